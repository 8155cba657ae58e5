"""One filter for the whole unit at 10 kHz: the check of the coupled pair on a short window.

All that the two filters of :mod:`estimators.apu.joint` know apart is here one state: fluxes,
rotor angle and severities of the generator, rotor speed and health factors of the gas generator,
coupled by eqs. (1) and (2) at every sample instead of every 20 ms.  Nothing is handed over, so no
correlation can be lost on the way.  The cycle is solved two hundred times as often; that is why it
is a check.

The error of a fuel reading holds for 20 ms.  It is a state, drawn anew with every reading.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from apu_casadi.core.sharing import Parametric, kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.electricalfilter import ElectricalFilter, electrical_filter
from estimators.apu.electrical.tracking import window_power
from estimators.apu.gaspath import GasPathFilter, gas_path_filter, samples
from estimators.apu.gaspathmodel import DT, GOVERNOR, engine_function
from estimators.apu.joint import better_speed, electrical_samples, speed_from_generators
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
        electrical, gas: the filters that it stands for; gains, inertia and efficiency known.
        model: their one model.
    """

    apu: Apu
    electrical: ElectricalFilter
    gas: GasPathFilter
    model: FilterModel

    def recording(
        self, fast: Recording, slow: Recording, w_r: np.ndarray, sigma: float
    ) -> Recording:
        """Merge the recordings of both filters and the pick-ups' speed, (K,) with its sigma.

        The gas path's instants must be among the electrical ones.
        """
        m, K = self.model, fast.size
        at = np.searchsorted(fast.t, slow.t - 1e-9)
        row = np.searchsorted(slow.t, fast.t + 1e-9, side="right") - 1
        ne = len(self.electrical.model.u)
        u = np.zeros((len(m.u), K))
        u[:ne] = fast.u
        for n in ("Wf", "sigma_Wf", *AMBIENT):
            u[m.u.index(n)] = slow.u[self.gas.model.u.index(n), row]
        u[m.u.index("since")] = fast.t - slow.t[row]
        u[m.u.index("fresh"), at[1:] - 1] = 1.0
        y, variance = np.full((len(m.y), K), np.nan), np.ones((len(m.y), K))
        y[:4], variance[:4] = fast.y, fast.variance
        y[4], variance[4] = w_r, sigma**2
        y[5:, at], variance[5:, at] = slow.y, slow.variance
        return Recording(fast.t, u, y, variance, np.zeros(0))

    def prior(self, electrical: Belief, gas: Belief) -> Belief:
        """Put the beliefs of both filters together, uncorrelated."""
        P = np.zeros((len(self.model.x), len(self.model.x)))
        n, k = len(electrical.mean), len(electrical.mean) + len(gas.mean)
        P[:n, :n], P[n:k, n:k], P[k, k] = electrical.cov, gas.cov, 1.0
        return Belief(self.model.x, np.concatenate([electrical.mean, gas.mean, [0.0]]), P)

    def run(self, prior: Belief, data: Recording, *, backend: str | None = None) -> FilterResult:
        """Filter a recording."""
        return extended_kalman_filter(self.model, prior, data, full=True, backend=backend)


@kept
def monolithic_filter(apu: Apu, electrical: ElectricalFilter, gas: GasPathFilter) -> Monolithic:
    """Make the filter of the whole unit from its two parts.

    Args:
        apu: the unit.
        electrical: with ``power=True`` and without gains.
        gas: with measured power, without gains, inertia or efficiency among its states.
    """
    me, mg, gg = electrical.model, gas.model, gas.gg
    kept_w = [i for i, n in enumerate(me.w.names) if n != "w_w_r"]
    X = me.x + mg.x + Signals([_ERROR])
    U = me.u + Signals([*(mg.u[n] for n in ("Wf", "sigma_Wf", *AMBIENT)), _SINCE, _FRESH])
    W = Signals([*(me.w[i] for i in kept_w), Signal("w_Wf", "1", "error of the next fuel reading")])
    Y = Signals([*me.y, dataclasses.replace(me.u["w_r"], default=None), *mg.y])
    x, u, w = (ca.MX.sym(n, len(s)) for n, s in (("x", X), ("u", U), ("w", W)))
    p, dt = ca.MX.sym("p", 0), ca.MX.sym("dt")
    ne = len(me.x)
    at = dict(zip(X.names, ca.vertsplit(x), strict=True))
    given = dict(zip(U.names, ca.vertsplit(u), strict=True))
    N, health = at["N"], ca.vertcat(*(at[n] for n in HEALTH))
    # the generator at the speed of the rotor, (2)
    known = dict(zip(me.u.names, ca.vertsplit(u[: len(me.u)]), strict=True))
    u_e = me.u.stack(known | {"w_r": apu.w_r(N), "keep": ca.MX(0)})
    w_e = ca.MX.zeros(len(me.w))
    for j, i in enumerate(kept_w):
        w_e[i] = w[j]
    x_e, check_e = me.transition(x[:ne], u_e, p, w_e, dt)
    y_e, _ = me.output(x[:ne], u_e, p, w_e)
    # its power of this step loads the rotor, (1)
    energy = me.x.index("energy")
    PW = apu.PW(x_e[energy]) / ca.fmax(dt, 1e-12)
    Wf = given["Wf"] - given["sigma_Wf"] * at["error_Wf"]
    engine = engine_function(gg.cycle)
    inputs: dict[str, Any] = {n: given[n] for n in AMBIENT} | {"PW": PW, "Wf": Wf}
    _, y_g, check_y, _ = engine(N, gg.U.stack(inputs | {"PW": ca.MX(0)}), health)
    k1, _, check, _ = engine(N, gg.U.stack(inputs), health)
    slope = GOVERNOR.slope(N, k1, gg.parameters.N)
    now = inputs | {"Wf": Wf + given["since"] * slope}
    k2, _, check_2, _ = engine(N, gg.U.stack(now), health)
    error = (1 - given["fresh"]) * at["error_Wf"] + given["fresh"] * w[len(W) - 1]
    x1 = ca.vertcat(x_e, N + dt * k2, health, error)
    y = ca.vertcat(y_e, apu.w_r(N), N, y_g)
    step, output = (x1, check_e + check + check_2), (y, check_y)
    model = FilterModel.of("unit", (X, U, Signals(), W, Y), (x, u, p, w, dt), step, output)
    walks = zip(X.names, np.concatenate([me.walk, mg.walk, [0.0]]), strict=True)
    model = model.with_walk(dict(walks))
    return Monolithic(apu, electrical, gas, model)


def compare_monolithic(ds: xr.Dataset, seed: int, *, apu: Apu | None = None) -> dict[str, Any]:
    """Estimate a short joint run with the coupled filters and with the monolithic one.

    Both get the same samples and priors; gains, inertia and efficiency are known, no fault is
    looked for beyond h.

    Args:
        ds: from :func:`apu_casadi.unit.multirate.simulate_joint` with ``waveform_dt=1e-4``.
        seed: of the noise.
        apu: the unit.

    Returns:
        For N, the factors and h_a, h_b, h_c: ``difference_max``, largest difference of the means
        over the coupled sigma, from the fifth window on; ``sigma_ratio``, monolithic over coupled
        at the end.  ``correlation``: largest correlation of an electrical with a gas-path state at
        the end, which the coupled pair does not carry.
    """
    apu = Apu() if apu is None else apu
    electrical = electrical_filter(apu.generator.machine, power=True)
    gas = gas_path_filter(apu.gas_generator, gains=False, inertia=None)
    samples_fast = electrical_samples(ds, apu, np.random.default_rng([seed, 1]))
    t, _ = samples(ds)
    fast = electrical.recording(samples_fast, window=DT, start=float(t[0]))
    first = electrical.prior(samples_fast)
    found = extended_kalman_filter(electrical.model, first, fast)
    _, P, var = window_power(electrical, found, fast)
    slow = gas.recording(
        ds,
        np.random.default_rng([seed, 2]),
        power=(apu.PW(P), np.sqrt(var) / apu.coupling.eta_gtSg),
    )
    sigma = ELECTRICAL.sigma("w_r", float(np.median(samples_fast["w_r"])))
    speed = speed_from_generators(samples_fast["t"], samples_fast["w_r"], sigma, t, apu)
    before = gas.prior()
    pair = gas.run(better_speed(gas, slow, *speed), prior=before)
    whole = monolithic_filter(apu, electrical, gas)
    data = whole.recording(fast, slow, samples_fast["w_r"], sigma)
    one = whole.run(whole.prior(first, before), data)
    assert one.cov is not None
    at = np.searchsorted(one.t, t - 1e-9)
    out: dict[str, Any] = {}
    for n in ("N", *HEALTH):
        (m, s), (m2, s2) = one[n], pair[n]
        out[n] = {
            "difference_max": float(np.abs((m[at] - m2) / s2)[5:].max()),
            "sigma_ratio": float(s[-1] / s2[-1]),
        }
    for n in ("h_a", "h_b", "h_c"):
        (m, s), (m2, s2) = one[n], found[n]
        out[n] = {
            "difference_max": float(np.abs((m - m2) / s2)[at[5] :].max()),
            "sigma_ratio": float(s[-1] / s2[-1]),
        }
    C = one.cov[-1]
    size = np.sqrt(np.maximum(np.diag(C), np.finfo(float).tiny))
    e = len(electrical.model.x)
    out["correlation"] = float(np.abs(C / np.outer(size, size))[:e, e:].max())
    return out
