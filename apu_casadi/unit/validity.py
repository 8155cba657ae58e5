"""What must be known of a run besides its numbers: where it left the model, what its exchange errs.

Everything is judged once, at the end, from the outputs that the run keeps: the limits of the trim
(:class:`apu_casadi.gaspath.steady.steadypoint.Limits`) against every exchange instant, and an
estimate of the error that the exchange of speed and fuel has made.  The findings go into the
attributes of the dataset, and each category is raised once as a Python warning.

The exchange error.  Over a step the fuel is held, and with the paper's exchange it is half a step
late.  With the rotor linearised at the start of the run,

    dn/dt = a n + b w + d,

n and w being speed and fuel from their start, the stored speeds and fuels give the disturbance d
(load, faults, all that is not linear) of each step exactly.  The same disturbance then drives the
same rotor under the continuous governor; the difference of the two speeds is the error.  It needs
nothing but the run itself, holds for every exchange, and was measured against runs with an exchange
step of 1 ms: right within 15 % from 5 to 160 ms (docs/MULTIRATE.md has the errors of the study).
It does not see the ripple of a short circuit that a governor sampled at whole multiples of 1.25 ms
takes for a speed error, some 0.25 % of the excursion.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import ApuWarning, ExchangeWarning, OperatingPointError, ValidityWarning
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits, OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import GovernorParameters, governor
from apu_casadi.unit.events import Event, LoadChange

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.loads.load import Load

__all__ = [
    "EXCHANGE_LIMIT",
    "Departure",
    "ExchangeError",
    "before",
    "conclude",
    "departures",
    "exchange_error",
    "exchange_words",
    "found_in",
    "fuel_limited",
    "notes_of_exchange",
    "overload",
    "unserved",
]

RPM = 30.0 / math.pi
EXCHANGE_LIMIT = 0.01
"""Estimated exchange error, of the speed's excursion, beyond which a run warns."""
PAPER_STEP = 0.02
"""Exchange step, s, of the paper; its own scheme with it is what a reproduction asks for."""
PAPER_ERROR = 0.1
"""Error up to which that is accepted: twice the 5 % that it loses with the paper's governor."""
SETTLED = 0.1  # s after which a constant-power load should have its power
_STILL = 1e-5  # of the governed speed: a smaller excursion is none
_WORDS = {
    "SM": "beyond surge", "T4": "hot", "T5": "hot", "off_c": "off the compressor map",
    "off_t": "off the turbine map", "Mach8": "exhaust exit choked", "Wf": "no flame",
}  # fmt: skip


# ------------------------------------------------------------------------------ limits


@dataclass(frozen=True)
class Departure:
    """One quantity that was beyond its limit during a run.

    Args:
        quantity, unit: output of the gas generator.
        limit, worst: of the trim, and the value farthest beyond it.
        first, at: instants, s, of the first value beyond and of the worst one.
        duration: sum of the exchange steps, s, that ended beyond.
    """

    quantity: str
    unit: str
    limit: float
    worst: float
    first: float
    at: float
    duration: float

    def text(self) -> str:
        """Return it in words."""
        unit = {"1": "", "off_c": " table spans", "off_t": " table spans"}.get(
            self.quantity if self.quantity.startswith("off_") else self.unit, f" {self.unit}"
        )
        words = _WORDS.get(self.quantity, "beyond a limit")
        return (
            f"{words}: {self.quantity} = {self.worst:.5g}{unit} at t = {self.at:.6g} s (limit "
            f"{self.limit:.5g}), first beyond it at t = {self.first:.6g} s, for "
            f"{self.duration:.4g} s in all"
        )


def departures(
    gg: GasGenerator,
    t: np.ndarray,
    outputs: Mapping[str, np.ndarray],
    limits: Limits | None = None,
) -> list[Departure]:
    """Return what left the limits of a trim during a run, each quantity once.

    Args:
        t: exchange instants, s, shape (K,).
        outputs: outputs of the gas generator by name, shape (K,), each at the end of its step.
        limits: those of the trim by default.
    """
    steps = np.diff(t, prepend=t[0])
    found = []
    for _, name, sign, limit in (limits or Limits()).rows(gg):
        if name not in outputs or math.isinf(limit):
            continue
        values = np.asarray(outputs[name])  # of a long run they lie in a file
        beyond = sign * (values - limit)
        out = beyond > 0
        if not out.any():
            continue
        k, first = int(np.argmax(beyond)), int(np.argmax(out))
        found.append(
            Departure(
                name, gg.Y[name].unit, float(limit), float(values[k]), float(t[first]),
                float(t[k]), float(steps[out].sum()),
            )
        )  # fmt: skip
    return found


def fuel_limited(apu: Apu, t: np.ndarray, N: np.ndarray, Wf: np.ndarray) -> str | None:
    """Return the words for a run that ends with the fuel at its limit and the speed falling."""
    high = apu.governor.Wf_max
    if N.size < 2 or not (Wf[-1] >= high * (1 - 1e-9) and N[-1] < N[-2]):
        return None
    below = np.flatnonzero(Wf < high * (1 - 1e-9))
    since = float(t[below[-1] + 1]) if below.size else float(t[0])
    return (
        f"the load asks for more than the engine gives: at the end of the run the governor is at "
        f"its limit Wf_max = {high:g} kg/s, since t = {since:.6g} s, and the speed still falls "
        f"({N[-1] * RPM:.0f} r/min, {100 * N[-1] / apu.N_ref:.1f} % of the governed one)"
    )


def unserved(load: Load, events: Sequence[Event], t: np.ndarray, P_e: np.ndarray) -> str | None:
    """Return the words for a constant-power load that does not get its power; None if all do.

    Args:
        load, events: of the run.
        t, P_e: exchange instants, s, and output of one generator over the step before, W, (K,).
    """
    changes = [(e.t, e.load) for e in events if isinstance(e, LoadChange)]
    starts = [(0.0, load), *changes]
    for (start, x), end in zip(starts, [*(s for s, _ in changes), float(t[-1])], strict=True):
        k = int(np.searchsorted(t, end + 1e-9)) - 1
        if end - start < SETTLED:
            continue
        if P_e[k] < 0.9 * x.demand:
            return (
                f"the load asks for more than the generator can give: at t = {t[k]:.6g} s it gets "
                f"{P_e[k] / 1e3:.1f} kW of the {x.demand / 1e3:.1f} kW asked of each generator; "
                f"the voltage has collapsed"
            )
    return None


def overload(
    apu: Apu,
    *,
    N: float,
    Wf: float,
    PW: float,
    ambient: Mapping[str, float],
    health: Mapping[str, float],
) -> str | None:
    """Return the words for a load that the engine cannot carry; None where it is another failure.

    The sign of it: the governor is at its upper fuel limit and the speed is below the governed one.

    Args:
        N, Wf, PW: speed (rad/s), fuel flow (kg/s) and shaft power asked for (W) when it failed.
        ambient, health: by name.
    """
    high = apu.governor.Wf_max
    if not (Wf >= high * (1 - 1e-9) and apu.N_ref > N):
        return None
    asked = f"{PW / 1e3:.1f} kW of shaft power" if math.isfinite(PW) else "more shaft power"
    try:
        most = trim_gas_generator(
            apu.gas_generator, {"N": apu.N_ref, "Wf": high}, theta=health, limits=Limits.none(),
            **ambient,
        )  # fmt: skip
        gives = (
            f"gives {most['PW'] / 1e3:.1f} kW at the governed speed (T4 = {most['T4']:.0f} K, "
            f"SM = {most['SM']:.3f})"
        )
        if math.isfinite(PW) and most["PW"] >= PW:
            gives += ", and less at the speed to which it has fallen"
    except OperatingPointError as e:
        gives = f"has no steady point at the governed speed ({e})"
    return (
        f"the load asks for more than the engine can give at the fuel limit: it asks for {asked}; "
        f"with Wf_max = {high:g} kg/s the engine {gives}; the speed has fallen to "
        f"N = {N * RPM:.0f} r/min, {100 * N / apu.N_ref:.1f} % of the governed one"
    )


def before(gg: GasGenerator, t: float, y: np.ndarray) -> str:
    """Return how far from its limits the engine was at the last instant that was solved."""
    v = gg.Y.unpack(y)
    return (
        f"the instant before, t = {t:.6g} s, had N = {v['N'] * RPM:.0f} r/min, T4 = "
        f"{v['T4']:.0f} K, SM = {v['SM']:.3f}, and lay {max(v['off_c'], v['off_t']):.2f} table "
        f"spans off the maps"
    )


# ------------------------------------------------------------------------------ exchange error


@dataclass(frozen=True)
class ExchangeError:
    """Estimated error of the exchange.

    Args:
        error: largest error of the speed, of its largest excursion from the start.
        excursion: that excursion, rad/s, as the continuous governor would have it.
    """

    error: float
    excursion: float


def exchange_error(
    apu: Apu, point: OperatingPoint, t: np.ndarray, N: np.ndarray, Wf: np.ndarray
) -> ExchangeError:
    """Estimate the exchange error of a run from its own speeds and fuels; see the module's text.

    Args:
        point: the steady point that the run starts from.
        t, N, Wf: exchange instants (s), speed there (rad/s), and the fuel flow (kg/s) held over the
            step that ends there, shape (K,).
    """
    a, b = _rotor(apu.gas_generator, point)
    n, I = 0.0, float(Wf[0])  # speed from its start, governor's integrator
    error = excursion = 0.0
    for first in range(0, t.size - 1, _CHUNK):
        at = slice(first, min(first + _CHUNK + 1, t.size))
        h, run = np.diff(t[at]), N[at] - N[0]
        e = np.exp(a * h)
        g = np.expm1(a * h) / a if a else h
        d = (run[1:] - e * run[:-1]) / g - b * (Wf[at][1:] - Wf[0])
        n, I, error, excursion = _continuous(
            apu.governor, apu.N_ref, float(N[0]), (a, b, float(Wf[0])), h, d, run[1:],
            (n, I, error, excursion),
        )  # fmt: skip
    return ExchangeError(error / max(excursion, _STILL * apu.N_ref), excursion)


_CHUNK = 8192  # steps at a time: the memory of a long run stays small


def _rotor(gg: GasGenerator, point: OperatingPoint) -> tuple[float, float]:
    """Return d(dN/dt)/dN, 1/s, and d(dN/dt)/dWf, (rad/s2)/(kg/s), at a steady point."""
    x, u, theta = point.x, np.array(point.u, float), point.theta
    ode, slope, *_ = gg.cycle.dfdx(x, point.z, u, theta)
    u[0] *= 1 + (step := 1e-4)
    z = gg.solve(point.z, x, u, theta)
    more, *_ = gg.cycle.dfdx(x, z, u, theta)
    return float(slope), (float(more) - float(ode)) / (step * float(point.u[0]))


def _continuous(
    par: GovernorParameters,
    N_ref: float,
    N_0: float,
    rotor: tuple[float, float, float],
    h: np.ndarray,
    d: np.ndarray,
    run: np.ndarray,
    state: tuple[float, float, float, float],
) -> tuple[float, float, float, float]:
    """Drive rotor and continuous governor by the disturbances of some steps.

    Exact where the fuel is within its limits, by Heun's rule in small parts of the step where it
    meets one.  ``state`` and the answer: speed, integrator, largest error, largest excursion.
    """
    a, b, Wf_0 = rotor
    n, I, error, excursion = state
    moves: dict[float, tuple[float, ...]] = {}

    def rates(n: float, I: float, dist: float) -> tuple[float, float]:
        fuel = governor(N=N_0 + n, N_ref=N_ref, Wf_I=I, par=par)
        return a * n + b * (fuel.Wf - Wf_0) + dist, fuel.Wf_I_dot

    steps = np.round(h, 12).tolist()  # equal but for rounding: one exponential
    for step, dist, seen in zip(steps, d.tolist(), run.tolist(), strict=True):
        if step not in moves:
            if len(moves) > 64:
                moves.clear()
            moves[step] = _move(a, b, Wf_0, N_0, N_ref, par, step)
        m = moves[step]
        n1 = m[0] * n + m[1] * I + m[2] * dist + m[3]
        I1 = m[4] * n + m[5] * I + m[6] * dist + m[7]
        now = par.Kp * (N_ref - N_0 - n) / N_ref + I
        then = par.Kp * (N_ref - N_0 - n1) / N_ref + I1
        if not (par.Wf_min < min(now, then) and max(now, then) < par.Wf_max):
            n1, I1 = n, I
            parts = max(8, math.ceil(step / 2e-3))
            for _ in range(parts):
                k1, q1 = rates(n1, I1, dist)
                part = step / parts
                k2, q2 = rates(n1 + part * k1, I1 + part * q1, dist)
                n1, I1 = n1 + part / 2 * (k1 + k2), I1 + part / 2 * (q1 + q2)
        n, I = n1, I1
        error = max(error, abs(seen - n))
        excursion = max(excursion, abs(n))
    return n, I, error, excursion


def _move(
    a: float, b: float, Wf_0: float, N_0: float, N_ref: float, par: GovernorParameters, h: float
) -> tuple[float, ...]:
    """Exact step of (n, I) under the unlimited governor: factors of n, I, d and 1."""
    e_0 = (N_ref - N_0) / N_ref
    M = np.zeros((4, 4))
    M[0] = a - b * par.Kp / N_ref, b, 1.0, b * (par.Kp * e_0 - Wf_0)
    M[1] = -par.Ki / N_ref, 0.0, 0.0, par.Ki * e_0
    # scaled, Taylor's series, squared again; scipy's expm costs a hundred times as much for 4 x 4
    halvings = max(0, math.ceil(math.log2(float(np.abs(M).sum(1).max()) * h)) + 2)
    part = M * (h / 2**halvings)
    E = term = np.eye(4)
    for k in range(1, 13):
        term = term @ part / k
        E = E + term
    for _ in range(halvings):
        E = E @ E
    return tuple(E[:2].ravel().tolist())


def accepted(error: float, exchange: str, dt: float) -> bool:
    """Tell whether the exchange is the paper's own as it is printed, and errs as it does there."""
    return exchange == "paper" and dt <= PAPER_STEP * (1 + 1e-9) and error <= PAPER_ERROR


def exchange_words(error: float, exchange: str, dt: float) -> str:
    """Return the estimate in words, with the exchange that errs less where it is large."""
    text = (
        f"exchange {exchange!r} every {1e3 * dt:g} ms: estimated error "
        f"{100 * error:{'.0f' if error > 0.1 else '.2g'}} % of the speed's excursion"
    )
    if error <= EXCHANGE_LIMIT:
        return text
    if accepted(error, exchange, dt):
        return f"{text}, as the paper's scheme has it; exchange 'predicted' errs less"
    if exchange in ("predicted", "corrected"):  # of second order: this gives half a percent
        return f"{text}; use a step of {1e3 * dt * math.sqrt(0.005 / error):.2g} ms or less"
    step = f" with a step of {1e3 * PAPER_STEP:g} ms or less" if dt > PAPER_STEP else ""
    return f"{text}; use exchange 'predicted' or 'corrected'{step}"


# ------------------------------------------------------------------------------ the end of a run


def conclude(
    ds: xr.Dataset,
    found: Sequence[Departure] = (),
    notes: Iterable[ApuWarning] = (),
    *,
    stacklevel: int = 3,
) -> xr.Dataset:
    """Write what was found into the attributes of a run, and raise the warnings.

    ``validity`` holds the departures as a JSON list, ``warnings`` the texts of all warnings as
    another, those that are there already first.

    Args:
        found: departures from the limits; together they make one :class:`ValidityWarning`.
        notes: further warnings, raised as they are.
    """
    notes = list(notes)
    if found:
        words = "; ".join(d.text() for d in found)
        text = f"the run left the range in which the model holds: {words}"
        notes.insert(0, ValidityWarning(text))
    before = json.loads(ds.attrs.get("warnings", "[]"))
    ds.attrs["validity"] = json.dumps([asdict(d) for d in found])
    ds.attrs["warnings"] = json.dumps([*before, *(str(w) for w in notes)], ensure_ascii=False)
    for w in notes:
        warnings.warn(w, stacklevel=stacklevel)
    return ds


def notes_of_exchange(error: float, exchange: str, dt: float) -> list[ApuWarning]:
    """Return the warning for an exchange error beyond the limit, if it is to be raised.

    The paper's own exchange with its own step loses 5 % of the excursion, is documented and is what
    a reproduction asks for: up to twice that it is told in attributes and summary, and not raised.
    """
    if not error > EXCHANGE_LIMIT or accepted(error, exchange, dt):
        return []
    return [ExchangeWarning(exchange_words(error, exchange, dt))]


def found_in(ds: Any) -> list[str]:
    """Return the warnings that a dataset carries; [] where it has none."""
    try:
        rows = json.loads(ds.attrs.get("warnings", "[]"))
    except (TypeError, ValueError):
        return []
    return [str(r) for r in rows] if isinstance(rows, list) else []
