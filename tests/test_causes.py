"""What a change is, told of runs in which it is known: phase, sensor, winding, harmonics, gas path.

The truths are joint runs of 0.2 s; sensors have gain errors and noise.
"""

import dataclasses

import numpy as np
import pytest

from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.faults.fieldshort import FieldShort
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange, HealthChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.believable import gas_doubts
from estimators.apu.creeping import creep
from estimators.apu.electrical.causes import causes_of_change
from estimators.apu.electrical.residuals import field_steps
from estimators.apu.gascauses import causes_of_alarms
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.healthjumps import Tracked
from estimators.apu.jointcases import joint_case
from estimators.apu.measuring import measure_run
from estimators.apu.recorded_estimate import estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensors import ELECTRICAL
from estimators.apu.unknowns import ETA_SIGMA
from scenarios.studies.flightruns import flown

# each runs a dozen filters that are made for it
pytestmark = pytest.mark.ci

APU, AT = Apu(), 0.1


def run(*events, apu=APU, duration=0.2, health=None):
    return simulate_joint(
        apu, duration=duration, load=SeriesLoad.from_power(150e3), events=events, dt=0.005,
        exchange="corrected", waveform_dt=1e-4, health=health,
    )  # fmt: skip


def waves(*events, apu=APU, seed=1, duration=0.2):
    made = measure_run(run(*events, apu=apu, duration=duration), APU, seed)["electrical"]
    return {"t": made["time"].values} | {str(n): made[n].values.copy() for n in made}


@pytest.fixture(scope="module")
def healthy():
    return waves()


def cause(samples):
    return causes_of_change(APU.generator.machine, ELECTRICAL, samples, AT)


@pytest.mark.parametrize("phase", "abc")
def test_a_short_circuit_and_its_phase(phase):
    """h = 5e-4: too small to be told from gain errors if it had been there before."""
    found = cause(waves(FaultChange(AT, Ttsc.of_h(0.02, 5e-4, phase=phase))))
    assert found.best == f"short circuit {phase}" and found.probability[found.best] > 0.99


def test_nothing_happened(healthy):
    found = cause(healthy)
    assert found.best == "healthy" and found.probability["healthy"] > 0.9
    assert sum(found.probability.values()) == pytest.approx(1.0)


def test_a_current_sensor_that_fails(healthy):
    t = healthy["t"]
    rng = np.random.default_rng(0)
    stuck = np.where(t >= AT, healthy["i_b"][int(np.searchsorted(t, AT))], healthy["i_b"])
    for n, v in (
        ("i_b", stuck),
        ("i_a", healthy["i_a"] + 20.0 * (t >= AT)),
        ("i_c", healthy["i_c"] + (t >= AT) * 10 * rng.standard_normal(t.size)),
    ):
        found = cause(healthy | {n: v})
        assert found.best == f"sensor {n}" and found.probability[found.best] > 0.99


def test_a_voltage_sensor_harmonics_a_hot_winding(healthy):
    t = healthy["t"]
    off = healthy | {"v_a": healthy["v_a"] + 10.0 * (t >= AT)}
    assert cause(off).best == "voltage sensors"
    fifth = {
        f"i_{p}": healthy[f"i_{p}"] + 5.0 * np.cos(5 * (2513.27 * t - k * 2.0944))
        for k, p in enumerate("abc")
    }
    assert cause(healthy | fifth).best == "harmonics"
    r_fd = APU.generator.machine.r_fd
    hot = APU.change({"machine.r_fd": 1.2 * r_fd})
    assert cause(waves(apu=hot)).best == "hot winding"


def test_shorted_turns_of_the_field(healthy):
    """4 % of them; the current's sensor alone may read less, which turns cannot make it."""
    field = waves(FaultChange(AT, FieldShort(0.04)))
    at = field["t"][field_steps(field, ELECTRICAL, [])[0] <= field["t"]][0]
    found = causes_of_change(APU.generator.machine, ELECTRICAL, field, float(at))
    assert found.best == "field winding" and found.probability[found.best] > 0.8
    t = healthy["t"]
    assert field_steps(healthy, ELECTRICAL, []) == []
    less = healthy | {"i_fd": healthy["i_fd"] * np.where(t >= AT, 0.96, 1.0)}
    assert field_steps(less, ELECTRICAL, []) == [pytest.approx(AT)]
    assert field_steps(less, ELECTRICAL, [AT - 0.01]) == []  # that is told
    assert cause(less).best == "sensor i_fd"


def test_too_few_samples_tell_nothing(healthy):
    early = {n: v[:80] for n, v in healthy.items()}
    assert causes_of_change(APU.generator.machine, ELECTRICAL, early, 0.005) is None


# ------------------------------------------------------------------------------ gas path


@pytest.fixture(scope="module")
def gas():
    """2 s of a healthy unit, and of one that loses 3 % of compressor efficiency at 1 s."""
    filt = gas_path_filter()
    lost = HealthChange(1.0, {"f_eta_c": 0.97})
    return filt, run(duration=2.0), run(lost, duration=2.0)


def test_a_shaft_power_that_drifts(gas):
    """By 10 % in 2 s: named with its size."""
    filt, quiet = gas_path_filter(eta=ETA_SIGMA, consider_eta=False), gas[1]
    for seed in range(3):
        data = filt.recording(quiet, seed)
        r = filt.run(data, backend="vm")
        assert not [*gas_doubts(filt, Tracked(r, (), (), data))]
        u = data.u.copy()
        u[filt.model.u.index("PW")] *= 1 + 0.1 * data.t / data.t[-1]
        off = dataclasses.replace(data, u=u)
        found = [*gas_doubts(filt, Tracked(filt.run(off, backend="vm"), (), (), off))]
        assert any(d.startswith("shaft power: it drifts by +") for d in found), found


def test_a_drift_that_hardly_shows_is_in_the_band(gas):
    """By 5 % in 2 s; and where nothing drifts the band is as it was, to a few per cent."""
    filt, quiet = gas_path_filter(eta=ETA_SIGMA, consider_eta=False), gas[1]
    truth = dict.fromkeys(HEALTH, 1.0)
    for seed in range(3):
        data = filt.recording(quiet, seed)
        u = data.u.copy()
        u[filt.model.u.index("PW")] *= 1 + 0.05 * data.t / data.t[-1]
        r, off = (filt.run(d, backend="vm") for d in (data, dataclasses.replace(data, u=u)))
        same = creep(filt, Tracked(r, (), (), data)).widened(r)
        assert np.all(same.variance >= r.variance)
        assert np.all(same.variance[:, -1] < 1.1 * r.variance[:, -1])
        found = creep(filt, Tracked(off, (), (), dataclasses.replace(data, u=u)))
        wide = found.widened(off)
        k = found.names.index("shaft power")  # drifts come first
        assert found.size[k] == pytest.approx(0.05, abs=4 * found.sigma[k])
        # what the drift moves is what the filters differ by
        moved = (off.mean - r.mean)[filt.model.x.index("f_eta_t"), -1]
        said = -0.05 * found.error[-1, filt.model.x.index("f_eta_t"), k]
        assert said == pytest.approx(moved, rel=0.3)
        assert max(abs(wide[n][0][-1] - v) / wide[n][1][-1] for n, v in truth.items()) < 3


def test_a_reading_beyond_its_stated_error(gas):
    """T5 5 % too high, ten times its sigma, moves four factors and shows in no innovation."""
    filt, quiet = gas_path_filter(eta=ETA_SIGMA, consider_eta=False), gas[1]
    z, moved = [], []
    for seed in range(4):
        data = filt.recording(quiet, seed, gains=joint_case(seed).gas_gains)
        y = data.y.copy()
        y[filt.model.y.index("T5")] *= 1.05
        off = dataclasses.replace(data, y=y)
        r = filt.run(off, backend="vm")
        found = creep(filt, Tracked(r, (), (), off))
        wide = found.widened(r, drifts=False)
        z.append(max(abs(r[n][0][-1] - 1) / r[n][1][-1] for n in HEALTH))
        moved.append(max(abs(wide[n][0][-1] - 1) / wide[n][1][-1] for n in HEALTH))
        doubts = [*gas_doubts(filt, Tracked(r, (), (), off), drifts=found)]
        surely = (found.probability * found.lasting).sum() > 0.5
        assert any(d.startswith("T5: an error of +") for d in doubts) == surely
    assert max(z) > 4 and max(moved) < 3.5, (z, moved)


def test_another_day(gas):
    """12 K warmer than was given; the recording says by how much, and it is no change of health."""
    filt, quiet = gas_path_filter(eta=ETA_SIGMA, consider_eta=False), gas[1]
    data = filt.recording(quiet, 1, gains=joint_case(1).gas_gains)
    u = data.u.copy()
    u[filt.model.u.index("dT_isa")] -= 12.0
    off = dataclasses.replace(data, u=u)
    tracked = Tracked(filt.run(off, backend="vm"), (), (), off)
    found = creep(filt, tracked)
    assert found.names[-1] == "dT_isa" and found.probability[-1] > 0.5
    assert found.size[-1] == pytest.approx(12.0, abs=3 * found.sigma[-1])
    assert any(d.startswith("dT_isa: an error of +") for d in gas_doubts(filt, tracked))


def test_health_that_was_off_before_is_no_error_of_a_sensor():
    """By as much as the prior has it probable, 2 % of each factor; 1.5 times that in this run."""
    filt = gas_path_filter(eta=ETA_SIGMA, consider_eta=False)
    factors = {"f_eta_c": 0.97, "f_W_c": 0.97, "f_eta_t": 0.97, "f_W_t": 1.03}
    worn = run(health=factors, duration=1.0)
    for seed in range(3):
        data = filt.recording(worn, seed, gains=joint_case(seed).gas_gains)
        r = filt.run(data, backend="vm")
        found = creep(filt, Tracked(r, (), (), data))
        assert (found.probability * found.lasting).sum() < 0.3
        assert not [*gas_doubts(filt, Tracked(r, (), (), data), drifts=found)]


def told(filt, data, k=55):
    r = filt.run(data, backend="vm")
    (c,) = causes_of_alarms(filt, Tracked(r, (k,), (k - 5,), data))
    return c


def test_the_gas_path_or_one_of_its_sensors(gas):
    filt, quiet, worn = gas
    c = told(filt, filt.recording(worn, 3))
    assert c.best == "gas path" and c.probability["gas path"] > 0.9
    assert max(c.failure["gas path"], key=c.failure["gas path"].get) == "f_eta_c"
    assert told(filt, filt.recording(quiet, 3)).best == "none"
    for name, share in (("P3", 0.04), ("T5", 0.06), ("T3", 0.06), ("N", 0.02)):
        data = filt.recording(quiet, 3)
        y = data.y.copy()
        y[filt.model.y.index(name), 50:] *= 1 + share
        c = told(filt, dataclasses.replace(data, y=y))
        assert c.best == f"sensor {name}" and c.probability[c.best] > 0.9, c.probability


@pytest.mark.parametrize("name", ["sensor P3", "sensor T5", "f_W_c"])
def test_large_steps_in_the_pipeline(name):
    """Of 4 %: a pressure was called a change of the gas path with a probability of 0.998."""
    found = flown(name, 0.04, 1)
    assert found["exact"] and found["said"] == ("gas path" if name in HEALTH else "sensor")


def test_a_short_circuit_where_both_windings_are_hot():
    """By 65 to 75 K: it was called shorted turns of the field with a probability of 0.99."""
    known = APU.parameters()
    warm = {"machine.r_s": 1.3, "machine.r_fd": 1.25}
    hot = APU.change({n: known[n] * v for n, v in warm.items()})
    fault = FaultChange(0.2, Ttsc.of_h(0.02, 4e-4, phase="b"))
    e = estimate(read_recording(waves(fault, apu=hot, duration=0.4)), only="electrical")
    (change,) = e.diagnoses
    assert change.best == "machine 1: short circuit b", change.probability
    assert change.probability[change.best] > 0.9 and e.believable, e.doubts


def test_a_sensor_that_drifts_or_is_noisy(gas):
    """No step: noise about what the others predict, of a size that is found."""
    filt, quiet, _ = gas
    rng, after = np.random.default_rng(1), np.arange(101) - 50
    for off in (0.002 * after.clip(0), 0.05 * rng.standard_normal(101) * (after > 0)):
        data = filt.recording(quiet, 3)
        y = data.y.copy()
        y[filt.model.y.index("T3")] *= 1 + off
        c = told(filt, dataclasses.replace(data, y=y), 75)
        assert c.best == "sensor T3" and c.probability[c.best] > 0.9, c.probability
