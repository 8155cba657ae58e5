"""Changes below what gain errors hide: against draws, and in a run that is measured."""

import math

import numpy as np
import pytest

from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.electrical.electricalside import Beliefs
from estimators.apu.electrical.smallchanges import change_statistic, offset_steps
from estimators.apu.measuring import measure_run
from estimators.apu.recorded_estimate import estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensors import ELECTRICAL

N = 40


def beliefs(rng, rise=0.0):
    """Windows of a filter that considers two errors, of which a load step changes the effect."""
    S = np.repeat([[[4e-5, 1e-5], [0, 5e-5], [-2e-5, 3e-5]]], N, axis=0)
    S[20:] *= 2.0
    noise = 3e-6
    c = rng.standard_normal(2)
    h = (S @ c) + noise * rng.standard_normal((N, 3))
    h[34:, 1] += rise
    cov = np.zeros((N, 6, 6))
    cov[:, 4:, 4:] = np.eye(2)
    cov[:, :3, 4:], cov[:, 4:, :3] = S, S.transpose(0, 2, 1)
    cov[:, :3, :3] = S @ S.transpose(0, 2, 1) + noise**2 * np.eye(3)
    mean = np.concatenate([h, np.zeros((N, 1)), np.zeros((N, 2))], axis=1)
    return Beliefs(("h_a", "h_b", "h_c", "P", "gain_1", "gain_2"), mean, cov)


def test_a_rise_is_told_from_constant_errors():
    """Without one the statistic is standard normal, at the step of the sensitivities as well; a
    rise of 4e-5, less than one standard deviation of the severity, is ten of its change's."""
    rng = np.random.default_rng(5)
    for lag, width in ((1, 1), (5, 2)):
        z = np.array([change_statistic(beliefs(rng), lag, width) for _ in range(400)])
        first = 5 + lag + 2
        assert not z[:, :, :first].any() and z[:, :, first:].all()
        for part in (slice(first, 20), slice(20, 30), slice(34, 40)):
            assert z[:, :, part].std() == pytest.approx(1.0, abs=0.07)
            assert abs(z[:, :, part].mean()) < 0.06
        risen = np.array([change_statistic(beliefs(rng, 4e-5), lag, width) for _ in range(200)])
        shown = risen[:, :, 33 + width : 34 + lag].mean((0, 2))
        sigma = 3e-6 * math.sqrt(1 / width + 1 / 10)
        assert shown[1] == pytest.approx(4e-5 / sigma, rel=0.3)
        # of what all three have in common nothing is known, and so the others fall
        assert shown[[0, 2]].max() < 0
    assert not change_statistic(beliefs(rng), N, 1).any()
    small = change_statistic(beliefs(rng), 1, 1, first=38)
    assert not small.any()


def waves(rng, size=0.0, names=(), at=0.503):
    """Currents and voltages of 400 Hz at 10 kHz for a second, with an offset from an instant on."""
    t = 1e-4 * np.arange(10_000)
    a = {"t": t, "w_r": np.full(t.size, 2 * math.pi * 400.0)}
    for kind, top, s in (("v", 325.0, 0.5), ("i", 300.0, 1.0)):
        for k, p in enumerate("abc"):
            wave = top * np.cos(a["w_r"] * t - k * 2 * math.pi / 3)
            a[f"{kind}_{p}"] = wave + s * rng.standard_normal(t.size)
    for n in names:
        a[n] += size * (t >= at)
    return a


def test_an_offset_that_comes_is_the_sensor_s():
    rng = np.random.default_rng(7)
    for size in (1.0, -3.0):
        (found,) = offset_steps(waves(rng, size, ["i_b"]), ELECTRICAL)
        assert found.name == "i_b" and found.size == pytest.approx(size, abs=0.2)
        assert found.t == pytest.approx(0.503, abs=2e-3)
    assert offset_steps(waves(rng), ELECTRICAL) == []
    assert offset_steps(waves(rng, 0.2, ["i_b"]), ELECTRICAL) == []
    # of two channels at once: a direct current that flows
    assert offset_steps(waves(rng, 3.0, ["i_b", "i_c"]), ELECTRICAL) == []
    assert offset_steps(waves(rng, 3.0, ["i_b", "v_b"]), ELECTRICAL) == []
    a = waves(rng, 3.0, ["i_b"])
    a["i_b"][[100, 5030]] = np.nan  # the step itself is a wild sample
    assert offset_steps(a, ELECTRICAL)[0].name == "i_b"
    a["i_b"][rng.random(10_000) < 0.05] = np.nan
    assert offset_steps(a, ELECTRICAL) == []
    short = {n: v[:1000] for n, v in waves(rng).items()}
    assert offset_steps(short, ELECTRICAL) == []


@pytest.mark.ci  # a run, its recording and filters compiled: 5 s
def test_a_short_circuit_that_gain_errors_hide_is_told_by_its_onset():
    """h = 1e-4 at 225 kW is 2.5 standard deviations: no report, but an answer, with its instant."""
    apu, event = Apu(), FaultChange(0.313, Ttsc.of_h(0.05, 1e-4, phase="b"))
    run = {"duration": 0.8, "load": SeriesLoad.from_power(225e3), "events": (event,)}
    fine = {"dt": 0.005, "exchange": "corrected", "waveform_dt": 1e-4}
    ds = simulate_joint(apu, **run, **fine, warn_exchange=False)
    made = measure_run(ds, apu, 1)["electrical"]
    e = estimate(read_recording(made), apu, only="electrical")
    (answer,) = e.diagnoses
    assert answer.best == "machine 1: short circuit b"
    assert answer.t == pytest.approx(0.313, abs=2.6e-3)
    assert e.believable and not e.machines[1]["faulty_phase"].values.any()
    made["i_a"].values[5500:] += 2.0
    failed = estimate(read_recording(made), apu, only="electrical")
    assert failed.diagnoses[-1].best == "machine 1: sensor i_a"
    assert not failed.believable
