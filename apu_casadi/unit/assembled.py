"""The linear model of the unit put together of the linear models of its parts, by (1)-(3).

Needed where a generator's part is that of means over a turn, which has no equations of its own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.sharing import once
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.unit.apu import Apu, JointPoint
from apu_casadi.unit.control import Governor
from apu_casadi.unit.jointfamily import N_REF, of_group
from apu_casadi.unit.linearmodel import LinearModel


class _Part(NamedTuple):
    """A generator's linear model in the unit: what stands before its names, and its group."""

    prefix: str
    numbers: tuple[int, ...]
    model: LinearModel

    def own(self, signals: Signals) -> Iterable[Signal]:
        return of_group(signals, self.prefix, self.numbers)

    @property
    def fed(self) -> list[int]:
        """Inputs but the speed."""
        return [i for i, n in enumerate(self.model.u.names) if n != "w_r"]


def assembled(
    apu: Apu, point: JointPoint, gas: LinearModel, gens: Mapping[tuple[int, ...], LinearModel]
) -> LinearModel:
    """Return the linear model of the governed unit.

    Args:
        apu, point: unit and steady point.
        gas: of the gas generator there.
        gens: of each group of equal generators, by their numbers.
    """
    one = len(gens) == 1
    parts = [_Part("" if one else f"generator{k[0]}.", k, m) for k, m in gens.items()]
    law, N_0, Wf_0 = apu.governor, float(point.gas["N"]), float(point.gas["Wf"])
    day = [gas.u.index(n) for n in AMBIENT]
    X = Signals([*gas.x, *law.X, *(s for p in parts for s in p.own(p.model.x))])
    fed = (s for p in parts for s in p.own(Signals(p.model.u[i] for i in p.fed)))
    U = Signals([*(gas.u[i] for i in day), N_REF, *fed])
    TH = Signals([*gas.theta, *(s for p in parts for s in p.own(p.model.theta))])
    Y = Signals([*gas.y, *(s for p in parts for s in p.own(p.model.y))])
    columns = Signals([*(dataclasses.replace(s, name=f"x.{s.name}") for s in X), *U, *TH])

    def by(names: Sequence[str], matrix: np.ndarray | None = None) -> np.ndarray:
        """Derivatives by these columns as a row, or rows, by all."""
        matrix = np.eye(len(names)) if matrix is None else matrix
        made = np.zeros((matrix.shape[0], len(columns)))
        made[:, columns.indices(names)] = matrix
        return made

    N = by(["x.N"])
    x_gov = law.start(Wf_0)
    slope = _law(law)(N_0, N_0, x_gov).full()
    governed = by(["x.N", "N_ref", *(f"x.{n}" for n in law.X.names)], slope)
    PW, moves, seen = np.zeros_like(N), [], []
    for p in parts:
        m, link = p.model, apu.link_of(p.numbers)
        of_x = by([f"x.{p.prefix}{n}" for n in m.x.names])
        of_th = by([f"{p.prefix}{n}" for n in m.theta.names])
        of_u = np.zeros((len(m.u), len(columns)))
        of_u[p.fed] = by([f"{p.prefix}{m.u.names[i]}" for i in p.fed])
        of_u[m.u.index("w_r")] = float(link.w_r(1.0)) * N[0]
        moves.append(m.A @ of_x + m.B_u @ of_u + m.B_theta @ of_th)
        seen.append(m.C @ of_x + m.D_u @ of_u + m.D_theta @ of_th)
        PW += float(link.PW(1.0)) * seen[-1][m.y.index("P_total")]
    of_u = np.zeros((len(gas.u), len(columns)))
    of_u[day] = by(AMBIENT)
    of_u[gas.u.index("Wf")], of_u[gas.u.index("PW")] = governed[0], PW[0]
    of_th = by(gas.theta.names)
    xdot = np.vstack([gas.A @ N + gas.B_u @ of_u + gas.B_theta @ of_th, governed[1:], *moves])
    y = np.vstack([gas.C @ N + gas.D_u @ of_u + gas.D_theta @ of_th, *seen])
    cut = (len(X), len(X) + len(U))
    (A, B_u, B_th), (C, D_u, D_th) = (np.split(m, cut, axis=1) for m in (xdot, y))
    rest = [float(v) for v in law.law(N_0, N_0, x_gov).rates]
    x0 = np.concatenate([gas.x0, x_gov, *(p.model.x0 for p in parts)])
    u0 = np.concatenate([gas.u0[day], [N_0], *(p.model.u0[p.fed] for p in parts)])
    theta0 = np.concatenate([gas.theta0, *(p.model.theta0 for p in parts)])
    y0 = np.concatenate([gas.y0, *(p.model.y0 for p in parts)])
    xdot0 = np.concatenate([gas.xdot0, rest, *(p.model.xdot0 for p in parts)])
    name = f"joint_{'_'.join(p.model.name for p in parts)}"
    there = (x0, u0, theta0, y0, xdot0)
    return LinearModel(name, X, U, TH, Y, A, B_u, B_th, C, D_u, D_th, *there)


@once
def _law(governor: Governor) -> ca.Function:
    """(N, N_ref, x) -> derivatives of fuel and rates by these."""
    N, N_ref, x = ca.SX.sym("N"), ca.SX.sym("N_ref"), ca.SX.sym("x", len(governor.X))
    Wf, rates = governor.law(N, N_ref, ca.vertsplit(x))
    J = ca.jacobian(ca.vertcat(Wf, *rates), ca.vertcat(N, N_ref, x))
    return ca.Function("law", [N, N_ref, x], [ca.densify(J)])
