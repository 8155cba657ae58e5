"""What can be known from given sensors, before anything is estimated.

From the sensitivities of readings (:mod:`estimators.information.sensitivities`) follow

* :func:`identify` : rank, invisible directions in words, bounds, confounded pairs, visible sizes;
* :func:`compare_sensors`, :func:`which_to_add` : the same for several sets of sensors.

A fault is *visible* at the size at which a chi-squared test of one degree of freedom with the
stated false-alarm probability detects it with the stated probability: size^2 I = lambda, the
noncentrality that :func:`noncentrality` solves for.  *Alone*: nothing but this fault and the
nuisances can have changed.  *Among others*: the other faults are unknown too, within their priors.
All of it is first order in the faults.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
import scipy.stats

from apu_casadi.core.errors import ParameterError, SignalError, nearest
from estimators.information.consistency import exceeded
from estimators.information.sensitivities import (
    ENTRY,
    EXACT,
    RECORDING,
    Sensitivities,
    bound_of,
    remainder,
)

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "Identifiability",
    "Mimic",
    "Pair",
    "SensorComparison",
    "compare_sensors",
    "identify",
    "noncentrality",
    "which_to_add",
]

ALIKE = 0.3  # a fault of which a smaller share stands out from others counts as imitated
CORRELATED = 0.9  # estimates whose correlation is beyond this count as confounded


# ---------------------------------------------------------------------- what is seen


def noncentrality(P_fa: float, P_d: float, dof: int = 1) -> float:
    """Return lambda with which a chi-squared test detects with probability P_d.

    The test raises an alarm above the 1 - P_fa quantile of chi2(dof); under the fault the statistic
    is noncentral chi2(dof, lambda) (Kay 1998, Fundamentals of Statistical Signal Processing II,
    section 2.2.3).

    Raises:
        ParameterError: not 0 < P_fa < P_d < 1, or dof not positive.
    """
    if not (0 < P_fa < P_d < 1 and dof >= 1):
        raise ParameterError(
            f"0 < P_fa < P_d < 1 and dof >= 1 expected, got {P_fa!r}, {P_d!r}, {dof!r}"
        )
    limit = float(exceeded(P_fa, dof))

    def missing(lam: float) -> float:
        return float(scipy.stats.ncx2.sf(limit, dof, lam)) - P_d

    high = 4 * (limit + 1)
    while missing(high) < 0:
        high *= 2
    return float(scipy.optimize.brentq(missing, 1e-12, high, xtol=1e-12, rtol=1e-13))


@dataclass(frozen=True)
class Pair:
    """Two faults and how well they are told apart.

    Args:
        first, second: their names.
        angle: between their signatures, degrees, 0 to 90; 0 means that they cannot be told apart if
            only one of the two is there.
        correlation: of their estimates, all faults unknown within their priors; NaN if
            undetermined.
        size: of the first at which it is told from any size of the second, own unit.
    """

    first: str
    second: str
    angle: float
    correlation: float
    size: float

    @property
    def confounded(self) -> bool:
        """Whether angle or correlation say so."""
        return math.sin(math.radians(self.angle)) < ALIKE or abs(self.correlation) > CORRELATED


@dataclass(frozen=True)
class Mimic:
    """A fault that others imitate together.

    Args:
        fault: its name.
        by: amounts of the others, own units, that imitate one ``size`` of the fault best.
        share: of the fault's signature that remains; 0 is a perfect imitation.
    """

    fault: str
    by: tuple[tuple[str, float], ...]
    share: float


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What :func:`identify` found; all in own units, faults in order (nf of them).

    Args:
        given: the sensitivities of the sensors that are there.
        sensors: those sensors.
        singular: of the faults' signatures for changes by ``size``, largest first, shape (nf,):
            standard deviations by which the readings move.
        rank: number of singular values above rounding: directions that show at all.
        rank_in_noise: number above ``threshold``: directions that stand out from the noise.
        invisible: directions of all unknowns that no reading shows, in units of ``size``, shape (n,
            nf - rank); largest entry of the faults is 1.
        unseen: for each such direction the other sensors, not there, that would move, with the
            number of standard deviations.
        weakest: direction of the faults that shows least among those that do, in units of ``size``.
        alone, among: visible sizes, shape (nf,); see the module's text.
        sigma_flat, sigma: bounds without and with priors, shape (nf,); inf where undetermined.
        correlation: of the estimates with priors, shape (nf, nf).
        pairs, mimics: see :class:`Pair`, :class:`Mimic`.
        threshold, P_fa, P_d: as asked for.
    """

    given: Sensitivities
    sensors: tuple[str, ...]
    singular: np.ndarray
    rank: int
    rank_in_noise: int
    invisible: np.ndarray
    unseen: tuple[tuple[tuple[str, float], ...], ...]
    weakest: np.ndarray
    alone: np.ndarray
    among: np.ndarray
    sigma_flat: np.ndarray
    sigma: np.ndarray
    correlation: np.ndarray
    pairs: tuple[Pair, ...]
    mimics: tuple[Mimic, ...]
    threshold: float
    P_fa: float
    P_d: float

    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each fault, for printing."""
        g = self.given
        f = g.theta.indices(g.faults)
        return [
            {
                "fault": name,
                "unit": g.theta[name].unit,
                "doc": g.theta[name].doc,
                "prior": float(g.prior[f[j]]),
                "sigma": float(self.sigma[j]),
                "sigma_flat": float(self.sigma_flat[j]),
                "visible_alone": float(self.alone[j]),
                "visible_among": float(self.among[j]),
            }
            for j, name in enumerate(g.faults)
        ]

    def sentences(self) -> list[str]:
        """Return what can and what cannot be known, in words."""
        g = self.given
        nf = len(g.faults)
        have = f"With {', '.join(self.sensors)}"
        if self.sensors == (RECORDING,):
            have = "From the recording"
        out = []
        if self.rank == nf:
            out.append(f"{have}: every one of {', '.join(g.faults)} shows; nothing is invisible.")
        lost: list[str] = []
        for v, seen in zip(self.invisible.T, self.unseen, strict=True):
            names = [n for n, a in zip(g.theta.names, v, strict=True) if abs(a) > ENTRY]
            order = sorted(names, key=lambda n: (n not in g.faults, -abs(v[g.theta.index(n)])))
            parts = [_amount(g, n, v[g.theta.index(n)]) for n in order]
            whole = parts[0] + (f" together with {_and(parts[1:])}" if parts[1:] else " alone")
            text = f"{have}: {whole} leaves every reading as it is"
            text += f": {_and(order)} cannot be told apart." if len(order) > 1 else "."
            if seen:
                text += " It would show in " + _and(
                    [f"{n} ({abs(s):.2g} standard deviations)" for n, s in seen]
                )
                text += "."
            out.append(text)
            lost += [n for n in order if n in g.faults]
        clear = [n for n in g.faults if n not in lost]
        if lost and clear:
            out.append(f"{_and(clear)} {'is' if len(clear) == 1 else 'are'} free of that.")
        if self.rank:
            parts = [
                _amount(g, n, a)
                for n, a in sorted(
                    zip(g.faults, self.weakest, strict=True), key=lambda q: -abs(q[1])
                )
                if abs(a) > 0.05
            ]
            s = self.singular[self.rank - 1]
            verdict = "lost in the noise" if s < self.threshold else "above the noise"
            what = "The weakest of the visible combinations" if self.rank > 1 else "What shows"
            out.append(
                f"{what}, {_and(parts)}, moves the readings by {s:.2g} standard deviations in all: "
                f"{verdict}."
            )
        return out

    def to_dataset(self) -> xr.Dataset:
        """Return the arrays with names: dimensions fault, other and direction."""
        import xarray as xr

        g = self.given
        angle = np.zeros((len(g.faults),) * 2)
        for p in self.pairs:
            i, j = g.faults.index(p.first), g.faults.index(p.second)
            angle[i, j] = p.angle
        per_fault = {
            "sigma": (self.sigma, "bound on the standard deviation, with priors"),
            "sigma_flat": (self.sigma_flat, "bound without priors"),
            "visible_alone": (self.alone, "visible size, nothing else changed"),
            "visible_among": (self.among, "visible size, the other faults unknown too"),
            "size": (g.size[g.theta.indices(g.faults)], "change of interest"),
            "prior": (g.prior[g.theta.indices(g.faults)], "standard deviation before"),
        }
        data: dict[str, Any] = {
            k: (("fault",), v, {"long_name": doc}) for k, (v, doc) in per_fault.items()
        }
        data |= {
            "correlation": (("fault", "other"), self.correlation, {"long_name": "of estimates"}),
            "angle": (("fault", "other"), angle, {"long_name": "of signatures, degrees"}),
            "singular": (("direction",), self.singular, {"long_name": "of the signatures"}),
        }
        return xr.Dataset(
            data,
            coords={"fault": list(g.faults), "other": list(g.faults)},
            attrs={
                "sensors": ", ".join(self.sensors),
                "rank": self.rank,
                "rank_in_noise": self.rank_in_noise,
                "P_fa": self.P_fa,
                "P_d": self.P_d,
                "threshold": self.threshold,
            },
        )


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _amount(g: Sensitivities, name: str, amount: float) -> str:
    """``f_W_c +1.00 %``: an amount in units of size, as per cent of the nominal value."""
    i = g.theta.index(name)
    return f"{name} {100 * amount * g.size[i] / g.theta[i].nominal:+.2f} %"


def _invisible(g: Sensitivities, M: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return singular values, invisible directions of all unknowns, and the rank."""
    f = g.theta.indices(g.faults)
    n = [i for i in range(len(g.theta)) if i not in f]
    _, s, Vt = np.linalg.svd(M * g.size[f], full_matrices=True)
    s = np.append(s, np.zeros(len(f) - s.size))
    whole = np.linalg.norm(g.J[:, f] * g.size[f], axis=0).max()
    rank = int((s > EXACT * whole).sum()) if whole > 0 else 0
    N = Vt[rank:].T
    if N.shape[1]:
        # the sparsest readable basis: each pivot fault occurs in one direction only
        pivots = list(scipy.linalg.qr(N.T, mode="r", pivoting=True)[1])[: N.shape[1]]
        N = N @ np.linalg.inv(N[pivots])
        N[np.abs(N) < ENTRY] = 0.0
        N = N / N[np.abs(N).argmax(0), range(N.shape[1])]
    out = np.zeros((len(g.theta), N.shape[1]))
    out[f] = N
    if n and N.shape[1]:
        # what the nuisances do along it; those that have a prior stay
        free = [i for i in n if not np.isfinite(g.prior[i])]
        if free:
            B = g.J[:, free] * g.size[free]
            out[free] = -np.linalg.lstsq(B, (g.J[:, f] * g.size[f]) @ N, rcond=EXACT)[0]
            out[np.abs(out) < ENTRY] = 0.0
    return s, out, rank


def identify(
    sensitivities: Sensitivities,
    sensors: Sequence[str] | None = None,
    *,
    threshold: float = 1.0,
    P_fa: float = 1e-3,
    P_d: float = 0.95,
) -> Identifiability:
    """Tell what can be known of the faults.

    Args:
        sensitivities: of all sensors that are thought of.
        sensors: those that are there; all by default.  The others tell what an invisible direction
            would move.
        threshold: standard deviations by which the readings must move for a direction to count as
            above the noise.
        P_fa, P_d: probabilities of false alarm and of detection with which a size is visible.

    Raises:
        SignalError: unknown sensor. ParameterError : impossible probabilities or threshold.
    """
    if not threshold > 0:
        raise ParameterError(f"threshold must be > 0, got {threshold!r}")
    need = math.sqrt(noncentrality(P_fa, P_d))
    g = sensitivities if sensors is None else sensitivities.only(sensors)
    f = g.theta.indices(g.faults)
    nf, size, prior = len(f), g.size[f], g.prior[f]
    M = g.signatures()
    s, directions, rank = _invisible(g, M)
    absent = [r for r in sensitivities.sensors if r not in g.sensors]
    unseen = []
    for v in directions.T:
        moves = [
            (r, float(np.linalg.norm(sensitivities.only([r]).J @ (g.size * v)))) for r in absent
        ]
        unseen.append(tuple((r, a) for r, a in moves if a > 0.01))
    Vt = np.linalg.svd(M * size, full_matrices=True)[2]
    weakest = Vt[rank - 1] if rank else np.zeros(nf)
    if rank:
        weakest = weakest / weakest[np.abs(weakest).argmax()]
    alone, among = _visible(M, size, prior, need)
    C = bound_of(M, size, prior)
    sigma = np.sqrt(np.diag(C))
    with np.errstate(invalid="ignore"):
        correlation = C / np.outer(sigma, sigma)
    correlation[range(nf), range(nf)] = 1.0
    return Identifiability(
        given=g,
        sensors=g.sensors,
        singular=s,
        rank=rank,
        rank_in_noise=int((s[:rank] > threshold).sum()),
        invisible=directions,
        unseen=tuple(unseen),
        weakest=weakest,
        alone=alone,
        among=among,
        sigma_flat=np.sqrt(np.diag(bound_of(M, size, np.full(nf, np.inf)))),
        sigma=sigma,
        correlation=correlation,
        pairs=_pairs(g.faults, M, correlation, need),
        mimics=_mimics(g.faults, M, size),
        threshold=threshold,
        P_fa=P_fa,
        P_d=P_d,
    )


def _over(need: float, a: float, whole: float) -> float:
    return need / a if a > EXACT * whole else math.inf


def _visible(
    M: np.ndarray, size: np.ndarray, prior: np.ndarray, need: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return visible sizes alone and among the others."""
    nf = size.size
    # a signature that the nuisances swallow whole is rounding beside the others
    whole = float(np.linalg.norm(M * size, axis=0).max(initial=0.0))
    P = np.diag(np.where(np.isfinite(prior), 1 / prior, 0.0))
    A = np.vstack([M, P])
    alone, among = np.empty(nf), np.empty(nf)
    for j in range(nf):
        others = [i for i in range(nf) if i != j]
        own = np.append(M[:, j], np.zeros(nf))[:, None]
        rest = remainder(own, A[:, others] * size[others])
        limit = whole / size[j]
        alone[j] = _over(need, float(np.linalg.norm(M[:, j])), limit)
        among[j] = _over(need, float(np.linalg.norm(rest)), limit)
    return alone, among


def _pairs(
    faults: tuple[str, ...], M: np.ndarray, correlation: np.ndarray, need: float
) -> tuple[Pair, ...]:
    out = []
    length = np.linalg.norm(M, axis=0)
    for i, j in itertools.permutations(range(len(faults)), 2):
        rest = float(np.linalg.norm(remainder(M[:, [i]], M[:, [j]])))
        share = rest / length[i] if length[i] > 0 else 0.0
        angle = math.degrees(math.asin(min(share, 1.0)))
        out.append(
            Pair(
                faults[i],
                faults[j],
                angle,
                float(correlation[i, j]),
                _over(need, rest, float(length[i])),
            )
        )
    return tuple(out)


def _mimics(faults: tuple[str, ...], M: np.ndarray, size: np.ndarray) -> tuple[Mimic, ...]:
    """Smallest groups of other faults that imitate each fault."""
    out: list[Mimic] = []
    for j, name in enumerate(faults):
        others = [i for i in range(len(faults)) if i != j]
        target = M[:, j] * size[j]
        length = float(np.linalg.norm(target))
        best = 1.0
        for n in range(1, len(others) + 1):
            for group in itertools.combinations(others, n):
                B = M[:, list(group)] * size[list(group)]
                amounts = np.linalg.lstsq(B, target, rcond=EXACT)[0]
                rest = float(np.linalg.norm(target - B @ amounts))
                share = rest / length if length > 0 else 0.0
                # a larger group counts only if it imitates much better
                if share < ALIKE and (share < 0.5 * best and best > ENTRY):
                    best = share
                    by = tuple(
                        (faults[i], float(a * size[i])) for i, a in zip(group, amounts, strict=True)
                    )
                    out.append(Mimic(name, by, share))
    return tuple(out)


# ---------------------------------------------------------------------- which sensors


@dataclass(frozen=True, eq=False)
class SensorComparison:
    """Bounds and visible sizes for several sets of sensors.

    Args:
        faults: names; nf of them.
        sets: ``{label: Identifiability}`` in the order asked for.
    """

    faults: tuple[str, ...]
    sets: dict[str, Identifiability]

    def __getitem__(self, label: str) -> Identifiability:
        """Return one set's findings; SignalError with the nearest label if there is none."""
        if label not in self.sets:
            raise SignalError(f"unknown sensor set {label!r} {nearest(label, self.sets)}")
        return self.sets[label]

    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each set and fault, for printing."""
        return [
            {"set": label, "rank": r.rank, "rank_in_noise": r.rank_in_noise, **row}
            for label, r in self.sets.items()
            for row in r.rows()
        ]

    def to_dataset(self) -> xr.Dataset:
        """Return bounds and visible sizes over the dimensions set and fault."""
        import xarray as xr

        fields = ("sigma", "sigma_flat", "alone", "among")
        data: dict[str, Any] = {
            k: (("set", "fault"), np.array([getattr(r, k) for r in self.sets.values()]))
            for k in fields
        }
        data["rank"] = (("set",), [r.rank for r in self.sets.values()])
        return xr.Dataset(data, coords={"set": list(self.sets), "fault": list(self.faults)})


def compare_sensors(
    sensitivities: Sensitivities, sets: Mapping[str, Sequence[str]], **options: float
) -> SensorComparison:
    """Tell what several sets of sensors can know.

    Args:
        sensitivities: of all sensors.
        sets: sensors by label.
        options: of :func:`identify`.

    Raises:
        SignalError, ParameterError: see :func:`identify`.
    """
    found = {label: identify(sensitivities, names, **options) for label, names in sets.items()}
    return SensorComparison(sensitivities.faults, found)


def which_to_add(
    sensitivities: Sensitivities,
    base: Sequence[str],
    candidates: Sequence[str] | None = None,
    **options: float,
) -> list[dict[str, Any]]:
    """Tell which further sensor makes each fault visible at the smallest size.

    Args:
        sensitivities: of all sensors.
        base: sensors that are there.
        candidates: sensors that may be added, one at a time; all others by default.
        options: of :func:`identify`.

    Returns:
        One row for each fault: ``add`` (None if none of them makes the size smaller by 1 %),
        ``before`` and ``after`` (visible sizes among the other faults), ``sigma_before`` and
        ``sigma_after``, and ``ranking``: all candidates with the size that each gives, best first.

    Raises:
        SignalError, ParameterError: see :func:`identify`.
    """
    more = [s for s in sensitivities.sensors if s not in base] if candidates is None else candidates
    before = identify(sensitivities, base, **options)
    after = {c: identify(sensitivities, [*base, c], **options) for c in more}
    rows = []
    for j, name in enumerate(sensitivities.faults):
        ranking = sorted(
            ((c, float(r.among[j]), float(r.sigma[j])) for c, r in after.items()),
            key=lambda q: (q[1], q[2]),
        )
        useful = [q for q in ranking if q[1] < 0.99 * before.among[j]]
        best = useful[0] if useful else None
        rows.append(
            {
                "fault": name,
                "add": best[0] if best else None,
                "before": float(before.among[j]),
                "after": best[1] if best else float(before.among[j]),
                "sigma_before": float(before.sigma[j]),
                "sigma_after": best[2] if best else float(before.sigma[j]),
                "ranking": [(c, size) for c, size, _ in ranking],
            }
        )
    return rows
