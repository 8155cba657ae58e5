"""ESTIMATION.md is what the kept results say, and says what was missed."""

from pathlib import Path

import numpy as np
import pytest

from apu_casadi.core.errors import DataError, SignalError
from scenarios.figures.studyplot import plot_consistency, plot_coverage, plot_null, plot_rate
from scenarios.pages import estimation_page
from scenarios.studies import catalogue

HERE = Path(__file__).parents[1]
KEPT = HERE / "docs" / "estimation"


@pytest.fixture(scope="module")
def records():
    return estimation_page.load(KEPT)


def test_the_page_is_what_the_results_say(records):
    """``apu estimate page --write ESTIMATION.md``, from the numbers that are kept."""
    written = (HERE / "ESTIMATION.md").read_text(encoding="utf-8")
    assert estimation_page.page(records) == written


def test_every_figure_of_the_page_is_there(records):
    names = [
        file for group in estimation_page.pictures(records).values() for file, _ in group.values()
    ]
    assert len(names) == len(set(names)) >= 6
    for name in names:
        path = HERE / "docs" / "images" / name
        assert path.exists() and path.stat().st_size < 300_000, name


def test_every_study_has_a_report():
    for name, study in catalogue.STUDIES.items():
        assert study.template.text("intro"), name
        nothing = type(study.report)()
        assert study.report.claims is not nothing.claims, name
        assert study.report.section is not nothing.section, name


def test_every_missed_goal_has_a_reason(records):
    for c in estimation_page.claims(records):
        assert c.met is None or c.met or c.why, c.what


def test_goals_are_sorted(records):
    goals = [c.goal for c in estimation_page.claims(records)]
    numbers = [g for g in goals if isinstance(g, int)]
    assert numbers == sorted(numbers) and goals[: len(numbers)] == numbers


def test_a_part_that_was_not_run_is_named(records):
    """An interrupted study still makes a page."""
    name, record = next(iter(records.items()))
    text = estimation_page.page({name: record | {"parts": {}}})
    assert "Not run yet" in text
    for study in catalogue.STUDIES.values():
        assert study.report.claims({}) == [] and study.report.section({}) == []


def test_nothing_kept_is_an_error(tmp_path):
    with pytest.raises(DataError, match="apu estimate study all"):
        estimation_page.load(tmp_path)


def test_figures_refuse_what_does_not_fit():
    with pytest.raises(SignalError, match="one to four"):
        plot_consistency([], "")
    with pytest.raises(SignalError, match="wrong: a"):
        plot_consistency([("head", [1, 2], {"a": [1.0]}, None, {})], "")
    with pytest.raises(SignalError, match="one to three"):
        plot_null([], "", ylabel="")
    with pytest.raises(SignalError, match="same quantities"):
        plot_coverage({"a": {"x": (0.9, 0.8, 1.0)}, "b": {}}, "", goal=(0.9, 1.0), level=0.95)
    with pytest.raises(SignalError, match="hours"):
        plot_rate(np.arange(2), np.arange(2), np.arange(2), 0.0, 6, 1, "")


def test_the_readme_has_the_short_table(records):
    """``apu estimate page --readme docs/how-to/estimate.md`` puts it there."""
    text = (HERE / "docs/how-to/estimate.md").read_text(encoding="utf-8")
    assert estimation_page.put_summary(text, records) == text
    with pytest.raises(DataError, match="no place"):
        estimation_page.put_summary("nothing", records)
