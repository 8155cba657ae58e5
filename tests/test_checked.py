"""Numbers from outside: text, booleans and the like are refused wherever they come in."""

import dataclasses
import datetime as dt
from decimal import Decimal
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_array_equal

from apu_casadi.core.checked import array, number
from apu_casadi.core.errors import ApuError, SignalError
from apu_casadi.core.simulation import simulate
from apu_casadi.gaspath.calibration import CalibrationPoint
from apu_casadi.gaspath.designdata import GasGeneratorParameters
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits, LoadLaw
from apu_casadi.gaspath.steady.trimbatch import performance_deck, trim_batch
from apu_casadi.gaspath.steady.trimming import maximum_power, trim_gas_generator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.measurement import MeasurementNoise
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import GovernorParameters
from apu_casadi.unit.events import Ambient, FaultChange, HealthChange, LoadChange
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.noise import Noise
from estimators.detection.cusum import cusum_test
from estimators.filters.ukf import PointSet
from estimators.models.filtermodel import Unknown

NUMBERS = [
    2, 2.0, np.float32(2), np.int16(2), np.array(2.0), np.array([2]), [2.0], (2,), Fraction(4, 2),
    xr.DataArray(2.0), xr.DataArray([2], dims="k"), ca.DM(2),
]  # fmt: skip
NOT_NUMBERS = [
    True, np.True_, "2", b"2", "", None, 2j, [True], ["2"], np.array([True]), np.array(["2"]),
    [[1.0, "2"]], [1.0, True], np.array([2, "x"], dtype=object), np.array([None]), {}, object(),
    np.datetime64("2026-01-01"), np.timedelta64(2, "s"), dt.timedelta(seconds=2), Decimal("2"),
    np.ma.masked_array([2.0], [True]), ca.MX.sym("x"), 1 << 2000,
]  # fmt: skip


@pytest.mark.parametrize("value", NUMBERS, ids=repr)
def test_real_numbers_are_taken_in_every_dress(value):
    """The same number, exactly."""
    assert number("x", value) == 2.0
    assert_array_equal(array("x", value).ravel(), [2.0])


@pytest.mark.parametrize("value", NOT_NUMBERS, ids=lambda v: repr(v)[:15])
def test_what_is_no_number_is_refused_by_name(value):
    """NumPy and float() turn text, booleans, dates and masked values into numbers silently."""
    for f in (number, array):
        with pytest.raises(SignalError, match=r"^speed"):
            f("speed", value)


def test_several_numbers_are_not_one():
    """Shape and count are told; an array of them is taken as such."""
    with pytest.raises(SignalError, match=r"one number, got 3 values of shape \(3,\)"):
        number("x", [1, 2, 3])
    assert array("x", [[1, 2], [3, 4]]).shape == (2, 2)


GG, UNIT, LOAD = GasGenerator(), Apu(), SeriesLoad.from_power(100e3)
FIXED = {"N": 3775.0, "PW": 3e5}
ENTRIES = {
    "trim altitude": lambda v: trim_gas_generator(GG, FIXED, altitude=v),
    "trim health": lambda v: trim_gas_generator(GG, FIXED, theta={"f_eta_c": v}),
    "trim value": lambda v: trim_gas_generator(GG, {"N": 3775.0, "PW": v}),
    "batch altitude": lambda v: trim_batch(GG, FIXED, altitude=v),
    "batch health": lambda v: trim_batch(GG, FIXED, theta={"f_W_t": v}),
    "batch value": lambda v: trim_batch(GG, {"N": 3775.0, "PW": v}),
    "maximum power": lambda v: maximum_power(GG, T4_max=v),
    "deck": lambda v: performance_deck(GG, Mach=v),
    "load law": lambda v: LoadLaw(v, 3775.0),
    "limits": lambda v: Limits(off_map=v),
    "ambient": lambda v: Ambient(Mach=v),
    "health event": lambda v: HealthChange(1.0, {"f_eta_c": v}),
    "event time": lambda v: LoadChange(v, LOAD),
    "fault time": lambda v: FaultChange(v, None),
    "run health": lambda v: simulate_joint(UNIT, duration=0.04, load=LOAD, health={"f_W_c": v}),
    "run duration": lambda v: simulate_joint(UNIT, duration=v, load=LOAD),
    "run step": lambda v: simulate_joint(UNIT, duration=0.04, load=LOAD, dt=v),
    "run tolerance": lambda v: simulate_joint(UNIT, duration=0.04, load=LOAD, rtol=v),
    "noise": lambda v: Noise(N=v),
    "measurement noise": lambda v: MeasurementNoise(sigma_i=v),
    "load": lambda v: SeriesLoad((v, 1.0, 1.0)),
    "load power": lambda v: SeriesLoad.from_power(v),
    "constant power": lambda v: ConstantPowerLoad(v),
    "open": lambda v: OpenLoad(v),
    "fault": lambda v: Ttsc(mu=v, k_rf=1.0),
    "fault resistance": lambda v: Ttsc(mu=0.05, k_rf=v),
    "parameter": lambda v: GasGeneratorParameters(T4=v),
    "governor": lambda v: GovernorParameters(Kp=v),
    "unit": lambda v: UNIT.change({"machine.r_s": v}),
    "generator voltage": lambda v: Generator().steady_state(LOAD, V_t=v),
    "generator speed": lambda v: Generator().steady_state(LOAD, w_r=v),
    "calibration": lambda v: CalibrationPoint({"N": 3775.0, "PW": v}, {"T4": (1200.0, 1.0)}),
    "calibration value": lambda v: CalibrationPoint(FIXED, {"T4": (v, 1.0)}),
    "walk": lambda v: Unknown(walk=v),
    "sigma points": lambda v: PointSet.of(3, "scaled", v, 2.0, 0.0),
    "cusum": lambda v: cusum_test(np.zeros(3), drift=v, false_alarms_per_hour=1.0, rate=10.0),
    "alarms": lambda v: cusum_test(np.zeros(3), drift=0.5, false_alarms_per_hour=v, rate=10.0),
    "simulate": lambda v: simulate(GG.state_space, t_grid=[0.0, v], x0=[3775.0], u=None),
}


@pytest.mark.parametrize("value", ["1", True, b"1", [True], 1j], ids=repr)
@pytest.mark.parametrize("entry", list(ENTRIES))
def test_no_public_call_takes_text_or_booleans_as_numbers(entry, value):
    """Each is an error of the package that shows what came."""
    with pytest.raises(ApuError, match=r"must be|is expected|expected"):
        ENTRIES[entry](value)


def test_numbers_in_other_dresses_stay_what_they_are():
    """Parameters turn NumPy's numbers into Python's; the run of a unit does not change."""
    p = GasGeneratorParameters(T4=np.float32(1200.0), W2=np.array(3.0), N=np.int64(3000))
    assert all(type(getattr(p, n)) is float for n in ("T4", "W2", "N"))
    assert dataclasses.replace(p, T4=1250).T4 == 1250
    assert Ambient(altitude=np.int64(8000)) == Ambient(altitude=8000.0)


def test_an_efficiency_above_one_is_refused_with_its_reason():
    """Health factors may lift a map's efficiency past 1, which no component has."""
    worn = {"f_eta_t": 1.2}
    with pytest.raises(ApuError, match=r"eta_t = 1\.\d+, limit 1: no component is better") as e:
        trim_gas_generator(GG, FIXED, theta=worn)
    assert e.value.point["eta_t"] > 1
    batch = trim_batch(GG, FIXED, theta=worn)
    assert batch.counts()["efficiency above 1"] == 1 and "eta_t = 1." in batch.reason(0)
    free = trim_gas_generator(GG, FIXED, theta=worn, limits=Limits(eta_max=1.2))
    assert free["eta_t"] > 1
    with pytest.raises(ApuError, match="eta_t"):
        UNIT.steady_state(LOAD, health=worn)
