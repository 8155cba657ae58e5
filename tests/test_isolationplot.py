"""Figures of fault isolation: what is drawn is what was counted."""

import numpy as np
import pytest

from apu_casadi.core.errors import SignalError
from scenarios.figures.isolationplot import plot_confusion, plot_kappa

SCORES = {
    "classes": ["healthy", "a", "b"],
    "confusion": [[9, 1, 0], [0, 10, 0], [2, 0, 6]],
    "kappa": 0.84,
    "kappa_95": [0.63, 0.95],
}
ROWS = [{"value": v, "kappa": k, "kappa_95": [k - 0.1, k + 0.1]} for v, k in ((0.1, 0.9), (1, 0.4))]


def test_counts_stand_in_their_cells():
    fig = plot_confusion([("one", SCORES), ("other", SCORES)], "a note")
    first, second = fig.axes
    cells = {t.get_position(): t.get_text() for t in first.texts}
    assert cells == {(0, 0): "90", (1, 0): "10", (1, 1): "100", (0, 2): "25", (2, 2): "75"}
    assert [t.get_text() for t in first.get_yticklabels()] == SCORES["classes"]
    assert [t.get_text() for t in second.get_yticklabels()] == ["", "", ""]
    assert "0.840" in first.get_title(loc="left")


def test_curves_are_the_rows():
    fig = plot_kappa([("noise", "factor", ROWS)], "a note")
    line = fig.axes[0].lines[-1]
    np.testing.assert_allclose(line.get_xydata(), [[0.1, 0.9], [1, 0.4]])


def test_refusals():
    with pytest.raises(SignalError, match="one to three"):
        plot_confusion([], "")
    with pytest.raises(SignalError, match="no empty row"):
        plot_confusion([("x", {**SCORES, "confusion": np.zeros((3, 3))})], "")
    with pytest.raises(SignalError, match="positive values"):
        plot_kappa([("x", "y", ROWS[:1])], "")
    with pytest.raises(SignalError, match="one to four"):
        plot_kappa([], "")
