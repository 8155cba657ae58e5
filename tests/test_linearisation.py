"""Linear models: against central differences, against the nonlinear models' steps and decays."""

import math

import numpy as np
import pytest

from apu_casadi.core import simulation
from apu_casadi.core.errors import ApuError, OperatingPointError, SignalError
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.park import Abc, abc_to_qd0
from apu_casadi.unit import linearisation
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.averaged import (
    averaged_generator,
    generator_vectors,
    has_severity,
    joint_averaged,
    joint_vectors,
)
from apu_casadi.unit.events import Ambient
from apu_casadi.unit.linearisation import (
    linearise,
    linearise_gas_generator,
    linearise_generator,
    linearise_joint,
)

LOADS = {
    "resistive": SeriesLoad.from_power(225e3),
    "inductive": SeriesLoad.from_power(100e3, 0.85),
    "constant_power": ConstantPowerLoad(100e3),
}
MATRICES = ("A", "B_u", "B_theta", "C", "D_u", "D_theta")
# rows that are not smooth, or zero but for rounding: no central difference holds for them
NOT_SMOOTH = ("residual", "off_c", "off_t")


@pytest.fixture(scope="module")
def apu():
    return Apu()


@pytest.fixture(scope="module")
def point(apu):
    return apu.steady_state(LOADS["resistive"], ambient=Ambient())


@pytest.fixture(scope="module")
def joint(apu, point):
    return linearise_joint(apu, point)


def central_differences(ss, x, u, theta):
    """Return d(xdot, y)/d(x, u, theta) and a bound of its own error, by two step widths.

    The error of a central difference is c h^2 + rounding/h; c is taken from widths h and 2h.
    """
    w0 = np.concatenate([x, u, theta])
    nominal = np.concatenate([ss.x.nominals, ss.u.nominals, ss.theta.nominals])
    cut = np.cumsum([len(ss.x), len(ss.u)])

    def F(w):
        parts = np.split(w, cut)
        return np.concatenate([ss.f(*parts).full().ravel(), ss.g(*parts).full().ravel()])

    rows = np.abs(F(w0))
    J, error = [], []
    for j in range(w0.size):
        h = 3e-5 * max(abs(w0[j]), 0.1 * nominal[j])
        values = {}
        for k in (1, 2):
            d = np.zeros(w0.size)
            d[j] = k * h
            values[k] = F(w0 + d), F(w0 - d)
        one = (values[1][0] - values[1][1]) / (2 * h)
        two = (values[2][0] - values[2][1]) / (4 * h)
        # rounding of the functions: 1e-12 of the largest values they are made of
        size = np.max(np.abs(values[2]), axis=0) + rows + _scale(ss)
        J.append(one)
        error.append(np.abs(two - one) + 3e-12 * size / h)
    return np.array(J).T, np.array(error).T


def _scale(ss):
    # a rate is the small difference of terms as large as nominal times the fastest eigenvalue
    return np.concatenate([ss.x.nominals * 1e5, ss.y.nominals])


def stacked(m):
    return np.vstack([np.hstack([m.A, m.B_u, m.B_theta]), np.hstack([m.C, m.D_u, m.D_theta])])


def models(apu, point):
    gg, gen = apu.gas_generator, apu.generator
    yield (
        gg.state_space,
        (point.gas.x, point.gas.u, point.gas.theta),
        linearise_gas_generator(gg, point.gas),
    )
    for load in LOADS.values():
        p = gen.steady_state(load)
        ss, *args = generator_vectors(gen, p)
        yield ss, args, linearise_generator(gen, p)
    ss, *args = joint_vectors(apu, point)
    yield ss, args, linearise_joint(apu, point)


def test_equal_to_central_differences(apu, point):
    """House rule 6: derivatives come from the expression, a difference checks them in a test.

    Tolerance: the difference's own error, estimated from two step widths and rounding.
    """
    for ss, args, m in models(apu, point):
        J, error = central_differences(ss, *args)
        rows = [*(f"{n}_dot" for n in ss.x.names), *ss.y.names]
        keep = [i for i, n in enumerate(rows) if n not in NOT_SMOOTH]
        ours = stacked(m)
        off = np.abs(ours - J)[keep] - error[keep]
        i, j = np.unravel_index(
            np.argmax(off / (np.abs(J[keep]) + error[keep] + 1e-300)), off.shape
        )
        columns = [*ss.x.names, *ss.u.names, *ss.theta.names]
        assert off.max() <= 0, (
            f"{ss.name}: d {rows[keep[i]]}/d {columns[j]} = {ours[keep[i], j]:.9g}, difference "
            f"{J[keep[i], j]:.9g} +- {error[keep[i], j]:.1e}"
        )
        # the estimated error must leave something to be tested
        told = np.abs(J[keep]) > 1e-3 * (np.abs(J[keep]).max(axis=0) + 1e-300)
        sharp = np.median((error[keep] / (np.abs(J[keep]) + 1e-300))[told])
        assert sharp < 1e-3, f"{ss.name}: the differences are too coarse to check with: {sharp:.1e}"


@pytest.mark.long
def test_both_routes_agree(apu, point, joint):
    """Eliminating z by the root finder's derivative and by hand are two routes to one answer.

    1e-7 of each column's and row's size: the points differ by the root finder's tolerance.
    """
    for m, (ss, *args) in (
        (joint, joint_vectors(apu, point)),
        (
            linearise_gas_generator(apu.gas_generator, point.gas),
            (apu.gas_generator.state_space, point.gas.x, point.gas.u, point.gas.theta),
        ),
    ):
        other = linearise(ss, *args)
        rows = [*(f"{n}_dot" for n in ss.x.names), *ss.y.names]
        keep = [i for i, n in enumerate(rows) if n not in NOT_SMOOTH]
        a, b = stacked(m)[keep], stacked(other)[keep]
        size = np.abs(b).max(axis=1, keepdims=True)
        assert np.abs((a - b) / (size + 1e-12)).max() < 1e-7, ss.name


def test_steady_point_is_steady(joint, point):
    """The averaged unit rests where gas generator and generator were trimmed apart."""
    rest = np.abs(joint.xdot0 / joint.x.nominals)
    assert rest.max() < 1e-6, f"{joint.x.names[rest.argmax()]} changes by {rest.max():.1e} 1/s"
    y = joint.y.unpack(joint.y0)
    assert y["T4"] == pytest.approx(point.gas["T4"], rel=1e-10)
    for name in ("V_t", "P_total", "T_e", "i_fd"):
        assert y[name] == pytest.approx(point.generator.y[name], rel=1e-9), name


@pytest.mark.long
@pytest.mark.parametrize(
    ("what", "kind", "size", "end", "outputs"),
    [
        ("N_ref", "u", 8.0, 0.25, ("N", "T3", "Wf")),
        ("R", "u", 0.02, 0.2, ("N", "V_t", "E_fd")),
        ("V_ref", "u", 0.01, 0.2, ("V_t", "P_total", "i_fd")),
        ("f_eta_c", "theta", 0.004, 0.25, ("N", "T4", "SM")),
        ("f_W_t", "theta", 0.004, 0.25, ("N", "P3", "T5")),
        ("h", "theta", 2e-4, 0.3, ("N", "V_t", "P_loss_fault")),
    ],
)
def test_error_of_a_step_response_is_of_second_order(
    apu, point, joint, what, kind, size, end, outputs
):
    """A linear model misses a step by c size^2 + d size^3: half the step, a quarter of the error.

    Ratio within 4 +- 0.5: the third order of steps as small as these stays below a tenth.  The
    integrator's tolerance, 1e-10, is 1e-3 of the smallest error compared.
    """
    ss, x, u, theta = joint_vectors(apu, point)
    grid = np.linspace(0, end, 11)
    errors = {}
    for k in (1.0, 0.5):
        step = {what: k * size}
        u1, th1 = u.copy(), theta.copy()
        if kind == "u":
            u1[ss.u.index(what)] += k * size
        else:
            th1[ss.theta.index(what)] += k * size
        ds = simulation.simulate(ss, x, grid, u1, theta=th1, rtol=1e-10, atol=1e-12)
        _, y = joint.step_response(grid, **{kind: step})
        errors[k] = {n: ds[n].values - y[joint.y.index(n)] for n in outputs}
    for n in outputs:
        i = int(np.argmax(np.abs(errors[1.0][n])))
        ratio = errors[1.0][n][i] / errors[0.5][n][i]
        assert ratio == pytest.approx(4, abs=0.5), f"{n} after a step of {what}: ratio {ratio:.3f}"


def test_step_response_of_the_gas_generator(apu, point):
    """Fuel and load steps of the gas generator alone, as above.

    Over half a second: without a governor the speed then runs away so far that third order counts.
    """
    gg = apu.gas_generator
    m = linearise_gas_generator(gg, point.gas)
    grid = np.linspace(0, 0.5, 6)
    for name, size in (("Wf", 4e-4), ("PW", 6e3)):
        error = []
        for k in (1.0, 0.5):
            u1 = point.gas.u.copy()
            u1[gg.U.index(name)] += k * size
            ds = simulation.simulate(
                gg.state_space, point.gas.x, grid, u1, theta=point.gas.theta, rtol=1e-10, atol=1e-12
            )
            x, _ = m.step_response(grid, u={name: k * size})
            error.append(ds["N"].values[-1] - x[0, -1])
        ratio = error[0] / error[1]
        assert ratio == pytest.approx(4, abs=0.5), f"after a step of {name}: ratio {ratio:.3f}"


def test_eigenvalue_is_the_decay_of_a_simulation(apu, point):
    """The nonlinear gas generator, disturbed in speed, decays as exp(lambda t).

    1e-4: the disturbance of 1e-5 leaves a nonlinear part of its own relative size.
    """
    gg = apu.gas_generator
    m = linearise_gas_generator(gg, point.gas)
    (mode,) = m.eigenvalues()
    grid = np.array([0.0, 1.0, 3.0])
    ds = simulation.simulate(
        gg.state_space, point.gas.x * (1 + 1e-5), grid, point.gas.u, theta=point.gas.theta,
        rtol=1e-11, atol=1e-14,
    )  # fmt: skip
    gone = ds["N"].values - point.gas.x[0]
    rate = math.log(gone[2] / gone[1]) / 2.0
    assert rate == pytest.approx(mode.value.real, rel=1e-4)
    assert mode.time_constant == pytest.approx(-1 / rate, rel=1e-4)


def test_slow_oscillation_of_the_unit_shows_in_a_simulation(apu):
    """The mode of exciter and field, 54 Hz: frequency and decay from the full machine in abc.

    The full generator, with its rotor angle and three phases, is disturbed in E_fd; the peaks of
    V_t between 10 and 60 ms give both numbers.  1 %: other modes have not quite died away.
    """
    gen = apu.generator
    p = gen.steady_state(LOADS["resistive"])
    mode = next(e for e in linearise_generator(gen, p).eigenvalues() if e.frequency > 40)
    x = p.x.copy()
    x[p.ss.x.index("E_fd")] *= 1.001
    grid = np.arange(0, 0.0801, 1e-4)
    ds = simulation.simulate(p.ss, x, grid, p.u, rtol=1e-10, atol=1e-12)
    w = ds["V_t"].values - p.V_t
    # least squares of the two-sample recurrence w(t+2T) = a w(t+T) - b w(t) of one damped mode,
    # with the slow modes taken out by differences over one sample
    T = 20
    w = np.diff(w[(grid > 0.02)])
    M = np.column_stack([w[T:-T], -w[: -2 * T]])
    a, b = np.linalg.lstsq(M, w[2 * T :], rcond=None)[0]
    root = np.roots([1, -a, b])[0]
    found = np.log(complex(root)) / (T * 1e-4)
    assert abs(found.imag) == pytest.approx(mode.value.imag, rel=0.01)
    assert found.real == pytest.approx(
        mode.value.real, rel=0.01 * abs(mode.value / mode.value.real)
    )


def test_participations_sum_to_one_and_pairs_are_listed_once(joint):
    """Perez-Arriaga et al.: each mode's participations sum to 1 (those below 5 % are left out)."""
    modes = joint.eigenvalues()
    count = sum(2 if e.value.imag else 1 for e in modes)
    assert count == len(joint.x)
    assert all(0.6 < sum(e.participation.values()) <= 1 + 1e-9 for e in modes)
    reals = [e.value.real for e in modes]
    assert reals == sorted(reals, reverse=True)
    assert max(reals) < 0, "the default unit is stable at its design point"
    trace = sum((2 if e.value.imag else 1) * e.value.real for e in modes)
    assert trace == pytest.approx(np.trace(joint.A), rel=1e-9)


def test_averaging_is_exact_without_a_fault(apu):
    """In the rotor's frame the healthy, balanced machine does not know its angle.

    1e-9 of the largest rate: rounding at another angle.
    """
    gen = apu.generator
    for load in LOADS.values():
        p = gen.steady_state(load, theta_e=0.7)
        ss, x, u, theta = generator_vectors(gen, p)
        x = x * 1.01
        rates = ss.x.unpack(ss.f(x, u, theta).full().ravel())
        full = dict(zip(ss.x.names, x, strict=True)) | {"theta_e": 2.1}
        there = p.ss.f(p.ss.x.pack(full), p.u, []).full().ravel()
        for n, v in p.ss.x.unpack(there).items():
            if n != "theta_e":
                assert rates[n] == pytest.approx(v, abs=1e-9 * np.abs(there).max()), (ss.name, n)


@pytest.mark.long
def test_column_of_h_is_the_period_mean_of_the_faulty_generator(apu):
    """A small TTSC in abc: means over 400 Hz periods follow the column of h, the 800 Hz part not.

    Simulated with the coupled fault at h = 1e-4 and 2e-4 from the healthy steady state to rest:
    the mean's quotient by h, extrapolated to h = 0, within 1e-3 of the linear model's steady value
    -C A^-1 B + D.  Means are over 8 periods, 20 ms; after 3 s the slowest mode, 7 1/s, has gone.
    """
    gen = apu.generator
    load = LOADS["resistive"]
    p = gen.steady_state(load)
    m = linearise_generator(gen, p)
    steady = -m.C @ np.linalg.solve(m.A, m.B_theta[:, 0]) + m.D_theta[:, 0]
    names = ("V_t", "P_e", "T_e", "P_total", "i_fd", "E_fd")
    found = {}
    for h in (1e-4, 2e-4):
        fault = Ttsc(mu=h / (1 + h), k_rf=0.0)
        assert fault.h == pytest.approx(h, rel=1e-12)
        ss = gen.variant(load, fault)
        step = simulation.stepper(ss, 400, quad=names, rtol=1e-9, atol=1e-11)
        u, theta = gen.inputs(load), gen.fault_vector(load, fault)
        x = step(p.x, u, theta, 3.0).x_end
        last = step(x, u, theta, 0.02)
        found[h] = {n: (last.mean[n] - p.y[n]) / h for n in names}
        ripple = np.ptp(last.y[ss.y.index("T_e")]) / h
    for n in names:
        slope = 2 * found[1e-4][n] - found[2e-4][n]
        ours = steady[m.y.index(n)]
        assert slope == pytest.approx(ours, rel=1e-3), f"{n}: {slope:.6g} by simulation, {ours:.6g}"
    assert ripple > abs(steady[m.y.index("T_e")]), "the 800 Hz torque exceeds its mean's change"


def test_averaged_fault_does_not_depend_on_its_representation(apu):
    """If kappa = mu only h enters terminal quantities, and outputs are means on the axes."""
    gen = apu.generator
    p = gen.steady_state(LOADS["resistive"])
    ss, x, u, _ = generator_vectors(gen, p)
    h = 0.01
    y = ss.y.unpack(ss.g(x, u, [h]).full().ravel())
    mean = dict.fromkeys(("P_e", "P_loss_fault", "v_q", "v_d"), 0.0)
    fault = Ttsc(mu=0.05, k_rf=0.05 / h - 0.95)
    full = gen.variant(LOADS["resistive"], fault)
    for angle in np.arange(12) * math.pi / 6:
        at = p.ss.x.unpack(p.x) | {"theta_e": angle}
        v = full.y.unpack(
            full.g(full.x.pack({n: at[n] for n in full.x.names}), p.u,
                   gen.fault_vector(LOADS["resistive"], fault)).full().ravel()
        )  # fmt: skip
        axes = abc_to_qd0(angle, Abc(v["v_a"], v["v_b"], v["v_c"]))
        v |= {"v_q": axes.q, "v_d": axes.d}
        for n in mean:
            mean[n] += v[n] / 12
    for n, value in mean.items():
        assert y[n] == pytest.approx(value, rel=1e-9), n


def test_what_has_a_severity():
    """Where the fault current is a state of its own there is no h, and the model says so."""
    grounded, isolated = Generator(), Generator(neutral="isolated")
    assert averaged_generator(grounded).theta.names == ("h",)
    assert not has_severity(grounded, "inductive")
    for gen, kind in ((grounded, "inductive"), (isolated, "resistive")):
        assert len(averaged_generator(gen, kind).theta) == 0
        assert "lam_s0" in averaged_generator(grounded).x
    assert "lam_s0" not in averaged_generator(isolated).x


def test_joint_with_an_inductive_load_and_an_isolated_neutral():
    """Every combination linearises; without h, theta holds the health factors only."""
    apu = Apu(generator=Generator(neutral="isolated"))
    m = linearise_joint(apu, apu.steady_state(LOADS["inductive"]))
    assert m.theta.names == apu.gas_generator.THETA.names
    assert m.u.names[-2:] == ("R", "L")
    assert np.all(np.linalg.eigvals(m.A).real < 0)


def test_at_a_trimmed_point_no_search_is_made(apu, point, monkeypatch):
    """The algebraic unknowns are those of the point: a filter may linearise in every step."""
    wanted = linearise_joint(apu, point)

    def searched(*args):
        raise AssertionError("the algebraic unknowns are searched again")

    monkeypatch.setattr(linearisation, "_eliminated", searched)
    assert np.array_equal(linearise_joint(apu, point).A, wanted.A)
    assert joint_averaged(apu) is joint_averaged(apu)


def test_labelled(joint):
    """Every matrix carries names and units, and reads back by name."""
    ds = joint.labelled()
    assert set(MATRICES) < set(ds)
    assert float(ds["A"].sel(xdot="N", x="Wf_I")) == joint.derivative("N_dot", "Wf_I")
    assert float(ds["D_theta"].sel(y="T3", theta="f_eta_c")) == joint.derivative("T3", "f_eta_c")
    assert joint.derivative("T3", "f_eta_c") < 0, "a better compressor heats the air less"
    assert str(ds["x_unit"].sel(x="lam_sq").item()) == "Wb"
    assert str(ds["xdot_unit"].sel(xdot="N").item()) == "rad/s/s"
    empty = linearise_generator(
        Generator(), Generator().steady_state(LOADS["inductive"])
    ).labelled()
    assert empty["B_theta"].shape == (len(empty["xdot"]), 0)


def test_to_control(joint, monkeypatch):
    """python-control is optional: its object if it is there, else the command that installs it."""
    try:
        import control
    except ImportError:
        with pytest.raises(ApuError, match="pip install control"):
            joint.to_control()
        return
    system = joint.to_control()
    assert isinstance(system, control.StateSpace)
    assert system.input_labels == [*joint.u.names, *joint.theta.names]
    np.testing.assert_allclose(np.sort(system.poles()), np.sort(np.linalg.eigvals(joint.A)))
    monkeypatch.setitem(__import__("sys").modules, "control", None)
    with pytest.raises(ApuError, match="pip install control"):
        joint.to_control()


def test_failures_name_what_is_wrong(apu, point, joint):
    """Wrong shapes, values, names and points: each message says which."""
    gg = apu.gas_generator
    x, u, theta = point.gas.x, point.gas.u, point.gas.theta
    with pytest.raises(SignalError, match=r"u must have shape \(6,\).*Wf"):
        linearise(gg.state_space, x, u[:3], theta)
    with pytest.raises(SignalError, match="theta is not finite in f_W_c"):
        linearise(gg.state_space, x, u, [1, math.nan, 1, 1])
    with pytest.raises(SignalError, match="together"):
        linearise(gg.state_space, x, u, theta, z=point.gas.z)
    with pytest.raises(OperatingPointError, match=r"residual of .*N = 3775"):
        linearise(gg.state_space, x, u, theta, equations=gg.equations, z=point.gas.z * 1.01)
    with pytest.raises(SignalError, match="did you mean 'T3'"):
        joint.derivative("t3", "N_ref")
    with pytest.raises(SignalError, match="did you mean 'f_eta_c'"):
        joint.derivative("T3", "f_etac")
    with pytest.raises(SignalError, match="did you mean 'V_ref'"):
        joint.step_response([0, 1], u={"Vref": 0.01})
    with pytest.raises(SignalError, match="instants"):
        joint.step_response([-1.0])
    assert linearisation.RESIDUAL_TOL < 1e-5
