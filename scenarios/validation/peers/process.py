"""Run a peer's script in a process of its own: JSON in, JSON out."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from apu_casadi.core.errors import SimulationError

TIMEOUT = 900.0  # s; the slowest takes one minute
_RUNNING: list[subprocess.Popen[str]] = []


def run_script(python: str, script: str, case: dict[str, Any]) -> dict[str, Any]:
    """Run ``scenarios/validation/peers/<script>`` under another Python and return its answer.

    A process of its own keeps the peer's prints, log folders (the working directory is a
    temporary one), warnings and package versions away from ours; ``-I`` keeps our modules away
    from it.  Warnings are not shown: OpenMDAO gives hundreds about bounds met by first iterates.
    What counts is checked by the scripts, which fail where a solution does not converge.

    Args:
        python: interpreter that has the peer.
        script: file name in this folder.
        case: what the script reads as JSON.

    Raises:
        SimulationError: it did not end well; holds the end of what it said.
    """
    path = Path(__file__).parent / script
    with tempfile.TemporaryDirectory() as folder:
        try:
            status, out, err = _run([python, "-I", "-W", "ignore", str(path)], case, folder)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise SimulationError(f"{script} under {python}: {error}") from None
    if status:
        raise SimulationError(f"{script} under {python} ended with {status}: {err.strip()[-800:]}")
    answer: dict[str, Any] = json.loads(out)
    return answer


def _run(command: list[str], case: dict[str, Any], folder: str) -> tuple[int, str, str]:
    """Run a command; return its status and what it wrote.  It never outlives this call."""
    pipe = subprocess.PIPE
    p = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=folder)
    _RUNNING.append(p)
    try:
        out, err = p.communicate(json.dumps(case), timeout=TIMEOUT)
        return p.returncode, out, err
    finally:
        _RUNNING.remove(p)
        with p:
            p.kill()  # nothing where it has ended


def end_all() -> None:
    """End the scripts that other threads are waiting for: an interrupt reaches the main thread."""
    for p in list(_RUNNING):
        p.kill()
