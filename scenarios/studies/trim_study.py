"""How many steady points of the flight envelope are solved, and what becomes of the others.

Random points over altitude, Mach number, ISA deviation, shaft power and health, all solved cold:
the share solved, the share refused by reason, and, the two that must be nought, points that do not
satisfy the equations and points refused without a reason.  Equations are evaluated again by the
plain model in CasADi's virtual machine, which shares no derivative and no compiled code with the
solver.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from apu_casadi.core import backend
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.steady.steadypoint import MEANING, Limits, Status
from apu_casadi.gaspath.steady.trimbatch import TrimBatch, trim_batch

ENVELOPE: dict[str, tuple[float, float]] = {
    "altitude": (0.0, 12e3),
    "Mach": (0.0, 0.8),
    "dT_isa": (-30.0, 35.0),
}
HEALTH = (0.92, 1.08)


@dataclass(frozen=True)
class Report:
    """What the study found.

    Args:
        points, seed, backend: of the run.
        counts: points by what became of them.
        cold: points solved from the similarity guess.
        continued: points solved by continuation only.
        iterations: mean Newton steps of those solved cold.
        wrong: solved points whose equations, evaluated by the plain model, exceed 1e-9.
        worst: largest such residual.
        unexplained: refused points without a reason.
        seconds, cpu: wall and processor time of the trim of all points, s, without compiling.
        examples: a refusal of each kind in words.
    """

    points: int
    seed: int
    backend: str
    counts: dict[str, int]
    cold: int
    continued: int
    iterations: float
    wrong: int
    worst: float
    unexplained: int
    seconds: float
    cpu: float
    threads: int
    examples: dict[str, str] = field(default_factory=dict)


def sample(gg: GasGenerator, points: int, seed: int) -> dict[str, Any]:
    """Draw ambient, health and shaft power from nought to the maximum at the limit of T4.

    Where the engine has no point at that temperature, the maximum is taken by similarity.
    """
    rng = np.random.default_rng(seed)
    ambient: dict[str, Any] = {k: rng.uniform(*r, points) for k, r in ENVELOPE.items()}
    theta = {n: rng.uniform(*HEALTH, points) for n in gg.THETA.names}
    load = rng.uniform(0.0, 1.0, points)
    N = gg.parameters.N
    T4 = 1.1 * gg.parameters.T4
    top = trim_batch(gg, {"N": N, "T4": T4}, theta=theta, limits=Limits.none(), **ambient)
    u = np.zeros((len(gg.U), points))
    for n, v in ambient.items():
        u[gg.U.index(n)] = v
    a = np.asarray(gg.cycle.ambient.map(points)(u))
    d = gg.design.values
    similar = 5e5 * (a[3] / d["P1"]) / np.sqrt(a[2] / d["T1"])
    PW = load * np.where(top.ok, top["PW"], similar)
    return {"fixed": {"N": N, "PW": PW}, "theta": theta, **ambient}


def run(
    points: int = 10_000,
    seed: int = 1,
    *,
    gg: GasGenerator | None = None,
    n_threads: int | None = None,
) -> Report:
    """Draw, trim, check."""
    gg = GasGenerator() if gg is None else gg
    asked = sample(gg, points, seed)
    fixed = asked.pop("fixed")
    few = min(points, 400)  # compile and load beforehand
    head = {k: v[:few] for k, v in asked.items() if k != "theta"}
    head["theta"] = {k: v[:few] for k, v in asked["theta"].items()}
    first = {"N": fixed["N"], "PW": np.append(fixed["PW"][: few - 1], 1e9)}
    trim_batch(gg, first, n_threads=n_threads, **head)
    t, c = time.perf_counter(), time.process_time()
    batch = trim_batch(gg, fixed, n_threads=n_threads, **asked)
    t, c = time.perf_counter() - t, time.process_time() - c
    residual = recheck(gg, batch)
    solved = batch.status == Status.SOLVED
    reasons = [batch.reason(int(i)) for i in np.flatnonzero(~solved)]
    unexplained = int((batch.status == Status.UNEXPLAINED).sum()) + sum(not r for r in reasons)
    cold = solved & (batch.iterations >= 0)
    examples = {}
    for s in Status:
        at = np.flatnonzero(batch.status == s)
        if at.size and s != Status.SOLVED:
            examples[MEANING[s]] = batch.reason(int(at[0]))
    left = residual[solved]
    about: dict[str, Any] = {"points": points, "seed": seed, "counts": batch.counts()}
    about |= {"cold": int(cold.sum()), "continued": int((solved & ~cold).sum())}
    about["iterations"] = float(batch.iterations[cold].mean()) if cold.any() else float("nan")
    about["wrong"] = int((left > RESIDUAL_TOL).sum() + (~np.isfinite(left)).sum())
    about |= {"worst": float(left.max(initial=0.0)), "unexplained": unexplained}
    about |= {"backend": backend.backend_in_use(), "seconds": t, "cpu": c, "examples": examples}
    threads = backend.available_threads() if n_threads is None else n_threads
    return Report(**about, threads=threads)


def recheck(gg: GasGenerator, batch: TrimBatch) -> np.ndarray:
    """Evaluate the plain model at a batch's points: max-norm of all equations, shape (n,)."""
    n_z, n = len(gg.z), len(batch)
    w, p = batch.w, batch.p
    u = np.vstack([w[n_z + 1 :], p[:4]])
    ode, alg, y = (
        np.asarray(v) for v in gg.equations.map(n, "serial")(w[n_z : n_z + 1], w[:n_z], u, p[4:8])
    )
    del ode
    rows = [np.abs(alg).max(axis=0), np.abs(y[gg.Y.index("P_acceleration")]) / 5e5]
    for k, name in enumerate(batch.fixed):
        rows.append(np.abs(y[gg.Y.index(name)] - p[8 + k]) / gg.Y[name].nominal)
    worst: np.ndarray = np.max(rows, axis=0)
    return worst


def table(r: Report) -> str:
    """Return the report as text."""
    solved = r.counts["solved"]
    refused = r.points - solved

    def line(what: str, count: int, of: int | None = None, more: str = "") -> str:
        share = f"{100.0 / r.points * (count if of is None else of):6.2f} %"
        return f"  {what:<26}{count:7d}  {share}{more}"

    lines = [
        f"{r.points} random points, seed {r.seed}, backend {r.backend}, {r.threads} threads",
        line("solved", solved),
        line("  from a cold start", r.cold, more=f"  ({r.iterations:.2f} Newton steps)"),
        line("  by continuation", r.continued),
        line("refused with a reason", refused - r.unexplained, refused),
    ]
    apart = ("solved", MEANING[Status.UNEXPLAINED])
    lines += [line(f"  {k}", v) for k, v in r.counts.items() if v and k not in apart]
    wall, cpu = (1e6 * t / r.points for t in (r.seconds, r.cpu))
    lines += [
        f"  wrong (residual > 1e-9)   {r.wrong:7d}          (largest {r.worst:.1e})",
        f"  unexplained               {r.unexplained:7d}",
        f"  time per point            {wall:7.1f} us wall, {cpu:.1f} us processor",
    ]
    return "\n".join([*lines, *(f"  e.g. {v}" for v in r.examples.values())])
