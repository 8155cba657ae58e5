"""Units of one to four generators that differ: parameters, joint run, what is computed once."""

import dataclasses
import json
import warnings

import numpy as np
import pytest

from apu_casadi import Apu, FaultChange, Generator, LoadChange, SeriesLoad, Ttsc, simulate_joint
from apu_casadi.core import cf, results
from apu_casadi.core.errors import DataError, ParameterError, ScenarioError
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.measurement import MeasurementNoise
from apu_casadi.unit import recorder
from apu_casadi.unit.apu import CouplingParameters, OnShaft
from apu_casadi.unit.events import HealthChange, Holding
from apu_casadi.unit.linearisation import linearise_joint
from apu_casadi.unit.machines import kinds
from apu_casadi.unit.monolithic import simulate_monolithic
from apu_casadi.unit.noise import Noise

KW100, KW150 = SeriesLoad.from_power(100e3), SeriesLoad.from_power(150e3)
FAULT = Ttsc(0.05, 20.0)
SUMMARY = dict(duration=0.3, load=KW100, waveform_dt=None)
OTHER = Apu().change({"generator2.machine.r_s": 0.006, "generator2.exciter.K_A": 230.0})


def run(apu=None, **more):
    return simulate_joint(apu or Apu(), **{**SUMMARY, **more})


def faulty(k, t=0.1):
    return FaultChange(t, FAULT, generator=k)


# -- parameters ---------------------------------------------------------------------------------


def test_two_equal_generators_are_the_paper_s_unit():
    apu = Apu()
    assert apu.with_generators(apu.generator, Generator()) == apu and apu.others is None
    assert apu.generators == (apu.generator,) * 2 and apu.alike
    assert apu.with_generators(Generator(), Generator(), Generator()) != apu
    assert dataclasses.replace(apu, generator=OTHER.generators[1]).alike


def test_a_name_is_for_all_generators_or_for_one():
    one = Apu().change({"machine.r_s": 0.005, "generator2.machine.r_s": 0.006})
    assert [g.machine.r_s for g in one.generators] == [0.005, 0.006]
    # the order of the names does not count
    same = Apu().change({"generator2.machine.r_s": 0.006, "machine.r_s": 0.005})
    assert same == one and Apu().change(one.parameters()) == one
    assert one.parameters()["generator2.machine.r_s"] == 0.006
    assert one.change({"machine.r_s": 0.005}).alike
    gears = Apu().change({"generator2.coupling.gear": 3.2, "generator2.neutral": "isolated"})
    assert gears.machines[1].coupling.gear == 3.2 and gears.generator.neutral == "grounded"
    first = Apu().change({"generator1.machine.r_s": 0.006})
    assert first.generator.machine.r_s == 0.006 and not first.alike


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_a_unit_has_one_to_four_generators(n):
    unit = OTHER.change({"generator.count": n})
    assert len(unit.machines) == n == unit.parameters()["generator.count"]
    assert unit.generators[1:2] == OTHER.generators[1 : min(n, 2)]
    assert Apu().change(unit.parameters()) == unit


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"generator3.machine.r_s": 1.0}, "the unit has generators 1 to 2"),
        ({"generator2.machine.rs": 1.0}, "did you mean 'generator2.machine.r_s'"),
        ({"generator2.governor.Kp": 1.0}, "unknown parameter 'generator2.governor.Kp'"),
        ({"generator.count": 5}, "not one of 1 to 4"),
        ({"generator.count": 1.5}, "not one of 1 to 4"),
        ({"generator2.machine.r_s": -1.0}, "outside"),
    ],
)
def test_wrong_names_of_one_generator_are_refused(values, words):
    with pytest.raises(ParameterError, match=words):
        Apu().change(values)


def test_wrong_generators_are_refused():
    gen = Generator()
    with pytest.raises(ParameterError, match="1 to 4"):
        Apu().with_generators(*[gen] * 5)
    with pytest.raises(ParameterError, match="1 to 4"):
        Apu().with_generators()
    with pytest.raises(ParameterError, match="a gear each"):
        Apu().with_generators(gen, couplings=[CouplingParameters()] * 2)
    with pytest.raises(ParameterError, match="generator 2: OnShaft"):
        Apu(others=(gen,))
    with pytest.raises(ParameterError, match=r"needs equal generators.*generator2\.machine\.r_s"):
        OTHER.PW(1e5)
    with pytest.raises(ScenarioError, match="load: 2 entries expected, one a generator, got 1"):
        simulate_monolithic(OTHER, duration=0.1, load=[KW100])
    with pytest.raises(ParameterError, match="power 1 "):
        Apu().change({"generator.power": 1})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (dict(load=[KW100]), "load: 2 entries expected"),
        (dict(fault=[FAULT] * 3), "fault: 2 entries expected"),
        (dict(fault={3: FAULT}), "generator 3, but the unit has 1 to 2"),
        (dict(events=[faulty(3)]), r"events\[0\]: generator 3, but the unit has 1 to 2"),
        (dict(events=[faulty(2), faulty(None)]), "second FaultChange of generator 2"),
        (dict(events=[faulty(2), faulty(2)]), "second FaultChange of generator 2"),
    ],
)
def test_what_is_there_for_no_generator_is_refused(given, words):
    with pytest.raises(ScenarioError, match=words):
        run(**given)


@pytest.mark.parametrize("k", [0, 1.0, True, "2"])
def test_the_number_of_a_generator_is_a_number_from_1(k):
    with pytest.raises(ScenarioError, match="a number from 1"):
        LoadChange(0.1, KW100, generator=k)


# -- computed once ------------------------------------------------------------------------------


def test_equal_generators_are_one_group():
    unit = OTHER.change({"generator.count": 4})
    start = Holding((KW100,) * 4, (None,) * 4, {})
    assert kinds(unit, start) == [(1, 3, 4), (2,)]
    assert kinds(unit, start, [faulty(3)]) == [(1, 4), (2,), (3,)]
    # healed or not, they stay apart; what two get at one instant does not part them
    healed = [faulty(1), FaultChange(0.2, None, generator=1)]
    assert kinds(Apu(), Holding((KW100,) * 2, (None,) * 2, {}), healed) == [(1,), (2,)]
    both = [faulty(1), HealthChange(0.1, {"f_eta_c": 0.99}), faulty(2)]
    assert kinds(Apu(), Holding((KW100,) * 2, (None,) * 2, {}), both) == [(1, 2)]


def test_given_one_by_one_equal_ones_have_the_same_bits_and_form():
    plain = run(fault=FAULT, events=[LoadChange(0.2, KW150)])
    events = [LoadChange(0.2, KW150, generator=1), LoadChange(0.2, KW150, generator=2)]
    each = run(load=[KW100, KW100], fault={1: FAULT, 2: FAULT}, events=events)
    assert plain.drop_attrs().identical(each.drop_attrs())
    assert "generator" not in plain.dims and plain.attrs["generators"] == 2


def test_before_a_switch_of_one_both_are_one():
    """The group parts at 0.1 s: until then the bits are those of the run without the fault."""
    ds, healthy = run(events=[faulty(2)]), run()
    before = ds.time.values <= 0.1 + 1e-9
    for n in ("N", "PW", "P_total"):
        assert np.array_equal(ds[n].values[before], healthy[n].values[before])
    assert np.array_equal(*ds.I_a_rms.values[:, before])
    count = json.loads(ds.attrs["solver"])["steps_propagated"]
    # 5 steps of both as one, 10 of each; the step after the switch is CVODES and propagation
    assert count == 5 + 10 + 9


# -- physics ------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["auto", "cvodes"])
def test_a_fault_in_one_asks_half_of_what_a_fault_in_both_asks(solver):
    """In the step after the switch, in which the speed is held."""
    both, one, none = (
        run(duration=0.12, solver=solver, events=e) for e in ([faulty(None)], [faulty(2)], [])
    )
    more = [ds.PW.values[-1] - none.PW.values[-1] for ds in (one, both)]
    assert more[0] == pytest.approx(more[1] / 2, rel=1e-12) and more[0] > 5e3
    assert one.P_e.values[0, -1] == none.P_e.values[-1]


@pytest.mark.parametrize("waveform_dt", [None, 1e-4])
def test_a_fault_in_the_other_generator_mirrors_the_run(waveform_dt):
    a, b = (
        run(load=loads, events=[faulty(k)], waveform_dt=waveform_dt)
        for k, loads in ((1, [KW100, KW150]), (2, [KW150, KW100]))
    )
    for name, v in a.variables.items():
        if name != "generator":
            mirrored = v.values[::-1] if "generator" in v.dims else v.values
            assert mirrored.tobytes() == b[name].values.tobytes(), name


def test_currents_of_the_healthy_one_move_by_speed_only():
    """Its state is that of a generator alone, on the speeds of the run."""
    ds = run(events=[faulty(2)])
    gen, unit = Apu().generator, Apu()
    assert np.ptp(ds.N.values) > 3.0
    at_end = gen.steady_state(KW100, w_r=unit.w_r(ds.N.values[-1]))
    healthy, other = ds.sel(generator=1), ds.sel(generator=2)
    rated = gen.steady_state(KW100, w_r=unit.w_r(unit.N_ref)).V_t
    moved = healthy.V_a_rms.values[-1] / rated - 1
    assert abs(moved) < 2e-3 and abs(healthy.V_a_rms.values[-1] / at_end.V_t - 1) < 2e-3
    assert np.array_equal(healthy.I_a_rms, healthy.I_b_rms)
    assert abs(other.I_a_rms.values[-1] / other.I_b_rms.values[-1] - 1) > 1e-3


LOADS = {
    "R": KW100,
    "R-L": SeriesLoad.from_power(80e3, 0.85),
    "unbalanced": SeriesLoad.from_power(90e3, unbalance=(1.2, 1.0, 0.8)),
    "P": ConstantPowerLoad(70e3),
}


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_shaft_power_is_the_sum_over_the_generators(n):
    """Eq. (1) with a gear, an efficiency, a load, a fault and parameters of each."""
    gen, eta, gears = Generator(), (1.0, 0.97, 0.95, 0.99), (3.0, 3.05, 2.95, 3.01)
    machines = [
        OnShaft(
            dataclasses.replace(gen, machine=gen.machine.change(r_s=0.0044 + 1e-4 * k, eta_sg=e)),
            CouplingParameters(gear=gear, eta_gtSg=eta_g),
        )
        for k, (e, eta_g, gear) in enumerate(zip((0.9, 0.88, 0.91, 0.9), eta, gears, strict=True))
    ][:n]
    unit = Apu().with_generators(
        *(m.generator for m in machines), couplings=[m.coupling for m in machines]
    )
    loads = [*LOADS.values()][:n]
    faults = {k: Ttsc(0.05, 10.0 + k, phase="abca"[k - 1]) for k in range(1, n + 1) if k != 2}
    ds = run(unit, load=loads, fault=faults, duration=0.1, solver="cvodes")
    eta_sg = np.array([[m.generator.machine.eta_sg] for m in machines])
    P = ((ds.P_e.values + ds.P_loss_fault.values) / eta_sg).reshape(n, -1)
    assert ds.P_total.values == pytest.approx(P.sum(0), rel=1e-12)
    assert ds.PW.values == pytest.approx((P / np.array(eta[:n])[:, None]).sum(0), rel=1e-9)
    at = unit.steady_state([x.balanced_part for x in loads])
    assert len({at.of(k).y["P_e"] for k in range(1, n + 1)}) == n
    assert at.gas["PW"] == pytest.approx(
        sum(at.of(k).y["P_total"] / 2 / eta[k - 1] for k in range(1, n + 1)), rel=1e-9
    )


@pytest.mark.long
@pytest.mark.parametrize("waveform_dt", [None, 5e-5])
@pytest.mark.parametrize("phase", "abc")
def test_different_generators_by_blocks_equal_cvodes(waveform_dt, phase):
    """Exact propagation of two against CVODES: 1e-5 of peak, powers 5e-5, as of the pair."""
    kw = dict(waveform_dt=waveform_dt, load=[KW100, LOADS["R-L"]], duration=0.4)
    kw["events"] = [FaultChange(0.1, Ttsc(0.05, 5.0, phase=phase), generator=2)]
    a, b = run(OTHER, **kw), run(OTHER, solver="cvodes", **kw)
    names = ["N", "PW", "Wf", "V_a_rms", "I_b_rms", "I_c_rms", "P_e", "P_loss_fault"]
    if waveform_dt:
        names += ["i_a", "i_b", "i_c", "i_fd", "i_fault", "P_inst"]
        late = abs(a.time_w.values - 0.1) > 0.5e-3
        assert np.allclose(a.time_w, b.time_w, atol=1e-12)
    for n in names:
        x, y = a[n].values, b[n].values
        if a[n].dims[-1] == "time_w":
            x, y = x[..., late], y[..., late]
        tol = 5e-5 if n.startswith("P") else 1e-5
        assert np.abs(x - y).max() < tol * np.abs(y).max(), n


def test_kinds_of_load_side_by_side():
    """Each generator of a unit of three has the state that it has alone at that speed."""
    loads = [KW100, ConstantPowerLoad(90e3), OpenLoad()]
    unit = Apu().change({"generator.count": 3})
    ds = run(unit, load=loads, waveform_dt=1e-3)
    for k, x in enumerate(loads, 1):
        y = unit.generator.steady_state(x, w_r=unit.w_r(unit.N_ref)).y
        own = results.of_generator(ds, k)
        assert own.P_e.values[-1] == pytest.approx(y["P_e"], rel=1e-6, abs=5.0)
        assert own.V_a_rms.values[-1] == pytest.approx(y["V_t"], rel=1e-6)
    rows = json.loads(ds.attrs["loads"])
    assert [(r["generator"], r["t"]) for r in rows] == [(1, 0.0), (2, 0.0), (3, 0.0)]
    assert "3 generators" in ds.P_total.attrs["long_name"]


def test_warnings_say_which_generator():
    events = [LoadChange(0.1, OpenLoad(), generator=2)]
    with pytest.warns(UserWarning, match="generator 2: at t = 0.1 s a switch"):
        run(events=events, duration=0.14)
    big = LoadChange(0.1, ConstantPowerLoad(500e3), generator=2)
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        run(events=[big], duration=0.5, exchange="predicted")
    texts = [str(w.message) for w in raised]
    assert any("kW asked of generator 2;" in t for t in texts)
    assert any("the torque of generator 2 takes" in t for t in texts)


# -- results ------------------------------------------------------------------------------------


def test_each_generator_can_be_taken_out():
    ds, plain = run(events=[faulty(2)]), run()
    one = results.of_generator(ds, 2)
    assert set(one.dims) == {"time"} and one.mu.values[-1] == 0.05
    assert results.generators_of(ds) == (1, 2) and results.generators_of(plain) == (1,)
    assert results.of_generator(plain, 2).identical(plain)
    for each in (ds, plain):
        with pytest.raises(DataError, match="generator 3"):
            results.of_generator(each, 3)


@pytest.mark.parametrize("piece", [7, 1 << 15])
def test_different_generators_in_a_file_have_the_same_bits(piece, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "PIECE", piece)
    kw = dict(events=[faulty(2)], waveform_dt=1e-3, phasors=True, load=[KW100] * 3)
    unit = Apu().change({"generator.count": 3})
    memory, file = (run(unit, storage=s, **kw) for s in ("memory", tmp_path))
    assert list(memory.variables) == list(file.variables) and memory.attrs == file.attrs
    for name, v in memory.variables.items():
        assert v.values.tobytes() == file[name].values.tobytes(), name
        assert v.dims == file[name].dims and v.attrs == file[name].attrs
    path = results.save(file, tmp_path / "a.nc")
    assert path.read_bytes() == results.save(memory, tmp_path / "b.nc").read_bytes()
    assert results.load(path).identical(cf.described(memory))


# -- what takes part, and what refuses ----------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "how",
    [
        dict(exchange="predicted"),
        dict(exchange="corrected"),
        dict(solver="cvodes", waveform_dt=1e-3),
        dict(waveform_dt=1e-4, phasors=True),
        dict(solver="idas", duration=0.16),
    ],
    ids=str,
)
def test_two_that_only_seem_to_differ_give_the_bits_of_one(how):
    """The generators differ by a number that nothing here depends on: each has its own group."""
    events = [faulty(None), LoadChange(0.14, KW150)]
    a = run(events=events, **how)
    b = run(Apu().change({"generator2.exciter.T_lim": 2e-3}), events=events, **how)
    assert b.sizes["generator"] == 2
    for name, v in a.variables.items():
        for own in np.atleast_2d(b[name].values):
            assert own.tobytes() == v.values.tobytes(), name


def test_noise_is_drawn_for_each_group():
    ds = run(load=[KW100, KW150], solver="cvodes", noise=Noise(w1=2.0), seed=1, duration=0.1)
    V = ds.V_a_rms.values
    assert abs(np.corrcoef(np.diff(V[0]), np.diff(V[1]))[0, 1]) < 0.99
    terminal = Noise(terminal=MeasurementNoise(sigma_i=1.0))
    read = run(load=[KW100, KW150], noise=terminal, seed=1, duration=0.1, waveform_dt=1e-3)
    wrong = read.i_a_meas.values - read.i_a.values
    assert wrong.shape == (2, read.time_w.size) and 0.5 < wrong.std() < 1.5
    assert abs(np.corrcoef(*wrong)[0, 1]) < 0.5


def test_three_in_one_model_load_the_shaft_as_in_the_joint_run():
    unit = Apu().change({"generator.count": 3})
    kw = dict(duration=0.1, load=KW100)
    one, joint = simulate_monolithic(unit, **kw), simulate_joint(unit, waveform_dt=None, **kw)
    assert one.P_total.values == pytest.approx(joint.P_total.values, rel=1e-8)
    assert one.PW.values == pytest.approx(one.P_total.values, rel=1e-6)


def test_linear_models_know_how_many_generators_there_are():
    # the shaft power of four takes twice as much of the speed as that of two
    gains = []
    for n in (2, 4):
        unit = Apu().change({"generator.count": n})
        model = linearise_joint(unit, unit.steady_state(SeriesLoad.from_power(50e3)))
        gains.append(model.derivative("PW", "lam_fd"))
    assert gains[1] == pytest.approx(2 * gains[0], rel=1e-6) and abs(gains[0]) > 1e5
