"""Loads and faults that change in time, propagated with interpolated tables, against CVODES."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core import simulation
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.means import Term, wanted
from apu_casadi.core.profiles.points import Points
from apu_casadi.core.profiles.profile import at, varying
from apu_casadi.core.profiles.shapes import Growth, Ramp
from apu_casadi.machine import meanstep, transition
from apu_casadi.machine.course import MOST_TERMS, TERMS, Course, Piece
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator
from apu_casadi.unit.integrators import WAVEFORMS
from apu_casadi.unit.stepmeans import MEANS

GEN = Generator()
W = GEN.machine.w_rated
DT = 0.02
QUAD = (*MEANS, *wanted(phasors=True, short=True, symmetric=False))
KW100 = SeriesLoad.from_power(100e3)
RAMP = varying(SeriesLoad.from_power, Ramp(100e3, 200e3, over=60.0), 0.9)
GROWN = varying(Ttsc.of_h, 0.05, Growth(1e-5, 0.01, over=10.0))


def course_of(load, fault, *, end=60.0, waves=False):
    """The course of a load and a fault, beside the variant of its beginning."""
    ss = GEN.variant(at(load, 1.0), at(fault, 1.0))

    def prepare(u, theta, harmonics):
        if waves:
            more = {"n_out": 400, "outputs": WAVEFORMS, "quad": MEANS}
            return Propagator(GEN, ss, u, theta, dt=DT, harmonics=harmonics, **more)
        return MeanStep(GEN, ss, u, theta, dt=DT, quad=QUAD, harmonics=harmonics)

    usual = 0 if waves else meanstep.USUAL
    return Course(GEN, ss, load, fault, prepare, end, usual=usual)


def settled_at(ss, load, fault, V_ref):
    """State some time after the switch to load and fault from a steady start."""
    point = GEN.steady_state(KW100, theta_e=0.3)
    u, theta = GEN.inputs(load, V_ref=V_ref), GEN.fault_vector(load, fault)
    x = GEN.transfer(point.x, point.ss, ss, u=point.u, theta=[], u_target=u, theta_target=theta)
    return simulation.stepper(ss, 1, rtol=1e-10, atol=1e-12)(x, u, theta, 0.3).x_end.copy()


def followed(load, fault, begin, steps=6, waves=False):
    """Steps by interpolated tables, and by CVODES with the very numbers; largest errors of both."""
    course = course_of(load, fault, waves=waves)
    ss, V_ref = course.ss, GEN.V_ref_default
    t = begin + DT * (np.arange(steps) + 0.5)
    quad = MEANS if waves else QUAD
    exact = simulation.stepper(ss, 400 if waves else 1, quad=quad, rtol=1e-11, atol=1e-13)
    x = ours = settled_at(ss, at(load, t[0]), at(fault, t[0]), V_ref)
    off, seen = {}, 0.0
    for k in range(steps):
        fast, now = course.numbers(t[k : k + 1], t[k - 1] if k else None)
        fast.put(now.vector, now.theta[:, 0])
        here, there = at(load, t[k]), at(fault, t[k])
        u, theta = GEN.inputs(here, V_ref=V_ref, w_r=W), GEN.fault_vector(here, there)
        given = now.u[:, 0].copy()
        changed = ss.u.indices(["w_r", "V_ref"])
        given[changed] = u[changed]
        assert_allclose(given, u, rtol=1e-8)
        ours, *waves_, means = fast(ours, given)
        ours = ours.copy()
        theirs = exact(x, u, theta, DT)
        x = theirs.x_end.copy()
        for name, mean in zip(quad, means.ravel(), strict=True):
            scale = max(abs(theirs.mean[name]), Term.of(name).nominal(ss) / 100, 1.0)
            off[name] = max(off.get(name, 0.0), abs(mean - theirs.mean[name]) / scale)
        if waves:
            y = theirs.y[ss.y.indices(WAVEFORMS)]
            peak = np.abs(y).max(axis=1) + 1e-12
            seen = max(seen, float((np.abs(waves_[0] - y).max(axis=1) / peak).max()))
    windings = [i for i, n in enumerate(ss.x.names) if n.startswith("lam")]
    states = np.abs((ours - x) / ss.x.nominals)[windings].max()
    return off, states, seen


@pytest.mark.long
@pytest.mark.parametrize(
    ("load", "fault", "begin"),
    [(RAMP, None, 3.0), (KW100, GROWN, 6.0)],
    ids=["load ramp", "growing fault"],
)
def test_means_follow(load, fault, begin):
    """Powers and squares to 1e-6 of themselves, what ripples to that of a constant case, 1e-5."""
    off, states, _ = followed(load, fault, begin)
    assert max(off[n] for n in ("P_total", "P_e", "~v_a^2", "~i_a^2")) < 1e-6
    assert max(off.values()) < 1e-5 and states < 2e-5


@pytest.mark.long
def test_waveforms_follow():
    """Samples to 1e-6 of their peaks, load and fault on their way at once."""
    load = varying(SeriesLoad.from_power, Ramp(100e3, 200e3, over=60.0))
    _, states, seen = followed(load, GROWN, 8.0, steps=3, waves=True)
    assert seen < 1e-6 and states < 2e-6


def test_a_profile_of_many_points_needs_few_tables(monkeypatch):
    """A rough course of one profile is told by its value: as many tables as for a ramp."""
    rough = np.random.default_rng(0).uniform(100e3, 200e3, 500)
    load = varying(SeriesLoad.from_power, Points(tuple(np.arange(500.0)), tuple(rough)))
    course, made = course_of(load, None, end=500.0), []
    prepare = course._prepare
    monkeypatch.setattr(course, "_prepare", lambda *a: made.append(a) or prepare(*a))
    t = np.linspace(0.5, 498.5, 200)
    for s in t:
        _, now = course.numbers(np.array([s]))
        R = load.at(float(s)).R[0]
        assert now.u[course.ss.u.index("R_a"), 0] == pytest.approx(R, rel=2e-8)
    assert len(made) < 60


@pytest.mark.long
def test_what_changes_too_fast_or_in_structure_is_left_to_others():
    """A jump, an end that is another model, a profile of no load."""
    fast = varying(SeriesLoad.from_power, Ramp(100e3, 200e3, over=0.1), 0.9)
    course = course_of(fast, None, end=2.0)
    course.numbers(np.array([0.05]))
    assert course.numbers(np.array([0.05, 0.07]))[1].u.shape[1] == 1  # the second is a jump
    with pytest.raises(NotApplicable, match=r"change by .* of the transition matrices in a step"):
        course.numbers(np.array([0.07]), 0.05)
    assert course.numbers(np.array([1.0]), 0.98)[1].u.shape[1] == 1  # constant at the end
    with pytest.raises(NotApplicable, match="in a step"):  # across the bend before it
        course.numbers(np.array([0.11]), 0.09)
    going = varying(Ttsc, Ramp(0.05, 0.0, over=10.0), 20.0)
    gone = course_of(KW100, going, end=20.0)
    with pytest.raises(NotApplicable, match="turns into generator_resistive_healthy"):
        gone.numbers(np.array([15.0]))
    severity = gone.numbers(np.array([5.0]))[1].severity[0]
    assert severity == pytest.approx(0.025, rel=1e-7)  # at the end of a piece


def test_numbers_of_many_steps_are_those_of_each():
    """Columns of as many steps as lie before a bend of the course."""
    bent = varying(SeriesLoad.from_power, Ramp(100e3, 101e3, over=5.0, after=1.0))
    course = course_of(bent, None, end=60.0)
    t = 0.9 + DT * (np.arange(40) + 0.5)
    _, before = course.numbers(t)
    assert before.u.shape[1] == 5 == before.basis.shape[1]
    assert math.isclose(before.u[2, 0], KW100.R[0], rel_tol=1e-9)
    fast, many = course.numbers(t[5:], t[4])
    assert many.u.shape[1] == 35
    for k in range(35):
        one = course.numbers(t[5 + k : 6 + k])[1]
        off = np.abs(many.terms @ many.basis[:, k] - one.vector)
        assert (off * fast.units).max() < 1e-11
        for a, b in zip(one[2:], many[2:], strict=True):
            assert_allclose(a[:, 0], b[:, k], rtol=1e-13)


def test_polynomials_of_a_low_degree_are_told_to_their_error():
    """Over a part of an interval, or none; else there are none."""
    x = np.linspace(-1.0, 1.0, 9)
    made = np.polynomial.chebyshev.chebfit(x, np.array([np.exp(x), 2.0 + np.sin(3 * x)]).T, 8)
    piece = Piece(SimpleNamespace(), 10.0, 5.0, made, np.ones(2), *np.zeros((2, 2)))
    s = np.linspace(11.0, 11.02, 7)
    terms, basis = piece.near(s, 2)
    assert terms.shape == (2, TERMS)
    assert basis.shape == (TERMS, 7)
    assert_allclose((terms @ basis).T, piece.at(s, [0, 1]), rtol=1e-11)
    assert piece.near(np.linspace(6.0, 14.0, 7), 2) is None
    terms, basis = piece.near(np.array([11.0, 11.0]), 1)
    assert_allclose((terms @ basis).T, piece.at(np.array([11.0, 11.0]), [0]), rtol=0)


@pytest.mark.long
def test_a_steep_piece_gives_its_own_polynomials():
    """Short ones would fit two steps; as many as lie in the piece go together, to its error."""
    steep = varying(Ttsc.of_h, 0.05, Growth(1e-5, 1e-3, over=1.0))
    course = course_of(KW100, steep, end=2.0)
    t = 0.02 + DT * (np.arange(20) + 0.5)
    fast, many = course.numbers(t)
    assert many.terms.shape[1] == MOST_TERMS and many.u.shape[1] == 20
    for k in (0, 7, 19):
        here = fast.units * (many.terms @ many.basis[:, k] - course.numbers(t[k : k + 1])[1].vector)
        assert np.abs(here).max() < 1e-11


@pytest.mark.long
def test_strides_become_finer_once_where_a_step_was_refused():
    """Beside a mild fault; and a course that is over soon takes the usual ones from the start."""
    mild, usual = (k.harmonics for k in (meanstep.LEVELS[0], meanstep.LEVELS[len(meanstep.MILD)]))
    slow = varying(Ttsc.of_h, 0.05, Growth(1e-5, 1e-4, over=200.0))
    course, t = course_of(KW100, slow, end=200.0), np.array([100.0])
    assert course.numbers(t)[0].harmonics in mild
    assert course.refine() and course.numbers(t)[0].harmonics in usual
    assert not course.refine()
    soon = course_of(KW100, varying(Ttsc.of_h, 0.05, Growth(1e-5, 1e-4, over=20.0)), end=20.0)
    assert soon.numbers(np.array([10.0]))[0].harmonics in usual


def test_tables_are_made_once_for_all_runs(monkeypatch):
    """A second course of the same numbers, as of a second run, computes none."""
    made = []
    table = transition.transition_table

    def counted(*args, **more):
        made.append(args)
        return table(*args, **more)

    monkeypatch.setattr(transition, "transition_table", counted)
    load = varying(SeriesLoad.from_power, Ramp(100e3, 140e3, over=77.0))
    for least in (1, 0):
        before = len(made)
        course_of(load, None).numbers(np.array([20.0]))
        assert (len(made) > before) == bool(least)


def test_steps_end_with_the_piece_that_their_tables_are_of(monkeypatch):
    """Two pieces of one layout whose tables have more or fewer harmonics: no steps of both."""
    fast = SimpleNamespace(layout=("same",), smooth=1.0, vector=np.zeros(3))
    fast.expect, fast.theta = lambda _: None, np.zeros(0)
    pieces = {k: Piece(fast, k + 0.5, 0.5, np.zeros((2, 5 + k)), *np.zeros((3, 2))) for k in (0, 1)}
    pieces = {k: replace(p, weights=np.zeros(5 + k)) for k, p in pieces.items()}
    course = object.__new__(Course)
    course._only, course._likely, course.fault = None, 99, None
    course.ss = SimpleNamespace(name="model", x=[], u=[0])
    monkeypatch.setattr(course, "_piece", lambda s: pieces[int(s)], raising=False)
    t = np.array([0.8, 0.9, 1.1, 1.2])
    assert [course.numbers(part)[1].basis.shape[1] for part in (t, t[2:])] == [2, 2]
