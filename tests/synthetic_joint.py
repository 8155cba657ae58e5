"""A joint run made of plausible formulas, for tests of what reads results and not of physics."""

import json

import numpy as np

from apu_casadi.core import results
from apu_casadi.unit.runsignals import RUN

PHASES = [
    {"name": "design point", "start": 0.0, "end": 2.0},
    {"name": "load drop", "start": 2.0, "end": 6.0},
    {"name": "gas-path fault", "start": 6.0, "end": 10.0},
    {"name": "TTSC fault", "start": 10.0, "end": 14.0},
]
SCENARIO = {
    "name": "joint",
    "title": "synthetic",
    "duration": 14.0,
    "phase": [
        {"name": "design point", "start": 0.0, "load": {"kind": "R", "power_kW": 225.0}},
        {"name": "load drop", "start": 2.0, "load": {"kind": "R", "power_kW": 100.0}},
        {"name": "gas-path fault", "start": 6.0, "health": {"f_eta_c": 0.99}},
        {"name": "TTSC fault", "start": 10.0, "fault": {"mu": 0.05, "k_rf": 20.0}},
    ],
}


def _steps(t, values, tau=0.0):
    """Piecewise values at 0, 2, 6 and 10 s, each approached with a time constant."""
    y = np.full_like(t, values[0])
    for start, a, b in zip((2.0, 6.0, 10.0), values, values[1:], strict=False):
        after = t > start
        rise = 1.0 if tau == 0.0 else 1.0 - np.exp(-(t[after] - start) / tau)
        y[after] += (b - a) * rise
    return y


def _kicks(t, sizes, tau, period):
    y = np.zeros_like(t)
    for start, size in zip((2.0, 6.0, 10.0), sizes, strict=True):
        s = t[t > start] - start
        y[t > start] += size * np.exp(-s / tau) * np.sin(2 * np.pi * s / period)
    return y


def synthetic_joint(*, waveforms=True, end=14.0, waveform_dt=50e-6):
    """Return a dataset with the layout of a joint run."""
    t = np.arange(0.0, end + 0.01, 0.02)
    N = 3775.1 + _kicks(t, (75.0, -22.0, -6.0), 0.5, 1.6)
    PW = 1e3 * (_steps(t, (500.0, 222.2, 222.2, 229.0), 0.02) + _kicks(t, (6.0, -1.5, 1), 0.5, 1.6))
    T4 = _steps(t, (1273.0, 980.0, 1022.0, 1031.0), 0.25) + _kicks(t, (-120, 30, 8), 0.4, 1.6)
    T3 = _steps(t, (568.1, 541.0, 543.5, 544.5), 0.3) + _kicks(t, (6.0, -2.0, -0.5), 0.5, 1.6)
    P3 = 1e3 * (_steps(t, (802.5, 700, 690, 694), 0.3) + _kicks(t, (20.0, -6.0, -2.0), 0.5, 1.6))
    SM = _steps(t, (0.24, 0.345, 0.372, 0.366), 0.3) + _kicks(t, (0.03, -0.01, 0), 0.4, 1.6)
    Wf = _steps(t, (0.0483, 0.029, 0.0312, 0.0318), 0.2)
    hurt = t > 10.0
    V = 229.8 + _kicks(t, (12.0, -1.2, -2.0), 0.15, 0.8)
    I = _steps(t, (326.0, 145.0, 145.0, 145.0)) * V / 229.8
    va, vb, vc = V - 5.2 * hurt, V + 2.1 * hurt, V + 3.1 * hurt
    ia, ib, ic = I - 3.3 * hurt, I + 1.3 * hurt, I + 2.0 * hurt
    slow = {
        "N": N, "PW": PW, "Wf": Wf, "SFC": Wf / (PW + 30e3), "SNOx": 0.17, "SM": SM,
        "T3": T3, "P3": P3, "T4": T4, "T5": T4 - 350.0, "W2": 3.16, "residual": 1e-9,
        "f_eta_c": np.where(t > 6.0, 0.99, 1.0), "f_W_c": np.where(t > 6.0, 0.97, 1.0),
        "f_eta_t": np.where(t > 6.0, 0.98, 1.0), "f_W_t": np.where(t > 6.0, 1.04, 1.0),
        "mu": np.where(hurt, 0.05, 0.0), "k_rf": np.where(hurt, 20.0, np.nan),
        "kappa": np.where(hurt, 0.05, np.nan), "P_total": PW * 0.95, "P_e": PW * 0.9,
        "P_loss_fault": np.where(hurt, 6.8e3, 0.0),
        "V_a_rms": va, "V_b_rms": vb, "V_c_rms": vc, "I_a_rms": ia, "I_b_rms": ib, "I_c_rms": ic,
    }  # fmt: skip
    times, values = {"time": t}, {"time": slow}
    if waveforms:
        tw = np.arange(round(end / waveform_dt) + 1) * waveform_dt
        theta = 2 * np.pi * 400.0 * tw
        fast = {}
        for k, (p, v, i) in enumerate(zip("abc", (va, vb, vc), (ia, ib, ic), strict=True)):
            wave = np.sqrt(2) * np.cos(theta - 2 * np.pi * k / 3)
            fast[f"v_{p}"] = np.interp(tw, t, v) * wave
            fast[f"i_{p}"] = np.interp(tw, t, i) * wave
        fast["v_a"][(tw >= 2.0) & (tw < 2.00005)] = 480.0  # the overvoltage of a load drop
        fast |= {"i_fault": 0.0, "V_fd": 30.0, "i_fd": 200.0, "T_e": 180.0, "P_inst": 4.5e5}
        times["time_w"], values["time_w"] = tw, fast
    ds = results.dataset(times, values, signals=RUN)
    shown = [p for p in PHASES if p["start"] < end]
    shown[-1] = {**shown[-1], "end": end}
    ds.attrs["phases"] = json.dumps(shown)
    ds.attrs["scenario"] = json.dumps(SCENARIO)
    ds.attrs["apu_casadi_version"] = "0.1.0"
    return ds
