"""From a run to a recording to estimates: the very numbers of the estimation along the run.

The truth is the joint simulation of 0.2 s with a short circuit at 0.1 s.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core import results
from apu_casadi.core.errors import DataError, ParameterError
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.creeping import creep
from estimators.apu.electrical.sequences import sequences
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.healthjumps import track_jumps
from estimators.apu.joint import ETA_SIGMA, estimate_joint
from estimators.apu.jointcases import joint_case
from estimators.apu.measuring import measure_run, read_sensors, write_recording
from estimators.apu.recorded_estimate import estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensors import ELECTRICAL
from scenarios import cli
from scenarios.schema import Scenario
from scenarios.studies import jointrun

APU = Apu()
SEED = 3


@pytest.fixture(scope="module")
def run():
    fault = Ttsc(mu=0.05, k_rf=20.0, phase="a")
    return simulate_joint(
        APU, duration=0.2, load=SeriesLoad.from_power(100e3), events=[FaultChange(0.1, fault)],
        dt=0.005, exchange="corrected", waveform_dt=1e-4,
    )  # fmt: skip


@pytest.fixture(scope="module")
def readings(run):
    return measure_run(run, APU, SEED)


@pytest.fixture(scope="module")
def files(readings, tmp_path_factory):
    return write_recording(readings, tmp_path_factory.mktemp("recording") / "run.csv")


@pytest.fixture(scope="module")
def joint(files):
    return estimate(read_recording(*files), backend="vm")


def gas_of(readings, *names):
    """Arrays of some gas-path channels, as a user has them."""
    ds = readings["gaspath"]
    return {"t": ds["time"].values, **{n: ds[n].values for n in names}}


# ------------------------------------------------------------------------------ the same numbers


@pytest.mark.long
def test_run_measure_estimate_is_the_joint_estimation(run, joint):
    """Efficiency has no error in a recording: it is the truth's. All else is of the same draws."""
    case = joint_case(SEED)
    gains = {n: v for n, v in case.gas_gains.items() if n != "PW"}
    e = estimate_joint(
        run, SEED, apu=APU, gas_gains=gains, electrical_gains=case.electrical_gains, backend="vm"
    )
    assert joint.joint and joint.believable, joint.doubts
    for n in ("N", *HEALTH):
        assert_allclose(joint.gaspath[n], e[n], rtol=1e-7, err_msg=n)
        # a sensor that is off by more than was stated is in the band of a recording alone
        wider = joint.gaspath[f"{n}_sigma"].values / e[f"{n}_sigma"].values
        assert np.all((wider > 1 - 1e-7) & (wider < 1.1)), n  # most in the first samples
    machine = joint.machines[1]
    for n in ("h_a", "h_b", "h_c", "h_a_sigma", "P_total", "faulty_phase"):
        assert_allclose(machine[n], e[n], rtol=1e-6, atol=1e-10, err_msg=n)
    assert_allclose(machine["P_total_sigma"], e["P_total_sigma"], rtol=1e-6)
    for n in ("alarms", "onsets"):
        assert joint.gaspath.attrs[n] == e.attrs[n]
    resets = (json.loads(d.attrs["resets"]) for d in (machine, e))
    assert_allclose(*resets, atol=1e-12)  # times of a file are decimal
    report = joint.report()
    json.dumps(report, allow_nan=False)
    assert report["machines"]["1"]["alarms"] == [{"t": pytest.approx(0.12), "phase": "a"}]
    assert "short circuit in phase a, reported at 0.12 s" in joint.summary()


@pytest.mark.long
def test_gas_path_alone_is_the_filter_of_the_studies(run, files):
    filt = gas_path_filter(eta=ETA_SIGMA, consider_eta=False, consider_inertia=True)
    noise = np.random.default_rng([SEED, 2])
    data = filt.recording(run, noise, gains=joint_case(SEED).gas_gains)
    tracked = track_jumps(filt, data, backend="vm")
    drifts = creep(filt, tracked)
    r = drifts.widened(tracked.result)
    e = estimate(read_recording(files[0]), backend="vm")
    assert not e.joint and not e.machines and e.believable
    assert np.all(r.variance >= tracked.result.variance)
    for n in ("N", *HEALTH):
        assert_allclose(e.gaspath[n], r[n][0], rtol=1e-7, err_msg=n)
        assert_allclose(e.gaspath[f"{n}_sigma"], r[n][1], rtol=1e-7, err_msg=n)


@pytest.mark.long
def test_generators_alone(joint, files):
    e = estimate(read_recording(*files), only="electrical", backend="vm")
    assert e.gaspath is None
    for n in ("h_a", "h_a_sigma", "P_total"):
        assert_allclose(e.machines[1][n], joint.machines[1][n], rtol=1e-12)


@pytest.mark.long
def test_two_machines_and_their_mean_power(readings):
    """Machine 2 with other noise: power is the mean, known better than either's."""
    w = readings["electrical"]
    one = {f"{n}_1": w[n].values for n in w}
    two = {f"{n}_2": w[n].values for n in w}
    rng = np.random.default_rng(0)
    two |= {f"i_{p}_2": two[f"i_{p}_2"] + 0.1 * rng.standard_normal(w["time"].size) for p in "abc"}
    waves = {"t": w["time"].values, **one, **two}
    gas = gas_of(readings, "N", "P3", "T3", "T5", "Wf")
    e = estimate(read_recording(gas, waves), backend="vm")
    assert list(e.machines) == [1, 2] and e.joint
    assert not any("only machine" in n for n in e.notes)
    assert e.machines[2]["h_a"].values[-1] == pytest.approx(
        e.machines[1]["h_a"].values[-1], rel=0.1
    )


@pytest.mark.ci  # two joint estimates
def test_the_joint_command_writes_its_recording_and_estimates_from_it(run, tmp_path):
    """With the error of the efficiency, which is no sensor's; the file says the same again."""
    load = {"kind": "R", "power_kW": 100.0}
    fault = {"mu": 0.05, "k_rf": 20.0, "phase": "a"}
    phases = [
        {"name": "a", "start": 0.0, "load": load},
        {"name": "b", "start": 0.1, "fault": fault},
    ]
    s = Scenario.from_dict({"name": "x", "duration": 0.2, "phase": phases})
    ds = run.assign_attrs(scenario=s.to_json(), phases=json.dumps(s.phase_table()))
    e = jointrun.estimate(ds, SEED, folder=tmp_path)
    case = joint_case(SEED)
    gains = {"gas_gains": case.gas_gains, "electrical_gains": case.electrical_gains}
    own = estimate_joint(run, SEED, apu=APU, **gains)
    for n in ("N", *HEALTH, "h_a", "h_a_sigma", "h_a_true", "P_total", "P_total_true", "nis"):
        assert_allclose(e[n], own[n], rtol=1e-9, atol=1e-12, err_msg=n)
    assert json.loads(e.attrs["doubts"]) == []
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {"recording_gaspath.nc", "recording_electrical.nc"}


# ------------------------------------------------------------------------------ fewer channels


@pytest.mark.ci  # an estimate each
@pytest.mark.parametrize(
    ("names", "text"),
    [
        # half a minute
        pytest.param(ELECTRICAL.names, "jitter = 5e-6", marks=pytest.mark.slow),
        (("i_a", "i_b", "i_c"), "lag = 20e-6\ndelay = 5e-5"),
        (("i_a", "i_b", "i_c"), "quantum = 4.0\nrange = [-200, 200]"),
    ],
)
def test_declared_imperfections_of_the_generators_sensors(run, tmp_path, names, text):
    """No false alarm before the fault, found at the next sample, h within its band, believed."""
    path = tmp_path / "s.toml"
    path.write_text("".join(f"[{n}]\n{text}\n" for n in names))
    w = measure_run(run, APU, SEED, read_sensors(path))["electrical"]
    m = read_recording({"t": w["time"].values, **{n: w[n].values for n in w}})
    e = estimate(m, sensors=path, only="electrical")
    (machine,) = e.machines.values()
    phase = machine["faulty_phase"].sel(time=[0.1, 0.14, 0.2], method="nearest").values
    assert phase.tolist() == [0, 1, 1]
    for n, true in (("h_a", 0.05 / 20.95), ("h_b", 0.0), ("h_c", 0.0)):
        off = machine[n].values[-1] - true
        assert abs(off) < 3 * machine[f"{n}_sigma"].values[-1], n
    assert e.believable, e.doubts


@pytest.mark.ci  # two estimates of two machines
def test_a_channel_of_one_generator_has_a_sensor_of_its_own(readings, tmp_path):
    """i_a of machine 2 has a noise of 20 A: declared it is believed, else that machine is not."""
    w = readings["electrical"]
    waves = {f"{n}_{k}": w[n].values for n in w for k in (1, 2)}
    noise = 20.0 * np.random.default_rng(0).standard_normal(w["time"].size)
    waves |= {"t": w["time"].values, "i_a_2": w["i_a"].values + noise}
    path = tmp_path / "two.toml"
    path.write_text("[i_a_2]\nnoise = 20.0\n")
    m = read_recording(waves)
    e = estimate(m, sensors=path, only="electrical", backend="vm")
    assert e.believable, e.doubts
    for n, true in (("h_a", 0.05 / 20.95), ("h_b", 0.0)):
        x, s = (e.machines[2][f"{n}{end}"].values[-1] for end in ("", "_sigma"))
        assert abs(x - true) < 3 * s
    wrong = estimate(m, only="electrical", backend="vm")
    assert not wrong.believable and not wrong.belief["machine 1"] and wrong.belief["machine 2"]
    assert "doubted: machine 2" in wrong.summary() and "believed: machine 1" in wrong.summary()
    report = wrong.report()["belief"]
    assert [n for n, b in report.items() if b["believable"]] == [
        n for n in report if n.startswith("machine 1")
    ]


@pytest.mark.ci  # an estimate
def test_a_machine_whose_filter_is_lost_is_not_believed(readings):
    """A step of a voltage's offset by 30 V: no severity is estimated, and that is said."""
    w = readings["electrical"]
    waves = {"t": w["time"].values, **{n: w[n].values.copy() for n in w}}
    waves["v_a"] += 30.0 * (waves["t"] > 0.05)
    e = estimate(
        read_recording(gas_of(readings, "N", "P3", "T3", "T5", "Wf", "PW"), waves), backend="vm"
    )
    assert not e.believable and e.belief["machine 1"]
    assert all(e.belief[f"machine 1: h_{p}"] for p in "abc")
    if not e.machines:  # it was lost
        assert any("its filter is lost" in d for d in e.belief["machine 1"])
        assert not e.belief["gas path"] and "believed: gas path" in e.summary()


@pytest.mark.long
def test_a_subset_of_the_gas_path(readings):
    """Without shaft power, speed and temperatures: wider, and said so."""
    few = estimate(read_recording(gas_of(readings, "P3", "Wf")), backend="vm")
    all_ = estimate(
        read_recording(gas_of(readings, "N", "P3", "T3", "T5", "Wf", "PW")), backend="vm"
    )
    for n in HEALTH:
        assert few.gaspath[f"{n}_sigma"].values[-1] > all_.gaspath[f"{n}_sigma"].values[-1]
    assert "random walk" in few.summary() and "hardly tell" in few.summary()
    assert "dT_isa = 5 K" in few.summary()


def test_missing_samples_and_other_rates(readings):
    """T5 at 10 Hz, P3 with a gap, fuel flow with a missing sample: all are taken as they are."""
    gas = gas_of(readings, "N", "P3", "T3", "T5", "Wf", "PW")
    slow = {"t": gas["t"][::5], "T5": gas.pop("T5")[::5]}
    gas["P3"][3:6] = np.nan
    gas["Wf"][4] = np.nan
    e = estimate(read_recording(gas, slow), backend="vm")
    i = e.result.y.index("T5")
    assert np.isfinite(e.result.innovation[i]).sum() == 3
    assert e.believable


def test_three_currents_alone(readings):
    """Sequence components and no severity; the fault at half time doubles I2/I1 and more."""
    w = readings["electrical"]
    data = {"t": w["time"].values, **{f"i_{p}": w[f"i_{p}"].values for p in "abc"}}
    e = estimate(read_recording(data))
    assert e.gaspath is None and not e.machines
    (s,) = e.sequences.values()
    assert s.frequency[0] == pytest.approx(400, rel=0.01)
    assert abs(s.unbalance[-1]) > 3 * abs(s.unbalance[0])
    assert "needs w_r, v_a" in e.summary() and "severity h" not in e.summary()


@pytest.mark.parametrize("reverse", [False, True])
def test_sequences_of_a_known_machine(reverse):
    """50 Hz at 1 kHz, as public inter-turn data: the exact I2/I1, its noise, and its change."""
    rng = np.random.default_rng(1)
    t, f, ratio = np.arange(8000) * 1e-3, 49.3, 0.02 * np.exp(0.7j)
    now = ratio + np.where(t < 5.0, 0, 0.01)
    turn = np.exp(2j * np.pi / 3 * np.arange(3))[:, None] ** (-1 if not reverse else 1)
    x = (np.exp(2j * np.pi * f * t) * (turn + now * turn.conj())).real * 300
    s = sequences(t, x + rng.standard_normal(x.shape))
    assert_allclose(s.frequency, f, atol=0.02)
    assert_allclose(np.abs(s.components[0]), 300, rtol=2e-3)
    before = s.t < 5.0
    error = s.unbalance[before] - ratio
    assert np.sqrt(np.mean(np.abs(error) ** 2) / 2) == pytest.approx(s.sigma.mean(), rel=0.3)
    assert len(s.alarms) == 1 and 5.0 < s.alarms[0] < 5.4
    assert not sequences(t[:5000], x[:, :5000] + rng.standard_normal((3, 5000))).alarms
    # windows that are fitted together do not hang on each other: a gap changes its own alone
    x[1, 2510:2520] = np.nan
    holed, full = sequences(t, x), sequences(t, np.where(np.isnan(x), 0.0, x))
    others = np.arange(full.t.size) != np.searchsorted(full.t, 2.51)
    assert_allclose(holed.components[:, others], full.components[:, others], rtol=1e-12)
    assert (np.abs(holed.components - full.components)[:, ~others] > 0.1).all()


def test_what_cannot_be_used_is_refused(readings):
    w = readings["electrical"]
    slow = {"t": w["time"].values[::20], **{f"i_{p}": w[f"i_{p}"].values[::20] for p in "abc"}}
    with pytest.raises(DataError, match=r"500 samples a second show nothing of 400 Hz: 800"):
        estimate(read_recording(slow))
    with pytest.raises(DataError, match="takes the fuel flow Wf as an input, which was not"):
        estimate(read_recording(gas_of(readings, "N", "P3")))
    with pytest.raises(DataError, match="none of P3, T3, T5 was measured"):
        estimate(read_recording(gas_of(readings, "N", "Wf")))
    m = read_recording(gas_of(readings, "N", "P3", "Wf"))
    with pytest.raises(DataError, match="generators: nothing of them was measured"):
        estimate(m, only="electrical")
    with pytest.raises(ParameterError, match="did you mean 'gaspath'"):
        estimate(m, only="gas-path")
    with pytest.raises(DataError, match="altitude = 20000 m is outside"):
        estimate(m, ambient={"altitude": 2e4})


@pytest.mark.long
def test_a_gap_of_the_fuel_flow_is_bridged(readings):
    """A second is missing, in all or in the fuel alone: the estimates go on, a little wider."""
    names = ("N", "P3", "T3", "T5", "Wf", "PW")
    gas = {n: np.tile(v, 12) for n, v in gas_of(readings, *names).items()}
    gas["t"] = 0.02 * np.arange(gas["N"].size)
    whole = estimate(read_recording(gas), backend="vm")
    lost = (gas["t"] > 0.81) & (gas["t"] < 1.79)
    holed = {n: v[~lost] for n, v in gas.items()}
    unfed = gas | {"Wf": np.where(lost, np.nan, gas["Wf"])}
    for data, names in ((holed, "Wf, PW"), (unfed, "Wf")):
        e = estimate(read_recording(data), backend="vm")
        assert any(n.startswith(f"{names}: no reading from 0.8 to 1.8 s") for n in e.notes)
        assert not json.loads(e.gaspath.attrs["alarms"]) and e.believable
        inside = (e.gaspath.time > 1.0) & (e.gaspath.time < 1.7)
        assert e.gaspath["N_sigma"].values[inside].min() > 20.0  # and found again
        # 82 of 132 samples are left: sqrt(132/82) = 1.27
        assert e.gaspath["N_sigma"].values[-1] < 1.27 * whole.gaspath["N_sigma"].values[-1]
        for n in HEALTH:
            (x, s), (y, r) = (
                (float(g[n][-1]), float(g[f"{n}_sigma"][-1])) for g in (e.gaspath, whole.gaspath)
            )
            # what wrong readings may have moved is in both, and hangs on the readings themselves
            assert 0.98 * r < s < 1.2 * r and abs(x - y) < s


@pytest.mark.long
def test_a_wrong_sensor_is_doubted(readings):
    """T5 is 10 % too high in each second sample: no health explains that."""
    gas = {n: np.tile(v, 4) for n, v in gas_of(readings, "N", "P3", "T3", "T5", "Wf", "PW").items()}
    gas["t"] = 0.02 * np.arange(gas["t"].size)
    assert estimate(read_recording(gas), backend="vm").believable
    gas["T5"] = gas["T5"] * np.where(np.arange(gas["t"].size) % 2, 1.1, 1.0)
    e = estimate(read_recording(gas), backend="vm")
    assert not e.believable and any(d.startswith("T5: its innovations") for d in e.doubts)
    assert "NOT TO BE BELIEVED" in e.summary()


@pytest.mark.long
def test_a_short_circuit_too_small_to_report_is_no_change_of_health():
    """h = 7e-5 is not reported, but neither is the change of health believed; 5e-4 is reported."""
    for k_rf, found in ((713.0, False), (100.0, True)):
        fault = Ttsc(mu=0.05, k_rf=k_rf, phase="b")
        ds = simulate_joint(
            APU, duration=0.2, load=SeriesLoad.from_power(100e3), health={"f_eta_c": 0.94},
            fault=fault, dt=0.005, waveform_dt=1e-4,
        )  # fmt: skip
        made = measure_run(ds, APU, SEED, gains=False)
        arrays = ({"t": d["time"].values, **{n: d[n].values for n in d}} for d in made.values())
        e = estimate(read_recording(*arrays), backend="vm")
        assert "f_eta_c" in e.report()["gaspath"]["changed"]
        phases = e.machines[1]["faulty_phase"].values
        assert set(phases) == ({0, 2} if found else {0})
        h, sigma = (e.machines[1][n].values[-1] for n in ("h_b", "h_b_sigma"))
        assert abs(h - 0.05 / (k_rf + 0.95)) < 3 * sigma
        assert any(d.startswith("a short circuit of h_b") for d in e.doubts) != found


@pytest.mark.long
def test_a_filter_that_begins_again_and_again_is_doubted(readings):
    """All currents jump by 30 % every 25 ms, and nothing else does."""
    w = readings["electrical"]
    data = {n: w[n].values.copy() for n in w}
    t = w["time"].values
    for p in "abc":
        data[f"i_{p}"] *= 1 + 0.3 * ((t > 0.03) & (t % 0.05 < 0.025))
    e = estimate(read_recording({"t": t, **data}), backend="vm")
    assert any("began anew" in d for d in e.doubts) or "resets" in e.lacking["severity, machine 1"]


def test_a_stuck_sensor_is_doubted(readings):
    gas = {n: np.tile(v, 4) for n, v in gas_of(readings, "N", "P3", "T3", "T5", "Wf").items()}
    gas["t"] = 0.02 * np.arange(gas["t"].size)
    gas["T5"][10:] = gas["T5"][10]
    e = estimate(read_recording(gas), backend="vm")
    assert any("T5 stands still from 0.2 to 0.86 s" in d for d in e.doubts)


@pytest.mark.long
def test_waveforms_of_a_short_part(readings):
    """Then the gas path keeps its own shaft power, and both are estimated."""
    gas = {n: np.tile(v, 4) for n, v in gas_of(readings, "N", "P3", "T3", "T5", "Wf", "PW").items()}
    gas["t"] = 0.02 * np.arange(gas["t"].size)
    w = readings["electrical"]
    e = estimate(read_recording(gas, {"t": w["time"].values, **{n: w[n].values for n in w}}))
    assert not e.joint and e.gaspath["time"].size == 44 and list(e.machines) == [1]
    assert any("cover less than half" in n for n in e.notes)


@pytest.mark.long
def test_generators_that_differ():
    """Each is measured and estimated as itself; r_s of the second is 20 % higher, its gear lower.

    Their powers make the shaft power; of one alone nothing is known of it.
    """
    unit = APU.change({"generator2.machine.r_s": 1.2 * 0.0044, "generator2.coupling.gear": 3.05})
    loads = [SeriesLoad.from_power(100e3), SeriesLoad.from_power(60e3)]
    ds = simulate_joint(unit, duration=0.1, load=loads, dt=0.005, waveform_dt=1e-4)
    made = measure_run(ds, unit, SEED)
    assert {"i_a_1", "i_a_2", "w_r_2"} <= set(made["electrical"])
    arrays = [{"t": d["time"].values, **{n: d[n].values for n in d}} for d in made.values()]
    del arrays[0]["PW"]
    e = estimate(read_recording(*arrays), unit, backend="vm")
    assert list(e.machines) == [1, 2] and e.joint
    assert not any("differ" in n or "only" in n for n in e.notes)
    for n in HEALTH:
        assert abs(e.gaspath[n].values[-1] - 1) < 3 * e.gaspath[f"{n}_sigma"].values[-1]
    for m in e.machines.values():
        assert abs(m["h_a"].values[-1]) < 4 * m["h_a_sigma"].values[-1]
        assert not m["faulty_phase"].values.any()
    power = [m["P_total"].values[-1] for m in e.machines.values()]
    assert power[0] / power[1] == pytest.approx(100 / 60, rel=0.1)
    second = {n: v for n, v in arrays[1].items() if not n.endswith("_1")}
    alone = estimate(read_recording(arrays[0], second), unit, backend="vm")
    assert list(alone.machines) == [2] and not alone.joint
    assert any("differ, and generator 1 is not estimated" in n for n in alone.notes)
    assert alone.gaspath["f_eta_c_sigma"].values[-1] > e.gaspath["f_eta_c_sigma"].values[-1]


# ------------------------------------------------------------------------------ sensors, files


def test_a_file_of_sensors(run, tmp_path):
    path = tmp_path / "sensors.toml"
    path.write_text(
        "[T5]\nnoise = 0.0\ngain = 0.0\nrate = 10\n[T41]\n[i_a]\nnoise = 0\ngain = 0.01\n"
    )
    s = read_sensors(path)
    made = measure_run(run, APU, SEED, s)
    t5 = made["gaspath"]["T5"].values
    rows = np.searchsorted(run["time"].values, made["gaspath"]["time"].values - 1e-7)
    assert_allclose(t5[::5], run["T5"].values[rows][::5], rtol=1e-12)
    assert np.isnan(t5[1:5]).all() and "T41" in made["gaspath"]
    ratio = made["electrical"]["i_a"].values[5:] / run["i_a"].values[5:]
    assert np.ptp(ratio) < 1e-9 and 1e-4 < abs(ratio[0] - 1) < 0.04
    exact = measure_run(run, APU, None)["gaspath"]
    assert_allclose(exact["P3"], run["P3"].values[rows], rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[T55]\nnoise = 1", "unknown sensor 'T55' .did you mean 'T5'"),
        ("[T5]\nnoize = 1", "T5: unknown key 'noize' .did you mean 'noise'"),
        ("[T5]\nnoise = -1", "noise must be a number >= 0, got -1"),
        ("[T5]\nrate = 0", "rate must be a number > 0"),
        ("T5 = 1", r"a table \[T5\] is expected"),
        ("[T5", "no TOML"),
    ],
)
def test_wrong_sensor_files(tmp_path, text, words):
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(DataError, match=words):
        read_sensors(path)


@pytest.mark.parametrize("ending", [".csv", ".nc", ".parquet"])
def test_all_formats_hold_the_same(readings, tmp_path, ending):
    made = write_recording(readings, tmp_path / f"r{ending}")
    assert [p.stem for p in made] == ["r_gaspath", "r_electrical"]
    m = read_recording(*made)
    for kind, names in (("gaspath", ("T5", "PW", *CONDITIONS)), ("electrical", ("i_a", "w_r"))):
        for n in names:
            assert_allclose(m[n].values, readings[kind][n].values, rtol=1e-10, atol=1e-12)


@pytest.mark.long
def test_commands(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results.save(run, "run.nc")
    assert cli.main(["measure", "run.nc", "--seed", "3", "--out", "r.csv"]) == 0
    said = capsys.readouterr().out
    assert "r_electrical.csv: v_a" in said and "note:" not in said
    coarse = json.loads(run.attrs["solver"]) | {"exchange": "paper", "dt": 0.02}
    results.save(run.assign_attrs(solver=json.dumps(coarse)), "coarse.nc")
    assert cli.main(["measure", "coarse.nc", "--out", "c.csv"]) == 0
    said = capsys.readouterr().out
    assert "note: with exchange 'paper' every 20 ms speed and voltage have kinks" in said
    assert len(pd.read_csv("r_gaspath.csv")) == 11
    Path("p.toml").write_text("[f_eta_c]\nsigma = 1e-4\n")
    Path("s.toml").write_text("[T5]\nlag = 0.1\n")
    command = ["estimate", "data", "r_gaspath.csv", "--altitude", "100", "--out", "o", "--json"]
    command += ["--prior", "p.toml", "--sensors", "s.toml"]
    assert cli.main(command) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["believable"] and set(found["gaspath"]["values"]) >= {"N", *HEALTH}
    assert not any("assumed" in n for n in found["notes"])
    assert found["gaspath"]["values"]["f_eta_c"]["half_width"] < 4e-4
    names = {p.name for p in (tmp_path / "o").iterdir()}
    assert names == {"estimate_gaspath.nc", "estimate.json", "estimate.png"}
    assert (tmp_path / "o" / "estimate.png").stat().st_size > 10_000
    for wrong, words in (
        (["measure", "run.nc"], "--out FILE is needed"),
        (["measure", "run.nc", "--out", "r.xlsx"], ".csv, .parquet, .nc is expected"),
        (["measure", "run.nc", "--out", "r.csv", "--seed", "-1"], "--seed must be >= 0"),
        (["estimate", "data", "none.csv"], "none.csv"),
        (["estimate", "data", "r_gaspath.csv", "--column", "T55=T5"], "unknown quantity"),
    ):
        assert cli.main(wrong) != 0
        assert words in capsys.readouterr().err


@pytest.mark.long
def test_noise_is_tuned_from_a_recording(files, tmp_path, capsys):
    """The command: ten samples know the noise of T5 to a quarter; JSON, figure and text agree."""
    gas = str(files[0])
    assert cli.main(["tune", gas, "--noise", "T5", "--walk", "", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    report = json.loads((tmp_path / "tune.json").read_text())
    (row,) = report["estimates"]
    assert (row["name"], row["kind"], row["unit"]) == ("T5", "noise", "K")
    assert row["low"] < row["estimate"] < row["high"] and 0.3 < row["estimate"] / row["start"] < 2
    assert report["loglik"] >= report["loglik_start"]
    assert f"noise of output T5       {row['start']:>11.4g}  {row['estimate']:>10.4g}" in said
    assert (tmp_path / "tune.png").stat().st_size > 10_000
    assert cli.main(["tune", gas, "--noise", "T9", "--walk", ""]) == 2
    assert "noise of output 'T9'" in capsys.readouterr().err


@pytest.mark.ci  # derivatives of the electrical filter
def test_noise_of_a_generator_is_tuned(run, tmp_path, capsys):
    """0.1 s without a fault: the noise that was drawn is in the band, of reading and input."""
    made = measure_run(run.sel(time_w=slice(None, 0.09)), APU, SEED)["electrical"]
    write_recording({"electrical": made}, tmp_path / "waves.csv")
    args = ["tune", str(tmp_path / "waves.csv"), "--noise", "i_a", "--inputs", "v_a", "--json"]
    assert cli.main(args) == 0
    report = json.loads(capsys.readouterr().out)
    volt, ampere = report["estimates"]
    assert (volt["name"], ampere["name"]) == ("w_v_a", "i_a")
    for row in (volt, ampere):
        assert row["low"] < 1.1 and row["high"] > 0.9 and row["high"] / row["low"] < 1.5
    assert cli.main([*args[:2], "--machine", "2"]) != 0
    assert "generator 2 was not measured" in capsys.readouterr().err
    assert cli.main([*args[:2], "--only", "gaspath"]) != 0


@pytest.mark.ci  # four estimates
def test_late_stamps_and_rows_in_disorder_from_the_command_line(readings, tmp_path, capsys):
    """T5 comes two samples late, as declared: the same as in time, but for the last two, which are
    not there yet. Rows in disorder are refused, and the same when they are sorted."""
    ds = readings["gaspath"]
    table = ds[["N", "P3", "T3", "T5", "Wf", "PW"]].to_dataframe().reset_index()

    def said(frame, *more):
        path = tmp_path / "run.csv"
        frame.to_csv(path, index=False)
        assert cli.main(["estimate", "data", str(path), "--json", *more]) == 0
        return json.loads(capsys.readouterr().out)["gaspath"]["values"]

    late, known = table.copy(), table.copy()
    late["T5"] = table["T5"].shift(2)
    known.loc[known.index[-2:], "T5"] = np.nan
    sensors = tmp_path / "late.toml"
    sensors.write_text("[T5]\ndelay = 0.04\n")
    one, other = said(late, "--sensors", str(sensors)), said(known)
    disorder = known.sample(frac=1.0, random_state=1)
    again = said(disorder, "--sort")
    for n in ("N", *HEALTH):
        for key in ("estimate", "half_width"):
            assert_allclose(one[n][key], other[n][key], rtol=1e-9, err_msg=n)
            assert_allclose(again[n][key], other[n][key], rtol=1e-9, err_msg=n)
    assert cli.main(["estimate", "data", str(tmp_path / "run.csv")]) != 0
    assert "--sort" in capsys.readouterr().err
