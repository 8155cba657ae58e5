"""What a run says of itself at its end: limits left, overloads, the error of its exchange."""

import json
import math
import warnings

import numpy as np
import pytest

from apu_casadi import Ambient, Apu, ConstantPowerLoad, HealthChange, LoadChange, SeriesLoad, trim
from apu_casadi.core.errors import ExchangeWarning, ScenarioError, SimulationError, ValidityWarning
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.unit import validity as v
from apu_casadi.unit.monolithic import simulate_monolithic
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.noise import Noise
from scenarios import cli, registry
from scenarios.campaigns import run_campaign
from scenarios.schema import Scenario
from scenarios.studies import multirate_study

KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
# a worn compressor on a very hot day: it gets hot at once, and beyond surge as the speed falls
HOT = Ambient(dT_isa=55.0)
WORN = {"f_eta_c": 0.84}
SLOW = {"waveform_dt": None, "solver": "cvodes"}  # nothing is compiled for it
QUICK = {"waveform_dt": None, "solver": "propagator"}


@pytest.fixture(scope="module")
def apu():
    return Apu()


def quietly(simulate, *args, **kwargs):
    """Run with the package's warnings kept back, and return run and warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ds = simulate(*args, **kwargs)
    return ds, [w for w in caught if issubclass(w.category, v.ApuWarning)]


# ------------------------------------------------------------------------------ limits


def test_departures_are_found_with_value_time_and_duration():
    """Against a plain loop over random outputs; a limit of infinity is none."""
    gg, rng = GasGenerator(), np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.01, 0.03, 200))
    y = {n: rng.normal(0.0, 1.0, 200) for n in ("SM", "off_c", "off_t", "Mach8")}
    y |= {"T4": rng.normal(1300, 20, 200), "T5": rng.normal(800, 20, 200), "Wf": np.full(200, 0.03)}
    limits = Limits(off_map=0.5, SM_min=-0.5, Mach8_max=1.2)
    found = {d.quantity: d for d in v.departures(gg, t, y, limits)}
    assert set(found) == {"SM", "off_c", "off_t", "Mach8", "T4"}
    for _, name, sign, limit in limits.rows(gg):
        if name not in found:
            continue
        d, duration, first, worst = found[name], 0.0, None, -math.inf
        for k in range(200):
            if sign * (y[name][k] - limit) > 0:
                duration += t[k] - t[k - 1] if k else 0.0
                first = t[k] if first is None else first
                worst = max(worst, sign * y[name][k])
        assert (d.first, d.limit) == (first, limit)
        assert d.duration == pytest.approx(duration, rel=1e-12)
        assert d.worst == pytest.approx(sign * worst) == y[name][np.flatnonzero(t == d.at)[0]]
    assert v.departures(gg, t, y, Limits.none()) == v.departures(
        gg, t, {"Mach8": y["Mach8"]}, Limits.none()
    )


@pytest.mark.parametrize("way", ["propagator", "cvodes", "waveforms", "monolithic"])
def test_a_run_beyond_surge_says_so_on_every_path(apu, way):
    """Block and single steps, CVODES, the one model: margin, T4, first time and duration."""
    options = dict(QUICK)
    if way == "waveforms":
        options["waveform_dt"] = 1e-3
    if way == "cvodes":
        options["solver"] = "cvodes"
    simulate = simulate_joint
    if way == "monolithic":
        options, simulate = {"rtol": 1e-6}, simulate_monolithic
    events = [HealthChange(0.1, WORN)]
    ds, raised = quietly(
        simulate, apu, duration=0.5, load=SeriesLoad.from_power(215e3), ambient=HOT,
        events=events, **options,
    )  # fmt: skip
    rows = {r["quantity"]: r for r in json.loads(ds.attrs["validity"])}
    assert rows["T4"]["worst"] == float(ds["T4"].max()) > rows["T4"]["limit"]
    assert rows["T4"]["first"] == 0.0  # hot from the start, which is no reason not to simulate
    assert rows["T4"]["duration"] == pytest.approx(0.5)
    beyond = ds["SM"].values < 0
    assert rows["SM"]["worst"] == float(ds["SM"].min()) < 0
    assert rows["SM"]["first"] == float(ds["time"].values[np.argmax(beyond)])
    assert rows["SM"]["duration"] == pytest.approx(0.02 * beyond.sum(), rel=1e-6)
    (one,) = [w for w in raised if "the range in which the model holds" in str(w.message)]
    assert one.category is ValidityWarning
    text = str(one.message)
    assert text in json.loads(ds.attrs["warnings"])
    for part in (
        "beyond surge: SM = -",
        "hot: T4 = ",
        "first beyond it at t = 0 s, for 0.5 s in all",
    ):
        assert part in text
    assert one.filename == __file__  # it points at the caller


def test_within_the_limits_nothing_is_said(apu):
    """filterwarnings = error: a warning would fail the test."""
    ds = simulate_joint(
        apu, duration=0.4, load=KW225, events=[LoadChange(0.1, KW100)], exchange="predicted",
        dt=0.01, **QUICK,
    )  # fmt: skip
    assert json.loads(ds.attrs["warnings"]) == json.loads(ds.attrs["validity"]) == []


# ------------------------------------------------------------------------------ overload


@pytest.mark.long
@pytest.mark.parametrize("way", ["propagator", "cvodes", "predicted", "monolithic"])
@pytest.mark.parametrize("load", [SeriesLoad.from_power(450e3), ConstantPowerLoad(400e3)])
def test_an_overload_is_told_as_one(apu, way, load):
    """Time, speed, fuel limit, the power asked for and what the engine gives: not N = nan."""
    options = {"events": [LoadChange(0.1, load)], "duration": 1.0, "load": KW225}
    simulate = simulate_joint
    if way == "monolithic":
        simulate = simulate_monolithic
        options["rtol"] = 1e-6
    else:
        options |= {"waveform_dt": None, "solver": "cvodes" if way == "cvodes" else "propagator"}
        options["exchange"] = "predicted" if way == "predicted" else "paper"
    with pytest.raises(SimulationError) as error:
        simulate(apu, **options)
    text = str(error.value)
    assert text.startswith("at t = 0.") and "nan" not in text
    assert "the load asks for more than the engine can give at the fuel limit" in text
    most = trim(apu.gas_generator, {"N": apu.N_ref, "Wf": apu.governor.Wf_max},
                limits=Limits.none())["PW"]  # fmt: skip
    assert f"with Wf_max = 0.06 kg/s the engine gives {most / 1e3:.1f} kW" in text
    assert "% of the governed one" in text
    asked = float(text.split("it asks for ")[1].split(" kW")[0])
    assert asked > most / 1e3


def test_other_failures_are_not_called_overloads(apu):
    """Fuel below its limit, or a speed at or above the governed one."""
    at = {"ambient": {}, "health": {}, "PW": 9e5}
    assert v.overload(apu, N=0.9 * apu.N_ref, Wf=0.05, **at) is None
    assert v.overload(apu, N=1.01 * apu.N_ref, Wf=0.06, **at) is None
    text = v.overload(apu, N=0.9 * apu.N_ref, Wf=0.06, **(at | {"PW": math.nan}))
    assert "asks for more shaft power" in text and "nan" not in text


def test_an_overload_that_the_end_cut_off_is_told(apu):
    """The fuel at its limit and the speed falling at the end of a run that did not fail."""
    ds, raised = quietly(
        simulate_joint, apu, duration=0.4, load=KW225,
        events=[LoadChange(0.1, SeriesLoad.from_power(330e3))], **QUICK,
    )  # fmt: skip
    (text,) = [str(w.message) for w in raised if "its limit Wf_max" in str(w.message)]
    assert "the speed still falls" in text and text in json.loads(ds.attrs["warnings"])
    t, N, Wf = (ds[n].values for n in ("time", "N", "Wf"))
    first = t[np.flatnonzero(Wf < apu.governor.Wf_max - 1e-12)[-1] + 1]
    assert f"since t = {first:.6g} s" in text
    # a recovery is none
    assert v.fuel_limited(apu, t, np.append(N[:-1], 1.001 * N[-2]), Wf) is None


def test_a_constant_power_load_without_its_power_is_told(apu):
    """500 kW of each generator collapse the voltage: 3 % fuel is all that it costs."""
    big = ConstantPowerLoad(500e3)
    ds, raised = quietly(
        simulate_joint, apu, duration=1.0, load=KW225, events=[LoadChange(0.2, big)],
        exchange="predicted", **QUICK,
    )  # fmt: skip
    assert float(ds["P_e"][-1]) < 0.9 * big.P
    assert any("of the 500.0 kW asked of each generator" in str(w.message) for w in raised)
    P_e = np.full(101, 100e3)
    t = np.linspace(0.0, 1.0, 101)
    assert v.unserved(ConstantPowerLoad(100e3), [], t, P_e) is None
    late = v.unserved(ConstantPowerLoad(2e5), [LoadChange(0.5, KW100)], t, P_e)
    assert "at t = 0.5 s" in late.text()
    assert (late.quantity, late.limit, late.worst, late.at) == ("P_e", 2e5, 1e5, 0.5)
    assert (late.first, late.duration) == (pytest.approx(0.1), pytest.approx(0.41))


# ------------------------------------------------------------------------------ exchange error


@pytest.fixture(scope="module")
def truths(apu):
    """Cases of the study with an exchange step of 4 ms, corrected: its errors are 8e-5."""
    return {
        name: case.run(
            simulate_joint, apu, duration=0.64, dt=4e-3, exchange="corrected", **QUICK
        )
        for name, case in multirate_study.CASES.items() if name != "TTSC fault"
    }  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("case", ["load step", "gas-path fault"])
@pytest.mark.parametrize("exchange", ["paper", "predicted", "corrected"])
def test_the_estimate_is_the_error(apu, truths, case, exchange):
    """Estimated over true error: within 15 %; 0.90 to 1.06 was measured from 5 to 160 ms."""
    truth = truths[case]
    N = truth["N"].values
    excursion = np.abs(N - N[0]).max()
    for dt in (0.02, 0.08, 0.16):
        ds = multirate_study.CASES[case].run(
            simulate_joint, apu, duration=0.64, dt=dt, exchange=exchange, warn_exchange=False,
            **QUICK,
        )  # fmt: skip
        there = np.interp(ds["time"].values, truth["time"].values, N)
        true = np.abs(ds["N"].values - there).max() / excursion
        assert ds.attrs["exchange_error"] == pytest.approx(true, rel=0.15), dt


def test_the_measured_errors_of_the_study_are_estimated(apu):
    """docs/MULTIRATE.md, against the one model: 5.0e-2, 5.6e-3 and 2.0e-3 for a load step."""
    for exchange, measured in (("paper", 5.0e-2), ("predicted", 5.6e-3), ("corrected", 2.0e-3)):
        ds = multirate_study.CASES["load step"].run(
            simulate_joint, apu, duration=0.8, exchange=exchange, **QUICK
        )
        assert ds.attrs["exchange_error"] == pytest.approx(measured, rel=0.15)


def test_the_estimate_at_the_fuel_limit(apu):
    """A load step that takes the governor to its limit: the reference is limited like the run."""
    events = [LoadChange(0.1, SeriesLoad.from_power(275e3))]
    options = {"duration": 0.8, "load": KW100, "events": events, "warn_exchange": False, **QUICK}
    truth, _ = quietly(simulate_joint, apu, dt=4e-3, exchange="corrected", **options)
    ds, _ = quietly(simulate_joint, apu, dt=0.04, **options)
    assert float(truth["Wf"].max()) == apu.governor.Wf_max  # or the test tests nothing
    N = truth["N"].values
    there = np.interp(ds["time"].values, truth["time"].values, N)
    true = np.abs(ds["N"].values - there).max() / np.abs(N - N[0]).max()
    assert ds.attrs["exchange_error"] == pytest.approx(true, rel=0.25)


@pytest.mark.parametrize(
    ("exchange", "dt", "warned"),
    [("paper", 0.02, False), ("paper", 0.04, True), ("paper", 0.2, True),
     ("predicted", 0.02, False), ("predicted", 0.2, True), ("corrected", 0.2, True)],
)  # fmt: skip
def test_a_coarse_exchange_warns(apu, exchange, dt, warned):
    """Beyond 1 % of the excursion, but for the paper's own exchange as it is printed."""
    ds, raised = quietly(
        multirate_study.CASES["load step"].run, simulate_joint, apu, duration=1.2, dt=dt,
        exchange=exchange, **QUICK,
    )  # fmt: skip
    texts = [str(w.message) for w in raised if w.category is ExchangeWarning]
    assert (len(texts) == 1) == warned
    assert texts == json.loads(ds.attrs["warnings"])
    if warned:
        assert ds.attrs["exchange_error"] > 0.01
        assert f"every {1e3 * dt:g} ms: estimated error" in texts[0] and "; use " in texts[0]


def test_the_papers_exchange_is_accepted_for_what_it_loses_there():
    """5 % with the paper's governor; a governor with which it loses 30 % is warned of."""
    assert not v.notes_of_exchange(0.05, "paper", 0.02)
    assert "as the paper's scheme has it" in v.exchange_words(0.05, "paper", 0.02)
    (note,) = v.notes_of_exchange(0.3, "paper", 0.02)
    assert "30 % of the speed's excursion; use exchange 'predicted' or 'corrected'" in str(note)
    assert v.notes_of_exchange(0.05, "paper", 0.021) and v.notes_of_exchange(
        0.011, "corrected", 0.02
    )
    assert not v.notes_of_exchange(math.nan, "paper", 0.2)


def test_a_quick_governor_makes_the_papers_exchange_err_more(apu):
    """Crossover at 24 rad/s instead of 8: the estimate follows, against an exchange of 4 ms."""
    quick = apu.change({"governor.Kp": 1.14, "governor.Ki": 2.28})
    case = multirate_study.CASES["gas-path fault"]
    (ds, raised), (truth, _) = (
        quietly(case.run, simulate_joint, quick, duration=0.6, dt=dt, exchange=ex, **SLOW)
        for dt, ex in ((0.02, "paper"), (0.004, "corrected"))
    )
    N = truth["N"].values
    there = np.interp(ds["time"].values, truth["time"].values, N)
    true = np.abs(ds["N"].values - there).max() / np.abs(N - N[0]).max()
    assert true > v.PAPER_ERROR and ds.attrs["exchange_error"] == pytest.approx(true, rel=0.15)
    assert [w.category for w in raised] == [ExchangeWarning]


def test_no_estimate_where_there_is_none(apu):
    """State noise is drawn for each exchange step; nothing moves in a steady run."""
    noisy = simulate_joint(apu, duration=0.1, load=KW100, noise=Noise(N=0.1), seed=1, **QUICK)
    assert math.isnan(noisy.attrs["exchange_error"])
    still = simulate_joint(apu, duration=0.4, load=KW100, dt=0.2, **QUICK)
    assert still.attrs["exchange_error"] < 1e-5  # of an excursion of nothing


def test_a_long_run_is_estimated_in_pieces(apu):
    """The pieces are joined: any length of them gives the same, but for rounding of sums."""
    ds = multirate_study.CASES["load step"].run(simulate_joint, apu, duration=1.0, **QUICK)
    point = apu.steady_state(KW225).gas
    args = (apu, point, *(ds[n].values for n in ("time", "N", "Wf")))
    whole = v.exchange_error(*args)
    with pytest.MonkeyPatch.context() as m:
        m.setattr(v, "_CHUNK", 7)
        parted = v.exchange_error(*args)
    assert parted.error == pytest.approx(whole.error, rel=1e-11)
    assert parted.excursion == pytest.approx(whole.excursion, rel=1e-11)
    assert whole.error == ds.attrs["exchange_error"]


# ------------------------------------------------------------------------------ commands, campaigns

SURGE = """
name = "surge"
duration = 0.5
exchange = "predicted"
seed = 7
[ambient]
dT_isa = 55.0
[[phase]]
name = "worn"
start = 0.0
load = { kind = "R", power_kW = 215.0 }
[[phase]]
name = "ill"
start = 0.1
health = { f_eta_c = 0.84 }
fault = { mu = 0.002, k_rf = 100.0, phase = "b" }
"""


def test_the_command_prints_each_warning_once_and_keeps_it(tmp_path, capsys):
    """stderr has one line each; summary.json has the list; the summary has what was asked."""
    file = tmp_path / "surge.toml"
    file.write_text(SURGE, encoding="utf-8")
    argv = ["run", str(file), "--out", str(tmp_path / "out"), "--no-waveforms", "--no-figures",
            "--solver", "propagator"]  # fmt: skip
    assert cli.main(argv) == 0
    out, err = capsys.readouterr()
    lines = [x for x in err.splitlines() if x.startswith("warning: ")]
    report = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert [f"warning: {w}" for w in report["warnings"]] == lines and len(set(lines)) == len(lines)
    assert sum("beyond surge" in x for x in lines) == 1
    assert report["ambient"] == {"altitude": 0.0, "Mach": 0.0, "dT_isa": 55.0, "war": 0.0}
    assert report["solver"]["solver"] == "propagator" and report["seed"] == 7
    assert report["exchange"] == "predicted" and 0 < report["exchange_error"] < 0.01
    assert [p["fault_phase"] for p in report["phases"]] == [None, "b"]
    assert [p["load"] for p in report["phases"]] == ["215 kW", "215 kW"]
    assert {r["quantity"] for r in report["validity"]} >= {"SM", "T4"}
    for part in ("ISA + 55 K", "solver propagator", "seed 7", "beyond the model's limits: ",
                 "exchange 'predicted' every 20 ms: estimated error", "apu-casadi "):  # fmt: skip
        assert part in out


@pytest.mark.long
def test_the_command_takes_an_exchange(tmp_path, capsys):
    file = tmp_path / "surge.toml"
    file.write_text(SURGE.replace("exchange =", "# exchange ="), encoding="utf-8")
    argv = ["run", str(file), "--out", str(tmp_path), "--no-waveforms", "--no-figures", "--json",
            "--solver", "propagator"]  # fmt: skip
    assert cli.main([*argv, "--exchange", "corrected"]) == 0
    assert json.loads(capsys.readouterr().out)["exchange"] == "corrected"
    assert cli.main([*argv, "--exchange", "correct"]) == 2
    assert "did you mean 'corrected'?" in capsys.readouterr().err
    s = Scenario.from_toml_text(SURGE)
    assert s.exchange == "predicted" and Scenario.from_dict(s.to_dict()) == s
    with pytest.raises(ScenarioError, match="exchange: unknown 'half'"):
        s.change(exchange="half")


def test_a_campaign_keeps_the_warnings_of_each_run():
    """No warning comes out of the campaign itself; every run's are in its record."""
    s = Scenario.from_toml_text(SURGE)
    calm = s.change(name="calm", ambient=Ambient())
    ds = run_campaign([s, calm.change(phases=calm.phases[:1])], workers=1)
    assert "beyond surge" in str(ds["warnings"].values[0]) and ds["warnings"].values[1] == "-"
    assert float(ds["exchange_error"][0]) < 0.01
    assert ds.attrs["ambient"] == "differs from run to run" and ds.attrs["apu_casadi_version"]


def test_attributes_tell_what_was_asked(apu):
    """Day, loads, faults with their phase, seed, version; and the captions say them."""
    from scenarios.figures.runwords import fault_phase, made_with

    mild = SURGE.replace("f_eta_c = 0.84", "f_eta_c = 0.98")
    s = Scenario.from_toml_text(mild).change(ambient=Ambient(), waveform_dt=None)
    ds = registry.run(s, solver="propagator")
    assert json.loads(ds.attrs["faults"])[1]["phase"] == "b" and ds.attrs["seed"] == 7
    assert fault_phase(ds, 0.4) == " of phase b" and fault_phase(ds, 0.05) == ""
    words = made_with(ds)
    for part in ("Load of each generator: 215 kW", "ISA +5 K", "propagator", "seed 7"):
        assert part in words
    bare = ds.copy()
    bare.attrs = {}
    assert made_with(bare) == ""


def test_the_truth_of_an_estimation_is_judged_too():
    """It runs with other steps and its own call; the estimate takes over its attributes."""
    from scenarios.studies import jointrun

    table = {
        "name": "hot", "duration": 0.06,
        "phase": [{"name": "worn", "start": 0.0, "load": {"kind": "R", "power_kW": 225.0},
                   "health": {"f_eta_c": 0.85}}],
    }  # fmt: skip
    ds, raised = quietly(jointrun.truth, Scenario.from_dict(table))
    assert [r["quantity"] for r in json.loads(ds.attrs["validity"])] == ["T4"]
    assert [w.category for w in raised] == [ValidityWarning]
    told = jointrun.made_with(ds)
    assert told["warnings"] == [str(raised[0].message)] and told["loads"][0]["load"] == "225 kW"
    words = jointrun.made_words(told | {"truth_solver": json.loads(ds.attrs["solver"])})
    assert "load of each generator 225 kW from 0 s; truth by cvodes, exchange corrected" in words
