"""Strict runs stop where the model no longer holds; what was beyond its limit is told by phase."""

import json
import pickle

import numpy as np
import pytest

from apu_casadi.core.errors import ApuWarning, ValidityError, ValidityWarning
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import LoadChange
from apu_casadi.unit.multirate import simulate_joint
from scenarios import registry
from scenarios.cli import main

APU = Apu()
KW100, KW225 = SeriesLoad.from_power(100e3), SeriesLoad.from_power(225e3)
HOT = SeriesLoad.from_power(285e3)
SHORT = SeriesLoad(R=(1e-3,) * 3)
TOML = """
name = "hot"
duration = 2.0
waveform_dt = 0
[[phase]]
name = "cool"
start = 0.0
load = { kind = "R", power_kW = 150 }
[[phase]]
name = "too much"
start = 1.0
load = { kind = "R", power_kW = 285 }
"""


def run(load=KW100, events=(), **how):
    return simulate_joint(
        APU, **{"duration": 2.0, "load": load, "events": events, "waveform_dt": None, **how}
    )


@pytest.mark.parametrize("solver", ["auto", "cvodes"])
def test_it_stops_at_the_first_instant_beyond_a_limit(solver):
    """Of the same run that only warns: same quantity, limit and instant."""
    events = [LoadChange(1.0, HOT)]
    with pytest.warns(ValidityWarning):
        ds = run(events=events, solver=solver)
    found = json.loads(ds.attrs["validity"])
    first = min(found, key=lambda d: d["first"])
    with pytest.raises(ValidityError, match=rf"{first['quantity']} = .*\(limit ") as caught:
        run(events=events, solver=solver, strict=True)
    assert caught.value.t == pytest.approx(first["first"], abs=1e-9)
    assert isinstance(pickle.loads(pickle.dumps(caught.value)), ValidityError)


def test_a_run_within_the_limits_is_the_same():
    a, b = run(events=[LoadChange(0.5, KW225)]), run(events=[LoadChange(0.5, KW225)], strict=True)
    assert all(np.array_equal(a[n], b[n]) for n in ("N", "T4", "V_a_rms"))


def test_one_machine_of_two_stops_it_by_number():
    """A short at the terminals of the second: torque beyond eq. (8), at the first step's end."""
    events = [LoadChange(0.1, SHORT, generator=2)]
    with pytest.warns(ApuWarning, match=r"eq. \(8\) gives too little"):
        run(events=events, duration=0.3)
    with pytest.raises(ValidityError, match=r"at t = 0.12 s: eq. \(8\).*generator 2 ") as caught:
        run(events=events, duration=0.3, strict=True)
    assert caught.value.t == pytest.approx(0.12)
    with pytest.raises(ValidityError, match=r"generator 1: at t = 0.1 s a switch to OpenLoad"):
        run(KW225, [LoadChange(0.1, OpenLoad(), generator=1)], duration=0.3, strict=True)


def test_what_shows_at_the_end_only_is_refused_there():
    """An exchange error beyond the limit."""
    how = {"events": [LoadChange(0.5, KW225)], "dt": 0.08}
    with pytest.raises(ValidityError, match=r"at t = 2 s: at the end of the run: exchange 'paper'"):
        run(**how, strict=True)


def test_summary_and_command_tell_the_phase(tmp_path, capsys):
    file = tmp_path / "hot.toml"
    file.write_text(TOML)
    with pytest.warns(ValidityWarning):
        ds = registry.run(file)
    cool, hot = registry.summary(ds)["phases"]
    assert cool["beyond"] == []
    whole = {d["quantity"]: d for d in json.loads(ds.attrs["validity"])}
    assert {d["quantity"] for d in hot["beyond"]} == set(whole)
    for d in hot["beyond"]:
        assert d["worst"] == whole[d["quantity"]]["worst"]
        assert d["first"] == pytest.approx(whole[d["quantity"]]["first"])
        assert d["first"] > 1.0
    assert hot["I_2_over_I_1"] == 0.0
    out = ["--out", str(tmp_path / "out"), "--no-figures"]
    assert main(["run", str(file), "--strict", *out]) != 0
    said = capsys.readouterr().err
    assert "in phase 'too much'" in said and "(limit" in said
    assert not list((tmp_path / "out").glob("*.nc"))
