"""Fisher information, null directions, confounded faults, visible sizes, sets of sensors.

Kay (1993, 1998), Fundamentals of Statistical Signal Processing, I section 3.9 and II section 2.2.3.
Every number has a second route: inverses written out, Monte Carlo, finite differences of trims.
"""

import numpy as np
import pytest
from estimation_models import batch_by_hand, gappy, linear, random_belief, random_linear, signals
from numpy.testing import assert_allclose
from scipy.stats import chi2, ncx2, norm

from apu_casadi.core.errors import EstimationError, ParameterError, SignalError
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from estimators.apu.identify import BASE, CANDIDATES, gas_path
from estimators.filters.belief import Belief
from estimators.information.bounds import posterior_bound
from estimators.information.identifiability import (
    compare_sensors,
    identify,
    noncentrality,
    which_to_add,
)
from estimators.information.sensitivities import (
    Sensitivities,
    recording_sensitivities,
    steady_sensitivities,
    together,
)


def toy(H=None, *, faults="a b", nuisances="n", prior=None, sigma=None, seed=0):
    """Readings r0, r1, ... of two faults and a nuisance."""
    rng = np.random.default_rng(seed)
    theta = signals(f"{faults} {nuisances}")
    H = rng.standard_normal((6, len(theta))) if H is None else np.asarray(H, float)
    sigma = np.ones(len(H)) if sigma is None else sigma
    return Sensitivities.of(
        theta, [f"r{i}" for i in range(len(H))], H, sigma, faults=faults.split(), prior=prior
    )


# ---------------------------------------------------------------------- information


def test_nuisances_are_eliminated_as_in_the_inverse_information():
    """The information of the faults is the Schur complement; priors count as readings."""
    g = toy(prior={"n": 0.3, "a": 0.5}, sigma=np.linspace(0.5, 2, 6))
    full = g.J.T @ g.J + np.diag([0, 0, 1 / 0.3**2])
    schur = full[:2, :2] - full[:2, 2:] @ np.linalg.inv(full[2:, 2:]) @ full[2:, :2]
    assert_allclose(g.information(), schur, rtol=1e-11)
    cov = np.linalg.inv(full + np.diag([1 / 0.5**2, 0, 0]))[:2, :2]
    assert_allclose(g.covariance(), cov, rtol=1e-11)
    assert_allclose(identify(g).sigma, np.sqrt(np.diag(cov)), rtol=1e-11)


def test_a_considered_nuisance_costs_what_schmidt_s_filter_loses():
    """One sample, gain (P H')(S)^-1 with the bias in S and no row for it: the same variance."""
    g = toy(prior={"a": 0.5, "b": 2.0, "n": 0.3})
    H, P = g.J, np.diag([0.5, 2.0, 0.3]) ** 2
    S = H @ P @ H.T + np.eye(6)
    K = P @ H.T @ np.linalg.inv(S)
    K[2] = 0
    A = np.eye(3) - K @ H
    schmidt = A @ P @ A.T + K @ K.T
    assert_allclose(g.covariance(), schmidt[:2, :2], rtol=1e-11)


def test_the_units_of_the_unknowns_do_not_matter():
    """A fault counted in other units has other numbers, but the same visibility."""
    g = toy()
    f = Sensitivities(g.theta, g.J / 1e6, g.rows, g.faults, g.size * 1e6, g.prior)
    one, two = identify(g), identify(f)
    assert_allclose(two.singular, one.singular, rtol=1e-10)
    assert_allclose(two.among, 1e6 * one.among, rtol=1e-10)
    assert_allclose([p.angle for p in two.pairs], [p.angle for p in one.pairs], rtol=1e-9)


def test_the_information_of_a_recording_is_that_of_the_batch_fit():
    """Noise in output and transition, gaps: against one stacked least-squares problem.

    The batch fit's prior is made wide; 1e-5 is what a variance of 1e6 leaves of it.
    """
    model, parts = random_linear(7)
    prior, data = random_belief(7, model), gappy(7, model, 20)
    found = recording_sensitivities(
        model, ["x2", "x0"], prior, data, np.zeros((3, 20)), backend="vm"
    )
    cov = np.zeros((3, 3))
    cov[1, 1] = prior.cov[1, 1]
    cov[0, 0] = cov[2, 2] = 1e6
    _, batch = batch_by_hand(parts, model.walk, Belief(model.x, np.zeros(3), cov), data)
    assert_allclose(found.covariance(), batch[0][np.ix_([2, 0], [2, 0])], rtol=1e-5, atol=1e-8)


def test_a_recording_of_constants_agrees_with_the_posterior_bound():
    """Information plus the prior's is the inverse of the bound, where theta stays what it was."""
    model, (A, B, G, C, D) = random_linear(8)
    A = A.copy()
    A[2], G = [0, 0, 1], np.vstack([G[:2], np.zeros((1, 2))])
    model = linear(A, B, G, C, D, [0.2, 0.3, 0.0])
    data = gappy(8, model, 15)
    prior = Belief(model.x, np.zeros(3), np.diag([1.0, 2.0, 0.7]))
    g = recording_sensitivities(model, ["x2"], prior, data, np.zeros((3, 15)), backend="vm")
    bound = posterior_bound(model, prior, data, np.zeros((3, 15)), backend="vm")
    assert_allclose(g.with_prior({"x2": 0.7**0.5}).covariance()[0, 0], bound[-1, 2, 2], rtol=1e-9)


# ---------------------------------------------------------------------- what is seen


def test_noncentrality_is_where_the_test_detects():
    """Against the normal distribution for one degree of freedom; the other tail is below 1e-10."""
    lam = noncentrality(1e-3, 0.95)
    assert_allclose(np.sqrt(lam), norm.isf(0.5e-3) + norm.ppf(0.95), rtol=1e-9)
    for dof in (2, 5):
        found = ncx2.sf(chi2.isf(1e-3, dof), dof, noncentrality(1e-3, 0.95, dof))
        assert_allclose(found, 0.95, rtol=1e-9)


def test_a_visible_size_is_detected_as_often_as_stated():
    """20000 draws, nuisance and other fault at random: 0.95 within four standard errors."""
    g = toy(prior={"b": 0.4})
    found = identify(g)
    rng = np.random.default_rng(1)
    for size, others in ((found.alone[0], False), (found.among[0], True)):
        b = 0.4 * rng.standard_normal(20000) * others
        theta = np.vstack([np.full(20000, size), b, 10 * rng.standard_normal(20000)])
        y = g.J @ theta + rng.standard_normal((6, 20000))
        # best linear unbiased estimate of a, b known to be 0 or drawn from its prior
        A = np.vstack([g.J, [0, 1 / 0.4, 0]]) if others else g.J[:, [0, 2]]
        y = np.vstack([y, np.zeros(20000)]) if others else y
        cov = np.linalg.inv(A.T @ A)
        a = (cov @ A.T @ y)[0]
        detected = np.mean(a**2 / cov[0, 0] > chi2.isf(1e-3, 1))
        assert abs(detected - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 20000)


def test_null_directions_in_words():
    """A fault that only acts with a nuisance; one sensor that is not there would show it."""
    theta = Signals(
        [
            Signal("f", "1", "first fault"),
            Signal("s", "1", "second fault"),
            Signal("q", "kg/s", "a flow", nominal=0.05),
        ]
    )
    H = [[1.0, 0.0, 20.0], [0.0, 2.0, 0.0], [0.0, 0.0, 20.0]]
    g = Sensitivities.of(theta, ["A", "B", "Q"], H, [0.01, 0.01, 0.01], faults=["f", "s"])
    found = identify(g, ["A", "B"])
    assert (found.rank, found.rank_in_noise) == (1, 1)
    assert_allclose(found.invisible[:, 0], [1.0, 0.0, -1.0], atol=1e-12)
    words = " ".join(found.sentences())
    assert "With A, B: f +1.00 % together with q -1.00 % leaves every reading as it is" in words
    assert "f and q cannot be told apart. It would show in Q (1 standard deviations)." in words
    assert "s is free of that." in words
    assert np.isinf(found.sigma_flat[0]) and np.isfinite(found.sigma_flat[1])
    assert np.isinf(found.alone[0]) and np.isinf(found.among[0])
    assert "nothing is invisible" in identify(g).sentences()[0]


def test_several_null_directions_are_written_sparsely():
    """Two pairs that imitate each other: two sentences with two names, not mixtures."""
    H = np.zeros((2, 4))
    H[0, :2], H[1, 2:] = (1.0, 2.0), (3.0, 1.0)
    theta = signals("a b c d")
    g = Sensitivities.of(theta, ["r", "s"], H, [0.01, 0.01], faults=theta.names)
    found = identify(g)
    assert found.rank == 2
    assert sorted(tuple(np.flatnonzero(v)) for v in found.invisible.T) == [(0, 1), (2, 3)]
    assert_allclose(g.J @ (found.invisible * g.size[:, None]), 0, atol=1e-12)
    mimics = {m.fault: dict(m.by) for m in found.mimics}
    assert mimics["a"] == pytest.approx({"b": 0.005})
    assert np.isnan(found.correlation[0, 1])


def test_pairs_that_look_alike():
    """Signatures 10 degrees apart: confounded, told apart at a size 1/sin(10 degrees) larger."""
    angle = np.radians(10)
    H = [[1.0, np.cos(angle)], [0.0, np.sin(angle)], [0.0, 0.0]]
    g = Sensitivities.of(signals("a b"), list("rst"), H, np.full(3, 0.1), faults=["a", "b"])
    found = identify(g)
    pair = found.pairs[0]
    assert_allclose(pair.angle, 10, rtol=1e-9)
    assert_allclose(pair.size, found.alone[0] / np.sin(angle), rtol=1e-9)
    assert_allclose(pair.correlation, -np.cos(angle), rtol=1e-9)
    assert pair.confounded
    assert found.mimics[0].share == pytest.approx(np.sin(angle))
    far = Sensitivities.of(signals("a b"), list("rs"), [[1, 1], [0, 2]], [1, 1], faults=["a", "b"])
    assert not identify(far).pairs[0].confounded


def test_two_experiments_share_faults_and_what_is_said_to_be_shared():
    """Their information adds when nothing else is shared; a shared gain is one unknown."""
    one, two = toy(seed=1), toy(seed=2)
    both = together({"x": one, "y": two})
    assert both.theta.names == ("a", "b", "n_x", "n_y")
    assert_allclose(both.information(), one.information() + two.information(), rtol=1e-11)
    same = together({"x": one, "y": two}, shared=["n"])
    J = np.vstack([one.J, two.J])
    full = J.T @ J
    schur = full[:2, :2] - np.outer(full[:2, 2], full[2, :2]) / full[2, 2]
    assert_allclose(same.information(), schur, rtol=1e-11)


def test_the_sensor_to_add():
    """Each fault has its own sensor; the third shows nothing of either."""
    H = [[1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]
    g = Sensitivities.of(
        signals("a b"), ["sum", "A", "B", "none"], H, [0.01, 0.02, 0.001, 1.0], faults=["a", "b"],
        prior={"a": 1.0, "b": 1.0},
    )  # fmt: skip
    rows = {r["fault"]: r for r in which_to_add(g, ["sum"])}
    assert rows["b"]["add"] == "B" and rows["a"]["add"] == "B"
    assert [n for n, _ in rows["a"]["ranking"]] == ["B", "A", "none"]
    only = which_to_add(g, ["sum"], ["none"])
    assert [r["add"] for r in only] == [None, None]
    sets = compare_sensors(g, {"one": ["sum"], "two": ["sum", "A"]})
    assert sets["one"].rank == 1 and sets["two"].rank == 2
    data = sets.to_dataset()
    assert_allclose(data["among"].sel(set="two", fault="a"), sets["two"].among[0])
    assert len(sets.rows()) == 4
    with pytest.raises(SignalError, match=r"unknown sensor set 'tow'.*'two'"):
        sets["tow"]


def test_a_dataset_names_everything():
    """Bounds by fault, angles and correlations by pair."""
    data = identify(toy()).to_dataset()
    assert set(data["fault"].values) == {"a", "b"}
    assert data["angle"].sel(fault="a", other="b") > 0
    assert data.attrs["rank"] == 2 and data["sigma"].attrs["long_name"]


def test_messages():
    """What is wrong, where, and what to do."""
    g = toy()
    with pytest.raises(SignalError, match=r"unknown sensor R1.*'r1'"):
        identify(g, ["R1"])
    with pytest.raises(ParameterError, match="0 < P_fa < P_d < 1"):
        identify(g, P_fa=0.99)
    with pytest.raises(ParameterError, match="threshold must be > 0"):
        identify(g, threshold=0.0)
    with pytest.raises(SignalError, match=r"prior must be > 0: b"):
        g.with_prior({"b": 0.0})
    with pytest.raises(SignalError, match="no fault is asked for"):
        Sensitivities.of(g.theta, ["r"], np.ones((1, 3)), [1.0], faults=[])
    with pytest.raises(SignalError, match="sigma: 1 positive numbers expected"):
        Sensitivities.of(g.theta, ["r"], np.ones((1, 3)), [0.0], faults=["a"])
    with pytest.raises(SignalError, match="d r / d b is not finite"):
        Sensitivities.of(g.theta, ["r"], [[1.0, np.inf, 1.0]], [1.0], faults=["a"])
    with pytest.raises(SignalError, match="y asks for c, not for a, b"):
        together({"x": g, "y": toy(faults="c", nuisances="n m")})
    w = signals("x u v")
    with pytest.raises(SignalError, match="1 solved columns for 1 states"):
        steady_sensitivities(np.ones((1, 3)), np.eye(3), w, unknown=["x"], solved=["u", "v"])
    with pytest.raises(SignalError, match="of which u is unknown too"):
        steady_sensitivities(np.ones((1, 3)), np.eye(3), w, unknown=["x", "u"], solved=["u"])
    with pytest.raises(EstimationError, match="does not determine u: choose others"):
        steady_sensitivities([[1.0, 0.0, 1.0]], np.eye(3), w, unknown=["x", "v"], solved=["u"])


# ---------------------------------------------------------------------- the gas generator

GG = GasGenerator()


def trimmed(change):
    """Steady readings with speed, fuel flow and health changed relatively; shaft power follows."""
    d = trim_gas_generator(GG, {"N": GG.parameters.N, "PW": 500e3}, dT_isa=5.0)
    fixed = {n: d[n] * (1 + change.get(n, 0.0)) for n in ("N", "Wf")}
    theta = {n: 1 + change.get(n, 0.0) for n in GG.THETA.names}
    return trim_gas_generator(GG, fixed, theta=theta, dT_isa=5.0)


def test_exact_derivatives_are_finite_differences_of_trims():
    """Steady sensitivities of all sensors; central differences, step 1e-4: 1e-5 of the largest."""
    g = gas_path("design", prior=np.inf)
    names = g.sensors
    at = trimmed({})
    for name in g.theta.names:
        up, down = trimmed({name: 1e-4}), trimmed({name: -1e-4})
        slope = np.array([(up[n] - down[n]) / 2e-4 for n in names])
        j = g.theta.index(name)
        exact = g.J[:, j] * g.theta[j].nominal
        noise = np.array([noise_of(g, n, at) for n in names])
        assert_allclose(exact * noise, slope, atol=1e-5 * np.abs(slope).max(), err_msg=name)


def noise_of(g, name, at):
    """Standard deviation of a reading of 50 averaged samples, from the sensor table."""
    return CANDIDATES.sigma(name, at[name]) / (1 if name == "PW" else np.sqrt(50))


def test_the_null_direction_is_confirmed_by_trimming_along_it():
    """1 % and 0.5 % along it: readings move by curvature only, four times less for half the step.

    The same step in f_W_c alone moves them by more than twenty times as much; PW moves at first
    order along the null direction, and is what shows it.
    """
    found = identify(gas_path("design"), BASE)
    assert found.rank == 3
    g = found.given
    v = dict(zip(g.theta.names, found.invisible[:, 0], strict=True))
    at = trimmed({})

    def moved(change):
        to = trimmed(change)
        return np.linalg.norm([(to[n] - at[n]) / noise_of(g, n, at) for n in BASE]), (
            to["PW"] / at["PW"] - 1
        )

    whole, PW = moved({n: 0.01 * a for n, a in v.items()})
    half, _ = moved({n: 0.005 * a for n, a in v.items()})
    first, _ = moved({"f_W_c": 0.01})
    assert 3.5 < whole / half < 4.5
    assert whole < first / 20
    unseen = dict(found.unseen[0])
    assert abs(PW) == pytest.approx(0.01 * unseen["PW"], rel=0.1)
    assert "f_W_c, f_eta_t and f_W_t cannot be told apart" in found.sentences()[0]


def test_without_a_fuel_meter_turbine_efficiency_and_fuel_are_one():
    """N, P3, T3, T5: two null directions, both with the true fuel flow in them."""
    found = identify(gas_path("design"), ["N", "P3", "T3", "T5"])
    assert found.rank == 2
    assert np.all(np.abs(found.invisible[found.given.theta.index("Wf")]) > 0.1)
    assert "f_eta_t, f_W_c and Wf cannot be told apart" in " ".join(found.sentences())


def test_two_operating_points_remove_the_null_direction_but_hardly_see_it():
    """It turns with load, so that it is not common to both; what is left lies below the noise."""
    found = identify(gas_path("design,partload"), BASE)
    assert found.rank == 4 and found.rank_in_noise == 3
    assert identify(gas_path("design,partload")).rank_in_noise == 4
