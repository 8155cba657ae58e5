"""With which filters a study's numbers were made: a digest of their equations.

It is taken of the functions themselves, as CasADi writes them down: comments, names of Python and
the place of code do not change it; an operation, a constant or a default of the filters does.  What
a study draws, and how it scores, is outside.  Digests of two versions of CasADi cannot be compared.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import casadi as ca

from apu_casadi.core.sharing import once

__all__ = ["FUNCTIONS", "digest", "digest_of"]


def _linear() -> list[ca.Function]:
    from estimators.filters.ekf import ekf_step
    from estimators.filters.ukf import ukf_step
    from scenarios.studies.correctness import linear_model

    return [f(linear_model()).function for f in (ekf_step, ukf_step)]


def _electrical() -> list[ca.Function]:
    from estimators.apu.electrical.electricalfilter import GAINS, electrical_filter
    from estimators.filters.ekf import ekf_step

    return [ekf_step(electrical_filter(gains=g).model).function for g in GAINS]


def _gas_path() -> list[ca.Function]:
    from estimators.apu.gaspath import ITERATED, ITERATIONS, gas_path_filter
    from estimators.filters.ekf import ekf_step
    from scenarios.studies.gaspath_study import ETA_SIGMA

    filters = (gas_path_filter(), gas_path_filter(eta=ETA_SIGMA, consider_eta=False))
    return [ekf_step(f.model, ITERATIONS, ITERATED).function for f in filters]


def _both() -> list[ca.Function]:
    return [*_electrical(), *_gas_path()]


def _isolation() -> list[ca.Function]:
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.isolation.windowmodel import jump_model
    from estimators.filters.ekf import ekf_step

    return [ekf_step(jump_model(GasGenerator())).function]


def _fitting() -> list[ca.Function]:
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.fitting import OUTPUTS, engine_model

    return [engine_model(GasGenerator(), OUTPUTS, steady=s).stage for s in (True, False)]


FUNCTIONS: dict[str, Callable[[], list[ca.Function]]] = {
    "correctness": _linear,
    "electrical": _electrical,
    "detection": _electrical,
    "gaspath": _gas_path,
    "shaft-power": _gas_path,
    "isolation": _isolation,
    "fitting": _fitting,
    "joint": _both,
    "speed": _both,
}
"""What makes the filters of each study, by its name."""


def digest_of(functions: Sequence[ca.Function]) -> str:
    """Return the digest of functions, twelve characters: that of all they are made of."""
    h = hashlib.sha256()
    for f in functions:
        h.update(f.serialize().encode())
    return h.hexdigest()[:12]


@once
def digest(study: str) -> str:
    """Return the digest of a study's filters as the code makes them now; a second or two."""
    return digest_of(FUNCTIONS[study]())
