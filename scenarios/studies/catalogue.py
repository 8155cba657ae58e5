"""The estimation studies by name: running them, keeping what is done, and reading it again.

Every file of :mod:`scenarios.studies.estimation` is one study.  A study has parts.  Each part is
written as soon as it is done, so that an interruption loses one part and no more; a part that was
run with the same seeds and the same constants is not run again.

>>> from scenarios.studies import catalogue
>>> catalogue.run("correctness", "results", n_seeds=20)  # doctest: +SKIP
"""

from __future__ import annotations

import dataclasses
import json
import platform
import re
import time
from collections.abc import Callable, Mapping
from enum import StrEnum
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.files import write_text
from scenarios.shell.locking import locked
from scenarios.studies import estimation, kept
from scenarios.studies.registration import Results, Study, plain

__all__ = ["STUDIES", "State", "get", "other_code", "pending", "read", "results", "run", "states"]

PACKAGES = ("apu-casadi", "casadi", "numpy", "scipy", "filterpy")


def walk() -> dict[str, Study]:
    """Return the study of each file of the folder, in the order of the page."""
    found = (import_module(f"{estimation.__name__}.{n}").STUDY for n in estimation.files())
    return {s.name: s for s in sorted(found, key=lambda s: (s.order, s.name))}


STUDIES: dict[str, Study] = walk()
"""All studies by name, in the order of the page."""


def get(name: str) -> Study:
    """Return a study.

    Raises:
        ParameterError: unknown name; the nearest is named.
    """
    if name not in STUDIES:
        raise ParameterError(f"unknown study {name!r} {nearest(name, STUDIES)}")
    return STUDIES[name]


# ------------------------------------------------------------------------------ what is kept


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that the numbers depend on."""
    out = {"Python": platform.python_version()}
    for p in PACKAGES:
        try:
            out[p] = version(p)
        except PackageNotFoundError:
            continue
    return out


def path_of(study: Study, folder: str | Path) -> Path:
    """Return where a study is kept."""
    return Path(folder) / f"{study.name}.json"


def read(study: Study, folder: str | Path) -> dict[str, Any]:
    """Return the kept record of a study: ``fixed`` constants, and by part settings and ``result``.

    An empty record if there is none; damaged parts are left out, and told.

    Raises:
        DataError: the file cannot be read, or is none of ours.
    """
    record = kept.read(path_of(study, folder), study.name)
    return {"study": study.name, "fixed": {}, "parts": {}} if record is None else record


def results(record: Mapping[str, Any]) -> Results:
    """Return the results of a record by part."""
    return Results(record["parts"])


class State(StrEnum):
    """What a kept part is worth today."""

    FRESH = "made with these seeds, constants and filters"
    MISSING = "not run"
    CONSTANTS = "made with other constants"
    SEEDS = "made with other seeds"
    CODE = "made with other code"
    UNKNOWN = "not known whether made with this code"


PENDING = (State.MISSING, State.CONSTANTS, State.SEEDS)
"""States of parts that are run again.  One that was made with other code is only told: a change of
the code may well leave the numbers as they are."""


def states(
    study: Study, record: Mapping[str, Any], n_seeds: int | None = None, *, code: bool = True
) -> dict[str, State]:
    """Return what the parts of a record are worth: the one place that decides what is stale.

    Args:
        study: as it is now.
        record: of :func:`read`.
        n_seeds: that are asked for, of all parts; None: whatever they are, of the kept parts.
        code: whether to compare the filters' equations, which takes a second or two.
    """
    fixed = n_seeds is None or _holds(record["fixed"], study.fixed())

    def state(name: str) -> State:
        part = record["parts"].get(name)
        if part is None:
            return State.MISSING
        if not fixed:
            return State.CONSTANTS
        asked = None if n_seeds is None else study.settings(name, n_seeds)
        if asked is not None and part["seeds"] != asked:
            return State.SEEDS
        if not code:
            return State.FRESH
        if "code" not in part or part["versions"].get("casadi") != versions().get("casadi"):
            return State.UNKNOWN
        return State.FRESH if part["code"] == study.digest() else State.CODE

    names = study.parts if n_seeds is not None else record["parts"]
    return {name: state(name) for name in names}


def _holds(made: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether no constant has another value.

    A name that came or went is a change of code, which the filters' fingerprint is for; but a
    module of which no name is left is another one.
    """
    if made.keys() != now.keys():
        return False
    for module, names in made.items():
        common = names.keys() & now[module].keys()
        if (names and not common) or any(names[n] != now[module][n] for n in common):
            return False
    return True


def pending(study: Study, folder: str | Path, n_seeds: int) -> list[str]:
    """Return the parts that are not kept in ``folder`` with these seeds and today's constants."""
    found = states(study, read(study, folder), n_seeds, code=False)
    return [name for name in study.parts if found[name] in PENDING]


def from_seed(study: Study, seed0: int | None) -> Study:
    """Return the study with another first seed; None: as it is."""
    return study if seed0 is None else dataclasses.replace(study, seed0=seed0)


def parts_with(study: Study, words: str | None) -> list[str]:
    """Return the parts whose names contain one of some words, which commas part; None: all.

    Raises:
        ParameterError: no part has a word; the nearest name is told.
    """
    if words is None:
        return list(study.parts)
    asked = [w.strip() for w in words.split(",") if w.strip()]
    for w in asked or [""]:
        if not w or not any(w in name for name in study.parts):
            raise ParameterError(f"study {study.name}: no part {w!r} {nearest(w, study.parts)}")
    return [name for name in study.parts if any(w in name for w in asked)]


def other_code(study: Study, record: Mapping[str, Any]) -> str:
    """Say which parts of a record were made with other filters than the code makes now; or ""."""
    found = states(study, record)
    remedy = {State.CODE: " (--again makes it anew)", State.UNKNOWN: ""}
    said = []
    for state, more in remedy.items():
        parts = [name for name in record["parts"] if found[name] is state]
        if parts:
            named = "all parts" if len(parts) == len(record["parts"]) else ", ".join(parts)
            said.append(f"{state}: {named}{more}")
    return "; ".join(said)


# ------------------------------------------------------------------------------ running

Progress = Callable[[str, float, float], None]
"""Called with the part in work, the expected seconds done, and their total."""


def run(
    name: str,
    folder: str | Path,
    *,
    n_seeds: int | None = None,
    seed0: int | None = None,
    only: str | None = None,
    again: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run what is pending of a study, write each part when it is done, return the record.

    While another process runs the study in the folder this one waits, and takes over its parts.

    Args:
        name: of the study.
        folder: where ``NAME.json`` is kept.
        n_seeds: fresh seeds; the study's own number by default.
        seed0: the first of them; the study's own by default.
        only: parts whose names contain one of these words; see :func:`parts_with`.
        again: run all parts, kept or not.
        progress: see :data:`Progress`.

    Raises:
        ParameterError: unknown study, fewer than two seeds.
        DataError: the folder cannot be used.
    """
    study = from_seed(get(name), seed0)
    n = study.seeds if n_seeds is None else n_seeds
    if n < 2:
        raise ParameterError(f"a study of {n} seeds says nothing: 2 at least")
    some, tell = parts_with(study, only), progress or (lambda *_: None)
    with locked(Path(folder), f"{name}.lock"):
        return _run(study, folder, n, some, again=again, progress=tell)


def _run(
    study: Study, folder: str | Path, n: int, some: list[str], *, again: bool, progress: Progress
) -> dict[str, Any]:
    todo = some if again else [p for p in pending(study, folder, n) if p in some]
    record, fixed = read(study, folder), study.fixed()
    if not _holds(record["fixed"], fixed):
        record["parts"] = {}
    total = sum(study.parts[p].seconds(n) for p in todo)
    done = 0.0
    for key in todo:
        part = study.parts[key]

        def tell(k: int, of: int, key: str = key, done: float = done) -> None:
            progress(key, done + study.parts[key].seconds(n) * min(k / max(of, 1), 1.0), total)

        tell(0, 1)
        began = time.perf_counter()
        result = plain(part.run(part.seeds(n), study.seed0, tell))
        record["parts"][key] = kept.signed(
            {
                "seeds": study.settings(key, n),
                "seconds": round(time.perf_counter() - began, 1),
                "versions": versions(),
                "code": study.digest(),
                "result": result,
            }
        )
        about: dict[str, Any] = {"study": study.name, "title": study.title, "goal": study.goal}
        about |= {"tuned": study.tuned, "fixed": fixed}
        parts = {k: record["parts"][k] for k in study.parts if k in record["parts"]}
        record = {**about, "parts": parts}
        write_text(path_of(study, folder), _text(record))
        done += part.seconds(n)
        progress(key, done, total)
    return record


def _text(record: Mapping[str, Any]) -> str:
    """Return a record as JSON, its lists of numbers on one line each."""
    text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
    lists = r"\[\s+([^\[\]{}]*?)\s+\]"
    return re.sub(lists, lambda m: "[" + re.sub(r"\s*\n\s*", " ", m[1]) + "]", text) + "\n"
