"""A run that stops where the model no longer holds, instead of going on with a warning."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from apu_casadi.core.errors import ValidityError
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.unit.jointrun import JointRun
from apu_casadi.unit.recorder import Row
from apu_casadi.unit.stepmeans import RawMeans, StepMeans
from apu_casadi.unit.validity import beyond_words


class Strict:
    """Records what a run gives, and stops it at the first instant that leaves the model.

    That is a limit of the trim, a voltage spike at a switch, or a torque that takes more of the
    shaft than eq. (8) gives it.  What shows at the end only is refused there.

    Args:
        run: on its way.
        means: what settles the means, by the numbers of generators that stay equal.
        record: what each step goes to.

    Raises:
        ValidityError: by a call; with the instant and the reason.
    """

    def __init__(
        self,
        run: JointRun,
        means: dict[tuple[int, ...], StepMeans],
        record: Callable[[int, int, Row], None],
    ) -> None:
        gg = run.apu.gas_generator
        self._run, self._means, self._record, self._gg = run, means, record, gg
        self._rows = [(n, gg.Y.index(n), s, limit) for _, n, s, limit in Limits().rows(gg)]

    def __call__(self, k: int, n: int, row: Row) -> None:
        """Take n exchange instants, the first of which is k."""
        self._record(k, n, row)
        t, y = self._run.asked.grid[k : k + n], row.y.reshape(-1, n)
        first: tuple[int, str] | None = None
        for name, i, sign, limit in self._rows:
            out = np.flatnonzero(sign * (y[i] - limit) > 0)
            if out.size and (first is None or out[0] < first[0]):
                words = beyond_words(name, float(y[i, out[0]]), self._gg.Y[name].unit, limit)
                first = int(out[0]), words
        if first is not None:
            raise ValidityError(first[1], float(t[first[0]]))
        if spikes := self._run.machines.spikes:
            raise ValidityError(spikes[0], float(t[0]))
        for of in row.of:
            own = next(m for numbers, m in self._means.items() if of.numbers[0] in numbers)
            if isinstance(of.means, RawMeans) and (found := own.too_little(of.means)):
                raise ValidityError(*found)
