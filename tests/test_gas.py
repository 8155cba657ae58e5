"""Gas properties against their own definitions; against Cantera in tests/peers/test_cantera.py."""

import casadi as ca
import numpy as np
import pytest

from apu_casadi.core.errors import ParameterError
from apu_casadi.gaspath.gas import T_REF, Gas

TEMPERATURES = np.array([200.0, 250, 298.15, 400, 600, 800, 999, 1001, 1200, 1500, 1800, 2200])
FAR_WAR = [(0.0, 0.0), (0.0, 0.02), (0.01, 0.0), (0.02, 0.01), (0.04, 0.0)]


def test_nasa9_and_nasa7_differ_by_what_the_docs_say():
    """gas.py: nasa7 lies up to 0.4 % below nasa9 in cp of dry air; the two bracket each other."""
    a, b = Gas(data="nasa9"), Gas(data="nasa7")
    ratio = np.array([float(b.cp(T)) / float(a.cp(T)) - 1 for T in np.arange(250.0, 1600.0, 10)])
    assert np.abs(ratio).max() < 4.5e-3
    assert np.abs(ratio).max() > 2e-3


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
