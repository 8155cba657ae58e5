"""Steady states with a fault or an unbalanced load, against long runs and a power balance."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core import simulation
from apu_casadi.core.errors import OperatingPointError, ParameterError
from apu_casadi.machine.faults.fieldshort import FieldShort
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.capacitor import CapacitorLoad
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import ExciterParameters

GEN = Generator()
HELD = Generator(excitation="constant")
P = GEN.machine
W = P.w_rated
KW100 = SeriesLoad.from_power(100e3)
UNEVEN = SeriesLoad.from_power(100e3, 0.9, unbalance=(1.3, 1.0, 0.7))
ONE_OPEN = SeriesLoad(R=(1e4, 1.5, 1.5))
#: Its reactance lies between those of the d and the q axis.
SELF_EXCITED = CapacitorLoad(R=(0.01,) * 3, C=(1 / (W * 0.53),) * 3)
CASES = {
    "short circuit": (GEN, KW100, Ttsc(0.05, 20.0), 1.0),
    "with leakage": (GEN, KW100, Ttsc(0.05, 1.0, 1.0, phase="b"), 0.97),
    "unbalanced": (GEN, UNEVEN, None, 1.03),
    "capacitive": (GEN, CapacitorLoad.from_power(60e3, 0.9, unbalance=(1.2, 1, 1)), None, 1.0),
    "open phase": (GEN, ONE_OPEN, None, 1.0),
    "constant power": (GEN, ConstantPowerLoad(100e3), Ttsc(0.05, 20.0, phase="c"), 1.0),
    "isolated": (Generator(neutral="isolated"), UNEVEN, Ttsc(0.02, 5.0), 1.0),
    "limits met": (GEN, SeriesLoad.from_power(225e3), Ttsc(0.3, 0.5), 1.0),
    "held field": (HELD, UNEVEN, Ttsc(0.05, 20.0), 1.0),
}


#: Two seconds at tight tolerances take CVODES seconds each; three kinds are enough for every day.
DAILY = ("with leakage", "unbalanced", "constant power")
LONG = [n if n in DAILY else pytest.param(n, marks=pytest.mark.slow) for n in CASES]


@pytest.mark.long
@pytest.mark.parametrize("name", LONG)
def test_the_last_turn_of_a_long_run(name):
    """CVODES from the balanced, healthy state, after a whole number of turns.

    All voltages, currents and the field to 1e-6 of their peaks; tolerances of 1e-10, but for the
    open phase, which CVODES takes with 1e-8 only.
    """
    rtol = 1e-8 if "open" in name else 1e-10
    gen, load, fault, share = CASES[name]
    point = gen.steady_state(load, fault, w_r=share * W, theta_e=0.4)
    V = {"V_t": point.V_t} if gen is HELD else {}
    start = gen.steady_state(load.balanced_part, w_r=share * W, theta_e=0.4, **V)
    u, theta = gen.inputs(load, w_r=share * W, V_ref=point.V_ref), gen.fault_vector(load, fault)
    x = gen.transfer(
        start.x, start.ss, point.ss, u=start.u, theta=[], u_target=u, theta_target=theta
    )
    if gen is HELD:
        x[point.ss.x.index("E_fd")] = point.y["E_fd"]
    turn = 2 * math.pi / (share * W)
    long = simulation.stepper(point.ss, 1, rtol=rtol, atol=rtol / 100)
    for _ in range(3 if "limits" in name else 1):
        x = long(x, u, theta, 800 * turn).x_end
    n = point.turn.angle.size
    last = simulation.stepper(point.ss, n, rtol=1e-12, atol=1e-14)(x, u, theta, turn)
    for k in ("v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "i_fd", "i_kq", "T_e", "E_fd", "i_fault"):
        found = np.roll(point.turn[k], -1)
        there = last.y[point.ss.y.index(k)]
        peak = np.abs(point.turn["v_b" if k[0] == "v" else "i_b" if k[:2] == "i_" else k]).max()
        assert_allclose(found, there, atol=1e-6 * peak)


def test_what_is_balanced_but_for_rounding_is_the_balanced_state():
    """By collocation against the closed form, 1e-9; speed, voltage and angle off the design."""
    near = SeriesLoad(R=(KW100.R[0], KW100.R[0], KW100.R[0] * (1 + 3e-12)))
    for how in ({}, {"w_r": 0.95 * W, "V_t": 215.0, "theta_e": 1.0}, {"V_fd": 60.0}):
        a, b = GEN.steady_state(KW100, **how), GEN.steady_state(near, **how)
        assert a.balanced and not b.balanced
        assert_allclose(b.x, a.x, atol=1e-9 * np.abs(a.x).max())
        assert b.V_t == pytest.approx(a.V_t, rel=1e-9)
        assert b.V_ref == pytest.approx(a.V_ref, rel=1e-9)
        for n in ("P_e", "T_e", "i_fd", "P_total"):
            assert b.mean(n) == pytest.approx(a.mean(n), rel=1e-9)
        for n in ("v_a", "i_b"):
            assert b.turn.phasor(n) == pytest.approx(a.turn.phasor(n), rel=1e-8)
            assert b.turn.rms(n) == pytest.approx(a.turn.rms(n), rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_power_balance_of_a_turn(name):
    """Shaft and field power are output and losses, the fault's included; 1e-8 of the rating."""
    gen, load, fault, share = CASES[name]
    point = gen.steady_state(load, fault, w_r=share * W)
    t = point.turn
    shaft = t.mean("T_e") * share * W / P.n_pp
    field = 1.5 * (t["V_fd"] * t["i_fd"]).mean()
    windings = ((P.r_fd, "i_fd"), (P.r_kd, "i_kd"), (P.r_kq, "i_kq"))
    rotor = 1.5 * sum(r * t.rms(i) ** 2 for r, i in windings)
    stator = P.r_s * sum(t.rms(f"i_{k}") ** 2 for k in "abc")
    out = t.mean("P_e") + t.mean("P_loss_fault")
    assert shaft + field == pytest.approx(out + rotor + stator, abs=1e-8 * P.P_rated)
    assert abs(t.mean("P_e")) > 1e3


def test_regulator_sees_the_ripple():
    """The mean error of the voltage is what the mean field asks for; the field ripples."""
    point = GEN.steady_state(KW100, Ttsc(0.05, 2.0))
    V_c, V_R = point.turn["V_c"], point.turn["V_R"]
    assert np.ptp(V_R) > 1e-3
    assert V_c.mean() == pytest.approx(point.V_t / P.V_rated_rms, rel=1e-10)
    assert V_R.mean() / GEN.exciter.K_A == pytest.approx(point.V_ref - V_c.mean(), rel=1e-7)


def test_half_a_turn_reverses_the_phases():
    point = GEN.steady_state(UNEVEN, Ttsc(0.05, 1.0, 1.0))
    for name, sign in (("v_a", -1), ("i_fault", -1), ("i_fd", 1), ("T_e", 1)):
        half = np.roll(point.turn[name], point.turn.angle.size // 2)
        assert_allclose(half, sign * point.turn[name], atol=1e-9 * np.abs(half).max())


def test_runs_go_on_from_there():
    """Nothing settles: every turn of a run is the first one; and a field short keeps its field."""
    turn = 2 * math.pi / W
    how = {"dt_out": turn / 64, "rtol": 1e-10, "atol": 1e-12}
    for fault in (Ttsc(0.05, 20.0), FieldShort(0.1)):
        run = GEN.simulate(UNEVEN, 8 * turn, fault=fault, theta_e=0.2, **how)
        for n in ("v_a", "i_c", "i_fd"):
            waves = run[n].values
            assert_allclose(waves[-65:], waves[:65], atol=1e-7 * np.abs(waves).max())
    cleared = GEN.simulate(KW100, 0.004, fault=Ttsc(0.05, 20.0), switches=[(0.002, None)])
    assert np.abs(cleared["i_fault"].values[cleared["time"] < 0.002]).max() > 10
    assert not cleared["i_fault"].values[-10:].any()


@pytest.mark.parametrize("fault", [None, Ttsc(0.05, 20.0)], ids=["healthy", "fault"])
def test_start_at_a_terminal_or_field_voltage(fault):
    """What is asked for comes out, and one determines the others."""
    a = GEN.steady_state(KW100, fault, V_t=220.0)
    assert a.V_t == pytest.approx(220.0, rel=1e-12)
    assert a.turn.mean("V_t") == pytest.approx(220.0, rel=1e-9)
    b = GEN.steady_state(KW100, fault, V_fd=a.mean("V_fd"))
    assert b.V_t == pytest.approx(220.0, rel=1e-8)
    assert b.V_ref == pytest.approx(a.V_ref, rel=1e-8)
    assert b.mean("V_fd") == pytest.approx(a.mean("V_fd"), rel=1e-10)
    c = GEN.steady_state(KW100, fault, V_ref=a.V_ref, theta_e=1.0)
    assert c.mean("P_e") == pytest.approx(a.mean("P_e"), rel=1e-8)
    assert c.x[c.ss.x.index("theta_e")] == 1.0


def test_constant_excitation_is_an_exciter_that_never_moves():
    """Against T_E = 1e12 through a load drop and a fault, 1e-6 of peak; its field stays."""
    never = Generator(exciter=ExciterParameters(T_E=1e12))
    switches = [(0.01, SeriesLoad.from_power(50e3)), (0.02, Ttsc(0.05, 20.0))]
    how = {"switches": switches, "V_t": 230.0, "rtol": 1e-10, "atol": 1e-12}
    a, b = (g.simulate(KW100, 0.04, **how) for g in (HELD, never))
    assert np.ptp(a["E_fd"].values) == 0.0
    for n in ("v_a", "i_b", "T_e"):
        assert_allclose(a[n], b[n], atol=1e-6 * np.abs(b[n]).max())
    assert np.abs(a["V_t"].values[-1] - 230.0) > 3.0  # nobody regulates


def test_leading_load_excites_at_a_given_field():
    """The highest voltage of a field under a leading load lies above that without a load."""
    lead = CapacitorLoad.from_power(20e3, 0.3)
    point = GEN.steady_state(lead, V_fd=30.0)
    assert point.y["V_fd"] == pytest.approx(30.0, rel=1e-9)
    assert point.V_t > 30.0 / P.r_fd * W * P.L_md / math.sqrt(2)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"V_t": 230.0, "V_fd": 40.0}, "V_t or V_fd, not both"),
        ({"V_fd": -3.0}, "field voltage must be > 0"),
        ({"V_fd": float("nan")}, "field voltage must be > 0"),
        ({"V_fd": "x"}, "V_fd"),
        ({"theta_e": "x"}, "theta_e"),
        ({"load": ConstantPowerLoad(200e3), "V_fd": 20.0}, "does not carry"),
        ({"load": SELF_EXCITED, "V_fd": 20.0}, "excites the generator by itself"),
        ({"load": SELF_EXCITED}, "excites the generator by itself"),
    ],
)
def test_refusals(how, words):
    with pytest.raises(OperatingPointError, match=words):
        GEN.steady_state(**{"load": KW100, **how})


def test_unknown_excitation_is_refused():
    with pytest.raises(ParameterError, match=r"excitation 'constan'.*'constant'"):
        Generator(excitation="constan")


def test_at_the_ceiling_the_point_says_so():
    point = GEN.steady_state(SeriesLoad(R=(0.02, 0.02, 0.03)))
    assert "limit" in point.note
    assert point.V_t < 150.0
    assert GEN.steady_state(UNEVEN).note == ""
