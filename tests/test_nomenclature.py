"""The page of names says what the code says."""

from pathlib import Path

from apu_casadi.unit.apu import Apu
from scenarios.pages import nomenclature

PAGE = Path(__file__).parents[1] / "docs" / "NOMENCLATURE.md"


def test_the_page_is_what_the_code_generates():
    """One owner of every name, unit and source: the declaration in the code."""
    again = "write it again: python -m scenarios.pages.nomenclature > docs/NOMENCLATURE.md"
    old, new = PAGE.read_text(encoding="utf-8").splitlines(), nomenclature.page().splitlines()
    differ = [(a, b) for a, b in zip(old, new, strict=False) if a != b]
    assert not differ, f"stale from {differ[0][0]!r}, now {differ[0][1]!r}; {again}"
    assert len(old) == len(new), again


def test_every_parameter_is_on_the_page():
    """``Apu.parameters`` lists the names that scenarios may change; none may lack a row."""
    page = PAGE.read_text(encoding="utf-8")
    sections = dict(part.split("`", 2)[1:] for part in page.split("### ") if ": `" in part)
    for key, value in Apu().parameters().items():
        s, _, name = key.partition(".")
        choice = isinstance(value, str) or s not in sections
        where = page if choice else sections[s]
        assert f"`{key if choice else name}`" in where, key


def test_conditions_are_told_in_few_words():
    """A name that appears with an isolated neutral only is told so, whatever the faults there."""
    every = {("R", None, "grounded"), ("R", None, "isolated"), ("R", "leaky", "isolated")}
    assert nomenclature._condition(every, every) == ""
    some = {v for v in every if v[2] == "isolated"}
    assert nomenclature._condition(some, every) == "isolated neutral"


def test_tables_survive_bars_and_stars():
    """GitHub-flavoured Markdown: a bar ends a cell and stars set bold, unless escaped."""
    assert nomenclature.table(("a",), [("n**2 | x",)]).splitlines()[-1] == r"| n\*\*2 \| x |"
