"""Saturation of the d axis: its curve, its energy, its limit of none, and what refuses it."""

import dataclasses
import math

import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose

from apu_casadi.core import simulation
from apu_casadi.core.errors import NotApplicable, ParameterError
from apu_casadi.machine import wrsg
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import MachineParameters, SaturatedMachine, magnetics
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator
from apu_casadi.machine.terminals import terminal_model
from apu_casadi.machine.wrsg import Windings
from estimators.apu.electrical.electricalfilter import electrical_filter

P, LINEAR = SaturatedMachine(S_10=0.12, S_12=0.5), MachineParameters()
GEN, PLAIN = Generator(machine=P), Generator()
W, X = P.w_rated, math.log(0.5 / 0.12) / math.log(1.2)
KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
UNEVEN = SeriesLoad.from_power(150e3, 0.9, unbalance=(1.3, 1.0, 0.7))


def test_curve_and_its_inverse():
    """S at 1 and 1.2 as given; currents and flux linkages are inverse up to five times rated."""
    for share, S in ((1.0, 0.12), (1.2, 0.5), (-1.2, 0.5)):
        assert wrsg.saturation(P, share * P.lam_rated)[0] == pytest.approx(S, rel=1e-9)
    rng = np.random.default_rng(1)
    for scale in (0.1, 1.0, 5.0):
        lam = Windings(*(P.lam_rated * scale * rng.normal(size=6)))
        i = wrsg.currents(P, lam)
        i_md = i.fd + i.kd - i.sd
        md = lam.sd + P.L_ls * i.sd  # of the path, by the stator's leakage
        S = 0.12 * abs(md / P.lam_rated) ** X
        assert P.L_md * i_md == pytest.approx(md * (1 + S), rel=1e-8)
        assert_allclose(wrsg.flux_linkages(P, i), lam, rtol=1e-9, atol=1e-12)


def test_rates_are_derivatives():
    """Of the currents along a rate, by central differences."""
    rng = np.random.default_rng(2)
    lam, rate = (Windings(*(P.lam_rated * rng.normal(size=6))) for _ in range(2))
    h = 1e-6
    ends = [
        np.array(wrsg.currents(P, Windings(*(np.array(lam) + s * h * np.array(rate)))))
        for s in (1, -1)
    ]
    found = np.array(wrsg.current_rates(P, lam, rate))
    assert_allclose(found, (ends[0] - ends[1]) / (2 * h), rtol=1e-6, atol=1e-4)


def test_open_circuit_characteristic():
    """Field current over voltage at no load, from the formula; steady state and simulation agree.

    The voltmeter's 1e4 ohm shift it by 1e-4.
    """
    for V in (100.0, 230.0, 276.0):
        lam = math.sqrt(2) * V / W
        expected = lam * (1 + 0.12 * (lam / P.lam_rated) ** X) / P.L_md
        point = GEN.steady_state(OpenLoad(), V_t=V)
        assert point.y["i_fd"] == pytest.approx(expected, rel=1e-4)
        again = GEN.steady_state(OpenLoad(), V_fd=point.y["V_fd"])
        assert again.V_t == pytest.approx(V, rel=1e-9)
    end = simulation.stepper(point.ss, 1)(point.x, point.u, [], 0.05).y[:, -1]
    assert end[point.ss.y.index("V_t")] == pytest.approx(276.0, rel=1e-7)


def test_steady_state_under_load():
    """The regulated point against a root of the phasor equations with the saturated reactance."""
    point = GEN.steady_state(SeriesLoad.from_power(200e3, 0.8))
    turn, y = point.turn, point.y
    V, I = turn.phasor("v_a"), turn.phasor("i_a")
    along = V + complex(P.r_s, W * (P.L_mq + P.L_ls)) * I
    assert abs(np.angle(along)) < 1e-9  # the angle is the q axis's
    lam = math.sqrt(2) * abs(V + complex(P.r_s, W * P.L_ls) * I).real / W
    lam_d = math.sqrt(2) * (V + complex(P.r_s, W * P.L_ls) * I).real / W
    i_md = y["i_fd"] + math.sqrt(2) * I.imag

    def miss(psi):
        return psi * (1 + 0.12 * (psi / P.lam_rated) ** X) - P.L_md * i_md

    assert lam_d == pytest.approx(scipy.optimize.brentq(miss, 0, lam * 2), rel=1e-8)
    assert y["i_fd"] > 1.05 * PLAIN.steady_state(SeriesLoad.from_power(200e3, 0.8)).y["i_fd"]


def test_none_is_the_linear_machine():
    """To the last bits where it is off; and as S vanishes, to what is left of it."""
    off = magnetics(P, 0.0, None)
    assert type(off) is MachineParameters
    assert off == LINEAR
    assert Generator(machine=off).state_space(KW225) is not None
    a, b = (
        g.simulate(KW225, 0.02, switches=[(0.005, KW100)]) for g in (Generator(machine=off), PLAIN)
    )
    assert all(np.array_equal(a[n], b[n]) for n in ("v_a", "i_b", "T_e", "E_fd"))
    little = Generator(machine=SaturatedMachine(S_10=1e-9, S_12=1e-8))
    c = little.simulate(KW225, 0.02, switches=[(0.005, KW100)])
    for n in ("v_a", "i_b", "T_e", "E_fd"):
        assert_allclose(c[n], b[n], atol=2e-6 * np.abs(b[n]).max())


def energy(p, i, lam_md):
    """Of the magnetic field, J: leakages, q axis, and the integral of i_md over lambda_md."""
    S = p.S_10 * abs(lam_md / p.lam_rated) ** X
    d = lam_md**2 / (2 * p.L_md) * (1 + 2 * S / (X + 2))
    leak = p.L_ls * (i["sq"] ** 2 + i["sd"] ** 2) + p.L_lfd * i["fd"] ** 2
    leak += p.L_lkd * i["kd"] ** 2 + p.L_lkq * i["kq"] ** 2
    return 1.5 * (d + (leak + p.L_mq * (i["kq"] - i["sq"]) ** 2) / 2)


@pytest.mark.parametrize("solver", ["cvodes", "idas"])
def test_energy_through_a_load_step(solver):
    """What comes in by shaft and field is output, heat and what the field has gained: 1e-6."""
    quad = ("P_e", "T_e", "V_fd", "i_fd^2", "i_kd^2", "i_kq^2", "i_a^2", "i_b^2", "i_c^2", "i_fd")
    point = GEN.steady_state(KW100)
    ss, u = point.ss, GEN.inputs(KW225, V_ref=point.V_ref)
    x = point.x.copy()
    x[ss.x.index("lam_s0")] = 0.0
    x[ss.x.indices(["lam_sq", "lam_sd"])] *= 0.9  # not at rest
    step = simulation.stepper(ss, 1, quad=quad, solver=solver, rtol=1e-10, atol=1e-12)
    held = np.array(x)
    h = 2e-3
    r = step(held, u, [], h)

    def stored(state):
        lam = Windings(*(state[ss.x.index(f"lam_{n}")] for n in Windings._fields))
        i = wrsg.currents(P, lam)._asdict()
        return energy(P, i, lam.sd + P.L_ls * i["sd"])

    m = r.mean
    E_fd = np.array([held[ss.x.index("E_fd")], r.x_end[ss.x.index("E_fd")]])
    assert np.ptp(E_fd) < 0.05  # the field voltage moves slowly: its product with the current ...
    heat = P.r_s * sum(m[f"i_{k}^2"] for k in "abc")
    heat += 1.5 * (P.r_fd * m["i_fd^2"] + P.r_kd * m["i_kd^2"] + P.r_kq * m["i_kq^2"])
    fine = simulation.stepper(ss, 400, solver=solver, rtol=1e-10, atol=1e-12)(held, u, [], h)
    y = {
        n: np.append(start, row)
        for n, start, row in zip(ss.y.names, ss.g(held, u, []).full().ravel(), fine.y, strict=True)
    }
    field = 1.5 * np.trapezoid(y["V_fd"] * y["i_fd"], dx=h / 400)  # ... by 400 samples
    shaft = m["T_e"] * W / P.n_pp * h
    gain = stored(r.x_end) - stored(held)
    assert abs(gain) > 1.0
    assert shaft + field - (m["P_e"] + heat) * h == pytest.approx(gain, abs=2e-6 * 225e3 * h + 1e-4)


def test_faults_and_unbalance():
    """A periodic state closes its power balance, and is what a run comes back to after a turn."""
    point = GEN.steady_state(UNEVEN, Ttsc(0.05, 20.0))
    t = point.turn
    windings = ((P.r_fd, "i_fd"), (P.r_kd, "i_kd"), (P.r_kq, "i_kq"))
    rotor = 1.5 * sum(r * t.rms(i) ** 2 for r, i in windings)
    stator = P.r_s * sum(t.rms(f"i_{k}") ** 2 for k in "abc")
    given = t.mean("T_e") * W / P.n_pp + 1.5 * (t["V_fd"] * t["i_fd"]).mean()
    out = t.mean("P_e") + t.mean("P_loss_fault") + rotor + stator
    assert given == pytest.approx(out, abs=1e-8 * P.P_rated)
    end = simulation.stepper(point.ss, 1, rtol=1e-10, atol=1e-12)(
        point.x, point.u, point.theta, 2 * math.pi / W
    ).x_end
    off = (end - point.x) / point.ss.x.nominals
    off[point.ss.x.index("theta_e")] = 0.0
    assert np.abs(off).max() < 1e-7


def test_what_needs_the_linear_machine_says_so():
    ss, u = GEN.variant(KW100), GEN.inputs(KW100)
    for fast in (
        lambda: Propagator(GEN, ss, u, np.zeros(0), n_out=100, dt=0.02),
        lambda: MeanStep(GEN, ss, u, np.zeros(0), dt=0.02, quad=("P_e",)),
    ):
        with pytest.raises(NotApplicable, match="its machine saturates"):
            fast()
    with pytest.raises(ParameterError, match=r"terminal model needs the linear.*machine.S_10 = 0"):
        terminal_model(P)
    with pytest.raises(ParameterError, match=r"electrical filter needs the linear machine"):
        electrical_filter(P)


def test_values_are_checked():
    for wrong, words in (({"S_12": 0.1}, "must be > 1.2 S_10"), ({"S_10": -1.0}, "outside")):
        with pytest.raises(ParameterError, match=words):
            SaturatedMachine(**wrong)
    assert magnetics(LINEAR, None, None) is LINEAR
    assert magnetics(LINEAR, 0.2, 0.6) == SaturatedMachine(S_10=0.2, S_12=0.6)
    assert magnetics(P, None, 0.7) == dataclasses.replace(P, S_12=0.7)
    assert magnetics(P, 0.3, None) == dataclasses.replace(P, S_10=0.3)
