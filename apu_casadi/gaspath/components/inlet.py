"""Inlet: total-pressure loss between the intake entrance (1) and the compressor face (2)."""

from __future__ import annotations

from typing import Any, NamedTuple


class InletOut(NamedTuple):
    """State at station 2: K, Pa."""

    T2: Any
    P2: Any


def inlet(*, T1: Any, P1: Any, dp_inlet: Any) -> InletOut:
    """Adiabatic inlet of constant relative loss.  0 = P2 - (1 - dp_inlet) P1,  0 = T2 - T1."""
    return InletOut(T1, P1 * (1 - dp_inlet))
