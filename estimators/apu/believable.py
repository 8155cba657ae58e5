"""Whether an estimate is to be believed, and if not, why: the rule is never to be silently wrong.

Every doubt is a sentence with its ``kind``:

============== =================================================================================
innovations    larger than model and stated noise explain, in all or in a window, by sensor
colour         innovations that are not white: a mean, a drift, neighbours that are alike
wild           single readings far out
sensor         one that stands still or is clipped
prior          a gain error, inertia or efficiency farther off than was stated
machine        several phases, or a negative severity; changes that no load and no fault explains
harmonics      in the currents, not in the voltages
linearisation  beyond what the filters were tried on
maps           an operating point off the component maps
power          of the two sides, or of the short circuit that may be there
time           rate and order of the samples
lost           a filter that its model does not fit: there is no estimate
============== =================================================================================

The thresholds come from :data:`LEVEL`, the probability that a group of tests doubts an estimate
whose model holds; the group's tests share it (Bonferroni), so that it is kept however they are
correlated.  What follows by logic (a phase current with a hole in it, three faulty phases) has no
level.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.park import PHASE_ANGLE, PHASES
from estimators.apu.creeping import Creep, creep, quiet_of
from estimators.apu.electrical.causes import PRIOR, Causes, causes_of_change, onset_of
from estimators.apu.electrical.residuals import field_steps, unexplained_waves
from estimators.apu.electrical.smallchanges import OffsetStep, offset_steps, severity_changes
from estimators.apu.electrical.terminalsignals import MEASURED, PHASES_V
from estimators.apu.gascauses import causes_of_alarms
from estimators.apu.gaspathmodel import DT, engine_function
from estimators.apu.healthjumps import Tracked, judged
from estimators.apu.recorded_report import SURE, Z95
from estimators.apu.trust import GAS, Doubt, part_of, severity
from estimators.information.innovationtests import Finding, findings, least

if TYPE_CHECKING:
    from apu_casadi.machine.machinedata import MachineParameters
    from estimators.apu.fitting import EngineFit
    from estimators.apu.gaspath import GasPathFilter
    from estimators.apu.joint import ElectricalSide
    from estimators.apu.recordings.measured import Measurements
    from estimators.apu.sensors import SensorSet

__all__ = [
    "KINDS",
    "LEVEL",
    "Still",
    "channels_still",
    "fit_doubts",
    "gas_causes",
    "gas_doubts",
    "lost",
    "machine_causes",
    "machine_doubts",
    "standing_still",
    "still_causes",
    "without_still",
]

KINDS = (
    *("innovations", "colour", "wild", "sensor", "prior", "machine"),
    *("harmonics", "linearisation", "maps", "power", "time", "lost"),
)
#: Probability that a group of tests doubts an estimate whose model holds: of a recording the gas
#: path is one group, and each generator two.
LEVEL = 1e-3
MARGIN = (
    1.1  # on the variance of the gas path's innovations, for maps and gas data of another engine
)
STEEP = 0.1  # change of a factor beyond which no filter was tried
SEVERAL = 25.0  # chi-squared of two degrees of freedom that one faulty phase may leave
STEEP_FIT = 0.2  # the same of a fit, which is linearised where it ends
STEEP_H = 0.03  # the same of a severity
RESTLESS = 0.1  # s, in which the electrical filter begins anew three times only if it is wrong
MOST_JUMPS = 8
RECENT = 0.1  # s, before a report, in which a reset is its own
SLOWLY = 0.06  # s, before a report, in which a short circuit came that made no reset
SLIP = 1.5  # rad; the angle between voltage and rotor of a machine in step changes by less
FEWEST_SAMPLES = 100
FEWEST_STILL = 20
MOST_CAUSES = 3  # changes of a generator of which the cause is told
SURELY = 0.5  # probability below which a report is doubted
OFF_MAP = ("off_c", "off_t")


# ------------------------------------------------------------------------------ channels


class Still(NamedTuple):
    """A sensor that stands still: its name, from when until when, what that makes doubtful."""

    name: str
    t: float
    end: float
    doubt: Doubt


def channels_still(m: Measurements, table: SensorSet, coarse: Collection[str] = ()) -> list[Still]:
    """Say which sensors stand still while most others move.

    Args:
        m, table: readings and sensors of the gas path.
        coarse: sensors whose digits are wider than their noise, which stand still often.
    """
    used, out = (*table.names, *m.electrical), []
    sensors = {n: c for n, c in m.items() if n in used and np.isfinite(c.values).any()}
    for n, c in sensors.items():
        others = [o.values for o in sensors.values() if o is not c and o.t is c.t]
        rows = None if n in coarse else standing_still(c.values, others)
        if rows is not None:
            a, b = (c.t[k] for k in rows)
            text = f"{c.source}: {n} stands still from {a:g} to {b:g} s"
            out.append(
                Still(n, float(a), float(b), Doubt("sensor", text, part_of(n, m.electrical)))
            )
    return out


def without_still(m: Measurements, still: Sequence[Still], table: SensorSet) -> Measurements:
    """Return the recording without what outputs of the gas path show while they stand still."""
    channels = dict(m.channels)
    for s in (s for s in still if s.name in table.outputs):
        c = channels[s.name]
        stuck = (c.t >= s.t) & (c.t <= s.end)
        channels[s.name] = dataclasses.replace(c, values=np.where(stuck, np.nan, c.values))
    return dataclasses.replace(m, channels=channels)


def still_causes(still: Sequence[Still]) -> Iterator[Causes]:
    """Tell what the stand of a gas-path sensor is: as little probable otherwise as ``LEVEL``."""
    for s in still:
        if s.doubt.part == GAS:
            name = f"sensor {s.name}"
            yield Causes(s.t, {name: 1 - LEVEL, "none": LEVEL}, {name: {"stuck": 1.0}})


def standing_still(
    values: np.ndarray, others: Sequence[np.ndarray], level: float = LEVEL
) -> tuple[int, int] | None:
    """Return first and last row of the longest run of one reading, if most others change in it.

    A coarse sensor repeats itself: the share q of its repeated readings, the longest run left out,
    gives a run of n readings somewhere among K with a probability of less than K q^(n-1).  One that
    never moves has no such share: as many as ``FEWEST_STILL`` are enough.
    """
    change = np.flatnonzero(np.append(True, values[1:] != values[:-1]))
    length = np.diff(np.append(change, values.size))
    k, K = int(length.argmax()), values.size
    n = int(length[k])
    repeats = K - change.size - (n - 1)
    q = min((repeats + 1) / max(K - n, 1), 1.0)
    never = n == K >= FEWEST_STILL
    if n < 4 or (math.log(K) + (n - 1) * math.log(q) > math.log(level) and not never):
        return None
    part = slice(change[k], change[k] + n)
    there = [o[part][np.isfinite(o[part])] for o in others]
    moving = [np.ptp(o) > 0 for o in there if o.size]
    return (int(change[k]), int(part.stop) - 1) if moving and np.mean(moving) > 0.5 else None


# ------------------------------------------------------------------------------ generators

_WAVES = {
    "noise": "{n}: what its innovations leave is {v:.2f} times what its noise explains{at}",
    "offset": "{n}: its innovations have a mean of {v:+.2g} A{at}, which no gain error gives",
    "gain": "{n}: {v:.1%} of it is not explained{at}, more than the stated gain errors give",
    "change": "{n}: its error changes by {v:.2g} A{at}, and neither load nor fault is seen there",
    "steps": "the voltages jump in {v:.0%} of the windows: no load is switched that often",
    "moved": "at {v:g} s the machine changed: no voltage jumped, no short circuit was reported",
}


def _wave_doubt(f: Finding, t0: float, length: float) -> Doubt:
    kind, _, order = f.test.partition(" ")
    at = f" at {t0 + f.at * length:.3g} s" if f.at >= 0 else ""
    if kind == "harmonic":
        text = f"{f.sensor}: the harmonic of order {order} is {f.value:.2g} A, not of the voltages"
        return Doubt("harmonics", text)
    text = _WAVES[kind].format(n=f.sensor, v=f.value, at=at)
    return Doubt({"noise": "innovations"}.get(kind, "machine"), text)


def machine_doubts(
    side: ElectricalSide,
    machine: MachineParameters,
    sensors: SensorSet,
    samples: Mapping[str, np.ndarray],
    causes: Sequence[Causes] = (),
) -> Iterator[Doubt]:
    """Say why what is estimated of a generator is not to be believed.

    Args:
        side: the estimate.
        machine, sensors: as the filter knows them; the sensors with their own noise.
        samples: as the filter took them.
        causes: of its changes, of :func:`machine_causes`: a short circuit is an explanation.
    """
    found = [t for t, _ in _reports(side)]
    found += [c.t for c in causes if c.best.startswith("short circuit")]
    resets = [float(t) for t in side.resets]
    waves = unexplained_waves(
        machine, sensors, samples, side.result, resets=resets, faults=found, level=LEVEL
    )
    length = 2 * math.pi * 10 / float(np.nanmedian(samples["w_r"]))
    yield from (_wave_doubt(f, float(side.t[0]), length) for f in waves)
    often = [v for k, v in enumerate(resets[2:]) if v - resets[k] <= RESTLESS]
    if often:
        yield Doubt(
            "machine",
            f"its filter began anew {len(resets)} times up to {resets[-1]:g} s, as after "
            "a step of load or a fault: no model of one step fits, and reports around are doubtful",
        )
    yield from _severity_doubts(side)
    slip = _slip(samples)
    if abs(slip) > SLIP:
        yield Doubt(
            "time",
            f"the voltages turn by {slip:+.1f} rad against the speed, where no load turns them by "
            f"{SLIP:g}: a wrong rate of samples, or the speed of another machine",
        )


def _slip(samples: Mapping[str, np.ndarray]) -> float:
    """Angle that the voltage's space vector gains on the rotor from beginning to end, rad."""
    a = np.array([samples[n] for n in (*PHASES_V, "w_r", "t")])
    *v, w, t = a[:, np.isfinite(a).all(0)]
    if t.size < FEWEST_SAMPLES:
        return 0.0
    turn = np.exp(1j * np.array(list(PHASE_ANGLE.values())))
    rotor = np.concatenate([[0.0], np.cumsum(w[:-1] * np.diff(t))])
    angle = np.unwrap(np.angle((turn @ np.array(v)) * np.exp(-1j * rotor)))
    ends = max(t.size // 20, 1)
    return float(angle[-ends:].mean() - angle[:ends].mean())


def _severity_doubts(side: ElectricalSide) -> Iterator[Doubt]:
    """At most one phase is faulty, and no severity is negative."""
    h = side.severities[0]
    best = int(h[:, -1].argmax())
    if side.misfit[-1] > SEVERAL:
        yield Doubt(
            "machine",
            f"the severities are {math.sqrt(side.misfit[-1]):.0f} sigmas from what one faulty "
            "phase explains: no short circuit of one phase; another machine, or like errors of "
            "several sensors",
        )
    if h[best, -1] > STEEP_H:
        yield Doubt(
            "linearisation",
            f"h_{PHASES[best]} = {h[best, -1]:.2e} is larger than any that the filter was tried on",
            severity(PHASES[best]),
        )


def _reports(side: ElectricalSide) -> list[tuple[float, str]]:
    """Instants at which a short circuit was reported, s, and the phases."""
    now = side.phase
    new = 1 + np.flatnonzero((now[1:] > 0) & (now[1:] != now[:-1]))
    return [(float(side.t[k]), PHASES[int(now[k]) - 1]) for k in new]


def machine_causes(
    side: ElectricalSide,
    machine: MachineParameters,
    sensors: SensorSet,
    samples: Mapping[str, np.ndarray],
) -> Iterator[tuple[Causes, Doubt | None]]:
    """Tell what the first changes of a generator are, and where the report says something else.

    A change is a reported short circuit, a new beginning of the filter without a report, or what
    gain errors hide from the filter: a rise of a severity, a step of a current's offset, or one of
    the field's current alone.

    Args:
        side, machine, sensors, samples: as of :func:`machine_doubts`.
    """
    reports, resets = _reports(side), [float(t) for t in side.resets]
    t0, dt = float(side.t[0]), float(side.t[1] - side.t[0])

    def came(phase: str, first: float, last: float) -> float:
        within = max(first, t0), last
        return onset_of(machine, sensors, samples, phase, within)

    rises = [
        (side.t[k] - 2 * dt, float(side.t[m]), PHASES[i])
        for m, k, i in severity_changes(side.beliefs)
    ]
    changes: list[tuple[float, str]] = []
    crept: dict[float, str] = {}
    for t, p in reports:
        # a small one makes no reset: it came before it was found, if it was not there before
        own = [r for r in resets if t - RECENT <= r <= t + 1e-9]
        about = [(a, b) for a, b, q in rises if p == q and b <= t + 1e-9]
        begin = max(own) if own else came(p, *(about[0] if about else (t - SLOWLY, t)))
        changes.append((begin, f"short circuit {p}"))
        crept |= {begin: p} if about and not own else {}
    changes += [(t, "") for t in resets if t not in dict(changes)]
    for first, last, p in rises:
        if not _near(changes, first, last):
            changes.append((came(p, first, last), ""))
            crept[changes[-1][0]] = p
    offsets = offset_steps(samples, sensors)
    alone = [o for o in offsets if not any(_of(o, t) for t, _ in changes)]
    known = [t for t, _ in changes] + [o.t for o in alone]
    changes += [(t, "") for t in field_steps(samples, sensors, known)]
    for o in alone:
        yield _offset(o), _unsaid(_offset(o))
    for t, said in sorted(changes)[:MOST_CAUSES]:
        failed = next((_offset(o) for o in offsets if _of(o, t)), None)
        told = failed or causes_of_change(machine, sensors, samples, t)
        if told is None:
            continue
        if t in crept and told.best == "healthy":
            told = _crept(t, crept[t])
        what = f"what is reported as a {said} at {t:g} s"
        yield told, _rather(told, said, what) if said else _unsaid(told)


def _of(step: OffsetStep, t: float) -> bool:
    """Whether a change at an instant may be that of an offset."""
    return step.t - DT <= t <= step.t + RECENT


def _offset(step: OffsetStep) -> Causes:
    """What a change of an offset is: no machine gives a direct current that lasts."""
    name = f"sensor {step.name}"
    return Causes(step.t, {name: 1 - LEVEL, "healthy": LEVEL}, {name: {"bias": 1.0}})


def _crept(t: float, phase: str) -> Causes:
    """What a severity's rise is that is too slow for the piece about any instant of it.

    A gain of the phase's current that drifts looks alike under a load that is a resistance.
    """
    share = {f"short circuit {phase}": PRIOR["short circuit"] / len(PHASES)}
    share[f"sensor i_{phase}"] = PRIOR["sensor"] / len(MEASURED)
    shares = {n: (1 - LEVEL) * v / sum(share.values()) for n, v in share.items()}
    return Causes(t, shares | {"healthy": LEVEL}, {f"sensor i_{phase}": {"drift": 1.0}})


def _near(changes: Sequence[tuple[float, str]], first: float, last: float) -> bool:
    return any(first <= t <= last + RECENT for t, _ in changes)


def _unsaid(found: Causes) -> Doubt | None:
    """The doubt that a change raises which no filter knows, and which is no short circuit."""
    best = found.best
    if best.partition(" ")[0] in ("healthy", "short") or found.probability[best] < SURELY:
        return None
    return Doubt(
        "sensor",
        f"the change at {found.t:g} s is rather: {best} ({100 * found.probability[best]:.0f} %), "
        "of which the filter knows nothing",
    )


def lost(why: Exception, first: Causes | None = None) -> Doubt:
    """The doubt about a machine whose filter is lost; ``first``: what its first change is."""
    text = f"its filter is lost, and nothing is estimated: {why}"
    if first is not None:
        text += f"; the first change is {first.best} ({100 * first.probability[first.best]:.0f} %)"
    return Doubt("lost", text)


def _rather(found: Causes, said: str, what: str) -> Doubt | None:
    """The doubt about a report that its probability raises."""
    if found.probability.get(said, 0.0) >= SURELY:
        return None
    text = f"{found.best} ({100 * found.probability[found.best]:.0f} %)"
    return Doubt("sensor", f"{what} is rather: {text}")


# ------------------------------------------------------------------------------ gas path

_GAS = {
    "size": "its innovations are {v:.2f} times what model and stated noise explain",
    "window": "its innovations up to {t:g} s are {v:.2f} times what model and stated noise explain",
    "wild": "its reading at {t:g} s is {v:+.1f} sigma from what model and stated noise explain",
    "mean": "its innovations have a mean of {v:+.2f} sigma",
    "drift": "its innovations drift by {v:+.1f} sigma along the recording",
    "creep": "it drifts by {v:+.1%} along the recording, against all that was measured besides",
    "colour": "its innovations are not white, neighbours are correlated by {v:+.2f}: a lag?",
}
_GAS_KIND = {"size": "innovations", "window": "innovations", "wild": "wild"}


def gas_doubts(
    filt: GasPathFilter,
    tracked: Tracked,
    sides: Sequence[ElectricalSide] = (),
    drifts: Creep | None = None,
) -> Iterator[Doubt]:
    """Say why the gas-path estimate is not to be believed.

    Args:
        filt, tracked: the filter and what it said.
        sides: the generators' estimates, of which its shaft power is.
        drifts: of :func:`~estimators.apu.creeping.creep`, where that was asked already.
    """
    quiet, (judge, seen) = quiet_of(tracked), judged(filt, tracked)
    r = seen.result
    z = r.innovation / np.sqrt(r.innovation_variance)
    each = {n: np.where(quiet, row, np.nan) for n, row in zip(r.y.names, z, strict=True)}
    found = findings(each, margin=MARGIN)
    if {"Wf", "PW"} & {
        *r.x.names
    }:  # freer than a load moves: innovations alternate, sigma is large
        found = [f for f in found if f.test != "colour" or f.value > 0]
    drifts = creep(filt, tracked) if drifts is None else drifts
    found += _creeping(drifts)
    for f in least(found, LEVEL):
        text = _GAS[f.test].format(v=f.value, t=float(r.t[f.at]))
        yield Doubt(_GAS_KIND.get(f.test, "colour"), f"{f.sensor}: {text}")
    if len(tracked.alarms) >= MOST_JUMPS:
        yield Doubt(
            "innovations",
            f"{MOST_JUMPS} changes of health were reported, and further ones were not looked for",
        )
    yield from _prior_doubts(judge, seen)
    yield from _off(drifts)
    r = tracked.result
    x = {n: float(r[n][0][-1]) for n in HEALTH}
    for n, v in x.items():
        if abs(v - 1) > STEEP:
            yield Doubt(
                "linearisation",
                f"{n} = {v:.3f} is farther from 1 than any that the filter was tried on",
            )
    yield from _map_doubts(filt, tracked)
    changed = bool(tracked.alarms) or any(
        abs(v - 1) > SURE * float(r[n][1][-1]) for n, v in x.items()
    )
    yield from (d for side in sides if changed for d in _hidden(side))


def _creeping(found: Creep | None) -> list[Finding]:
    """Test whether a sensor, or the shaft power, drifts against all others.

    What that would leave in the innovations of all sensors is known, so that a drift is found which
    hardly shows in any one of them, and still moves the estimates by several sigmas.
    """
    if found is None:
        return []
    z = np.abs(found.size / found.sigma)[~found.lasting]  # drifts come first
    # others share a part of its signature: the most striking one alone is told
    k = int(z.argmax())
    chance = float(2 * ndtr(-z[k] / math.sqrt(MARGIN))) * len(z)
    return [Finding(found.names[k], "creep", chance, float(found.size[k]))]


def _off(found: Creep | None) -> Iterator[Doubt]:
    """Say where errors all along, beyond what was stated, are more probable than none.

    Such an error shows in no innovation: the health factors follow it, farther than they probably
    are.  A wrong day, or an engine that is much worse than its prior, looks alike.
    """
    if found is None or (p := found.probability * found.lasting).sum() < SURELY:
        return
    k = int(p.argmax())
    name, size = found.names[k], found.size[k]
    error = f"{size:+.3g} {CONDITIONS[name].unit}" if name in CONDITIONS else f"{size:+.1%}"
    yield Doubt(
        "prior",
        f"{name}: an error of {error} all along, beyond what was stated, explains the readings "
        f"better than the health does ({100 * p.sum():.0f} % for some such error)",
    )


def gas_causes(filt: GasPathFilter, tracked: Tracked) -> Iterator[tuple[Causes, Doubt | None]]:
    """Tell of each reported change of health what it is, and where it is rather something else.

    Args:
        filt, tracked: the filter and what it said.
    """
    for found in causes_of_alarms(*judged(filt, tracked)):
        yield found, _rather(found, "gas path", f"the change reported at {found.t:g} s")


def _hidden(side: ElectricalSide) -> Iterator[Doubt]:
    """A short circuit too small to report, of which a change of health may be the loss."""
    h, s = side.severities[:, :, -1]
    i = int((h / s).argmax())
    if not side.phase[-1] and h[i] > 2 * s[i]:
        yield Doubt(
            "power",
            f"a short circuit of h_{PHASES[i]} = {h[i]:.1e} +- {Z95 * s[i]:.1e} may be "
            "there, too small to be told from gain errors; the change of health may be its loss",
        )


def _prior_doubts(filt: GasPathFilter, tracked: Tracked) -> Iterator[Doubt]:
    """Gain errors, inertia and efficiency against what was stated of them."""
    r = tracked.result
    names = [n for n in r.x.names if n.startswith(("gain_", "bias_"))]
    names = [n for n in names if n not in filt.model.consider]
    limit = float(-ndtri(LEVEL / 2 / max(len(names), 1)))
    jumped = "jump_PW" in filt.model.u.names
    for n in names:
        x, walk = float(r[n][0][-1]), filt.model.walk[filt.model.x.index(n)]
        s = math.hypot(filt.sigma[n], walk * math.sqrt(r.t[-1] - r.t[0]))
        if abs(x) > limit * s and not (n == "gain_PW" and jumped and tracked.alarms):
            what = {"gain_PW": "the generators' efficiency", "gain_J": "the inertia"}
            of = what.get(n, f"the sensor {n[5:]}")
            size = f"{x:+.3g} {r.x[n].unit}" if n.startswith("bias_") else f"{100 * x:+.1f} %"
            yield Doubt(
                "power" if n == "gain_PW" else "prior",
                f"{n[5:]}: an error of {size} is {abs(x) / s:.1f} times what was stated of {of}",
            )


def _map_doubts(filt: GasPathFilter, tracked: Tracked) -> Iterator[Doubt]:
    """Operating points beyond the tables of the maps, at the end."""
    r, gg = tracked.result, filt.gg
    u = dict(zip(filt.model.u.names, tracked.data.u[:, -1], strict=True))
    u |= {n: float(r[n][0][-1]) for n in ("Wf", "PW") if n in r.x}
    given = gg.U.pack({n: float(u.get(n, 0.0)) for n in gg.U.names})
    theta = gg.THETA.pack({n: float(r[n][0][-1]) for n in HEALTH})
    N = np.array([float(r["N"][0][-1])])
    y = np.asarray(engine_function(gg.family, OFF_MAP)(N, given, gg.full(theta))[1]).ravel()
    for n, v in zip(("compressor", "turbine"), y, strict=True):
        if not v <= 0:
            yield Doubt("maps", f"at the end the {n} runs off its map (by {v:.2g})")


# ------------------------------------------------------------------------------ fits


def fit_doubts(fit: EngineFit) -> Iterator[Doubt]:
    """Say why the parameters of a fit are not to be believed, by residuals and bounds.

    The residuals of a fit are smaller than those of the truth, so that the level is kept.

    Args:
        fit: of :func:`estimators.apu.fitting.fit_engine`.
    """
    r = fit.result
    if r.freedom > 0 and r.p_value < LEVEL:
        yield Doubt(
            "innovations",
            f"chi2 = {r.chi2:.4g} with {r.freedom} degrees of freedom: more than noise gives",
        )
    for k, name in enumerate(fit.names):
        rest = {n: e for n, (_, _, e) in fit.series(k).items() if n in fit.lifted.model.y.names}
        t = r.recordings[k].t
        for f in least(findings(rest), LEVEL):
            text = _GAS[f.test].format(v=f.value, t=float(t[f.at]))
            text = text.replace("innovations", "residuals")
            yield Doubt(_GAS_KIND.get(f.test, "colour"), f"{name}: {f.sensor}: {text}")
    for n in r.at_bound:
        yield Doubt("linearisation", f"{n} is at its bound, where no interval holds")
    for n, v in r.values.items():
        if n.partition("[")[0] in HEALTH and abs(v - 1) > STEEP_FIT:
            yield Doubt("linearisation", f"{n} = {v:.3f} is farther from 1 than any that was tried")
