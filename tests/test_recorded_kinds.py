"""What instruments and loggers write: read with a word on how, or refused with the remedy."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.recordings.recorded import Reading, parse_mapping, read_table
from estimators.apu.recordings.thermal import check_temperatures
from scenarios.cli import main

K = 12
k = np.arange(K)
#: name -> (unit of the file, values there, SI unit, first value in SI)
DATA = {
    "N": ("rpm", np.full(K, 36050.5), "rad/s", 36050.5 * np.pi / 30),
    "P3": ("kPa", np.linspace(812.9, 765.6, K).round(3), "Pa", 812.9e3),
    "T3": ("degC", np.linspace(288.8, 281.4, K).round(3), "K", 561.95),
    "T5": ("degC", np.linspace(468.1, 362.0, K).round(3), "K", 741.25),
    "Wf": ("kg/h", np.linspace(173.7, 125.2, K).round(3), "kg/s", 173.7 / 3600),
    "PW": ("kW", np.linspace(500.0, 300.0, K).round(3), "W", 5e5),
}
NAMES = [f"{n} [{d[0]}]" for n, d in DATA.items()]


def text(time=None, *, names=NAMES, sep=",", comma=False, tname="time"):
    rows = [[f"{v:.3f}" for v in row] for row in zip(*(d[1] for d in DATA.values()), strict=True)]
    names = list(names)
    if time is not None:
        names, rows = [tname, *names], [[str(t), *r] for t, r in zip(time, rows, strict=True)]
    if comma:
        rows = [[c.replace(".", ",") for c in r] for r in rows]
    return "\n".join(sep.join(r) for r in [names, *rows]) + "\n"


def cell(row, name, value):
    lines = [x.split(",") for x in text().splitlines()]
    lines[row][list(DATA).index(name)] = value
    return "\n".join(map(",".join, lines))


def read(tmp_path, content, name="x.csv", *, mapping=(), **reading):
    """Write, read with notes; check the values where nothing is missing; return table, notes."""
    path = tmp_path / name
    if callable(content):
        content(path)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    notes = []
    table = read_table(path, parse_mapping(list(mapping)), reading=Reading(**reading), notes=notes)
    table.time()
    for n, (_, _, si, first) in DATA.items():
        got = table.get(n, si)
        assert got[0] == pytest.approx(first, rel=1e-6), n
    return table, notes


LAYOUTS = {
    "semicolons": (text(sep=";"), None),
    "tabs": (text(k * 0.5, sep="\t"), None),
    "bars": (text(sep="|"), None),
    "blanks": (text(k * 0.5, sep="   "), None),
    "decimal commas": (text(sep=";", comma=True), "decimal commas, such as '36050,500'"),
    "decimal commas, tabs": (text(sep="\t", comma=True), "decimal commas"),
    "thousands": (text().replace("36050.500", '"36,050.500"'), "commas separate thousands"),
    "a separator more": (text().replace("\n", ",\n"), None),
    "a separator more in the rows": (text().replace("\n", ",\n").replace("],\n", "]\n"), None),
    "quoted": (text().replace("36050.500", '"36050.500"'), None),
    "row of units": (
        text(names=DATA).replace("PW\n", "PW\nrpm,kPa,degC,degC,kg/h,kW\n"),
        "line 2: taken as a row of units",
    ),
    "row of units in brackets": (
        text(k * 0.5, names=DATA).replace("PW\n", "PW\n[s],[rpm],[kPa],[°C],[°C],[kg/h],[kW]\n"),
        "row of units",
    ),
    "underscores": (
        text(names=["N_rpm", "P3_kPa", "T3_degC", "T5_C", "Wf_kg_h", "PW_kW"]),
        "column N_rpm is taken as N in rpm",
    ),
    "spellings": (
        text(names=["N [RPM]", "P3 (kPa)", "T3 [deg C]", "T5 [Celsius]", "Wf [kg/hr]", "PW [KW]"]),
        None,
    ),
    "windows": (text(names=[n.replace("degC", "°C") for n in NAMES]).encode("cp1252"),
                "read as Windows-1252"),
    "utf-16": (text().encode("utf-16"), "read as UTF-16"),
    "mark of UTF-8": ("\ufeff" + text(), None),
    "lines above": ("Logger: X\nStart: 2024\n\n" + text(), "lines 1 to 2, above the column names"),
    "names in a comment": ("# " + text(), "the comment above the numbers is taken as column"),
    "excel's own line": ("sep=;\n" + text(sep=";"), None),
    "numbered rows": (
        "\n".join(f"{i - 1 if i else ''},{x}" for i, x in enumerate(text().splitlines())),
        "numbers the rows",
    ),
    "percent": (text(names=["N [%]", *NAMES[1:]]).replace("36050.500", "100.0013869625"),
                "100 % is taken as the design speed, 36050 r/min"),
    "carriage returns": (text().replace("\n", "\r\n"), None),
    "old line ends": (text().replace("\n", "\r"), None),
    "mark of UTF-32": (text().encode("utf-32"), "read as UTF-32"),
    "quoted line of excel": ('"sep=;"\n' + text(sep=";", comma=True), "decimal commas"),
    "blanks, decimal commas": (
        text(sep="  ", comma=True, names=[n.replace(" ", "") for n in NAMES]), "decimal commas"),
    "blank thousands": (text(sep=";").replace("36050.500", "36 050.500"), "separate thousands"),
    "apostrophes": (text().replace("36050.500", "36'050.500"), "separate thousands"),
    "Fortran": (text().replace("36050.500", "3.60505D+04"), None),
    "unit in cells": (text().replace("36050.500", "36050.500 rpm"), "unit stands in the cells"),
    "keys above": ("Channels,6\nRate,50\n" + text(), "lines 1 to 2, above the column names"),
    "keys above, filled": ("Channels,6,,,,\nRate,50,,,,\n" + text(), "lines 1 to 2, above"),
    "percent comments": ("% bench 3\n" + text(), "line 1, above the column names"),
    "units above": ("rpm,kPa,degC,degC,kg/h,kW\n" + text(names=DATA), "line 1: taken as a row of"),
    "words, then units": (
        text(names=DATA).replace(
            "PW\n", "PW\nspeed,pressure,a,b,fuel,power\nrpm,kPa,degC,degC,kg/h,kW\n"),
        "line 3: taken as a row of units"),
    "units, then channels": (
        text(names=DATA).replace("PW\n", "PW\nrpm,kPa,degC,degC,kg/h,kW\nc0,c1,c2,c3,c4,c5\n"),
        "left out above the data: line 3"),
    "in": (text(names=[n.replace("[", "in ").replace("]", "") for n in NAMES]), "as N in rpm"),
    "braces": (text(names=[n.replace("[", "{").replace("]", "}") for n in NAMES]), None),
    "dashes": (text(names=[n.replace("[", "- ").replace("]", "") for n in NAMES]), "is taken as"),
    "a word at the end": (text() + "\nEnd of data\n", "line 15 below the data left out"),
    "empty rows": (text() + ",,,,,\n,,,,,\n", "an empty row is left out, of 2 in all"),
    "two of a name": (text().replace("\n", ",1,2\n").replace("],1,2", "],a,a"), None),
    "typographic minus": (
        text().replace("\n", ",\u22121.5\n").replace("],\u22121.5", "],dT_isa [K]"), "U+2212"),
    "turns": (text(names=["N [U/min]", *NAMES[1:]]), None),
    "thousand turns": (text(names=["N [krpm]", *NAMES[1:]]).replace("36050.500", "36.0505"), None),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_text_files(tmp_path, layout):
    """All six columns in SI; what had to be understood is told, and refused untold."""
    content, note = LAYOUTS[layout]
    _, notes = read(tmp_path, content)
    if note is None:
        assert notes == []
        return
    assert any(note in n for n in notes), notes
    with pytest.raises(DataError):
        table = read_table(tmp_path / "x.csv")
        for n, d in DATA.items():
            table.get(n, d[2])


OPEN = {
    "thousand or decimal": (cell(1, "P3", '"1,234"'), "give --decimal comma or point"),
    "both": (text(sep=";", comma=True).replace("812,900", "812.900"), "give --decimal"),
    "utf-16 without mark": (text().encode("utf-16-le"), "binary data"),
    "unit unknown": (text(names=DATA).replace("PW\n", "PW\nrpm,kPa,degX,degC,kg/h,kW\n"), "'degX'"),
    "two headers": (text() + text(), r"line 14, column N: 'N \[rpm\]' is no number"),
    "sum at the end": (text() + "Mean,800,285,400,150,400\n", "'Mean' is no number"),
    "gauge pressure": (text().replace("kPa", "psig"), "unknown unit 'psig'"),
    "gauge in brackets": (text().replace("[kPa]", "(bar(g))"), r"bar\(g\).*--barometer PRESSURE"),
    "frequency": (text().replace("rpm", "Hz"), "'Hz' measures 1/s"),
    "commas as both": (text(comma=True), "are commas decimal commas as well as separators"),
    "another unit in cells": (text().replace("36050.500", "36050.5 rad/s"), "correct one of them"),
    "a word of the day": (cell(3, "T5", "off"), "'off' is no number"),
    "beyond a bound": (cell(3, "T5", "> 800"), "'> 800' is no number"),
    "half of the units": (
        text(names=DATA).replace("PW\n", "PW\nrpm,kPa,Grad\n"),
        "give them by --units|neither numbers nor units",
    ),
    "codes in the range": (cell(3, "P3", "999"), "999 kPa.* stands apart .*--missing 999"),
    "a zero in the range": (cell(3, "PW", "0"), "0 kW.* stands apart .*--missing 0 .*--range PW"),
    "long cell": (text().rstrip() + "x" * 200_000, r"x.csv, line 13: no CSV file|is no number"),
}


@pytest.mark.parametrize("what", OPEN)
def test_what_is_left_open_is_refused(tmp_path, what):
    """With the option, or the place."""
    content, words = OPEN[what]
    with pytest.raises(DataError, match=words) as e:
        read(tmp_path, content)
    assert len(str(e.value)) < 500


def test_options_decide(tmp_path):
    """The encoding, the decimal sign, a unit, what stands for a gap, a range."""
    read(tmp_path, text().encode("utf-16-le"), encoding="utf-16-le")
    path_text = text(sep=";").replace("36050.500", "36.050,5").replace(".", ",")
    read(tmp_path, path_text.replace("36,050,5", "36.050,5"), decimal="comma")
    bare = text(names=[n.replace(" [degC]", "") for n in NAMES])
    read(tmp_path, bare, mapping=["T3=T3:degC", "T5=T5:degC"])
    table, notes = read(tmp_path, cell(3, "T5", "-999"), missing=(-999.0,))
    assert np.isnan(table.get("T5", "K")[2]) and not notes
    table, notes = read(tmp_path, cell(3, "T5", "-999"), exclude=True)
    assert np.isnan(table.get("T5", "K")[2])
    assert "line 4: -999 degC = -725.85 K is no possible T5 (300 to 1200 K); 1 of 12" in notes[0]
    table, _ = read(tmp_path, cell(3, "T5", "999"), ranges={"T5": (300.0, 1300.0)})
    assert table.get("T5", "K")[2] == 1272.15


@pytest.mark.parametrize("value", ["-999", "9999", "-32768", "1e30", "0", "-273.15", "999"])
def test_a_reading_that_cannot_be(tmp_path, value):
    """File, column, row and value, and three remedies."""
    with pytest.raises(DataError, match=rf"x.csv, column T5, data row 3, line 4: {value[:2]}.*"
                       r"--missing.*--exclude-implausible.*--range T5"):  # fmt: skip
        read(tmp_path, cell(3, "T5", value))


@pytest.mark.parametrize(("name", "value"), [
    ("N", "0"), ("N", "9999"), ("P3", "0"), ("P3", "-999"), ("Wf", "0"), ("Wf", "999"),
    ("PW", "-999"), ("PW", "9999"), ("PW", "999"), ("T3", "0"),
])  # fmt: skip
def test_other_quantities_have_ranges(tmp_path, name, value):
    """A dead channel and a sentinel in each."""
    with pytest.raises(
        DataError, match=f"column {name}, data row 3, line 4: .* no possible {name}"
    ):
        read(tmp_path, cell(3, name, value))


@pytest.mark.parametrize("word", ["", "N/A", "NaN", "Bad Input", "#VALUE!", "No Data", "--"])
def test_words_for_a_gap(tmp_path, word):
    """A gap; the less usual ones are told."""
    table, notes = read(tmp_path, cell(3, "T5", word))
    assert np.flatnonzero(np.isnan(table.get("T5", "K"))).tolist() == [2]
    assert bool(notes) == (word not in ("", "N/A", "NaN"))


@pytest.mark.parametrize(("name", "words"), [
    ("N", "36050.5 is plausible as rpm, not as rad/s"),
    ("P3", "812.9 is plausible as kPa"), ("T3", "288.8 is plausible as degC"),
    ("T5", "468.1 is plausible as degC and as K"), ("Wf", "173.7 is plausible as kg/h"),
    ("PW", "the largest PW is 500, plausible as kW"),
])  # fmt: skip
def test_a_missing_unit_is_told_by_the_range(tmp_path, name, words):
    """Refused with the option; with it, read."""
    content = text(names=[name if n.split()[0] == name else n for n in NAMES])
    with pytest.raises(DataError, match=rf"unit missing\?.*{words}.*--column {name}={name}:"):
        read(tmp_path, content)
    read(tmp_path, content, mapping=[f"{name}={name}:{DATA[name][0]}"])


EPOCH = 1_711_843_200
TIMES = {
    "seconds": (k * 0.5, 0.5, False),
    "unix": (EPOCH + k, 1.0, True),
    "unix ms": (EPOCH * 10**3 + k * 20, 0.02, True),
    "unix us": (EPOCH * 10**6 + k * 20_000, 0.02, True),
    "unix ns": (EPOCH * 10**9 + k * 20_000_000, 0.02, True),
    "iso": ([f"2024-01-01 00:00:{i:02d}.250" for i in k], 1.0, True),
    "iso, zone": ([f"2024-03-31T0{1 + i // 2}:{30 * (i % 2):02d}:00Z" for i in k], 1800.0, True),
    "iso, offsets": ([f"2024-01-01T{i % 2:02d}:00:{i:02d}+0{i % 2}:00" for i in k], 1.0, True),
    "year first": ([f"2024/03/31 01:00:{i:02d}" for i in k], 1.0, True),
    "clock": ([f"00:01:{i:02d}" for i in k], 1.0, True),
    "clock over midnight": (
        [f"23:59:{54 + i}" for i in k[:6]] + [f"00:00:0{i}" for i in k[:6]],
        1.0,
        True,
    ),
    "halves of the day": (
        [f"11:59:{54 + i} AM" for i in k[:6]] + [f"12:00:0{i} PM" for i in k[:6]],
        1.0,
        True,
    ),
    "month in letters": ([f"31-Mar-2024 01:00:{i:02d}.250" for i in k], 1.0, True),
    "day of the year": ([f"2024-091T01:00:{i:02d}" for i in k], 1.0, True),
    "of mails": ([f'"Sun, 31 Mar 2024 01:00:{i:02d} +0000"' for i in k], 1.0, True),
    "clock, comma": ([f'"00:01:{i:02d},5"' for i in k], 1.0, True),
}


@pytest.mark.parametrize("kind", TIMES)
def test_times(tmp_path, kind):
    """Seconds, exact to 1 us of the step; all but plain seconds are told, and refused untold."""
    values, step, told = TIMES[kind]
    table, notes = read(tmp_path, text(values))
    assert_allclose(np.diff(table.time()), step, atol=1e-6)
    assert bool(notes) == told
    if told:
        with pytest.raises(DataError, match="refused, since nobody would be told"):
            read_table(tmp_path / "x.csv").time()


NO_TIMES = {
    "day or month": ([f"03/04/2024 01:00:{i:02d}" for i in k], "order of day and month"),
    "points": ([f"31.03.2024 01:00:{i:02d}" for i in k], "--time-format"),
    "two figures": ([f"00:{i:02d}" for i in k], "give --time-format %M:%S or %H:%M"),
    "half zoned": ([f"2024-01-01 00:00:{i:02d}{'Z' * (i % 2)}" for i in k], "some not"),
    "summer time": ([f"2024-03-31 01:59:{54 + i}" for i in k[:6]]
                    + [f"2024-03-31 03:00:0{i}" for i in k[:6]],
                    "clock jumps by an hour.*--time-zone"),
    "dates as numbers": (20240101 + k, "may be a date or seconds: give --time-format %Y%m%d"),
    "spreadsheet": ([f"{45382 + i / 86400:.8f}" for i in k], "may be days of a spreadsheet"),
    "doubled": ([0, 1, 1, *range(3, K)], "data row 3 has 1 s after 1 s"),
    "falling": ([0, 1, 3, 2, *range(4, K)], "data row 4 has 2 s after 3 s"),
    "a gap": ([0, "", *range(2, K)], "gap in data row 2"),
    "words": (["noon"] * K, "'noon' is no time"),
    "spreadsheet, minutes": ([f"{45382 + i / 1440:.8f}" for i in k], "days of a spreadsheet"),
    "spreadsheet, hours": ([f"{45382 + i / 24:.8f}" for i in k], "days of a spreadsheet"),
    "MATLAB": ([f"{739342 + i / 86400:.8f}" for i in k], "may be days of MATLAB or seconds"),
    "Julian": ([f"{2460400.5 + i / 86400:.8f}" for i in k], "days of the Julian calendar"),
    "abbreviated zone": ([f"2024-01-01 00:00:{i:02d} CET" for i in k], "--time-zone Europe/Berlin"),
    "month first": ([f"3/31/2024 1:00:{i:02d} PM" for i in k],
                    "give --time-format '%m/%d/%Y %I:%M:%S %p'"),
    "half marked": ([f"11:00:{i:02d}{' AM' * (i % 2)}" for i in k], "some times have AM or PM"),
    "coarse": ([i // 4 for i in k], "give --rate HZ if the stamps are too coarse"),
}  # fmt: skip


@pytest.mark.parametrize("kind", NO_TIMES)
def test_times_that_are_not_guessed(tmp_path, kind):
    """Refused, with what decides."""
    values, words = NO_TIMES[kind]
    with pytest.raises(DataError, match=words):
        read(tmp_path, text(values))


def test_options_for_times(tmp_path):
    """A format, a zone over the change of the clocks, days of a spreadsheet."""
    table, _ = read(tmp_path, text(NO_TIMES["points"][0]), time_format="%d.%m.%Y %H:%M:%S")
    assert_allclose(np.diff(table.time()), 1.0)
    table, _ = read(tmp_path, text(NO_TIMES["summer time"][0]), time_zone="Europe/Berlin")
    assert_allclose(np.diff(table.time()), 1.0)
    table, _ = read(tmp_path, text(NO_TIMES["spreadsheet"][0]), mapping=["time=time:d"])
    assert_allclose(np.diff(table.time()), 1.0, atol=1e-3)
    table, _ = read(tmp_path, text(20240101 + k), time_format="%Y%m%d")
    assert_allclose(np.diff(table.time()), 86400.0)


@pytest.mark.parametrize("name", ["Time", "TIMESTAMP", "Time Stamp", "Date/Time", "UTC", "Zeit",
                                  "Elapsed Time [s]", "time_s", "t_ms", "LogTime", "rec_time",
                                  "time since start [s]", "Uhrzeit", "t(s)"])  # fmt: skip
def test_names_of_the_time(tmp_path, name):
    """A transient is not taken for steady points; a column that only may be the time is told."""
    table, _ = read(tmp_path, text(k * 0.5, tname=name))
    assert_allclose(np.diff(table.time()), 5e-4 if name == "t_ms" else 0.5)
    table, _ = read(tmp_path, text(k * 0.5, tname="clock"))
    assert table.time() is None and table.steady_hint() == "clock"


def test_dates_and_times_of_day_in_two_columns(tmp_path):
    """Joined, also over midnight; a day first is refused with the format that decides."""
    late = [f"23:59:{54 + i}" for i in k[:6]] + [f"00:00:0{i}" for i in k[:6]]
    for days, names, form in (
        (("2024-03-31", "2024-04-01"), "Date,Time", None),
        (("31-Mar-2024", "01-Apr-2024"), "Date,Time", None),
        (("31.03.2024", "01.04.2024"), "Datum,Uhrzeit", "%d.%m.%Y %H:%M:%S"),
    ):
        both = [f"{days[i > 5]},{c}" for i, c in enumerate(late)]
        if form is not None:
            with pytest.raises(DataError, match=f"Datum . Uhrzeit: .*--time-format '{form}'"):
                read(tmp_path, text(both, tname=names))
        table, notes = read(tmp_path, text(both, tname=names), time_format=form)
        assert_allclose(np.diff(table.time()), 1.0)
        assert any(f"column {names.replace(',', ' + ')}: dates" in n for n in notes)


def test_rate_order_and_pressure_are_given(tmp_path):
    """Stamps too coarse; rows that fell back, two of them of one stamp; gauge pressures."""
    table, notes = read(tmp_path, text(k // 4), rate=50.0)
    assert_allclose(table.time(), k * 0.02)
    assert "--rate goes before column time" in notes[0]
    rows = text(k * 0.5).splitlines()
    moved = [rows[0], *rows[3:5], *rows[1:3], *rows[5:]]
    moved[1:1] = [rows[3].replace("36050.500", "")]
    path = tmp_path / "y.csv"
    path.write_text("\n".join(moved))
    table = read_table(path, reading=Reading(sort=True), notes=(notes := []))
    assert_allclose(table.time(), k * 0.5)
    assert_allclose(table.get("T5", "K"), DATA["T5"][1] + 273.15)
    assert np.isfinite(table.get("N", "rad/s")).all() and "1 joined with another" in notes[0]
    path.write_text("P3 [psig],P5 [bar(g)],P0 [mbar]\n100,0.02,1013.25\n101,0.03,1013.25\n")
    table = read_table(path, notes=[])
    assert_allclose(table.get("P3", "Pa")[0], 101325 + 100 * 6894.757293168)
    assert_allclose(table.get("P5", "Pa"), [103325, 104325])


FRAME = pd.DataFrame({f"{n} [{d[0]}]": d[1] for n, d in DATA.items()})
DATES = pd.Timestamp("2024-01-01") + pd.to_timedelta(k * 0.5, "s")
LEVELS = pd.MultiIndex.from_tuples([(n, d[0]) for n, d in DATA.items()])
FRAMES = {
    "dates": FRAME.assign(time=DATES),
    "dates with a zone": FRAME.assign(time=DATES.tz_localize("Europe/Berlin")),
    "spans": FRAME.assign(time=DATES - DATES[0]),
    "index of dates": FRAME.set_index(DATES),
    "named index": FRAME.set_index(pd.Index(k * 0.5, name="t [s]")),
    "two levels": FRAME.set_index(
        pd.MultiIndex.from_arrays([["a"] * K, DATES], names=["unit", "time"])
    ),
    "text": FRAME.assign(time=[str(t) for t in DATES]),
    "columns of two levels": FRAME.set_axis(LEVELS, axis=1),
    "categories": FRAME.assign(**{"N [rpm]": pd.Categorical(DATA["N"][1])}),
    "numbers as text": FRAME.assign(**{"N [rpm]": [str(v) for v in DATA["N"][1]]}),
    "a note": FRAME.assign(note="x", ok=True),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_frames(tmp_path, kind):
    """Types of columns and indices; a time index is the time."""
    pytest.importorskip("pyarrow")
    table, notes = read(tmp_path, FRAMES[kind].to_parquet, "x.parquet")
    if kind not in ("columns of two levels", "categories", "numbers as text", "a note"):
        assert_allclose(np.diff(table.time()), 0.5)
        assert bool(notes) == (kind != "named index")
    else:
        assert table.time() is None and bool(notes) == (kind == "numbers as text")


@pytest.mark.parametrize(("column", "words"), [
    (["605"] * (K - 1) + ["x"], "data row 12, column T5: 'x' is no number"),
    ([True] * K, "column T5 holds no numbers: .*True"), (["x"] * K, "holds no numbers"),
    ([np.inf] * K, "infinite value"), ([[1.0, 2.0]] * K, "holds no numbers"),
    (DATES, "holds no numbers"),
])  # fmt: skip
def test_frames_without_numbers(tmp_path, column, words):
    """One word in a column, and columns of other things: never NaN in silence."""
    pytest.importorskip("pyarrow")
    with pytest.raises(DataError, match=words):
        read(tmp_path, FRAME.assign(**{"T5 [degC]": column}).to_parquet, "x.parquet")


SET = xr.Dataset({n: ("time", d[1], {"units": d[0]}) for n, d in DATA.items()},
                 coords={"time": k * 0.5})  # fmt: skip


def netcdf(ds, **encoding):
    return lambda path: ds.to_netcdf(path, engine="scipy", encoding=encoding)


def test_netcdf(tmp_path):
    """Dates as xarray writes them; fill values, scale and offset; a dimension of one."""
    for unit, values, step in (
        ("milliseconds since 2024-01-01", (k * 20).astype("i4"), 0.02),
        ("hours since 2024-01-01", k / 3600, 1.0),
        ("ms", k * 20, 0.02),
    ):
        ds = SET.assign_coords(time=("time", values, {"units": unit}))
        table, notes = read(tmp_path, netcdf(ds), "x.nc")
        assert_allclose(np.diff(table.time()), step)
        assert bool(notes) == ("since" in unit)
    hole = SET.copy()
    hole["T5"] = SET.T5.where(k != 3)
    packed = {"dtype": "int16", "scale_factor": 0.1, "add_offset": 100.0, "_FillValue": -32768}
    for ds, encoding in (
        (hole, {"T5": packed}),
        (SET.assign(T5=("time", np.where(k == 3, -9999.0, DATA["T5"][1]),
                        {"units": "degC", "missing_value": -9999.0})), {}),
    ):  # fmt: skip
        table, _ = read(tmp_path, netcdf(ds, **encoding), "x.nc")
        got = table.get("T5", "K")
        assert np.flatnonzero(np.isnan(got)).tolist() == [3]
        assert got[1] == pytest.approx(DATA["T5"][1][1] + 273.15, abs=0.051)
    read(tmp_path, netcdf(SET.assign(T5=SET.T5.expand_dims("k", axis=1))), "x.nc")


@pytest.mark.parametrize(("change", "words"), [
    ({"T5": (("time", "k"), np.ones((K, 2)))}, r"T5 has the dimensions \(time, k\)"),
    ({"T5": ("time", np.array(["ab"] * K))}, "column T5 holds no numbers: .*'ab'"),
    ({"T5": ("time", DATA["T5"][1], {"units": 5})}, "the unit must be text"),
    ({"T5": ("time", DATA["T5"][1], {"units": [1.0, 2.0]})}, "the unit must be text"),
])  # fmt: skip
def test_netcdf_variables_that_are_no_columns(tmp_path, change, words):
    """Said with the reason."""
    with pytest.raises(DataError, match=words):
        read(tmp_path, netcdf(SET.assign(change)), "x.nc")


def test_the_command_says_how_it_read(tmp_path, capsys):
    """One line for each thing that was understood; the refusal has status 2 and the remedy."""
    path = tmp_path / "x.csv"
    path.write_text(text(sep=";", comma=True), encoding="utf-8")
    assert main(["fit", str(path)]) == 0
    out = capsys.readouterr().out
    assert "12 steady points" in out and "read: " in out and "decimal commas" in out
    path.write_text(cell(3, "T5", "-999"), encoding="utf-8")
    assert main(["fit", str(path)]) == 2
    assert "data row 3, line 4: -999 degC" in capsys.readouterr().err
    for more in (["--missing=-999"], ["--exclude-implausible"]):
        assert main(["fit", str(path), *more, "--json"]) == 0
        assert '"readings": 11' in capsys.readouterr().out
    flagged = "\n".join(f"{x},{'valid' if not i else 'FALSE' if i == 2 else 'TRUE'}"
                        for i, x in enumerate(text().splitlines()))  # fmt: skip
    path.write_text(flagged, encoding="utf-8")
    assert main(["fit", str(path)]) == 0
    assert "column valid is not heeded: 1 of 12 rows" in capsys.readouterr().out


@pytest.mark.long
def test_the_command_takes_layouts(tmp_path, capsys):
    """Names, units and rate by options or by a file; words for gaps; many rows without time."""
    path, layout = tmp_path / "x.csv", tmp_path / "x.toml"
    path.write_text(text().split("\n", 1)[1], encoding="utf-8")
    names, units = ",".join(DATA), ",".join(d[0] for d in DATA.values())
    assert main(["fit", str(path)]) == 2
    assert "give --names A,B" in capsys.readouterr().err
    assert main(["fit", str(path), "--names", names, "--units", units]) == 0
    assert "12 steady points" in capsys.readouterr().out
    layout.write_text(f"names = {names.split(',')}\nunits = {units.split(',')}\n", "utf-8")
    assert main(["fit", str(path), "--columns", str(layout), "--rate", "20"]) == 0
    assert "12 samples of a transient" in capsys.readouterr().out
    path.write_text(cell(3, "T5", "off"), encoding="utf-8")
    assert main(["fit", str(path), "--missing=off", "--json"]) == 0
    assert '"readings": 11' in capsys.readouterr().out
    rows = text().splitlines()
    path.write_text("\n".join([*rows, *rows[1:]]), encoding="utf-8")
    assert main(["fit", str(path)]) == 0
    assert "no time column, so each row is taken as a steady" in capsys.readouterr().out


def test_temperatures_that_the_other_readings_refute(tmp_path, capsys):
    """All in SI but T5 in degC, which as K lies in the range; a hot day's T3 so too."""
    si = {n: d[1] * {"N": np.pi / 30, "P3": 1e3, "Wf": 1 / 3600, "PW": 1e3}.get(n, 1.0)
          + 273.15 * (n in ("T3", "T5")) for n, d in DATA.items()}  # fmt: skip
    path = tmp_path / "x.csv"
    for name, add in (("T5", 0.0), ("T3", 30.0)):
        wrong = {**si, name: si[name] - 273.15 + add}
        pd.DataFrame(wrong).to_csv(path, index=False)
        assert main(["fit", str(path)]) == 2
        err = capsys.readouterr().err
        assert (
            f"x.csv, column {name}: unit missing?" in err and f"--column {name}={name}:degC" in err
        )
        assert main(["fit", str(path), "--column", f"{name}={name}:degC"]) == 0
        capsys.readouterr()


@pytest.mark.parametrize(("name", "factor", "words"), [
    ("P3", 0.1, r"column P3: wrong unit\? 7.892e.04 Pa .* no compressor's .*--altitude"),
    ("Wf", 0.454, "columns Wf, PW and T5: 688.2 K .* too hot for an engine .*--range T5"),
])  # fmt: skip
def test_pressure_and_heat_that_cannot_be(tmp_path, name, factor, words):
    """kPa that are called hPa, kg/h that are called lb/h; believed where the range is given."""
    table, _ = read(tmp_path, text())
    readings = {n: table.get(n, d[2]) for n, d in DATA.items()}
    check_temperatures("x.csv", readings, {}, GasGenerator())
    readings[name] = readings[name] * factor
    with pytest.raises(DataError, match=words):
        check_temperatures("x.csv", readings, {}, GasGenerator())
    check_temperatures("x.csv", readings, {}, GasGenerator(), ("P3", "T5"))


def test_units_of_time_in_names(tmp_path):
    """TimeMs, and a column that is asked for by a name that is a unit."""
    for name, time in (("TimeMs", None), ("msec", "msec"), ("Elapsed Hours", None)):
        scale = 3600e-3 if "Hours" in name else 1.0
        cells = [f"{20 * i / 1e3 / 3600:.12f}" if scale != 1 else str(20 * i) for i in k]
        table, notes = read(tmp_path, text(cells, tname=name), time=time)
        assert_allclose(np.diff(table.time()), 0.02, atol=1e-6)
        assert any("as its name says" in n or "as Elapsed in h" in n for n in notes)


def test_calibration_points_have_the_same_ranges(tmp_path, capsys):
    """A pressure in kPa; a NaN; a cell that never ends: file, point or line, and no traceback."""
    path = tmp_path / "points.csv"
    start = "point,role,name,value,sigma\nA,fixed,N,3775.1,\nA,fixed,PW,4e5,\n"
    for line, words in (
        ("A,measured,P3,802,1\n", "point 'A': P3 = 802 Pa is not plausible (40000 to 2e+06)"),
        ("A,measured,P3,nan,1\n", "line 4: P3: no number stands there"),
        ("A,measured,P3,8_0,1\n", "line 4, column value: '8_0' is no number"),
        ("A,measured,P3,8e5," + "1" * 200_000 + "\n", "line 4: no CSV file: field"),
        ('A,measured,P3,"8e5,1\nA,measured,T3,560,1\n', "a quoted cell runs over several"),
        ("A,measured,P3,8e5,-1\n", "points.csv: A: measured P3"),
    ):
        path.write_text(start + line, encoding="utf-8")
        assert main(["calibrate", str(path)]) == 2
        err = capsys.readouterr().err
        assert words in err and len(err) < 400
