"""The study of the exchange error: its norms, its page and its command."""

import json
import math

import numpy as np
import pytest

from apu_casadi.core import results
from apu_casadi.core.errors import ScenarioError
from apu_casadi.unit.runsignals import RUN
from scenarios.cli import main
from scenarios.studies import multirate_study as study


def rows(cases=tuple(study.CASES)):
    """Errors that fall with the first power of the step, or with the second."""
    made = []
    for case in cases:
        made.append(study.Measured(case, "one model", math.nan, *[1e-8] * 4, cpu=10.0))
        for ex, p in (("paper", 1), ("predicted", 2), ("corrected", 2)):
            made += [study.Measured(case, ex, dt, *[dt**p] * 4, cpu=1.0) for dt in study.STEPS]
        made += [study.Measured(case, ex, 0.02, *[1e-3] * 4, cpu=1.0)
                 for ex in ("predicted speed", "predicted fuel")]  # fmt: skip
    return made


def run_of(dt, *, N=1.0, P=1.0, V=1.0):
    """A joint run sampled every ``dt``; factors on speed excursion, power and voltage."""
    t = np.arange(round(study.DURATION / dt) + 1) * dt
    after = t > study.T_EVENT
    values = {"N": 3775 + 100 * N * after, "P_total": 2e5 * np.where(after, P, 1.0)}
    values["P_e"] = 1e5 * np.where(after, V, 1.0) ** 2  # into a resistive load
    return results.dataset({"time": t}, {"time": values}, signals=RUN)


def test_norms_are_what_they_say():
    """Known errors of speed, power and voltage, on two different grids."""
    truth = run_of(0.02)
    e = study.errors(run_of(0.005, N=1.03, P=1.002, V=0.999), truth)
    assert e["N"] == pytest.approx(0.03, rel=1e-9), "of the excursion of 100 rad/s"
    assert e["P"] == pytest.approx(0.002, rel=1e-9)
    assert e["V"] == pytest.approx(0.001, rel=1e-9)
    assert e["E"] == pytest.approx(0.002, rel=1e-9), "energy since the event"
    assert max(study.errors(truth, truth).values()) == 0.0


def test_of_generators_that_differ_the_worst_voltage_counts():
    """Where each has its own power, the error of one of them is that of the unit."""
    truth, wrong = run_of(0.02), run_of(0.02, V=0.999)
    two = [ds.drop_vars("P_e").copy() for ds in (truth, truth)]
    for ds, others in zip(two, ((truth, truth), (truth, wrong)), strict=True):
        ds["P_e"] = ("generator", "time"), np.array([d.P_e.values for d in others])
    assert study.errors(two[1], two[0])["V"] == pytest.approx(0.001, rel=1e-9)
    assert set(study.OF_ONE).isdisjoint(study.CASES)
    assert all(case.event.generator for case in study.OF_ONE.values())


def test_order_is_the_slope():
    """First and second power come out as orders 1 and 2."""
    orders = {r["exchange"]: r["N"] for r in study.report(rows())["orders"]}
    assert orders == pytest.approx({"paper": 1.0, "predicted": 2.0, "corrected": 2.0})


def test_report_is_json_and_the_page_holds_every_run():
    """NaN never reaches a file, and every measured step has its line on the page."""
    data = rows()
    report = json.loads(json.dumps(study.report(data), allow_nan=False))
    assert report["runs"][0]["dt"] is None and report["runs"][1]["times_faster"] == 10.0
    page = study.page(data)
    assert page.count("| paper |") == len(study.STEPS) * len(study.CASES)
    assert "54 Hz" in page, "the regulator's mode at 100 kW, from the eigenvalues"
    assert "TTSC fault" in study.table(data)


def test_events_of_one_machine_are_chosen_and_leave_the_text_alone(tmp_path, monkeypatch, capsys):
    """The page's paragraph is of the three events of both; a table is added for each of one."""
    asked = {}

    def measured(**how):
        asked.update(how)
        return rows()

    monkeypatch.setattr(study, "measure", measured)
    assert main(["multirate", "--events", "one", "--out", str(tmp_path), "--json"]) == 0
    assert asked["cases"] == tuple(study.OF_ONE)
    capsys.readouterr()
    data = rows()
    worse = [study.Measured("TTSC fault of one", r.exchange, r.dt, *[9 * r.N] * 4, cpu=r.cpu)
             for r in data if r.case == "TTSC fault"]  # fmt: skip
    page, more = study.page(data), study.page(data + worse)
    text = page.partition("## ")[0].replace("apu multirate", "apu multirate --events all")
    assert " ".join(more.partition("## ")[0].split()) == " ".join(text.split())
    assert "## TTSC fault of one" in more


def test_figure_has_a_panel_for_each_quantity():
    """Four logarithmic panels, every case and exchange in a legend; one step alone is refused."""
    fig = study.figure(rows())
    assert [ax.get_title() or ax.texts[0].get_text() for ax in fig.axes] == [
        "Speed, of its excursion", "Power", "Voltage", "Energy",
    ]  # fmt: skip
    words = [t.get_text() for t in fig.legends[0].get_texts()]
    assert len(words) == len(study.CASES) + len(study.COMPARED)
    every = study.figure(rows(study.CHOSEN["all"]))
    assert [len(x.get_texts()) for x in every.legends] == [5, len(study.COMPARED)]
    looks = [(line.get_color(), line.get_marker()) for line in every.legends[0].get_lines()]
    assert len(set(looks)) == 5
    with pytest.raises(ScenarioError, match="two exchange steps"):
        study.figure([r for r in rows() if r.dt == 0.02])


def test_the_staircase_of_the_paper_s_step_is_near_the_regulator_s_mode():
    """20 ms against the mode's period: within 15 %, which is why power errs most there."""
    mode = study.regulator_mode()
    assert 1 / mode.frequency == pytest.approx(0.020, rel=0.15)
    assert 0 < mode.damping < 0.3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--steps", "7"], "does not divide 80 ms"),
        (["--steps", "ten"], "numbers in ms"),
        (["--steps", "10,40", "--page", "x.md"], "20 ms"),
        (["--events", "one", "--page", "x.md"], "--events both, or all"),
    ],
)
def test_the_command_refuses_before_it_runs(arguments, words, capsys, tmp_path, monkeypatch):
    """Exit status 2 and one line: what was expected."""
    monkeypatch.chdir(tmp_path)
    assert main(["multirate", *arguments]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.slow
def test_the_study_itself(tmp_path, capsys):
    """All cases with three steps: first order as the paper exchanges, second order otherwise."""
    assert main(["multirate", "--steps", "10,20,40", "--out", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    for o in report["orders"]:
        low, high = (0.9, 1.3) if o["exchange"] == "paper" else (1.7, 2.4)
        if o["case"] != "TTSC fault" or o["exchange"] == "paper":  # else: 800 Hz, see the page
            assert low < o["N"] < high, o
    at_20 = {(r["case"], r["exchange"]): r for r in report["runs"] if r["dt"] == 0.02}
    for case in study.CASES:
        e = {ex: at_20[case, ex]["N"] for ex in study.COMPARED}
        assert 0.04 < e["paper"] < 0.07 and e["predicted"] < 0.01 and e["corrected"] < 0.004, e
    assert (tmp_path / "multirate_error.png").stat().st_size > 10_000
