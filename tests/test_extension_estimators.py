"""A sensor and a filter step of one's own, from a user's file: no module of the package changes."""

import json

import casadi as ca
import numpy as np
import pytest

from apu_casadi import Apu, HealthChange, SeriesLoad, simulate_joint
from apu_casadi.core.errors import SignalError
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.identify import gas_path
from estimators.apu.joint import estimate_joint
from estimators.apu.recordings.recorded import read_table
from estimators.apu.sensors import GAS_PATH, gas_path_table, unregister
from estimators.detection.signatures import linearised
from estimators.filters.filtering import STEP_IN, STEP_OUT, FilterStep, run
from estimators.filters.stepparts import step_symbols
from scenarios import extensions
from scenarios.cli import main

# ------------------------------------------------------------------ a user's files, as they stand

SENSORS = '''
"""Two sensors of my engine: a thermocouple with a lag, and a differential pressure."""
from estimators.apu.sensors import Sensor, register

register(Sensor("T41_slow", 0.005, True, 0.005, "K", "my thermocouple", (400.0, 1900.0),
                reads=("T41",), tau=0.8))


def difference(P3, P5):
    return P3 - P5


register(Sensor("dP", 0.005, True, 0.005, "Pa", "my transducer", (1e4, 2e6),
                reads=("P3", "P5"), value=difference))
'''


def constant_gain(K, S):
    """Make the maker of a step whose gain, as found once, does not change: m + K (y - g(m))."""

    def step(model):
        m, P, u, p, y, R, dt = s = step_symbols(model, ca.MX)
        w = ca.MX.zeros(len(model.w))
        h, check = model.output(m, u, p, w)
        nu = ca.if_else(R >= 0, y - h, 0)
        m_f = m + ca.DM(K) @ nu
        m1, c = model.transition(m_f, u, p, w, dt)
        nis = nu.T @ ca.DM(np.linalg.inv(S)) @ nu
        measured = ca.sum1(R >= 0)
        logdet = np.linalg.slogdet(2 * np.pi * S)[1]
        stats = ca.vertcat(check + c, nis, -0.5 * (nis + logdet), measured)
        out = m1, P, m_f, P, P, nu, ca.DM(S), stats
        f = ca.Function(
            f"constant_{model.name}", s, [ca.densify(o) for o in out], STEP_IN, STEP_OUT
        )
        return FilterStep(model, f)

    return step


# ------------------------------------------------------------------------------ what they do


@pytest.fixture(scope="module")
def ds():
    return simulate_joint(
        Apu(),
        duration=1.0,
        load=SeriesLoad.from_power(150e3),
        waveform_dt=1e-4,
        events=[HealthChange(t=0.5, factors={"f_eta_c": 0.98})],
    )


@pytest.fixture
def mine(tmp_path):
    path = tmp_path / "my_sensors.py"
    path.write_text(SENSORS)
    extensions.load([path])
    names = ("T41_slow", "dP")
    yield names
    for name in names:
        unregister(name)


def test_a_sensor_of_ones_own(ds, mine, tmp_path):
    """Registered by one line, it is in filter, joint estimation, identifiability and files."""
    table = gas_path_table()
    assert table.outputs == (*GAS_PATH.outputs, *mine)
    filt = gas_path_filter(sensors=table)
    assert filt.model.x.names[-1] == "T41_slow"
    assert {"gain_dP", "gain_T41_slow"} < set(filt.model.x.names)
    data = filt.recording(ds, None)
    i = filt.model.y.index("dP")
    assert data.y[i, 3] == pytest.approx(float((ds["P3"] - ds["P5"])[3]), rel=1e-12)
    both = estimate_joint(ds, 1, gas_sensors=table)
    assert both["f_eta_c_sigma"][-1] < estimate_joint(ds, 1)["f_eta_c_sigma"][-1]
    # at a steady point the lag is over
    g = gas_path(sensors=GAS_PATH.add("dP", "T41_slow"))
    assert g.only(["N", "dP"]).sensors == ("N", "dP")
    (tmp_path / "run.csv").write_text("time,T41_slow [degC],dP\n0,900,7e5\n1,905,7.1e5\n")
    table = read_table(tmp_path / "run.csv")
    assert table.get("T41_slow", "K") == pytest.approx([1173.15, 1178.15])


def test_a_sensor_of_ones_own_in_commands(mine, tmp_path, capsys):
    """``apu fit`` reads its column and its sigma; ``apu identify`` takes it by name."""
    gg = GasGenerator()
    points = [trim_gas_generator(gg, {"N": gg.parameters.N, "PW": P}) for P in (2e5, 3e5, 4e5)]
    names = ("N", "P3", "T3", "T5", "Wf", "PW")
    rows = [[p[n] for n in names] + [p["T41"] - 273.15, p["P3"] - p["P5"]] for p in points]
    head = ",".join((*names, "T41_slow [degC]", "dP"))
    text = "\n".join([head, *(",".join(f"{v:.9g}" for v in row) for row in rows)])
    (tmp_path / "points.csv").write_text(text + "\n")
    argv = ["fit", str(tmp_path / "points.csv"), "--steady", "--json", "--sigma", "dP=1kPa"]
    argv += ["--with", str(tmp_path / "my_sensors.py")]
    assert main(argv) == 0
    report = json.loads(capsys.readouterr().out)
    assert {"T41_slow", "dP"} <= set(json.dumps(report).replace('"', " ").split())
    given = ["--with", str(tmp_path / "my_sensors.py"), "--sensors", "N,dP,Wf,T41_slow"]
    assert main(["identify", *given, "--json", "--trials", "0"]) == 0
    assert "T41_slow" in capsys.readouterr().out


def test_a_filter_step_of_ones_own(ds):
    """A steady-state gain, found by the package's filter, serves almost as well as that."""
    filt = gas_path_filter(gains=False)
    data = filt.recording(ds, 1)
    usual = filt.run(data)
    lin, S = linearised(filt.model, usual, data), usual.innovation_cov[-1]
    own = constant_gain(usual.cov_pred[-1] @ lin.H[-1].T @ np.linalg.inv(S), S)
    r = run(own(filt.model), filt.prior(), data)
    assert np.allclose(r.mean, filt.run(data, step=own, full=False).mean)
    k = int(0.45 / 0.02)
    assert abs(r["N"][0][k] - float(ds["N"][k])) < 3 * usual["N"][1][0]
    e = estimate_joint(ds, 1, gain_errors=False, eta=0.0, speed=False, step=own)
    assert np.isfinite(e["f_eta_c"]).all()
    assert e["N"].values[k] == pytest.approx(float(ds["N"][k]), rel=0.01)


def test_a_step_of_other_sizes_is_refused():
    """With what is expected, and what was got."""
    model = gas_path_filter(gains=False, inertia=None).model
    f = ca.Function("mine", [ca.MX.sym("m", 2)], [ca.MX(1)])
    with pytest.raises(SignalError, match="step mine of gas_path_measured: inputs m"):
        FilterStep(model, f)
