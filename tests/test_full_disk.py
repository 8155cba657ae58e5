"""A disk that gets full, over all commands that write: nothing damaged stays, the error tells all.

The limit on the size of a file stands for the end of the disk: the system's own calls fail, also
those of libraries in C.  A file that was cut off would be exactly as long as the limit.
"""

import argparse
import errno
import os
import re
import shutil
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from apu_casadi.core import files
from apu_casadi.core.errors import DataError
from apu_casadi.gaspath.calibration import write_points
from scenarios import cli
from scenarios.commands.calibrate import published_points

resource = pytest.importorskip("resource", reason="limits of a process are POSIX's")
LIMIT = 600

FORMATS = ["nc", "nc4", "csv", "parquet", "mat"]
_RUN, _FIT = "run quiet --quiet", "calibrate --free compressor_map.n_Re POINTS"
QUICK = {
    "deck": "deck --power 1e5:2e5:9 --out OUT/d.nc",
    "linearise --save nc": "linearise --no-figures --out OUT --save OUT/l.nc",
    "linearise --save mat": "linearise --no-figures --out OUT --save OUT/l.mat",
    "linearise": "linearise --out OUT",
    "export c": "export c f --out OUT",
    "export fmu": "export fmu gas_generator --out OUT/g.fmu",
}
LONG = {
    **{f"run --format {f}": f"{_RUN} --no-figures --format {f} --out OUT" for f in FORMATS},
    **{f"measure {e}": f"measure RUN --out OUT/m.{e}" for e in ("csv", "parquet", "nc")},
    "calibrate --write-points": f"{_FIT} --write-points OUT/p.csv",
    "calibrate --write-engine": f"{_FIT} --write-engine OUT/e.toml",
    **{f"run --figures {f}": f"{_RUN} --figures={f} --out OUT" for f in ("png", "svg", "pdf")},
    "campaign": "campaign --runs 1 --workers 1 --out OUT",
    "dataset make": "dataset make --units 1 --workers 1 --quiet --out OUT",
    "estimate data": "estimate data GAS --out OUT",
    "maps": "maps --out OUT",
}
"""Commands by what they write; OUT, RUN, GAS and POINTS are files and folders."""
MINUTES = {
    *(f"estimate {w}" for w in ("joint", "study", "page")),
    *("bench", "dataset baseline", "dataset page", "errata", "multirate", "tune", "validate"),
}
"""Commands that take minutes before they write; by the same functions, as the last test sees."""
WRITING = {"out", "write", "save", "page", "write_points", "write_engine"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run, a recording of it, and points of a bench, for commands that read some."""
    folder = tmp_path_factory.mktemp("made")
    assert cli.main(f"run quiet --quiet --no-figures --out {folder}/q".split()) == 0
    assert cli.main(f"measure {folder}/q/quiet.nc --seed 3 --out {folder}/m.csv".split()) == 0
    write_points(published_points(), folder / "p.csv")
    return {
        "RUN": f"{folder}/q/quiet.nc",
        "GAS": f"{folder}/m_gaspath.csv",
        "POINTS": f"{folder}/p.csv",
    }


@pytest.fixture
def full():
    """No file may grow beyond ``LIMIT``."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(n, marks=pytest.mark.long) for n in LONG)])
def test_nothing_damaged_stays(tmp_path, request, capsys, name):
    words = (QUICK | LONG)[name].split()
    needs = {"RUN", "GAS", "POINTS"} & set(words)
    made = request.getfixturevalue("made") if needs else {}
    request.getfixturevalue("full")
    for key, place in {**made, "OUT": str(tmp_path / "out")}.items():
        words = [w.replace(key, place) for w in words]
    status = cli.main(words)
    err = capsys.readouterr().err
    assert status == 2, err
    assert "File too large" in err or "Disk quota" in err, err
    place = tempfile.gettempdir() if name == "export fmu" else str(tmp_path / "out")
    assert place in err, err
    left = {
        str(p.relative_to(tmp_path)): p.stat().st_size for p in tmp_path.rglob("*") if p.is_file()
    }
    assert all(size < LIMIT for size in left.values()), left
    assert not [n for n in left if n.endswith(".part")], left
    assert not files.PARTIAL


def test_how_much_is_told(tmp_path, full):
    with pytest.raises(DataError) as e:
        files.write_text(tmp_path / "page.md", "x" * 5000)
    assert "page.md: cannot be written: File too large; the limit on the size" in str(e.value)
    assert f"({LIMIT} bytes of it were written, " in str(e.value) and "free there)" in str(e.value)


def test_no_space_is_told_with_what_is_free(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda place: argparse.Namespace(free=12))
    words = r"No space left .* \(4 bytes of it were written, 12 bytes are free there\)"
    with pytest.raises(DataError, match=words), files.whole(tmp_path / "x") as part:
        part.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert not list(tmp_path.iterdir())


def test_every_command_that_writes_is_in_the_table():
    parser = cli.parser()
    found = set()

    def walk(p, name):
        for a in p._actions:
            if isinstance(a, argparse._SubParsersAction):
                for word, sub in a.choices.items():
                    walk(sub, f"{name} {word}".strip())
            elif a.dest in WRITING:
                found.add(name)

    walk(parser, "")
    tried = {*QUICK, *LONG, *MINUTES}
    missing = {n for n in found if not any(t.startswith(n) for t in tried)}
    assert not missing


def test_nothing_is_written_past_the_functions_that_write_whole_files():
    """Modules that call a writer of Python or of a library: all inside ``whole``, or temporary."""
    calls = re.compile(
        r"(?<!files)(?<!markdown)\.(write_text|write_bytes|savefig|to_parquet|to_netcdf)\("
    )
    root, found = Path(find_spec("apu_casadi").origin).parents[1], set()
    for top in ("apu_casadi", "estimators", "scenarios"):
        for path in (root / top).rglob("*.py"):
            if calls.search(path.read_text(encoding="utf-8")):
                found.add(path.name)
    inside = {"files.py", "resultformats.py", "making.py", "campaign_records.py", "figstyle.py"}
    temporary = {"backend.py", "fmu.py", "netcdf3.py"}
    assert found == inside | temporary
