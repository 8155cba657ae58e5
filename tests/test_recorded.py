"""Recorded data files: what is read, converted, and refused with the line it happened in."""

import importlib.util

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError
from apu_casadi.core.results import dataset, save
from apu_casadi.core.units import UNITS, convert
from apu_casadi.unit.runsignals import RUN
from estimators.apu.recordings.recorded import parse_mapping, read_table


def written(tmp_path, text, name="run.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_csv_with_units_and_gaps(tmp_path):
    """Header forms, comments, empty and NaN cells, a byte order mark."""
    head = "\ufeff# bench 3\ntime [ms],N (rpm),P3 [kPa],T3\n"
    text = head + "0,36050,800,568\n\n20,,nan,569\n40,36000,NA,570\n"
    t = read_table(written(tmp_path, text))
    assert_allclose(t.time(), [0.0, 0.02, 0.04])
    assert_allclose(t.get("N", "rad/s"), [36050 * np.pi / 30, np.nan, 36000 * np.pi / 30])
    assert_allclose(t.get("P3", "Pa"), [8e5, np.nan, np.nan])
    assert_allclose(t.get("T3", "K"), [568, 569, 570])
    assert t.size == 3 and "N" in t and "T5" not in t


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_other_delimiters(tmp_path, delimiter):
    """The one that the header uses most."""
    text = "T3 [K];T5 [K]\n560;700\n".replace(";", delimiter)
    t = read_table(written(tmp_path, text, "run.txt"))
    assert t.get("T5", "K") == [700.0]


def test_columns_of_other_names(tmp_path):
    """--column T5=EGT_in:degC; the unit of the option goes before that of the header."""
    path = written(tmp_path, "EGT_in [K],p\n500,8\n")
    t = read_table(path, parse_mapping(["T5=EGT_in:degC", "P3=p:bar"]))
    assert t.get("T5", "K") == [773.15] and t.get("P3", "Pa") == [8e5]
    assert t.mapped == {"EGT_in", "p"} and "T5" in t
    with pytest.raises(DataError, match=r"no column 'EGT' for T5 \(did you mean 'EGT_in'"):
        read_table(path, parse_mapping(["T5=EGT"]))


@pytest.mark.parametrize(
    ("value", "unit", "si", "expected"),
    [
        (15.0, "degC", "K", 288.15), (59.0, "degF", "K", 288.15), (518.67, "degR", "K", 288.15),
        (14.695948775, "psi", "Pa", 101325.0), (1.01325, "bar", "Pa", 101325.0),
        (60.0, "rpm", "rad/s", 2 * np.pi), (180.0, "kg/h", "kg/s", 0.05),
        (7936.641438655, "lb/h", "kg/s", 1.0), (250.0, "kW", "W", 2.5e5),
        (1000.0, "ft", "m", 304.8), (2.0, "%", "1", 0.02), (5.0, "g/kg", "kg/kg", 0.005),
        (5.0, None, "K", 5.0),
    ],
)  # fmt: skip
def test_units(value, unit, si, expected):
    """Known values: the ice point's neighbours, the atmosphere, definitions of pound and foot."""
    assert convert(np.array(value), unit, si, "x") == pytest.approx(expected, rel=1e-9)


def test_a_difference_has_no_offset():
    """10 degC warmer than ISA is 10 K."""
    assert convert(np.array(10.0), "degC", "K", "dT_isa", difference=True) == 10.0
    assert convert(np.array(18.0), "degF", "K", "dT_isa", difference=True) == pytest.approx(10.0)


def test_unknown_and_unfitting_units():
    """The nearest unit is named; a pressure is no temperature."""
    with pytest.raises(DataError, match=r"P3: unknown unit 'kpa' \(did you mean 'kPa'"):
        convert(np.ones(1), "kpa", "Pa", "P3")
    with pytest.raises(DataError, match="T3: a unit of K is expected, 'bar' measures Pa"):
        convert(np.ones(1), "bar", "K", "T3")
    assert all(len(u) == 3 for u in UNITS.values())


@pytest.mark.parametrize(
    ("item", "words"),
    [
        ("T3", "NAME=COLUMN or NAME=COLUMN:UNIT"),
        ("T3=", "NAME=COLUMN"),
        ("T3=a:", "NAME=COLUMN"),
        ("T3=a:degX", "unknown unit 'degX'"),
    ],
)
def test_options_of_the_wrong_form(item, words):
    """Said with what is expected."""
    with pytest.raises(DataError, match=words):
        parse_mapping([item])
    with pytest.raises(DataError, match="T3 given twice"):
        parse_mapping(["T3=a", "T3=b"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "run.csv: empty"),
        ("# only this\n", "run.csv: empty"),
        ("T3,T5\n", "no data rows"),
        ("1,2\n3,4\n", "a line of column names is expected first"),
        ("T3,\n1,2\n", "line 1: column 2 has no name"),
        ("T3,T5\n1,2\n3\n", "line 3: 1 cells, but 2 columns are named; is the file cut off"),
        ("T3,T5\n1,2\n\n3,x4\n", "line 4, column T5: 'x4' is no number"),
        ("T3,T5\n1,inf\n", "'inf' is no number"),
        ("T3 [K],T3\n1,2\n", "two columns are named 'T3'"),
        ('T3,T5\n1,"2\n3,4\n', "quote"),
    ],
)
def test_damaged_csv(tmp_path, text, words):
    """The line and the column are named."""
    with pytest.raises(DataError, match=words):
        read_table(written(tmp_path, text))


def test_files_that_are_none(tmp_path):
    """Missing, of an unknown kind, binary."""
    with pytest.raises(DataError, match="no such file"):
        read_table(tmp_path / "none.csv")
    with pytest.raises(DataError, match=r"unknown kind of file '.xls'"):
        read_table(written(tmp_path, "x", "run.xls"))
    path = tmp_path / "run.csv"
    path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(DataError, match="not a text file in UTF-8"):
        read_table(path)
    path.write_bytes(b"T3\0")
    with pytest.raises(DataError, match="binary data"):
        read_table(path)


def test_time(tmp_path):
    """Rows must follow each other; the first that does not is named."""
    t = read_table(written(tmp_path, "t [s],T3\n0,1\n2,1\n1,1\n1,1\n"))
    with pytest.raises(DataError, match=r"data row 3 has 1 s after 2 s \(2 such rows\)"):
        t.time()
    t = read_table(written(tmp_path, "time,T3\n0,1\n,1\n"))
    with pytest.raises(DataError, match="column time has a gap in data row 2"):
        t.time()
    t = read_table(written(tmp_path, "clock,T3\n0,1\n5,1\n"))
    assert t.time() is None
    assert_allclose(t.time("clock"), [0, 5])
    with pytest.raises(DataError, match=r"no column 'clok' \(did you mean 'clock'"):
        t.time("clok")
    with pytest.raises(DataError, match="no column 'T5'"):
        t.get("T5", "K")


def test_netcdf_with_units_in_attributes(tmp_path):
    """What the package itself saves; a column in kPa; another dimension is left out."""
    ds = dataset({"time": [0.0, 0.02]}, {"time": {"T4": [1200.0, np.nan]}}, signals=RUN)
    ds["P3"] = ("time", [800.0, 810.0], {"units": "kPa"})
    ds["other"] = ("k", [1.0, 2.0, 3.0])
    t = read_table(save(ds, tmp_path / "run.nc"))
    assert_allclose(t.get("T4", "K"), [1200, np.nan])
    assert_allclose(t.get("P3", "Pa"), [8e5, 8.1e5])
    assert_allclose(t.time(), [0, 0.02])
    assert "other" not in t


def test_damaged_netcdf(tmp_path):
    """Cut in the middle, or another kind of file altogether."""
    path = save(
        dataset({"time": [0.0, 1.0]}, {"time": {"T4": [1.0, 2.0]}}, signals=RUN),
        tmp_path / "run.nc",
    )
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(DataError, match="damaged netCDF file of 60 bytes"):
        read_table(path)
    path.write_bytes(b"hello")
    with pytest.raises(DataError, match="not a netCDF 3 file"):
        read_table(path)
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(DataError, match=r"netCDF 4 file; reading it needs|damaged netCDF"):
        read_table(path)
    save(xr.Dataset(), path)
    with pytest.raises(DataError, match="no data rows"):
        read_table(path)


def test_parquet_names_what_to_install(tmp_path, monkeypatch):
    """Without an engine nothing is guessed."""
    import apu_casadi.core.tables.binaryfiles as module

    path = tmp_path / "run.parquet"
    path.write_bytes(b"PAR1")
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(DataError, match="needs pandas and pyarrow: pip install pandas pyarrow"):
        read_table(path)


@pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="needs pyarrow")
def test_real_parquet(tmp_path):
    """The same with a real file."""
    import pandas as pd

    path = tmp_path / "run.parquet"
    pd.DataFrame({"T3 [degC]": [295.0, None]}).to_parquet(path)
    assert_allclose(read_table(path).get("T3", "K"), [568.15, np.nan])
    pd.DataFrame({"T3 [degC]": [295.0, 296.0], "note": ["a", "b"]}).to_parquet(path)
    t = read_table(path)
    assert_allclose(t.get("T3", "K"), [568.15, 569.15])
    assert np.isnan(t.columns["note"].values).all()
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(DataError, match="damaged Parquet file"):
        read_table(path)
