"""Validation section ``dpsim``: the machine in dpsim, run live in a process of its own."""

from importlib.util import find_spec

import pytest

from scenarios.validation import comparison
from scenarios.validation.peers import machine


# not importorskip: its C++ libraries belong into the process of the script, not into this one
@pytest.mark.ci  # a fifth of a minute
@pytest.mark.skipif(find_spec("dpsimpy") is None, reason="dpsim is not installed (extra 'peers')")
def test_every_row_is_within_its_tolerance(tmp_path, monkeypatch):
    """Load steps, short circuit, faults as shunts; nothing is left in the working directory."""
    monkeypatch.chdir(tmp_path)
    rows = comparison.run("dpsim")
    assert len(rows) == 3 * len(machine.CASES) + 1
    short = [f"{r.quantity}: {r.error:+.2e} > {r.tolerance:.0e}" for r in rows if not r.passed]
    assert not short, short
    assert not list(tmp_path.iterdir())
