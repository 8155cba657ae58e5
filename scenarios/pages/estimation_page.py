"""The page ``ESTIMATION.md``, made from the kept results by ``apu estimate page``.

The same numbers give the same page: nothing is run, and no time of day enters.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apu_casadi.core import files
from apu_casadi.core.errors import DataError
from estimators.apu.sensors import ELECTRICAL, GAS_PATH, SensorSet
from scenarios.pages.reports import JOINT, REPORTS, Claim, Pictures
from scenarios.shell.markdown import markdown_table, write_text
from scenarios.studies import catalogue
from scenarios.studies.kept import understood

__all__ = [
    "claims",
    "load",
    "page",
    "preliminary",
    "put_summary",
    "sensor_table",
    "summary",
    "write",
]

IMAGES = "docs/images"
DPI = 120
GOALS = {
    1: "correctness", 2: "efficiency", 3: "consistency", 4: "shaft power", 5: "detection",
    6: "isolation", 7: "fitting", 8: "speed",
}  # fmt: skip

_TOP = """# Estimation

Made by `apu estimate page --write ESTIMATION.md` from the numbers in `docs/estimation`; do not
edit. How well health factors, short circuits and their confidence are estimated, against goals that
were set before: each on fresh random seeds, with filters, noise levels and thresholds fixed in code
and tuned on other seeds. What falls short is printed with its reason.
"""

_SENSORS = """## Sensors

Standard deviations (1 sigma) that all studies use; `apu estimate sensors` prints them. Noise is
white; a gain error is a constant relative error that is drawn anew for each run. Another table is
made with `SensorSet.change`.
"""

_HOW = """## How to reproduce

    pip install .
    apu estimate joint                    # one joint run: summary, data, figure
    apu estimate sensors                  # the tables above
    apu estimate study NAME               # one study, into docs/estimation/NAME.json
    apu estimate study all                # all that is not kept with the same seeds and constants
    apu estimate study all --seeds 20     # quickly, into results/estimation if --out says so
    apu estimate page --write ESTIMATION.md

A study is written part by part and can be interrupted; what is done is not run again unless
`--again` is given. Seconds on one core with the default number of seeds:
"""

_LIMITS = """## Limits of validity

- All data are simulated. The mismatched truths differ from the filters' models as stated (other
  integrators, steps, inertia, gas data, maps, kappa, gain errors, unbalance); a real machine also
  differs in ways that nobody wrote down: saturation, slot harmonics, heat soak, sensor lags.
- Sensor noise is white and Gaussian, gain errors are constant. The 1-sigma tables are from the
  literature where it has them, assumed elsewhere; every conclusion moves with them.
- Electrical severities are h = mu/(k_rf + 1 - mu) with full coupling (kappa = mu). mu and k_rf are
  reported as a ridge; where kappa > mu they can be separated, but only by a filter that is told
  kappa.
- Bounds are posterior Cramer-Rao bounds, averaged over some of the trajectories for the gas path.
- Health factors walk slowly and jump by a few per cent; the jump test has its false alarms by
  construction of its threshold, not by a fit to the data shown.
- A unit without history is only known by the priors of wear and gain errors; no method isolates
  faults that lie inside them.
"""


def load(folder: str | Path) -> dict[str, dict[str, Any]]:
    """Return the records of all studies that are kept in a folder, by name.

    Raises:
        DataError: there is none, or a file cannot be read.
    """
    found = {
        name: catalogue.read(s, folder)
        for name, s in catalogue.STUDIES.items()
        if catalogue.path_of(s, folder).exists()
    }
    if not found:
        raise DataError(f"{os.fspath(folder)}: no results; apu estimate study all makes them")
    for name, record in found.items():
        try:
            REPORTS[name].claims(catalogue.results(record))
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as e:
            raise DataError(
                f"{catalogue.path_of(catalogue.STUDIES[name], folder)}: damaged: its results "
                f"cannot be read ({type(e).__name__}: {e}); run the study with --again"
            ) from None
    return found


def claims(records: Mapping[str, Mapping[str, Any]]) -> list[Claim]:
    """Return all claims, sorted by goal."""
    every: list[Claim] = []
    for name, r in records.items():
        with understood(name):
            every += REPORTS[name].claims(catalogue.results(r))
    return sorted(every, key=lambda c: 9 if c.goal == JOINT else int(c.goal))


def sensor_table(sensors: SensorSet) -> str:
    """Return a sensor set as a Markdown table."""
    return markdown_table(
        ("signal", "noise, 1 sigma", "gain error, 1 sigma", "source"),
        [
            (
                s.name,
                f"{100 * s.noise:g} % of the reading" if s.relative else f"{s.noise:g} {s.unit}",
                f"{100 * s.gain:g} %" if s.gain else "none",
                s.source,
            )
            for s in sensors.sensors
        ],
    )


def _met(c: Claim) -> str:
    return "" if c.met is None else "yes" if c.met else "**no**"


def _first_table(found: list[Claim]) -> str:
    rows = [
        (f"{c.goal}, {GOALS[c.goal]}" if isinstance(c.goal, int) else str(c.goal), c.what, c.target,
         c.achieved, c.interval, c.seeds, _met(c))
        for c in found
    ]  # fmt: skip
    head = ("goal", "what", "target", "achieved", "interval, remark", "seeds", "met")
    return markdown_table(head, rows)


ASKED = {
    1: "linear models: largest difference <= 1e-9",
    2: "RMSE over bound <= 1.2, mismatched 1.5",
    3: "NEES and NIS in their 95 % bands at >= 90 % of checkpoints",
    4: "shaft power takes >= 50 % off the error, with efficiency bias >= 30 %",
    5: "h = 1e-4 in 20 periods, 3e-4 in 50; <= 1 false alarm an hour",
    6: "Cohen's kappa >= 0.8",
    7: "95 % intervals cover 93 to 97 %",
    8: "EKF step <= 5 us, UKF <= 20 us, 14 s joint in <= 5 s",
}
MARKS = ("<!-- estimation: begin -->", "<!-- estimation: end -->")
"""What the summary in the README stands between."""


def summary(records: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a short table: for each goal how many claims are met, and the figures."""
    rows = []
    for goal, name in GOALS.items():
        some = [c for c in claims(records) if c.goal == goal and c.met is not None]
        if some:
            rows.append((
                f"{goal}, {name}", ASKED[goal], f"{sum(bool(c.met) for c in some)} of {len(some)}",
                ", ".join(c.achieved if c.met else f"**{c.achieved}**" for c in some),
            ))  # fmt: skip
    return markdown_table(("goal", "asked", "met", "reached (bold: missed)"), rows)


def preliminary(records: Mapping[str, Mapping[str, Any]]) -> str:
    """Say which studies were run with fewer seeds than they ask for; "" if none."""
    few: dict[str, str] = {}
    for name, record in records.items():
        study = catalogue.STUDIES[name]
        for key, part in record["parts"].items():
            asked = study.parts[key].seeds(study.seeds) if key in study.parts else 0
            if part["seeds"] and part["seeds"][1] < asked:
                few.setdefault(name, f"{name} ({part['seeds'][1]} of {asked})")
    if not few:
        return ""
    return "**Preliminary**: run with fewer seeds than asked for: " + ", ".join(few.values()) + "."


def put_summary(text: str, records: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a text with the summary between :data:`MARKS`.

    Raises:
        DataError: the marks are not there.
    """
    begin, end = MARKS
    head, found, rest = text.partition(begin)
    _, closed, tail = rest.partition(end)
    if not (found and closed):
        raise DataError(f"no place for the summary: {begin} and {end} expected")
    blocks = [b for b in (summary(records), preliminary(records)) if b]
    return "\n".join([f"{head}{begin}", "\n\n".join(blocks), f"{end}{tail}"])


def page(records: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the page, from the records of :func:`load`."""
    figures = pictures(records)
    found = claims(records)
    asked = [c for c in found if c.met is not None]
    missed = [c for c in asked if not c.met]
    blocks = [_TOP.strip(), "## Goals and what was reached"]
    if preliminary(records):
        blocks.append(preliminary(records))
    blocks.append(f"{len(asked) - len(missed)} of {len(asked)} met.")
    blocks.append(_first_table(found))
    if missed:
        blocks.append("### What was missed, and why")
        blocks.append("\n".join(
            f"- {c.what}: {c.achieved} where {c.target} is asked. {_sentence(c.why)}"
            for c in missed
        ))  # fmt: skip
    absent = [n for n in catalogue.STUDIES if n not in records]
    if absent:
        blocks.append("Not run yet: " + ", ".join(absent) + ".")
    for name, record in records.items():
        blocks += _study(name, record, figures[name])
    blocks += [
        _SENSORS.strip(), "Gas path, every 20 ms:", sensor_table(GAS_PATH),
        "Electrical, at 10 kHz:", sensor_table(ELECTRICAL), _HOW.strip(), _durations(records),
        _LIMITS.strip(),
    ]  # fmt: skip
    return "\n\n".join(blocks) + "\n"


def _sentence(text: str) -> str:
    return "" if not text else f"{text[0].upper()}{text[1:]}."


def _study(name: str, record: Mapping[str, Any], figures: Pictures) -> list[str]:
    study, report = catalogue.STUDIES[name], REPORTS[name]
    parts = record["parts"]
    blocks = [f"## {study.title}", f"Goal: {study.goal}", report.intro]
    with understood(name):
        blocks += report.section(catalogue.results(record))
    blocks += [f"![{text}]({IMAGES}/{file})" for text, (file, _) in figures.items()]
    absent = [p for p in study.parts if p not in parts]
    if absent:
        blocks.append("Not run yet: " + ", ".join(absent) + ".")
    seeds = sorted({tuple(p["seeds"]) for p in parts.values() if p["seeds"]})
    said = ", ".join(f"{n} from {first}" for first, n in seeds) or "none"
    versions = next(iter(parts.values()))["versions"] if parts else {}
    blocks.append(
        f"Seeds: {said}; {record.get('tuned', study.tuned)}. Constants and all numbers: "
        f"[docs/estimation/{name}.json](docs/estimation/{name}.json). Made with "
        + ", ".join(f"{k} {v}" for k, v in versions.items()) + "."
    )  # fmt: skip
    return blocks


def _durations(records: Mapping[str, Mapping[str, Any]]) -> str:
    rows = []
    for name, record in records.items():
        parts = record["parts"]
        rows.append((
            f"`apu estimate study {name}`", f"{sum(p['seconds'] for p in parts.values()):.0f}",
            ", ".join(f"{k} {p['seconds']:.0f}" for k, p in parts.items()),
        ))  # fmt: skip
    return markdown_table(("command", "s", "of which"), rows)


def pictures(records: Mapping[str, Mapping[str, Any]]) -> dict[str, Pictures]:
    """Return the figures of all records by study, not drawn yet."""
    found = {}
    for name, r in records.items():
        with understood(name):
            found[name] = REPORTS[name].figures(catalogue.results(r))
    return found


def write(path: str | os.PathLike[str], records: Mapping[str, Mapping[str, Any]]) -> list[Path]:
    """Write page and figures (in ``docs/images`` beside it); return the paths."""
    path = Path(path)
    out = path.parent / IMAGES
    made = [write_text(path, page(records))]
    for name, group in pictures(records).items():
        for file, figure in group.values():
            with understood(name):
                drawn = figure()
            made.append(files.save_figure(drawn, out / file, dpi=DPI))
    return made
