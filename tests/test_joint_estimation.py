"""Joint estimation: what the electrical filter hands to the gas-path filter, and back.

The truth is the joint simulation with exchange "corrected" in steps of 5 ms, integrated by CVODES.
"""

import json

import numpy as np
import pytest

from apu_casadi.core.errors import DataError, EstimationError
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange, LoadChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.electrical import tracking
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.electrical.terminalsignals import GAIN_SENSORS
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.joint import (
    ETA_SIGMA,
    GAIN_SHARE,
    electrical_samples,
    electrical_side,
    estimate_joint,
    speed_from_generators,
)
from estimators.apu.jointcases import joint_case
from estimators.apu.monolithic_filter import compare_monolithic, monolithic_filter
from estimators.apu.sensors import ELECTRICAL
from estimators.apu.unknowns import UNKNOWNS, Knowledge
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import run as run_filter
from estimators.models.filtermodel import Unknown

APU = Apu()
FAULT = Ttsc(mu=0.05, k_rf=20.0, phase="a")
H = 0.05 / 20.95


def truth(waveform_dt):
    return simulate_joint(
        APU, duration=0.2, load=SeriesLoad.from_power(100e3), events=[FaultChange(0.1, FAULT)],
        dt=0.005, exchange="corrected", waveform_dt=waveform_dt,
    )  # fmt: skip


@pytest.fixture(scope="module")
def run():
    return truth(1e-4)


@pytest.fixture(scope="module")
def estimates(run):
    return {
        ttsc: estimate_joint(run, 1, apu=APU, ttsc=ttsc, backend="vm") for ttsc in (True, False)
    }


def test_a_short_circuit_is_found_and_its_power_accounted_for(estimates):
    e = estimates[True]
    assert json.loads(e.attrs["resets"]) == [pytest.approx(0.1, abs=0.01)]
    assert list(e["faulty_phase"].values[[3, -1]]) == [0, 1]
    assert abs(e["h_a"].values[-1] - H) < 4 * e["h_a_sigma"].values[-1]
    np.testing.assert_allclose(e["h_a_true"].values[[3, -1]], [0, H])
    # power of each window but those of the reset, 0.1 % of 285 kW: there are no gain errors here
    error = (e["P_total"] - e["P_total_true"]).values[1:]
    assert np.abs(np.delete(error, [4, 5, 6])).max() < 4 * 300
    # what is claimed holds those that there might be, beside the efficiency
    share = e["P_total_sigma"].values[-1] / e["P_total"].values[-1]
    assert np.sqrt(share**2 - ETA_SIGMA**2) == pytest.approx(GAIN_SHARE, rel=0.1)


def test_no_health_fault_is_seen_in_a_short_circuit(estimates):
    e = estimates[True]
    assert e.attrs["alarms"] == "[]"
    for n in HEALTH:
        assert abs(e[n].values[-1] - 1) < 3 * e[f"{n}_sigma"].values[-1]


def test_without_the_short_circuit_in_the_filter_its_loss_is_missing(estimates, run):
    """The loss of both machines over the efficiency: what the gas path would have to explain."""
    healthy = estimates[False]
    lost = (healthy["P_total_true"] - healthy["P_total"]).values[-1]
    loss = 2 * run["P_loss_fault"].values[-1] / 0.9
    assert loss > 10e3
    assert lost > 0.3 * loss


def test_speed_of_the_generators_is_better_than_the_sensor(estimates):
    e = estimates[True]
    error = (e["N"] - e["N_true"]).values[1:]
    assert np.abs(error / e["N_sigma"].values[1:]).max() < 4.5
    # 0.05 % pick-ups, 200 samples; the sensor's 0.25 % is 9 rad/s
    assert e["N_sigma"].values[-1] < 0.5


def test_speed_from_a_parabola_is_exact_and_its_sigma_right():
    """Noise-free: exact.  With noise: the spread over many windows is the stated one."""
    t_w, t = np.arange(0, 2.0, 1e-4), np.arange(0, 2.0, 0.02)
    N = 3775 + 30 * t - 20 * t**2
    w_r = APU.w_r(3775 + 30 * t_w - 20 * t_w**2)
    found, sigma = speed_from_generators(t_w, w_r, 1.0, t, APU)
    np.testing.assert_allclose(found[1:], N[1:], rtol=1e-9)
    assert np.isinf(sigma[0])
    noise = np.random.default_rng(1).standard_normal(w_r.size)
    found, _ = speed_from_generators(t_w, w_r + noise, 1.0, t, APU)
    # 99 windows: standard error of a standard deviation 7 %
    assert np.std((found - N)[1:] / sigma[1:]) == pytest.approx(1, abs=0.21)


@pytest.mark.slow
def test_the_coupled_filters_are_the_monolithic_one():
    """One filter of the whole unit at 10 kHz, on a window with a load drop.

    The coupled pair may lose information (a window's samples are one measurement, speed is a fit),
    but little of health and h, and may not claim more than the monolithic filter.
    """
    ds = simulate_joint(
        APU, duration=0.3, load=SeriesLoad.from_power(225e3),
        events=[LoadChange(0.1, SeriesLoad.from_power(100e3))], dt=0.005, exchange="corrected",
        waveform_dt=1e-4,
    )  # fmt: skip
    c = compare_monolithic(ds, 1)
    for n in HEALTH:
        # an estimate that loses information differs from the best one by sqrt(1 - ratio^2) sigmas
        # rms; over the first windows the ratio is 0.946, that is 0.32, and three times that is 1
        assert c[n]["difference_max"] < 1.0
        assert 0.93 < c[n]["sigma_ratio"] < 1.005  # monolithic over coupled
    for n in ("h_a", "h_b", "h_c"):
        assert c[n]["difference_max"] < 1.0
        assert c[n]["sigma_ratio"] == pytest.approx(1, abs=0.02)


def test_samples_carry_noise_and_gains(run):
    clean = electrical_samples(run, APU, None)
    gained = electrical_samples(run, APU, None, gains={"v_b": 0.01})
    np.testing.assert_allclose(gained["v_b"], 1.01 * clean["v_b"])
    noisy = electrical_samples(run, APU, np.random.default_rng(1))
    # 2001 numbers: standard error 1.6 %
    assert np.std(noisy["i_a"] - clean["i_a"]) == pytest.approx(1.0, rel=0.06)
    assert clean["w_r"][0] == pytest.approx(APU.w_r(APU.N_ref), rel=1e-6)


def test_a_run_without_waveforms_is_refused():
    with pytest.raises(DataError, match="waveform_dt=1e-4"):
        estimate_joint(truth(None), 1, apu=APU)


def test_cases_of_a_seed_are_reproducible():
    a, b, c = joint_case(1), joint_case(1), joint_case(2)
    assert a == b != c
    assert set(a.gas_gains) == {"P3", "T3", "T5", "Wf", "PW"}


@pytest.mark.long
def test_late_currents_are_told_as_their_delay(run):
    """The model's derivative by the delay against currents interpolated at earlier instants."""
    measured = electrical_samples(run, APU, np.random.default_rng(1), delay=2e-5)
    first = {n: v[:900] for n, v in measured.items()}  # before the fault
    filt = electrical_filter(gains="estimate", phases=(), free={"delay_i": Unknown()})
    # against gain errors a delay shows in the field current: small ones leave it alone
    sigma = {f"gain_{n}": 1e-5 for n in GAIN_SENSORS} | {"delay_i": 5e-5}
    prior = filt.prior(first, sigma=sigma)
    r = run_filter(ekf_step(filt.model), prior, filt.recording(first), backend="vm")
    delay, s = (float(v[-1]) for v in r["delay_i"])
    assert s < 1e-6 and abs(delay - 2e-5) < 4 * s


@pytest.mark.long
def test_late_currents_are_within_what_is_claimed_of_the_power(run):
    measured = electrical_samples(run, APU, np.random.default_rng(1), delay=1e-5)
    t = np.arange(0, 0.08 + 1e-9, 0.02)
    first = {n: v[:801] for n, v in measured.items()}
    side = electrical_side(APU, ELECTRICAL, first, t, backend="vm")
    true = float(run["P_total"].values[8])
    assert abs(side.P[-1] - true) < 3 * np.sqrt(side.given_efficiency[-1])
    assert side.eta == ETA_SIGMA and side.variance[-1] > (ETA_SIGMA * side.P[-1]) ** 2
    # what is known of the efficiency is taken at its word
    known = UNKNOWNS | {"machine.eta_sg": Knowledge("known")}
    exact = electrical_side(APU, ELECTRICAL, first, t, unknowns=known, backend="vm")
    np.testing.assert_allclose(exact.variance, side.given_efficiency)


@pytest.mark.long
def test_a_hot_field_is_no_short_circuit():
    """The field's resistance is 20 % more than the filters know, 50 K."""
    hot = APU.change({"machine.r_fd": 1.2 * APU.generator.machine.r_fd})
    ds = simulate_joint(
        hot, duration=0.1, load=SeriesLoad.from_power(100e3), dt=0.005, exchange="corrected",
        waveform_dt=1e-4,
    )  # fmt: skip
    gains = joint_case(1).electrical_gains
    measured = electrical_samples(ds, APU, np.random.default_rng(1), gains=gains)
    t = np.arange(0, 0.1 + 1e-9, 0.02)
    side = electrical_side(APU, ELECTRICAL, measured, t, backend="vm")
    assert not side.phase.any() and side.resets == () and side.probability[-1] < 0.1
    assert side.misfit[-1] < 25
    taken = {n: Knowledge("known") for n in ("machine.r_s", "machine.r_fd")}
    blind = electrical_side(APU, ELECTRICAL, measured, t, unknowns=taken, backend="vm")
    assert blind.misfit[-1] > 25 or blind.resets


@pytest.mark.long
def test_which_machine_is_found():
    """A short circuit in phase b of the second; each has gain errors of its own."""
    ds = simulate_joint(
        APU, duration=0.1, load=SeriesLoad.from_power(100e3),
        events=[FaultChange(0.04, Ttsc(mu=0.05, k_rf=20.0, phase="b"), generator=2)], dt=0.005,
        exchange="corrected", waveform_dt=1e-4,
    )  # fmt: skip
    case = joint_case(1, machines=2)
    gains = {"gas_gains": case.gas_gains, "electrical_gains": case.electrical_gains}
    e = estimate_joint(ds, 1, apu=APU, **gains, backend="vm")
    assert list(e["faulty_phase_1"].values) == [0] * 6
    assert list(e["faulty_phase_2"].values) == [0, 0, 0, 2, 2, 2]
    assert e["ttsc_probability_1"].values[-1] < 0.1 < 0.99 < e["ttsc_probability_2"].values[-1]
    of = json.loads(e.attrs["compared"])["machines"]
    assert of["1"]["probability"] < 0.05 < 0.98 < of["2"]["probability"]
    assert of["2"]["likeliest_phase"] == "b"
    assert e.attrs["alarms"] == "[]"
    for n, true in (("h_b_2", H), ("h_b_1", 0.0), ("P_total", e["P_total_true"].values[-1])):
        assert abs(e[n].values[-1] - true) < 4 * e[f"{n}_sigma"].values[-1]
    np.testing.assert_allclose(e["h_b_2_true"].values, [0, 0, 0, H, H, H])


def test_a_recording_in_pieces_is_filtered_as_a_whole(run, monkeypatch):
    """Resets and beliefs do not hang on how much is filtered before it is judged."""
    filt = electrical_filter(power=True)
    measured = electrical_samples(run, APU, np.random.default_rng(1))
    data = filt.recording(measured).part(0, 1500)
    at = np.array([0, 399, 400, 1103])
    found = []
    for pieces in (8, 1000):
        monkeypatch.setattr(tracking, "CHUNK", pieces * tracking.RESET_WINDOW)
        found.append(tracking.track(filt, filt.prior(measured), data, backend="vm", cov_at=at))
    (a, resets), (b, same) = found
    assert resets == same == [pytest.approx(0.1, abs=0.01)]
    np.testing.assert_allclose(a.mean, b.mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(a.some_cov, b.some_cov, rtol=1e-6, atol=1e-18)
    variance = a.some_cov.diagonal(axis1=1, axis2=2).T
    np.testing.assert_allclose(variance, a.variance[:, at], rtol=1e-12)
    assert a.loglik == pytest.approx(b.loglik, rel=1e-12)


@pytest.mark.slow
def test_two_different_machines_in_one_filter():
    """Own parameters, gear and load of each: as the coupled filters, and surer of the speed."""
    unit = APU.change({"generator2.machine.r_s": 0.006, "generator2.coupling.gear": 3.05})
    ds = simulate_joint(
        unit,
        duration=0.14,
        load=[SeriesLoad.from_power(225e3), SeriesLoad.from_power(150e3)],
        events=[LoadChange(0.06, SeriesLoad.from_power(180e3), generator=1)],
        dt=0.005,
        exchange="corrected",
        waveform_dt=1e-4,
    )
    c = compare_monolithic(ds, 1, apu=unit)
    for n in (*HEALTH, *(f"generator{k}.h_{p}" for k in (1, 2) for p in "abc")):
        assert c[n]["difference_max"] < 1.0, n
        assert 0.8 < c[n]["sigma_ratio"] < 1.01, n
    assert c["N"]["sigma_ratio"] < 0.5


def test_wrong_groups_of_the_filter_of_the_unit_are_told():
    electrical = electrical_filter(APU.generator.machine, power=True)
    gas = gas_path_filter(APU.gas_generator, gains=False, inertia=None)
    other = APU.change({"generator2.machine.r_s": 0.006})
    with pytest.raises(EstimationError, match="generators 1 and 2 differ"):
        monolithic_filter(other, electrical, gas)
    with pytest.raises(EstimationError, match="one for each group is needed"):
        monolithic_filter(APU, (electrical,) * 3, gas)
    two = monolithic_filter(other, (electrical, electrical), gas)
    assert two.of == ((1,), (2,)) and "generator2.h_a" in two.model.x
    one = monolithic_filter(APU, electrical, gas)
    assert "h_a" in one.model.x and len(two.model.x) == 2 * len(electrical.model.x) + 6
    n, dt = len(two.model.x), 1e-4
    # the same state in both parts: the rotor goes on as that of the one
    x1 = electrical.model.x.nominals * 0.3
    N = np.array([APU.N_ref, 1.0, 1.0, 1.0, 1.0, 0.0])
    u = electrical.model.u.pack({k: 0.0 for k in electrical.model.u.names})
    more = gas.model.u.unpack(np.zeros(len(gas.model.u))) | {
        "Wf": 0.04,
        "sigma_Wf": 0.0,
        "since": 0.0,
    }
    more |= {"altitude": 0.0, "Mach": 0.0, "dT_isa": 5.0, "war": 0.0, "fresh": 0.0}
    ends = []
    for filt, parts in ((one, 1), (two, 2)):
        m = filt.model
        rest = np.array([more[k] for k in m.u.names[parts * len(u) :]])
        x, w = np.concatenate([*[x1] * parts, N]), np.zeros(len(m.w))
        made, check = m.transition(x, np.concatenate([*[u] * parts, rest]), [], w, dt)
        assert float(check) < 1e-6
        ends.append(made.full().ravel()[m.x.index("N")])
    assert ends[0] == pytest.approx(ends[1], rel=1e-12) and n > 20
