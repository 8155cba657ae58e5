"""The equations of a steady point as one compiled Newton iteration, and a first guess for it.

Unknowns are the cycle's z, speed, fuel flow and shaft power, less what is fixed directly.  Those
that must stay positive are sought as logarithms: no iterate leaves the range, and a relative step
means the same at every altitude.  Each Newton step is limited; the step, not the residual, decides
when to stop, and the residual is evaluated again at the end, whatever the iteration said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.rootfinding import schur_sign, solve_bordered
from apu_casadi.core.sharing import Rebuilt, derived
from apu_casadi.gaspath.components.inlet import inlet
from apu_casadi.gaspath.cycle import (
    AMBIENT_STATE,
    COLUMNS,
    EQUATIONS,
    N_ORDERED,
    ORDER,
    THETA,
    Z_NAMES,
    Assembled,
    Cycle,
    Point,
    U,
    Y,
)

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


class System(NamedTuple):
    """The equations at one point, as SX.

    r : residuals, in the order of ``TrimKernel.rows``.  J : their derivatives by the unknowns as
    sought.  w : (z, N, Wf, PW), a list.  y : outputs.
    """

    r: Any
    J: Any
    w: list[Any]
    y: Any


class TrimKernel(Rebuilt):
    """The equations of steady points with two given quantities.

    Args:
        cycle: the engine.
        spec: names of the two fixed outputs; ``LAW`` in place of ``"PW"`` for a load law, whose
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
                slope[i] = self.nominal[i]
        for n, i in DIRECT.items():
            if n in values:
                w[i] = values[n]
        dPW_dN = 0.0
        if LAW in values:
            PW_ref, N_ref, k = ca.vertsplit(values[LAW])
            N = w[DIRECT["N"]]
            w[DIRECT["PW"]] = PW_ref * (N / N_ref) ** k
            dPW_dN = w[DIRECT["PW"]] * k / N
        return w, slope, dPW_dN

    def _ambient(self, p: Any) -> Any:
        n = len(AMBIENT)
        return self.cycle.ambient(ca.vertcat(0.0, 0.0, p[:n]))

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Unknowns s, parameters p, ambient state a."""
        sizes = {"s": len(self.free), "p": self.n_p, "a": len(AMBIENT_STATE)}
        s, p, a = (ca.SX.sym(k, n) for k, n in sizes.items())
        return s, p, a

    def _function(
        self,
        name: str,
        args: Mapping[str, ca.SX],
        s: Any,
        p: Any,
        a: Any,
        outputs: Callable[[System], Mapping[str, Any]],
    ) -> ca.Function:
        """Make a function of ``args``, which give s, p and a, that evaluates the equations."""
        w, slope, dPW_dN = self._decode(s, p)
        n = len(AMBIENT)
        N, Wf, PW = w[NZ:]
        point = Point(
            x=N, z=ca.vertcat(*w[:NZ]), u=ca.vertcat(Wf, PW, p[:n]), a=a, theta=p[n:N_FIRST]
        )

        def made(c: Assembled) -> Mapping[str, Any]:
            return outputs(self._system(c, p, w, slope, dPW_dN))

        return self.cycle.function(name, args, point, made)

    def _system(
        self, c: Assembled, p: Any, w: list[Any], slope: dict[int, Any], dPW_dN: Any
    ) -> System:
        """Residuals and their Jacobian by s, from the cycle at w."""
        values = self._values(p)
        k = COLUMNS
        # columns of (z, N, Wf, PW) among v = (z, x, u, a, theta)
        columns = [*range(NZ), k.x.start, k.u.start, k.u.start + 1]
        load = ca.SX(1, N_W)
        load[0, DIRECT["PW"]] = 1
        r = [c.alg, (c.P_free - w[DIRECT["PW"]]) / self.PW_design]
        J = [c.dq[:NZ, columns], (c.dq[NZ, columns] - load) / self.PW_design]
        for name in (n for n in self.spec if n not in (*DIRECT, LAW)):
            scale = Y[name].nominal
            r.append((c.y[Y.index(name)] - values[name]) / scale)
            J.append(c.dy[Y.index(name), columns] / scale)
        J_w = ca.vertcat(*J)
        J_s = ca.horzcat(*(J_w[:, i] * slope[i] for i in self.free))
        if LAW in self.spec and DIRECT["N"] in self.free:
            at = self.free.index(DIRECT["N"])
            J_s[:, at] += J_w[:, DIRECT["PW"]] * dPW_dN * slope[DIRECT["N"]]
        return System(ca.vertcat(*r), J_s, w, c.y)

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

        N = values.get("N", par.N)
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
            cy.cmap.beta_des,
            cy.tmap.beta_des,
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
        v, q = ca.SX.sym("v", n + 1), ca.SX.sym("q", m + len(AMBIENT_STATE))
        rows = [*ORDER, *range(NZ, n)]

        def step(e: System) -> dict[str, Any]:
            d = -solve_bordered(e.J[rows, :], e.r[rows], N_ORDERED)
            d = d * ca.fmin(1.0, MAX_STEP / ca.norm_inf(d))
            return {"F": ca.vertcat(-d, -_COUNT)}

        F = self._function("trim_step", {"v": v, "q": q}, v[:n], q[:m], q[m:], step)
        x, c = F.mx_in()
        options = {
            "abstol": 0.0,
            "abstolStep": STEP_TOL,
            "max_iter": iterations,
            "error_on_fail": False,
            "jacobian_function": ca.Function("trim_loop", [x, c], [ca.DM.eye(n + 1), F(x, c)]),
        }
        return ca.rootfinder("trim_root", "fast_newton", F, options)

    def _outputs(self, s0: Any, p: Any, a: Any, iterations: int) -> list[Any]:
        n = len(self.free)
        v = self._root(iterations)(ca.vertcat(s0, 0.0), ca.vertcat(p, a))
        s_end, p_end, a_end = self._symbols()
        end = self._function(
            "trim_end", {"s": s_end, "p": p_end, "a": a_end}, s_end, p_end, a_end,
            lambda e: {"w": ca.vertcat(*e.w), "y": e.y, "r": e.r},
        )  # fmt: skip
        return [*end(v[:n], p, a), v[:n], v[n] / _COUNT]

    @derived
    def cold(self) -> ca.Function:
        """Solve from the similarity guess: (p,) -> :class:`Output`.

        p are the ambient inputs, health factors and fixed values, in this order.
        """
        p = ca.MX.sym("p", self.n_p)
        a = self._ambient(p)
        _, ps, as_ = self._symbols()
        start = ca.Function("trim_start", [ps, as_], [self._start(ps, as_)])
        out = self._outputs(start(p, a), p, a, MAX_ITERATIONS)
        return ca.Function(f"trim_{self.label}", [p], out, ["p"], list(Output._fields))

    @derived
    def warm(self) -> ca.Function:
        """Solve from a given start: (s, p) -> :class:`Output`."""
        s, p = ca.MX.sym("s", len(self.free)), ca.MX.sym("p", self.n_p)
        out = self._outputs(s, p, self._ambient(p), WARM_ITERATIONS)
        names = list(Output._fields)
        names[names.index("s")] = "s1"
        return ca.Function(f"trim_warm_{self.label}", [s, p], out, ["s", "p"], names)

    @derived
    def equations(self) -> ca.Function:
        """(s, p) -> residuals, and their Jacobian by the scaled unknowns, which tells a fold."""
        s, p, _ = self._symbols()
        args = {"s": s, "p": p}
        a = self._ambient(p)
        return self._function("trim_equations", args, s, p, a, lambda e: {"r": e.r, "J": e.J})

    @derived
    def side(self) -> ca.Function:
        """(s, p) -> sign of the determinant of the Jacobian, which changes at a fold.

        That of the equations of the stations, each of which gives one temperature, is left out: its
        sign never changes but with the branch of the static temperature at 3, which no other
        equation contains.
        """
        n = len(self.free)
        s, p, _ = self._symbols()
        rows = [*ORDER, *range(NZ, n)]
        return self._function(
            f"trim_side_{self.label}", {"s": s, "p": p}, s, p, self._ambient(p),
            lambda e: {"side": schur_sign(e.J[rows, :], N_ORDERED)},
        )  # fmt: skip

    @property
    def label(self) -> str:
        """The specification as an identifier."""
        return "_".join("law" if n == LAW else n for n in self.spec)

    def sought(self, w: np.ndarray) -> np.ndarray:
        """Return s from w = (z, N, Wf, PW), by columns."""
        s = (w.T / self.nominal).T
        s[self.log] = np.log(s[self.log])
        return s[self.free]

    def design_start(self) -> np.ndarray:
        """Return s at the design point, shape (n,)."""
        d = self.cycle.design
        z = [d.z[n] for n in Z_NAMES[: NZ - 2]] + [
            self.cycle.cmap.beta_des,
            self.cycle.tmap.beta_des,
        ]
        return self.sought(np.array([*z, self.cycle.p.N, d.values["Wf"], self.PW_design]))
