"""The measurement equation (10): white Gaussian noise on terminal quantities."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, SignalError
from apu_casadi.core.measuring import measure


@dataclass(frozen=True)
class MeasurementNoise:
    """The measurement equation (10): white Gaussian noise on terminal quantities.

    Args:
        sigma_i: standard deviation of v_i, phase currents, A.
        sigma_v: standard deviation of v_v, phase voltages, V.
        sigma_V_fd: standard deviation of v_v, field voltage, V.
    """

    sigma_i: float = 0.0
    sigma_v: float = 0.0
    sigma_V_fd: float = 0.0

    def __post_init__(self) -> None:
        """Refuse standard deviations that are negative or not finite."""
        for name in ("sigma_i", "sigma_v", "sigma_V_fd"):
            value = number(f"MeasurementNoise.{name}", getattr(self, name), error=ParameterError)
            if not (math.isfinite(value) and value >= 0):
                raise ParameterError(f"MeasurementNoise.{name} must be >= 0, got {value!r}")

    def measure(self, y: Mapping[str, Any], rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return noisy i_a, i_b, i_c, v_a, v_b, v_c, V_fd, each of the shape it has in ``y``.

        Args:
            y: true values by name; a Dataset, or ``ss.y.unpack(step.y)``.
            rng: the caller's generator; nothing is seeded here.
        """
        return dict(self.each(y, rng))

    def each(
        self, y: Mapping[str, Any], rng: np.random.Generator
    ) -> Iterator[tuple[str, np.ndarray]]:
        """Yield name and noisy values of :meth:`measure` one after the other."""
        sigmas = dict.fromkeys(("i_a", "i_b", "i_c"), self.sigma_i)
        sigmas |= dict.fromkeys(("v_a", "v_b", "v_c"), self.sigma_v)
        sigmas["V_fd"] = self.sigma_V_fd
        missing = [n for n in sigmas if n not in y]
        if missing:
            raise SignalError(f"to be measured but absent: {', '.join(missing)}")
        for n, sigma in sigmas.items():
            yield n, measure(y[n], sigma, rng)
