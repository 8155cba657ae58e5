"""What files say of themselves: the attributes of CF and ACDD, whoever writes them."""

import re
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import xarray as xr
from synthetic_joint import synthetic_joint

import apu_casadi
from apu_casadi import Apu, SeriesLoad
from apu_casadi.core import cf, resultformats, results
from apu_casadi.gaspath.steady.trimbatch import performance_deck
from apu_casadi.unit.linearisation import linearise_generator
from estimators.apu.measuring import measure_run, write_recording
from scenarios.export import linear

TOLD = {"title", "summary", "keywords", "project", "processing_level", "date_created"}
ASKED = TOLD | set(cf.origin("made"))
DATE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")


def complete(ds):
    assert set(ds.attrs) >= ASKED
    assert not {"institution", "geospatial_lat_min"} & set(ds.attrs)
    assert ds.attrs["Conventions"] == "CF-1.11, ACDD-1.3" and DATE.fullmatch(
        ds.attrs["date_created"]
    )
    for name, v in ds.variables.items():
        assert v.attrs["long_name"], name
        kind = "coordinate" if name in ds.coords else "modelResult"
        assert v.attrs["coverage_content_type"] == kind, name
        assert v.attrs.get("standard_name") == cf.STANDARD_NAMES.get(name), name
        assert name not in ds.coords or "_FillValue" not in v.attrs | v.encoding, name
        assert np.asarray(v.attrs.get("flag_values", np.array(0, v.dtype))).dtype == v.dtype, name
    return ds


@pytest.fixture(scope="module")
def run():
    return synthetic_joint(end=0.5)


@pytest.mark.parametrize("form", ["nc", "nc4"])
def test_results(run, tmp_path, form):
    pytest.importorskip("h5netcdf")
    (path,) = resultformats.save_as(run, tmp_path / "r", form)
    ds = complete(results.load(path))
    assert {n: ds.attrs[n] for n in run.attrs} == run.attrs
    assert ds.attrs["time_coverage_duration"] == "PT0.5S"
    assert ds.attrs["time_coverage_resolution"] == "PT0.02S"
    assert "time_coverage_start" not in ds.attrs  # no date is made up


def test_mat(run, tmp_path):
    (path,) = resultformats.save_as(run, tmp_path / "r", "mat")
    assert set(scipy.io.loadmat(path, simplify_cells=True)["about"]) >= ASKED


def test_recordings(run, tmp_path):
    for path in write_recording(measure_run(run, Apu(), seed=1), tmp_path / "m.nc"):
        assert complete(results.load(path)).attrs["title"] == "readings of sensors"


def test_decks_have_standard_names(tmp_path):
    deck = performance_deck(
        Apu().gas_generator, altitude=[0.0, 4000.0], Mach=0.0, dT_isa=0.0, PW=1e5
    )
    ds = complete(results.load(results.save(deck, tmp_path / "d.nc")))
    told = ds["altitude"].attrs
    assert (told["standard_name"], told["positive"]) == ("altitude", "up")
    assert ds.attrs["standard_name_vocabulary"].startswith("CF Standard Name Table")


def test_linear_models(tmp_path):
    g = Apu().generator
    model = linearise_generator(g, g.steady_state(SeriesLoad.from_power(1e5, 0.85)))
    ds = complete(results.load(linear.save(model, tmp_path / "m.nc", {"load": "100 kW"})))
    assert ds.attrs["title"] == f"linear model {model.name}"
    mat = scipy.io.loadmat(linear.save(model, tmp_path / "m.mat", {}), simplify_cells=True)
    assert set(mat["about"]) >= ASKED


def test_what_was_given_stays_and_the_input_is_untouched(monkeypatch):
    ds = xr.Dataset({"x": ("n", [1.0], {"long_name": "mine"})}, attrs={"title": "own"})
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    made = cf.described(ds, "other")
    assert made.attrs["title"] == "own" and made["x"].attrs["long_name"] == "mine"
    assert made.attrs["date_created"] == "1970-01-01T00:00:00Z"
    assert ds.attrs == {"title": "own"}
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    assert cf.described(ds).attrs["date_created"] > "2025"


def test_nothing_writes_netcdf_or_mat_past_them():
    """Each file that calls a writer of xarray or SciPy is one of these, which describe."""
    root = Path(apu_casadi.__file__).parents[1]
    wanted = re.compile(r"\.to_netcdf\(|\bsavemat\(|netcdf3\.write\(")
    callers = {
        p.name
        for part in ("apu_casadi", "estimators", "scenarios")
        for p in (root / part).rglob("*.py")
        if wanted.search(p.read_text(encoding="utf-8"))
    }
    assert callers == {"results.py", "resultformats.py", "linear.py", "netcdf3.py"}
