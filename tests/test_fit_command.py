"""``apu fit``: from a file to estimates with intervals; what it says, and how it refuses.

Truth comes from the trim solver and CVODES, noise from the sensors' table.
"""

import json

import numpy as np
import pytest

from apu_casadi.core.errors import DataError, ParameterError, SignalError
from apu_casadi.gaspath.designdata import RPM
from estimators.apu import fitting
from estimators.apu.sensors import GAS_PATH
from scenarios.cli import main
from scenarios.commands.fit import verdict
from scenarios.figures.fitplot import plot_fit

TRUTH = np.array([0.98, 0.99, 1.0, 0.985])
HEADER = "N [rpm],P3 [kPa],T3 [K],EGT_in [degC],Wf [kg/h],PW [kW],dT_isa [K],remark"


def lines(data, gaps=()):
    r = data.readings
    columns = [
        r["N"] / RPM, r["P3"] / 1e3, r["T3"], r["T5"] - 273.15, r["Wf"] * 3600, r["PW"] / 1e3,
        np.full(data.t.size, 5.0),
    ]  # fmt: skip
    rows = [[f"{c[k]:.9g}" for c in columns] for k in range(data.t.size)]
    for k, i in gaps:
        rows[k][i] = ""
    return [",".join([*row, ""]) for row in rows]


@pytest.fixture(scope="module")
def steady(tmp_path_factory):
    """Five noisy points, each the mean of 25 readings; one T3 and one fuel flow missing."""
    gg = fitting._engine()
    data = fitting.noisy(
        fitting.steady_truth(gg, TRUTH), np.random.default_rng(5), averaged=fitting.READINGS
    )
    path = tmp_path_factory.mktemp("fit") / "steady.csv"
    text = "\n".join([HEADER, *lines(data, [(3, 2), (2, 4)])]) + "\n"
    path.write_text(text, encoding="utf-8")
    return path


def out(capsys, *argv):
    """Run the command; return status, standard output and standard error."""
    status = main(["fit", *map(str, argv)])
    got = capsys.readouterr()
    return status, got.out, got.err


COMMON = ("--column", "T5=EGT_in", "--readings", "25")


@pytest.mark.long
def test_steady_points(capsys, steady, tmp_path):
    """The truth lies in the intervals; profile and standard error agree; the figure is drawn."""
    figure = tmp_path / "sub" / "fit.png"
    status, text, err = out(capsys, steady, *COMMON, "--figure", figure)
    assert status == 0, err
    assert "5 steady points" in text and "the model fits within the stated noise" in text
    assert "columns not used: remark" in text and "compressor efficiency" in text
    assert figure.stat().st_size > 20_000
    status, text, _ = out(capsys, steady, *COMMON, "--profile", "--json")
    report = json.loads(text)
    assert status == 0 and report["mode"] == "steady"
    for row, truth in zip(report["parameters"], TRUTH, strict=True):
        assert abs(row["estimate"] - truth) < 4 * row["standard_error"]
        width = row["high"] - row["low"]
        # nearly linear: the profile is the interval within a hundredth
        assert abs(row["profile_low"] - row["low"]) < 0.01 * width
        assert abs(row["profile_high"] - row["high"]) < 0.01 * width
    # 4 outputs at 5 points less one gap, less 4 factors; the missing input is no reading either
    assert report["degrees_of_freedom"] == 19 - 4 - 1
    assert report["misfit"]["Wf"]["readings"] == 4 and report["misfit"]["T3"]["readings"] == 4


@pytest.mark.long
def test_two_transients_with_a_bias_each(capsys, tmp_path):
    """Two load steps, CVODES: common health, T5 sensor with another bias in each run."""
    gg = fitting._engine()
    truth = fitting.transient_truth(gg, TRUTH, K=40)
    paths = []
    for k, shift in enumerate((8.0, -6.0)):
        data = fitting.noisy(truth, np.random.default_rng(k))
        data.readings["T5"][:] += shift
        rows = lines(data, [(7, 0), (8, 0), (20, 5)])
        text = ["time [ms]," + HEADER, *(f"{20 * i}," + r for i, r in enumerate(rows))]
        paths.append(tmp_path / f"run{k}.csv")
        paths[-1].write_text("\n".join(text), encoding="utf-8")
    status, text, err = out(capsys, *paths, "--column", "T5=EGT_in", "--own", "bias_T5", "--json")
    assert status == 0, err
    report = json.loads(text)
    rows = {r["name"]: r for r in report["parameters"]}
    assert report["mode"] == "transient" and report["samples"] == [40, 40]
    for name, value in (*zip(fitting.HEALTH, TRUTH, strict=True),
                        ("bias_T5[0]", 8.0), ("bias_T5[1]", -6.0)):  # fmt: skip
        assert abs(rows[name]["estimate"] - value) < 4 * rows[name]["standard_error"], name
    assert rows["bias_T5[0]"]["meaning"] == "bias of the T5 sensor"
    # biases and turbine hang together: without the load step they could not be told apart at all
    assert report["p_value"] > 1e-4


def test_a_ridge_is_told(capsys, steady):
    """With an unknown gain of P3, flow factors and gain go together; told in words."""
    status, text, _ = out(capsys, steady, *COMMON, "--estimate", "f_W_c,f_W_t,gain_T5,gain_P3",
                          "--fix", "f_eta_c=0.98", "--consider", "gain_T3=0.005")  # fmt: skip
    assert status == 0
    assert "ridge: " in text and "are told apart poorly" in text
    assert "gain of the P3 sensor" in text
    assert "intervals include the uncertainty of gain_T3" in text


def test_what_is_open_is_said(capsys, steady, tmp_path):
    """Without shaft power a ridge; with T3 alone nothing but words, no number."""
    rows = [x.split(",") for x in steady.read_text(encoding="utf-8").splitlines()]
    path = tmp_path / "no_power.csv"
    path.write_text("\n".join(",".join([*r[:5], *r[6:]]) for r in rows), encoding="utf-8")
    status, text, _ = out(capsys, path, *COMMON)
    assert status == 0
    assert "not measured, and left open: PW" in text and "ridge: turbine efficiency" in text
    path.write_text("T3,PW\n560,2e5\n562,3e5\n", encoding="utf-8")
    status, text, _ = out(capsys, path)
    assert status == 0
    assert "undetermined: " in text and "cannot be told apart" in text
    assert "fewer readings than unknowns" in text and "open to open" in text
    status, text, _ = out(capsys, path, "--json")
    assert [r["estimate"] for r in json.loads(text)["parameters"]] == [None] * 4


@pytest.mark.long
def test_options_change_the_answer(capsys, steady):
    """A prior narrows, a considered gain widens, a wrong sigma shows in chi-squared."""

    def run(*argv):
        status, text, err = out(capsys, steady, *COMMON, "--json", *argv)
        assert status == 0, err
        report = json.loads(text)
        return {r["name"]: r["standard_error"] for r in report["parameters"]}, report

    plain, _ = run()
    prior, _ = run("--prior", "f_W_c=0.99:0.001")
    assert prior["f_W_c"] < 0.7 * plain["f_W_c"]
    wide, report = run("--consider", "gain_T3=0.005")
    assert wide["f_eta_c"] > 1.5 * plain["f_eta_c"] and list(report["considered"]) == ["gain_T3"]
    _, report = run("--sigma", "T3=0.01%", "--sigma", "T5=0.2K")
    assert report["p_value"] < 1e-3 and "does not fit" in report["verdict"]
    _, report = run("--sigma", "T3=50 K", "--sigma", "P3=100kPa", "--sigma", "T5=10%")
    assert "sigmas are too large" in report["verdict"] or report["p_value"] > 0.5


def test_the_figure_refuses_what_does_not_fit():
    """Nothing to draw, or arrays of another length than the instants."""
    with pytest.raises(SignalError, match="wrong: none given"):
        plot_fit(np.arange(3.0), {}, {}, steady=True, heading="x")
    with pytest.raises(SignalError, match="series of 3 values expected; wrong: T3"):
        plot_fit(np.arange(3.0), {"T3": (np.ones(2),) * 3}, {"T3": "K"}, steady=True, heading="x")


def test_verdicts():
    """Said by probability; nothing is said of a fit without freedom."""
    assert "cannot be judged" in verdict(0.0, 0, float("nan"))
    assert "fewer readings" in verdict(0.0, -1, float("nan"))
    assert "does not fit" in verdict(100.0, 10, 1e-9)
    assert "too large" in verdict(0.1, 10, 0.99999)
    assert verdict(10.0, 10, 0.4) == "the model fits within the stated noise"


@pytest.mark.long
@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (("--estimate", "f_eta_x"), "cannot fit 'f_eta_x' (did you mean 'f_eta_"),
        (("--estimate", "gain_T4"), "cannot fit 'gain_T4'"),
        (("--column", "T33=EGT_in"), "unknown quantity (did you mean 'T3'"),
        (("--column", "T3=EGT"), "no column 'EGT' for T3"),
        (("--column", "P3=EGT_in"), "a unit of Pa is expected, 'degC' measures K"),
        (("--sigma", "T33=2K"), "unknown output (did you mean 'T3'"),
        (("--sigma", "T3=2"), "a unit is needed"),
        (("--sigma", "T3=2bar"), "a unit of K is expected"),
        (("--sigma", "T3=-1K"), "must be > 0"),
        (("--sigma", "T3"), "NAME=VALUE is expected"),
        (("--prior", "f_W_c=1"), "NAME=MEAN:SIGMA is expected"),
        (("--prior", "f_W_c=1:x"), "'x' is no number"),
        (("--consider", "f_W_c=0.1"), "estimated, own or considered at once"),
        (("--fix", "f_W_c=1"), "both fixed and fitted: f_W_c"),
        (("--readings", "0"), "--readings must be >= 1"),
        (("--time", "clok"), "no column 'clok'"),
        (("--figure", "fit.doc"), ".png, .pdf or .svg is expected"),
    ],
)
def test_refusals(capsys, steady, argv, words):
    """Status 2 and one line that says what is wrong."""
    status, _, err = out(capsys, steady, *argv)
    assert status == 2
    assert words in err


def test_files_without_what_is_needed(capsys, tmp_path):
    """No measured output, no file, holes in time, one file with time and one without."""
    path = tmp_path / "a.csv"
    path.write_text("T33,foo\n1,2\n", encoding="utf-8")
    status, _, err = out(capsys, path)
    assert (
        status == 2 and "none of the columns T33, foo is a measured output (N, P3, T3, T5)" in err
    )
    status, _, err = out(capsys, tmp_path / "none.csv")
    assert status == 2 and "no such file" in err
    path.write_text("time,T3\n0,560\n0.02,560\n3,561\n", encoding="utf-8")
    status, _, err = out(capsys, path)
    assert status == 2 and "2.98 s without a row after t = 0.02 s" in err
    other = tmp_path / "b.csv"
    other.write_text("T3\n560\n", encoding="utf-8")
    status, _, err = out(capsys, path, other)
    assert status == 2 and "some files have a time column and some not" in err


def test_readings_as_the_model_takes_them():
    """Weights follow the level, not the noise; gaps in ambient conditions are refused."""
    gg = fitting._engine()
    lifted = fitting.engine_model(gg, ("T3",))
    t = np.arange(50) * 0.02
    noise = 0.05 * np.random.default_rng(0).standard_normal(50)
    data = fitting.EngineData("x", t, {"T3": 560 * (1 + noise)}, {"dT_isa": 5.0})
    rec = fitting.to_recording(gg, lifted, data)
    level = np.sqrt(rec.variance[0]) / GAS_PATH["T3"].noise
    assert np.std(level / 560) < 0.02
    # neither input was read: both are open
    for name in fitting.INPUTS:
        assert not fitting._read(lifted, rec, name).any()
    holes = fitting.EngineData("x", t, data.readings, {"dT_isa": np.where(t < 0.1, np.nan, 5.0)})
    with pytest.raises(DataError, match="x: dT_isa has gaps"):
        fitting.to_recording(gg, lifted, holes)
    with pytest.raises(DataError, match="none of T3 is measured"):
        fitting.to_recording(gg, lifted, fitting.EngineData("x", t, {}))


@pytest.mark.long
def test_coverage_study_in_small():
    """Thirty steady fits: each factor's intervals hold the truth most of the time."""
    result = fitting.coverage(30, seed0=1, kind="steady")
    assert result["failed"] == 0 and result["freedom"] == 16
    for row in result["rows"]:
        assert row["low"] < row["covered"] <= row["high"]
        assert row["covered"] >= 0.8  # 30 of 95 %: below 24 once in 10 000
    with pytest.raises(ParameterError, match="did you mean 'transient'"):
        fitting.coverage(1, kind="transients")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["steady", "transient", "steady, gains considered"])
def test_coverage(kind):
    """Goal: 95 % intervals cover 93 to 97 % of 500 fits, seeds not used for anything else."""
    result = fitting.coverage(500, kind=kind)
    for row in result["rows"]:
        assert 0.93 <= row["covered"] <= 0.97, row
