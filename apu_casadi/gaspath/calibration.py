"""Calibration of the component maps: a few named numbers, fitted to known steady points.

A point says what is held (two quantities, ambient, health) and what was measured, each with its
standard deviation.  The numbers are those of
:class:`~apu_casadi.gaspath.maps.scaledmaps.MapCalibration`, named ``compressor_map.n_Re`` and so
on, as in :meth:`apu_casadi.unit.apu.Apu.change`.

The fit is weighted least squares by a trust-region Gauss-Newton method with bounds
(:func:`scipy.optimize.least_squares`).  Its derivatives are exact: map flow and efficiency enter
the cycle just where the health factors do, so that

    dr/dp = sum over maps of  dr/df_W f_W dlnW/dp + dr/df_eta f_eta dln(eta)/dp

for every equation r, the two logarithmic derivatives at the point's place on the map; the implicit
function theorem then gives the measured quantities'.  Only the values need the engine to be built
anew for each trial, about a second: the numbers are constants of its equations, which keeps every
other calculation fast.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core import files
from apu_casadi.core.checked import number
from apu_casadi.core.errors import (
    ApuError,
    DataError,
    OperatingPointError,
    ParameterError,
    SignalError,
    nearest,
)
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration
from apu_casadi.gaspath.stations import reynolds_index
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator

SETS = ("compressor_map", "turbine_map")
COLUMNS = ("point", "role", "name", "value", "sigma")
ROLES = ("ambient", "health", "fixed", "measured")
SINGULAR = 1e10  # condition above which the points are said not to determine the numbers
WEAK = 1e3  # condition above which a combination is reported as weakly determined

_FIELDS = tuple(f.name for f in dataclasses.fields(MapCalibration))


@dataclass(frozen=True)
class CalibrationPoint:
    """A steady point with measured outputs.

    Args:
        fixed: two outputs held, by name, SI: ``{"N": 3775.1, "PW": 221821.5}``.
        measured: outputs (value, standard deviation > 0) by name, SI: ``{"W2": (1.6817, 3e-5)}``.
        ambient: altitude (m), Mach, dT_isa (K), war (kg/kg); of the default day where absent.
        health: factors, 1 where absent.
        name: for messages.

    Raises:
        SignalError: unknown names, not two held quantities, nothing measured, or a number that is
            not finite.
    """

    fixed: Mapping[str, float]
    measured: Mapping[str, tuple[float, float]]
    ambient: Mapping[str, float] = field(default_factory=dict)
    health: Mapping[str, float] = field(default_factory=dict)
    name: str = "point"

    def __post_init__(self) -> None:
        gg = GasGenerator
        groups: tuple[tuple[str, Iterable[str], Sequence[str]], ...] = (
            ("fixed", self.fixed, gg.Y.names),
            ("measured", self.measured, gg.Y.names),
            ("ambient", self.ambient, AMBIENT),
            ("health", self.health, gg.THETA.names),
        )
        for role, names, valid in groups:
            for n in names:
                if n not in valid:
                    raise SignalError(f"{self.name}: {role} {n!r} is unknown {nearest(n, valid)}")
        if len(self.fixed) != 2:
            raise SignalError(
                f"{self.name}: a steady point holds two quantities, got {len(self.fixed)}: "
                f"{', '.join(self.fixed) or 'none'}"
            )
        if not self.measured:
            raise SignalError(f"{self.name}: nothing is measured at this point")
        for n, pair in self.measured.items():
            if not isinstance(pair, tuple) or len(pair) != 2:
                raise SignalError(
                    f"{self.name}: measured {n} must be (value, standard deviation), got {pair!r}"
                )
            value, sigma = (number(f"{self.name}: measured {n}", v) for v in pair)
            if not (math.isfinite(value) and math.isfinite(sigma) and sigma > 0):
                raise SignalError(
                    f"{self.name}: measured {n} = {value!r} with standard deviation {sigma!r}: "
                    "finite numbers are needed, the second > 0"
                )
            if n in self.fixed:
                raise SignalError(f"{self.name}: {n} is both held and measured")
        for n, v in {**self.fixed, **self.ambient, **self.health}.items():
            if not math.isfinite(number(f"{self.name}: {n}", v)):
                raise SignalError(f"{self.name}: {n} = {v!r} must be finite")

    def trim(self, gg: GasGenerator) -> OperatingPoint:
        """Solve the point with an engine.

        Raises:
            OperatingPointError: no such point with this engine's maps; names the point.
        """
        try:
            return trim_gas_generator(gg, self.fixed, theta=self.health, **self.ambient)
        except OperatingPointError as e:
            raise OperatingPointError(f"{self.name}: {e}") from None


@dataclass(frozen=True)
class Residual:
    """What is left at one measurement: ``error`` = (model - measured)/sigma."""

    point: str
    name: str
    measured: float
    model: float
    sigma: float

    @property
    def error(self) -> float:
        """(model - measured)/sigma."""
        return (self.model - self.measured) / self.sigma


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """Fitted map numbers.

    Args:
        names: the fitted numbers, n of them.
        values: their values, by name.
        covariance: shape (n, n), from the measurements' standard deviations: (J' J)^-1 with J
            scaled by them.  It knows of those errors only, not of a map whose shape is wrong.
        residuals: one for each measurement.
        condition: condition number of J with columns of unit length; 1: each number has its own
            signature, large: some combination hardly shows in the measurements.
        weak: combinations that hardly show, in words, weakest first; empty if condition < 1000.
        at_bound: numbers that ended at the edge of their range; the covariance does not hold for
            them.
        engine: the gas generator with the fitted numbers.
        evaluations: engines built.
    """

    names: tuple[str, ...]
    values: dict[str, float]
    covariance: np.ndarray
    residuals: tuple[Residual, ...]
    condition: float
    weak: tuple[str, ...]
    at_bound: tuple[str, ...]
    engine: GasGenerator
    evaluations: int

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def chi2(self) -> float:
        """Sum of squared errors; about :attr:`freedom` where model and sigmas are right."""
        return sum(r.error**2 for r in self.residuals)

    @property
    def freedom(self) -> int:
        """Measurements less fitted numbers."""
        return len(self.residuals) - len(self.names)


def numbers() -> tuple[str, ...]:
    """Return the names of all numbers that can be fitted."""
    both = [f"{s}.{f}" for s in SETS for f in _FIELDS]
    return tuple(n for n in both if n not in ("turbine_map.k_SM", "turbine_map.a_SM"))


def _with(gg: GasGenerator, values: Mapping[str, float]) -> GasGenerator:
    """Return the engine with some map numbers changed."""
    changed: dict[str, Any] = {}
    for s in SETS:
        own = {n.partition(".")[2]: v for n, v in values.items() if n.startswith(f"{s}.")}
        choice = getattr(gg, s)
        if own:
            calibration = choice.calibration.change(**own)
            changed[s] = dataclasses.replace(choice, calibration=calibration)
    return dataclasses.replace(gg, **changed) if changed else gg


def _current(gg: GasGenerator, names: Sequence[str]) -> np.ndarray:
    parts = (n.partition(".") for n in names)
    return np.array([getattr(getattr(gg, s).calibration, f) for s, _, f in parts], float)


def sensitivity(gg: GasGenerator, point: OperatingPoint, fixed: Sequence[str]) -> np.ndarray:
    """Return the exact derivatives of all outputs by all map numbers at a trimmed point.

    Args:
        point: trimmed with this engine.
        fixed: names of the two outputs that are held.

    Returns:
        float array, shape (ny, 12): the numbers of the compressor map, then those of the turbine
        map.
    """
    J = _jacobian(gg)(point.x, point.z, point.u, point.theta).full()
    nz, ny = len(gg.z), len(gg.Y)
    # rows: alg (nz), y (ny); columns: z (nz), N, Wf, PW, theta (4)
    w, th = J[:, : nz + 3], J[:, nz + 3 :]
    own = np.zeros((nz + ny, 2 * len(_FIELDS)))  # at unchanged z, N, Wf, PW
    v, H = point.values, gg.THETA.unpack(point.theta)
    d, z = gg.design.values, gg.z.unpack(point.z)
    RNI_c = reynolds_index(P=v["P2"], T=v["T2"], P_ref=d["P2"], T_ref=d["T2"])
    P4_guess = v["P2"] * v["PR_c"] * (1 - gg.parameters.dp_burner)
    RNI_t = reynolds_index(P=P4_guess, T=v["T41"], P_ref=d["P4"], T_ref=d["T41"])
    places = ((v["n_c"], z["beta_c"], float(RNI_c)), (v["n_t"], z["beta_t"], float(RNI_t)))
    for k, (s, m, place, tag) in enumerate(zip(SETS, gg.maps, places, "ct", strict=True)):
        cal = np.array([getattr(m.cal, f) for f in _FIELDS])
        value, jac = (o.full() for o in _map_jacobian(m.calibrated)(*place, cal))
        eta = value[1, 0] * H[f"f_eta_{tag}"]
        if abs(eta / v[f"eta_{tag}"] - 1) > 1e-9:
            raise AssertionError(f"{s} read at another place than the cycle reads it: eta {eta}")
        block = slice(k * len(_FIELDS), (k + 1) * len(_FIELDS))
        for row, factor in enumerate((f"f_W_{tag}", f"f_eta_{tag}")):
            by_log = th[:, gg.THETA.index(factor)] * H[factor]
            own[:, block] += np.outer(by_log, jac[row] / value[row, 0])
        if tag == "c":
            own[nz + gg.Y.index("SM"), block] = jac[2]
    held = [nz + gg.Y.index(n) for n in ("P_acceleration", *fixed)]
    rows = [*range(nz), *held]
    dw = -np.linalg.solve(w[rows], own[rows])
    return np.asarray(own[nz:] + w[nz:] @ dw)


def _jacobian(gg: GasGenerator) -> ca.Function:
    """(x, z, u, theta) -> d(alg, y)/d(z, N, Wf, PW, theta)."""
    x, z = ca.MX.sym("x", len(gg.X)), ca.MX.sym("z", len(gg.z))
    flows, around = ca.MX.sym("flows", 2), ca.MX.sym("around", len(gg.U) - 2)
    u, theta = ca.vertcat(flows, around), ca.MX.sym("theta", len(gg.THETA))
    _, alg, y = gg.equations(x, z, u, theta)
    J = ca.densify(ca.jacobian(ca.vertcat(alg, y), ca.vertcat(z, x, flows, theta)))
    inner = ca.Function("J", [x, z, flows, around, theta], [J])
    us = ca.MX.sym("u", len(gg.U))
    return ca.Function("J", [x, z, us, theta], [inner(x, z, us[:2], us[2:], theta)])


def _map_jacobian(calibrated: ca.Function) -> ca.Function:
    """(n, beta, RNI, cal) -> W, eta and SM, and their derivatives by cal."""
    args = [ca.MX.sym("a", calibrated.size1_in(i)) for i in range(4)]
    out = dict(zip(calibrated.name_out(), calibrated.call(args), strict=True))
    rows = ca.vertcat(*(out[n] for n in ("W", "eta", "SM") if n in out))
    return ca.Function("map_jacobian", args, [rows, ca.densify(ca.jacobian(rows, args[3]))])


def calibrate(
    gg: GasGenerator,
    points: Sequence[CalibrationPoint],
    free: Sequence[str],
    *,
    max_evaluations: int = 40,
) -> CalibrationResult:
    """Fit map numbers to points, starting from the engine's own.

    Args:
        gg: engine with the map shapes; numbers that are not free keep its values.
        points: steady points with measurements.
        free: numbers to fit, such as ``"compressor_map.n_Re"``; see :func:`numbers`.
        max_evaluations: engines built at most.

    Raises:
        ParameterError: unknown or doubled numbers, fewer measurements than numbers, or points that
            do not determine the numbers; names the combination that does not show.
        OperatingPointError: a point cannot be solved at the start, or the fit did not converge.
    """
    from scipy.optimize import least_squares

    points, names = tuple(points), tuple(free)
    _check_free(names, points)
    targets = [(p, n, *p.measured[n]) for p in points for n in p.measured]
    sigma = np.array([t[3] for t in targets])
    measured = np.array([t[2] for t in targets])
    index = [SETS.index(n.partition(".")[0]) * len(_FIELDS) + _FIELDS.index(n.partition(".")[2])
             for n in names]  # fmt: skip
    fields = {f.name: f.metadata for f in dataclasses.fields(MapCalibration)}
    lower, upper = (
        np.array([fields[n.partition(".")[2]][side] for n in names]) for side in ("lo", "hi")
    )
    built: dict[bytes, tuple[GasGenerator, list[OperatingPoint]]] = {}

    def solved(p: np.ndarray) -> tuple[GasGenerator, list[OperatingPoint]]:
        key = p.tobytes()
        if key not in built:
            engine = _with(gg, dict(zip(names, p.tolist(), strict=True)))
            built[key] = engine, [point.trim(engine) for point in points]
        return built[key]

    def model(p: np.ndarray) -> np.ndarray:
        _, trims = solved(p)
        return np.array(
            [t[n] for t, point in zip(trims, points, strict=True) for n in point.measured]
        )

    def errors(p: np.ndarray) -> np.ndarray:
        try:
            return (model(p) - measured) / sigma
        except ApuError:
            if len(built) == 0:  # at the start there is nowhere to go back to
                raise
            return np.full(sigma.shape, np.inf)  # makes the trust region shrink

    def jacobian(p: np.ndarray) -> np.ndarray:
        engine, trims = solved(p)
        rows = []
        for t, point in zip(trims, points, strict=True):
            S = sensitivity(engine, t, tuple(point.fixed))[:, index]
            rows += [S[engine.Y.index(n)] for n in point.measured]
        return np.array(rows) / sigma[:, None]

    # off the edge by a hundredth: some numbers are at their identity, and at their limit, when 0
    start = np.clip(_current(gg, names), lower + 0.01, upper - 0.01)
    fit = least_squares(
        errors, start, jacobian, bounds=(lower, upper), xtol=1e-13, ftol=1e-13, gtol=1e-13,
        max_nfev=max_evaluations,
    )  # fmt: skip
    if fit.status <= 0:
        raise OperatingPointError(
            f"calibration did not converge in {len(built)} evaluations: sum of squared errors "
            f"{2 * fit.cost:.4g} at " + _listing(names, fit.x)
        )
    J = np.asarray(fit.jac)
    covariance, condition, weak = _determined(J, names)
    edge = 1e-9 * (upper - lower)
    at_bound = tuple(
        n for n, v, lo, hi, e in zip(names, fit.x, lower, upper, edge, strict=True)
        if v - lo <= e or hi - v <= e
    )  # fmt: skip
    engine, _ = solved(fit.x)
    residuals = tuple(
        Residual(p.name, n, value, float(m), s)
        for (p, n, value, s), m in zip(targets, model(fit.x), strict=True)
    )
    values = dict(zip(names, fit.x.tolist(), strict=True))
    return CalibrationResult(
        names, values, covariance, residuals, condition, weak, at_bound, engine, len(built)
    )


def _check_free(names: tuple[str, ...], points: tuple[CalibrationPoint, ...]) -> None:
    valid = numbers()
    for n in names:
        if n not in valid:
            raise ParameterError(f"no map number {n!r} {nearest(n, valid)}")
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice or not names:
        raise ParameterError(f"numbers to fit: {'twice ' + ', '.join(twice) if twice else 'none'}")
    count = sum(len(p.measured) for p in points)
    if count < len(names):
        raise ParameterError(
            f"{count} measurements cannot determine {len(names)} numbers: {', '.join(names)}"
        )


def _listing(names: Sequence[str], values: Sequence[float] | np.ndarray) -> str:
    return ", ".join(f"{n} = {v:.6g}" for n, v in zip(names, values, strict=True))


def _determined(J: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, float, tuple[str, ...]]:
    """Return covariance, condition and weak combinations; refuse what cannot be determined."""
    length = np.linalg.norm(J, axis=0)
    none = [n for n, l in zip(names, length, strict=True) if not l > 0]
    if none:
        raise ParameterError(f"no measurement depends on {', '.join(none)}: do not fit it")
    _, s, Vt = np.linalg.svd(J / length, full_matrices=False)

    def words(v: np.ndarray) -> str:
        v = v * np.sign(v[np.argmax(np.abs(v))])
        order = [i for i in np.argsort(-np.abs(v)) if abs(v[i]) >= 0.1]
        return " ".join(f"{v[i]:+.2f} {names[i]}" for i in order)

    condition = float(s[0] / s[-1]) if s[-1] > 0 else math.inf
    if not condition < SINGULAR:
        raise ParameterError(
            f"the points do not determine the numbers: condition {condition:.1e}, and "
            f"{words(Vt[-1])} (each in units of its own effect) shows in no measurement; fit fewer "
            "numbers, or add a point at another speed, pressure ratio or altitude"
        )
    weak = tuple(words(Vt[k]) for k in range(len(s) - 1, -1, -1) if s[0] > WEAK * s[k])
    root = (Vt.T / s) / length[:, None]
    return root @ root.T, condition, weak


def read_points(path: str | Path) -> list[CalibrationPoint]:
    """Read points from a CSV file with one quantity on each line.

    Columns ``point, role, name, value, sigma``; lines that begin with ``#`` are comments.  ``role``
    is ambient, health, fixed (two for each point) or measured; ``sigma``, the standard deviation,
    is for measured ones only.  SI units, names as in :attr:`GasGenerator.Y`::

        point,role,name,value,sigma
        cruise,ambient,altitude,8000,
        cruise,fixed,N,3775.1,
        cruise,fixed,PW,221821.5,
        cruise,measured,W2,1.6817,1.7e-4

    Raises:
        DataError: no such file, a wrong header, or a line that cannot be read; says which.
        SignalError: a point with unknown names, or not two held quantities.
    """
    path = Path(path)
    text = files.read_text(path)
    lines = [(k, x) for k, x in enumerate(text.split("\n"), 1) if x.strip() and x[0] != "#"]
    rows = []
    for k, x in lines:
        try:
            rows += list(csv.reader([x], strict=True))
        except csv.Error as e:  # a quotation mark left open, a cell beyond csv's limit
            raise DataError(f"{path}, line {k}: no line of a CSV file ({e})") from None
    if not rows or tuple(c.strip() for c in rows[0]) != COLUMNS:
        raise DataError(f"{path}: the first line must be {','.join(COLUMNS)}")
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for (k, _), row in zip(lines[1:], rows[1:], strict=True):
        cells = [c.strip() for c in row] + [""] * (len(COLUMNS) - len(row))
        if len(cells) > len(COLUMNS):
            raise DataError(f"{path}, line {k}: {len(cells)} columns, {len(COLUMNS)} expected")
        point, role, name, value, sigma = cells
        if role not in ROLES:
            raise DataError(f"{path}, line {k}: role {role!r} {nearest(role, ROLES)}")
        where = f"{path}, line {k}: {name}"
        if (role == "measured") != bool(sigma):
            raise DataError(f"{where}: a standard deviation goes with measured quantities, only")
        group = found.setdefault(point, {r: {} for r in ROLES})[role]
        if name in group:
            raise DataError(f"{where}: given twice for point {point!r}")
        v = _number(value, where)
        group[name] = (v, _number(sigma, where)) if role == "measured" else v
    if not found:
        raise DataError(f"{path}: no points below the header")
    try:
        return [CalibrationPoint(**groups, name=point) for point, groups in found.items()]
    except SignalError as e:
        raise SignalError(f"{path}: {e}") from None


def write_points(points: Iterable[CalibrationPoint], path: str | Path) -> None:
    """Write points as :func:`read_points` reads them.

    Raises:
        DataError: the file cannot be written.
    """
    rows: list[tuple[Any, ...]] = [COLUMNS]
    for p in points:
        for role in ("ambient", "health", "fixed"):
            rows += [(p.name, role, n, repr(float(v)), "") for n, v in getattr(p, role).items()]
        rows += [(p.name, "measured", n, repr(float(v)), repr(float(s)))
                 for n, (v, s) in p.measured.items()]  # fmt: skip
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    files.write_text(path, text.getvalue())


def _number(text: str, where: str) -> float:
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"{where}: {text[:40]!r} is not a number")
    return value
