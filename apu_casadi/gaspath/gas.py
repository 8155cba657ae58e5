"""Ideal-gas properties of humid air and of its lean, complete combustion products.

NASA polynomials are summed, once, to three pseudo species per kilogram: dry air, water vapour,
and the *change* that burning one kilogram of fuel CHx completely brings to the mixture,

    CHx + (1 + x/4) O2 -> CO2 + x/2 H2O.

A mixture is then given by two numbers, both per kilogram of dry air: ``FAR``, the burnt fuel, and
``war``, the water vapour.  Every property is linear in them, and exact for lean mixtures.  Gases
do not dissociate; against chemical equilibrium at 8 bar that is 0.04 % of cp T in enthalpy at
1200 K, 0.2 % at 1500 K and 1.7 % at 2200 K (``apu validate --only cantera``).

Two sets of coefficients, one formula:

- ``nasa9``: NASA/TP-2002-211556 (2002), nine coefficients; the more accurate physics.
- ``nasa7``: NASA TM-4513 (1993), seven coefficients.  GasTurb's gas is built on data of that
  generation, and so are the paper's tables: its T3 at the design point comes out within 8e-5
  with nasa7 and 3.4e-4 with nasa9, its NOx severity within 4e-5 and 8e-4.

Sensible enthalpies are referred to 298.15 K, at which the lower heating value is defined.
Entropies leave out the entropy of mixing: only differences at fixed composition are ever used.
All functions take floats, ``SX`` or ``MX``.  Valid from 200 K to 2200 K; the polynomials reach
to 6000 K and continue smoothly below 200 K.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.sharing import Parametric, derived, once

R_UNIVERSAL = 8314.462618  # J/(kmol K), CODATA 2018
T_REF = 298.15  # K, reference of sensible enthalpy and of the heating value
P_STD = 101325.0  # Pa
T_MID = 1000.0  # K, where the two polynomial ranges meet
COEFFICIENTS = ("a1", "a2", "a3", "a4", "a5", "a6", "a7", "b1", "b2")  # NASA's, of a range

# Dry air by mole; closes the flows and temperatures of the paper's tables (N2 78.084 %,
# O2 20.9476 %, Ar 0.9365 %, CO2 0.0319 %; U.S. Standard Atmosphere 1976).
DRY_AIR = {"N2": 0.78084, "O2": 0.209476, "Ar": 0.009365, "CO2": 0.000319}
M_C, M_H = 12.0107, 1.00794  # kg/kmol


DATA_SETS = ("nasa9", "nasa7")


@once
def species(data: str) -> dict[str, tuple[float, np.ndarray]]:
    """Read molar masses (kg/kmol) and coefficients, shape (2, 9), of each species."""
    rows: dict[str, list[list[float]]] = {}
    masses: dict[str, float] = {}
    text = (
        resources.files("apu_casadi.gaspath.data")
        .joinpath(f"{data}.csv")
        .read_text(encoding="utf-8")
    )
    for row in csv.DictReader(line for line in text.splitlines() if not line.startswith("#")):
        name = row["species"]
        masses[name] = float(row["M_kg_per_kmol"])
        rows.setdefault(name, []).append([float(row[k]) for k in COEFFICIENTS])
    for name, r in rows.items():
        if len(r) != 2:
            raise DataError(f"{data}.csv: species {name} has {len(r)} temperature ranges, not 2")
    return {n: (masses[n], np.array(r)) for n, r in rows.items()}


def _cp_over_R(a: Any, T: Any) -> Any:
    """cp/R of one NASA-9 range."""
    slope = a[3] + T * (a[4] + T * (a[5] + T * a[6]))
    return a[0] / T**2 + a[1] / T + a[2] + T * slope


def _h_over_R(a: Any, T: Any) -> Any:
    """h/R, in K, of one NASA-9 range; ``a[7]`` is the integration constant b1."""
    poly = T * (a[2] + T * (a[3] / 2 + T * (a[4] / 3 + T * (a[5] / 4 + T * a[6] / 5))))
    return -a[0] / T + a[1] * ca.log(T) + poly + a[7]


def _s_over_R(a: Any, T: Any) -> Any:
    """s0/R at standard pressure of one NASA-9 range; ``a[8]`` is the constant b2."""
    poly = T * (a[3] + T * (a[4] / 2 + T * (a[5] / 3 + T * a[6] / 4)))
    return -a[0] / (2 * T**2) - a[1] / T + a[2] * ca.log(T) + poly + a[8]


@once
def _by_range(formula: Callable[[Any, Any], Any]) -> ca.Function:
    """Function (coefficients of both ranges, shape (2, 9); T) -> property on the range of T.

    Models take it in as the expression that it is, much faster than Python writes it again.
    """
    c, T = ca.SX.sym("c", 2, 9), ca.SX.sym("T")
    low, high = (formula(ca.horzsplit(c[k, :]), T) for k in (0, 1))
    return ca.Function("by_range", [c, T], [ca.if_else(T < T_MID, low, high)])


@once
def _coefficients(data: str) -> dict[str, np.ndarray]:
    """Coefficients of each species, shape (2, 9), with enthalpy 0 at T_REF and no jump."""
    out = {}
    for name, (_, given) in species(data).items():
        c = given.copy()
        # sensible enthalpy: zero at T_REF on the low range, same shift on the high one
        c[:, 7] -= float(_h_over_R(c[0], T_REF))
        # the printed digits leave jumps of 1e-9 at 1000 K; close them, Newton sees them
        c[1, 7] += float(_h_over_R(c[0], T_MID) - _h_over_R(c[1], T_MID))
        c[1, 8] += float(_s_over_R(c[0], T_MID) - _s_over_R(c[1], T_MID))
        out[name] = c
    return out


def _per_kg(moles: dict[str, Any], mass: Any, data: str) -> Any:
    """Coefficients times R, J/(kg K), of a mixture of so many moles in so many kg/kmol."""
    given, kind = _coefficients(data), ca.DM if isinstance(mass, ca.SX | ca.MX) else np.asarray
    total: Any = 0.0
    for n, nu in moles.items():
        total = total + nu * kind(given[n])
    return total * R_UNIVERSAL / mass


@once
def used(data: str) -> np.ndarray:
    """Return which coefficients some species has, shape (2, 9): nasa7 has two fewer."""
    made: np.ndarray = np.any([c != 0 for c in _coefficients(data).values()], axis=0)
    return made


@once
def dry_and_wet(data: str) -> tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]:
    """Return coefficients and gas constant, J/(kg K), of dry air and of water vapour."""
    sp, norm = species(data), sum(DRY_AIR.values())
    m_air = sum(y * sp[n][0] for n, y in DRY_AIR.items()) / norm
    air = _per_kg({n: y / norm for n, y in DRY_AIR.items()}, m_air, data)
    water = _per_kg({"H2O": 1.0}, sp["H2O"][0], data)
    return (air, R_UNIVERSAL / m_air), (water, R_UNIVERSAL / sp["H2O"][0])


def fuel_burning(x: Any, data: str) -> tuple[Any, Any]:
    """Return coefficients and gas constant, J/(kg K), of burning 1 kg of CHx; x may be a symbol."""
    mass = M_C + x * M_H
    moles = {"CO2": 1.0, "H2O": x / 2, "O2": -(1 + x / 4)}
    return _per_kg(moles, mass, data), R_UNIVERSAL * ((1 + x / 2 - (1 + x / 4)) / mass)


@dataclass(frozen=True)
class Gas(Parametric):
    """Working gas: dry air of fixed composition, water vapour, and products of a fuel CHx.

    Args:
        x_HC: hydrogen atoms per carbon atom of the fuel (1.9185: kerosene).
        data: ``"nasa9"`` or ``"nasa7"``.

    Raises:
        ParameterError: a fuel that is not CHx with 0 <= x <= 4, or an unknown data set.
    """

    x_HC: float = 1.9185
    data: str = "nasa9"

    def __post_init__(self) -> None:
        """Check the fuel and the name of the data."""
        if self.data not in DATA_SETS:
            raise ParameterError(f"Gas.data = {self.data!r} {nearest(self.data, DATA_SETS)}")
        if not 0.0 <= self.x_HC <= 4.0:
            raise ParameterError(f"Gas.x_HC = {self.x_HC} is outside [0, 4]")

    @classmethod
    def of_symbols(cls, x_HC: Any, data: str, burning: tuple[Any, Any] | None = None) -> Gas:
        """Return a gas whose fuel is given by symbols; nothing is checked.

        Args:
            x_HC, data: as in the class.
            burning: as :meth:`burning` returns it, where that is known; it is made of x_HC if not.
        """
        air, water = dry_and_wet(data)
        coefficients, R = fuel_burning(x_HC, data) if burning is None else burning
        new = object.__new__(cls)
        known = {"_pseudo": (air[0], water[0], coefficients), "_R": (air[1], water[1], R)}
        new.__dict__.update(x_HC=x_HC, data=data, **known)
        return new

    @derived
    def burning(self) -> tuple[np.ndarray, float]:
        """Coefficients, shape (2, 9), and gas constant of burning 1 kg of fuel, J/(kg K)."""
        made: tuple[np.ndarray, float] = fuel_burning(self.x_HC, self.data)
        return made

    @derived
    def _pseudo(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients times R in J/(kg K), each of shape (2, 9), of air, water, burning."""
        air, water = dry_and_wet(self.data)
        return air[0], water[0], self.burning[0]

    @derived
    def _R(self) -> tuple[float, float, float]:
        """Gas constants, J/(kg K), of air, water vapour and the burning of 1 kg of fuel."""
        air, water = dry_and_wet(self.data)
        return air[1], water[1], self.burning[1]

    @property
    def FAR_stoichiometric(self) -> float:
        """Fuel per dry air, kg/kg, at which the oxygen is used up; the model's upper limit."""
        sp = species(self.data)
        m_air = sum(y * sp[n][0] for n, y in DRY_AIR.items()) / sum(DRY_AIR.values())
        y_O2 = DRY_AIR["O2"] / sum(DRY_AIR.values())
        return float(y_O2 / (1 + self.x_HC / 4) * (M_C + self.x_HC * M_H) / m_air)

    def _mix(self, T: Any, FAR: Any, war: Any, formula: Any) -> Any:
        """Evaluate a property per kg of mixture on the range that T is in."""
        a, w, b = (x if isinstance(x, ca.SX | ca.MX) else ca.DM(x) for x in self._pseudo)
        (value,) = _by_range(formula).call([a + war * w + FAR * b, T], True, False)
        return value / (1 + war + FAR)

    def R(self, FAR: Any = 0.0, war: Any = 0.0) -> Any:
        """Gas constant, J/(kg K)."""
        a, w, b = self._R
        return (a + war * w + FAR * b) / (1 + war + FAR)

    def cp(self, T: Any, FAR: Any = 0.0, war: Any = 0.0) -> Any:
        """Specific heat at constant pressure, J/(kg K), at T in K."""
        return self._mix(T, FAR, war, _cp_over_R)

    def h(self, T: Any, FAR: Any = 0.0, war: Any = 0.0) -> Any:
        """Sensible enthalpy, J/kg, zero at 298.15 K."""
        return self._mix(T, FAR, war, _h_over_R)

    def s0(self, T: Any, FAR: Any = 0.0, war: Any = 0.0) -> Any:
        """Temperature part of the entropy, J/(kg K): s = s0(T) - R ln(P/P_std) + const."""
        return self._mix(T, FAR, war, _s_over_R)

    def gamma(self, T: Any, FAR: Any = 0.0, war: Any = 0.0) -> Any:
        """Ratio of specific heats."""
        cp = self.cp(T, FAR, war)
        return cp / (cp - self.R(FAR, war))

    def T_of_h(self, h: Any, T_start: Any, FAR: Any = 0.0, war: Any = 0.0, n: int = 4) -> Any:
        """Temperature, K, at which the enthalpy is ``h``, by ``n`` Newton steps from ``T_start``.

        Unrolled, so that it is an expression with exact derivatives.  cp varies so slowly that
        an error of 5 % in ``T_start`` falls below 1e-13 in four steps.
        """
        T = T_start
        for _ in range(n):
            T = T - (self.h(T, FAR, war) - h) / self.cp(T, FAR, war)
        return T
