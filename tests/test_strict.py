"""Strict runs stop where the model no longer holds; what was beyond its limit is told by phase."""

import json
import pickle
import warnings

import numpy as np
import pytest

from apu_casadi.core.errors import ApuWarning, ValidityError, ValidityWarning
from apu_casadi.core.profiles.profile import varying
from apu_casadi.core.profiles.shapes import Ramp
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.departures import REMEDIES
from apu_casadi.unit.events import LoadChange
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.validity import unserved
from scenarios import registry
from scenarios.cli import main
from scenarios.commands.run import made_with
from scenarios.schema import Scenario

APU = Apu()
KW100, KW225 = SeriesLoad.from_power(100e3), SeriesLoad.from_power(225e3)
HOT = SeriesLoad.from_power(285e3)
LARGE = SeriesLoad.from_power(330e3)
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


def run(load=KW100, events=(), apu=APU, **how):
    return simulate_joint(
        apu, **{"duration": 2.0, "load": load, "events": events, "waveform_dt": None, **how}
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


ALL = APU.change({"generator.power": "torque"})
FULL = ConstantPowerLoad(500e3)
COLD = Limits(T4_max=np.inf)
EACH = {
    "temperature": ({"limits": Limits(T4_max=1150.0)}, [LoadChange(0.1, KW225)]),
    "surge": ({"limits": Limits(SM_min=0.2)}, [LoadChange(0.1, KW225)]),
    "off_map": ({"limits": Limits(off_map=0.0), "N_ref": 1.12 * APU.N_ref, "duration": 0.1}, []),
    "fuel_limit": ({"load": KW225, "duration": 0.4, "limits": COLD}, [LoadChange(0.1, LARGE)]),
    "unserved": (
        {"apu": ALL, "load": KW225, "exchange": "predicted"}, [LoadChange(0.2, FULL, generator=2)],
    ),
    "torque": ({"duration": 0.3}, [LoadChange(0.1, SHORT, generator=2)]),
    "spike": ({"load": KW225, "duration": 0.3}, [LoadChange(0.1, OpenLoad(), generator=1)]),
    "exchange": ({"dt": 0.08}, [LoadChange(0.5, KW225)]),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("kind", EACH)
def test_every_kind_is_data_and_stops_a_strict_run(kind):
    """With the reason, the instant and what to do; the run that goes on has it as data."""
    given, events = EACH[kind]
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        ds = run(events=events, **given)
    assert raised and all(issubclass(w.category, ApuWarning) for w in raised)
    rows = [d for d in json.loads(ds.attrs["validity"]) if d["kind"] == kind]
    d = min(rows, key=lambda d: d["first"] or 0.0)
    numbers = {"unserved": [2], "torque": [2], "spike": [1]}
    assert d["generators"] == numbers.get(kind) and d["remedy"] == REMEDIES[kind]
    with pytest.raises(ValidityError) as caught:
        run(events=events, **given, strict=True)
    text, end = str(caught.value), float(ds["time"][-1])
    assert REMEDIES[kind] in text and text.endswith("the run goes on, with a warning")
    if kind == "exchange":
        assert d["first"] is None and d["worst"] == ds.attrs["exchange_error"] > d["limit"]
        assert caught.value.t == end
    elif kind == "unserved":  # it has to last before it is told
        assert d["first"] <= caught.value.t <= d["first"] + 0.15 and "asked of generator 2" in text
    else:
        assert caught.value.t == pytest.approx(d["first"], abs=1e-9)
    if d["quantity"] in ds and kind != "unserved":
        sign = 1.0 if d["worst"] >= d["limit"] else -1.0
        worst = (sign * ds[d["quantity"]].values).max() * sign
        assert d["worst"] == pytest.approx(worst)


def test_limits_are_those_of_the_engines_file(tmp_path):
    """In the warning, in the phases of the summary, and where a strict run stops."""
    engine = tmp_path / "engine.toml"
    engine.write_text("[limits]\nT4_max = { value = 1150.0, unit = 'K' }\n")
    s = Scenario.from_toml_text(TOML.replace("285", "225")).change(engine=str(engine))
    with pytest.warns(ValidityWarning, match=r"hot: T4 = .* \(limit 1150\)"):
        ds = registry.run(s)
    (d,) = registry.summary(ds)["validity"]
    assert (d["kind"], d["limit"], d["phases"]) == ("temperature", 1150.0, ["too much"])
    with pytest.raises(ValidityError, match=r"in phase 'too much': hot: T4 .*\(limit 1150\)") as e:
        registry.run(s, strict=True)
    assert e.value.t == d["first"] > 1.0


def test_what_one_machine_lacks_is_told_by_phase_and_number():
    """A load of constant power of one machine, and less for both again."""
    more = """
[[event]]
time = 1.1
generator = 2
load = { kind = "constant_power", power_kW = 500.0 }
[[phase]]
name = "less"
start = 1.6
load = { kind = "R", power_kW = 100.0 }
"""
    text = TOML.replace("power_kW = 285 }", f"power_kW = 225 }}{more}")
    with pytest.warns(ApuWarning):
        ds = registry.run(Scenario.from_toml_text(text))
    report = registry.summary(ds)
    (d,) = [d for d in report["validity"] if d["kind"] == "unserved"]
    assert d["generators"] == [2] and d["phases"] == ["too much"] and 1.2 <= d["first"] < 1.6
    (_, (one,), _) = [[b for b in p["beyond"] if b["kind"] == "unserved"] for p in report["phases"]]
    assert one["generators"] == [2] and 0 < one["duration"] <= 0.5
    assert any("P_e of generator 2 for " in line for line in made_with(report))


def test_a_demand_that_grows_along_a_profile_is_followed():
    """Power that stays while 100 to 200 kW are asked: from nine tenths of the demand on."""
    load = varying(ConstantPowerLoad, Ramp(100e3, 200e3, over=1.0))
    t = np.linspace(0.0, 3.0, 151)
    held = unserved(load, [LoadChange(2.0, KW100)], t, np.full(151, 120e3))
    assert held.first == pytest.approx(0.36) and held.limit == pytest.approx(200e3)
    assert held.duration == pytest.approx(1.66)
    assert unserved(load, [], t, np.full(151, 190e3)) is None


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
