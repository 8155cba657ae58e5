"""Notebooks are thin, are stored without outputs, and run."""

import json
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def read(path):
    return json.loads(path.read_text(encoding="utf-8"))


def test_there_are_notebooks():
    """An empty list would let every test below pass."""
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_stored_without_outputs(path):
    """Outputs are made by running; stored ones age, and make every difference unreadable."""
    for k, cell in enumerate(read(path)["cells"], 1):
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [], f"{path.name}, cell {k} has outputs: strip them"
            assert cell["execution_count"] is None, f"{path.name}, cell {k} has a count: strip it"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_thin(path):
    """House rule: under fifteen cells, no ``def``; notebooks show, modules do."""
    cells = read(path)["cells"]
    assert len(cells) < 15
    for cell in cells:
        if cell["cell_type"] == "code":
            lines = "".join(cell["source"]).splitlines()
            bad = [x for x in lines if x.lstrip().startswith(("def ", "class ", "async def "))]
            assert not bad, f"{path.name} defines {bad}"


@pytest.mark.ci  # a kernel and a fresh interpreter for each: half a minute
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_runs(path, tmp_path, monkeypatch):
    """Every cell runs in a fresh kernel of this interpreter, in an empty folder."""
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    kernel = tmp_path / "kernels" / "here"
    kernel.mkdir(parents=True)
    argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec = {"argv": argv, "display_name": "here", "language": "python"}
    (kernel / "kernel.json").write_text(json.dumps(spec), encoding="utf-8")
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path))
    # a folder of this run alone, so that nothing of the user's own setup is read or written
    for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=120, kernel_name="here", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    figures = [
        o
        for cell in notebook.cells
        if cell.cell_type == "code"
        for o in cell.outputs
        if "image/png" in o.get("data", {})
    ]
    assert figures, "the notebook shows no figure"
