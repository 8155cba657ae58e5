"""Files of what is known before a recording begins, of the gas path and of the generators.

    [f_eta_c]
    mean = 0.985           # of the last overhaul's report
    sigma = 0.005
    [gain_T5]
    sigma = 0.001          # calibrated: the mean stays
    [machine.r_s]
    sigma = 0.02           # of the value; 0: known
    [machine.L_md]
    sigma = 0.05
    how = "estimated"      # or "considered", as without it, or "known"
    [delay_i]
    sigma = 2e-6           # s, of the currents behind the voltages
    [h]
    probability = 0.01     # of a short circuit; sigma: of its severity
    [h_a]
    mean = 3e-4            # if phase a has it
    sigma = 1e-4

The first two are states of the gas-path filter; parameters of the generators are those of
:mod:`estimators.apu.unknowns`, whose sigmas are shares of the values; severities have the prior
:class:`estimators.apu.electrical.hypotheses.SeverityPrior`.  What is not named is as usual.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.signals import Signals
from apu_casadi.core.tomlnumbers import read_toml
from apu_casadi.machine.park import PHASES
from estimators.apu.electrical.hypotheses import SeverityPrior
from estimators.apu.electrical.terminalsignals import DELAY
from estimators.apu.unknowns import (
    EFFICIENCY,
    INERTIA,
    UNKNOWNS,
    Knowledge,
    known_parameters,
)

__all__ = ["Prior", "read_prior"]

KEYS = ("mean", "sigma")
ANY = "h"  # the severity of whatever phase
BOTH = (EFFICIENCY, INERTIA)  # of which the gas path knows as well
SEVERITIES = (ANY, *(f"h_{p}" for p in PHASES))


@dataclass(frozen=True)
class Prior:
    """Means and standard deviations by state of the gas-path filter, parameter, or severity.

    Args:
        mean, sigma: what differs from the usual.
        source: file that says so.
        probability: that a generator has a short circuit; None: the usual one.
        how: what is done about a parameter, by name: see
            :class:`~estimators.apu.unknowns.Knowledge`.
    """

    mean: Mapping[str, float] = field(default_factory=dict)
    sigma: Mapping[str, float] = field(default_factory=dict)
    source: str = "prior"
    probability: float | None = None
    how: Mapping[str, str] = field(default_factory=dict)

    def check(self, states: Signals, *, generators: bool = True) -> None:
        """Refuse states that the filters do not have.

        Args:
            states: of the gas-path filter.
            generators: whether there is an electrical filter.

        Raises:
            DataError: with the nearest name.
        """
        own = (*SEVERITIES, *known_parameters())
        for n in {**self.mean, **self.sigma, **self.how}:
            if n in own and n not in BOTH and not generators:
                what = "severity" if n in SEVERITIES else "parameter of the generators"
                raise DataError(f"{self.source}: {n} is a {what}, and none of them was measured")
            if n not in (*states.names, *own):
                hint = nearest(n, (*states.names, *own))
                raise DataError(f"{self.source}: no state {n!r} of the gas-path filter {hint}")

    def of_gas_path(self) -> Prior:
        """Return what is said of states of the gas-path filter."""
        other = (*SEVERITIES, *known_parameters())
        mean, sigma = ({n: v for n, v in d.items() if n not in other} for d in self._both)
        return replace(self, mean=mean, sigma=sigma)

    @property
    def _both(self) -> tuple[Mapping[str, float], Mapping[str, float]]:
        return self.mean, self.sigma

    def values(self) -> dict[str, float]:
        """Return the generators' parameters of which a mean is said, by name.

        Raises:
            DataError: the delay, or the inertia, which are not set in that way.
        """
        out = {n: v for n, v in self.mean.items() if n in known_parameters()}
        for n in out:
            if "." not in n:
                how = "in the file of sensors" if n == DELAY.name else "in the engine's file"
                raise DataError(f"{self.source}: {n} has no mean here: declare it {how}")
        return out

    def unknowns(self) -> dict[str, Knowledge]:
        """Return what is known of parameters, by name, the usual included.

        Raises:
            DataError: a standard deviation below 0, or none of what is not known.
        """
        out = dict(UNKNOWNS)
        for n in known_parameters():
            if n not in self.sigma and n not in self.how:
                continue
            usual = out.get(n, Knowledge("known"))
            sigma = self.sigma.get(n, usual.sigma)
            if not sigma >= 0:
                raise DataError(f"{self.source}, {n}: sigma = {sigma!r} must be >= 0")
            try:
                if n in self.how:
                    known = self.how[n] == "known" and n not in self.sigma
                    out[n] = Knowledge(self.how[n], 0.0 if known else sigma)
                else:
                    out[n] = Knowledge.of(sigma, usual.how if usual.sigma else "considered")
            except ParameterError as e:
                raise DataError(f"{self.source}, {n}: {e}") from None
        return out

    def severity(self) -> SeverityPrior:
        """Return what is known of a short circuit.

        Raises:
            DataError: an impossible number.
        """
        usual, said = SeverityPrior(), dict[str, tuple[float, ...]]()
        for name, given, old in zip(
            ("mean", "scale"), self._both, (usual.mean, usual.scale), strict=True
        ):
            said[name] = tuple(
                given.get(n, given.get(ANY, v)) for n, v in zip(SEVERITIES[1:], old, strict=True)
            )
        p = usual.probability if self.probability is None else self.probability
        try:
            return SeverityPrior(p, said["mean"], said["scale"])  # type: ignore[arg-type]
        except ParameterError as e:
            raise DataError(f"{self.source}: {e}") from None


def read_prior(path: str | Path) -> Prior:
    """Read a file of priors.

    Raises:
        DataError: no such file, no TOML, an unknown key, no number; it says where.
    """
    data = read_toml(path, "")
    found: dict[str, dict[str, float]] = {k: {} for k in KEYS}
    probability, how = None, dict[str, str]()
    for name, row in _flat(data).items():
        if not isinstance(row, dict) or not row:
            raise DataError(f"{path}: a table [{name}] with mean or sigma is expected, got {row!r}")
        keys = (*KEYS, "probability") if name == ANY else KEYS
        keys = (*keys, "how") if name in known_parameters() else keys
        for key, v in row.items():
            if key not in keys:
                raise DataError(f"{path}, {name}: unknown key {key!r} {nearest(key, keys)}")
            if key == "how":
                how[name] = str(v)
                continue
            number = isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)
            zero = name in known_parameters()  # what is known
            if not number or (key == "sigma" and not (v > 0 or (zero and v == 0))):
                least = " > 0" if key == "sigma" else ""
                raise DataError(f"{path}, {name}: {key} must be a number{least}, got {v!r:.40}")
            if key == "probability":
                probability = float(v)
            else:
                found[key][name] = float(v)
    made = Prior(found["mean"], found["sigma"], str(path), probability, how)
    made.unknowns()  # says what cannot be
    return made


def _flat(data: Mapping[str, object]) -> dict[str, object]:
    """Tables by name, those of parameters as ``machine.r_s``."""
    out: dict[str, object] = {}
    for name, row in data.items():
        if isinstance(row, dict) and row and all(isinstance(v, dict) for v in row.values()):
            out |= {f"{name}.{n}": v for n, v in row.items()}
        else:
            out[name] = row
    return out
