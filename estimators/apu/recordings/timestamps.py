"""Time columns of recordings: seconds, dates, clocks and Unix times, all into seconds.

What can be read in one way only is read; a date whose day and month could be exchanged, a clock
that may be hours or minutes, and local times over a change of the clocks are refused with the
option that decides.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.core.units import UNITS, convert, unit_of

__all__ = ["TIMES", "is_time_name", "looks_like_time", "to_seconds"]

#: Names of time columns, in lower case and without blanks, underscores and hyphens.
_NAMED = """
time t timestamp datetime dateandtime timestamps datestamp timeutc utc utctime utcdatetime
datetimeutc timestamputc localtime systemtime unixtime epoch epochtime posixtime ts elapsed
elapsedtime timeelapsed reltime relativetime testtime runtime recordtime seconds secs sec zeit
zeitstempel datum date temps tiempo datumzeit timeofday
"""
_NAMES = tuple(_NAMED.split())
#: Spellings that were always known, tried first.
TIMES = ("time", "Time", "t", "timestamp")

_ISO = re.compile(
    r"\d{4}-?\d{2}-?\d{2}([T ]\d{2}:?\d{2}(:?\d{2}([.,]\d+)?)?)?\s?"
    r"(Z|UTC|[+-]\d{2}:?\d{2}|[+-]\d{2})?",
    re.ASCII,
)
_ZONE = re.compile(r"\d{2}(:?\d{2}([.,]\d+)?)?\s?(Z|UTC|[+-]\d{2}:?\d{2}|[+-]\d{2})$", re.ASCII)
_CLOCK = re.compile(r"(\d+ days? )?-?\d{1,3}:[0-5]\d:[0-5]\d([.,]\d+)?", re.ASCII)
_SHORT_CLOCK = re.compile(r"\d{1,3}:[0-5]\d([.,]\d+)?", re.ASCII)
_YEAR_FIRST = re.compile(r"^(\d{4})[/.](\d{1,2})[/.](\d{1,2})(?!\d)", re.ASCII)
_DATE = re.compile(r"\d{1,4}[./-]\d{1,2}[./-]\d{1,4}", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_YEARS = 6.3e8, 4.2e9  # s, Unix times from 1990 to 2103
Tell = Callable[[str], None]


def is_time_name(name: str) -> bool:
    """Tell whether a column of this name is the time."""
    return re.sub(r"[ _/.\-]", "", name).lower() in _NAMES


def looks_like_time(raw: Any) -> bool:
    """Tell whether a column holds dates, spans or clocks, whatever its name."""
    a = np.asarray(raw)
    if a.dtype.kind in "mM":
        return True
    cells = [c.strip() for c in a[:20] if isinstance(c, str) and c.strip()]
    return bool(cells) and all(
        (_ISO.fullmatch(c) and "-" in c) or _CLOCK.fullmatch(c) or _DATE.match(c) for c in cells
    )


def to_seconds(
    raw: Any,
    unit: str | None,
    what: str,
    tell: Tell,
    *,
    form: str | None = None,
    zone: str | None = None,
) -> np.ndarray:
    """Return times in seconds, NaN where there is none; dates count from the first.

    Args:
        raw: as it stands in the file: numbers, text, dates or spans, shape (K,).
        unit: of numbers; ``"<unit> since <date>"`` too.
        what: file and column, for messages.
        tell: takes one sentence on anything that is not plain seconds.
        form: how dates are written, such as ``"%d.%m.%Y %H:%M:%S"``; decides what is ambiguous.
        zone: of dates without one: ``"UTC"``, ``"Europe/Berlin"``.

    Raises:
        DataError: what can be read in more than one way, or not at all.
    """
    a = np.asarray(raw)
    if a.dtype == object:
        a = _narrowed(a)
    if a.dtype.kind == "m":
        tell(f"{what}: spans of time are taken in seconds")
        return _from_spans(a)
    if a.dtype.kind == "M":
        tell(f"{what}: dates are taken in seconds since the first, {_text(a)}")
        return _from_dates(a)
    if a.dtype == object:
        return _from_text(list(a), what, tell, form, zone)
    if form is not None and a.dtype.kind in "iuf":
        cells = [str(int(v)) if v == int(v) else repr(float(v)) for v in a.tolist()]
        return _formatted(cells, form, what, tell, zone)
    if a.dtype.kind == "b":
        raise DataError(f"{what}: truth values are no times")
    if unit is not None and re.search(r"\bsince\b", str(unit)):
        return _since(a, str(unit), what, tell)
    if unit is None:
        return _plain(a, what, tell)
    return convert(_shifted(a), unit, "s", what) + _first(a, unit, what)


def _first(a: np.ndarray, unit: str, what: str) -> float:
    """What :func:`_shifted` took away, s: nothing where it would cost digits."""
    start = float(a[0]) if a.size and a.dtype.kind in "iu" else 0.0
    seconds = float(convert(np.array(start), unit, "s", what))
    return 0.0 if abs(seconds) > _YEARS[0] else seconds


def _shifted(a: np.ndarray) -> np.ndarray:
    """Return whole numbers from the first on, exactly, others as they are."""
    return (a - a[0]).astype(float) if a.size and a.dtype.kind in "iu" else a.astype(float)


def _narrowed(a: np.ndarray) -> np.ndarray:
    """Return dates, spans or numbers as such where all objects are of one kind."""
    import datetime

    pd: Any = import_module("pandas")

    gaps = (None, pd.NaT, pd.NA)
    there = [c for c in a if not any(c is g for g in gaps)]
    there = [c for c in there if not (isinstance(c, float) and np.isnan(c))]
    if there and all(isinstance(c, datetime.timedelta | np.timedelta64) for c in there):
        return np.asarray(pd.to_timedelta(list(a)).to_numpy())
    if there and all(isinstance(c, datetime.datetime | np.datetime64) for c in there):
        return np.asarray(pd.to_datetime(list(a), utc=True).tz_localize(None).to_numpy())
    if there and all(isinstance(c, datetime.time) for c in there):
        return np.array([None if c is None else c.isoformat() for c in a], dtype=object)
    if there and all(isinstance(c, datetime.date) for c in there):
        return np.asarray(pd.to_datetime(list(a)).to_numpy())
    if there and all(isinstance(c, int | np.integer) for c in there) and len(there) == a.size:
        return a.astype(np.int64)
    try:
        if not any(isinstance(c, str) for c in there):
            return np.array([np.nan if c is None or c is pd.NA else float(c) for c in a])
    except (TypeError, ValueError):
        pass
    return a


def _text(a: np.ndarray) -> str:
    there = a[~np.isnat(a)]
    return str(there[0]) if there.size else "none"


def _from_spans(a: np.ndarray) -> np.ndarray:
    return np.where(np.isnat(a), np.nan, a / np.timedelta64(1, "s"))


def _from_dates(a: np.ndarray) -> np.ndarray:
    there = np.flatnonzero(~np.isnat(a))
    return _from_spans(a - a[there[0]]) if there.size else np.full(a.shape, np.nan)


def _plain(a: np.ndarray, what: str, tell: Tell) -> np.ndarray:
    """Numbers without a unit: seconds, unless they can only be Unix times."""
    v = a.astype(float)
    there = v[np.isfinite(v)]
    if there.size:
        for scale, name in ((1e9, "ns"), (1e6, "us"), (1e3, "ms"), (1.0, "s")):
            low, high = (y * scale for y in _YEARS)
            if low <= there.min() and there.max() <= high:
                tell(
                    f"{what}: {there[0]:.0f} is a Unix time in {name}; taken in seconds since "
                    "the first"
                )
                # two steps, so that no digit of the nanoseconds is lost
                start = a[np.isfinite(v)][0]
                return np.asarray((a - start).astype(float) / scale)
        if there.max() > _YEARS[1]:
            raise DataError(
                f"{what}: unit missing? {there.max():.6g} s are {there.max() / 3.156e7:.3g} years: "
                "give --column time=COLUMN:UNIT with ms, us or ns, or --time-format %Y%m%d%H%M%S"
            )
        _no_calendar(there, what)
    return v


def _no_calendar(there: np.ndarray, what: str) -> None:
    """Refuse seconds that look like dates: 20240331, and the days of a spreadsheet."""
    v = there.astype(np.int64)
    whole = (there == v).all() and there.min() > 19000101 and there.max() < 21001232
    if whole and ((v // 100 % 100 <= 12) & (v % 100 <= 31) & (v % 100 > 0)).all():
        raise DataError(
            f"{what}: {v[0]} may be a date or seconds: give --time-format %Y%m%d, or --column "
            "time=COLUMN:s"
        )
    step = np.median(np.diff(there)) if there.size > 1 else 1.0
    if there.min() > 2e4 and there.max() < 8e4 and 0 < step < 5e-4:
        raise DataError(
            f"{what}: {there[0]:.9g} with steps of {step:.3g} may be days of a spreadsheet or "
            "seconds: give --column time=COLUMN:d or time=COLUMN:s"
        )


def _since(a: np.ndarray, unit: str, what: str, tell: Tell) -> np.ndarray:
    """CF convention, ``milliseconds since 2024-01-01``: the origin does not matter here."""
    name = re.split(r"\bsince\b", unit)[0].strip()
    known = unit_of(name)
    if known is None or UNITS[known][0] != "s":
        raise DataError(f"{what}: {unit!r}: a unit of time is expected before 'since'")
    scale = UNITS[known][1]
    tell(f"{what}: {unit!r}: taken in seconds since the first")
    there = np.flatnonzero(np.isfinite(a.astype(float)))
    return (a - a[there[0]]).astype(float) * scale if there.size else a.astype(float)


def _from_text(
    cells: list[Any], what: str, tell: Tell, form: str | None, zone: str | None
) -> np.ndarray:
    pd: Any = import_module("pandas")

    text = [
        str(c).strip() if c is not None and c is not pd.NaT and c is not pd.NA else ""
        for c in cells
    ]
    text = [
        "" if c.lower() in ("", "nan", "nat", "none", "null", "na", "n/a", "-") else c for c in text
    ]
    # the year first leaves no question
    text = [_YEAR_FIRST.sub(lambda m: f"{m[1]}-{int(m[2]):02d}-{int(m[3]):02d}", c) for c in text]
    there = [c for c in text if c]
    if not there:
        return np.full(len(text), np.nan)
    if form is not None and cells:
        text = [str(c).strip() if c is not None else "" for c in cells]
        return _formatted(text, form, what, tell, zone)
    if all(_NUMBER.fullmatch(c) for c in there):
        tell(f"{what}: text that holds numbers is read as numbers")
        whole = all(re.fullmatch(r"[+-]?\d+", c) for c in text)
        read = int if whole else (lambda c: float(c) if c else np.nan)
        return _plain(np.array([read(c) for c in text]), what, tell)
    if all(_CLOCK.fullmatch(c) for c in there):
        tell(f"{what}: hours:minutes:seconds, {there[0]!r}, are taken in seconds")
        return _from_spans(pd.to_timedelta([c.replace(",", ".") or None for c in text]).to_numpy())
    bad = next((c for c in there if not _ISO.fullmatch(c)), None)
    if bad is None:
        return _iso(text, what, tell, zone)
    if all(_SHORT_CLOCK.fullmatch(c) for c in there):
        raise DataError(
            f"{what}: {there[0]!r} may be hours and minutes or minutes and seconds: give "
            "--time-format %M:%S or %H:%M"
        )
    if _DATE.match(bad):
        raise DataError(
            f"{what}: the order of day and month in {bad!r} is not guessed: give --time-format, "
            "such as %d.%m.%Y %H:%M:%S or %m/%d/%Y %H:%M:%S"
        )
    raise DataError(
        f"{what}: {bad[:40]!r} is no time; seconds, ISO dates (2024-03-31T01:59:58.25Z) and "
        "hh:mm:ss are read; give --time-format for others"
    )


def _iso(text: list[str], what: str, tell: Tell, zone: str | None) -> np.ndarray:
    """ISO 8601 dates, with zones in all or in none."""
    pd: Any = import_module("pandas")

    zoned = [bool(_ZONE.search(c)) for c in text if c]
    if any(zoned) != all(zoned):
        raise DataError(f"{what}: some dates have a zone and some not: write it in all of them")
    clean = [c.replace(",", ".").replace("UTC", "Z").replace(" Z", "Z") or None for c in text]
    try:
        dates = pd.to_datetime(clean, format="ISO8601", utc=all(zoned) or None)
    except (ValueError, OverflowError) as e:
        raise DataError(f"{what}: {str(e).splitlines()[0]}") from None
    return _told(dates, what, tell, zone)


def _formatted(text: list[str], form: str, what: str, tell: Tell, zone: str | None) -> np.ndarray:
    pd: Any = import_module("pandas")

    try:
        dates = pd.to_datetime([c or None for c in text], format=form)
    except (ValueError, OverflowError, TypeError) as e:
        raise DataError(f"{what}: not of the form {form!r}: {str(e).splitlines()[0]}") from None
    return _told(dates, what, tell, zone)


def _told(dates: Any, what: str, tell: Tell, zone: str | None) -> np.ndarray:
    """Seconds since the first date; local times over a change of the clocks need a zone."""
    there = dates[~dates.isna()]
    if dates.tz is None and zone is not None:
        try:
            dates = dates.tz_localize(zone)
        except Exception as e:  # unknown zones and times that do not exist, of many types
            raise DataError(f"{what}: zone {zone!r}: {type(e).__name__}: {e}") from None
        there = dates[~dates.isna()]
    elif dates.tz is None and len(there) > 2:
        step = np.diff(there.to_numpy()) / np.timedelta64(1, "s")
        usual = float(np.median(step))
        jump = np.flatnonzero(np.abs(np.abs(step - usual) - 3600.0) < max(0.5 * abs(usual), 1e-3))
        if usual < 1000.0 and jump.size:
            k = int(jump[0])
            raise DataError(
                f"{what}: from {there[k]} to {there[k + 1]} the clock jumps by an hour beside the "
                f"usual {usual:g} s: summer time? give --time-zone (UTC, Europe/Berlin, ...), or "
                "--steady"
            )
    tell(f"{what}: dates are taken in seconds since the first, {there[0]}")
    if dates.tz is not None:
        dates = dates.tz_convert("UTC").tz_localize(None)
    return _from_dates(dates.to_numpy())
