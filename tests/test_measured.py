"""The shared reader: gas path and electrical recordings from files and memory, on one time."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError
from apu_casadi.core.results import dataset
from apu_casadi.unit.runsignals import RUN
from estimators.apu.recordings.layout import Reading, read_layout
from estimators.apu.recordings.measured import read_recording

K = 400
t = np.arange(K) * 1e-3
#: Three phase currents, A, of a public inter-turn data set's kind.
I = {
    f"i_{p}": 320 * np.sin(2 * np.pi * 50 * t - a)
    for p, a in zip("abc", (0, 2.1, 4.2), strict=True)
}
NAMES = ("i_a", "i_b", "i_c")
GAS = pd.DataFrame({"T5 [degC]": [500.0, 501.0, 502.0], "note": "x"})
DAY = pd.date_range("2024-01-01 00:00", periods=3, freq="s", tz="Europe/Berlin")
WAVES = pd.DataFrame({f"{n} [A]": v for n, v in I.items()})
LATER = pd.date_range("2023-12-31T23:00:01Z", periods=K, freq="ms")


def no_header(path, sep=","):
    path.write_text(
        "\n".join(sep.join(f"{x:.6f}" for x in r) for r in zip(*I.values(), strict=True))
    )
    return path


@pytest.mark.parametrize("sep", [",", ";", "\t", " "])
def test_a_file_without_names_and_time(tmp_path, sep):
    """Three columns at 1 kHz: names, units and rate are given, by name or by a file of them."""
    path = no_header(tmp_path / "w.csv", sep)
    with pytest.raises(DataError, match="column names is expected first: give --names"):
        read_recording(path)
    layout = tmp_path / "layout.toml"
    layout.write_text('names = ["i_a", "", "i_c"]\nunits = ["A", "", "A"]\nrate = 1000\n')
    data = read_recording(path, names=NAMES, units=("A", "A", "A"), rate=1000)
    for n, v in I.items():
        assert_allclose(data[n].values, v, atol=1e-6)
        assert_allclose(data[n].t, t, atol=1e-12)
    assert (
        data.electrical == NAMES and data.gaspath == () and data["i_a"].rate == pytest.approx(1e3)
    )
    assert data.lacking(("v_a", "i_a", "w_r")) == ("v_a", "w_r")
    assert tuple(read_recording(path, columns=layout)) == ("i_a", "i_c")
    with pytest.raises(DataError, match="3 cells, but 2 names are given"):
        read_recording(path, names=("i_a", "i_b"))
    with pytest.raises(DataError, match="no column is the time"):
        read_recording(path, names=NAMES)


def test_from_memory_in_three_lines():
    """Arrays by name, an array of columns, a frame, a series, a dataset, an array with its unit."""
    made = {
        "arrays": ({"t [ms]": 1e3 * t, **I}, {}),
        "columns": (np.array(list(I.values())).T, {"names": NAMES, "rate": 1000}),
        "frame": (WAVES.set_index(pd.Index(t, name="time")), {}),
        "dates": (WAVES.set_index(LATER), {}),
        "series": (pd.Series(I["i_a"], index=pd.to_timedelta(t, "s"), name="i_a [A]"), {}),
        "dataset": (xr.Dataset({n: ("time", v) for n, v in I.items()}, {"time": t}), {}),
        "units in names": (
            pd.DataFrame(
                {f"{n} [mA]": 1e3 * v for n, v in I.items()}, index=pd.Index(t, name="t [s]")
            ).to_xarray(),
            {},
        ),
        "array": (xr.DataArray(I["i_a"] / 1e3, {"time": t}, name="i_a", attrs={"units": "kA"}), {}),
    }
    for what, (source, how) in made.items():
        data = read_recording(source, **how)
        assert_allclose(data["i_a"].values, I["i_a"], rtol=1e-12, err_msg=what)
        assert_allclose(data["i_a"].t, t, atol=1e-9, err_msg=what)
    hidden = np.ma.masked_greater(I["i_a"], 300)
    assert (
        np.isnan(read_recording({"t": t, "i_a": hidden})["i_a"].values).sum() == hidden.mask.sum()
    )


def test_several_sources_on_one_time():
    """A frame with a zone at 1 Hz and waveforms in UTC at 1 kHz, from one instant on."""
    data = read_recording(GAS.set_index(DAY), WAVES.set_index(LATER))
    assert data.start == np.datetime64("2023-12-31T23:00:00")
    assert data["i_a"].t[0] == 1.0 and data["T5"].t[0] == 0.0 and data.unused == ("note",)
    assert_allclose(data["T5"].values, [773.15, 774.15, 775.15])
    joined = data.samples("T5", "i_a")
    assert joined["t"].size == K + 2 and np.isfinite(joined["T5"]).sum() == 3
    assert np.isfinite(joined["i_a"]).sum() == K
    ds = data.dataset()
    assert ds.T5.dims == ("time",) and ds.i_a.dims == ("time_w",) and ds.i_a.units == "A"
    # the same by a local time, told the zone
    local = GAS.set_index(DAY.tz_localize(None))
    again = read_recording(local, WAVES.set_index(LATER), time_zone="Europe/Berlin")
    assert_allclose(again["i_a"].t, data["i_a"].t, atol=1e-9)
    for other, words in (
        ({"t": t, **I}, "has dates and arrays has none: they have no common time"),
        (WAVES.set_index(LATER.tz_localize(None)), "with a zone and some without"),
        (GAS.set_index(DAY), "T5 is in DataFrame, column T5 and in DataFrame"),
    ):
        with pytest.raises(DataError, match=words):
            read_recording(GAS.set_index(DAY), other)
    plain = read_recording({"t": [0.0, 1.0], "T5": [700.0, 701.0]}, {"t": t, **I})
    assert any("from the same instant" in n for n in plain.notes)


def test_a_run_file_of_two_rates(tmp_path):
    """Both time coordinates of a netCDF file; gaps are left out of the streams."""
    ds = xr.Dataset(
        {"T5": ("time", [700.0, np.nan, 702.0], {"units": "K"}),
         "i_a": ("time_w", I["i_a"], {"units": "A"}), "f_eta_c": ("time", [1.0, 1.0, 1.0])},
        {"time": [0.0, 0.02, 0.04], "time_w": t},
    )  # fmt: skip
    ds.to_netcdf(tmp_path / "r.nc", engine="scipy")
    data = read_recording(tmp_path / "r.nc")
    assert data["T5"].t.size == 3 and data["i_a"].t.size == K and "f_eta_c" in data.unused
    at, values = data.streams("T5")["T5"]
    assert_allclose(at, [0, 0.04])
    assert_allclose(values, [700, 702])


def test_two_machines():
    """Quantities of each by their plain names; the number is at the end of the name."""
    data = read_recording({"t": t, "i_a_1 [A]": I["i_a"], "i_a_2 [A]": I["i_b"], "N": t + 3775})
    assert data.electrical == ("i_a_1", "i_a_2") and data.gaspath == ("N",)
    assert_allclose(data.machine(2)["i_a"].values, I["i_b"])
    assert read_recording({"t": t, "i_a": I["i_a"]}).machine(1)["i_a"].t.size == K


def test_generators_of_a_run():
    """A dimension of generators becomes a quantity for each; what has others is told."""
    waves = np.array([I["i_a"], I["i_b"]])
    ds = dataset({"time": [0.0, 0.02], "time_w": t}, {"time": {"T5": [700.0, 701.0]},
                 "time_w": {"i_a": waves}}, signals=RUN, generators=2)  # fmt: skip
    ds["spectrum"] = (("time", "order"), np.ones((2, 3)))
    data = read_recording(ds)
    assert tuple(sorted(data)) == ("T5", "i_a_1", "i_a_2")
    assert_allclose(data.machine(2)["i_a"].values, I["i_b"])
    assert any(n.startswith("spectrum (has the dimensions (time, order)") for n in data.unused)


def test_names_of_the_recording_itself():
    """Quantities by the columns that hold them."""
    source = {"t": t, "EGT": 0 * t + 500, "CH1": I["i_a"] / 10, "NGG": 0 * t + 36050}
    how = {"T5": "EGT:degC", "i_a": "CH1", "N": "NGG:rpm"}
    data = read_recording(source, columns=how)
    assert data["T5"].values[0] == 773.15 and data["T5"].source == "arrays, column EGT"
    assert data["N"].values[0] == pytest.approx(36050 * np.pi / 30) and data.unused == ()
    with pytest.raises(DataError, match="columns: unknown quantity"):
        read_recording(source, columns={"T9": "EGT"})
    with pytest.raises(DataError, match="no column 'EGT2' for T5"):
        read_recording(source, columns={"T5": "EGT2"})


@pytest.mark.parametrize(("value", "words"), [
    (-9999.0, "stands apart from all other readings"), (-999.0, "stands apart"),
    (1e30, "no possible i_a"), (32767.0, "no possible i_a"), (np.inf, "infinite value"),
])  # fmt: skip
def test_a_code_among_samples(value, words):
    """A sentinel in a waveform is refused; given as missing, it is a gap."""
    samples = I["i_a"].copy()
    samples[5] = value
    with pytest.raises(DataError, match=words):
        read_recording({"t": t, "i_a": samples})
    if np.isfinite(value):
        data = read_recording({"t": t, "i_a": samples}, missing=[value])
        assert np.flatnonzero(np.isnan(data["i_a"].values)).tolist() == [5]


def test_what_looks_wrong_is_told():
    """A transducer that clips, a channel that stands still while others move, all in kA."""
    noisy = {n: v + np.random.default_rng(1).normal(0, 1, v.shape) for n, v in I.items()}
    clipped = np.clip(noisy["i_a"], -250, 250)
    data = read_recording({"t": t, "i_a": clipped, "i_b": noisy["i_b"]})
    assert next(n for n in data.notes if "clipped?" in n).startswith("arrays, column i_a: ")
    assert not any("i_b" in n for n in data.notes)
    noise = np.random.default_rng(1).standard_normal((2, 100))
    moving = {"t": np.arange(100.0), "T3": 560 + noise[0], "T5": 700 + noise[1]}
    moving["T5"][40:70] = 700.5
    data = read_recording(moving)
    assert "data row 41 to 70: 700.5 in 30 rows while all others change: stuck?" in data.notes[0]
    with pytest.raises(DataError, match=r"wrong unit\? 320 is plausible as A or mA"):
        read_recording({"t": [0.0, 1.0, 2.0], "i_a [kA]": [320.0, 310.0, -300.0]})


@pytest.mark.parametrize(("source", "how", "words"), [
    (5, {}, "a file name, a table of arrays"), ({"t": t, "i_a": t[:5]}, {}, "arrays of one shape"),
    ({"t": t, "x": t}, {}, "none of the columns t, x is a quantity"),
    ({"t": t, **I}, {"rte": 1}, r"unknown option 'rte' \(did you mean 'rate'"),
    (np.ones((3, 2)), {"names": ("i_a",), "rate": 1.0}, "2 columns, but 1 names are given"),
    ("none.csv", {}, "none.csv: no such file"),
    ({"t": 20 * np.arange(9), "i_a": t[:9]}, {}, "steps of 20 s are no sampling of a waveform"),
    ({"t": [0, 1, 1], "i_a": [1.0, 2.0, 3.0]}, {}, "--rate HZ if the stamps are too"),
    ({"t": [0, 1, 1], "i_a": [1.0, 2.0, 3.0]}, {"sort": True}, "another row of the same stamp"),
])  # fmt: skip
def test_what_is_no_recording(source, how, words):
    """Said with what is expected."""
    with pytest.raises(DataError, match=words):
        read_recording(source, **how)
    with pytest.raises(DataError, match="no recording is given"):
        read_recording()


def test_rows_in_the_order_of_time():
    """Sorted where asked for; rows of one stamp that complete each other are one."""
    source = {
        "t": [2.0, 0.0, 1.0, 1.0],
        "T3": [562.0, 560, 561, np.nan],
        "T5": [702, 700, np.nan, 701],
    }
    data = read_recording(source, sort=True)
    assert_allclose(data["T5"].t, [0, 1, 2])
    assert_allclose(data["T5"].values, [700, 701, 702])
    assert_allclose(data["T3"].values, [560, 561, 562])
    assert any("in the order of time" in n for n in data.notes)


LAYOUT = """
time = "when"
time_format = "%d.%m.%Y %H:%M:%S"
decimal = "comma"
missing = [-1, "off"]
barometer = "1013.25 mbar"
[columns]
T5 = "EGT_in:degC"
P3 = {column = "p", unit = "barg"}
[ranges]
T5 = [250, 1300]
"""


def test_a_file_of_columns(tmp_path):
    """All that it may hold, at work; and each mistake in it with the key."""
    path, layout = tmp_path / "x.csv", tmp_path / "layout.toml"
    path.write_text("when;EGT_in;p\n04.03.2024 10:00:00;500,5;7,0\n04.03.2024 10:00:01;off;-1\n")
    layout.write_text(LAYOUT)
    data = read_recording(path, columns=layout)
    assert_allclose(data["T5"].values, [773.65, np.nan])
    assert_allclose(data["P3"].values, [801325.0, np.nan])
    assert_allclose(data["T5"].t, [0, 1])
    assert any("to which the air's is added: 101325 Pa" in n for n in data.notes)
    reading, columns = read_layout(layout)
    assert reading.ranges == {"T5": (250.0, 1300.0)} and columns["P3"] == ("p", "barg")
    assert isinstance(reading, Reading) and reading.missing == (-1, "off")


@pytest.mark.parametrize(("text", "words"), [
    ("foo = 1", "unknown key 'foo'"), ('names = "a"', "names: a list of texts"), ("x", "no"),
    ('rate = "x"', "rate: a number of Hz"), ("rate = -1", "must be > 0"), ("columns = 1", "a t"),
    ("missing = [true]", "missing: a list of numbers and texts"), ('units = ["A"]', "1 for 0"),
    ("[columns]\nT5 = 1", r"columns.T5: \"COLUMN:UNIT\""), ('names = ["a", "a"]', "given twice"),
    ('[columns]\nT5 = "a:degX"', "unknown unit 'degX'"), ('decimal = "x"', "point or comma"),
    ("[ranges]\nT5 = [1]", "ranges.T5: .*LOW, HIGH"), ("[ranges]\nTT = [1, 2]", "unknown quantity"),
    ("names_line = 0", "names_line: a number of a line"), ('barometer = "5 kg"', "a pressure"),
    ("barometer = 101325", "a pressure with unit"), ('delimiter = "ab"', "one character"),
    ('names = ["i_a"]\nunits = ["B"]', "unknown unit 'B'"), ("sort = 1", "true or false"),
])  # fmt: skip
def test_mistakes_in_a_file_of_columns(tmp_path, text, words):
    """Named with file and key."""
    path = tmp_path / "layout.toml"
    path.write_text(text + "\n")
    with pytest.raises(DataError, match=rf"layout.toml: .*{words}|layout.toml: {words}"):
        read_layout(path)


def test_netcdf_4_is_read_where_its_package_is(tmp_path):
    """Dates, a damaged file, and variables in groups, which are not looked for."""
    pytest.importorskip("h5netcdf")
    day = pd.date_range("2026-01-01", periods=3, freq="100ms")
    ds = xr.Dataset({"T3": ("time", [500.0, 501.0, 502.0], {"units": "K"})}, {"time": day})
    path = tmp_path / "a.nc"
    ds.to_netcdf(path, engine="h5netcdf")
    data = read_recording(path)
    assert_allclose(data["T3"].t, [0, 0.1, 0.2], atol=1e-12)  # a date counts nanoseconds
    assert_allclose(data["T3"].values, [500, 501, 502])
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(DataError, match="damaged netCDF file"):
        read_recording(path)
    ds.to_netcdf(tmp_path / "g.nc", group="flight", engine="h5netcdf")
    with pytest.raises(DataError, match=r"in groups .*/flight"):
        read_recording(tmp_path / "g.nc")
