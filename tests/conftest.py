"""What holds for all tests.

Most run in CasADi's virtual machine: the C compiler would take longer than they do, and compiled
code gives the same numbers.  Marked ``compiled`` are those about compiled code itself; those marked
``ci`` take it as well.  ``APU_BACKEND=auto pytest`` compiles in all of them.
"""

import hashlib
import os
import sys
import weakref
from pathlib import Path

import pytest

# most of the time of a first run is the C compiler's; what is tested here is not speed
os.environ.setdefault("APU_OPTIMISE", "1")
# small matrices: threads of the linear algebra only take the cores from other workers
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# files tell when they were made; here all at one instant
os.environ.setdefault("SOURCE_DATE_EPOCH", "1700000000")
PARTS = Path(__file__).with_name("extension_parts.py")
GIVEN = os.environ.get("APU_BACKEND")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Choose the backend before any fixture is made; processes that a test starts inherit it."""
    marked = any(item.get_closest_marker(name) for name in ("compiled", "ci"))
    os.environ["APU_BACKEND"] = GIVEN or ("auto" if marked else "vm")


@pytest.fixture
def asked(monkeypatch):
    """Contents of the functions whose compiled form is asked for; none is compiled.

    What is made meanwhile is forgotten afterwards.
    """
    from apu_casadi.core import backend, sharing

    found = set()

    def note(fun, wanted, build, level):
        found.add(hashlib.sha256(fun.serialize().encode()).hexdigest())
        return fun

    monkeypatch.setenv("APU_BACKEND", "c")
    monkeypatch.setattr(sharing, "_stores", weakref.WeakValueDictionary())
    monkeypatch.setattr(sharing, "_recent", {})
    monkeypatch.setattr(backend, "_find_or_make", note)
    monkeypatch.setattr(backend, "_library", lambda *given: None)
    monkeypatch.setattr(backend, "_load", lambda name, key: None)
    monkeypatch.setattr(backend, "_toolchain", lambda wanted: (sys.executable,))
    return found


@pytest.fixture(scope="module")
def mine():
    """What the user's file ``extension_parts.py`` defines, loaded as a command loads it."""
    from apu_casadi.machine.faults.fault import FAULTS
    from apu_casadi.machine.loads.load import LOADS
    from apu_casadi.unit.control import GOVERNORS
    from estimators.apu.sensors import register, unregister
    from scenarios import extensions

    extensions.load([PARTS])
    names = vars(sys.modules[LOADS["my_RC"].__module__])
    assert (names["MyFieldShort"], names["MyGovernor"]) == (FAULTS["my_field"], GOVERNORS["my_PID"])
    sensors = (names["T41_MINE"], names["DP_MINE"])
    for s in sensors:  # again: a file is run once, tests of other files come between
        register(s)
    yield names
    for s in sensors:
        unregister(s.name)
