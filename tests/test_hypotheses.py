"""A short circuit that may be there: odds, severity and power, against quadrature."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from apu_casadi.core.errors import ParameterError
from estimators.apu.electrical.hypotheses import (
    COMMON,
    FAULTY,
    H_SCALE,
    Hypotheses,
    SeverityPrior,
    loose_in_common,
)
from estimators.apu.unknowns import COPPER, UNKNOWNS, Knowledge, filter_unknowns
from estimators.information.posterior import named_posterior, posterior

TRUE_P, SLOPE = 200e3, 2e7


def belief(h, seed=0):
    """A filter's means and covariance of three severities and power, errors drawn."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 4)) + 2 * np.eye(4)
    A[:3] *= 2e-5
    A[3] = 300 * A[3] + SLOPE * A[:3].sum(0)
    C = A @ A.T
    return np.array([*h, TRUE_P]) + A @ rng.standard_normal(4), C


@pytest.mark.parametrize("h", [(0, 0, 0), (8e-5, 0, 0), (0, 0, 5e-4)])
def test_odds_severity_and_power_are_those_of_quadrature(h):
    mean, C = belief(h)
    found = Hypotheses.of(mean[None], C[None])
    none = multivariate_normal.pdf(mean[:3], np.zeros(3), C[:3, :3])
    for k in range(3):

        def weight(x, k=k):
            at = np.zeros(3)
            at[k] = x
            prior = 2 * np.exp(-((x / H_SCALE) ** 2) / 2) / (H_SCALE * np.sqrt(2 * np.pi))
            return prior * multivariate_normal.pdf(mean[:3], at, C[:3, :3])

        # the power goes with the errors of the severities
        gain = np.linalg.solve(C[:3, :3], C[:3, 3])
        best, s = float(found.h[k, 0]), float(np.sqrt(found.variance[k, 0]))
        end = max(best, 0) + 12 * s
        total = quad(weight, 0, end, points=[max(best, 0)], epsrel=1e-10)[0]
        odds = total / none * FAULTY / 3 / (1 - FAULTY)
        assert_allclose(found.odds[k, 0], np.log(odds), atol=1e-6)
        # of a severity far from zero, the prior's bound at zero is not felt
        if best > 6 * s:
            m = quad(lambda x: x * weight(x), 0, end, points=[best], epsrel=1e-10)[0] / total
            assert_allclose(best, m, rtol=1e-6)
            error = mean[:3] - np.eye(3)[k] * best
            assert_allclose(found.P[k, 0], mean[3] - gain @ error, rtol=1e-9)


def test_the_mean_over_the_hypotheses_holds_what_they_differ_by():
    """The mixture's mean and variance, by its samples."""
    mean, C = belief((9e-5, 0, 0))
    found = Hypotheses.of(mean[None], C[None])
    got, spread = found.power()
    rng = np.random.default_rng(1)
    of = (
        np.append(first, more[:, 0])
        for first, more in zip(found.healthy[:, 0], (found.P, found.P_variance), strict=True)
    )
    P, sigma = next(of), np.sqrt(next(of))
    which = rng.choice(4, 200_000, p=found.probability[:, 0])
    drawn = P[which] + sigma[which] * rng.standard_normal(which.size)
    assert_allclose(got[0], drawn.mean(), atol=5 * drawn.std() / np.sqrt(which.size))
    assert_allclose(spread[0], drawn.var(), rtol=0.02)


def test_the_power_of_a_healthy_machine_is_what_is_left_of_its_error():
    """Errors of severities and power are jointly normal: what h tells of P is taken off."""
    draws = [belief((0, 0, 0), seed) for seed in range(400)]
    of = (Hypotheses.of(m[None], C[None]).healthy[:, 0] for m, C in draws)
    z = np.array([(P - TRUE_P) / np.sqrt(V) for P, V in of])
    assert abs(z.mean()) < 4 / 20 and z.std() == pytest.approx(1, abs=4 / np.sqrt(800))
    m, C = draws[0]
    assert Hypotheses.of(m[None], C[None]).healthy[1, 0] < C[3, 3]


def test_a_prior_of_the_severity_moves_odds_and_estimate():
    """By quadrature again, of a normal prior that is cut off at zero."""
    mean, C = belief((3e-5, 0, 0))
    prior = SeverityPrior(0.3, (1e-4, 0.0, 0.0), (3e-5, 1e-3, 1e-3))
    found = Hypotheses.of(mean[None], C[None], prior)

    def weight(x):
        of = multivariate_normal.pdf(mean[:3], (x, 0, 0), C[:3, :3])
        return of * norm.pdf(x, 1e-4, 3e-5) / norm.cdf(1e-4 / 3e-5)

    total = quad(weight, 0, 4e-4, points=[1e-4], epsrel=1e-10)[0]
    none = multivariate_normal.pdf(mean[:3], np.zeros(3), C[:3, :3])
    assert_allclose(found.odds[0, 0], np.log(total / none * 0.1 / 0.7), atol=1e-6)
    assert found.h[0, 0] > Hypotheses.of(mean[None], C[None]).h[0, 0]
    sure = SeverityPrior(1e-6)
    few = Hypotheses.of(mean[None], C[None], sure).probability[1:].sum()
    assert few < Hypotheses.of(mean[None], C[None]).probability[1:].sum()


def test_one_faulty_phase_leaves_no_misfit_and_two_do():
    """Chi-squared with two degrees of freedom, mean 2; far more for three phases."""
    draws = [belief((3e-4, 0, 0), seed) for seed in range(300)]
    means, covs = (np.array(x) for x in zip(*draws, strict=True))
    assert Hypotheses.of(means, covs).misfit.mean() == pytest.approx(2.0, abs=0.6)
    two = means + np.array([0, 1e-3, 1e-3, 0])
    assert np.median(Hypotheses.of(two, covs).misfit) > 20


def test_what_is_known_of_parameters():
    assert Knowledge.temperature(20.0).sigma == pytest.approx(20 * COPPER)
    # a stator at the limit of its class, known as at 20 C, is within four deviations
    stator = UNKNOWNS["machine.r_s"]
    assert stator.how == "considered"
    assert stator.sigma == pytest.approx(COPPER * 160 / np.sqrt(12))
    assert 4 * stator.sigma > 160 * COPPER
    of = filter_unknowns({"machine.L_md": Knowledge("considered", 0.05), "J": Knowledge("known")})
    assert of["machine.L_md"][0].consider and of["machine.L_md"][1] == 0.05 and len(of) == 1


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Knowledge("guessed", 0.1), "guessed"),
        (lambda: Knowledge("known", 0.1), "0 for what is known"),
        (lambda: Knowledge("considered"), "a share of the value > 0"),
        (lambda: filter_unknowns({"machine.L_nd": Knowledge("considered", 0.1)}), "L_md"),
        (lambda: filter_unknowns({"machine.r_s": Knowledge("estimated", 0.1)}), "consider it"),
        (lambda: filter_unknowns({"machine.eta_sg": Knowledge("estimated", 0.1)}), "consider it"),
        (lambda: SeverityPrior(1.0), "a probability in"),
        (lambda: SeverityPrior(mean=(0, -1e-4, 0)), "means >= 0"),
        (lambda: SeverityPrior(scale=(0, 1e-4, 1e-4)), "scale = 0"),
    ],
)
def test_wrong_knowledge_is_refused(make, words):
    with pytest.raises(ParameterError, match=words):
        make()


def test_what_severities_have_in_common_counts_for_little():
    """Shifted along their regression on it, severities and power say the same as before."""
    mean, C = belief((2e-4, 0, 0))
    more = np.block([[C, np.zeros((4, 2))], [np.zeros((2, 4)), np.eye(2)]])
    loose = loose_in_common(np.array([more]))
    e = np.repeat([1 / 3, 0], [3, 3])
    assert_allclose(e @ loose[0] @ e, e @ more @ e + COMMON**2)
    of = loose[:, :4, :4]
    g = of[0] @ e[:4] / (e[:4] @ of[0] @ e[:4])
    before, after = (Hypotheses.of(m[None], of) for m in (mean, mean - 1e-4 * g))
    tight = [Hypotheses.of(m[None], C[None]).misfit[0] for m in (mean, mean - 1e-4 * g)]
    assert abs(after.misfit[0] - before.misfit[0]) < 0.3 * abs(tight[1] - tight[0])


def test_probabilities_of_hypotheses_from_logarithms():
    """Of any size, also where nothing but one is possible."""
    log = np.log([0.1, 0.7, 0.2])
    assert_allclose(posterior(log - 1e6), [0.1, 0.7, 0.2], rtol=1e-9)
    assert_allclose(posterior(np.array([[0.0, -np.inf], [0.0, 5.0]])), [[0.5, 0.0], [0.5, 1.0]])
    found = named_posterior({"a": float(np.log(3.0)), "b": 0.0, "c": np.nan, "d": -np.inf})
    assert found == pytest.approx({"a": 0.75, "b": 0.25, "c": 0.0, "d": 0.0})
