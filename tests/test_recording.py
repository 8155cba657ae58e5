"""Streams of time-stamped samples merged into recordings; every refusal says what and where."""

import math

import numpy as np
import pytest
from estimation_models import cv_model, oscillator, pendulum
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError, SignalError
from estimators.models.filtermodel import discretise
from estimators.models.recording import Recording, record

MODEL = cv_model()
SIGMA = {"place": 0.1, "speed": 0.2}


def made(place=((0, 1, 2), (5, 6, 7)), speed=((0.5,), (9,)), sigma=SIGMA, a=0.0, **more):
    return record(MODEL, outputs={"place": place, "speed": speed}, sigma=sigma, inputs={"a": a},
                  **more)  # fmt: skip


def test_sensors_of_different_instants():
    """The union of the stamps; NaN where a sensor did not speak; dt to the next, last 0."""
    r = made()
    assert_allclose(r.t, [0, 0.5, 1, 2])
    assert_allclose(r.y, [[5, np.nan, 6, 7], [np.nan, 9, np.nan, np.nan]])
    assert_allclose(r.dt, [0.5, 0.5, 1, 0])
    there = ~np.isnan(r.y)
    assert_allclose(r.variance[0, there[0]], 0.01)
    assert_allclose(r.variance[1, there[1]], 0.04)
    assert r.size == 4


def test_equal_stamps_are_one_instant():
    """Also when rounding keeps them 1e-10 apart; 2e-9 s are two instants."""
    r = made(speed=((1 + 1e-10,), (9,)))
    assert_allclose(r.t, [0, 1, 2])
    assert_allclose(r.y[:, 1], [6, 9])
    r = made(speed=((1 - 1e-10,), (9,)))
    assert r.size == 3
    assert_allclose(r.y[:, 1], [6, 9])
    assert made(speed=((1 + 2e-9,), (9,))).size == 4


def test_stamps_far_from_zero():
    """Unix time resolves 2e-7 s: 50 Hz and 20 Hz streams still meet where they should."""
    t0 = 1.7e9
    a, b = t0 + np.arange(50) * 0.02, t0 + np.arange(20) * 0.05
    r = made(place=(a, a - t0), speed=(b, b - t0))
    for row, t in zip(r.y, (a, b), strict=True):
        there = ~np.isnan(row)
        assert there.sum() == t.size
        assert_allclose(row[there], r.t[there] - t0, atol=1e-6)


def test_inputs_hold_until_their_next_stamp():
    """A stamp between measurements becomes an instant: the input changes there."""
    r = made(a=((-1, 0.7, 1, 3), (1, 2, 3, 4)))
    assert_allclose(r.t, [0, 0.5, 0.7, 1, 2])
    assert_allclose(r.u[0], [1, 1, 2, 3, 3])
    assert np.isnan(r.y[:, 2]).all()
    assert_allclose(made(a=2.5).u[0], 2.5)


def test_long_gaps_are_divided():
    """No step longer than max_dt, stamps kept; a gap of exactly max_dt stays whole."""
    r = made(max_dt=0.3)
    assert r.dt.max() <= 0.3 + 1e-12
    assert np.isin([0, 0.5, 1, 2], r.t).all()
    assert made(max_dt=0.5).size == 5
    t = np.arange(100) * 0.02
    assert made(place=(t, t), speed=(t, t), max_dt=0.02).size == 100


def test_gaps_and_single_samples():
    """NaN is a gap; a deviation per sample; a sensor that appears once."""
    r = made(place=((0, 1, 2), (5, np.nan, 7)), sigma={"place": [1, np.nan, 3], "speed": 1})
    assert np.isnan(r.y[0, 2])
    assert_allclose(r.variance[0, [0, 3]], [1, 9])


def test_outputs_that_are_not_given_are_never_measured():
    """A sensor that never speaks."""
    r = record(MODEL, outputs={"speed": ((0, 1), (1, 2))}, sigma={"speed": 1}, inputs={"a": 0})
    assert np.isnan(r.y[0]).all()


def test_parameters_by_name():
    """Those without default must come."""
    model = pendulum()
    args = dict(outputs={"angle": ((0,), (1,))}, sigma={"angle": 1}, inputs={"tau": 0})
    assert_allclose(record(model, **args, p={"d": 0.3}).p, [0.3])
    with pytest.raises(SignalError, match="missing d"):
        record(model, **args)


def test_part_and_fit():
    """Some instants; another model is refused."""
    r = made()
    part = r.part(1, 3)
    assert_allclose(part.t, [0.5, 1])
    assert_allclose(part.dt, [0.5, 0])
    r.check(MODEL)
    with pytest.raises(DataError, match="pendulum has 1 inputs, 2 parameters and 2 outputs; the"):
        r.check(discretise(oscillator()))
    with pytest.raises(DataError, match="K > 0"):
        r.part(3, 3)


REFUSED = {
    "unknown output": (dict(sigma=SIGMA | {"plac": 1}), "unknown sigma of output 'plac' .*'place'"),
    "no sigma": (dict(sigma={"place": 1}), "sigma missing for speed"),
    "falling": (
        dict(place=((0, 2, 1), (1, 2, 3))),
        "place: times must increase; after t = 2",
    ),
    "doubled": (dict(place=((0, 1, 1), (1, 2, 3))), r"after t = 1 s \(sample 1\).*same stamp"),
    "no time": (dict(place=((0, np.nan), (1, 2))), r"place: times must be finite; t = .*sample 1"),
    "lengths": (dict(place=((0, 1), (1, 2, 3))), "place: times and values of one length"),
    "empty": (dict(place=((), ())), "place: times and values of one length"),
    "not a pair": (dict(place=3.0), r"place: \(times, values\) expected"),
    "words": (dict(place=(("x",), (1,))), r"place: \(times, values\) expected"),
    "infinite": (dict(place=((0, 1), (1, np.inf))), "place: sample 1 is infinite; a gap is NaN"),
    "zero sigma": (dict(sigma=SIGMA | {"speed": 0}), "sigma of speed must be finite and > 0, got"),
    "nan sigma": (dict(sigma=SIGMA | {"place": [1, np.nan, 1]}), "sigma of place .* at sample 1"),
    "many sigmas": (
        dict(sigma=SIGMA | {"place": [1, 1]}),
        "sigma of place: a number or shape",
    ),
    "late input": (dict(a=((0.1, 1), (1, 2))), "input a begins at 0.1 s, after the first measurem"),
    "nan input": (dict(a=((0, 1), (1, np.nan))), "input a: 1 values not finite"),
    "max_dt": (dict(max_dt=0.0), "max_dt = 0.0 s must be > 0"),
    "nan max_dt": (dict(max_dt=math.nan), "max_dt = nan s must be > 0"),
}


@pytest.mark.parametrize(("change", "words"), REFUSED.values(), ids=REFUSED.keys())
def test_streams_that_cannot_be_merged_are_refused(change, words):
    """What, where, and what to do."""
    with pytest.raises(DataError, match=words):
        made(**change)


def test_unknown_names_and_nothing_measured():
    """Names of outputs and inputs, with the nearest one; missing inputs."""
    with pytest.raises(DataError, match=r"unknown output 'sped' .*'speed'"):
        record(MODEL, outputs={"sped": ((0,), (1,))}, sigma={})
    with pytest.raises(DataError, match="unknown input 'b'"):
        record(MODEL, outputs={"speed": ((0,), (1,))}, sigma={"speed": 1}, inputs={"b": 1})
    with pytest.raises(DataError, match="no output is measured"):
        record(MODEL, outputs={}, sigma={}, inputs={"a": 1})
    with pytest.raises(SignalError, match="missing a"):
        record(MODEL, outputs={"speed": ((0,), (1,))}, sigma={"speed": 1})


def test_samples_too_close_to_be_told_apart():
    """Two samples of a sensor 1.5e-9 s apart, and another sensor's between: one would be lost."""
    with pytest.raises(DataError, match="place: samples closer than 2e-09 s"):
        made(place=((1, 1 + 1.6e-9), (1, 2)), speed=((1 + 0.8e-9,), (3,)))


GOOD = dict(t=np.arange(3.0), u=np.zeros((1, 3)), y=np.zeros((2, 3)), variance=np.ones((2, 3)),
            p=np.zeros(1))  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(t=np.zeros((3, 1))), r"t: shape \(K,\) with K > 0"),
        (dict(t=np.zeros(0)), "K > 0"),
        (dict(t=[0.0, 2, 2]), "does not after t = 2"),
        (dict(t=[0.0, np.inf, np.inf]), "t must be finite; t = inf at sample 1"),
        (dict(u=np.zeros((1, 2))), r"u: 3 columns expected, got shape \(1, 2\)"),
        (dict(y=np.zeros(3)), "y: 3 columns"),
        (dict(variance=np.ones((1, 3))), r"variance: shape \(2, 3\) expected"),
        (dict(p=np.zeros((1, 1))), r"p: shape \(np,\) expected"),
        (dict(u=np.full((1, 3), np.nan)), "must be finite"),
        (dict(p=np.array([np.nan])), "must be finite"),
        (dict(y=np.full((2, 3), np.inf)), "NaN where missing"),
        (dict(variance=np.zeros((2, 3))), "variances must be positive"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(change, words):
    """Recordings made by hand are checked once, so that filters need not."""
    Recording(**GOOD)
    with pytest.raises(DataError, match=words):
        Recording(**GOOD | change)


def test_variances_of_missing_samples_do_not_count():
    """Any number does, NaN and zero included."""
    y, v = np.zeros((2, 3)), np.ones((2, 3))
    y[0, 1], v[0, 1] = np.nan, np.nan
    y[1, 1], v[1, 1] = np.nan, 0
    assert Recording(**GOOD | dict(y=y, variance=v)).size == 3


def test_what_numpy_would_turn_into_numbers_is_told():
    """Ticks of dates are no seconds, masked values no readings, text no numbers."""
    t = np.array(["2024-01-01T00:00:00", "2024-01-01T00:00:02", "2024-01-01T00:00:04"], "M8[ns]")
    with pytest.raises(DataError, match=r"place: .*give \(t - t\[0\]\) / np.timedelta64\(1, 's'\)"):
        made(place=(t, (5, 6, 7)))
    with pytest.raises(DataError, match=r"give t / np.timedelta64\(1, 's'\)"):
        made(place=(t - t[0], (5, 6, 7)))
    r = made(place=((t - t[0]) / np.timedelta64(1, "s"), (5, 6, 7)))
    assert_allclose(r.t, [0, 0.5, 2, 4])
    masked = np.ma.array([5.0, -999.0, 7.0], mask=[False, True, False])
    assert_allclose(made(place=((0, 1, 2), masked)).y[0], [5, np.nan, np.nan, 7])
    with pytest.raises(DataError, match="1 of 3 values are masked"):
        made(place=(np.ma.array([0.0, 1.0, 2.0], mask=[0, 1, 0]), (5, 6, 7)))
    for wrong in ([True, False, True], ["5", "6", "7"], [5, "6", 7], [1j, 2, 3]):
        with pytest.raises(DataError, match="numbers expected"):
            made(place=((0, 1, 2), wrong))
    with pytest.raises(DataError, match="u: 1 of 2 values are masked"):
        Recording([0.0, 1.0], np.ma.array([[1.0, 2.0]], mask=[[0, 1]]), np.zeros((1, 2)),
                  np.ones((1, 2)), [])  # fmt: skip
    y = np.ma.array([[1.0, -999.0]], mask=[[0, 1]])
    assert np.isnan(Recording([0.0, 1.0], np.zeros((0, 2)), y, np.ones((1, 2)), []).y[0, 1])


def test_gaps_of_pandas():
    """NA of nullable columns is a gap, as NaN is; Decimals are numbers."""
    from decimal import Decimal

    import pandas as pd

    r = made(place=((0, 1, 2), pd.Series([5, None, 7], dtype="Int64")))
    assert_allclose(r.y[0], [5, np.nan, np.nan, 7])
    r = made(place=((0, 1, 2), [Decimal(5), None, Decimal(7)]))
    assert_allclose(r.y[0], [5, np.nan, np.nan, 7])
