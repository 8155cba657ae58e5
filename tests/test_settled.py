"""The whole unit in a settled state: trims with a fault, runs that start there, power by torque."""

import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import (
    ApuWarning,
    OperatingPointError,
    ParameterError,
    ScenarioError,
    SignalError,
)
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.openphase import OpenPhase
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import MachineParameters, SaturatedMachine
from apu_casadi.unit.apu import Apu, trim
from apu_casadi.unit.averaged import generator_vectors
from apu_casadi.unit.events import Ambient, FaultChange, LoadChange
from apu_casadi.unit.linearisation import linearise_joint
from apu_casadi.unit.multirate import simulate_joint
from scenarios import registry
from scenarios.cli import main
from scenarios.schema import Scenario
from scenarios.studies.jointrun import truth

APU = Apu()
KW100, KW225 = SeriesLoad.from_power(100e3), SeriesLoad.from_power(225e3)
UNEVEN = SeriesLoad.from_power(100e3, 0.9, unbalance=(1.3, 1.0, 0.7))
FAULT = Ttsc(0.05, 20.0, phase="b")
SHORT = SeriesLoad(R=(0.01,) * 3)
TORQUE = APU.change({"generator.power": "torque"})


def run(apu=APU, **how):
    return simulate_joint(apu, **{"duration": 0.6, "waveform_dt": None, **how})


@pytest.mark.long
@pytest.mark.parametrize("solver", ["auto", "cvodes"])
@pytest.mark.parametrize(
    ("load", "fault"), [(UNEVEN, None), (KW100, FAULT), (UNEVEN, {2: FAULT})],
    ids=["load", "fault", "second only"],
)  # fmt: skip
def test_nothing_moves_after_a_settled_start(load, fault, solver):
    """Speed, fuel, rms values, components and powers stay as they are at the first instant."""
    ds = run(load=load, fault=fault, solver=solver, start_from="settled", phasors=True)
    for n in ("N", "Wf", "V_a_rms", "I_c_rms", "V_2", "I_0", "P_e", "P_loss_fault", "V_b_re"):
        values = np.atleast_2d(ds[n].transpose(..., "time").values)
        assert_allclose(values, np.repeat(values[:, :1], values.shape[1], axis=1), rtol=2e-5)
    mu = np.atleast_2d(ds["mu"].transpose(..., "time").values)
    assert set(mu[-1]) == {0.05 if fault else 0.0}  # from the first instant on
    assert json.loads(ds.attrs["warnings"]) == []


@pytest.mark.long
def test_it_is_where_a_run_from_the_balanced_start_ends():
    """After 6 s; the governor is the slowest."""
    late = run(duration=6.0, load=UNEVEN, fault=FAULT)
    ds = run(duration=0.02, load=UNEVEN, fault=FAULT, start_from="settled")
    for n in ("N", "Wf", "V_a_rms", "V_c_rms", "I_b_rms", "V_2", "P_e", "P_total"):
        assert float(ds[n][-1]) == pytest.approx(float(late[n][-1]), rel=1e-4)


@pytest.mark.long
def test_events_go_on_from_there():
    events = [FaultChange(0.2, None), LoadChange(0.4, KW225)]
    ds = run(load=UNEVEN, fault=FAULT, events=events, start_from="settled")
    t = ds["time"].values
    assert set(ds["mu"].values[t < 0.21]) == {0.05}
    assert set(ds["mu"].values[t > 0.21]) == {0.0}
    assert float(ds["P_e"][-1]) == pytest.approx(225e3, rel=0.02)


def test_a_trim_of_the_unit_with_faults():
    """Shaft power is the mean (8) of each generator; off the design point, and one machine only."""
    day = Ambient(altitude=8000.0, Mach=0.7)
    both = trim(APU, load=KW100, fault=FAULT, ambient=day)
    one = trim(APU, load=KW100, fault={2: FAULT}, ambient=day)
    none = trim(APU, load=KW100, ambient=day)
    assert both.gas["PW"] == pytest.approx(both.generator.mean("P_total"), rel=1e-9)
    assert one.of(1).y["P_total"] == pytest.approx(none.generator.y["P_total"], rel=1e-12)
    half = (both.gas["PW"] + none.gas["PW"]) / 2
    assert one.gas["PW"] == pytest.approx(half, rel=1e-9)
    with pytest.raises(ScenarioError, match="generator 3, but the unit has 1 to 2"):
        trim(APU, load=KW100, fault={3: FAULT})


@pytest.mark.long
def test_in_scenarios_and_commands(tmp_path, capsys):
    text = """
    name = "settled"
    duration = 0.1
    waveform_dt = 0
    start_from = "settled"
    [[phase]]
    name = "all"
    start = 0.0
    load = { kind = "open_phase", power_kW = 90, phase = "c" }
    """
    s = Scenario.from_toml_text(text)
    assert Scenario.from_dict(s.to_dict()) == s
    ds = registry.run(s)
    assert float(ds["I_c_rms"][0]) < 0.05
    assert np.ptp(ds["N"].values) < 1e-4
    with pytest.raises(ScenarioError, match=r"start_from: unknown 'setled'.*'settled'"):
        s.change(start_from="setled")
    with pytest.raises(ScenarioError, match=r"start_from 'x'"):
        run(load=KW100, start_from="x")
    file = tmp_path / "s.toml"
    file.write_text(text.replace('start_from = "settled"', ""))
    out = ["--out", str(tmp_path), "--json", "--no-figures"]
    assert main(["run", str(file), "--start-from", "settled", *out]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["phases"][0]["I_c_rms"] < 0.05

    keys = ["--fault", 'mu = 0.05, k_rf = 20, phase = "b"', "--json"]
    assert main(["trim", "--load", "100e3", *keys]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["generator"]["I_2_over_I_1"] > 0.01
    assert report["fault"]["phase"] == "b"
    assert main(["trim", "--load", "100e3", "--field-voltage", "45", *keys[:2]]) == 0
    text = capsys.readouterr().out
    assert "V_2_over_V_1" in text and "fault of each: Ttsc" in text
    assert main(["trim", "--power", "1e5", *keys[:2]]) == 2
    assert "--fault is that of a generator and needs --load" in capsys.readouterr().err
    assert main(["trim", "--load", "1e5", "--fault", "mu = 0.05"]) == 2
    assert "k_rf: missing" in capsys.readouterr().err


def test_trim_takes_the_fault_of_one_generator(capsys):
    keys = ["--load", "100e3", "--fault", "generator = 2, mu = 0.05, k_rf = 20"]
    assert main(["trim", *keys, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    both = trim(APU, load=KW100, fault=FAULT).gas["PW"] + trim(APU, load=KW100).gas["PW"]
    assert report["outputs"]["PW"] == pytest.approx(both / 2, rel=1e-9)
    healthy, faulty = report["generators"]
    assert healthy["P_loss_fault"] == 0.0 < faulty["P_loss_fault"]
    for more, fault, words in (
        (["--voltage", "230"], keys[3], "leave out generator"),
        ([], "generator = 3, mu = 0.05, k_rf = 20", "the unit has 1 to 2"),
        ([], "generator = 5, mu = 0.05, k_rf = 20", "--fault.generator: the number"),
    ):
        assert main(["trim", *keys[:3], fault, *more]) == 2
        assert words in capsys.readouterr().err


# -- power by torque --------------------------------------------------------------------------


def test_torque_and_paper_agree_at_the_rated_point():
    """The stated fixed loss is made for that."""
    a, b = (trim(apu, load=KW225).generator for apu in (APU, TORQUE))
    assert b.y["P_total"] == pytest.approx(a.y["P_total"], rel=1e-9)
    g = TORQUE.generator
    assert 20e3 < g.P_fixed < 30e3
    assert a.y["P_e"] / (b.y["P_total"] / 2) == pytest.approx(g.machine.eta_sg, rel=1e-9)
    assert a.ss.name == "generator_resistive_healthy"
    assert b.ss.name == "generator_resistive_healthy_torque"


@pytest.mark.long
@pytest.mark.parametrize(
    ("load", "fault"),
    [(KW100, None), (UNEVEN, FAULT), (SHORT, None),
     (KW225, Ttsc(0.3, 0.5)), (OpenPhase(KW100), None)],
)  # fmt: skip
def test_energy_book_of_the_shaft(load, fault):
    """Shaft and field give output, losses of machine and fault, and the fixed one: 1e-8."""
    g, p = TORQUE.generator, TORQUE.generator.machine
    share = 0.99
    how = {"V_fd": 50.0} if load == SHORT else {}
    point = g.steady_state(load, fault, w_r=share * p.w_rated, **how)
    t = point.turn
    heat = p.r_s * sum(t.rms(f"i_{k}") ** 2 for k in "abc")
    windings = ((p.r_fd, "i_fd"), (p.r_kd, "i_kd"), (p.r_kq, "i_kq"))
    heat += 1.5 * sum(r * t.rms(i) ** 2 for r, i in windings)
    field = 1.5 * (t["V_fd"] * t["i_fd"]).mean()
    spent = t.mean("P_e") + t.mean("P_loss_fault") + heat - field + share * g.P_fixed
    assert t.mean("P_total") / 2 == pytest.approx(spent, abs=1e-8 * p.P_rated)


def test_near_a_terminal_short_the_shaft_feels_the_torque():
    """Eq. (8) tells 1 kW where the torque takes tens; the run by torque has no such warning."""
    short = SeriesLoad(R=(1e-3,) * 3)
    events = [LoadChange(0.1, short)]
    how = {"load": KW100, "events": events, "duration": 0.3, "solver": "cvodes"}
    with pytest.warns(ApuWarning, match=r"eq. \(8\) gives too little"):
        paper = run(**how)
    torque = run(TORQUE, **how)
    assert json.loads(torque.attrs["warnings"]) == []
    assert float(torque["P_total"][-1]) > float(paper["P_total"][-1]) + 30e3


@pytest.mark.slow  # what is exact is compiled anew for it
def test_all_solvers_follow_the_torque():
    ways = [run(TORQUE, load=KW225, events=[FaultChange(0.1, FAULT)], solver=s, exchange=e)
            for s, e in (("auto", "paper"), ("cvodes", "paper"))]  # fmt: skip
    assert_allclose(ways[0]["P_total"], ways[1]["P_total"], rtol=2e-5)
    assert_allclose(ways[0]["N"], ways[1]["N"], rtol=1e-6)


# -- parameters by name -----------------------------------------------------------------------


def test_choices_and_saturation_by_name():
    unit = APU.change(
        {"generator.excitation": "constant", "machine.S_10": 0.1, "machine.S_12": 0.4}
    )
    g = unit.generator
    assert g.excitation == "constant"
    assert g.machine == SaturatedMachine(S_10=0.1, S_12=0.4)
    assert unit.parameters()["machine.S_10"] == 0.1
    assert unit.change({"machine.S_10": 0}).generator.machine == MachineParameters()
    assert unit.change({"machine.r_s": 0.005}).generator.machine.S_12 == 0.4
    second = APU.change({"generator2.machine.S_10": 0.1, "generator2.power": "torque"})
    assert second.generators[0] == Generator()
    assert isinstance(second.generators[1].machine, SaturatedMachine)
    own = second.parameters()
    assert own["generator2.power"] == "torque"
    assert own["generator2.machine.S_10"] == 0.1
    back = second.change({"generator2.machine.S_10": 0, "generator2.power": "paper"})
    assert back == APU
    for wrong, words in (
        ({"machine.S_12": 0.3}, "needs machine.S_10"),
        ({"generator.power": "tork"}, r"power 'tork'.*'torque'"),
        ({"machine.S_11": 1.0}, "unknown parameter"),
    ):
        with pytest.raises(ParameterError, match=words):
            APU.change(wrong)


def test_a_saturated_unit_runs_by_cvodes():
    """``auto`` asks what is exact first, which refuses; fuel and field are those of its trim."""
    unit = APU.change({"machine.S_10": 0.1, "machine.S_12": 0.4})
    ds = run(unit, load=KW225, duration=0.1)
    status = json.loads(ds.attrs["solver"])
    assert status["steps_propagated"] == 0 and status["nsteps_generator"] > 0
    point = unit.steady_state(KW225)
    assert float(ds["Wf"][-1]) == pytest.approx(point.gas["Wf"], rel=1e-6)
    assert point.generator.y["i_fd"] > APU.steady_state(KW225).generator.y["i_fd"] * 1.02


def test_refusal_tells_why():
    with pytest.raises(OperatingPointError, match="no regulated steady state"):
        APU.steady_state(SeriesLoad.from_power(3e6))
    assert not math.isnan(APU.steady_state(KW100).gas["Wf"])


def test_what_needs_a_balanced_or_another_machine_says_so():
    """The averaged model of a faulty point; the joint estimation with another power, saturation."""
    with pytest.raises(SignalError, match=r"without a fault"):
        generator_vectors(APU.generator, APU.generator.steady_state(KW100, FAULT))
    saturated = APU.change({"machine.S_10": 0.1, "machine.S_12": 0.4})
    for unit in (saturated, TORQUE):
        model = linearise_joint(unit, unit.steady_state(KW100))
        assert np.abs(model.xdot0).max() < 1e-5 * np.abs(model.x0).max()
    quiet = registry.get("quiet")
    with pytest.raises(ScenarioError, match=r"generator\.power must be 'paper'"):
        truth(quiet.change(parameters={"generator.power": "torque"}))
    with pytest.raises(ParameterError, match="the joint estimation needs the linear machine"):
        truth(quiet.change(parameters={"machine.S_10": 0.1}))
