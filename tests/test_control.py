"""The PI governor."""

import pytest

from apu_casadi.control import GovernorParameters, governor
from apu_casadi.errors import ParameterError

P = GovernorParameters()


def law(N, Wf_I):
    out = governor(N=N, N_ref=100.0, Wf_I=Wf_I, par=P)
    return float(out.Wf), float(out.Wf_I_dot)


def test_proportional_and_integral_action():
    """Inside the limits: Wf = Kp e + Wf_I and dWf_I/dt = Ki e, with e relative."""
    assert law(99.0, 0.03) == pytest.approx((0.03 + P.Kp * 0.01, P.Ki * 0.01))


def test_limits_hold_and_the_integrator_tracks_them():
    """Beyond a limit the integrator is driven back: demand decays to the limit, no windup."""
    Wf, rate = law(80.0, 0.05)
    assert Wf == P.Wf_max
    assert rate < P.Ki * 0.2
    Wf_I = 0.05
    for _ in range(20000):
        Wf_I += 1e-3 * law(80.0, Wf_I)[1]
    # steady: Ki e = (demand - Wf_max)/T_aw
    demand = P.Kp * 0.2 + Wf_I
    assert demand - P.Wf_max == pytest.approx(P.Ki * 0.2 * P.T_aw, rel=1e-6)
    assert law(120.0, 0.02)[0] == P.Wf_min


def test_limits_in_wrong_order_are_refused():
    """Both numbers are in the message."""
    with pytest.raises(ParameterError, match=r"0\.07 .* 0\.06"):
        GovernorParameters(Wf_min=0.07)
