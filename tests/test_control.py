"""The PI governor."""

import pytest

from apu_casadi.core.errors import ParameterError
from apu_casadi.unit.control import GovernorParameters, governor

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


def test_the_fuel_limit_limits_fuel_and_says_what_T4_is_there():
    """T4 "below 1400 K" was promised, 1478 K reached: the words name T4 at one point, no bound."""
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.gaspath.steady.steadypoint import Limits
    from apu_casadi.gaspath.steady.trimming import trim_gas_generator

    gg, words = GasGenerator(), next(r for r in P.table() if r[0] == "Wf_max")
    at_limit = {"N": gg.parameters.N, "Wf": P.Wf_max}
    T4 = trim_gas_generator(gg, at_limit, limits=Limits.none())["T4"]
    assert f"T4 there {T4:.0f} K" in words[4]
    assert f"{P.Wf_max / gg.design.values['Wf']:.2f} x design fuel" in words[4]
    for other in ({"dT_isa": 35.0}, {"altitude": 3000.0}, {"theta": {"f_eta_c": 0.95}}):
        assert trim_gas_generator(gg, at_limit, limits=Limits.none(), **other)["T4"] > T4 + 10
    slow = {**at_limit, "N": 0.95 * gg.parameters.N}
    assert trim_gas_generator(gg, slow, limits=Limits.none())["T4"] > T4 + 50
    assert "below" not in words[4] and "not T4" in words[3]
