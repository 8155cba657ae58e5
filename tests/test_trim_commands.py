"""The commands trim, deck, study and compile: what they print, and how they refuse."""

import json

import pytest
import xarray as xr

from apu_casadi.core import backend
from apu_casadi.core.means import RMS, SEQUENCES
from apu_casadi.machine.generator import Generator
from scenarios.cli import main
from scenarios.commands.trim import _electrical, _table


def out(capsys, *argv):
    """Run the command; return status, standard output and standard error."""
    status = main(list(argv))
    got = capsys.readouterr()
    return status, got.out, got.err


def test_trim_prints_table_5(capsys):
    """The paper's cruise point (Table 5), by shaft power; JSON holds every output."""
    ambient = ("--altitude", "8000", "--mach", "0.7", "--disa", "5")
    status, text, _ = out(capsys, "trim", *ambient, "--power", "222e3", "--json")
    report = json.loads(text)
    assert status == 0
    assert report["outputs"]["T3"] == pytest.approx(534.3, rel=2e-3)
    assert report["residual"] < 1e-9
    status, text, _ = out(capsys, "trim", *ambient, "--power", "222e3")
    assert status == 0 and "T3              534" in text and "residual" in text


def test_every_output_of_a_generator_has_unit_and_meaning():
    """At rest, and those of a periodic state."""
    told = _electrical()
    y = Generator().state_space().y.names
    for name in (*y, *RMS, *SEQUENCES, "V_ref", "i_fault_rms"):
        assert all(told[name]), name
    table = _table({"V_ref": 1.0, "I_2_angle": -1.0}, ["V_ref", "I_2_angle"], told).splitlines()
    assert table[0].endswith("1        voltage reference, per unit") and "  rad  " in table[1]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (
            ("--load", "225"),
            "load = 225 W is outside 450 to 3.6e+05, a generator is rated 225000 W",
        ),
        (("--power", "222"), "--power = 222 W is outside"),
        (("--speed", "3775", "--power", "2e5"), "--speed = 3775 r/min is outside 1.442e+04 to"),
    ],
)
def test_likely_slips_of_a_unit_are_told(capsys, argv, words):
    """kW for W, rad/s for r/min: taken, with one line."""
    _, _, err = out(capsys, "trim", *argv)
    assert f"warning: {words}" in err and "is the unit of the number right?" in err


def test_trim_by_other_quantities(capsys):
    """Two fixed outputs, a cubic load, a temperature limit, an electrical load, one generator."""
    for argv in (
        ("--fix", "N_rpm=36050", "--fix", "T4=1150"),
        ("--fix", "Wf=0.045,PW=cube"),
        ("--max-power", "T5=720", "--altitude", "3000"),
        ("--load", "200e3", "--disa", "5"),
        ("--power", "300e3", "--health", "f_eta_c=0.97", "--limit", "T4_max=1500"),
    ):
        status, text, err = out(capsys, "trim", *argv, "--json")
        assert status == 0, (argv, err)
        assert json.loads(text)["outputs"]["PW"] > 1e5
    status, text, _ = out(capsys, "trim", "--load", "100e3", "--voltage", "230", "--json")
    assert status == 0 and json.loads(text)["generator"]["V_t"] == pytest.approx(230.0)


@pytest.mark.parametrize(
    ("argv", "status", "words"),
    [
        (("--power", "900e3"), 1, "temperature limit: T4 = "),
        (("--load", "225e3", "--power", "1e5"), 2, "give one of --power, --load"),
        ((), 2, "got none"),
        (("--fix", "N=3775,t4=1000"), 2, "did you mean 'T4'?"),
        (("--power", "1e5", "--limit", "SMmin=0"), 2, "did you mean 'SM_min'?"),
        (("--power", "1e5", "--health", "f_eta_c"), 2, "NAME=VALUE is expected"),
        (("--power", "1e5", "--voltage", "230"), 2, "needs --load"),
    ],
)
def test_trim_refuses_with_the_reason(capsys, argv, status, words):
    """Status 1: no such point; 2: a wrong question."""
    got, _, err = out(capsys, "trim", *argv)
    assert got == status and words in err


def test_deck_writes_the_grid(capsys, tmp_path):
    """Axes by range and by list; refused points are counted."""
    path = tmp_path / "d" / "deck.nc"
    status, text, _ = out(
        capsys, "deck", "--altitude", "0:6000:3", "--mach", "0,0.4", "--power", "1e5,9e5",
        "--outputs", "T4,Wf", "--out", str(path), "--json",
    )  # fmt: skip
    report = json.loads(text)
    assert status == 0 and report["points"] == 12 == sum(report["counts"].values())
    with xr.open_dataset(path) as deck:
        assert dict(deck.sizes) == {"altitude": 3, "Mach": 2, "dT_isa": 1, "PW": 2}
        assert {"T4", "Wf", "status"} <= set(deck.data_vars)
    status, _, err = out(capsys, "deck", "--mach", "0:x:3", "--out", str(path))
    assert status == 2 and "FROM:TO:COUNT" in err


def test_study_reports_shares(capsys):
    """A small run of the large study; status 1 if a point were wrong or unexplained."""
    status, text, _ = out(capsys, "study", "trim", "--points", "300", "--seed", "3", "--json")
    report = json.loads(text)
    assert status == 0
    assert report["wrong"] == report["unexplained"] == 0
    assert report["cold"] > 0.8 * report["points"]
    status, text, _ = out(capsys, "study", "trim", "--points", "300", "--seed", "3")
    assert status == 0 and "wrong (residual > 1e-9)         0" in text


def test_compile_without_a_compiler_says_so(capsys, monkeypatch, tmp_path):
    """Nothing to do is status 1, not a failure; an unknown group is a wrong question."""
    monkeypatch.setenv("APU_CACHE_DIR", str(tmp_path))
    with backend.use_backend("vm"):
        status, _, err = out(capsys, "compile")
    assert status == 1 and "virtual machine" in err
    status, _, err = out(capsys, "compile", "--only", "trimm")
    assert status == 2 and "did you mean 'trim'?" in err
    status, text, _ = out(capsys, "compile", "--clear")
    assert status == 0 and text.startswith("0 libraries")


MIXED = ("--load", "100e3", "--load", 'kind = "RL", power_kW = 80, power_factor = 0.85')
OF_2 = ("--fault", "generator = 2, mu = 0.05, k_rf = 20")


def test_each_generator_has_its_load_and_its_fault(capsys):
    """Given twice, loads are those of generators 1 and 2, as in a scenario's list."""
    both = ("--fault", "generator = 1, mu = 0.05, k_rf = 200")
    status, text, _ = out(capsys, "trim", *MIXED, *OF_2, *both, "--json")
    report = json.loads(text)
    assert status == 0 and [f["generator"] for f in report["fault"]] == [2, 1]
    first, second = report["generators"]
    assert first["P_e"] > 95e3 > 81e3 > second["P_e"] and len(report["load"]) == 2
    assert second["P_loss_fault"] > 8 * first["P_loss_fault"] > 0
    status, text, _ = out(capsys, "trim", *MIXED)
    assert "generator 2: 80 kW, power factor 0.85" in text


def test_linear_models_take_loads_and_faults_by_generator(capsys, tmp_path):
    saved = tmp_path / "model.nc"
    how = ("linearise", "--no-figures", "--json")
    status, text, _ = out(capsys, *how, *MIXED, "--save", str(saved))
    report = json.loads(text)
    assert status == 0 and "generator2.L" in report["names"]["u"] and saved.exists()
    status, text, _ = out(capsys, *how, "--power", "100", *OF_2)
    report = json.loads(text)
    assert report["names"]["theta"][-3:] == [
        f"generator2.{n}" for n in ("mu", "k_rf", "phase_angle")
    ]
    assert max(e["real"] for e in report["eigenvalues"]) < 0
    one = ("--model", "generator", "--generator", "2")
    status, text, _ = out(capsys, *how, *one, *MIXED)
    assert "L" in json.loads(text)["names"]["u"]
    status, text, _ = out(capsys, *how, "--power", "100", "--apart")
    assert {"generator1.V_ref", "generator2.V_ref"} <= set(json.loads(text)["names"]["u"])


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (("trim", *MIXED, "--load", "1e5"), "2 entries expected, one a generator, got 3"),
        (("trim", *MIXED, "--voltage", "230"), "one generator is solved alone"),
        (("trim", "--load", "1e5", *OF_2, *OF_2), "two faults of generator 2"),
        (("linearise", "--generator", "2"), "--generator is that of --model generator"),
        (("linearise", "--model", "generator", "--generator", "3"), "has generators 1 to 2"),
        (("linearise", "--model", "gas", "--apart"), "--apart is about the generators"),
        (("linearise", "--power", "90", "--load", "1e5"), "not both"),
        (
            ("linearise", "--load", 'kind = "R", power_kW = { from = 100, to = 150, over = 9.0 }'),
            "give what it is then, 100 kW at t = 0 s, 150 kW at t = 9 s",
        ),
    ],
)
def test_wrong_loads_and_faults_of_generators_are_told(capsys, argv, words):
    status, _, err = out(capsys, *argv)
    assert status == 2 and words in err
