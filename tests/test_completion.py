"""Completion of the command line in shells, and pages as text for a terminal."""

import shutil
import subprocess

import pytest

from scenarios import cli
from scenarios.commands import validate
from scenarios.shell import completing, terminal, usage
from scenarios.validation.comparison import Row

KNOWN = {"SCENARIO": ["joint", "quiet"], "--engine": ["aps5000"]}


@pytest.fixture(scope="module")
def nodes():
    return completing.tree(cli.parser(), KNOWN)


@pytest.fixture(scope="module")
def bash(nodes, tmp_path_factory):
    path = tmp_path_factory.mktemp("shell") / "apu.bash"
    path.write_text(completing.script("bash", nodes))
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["ca"], {"calibrate", "campaign"}),
        (["run", "j"], {"joint"}),
        (["run", "joint", "--sol"], {"--solver"}),
        (["run", "joint", "--style", ""], {"colour", "grey"}),
        (["trim", "--engine", ""], {"aps5000"}),
        (["dataset", "ma"], {"make"}),
        (["export", "c", "--che"], {"--check"}),
    ],
)
def test_bash_completes(bash, words, found):
    call = 'COMP_WORDS=(apu "$@"); COMP_CWORD=$#; _apu; printf "%s\\n" "${COMPREPLY[@]}"'
    line = f"source {bash}; {call}"
    done = subprocess.run(["bash", "-c", line, "bash", *words], capture_output=True, text=True)
    assert set(done.stdout.split()) == found, done.stderr


@pytest.mark.parametrize("shell", completing.SHELLS)
def test_every_command_and_option_is_in_every_script(nodes, shell):
    text = completing.script(shell, nodes)
    of = {"fish": "-l {}"}.get(shell, "--{}")
    for n in nodes:
        assert all(name in text for name in n.subs)
        assert all(of.format(o[2:]) in text for o in n.options if o.startswith("--"))
    if shutil.which(shell):
        done = subprocess.run([shell, "-n"], input=text, capture_output=True, text=True)
        assert done.returncode == 0 and not done.stderr


def test_an_unknown_option_before_the_command_is_named(capsys):
    assert cli.main(["--verison"]) == 2
    assert "did you mean '--version'" in capsys.readouterr().err


PAGE = """# A page

Of [words](x.md) and `code`, which are **many** and go on until the line is full and more.

| paper | what | effect |
| --- | --- | --- |
| (7) | `L` and a cell that is far too long to stand beside the others on one line | a<br>b |

| load | kW |
| --- | --- |
| open | 0.2 |

- one
- two
"""


def test_a_page_is_plain_text_of_the_terminals_width():
    text = terminal.plain(PAGE, 50)
    assert max(map(len, text.splitlines())) <= 50
    assert not set("|`*#<") & set(text)
    assert "A page\n======" in text and "Of words and code" in text
    assert "(7)\n  what:   L and a cell" in text and "  effect: a\n          b" in text
    assert "load  kW\n--------\nopen  0.2" in text and "- one\n\n- two" in text


def test_validation_fits_the_terminal():
    reason = "a reason of many words " * 6
    rows = [Row("T3", "K", 1.0, 1.0, 0.0, 1e-3, reason.strip(), "predicted")]
    assert reason.strip() in validate.table(rows)
    for width in (80, 100, 140):
        lines = validate.table(rows, width).splitlines()
        assert max(map(len, lines)) <= width
        assert " ".join(" ".join(lines).split()).count("of many words") == 6
    numbers = (221.8215, 221.82, 1e-5, 1e-4)
    rows.append(Row("mean of 15 rows that are", "kg/(kW.h)", *numbers, "w", "check"))
    lines = validate.table(rows, 80).splitlines()
    assert max(map(len, lines)) <= 80 and "check, tolerance 1e-04: w" in lines[-1]
    rows.append(Row("a quantity of very many words " * 4, "1", *numbers, "w", "check"))
    lines = validate.table(rows, 80).splitlines()
    assert max(map(len, lines)) <= 80 and lines[-2].endswith("ok")
    assert " ".join(lines).count("very") == 4
    assert "a quantity of very many words " * 4 in validate.table(rows)


def test_help_fits_the_terminal_and_examples_stay(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    words = " ".join(["paragraph"] * 12)
    help_of = usage.Help("apu")
    text = help_of._fill_text(f"Title.\n\n{words}\n\n    apu {words}", 78, "")
    broken, example = text.split("\n\n")[1:]
    assert max(map(len, broken.splitlines())) <= 80 and " ".join(broken.split()) == words
    assert example == f"    apu {words}"
    assert help_of._fill_text(words, 118, "") == words
