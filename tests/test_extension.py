"""A part of one's own is one file: no module of the package changes for it.

``extension_parts.py`` is a user's file with a load, a fault, a sensor, a governor and a filter
step, written against public names; the engine is a TOML file.  Here each of them is used from
Python, from a scenario and on the command line; in a joint run, in the linearisation and in an
estimator.
"""

import ast
import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi import Apu, FaultChange, HealthChange, SeriesLoad, simulate_joint
from apu_casadi.core.errors import SignalError
from apu_casadi.core.results import load
from apu_casadi.gaspath.engines import read_engine
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.faults.fieldshort import FieldShort
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.capacitor import CapacitorLoad
from apu_casadi.unit.linearisation import linearise, linearise_joint
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.identify import gas_path
from estimators.apu.joint import estimate_joint
from estimators.apu.recordings.recorded import read_table
from estimators.apu.sensors import GAS_PATH, gas_path_table
from estimators.detection.signatures import linearised
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.filtering import FilterStep, run
from estimators.models.filtermodel import Unknown, augment, discretise, measure
from estimators.models.recording import record
from scenarios.cli import main

PARTS = Path(__file__).with_name("extension_parts.py")
KW = SeriesLoad.from_power(150e3)
LOAD = 'kind = "my_RC", R = 1.0, C = 2e-3'
ENGINE = """
[gas_generator]
W2 = 2.5
PR_c = 7.0
[compressor_map]
shipped = "axi5"
N_map_des = 1.0
beta_des = 2.0
[turbine_map]
shipped = "lpt2269"
N_map_des = 100.0
beta_des = 0.5
"""
SCENARIO = """
name = "mine"
title = "A load, a fault and a governor of my own"
duration = 0.2
governor = "my_PID"
extensions = ["PARTS"]
[[phase]]
name = "capacitors"
start = 0.0
load = { kind = "my_RC", R = 1.0, C = 2e-3 }
[[phase]]
name = "field"
start = 0.1
fault = { kind = "my_field", m = 0.1 }
[parameters]
governor.Kd = 0.02
"""


@pytest.fixture(scope="module")
def ds(mine):
    """A joint run whose compressor gets worse at 0.5 s."""
    events = [HealthChange(0.5, {"f_eta_c": 0.98})]
    return simulate_joint(Apu(), duration=1.0, load=KW, waveform_dt=1e-4, events=events)


@pytest.fixture
def folder(tmp_path, mine, monkeypatch):
    """A user's folder: parts, engine, scenario."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "engine.toml").write_text(ENGINE)
    (tmp_path / "mine.toml").write_text(SCENARIO.replace("PARTS", str(PARTS)))
    return tmp_path


def test_each_part_is_less_than_fifty_lines():
    """Definitions and what registers them; the imports are shared."""
    text = PARTS.read_text()
    marks = [i for i, line in enumerate(text.splitlines()) if line.startswith("# -- (")]
    ends = [*marks[1:], len(text.splitlines())]
    assert len(marks) == 5 and all(b - a < 50 for a, b in zip(marks, ends, strict=True))
    imported = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.ImportFrom)]
    assert not [a.name for n in imported for a in n.names if a.name.startswith("_")]


@pytest.mark.long
def test_a_load_in_run_linearisation_and_estimator(mine):
    """The same numbers as the shipped R-C load; its states are in the linear model."""
    own, shipped = mine["MyCapacitors"](1.0, 2e-3), CapacitorLoad((1.0,) * 3, (2e-3,) * 3)
    how = {"duration": 0.2, "waveform_dt": 1e-4}
    a, b = (simulate_joint(Apu(), load=x, **how) for x in (own, shipped))
    for name in ("N", "P_e", "V_a_rms", "I_a_rms", "T4"):
        assert_allclose(a[name], b[name], rtol=1e-6, err_msg=name)
    solver = json.loads(a.attrs["solver"])
    assert solver["steps_propagated"] == 10  # linear: no integrator was needed
    model = linearise_joint(Apu(), Apu().steady_state(own))
    same = linearise_joint(Apu(), Apu().steady_state(shipped))
    assert {"u_q", "u_d"} < set(model.x.names)
    slow = [max(m.eigenvalues(), key=lambda e: e.value.real).value for m in (model, same)]
    assert slow[0] == pytest.approx(slow[1], rel=1e-6)
    found = estimate_joint(a, 1)
    assert abs(found["f_eta_c"].values[-1] - 1) < 0.05


@pytest.mark.long
def test_a_fault_in_run_linearisation_and_estimator(mine):
    """As the shipped field fault; the filter finds the fraction of shorted turns."""
    own = mine["MyFieldShort"](0.1)
    events = {n: [FaultChange(0.1, f)] for n, f in (("own", own), ("shipped", FieldShort(0.1)))}
    a, b = (simulate_joint(Apu(), duration=0.3, load=KW, events=e) for e in events.values())
    assert_allclose(a["i_fd"], b["i_fd"], rtol=1e-9)
    assert a["m"].values[-1] == 0.1
    gen = Generator()
    ss, point = gen.variant(KW, own), gen.steady_state(KW)
    u, theta = gen.inputs(KW, V_ref=point.V_ref), gen.fault_vector(KW, own)
    by_m = linearise(ss, point.x, u, theta).derivative("i_fd", "m")
    h = 1e-6
    i_fd = [float(ss.g(point.x, u, [0.1 + d])[ss.y.index("i_fd")]) for d in (h, -h)]
    expected = (i_fd[0] - i_fd[1]) / (2 * h)
    assert by_m == pytest.approx(expected, rel=1e-6)


@pytest.mark.long
def test_a_fault_is_found_by_a_filter(mine):
    """m as an unknown of the extended Kalman filter on the generator's own equations."""
    gen, own = Generator(), mine["MyFieldShort"](0.1)
    ss, point = gen.variant(KW, own), gen.steady_state(KW)
    u = gen.inputs(KW, V_ref=point.V_ref)
    dt, K = 2e-5, 4000
    x, y = point.x.copy(), np.empty((2, K))
    rows = ss.y.indices(["i_a", "i_fd"])
    model = measure(discretise(ss), ["i_a", "i_fd"])
    for k in range(K):
        y[:, k] = np.asarray(ss.g(x, u, [0.1])).ravel()[rows]
        x1, _ = model.transition(x, u, [0.1], [], dt)
        x = np.asarray(x1).ravel()
    model = augment(model, {"m": Unknown()})
    mean = {**ss.x.unpack(point.x), "m": 0.01}
    prior = Belief.of(model.x, mean, dict.fromkeys(mean, 1e-6) | {"m": 0.1})
    t = np.arange(K) * dt
    readings = {"i_a": (t, y[0]), "i_fd": (t, y[1])}
    sigma, inputs = dict.fromkeys(readings, 1.0), ss.u.unpack(u)
    data = record(model, outputs=readings, sigma=sigma, inputs=inputs)
    found = extended_kalman_filter(model, prior, data)
    mean, sigma = found["m"]
    assert abs(mean[-1] - 0.1) < 4 * sigma[-1] < 0.02


@pytest.mark.long
def test_sensors_in_filter_and_joint_estimation(ds, mine, tmp_path):
    """The lag is a state; they narrow what is known of the compressor; files have their columns."""
    own = ("T41_mine", "dP_mine")
    table = gas_path_table()
    assert table.outputs == (*GAS_PATH.outputs, *own)
    filt = gas_path_filter(sensors=table)
    assert filt.model.x.names[-1] == "T41_mine"
    assert {"gain_dP_mine", "gain_T41_mine"} < set(filt.model.x.names)
    data = filt.recording(ds, None)
    i = filt.model.y.index("dP_mine")
    assert data.y[i, 3] == pytest.approx(float((ds["P3"] - ds["P5"])[3]), rel=1e-12)
    with_it, without = (estimate_joint(ds, 1, **o) for o in ({"gas_sensors": table}, {}))
    assert with_it["f_eta_c_sigma"][-1] < without["f_eta_c_sigma"][-1]
    # at a steady point the lag is over
    g = gas_path(sensors=GAS_PATH.add(*own[::-1]))
    assert g.only(["N", "dP_mine"]).sensors == ("N", "dP_mine")
    (tmp_path / "run.csv").write_text("time,T41_mine [degC],dP_mine\n0,900,7e5\n1,905,7.1e5\n")
    table = read_table(tmp_path / "run.csv")
    assert table.get("T41_mine", "K") == pytest.approx([1173.15, 1178.15])


@pytest.mark.long
def test_an_engine_in_run_linearisation_and_estimator(folder):
    """Another size and another pressure ratio, from one file."""
    gg = read_engine("engine.toml")
    unit, load_ = Apu(gas_generator=gg), SeriesLoad.from_power(100e3)
    ds = simulate_joint(unit, duration=0.2, load=load_, waveform_dt=1e-4)
    assert float(ds["W2"][0]) < 0.9 * float(
        simulate_joint(Apu(), duration=0.02, load=load_, waveform_dt=None)["W2"][0]
    )
    assert all(
        e.value.real < 0 for e in linearise_joint(unit, unit.steady_state(load_)).eigenvalues()
    )
    found = estimate_joint(ds, 1, apu=unit)
    assert abs(found["f_eta_c"].values[-1] - 1) < 0.05


def test_a_governor_in_run_linearisation_and_estimator(mine):
    """Its state is in the linear model, its word in a unit's parameters."""
    unit = Apu(governor=mine["MyGovernor"]()).change({"governor.Kd": 0.02})
    assert unit == Apu(governor=mine["MyGovernor"](Kd=0.02))
    events = [HealthChange(0.1, {"f_eta_c": 0.98})]
    ds = simulate_joint(unit, duration=0.5, load=KW, events=events, waveform_dt=None)
    assert abs(float(ds["N"][-1]) / unit.N_ref - 1) < 0.01
    assert "e_slow" in linearise_joint(unit, unit.steady_state(KW)).x.names
    filt = gas_path_filter(governed=unit.governor)
    assert np.isfinite(filt.run(filt.recording(ds, 1)).mean).all()


@pytest.mark.long
def test_a_filter_step_in_run_and_joint_estimation(ds, mine):
    """A steady gain, found by the package's filter, serves almost as well as that."""
    filt = gas_path_filter(gains=False)
    data = filt.recording(ds, 1)
    usual = filt.run(data)
    H, S = linearised(filt.model, usual, data).H[-1], usual.innovation_cov[-1]
    own = mine["constant_gain"](usual.cov_pred[-1] @ H.T @ np.linalg.inv(S), S)
    r = run(own(filt.model), filt.prior(), data)
    assert np.allclose(r.mean, filt.run(data, step=own, full=False).mean)
    k = int(0.45 / 0.02)  # before the fault
    assert abs(r["N"][0][k] - float(ds["N"][k])) < 3 * usual["N"][1][0]
    e = estimate_joint(ds, 1, gain_errors=False, eta=0.0, speed=False, step=own)
    assert np.isfinite(e["f_eta_c"]).all()
    assert e["N"].values[k] == pytest.approx(float(ds["N"][k]), rel=0.01)


def test_a_filter_step_of_other_sizes_is_refused():
    """With what is expected, and what was got."""
    model = gas_path_filter(gains=False, inertia=None).model
    f = ca.Function("mine", [ca.MX.sym("m", 2)], [ca.MX(1)])
    with pytest.raises(SignalError, match="step mine of gas_path_measured: inputs m"):
        FilterStep(model, f)


# -- from files and on the command line -----------------------------------------------------------


def test_a_scenario_names_load_fault_and_governor(folder, capsys):
    """``extensions`` in the file, the engine beside it; the run's file tells all of them."""
    argv = ["run", "mine.toml", "--engine", "engine.toml", "--out", "out", "--no-figures", "--json"]
    assert main(argv) == 0
    ds = load(folder / "out" / "mine.nc")
    assert ds["m"].values[-1] == 0.1 and ds["W2"][0] < 2.6
    told = json.loads(ds.attrs["parameters"])
    assert (told["governor.kind"], told["governor.Kd"]) == ("my_PID", 0.02)
    assert json.loads(ds.attrs["loads"])[0]["R"] == 1.0
    capsys.readouterr()


@pytest.mark.long
@pytest.mark.parametrize(
    "argv",
    [
        ["trim", "--load", LOAD, "--engine", "engine.toml"],
        ["linearise", "--governor", "my_PID", "--no-figures", "--load", LOAD],
        ["identify", "--sensors", "N,P3,Wf,T41_mine", "--trials", "0"],
        ["estimate", "joint", "--scenario", "mine.toml", "--no-figures", "--quiet", "--out", "e"],
    ],
    ids=lambda argv: argv[0],
)
def test_commands_take_the_parts(folder, argv, capsys):
    """``--with`` names the file where the command needs a part of it."""
    assert main([*argv, "--with", str(PARTS), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)


@pytest.mark.long
def test_sensors_in_commands(folder, capsys):
    """``apu fit`` reads their columns and a sigma; ``apu identify`` takes them by name."""
    gg = GasGenerator()
    points = [trim_gas_generator(gg, {"N": gg.parameters.N, "PW": P}) for P in (2e5, 3e5, 4e5)]
    names = ("N", "P3", "T3", "T5", "Wf", "PW")
    rows = [[p[n] for n in names] + [p["T41"] - 273.15, p["P3"] - p["P5"]] for p in points]
    head = ",".join((*names, "T41_mine [degC]", "dP_mine"))
    text = "\n".join([head, *(",".join(f"{v:.9g}" for v in row) for row in rows)])
    (folder / "points.csv").write_text(text + "\n")
    argv = ["fit", "points.csv", "--steady", "--json", "--sigma", "dP_mine=1kPa"]
    assert main([*argv, "--with", str(PARTS)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {"T41_mine", "dP_mine"} <= set(json.dumps(report).replace('"', " ").split())
    given = ["--with", str(PARTS), "--sensors", "N,dP_mine,Wf,T41_mine"]
    assert main(["identify", *given, "--json", "--trials", "0"]) == 0
    assert "T41_mine" in capsys.readouterr().out


def test_a_mistake_in_a_part_is_told_with_its_place(folder, capsys):
    """A key that is none of the load's, as for a shipped load."""
    text = SCENARIO.replace("R = 1.0", "Rr = 1.0").replace("PARTS", str(PARTS))
    (folder / "mine.toml").write_text(text)
    assert main(["run", "mine.toml"]) != 0
    assert "phase[1].load.Rr: unknown key (did you mean 'R'?)" in capsys.readouterr().err


def test_the_drill_of_an_engine_is_no_code():
    """An engine of the file is one of the package."""
    assert GasGenerator().family == GasGenerator(dt=0.01).family
