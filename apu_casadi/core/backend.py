"""One backend switch for every hot function: CasADi's virtual machine, or compiled C.

:func:`compiled` returns a function that does the same as its argument, faster where a C compiler
is found.  The library is compiled once and kept in the user's cache folder under a name that is a
hash of everything it depends on, so that a change of content gives another name; it is loaded
afterwards without asking the compiler.  Where there is no compiler, or it fails, the argument
itself comes back, with one line in the log ``apu_casadi``.

Environment: ``APU_BACKEND`` is ``auto`` (default), ``vm`` or ``c`` (refuse to fall back);
``APU_CACHE_DIR`` is the folder of the libraries, by default ``$XDG_CACHE_HOME/apu_casadi`` or
``~/.cache/apu_casadi``; ``CC`` is the compiler, by default ``cc``, ``gcc`` or ``clang``;
``APU_OPTIMISE`` (1 to 3, default 3) is the highest level of its optimisation.

Failures inside a function become NaN or a large residual in C as in the virtual machine, and must
be looked for by the caller: ``error_on_fail`` has no effect in generated code.

Threads may use everything here at once.  Functions are built, compiled and loaded one at a time;
:class:`~apu_casadi.core.calling.Caller` and its batch form have buffers for each thread.  A
library is closed when nothing uses it any more (:mod:`apu_casadi.core.sharing`).  Which folders
are trusted is told in :mod:`apu_casadi.core.cachefolder`.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import weakref
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from contextvars import ContextVar, Token
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.cachefolder import SUFFIX, cache_folder, say, unsafe_file
from apu_casadi.core.calling import Caller, Mapped, available_threads, mapped
from apu_casadi.core.errors import BackendError, nearest
from apu_casadi.core.sharing import BUILDING

__all__ = [
    "Caller",
    "Code",
    "Gradual",
    "Mapped",
    "available_threads",
    "backend_in_use",
    "cache_folder",
    "compiled",
    "find_compiler",
    "library",
    "load_library",
    "load_or_build",
    "loaded_functions",
    "mapped",
    "package_digest",
    "rarely",
    "recipe",
    "use_backend",
]

log: logging.Logger = logging.getLogger("apu_casadi")

BACKENDS = ("auto", "vm", "c")
FLAGS: tuple[str, ...] = ("-fPIC", "-shared", "-fno-math-errno")  # NaN must survive
if platform.machine() not in ("x86_64", "AMD64"):
    FLAGS += ("-ffp-contract=off",)  # elsewhere compilers fuse products and sums unasked
LEVELS = (1, 2, 3)  # -O1, -O2, -O3
COMPILE_TIMEOUT = 900.0  # s
OFTEN = 50  # calls that are enough for a :class:`Gradual` function to be compiled
READY = "ready"  # as an argument: the library that is there, else the virtual machine
RARELY = 30  # uses from which on what is used rarely is compiled, too

_chosen: list[use_backend | None] = [None]  # the last one is the choice of the process
_here: ContextVar[str | None] = ContextVar("apu_backend", default=None)  # of a ``with`` block
#: Compiled forms of a function, and loaded libraries by key, while something uses them.
_compiled: weakref.WeakKeyDictionary[ca.Function, dict[tuple[str, int], ca.Function]] = (
    weakref.WeakKeyDictionary()
)
_loaded: weakref.WeakValueDictionary[str, ca.Function] = weakref.WeakValueDictionary()
_failed: dict[str, str] = {}
_uses: Counter[str] = Counter()
_MANY = 256  # failures remembered


# ------------------------------------------------------------------------------ the switch


class use_backend:  # noqa: N801 - reads as a verb: use_backend("vm"), with use_backend("vm"): ...
    """Choose the backend for this process, or for a ``with`` block.

    Called, it is the choice of all threads.  A ``with`` block chooses for its own thread only (its
    context, to be exact: threads and tasks that it starts begin with the choice of the process), so
    that threads with different choices do not disturb each other.

    Args:
        name: ``"auto"``, ``"vm"`` or ``"c"``; None returns to ``$APU_BACKEND``.

    Raises:
        BackendError: unknown name.
    """

    def __init__(self, name: str | None) -> None:
        self._name = None if name is None else _valid(name, "use_backend")
        _chosen.append(self)
        del _chosen[:-_MANY]

    def __enter__(self) -> use_backend:
        """Take the choice back from the process, and make it here."""
        with suppress(ValueError):
            _chosen.remove(self)
        wanted = self._name or os.environ.get("APU_BACKEND") or "auto"
        self._token: Token[str | None] = _here.set(wanted)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        _here.reset(self._token)


def _valid(name: str, where: str) -> str:
    if name not in BACKENDS:
        raise BackendError(f"{where}: unknown backend {name!r} {nearest(str(name), BACKENDS)}")
    return name


def _wanted(backend: str | None) -> str:
    if backend is not None:
        return _valid(backend, "backend")
    last = _chosen[-1]
    chosen = _here.get() or (last._name if last is not None else None)
    return _valid(chosen or os.environ.get("APU_BACKEND") or "auto", "APU_BACKEND")


def backend_in_use() -> str:
    """Return ``"c"`` or ``"vm"``: what :func:`compiled` would use for a new function now.

    Raises:
        BackendError: ``$APU_BACKEND`` is none of the known names.
    """
    wanted = _wanted(None)
    if wanted == "c":
        return "c"
    return "c" if wanted == "auto" and find_compiler() else "vm"


# ------------------------------------------------------------------------------ compiler


def find_compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler: ``$CC``, else cc, gcc or clang on ``PATH``; or None."""
    return _find_compiler(os.environ.get("CC", ""), os.environ.get("PATH", ""))


@lru_cache(maxsize=8)
def _find_compiler(cc: str, path: str) -> tuple[str, ...] | None:
    for name, *options in _commands(cc):
        found = shutil.which(name, path=path)
        if found:
            return (found, *options)
    return None


def _commands(cc: str) -> list[list[str]]:
    """Return how ``$CC`` can be meant: one path with blanks, or words, quoted or not."""
    if not cc.strip():
        return [["cc"], ["gcc"], ["clang"]]
    ways = [[cc.strip()]]
    if os.name == "posix":
        with suppress(ValueError):  # quotes that are not closed
            ways.append(shlex.split(cc))
    return [w for w in (*ways, cc.split()) if w]


@lru_cache(maxsize=8)
def _identity(command: tuple[str, ...]) -> str:
    """Tell one compiler from another without running it: real path, size, date."""
    real = Path(command[0]).resolve()
    s = real.stat()
    return f"{real} {s.st_size} {s.st_mtime_ns} {' '.join(command[1:])}"


# ------------------------------------------------------------------------------ compile and load


def compiled(
    fun: ca.Function, *, backend: str | None = None, build: bool = True, level: int = 1
) -> ca.Function:
    """Return ``fun`` compiled from generated C, or ``fun`` itself in the virtual machine.

    The second call with the same function costs nothing.

    Args:
        fun: any function whose parts generate C (``fast_newton``, ``rosenbrock``, ``erk``,
            ``bspline`` and ``map`` do; ``cvodes``, ``idas``, ``newton`` and ``kinsol`` do not).
        backend: overrides the backend in use; ``"ready"`` is that in use, without ``build``.
        build: compile if no library is found; False only loads, which suits a single short call.
        level: how hard the C compiler optimises, 1 to 3.  Long straight-line code, a filter's block
            or a trim, runs as fast at 1 and compiles in half the time; short bodies in loops over
            many samples gain up to a third from 3.

    Raises:
        BackendError: ``backend="c"`` was demanded and there is no compiler, no folder for the
            library, or the compiler failed; no such level, also in ``$APU_OPTIMISE``, the highest.
    """
    if level not in LEVELS:
        raise BackendError(f"{fun.name()}: level must be one of {LEVELS}, got {level!r}")
    wanted = _wanted(None if backend == READY else backend)
    if wanted == "vm":
        return fun
    level = min(level, _ceiling())
    known = _compiled.get(fun, {}).get((wanted, level))
    if known is not None:
        return known
    with BUILDING:
        return _find_or_make(fun, wanted, build and backend != READY, level)


def rarely(what: str) -> str | None:
    """Return the backend of something that is done once in a while, by functions of its own.

    To compile them would take longer than to do it: only libraries that are there are used, up to
    the thirtieth time in this process.  Each of ``what`` is counted for itself.
    """
    _uses[what] += 1
    return READY if _uses[what] < RARELY else None


class Gradual:
    """A :class:`Caller` that compiles its function when it has been called often.

    A few steps between longer blocks then need no compiler: it takes seconds, and they some
    milliseconds each in the virtual machine.  A library that is there is loaded at once.

    Args:
        fun, level: as for :func:`compiled`.
        copy: as for :class:`Caller`.
        by: what compiles, called as :func:`compiled`, which it is by default.
        often: calls that are enough.
    """

    def __init__(
        self,
        fun: ca.Function,
        *,
        level: int = 1,
        copy: bool = True,
        by: Callable[..., ca.Function] = compiled,
        often: int = OFTEN,
    ) -> None:
        self._often = often
        self._fun, self._level, self._copy, self._calls = fun, level, copy, 0
        self._by = by
        self._call = self._made(build=False)

    def _made(self, *, build: bool) -> Caller:
        return Caller(self._by(self._fun, build=build, level=self._level), copy=self._copy)

    @property
    def inputs(self) -> list[np.ndarray]:
        """Input buffers of this thread; see :class:`Caller`."""
        return self._call.inputs

    def __call__(self, *arrays: np.ndarray | float) -> tuple[np.ndarray, ...]:
        """Evaluate."""
        if self._calls < self._often:
            self._calls += 1
            if self._calls == self._often and self._call.fun is self._fun:
                self._call = self._made(build=True)
        return self._call(*arrays)


def _ceiling() -> int:
    """Return the highest level that ``$APU_OPTIMISE`` leaves: 1 compiles twice as fast as 3."""
    text = os.environ.get("APU_OPTIMISE", str(LEVELS[-1]))
    if text not in map(str, LEVELS):
        raise BackendError(f"$APU_OPTIMISE = {text!r}: one of {LEVELS} is expected")
    return int(text)


def _find_or_make(fun: ca.Function, wanted: str, build: bool, level: int) -> ca.Function:
    known = _compiled.get(fun, {}).get((wanted, level))
    if known is not None:
        return known
    made = _library(_own_code(fun), wanted, build, level)
    if made is None:
        return fun
    _compiled.setdefault(fun, {})[wanted, level] = made
    return made


def _own_code(fun: ca.Function) -> Code:
    """Return the C that CasADi writes for a function."""

    def write() -> str:
        generator = ca.CodeGenerator(f"{fun.name()}.c", {"with_header": False})
        generator.add(fun)
        text: str = generator.dump()
        return text

    return Code(fun.name(), f"{fun.name()}\n{fun.serialize()}", write)


class Code(NamedTuple):
    """C code of a function that CasADi loads as ``external``.

    Args:
        name: of the function.
        content: all that the code depends on, beside compiler, flags and CasADi.
        write: returns the code; asked only if there is no library.
        flags: of the compiler, beside ``FLAGS``.
    """

    name: str
    content: str
    write: Callable[[], str]
    flags: tuple[str, ...] = ()


def library(
    code: Code, *, backend: str | None = None, build: bool = True, level: int = 1
) -> ca.Function | None:
    """Return the function of a library, from the cache or compiled now; None if there is none.

    Arguments and errors as of :func:`compiled`, which is this for the C that CasADi writes.
    """
    wanted = _wanted(backend)
    if wanted == "vm":
        return None
    with BUILDING:
        return _library(code, wanted, build, min(level, _ceiling()))


def _library(code: Code, wanted: str, build: bool, level: int) -> ca.Function | None:
    command = _toolchain(wanted)
    if command is None:
        return None
    key = _key_of(code, command, level)
    made = _load(code.name, key)
    if made is None and build:
        made = _make(code, key, (*command, f"-O{level}", *FLAGS, *code.flags), wanted)
    return made


def load_or_build(
    recipe: str,
    build: Callable[[], ca.Function],
    *,
    compile_missing: bool = True,
) -> ca.Function:
    """Return the compiled function of a recipe, without building its expressions when it is known.

    Building the expression graph of a large model takes longer than anything that is done with it
    once.  The recipe stands for the graph: a hash, by :func:`recipe`, of all that the graph is made
    from, so that a new process can go straight to the library.

    Args:
        recipe: hash of what the function is made from.
        build: makes the function; called only if the recipe is not known here, or in the virtual
            machine.
        compile_missing: compile if no library is found; False only loads.

    Raises:
        BackendError: as in :func:`compiled`.
    """
    wanted = _wanted(None)
    with BUILDING:
        fun: list[ca.Function] = []

        def built() -> ca.Function:
            fun.append(build())
            return fun[0]

        made = None
        if wanted != "vm":
            made = _recall(recipe, built, None, wanted, compile_missing)
        return made or (fun[0] if fun else build())


def load_library(
    recipe: str,
    build: Callable[[], ca.Function],
    code: Callable[[ca.Function], Code | None],
    *,
    compile_missing: bool = True,
) -> ca.Function | None:
    """Return the library of a recipe written by ``code``; None if there is none.

    Other arguments as of :func:`load_or_build`, which is this for the C that CasADi writes.
    """
    wanted = _wanted(None)
    with BUILDING:
        return None if wanted == "vm" else _recall(recipe, build, code, wanted, compile_missing)


def _recall(
    recipe: str,
    build: Callable[[], ca.Function],
    code: Callable[[ca.Function], Code | None] | None,
    wanted: str,
    compile_missing: bool,
) -> ca.Function | None:
    command, folder = _toolchain(wanted), cache_folder()
    if command is None or folder is None:
        return None
    alias = folder / f"apu-{_library_key(recipe, command)}.txt"
    with suppress(OSError, ValueError):
        if unsafe_file(alias):
            raise ValueError(alias)
        name, key = alias.read_text(encoding="utf-8").split()
        made = _load(name, key)
        if made is not None:
            return made
    if not compile_missing:
        return None
    fun = build()
    own = _own_code(fun) if code is None else code(fun)
    if own is None:
        return None
    made = _library(own, wanted, True, 1) if code else compiled(fun, backend=wanted)
    if made is not None and made is not fun:
        with suppress(OSError):
            _write(alias, f"{own.name} {_key_of(own, command, 1)}\n".encode())
    return None if made is fun else made


def recipe(*parts: object) -> str:
    """Hash the texts of ``parts`` with the sources of the package that holds this module.

    The parts must have texts (``repr``) that tell their content: dataclasses of numbers do, arrays
    and functions do not.
    """
    h = hashlib.sha256(package_digest().encode())
    for p in parts:
        h.update(b"\0" + repr(p).encode())
    return h.hexdigest()


@lru_cache(maxsize=1)
def package_digest() -> str:
    """Return a hash of all modules and data files of apu_casadi."""
    h = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(p for p in root.rglob("*") if p.suffix in (".py", ".csv", ".json")):
        h.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return h.hexdigest()


def _toolchain(wanted: str) -> tuple[str, ...] | None:
    """Return the compiler if compiled code can be made and kept; raise if it was demanded."""
    command = find_compiler()
    if command is None:
        cc = os.environ.get("CC")
        looked = f"$CC = {cc!r}" if cc else "none of cc, gcc, clang on PATH"
        if wanted == "c":
            raise BackendError(
                f"backend 'c' demanded, but no C compiler found ({looked}); install one, set CC, "
                f"or use backend 'auto'"
            )
        say(logging.INFO, f"no C compiler found ({looked}); using CasADi's virtual machine")
    elif cache_folder() is None:
        if wanted == "c":
            raise BackendError(
                "backend 'c' demanded, but no folder can be written for the libraries; set "
                "APU_CACHE_DIR"
            )
        return None
    return command


def _key_of(code: Code, command: tuple[str, ...], level: int) -> str:
    digest = hashlib.sha256(code.content.encode()).hexdigest()
    return _library_key(digest, command, level, code.flags)


def _library_key(
    content: str, command: tuple[str, ...], level: int = 1, flags: tuple[str, ...] = ()
) -> str:
    made_by = (_identity(command), f"-O{level}", *FLAGS, *flags)
    parts = (content, ca.__version__, *made_by, sys.platform, platform.machine())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:40]


def _load(name: str, key: str) -> ca.Function | None:
    """Load a library whose content is what was written; a damaged one would crash the process."""
    known = _loaded.get(key)
    if known is not None:
        return known
    folder = cache_folder()
    if folder is None:
        return None
    path, written = folder / f"apu-{key}{SUFFIX}", folder / f"apu-{key}.sum"
    try:
        for each in (written, path):
            if reason := unsafe_file(each):
                raise ValueError(f"{each.name}: {reason}")
        size, digest = written.read_text(encoding="utf-8").split()
        if path.stat().st_size != int(size):
            raise ValueError("size")
        if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise ValueError("content")
        made = _loaded[key] = ca.external(name, str(path))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RuntimeError) as e:
        say(logging.INFO, f"library {path.name} is damaged ({e}); it is compiled again")
        return None
    return made


def loaded_functions() -> list[str]:
    """Return the names of the compiled functions that something in this process uses, sorted."""
    return sorted(f.name() for f in list(_loaded.values()))


def _make(code: Code, key: str, command: tuple[str, ...], wanted: str) -> ca.Function | None:
    """Generate, compile, put in place and load; None with one warning if that fails."""
    if key in _failed and wanted != "c":
        return None
    try:
        _compile(code, key, command)
        made = _load(code.name, key)
        if made is None:
            raise BackendError("the library cannot be loaded")
    except (OSError, RuntimeError, subprocess.SubprocessError, BackendError) as e:
        why = " ".join(str(e).split())[:300]
        while len(_failed) >= _MANY:
            _failed.pop(next(iter(_failed)))
        _failed[key] = why
        if wanted == "c":
            raise BackendError(f"{code.name} could not be compiled: {why}") from e
        say(
            logging.WARNING,
            f"{code.name} could not be compiled, using CasADi's virtual machine: {why}",
        )
        return None
    return made


def _compile(code: Code, key: str, command: tuple[str, ...]) -> None:
    folder = cache_folder()
    if folder is None:
        raise BackendError("no folder for the library")
    text = code.write()
    with tempfile.TemporaryDirectory(prefix="tmp-", dir=folder) as work:
        source, library = Path(work) / "code.c", Path(work) / f"code{SUFFIX}"
        source.write_text(text, encoding="utf-8")
        # relative names: the library does not depend on where it was made
        done = subprocess.run(
            [*command, "-o", library.name, source.name, "-lm"],
            cwd=work, capture_output=True, encoding="utf-8", errors="replace",
            timeout=COMPILE_TIMEOUT, check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        if done.returncode or not library.exists():
            raise BackendError(
                f"{' '.join(command)} ended with status {done.returncode}: "
                f"{done.stderr.strip() or done.stdout.strip() or 'no message'}"
            )
        content = library.read_bytes()
        library.chmod(0o700)  # whatever the umask: what others can write to is not loaded
        # the library first: a sum without its library says only that there is none
        os.replace(library, folder / f"apu-{key}{SUFFIX}")
    digest = hashlib.sha256(content).hexdigest()
    _write(folder / f"apu-{key}.sum", f"{len(content)} {digest}\n".encode())


def _write(path: Path, content: bytes) -> None:
    """Write a file that is there completely or not at all."""
    handle, name = tempfile.mkstemp(prefix="tmp-", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as f:
            f.write(content)
        os.replace(name, path)
    except OSError:
        with suppress(OSError):
            os.unlink(name)
        raise
