"""Exact propagation of the generator between samples, against CVODES and against itself."""

import math

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core import simulation
from apu_casadi.core.errors import NotApplicable, SimulationError
from apu_casadi.core.hoisting import hoisted
from apu_casadi.machine import transition
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.loads.openphase import OpenPhase
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.propagation import Propagator, strides
from apu_casadi.machine.weights import gregory, rippling, unresolved

GEN = Generator()
ISOLATED = Generator(neutral="isolated")
W = GEN.machine.w_rated
KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
OPEN = OpenPhase(SeriesLoad.from_power(100e3, 0.9), "b")
UNEVEN = SeriesLoad.from_power(100e3, 0.9, unbalance=(1.3, 1.0, 0.7))
OUTPUTS = ("v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "V_fd", "T_e", "P_total")
QUAD = ("P_total", "P_e", "v_a^2", "i_b^2")
STEP = {"n_out": 400, "dt": 0.02, "outputs": OUTPUTS, "quad": QUAD}


def single_samples(*given):
    """The propagator whose exciter steps at every sample; None where that is refused."""
    try:
        return Propagator(*given, **STEP, fine=True)
    except NotApplicable:
        return None


@pytest.mark.long
@pytest.mark.parametrize(
    ("gen", "load", "fault"),
    [
        (GEN, KW100, None),
        (GEN, KW100, Ttsc(0.05, 20.0)),
        (GEN, KW100, Ttsc(0.05, 1.0, 1.0, phase="b")),
        (GEN, UNEVEN, None),
        (GEN, UNEVEN, Ttsc(0.05, 1.0, 1.0, phase="c")),
        (GEN, OpenLoad(), None),
        # windings or a fault branch that settle within a small part of a sample
        (GEN, KW100, Ttsc(0.05, 20.0, 0.0501)),
        (GEN, OpenLoad(), Ttsc(0.01, 100.0)),
        (ISOLATED, KW100, Ttsc(0.05, 20.0)),
        (ISOLATED, UNEVEN, None),
        (GEN, OPEN, None),
        (ISOLATED, OPEN, None),
    ],
    ids=lambda v: getattr(v, "neutral", None) or repr(v),
)
def test_equals_cvodes(gen, load, fault):
    """Three steps of 20 ms at 1 % overspeed, 40 ms after the switch: 5e-6 of peak, means 1e-5.

    CVODES runs at rtol 1e-11.  What is left is the exciter's step and the cut of the series.
    Where a phase is open strides of two samples are taken; its voltage has 2e-5 of the solver's.
    """
    point = gen.steady_state(KW225, theta_e=0.3)
    ss = gen.variant(load, fault)
    u = gen.inputs(load, V_ref=point.V_ref, w_r=1.01 * W)
    theta = gen.fault_vector(load, fault)
    x = gen.transfer(point.x, point.ss, ss, u=point.u, theta=[], u_target=u)
    x = simulation.stepper(ss, 1, rtol=1e-11, atol=1e-13)(x, u, theta, 0.04).x_end.copy()
    given = (gen, ss, u, theta)
    fast = single_samples(*given) or Propagator(*given, **STEP)
    exact = simulation.stepper(ss, 400, quad=QUAD, rtol=1e-11, atol=1e-13)
    x_fast = x.copy()
    rows = ss.y.indices(OUTPUTS)
    for _ in range(3):
        ours, theirs = fast.result(x_fast, u), exact(x, u, theta, 0.02)
        assert_allclose(ours.t, theirs.t, rtol=0, atol=0)
        for a, b in zip(ours.y, theirs.y[rows], strict=True):
            assert_allclose(a, b, rtol=0, atol=(2e-5 if load is OPEN else 5e-6) * np.abs(b).max())
        for name in QUAD:
            scale = max(abs(theirs.mean[name]), 1.0)
            assert abs(ours.mean[name] - theirs.mean[name]) < 1e-5 * scale
        x_fast, x = ours.x_end.copy(), theirs.x_end.copy()


@pytest.mark.long
def test_long_strides_agree_with_single_samples():
    """Several samples for each step of the exciter: the same within 1e-6 of peak once settled."""
    point = GEN.steady_state(KW100)
    for load, fault in ((KW100, None), (KW100, Ttsc(0.05, 20.0))):
        ss = GEN.variant(load, fault)
        u, theta = GEN.inputs(load, V_ref=point.V_ref), GEN.fault_vector(load, fault)
        x = GEN.transfer(point.x, point.ss, ss, u=point.u, theta=[], u_target=u)
        x = simulation.stepper(ss, 1)(x, u, theta, 0.2).x_end.copy()
        runs = [
            Propagator(GEN, ss, u, theta, **STEP, fine=fine).result(x, u) for fine in (True, False)
        ]
        for a, b in zip(runs[0].y, runs[1].y, strict=True):
            assert_allclose(b, a, rtol=0, atol=1e-6 * np.abs(a).max())


def test_coefficients_are_recognised_as_constant_or_periodic():
    """Healthy and balanced: no harmonics; a fault or an unbalanced load: some, and they end."""
    for load, fault, constant in (
        (KW100, None, True),
        (KW100, Ttsc(0.05, 20.0), False),
        (UNEVEN, None, False),
    ):
        ss = GEN.variant(load, fault)
        u, theta = GEN.inputs(load), GEN.fault_vector(load, fault)
        table = transition.transition_table(ss, u, theta, W, h=50e-6)
        assert (table.harmonics == 0) == constant
        assert table.harmonics < transition.HARMONICS[-1] - 1
        assert table.error <= transition.STEP_TOL


def test_mean_weights_are_of_order_ten_and_six():
    """Exact for polynomials to degree 9, to 5 with few samples; spectral for what is periodic."""
    for n, exact_to in ((10, 5), (40, 9)):
        t = np.linspace(0.0, 1.0, n + 1)
        for k in range(exact_to + 1):
            assert gregory(n) @ t**k == pytest.approx(1 / (k + 1), rel=1e-13)
    # the square of a phase voltage at 2 % overspeed over 20 ms: 16.3 ripples, 10 samples each
    t = np.linspace(0.0, 1.0, 161)
    phase = 2 * math.pi * 16.3
    wave = 0.5 + 0.5 * np.cos(phase * t + 0.8)
    exact = 0.5 + (math.sin(phase + 0.8) - math.sin(0.8)) / (2 * phase)
    assert gregory(160) @ wave == pytest.approx(exact, rel=2e-6)


def test_ripples_that_change_slowly_are_integrated_exactly():
    """Seven harmonics of a period of 14 samples times lines and parabolas, against Gauss."""
    first, partial = rippling(30, 5, 14, {0: 3, 1: 2, 2: 2, 3: 1, 4: 1, 5: 1, 6: 0})
    at = np.arange(-29.0, 6.0)
    node, share = np.polynomial.legendre.leggauss(200)
    for m, p in ((0, 3), (1, 2), (4, 1), (6, 0)):
        for shift in (0.0, 0.7):

            def f(t, m=m, p=p, shift=shift):
                return (1 + t / 20) ** p * np.cos(2 * math.pi * m * t / 14 + shift)

            exact = share @ f(14.5 * node - 14.5) * 14.5
            assert first @ f(at) == pytest.approx(exact, abs=1e-12)
            for x in (0.0, 0.31, 1.0):
                weights = [np.polyval(row[::-1], x - 0.5) for row in partial]
                exact = share @ f(x / 2 * (1 + node)) * x / 2
                assert weights @ f(at) == pytest.approx(exact, abs=1e-12)


@pytest.mark.parametrize("slope", [0.0, 1 / 12], ids=["Simpson's rule", "a cubic"])
def test_what_sums_of_samples_leave_of_a_decay(slope):
    """Against the integral of exp(-z t) itself, as fast as light loads have it: to 1e-3."""
    weights = np.array([0.5, 1.0, 1.0]) if slope else np.array([1.0, 4.0, 2.0, 4.0]) / 3.0
    n, *below = unresolved(weights, slope)
    for z in (0.3, 1.0, 2.0, 5.0, 9.0):
        samples = np.exp(-z * np.arange(200))
        rule = np.append(weights[:-2], np.resize(weights[-2:], 200 - weights.size + 2))
        left = 1 / z - rule @ samples + slope * z
        assert -n * z**3 / np.polyval([*below[::-1], 1.0], z) == pytest.approx(left, abs=1e-3)


def test_strides_cover_every_sample_once():
    """Where nothing ripples the head resolves a millisecond; no sample is left over."""
    for n, h in ((400, 50e-6), (160, 125e-6), (200, 100e-6), (11, 1e-4)):
        for constant in (True, False):
            s = strides(n, h, constant, False)
            assert s.head + s.m * s.many == n
            assert s.head * h >= (min(1e-3, n * h) - 1e-12 if constant else 0)
            assert s.starts().size == s.head + s.many
    assert strides(400, 50e-6, True, True) == (400, 1, 0)
    assert strides(11, 1e-4, False, False) == (1, 2, 5)


def test_what_is_not_linear_or_too_coarse_is_refused():
    """Each message says what to use instead, or by how much a limit is passed."""
    load = ConstantPowerLoad(90e3)
    ss = GEN.variant(load)
    with pytest.raises(SimulationError, match="not linear"):
        Propagator(GEN, ss, GEN.inputs(load), np.zeros(0), n_out=100, dt=0.02)
    ss, u = GEN.variant(KW100), GEN.inputs(KW100)
    with pytest.raises(SimulationError, match="at least 10 samples"):
        Propagator(GEN, ss, u, np.zeros(0), n_out=4, dt=0.02)
    fast = Propagator(GEN, ss, u, np.zeros(0), n_out=100, dt=0.02, quad=("P_total",))
    x = GEN.steady_state(KW100).x
    with pytest.raises(SimulationError, match=r"outside the table"):
        fast(x, GEN.inputs(KW100, w_r=1.2 * W))
    # full forcing of a cold exciter: the field voltage runs away from its quadratic
    x = x.copy()
    x[ss.x.index("V_R")] += 5.0
    with pytest.raises(SimulationError, match=r"misses it by .* > "):
        fast(x, u)


def test_single_samples_beside_an_open_phase_are_refused():
    """They take the slope of the terminal voltage: power was 2 % off."""
    ss, u = GEN.variant(OPEN, None), GEN.inputs(OPEN)
    with pytest.raises(NotApplicable, match="digits an open phase takes"):
        Propagator(GEN, ss, u, GEN.fault_vector(OPEN, None), n_out=400, dt=0.02, fine=True)


def test_a_series_that_does_not_converge_is_refused(monkeypatch):
    """Fewer harmonics or steps than the fault on an open generator needs: told, not cut off."""
    load, fault = OpenLoad(1e4), Ttsc(0.05, 20.0)
    ss = GEN.variant(load, fault)
    u, theta = GEN.inputs(load), GEN.fault_vector(load, fault)
    monkeypatch.setattr(transition, "HARMONICS", (8, 16))
    with pytest.raises(SimulationError, match=r"over \d+ harmonics"):
        transition.transition_table(ss, u, theta, W, h=50e-6)
    monkeypatch.setattr(transition, "STAGES", 1)
    monkeypatch.setattr(transition, "FEW", 1)
    with pytest.raises(SimulationError, match="do not converge"):
        transition.transition_table(ss, u, theta, W, h=50e-6)


@pytest.mark.parametrize("k_rf", [500.0, 5000.0])
def test_fewer_stages_are_as_good_where_a_branch_settles_at_once(monkeypatch, k_rf):
    """A light fault asks for four steps and more: entries as of eight stages to 1e-9 nominal."""
    load, fault = SeriesLoad.from_power(100e3, 0.85), Ttsc(0.05, k_rf)
    ss = GEN.variant(load, fault)
    u, theta = GEN.inputs(load), GEN.fault_vector(load, fault)
    few = transition.transition_table(ss, u, theta, W, angle=2 * math.pi / 28)
    monkeypatch.setattr(transition, "FEW", transition.STAGES)
    all_ = transition.transition_table(ss, u, theta, W, angle=2 * math.pi / 28)
    units = transition.nominal_entries(ss, 1)
    for part, scale in zip(("even", "odd"), units, strict=True):
        a, b = (getattr(t, part) * scale for t in (few, all_))
        n = min(a.shape[1], b.shape[1])
        assert np.abs(a[:, :n] - b[:, :n]).max() < 1e-9


def test_what_is_fixed_is_taken_out_of_a_loop_and_divides_nothing_in_it():
    """Inside there is no division by it and no cosine of it; the values are the same."""
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 2)
    values = [ca.vertcat(x[0] / p[0] + ca.cos(p[1]) * x[1], p[0] / x[1], x[1] / (p[0] + p[1]))]
    inner, before = hoisted("f", [x], p, values)
    ids = [inner.instruction_id(k) for k in range(inner.n_instructions())]
    assert ids.count(ca.OP_DIV) == 1 and ca.OP_COS not in ids
    given = np.array([0.3, 0.7]), np.array([1.7, 0.4])
    expected = ca.Function("e", [x, p], values)(*given).full()
    assert_allclose(inner(given[0], before(given[1])).full(), expected, rtol=1e-15)


def test_noise_that_half_a_turn_does_not_reverse_is_refused():
    """Noise in the zero sequence breaks the symmetry that halves the table."""
    fault = Ttsc(0.05, 20.0)
    ss = GEN.variant(KW100, fault)
    u, theta = GEN.inputs(KW100, w1_0=1.0), GEN.fault_vector(KW100, fault)
    with pytest.raises(SimulationError, match="half a turn"):
        transition.transition_table(ss, u, theta, W, h=50e-6)


def test_transition_matrices_agree_with_exponentials():
    """A healthy machine's, at three speeds: exp(M h) by scipy, in nominal units to 1e-9."""
    from scipy.linalg import expm

    ss, u, h = GEN.variant(KW100), GEN.inputs(KW100), 100e-6
    table = transition.transition_table(ss, u, np.zeros(0), W, h=h)
    n = len(ss.linear)
    nominal = ss.x.nominals[ss.x.indices(ss.linear)]
    for w in (0.95 * W, W, 1.03 * W):
        u[ss.u.index("w_r")] = w
        M = transition.coefficients(ss.shared)(0.7, u, ss.full([])).full()
        exact = expm(h * M)[:n]
        entries = np.zeros(n * (n + transition.EXTRA))
        entries[transition.parity(ss, 1).even] = table.at(w)[0].ravel()
        P = entries.reshape(-1, n).T
        scale = nominal[:, None] / np.append(nominal, np.ones(transition.EXTRA))
        assert_allclose(P / scale, exact / scale, rtol=0, atol=1e-9)
