"""A unit is one file: with units and sources, shipped by name, taken by every command."""

import dataclasses
import json

import numpy as np
import pytest

from apu_casadi.core import backend, results
from apu_casadi.core.errors import ApuError, ApuWarning, DataError, ParameterError, ScenarioError
from apu_casadi.gaspath.steady.steadypoint import LIMIT_UNITS, Limits
from apu_casadi.gaspath.steady.trimbatch import performance_deck
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import magnetics
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.enginefile import GAS, Engine, read_unit, write_unit
from apu_casadi.unit.events import FaultChange, HealthChange, LoadChange
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.shippedunits import shipped_units, titles, unit_path
from apu_casadi.unit.usual import USUAL, unusual
from estimators.apu import fitting, identify
from scenarios import campaigns, registry
from scenarios.cli import main
from scenarios.schema import Scenario

HP = 745.6998715823  # W
RUN = """
name = "short"
duration = 0.3
waveform_dt = 0
engine = "tpe331"
[[phase]]
name = "healthy"
start = 0.0
load = { kind = "R", power_kW = 150.0 }
[[phase]]
name = "ill"
start = 0.1
health = { f_eta_c = 0.99 }
[[phase]]
name = "shorted"
start = 0.2
fault = { mu = 0.01, k_rf = 20.0 }
"""


@pytest.fixture(scope="module")
def tpe():
    return read_unit("tpe331")


@pytest.fixture
def work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.toml").write_text(RUN)
    return tmp_path


# ------------------------------------------------------------------------------ reading, writing


def test_the_default_unit_is_a_file_of_its_own(tmp_path):
    """Bit by bit the unit without a file; nothing in it is assumed; the file is what is written."""
    e = read_unit("aps5000")
    assert e.unit == Apu() and e.assumed == ()
    assert next(iter(shipped_units())) == e.name == "aps5000"
    assert dataclasses.replace(e.limits, T4_max=None) == Limits()
    write_unit(e, tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_text() == shipped_units()["aps5000"].read_text()
    assert e.sources["machine.r_s"] == "paper, Table 1"
    for part, p in e.unit.parameter_sets().items():
        assert all(f"{part}.{name}" in e.sources for name, *_ in p.table()), part


def test_any_unit_comes_back_from_its_file(tmp_path, tpe):
    """Every set changed, a map of its own, limits and sources; bit by bit."""
    default = Apu()
    changes = {
        k: v * (1 + 1e-3 / 7)
        for k, v in default.parameters().items()
        if isinstance(v, float) and k.startswith(("machine.", "exciter.T", "governor.", "coupl"))
    }
    changes = {k: min(v, 1.0) if "eta" in k else v for k, v in changes.items()}
    words = {"generator.neutral": "isolated", "generator.power": "torque"}
    unit = default.change({**changes, **words, "gas_generator.eta_c": 0.84})
    gg = unit.gas_generator
    own = dataclasses.replace(gg.compressor_map.table, name="own")
    choice = dataclasses.replace(gg.compressor_map, table=own)
    unit = dataclasses.replace(unit, gas_generator=dataclasses.replace(gg, compressor_map=choice))
    e = Engine("mine", "A unit", "several\nlines", unit, Limits(T4_max=1400.0, T5_max=1000.0))
    for made in (dataclasses.replace(e, sources={"machine.r_s": 'bench, "hot"'}), tpe):
        path = tmp_path / f"{made.name}.toml"
        write_unit(made, path)
        back = read_unit(path)
        assert back.unit == made.unit and back.limits == made.limits and back.assumed == ()
        assert (back.name, back.title, back.doc) == (made.name, made.title, made.doc)
        assert dict(made.sources).items() <= dict(back.sources).items()
    assert (tmp_path / "mine-compressor.csv").exists()


@pytest.mark.parametrize("first", [True, False])
def test_a_saturating_generator_is_kept(tmp_path, first):
    """Beside one that is linear, in either place; what is not given of it is assumed."""
    gen = Apu().generator
    other = dataclasses.replace(gen, machine=magnetics(gen.machine, 0.08, 0.25))
    unit = Apu().with_generators(*((other, gen) if first else (gen, other)))
    write_unit(unit, tmp_path / "s.toml")
    assert read_unit(tmp_path / "s.toml").unit == unit
    (tmp_path / "t.toml").write_text("[generator.machine]\nS_10 = 0.15")
    back = read_unit(tmp_path / "t.toml")
    assert back.unit.generator.machine == magnetics(gen.machine, 0.15, None)
    assert "machine.S_12" in {a.name for a in back.assumed}
    (tmp_path / "t.toml").write_text("[generator.machine]\nS_10 = 0.3")
    with pytest.raises(ParameterError, match=r"t\.toml.*S_12 = 0\.3 must be > 1\.2 S_10"):
        read_unit(tmp_path / "t.toml")


def test_units_are_converted_and_the_rest_is_assumed(tmp_path):
    """Each left-out number is listed once with value, unit and source; maps too."""
    path = tmp_path / "part.toml"
    path.write_text("""
[gas_generator]
N = { value = 36050, unit = "r/min", source = "plate" }
T4 = { value = 930.0, unit = "degC" }
dT_isa = { value = 9, unit = "degF" }
LHV = { value = 43.0, unit = "MJ/kg" }
[generator]
neutral = "isolated"
machine = { r_s = { value = 5.1, unit = "mohm" }, L_ls = { value = 19.8, unit = "uH" } }
[governor]
Wf_max = { value = 230.0, unit = "kg/h" }
[limits]
T5_max = { value = 700.0, unit = "degC" }
""")
    e = read_unit(path)
    p, m = e.unit.gas_generator.parameters, e.unit.generator.machine
    assert pytest.approx(36050 * np.pi / 30, rel=1e-15) == p.N and pytest.approx(1203.15) == p.T4
    assert (p.dT_isa, p.LHV) == (pytest.approx(5.0), 43e6)
    assert (m.r_s, m.L_ls) == (pytest.approx(5.1e-3), pytest.approx(19.8e-6))
    assert e.unit.governor.Wf_max == pytest.approx(230 / 3600) and e.limits.T5_max == 973.15
    assert e.unit.generator.neutral == "isolated" and e.sources == {"gas_generator.N": "plate"}
    names = [a.name for a in e.assumed]
    assert len(set(names)) == len(names)
    told = {"gas_generator.N", "machine.r_s", "governor.Wf_max", "generator.neutral"}
    assert not told & set(names) and "limits.T5_max" not in names
    by_name = {a.name: a for a in e.assumed}
    assert by_name["machine.L_md"][1:] == (0.221e-3, "H", "default unit: paper, Table 1")
    assert by_name["compressor_map.map"].value == "AXI5 at N = 1, beta = 2"
    gas = {a.name.split(".")[0] for a in e.assumed_for(GAS)}
    assert gas == {"gas_generator", "compressor_map", "turbine_map", "limits"}


def test_several_generators(tmp_path, capsys, monkeypatch):
    """One table for all, or one for each: a further one is the first but for what it says."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "several.toml"
    path.write_text("[generator]\ncount = 3\nneutral = 'isolated'\n")
    three = read_unit(path)
    assert three.unit == Apu().change({"generator.count": 3, "generator.neutral": "isolated"})
    assert "generator.count" not in {a.name for a in three.assumed}
    path.write_text("""
[coupling]
eta_gtSg = 0.99
[[generator]]
[generator.machine]
r_s = 0.005
[[generator]]
neutral = "isolated"
machine.P_rated = { value = 60, unit = "kW", source = "plate" }
[generator.coupling]
gear = 3.2
""")
    two = read_unit(path)
    a, b = two.unit.machines
    assert (a.generator.machine.r_s, b.generator.machine.r_s) == (0.005, 0.005)
    assert (a.generator.machine.P_rated, b.generator.machine.P_rated) == (225e3, 60e3)
    assert (a.generator.neutral, b.generator.neutral) == ("grounded", "isolated")
    assert (a.coupling.eta_gtSg, b.coupling.eta_gtSg, b.coupling.gear) == (0.99, 0.99, 3.2)
    assert two.sources == {"generator2.machine.P_rated": "plate"}
    assert not {"machine.r_s", "coupling.eta_gtSg"} & {n.name for n in two.assumed}
    again = tmp_path / "again.toml"
    for e in (three, two):
        write_unit(e, again)
        assert read_unit(again).unit == e.unit and read_unit(again).assumed == ()
    assert main(["trim", "--engine", str(again), "--load", "50e3", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    one, other = report["generators"]
    assert report["generator"] == one and one["P_total"] != other["P_total"]
    assert main(["estimate", "joint", "--engine", str(again), "--scenario", "quiet"]) == 2
    said = capsys.readouterr().err
    assert "the joint estimation needs equal generators; these differ: ['generator2." in said
    path.write_text("[[generator]]\n")
    assert len(read_unit(path).unit.machines) == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "# nothing",
            r"engine\.toml: empty: an engine has at least one of the tables gas_generator",
        ),
        ("[governer]\nKp = 1", r"unknown 'governer' \(did you mean 'governor'\?\)"),
        ("[governor]\nKP = 1", r"\[governor\]: unknown 'KP' \(did you mean 'Kp'\?\)"),
        ("[governor]\nkind = 'PIX'", r"\[governor\]: unknown kind 'PIX' .*'PI'"),
        ("[governor]\nKp = -1", r"\[governor\]: .*Kp \[kg/s\] = -1 is outside \[0, inf\]"),
        ("[governor]\nWf_max = 0.001", r"\[governor\]: .*Wf_min = 0.01 must be below"),
        ("[generator.machine]\nr_S = 1", r"\[generator.machine\]: unknown 'r_S' .*'r_s'"),
        ("[generator.machin]\nr_s = 1", r"\[generator\]: unknown 'machin' .*'machine'"),
        ("[generator.exciter]\nK_A = 'high'", r"\[generator.exciter\]: .*K_A \[1\].*number"),
        ("[generator]\nneutral = 'open'", r"\[generator\]: neutral = 'open' .*isolated"),
        ("[generator]\npower = 'torq'", r"\[generator\]: power = 'torq' \(did you mean 'torque'"),
        ("[generator]\nexcitation = 1", r"\[generator\]: excitation = 1 .*regulated"),
        ("generator = 3", r"\[generator\]: a table is expected, got 3"),
        ("[generator]\ncount = 5", r"\[generator\]: count = 5; a unit has 1 to 4 generators"),
        ("[generator]\ncount = 2.0", r"\[generator\]: count = 2\.0; a unit has"),
        ("generator = []", r"no \[\[generator\]\]; a unit has 1 to 4"),
        (5 * "[[generator]]\n", r"\[\[generator\]\] 5: count = 1; a unit has 1 to 4"),
        ("[[generator]]\n[generator.machine]\nr = 1", r"\[\[generator.machine\]\] 1: unknown 'r'"),
        ("[coupling]\ngear = 0.0", r"\[coupling\]: .*gear \[1\] = 0 is outside"),
        ("[coupling]\neta_gt = 1.0", r"\[coupling\]: unknown 'eta_gt' .*eta_gtSg"),
        ("[limits]\nT4max = 1", r"\[limits\]: unknown 'T4max' .*T4_max"),
        ("[limits]\nT4_max = 'x'", r"\[limits\]: limit T4_max.*number"),
        ("[limits]\nSM_min = 20", r"\[limits\]: limit SM_min must lie in \[-inf, 1\], got 20"),
        ("[limits]\nT4_max = -5", r"\[limits\]: limit T4_max must lie in \[250, inf\], got -5"),
        ("[gas_generator]\nW2 = { value = 3, unit = 'kg' }", r"W2.unit: unknown unit 'kg' .*kg/s"),
        ("[gas_generator]\nW2 = { value = 3, unit = 'K' }", r"W2.unit: a unit of kg/s is expect"),
        ("[gas_generator]\nW2 = { val = 3 }", r"W2: unknown 'val' .*value"),
        ("[gas_generator]\nW2 = { unit = 'kg/s' }", r"W2: give value = "),
        ("[gas_generator]\nW2 = { value = 3, source = 4 }", r"W2: source must be a text, got 4"),
        ("title = 3", r"title must be a text, got 3"),
        ("[compressor_map]\nfile = 'no.csv'", r"no\.csv: cannot read the map file"),
    ],
)
def test_mistakes_are_told_with_their_place(tmp_path, text, words):
    """File, table, name, unit, range and the nearest name."""
    path = tmp_path / "engine.toml"
    path.write_text(text)
    with pytest.raises(ApuError, match=words) as e:
        read_unit(path)
    assert str(tmp_path) in str(e.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[gas_generator]\nN = 36050", "[gas_generator]: N = 36050 rad/s is outside 300 to 20000"),
        ("[generator.machine]\nr_s = 4.4", "[machine]: r_s = 4.4 ohm is outside 0.0001 to 1 ohm"),
        ("[governor]\nWf_max = 240", "[governor]: Wf_max = 240 kg/s is outside 0.001 to 2 kg/s"),
        (
            "[coupling]\ngear = 1.5",
            "[coupling]: the governed speed of 3775.15 rad/s, gear 1.5 and 2",
        ),
        ("[limits]\nT4_max = 3000", "[limits]: T4_max = 3000 K is outside 900 to 2300 K"),
    ],
)
def test_what_is_most_often_a_slip_is_told(tmp_path, text, words):
    """A wrong unit: taken, with a warning that has file, table, value and usual range."""
    path = tmp_path / "slip.toml"
    path.write_text(text)
    with pytest.warns(ApuWarning) as told:
        read_unit(path)
    assert any(str(w.message).startswith(f"{path}, {words}") for w in told)


def test_every_number_has_a_usual_range_or_a_narrow_one():
    """And the default unit is within all of them."""
    apu = Apu()
    for part, p in apu.parameter_sets().items():
        for f in dataclasses.fields(p):
            lo, hi = USUAL.get(f"{part}.{f.name}", (f.metadata.get("lo"), f.metadata.get("hi")))
            assert lo is None or np.isfinite([lo, hi]).all(), f.name
    assert set(n for n in USUAL if n.startswith("limits.")) == {f"limits.{n}" for n in LIMIT_UNITS}
    assert set(USUAL) - {f"limits.{n}" for n in LIMIT_UNITS} <= set(apu.parameters())
    assert list(unusual(apu, USUAL, Limits())) == []


def test_names_of_shipped_units(work):
    """A word is a name unless a file of that name is there; a wrong one has a nearest."""
    with pytest.raises(DataError, match=r"engine 'tpe33': .* no unit of this name .*'tpe331'"):
        read_unit("tpe33")
    with pytest.raises(DataError, match=r"tpe33\.toml: engine file cannot be read"):
        read_unit("tpe33.toml")
    assert unit_path("tpe331") == shipped_units()["tpe331"]
    (work / "tpe331").write_text("")
    assert unit_path("tpe331").name == "tpe331" != shipped_units()["tpe331"].name
    assert "TPE331-10" in titles()["tpe331"]


# ------------------------------------------------------------------------------ the second unit


def test_figures_that_were_not_put_in_are_predicted(tpe):
    """1000 shp was put in by way of T4.  Fuel per power within 4 % of the two figures found, burner
    exit temperature within 2 % of what a public model of the larger sister takes as its highest."""
    gg = tpe.unit.gas_generator
    p, v = gg.parameters, gg.design.values
    assert v["PW"] == pytest.approx(1000 * HP, rel=2e-3)
    assert (p.PR_c, p.W2, p.N * 30 / np.pi) == (10.55, 3.49, pytest.approx(41730))
    sfc = 3.6e6 * v["Wf"] / v["PW"]  # kg/(kW h)
    assert sfc == pytest.approx(0.32, rel=0.04)
    assert sfc == pytest.approx(0.50 * 0.45359237 / (HP / 1e3), rel=0.04)
    assert pytest.approx(1320.0, rel=0.02) == p.T4
    rated = trim_gas_generator(gg, {"N": p.N, "PW": 940 * HP}, dT_isa=0.0)
    assert rated["T4"] < p.T4 and rated["SM"] > 0.15
    for name in ("W2", "PR_c", "N", "T4", "eta_c"):
        assert tpe.sources[f"gas_generator.{name}"]
    assert {a.name.split(".")[0] for a in tpe.assumed} >= {"machine", "exciter", "limits"}


@pytest.mark.long
@pytest.mark.compiled
def test_the_second_unit_compiles_nothing(tpe, monkeypatch):
    """Trim, deck and a joint run with load step and both faults, on what the default unit made."""

    def use(unit):
        load = SeriesLoad.from_power(100e3)
        point = unit.steady_state(load)
        deck = performance_deck(unit.gas_generator, altitude=[0, 4000], PW=[2e5, 3e5])
        events = [
            LoadChange(0.2, SeriesLoad.from_power(150e3)),
            HealthChange(0.6, {"f_eta_c": 0.98}),
            FaultChange(1.0, Ttsc(0.05, 20.0)),
        ]
        ds = simulate_joint(unit, duration=1.6, load=load, events=events, waveform_dt=None)
        return point, deck, ds

    for _ in range(6):  # single steps are compiled when they have been called 50 times
        use(Apu())
    monkeypatch.setattr(backend, "_compile", None)
    point, deck, ds = use(tpe.unit)
    assert (deck["status"].values == 0).all()
    assert deck["Wf"].values[0, 0, 0, 0] > deck["Wf"].values[1, 0, 0, 0] > 0
    g, N = point.gas, ds["N"].values * 30 / np.pi
    # eq. (1): twice a generator's power over both efficiencies
    assert g["PW"] == pytest.approx(2 * 230**2 / (3 * 230**2 / 100e3) * 3 / 0.9, rel=3e-2)
    assert N[0] == pytest.approx(41730) and 0.97 * 41730 < N.min() < 41700
    t = ds["time"].values
    before, after = (float(ds["PW"].values[np.searchsorted(t, s) - 1]) for s in (1.0, 1.6))
    assert after > 1.05 * before  # both generators are shorted
    assert float(ds["T4"].values[-1]) > g["T4"]


def test_its_faults_are_estimated(tpe):
    """Health factors from its own steady points; 500 kW is no design point of this engine."""
    gg = tpe.unit.gas_generator
    truth = np.array([0.98, 0.99, 1.0, 0.985])
    fit = fitting.fit_engine([fitting.steady_truth(gg, truth)], gg=gg, steady=True)
    assert fit.result.estimate == pytest.approx(truth, abs=1e-6)
    assert identify.condition("design", gg)["PW"] == gg.rated_power == 746e3
    assert identify.condition("design", Apu().gas_generator)["PW"] == 500e3
    point = identify.steady_point("design", gg)
    assert point["T4"] == pytest.approx(gg.parameters.T4, rel=0.02)  # a day 5 K hotter


# ------------------------------------------------------------------------------ commands


@pytest.mark.long
def test_every_command_takes_a_unit(work, capsys, tpe):
    """Each runs with the shipped unit and tells once, on stderr or in JSON, what is assumed."""
    gg = tpe.unit.gas_generator
    points = fitting.steady_truth(gg, np.ones(4))
    names = ("N", "P3", "T3", "T5", "Wf", "PW")
    rows = zip(*(points.readings[n] for n in names), strict=True)
    header = "N [rad/s],P3 [Pa],T3 [K],T5 [K],Wf [kg/s],PW [W]"
    text = "\n".join([header, *(",".join(map(repr, map(float, r))) for r in rows)])
    (work / "data.csv").write_text(text + "\n")
    at = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": 5e5})
    bench = [f"b,fixed,N,{at['N']!r},", "b,fixed,PW,5e5,", f"b,measured,W2,{at['W2']!r},0.01"]
    (work / "bench.csv").write_text("\n".join(["point,role,name,value,sigma", *bench]) + "\n")
    commands = {
        "trim --power 5e5 --json": None,
        "trim --load 2e5 --json": None,
        "trim --load 2e5 --voltage 230 --json": None,
        "deck --altitude 0 --mach 0 --json": None,
        "linearise --no-figures --json": None,
        "identify --json": None,
        "calibrate bench.csv --free compressor_map.a_W --json --write-engine mine.toml": None,
        "fit data.csv --steady --altitude 0 --json": None,
        "run short.toml --no-figures --json": None,
        "campaign --base short.toml --runs 1 --workers 1 --json": None,
        "maps --no-lines": "stderr",
        "export c gas_generator.step --out c --json": None,
        "export fmu gas_generator --no-library --out g.fmu --json": None,
    }
    for command, where in commands.items():
        assert main([*command.split(), "--engine", "tpe331"]) == 0, command
        out, err = capsys.readouterr()
        if where:
            assert err.count("assumed, since tpe331 does not give it:") == 1, command
            continue
        report = json.loads(out)
        told = report.get("assumed_engine") or json.loads(report["assumed"]["assumed_engine"])
        by_name = {r["name"]: r for r in told}
        assert len(by_name) == len(told) and set(told[0]) == {"name", "value", "unit", "source"}
        alone = command.startswith(("deck", "fit", "calibrate", "trim --power"))
        assert ("machine.r_s" in by_name) != alone, command
        assert ("gas_generator.LHV" in by_name) == ("--voltage" not in command), command
        assert "APS5000" not in out and "36050" not in out
    assert (
        main(["run", "short.toml", "--no-figures", "--quiet", "--out", ".", "--solver", "cvodes"])
        == 0
    )
    capsys.readouterr()
    assert main(["fit", "short.nc", "--estimate", "f_eta_c", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["read_as"]
    assert "short.nc is a run of tpe331: give --engine tpe331" in said
    mine = read_unit("mine.toml")
    assert mine.sources["compressor_map.a_W"] == "fitted to bench.csv (apu calibrate)"
    assert mine.unit.parameters()["compressor_map.a_W"] == pytest.approx(0.0, abs=1e-6)
    assert mine.sources["gas_generator.W2"] == "[1]" and mine.assumed == ()
    deck = results.load("deck.nc")
    assert float(deck["PW"].values[-1]) == 746e3 and deck.attrs["engine"] == "tpe331"
    assert main(["trim", "--engine", "tpe331", "--power", "5e5"]) == 0
    out, err = capsys.readouterr()
    assert err.count("gas_generator.LHV") == 1 and "machine" not in err
    assert "4.3124e+07 J/kg (default unit: Table 3)" in err and "tpe331" in out
    assert main(["calibrate", "--engine", "tpe331"]) == 2
    assert "the published points are those of the default unit" in capsys.readouterr().err


@pytest.mark.long
def test_estimate_takes_a_unit(work, capsys):
    (work / "still.toml").write_text(RUN.partition('[[phase]]\nname = "ill"')[0])
    assert main(["estimate", "joint", "--scenario", "still.toml", "--json", "--figures"]) == 0
    report = json.loads(capsys.readouterr().out)
    value = report["phases"][0]["values"]["N"]
    assert value["true"] == pytest.approx(41730 * np.pi / 30, rel=1e-3)
    assert abs(value["estimate"] - value["true"]) < 4 * value["half_width"]
    assert {r["name"] for r in report["assumed_engine"]} >= {"machine.r_s", "gas_generator.LHV"}


def test_a_scenario_names_its_unit(work, tpe, monkeypatch):
    """By name, or by a file seen from the scenario's; parameters of its own are not assumed."""
    s = registry.get(work / "short.toml")
    assert s.engine == "tpe331" and Scenario.from_dict(s.to_dict()) == s
    assert registry.unit_for(s) == tpe.unit
    mine = s.change(parameters={"machine.r_s": 0.005})
    assert "machine.r_s" not in {r["name"] for r in registry.assumed(mine)}
    (work / "sub").mkdir()
    write_unit(tpe, work / "sub" / "own.toml")
    (work / "sub" / "case.toml").write_text(RUN.replace('"tpe331"', '"own.toml"'))
    monkeypatch.chdir("/")
    own = registry.get(work / "sub" / "case.toml")
    assert own.engine == str(work / "sub" / "own.toml") and registry.assumed(own) == []
    assert registry.unit_for(own) == tpe.unit
    keys = [campaigns._task(x, "propagator", None).key for x in (s, own)]
    assert keys[0] != keys[1]
    with pytest.raises(DataError, match=r"engine 'tpe33': .*'tpe331'"):
        registry.engine_file("tpe33")
    with pytest.raises(ScenarioError, match=r"engine: engine 'tpe33': .*'tpe331'"):
        s.change(engine="tpe33")


def test_list_shows_the_units(capsys):
    assert main(["list"]) == 0
    assert "\nunits, for --engine NAME:\naps5000  APS5000-like" in capsys.readouterr().out
    assert main(["list", "--engines", "--json"]) == 0
    assert [r["name"] for r in json.loads(capsys.readouterr().out)][:2] == ["aps5000", "tpe331"]
    assert main(["list", "--engine", "tpe331"]) == 0
    assert capsys.readouterr().out == shipped_units()["tpe331"].read_text()
