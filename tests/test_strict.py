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
from apu_casadi.unit.monolithic import simulate_monolithic
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.validity import fuel_limited, unserved
from scenarios import registry
from scenarios.cli import main
from scenarios.commands.run import made_with
from scenarios.schema import Scenario

APU = Apu()
KW100, KW225 = SeriesLoad.from_power(100e3), SeriesLoad.from_power(225e3)
HOT = SeriesLoad.from_power(285e3)
LARGE = SeriesLoad.from_power(330e3)
SHORT = SeriesLoad(R=(1e-3,) * 3)
ALL = APU.change({"generator.power": "torque"})
FULL = ConstantPowerLoad(500e3)
COLD = Limits(T4_max=np.inf)
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
    """An exchange error beyond the limit, of a transient that has not passed."""
    how = {"events": [LoadChange(0.5, KW225)], "dt": 0.08, "duration": 0.8}
    words = r"at t = 0.8 s: at the end of the run: exchange 'paper'"
    with pytest.raises(ValidityError, match=words):
        run(**how, strict=True)


@pytest.mark.parametrize("solver", ["auto", "cvodes"])
def test_an_exchange_that_errs_stops_it_when_the_transient_has_passed(solver):
    """At the instant of the largest error, and not at the end of the run."""
    how = {"events": [LoadChange(0.5, KW225)], "dt": 0.08, "solver": solver}
    words = r"exchange 'paper' every 80 ms: estimated error [0-9]+ % .* so far; "
    done = []
    with pytest.raises(ValidityError, match=words) as caught:
        run(**how, duration=60.0, strict=True, progress=lambda t, _: done.append(t))
    assert 0.5 < caught.value.t < 1.5 and done[-1] < 4.0
    with pytest.warns(ApuWarning) as raised:
        ds = run(**how, duration=1.6)
    assert f"{100 * ds.attrs['exchange_error']:.0f} %" in str(caught.value)
    assert len(raised) == 1


@pytest.mark.parametrize(
    "model", [simulate_joint, pytest.param(simulate_monolithic, marks=pytest.mark.long)]
)
def test_a_fuel_limit_stops_it_when_the_speed_has_fallen_for_long(model):
    """Since when, and how low the speed is; the run that goes on tells the same at its end."""
    done, events = [], [LoadChange(0.1, SeriesLoad.from_power(308e3))]
    how = {"load": KW225, "events": events, "limits": Limits.none()}
    if model is simulate_joint:
        how["waveform_dt"] = None
    words = r"asks for more than the engine gives: at t = .* since t = .* and the speed still falls"
    with pytest.raises(ValidityError, match=words) as caught:
        model(APU, duration=2.0, **how, strict=True, progress=lambda t, _: done.append(t))
    since = caught.value.t
    assert 0.1 < since < 0.5 and since < done[-1] < since + 0.5  # before the step that stops it
    with pytest.warns(ValidityWarning, match=rf"since t = {since:.6g} s"):
        model(APU, duration=since + 0.3, **how)


def test_a_fuel_limit_that_lasted_within_a_run_is_told():
    """Half a second of falling speed at the limit, and a recovery; a shorter one is no reason."""
    t, high = np.arange(0.0, 2.0, 0.02), APU.governor.Wf_max
    N = APU.N_ref * (1 - 0.01 * np.clip(t - 0.5, 0.0, 0.6))
    N[t > 1.1] += 0.1
    Wf = np.where((t > 0.51) & (t < 1.11), high, 0.5 * high)
    d = fuel_limited(APU, t, N, Wf)
    assert (d.first, d.at, d.kind) == (pytest.approx(0.52), pytest.approx(1.1), "fuel_limit")
    assert "at t = 1.1 s the governor is at its limit" in d.text()
    assert fuel_limited(APU, t, N, np.where(t < 1.0, Wf, 0.5 * high)) is None


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
        assert 0.5 < caught.value.t < end
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
