"""A run that stops where the model no longer holds, instead of going on with a warning."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from apu_casadi.core.errors import ValidityError
from apu_casadi.core.profiles.profile import at
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.unit.departures import beyond_words, stopped
from apu_casadi.unit.events import Event, LoadChange
from apu_casadi.unit.jointrun import JointRun
from apu_casadi.unit.recorder import Row
from apu_casadi.unit.stepmeans import RawMeans, StepMeans
from apu_casadi.unit.validity import SERVED, SETTLED, demanded, unserved_words


class Strict:
    """Records what a run gives, and stops it at the first instant that leaves the model.

    That is a limit of the trim, a voltage spike at a switch, a torque that takes more of the shaft
    than eq. (8) gives it, or a constant-power load that lacks its power for ``SETTLED``.  What
    shows at the end only is refused there: an exchange error, and a fuel limit at which the speed
    falls.

    Args:
        run: on its way.
        means: what settles the means, by the numbers of generators that stay equal.
        record: what each step goes to.
        limits: of the trim.
        events: of the run.

    Raises:
        ValidityError: by a call; with the instant and the reason.
    """

    def __init__(
        self,
        run: JointRun,
        means: dict[tuple[int, ...], StepMeans],
        record: Callable[[int, int, Row], None],
        limits: Limits,
        events: Sequence[Event] = (),
    ) -> None:
        gg = run.apu.gas_generator
        self._run, self._means, self._record, self._gg = run, means, record, gg
        self._rows = [(k, n, gg.Y.index(n), s, limit) for k, n, s, limit in limits.rows(gg)]
        self._changed = [(e.t, e.generator) for e in events if isinstance(e, LoadChange)]
        self._lacks = dict[tuple[int, ...], float]()  # since when a load lacks power, s

    def __call__(self, k: int, n: int, row: Row) -> None:
        """Take n exchange instants, the first of which is k."""
        self._record(k, n, row)
        t, y = self._run.asked.grid[k : k + n], row.y.reshape(-1, n)
        first: tuple[int, str] | None = None
        for kind, name, i, sign, limit in self._rows:
            out = np.flatnonzero(sign * (y[i] - limit) > 0)
            if out.size and (first is None or out[0] < first[0]):
                words = beyond_words(name, float(y[i, out[0]]), self._gg.Y[name].unit, limit)
                first = int(out[0]), stopped(words, kind.name.lower())
        if first is not None:
            raise ValidityError(first[1], float(t[first[0]]))
        if spikes := self._run.machines.spikes:
            raise ValidityError(stopped(spikes[0].text(), "spike"), spikes[0].at)
        for of in row.of:
            if not isinstance(of.means, RawMeans):
                continue
            own = next(m for numbers, m in self._means.items() if of.numbers[0] in numbers)
            if found := own.too_little(of.means):
                raise ValidityError(stopped(found.words, "torque"), found.t)
            self._served(of.numbers, of.means, t)

    def _served(self, numbers: tuple[int, ...], means: RawMeans, t: np.ndarray) -> None:
        """Refuse a load of constant power that lacks it for as long as it may settle."""
        load = self._run.now.loads[numbers[0] - 1]
        if not at(load, float(t[0])).demand:
            return
        changed = (b for b, k in self._changed if k in (None, *numbers) and b < t[0])
        since = max(changed, default=0.0)
        P_e = means.values[means.quad.index("P_e")]
        before = float(self._run.asked.grid[np.searchsorted(self._run.asked.grid, t[0]) - 1])
        for now, P in zip(t.tolist(), P_e.tolist(), strict=True):
            asked = demanded(load, before, now)
            if now < since + SETTLED - 1e-9 or SERVED * asked <= P:
                self._lacks.pop(numbers, None)
            elif now - self._lacks.setdefault(numbers, now) >= SETTLED - 1e-9:
                alone = len(numbers) < len(self._run.apu.machines)
                words = unserved_words(now, P, asked, numbers if alone else None)
                raise ValidityError(stopped(words, "unserved"), now)
            before = now
