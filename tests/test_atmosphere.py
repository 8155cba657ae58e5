"""The standard atmosphere and the ram state."""

import pytest

from apu_casadi.gaspath.atmosphere import ambient, isa
from apu_casadi.gaspath.gas import Gas


@pytest.mark.parametrize(
    ("H", "T", "P"),
    [(0, 288.15, 101325), (2000, 275.15, 79495.2), (5000, 255.65, 54019.9), (8000, 236.15, 35599.8),
     (11000, 216.65, 22632.1), (13000, 216.65, 16510.4), (15000, 216.65, 12044.6)],
)  # fmt: skip
def test_isa_table(H, T, P):
    """ICAO Doc 7488, geopotential altitude; six printed digits of pressure."""
    T0, P0 = isa(H)
    assert float(T0) == pytest.approx(T, abs=1e-9)
    assert float(P0) == pytest.approx(P, rel=5e-6)


def test_deviation_shifts_temperature_only():
    """A deviation leaves the pressure alone."""
    assert float(isa(8000.0, 5.0)[0]) == pytest.approx(241.15)
    assert float(isa(8000.0, 5.0)[1]) == float(isa(8000.0, 0.0)[1])


def test_ram_state_of_table_5():
    """Paper, Table 5: T1 264.829 K and P1 = P2/0.99 = 49.3884 kPa at 8000 m, Mach 0.7, ISA + 5 K.

    1e-4: GasTurb's own gas tables.
    """
    a = ambient(altitude=8000.0, Mach=0.7, dT_isa=5.0, war=0.0, gas=Gas())
    assert float(a.T1) == pytest.approx(264.829, rel=1e-4)
    assert float(a.P1) == pytest.approx(48894.5 / 0.99, rel=1e-4)


def test_ram_state_conserves_energy_and_entropy():
    """h1 = h0 + V0^2/2 and s1 = s0, re-evaluated (1e-12: three Newton steps suffice)."""
    gas = Gas()
    a = ambient(altitude=10000.0, Mach=0.8, dT_isa=-20.0, war=0.005, gas=gas)
    h0, h1 = gas.h(a.T0, 0, 0.005), gas.h(a.T1, 0, 0.005)
    assert float(h1 - h0 - a.V0**2 / 2) == pytest.approx(0.0, abs=1e-7)
    import casadi as ca

    ds = gas.s0(a.T1, 0, 0.005) - gas.s0(a.T0, 0, 0.005)
    assert float(ds / gas.R(0, 0.005) - ca.log(a.P1 / a.P0)) == pytest.approx(0.0, abs=1e-12)
