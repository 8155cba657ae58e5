"""The study of faults that change: courses, the bound, and what is claimed of runs."""

import math

import numpy as np
import pytest

from apu_casadi.machine.machinedata import MachineParameters
from estimators.apu.sensors import ELECTRICAL
from scenarios.studies.estimation import changing
from scenarios.studies.estimation.changing import COURSES, STUDY, bound_instant
from scenarios.studies.registration import Results


def test_courses_begin_with_nothing_and_are_what_they_say():
    for name, c in COURSES.items():
        assert not c.at(np.array([-1.0, -1e-9])).any(), name
    assert COURSES["growing"].at(np.array([0.15]))[0] == pytest.approx(2.4e-3 * (1 - math.exp(-1)))
    on = COURSES["intermittent"].at(np.array([0.05, 0.15, 0.25]))
    assert on.tolist() == [3e-4, 0.0, 3e-4]
    assert COURSES["f_W_c"].at(np.array([1.0, 9.0])) == pytest.approx([-0.01, -0.04])


def made(bound, late, z=1.0):
    runs = [
        {"late": t, "before": 0, "answered": True, "right": True, "lag": 0.01, "z": z, "most": 2.0}
        for t in late
    ]
    return Results({"growing": {"seeds": [1, len(runs)], "result": {"bound": bound, "runs": runs}}})


@pytest.mark.parametrize(
    ("bound", "late", "met"),
    [
        (0.05, [0.1] * 20, True),
        (0.05, [0.1] * 18 + [0.12] * 2, False),
        (0.001, [0.02] * 20, True),  # nothing is said before the next instant of the estimate
        (0.0, [0.02] * 20, True),
        (0.012, [0.04] * 20, True),
        (0.001, [0.04] * 20, False),
        (0.05, [0.1] * 18 + [None] * 2, False),
        (None, [0.1] * 20, True),  # the bound is not reached
    ],
)
def test_an_alarm_is_in_time_by_twice_the_bound(bound, late, met):
    r = made(bound, late)
    alarm, error = changing.claims(r)
    assert alarm.met is met and error.met and alarm.why
    (table, _) = changing.section(r)
    assert "growing" not in table and "h grows" in table
    assert not changing.claims(made(bound, late, z=1.6))[1].met
    assert changing.claims(Results({})) == [] == changing.section(Results({}))


def test_parts_are_the_courses():
    assert [*STUDY.parts] == [*COURSES]


@pytest.mark.ci  # a generator and a filter, linearised: 5 s
def test_the_bound_is_later_than_that_of_the_current_alone():
    """With all else known, h adds -h v/r_s to one current: the information is that of white noise;
    unknown fluxes and angle take a part of it."""
    p, c = MachineParameters(), COURSES["growing exact"]
    t = 1e-4 * np.arange(400)
    v = math.sqrt(2) * p.V_rated_rms * np.cos(2 * math.pi * p.f_rated * t)
    known = np.cumsum((c.at(t) * v / p.r_s / ELECTRICAL["i_b"].noise) ** 2)
    first = float(t[np.searchsorted(known, 25.0)])
    assert first < bound_instant("growing exact") < 3 * first
