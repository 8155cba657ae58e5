"""The mismatch study: its entries, what it counts, and how parts of a study are asked for."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ApuError, ParameterError
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange, HealthChange, LoadChange
from estimators.apu.trust import believed
from scenarios.commands import estimate as command
from scenarios.studies import catalogue
from scenarios.studies.mismatch import pipeline
from scenarios.studies.mismatch.imperfections import (
    FAULTS,
    IMPERFECTIONS,
    ONSET,
    SIZES,
    Readings,
    imperfection,
    scenario,
)
from scenarios.studies.registration import Results

STUDY = catalogue.get("mismatch")


def readings():
    """0.2 s of unequal numbers."""
    rng = np.random.default_rng(0)
    t, tw = 0.02 * np.arange(51), 1e-4 * np.arange(10_001)
    gas = {n: 100 + rng.standard_normal(51) for n in ("N", "P3", "T3", "T5", "Wf", "PW", "dT_isa")}
    waves = {f"{q}_{p}": 300 * np.cos(2513 * tw + k) for q in "vi" for k, p in enumerate(PHASES)}
    waves |= {"w_r": 2513 + 0 * tw, "V_fd": 40 + 0 * tw, "i_fd": 590 + 0 * tw}
    return Readings({"t": t, **gas}, {"t": tw, **waves}, np.random.default_rng(1))


def test_there_are_enough_and_each_has_three_sizes():
    assert len(IMPERFECTIONS) >= 25
    for e in IMPERFECTIONS.values():
        assert len(e.sizes) == len(SIZES) == 3 and e.fault in (None, *FAULTS)
    assert len(STUDY.parts) == 3 * len(IMPERFECTIONS)
    with pytest.raises(ParameterError, match="T5 lag"):
        imperfection("T5 lag", "sensors", "s", (1.0, 2.0, 3.0))
    with pytest.raises(ParameterError, match="weather"):
        imperfection("rain", "weather", "s", (1.0, 2.0, 3.0))


@pytest.mark.parametrize("name", IMPERFECTIONS)
def test_each_changes_what_it_says_and_nothing_else(name):
    """Units and scenarios differ from those that are believed; of readings one kind does."""
    e = IMPERFECTIONS[name]
    for size in e.sizes:
        if e.what == "unit":
            assert e.change(Apu(), size) != Apu()
        elif e.what == "scenario":
            run = scenario(e.fault or "none", "a")
            assert e.change(dict(run), size) != run
        else:
            was, now = readings(), readings()
            e.change(now, size)
            kinds = [
                any(not np.array_equal(getattr(was, k)[n], v) for n, v in getattr(now, k).items())
                for k in ("gaspath", "electrical")
            ]
            assert sum(kinds) == 1


def test_the_run_has_a_load_step_and_its_fault():
    for fault, kind in zip(FAULTS, (None, FaultChange, HealthChange), strict=True):
        events = scenario(fault, "c")["events"]
        assert isinstance(events[0], LoadChange)
        assert [type(e) for e in events[1:]] == ([] if kind is None else [kind])
        assert all(e.t == ONSET for e in events[1:])


def truth(*, h=0.0, f_eta_c=1.0):
    t = 0.02 * np.arange(51)
    after = t > ONSET - 1e-9
    values = {n: np.ones(51) for n in HEALTH} | {"N": 0 * t + 3775.0, "P_total": 0 * t + 1e5}
    values["f_eta_c"] = np.where(after, f_eta_c, 1.0)
    values |= {"mu": np.where(after, h / (1 + h), 0.0), "k_rf": np.zeros(51)}
    return xr.Dataset({n: ("time", v) for n, v in values.items()}, {"time": t})


def estimated(ds, *, alarms=(), phase=None, **off):
    """An estimate that is right with sigmas of 1e-3 of each, but for what is off by so many."""
    true = {n: ds[n].values for n in ("N", *HEALTH, "P_total")}
    true |= dict.fromkeys(("h_a", "h_b", "h_c"), 0 * ds["N"].values)
    sigma = {n: 1e-3 * np.maximum(np.abs(v), 1.0) for n, v in true.items()}
    values = {n: v + off.get(n, 0.0) * sigma[n] for n, v in true.items()}
    values |= {f"{n}_sigma": s for n, s in sigma.items()}
    values["faulty_phase"] = np.zeros(51) if phase is None else phase
    both = xr.Dataset({n: ("time", v) for n, v in values.items()}, ds.coords)
    gas = both.assign_attrs(alarms=json.dumps(list(alarms)))
    return SimpleNamespace(gaspath=gas, machines={1: both})


def test_errors_over_sigmas_and_false_alarms():
    ds = truth()
    j = pipeline.judged(ds, estimated(ds, f_W_c=-5.0, P_total=3.0), "none", "a")
    assert_allclose(j["z"]["f_W_c"], -5.0)
    assert_allclose(j["z"]["P_total"], 3.0)
    assert_allclose([j["z"][n] for n in ("N", "h_b")], 0.0, atol=1e-9)
    assert j["false"] == 0
    early, late = ((0.02 * np.arange(51) > t) * 2.0 for t in (0.4, 0.7))
    short = truth(h=2e-3)
    for fault, phase, reported, false in (
        ("none", "b", late, 1),
        ("short circuit", "b", late, 0),
        ("short circuit", "a", late, 1),
        ("short circuit", "b", early, 1),
    ):
        run = short if fault != "none" else ds
        assert pipeline.judged(run, estimated(run, phase=reported), fault, phase)["false"] == false
    worn = truth(f_eta_c=0.97)
    assert pipeline.judged(worn, estimated(worn, alarms=[0.68]), "gas path", "a")["false"] == 0
    assert pipeline.judged(worn, estimated(worn, alarms=[0.4, 0.7]), "gas path", "a")["false"] == 1
    assert pipeline.judged(ds, estimated(ds, alarms=[0.7]), "none", "a")["false"] == 1


def test_counting(monkeypatch):
    """Seed 0 right, 1 wrong and doubted, 2 silently wrong, 3 refused, 4 a false alarm believed."""
    ds = truth()
    made = {
        0: estimated(ds),
        1: estimated(ds, N=6.0),
        2: estimated(ds, N=6.0),
        4: estimated(ds, alarms=[0.3]),
    }

    def estimate(seed, *_, **__):
        if seed not in made:
            raise ApuError("no")
        made[seed].doubts = ("N: odd",) if seed == 1 else ()
        made[seed].believable = not made[seed].doubts
        made[seed].belief = believed(made[seed].doubts, gas=True, machines=[1])
        return made[seed]

    monkeypatch.setattr(
        pipeline,
        "recorded",
        lambda e, s, seed, f: (ds, SimpleNamespace(gaspath=seed, electrical=0)),
    )
    monkeypatch.setattr(pipeline, "read_recording", lambda seed, _: seed)
    monkeypatch.setattr(pipeline, "estimate", estimate)
    r = pipeline.mismatch("T5 lag", 1.0, 5, 0)
    wanted = {"runs": 5, "refused": 1, "flagged": 1, "wrong": 2, "silent": 1}
    wanted |= {"false_alarms": 1, "silent_false_alarms": 1, "seconds": 5.0}
    assert {n: r[n] for n in wanted} == wanted
    assert [m["seed"] for m in r["missed"]] == [2, 4] and r["doubts"] == {"N": 1}
    # the report of a study with that part
    parts = {f"T5 lag, {size}": {"seeds": [0, 5], "result": r} for size in SIZES}
    found = STUDY.report.claims(Results(parts))
    assert [c.met for c in found] == [False] * 4
    assert "T5 lag (1 of 5)" in found[0].why and "1 of 5 runs" in found[0].interval
    text = "\n".join(STUDY.report.section(Results(parts)))
    assert "T5 lag" in text and "N 6.0" in text


# ------------------------------------------------------------------------------ parts, seeds


def test_parts_by_words_and_the_first_seed():
    assert catalogue.parts_with(STUDY, "T5 lag") == [f"T5 lag, {s}" for s in SIZES]
    assert len(catalogue.parts_with(STUDY, "realistic, large")) == 2 * len(IMPERFECTIONS)
    assert catalogue.parts_with(STUDY, None) == list(STUDY.parts)
    for wrong in ("T5 lagg", "", " , "):
        with pytest.raises(ParameterError, match="no part"):
            catalogue.parts_with(STUDY, wrong)
    assert catalogue.from_seed(STUDY, 7).settings("T5 lag, large", 4) == [7, 4]
    assert catalogue.from_seed(STUDY, None) is STUDY


def test_the_command_runs_some_parts_from_a_seed(monkeypatch, tmp_path, capsys):
    from scenarios import cli

    ran = []

    def run(n, seed0, tell):
        ran.append((n, seed0))
        return {"n": n}

    part = dataclasses.replace(next(iter(STUDY.parts.values())), run=run)
    small = dataclasses.replace(STUDY, parts={"T5 lag, large": part, "other": part}, filters=list)
    small.report = type(small.report)()
    monkeypatch.setitem(catalogue.STUDIES, "mismatch", small)
    args = ["estimate", "study", "mismatch", "--seeds", "3", "--first-seed", "11", "--only", "T5"]
    assert cli.main([*args, "--out", str(tmp_path), "--quiet"]) == 0
    assert ran == [(3, 11)] and "mismatch: T5 lag, large" in capsys.readouterr().out
    assert cli.main([*args, "--out", str(tmp_path), "--quiet"]) == 0  # kept
    assert len(ran) == 1
    assert cli.main([*args[:-1], "rain", "--out", str(tmp_path)]) != 0
    assert "no part 'rain'" in capsys.readouterr().err
    assert command.NAME == "estimate"


@pytest.mark.slow
def test_a_run_of_the_pipeline():
    r = pipeline.mismatch("T5 stuck", 0.4, 2, 0)
    assert r["runs"] == r["flagged"] == 2 and not r["silent"]
