"""Campaigns: reproducible draws, nothing lost, resumed where they stopped."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from apu_casadi.core import cf, results
from apu_casadi.core.errors import DataError, ScenarioError, SimulationError
from apu_casadi.core.means import UNBALANCE
from apu_casadi.core.profiles.profile import Varying, at
from apu_casadi.core.profiles.shapes import Ramp
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.unit import runsummary
from scenarios import campaign_records, campaigns, registry
from scenarios.campaign_records import COLUMNS, RUNS
from scenarios.campaigns import counts, random_faults, run_campaign
from scenarios.cli import main
from scenarios.schema import Scenario
from scenarios.shell import workers
from scenarios.shell.locking import locked

BASE = {
    "name": "short",
    "duration": 0.4,
    "phase": [
        {"name": "healthy", "start": 0.0, "load": {"kind": "R", "power_kW": 100.0}},
        {"name": "gas path", "start": 0.1, "health": {"f_eta_c": 0.99}},
        {"name": "short circuit", "start": 0.3, "fault": {"mu": 0.05, "k_rf": 20.0}},
    ],
}


@pytest.fixture
def base():
    return Scenario.from_dict(BASE)


def refused(base):
    """No gas generator carries twice 500 kW: refused at the start."""
    table = base.to_dict()
    table["name"], table["phase"][0]["load"]["power_kW"] = "too-much", 500.0
    return Scenario.from_dict(table)


def same(a, b):
    """All but the times of two campaigns."""
    return a.drop_vars("seconds").identical(b.drop_vars("seconds"))


def test_draws_depend_on_seed_and_index_alone(base):
    long, short = random_faults(40, 7, base=base), random_faults(3, 7, base=base)
    assert long[:3] == short
    assert random_faults(1, 8, base=base)[0].phases[1] != long[0].phases[1]
    assert len({s.name for s in long}) == 40
    faults = [s.phases[2].fault for s in long]
    assert all(isinstance(f, Ttsc) and f.mu <= f.kappa <= 1 for f in faults)
    assert {f.phase for f in faults} == set("abc")
    full = sum(f.kappa == f.mu for f in faults)
    assert 0 < full < 40
    assert len({s.phases[2].start for s in long}) > 20
    assert all(0.2 <= s.phases[2].start < 0.4 for s in long)


def test_a_share_of_the_faults_grows_into_what_is_drawn(base):
    """Ramps from one, exponentially from 1e-5; what is drawn is that of the steps."""
    steps, grown = (random_faults(60, 3, base=base, growing=g) for g in (0.0, 0.5))
    healths = [s.phases[1].health for s in grown]
    ramps = [h for h in healths if isinstance(h["f_eta_c"], Ramp)]
    shorts = [s.phases[2].fault for s in grown if isinstance(s.phases[2].fault, Varying)]
    assert 15 < len(ramps) < 45 and 15 < len(shorts) < 45
    for a, b in zip(steps, grown, strict=True):
        last, first = (at(b.phases[k].health["f_W_c"], t) for k, t in ((1, 9.0), (1, 0.0)))
        assert last == a.phases[1].health["f_W_c"] and first in (1.0, last)
        fault, wanted = at(b.phases[2].fault, 9.0), a.phases[2].fault
        assert fault.h == pytest.approx(wanted.h, rel=1e-4)
        assert (fault.phase, fault.mu, fault.kappa) == (wanted.phase, wanted.mu, wanted.kappa)
        assert (a.seed, a.phases[2].start) == (b.seed, b.phases[2].start)
        if fault is not b.phases[2].fault:
            assert b.phases[2].fault.at(0.0).h == pytest.approx(1e-5)
    assert Scenario.from_dict(grown[0].to_dict()) == grown[0]
    again = random_faults(1, base=base.change(phases=grown[0].phases))
    assert isinstance(again[0].phases[2].fault, Ttsc)
    for g in (-0.1, 1.5):
        with pytest.raises(ScenarioError, match="growing"):
            random_faults(1, base=base, growing=g)


@pytest.mark.long
def test_a_campaign_of_growing_faults_says_how_they_grow(base):
    ds = run_campaign(random_faults(2, 1, base=base, growing=1.0), workers=1)
    assert counts(ds)["done"] == 2 and ds["h"].values[0, 2] > 1e-5
    words = str(ds["profiles"].values[0])
    assert "f_eta_c ramp from 1 to" in words and "h exponential from 1e-05 to" in words


def test_a_base_without_faults_is_refused():
    with pytest.raises(ScenarioError, match="lacks a phase with"):
        random_faults(1, base="quiet")
    with pytest.raises(ScenarioError, match="n >= 1"):
        random_faults(0)


@pytest.mark.long
def test_summaries_are_those_of_single_runs(base, tmp_path):
    runs = random_faults(2, 1, base=base)
    ds = run_campaign(runs, workers=1, out=tmp_path)
    assert counts(ds)["done"] == 2
    alone = registry.run(runs[1].change(waveform_dt=None), solver="propagator")
    for j, row in enumerate(runsummary.phase_summary(alone)):
        for k in ("T4", "N_rpm_min", "V_a_rms", "h", "f_W_t"):
            assert float(ds[k][1, j]) == pytest.approx(row[k], rel=1e-12)
    assert np.isnan(ds["k_rf"].values[:, 0]).all()
    assert ds["fault_phase"].values[1, 2] == runs[1].phases[2].fault.phase
    assert all("units" in v.attrs or v.dtype.kind in "Ui" for v in ds.data_vars.values())
    assert same(results.load(tmp_path / campaigns.DATASET), cf.described(ds, "campaign of 2 runs"))


def test_a_refused_run_is_recorded_with_its_reason(base):
    ds = run_campaign([random_faults(1, base=base)[0], refused(base)], workers=1)
    assert counts(ds) == {"done": 1, "refused": 1, "failed": 0, "invalid": 0, "crashed": 0}
    assert "beyond surge" in str(ds["reason"].values[1]) and str(ds["reason"].values[0]) == "-"
    assert np.isnan(ds["T4"].values[1]).all() and np.isfinite(ds["T4"].values[0]).all()


def test_an_unforeseen_error_is_recorded_and_tried_again(base, tmp_path, monkeypatch):
    runs = random_faults(2, base=base)
    right = registry.run

    def wrong(s, **how):
        if s.name == runs[0].name:
            raise ZeroDivisionError("never mind")
        return right(s, **how)

    monkeypatch.setattr(registry, "run", wrong)
    ds = run_campaign(runs, workers=1, out=tmp_path)
    assert counts(ds)["crashed"] == 1
    assert str(ds["reason"].values[0]) == "ZeroDivisionError: never mind"
    monkeypatch.setattr(registry, "run", right)
    assert counts(run_campaign(runs, workers=1, out=tmp_path))["done"] == 2


@pytest.mark.long
def test_an_interrupted_campaign_goes_on_where_it_stopped(base, tmp_path, monkeypatch):
    runs = random_faults(3, base=base)
    whole = run_campaign(runs, workers=1)
    right = campaigns._run_one
    ran = []

    def counted(task):
        if len(ran) == 2:
            raise KeyboardInterrupt
        ran.append(task.table["name"])
        return right(task)

    monkeypatch.setattr(campaigns, "_run_one", counted)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(runs, workers=1, out=tmp_path)
    # the second line was changed on disk, and a third one cut short
    lines = (tmp_path / RUNS).read_text().splitlines()
    assert len(lines) == 2
    (tmp_path / RUNS).write_text(f"{lines[0]}\n{lines[1].replace('done', 'gone')}\n{lines[0][:99]}")
    ran.clear()
    seen = []
    again = run_campaign(
        runs, workers=1, out=tmp_path, progress=lambda done, total: seen.append((done, total))
    )
    assert ran == [runs[1].name, runs[2].name]
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert same(again, whole)
    ran.clear()
    assert same(run_campaign(runs, workers=1, out=tmp_path), whole) and ran == []
    with pytest.raises(KeyboardInterrupt):  # anew: the third one interrupts
        run_campaign(runs, workers=1, out=tmp_path, resume=False)


def test_a_changed_scenario_runs_again(base, tmp_path):
    runs = random_faults(1, base=base)
    run_campaign(runs, workers=1, out=tmp_path)
    longer = runs[0].change(duration=0.42)
    ds = run_campaign([longer], workers=1, out=tmp_path)
    assert float(ds["end"][0, -1]) == 0.42
    assert len((tmp_path / RUNS).read_text().splitlines()) == 2


@pytest.mark.long
def test_datasets_of_runs_are_kept_when_asked_for(base, tmp_path, caplog):
    (run,) = random_faults(1, base=base.change(waveform_dt=1e-3))
    run_campaign([run], workers=1, out=tmp_path, summary_only=False)
    ds = results.load(tmp_path / "runs" / f"{run.name}.nc")
    assert abs(ds.sizes["time_w"] - 401) <= 1
    path = tmp_path / "runs" / f"{run.name}.nc"
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])  # a file that lost its end is made again, and told
    (tmp_path / "runs" / ".x.nc.7.part").write_bytes(b"of a killed process")
    run_campaign([run], workers=1, out=tmp_path, summary_only=False)
    assert path.read_bytes() == whole and "damaged netCDF file" in caplog.text
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    with pytest.raises(ScenarioError, match="need a folder"):
        run_campaign([run], summary_only=False)


@pytest.mark.long
def test_processes_give_the_same_and_one_that_dies_is_told(base, monkeypatch):
    """Three workers' worth of tasks over two processes; one kills its process."""
    before = (dict(os.environ), sys.modules["__main__"].__dict__.get("__file__"))
    runs = random_faults(2, base=base)
    ds = run_campaign(runs, workers=2)
    assert same(ds, run_campaign(runs, workers=1))
    assert (dict(os.environ), sys.modules["__main__"].__dict__.get("__file__")) == before


def test_a_dead_process_costs_one_run(base, monkeypatch):
    """The pool is replaced by one whose process dies for one scenario."""
    from concurrent.futures import Future
    from concurrent.futures.process import BrokenProcessPool

    runs = random_faults(4, base=base)

    class Pool:
        def __init__(self, *_, **__):
            self.dead = False

        def submit(self, call, task):
            if self.dead:
                raise BrokenProcessPool
            f = Future()
            if task.table["name"] == runs[1].name:
                self.dead = True
                f.set_exception(BrokenProcessPool())
            else:
                f.set_result(call(task))
            return f

        def shutdown(self, **_):
            pass

    monkeypatch.setattr(workers, "ProcessPoolExecutor", Pool)
    ds = run_campaign(runs, workers=2)
    assert counts(ds)["done"] == 3 and counts(ds)["crashed"] == 1
    assert str(ds["reason"].values[1]).startswith("the process ended")


def sealed(record):
    """A line as it stands in the file, whatever the record is."""
    return campaign_records.line(record).decode()


def test_records_hold_every_number_of_a_summary(base):
    """The columns that are kept and checked are those that a summary has."""
    ds = registry.run(base.change(waveform_dt=None), solver="propagator")
    for row in runsummary.phase_summary(ds):
        numbers = {k for k, v in row.items() if v is None or isinstance(v, int | float)}
        numbers -= {"fault_phase"}  # a letter, or None: the campaign's own plan tells it
        numbers -= {*UNBALANCE, "worst"}  # records keep their form
        assert set(COLUMNS) == numbers


@pytest.mark.parametrize(
    "damage",
    [
        lambda r: [],
        lambda r: 1,
        lambda r: {},
        lambda r: {"key": r["key"]},
        lambda r: {"key": 1},
        lambda r: {**r, "name": "another"},
        lambda r: {**r, "status": "fine"},
        lambda r: {**r, "status": ["done"]},
        lambda r: {**r, "reason": None},
        lambda r: {**r, "seconds": "1"},
        lambda r: {**r, "residual": float("nan")},
        lambda r: {**r, "phases": r["phases"][:2]},
        lambda r: {**r, "phases": {"0": 1}},
        lambda r: {**r, "phases": [*r["phases"][:2], 3]},
        lambda r: {**r, "phases": [{**row, "T4": "1200"} for row in r["phases"]]},
        lambda r: {**r, "phases": [{**row, "T4": True} for row in r["phases"]]},
        lambda r: {**r, "phases": [{**row, "T4": None} for row in r["phases"]]},
        lambda r: {**r, "phases": [{**row, "h": float("inf")} for row in r["phases"]]},
        lambda r: {**r, "phases": [{k: row[k] for k in ("name", "T4")} for row in r["phases"]]},
    ],
)
def test_a_wrong_record_with_a_right_sum_is_told_and_left_out(kept, damage, tmp_path, caplog):
    """The file loses it; lines of other campaigns stay."""
    record, asked = kept
    path = tmp_path / RUNS
    other = sealed({"key": "of another campaign", "name": "x"})
    path.write_text(sealed(damage(record)) + other)
    assert campaign_records.read(path, asked) == {}
    assert "1 damaged line left out (line 1: " in caplog.text
    assert path.read_text() == other
    path.write_text(sealed(record))
    assert campaign_records.read(path, asked) == {record["key"]: record}


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A record, and what it is asked for by."""
    folder = tmp_path_factory.mktemp("kept")
    (run,) = random_faults(1, base=Scenario.from_dict(BASE))
    run_campaign([run], workers=1, out=folder)
    record = json.loads((folder / RUNS).read_text().partition(" ")[2])
    return record, {record["key"]: (run.name, 3)}


def test_damaged_bytes_are_made_again(base, tmp_path, caplog):
    """Zeros, other line ends, a mark at the beginning, a text without end."""
    runs = random_faults(2, base=base)
    whole = run_campaign(runs, workers=1, out=tmp_path)
    raw = (tmp_path / RUNS).read_bytes()
    deep = b"[" * 100_000
    for damaged in (
        b"\xef\xbb\xbf" + raw,
        raw.replace(b"\n", b"\r\n"),
        raw[:100] + bytes(50) + raw[150:],
        raw + campaign_records._sum(deep) + b" " + deep + b"\n",
        raw + raw,
        b"",
    ):
        (tmp_path / RUNS).write_bytes(damaged)
        assert same(run_campaign(runs, workers=1, out=tmp_path), whole)
        caplog.clear()
        ran = run_campaign(runs, workers=1, out=tmp_path)
        assert same(ran, whole) and not caplog.records  # told once: the file is clean


def test_a_full_disk_keeps_what_was_there(tmp_path):
    """Half a line finds room; it is taken back, and the error says what is kept."""

    class Full:
        def __init__(self, f):
            self.f, self.room = f, 20

        def write(self, data):
            if not self.room:
                raise OSError(28, "No space left on device")
            n, self.room = self.f.write(data[: self.room]), 0
            return n

        def __getattr__(self, name):
            return getattr(self.f, name)

    path = tmp_path / RUNS
    path.write_bytes(b"what was there\n")
    with (
        path.open("r+b", buffering=0) as f,
        pytest.raises(DataError, match=r"No space left on device; the runs in it are kept"),
    ):
        f.seek(0, 2)
        campaign_records._append(Full(f), path, b"a line of more than twenty bytes\n")
    assert path.read_bytes() == b"what was there\n"


def test_an_interruption_that_looks_like_a_failure_is_not_recorded(base, tmp_path, monkeypatch):
    """Ctrl-C inside an integrator comes out as an error of the run."""

    def interrupted(*_, **__):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise SimulationError("cvodes failed")

    monkeypatch.setattr(registry, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(random_faults(2, base=base), workers=1, out=tmp_path)
    assert (tmp_path / RUNS).read_bytes() == b""


def test_two_campaigns_in_one_folder_share_what_is_done(base, tmp_path):
    """The second waits, says for whom, and finds everything done; or it refuses."""
    runs = random_faults(2, base=base)
    said, got = [], []
    second = threading.Thread(
        target=lambda: got.append(run_campaign(runs, workers=1, out=tmp_path, say=said.append))
    )
    with locked(tmp_path, campaigns.LOCK):
        second.start()
        with pytest.raises(DataError, match=f"in use by process {os.getpid()}"):
            run_campaign(runs, workers=1, out=tmp_path, wait=False)
        while not said:
            time.sleep(0.01)
        assert not (tmp_path / RUNS).exists()
    second.join()
    assert counts(got[0])["done"] == 2 and "waiting until it ends" in said[0]
    assert len((tmp_path / RUNS).read_text().splitlines()) == 2


def test_what_a_killed_process_left_half_written_goes(base, tmp_path):
    (tmp_path / ".campaign.nc.123.part").write_bytes(b"CDF")
    run_campaign(random_faults(1, base=base), workers=1, out=tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [campaigns.DATASET, RUNS]


def test_an_interrupted_command_says_what_is_kept(tmp_path, monkeypatch, capsys):
    def stopped(*_, progress, **__):
        progress(3, 7)
        raise KeyboardInterrupt

    monkeypatch.setattr(campaigns, "run_campaign", stopped)
    assert main(["campaign", "--runs", "7", "--out", str(tmp_path)]) == 130
    assert f"3 of 7 runs are kept in {tmp_path}; the same command goes" in capsys.readouterr().err


@pytest.mark.ci  # two campaigns over processes, each with the start of its interpreters
@pytest.mark.skipif(os.name == "nt", reason="no SIGTERM there")
def test_sigterm_ends_a_campaign_as_ctrl_c_does(tmp_path):
    """Status, words, what is kept; and the same command gives what an undisturbed one gives."""
    line = [sys.executable, "-m", "scenarios.cli", "campaign", "--runs", "6", "--workers", "2",
            "--quiet", "--out", str(tmp_path)]  # fmt: skip
    p = subprocess.Popen(line, stderr=subprocess.PIPE, text=True)
    path = tmp_path / RUNS
    while not (path.exists() and path.stat().st_size):
        assert p.poll() is None
        time.sleep(0.05)
    p.terminate()
    _, err = p.communicate(timeout=30)
    assert p.returncode in (130, 143) and "runs are kept in" in err and "Traceback" not in err
    assert not (tmp_path / campaigns.DATASET).exists()
    subprocess.run(line, check=True)
    again = results.load(tmp_path / campaigns.DATASET)
    whole = run_campaign(random_faults(6), workers=1)
    assert same(again, cf.described(whole, "campaign of 6 runs"))


@pytest.mark.parametrize(
    ("how", "message"),
    [({"workers": 0}, "workers"), ({"solver": "cvode"}, "did you mean 'cvodes'")],
)
def test_wrong_options_are_refused(base, how, message):
    with pytest.raises(ScenarioError, match=message):
        run_campaign(random_faults(1, base=base), **how)
    with pytest.raises(ScenarioError, match="two scenarios of one name"):
        run_campaign([base, base])
    with pytest.raises(ScenarioError, match="at least one"):
        run_campaign([])


def test_the_command(base, tmp_path, monkeypatch, capsys):
    table = tmp_path / "short.py"
    table.write_text(f"scenario = {BASE!r}\n")
    argv = ["campaign", "--runs", "2", "--workers", "1", "--base", str(table), "--out"]
    assert main([*argv, str(tmp_path / "out"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["counts"]["done"] == 2 and report["reasons"] == {}
    assert main([*argv, str(tmp_path / "out")]) == 0
    assert "2 runs in" in capsys.readouterr().out
    assert (tmp_path / "out" / campaigns.DATASET).exists()


def test_many_runs_are_one_ensemble_with_the_same_records(base, tmp_path, monkeypatch):
    """Done, refused and crashed ones; what is done is not done again."""
    runs = [*random_faults(2, base=base), refused(base)]
    single = run_campaign(runs, workers=1)
    monkeypatch.setattr(campaigns, "FEW", 1)
    monkeypatch.setattr(campaigns, "_run_one", None)
    right, ran = registry.course, []

    def counted(s, **how):
        ran.append(s.name)
        if len(ran) == 2:
            raise ZeroDivisionError("never mind")
        return right(s, **how)

    monkeypatch.setattr(registry, "course", counted)
    ds = run_campaign(runs, workers=1, out=tmp_path)
    assert counts(ds) == {"done": 1, "refused": 1, "failed": 0, "invalid": 0, "crashed": 1}
    assert str(ds["reason"].values[1]) == "ZeroDivisionError: never mind"
    assert same(run_campaign(runs, workers=1, out=tmp_path), single)
    assert ran[3:] == [runs[1].name]
