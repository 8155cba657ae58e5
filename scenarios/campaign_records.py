"""The records of a campaign's runs, kept in a file line by line, and checked when they are read.

A line is the first 16 digits of the SHA-256 of a JSON text, a blank, and that text: the record of
one run.  A line that was cut short or changed fails its sum; a record with a valid sum that is none
(a wrong type, a missing quantity) counts as damaged too.  Neither stops a campaign: it tells how
many there are, and their runs are made again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from apu_casadi.core.errors import DataError
from apu_casadi.gaspath.health import HEALTH

RUNS = "runs.jsonl"
STATUS = ("done", "refused", "failed", "invalid", "crashed")
"""What became of a run: refused, no steady start; failed, the simulation stopped; invalid, a wrong
scenario or parameter; crashed, an unforeseen error or the loss of the process."""

_COLUMNS = f"""
start end window N_rpm PW_kW Wf SFC T3 P3_kPa T4 T5 SM_percent V_a_rms V_b_rms V_c_rms I_a_rms
I_b_rms I_c_rms P_e P_loss_fault N_rpm_min N_rpm_max T4_max SM_percent_min
{" ".join(HEALTH)} mu k_rf kappa h
"""
COLUMNS = tuple(_COLUMNS.split())
"""Numbers of :func:`apu_casadi.core.runsummary.phase_summary` that are kept of each phase."""
OF_EACH = tuple(
    c for c in COLUMNS if c[:2] in ("V_", "I_", "P_") or c in ("mu", "k_rf", "kappa", "h")
)
"""Those of a generator."""
_MAY_BE_NONE = {"k_rf", "kappa"}  # healthy
_log = logging.getLogger("apu_casadi")


def line(record: Mapping[str, Any]) -> bytes:
    """Return a record as it stands in the file."""
    text = json.dumps(record, sort_keys=True).encode()
    return _sum(text) + b" " + text + b"\n"


def _sum(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest()[:16].encode()


def wrong(record: Mapping[str, Any], name: str, phases: int) -> str:
    """Return what keeps a record from being that of a run ``name`` with so many phases, or ""."""
    if record.get("name") != name:
        return f"name {record.get('name')!r}, {name!r} expected"
    if record.get("status") not in STATUS:
        return f"status {record.get('status')!r}"
    if not isinstance(record.get("reason"), str):
        return f"reason {record.get('reason')!r}"
    seconds = record.get("seconds")
    if not _number(seconds) and not (record["status"] == "crashed" and _is_nan(seconds)):
        return f"seconds {seconds!r}"
    if record["status"] != "done":
        return ""
    if not _number(record.get("residual")):
        return f"residual {record.get('residual')!r}"
    texts, lost = record.get("warnings"), record.get("exchange_error")
    if not isinstance(texts, list) or not all(isinstance(w, str) for w in texts):
        return f"warnings {texts!r}"
    if not _number(lost) and not _is_nan(lost):  # not a number: not estimated
        return f"exchange_error {lost!r}"
    rows = record.get("phases")
    if not isinstance(rows, list) or len(rows) != phases:
        return f"phases: {phases} rows expected"
    for k, row in enumerate(rows):
        if not isinstance(row, dict) or not isinstance(row.get("name"), str):
            return f"phase {k}: no row with a name"
        for c in COLUMNS:
            for own in each(row) if c in OF_EACH else [row]:
                value = own.get(c, math.nan)
                if not (_number(value) or (value is None and c in _MAY_BE_NONE)):
                    return f"phase {k}: {c} {own.get(c)!r}"
    return ""


def kept(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is kept of a phase's summary."""
    made = {k: row[k] for k in ("name", *COLUMNS) if k in row}
    if "generators" in row:
        made["generators"] = [{k: one[k] for k in OF_EACH} for one in row["generators"]]
    return made


def each(row: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the numbers of each generator that differs, or once those of all."""
    rows = row.get("generators", [row])
    return rows if isinstance(rows, list) and all(isinstance(r, dict) for r in rows) else [{}]


def _number(x: object) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x)


def _is_nan(x: object) -> bool:
    return isinstance(x, float) and math.isnan(x)


def read(path: Path, asked: Mapping[str, tuple[str, int]]) -> dict[str, dict[str, Any]]:
    """Return the sound records of a file by key; the file loses its damaged lines.

    Args:
        path: of the file, which need not exist.
        asked: name and number of phases of the runs that are wanted, by key; lines with other keys
            belong to other campaigns and stay as they are.

    Raises:
        DataError: the file cannot be read.
    """
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        return {}
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror or e}") from None
    found: dict[str, dict[str, Any]] = {}
    sound, damaged, first = [], 0, ""
    for n, text in enumerate(raw.splitlines(), 1):
        if not text:
            continue
        record, why = _parsed(text, asked)
        if why:
            damaged += 1
            first = first or f"line {n}: {why}"
            continue
        sound.append(text + b"\n")
        if record["key"] in asked:
            found[record["key"]] = record
    if damaged:
        lines = "line" if damaged == 1 else "lines"
        told = "%s: %d damaged %s left out (%s); their runs are made again"
        _log.warning(told, path, damaged, lines, first)
        _rewrite(path, b"".join(sound))
    return found


def _parsed(text: bytes, asked: Mapping[str, tuple[str, int]]) -> tuple[dict[str, Any], str]:
    """Return the record of a line, and what is wrong with it or ""."""
    total, _, body = text.partition(b" ")
    if _sum(body) != total:
        return {}, "its sum is wrong"
    try:
        record = json.loads(body)
    except (ValueError, RecursionError):
        return {}, "no JSON"
    key = record.get("key") if isinstance(record, dict) else None
    if not isinstance(key, str):
        return {}, "no record of a run"
    return record, wrong(record, *asked[key]) if key in asked else ""


def _rewrite(path: Path, data: bytes) -> None:
    """Replace the file; where that is impossible it stays, damaged lines and all."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


@contextlib.contextmanager
def appending(path: Path, *, fresh: bool) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Yield a function that appends a record to the file, whole or not at all.

    Args:
        path: of the file.
        fresh: begin with an empty one.

    Raises:
        DataError: the file cannot be written (by the function too).
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
    try:
        f = os.fdopen(os.open(path, flags | (os.O_TRUNC if fresh else 0), 0o666), "r+b", 0)
    except OSError as e:
        raise DataError(f"{path}: cannot be written: {e.strerror or e}") from None

    def write(record: Mapping[str, Any]) -> None:
        _append(f, path, line(record))

    with f:
        size = os.fstat(f.fileno()).st_size
        if size:
            f.seek(size - 1)
            if f.read(1) != b"\n":
                _append(f, path, b"\n")  # the rest of a line that was cut short stays alone
        yield write


def _append(f: Any, path: Path, data: bytes) -> None:
    """Append; where the disk has no room, take back the part that found some."""
    size = os.fstat(f.fileno()).st_size
    try:
        done = 0
        while done < len(data):
            done += f.write(data[done:])
    except OSError as e:
        with contextlib.suppress(OSError):
            f.truncate(size)
        raise DataError(
            f"{path}: cannot be written: {e.strerror or e}; the runs in it are kept, the same "
            "command goes on with them"
        ) from None
