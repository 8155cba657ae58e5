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
from apu_casadi.core.files import write_text
from estimators.apu.sensors import ELECTRICAL, GAS_PATH, SensorSet
from scenarios.shell.template import Template
from scenarios.studies import catalogue
from scenarios.studies.kept import understood
from scenarios.studies.registration import JOINT, Claim, Pictures

__all__ = ["claims", "load", "page", "preliminary", "put_summary", "summary", "write"]

IMAGES = "docs/images"
DPI = 120
MARKS = ("<!-- estimation: begin -->", "<!-- estimation: end -->")
"""What the summary in the README stands between."""

TEXT = Template.of("estimation.md")
_ROWS = [row.split(" | ") for row in TEXT.raw("goals").splitlines()]
GOALS = {k: name for k, (name, _) in enumerate(_ROWS, 1)}
ASKED = {k: asked for k, (_, asked) in enumerate(_ROWS, 1)}


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
            catalogue.STUDIES[name].report.claims(catalogue.results(record))
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
            every += catalogue.STUDIES[name].report.claims(catalogue.results(r))
    return sorted(every, key=lambda c: 9 if c.goal == JOINT else int(c.goal))


def sensor_table(sensors: SensorSet) -> str:
    """Return a sensor set as a Markdown table."""
    rows = [
        {
            "name": s.name,
            "noise": f"{100 * s.noise:g} % of the reading"
            if s.relative
            else f"{s.noise:g} {s.unit}",
            "gain": f"{100 * s.gain:g} %" if s.gain else "none",
            "source": s.source,
        }
        for s in sensors.sensors
    ]
    return TEXT.table("sensor", rows, right=())


def _claim_table(found: list[Claim]) -> str:
    said = {None: "", True: "yes", False: "**no**"}
    rows = []
    for c in found:
        goal = f"{c.goal}, {GOALS[c.goal]}" if isinstance(c.goal, int) else c.goal
        rows.append(vars(c) | {"goal": goal, "met": said[c.met]})
    return TEXT.table("claim", rows, right=())


def summary(records: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a short table: for each goal how many claims are met, and the figures."""
    rows = []
    for goal, name in GOALS.items():
        some = [c for c in claims(records) if c.goal == goal and c.met is not None]
        reached = ", ".join(c.achieved if c.met else f"**{c.achieved}**" for c in some)
        counts = {"met": sum(bool(c.met) for c in some), "of": len(some)}
        if some:
            about = {"goal": f"{goal}, {name}", "asked": ASKED[goal], "reached": reached}
            rows.append(about | counts)
    return TEXT.table("summary", rows, right=())


def preliminary(records: Mapping[str, Mapping[str, Any]]) -> str:
    """Say which studies were run with fewer seeds than they ask for; "" if none."""
    few: dict[str, str] = {}
    for name, record in records.items():
        study = catalogue.STUDIES[name]
        for key, part in record["parts"].items():
            asked = study.parts[key].seeds(study.seeds) if key in study.parts else 0
            if part["seeds"] and part["seeds"][1] < asked:
                few.setdefault(name, f"{name} ({part['seeds'][1]} of {asked})")
    return TEXT.text("preliminary", few=", ".join(few.values())) if few else ""


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
    blocks = [TEXT.raw("top"), "## Goals and what was reached", preliminary(records)]
    blocks.append(TEXT.text("met", met=len(asked) - len(missed), asked=len(asked)))
    blocks.append(_claim_table(found))
    if missed:
        why = (
            vars(c) | {"why": f"{c.why[0].upper()}{c.why[1:]}." if c.why else ""} for c in missed
        )
        blocks.append("### What was missed, and why")
        blocks.append("\n".join(TEXT.text("missed", **c) for c in why))
    blocks.append(_not_run([n for n in catalogue.STUDIES if n not in records]))
    for name, record in records.items():
        blocks += _study(name, record, figures[name])
    blocks += [TEXT.raw("sensors"), "Gas path, every 20 ms:", sensor_table(GAS_PATH)]
    blocks += ["Electrical, at 10 kHz:", sensor_table(ELECTRICAL)]
    blocks += [TEXT.raw("peers"), TEXT.raw("how"), _durations(records), TEXT.raw("limits")]
    return "\n\n".join(b for b in blocks if b) + "\n"


def _missed(c: Claim) -> str:
    why = f"{c.why[0].upper()}{c.why[1:]}." if c.why else ""
    return TEXT.text("missed", **{**vars(c), "why": why})


def _not_run(names: list[str]) -> str:
    return TEXT.text("not run", names=", ".join(names)) if names else ""


def _study(name: str, record: Mapping[str, Any], figures: Pictures) -> list[str]:
    study = catalogue.STUDIES[name]
    parts = record["parts"]
    blocks = [f"## {study.title}", f"Goal: {study.goal}", study.template.text("intro")]
    with understood(name):
        blocks += study.report.section(catalogue.results(record))
    blocks += [f"![{text}]({IMAGES}/{file})" for text, (file, _) in figures.items()]
    blocks.append(_not_run([p for p in study.parts if p not in parts]))
    seeds = sorted({tuple(p["seeds"]) for p in parts.values() if p["seeds"]})
    values = {
        "seeds": ", ".join(f"{n} from {first}" for first, n in seeds) or "none",
        "tuned": record.get("tuned", study.tuned),
        "versions": ", ".join(
            f"{k} {v}" for p in list(parts.values())[:1] for k, v in p["versions"].items()
        ),
    }
    return [*blocks, TEXT.text("made", name=name, **values)]


def _durations(records: Mapping[str, Mapping[str, Any]]) -> str:
    rows = []
    for name, record in records.items():
        seconds = {k: p["seconds"] for k, p in record["parts"].items()}
        parts = ", ".join(f"{k} {s:.0f}" for k, s in seconds.items())
        rows.append({"name": name, "seconds": sum(seconds.values()), "parts": parts})
    return TEXT.table("duration", rows, right=())


def pictures(records: Mapping[str, Mapping[str, Any]]) -> dict[str, Pictures]:
    """Return the figures of all records by study, not drawn yet."""
    found = {}
    for name, r in records.items():
        with understood(name):
            found[name] = catalogue.STUDIES[name].report.figures(catalogue.results(r))
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
