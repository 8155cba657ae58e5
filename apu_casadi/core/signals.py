"""Named vectors: the order of a model's states, inputs and outputs is declared once, here.

CasADi sets absent named inputs to zero and spreads scalars over vectors, both silently.  So every
vector in this package is made and read by name, through :class:`Signals`, which refuses unknown
and missing names, wrong shapes and values that are not finite.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass
from functools import cached_property
from typing import Any, overload

import casadi as ca
import numpy as np

from apu_casadi.core.checked import array
from apu_casadi.core.errors import SignalError, nearest


@dataclass(frozen=True)
class Signal:
    """One scalar of a model.

    Args:
        name: the field's standard symbol (``T3``, ``lam_sq``); a valid Python identifier, or
            several joined by dots (``machine.r_s``).
        unit: SI unit as text (``"K"``, ``"rad/s"``); ``"1"`` for fractions.
        doc: one line of meaning, with the station or the equation it belongs to.
        default: value that :meth:`Signals.pack` takes when the name is absent; None means required.
        nominal: typical magnitude (> 0), used to scale unknowns and residuals.
    """

    name: str
    unit: str
    doc: str
    default: float | None = None
    nominal: float = 1.0

    def __post_init__(self) -> None:
        """Refuse names that cannot be attributes and magnitudes that cannot scale."""
        if not all(part.isidentifier() for part in self.name.split(".")):
            raise SignalError(f"signal name {self.name!r} is not an identifier")
        if not (math.isfinite(self.nominal) and self.nominal > 0):
            raise SignalError(f"signal {self.name}: nominal must be > 0, got {self.nominal!r}")


class Signals(Sized):
    """An ordered set of :class:`Signal`, with packing and unpacking by name."""

    def __init__(self, signals: Iterable[Signal] = ()) -> None:
        """Keep the signals; a name given twice is a :class:`SignalError`."""
        self._signals = tuple(signals)
        names = [s.name for s in self._signals]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise SignalError(f"signals declared twice: {', '.join(twice)}")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names in order."""
        return tuple(s.name for s in self._signals)

    @cached_property
    def _index(self) -> dict[str, int]:
        return {n: i for i, n in enumerate(self.names)}

    def __len__(self) -> int:
        return len(self._signals)

    def __iter__(self) -> Iterator[Signal]:
        return iter(self._signals)

    @overload
    def __getitem__(self, key: str | int) -> Signal: ...
    @overload
    def __getitem__(self, key: slice) -> tuple[Signal, ...]: ...
    def __getitem__(self, key: str | int | slice) -> Signal | tuple[Signal, ...]:
        """Return the signal of that name or position."""
        if isinstance(key, str):
            return self._signals[self.index(key)]
        return self._signals[key]

    def __contains__(self, name: object) -> bool:
        """Tell whether a signal of that name is declared."""
        return name in self._index

    def __add__(self, other: Signals) -> Signals:
        return Signals((*self._signals, *other))

    def __eq__(self, other: object) -> bool:
        """Two sets are equal when they hold equal signals in the same order."""
        return isinstance(other, Signals) and self._signals == other._signals

    def __hash__(self) -> int:
        return hash(self._signals)

    def __repr__(self) -> str:
        return f"Signals({', '.join(f'{s.name} [{s.unit}]' for s in self._signals)})"

    def index(self, name: str, *_: Any) -> int:
        """Return the position of ``name``; raise :class:`SignalError` with the nearest name."""
        try:
            return self._index[name]
        except KeyError:
            raise SignalError(f"unknown signal {name!r} {nearest(name, self.names)}") from None

    def indices(self, names: Sequence[str]) -> list[int]:
        """Return the positions of several names."""
        return [self.index(n) for n in names]

    @cached_property
    def nominals(self) -> np.ndarray:
        """Typical magnitudes, shape (n,)."""
        return np.array([s.nominal for s in self._signals])

    def pack(self, values: Mapping[str, Any] | None = None, **more: Any) -> np.ndarray:
        """Make a vector from values by name.

        Values are scalars, or 1-D arrays of one common length m; scalars are then repeated.

        Returns:
            float array of shape (n,), or (n, m) if any value is an array of length m.

        Raises:
            SignalError: unknown, missing or doubled names, unequal lengths, values not finite.
        """
        given: dict[str, Any] = dict(values or {})
        for name, value in more.items():
            if name in given:
                raise SignalError(f"signal {name!r} given twice")
            given[name] = value
        wrong = [f"unknown {n} {nearest(n, self.names)}" for n in given if n not in self._index]
        missing = [s.name for s in self._signals if s.name not in given and s.default is None]
        if missing:
            wrong.insert(0, f"missing {', '.join(missing)}")
        if wrong:
            raise SignalError("; ".join(wrong))
        columns = []
        for s in self._signals:
            value = given.get(s.name, s.default)
            a = array(f"{s.name} [{s.unit}]", value, what="a number or a 1-D array")
            if a.ndim > 1:
                raise SignalError(f"{s.name}: scalar or 1-D array expected, got shape {a.shape}")
            if not np.all(np.isfinite(a)):
                bad = int(np.size(a) - np.isfinite(a).sum())
                raise SignalError(f"{s.name} [{s.unit}]: {bad} of {a.size} values not finite")
            columns.append(a)
        lengths = {c.shape[0] for c in columns if c.ndim == 1}
        if len(lengths) > 1:
            raise SignalError(f"arrays of unequal length: {sorted(lengths)}")
        if lengths:
            m = lengths.pop()
            return np.array([np.broadcast_to(c, (m,)) for c in columns])
        return np.array([float(c) for c in columns])

    def unpack(self, vector: Any) -> dict[str, Any]:
        """Return ``{name: value}`` from a vector (n,), rows of a matrix (n, m), or a symbol.

        Raises:
            SignalError: the first dimension is not n.
        """
        if isinstance(vector, ca.SX | ca.MX | ca.DM):
            if vector.shape[0] != len(self):
                raise SignalError(f"{len(self)} rows expected for {self!r}, got {vector.shape}")
            return {n: vector[i, :] for i, n in enumerate(self.names)}
        a = np.asarray(vector, dtype=float)
        if a.ndim not in (1, 2) or a.shape[0] != len(self):
            raise SignalError(f"shape ({len(self)},) or ({len(self)}, m) expected, got {a.shape}")
        if a.ndim == 1:
            return {n: float(a[i]) for i, n in enumerate(self.names)}
        return {n: a[i] for i, n in enumerate(self.names)}

    def sx(self) -> tuple[ca.SX, dict[str, ca.SX]]:
        """Return a fresh symbolic column and its entries by name."""
        parts = {n: ca.SX.sym(n) for n in self.names}
        return ca.vertcat(*parts.values()) if parts else ca.SX(0, 1), parts

    def stack(self, values: Mapping[str, Any]) -> Any:
        """Stack symbolic values in declared order; the names must match exactly."""
        unknown = [f"unknown {n} {nearest(n, self.names)}" for n in values if n not in self._index]
        missing = [n for n in self.names if n not in values]
        if unknown or missing:
            raise SignalError("; ".join([*(f"missing {n}" for n in missing), *unknown]))
        return ca.vertcat(*(values[n] for n in self.names)) if len(self) else ca.SX(0, 1)
