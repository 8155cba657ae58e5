"""A component map as a table: axes, flow, pressure ratio, efficiency, surge line, all checked.

The files of such tables are read and written by :mod:`apu_casadi.gaspath.maps.mapfiles`.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from apu_casadi.core.checked import array
from apu_casadi.core.errors import MapError
from apu_casadi.core.sharing import Parametric
from apu_casadi.gaspath.maps.mapcheck import Finding, implausible

KINDS = ("compressor", "turbine")
GRID_COLUMNS = ("N", "beta", "W", "PR", "eta")
SURGE_COLUMNS = ("W_surge", "PR_surge")
MIN_LINES = 4  # a natural cubic spline of fewer points says little about a map


@dataclass(frozen=True, eq=False, kw_only=True)
class MapTable(Parametric):
    """The table of a component map, checked on construction.  Tables compare by their content.

    Args:
        kind: ``"compressor"`` or ``"turbine"``.
        N: relative corrected speeds, shape (n,), n >= 4, > 0, rising; any unit.
        beta: auxiliary coordinate, shape (m,), m >= 4, rising; any unit.
        W: corrected flow, shape (n, m), > 0; any unit.
        PR: pressure ratio, shape (n, m), > 1.
        eta: isentropic efficiency, shape (n, m), in (0, 1].
        surge_W, surge_PR: surge line, shape (k,) with k >= 4 and W rising; None for a turbine.
        N_ref, beta_ref: the design point that the source gives, if it gives one.
        name, source: text for messages and file headers.
        check: whether the numbers must be plausible beside their neighbours (see
            :mod:`apu_casadi.gaspath.maps.mapcheck`); False accepts a strange map knowingly.

    Raises:
        MapError: a shape, an order or a value is wrong or implausible; the message says where.
    """

    kind: str
    N: np.ndarray
    beta: np.ndarray
    W: np.ndarray
    PR: np.ndarray
    eta: np.ndarray
    surge_W: np.ndarray | None = None
    surge_PR: np.ndarray | None = None
    N_ref: float | None = None
    beta_ref: float | None = None
    name: str = "map"
    source: str = ""
    check: bool = True

    def __post_init__(self) -> None:
        """Copy the arrays, make them read-only, and check them."""
        for name in (*GRID_COLUMNS, "surge_W", "surge_PR"):
            value = getattr(self, name)
            if value is not None:
                try:
                    a = array(f"map {self.name!r}: {name}", value, error=MapError)
                except MapError as e:
                    raise MapError(
                        f"map {self.name!r}: {name} is not a table of numbers; {e}"
                    ) from None
                a.setflags(write=False)
                object.__setattr__(self, name, a)
        self._check()
        for found in self.implausible()[:1] if self.check else ():
            at = self.place(found)
            raise MapError(f"map {self.name!r}, {at}: {found_text(self, found)}")

    def _content(self) -> tuple[object, ...]:
        values = (getattr(self, f.name) for f in fields(self))
        return tuple((v.shape, v.tobytes()) if isinstance(v, np.ndarray) else v for v in values)

    def __eq__(self, other: object) -> bool:
        """Whether all fields are the same, bit for bit."""
        if self is other or not isinstance(other, MapTable):
            return self is other
        return hash(self) == hash(other) and self._content() == other._content()

    def __hash__(self) -> int:
        known: int | None = self.__dict__.get("_hash")
        if known is None:
            known = self.__dict__["_hash"] = hash(self._content())
        return known

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take up the fields, arrays read-only again."""
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        self.__dict__.update(state)

    def found_plausible(self) -> MapTable:
        """Return the same with ``check``, where it is known that nothing is implausible."""
        made = copy.copy(self)
        made.__dict__.update(check=True)
        made.__dict__.pop("_hash", None)
        return made

    def implausible(self) -> list[Finding]:
        """Return the numbers that do not go with their neighbours, the worst first."""
        surge = None
        if self.surge_W is not None and self.surge_PR is not None:
            surge = self.surge_W, self.surge_PR
        return implausible(self.kind, self.N, self.beta, self.W, self.PR, self.eta, surge)

    def place(self, f: Finding) -> str:
        """Tell where in the table a finding is."""
        if f.name == "PR_surge":
            assert self.surge_W is not None
            return f"surge point {f.i + 1} at W = {self.surge_W[f.i]:g}, PR_surge"
        if f.j < 0:
            return f"speed line N = {self.N[f.i]:g}, mean {f.name}"
        if f.i < 0:
            return f"beta line beta = {self.beta[f.j]:g}, mean {f.name}"
        return f"N = {self.N[f.i]:g}, beta = {self.beta[f.j]:g}, {f.name}"

    def _check(self) -> None:
        who = f"map {self.name!r}"
        if self.kind not in KINDS:
            raise MapError(f"{who}: kind must be one of {', '.join(KINDS)}, got {self.kind!r}")
        for name, what in (("N", "speed"), ("beta", "beta")):
            _check_axis(f"{who}: {name}", getattr(self, name), f"{what} lines")
        if self.N[0] <= 0:
            raise MapError(f"{who}: speeds must be > 0, the lowest is {self.N[0]:g}")
        shape = (self.N.size, self.beta.size)
        for name in ("W", "PR", "eta"):
            a = getattr(self, name)
            if a.shape != shape:
                raise MapError(f"{who}: {name} has shape {a.shape}, N and beta ask for {shape}")
            for i, j in np.ndindex(shape):
                if wrong := fault(name, a[i, j]):
                    at = f"N = {self.N[i]:g}, beta = {self.beta[j]:g}"
                    raise MapError(f"{who}: {name} = {a[i, j]:g} at {at}; {wrong}")
        if self.kind == "turbine":
            if self.surge_W is not None or self.surge_PR is not None:
                raise MapError(f"{who}: a turbine has no surge line; leave it out")
        elif self.surge_W is None or self.surge_PR is None:
            raise MapError(f"{who}: a compressor needs a surge line (surge_W and surge_PR)")
        else:
            _check_axis(f"{who}: surge_W", self.surge_W, "surge points")
            if self.surge_PR.shape != self.surge_W.shape:
                raise MapError(
                    f"{who}: {self.surge_W.size} surge flows, {self.surge_PR.size} pressure ratios"
                )
            for k, (W, PR) in enumerate(zip(self.surge_W, self.surge_PR, strict=True), 1):
                for name, value in (("W", W), ("PR", PR)):
                    if wrong := fault(name, value):
                        raise MapError(f"{who}: surge {name} = {value:g} at point {k}; {wrong}")
        for name, axis in (("N_ref", self.N), ("beta_ref", self.beta)):
            ref = getattr(self, name)
            if ref is not None and not axis[0] <= ref <= axis[-1]:
                raise MapError(
                    f"{who}: {name} = {ref:g} is outside the table, {axis[0]:g} to {axis[-1]:g}"
                )


def found_text(table: MapTable, f: Finding) -> str:
    """Say what is implausible, what was expected, and what to do."""
    rest = len(table.implausible()) - 1
    more = f" ({rest} more)" if rest else ""
    what = "correct the lines or their order" if min(f.i, f.j) < 0 else "correct the cell"
    return (
        f"{f.value:.5g} is implausible: its neighbours say about {f.expected:.5g}, off by "
        f"{f.excess:.2g} times the tolerance{more}; {what}, or accept the map knowingly "
        f"with check=False"
    )


def fault(column: str, value: float) -> str | None:
    """Say what is wrong with one map value and what to do, or None."""
    if not math.isfinite(value):
        return "it must be a finite number: fill the cell or remove the whole line"
    if column == "N" and value <= 0:
        return "speeds must be > 0: remove that speed line"
    if column in ("W", "W_surge") and value <= 0:
        return "flow must be > 0: correct the value or remove the line"
    if column in ("PR", "PR_surge") and value <= 1:
        return (
            "pressure ratio must be > 1: remove the beta or speed lines that reach it "
            "(read_map with trim=True does so for the text layouts)"
        )
    if column == "eta" and not 0 < value <= 1:
        return "efficiency must be in (0, 1], as a fraction, not per cent"
    return None


def _check_axis(where: str, axis: np.ndarray, what: str) -> None:
    if axis.ndim != 1 or axis.size < MIN_LINES:
        raise MapError(f"{where}: at least {MIN_LINES} {what} needed, got {axis.size}")
    if not np.all(np.isfinite(axis)):
        raise MapError(f"{where}: value {int(np.argmin(np.isfinite(axis))) + 1} is not finite")
    if np.any(np.diff(axis) <= 0):
        k = int(np.argmax(np.diff(axis) <= 0))
        raise MapError(
            f"{where} must rise, but {axis[k + 1]:g} follows {axis[k]:g}: sort the lines"
        )
