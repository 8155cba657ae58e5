"""The benchmark on tiny settings: every part runs, and its accuracy holds; no time is judged."""

import dataclasses
import json
import math

import numpy as np
import pytest

from apu_casadi.core.errors import ScenarioError, SignalError
from scenarios.bench import benchmarks, laneparts, linearity, runparts
from scenarios.bench.measuring import Row, Size, child
from scenarios.cli import main
from scenarios.figures.benchplot import fit, plot_costs
from scenarios.schema import Scenario
from scenarios.shell.computer import machine

SHORT = Scenario.from_dict(
    {
        "name": "short",
        "duration": 0.4,
        "phase": [
            {"name": "healthy", "start": 0.0, "load": {"kind": "R", "power_kW": 150.0}},
            {"name": "gas path", "start": 0.1, "health": {"f_eta_c": 0.99}},
            {"name": "short circuit", "start": 0.2, "fault": {"mu": 0.05, "k_rf": 20.0}},
        ],
    }
)
TINY = Size(
    trims=10, batch=20, deck=(2, 2, 1, 3), calls=60, joint=SHORT, repeats=1, runs=1, checked=1,
    hour=0.5, durations=(0.4, 0.8), counts=(1, 2), rates=(0.0, 2e4),
)  # fmt: skip
ROW = Row("it", 2.0, "ms", 3.0, 1e-7, 1e-6, "relative")


@pytest.mark.ci  # what is measured is tested on its own; this is the benchmark of it
@pytest.mark.parametrize("name", ["trim", "deck", "derivatives", "linearisation", "shell"])
def test_the_parts_run_and_are_accurate(name):
    rows = benchmarks.parts()[name](TINY)
    assert rows and all(r.accurate for r in rows), [(r.what, r.error) for r in rows]
    assert all(math.isfinite(r.value) and r.value > 0 for r in rows)


@pytest.mark.ci  # as above
def test_the_joint_parts_run_and_are_accurate(monkeypatch):
    """The process without compiled code is left out: it takes its time to build everything."""
    monkeypatch.setattr(runparts, "_virtual_machine", lambda *_: [])
    rows = runparts.joint(TINY) + runparts.campaign(TINY)
    assert len(rows) == 3 and all(r.accurate for r in rows), [(r.what, r.error) for r in rows]


@pytest.mark.slow  # half a minute of compiling
def test_lanes_are_timed_beside_scalar_code_with_the_same_results():
    rows = laneparts.lanes(TINY)
    assert len(rows) == 6 and all(r.accurate and r.ratio > 0 for r in rows)
    assert laneparts.off([1.0, np.nan], [1.0, np.nan]) == 0.0
    assert laneparts.off([1.0, np.nan], [1.0, 2.0]) == np.inf


def test_errors_leave_out_the_first_half_millisecond():
    t = np.arange(0, 0.01, 1e-4)
    ref = {
        "time_w": t,
        **{n: np.ones(5) for n in runparts.SLOW},
        **{n: 0 * t + 2 for n in runparts.FAST},
    }
    off = {**ref, "v_a": ref["v_a"] + 0.5 * (np.abs(t - 0.0052) < 1e-9), "N": ref["N"] * 1.1}
    assert runparts.errors(off, ref, [0.005])["v_a"] == 0.0
    e = runparts.errors(off, ref, [])
    assert e["v_a"] == pytest.approx(0.25) and e["N"] == pytest.approx(0.1) and e["v_b"] == 0.0


def test_a_fast_wrong_answer_is_not_met():
    assert ROW.met
    assert not dataclasses.replace(ROW, error=1e-5).met
    assert not dataclasses.replace(ROW, error=math.nan).met
    assert not dataclasses.replace(ROW, value=4.0).met
    assert dataclasses.replace(ROW, value=4.0, more=True).met
    assert benchmarks.cells(dataclasses.replace(ROW, error=1.0))["verdict"] == "inaccurate"


def test_memory_is_that_of_this_process():
    assert 20 < runparts.peak_memory() < 1e5


@pytest.mark.long
def test_a_part_runs_in_a_process_of_its_own():
    """The long run is measured there, and its answer comes back."""
    load = {"kind": "R", "power_kW": 150.0}
    phase = [{"name": "healthy", "start": 0.0, "load": load}]
    s = Scenario.from_dict({"name": "shorter", "duration": 0.04, "phase": phase})
    answer = child(runparts.run_long, {"scenario": s.to_dict()}, APU_BACKEND="vm")
    assert answer["MB"] > 20 and answer["error"] < 0.1


def test_page_and_table_and_json(tmp_path):
    where = {**machine(), "load_before": 2.0}
    curves = {"rate": (np.array([0.0, 1.0, 2.0]), np.array([1.0, 2.0, 3.0]))}
    rows = {"trim": [ROW, dataclasses.replace(ROW, target=None, peer="other", ratio=12.0)]}
    rows["linear"] = linearity.linear_rows(curves)
    r = benchmarks.Report(rows, curves, {"pycycle": "not here"}, where, 3.0)
    text = benchmarks.page(r, "docs/images/bench_linear.png")
    assert "| it | <= 3 ms | 2 ms | 1.0e-07 | 1e-06 | met | - | - | relative |" in text
    assert "Other programs were running" in text and "pycycle: not here" in text
    assert "12" in benchmarks.table(r) and "load before the start 2.0" in benchmarks.table(r)
    assert json.loads(json.dumps(r.to_dict(), allow_nan=False))["rows"]["trim"][0]["met"] is True
    assert rows["linear"][0].value == pytest.approx(0.0, abs=1e-9)
    path = linearity.write_plot(curves, TINY, tmp_path / "a" / "b.png")
    assert path.stat().st_size > 5000


def test_plot_refuses_what_is_no_curve():
    with pytest.raises(SignalError, match="two points"):
        fit(np.array([1.0]), np.array([1.0]))
    with pytest.raises(SignalError, match="one to four"):
        plot_costs([], "")


def test_the_command(capsys, tmp_path, monkeypatch):
    own, bad = (
        {"trim": lambda size: [ROW]},
        {"trim": lambda size: [dataclasses.replace(ROW, error=1.0)]},
    )
    others = benchmarks.parts(peers=True)
    monkeypatch.setattr(benchmarks, "parts", lambda peers=False: others if peers else own)
    monkeypatch.setattr(
        benchmarks, "linear", lambda size: {"rate": (np.arange(3.0), np.arange(3.0))}
    )
    assert main(["bench", "--list"]) == 0
    assert "dpsim" in capsys.readouterr().out
    page = tmp_path / "BENCHMARKS.md"
    assert main(["bench", "--page", str(page)]) == 0
    assert "2 ms" in capsys.readouterr().out
    assert "bench_linear.png" in page.read_text(encoding="utf-8")
    assert (tmp_path / "docs" / "images" / "bench_linear.png").exists()
    assert main(["bench", "--only", "trim", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"]["trim"][0]["value"] == 2.0
    own |= bad
    assert main(["bench", "--only", "trim"]) == 1
    assert main(["bench", "--runs", "0"]) == 2
    with pytest.raises(ScenarioError, match="unknown part"):
        benchmarks.run(["trin"])


@pytest.mark.slow
def test_the_estimation_part_runs_and_is_accurate():
    """Compiles six filters: some minutes."""
    rows = benchmarks.parts()["estimation"](TINY)
    assert len(rows) == 3 and all(r.accurate for r in rows), [(r.what, r.error) for r in rows]
