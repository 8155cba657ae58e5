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
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.cycle import COLUMNS, N_ORDERED, Assembled, Cycle, Point, similar_z
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.gaspath.stations import AMBIENT_STATE, UNKNOWNS, Y, Z
from apu_casadi.gaspath.unitnumbers import MAPS, NUMBERS, UnitParts

NZ = len(Z)
N_W = NZ + 3  # w = (z, N, Wf, PW)
DIRECT = {"N": NZ, "Wf": NZ + 1, "PW": NZ + 2}
HOT = ("T4", "T41", "T50", "T5", "T8")  # outputs that grow with fuel-air ratio
LAW = "PW ~ N^k"  # stands for "PW" in a specification whose power is a law of speed
N_FIRST = len(AMBIENT) + len(HEALTH)  # parameters before the fixed values
IDLE = 0.33  # share of the design fuel at no net power, of the first guess
STEP_TOL = 1e-6  # Newton converges quadratically: after such a step some 1e-12 is left
MAX_STEP = 0.4  # largest change of an unknown in one step: relative, or of its nominal value
MAX_ITERATIONS = 16  # of a cold start
WARM_ITERATIONS = 10  # of a start nearby; a continuation rather halves its step
_COUNT = 1e-12  # what one iteration adds to the counter, far below STEP_TOL


class Output(NamedTuple):
    """Positions in what the kernel returns.

    Args:
        w: (z, N, Wf, PW), shape (14,).
        y: outputs.
        r: residuals of the cycle, the power balance and the specifications that are not direct.
        s: the unknowns as sought.
        iterations: their number.
    """

    w: Any
    y: Any
    r: Any
    s: Any
    iterations: Any


class System(NamedTuple):
    """The equations at one point, as SX.

    r : residuals: of the cycle, of the power balance, and of what is fixed.  J : their derivatives
    by the unknowns as sought.  w : (z, N, Wf, PW), a list.  y : outputs.
    """

    r: Any
    J: Any
    w: list[Any]
    y: Any


class TrimKernel(Rebuilt):
    """The equations of steady points with two given quantities, for all engines of a structure.

    Args:
        cycle: the structure.
        spec: names of the two fixed outputs; ``LAW`` in place of ``"PW"`` for a load law, whose
            values are (PW_ref, N_ref, exponent).

    Functions take c, the numbers of the engine, as last argument.
    """

    cycle: Cycle
    spec: tuple[str, str]
    free: list[int]
    log: np.ndarray
    n_p: int

    def __init__(self, cycle: Cycle, spec: tuple[str, str]) -> None:
        """Choose the unknowns; expressions are built when first needed."""
        self.cycle, self.spec = cycle, spec
        fixed = {DIRECT[n] for n in spec if n in DIRECT} | ({DIRECT["PW"]} & self._law_columns)
        self.free = [i for i in range(N_W) if i not in fixed]
        self.log = np.array([bool(k.follows) for k in UNKNOWNS] + [True, True, False])
        self.n_p = N_FIRST + sum(3 if n == LAW else 1 for n in spec)

    @property
    def _law_columns(self) -> set[int]:
        return {DIRECT["PW"]} if LAW in self.spec else set()

    # -- expressions ------------------------------------------------------------------------

    def _nominal(self, c: Any) -> Any:
        """Magnitudes of w: those of z, design speed, fuel flow and shaft power."""
        rows = ("gas_generator.N", "design.Wf", "design.PW")
        return ca.vertcat(self.cycle.scale(c), *(c[NUMBERS.index(n)] for n in rows))

    def _values(self, p: Any) -> dict[str, Any]:
        """The fixed values by name; three for a load law."""
        at, out = N_FIRST, {}
        for n in self.spec:
            k = 3 if n == LAW else 1
            out[n] = p[at : at + k]
            at += k
        return out

    def _decode(self, s: Any, p: Any, c: Any) -> tuple[list[Any], dict[int, Any], Any]:
        """Return w as list, dw/ds of the free ones, and dPW/dN of a load law."""
        values, nominal = self._values(p), ca.vertsplit(self._nominal(c))
        w: list[Any] = [None] * N_W
        slope: dict[int, Any] = {}
        for k, i in enumerate(self.free):
            if self.log[i]:
                w[i] = nominal[i] * ca.exp(s[k])
                slope[i] = w[i]
            else:
                w[i] = nominal[i] * s[k]
                slope[i] = nominal[i]
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

    def _symbols(self) -> dict[str, ca.SX]:
        """Unknowns s, parameters p, ambient state a, numbers c."""
        sizes = {"s": len(self.free), "p": self.n_p, "a": len(AMBIENT_STATE), "c": len(NUMBERS)}
        return {k: ca.SX.sym(k, n) for k, n in sizes.items()}

    def _function(
        self,
        name: str,
        args: Mapping[str, ca.SX],
        outputs: Callable[[System], Mapping[str, Any]],
        reciprocals: bool = False,
        **at: Any,
    ) -> ca.Function:
        """Make a function of ``args`` that evaluates the equations at s, p, a, c.

        These are arguments, or given as expressions of them; ``reciprocals`` as of
        :meth:`~apu_casadi.gaspath.cycle.Cycle.function`.
        """
        s, p, a, c = ({**args, **at}[k] for k in "spac")
        w, slope, dPW_dN = self._decode(s, p, c)
        n = len(AMBIENT)
        N, Wf, PW = w[NZ:]
        u = ca.vertcat(Wf, PW, p[:n])
        point = Point(x=N, z=ca.vertcat(*w[:NZ]), u=u, a=a, theta=p[n:N_FIRST], c=c)
        PW_design = c[NUMBERS.index("design.PW")]

        def made(e: Assembled) -> Mapping[str, Any]:
            return outputs(self._system(e, p, w, slope, dPW_dN, PW_design))

        return self.cycle.function(name, args, point, made, reciprocals=reciprocals)

    def _system(
        self,
        e: Assembled,
        p: Any,
        w: list[Any],
        slope: dict[int, Any],
        dPW_dN: Any,
        PW_design: Any,
    ) -> System:
        """Residuals and their Jacobian by s, from the cycle at w."""
        values = self._values(p)
        k = COLUMNS
        # columns of (z, N, Wf, PW) among v = (z, x, u, a, theta)
        columns = [*range(NZ), k.x.start, k.u.start, k.u.start + 1]
        load = ca.SX(1, N_W)
        load[0, DIRECT["PW"]] = 1
        r = [e.alg, (e.P_free - w[DIRECT["PW"]]) / PW_design]
        J = [e.dq[:NZ, columns], (e.dq[NZ, columns] - load) / PW_design]
        for name in (n for n in self.spec if n not in (*DIRECT, LAW)):
            scale = Y[name].nominal
            r.append((e.y[Y.index(name)] - values[name]) / scale)
            J.append(e.dy[Y.index(name), columns] / scale)
        J_w = ca.vertcat(*J)
        J_s = ca.horzcat(*(J_w[:, i] * slope[i] for i in self.free))
        if LAW in self.spec and DIRECT["N"] in self.free:
            at = self.free.index(DIRECT["N"])
            J_s[:, at] += J_w[:, DIRECT["PW"]] * dPW_dN * slope[DIRECT["N"]]
        return System(ca.vertcat(*r), J_s, w, e.y)

    def _start(self, p: Any, a: Any, c: Any) -> Any:
        """First guess by similarity with the design point, from whatever is fixed."""
        unit = self.cycle.parts(c)
        d, par = unit.design.values, unit.p
        values = self._values(p)
        T2, P2 = inlet(T1=a[2], P1=a[3], dp_inlet=par.dp_inlet)
        t, delta = T2 / d["T2"], P2 / d["P2"]
        N, Wf, PW = self._flows(unit, values, delta)
        n = N / par.N / ca.sqrt(t)
        T3 = T2 * (1 + (d["T3"] / d["T2"] - 1) * n**2)
        W = par.W2 * delta / ca.sqrt(t) * n
        rise = (par.T4 - d["T3"]) / (d["Wf"] / par.W2)
        hot = [name for name in HOT if name in values]
        if Wf is None and hot:
            T4 = values[hot[0]] * par.T4 / d[hot[0]]
            Wf = ca.fmax((T4 - T3) / rise * W, 0.05 * d["Wf"] * delta)
        elif Wf is None:
            Wf = _fuel_of(PW, unit, delta) if PW is not None else d["Wf"] * delta
        if PW is None:
            PW = _power_of(Wf, unit, delta)
        w = [*similar_z(unit, T3=T3, T4=T3 + rise * Wf / W), N, Wf, PW]
        return self._sought(w, ca.vertsplit(self._nominal(c)))

    @staticmethod
    def _flows(unit: UnitParts, values: Mapping[str, Any], delta: Any) -> tuple[Any, Any, Any]:
        """Speed, fuel flow and shaft power of the first guess; None where not fixed."""
        N, Wf, PW = (values.get(n) for n in ("N", "Wf", "PW"))
        N = unit.p.N if N is None else N
        if LAW in values:
            PW_ref, N_ref, k = ca.vertsplit(values[LAW])
            if Wf is not None:
                share = ca.fmin(ca.fmax(_power_of(Wf, unit, delta) / PW_ref, 0.05), 2.0)
                N = N_ref * ca.fmin(ca.fmax(share ** (1 / ca.fmax(k, 0.5)), 0.5), 1.15)
            PW = PW_ref * (N / N_ref) ** k
        return N, Wf, PW

    def _sought(self, w: list[Any], nominal: list[Any]) -> Any:
        """Return s from w, as an expression."""
        ratio = [w[i] / nominal[i] for i in self.free]
        logs = [self.log[i] for i in self.free]
        return ca.vertcat(*(ca.log(q) if log else q for q, log in zip(ratio, logs, strict=True)))

    # -- functions --------------------------------------------------------------------------

    def _root(self, iterations: int) -> ca.Function:
        """Limited Newton iteration: (s0 with counter, p and a) -> s with counter.

        ``fast_newton`` serves as the loop alone.  It is given the identity for a Jacobian and the
        limited step for a residual, so that what it subtracts is the step made here.
        """
        n, m, k = len(self.free), self.n_p, self.n_p + len(AMBIENT_STATE)
        v, q = ca.SX.sym("v", n + 1), ca.SX.sym("q", k + len(NUMBERS))

        def step(e: System) -> dict[str, Any]:
            d = -solve_bordered(e.J, e.r, N_ORDERED)
            d = d * ca.fmin(1.0, MAX_STEP / ca.norm_inf(d))
            return {"F": ca.vertcat(-d, -_COUNT)}

        at = {"s": v[:n], "p": q[:m], "a": q[m:k], "c": q[k:]}
        F = self._function("trim_step", {"v": v, "q": q}, step, reciprocals=True, **at)
        x, c = F.mx_in()
        options = {
            "abstol": 0.0,
            "abstolStep": STEP_TOL,
            "max_iter": iterations,
            "error_on_fail": False,
            "jacobian_function": ca.Function("trim_loop", [x, c], [ca.DM.eye(n + 1), F(x, c)]),
        }
        return ca.rootfinder("trim_root", "fast_newton", F, options)

    def _outputs(self, s0: Any, p: Any, a: Any, c: Any, iterations: int) -> list[Any]:
        n = len(self.free)
        v = self._root(iterations)(ca.vertcat(s0, 0.0), ca.vertcat(p, a, c))
        end = self._function(
            "trim_end", self._symbols(), lambda e: {"w": ca.vertcat(*e.w), "y": e.y, "r": e.r}
        )
        return [*end(v[:n], p, a, c), v[:n], v[n] / _COUNT]

    @derived
    def cold(self) -> ca.Function:
        """Solve from the similarity guess: (p, c) -> :class:`Output`.

        p are the ambient inputs, health factors and fixed values, in this order.
        """
        p, c = ca.MX.sym("p", self.n_p), ca.MX.sym("c", len(NUMBERS))
        a, q = self._ambient(p), self._symbols()
        start = ca.Function(
            "trim_start", [q["p"], q["a"], q["c"]], [self._start(q["p"], q["a"], q["c"])]
        )
        out = self._outputs(start(p, a, c), p, a, c, MAX_ITERATIONS)
        return ca.Function(f"trim_{self.label}", [p, c], out, ["p", "c"], list(Output._fields))

    @derived
    def warm(self) -> ca.Function:
        """Solve from a given start: (s, p, c) -> :class:`Output`."""
        sizes = {"s": len(self.free), "p": self.n_p, "c": len(NUMBERS)}
        s, p, c = (ca.MX.sym(k, n) for k, n in sizes.items())
        out = self._outputs(s, p, self._ambient(p), c, WARM_ITERATIONS)
        names = list(Output._fields)
        names[names.index("s")] = "s1"
        return ca.Function(f"trim_warm_{self.label}", [s, p, c], out, [*sizes], names)

    def _at(self, name: str, outputs: Callable[[System], Mapping[str, Any]]) -> ca.Function:
        """Make a function (s, p, c) of the equations."""
        args = self._symbols()
        del args["a"]
        return self._function(name, args, outputs, a=self._ambient(args["p"]))

    @derived
    def equations(self) -> ca.Function:
        """(s, p, c) -> residuals, and their Jacobian by the scaled unknowns, which tells a fold."""
        return self._at("trim_equations", lambda e: {"r": e.r, "J": e.J})

    @derived
    def side(self) -> ca.Function:
        """(s, p, c) -> sign of the determinant of the Jacobian, which changes at a fold.

        That of the equations of the stations, each of which gives one temperature, is left out: its
        sign never changes but with the branch of the static temperature at 3, which no other
        equation contains.
        """
        return self._at(f"trim_side_{self.label}", lambda e: {"side": schur_sign(e.J, N_ORDERED)})

    @property
    def label(self) -> str:
        """The specification as an identifier."""
        return "_".join("law" if n == LAW else n for n in self.spec)

    def nominal(self, c: np.ndarray) -> np.ndarray:
        """Return the magnitudes of w = (z, N, Wf, PW) for an engine's numbers c, shape (14,)."""
        return np.asarray(self._nominal(ca.DM(c))).ravel()

    def sought(self, w: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """Return s from w, by columns, with the magnitudes of an engine."""
        s = (w.T / nominal).T
        s[self.log] = np.log(s[self.log])
        made: np.ndarray = s[self.free]
        return made

    def design_start(self, c: np.ndarray) -> np.ndarray:
        """Return s at the design point of an engine with the numbers c, shape (n,)."""
        nominal = self.nominal(c)
        w = nominal.copy()
        w[NZ - 2 : NZ] = [c[NUMBERS.index(f"{m}.beta_des")] for m in MAPS]
        return self.sought(w, nominal)


def _fuel_of(PW: Any, unit: UnitParts, delta: Any) -> Any:
    """First guess of the fuel flow for a shaft power: a line through the design point."""
    d, P_acc = unit.design.values, unit.p.P_acc
    load = ca.fmin(ca.fmax((PW + P_acc) / ((d["PW"] + P_acc) * delta), -0.3), 1.5)
    return d["Wf"] * delta * (IDLE + (1 - IDLE) * load)


def _power_of(Wf: Any, unit: UnitParts, delta: Any) -> Any:
    """First guess of the shaft power that a fuel flow gives, by the same line."""
    d, P_acc = unit.design.values, unit.p.P_acc
    full = (d["PW"] + P_acc) * delta  # shaft and accessories at design fuel
    return full * (Wf / (d["Wf"] * delta) - IDLE) / (1 - IDLE) - P_acc
