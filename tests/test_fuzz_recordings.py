"""Recordings in random layouts: read as they were meant, or refused with what to do.

``FUZZ_SEED`` sets the first seed, ``FUZZ_CASES`` the number of recordings.  The truth is a load
step of the engine in SI; a layout is drawn for it, written, and read again.  What a layout leaves
open may be refused; what it does not must be read.
"""

import os
import random
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from apu_casadi.core.errors import DataError
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.recordings.layout import Reading
from estimators.apu.recordings.recorded import read_data, read_table
from estimators.apu.recordings.thermal import check_temperatures

SEED = int(os.environ.get("FUZZ_SEED", "0"))
CASES = int(os.environ.get("FUZZ_CASES", "120"))
RPM = np.pi / 30
#: Units of the files: how they are written, SI value of one, offset.
UNITS = {
    "N": [("rpm", RPM, 0), ("RPM", RPM, 0), ("1/min", RPM, 0), ("rad/s", 1, 0),
          ("krpm", 1e3 * RPM, 0), ("%", 37.75147, 0), ("U/min", RPM, 0), ("min-1", RPM, 0)],
    "P3": [("kPa", 1e3, 0), ("bar", 1e5, 0), ("psia", 6894.757293168, 0), ("Pa", 1, 0),
           ("MPa", 1e6, 0), ("mbar", 100, 0), ("bara", 1e5, 0), ("barg", 1e5, 101325)],
    "T3": [("degC", 1, 273.15), ("K", 1, 0), ("°C", 1, 273.15), ("deg C", 1, 273.15),
           ("degF", 5 / 9, 459.67 * 5 / 9), ("degR", 5 / 9, 0), ("C", 1, 273.15)],
    "Wf": [("kg/h", 1 / 3600, 0), ("kg/s", 1, 0), ("g/s", 1e-3, 0), ("lb/h", 0.45359237 / 3600, 0),
           ("pph", 0.45359237 / 3600, 0)],
    "PW": [("kW", 1e3, 0), ("W", 1, 0), ("hp", 745.6998715823, 0), ("KW", 1e3, 0)],
}  # fmt: skip
UNITS["T5"] = UNITS["T3"]
SI = {"N": "rad/s", "P3": "Pa", "T3": "K", "T5": "K", "Wf": "kg/s", "PW": "W"}


def truth(rng, K):
    """A load step from 300 to 500 kW or back, all channels moving, none of them constant."""
    s = np.clip((np.arange(K) - K / 4) / (K / 3), 0, 1)
    s = s if rng.random() < 0.5 else 1 - s
    noise = np.random.default_rng(rng.randrange(1 << 30))
    ends = {"N": (3770, 3779), "P3": (765e3, 813e3), "T3": (554.5, 562), "T5": (635, 741),
            "Wf": (0.0348, 0.0482), "PW": (3e5, 5e5)}  # fmt: skip
    return {n: a + (b - a) * (s + 0.01 * noise.standard_normal(K)) for n, (a, b) in ends.items()}


# ------------------------------------------------------------------ time


def stamps(form, seconds, start="2024-05-21 10:11:12"):
    dates = pd.Timestamp(start) + pd.to_timedelta(np.round(seconds, 6), "s")
    return [d.strftime(form) for d in dates]


def clock(seconds, start):
    at = [round(start + s, 3) for s in seconds]
    return [f"{int(a // 3600) % 24:02d}:{int(a // 60) % 60:02d}:{a % 60:06.3f}" for a in at]


EPOCH = 1_716_286_272
#: Kind -> (column name, cells of the times, whether it may be refused).
TIMES = {
    "none": lambda t: (None, None, False),
    "s": lambda t: ("time", [f"{x:.4f}" for x in t], False),
    "t [s]": lambda t: ("t [s]", [f"{x:.4f}" for x in t], False),
    "ms": lambda t: ("Time [ms]", [f"{1e3 * x:.2f}" for x in t], False),
    "time_ms": lambda t: ("time_ms", [f"{1e3 * x:.2f}" for x in t], False),
    "Zeit": lambda t: ("Zeit [s]", [f"{x:.4f}" for x in t], False),
    "elapsed": lambda t: ("Elapsed Time", [f"{x:.4f}" for x in t], False),
    "LogTime": lambda t: ("LogTime", [f"{x:.4f}" for x in t], False),
    "minutes": lambda t: ("Time [min]", [f"{x / 60:.9f}" for x in t], False),
    "odd name": lambda t: ("X_Value", [f"{x:.4f}" for x in t], False),
    "iso": lambda t: ("Timestamp", stamps("%Y-%m-%d %H:%M:%S.%f", t), False),
    "isoT": lambda t: ("Timestamp", stamps("%Y-%m-%dT%H:%M:%S.%fZ", t), False),
    "offset": lambda t: ("Date", stamps("%Y-%m-%dT%H:%M:%S.%f+02:00", t), False),
    "slashes": lambda t: ("Date/Time", stamps("%Y/%m/%d %H:%M:%S.%f", t), False),
    "months": lambda t: ("Date", stamps("%d-%b-%Y %H:%M:%S.%f", t), False),
    "unix": lambda t: ("epoch", [f"{EPOCH + x:.4f}" for x in t], False),
    "unix ms": lambda t: ("Timestamp", [f"{1000 * EPOCH + round(1e3 * x)}" for x in t], False),
    "unix us": lambda t: ("ts", [f"{10**6 * EPOCH + round(1e6 * x)}" for x in t], False),
    "clock": lambda t: ("Time", clock(t, 3600.0), False),
    "midnight": lambda t: ("Time", clock(t, 86400.0 - t[len(t) // 2] - 1e-4), False),
    "spans": lambda t: ("time", [f"0 days {c}" for c in clock(t, 0.0)], False),
    "german": lambda t: ("Datum", stamps("%d.%m.%Y %H:%M:%S.%f", t), True),
    "american": lambda t: ("Date", stamps("%m/%d/%Y %I:%M:%S.%f %p", t), True),
    "open date": lambda t: ("Date", stamps("%d/%m/%Y %H:%M:%S.%f", t, "2024-03-04"), True),
    "excel": lambda t: ("Date", [f"{45433.4244444 + x / 86400:.11f}" for x in t], True),
    "datenum": lambda t: ("time", [f"{739393.4244444 + x / 86400:.10f}" for x in t], True),
    "compact": lambda t: ("time", stamps("%Y%m%d%H%M%S", t), True),
    "unsorted": lambda t: ("time", [f"{x:.4f}" for x in [*t[2:4], *t[:2], *t[4:]]], True),
    "coarse": lambda t: ("time", [f"{int(x)}" for x in t], True),
    "gap": lambda t: ("time", ["" if k == 3 else f"{x:.4f}" for k, x in enumerate(t)], True),
    "two": lambda t: (("Date", "Time"), (stamps("%Y-%m-%d", t), stamps("%H:%M:%S.%f", t)), False),
    "two german": lambda t: (("Datum", "Uhrzeit"), (stamps("%d.%m.%Y", t), stamps("%H:%M:%S", t)),
                             True),
}  # fmt: skip

# ------------------------------------------------------------------ cells

GAPS = ["", "", "NaN", "N/A", "Bad", "---", "#N/A", "-", "OL", "I/O Timeout", "****"]
CODES = ["-999", "-9999", "1e30", "9999", "-32768", "999999", "0"]
HEADS = ["{n} [{u}]", "{n} ({u})", "{n}[{u}]", "{n}_{u}", "{n} {{{u}}}", "{n}/{u}", "{n} in {u}"]


def drawn(seed):
    """Return what is written, what it means, and what of it may be refused."""
    rng = random.Random(seed)
    K = rng.choice((6, 12, 40, 90))
    kind = rng.choice(list(TIMES))
    step = (
        1.0
        if kind in ("two german", "compact", "excel", "datenum")
        else rng.choice((0.02, 0.5, 1.0))
    )
    t = np.arange(K) * step
    values, given, open_ = truth(rng, K), {}, []
    names, cells = [], []
    for n, v in values.items():
        unit, scale, offset = rng.choice(UNITS[n])
        shown = [f"{(x - offset) / scale:.9g}" for x in v]
        if unit == "barg":
            open_.append("gauge")
        given[n] = unit
        names.append(n)
        cells.append(shown)
    # what stands for no reading
    for _ in range(rng.choice((0, 0, 1, 3))):
        n, k = rng.choice(names), rng.randrange(1, K)
        word = rng.choice(GAPS if rng.random() < 0.6 else CODES)
        cells[names.index(n)][k] = word
        values[n][k] = np.nan
        open_ += [f"code {word}"] * (word in CODES)
    return rng, t, kind, names, cells, given, values, open_


def written(seed, folder):
    """Write a text file; return path, time or None, truth, what may be refused."""
    rng, t, kind, names, cells, given, values, open_ = drawn(seed)
    tname, tcells, maybe = TIMES[kind](t)
    open_ += [f"time {kind}"] * maybe
    style = rng.choice((*HEADS, "row", "row", "row above", "none"))
    if style in ("{n}_{u}", "{n} in {u}", "{n}/{u}") and any(
        u in ("%", "deg C") for u in given.values()
    ):
        style = "{n} [{u}]"
    if style == "none":
        open_.append("no units")
    heads = [style.format(n=n, u=given[n]) if "{" in style else n for n in names]
    row = [given[n] for n in names]
    if tname is not None:
        many = isinstance(tname, tuple)
        heads = [*(tname if many else (tname,)), *heads]
        cells = [*(tcells if many else (tcells,)), *cells]
        row = [*([""] * (2 if many else 1)), *row]
    blanks = tname is None or (not isinstance(tname, tuple) and not any(" " in c for c in cells[0]))
    sep = rng.choice((",", ",", ";", "\t", "|", "  " if blanks and "in" not in style else ";"))
    comma = sep in (";", "\t") and rng.random() < 0.6
    K = len(cells[-1])
    # columns that nobody asked for
    for extra in rng.sample(("text", "flag", "constant", "index"), rng.choice((0, 0, 1, 2))):
        text = {"text": ["run"] * K, "flag": ["TRUE"] * K, "constant": ["1.5"] * K,
                "index": [str(k) for k in range(K)]}[extra]  # fmt: skip
        heads, cells, row = [*heads, extra], [*cells, text], [*row, ""]
    if sep == "  ":  # blanks: no empty cells, no blanks inside them
        cells = [[c.replace(" ", "") if c else "NaN" for c in x] for x in cells]
        heads, row = [h.replace(" ", "") for h in heads], [u.replace(" ", "") or "-" for u in row]
    body = [list(r) for r in zip(*cells, strict=True)]
    if comma:
        dates = kind not in ("s", "none") and tname is not None
        for r in body:
            for i, c in enumerate(r):
                if not (dates and ":" in c):
                    r[i] = c.replace(".", ",")
    table = [heads, *body]
    if style == "row":
        table = [heads, [f"[{u}]" if u else u for u in row] if rng.random() < 0.5 else row, *body]
    elif style == "row above":
        table = [row, heads, *body]
    quote = rng.random() < 0.2 and sep != "  "
    lines = [sep.join(f'"{c}"' if quote or (sep in c and c) else c for c in r) for r in table]
    if rng.random() < 0.2 and sep != "  ":
        lines = [x + sep for x in lines]
    if rng.random() < 0.2 and sep not in ("  ",):
        lines = [f"sep={sep}", *lines]
    elif rng.random() < 0.3:
        above = ["# a comment", "Logger: X 12", f"Channels{sep}6", "", "Start of test"]
        lines = [*rng.sample(above, rng.choice((1, 2))), *lines]
    if rng.random() < 0.15:
        lines += ["", "End of data"]
    text = rng.choice(("\n", "\r\n")).join(lines) + "\n"
    code = rng.choice(("utf-8", "utf-8-sig", "utf-16", "cp1252"))
    path = Path(folder) / f"x.{rng.choice(('csv', 'txt'))}"
    path.write_bytes(text.encode(code))
    order = [2, 3, 0, 1, *range(4, t.size)] if kind == "unsorted" else range(t.size)
    return path, (None if tname is None else t[list(order)]), values, open_


def framed(seed, folder):
    """The same as a frame, a Parquet file, a Dataset or a netCDF file."""
    rng, t, _, names, cells, given, values, open_ = drawn(seed)
    unit = dict(given)

    def number(c):
        try:
            return float(c)
        except ValueError:
            return np.nan

    data = {n: np.array([number(c) for c in x]) for n, x in zip(names, cells, strict=True)}
    index = rng.choice(("s", "dates", "spans", "zone", "column"))
    dates = pd.Timestamp("2024-05-21") + pd.to_timedelta(t, "s")
    when = {"s": t, "column": t, "dates": dates, "spans": pd.to_timedelta(t, "s"),
            "zone": dates.tz_localize("Europe/Berlin")}[index]  # fmt: skip
    if rng.random() < 0.5:
        frame = pd.DataFrame({f"{n} [{unit[n]}]": v for n, v in data.items()})
        if index == "column":
            frame.insert(0, "t [s]", when)
        else:
            frame = frame.set_index(pd.Index(when, name="time"))
        if rng.random() < 0.5:
            return frame, t, values, open_
        path = Path(folder) / "x.parquet"
        frame.to_parquet(path)
        return path, t, values, open_
    when = when.tz_localize(None) if index == "zone" else when
    ds = xr.Dataset({n: ("time", v, {"units": unit[n]}) for n, v in data.items()},
                    coords={"time": ("time", np.asarray(when))})  # fmt: skip
    if rng.random() < 0.4:
        return ds, t, values, open_
    path = Path(folder) / "x.nc"
    ds.to_netcdf(path, engine="scipy")
    return path, t, values, open_


def outcome(source, t, values, open_, told):
    """Read; "read" where all is as it was meant, else the refusal, which must be one of words."""
    notes = []
    how = {"reading": Reading(), "notes": notes}
    try:
        table = read_table(source, **how) if isinstance(source, Path) else read_data(source, **how)
        got = table.time()
        read = {n: table.get(n, SI[n]) for n in values}
        check_temperatures(table.source, read, {}, GasGenerator())
    except DataError as e:
        words = ("give ", "write", "delete", "complete", "sort", "is no number (", "export")
        assert any(w in str(e) for w in words), f"{told}: no remedy: {e}"
        assert open_, f"{told}: refused, but nothing is open: {e}"
        return str(e)
    for n, v in values.items():
        np.testing.assert_allclose(read[n], v, rtol=2e-6, err_msg=f"{told}: {n}; {notes}")
    if t is None or (got is None and table.steady_hint()):
        assert got is None, told
        return "read"
    assert got is not None, f"{told}: the time is lost; {notes}"
    np.testing.assert_allclose(
        got - got[0], t - t[0], atol=2e-4 * (t[1] - t[0]) + 1e-6, err_msg=told
    )
    return "read"


def read_rightly_or_refused(seeds, folder):
    counts = {}
    for seed in seeds:
        make = framed if seed % 5 == 4 else written
        source, t, values, open_ = make(seed, folder)
        said = outcome(source, t, values, open_, f"seed {seed} ({make.__name__}, open: {open_})")
        counts[said == "read"] = counts.get(said == "read", 0) + 1
    return counts


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Times can't be serialized faithfully")
def test_random_layouts_are_read_rightly_or_refused_with_the_remedy(tmp_path):
    counts = read_rightly_or_refused(range(SEED, SEED + CASES), tmp_path)
    assert counts[True] > 0.4 * CASES
