"""The equations of a steady point as one compiled Newton iteration, and a first guess for it.

Unknowns are the cycle's z, speed, fuel flow and shaft power, less what is fixed directly.  Those
that must stay positive are sought as logarithms: no iterate leaves the range, and a relative step
means the same at every altitude.  Each Newton step is limited; the step, not the residual, decides
when to stop, and the residual is evaluated again at the end, whatever the iteration said.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.components.inlet import inlet
from apu_casadi.cycle import COLUMNS, EQUATIONS, THETA, Z_NAMES, Cycle, U, Y

NZ = len(Z_NAMES)
N_W = NZ + 3  # w = (z, N, Wf, PW)
DIRECT = {"N": NZ, "Wf": NZ + 1, "PW": NZ + 2}
HOT = ("T4", "T41", "T50", "T5", "T8")  # outputs that grow with fuel-air ratio
LAW = "PW ~ N^k"  # stands for "PW" in a specification whose power is a law of speed
AMBIENT = U.names[2:]
N_FIRST = len(AMBIENT) + len(THETA)  # parameters before the fixed values
STEP_TOL = 1e-6  # Newton converges quadratically: after such a step some 1e-12 is left
MAX_STEP = 0.4  # largest change of an unknown in one step: relative, or of its nominal value
MAX_ITERATIONS = 16  # of a cold start
WARM_ITERATIONS = 10  # of a start nearby; a continuation rather halves its step
_COUNT = 1e-12  # what one iteration adds to the counter, far below STEP_TOL


class Output(NamedTuple):
    """Positions in what the kernel returns.

    w : (z, N, Wf, PW), shape (14,).  y : outputs.  r : residuals of the cycle, the power balance
    and the specifications that are not direct.  s : the unknowns as sought.  iterations : count.
    """

    w: Any
    y: Any
    r: Any
    s: Any
    iterations: Any


class TrimKernel:
    """The equations of steady points with two given quantities.

    Parameters
    ----------
    cycle : the engine.
    spec : names of the two fixed outputs; ``LAW`` in place of ``"PW"`` for a load law, whose
        values are (PW_ref, N_ref, exponent).
    """

    def __init__(self, cycle: Cycle, spec: tuple[str, str]) -> None:
        """Choose the unknowns; expressions are built when first needed."""
        self.cycle, self.spec = cycle, spec
        d, p = cycle.design.values, cycle.p
        self.PW_design = d["P_turb"] - d["P_cpr"] / p.eta_cpr - p.P_acc
        self.nominal = np.concatenate([cycle.z.nominals, [p.N, d["Wf"], self.PW_design]])
        fixed = {DIRECT[n] for n in spec if n in DIRECT} | ({DIRECT["PW"]} & self._law_columns)
        self.free = [i for i in range(N_W) if i not in fixed]
        self.log = np.array([True] * (NZ - 2) + [False] * 2 + [True, True, False])
        self.rows = (
            *EQUATIONS, "power balance", *(f"fixed {n}" for n in spec if n not in (*DIRECT, LAW))
        )  # fmt: skip
        self.n_p = N_FIRST + sum(3 if n == LAW else 1 for n in spec)

    @property
    def _law_columns(self) -> set[int]:
        return {DIRECT["PW"]} if LAW in self.spec else set()

    # -- expressions ------------------------------------------------------------------------

    def _values(self, p: Any) -> dict[str, Any]:
        """The fixed values by name; three for a load law."""
        at, out = N_FIRST, {}
        for n in self.spec:
            k = 3 if n == LAW else 1
            out[n] = p[at : at + k]
            at += k
        return out

    def _decode(self, s: Any, p: Any) -> tuple[list[Any], dict[int, Any], Any]:
        """Return w as list, dw/ds of the free ones, and dPW/dN of a load law."""
        values = self._values(p)
        w: list[Any] = [None] * N_W
        slope: dict[int, Any] = {}
        for k, i in enumerate(self.free):
            if self.log[i]:
                w[i] = self.nominal[i] * ca.exp(s[k])
                slope[i] = w[i]
            else:
                w[i] = self.nominal[i] * s[k]
                slope[i] = ca.MX(self.nominal[i])
        for n, i in DIRECT.items():
            if n in values:
                w[i] = values[n]
        dPW_dN = ca.MX(0)
        if LAW in values:
            PW_ref, N_ref, k = ca.vertsplit(values[LAW])
            N = w[DIRECT["N"]]
            w[DIRECT["PW"]] = PW_ref * (N / N_ref) ** k
            dPW_dN = w[DIRECT["PW"]] * k / N
        return w, slope, dPW_dN

    def _ambient(self, p: Any) -> Any:
        n = len(AMBIENT)
        return self.cycle.ambient(ca.vertcat(ca.MX(2, 1), p[:n]))

    def _system(
        self, s: Any, p: Any, a: Any, *, derivatives: bool
    ) -> tuple[Any, Any, list[Any], Any]:
        """Residuals, their Jacobian by s (or None), w and y (or None)."""
        w, slope, dPW_dN = self._decode(s, p)
        z, N, Wf, PW = ca.vertcat(*w[:NZ]), *w[NZ:]
        n = len(AMBIENT)
        u, theta = ca.vertcat(Wf, PW, p[:n]), p[n:N_FIRST]
        implicit = [name for name in self.spec if name not in (*DIRECT, LAW)]
        direct_z = {name: "T5" if name == "T8" else name for name in implicit}
        direct_z = {k: v for k, v in direct_z.items() if v in Z_NAMES}
        need_y = not derivatives or len(direct_z) < len(implicit)
        c = self.cycle.assemble(N, z, u, a, theta, outputs=need_y, derivatives=derivatives)
        values = self._values(p)
        PW_ref = self.PW_design
        rows = [c.alg, (c.P_free - PW) / PW_ref]
        for name in implicit:
            value = w[Z_NAMES.index(direct_z[name])] if name in direct_z else c.y[Y.index(name)]
            rows.append((value - values[name]) / Y[name].nominal)
        r = ca.vertcat(*rows)
        if not derivatives:
            return r, None, w, c.y
        k = COLUMNS
        # columns of (z, N, Wf, PW) among v = (z, x, u, a, theta)
        columns = [*range(NZ), k.x.start, k.u.start, k.u.start + 1]
        own = ca.DM(1, N_W)
        own[0, DIRECT["PW"]] = 1
        parts = [
            c.dq[:NZ, :][:, columns],
            (c.dq[NZ, :][:, columns] - ca.sparsify(own)) / PW_ref,
        ]
        for name in implicit:
            if name in direct_z:
                e = ca.DM(1, N_W)
                e[0, Z_NAMES.index(direct_z[name])] = 1
                parts.append(ca.MX(ca.sparsify(e)) / Y[name].nominal)
            else:
                parts.append(c.dy[Y.index(name), :][:, columns] / Y[name].nominal)
        J = ca.vertcat(*parts)
        J_free = ca.horzcat(*(J[:, i] * slope[i] for i in self.free))
        if LAW in self.spec and DIRECT["N"] in self.free:
            at = self.free.index(DIRECT["N"])
            extra = J[:, DIRECT["PW"]] * dPW_dN * slope[DIRECT["N"]]
            J_free = J_free + ca.horzcat(
                *(extra if i == at else ca.MX(J.shape[0], 1) for i in range(len(self.free)))
            )
        return r, J_free, w, c.y

    def _start(self, p: Any, a: Any) -> Any:
        """First guess by similarity with the design point, from whatever is fixed."""
        cy = self.cycle
        d, par, zd = cy.design.values, cy.p, cy.design.z
        values = self._values(p)
        T2, P2 = inlet(T1=a[2], P1=a[3], dp_inlet=par.dp_inlet)
        t, delta = T2 / d["T2"], P2 / d["P2"]
        full = (self.PW_design + par.P_acc) * delta  # shaft and accessories at design fuel
        idle = 0.33  # share of the design fuel at no net power: a line through the design point

        def fuel_of(PW: Any) -> Any:
            load = ca.fmin(ca.fmax((PW + par.P_acc) / full, -0.3), 1.5)
            return d["Wf"] * delta * (idle + (1 - idle) * load)

        def power_of(Wf: Any) -> Any:
            return full * (Wf / (d["Wf"] * delta) - idle) / (1 - idle) - par.P_acc

        N = values.get("N", ca.MX(par.N))
        if LAW in values:
            PW_ref, N_ref, k = ca.vertsplit(values[LAW])
            if "Wf" in values:
                share = ca.fmin(ca.fmax(power_of(values["Wf"]) / PW_ref, 0.05), 2.0)
                N = N_ref * ca.fmin(ca.fmax(share ** (1 / ca.fmax(k, 0.5)), 0.5), 1.15)
            PW = PW_ref * (N / N_ref) ** k
        else:
            PW = values.get("PW")
        n = N / par.N / ca.sqrt(t)
        T3 = T2 * (1 + (zd["T3"] / d["T2"] - 1) * n**2)
        W = par.W2 * delta / ca.sqrt(t) * n
        rise = (par.T4 - zd["T3"]) / (d["Wf"] / par.W2)
        hot = [name for name in HOT if name in values]
        if "Wf" in values:
            Wf = values["Wf"]
        elif hot:
            T4 = values[hot[0]] * par.T4 / d[hot[0]]
            Wf = ca.fmax((T4 - T3) / rise * W, 0.05 * d["Wf"] * delta)
        else:
            Wf = fuel_of(PW) if PW is not None else d["Wf"] * delta
        if PW is None:
            PW = power_of(Wf)
        T4 = T3 + rise * Wf / W
        ratio = {"T3s": T3, "T3": T3, "Ts3": T3}
        z = [
            *(
                zd[m] * (ratio[m] / zd["T3"] if m in ratio else T4 / par.T4)
                for m in Z_NAMES[: NZ - 2]
            ),
            ca.MX(cy.cmap.beta_des),
            ca.MX(cy.tmap.beta_des),
        ]
        w = [*z, N, Wf, PW]
        return ca.vertcat(
            *(
                ca.log(w[i] / self.nominal[i]) if self.log[i] else w[i] / self.nominal[i]
                for i in self.free
            )
        )

    # -- functions --------------------------------------------------------------------------

    def _root(self, iterations: int) -> ca.Function:
        """Limited Newton iteration: (s0 with counter, p and a) -> s with counter.

        ``fast_newton`` serves as the loop alone.  It is given the identity for a Jacobian and the
        limited step for a residual, so that what it subtracts is the step made here.
        """
        n, m = len(self.free), self.n_p
        v, q = ca.MX.sym("v", n + 1), ca.MX.sym("q", m + 4)
        r, J, _, _ = self._system(v[:n], q[:m], q[m:], derivatives=True)
        step = -ca.solve(J, r, "qr")
        step = step * ca.fmin(1.0, MAX_STEP / ca.norm_inf(step))
        F = ca.Function("trim_step", [v, q], [ca.vertcat(-step, -_COUNT)])
        back = F(v, q)
        options = {
            "abstol": 0.0,
            "abstolStep": STEP_TOL,
            "max_iter": iterations,
            "error_on_fail": False,
            "jacobian_function": ca.Function("trim_loop", [v, q], [ca.DM.eye(n + 1), back]),
        }
        return ca.rootfinder("trim_root", "fast_newton", F, options)

    def _outputs(self, s0: Any, p: Any, a: Any, iterations: int) -> list[Any]:
        n = len(self.free)
        v = self._root(iterations)(ca.vertcat(s0, 0.0), ca.vertcat(p, a))
        r, _, w, y = self._system(v[:n], p, a, derivatives=False)
        return [ca.vertcat(*w), ca.densify(y), ca.densify(r), v[:n], v[n] / _COUNT]

    @cached_property
    def cold(self) -> ca.Function:
        """Solve from the similarity guess: (p,) -> :class:`Output`.

        p are the ambient inputs, health factors and fixed values, in this order.
        """
        p = ca.MX.sym("p", self.n_p)
        a = self._ambient(p)
        out = self._outputs(self._start(p, a), p, a, MAX_ITERATIONS)
        return ca.Function(f"trim_{self.label}", [p], out, ["p"], list(Output._fields))

    @cached_property
    def warm(self) -> ca.Function:
        """Solve from a given start: (s, p) -> :class:`Output`."""
        s, p = ca.MX.sym("s", len(self.free)), ca.MX.sym("p", self.n_p)
        out = self._outputs(s, p, self._ambient(p), WARM_ITERATIONS)
        names = list(Output._fields)
        names[names.index("s")] = "s1"
        return ca.Function(f"trim_warm_{self.label}", [s, p], out, ["s", "p"], names)

    @cached_property
    def jacobian(self) -> ca.Function:
        """(s, p) -> Jacobian of the scaled equations by the scaled unknowns; to tell a fold."""
        s, p = ca.MX.sym("s", len(self.free)), ca.MX.sym("p", self.n_p)
        _, J, _, _ = self._system(s, p, self._ambient(p), derivatives=True)
        return ca.Function("trim_jacobian", [s, p], [ca.densify(J)])

    @property
    def label(self) -> str:
        """The specification as an identifier."""
        return "_".join("law" if n == LAW else n for n in self.spec)

    def design_start(self) -> np.ndarray:
        """Return s at the design point, shape (n,)."""
        d = self.cycle.design
        z = [d.z[n] for n in Z_NAMES[: NZ - 2]] + [
            self.cycle.cmap.beta_des,
            self.cycle.tmap.beta_des,
        ]
        w = np.array([*z, self.cycle.p.N, d.values["Wf"], self.PW_design])
        s = w / self.nominal
        s[self.log] = np.log(s[self.log])
        return s[self.free]
