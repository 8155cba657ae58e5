"""The machine at given terminals, against the generator with load and exciter by CVODES.

The generator's model is another set of equations around the same windings (voltages are unknowns
there, eliminated with the load), and CVODES another integrator with its own steps: where both say
the same currents for the same voltages, the terminal model and the interpolation of sampled
voltages are right.
"""

import math

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ParameterError
from apu_casadi.machine import terminals as tm
from apu_casadi.machine.faults.ttsc import Ttsc, fault_loss
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.park import Abc

GEN = Generator()
P = GEN.machine
W = P.w_rated
DT = 1e-4
FULL = SeriesLoad.from_power(225e3)
UNEVEN = SeriesLoad.from_power(225e3, unbalance=(1.05, 1.0, 0.95))
I_NOISE = 1.0  # A, the current sensors; what the model errs must be small beside it
MEASURED = ("i_a", "i_b", "i_c", "i_fd")


def truth(fault, load, duration=0.1):
    """Samples of the generator at 10 kHz, a settled 0.1 s after load and fault came."""
    switches = [(0.0, load), (0.0, fault)] if fault else [(0.0, load)]
    data = GEN.simulate(FULL, 0.1 + duration, switches=switches, dt_out=DT, rtol=1e-9, atol=1e-11)
    return {n: data[n].values[1000:] for n in data.data_vars} | {"t": data["time"].values[1000:]}


def run(kind, theta, d):
    """One-step and long-run currents of the terminal model along a truth, both (4, K - 1)."""
    ss = tm.terminal_model(P, kind)
    th = ss.theta.pack(theta)
    x = ca.SX.sym("x", len(ss.x))
    u = [ca.SX.sym(n, 5) for n in ("u0", "um", "u1")]
    at = [tm.Terminals(v[0], Abc(v[1], v[2], v[3]), v[4]) for v in u]
    step = ca.Function(
        "step",
        [x, *u],
        [tm.advance(lambda s, a: ss.f(s, ca.vertcat(a.w_r, *a.v, a.V_fd), th), x, *at, DT)],
    )
    K = d["t"].size
    w = np.full(K, W)
    v = np.array([d[f"v_{k}"] for k in "abc"])
    mid = tm.midpoints(d["t"], v, w)
    V_fd = d["V_fd"]
    U = np.vstack([w, v, V_fd])
    M = np.vstack([w, mid, (V_fd + np.append(V_fd[1:], V_fd[-1])) / 2])
    X = np.array([d[n] for n in ss.x.names])
    rows = ss.y.indices(MEASURED)

    def y(X, U):
        return ss.g.map(X.shape[1])(X, U, np.repeat(th[:, None], X.shape[1], 1)).full()[rows]

    one = step.map(K - 1)(X[:, :-1], U[:, :-1], M[:, :-1], U[:, 1:]).full()
    many = step.mapaccum(K - 1)(X[:, 0], U[:, :-1], M[:, :-1], U[:, 1:]).full()
    true = np.array([d[n] for n in MEASURED])
    return y(X, U) - true, y(one, U[:, 1:]) - true[:, 1:], y(many, U[:, 1:]) - true[:, 1:]


@pytest.mark.parametrize(
    ("kind", "load", "fault", "step", "long"),
    [
        ("shunts", FULL, None, 1e-8, 1e-6),
        ("shunts", UNEVEN, None, 0.01, 0.3),
        ("shunts", FULL, Ttsc(0.05, 0.05 / 1e-3 - 0.95, phase="b"), 0.01, 0.5),
        ("leaky", UNEVEN, Ttsc(0.01, 1.0, kappa=1.0, phase="c"), 0.01, 0.3),
        # 40 times rated current in the fault branch: higher harmonics show
        ("shunts", FULL, Ttsc(0.05, 1.0), 2.0, 4.0),
    ],
    ids=["healthy", "unbalanced", "h 1e-3", "kappa 1", "h 2.6e-2"],
)
def test_currents_are_those_of_the_generator(kind, load, fault, step, long):
    """Equations (5)-(7) and (9): outputs to rounding, steps and long runs below sensor noise.

    Steps are judged once two periods are there for the harmonics; a long run starts before, and
    keeps for a while what the first steps err.
    """
    theta = {}
    if fault and kind == "shunts":
        theta = {f"h_{fault.phase}": fault.h}
    elif fault:
        theta = {"mu": fault.mu, "k_rf": fault.k_rf, "kappa": fault.kappa,
                 "phase_angle": fault.phase_angle}  # fmt: skip
    here, one, many = run(kind, theta, truth(fault, load))
    assert np.abs(here).max() < 1e-8
    assert np.abs(one)[:, 60:-3].max() < step * I_NOISE
    assert np.abs(many)[:, :-3].max() < long * I_NOISE


def test_linear_interpolation_would_not_do():
    """The reason for the sinusoid: 0.5 % of the voltage at 25 samples a period."""
    t = np.arange(100) * DT
    v = 325.0 * np.array([np.cos(W * t - a) for a in (0, 2.1, 4.2)])
    exact = 325.0 * np.array([np.cos(W * (t + DT / 2) - a) for a in (0, 2.1, 4.2)])
    linear = (v[:, :-1] + v[:, 1:]) / 2
    assert np.abs(linear - exact[:, :-1]).max() / 325.0 == pytest.approx(
        1 - math.cos(W * DT / 2), rel=0.02
    )
    assert_allclose(tm.midpoints(t, v, np.full(t.size, W))[:, :-1], exact[:, :-1], atol=1e-9)


def test_midpoints_know_the_harmonics_and_leave_noise_alone():
    """3rd and 5th harmonic within 1 % of them; white noise as from two neighbours within 5 %."""
    t = np.arange(300) * DT
    w = np.full(t.size, W)

    def wave(t):
        return np.array([300 * np.cos(W * t) + 6 * np.cos(3 * W * t + 1) + np.sin(5 * W * t)])

    two = tm.midpoints(t, wave(t), w, periods=0)
    four = tm.midpoints(t, wave(t), w)
    exact = wave(t + DT / 2)
    inner = slice(60, -3)
    assert np.abs(two - exact)[:, inner].max() > 0.3
    assert np.abs(four - exact)[:, inner].max() < 0.05
    noise = np.random.default_rng(0).standard_normal((3, 300))
    a, b = (tm.midpoints(t, noise, w, periods=p)[:, inner] for p in (0, 2))
    assert np.std(b - a) < 0.05


def test_a_missing_sample_falls_back_on_the_neighbours():
    """Four equal steps are not to be had around a gap; the sinusoid is still exact there."""
    t = np.delete(np.arange(60) * DT, 30)
    v = np.array([np.cos(W * t), np.sin(W * t)])
    mid = tm.midpoints(t, v, np.full(t.size, W))
    between = (t[:-1] + t[1:]) / 2
    assert_allclose(mid[:, :-1], [np.cos(W * between), np.sin(W * between)], atol=1e-12)


def test_jumps_are_found_where_they_are():
    """A load switched between two samples; unbalance, harmonics and noise are none."""
    rng = np.random.default_rng(1)
    t = np.arange(200) * DT
    w = np.full(t.size, W)
    v = np.array([(1 + 0.03 * k) * 325 * np.cos(W * t - 2.1 * k) for k in range(3)])
    v += 4 * np.cos(3 * W * t) + 0.5 * rng.standard_normal(v.shape)
    plane, zero = tm.jumps(t, v, w, floor=5.0)
    assert not plane.any()
    v[:, 100:] *= 0.8
    plane, _ = tm.jumps(t, v, w, floor=5.0)
    assert set(np.flatnonzero(plane)) == {99}
    assert plane[99] == pytest.approx(0.2 * 325, rel=0.2)
    assert zero.shape == plane.shape == t.shape


def test_predictions_do_not_hold_the_sample():
    """``before``: continuing the fundamental, whatever the sample and the one before it read."""
    t = np.arange(200) * DT
    w = np.full(t.size, W)
    x = np.array([200 * np.cos(W * t + 0.3) + 5 * np.sin(3 * W * t)])
    assert_allclose(tm.before(t, x, w), x, atol=1e-9)  # 25 samples a period: no leakage
    y = x.copy()
    y[0, 150] += 10.0
    p = tm.before(t, y, w)
    assert_allclose(p[0, :152], x[0, :152], atol=1e-9)
    assert abs(p[0, 152] - x[0, 152]) > 0.1
    z = tm.before(t, x, w, space=True)
    assert_allclose(z[0], 200 * np.exp(1j * (W * t + 0.3)), atol=1e-9)


def test_shunt_loss_is_the_fault_loss():
    """(8): the loss written with h alone is that with mu, k_rf and i_fault, for kappa = mu."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        mu, k_rf = rng.uniform(0.01, 0.2), rng.uniform(0, 20)
        h = mu / (k_rf + 1 - mu)
        v, ibar = rng.uniform(-325, 325), rng.uniform(-460, 460)
        i_fault = -v / ((1 - mu + k_rf) * P.r_s)
        want = fault_loss(P, mu=mu, k_rf=k_rf, i_k=ibar + mu * i_fault, i_fault=i_fault)
        got = tm.shunt_loss(P, ibar=Abc(ibar, 0, 0), v=Abc(v, 9, 9), h=Abc(h, 0, 0))
        assert got == pytest.approx(want, rel=1e-12)


def test_shunt_parameters_invert_the_equivalent_circuit():
    """R and L of the fault, and back: one pair (mu, k_rf) for each kappa, none without."""
    f = Ttsc(0.03, 2.0, kappa=0.7)
    R, L = f.R_shunt(P), f.L_shunt(P)
    back = tm.shunt_parameters(P, R=R, L=L, kappa=0.7)
    assert back == pytest.approx({"mu": 0.03, "k_rf": 2.0})
    other = Ttsc(**tm.shunt_parameters(P, R=R, L=L, kappa=0.3), kappa=0.3)
    assert (other.R_shunt(P), other.L_shunt(P)) == pytest.approx((R, L))
    assert other.mu != pytest.approx(0.03, rel=0.1)
    with pytest.raises(ParameterError, match="full coupling"):
        tm.shunt_parameters(P, R=R, L=0.0, kappa=0.7)


def test_balanced_state_from_phasors():
    """The steady state that the generator solves for, found again from its terminals alone."""
    point = GEN.steady_state(FULL, theta_e=0.7)
    y = point.y
    turn = np.exp(2j * np.pi / 3 * np.arange(3))
    v, i = (2 / 3 * sum(y[f"{n}_{k}"] * t for k, t in zip("abc", turn, strict=True)) for n in "vi")
    got = tm.balanced_state(P, v=v, i=i, w_r=W, i_fd=y["i_fd"])
    want = dict(zip(point.ss.x.names, point.x, strict=True))
    for name, value in got.items():
        assert value == pytest.approx(want[name], rel=1e-9, abs=1e-12)


def test_unknown_fault_is_refused():
    """The variants are named."""
    with pytest.raises(ParameterError, match="did you mean 'leaky'"):
        tm.terminal_model(P, "leak")
