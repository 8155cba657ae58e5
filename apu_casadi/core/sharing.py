"""What is derived from a model: made once, kept as long as the model, never pickled.

Models are frozen sets of parameters.  Their functions, solvers and buffers follow from these and
take seconds and megabytes, so each is made once and *kept* in a :class:`Store` that belongs to the
model.  Equal models share one store: a fresh ``Apu()`` finds what another one made.  A store lives
as long as one of its models does, and beyond that while it is among the last ``MODELS`` of its
class; then functions, buffers and loaded libraries are released.

Threads: everything is built under one re-entrant lock, so that nothing is made twice, and looked up
without it.  What a thread writes to, buffers and solver memory, is its own (:class:`PerThread`).
Processes: a model is pickled and copied by its fields alone (:class:`Parametric`), what a kept
function made as the call that made it.  ``fork`` waits until nothing is being built.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Generic, TypeVar, cast, overload

import casadi as ca

__all__ = [
    "BUILDING",
    "MODELS",
    "Parametric",
    "PerThread",
    "Rebuilt",
    "building",
    "derived",
    "keep",
    "kept",
    "last",
    "of_family",
    "once",
    "remade",
    "twin",
]

MODELS = 4  # models of each class whose stores outlive them
RESULTS = 64  # results of one function for one model; the longest unused goes first

#: Held while anything is built: CasADi expressions, functions, libraries.
BUILDING = threading.RLock()
#: Held for moments: changes of the tables below, solver memory checked out.
_TABLES = threading.RLock()

T = TypeVar("T")
_STORE, _WEAK, _MADE_BY, _MADE_AT = "_store", "_weak_store", "_made_by", "_made_at"


class Store:
    """What was derived from one model, by what made it."""

    __slots__ = ("__weakref__", "results")

    def __init__(self) -> None:
        self.results: dict[Hashable, OrderedDict[Hashable, Any]] = {}


_stores: weakref.WeakValueDictionary[Hashable, Store] = weakref.WeakValueDictionary()
_recent: dict[type, OrderedDict[Hashable, Store]] = {}


def _before_fork() -> None:
    BUILDING.acquire()
    _TABLES.acquire()


def _after_fork() -> None:
    _TABLES.release()
    BUILDING.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork
    )


_IDENTITY: Any = object.__hash__


def _by_identity(owner: Any) -> bool:
    """Whether nothing else can be equal to ``owner``."""
    return isinstance(owner, ca.Function) or type(owner).__hash__ is _IDENTITY


def twin(owner: Any) -> Any:
    """Return an equal model that does not keep the store alive.

    What is built from it may hold it, without a circle that only the garbage collector ends.
    """
    if _by_identity(owner) or _WEAK in owner.__dict__:
        return owner
    new = object.__new__(type(owner))
    new.__dict__.update({f.name: getattr(owner, f.name) for f in dataclasses.fields(owner)})
    new.__dict__[_WEAK] = weakref.ref(_store_of(owner))
    new.__dict__.update({n: owner.__dict__[n] for n in (_MADE_BY, _MADE_AT) if n in owner.__dict__})
    return new


def _store_of(owner: Any) -> Store:
    own: dict[str, Any] = owner.__dict__
    store = own.get(_STORE)
    if store is None and _WEAK in own:
        store = own[_WEAK]()
    return _find(owner) if store is None else store


def _find(owner: Any) -> Store:
    """Take up or begin the store of an owner that has none."""
    own = owner.__dict__
    with _TABLES:
        if _by_identity(owner):
            own_store: Store = own.setdefault(_STORE, Store())
            return own_store
        key = object.__new__(type(owner))
        key.__dict__.update({f.name: getattr(owner, f.name) for f in dataclasses.fields(owner)})
        store = _stores.get((type(owner), key))
        if store is None:
            store = _stores[(type(owner), key)] = Store()
        recent = _recent.setdefault(type(owner), OrderedDict())
        recent[key] = store
        recent.move_to_end(key)
        gone = recent.popitem(last=False) if len(recent) > MODELS else None
        if _WEAK in own:
            own[_WEAK] = weakref.ref(store)
        else:
            own[_STORE] = store
    del gone  # outside the lock: it may be much that ends here
    return store


def keep(
    owner: Any,
    which: Hashable,
    key: Hashable,
    make: Callable[[], T],
    *,
    limit: int = RESULTS,
    locked: bool = True,
) -> T:
    """Return what ``make`` returns, made once for an owner and a key.

    Args:
        owner: a frozen dataclass, or anything that takes attributes.
        which: tells what is made from what else is made.
        key: all that the result depends on beside the owner.
        limit: results of this kind that are kept for the owner.
        locked: make it under the lock; False for what is mere arithmetic and takes long: two
            threads may then make the same, and the first one's stays.
    """
    table = _store_of(owner).results.get(which)
    if table is not None:
        found = table.get(key, table)
        if found is not table:
            if 2 * len(table) > limit:  # something may have to go before long
                with _TABLES:
                    if key in table:
                        table.move_to_end(key)
            return cast(T, found)
    store = _store_of(owner)
    if locked:
        with BUILDING:
            return _entered(store, which, key, make, limit)
    return _entered(store, which, key, make, limit)


def _entered(store: Store, which: Hashable, key: Hashable, make: Callable[[], T], limit: int) -> T:
    with _TABLES:
        table = store.results.setdefault(which, OrderedDict())
        if key in table:
            return cast(T, table[key])
    made = make()
    with _TABLES:
        made = table.setdefault(key, made)
        gone = table.popitem(last=False) if len(table) > limit else None
    del gone
    return made


class derived(Generic[T]):  # noqa: N801 - a decorator, like cached_property
    """A property that is computed once and kept with the model; as ``cached_property``, but shared.

    Equal models share the value; it is built under the lock.
    """

    make: Callable[[Any], T]
    name: str

    def __init__(self, make: Callable[[Any], T]) -> None:
        self.make, self.__doc__ = make, make.__doc__

    def _build(self, owner: Any) -> T:
        made: T = _recorded(getattr, self.make, (owner,), {}, (owner, self.name))
        return made

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, obj: None, cls: type | None = None) -> derived[T]: ...
    @overload
    def __get__(self, obj: Any, cls: type | None = None) -> T: ...
    def __get__(self, obj: Any, cls: type | None = None) -> derived[T] | T:
        """Return the value; an ordinary attribute from then on."""
        if obj is None:
            return self
        value = keep(obj, self, None, lambda: self._build(twin(obj)))
        if _WEAK not in obj.__dict__:
            obj.__dict__[self.name] = value
        return value


def kept(make: Callable[..., T]) -> Callable[..., T]:
    """Keep a function's results with the model that is its first argument; as ``lru_cache``."""

    @functools.wraps(make)
    def call(owner: Any, *args: Any, **more: Any) -> T:
        key = (args, tuple(sorted(more.items()))) if more else args
        return keep(owner, call, key, lambda: _recorded(call, make, (twin(owner), *args), more))

    return call


def last(limit: int) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Keep the last ``limit`` results of a function that belong to no one model."""

    def decorate(make: Callable[..., T]) -> Callable[..., T]:
        table = _Owner()

        @functools.wraps(make)
        def call(*args: Any, **more: Any) -> T:
            key = (args, tuple(sorted(more.items()))) if more else args
            return keep(table, call, key, lambda: _recorded(call, make, args, more), limit=limit)

        return call

    return decorate


def once(make: Callable[..., T]) -> Callable[..., T]:
    """Keep the results of a function that belong to no model and are small; as ``cache``."""
    return last(RESULTS)(make)


class _Owner:
    """Holds the results of one function of :func:`last`."""


def of_family(make: Callable[..., T]) -> Callable[..., T]:
    """Let what is made of a model be made of the model's family: once for all its units.

    The model has a ``family``, or None, and the result a method ``unit`` that holds the numbers
    of a model.
    """

    @functools.wraps(make)
    def call(model: Any, *args: Any, **more: Any) -> T:
        family = model.family
        if family is None:
            return make(model, *args, **more)
        key = _frozen((args, more))
        made: Any = keep(family, call, key, lambda: make(family, *args, **more))
        held: T = made.unit(model)
        return held

    return call


def _frozen(value: Any) -> Any:
    """Return what an argument says as a key: lists and tables as tuples, arrays as lists."""
    if isinstance(value, Mapping):
        return tuple((k, _frozen(v)) for k, v in value.items())
    if hasattr(value, "tolist"):
        value = value.tolist()
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value


def building(make: Callable[..., T]) -> Callable[..., T]:
    """Let a function or constructor that builds expressions hold the lock."""

    @functools.wraps(make)
    def call(*args: Any, **more: Any) -> T:
        with BUILDING:
            return make(*args, **more)

    return call


def remade(make: Callable[..., T]) -> Callable[..., T]:
    """Build under the lock, and let the result be pickled as the call that made it."""

    @functools.wraps(make)
    def call(*args: Any, **more: Any) -> T:
        # copies of what the caller may change later
        kept_args = tuple(copy.copy(a) if isinstance(a, _CHANGEABLE) else a for a in args)
        with BUILDING:
            return _recorded(call, make, kept_args, more)

    return call


_CHANGEABLE = (dict, list, set)


def _recorded(
    call: Callable[..., T],
    make: Callable[..., T],
    args: tuple[Any, ...],
    more: dict[str, Any],
    call_args: tuple[Any, ...] | None = None,
) -> T:
    """Make something, and note the call with it if it is new.

    The outermost call of those that made it counts.  What was there before keeps its own.
    """
    began = next(_count)
    made = make(*args, **more)
    if isinstance(made, Parametric) and not any(made is a for a in (*args, *more.values())):
        own = made.__dict__
        if own.get(_MADE_AT, began) >= began:
            own[_MADE_BY] = call, args if call_args is None else call_args, more
            own[_MADE_AT] = next(_count)
    return made


_count = itertools.count()


def _remake(call: Callable[..., Any], args: tuple[Any, ...], more: dict[str, Any]) -> Any:
    return call(*args, **more)


class Parametric:
    """A model that is pickled and copied by its fields alone; a dataclass.

    Nothing derived goes along.  What :func:`kept`, :func:`once` or :func:`remade` made is pickled
    as that call: some hundred bytes instead of its functions, and the same bits where it is made
    again.
    """

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Return the call that made it, or class and fields."""
        call = self.__dict__.get(_MADE_BY)
        if call is not None:
            return _remake, call
        return super().__reduce_ex__(protocol)

    def __getstate__(self) -> dict[str, Any]:
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        return {f.name: self.__dict__[f.name] for f in fields}


class Rebuilt:
    """An object with functions and buffers inside, pickled and copied as its constructor's call."""

    _built_by: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **more: Any) -> Any:
        """Note the arguments of the constructor."""
        self = object.__new__(cls)
        self._built_by = args, more
        return self

    def __reduce__(self) -> Any:
        return _remake, (type(self), *self._built_by)


class PerThread(threading.local, Generic[T]):
    """One object for each thread, as ``own``, made when a thread first asks; it ends with it."""

    own: T

    def __init__(self, make: Callable[..., T], *args: Any) -> None:
        """Make the calling thread's; Python calls this again in each other thread."""
        with _TABLES:
            self.own = make(*args)
