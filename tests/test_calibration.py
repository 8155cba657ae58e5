"""Calibration: the defaults made again, exact sensitivities, and what the points cannot tell."""

import dataclasses
import json

import numpy as np
import pytest

from apu_casadi.core.errors import DataError, OperatingPointError, ParameterError, SignalError
from apu_casadi.gaspath import calibration
from apu_casadi.gaspath.calibration import (
    CalibrationPoint,
    calibrate,
    numbers,
    read_points,
    sensitivity,
    write_points,
)
from apu_casadi.gaspath.gasgenerator import (
    COMPRESSOR_CALIBRATION,
    TURBINE_CALIBRATION,
    GasGenerator,
)
from scenarios.cli import main
from scenarios.commands import calibrate as command


@pytest.fixture(scope="module")
def defaults():
    return calibrate(command.uncalibrated(GasGenerator()), command.published_points(), command.FREE)


@pytest.fixture(scope="module")
def gg():
    return GasGenerator()


def bench(gg, *, n_points=3, sigma=1e-3, outputs=("W2", "T3", "P3", "T5", "SM")):
    """Return points as this engine would measure them, without noise."""
    points = []
    for k, PW in enumerate(np.linspace(4.5e5, 2.5e5, n_points)):
        p = CalibrationPoint(
            {"N": 3700.0 + 40 * k, "PW": float(PW)},
            {n: (1.0, 1.0) for n in outputs},
            ambient={"altitude": 2500.0 * k, "Mach": 0.2 * k, "dT_isa": 5.0 - 10 * k},
            health={"f_W_t": 1.01},
            name=f"bench {k}",
        )
        t = p.trim(gg)
        measured = {n: (t[n], sigma * abs(t[n])) for n in outputs}
        points.append(dataclasses.replace(p, measured=measured))
    return points


@pytest.mark.long
def test_defaults_are_made_again(defaults):
    """The numbers in the code are those that `apu calibrate` finds, to all digits printed there."""
    code = {"compressor_map": COMPRESSOR_CALIBRATION, "turbine_map": TURBINE_CALIBRATION}
    for name, value in defaults.values.items():
        s, _, f = name.partition(".")
        printed = getattr(code[s], f)
        assert value == pytest.approx(printed, abs=6e-9), (
            f"{name}: the code says {printed!r}, the calibration {value:.8f}: print that there"
        )
    assert set(numbers()) >= set(defaults.names)


def test_defaults_meet_the_rows_they_were_fitted_to(defaults):
    """Six numbers, six rows of Tables 4 and 5: no error is left.

    1e-6 standard deviations: where the iteration stops.
    """
    assert defaults.freedom == 0
    worst = max(defaults.residuals, key=lambda r: abs(r.error))
    assert abs(worst.error) < 1e-6, f"{worst.point} {worst.name}: {worst.error:.1e} sigma"
    rows = [(r.point, r.name) for r in defaults.residuals]
    assert rows == [("Table 4", "SM"), *(("Table 5", n) for n in ("W2", "T3", "P3", "T5", "SM"))]
    assert defaults.condition < calibration.WEAK
    assert defaults.weak == () and defaults.at_bound == ()


def test_sensitivities_are_exact(gg):
    """Against central differences over rebuilt engines, for every number and output.

    Tolerance 1e-6 of each output's size per unit: difference error, step 1e-4 in exponents.
    """
    point = bench(gg, n_points=2)[1]
    t = point.trim(gg)
    ours = sensitivity(gg, t, tuple(point.fixed))
    fields = [f"{s}.{f}" for s in calibration.SETS for f in calibration._FIELDS]
    keep = [i for i, s in enumerate(gg.Y) if s.name not in ("residual", "off_c", "off_t")]
    size = np.abs(t.y) + gg.Y.nominals * 1e-3
    # c_N is 0, its bound: it is checked where it may be moved both ways
    base = calibration._with(gg, {"compressor_map.c_N": 0.5, "turbine_map.c_N": 0.5})
    tb = point.trim(base)
    ours_b = sensitivity(base, tb, tuple(point.fixed))
    for name, j in ((n, fields.index(n)) for n in numbers()):
        where, exact = (base, ours_b) if name.endswith("c_N") else (gg, ours)
        if name in ("compressor_map.c_PR", "turbine_map.n_Re"):
            continue  # at their bound, 0, in the defaults; alike in the other map
        h = 1e-4
        now = calibration._current(where, [name])[0]
        plus, minus = (point.trim(calibration._with(where, {name: now + s * h})).y for s in (1, -1))
        difference = (plus - minus) / (2 * h)
        off = np.abs(difference - exact[:, j])[keep] / size[keep]
        worst = gg.Y.names[keep[int(off.argmax())]]
        assert off.max() < 1e-6, f"d {worst}/d {name} is off by {off.max():.1e}"
    assert np.allclose(ours[[gg.Y.index("N"), gg.Y.index("PW")]], 0, atol=1e-6), "these are held"


def test_numbers_come_back_from_their_own_points(gg):
    """An engine with known numbers, measured at three bench points, is found again.

    1e-7: no noise, so only the stop of the iteration is left.
    """
    wanted = {"compressor_map.a_W": 0.1, "compressor_map.n_Re": 0.12, "turbine_map.c_PR": 0.5}
    truth = calibration._with(gg, wanted)
    found = calibrate(gg, bench(truth), tuple(wanted))
    for name, value in wanted.items():
        assert found.values[name] == pytest.approx(value, abs=1e-7), name
    assert found.freedom == 15 - 3
    assert found.engine.compressor_map.calibration.n_Re == found.values["compressor_map.n_Re"]


def test_covariance_tells_the_scatter(gg):
    """Numbers fitted to noisy points scatter as the covariance says.

    One Gauss-Newton step from the truth stands for each fit; the mean squared normalised error of
    400 draws of 2 numbers lies within 2 +- 0.4, four standard errors of a chi-square mean.
    """
    names = ("compressor_map.n_Re", "turbine_map.c_PR")
    points = bench(gg, n_points=2)
    fit = calibrate(gg, points, names)
    fields = [f"{s}.{f}" for s in calibration.SETS for f in calibration._FIELDS]
    rows, sigma = [], []
    for p in points:
        S = sensitivity(gg, p.trim(gg), tuple(p.fixed))
        rows += [S[gg.Y.index(n), [fields.index(m) for m in names]] for n in p.measured]
        sigma += [s for _, s in p.measured.values()]
    J, sigma = np.array(rows), np.array(sigma)
    noise = sigma[:, None] * np.random.default_rng(1).standard_normal((sigma.size, 400))
    error = np.linalg.lstsq(J / sigma[:, None], noise / sigma[:, None], rcond=None)[0]
    nees = np.einsum("in,ij,jn->n", error, np.linalg.inv(fit.covariance), error).mean()
    assert nees == pytest.approx(2.0, abs=0.4)
    assert fit.std[names[0]] == pytest.approx(np.sqrt(fit.covariance[0, 0]))


def test_combinations_that_do_not_show_are_named(gg):
    """Reynolds and speed droop cannot be told apart at one point; the message says which."""
    point = bench(gg, outputs=("W2", "T3"))[2]
    with pytest.raises(ParameterError, match=r"do not determine.*compressor_map\.(c_N|n_Re)"):
        calibrate(gg, [point], ("compressor_map.n_Re", "compressor_map.c_N"))
    with pytest.raises(ParameterError, match=r"no measurement depends on compressor_map\.k_SM"):
        calibrate(gg, [point], ("compressor_map.k_SM",))
    # nearly the same signature: found, and reported as weak
    J = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-4], [0.5, 0.5]])
    covariance, condition, weak = calibration._determined(J, ["a", "b"])
    assert condition > calibration.WEAK and len(weak) == 1
    assert "a" in weak[0] and "b" in weak[0]
    assert np.allclose(covariance, np.linalg.inv(J.T @ J), rtol=1e-5)


def test_points_file(gg, tmp_path):
    """What is written is read back; comments and blank lines do not count."""
    points = bench(gg, n_points=2)
    write_points(points, tmp_path / "p.csv")
    assert read_points(tmp_path / "p.csv") == points
    text = (tmp_path / "p.csv").read_text()
    (tmp_path / "q.csv").write_text("# of a test bench\n\n" + text)
    assert read_points(tmp_path / "q.csv") == points


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "p.csv: empty"),
        ("point,role,name,value\na,fixed,N,1\n", "first line must be point,role,name,value,sigma"),
        ("point,role,name,value,sigma\n", "no points"),
        ("point,role,name,value,sigma\na,fixt,N,1,", "line 2: role 'fixt' .did you mean 'fixed'"),
        (
            "point,role,name,value,sigma\na,fixed,N,x,",
            "line 2, column value: 'x' is no number",
        ),
        ("point,role,name,value,sigma\na,measured,T3,500,", "line 2: T3: a standard deviation"),
        ("point,role,name,value,sigma\n# c\na,fixed,N,1,\na,fixed,N,2,", "line 4: N: given twice"),
        (
            "point,role,name,value,sigma\na,fixed,N,1,,9",
            "line 2: 6 cells, but 5 columns are",
        ),
    ],
)
def test_bad_files_are_refused_by_line(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        read_points(tmp_path / "p.csv")


def test_failures_name_what_is_wrong(gg, tmp_path):
    """Unknown names, too few measurements and impossible points."""
    fixed, measured = {"N": 3775.0, "PW": 4e5}, {"T3": (568.0, 0.5)}
    with pytest.raises(SignalError, match="measured 't3' is unknown"):
        CalibrationPoint(fixed, {"t3": (1.0, 1.0)})
    with pytest.raises(SignalError, match="holds two quantities, got 1"):
        CalibrationPoint({"N": 1.0}, measured)
    with pytest.raises(SignalError, match="both held and measured"):
        CalibrationPoint(fixed, {"N": (3775.0, 1.0)})
    with pytest.raises(SignalError, match="with standard deviation 0"):
        CalibrationPoint(fixed, {"T3": (568.0, 0.0)})
    point = CalibrationPoint(fixed, measured, name="cell 3")
    with pytest.raises(ParameterError, match=r"did you mean 'compressor_map\.n_Re'"):
        calibrate(gg, [point], ("compressor_map.nRe",))
    with pytest.raises(ParameterError, match="1 measurements cannot determine 2"):
        calibrate(gg, [point], ("compressor_map.n_Re", "compressor_map.a_W"))
    hopeless = CalibrationPoint({"N": 3775.0, "PW": 4e6}, measured, name="cell 4")
    with pytest.raises(OperatingPointError, match="cell 4: no steady point"):
        calibrate(gg, [hopeless], ("compressor_map.n_Re",))
    with pytest.raises(DataError, match="cannot be read"):
        read_points(tmp_path / "absent.csv")


def test_command_with_a_file(gg, tmp_path, capsys):
    """`apu calibrate FILE --json` fits users' points; the value in the code stands beside it."""
    write_points(bench(gg, n_points=2), tmp_path / "p.csv")
    assert (
        main(["calibrate", str(tmp_path / "p.csv"), "--free", "compressor_map.n_Re", "--json"]) == 0
    )
    report = json.loads(capsys.readouterr().out)
    (row,) = report["numbers"]
    assert row["value"] == pytest.approx(row["in_code"], abs=1e-7)
    assert report["degrees_of_freedom"] == 9


def test_text_of_the_command(defaults):
    """The printed table names each number and each row fitted."""
    text = command.text(defaults, command.in_use(GasGenerator(), defaults.names))
    for name in defaults.names:
        assert f"{name} " in text
    assert "0 degrees of freedom" in text and "Table 5" in text
