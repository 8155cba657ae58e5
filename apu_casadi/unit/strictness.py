"""A run that stops where the model no longer holds, instead of going on with a warning."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np

from apu_casadi.core.errors import ValidityError
from apu_casadi.core.profiles.profile import at
from apu_casadi.gaspath.steady.steadypoint import Limits, OperatingPoint
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.departures import Departure, beyond_words, stopped
from apu_casadi.unit.events import Event, Holding, LoadChange
from apu_casadi.unit.recorder import Row
from apu_casadi.unit.stepmeans import RawMeans, StepMeans
from apu_casadi.unit.validity import (
    FALLING,
    PASSED,
    SERVED,
    SETTLED,
    FollowedRotor,
    demanded,
    exchange_words,
    fuel_words,
    notes_of_exchange,
    unserved_words,
)


class Running(Protocol):
    """A run on its way: the unit and what holds now."""

    apu: Apu
    now: Holding


class Strict:
    """Records what a run gives, and stops it at the first instant that leaves the model.

    That is a limit of the trim, a voltage spike at a switch, a torque that takes more of the shaft
    than eq. (8) gives it, a constant-power load that lacks its power for ``SETTLED``, a fuel limit
    at which the speed has fallen for ``FALLING``, or an exchange error beyond its limit of the
    excursion so far, once that has passed.  What a run ends in before that is refused at its end.

    Args:
        run: on its way.
        grid: its instants, s.
        means: what settles the means, by the numbers of generators that stay equal.
        record: what each step goes to.
        limits: of the trim.
        events: of the run.
        spikes: returns those at switches so far.
        exchange: the exchange and its step, s, and the rotor by which its error is judged; None:
            it is not.

    Raises:
        ValidityError: by a call; with the instant and the reason.
    """

    def __init__(
        self,
        run: Running,
        grid: np.ndarray,
        means: Mapping[tuple[int, ...], StepMeans],
        record: Callable[[int, int, Row], None],
        limits: Limits,
        events: Sequence[Event] = (),
        spikes: Callable[[], Sequence[Departure]] = tuple,
        exchange: tuple[str, float, OperatingPoint] | None = None,
    ) -> None:
        gg = run.apu.gas_generator
        self._run, self._means, self._record, self._gg = run, means, record, gg
        self._grid, self._spikes, self._exchange = grid, spikes, exchange
        self._rows = [(k, n, gg.Y.index(n), s, limit) for k, n, s, limit in limits.rows(gg)]
        self._changed = [(e.t, e.generator) for e in events if isinstance(e, LoadChange)]
        self._lacks = dict[tuple[int, ...], float]()  # since when a load lacks power, s
        self._N, self._Wf = (gg.Y.index(n) for n in ("N", "Wf"))
        self._speed, self._starved = -math.inf, math.inf  # before; since when the fuel falls short
        self._rotor: FollowedRotor | None = None

    def __call__(self, k: int, n: int, row: Row) -> None:
        """Take n exchange instants, the first of which is k."""
        self._record(k, n, row)
        t, y = self._grid[k : k + n], row.y.reshape(-1, n)
        first: tuple[int, str] | None = None
        for kind, name, i, sign, limit in self._rows:
            out = np.flatnonzero(sign * (y[i] - limit) > 0)
            if out.size and (first is None or out[0] < first[0]):
                words = beyond_words(name, float(y[i, out[0]]), self._gg.Y[name].unit, limit)
                first = int(out[0]), stopped(words, kind.name.lower())
        if first is not None:
            raise ValidityError(first[1], float(t[first[0]]))
        if spikes := self._spikes():
            raise ValidityError(stopped(spikes[0].text(), "spike"), spikes[0].at)
        for of in row.of:
            if not isinstance(of.means, RawMeans):
                continue
            own = next(m for numbers, m in self._means.items() if of.numbers[0] in numbers)
            if found := own.too_little(of.means):
                raise ValidityError(stopped(found.words, "torque"), found.t)
            self._served(of.numbers, of.means, t)
        self._fuelled(t, y[self._N], y[self._Wf])
        self._exchanged(t, y[self._N], y[self._Wf])

    def _fuelled(self, t: np.ndarray, N: np.ndarray, Wf: np.ndarray) -> None:
        """Refuse a fuel limit at which the speed falls for as long as it may in a transient."""
        apu = self._run.apu
        starved = (Wf >= apu.governor.Wf_max * (1 - 1e-9)) & (np.diff(N, prepend=self._speed) < 0)
        self._speed = float(N[-1])
        for now, speed, lacks in zip(t.tolist(), N.tolist(), starved.tolist(), strict=True):
            self._starved = min(self._starved, now) if lacks else math.inf
            if now - self._starved >= FALLING - 1e-9:
                asked = at(self._run.now.N_ref, now)
                words = fuel_words(apu, f"at t = {now:.6g} s", self._starved, speed, asked)
                raise ValidityError(stopped(words, "fuel_limit"), self._starved)

    def _exchanged(self, t: np.ndarray, N: np.ndarray, Wf: np.ndarray) -> None:
        """Refuse an exchange that has erred by too much of a transient that has passed."""
        if self._exchange is None:
            return
        name, dt, point = self._exchange
        if self._rotor is None:
            self._rotor = FollowedRotor(self._run.apu, point, t, N, Wf)
            t, N, Wf = t[1:], N[1:], Wf[1:]
        if not t.size:
            return
        rotor = self._rotor
        rotor.follow(t, N, Wf)
        if t[-1] - rotor.grew >= PASSED - 1e-9 and notes_of_exchange(rotor.share, name, dt):
            words = f"{exchange_words(rotor.share, name, dt)} so far"
            raise ValidityError(stopped(words, "exchange"), rotor.grew)

    def _served(self, numbers: tuple[int, ...], means: RawMeans, t: np.ndarray) -> None:
        """Refuse a load of constant power that lacks it for as long as it may settle."""
        load = self._run.now.loads[numbers[0] - 1]
        if not at(load, float(t[0])).demand:
            return
        changed = (b for b, k in self._changed if k in (None, *numbers) and b < t[0])
        since = max(changed, default=0.0)
        P_e = means.values[means.quad.index("P_e")]
        before = float(self._grid[np.searchsorted(self._grid, t[0]) - 1])
        for now, P in zip(t.tolist(), P_e.tolist(), strict=True):
            asked = demanded(load, before, now)
            if now < since + SETTLED - 1e-9 or SERVED * asked <= P:
                self._lacks.pop(numbers, None)
            elif now - self._lacks.setdefault(numbers, now) >= SETTLED - 1e-9:
                alone = len(numbers) < len(self._run.apu.machines)
                words = unserved_words(now, P, asked, numbers if alone else None)
                raise ValidityError(stopped(words, "unserved"), now)
            before = now
