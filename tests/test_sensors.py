"""Sensors: tables, readings, a lag against its step response, and the filter that carries it."""

import dataclasses
import json
import math

import numpy as np
import pytest

from apu_casadi import Apu, HealthChange, LoadChange, SeriesLoad, simulate_joint
from apu_casadi.core.errors import DataError, ParameterError
from apu_casadi.core.measuring import measure
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from estimators.apu.fitting import EngineData, fit_engine
from estimators.apu.gaspath import gas_path_filter, samples
from estimators.apu.measuring import measure_run
from estimators.apu.priorfile import Prior
from estimators.apu.recorded_estimate import JUMPS, estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.recordings.plausible import PLAUSIBLE
from estimators.apu.sensorfile import SensorFile, read_sensors
from estimators.apu.sensors import (
    ELECTRICAL,
    GAS_PATH,
    KNOWN,
    THERMOCOUPLE,
    Sensor,
    SensorSet,
    gas_path_table,
    register,
    respond,
    unregister,
)
from estimators.information.consistency import band

GG = GasGenerator()
WITH_TC = GAS_PATH.add("T41_tc")


def slow(**tau):
    """The table with lags of some sensors."""
    return SensorSet(
        tuple(dataclasses.replace(s, tau=tau.get(s.name, 0.0)) for s in GAS_PATH.sensors)
    )


@pytest.fixture(scope="module")
def drop():
    """A joint run with a load drop at 1 s.

    Every 20 ms the exchange would err by 5 % of the speed's excursion, with a fuel that is late by
    a step: an error of the truth that a sensor of the speed by 1 rad/s shows.
    """
    return simulate_joint(
        Apu(),
        duration=4.0,
        load=SeriesLoad.from_power(200e3),
        events=[LoadChange(t=1.0, load=SeriesLoad.from_power(80e3))],
        waveform_dt=None,
        solver="propagator",
        dt=5e-3,
    )


def test_the_response_to_a_step_is_exponential():
    """Held input: 1 - exp(-t/tau), whatever the steps; a ramp is followed tau late."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.01, 0.3, 40))
    held = np.full(t.size, 900.0)
    assert np.array_equal(respond(t, held, 0.5), held)  # at rest in the beginning
    x = respond(np.append(t[0] - 1e-9, t), np.append(600.0, held), 0.5)[1:]
    assert x == pytest.approx(900.0 - 300.0 * np.exp(-(t - t[0]) / 0.5), rel=1e-8)
    ramp = respond(t, 7.0 * t, 0.5)
    late = 7.0 * (t - 0.5) + 3.5 * np.exp(-(t - t[0]) / 0.5)
    assert ramp == pytest.approx(late, abs=1e-12)


def test_a_run_gets_measured_copies(drop):
    """Beside the truth, with units; the thermocouple's follows with its lag."""
    ds = WITH_TC.copies(drop, None, gains={"P3": 0.01})
    assert ds["P3_meas"].values == pytest.approx(1.01 * drop["P3"].values, rel=1e-15)
    t, late = drop["time"].values, ds["T41_tc_meas"]
    assert np.array_equal(late.values, respond(t, drop["T41"].values, THERMOCOUPLE.tau))
    assert late.attrs["units"] == "K"
    assert late.attrs["long_name"] == "measured: reading of T41"
    noisy = WITH_TC.copies(drop, 1)["T41_tc_meas"].values
    assert np.std(noisy / late.values - 1) == pytest.approx(THERMOCOUPLE.noise, rel=0.2)
    assert "T41_tc_meas" not in drop


def test_the_filter_carries_the_lag_exactly():
    """At a steady point the state goes to T41 by the exponential, for any step."""
    filt = gas_path_filter(GG, WITH_TC, gains=False, inertia=None)
    model = filt.model
    assert model.x.names[-1] == model.y.names[-1] == "T41_tc"
    assert [s.name for s in filt.lagging] == ["T41_tc"]
    at = trim_gas_generator(GG, {"N": GG.parameters.N, "PW": 400e3})
    x = model.x.pack({"N": at["N"], **dict.fromkeys(GG.THETA.names, 1.0), "T41_tc": 700.0})
    u = model.u.pack({"Wf": at["Wf"], "PW": at["PW"], "sigma_Wf": 0.0, "sigma_PW": 0.0})
    w = np.zeros(len(model.w))
    for dt in (0.0, 0.02, 0.5, 30.0):
        x1, check = model.transition(x, u, [], w, dt)
        assert float(check) < 1e-9
        expected = at["T41"] + (700.0 - at["T41"]) * math.exp(-dt / THERMOCOUPLE.tau)
        assert float(x1[-1]) == pytest.approx(expected, rel=1e-9)
    assert float(model.output(x, u, [], w)[0][-1]) == 700.0


def test_a_measured_input_may_lag():
    """Fuel and power are states, known through the lag of their sensors, for any step."""
    sensors = slow(Wf=0.3, PW=0.2)
    filt = gas_path_filter(GG, sensors, governed=None, inertia=None)
    model = filt.model
    assert {"Wf", "PW", "Wf_lag", "PW_lag"} <= {*model.x.names} and not filt.known_power
    assert {"Wf", "PW"} <= {*model.y.names} and "Wf" not in model.u.names
    at = trim_gas_generator(GG, {"N": GG.parameters.N, "PW": 400e3})
    x = dict.fromkeys(model.x.names, 0.0) | dict.fromkeys(HEALTH, 1.0)
    x |= {n: at[n] for n in ("N", "Wf", "PW")} | {"Wf_lag": 0.03, "PW_lag": 1e5, "gain_Wf": 0.01}
    given = model.x.pack(x), model.u.pack({}), []
    w = np.zeros(len(model.w))
    for dt in (0.02, 0.5):
        x1 = dict(
            zip(model.x.names, model.transition(*given, w, dt)[0].full().ravel(), strict=True)
        )
        for n, tau in (("Wf", 0.3), ("PW", 0.2)):
            left = (x[f"{n}_lag"] - at[n]) * math.exp(-dt / tau)
            assert x1[f"{n}_lag"] == pytest.approx(at[n] + left, rel=1e-9)
            assert x1[n] == at[n]
    y = dict(zip(model.y.names, model.output(*given, w)[0].full().ravel(), strict=True))
    assert (y["Wf"], y["PW"]) == (pytest.approx(0.03 * 1.01, rel=1e-12), 1e5)


@pytest.mark.ci  # three estimates
def test_inputs_that_lag_are_followed_through_a_load_drop(drop):
    """Declared: NEES near 1, believed; not declared: found out."""
    sensors = SensorFile(slow(Wf=0.3))
    for seed in range(2):
        m = recorded(drop, sensors, seed)
        e = estimate(m, sensors=sensors, backend="vm")
        assert e.believable and of_health(e) < 3 and e.gaspath.attrs["alarms"] == "[]"
        z = (e.result["Wf"][0] - np.interp(e.result.t, drop["time"], drop["Wf"])) / e.result["Wf"][
            1
        ]
        assert 0.5 < np.sqrt(np.mean(z[25:] ** 2)) < 1.3
    assert not estimate(m, backend="vm").believable


@pytest.mark.ci  # three estimates
def test_a_power_that_lags_is_followed_through_a_load_drop(drop, tmp_path):
    """The same of the shaft power's sensor, from its file to what is believed."""
    path = tmp_path / "slow.toml"
    path.write_text("[PW]\nlag = 0.2\n")
    for seed in range(2):
        m = recorded(drop, read_sensors(path), seed)
        e = estimate(m, sensors=path, backend="vm")
        assert e.believable, e.doubts
        assert of_health(e) < 3 and e.gaspath.attrs["alarms"] == "[]"
        true = np.interp(e.result.t, drop["time"], drop["PW"])
        z = (e.result["PW"][0] - true) / e.result["PW"][1]
        assert np.sqrt(np.mean(z[25:] ** 2)) < 1.5
    assert not estimate(m, backend="vm").believable


@pytest.mark.long
def test_a_lagging_sensor_is_followed_through_a_load_drop(drop):
    """The filter is consistent; one that takes the thermocouple for instantaneous is not."""
    late, instant, errors = ([], [], [])
    quick = dataclasses.replace(THERMOCOUPLE, tau=0.0)
    plain = GAS_PATH.add(quick)
    filters = [gas_path_filter(GG, s, gains=False, inertia=None) for s in (WITH_TC, plain)]
    t, rows = samples(drop)
    true = respond(drop["time"].values, drop["T41"].values, THERMOCOUPLE.tau)[rows]
    for seed in range(3):
        data = filters[0].recording(drop, seed)
        r = filters[0].run(data)
        late.append(r.nis[25:].mean())
        mean, sigma = r["T41_tc"]
        errors.append(((mean - true) / sigma)[25:])
        believed = filters[1].recording(drop, seed)
        i = believed.y.shape[0] - 1
        believed.y[i] = data.y[i]
        instant.append(filters[1].run(believed).nis[25:].mean())
    # an error lasts for seconds, so a run has few independent ones: up to 1.7 in one, 1.00 in 20
    assert np.sqrt(np.mean(np.square(errors))) < 1.3
    low, high = band(3 * (t.size - 25), 5, 0.999)
    assert low < np.mean(late) < high
    assert np.mean(instant) > 1.5 * high
    # tau dx/dt = v - x, summed: the area between gas and thermocouple is tau times the fall
    area = np.trapezoid(drop["T41"].values[rows] - true, t)
    assert area == pytest.approx(THERMOCOUPLE.tau * (true[-1] - true[0]), rel=1e-3)
    assert true[-1] - true[0] < -150.0


@pytest.mark.long
def test_another_sensor_tells_more(drop):
    """P5 and the thermocouple each leave less uncertainty of the health than the table alone."""

    def spread(sensors):
        f = gas_path_filter(GG, sensors, gains=False, inertia=None)
        r = f.run(f.recording(drop, 1))
        return sum(r[n][1][-1] ** 2 for n in GG.THETA.names)

    base = spread(GAS_PATH)
    assert spread(GAS_PATH.add("P5")) < 0.999 * base
    assert spread(WITH_TC) < 0.99 * base


@pytest.mark.long
def test_a_fit_takes_sensors_of_any_kind(drop):
    """Through the load drop with the lag as a state, and at steady points, where it is over."""
    t, rows = samples(drop)
    k = slice(45, 105)
    names = (*GAS_PATH.names, "T41")
    there = {n: drop[n].values for n in names}
    true = {n: v[rows][k] for n, v in WITH_TC.true(drop["time"].values, there).items()}
    readings = WITH_TC.measure(true, np.random.default_rng(2))
    transient = fit_engine([EngineData("drop", t[k], readings)], sensors=WITH_TC).result
    assert transient.recordings[0].x.shape[0] == 2  # N and the lag
    assert (np.abs(transient.estimate - 1) < 4 * transient.sigma).all()
    assert transient.p_value > 1e-3
    points = [trim_gas_generator(GG, {"N": GG.parameters.N, "PW": P}) for P in (2e5, 4e5)]
    steady = {n: np.array([p[n] for p in points]) for n in names}
    data = EngineData("steady", np.arange(2.0), steady | {"T41_tc": steady["T41"]})
    found = fit_engine([data], steady=True, sensors=WITH_TC).result
    assert found.estimate == pytest.approx(np.ones(4), abs=1e-5)


def test_more_sensors_do_not_change_the_noise_of_the_others(drop):
    """Each draws after those before it in the table."""
    few, more = (
        gas_path_filter(GG, s, gains=False, inertia=None).recording(drop, 3)
        for s in (GAS_PATH, WITH_TC)
    )
    assert np.array_equal(few.y, more.y[: len(few.y)])
    assert np.array_equal(few.u, more.u)


def test_readings_have_gain_and_noise():
    """(1 + gain) v + sigma e, in the order of the names; averaging divides the noise."""
    true = {"P3": np.full(3, 8e5), "N": np.full(3, 3775.0)}
    read = GAS_PATH.measure(true, np.random.default_rng(1), gains={"P3": 0.01}, averaged=4)
    rng = np.random.default_rng(1)
    assert read["P3"] == pytest.approx(8.08e5 * (1 + 0.0025 * rng.standard_normal(3)), rel=1e-14)
    assert read["N"] == pytest.approx(3775.0 * (1 + 0.00125 * rng.standard_normal(3)), rel=1e-14)
    of_true = GAS_PATH.measure(
        true, np.random.default_rng(1), gains={"P3": 0.01}, averaged=4, noise_of="true"
    )
    assert of_true["P3"] - 8.08e5 == pytest.approx((read["P3"] - 8.08e5) / 1.01)
    assert np.array_equal(GAS_PATH.measure(true, None)["N"], true["N"])
    assert measure(2.0, 0.5, np.array(2.0), gain=0.5) == 4.0
    assert set(ELECTRICAL.draw_gains(np.random.default_rng(0))) == set(ELECTRICAL.names)


def test_impossible_sensors_are_refused():
    """By name, with what to do."""
    with pytest.raises(ParameterError, match="tau must be >= 0"):
        Sensor("X", 0.01, True, 0.0, "K", "", tau=-1.0)
    with pytest.raises(ParameterError, match="give value"):
        Sensor("X", 0.01, True, 0.0, "Pa", "", reads=("P3", "P5"))
    with pytest.raises(ParameterError, match="no range"):
        Sensor("X", 0.01, True, 0.0, "Pa", "", (2.0, 1.0))
    with pytest.raises(ParameterError, match=r"no output 'P33'.*P3"):
        register(Sensor("X", 0.01, True, 0.0, "Pa", "", reads=("P33",)))
    with pytest.raises(ParameterError, match="'P3' is known already"):
        register(Sensor("P3", 0.01, True, 0.0, "Pa", ""))
    with pytest.raises(ParameterError, match=r"unknown sensor 'T41_tcc'.*T41_tc"):
        GAS_PATH.add("T41_tcc")
    with pytest.raises(ParameterError, match="'P3' is in the set already"):
        GAS_PATH.add("P3")
    with pytest.raises(ParameterError, match="depends on the shaft power"):
        gas_path_filter(GG, GAS_PATH.add(Sensor("SFC", 0.01, True, 0.0, "kg/J", "")))
    with pytest.raises(ParameterError, match="takes PW as an input"):
        gas_path_filter(GG, GAS_PATH.only(("N", "P3", "T3", "T5", "Wf")))
    with pytest.raises(ParameterError, match="must be measured, without a lag"):
        gas_path_filter(GG, slow(PW=0.1), eta=0.02, loss=True)


def test_one_table_feeds_all():
    """Ranges of recorded files are those of the sensors."""
    for s in KNOWN.values():
        assert PLAUSIBLE[s.name] == s.plausible
    assert gas_path_table().names[:6] == GAS_PATH.names


MANY = """
[T3]
lag = 1.0
[T5]
lag = 1.0
bias = 3.0
[T41]
bias = 5.0
bias_as = "considered"
[EGT]
quantity = "T5"
unit = "degC"
noise = 2.0
lag = 0.5
delay = 0.1
quantum = 1.0
[f_gen]
quantity = "N"
unit = "Hz"
factor = 0.1061
noise = 0.1
jitter = 1e-3
"""


@pytest.fixture
def many(tmp_path):
    path = tmp_path / "many.toml"
    path.write_text(MANY)
    yield read_sensors(path)
    for name in ("EGT", "f_gen"):
        unregister(name)


def recorded(run, sensors, seed):
    made = measure_run(run, Apu(), seed, sensors)["gaspath"]
    return read_recording({"t": made["time"].values, **{n: made[n].values for n in made}})


def of_health(e):
    """NEES of the health factors at the end, over their number."""
    r, at = e.result, e.result.x.indices(HEALTH)
    off = r.mean[at, -1] - 1.0
    return off @ np.linalg.solve(r.cov[-1][np.ix_(at, at)], off) / 4


def test_offsets_are_states_estimated_or_considered(many):
    """With the declared prior; a considered one keeps it, and all that is declared is a state."""
    filt = gas_path_filter(GG, many.gas_path)
    assert {"bias_T5", "bias_T41", "T5", "T3", "EGT", "gain_EGT"} <= {*filt.model.x.names}
    assert "bias_P3" not in filt.model.x and "gain_f_gen" not in filt.model.x
    assert filt.model.consider == ("bias_T41", "gain_J")
    assert (filt.sigma["bias_T5"], filt.sigma["bias_T41"]) == (3.0, 5.0)
    x = dict.fromkeys(filt.model.x.names, 0.0)
    x |= dict.fromkeys(HEALTH, 1.0) | {"N": GG.parameters.N, "T5": 900.0, "bias_T5": 7.0}
    at = trim_gas_generator(GG, {"N": GG.parameters.N, "PW": 400e3})
    u = filt.model.u.pack({"Wf": at["Wf"], "PW": at["PW"], "sigma_Wf": 0.0, "sigma_PW": 0.0})
    y, check = filt.model.output(filt.model.x.pack(x), u, [], np.zeros(len(filt.model.w)))
    y = dict(zip(filt.model.y.names, y.full().ravel(), strict=True))
    assert float(check) < 1e-9 and y["T5"] == 907.0
    assert y["f_gen"] == pytest.approx(0.1061 * GG.parameters.N)
    assert y["T41"] == pytest.approx(at["T41"], rel=1e-8)


@pytest.mark.ci  # sixteen estimates
def test_declared_sensors_are_believed_and_right_and_undeclared_lags_are_not(drop, many):
    """NEES near 1 with lags, delay, offsets, digits and jitter declared; a lag left out shows."""
    found = [estimate(recorded(drop, many, s), sensors=many, backend="vm") for s in range(12)]
    # 0.69 in 48 seeds, in the mean of which it is known to 0.08: the truth is the prior's mean
    assert 0.4 < np.mean([of_health(e) for e in found]) < 1.2
    assert all(e.believable for e in found), [e.doubts for e in found]
    assert not any(json.loads(e.gaspath.attrs["alarms"]) for e in found)
    instant = [dataclasses.replace(s, tau=0.0) for s in many.gas_path.sensors]
    fast = dataclasses.replace(many, gas_path=SensorSet(tuple(instant)))
    first = drop.sel(time=slice(0.0, 1.5))  # every alarm takes a second more for its causes
    for seed in range(4):
        assert not estimate(recorded(first, many, seed), sensors=fast, backend="vm").believable


def test_a_considered_error_is_no_change(drop, tmp_path):
    """What happened is judged by innovations that are white, not by those that hold the offset."""
    path = tmp_path / "considered.toml"
    path.write_text(CONSIDERED["T41"])
    e = estimate(recorded(drop, read_sensors(path), 0), sensors=path, backend="vm")
    filt, tracked = e.path
    assert e.believable, e.doubts
    assert tracked.alarms == ()
    assert JUMPS.first(tracked.result, JUMPS.hold) is not None
    assert JUMPS.first(tracked.deciding, JUMPS.hold) is None
    # the estimate is still the filter's that does not estimate it, the other one's does
    own, other = (r["bias_T41"][1] for r in (tracked.result, tracked.deciding))
    assert np.allclose(own, 5.0, rtol=1e-12) and other[-1] < 4.9
    assert filt.deciding.model.consider == ("gain_J",)
    plain = gas_path_filter(GG)
    assert plain.deciding is plain and plain.runs().deciding is None


CONSIDERED = {
    "T41": '[T41]\nbias = 5.0\nbias_as = "considered"\n',
    "T5": '[T5]\nbias = 5.0\nbias_as = "considered"\n',
    "P3": '[P3]\ngain = 0.01\ngain_as = "considered"\n',
}


@pytest.mark.ci  # twelve estimates
@pytest.mark.parametrize("name", CONSIDERED)
def test_considered_errors_are_no_doubt_and_a_fault_beside_them_is_found(drop, tmp_path, name):
    """No alarm and no doubt of healthy units; a change of health is found when it comes."""
    path = tmp_path / "considered.toml"
    path.write_text(CONSIDERED[name])
    sensors = read_sensors(path)
    for seed in range(3):
        e = estimate(recorded(drop, sensors, seed), sensors=path, backend="vm")
        assert e.believable, e.doubts
        assert e.path[1].alarms == ()
    ill = simulate_joint(
        Apu(),
        duration=3.0,
        load=SeriesLoad.from_power(200e3),
        events=[HealthChange(t=1.5, factors={"f_eta_t": 0.97})],
        waveform_dt=None,
        solver="propagator",
        dt=5e-3,
    )
    e = estimate(recorded(ill, sensors, 0), sensors=path, backend="vm")
    (alarm,) = json.loads(e.gaspath.attrs["alarms"])
    assert 1.5 < alarm < 2.0 and e.causes["gas path"][0].best == "gas path"
    assert e.believable, e.doubts


@pytest.mark.long
def test_a_prior_is_taken_and_a_wrong_state_named(drop, many):
    m = recorded(drop, many, 1)
    known = Prior({"f_eta_c": 1.0}, {"f_eta_c": 1e-4})
    e, free = (estimate(m, sensors=many, prior=p, backend="vm") for p in (known, None))
    first, own = (x.gaspath["f_eta_c_sigma"].values for x in (e, free))
    assert first[0] < 1.01e-4 and own[0] > 0.015
    for name, words in (("f_eta", "did you mean 'f_eta_"), ("h_a", "h_a is a severity")):
        with pytest.raises(DataError, match=words):
            estimate(m, sensors=many, prior=Prior({name: 1.0}), backend="vm")


def test_an_angle_is_read_modulo_a_turn(drop, tmp_path):
    """Declared in a file, measured, recorded and estimated: as one that counts its turns.

    What turns is a tenth of the speed, which is known to some 9 rad/s beforehand.
    """
    text = '[phase]\nquantity = "N"\nfactor = 0.1\nunit = "1"\nnoise = 0.5\n'
    found = {}
    for name, more in {"counts": "", "wrapped": "turn = 7.0\n"}.items():
        path = tmp_path / f"{name}.toml"
        path.write_text(text + more)
        of = read_sensors(path)
        recorded = measure_run(drop, Apu(), 3, sensors=of)["gaspath"]
        found[name] = estimate(read_recording(recorded), only="gaspath", sensors=of)
        found[f"{name} readings"] = recorded["phase"].values
    turns = (found["counts readings"] - found["wrapped readings"]) / 7.0
    assert np.allclose(turns, np.round(turns)) and np.ptp(found["wrapped readings"]) < 7.0
    assert np.abs(found["wrapped readings"]).max() <= 3.5 < found["counts readings"].min()
    counts, wrapped = found["counts"].gaspath, found["wrapped"].gaspath
    assert np.allclose(wrapped["N"], counts["N"], rtol=1e-9)
    assert np.allclose(wrapped["N_sigma"], counts["N_sigma"], rtol=1e-9)
    plain = estimate(read_recording(measure_run(drop, Apu(), 3)["gaspath"]), only="gaspath")
    assert float(wrapped["N_sigma"][-1]) < 0.8 * float(plain.gaspath["N_sigma"][-1])
    with pytest.raises(ParameterError, match="has no gain, delay"):
        Sensor("phase", 0.1, False, 0.1, "1", "", reads=("N",), turn=7.0, delay=0.1)
