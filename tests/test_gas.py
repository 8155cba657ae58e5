"""Gas properties against Cantera, and against their own definitions."""

import casadi as ca
import numpy as np
import pytest

from apu_casadi.errors import ParameterError
from apu_casadi.gas import DRY_AIR, M_C, M_H, P_STD, T_REF, Gas

ct = pytest.importorskip("cantera")

TEMPERATURES = np.array([200.0, 250, 298.15, 400, 600, 800, 999, 1001, 1200, 1500, 1800, 2200])
FAR_WAR = [(0.0, 0.0), (0.0, 0.02), (0.01, 0.0), (0.02, 0.01), (0.04, 0.0)]


def mixture(FAR, war, x):
    """Moles of each species per kilogram of dry air, by hand."""
    m_air = sum(DRY_AIR[n] * M for n, M in (("N2", 28.0134), ("O2", 31.9988), ("Ar", 39.948),
                                            ("CO2", 44.0095))) / sum(DRY_AIR.values())  # fmt: skip
    n_air = 1 / m_air / sum(DRY_AIR.values())
    moles = {n: y * n_air for n, y in DRY_AIR.items()} | {"H2O": war / 18.01528}
    n_fuel = FAR / (M_C + x * M_H)
    moles["CO2"] += n_fuel
    moles["H2O"] += n_fuel * x / 2
    moles["O2"] -= n_fuel * (1 + x / 4)
    return moles


@pytest.fixture(scope="module")
def cantera_nasa7():
    species = [s for s in ct.Species.list_from_file("nasa_gas.yaml")
               if s.name in ("N2", "O2", "Ar", "CO2", "H2O")]  # fmt: skip
    return ct.Solution(thermo="ideal-gas", species=species)


@pytest.mark.parametrize(("FAR", "war"), FAR_WAR)
def test_frozen_products_equal_cantera(cantera_nasa7, FAR, war):
    """Cantera 3 with its own NASA-7 data (nasa_gas.yaml): same data, independent code and mixing.

    2e-5: Cantera's molar masses differ from those of 1993 by that much (O2: 31.998, 31.9988).
    """
    g = Gas(data="nasa7")
    X = {n: max(v, 0.0) for n, v in mixture(FAR, war, g.x_HC).items()}
    c = cantera_nasa7
    c.TPX = T_REF, P_STD, X
    h_ref, s_ref = c.h, c.s
    s0_ref = float(g.s0(T_REF, FAR, war))
    for T in TEMPERATURES:
        c.TPX = T, P_STD, X
        scale = c.cp * T
        assert float(g.cp(T, FAR, war)) == pytest.approx(c.cp, rel=3e-5)
        assert abs(float(g.h(T, FAR, war)) - (c.h - h_ref)) < 3e-5 * scale
        assert abs(float(g.s0(T, FAR, war)) - s0_ref - (c.s - s_ref)) < 3e-5 * c.cp
    assert float(g.R(FAR, war)) == pytest.approx(ct.gas_constant / c.mean_molecular_weight, rel=3e-5)


def test_nasa9_of_air_species_equals_cantera():
    """Cantera's airNASA9.yaml carries N2 and O2 of NASA/TP-2002-211556 (1e-6: printed digits)."""
    from apu_casadi.gas import _cp_over_R, _species

    theirs = {s.name: s.thermo for s in ct.Species.list_from_file("airNASA9.yaml")}
    ours = _species("nasa9")
    for name in ("N2", "O2"):
        for T in TEMPERATURES:
            cp = float(_cp_over_R(ours[name][1][0 if T < 1000 else 1], T)) * ct.gas_constant
            assert cp == pytest.approx(theirs[name].cp(T), rel=1e-6)


def test_nasa9_and_nasa7_differ_by_what_the_docs_say():
    """gas.py: nasa7 lies up to 0.4 % below nasa9 in cp of dry air; the two bracket each other."""
    a, b = Gas(data="nasa9"), Gas(data="nasa7")
    ratio = np.array([float(b.cp(T)) / float(a.cp(T)) - 1 for T in np.arange(250.0, 1600.0, 10)])
    assert np.abs(ratio).max() < 4.5e-3
    assert np.abs(ratio).max() > 2e-3


def test_frozen_against_equilibrium_products():
    """No dissociation: against Cantera's equilibrium with the same data, 8 bar, FAR 0.02.

    The module says 0.04 % of cp T at 1200 K, 0.2 % at 1500 K and 1.7 % at 2200 K.
    """
    names = ("N2", "O2", "Ar", "CO2", "H2O", "CO", "OH", "NO", "NO2", "H2", "O", "H")
    species = [s for s in ct.Species.list_from_file("nasa_gas.yaml") if s.name in names]
    gas = ct.Solution(thermo="ideal-gas", species=species)
    g = Gas(data="nasa7")
    X = {n: max(v, 0.0) for n, v in mixture(0.02, 0.0, g.x_HC).items()}

    def error(T):
        gas.TPX = T_REF, 8 * P_STD, X
        h_ref = gas.h
        gas.TPX = T, 8 * P_STD, X
        gas.equilibrate("TP")
        return abs(float(g.h(T, 0.02)) - (gas.h - h_ref)) / (gas.cp * T)

    assert error(1200.0) < 4e-4
    assert error(1500.0) < 2e-3
    assert 1.5e-2 < error(2200.0) < 1.7e-2


@pytest.mark.parametrize("data", ["nasa9", "nasa7"])
def test_cp_and_entropy_are_derivatives_of_enthalpy(data):
    """cp = dh/dT and ds0/dT = cp/T, by exact derivatives (1e-11: rounding of the polynomials)."""
    g = Gas(data=data)
    T = ca.SX.sym("T")
    h, s0, cp = g.h(T, 0.02, 0.01), g.s0(T, 0.02, 0.01), g.cp(T, 0.02, 0.01)
    f = ca.Function("f", [T], [ca.jacobian(h, T) / cp, T * ca.jacobian(s0, T) / cp])
    for T_ in TEMPERATURES:
        np.testing.assert_allclose(np.array(f(T_)).ravel(), 1.0, rtol=1e-11)


@pytest.mark.parametrize("data", ["nasa9", "nasa7"])
def test_properties_join_at_1000_K(data):
    """Enthalpy and entropy are continuous where the ranges meet, to rounding: Newton needs it."""
    g = Gas(data=data)
    below, above = np.nextafter(1000.0, 0), 1000.0
    for f in (g.h, g.s0):
        assert float(f(above, 0.02)) == pytest.approx(float(f(below, 0.02)), rel=2e-14)


def test_temperature_of_enthalpy_inverts():
    """T_of_h from a start 5 % off returns the temperature to 1e-10 K, as its docstring says."""
    g = Gas()
    for T in TEMPERATURES:
        h = g.h(T, 0.02, 0.01)
        assert float(g.T_of_h(h, 1.05 * T, 0.02, 0.01)) == pytest.approx(T, abs=1e-10)


def test_enthalpy_is_zero_at_the_reference():
    """Sensible enthalpy vanishes at 298.15 K for every mixture (rounding only)."""
    for FAR, war in FAR_WAR:
        assert abs(float(Gas().h(T_REF, FAR, war))) < 1e-6


def test_stoichiometric_ratio_of_kerosene():
    """About 0.068 kg fuel per kg air for CH1.92 (textbook value for kerosene)."""
    assert Gas().FAR_stoichiometric == pytest.approx(0.068, abs=5e-4)


def test_unknown_data_and_impossible_fuel_are_refused():
    """The message names the nearest data set, and the range."""
    with pytest.raises(ParameterError, match="nasa7"):
        Gas(data="nasa_7")
    with pytest.raises(ParameterError, match=r"x_HC = 5"):
        Gas(x_HC=5)
