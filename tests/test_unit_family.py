"""Averaged, linear and one-piece models of other units: shared, with exact derivatives."""

import time

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi import Apu, Generator, SeriesLoad
from apu_casadi.core.errors import SignalError
from apu_casadi.core.simulation import stepper
from apu_casadi.machine.machinedata import MACHINE, ExciterParameters
from apu_casadi.unit.averaged import (
    averaged_generator,
    joint_averaged,
    joint_equations,
    joint_vectors,
)
from apu_casadi.unit.linearisation import (
    linearise,
    linearise_gas_generator,
    linearise_generator,
    linearise_joint,
)

KW100 = SeriesLoad.from_power(100e3)
LAGGED = ExciterParameters(T_F2=0.02, T_F3=0.01)
# one of each kind: of machine and exciter, gas path and map, governor, gearbox
SOME = ["machine.r_s", "machine.L_md", "machine.eta_sg", "exciter.K_A", "gas_generator.eta_c"]
SOME += ["gas_generator.J", "gas_generator.W2", "compressor_map.n_Re", "turbine_map.a_W"]
SOME += ["governor.Kp", "governor.Ki", "governor.T_aw", "coupling.gear", "coupling.eta_gtSg"]


def flat(a):
    """Return what a function of CasADi gave as a vector."""
    return np.asarray(a).ravel()


@pytest.fixture(scope="module")
def point():
    """The default unit at 100 kW a generator."""
    return Apu().steady_state(KW100)


@pytest.mark.parametrize("kind", ["resistive", "inductive"])
def test_derivatives_of_the_averaged_generator_by_every_parameter_are_exact(kind):
    """Rates and outputs of the family by all numbers, against generators made with them, 1e-6."""
    gen = Generator(exciter=LAGGED)
    ss = averaged_generator(gen, kind)
    rng = np.random.default_rng(4)
    x, u = (s.nominals * rng.uniform(0.3, 0.9, len(s)) for s in (ss.x, ss.u))
    x[ss.x.index("V_R")] = 2.0
    theta = np.full(len(ss.theta), 1e-3)
    full, t = ss.full(theta), ca.SX.sym("t", len(ss.shared.theta))
    both = ca.vertcat(ss.shared.f(x, u, t), ss.shared.g(x, u, t))
    J = ca.Function("J", [t], [ca.jacobian(both, t)])(full).full()[:, len(theta) :]
    assert ss.shared.theta.names[len(theta) : len(theta) + len(MACHINE)] == MACHINE.names
    for k, (name, value) in enumerate(ss.held.items()):
        h, ends = 1e-5 * (abs(value) or 1.0), []
        set_of, _, field = name.partition(".")
        for v in (value + h, value - h):
            unit = Generator.__new__(Generator)
            parts = {"machine": gen.machine, "exciter": gen.exciter}
            parts[set_of] = parts[set_of].symbolic(**{field: v})
            unit.__dict__.update(neutral=gen.neutral, **parts)
            made = averaged_generator(unit, kind)
            ends.append(np.concatenate([flat(made.f(x, u, theta)), flat(made.g(x, u, theta))]))
        off = (ends[0] - ends[1]) / (2 * h) - J[:, k]
        rounding = 1e-10 * np.abs(ends[0]).max() / h
        assert (np.abs(off) <= 1e-6 * np.abs(J[:, k]).max() + rounding).all(), name


def test_derivatives_of_the_averaged_unit_by_parameters_are_exact(point):
    """Linear model with parameters of each kind in theta, against units made with them.

    Central differences of order four at the same state and inputs, 1e-6 of each column's largest
    entry in nominal units.
    """
    ss, x, u, theta = joint_vectors(Apu(), point, free=tuple(SOME))
    x[1] *= 1.03  # more fuel than at rest, so that the rotor accelerates, and thinner air
    u[ss.u.index("altitude")] = 1500.0
    z, equations = flat(ss.z_of(x, u, theta)), joint_equations(Apu(), free=tuple(SOME))
    model = linearise(ss, x, u, theta, equations=equations, z=z)
    assert model.theta.names[-len(SOME) :] == tuple(SOME)
    J = np.vstack([model.B_theta, model.D_theta])[:, -len(SOME) :]
    names = [*ss.x.names, *ss.y.names]
    size = np.concatenate([np.maximum(np.abs(x), 1e-3 * ss.x.nominals), np.abs(model.y0) + 1e-3])
    own = len(theta) - len(SOME)
    skip = [i for i, n in enumerate(names) if n in ("off_c", "off_t", "residual")]
    for k, name in enumerate(SOME):
        value = theta[own + k]
        h = 1e-4 * value

        def at(move: float, name: str = name, value: float = value) -> np.ndarray:
            unit = joint_averaged(Apu().change({name: value + move}))
            return np.concatenate([flat(m(x, u, theta[:own])) for m in (unit.f, unit.g)])

        near, far = ((at(m * h) - at(-m * h)) for m in (1, 2))
        off = np.abs((8 * near - far) / (12 * h) - J[:, k]) / size
        off[skip] = 0.0
        worst = names[int(off.argmax())]
        assert off.max() < 1e-6 * np.abs(J[:, k] / size).max(), f"d {worst}/d {name}: {off.max()}"


def test_pole_pairs_are_whole_but_differentiable(point):
    """A whole number of a unit has a derivative all the same; unknown ones are told."""
    model = linearise_joint(Apu(), point, free=["machine.n_pp"])
    assert abs(model.derivative("T_e", "machine.n_pp")) > 0
    with pytest.raises(SignalError, match=r"'machine.rs' .*r_s"):
        linearise_joint(Apu(), point, free=["machine.rs"])
    with pytest.raises(SignalError, match=r"no derivatives by machine.P_rated"):
        linearise_joint(Apu(), point, free=["machine.P_rated"])
    with pytest.raises(SignalError, match=r"no derivatives by gas_generator.eta_c"):
        joint_averaged(Apu()).with_free("gas_generator.eta_c")


def test_a_free_parameter_changes_nothing_at_its_own_value(point):
    """Matrices by state and input are those without; theta has the unit's value as default."""
    plain = linearise_joint(Apu(), point)
    free = linearise_joint(Apu(), point, free=["machine.r_s", "gas_generator.eta_c"])
    assert free.theta0[-2:].tolist() == [0.0044, 0.85]
    n = len(plain.theta)
    pairs = ((free.A, plain.A), (free.B_u, plain.B_u), (free.D_theta[:, :n], plain.D_theta))
    for a, b in pairs:
        assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())


def test_another_unit_builds_nothing_and_costs_little():
    """Linear models and a run of the averaged model: functions are shared, 30 ms over a repeat."""

    def use(unit: Apu) -> tuple[float, object]:
        point = unit.steady_state(KW100)
        t = time.process_time()
        linearise_gas_generator(unit.gas_generator, point.gas)
        linearise_generator(unit.generator, point.generator)
        ss, x, u, theta = joint_vectors(unit, point)
        stepper(ss, 2)(x, u, theta, 0.02)
        return time.process_time() - t, ss.shared

    made = use(Apu())[1]
    first, again = [], []
    for k in range(5):
        unit = Apu().change(
            {"gas_generator.eta_c": 0.84 + 1e-3 * k, "machine.r_s": 0.004 + 1e-4 * k}
        )
        cost, shared = use(unit)
        assert shared is made
        first.append(cost)
        again.append(use(unit)[0])
    # three models, of which none takes longer than 30 ms
    assert min(first) < min(again) + 0.09
