"""``apu identify``, and the studies behind it: shaft power, load ramp, severity of a stator fault.

FACTS known of the machine: with kappa = mu only h = mu/(k_rf + 1 - mu) shows at the terminals; seen
from there the faulty machine is the healthy one with a shunt R = r_s/h, L = (kappa - mu) L_ls/mu.
"""

import dataclasses
import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ParameterError, SignalError
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from estimators.apu import identify as study
from estimators.apu import severity, trials
from estimators.information.identifiability import identify
from scenarios.cli import main
from scenarios.figures.estimationplot import plot_gain_of_a_sensor


def out(capsys, *argv):
    """Run the command; return status, standard output and standard error."""
    status = main(["identify", *argv])
    got = capsys.readouterr()
    return status, got.out, got.err


@pytest.mark.long
def test_the_report_says_what_can_be_known(capsys, tmp_path):
    """The paper's sensors at the design point: the null direction, what to add, what power does."""
    status, text, _ = out(capsys, "--figure", str(tmp_path / "new" / "power.png"))
    words = " ".join(text.split())
    assert status == 0
    assert "rank 3 of 4" in words
    assert "f_W_c, f_eta_t and f_W_t cannot be told apart" in words
    assert "f_W_c: add W2; visible from" in words
    assert "Null direction, unit length: f_W_c +0.626, f_eta_t -0.578, f_W_t +0.523" in words
    assert "(mu, k_rf) is a ridge of constant h" in words
    assert max(len(line) for line in text.splitlines()) <= 120
    assert (tmp_path / "new" / "power.png").stat().st_size > 20_000


@pytest.mark.long
def test_json_holds_the_same(capsys):
    """Infinite bounds become null; nothing is NaN."""
    status, text, _ = out(capsys, "--json", "--sensors", "N,P3,T3,T5", "--point", "offdesign")
    report = json.loads(text)
    assert status == 0 and report["rank"] == 2
    these = {r["fault"]: r for r in report["sets"] if r["set"] == "these"}
    assert these["f_W_c"]["sigma_flat"] is None and these["f_eta_c"]["sigma_flat"] > 0
    assert report["severity"][0]["sigma_log_mu"] is None
    assert {r["fault"] for r in report["add"]} == set(these)


@pytest.mark.long
@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (("--sensors", "N,p3"), "unknown sensor p3 (did you mean 'P3'?)"),
        (("--point", "desing"), "unknown point 'desing' (did you mean 'design'?)"),
        (("--point", "design,design"), "a point is given twice"),
        (("--prior", "0"), "--prior > 0"),
        (("--figure", "/proc/none/x.png"), "cannot be written"),
    ],
)
def test_refusals(capsys, argv, words):
    """Status 2, the nearest name, and nothing printed."""
    status, text, err = out(capsys, *argv)
    assert status == 2 and words in err and text == ""


# ---------------------------------------------------------------------- shaft power


@pytest.mark.parametrize("point", ["design", "offdesign", "partload"])
def test_shaft_power_reaches_its_aims(point):
    """2 % prior, 1 % power noise, 1 s: rms of the four sigmas falls by 50 %, by 30 % with bias."""
    exact = study.shaft_power_snapshot(point)
    biased = study.shaft_power_snapshot(point, eta_bias=study.ETA_BIAS)
    assert exact["reduction"] >= study.AIMS["exact efficiency"]
    assert biased["reduction"] >= study.AIMS["efficiency bias"]
    # without PW the prior is all that is known along the null direction
    assert exact["null_before"] == pytest.approx(0.02, rel=1e-9)
    assert exact["null_after"] < biased["null_after"] < 0.02


def test_where_shaft_power_falls_short():
    """One sample, or gain errors of all sensors: below 30 %, by the information there is."""
    assert study.shaft_power_snapshot(samples=1)["reduction"] < 0.3
    gains = study.shaft_power_snapshot(eta_bias=study.ETA_BIAS, gain_errors=True)
    assert gains["reduction"] < 0.3
    # each gain error alone leaves more than all together
    alone = study.limiting_gains(eta_bias=study.ETA_BIAS)
    assert set(alone) == {"P3", "T3", "T5", "Wf"}
    assert min(alone.values()) > gains["reduction"]
    one = study.shaft_power_snapshot(samples=1)["reduction"]
    noise = study.limiting_noises()
    assert all(one < v < study.AIMS["exact efficiency"] for v in noise.values())


def test_the_reduction_agrees_with_the_matrix_inversion_lemma():
    """One more reading of variance R and bias b: C - C h h'C/(h'C h + R + b^2), by hand."""
    g = study.gas_path(sensors=study.GAS_PATH)
    C = np.linalg.inv(
        sum(np.outer(r, r) for r, n in zip(g.J, g.rows, strict=True) if n != "PW")
        + np.diag(1 / np.where(np.isfinite(g.prior), g.prior, 1e9) ** 2)
    )
    h = g.J[g.rows.index("PW")]
    f = g.theta.indices(g.faults)
    for bias in (0.0, 0.02):
        r = study.shaft_power_snapshot(eta_bias=bias)
        after = C - np.outer(C @ h, C @ h) / (h @ C @ h + 1 + (bias / 0.01) ** 2)
        rms = math.sqrt(np.trace(after[np.ix_(f, f)]) / 4)
        # 1e-5: the flat priors of N and Wf are 1e9 here, and C is inverted in unlike units
        assert r["rms_after"] == pytest.approx(rms, rel=1e-5)


@pytest.mark.long
def test_random_snapshots_of_the_nonlinear_engine_confirm_the_bounds():
    """60 seeds: errors within 4 standard errors of the bounds (500 in the command's --trials).

    The rms of 60 snapshots' dominant direction has a standard error of 1/sqrt(120) = 9 %.
    """
    t = trials.snapshot_trials(seeds=range(60), eta_bias=study.ETA_BIAS)
    assert t.rms_before == pytest.approx(t.bound_before, rel=0.36)
    assert t.rms_after == pytest.approx(t.bound_after, rel=0.36)
    assert t.interval[0] < t.reduction < t.interval[1]
    # 95 % band of 240 degrees of freedom, doubled
    assert abs(t.nees - 1) < 2 * (t.nees_band[1] - 1)


def test_the_sweep_and_the_samples_needed():
    """The reduction grows with the prior, falls with power noise; the aim needs a few samples."""
    rows = study.snapshot_sweep(variants={"exact efficiency": {}})
    assert len(rows) == len(study.PRIORS) * len(study.POWER_NOISES)
    table = np.array([r["reduction"] for r in rows]).reshape(len(study.POWER_NOISES), -1)
    assert np.all(np.diff(table, axis=1) > 0) and np.all(np.diff(table, axis=0) < 0)
    n = study.needed_samples(0.5)
    assert study.shaft_power_snapshot(samples=n)["reduction"] >= 0.5
    assert study.shaft_power_snapshot(samples=n - 1)["reduction"] < 0.5
    assert study.needed_samples(0.5, eta_bias=0.02, gain_errors=True) is None


def test_a_load_ramp_shows_what_a_steady_recording_does_not():
    """0.8 s without PW: steady leaves the null direction, a ramp shows a little of it."""
    common = {"power": False, "seconds": 0.8, "to_power": 500e3, "backend": "vm"}
    steady = identify(study.gas_path_transient(from_power=500e3, **common))
    ramp = identify(study.gas_path_transient(from_power=222e3, **common))
    # sigma 1e8 W instead of an infinite one: sqrt(40) * 9.4 kW / 1e8 W
    assert steady.singular[-1] < 1e-3
    assert ramp.singular[-1] > 5 * steady.singular[-1]
    null = study.shaft_power_snapshot()["null"]
    v = steady.weakest / np.linalg.norm(steady.weakest)
    assert abs(v @ np.array(list(null.values()))) > 0.999


def test_wrong_numbers_are_refused():
    """Names and ranges, by the function that meets them."""
    with pytest.raises(ParameterError, match="samples >= 1, prior > 0"):
        study.gas_path(samples=0)
    with pytest.raises(ParameterError, match="periods >= 1 and k_rf > 0"):
        severity.severity(Ttsc(0.05, 0.0))


# ---------------------------------------------------------------------- severity

GEN = Generator()
LOAD = SeriesLoad.from_power(225e3)


@pytest.mark.long
def test_severities_of_one_h_have_the_same_currents():
    """kappa = mu: along mu(k_rf) with constant h, 20 ms of the coupled model agree to 1e-9.

    Fourth-order Runge-Kutta with 25 us, so that no step control can hide or make a difference.
    """
    h = 0.02
    point = GEN.steady_state(LOAD)
    ss = GEN.state_space("resistive", "coupled")
    x0 = GEN.transfer(
        point.x, point.ss, ss, u=point.u, theta=[], u_target=GEN.inputs(LOAD, V_ref=point.V_ref)
    )
    u = GEN.inputs(LOAD, V_ref=point.V_ref)
    seen = []
    for k_rf in (0.5, 1.0, 5.0):
        mu = h * (1 + k_rf) / (1 + h)
        fault = Ttsc(mu, k_rf)
        assert fault.h == pytest.approx(h, rel=1e-12)
        theta = GEN.fault_vector(LOAD, fault)
        x, dt, currents = x0, 25e-6, []
        for _ in range(800):
            k1 = ss.f(x, u, theta)
            k2 = ss.f(x + dt / 2 * k1, u, theta)
            k3 = ss.f(x + dt / 2 * k2, u, theta)
            x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + ss.f(x + dt * k3, u, theta))
            currents.append(ss.g(x, u, theta).full().ravel()[ss.y.indices(["i_a", "i_b", "i_c"])])
        seen.append(np.array(currents))
    amplitude = np.abs(seen[0]).max()
    for other in seen[1:]:
        assert np.abs(other - seen[0]).max() < 1e-9 * amplitude


def test_the_shunt_is_what_the_faulty_machine_shows():
    """kappa = 1: simulated mu i_fault against the closed form at the simulated voltage.

    Last two periods of 40 ms with the fault; fundamental of v_a by correlation. 0.5 %: the field
    voltage still moves, and the fault's imbalance adds harmonics.
    """
    fault = Ttsc(0.02, 3.0, 1.0)
    data = GEN.simulate(LOAD, 0.042, switches=[(0.002, fault)], dt_out=25e-6)
    late = data.isel(time=slice(-200, None))
    t, w = late["time"].values, GEN.machine.w_rated
    turn = np.exp(-1j * w * t)
    V, I = (2 * np.mean(late[n].values * turn) for n in ("v_a", "i_fault"))
    Z = fault.R_shunt(GEN.machine) + 1j * w * fault.L_shunt(GEN.machine)
    assert abs(fault.mu * I + V / Z) < 5e-3 * abs(V / Z)
    # and the function behind the study is that closed form
    shunt = severity.shunt_current(GEN)
    args = (math.log(0.02), math.log(3.0), 1.0, 230.0, w)
    found = np.array([float(shunt(*args, s)[0]) for s in t[:25]])
    phasor = -math.sqrt(2) * 230 / Z * np.exp(1j * w * t[:25])
    assert_allclose(found, phasor.real, rtol=1e-9, atol=1e-9 * np.abs(phasor).max())


@pytest.mark.parametrize("kappa", [None, 0.5, 1.0])
def test_exact_sensitivities_are_finite_differences_of_the_current(kappa):
    """Central differences with a step of 1e-5 in the logarithms: 1e-8 of the largest."""
    fault = Ttsc(0.03, 2.0, kappa)
    g, _ = severity.severity(fault, gain_error=False)
    at = GEN.steady_state(LOAD)
    w = float(at.u[0])
    t = 1e-4 * np.arange(len(g.rows))

    def current(mu, k_rf):
        f = Ttsc(mu, k_rf, kappa)
        Z = f.R_shunt(GEN.machine) + 1j * w * f.L_shunt(GEN.machine)
        return -math.sqrt(2) * at.V_t * (np.exp(1j * w * t) / Z).real

    e = 1e-5
    for j, (a, b) in enumerate(((e, 0), (0, e))):
        up = current(0.03 * math.exp(a), 2.0 * math.exp(b))
        down = current(0.03 * math.exp(-a), 2.0 * math.exp(-b))
        slope = (up - down) / (2 * e)
        assert_allclose(g.J[:, j], slope, atol=1e-8 * np.abs(slope).max())  # noise is 1 A


def test_kappa_decides_whether_mu_and_k_rf_can_be_known():
    """kappa = mu is a ridge; a known larger kappa removes it; an unknown one brings it back."""
    rows = severity.severity_study([(0.05, 1.0), (0.01, 10.0)])
    for s in rows:
        tied = s.fault.kappa == s.fault.mu
        assert s.rank == (1 if tied else 2)
        assert math.isinf(s.sigma_mu) == tied and math.isinf(s.sigma_k_rf) == tied
        assert s.sigma_h < 0.1
        if not tied:
            assert s.rank_with_kappa == 2  # of three
    # the ridge is the direction of constant h: d log h = 0
    found = identify(severity.severity(Ttsc(0.05, 1.0))[0])
    v = found.invisible[:2, 0]
    dlog_h = v[0] * (1 + 0.05 / 1.95) - v[1] / 1.95
    assert abs(dlog_h) < 1e-9


# ---------------------------------------------------------------------- figure


def test_the_figure_refuses_what_it_cannot_draw():
    """Shapes, numbers of curves, names of aims."""
    prior = np.array([0.01, 0.02])
    curve = {"reduction": prior, "null_before": prior, "null_after": prior}
    options = {"aims": {}, "note": ""}
    with pytest.raises(SignalError, match="one to 4 curves"):
        plot_gain_of_a_sensor(prior, {}, **options)
    with pytest.raises(SignalError, match=r"a: shapes .*, \(1,\) expected"):
        plot_gain_of_a_sensor(prior[:1], {"a": curve}, **options)
    with pytest.raises(SignalError, match="aims of unknown curves: b"):
        plot_gain_of_a_sensor(prior, {"a": curve}, aims={"b": (0.02, 0.5)}, note="")


@pytest.mark.long
def test_generators_whose_efficiencies_err_on_their_own(capsys, tmp_path):
    """Two equal loads: 0.71 of one's error; one of two with another r_s: its own severity."""
    assert study.independent_bias(0.02, [3.0, 3.0]) == pytest.approx(0.02 / math.sqrt(2))
    assert study.independent_bias(0.02, [1.0]) == 0.02
    # as two considered gains with half of the reading each
    one = study.gas_path(eta_bias=study.independent_bias(0.02, [0.5, 0.5]))
    g = study.gas_path(eta_bias=0.0, power_noise=math.hypot(0.01, 0.02 * math.hypot(0.5, 0.5)))
    pairs = [x.only([*study.BASE, "PW"]).covariance() for x in (one, g)]
    assert_allclose(*pairs, rtol=1e-9)
    engine = tmp_path / "two.toml"
    engine.write_text(
        'name = "two"\n[[generator]]\n[[generator]]\n[generator.machine]\n'
        'r_s = { value = 0.0088, unit = "ohm", source = "twice Table 1" }\n'
    )
    told = []
    for k in ("1", "2"):
        how = ("--json", "--engine", str(engine), "--generator", k, "--shares", "100,100")
        status, text, err = out(capsys, *how)
        assert status == 0, err
        told.append(json.loads(text))
    a, b = (t["severity"] for t in told)
    assert told[1]["generator"] == 2 and "generator" not in told[0]
    assert told[0]["eta_bias_of_all"] == pytest.approx(0.02 / math.sqrt(2))
    bias = [t["shaft_power"]["efficiency bias"]["eta_bias"] for t in told]
    assert bias == [pytest.approx(0.02 / math.sqrt(2))] * 2
    gen = Generator()
    other = dataclasses.replace(gen, machine=gen.machine.change(r_s=0.0088))
    for rows, machine in ((a, gen), (b, other)):
        wanted = severity.severity_study(generator=machine)
        assert_allclose([r["sigma_log_h"] for r in rows], [s.sigma_h for s in wanted], rtol=1e-12)
    # a shunt of twice the resistance carries half of the current
    assert b[-3]["sigma_log_h"] == pytest.approx(2 * a[-3]["sigma_log_h"], rel=0.02)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (("--generator", "3"), "--generator 3: the unit has generators 1 to 2"),
        (("--generator", "0"), "the unit has generators 1 to 2"),
        (("--shares", "1,2,3"), "--shares 1,2,3: the unit has 2 generators"),
        (("--shares", "1,-2"), "numbers > 0 expected"),
        (("--shares", "1,x"), "is no number"),
    ],
)
def test_wrong_generators_and_shares_are_told(capsys, argv, words):
    status, _, err = out(capsys, *argv)
    assert status == 2 and words in err
