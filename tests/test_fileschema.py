"""The JSON schema of a scenario file: what is read passes it, and mistakes do not."""

import json
import tomllib
from importlib.resources import files

import pytest

from apu_casadi.unit.apu import Apu
from apu_casadi.unit.enginefile import write_unit
from apu_casadi.unit.shippedunits import shipped_units
from scenarios.cli import main
from scenarios.fileschema import docs_of, engine_schema, file_schema
from scenarios.schema import FILE_KEYS, Scenario

jsonschema = pytest.importorskip("jsonschema")

GOOD = """
name = "mine"
duration = 4.0
waveform_dt = 0
exchange = "predicted"
seed = 3
[ambient]
altitude = 8000.0
[parameters]
"machine.r_s" = 0.005
governor.Kp = 0.4
[noise]
N = 0.1
gas = { T3 = 1.0 }
terminal = { sigma_v = 0.5 }
[[phase]]
name = "start"
start = 0.0
load = { kind = "RL", power_kW = 225.0, unbalance = [1.1, 1.0, 0.9] }
[[phase]]
name = "fault"
start = 2.0
fault = { mu = 0.05, k_rf = 20.0, phase = "b" }
health = { f_eta_c = 0.99 }
[[event]]
time = 3.0
fault = "none"
"""


@pytest.fixture(scope="module")
def validator():
    schema = file_schema()
    jsonschema.Draft7Validator.check_schema(schema)
    return jsonschema.Draft7Validator(schema)


def test_everything_that_is_read_passes(validator):
    """The library, a file with every key, and what a scenario writes of itself."""
    texts = [p.read_text() for p in files("scenarios").joinpath("library").iterdir()]
    for text in [*texts, GOOD]:
        data = tomllib.loads(text)
        validator.validate(data)
        validator.validate(json.loads(Scenario.from_dict(data).to_json()))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('name = "mine"', 'nam = "mine"'), ('"mine"', '"../mine"'), ("duration = 4.0", ""),
        ("duration = 4.0", "duration = 9999"), ("duration = 4.0", 'duration = "4"'),
        ('"RL"', '"Rl"'), ("power_kW", "power_kw"), ("power_kW = 225.0", "power_kW = -1"),
        ("power_kW = 225.0,", ""), ("[1.1, 1.0, 0.9]", "[1.1, 1.0]"), ("mu = 0.05", "mu = 5"),
        ("mu = 0.05,", ""), ('"b"', '"d"'), ("f_eta_c", "f_eta_C"), ("0.99", "0.5"),
        ("start = 2.0", "begin = 2.0"), ('"predicted"', '"half"'), ("seed = 3", "seed = -3"),
        ("altitude = 8000.0", "altitude = 80000.0"), ("machine.r_s", "machine.rs"),
        ("sigma_v", "sigma_V"), ("time = 3.0", "time = 0.0"), ('fault = "none"', 'fault = "nil"'),
    ],
)  # fmt: skip
def test_mistakes_do_not(validator, old, new):
    """Each is one that the program refuses as well (parameters when the unit is made)."""
    assert old in GOOD
    assert not validator.is_valid(tomllib.loads(GOOD.replace(old, new, 1)))


def test_it_is_made_of_the_classes_and_documented(validator, capsys):
    """Every key is there, with words and units for who writes a file."""
    assert main(["list", "--schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert schema == json.loads(json.dumps(validator.schema))
    assert tuple(schema["properties"]) == FILE_KEYS
    assert ":func:" not in json.dumps(schema) and ":class:" not in json.dumps(schema)
    assert all(p["description"] for p in schema["properties"].values())
    power = schema["definitions"]["load"]["anyOf"][0]["oneOf"][0]["properties"].get("power_kW")
    assert power is None or power["description"].endswith("[kW]")
    start = schema["properties"]["phase"]["items"]["properties"]["start"]
    assert start["description"] == "instant at which it begins and its changes take effect [s]"


ENGINE = """
name = "own"
[gas_generator]
N = { value = 41730, unit = "r/min", source = "plate" }
W2 = 3.49
gas_data = "nasa9"
[compressor_map]
file = "maps/radial.csv"
check = false
[[generator]]
neutral = "isolated"
machine.S_10 = 0.1
[[generator]]
[generator.coupling]
gear = 3.2
[governor]
kind = "PI"
Wf_max = { value = 240, unit = "kg/h" }
[limits]
T4_max = 1400.0
"""


@pytest.fixture(scope="module")
def of_engines():
    schema = engine_schema()
    jsonschema.Draft7Validator.check_schema(schema)
    return jsonschema.Draft7Validator(schema)


def test_every_unit_that_is_shipped_or_written_passes(of_engines, tmp_path, capsys):
    """And every key of the scenario's parameters has its table there."""
    for path in shipped_units().values():
        of_engines.validate(tomllib.loads(path.read_text(encoding="utf-8")))
    of_engines.validate(tomllib.loads(ENGINE))
    mixed = {"generator2.machine.r_s": 0.005, "generator2.neutral": "isolated", "machine.S_10": 0.1}
    for unit in (Apu(), Apu().change(mixed)):
        write_unit(unit, tmp_path / "unit.toml")
        of_engines.validate(tomllib.loads((tmp_path / "unit.toml").read_text()))
    assert main(["list", "--engine-schema"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(of_engines.schema))
    table = of_engines.schema["properties"]
    assert tuple(table) == ("name", "title", "doc", "gas_generator", "limits", "compressor_map",
                            "turbine_map", "generator", "governor", "coupling")  # fmt: skip
    assert table["gas_generator"]["properties"]["W2"]["description"].endswith("[kg/s]")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[governor]", "[governer]"), ('"PI"', '"PIX"'), ('"isolated"', '"loose"'), ("W2", "w2"),
        ("3.49", "-3.49"), ("3.49", '"3.49"'), ('"r/min"', '"K"'), ("T4_max", "T4max"),
        ("value = 240", "val = 240"), ("gear = 3.2", "gear = 0.0"), ("check = false", "check = 1"),
        ('file = "maps/radial.csv"', 'file = "a"\nshipped = "axi5"'), ("1400.0", "-1400.0"),
        ('source = "plate"', "source = 4"), ('"nasa9"', '"nasa"'), ("machine.S_10", "machine.S_11"),
    ],
)  # fmt: skip
def test_mistakes_in_an_engine_do_not(of_engines, old, new):
    """Each is one that the program refuses as well."""
    assert old in ENGINE
    assert not of_engines.is_valid(tomllib.loads(ENGINE.replace(old, new, 1)))


def test_words_come_from_docstrings():
    class Thing:
        """A thing.

        Args:
            a, b: two
                words.
            c: one.

        Raises:
            Error: never.
        """

    assert docs_of(Thing) == {"a": "two words", "b": "two words", "c": "one"}
