"""Calibration of the component maps: a few named numbers, fitted to known steady points.

A point says what is held (two quantities, ambient, health) and what was measured, each with its
standard deviation.  The numbers are those of
:class:`~apu_casadi.gaspath.maps.scaledmaps.MapCalibration`, named ``compressor_map.n_Re`` and so
on, as in :meth:`apu_casadi.unit.apu.Apu.change`.

The fit is weighted least squares by a trust-region Gauss-Newton method with bounds
(:func:`scipy.optimize.least_squares`).  Its derivatives are exact, those of the cycle by its
parameters (:attr:`~apu_casadi.gaspath.gasgenerator.GasGenerator.by_parameters`).
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
from apu_casadi.core.tables.numbertable import read_numbers
from apu_casadi.core.tables.tablelayout import TableLayout
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.gaspath.unitnumbers import GIVEN, MAPS

SETS = MAPS
COLUMNS = ("point", "role", "name", "value", "sigma")
ROLES = ("ambient", "health", "fixed", "measured")
SINGULAR = 1e10  # condition above which the points are said not to determine the numbers
WEAK = 1e3  # condition above which a combination is reported as weakly determined

_FIELDS = tuple(f.name for f in dataclasses.fields(MapCalibration))
_ALL = tuple(f"{s}.{f}" for s in SETS for f in _FIELDS)


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
        evaluations: engines tried.
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
    return tuple(n for n in _ALL if n not in ("turbine_map.k_SM", "turbine_map.a_SM"))


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
    given = gg.numbers[: len(GIVEN)]
    w = np.concatenate([point.theta, given])
    _, _, xdot_w, y_w, _ = (
        np.asarray(a.full()) for a in gg.by_parameters.sensitivities(point.x, point.z, point.u, w)
    )
    names = (*gg.X.names, *gg.U.names, *gg.by_parameters.theta.names)
    own = [names.index(n) for n in _ALL]
    open_ = [names.index(n) for n in ("N", "Wf", "PW")]  # what may move: the point stays steady
    held = np.vstack([xdot_w, y_w[gg.Y.indices(tuple(fixed))]])
    moved = -np.linalg.solve(held[:, open_], held[:, own])
    return np.asarray(y_w[:, own] + y_w[:, open_] @ moved)


def calibrate(
    gg: GasGenerator,
    points: Sequence[CalibrationPoint],
    free: Sequence[str],
) -> CalibrationResult:
    """Fit map numbers to points, starting from the engine's own.

    Args:
        gg: engine with the map shapes; numbers that are not free keep its values.
        points: steady points with measurements.
        free: numbers to fit, such as ``"compressor_map.n_Re"``; see :func:`numbers`.

    Raises:
        ParameterError: unknown or doubled numbers, fewer measurements than numbers, or points that
            do not determine the numbers; names the combination that does not show.
        OperatingPointError: a point cannot be solved at the start, or the fit did not converge.
    """
    from scipy.optimize import least_squares

    points, names = tuple(points), tuple(free)
    _check_free(names, points)
    trial = _Trials(gg, points, names)
    fields = {f.name: f.metadata for f in dataclasses.fields(MapCalibration)}
    lower, upper = (
        np.array([fields[n.partition(".")[2]][side] for n in names], float) for side in ("lo", "hi")
    )
    # off the edge by a hundredth: some numbers are at their identity, and at their limit, when 0
    start = np.clip(_current(gg, names), lower + 0.01, upper - 0.01)
    stop = {**dict.fromkeys(("xtol", "ftol", "gtol"), 1e-13), "max_nfev": 40}
    fit = least_squares(trial.errors, start, trial.jacobian, bounds=(lower, upper), **stop)
    if fit.status <= 0:
        raise OperatingPointError(
            f"calibration did not converge in {len(trial.built)} evaluations: sum of squared "
            f"errors {2 * fit.cost:.4g} at " + _listing(names, fit.x)
        )
    covariance, condition, weak = _determined(np.asarray(fit.jac), names)
    edge = 1e-9 * (upper - lower)
    bound = (fit.x - lower <= edge) | (upper - fit.x <= edge)
    at_bound = tuple(n for n, b in zip(names, bound, strict=True) if b)
    engine, _ = trial.solved(fit.x)
    residuals = tuple(
        Residual(p.name, n, value, float(m), s)
        for (p, n, value, s), m in zip(trial.targets, trial.model(fit.x), strict=True)
    )
    values = dict(zip(names, fit.x.tolist(), strict=True))
    told = covariance, residuals, condition, weak, at_bound, engine, len(trial.built)
    return CalibrationResult(names, values, *told)


class _Trials:
    """The engines that a fit tries, and their errors at the points."""

    def __init__(
        self, gg: GasGenerator, points: tuple[CalibrationPoint, ...], names: tuple[str, ...]
    ) -> None:
        self.gg, self.points, self.names = gg, points, names
        self.targets = [(p, n, *p.measured[n]) for p in points for n in p.measured]
        self.sigma = np.array([t[3] for t in self.targets])
        self.measured = np.array([t[2] for t in self.targets])
        self.columns = [_ALL.index(n) for n in names]
        self.built: dict[bytes, tuple[GasGenerator, list[OperatingPoint]]] = {}

    def solved(self, p: np.ndarray) -> tuple[GasGenerator, list[OperatingPoint]]:
        """Return the engine with the numbers p, trimmed at the points."""
        key = p.tobytes()
        if key not in self.built:
            engine = _with(self.gg, dict(zip(self.names, p.tolist(), strict=True)))
            self.built[key] = engine, [point.trim(engine) for point in self.points]
        return self.built[key]

    def model(self, p: np.ndarray) -> np.ndarray:
        """Return what the engine says for each measurement."""
        _, trims = self.solved(p)
        pairs = zip(trims, self.points, strict=True)
        return np.array([t[n] for t, point in pairs for n in point.measured])

    def errors(self, p: np.ndarray) -> np.ndarray:
        """Return (model - measured)/sigma."""
        try:
            made: np.ndarray = (self.model(p) - self.measured) / self.sigma
            return made
        except ApuError:
            if len(self.built) == 0:  # at the start there is nowhere to go back to
                raise
            return np.full(self.sigma.shape, np.inf)  # makes the trust region shrink

    def jacobian(self, p: np.ndarray) -> np.ndarray:
        """Return the derivatives of the errors by p."""
        engine, trims = self.solved(p)
        rows = []
        for t, point in zip(trims, self.points, strict=True):
            S = sensitivity(engine, t, tuple(point.fixed))[:, self.columns]
            rows += [S[engine.Y.index(n)] for n in point.measured]
        made: np.ndarray = np.array(rows) / self.sigma[:, None]
        return made


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


class _Layout(TableLayout):
    """A row of an ambient or fixed quantity may end before its sigma."""

    pads_rows = True


def read_points(path: str | Path) -> list[CalibrationPoint]:
    """Read points from a file with one quantity on each line.

    Columns ``point, role, name, value, sigma``; lines that begin with ``#`` are comments.  What
    spreadsheets write is read (:mod:`apu_casadi.core.tables.numbertable`).  ``role``
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
    table = read_numbers(path, COLUMNS.__contains__, layout=_Layout())
    if not set(COLUMNS) <= set(table.names):
        raise DataError(f"{path}: the first line must be {','.join(COLUMNS)}")
    found: dict[str, dict[str, dict[str, Any]]] = {}
    values, sigmas = (table.numbers(n, gaps=True, ordered=False) for n in ("value", "sigma"))
    words = zip(*(table.texts(n) for n in COLUMNS[:3]), strict=True)
    for k, (point, role, name) in enumerate(words):
        if role not in ROLES:
            raise DataError(f"{table.place(k)}: role {role!r} {nearest(role, ROLES)}")
        where, value, sigma = f"{table.place(k)}: {name}", float(values[k]), float(sigmas[k])
        if (role == "measured") == math.isnan(sigma):
            raise DataError(f"{where}: a standard deviation goes with measured quantities, only")
        if math.isnan(value):
            raise DataError(f"{where}: no number stands there: complete the row, or delete it")
        group = found.setdefault(point, {r: {} for r in ROLES})[role]
        if name in group:
            raise DataError(f"{where}: given twice for point {point!r}")
        group[name] = (value, sigma) if role == "measured" else value
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
        for n, pair in p.measured.items():
            rows.append((p.name, "measured", n, *(repr(float(v)) for v in pair)))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    files.write_text(path, text.getvalue())
