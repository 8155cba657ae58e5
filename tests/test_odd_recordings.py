"""Recordings that something is wrong with: what is said of them, and what is still estimated."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError
from apu_casadi.machine.machinedata import MachineParameters
from estimators.apu.believable import channels_still
from estimators.apu.declared import as_declared
from estimators.apu.electrical.gaps import filled
from estimators.apu.electrical.sequences import sequences
from estimators.apu.electrical.wiring import miswired
from estimators.apu.recorded_estimate import estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.recordings.plausible import clipped
from estimators.apu.sensorchain import onto
from estimators.apu.sensors import ELECTRICAL, gas_path_table
from scenarios import cli

TURN = np.exp(-2j * np.pi / 3 * np.arange(3))[:, None]
PHASES = [f"{q}_{p}" for q in "vi" for p in "abc"]


def balanced(t, f=400.0, lag=0.3):
    """Voltages and currents of the rated size, currents behind by ``lag``, rad, (6, K)."""
    turning = np.exp(2j * np.pi * f * t) * TURN
    return np.concatenate([325.3 * turning, 300 * np.exp(-1j * lag) * turning]).real


# ------------------------------------------------------------------------------ phases


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: x, None),
        (lambda x: x[[0, 1, 2, 3, 5, 4]], "the currents alone follow one another as a, c, b"),
        (lambda x: x[[0, 2, 1, 3, 4, 5]], "the voltages alone"),
        (lambda x: x[[0, 2, 1, 3, 5, 4]], "exchange those of b and c in both"),
        (lambda x: x * np.array([1, 1, 1, 1, -1, 1])[:, None], r"^i_b: power flows into"),
        (lambda x: x * np.array([1, 1, 1, -1, -1, -1])[:, None], r"^all currents: power flows"),
        (lambda x: x * np.array([3**0.5] * 3 + [1] * 3)[:, None], "between lines"),
    ],
    ids=["right", "currents", "voltages", "both", "one sign", "all signs", "lines"],
)
@pytest.mark.parametrize("lag", [-1.2, 0.0, 1.2])
def test_phases_that_stand_wrong(change, words, lag):
    """The order and the signs are told at any power factor of a passive load, and their remedy."""
    t = np.arange(1000) * 1e-4
    a = {
        "t": t,
        "w_r": np.full(t.size, 2 * np.pi * 400),
        **dict(zip(PHASES, change(balanced(t, lag=lag)), strict=True)),
    }
    found = miswired(a, MachineParameters())
    if words is None:
        assert found is None
    else:
        assert found is not None
        with pytest.raises(DataError, match=words):
            raise DataError(found)


def test_samples_at_other_instants():
    """A voltage at the instants of the currents: to 1e-4 of 12 samples a period; gaps stay."""
    t = np.arange(400) / 4800.0
    at = t + 0.4 / 4800
    v = np.cos(2 * np.pi * 400 * t)
    found = onto(at, t, v, 2 * np.pi * 400)
    assert_allclose(found[3:-3], np.cos(2 * np.pi * 400 * at)[3:-3], atol=2e-4)
    assert np.isnan(found[-1])  # after the last sample
    kept = np.delete(np.arange(400), np.arange(100, 140))
    holed = onto(at, t[kept], v[kept], 2 * np.pi * 400)
    assert np.isnan(holed[103:136]).all() and np.isfinite(holed[150:-3]).all()


def test_many_gaps_are_filled_each_from_its_own_period():
    """Every second sample is missing; what is filled is the wave around it."""
    t = np.arange(4000) / 20e3
    w = np.full(t.size, 2 * np.pi * 400)
    x = np.where(t < 0.1, 1.0, 2.0) * np.cos(2 * np.pi * 400 * t)
    holed = np.where(np.arange(t.size) % 2, x, np.nan)
    found, off = filled(t, holed, w, (1, 3), "v_a")
    away = np.abs(t - 0.1) > 0.005
    assert_allclose(found[away], x[away], atol=1e-9)
    assert off[away].max() < 1e-9 and off[~away].max() > 0.05


def test_clipped_currents_of_few_samples_a_period():
    """400 Hz at 1 kHz shows five angles: without those that are clipped the rest tells nothing."""
    rng = np.random.default_rng(1)
    t = np.arange(3000) / 1000
    i = 12 * (np.exp(2j * np.pi * 399.2 * t) * TURN).real + rng.normal(0, 0.05, (3, t.size))
    cut = np.clip(i, -9.6, 9.6)
    assert all(clipped(v) for v in cut) and not any(clipped(v) for v in i)
    left = np.where(np.abs(cut) < 9.6, cut, np.nan)
    with pytest.raises(DataError, match="the rest tells no sinusoid"):
        sequences(t, left)
    scattered = np.where(rng.random(i.shape) < 0.3, np.nan, i)
    assert np.abs(sequences(t, scattered).unbalance).max() < 0.005  # missing at any angle
    slow = 12 * (np.exp(2j * np.pi * 49.7 * t) * TURN).real + rng.normal(0, 0.05, (3, t.size))
    found = sequences(t, np.where(np.abs(slow) < 9.6, slow, np.nan))
    assert np.abs(found.unbalance).max() < 5 * found.sigma.max()
    digits = np.round(np.sin(2 * np.pi * 399.2 * t) * 300)  # no clipping: the top digit of a wave
    fast = np.sin(2 * np.pi * 399.2 * np.arange(5000) / 1e4) * 200
    assert not clipped(digits) and not clipped(np.round(fast / 5) * 5)  # in runs, for all that
    assert clipped(np.clip(np.round(fast / 5) * 5, -180, 180))


# ------------------------------------------------------------------------------ channels


def test_a_current_that_shows_nothing_is_not_used():
    t = np.arange(4000) / 5000
    x = dict(zip(PHASES, balanced(t), strict=True)) | {"i_c": np.zeros(t.size)}
    found = estimate(read_recording({"t": t, **x}))
    assert set(found.sequences) == {"v of machine 1"}
    assert "i_c was not measured" in found.lacking["symmetrical components, i of machine 1"]
    assert any("i_c shows 0 A all the time" in d for d in found.doubts) and not found.believable


def test_a_sensor_that_never_moves():
    rng = np.random.default_rng(2)
    gas = {n: v * (1 + 1e-3 * rng.standard_normal(60)) for n, v in
           {"N": 3775.0, "P3": 8e5, "T3": 568.0, "Wf": 0.048}.items()}  # fmt: skip
    m = read_recording({"t": 0.02 * np.arange(60), **gas, "T5": np.full(60, 740.0)})
    ready = as_declared(m, gas_path_table(), ELECTRICAL)
    (still,) = channels_still(ready.m, ready.gas_path, ready.coarse)
    assert (still.name, still.t) == ("T5", 0.0) and still.end == pytest.approx(1.18)


# ------------------------------------------------------------------------------ times, files


def test_seconds_since_1970_count_from_the_first():
    t = 1714867193.25 + 0.02 * np.arange(20)
    late = {"t [s]": t + 1, "T3": np.full(20, 560.0)}
    m = read_recording({"t [s]": t, "N": np.full(20, 3775.0)}, late)
    assert_allclose(m["N"].t, 0.02 * np.arange(20), atol=1e-6)
    assert_allclose(m["T3"].t - m["N"].t, 1.0, atol=1e-6)
    assert str(m.start).startswith("2024-05-04T23:59:53.2")
    assert any("seconds since 1970" in n for n in m.notes)


def test_files_that_are_something_else(tmp_path, capsys):
    """A Parquet file by another name, a unit at --time, an infinite reading, columns of no use."""
    path = tmp_path / "a.csv"
    path.write_bytes(b"PAR1\x15\x04")
    assert cli.main(["estimate", "data", str(path)]) == 2
    assert "let its name end in .parquet" in capsys.readouterr().err
    rows = "\n".join(
        f"{20 * k},{3775 + k % 3},{'inf' if k == 5 else 568 + k % 2},7" for k in range(40)
    )
    path.write_text(f"time,N [rad/s],T3 [K],torque\n{rows}\n")
    with pytest.raises(DataError, match=r"'inf' is no number .* give --missing='inf'"):
        read_recording(path)
    m = read_recording(path, time="time:ms", missing=["inf"])
    assert_allclose(m["N"].t[-1], 0.78)
    assert np.isnan(m["T3"].values[5]) and m.unused == ("torque",)
