"""Vector lanes against scalar C in the same run: trims, filters, joint runs; and the roofline."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.lanes.lanelibrary import in_lanes, lanes_in_use
from apu_casadi.gaspath.steady.trimbatch import performance_deck, trim_batch
from apu_casadi.unit.ensemble import simulate_ensemble
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filterensemble import run_many
from estimators.filters.filtering import run
from estimators.filters.imm import interacting_multiple_models
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording
from scenarios.bench.gasparts import deck_axes
from scenarios.bench.measuring import Row, Size, apu, part
from scenarios.bench.runparts import simulate
from scenarios.campaigns import random_faults
from scenarios.schema import Scenario
from scenarios.studies import trim_study
from scenarios.studies.electrical.protocol import FULL
from scenarios.studies.electrical.truth import generator_truth, samples_of

FLOPS = (ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_SQ, ca.OP_TWICE, ca.OP_INV, ca.OP_SQRT)
CHAINS, LENGTH = 10, 400  # of the function that tells the peak: independent sums and products
OFTEN, MANY = 5, 32  # calls, and packs in a call, of the roofline
MODES = 8  # of the bank
SAME = "largest difference from scalar C, relative"


@contextmanager
def scalar() -> Iterator[None]:
    """Evaluate without lanes."""
    before = os.environ.get("APU_LANES")
    os.environ["APU_LANES"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["APU_LANES"]
        else:
            os.environ["APU_LANES"] = before


def in_turn(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Return the least processor time of each call, s, taken in turn; each is called once before.

    Others' work on the machine then hits all alike.
    """
    best = dict.fromkeys(calls, np.inf)
    for k in range(repeats + 1):
        for name, call in calls.items():
            t = time.process_time()
            call()
            if k:
                best[name] = min(best[name], time.process_time() - t)
    return best


def off(a: Any, b: Any) -> float:
    """Largest relative difference of two arrays with gaps at the same places."""
    a, b = np.asarray(a), np.asarray(b)
    if not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return np.inf
    size = np.maximum(np.abs(b), 1e-300)
    return float(np.nanmax(np.abs(a - b) / size, initial=0.0))


def _row(what: str, took: dict[str, float], per: float, target: float | None, error: float) -> Row:
    us, ratio = 1e6 * took["lanes"] / per, took["scalar"] / took["lanes"]
    peer = {"peer": "scalar C, same run", "ratio": ratio}
    return Row(what, us, "us", target, error, 1e-15, SAME, **peer)  # type: ignore[arg-type]


@part("lanes", order=33)
def lanes(size: Size) -> list[Row]:
    """Batches in lanes and in scalar C on one core, taken in turn."""
    n, repeats = lanes_in_use(), max(2, size.repeats)
    gg = apu().gas_generator
    asked = trim_study.sample(gg, size.batch, seed=2)
    fixed, theta = asked.pop("fixed"), asked.pop("theta")
    batch = partial(trim_batch, gg, fixed, theta=theta, n_threads=1, **asked)

    def by_one() -> Any:
        with scalar():
            return batch()

    took = in_turn({"lanes": batch, "scalar": by_one}, repeats)
    what = f"trim, batch of {size.batch} points, a point, {n} lanes"
    rows = [_row(what, took, size.batch, 3.0, off(batch().w, by_one().w))]

    rows.append(_deck(size, repeats))

    filt = electrical_filter()
    samples = samples_of(generator_truth(FULL, 0.05), np.random.default_rng(0))
    data, prior, step = filt.recording(samples), filt.prior(samples), ekf_step(filt.model)
    some = 4 * max(2, n)
    many = partial(run_many, step, prior, [data] * some)
    took = in_turn({"lanes": many, "scalar": lambda: [run(step, prior, data)] * 1}, repeats)
    took["scalar"] *= some
    what = f"step of the electrical EKF, a filter, ensemble of {some}, {n} lanes"
    error = off(many()[-1].mean, run(step, prior, data).mean)
    rows.append(_row(what, took, some * data.size, 1.2, error))
    rows.append(_bank(filt.model, prior, data, repeats))
    rows.append(_runs(size, repeats))
    return [*rows, _roofline(step.shared.function.expand(), repeats)]


def _bank(model: FilterModel, prior: Belief, data: Recording, repeats: int) -> Row:
    """A bank of filters that differ in the noise of their states, by interacting models."""
    sizes = dict(zip(model.x.names, model.walk.tolist(), strict=True))
    modes = {
        f"walk {k}": model.with_walk({n: v * (1 + 0.1 * k) for n, v in sizes.items() if v})
        for k in range(MODES)
    }
    rates = np.ones((MODES, MODES)) - MODES * np.eye(MODES)
    bank = partial(interacting_multiple_models, modes, prior, data, rates=rates)

    def by_one() -> Any:
        with scalar():
            return bank()

    took = in_turn({"lanes": bank, "scalar": by_one}, repeats)
    what = f"sample of {MODES} interacting electrical EKFs, a mode"
    return _row(what, took, MODES * data.size, None, off(bank().mean, by_one().mean))


def _deck(size: Size, repeats: int) -> Row:
    """Processor time of a performance deck on all cores."""
    axes, gg = deck_axes(size), apu().gas_generator
    deck = partial(performance_deck, gg, outputs=("T4", "Wf"), **axes)

    def by_one() -> Any:
        with scalar():
            return deck()

    took = in_turn({"lanes": deck, "scalar": by_one}, min(2, repeats))
    error = max(off(deck()[n], by_one()[n]) for n in ("T4", "Wf"))
    what = f"performance deck of {math.prod(size.deck)} points, processor time"
    peer = {"peer": "scalar C, same run", "ratio": took["scalar"] / took["lanes"]}
    return Row(what, took["lanes"], "s", 0.4, error, 1e-15, SAME, **peer)  # type: ignore[arg-type]


def _runs(size: Size, repeats: int) -> Row:
    """Joint runs with random faults in one loop."""
    half = max(size.counts)

    def drawn(seed: int) -> list[Scenario]:
        return [s.change(waveform_dt=None) for s in random_faults(half, seed=seed, base=size.joint)]

    def one(s: Scenario) -> Any:
        return simulate(s, solver="propagator", noise=s.noise, seed=s.seed)["N"].values[-1]

    def together(some: list[Scenario]) -> list[Any]:
        asked = [asked_of(s) for s in some]
        return simulate_ensemble(asked, keep=lambda _, ds: ds["N"].values[-1], refused="keep")

    warm = drawn(3)  # compiles; as many as are timed, since packs of others need other functions
    error = off(together(warm)[:2], [one(s) for s in warm[:2]])
    # faults not met before in either, in turn: what is made for a fault is kept
    took = {"lanes": 0.0, "scalar": 0.0}
    for k in range(repeats):
        t = time.process_time()
        together(drawn(10 + k))
        took["lanes"] += (time.process_time() - t) / repeats
        t = time.process_time()
        for s in drawn(100 + k):
            one(s)
        took["scalar"] += (time.process_time() - t) / repeats
    ms, ratio = 1e3 * took["lanes"] / half, took["scalar"] / took["lanes"]
    what = f"joint {size.joint.duration:g} s run with a random fault, in an ensemble of {half}"
    more: dict[str, Any] = {"peer": "single runs, other faults", "ratio": ratio}
    return Row(what, ms, "ms", 20.0, error, 1e-15, "speed at the end, single runs", **more)


def asked_of(s: Scenario) -> dict[str, Any]:
    """Return what a scenario asks of the paper's unit, as an ensemble takes it."""
    how = {"waveform_dt": s.waveform_dt, "dt": s.dt, "ambient": s.ambient, "noise": s.noise}
    own = {"apu": apu(), "duration": s.duration, **s.start(), "events": s.events()}
    return {**own, **how, "seed": s.seed, "solver": "propagator"}


def flops(fun: ca.Function) -> int:
    """Return the additions, multiplications, divisions and roots of an SX function."""
    return sum(fun.instruction_id(k) in FLOPS for k in range(fun.n_instructions()))


def peak_function() -> ca.Function:
    """Return a function of sums and products that stay in registers, many at a time independent."""
    x = ca.SX.sym("x", CHAINS)
    now = ca.vertsplit(x)
    for _ in range(LENGTH):  # each takes its neighbour, so that they go on side by side
        now = [0.5 * now[k] + now[k - 1] for k in range(CHAINS)]
    return ca.Function("peak", [x], [ca.vertcat(*now)])


def _often(call: Caller) -> None:
    for _ in range(OFTEN):
        call.evaluate()


def _roofline(step: ca.Function, repeats: int) -> Row:
    """How far a filter's step is from what the processor computes at most, without fused adds."""
    rates = {}
    for name, fun in (("step", step), ("peak", peak_function())):
        wide = in_lanes(fun)
        points = OFTEN * MANY * wide.size2_out(0) // fun.size2_out(0)
        call = Caller(wide.map(MANY), copy=False)
        for a in call.inputs:
            a[...] = 1.0
        took = in_turn({name: partial(_often, call)}, repeats)
        rates[name] = 1e-9 * flops(fun) * points / took[name]
    scalar_step = compiled(step)
    call = Caller(scalar_step.map(MANY), copy=False)
    took = in_turn({"one": partial(_often, call)}, repeats)
    one = 1e-9 * flops(step) * OFTEN * MANY / took["one"]
    what = f"electrical EKF step: of {rates['peak']:.1f} Gflop/s that lanes reach in registers"
    text = f"{rates['step']:.1f} Gflop/s in lanes, {one:.1f} in scalar C; nothing is judged"
    share = 100 * rates["step"] / rates["peak"]
    more: dict[str, Any] = {"peer": "scalar C, same run", "ratio": rates["step"] / one}
    return Row(what, share, "%", None, 0.0, 0.0, text, more=True, **more)
