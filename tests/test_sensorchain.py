"""What a sensor makes of the truth, and how its declaration takes that out again."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError
from estimators.apu.declared import as_declared
from estimators.apu.electrical.sequences import sequences
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensorchain import (
    Draws,
    disturbed,
    interpolated,
    sampled,
    sampled_wave,
    slopes,
    spread,
)
from estimators.apu.sensors import ELECTRICAL, GAS_PATH, Sensor, SensorSet

t = np.arange(1000) * 1e-4
W = 2 * np.pi * 400.0
WAVE = 325.0 * np.cos(W * t + 0.3)
V_A = Sensor("v_a", 0.5, False, 0.0, "V", "")
inner = slice(30, -10)


def changed(sensors, name, **how):
    return SensorSet(
        tuple(dataclasses.replace(s, **how) if s.name == name else s for s in sensors.sensors)
    )


def test_a_wave_lags_as_the_complex_gain_says():
    """1/(1 + i w tau), for a lag of a fifth of the step and of ten."""
    for tau in (2e-5, 1e-3):
        got = sampled_wave(dataclasses.replace(V_A, tau=tau), t, WAVE, Draws(None))
        true = 325.0 * (np.exp(1j * (W * t + 0.3)) / (1 + 1j * W * tau)).real
        assert_allclose(got[-500:-10], true[-500:-10], atol=0.01)


def test_a_delay_shows_what_was_and_nothing_before_the_start():
    late = sampled_wave(dataclasses.replace(V_A, delay=2.5e-4), t, WAVE, Draws(None))
    assert np.isnan(late[:2]).all()
    assert_allclose(late[inner], 325.0 * np.cos(W * (t - 2.5e-4) + 0.3)[inner], atol=2e-3)
    T5 = dataclasses.replace(GAS_PATH["T5"], delay=0.03)
    slow = np.arange(0, 1, 0.02)
    assert_allclose(sampled(T5, slow, 700 + slow, slow, Draws(None))[2:], 700 + slow[2:] - 0.03)


def test_jitter_is_noise_by_the_slope():
    """Its rms is that of the slope; a filter is told so, for each sample."""
    s = dataclasses.replace(V_A, jitter=5e-6)
    rest = sampled_wave(s, t, WAVE, Draws(4)) - WAVE
    rms = 5e-6 * 325.0 * W / np.sqrt(2)
    assert np.std(rest[inner]) == pytest.approx(rms, rel=0.05)
    assert_allclose(spread(s, t, WAVE, wave=True), np.hypot(0.5, rms), rtol=0.15)
    slow = np.arange(0, 4, 0.02)
    assert_allclose(slopes(slow, 3.0 * slow, wave=False), 3.0)
    assert np.array_equal(spread(V_A, t, WAVE), np.full(t.size, 0.5))


def test_offsets_drift_digits_and_range():
    s = Sensor("P3", 0.0, False, 0.0, "Pa", "", bias=50.0, bias_mean=10.0, drift=3.0)
    time, zero = np.arange(0, 100, 0.02), np.zeros(5000)
    both = [
        disturbed(SensorSet((s,)), time, {"P3": zero}, Draws(k), errors=True)["P3"]
        for k in range(100)
    ]
    offset = np.array([v[0] for v in both])
    assert np.mean(offset) == pytest.approx(10.0, abs=15) and 40 < np.std(offset) < 62
    assert np.std([v[-1] - v[0] for v in both]) == pytest.approx(30.0, rel=0.2)
    (exact,) = disturbed(SensorSet((s,)), time, {"P3": zero}, Draws(None), errors=False).values()
    assert np.array_equal(exact, np.full(5000, 10.0))
    s = Sensor("P3", 0.0, False, 0.0, "Pa", "", quantum=4.0, limits=(-6.0, 9.0))
    seen = disturbed(
        SensorSet((s,)), t, {"P3": np.linspace(-20, 20, t.size)}, Draws(1), errors=True
    )["P3"]
    assert set(seen) == {-6.0, -4.0, 0.0, 4.0, 8.0, 9.0}


def test_the_draws_of_one_sensor_hang_on_no_other():
    a, b = Draws(1), Draws(1, machine=2)
    assert np.array_equal(a.normal("T5", "bias", 3), Draws(1).normal("T5", "bias", 3))
    assert not np.array_equal(a.normal("T5", "bias", 3), a.normal("T3", "bias", 3))
    assert not np.array_equal(a.normal("v_a", "jitter", 3), b.normal("v_a", "jitter", 3))
    assert not Draws(None).normal("T5", "drift", 4).any()


def test_local_polynomials_are_exact_for_the_fifth_degree():
    """Value and derivative between uneven instants, and how white noise grows."""
    x = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 40))
    at = np.linspace(x[3], x[-4], 57)
    poly = np.polynomial.Polynomial([1.0, -2.0, 0.3, 0.05, -0.002, 1e-5])
    got, _ = interpolated(x, poly(x), at, more=0.7)
    assert_allclose(got, poly(at) + 0.7 * poly.deriv()(at), rtol=1e-10)
    same, grown = interpolated(x, poly(x), x)
    assert np.array_equal(same, poly(x)) and np.array_equal(grown, np.ones(40))


def test_lag_and_delay_of_a_current_are_undone():
    """To 1e-4 of its amplitude; the noise is said to grow by what the polynomials make of it."""
    own = changed(ELECTRICAL, "i_a", tau=2e-5, delay=5e-5)
    read = sampled_wave(dataclasses.replace(V_A, tau=2e-5, delay=5e-5), t, WAVE, Draws(None))
    m = read_recording({"t": t, "i_a": read, "i_b": WAVE})
    d = as_declared(m, GAS_PATH, own)
    assert_allclose(d.m["i_a"].values[inner], WAVE[inner], atol=0.02)
    assert d.m["i_b"].values is m["i_b"].values
    assert 1.0 <= d.electrical["i_a"].noise < 1.4 and d.electrical["i_b"].noise == 1.0
    assert d.late == 5e-5 and any("known 5e-05 s later" in n for n in d.notes)


def test_a_common_delay_shifts_the_instants_alone():
    own = SensorSet(tuple(dataclasses.replace(s, delay=1e-3) for s in ELECTRICAL.sensors))
    m = read_recording({"t": t, "i_a": WAVE, "i_b": WAVE})
    d = as_declared(m, GAS_PATH, own)
    assert_allclose(d.m["i_a"].t, t - 1e-3) and d.m["i_a"].t is d.m["i_b"].t
    assert d.m["i_a"].values is m["i_a"].values


def test_what_saturates_is_not_used_and_said():
    """Of the gas path five samples on either side, too, of which noise chooses some."""
    slow = np.arange(0, 4, 0.02)
    T5 = np.minimum(700 + 100 * (slow > 2), 760.0)
    m = read_recording({"t": slow, "T5": T5 + 1e-3 * slow * (T5 < 760)})
    d = as_declared(m, changed(GAS_PATH, "T5", limits=(300.0, 760.0)), ELECTRICAL)
    used = np.isfinite(d.m["T5"].values)
    assert used.sum() == (slow <= 2.0).sum() - 5
    assert "end of its range, 760 K, in 99 samples from 2.02 to 3.98 s" in " ".join(d.notes)
    with pytest.raises(DataError, match="T5 is at the end of its range, 300 K"):
        as_declared(m, changed(GAS_PATH, "T5", limits=(200.0, 300.0)), ELECTRICAL)


def test_clipping_that_nobody_declared_is_doubted():
    cut = {"t": t, "i_a": np.clip(WAVE, -250, 250), "v_a": np.clip(WAVE, -300, 300)}
    d = as_declared(read_recording(cut), GAS_PATH, ELECTRICAL)
    assert sorted(x.split(" samples of ")[1][:15] for x in d.doubts) == [
        "i_a are clipped", "v_a are clipped",
    ]  # fmt: skip
    assert np.nanmax(d.m["i_a"].values) < 250 and "v_a" not in d.m
    assert any("v_a: " in n and "too many to be filled" in n for n in d.notes)
    own = changed(changed(ELECTRICAL, "i_a", limits=(-250, 250)), "v_a", limits=(-300, 300))
    assert not as_declared(read_recording(cut), GAS_PATH, own).doubts


def test_expected_errors_are_taken_out():
    own = changed(GAS_PATH, "P3", gain_mean=0.01, bias_mean=100.0)
    m = read_recording({"t": np.arange(3.0), "P3": np.full(3, 8.08e5 + 100)})
    assert_allclose(as_declared(m, own, ELECTRICAL).m["P3"].values, 8e5)


def test_sequences_of_clipped_phases_and_what_they_know():
    """Errors are what is claimed, at twice the variance of unclipped ones."""
    x = np.arange(2000) * 1e-3
    turn = np.exp(-2j * np.pi / 3 * np.arange(3))[:, None]
    clean = (np.exp(2j * np.pi * 49.7 * x) * (turn + 0.01 * turn.conj())).real * 12
    z = []
    for seed in range(6):
        data = clean + 0.05 * np.random.default_rng(seed).standard_normal(clean.shape)
        full, s = (sequences(x, np.where(np.abs(data) < c, data, np.nan)) for c in (99.0, 10.0))
        z.append(np.mean(np.abs((s.unbalance - 0.01) / s.sigma) ** 2) / 2)
    assert np.sqrt(np.mean(z)) == pytest.approx(1.0, abs=0.15)
    assert s.sigma.mean() > 1.3 * full.sigma.mean()


def test_sensors_of_one_clock_share_the_errors_of_their_instants():
    """Readings of one wave are alike but for noise; a filter takes n times the variance."""
    s = dataclasses.replace(V_A, jitter=5e-6, clock="adc")
    other = dataclasses.replace(s, name="v_b")
    one, two = (sampled_wave(x, t, WAVE, Draws(4, machine=m)) for x, m in ((s, 1), (other, 2)))
    assert np.array_equal(one[inner], two[inner])
    alone = dataclasses.replace(other, clock="")
    assert not np.array_equal(one[inner], sampled_wave(alone, t, WAVE, Draws(4))[inner])
    own = ELECTRICAL
    for n in ("i_a", "i_b", "v_a"):
        own = changed(own, n, jitter=5e-6, clock="adc")
    own = changed(own, "i_c", jitter=5e-6)
    d = as_declared(read_recording({"t": t, "i_a": WAVE, "i_b": WAVE, "i_c": WAVE}), GAS_PATH, own)
    now = d.electrical
    assert now["i_a"].jitter == pytest.approx(5e-6 * np.sqrt(2)) and now["i_c"].jitter == 5e-6
    # whatever the slopes of the channels, the shared error is covered: n diag(a^2) - a a' >= 0
    a = np.random.default_rng(0).standard_normal((50, 6))
    for v in a:
        assert np.linalg.eigvalsh(6 * np.diag(v**2) - np.outer(v, v)).min() > -1e-12
    both = changed(changed(GAS_PATH, "P3", jitter=1e-3, clock="x"), "T5", jitter=1e-3, clock="x")
    slow = np.arange(0, 4, 0.02)
    d = as_declared(read_recording({"t": slow, "P3": 8e5 + slow, "T5": 900 + slow}), both, own)
    assert d.gas_path["P3"].jitter == pytest.approx(1e-3 * np.sqrt(2))
