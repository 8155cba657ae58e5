"""Park's transformation between phase and rotor quantities, with axes and signs stated once.

The transformation is Krause's, q axis first: theta_e is the electrical angle from the magnetic
axis of phase a to the q axis, the d axis lags q by 90 degrees, and the factor 2/3 makes it
amplitude invariant.  Written with this T, the paper's equations (5)-(9) have the printed signs.

Everything here is a pure function of floats, NumPy arrays or CasADi symbols.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

PHASES = ("a", "b", "c")
#: Electrical angle of each phase's magnetic axis, rad, keyed by the phase's letter.
PHASE_ANGLE = {"a": 0.0, "b": 2.0 * math.pi / 3.0, "c": 4.0 * math.pi / 3.0}


class Qd0(NamedTuple):
    """A stator quantity on the rotor's axes; the order is the paper's."""

    q: Any
    d: Any
    zero: Any


class Abc(NamedTuple):
    """A stator quantity by phase."""

    a: Any
    b: Any
    c: Any


def _cos(angle: Any) -> Any:
    return ca.cos(angle) if isinstance(angle, ca.SX | ca.MX | ca.DM) else np.cos(angle)


def _sin(angle: Any) -> Any:
    return ca.sin(angle) if isinstance(angle, ca.SX | ca.MX | ca.DM) else np.sin(angle)


def _axes(theta_e: Any) -> list[tuple[Any, Any]]:
    """Cosine and sine of the angle from each phase's axis to the q axis.

    By the addition theorem, from one cosine and one sine: these are the dearest operations here.
    """
    c, s = _cos(theta_e), _sin(theta_e)
    fixed = ((math.cos(a), math.sin(a)) for a in PHASE_ANGLE.values())
    return [(c * cos_a + s * sin_a, s * cos_a - c * sin_a) for cos_a, sin_a in fixed]


def abc_to_qd0(theta_e: Any, x: Abc) -> Qd0:
    """Return T x.

    Args:
        theta_e: electrical angle from the phase-a axis to the q axis, rad.
        x: phase quantities, any unit.
    """
    axes = _axes(theta_e)
    q = 2.0 / 3.0 * sum(c * v for (c, _), v in zip(axes, x, strict=True))
    d = 2.0 / 3.0 * sum(s * v for (_, s), v in zip(axes, x, strict=True))
    return Qd0(q, d, (x.a + x.b + x.c) / 3.0)


def qd0_to_abc(theta_e: Any, x: Qd0) -> Abc:
    """Return T^-1 x; the inverse of :func:`abc_to_qd0`."""
    return Abc(*(c * x.q + s * x.d + x.zero for c, s in _axes(theta_e)))


def phase_column(theta_e: Any, phase_angle: Any) -> Qd0:
    """Return the column T(:, k) of the phase whose axis lies at ``phase_angle`` (rad).

    The paper's T(:,1) in (7) is the column of phase a, ``phase_angle = 0``.
    """
    angle = theta_e - phase_angle
    return Qd0(2.0 / 3.0 * _cos(angle), 2.0 / 3.0 * _sin(angle), 1.0 / 3.0)


def phase_selector(phase_angle: Any) -> Abc:
    """Return T^-1 T(:, k): one for the phase whose axis lies at ``phase_angle``, zero elsewhere.

    Written as (1 + 2 cos(offset)) / 3, so that the faulty phase is a number and not a structure.
    """
    return Abc(*((1.0 + 2.0 * c) / 3.0 for c, _ in _axes(phase_angle)))


def speed_voltage(w_r: Any, x: Qd0) -> Qd0:
    """Return W_r x of (5): what d/dt of T^-1 adds.  ``w_r`` in electrical rad/s."""
    return Qd0(w_r * x.d, -w_r * x.q, 0.0)
