"""Linear models for other tools: SciPy, netCDF, MAT."""

import numpy as np
import pytest
import scipy.io
import scipy.signal

from apu_casadi import Apu, SeriesLoad
from apu_casadi.core import results
from apu_casadi.core.errors import DataError
from apu_casadi.unit.linearisation import linearise_gas_generator, linearise_generator
from scenarios import cli
from scenarios.export import linear


@pytest.fixture(scope="module")
def model():
    unit = Apu()
    return linearise_generator(
        unit.generator, unit.generator.steady_state(SeriesLoad.from_power(1e5))
    )


def test_to_scipy(model):
    """Its step response against the model's own, which is by the matrix exponential."""
    system = model.to_scipy()
    assert isinstance(system, scipy.signal.StateSpace)
    t = np.linspace(0.0, 0.2, 201)
    step = np.zeros((t.size, system.inputs))
    step[:, model.u.index("V_ref")] = 0.01
    _, y, _ = scipy.signal.lsim(system, step, t)
    _, ours = model.step_response(t, u={"V_ref": 0.01})
    k = model.y.index("V_t")
    np.testing.assert_allclose(y[:, k], ours[k] - model.y0[k], rtol=1e-6, atol=1e-9)


def test_files(model, tmp_path):
    told = {"load": "100 kW", "altitude": 0.0}
    ds = results.load(linear.save(model, tmp_path / "m.nc", told))
    np.testing.assert_array_equal(ds["A"].values, model.A)
    assert list(ds["x"].values) == list(model.x.names) and ds.attrs["load"] == "100 kW"
    assert list(ds["y_unit"].values) == [s.unit for s in model.y]
    mat = scipy.io.loadmat(linear.save(model, tmp_path / "m.mat", told), simplify_cells=True)
    for name, ours in zip("ABCD", model.matrices, strict=True):
        np.testing.assert_array_equal(mat[name].reshape(ours.shape), ours)
    assert list(mat["u_name"]) == [*model.u.names, *model.theta.names]
    assert list(mat["x_unit"]) == [s.unit for s in model.x] and mat["load"] == "100 kW"
    np.testing.assert_array_equal(mat["y0"], model.y0)
    with pytest.raises(DataError, match=r"m.csv: a linear model is saved as .nc or .mat"):
        linear.save(model, tmp_path / "m.csv", told)


def test_a_model_without_parameters(tmp_path):
    unit = Apu()
    load = SeriesLoad.from_power(1e5, 0.85)  # inductive: no severity
    model = linearise_generator(unit.generator, unit.generator.steady_state(load))
    assert not len(model.theta)
    ds = results.load(linear.save(model, tmp_path / "m.nc", {}))
    np.testing.assert_array_equal(ds["B_u"].values, model.B_u)
    assert "B_theta" not in ds
    assert model.to_scipy().B.shape == model.B_u.shape


def test_command(tmp_path, capsys):
    out = tmp_path / "gas.mat"
    argv = ["linearise", "--model", "gas", "--power", "100", "--no-figures", "--save", str(out)]
    assert cli.main(argv) == 0
    assert str(out) in capsys.readouterr().out
    mat, unit = scipy.io.loadmat(out, simplify_cells=True), Apu()
    point = unit.steady_state(SeriesLoad.from_power(1e5)).gas
    ours = linearise_gas_generator(unit.gas_generator, point)
    np.testing.assert_allclose(mat["A"], ours.A[0, 0], rtol=1e-12)
    assert mat["altitude"] == 0.0 and "100 kW" in mat["load"]
    assert cli.main([*argv[:-1], str(tmp_path / "gas.txt")]) == 2
    assert "saved as .nc or .mat" in capsys.readouterr().err
