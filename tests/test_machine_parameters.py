"""Parameters of machine and exciter as inputs: exact derivatives, shared code, flat memory."""

import gc
import math
import weakref

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core import simulation
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine.faults.fieldshort import FieldShort
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.capacitor import CapacitorLoad
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator

LAGGED = ExciterParameters(T_F2=0.02, T_F3=0.01)
KW100, LAGGING = SeriesLoad.from_power(100e3), SeriesLoad.from_power(100e3, 0.85)


def somewhere(ss: StateSpace, load, gen) -> tuple[np.ndarray, np.ndarray]:
    """A state away from any rest and any limit, and inputs."""
    rng = np.random.default_rng(11)
    x = ss.x.nominals * rng.uniform(0.3, 0.9, len(ss.x))
    u = gen.inputs(load, V_ref=1.0)
    x[ss.x.index("V_R")] = 2.0
    return x, u


@pytest.mark.long
@pytest.mark.parametrize(
    ("gen", "load", "fault"),
    [
        (Generator(exciter=LAGGED), KW100, None),
        (Generator(), LAGGING, Ttsc(0.05, 1.0, 1.0)),
        (Generator(neutral="isolated"), ConstantPowerLoad(9e4), Ttsc(0.05, 2.0, phase="c")),
        (Generator(), CapacitorLoad.from_power(1e5, 0.9), FieldShort(0.2)),
        (Generator(), KW100, Ttsc(0.05, 20.0)),
    ],
    ids=["second lag", "leaky", "isolated", "field", "coupled"],
)
def test_derivatives_by_every_parameter_are_exact(gen, load, fault):
    """f and g of the family by all parameters, against central differences over units built so.

    The step is 1e-5 relative; 1e-6 of the largest derivative of each parameter.
    """
    ss, theta = gen.variant(load, fault), gen.fault_vector(load, fault)
    x, u = somewhere(ss, load, gen)
    whole = ss.family
    full = np.append(theta, ss.numbers)
    th = ca.SX.sym("th", full.size)
    for label, fun, one in (("f", whole.f, lambda s: s.f), ("g", whole.g, lambda s: s.g)):
        J = ca.Function("J", [th], [ca.jacobian(fun(x, u, th), th)])(full).full()
        assert_allclose(fun(x, u, full), one(ss)(x, u, theta), rtol=1e-13, atol=1e-13)
        for k, name in enumerate(whole.theta.names[theta.size :], theta.size):
            prefix, field = name.split(".")
            values = []
            h = 1e-5 * (abs(full[k]) or 1.0)
            for sign in (1, -1):
                p, e = gen.machine, gen.exciter
                if prefix == "machine":
                    p = p.symbolic(**{field: full[k] + sign * h})
                else:
                    e = e.symbolic(**{field: full[k] + sign * h})
                unit = Generator.__new__(Generator)
                unit.__dict__.update(machine=p, exciter=e, neutral=gen.neutral)
                values.append(one(unit.variant(load, fault))(x, u, theta).full().ravel())
            difference = (values[0] - values[1]) / (2 * h)
            # where nothing depends on the parameter, the difference is rounding
            size = max(np.abs(J[:, k]).max(), 1e-10 * np.abs(values[0]).max() / h)
            where = f"{label} by {name}"
            assert_allclose(J[:, k], difference, atol=1e-6 * size, rtol=0, err_msg=where)


def test_every_parameter_counts_somewhere():
    """None of the family's parameters is without effect on f or g, but the named ones."""
    ss = Generator(exciter=LAGGED).variant(KW100)
    th = ca.SX.sym("th", len(ss.family.theta))
    x, u = (ca.SX.sym(n, len(s)) for n, s in (("x", ss.x), ("u", ss.u)))
    both = ca.vertcat(ss.family.f(x, u, th), ss.family.g(x, u, th))
    idle = [
        n
        for n, used in zip(ss.family.theta.names, ca.which_depends(both, th, 1, False), strict=True)
        if not used
    ]
    assert idle == ["machine.P_rated"]


@pytest.mark.long
@pytest.mark.parametrize("fault", [None, Ttsc(0.05, 20.0)], ids=["healthy", "fault"])
def test_another_unit_builds_and_compiles_nothing(fault):
    """Functions of the steps and of the integrators are the very same; results are its own."""
    units = [Generator(), Generator(MachineParameters(r_s=0.006), ExciterParameters(K_A=240.0))]
    made, ends = [], []
    for gen in units:
        ss, theta = gen.variant(KW100, fault), gen.fault_vector(KW100, fault)
        point = gen.steady_state(KW100)
        u = gen.inputs(KW100, V_ref=point.V_ref)
        x = gen.transfer(point.x, point.ss, ss, u=point.u, theta=[], u_target=u)
        run = simulation.stepper(ss, 1, rtol=1e-10, atol=1e-12)
        x = run(x, u, theta, 0.1).x_end
        mean = MeanStep(gen, ss, u, theta, dt=0.02, quad=("P_e",))
        waves = Propagator(gen, ss, u, theta, n_out=400, dt=0.02, quad=("P_e",))
        exact = run(x, u, theta, 0.02).x_end
        if fault is None:
            assert_allclose(mean(x, u)[0], exact, rtol=2e-5, atol=2e-5)
        made.append((mean.advance, waves.function, run._F, run._g))
        ends.append(exact)
    for first, second in zip(*made, strict=True):
        assert first is second
    assert np.abs(ends[1] - ends[0]).max() > 1e-3


def test_a_second_exciter_without_saturation_is_a_structure_of_its_own():
    """S_E = 0 and no second lag: those parameters are no inputs, and the model holds."""
    plain = Generator(exciter=ExciterParameters(S_E1=0.0, S_E2=0.0))
    names = plain.variant(KW100).family.theta.names
    assert "exciter.S_E1" not in names and "exciter.T_F2" not in names
    assert "exciter.S_E1" in Generator().variant(KW100).family.theta.names
    point = plain.steady_state(KW100)
    assert point.residual < 1e-6
    assert point.y["E_fd"] == pytest.approx(point.ss.x.unpack(point.x)["V_R"], rel=1e-12)


@pytest.mark.long
def test_units_leave_nothing_behind_and_compile_nothing(asked):
    """200 units with a step each: their models are gone, and only the first is compiled."""
    gone = []

    def step(k: int) -> float:
        gen = Generator(MachineParameters(r_s=0.0044 + 1e-7 * k))
        point = gen.steady_state(KW100)
        mean = MeanStep(gen, point.ss, point.u, np.zeros(0), dt=0.02, quad=("P_e",))
        power = float(mean(point.x, point.u)[1][0])
        gone.append(weakref.ref(point.ss))
        return power

    first = step(0)
    before = set(asked)
    powers = [step(k) for k in range(1, 200)]
    assert before and asked == before
    assert all(math.isfinite(p) and p != first for p in powers)
    gc.collect()
    assert sum(r() is not None for r in gone) < 12
