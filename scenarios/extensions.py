"""Parts of a user's own: Python files that register loads, faults, sensors, governors, engines.

A file is named by ``--with FILE`` or by ``extensions = ["my_parts.py"]`` in a scenario.  It is run
once in a process, before anything is read that may name its parts::

    from apu_casadi.machine.loads.load import LOADS, Load

    @LOADS.add("battery")
    class BatteryLoad(Load):
        ...

Such a file runs with your rights, like any program: load only what you trust.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

from apu_casadi.core import files
from apu_casadi.core.errors import ApuError, DataError, ScenarioError

LARGEST_FILE = 1 << 24
"""Largest file that is read, bytes."""

_LOADED: dict[str, str] = {}  # SHA-256 of the files that were run, by path


def load(paths: Iterable[str | os.PathLike[str]]) -> None:
    """Run the files that were not run before, or that have changed since.

    Raises:
        ScenarioError: no such file, or an error inside it, with its line.
    """
    for path in paths:
        absolute = os.path.abspath(path)
        content = digest(path)
        if _LOADED.get(absolute) != content:
            # a module of its own, since dataclasses and pickle look for the one of a class
            stem = "".join(c if c.isalnum() else "_" for c in Path(path).stem)
            execute(path, f"apu_extension_{stem}_{abs(hash(absolute)) % 10**8}")
            _LOADED[absolute] = content


def digest(path: str | os.PathLike[str], what: str = "Python file") -> str:
    """Return the SHA-256 of a file's content; ``what`` it is, for messages.

    Raises:
        ScenarioError: it cannot be read.
    """
    return hashlib.sha256(_read(path, what)).hexdigest()


def execute(path: str | os.PathLike[str], name: str, what: str = "Python file") -> dict[str, Any]:
    """Run a Python file as the module ``name``; return its names.

    Raises:
        ScenarioError: no such file, or an error inside it, with its line.
    """
    code = _read(path, what)
    module = ModuleType(name)
    module.__file__ = str(path)
    before = sys.modules.get(name)
    sys.modules[name] = module
    try:
        exec(compile(code, str(path), "exec"), vars(module))
    except KeyboardInterrupt:
        raise
    except BaseException as e:  # SystemExit too: it would pass for the end of the command
        sys.modules.pop(name)
        if before is not None:
            sys.modules[name] = before
        said = f"{type(e).__name__}{_at_line(e, path)}: {e}"
        if isinstance(e, ScenarioError):
            said = f"{e}{_at_line(e, path)}"
        elif isinstance(e, SystemExit):
            ends = f"the file ends the program, with status {e.code!r}; remove that"
            said = f"{type(e).__name__}{_at_line(e, path)}: {ends}"
        raise ScenarioError(f"{path}: {said}") from (e if not isinstance(e, ApuError) else None)
    return vars(module)


def _read(path: str | os.PathLike[str], what: str) -> bytes:
    try:
        return files.read_bytes(path, what, LARGEST_FILE)
    except DataError as e:
        raise ScenarioError(str(e)) from None


def _at_line(e: BaseException, path: str | os.PathLike[str]) -> str:
    """Return the innermost line of a file in a traceback, or of a syntax error, as words."""
    line = getattr(e, "lineno", None)
    tb: TracebackType | None = e.__traceback__
    while tb is not None:
        if tb.tb_frame.f_code.co_filename == str(path):
            line = tb.tb_lineno
        tb = tb.tb_next
    return f" at line {line}" if line else ""
