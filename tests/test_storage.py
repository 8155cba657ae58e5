"""Results in files: written in pieces, read on demand, the same bits as in memory."""

import contextlib
import copy
import io
import os
import pickle
import tracemalloc
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import xarray as xr

from apu_casadi import Apu, FaultChange, HealthChange, SeriesLoad, Ttsc, simulate_joint
from apu_casadi.core import cf, netcdf3, results, runstorage
from apu_casadi.core.errors import DataError
from apu_casadi.core.filearrays import File, RowFile, lazy
from apu_casadi.machine.measurement import MeasurementNoise
from apu_casadi.unit import recorder, runsummary
from apu_casadi.unit.machines import Of
from apu_casadi.unit.noise import Noise
from apu_casadi.unit.stepmeans import StepMeans

LONG = 200_000


@pytest.fixture
def ds():
    """Every kind of variable that is stored, two long dimensions among them."""
    rng = np.random.default_rng(1)
    holes = np.where(rng.random(LONG) < 0.1, np.nan, 1.0)
    return xr.Dataset(
        {
            "a": ("time_w", rng.standard_normal(LONG), {"units": "V", "long_name": "längs"}),
            "holes": ("time_w", holes),
            "single": ("time_w", rng.standard_normal(LONG).astype("f4")),
            "table": (("time", "bin"), rng.standard_normal((5, 40_000))),
            "slow": ("time", rng.standard_normal(5)),
            "count": ("time", np.arange(5, dtype="i4")),
            "text": ("time", np.array(["a", "bc", "ü", "", "e"])),
            "one": ((), 3.0),
        },
        coords={"time": np.arange(5.0), "time_w": np.arange(LONG) * 5e-5},
        attrs={"text": "ü", "n": 3, "x": 2.5, "list": [1.0, 2.0]},
    )


def test_a_file_written_in_pieces_is_what_xarray_writes(ds, tmp_path):
    """xarray's own writer, which builds the whole file in memory, is the reference."""
    path = results.save(ds, tmp_path / "ours.nc")
    with xr.open_dataset(
        io.BytesIO(bytes(cf.described(ds).to_netcdf(engine="scipy"))),
        engine="scipy",
        decode_times=False,
    ) as f:
        reference = f.load()
    with xr.open_dataset(path, engine="scipy", decode_times=False) as f:
        xr.testing.assert_identical(f.load(), reference)
    xr.testing.assert_identical(results.load(path), reference)
    xr.testing.assert_identical(results.load(path, lazy=True), reference)
    assert list(results.load(path).variables) == list(ds.variables)


def test_saving_again_what_was_loaded_gives_the_same_file(ds, tmp_path):
    path = results.save(ds, tmp_path / "a.nc")
    for how in (False, True):
        again = results.save(results.load(path, lazy=how), tmp_path / "b.nc")
        assert again.read_bytes() == path.read_bytes()


def test_lazy_values_are_those_asked_for(ds, tmp_path):
    found = results.load(results.save(ds, tmp_path / "a.nc"), lazy=True)
    for part in (3, -1, slice(5, 9), slice(None, None, -70_001), [5, 1, 9], slice(7, 7)):
        assert found["a"][part].values.tobytes() == ds["a"][part].values.tobytes()
    at = ([4, 0], slice(10, 3, -2))
    assert found["table"][at].values.tobytes() == ds["table"][at].values.tobytes()
    with pytest.raises(IndexError):
        found["a"][LONG]
    for other in (copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        xr.testing.assert_identical(other, found.load())


def test_threads_and_forked_processes_read_the_same_file(ds, tmp_path):
    """They share the place at which a file is read; each reads its own all the same."""
    found = results.load(results.save(ds, tmp_path / "a.nc"), lazy=True)
    right = {n: ds[n].values.tobytes() for n in ("a", "holes", "single", "table")}

    def wrong():
        return [n for _ in range(20) for n, v in right.items() if found[n].values.tobytes() != v]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12: "... is multi-threaded"
        pid = os.fork() if hasattr(os, "fork") else None
    if pid == 0:
        status = 1
        with contextlib.suppress(BaseException):
            status = len(wrong())
        os._exit(status)
    with ThreadPoolExecutor(4) as pool:
        assert [f.result() for f in [pool.submit(wrong) for _ in range(4)]] == [[]] * 4
    if pid is not None:
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def test_writing_and_reading_need_little_more_than_the_data(tmp_path):
    n = 1 << 21
    ds = xr.Dataset({k: ("t", np.full(n, 1.5)) for k in "abc"}, coords={"t": np.arange(n) * 1.0})
    tracemalloc.start()
    try:
        path = results.save(ds, tmp_path / "a.nc")
        assert tracemalloc.get_traced_memory()[1] < 16 * 2**20  # of 64 MiB of data
        tracemalloc.reset_peak()
        results.load(path)
        # the data, one variable twice while it is made, and the index of t
        assert tracemalloc.get_traced_memory()[1] < 1.8 * ds.nbytes
    finally:
        tracemalloc.stop()


def test_damaged_files_are_refused(ds, tmp_path):
    path = results.save(ds, tmp_path / "a.nc")
    raw = path.read_bytes()
    for n in (4, 7, 50, 400, len(raw) // 2, len(raw) - 100_000):
        path.write_bytes(raw[:n])
        for how in (False, True):
            with pytest.raises(DataError, match=r"damaged netCDF file of \d+ bytes"):
                results.load(path, lazy=how)
    for other, message in (
        (b"CDF\x05" + raw[4:], "not known"),
        (raw[:4] + b"\x7f\xff\xff\xff" + raw[8:], "records without a dimension"),
    ):
        path.write_bytes(other)
        with pytest.raises(DataError, match=message):
            results.load(path)


def test_a_summary_of_what_is_no_run_is_refused(in_memory):
    """Wrong kinds of variables, which a damaged or edited file may hold."""
    n = in_memory.sizes["time"]
    for T4, message in (
        (("time", np.full(n, np.nan)), "T4 = nan at t = 0 s"),
        (("time", np.array(["ab"] * n)), "numbers on time are expected, <U2 on time found"),
        ((("time", "k"), np.ones((n, 2))), "float64 on time, k found"),
        ((), "T4"),
    ):
        ds = in_memory.assign(T4=T4) if T4 else in_memory.drop_vars("T4")
        with pytest.raises(DataError, match=message):
            runsummary.phase_summary(ds)


def test_a_file_with_a_growing_dimension_is_read(tmp_path):
    """Other programs write them; the values of their variables are scattered."""
    ds = xr.Dataset({"a": ("t", [1.0, 2.0]), "b": ("t", [3.0, 4.0])})
    ds.to_netcdf(tmp_path / "a.nc", engine="scipy", unlimited_dims=["t"])
    found = results.load(tmp_path / "a.nc", lazy=True)
    assert found["a"].values.tolist() == [1.0, 2.0] and found["b"].values.tolist() == [3.0, 4.0]


def test_a_write_that_fails_leaves_nothing(ds, tmp_path, monkeypatch):
    """A full disk in the middle of the data; the file of before stays."""
    results.save(ds.isel(time_w=slice(0, 9)), tmp_path / "a.nc")
    before = (tmp_path / "a.nc").read_bytes()
    whole = netcdf3.write

    def full(ds, f):
        whole(ds, f)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(netcdf3, "write", full)
    with pytest.raises(DataError, match="No space left"):
        results.save(ds, tmp_path / "a.nc")
    assert [p.name for p in tmp_path.iterdir()] == ["a.nc"]
    assert (tmp_path / "a.nc").read_bytes() == before


def sparse(path, n):
    """A dataset of n zeros that take no room."""
    with path.open("wb") as f:
        f.truncate(8 * n)
    array = lazy(File(path.open("rb", buffering=0), str(path)), 0, (n,), "f8")
    return xr.Dataset({"a": ("t", array), "b": ("t", array)})


class Counted(io.RawIOBase):
    """A file of which only the beginning is kept."""

    def __init__(self):
        self.size, self.start = 0, b""

    def write(self, data):
        self.start = (self.start + bytes(data))[:1024] if len(self.start) < 1024 else self.start
        self.size += len(data)
        return len(data)


@pytest.mark.skipif(os.name == "nt", reason="NTFS needs a flag for sparse files")
def test_variables_that_the_format_cannot_hold_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"a: 4.00 GiB; a variable of a netCDF 3 file"):
        netcdf3.write(sparse(tmp_path / "zeros", 2**29), Counted())


@pytest.mark.slow  # converts 5 GB
def test_files_beyond_2_and_4_gib(tmp_path):
    """Sizes and places of the header; netCDF-3 offsets have 64 bits, sizes 32."""
    n = 300_000_000  # 2.2 GiB a variable
    f = Counted()
    netcdf3.write(sparse(tmp_path / "zeros", n), f)
    header = netcdf3._parsed(f.start)
    a, b = header.variables
    assert header.dims == {"t": n} and b.begin == a.begin + 8 * n > 2**31
    assert f.size == b.begin + 8 * n > 2**32


KW = dict(
    duration=1.3,
    load=SeriesLoad.from_power(1e5),
    solver="propagator",
    phasors=True,
    events=[
        HealthChange(t=0.41, factors={"f_eta_c": 0.99}),
        FaultChange(t=0.9, fault=Ttsc(mu=0.05, k_rf=20.0)),
    ],
    seed=3,
    noise=Noise(gas={"T3": 1.0, "P3": 100.0}, terminal=MeasurementNoise(1.0, 2.0, 3.0)),
)


@pytest.fixture(scope="module")
def in_memory():
    return simulate_joint(Apu(), storage="memory", **KW)


@pytest.mark.parametrize("piece", [11, 1 << 15])
def test_a_run_kept_in_a_file_has_the_same_bits(in_memory, piece, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "PIECE", piece)
    ds = simulate_joint(Apu(), storage=tmp_path, **KW)
    assert list(ds.variables) == list(in_memory.variables) and ds.attrs == in_memory.attrs
    for name, v in in_memory.variables.items():
        assert ds[name].values.tobytes() == v.values.tobytes(), name
        assert ds[name].attrs == v.attrs
    assert runsummary.phase_summary(ds) == runsummary.phase_summary(in_memory)
    a = results.save(ds, tmp_path / "a.nc").read_bytes()
    assert a == results.save(in_memory, tmp_path / "b.nc").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.nc", "b.nc"]


@pytest.mark.parametrize("storage", ["memory", "file"])
def test_the_last_instant_is_at_hand_wherever_results_are(storage, tmp_path, monkeypatch):
    """An error in the middle of a long run tells of the instant before."""
    monkeypatch.setattr(recorder, "PIECE", 11)
    gg, K = Apu().gas_generator, 25
    n = len(gg.Y)
    where = "memory" if storage == "memory" else tmp_path
    means = {(1, 2): StepMeans(Apu().generator, False)}
    book = recorder.Recorder(gg, np.arange(K) * 0.02, 0, means, where)
    for k in range(K):
        y, factors = np.arange(n) + 100.0 * k, dict.fromkeys("abcd", 1.0)
        of = Of((1, 2), np.full(len(means[1, 2].kept), 4.0 * k), None, np.zeros((11, 1)))
        book.put(k, 1, recorder.Row(y, [of], factors, np.zeros(1)))
        assert book.last().tolist() == (np.arange(n) + 100.0 * k).tolist()
    rows = book.instants()
    assert np.asarray(rows[gg.Y.names[2]]).tolist() == [2 + 100.0 * k for k in range(K)]
    assert np.asarray(rows["P_e"]).tolist() == [4.0 * k for k in range(K)]
    assert np.asarray(rows["mu"]).tolist() == [0.0] * K


def test_large_results_go_to_a_file_by_themselves(monkeypatch, tmp_path, caplog):
    kw = dict(duration=0.2, load=SeriesLoad.from_power(1e5), solver="propagator", waveform_dt=None)
    small = simulate_joint(Apu(), **kw)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(runstorage.tempfile, "tempdir", None)
    monkeypatch.setattr(runstorage, "IN_MEMORY", 1000)
    made = []

    class Watched(RowFile):
        def __init__(self, lengths, folder):
            super().__init__(lengths, folder)
            made.append(folder)

    monkeypatch.setattr(runstorage, "RowFile", Watched)
    assert simulate_joint(Apu(), **kw).identical(small)
    assert made == [tmp_path]
    # no room: memory, and it is told; where a folder was asked for, refused
    monkeypatch.setattr(runstorage.shutil, "disk_usage", lambda p: type("Usage", (), {"free": 100}))
    assert simulate_joint(Apu(), **kw).identical(small)
    assert "the results are kept in memory" in caplog.text
    with pytest.raises(DataError, match="cannot be kept"):
        simulate_joint(Apu(), storage=tmp_path, **kw)
    with pytest.raises(DataError, match="'auto', 'memory' or a folder"):
        simulate_joint(Apu(), storage="disk", **kw)
