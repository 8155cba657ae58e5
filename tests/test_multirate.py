"""The multi-rate joint simulation: steady start, books of energy, events, noise, refusals."""

import json
import math

import numpy as np
import pytest

from apu_casadi.core.errors import OperatingPointError, ParameterError, ScenarioError, SignalError
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.measurement import MeasurementNoise
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import Ambient, FaultChange, HealthChange, LoadChange
from apu_casadi.unit.multirate import exchange_grid, simulate_joint
from apu_casadi.unit.noise import Noise

APU = Apu()
KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)


@pytest.fixture(scope="module")
def run():
    """Half a second with all three kinds of event, one of them between exchange instants."""
    events = [
        LoadChange(0.1, KW100),
        HealthChange(0.2, {"f_eta_c": 0.99}),
        FaultChange(0.3137, Ttsc(0.05, 20.0)),
    ]
    return simulate_joint(APU, duration=0.5, load=KW225, events=events, solver="cvodes")


def test_nothing_moves_before_the_first_event(run):
    """Trimmed start: 1e-8, the integrators' tolerance."""
    before = run.time.to_numpy() <= 0.1
    for n in ("N", "PW", "Wf", "T3", "T4", "P3", "V_a_rms", "I_a_rms"):
        v = run[n].to_numpy()[before]
        assert np.ptp(v) <= 1e-8 * abs(v[0]), n


def test_energy_handed_over_is_energy_received(run):
    """Eq. (1): what the generators took is what loads the gas generator, to 1e-10."""
    h = np.diff(run.time.to_numpy())
    given = np.sum(run.P_total.to_numpy()[1:] * h)
    taken = np.sum(run.PW.to_numpy()[1:] * h) * APU.coupling.eta_gtSg
    assert given == pytest.approx(taken, rel=1e-10)


def test_power_balance_of_eq_3_closes(run):
    """J N dN = (P_turb - P_cpr/eta - P_acc - PW) dt over the acceleration after the load drop.

    1 %: fuel and power of a step are those stored at its end, the speed's change within a step
    is neglected in the sum here.
    """
    t, N = run.time.to_numpy(), run.N.to_numpy()
    J = APU.gas_generator.parameters.J
    a, b = np.searchsorted(t, 0.12 - 1e-9), np.searchsorted(t, 0.2 - 1e-9)
    P = run.P_acceleration.to_numpy()[a : b + 1]
    work = np.sum(P[1:] * np.diff(t[a : b + 1]))

    assert 0.5 * J * (N[b] ** 2 - N[a] ** 2) == pytest.approx(work, rel=0.01)


def test_events_between_exchange_instants_are_met_exactly(run):
    """0.3137 s is on the exchange grid; the fault is there right after, not before."""
    t = run.time.to_numpy()
    k = int(np.argmin(abs(t - 0.3137)))
    assert abs(t[k] - 0.3137) < 1e-12
    assert run.mu.to_numpy()[k] == 0.0
    assert run.mu.to_numpy()[k + 1] == 0.05
    t_w, i_F = run.time_w.to_numpy(), run.i_fault.to_numpy()
    assert np.all(i_F[t_w <= 0.3137] == 0.0)
    assert np.abs(i_F[t_w > 0.3137]).max() > 1000


def test_waveforms_are_sampled_evenly_without_events_in_between(run):
    """50 us apart on whole exchange steps (rounding of the times)."""
    t = run.time_w.to_numpy()
    t = t[t <= 0.3]
    np.testing.assert_allclose(np.diff(t), 50e-6, rtol=1e-6)


def test_rms_per_exchange_is_the_rms_of_the_samples(run):
    """Quadrature in the integrator against 400 samples: spectral accuracy at rated speed, 1e-6."""
    t = run.time_w.to_numpy()
    v = run.v_a.to_numpy()[(t > 0.06 + 1e-9) & (t <= 0.08 + 1e-9)]
    k = int(np.argmin(abs(run.time.to_numpy() - 0.08)))
    assert float(run.V_a_rms[k]) == pytest.approx(math.sqrt(np.mean(v**2)), rel=1e-6)


def test_health_changes_act_from_their_instant(run):
    """The factor holds from the step after 0.2 s on, and the speed falls."""
    t = run.time.to_numpy()
    f = run.f_eta_c.to_numpy()
    assert np.all(f[t <= 0.2 + 1e-9] == 1.0)
    assert np.all(f[t > 0.2 + 1e-9] == 0.99)


def test_the_dataset_says_what_it_is(run):
    """Units and meaning on every variable; parameters and solver in the attributes."""
    for v in run.variables.values():
        assert v.attrs["units"]
        assert v.attrs["long_name"]
    assert json.loads(run.attrs["parameters"])["machine.r_s"] == 0.0044
    solver = json.loads(run.attrs["solver"])
    assert solver["residual_max"] < 1e-9
    assert solver["solver"] == "cvodes"


def test_idas_and_cvodes_give_the_same_unit():
    """The DAE form in the loop instead of the ODE: speed and voltage to 5e-6.

    Right after the load drop the voltage doubles for microseconds; both integrate its square.
    """
    events = [LoadChange(0.04, KW100)]
    kw = {"duration": 0.1, "load": KW225, "events": events, "waveform_dt": None}
    a, b = (simulate_joint(APU, solver=s, **kw) for s in ("cvodes", "idas"))
    for n in ("N", "V_a_rms", "PW"):
        np.testing.assert_allclose(b[n], a[n], rtol=5e-6)


def test_exact_propagation_gives_the_same_run(run):
    """The fast integrator in the loop against CVODES at rtol 1e-10: 1e-5 of peak everywhere.

    Same events as above.  The step after each switch is CVODES' own in both.
    """
    kw = {"duration": 0.5, "load": KW225,
          "events": [LoadChange(0.1, KW100), HealthChange(0.2, {"f_eta_c": 0.99}),
                     FaultChange(0.3, Ttsc(0.05, 20.0))]}  # fmt: skip
    fast = simulate_joint(APU, solver="propagator", **kw)
    tight = simulate_joint(APU, rtol=1e-10, atol=1e-12, **kw)
    assert json.loads(fast.attrs["solver"])["steps_propagated"] >= 20
    for n in ("v_a", "v_b", "v_c", "i_a", "i_fault", "V_fd", "T_e"):
        np.testing.assert_allclose(fast[n], tight[n], atol=1e-5 * float(abs(tight[n]).max()))
    for n in ("N", "PW", "V_a_rms", "I_c_rms", "T4"):
        np.testing.assert_allclose(fast[n], tight[n], rtol=1e-6)


def test_means_and_phasors_without_waveforms():
    """Blocks of steps without samples, healthy and faulty, against CVODES: 1e-5, phasors 2e-5.

    Phasors of the balanced steady start: equal, a third of a turn apart, and as large as the rms
    value; the fault brings a negative sequence.
    """
    events = [LoadChange(0.1, KW100), FaultChange(0.5113, Ttsc(0.05, 20.0, phase="b"))]
    kw = {"duration": 1.0, "load": KW225, "waveform_dt": None, "phasors": True, "events": events}
    fast = simulate_joint(APU, solver="propagator", **kw)
    tight = simulate_joint(APU, rtol=1e-10, atol=1e-12, **kw)
    assert json.loads(fast.attrs["solver"])["steps_propagated"] >= 40
    for n in ("N", "PW", "T4", "P_loss_fault", "V_a_rms", "V_b_rms", "I_c_rms"):
        np.testing.assert_allclose(fast[n], tight[n], atol=1e-5 * float(abs(tight[n]).max()))
    V, I = (np.array([fast[f"{q}_{p}_re"] + 1j * fast[f"{q}_{p}_im"] for p in "abc"]) for q in "VI")
    exact = np.array([tight[f"V_{p}_re"] + 1j * tight[f"V_{p}_im"] for p in "abc"])
    np.testing.assert_allclose(V, exact, atol=2e-5 * np.abs(exact).max())
    a = np.exp(2j * np.pi / 3)
    np.testing.assert_allclose(V[:, 0], V[0, 0] * np.array([1, a**2, a]), rtol=1e-12)
    np.testing.assert_allclose(V[:, 0], V[:, 1], rtol=1e-6)
    np.testing.assert_allclose(abs(V[0, :4]), fast.V_a_rms[:4], rtol=1e-6)
    np.testing.assert_allclose(V[:, -1] / I[:, -1], KW100.R, rtol=1e-6)
    negative = np.abs(V[0] + a**2 * V[1] + a * V[2]) / 3
    assert negative[:5].max() < 1e-3 and negative[-1] > 1.0
    assert fast.V_a_re.attrs["units"] == "V" and "fundamental" in fast.I_b_im.attrs["long_name"]


def test_exact_propagation_leaves_to_cvodes_what_is_not_linear():
    """A constant-power load runs by CVODES although the propagator was asked for."""
    kw = {"duration": 0.1, "load": ConstantPowerLoad(90e3), "waveform_dt": None}
    ds = simulate_joint(APU, solver="propagator", **kw)
    status = json.loads(ds.attrs["solver"])
    assert status["steps_propagated"] == 0
    assert status["nsteps_generator"] > 0


@pytest.mark.long
def test_noise_is_reproducible_and_has_the_spread_asked_for():
    """Same seed, same run; measured copies scatter around the truth with the given sigma."""
    noise = Noise(N=1.0, w1=0.5, w2=0.1, gas={"T3": 2.0}, terminal=MeasurementNoise(1.0, 2.0, 0.5))
    kw = {"duration": 1.0, "load": KW225, "noise": noise, "waveform_dt": 1e-3}
    a, b, c = (simulate_joint(APU, seed=s, **kw) for s in (1, 1, 2))
    np.testing.assert_array_equal(a.N, b.N)
    np.testing.assert_array_equal(a.T3_meas, b.T3_meas)
    assert not np.array_equal(a.N, c.N)
    # 51 draws: the sample deviation lies within 4 of its own deviations, 10 % each
    assert np.std(a.T3_meas - a.T3) == pytest.approx(2.0, rel=0.4)
    assert np.std(a.v_a_meas - a.v_a) == pytest.approx(2.0, rel=0.1)
    assert a.T3_meas.attrs["units"] == "K"


def test_the_hook_sits_between_update_and_output():
    """A hook that holds the speed freezes it, in the outputs too."""
    N0 = APU.N_ref
    ds = simulate_joint(APU, duration=0.1, load=KW225, events=[LoadChange(0.02, KW100)],
                        hook=lambda k, x: np.array([N0]), waveform_dt=None)  # fmt: skip
    np.testing.assert_array_equal(ds.N.to_numpy()[1:], N0)


def test_unbalanced_load_and_fault_from_the_start():
    """Both act from t = 0 on the steady balanced unit."""
    load = SeriesLoad.from_power(150e3, unbalance=(1.2, 1.0, 0.8))
    ds = simulate_joint(APU, duration=0.06, load=load, fault=Ttsc(0.02, 50.0, phase="b"))
    assert float(ds.I_a_rms[-1]) > 1.3 * float(ds.I_c_rms[-1])
    assert float(ds.mu[1]) == 0.02


def test_flight_and_other_loads():
    """At 6000 m with a constant-power load: steady as on the ground."""
    ds = simulate_joint(APU, duration=0.1, load=ConstantPowerLoad(90e3), waveform_dt=None,
                        ambient=Ambient(altitude=6000.0, Mach=0.5, dT_isa=0.0))  # fmt: skip
    assert np.ptp(ds.N.to_numpy()) < 1e-8 * float(ds.N[0])
    assert float(ds.P_e[-1]) == pytest.approx(90e3, rel=1e-8)


def test_parameters_are_changed_by_name():
    """A rotor twice as heavy overshoots less (0.89 of it); wrong names are refused."""
    kw = {"duration": 0.5, "load": KW225, "events": [LoadChange(0.02, KW100)], "waveform_dt": None}
    light = simulate_joint(APU, **kw)
    heavy = simulate_joint(APU.change({"gas_generator.J": 0.1}), **kw)
    assert float(heavy.N.max()) - APU.N_ref < 0.95 * (float(light.N.max()) - APU.N_ref)
    with pytest.raises(ParameterError, match=r"governor\.kp.*governor\.Kp"):
        APU.change({"governor.kp": 1.0})
    with pytest.raises(ParameterError, match=r"r_s"):
        APU.change({"machine.r_s": -1.0})


def test_exchange_grid_holds_multiples_events_and_the_end():
    """No instant twice, none missed."""
    g = exchange_grid(0.1, 0.02, [LoadChange(0.05, KW100), HealthChange(0.04, {"f_W_c": 1.0})])
    np.testing.assert_allclose(g, [0, 0.02, 0.04, 0.05, 0.06, 0.08, 0.1], atol=1e-12)
    g = exchange_grid(0.05, 0.02, [])
    np.testing.assert_allclose(g, [0, 0.02, 0.04, 0.05], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"duration": -1.0}, ScenarioError, "duration"),
        ({"dt": 0.0}, ScenarioError, "dt"),
        ({"waveform_dt": 0.1}, ScenarioError, "waveform_dt"),
        ({"events": [LoadChange(5.0, KW100)]}, ScenarioError, "5 s"),
        ({"health": {"f_eta_x": 1.0}}, ScenarioError, "f_eta_t"),
        ({"solver": "cvode"}, ScenarioError, "cvodes"),
        ({"load": SeriesLoad.from_power(400e3)}, OperatingPointError, "governor's limits"),
    ],
)
def test_impossible_runs_are_refused(change, error, message):
    """Each message says what is wrong and by how much."""
    with pytest.raises(error, match=message):
        simulate_joint(APU, **{"duration": 0.1, "load": KW225, "waveform_dt": None, **change})


def test_noise_refuses_unknown_signals_and_negative_spread():
    """The nearest output name is in the message."""
    with pytest.raises(SignalError, match="T3"):
        Noise(gas={"t3": 1.0})
    with pytest.raises(SignalError, match="N"):
        Noise(N=-1.0)


@pytest.mark.long
def test_a_staircase_of_small_changes_is_fast_by_default():
    """120 health changes in 61 s, every half second: each step is propagated, none integrated."""
    events = [HealthChange(0.5 * (k + 1), {"f_eta_c": 1 - 1e-4 * k}) for k in range(120)]
    ds = simulate_joint(APU, duration=61.0, load=KW225, events=events, waveform_dt=None)
    status = json.loads(ds.attrs["solver"])
    assert status["solver"] == "auto" and status["nsteps_generator"] == 0
    assert status["steps_propagated"] == 3050
    assert ds["f_eta_c"].values[-1] == pytest.approx(1 - 1e-4 * 119)
