"""The gas generator: tables of the paper, conservation, the discrete model of eq. (12)."""

import dataclasses

import casadi as ca
import numpy as np
import pytest

from apu_casadi.core.errors import (
    MapError,
    OperatingPointError,
    ParameterError,
    SignalError,
    SimulationError,
)
from apu_casadi.gaspath.designdata import RPM, GasGeneratorParameters
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.maps.mapfiles import read_map, shipped, write_map_csv
from apu_casadi.gaspath.steady.trimming import initialise, trim_gas_generator

ISA5 = {"dT_isa": 5.0}


@pytest.fixture(scope="module")
def gg():
    return GasGenerator()


@pytest.fixture(scope="module")
def random_points(gg):
    """Solved points over the envelope, unsteady ones included (fixed seed)."""
    rng = np.random.default_rng(1)
    points = []
    for _ in range(25):
        theta = {n: 1 + 0.04 * rng.uniform(-1, 1) for n in gg.THETA.names}
        fixed = {"N": gg.parameters.N * rng.uniform(0.97, 1.03), "T4": rng.uniform(950, 1200)}
        ambient = {"altitude": rng.uniform(0, 10000), "Mach": rng.uniform(0, 0.7),
                   "dT_isa": rng.uniform(-20, 20), "war": rng.uniform(0, 0.02)}  # fmt: skip
        points.append(trim_gas_generator(gg, fixed, theta=theta, **ambient))
    return points


def test_design_point_is_a_root_of_the_off_design_equations(gg):
    """Design and off-design use the same components: the design z solves 0 = alg (rounding)."""
    d = gg.design
    PW = d.values["P_turb"] - d.values["P_cpr"] - gg.parameters.P_acc
    u = gg.U.pack(Wf=d.values["Wf"], PW=PW, **ISA5)
    z = gg.similar(ca.DM([gg.parameters.N]), ca.DM(u))
    ode, alg, _ = gg.equations([gg.parameters.N], z, u, gg.THETA.pack())
    assert np.abs(np.array(alg)).max() < 1e-12
    assert abs(float(ode)) < 1e-7  # rad/s2


def test_newer_gas_data_move_the_design_point_as_documented():
    """gas.py: T3 at the design point is within 8e-5 of Table 4 with nasa7, 3.4e-4 with nasa9."""
    T3 = {
        data: GasGenerator(GasGeneratorParameters(gas_data=data)).design.z["T3"]
        for data in ("nasa7", "nasa9")
    }
    assert T3["nasa7"] == pytest.approx(568.127, rel=9e-5)
    assert T3["nasa9"] / 568.127 - 1 == pytest.approx(3.36e-4, abs=2e-6)


def test_conservation_of_mass(random_points):
    """Every kilogram is accounted for: W8 = W2 - overboard + Wf (rounding)."""
    for p in random_points:
        assert p["W8"] == pytest.approx(p["W2"] * 0.99 + p["Wf"], rel=1e-13)
        assert p["W31"] == pytest.approx(0.89 * p["W2"], rel=1e-13)
        assert p["W41"] == pytest.approx(p["W4"] + 0.05 * p["W2"], rel=1e-13)


def test_conservation_of_energy_per_component(gg, random_points):
    """First law for compressor, burner, mixers and turbine with enthalpies re-evaluated here.

    1e-9 of the flow of enthalpy: the solver's tolerance.
    """
    gas, p = gg.gas, gg.parameters
    for pt in random_points:
        war = pt.u[gg.U.index("war")]
        h = lambda T, FAR=0.0, war=war: float(gas.h(T, FAR, war))  # noqa: E731
        W2, Wf = pt["W2"], pt["Wf"]
        scale = W2 * 1005 * pt["T4"]
        dry = lambda W_humid, war=war: W_humid / (1 + war)  # noqa: E731
        FAR4 = Wf / dry(0.89 * W2)
        FAR41 = Wf / dry(0.94 * W2)
        FAR5 = Wf / dry(0.99 * W2)
        h3 = h(pt["T3"])
        assert pt["P_cpr"] == pytest.approx(W2 * (h3 - h(pt["T2"])), rel=1e-12)
        burner = 0.89 * W2 * h3 + Wf * p.LHV - pt["W4"] * h(pt["T4"], FAR4)
        vane = pt["W4"] * h(pt["T4"], FAR4) + 0.05 * W2 * h3 - pt["W41"] * h(pt["T41"], FAR41)
        rotor = pt["W41"] * h(pt["T50"], FAR41) + 0.05 * W2 * h3 - pt["W5"] * h(pt["T5"], FAR5)
        turbine = pt["W41"] * (h(pt["T41"], FAR41) - h(pt["T50"], FAR41)) - pt["P_turb"]
        for balance in (burner, vane, rotor, turbine):
            assert abs(balance) < 1e-9 * scale


def test_conservation_of_energy_of_the_whole_engine(gg, random_points):
    """Steady flow energy equation from 2 to 8: fuel = shaft + accessories + enthalpy rise."""
    for pt in random_points:
        war = pt.u[gg.U.index("war")]
        h = lambda T, FAR=0.0, war=war: float(gg.gas.h(T, FAR, war))  # noqa: E731
        W2, Wf = pt["W2"], pt["Wf"]
        out = pt["W8"] * h(pt["T8"], Wf / (0.99 * W2 / (1 + war))) + 0.01 * W2 * h(pt["T3"])
        balance = Wf * gg.parameters.LHV + W2 * h(pt["T2"]) - out - pt["PW"] - 30e3
        assert abs(balance) < 1e-8 * Wf * gg.parameters.LHV


def test_losses_scale_with_corrected_flow_squared(random_points):
    """Exact in Table 5: burner loss 3 % at the design corrected flow, squared law."""
    for p in random_points:
        corrected = p["W31"] * np.sqrt(p["T3"]) / p["P3"]
        design = 0.89 * 3.1442 * np.sqrt(568.1749) / 802494.0
        assert 1 - p["P4"] / p["P3"] == pytest.approx(0.03 * (corrected / design) ** 2, rel=1e-5)


def test_explicit_and_implicit_method_agree(gg):
    """Algorithm 1 (output computed inside one implicit step) against Algorithm 2, empty hook.

    The earlier method hides the state; its one function is written out here.  Same trajectory to
    the solver's tolerance.
    """
    start = initialise(gg, N=gg.parameters.N, PW=230e3, **ISA5)
    K = 40
    inputs = np.tile(start.u[:, None], (1, K))
    inputs[0, 10:] *= 1.1
    X, Y = gg.run(start, inputs, hook=lambda k, x: x)

    x_hidden, z = start.x, start.z
    Y1 = [np.array(gg.g(start.x, start.u, start.theta, z)[0]).ravel()]

    def transition_state(u):
        nonlocal x_hidden, z
        x_hidden, z, _ = gg.f(x_hidden, u, start.theta, gg.dt, z)
        y, z = gg.g(x_hidden, u, start.theta, z)
        return np.array(y).ravel()

    Y1 += [transition_state(inputs[:, k]) for k in range(K)]
    # in nominal units: 1e-12 is rounding, all that is left of P_acceleration at the steady start
    a, b = (v[:-1] / gg.Y.nominals[:-1, None] for v in (np.array(Y1).T, Y))
    np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
    assert X.shape == (1, K + 1)
    assert X[0, -1] > X[0, 0] * 1.01


def test_hook_and_output_noise_enter_where_algorithm_2_puts_them(gg):
    """The hook moves the state, so outputs follow it; output noise leaves the state alone."""
    start = initialise(gg, N=gg.parameters.N, PW=230e3, **ISA5)
    inputs = np.tile(start.u[:, None], (1, 3))
    X0, Y0 = gg.run(start, inputs)
    X1, Y1 = gg.run(start, inputs, hook=lambda k, x: x + (5.0 if k == 2 else 0.0))
    assert X1[0, 2] - X0[0, 2] == pytest.approx(5.0, abs=1e-9)
    assert Y1[gg.Y.index("N"), 2] == X1[0, 2]
    assert Y1[gg.Y.index("W2"), 2] > Y0[gg.Y.index("W2"), 2]
    v = np.arange(len(gg.Y), dtype=float)
    X2, Y2 = gg.run(start, inputs, output_noise=lambda k: v)
    np.testing.assert_array_equal(X2, X0)
    np.testing.assert_allclose(Y2[:, 1:] - Y0[:, 1:], v[:, None].repeat(3, 1), atol=1e-9)


def test_discrete_step_is_second_order(gg):
    """Halving the step quarters the error against CVODES on the continuous model (rtol 1e-11)."""
    start = initialise(gg, N=gg.parameters.N, PW=230e3, **ISA5)
    u = start.u.copy()
    u[0] *= 1.05
    ss = gg.state_space
    x = ca.MX.sym("x")
    options = {"reltol": 1e-11, "abstol": 1e-9}
    exact = ca.integrator("I", "cvodes", {"x": x, "ode": ss.f(x, u, start.theta)}, 0, 1.0, options)
    reference = float(exact(x0=start.x)["xf"])
    errors = []
    for dt in (0.1, 0.05, 0.025):
        inputs = np.tile(u[:, None], (1, round(1.0 / dt)))
        errors.append(abs(gg.run(start, inputs, dt=dt)[0][0, -1] - reference))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 1.9)
    assert errors[-1] / reference < 1e-6


def test_exact_derivatives_equal_central_differences(gg):
    """Jacobians of f and g through the root finder against differences (their h^2 error)."""
    ss = gg.state_space
    p = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": 3e5}, **ISA5)
    for fun in (ss.f, ss.g):
        J = fun.jacobian()
        out = np.asarray(fun(p.x, p.u, p.theta)).ravel()
        jac = J(p.x, p.u, p.theta, np.zeros_like(out))
        # outputs that follow the solver's rounding are not functions
        keep = np.array([n != "residual" for n in gg.Y.names]) if out.size > 1 else np.array([True])
        for k, (v, scale) in enumerate(((p.x, 3e3), (p.u[:2], None), (p.theta, 1.0))):
            full = [p.x, p.u, p.theta]
            for i in range(v.size):
                h = 1e-4 * (scale or abs(p.u[i]))
                hi, lo = [a.copy() for a in full], [a.copy() for a in full]
                hi[k][i] += h
                lo[k][i] -= h
                num = (np.asarray(fun(*hi)) - np.asarray(fun(*lo))).ravel() / (2 * h)
                col = np.asarray(jac[k])[:, i]
                np.testing.assert_allclose(
                    col[keep], num[keep], rtol=2e-5, atol=1e-7 * np.abs(num[keep]).max()
                )


def test_assembled_derivatives_equal_those_of_the_whole_expression(gg, random_points):
    """Two routes: the chain rule through maps and stations against CasADi's own derivatives.

    1e-9 of each row's largest entry in nominal units: residuals of 1e-10 move the point that far.
    """
    ss = gg.state_space
    x, u, theta = (ca.MX.sym(k, len(s)) for k, s in (("x", gg.X), ("u", gg.U), ("t", gg.THETA)))
    z = gg.solve(gg.similar(x, u), x, u, theta)
    whole = ca.vertcat(ss.f(x, u, theta), ss.g(x, u, theta), z)
    w = ca.vertcat(x, u, theta)
    plain = ca.Function("plain", [x, u, theta], [ca.densify(ca.jacobian(whole, w))])
    smooth = [n not in ("off_c", "off_t", "residual") for n in gg.Y.names]
    keep = np.array([True, *smooth, *[True] * len(gg.z)])
    nominal = np.concatenate([s.nominals for s in (gg.X, gg.U, gg.THETA)])
    for p in random_points[:8]:
        want = plain(p.x, p.u, p.theta).full()[keep]
        _, _, *parts = gg.cycle.sensitivities(p.x, p.z, p.u, p.theta)
        got = np.vstack([v.full() for v in parts])[keep]
        scale = np.abs(want * nominal).max(axis=1, keepdims=True)
        assert (np.abs(got - want) * nominal / np.where(scale > 0, scale, 1.0)).max() < 1e-9


def test_second_derivatives_of_the_root_equal_differences_of_first_ones(gg):
    """The Jacobian of the root is itself differentiable; 1e-6 is the error of the differences."""
    p = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": 3e5}, **ISA5)
    theta = ca.MX.sym("theta", len(gg.THETA))
    z = gg.solve(p.z, p.x, p.u, theta)
    J = ca.jacobian(z, theta)
    f = ca.Function("f", [theta], [J, ca.jacobian(ca.vec(J), theta)])
    h = 1e-5
    second = f(p.theta)[1].full()
    for k, e in enumerate(h * np.eye(len(gg.THETA))):
        column = (f(p.theta + e)[0] - f(p.theta - e)[0]).full().ravel(order="F") / (2 * h)
        np.testing.assert_allclose(second[:, k], column, atol=1e-6 * np.abs(second).max())


@pytest.mark.long
@pytest.mark.parametrize("backend", ["vm", "auto"])
def test_what_is_not_a_number_is_never_called_solved(gg, backend):
    """NaN in any input or in the start leaves a residual that fails every check."""
    from apu_casadi.core.backend import compiled

    step = compiled(gg.step, backend=backend)
    p = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": 3e5}, **ISA5)
    good = [p.x, p.u, p.theta, np.array([gg.dt]), p.z]
    assert float(step(*good)[3]) < 1e-9  # RESIDUAL_TOL: what any result is used with
    for which, vector in enumerate(good):
        for k in range(vector.size):
            bad = [v.copy() for v in good]
            bad[which][k] = np.nan
            x1, _, _, residual = step(*bad)
            assert np.isnan(float(x1)) or np.isnan(float(residual)), (which, k)


def test_health_factors_act_in_their_sense(gg):
    """Less efficiency needs more fuel at the same power; less flow capacity passes less air."""
    base = {"N": gg.parameters.N, "PW": 3e5}
    healthy = trim_gas_generator(gg, base, **ISA5)
    for name in ("f_eta_c", "f_eta_t"):
        worse = trim_gas_generator(gg, base, theta={name: 0.98}, **ISA5)
        assert worse["Wf"] > healthy["Wf"] * 1.01
        assert worse["T4"] > healthy["T4"]
    assert trim_gas_generator(gg, base, theta={"f_W_c": 0.97}, **ISA5)["W2"] < healthy["W2"] * 0.98
    assert trim_gas_generator(gg, base, theta={"f_W_t": 1.04}, **ISA5)["P3"] < healthy["P3"] * 0.98


def test_users_bring_their_own_map(gg, tmp_path):
    """A map written as CSV and read back gives the same engine, without touching the package."""
    path = tmp_path / "mine.csv"
    write_map_csv(shipped("axi5"), path)
    mine = dataclasses.replace(gg.compressor_map, table=read_map(path))
    other = dataclasses.replace(gg, compressor_map=mine)
    fixed = {"N": gg.parameters.N, "PW": 222e3}
    a, b = (trim_gas_generator(g, fixed, **ISA5) for g in (gg, other))
    assert b["T3"] == pytest.approx(a["T3"], rel=1e-12)


def test_bad_inputs_are_refused_with_their_range(gg):
    """Each message names the quantity, its value and what is allowed."""
    with pytest.raises(ParameterError, match=r"eta_c .*1\.2 .*0\.3, 1"):
        GasGeneratorParameters(eta_c=1.2)
    with pytest.raises(OperatingPointError, match=r"altitude = 40000 m .*15000"):
        trim_gas_generator(gg, {"N": 3775.0, "PW": 1e5}, altitude=40000.0)
    with pytest.raises(SignalError, match=r"'n' .*N"):
        trim_gas_generator(gg, {"n": 3775.0, "PW": 1e5})
    with pytest.raises(SignalError, match="Mch"):
        trim_gas_generator(gg, {"N": 3775.0, "PW": 1e5}, Mch=0.2)
    with pytest.raises(SignalError, match="two fixed"):
        trim_gas_generator(gg, {"N": 3775.0})
    with pytest.raises(MapError):
        dataclasses.replace(gg.compressor_map, beta_des=99.0).scaled(W=1.0, PR=8.0, eta=0.85)


def test_impossible_points_are_refused_with_the_best_point(gg):
    """400 kW cannot be had from 0.040 kg/s (Table 4's SFC asks for 0.0416): says how far it got."""
    with pytest.raises(OperatingPointError, match=r"% of the way .* best point N = "):
        trim_gas_generator(gg, {"Wf": 0.03, "PW": 400e3}, **ISA5)


def test_a_step_off_the_maps_raises(gg):
    """No result with a residual above 1e-9 is used: with the load kept at a tenth of the fuel the
    rotor runs down until the cycle has no solution, and the run stops with numbers.
    """
    start = initialise(gg, N=gg.parameters.N, PW=230e3, **ISA5)
    inputs = np.tile(start.u[:, None], (1, 800))
    inputs[0] *= 0.1
    with pytest.raises(SimulationError, match=r"residual .* at N = "):
        gg.run(start, inputs)


def test_impossible_design_data_are_refused():
    """T4 below T3 leaves no solution with positive fuel; the worst equation is named."""
    par = GasGeneratorParameters(T4=620.0, PR_c=40.0)
    with pytest.raises(OperatingPointError, match="design point not solved: equation"):
        _ = GasGenerator(par).design


def test_speed_unit(gg):
    """Table 3's 36050 r/min in rad/s."""
    speed_rpm = gg.parameters.N / RPM
    assert speed_rpm == pytest.approx(36050.0, rel=1e-15)
