"""Pages of the documentation: examples run, commands exist, links lead somewhere."""

import re
import shlex
from pathlib import Path

import pytest

from scenarios import cli, registry

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [p for folder in ("tutorials", "how-to") for p in sorted((DOCS / folder).glob("*.md"))]
PAGES += [DOCS / name for name in ("index.md", "theory.md", "citing.md", "limits.md")]
MADE = ("made/", "../made/")  # by docs/site_parts.py, when the site is built


def blocks(page, language):
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def test_there_are_pages():
    assert len([p for p in PAGES if p.parent.name == "tutorials"]) >= 5


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=lambda p: p.stem)
def test_examples_run(page, tmp_path, monkeypatch, capsys):
    """One after the other, as a reader would type them."""
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for k, code in enumerate(blocks(page, "python")):
        exec(compile(code, f"{page.name}, example {k + 1}", "exec"), names)
    assert capsys.readouterr().out.strip()


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_commands_are_accepted(page):
    """Every ``apu`` line is one that the parser takes; nothing is run."""
    lines = [x for b in blocks(page, "sh") for x in b.splitlines()]
    lines += re.findall(r"`(apu [^`]*)`", page.read_text(encoding="utf-8"))
    for line in lines:
        words = shlex.split(line.partition("#")[0])
        if words[:1] == ["apu"] and len(words) > 2 and words[1] != "COMMAND":
            cli.parser().parse_args(words[1:])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_links_lead_somewhere(page):
    """Files beside the page, except those that are made with the site."""
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if not target.startswith((*MADE, "http")):
            assert (page.parent / target).exists(), target


def test_files_of_the_tutorials_are_accepted(tmp_path):
    """The scenario as a scenario, the engine as an engine."""
    from apu_casadi.unit.enginefile import read_unit

    (tmp_path / "mine.toml").write_text(blocks(DOCS / "tutorials/five-minutes.md", "toml")[0])
    assert len(registry.get(tmp_path / "mine.toml").phases) == 2
    (tmp_path / "my_unit.toml").write_text(blocks(DOCS / "tutorials/own-engine.md", "toml")[0])
    engine = read_unit(tmp_path / "my_unit.toml")
    assert engine.unit.gas_generator.design.values["PW"] > 50e3


def test_every_module_has_a_page_of_the_api(monkeypatch):
    """Packages name what is in them, with the first line of each; nothing private is there."""
    import apu_casadi

    monkeypatch.syspath_prepend(str(DOCS))
    import site_api

    root = Path(apu_casadi.__file__).parents[1]
    known = site_api.modules(root)
    assert len(known) > 400 and {*site_api.PACKAGES, "apu_casadi.core.cf"} < {*known}
    assert not [n for n in known if "._" in n or "__init__" in n]
    assert {n.rpartition(".")[0] for n in known} - {*known} == {""}
    faults = site_api.page("apu_casadi.machine.faults", known)
    assert ":doc:`apu_casadi.machine.faults.ttsc`\n     - Turn-to-turn short circuit" in faults
    inner = {n for n in known if n.startswith("apu_casadi.machine.faults.")}
    assert {*re.findall(r"^   ([\w.]+)$", faults, re.M)} == inner
