"""Filter steps that a wild reading cannot poison.

Where an innovation of one output is farther than a limit c from zero, in standard deviations z of
its own, the variance of that reading is taken for larger, by as much as puts it on the limit:

    R' = R + S ((z/c)^2 - 1),    S' = S (z/c)^2.

Chang (2014), J. Geodesy 88, 391-401, for each output by itself, so that one wild sensor does not
take the others with it.  The update of the mean is then K z sqrt(S) (c/z)^2: it grows with the
innovation up to the limit, and falls as 1/z beyond; a reading that is far out counts as none, in
the limit exactly.

What it costs in sigma: as long as the model holds a reading is doubted with the probability
``chance``, one in a million by default, so that mean and covariance are those of the filter
itself, to the last bit wherever nothing is doubted.  A doubted reading takes off the covariance
what its R' says: sigma is never smaller than without that reading, and never larger.

Innovations, their covariance, NIS and likelihood are those of the filter itself, so that tests of
them see what was doubted.
"""

from __future__ import annotations

import math
from functools import partial

import casadi as ca
from scipy.special import chdtri

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError
from apu_casadi.core.sharing import kept, of_family
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import STATS, STEP_IN, FilterStep
from estimators.models.filtermodel import FilterModel

__all__ = ["CHANCE", "limit_of", "robust_ekf_step", "robustly"]

CHANCE = 1e-6  # with which a reading of a right model is doubted


def limit_of(chance: float = CHANCE) -> float:
    """Return the limit c, standard deviations, which noise alone passes with a probability.

    Raises:
        ParameterError: a probability outside (0, 0.1].

    Examples:
        >>> round(limit_of(1e-6), 2)
        4.89
    """
    chance = number("chance", chance, error=ParameterError)
    if not 0 < chance <= 0.1:
        raise ParameterError(f"chance must lie in (0, 0.1], got {chance!r}")
    return math.sqrt(float(chdtri(1, chance)))


@kept
def robustly(step: FilterStep, chance: float = CHANCE) -> FilterStep:
    """Return a filter's step that doubts wild readings; of any filter.

    Args:
        step: with covariances or with roots.
        chance: with which a reading of a right model is doubted, see :func:`limit_of`.

    Raises:
        ParameterError: see :func:`limit_of`.
    """
    limit, f = limit_of(chance) ** 2, step.function
    kind = ca.SX if f.is_a("SXFunction") else ca.MX
    m, P, u, p, y, R, dt = (kind.sym(n, *f.size_in(n)) for n in STEP_IN)
    given = [m, P, u, p, y, R, dt]
    # written out, so that of the first only what is asked for is evaluated
    first = dict(zip(f.name_out(), f.call(given, True, False), strict=True))
    size = ca.diag(first["S"])
    over = ca.fmax(first["nu"] ** 2 / size / limit, 1.0)
    doubted = ca.if_else(R >= 0, R + size * (over - 1.0), R)
    out = dict(zip(f.name_out(), f.call([m, P, u, p, y, doubted, dt], True, False), strict=True))
    checks = STATS.index("check")
    stats = ca.vertsplit(first["stats"])
    stats[checks] = out["stats"][checks]
    out |= {"nu": first["nu"], "S": first["S"], "stats": ca.vertcat(*stats)}
    made = [ca.densify(out[n]) for n in f.name_out()]
    made = ca.cse(made)
    name = f"robust_{f.name()}"
    function = ca.Function(name, [m, P, u, p, y, R, dt], made, STEP_IN, f.name_out())
    wide = None if step.wide is None else partial(_wide, step, chance)
    return FilterStep(step.model, function, step.root, wide)


def _wide(step: FilterStep, chance: float) -> FilterStep:
    assert step.wide is not None
    return robustly(step.wide(), chance)


@kept
@of_family
def robust_ekf_step(
    model: FilterModel, iterations: int = 1, iterated: str = "all", chance: float = CHANCE
) -> FilterStep:
    """Build the extended filter's step that doubts wild readings; see :func:`robustly`.

    Args:
        model, iterations, iterated: as of :func:`~.ekf.ekf_step`.
        chance: with which a reading of a right model is doubted.
    """
    return robustly(ekf_step(model, iterations, iterated), chance)
