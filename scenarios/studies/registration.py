"""What a study is: its parts, what it claims, its text and its figures, in one file.

A file of :mod:`scenarios.studies.estimation` makes one :class:`Study` and registers the rest with
its decorators::

    STUDY = Study("fitting", order=70, title="Fitting to recorded data", goal="...", text="...")

    @STUDY.part("steady", start=2, each=0.02)
    def steady(n, seed0, tell): ...

    @STUDY.claims
    def claims(r): ...

    @STUDY.section
    def section(r): ...

    @STUDY.figures
    def figures(r): ...

That is all: the command line, the page and the tests find it by its file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import DataError, ScenarioError
from scenarios.shell.markdown import markdown_table
from scenarios.shell.template import Template
from scenarios.studies.fingerprint import constants, digest_of

Tell = Callable[[int, int], None]
"""Called with what is done of a part, and its total, in any unit."""
Run = Callable[[int, int, Tell], Any]
"""(number of seeds, first seed, tell) -> numbers that JSON can hold."""
Pictures = dict[str, tuple[str, Callable[[], Any]]]
"""By caption: name of the file, and what makes the figure."""

DIGITS = 6  # significant digits that are kept of a number
JOINT = "joint"
"""In place of a goal's number: what is asked of the joint run beyond the numbered goals."""


@dataclass(frozen=True)
class Part:
    """One run of a study.

    Args:
        run: see :data:`Run`.
        start, each: expected seconds on one core: once, and for each seed of the study.
        share: seeds of this part over those of the study; None: it has no seeds.
    """

    run: Run
    start: float
    each: float = 0.0
    share: float | None = 1.0

    def seeds(self, n: int) -> int:
        """Return how many of the study's seeds this part takes; two at least, or none."""
        return 0 if self.share is None else max(2, round(self.share * n))

    def seconds(self, n: int) -> float:
        """Return the expected duration with the study's n seeds, s, on one core."""
        return self.start + self.each * n


@dataclass(frozen=True)
class Claim:
    """One line of the table of goals.

    Args:
        goal: number of the goal, or "joint".
        what, target, achieved, interval, seeds: texts.
        met: None where nothing was asked.
        why: the reason, where it was missed.
    """

    goal: int | str
    what: str
    target: str
    achieved: str
    interval: str
    seeds: str
    met: bool | None
    why: str = ""


@dataclass(frozen=True)
class Results(Mapping[str, Any]):
    """Results of a study by part, and the seeds that each was made with.

    Args:
        parts: as they are kept in a record.
    """

    parts: Mapping[str, Mapping[str, Any]]

    def __getitem__(self, part: str) -> Any:
        return self.parts[part]["result"]

    def __iter__(self) -> Iterator[str]:
        return iter(self.parts)

    def __len__(self) -> int:
        return len(self.parts)

    def seeds_from(self, part: str) -> str:
        """Return number and first of a part's seeds, in words."""
        first, n = self.parts[part]["seeds"]
        return f"{n} from {first}"

    def seeds_to(self, part: str) -> str:
        """Return first and last of a part's seeds, in words."""
        first, n = self.parts[part]["seeds"]
        return f"{first} to {first + n - 1}"


@dataclass
class Report:
    """How the results of one study are shown; what nothing is registered for, is empty."""

    claims: Callable[[Results], list[Claim]] = lambda r: []
    section: Callable[[Results], list[str]] = lambda r: []
    figures: Callable[[Results], Pictures] = lambda r: {}


@dataclass
class Study:
    """One study.

    Args:
        name: on the command line, and of its file of results.
        title: heading of its section.
        goal: what is to be shown, with the number.
        text: source of its :class:`Template`; the block ``intro`` says in plain words what is done.
        order: place on the page, ascending.
        modules: whose constants (numbers in capitals) the results depend on: modules or packages,
            by the name under which they are kept.
        seeds, seed0: default number of fresh seeds, and the first of them.
        tuned: on which seeds the filters and thresholds were tuned.
        filters: makes the functions whose equations the results depend on.
        parts: by name, in order; see :meth:`part`.
    """

    name: str
    title: str
    goal: str
    text: str = "@intro\n"
    order: int = 1000
    modules: Mapping[str, Sequence[str]] = field(default_factory=dict)
    seeds: int = 500
    seed0: int = 1000
    tuned: str = "nothing is tuned"
    filters: Callable[[], list[ca.Function]] = list
    parts: dict[str, Part] = field(default_factory=dict)
    report: Report = field(default_factory=Report)

    def __post_init__(self) -> None:
        self.template: Template = Template(self.text)

    def part(
        self, name: str, *, start: float, each: float = 0.0, share: float | None = 1.0
    ) -> Callable[[Run], Run]:
        """Register a part under its name; see :class:`Part`."""

        def register(run: Run) -> Run:
            if name in self.parts:
                raise ScenarioError(f"study {self.name}: part {name!r} is registered twice")
            self.parts[name] = Part(run, start, each, share)
            return run

        return register

    def claims(
        self, function: Callable[[Results], list[Claim]]
    ) -> Callable[[Results], list[Claim]]:
        """Register what is claimed of the results, goal by goal."""
        self.report.claims = function
        return function

    def section(self, function: Callable[[Results], list[str]]) -> Callable[[Results], list[str]]:
        """Register the blocks of text and tables."""
        self.report.section = function
        return function

    def figures(self, function: Callable[[Results], Pictures]) -> Callable[[Results], Pictures]:
        """Register the figures, which are not drawn yet."""
        self.report.figures = function
        return function

    def claim(self, block: str, met: bool, /, **values: Any) -> Claim:
        """Return a claim from a block: goal | what | target | achieved | interval | seeds | why."""
        goal, *texts, why = self.template.cells(block, **values)
        what, target, achieved, interval, seeds = texts
        number = int(goal) if goal.isdigit() else goal
        return Claim(number, what, target, achieved, interval, seeds, met, why)

    def fixed(self) -> dict[str, Any]:
        """Return the constants that the results depend on, by module, and the sensor tables."""
        from estimators.apu.sensors import ELECTRICAL, GAS_PATH

        out = {name: constants(*modules) for name, modules in self.modules.items()}
        if out:
            out["sensors"] = {
                s.name: [s.noise, s.gain] for s in (*GAS_PATH.sensors, *ELECTRICAL.sensors)
            }
        fixed: dict[str, Any] = plain(out)
        return fixed

    def settings(self, part: str, n_seeds: int) -> list[int]:
        """Return first and number of a part's seeds if the study has ``n_seeds``; [] without."""
        n = self.parts[part].seeds(n_seeds)
        return [self.seed0, n] if n else []

    def digest(self) -> str:
        """Return the fingerprint of the filters as the code makes them now."""
        return digest_of(self.filters)


def plain(x: Any) -> Any:
    """Return what JSON holds: numbers with few digits, no NaN, no infinity, no tuples.

    Raises:
        DataError: a value of another type.
    """
    if isinstance(x, Mapping):
        return {str(k): plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [plain(v) for v in x]
    if isinstance(x, bool) or x is None or isinstance(x, int | str):
        return x
    if hasattr(x, "tolist"):
        return plain(x.tolist())
    if isinstance(x, float):
        return float(f"{x:.{DIGITS}g}") if math.isfinite(x) else None
    raise DataError(f"a study returned {type(x).__name__}, which JSON cannot hold")


def series(x: Sequence[float | None]) -> np.ndarray:
    """Return numbers as JSON holds them, None for NaN, as an array."""
    return np.array([np.nan if v is None else v for v in x], float)


def numbers(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose first column holds words and the others numbers."""
    return markdown_table(head, rows, right=range(1, len(head)))
