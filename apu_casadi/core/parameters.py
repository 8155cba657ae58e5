"""Frozen parameter sets: every number has a unit, an origin and a range.

A parameter set is a frozen dataclass whose fields are made by :func:`par`.  Users change values
by ``dataclasses.replace`` or, with helpful errors, by :meth:`Parameters.change`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import casadi as ca

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.signals import Signal, Signals


def par(
    default: float,
    *,
    unit: str,
    source: str,
    doc: str,
    lo: float = -math.inf,
    hi: float = math.inf,
) -> Any:
    """Declare a parameter: value, unit, origin, meaning and the closed range that makes sense."""
    meta = {"unit": unit, "source": source, "doc": doc, "lo": lo, "hi": hi}
    return dataclasses.field(default=default, metadata=meta)


@dataclass(frozen=True)
class Parameters:
    """Base of the parameter sets; checks every field made by :func:`par` on construction."""

    def __post_init__(self) -> None:
        """Raise :class:`ParameterError` for a value that is not a finite number in its range."""
        for f in dataclasses.fields(self):
            if "unit" not in f.metadata:
                continue
            value = getattr(self, f.name)
            where = f"{type(self).__name__}.{f.name} [{f.metadata['unit']}]"
            x = number(where, value, error=ParameterError)
            if not isinstance(value, int | float):
                value = x
                object.__setattr__(self, f.name, value)
            if not math.isfinite(value):
                raise ParameterError(f"{where} must be finite, got {value!r}")
            lo, hi = f.metadata["lo"], f.metadata["hi"]
            if not lo <= value <= hi:
                raise ParameterError(f"{where} = {value:g} is outside [{lo:g}, {hi:g}]")

    def change(self, **values: Any) -> Self:
        """Return a copy with some values changed.

        Raises:
            ParameterError: unknown name (the nearest valid one is named) or a value out of range.
        """
        names = [f.name for f in dataclasses.fields(self)]
        for n in values:
            if n not in names:
                raise ParameterError(f"{type(self).__name__} has no {n!r} {nearest(n, names)}")
        return dataclasses.replace(self, **values)

    def signals(
        self, prefix: str, names: Iterable[str] | None = None, *, defaults: bool = False
    ) -> Signals:
        """Return the values as signals with dotted names, as ``machine.r_s``.

        Args:
            prefix: what stands before the dot.
            names: which, and in which order; default all.
            defaults: whether the signals have the defaults of the class.
        """
        by_name = {f.name: f for f in dataclasses.fields(self) if "unit" in f.metadata}
        signals = []
        for f in by_name.values() if names is None else [by_name[n] for n in names]:
            size: Any = f.default
            meta = f.metadata
            signals.append(
                Signal(
                    f"{prefix}.{f.name}",
                    meta["unit"],
                    meta["doc"],
                    default=float(size) if defaults else None,
                    nominal=abs(size) or 1.0,
                )
            )
        return Signals(signals)

    def symbolic(self, **values: Any) -> Self:
        """Return a copy with some values replaced by symbols or expressions, unchecked.

        Raises:
            ParameterError: unknown name.
        """
        names = [f.name for f in dataclasses.fields(self)]
        for n in values:
            if n not in names:
                raise ParameterError(f"{type(self).__name__} has no {n!r} {nearest(n, names)}")
        new = object.__new__(type(self))
        new.__dict__.update({n: values.get(n, getattr(self, n)) for n in names})
        return new

    def held(self, prefix: str) -> dict[str, float]:
        """Return its numbers by dotted name, as ``machine.r_s``."""
        return {f"{prefix}.{row[0]}": row[1] for row in self.table()}

    def table(self) -> list[tuple[str, float, str, str, str]]:
        """Return rows (name, value, unit, meaning, source), for printing and for file headers."""
        return [
            (f.name, getattr(self, f.name), f.metadata["unit"], f.metadata["doc"],
             f.metadata["source"])
            for f in dataclasses.fields(self)
            if "unit" in f.metadata
        ]  # fmt: skip


P = TypeVar("P", bound=Parameters)


def of_symbols(cls: type[P], values: Any, **others: Any) -> P:
    """Return a parameter set whose numbers are symbols, in the order of its fields."""
    names = [f.name for f in dataclasses.fields(cls) if "unit" in f.metadata]
    return cls().symbolic(**dict(zip(names, ca.vertsplit(values), strict=True)), **others)
