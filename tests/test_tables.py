"""Tables as instruments and spreadsheets write them, in every place that reads one.

Each kind of oddity is either read as the plain file is, or refused with reason and remedy.
"""

import re

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from apu_casadi.core import results
from apu_casadi.core.errors import ApuError, DataError
from apu_casadi.core.tables.sentinels import sentinel
from apu_casadi.gaspath.calibration import read_points
from apu_casadi.gaspath.maps.mapfiles import read_map
from estimators.apu.recordings.recorded import read_table
from scenarios.datasets import scoring
from scenarios.reading import read_load, read_profile


def of_recording(path):
    table = read_table(path, notes=[])
    return [table.time(), table.get("N", "rad/s"), table.get("T3", "K")]


def of_profile(path):
    made = read_profile({"file": str(path)}, "altitude")
    return [made.times, made.points]


def of_map(path):
    made = read_map(path)
    return [made.N, made.beta, made.W, made.PR, made.eta, made.surge_W, made.surge_PR]


def of_points(path):
    (p,) = read_points(path)
    return [list(p.fixed.values()), *map(list, p.measured.values())]


def of_predictions(path):
    labels = {"run": np.arange(4), "class": np.array(["healthy"] * 4)}
    return [scoring.read_predictions(path, labels).values[n] for n in ("run", "h", "alarm_time")]


def of_result(path):
    ds = results.load(path)
    return [ds["time"].values, ds["T4"].values, ds["P3"].values]


T = range(8)
GRID = [
    [f"{n:.2f}", f"{b:.2f}", f"{5 * n + 0.4 * b:.3f}", f"{1.5 + n - 0.3 * b:.3f}", "0.80"]
    for n in (0.7, 0.8, 0.9, 1.0)
    for b in (0.0, 0.25, 0.5, 0.75, 1.0)
]
# place: (reader, lines above, names, units, rows, row and column of the cell that goes wrong,
# rows below)
PLACES = {
    "recording": (of_recording, [], "time N T3", "s rad/s K",
                  [[f"{0.5 * k:.1f}", f"{3700.5 + k:.1f}", f"{560.2 + 3 * k:.1f}"] for k in T],
                  (3, 2), []),
    "profile": (of_profile, [], "time altitude", "s m",
                [[f"{0.5 * k:.1f}", f"{100.5 * k:.1f}"] for k in T], (3, 1), []),
    "map": (of_map, ["# kind: compressor"], "N beta W PR eta", "- - kg/s - -", GRID, (7, 2),
            [["W_surge", "PR_surge"], *([f"{2.5 + k:.1f}", f"{2.9 + k:.1f}"] for k in range(4))]),
    "points": (of_points, [], "point role name value sigma", "- - - - -",
               [["a", "fixed", "N", "3775.5", ""], ["a", "fixed", "PW", "221821.5", ""],
                ["a", "measured", "W2", "1.6817", "0.0002"],
                ["a", "measured", "T3", "560.25", "0.5"]], (2, 3), []),
    "predictions": (of_predictions, [], "run class h alarm_time", "- - - s",
                    [[str(k), "ttsc", f"{0.25 * k:.2f}", f"{2.5 + k:.1f}"] for k in range(4)],
                    (1, 2), []),
    "result": (of_result, [], "time T4 P3", "s K Pa",
               [[f"{0.5 * k:.1f}", f"{1200.5 + k:.1f}", f"{4e5 + k:.1f}"] for k in T], (3, 1), []),
}  # fmt: skip


def table(place, *, sep=",", comma=False, units="", above=(), cell=None, more=None, end="",
          encoding="utf-8", time=None):  # fmt: skip
    """Return the bytes of a file of a place."""
    _, comments, names, own, rows, (i, j), below = PLACES[place]
    names, own = names.split(), own.split()
    rows = [list(r) for r in rows]
    if cell is not None:
        rows[i][j] = cell
    if time is not None:
        rows = [[time(k), *r[1:]] for k, r in enumerate(rows)]
    head = (
        [f"{n} [{u}]" for n, u in zip(names, own, strict=True)] if units == "names" else list(names)
    )
    if place == "result" and not units:
        head = [f"{n} [{u}]" for n, u in zip(names, own, strict=True)]
    if more is not None:
        head, rows = [*head, more[0]], [[*r, more[1]] for r in rows]
    lines = [head, *([own] if units == "row" else []), *rows, *below]
    if comma:
        lines = [[re.sub(r"^(-?\d+)\.(\d+)$", r"\1,\2", c) for c in r] for r in lines]
    texts = [*above, *comments, *(sep.join(r) + end for r in lines)]
    return "\r\n".join([*texts, ""]).encode(encoding)


READ = "read"
NO_TIME = {"map", "points", "predictions"}
#: kind of oddity -> how the file is made, and what comes of it where it is not read rightly
ODD = {
    "semicolons, decimal commas": ({"sep": ";", "comma": True}, {}),
    "tabs, decimal commas": ({"sep": "\t", "comma": True}, {}),
    "UTF-16": ({"encoding": "utf-16"}, {}),
    "UTF-8 with mark": ({"encoding": "utf-8-sig"}, {}),
    "Latin-1": ({"above": ["# Höhe über Grund"], "encoding": "latin-1"}, {}),
    "units in a second row": ({"units": "row"}, {}),
    "units in names": ({"units": "names"}, {}),
    "trailing comma": ({"end": ","}, {}),
    "sep= line": ({"sep": ";", "above": ["sep=;"]}, {}),
    "sep= line, decimal commas": ({"sep": ";", "comma": True, "above": ['"sep=;"']}, {}),
    "a text column": (
        {"more": ("remark", "so la la")},
        {"map": "must hold N,beta,W,PR,eta, each once.* delete the other columns",
         "predictions": r"column 'remark' .*: rename or delete it",
         "result": "column remark: no numbers; a recording is read by read_recording"}),
    "masked": (
        {"cell": "--"},
        {"profile": r"line 5, column altitude: no number.*missing = \[\]",
         "map": "line 10, column W: no number stands there: .*fill the cell or remove",
         "result": "column T4: no numbers; a recording is read by read_recording",
         "points": "line 4: W2: no number stands there: complete the row",
         "predictions": "line 3: h = '--' is no finite number: leave the cell empty"}),
    "-999": (
        {"cell": "-999"},
        {"recording": "line 5: -999 K is no possible T3.* --missing -999",
         "profile": r"line 5, column altitude: -999 stands for no reading.* missing = \[-999\]",
         "map": "line 10, column W: -999 stands for no reading .*remove the whole",
         "points": "line 4, column value: -999 stands for no reading",
         "predictions": "line 3, column h: -999 stands for no reading .*leave the cell empty",
         "result": "column T4, row 4: -999 stands for no reading.*read_recording"}),
    "9999": (
        {"cell": "9999"},
        {"recording": "9999 K is no possible T3.* --missing 9999",
         "profile": r"line 5, column altitude: 9999 stands for no reading.* missing = \[9999\]",
         "map": "line 10, column W: 9999 stands for no reading",
         "points": "line 4, column value: 9999 stands for no reading",
         "predictions": "line 3, column h: 9999 stands for no reading"}),
    "1e20": (
        {"cell": "1e20"},
        {"recording": r"1e\+20 K is no possible T3",
         "profile": r"line 5, column altitude: 1e\+20 stands for no reading",
         "map": r"line 10, column W: 1e\+20 stands for no reading",
         "points": r"line 4, column value: 1e\+20 stands for no reading",
         "predictions": r"line 3, column h: 1e\+20 stands for no reading",
         "result": r"column T4, row 4: 1e\+20 stands for no reading"}),
    "dates with zones": (
        {"time": lambda k: f"2024-03-31T01:59:{10 + k}.000+02:00"},
        {"profile": "column time: '2024-03-31T.*is no number: numbers are expected, not dates",
         "result": "column time: no numbers; a recording is read by read_recording"}),
}  # fmt: skip


def plain(tmp_path, place):
    path = tmp_path / "plain.csv"
    path.write_bytes(table(place))
    return PLACES[place][0](path)


def same(found, wanted, place):
    assert len(found) == len(wanted)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), rtol=1e-12)


@pytest.mark.parametrize("kind", ODD)
@pytest.mark.parametrize("place", PLACES)
def test_each_kind_is_read_or_refused(tmp_path, place, kind):
    """As the plain file, or not at all: with the place in the file, the reason and the remedy."""
    how, refused = ODD[kind]
    if "time" in how and place in NO_TIME:
        pytest.skip("no time there")
    path = tmp_path / "odd.csv"
    path.write_bytes(table(place, **how))
    if place in refused:
        with pytest.raises(ApuError, match=refused[place]) as e:
            PLACES[place][0](path)
        assert "odd.csv" in str(e.value)
        return
    found, wanted = PLACES[place][0](path), plain(tmp_path, place)
    if "time" in how:
        found, wanted = found[1:], wanted[1:]
    if kind in ("masked", "9999"):  # a gap of a recording; a result stands as it is
        i, j = PLACES[place][5]
        found = [np.array(a, float) for a in found]
        kept = np.isnan(found[j][i]) if kind == "masked" else found[j][i] == 9999.0
        assert kept, (kind, found[j])
        found[j][i] = wanted[j][i]
    same(found, wanted, place)


def frame(place):
    _, _, names, units, rows, _, _ = PLACES[place]
    columns = {}
    for n, u, cells in zip(names.split(), units.split(), zip(*rows, strict=True), strict=True):
        label = n if u == "-" else f"{n} [{u}]"
        numbers = [c if re.search("[A-Za-z]", c) else float(c or "nan") for c in cells]
        whole = n == "run"
        columns[label] = [int(c) for c in cells] if whole else numbers
    return pd.DataFrame(columns)


@pytest.mark.parametrize("place", PLACES)
def test_parquet_with_its_first_column_as_the_index(tmp_path, place):
    f = frame(place)
    f.set_index(f.columns[0]).to_parquet(tmp_path / "odd.parquet")
    if place == "map":
        with pytest.raises(DataError, match=r"odd\.parquet: .*export .*CSV"):
            PLACES[place][0](tmp_path / "odd.parquet")
        return
    same(PLACES[place][0](tmp_path / "odd.parquet"), plain(tmp_path, place), place)


@pytest.mark.parametrize("place", ["recording", "profile", "result"])
def test_netcdf_with_masked_values(tmp_path, place):
    """What is masked is a gap of a recording and of a result, and refused in a profile."""
    f = frame(place)
    ds = xr.Dataset({c.split(" [")[0]: ("time", f[c].to_numpy()) for c in f.columns[1:]})
    ds = ds.assign_coords(time=("time", f.iloc[:, 0].to_numpy(), {"units": "s"}))
    results.save(ds, tmp_path / "whole.nc")
    same(PLACES[place][0](tmp_path / "whole.nc"), plain(tmp_path, place), place)
    name = list(ds.data_vars)[-1]
    ds[name] = ds[name].where(np.arange(ds.sizes["time"]) != 3)
    results.save(ds, tmp_path / "odd.nc")
    if place == "profile":
        with pytest.raises(ApuError, match=r"data row 4, column altitude: no number stands"):
            PLACES[place][0](tmp_path / "odd.nc")
    else:
        assert np.isnan(np.asarray(PLACES[place][0](tmp_path / "odd.nc")[-1])[3])


def test_dates_of_a_profile_in_binary_files(tmp_path):
    """A time index of dates is refused, one of spans is read."""
    for start, ok in ((pd.Timestamp("2024-03-31", tz="CET"), False), (pd.Timedelta(0), True)):
        index = pd.Index([start + pd.Timedelta(k, "s") for k in range(4)], name="time")
        pd.DataFrame({"altitude": np.arange(4.0)}, index).to_parquet(tmp_path / "odd.parquet")
        if ok:
            assert of_profile(tmp_path / "odd.parquet")[0] == (0.0, 1.0, 2.0, 3.0)
        else:
            with pytest.raises(ApuError, match=r"column time: .*times are seconds from the start"):
                of_profile(tmp_path / "odd.parquet")


def test_units_of_profiles_are_those_of_the_scenario(tmp_path):
    """Feet, minutes, watts and per cent, in names, become what the key is in."""
    (tmp_path / "p.csv").write_text(
        "time [min],altitude [ft],power_kW [W],power_factor [%],N_ref_rpm [rad/s]\n"
        "0,0,5000,80,3769.911184307752\n1,1000,6000,90,3769.911184307752\n"
    )
    file = {"file": str(tmp_path / "p.csv")}
    assert read_profile(file, "altitude").times == (0.0, 60.0)
    assert read_profile(file, "altitude").points == pytest.approx((0.0, 304.8))
    assert read_profile(file, "N_ref_rpm").points == pytest.approx((36000.0, 36000.0))
    load = read_load({"kind": "RL", "power_kW": file, "power_factor": file})
    assert load.profiles["power_kW"].points == pytest.approx((5.0, 6.0))
    assert load.profiles["power_factor"].points == pytest.approx((0.8, 0.9))
    with pytest.raises(ApuError, match="a unit of m is expected, 'W' measures W"):
        read_profile({**file, "column": "power_kW"}, "altitude")


@pytest.mark.parametrize(
    ("text", "keys", "points"),
    [
        ("time,altitude\n0,1\n1,-999\n2,5\n", {"missing": [-999]}, (1.0, 5.0)),
        ("time,altitude\n0,1\n1,off\n2,5\n", {"missing": ["off"]}, (1.0, 5.0)),
        ("time,altitude\n0,1\n1,\n2,5\n", {"missing": []}, (1.0, 5.0)),
        ("time,altitude\n0,1\n1,9999\n2,5\n", {"missing": []}, (1.0, 9999.0, 5.0)),
        ("time,altitude\n0,1\n1,9999\n2,10500\n", {}, (1.0, 9999.0, 10500.0)),
        ("time;altitude\n0;1,500\n1;2,250\n", {"decimal": "comma"}, (1.5, 2.25)),
        ('time,altitude\n0,"1,500"\n1,2\n', {"decimal": "point"}, (1500.0, 2.0)),
    ],
)
def test_keys_of_a_profile_decide_what_its_file_leaves_open(tmp_path, text, keys, points):
    (tmp_path / "p.csv").write_text(text)
    assert read_profile({"file": str(tmp_path / "p.csv"), **keys}, "altitude").points == points


@pytest.mark.parametrize(
    ("values", "ordered", "place"),
    [
        ([1.0, 2.0, -999.0], True, 2), ([1.0, 9.969e36], True, 1), ([1.0, 9999.0], True, 1),
        ([9000.0, 9999.0, 9999.0, 12000.0], True, None), ([9e3, 9999.0, 8e3], True, 1),
        ([9000.0, 9999.0, 12000.0], False, 1), ([9e3, 9999.0], None, None), ([np.nan], True, None),
        ([9999.0], True, 0), ([-1e30], None, 0),
    ],
)  # fmt: skip
def test_numbers_that_stand_for_no_reading(values, ordered, place):
    assert sentinel(np.array(values), ordered=ordered) == place
