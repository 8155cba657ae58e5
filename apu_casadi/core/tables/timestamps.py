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

__all__ = [
    "TIMES",
    "Start",
    "date_and_clock",
    "is_time_name",
    "looks_like_time",
    "may_be_time",
    "to_seconds",
    "unit_in_name",
]

#: Names of time columns, in lower case and without blanks, underscores and hyphens.
_NAMED = """
time timew t timestamp datetime dateandtime timestamps datestamp timeutc utc utctime utcdatetime
datetimeutc timestamputc localtime systemtime unixtime epoch epochtime posixtime ts elapsed
elapsedtime timeelapsed reltime relativetime testtime runtime recordtime seconds secs sec zeit
zeitstempel datum date temps tiempo datumzeit timeofday
"""
_NAMES = tuple(_NAMED.split())
#: Words of a name that may be the time, where the column rises or holds times.
_WORDS = "time timestamp date datetime zeit uhrzeit datum epoch elapsed stamp temps tiempo"
_TOKENS = frozenset(_WORDS.split())
#: Spellings that were always known, tried first.
TIMES = ("time", "Time", "t", "timestamp")

_ISO = re.compile(
    r"\d{4}-?\d{2}-?\d{2}([T ]\d{2}:?\d{2}(:?\d{2}([.,]\d+)?)?)?\s?"
    r"(Z|UTC|[+-]\d{2}:?\d{2}|[+-]\d{2})?",
    re.ASCII,
)
_ZONE = re.compile(r"\d{2}(:?\d{2}([.,]\d+)?)?\s?(Z|UTC|[+-]\d{2}:?\d{2}|[+-]\d{2})$", re.ASCII)
_CLOCK = re.compile(
    r"(\d+ days? )?-?\d{1,3}:[0-5]\d:[0-5]\d([.,]\d+)?( ?[aApP]\.?[mM]\.?)?", re.ASCII
)
_HALF_DAY = re.compile(r" ?([aApP])\.?[mM]\.?$")
_MONTH = re.compile(r"(?i)(?<![a-z])(jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*")
#: Ways of writing dates that cannot be mistaken, for pandas; a fraction of the second may follow.
_FORMS = """
%d-%b-%Y %H:%M:%S
%d %b %Y %H:%M:%S
%b %d %Y %H:%M:%S
%b %d, %Y %H:%M:%S
%a, %d %b %Y %H:%M:%S %z
%a %b %d %H:%M:%S %Y
%d-%b-%Y %I:%M:%S %p
%d %b %Y %I:%M:%S %p
%b %d, %Y %I:%M:%S %p
%d/%b/%Y:%H:%M:%S %z
%d/%b/%Y %H:%M:%S
%Y-%jT%H:%M:%S
%Y-%jT%H:%M:%S%z
%d-%b-%Y
%d %b %Y
"""
_DAYS = {
    "a spreadsheet": (2e4, 8e4),
    "MATLAB": (7.1e5, 7.7e5),
    "the Julian calendar": (2.4e6, 2.5e6),
}
_ROUND = (1, 2, 5, 10, 15, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21600, 43200, 86400)
_SHORT_CLOCK = re.compile(r"\d{1,3}:[0-5]\d([.,]\d+)?", re.ASCII)
_YEAR_FIRST = re.compile(r"^(\d{4})[/.](\d{1,2})[/.](\d{1,2})(?!\d)", re.ASCII)
_DATE = re.compile(r"\d{1,4}[./-]\d{1,2}[./-]\d{1,4}", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_YEARS = 6.3e8, 4.2e9  # s, Unix times from 1990 to 2103
Tell = Callable[[str], None]
#: First instant, and whether it is in UTC.
Start = tuple[np.datetime64, bool]


def is_time_name(name: str) -> bool:
    """Tell whether a column of this name is the time."""
    return re.sub(r"[ _/.\-]", "", name).lower() in _NAMES


def unit_in_name(name: str) -> str | None:
    """Return the unit of time that a name ends with or is: ``TimeMs``, ``msec``, ``Hours``."""
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name) or [""]
    unit = unit_of(words[-1].lower()) if len(words[-1]) > 1 else None
    return unit if unit is not None and UNITS[unit][0] == "s" else None


def may_be_time(name: str) -> bool:
    """Tell whether a name has a word in it that names a time: ``LogTime``, ``time since start``."""
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    return any(w.lower() in _TOKENS for w in words)


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
    start: list[Start] | None = None,
    utc: bool = False,
) -> np.ndarray:
    """Return times in seconds, NaN where there is none; dates count from the first.

    Args:
        raw: as it stands in the file: numbers, text, dates or spans, shape (K,).
        unit: of numbers; ``"<unit> since <date>"`` too.
        what: file and column, for messages.
        tell: takes one sentence on anything that is not plain seconds.
        form: how dates are written, such as ``"%d.%m.%Y %H:%M:%S"``; decides what is ambiguous.
        zone: of dates without one: ``"UTC"``, ``"Europe/Berlin"``.
        start: takes the first instant where there are dates, and whether it is in UTC.
        utc: whether dates, no text, are in UTC.

    Raises:
        DataError: what can be read in more than one way, or not at all.
    """
    a = np.asarray(raw)
    start = [] if start is None else start
    if a.dtype == object:
        utc = utc or any(getattr(c, "tzinfo", None) is not None for c in a)
        a = _narrowed(a)
    if a.dtype.kind == "m":
        tell(f"{what}: spans of time are taken in seconds")
        return _from_spans(a)
    if a.dtype.kind == "M":
        if zone is not None and not utc:
            return _told(import_module("pandas").DatetimeIndex(a), what, tell, zone, start)
        tell(f"{what}: dates are taken in seconds since the first, {_text(a)}")
        return _from_dates(a, start, utc)
    if a.dtype == object:
        return _from_text(list(a), what, tell, form, zone, start)
    if form is not None and a.dtype.kind in "iuf":
        cells = [str(int(v)) if v == int(v) else repr(float(v)) for v in a.tolist()]
        return _formatted(cells, form, what, tell, zone, start)
    if a.dtype.kind == "b":
        raise DataError(f"{what}: truth values are no times")
    if unit is not None and re.search(r"\bsince\b", str(unit)):
        return _since(a, str(unit), what, tell, zone, start)
    if unit is None:
        return _plain(a, what, tell, start)
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


def _from_dates(a: np.ndarray, start: list[Start], zoned: bool) -> np.ndarray:
    there = np.flatnonzero(~np.isnat(a))
    if there.size:
        start.append((a[there[0]].astype("datetime64[ns]"), zoned))
    return _from_spans(a - a[there[0]]) if there.size else np.full(a.shape, np.nan)


def _plain(a: np.ndarray, what: str, tell: Tell, start: list[Start]) -> np.ndarray:
    """Numbers without a unit: seconds, unless they can only be Unix times."""
    v = a.astype(float)
    there = v[np.isfinite(v)]
    if there.size:
        for scale, name in ((1e9, "ns"), (1e6, "us"), (1e3, "ms"), (1.0, "s")):
            low, high = (y * scale for y in _YEARS)
            if low <= there.min() and there.max() <= high:
                tell(
                    f"{what}: {there[0]:.0f} is a Unix time in {name}; taken in seconds since "
                    f"the first, {np.datetime64(int(there[0] / scale), 's')}"
                )
                # two steps, so that no digit of the nanoseconds is lost
                first = a[np.isfinite(v)][0]
                ns = int(first) * int(1e9 / scale) + int(float(first) % 1 * 1e9 / scale)
                start.append((np.datetime64(ns, "ns"), True))
                return np.asarray((a - first).astype(float) / scale)
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
    step = float(np.median(np.diff(there))) if there.size > 1 else 1.0
    near = np.abs(step * 86400 / np.array(_ROUND) - 1).min() < 5e-3
    dated = re.search(r"(?i)dat[eu]", what.rpartition("column ")[2]) is not None
    for of, (low, high) in _DAYS.items():
        fine = 0 < step < 5e-4 or (0 < step < 1 and near) or (step >= 1 and dated)
        if low < there.min() and there.max() < high and fine:
            raise DataError(
                f"{what}: {there[0]:.9g} with steps of {step:.3g} may be days of {of} or "
                "seconds: give --column time=COLUMN:d or time=COLUMN:s"
            )


def _since(
    a: np.ndarray, unit: str, what: str, tell: Tell, zone: str | None, start: list[Start]
) -> np.ndarray:
    """CF convention, ``milliseconds since 2024-01-01``: the origin does not matter here."""
    name, origin = (part.strip() for part in re.split(r"\bsince\b", unit, maxsplit=1))
    known = unit_of(name)
    if known is None or UNITS[known][0] != "s":
        raise DataError(f"{what}: {unit!r}: a unit of time is expected before 'since'")
    scale = UNITS[known][1]
    tell(f"{what}: {unit!r}: taken in seconds since the first")
    there = np.flatnonzero(np.isfinite(a.astype(float)))
    if there.size:
        start.extend(_origin(origin, float(a[there[0]]) * scale, zone, what))
    return (a - a[there[0]]).astype(float) * scale if there.size else a.astype(float)


def _origin(text: str, seconds: float, zone: str | None, what: str) -> list[Start]:
    """The date that many seconds after the one of a CF unit, if that is an ISO date."""
    pd: Any = import_module("pandas")

    try:
        date = pd.to_datetime(text.replace("UTC", "Z").replace(" Z", "Z"), format="ISO8601")
    except (ValueError, OverflowError):
        return []
    first = pd.DatetimeIndex([date + pd.to_timedelta(seconds, "s")])
    first = _localised(first, what, zone) if first.tz is None and zone is not None else first
    return [(_in_utc(first).astype("datetime64[ns]")[0], first.tz is not None)]


def _localised(dates: Any, what: str, zone: str) -> Any:
    try:
        return dates.tz_localize(zone)
    except Exception as e:  # unknown zones and times that do not exist, of many types
        raise DataError(f"{what}: zone {zone!r}: {type(e).__name__}: {e}") from None


def _in_utc(dates: Any) -> np.ndarray:
    dates = dates if dates.tz is None else dates.tz_convert("UTC").tz_localize(None)
    return np.asarray(dates.to_numpy())


def _from_text(
    cells: list[Any],
    what: str,
    tell: Tell,
    form: str | None,
    zone: str | None,
    start: list[Start],
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
        return _formatted(text, form, what, tell, zone, start)
    if all(_NUMBER.fullmatch(c) for c in there):
        tell(f"{what}: text that holds numbers is read as numbers")
        whole = all(re.fullmatch(r"[+-]?\d+", c) for c in text)
        read = int if whole else (lambda c: float(c) if c else np.nan)
        return _plain(np.array([read(c) for c in text]), what, tell, start)
    if all(_CLOCK.fullmatch(c) for c in there):
        tell(f"{what}: hours:minutes:seconds, {there[0]!r}, are taken in seconds")
        return _over_midnight(_clock(text, what), what, tell)
    bad = next((c for c in there if not _ISO.fullmatch(c)), None)
    if bad is None:
        return _iso(text, what, tell, zone, start)
    if all(_SHORT_CLOCK.fullmatch(c) for c in there):
        raise DataError(
            f"{what}: {there[0]!r} may be hours and minutes or minutes and seconds: give "
            "--time-format %M:%S or %H:%M"
        )
    found = _written(text, there)
    if found is not None:
        return _told(found, what, tell, zone, start)
    if _ISO.match(bad) and "-" in bad[:5]:
        raise DataError(
            f"{what}: what follows the date in {bad[:40]!r} is not understood: give --time-format, "
            "such as '%Y-%m-%d %H:%M:%S CET' with --time-zone Europe/Berlin"
        )
    if _DATE.match(bad):
        form = _day_first(there)
        if form is not None:
            raise DataError(
                f"{what}: the order of day and month in {bad!r} is not guessed, since on other "
                f"days it would be open: give --time-format '{form}'"
            )
        raise DataError(
            f"{what}: the order of day and month in {bad!r} is not guessed: give --time-format, "
            "such as %d.%m.%Y %H:%M:%S or %m/%d/%Y %H:%M:%S"
        )
    raise DataError(
        f"{what}: {bad[:40]!r} is no time; seconds, ISO dates (2024-03-31T01:59:58.25Z) and "
        "hh:mm:ss are read; give --time-format for others"
    )


def _written(text: list[str], there: list[str]) -> Any:
    """Dates with the month in letters, or the day of the year; None if they are no such."""
    pd: Any = import_module("pandas")

    if not (_MONTH.search(there[0]) or re.match(r"\d{4}-\d{3}T", there[0])):
        return None
    clean = [re.sub(r"[.,](?=\d+( |$|Z|[+-]\d\d:?\d\d$))", ".", c) for c in text]
    for form in _FORMS.strip().splitlines():
        for one in (form, form.replace("%S", "%S.%f")):
            try:
                return pd.to_datetime([c or None for c in clean], format=one)
            except (ValueError, OverflowError, TypeError):
                continue
    return None


def _day_first(there: list[str]) -> str | None:
    """The format of dates whose first or second number is above 12 somewhere; None if it is not."""
    found = re.match(r"\d{1,2}([./-])\d{1,2}[./-](\d{4}|\d{2})(?!\d)", there[0])
    pairs = [re.match(r"(\d{1,2})[./-](\d{1,2})[./-]", c) for c in there]
    if found is None or not all(pairs) or len(found[2]) == 2:
        return None
    first, second = (max(int(p[k]) for p in pairs if p) for k in (1, 2))
    if (first > 12) == (second > 12):
        return None
    date = found[1].join(("%d", "%m", "%Y") if first > 12 else ("%m", "%d", "%Y"))
    rest = there[0][found.end() :]
    if re.fullmatch(r"[ T]\d{1,2}:\d{2}:\d{2}(\.\d+)?( [aApP][mM])?", rest):
        half = rest[-1] in "mM"
        clock = ("%I" if half else "%H") + ":%M:%S" + (".%f" if "." in rest else "")
        return f"{date}{rest[0]}{clock}" + (" %p" if half else "")
    return date if not rest else date + f"{rest[0]}%H:%M:%S"


def _clock(text: list[str], what: str) -> np.ndarray:
    """Hours, minutes and seconds, with AM and PM or of 24 hours, in seconds."""
    pd: Any = import_module("pandas")

    halves = [_HALF_DAY.search(c) for c in text]
    if any(halves) and not all(h for h, c in zip(halves, text, strict=True) if c):
        raise DataError(f"{what}: some times have AM or PM and some not: write it in all of them")
    clean = [_HALF_DAY.sub("", c).replace(",", ".") or None for c in text]
    t = _from_spans(pd.to_timedelta(clean).to_numpy())
    if any(halves):
        late = np.array([h is not None and h[1] in "pP" for h in halves])
        if (t >= 13 * 3600).any() or (t < 3600).any():
            raise DataError(f"{what}: with AM or PM the hours run from 1 to 12")
        t = t % 43200 + 43200 * late
    return t


def _over_midnight(t: np.ndarray, what: str, tell: Tell) -> np.ndarray:
    """Add a day where a clock of 24 hours begins anew: it falls by a day less about one step."""
    step = np.diff(t)
    if not (step < 0).any() or t.min(initial=0.0) < 0 or t.max(initial=0.0) >= 86400:
        return t
    usual = float(np.median(step))
    fall = step < 0
    if (
        usual > 0
        and (step[fall] + 86400 > 0).all()
        and (step[fall] + 86400 < 100 * usual + 1).all()
    ):
        tell(f"{what}: the clock passes midnight in data row {int(np.argmax(fall)) + 2}")
        return t + 86400.0 * np.concatenate([[0], np.cumsum(fall)])
    return t


def date_and_clock(dates: Any, clocks: Any) -> np.ndarray | None:
    """Join a column of dates and one of times of day; None where they are no such."""
    d, c = ([str(x).strip() for x in a] for a in (dates, clocks))
    d = [re.sub(r"[T ]0?0:00(:00(\.0+)?)?$", "", x) for x in d]
    full = [x for x in c if x]
    if not full or not all(_CLOCK.fullmatch(x) for x in full):
        return None
    if not all(re.fullmatch(r"[\w./-]+|[\w ]+", x) and not _CLOCK.fullmatch(x) for x in d if x):
        return None
    if not all(_ISO.match(x) or _DATE.match(x) or _MONTH.search(x) for x in d if x):
        return None
    c = [x.replace(",", ".") if x[1:2] != ":" else "0" + x.replace(",", ".") for x in c]
    return np.array(
        [f"{a} {b}" if a and b else "" for a, b in zip(d, c, strict=True)], dtype=object
    )


def _iso(
    text: list[str], what: str, tell: Tell, zone: str | None, start: list[Start]
) -> np.ndarray:
    """ISO 8601 dates, with zones in all or in none."""
    pd: Any = import_module("pandas")

    zoned = [bool(_ZONE.search(c)) for c in text if c]
    if any(zoned) != all(zoned):
        raise DataError(f"{what}: some dates have a zone and some not: write it in all of them")
    clean = [c.replace(",", ".").replace("UTC", "Z").replace(" Z", "Z") or None for c in text]
    try:
        dates = pd.to_datetime(clean, format="ISO8601", utc=all(zoned) or None)
    except (ValueError, OverflowError) as e:
        why = str(e).splitlines()[0].partition(". You")[0]
        raise DataError(f"{what}: {why}: correct it, or give --time-format") from None
    return _told(dates, what, tell, zone, start)


def _formatted(
    text: list[str], form: str, what: str, tell: Tell, zone: str | None, start: list[Start]
) -> np.ndarray:
    pd: Any = import_module("pandas")

    try:
        dates = pd.to_datetime([c or None for c in text], format=form)
    except (ValueError, OverflowError, TypeError) as e:
        raise DataError(f"{what}: not of the form {form!r}: {str(e).splitlines()[0]}") from None
    return _told(dates, what, tell, zone, start)


def _told(dates: Any, what: str, tell: Tell, zone: str | None, start: list[Start]) -> np.ndarray:
    """Seconds since the first date; local times over a change of the clocks need a zone."""
    there = dates[~dates.isna()]
    if dates.tz is None and zone is not None:
        dates = _localised(dates, what, zone)
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
                "--steady (apu fit)"
            )
    tell(f"{what}: dates are taken in seconds since the first, {there[0]}")
    return _from_dates(_in_utc(dates), start, dates.tz is not None)
