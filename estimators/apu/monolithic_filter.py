"""One filter for the whole unit at 10 kHz: the check of the coupled pair on a short window.

All that the two filters of :mod:`estimators.apu.joint` know apart is here one state: fluxes,
rotor angle and severities of the generators, rotor speed and health factors of the gas generator,
coupled by eqs. (1) and (2) at every sample instead of every 20 ms.  Equal generators with equal
loads are one; of others each has its own part, named ``generator2.h_a``.  Nothing is handed over,
so no correlation can be lost on the way.  The cycle is solved two hundred times as often; that is
why it is a check.

The error of a fuel reading holds for 20 ms.  It is a state, drawn anew with every reading.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import DataError, EstimationError
from apu_casadi.core.results import GENERATOR, of_generator
from apu_casadi.core.sharing import Parametric, keep, kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.apu import Apu, CouplingParameters
from apu_casadi.unit.events import who
from apu_casadi.unit.exchange import Link
from apu_casadi.unit.jointfamily import of_group
from estimators.apu.electrical.electricalfilter import ElectricalFilter, electrical_filter
from estimators.apu.electrical.tracking import window_power
from estimators.apu.gaspath import GasPathFilter, gas_path_filter, samples
from estimators.apu.gaspathmodel import DT, GOVERNOR, engine_function
from estimators.apu.joint import better_speed, electrical_samples, speed_from_generators, unit_of
from estimators.apu.sensors import ELECTRICAL
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.filtering import FilterResult
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Monolithic", "compare_monolithic", "monolithic_filter"]

_ERROR = Signal("error_Wf", "1", "error of the last fuel reading over its standard deviation")
_SINCE = Signal("since", "s", "time since the last fuel reading", default=0.0, nominal=0.02)
_FRESH = Signal("fresh", "1", "1 in the step before a fuel reading", default=0.0)


@dataclass(frozen=True, eq=False)
class Monolithic(Parametric):
    """The filter of the whole unit.

    Args:
        apu: the unit.
        electrical, gas: the filters that it stands for, the first of each group of equal
            generators; gains, inertia and efficiency known.
        model: their one model.
        of: numbers of the generators of each group.
    """

    apu: Apu
    electrical: tuple[ElectricalFilter, ...]
    gas: GasPathFilter
    model: FilterModel
    of: tuple[tuple[int, ...], ...]

    def recording(
        self,
        fast: Sequence[Recording],
        slow: Recording,
        w_r: Sequence[np.ndarray],
        sigma: Sequence[float],
    ) -> Recording:
        """Merge the recordings of all filters and the pick-ups' speeds, (K,) with their sigmas.

        One of each for each group; the gas path's instants must be among the electrical ones.

        Raises:
            DataError: another number of recordings, or other instants.
        """
        t = fast[0].t
        if not len(fast) == len(w_r) == len(sigma) == len(self.of):
            raise DataError(f"{len(self.of)} recordings with speed expected, got {len(fast)}")
        if any(not np.array_equal(f.t, t) for f in fast[1:]):
            raise DataError("the generators were sampled at other instants")
        m, K = self.model, t.size
        at = np.searchsorted(t, slow.t - 1e-9)
        row = np.searchsorted(slow.t, t + 1e-9, side="right") - 1
        u, y = np.zeros((len(m.u), K)), np.full((len(m.y), K), np.nan)
        variance = np.ones((len(m.y), K))
        u[: sum(len(f.u) for f in fast)] = np.concatenate([f.u for f in fast])
        for name in ("Wf", "sigma_Wf", *AMBIENT):
            u[m.u.index(name)] = slow.u[self.gas.model.u.index(name), row]
        u[m.u.index("since")] = t - slow.t[row]
        u[m.u.index("fresh"), at[1:] - 1] = 1.0
        k = 0
        for f, own, deviation in zip(fast, w_r, sigma, strict=True):
            n = len(f.y)
            y[k : k + n], variance[k : k + n] = f.y, f.variance
            y[k + n], variance[k + n] = own, deviation**2
            k += n + 1
        y[k:, at], variance[k:, at] = slow.y, slow.variance
        return Recording(t, u, y, variance, np.zeros(0))

    def prior(self, electrical: Sequence[Belief], gas: Belief) -> Belief:
        """Put the beliefs of all filters together, uncorrelated."""
        P, k = np.zeros((len(self.model.x), len(self.model.x))), 0
        for belief in (*electrical, gas):
            n = len(belief.mean)
            P[k : k + n, k : k + n] = belief.cov
            k += n
        P[k, k] = 1.0
        mean = np.concatenate([*(b.mean for b in electrical), gas.mean, [0.0]])
        return Belief(self.model.x, mean, P)

    def run(self, prior: Belief, data: Recording, *, backend: str | None = None) -> FilterResult:
        """Filter a recording."""
        return extended_kalman_filter(self.model, prior, data, full=True, backend=backend)


def _prefix(numbers: tuple[int, ...], alone: bool) -> str:
    return "" if alone else f"generator{numbers[0]}."


def _kept_noises(me: FilterModel) -> list[int]:
    """Positions of an electrical filter's noises but that of the speed, which is the rotor's."""
    return [i for i, n in enumerate(me.w.names) if n != "w_w_r"]


def _signals(
    of: Sequence[tuple[int, ...]], models: Sequence[FilterModel], mg: FilterModel
) -> tuple[Signals, Signals, Signals, Signals]:
    """Return x, u, w and y of the unit."""
    x, u, w, y = list[Signal](), list[Signal](), list[Signal](), list[Signal]()
    for k, me in zip(of, models, strict=True):
        speed = dataclasses.replace(me.u["w_r"], default=None)
        parts = ([*me.x], [*me.u], [me.w[i] for i in _kept_noises(me)], [*me.y, speed])
        for all_of, own in zip((x, u, w, y), parts, strict=True):
            all_of += of_group(own, _prefix(k, len(of) == 1), k)
    fuel = (mg.u[n] for n in ("Wf", "sigma_Wf", *AMBIENT))
    w.append(Signal("w_Wf", "1", "error of the next fuel reading"))
    return (
        Signals([*x, *mg.x, _ERROR]),
        Signals([*u, *fuel, _SINCE, _FRESH]),
        Signals(w),
        Signals([*y, *mg.y]),
    )


@kept
def monolithic_filter(
    apu: Apu,
    electrical: ElectricalFilter | tuple[ElectricalFilter, ...],
    gas: GasPathFilter,
    of: tuple[tuple[int, ...], ...] | None = None,
) -> Monolithic:
    """Make the filter of the whole unit from its parts.

    Args:
        apu: the unit.
        electrical: with ``power=True`` and without gains; of all generators, or of each group.
        gas: with measured power, without gains, inertia or efficiency among its states.
        of: numbers of the generators of each group; default all in one, or each on its own.

    Raises:
        EstimationError: another number of filters than groups, or a generator in none or in two.
    """
    each = (electrical,) if isinstance(electrical, ElectricalFilter) else tuple(electrical)
    numbers = tuple(range(1, len(apu.machines) + 1))
    if of is None:
        of = (numbers,) if len(each) == 1 else tuple((k,) for k in numbers)
    if len(of) != len(each) or sorted(k for group in of for k in group) != [*numbers]:
        raise EstimationError(
            f"{len(each)} electrical filters for generators {of}: one for each group is needed, "
            f"and each of the generators 1 to {len(numbers)} in one of them"
        )
    for group in of:
        if len({apu.machines[k - 1] for k in group}) > 1:
            raise EstimationError(
                f"{who(group)} differ: one electrical filter cannot stand for them"
            )
    if gas.model.x.names != (*gas.gg.X.names, *HEALTH) or any(len(f.model.p) for f in each):
        raise EstimationError(
            "the filter of the whole unit takes a gas-path filter without gains, inertia or "
            "efficiency among its states, and electrical filters with all three severities"
        )
    whole = _family(gas.gg, gas.model, of, [f.model for f in each])
    held = dict(gas.model.held)
    for group, f in zip(of, each, strict=True):
        gear = apu.machines[group[0] - 1].coupling.held("coupling")
        prefix = _prefix(group, len(of) == 1)
        held |= {prefix + n: v for n, v in (f.model.held | gear).items()}
    return Monolithic(apu, each, gas, whole.member(held), of)


def _family(
    gg: GasGenerator,
    mg: FilterModel,
    of: tuple[tuple[int, ...], ...],
    models: Sequence[FilterModel],
) -> FilterModel:
    """The model of all units of a structure, made once, with their numbers as parameters."""
    shared = tuple(m.shared for m in models)
    return keep(gg.family, _family, (mg.shared, of, shared), lambda: _all_units(gg, mg, of, shared))


def _all_units(
    gg: GasGenerator,
    mg: FilterModel,
    of: tuple[tuple[int, ...], ...],
    models: Sequence[FilterModel],
) -> FilterModel:
    X, U, W, Y = _signals(of, models, mg)
    engine_numbers, own = mg.shared.p, _numbers(of, models)
    P = Signals([*engine_numbers, *(s for numbers in own for s in numbers)])
    x, u, p, w = (ca.MX.sym(n, len(s)) for n, s in zip("xupw", (X, U, P, W), strict=True))
    dt = ca.MX.sym("dt")
    at, given, value = (
        dict(zip(s.names, ca.vertsplit(v), strict=True)) for s, v in ((X, x), (U, u), (P, p))
    )
    N, health = at["N"], ca.vertcat(*(at[n] for n in HEALTH))
    moved, seen, checks, power = [], [], [], []
    i = j = n = 0
    for group, me, numbers in zip(of, models, own, strict=True):
        ne, keep_w, prefix = len(me.x), _kept_noises(me), _prefix(group, len(of) == 1)
        gear = {k: value[f"{prefix}coupling.{k}"] for k in ("gear", "eta_gtSg")}
        n_pp = value[f"{prefix}machine.n_pp"]
        link = Link(GOVERNOR, value["gas_generator.N"], **gear, n_pp=n_pp, pairs=len(group) / 2)
        p_e = p[P.indices(numbers.names[: len(me.p)])]
        # the generators at the speed of the rotor, (2)
        known = dict(zip(me.u.names, ca.vertsplit(u[j : j + len(me.u)]), strict=True))
        u_e = me.u.stack(known | {"w_r": link.w_r(N), "keep": ca.MX(0)})
        w_e = ca.MX.zeros(len(me.w))
        for k, place in enumerate(keep_w):
            w_e[place] = w[n + k]
        x_e, check_e = me.transition(x[i : i + ne], u_e, p_e, w_e, dt)
        y_e, _ = me.output(x[i : i + ne], u_e, p_e, w_e)
        moved.append(x_e)
        seen += [y_e, link.w_r(N)]
        checks.append(check_e)
        power.append(link.PW(x_e[me.x.index("energy")]) / ca.fmax(dt, 1e-12))
        i, j, n = i + ne, j + len(me.u), n + len(keep_w)
    # their power of this step loads the rotor, (1)
    PW = sum(power[1:], power[0])
    Wf = given["Wf"] - given["sigma_Wf"] * at["error_Wf"]
    function, theta = engine_function(gg.family), ca.vertcat(health, p[: len(engine_numbers)])
    inputs: dict[str, Any] = {n: given[n] for n in AMBIENT} | {"PW": PW, "Wf": Wf}
    _, y_g, check_y, _ = function(N, gg.U.stack(inputs | {"PW": ca.MX(0)}), theta)
    k1, _, check, _ = function(N, gg.U.stack(inputs), theta)
    slope = GOVERNOR.slope(N, k1, value["gas_generator.N"])
    now = inputs | {"Wf": Wf + given["since"] * slope}
    k2, _, check_2, _ = function(N, gg.U.stack(now), theta)
    error = (1 - given["fresh"]) * at["error_Wf"] + given["fresh"] * w[len(W) - 1]
    x1 = ca.vertcat(*moved, N + dt * k2, health, error)
    y = ca.vertcat(*seen, N, y_g)
    step, output = (x1, sum(checks[1:], checks[0]) + check + check_2), (y, check_y)
    model = FilterModel.of("unit", (X, U, P, W, Y), (x, u, p, w, dt), step, output)
    walk = np.concatenate([*(me.walk for me in models), mg.walk, [0.0]])
    return model.with_walk(dict(zip(X.names, walk, strict=True)))


def _numbers(of: Sequence[tuple[int, ...]], models: Sequence[FilterModel]) -> list[Signals]:
    """Numbers of the machine, and of the gear behind them, of each group."""
    gear = CouplingParameters().signals("coupling")
    each = zip(of, models, strict=True)
    return [Signals(of_group([*me.p, *gear], _prefix(k, len(of) == 1), k)) for k, me in each]


class _Side(NamedTuple):
    """The electrical filter of a group of generators along a run."""

    prefix: str
    numbers: tuple[int, ...]
    filt: ElectricalFilter
    samples: Mapping[str, np.ndarray]
    data: Recording
    prior: Belief
    found: FilterResult
    power: tuple[np.ndarray, np.ndarray]
    sigma: float


def _sides(ds: xr.Dataset, seed: int, apu: Apu, start: float) -> list[_Side]:
    numbers = tuple(range(1, len(apu.machines) + 1))
    of = [(k,) for k in numbers] if GENERATOR in ds.dims else [numbers]
    made = []
    for group in of:
        k, alone = group[0], len(of) == 1
        unit = unit_of(apu, k)
        filt = electrical_filter(unit.generator.machine, power=True)
        rng = np.random.default_rng([seed, 1] if k == 1 else [seed, 1, k])
        samples = electrical_samples(of_generator(ds, k), unit, rng)
        data = filt.recording(samples, window=DT, start=start)
        first = filt.prior(samples)
        found = extended_kalman_filter(filt.model, first, data)
        _, P, var = window_power(filt, found, data)
        sigma = ELECTRICAL.sigma("w_r", float(np.median(samples["w_r"])))
        prefix = "" if alone else f"generator{k}."
        made.append(_Side(prefix, group, filt, samples, data, first, found, (P, var), sigma))
    return made


def compare_monolithic(ds: xr.Dataset, seed: int, *, apu: Apu | None = None) -> dict[str, Any]:
    """Estimate a short joint run with the coupled filters and with the monolithic one.

    Both get the same samples and priors; gains, inertia and efficiency are known, no fault is
    looked for beyond h.

    Args:
        ds: from :func:`apu_casadi.unit.multirate.simulate_joint` with ``waveform_dt=1e-4``.
        seed: of the noise.
        apu: the unit.

    Returns:
        For N, the factors and h_a, h_b, h_c (of each generator where they differ,
        ``generator2.h_a``): ``difference_max``, largest difference of the means over the coupled
        sigma, from the fifth window on; ``sigma_ratio``, monolithic over coupled at the end.
        ``correlation``: largest correlation of an electrical with a gas-path state at the end,
        which the coupled pair does not carry.
    """
    apu = Apu() if apu is None else apu
    gas = gas_path_filter(apu.gas_generator, gains=False, inertia=None)
    t, _ = samples(ds)
    sides = _sides(ds, seed, apu, float(t[0]))
    links = [apu.link_of(s.numbers) for s in sides]
    PW = sum(link.PW(x.power[0]) for link, x in zip(links, sides, strict=True))
    var = sum(link.PW(1.0) ** 2 * x.power[1] for link, x in zip(links, sides, strict=True))
    slow = gas.recording(ds, np.random.default_rng([seed, 2]), power=(PW, np.sqrt(var)))
    better = slow
    for side in sides:
        own, unit = side.samples, unit_of(apu, side.numbers[0])
        speed = speed_from_generators(own["t"], own["w_r"], side.sigma, t, unit)
        better = better_speed(gas, better, *speed)
    before = gas.prior()
    pair = gas.run(better, prior=before)
    filters, of = tuple(x.filt for x in sides), tuple(x.numbers for x in sides)
    whole = monolithic_filter(apu, filters, gas, of)
    speeds, sigmas = [x.samples["w_r"] for x in sides], [x.sigma for x in sides]
    data = whole.recording([x.data for x in sides], slow, speeds, sigmas)
    one = whole.run(whole.prior([x.prior for x in sides], before), data)
    assert one.cov is not None
    at = np.searchsorted(one.t, t - 1e-9)
    out: dict[str, Any] = {}
    for n in ("N", *HEALTH):
        (m, s), (m2, s2) = one[n], pair[n]
        out[n] = {
            "difference_max": float(np.abs((m[at] - m2) / s2)[5:].max()),
            "sigma_ratio": float(s[-1] / s2[-1]),
        }
    for side in sides:
        for n in ("h_a", "h_b", "h_c"):
            (m, s), (m2, s2) = one[f"{side.prefix}{n}"], side.found[n]
            out[f"{side.prefix}{n}"] = {
                "difference_max": float(np.abs((m - m2) / s2)[at[5] :].max()),
                "sigma_ratio": float(s[-1] / s2[-1]),
            }
    C = one.cov[-1]
    size = np.sqrt(np.maximum(np.diag(C), np.finfo(float).tiny))
    e = sum(len(x.filt.model.x) for x in sides)
    out["correlation"] = float(np.abs(C / np.outer(size, size))[:e, e:].max())
    return out
