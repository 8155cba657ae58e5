"""Damaged files: whatever is done to one, it is read, or refused in a sentence that names it.

``FUZZ_SEED`` sets the first seed, ``FUZZ_CASES`` the number of damages to each kind of file.
"""

import json
import os
import random
import re
from pathlib import Path

import pytest
from synthetic_joint import synthetic_joint

from apu_casadi.core import results
from apu_casadi.core.errors import ApuError, ApuWarning, DataError, ScenarioError
from apu_casadi.gaspath.calibration import read_points, write_points
from apu_casadi.unit import runsummary
from scenarios import registry
from scenarios.commands.calibrate import published_points
from scenarios.pages import estimation_page
from scenarios.schema import Scenario
from scenarios.studies import catalogue

SEED = int(os.environ.get("FUZZ_SEED", "0"))
CASES = int(os.environ.get("FUZZ_CASES", "150"))
LIBRARY = Path(registry.__file__).parent / "library"
KEPT = Path(__file__).parents[1] / "docs" / "estimation"


# ------------------------------------------------------------------ good files, and their readers


def read_scenario(path):
    s = Scenario.from_toml(path)
    s.events(), s.start(), s.to_json()
    return Scenario.from_dict(s.to_dict())


def read_run(path):
    return runsummary.phase_summary(results.load(path))


def read_study(path):
    study = catalogue.get("correctness")
    record = catalogue.read(study, path.parent)
    catalogue.other_code(study, record)
    return estimation_page.load(path.parent)


def write_scenario(path):
    path.write_bytes((LIBRARY / "joint.toml").read_bytes())


def write_study(path):
    """The kept one of a checkout; the wheel has none."""
    kept = KEPT / "correctness.json"
    if not kept.exists():
        pytest.skip("kept studies are part of a checkout")
    path.write_bytes(kept.read_bytes())


KINDS = {
    "scenario.toml": (write_scenario, read_scenario),
    "points.csv": (lambda path: write_points(published_points(), path), read_points),
    "run.nc": (lambda path: results.save(synthetic_joint(waveforms=False), path), read_run),
    "correctness.json": (write_study, read_study),
}


# ------------------------------------------------------------------ damage

NUMBER = re.compile(rb"(?<![\w.\"])-?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.\"])")
WORDS = (
    b"abc",
    b"nan",
    b"inf",
    b"1e300",
    b"1e-300",
    b"-7",
    b"",
    b'"5"',
    b"true",
    b"[]",
    b"2020-01-01",
)


def flip(rng, raw):
    b = bytearray(raw)
    for _ in range(rng.choice((1, 1, 3, 30))):
        b[rng.randrange(len(b))] ^= 1 << rng.randrange(8)
    return bytes(b)


def cut(rng, raw):
    a = rng.randrange(len(raw))
    return raw[:a] + raw[a + rng.choice((1, 7, 100, len(raw))) :]


def put(rng, raw):
    a = rng.randrange(len(raw))
    what = (b"\0", b'"', b"\xe9\xff", b"\r", b"[" * 3000, b"x" * 200_000, rng.randbytes(20))
    return raw[:a] + rng.choice(what) + raw[a:]


def number(rng, raw):
    found = list(NUMBER.finditer(raw))
    m = rng.choice(found) if found else None
    return raw[: m.start()] + rng.choice(WORDS) + raw[m.end() :] if m else cut(rng, raw)


def lines(rng, raw):
    rows = raw.split(b"\n")
    i, j = rng.randrange(len(rows)), rng.randrange(len(rows))
    way = rng.randrange(3)
    if way == 0:
        rows[i], rows[j] = rows[j], rows[i]
    elif way == 1:
        rows.insert(i, rows[j])
    else:
        del rows[i]
    return b"\n".join(rows)


def whole(rng, raw):
    ways = (b"", b" \n", raw + raw, b"\xef\xbb\xbf" + raw, raw.replace(b"\n", b"\r\n"))
    return rng.choice((*ways, raw.decode("latin-1").encode("utf-16")))


DAMAGE = (flip, cut, put, number, number, lines, whole)


def damaged_files_are_read_or_refused(name, folder, seeds):
    write, read = KINDS[name]
    path = folder / name
    write(path)
    raw = path.read_bytes()
    for seed in seeds:
        rng = random.Random(seed)
        damage = rng.choice(DAMAGE)
        path.write_bytes(damage(rng, raw))
        told = f"seed {seed}: {damage.__name__} of {name}"
        try:
            read(path)
        except (ApuError, ApuWarning) as e:  # refused, or read with a note
            assert name in str(e), f"{told}: the message does not name the file: {e}"
        except Exception as e:
            raise AssertionError(f"{told}: {type(e).__name__}: {e}") from e


@pytest.mark.long
@pytest.mark.parametrize("name", list(KINDS))
def test_damaged_files(tmp_path, name):
    n = CASES // 3 if name.endswith(".nc") else CASES  # reading netCDF takes longest
    damaged_files_are_read_or_refused(name, tmp_path, range(SEED, SEED + n))


@pytest.mark.slow  # a minute or two: the same, twenty times as many
@pytest.mark.parametrize("name", list(KINDS))
def test_many_damaged_files(tmp_path, name):
    seeds = range(SEED + 10_000, SEED + 10_000 + 20 * CASES)
    damaged_files_are_read_or_refused(name, tmp_path, seeds)


# ------------------------------------------------------------------ what must be refused


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 5000 + "]" * 5000, "nested too deeply"),
        (".".join(["a"] * 3000) + " = 1", "nested too deeply"),
        ('"machine.r_s" = 2020-01-01', "parameters.machine.r_s: a number is expected"),
        ('"machine.r_s" = [1, 2]', "a number is expected"),
        ('"machine.r_s" = true', "a number is expected, got True"),
        ('"machine.r_s" = nan', "must be finite"),
        ('"machine.r_s" = 1' + "0" * 5000, "s.toml: "),
    ],
)
def test_parameters_of_a_scenario(tmp_path, text, words):
    path = tmp_path / "s.toml"
    write_scenario(path)
    path.write_text(f"{path.read_text()}\n[parameters]\n{text}\n")
    with pytest.raises(ScenarioError, match=re.escape(words)) as e:
        read_scenario(path)
    assert str(e.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import sys\nsys.exit(0)", "SystemExit at line 2: the file ends the program, with status"),
        ("raise SystemExit", "SystemExit at line 1: the file ends the program, with status None"),
        ("def f(): f()\nf()", "RecursionError at line 1"),
        ("\nraise GeneratorExit('x')", "GeneratorExit at line 2: x"),
        ("x = (", "SyntaxError at line 1"),
    ],
)  # fmt: skip
def test_a_python_scenario_cannot_end_the_command(tmp_path, capsys, monkeypatch, code, words):
    from scenarios import cli

    monkeypatch.chdir(tmp_path)
    Path("s.py").write_text(code)
    assert cli.main(["run", "s.py"]) == 2
    assert f"apu: error: s.py: {words}" in capsys.readouterr().err


def test_an_interrupt_of_a_python_scenario_is_one(tmp_path):
    path = tmp_path / "s.py"
    path.write_text("raise KeyboardInterrupt")
    with pytest.raises(KeyboardInterrupt):
        registry.get(path)


def test_results_of_other_than_numbers(tmp_path):
    path = tmp_path / "x.nc"
    ds = synthetic_joint(waveforms=False)
    for wrong, words in (
        (ds.assign(T4=ds["T4"].astype(str)), "T4: numbers on time are expected"),
        (ds.assign(T4=ds["T4"] * float("nan")), "T4 = nan at t = 0 s is no finite number"),
        (ds.assign_coords(time=ds["time"] * 0), "'time' does not increase"),
        (ds.assign_attrs(phases="{"), "attribute 'phases'"),
    ):
        results.save(wrong, path)
        with pytest.raises(DataError, match=re.escape(f"{path}: ")) as e:
            read_run(path)
        assert words in str(e.value)


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda ds: ds.drop_vars("W2"), "the trajectory lacks W2"),
        (lambda ds: ds.assign(W2=ds["W2"].astype(str)), "other than numbers over time in W2"),
        (lambda ds: ds.isel(time=0), "lacks a 'time' coordinate"),
    ],
)
def test_a_file_that_is_no_run_is_not_drawn(tmp_path, monkeypatch, capsys, change, words):
    from scenarios import cli

    monkeypatch.chdir(tmp_path)
    ds = synthetic_joint(waveforms=False)
    ds = ds.assign(W2=ds["T4"], T2=ds["T4"], P2=ds["P3"], PR_c=ds["T4"])
    results.save(change(ds), "x.nc")
    assert cli.main(["maps", "--trajectory", "x.nc", "--no-lines"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("apu: error: x.nc: ") and words in err


def test_a_study_that_lacks_a_part_of_itself(tmp_path, caplog):
    """What cannot be read at all is refused; a damaged part is left out, told, and made again."""
    path = tmp_path / "correctness.json"
    write_study(path)
    good = json.loads(path.read_text())
    part = next(iter(good["parts"]))
    path.write_text(json.dumps({**good, "parts": []}))
    with pytest.raises(DataError, match=r"correctness\.json: no table 'parts'"):
        read_study(path)
    for damaged, words in (
        (5, "no table"),
        ({**good["parts"][part], "seeds": "x"}, "its seeds are 'x'"),
        ({k: v for k, v in good["parts"][part].items() if k != "result"}, "it has no result"),
    ):
        path.write_text(json.dumps({**good, "parts": {**good["parts"], part: damaged}}))
        caplog.clear()
        record = catalogue.read(catalogue.get("correctness"), tmp_path)
        assert set(record["parts"]) == set(good["parts"]) - {part}
        assert f"part {part!r} is left out: {words}" in caplog.text
    # without the sum of its numbers, as files of before have none: with it the part is left out
    empty = {k: v for k, v in good["parts"][part].items() if k != "sum"} | {"result": {}}
    path.write_text(json.dumps({**good, "parts": {**good["parts"], part: empty}}))
    with pytest.raises(DataError, match="correctness"):
        estimation_page.pictures(estimation_page.load(tmp_path))
