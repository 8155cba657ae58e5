"""Short circuits that grow, with exact sensors: followed within their bands."""

from __future__ import annotations

import numpy as np
import pytest

from apu_casadi.core.backend import use_backend
from apu_casadi.machine.loads.series import SeriesLoad
from estimators.apu.electrical import tracking
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.electrical.growing import Moving, motion
from estimators.apu.electrical.tracking import track
from estimators.apu.electrical.tuning import GROWTH_SPANS
from scenarios.studies.electrical.truth import chances, generator_truth, samples_of

ONSET = 1000  # samples of 0.1 ms


@pytest.fixture(autouse=True)
def _vm():
    """Nothing is compiled for some thousand samples."""
    with use_backend("vm"):
        yield


def tracked(course, seed, monkeypatch=None):
    """A severity of phase b that goes a course, tracked, with or without rates."""
    rng = np.random.default_rng(seed)
    base = generator_truth(SeriesLoad.from_power(100e3), (course.size - 1) * 1e-4)
    h = np.zeros((3, base.t.size))
    h[1] = course
    filt = electrical_filter()
    samples = samples_of(chances(base, rng, h=h), rng)
    data, prior = filt.recording(samples), filt.prior(samples)
    if monkeypatch is not None:
        monkeypatch.setattr(tracking, "can_grow", lambda _: False)
    return track(filt, prior, data)[0]


def grown(samples, slope):
    t = np.arange(samples) * 1e-4
    return slope * np.maximum(t - ONSET * 1e-4, 0.0)


def test_a_severity_that_grows_is_followed(monkeypatch):
    """By 0.016 a second: found when it is 1.6e-4, then four standard deviations off at most.

    The filter of constant severities is 5 off in the mean; what it says before the growth is the
    same to the last bit, but for what three standard deviations of motion in noise widen.
    """
    course = grown(2000, 0.016)
    r, old = tracked(course, 1), tracked(course, 1, monkeypatch)
    h, sigma = r["h_b"]
    assert np.flatnonzero(h > 5 * sigma)[0] < ONSET + 110
    late = slice(ONSET + 150, None)
    assert np.abs((h - course) / sigma)[late].max() < 4
    was, claimed = old["h_b"]
    assert np.sqrt(np.mean(((was - course) / claimed)[ONSET:] ** 2)) > 4
    first = slice(None, ONSET)
    assert (r.mean[:, first] == old.mean[:, first]).all()
    assert (r.nis[first] == old.nis[first]).all()
    assert (r.variance[:, first] == old.variance[:, first]).mean() > 0.99
    # the rates are no states of what is returned
    assert r.x.names == old.x.names == r.final.x.names


@pytest.mark.parametrize("chunk", [50, 94])
def test_it_does_not_matter_where_pieces_begin(chunk, monkeypatch):
    """Growth may show, and end, at the first sample of a piece.

    So short ones see the beginning of growth only, and take it for slower: 1.8 sigma of error.
    """
    course = np.minimum(grown(3500, 0.016), 5e-4)
    monkeypatch.setattr(tracking, "CHUNK", chunk)
    r = tracked(course, 1)
    h, sigma = r["h_b"]
    assert r.t.size == course.size
    assert (np.diff(r.t) > 0).all()
    assert np.sqrt(np.mean(((h - course) / sigma)[ONSET:] ** 2)) < 2.5


def test_rest_is_found_again():
    """A tenth of a second after growth has ended, severities are taken for constant again."""
    course = np.minimum(grown(5000, 0.01), 5e-4)
    h, sigma = (a[-1] for a in tracked(course, 3)["h_b"])
    assert h == pytest.approx(5e-4, abs=4 * sigma)
    # 3.9e-6 of the walk alone, 1e-5 while rates are states
    assert sigma < 5e-6


def test_motion_of_a_scalar_filter():
    """A Kalman filter of a walk that meets a ramp: by how much it is behind.

    The lag that is told of a ramp is that of the filter within a fifth, while the span is short of
    its memory, 150 samples; of walk and noise alone nothing is certain.
    """
    rng = np.random.default_rng(4)
    q, r, dt, n, runs = 2e-5, 3e-5, 1e-4, 700, 60
    slope = 0.05
    begin = 500
    truth = slope * np.maximum(np.arange(n) - begin, 0) * dt

    def filtered(y):
        m, P, out = np.zeros(runs), 1e-10, []
        for k in range(n):
            K = P / (P + r**2)
            m, P = m + K * (y[:, k] - m), (1 - K) * P
            out.append((m, P))
            P += q**2 * dt
        return np.array([a for a, _ in out]).T, np.array([b for _, b in out])

    walk = np.cumsum(rng.normal(0, q * np.sqrt(dt), (runs, n)), axis=1)
    noise = walk + rng.normal(0, r, (runs, n))
    t = np.arange(n) * dt
    still, variance = filtered(noise)
    moving, _ = filtered(noise + truth)
    wide = np.broadcast_to(variance, still.shape)
    told = motion(Moving(t, moving, wide), q, 100)
    at = begin + 60
    lag = (truth + walk - moving)[:, at]
    shown = told.behind[:, at] != 0
    assert shown.all()
    assert told.behind[:, at].mean() == pytest.approx(lag.mean(), rel=0.2)
    assert told.at is not None
    assert begin < told.at < at
    assert told.span in GROWTH_SPANS
    assert motion(Moving(t, still[:3], wide[:3]), q, 100).at is None
