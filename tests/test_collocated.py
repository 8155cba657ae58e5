"""Steps of any length, also right after a switch, against CVODES with tight tolerances."""

import dataclasses
import math

import numpy as np
import pytest

from apu_casadi import (
    Apu,
    FaultChange,
    HealthChange,
    LoadChange,
    SeriesLoad,
    Ttsc,
    simulate_joint,
)
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.means import Term
from apu_casadi.core.simulation import Stepper, stepper
from apu_casadi.machine.collocated import DOUBLED, Collocated, shares
from apu_casadi.machine.loads.capacitor import CapacitorLoad
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.unit.stepmeans import StepMeans

P = SeriesLoad.from_power
DT = 0.02
MILD = Ttsc(mu=0.05, k_rf=20.0, phase="b")


@pytest.fixture(scope="module")
def apu():
    return Apu()


def switched(apu, before, load, fault):
    """State, inputs and model of a generator at an instant at which load and fault change."""
    gen, w_r = apu.generator, apu.link_of((1, 2)).w_r(apu.N_ref)
    point = apu.steady_state(before).of(1)
    ss, theta = gen.variant(load, fault), gen.fault_vector(load, fault)
    u = gen.inputs(load, w_r=w_r, V_ref=point.V_ref)
    own = {"u": point.u, "theta": point.theta, "u_target": u, "theta_target": theta}
    return ss, gen.transfer(np.asarray(point.x), point.ss, ss, **own), u, theta


def step_of(apu, ss, theta, h, fault):
    gen = apu.generator
    quad = StepMeans(gen, False).quad(short=False, symmetric=fault is None)
    how = {"longest": (DT, gen.machine.w_rated), "quad": quad, "symmetric": fault is None}
    return Collocated(ss, theta, h, **how)


@pytest.mark.parametrize(
    ("before", "load", "fault", "h"),
    [
        (P(225e3), P(100e3), None, DT),
        (P(100e3), P(120e3, 0.8), None, 0.0137),
        (P(225e3), P(10e3), None, DT),
        (P(100e3), P(100e3), MILD, DT),
        (P(100e3), P(100e3), dataclasses.replace(MILD, kappa=0.4), 0.0017),
        (P(10e3), P(10e3), Ttsc(0.05, 49.05, 1.0), DT),
        (P(10e3), CapacitorLoad.from_power(10e3, 0.9), Ttsc(0.05, 49.05, 1.0), DT),
        (P(40e3, 0.85), P(40e3, 0.85), Ttsc(0.05, 4.05), 0.007),
    ],
)
def test_against_cvodes(apu, before, load, fault, h):
    """States to 2e-6, means to 1e-6 of their size, though the voltage jumps at the start.

    Digits that elimination loses beside a stiff loop made means err by 4e-6.
    """
    ss, x, u, theta = switched(apu, before, load, fault)
    one = step_of(apu, ss, theta, h, fault)
    made, means = one(x, u)
    right = stepper(ss, quad=one.quad, rtol=1e-10, atol=1e-12)(x, u, theta, h)
    assert np.abs((made - right.x_end) / ss.x.nominals).max() < 2e-6
    sizes = [Term.of(q)._replace(trig="", k=0, weighted=False).nominal(ss) for q in one.quad]
    off = (means.ravel() - np.array([right.mean[q] for q in one.quad])) / sizes
    assert np.abs(off).max() < 1e-6


def test_strides_fill_the_step():
    """Each of the first ones is as long as all before it; the rest are equal."""
    starts, lengths = shares(34)
    assert starts[0] == 0.0
    np.testing.assert_allclose(np.cumsum(lengths)[:-1], starts[1:], rtol=1e-12)
    np.testing.assert_allclose(lengths.sum(), 1.0, rtol=1e-12)
    np.testing.assert_allclose(lengths[1 : DOUBLED + 1], starts[1 : DOUBLED + 1], rtol=1e-12)
    np.testing.assert_allclose(lengths[DOUBLED + 1 :], 1 / 34, rtol=1e-9)


def test_what_it_cannot_do_is_refused_with_the_reason(apu):
    """A load that is not linear, a step without end, and a severe fault, whose ripple is coarse."""
    gen, load = apu.generator, ConstantPowerLoad(P=100e3)
    ss, theta = gen.variant(load, None), gen.fault_vector(load, None)
    with pytest.raises(NotApplicable, match="linear"):
        step_of(apu, ss, theta, DT, None)
    ss, x, u, theta = switched(apu, P(10e3), P(10e3), Ttsc(mu=0.1, k_rf=0.5))
    with pytest.raises(NotApplicable, match="strides"):
        Collocated(ss, theta, DT, longest=(10.0, 2500.0), quad=(), symmetric=True)
    with pytest.raises(NotApplicable, match="errors of E_fd and of the stages"):
        step_of(apu, ss, theta, DT, MILD)(x, u)


def test_a_run_takes_no_step_by_cvodes(apu, monkeypatch):
    """Load, health and fault change on and off the grid; the result is that of CVODES."""
    events = [
        LoadChange(t=0.02, load=P(100e3)),
        HealthChange(t=0.033, factors={"f_eta_c": 0.99}),
        FaultChange(t=0.0737, fault=MILD),
    ]
    how = {"duration": 0.11, "load": P(225e3), "events": events, "waveform_dt": None}
    right = simulate_joint(apu, **how, solver="cvodes", rtol=1e-9, atol=1e-11)

    def refuse(*_args, **_how):
        raise AssertionError("CVODES was asked")

    monkeypatch.setattr(Stepper, "__call__", refuse)
    made = simulate_joint(apu, **how)
    for name in ("N", "T4", "P_total", "P_e", "P_loss_fault", "V_a_rms", "V_b_rms", "I_c_rms"):
        peak = np.abs(right[name].values).max()
        assert np.abs(made[name].values - right[name].values).max() < 1e-6 * peak, name
    assert math.isfinite(made.attrs["exchange_error"])
