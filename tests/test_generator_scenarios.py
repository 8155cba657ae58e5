"""Scenarios of generators that differ: what files say, and what summary and figures tell."""

import json
import pickle

import pytest

from apu_casadi import Apu, FaultChange, LoadChange, SeriesLoad, Ttsc
from apu_casadi.core.errors import ScenarioError
from apu_casadi.unit import runsummary
from scenarios import registry
from scenarios.campaigns import random_faults, run_campaign
from scenarios.commands import run as run_command
from scenarios.figures import plotting, runwords
from scenarios.fileschema import file_schema
from scenarios.reading import FaultOf
from scenarios.schema import Change, Phase, Scenario

KW100 = {"kind": "R", "power_kW": 100.0}
R_L = {"kind": "RL", "power_kW": 80.0, "power_factor": 0.85}
SHORT = {"mu": 0.05, "k_rf": 20.0, "phase": "c"}


def scenario(phase=None, first=None, **more):
    phases = [
        {"name": "healthy", "start": 0.0, "load": KW100, **(first or {})},
        {"name": "short circuit", "start": 0.1, **(phase or {"fault": {"generator": 2, **SHORT}})},
    ]
    head = {"name": "two", "duration": 0.3, "waveform_dt": 0}
    return Scenario.from_dict({**head, "phase": phases, **more})


def test_a_file_names_the_generator():
    s = scenario(
        event=[
            {"time": 0.15, "generator": 1, "load": R_L},
            {"time": 0.2, "generator": 2, "fault": "none"},
            {"time": 0.2, "fault": {"generator": 1, **SHORT}},
        ]
    )
    fault, r_l = Ttsc(0.05, 20.0, phase="c"), SeriesLoad.from_power(80e3, 0.85)
    assert s.events() == (
        FaultChange(0.1, fault, 2),
        LoadChange(0.15, r_l, 1),
        FaultChange(0.2, None, 2),
        FaultChange(0.2, fault, 1),
    )
    assert Scenario.from_dict(s.to_dict()) == s
    assert pickle.loads(pickle.dumps(s)) == s and hash(s) == hash(pickle.loads(pickle.dumps(s)))


def test_a_list_is_of_all_generators():
    faults = [{"generator": 2, **SHORT}, {"generator": 1, "kind": "none"}]
    s = scenario(first={"load": [KW100, R_L], "fault": faults}, phase={"load": [R_L, KW100]})
    start = s.start()
    assert [x.label for x in start["load"]] == ["100 kW", "80 kW, power factor 0.85"]
    assert start["fault"] == {1: None, 2: Ttsc(0.05, 20.0, phase="c")}
    assert [e.generator for e in s.events()] == [1, 2]
    assert Scenario.from_dict(s.to_dict()) == s


def test_python_takes_faults_by_number():
    fault = Ttsc(0.05, 20.0)
    assert Phase("a", 0.0, fault={2: fault}).fault == (FaultOf(2, fault),)
    assert Change(1.0, fault=[FaultOf(2, fault), FaultOf(1, None)]).fault[0] == FaultOf(1, None)


REFUSED = [
    (dict(fault=[{"generator": 1, **SHORT}] * 2), r"fault\[2\].generator: generator 1 has a fault"),
    (dict(fault=[SHORT]), r"fault\[1\].generator: missing: which generator"),
    (dict(fault=[{"genrator": 2, **SHORT}]), r"fault\[1\].genrator: unknown .* 'generator'"),
    (dict(fault=[]), "fault: an empty list"),
    (dict(fault={"generator": 3, **SHORT}), "fault: generator 3, but the unit has 1 to 2"),
    (dict(fault={"generator": 0, **SHORT}), r"fault.generator: the number of a generator, 1 to 4"),
    (dict(fault={"generator": 2, "mu": 0.05}), "fault.k_rf: missing"),
    (dict(fault={"generater": 2, **SHORT}), r"fault.generater: unknown key .*'generator'"),
    (dict(load=[KW100]), "load: 1 loads, but the unit has 2 generators"),
    (dict(load=[]), "load: 1 to 4 loads"),
    (dict(load={"generator": 2, **KW100}), r"load.generator: unknown key .*a list .*event"),
    (dict(load=[KW100, {"kind": "R", "power": 1.0}]), r"load\[2\].power: unknown key"),
]


@pytest.mark.parametrize(("phase", "words"), REFUSED)
def test_a_wrong_phase_is_refused_with_its_place(phase, words):
    with pytest.raises(ScenarioError, match=rf"phase\[2\].{words}"):
        scenario(phase)


@pytest.mark.parametrize(
    ("event", "words"),
    [
        ({"time": 0.1, "generator": 2, "fault": "none"}, "second change of fault of generator 2"),
        ({"time": 0.1, "fault": "none"}, "a second change of fault at"),
        ({"time": 0.2, "generator": 2}, "nothing changes then"),
        ({"time": 0.2, "generator": "2", "load": KW100}, "the number of a generator"),
        ({"time": 0.2, "generator": 2, "load": [KW100, KW100]}, "of several generators"),
        ({"time": 0.2, "generator": 2, "health": "none"}, "no generator has health"),
        ({"time": 0.2, "generator": 3, "load": KW100}, "generator 3, but the unit has 1 to 2"),
    ],
)
def test_a_wrong_event_is_refused_with_its_place(event, words):
    with pytest.raises(ScenarioError, match=rf"event\[1\].*{words}"):
        scenario(event=[event])


def test_as_many_loads_as_generators():
    s = scenario(parameters={"generator.count": 3}, first={"load": [KW100, R_L, KW100]})
    assert len(s.start()["load"]) == 3
    one = scenario(
        parameters={"generator": {"count": 1}}, first={"load": [KW100]}, phase={"fault": SHORT}
    )
    assert registry.unit_for(one) == Apu().change({"generator.count": 1})
    mixed = scenario(parameters={"generator2": {"machine": {"r_s": 0.005}, "neutral": "isolated"}})
    assert registry.unit_for(mixed).generators[1].neutral == "isolated"


def test_the_schema_of_files_knows_generators():
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft7Validator(file_schema())
    good = scenario(
        event=[{"time": 0.2, "generator": 1, "load": R_L}],
        parameters={"generator2.machine.r_s": 0.005, "generator3": {"neutral": "isolated"},
                    "generator.count": 3},
    ).to_dict()  # fmt: skip
    good["phase"][0]["load"] = [KW100, R_L, KW100]
    good["phase"][1]["fault"] = [{"generator": 2, **SHORT}, {"generator": 1, "kind": "none"}]
    assert not list(validator.iter_errors(good))
    for place, wrong in (
        (("phase", 1, "fault"), [SHORT]),
        (("phase", 1, "fault"), {"generator": 5, **SHORT}),
        (("phase", 0, "load"), []),
        (("event", 0, "generator"), 0),
        (("parameters",), {"generator2.machine.rs": 1.0}),
    ):
        bad = json.loads(json.dumps(good))
        at = bad
        for k in place[:-1]:
            at = at[k]
        at[place[-1]] = wrong
        assert list(validator.iter_errors(bad)), (place, wrong)


@pytest.fixture(scope="module")
def ds():
    s = scenario(event=[{"time": 0.2, "generator": 1, "load": R_L}])
    return registry.run(s)


def test_the_summary_tells_each_generator(ds):
    rows = registry.summary(ds)["phases"]
    assert "I_a_rms" not in rows[0] and "mu" not in rows[0]
    one, two = rows[1]["generators"]
    assert (one["generator"], two["generator"]) == (1, 2)
    assert one["mu"] == 0.0 and one["fault_phase"] is None
    assert two["mu"] == 0.05 and two["fault_phase"] == "c" and two["h"] == 0.05 / 20.95
    assert one["load"] == "80 kW, power factor 0.85" and two["load"] == "100 kW"
    assert two["P_loss_fault"] > 0 == one["P_loss_fault"]
    plain = registry.summary(registry.run(scenario(phase={"load": R_L})))["phases"]
    assert "generators" not in plain[0]
    assert set(plain[0]) == set(rows[0]) - {"generators"} | set(one) - {"generator"}


def test_the_table_of_the_command_tells_each_generator(ds):
    text = run_command.table(registry.summary(ds)["phases"])
    lines = text.splitlines()
    at = [i for i, line in enumerate(lines) if line.startswith("generator ")]
    assert len(at) == 2
    first, second = lines[at[0] : at[1]], lines[at[1] :]
    assert any("phase" in x and x.endswith("c") for x in second)
    assert not any("phase" in x and x.endswith("c") for x in first)
    assert any("power factor" in x for x in first)


def test_captions_tell_generator_and_phase(ds):
    note = runwords.severity_note(ds)
    assert note.startswith("TTSC of phase c of generator 2: µ = 5 %")
    told = runwords.made_with(ds)
    assert "Load of generator 1: 100 kW, then 80 kW, power factor 0.85;" in told
    assert "; of generator 2: 100 kW;" in told


@pytest.mark.long
def test_figures_draw_each_generator(ds, tmp_path):
    made = plotting.save_figures(ds, tmp_path)
    stems = [p.stem for p in made]
    assert stems[-4:] == [
        f"{k}_generator{n}" for k in ("fig24_currents", "fig25_voltages") for n in (1, 2)
    ]
    assert len(stems) == 8
    fig = plotting.figure_20(ds)
    ticks = [t.get_text() for ax in fig.axes for t in ax.get_yticklabels()]
    assert ticks == ["Load 1", "Load 2", "Gas path", "Stator 1", "Stator 2"]


@pytest.mark.long
def test_the_library_has_a_fault_in_one_machine():
    one, both = (registry.run(n, waveform_dt=None) for n in ("joint_one_machine", "joint"))
    a, b = (runsummary.phase_summary(x) for x in (one, both))
    asked = [rows[3]["PW_kW"] - rows[2]["PW_kW"] for rows in (a, b)]
    assert asked[0] == pytest.approx(asked[1] / 2, rel=1e-4)
    healthy = a[3]["generators"][0]
    assert healthy["I_a_rms"] == pytest.approx(a[2]["generators"][0]["I_a_rms"], rel=1e-6)
    before = both.time.values <= 10.0 + 1e-9
    assert (one.N.values[before] == both.N.values[before]).all()


def test_a_campaign_keeps_each_generator(tmp_path):
    """One run whose generators differ, and one whose generators are alike."""
    alike = scenario(phase={"fault": SHORT}, name="alike")
    runs = [scenario(), alike]
    made = run_campaign(runs, workers=1, out=tmp_path)
    assert made["status"].values.tolist() == [0, 0]
    assert made["mu"].dims == ("run", "phase", "generator")
    assert made["mu"].values[:, 1].tolist() == [[0.0, 0.05], [0.05, 0.05]]
    assert made["fault_phase"].values[:, 1].tolist() == [["-", "c"], ["c", "c"]]
    assert made["PW_kW"].dims == ("run", "phase")
    again = run_campaign(runs, workers=1, out=tmp_path)
    assert again.drop_vars("seconds").identical(made.drop_vars("seconds"))
    rows = runsummary.phase_summary(registry.run(runs[0], solver="propagator"))
    assert made["I_c_rms"].values[0, 1, 1] == rows[1]["generators"][1]["I_c_rms"]
    assert "generator" not in run_campaign([alike], workers=1).dims


def test_random_faults_stay_in_their_generator():
    drawn = random_faults(3, seed=1, base="joint_one_machine")
    faults = [s.phases[3].fault for s in drawn]
    assert all(len(f) == 1 and f[0].generator == 2 for f in faults)
    plain = random_faults(3, seed=1, base="joint")
    assert [f[0].fault for f in faults] == [s.phases[3].fault for s in plain]


def test_a_file_may_be_of_the_unit_that_is_named_beside_it(tmp_path):
    """A fault of the fourth generator, where --engine has four; none of the default unit's two."""
    (tmp_path / "four.toml").write_text("[generator]\ncount = 4\n")
    (tmp_path / "s.toml").write_text(
        'name = "s"\nduration = 0.1\n[[phase]]\nname = "p"\nstart = 0.0\n'
        'load = { kind = "R", power_kW = 50.0 }\n'
        'fault = { generator = 4, mu = 0.05, k_rf = 20.0, phase = "b" }\n'
    )
    (tmp_path / "s.py").write_text(
        "import tomllib, pathlib\n"
        "scenario = tomllib.loads((pathlib.Path(__file__).parent / 's.toml').read_text())\n"
    )
    engine = str(tmp_path / "four.toml")
    for name in ("s.toml", "s.py"):
        s = registry.get(tmp_path / name, engine=engine)
        assert len(registry.unit_for(s).machines) == 4
        with pytest.raises(ScenarioError, match="generator 4, but the unit has 1 to 2"):
            registry.get(tmp_path / name)
    assert registry.get("quiet", engine=engine).engine == engine
