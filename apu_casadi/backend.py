"""One backend switch for every hot function: CasADi's virtual machine, or compiled C.

:func:`compiled` returns a function that does the same as its argument, faster where a C compiler
is found.  The library is compiled once and kept in the user's cache folder under a name that is a
hash of everything it depends on, so that a change of content gives another name; it is loaded
afterwards without asking the compiler.  Where there is no compiler, or it fails, the argument
itself comes back, with one line in the log ``apu_casadi``.

Environment: ``APU_BACKEND`` is ``auto`` (default), ``vm`` or ``c`` (refuse to fall back);
``APU_CACHE_DIR`` is the folder of the libraries, by default ``$XDG_CACHE_HOME/apu_casadi`` or
``~/.cache/apu_casadi``; ``CC`` is the compiler, by default ``cc``, ``gcc`` or ``clang``.

Failures inside a function become NaN or a large residual in C as in the virtual machine, and must
be looked for by the caller: ``error_on_fail`` has no effect in generated code.

Nothing here is thread-safe except :func:`mapped`'s own threads.
"""

from __future__ import annotations

import getpass
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from types import TracebackType

import casadi as ca
import numpy as np

from apu_casadi.errors import BackendError, nearest

__all__ = [
    "Caller",
    "Mapped",
    "available_threads",
    "backend_in_use",
    "cache_folder",
    "clear_cache",
    "compiled",
    "find_compiler",
    "load_or_build",
    "mapped",
    "package_digest",
    "recipe",
    "use_backend",
]

log = logging.getLogger("apu_casadi")

BACKENDS = ("auto", "vm", "c")
FLAGS = ("-fPIC", "-shared", "-fno-math-errno")  # no -ffast-math, because NaN must survive
LEVELS = (1, 2, 3)  # -O1, -O2, -O3
COMPILE_TIMEOUT = 900.0  # s

_chosen: list[str | None] = [None]
_said: set[str] = set()
_compiled: OrderedDict[tuple[int, str, int], tuple[ca.Function, ca.Function]] = OrderedDict()
_loaded: dict[str, ca.Function] = {}
_failed: dict[str, str] = {}
_MEMO = 512


# ------------------------------------------------------------------------------ the switch


class use_backend:  # noqa: N801 - reads as a verb: use_backend("vm"), with use_backend("vm"): ...
    """Choose the backend for this process, or for a ``with`` block.

    Parameters
    ----------
    name : ``"auto"``, ``"vm"`` or ``"c"``; None returns to ``$APU_BACKEND``.

    Raises
    ------
    BackendError : unknown name.
    """

    def __init__(self, name: str | None) -> None:
        """Set the backend; see the class."""
        self._before = _chosen[0]
        _chosen[0] = None if name is None else _valid(name, "use_backend")

    def __enter__(self) -> use_backend:
        """The choice was made by the constructor."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Return to the backend before."""
        _chosen[0] = self._before


def _valid(name: str, where: str) -> str:
    if name not in BACKENDS:
        raise BackendError(f"{where}: unknown backend {name!r} {nearest(str(name), BACKENDS)}")
    return name


def _wanted(backend: str | None) -> str:
    if backend is not None:
        return _valid(backend, "backend")
    if _chosen[0] is not None:
        return _chosen[0]
    return _valid(os.environ.get("APU_BACKEND") or "auto", "APU_BACKEND")


def backend_in_use() -> str:
    """Return ``"c"`` or ``"vm"``: what :func:`compiled` would use for a new function now.

    Raises
    ------
    BackendError : ``$APU_BACKEND`` is none of the known names.
    """
    wanted = _wanted(None)
    if wanted == "c":
        return "c"
    return "c" if wanted == "auto" and find_compiler() else "vm"


def _say(level: int, text: str) -> None:
    """Log a line once per process."""
    if text not in _said:
        _said.add(text)
        log.log(level, text)


# ------------------------------------------------------------------------------ compiler, folder


def find_compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler: ``$CC``, else cc, gcc or clang on ``PATH``; or None."""
    return _find_compiler(os.environ.get("CC", ""), os.environ.get("PATH", ""))


@lru_cache(maxsize=8)
def _find_compiler(cc: str, path: str) -> tuple[str, ...] | None:
    words = cc.split()
    for name, *options in [words] if words else [["cc"], ["gcc"], ["clang"]]:
        found = shutil.which(name, path=path)
        if found:
            return (found, *options)
    return None


@lru_cache(maxsize=8)
def _identity(command: tuple[str, ...]) -> str:
    """Tell one compiler from another without running it: real path, size, date."""
    real = Path(command[0]).resolve()
    s = real.stat()
    return f"{real} {s.st_size} {s.st_mtime_ns} {' '.join(command[1:])}"


def cache_folder() -> Path | None:
    """Return the folder of the compiled libraries, made if absent; None if none can be written."""
    return _cache_folder(
        os.environ.get("APU_CACHE_DIR", ""),
        os.environ.get("XDG_CACHE_HOME", ""),
        os.environ.get("HOME", ""),
    )


@lru_cache(maxsize=8)
def _cache_folder(own: str, xdg: str, home: str) -> Path | None:
    if own:
        first = Path(own)
    elif xdg:
        first = Path(xdg) / "apu_casadi"
    else:
        first = Path(home or "~").expanduser() / ".cache" / "apu_casadi"
    if _writable(first):
        return first
    try:
        user = str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
    except (KeyError, OSError):
        user = "user"
    second = Path(tempfile.gettempdir()) / f"apu_casadi-{user}"
    # a folder that others can write to is no place to load libraries from
    if _writable(second) and _private(second):
        _say(logging.INFO, f"cache folder {first} cannot be written; libraries go to {second}")
        return second
    _say(logging.INFO, f"neither {first} nor {second} can be written; using the virtual machine")
    return None


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _private(folder: Path) -> bool:
    if not hasattr(os, "getuid"):
        return True
    s = folder.lstat()
    return s.st_uid == os.getuid() and not s.st_mode & 0o022


def clear_cache() -> int:
    """Delete the libraries of the cache folder; return how many there were.

    Libraries that a process has loaded stay usable in it.
    """
    folder = cache_folder()
    n = 0
    for path in folder.glob("apu-*") if folder else ():
        n += path.suffix == _SUFFIX
        with suppress(OSError):
            path.unlink()
    return n


# ------------------------------------------------------------------------------ compile and load


def compiled(
    fun: ca.Function, *, backend: str | None = None, build: bool = True, level: int = 1
) -> ca.Function:
    """Return ``fun`` compiled from generated C, or ``fun`` itself in the virtual machine.

    The second call with the same function costs nothing.

    Parameters
    ----------
    fun : any function whose parts generate C (``fast_newton``, ``rosenbrock``, ``erk``,
        ``bspline`` and ``map`` do; ``cvodes``, ``idas``, ``newton`` and ``kinsol`` do not).
    backend : overrides the backend in use.
    build : compile if no library is found; False only loads, which suits a single short call.
    level : how hard the C compiler optimises, 1 to 3.  Long straight-line code, a filter's block
        or a trim, runs as fast at 1 and compiles in half the time; short bodies in loops over many
        samples gain up to a third from 3.

    Raises
    ------
    BackendError : ``backend="c"`` was demanded and there is no compiler, no folder for the library,
        or the compiler failed; no such level.
    """
    if level not in LEVELS:
        raise BackendError(f"{fun.name()}: level must be one of {LEVELS}, got {level!r}")
    wanted = _wanted(backend)
    if wanted == "vm":
        return fun
    memo = (fun.__hash__(), wanted, level)
    known = _compiled.get(memo)
    if known is not None:
        _compiled.move_to_end(memo)
        return known[1]
    command = _toolchain(wanted)
    if command is None:
        return fun
    text = f"{fun.name()}\n{fun.serialize()}"
    key = _library_key(hashlib.sha256(text.encode()).hexdigest(), command, level)
    made = _load(fun.name(), key)
    if made is None and not build:
        return fun
    if made is None:
        made = _make(fun, key, (*command, f"-O{level}"), wanted)
    if made is None:
        return fun
    _remember(memo, fun, made)
    return made


def load_or_build(
    recipe: str,
    build: Callable[[], ca.Function],
    *,
    backend: str | None = None,
    compile_missing: bool = True,
) -> ca.Function:
    """Return the compiled function of a recipe, without building its expressions when it is known.

    Building the expression graph of a large model takes longer than anything that is done with it
    once.  The recipe stands for the graph: a hash, by :func:`recipe`, of all that the graph is made
    from, so that a new process can go straight to the library.

    Parameters
    ----------
    recipe : hash of what the function is made from.
    build : makes the function; called only if the recipe is not known here, or in the virtual
        machine.
    backend : overrides the backend in use.
    compile_missing : compile if no library is found; False only loads.

    Raises
    ------
    BackendError : as in :func:`compiled`.
    """
    wanted = _wanted(backend)
    command = None if wanted == "vm" else _toolchain(wanted)
    folder = cache_folder()
    if command is None or folder is None:
        return build()
    alias = folder / f"apu-{_library_key(recipe, command)}.txt"
    with suppress(OSError, ValueError):
        name, key = alias.read_text(encoding="utf-8").split()
        made = _load(name, key)
        if made is not None:
            return made
    fun = build()
    if not compile_missing:
        return fun
    made = compiled(fun, backend=wanted)
    if made is not fun:
        text = f"{fun.name()}\n{fun.serialize()}"
        key = _library_key(hashlib.sha256(text.encode()).hexdigest(), command)
        with suppress(OSError):
            _write(alias, f"{fun.name()} {key}\n".encode())
    return made


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
    """Return a hash of the modules and data files of the package that holds this module."""
    h = hashlib.sha256()
    root = Path(__file__).parent
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
        _say(logging.INFO, f"no C compiler found ({looked}); using CasADi's virtual machine")
    elif cache_folder() is None:
        if wanted == "c":
            raise BackendError(
                "backend 'c' demanded, but no folder can be written for the libraries; set "
                "APU_CACHE_DIR"
            )
        return None
    return command


_SUFFIX = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


def _library_key(content: str, command: tuple[str, ...], level: int = 1) -> str:
    made_by = (_identity(command), f"-O{level}", *FLAGS)
    parts = (content, ca.__version__, *made_by, sys.platform, platform.machine())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:40]


def _remember(memo: tuple[int, str, int], fun: ca.Function, made: ca.Function) -> None:
    _compiled[memo] = (fun, made)  # fun is held, so that its address is not given to another
    while len(_compiled) > _MEMO:
        _compiled.popitem(last=False)


def _load(name: str, key: str) -> ca.Function | None:
    """Load a library whose content is what was written; a damaged one would crash the process."""
    if key in _loaded:
        return _loaded[key]
    folder = cache_folder()
    if folder is None:
        return None
    path = folder / f"apu-{key}{_SUFFIX}"
    try:
        size, digest = (folder / f"apu-{key}.sum").read_text(encoding="utf-8").split()
        if path.stat().st_size != int(size):
            raise ValueError("size")
        if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise ValueError("content")
        _loaded[key] = ca.external(name, str(path))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RuntimeError) as e:
        _say(logging.INFO, f"library {path.name} is damaged ({e}); it is compiled again")
        return None
    return _loaded[key]


def _make(fun: ca.Function, key: str, command: tuple[str, ...], wanted: str) -> ca.Function | None:
    """Generate, compile, put in place and load; None with one warning if that fails."""
    if key in _failed and wanted != "c":
        return None
    try:
        _compile(fun, key, command)
        made = _load(fun.name(), key)
        if made is None:
            raise BackendError("the library cannot be loaded")
    except (OSError, RuntimeError, subprocess.SubprocessError, BackendError) as e:
        why = " ".join(str(e).split())[:300]
        _failed[key] = why
        if wanted == "c":
            raise BackendError(f"{fun.name()} could not be compiled: {why}") from e
        _say(
            logging.WARNING,
            f"{fun.name()} could not be compiled, using CasADi's virtual machine: {why}",
        )
        return None
    return made


def _compile(fun: ca.Function, key: str, command: tuple[str, ...]) -> None:
    folder = cache_folder()
    if folder is None:
        raise BackendError("no folder for the library")
    generator = ca.CodeGenerator(f"{fun.name()}.c", {"with_header": False})
    generator.add(fun)
    text = generator.dump()
    with tempfile.TemporaryDirectory(prefix="tmp-", dir=folder) as work:
        source, library = Path(work) / "code.c", Path(work) / f"code{_SUFFIX}"
        source.write_text(text, encoding="utf-8")
        # relative names: the library does not depend on where it was made
        done = subprocess.run(
            [*command, *FLAGS, "-o", library.name, source.name, "-lm"],
            cwd=work, capture_output=True, text=True, timeout=COMPILE_TIMEOUT, check=False,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
        if done.returncode or not library.exists():
            raise BackendError(
                f"{' '.join(command)} ended with status {done.returncode}: "
                f"{done.stderr.strip() or done.stdout.strip() or 'no message'}"
            )
        content = library.read_bytes()
        # the library first: a sum without its library says only that there is none
        os.replace(library, folder / f"apu-{key}{_SUFFIX}")
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


# ------------------------------------------------------------------------------ calling


class Caller:
    """A function called through flat NumPy buffers, which costs 1 to 3 us beyond its own work.

    Not thread-safe and not re-entrant: the buffers belong to the object.  Make one per thread.

    Parameters
    ----------
    fun : the function; inputs and outputs may be vectors or dense matrices.
    copy : return copies, which stay; False returns views of the buffers, which the next call
        overwrites.
    """

    def __init__(self, fun: ca.Function, *, copy: bool = True) -> None:
        """Allocate and bind the buffers; see the class."""
        self.fun = fun
        self._buffer, self._evaluate = fun.buffer()
        self._copy = copy
        self._in, self._out = [], []
        self._shape_in = [fun.size_in(i) for i in range(fun.n_in())]
        for i in range(fun.n_in()):
            flat, view = _flat(fun.sparsity_in(i), fun.name(), fun.name_in(i))
            self._in.append(view)
            if flat.size:
                self._buffer.set_arg(i, memoryview(flat))
        for i in range(fun.n_out()):
            flat, view = _flat(fun.sparsity_out(i), fun.name(), fun.name_out(i))
            self._out.append(view)
            if flat.size:
                self._buffer.set_res(i, memoryview(flat))

    @property
    def inputs(self) -> list[np.ndarray]:
        """The input buffers: fill them in place and use :meth:`evaluate` to save the copies."""
        return self._in

    @property
    def outputs(self) -> list[np.ndarray]:
        """The output buffers, as the last call left them."""
        return self._out

    def evaluate(self) -> None:
        """Evaluate with what the input buffers hold.

        Raises
        ------
        BackendError : the function reported a failure.
        """
        self._evaluate()
        if self._buffer.ret():
            raise BackendError(f"{self.fun.name()}: evaluation failed ({self._buffer.ret()})")

    def __call__(self, *arrays: np.ndarray | float) -> tuple[np.ndarray, ...]:
        """Evaluate; column vectors come back with shape (n,), matrices with shape (n, m).

        An argument that is the input buffer itself, filled in place, is not copied.

        Raises
        ------
        BackendError : wrong number or size of arguments (nothing is spread), or a failure.
        """
        if len(arrays) != len(self._in):
            raise BackendError(
                f"{self.fun.name()} takes {len(self._in)} arguments "
                f"({', '.join(self.fun.name_in())}), got {len(arrays)}"
            )
        for i, (view, a) in enumerate(zip(self._in, arrays, strict=True)):
            if a is view:
                continue
            value = np.asarray(a, dtype=float)
            if value.shape != view.shape:
                if value.size != view.size or value.ndim > 2 or min(self._shape_in[i]) > 1:
                    raise BackendError(
                        f"{self.fun.name()}: {self.fun.name_in(i)} has shape {view.shape}, "
                        f"got {value.shape}"
                    )
                value = value.reshape(view.shape)
            view[...] = value
        self._evaluate()
        if self._buffer.ret():
            raise BackendError(f"{self.fun.name()}: evaluation failed ({self._buffer.ret()})")
        if self._copy:
            return tuple([a.copy() for a in self._out])
        return tuple(self._out)


def _flat(sparsity: ca.Sparsity, fun: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a flat buffer and a view of it: (n,) for a column, (n, m) column by column else."""
    if not sparsity.is_dense():
        raise BackendError(f"{fun}: {name} is sparse; make it dense with casadi.densify")
    n, m = sparsity.shape
    flat = np.zeros(n * m)
    return flat, flat if m == 1 else flat.reshape((n, m), order="F")


def available_threads() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Mapped:
    """A function of columns evaluated for many columns at once; made by :func:`mapped`.

    Memory is bounded by the chunk: buffers hold that many columns, whatever the number asked for.
    """

    def __init__(
        self, fun: ca.Function, n_threads: int | None = None, *, chunk: int = 1024
    ) -> None:
        """Check the shapes; evaluators of each chunk size are made when first needed."""
        wide = [fun.name_in(i) for i in range(fun.n_in()) if fun.size2_in(i) != 1]
        wide += [fun.name_out(i) for i in range(fun.n_out()) if fun.size2_out(i) != 1]
        if wide:
            raise BackendError(f"{fun.name()}: {', '.join(wide)} must be columns to be mapped")
        self.fun = fun
        self.n_threads = max(1, available_threads() if n_threads is None else int(n_threads))
        # chunks are multiples of the thread count; the last one is filled up with its last column
        sizes = sorted({max(1, c) for c in (16, 128, chunk) if c <= chunk} | {chunk})
        self._sizes = sorted({-(-c // self.n_threads) * self.n_threads for c in sizes})
        self._callers: dict[int, Caller] = {}

    def _caller(self, size: int) -> Caller:
        if size not in self._callers:
            if self.n_threads == 1:
                f = self.fun.map(size, "serial")
            else:
                f = self.fun.map(size, "thread", self.n_threads)
            self._callers[size] = Caller(f, copy=False)
        return self._callers[size]

    def __call__(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        """Evaluate for N columns: arrays of shape (n, N) or (n,), the latter for every column.

        Returns
        -------
        One array (m, N) per output, N = 1 if every argument is a single column.

        Raises
        ------
        BackendError : wrong number or shapes of arguments.
        """
        fun = self.fun
        if len(arrays) != fun.n_in():
            raise BackendError(
                f"{fun.name()} takes {fun.n_in()} arguments ({', '.join(fun.name_in())}), "
                f"got {len(arrays)}"
            )
        given = [np.asarray(a, dtype=float) for a in arrays]
        given = [a.reshape(-1, 1) if a.ndim < 2 else a for a in given]
        lengths = {a.shape[1] for a in given} - {1}
        for i, a in enumerate(given):
            if a.ndim != 2 or a.shape[0] != fun.size1_in(i):
                raise BackendError(
                    f"{fun.name()}: {fun.name_in(i)} must have shape ({fun.size1_in(i)}, N), got "
                    f"{a.shape}"
                )
        if len(lengths) > 1:
            raise BackendError(f"{fun.name()}: unequal numbers of columns: {sorted(lengths)}")
        N = lengths.pop() if lengths else 1
        given = [np.broadcast_to(a, (a.shape[0], N)) for a in given]
        results = tuple(np.empty((fun.size1_out(i), N)) for i in range(fun.n_out()))
        done = 0
        while done < N:
            left = N - done
            fitting = [s for s in self._sizes if s <= left]
            size = fitting[-1] if fitting else self._sizes[0]
            n = min(size, left)
            call = self._caller(size)
            for a, buffer in zip(given, call.inputs, strict=True):
                wide = buffer.reshape(a.shape[0], size)
                wide[:, :n] = a[:, done : done + n]
                if n < size:
                    wide[:, n:] = wide[:, n - 1 : n]
            call.evaluate()
            for r, buffer in zip(results, call.outputs, strict=True):
                r[:, done : done + n] = buffer.reshape(r.shape[0], size)[:, :n]
            done += n
        return results


def mapped(fun: ca.Function, n_threads: int | None = None, *, chunk: int = 1024) -> Mapped:
    """Return a batch form of ``fun`` over columns, in chunks, on ``n_threads`` threads.

    Give it a compiled function for speed: ``mapped(compiled(f))``.

    Parameters
    ----------
    fun : function whose inputs and outputs are columns.
    n_threads : default all cores that the process may use.
    chunk : columns per evaluation; more need more memory, fewer start threads more often.

    Raises
    ------
    BackendError : an input or output is not a column.
    """
    return Mapped(fun, n_threads, chunk=chunk)
