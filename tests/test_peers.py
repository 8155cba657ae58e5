"""Machines compared: errors that they share cancel, and the faulty one is found."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import simpson

from apu_casadi.core.errors import DataError
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu import peers
from estimators.apu.electrical.electricalside import Beliefs, electrical_side
from estimators.apu.joint import electrical_samples, machines_of
from estimators.apu.measuring import measure_run
from estimators.apu.peers import compare, compared_sides
from estimators.apu.recorded_estimate import estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensors import ELECTRICAL

NAMES = ("h_a", "h_b", "h_c", "P", "gain_i_b")
OWN = 1e-10 * (np.eye(3) + 89.0)  # 1e-5 of each phase, and 9e-5 of all alike
SLOPE = np.array([0.0, -2.8e-3, 0.0])  # of severities with the gain of i_b
GAIN = 0.005


def beliefs(h, load=1.0) -> Beliefs:
    """Beliefs of a machine whose filter considers the gain of one current, (n, 3)."""
    n = len(h)
    mean = np.hstack([h, np.full((n, 1), 2e5), np.zeros((n, 1))])
    cov = np.zeros((n, 5, 5))
    cov[:, :3, :3] = OWN
    cov[:, :3, 4] = cov[:, 4, :3] = -load * SLOPE * GAIN**2
    cov[:, 4, 4], cov[:, 3, 3] = GAIN**2, 1e6
    return Beliefs(NAMES, mean, cov)


def draws(rng, n):
    return rng.multivariate_normal(np.zeros(3), OWN, size=n)


def test_a_common_gain_is_no_fault_and_one_fault_is_found_beside_it():
    """Of a gain error of 5 % each machine alone sees 1.4e-4 in phase b, fourteen sigmas."""
    rng, n = np.random.default_rng(0), 50
    false = -0.05 * SLOPE
    c = compare([beliefs(false + draws(rng, n)), beliefs(0.6 * false + draws(rng, n), 0.6)])
    assert c.faulty.max() < 0.05 and not c.phase.any()
    mean, sigma = c.alike[:, 1]
    assert_allclose(mean, 0.8 * 1.4e-4, atol=4e-5)
    assert (mean > 3 * sigma).all()
    real = np.array([0.0, 2e-4, 0.0])
    c = compare([beliefs(false + draws(rng, n)), beliefs(false + real + draws(rng, n))])
    assert (c.faulty[1] > 0.98).all() and (c.faulty[0] < 0.05).all()
    assert (c.phase[1] == 2).all() and c.several.max() < 0.05
    off = (c.severities[0, 1, 1] - 2e-4) / c.severities[1, 1, 1]
    assert np.abs(off).max() < 4
    # of one machine only it is a fault
    c = compare([beliefs(false + draws(rng, n)), beliefs(draws(rng, n))])
    assert (c.phase[0] == 2).all() and not c.phase[1].any()


@pytest.mark.parametrize(
    ("name", "times"), [("gain_v_b", 10.0), ("delay_i", 4.0), ("machine.L_md", 1.0), ("other", 0.0)]
)
def test_what_machines_share_is_decided_by_name(name, times):
    """A common error of its size is no fault of any; of an error that is not common it is one."""
    rng, n = np.random.default_rng(5), 50
    size = (times if times >= 4.0 else 8.0) * GAIN

    def of(h):
        return beliefs(h)._replace(names=(*NAMES[:-1], name))

    c = compare([of(-size * SLOPE + draws(rng, n)) for _ in range(2)])
    assert (c.faulty.max() < 0.1) == (times >= 4.0)


def test_probabilities_are_frequencies(monkeypatch):
    """Machines drawn by the very model: of those with probability p, a share p is faulty."""
    monkeypatch.setattr(peers, "NONLINEAR", 0.0)
    rng, n = np.random.default_rng(1), 4000
    faulty = rng.random((2, n)) < 0.3
    phase, size = rng.integers(0, 3, (2, n)), np.abs(rng.standard_normal((2, n))) * 8e-5
    common = 0.05 * rng.standard_normal(n)[:, None] * SLOPE
    common = common + 1e-4 * rng.standard_normal((n, 1))
    h = [
        draws(rng, n) + common + (faulty[k] * size[k])[:, None] * np.eye(3)[phase[k]]
        for k in (0, 1)
    ]
    c = compare([beliefs(v) for v in h], balanced=1e-4, faulty=0.3, scale=8e-5)
    p = c.faulty.ravel()
    for low, high in ((0.0, 0.15), (0.15, 0.3), (0.3, 0.6), (0.6, 0.9), (0.9, 1.0)):
        inside = (p >= low) & (p <= high)
        assert inside.sum() > 100
        true, said = faulty.ravel()[inside].mean(), p[inside].mean()
        assert abs(true - said) < 3.5 * np.sqrt(said * (1 - said) / inside.sum())
    true = (phase + 1) * faulty
    score = np.mean([c.phase[k] == true[k] for k in (0, 1)])
    assert score > 0.8


def test_odds_of_one_fault_are_the_integral_over_its_severity():
    """By quadrature, of three machines without common errors but the balanced one."""
    rng, tau, q = np.random.default_rng(2), 3e-5, 0.1
    h = [draws(rng, 1) + np.array([2e-5, 0, 0]) * (k == 1) for k in range(3)]
    b = [Beliefs(NAMES[:3], v, np.broadcast_to(OWN, (1, 3, 3))) for v in h]
    with pytest.MonkeyPatch.context() as m:
        m.setattr(peers, "TOGETHER", 1)
        m.setattr(peers, "NONLINEAR", 0.0)
        c = compare(b, balanced=2e-4, faulty=q, scale=tau)
    R = np.kron(np.eye(3), OWN) + 4e-8
    inverse, flat = np.linalg.inv(R), np.concatenate(h, axis=1)[0]
    x = np.linspace(0, 12 * tau, 20001)
    prior = 2 * np.exp(-0.5 * (x / tau) ** 2) / np.sqrt(2 * np.pi) / tau
    odds = np.zeros(9)
    for i in range(9):
        off = flat[:, None] - np.eye(9)[:, [i]] * x
        fits = np.einsum("ik,ij,jk->k", off, inverse, off) - flat @ inverse @ flat
        odds[i] = q / 3 / (1 - q) * simpson(prior * np.exp(-0.5 * fits), x=x)
    expected = odds.reshape(3, 3) / (1 + odds.sum())
    assert_allclose(c.probability[:, 1:, 0], expected, rtol=1e-6)


def test_two_faults_are_the_double_integral():
    """Of two machines with one common error that looks like both: correlated severities."""
    rng, tau, q = np.random.default_rng(4), 3e-5, 0.1
    h = [draws(rng, 1) + np.array([0, 3e-5, 0]) for _ in range(2)]
    with pytest.MonkeyPatch.context() as m:
        m.setattr(peers, "NONLINEAR", 0.0)
        c = compare([beliefs(v) for v in h], balanced=2e-4, faulty=q, scale=tau)
    gain = np.tile(SLOPE, 2) * 0.05
    R = np.kron(np.eye(2), OWN) + 4e-8 + np.outer(gain, gain)
    inverse, flat = np.linalg.inv(R), np.concatenate(h, axis=1)[0]
    x = np.linspace(0, 8 * tau, 401)
    prior = 2 * np.exp(-0.5 * (x / tau) ** 2) / np.sqrt(2 * np.pi) / tau
    pair, one, odds = q / 3 / (1 - q), np.zeros((2, 3)), np.zeros((3, 3))

    def likelihood(off):
        fits = np.einsum("i...,ij,j...->...", off, inverse, off) - flat @ inverse @ flat
        return np.exp(-0.5 * fits)

    for i in range(6):
        off = flat[:, None] - np.eye(6)[:, [i]] * x
        one[i // 3, i % 3] = pair * simpson(prior * likelihood(off), x=x)
    for i in range(3):
        for j in range(3):
            at = np.eye(6)[:, [i, 3 + j]]
            off = flat[:, None, None] - at[:, :1, None] * x[:, None] - at[:, 1:, None] * x
            inner = simpson(prior * likelihood(off), x=x, axis=1)
            odds[i, j] = pair**2 * simpson(prior * inner, x=x)
    total = 1 + one.sum() + odds.sum()
    assert_allclose(c.several[0], odds.sum() / total, rtol=1e-4)
    both = np.array([odds.sum(1), odds.sum(0)])
    assert_allclose(c.probability[:, 1:, 0], (one + both) / total, rtol=1e-4)


def test_what_cannot_be_compared_is_told():
    one = beliefs(np.zeros((4, 3)))
    with pytest.raises(DataError, match="two machines at least"):
        compare([one])
    with pytest.raises(DataError, match="of the same windows"):
        compare([one, beliefs(np.zeros((5, 3)))])
    with pytest.raises(DataError, match="h_a, h_b, h_c, in this order"):
        compare([one, one._replace(names=("h_b", *NAMES[1:]))])
    assert compared_sides({}) == (None, {}, [])


@pytest.mark.long
def test_errors_that_fool_each_machine_alone():
    """Simulated: currents of phase b 5 % too small and speeds 0.5 % too high in both."""
    apu, t = Apu(), np.arange(0, 0.2 + 1e-9, 0.02)
    wrong = {"i_b": 0.95, "w_r": 1.005}
    for h in (0.0, 2e-4):
        events = (
            [FaultChange(0.06, Ttsc(0.05, 0.05 / h - 0.95, phase="b"), generator=2)] if h else []
        )
        loads = [SeriesLoad.from_power(p) for p in (100e3, 99e3)]
        ds = simulate_joint(
            apu, duration=0.2, load=loads, events=events, dt=0.005, exchange="corrected",
            waveform_dt=1e-4,
        )  # fmt: skip
        rng, sides = np.random.default_rng(1), {}
        for k, (_, one, view) in enumerate(machines_of(ds, apu), 1):
            samples = electrical_samples(view, one, rng)
            samples = {n: v * wrong.get(n, 1.0) for n, v in samples.items()}
            sides[k] = electrical_side(one, ELECTRICAL, samples, t, backend="vm")
        assert [int(s.phase[-1]) for s in sides.values()] == [2, 2]
        assert min(s.probability[-1] for s in sides.values()) > 0.98
        c, report, doubts = compared_sides(sides)
        assert c.faulty[0, -1] < 0.05 and list(c.phase[:, -1]) == [0, 2 if h else 0]
        assert report["machines"]["2"]["probability"] == c.faulty[1, -1]
        assert len(doubts) == (1 if h else 2) and "machine 1: all machines show" in doubts[0]
        if h:
            assert c.faulty[1, -1] > 0.98 and c.several[-1] < 0.05
            assert abs(c.severities[0, 1, 1, -1] - h) < 3 * c.severities[1, 1, 1, -1]


@pytest.mark.long
def test_the_report_of_a_recording_names_the_faulty_machine():
    apu = Apu()
    ds = simulate_joint(
        apu, duration=0.16, load=SeriesLoad.from_power(100e3), dt=0.005, waveform_dt=1e-4,
        events=[FaultChange(0.06, Ttsc(0.05, 20.0, phase="c"), generator=2)],
    )  # fmt: skip
    waves = measure_run(ds, apu, 3)["electrical"]
    arrays = {"t": waves["time"].values, **{n: waves[n].values for n in waves}}
    e = estimate(read_recording(arrays), only="electrical", backend="vm")
    of = e.report()["compared"]["machines"]
    assert of["1"]["probability"] < 0.05 < 0.98 < of["2"]["probability"]
    assert of["2"]["likeliest_phase"] == "c"
    assert "generator 2 has a short circuit with a probability of 1.000" in e.summary() or (
        "generator 2 has a short circuit with a probability of 0.99" in e.summary()
    )
    assert not any("all machines show" in d for d in e.doubts)
