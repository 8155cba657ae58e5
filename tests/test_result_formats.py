"""Results in other tools' formats: read back by their own readers, value by value."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from apu_casadi.core import cf, resultformats, results
from apu_casadi.core.errors import DataError, ParameterError
from apu_casadi.unit.runsignals import RUN
from estimators.apu.recordings.measured import read_recording
from scenarios import cli, registry

pd = pytest.importorskip("pandas")


@pytest.fixture(scope="module")
def ds():
    t, w = np.linspace(0, 1, 6), np.linspace(0, 1, 20001)
    rng = np.random.default_rng(1)
    return results.dataset(
        {"time": t, "time_w": w},
        {
            "time": {"T4": 1200 + rng.normal(size=6), "P_e": rng.normal(1e5, 1, (2, 6))},
            "time_w": {
                "i_a": 400 * np.cos(2500 * w),
                "v_a": np.outer([325, 326], np.sin(2500 * w)),
            },
        },
        signals=RUN,
        attrs={"title": "two generators", "seed": 3},
        generators=2,
    )


def test_tables_have_units_and_numbers_of_generators(ds, tmp_path):
    (time, waves) = resultformats.save_as(ds, tmp_path / "r", "csv")
    assert (time.name, waves.name) == ("r.csv", "r_time_w.csv")
    table = pd.read_csv(time)
    assert list(table) == ["time [s]", "T4 [K]", "P_e_1 [W]", "P_e_2 [W]"]
    assert table["P_e_2 [W]"].to_numpy() == pytest.approx(ds["P_e"].values[1], rel=1e-11)
    assert list(pd.read_csv(waves)) == ["time_w [s]", "i_a [A]", "v_a_1 [V]", "v_a_2 [V]"]


def test_parquet_is_exact(ds, tmp_path):
    pytest.importorskip("pyarrow")
    time, waves = resultformats.save_as(ds, tmp_path / "r", "parquet")
    assert_array_equal(pd.read_parquet(time)["T4 [K]"], ds["T4"])
    assert_array_equal(pd.read_parquet(waves)["v_a_2 [V]"], ds["v_a"][1])


def test_netcdf4_is_small_and_says_its_precision(ds, tmp_path):
    pytest.importorskip("h5netcdf")
    (path,) = resultformats.save_as(ds, tmp_path / "r", "nc4")
    back = results.load(path)
    assert back.attrs == {**cf.described(ds).attrs, "precision": resultformats.PRECISION}
    assert_array_equal(back["T4"], ds["T4"])
    assert_array_equal(back["time_w"], ds["time_w"])
    assert_array_equal(back["v_a"], ds["v_a"].values.astype(np.float32))
    assert back["v_a"].attrs["units"] == "V"
    assert path.stat().st_size < 0.75 * results.save(ds, tmp_path / "r.nc").stat().st_size


def test_mat_has_units_and_attributes(ds, tmp_path):
    from scipy.io import loadmat

    (path,) = resultformats.save_as(ds, tmp_path / "r", "mat")
    found = loadmat(path, squeeze_me=True, simplify_cells=True)
    assert_array_equal(found["v_a"], ds["v_a"])
    assert found["units"]["T4"] == "K" and found["about"]["seed"] == 3


@pytest.mark.parametrize("form", ["nc", "nc4", "csv", "parquet", "mat"])
def test_every_format_is_read_again(ds, tmp_path, form):
    """By ``results.load``, and as a recording, whose currents are the same numbers."""
    pytest.importorskip("pyarrow" if form == "parquet" else "h5netcdf")
    path, *_ = resultformats.save_as(ds, tmp_path / "r", form)
    back = results.load(path)
    digits = {"csv": 1e-11, "nc4": 6e-8}.get(form, 0)
    for n in ("T4", "i_a", "time_w"):
        np.testing.assert_allclose(back[n], ds[n], rtol=digits, atol=0 if digits < 1e-9 else 1e-4)
        assert back[n].attrs["units"] == ds[n].attrs["units"]
    two = back["v_a_2"] if "v_a_2" in back else back["v_a"][1]
    np.testing.assert_allclose(two, ds["v_a"][1], rtol=digits, atol=1e-4 if digits else 0)
    data = read_recording(path)
    np.testing.assert_array_equal(data["T4"].values, back["T4"])


def test_other_files_are_told(tmp_path):
    for name, text, words in (
        ("a.csv", "x;y\n1;2\n", "a column 'time \\[s\\]' is expected; recordings of other"),
        ("b.csv", "time,T4\n0,hot\n", "column T4: no numbers"),
        ("c.csv", "", "damaged"),
        ("d.mat", "none", "damaged MAT file"),
        ("e.parquet", "none", "damaged"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(DataError, match=words):
            results.load(tmp_path / name)


def test_refusals(ds, tmp_path, monkeypatch, capsys):
    with pytest.raises(ParameterError, match=r"unknown format 'cvs' \(did you mean 'csv'"):
        resultformats.save_as(ds, tmp_path / "r", "cvs")
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file"):
        resultformats.save_as(ds, tmp_path / "file" / "r", "csv")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "joint", "--format", "nc,cvs"]) == 2  # before anything is run
    assert "unknown format 'cvs'" in capsys.readouterr().err


def test_a_run_is_written_as_asked(ds, tmp_path, monkeypatch):
    """A user's reader of the package opens each."""
    from estimators.apu.recordings.measured import read_recording

    monkeypatch.setattr(registry, "summary", lambda ds: {})
    made = registry.write(ds, tmp_path, figures=False, name="two", formats=("nc", "csv"))
    assert [p.name for p in made] == ["two.nc", "two.csv", "two_time_w.csv", "summary.json"]
    m = read_recording(tmp_path / "two.csv")
    assert m["T4"].values == pytest.approx(ds["T4"].values, rel=1e-11)
