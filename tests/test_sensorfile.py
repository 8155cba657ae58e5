"""Files of sensors: what an entry declares, its units, and what is wrong with it."""

import dataclasses
import json

import numpy as np
import pytest

from apu_casadi.core.errors import DataError, ParameterError
from estimators.apu.electrical.hypotheses import SeverityPrior
from estimators.apu.priorfile import read_prior
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensorfile import KEYS, TABLED, SensorFile, read_sensors, sensor_schema, to_toml
from estimators.apu.sensors import ELECTRICAL, GAS_PATH, KNOWN, Sensor, SensorSet, unregister
from estimators.apu.unknowns import UNKNOWNS, Knowledge
from scenarios import cli

OWN = """
[T5]
lag = 1.0
delay = 0.2
bias = 3.0
bias_as = "considered"
range = [300, 1100]
fails = false
[P3]
unit = "kPa"
noise = 4.0
quantum = 0.5
[T41]
[i_a]
jitter = 5e-6
gain_mean = 0.01
[EGT]
quantity = "T5"
unit = "degC"
noise = 2.0
range = [0, 900]
lag = 0.5
[f_gen]
quantity = "N"
unit = "Hz"
factor = 0.1061
noise = 0.05
rate = 10
"""


@pytest.fixture(autouse=True)
def _forget():
    """What a file names is known to files of recordings until the process ends."""
    yield
    for name in set(KNOWN) - set(TABLED):
        unregister(name)


@pytest.fixture
def own(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(OWN)
    return read_sensors(path)


def test_an_entry_is_what_it_says_and_the_table_for_the_rest(own):
    g = own.gas_path
    assert g.names == (*GAS_PATH.names, "T41", "EGT", "f_gen")
    T5, P3 = g["T5"], g["P3"]
    assert (T5.tau, T5.delay, T5.bias, T5.limits, T5.fails) == (1.0, 0.2, 3.0, (300, 1100), False)
    assert (T5.noise, T5.relative) == (GAS_PATH["T5"].noise, True)
    assert not T5.direct and T5.biased and T5.unsure("bias") == 3.0
    assert (P3.noise, P3.relative, P3.quantum, P3.unit) == (4000.0, False, 500.0, "Pa")
    assert own.electrical["i_a"].jitter == 5e-6
    assert own.electrical["i_b"] == ELECTRICAL["i_b"]
    assert own.rates == {"f_gen": 10.0}


def test_a_sensor_of_ones_own_reads_a_quantity_in_its_unit(own):
    """degC and Hz of the file are K and 1/s; the plausible range goes with the factor."""
    egt, f = own.gas_path["EGT"], own.gas_path["f_gen"]
    assert (egt.reads, egt.unit, egt.noise, egt.relative) == (("T5",), "K", 2.0, False)
    assert egt.limits == (273.15, 1173.15) and egt.plausible == GAS_PATH["T5"].plausible
    assert f.unit == "1/s" and f.of({"N": 3775.0}) == pytest.approx(400.5, abs=0.1)
    assert f.plausible == pytest.approx([0.1061 * v for v in GAS_PATH["N"].plausible])
    # no gain error of what is counted; and files may name it from then on
    assert "f_gen" not in own.gas_path.uncertain and "EGT" in own.gas_path.uncertain
    t = np.arange(4) * 0.1
    m = read_recording({"t": t, "EGT [degC]": 500 + t, "f_gen [Hz]": 400 + t})
    assert m["EGT"].values[0] == 773.15 and m["f_gen"].unit == "1/s"
    assert "EGT" not in SensorFile().gas_path


def test_a_complete_file_has_no_other_sensors(own, tmp_path):
    path = tmp_path / "all.toml"
    path.write_text(to_toml(own))
    again = read_sensors(path)
    assert again.complete and again.gas_path.names == own.gas_path.names
    plain = {f.name: None for f in dataclasses.fields(Sensor) if f.name in ("source", "plausible")}
    for a, b in zip(again.gas_path.sensors, own.gas_path.sensors, strict=True):
        assert dataclasses.replace(a, **plain) == dataclasses.replace(b, **plain)
    path.write_text("complete = true\n[P3]\n[Wf]\n[i_a]\n")
    few = read_sensors(path)
    assert (few.gas_path.names, few.electrical.names) == (("P3", "Wf"), ("i_a",))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[T5]\nlag = -1", "T5: lag must be a number >= 0 and <= 10000, got -1"),
        ("[T5]\ngain = true", "gain must be a number >= 0 and <= 1, got True"),
        ("[T5]\nbias_as = 'guessed'", "bias_as 'guessed' .valid: estimated, c"),
        ("[T5]\nunit = 'bar'", r"T5: bar is no unit of T5 \(K\)"),
        ("[T5]\nunit = 'barr'", "unknown unit 'barr' .did you mean 'bar'"),
        ("[T5]\nrange = [3, 2]", r"range must be \[LOW, HIGH\]"),
        ("[T5]\nfails = 1", "fails must be true or false"),
        ("[T5]\nrelative = false", "relative without noise"),
        ("[P3]\nnoise = 4000", "noise of 4000 times the reading: give its unit"),
        ("[T5]\ndrift = 1.0\nbias_as = 'known'", "a bias that drifts must be estimated"),
        ("[T5]\nquantity = 'T3'", "it reads T5 in all files: take another name"),
        ("[X]\nquantity = 'T55'", "X: unknown quantity 'T55' .did you mean 'T5"),
        ("[X]\nquantity = 'N'\nunit = 'Hz'", "X: Hz is no unit of N .rad/s.; where"),
        ("[X]\nquantity = 'N'\nfactor = 0", "factor must be a number not 0"),
        ("[X]\nquantity = 'W3'", "X: its noise is needed"),
        ("[X]\nnoise = 1", "unknown sensor 'X' .*a sensor of its own says its quantity"),
        ("complete = 1", "complete must be true or false"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(tmp_path, text, words):
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(DataError, match=words) as e:
        read_sensors(path)
    assert str(e.value).startswith(str(path))


def test_the_schema_knows_every_key_and_sensor():
    made = sensor_schema()
    entry = made["definitions"]["sensor"]["properties"]
    assert {k.name for k in KEYS} < set(entry) and entry["rate"]["exclusiveMinimum"] == 0
    assert {*KNOWN, *ELECTRICAL.names, "complete"} == set(made["properties"])
    assert made["additionalProperties"]["allOf"][1] == {"required": ["quantity"]}
    json.dumps(made, allow_nan=False)


def test_impossible_declarations_are_refused():
    for wrong, words in (
        ({"gain_as": "guess"}, "gain_as 'guess'"),
        ({"rate": -1.0}, "impossible rate: -1.0"),
        ({"factor": 0.0}, "impossible factor"),
        ({"limits": (2.0, 1.0)}, "no limits"),
        ({"quantum": -1.0}, "quantum must be >= 0"),
    ):
        with pytest.raises(ParameterError, match=words):
            Sensor("X", 0.01, True, 0.0, "K", "", **wrong)


def test_digits_count_as_noise():
    """q/sqrt(12) of a uniform error, beside the noise."""
    s = SensorSet((Sensor("P3", 30.0, False, 0.0, "Pa", "", quantum=100.0),))
    assert s.sigma("P3", 8e5) == pytest.approx(np.hypot(30.0, 100 / np.sqrt(12)))
    assert s["P3"].white(8e5) == 30.0


def test_a_prior_file(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text("[f_eta_c]\nmean = 0.98\nsigma = 0.01\n[gain_T5]\nsigma = 1e-3\n")
    p = read_prior(path)
    assert (p.mean, p.sigma) == ({"f_eta_c": 0.98}, {"f_eta_c": 0.01, "gain_T5": 1e-3})
    for text, words in (
        ("[f_eta_c]\nmeen = 1", "f_eta_c: unknown key 'meen' .did you mean 'mean'"),
        ("[f_eta_c]\nsigma = 0", "sigma must be a number > 0, got 0"),
        ("f_eta_c = 1", r"a table \[f_eta_c\] with mean or sigma is expected"),
        ("[", "no TOML"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=words):
            read_prior(path)


def test_a_prior_file_says_what_is_done_about_a_parameter(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(
        '[machine.L_md]\nsigma = 0.05\nhow = "estimated"\n[machine.r_s]\nhow = "known"\n'
        '[J]\nhow = "estimated"\n'
    )
    of = read_prior(path).unknowns()
    assert of["machine.L_md"] == Knowledge("estimated", 0.05)
    assert of["machine.r_s"] == Knowledge("known")
    assert of["J"] == Knowledge("estimated", UNKNOWNS["J"].sigma)
    for text, words in (
        ('[J]\nhow = "estimate"', "J: how = 'estimate' .did you mean 'estimated'"),
        ('[machine.L_mq]\nhow = "considered"', "L_mq: sigma = 0.0: a share of the value > 0"),
        ('[J]\nhow = "known"\nsigma = 0.1', "0 for what is known"),
        ('[f_eta_c]\nhow = "known"', "f_eta_c: unknown key 'how'"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=words):
            read_prior(path)


def test_a_prior_file_of_generators(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(
        "[machine.r_s]\nmean = 0.005\nsigma = 0.02\n[machine.eta_sg]\nsigma = 0\n"
        "[delay_i]\nsigma = 2e-6\n[h]\nprobability = 0.01\n[h_b]\nmean = 3e-4\nsigma = 1e-4\n"
    )
    p = read_prior(path)
    known = p.unknowns()
    assert p.values() == {"machine.r_s": 0.005}
    assert known["machine.r_s"].sigma == 0.02 and known["machine.eta_sg"].how == "known"
    assert known["delay_i"].sigma == 2e-6 and known["machine.r_fd"] == UNKNOWNS["machine.r_fd"]
    usual = SeverityPrior()
    s = p.severity()
    assert s.probability == 0.01 and s.mean == (0.0, 3e-4, 0.0)
    assert s.scale == (usual.scale[0], 1e-4, usual.scale[2])
    assert (p.of_gas_path().mean, p.of_gas_path().sigma) == ({}, {})
    for text, words in (
        ("[h]\nprobability = 1.0", "probability = 1.0; a probability in"),
        ("[h_a]\nprobability = 0.1", "h_a: unknown key 'probability'"),
        ("[machine.r_s]\nsigma = -1", "sigma must be a number > 0, got -1"),
        ("[delay_i]\nmean = 1e-6", "declare it in the file of sensors"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=words):
            wrong = read_prior(path)
            (wrong.severity(), wrong.values())


def test_commands(tmp_path, capsys):
    path = tmp_path / "own.toml"
    path.write_text(OWN)
    assert cli.main(["estimate", "sensors", "--sensors", str(path)]) == 0
    assert "tau 1 s, delay 0.2 s, bias 3 K" in capsys.readouterr().out
    assert cli.main(["estimate", "sensors", "--toml"]) == 0
    assert capsys.readouterr().out.startswith("complete = true\n\n[N]")
    assert cli.main(["estimate", "sensors", "--schema"]) == 0
    assert json.loads(capsys.readouterr().out) == sensor_schema()


@pytest.mark.ci  # solves steady points: some seconds
def test_identify_takes_a_file(tmp_path, capsys):
    path = tmp_path / "own.toml"
    path.write_text(OWN)
    assert cli.main(["identify", "--sensors", str(path), "--gain-errors", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert "EGT" in found["sensors"] and "PW" not in found["sensors"]


def test_one_generator_has_sensors_of_its_own(tmp_path):
    """What is said of i_a_2 holds for that one; the file of the set reads the same again."""
    path = tmp_path / "two.toml"
    path.write_text(
        "[i_a_2]\ngain = 0.02\n[i_a]\nnoise = 2.0\n[v_b_1]\nclock = 'adc'\njitter = 1e-6\n"
    )
    made = read_sensors(path)
    e = made.electrical
    assert e.numbered == (1, 2) and e["i_a_2"].noise == 2.0
    one, two = e.machine(1), e.machine(2)
    assert one.names == two.names == ELECTRICAL.names
    assert (one["i_a"].gain, two["i_a"].gain) == (0.005, 0.02)
    assert (one["v_b"].clock, two["v_b"].clock) == ("adc", "")
    assert e.of_channel("i_a_2") is e["i_a_2"] and e.of_channel("i_a_3") is e["i_a"]
    assert e.of_channel("v_b") is e["v_b_1"] and e.of_channel("x") is None
    assert ELECTRICAL.machine(2) is ELECTRICAL
    path.write_text(to_toml(made))
    again = read_sensors(path).electrical.machine(2)
    assert [(s.name, s.noise, s.gain) for s in again.sensors] == [
        (s.name, s.noise, s.gain) for s in two.sensors
    ]
    path.write_text("[i_d_2]\nnoise = 1")
    with pytest.raises(DataError, match="unknown sensor 'i_d_2'"):
        read_sensors(path)
    assert sensor_schema()["patternProperties"]
