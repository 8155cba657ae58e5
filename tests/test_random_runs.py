"""Joint runs whose loads, faults, profiles, events, days and speeds are drawn, against CVODES."""

import warnings

import numpy as np
import pytest

from apu_casadi.core.errors import ApuWarning, OperatingPointError, SimulationError
from apu_casadi.core.profiles.profile import varying
from apu_casadi.core.profiles.shapes import Growth, OnOff, Ramp
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.capacitor import CapacitorLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import Ambient, FaultChange, HealthChange, LoadChange, SpeedChange
from apu_casadi.unit.multirate import simulate_joint

UNIT = Apu()
MEANS = ("N", "Wf", "T4", "PW", "P_e", "V_a_rms", "V_b_rms", "I_b_rms", "I_c_rms", "P_loss_fault")
WAVES = ("v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "i_fault", "V_fd", "i_fd", "T_e")


def load(r):
    P, pf = float(10 ** r.uniform(np.log10(4e3), np.log10(2e5))), float(r.uniform(0.6, 0.98))
    kind = r.integers(5)
    if kind == 0:
        return SeriesLoad.from_power(P)
    if kind == 1:
        return SeriesLoad.from_power(P, pf)
    if kind == 2:
        return CapacitorLoad.from_power(P, max(pf, 0.8))
    if kind == 3:
        a, c = (float(v) for v in r.uniform(0.8, 1.2, 2))
        return SeriesLoad.from_power(P, pf, unbalance=(a, 1.0, c))
    course = [
        Ramp(P, P * float(r.uniform(0.7, 1.4)), over=float(r.uniform(0.2, 2.0))),
        OnOff(P, 0.8 * P, frequency=float(r.uniform(2.0, 8.0)), duty=0.5),
    ][r.integers(2)]
    return varying(SeriesLoad.from_power, course, *([pf] if r.random() < 0.5 else []))


def fault(r):
    h, phase, kind = float(10 ** r.uniform(-5, -1.7)), "abc"[r.integers(3)], r.random()
    mu = max(0.05, 2 * h)
    if kind < 0.4:
        grows = Growth(0.3 * h, h, over=float(r.uniform(0.2, 2.0)))
        return varying(Ttsc.of_h, mu, grows, phase=phase)
    if kind < 0.55:
        return varying(Ttsc.of_h, mu, OnOff(h, 0.1 * h, 5.0, duty=0.4), phase=phase)
    kappa = None if r.random() < 0.6 else float(r.uniform(mu, 1.0))
    return Ttsc(mu, mu / h - 1 + mu, kappa, phase=phase)


def event(r):
    t, kind = round(float(r.uniform(0.05, 0.45)), int(r.integers(2, 5))), r.integers(5)
    of = {"generator": [None, 1, 2][r.integers(3)]}
    return [
        lambda: LoadChange(t, load(r), **of),
        lambda: FaultChange(t, fault(r), **of),
        lambda: FaultChange(t, None, **of),
        lambda: HealthChange(t, {"f_eta_c": float(r.uniform(0.96, 1.0))}),
        lambda: SpeedChange(t, UNIT.N_ref * float(r.uniform(0.98, 1.01))),
    ][kind]()


def drawn(seed):
    r = np.random.default_rng(seed)
    given = {"duration": 0.5, "dt": [0.01, 0.02, 0.025][r.integers(3)]}
    given["waveform_dt"] = [None, None, 5e-5, 2e-4][r.integers(4)]
    given["load"] = [load(r), load(r)] if r.random() < 0.7 else load(r)
    if r.random() < 0.6:
        given["fault"] = {int(r.integers(1, 3)): fault(r)}
    if r.random() < 0.5:
        given["start_from"] = "settled"
    if r.random() < 0.4:
        given["N_ref"] = UNIT.N_ref * float(r.uniform(0.97, 1.02))
    if r.random() < 0.4:
        altitude, Mach, dT = (float(v) for v in r.uniform([0, 0, -20], [4e3, 0.5, 20]))
        given["ambient"] = Ambient(altitude=altitude, Mach=Mach, dT_isa=dT)
    events = [event(r) for _ in range(r.integers(4))]
    return given | {"events": sorted(events, key=lambda e: e.t)}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(60))
def test_a_drawn_run_is_that_of_cvodes(seed):
    """To 2.5e-6 of peak: twice what CVODES by itself errs by, and what docs/limits.md has worst.

    What a unit cannot carry is refused by both.  Two machines that had each other's means, and a
    governed speed that was not followed, were found by such runs.
    """
    given = drawn(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ApuWarning)
        try:
            ours = simulate_joint(UNIT, **given)
        except (OperatingPointError, SimulationError):
            with pytest.raises((OperatingPointError, SimulationError)):
                simulate_joint(UNIT, **given, solver="cvodes")
            return
        theirs = simulate_joint(UNIT, **given, solver="cvodes", rtol=1e-10, atol=1e-12)
    for name in (*MEANS, *(WAVES if given["waveform_dt"] else ())):
        if name in theirs:
            a, b = ours[name].values, theirs[name].values
            assert np.nanmax(np.abs(a - b)) <= 2.5e-6 * np.nanmax(np.abs(b)), name
