"""Rows of blocks of exchange steps: as far as each is right, and as if one by one."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.backend import find_compiler, use_backend
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.profiles.profile import varying
from apu_casadi.core.profiles.shapes import Growth, Ramp
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit import jointstep
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import Ambient, FaultChange, HealthChange, LoadChange, SpeedChange
from apu_casadi.unit.jointstep import BLOCK, JointBlock, UnitState
from apu_casadi.unit.multirate import simulate_joint

LIMIT = 1e-5


def block_that_counts(wrong_from):
    """Blocks that add one to each of two states; errors grow from a number of calls on."""
    buffers = [np.zeros(4), *(np.zeros((n, BLOCK)) for n in (3, 1, 2, 2))]  # reused, as CasADi's
    calls = []

    def call(carry, step):
        calls.append(step)
        last, y, _, means, checks = buffers
        last[:], y[:], means[:] = carry + 1, carry[0], carry[1]
        checks[:] = [[LIMIT * (len(calls) > wrong_from) * 2] * BLOCK, [2500.0 + carry[0]] * BLOCK]
        return tuple(buffers)

    block = object.__new__(JointBlock)
    machine = SimpleNamespace(limits=np.array([LIMIT]), valid=lambda w: w < 2600.0)
    machine.ss = SimpleNamespace(name="stub")
    block.machines, block._sampled, block._n_gov, block._n_x = (machine,), [False], 1, [1]
    block._n_z, block._call = 1, call
    return block, calls


def followed(block, n):
    one = np.array([1.0])
    return block.followed(UnitState(one, one, (1.0,)), [one], ([k] for k in range(n)))


def test_a_row_of_blocks_ends_before_the_first_that_is_wrong():
    block, calls = block_that_counts(3)
    done = followed(block, 5)
    assert calls == [0, 1, 2, 3]  # no more are tried
    assert done.y.shape == (3, 3 * BLOCK)
    assert done.state.N == 4.0
    assert done.state.governor == (4.0,)
    assert done.machines[0].x == 4.0
    # what the first gave is not overwritten by those after it
    assert done.y[0, ::BLOCK].tolist() == [1.0, 2.0, 3.0]
    assert done.machines[0].means[0, ::BLOCK].tolist() == [1.0, 2.0, 3.0]
    assert done.machines[0].w_r[::BLOCK].tolist() == [2501.0, 2502.0, 2503.0]


def test_a_row_whose_first_block_is_wrong_is_refused():
    block, calls = block_that_counts(0)
    with pytest.raises(NotApplicable, match="stub: a step of the block is not right"):
        followed(block, 5)
    assert calls == [0]


UNIT = Apu()
KINDS = {
    "load": LoadChange(0.3, SeriesLoad.from_power(120e3, 0.9)),
    "load of one": LoadChange(0.313, SeriesLoad.from_power(60e3), generator=2),
    "constant power": LoadChange(0.3, ConstantPowerLoad(90e3)),
    "fault": FaultChange(0.3, Ttsc(0.05, 24.0)),
    "health": HealthChange(0.3, {"f_eta_c": 0.98, "f_W_t": 1.02}),
    "speed": SpeedChange(0.305, 0.99 * UNIT.N_ref),
}


@pytest.mark.ci  # CVODES, 12 runs
@pytest.mark.parametrize("waveform_dt", [None, 1e-3])
@pytest.mark.parametrize("kind", KINDS)
def test_blocks_take_every_kind_of_event_off_the_units_own_speed(kind, waveform_dt):
    """Another governed speed from the start, and from an event on; means to 1e-6 of peak.

    Blocks governed by the unit's own speed: N was wrong by 2 % without anybody knowing.
    """
    given = {
        "duration": 0.5, "load": [SeriesLoad.from_power(p, 0.85) for p in (100e3, 60e3)],
        "N_ref": 0.985 * UNIT.N_ref, "ambient": Ambient(altitude=500.0), "waveform_dt": waveform_dt,
        "events": [SpeedChange(0.1, 0.99 * UNIT.N_ref), KINDS[kind]],
    }  # fmt: skip
    ours = simulate_joint(UNIT, **given)
    theirs = simulate_joint(UNIT, **given, solver="cvodes", rtol=1e-10, atol=1e-12)
    assert json.loads(ours.attrs["solver"])["steps_propagated"] > 20
    for name in ("N", "Wf", "PW", "P_e", "T4", "V_a_rms", "I_b_rms"):
        peak = np.abs(theirs[name].values).max()
        assert np.abs(ours[name].values - theirs[name].values).max() < 1e-6 * peak, name


GROWN = varying(Ttsc.of_h, 0.05, Growth(1e-4, 2e-3, over=5.0), phase="c")
RAMP, KW80 = varying(SeriesLoad.from_power, Ramp(60e3, 61e3, over=1.0)), SeriesLoad.from_power(80e3)
PAIRS = {
    "healthy": ([SeriesLoad.from_power(90e3, 0.85), RAMP], {}),
    "faults of other strides": ([RAMP, KW80], {1: Ttsc(0.05, 40.0), 2: Ttsc(0.05, 4.0)}),
    "faults of other loads": (
        [RAMP, SeriesLoad.from_power(80e3, 0.85)],
        {k: Ttsc(0.05, 40.0, phase="b") for k in (1, 2)},
    ),
    "one of them growing": ([RAMP, KW80], {1: Ttsc(0.05, 40.0, 0.3), 2: GROWN}),
}


@pytest.mark.compiled
@pytest.mark.ci
@pytest.mark.parametrize("pair", PAIRS)
def test_compiled_blocks_of_two_different_machines_are_those_of_the_virtual_machine(
    pair, monkeypatch
):
    """To rounding: once compiled, a machine had the means of the other, 1e13 of its power."""
    if find_compiler() is None:
        pytest.skip("no compiler")
    monkeypatch.setattr(jointstep, "keep", lambda *given: given[-1]())  # anew for each run
    load, fault = PAIRS[pair]
    given = {"duration": 0.4, "load": load, "fault": fault, "waveform_dt": None}
    with use_backend("vm"):
        theirs = simulate_joint(UNIT, **given)
    monkeypatch.setattr(jointstep, "OFTEN", 1)
    with use_backend("c"):
        ours = simulate_joint(UNIT, **given)
    assert json.loads(ours.attrs["solver"])["steps_propagated"] > 25  # of 40
    for name in ("N", "PW", "P_e", "V_a_rms", "V_b_rms", "I_c_rms", "T4"):
        assert_allclose(ours[name], theirs[name], rtol=1e-9, err_msg=name)
