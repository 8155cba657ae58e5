"""One table of ambient conditions: the default day and the ranges, everywhere the same."""

import ast
import inspect
import json
import re
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from apu_casadi import Ambient, Apu, GasGenerator, trim, trim_batch
from apu_casadi.core.errors import ApuError
from apu_casadi.core.results import save
from apu_casadi.gaspath.conditions import (
    AMBIENT,
    CONDITIONS,
    DEFAULT_DAY,
    RANGES,
    assumed_words,
    day_words,
)
from apu_casadi.gaspath.designdata import GasGeneratorParameters
from apu_casadi.gaspath.steady.steadypoint import Limits, Status
from apu_casadi.gaspath.steady.trimbatch import performance_deck
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.recordings.runfiles import recorded_ambient
from scenarios import cli
from scenarios.schema import Scenario

ROOT = Path(find_spec("apu_casadi").origin).parents[1]
OPTIONS = {"altitude": "--altitude", "Mach": "--mach", "dT_isa": "--disa", "war": "--war"}
# readings of a fit: the accuracy of the trims and of the run, not of sensors
EXACT = 1e-5


@pytest.fixture(scope="module")
def apu():
    return Apu()


# ------------------------------------------------------------------------------ one default


def test_the_day_is_the_papers_and_every_default_is_it(apu):
    """Table 3: sea level, ISA + 5 K.  Runs, engine, trims, batches and decks take this day."""
    assert dict(DEFAULT_DAY) == {"altitude": 0.0, "Mach": 0.0, "dT_isa": 5.0, "war": 0.0}
    gg = apu.gas_generator
    for n, v in DEFAULT_DAY.items():
        assert gg.U[n].default == v == getattr(Ambient(), n) == getattr(gg.parameters, n)
    assert gg.U.names[2:] == AMBIENT == tuple(CONDITIONS)
    fixed = {"N": apu.N_ref, "PW": 3e5}
    point = trim(gg, fixed)
    assert dict(zip(AMBIENT, point.u[2:].tolist(), strict=True)) == dict(DEFAULT_DAY)
    explicit = trim(gg, fixed, **DEFAULT_DAY)
    assert explicit["T4"] == point["T4"]
    assert trim_batch(gg, fixed)["T4"] == pytest.approx(point["T4"], rel=1e-9)
    deck = performance_deck(gg, PW=[3e5])
    assert float(deck["dT_isa"][0]) == DEFAULT_DAY["dT_isa"]
    assert float(deck["T4"].squeeze()) == pytest.approx(point["T4"], rel=1e-9)
    joint = apu.steady_state(SeriesLoad.from_power(100e3))
    assert dict(zip(AMBIENT, joint.gas.u[2:].tolist(), strict=True)) == dict(DEFAULT_DAY)


def test_commands_take_the_same_day_and_say_so(capsys, tmp_path):
    """Trim, linearise and deck without options: the default day, printed as assumed."""
    assert cli.main(["trim", "--power", "3e5", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {n: report["inputs"][n] for n in AMBIENT} == dict(DEFAULT_DAY)
    assert report["assumed"] == list(AMBIENT)
    assert cli.main(["trim", "--power", "3e5", "--disa", "20"]) == 0
    text = capsys.readouterr().out
    assert "ISA + 20 K" in text and "assumed: altitude = 0 m, Mach = 0, war = 0 kg/kg" in text
    assert cli.main(["linearise", "--model", "gas", "--no-figures"]) == 0
    text = capsys.readouterr().out
    assert f"ambient: {day_words()}" in text and assumed_words({}) in text
    deck = tmp_path / "deck.nc"
    argv = ["deck", "--altitude", "0", "--mach", "0", "--power", "3e5", "--out", str(deck)]
    assert cli.main([*argv, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["axes"]["dT_isa"] == [DEFAULT_DAY["dT_isa"]]
    assert report["assumed"]["war"] == DEFAULT_DAY["war"]


NAMES = {"altitude", "mach", "dt_isa", "disa", "war", "humidity"}


def _number(node):
    """Whether a node is a number, or a list or tuple of one."""
    if isinstance(node, ast.Tuple | ast.List):
        return len(node.elts) == 1 and _number(node.elts[0])
    if isinstance(node, ast.UnaryOp):
        return _number(node.operand)
    return isinstance(node, ast.Constant) and not isinstance(node.value, bool | str | None)


def _default_day(given):
    """Whether names with their nodes give the default day's deviation, and no other condition."""
    if {k for k in given if k.lower() in NAMES} != {"dT_isa"} or not _number(given["dT_isa"]):
        return False
    return ast.literal_eval(given["dT_isa"]) == DEFAULT_DAY["dT_isa"]


# what is no default day: the standard atmosphere itself, and the properties of a dry gas
ELSEWHERE = {
    "apu_casadi/gaspath/atmosphere.py: argument dT_isa",
    "apu_casadi/gaspath/gas.py: argument war",
}


def written_elsewhere(text):
    """Return (line, what) of each default of a condition in a module: arguments, fields, options.

    Complete conditions of a named point (Table 5) are no default: a call or a table that gives an
    altitude as well may give numbers.
    """
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            a = node.args
            pairs = list(zip([*a.posonlyargs, *a.args][::-1], a.defaults[::-1], strict=False))
            pairs += [(k, d) for k, d in zip(a.kwonlyargs, a.kw_defaults, strict=True) if d]
            found += [
                (node.lineno, f"argument {k.arg}")
                for k, d in pairs if k.arg.lower() in NAMES and _number(d)
            ]  # fmt: skip
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            targets = [node.target] if isinstance(node, ast.AnnAssign) else node.targets
            for t in targets:
                named = isinstance(t, ast.Name) and t.id.lower() in NAMES
                if named and node.value is not None and _number(node.value):
                    found.append((node.lineno, f"value {t.id}"))
        elif isinstance(node, ast.Call):
            words = [x.value for x in node.args if isinstance(x, ast.Constant)]
            named = any(isinstance(w, str) and w.lstrip("-").lower() in NAMES for w in words)
            given = {k.arg: k.value for k in node.keywords if k.arg}
            default = given.get("default")
            if named and default is not None and (
                _number(default) or (isinstance(default, ast.Constant)
                                     and re.fullmatch(r"[-+.\d]+", str(default.value)))
            ):  # fmt: skip
                found.append((node.lineno, f"default of {words[0]}"))
            if _default_day(given):
                found.append((node.lineno, "dT_isa of the default day, written out"))
        elif isinstance(node, ast.Dict):
            pairs = zip(node.keys, node.values, strict=True)
            if _default_day({str(k.value): v for k, v in pairs if isinstance(k, ast.Constant)}):
                found.append((node.lineno, "dT_isa of the default day, written out"))
    return found


@pytest.mark.long
def test_no_default_is_written_elsewhere():
    """Every argument, field, option and table takes its default from ``gaspath/conditions.py``."""
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {what}"
        for package in ("apu_casadi", "estimators", "scenarios")
        for path in sorted((ROOT / package).rglob("*.py"))
        if path.name != "conditions.py"
        for line, what in written_elsewhere(path.read_text(encoding="utf-8"))
        if f"{path.relative_to(ROOT).as_posix()}: {what}" not in ELSEWHERE
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "text",
    [
        "def f(*, dT_isa=0.0): pass",
        "def f(altitude=0.0, n=1): pass",
        "def f(Mach=(0.0,)): pass",
        "class A:\n    war: float = 0.0",
        "p.add_argument('--disa', type=float, default=0.0)",
        "p.add_argument('--disa', default='0')",
        "Signal('Mach', '1', 'x', default=0.0)",
        "trim_gas_generator(gg, fixed, dT_isa=5.0)",
        "given = {'PW': 1.0, 'dT_isa': 5.0} | more",
    ],
)
def test_the_search_finds_what_it_looks_for(text):
    assert written_elsewhere(text)
    # the named point of Table 5 is no default
    assert not written_elsewhere("trim(gg, f, altitude=8000.0, Mach=0.7, dT_isa=5.0)")


# ------------------------------------------------------------------------------ a healthy run


@pytest.fixture(scope="module")
def healthy(apu, tmp_path_factory):
    """A load step of a healthy unit with all defaults, saved as a run file, and as bare columns."""
    from apu_casadi import LoadChange

    folder = tmp_path_factory.mktemp("healthy")
    ds = simulate_joint(
        apu, duration=0.9, load=SeriesLoad.from_power(150e3), waveform_dt=None,
        events=[LoadChange(0.4, SeriesLoad.from_power(120e3))], solver="propagator",
    )  # fmt: skip
    names = ("N", "P3", "T3", "T5", "Wf", "PW")
    # the fuel of a stored instant is that of the step before; of steady rows both are the same
    rows = np.flatnonzero((ds["time"] < 0.39) & (ds["time"] > 0))
    csv = folder / "bench.csv"
    lines = [",".join(names)]
    lines += [",".join(repr(float(ds[n][k])) for n in names) for k in rows]
    csv.write_text("\n".join(lines), encoding="utf-8")
    return save(ds, folder / "run.nc"), csv, ds


@pytest.mark.long
@pytest.mark.parametrize("file", ["run.nc", "bench.csv"])
def test_fitting_a_healthy_run_with_all_defaults_finds_it_healthy(healthy, file, capsys):
    """0.958 was found for f_eta_c, the day of the fit being 5 K colder than that of the run.

    The run's steady part is exact to the trim's accuracy.  From there the fit finds 1 to EXACT.
    """
    path = healthy[0] if file.endswith(".nc") else healthy[1]
    argv = ["fit", str(path), "--json"] + (["--steady"] if file.endswith(".csv") else [])
    assert cli.main(argv) == 0
    report = json.loads(capsys.readouterr().out)
    # a transient is sampled: the speed's slope over a step of 20 ms costs 1e-3
    tolerance = EXACT if file.endswith(".csv") else 2e-3
    for row in report["parameters"]:
        assert row["estimate"] == pytest.approx(1.0, abs=tolerance), row["name"]
        assert row["low"] < 1.0 < row["high"]
    if file.endswith(".csv"):
        assert report["assumed_ambient"] == dict(DEFAULT_DAY) and not report["recorded_ambient"]
    else:
        assert report["recorded_ambient"] == {"run.nc": dict(DEFAULT_DAY)}
        assert not report["assumed_ambient"]


def test_a_run_file_tells_the_day_of_its_fit(apu, tmp_path, capsys):
    """A run on a cold, humid day at altitude is fitted on that day, unless an option says more."""
    day = Ambient(altitude=2500.0, Mach=0.3, dT_isa=-12.0, war=0.004)
    ds = simulate_joint(
        apu, duration=0.4, load=SeriesLoad.from_power(120e3), ambient=day, waveform_dt=None,
        solver="propagator",
    )  # fmt: skip
    path = save(ds, tmp_path / "cold.nc")
    given = {n: getattr(day, n) for n in AMBIENT}
    assert recorded_ambient(path) == given
    assert cli.main(["fit", str(path), "--steady", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["recorded_ambient"] == {"cold.nc": given}
    for row in report["parameters"]:
        assert row["estimate"] == pytest.approx(1.0, abs=EXACT), row["name"]
    assert cli.main(["fit", str(path), "--steady", "--disa", "-12"]) == 0
    text = capsys.readouterr().out
    assert "as the run file says, cold.nc: altitude = 2500, Mach = 0.3, war = 0.004" in text
    del ds.attrs["ambient"]  # a file of an older version tells its scenario
    ds.attrs["scenario"] = json.dumps({"ambient": given})
    assert recorded_ambient(save(ds, tmp_path / "old.nc")) == given
    del ds.attrs["scenario"]
    assert recorded_ambient(save(ds, tmp_path / "bare.nc")) == {}
    ds.attrs["ambient"] = json.dumps({"dT_isa": "warm"})
    with pytest.raises(ApuError, match=r"dT_isa = 'warm' is no number in \[-60, 60\] K"):
        recorded_ambient(save(ds, tmp_path / "odd.nc"))


# ------------------------------------------------------------------------------ one range


@pytest.mark.parametrize("name", AMBIENT)
@pytest.mark.parametrize("end", [0, 1])
def test_what_a_run_accepts_the_engine_accepts(apu, name, end):
    """20 km, Mach 0.999 and ISA - 80 K were accepted by Ambient and refused by the engine."""
    gg, limit = apu.gas_generator, RANGES[name][end]
    beyond = float(np.nextafter(limit, np.inf if end else -np.inf))
    par = next(r for r in gg.parameters.table() if r[0] == name)
    assert par[2] == CONDITIONS[name].unit
    Ambient(**{name: limit})
    GasGeneratorParameters(**{name: limit})
    gg.check_inputs(gg.U.pack({"Wf": 0.03, "PW": 1e5, name: limit}))
    fixed, free = {"N": apu.N_ref, "PW": 1e5}, Limits.none()
    status = trim_batch(gg, fixed, limits=free, **{name: np.array([limit, beyond])}).status
    assert status[0] != Status.INPUT and status[1] == Status.INPUT
    table = {"name": "x", "duration": 1.0,
             "phase": [{"name": "p", "start": 0.0, "load": {"kind": "open"}}]}  # fmt: skip
    assert Scenario.from_dict(table | {"ambient": {name: limit}})
    for refused in (
        lambda: Ambient(**{name: beyond}),
        lambda: GasGeneratorParameters(**{name: beyond}),
        lambda: gg.check_inputs(gg.U.pack({"Wf": 0.03, "PW": 1e5, name: beyond})),
        lambda: trim(gg, fixed, **{name: beyond}),
        lambda: Scenario.from_dict(table | {"ambient": {name: beyond}}),
    ):
        with pytest.raises(ApuError, match=rf"{name}"):
            refused()


@pytest.mark.parametrize("name", AMBIENT)
def test_a_fit_takes_no_day_that_the_engine_refuses(healthy, name, tmp_path, capsys):
    """An option and a column beyond the range are refused with file, row, value and range."""
    c = CONDITIONS[name]
    beyond = c.hi * 1.5
    assert cli.main(["fit", str(healthy[1]), "--steady", OPTIONS[name], f"{beyond}"]) == 2
    assert f"bench.csv: {name} = {beyond:g} {c.unit} is outside" in capsys.readouterr().err
    rows = healthy[1].read_text(encoding="utf-8").splitlines()
    path = tmp_path / "column.csv"
    cells = [c.default, *[beyond] * (len(rows) - 2)]
    text = [f"{rows[0]},{name}"]
    text += [f"{r},{v}" for r, v in zip(rows[1:], cells, strict=True)]
    path.write_text("\n".join(text), encoding="utf-8")
    assert cli.main(["fit", str(path), "--steady"]) == 2
    err = capsys.readouterr().err
    assert f"column.csv, column {name}, data row 2, line 3: " in err
    assert f"{beyond:g}" in err and f"{c.lo:g} to {c.hi:g}" in err
    # whoever widens the range of readings does not widen the engine's
    wide = ["--range", f"{name}=-1e9:1e9"]
    assert cli.main(["fit", str(path), "--steady", *wide]) == 2
    err = capsys.readouterr().err
    assert f"column.csv, data row 2: {name} = {beyond:g} {c.unit} is outside" in err
    assert f"({len(rows) - 2} such rows)" in err


def test_words():
    assert day_words({"dT_isa": -12.5, "war": 0.01}) == (
        "0 m, Mach 0, ISA - 12.5 K, 0.01 kg/kg of water"
    )
    assert assumed_words(dict(DEFAULT_DAY)) == ""
    assert "dT_isa" in inspect.signature(performance_deck).parameters
    assert GasGenerator().input_ranges["Mach"] == RANGES["Mach"]
