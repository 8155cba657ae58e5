"""What is measured, and how well: every sensor is one entry of a table.

An entry declares what a sensor reads, how often and how late, and all its errors; measurements are
made by it (:mod:`estimators.apu.sensorchain`) and filters take it for what they do not know.
Filters, fits, identifiability, recorded files and studies take their lists from the tables:
:data:`GAS_PATH` and :data:`ELECTRICAL`, whose numbers all studies use, and :data:`KNOWN`, all
gas-path sensors by name.  A table is data: sensors are added by :meth:`SensorSet.add`, their noise
changed by :meth:`SensorSet.change`, and whole sets are files (:mod:`estimators.apu.sensorfile`).

>>> round(GAS_PATH.sigma("P3", 800e3))
4000
>>> GAS_PATH.change(T5=0.004).sigma("T5", 1000.0)
4.0
>>> GAS_PATH.add("P5").outputs
('N', 'P3', 'T3', 'T5', 'P5')

A sensor of one's own is registered by one line, in a module of one's own, which commands and
scenarios load by ``--with`` and ``extensions`` (:mod:`scenarios.extensions`)::

    register(Sensor("dP", 0.005, True, 0.005, "Pa", "assumed", reads=("P3", "P5"),
                    value=lambda P3, P5: P3 - P5))
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.measuring import measure
from apu_casadi.core.signals import Signal
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.park import PHASES

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "ELECTRICAL",
    "GAS_PATH",
    "KNOWN",
    "RANGES",
    "Sensor",
    "SensorSet",
    "gas_path_table",
    "known",
    "plain",
    "register",
    "respond",
    "unregister",
]


def _itself(value: Any) -> Any:
    return value


#: Endings of the names of one generator's channels, ``i_a_2``.
NUMBERS = ("1", "2", "3", "4")
#: What a filter makes of a constant error: a state, one that is considered, or nothing.
WAYS = ("estimated", "considered", "known")
_POSITIVE = ("noise", "gain", "tau", "bias", "drift", "delay", "jitter", "quantum", "turn", "extra")
_NO_ANGLE = ("relative", "gain", "gain_mean", "tau", "delay", "jitter", "limits")


@dataclass(frozen=True)
class Sensor:
    """One sensor.

    Args:
        name: of its reading; the output that it reads, where nothing else is said.
        noise: standard deviation of its white noise, over the reading if ``relative``.
        relative: whether noise is a fraction of the reading.
        gain: standard deviation of its constant relative gain error, used where a study has one.
        unit: of the reading, SI.
        source: where the numbers come from.
        plausible: lowest and highest reading of a running engine, SI; others are refused in files.
        reads: outputs of the model; its own name by default.
        value: its reading from those outputs, an expression; the one output itself by default.
        tau: time constant of a first-order lag, s; its state is one more of a filter.
        rate: of its readings, Hz; None: at every instant that is sampled.
        gain_mean: expected gain error, of which readings are corrected.
        gain_as: the rest of the gain error is ``"estimated"``, ``"considered"`` or taken for
            ``"known"``, which is nothing.  An electrical filter takes what is not known for noise.
        bias: standard deviation of its constant offset, unit.
        bias_mean, bias_as: the same of the offset.
        drift: random walk of the offset, unit per sqrt(s).
        delay: by which a reading is older than its stamp, s.
        jitter: standard deviation of the instant of each sample, s.
        clock: what samples it; sensors of one clock share their jitter.  "": its own.
        quantum: step of its digits, unit.
        limits: lowest and highest value that it can show, unit; there it saturates.
        turn: of an angle, its period, unit: it shows what is within half of it of zero, and a
            filter takes differences modulo it.  0: it is none.
        factor: reading over what it reads: ``unit`` over that of the output.
        fails: whether it can fail; hypotheses of failures are about those that can.
        extra: further white noise in a recording, unit: what jitter makes of its fastest change.

    Raises:
        ParameterError: a number out of range, several outputs without ``value``.
    """

    name: str
    noise: float
    relative: bool
    gain: float
    unit: str
    source: str
    plausible: tuple[float, float] | None = None
    reads: tuple[str, ...] = ()
    value: Callable[..., Any] | None = None
    tau: float = 0.0
    rate: float | None = None
    gain_mean: float = 0.0
    gain_as: str = "estimated"
    bias: float = 0.0
    bias_mean: float = 0.0
    bias_as: str = "estimated"
    drift: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    quantum: float = 0.0
    limits: tuple[float, float] | None = None
    turn: float = 0.0
    factor: float = 1.0
    fails: bool = True
    extra: float = 0.0
    clock: str = ""

    def __post_init__(self) -> None:
        for label in _POSITIVE:
            v = number(f"sensor {self.name}: {label}", getattr(self, label), error=ParameterError)
            if not (math.isfinite(v) and v >= 0):
                raise ParameterError(f"sensor {self.name}: {label} must be >= 0, got {v!r}")
        for label in ("gain_mean", "bias_mean", "factor", *(["rate"] if self.rate else [])):
            v = number(f"sensor {self.name}: {label}", getattr(self, label), error=ParameterError)
            least = {"gain_mean": -1.0, "rate": 0.0}.get(label, -math.inf)
            if not (math.isfinite(v) and v > least and (v or label != "factor")):
                raise ParameterError(f"sensor {self.name}: impossible {label}: {v!r}")
        for what, span in (("range", self.plausible), ("limits", self.limits)):
            if span is not None and not span[0] < span[1]:
                raise ParameterError(f"sensor {self.name}: no {what}: {span!r}")
        for label in ("gain_as", "bias_as"):
            if getattr(self, label) not in WAYS:
                way = getattr(self, label)
                raise ParameterError(f"sensor {self.name}: {label} {way!r} {nearest(way, WAYS)}")
        if self.turn and (bad := [n for n in _NO_ANGLE if getattr(self, n)]):
            raise ParameterError(
                f"sensor {self.name}: an angle that is read modulo a turn has no {', '.join(bad)}"
            )
        if self.drift and self.bias_as != "estimated":
            raise ParameterError(f"sensor {self.name}: a bias that drifts must be estimated")
        object.__setattr__(self, "reads", tuple(self.reads) or (self.name,))
        if self.value is None and len(self.reads) > 1:
            raise ParameterError(
                f"sensor {self.name} reads {', '.join(self.reads)}: give value, its reading from "
                "them"
            )

    @property
    def direct(self) -> bool:
        """Whether it reads the output of its own name at once."""
        plain = self.value is None and self.factor == 1.0
        return self.reads == (self.name,) and plain and not self.tau

    @property
    def biased(self) -> bool:
        """Whether a filter of the gas path carries its offset."""
        return bool(self.bias or self.drift) and self.bias_as != "known"

    def unsure(self, error: str) -> float:
        """Return what a filter is not sure of, of ``"gain"`` or ``"bias"``: standard deviation."""
        return 0.0 if getattr(self, f"{error}_as") == "known" else float(getattr(self, error))

    @property
    def signal(self) -> Signal:
        """Its reading as a signal of a model."""
        Y = GasGenerator.Y
        if self.direct and self.name in Y.names:
            return Y[self.name]
        nominal = next((Y[n].nominal for n in self.reads if Y[n].unit == self.unit), 1.0)
        nominal = nominal if self.factor == 1.0 else abs(self.factor) * Y[self.reads[0]].nominal
        return Signal(self.name, self.unit, f"reading of {', '.join(self.reads)}", nominal=nominal)

    @property
    def expression(self) -> Callable[..., Any]:
        """What it reads of the values of ``reads``, its lag left out."""
        return _itself if self.value is None else self.value

    def of(self, y: Mapping[str, Any]) -> Any:
        """Return what it reads of outputs by name, its lag left out: numbers or expressions."""
        v = self.expression(*(y[n] for n in self.reads))
        return v if self.factor == 1.0 else self.factor * v

    def white(self, reading: Any) -> Any:
        """Return the standard deviation of the noise itself at a reading, in its unit."""
        return self.noise * abs(reading) if self.relative else self.noise

    @property
    def rest(self) -> float:
        """Standard deviation of what is white beside its noise: digits, and jitter (``extra``)."""
        return math.hypot(self.quantum / math.sqrt(12), self.extra)

    def sigma(self, reading: Any) -> Any:
        """Return the standard deviation of all that is white at a reading, in its unit."""
        noise = self.white(reading)
        return np.hypot(noise, self.rest) if self.rest else noise

    def more(self) -> dict[str, str]:
        """Return in words what it declares beside noise and gain, by name."""
        units = {"tau": "s", "rate": "Hz", "delay": "s", "jitter": "s", "bias": self.unit}
        units |= {"drift": f"{self.unit}/sqrt(s)", "quantum": self.unit, "bias_mean": self.unit}
        out = {n: f"{getattr(self, n):g} {u}" for n, u in units.items() if getattr(self, n)}
        out |= {"gain_mean": f"{self.gain_mean:g}"} if self.gain_mean else {}
        if self.limits is not None:
            out["range"] = f"{self.limits[0]:g} to {self.limits[1]:g} {self.unit}"
        out |= {"clock": self.clock} if self.clock else {}
        ways = {n: getattr(self, n) for n in ("gain_as", "bias_as")}
        return out | {n: way for n, way in ways.items() if way != WAYS[0]}

    def model(self) -> Sensor:
        """Return the sensor with what its equations hang on, its errors left out."""
        kept = {n: getattr(self, n) for n in ("reads", "value", "tau", "turn", "factor")}
        return Sensor(self.name, 0.0, self.relative, 0.0, self.unit, "", **kept)


@dataclass(frozen=True)
class SensorSet:
    """Sensors by name, in order."""

    sensors: tuple[Sensor, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Their names in order."""
        return tuple(s.name for s in self.sensors)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what the gas generator puts out; the others are its measured inputs."""
        return tuple(n for n in self.names if n not in GasGenerator.U.names)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Sensors whose gain error a filter may estimate.

        A counted speed has none, unless one is declared, and that of the shaft power is the
        generators' efficiency.
        """
        exact = {s.name for s in self.sensors if {*s.reads} <= {*GasGenerator.X.names}}
        exact -= {s.name for s in self.sensors if s.unsure("gain")}
        return tuple(n for n in self.names if n != "PW" and n not in exact)

    def __getitem__(self, name: str) -> Sensor:
        """Return a sensor; ParameterError with the nearest name if there is none."""
        for s in self.sensors:
            if s.name == name:
                return s
        raise ParameterError(f"unknown sensor {name!r} {nearest(name, self.names)}")

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def sigma(self, name: str, reading: Any) -> Any:
        """Return the standard deviation of the noise at a reading, unit of the signal."""
        return self[name].sigma(reading)

    def change(self, **noise: float) -> SensorSet:
        """Return the set with other noise of some sensors.

        Raises:
            ParameterError: unknown sensor, or no standard deviation.
        """
        changed = {
            n: dataclasses.replace(self[n], noise=s, source="changed by the user")
            for n, s in noise.items()
        }
        return SensorSet(tuple(changed.get(s.name, s) for s in self.sensors))

    def add(self, *sensors: str | Sensor) -> SensorSet:
        """Return the set with more sensors, by name (of :data:`KNOWN`) or made.

        Raises:
            ParameterError: unknown name, or a sensor that is there.
        """
        out = list(self.sensors)
        for given in sensors:
            if isinstance(given, str) and given not in KNOWN:
                raise ParameterError(f"unknown sensor {given!r} {nearest(given, KNOWN)}")
            new = KNOWN[given] if isinstance(given, str) else given
            if new.name in [s.name for s in out]:
                raise ParameterError(f"sensor {new.name!r} is in the set already")
            out.append(new)
        return SensorSet(tuple(out))

    def including(self, *names: str) -> SensorSet:
        """Return the set with those of :data:`KNOWN` that are named and not in it."""
        return self.add(*(n for n in names if n in KNOWN and n not in self))

    def only(self, names: Sequence[str]) -> SensorSet:
        """Return the set of some of the sensors, in the order of the names.

        Raises:
            ParameterError: unknown sensor.
        """
        return SensorSet(tuple(self[n] for n in names))

    def of_channel(self, name: str) -> Sensor | None:
        """Return the sensor of a channel, ``i_a_2``, or ``i_a`` of machine 1, or None."""
        asked = (name, f"{name}_1") if plain(name) == name else (name,)
        return next((self[n] for n in (*asked[::-1], plain(name)) if n in self), None)

    def machine(self, number: int) -> SensorSet:
        """Return one generator's sensors by plain names; entries of it alone go first."""
        if not self.numbered:
            return self
        names = dict.fromkeys(plain(n) for n in self.names)
        own = {n: next((e for e in (f"{n}_{number}", n) if e in self), None) for n in names}
        made = (dataclasses.replace(self[e], name=n) for n, e in own.items() if e is not None)
        return SensorSet(tuple(made))

    @property
    def numbered(self) -> tuple[int, ...]:
        """Numbers of the generators of which some sensor is declared by itself."""
        return tuple(sorted({int(n[-1]) for n in self.names if n != plain(n)}))

    def table(self) -> list[dict[str, Any]]:
        """Return one row for each sensor, for printing."""
        shown = ("name", "noise", "relative", "gain", "unit", "source")
        return [{n: getattr(s, n) for n in shown} | s.more() for s in self.sensors]

    def true(self, t: np.ndarray, y: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return what the sensors would read without errors.

        Args:
            t: instants, s, (K,).
            y: outputs of the model by name, (K,); where the name of a sensor of other outputs is
                among them, that is taken.
        """
        out = {}
        for s in self.sensors:
            there = s.name in y and s.name not in s.reads
            v = np.asarray(y[s.name] if there else s.of(y), float)
            out[s.name] = respond(t, v, s.tau) if s.tau and not there else v
        return out

    def measure(
        self,
        true: Mapping[str, Any],
        rng: np.random.Generator | None,
        *,
        gains: Mapping[str, float] | None = None,
        averaged: int = 1,
        noise_of: str = "reading",
    ) -> dict[str, np.ndarray]:
        """Return readings by name, of gain errors and white noise; drawn in the order of ``true``.

        Args:
            true: what the sensors would read without errors.
            rng: draws the noise; None for none.
            gains: actual relative gain errors, 0 where not given.
            averaged: each reading is the mean of that many.
            noise_of: relative noise is that of the ``"reading"``, gain error included, or of the
                ``"true"`` value.
        """
        out = {}
        for name, v in true.items():
            gain = (gains or {}).get(name, 0.0)
            size = v if noise_of == "true" or not gain else (1.0 + gain) * v
            sigma = self[name].white(size)
            out[name] = measure(v, sigma / math.sqrt(averaged), rng, gain=gain)
        return out

    def draw_gains(
        self, rng: np.random.Generator, names: Sequence[str] | None = None
    ) -> dict[str, float]:
        """Draw the constant gain errors of some sensors (all by default), Gaussian."""
        names = self.names if names is None else names
        return {n: self[n].gain * float(rng.standard_normal()) for n in names}

    def copies(
        self, ds: xr.Dataset, seed: int | None, *, gains: Mapping[str, float] | None = None
    ) -> xr.Dataset:
        """Return a run with a measured copy ``<name>_meas`` for each sensor, on its ``time``.

        Args:
            ds: from :func:`apu_casadi.unit.multirate.simulate_joint`.
            seed: of the noise; None for none.
            gains: actual relative gain errors by sensor.
        """
        time = np.asarray(ds["time"].values, float)
        there = {n: np.asarray(ds[n].values, float) for s in self.sensors for n in s.reads}
        rng = None if seed is None else np.random.default_rng(seed)
        read = self.measure(self.true(time, there), rng, gains=gains)
        docs = {n: f"measured: {self[n].signal.doc}" for n in read}
        told = {n: {"units": self[n].unit, "long_name": docs[n]} for n in read}
        return ds.assign({f"{n}_meas": ("time", v, told[n]) for n, v in read.items()})


def respond(t: np.ndarray, v: np.ndarray, tau: float) -> np.ndarray:
    """Return the response of a first-order lag, tau dx/dt = v - x, at rest in the beginning.

    Exact where the input is linear from sample to sample.
    """
    x = np.array(v, float)
    dt = np.diff(t)
    slope, keep = np.diff(v) / dt, np.exp(-dt / tau)
    for k in range(dt.size):
        follow = v[k] - slope[k] * tau  # what the response tends to, less the ramp
        x[k + 1] = follow + slope[k] * dt[k] + (x[k] - follow) * keep[k]
    return x


# ------------------------------------------------------------------------------ the tables

_SIMON = (
    "per cent of the reading as in Simon and Garg (2010), J. Eng. Gas Turbines Power 132, 031601"
)
_COUNTED = _SIMON + "; a counted speed has no gain error"
_CLASS = "assumed: transducer of accuracy class 0.5, noise of a 12-bit converter"
_POWER = "assumed where no electrical filter delivers it"

#: Gas-path sensors, sampled every 20 ms.  PW is the shaft power that the electrical side delivers.
GAS_PATH = SensorSet(
    (
        Sensor("N", 0.0025, True, 0.0, "rad/s", _COUNTED, (1500.0, 4600.0)),  # 40 to 122 %
        Sensor("P3", 0.005, True, 0.005, "Pa", _SIMON, (4e4, 2e6)),
        Sensor("T3", 0.0075, True, 0.005, "K", _SIMON, (300.0, 800.0)),
        Sensor("T5", 0.0075, True, 0.005, "K", _SIMON, (300.0, 1200.0)),
        Sensor("Wf", 0.01, True, 0.01, "kg/s", "assumed: turbine flow meter, 1 %", (5e-4, 0.12)),
        Sensor("PW", 0.01, True, 0.02, "W", _POWER, (-2e4, 9e5)),
    )
)

_COUPLE = "assumed: sheathed thermocouple, lag 0.5 s"
#: A thermocouple before the rotor: what a pyrometer reads at once it follows with a lag.
THERMOCOUPLE = Sensor(
    "T41_tc", 0.005, True, 0.005, "K", _COUPLE, (400.0, 1900.0), reads=("T41",), tau=0.5
)

#: Sensors that could be added.
MORE = (
    Sensor("W2", 0.01, True, 0.01, "kg/s", "assumed: bellmouth, 1 %", (0.1, 10.0)),
    Sensor("P5", 0.005, True, 0.005, "Pa", "assumed: as P3", (5e3, 2.5e5)),
    Sensor("T41", 0.01, True, 0.01, "K", "assumed: pyrometer, 1 %", (400.0, 1900.0)),
    THERMOCOUPLE,
)

#: Electrical sensors, sampled at 10 kHz.
ELECTRICAL = SensorSet(
    (
        *(Sensor(f"v_{k}", 0.5, False, 0.005, "V", _CLASS) for k in PHASES),
        *(Sensor(f"i_{k}", 1.0, False, 0.005, "A", _CLASS) for k in PHASES),
        Sensor("V_fd", 0.2, False, 0.005, "V", _CLASS),
        Sensor("i_fd", 0.5, False, 0.005, "A", _CLASS),
        Sensor("w_r", 5e-4, True, 0.0, "rad/s", "assumed: speed pick-up, 0.05 %"),
    )
)


def plain(name: str) -> str:
    """Return a quantity of a generator without the machine's number: ``v_a`` of ``v_a_2``."""
    head, _, machine = name.rpartition("_")
    return head if machine in NUMBERS and head in ELECTRICAL else name


#: All gas-path sensors by name, registered ones among them.
KNOWN: dict[str, Sensor] = {s.name: s for s in (*GAS_PATH.sensors, *MORE)}
#: Range of the readings of each of them, SI.
RANGES: dict[str, tuple[float, float]] = {n: s.plausible for n, s in KNOWN.items() if s.plausible}
_registered: dict[str, Sensor] = {}
_named: set[str] = set()


def register(sensor: Sensor) -> Sensor:
    """Make a sensor known by its name to filters, fits, files and commands; returns it.

    Raises:
        ParameterError: an output that the model does not have, or a name that is taken.
    """
    for n in sensor.reads:
        if n not in GasGenerator.Y.names:
            raise ParameterError(
                f"sensor {sensor.name}: no output {n!r} {nearest(n, GasGenerator.Y.names)}"
            )
    if sensor.name in KNOWN and sensor.name not in {*_registered, *_named}:
        raise ParameterError(f"a sensor {sensor.name!r} is known already: take another name")
    KNOWN[sensor.name] = _registered[sensor.name] = sensor
    if sensor.plausible is not None:
        RANGES[sensor.name] = sensor.plausible
    return sensor


def known(sensor: Sensor) -> Sensor:
    """Let files name a sensor's readings, without putting it into the default table; returns it.

    Raises:
        ParameterError: as :func:`register`.
    """
    if KNOWN.get(sensor.name) != sensor:
        added = register(sensor)
        del _registered[sensor.name]
        _named.add(added.name)
    return sensor


def unregister(name: str) -> None:
    """Forget a sensor that was registered or named; one of the tables stays."""
    if _registered.pop(name, None) is not None or name in _named:
        _named.discard(name)
        del KNOWN[name]
        RANGES.pop(name, None)


def gas_path_table() -> SensorSet:
    """Return the gas-path sensors that commands use: :data:`GAS_PATH` and what was registered."""
    return GAS_PATH.add(*_registered.values())
