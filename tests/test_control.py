"""The PI governor, and another one in its place."""

import numpy as np
import pytest

from apu_casadi import Apu, LoadChange, SeriesLoad, simulate_joint
from apu_casadi.core.errors import ParameterError
from apu_casadi.unit.control import GovernorParameters, governor
from apu_casadi.unit.linearisation import linearise_joint
from estimators.apu.gaspath import gas_path_filter

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


# --------------------------------------------------------------------------- another governor


KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
STEP = {"duration": 1.0, "load": KW225, "events": [LoadChange(0.1, KW100)], "waveform_dt": None}


def speed(governor, **options):
    return simulate_joint(Apu(governor=governor), **{**STEP, **options})["N"].values


@pytest.mark.parametrize(
    "options",
    [{"solver": "auto"}, {"solver": "cvodes"}, {"solver": "cvodes", "exchange": "predicted"}],
)
def test_another_governor_without_its_derivative_is_the_shipped_one(options, mine):
    """In blocks and single steps; the arithmetic differs by what is added as zero."""
    other = mine["MyGovernor"](Kd=0.0)
    assert speed(other, **options) == pytest.approx(speed(P, **options), rel=1e-12)


def test_derivative_action_damps_and_all_integrators_agree(mine):
    """The overspeed of a load drop falls; auto and CVODES see the same, 1e-7 of the speed."""
    auto, cvodes = (speed(mine["MyGovernor"](), solver=s) for s in ("auto", "cvodes"))
    assert auto == pytest.approx(cvodes, rel=1e-7)
    assert auto.max() < speed(P).max() - 1.0


def test_another_governor_in_linear_models(mine):
    """Its state is one of the unit's; eigenvalues decay; the run's return fits the slowest ones."""
    apu = Apu(governor=mine["MyGovernor"]())
    model = linearise_joint(apu, apu.steady_state(KW100))
    assert "e_slow" in model.x and model.derivative("e_slow_dot", "e_slow") == pytest.approx(-20.0)
    p = apu.governor
    gain = -(p.Kp + p.Kd / p.T_d) / apu.N_ref
    by_fuel = model.derivative("N_dot", "Wf_I")
    plain = linearise_joint(Apu(), Apu().steady_state(KW100))
    free = plain.derivative("N_dot", "N") + by_fuel * P.Kp / apu.N_ref
    assert model.derivative("N_dot", "N") == pytest.approx(free + by_fuel * gain, rel=1e-9)
    assert all(e.value.real < 0 for e in model.eigenvalues())


def test_the_slope_of_the_fuel_is_that_of_the_law(mine):
    """For filters: against a central difference along the states' own rates; exact, rounding."""
    for law, x in ((P, (0.04,)), (mine["MyGovernor"](), (0.03, 1e-3))):
        N, N_dot, N_ref, h = 3770.0, 12.0, 3775.0, 1e-5
        rates = law.law(N, N_ref, x).rates
        fuel = [
            law.law(N + s * N_dot, N_ref, [a + s * b for a, b in zip(x, rates, strict=True)]).Wf
            for s in (-h, h)
        ]
        slope = float(law.slope(N, N_dot, N_ref, x))
        assert slope == pytest.approx((fuel[1] - fuel[0]) / (2 * h), rel=1e-7)


def test_a_filter_follows_another_law(mine):
    """Along a load drop the speed errs less with the governor's own law than with a held fuel."""
    apu = Apu(governor=mine["MyGovernor"](Kd=0.002))
    ds, worst = simulate_joint(apu, **STEP), []
    for law in (apu.governor, None):
        own = gas_path_filter(apu.gas_generator, gains=False, inertia=None, governed=law)
        N, _ = own.run(own.recording(ds, seed=1))["N"]
        worst.append(np.abs(N - ds["N"].values).max())
    assert worst[0] < 0.75 * worst[1]
