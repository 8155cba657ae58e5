"""The validation sections themselves: every row within its tolerance, and honest bookkeeping."""

import math

import pytest

from apu_casadi.core.errors import ScenarioError
from scenarios.validation import comparison
from scenarios.validation.comparison import Row


@pytest.mark.parametrize(
    "name", ["table4", "table5", "table7", "table8", "generator", "conservation"]
)
def test_every_row_is_within_its_tolerance(name):
    """The goals of the tables and checks; ``apu validate`` prints the rows."""
    rows = comparison.run(name)
    short = [f"{r.quantity}: {r.error:+.2e} > {r.tolerance:.0e}" for r in rows if not r.passed]
    assert not short, short
    assert rows


def test_rows_that_were_fitted_are_not_called_predicted():
    """Table 5: what the six map numbers were fitted to is marked calibrated."""
    kinds = {r.quantity: r.kind for r in comparison.run("table5")}
    for fitted in ("W2", "W3", "T3", "P3", "T5", "T8", "HPCSM"):
        assert kinds[fitted] == "calibrated"
    assert kinds["Wf" if "Wf" in kinds else "SFC"] == "predicted"


def test_a_row_with_a_bad_number_does_not_pass():
    """NaN is a failure, not a pass."""
    row = Row("x", "1", 1.0, math.nan, math.nan, 1e-3, "", "predicted")
    assert not row.passed
    with pytest.raises(ScenarioError, match="predicted"):
        Row("x", "1", 1.0, 1.0, 0.0, 1e-3, "", "predictd")


def test_unknown_sections_are_refused_with_the_nearest():
    """A typo is answered with the section meant."""
    with pytest.raises(ScenarioError, match="table5"):
        comparison.run("tabel5")


def test_json_takes_rows_of_numpy_numbers_that_fall_short(monkeypatch, capsys):
    """Peers return NumPy's numbers, and the verdict on them must be Python's."""
    import json

    import numpy as np

    from scenarios import cli

    row = comparison.Row("T4", "K", 1.0, np.float64(1.1), np.float64(0.1), 1e-3, "why", "check")
    assert type(row.passed) is bool and not row.passed
    monkeypatch.setattr(comparison, "sections", lambda: {"x": ("title", lambda: [row])})
    assert cli.main(["validate", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["sections"]["x"][0]["passed"] is False
