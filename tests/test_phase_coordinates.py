"""The faulty machine against coupled windings in phase coordinates, without Park's transform.

Both sides run at constant field voltage: with an exciter time constant of 1e9 s the package's
E_fd moves by less than 1e-10 per unit over the run.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from phase_coordinates import coupled_windings, krause_inductance, split_phase

from apu_casadi.core import simulation
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters

FROZEN = ExciterParameters(T_E=1e9)
GENERATORS = {n: Generator(exciter=FROZEN, neutral=n) for n in ("grounded", "isolated")}
P = MachineParameters()
KW225 = SeriesLoad.from_power(225e3)
UNBALANCED = SeriesLoad.from_power(180e3, unbalance=(1.3, 1.0, 0.7))
R_L = SeriesLoad.from_power(180e3, 0.8)
UNBALANCED_R_L = SeriesLoad.from_power(150e3, 0.85, unbalance=(1.0, 1.4, 0.8))
T_END, N_OUT = 5e-3, 50  # two periods


def compare(neutral, load, fault, theta_e=0.4):
    """Return the largest difference of each quantity over its peak, by name."""
    gen = GENERATORS[neutral]
    point = gen.steady_state(KW225, theta_e=theta_e)
    ss = gen.variant(load, fault)
    u = gen.inputs(load, V_ref=point.V_ref)
    x = gen.transfer(point.x, point.ss, ss, u=point.u, theta=[], u_target=u)
    run = simulation.stepper(ss, N_OUT, rtol=1e-11, atol=1e-13)
    y = ss.y.unpack(run(x, u, gen.fault_vector(load, fault), T_END).y)
    other = coupled_windings(
        point.y, point.y["V_fd"], theta_e, load, fault, T_END, N_OUT, isolated=neutral == "isolated"
    )
    pairs = {f"i_{k}": (y[f"i_{k}"], i) for k, i in zip("abc", other.i, strict=True)}
    pairs |= {n: (y[n], i) for n, i in zip(("i_fd", "i_kd", "i_kq"), other.rotor, strict=True)}
    pairs |= {"i_fault": (y["i_fault"], other.i_fault), "T_e": (y["T_e"], other.T_e)}
    if other.v is not None:
        pairs |= {f"v_{k}": (y[f"v_{k}"], v) for k, v in zip("abc", other.v, strict=True)}
    return {n: np.abs(a - b).max() / np.abs(b).max() for n, (a, b) in pairs.items()}


@pytest.mark.parametrize("neutral", ["grounded", "isolated"])
@pytest.mark.parametrize(
    "load", [KW225, UNBALANCED, R_L, UNBALANCED_R_L],
    ids=["R", "R unbalanced", "R-L", "R-L unbalanced"],
)  # fmt: skip
@pytest.mark.parametrize(
    "fault",
    [
        Ttsc(0.05, 1.0, phase="a"),
        Ttsc(0.05, 1.0, phase="b"),
        Ttsc(0.1, 0.5, 0.3, phase="c"),
        Ttsc(0.05, 1.0, 1.0, phase="a"),
        Ttsc(0.02, 3.0, 0.5, phase="b"),
        Ttsc(0.2, 0.0, 1.0, phase="c"),
    ],
    ids=lambda f: f"{f.phase} {f.mu:g} {f.k_rf:g} {f.kappa:g}",
)
def test_package_equals_coupled_windings(neutral, load, fault):
    """Currents, torque and voltages from the instant of the fault, <= 1e-6 of peak (goal)."""
    errors = compare(neutral, load, fault)
    assert max(errors.values()) < 1e-6, errors


def test_the_comparison_can_tell():
    """A wrong leakage partition shows: kappa = 0.9 for 1 changes i_fault by more than 1e-3."""
    right, wrong = Ttsc(0.05, 1.0, 1.0), Ttsc(0.05, 1.0, 0.9)
    gen = GENERATORS["grounded"]
    point = gen.steady_state(KW225)
    a, b = (
        coupled_windings(point.y, point.y["V_fd"], 0.0, KW225, f, T_END, N_OUT).i_fault
        for f in (right, wrong)
    )
    assert np.abs(a - b).max() > 1e-3 * np.abs(a).max()


@pytest.mark.parametrize("kappa", [0.05, 0.3, 1.0])
def test_cut_phase_in_series_is_the_whole_phase(kappa):
    """Both parts under one current are Krause's phase, to rounding; energy is positive."""
    fault = Ttsc(0.05, 1.0, kappa, phase="b")
    for theta in (0.0, 0.7, 2.9):
        L = split_phase(theta, fault)
        series = np.zeros((7, 6))
        series[:3, :3], series[4:, 3:] = np.eye(3), np.eye(3)
        series[3, 1] = 1.0
        assert_allclose(series.T @ L @ series, krause_inductance(theta), atol=1e-18)
        symmetric = np.diag([1, 1, 1, 1, 1.5, 1.5, 1.5]) @ L
        assert_allclose(symmetric, symmetric.T, atol=1e-18)
        assert np.linalg.eigvalsh(symmetric).min() > -1e-18


def test_integrator_is_of_fifth_order():
    """Halving the step of the Radau method divides its error by about 32."""
    gen = GENERATORS["grounded"]
    point = gen.steady_state(KW225)
    fault = Ttsc(0.05, 1.0, 1.0)
    i = [
        coupled_windings(point.y, point.y["V_fd"], 0.0, KW225, fault, 2e-3, 4, steps=s).i_fault
        for s in (4, 8, 64)
    ]
    order = np.log2(np.abs(i[0] - i[2]).max() / np.abs(i[1] - i[2]).max())
    assert 4.5 < order < 5.5
