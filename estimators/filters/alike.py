"""Filters of a bank that differ in constants alone, as members of one family.

A filter's numbers may stand in its function: the noise of its states, a time constant, a bound.  If
the functions are one list of instructions but for these, the numbers become known parameters, as
those of a unit are, and the filters share what is compiled and evaluated together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import casadi as ca

from apu_casadi.core.constants import differing, form_of, with_constants
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from estimators.filters.filtering import STEP_IN, FilterStep
from estimators.models.filtermodel import FilterModel

__all__ = ["of_one_form"]


def of_one_form(steps: Sequence[FilterStep]) -> list[FilterStep]:
    """Return the steps, those that differ in constants alone as members of one family.

    Steps of one family already, of MX functions, and of which there is no other of the same form
    come back as they are.
    """
    made = list(steps)
    groups: dict[object, list[int]] = {}
    if len({id(s.shared) for s in steps}) < 2:
        return made
    for k, step in enumerate(steps):
        shared = step.shared
        if shared.function.is_a("SXFunction"):
            names = tuple(tuple(getattr(shared.model, n).names) for n in "xupy")
            form = form_of(shared.function)
            groups.setdefault((names, step.root, len(step.model.p), form.key), []).append(k)
    for group in groups.values():
        shares = {id(steps[k].shared): k for k in group}
        if len(shares) < 2:
            continue
        first, *others = (steps[k] for k in group)
        family = _members(first, tuple(others))
        for k, step in zip(group, family, strict=True):
            made[k] = step
    return made


@kept
def _members(first: FilterStep, others: tuple[FilterStep, ...]) -> list[FilterStep]:
    """Return steps of one form as members of one family."""
    steps, shared = (first, *others), first.shared
    values, place = differing([form_of(s.shared.function) for s in steps])
    names = [f"constant_{k}" for k in range(values.shape[1])]
    more = Signals([Signal(n, "1", "what differs between the filters of a bank") for n in names])
    model = shared.model
    x, u, p, w, dt = model.symbols(ca.SX if model.transition.is_a("SXFunction") else ca.MX)
    both = ca.vertcat(p, type(p).sym("constants", len(names)))
    of = model.x, model.u, model.p + more, model.w, model.y
    # the step's function is what counts: f and g stand for names and sizes
    read = model.transition(x, u, p, w, dt), model.output(x, u, p, w)
    like = FilterModel.of(model.name, of, (x, u, both, w, dt), *read, like=model)
    function = with_constants(shared.function, place, STEP_IN.index("p"))
    family = FilterStep(like, function, shared.root, shared.wide)
    return [
        _member(s, family, dict(zip(names, v, strict=True)))
        for s, v in zip(steps, values.tolist(), strict=True)
    ]


def _member(step: FilterStep, family: FilterStep, constants: dict[str, float]) -> FilterStep:
    """Return a step as it is, but for the family and the numbers by which it is of it."""
    model = dataclasses.replace(step.model)
    model.__dict__.update(_family=family.model, _held=step.model.held | constants)
    made = FilterStep(model, step.function, step.root, step.wide, step.rows)
    made.__dict__["_family"] = family
    return made
