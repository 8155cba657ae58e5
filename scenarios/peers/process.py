"""Run a peer's script in a process of its own: JSON in, JSON out."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from apu_casadi.errors import SimulationError

TIMEOUT = 900.0  # s; the slowest takes one minute


def run_script(python: str, script: str, case: dict[str, Any]) -> dict[str, Any]:
    """Run ``scenarios/peers/<script>`` under another Python and return its answer.

    A process of its own keeps the peer's prints, log folders (the working directory is a
    temporary one), warnings and package versions away from ours; ``-I`` keeps our modules away
    from it.  Warnings are not shown: OpenMDAO gives hundreds about bounds met by first iterates.
    What counts is checked by the scripts, which fail where a solution does not converge.

    Parameters
    ----------
    python : interpreter that has the peer.
    script : file name in this folder.
    case : what the script reads as JSON.

    Raises
    ------
    SimulationError : it did not end well; holds the end of what it said.
    """
    path = Path(__file__).parent / script
    with tempfile.TemporaryDirectory() as folder:
        try:
            done = subprocess.run(
                [python, "-I", "-W", "ignore", str(path)],
                input=json.dumps(case),
                capture_output=True,
                text=True,
                cwd=folder,
                timeout=TIMEOUT,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise SimulationError(f"{script} under {python}: {error}") from None
    if done.returncode:
        raise SimulationError(
            f"{script} under {python} ended with {done.returncode}: {done.stderr.strip()[-800:]}"
        )
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer
