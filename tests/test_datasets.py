"""Data sets: recipes are checked, runs depend on seeds alone, nothing is lost, scores are right."""

import contextlib
import dataclasses
import errno
import hashlib
import json
import math
import os
import signal
import subprocess
import sys
from collections import Counter
from datetime import datetime
from types import SimpleNamespace

import numpy as np
import pytest

from apu_casadi.core.errors import DataError, ScenarioError
from scenarios import cli
from scenarios.datasets import baselines, making, scoring, waveforms
from scenarios.datasets.recipe import CLASSES, Recipe, draw, read_recipe
from scenarios.schema import Scenario

pd = pytest.importorskip("pandas")
pytest.importorskip("pyarrow")
REFERENCE = read_recipe()


def table(r=REFERENCE, **changed):
    return {f.name: getattr(r, f.name) for f in dataclasses.fields(r)} | changed


@pytest.fixture(scope="module")
def small():
    """Eleven units, one of each class and two of the weighty, 0.6 s each, waveforms at 5 kHz."""
    return Recipe.of(
        table(
            units=11, duration=0.6, onset=[0.2, 0.3], growing=0.0,
            waveforms={"rate": 5000.0, "before": 0.05, "after": 0.1},
        )
    )  # fmt: skip


@pytest.fixture(scope="module")
def made(small, tmp_path_factory):
    folder = tmp_path_factory.mktemp("set") / "data"
    assert making.make_dataset(small, folder, workers=1) == {"done": 11}
    return folder


def test_classes_and_splits_are_as_the_recipe_says():
    drawn = [draw(REFERENCE, u, 0) for u in range(110)]
    count = Counter(d.labels["class"] for d in drawn)
    assert count == {c: 10 * REFERENCE.classes[c] for c in CLASSES}
    split = Counter(REFERENCE.split_of(u) for u in range(1000))
    assert all(abs(split[s] - 1000 * share) < 5 for s, share in REFERENCE.split.items())
    for d in drawn[:22]:
        s = Scenario.from_dict(d.scenario)
        outside = d.labels["split"] == "range"
        assert (s.ambient.altitude > 6999) == outside
        assert (d.labels["h"] > 0) == (d.labels["class"] in ("ttsc", "combined"))
    assert draw(REFERENCE, 5, 0) == draw(dataclasses.replace(REFERENCE, units=7), 5, 0)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"unit": 3}, r"unknown key 'unit' \(did you mean 'units'"),
        ({"units": 0}, "units = 0 must be a whole number >= 1"),
        ({"seed": True}, "seed = True must be a whole number"),
        ({"onset": [1.0, 7.0]}, "onset = .* is not inside the run"),
        ({"growing": 2.0}, "growing = 2 is outside"),
        ({"classes": {"healty": 1}}, r"'healty' \(did you mean 'healthy'"),
        ({"classes": {"healthy": -1}}, "shares >= 0"),
        ({"size": {**REFERENCE.size, "h": [0.0, 1.0]}}, r"\[size\] h = \[0, 1\] is no range"),
        ({"spread": {"machine.rs": 0.1}}, r"machine.rs.*machine.r_s"),
        ({"spread": {"machine.r_s": 0.5}}, "outside"),
        ({"range": 3}, "range must be a table"),
        ({"exchange": "papre"}, r"exchange = 'papre' \(did you mean 'paper'"),
    ],
)
def test_a_wrong_recipe_is_told(changed, words):
    with pytest.raises(ScenarioError, match=words):
        Recipe.of(table(**changed))


def waves_of(run, n, seed):
    """Waveforms of a run as they are measured."""
    rng = np.random.default_rng(seed)
    own = {w: rng.normal(size=n).astype(np.float32) for w in waveforms.WAVES}
    return {"run": np.full(n, run, np.int32), "time": 1.0 + 1e-4 * np.arange(n), **own}


def test_waveforms_are_netcdf_4_without_a_time_of_making(tmp_path, monkeypatch):
    """Two runs of different lengths; the same bits later, every number back, units and names."""
    xr = pytest.importorskip("xarray")
    parts = [waves_of(3, 40, 1), waves_of(4, 30, 2)]
    data = waveforms.packed(parts, "two runs")
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert waveforms.packed(parts, "two runs") == data
    (tmp_path / "u.nc").write_bytes(data)
    read = waveforms.frame(tmp_path / "u.nc")
    expected = pd.concat([pd.DataFrame(p) for p in parts], ignore_index=True)
    pd.testing.assert_frame_equal(read, expected)
    with xr.open_dataset(tmp_path / "u.nc", decode_times=False) as ds:
        assert ds["i_a"].dims == ("generator", "sample") and ds["i_a"].attrs["units"] == "A"
        assert set(ds.coords) == {"generator", "run", "time"}
        assert ds.attrs["Conventions"].startswith("CF") and "date_created" not in ds.attrs
        assert all(v.attrs["long_name"] and v.attrs["units"] for v in ds.variables.values())
        np.testing.assert_array_equal(ds["v_b"].sel(generator=2), expected["v_b_2"])
    (tmp_path / "u.nc").write_bytes(data[:-700])
    with pytest.raises(DataError, match=r"u\.nc: damaged"):
        waveforms.frame(tmp_path / "u.nc")


def test_a_set_made_before_waveforms_were_netcdf_is_read(tmp_path):
    for part in ("gaspath", "electrical"):
        (tmp_path / part).mkdir()
    gas, waves = {"run": [0], "time": [0.0]}, waves_of(0, 20, 1)
    pd.DataFrame(gas).to_parquet(tmp_path / "gaspath/unit_00002.parquet")
    pd.DataFrame(waves).to_parquet(tmp_path / "electrical/unit_00002.parquet")
    labels = {"run": np.array([0]), "unit": np.array([2])}
    ((_, _, read),) = baselines.runs_of(tmp_path, labels)
    pd.testing.assert_frame_equal(read, pd.DataFrame(waves))
    (tmp_path / "electrical/unit_00002.parquet").write_bytes(b"PAR1")
    with pytest.raises(DataError, match=r"unit_00002.parquet: damaged"):
        next(baselines.runs_of(tmp_path, labels))


def test_packages_that_files_need_are_asked_for_first(tmp_path, monkeypatch):
    monkeypatch.setattr(making, "find_spec", lambda name: None)
    for rate, words in ((1e4, r"pyarrow and h5netcdf: .*\[parquet,netcdf4\]"), (0, r"\[parquet\]")):
        r = dataclasses.replace(REFERENCE, waveforms={**REFERENCE.waveforms, "rate": rate})
        with pytest.raises(DataError, match=words):
            making.make_dataset(r, tmp_path / "data")
    assert not (tmp_path / "data").exists()


@pytest.mark.long
def test_what_a_data_set_holds(small, made):
    labels = scoring.read_labels(made)
    assert sorted(labels["run"]) == list(range(11))
    for u in range(11):
        d = draw(small, u, 0)
        gas = pd.read_parquet(made / f"gaspath/unit_{u:05d}.parquet")
        assert list(gas) == list(making.gas_path_columns())
        before, last = gas["time"] < d.labels["onset"] - 0.02, gas.iloc[-1]
        for f in ("f_eta_c", "f_W_c", "f_eta_t", "f_W_t"):
            assert (gas.loc[before, f"T.{f}"] == 1).all()
            assert last[f"T.{f}"] == pytest.approx(d.labels[f], rel=1e-6)
        assert last["T.h"] == pytest.approx(d.labels["h"], rel=1e-3)
        # noise and gain errors, no more, but where the sensor is the fault
        names = [n for n in ("T3", "T5", "P3") if n != d.labels["sensor"]]
        for n in names:
            assert gas[f"X_s.{n}"].iloc[5] == pytest.approx(gas[f"X_v.{n}"].iloc[5], rel=0.03)
        waves = waveforms.frame(made / f"electrical/unit_{u:05d}.nc")
        assert len(waves) == 750 and not waves.isna().any().any()
        assert list(waves) == ["run", "time", *waveforms.WAVES] and set(waves["run"]) == {u}
    assert Counter(labels["class"]) == {c: int(small.classes[c]) for c in CLASSES}


def test_a_faulty_sensor_reads_wrong_from_its_onset():
    t, y = np.linspace(0, 1, 51), np.full(51, 500.0)
    for kind, ends in (("bias", 510.0), ("drift", 510.0), ("stuck", 500.0)):
        d = draw(REFERENCE, 0, 0)
        d = dataclasses.replace(d, sensor=("T5", kind, 0.02))
        d.labels.update(onset=0.4, over=0.0)
        read = making._faulty(d, "T5", t, y)
        assert read[-1] == pytest.approx(ends) and (read[t < 0.4] == 500).all()
        assert making._faulty(d, "T3", t, y) is y


@pytest.mark.long
def test_an_interrupted_one_goes_on_with_the_same_bits(small, made, tmp_path):
    """Two units fewer, a damaged file, a record cut short: made again, and nothing else."""
    folder = tmp_path / "data"
    folder.mkdir()
    for p in made.rglob("*"):
        if p.is_file():
            (folder / p.relative_to(made)).parent.mkdir(exist_ok=True)
            (folder / p.relative_to(made)).write_bytes(p.read_bytes())
    (folder / "gaspath/unit_00003.parquet").write_bytes(b"damaged")
    (folder / "units/unit_00004.json").write_text('{"files": {')
    again = []
    making.make_dataset(small, folder, workers=1, progress=lambda k, n: again.append((k, n)))
    assert again == [(10, 11), (11, 11)]
    for line in (made / "checksums.sha256").read_text().splitlines():
        digest, name = line.split()
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    with pytest.raises(DataError, match="another recipe"):
        making.make_dataset(dataclasses.replace(small, seed=1), folder)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("")
    with pytest.raises(DataError, match="holds other files"):
        making.make_dataset(small, tmp_path / "full")


def test_a_recipe_of_before_runs_as_before_and_what_grows_is_integrated():
    old = {k: v for k, v in table().items() if k != "exchange"}
    assert draw(Recipe.of(old), 3, 0).scenario["exchange"] == "predicted"
    assert draw(REFERENCE, 3, 0).scenario["exchange"] == "paper"
    for d in (draw(REFERENCE, u, 0) for u in range(66)):
        electrical = d.labels["class"] in ("ttsc", "field", "combined")
        cvodes = making.solver_of(d).get("solver") == "cvodes"
        assert cvodes == (electrical and d.labels["over"] > 0)


def test_a_refused_run_keeps_its_reason(small):
    r = dataclasses.replace(small, range={**small.range, "power_kW": (900.0, 900.0)})
    labels, gas, waves = making.make_run(r, 0, 0)
    assert labels["status"] == "refused" and labels["reason"] and not gas and not waves


def predictions(path, rows):
    pd.DataFrame(rows).to_csv(path, index=False)
    return path


def test_scores_against_numbers_by_hand(tmp_path):
    """Kappa 0.5 of the textbook's table; latencies, rates and coverage that can be counted."""
    true = np.array(["ttsc"] * 25 + ["healthy"] * 25)
    labels = {
        "run": np.arange(50),
        "class": true,
        "split": np.array(["test"] * 50),
        "onset": np.where(true == "ttsc", 2.0, np.nan),
        "h": np.where(true == "ttsc", 1e-3, 0.0),
        "phase": np.array(["a"] * 50),
        "generator": np.ones(50),
    }
    said = ["ttsc"] * 20 + ["healthy"] * 5 + ["ttsc"] * 10 + ["healthy"] * 15
    rows = [
        {"run": k, "class": s, "score": float(s == "ttsc") + (k < 10), "alarm_time": 2.5,
         "phase": "a" if k < 10 else "b", "h": 1.1e-3, "h_sigma": 1e-4}
        for k, s in enumerate(said)
    ]  # fmt: skip
    p = scoring.read_predictions(predictions(tmp_path / "p.csv", rows), labels)
    s = scoring.score(p, labels)["test"]
    assert s["accuracy"] == pytest.approx(0.7) and s["kappa"] == pytest.approx(0.4)
    assert s["detected"] == 0.8 and s["false_alarms"] == 0.4
    assert s["confusion"]["ttsc"] == {"healthy": 5, "ttsc": 20}
    assert s["detected_at_false_alarms"] == {"false_alarms": 0.05, "detected": 0.4}
    assert s["latency"]["median"] == 0.5 and s["latency"]["false_alarms"] == 1.0
    assert s["phase_right"] == 0.5
    assert s["severities"]["h"]["coverage_95"] == 0.5  # 1e-4 off: one sigma; healthy ones eleven
    assert s["severities"]["h"]["relative_rmse_if_faulty"] == pytest.approx(0.1)
    assert scoring.cohen_kappa(true, true) == 1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows[:-1], "1 runs are missing: 2"),
        (lambda rows: [*rows, rows[0]], "line 5: run 0 is there twice"),
        (lambda rows: [*rows, {"run": 9, "class": "ttsc"}], "1 runs are not in the data set: 9"),
        (lambda rows: [{**r, "class": "tstc"} for r in rows], r"'tstc' \(did you mean 'ttsc'"),
        (lambda rows: [{**r, "hh": 1} for r in rows], r"column 'hh' \(did you mean 'h'"),
        (
            lambda rows: [{**r, "h": "big"} for r in rows],
            "line 2, column h: 'big' is no number: leave",
        ),
        (lambda rows: [{"run": r["run"]} for r in rows], "column class is missing"),
        (
            lambda rows: [{**r, "class": float("nan")} for r in rows],
            "line 2: class '' .*is missing",
        ),
        (lambda rows: [{**r, "run": -1} for r in rows], "run '-1' is no whole number"),
        (lambda rows: [{**r, "run": r["run"] + 0.5} for r in rows], "'0.5' is no whole number"),
        (lambda rows: [{**r, "h": "inf"} for r in rows], "line 2, column h: 'inf' is no number"),
        (lambda rows: [{**r, "score": "NaN"} for r in rows], "score = 'NaN' is no finite number"),
        (lambda rows: [{**r, "h": 0, "h_sigma": -1} for r in rows], "h_sigma = '-1' must be > 0"),
        (lambda rows: [{**r, "h_sigma": 1} for r in rows], "column h is missing for h_sigma"),
        (lambda rows: [{**r, "generator": 1.5} for r in rows], "generator '1.5' is no whole"),
        (lambda rows: [{**r, "phase": "d"} for r in rows], "phase 'd': a, b, c or nothing"),
        (lambda rows: [], "p.csv: empty"),
    ],
)
def test_predictions_that_do_not_fit_are_refused(tmp_path, change, words):
    labels = {"run": np.arange(3), "class": np.array(["healthy"] * 3)}
    rows = change([{"run": k, "class": "healthy"} for k in range(3)])
    with pytest.raises(DataError, match=words):
        scoring.read_predictions(predictions(tmp_path / "p.csv", rows), labels)


def test_columns_that_are_named_twice_are_refused(tmp_path):
    (tmp_path / "p.csv").write_text("run,class,h,h\n0,ttsc,1,2\n")
    labels = {"run": np.arange(1), "class": np.array(["healthy"])}
    with pytest.raises(DataError, match="column h is there twice"):
        scoring.read_predictions(tmp_path / "p.csv", labels)


def test_scores_are_those_of_scikit_learn():
    metrics = pytest.importorskip("sklearn.metrics", reason="extra 'learn'")
    rng = np.random.default_rng(4)
    true, said = rng.choice(CLASSES, 500), rng.choice(CLASSES, 500)
    said = np.where(rng.random(500) < 0.6, true, said)
    ill, value = true != "healthy", rng.normal(size=500) + (true != "healthy")
    h, guess = np.where(ill, 1e-3, 0.0), rng.normal(1e-3, 3e-4, 500)
    y = {"class": true, "h": h}
    s = scoring.score_of({"class": said, "score": value, "h": guess}, y)
    assert s["kappa"] == pytest.approx(metrics.cohen_kappa_score(true, said), rel=1e-12)
    assert s["accuracy"] == pytest.approx(metrics.accuracy_score(true, said), rel=1e-12)
    table = metrics.confusion_matrix(true, said, labels=CLASSES)
    ours = [[s["confusion"][a].get(b, 0) for b in CLASSES] for a in CLASSES]
    np.testing.assert_array_equal(ours, table)
    recall = metrics.recall_score(true, said, labels=CLASSES, average=None)
    assert [s["by_class"][c]["right"] for c in CLASSES] == pytest.approx(list(recall), rel=1e-12)
    rmse = math.sqrt(metrics.mean_squared_error(h, guess))
    assert s["severities"]["h"]["rmse"] == pytest.approx(rmse, rel=1e-12)
    false, found, _ = metrics.roc_curve(ill, value, drop_intermediate=False)
    best = found[false <= scoring.FALSE_ALARMS + 1e-12].max()
    assert s["detected_at_false_alarms"]["detected"] == pytest.approx(best, rel=1e-12)


def test_a_full_disk_is_told_and_nothing_is_lost(small, made, tmp_path, monkeypatch):
    """The third file finds no room; what was kept stays, and the rest is made later."""
    folder, write, count = tmp_path / "data", making.files.os.fsync, []
    units = {u: json.loads((made / f"units/unit_{u:05d}.json").read_text()) for u in range(11)}
    kept = {
        u: {"rows": k["rows"], "files": {n: (made / n).read_bytes() for n in k["files"]}}
        for u, k in units.items()
    }
    monkeypatch.setattr(making, "make_unit", lambda table, u: kept[u])

    def full(fd):
        count.append(fd)
        if len(count) == 9:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(fd)

    monkeypatch.setattr(making.files.os, "fsync", full)
    with pytest.raises(DataError, match="No space left on device; free some space"):
        making.make_dataset(small, folder, workers=1)
    assert len(list((folder / "units").iterdir())) == 2
    assert not list(folder.rglob("*.part"))
    making.make_dataset(small, folder, workers=1)
    assert (folder / "checksums.sha256").read_text() == (made / "checksums.sha256").read_text()


def test_what_a_kill_left_half_written_goes(small, made, tmp_path, monkeypatch):
    """Also where it came before the recipe was written."""
    folder = tmp_path / "data"
    for name in (".123-0.part", "gaspath/.123-1.part"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"half")
    with pytest.raises(DataError, match="holds other files"):
        making.make_dataset(small, folder)
    (folder / "gaspath/.123-1.part").unlink()
    (folder / "gaspath").rmdir()
    monkeypatch.setattr(making, "make_unit", lambda table, u: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        making.make_dataset(small, folder, workers=1)
    assert sorted(p.name for p in folder.iterdir()) == ["recipe.json"]


def test_the_day_of_a_set_is_that_of_its_beginning(tmp_path, monkeypatch):
    told = {"recipe": {}, "program": "p"}
    for epoch, day in ((0, "1970-01-01"), (86400 * 365, "1970-01-01")):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", str(epoch))
        assert making._claim(tmp_path, told) == day
    assert json.loads((tmp_path / "recipe.json").read_text())["begun"] == "1970-01-01"


@pytest.mark.ci  # processes that are killed and begun again
def test_killed_at_any_moment_it_goes_on_with_the_same_bits(small, made, tmp_path):
    kept = json.loads((made / "recipe.json").read_text())
    told, begun = kept["recipe"], datetime.fromisoformat(kept["begun"] + "T00:00+00:00")
    same_day = os.environ | {"SOURCE_DATE_EPOCH": f"{begun.timestamp():.0f}"}
    text = "\n".join(f"{k} = {json.dumps(v)}" for k, v in told.items() if not isinstance(v, dict))
    for name, rows in ((k, v) for k, v in told.items() if isinstance(v, dict)):
        text += f"\n[{name}]\n" + "\n".join(f'"{k}" = {json.dumps(v)}' for k, v in rows.items())
    (tmp_path / "r.toml").write_text(text)
    command = [sys.executable, "-m", "scenarios.cli", "dataset", "make", str(tmp_path / "r.toml")]
    command += ["--out", str(tmp_path / "data"), "--quiet"]
    rng = np.random.default_rng(7)
    for _ in range(4):
        p = subprocess.Popen(command, start_new_session=True, env=same_day)
        with contextlib.suppress(subprocess.TimeoutExpired):
            p.wait(rng.uniform(1, 12))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(p.pid, signal.SIGKILL)
        p.wait()
    subprocess.run(command, check=True, env=same_day)
    names = {str(p.relative_to(made)) for p in made.rglob("*") if p.is_file()}
    assert names == {
        str(p.relative_to(tmp_path / "data")) for p in (tmp_path / "data").rglob("*") if p.is_file()
    }
    for n in names - {making.LOCK}:
        assert (tmp_path / "data" / n).read_bytes() == (made / n).read_bytes(), n


@pytest.mark.long
def test_commands(made, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["dataset", "recipe"]) == 0
    (tmp_path / "mine.toml").write_text(capsys.readouterr().out)
    assert read_recipe(tmp_path / "mine.toml") == REFERENCE
    assert cli.main(["dataset", "baseline", "chance", "--dataset", str(made), "--quiet"]) == 0
    assert cli.main(["score", "predictions.csv", "--dataset", str(made), "--split", "all"]) == 0
    out = capsys.readouterr().out
    assert "split all: 11 runs" in out and "Cohen's kappa" in out
    assert cli.main(["score", "predictions.csv", "--dataset", str(made), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["all"]["runs"] == 11
    assert cli.main(["score", "predictions.csv", "--dataset", str(tmp_path)]) == 2
    assert "apu dataset make" in capsys.readouterr().err


@pytest.mark.ci  # starts a scheduler and its workers
def test_a_cluster_whose_worker_is_killed_gives_the_same_bits(small, made, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as c:
        killed = []

        def progress(k, n):
            if k == 2 and not killed:
                killed.append(next(iter(c.workers.values())))
                killed[0].process.process.kill() if hasattr(killed[0], "process") else None

        making.make_dataset(
            small, tmp_path / "data", cluster=c.scheduler_address, progress=progress
        )
    sums = (tmp_path / "data/checksums.sha256").read_text()
    assert sums == (made / "checksums.sha256").read_text()


@pytest.mark.long
def test_metadata_names_every_file_and_column(small, made):
    meta = json.loads((made / "croissant.json").read_text())
    assert (
        meta["distribution"][0]["sha256"]
        == hashlib.sha256((made / "runs.parquet").read_bytes()).hexdigest()
    )
    assert meta["datePublished"] == json.loads((made / "recipe.json").read_text())["begun"]
    fields = {r["@id"]: [f["name"] for f in r["field"]] for r in meta["recordSet"]}
    assert fields["gaspath_samples"] == list(making.gas_path_columns())
    assert fields["runs"] == list(pd.read_parquet(made / "runs.parquet"))
    sets = {d["@id"]: d for d in meta["distribution"]}
    assert sets["electrical"]["includes"] == "electrical/*.nc"
    assert "i_fd [A]" in sets["electrical"]["description"]
    card = (made / "CARD.md").read_text()
    assert "11 runs" in card and "{{" not in card and "| `X_s.T5` | K |" in card
    assert math.isfinite(small.duration)


def told_of(*best, onsets=(), factors=(), severity=(0.0, 1e-5)):
    """What an estimate says: all factors are 2 % off, by gain errors; only one has changed."""
    import xarray as xr

    t = np.linspace(0.0, 6.0, 301)
    course = {n: ("time", np.full(t.size, 0.98)) for n in baselines.HEALTH}
    course["f_eta_t"] = ("time", np.where(t < 3.2, 1.0, 0.985))
    sigma = {f"{n}_sigma": ("time", np.full(t.size, 0.007)) for n in baselines.HEALTH}
    alarms = [v + 0.2 for v in onsets]
    attrs = {"onsets": str([*onsets]), "alarms": str(alarms)}
    found = [SimpleNamespace(t=3.2, best=b, failure=dict(factors)) for b in best]
    lost = {"h": severity[0], "h_sigma": severity[1]}
    lost = {n: ("time", np.full(t.size, v)) for n, v in lost.items()}
    return SimpleNamespace(
        gaspath=xr.Dataset(course | sigma, {"time": t}, attrs),
        diagnoses=found,
        balance=xr.Dataset(lost, {"time": t}, {"evidence": 0.3}),
        path=(None, SimpleNamespace(result=None)),
    )


def said_of(monkeypatch, told, waves=None):
    """What the baseline makes of it."""
    from estimators.apu import recorded_estimate
    from estimators.apu.recordings import measured

    monkeypatch.setattr(recorded_estimate, "estimate", lambda *a, **k: told)
    monkeypatch.setattr(recorded_estimate, "JUMPS", SimpleNamespace(evidence=lambda _: 0.4))
    monkeypatch.setattr(measured, "read_recording", lambda data: data)
    columns = [f"X_s.{n}" for n in baselines.GAS_PATH.names] + [f"W.{n}" for n in baselines.VARIED]
    t = told.gaspath["time"].values
    return baselines.estimated(
        1, pd.DataFrame({"time": t} | dict.fromkeys([*columns, "W.P_e"], 1.0)), waves
    )


@pytest.mark.parametrize(
    ("best", "alarmed", "said"),
    [("gas path", True, "f_eta_t"), ("sensor T5", True, "sensor"), ("gas path", False, "healthy")],
)
def test_a_change_of_health_is_judged_from_its_onset(monkeypatch, best, alarmed, said):
    """All factors are 2 % off, as gain errors make them; only one of them has changed."""
    told = told_of(*([best] if alarmed else []), onsets=(3.0,) if alarmed else ())
    row = said_of(monkeypatch, told)
    assert row["class"] == said
    assert row.get("alarm_time") == (3.2 if alarmed else None)
    assert row["f_eta_t"] == 0.985
    assert row["score"] == (1.4 if alarmed else 0.4)


def test_what_a_loss_of_the_generators_and_a_likelier_factor_say(monkeypatch):
    short = "generators: short circuit"
    row = said_of(monkeypatch, told_of(short, severity=(8e-4, 1e-4)))
    assert (row["class"], row["h"], row["h_sigma"]) == ("ttsc", 8e-4, 1e-4)
    assert said_of(monkeypatch, told_of(short, severity=(3e-4, 1e-4)))["class"] == "healthy"
    both = told_of("gas path", short, onsets=(3.0,), factors={"f_W_c": 0.9}, severity=(8e-4, 1e-4))
    assert said_of(monkeypatch, both)["class"] == "combined"
    gas = told_of("gas path", onsets=(3.0,), factors={"f_W_c": 0.9, "several factors": 0.1})
    assert said_of(monkeypatch, gas)["class"] == "f_W_c"
    monkeypatch.setattr(baselines, "_of_machine", lambda _, k: ("a", 0.0, 1e-5, "field winding"))
    row = said_of(monkeypatch, told_of(), waves=())
    assert (row["class"], row["generator"]) == ("field", 1)
