"""Parts of a user's own, in a file beside the scenario: nothing of the package is changed."""

import dataclasses
import json
import pickle
import sys
from pathlib import Path

import pytest

from apu_casadi.core import results
from apu_casadi.core.errors import ScenarioError
from apu_casadi.gaspath.engines import read_engine, write_engine
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.faults.fault import FAULTS
from apu_casadi.machine.loads.load import LOADS
from apu_casadi.unit.control import GOVERNORS
from scenarios import campaigns, extensions, registry
from scenarios.cli import main
from scenarios.schema import Scenario

PARTS_FILE = Path(__file__).with_name("extension_parts.py")
PARTS = '''
"""A load that is a resistance with a name of its own, and a fault with a word of its own."""
from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

from apu_casadi.core.register import Key
from apu_casadi.machine.faults.fault import FAULTS
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.load import LOADS
from apu_casadi.machine.loads.series import SeriesLoad


@LOADS.add("heater")
@dataclass(frozen=True)
class Heater(SeriesLoad):
    """A heater of so many rods of 10 kW."""

    tables = MappingProxyType({"heater": (Key("rods", "1", "number of rods", 1.0, 40.0),)})

    @classmethod
    def from_keys(cls, word, values):
        return cls.from_power(1e4 * values["rods"])

    def to_table(self):
        return {"kind": "heater", "rods": round(3 * 230.0**2 / self.R[0] / 1e4, 9)}


@FAULTS.add("bolted")
@dataclass(frozen=True)
class Bolted(Ttsc):
    """A short circuit without resistance."""

    word = "bolted"
    keys = (Key("mu", "1", "shorted fraction", 0.0, 0.05, open_lo=True),)

    @classmethod
    def from_table(cls, table):
        return cls(table["mu"], 20.0)

    def to_table(self):
        return {"kind": "bolted", "mu": self.mu}
'''
RUN = """
name = "mine"
duration = 0.3
waveform_dt = 0
extensions = ["parts/my_parts.py"]
[[phase]]
name = "heating"
start = 0.0
load = { kind = "heater", rods = 10 }
[[phase]]
name = "ill"
start = 0.1
health = { f_eta_c = 0.99 }
[[phase]]
name = "short"
start = 0.2
fault = { kind = "bolted", mu = 0.01 }
"""


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A scenario in one folder, its parts in another, and the work in a third."""
    for name in ("case/parts", "work"):
        (tmp_path / name).mkdir(parents=True)
    parts, run = tmp_path / "case" / "parts" / "my_parts.py", tmp_path / "case" / "mine.toml"
    parts.write_text(PARTS)
    run.write_text(RUN)
    monkeypatch.chdir(tmp_path / "work")
    for register in (LOADS, FAULTS, GOVERNORS):  # what is entered in a test leaves with it
        assert len(register)
        monkeypatch.setattr(register, "_added", dict(register._added))
    return parts, run


def test_a_scenario_brings_its_parts(files):
    """Seen from the scenario's file; as a table the scenario names them with their whole path."""
    parts, path = files
    s = registry.get(path)
    assert type(s.phases[0].load).__name__ == "Heater" and s.phases[0].load.inputs["R_a"] > 1
    assert s.extensions == (str(parts),)
    assert s.to_dict()["extensions"] == [str(parts)]
    assert Scenario.from_dict(json.loads(s.to_json())) == s
    assert pickle.loads(pickle.dumps(s)) == s
    assert registry.run(s, solver="propagator")["T4"].size > 10


def test_keys_of_an_own_part_are_checked_as_all_are(files):
    _, path = files
    for old, new, message in (
        ("rods = 10", "rods = 0", "phase[1].load.rods: must lie in [1, 40], got 0"),
        ("rods = 10", "rod = 10", "phase[1].load.rod: unknown key (did you mean 'rods'?)"),
        ('"heater"', '"heatr"', "phase[1].load.kind: unknown 'heatr' (did you mean 'heater'?)"),
        ('"bolted", mu', '"bolted", k_rf = 1, mu', "phase[3].fault.k_rf: unknown key"),
        ('"bolted"', '"bolt"', "phase[3].fault.kind: unknown 'bolt' (did you mean 'bolted'?)"),
    ):
        path.write_text(RUN.replace(old, new))
        with pytest.raises(ScenarioError) as e:
            registry.get(path)
        assert message in str(e.value)


@pytest.mark.long
def test_workers_of_a_campaign_know_them(files):
    """Fresh processes read the tables alone; a changed part is another run."""
    parts, path = files
    base = registry.get(path)
    table = base.to_dict()
    table["phase"][2]["fault"] = {"mu": 0.01, "k_rf": 20.0}
    runs = campaigns.random_faults(2, base=Scenario.from_dict(table))
    assert runs[0].to_dict()["phase"][0]["load"] == {"kind": "heater", "rods": 10.0}
    ds = campaigns.run_campaign(runs, workers=2)
    assert campaigns.counts(ds)["done"] == 2, ds["reason"].values
    key = campaigns._task(runs[0], "propagator", None).key
    parts.write_text(PARTS + "\n# changed\n")
    assert campaigns._task(runs[0], "propagator", None).key != key


def test_commands_take_them(files, capsys):
    parts, path = files
    load = ["--with", str(parts), "--load", 'kind = "heater", rods = 20']
    assert main(["trim", *load, "--json"]) == 0
    own = json.loads(capsys.readouterr().out)
    assert own["load"] == {"kind": "heater", "rods": 20}
    assert main(["trim", "--load", "200e3", "--json"]) == 0
    assert own["outputs"] == json.loads(capsys.readouterr().out)["outputs"]
    assert main(["trim", *load]) == 0
    assert "load of each generator: 200 kW; " in capsys.readouterr().out
    assert main(["linearise", *load, "--no-figures", "--model", "gas"]) == 0
    assert "load of each generator: 200 kW; healthy" in capsys.readouterr().out
    path.write_text(RUN.replace('extensions = ["parts/my_parts.py"]\n', ""))
    quick = ["--solver", "propagator", "--no-figures", "--quiet", "--governor", "PI"]
    assert main(["run", str(path), "--with", str(parts), *quick]) == 0
    said = capsys.readouterr().out
    assert "100 kW" in said and "\ngovernor PI\n" in said
    argv = ["campaign", "--base", str(path), "--with", str(parts), "--runs", "1", "--out", "c"]
    assert main([*argv, "--workers", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["counts"]["done"] == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\ny = 1/0\n", "ZeroDivisionError at line 2: division by zero"),
        ("x = = 2\n", "SyntaxError at line 1"),
        ("import sys\nsys.exit(3)\n", "the file ends the program, with status 3; remove that"),
        (
            "from apu_casadi.machine.loads.load import LOADS\n\nLOADS.add('R')(dict)\n",
            "ParameterError at line 3: load 'R' is taken by SeriesLoad",
        ),
    ],
)
def test_a_file_with_a_mistake_is_told_by_its_line(files, capsys, text, message):
    parts, path = files
    parts.write_text(text)
    assert main(["run", str(path)]) == 2
    err = capsys.readouterr().err
    assert f"apu: error: {path}: {parts}: " in err and message in err and err.count("\n") == 1
    for command in ("fit nope.csv", "deck", "maps", "identify", "calibrate", "estimate joint"):
        assert main([*command.split(), "--with", str(parts)]) == 2
        assert message in capsys.readouterr().err


def test_a_file_is_run_once_until_it_changes(tmp_path):
    path = tmp_path / "counted.py"
    path.write_text("import sys\nsys.counted = getattr(sys, 'counted', 0) + 1\n")
    for _ in range(2):
        extensions.load([path, path])
    assert sys.counted == 1
    path.write_text(path.read_text() + "\n")
    extensions.load([path])
    assert sys.counted == 2
    del sys.counted
    with pytest.raises(ScenarioError, match=r"none\.py: Python file cannot be read: No such file"):
        extensions.load([tmp_path / "none.py"])


def test_names_of_files_are_checked():
    table = {"name": "x", "duration": 1.0, "phase": []}
    for value in ("parts.py", [3], [""]):
        with pytest.raises(ScenarioError, match="extensions: a list of file names is expected"):
            Scenario.from_dict({**table, "extensions": value})
    with pytest.raises(ScenarioError, match="engine: a text is expected, got 3"):
        Scenario.from_dict({**table, "engine": 3})


def test_a_governor_of_ones_own(mine, files, capsys):
    """By its name in a scenario and on the command line; its numbers are parameters."""
    _, path = files
    text = f'name = "mine"\nduration = 0.3\nwaveform_dt = 0\nextensions = ["{PARTS_FILE}"]\n'
    text += '[[phase]]\nname = "a"\nstart = 0.0\n'
    text += 'load = { kind = "R", power_kW = 100 }\n[[event]]\ntime = 0.1\n'
    text += 'load = { kind = "R", power_kW = 150 }\n'
    own = text.replace(
        "[[phase]]", 'governor = "my_PID"\nparameters.governor.Kd = 0.004\n[[phase]]', 1
    )
    lowest = {}
    for name, toml in {"PI": text, "PID": own}.items():
        path.write_text(toml)
        s = registry.get(path)
        assert Scenario.from_dict(s.to_dict()) == s
        lowest[name] = float(registry.run(s)["N"].min())
    assert lowest["PID"] > lowest["PI"] + 1.0  # the derivative catches the drop
    both = own.replace("parameters.governor.Kd", "parameters.governor.kind = 'PI'\n# ")
    path.write_text(both)
    with pytest.raises(ScenarioError, match=r"governor: 'my_PID', but parameters.governor.kind is"):
        registry.get(path)
    path.write_text(own.replace('"my_PID"', '"my_PIDD"'))
    with pytest.raises(
        ScenarioError, match=r"governor: unknown 'my_PIDD' \(did you mean 'my_PID'\?\)"
    ):
        registry.get(path)
    argv = ["linearise", "--no-figures", "--json", "--with", str(PARTS_FILE), "--governor"]
    assert main([*argv, "my_PID"]) == 0
    assert "e_slow" in json.loads(capsys.readouterr().out)["names"]["x"]
    assert main([*argv, "my_PIDD"]) == 2
    assert "unknown governor 'my_PIDD' (did you mean 'my_PID'?)" in capsys.readouterr().err


# ------------------------------------------------------------------------------ another engine


@pytest.fixture
def other_engine(tmp_path, monkeypatch):
    """An engine with a worse compressor, in a file."""
    path = tmp_path / "engine.toml"
    poor = GasGenerator().parameters.change(eta_c=0.80)
    write_engine(dataclasses.replace(GasGenerator(), parameters=poor), path)
    monkeypatch.chdir(tmp_path)
    return path, read_engine(path)


@pytest.mark.long
def test_every_command_takes_another_engine(other_engine, capsys):
    """The fuel that commands print is the other engine's."""
    _, made = other_engine
    fuel = trim_gas_generator(made, {"N": made.parameters.N, "PW": 2e5})["Wf"]
    assert fuel > 1.03 * trim_gas_generator(GasGenerator(), {"N": 3775.147, "PW": 2e5})["Wf"]
    assert main(["trim", "--engine", "engine.toml", "--power", "2e5", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["outputs"]["Wf"] == pytest.approx(fuel, rel=1e-9)
    assert report["engine"] == "engine.toml"
    assert main(["trim", "--engine", "engine.toml", "--power", "2e5"]) == 0
    assert "health: healthy; engine engine.toml; apu-casadi" in capsys.readouterr().out
    deck = ["deck", "--altitude", "0", "--mach", "0", "--power", "2e5", "--engine", "engine.toml"]
    assert main(deck) == 0
    assert float(results.load("deck.nc")["Wf"].values.item()) == pytest.approx(fuel, rel=1e-9)
    assert main(["maps", "--no-lines", "--engine", "engine.toml"]) == 0
    assert main(["linearise", "--engine", "engine.toml", "--power", "80", "--json"]) == 0
    capsys.readouterr()


def test_a_scenario_names_its_engine(other_engine, monkeypatch):
    """Seen from its file; a changed engine is another unit and another run of a campaign."""
    path, made = other_engine
    text = 'name = "own"\nduration = 0.1\nwaveform_dt = 0\nengine = "engine.toml"\n[[phase]]\n'
    text += 'name = "a"\nstart = 0.0\nload = { kind = "R", power_kW = 80.0 }\n'
    (path.parent / "own.toml").write_text(text)
    monkeypatch.chdir("/")
    s = registry.get(path.parent / "own.toml")
    assert s.engine == str(path) and Scenario.from_dict(s.to_dict()) == s
    assert registry.unit_for(s).gas_generator == made
    assert registry.unit_for(s.change(engine=None)).gas_generator == GasGenerator()
    key = campaigns._task(s, "propagator", None).key
    path.write_text(path.read_text() + "\n")
    assert campaigns._task(s, "propagator", None).key != key
    path.unlink()
    with pytest.raises(
        ScenarioError, match=r"engine\.toml: engine file cannot be read: No such file"
    ):
        registry.unit_for(s)
