"""Validation section ``pycycle``: the cycle in pyCycle, run live under a Python that has it."""

import os

import pytest

from scenarios.validation import comparison
from scenarios.validation.peers import cycle

needs_pycycle = pytest.mark.skipif(
    not os.environ.get(cycle.VARIABLE), reason=f"{cycle.VARIABLE} names no Python with pyCycle"
)


@needs_pycycle
def test_every_row_is_within_its_tolerance():
    """Design, off-design line at constant speed and 8000 m; about a minute."""
    rows = comparison.run("pycycle")
    short = [f"{r.quantity}: {r.error:+.2e} > {r.tolerance:.0e}" for r in rows if not r.passed]
    assert not short, short
    points = {r.quantity.split(":")[0] for r in rows if ": " in r.quantity}
    assert {label for label, _, _ in cycle.POINTS} <= points


def test_no_python_is_a_skip_with_the_reason(monkeypatch):
    """Without pyCycle the section says what to set, and what is named must exist."""
    monkeypatch.delenv(cycle.VARIABLE, raising=False)
    with pytest.raises(comparison.SkippedError, match=rf"{cycle.VARIABLE}.*--pycycle-python"):
        comparison.run("pycycle")
    monkeypatch.setenv(cycle.VARIABLE, "no-such-python")
    with pytest.raises(comparison.SkippedError, match="no-such-python"):
        comparison.run("pycycle")


def test_our_side_has_no_calibration_and_the_same_design_location():
    """Identity maps; the turbine's location is pressure ratio 5.5 of LPT2269."""
    gg = cycle.engine()
    for choice in (gg.compressor_map, gg.turbine_map):
        cal = choice.calibration
        assert (cal.a_W, cal.n_Re, cal.c_PR, cal.c_N) == (0.0, 0.0, 0.0, 0.0)
    case = cycle.pycycle_case(gg, cycle.SMOOTH)
    assert case["turbine_PRmap"] == pytest.approx(5.5, rel=1e-12)
    i = gg.turbine_map.table.PR[0].searchsorted(5.5)
    assert gg.turbine_map.table.beta[i] == pytest.approx(gg.turbine_map.beta_des)
    assert (gg.compressor_map.N_map_des, gg.compressor_map.beta_des) == (1.0, 2.0)


def test_our_side_of_every_point_stays_on_the_maps():
    """Off the tables the two programs extrapolate differently, and nothing would be compared."""
    for point in cycle.trimmed(cycle.engine()):
        assert point["off_c"] == point["off_t"] == 0.0
