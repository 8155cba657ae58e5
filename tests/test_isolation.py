"""Isolation of faults: evidence by quadrature, kappa by its definition, truth against the trim.

Cohen's kappa: the example of Cohen (1960), Educ. Psychol. Meas. 20, 37-46, with kappa 0.492.
"""

import dataclasses
import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import integrate

from apu_casadi.core.backend import use_backend
from apu_casadi.core.errors import ParameterError
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from estimators.apu.isolation.classifiers import isolate, recording_of
from estimators.apu.isolation.evidence import log_box
from estimators.apu.isolation.limit import (
    information_limit,
    linear_problem,
    white_signatures,
)
from estimators.apu.isolation.problem import (
    CLASSES,
    DEFAULT,
    FAULTS,
    SNAPSHOT,
    Protocol,
    severity_of_loss,
)
from estimators.apu.isolation.scores import cohen_kappa, scores
from estimators.apu.isolation.truth import simulate_windows, windows_of_engines
from estimators.apu.isolation.windowmodel import model_of
from scenarios.studies.estimation import isolation

SHORT = Protocol(before=0.4, after=0.8, spread=0.2)
BY_NAME = {c.name: i for i, c in enumerate(CLASSES)}


@pytest.fixture(scope="module", autouse=True)
def interpreted():
    """Nothing is compiled for a test."""
    with use_backend("vm"):
        yield


@pytest.fixture(scope="module")
def gg():
    return GasGenerator()


# ------------------------------------------------------------------------------ evidence


@pytest.mark.parametrize(("b", "C"), [(0.3, 2.0), (25.0, 9.0), (-6.0, 0.4), (0.0, 1e-9)])
def test_evidence_of_one_size(b, C):
    """The mean of exp(b s - C s^2/2) over two intervals, by adaptive quadrature."""
    boxes = [(np.array([-4.0]), np.array([-1.0])), (np.array([1.0]), np.array([4.0]))]
    direct = [integrate.quad(lambda s: math.exp(b * s - C * s * s / 2), lo[0], hi[0],
                             epsabs=0, epsrel=1e-10)[0] for lo, hi in boxes]  # fmt: skip
    got = log_box(np.array([b]), np.array([[C]]), boxes)
    assert got == pytest.approx(math.log(np.mean(direct) / 3), abs=1e-8)


def test_evidence_of_two_sizes():
    C = np.array([[6.0, 2.5], [2.5, 3.0]])
    b = np.array([8.0, -3.0])
    boxes = [(np.array([1.0, -4.0]), np.array([4.0, -1.0])),
             (np.array([1.0, 1.0]), np.array([4.0, 4.0]))]  # fmt: skip

    def density(s2, s1):
        s = np.array([s1, s2])
        return math.exp(b @ s - s @ C @ s / 2)

    direct = [integrate.dblquad(density, lo[0], hi[0], lo[1], hi[1], epsabs=1e-10)[0]
              for lo, hi in boxes]  # fmt: skip
    assert log_box(b, C, boxes) == pytest.approx(math.log(np.mean(direct) / 9), abs=1e-6)


def test_evidence_far_in_the_tail_and_very_sharp():
    """Ten thousand standard deviations away the nearest edge decides: -(distance/sigma)^2/2 left
    of it, and the edge's slope; a sharp peak inside is its height over the volume."""
    C = np.array([[1e8]])
    box = [(np.array([1.0]), np.array([4.0]))]
    far = log_box(np.zeros(1), C, box)
    assert far == pytest.approx(-1e8 / 2 - math.log(1e8) - math.log(3), rel=1e-10)
    inside = log_box(np.array([2e8]), C, box)
    assert inside == pytest.approx(2e8 + 0.5 * math.log(2 * math.pi / 1e8) - math.log(3), rel=1e-12)
    two = log_box(np.array([2e8, 3e8]), 1e8 * np.eye(2), [(np.ones(2), 4 * np.ones(2))])
    alone = inside + log_box(np.array([3e8]), C, box)
    assert two == pytest.approx(alone, rel=1e-13, abs=1e-6)


@pytest.mark.parametrize("scale", [1.0, 30.0, 1e3])
@pytest.mark.parametrize("mean", [(2.5, 2.0), (0.5, 2.0), (2.0, 6.0), (0.0, 0.0), (7.0, -3.0)])
def test_evidence_of_two_sizes_anywhere(mean, scale):
    """Peak inside, beyond an edge, beyond a corner; wide and sharp: which size is integrated
    first must not matter."""
    C = scale**2 * np.array([[1.0, 0.6], [0.6, 0.9]])
    b = C @ mean
    box = [(np.array([1.0, 1.0]), np.array([4.0, 4.0]))]
    one = log_box(b, C, box)
    other = log_box(b[::-1], C[::-1, ::-1], box)
    assert one == pytest.approx(other, rel=1e-12, abs=1e-7)


def test_evidence_at_the_sharpness_of_the_study(gg):
    """Two sizes at the information that the best window holds: quadrature must not miss it."""
    f = linear_problem(3e5, 0.0, DEFAULT, gg)
    G = white_signatures(f, np.array([DEFAULT.first]))[0]
    for name in ("compressor pair", "turbine pair"):
        c = CLASSES[BY_NAME[name]]
        i = [FAULTS.index(n) for n in c.faults]
        C = (G.T @ G)[np.ix_(i, i)]
        lo, hi = c.boxes[0]
        for t in np.linspace(0.3, 0.7, 5):
            s = lo + t * (hi - lo)
            got = log_box(C @ s, C, [(lo, hi)])
            # well inside the box the integral is that of the whole Gaussian
            whole = s @ C @ s / 2 + math.log(2 * math.pi) - np.linalg.slogdet(C)[1] / 2
            assert got == pytest.approx(whole - np.log(hi - lo).sum(), abs=1e-5), name


def test_classes_cover_what_they_draw():
    rng = np.random.default_rng(0)
    for c in CLASSES:
        mean, var = c.normal()
        assert set(c.faults) <= set(FAULTS)
        for _ in range(50):
            s = c.draw(rng)
            v = np.array([s[f] for f in c.faults])
            assert any(((lo <= v) & (v <= hi)).all() for lo, hi in c.boxes)
            assert (np.abs(v - mean) < 3 * np.sqrt(var)).all()
    assert len(CLASSES[BY_NAME["turbine pair"]].boxes) == 2


# ------------------------------------------------------------------------------ scores


def test_kappa_of_the_literature():
    """Cohen (1960): proportions .44 .07 .09; .05 .20 .05; .01 .03 .06; and the two extremes."""
    c = np.array([[88, 14, 18], [10, 40, 10], [2, 6, 12]])
    po, pe = 140 / 200, (120 * 100 + 60 * 60 + 20 * 40) / 200**2
    kappa, low, high = cohen_kappa(c)
    assert kappa == pytest.approx((po - pe) / (1 - pe)) == pytest.approx(0.492, abs=6e-4)
    assert low < kappa < high
    # the interval's width is near that of the usual standard error sqrt(po(1-po)/n)/(1-pe)
    assert (high - low) / 2 == pytest.approx(
        1.96 * math.sqrt(po * (1 - po) / 200) / (1 - pe), rel=0.05
    )
    assert cohen_kappa(np.eye(3) * 10)[0] == 1 == cohen_kappa(np.eye(3) * 10)[2]
    assert cohen_kappa(np.eye(3) * 10)[1] < 0.85
    assert cohen_kappa(np.full((3, 3), 5))[0] == pytest.approx(0, abs=1e-12)


# ------------------------------------------------------------------------------ the linear problem


def test_signatures_are_the_steady_sensitivities(gg):
    """A gain error shows as that reading alone in the first innovation; a health factor as the
    output's derivative at fixed speed, fuel and power, here by differences of the cycle."""
    f = linear_problem(3e5, 0.0, SHORT, gg)
    k = SHORT.first
    first = f.signature(k, k + 1)[0]
    point = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": 3e5}, dT_isa=0.0)
    P3 = FAULTS.index("gain_P3")
    assert_allclose(first[:, P3], [0, point["P3"], 0, 0, 0], rtol=1e-9, atol=1e-9)
    d = 1e-5
    for i, name in enumerate(FAULTS[:4]):
        theta = np.ones(4)
        theta[i] += d
        y = np.array(gg.state_space.g(point.x, point.u, theta)).ravel()
        change = [(y[gg.Y.index(n)] - point[n]) / d for n in ("P3", "T3", "T5")]
        assert_allclose(first[1:4, i], change, rtol=2e-3, err_msg=name)
    loss = FAULTS.index("loss")
    assert first[4, loss] == pytest.approx(severity_of_loss())


def test_severity_of_a_loss_is_that_of_the_shunt(gg):
    """r_s/h from terminal to neutral at 230 V takes half of 0.9 times the shaft power lost."""
    h = severity_of_loss()
    assert 2 * h * 230.0**2 / 0.0044 / 0.9 == pytest.approx(500e3)


def test_the_limit_between_all_and_nothing(gg):
    """Little noise: all right, or nearly; noise that hides everything: no better than chance."""
    clear = information_limit(6, 1, dataclasses.replace(SHORT, noise=0.2), gg, points=1)
    assert clear["kappa"] > 0.97
    blind = dataclasses.replace(SHORT, noise=1e3)
    assert abs(information_limit(20, 1, blind, gg, points=1)["kappa"]) < 0.2
    json.dumps(clear)


def test_knowing_the_onset_does_not_harm(gg):
    """Same draws cannot be had; with 220 each, kappa differs by more than 0.1 only if it should."""
    hard = dataclasses.replace(SHORT, noise=4.0)
    known = information_limit(20, 3, hard, gg, points=1, onset_known=True)["kappa"]
    unknown = information_limit(20, 3, hard, gg, points=1)["kappa"]
    assert known > unknown - 0.1


# ------------------------------------------------------------------------------ truth, classifiers


def _quiet(protocol):
    return dataclasses.replace(protocol, noise=1e-9, baseline=1e-9)


@pytest.mark.long
def test_truth_ends_at_the_trim(gg):
    """Two routes to the faulty unit's steady state: simulated, and trimmed with its health.  The
    load wanders by half a per cent in a second, so the ends agree to that."""
    p = _quiet(Protocol(before=0.1, after=2.0, spread=0.0))
    label = BY_NAME["turbine efficiency"]
    w = simulate_windows([label], [3], p, gg)
    size = w.sizes[0]["f_eta_t"]
    N, P3, T3, T5, _, Wf, PW = w.reading[:, 0, -1]
    point = trim_gas_generator(
        gg, {"N": N, "PW": PW}, theta={"f_eta_t": 1 + size}, dT_isa=w.ambient[2, 0]
    )
    assert pytest.approx(gg.parameters.N, rel=2e-3) == N
    for name, v, tol in (("Wf", Wf, 0.02), ("P3", P3, 3e-3), ("T3", T3, 2e-3), ("T5", T5, 0.015)):
        assert v == pytest.approx(point[name], rel=tol), name
    before = w.reading[:, 0, 0]
    assert (T5 - before[3]) / before[3] > 0.8 * 1.5 * abs(size) - 0.06


def test_a_window_is_its_seed(gg):
    """What a window holds depends on its own seed and label alone."""
    p = Protocol(before=0.04, after=0.04, spread=0.02)
    both = simulate_windows([1, 8], [11, 12], p, gg)
    one = simulate_windows([8], [12], p, gg)
    assert_allclose(one.reading[:, 0], both.reading[:, 1], rtol=1e-12)
    again = windows_of_engines(np.array([1, 8]), np.array([11, 12]), p, [gg, gg])
    assert_allclose(again.reading, both.reading, rtol=1e-12)
    assert again.sizes == both.sizes


@pytest.mark.long
def test_one_filter_tells_a_clear_fault(gg):
    """An eighth of the noise: the class, its onset and healthy consistency, by the ratio alone."""
    p = dataclasses.replace(SHORT, noise=0.125)
    label = BY_NAME["T5 sensor"]
    w = simulate_windows([label], [5], p, gg)
    v = isolate(recording_of(model_of(gg, p.N_walk), w, 0, p), p, gg, methods=["glr"])
    assert int(np.argmax(v.log_probability["glr"])) == label
    assert abs(v.onset - w.onset[0]) <= p.every
    assert np.exp(v.log_probability["glr"]).sum() == pytest.approx(1)
    assert 0.7 < v.nis < 1.4


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Protocol(after=0.0), "Protocol.after must be > 0"),
        (lambda: Protocol(before=-1.0), "Protocol.before must be >= 0"),
        (lambda: Protocol(every=0), "at least|must be >= 1"),
        (lambda: cohen_kappa(np.zeros((2, 2))), "empty confusion"),
        (lambda: cohen_kappa(np.array([[5, 0], [0, 0]])), "not defined"),
        (lambda: log_box(np.ones(3), np.eye(3), []), "one or two sizes"),
        (lambda: isolate(None, methods=["glp"]), "did you mean 'glr'"),
        (lambda: isolation.watched("watchd", GasGenerator()), "did you mean 'watched'"),
    ],
)
def test_refusals(call, words):
    with pytest.raises(ParameterError, match=words):
        call()


def test_every_sweep_has_its_curve():
    """Figures of a result of the right form, whatever its numbers."""
    s = scores(5 * np.eye(len(CLASSES), dtype=int))
    result = {
        **{name: {"bank": s, "limit": s} for name in isolation.STUDIES},
        "sweeps": {
            name: [{"change": c, "value": v, "kappa": 0.9, "kappa_95": [0.8, 0.95]}
                   for c, values in changes.items() for v in values]
            for name, _, changes in isolation.SWEEPS
        },
    }  # fmt: skip
    made = dict(isolation.figures(result).values())
    assert set(made) == {"estimation_confusion.png", "estimation_limit.png"}
    curves = made["estimation_limit.png"]().axes
    assert [len(ax.lines[-1].get_xdata()) for ax in curves] == [6, 5, 5, 6]


@pytest.mark.slow
def test_the_study_on_a_few_windows():
    """Goal 6 of the estimation work on 22 windows: kappa 0.8 at least, near the limit."""
    with use_backend("c"):
        r = isolation.isolation_study(2, 5000, limit_draws=20, limit_points=1)
        lost = isolation.isolation_study(2, 5000, SNAPSHOT, limit_draws=20, limit_points=1)
    json.dumps([r, lost])
    for m in ("glr", "bank", "limit"):
        assert r[m]["kappa"] >= 0.8, m
        assert lost[m]["kappa"] < 0.8, m
    assert 0.9 < r["nis"] < 1.1
