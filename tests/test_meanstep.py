"""Exchange steps of which only means are wanted, against CVODES; refusals."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core import simulation
from apu_casadi.core.errors import SimulationError
from apu_casadi.core.lanes.lanelibrary import unsupported
from apu_casadi.core.means import PARTS, RMS, Term, as_dict, settled, wanted, window
from apu_casadi.machine import meanstep
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.capacitor import CapacitorLoad
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.unit.stepmeans import MEANS

GEN = Generator()
W = GEN.machine.w_rated
KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
LAGGING = SeriesLoad.from_power(100e3, 0.9)
UNEVEN = SeriesLoad.from_power(100e3, 0.9, unbalance=(1.3, 1.0, 0.7))
QUAD = (*MEANS, *wanted(phasors=True, short=True, symmetric=False))


def start(gen, load, fault, ss=None):
    """Variant, inputs, fault parameters and state 100 ms after the switch from 225 kW."""
    point = gen.steady_state(KW225, theta_e=0.3)
    plain = gen.variant(load, fault)
    u, theta = gen.inputs(load, V_ref=point.V_ref, w_r=1.01 * W), gen.fault_vector(load, fault)
    x = gen.transfer(point.x, point.ss, plain, u=point.u, theta=[], u_target=u)
    x = simulation.stepper(plain, 1, rtol=1e-11, atol=1e-13)(x, u, theta, 0.1).x_end.copy()
    return ss or plain, u, theta, x


@pytest.mark.long
@pytest.mark.parametrize(
    ("gen", "load", "fault"),
    [
        (GEN, KW100, None),
        (GEN, LAGGING, None),
        (GEN, UNEVEN, None),
        (GEN, KW100, Ttsc(0.05, 20.0)),
        (GEN, KW100, Ttsc(0.05, 20.0, 0.052, phase="b")),
        (Generator(neutral="isolated"), KW100, Ttsc(0.05, 20.0, 1.0, phase="c")),
    ],
)
def test_means_equal_those_of_cvodes(gen, load, fault):
    """Three steps, the speed jumping by 2e-4 between them: means to 1e-5, windings to 2e-5 nominal.

    CVODES runs at rtol 1e-11.  What is left is the sampling of the ripple and of what follows the
    jump within microseconds.
    """
    ss, u, theta, x = start(gen, load, fault)
    fast = MeanStep(gen, ss, u, theta, dt=0.02, quad=QUAD)
    assert not unsupported(fast.advance)  # ensembles evaluate it in lanes
    exact = simulation.stepper(ss, 1, quad=QUAD, rtol=1e-11, atol=1e-13)
    ours = x.copy()
    windings = [i for i, n in enumerate(ss.x.names) if n.startswith("lam") or n == "E_fd"]
    for k in range(3):
        u[ss.u.index("w_r")] = (1.01 + 2e-4 * k) * W
        ours, means = fast(ours, u)
        theirs = exact(x, u, theta, 0.02)
        x = theirs.x_end.copy()
        for name, mean in zip(QUAD, means, strict=True):
            # what ripples is nearly zero on average: its error is that of the values themselves
            scale = max(abs(theirs.mean[name]), Term.of(name).nominal(ss) / 100, 1.0)
            assert abs(mean - theirs.mean[name]) < 1e-5 * scale, name
        off = (ours - x) / ss.x.nominals
        assert_allclose(off[windings], 0.0, rtol=0, atol=2e-5)
        assert ours[ss.x.index("theta_e")] == pytest.approx(x[ss.x.index("theta_e")], rel=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("fault", [None, Ttsc(0.05, 20.0)], ids=["healthy", "fault"])
def test_every_speed_of_the_range_and_other_lengths_of_step(fault):
    """From -3 to +3 % the step ends at all places between samples; 10 and 30 ms as well.

    1e-5, and 1e-3 of the jump in speed: that is some hundred times what a unit's is, and what
    follows it within 20 us falls between the samples.
    """
    ss, u, theta, x = start(GEN, KW100, fault)
    quad = tuple(RMS.values())
    exact = simulation.stepper(ss, 1, quad=quad, rtol=1e-10, atol=1e-12)
    for dt, share in ((0.02, -0.03), (0.02, -0.0173), (0.02, 0.0111), (0.02, 0.03), (0.01, 0.013),
                      (0.03, -0.007)):  # fmt: skip
        u[ss.u.index("w_r")] = (1.01 + share) * W
        _, means = MeanStep(GEN, ss, u, theta, dt=dt, quad=quad)(x, u)
        theirs = exact(x, u, theta, dt).mean
        assert_allclose(means, [theirs[q] for q in quad], rtol=1e-5 + 1e-3 * abs(share))


@pytest.mark.parametrize(
    ("load", "fault"),
    [
        (SeriesLoad.from_power(10e3), None),
        (CapacitorLoad.from_power(10e3, 0.9), None),
        (SeriesLoad.from_power(10e3), Ttsc(0.05, 500.0)),
        (SeriesLoad.from_power(10e3, 0.85), Ttsc(0.05, 500.0)),
        (SeriesLoad.from_power(10e3), Ttsc(0.05, 49.0, 1.0)),
        (KW100, Ttsc(0.05, 19.0)),
        (SeriesLoad.from_power(10e3, 0.8), Ttsc(0.05, 49.0)),
    ],
    ids=[
        "R", "R-C", "R and a small fault", "R-L and a small fault", "R and a leaky fault",
        "100 kW", "R-L and a fault",
    ],
)  # fmt: skip
def test_a_new_speed_under_a_light_load(load, fault):
    """The voltage follows in microseconds, which no sample has: mean power and voltage to 4e-7.

    At 100 kW, and in a fault's branch beside an inductive load, it takes about a stride: of that
    strides make too much (1e-6 and 5e-6 of the voltage where it is not made good).

    Speed falls by 0.3 %, as in 20 ms after a load step.  Taken for a sample like any other, the
    first one would make the regulator err by 1e-6 (healthy) to 1e-5.  The branch of a fault beside
    an inductive load settles alike, and that of turns that leak together with the stator (5e-6 off
    where neither was done).
    """
    ss, u, theta, x = start(GEN, load, fault)
    quad = ("P_e", "~v_a^2", "~v_b^2", "~v_c^2")
    u[ss.u.index("w_r")] *= 0.997
    _, means = MeanStep(GEN, ss, u, theta, dt=0.02, quad=quad)(x, u)
    theirs = simulation.stepper(ss, 1, quad=quad, rtol=1e-11, atol=1e-13)(x, u, theta, 0.02).mean
    assert_allclose(means, [theirs[q] for q in quad], rtol=8e-7)  # squares: twice as much


def fits(strides):
    """Harmonics of the levels of so many strides a turn."""
    return [k for level in meanstep.LEVELS if level.strides in strides for k in level.harmonics]


@pytest.mark.parametrize(
    ("load", "mu", "h"),
    [(KW100, 0.05, 0.03), (KW100, 0.2, 0.1), (SeriesLoad.from_power(10e3), 0.2, 0.1),
     (LAGGING, 0.05, 0.01)],
    ids=["h = 0.03", "h = 0.1", "10 kW", "R-L"],
)  # fmt: skip
def test_severe_faults_take_finer_strides(load, mu, h):
    """Mean powers and squares of voltages at a new speed to 1.6e-6, twice what rms values are.

    It starts where the ripple's sampling by 56 strides a turn made most: 1e-5 at 10 kW, h = 0.1.
    """
    fault, quad = Ttsc(mu, mu / h - 1 + mu), ("P_total", "P_e", "~v_a^2", "~v_b^2", "~v_c^2")
    point = GEN.steady_state(load, fault)
    ss, u, theta = point.ss, point.u.copy(), np.array(point.theta)
    exact = simulation.stepper(ss, 1, quad=quad, rtol=1e-11, atol=1e-13)
    x = exact(point.x, u, theta, 0.22 * 2 * math.pi / GEN.machine.w_rated).x_end.copy()
    u[ss.u.index("w_r")] *= 1 - 2e-4
    fast = MeanStep(GEN, ss, u, theta, dt=0.02, quad=quad)
    _, means = fast(x, u)
    theirs = exact(x, u, theta, 0.02)
    largest = max(theirs.mean[q] for q in quad[2:])
    scale = [theirs.mean["P_total"], theirs.mean["P_e"], *[largest] * 3]
    assert_allclose(means / scale, [theirs.mean[q] / s for q, s in zip(quad, scale, strict=True)],
                    rtol=0, atol=1.6e-6)  # fmt: skip
    mild = MeanStep(GEN, ss, u, GEN.fault_vector(load, Ttsc(0.05, 99.0)), dt=0.02, quad=quad)
    assert mild.harmonics in fits(strides=(28,))
    assert fast.harmonics in fits(strides=(56, 112))


@pytest.mark.parametrize(
    ("load", "h", "strides"),
    [(KW100, 1e-5, 16), (KW100, 6e-4, 16), (SeriesLoad.from_power(10e3), 3e-4, 16),
     (CapacitorLoad.from_power(40e3, 0.9), 4e-4, 16),
     (KW100, 1.6e-3, 20), (SeriesLoad.from_power(10e3), 5e-4, 20),
     (SeriesLoad.from_power(225e3), 2.2e-3, 20), (LAGGING, 5e-4, 16), (LAGGING, 7e-4, 20)],
    ids=["tiny", "100 kW", "10 kW", "leading", "100 kW, 20", "10 kW, 20", "225 kW, 20", "R-L",
         "R-L, 20"],
)  # fmt: skip
def test_mild_faults_take_longer_strides(load, h, strides):
    """Mean powers and rms voltages over three steps of falling speed to 5e-7 of the largest.

    These are the largest faults that 16 and 20 strides a turn are taken for, and a tiny one.
    """
    fault, quad = Ttsc(0.05, 0.05 / h - 0.95), ("P_total", "P_e", "~v_a^2", "~v_b^2", "~v_c^2")
    point = GEN.steady_state(load, fault)
    ss, u, theta = point.ss, point.u.copy(), np.array(point.theta)
    fast = MeanStep(GEN, ss, u, theta, dt=0.02, quad=quad, harmonics=0)
    assert fast.harmonics in fits(strides=(strides,))
    exact = simulation.stepper(ss, 1, quad=quad, rtol=1e-12, atol=1e-14)
    x = ours = np.array(point.x)
    for _ in range(3):
        u[ss.u.index("w_r")] *= 1 - 2e-4
        ours, means = fast(ours, u)
        theirs = exact(x, u, theta, 0.02)
        x = theirs.x_end.copy()
        power, voltage = theirs.mean["P_total"], max(theirs.mean[q] for q in quad[2:])
        off = np.abs(means - [theirs.mean[q] for q in quad])
        assert (off / [power, power, *[2 * voltage] * 3]).max() < 5e-7


@pytest.mark.parametrize("h", [5e-6, 7e-6, 1e-5, 1.3e-5, 2e-5, 3e-5, 8e-5])
@pytest.mark.parametrize("harmonics", [0, meanstep.USUAL])
def test_a_loop_that_follows_within_nanoseconds_is_left_as_it_is(h, harmonics):
    """Beside 10 kW R-L a small fault's loop has no digits to be settled by: means to 1.1e-6.

    A loop just slow enough for what was done then made P_total wrong by 2.6e-3.
    """
    load, quad = SeriesLoad.from_power(10e3, 0.85), ("P_total", "~v_a^2", "~v_b^2", "~v_c^2")
    point = GEN.steady_state(load, Ttsc(0.05, 0.05 / h - 0.95))
    ss, u, theta = point.ss, point.u.copy(), np.array(point.theta)
    fast = MeanStep(GEN, ss, u, theta, dt=0.02, quad=quad, harmonics=harmonics)
    u[ss.u.index("w_r")] *= 1 - 2e-4
    _, means = fast(np.array(point.x), u)
    theirs = simulation.stepper(ss, 1, quad=quad, rtol=1e-12, atol=1e-14)(point.x, u, theta, 0.02)
    # squares of voltages: twice what rms values are
    assert_allclose(means, [theirs.mean[q] for q in quad], rtol=2.2e-6)


def test_phasors_are_those_of_the_samples():
    """Least squares on 4000 samples of CVODES, under a fault and off rated speed: 1e-5 of V_a.

    The samples' own quadrature errs by that.
    """
    ss, u, theta, x = start(GEN, KW100, Ttsc(0.05, 20.0, phase="b"))
    _, means = MeanStep(GEN, ss, u, theta, dt=0.02, quad=QUAD)(x, u)
    by_name = as_dict(QUAD, means)
    both = settled(by_name, turn=8.0, symmetric=False, phasors=True)
    found = as_dict((*RMS, *PARTS), both)
    run = simulation.stepper(ss, 4000, rtol=1e-10, atol=1e-12)(x, u, theta, 0.02)
    angle = run.x[ss.x.index("theta_e")]
    weight = np.sqrt(window(np.arange(1, 4001) / 4000))
    basis = weight[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    V = []
    for p in "abc":
        c, s = np.linalg.lstsq(basis, weight * run.y[ss.y.index(f"v_{p}")], rcond=None)[0]
        ours = complex(found[f"V_{p}_re"], found[f"V_{p}_im"])
        V.append(ours)
        assert abs(ours - complex(c, -s) / math.sqrt(2)) < 2e-5 * abs(ours)
    # symmetrical components: the positive sequence is nearly all, the negative one the fault
    a = np.exp(2j * np.pi / 3)
    positive, negative = (V[0] + a * V[1] + a**2 * V[2]) / 3, (V[0] + a**2 * V[1] + a * V[2]) / 3
    assert abs(positive) > 200 and 1.0 < abs(negative) < 15.0


def test_what_does_not_hold_is_refused(monkeypatch):
    """Each message says what is wrong; a step that moves too fast is not passed off as good."""
    load = ConstantPowerLoad(90e3)
    with pytest.raises(SimulationError, match="not linear"):
        MeanStep(GEN, GEN.variant(load), GEN.inputs(load), np.zeros(0), dt=0.02, quad=())
    for fault in (None, Ttsc(0.05, 20.0)):
        ss, u, theta, x = start(GEN, KW100, fault)
        with pytest.raises(SimulationError, match="less than two turns"):
            MeanStep(GEN, ss, u, theta, dt=0.004, quad=QUAD)
        fast = MeanStep(GEN, ss, u, theta, dt=0.02, quad=QUAD)
        off = u.copy()
        off[ss.u.index("w_r")] = 1.2 * W
        with pytest.raises(SimulationError, match="outside the table"):
            fast(x, off)
        moved = x.copy()
        moved[ss.x.index("V_R")] += 2000.0  # runs away from any polynomial
        with pytest.raises(SimulationError, match="errors of E_fd"):
            fast(moved, u)
        moved[ss.x.index("V_R")] = np.nan
        with pytest.raises(SimulationError, match="not finite"):
            fast(moved, u)
    monkeypatch.setattr(meanstep, "LEVELS", (meanstep.Level(20, (4,), 1.0, (1.0, 1.0)),))
    with pytest.raises(SimulationError, match="harmonics of the rotor angle, 4 fit"):
        MeanStep(GEN, ss, u, theta, dt=0.02, quad=QUAD, harmonics=0)
