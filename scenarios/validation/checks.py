"""Numerical checks: two routes to the same number, and conservation.

Each row's ``error`` is the largest deviation that the check defines, relative to the peak or to
the throughput; ``reference`` is zero.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from apu_casadi.core import simulation
from apu_casadi.gaspath.atmosphere import isa
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from scenarios.validation.comparison import Row, check, section, timing

WAVES = ("v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "V_fd", "i_fd", "T_e")


def qd0_steady_state(gen: Generator, V_fd: float, R: float) -> tuple[np.ndarray, np.ndarray]:
    """Currents (q, d, 0, fd, kd, kq) and voltages (q, d, 0) of the linear equations (5)-(7).

    Written as the paper prints them, six windings at rest under v = R i; it shares no line with
    the package's machine.
    """
    m = gen.machine
    L = np.zeros((6, 6))
    L[0, 0], L[0, 5], L[5, 0], L[5, 5] = -(m.L_mq + m.L_ls), m.L_mq, -m.L_mq, m.L_mq + m.L_lkq
    L[1, 1], L[1, 3], L[1, 4] = -(m.L_md + m.L_ls), m.L_md, m.L_md
    L[2, 2] = -m.L_ls
    L[3] = [0, -m.L_md, 0, m.L_md + m.L_lfd, m.L_md, 0]
    L[4] = [0, -m.L_md, 0, m.L_md, m.L_md + m.L_lkd, 0]
    W_r = np.zeros((6, 6))
    W_r[0, 1], W_r[1, 0] = m.w_rated, -m.w_rated
    r = np.diag([-m.r_s] * 3 + [m.r_fd, m.r_kd, m.r_kq])
    i = np.linalg.solve(W_r @ L + r - np.diag([R] * 3 + [0] * 3), [0, 0, 0, V_fd, 0, 0])
    return i, R * i[:3]


def _peak_error(
    a: Any, b: Any, skip: tuple[float, ...] = (), names: tuple[str, ...] = WAVES
) -> float:
    """Largest difference of two runs over the peak, without 0.5 ms after each switch."""
    t = a.time.to_numpy()
    keep = np.all([(t < s) | (t >= s + 0.5e-3) for s in skip], axis=0) if skip else slice(None)
    worst = 0.0
    for n in names:
        x, y = a[n].to_numpy()[keep], b[n].to_numpy()[keep]
        worst = max(worst, float(np.abs(x - y).max() / np.abs(x).max()))
    return worst


@section(
    "generator", "Starter/generator: steady state, two solvers, shunt, power balance", order=30
)
def generator() -> list[Row]:
    """Measure the machine against the linear solution, against itself in other form."""
    gen = Generator()
    rows = []
    loads = {P: SeriesLoad.from_power(P * 1e3) for P in (225, 100)}
    for P, load in loads.items():
        point = gen.steady_state(load)
        i, v = qd0_steady_state(gen, point.y["V_fd"], load.R[0])
        ours = np.array([point.y[k] for k in ("v_a", "i_a", "i_fd", "P_e")])
        theirs = np.array([v[0], i[0], i[3], 1.5 * v[:2] @ i[:2]])
        what, e = f"steady state, {P} kW, against the closed qd0 solution", ours / theirs - 1
        error = float(np.abs(e).max())
        rows.append(check(what, error, 1e-8, "goal; both are linear solutions"))
    faults = {"kappa = mu": Ttsc(0.05, 20.0), "kappa = 1": Ttsc(0.05, 1.0, 1.0)}
    changes: dict[str, Any] = {"load step": loads[100], **faults}
    for label, change in changes.items():
        a, b = (
            gen.simulate(loads[225], 0.05, switches=[(0.01, change)], solver=s)
            for s in ("cvodes", "idas")
        )
        what, error = f"CVODES against IDAS, {label}", _peak_error(a, b, (0.01,))
        rows.append(check(what, error, 1e-5, "goal, of peak, after the first 0.5 ms"))
    fault = faults["kappa = mu"]
    R, R_sh = loads[100].R[0], fault.R_shunt(gen.machine)
    shunted = SeriesLoad(R=(R * R_sh / (R + R_sh), R, R))
    a, b = (
        gen.simulate(loads[100], 0.05, switches=[(0.01, s)], rtol=1e-10) for s in (fault, shunted)
    )
    # the shunt's own current is part of the load's in one and of i_a in the other
    error = _peak_error(a, b, names=tuple(n for n in WAVES if n != "i_a"))
    what = "faulted machine against healthy machine with shunt, kappa = mu"
    rows.append(check(what, error, 1e-6, "goal; the equivalence is exact"))
    rows += [_power_balance(gen, loads[100], f, label) for label, f in faults.items()]
    return rows


def _power_balance(
    gen: Generator, load: SeriesLoad, fault: Ttsc | None, label: str, w_r: float | None = None
) -> Row:
    """Shaft and field power against output and every copper loss over 8 periods, after 3 s."""
    m = gen.machine
    w_r = m.w_rated if w_r is None else w_r
    point = gen.steady_state(load, w_r=w_r)
    ss, theta = gen.variant(load, fault), gen.fault_vector(load, fault)
    u = gen.inputs(load, w_r=w_r)
    x = gen.transfer(point.x, point.ss, ss, u=point.u, theta=[], u_target=u)
    x = simulation.stepper(ss, 1)(x, u, theta, 3.0).x_end
    cycles = 0.02 if w_r == m.w_rated else 8 * 2 * math.pi / w_r
    s = ss.y.unpack(simulation.stepper(ss, 1600, rtol=1e-9, atol=1e-11)(x, u, theta, cycles).y)
    losses = sum(m.r_s * np.mean(s[f"i_{k}"] ** 2) for k in "abc")
    if fault is not None:
        i_k = s[f"i_{fault.phase}"]
        losses += fault.r_fault(m) * np.mean(s["i_fault"] ** 2)
        losses += fault.mu * m.r_s * np.mean((i_k - s["i_fault"]) ** 2 - i_k**2)
    for r, i in ((m.r_fd, "i_fd"), (m.r_kd, "i_kd"), (m.r_kq, "i_kq")):
        losses += 1.5 * r * np.mean(s[i] ** 2)
    out = np.mean(sum(s[f"v_{k}"] * s[f"i_{k}"] for k in "abc"))
    given = np.mean(s["T_e"]) * w_r / m.n_pp + 1.5 * np.mean(s["V_fd"] * s["i_fd"])
    which = "machine" if fault is None else "faulted machine"
    what = f"average power balance of the {which}, {label}"
    reason = "goal, of the output; remaining transient after 3 s"
    return check(what, float(abs(given - out - losses) / out), 1e-6, reason)


@section("joint", "Joint scenario: energy handed over, steady start, wall time", order=31)
def joint() -> list[Row]:
    """Run the paper's four-phase scenario with 50 us waveforms and look at its books."""
    from scenarios import registry

    start = time.perf_counter()
    ds = registry.run("joint")
    wall = time.perf_counter() - start
    h = np.diff(ds.time.to_numpy())
    duration = float(ds.time[-1])
    apu = Apu()
    given = float(np.sum(ds.P_total.to_numpy()[1:] * h))
    taken = float(np.sum(ds.PW.to_numpy()[1:] * h)) * apu.coupling.eta_gtSg
    t_w, P_w = ds.time_w.to_numpy(), ds.P_inst.to_numpy()
    sampled = float(np.sum(0.5 * (P_w[1:] + P_w[:-1]) * np.diff(t_w)))
    before = (ds.time < 2.0).to_numpy()
    drift = max(
        float(np.ptp(ds[n].to_numpy()[before]) / abs(float(ds[n][0])))
        for n in ("N", "PW", "Wf", "T4", "P3", "V_a_rms", "I_a_rms")
    )
    residual = float(ds.residual.max())
    speed = duration / wall
    missed = "trapezoidal rule misses the spike of the load step and the jumps"
    return [
        check("energy, generator to gas generator", given / taken - 1, 1e-10, "goal, eq. (1)"),
        check("energy against the sum of 50 us samples", sampled / given - 1, 1e-4, missed),
        check("movement before the first event", drift, 1e-8, "integrator tolerance"),
        check("largest cycle residual", residual, 1e-9, "no result above it is used"),
        timing("wall time, 14 s with 50 us waveforms", "s", wall),
        timing("speed against real time", "1", speed),
    ]


@section(
    "machines", "Short circuit in one of two machines: shaft, books, the healthy one", order=32
)
def machines() -> list[Row]:
    """Run the paper's scenario with the fault in both machines and in one."""
    from scenarios import registry

    both, one = (registry.run(n, waveform_dt=None) for n in ("joint", "joint_one_machine"))
    k, apu = int(np.searchsorted(one.time, 10.0 + 1e-9)), Apu()
    asked = [float(ds.PW[k] - ds.PW[k - 1]) for ds in (one, both)]
    eta = apu.generator.machine.eta_sg * apu.coupling.eta_gtSg
    h = np.diff(one.time.to_numpy())
    P = (one.P_e + one.P_loss_fault).to_numpy()[:, 1:] / eta
    given, taken = float((P * h).sum()), float((one.PW.to_numpy()[1:] * h).sum())
    load, w_r = SeriesLoad.from_power(100e3), float(apu.w_r(float(one.N[-1])))
    alone = apu.generator.steady_state(load, w_r=w_r)
    moved = float(one.V_a_rms[0, -1] / alone.V_t - 1)
    half, left = 2 * asked[0] / asked[1] - 1, "what is left of the transient before it"
    rows = [
        check("fault in one against half of both, in the next step", half, 1e-6, left),
        check("energy of both generators against the shaft", given / taken - 1, 1e-10, "eq. (1)"),
        check("healthy machine against one alone at that speed", moved, 1e-6, "transient left"),
    ]
    for number, fault in ((1, None), (2, Ttsc(0.05, 20.0))):
        label = f"generator {number} at the last speed"
        rows.append(_power_balance(apu.generator, load, fault, label, w_r))
    return rows


@section(
    "conservation", "Mass and energy across every component at random operating points", order=33
)
def conservation(n: int = 50, seed: int = 0) -> list[Row]:
    """First law and continuity with enthalpies re-evaluated outside the model."""
    gg = Apu().gas_generator
    gas, p = gg.gas, gg.parameters
    rng = np.random.default_rng(seed)
    worst: dict[str, float] = {}
    for _ in range(n):
        theta = {k: 1 + 0.04 * rng.uniform(-1, 1) for k in gg.THETA.names}
        war, altitude, dT = rng.uniform(0, 0.02), rng.uniform(0, 10000), rng.uniform(-20, 20)
        T0 = float(isa(altitude, dT)[0])
        # corrected speed and temperature ratio are drawn, so that points lie on the maps
        N = p.N * rng.uniform(0.9, 1.08) * math.sqrt(T0 / 293.15)
        fixed = {"N": N, "T4": T0 * rng.uniform(3.4, 4.2)}
        air = {"altitude": altitude, "Mach": rng.uniform(0, 0.6), "dT_isa": dT, "war": war}
        y = trim_gas_generator(gg, fixed, theta=theta, **air)
        W2, Wf = y["W2"], y["Wf"]
        shares = {"4": 0.89, "41": 0.94, "5": 0.99}
        FAR = {s: Wf * (1 + war) / (share * W2) for s, share in shares.items()}
        h2, h3 = (float(gas.h(y[t], 0.0, war)) for t in ("T2", "T3"))
        h4, h41, h50, h5 = (
            float(gas.h(y[t], FAR[s], war))
            for t, s in (("T4", "4"), ("T41", "41"), ("T50", "41"), ("T5", "5"))
        )
        cool = 0.05 * W2 * h3
        balances = {
            "compressor": W2 * (h3 - h2) - y["P_cpr"],
            "combustor": 0.89 * W2 * h3 + Wf * p.LHV * p.eta_burner - y["W4"] * h4,
            "vane cooling": y["W4"] * h4 + cool - y["W41"] * h41,
            "turbine rotor": y["W41"] * (h41 - h50) - y["P_turb"],
            "rotor cooling": y["W41"] * h50 + cool - y["W5"] * h5,
            "whole engine": Wf * p.LHV + W2 * (h2 - 0.01 * h3) - y["W8"] * h5 - y["PW"] - p.P_acc,
        }
        for k, b in balances.items():
            worst[f"energy, {k}"] = max(worst.get(f"energy, {k}", 0.0), abs(b) / (Wf * p.LHV))
        mass = abs(W2 * 0.99 + Wf - y["W8"]) / W2
        worst["mass, whole engine"] = max(worst.get("mass, whole engine", 0.0), mass)
    return [
        check(f"{k}, {n} points", e, 1e-8, "solver tolerance of each equation, of fuel power")
        for k, e in worst.items()
    ]
