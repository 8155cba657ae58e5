"""Shaft power against electrical output: a loss of the generators that came, wherever it came from.

What the shaft gives and no load takes is lost in the generators.  Constant errors of both sensors
and of the efficiency are one share, g; a short circuit takes its loss L besides, in watts,

    PW = (1 + g) (P_e_total + L) / (eta_sg eta_gtSg).

A fault that is there from the start is not told from g; one that comes, at once or slowly, is, to
a thousandth of the power in half a second, and without a waveform.  Which machine has it, and in
which phase, power does not say.  Of one short circuit the severity h is that of (8) with the
voltage that is regulated, L = h (1 + h) V^2/r_s + 2 h P_phase; the phase's own is lower, and h told
for less, by 1 % at 1e-3 and 4 % at 7e-3.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from apu_casadi.core.results import dataset
from apu_casadi.core.sharing import once
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.causes import Causes, probabilities
from estimators.apu.electrical.hypotheses import H_SCALE
from estimators.apu.gaspath import JUMP, LOSS_WALK
from estimators.apu.healthjumps import JumpTest, Tracked, track_jumps
from estimators.apu.sensors import Sensor
from estimators.apu.trust import Doubt
from estimators.apu.unknowns import ETA_SIGMA, Knowledge, of_parameter
from estimators.filters.belief import Belief
from estimators.filters.filtering import StepMaker
from estimators.filters.resuming import Runs
from estimators.filters.robust import limit_of, robust_ekf_step
from estimators.models.filtermodel import FilterModel, Unknown
from estimators.models.recording import Recording, record

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["OUTPUT", "PowerBalance", "balance", "loss_of", "severity_of"]

OUTPUT = "P_e_total"
METER = 0.005  # relative error of the output's meter: class 0.5 of IEC 62053-22
WHITE = 0.002  # its noise, relative, and that output and shaft power are not of one instant
SENSOR_JUMP = 0.05  # standard deviation of a jump of the shaft power's sensor, relative
SURE = 4.0  # sigmas of the constant share, beyond which it is no error of sensors
TOLD = 50  # samples after an alarm from which the size of a change is told
TEST = JumpTest(limit=limit_of())
_P = Signal(OUTPUT, "W", "electrical output of all generators", nominal=4e5)


def loss_of(apu: Apu, h: float, P_e: float) -> float:
    """Return the extra loss, W, of a short circuit of severity h at an output of all, W."""
    p = apu.generator.machine
    P_phase = P_e / len(apu.machines) / 3
    return h * (1 + h) * p.V_rated_rms**2 / p.r_s + 2 * h * P_phase


def severity_of(apu: Apu, loss: Any, P_e: Any) -> Any:
    """Return the severity of one short circuit that loses so much, W: of :func:`loss_of`."""
    p = apu.generator.machine
    a = p.V_rated_rms**2 / p.r_s
    b = a + 2 * np.asarray(P_e) / len(apu.machines) / 3
    # the root that vanishes with the loss, without cancellation
    return 2 * loss / (b + np.sqrt(np.maximum(b**2 + 4 * a * np.asarray(loss), 0.0)))


@once
def _model() -> FilterModel:
    """PW of output, loss and share; p: power of the shaft over that of the terminals, a jump."""
    signals = (
        Signals([Signal("gain", "1", "constant error", nominal=0.01), Signal("loss", "W", "loss")]),
        Signals([_P, Signal("jump", "1", "where the loss may have jumped", default=0.0)]),
        Signals([Signal("shaft", "1", "shaft power over output"), Signal("size", "W", "a jump")]),
        Signals([Signal("w_jump", "1", "jump over its size")]),
        Signals([Signal("PW", "W", "shaft power")]),
    )
    symbols = x, u, p, w, _ = tuple(
        ca.SX.sym(n, k) for n, k in zip("xupwt", (2, 2, 2, 1, 1), strict=True)
    )
    y = (1 + x[0]) * (u[0] + x[1]) * p[0]
    x1 = ca.vertcat(x[0], x[1] + u[1] / JUMP * p[1] * w)
    more = {"gain": Unknown(), "loss": Unknown(walk=LOSS_WALK)}
    none = ca.SX(0)
    return FilterModel.of("power_balance", signals, symbols, (x1, none), (y, none), more=more)


@dataclass(frozen=True, eq=False)
class PowerBalance:
    """The balance of a unit over a recording.

    Args:
        apu: the unit.
        data: what the filter takes.
        resistance: relative standard deviation of the stator's, of which the severity is a share.
    """

    apu: Apu
    data: Recording
    resistance: float

    @property
    def model(self) -> FilterModel:
        """That of the filter."""
        return _model()

    def runs(
        self,
        *,
        prior: Belief | None = None,
        step: StepMaker | None = None,
        backend: str | None = None,
    ) -> Runs:
        """Return the filter for recordings that begin alike, single wild readings doubted."""
        start = {"gain": math.hypot(ETA_SIGMA, METER), "loss": 0.0}
        prior = prior or Belief.of(self.model.x, dict.fromkeys(self.model.x.names, 0.0), start)
        return Runs((step or robust_ekf_step)(self.model), prior, backend)

    def tracked(self, backend: str | None = None) -> Tracked:
        """Find changes of the loss, and follow them."""
        return track_jumps(self, self.data, test=TEST, backend=backend)

    def output(self) -> np.ndarray:
        """Electrical output at the instants of the filter, W."""
        out: np.ndarray = self.data.u[self.model.u.index(OUTPUT)]
        return out

    def dataset(self, tracked: Tracked) -> xr.Dataset:
        """Return loss and severity over time, with alarms and onsets as attributes."""
        r = tracked.result
        loss, s = r["loss"]
        h = severity_of(self.apu, loss, self.output())
        slope = (severity_of(self.apu, loss + s, self.output()) - h) / np.maximum(s, 1e-9)
        values = {"loss": loss, "loss_sigma": s, "h": h}
        values["h_sigma"] = np.hypot(slope * s, self.resistance * h)
        units = {"loss": "W", "loss_sigma": "W"}
        docs = {"loss": "extra loss since the beginning", "h": "that of one short circuit"}
        signals = [Signal(n, units.get(n, "1"), docs.get(n, "standard deviation")) for n in values]
        e = dataset({"time": r.t}, {"time": values}, signals=signals)
        e.attrs["alarms"] = str([float(r.t[k]) for k in tracked.alarms])
        e.attrs["onsets"] = str([float(r.t[k]) for k in tracked.onsets])
        e.attrs["evidence"] = TEST.evidence(r)
        return e

    def causes(self, tracked: Tracked) -> Iterator[tuple[Causes, Doubt | None]]:
        """Tell of each change of the loss what it is: a short circuit only adds to it."""
        r, (loss, s) = tracked.result, tracked.result["loss"]
        ends = [*tracked.onsets, r.t.size - 1][1:]
        for k, onset, end in zip(tracked.alarms, tracked.onsets, ends, strict=True):
            at = max(min(k + TOLD, end, r.t.size - 1), k)
            change, v = float(loss[at] - loss[onset]), float(s[at] ** 2 - s[onset] ** 2)
            v = max(v, float(s[onset] ** 2))
            P = float(self.output()[at])
            sizes = {
                "healthy": 0.0,
                "short circuit": loss_of(self.apu, H_SCALE, P),
                "sensor PW": SENSOR_JUMP * P,
            }
            found = {n: _normal(change, v + size**2) for n, size in sizes.items()}
            up = change > 0
            found["short circuit"] += math.log(2.0) if up else -math.inf
            c = Causes(float(r.t[k]), probabilities(found))
            text = f"shaft power and electrical output differ from {c.t:g} s on: rather {c.best}"
            yield c, None if c.best == "short circuit" else Doubt("power", text)

    def doubts(self, tracked: Tracked) -> Iterator[Doubt]:
        """Say where power and output do not belong together."""
        g = float(tracked.result["gain"][0][-1])
        known = math.hypot(ETA_SIGMA, METER)
        if abs(g) > SURE * known:
            yield Doubt(
                "power",
                f"{OUTPUT}: the shaft power is {100 * g:+.0f} % off what the output asks for, "
                f"{abs(g) / known:.0f} times what sensors and efficiency explain: of all machines?",
            )


def _normal(x: float, variance: float) -> float:
    """Logarithm of a normal density of mean zero."""
    return -0.5 * (x**2 / variance + math.log(2 * math.pi * variance))


def balance(
    apu: Apu,
    sensor: Sensor,
    power: tuple[np.ndarray, np.ndarray],
    output: tuple[np.ndarray, np.ndarray],
    unknowns: Mapping[str, Knowledge],
) -> PowerBalance:
    """Make the balance of readings.

    Args:
        apu: the unit; of machines that differ the first one's efficiency counts.
        sensor: of the shaft power.
        power, output: instants, s, and readings, W, of ``PW`` and of all generators.
        unknowns: by name, for the stator's resistance.
    """
    t, PW = (v[power[0] >= output[0][0] - 1e-9] for v in power)
    shaft = 1.0 / (apu.generator.machine.eta_sg * apu.coupling.eta_gtSg)
    sigma = np.hypot(sensor.sigma(PW), WHITE * np.abs(PW))
    size = loss_of(apu, H_SCALE, float(np.median(output[1])))
    data = record(
        _model(),
        outputs={"PW": (t, PW)},
        sigma={"PW": sigma},
        inputs={OUTPUT: output, "jump": (t, np.zeros(t.size))},
        p={"shaft": shaft, "size": size},
    )
    return PowerBalance(apu, data, of_parameter(unknowns, "machine.r_s").sigma)
