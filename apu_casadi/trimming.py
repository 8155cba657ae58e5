"""Steady operating points: fix any two quantities, get everything else.

The cycle equations and the power balance leave two degrees of freedom; a trim fixes two outputs
by name (speed and shaft power, speed and T4, fuel flow and a load law, ...).  Newton's method
starts from the design point by similarity; where that fails, ambient, health and fixed values
are moved there from the design point in steps (continuation).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from apu_casadi.errors import OperatingPointError, SignalError
from apu_casadi.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.rootfinding import Newton, Root


@dataclass(frozen=True)
class OperatingPoint:
    """A solved steady point.

    Parameters
    ----------
    x, z, u, theta, y : packed vectors of the gas generator.
    values : outputs by name (SI).
    residual : re-evaluated max-norm of all equations, specifications included.
    iterations : Newton steps, over all continuation steps.
    """

    x: np.ndarray
    z: np.ndarray
    u: np.ndarray
    theta: np.ndarray
    y: np.ndarray
    values: dict[str, float]
    residual: float
    iterations: int

    def __getitem__(self, name: str) -> float:
        """Return an output by name."""
        return self.values[name]


@lru_cache(maxsize=32)
def _problem(gg: GasGenerator, fixed: tuple[str, ...]) -> tuple[Newton, tuple[str, ...]]:
    """Unknowns (z, N, Wf, PW); parameters (ambient 4, theta 4, fixed values)."""
    nz = len(gg.z)
    w, p = ca.MX.sym("w", nz + 3), ca.MX.sym("p", 8 + len(fixed))
    z, x = w[:nz], w[nz]
    u = ca.vertcat(w[nz + 1], w[nz + 2], p[:4])
    _, alg, y = gg.equations(x, z, u, p[4:8])
    PW_ref = gg.U["PW"].nominal
    rows = [alg, y[gg.Y.index("P_acceleration")] / PW_ref]
    rows += [(y[gg.Y.index(n)] - p[8 + i]) / gg.Y[n].nominal for i, n in enumerate(fixed)]
    names = (*gg.equation_names, "power balance", *(f"fixed {n}" for n in fixed))
    scale = np.concatenate([gg.z.nominals, [gg.parameters.N, gg.design.values["Wf"], PW_ref]])
    n_T = nz - 2  # all z but the two map coordinates are temperatures
    lower = np.concatenate([np.full(n_T, 120.0), [-9, -9], [0.2 * gg.parameters.N, 1e-5, -1e6]])
    upper = np.concatenate([np.full(n_T, 3500.0), [12, 12], [2 * gg.parameters.N, 1.0, 5e6]])
    residual = ca.Function("trim", [w, p], [ca.vertcat(*rows)])
    return Newton(residual, scale=scale, lower=lower, upper=upper, tol=RESIDUAL_TOL / 10), names


def trim_gas_generator(
    gg: GasGenerator,
    fixed: Mapping[str, float],
    *,
    theta: Mapping[str, float] | None = None,
    **ambient: float,
) -> OperatingPoint:
    """Solve a steady point of the gas generator.

    Parameters
    ----------
    fixed : two outputs by name with their values, SI: ``{"N": 3775, "PW": 5e5}``.
    theta : health factors by name, healthy by default.
    ambient : altitude (m), Mach, dT_isa (K), war (kg/kg).

    Raises
    ------
    SignalError : not two names, or an unknown one.
    OperatingPointError : no such point; says what failed, by how much, and the nearest reached.
    """
    names = tuple(sorted(fixed))
    if len(names) != 2:
        raise SignalError(f"a steady point needs two fixed quantities, got {len(names)}: {names}")
    for n in names:
        gg.Y.index(n)
    th = gg.THETA.pack(theta)
    u_target = gg.U.pack({"Wf": gg.design.values["Wf"], "PW": 0.0, **ambient})
    gg.check_inputs(u_target)
    newton, labels = _problem(gg, names)
    target = np.concatenate([u_target[2:], th, [float(fixed[n]) for n in names]])
    if not np.all(np.isfinite(target)):
        raise SignalError(f"fixed values must be finite, got {dict(fixed)}")
    root = newton(_start(gg, dict(fixed), u_target), target)
    total = root.iterations
    if not root.success:
        root, total, reached = _continue(gg, newton, names, target)
        if not root.success:
            _refuse(gg, root, labels, names, fixed, reached)
    nz = len(gg.z)
    x, z = root.x[nz : nz + 1], root.x[:nz]
    u = np.concatenate([root.x[nz + 1 :], u_target[2:]])
    y = np.asarray(gg.equations(x, z, u, th)[2]).ravel()
    values = gg.Y.unpack(y)
    if values["Mach8"] > 1.0:
        raise OperatingPointError(f"exhaust exit choked: Mach {values['Mach8']:.3f} at station 8")
    return OperatingPoint(x, z, u, th, y, values, root.residual, total)


def _start(gg: GasGenerator, fixed: dict[str, float], u: np.ndarray) -> np.ndarray:
    """First guess by similarity with the design point."""
    d = gg.design.values
    N = fixed.get("N", gg.parameters.N)
    ram = gg.equations(gg.parameters.N, list(gg.z.nominals), u, [1, 1, 1, 1])[2]
    delta = float(ram[gg.Y.index("P2")]) / d["P2"]
    PW_design = d["P_turb"] - d["P_cpr"] - gg.parameters.P_acc
    PW = fixed.get("PW", PW_design * delta)
    # a line through the design point: no net power needs about a third of the fuel
    load = (PW + gg.parameters.P_acc) / ((PW_design + gg.parameters.P_acc) * max(delta, 0.05))
    Wf = fixed.get("Wf", d["Wf"] * delta * (0.33 + 0.67 * min(max(load, 0.0), 1.5)))
    u0 = np.concatenate([[Wf, PW], u[2:]])
    z0 = np.asarray(gg.similar(ca.DM([N]), ca.DM(u0))).ravel()
    return np.concatenate([z0, [N, Wf, PW]])


def _continue(
    gg: GasGenerator, newton: Newton, names: tuple[str, ...], target: np.ndarray
) -> tuple[Root, int, float]:
    """Move from the design point to the target in adaptive steps of a common parameter s."""
    p, d = gg.parameters, gg.design.values
    PW_des = d["P_turb"] - d["P_cpr"] - p.P_acc
    u_des = np.array([d["Wf"], PW_des, p.altitude, p.Mach, p.dT_isa, p.war])
    z_des = np.asarray(gg.similar(ca.DM([p.N]), ca.DM(u_des))).ravel()
    y = np.asarray(gg.equations(p.N, z_des, u_des, [1, 1, 1, 1])[2]).ravel()
    origin = np.concatenate([u_des[2:], np.ones(4), [y[gg.Y.index(n)] for n in names]])
    w = np.concatenate([z_des, [p.N, d["Wf"], PW_des]])
    s, ds, total = 0.0, 0.25, 0
    root = newton(w, origin)
    while s < 1.0:
        s_try = min(1.0, s + ds)
        trial = newton(w, origin + s_try * (target - origin))
        total += trial.iterations
        if trial.success:
            root, w, s, ds = trial, trial.x, s_try, ds * 1.7
        else:
            ds /= 2
            if ds < 1e-3:
                return Root(w, trial.residual, trial.worst, False, total, trial.reason), total, s
    return root, total, 1.0


def _refuse(
    gg: GasGenerator,
    root: Root,
    labels: tuple[str, ...],
    names: tuple[str, ...],
    fixed: Mapping[str, float],
    reached: float,
) -> None:
    nz = len(gg.z)
    beta_c, beta_t = root.x[nz - 2], root.x[nz - 1]
    best = {n: root.x[nz + i] for i, n in enumerate(("N", "Wf", "PW"))}
    raise OperatingPointError(
        f"no steady point with {', '.join(f'{n} = {fixed[n]:.6g}' for n in names)}: stopped at "
        f"{100 * reached:.1f} % of the way from the design point; worst equation "
        f"{labels[root.worst]!r}, residual {root.residual:.1e} ({root.reason}); best point "
        + ", ".join(f"{k} = {v:.6g}" for k, v in best.items())
        + f", map coordinates beta_c = {beta_c:.3f}, beta_t = {beta_t:.3f}"
    )
