"""Symmetrical components: Fortescue's by hand, Fourier analysis of waveforms, phasors of a load."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import SignalError
from apu_casadi.core.means import (
    COMPONENTS,
    PARTS,
    SEQUENCES,
    UNBALANCE,
    as_dict,
    of_samples,
    sequences,
)
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.multirate import simulate_joint

APU = Apu()
KW100 = SeriesLoad.from_power(100e3)
UNEVEN = SeriesLoad.from_power(100e3, 0.9, unbalance=(1.3, 1.0, 0.7))
A = np.exp(2j * np.pi / 3)
#: Phasors of phases a, b, c to those of positive, negative and zero sequence.
FORTESCUE = np.array([[1, A, A**2], [1, A**2, A], [1, 1, 1]]) / 3


def run(duration=1.0, **how):
    return simulate_joint(APU, duration=duration, **{"waveform_dt": None, **how})


def phasors(ds, q, kinds="120", k=-1):
    """Complex components of the last exchange step."""
    return np.array([
        float(ds[f"{q}_{s}"][k]) * np.exp(1j * float(ds[f"{q}_{s}_angle"][k])) for s in kinds
    ])  # fmt: skip


def test_by_hand():
    """A set of each sequence alone gives itself; nothing but zero where there is no other."""
    for k, row in enumerate(np.linalg.inv(FORTESCUE).T):
        parts = np.concatenate([(2 * row, 3j * row)]).ravel()
        found = as_dict(SEQUENCES, sequences(np.column_stack([parts.real, parts.imag]).ravel()))
        V, I = ([found[f"{q}_{s}"] for s in "120"] for q in "VI")
        assert_allclose(V, 2 * np.eye(3)[k], atol=1e-14)
        assert_allclose(I, 3 * np.eye(3)[k], atol=1e-14)
        name = COMPONENTS[3 + k]
        assert found[f"{name}_angle"] == pytest.approx(math.pi / 2)
    none = sequences(np.zeros(len(PARTS)))
    assert np.isnan(as_dict(SEQUENCES, none)["V_2_over_V_1"])


@pytest.mark.long
@pytest.mark.parametrize(
    ("load", "fault"), [(UNEVEN, None), (KW100, Ttsc(0.05, 20.0, phase="b"))], ids=["load", "fault"]
)
def test_against_fourier_analysis_of_the_waveforms(load, fault):
    """The last 20 ms, eight periods but for the speed's deviation; and without waveforms.

    The means are weighted, the periods whole: what differs is what moves within the 20 ms, the
    exciter and the speed (1e-4).
    """
    ds = run(duration=3.0, load=load, fault=fault, waveform_dt=50e-6)
    bare = run(duration=3.0, load=load, fault=fault)
    w_r = float(APU.w_r(ds["N"].values[-2]))
    t = ds["time_w"].values
    last = t > t[-1] - 8 * 2 * math.pi / w_r
    assert last.sum() == pytest.approx(400, abs=2)
    basis = [f(k * w_r * t[last]) for k in range(1, 8) for f in (np.cos, np.sin)]
    M = np.column_stack([np.ones(last.sum()), *basis])
    for q in "vi":
        fits = [np.linalg.lstsq(M, ds[f"{q}_{p}"].values[last], rcond=None)[0] for p in "abc"]
        fundamental = np.array([c[1] - 1j * c[2] for c in fits]) / math.sqrt(2)
        expected = np.abs(FORTESCUE @ fundamental)
        for each in (ds, bare):
            found = [float(each[f"{q.upper()}_{s}"][-1]) for s in "120"]
            assert_allclose(found, expected, atol=1e-4 * expected[0])
        assert expected[1] > 5e-3 * expected[0]  # there is something to see
        ratio = float(bare[f"{q.upper()}_2_over_{q.upper()}_1"][-1])
        assert ratio == pytest.approx(expected[1] / expected[0], abs=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("solver", ["auto", "cvodes"])
def test_an_unbalanced_load_by_phasors(solver):
    """Currents of all sequences from the voltages by the load's admittances, angles included.

    Y_120 = F diag(1/Z) F^-1 at the speed of the step, settled to 2e-5.
    """
    ds = run(duration=1.5 if solver == "auto" else 0.6, load=UNEVEN, solver=solver)
    w_r = float(APU.w_r(ds["N"].values[-2]))
    Z = np.array([complex(R, w_r * L) for R, L in zip(UNEVEN.R, UNEVEN.L, strict=True)])
    Y = FORTESCUE @ np.diag(1 / Z) @ np.linalg.inv(FORTESCUE)
    V, I = phasors(ds, "V"), phasors(ds, "I")
    assert abs(I[1]) > 0.1 * abs(I[0])
    assert_allclose(I, Y @ V, atol=2e-5 * abs(I[0]))


def test_a_healthy_machine_has_a_positive_sequence_only():
    """Exactly; it has the rms value and, with phasors kept, phase a's angle; kept once."""
    ds = run(duration=0.2, load=KW100, phasors=True)
    for name in ("V_2", "V_0", "I_2", "V_2_angle", "I_0_angle", *UNBALANCE):
        assert not ds[name].values.any()
    assert_allclose(ds["V_1"], ds["V_a_rms"], rtol=1e-12)
    a = ds["V_a_re"].values + 1j * ds["V_a_im"].values
    assert_allclose(ds["V_1_angle"], np.angle(a), atol=1e-12)
    assert ds["V_2_over_V_1"].attrs["units"] == "1"


def test_of_a_generator_alone_by_its_samples():
    """Of the waveforms of a settled generator, against the phasors of its turn: 1e-7."""
    gen = APU.generator
    point = gen.steady_state(UNEVEN, Ttsc(0.05, 20.0))
    ds = gen.simulate(UNEVEN, 0.02, fault=Ttsc(0.05, 20.0), dt_out=10e-6)
    found = of_samples(ds["time"], ds["theta_e"], ds)
    for q in "VI":
        exact = FORTESCUE @ [point.turn.phasor(f"{q.lower()}_{p}") for p in "abc"]
        seen = [found[f"{q}_{s}"] * np.exp(1j * found[f"{q}_{s}_angle"]) for s in "120"]
        assert_allclose(seen, exact, atol=1e-6 * abs(exact[0]))
        assert found[f"{q}_a_rms"] == pytest.approx(point.turn.rms(f"{q.lower()}_a"), rel=1e-5)
    with pytest.raises(SignalError, match=r"without i_c"):
        of_samples(ds["time"], ds["theta_e"], ds.drop_vars("i_c"))
    part = ds.isel(time=slice(0, 100))
    with pytest.raises(SignalError, match=r"over 0\.396 periods"):
        of_samples(part["time"], part["theta_e"], part)
