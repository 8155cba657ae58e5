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

import casadi as ca
import numpy as np

from apu_casadi.core.errors import (
    ApuWarning,
    ExchangeWarning,
    OperatingPointError,
    ValidityError,
    ValidityWarning,
)
from apu_casadi.core.profiles.profile import Varying, at, later
from apu_casadi.core.results import phases
from apu_casadi.core.sharing import once
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits, OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import Governor
from apu_casadi.unit.events import Event, LoadChange, who

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.loads.load import Load

__all__ = [
    "EXCHANGE_LIMIT",
    "Departure",
    "ExchangeError",
    "before",
    "beyond_words",
    "by_phase",
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
    **dict.fromkeys(("T4", "T5"), "hot"),
    **{"SM": "beyond surge", "Mach8": "exhaust exit choked", "Wf": "no flame"},
    **{"off_c": "off the compressor map", "off_t": "off the turbine map"},
}


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
        when = f" at t = {self.at:.6g} s"
        return (
            f"{beyond_words(self.quantity, self.worst, self.unit, self.limit, when)}, first beyond "
            f"it at t = {self.first:.6g} s, for {self.duration:.4g} s in all"
        )


def beyond_words(quantity: str, value: float, unit: str, limit: float, when: str = "") -> str:
    """Return in words that a quantity is beyond its limit."""
    spans = {"1": "", "off_c": " table spans", "off_t": " table spans"}
    unit = spans.get(quantity if quantity.startswith("off_") else unit, f" {unit}")
    words = _WORDS.get(quantity, "beyond a limit")
    return f"{words}: {quantity} = {value:.5g}{unit}{when} (limit {limit:.5g})"


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
        instants = float(t[first]), float(t[k]), float(steps[out].sum())
        found.append(Departure(name, gg.Y[name].unit, float(limit), float(values[k]), *instants))
    return found


def by_phase(ds: Any) -> list[list[dict[str, Any]]]:
    """Return for each phase of a run what was beyond its limit in it: a table for each quantity.

    A table has quantity, limit, worst and its instant ``at``, ``first`` instant and duration, s.
    """
    rows, t = json.loads(ds.attrs.get("validity", "[]")), ds["time"].values
    steps, found = np.diff(t, prepend=t[0]), []
    for k, p in enumerate(phases(ds)):
        inside = ((t > p["start"] + 1e-9) | (k == 0)) & (t <= p["end"] + 1e-9)
        own = []
        for d in rows:
            sign = 1.0 if d["worst"] > d["limit"] else -1.0
            values = ds[d["quantity"]].values
            out = np.flatnonzero(inside & (sign * (values - d["limit"]) > 0))
            if out.size:
                worst = out[int(np.argmax(sign * values[out]))]
                own.append({
                    **{n: d[n] for n in ("quantity", "unit", "limit")},
                    "worst": float(values[worst]), "at": float(t[worst]),
                    "first": float(t[out[0]]), "duration": float(steps[out].sum()),
                })  # fmt: skip
        found.append(own)
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


def unserved(
    load: Load | Varying[Load],
    events: Sequence[Event],
    t: np.ndarray,
    P_e: np.ndarray,
    numbers: Sequence[int] = (1,),
    *,
    of_all: bool = True,
) -> str | None:
    """Return the words for a constant-power load that does not get its power; None if all do.

    Args:
        load, events: of the run.
        t, P_e: exchange instants, s, and output of one generator over the step before, W, (K,).
        numbers: of the generators that it is of.
        of_all: whether they are all.
    """
    of_these = (None, numbers[0])
    changes = [
        (e.t, later(e.load, e.t))
        for e in events
        if isinstance(e, LoadChange) and e.generator in of_these
    ]
    starts = [(0.0, load), *changes]
    for (start, x), end in zip(starts, [*(s for s, _ in changes), float(t[-1])], strict=True):
        k = int(np.searchsorted(t, end + 1e-9)) - 1
        if end - start < SETTLED:
            continue
        x = at(x, float(t[max(k, 1) - 1 : k + 1].mean()))
        if P_e[k] < 0.9 * x.demand:
            each = "each generator" if of_all else who(numbers)
            return (
                f"the load asks for more than the generator can give: at t = {t[k]:.6g} s it gets "
                f"{P_e[k] / 1e3:.1f} kW of the {x.demand / 1e3:.1f} kW asked of {each}; "
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
        at, free = {"N": apu.N_ref, "Wf": high}, Limits.none()
        most = trim_gas_generator(apu.gas_generator, at, theta=health, limits=free, **ambient)
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
    rotor = _Rotor(apu, point, float(N[0]), float(Wf[0]))
    for first in range(0, t.size - 1, _CHUNK):
        at = slice(first, min(first + _CHUNK + 1, t.size))
        h, run = np.diff(t[at]), N[at] - N[0]
        e = np.exp(rotor.a * h)
        g = np.expm1(rotor.a * h) / rotor.a if rotor.a else h
        d = (run[1:] - e * run[:-1]) / g - rotor.b * (Wf[at][1:] - Wf[0])
        rotor.drive(h, d, run[1:])
    return ExchangeError(rotor.error / max(rotor.excursion, _STILL * apu.N_ref), rotor.excursion)


_CHUNK = 8192  # steps at a time: the memory of a long run stays small


class _Rotor:
    """The linear rotor under the continuous governor.

    Exact where the fuel is within its limits and the law is linear in speed and states, as it is
    linearised at the start; by Heun's rule in small parts of the step where a limit is met.
    """

    def __init__(self, apu: Apu, point: OperatingPoint, N_0: float, Wf_0: float) -> None:
        self.link, self.N_0, self.Wf_0 = apu.shaft, N_0, Wf_0
        self.a, self.b = _slopes(apu.gas_generator, point)
        self.state = np.array([0.0, *apu.governor.start(Wf_0)])  # speed from its start, governor's
        self.error = self.excursion = 0.0
        self._matrix, self._demand = self._linear()
        self._moves: dict[float, np.ndarray] = {}

    def _linear(self) -> tuple[np.ndarray, np.ndarray]:
        """Rates of (n, x) and demand under the unlimited governor: factors of n, x, d and 1."""
        m, law = self.state.size, _law(self.link.governor)
        value, slope = (v.full() for v in law(self.state, self.N_0, self.link.N_ref))
        rows = np.zeros((m, m + 2))
        rows[:, :m], rows[:, -1] = slope, value.ravel() - slope @ self.state
        M = np.zeros((m + 2, m + 2))
        M[0] = self.b * rows[0]
        M[0, 0] += self.a
        M[0, -2:] += 1.0, -self.b * self.Wf_0
        M[1:m] = rows[1:]
        return M, rows[0]

    def _move(self, h: float) -> np.ndarray:
        """Exact step of (n, x) over h, and the demand at its end: factors of n, x, d and 1."""
        if h in self._moves:
            return self._moves[h]
        M, m = self._matrix, self.state.size
        # scaled, Taylor's series, squared again; scipy's expm costs a hundred times as much
        halvings = max(0, math.ceil(math.log2(float(np.abs(M).sum(1).max()) * h)) + 2)
        part = M * (h / 2**halvings)
        E = term = np.eye(m + 2)
        for k in range(1, 13):
            term = term @ part / k
            E = E + term
        for _ in range(halvings):
            E = E @ E
        if len(self._moves) > 64:
            self._moves.clear()
        self._moves[h] = np.vstack([E[:m], self._demand @ E])
        return self._moves[h]

    def drive(self, h: np.ndarray, d: np.ndarray, run: np.ndarray) -> None:
        """Go on over steps of lengths h by their disturbances; compare with the speeds of a run."""
        low, high = self.link.governor.Wf_min, self.link.governor.Wf_max
        m, v, speeds = self.state.size, np.append(self.state, [0.0, 1.0]), []
        now = float(self._demand @ v)
        steps = np.round(h, 12).tolist()  # equal but for rounding: one exponential
        last, move = math.nan, np.empty(0)
        for step, dist in zip(steps, d.tolist(), strict=True):
            if step != last:
                last, move = step, self._move(step)
            v[m] = dist
            after = move.dot(v)
            then = float(after[m])
            if low < now < high and low < then < high:
                v[:m] = after[:m]
            else:
                v[:m] = self._by_parts(v[:m], step, dist)
                then = float(self._demand @ v)
            now = then
            speeds.append(float(v[0]))
        self.state = v[:m].copy()
        self.error = max(self.error, float(np.abs(run - speeds).max()))
        self.excursion = max(self.excursion, float(np.abs(speeds).max()))

    def _by_parts(self, state: np.ndarray, h: float, dist: float) -> np.ndarray:
        def rates(s: np.ndarray) -> np.ndarray:
            n, *x = s.tolist()
            fuel = self.link.fuel(self.N_0 + n, x)
            return np.array([self.a * n + self.b * (fuel.Wf - self.Wf_0) + dist, *fuel.rates])

        parts = max(8, math.ceil(h / 2e-3))
        for _ in range(parts):
            k1 = rates(state)
            k2 = rates(state + h / parts * k1)
            state = state + h / parts / 2 * (k1 + k2)
        return state


@once
def _law(governor: Governor) -> ca.Function:
    """(n and states, N_0, N_ref) -> demand and rates without limits, and their derivatives."""
    s, N_0, N_ref = (ca.SX.sym(k, n) for k, n in (("s", 1 + len(governor.X)), ("N", 1), ("R", 1)))
    e, x = (N_ref - N_0 - s[0]) / N_ref, ca.vertsplit(s[1:])
    own = ca.vertcat(governor.demand(e, x), *governor.rates(e, x, 0.0))
    return ca.Function("law", [s, N_0, N_ref], [own, ca.jacobian(own, s)])


def _slopes(gg: GasGenerator, point: OperatingPoint) -> tuple[float, float]:
    """Return d(dN/dt)/dN, 1/s, and d(dN/dt)/dWf, (rad/s2)/(kg/s), at a steady point."""
    x, u, theta = point.x, np.array(point.u, float), point.theta
    ode, slope, *_ = gg.cycle.dfdx(x, point.z, u, theta)
    u[0] *= 1 + (step := 1e-4)
    z = gg.solve(point.z, x, u, theta)
    more, *_ = gg.cycle.dfdx(x, z, u, theta)
    return float(slope), (float(more) - float(ode)) / (step * float(point.u[0]))


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
    strict: bool = False,
) -> xr.Dataset:
    """Write what was found into the attributes of a run, and raise the warnings.

    ``validity`` holds the departures as a JSON list, ``warnings`` the texts of all warnings as
    another, those that are there already first.

    Args:
        found: departures from the limits; together they make one :class:`ValidityWarning`.
        notes: further warnings, raised as they are.
        strict: raise the first as an error instead.

    Raises:
        ValidityError: there is a warning, and the run was to be strict.
    """
    notes = list(notes)
    if found:
        words = "; ".join(d.text() for d in found)
        text = f"the run left the range in which the model holds: {words}"
        notes.insert(0, ValidityWarning(text))
    if strict and notes:
        raise ValidityError(f"at the end of the run: {notes[0]}", float(ds["time"][-1]))
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
