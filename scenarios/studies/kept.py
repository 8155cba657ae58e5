"""What is kept of the estimation studies is checked when it is read, part by part.

A part says what its numbers were when they were written (a sum of its JSON); one that does not fit
it, or is no part at all, is left out and told, so that it is run again.  Parts that were kept
before there were sums count as they are.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from apu_casadi.core import files
from apu_casadi.core.errors import DataError

_log = logging.getLogger("apu_casadi")


def signed(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return a part with its sum."""
    bare = {k: v for k, v in part.items() if k != "sum"}
    return {**bare, "sum": _sum(bare)}


def _sum(part: Mapping[str, Any]) -> str:
    text = json.dumps(part, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read(path: Path, name: str) -> dict[str, Any] | None:
    """Return the record of a study with its sound parts; None where there is no file.

    Raises:
        DataError: the file cannot be read, or does not hold the study ``name``.
    """
    if not path.exists():
        return None
    text = files.read_text(path, "study")
    try:
        record = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as e:
        raise DataError(f"{path}: cannot be read as a study: {e}") from None
    if not isinstance(record, dict) or record.get("study") != name:
        raise DataError(f"{path} does not hold the study {name!r}")
    for key in ("fixed", "parts"):
        if not isinstance(record.get(key), dict):
            raise DataError(f"{path}: no table {key!r}; remove the file to make the study anew")
    for key, part in list(record["parts"].items()):
        why = _wrong(part)
        if why:
            _log.warning("%s: part %r is left out: %s; it is to be run again", path, key, why)
            del record["parts"][key]
    return record


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def _wrong(part: Any) -> str:
    """Return what is wrong with a part, or ""."""
    if not isinstance(part, dict):
        return "no table"
    kinds = (("seeds", list), ("seconds", int | float), ("versions", dict))
    for key, kind in kinds:
        if not isinstance(part.get(key), kind):
            return f"its {key} are {part.get(key)!r}"
    if len(part["seeds"]) not in (0, 2) or not all(type(n) is int for n in part["seeds"]):
        return f"its seeds are {part['seeds']!r}"
    if "result" not in part:
        return "it has no result"
    try:
        sound = "sum" not in part or signed(part)["sum"] == part["sum"]
    except ValueError:  # NaN, which JSON does not have
        sound = False
    return "" if sound else "its numbers are not those that were written"


@contextlib.contextmanager
def understood(name: str) -> Iterator[None]:
    """Say so where what is kept of a study is not of the form that its report reads."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as e:
        if isinstance(e, DataError):
            raise
        raise DataError(
            f"study {name}: what is kept is not what this version writes ({type(e).__name__}: "
            f"{e}); apu estimate study {name} --again makes it anew"
        ) from e
