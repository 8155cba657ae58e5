"""Park's transformation, Table 1, the fault's parameters, the exciter and the loads."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ParameterError
from apu_casadi.machine import exciter, wrsg
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters
from apu_casadi.machine.park import (
    PHASE_ANGLE,
    Abc,
    abc_to_qd0,
    phase_column,
    phase_selector,
    qd0_to_abc,
)

TABLE_1 = MachineParameters()


def test_park_is_krauses_matrix_and_its_inverse_undoes_it():
    """Krause, Analysis of Electric Machinery, eq. 3.3-4; rounding only."""
    theta = 0.7
    shifts = np.array([0.0, -2 * np.pi / 3, 2 * np.pi / 3])
    T = 2 / 3 * np.array([np.cos(theta + shifts), np.sin(theta + shifts), [0.5, 0.5, 0.5]])
    x = Abc(1.0, -0.3, 0.9)
    assert_allclose(abc_to_qd0(theta, x), T @ x, atol=1e-15)
    assert_allclose(qd0_to_abc(theta, abc_to_qd0(theta, x)), x, atol=1e-15)
    for k, name in enumerate("abc"):
        assert_allclose(phase_column(theta, PHASE_ANGLE[name]), T[:, k], atol=1e-15)
        assert_allclose(phase_selector(PHASE_ANGLE[name]), np.eye(3)[k], atol=1e-15)


def test_park_keeps_the_amplitude_and_q_leads():
    """A balanced set of amplitude 5 in phase with the q axis is q = 5, d = 0; rounding only."""
    theta = np.linspace(0, 7, 11)
    x = Abc(*(5 * np.cos(theta - PHASE_ANGLE[k]) for k in "abc"))
    q, d, zero = abc_to_qd0(theta, x)
    assert_allclose(q, 5.0, rtol=1e-14)
    assert_allclose([d, zero], 0.0, atol=1e-14)


def test_reactances_of_table_1():
    """Xd .605, X'd .1215, X''d .0888, Xq .457, X''q .241 ohm at 400 Hz, to the digits given."""
    p, w = TABLE_1, TABLE_1.w_rated

    def parallel(*L):
        return 1 / sum(1 / x for x in L)

    assert w * (p.L_ls + p.L_md) == pytest.approx(0.605, abs=5e-4)
    assert w * (p.L_ls + parallel(p.L_md, p.L_lfd)) == pytest.approx(0.1215, abs=5e-5)
    X_d2 = w * (p.L_ls + parallel(p.L_md, p.L_lfd, p.L_lkd))
    assert X_d2 == pytest.approx(0.0888, abs=5e-5)
    assert w * (p.L_ls + p.L_mq) == pytest.approx(0.457, abs=5e-4)
    X_q2 = w * (p.L_ls + parallel(p.L_mq, p.L_lkq))
    assert X_q2 == pytest.approx(0.241, abs=5e-4)
    # the flux equations hold the same: stator flux per current at constant rotor flux
    i = wrsg.currents(p, wrsg.Windings(1.0, 1.0, 1.0, 0.0, 0.0, 0.0))
    assert_allclose([-w / i.sd, -w / i.sq, -w / i.s0], [X_d2, X_q2, w * p.L_ls], rtol=1e-12)


def test_inductance_derives_from_an_energy():
    """(7) with L_mq + L_lkq: 3/2 (stator in motor signs, rotor) is symmetric; rounding only.

    With the printed last entry, L_md + L_lkq, it would be symmetric as well, but not the q axis of
    a machine: its mutual and magnetising inductances must be equal, which is tested here.
    """
    L = wrsg.inductance(TABLE_1)
    motor = L * np.array([-1, -1, -1, 1, 1, 1])
    assert_allclose(motor, motor.T, atol=0)
    assert np.all(np.linalg.eigvalsh(motor) > 0)
    assert L[5, 5] - TABLE_1.L_lkq == pytest.approx(L[0, 5], rel=1e-14)


def test_flux_and_current_are_inverse():
    """(7) and its inverse; rounding of a matrix with condition number about 50."""
    lam = wrsg.Windings(0.1, -0.2, 0.01, 0.3, 0.15, -0.05)
    back = wrsg.flux_linkages(TABLE_1, wrsg.currents(TABLE_1, lam))
    assert_allclose(back, lam, rtol=1e-12)


def test_field_voltage_base_is_40_35_volts():
    """Rated voltage at no load needs 40.35 V of field voltage (to the digits given)."""
    assert TABLE_1.V_fd_base == pytest.approx(40.35, abs=5e-3)


def test_every_number_has_a_unit_and_a_source():
    for rows in (MachineParameters().table(), ExciterParameters().table()):
        assert all(unit and doc and source for _, _, unit, doc, source in rows)


def test_ttsc_severity_and_equivalent_shunt():
    """h = mu/(k_rf + 1 - mu); R = r_s/h; L = (kappa - mu) L_ls/mu; exact."""
    fault = Ttsc(mu=0.05, k_rf=1.0)
    assert fault.kappa == 0.05
    assert fault.h == pytest.approx(0.05 / 1.95, rel=1e-15)
    assert fault.R_shunt(TABLE_1) == pytest.approx(0.0044 * 1.95 / 0.05, rel=1e-15)
    assert fault.L_shunt(TABLE_1) == 0.0
    assert fault.r_fault(TABLE_1) == pytest.approx(1.0 * 0.05 * 0.0044, rel=1e-15)
    assert Ttsc(0.05, 1.0, 1.0).L_shunt(TABLE_1) == pytest.approx(19 * 19.8e-6, rel=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mu": 0.0, "k_rf": 1.0}, r"mu = 0 is outside \(0, 1\).*healthy machine has no fault"),
        ({"mu": 1.2, "k_rf": 1.0}, r"mu = 1.2 is outside"),
        ({"mu": 0.05, "k_rf": -1.0}, r"k_rf = -1 must be >= 0"),
        ({"mu": 0.05, "k_rf": math.inf}, r"k_rf must be a finite number"),
        ({"mu": 0.05, "k_rf": 1.0, "kappa": 0.01}, r"kappa = 0.01 is outside \[mu, 1\]"),
        ({"mu": 0.05, "k_rf": 1.0, "phase": "A"}, r"phase must be 'a', 'b' or 'c', got 'A'"),
    ],
)
def test_ttsc_refuses(arguments, message):
    with pytest.raises(ParameterError, match=message):
        Ttsc(**arguments)


def test_saturation_passes_through_both_points():
    """S_E = .86 at 5.6 and .5 at 4.2, exponential; rounding only."""
    p = ExciterParameters()
    assert exciter.saturation(p, 5.6) == pytest.approx(0.86, rel=1e-14)
    assert exciter.saturation(p, 4.2) == pytest.approx(0.5, rel=1e-14)
    assert exciter.saturation(p, 4.9) == pytest.approx(math.sqrt(0.86 * 0.5), rel=1e-14)
    assert exciter.saturation(p.change(S_E1=0.0, S_E2=0.0), 4.9) == 0.0


@pytest.mark.parametrize("T_F2", [0.0, 0.02])
def test_exciter_rests_where_it_says(T_F2):
    """The rates at rest vanish, with and without the second lag; rounding times K_A/T_A."""
    p = ExciterParameters(T_F2=T_F2, T_F3=T_F2 / 2)
    s, V_ref = exciter.exciter_steady(p, E_fd=1.3, V_t=0.99)
    rates = exciter.exciter_rates(p, s, V_t=0.99, V_ref=V_ref)
    assert len(exciter.exciter_signals(p)) == (5 if T_F2 else 4)
    assert_allclose([float(r) for r in rates if r is not None], 0.0, atol=1e-9)


def test_exciter_limits_do_not_wind_up():
    """At the ceiling the rate upwards is zero, and downwards it is the free one; rounding only."""
    p = ExciterParameters()
    at_top = exciter.ExciterState(V_c=0.9, V_R=7.3, E_fd=3.0, x_F1=3.0)
    assert float(exciter.exciter_rates(p, at_top, V_t=0.9, V_ref=1.0).V_R) == 0.0
    free = (250 * (0.9 - 1.0) - 7.3) / 0.005
    down = exciter.exciter_rates(p, at_top._replace(V_c=1.0), V_t=1.0, V_ref=0.9).V_R
    assert float(down) == pytest.approx(max(free, (-7.3 - 7.3) / 1e-3), rel=1e-14)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"V_R_max": -8.0}, r"V_R_min = -7.3 must be below V_R_max = -8"),
        ({"S_E1": 0.0}, r"saturation curve needs two different points"),
        ({"T_F3": 0.1}, r"T_F3 > 0 needs T_F2 > 0"),
        ({"K_a": 200.0}, r"no 'K_a' \(did you mean 'K_A'\?\)"),
    ],
)
def test_exciter_parameters_refuse(values, message):
    with pytest.raises(ParameterError, match=message):
        ExciterParameters().change(**values)


def test_load_from_power():
    """The paper's 225 kW is R = 3 * 230^2 / 225e3; rounding only."""
    load = SeriesLoad.from_power(225e3)
    assert load.kind == "resistive"
    assert load.balanced
    assert_allclose(load.R, 3 * 230**2 / 225e3, rtol=1e-15)


def test_load_from_power_with_power_factor_and_unbalance():
    """Power and power factor recomputed by phasors; rounding only."""
    load = SeriesLoad.from_power(100e3, 0.8, unbalance=(1.0, 2.0, 3.0))
    Z = np.array(load.R) + 2j * np.pi * 400 * np.array(load.L)
    S = 230**2 / np.conj(Z)
    assert_allclose(S.real, 100e3 * np.array([1, 2, 3]) / 6, rtol=1e-14)
    assert_allclose(S.real / abs(S), 0.8, rtol=1e-14)
    assert load.kind == "inductive"
    assert not load.balanced
    assert load.inputs["L_b"] == load.L[1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SeriesLoad.from_power(0.0), r"P \[W\].*OpenLoad.* = 0 must be > 0"),
        (lambda: SeriesLoad.from_power(1e5, 1.1), r"power_factor = 1.1 is outside \(0, 1\]"),
        (lambda: SeriesLoad.from_power(1e5, 0.0), r"power_factor = 0 must be > 0"),
        (lambda: SeriesLoad(R=(1.0, 1.0, 0.0)), r"R_c \[ohm\] = 0 must be > 0"),
        (lambda: SeriesLoad(R=(1.0, 1.0, 1.0), L=(0.0, -1e-6, 0.0)), r"L_b \[H\] = -1e-06"),
        (lambda: SeriesLoad(R=2.0), r"tuple of three values"),
        (lambda: ConstantPowerLoad(1e5, tau=0.0), r"tau \[s\] = 0 must be > 0"),
        (lambda: ConstantPowerLoad(math.nan), r"P \[W\].*finite number, got nan"),
        (lambda: OpenLoad(R=-1.0), r"R \[ohm\] = -1 must be > 0"),
    ],
)
def test_loads_refuse(make, message):
    with pytest.raises(ParameterError, match=message):
        make()
