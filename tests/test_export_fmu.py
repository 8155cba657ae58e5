"""FMUs: what the description says, the C integrator, and runs equal to ours to 1e-6.

The runs go through a host of the tests' own (``fmi_host``), which needs a C compiler alone; FMPy,
where it is installed, validates the files and runs them by its own solvers.
"""

import dataclasses
import re
import subprocess
import zipfile
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
from fmi_host import Fmu, cosimulate, exchanged
from odd_engine import odd_engine

from apu_casadi import (
    Apu,
    FaultChange,
    HealthChange,
    LoadChange,
    SeriesLoad,
    Ttsc,
    simulate_joint,
)
from apu_casadi.core.backend import find_compiler
from apu_casadi.core.errors import BackendError, DataError, ParameterError
from apu_casadi.gaspath.gasgenerator import GasGeneratorState
from apu_casadi.unit.enginefile import read_unit
from apu_casadi.unit.events import HEALTH_FACTORS, Ambient
from apu_casadi.unit.monolithic import simulate_monolithic
from scenarios import cli
from scenarios.export import ccode, description, fmu
from scenarios.export.cfunctions import Asked
from scenarios.export.collocation import radau
from scenarios.export.fmumodel import DEFAULT_FAULT, MODELS, fmu_model

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
VERSIONS = pytest.mark.parametrize("version", fmu.VERSIONS)
LOAD, LESS = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
LESS_R = dict(zip(("R_a", "R_b", "R_c"), LESS.R, strict=True))


@pytest.fixture(scope="module")
def asked():
    return Asked(Apu(), LOAD, None, Ambient())


@pytest.fixture(scope="module")
def built(asked, tmp_path_factory):
    """FMUs by model and version, each built once."""
    made = {}

    def get(name, version=3):
        if (name, version) not in made:
            path = tmp_path_factory.mktemp("fmu") / f"{name}.fmu"
            made[name, version] = fmu.build(fmu_model(name, asked), path, fmi=version)
        return made[name, version]

    return get


# ------------------------------------------------------------------------------ description


@VERSIONS
@pytest.mark.parametrize("name", MODELS)
def test_description(asked, name, version):
    model = fmu_model(name, asked)
    text, token = description.described(model, version)
    root = Xml.fromstring(text)
    variables = [v for v in root.find("ModelVariables") if v.get("name") != "time"]
    names = [v.get("name") for v in variables]
    assert len(set(names)) == len(names) == len(model.variables)
    assert [int(v.get("valueReference")) for v in variables] == list(range(1, len(names) + 1))
    values = [v if version == 3 else v.find("Real") for v in variables]
    units = {u.get("name") for u in root.find("UnitDefinitions")}
    for v, value, own in zip(variables, values, model.variables, strict=True):
        assert v.get("description") == own.signal.doc
        assert value.get("unit") == own.signal.unit and value.get("unit") in units
        if own.role in ("input", "parameter", "state"):
            assert float(value.get("start")) == own.start
        if own.role in ("parameter", "state"):
            assert v.get("initial") == "exact"
        if own.role == "parameter":
            assert v.get("variability") == "tunable"
        if own.role == "rate":
            assert f"{names[int(value.get('derivative')) - 1]}_dot" == v.get("name")
    shown = {v.get("name") for v in variables if v.get("causality") == "output"}
    assert ("N" if name != "generator" else "V_t") in shown
    assert token in text and description.described(model, version)[1] == token
    tunable = [v.signal.name for v in model.of("parameter")]
    if name != "generator":
        assert tunable[:4] == list(HEALTH_FACTORS)
    if name != "gas_generator":
        prefix = "generator2." if name == "apu" else ""
        inputs = [v.signal.name for v in model.of("input")]
        assert f"{prefix}mu" in tunable and f"{prefix}R_a" in inputs


def test_units_in_base_units():
    powers = description.base_powers
    assert powers("W") == {"kg": 1, "m": 2, "s": -3}
    assert powers("J/(kg K)") == {"m": 2, "s": -2, "K": -1}
    assert powers("kg/s^2") == {"kg": 1, "s": -2}
    assert powers("kg/kg") == powers("1") == {}
    assert powers("ohm") == {"kg": 1, "m": 2, "s": -3, "A": -2}
    assert powers("N m") == powers("J")
    with pytest.raises(DataError, match="unit 'furlong/s': 'furlong' is none"):
        powers("furlong/s")


@pytest.mark.parametrize("stages", [3, 5, 7])
def test_collocation(stages):
    """Against what a Radau IIA method is, and the tabulated three stages (Hairer, Wanner IV.5)."""
    m = radau(stages)
    A = np.linalg.inv(m.inverse)
    c = A.sum(axis=1)
    for k in range(2 * stages - 1):  # weights of order 2 s - 1
        assert m.weights @ c**k == pytest.approx(1 / (k + 1), rel=1e-11)
    again = (m.of * m.values) @ m.to  # pairs are doubled: the real part is all
    np.testing.assert_allclose(again.real, m.inverse, rtol=1e-9, atol=1e-9)
    # the embedded formula is of order s: polynomials up to there have no error
    first = 1 / m.values[0].real
    for k in range(1, stages + 1):
        assert first * (k == 1) + m.error @ c**k == pytest.approx(0, abs=1e-12)
    assert abs(m.error @ c ** (stages + 1)) > 1e-6
    if stages == 3:
        s = np.sqrt(6.0)
        np.testing.assert_allclose(c, [(4 - s) / 10, (4 + s) / 10, 1], rtol=1e-13)
        assert m.values[0].real == pytest.approx(3 + 3 ** (2 / 3) - 3 ** (1 / 3), rel=1e-12)


@pytest.mark.long
@needs_compiler
@VERSIONS
@pytest.mark.parametrize("name", MODELS)
def test_own_sources_have_no_warning(asked, name, version, tmp_path):
    model = fmu_model(name, asked)
    texts = fmu.sources(model, version, "token")
    for n, t in texts.items():
        (tmp_path / n).write_text(t)
    own = [n for n in description.source_names(model, version) if n != "model.c"]
    line = [*find_compiler(), *ccode.FLAGS, "-fsyntax-only", *own]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    included = set(re.findall(r"#include <(\w+)\.h>", "\n".join(texts.values())))
    assert included <= {"math", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string"}


def test_sources_alone_and_the_same_file_twice(asked, tmp_path):
    model = fmu_model("generator", asked)
    one, two = (fmu.build(model, tmp_path / n, library=False) for n in ("a.fmu", "b.fmu"))
    assert one.read_bytes() == two.read_bytes()
    with zipfile.ZipFile(one) as archive:
        names = set(archive.namelist())
        build = Xml.fromstring(archive.read("sources/buildDescription.xml"))
    assert not [n for n in names if n.startswith("binaries")]
    listed = {f"sources/{f.get('name')}" for f in build.iter("SourceFile")}
    assert listed == {n for n in names if n.endswith(".c")}


def test_refusals(asked, tmp_path, monkeypatch):
    with pytest.raises(ParameterError, match=r"no model 'generater' to export.*'generator'"):
        fmu_model("generater", asked)
    model = fmu_model("generator", asked)
    with pytest.raises(ParameterError, match="FMI version 1: one of 3, 2"):
        fmu.build(model, tmp_path / "x.fmu", fmi=1)
    monkeypatch.setattr(fmu, "find_compiler", lambda: None)
    with pytest.raises(BackendError, match="no C compiler found for the FMU's library"):
        fmu.build(model, tmp_path / "x.fmu")
    assert not (tmp_path / "x.fmu").exists()


def test_command(tmp_path, capsys):
    out = tmp_path / "g.fmu"
    argv = ["export", "fmu", "generator", "--load", "90e3", "--no-library", "--out", str(out)]
    fault = 'kind = "field", mu_f = 0.1'
    assert cli.main([*argv, "--fault", fault]) == 0
    told = capsys.readouterr().out
    assert "FMI 3.0" in told and "1 parameters: mu_f" in told and str(out) in told
    assert cli.main(["export", "fmu", "apuu"]) == 2
    assert cli.main([*argv, "--fmi", "4"]) == 2
    assert "FMI version 4: one of 3, 2" in capsys.readouterr().err


# ------------------------------------------------------------------------------ generator


def close(values, names, ds, rows=slice(None), tol=1e-6):
    """Compare with a dataset relative to the largest value of each."""
    for n, row in zip(names, values, strict=True):
        ours = np.asarray(ds[n].values)[rows]
        assert np.abs(row - ours).max() <= tol * np.abs(ours).max(), n


GENERATOR = ["v_a", "i_a", "i_b", "T_e", "P_total", "V_t", "i_fd", "P_loss_fault", "lam_sq", "E_fd"]
SWITCHES = [(0.02, LESS_R), (0.04, {"mu": 0.05, "k_rf": 20.0}), (0.07, {"mu": 0.0})]
#: At a switch ours tell the values after it, an FMU those before.
BETWEEN = [k for k in range(101) if k not in (20, 40, 70)]


@pytest.fixture(scope="module")
def generator_run(asked):
    w_r = asked.unit.w_r(asked.unit.N_ref)
    switches = [(0.02, LESS), (0.04, Ttsc(0.05, 20.0)), (0.07, None)]
    how = {"dt_out": 1e-3, "rtol": 1e-10, "atol": 1e-12}
    return asked.unit.generator.simulate(LOAD, 0.1, switches=switches, w_r=w_r, **how)


@pytest.mark.long
@needs_compiler
def test_generator_by_cosimulation(built, generator_run, tmp_path):
    names = GENERATOR
    t, v = cosimulate(
        built("generator"), tmp_path, t_end=0.1, names=names, dt=1e-3, changes=SWITCHES
    )
    np.testing.assert_allclose(t, generator_run["time"].values, atol=1e-12)
    close(v[:, BETWEEN], names, generator_run, BETWEEN, 1e-7)


@pytest.mark.long
@needs_compiler
def test_generator_by_model_exchange(built, generator_run, tmp_path):
    how = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-10, "changes": SWITCHES}
    t = generator_run["time"].values[BETWEEN]
    v = exchanged(built("generator"), tmp_path, instants=t, names=GENERATOR, **how)
    close(v, GENERATOR, generator_run, BETWEEN)


@needs_compiler
@pytest.mark.ci
@pytest.mark.parametrize(
    ("load", "fault"),
    [
        (SeriesLoad.from_power(100e3, 0.85), Ttsc(0.05, 20.0)),  # i_fault is a state
        (SeriesLoad(R=(1.5, 1.6, 1.7)), Ttsc(0.1, 1.0, 1.0, "c")),
    ],
)
def test_generator_with_a_fault_from_the_start(asked, load, fault, tmp_path):
    mine = Asked(asked.unit, load, fault, asked.ambient)
    path = fmu.build(fmu_model("generator", mine), tmp_path / "g.fmu")
    names = ["v_a", "i_a", "i_fault", "P_total", "T_e"]
    _, v = cosimulate(path, tmp_path, t_end=0.05, names=names, dt=1e-3)
    switches = [(0.0, load), (0.0, fault)]
    how = {"dt_out": 1e-3, "rtol": 1e-10, "atol": 1e-12, "w_r": asked.unit.w_r(asked.unit.N_ref)}
    ds = asked.unit.generator.simulate(load.balanced_part, 0.05, switches=switches, **how)
    close(v[:, 1:], names, ds, slice(1, None), 1e-7)


@needs_compiler
def test_a_load_dump_is_integrated(built, asked, tmp_path):
    """1e6 ohm: what settles within nanoseconds, which no explicit method steps over."""
    start = {f"R_{k}": 1e6 for k in "abc"}
    names = ["v_a", "V_t", "E_fd", "i_fd"]
    _, v = cosimulate(built("generator"), tmp_path, t_end=0.1, names=names, changes=[(0.02, start)])
    w_r = asked.unit.w_r(asked.unit.N_ref)
    switches = [(0.02, SeriesLoad(R=(1e6,) * 3))]
    ds = asked.unit.generator.simulate(LOAD, 0.1, switches=switches, w_r=w_r, dt_out=0.02)
    close(v[:, 2:], names, ds, slice(2, None), 1e-5)


@needs_compiler
def test_what_cannot_be_is_told(built, tmp_path):
    path = built("generator")
    with pytest.raises(RuntimeError, match="a value is out of its range"):
        Fmu(path, tmp_path).put({"R_a": -1.0})
    with pytest.raises(RuntimeError, match="a value is not finite"):
        Fmu(path, tmp_path).put({"w_r": np.nan})
    one = Fmu(path, tmp_path)
    one.start({})
    with pytest.raises(RuntimeError, match="before the start only"):
        one.put({"lam_sq": 0.0})
    with pytest.raises(RuntimeError, match="cannot be set"):
        one.put({"v_a": 0.0})
    stranger = Fmu(path, tmp_path, token="{another}")
    assert stranger.one is None and "of another model description" in stranger.said[-1]


@needs_compiler
@pytest.mark.ci
def test_a_fault_begins_anew_whatever_is_read_before(asked, tmp_path):
    """Model exchange: outputs read between the change and event mode leave the reset undone."""
    mine = Asked(asked.unit, SeriesLoad.from_power(100e3, 0.85), None, asked.ambient)
    path = fmu.build(fmu_model("generator", mine), tmp_path / "g.fmu")
    one = Fmu(path, tmp_path, exchange=True)
    one.start({})
    one.put({"mu": 0.05})
    one.update()
    states = one.vector("GetContinuousStates")
    at = [n for n in one.names if n != "time"].index("i_fault") - one.at["lam_sq"] + 1
    assert states[at] == 0.0
    states[at] = 100.0
    one.vector("SetContinuousStates", states)
    assert one.take(["i_fault"]) == [100.0]
    for mu, after in ((0.0, 0.0), (0.05, 0.0)):
        one.put({"mu": mu})
        one.take(["P_total"])  # computed with the new parameter, before event mode
        one.update()
        assert one.vector("GetContinuousStates")[at] == after
        states[at] = 50.0
        one.vector("SetContinuousStates", states)


@needs_compiler
def test_state_is_kept_and_restored(built, tmp_path):
    import ctypes

    one = Fmu(built("generator"), tmp_path)
    one.start({})
    one.put({"mu": 0.05})
    one.step(0.0, 0.01)
    kept = ctypes.c_void_p()
    one.call("GetFMUState", ctypes.byref(kept))
    one.step(0.01, 0.01)
    first = one.take(GENERATOR)
    one.call("SetFMUState", kept)
    one.step(0.01, 0.01)
    assert one.take(GENERATOR) == first
    one.call("FreeFMUState", ctypes.byref(kept))


# ------------------------------------------------------------------------------ gas generator


@needs_compiler
@pytest.mark.ci
@VERSIONS
def test_gas_generator_by_cosimulation(built, asked, tmp_path, version):
    """Steps of eq. (12), to the last digits: load step, health step, fuel step."""
    gg, at = asked.unit.gas_generator, asked.gas
    u, theta = np.repeat(at.u[:, None], 100, 1), np.repeat(at.theta[:, None], 100, 1)
    u[1, 25:] *= 0.8
    theta[0, 50:] = 0.98
    u[0, 60:] *= 0.97
    x, y = gg.run(GasGeneratorState(at.x, at.z, at.u, at.theta), u, theta)
    names = ["N", "T4", "P3", "SM", "W2"]
    changes = [(0.5, {"PW": u[1, -1]}), (1.0, {"f_eta_c": 0.98}), (1.2, {"Wf": u[0, -1]})]
    path = built("gas_generator", version)
    _, v = cosimulate(path, tmp_path, t_end=2.0, names=names, changes=changes)
    ours = [x[0], *(y[gg.Y.index(n)] for n in names[1:])]
    np.testing.assert_allclose(v, ours, rtol=1e-12)


@needs_compiler
@pytest.mark.ci
def test_gas_generator_by_model_exchange(built, asked, tmp_path):
    from apu_casadi.core.simulation import simulate

    gg, at = asked.unit.gas_generator, asked.gas
    names, t = ["N", "T4", "P3", "SM"], np.arange(26) * 0.02
    u, start = np.array(at.u), {"f_W_c": 0.97}
    theta = gg.THETA.pack(start)
    ds = simulate(gg.state_space, at.x, t, u, theta=theta, rtol=1e-10, atol=1e-12)
    how = {"start": start, "rtol": 1e-9, "atol": 1e-9}
    v = exchanged(built("gas_generator"), tmp_path, instants=t, names=names, **how)
    close(v, names, ds)


# ------------------------------------------------------------------------------ the unit

JOINT = ["N", "T4", "PW", "Wf", "SM", "P_total"]
WAVES = ["v_a", "i_a", "i_b", "T_e"]
MEANS = ["P_e", "P_loss_fault"]
EVENTS = [
    LoadChange(0.2, LESS),
    HealthChange(0.4, {"f_eta_c": 0.98}),
    FaultChange(0.61, DEFAULT_FAULT),
    FaultChange(1.0, None),
]


def of_each(values, which=(1, 2)):
    """Values by name for generators of these numbers."""
    return {f"generator{k}.{n}": v for k in which for n, v in values.items()}


CHANGES = [
    (0.2, of_each(LESS_R)),
    (0.4, {"f_eta_c": 0.98}),
    (0.61, of_each({"mu": 0.05})),
    (1.0, of_each({"mu": 0.0})),
]


def compared(path, folder, ds, changes, dt=0.1):
    """Compare the FMU's co-simulation with a joint run, generator by generator."""
    n = ds.sizes.get("generator", 1)
    own = [f"generator{k}.{q}" for k in range(1, n + 1) for q in (*MEANS, *WAVES)]
    t, v = cosimulate(path, folder, t_end=1.2, names=[*JOINT, *own], changes=changes, dt=dt)
    at = [int(np.abs(ds["time"].values - i).argmin()) for i in t]
    at_w = [int(np.abs(ds["time_w"].values - i).argmin()) for i in t]
    close(v[: len(JOINT)], JOINT, ds, at)
    rows = v[len(JOINT) :].reshape(n, -1, t.size)
    for k in range(n):
        one = ds.isel(generator=k) if "generator" in ds.dims else ds
        close(rows[k][: len(MEANS)], MEANS, one, at)
        close(rows[k][len(MEANS) :, 1:], WAVES, one, at_w[1:])


@needs_compiler
@pytest.mark.ci
@VERSIONS
def test_unit_by_cosimulation(built, asked, tmp_path, version):
    """The paper's exchange inside: load step, health step, fault, and its end."""
    how = {"solver": "cvodes", "rtol": 1e-10, "atol": 1e-12, "waveform_dt": 1e-3}
    ds = simulate_joint(asked.unit, duration=1.2, load=LOAD, events=EVENTS, **how)
    compared(built("apu", version), tmp_path, ds, CHANGES)


def own_engine():
    """A unit that nobody ships: other gas-path numbers, maps, machine, gear and governor."""
    moved = {"machine.r_s": 0.006, "coupling.gear": 3.1, "governor.Kp": 0.4}
    return dataclasses.replace(Apu(), gas_generator=odd_engine()).change(moved)


@needs_compiler
@pytest.mark.ci
@pytest.mark.parametrize("name", ["tpe331", "aps5000", "own"])
def test_other_units_by_cosimulation(name, tmp_path):
    """Load step, health step, fault and its end, as of the default unit."""
    unit = own_engine() if name == "own" else read_unit(name).unit
    rated = unit.generator.machine.P_rated
    load, less = (SeriesLoad.from_power(k * rated) for k in (0.9, 0.45))
    path = fmu.build(fmu_model("apu", Asked(unit, load, None, Ambient())), tmp_path / "u.fmu")
    events = [LoadChange(0.2, less), *EVENTS[1:]]
    of_less = of_each(dict(zip(("R_a", "R_b", "R_c"), less.R, strict=True)))
    how = {"solver": "cvodes", "rtol": 1e-10, "atol": 1e-12, "waveform_dt": 1e-3}
    ds = simulate_joint(unit, duration=1.2, load=load, events=events, **how)
    compared(path, tmp_path, ds, [(0.2, of_less), *CHANGES[1:]])


@needs_compiler
@pytest.mark.ci
def test_different_generators(asked, tmp_path):
    """Another machine with another gear and load beside the first; a fault in it alone."""
    unit = asked.unit.change({"generator2.machine.r_s": 0.006, "generator2.coupling.gear": 3.1})
    loads = [LOAD, SeriesLoad.from_power(100e3, 0.85)]
    mine = Asked(unit, loads, None, asked.ambient)
    path = fmu.build(fmu_model("apu", mine), tmp_path / "two.fmu")
    events = [LoadChange(0.2, LESS, generator=1), FaultChange(0.61, DEFAULT_FAULT, generator=2)]
    changes = [(0.2, of_each(LESS_R, [1])), (0.61, of_each({"mu": 0.05}, [2]))]
    how = {"solver": "cvodes", "rtol": 1e-10, "atol": 1e-12, "waveform_dt": 1e-3}
    ds = simulate_joint(unit, duration=1.2, load=loads, events=events, **how)
    compared(path, tmp_path, ds, changes)


@needs_compiler
@pytest.mark.ci
def test_unit_by_model_exchange(built, asked, tmp_path):
    """Nothing exchanged: the one model of the whole unit."""
    ds = simulate_monolithic(
        asked.unit, duration=0.08, load=LOAD, events=[LoadChange(0.02, LESS)], rtol=1e-10
    )
    names, t = ["N", "T4", "Wf", "SM"], ds["time"].values
    how = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-10, "first_step": 1e-6, "max_step": 1e-4}
    how["changes"] = [(0.02, of_each(LESS_R))]
    v = exchanged(built("apu"), tmp_path, instants=t, names=names, **how)
    close(v, names, ds)


# ------------------------------------------------------------------------------ FMPy


@needs_compiler
@pytest.mark.ci
@VERSIONS
@pytest.mark.parametrize("name", MODELS)
def test_fmpy_validates_and_runs(built, name, version):
    fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: extra 'fmu'")
    from fmpy.validation import validate_fmu

    path = str(built(name, version))
    assert validate_fmu(path) == []
    for kind in ("CoSimulation", "ModelExchange"):
        found = fmpy.simulate_fmu(path, fmi_type=kind, stop_time=0.04, output_interval=0.02)
        output = "T4" if name != "generator" else "V_t"
        assert found[output][-1] == pytest.approx(found[output][0], rel=1e-6)


@needs_compiler
@pytest.mark.ci
@VERSIONS
@pytest.mark.parametrize(
    ("event", "values"),
    [
        (LoadChange(0.0, LESS), of_each(LESS_R)),
        (HealthChange(0.0, {"f_eta_c": 0.98}), {"f_eta_c": 0.98}),
        (FaultChange(0.0, DEFAULT_FAULT), of_each({"mu": 0.05})),
    ],
)
def test_fmpy_s_runs_equal_ours(built, asked, event, values, version):
    """Load step, health step and fault of the whole unit, from its first instant on."""
    fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: extra 'fmu'")
    how = {"stop_time": 0.4, "output_interval": 0.02, "fmi_type": "CoSimulation"}
    found = fmpy.simulate_fmu(str(built("apu", version)), start_values=values, **how)
    how = {"solver": "cvodes", "rtol": 1e-10, "atol": 1e-12, "waveform_dt": None}
    ds = simulate_joint(asked.unit, duration=0.4, load=LOAD, events=[event], **how)
    later = slice(1, None)  # of the first instant itself ours tell what was before
    close([found[n][later] for n in JOINT], JOINT, ds, later)
