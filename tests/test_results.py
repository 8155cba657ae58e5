"""Labelled datasets: building, keeping, summarising."""

import numpy as np
import pytest
from synthetic_joint import synthetic_joint

from apu_casadi.core import cf, results
from apu_casadi.core.errors import DataError, SignalError
from apu_casadi.core.signals import Signal
from apu_casadi.unit import runsummary
from apu_casadi.unit.runsignals import RUN


@pytest.fixture(scope="module")
def ds():
    return synthetic_joint(waveforms=False)


def test_every_variable_has_unit_and_meaning(ds):
    for name in [*ds.data_vars, *ds.coords]:
        assert ds[name].attrs["units"] and ds[name].attrs["long_name"], name


def test_dataset_refuses_what_it_cannot_label():
    time = {"time": [0.0, 0.02]}
    with pytest.raises(SignalError, match=r"unit of 'WF' unknown \(did you mean 'Wf'\?\)"):
        results.dataset(time, {"time": {"WF": 1.0}}, signals=RUN)
    with pytest.raises(SignalError, match=r"T4: shape \(2,\) as time expected, got \(3,\)"):
        results.dataset(time, {"time": {"T4": np.zeros(3)}}, signals=RUN)
    with pytest.raises(SignalError, match="strictly increasing"):
        results.dataset({"time": [0.0, 0.0]}, {}, signals=RUN)
    with pytest.raises(SignalError, match=r"unknown coordinate 'tme' \(did you mean 'time'"):
        results.dataset(time, {"tme": {}}, signals=RUN)
    mine = results.dataset(time, {"time": {"beta": 0.5}}, signals=[Signal("beta", "1", "map line")])
    assert mine["beta"].attrs == {"units": "1", "long_name": "map line"}
    assert mine["beta"].values.tolist() == [0.5, 0.5]


def test_netcdf_round_trip_keeps_values_and_attributes(tmp_path):
    ds = synthetic_joint(end=0.5)
    ds.attrs["solver"] = "κ = µ, two\nlines"
    back = results.load(results.save(ds, tmp_path / "new folder" / "joint.nc"))
    assert back.identical(cf.described(ds)) and set(ds.attrs.items()) <= set(back.attrs.items())
    assert [p.name for p in (tmp_path / "new folder").iterdir()] == ["joint.nc"]


def test_an_interrupted_write_leaves_the_old_file(tmp_path, ds, monkeypatch):
    path = results.save(ds, tmp_path / "joint.nc")
    before = path.read_bytes()

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(results.os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        results.save(ds * 2.0, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["joint.nc"]


@pytest.mark.long
def test_missing_and_damaged_files_are_data_errors(tmp_path):
    with pytest.raises(DataError, match=r"none\.nc: cannot be read: No such file"):
        results.load(tmp_path / "none.nc")
    path = tmp_path / "x.nc"
    path.write_text("time,T4\n")
    with pytest.raises(DataError, match="not a netCDF 3 file"):
        results.load(path)
    small = results.dataset(
        {"time": [0.0, 0.02]},
        {"time": {"T4": [1.0, 2.0], "P3": [1.0, 2.0]}},
        signals=RUN,
        attrs={"a": "b"},
    )
    whole = results.save(small, path).read_bytes()
    for size in range(4, len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(DataError, match="damaged netCDF file"):
            results.load(path)
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        results.save(small, tmp_path / "file" / "x.nc")


def test_summary_averages_the_end_of_each_phase(ds):
    rows = runsummary.phase_summary(ds)
    assert [r["name"] for r in rows] == [
        "design point",
        "load drop",
        "gas-path fault",
        "TTSC fault",
    ]
    first, drop, gas, ttsc = rows
    assert first["N_rpm"] == pytest.approx(36049.6, abs=0.1)
    assert first["PW_kW"] == pytest.approx(500.0)
    assert first["SFC"] == pytest.approx(0.0483 / 530e3)
    assert drop["N_rpm_max"] > 36300 > drop["N_rpm"]
    assert drop["T4_max"] == ds["T4"].sel(time=slice(2.01, 6.01)).max()
    assert first["N_rpm_max"] == pytest.approx(36049.6, abs=0.1)  # 2 s is the first phase's
    assert gas["f_W_t"] == 1.04 and first["f_W_t"] == 1.0
    inside = ds["I_a_rms"].sel(time=slice(13.51, 14.001)).mean().item()
    assert ttsc["I_a_rms"] == pytest.approx(inside)
    assert ttsc["window"] == 0.5


def test_summary_gives_the_severity_whole(ds):
    rows = runsummary.phase_summary(ds)
    assert [rows[2][k] for k in ("mu", "k_rf", "kappa", "h")] == [0.0, None, None, 0.0]
    assert [rows[3][k] for k in ("mu", "k_rf", "kappa")] == [0.05, 20.0, 0.05]
    assert rows[3]["h"] == pytest.approx(0.05 / 20.95)


def test_summary_of_a_short_run_and_of_a_wrong_dataset(ds):
    short = synthetic_joint(waveforms=False, end=0.1)
    assert runsummary.phase_summary(short)[0]["window"] == pytest.approx(0.1)
    del short.attrs["phases"]
    assert runsummary.phase_summary(short)[0]["name"] == "run"
    with pytest.raises(DataError, match="the dataset lacks T4, mu"):
        runsummary.phase_summary(ds.drop_vars(["T4", "mu"]))
    with pytest.raises(DataError, match="attribute 'phases' is not a list"):
        runsummary.phase_summary(ds.assign_attrs(phases="[1]"))
    with pytest.raises(DataError, match="holds no sample"):
        runsummary.phase_summary(ds.assign_attrs(phases='[{"name": "x", "start": 20, "end": 21}]'))
