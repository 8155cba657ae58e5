"""Doubts: tests of innovations keep their level and find what they are for, sensor by sensor."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.signals import Signals
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.machine.terminals import OUTPUTS
from estimators.apu import believable
from estimators.apu.believable import KINDS, LEVEL, machine_causes, standing_still
from estimators.apu.diagnosis import diagnoses
from estimators.apu.electrical import residuals
from estimators.apu.electrical.causes import PRIOR, Causes, probabilities
from estimators.apu.electrical.hypotheses import Hypotheses
from estimators.apu.electrical.residuals import unexplained_waves
from estimators.apu.electrical.terminalsignals import MEASURED
from estimators.apu.electrical.wild import wild_samples
from estimators.apu.sensorfailures import failure
from estimators.apu.sensors import ELECTRICAL
from estimators.apu.trust import Doubt, about, believed, in_words, is_lost, part_of, verdict
from estimators.filters.filtering import FilterResult
from estimators.information.innovationtests import findings, least

# ------------------------------------------------------------------------------ innovations


def doubted(z, level=LEVEL):
    return {f.sensor: f.test for f in least(findings(z), level)}


def test_white_innovations_are_doubted_no_more_often_than_stated():
    """300 recordings of four sensors at a level of 5 %: at most 24 are chance at 98 %."""
    rng = np.random.default_rng(0)
    flags = [bool(doubted({n: rng.standard_normal(60) for n in "abcd"}, 0.05)) for _ in range(300)]
    assert 1 <= sum(flags) <= 24


@pytest.mark.parametrize(
    ("test", "spoil"),
    [
        ("mean", lambda z: z + 0.7),
        ("drift", lambda z: z + np.linspace(-2.0, 2.0, z.size)),
        ("size", lambda z: 1.6 * z),
        ("wild", lambda z: np.where(np.arange(z.size) == 70, 9.0, z)),
        ("window", lambda z: z + 2.2 * (-1.0) ** np.arange(z.size) * (np.arange(z.size) > 130)),
        ("colour", lambda z: np.convolve(np.append(0, z), [0.75, 0.66], "valid")),
    ],
)
def test_what_a_test_is_for_is_found_in_the_one_sensor(test, spoil):
    rng = np.random.default_rng(3)
    z = {n: rng.standard_normal(150) for n in "abc"}
    z["b"] = spoil(z["b"])
    found = least(findings(z), LEVEL)
    assert [f.sensor for f in found] == ["b"]
    limit = LEVEL / len(findings(z))
    assert test in {f.test for f in findings(z) if f.sensor == "b" and f.chance < limit}


def test_gaps_and_short_recordings():
    z = np.random.default_rng(1).standard_normal(40)
    z[::3] = np.nan
    assert not doubted({"a": z, "b": np.full(40, np.nan), "c": z[:6]})
    with_gap = np.append(z, 12.0)
    (f,) = least(findings({"a": with_gap}), LEVEL)
    assert f.at == 40


# ------------------------------------------------------------------------------ channels


def test_a_run_of_equal_readings_is_judged_by_the_sensor_s_own_repetitions():
    rng = np.random.default_rng(2)
    fine, other = rng.standard_normal(51), rng.standard_normal(51)
    stuck = fine.copy()
    stuck[20:25] = stuck[20]
    assert standing_still(stuck, [other]) == (20, 24)
    assert standing_still(fine, [other]) is None
    coarse = np.round(0.4 * rng.standard_normal(2000))  # one digit wide noise repeats itself
    assert standing_still(coarse, [rng.standard_normal(2000)]) is None
    coarse[500:600] = 0.0
    assert standing_still(coarse, [rng.standard_normal(2000)]) is not None
    # nothing else moves either: an engine at rest
    assert standing_still(stuck, [np.where(np.arange(51) < 20, other, 1.0)]) is None


def wave(t, w=2513.0, phase=0.0):
    return 400 * np.cos(w * t + phase)


def test_single_wild_samples_and_nothing_else():
    """Noise, a step of the load in all channels, and a missing sample are none."""
    rng = np.random.default_rng(4)
    t = 1e-4 * np.arange(2000)
    x = {n: wave(t, phase=k) + rng.standard_normal(t.size) for k, n in enumerate("ab")}
    for n in "ab":
        x[n][700:] *= 0.6
    x["a"][1000] = np.nan
    sigma = {"a": 1.0, "b": 1.0}
    assert not any(v.any() for v in wild_samples(t, x, 2513.0, sigma).values())
    x["b"][[300, 1500]] += [40.0, -25.0]
    found = wild_samples(t, x, 2513.0, sigma)
    assert not found["a"].any() and np.flatnonzero(found["b"]).tolist() == [300, 1500]
    few = wild_samples(t[::6], {"b": x["b"][::6]}, 2513.0, sigma)  # four a period say nothing
    assert not few["b"].any()


# ------------------------------------------------------------------------------ generators


@pytest.fixture
def waves(monkeypatch):
    """0.5 s of a filter's innovations that are the sensors' noise and offsets of gain errors."""
    rng = np.random.default_rng(5)
    t, w = 1e-4 * np.arange(5000), 2 * np.pi * 400
    S = np.array([3.2, 3.2, 3.2, 0.64])
    monkeypatch.setattr(residuals, "_variances", lambda *_: S)
    nu = rng.standard_normal((4, t.size)) * np.sqrt(S)[:, None]
    nu[:3] += 3 * np.cos(w * t + np.arange(3)[:, None])
    nu[3] += 2.0 + np.cos(2 * w * t)
    samples = {f"{q}_{p}": wave(t, w, -k * 2.0944) for q in "vi" for k, p in enumerate("abc")}
    samples |= {"t": t, "w_r": 0 * t + w, "V_fd": 0 * t + 40.0, "i_fd": 0 * t + 590.0}
    y = Signals([OUTPUTS[n] for n in MEASURED])
    nothing = np.zeros((0, t.size))

    def judge(extra=0.0, **events):
        r = FilterResult(
            Signals([]), y, t, nothing, nothing, nu + extra, 15 + 0 * nu, 0 * t, 0 * t, 0.0, None
        )
        found = unexplained_waves(
            MachineParameters(), ELECTRICAL, samples, r, level=LEVEL, **events
        )
        return [(f.sensor, f.test) for f in found]

    return t, w, judge


def test_noise_and_gain_errors_are_explained(waves):
    assert waves[2]() == []


def test_what_gain_errors_do_not_give_is_named_with_its_sensor(waves):
    t, w, judge = waves
    row = np.eye(4)[:, :, None]
    assert judge(row[1] * (t > 0.3) * 1.5) == [("i_b", "offset")]
    assert judge(row[0] * 0.4 * np.cos(5 * w * t)) == [("i_a", "harmonic 5")]
    burst = np.random.default_rng(6).standard_normal(t.size) * (abs(t - 0.36) < 0.01) * 4
    assert judge(row[2] * burst) == [("i_c", "noise")]
    assert ("i_a", "gain") in judge(row[0] * 40 * np.cos(w * t))
    assert judge(row[0] * 8 * (t > 0.3) * np.cos(w * t)) == [("i_a", "change")]


def test_a_new_beginning_without_cause_is_told(waves):
    judge = waves[2]
    assert judge(resets=[0.2]) == [("machine", "moved")]
    assert judge(resets=[0.2], faults=[0.22]) == []


def side(h, s=1e-4, **more):
    h = np.repeat(np.array(h, float)[:, None], 3, axis=1)
    t, phase = 0.02 * np.arange(3), np.zeros(3, int)
    beliefs = np.append(h, np.full((1, 3), 2e5), axis=0).T, np.diag([s, s, s, 1e3]) ** 2
    misfit = Hypotheses.of(beliefs[0], np.repeat(beliefs[1][None], 3, axis=0)).misfit
    told = {"severities": np.array([h, s + 0 * h]), "misfit": misfit}
    return SimpleNamespace(**told, t=t, phase=phase, **more)


@pytest.mark.parametrize(
    ("h", "kinds"),
    [
        ((1e-4, -1e-4, 2e-4), []),
        ((0.0, 2.4e-3, 1e-4), []),
        ((-6e-4, -6e-4, -6e-4), ["machine"]),
        ((5e-4, 2.4e-3, 1e-4), ["machine"]),
        ((0.0, 0.05, 0.0), ["linearisation"]),
    ],
)
def test_severities_are_of_one_phase_and_not_negative(h, kinds):
    doubts = list(believable._severity_doubts(side(h)))
    assert [d.kind for d in doubts] == kinds and set(kinds) <= set(KINDS)


def test_voltages_and_speed_of_two_rates():
    """1 % of another rate is 50 rad in 2 s; a load angle that changes by 1 rad is none."""
    t, w = 1e-4 * np.arange(20_000), 2513.0
    turn = {n: -k * 2 * np.pi / 3 for k, n in enumerate(("v_a", "v_b", "v_c"))}

    def slip(rate, change=0.0):
        angle = rate * w * t + change * (t > 1.0)
        v = {n: 325 * np.cos(angle + k) for n, k in turn.items()}
        v["v_a"][100:120] = np.nan
        return believable._slip(v | {"t": t, "w_r": w + 0 * t})

    assert_allclose(slip(1.0), 0.0, atol=1e-3)
    assert_allclose(slip(1.0, 1.0), 1.0, atol=1e-3)
    assert_allclose(slip(1.01), 0.95 * 0.01 * w * 2, rtol=0.01)
    assert_allclose(slip(0.99), -0.95 * 0.01 * w * 2, rtol=0.01)


# ------------------------------------------------------------------------------ causes


def test_probabilities_of_hypotheses():
    """Bayes' rule with weights shared by the members of a kind; what is impossible has none."""
    p = probabilities({"healthy": 0.0, "sensor i_a": 2.0, "sensor i_b": -np.inf})
    assert_allclose(sum(p.values()), 1.0)
    assert p["sensor i_b"] == 0
    odds = p["sensor i_a"] / p["healthy"]
    assert_allclose(odds, np.exp(2.0) * PRIOR["sensor"] / 2 / PRIOR["healthy"])


def test_a_doubt_is_its_sentence_and_its_kind():
    d = Doubt("sensor", "T5 stands still").of("machine 1")
    again = pickle.loads(pickle.dumps(d))
    assert d == again == "machine 1, T5 stands still" and again.kind == d.kind == "sensor"
    assert again.part == d.part == "machine 1"


# ------------------------------------------------------------------------------ part by part


def believed_of(*doubts, machines=(1, 2), gas=True, **more):
    told = believed(doubts, gas=gas, machines=machines, **more)
    return [n for n, why in told.items() if not why]


def test_parts_are_believed_or_not_for_what_is_said_of_them():
    ALL = [
        "gas path",
        *(f"machine {k}{h}" for k in (1, 2) for h in ("", ": h_a", ": h_b", ": h_c")),
    ]
    assert believed_of() == ALL
    assert believed_of("anything") == believed_of(Doubt("time", "anything")) == []
    (gas,) = about([Doubt("mean", "T5")], "gas path")
    assert believed_of(gas) == ALL[1:]
    both = Doubt("sensor", "w_r", part_of("w_r", ["w_r", "i_a_2"]))
    assert both.part == "machine" and believed_of(both) == ["gas path"]
    assert part_of("i_a_2", ["i_a_2"]) == "machine 2" and part_of("T5", ["w_r"]) == "gas path"
    # one severity, and so the machine of which it is, but not the others
    h = Doubt("linearisation", "h_a is large", "h_a").of("machine 2")
    assert believed_of(h) == [n for n in ALL if n not in ("machine 2", "machine 2: h_a")]
    # the power that the gas path has from it
    assert "gas path" not in believed_of(h, power_of=[1, 2])
    told = believed([h], gas=True, machines=[1, 2], power_of=[1, 2])
    assert told["gas path"] == ("its shaft power is that of machine 2, which is doubted",)
    words = in_words(verdict(told))
    assert words == (
        "; doubted: gas path, machine 2, machine 2: h_a"
        "; believed: machine 1, machine 2: h_b, machine 2: h_c"
    )
    assert in_words(verdict(believed([gas], gas=True, machines=[1]))) == (
        "; doubted: gas path; believed: machine 1"
    )
    gone = believable.lost(ValueError("20 resets")).of("machine 1")
    assert is_lost([gone], 1) and not is_lost([gone], 2) and gone.kind in KINDS
    assert [n for n in ALL if n.startswith("machine 1")] == [
        n for n in ALL if n not in believed_of(gone)
    ]


@pytest.mark.parametrize(
    ("best", "kind"),
    [
        ("sensor i_a", "sensor"),
        ("harmonics", "sensor"),
        ("healthy", None),
        ("short circuit b", None),
    ],
)
def test_a_change_that_no_filter_knows_is_doubted_though_nothing_was_reported(
    monkeypatch, best, kind
):
    """A filter that began anew since a current failed goes on with that current."""
    found = Causes(0.5, {best: 0.9, "hot winding": 0.1})
    monkeypatch.setattr(believable, "causes_of_change", lambda *_: found)
    monkeypatch.setattr(believable, "field_steps", lambda *_: [])
    monkeypatch.setattr(believable, "offset_steps", lambda *_: [])
    zero = np.zeros(51)
    side = SimpleNamespace(t=0.02 * np.arange(51), phase=zero, resets=(0.5,), beliefs=None)
    ((told, doubt),) = machine_causes(side, None, ELECTRICAL, {})
    assert told is found and (doubt.kind if doubt else None) == (kind or None)
    # a step of the field's current alone makes no reset
    monkeypatch.setattr(believable, "field_steps", lambda *_: [0.7])
    assert len([*machine_causes(side, None, ELECTRICAL, {})]) == 2


# ------------------------------------------------------------------------------ one answer


@pytest.mark.parametrize("kind", ["stuck", "bias", "drift", "noise", "spikes", "dropout"])
def test_how_a_sensor_failed_is_told(kind):
    """Of readings of 900 K +- 5 K, over 50 samples, for several draws."""
    t = 0.02 * np.arange(50)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        true, noise = 900 + 5 * np.sin(t), 5 * rng.standard_normal(50)
        v = true + noise
        v = {
            "stuck": np.full(50, v[0]),
            "bias": v + 20.0,
            "drift": v + 60.0 * t,
            "noise": true + 4 * noise,
            "spikes": np.where(np.arange(50) == 20 + seed, v + 100.0, v),
            "dropout": np.where(np.arange(50) > 3, np.nan, v),
        }[kind]
        found = failure(t, v, v - true, np.full(50, 5.0))
        assert max(found, key=found.get) == kind
        assert sum(found.values()) == pytest.approx(1.0)
    assert failure(t[:2], true[:2], noise[:2], np.full(2, 5.0)) == {}


def test_one_answer_for_what_several_filters_saw():
    """A short circuit that the gas path took for shaft power; a fault of the gas path alone."""
    short = Causes(0.5, {"healthy": 0.0, "short circuit b": 0.9, "sensor i_b": 0.1})
    power = Causes(0.56, {"none": 0.0, "gas path": 0.2, "shaft power": 0.8})
    (d,) = diagnoses({"machine 1": [short], "gas path": [power]})
    assert d.best == "machine 1: short circuit b" and d.t == 0.5
    assert d.probability["gas path"] < 1e-3 and sum(d.probability.values()) == pytest.approx(1.0)
    worn = Causes(0.56, {"none": 0.0, "gas path": 0.95, "sensor T5": 0.05})
    bias = {"sensor T5": {"bias": 1.0}}
    (d,) = diagnoses({"gas path": [worn]})
    assert d.best == "gas path" and not d.failure
    # both are sure of something that the other does not see
    (d,) = diagnoses({"machine 1": [short], "gas path": [worn]})
    assert d.best == "two at once"
    failed = Causes(3.0, {"none": 0.1, "gas path": 0.1, "sensor T5": 0.8}, bias)
    first, second = diagnoses({"machine 2": [short], "gas path": [failed]})
    assert first.best == "machine 2: short circuit b"
    assert (second.best, second.failure) == ("sensor T5", {"bias": 1.0})
    # a pick-up is an input of one filter and an output of the other
    pickup = Causes(0.5, {"healthy": 1e-9, "sensor w_r": 1.0})
    speed = Causes(0.54, {"none": 0.0, "sensor N": 1.0})
    (d,) = diagnoses({"machine 1": [pickup], "gas path": [speed]})
    assert d.best == "machine 1: sensor w_r"
    assert diagnoses({}) == []
