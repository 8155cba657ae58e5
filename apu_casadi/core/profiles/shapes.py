"""Profiles by a formula: ramp, exponential growth, on and off."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from apu_casadi.core.errors import ScenarioError
from apu_casadi.core.profiles.profile import MOST_JUMPS, PROFILES, Profile, in_run
from apu_casadi.core.register import Key

_AFTER = Key("after", "s", "time before it begins", 0.0, default=0.0)


class _Checked(Profile):
    """A profile whose fields are checked by its keys."""

    def __post_init__(self) -> None:
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        for key, f in zip(self.keys, fields, strict=True):
            object.__setattr__(self, f.name, key.read(getattr(self, f.name)))


@dataclass(frozen=True)
class _Between(_Checked):
    """From one value to another over a time; constant before and after.

    Args:
        first, last: values.
        over: time from one to the other, s, > 0.
        after: time before it begins, s.
    """

    first: float
    last: float
    over: float
    after: float = 0.0

    keys: ClassVar[tuple[Key, ...]] = (
        Key("from", "", "first value"),
        Key("to", "", "last value"),
        Key("over", "s", "time from one to the other", 0.0, open_lo=True),
        _AFTER,
    )

    def _share(self, t: np.ndarray) -> np.ndarray:
        return np.asarray(np.clip((t - self.after) / self.over, 0.0, 1.0))

    @property
    def bounds(self) -> tuple[float, float]:
        """The two values."""
        return min(self.first, self.last), max(self.first, self.last)

    def corners(self, duration: float) -> tuple[float, ...]:
        """Beginning and end of the change."""
        return in_run((self.after, self.after + self.over), duration)

    @property
    def label(self) -> str:
        """As in ``'ramp from 1 to 0.97 over 60 s'``."""
        late = f" after {self.after:g} s" if self.after else ""
        return f"{self.word} from {self.first:g} to {self.last:g} over {self.over:g} s{late}"


@PROFILES.add("ramp")
@dataclass(frozen=True)
class Ramp(_Between):
    """A straight line from one value to another; constant before and after.

    Args:
        first, last: values.
        over: time from one to the other, s, > 0.
        after: time before it begins, s.

    Raises:
        ScenarioError: a value out of range.
    """

    word = "ramp"

    def values(self, t: np.ndarray) -> np.ndarray:
        """Linear in between."""
        return np.asarray(self.first + (self.last - self.first) * self._share(t))


@PROFILES.add("exponential")
@dataclass(frozen=True)
class Growth(_Between):
    """Exponential growth or decay from one value to another; constant before and after.

    Args:
        first, last: values, of one sign, not zero.
        over: time from one to the other, s, > 0.
        after: time before it begins, s.

    Raises:
        ScenarioError: a value out of range.
    """

    word = "exponential"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.first * self.last > 0:
            raise ScenarioError(
                f"from: exponential growth from {self.first:g} to {self.last:g}: both must be of "
                "one sign, and none zero; a ramp goes to zero"
            )

    def values(self, t: np.ndarray) -> np.ndarray:
        """As first (last/first)^share."""
        rate = math.log(self.last / self.first)
        return np.asarray(self.first * np.exp(rate * self._share(t)))


@PROFILES.add("on-off")
@dataclass(frozen=True)
class OnOff(_Checked):
    """A square wave: on for a share of each period, then off; off before it begins.

    Args:
        on, off: values.
        frequency: Hz, > 0.
        duty: share of the period that it is on, 0 < duty < 1.
        after: time before it begins, s.

    Raises:
        ScenarioError: a value out of range.
    """

    on: float
    off: float
    frequency: float
    duty: float = 0.5
    after: float = 0.0

    word = "on-off"
    keys: ClassVar[tuple[Key, ...]] = (
        Key("on", "", "value while it is on"),
        Key("off", "", "value while it is off"),
        Key("frequency", "Hz", "periods in a second", 0.0, 1000.0, open_lo=True),
        Key("duty", "1", "share of the period that it is on", 1e-3, 0.999, default=0.5),
        _AFTER,
    )

    def values(self, t: np.ndarray) -> np.ndarray:
        """On or off; a switch counts a rounding earlier."""
        turns = (t - self.after) * self.frequency + 1e-12
        on = (turns >= 0) & (turns - np.floor(turns) < self.duty)
        return np.where(on, self.on, self.off)

    @property
    def bounds(self) -> tuple[float, float]:
        """The two values."""
        return min(self.on, self.off), max(self.on, self.off)

    def instants(self, duration: float) -> tuple[float, ...]:
        """Every switch."""
        if self.on == self.off:
            return ()
        periods = (duration - self.after) * self.frequency
        if not math.isfinite(periods):
            periods = 1.0
        if 2 * periods > MOST_JUMPS:
            raise ScenarioError(
                f"frequency: {self.frequency:g} Hz jumps {2 * periods:.0f} times in "
                f"{duration:g} s, {MOST_JUMPS} at most"
            )
        k = np.arange(max(0, math.ceil(periods)))
        turns = np.concatenate([k, k + self.duty])
        return in_run(self.after + turns / self.frequency, duration)

    @property
    def label(self) -> str:
        """As in ``'on-off 0.05 and 0 at 5 Hz'``."""
        share = f", {100 * self.duty:g} % of the time" if self.duty != 0.5 else ""
        late = f" after {self.after:g} s" if self.after else ""
        return f"on-off {self.on:g} and {self.off:g} at {self.frequency:g} Hz{share}{late}"
