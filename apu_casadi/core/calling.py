"""Calling CasADi functions from Python: through flat buffers, or for many columns at once.

Both forms may be shared between threads: each thread has buffers and solver memory of its own, made
when it first calls and released when it ends.  CasADi lets go of Python's lock while it evaluates,
so threads gain what the cores give.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import BackendError
from apu_casadi.core.sharing import PerThread, keep

__all__ = ["Buffers", "Caller", "Mapped", "available_threads", "mapped"]


class Buffers:
    """One thread's buffers of a function, and its solver memory.

    Args:
        fun: the function.
        arguments, results: positions of the inputs and outputs that have buffers; the others are
            zero and not wanted.
    """

    __slots__ = ("_buffer", "evaluate", "inputs", "outputs", "ret")
    evaluate: Callable[[], None]
    ret: Callable[[], int]
    inputs: list[np.ndarray]
    outputs: list[np.ndarray]

    def __init__(
        self, fun: ca.Function, arguments: tuple[int, ...], results: tuple[int, ...]
    ) -> None:
        """Allocate and bind; flat, column by column."""
        pair: Any = fun.buffer()
        self._buffer, self.evaluate = pair
        self.ret = self._buffer.ret
        self.inputs = [np.zeros(fun.numel_in(i)) for i in arguments]
        self.outputs = [np.zeros(fun.numel_out(i)) for i in results]
        for bind, positions, arrays in (
            (self._buffer.set_arg, arguments, self.inputs),
            (self._buffer.set_res, results, self.outputs),
        ):
            for i, a in zip(positions, arrays, strict=True):
                if a.size:
                    bind(i, memoryview(a))

    def stats(self) -> dict[str, Any]:
        """Return the solver's statistics of this thread's last call."""
        return dict(self._buffer.stats())


class _Shaped(Buffers):
    """Buffers of all inputs and outputs: vectors as (n,), matrices as (n, m)."""

    __slots__ = ()

    def __init__(self, fun: ca.Function) -> None:
        super().__init__(fun, tuple(range(fun.n_in())), tuple(range(fun.n_out())))
        sizes = [fun.size_in(i) for i in range(fun.n_in())]
        self.inputs = [_view(a, *s) for a, s in zip(self.inputs, sizes, strict=True)]
        sizes = [fun.size_out(i) for i in range(fun.n_out())]
        self.outputs = [_view(a, *s) for a, s in zip(self.outputs, sizes, strict=True)]


def _view(flat: np.ndarray, n: int, m: int) -> np.ndarray:
    return flat if m == 1 else flat.reshape((n, m), order="F")


class Caller:
    """A function called through flat NumPy buffers, which costs 1 to 3 us beyond its own work.

    Threads may share it: each has buffers of its own.  Within a thread it is not re-entrant.

    Args:
        fun: the function; inputs and outputs may be vectors or dense matrices.
        copy: return copies, which stay; False returns views of the thread's buffers, which its next
            call overwrites.
    """

    def __init__(self, fun: ca.Function, *, copy: bool = True) -> None:
        """Check that everything is dense; buffers are made by each thread's first call."""
        for i in range(fun.n_in()):
            _require_dense(fun.sparsity_in(i), fun.name(), fun.name_in(i))
        for i in range(fun.n_out()):
            _require_dense(fun.sparsity_out(i), fun.name(), fun.name_out(i))
        self.fun = fun
        self._copy = copy
        self._shape_in = [fun.size_in(i) for i in range(fun.n_in())]
        self._here: PerThread[_Shaped] = PerThread(_Shaped, fun)

    def __reduce__(self) -> Any:
        """Refuse compiled code, which is a file of this machine."""
        if self.fun.class_name() == "External":
            raise BackendError(
                f"{self.fun.name()}: compiled code cannot be pickled; pickle the model, or the "
                "function that it was compiled from"
            )
        return _caller, (self.fun, self._copy)

    @property
    def inputs(self) -> list[np.ndarray]:
        """This thread's input buffers: fill them in place and use :meth:`evaluate`, no copies."""
        return self._here.own.inputs

    @property
    def outputs(self) -> list[np.ndarray]:
        """This thread's output buffers, as its last call left them."""
        return self._here.own.outputs

    def evaluate(self) -> None:
        """Evaluate with what this thread's input buffers hold.

        Raises:
            BackendError: the function reported a failure.
        """
        own = self._here.own
        own.evaluate()
        if own.ret():
            raise BackendError(f"{self.fun.name()}: evaluation failed ({own.ret()})")

    def __call__(self, *arrays: np.ndarray | float) -> tuple[np.ndarray, ...]:
        """Evaluate; column vectors come back with shape (n,), matrices with shape (n, m).

        An argument that is the input buffer itself, filled in place, is not copied.

        Raises:
            BackendError: wrong number or size of arguments (nothing is spread), or a failure.
        """
        own = self._here.own
        inputs = own.inputs
        if len(arrays) != len(inputs):
            raise BackendError(
                f"{self.fun.name()} takes {len(inputs)} arguments "
                f"({', '.join(self.fun.name_in())}), got {len(arrays)}"
            )
        for i, (view, a) in enumerate(zip(inputs, arrays, strict=True)):
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
        own.evaluate()
        if own.ret():
            raise BackendError(f"{self.fun.name()}: evaluation failed ({own.ret()})")
        if self._copy:
            return tuple([a.copy() for a in own.outputs])
        return tuple(own.outputs)


def _caller(fun: ca.Function, copy: bool) -> Caller:
    return Caller(fun, copy=copy)


def _require_dense(sparsity: ca.Sparsity, fun: str, name: str) -> None:
    if not sparsity.is_dense():
        raise BackendError(f"{fun}: {name} is sparse; make it dense with casadi.densify")


def available_threads() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Mapped:
    """A function of columns evaluated for many columns at once; made by :func:`mapped`.

    Memory is bounded by the chunk: buffers hold that many columns, whatever the number asked for.

    Args:
        fun: the function; for ``width`` columns at once if more than one.
        n_threads, chunk: as in :func:`mapped`.
        width: columns that ``fun`` takes at once.
        common: inputs of which ``fun`` takes one column, the same for all.
        name: for messages, by default that of ``fun``.
    """

    def __init__(
        self,
        fun: ca.Function,
        n_threads: int | None = None,
        *,
        chunk: int = 1024,
        width: int = 1,
        common: tuple[int, ...] = (),
        name: str | None = None,
    ) -> None:
        """Check the shapes; evaluators of each chunk size are made when first needed."""
        self._name = fun.name() if name is None else name
        takes = [1 if i in common else width for i in range(fun.n_in())]
        wide = [fun.name_in(i) for i, n in enumerate(takes) if fun.size2_in(i) != n]
        wide += [fun.name_out(i) for i in range(fun.n_out()) if fun.size2_out(i) != width]
        if wide:
            raise BackendError(f"{self._name}: {', '.join(wide)} must be columns to be mapped")
        self.fun: ca.Function = fun
        self._width, self._common = width, common
        self.n_threads: int = max(1, available_threads() if n_threads is None else int(n_threads))
        # chunks are multiples of the thread count; the last one is filled up with its last column
        sizes = sorted({max(1, c) for c in (16, 128, chunk) if c <= chunk} | {chunk})
        each = self.n_threads * width
        self._sizes = sorted({-(-c // each) * each for c in sizes})

    def __reduce__(self) -> Any:
        """Refuse compiled code, as a :class:`Caller` does."""
        Caller(self.fun).__reduce__()
        more = (self._width, self._common, self._name)
        return _mapped, (self.fun, self.n_threads, max(self._sizes), *more)

    def _caller(self, size: int) -> Caller:
        def made() -> Caller:
            if self.n_threads == 1:
                f = self.fun.map(size // self._width, "serial")
            else:
                f = self.fun.map(size // self._width, "thread", self.n_threads)
            return Caller(f, copy=False)

        return keep(self, Caller, size, made)

    def __call__(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        """Evaluate for N columns: arrays of shape (n, N) or (n,), the latter for every column.

        Returns:
            One array (m, N) per output, N = 1 if every argument is a single column.

        Raises:
            BackendError: wrong number or shapes of arguments.
        """
        fun, name = self.fun, self._name
        if len(arrays) != fun.n_in():
            raise BackendError(
                f"{name} takes {fun.n_in()} arguments ({', '.join(fun.name_in())}), "
                f"got {len(arrays)}"
            )
        given = [np.asarray(a, dtype=float) for a in arrays]
        given = [a.reshape(-1, 1) if a.ndim < 2 else a for a in given]
        for i, a in enumerate(given):
            if a.ndim != 2 or a.shape[0] != fun.size1_in(i):
                raise BackendError(
                    f"{name}: {fun.name_in(i)} must have shape ({fun.size1_in(i)}, N), got "
                    f"{a.shape}"
                )
            if i in self._common and a.shape[1] > 1:
                raise BackendError(
                    f"{name}: {fun.name_in(i)} is common to all columns, got {a.shape}"
                )
        lengths = {a.shape[1] for a in given} - {1}
        if len(lengths) > 1:
            raise BackendError(f"{name}: unequal numbers of columns: {sorted(lengths)}")
        N = lengths.pop() if lengths else 1
        results = tuple(np.empty((fun.size1_out(i), N)) for i in range(fun.n_out()))
        done = 0
        while done < N:
            left = N - done
            fitting = [s for s in self._sizes if s <= left]
            size = fitting[-1] if fitting else self._sizes[0]
            n = min(size, left)
            call = self._caller(size)
            for i, (a, buffer) in enumerate(zip(given, call.inputs, strict=True)):
                if i in self._common:
                    buffer.reshape(a.shape[0], -1)[:] = a
                    continue
                wide = buffer.reshape(a.shape[0], size)
                wide[:, :n] = a if a.shape[1] == 1 else a[:, done : done + n]
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

    Args:
        fun: function whose inputs and outputs are columns.
        n_threads: default all cores that the process may use.
        chunk: columns per evaluation; more need more memory, fewer start threads more often.

    Raises:
        BackendError: an input or output is not a column.
    """
    return Mapped(fun, n_threads, chunk=chunk)


def _mapped(
    fun: ca.Function,
    n_threads: int,
    chunk: int,
    width: int,
    common: tuple[int, ...],
    name: str,
) -> Mapped:
    return Mapped(fun, n_threads, chunk=chunk, width=width, common=common, name=name)
