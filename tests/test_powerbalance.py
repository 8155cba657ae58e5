"""What the shaft gives beyond what loads take: a short circuit, its size, a sensor."""

import json

import numpy as np
import pytest

from apu_casadi.machine.park import Abc
from apu_casadi.machine.terminals import shunt_loss
from apu_casadi.unit.apu import Apu
from estimators.apu.believable import Still, still_causes
from estimators.apu.diagnosis import diagnoses
from estimators.apu.electrical.causes import Causes
from estimators.apu.powerbalance import OUTPUT, balance, loss_of, severity_of
from estimators.apu.recorded_estimate import estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensors import GAS_PATH
from estimators.apu.trust import Doubt
from estimators.apu.unknowns import UNKNOWNS

APU, P = Apu(), 250e3
T = 0.02 * np.arange(300)


def said(loss, seed=1, gain=0.02, output=P, sensor=0.0):
    """A balance of so much loss, W, with a constant error and noise of the shaft power."""
    rng = np.random.default_rng(seed)
    PW = (1 + gain) * (output + loss) / APU.generator.machine.eta_sg / APU.coupling.eta_gtSg
    PW = PW * (1 + sensor) * (1 + 0.01 * rng.standard_normal(T.size))
    of = balance(APU, GAS_PATH["PW"], (T, PW), (T, output + 0 * T), UNKNOWNS)
    tracked = of.tracked("vm")
    return of, tracked, of.dataset(tracked), [*of.causes(tracked)]


def test_the_severity_of_a_loss_is_that_of_equation_8():
    """The mean over a period of the loss that the machine's terminals have, at a resistive load."""
    p, x = APU.generator.machine, 2 * np.pi * np.arange(400) / 400
    for h in (3e-4, 2.5e-3, 8e-3):
        v = np.sqrt(2) * p.V_rated_rms * np.cos(x)
        i = v * P / 6 / p.V_rated_rms**2
        none = 0.0 * v
        ibar, of = Abc(i + h * v / p.r_s, none, none), Abc(h, 0.0, 0.0)
        lost = shunt_loss(p, ibar=ibar, v=Abc(v, none, none), h=of).mean()
        assert loss_of(APU, h, P) == pytest.approx(lost, rel=1e-9)
        assert severity_of(APU, lost, P) == pytest.approx(h, rel=1e-9)


@pytest.mark.parametrize("grows", [False, True])
def test_a_short_circuit_shows_in_the_power_alone(grows):
    """h = 8e-4 from 3 s on, at once or by an exponential as the data set has it."""
    h = np.where(T < 3.0, 0.0, 8e-4)
    h = np.where(T < 3.0, 0.0, 1e-5 * 80 ** np.clip((T - 3) / 2, 0, 1)) if grows else h
    of, tracked, e, causes = said(np.array([loss_of(APU, v, P) for v in h]))
    onset = json.loads(e.attrs["onsets"])[0]
    assert 2.9 < onset < (4.8 if grows else 3.1)
    assert [c.best for c, doubt in causes if doubt is None] == ["short circuit"] * len(causes)
    found, sigma = (float(e[n].values[-1]) for n in ("h", "h_sigma"))
    assert abs(found - 8e-4) < 3 * sigma < 8e-4
    assert not [*of.doubts(tracked)]


def test_without_a_change_nothing_is_said_and_the_band_holds():
    for seed in range(6):
        _, tracked, e, _ = said(0.0, seed, gain=-0.03)
        assert not tracked.alarms
        assert abs(float(e["loss"].values[-1])) < 4 * float(e["loss_sigma"].values[-1])


def test_a_sensor_that_reads_less_and_power_of_one_machine():
    off = np.where(T < 3.0, 0.0, -0.05)
    *_, ((cause, doubt),) = said(0.0, sensor=off)
    assert cause.best == "sensor PW" and doubt.kind == "power"
    of, tracked, *_ = said(P)  # the output is that of one of two
    assert "of all machines?" in next(of.doubts(tracked))


def test_from_a_recording():
    """Without a fuel flow there is no gas path, and the balance is told all the same."""
    rng = np.random.default_rng(2)
    h = np.where(T < 3.0, 0.0, 2e-3)
    PW = (P + np.array([loss_of(APU, v, P) for v in h])) / 0.9
    data = {"t": T, "PW [kW]": 1e-3 * PW * (1 + 0.01 * rng.standard_normal(T.size))}
    m = read_recording(data | {f"{OUTPUT} [kW]": 1e-3 * P + 0 * T})
    assert m[OUTPUT].unit == "W" and m[OUTPUT].values[0] == pytest.approx(P)
    r = estimate(m)
    assert r.report()["changes"][0]["t"] == pytest.approx(3.0, abs=0.1)
    assert [d.best for d in r.diagnoses] == ["generators: short circuit"]
    text = r.summary()
    assert "new loss [kW]" in text and "as a severity [1e-3]" in text
    assert "balance" in r.datasets() and "it changed after" in text


def test_power_and_waveforms_give_one_answer():
    """The power says no phase; the waveforms do, and both are of one change."""
    power = Causes(3.1, {"short circuit": 0.99, "sensor PW": 0.009, "healthy": 0.001})
    waves = Causes(3.0, {"short circuit b": 0.99, "sensor i_b": 0.009, "healthy": 0.001})
    (d,) = diagnoses({"generators": (power,), "machine 2": (waves,)})
    assert d.best in ("machine 2: short circuit b", "generators: short circuit")
    assert d.probability["two at once"] < 0.01
    (alone,) = diagnoses({"generators": (power,)})
    assert alone.best == "generators: short circuit"


def test_a_sensor_that_stands_still_is_a_cause():
    places = ("T5", "gas path"), ("i_a_2", "machine 2")
    still = [Still(n, 2.0, 3.0, Doubt("sensor", "stands still", part)) for n, part in places]
    (c,) = still_causes(still)
    (d,) = diagnoses({"gas path": (c,)})
    assert d.best == "sensor T5" and d.failure == {"stuck": 1.0} and d.t == 2.0
