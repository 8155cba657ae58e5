"""Scenario descriptions: what a file may say, and how a wrong one is refused."""

import pickle
import sys
import types

import pytest

from apu_casadi.core.errors import ApuError, ApuWarning, ParameterError, ScenarioError
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit import runsummary
from apu_casadi.unit.events import Ambient, FaultChange, HealthChange, LoadChange, in_order
from apu_casadi.unit.runsignals import RUN
from scenarios import registry, units
from scenarios.reading import read_fault, read_load
from scenarios.schema import Change, Phase, Scenario

GOOD = """
name = "mine"
duration = 4.0
[[phase]]
name = "start"
start = 0.0
load = { kind = "R", power_kW = 225.0 }
[[phase]]
name = "fault"
start = 2.0
fault = { mu = 0.05, k_rf = 20.0 }
"""


def read(text):
    return Scenario.from_toml_text(text, "mine.toml")


def refusal(text):
    with pytest.raises(ScenarioError) as e:
        read(text)
    return str(e.value)


def test_joint_is_the_paper_s_run():
    """Section 6.3 and Figure 20; the turbine flow capacity increases."""
    s = registry.get("joint")
    assert s.duration == 14.0
    assert [p["start"] for p in s.phase_table()] == [0.0, 2.0, 6.0, 10.0]
    assert s.phase_table()[-1]["end"] == 14.0
    start = s.start()
    assert start["load"] == SeriesLoad.from_power(225e3)
    assert start["health"] is None and start["fault"] is None
    drop, health, fault = s.events()
    assert drop == LoadChange(2.0, SeriesLoad.from_power(100e3))
    assert health == HealthChange(
        6.0, {"f_eta_c": 0.99, "f_eta_t": 0.98, "f_W_c": 0.97, "f_W_t": 1.04}
    )
    assert isinstance(fault, FaultChange) and fault.fault is not None
    assert (fault.t, fault.fault.mu, fault.fault.k_rf, fault.fault.kappa) == (10.0, 0.05, 20, 0.05)
    other = registry.get("joint_capacity_loss").events()[1]
    assert isinstance(other, HealthChange) and other.factors["f_W_t"] == 0.96


@pytest.mark.parametrize("s", registry.list_scenarios(), ids=lambda s: s.name)
def test_library_scenarios_build_and_survive_the_round_trip(s):
    assert s.title
    assert Scenario.from_dict(s.to_dict()) == s
    assert pickle.loads(pickle.dumps(s)) == s
    s.start()
    in_order(s.events(), s.duration)


def test_library_has_joint_first():
    names = [s.name for s in registry.list_scenarios()]
    assert names[0] == "joint"
    assert {"joint_capacity_loss", "gas_path_fault", "ttsc_leaky", "load_step"} <= set(names)
    assert {"unbalanced", "quiet"} <= set(names)


def test_every_kind_of_load_is_built_in_si_units():
    assert read_load({"kind": "open"}) == OpenLoad()
    assert read_load({"kind": "constant_power", "power_kW": 100, "lag_ms": 4}) == ConstantPowerLoad(
        100e3, tau=4e-3
    )
    lagging = read_load({"kind": "RL", "power_kW": 90.0, "power_factor": 0.8})
    assert lagging == SeriesLoad.from_power(90e3, 0.8)
    series = read_load({"kind": "series", "R_ohm": (0.7, 0.8, 0.9), "L_mH": (0.1, 0.1, 0.1)})
    assert series.R == (0.7, 0.8, 0.9)
    inductances = series.L
    assert inductances == pytest.approx((1e-4, 1e-4, 1e-4))
    uneven = read_load({"kind": "R", "power_kW": 90.0, "unbalance": (1.1, 1.0, 0.9)})
    assert uneven == SeriesLoad.from_power(90e3, unbalance=(1.1, 1.0, 0.9))


def test_phases_and_events_keep_what_they_do_not_change():
    s = read(
        GOOD
        + """
[[event]]
time = 1.0
health = { f_eta_c = 0.99 }
[[event]]
time = 3.0
fault = "none"
health = { f_W_t = 1.04 }
[[phase]]
name = "repaired"
start = 3.5
health = "none"
"""
    )
    kinds = [(e.t, type(e).__name__) for e in s.events()]
    assert kinds == [
        (1.0, "HealthChange"), (2.0, "FaultChange"), (3.0, "HealthChange"), (3.0, "FaultChange"),
        (3.5, "HealthChange"),
    ]  # fmt: skip
    events = s.events()
    assert events[2].factors == {"f_eta_c": 0.99, "f_W_c": 1.0, "f_eta_t": 1.0, "f_W_t": 1.04}
    assert events[3].fault is None
    assert set(events[4].factors.values()) == {1.0}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kind = "R"', 'kind = "Rl"', "phase[1].load.kind: unknown 'Rl' (did you mean 'R"),
        ("power_kW", "power_kw", "phase[1].load.power_kw: unknown key (did you mean 'power_kW'?)"),
        ("power_kW = 225.0", 'power_kW = "225"', "load.power_kW: a number is expected, got '225'"),
        ("power_kW = 225.0", "power_kW = nan", "load.power_kW: must be finite, got nan"),
        ("power_kW = 225.0", "power_kW = -1", "load.power_kW: must lie in [0.1, 500] kW, got -1"),
        (", power_kW = 225.0", "", "phase[1].load.power_kW: missing: a 'R' load needs it"),
        ('"R",', '"open",', "load.power_kW: not a key of a 'open' load; it takes no other key"),
        ('"R",', '"R", power_factor = 1.0,', "load.power_factor: not a key of a 'R' load; it"),
        ("{ kind", "{ R_ohm = [1, 2], kind", "phase[1].load.R_ohm: not a key"),
        ("start = 2.0", "start = 4.0", "phase[2].start: 4 s is not before the end of the run at 4"),
        ("start = 2.0", "start = 0.0", "phase[2].start: 0 s is not after phase 'start' at 0 s"),
        ("start = 2.0", "begin = 2.0", "phase[2].begin: unknown key"),
        ("start = 2.0\n", "", "phase[2].start: missing (phase 'fault')"),
        ("start = 0.0", "start = 1.0", "phase[1].start: the first phase starts at 0 s, not at 1 s"),
        ('"fault"', '"start"', "phase[2].name: 'start' is the name of an earlier phase"),
        ("mu = 0.05", "mu = 5", "phase[2].fault.mu: must lie in (0, 0.99], got 5 (phase 'fault')"),
        ("mu = 0.05", "Mu = 0.05", "phase[2].fault.Mu: unknown key (did you mean 'mu'?)"),
        (", k_rf = 20.0", "", "phase[2].fault.k_rf: missing: mu and k_rf are both needed"),
        ("k_rf = 20.0", "k_rf = 20.0, kappa = 0.01", "fault.kappa: must lie in [0.05, 1], got 0"),
        ("k_rf = 20.0", 'k_rf = 20.0, phase = "A"', "fault.phase: unknown 'A' (did you mean 'a'?)"),
        ("fault = {", "health = { f_eta_C = 1.0 }\nfault = {", "unknown 'f_eta_C' (did you mean "),
        ("fault = {", "health = { f_W_t = 4 }\nfault = {", "health.f_W_t: must lie in (0.5, 1.5]"),
        ("duration = 4.0", "duration = true", "duration: a number is expected, got True"),
        ("duration = 4.0", "duraton = 4.0", "duraton: unknown key (did you mean 'duration'?)"),
        ("duration = 4.0", "duration = 4.0\nseed = -1", "seed: a whole number >= 0, got -1"),
        ("duration = 4.0", "duration = 4.0\nwaveform_dt = 3e-5", "does not divide dt = 0.02 s"),
        ("duration = 4.0", "duration = 4.0\nambient = 5", "ambient: a table is expected, got 5"),
        ('"mine"', '"../mine"', "name: only letters, digits"),
        ("[[phase]]", "[[phase]", "not valid TOML:"),
        ("duration = 4.0", "duration = { from = 1.0 }", "duration: a number that does not change"),
        ("duration = 4.0", 'duration = 4.0\nengine = "tpe33"', "engine: engine 'tpe33': no such "),
        ("duration = 4.0", 'duration = 4.0\nengine = "tpe33"', "(did you mean 'tpe331'?)"),
        ("{ mu", '{ generator = 2, kind = "none", mu', "phase[2].fault.mu: a generator without fa"),
        (
            "fault = { mu = 0.05, k_rf = 20.0 }",
            'fault = { kind = "none" }',
            "phase[2].fault.kind: h",
        ),
        (
            "{ mu",
            "{ generator = 3, mu",
            "phase[2].fault: generator 3, but the unit has 1 to 2 (pha",
        ),
    ],
)
def test_a_wrong_description_is_refused_with_file_place_and_nearest_name(old, new, message):
    text = refusal(GOOD.replace(old, new, 1) if old != '"fault"' else GOOD.replace(old, new))
    assert text.startswith("mine.toml: ")
    assert message in text


def test_toml_syntax_error_names_the_line():
    assert "line 2" in refusal('name = "x"\nduration = = 3')


def test_ambient_and_events_are_checked_in_place():
    assert "ambient.Mach: must lie in [0, 0.95], got 2" in refusal(GOOD + "[ambient]\nMach = 2")
    assert "ambient.mach: unknown key (did you mean 'Mach'?)" in refusal(
        GOOD + "[ambient]\nmach = 0.5"
    )
    assert "event[1].time: nothing changes then" in refusal(GOOD + "[[event]]\ntime = 1.0")
    twice = '[[event]]\ntime = 2.0\nfault = "none"'
    assert "event[1].fault: a second change of fault at 2 s" in refusal(GOOD + twice)
    assert "event[1].time: 9 s is not before" in refusal(GOOD + twice.replace("2.0", "9.0"))


def test_noise_is_a_table_of_standard_deviations():
    noise = read(GOOD + "[noise]\nN = 0.1\ngas = { T3 = 1.0 }\nterminal = { sigma_v = 0.5 }").noise
    assert (noise.N, noise.gas, noise.terminal.sigma_v) == (0.1, {"T3": 1.0}, 0.5)
    assert "noise.terminal.sigma_V: unknown key (did you mean 'sigma_v'?)" in refusal(
        GOOD + "[noise]\nterminal = { sigma_V = 0.5 }"
    )
    assert "noise.gas.T3: must be >= 0, got -1" in refusal(GOOD + "[noise]\ngas = { T3 = -1 }")
    assert "noise.gas.T33: unknown key (did you mean 'T3" in refusal(
        GOOD + "[noise]\ngas = { T33 = 1 }"
    )


def test_parameters_may_be_dotted_or_nested():
    for text in ("machine.r_s = 0.01", '"machine.r_s" = 0.01'):
        s = read(GOOD + "[parameters]\n" + text)
        assert dict(s.parameters) == {"machine.r_s": 0.01}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            "machine.r_z = 1",
            "machine.r_z: unknown parameter 'machine.r_z' (did you mean 'machine.r_s",
        ),
        ("machine.r_s = -1", "machine.r_s: MachineParameters.r_s [ohm] = -1 is outside [0, inf]"),
        (
            "machine.r_s = { from = 1, to = 2, over = 3 }",
            "machine.r_s: a number that does not chan",
        ),
        (
            '"machine.r_s" = "x"',
            "machine.r_s: MachineParameters.r_s [ohm] must be a number, got 'x'",
        ),
        ("generator.count = 7", "generator.count: generator.count = 7 is not one of 1 to 4"),
        ('governor.kind = "PX"', "governor.kind: unknown governor 'PX'"),
        (
            'generator2.neutral = "loose"',
            "generator2.neutral: neutral 'loose' (valid: grounded, is",
        ),
        ("generator5.machine.r_s = 1", "generator5.machine.r_s: the unit has generators 1 to 2"),
        (
            "machine.r_s = 0.005\ngovernor.Wf_min = 0.5",
            "governor.Wf_min: GovernorParameters: Wf_min",
        ),
    ],
)
def test_parameters_are_checked_where_they_are_read(given, message):
    """With the file and their place, as everything else; not when the scenario runs."""
    assert refusal(f"{GOOD}[parameters]\n{given}").startswith(f"mine.toml: parameters.{message}")


def test_parameters_of_another_unit_are_checked_in_it(tmp_path):
    """A count of the engine's own, and a wrong number in its file, told with both files."""
    path = tmp_path / "one.toml"
    path.write_text("[generator]\ncount = 1\n")
    text = GOOD.replace("duration", f"engine = '{path}'\nduration", 1)
    assert read(text).engine == str(path)
    second = text.replace("{ mu", "{ generator = 2, mu")
    assert "phase[2].fault: generator 2, but the unit has 1 to 1" in refusal(second)
    path.write_text("[generator.machine]\nr_z = 1\n")
    told = refusal(text)
    assert told.startswith(f"mine.toml: engine: {path}, [generator.machine]: unknown 'r_z' (did")


IMPLAUSIBLE = [
    (
        "N_ref_rpm = 3775",
        "phase[2].N_ref_rpm: N_ref_rpm = 3775 r/min is outside 14420 to 39655 r/min",
    ),
    ("N_ref_rpm = 3775", "Was rad/s meant? 3775 rad/s are 36049 r/min"),
    (
        "health = { f_eta_c = { from = 1.0, to = 0.7, over = 1.0 } }",
        "health.f_eta_c: f_eta_c = 0.7",
    ),
    (
        "health = { f_eta_c = { from = 1, to = 0.97, over = 1, after = 60 } }",
        "nothing of it happens",
    ),
    (
        'load = { kind = "R", power_kW = 0.225 }',
        "load.power_kW: power_kW = 0.225 kW is outside 0.45",
    ),
    ('load = [{kind="open"}, {kind="R", power_kW=500}]', "load[2].power_kW: power_kW = 500 kW"),
    ('load = { kind = "series", R_ohm = 0.7, L_mH = 200 }', "load: apparent power = 0.31"),
    (
        "fault = { mu = 0.05, k_rf = 2e9 }",
        "fault.k_rf: the severity h = mu/(k_rf + 1 - mu) is 2.5e-11",
    ),
    ("[noise]\nN = 3000", "noise.N: N = 3000 rad/s is outside 0 to 755"),
    ("[noise]\ngas = { T3 = 300 }", "noise.gas.T3: gas.T3 = 300 K is outside 0 to 113.6"),
    ("[noise]\nterminal = { sigma_v = 400 }", "noise.terminal.sigma_v: terminal.sigma_v = 400 V"),
    (
        "[parameters]\nmachine.r_s = 4.4",
        "parameters.machine.r_s: r_s = 4.4 ohm is outside 0.0001 to",
    ),
    ("[parameters]\nmachine.r_s = 0.2", "parameters.machine.r_s: 0.2 is 45.5 times the unit's own"),
    ("[parameters]\ncoupling.gear = 1.5", "2 pole pairs give 801.1 Hz, the rated frequency is 400"),
    ("[parameters]\ngenerator2.machine.n_pp = 2.5", "n_pp = 2.5: pole pairs are a whole number"),
]


@pytest.mark.parametrize(("given", "message"), IMPLAUSIBLE)
def test_what_is_possible_and_most_often_a_slip_is_told(tmp_path, given, message):
    path = tmp_path / "slip.toml"
    path.write_text(GOOD.replace("fault = { mu = 0.05, k_rf = 20.0 }", "") + given)
    with pytest.warns(ApuWarning) as told:
        s = registry.get(path)
    assert any(str(w.message).startswith(f"{path}: ") and message in str(w.message) for w in told)
    assert registry.implausible(s) == [str(w.message).removeprefix(f"{path}: ") for w in told]


def test_nothing_in_the_library_is_implausible():
    assert [registry.implausible(s) for s in registry.list_scenarios()] == [[]] * 12


def test_unknown_name_and_missing_file():
    with pytest.raises(ScenarioError, match=r"unknown scenario 'jont' \(did you mean 'joint'\?\)"):
        registry.get("jont")
    with pytest.raises(ScenarioError, match=r"none\.toml: .*cannot be read: No such file"):
        registry.get("none.toml")
    with pytest.raises(ScenarioError, match=r"ends in \.toml or \.py"):
        registry.get("folder/file.yaml")


def test_python_file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "from scenarios.schema import *\n"
        "scenario = Scenario('mine', 4.0, (Phase('a', 0.0, load={'kind': 'open'}),))\n"
    )
    assert registry.get(path).name == "mine"
    path.write_text("import tomllib\nscenario = tomllib.loads('''" + GOOD + "''')\n")
    assert registry.get(path) == read(GOOD)
    path.write_text("x = 1\n")
    with pytest.raises(ScenarioError, match=r"mine\.py: defines no 'scenario'"):
        registry.get(path)
    path.write_text("x = 1\ny = 1/0\n")
    with pytest.raises(ScenarioError, match=r"ZeroDivisionError at line 2"):
        registry.get(path)
    path.write_text("x = 1\nx = = 2\n")
    with pytest.raises(ScenarioError, match=r"SyntaxError at line 2"):
        registry.get(path)


def test_classes_check_as_files_do():
    with pytest.raises(
        ScenarioError, match=r"load: a Load, or a table with kind, is expected, got 225"
    ):
        Phase("a", 0.0, load=225.0)
    with pytest.raises(ScenarioError, match=r"must be > 0 s, got 0"):
        Change(0.0, fault="none")
    with pytest.raises(ScenarioError, match=r"k_rf: must be >= 0, got -1"):
        read_fault({"mu": 0.05, "k_rf": -1.0})
    with pytest.raises(ParameterError, match=r"k_rf = -1 must be >= 0"):
        Ttsc(0.05, -1.0)
    with pytest.raises(ScenarioError, match=r"has no 'wavform_dt' \(did you mean 'waveform_dt'"):
        registry.get("quiet").change(wavform_dt=None)


def test_events_are_checked():
    with pytest.raises(ScenarioError, match=r"HealthChange\.t: must be >= 0 s, got -1"):
        HealthChange(-1.0, {})
    with pytest.raises(ScenarioError, match=r"unknown 'f_eta_C' \(did you mean 'f_eta_c'"):
        HealthChange(1.0, {"f_eta_C": 1.0})
    with pytest.raises(ScenarioError, match=r"f_W_c: must lie in \(0\.5, 1\.5\], got 0\.5"):
        HealthChange(1.0, {"f_W_c": 0.5})
    with pytest.raises(ScenarioError, match=r"a load object .* expected, got 225000"):
        LoadChange(1.0, 225e3)
    with pytest.raises(ScenarioError, match=r"a Ttsc or None is expected, got 0\.05"):
        FaultChange(1.0, 0.05)
    with pytest.raises(ScenarioError, match=r"altitude: must lie in \[-1000, 15000\] m, got 40000"):
        Ambient(altitude=40e3)
    with pytest.raises(ScenarioError, match=r"t = 3 s is not before the end of the run at 2 s"):
        in_order([FaultChange(3.0, None)], 2.0)
    with pytest.raises(ScenarioError, match=r"second FaultChange at t = 1 s"):
        in_order([FaultChange(1.0, None), FaultChange(1.0, None)], 2.0)
    late, soon = FaultChange(1.5, None), HealthChange(0.5, {"f_W_c": 0.97})
    assert in_order([late, soon], 2.0) == (soon, late)
    assert pickle.loads(pickle.dumps(soon)) == soon
    assert issubclass(ScenarioError, ApuError)


def test_run_hands_everything_to_the_simulation(monkeypatch):
    """The unit and the simulation are stand-ins that record what they are given."""
    import numpy as np

    from apu_casadi.core import results

    seen = {}

    class Unit:
        machines = (None, None)

        def change(self, values):
            seen["parameters"] = values
            return self

    def simulate_joint(apu, **given):
        seen.update(given)
        given["progress"](0.1, 0.1)
        return results.dataset(
            {"time": np.array([0.0, 0.02])}, {"time": {"N": 3775.0}}, signals=RUN
        )

    multirate = types.ModuleType("apu_casadi.unit.multirate")
    multirate.simulate_joint = simulate_joint
    monkeypatch.setitem(sys.modules, "apu_casadi.unit.multirate", multirate)
    # units are kept between runs: this stand-in must not stay
    monkeypatch.setattr(units, "unit_of", units.unit_of.__wrapped__)
    engine = types.SimpleNamespace(unit=Unit(), assumed=())
    monkeypatch.setattr(units, "engine_file", lambda name: engine)
    monkeypatch.setattr(registry, "implausible", lambda s: [])
    ds = registry.run(
        "joint",
        waveform_dt=None,
        seed=3,
        parameters={"machine.r_s": 0.01},
        phasors=True,
        progress=lambda done, total: None,
    )
    assert seen["phasors"] is True
    assert seen["parameters"] == {"machine.r_s": 0.01}
    assert seen["duration"] == 14.0 and seen["dt"] == 0.02 and seen["waveform_dt"] is None
    assert seen["seed"] == 3 and seen["ambient"] == Ambient(dT_isa=5.0)
    assert len(seen["events"]) == 3
    assert registry.name_of(ds) == "joint"
    assert runsummary.phases(ds)[0]["name"] == "design point"
