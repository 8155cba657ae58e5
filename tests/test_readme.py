"""README.md tells the truth: examples run, numbers are computed, links lead somewhere."""

import re
import shlex
from pathlib import Path

import pytest

from apu_casadi.gaspath.maps.mapfiles import shipped, write_map_csv
from scenarios import cli, registry
from scenarios.validation import comparison

HERE = Path(__file__).parents[1]
README = (HERE / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("k", range(len(blocks("python"))))
def test_python_examples_run(k, tmp_path, monkeypatch, capsys):
    """As printed, each alone, in a folder that holds a map file of the name used."""
    monkeypatch.chdir(tmp_path)
    write_map_csv(shipped("axi5"), "my_compressor.csv")
    exec(compile(blocks("python")[k], f"README.md, example {k + 1}", "exec"), {})
    assert capsys.readouterr().out.strip()


def test_the_first_example_is_short():
    """A newcomer reads ten lines or so, not more."""
    lines = [x for x in blocks("python")[0].splitlines() if x.strip()]
    assert len(lines) <= 12


def test_the_scenario_example_is_accepted(tmp_path):
    """Every key of the TOML example is one, and its parameters exist."""
    from apu_casadi.unit.apu import Apu

    path = tmp_path / "my_run.toml"
    path.write_text(blocks("toml")[0], encoding="utf-8")
    s = registry.get(path)
    assert len(s.phases) == 2
    Apu().change(s.parameters)


@pytest.mark.parametrize("label", ["run", "test"])
def test_there_is_one_command_of_each_kind(label):
    """Continuous integration takes the commands from here, by these marks."""
    found = re.findall(rf"<!-- command: {label} -->\n```sh\n(.*)\n```\n", README)
    assert len(found) == 1
    assert "-c constraints.txt" in found[0]


@pytest.mark.parametrize("table", ["4", "5", "8"])
def test_the_accuracy_table_is_what_validate_computes(table):
    """Mean and largest error of the predicted rows, to the two digits printed."""
    errors = [abs(r.error) for r in comparison.run(f"table{table}") if r.kind == "predicted"]
    row = next(x for x in README.splitlines() if x.startswith(f"| {table}, "))
    mean, largest = sum(errors) / len(errors), max(errors)
    assert f"| {len(errors)} predicted | {mean:.1e} | {largest:.1e} |" in row


def test_the_commands_of_the_table_exist():
    """Every ``apu`` line of the README is accepted by the parser (nothing is run)."""
    page = (HERE / "docs/how-to/commands.md").read_text(encoding="utf-8")
    lines = set(re.findall(r"`apu ([^`]*)`", README + page)) - {"COMMAND --help", "measure"}
    assert len(lines) >= 6
    for line in lines:
        assert cli.parser().parse_args(shlex.split(line))


def test_every_subcommand_is_in_the_readme():
    """A command nobody is told of is not there."""
    from importlib import import_module

    from scenarios import commands

    missing = [
        name
        for module in commands.MODULES
        if f"`apu {(name := import_module(module).NAME)}" not in README
    ]
    assert not missing, f"not in the command table of README.md: {', '.join(missing)}"


def test_links_and_pictures_exist():
    """Relative links point to files; pictures stay below 300 kB."""
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", README):
        path = HERE / target
        assert path.exists(), f"README.md links to {target}"
        if path.suffix == ".png":
            assert path.stat().st_size < 300_000, f"{target} is too large"
