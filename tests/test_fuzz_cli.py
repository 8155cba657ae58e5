"""Random wrong command lines, and surroundings that a command does not expect.

Every line holds something that is certainly wrong, so that none may succeed, and each must end with
one sentence and status 1 or 2.  ``FUZZ_SEED`` sets the first seed, ``FUZZ_CASES`` the number.
"""

import argparse
import os
import random
import subprocess
import sys

import pytest

from scenarios import cli

SEED = int(os.environ.get("FUZZ_SEED", "0"))
CASES = int(os.environ.get("FUZZ_CASES", "150"))

NO_NUMBER = ("nan", "inf", "-inf", "abc", "", "1e999", "0x10", "1,5", "5 kW", "²", "None", "--")
NO_NAME = (
    "", ".", "..", "nope", "nope.toml", "folder.toml", "empty.toml", "binary.toml", "loop.toml",
    "secret.toml", "a" * 300, "\udcff.toml", "é.nc", "/etc/passwd", "binary.csv", "folder.nc", "-1",
)  # fmt: skip


def commands(parser=None, words=()):
    """Yield (words, parser) of every command and sub-command, as the command line has them."""
    parser = parser or cli.parser()
    inner = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    if not inner:
        yield words, parser
    for action in inner:
        for name, p in action.choices.items():
            yield from commands(p, (*words, name))


ALL = list(commands())


def slip(rng, option):
    """Return an option with a letter lost, doubled or added: no longer one of ours."""
    k = rng.randrange(3, len(option))
    return rng.choice((option[:k] + option[k + 1 :], option[:k] + option[k - 1 :], option + "s"))


def wrong_line(rng):
    """Return a command line with at least one certain mistake."""
    words, parser = rng.choice(ALL)
    options = [a for a in parser._actions if a.option_strings and a.dest != "help"]
    known = {o for a in options for o in a.option_strings}
    argv = list(words)
    for a in parser._actions:
        if not a.option_strings:
            argv.append(rng.choice(NO_NAME))
    numbers = [a for a in options if a.type in (int, float)]
    if numbers and rng.random() < 0.6:
        option = rng.choice(numbers).option_strings[0]
        argv.append(f"{option}={rng.choice(NO_NUMBER)}")
    else:
        text = slip(rng, rng.choice(sorted(known))) if known else "--nope"
        argv.append(text if text not in known and not text.startswith("--no") else "--nope")
    for a in rng.sample(options, min(2, len(options))):
        argv += [a.option_strings[0]] if a.nargs == 0 else [f"{a.option_strings[0]}=1"]
    return argv


@pytest.fixture
def odd_files(tmp_path, monkeypatch):
    """A folder of files that nobody can use."""
    monkeypatch.chdir(tmp_path)
    for ending in ("toml", "csv", "nc"):
        (tmp_path / f"folder.{ending}").mkdir()
        (tmp_path / f"empty.{ending}").write_bytes(b"")
        (tmp_path / f"binary.{ending}").write_bytes(bytes(range(256)))
        (tmp_path / f"loop.{ending}").symlink_to(f"loop.{ending}")
        (tmp_path / f"secret.{ending}").touch(mode=0)


def refused(argv, capsys, seed):
    """Run a wrong line: a status that says so, and one sentence."""
    status = cli.main(argv)
    err = capsys.readouterr().err
    told = f"seed {seed}: apu {' '.join(map(repr, argv))}: status {status}, {err[-300:]!r}"
    assert status in (1, 2), told
    assert "error: " in err and len(err.partition("error: ")[2]) > 12, told
    assert "Errno" not in err and "object at 0x" not in err, told


@pytest.mark.long
def test_wrong_lines_are_refused(odd_files, capsys):
    for seed in range(SEED, SEED + CASES):
        refused(wrong_line(random.Random(seed)), capsys, seed)


@pytest.mark.slow  # some minutes: the same as above, twenty times as many
def test_many_wrong_lines_are_refused(odd_files, capsys):
    for seed in range(SEED + 10_000, SEED + 10_000 + 20 * CASES):
        refused(wrong_line(random.Random(seed)), capsys, seed)


@pytest.mark.long
@pytest.mark.parametrize(("words", "parser"), ALL, ids=[" ".join(w) for w, _ in ALL])
def test_no_option_may_be_abbreviated(words, parser, capsys):
    """What is short for one option today may be another's name tomorrow."""
    known = {o for a in parser._actions for o in a.option_strings if o.startswith("--")}
    for option in known:
        if option[:-1] not in known and option[:-1] != "--no-figure":
            assert cli.main([*words, option[:-1]]) == 2, option
            assert "error: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["run", "joint", "--jso"], "unrecognized arguments: --jso (did you mean '--json'?)"),
        (["identify", "--eta-bias=--"], "argument --eta-bias: a value is expected, got '--'"),
        (["deck", "--mach", "0:1e9:1000000000000"], "1000000000000 points asked for, 5000000"),
        (["deck", "--mach", "0:inf:3"], "values must be finite"),
        (["deck", "--altitude", "0:1:5000", "--mach", "0:1:5000"], "275000000 points asked for"),
        (["deck", "--threads", "99999"], "--threads must be 1 to 1024, got 99999"),
        (["study", "trim", "--points", "9" * 15], "--points must be 1 to 10000000, got 99999"),
        (["campaign", "--runs", "9" * 20], "--runs must be 1 to 1000000, got 99999"),
        (["identify", "--trials", "9" * 20], "--trials must be 0 to 1000000, got 99999"),
        (["identify", "--prior", "inf"], "--prior: a finite number is expected, got 'inf'"),
        (["trim", "--load", "1e5", "--voltage=nan"], "a finite number is expected, got 'nan'"),
        (["trim", "--load", "1e5", "--voltage=-5"], "--voltage must be > 0, got -5"),
    ],
)  # fmt: skip
def test_messages(odd_files, capsys, argv, message):
    assert cli.main(argv) == 2
    assert message in capsys.readouterr().err


# ------------------------------------------------------------------ surroundings

APU = f"{sys.executable} -m scenarios.cli"
SURROUNDINGS = {
    "stdout closed": (f"{APU} list >&-", {0}),
    "stderr closed": (f"{APU} deck --altitude 0 --mach 0 --power 2e5 2>&-", {0}),
    "all closed": (f"{APU} list <&- >&- 2>&-", {0}),
    "error, stderr closed": (f"{APU} run nope 2>&-", {2}),
    "stdout full": (f"{APU} list --json > /dev/full", {2}),
    "help to a full stdout": (f"{APU} run --help > /dev/full", {2}),
    "stderr full": (f"{APU} run nope 2> /dev/full", {2}),
    "reader gone": (f"{APU} list | true; exit ${{PIPESTATUS[0]}}", {0}),
    "ascii": (f"PYTHONIOENCODING=ascii {APU} estimate sensors", {0}),
    "ascii help": (f"PYTHONIOENCODING=ascii {APU} fit --help", {0}),
    "one column": (f"COLUMNS=1 {APU} run --help", {0}),
    "no environment": (f"env -i {APU} list", {0}),
    "folder removed": (f"mkdir gone; cd gone; rmdir ../gone; {APU} run nope.toml", {2}),
    "few files": (f"ulimit -n 12; {APU} list", {0, 1, 2}),
    "unknown screens": (f"MPLBACKEND=nope {APU} linearise --model gas --out lin", {0}),
    "target full": (f"{APU} deck --altitude 0 --mach 0 --power 2e5 --out /dev/full", {2}),
}


@pytest.mark.long
@pytest.mark.parametrize("name", list(SURROUNDINGS))
def test_surroundings(tmp_path, name):
    """Streams that are closed or full, encodings, and what else a shell can do to a command."""
    if "/dev/full" in SURROUNDINGS[name][0] and not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full here")
    command, allowed = SURROUNDINGS[name]
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode in allowed, done.stderr[-500:]
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr


def test_a_message_stays_readable(tmp_path, monkeypatch, capsys):
    """A damaged file may hold a word of any length; beginning and end tell what is wrong."""
    monkeypatch.chdir(tmp_path)
    head = "point,role,name,value,sigma"
    (tmp_path / "points.csv").write_text(f"{head}\na,fixed,{'x' * 100_000},1,\n")
    assert cli.main(["calibrate", "points.csv"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("apu: error: points.csv: a: fixed 'xxx") and len(err) < 1300
    assert "xxx' is unknown (valid: N, PW" in err and " ... " in err


def test_an_unforeseen_error_is_a_sentence_with_its_place(tmp_path):
    """In a process of its own; from Python it is raised, and a variable brings the traceback."""
    code = (
        "import sys; from scenarios import cli\n"
        "from scenarios.commands import list as c\n"
        "def run(args): raise ZeroDivisionError('by hand')\n"
        "c.run = run\n"
        "sys.argv = ['apu', 'list']; sys.exit(cli.main())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("apu: error: ZeroDivisionError: by hand (")
    assert "APU_TRACEBACK=1" in done.stderr and done.stderr.count("\n") == 1
    env = {**os.environ, "APU_TRACEBACK": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert done.returncode == 1 and "Traceback" in done.stderr
