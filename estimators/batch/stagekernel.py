"""One stage of a transcription: values and exact derivatives as CasADi functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.sharing import kept
from estimators.models.lifting import Lifted

__all__ = ["Kernel", "kernel"]


class Kernel(NamedTuple):
    """Functions of one stage in scaled unknowns q = (x, s, w, xi, theta).

    Args:
        value: (q, d) -> (e, c): normalised residuals (y - g)/sigma, w, xi; next state, constraints.
        first: (q, d) -> (e, c, nonzeros of de/dq, nonzeros of dc/dq, e' de/dq).
        second: (q, d, lam_e, lam_c) -> nonzeros of the upper triangle of the Hessian of lam_e/2
            e'e + lam_c' c.
        check: (q, d) -> residual of what is solved for inside, outputs in their units.
        J_e, J_c, H: the sparsities.
        sizes: of x, s, w, xi, theta.
        scale: of q, shape (n,).
        walk: rows of x with process noise.
    """

    value: ca.Function
    first: ca.Function
    second: ca.Function
    check: ca.Function
    J_e: ca.Sparsity
    J_c: ca.Sparsity
    H: ca.Sparsity
    sizes: tuple[int, int, int, int, int]
    scale: np.ndarray
    walk: tuple[int, ...]


@kept
def kernel(lifted: Lifted, names: tuple[str, ...]) -> Kernel:
    """Make the functions of one stage; ``names`` are the parameters that are unknowns."""
    model = lifted.model
    nx, nu, np_, nw, ny = model.sizes
    moving = () if lifted.steady else tuple(int(i) for i in np.flatnonzero(model.walk > 0))
    sizes = nx, len(lifted.s), nw, len(moving), len(names)
    cols = model.p.indices(names)
    scale = np.concatenate(
        [model.x.nominals, lifted.s.nominals, np.ones(nw + len(moving)), model.p.nominals[cols]]
    )
    n = scale.size
    kind = ca.SX if lifted.stage.is_a("SXFunction") else ca.MX
    q, d = kind.sym("q", n), kind.sym("d", nu + np_ + 2 * ny + 1)
    k = kind.sym("k", lifted.frozen.size1_out(0))
    x, s, w, xi, th = ca.vertsplit(q * ca.DM(scale), [0, *np.cumsum(sizes).tolist()])
    u, p0, y, weight, dt = ca.vertsplit(d, [0, *np.cumsum([nu, np_, ny, ny, 1]).tolist()])
    place = {i: th[j] for j, i in enumerate(cols)}
    p = ca.vertcat(kind(0, 1), *(place.get(i, p0[i]) for i in range(np_)))
    g, x1, c, check = lifted.stage(x, s, u, p, w, dt, k)
    spread = ca.DM(nx, len(moving))
    for j, i in enumerate(moving):
        spread[i, j] = model.walk[i]
    if moving:
        x1 = x1 + ca.sqrt(dt) * ca.mtimes(spread, xi)
    e = ca.vertcat(model.innovation(y, g) * weight, w, xi)
    c = ca.vertcat(x1 / model.x.nominals, c)
    J_e, J_c = ca.jacobian(e, q), ca.jacobian(c, q)
    le, lc = kind.sym("le"), kind.sym("lc", c.shape[0])
    H = ca.triu(ca.hessian(le / 2 * ca.dot(e, e) + ca.dot(lc, c), q)[0])

    def nz(J: Any) -> Any:
        return ca.sparsity_cast(J, ca.Sparsity.dense(J.nnz(), 1))

    tag = f"{model.name}_{'steady_' if lifted.steady else ''}stage"
    # the same arguments in an MX graph, where the coefficients k are looked up
    Q, D = ca.MX.sym("q", n), ca.MX.sym("d", d.shape[0])
    X = ca.vertsplit(Q * ca.DM(scale), [0, *np.cumsum(sizes).tolist()])
    U, P0, _, _, DT = ca.vertsplit(D, [0, *np.cumsum([nu, np_, ny, ny, 1]).tolist()])
    P = ca.vertcat(ca.MX(0, 1), *(X[4][cols.index(i)] if i in place else P0[i] for i in range(np_)))
    K = lifted.frozen(X[0], X[1], U, P, X[2], DT)

    def function(name: str, more: Sequence[Any], out: Sequence[Any]) -> ca.Function:
        values = [ca.densify(o) for o in out]
        if kind is ca.SX:
            values = ca.cse(values)
        inner = ca.Function(f"{tag}_{name}", [q, d, *more, k], values)
        if not k.shape[0]:
            return ca.Function(f"{tag}_{name}", [q, d, *more], [*values])
        others = [ca.MX.sym(f"l{i}", m.shape[0]) for i, m in enumerate(more)]
        return ca.Function(f"{tag}_{name}_at", [Q, D, *others], inner.call([Q, D, *others, K]))

    return Kernel(
        function("value", [], [e, c]),
        function("first", [], [e, c, nz(J_e), nz(J_c), J_e.T @ e]),
        function("second", [le, lc], [nz(H)]),
        function("check", [], [check, g]),
        J_e.sparsity(),
        J_c.sparsity(),
        H.sparsity(),
        sizes,
        scale,
        moving,
    )
