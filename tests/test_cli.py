"""The console command: listing, running (on a stand-in simulation), refusing."""

import json
import signal
import subprocess
import sys

import pytest
from synthetic_joint import synthetic_joint

from apu_casadi.core import results
from apu_casadi.core.errors import OperatingPointError
from scenarios import cli, registry


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """Replace the simulation; work in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def simulate(s, progress, solver, phasors):
        if progress:
            for k in range(15):
                progress(float(k), 14.0)
        return synthetic_joint(waveforms=s.waveform_dt is not None)

    monkeypatch.setattr(registry, "_simulate", simulate)


def test_list(capsys):
    assert cli.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("joint ")
    assert cli.main(["list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["name"] == "joint"


@pytest.mark.long
def test_list_loads_nothing_heavy():
    code = (
        "import sys; from scenarios.cli import main; main(['list'])\n"
        "print([m for m in ('xarray', 'matplotlib', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.long
def test_run_prints_the_phases_and_writes_everything(fake, capsys, tmp_path):
    assert cli.main(["run", "joint"]) == 0
    out, err = capsys.readouterr()
    assert err == ""  # stderr is no terminal here: no progress bar
    for words in ("design point", "TTSC fault", "shaft speed [r/min]", "k_rf", "kappa", "T4 [K]"):
        assert words in out
    folder = tmp_path / "results" / "joint"
    names = {p.name for p in folder.iterdir()}
    assert {"joint.nc", "summary.json", "fig20_phases.png", "fig25_voltages.png"} <= names
    assert len(names) == 8
    ds = results.load(folder / "joint.nc")
    assert json.loads(ds.attrs["scenario"])["phase"][3]["fault"]["k_rf"] == 20.0


def test_json_is_all_that_is_printed(fake, capsys, tmp_path):
    assert cli.main(["run", "joint", "--json", "--no-figures", "--out", "here"]) == 0
    out = capsys.readouterr().out
    report = json.loads(out)
    assert report["phases"][3]["mu"] == 0.05 and report["phases"][0]["k_rf"] is None
    assert {p.name for p in (tmp_path / "here").iterdir()} == {"joint.nc", "summary.json"}
    assert json.loads((tmp_path / "here" / "summary.json").read_text()) == report


def test_no_waveforms(fake, capsys, tmp_path):
    assert cli.main(["run", "joint", "--no-waveforms", "--no-figures", "--quiet"]) == 0
    assert "time_w" not in results.load(tmp_path / "results" / "joint" / "joint.nc").coords
    assert "written" not in capsys.readouterr().out


def test_progress_bar_goes_to_a_terminal_s_stderr(fake, capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert cli.main(["run", "joint", "--no-figures"]) == 0
    assert "14.00/14 s simulated" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["run", "jont"], "unknown scenario 'jont' (did you mean 'joint'?)"),
        (["run", "none.toml"], "none.toml: scenario file cannot be read"),
        (["run", "joint", "--out", "file/x"], "cannot make the folder for results"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(fake, capsys, tmp_path, argv, message):
    (tmp_path / "file").write_text("")
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("apu: error: ") and message in err
    assert err.count("\n") == 1


def test_usage_errors_and_version(capsys):
    assert cli.main([]) == 2
    assert cli.main(["rnu"]) == 2
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("apu-casadi ")


def test_ctrl_c_in_a_run_waits_for_the_exchange_step(fake, capsys, monkeypatch):
    def simulate(s, progress, solver, phasors):
        signal.raise_signal(signal.SIGINT)  # as if inside the integrator: no exception here
        progress(1.0, 14.0)

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(registry, "_simulate", simulate)
    assert cli.main(["run", "joint"]) == 130
    assert capsys.readouterr().err.startswith("apu: interrupted")
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interruption_says_what_was_written(fake, capsys, monkeypatch):
    """Data and summary stand when the figures are drawn."""
    from scenarios.figures import plotting

    def stopped(*_):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(plotting, "save_figures", stopped)
    assert cli.main(["run", "joint"]) == 130
    assert capsys.readouterr().err == (
        "apu: interrupted; written: results/joint/joint.nc, results/joint/summary.json; run the "
        "same command again\n"
    )


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            "rum",
            "apu: error: argument COMMAND: unknown 'rum' (did you mean 'run'?); see apu --help",
        ),
        (
            "estimate jiont",
            "apu estimate: error: argument ACTION: unknown 'jiont' (did you mean 'jo",
        ),
        (
            "export fmu apuu",
            "apu export fmu: error: argument model: unknown 'apuu' (did you mean 'a",
        ),
        ("linearise --model gass", "argument --model: unknown 'gass' (did you mean 'gas'?)"),
        ("campaign --runs 1.5", "argument --runs: a whole number is expected, got '1.5'"),
        ("trim --power abc", "argument --power: a finite number is expected, got 'abc'"),
        (
            "trim --load kind=R",
            "'key = value, ...' is expected, as TOML has it, words as in kind = ",
        ),
        ("run", "the following arguments are required: SCENARIO; see apu run --help"),
        (
            "run joint --strct",
            "unrecognized arguments: --strct (did you mean '--strict'?); see apu ",
        ),
    ],
)
def test_wrong_usage_is_one_line_with_the_nearest_word(capsys, line, words):
    assert cli.main(line.split()) == 2
    err = capsys.readouterr().err
    assert words in err and err.count("\n") == 1 and " error: " in err


def test_failed_simulation_is_status_1_and_interrupt_130(fake, capsys, monkeypatch):
    def fails(*_):
        raise OperatingPointError("beyond surge at 3.2 s")

    monkeypatch.setattr(registry, "_simulate", fails)
    assert cli.main(["run", "joint"]) == 1
    assert capsys.readouterr().err == "apu: error: beyond surge at 3.2 s\n"

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(registry, "_simulate", interrupted)
    assert cli.main(["run", "joint"]) == 130
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "figures", "left"),
    [
        (["--figures", "run.csv"], "png", ["run.csv"]),
        (["--figures", "svg", "run.csv"], "svg", ["run.csv"]),
        (["--figures", "png,pdf", "run.csv"], "png,pdf", ["run.csv"]),
        (["run.csv", "--figures"], "png", ["run.csv"]),
        (["--figures", "folder/png.csv", "b.csv"], "png", ["folder/png.csv", "b.csv"]),
        (["--figures", "--", "run.csv"], "png", ["run.csv"]),
        (["--figures", "pgn", "run.csv"], "pgn", ["run.csv"]),
        (["--", "--figures", "run.csv"], "png", ["--figures", "run.csv"]),
    ],
)
def test_an_option_with_an_optional_value_takes_no_file_name(words, figures, left):
    args = cli.parser().parse_args(["estimate", "data", *words])
    assert (args.figures, args.files) == (figures, left)


def test_every_optional_value_names_its_words():
    """Else the option would swallow the name of a file that follows it."""

    def parsers(p):
        yield p
        for a in p._actions:
            for q in getattr(a, "choices", None) or ():
                if isinstance(a.choices, dict):
                    yield from parsers(a.choices[q])

    options = [a for p in parsers(cli.parser()) for a in p._actions if a.option_strings]
    asked = [a for a in options if a.nargs in ("?", "*")]
    assert asked and all(getattr(a, "words", ()) for a in asked)
