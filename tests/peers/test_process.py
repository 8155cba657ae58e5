"""Peers run in processes of their own, and their failures speak."""

import json
import sys
import time

import pytest

from apu_casadi.core.errors import SimulationError
from scenarios.cli import main
from scenarios.validation.peers import cycle, process


def test_a_failing_peer_is_reported_with_what_it_said(tmp_path, monkeypatch):
    """Exit status and the end of the error stream are in the message."""
    (tmp_path / "bad.py").write_text("import sys; sys.exit('boom 42')")
    monkeypatch.setattr(process, "__file__", str(tmp_path / "process.py"))
    with pytest.raises(SimulationError, match=r"bad.py under .* ended with 1: boom 42"):
        process.run_script(sys.executable, "bad.py", {})
    with pytest.raises(SimulationError, match=r"bad.py under /no/python"):
        process.run_script("/no/python", "bad.py", {})


def test_the_answer_is_json_and_the_folder_a_temporary_one(tmp_path, monkeypatch):
    """The script reads the case and runs elsewhere than the caller."""
    script = "import json, os, sys; json.dump([json.load(sys.stdin), os.getcwd()], sys.stdout)"
    (tmp_path / "echo.py").write_text(script)
    monkeypatch.setattr(process, "__file__", str(tmp_path / "process.py"))
    monkeypatch.chdir(tmp_path)
    case, folder = process.run_script(sys.executable, "echo.py", {"a": 1.5})
    assert case == {"a": 1.5}
    assert folder != str(tmp_path)


def test_scripts_that_run_side_by_side_end_when_one_fails_or_the_caller_is_interrupted(
    tmp_path, monkeypatch
):
    """One script fails at once, the other would sleep for five minutes."""
    script = "import json, sys, time; time.sleep(300) if json.load(sys.stdin) else sys.exit('no')"
    (tmp_path / "pycycle_run.py").write_text(script)
    monkeypatch.setattr(process, "__file__", str(tmp_path / "process.py"))
    monkeypatch.setattr(cycle, "interpreter", lambda: sys.executable)
    monkeypatch.setattr(cycle, "pycycle_case", lambda gg, i: {"sleep": 1} if i == "slow" else {})
    began = time.monotonic()
    with pytest.raises(SimulationError, match="ended with 1: no"):
        cycle.run_pycycle(None, "fails", "slow")
    assert time.monotonic() - began < 100 and not process._RUNNING  # s; of 300


def test_validate_reports_a_skipped_section(capsys, monkeypatch):
    """``--only`` asks for it, so the status is 1; the reason is printed and in the JSON."""
    monkeypatch.delenv(cycle.VARIABLE, raising=False)
    assert main(["validate", "--only", "pycycle"]) == 1
    assert (
        f"skipped: no Python with pyCycle is named: set {cycle.VARIABLE}" in capsys.readouterr().out
    )
    assert main(["validate", "--only", "pycycle", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["rows"] == 0
    assert cycle.VARIABLE in report["skipped"]["pycycle"]
