"""Validation section ``cantera``: gas properties, frozen and in equilibrium."""

import pytest

from apu_casadi.gaspath.gas import _cp_over_R, species
from scenarios.validation import comparison
from scenarios.validation.peers import gas

ct = pytest.importorskip("cantera", reason="cantera is not installed (extra 'peers')")


def test_every_row_is_within_its_tolerance():
    """Both data sets, 200-2200 K, fuel-air ratio 0-0.04; the rows say why each tolerance."""
    rows = comparison.run("cantera")
    assert len(rows) == 2 * (4 + len(gas.BANDS))
    short = [f"{r.quantity}: {r.error:+.2e} > {r.tolerance:.0e}" for r in rows if not r.passed]
    assert not short, short


def test_dissociation_is_seen():
    """The check can fail: at 2200 K the frozen gas is more than 1 % of cp T off."""
    errors = gas.equilibrium_errors("nasa9")
    assert errors[2200.0] > 1e-2
    assert errors[1000.0] < 3e-4


def test_mixture_balances_the_atoms():
    """Complete combustion keeps C, H and O: 1 kg of air and the fuel, to rounding."""
    air, burnt = (gas.mixture(FAR, 0.01, 1.9185) for FAR in (0.0, 0.04))
    fuel = 0.04 / (gas.M_C + 1.9185 * gas.M_H)
    for atom, count, brought in (
        ("C", {"CO2": 1}, fuel),
        ("H", {"H2O": 2}, 1.9185 * fuel),
        ("O", {"CO2": 2, "H2O": 1, "O2": 2}, 0.0),
    ):
        before, after = (sum(n * m[s] for s, n in count.items()) for m in (air, burnt))
        assert after - before == pytest.approx(brought, abs=1e-15), atom


def test_nasa9_of_air_species_equals_cantera():
    """Cantera's airNASA9.yaml carries N2 and O2 of NASA/TP-2002-211556 (1e-6: printed digits)."""
    theirs = {s.name: s.thermo for s in ct.Species.list_from_file("airNASA9.yaml")}
    ours = species("nasa9")
    for name in ("N2", "O2"):
        for T in gas.TEMPERATURES:
            cp = float(_cp_over_R(ours[name][1][0 if T < 1000 else 1], T)) * ct.gas_constant
            assert cp == pytest.approx(theirs[name].cp(T), rel=1e-6)
