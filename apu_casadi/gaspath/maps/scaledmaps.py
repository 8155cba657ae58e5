"""Component maps: smooth surfaces from tables, scaled to a design point.

**Surface.**  The logarithms of W, PR - 1 and eta are interpolated by a tensor product of natural
cubic splines (de Boor, A Practical Guide to Splines, 2001, ch. IV) in N and beta, which passes
through every table point and is twice continuously differentiable.  Outside the table W and eta
stay above 0 and PR above 1 wherever a solver looks, and no derivative up to the second jumps at the
table's edge.  The continuation is a defined answer, not a measured one: how far outside a point
lies is the output ``off``.

*In beta* each speed line goes on as the straight line that its logarithms end with.  *In N* the
outermost speed line keeps its shape: the mean of its logarithms over the beta lines goes on
straight, and what each beta line has above or below the mean turns level within one interval of the
table.  If every beta line went on straight by itself, lines that approach each other towards high
speed would cross a little outside; pressure ratio would then fall and rise again along one speed
line, and one speed and power would have two steady points.

A natural spline with such a continuation is itself a cubic spline on the table's knots plus a few
outer knots on each side, so one B-spline holds table and continuation, without branches.  The far
knots lie ``REACH`` table spans away (at 5 % of the lowest speed below the table's speeds, since
speeds are positive); beyond them everything is held at its value there.

**Evaluation.**  The B-splines are rewritten as one bicubic polynomial per knot cell.  A lookup is
then two steps: find the cell and take its coefficients (``*_cell``, an MX function), and sum the
polynomial (``*_logs``, a plain expression that may be SX).  Models fetch the cells first and then
compute maps, thermodynamics and all derivatives in one SX function, several times faster than
B-splines within an MX graph.

**Stability margin.**  At constant corrected flow, as in GasTurb: SM = PR_surge(W)/PR - 1.  The
surge line is a natural cubic spline of ln(PR - 1) over ln W with the same continuation: a power
law.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import MapError
from apu_casadi.core.parameters import Parameters, par
from apu_casadi.core.sharing import Parametric, derived, kept
from apu_casadi.gaspath.maps.maptable import MapTable

REACH = 2.0  # table spans from the table's edge to where everything is held
LOWEST = 0.05  # held below this fraction of the table's lowest speed
TILT_WIDTH = 0.1  # of relative speed, over which the tilt of the surge line saturates
_FIXED_CELL = {"is_diff_in": [True, True, False]}  # a cell's numbers change by jumps only
N_CELL, N_SURGE_CELL = 4 + 3 * 16, 2 + 4  # numbers that describe a cell: its place, coefficients


class MapPoint(NamedTuple):
    """What a map says at a point.

    Args:
        W: corrected flow, in the unit of the design value.
        PR: pressure ratio, > 1.
        eta: isentropic efficiency.
        SM: stability margin PR_surge/PR - 1 at constant corrected flow; None for a turbine.
        off: distance outside the table in table spans, the larger of N and beta; 0 inside.
    """

    W: Any
    PR: Any
    eta: Any
    SM: Any
    off: Any


def b_splines(knots: np.ndarray, sites: np.ndarray, order: int = 0) -> np.ndarray:
    """Return the cubic B-splines on some knots, or a derivative of them, at sites.

    By CasADi's: to import SciPy's takes longer than all else that a trim needs.

    Args:
        knots: rising, with fourfold ends, (n + 4,).
        sites: shape (m,).
        order: of the derivative, two at most: CasADi 3.7 crashes at the third.

    Returns:
        Shape (m, n).
    """
    n, x = knots.size - 4, ca.MX.sym("x")
    made = ca.bspline(x, ca.DM(np.eye(n).ravel()), [knots.tolist()], [3], n)
    for _ in range(order):
        made = ca.jacobian(made, x)
    each = ca.Function("b_splines", [x], [ca.densify(made)]).map(sites.size)
    return np.asarray(each(sites[None])).T


def spline_operator(x: np.ndarray, lo: float, hi: float) -> tuple[np.ndarray, np.ndarray]:
    """Return knots and the matrix from data to B-spline coefficients of a natural cubic spline.

    Args:
        x: data sites, shape (n,), rising.
        lo, hi: ends of the straight continuation, lo < x[0] and hi > x[-1].

    Returns:
        knots, shape (n + 8,): x with lo and hi fourfold. P, shape (n + 4, n): coefficients are P @
        data.

    The n values at x and the four conditions S'' = 0 at lo, x[0], x[-1], hi fix the n + 4
    coefficients.  S'' is piecewise linear, so the outer pieces are straight.
    """
    knots = np.concatenate([[lo] * 4, x, [hi] * 4])
    n = x.size
    sites = np.array([lo, x[0], x[-1], hi])
    A = np.vstack([b_splines(knots, x), b_splines(knots, sites, 2)])
    return knots, np.linalg.solve(A, np.eye(n + 4)[:, :n])


def level_operator(
    x: np.ndarray, lo: float, hi: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return knots and the matrices to the coefficients of two continuations of a natural spline.

    Args:
        x, lo, hi: as in :func:`spline_operator`.

    Returns:
        knots, shape (n + 12,): x, two more sites on each side, and lo and hi fourfold. straight,
        level, shape (n + 8, n): coefficients are ``straight @ data`` or ``level @ data``. Both are
        the natural spline between x[0] and x[-1].  The first goes on straight; the second turns
        level within the width of the outermost interval, with continuous second derivative.

    S'' is piecewise linear.  It is 0 at x[0], x[-1] and beyond the outer of the two sites; at the
    inner one it is 0 for the straight continuation, and such that S' = 0 at the outer one for the
    level continuation.
    """
    a = min(float(x[1] - x[0]), 0.5 * (float(x[0]) - lo))
    b = min(float(x[-1] - x[-2]), 0.5 * (hi - float(x[-1])))
    inner, outer = [x[0] - a / 2, x[-1] + b / 2], [x[0] - a, x[-1] + b]
    knots = np.concatenate([[lo] * 4, [outer[0], inner[0]], x, [inner[1], outer[1]], [hi] * 4])
    n = x.size
    level = np.array([lo, outer[0], x[0], x[-1], outer[1], hi])
    common, made = [b_splines(knots, x), b_splines(knots, level, 2)], []
    for sites, order in ((inner, 2), (outer, 1)):
        A = np.vstack([*common, b_splines(knots, np.array(sites), order)])
        made.append(np.linalg.solve(A, np.eye(n + 8)[:, :n]))
    return knots, made[0], made[1]


def _ends(x: np.ndarray) -> tuple[float, float]:
    reach = REACH * float(x[-1] - x[0])
    return float(x[0]) - reach, float(x[-1]) + reach


def local_cubics(knots: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rewrite cubic B-splines as one cubic per knot interval.

    Args:
        knots, C: knots with fourfold ends, shape (n + 4,); coefficients, shape (n, ...).

    Returns:
        breaks, shape (m + 1,), and pieces, shape (4, m, ...): in interval i the spline is the sum
        of pieces[k, i] t^k with t = (x - breaks[i])/(breaks[i + 1] - breaks[i]).
    """
    breaks = knots[3:-3]
    width = np.diff(breaks).reshape(-1, *[1] * (C.ndim - 1))
    value, slope, bend = (np.tensordot(b_splines(knots, breaks, k), C, 1) for k in range(3))
    rise = np.diff(bend, axis=0)  # the second derivative is straight in between
    of_cell = [value[:-1], slope[:-1] * width, bend[:-1] * width**2 / 2, rise * width**2 / 6]
    return breaks, np.stack(of_cell)


def _held(x: Any, breaks: np.ndarray) -> Any:
    """Hold a query within the ends."""
    return ca.fmin(ca.fmax(x, float(breaks[0])), float(breaks[-1]))


def _interval(x: ca.MX, breaks: np.ndarray) -> tuple[ca.MX, ca.MX]:
    """Return the interval that x lies in, the first or last for an x outside, and its place.

    The place is the interval's start and one over its width, shape (2,).
    """
    i = ca.low(ca.DM(breaks), x)
    places = ca.DM(np.stack([breaks[:-1], 1 / np.diff(breaks)]))
    return i, ca.MX(places)[:, i]


def _cubic(c: list[Any], t: Any) -> Any:
    return c[0] + t * (c[1] + t * (c[2] + t * c[3]))


@kept
def _surface(table: MapTable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Breaks in N and beta, and coefficients of every cell, shape (48, cells).

    Rows: quantity, power in N, power in beta, the last running fastest; columns likewise by
    interval in N, interval in beta.
    """
    lo, hi = _ends(table.N)
    knots_N, straight, level = level_operator(table.N, max(lo, LOWEST * float(table.N[0])), hi)
    knots_b, P_b = spline_operator(table.beta, *_ends(table.beta))
    logs = np.log(np.stack([table.W, table.PR - 1, table.eta]))
    mean = logs.mean(axis=2, keepdims=True)
    along = np.einsum("ai,kij->akj", level, logs) + np.einsum("ai,kij->akj", straight - level, mean)
    C = np.einsum("akj,bj->abk", along, P_b)
    breaks_N, along_N = local_cubics(knots_N, C)  # (power, i, b, k)
    breaks_b, both = local_cubics(knots_b, np.moveaxis(along_N, 2, 0))  # (power, j, power, i, k)
    cells = np.einsum("ljpik->kplij", both)
    return breaks_N, breaks_b, cells.reshape(48, -1)


@kept
def surface_cell(table: MapTable) -> ca.Function:
    """Return the CasADi function (N, beta) -> cell, shape (52,): where it lies, coefficients.

    Piecewise constant: its derivative is zero, and that of :func:`surface_logs` is complete.
    """
    breaks_N, breaks_b, cells = _surface(table)
    N, beta = ca.MX.sym("N"), ca.MX.sym("beta")
    (i, at_N), (j, at_b) = _interval(N, breaks_N), _interval(beta, breaks_b)
    c = ca.MX(ca.DM(cells))[:, i * (breaks_b.size - 1) + j]
    return ca.Function("cell", [N, beta], [ca.vertcat(at_N, at_b, c)], ["N", "beta"], ["cell"])


def surface_logs(table: MapTable, N: Any, beta: Any, cell: Any) -> tuple[Any, list[Any]]:
    """Return N as held, and (ln W, ln(PR - 1), ln eta), at a point of a cell."""
    breaks_N, breaks_b, _ = _surface(table)
    held = _held(N, breaks_N)
    start_N, per_N, start_b, per_b, *c = ca.vertsplit(cell)
    t, s = (held - start_N) * per_N, (_held(beta, breaks_b) - start_b) * per_b
    rows = [_cubic(c[k : k + 4], s) for k in range(0, 48, 4)]
    return held, [_cubic(rows[k : k + 4], t) for k in range(0, 12, 4)]


@kept
def table_logs(table: MapTable) -> ca.Function:
    """(N, beta) -> N as held, and (ln W, ln(PR - 1), ln eta) stacked."""
    N, beta, cell = ca.SX.sym("N"), ca.SX.sym("beta"), ca.SX.sym("cell", N_CELL)
    held, logs = surface_logs(table, N, beta, cell)
    inner = ca.Function("logs", [N, beta, cell], [held, ca.vertcat(*logs)], _FIXED_CELL)
    q = ca.MX.sym("N"), ca.MX.sym("beta")
    out = inner(*q, surface_cell(table)(*q))
    return ca.Function("log_map", [*q], [*out], ["N", "beta"], ["N_held", "logs"])


@kept
def map_function(table: MapTable) -> ca.Function:
    """Return the unscaled surface as a CasADi function (N, beta) -> (W, PR, eta) of the table."""
    N, beta = ca.MX.sym("N"), ca.MX.sym("beta")
    _, y = table_logs(table)(N, beta)
    out = [ca.exp(y[0]), 1 + ca.exp(y[1]), ca.exp(y[2])]
    return ca.Function("map", [N, beta], out, ["N", "beta"], ["W", "PR", "eta"])


@kept
def _surge_line(table: MapTable) -> tuple[np.ndarray, np.ndarray]:
    """Breaks in ln W and coefficients of ln(PR_surge - 1), shape (4, intervals).

    Raises:
        MapError: the table is of a turbine.
    """
    if table.surge_W is None or table.surge_PR is None:
        raise MapError(f"map {table.name!r} is of a {table.kind}: it has no surge line")
    x = np.log(table.surge_W)
    knots, P = spline_operator(x, *_ends(x))
    return local_cubics(knots, P @ np.log(table.surge_PR - 1))


@kept
def surge_cell(table: MapTable) -> ca.Function:
    """Return the CasADi function W -> cell of the surge line, shape (6,); piecewise constant.

    Raises:
        MapError: the table is of a turbine.
    """
    breaks, pieces = _surge_line(table)
    W = ca.MX.sym("W")
    i, place = _interval(ca.log(W), breaks)
    return ca.Function("surge_cell", [W], [ca.vertcat(place, ca.MX(ca.DM(pieces))[:, i])])


def surge_PR(table: MapTable, W: Any, cell: Any) -> Any:
    """Return the pressure ratio of the unscaled surge line at W, which lies in this cell."""
    breaks, _ = _surge_line(table)
    start, per, *c = ca.vertsplit(cell)
    return 1 + ca.exp(_cubic(c, (_held(ca.log(W), breaks) - start) * per))


@kept
def surge_function(table: MapTable) -> ca.Function:
    """Return the unscaled surge line as a CasADi function W -> PR_surge, in the table's units.

    Raises:
        MapError: the table is of a turbine.
    """
    find = surge_cell(table)
    W, cell = ca.SX.sym("W"), ca.SX.sym("cell", N_SURGE_CELL)
    inner = ca.Function(
        "surge_PR", [W, cell], [surge_PR(table, W, cell)], {"is_diff_in": [True, False]}
    )
    q = ca.MX.sym("W")
    return ca.Function("surge", [q], [inner(q, find(q))], ["W"], ["PR_surge"])


@kept
def off_function(table: MapTable) -> ca.Function:
    """Return the CasADi function (N, beta) -> (off, off_N, off_beta), in table spans.

    off is 0 inside the table, else the larger distance outside; the other two are signed.
    """
    N, beta = ca.SX.sym("N"), ca.SX.sym("beta")
    signed = []
    for x, axis in ((N, table.N), (beta, table.beta)):
        lo, hi = float(axis[0]), float(axis[-1])
        signed.append((ca.fmax(0, x - hi) - ca.fmax(0, lo - x)) / (hi - lo))
    off = ca.fmax(ca.fabs(signed[0]), ca.fabs(signed[1]))
    return ca.Function(
        "off", [N, beta], [off, *signed], ["N", "beta"], ["off", "off_N", "off_beta"]
    )


def _bend(default: float, doc: str, lo: float, hi: float) -> Any:
    return par(default, unit="1", source="identity", doc=doc, lo=lo, hi=hi)


@dataclass(frozen=True)
class MapCalibration(Parameters):
    """Numbers that bend a scaled map to documented points; all leave the design point in place.

    With the defaults the map's shape is untouched.  n is the relative corrected speed, 1 at the
    design point.  RNI is the Reynolds number index, 1 at the design point.
    """

    a_W: float = _bend(0.0, "flow is multiplied by n**a_W", -5, 5)
    n_Re: float = _bend(0.0, "loss 1 - eta is multiplied by RNI**(-n_Re)", 0, 1)
    c_PR: float = _bend(0.0, "eta is multiplied by exp(-c_PR ln((PR - 1)/(PR_des - 1))**2)", 0, 200)
    c_N: float = _bend(0.0, "eta is multiplied by exp(-c_N (n - 1)**2)", 0, 1000)
    k_SM: float = _bend(
        1.0, "PR_surge - 1 is multiplied by k_SM (this one moves the design point's margin)", 0.2, 5
    )
    a_SM: float = _bend(0.0, "PR_surge - 1 is multiplied by 1 + a_SM tanh((n - 1)/0.1)", -0.9, 0.9)


@dataclass(frozen=True, kw_only=True)
class ScaledMap(Parametric):
    """A map scaled so that n = 1, beta = beta_des, RNI = 1 gives the design values exactly.

    Flow, PR - 1 and eta are each multiplied by a constant; the calibration then bends the map away
    from the design point.

    Args:
        table: the map's shape.
        N_map_des, beta_des: where on the table the design point lies, in the table's units.
        W_des: corrected flow at the design point, > 0; any unit, results have the same.
        PR_des: pressure ratio at the design point, > 1.
        eta_des: isentropic efficiency at the design point, in (0, 1).
        cal: calibrated numbers.

    Raises:
        MapError: design location outside the table, design value outside its range, or an
            efficiency that would reach 1 within the table after scaling.
    """

    table: MapTable
    N_map_des: float
    beta_des: float
    W_des: float
    PR_des: float
    eta_des: float
    cal: MapCalibration = field(default_factory=MapCalibration)

    def __post_init__(self) -> None:
        """Check that the map can be scaled as asked."""
        t, who = self.table, f"map {self.table.name!r}"
        for name, value, axis in (
            ("N_map_des", self.N_map_des, t.N),
            ("beta_des", self.beta_des, t.beta),
        ):
            if not axis[0] <= value <= axis[-1]:
                raise MapError(
                    f"{who}: {name} = {value:g} is outside the table, {axis[0]:g} to {axis[-1]:g}"
                )
        for name, value, lo, hi in (
            ("W_des", self.W_des, 0.0, np.inf),
            ("PR_des", self.PR_des, 1.0, np.inf),
            ("eta_des", self.eta_des, 0.0, 1.0),
        ):
            if not lo < value < hi:
                raise MapError(f"{who}: {name} = {value:g} must be between {lo:g} and {hi:g}")
        i, j = np.unravel_index(int(np.argmax(t.eta)), t.eta.shape)
        eta_map = float(map_function(t)(self.N_map_des, self.beta_des)[2])
        best = float(t.eta[i, j]) * self.eta_des / eta_map
        if best >= 1:
            raise MapError(
                f"{who}: scaled by {self.eta_des:g}/{eta_map:g} from N = {self.N_map_des:g}, beta "
                f"= {self.beta_des:g}, efficiency would be {best:.4f} at N = {t.N[i]:g}, beta = "
                f"{t.beta[j]:g}; choose a design location of higher efficiency on the map"
            )

    @derived
    def function(self) -> ca.Function:
        """(n, beta, RNI) -> W, PR, eta, for a compressor SM, and off."""
        n, beta, RNI, t = ca.MX.sym("n"), ca.MX.sym("beta"), ca.MX.sym("RNI"), self.table
        N_held, y = table_logs(t)(self.N_map_des * n, beta)
        surge = surge_function(t) if t.kind == "compressor" else None
        out = self._scaled(N_held, ca.vertsplit(y), RNI, surge)
        out["off"] = off_function(t)(self.N_map_des * n, beta)[0]
        names = ["n", "beta", "RNI"]
        return ca.Function("scaled_map", [n, beta, RNI], list(out.values()), names, list(out))

    @derived
    def design_logs(self) -> tuple[float, float, float]:
        """ln W, ln(PR - 1), ln eta of the table where the design point lies."""
        _, y = table_logs(self.table)(self.N_map_des, self.beta_des)
        W, PR, eta = np.asarray(y).ravel().tolist()
        return W, PR, eta

    @derived
    def factors(self) -> tuple[float, float, float]:
        """What scales speed, and table flow and surge line over the design's: made once."""
        return scale_factors(self)

    def _scaled(
        self, N_held: Any, y: list[Any], RNI: Any, surge: Callable[[Any], Any] | None
    ) -> dict[str, Any]:
        """Scale and bend what the table says: W, PR, eta, and SM if there is a surge line.

        ``surge`` gives the unscaled line's pressure ratio by the unscaled flow.
        """
        des, cal, (per_N, _, per_line) = self.design_logs, self.cal, self.factors
        held = N_held * per_N  # > 0, so that powers of it exist
        # powers are written as exponentials, which are cheaper when differentiated
        W = self.W_des * ca.exp(y[0] - des[0] + cal.a_W * ca.log(held))
        PR = 1 + (self.PR_des - 1) * ca.exp(y[1] - des[1])
        # ln((PR - 1)/(PR_des - 1)) is y - des itself
        droop = cal.c_PR * (y[1] - des[1]) ** 2 + cal.c_N * (held - 1) ** 2
        loss = 1 - self.eta_des * ca.exp(y[2] - des[2] - droop)
        eta = 1 - loss * ca.exp(-cal.n_Re * ca.log(RNI))
        out = {"W": W, "PR": PR, "eta": eta}
        if surge is not None:
            line = (surge(self._table_flow(W)) - 1) * per_line
            # a tilt about n = 1 that saturates: a power law fitted above the design speed would
            # move the whole surge line at part speed, about which it knows nothing
            tilt = 1 + cal.a_SM * ca.tanh((held - 1) / TILT_WIDTH)
            out["SM"] = (1 + line * cal.k_SM * tilt) / PR - 1
        return out

    def _table_flow(self, W: Any) -> Any:
        """Flow of the table that stands for a scaled flow."""
        return W * self.factors[1]

    def at(self, n: Any, beta: Any, RNI: Any, cell: Any, surge: Any = None) -> tuple[MapPoint, Any]:
        """Read the map at a point of a known cell; plain expressions, also of SX.

        Args:
            n, beta, RNI: as in :meth:`lookup`.
            cell: what :func:`surface_cell` of the table says at (N_map_des n, beta), shape (52,).
            surge: what :func:`surge_cell` says at the flow returned, shape (6,); None leaves out
                SM.

        Returns:
            The point, and the flow at which the surge line is read.
        """
        t = self.table
        N_held, y = surface_logs(t, self.N_map_des * n, beta, cell)
        line = None if surge is None else lambda W: surge_PR(t, W, surge)
        out = self._scaled(N_held, y, RNI, line)
        off = off_function(t)(self.N_map_des * n, beta)[0]
        return MapPoint(out["W"], out["PR"], out["eta"], out.get("SM"), off), self._table_flow(
            out["W"]
        )

    def lookup(self, n: Any, beta: Any, RNI: Any = 1.0) -> MapPoint:
        """Read the map.

        Args:
            n: relative corrected speed, 1 at the design point; float, array or ``casadi.MX``.
            beta: auxiliary coordinate, in the table's units; likewise.
            RNI: Reynolds number index, > 0, 1 at the design point; likewise.

        Returns:
            MapPoint of expressions if any argument is symbolic, else of floats or arrays.

        Raises:
            MapError: an argument is a ``casadi.SX``; cells are found in MX graphs only.
        """
        W, PR, eta, *SM, off = _call(self.function, n, beta, RNI)
        return MapPoint(W=W, PR=PR, eta=eta, SM=SM[0] if SM else None, off=off)


def scale_factors(m: Any) -> tuple[Any, Any, Any]:
    """Return 1/N_map_des, table flow over flow, and the factor of PR_surge - 1 of a scaled map."""
    W, PR, _ = m.design_logs
    return 1 / m.N_map_des, ca.exp(W) / m.W_des, (m.PR_des - 1) / ca.exp(PR)


def scale_map(
    table: MapTable,
    *,
    W_des: float,
    PR_des: float,
    eta_des: float,
    N_map_des: float | None = None,
    beta_des: float | None = None,
    cal: MapCalibration | None = None,
) -> ScaledMap:
    """Scale a map to a design point, by default from the source's own reference point.

    Arguments as in :class:`ScaledMap`.

    Raises:
        MapError: no design location given and none in the table, or as in :class:`ScaledMap`.
    """
    location = {"N_map_des": N_map_des, "beta_des": beta_des}
    reference = {"N_map_des": table.N_ref, "beta_des": table.beta_ref}
    given = {k: reference[k] if v is None else v for k, v in location.items()}
    missing = [k for k, v in given.items() if v is None]
    if missing:
        raise MapError(
            f"map {table.name!r} carries no reference point: give {' and '.join(missing)}, within "
            f"N {table.N[0]:g} to {table.N[-1]:g}, beta {table.beta[0]:g} to {table.beta[-1]:g}"
        )
    return ScaledMap(
        table=table,
        **given,  # type: ignore[arg-type]
        W_des=W_des,
        PR_des=PR_des,
        eta_des=eta_des,
        cal=MapCalibration() if cal is None else cal,
    )


def _call(f: ca.Function, *args: Any) -> tuple[Any, ...]:
    """Call with symbols, floats or arrays; return expressions, floats or arrays."""
    if any(isinstance(a, ca.SX) for a in args):
        raise MapError("a map's cell is found in MX graphs only: use MX, not SX, symbols")
    if any(isinstance(a, ca.MX) for a in args):
        return tuple(f.call([ca.MX(a) for a in args]))
    arrays = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in args))
    out = f.call([ca.DM(a.reshape(1, -1)) for a in arrays])
    if arrays[0].ndim == 0:
        return tuple(float(o) for o in out)
    return tuple(np.asarray(o).reshape(arrays[0].shape) for o in out)
