"""Validation rows: what the package says beside what somebody else says.

A *section* is a function that returns :class:`Row` objects; ``apu validate`` runs them and prints
each row with its error, its tolerance, the reason for the tolerance, and whether the number is an
input, was calibrated, is predicted, or is a numerical check between two routes.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources

from apu_casadi.core.errors import ApuError, DataError, ScenarioError, nearest
from scenarios.shell.registered import Registry

KINDS = ("input", "calibrated", "predicted", "check")


class SkippedError(ApuError):
    """A section cannot run here; the message says what it needs."""


@dataclass(frozen=True)
class Row:
    """One comparison.

    Args:
        quantity, unit: what is compared; ``unit`` in the reference's own units.
        reference, ours: the two values; for a check, ``reference`` is the target of the error.
        error: relative error, or the error that the check defines.
        tolerance: largest acceptable abs(error); infinite where nothing is asked.
        reason: why this tolerance.
        kind: one of ``KINDS``.
    """

    quantity: str
    unit: str
    reference: float
    ours: float
    error: float
    tolerance: float
    reason: str
    kind: str

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ScenarioError(f"row kind {self.kind!r} {nearest(self.kind, KINDS)}")

    @property
    def passed(self) -> bool:
        """Whether the error is a number within the tolerance."""
        return bool(math.isfinite(self.error) and abs(self.error) <= self.tolerance)


Section = Callable[[], list[Row]]
SECTIONS: Registry[tuple[str, Section]] = Registry(
    "scenarios.validation", "validation section", scripts=("dpsim_run", "pycycle_run")
)


def section(name: str, title: str, order: float) -> Callable[[Section], Section]:
    """Register a section under a short name; ``order`` is its place on the page, ascending."""

    def register(function: Section) -> Section:
        SECTIONS.add(name, order, (title, function))
        return function

    return register


def sections() -> dict[str, tuple[str, Section]]:
    """Return every section as ``{name: (title, function)}``, in the order of the page."""
    return SECTIONS.all()


def run(name: str) -> list[Row]:
    """Run one section.

    Raises:
        ScenarioError: no section of that name.
        SkippedError: it needs a program that is not installed.
    """
    known = sections()
    if name not in known:
        raise ScenarioError(f"no validation section {name!r} {nearest(name, known)}")
    return known[name][1]()


def reference(table: str) -> list[dict[str, str]]:
    """Read a published table from ``scenarios/reference``.

    Raises:
        DataError: no such table.
    """
    path = resources.files("scenarios").joinpath("reference", f"{table}.csv")
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(f"no reference table {table!r}") from None
    return list(csv.DictReader(x for x in text.splitlines() if not x.startswith("#")))


def relative(ours: float, reference: float) -> float:
    """Relative error; the difference itself where the reference is zero."""
    return (ours - reference) / abs(reference) if reference else ours - reference


def compared(
    what: str, unit: str, reference: float, ours: float, tolerance: float, reason: str, kind: str
) -> Row:
    """Return the row of two values with their relative error."""
    return Row(what, unit, reference, ours, relative(ours, reference), tolerance, reason, kind)


def check(what: str, error: float, tolerance: float, reason: str) -> Row:
    """Return the row of an error that a check defines, relative."""
    return Row(what, "1", 0.0, error, error, tolerance, reason, "check")


def timing(what: str, unit: str, value: float) -> Row:
    """Return the row of a time, of which nothing is asked."""
    return Row(what, unit, math.nan, value, 0.0, math.inf, "a timing is no test", "check")


def mean_row(rows: list[Row], what: str, tolerance: float, reason: str) -> Row:
    """Summarise: the mean absolute error of ``rows``."""
    m = sum(abs(r.error) for r in rows) / len(rows)
    return check(f"mean of {len(rows)} {what} rows", m, tolerance, reason)
