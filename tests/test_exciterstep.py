"""The exciter between samples: its steps without exponentials against those with them."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.machine.exciterstep import Exciter, exciter_step
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.transition import split

POINT = Generator().steady_state(SeriesLoad.from_power(100e3))
SS, THETA = POINT.ss.shared, POINT.ss.full(np.array(POINT.theta))


def both(V, H, moved=0.0):
    """A step by the series and by the exponentials, and whether the first is to be believed.

    Args:
        V: terminal voltage at start, middle and end, of the rated one.
        moved: what the regulator is off its state at rest by, per unit.
    """
    x = np.array(POINT.x)
    x[SS.x.index("V_R")] += moved
    slow, V, held = x[split(SS).slow], 230.0 * np.array(V), (POINT.V_ref, THETA)
    exciter = Exciter(SS)
    assert exciter.exps == 1
    k1, _, e = exciter.started(slow, V[0], *held)
    end, _, far = exciter.step((ca.DM(slow), k1, e), (V[1], V[2]), held, H)
    whole = exciter_step(SS)[1](slow, V, *held, H)
    return np.array(end).ravel(), np.array(whole).ravel(), float(far)


@pytest.mark.parametrize("H", [1e-4, 6e-4])
def test_steps_by_a_series_are_those_by_exponentials(H):
    """To rounding, where the voltage falls by 3 % within the step."""
    ours, theirs, far = both((1.0, 0.98, 0.97), H)
    assert_allclose(ours, theirs, rtol=1e-13)
    assert far == 0.0


def test_what_has_moved_too_far_is_told():
    """A field that moves by more than the series holds for: no error is allowed to be so large."""
    assert both((1.0, 1.0, 1.0), 5e-3, moved=7.0)[2] == 1.0


def test_other_exponentials_stay():
    """One of a square of a state, or of the terminal voltage: none is handed on, none is lost."""
    x, V = ca.SX.sym("x", len(SS.x)), ca.SX.sym("V")
    V_ref, th = ca.SX.sym("V_ref"), ca.SX.sym("th", len(SS.theta))
    rates = SS.exciter(x, V, V_ref, th) + ca.exp(-(x[SS.x.index("E_fd")] ** 2)) + ca.exp(-V / 230)
    odd = dataclasses.replace(SS, exciter=ca.Function("odd", [x, V, V_ref, th], [rates]))
    made, slow = Exciter(odd), np.array(POINT.x)[split(SS).slow]
    assert made.exps == 0
    ours, _ = made.at((slow, 230.0, POINT.V_ref, THETA), ca.DM(0, 1))
    theirs = odd.exciter(POINT.x, 230.0, POINT.V_ref, THETA)
    assert_allclose(np.array(ours), np.array(theirs), rtol=1e-14)
