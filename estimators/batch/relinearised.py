"""A filter whose derivatives are taken along a trajectory smoothed before: two passes or more.

The extended filter takes its derivatives at its own estimates, which hold the noise that the next
innovations hold: where something is seen weakly, over many samples, that adds up to a bias.  A
second pass, linearised about the smoothed estimates of the first, is free of most of it.  The prior
is the same in each pass, so that no sample counts twice.

Repeated until nothing moves, it is the Gauss-Newton method for the most likely trajectory: the
iterated Kalman smoother of Bell (1994), SIAM Journal on Optimization 4, 626.  It needs the whole
recording, so it is nothing for estimation while samples come in.
"""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.sharing import kept, of_family
from apu_casadi.core.signals import Signals
from estimators.batch.smoother import rts_smoother
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.filtering import FilterResult
from estimators.filters.stepparts import kind_of, linearisation
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording

__all__ = ["linearised", "relinearised_filter"]


@kept
@of_family
def linearised(model: FilterModel) -> FilterModel:
    """Return the model linearised about states that come as inputs ``at_<state>``.

    Output and transition are g and f there with w = 0, and linear in what x and w are beside that;
    an extended filter of it is exact.

    Args:
        model: any; the inputs are appended to its own.
    """
    model = model.expanded()
    kind = kind_of(model)
    nx, nu, np_, nw, _ = model.sizes
    u, p, dt = kind.sym("u", nu), kind.sym("p", np_), kind.sym("dt")
    outputs, forecast = linearisation(model, kind, u, p, dt)
    x, w, given = kind.sym("x", nx), kind.sym("w", nw), kind.sym("u", nu + nx)
    at = ca.vertcat(given[nu:], kind.zeros(nw))
    beside = ca.vertcat(x - given[nu:], w)
    y, H, check_y = outputs(at, given[:nu], p)
    x1, F, check_x = forecast(at, given[:nu], p, dt)
    name = f"{model.name}_linearised"
    about = [
        dataclasses.replace(
            q, name=f"at_{q.name}", doc=f"where it is linearised: {q.doc}", default=None
        )
        for q in model.x
    ]
    return FilterModel.of(
        name,
        (model.x, model.u + Signals(about), model.p, model.w, model.y),
        (x, given, p, w, dt),
        (x1 + ca.mtimes(F, beside), check_x),
        (y + ca.mtimes(H, beside), check_y),
        like=model,
    )


def relinearised_filter(
    model: FilterModel,
    prior: Belief,
    data: Recording,
    *,
    passes: int = 2,
    full: bool = False,
    backend: str | None = None,
) -> FilterResult:
    """Filter a recording, smooth, and filter it again about what was found.

    Args:
        model, prior, data, full, backend: as of
            :func:`estimators.filters.ekf.extended_kalman_filter`.
        passes: of the filter; 1 is the extended filter itself, 2 nearly always enough.

    Returns:
        The last pass's result, filtered: at each instant what the samples up to it tell.  Only
        where it is linearised comes from later ones.

    Raises:
        ParameterError: passes not a whole number from 1 to 20.
        DataError, SignalError, EstimationError: as of the extended filter.
    """
    if not (isinstance(passes, int) and 1 <= passes <= 20):
        raise ParameterError(f"passes must be a whole number from 1 to 20, got {passes!r}")
    full = full or passes > 1
    result = extended_kalman_filter(model, prior, data, full=full, backend=backend)
    for _ in range(passes - 1):
        path = rts_smoother(result).mean
        about = dataclasses.replace(data, u=np.vstack([data.u, path]))
        result = extended_kalman_filter(linearised(model), prior, about, full=full, backend=backend)
    return result
