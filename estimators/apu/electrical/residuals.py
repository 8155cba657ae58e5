"""What the innovations of an electrical filter leave unexplained, by sensor and window.

Gain errors stay in the innovations as an offset on the rotor's axes: a constant in the field
current, the fundamental in the phase currents, and with unequal gains a second and a third
harmonic.  With these taken out, what is left of a window is white noise of the sensors' own size,
whatever the filter claims: a filter that takes gain errors for noise claims twice as much.
Harmonics that the voltages have as well are in the model, and not in the innovations.

======== ============================================================================
noise    what is left of a window is larger than the sensors' noise
offset   a phase current has a mean that no gain error gives
gain     the fundamental (of i_fd the mean) is larger than stated gain errors give
change   it changes from window to window, and no load, no fault does
harmonic a higher harmonic in what is left
======== ============================================================================

Windows in which a load or a fault came are not judged; but a filter that began anew where neither
the voltage jumped nor a fault was found is told: ``moved``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from apu_casadi.core.sharing import last
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.machine.terminals import jumps
from estimators.apu.electrical.electricalfilter import electrical_filter, jump_floor
from estimators.apu.electrical.terminalsignals import MEASURED, PHASES_I, PHASES_V, VOLTAGES
from estimators.apu.sensors import SensorSet
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import FilterResult, run
from estimators.information.consistency import above
from estimators.information.innovationtests import Finding, least

__all__ = ["field_steps", "unexplained_waves"]

PERIODS = 10  # electrical periods of a window
MARGIN = 1.25  # on the variance: the filter's own error adds 0.08 to 0.2 of it
TAKEN = (0, 1, 2, 3)  # harmonics that gain errors leave; 0 and 2 are those of the field
HIGHEST = 13
PROBE = 8  # periods from which the noise of the innovations is told; the last four count
FEWEST_WINDOWS = 3
#: Share of missing readings from which the filter's gain is another in each sample: its innovations
#: are no longer those of a steady one, with which they are compared.
GAPPY = 0.02
TOLD = 0.2  # least singular value of the orders over the largest; 0.7 without gaps
NEAR = 0.03  # s from a cause to the reset that it makes
BESIDE = 5  # samples before and after a step of the field's current
STEP, RIPPLE = (
    10.0,
    3.0,
)  # standard deviations of it, and share of its usual change, that it exceeds
#: What the filter is behind a change of load, over that of the current's amplitude in the time
#: before (s), in which it follows: 5.2 A after a step by 92 A at 225 kW, 2.4 A after one by 40 A.
BEHIND, FOLLOWED = 0.06, 0.25
LOADED = 0.02  # share by which all currents change from window to window where a load does
EXCUSED = 0.34  # largest share of windows with steps of the voltage; more are no steps of load


@dataclass(frozen=True, eq=False)
class _Windows:
    """Regressions of all windows.

    Args:
        t: their beginnings, s.
        rest: sum of squares that is left over the noise's variance, (windows, sensors).
        dof: degrees of freedom of that.
        harmonics: cosine and sine by order, (windows, orders, 2, sensors); of 0 the mean.
    """

    t: np.ndarray
    rest: np.ndarray
    dof: int
    harmonics: np.ndarray


@last(8)
def _noise(machine: MachineParameters, sensors: SensorSet, key: bytes) -> np.ndarray:
    """Variances of the innovations of a filter that takes no gain error for noise, (4,)."""
    a = np.frombuffer(key).reshape(len(VOLTAGES) + 2 + len(MEASURED), -1)
    samples = dict(zip(("t", "w_r", *VOLTAGES, *MEASURED), a, strict=True))
    filt = electrical_filter(machine, sensors=sensors)
    r = run(ekf_step(filt.model), filt.prior(samples), filt.recording(samples))
    return np.asarray(np.nanmean(r.innovation_variance[:, a.shape[1] // 2 :], axis=1))


def _variances(
    machine: MachineParameters, sensors: SensorSet, samples: Mapping[str, np.ndarray], w: float
) -> np.ndarray:
    """Variances of the white part of the innovations.

    They hang on speed and rate alone, so that a period of a machine at no load gives them.
    """
    step = float(np.median(np.diff(samples["t"][:10_000])))
    t = step * np.arange(max(round(PROBE * 2 * math.pi / w / step), 40))
    turn = 2 * math.pi / 3
    V = math.sqrt(2) * machine.V_rated_rms
    values = {f"v_{p}": V * np.cos(w * t - k * turn) for k, p in enumerate("abc")}
    values |= {f"i_{p}": 0.0 * t for p in "abc"}
    i_fd = V / (w * machine.L_md)
    values |= {"t": t, "w_r": w + 0.0 * t, "V_fd": machine.r_fd * i_fd + 0.0 * t}
    values["i_fd"] = i_fd + 0.0 * t
    key = np.array([values[n] for n in ("t", "w_r", *VOLTAGES, *MEASURED)])
    return _noise(machine, sensors, key.tobytes())


def _windows(
    r: FilterResult, angle: np.ndarray, noise: np.ndarray, per: int, orders: Sequence[int]
) -> _Windows:
    columns = [np.ones_like(angle)]
    columns += [f(m * angle) for m in orders if m for f in (np.cos, np.sin)]
    n, width, W = 1 + 2 * sum(m in TAKEN and m > 0 for m in orders), len(columns), angle.size // per
    basis = np.column_stack(columns)[: W * per].reshape(W, per, width)
    y = r.innovation[:, : W * per].reshape(-1, W, per).transpose(1, 2, 0)
    there = np.isfinite(y)
    c, s = (np.full((W, k, y.shape[2]), np.nan) for k in (width, 1))
    whole = there.all((1, 2))
    c[whole], s[whole, 0] = _regressed(basis[whole], y[whole], n)
    for k, i in np.argwhere(there.sum(1) > 0.5 * per):
        if not whole[k]:
            row = there[k, :, i]
            b, e = basis[k, row], y[k, row, i]  # with gaps, harmonics may look alike
            every, _, _, size = np.linalg.lstsq(b, e, rcond=None)
            if size[-1] < TOLD * size[0]:  # gaps at the same angles, as clipping makes
                continue
            c[k, :, i] = every
            e = e - b[:, :n] @ np.linalg.lstsq(b[:, :n], e, rcond=None)[0]
            s[k, 0, i] = e @ e * (per - n) / (row.sum() - n)
    pairs = np.stack([c[:, 1::2], c[:, 2::2]], axis=2)
    mean = np.stack([c[:, 0], np.zeros_like(c[:, 0])], axis=1)[:, None]
    harmonics = np.concatenate([mean, pairs], axis=1)
    return _Windows(r.t[: W * per : per], s[:, 0] / noise, per - n, harmonics)


def _regressed(basis: np.ndarray, y: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the whole basis, and what its first n columns leave: sums of squares.

    Args:
        basis: of windows, (W, K, m). y : (W, K, sensors).
        n: columns that count as explained.
    """
    turned = basis.transpose(0, 2, 1)
    c = np.linalg.solve(turned @ basis, turned @ y)
    low = basis[:, :, :n]
    first = np.linalg.solve(turned[:, :n] @ low, turned[:, :n] @ y)
    return c, ((y - low @ first) ** 2).sum(1)


def unexplained_waves(
    machine: MachineParameters,
    sensors: SensorSet,
    samples: Mapping[str, np.ndarray],
    r: FilterResult,
    *,
    resets: Sequence[float] = (),
    faults: Sequence[float] = (),
    level: float,
) -> list[Finding]:
    """Say which sensors' innovations the machine and the stated noise do not explain.

    Args:
        machine, sensors: as the filter knows them; ``sensors`` with their own noise and gains.
        samples: what was measured, evenly, on the filter's instants or more.
        r: of the filter with the three severities.
        resets: instants at which it began anew, s.
        faults: instants at which a short circuit was reported, s.
        level: probability that anything is said of a right filter.

    Returns:
        Findings, the most striking of each sensor; ``at`` is the number of a window of
        :data:`PERIODS` electrical periods.
    """
    w = float(np.nanmedian(samples["w_r"]))
    step = float(np.median(np.diff(r.t)))
    per = round(PERIODS * 2 * math.pi / w / step)
    if r.t.size < FEWEST_WINDOWS * per:
        return []
    t, speed = samples["t"], np.nan_to_num(samples["w_r"], nan=w)
    angle = np.concatenate([[0.0], np.cumsum(np.interp(r.t[:-1], t, speed) * np.diff(r.t))])
    orders = [m for m in range(HIGHEST + 1) if m * w * step < 0.95 * math.pi]
    jumped = _jumped(samples, sensors)
    # jitter at no load is nothing: its most in the recording stands for it
    steady = tuple(dataclasses.replace(s, jitter=0.0) for s in sensors.sensors)
    noise = MARGIN * _variances(machine, SensorSet(steady), samples, w)
    windows = _windows(r, angle, noise, per, orders)
    stepped, odd = _events(windows.t, per * step, [*jumped, *resets, *faults])
    size = {n: _amplitude(samples, n, windows.t, per * step) for n in MEASURED}
    # the first window is the filter's start
    quiet = ~(stepped | _following(windows.t, size, stepped, faults))
    quiet[:1] = False
    out = [Finding("voltages", "steps", 0.0, float(stepped.mean()))] if odd else []
    if odd:
        quiet[1:] = True
    out += [Finding("machine", "moved", 0.0, t) for t in _moved(resets, [*jumped, *faults])]
    if quiet.sum() < FEWEST_WINDOWS or np.isnan(r.innovation).mean() > GAPPY:
        return out
    rated = math.sqrt(2) * machine.P_rated / 3 / machine.V_rated_rms
    found = _tests(windows, quiet, noise, per, size, sensors, rated)
    return out + least(found, level)


def field_steps(
    samples: Mapping[str, np.ndarray], sensors: SensorSet, known: Sequence[float]
) -> list[float]:
    """Return the instant of the largest step of the field's current with no cause; none if small.

    A step of a load moves the voltages as well.

    Args:
        samples: as of :func:`unexplained_waves`.
        sensors: with their own noise.
        known: instants of changes that are told already, s.
    """
    i, t = samples["i_fd"], samples["t"]
    if i.size < 10 * BESIDE:
        return []
    total = np.concatenate([[0.0], np.cumsum(i)])
    mean = (total[BESIDE:] - total[:-BESIDE]) / BESIDE
    step = np.abs(mean[BESIDE:] - mean[:-BESIDE])  # at sample BESIDE and on
    if not np.isfinite(step).all():
        return []
    k = int(step.argmax())
    sigma = sensors.sigma("i_fd", float(np.median(i))) * math.sqrt(2 / BESIDE)
    usual = float(np.quantile(step, 0.99))
    at = float(t[k + BESIDE])
    causes = np.array([*known, *_jumped(samples, sensors)])
    if step[k] < max(STEP * sigma, RIPPLE * usual) or (np.abs(causes - at) < NEAR).any():
        return []
    return [at]


def _jumped(samples: Mapping[str, np.ndarray], sensors: SensorSet) -> np.ndarray:
    """Instants at which the voltage jumped, s."""
    v = np.array([samples[n] for n in PHASES_V])
    there = np.isfinite(v).all(0)
    t = samples["t"][there]
    w = float(np.nanmedian(samples["w_r"]))
    sizes = np.array(jumps(t, v[:, there], np.full(t.size, w), floor=jump_floor(sensors)))
    step = np.diff(t)
    far = np.append(step > 1.5 * np.median(step), False)
    # over a gap, and from it, a jump is none
    far |= np.roll(far, 1) | np.roll(far, 2)
    return np.asarray(t[(sizes > 0).any(0) & ~far])


def _events(begin: np.ndarray, length: float, at: Sequence[float]) -> tuple[np.ndarray, bool]:
    """Windows in which something came, and whether these are too many for that."""
    after = np.asarray(at, float) - begin[0]
    k = np.floor(after / length + 1e-9).astype(int)
    stepped = np.zeros(begin.size, bool)
    for near in (k, np.floor(after / length - 0.2).astype(int)):
        stepped[near[(near >= 0) & (near < begin.size)]] = True
    return stepped, bool(stepped.mean() > EXCUSED and begin.size >= 10)


def _following(
    t: np.ndarray, size: Mapping[str, np.ndarray], stepped: np.ndarray, faults: Sequence[float]
) -> np.ndarray:
    """Windows in which the filter follows a step of load, one too small to be seen, or a fault."""
    change = [np.abs(np.diff(size[n])) / np.maximum(size[n][1:], 1e-9) for n in PHASES_I]
    # a load changes all three, a sensor one
    after = stepped[:-1] | (np.min(change, axis=0) > LOADED)
    out: np.ndarray = np.append(False, after) | np.append(after & ~stepped[:-1], False)
    for at in faults:
        out |= (t > at - NEAR) & (t < at + FOLLOWED)
    return out


def _moved(resets: Sequence[float], known: Sequence[float]) -> list[float]:
    """Resets near which nothing is known: no voltage jumped, no short circuit was reported."""
    at = np.asarray(known, float)
    return [float(t) for t in resets if not (np.abs(at - t) < NEAR).any()]


def _amplitude(
    samples: Mapping[str, np.ndarray], name: str, begin: np.ndarray, length: float
) -> np.ndarray:
    """Size of a channel in each window: rms times sqrt(2), of the field its mean."""
    edges = np.searchsorted(samples["t"], np.append(begin, begin[-1] + length) - 1e-9)
    x, out = samples[name], np.zeros(begin.size)
    for k, (i, j) in enumerate(pairwise(edges)):
        part = x[i:j][np.isfinite(x[i:j])]
        if part.size:
            out[k] = abs(part.mean()) if name == "i_fd" else math.sqrt(2 * float(np.mean(part**2)))
    return out


def _recent_change(size: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Largest change of a size from the windows of the time ``FOLLOWED`` before to each window."""
    n = math.ceil(FOLLOWED / float(np.median(np.diff(t))))
    before = sliding_window_view(np.concatenate([np.full(n, size[0]), size]), n + 1)
    return np.asarray(np.abs(before - size[:, None]).max(1))


def _tests(
    windows: _Windows,
    quiet: np.ndarray,
    noise: np.ndarray,
    per: int,
    size: Mapping[str, np.ndarray],
    sensors: SensorSet,
    rated: float,
) -> list[Finding]:
    """Findings of all sensors, without a limit; ``rated``: current, to which voltages' gains go."""
    out, number = [], np.flatnonzero(quiet)
    for i, name in enumerate(MEASURED):
        rest = windows.rest[number, i]
        good = number[np.isfinite(rest)]
        if good.size < FEWEST_WINDOWS:
            continue
        rest, c = windows.rest[good, i], windows.harmonics[good, :, :, i]
        k = int(rest.argmax())
        ratio = math.sqrt(MARGIN * float(rest[k]) / windows.dof)
        chance = float(above(rest[k], windows.dof)) * good.size
        out.append(Finding(name, "noise", chance, ratio, int(good[k])))
        variance = noise[i] / per
        field = name == "i_fd"
        # what gain errors leave, and its variance: the mean of the field, else the fundamental
        own = c[:, 0, :1] if field else c[:, 1]
        dof, spread = own.shape[1], variance * (1 if field else 2)
        if not field:
            q = c[:, 0, 0] ** 2 / (variance + sensors[name].unsure("bias") ** 2)
            k = int(q.argmax())
            chance = float(above(q[k], 1)) * good.size
            out.append(Finding(name, "offset", chance, float(c[k, 0, 0]), int(good[k])))
        amplitude = np.hypot(size[name][good], 0.0 if field else rated)
        gain = sensors[name].unsure("gain") * math.sqrt(
            2.0
        )  # of the current itself, and of the voltages
        q = (own**2).sum(1) / ((gain * amplitude) ** 2 + spread)
        k = int(q.argmax())
        found = math.sqrt(float((own[k] ** 2).sum())) / float(amplitude[k])
        out.append(Finding(name, "gain", float(above(q[k], dof)) * good.size, found, int(good[k])))
        usual = np.median(own, axis=0)
        late = BEHIND * _recent_change(size[name], windows.t)[good]
        q = ((own - usual) ** 2).sum(1) / ((0.1 * gain * amplitude) ** 2 + late**2 + spread)
        k = int(q.argmax())
        found = math.sqrt(float(((own[k] - usual) ** 2).sum()))
        out.append(
            Finding(name, "change", float(above(q[k], dof)) * good.size, found, int(good[k]))
        )
        for m in range(4 if not field else 3, c.shape[1]):
            if field and m in TAKEN:
                continue
            power = float((c[:, m] ** 2).sum()) / (2 * variance)
            mean = c[:, m].mean(0)
            chance = float(above(power, 2 * good.size))
            out.append(Finding(name, f"harmonic {m}", chance, float(np.hypot(*mean))))
    return out
