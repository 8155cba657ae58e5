"""Averaged, linear and one-piece models of other units: shared, with exact derivatives."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi import Apu, Generator, SeriesLoad, Ttsc, simulate_joint
from apu_casadi.core import backend
from apu_casadi.core.errors import SignalError
from apu_casadi.core.simulation import stepper
from apu_casadi.machine.machinedata import MACHINE, ExciterParameters
from apu_casadi.unit.averaged import (
    averaged_generator,
    joint_averaged,
    joint_equations,
    joint_vectors,
)
from apu_casadi.unit.integrators import ramped
from apu_casadi.unit.linearisation import (
    linearise,
    linearise_gas_generator,
    linearise_generator,
    linearise_joint,
)
from apu_casadi.unit.monolithic import joint_state_space, simulate_monolithic

# none of SOME at an end of its range
UNIT = Apu().change({"coupling.eta_gtSg": 0.98})
KW100, LAGGING = SeriesLoad.from_power(100e3), SeriesLoad.from_power(100e3, 0.85)
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
    """The unit at 100 kW a generator."""
    return UNIT.steady_state(KW100)


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
            unit = replace(gen, **{set_of: getattr(gen, set_of).symbolic(**{field: v})})
            made = averaged_generator(unit, kind)
            ends.append(np.concatenate([flat(made.f(x, u, theta)), flat(made.g(x, u, theta))]))
        off = (ends[0] - ends[1]) / (2 * h) - J[:, k]
        rounding = 1e-10 * np.abs(ends[0]).max() / h
        assert (np.abs(off) <= 1e-6 * np.abs(J[:, k]).max() + rounding).all(), name


@pytest.mark.long
def test_derivatives_of_the_averaged_unit_by_parameters_are_exact(point):
    """Linear model with parameters of each kind in theta, against units made with them.

    Central differences of order four at the same state and inputs, 1e-6 of each column's largest
    entry in nominal units.
    """
    ss, x, u, theta = joint_vectors(UNIT, point, free=tuple(SOME))
    # slower, with more fuel than at rest, and in thinner air
    x[:2] *= 0.999, 1.03
    u[ss.u.index("altitude")] = 1500.0
    z, equations = flat(ss.z_of(x, u, theta)), joint_equations(UNIT, free=tuple(SOME))
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
            unit = joint_averaged(UNIT.change({name: value + move}))
            return np.concatenate([flat(m(x, u, theta[:own])) for m in (unit.f, unit.g)])

        near, far = ((at(m * h) - at(-m * h)) for m in (1, 2))
        off = np.abs((8 * near - far) / (12 * h) - J[:, k]) / size
        off[skip] = 0.0
        worst = names[int(off.argmax())]
        most = 1e-6 * np.abs(J[:, k] / size).max()  # none by T_aw within the limits
        assert off.max() <= most, f"d {worst}/d {name} is off by {off.max():.1e}"


def test_pole_pairs_are_whole_but_differentiable(point):
    """A whole number of a unit has a derivative all the same; unknown ones are told."""
    model = linearise_joint(UNIT, point, free=["machine.n_pp"])
    assert abs(model.derivative("T_e", "machine.n_pp")) > 0
    with pytest.raises(SignalError, match=r"'machine.rs' .*r_s"):
        linearise_joint(UNIT, point, free=["machine.rs"])
    with pytest.raises(SignalError, match=r"no derivatives by machine.P_rated"):
        linearise_joint(UNIT, point, free=["machine.P_rated"])
    with pytest.raises(SignalError, match=r"no derivatives by gas_generator.eta_c"):
        joint_averaged(UNIT).with_free("gas_generator.eta_c")


@pytest.mark.long
def test_a_free_parameter_changes_nothing_at_its_own_value(point):
    """Matrices by state and input are those without; theta has the unit's value as default."""
    plain = linearise_joint(UNIT, point)
    free = linearise_joint(UNIT, point, free=["machine.r_s", "gas_generator.eta_c"])
    assert free.theta0[-2:].tolist() == [0.0044, 0.85]
    n = len(plain.theta)
    pairs = ((free.A, plain.A), (free.B_u, plain.B_u), (free.D_theta[:, :n], plain.D_theta))
    for a, b in pairs:
        assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())


def test_another_unit_builds_nothing():
    """Linear models and a run of the averaged model: functions are shared."""

    def use(unit: Apu) -> object:
        point = unit.steady_state(KW100)
        linearise_gas_generator(unit.gas_generator, point.gas)
        linearise_generator(unit.generator, point.generator)
        ss, x, u, theta = joint_vectors(unit, point)
        stepper(ss, 2)(x, u, theta, 0.02)
        return ss.shared

    made = use(UNIT)
    for k in range(5):
        unit = {"gas_generator.eta_c": 0.84 + 1e-3 * k, "machine.r_s": 0.004 + 1e-4 * k}
        assert use(UNIT.change(unit)) is made


@pytest.mark.long
@pytest.mark.parametrize(("load", "fault"), [(KW100, None), (LAGGING, Ttsc(0.05, 1.0, 1.0))])
def test_derivatives_of_the_ramped_model_by_every_parameter_are_exact(load, fault):
    """Rates of the family by all numbers of the machine, against models of machines made so."""
    gen = Generator(exciter=LAGGED)
    ss = ramped(gen.variant(load, fault))
    theta, rng = gen.fault_vector(load, fault), np.random.default_rng(7)
    x = ss.x.nominals * rng.uniform(0.3, 0.9, len(ss.x))
    x[ss.x.index("V_R")] = 2.0
    u = gen.inputs(load, V_ref=1.0)
    u[ss.u.index("w_r_dot")] = 30.0
    full, t = np.append(theta, ss.numbers), ca.SX.sym("t", len(ss.family.theta))
    J = ca.Function("J", [t], [ca.jacobian(ss.family.f(x, u, t), t)])(full).full()[:, theta.size :]
    assert_allclose(ss.shared.f(x, u, ss.full(theta)), ss.f(x, u, theta), rtol=1e-12)
    for k, (name, value) in enumerate(ss.held.items()):
        h, ends = 1e-5 * (abs(value) or 1.0), []
        set_of, _, field = name.partition(".")
        for v in (value + h, value - h):
            unit = replace(gen, **{set_of: getattr(gen, set_of).symbolic(**{field: v})})
            ends.append(flat(ramped(unit.variant(load, fault)).f(x, u, theta)))
        off = (ends[0] - ends[1]) / (2 * h) - J[:, k]
        rounding = 1e-10 * np.abs(ends[0]).max() / h
        assert (np.abs(off) <= 1e-6 * np.abs(J[:, k]).max() + rounding).all(), name


def test_derivatives_of_the_whole_unit_by_parameters_are_exact(point):
    """f and g of the one model with parameters free, against units made with them, 1e-6."""
    x = np.array([*point.gas.x, *UNIT.governor.start(point.gas["Wf"]), *point.generator.x])
    ss = joint_state_space(UNIT, free=tuple(SOME))
    given = point.generator.ss.u.unpack(point.generator.u)
    given |= {"altitude": 1500.0, "Mach": 0.0, "dT_isa": 0.0, "war": 0.0}
    u = ss.u.pack({n: given[n] for n in ss.u.names})
    theta = np.array([1.0, 0.99, 1.0, 0.98, *(s.default for s in ss.theta[4:])])
    z, t = flat(ss.z_of(x, u, theta)), ca.MX.sym("t", len(theta))
    ode, alg = ss.residual(x, z, u, t)
    J = ca.Function("J", [t], [ca.jacobian(ca.vertcat(ode, alg), t)])(theta).full()[:, 4:]
    for k, name in enumerate(SOME):
        h, ends = 1e-4 * theta[4 + k], []
        for move in (h, -h, 2 * h, -2 * h):
            unit = joint_state_space(UNIT.change({name: theta[4 + k] + move}))
            ends.append(np.concatenate([flat(v) for v in unit.residual(x, z, u, theta[:4])]))
        off = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h) - J[:, k]
        rounding = 1e-10 * np.abs(ends[0]) / h
        assert (np.abs(off) <= 1e-6 * np.abs(J[:, k]).max() + rounding).all(), name


def test_runs_of_another_unit_build_nothing(point, monkeypatch):
    """Ramped speed and one model: no integrator is made for a second unit's run."""

    def use(unit: Apu) -> tuple[float, float]:
        rising = simulate_joint(
            unit, duration=0.04, load=KW100, exchange="predicted", waveform_dt=None
        )
        whole = simulate_monolithic(unit, duration=0.02, load=KW100)
        return float(rising["P_total"][-1]), float(whole["P_total"][-1])

    first = use(UNIT)
    monkeypatch.setattr(ca, "integrator", None)
    monkeypatch.setattr(backend, "_compile", None)
    other = use(UNIT.change({"machine.r_s": 0.006, "gas_generator.eta_c": 0.84}))
    assert other[0] > first[0] and other[1] > first[1]
    assert other[0] == pytest.approx(other[1], rel=1e-5)
