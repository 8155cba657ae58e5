"""Interacting multiple models against independent recursions written out in NumPy.

Blom and Bar-Shalom (1988), IEEE Trans. Automatic Control 33, 780-783.  The static limit is exact,
so there the mixture over all mode histories must come out; with switching it is compared for a few
samples with the mixture of all M^K histories.
"""

import dataclasses
import itertools
import json
import math

import casadi as ca
import numpy as np
import pytest
from estimation_models import linear, oscillator
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from apu_casadi.core.errors import EstimationError, ParameterError, SignalError
from apu_casadi.core.signals import Signal, Signals
from estimators.batch.immsmoother import imm_smoother
from estimators.batch.smoother import rts_smoother
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.imm import interacting_multiple_models, log_normalised, multiple_models
from estimators.filters.ukf import ukf_step
from estimators.models.filtermodel import discretise
from estimators.models.recording import Recording

A = {"calm": np.array([[1.0, 0.1], [0.0, 1.0]]), "wild": np.array([[1.0, 0.1], [0.0, 0.8]])}
C = {"calm": np.array([[1.0, 0.0], [0.0, 1.0]]), "wild": np.array([[1.0, 0.2], [0.0, 1.0]])}
WALK = {"calm": np.array([0.1, 0.1]), "wild": np.array([0.2, 1.5])}
PI = np.array([[0.95, 0.05], [0.2, 0.8]])
VAR = np.array([0.3, 0.5])


def _models():
    return {
        n: linear(A[n], np.zeros((2, 0)), np.zeros((2, 0)), C[n], np.zeros((2, 0)), WALK[n], name=n)
        for n in A
    }


def _data(K, seed=0, dt=1.0):
    rng = np.random.default_rng(seed)
    y = np.cumsum(rng.standard_normal((2, K)), axis=1) * 0.4
    if K > 4:
        y[0, 3] = np.nan
    t = np.cumsum(np.full(K, dt)) if np.isscalar(dt) else np.concatenate([[0.0], np.cumsum(dt)])
    return Recording(t, np.zeros((0, K)), y, np.repeat(VAR[:, None], K, axis=1), np.zeros(0))


PRIOR = Belief.of(_models()["calm"].x, {"x0": 0.0, "x1": 0.0}, {"x0": 1.0, "x1": 1.0})


def _update(n, m, P, y):
    there = ~np.isnan(y)
    Hk = C[n][there]
    S = Hk @ P @ Hk.T + np.diag(VAR[there])
    K = P @ Hk.T @ np.linalg.inv(S)
    ll = multivariate_normal(Hk @ m, S).logpdf(y[there])
    return m + K @ (y[there] - Hk @ m), P - K @ S @ K.T, ll


def _predict(n, m, P, dt):
    return A[n] @ m, A[n] @ P @ A[n].T + dt * np.diag(WALK[n] ** 2)


def imm_by_hand(data, transitions, mu):
    names = list(A)
    beliefs = [(PRIOR.mean, PRIOR.cov)] * 2
    mus, means, variances, total = [], [], [], 0.0
    for k in range(data.size):
        if k:
            T = transitions[k - 1]
            c = mu @ T
            mixed = []
            for j in range(2):
                w = mu * T[:, j] / c[j]
                m = sum(w[i] * beliefs[i][0] for i in range(2))
                P = sum(w[i] * (beliefs[i][1] + np.outer(beliefs[i][0] - m, beliefs[i][0] - m))
                        for i in range(2))  # fmt: skip
                mixed.append((m, P))
            beliefs, mu = mixed, c
        done = [_update(n, *b, data.y[:, k]) for n, b in zip(names, beliefs, strict=True)]
        likelihood = np.array([math.exp(d[2]) for d in done])
        total += math.log(mu @ likelihood)
        mu = mu * likelihood / (mu @ likelihood)
        mean = sum(mu[j] * done[j][0] for j in range(2))
        P = sum(mu[j] * (done[j][1] + np.outer(done[j][0] - mean, done[j][0] - mean))
                for j in range(2))  # fmt: skip
        mus.append(mu)
        means.append(mean)
        variances.append(np.diag(P))
        beliefs = [_predict(n, *d[:2], data.dt[k]) for n, d in zip(names, done, strict=True)]
    return np.array(mus).T, np.array(means).T, np.array(variances).T, total


def all_histories(data, T, mu):
    """The exact mixture: a Kalman filter for each of the M^K histories of the mode."""
    names = list(A)
    logs, ends, means = [], [], []
    for path in itertools.product(range(2), repeat=data.size):
        m, P, ll = PRIOR.mean, PRIOR.cov, math.log(mu[path[0]])
        for k, j in enumerate(path):
            m, P, gain = _update(names[j], m, P, data.y[:, k])
            ll += gain + (np.log(T[j, path[k + 1]]) if k + 1 < data.size else 0.0)
            end = m
            m, P = _predict(names[j], m, P, data.dt[k])
        logs.append(ll)
        ends.append(path[-1])
        means.append(end)
    logs, ends = np.array(logs), np.array(ends)
    total = logsumexp(logs)
    p = np.array([np.exp(logsumexp(logs[ends == j]) - total) for j in range(2)])
    return p, np.exp(logs - total) @ np.array(means), total


def test_against_the_recursion_by_hand():
    """More samples than one block holds, a gap, unequal prior."""
    data = _data(120)
    r = interacting_multiple_models(
        _models(), PRIOR, data, transition=PI, backend="vm",
        prior_probability={"calm": 0.9, "wild": 0.1},
    )  # fmt: skip
    mu, mean, var, total = imm_by_hand(data, [PI] * 119, np.array([0.9, 0.1]))
    assert_allclose(r.probability, mu, rtol=1e-8)
    assert_allclose(r.mean, mean, atol=1e-10)
    assert_allclose(r.variance, var, rtol=1e-9)
    assert r.loglik == pytest.approx(total, rel=1e-12)
    assert r["x1"][1][-1] == pytest.approx(math.sqrt(var[1, -1]))
    assert json.loads(json.dumps(r.to_dict()))["loglik"] == r.loglik


@pytest.mark.parametrize("K", [60, 100, 120])
def test_one_mode_is_its_filter_to_the_end(K):
    """The belief after the last sample, not one that the padding of a block carried on: these
    models go on by A x even in a step that lasts no time."""
    data, model = _data(K), _models()["calm"]
    r = interacting_multiple_models({"calm": model}, PRIOR, data, transition=np.eye(1),
                                    backend="vm")  # fmt: skip
    alone = multiple_models({"calm": model}, PRIOR, data, backend="vm").results[0]
    assert_allclose(r.mean, alone.mean, atol=1e-12)
    assert_allclose(r.final[0].mean, alone.final.mean, atol=1e-12)
    assert_allclose(r.final[0].cov, alone.final.cov, atol=1e-12)


def test_any_filter_will_do():
    """On linear modes a square-root unscented filter is the extended one: same mixture."""
    data = _data(20)
    models = _models()
    mixed = {"calm": ukf_step(models["calm"]), "wild": models["wild"]}
    r = interacting_multiple_models(mixed, PRIOR, data, transition=PI, backend="vm")
    e = interacting_multiple_models(models, PRIOR, data, transition=PI, backend="vm")
    assert_allclose(r.log_probability, e.log_probability, atol=1e-8)
    assert_allclose(r.mean, e.mean, atol=1e-9)


def test_rates_follow_the_time_between_samples():
    """Transition matrices exp(Q dt) for steps that differ."""
    dt = np.random.default_rng(1).uniform(0.1, 2.0, 59)
    data = _data(60, dt=dt)
    rates = np.array([[-0.2, 0.2], [0.7, -0.7]])
    r = interacting_multiple_models(_models(), PRIOR, data, rates=rates, backend="vm")
    mu, *_ = imm_by_hand(data, [expm(rates * d) for d in dt], np.array([0.5, 0.5]))
    assert_allclose(r.probability, mu, rtol=1e-7)


def test_static_modes_are_the_exact_mixture():
    """No switching: filters of whole recordings weighed by Bayes' rule, and all histories."""
    data = _data(8)
    r = interacting_multiple_models(_models(), PRIOR, data, transition=np.eye(2), backend="vm")
    m = multiple_models(_models(), PRIOR, data, backend="vm")
    assert_allclose(r.log_probability[:, -1], m.log_probability, atol=1e-10)
    with np.errstate(divide="ignore"):
        p, mean, total = all_histories(data, np.eye(2), np.array([0.5, 0.5]))
    assert_allclose(r.probability[:, -1], p, rtol=1e-9)
    assert_allclose(r.mean[:, -1], mean, rtol=1e-9)
    assert r.loglik == pytest.approx(total, rel=1e-12)
    assert m.best == r.names[r.best[-1]]


@pytest.mark.parametrize("seed", [0, 2])
def test_with_switching_it_is_close_to_all_histories(seed):
    """Merging at each sample is an approximation: a tenth of log-likelihood for each of 6 samples,
    some per cent of probability, half a standard deviation of the state; the rarer the switching,
    the less there is to merge."""
    data = _data(6, seed)

    def both(T):
        r = interacting_multiple_models(_models(), PRIOR, data, transition=T, backend="vm")
        return r, *all_histories(data, T, np.array([0.5, 0.5]))

    r, p, mean, total = both(PI)
    assert_allclose(r.probability[:, -1], p, atol=0.05)
    assert_allclose(r.mean[:, -1], mean, atol=0.3)
    assert r.loglik == pytest.approx(total, abs=0.6)
    rare = 1e-4
    r, p, mean, total = both(np.array([[1 - rare, rare], [rare, 1 - rare]]))
    assert_allclose(r.probability[:, -1], p, atol=1e-3)
    assert r.loglik == pytest.approx(total, abs=1e-2)


def test_two_samples_of_identical_dynamics_are_exact():
    """Modes that differ in nothing: one Kalman filter, and probabilities of the chain alone."""
    models = {"one": _models()["calm"], "other": _models()["calm"]}
    data = _data(30)
    r = interacting_multiple_models(models, PRIOR, data, transition=PI, backend="vm",
                                    prior_probability={"one": 1.0, "other": 0.0})  # fmt: skip
    single = multiple_models({"one": models["one"]}, PRIOR, data, backend="vm")
    assert_allclose(r.mean, single.results[0].mean, atol=1e-10)
    chain = np.array([1.0, 0.0]) @ np.linalg.matrix_power(PI, 29)
    assert_allclose(r.probability[:, -1], chain, rtol=1e-9)


def test_hopeless_modes_neither_vanish_nor_poison():
    """Evidence of 1e-3000 against a mode, then for it: it comes back by its logarithm."""
    names = ("zero", "hundred")
    models = {n: linear(np.eye(1), np.zeros((1, 0)), np.zeros((1, 0)), np.eye(1),
                        np.zeros((1, 0)), [0.0], name=n) for n in names}  # fmt: skip
    x = models["zero"].x
    priors = {"zero": Belief.of(x, {"x0": 0.0}, {"x0": 0.0}),
              "hundred": Belief.of(x, {"x0": 100.0}, {"x0": 0.0})}  # fmt: skip
    y = np.r_[np.zeros(3), np.full(4, 100.0)][None, :]
    data = Recording(np.arange(7.0), np.zeros((0, 7)), y, np.ones((1, 7)), np.zeros(0))
    r = interacting_multiple_models(models, priors, data, transition=np.eye(2), backend="vm")
    assert r.log_probability[1, 2] == pytest.approx(-3 * 5000, rel=1e-12)
    assert r.log_probability[0, -1] == pytest.approx(-5000, rel=1e-12)
    assert r.best.tolist() == [0] * 6 + [1]
    path = r.to_dict()["path"]
    assert [p["mode"] for p in path] == ["zero", "hundred"]


def test_modes_of_different_states():
    """A mode with a third state, driven by nothing and measured by nothing, changes nothing; its
    own belief of it is kept where the other mode has none."""
    small = _models()["calm"]
    A3 = np.block([[A["calm"], np.zeros((2, 1))], [np.zeros((1, 2)), np.eye(1)]])
    big = linear(A3, np.zeros((3, 0)), np.zeros((3, 0)), np.c_[C["calm"], [0, 0]],
                 np.zeros((2, 0)), [*WALK["calm"], 0.0], name="big")  # fmt: skip
    priors = {
        "small": PRIOR,
        "big": Belief.of(big.x, {"x0": 0, "x1": 0, "x2": 3.0}, {"x0": 1, "x1": 1, "x2": 0.5}),
    }
    data = _data(20)
    r = interacting_multiple_models(
        {"small": small, "big": big}, priors, data, transition=PI, backend="vm"
    )
    alone = multiple_models({"small": small}, PRIOR, data, backend="vm").results[0]
    assert r.x.names == ("x0", "x1")
    assert_allclose(r.mean, alone.mean, atol=1e-10)
    assert_allclose(r.variance, alone.variance, rtol=1e-9)
    assert r.final[1]["x2"] == (pytest.approx(3.0), pytest.approx(0.5))


def test_extended_filters_interact():
    """A pendulum whose stiffness falls: two extended filters, the chain finds when.  Static modes
    are again whole filters weighed by Bayes' rule."""
    ss = oscillator()
    model = discretise(ss, walk={"r": 0.02})

    def at(k):
        x, u, _, w, dt = model.symbols()
        p = np.array([k, 0.3])
        return dataclasses.replace(
            model,
            name=f"k{k:g}".replace(".", "_"),
            p=Signals(),
            transition=ca.Function(
                "f", [x, u, ca.MX.sym("p", 0), w, dt], model.transition(x, u, p, w, dt)
            ),
            output=ca.Function("g", [x, u, ca.MX.sym("p", 0), w], model.output(x, u, p, w)),
        )

    rng = np.random.default_rng(3)
    K, onset, dt = 160, 90, 0.05
    x, y = np.array([1.2, 0.0]), np.empty((2, K))
    for k in range(K):
        p = [4.0 if k < onset else 3.0, 0.3]
        y[:, k] = np.array(ss.g(x, 0.5, p)).ravel() + [0.01, 0.1] * rng.standard_normal(2)
        for _ in range(5):
            x = x + dt / 5 * np.array(ss.f(x, 0.5, p)).ravel()
    variance = np.repeat([[1e-4], [1e-2]], K, axis=1)
    data = Recording(dt * np.arange(K), np.full((1, K), 0.5), y, variance, np.zeros(0))
    prior = Belief.of(model.x, {"q": 1.2, "r": 0.0}, {"q": 0.1, "r": 0.1})
    modes = {"stiff": at(4.0), "soft": at(3.0)}
    r = interacting_multiple_models(
        modes, prior, data, rates=[[-0.05, 0.05], [0.05, -0.05]], backend="vm"
    )
    assert (r.best[20:onset] == 0).all()
    assert (r.best[onset + 25 :] == 1).all()
    part = data.part(0, 40)
    static = interacting_multiple_models(modes, prior, part, transition=np.eye(2), backend="vm")
    whole = multiple_models(modes, prior, part, backend="vm")
    assert_allclose(static.log_probability[:, -1], whole.log_probability, atol=1e-8)


def test_logarithms_are_normalised():
    p = log_normalised(np.array([-1e5, -1e5 + math.log(3), -3e5]))
    assert_allclose(np.exp(p), [0.25, 0.75, 0.0], atol=1e-12)
    assert p[2] == pytest.approx(-2e5, rel=1e-4)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"transition": None}, ParameterError, "either transition"),
        ({"transition": np.eye(3)}, ParameterError, "2 x 2"),
        ({"transition": [[0.5, 0.4], [0, 1]]}, ParameterError, "row 'calm'.*sum to 1"),
        ({"transition": None, "rates": [[-1, 1], [1, 1]]}, ParameterError, "row 'wild'.*sum to 0"),
        ({"prior_probability": {"clam": 1}}, ParameterError, "did you mean 'calm'"),
        ({"prior_probability": {"calm": 1}}, ParameterError, "for all of calm, wild"),
    ],
)
def test_refusals(change, error, words):
    with pytest.raises(error, match=words):
        interacting_multiple_models(
            _models(), PRIOR, _data(5), **({"transition": PI, "backend": "vm"} | change)
        )


def test_models_must_fit_together():
    models = _models()
    one = linear(np.eye(2), np.zeros((2, 0)), np.zeros((2, 0)), np.ones((1, 2)), np.zeros((1, 0)),
                 [0, 0], name="one")  # fmt: skip
    with pytest.raises(SignalError, match="differ in y"):
        interacting_multiple_models({**models, "one": one}, PRIOR, _data(5), transition=np.eye(3))
    with pytest.raises(ParameterError, match="no models"):
        multiple_models({}, PRIOR, _data(5))
    other = Belief(Signals([Signal("z", "1", "none of them")]), np.zeros(1), np.eye(1))
    with pytest.raises(SignalError, match="mode 'wild': prior of z"):
        interacting_multiple_models(models, {"calm": PRIOR, "wild": other}, _data(5), transition=PI)


def test_a_lost_mode_is_named():
    """A mode whose transition overflows is told by name, with the instant."""
    models = _models()
    burst = linear(np.eye(2) * 1e200, np.zeros((2, 0)), np.zeros((2, 0)), C["calm"],
                   np.zeros((2, 0)), [0, 0], name="burst")  # fmt: skip
    with pytest.raises(EstimationError, match="mode 'burst' at t = "):
        interacting_multiple_models(
            {"calm": models["calm"], "burst": burst}, PRIOR, _data(9), transition=PI, backend="vm"
        )


# ------------------------------------------------------------------------------ smoother

EXACT = dict(rtol=1e-9, atol=1e-10)


def smoothed(models, data, T, prior=PRIOR, **how):
    """Filter, then smooth."""
    r = interacting_multiple_models(
        models, prior, data, transition=T, full=True, backend="vm", **how
    )
    return r, imm_smoother(r)


def smoothed_histories(data, T):
    """Smoothed probability of the second mode, mean and variance, by each of the 2^K histories."""
    names, K = list(A), data.size
    logs, means, variances, paths = [], [], [], np.array([*itertools.product(range(2), repeat=K)])
    for path in paths:
        m, P, ll, known = PRIOR.mean, PRIOR.cov, np.log(0.5), []
        for k, j in enumerate(path):
            before = m, P
            m, P, gain = _update(names[j], m, P, data.y[:, k])
            ll += gain + (np.log(T[j, path[k + 1]]) if k + 1 < K else 0.0)
            known.append((*before, m, P))
            m, P = _predict(names[j], m, P, data.dt[k])
        m, P = known[-1][2:]
        mean, variance = [m], [P.diagonal()]
        for k in range(K - 2, -1, -1):
            m1, P1, *_ = known[k + 1]
            _, _, mf, Pf = known[k]
            G = Pf @ A[names[path[k]]].T @ np.linalg.inv(P1)
            m, P = mf + G @ (m - m1), Pf + G @ (P - P1) @ G.T
            mean.insert(0, m)
            variance.insert(0, P.diagonal())
        logs.append(ll)
        means.append(np.array(mean).T)
        variances.append(np.array(variance).T)
    w = np.exp(np.array(logs) - logsumexp(logs))
    mean = np.einsum("h,hik->ik", w, means)
    return w @ paths, mean, np.einsum("h,hik->ik", w, variances + (means - mean) ** 2)


@pytest.mark.parametrize("make", [lambda m: m, ukf_step], ids=["ekf", "ukf"])
def test_one_mode_is_the_plain_smoother(make):
    """More samples than a block holds, a gap."""
    data, model = _data(120), _models()["wild"]
    _, s = smoothed({"only": make(model)}, data, np.eye(1))
    f = extended_kalman_filter(model, PRIOR, data, full=True, backend="vm")
    true = rts_smoother(f)
    assert_allclose(s.mean, true.mean, **EXACT)
    assert_allclose(s.variance, true.variance, **EXACT)
    assert_allclose(s.modes[0].cov, true.cov, **EXACT)


def test_static_modes_are_the_exact_mixture_of_smoothers():
    """Whole smoothers weighed by Bayes' rule; a mode's probability is the same at all instants."""
    data = _data(9)
    _, s = smoothed(_models(), data, np.eye(2))
    m = multiple_models(_models(), PRIOR, data, full=True, backend="vm")
    w = np.exp(m.log_probability)
    each = [rts_smoother(r) for r in m.results]
    mean = sum(wi * e.mean for wi, e in zip(w, each, strict=True))
    assert_allclose(s.probability, np.repeat(w[:, None], 9, axis=1), rtol=1e-8)
    assert_allclose(s.mean, mean, **EXACT)
    variance = sum(wi * (e.variance + (e.mean - mean) ** 2) for wi, e in zip(w, each, strict=True))
    assert_allclose(s.variance, variance, **EXACT)


def test_modes_that_differ_in_nothing_are_one_smoother_and_a_chain():
    """No sample tells them apart: the chain's own probabilities, forwards and backwards."""
    model, data = _models()["calm"], _data(30)
    how = {"prior_probability": {"one": 0.9, "other": 0.1}}
    r, s = smoothed({"one": model, "other": model}, data, PI, **how)
    f = extended_kalman_filter(model, PRIOR, data, full=True, backend="vm")
    assert_allclose(s.mean, rts_smoother(f).mean, **EXACT)
    assert_allclose(s.variance, rts_smoother(f).variance, **EXACT)
    assert_allclose(s.probability, r.probability, rtol=1e-9)


def test_the_smoother_with_switching_is_near_all_histories():
    """Merging is the only approximation: over six recordings the probability errs by 2 % where the
    filter's is 12 % off, the mean by a fifth of a standard deviation."""
    off, filtered, sigmas = [], [], []
    for seed in range(6):
        data = _data(5, seed)
        p, mean, variance = smoothed_histories(data, PI)
        r, s = smoothed(_models(), data, PI)
        off.append(np.abs(s.probability[1] - p))
        filtered.append(np.abs(r.probability[1] - p))
        sigmas.append(np.abs(s.mean - mean) / np.sqrt(variance))
    assert np.mean(off) < 0.03 < 0.08 < np.mean(filtered)
    assert np.mean(sigmas) < 0.2


def test_a_mode_with_a_state_of_its_own_is_smoothed():
    """A third state that one mode has alone, of its own noise only: smoothed by its own mode."""
    small = _models()["calm"]
    A3 = np.block([[A["calm"], np.zeros((2, 1))], [np.zeros((1, 2)), np.eye(1)]])
    none = np.zeros((3, 0))
    C3 = np.c_[np.eye(2), [0, 0]]
    big = linear(A3, none, none, C3, np.zeros((2, 0)), [*small.walk, 0.0], name="big")
    priors = {
        "small": PRIOR,
        "big": Belief.of(big.x, {"x0": 0, "x1": 0, "x2": 3.0}, {"x0": 1, "x1": 1, "x2": 0.5}),
    }
    data = _data(20)
    _, s = smoothed({"small": small, "big": big}, data, PI, prior=priors)
    f = extended_kalman_filter(small, PRIOR, data, full=True, backend="vm")
    true = rts_smoother(f)
    assert_allclose(s.mean, true.mean, **EXACT)
    assert_allclose(s.variance, true.variance, **EXACT)
    assert_allclose(s.mode_mean[1][2], 3.0, rtol=1e-12)
    assert_allclose(s.modes[1].cov[:, 2, 2], 0.25, rtol=1e-12)


def test_what_smoothing_lacks_is_told():
    r = interacting_multiple_models(_models(), PRIOR, _data(5), transition=PI, backend="vm")
    with pytest.raises(EstimationError, match="full=True"):
        imm_smoother(r)
    wide = Belief(PRIOR.x, np.zeros(2), 1e18 * np.array([[1.0, 1 - 1e-13], [1 - 1e-13, 1.0]]))
    silent = _data(2)
    silent.y[:, 0] = np.nan
    with pytest.raises(EstimationError, match=r"mode 'calm' at t = .*no digits left"):
        smoothed(_models(), silent, PI, prior=wide)
