"""The shaft power of all machines from the power of each, eq. (1)."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError
from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.electricalside import ElectricalSide, View
from estimators.apu.machinepowers import on_common_windows, shaft_courses

APU = Apu()
T = np.arange(0.0, 0.41, 0.02)


def side(P, *more, t=T, noise=100.0, loss=300.0) -> ElectricalSide:
    """A side of constant variances whose power is that of a course, or of several."""
    K = t.size
    views = tuple(
        View(start, *(np.full(K - 1, v) for v in (p, noise**2 + loss**2, noise**2, loss**2)))
        for start, p in ((0, P), *more)
    )
    none = np.zeros((2, 3, K)), np.zeros(K), np.zeros(K, int), np.zeros(K)
    return ElectricalSide(t, views, 0.0, 0.0, *none, (), None)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_each_machine_contributes_its_own_power_and_variance(n):
    """As eq. (1) of each with its gear's loss; P is that of two like it."""
    unit = APU.with_generators(*[APU.generator] * n)
    P = 1e5 * np.arange(1, n + 1)
    for eta in (None, 0.98):
        if eta is not None:  # of the last machine
            name = f"generator{n}.coupling.eta_gtSg" if n > 1 else "coupling.eta_gtSg"
            unit = unit.change({name: eta})
        of = np.array([unit.machines[k][1].eta_gtSg for k in range(n)])
        sides = [side(p, noise=100.0 * (k + 1), loss=50.0) for k, p in enumerate(P)]
        ((first, mean, new, same),) = shaft_courses(unit, sides)
        assert first == 0
        assert_allclose(mean, (P / 2 / of).sum(), rtol=1e-14)
        own = 100.0 * np.arange(1, n + 1) / 2 / of
        assert_allclose(new, np.hypot.reduce(own), rtol=1e-14)
        assert_allclose(same, np.hypot.reduce(50.0 / 2 / of), rtol=1e-14)


def test_one_of_equal_machines_stands_for_all():
    unit = APU.with_generators(*[APU.generator] * 3)
    ((_, mean, new, same),) = shaft_courses(unit, [side(2e5)])
    assert_allclose(mean, 3e5) and assert_allclose(new, 150.0) and assert_allclose(same, 450.0)
    other = APU.change({"generator2.machine.r_s": 0.006})
    with pytest.raises(DataError, match="powers of 1 of 2 are no sum"):
        shaft_courses(other, [side(2e5)])


def test_what_is_known_later_of_one_changes_the_sum_from_there_on():
    unit = APU.change({"generator2.coupling.gear": 3.05})
    before, after = shaft_courses(unit, [side(1e5), side(2e5, (5, 2.4e5))])
    assert (before[0], after[0]) == (0, 5)
    assert_allclose(before[1], 1.5e5)
    assert_allclose(after[1], 1.7e5)


def test_machines_sampled_at_other_instants_keep_their_energy():
    """The second began 7 ms later and ended earlier."""
    t = T[:-3] + 0.007
    P = 1e5 * (1 + np.sin(20 * (t[1:] + t[:-1]) / 2))
    a, b = on_common_windows([side(1e5), side(P, (4, P), t=t)])
    assert_allclose(a.t, T[1:-3])
    assert a.t is b.t and a.views[0].P.size == b.views[0].P.size == a.t.size - 1
    assert b.phase.shape == b.t.shape and b.severities.shape == (2, 3, b.t.size)
    energy = np.append(0.0, np.cumsum(P * np.diff(t)))
    assert_allclose((b.views[0].P * 0.02).sum(), np.ptp(np.interp(b.t[[0, -1]], t, energy)))
    # the fifth window of the second, from 0.087 s on, is known by 0.1 s
    assert [v.start for v in b.views] == [0, 4] and b.t[4] == pytest.approx(0.1)
    assert on_common_windows([side(1e5), side(1e5, t=T + 1.0)]) is None
    same = [side(1e5), side(2e5)]
    assert on_common_windows(same) == same
