"""The JSON that commands print and write: strict, whatever the numbers are made of.

NaN and the infinities, for which JSON has no word, become null; numbers and arrays of NumPy become
plain ones; dataclasses, paths and enumerations what they stand for.
"""

from __future__ import annotations

import dataclasses
import enum
import json
import math
import os
import sys
from collections.abc import Mapping
from typing import Any


def plain(value: Any) -> Any:
    """Return a value in the types of JSON.

    Raises:
        TypeError: a type that JSON has no place for.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, enum.Enum):
        return plain(value.value)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {_key(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):  # NumPy's numbers, booleans and arrays
        return plain(value.tolist())
    raise TypeError(f"{type(value).__name__} has no place in JSON")


def _key(key: Any) -> str:
    key = plain(key)
    return key if isinstance(key, str) else json.dumps(key)


def dumps(value: Any, *, encoding: str = "utf-8") -> str:
    """Return a value as strict JSON, indented; letters as such where ``encoding`` has them."""
    text = json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False)
    try:
        text.encode(encoding)
    except (UnicodeEncodeError, LookupError):
        text = json.dumps(plain(value), indent=2, allow_nan=False)
    return text


def show(value: Any) -> None:
    """Print a value as JSON on stdout."""
    print(dumps(value, encoding=getattr(sys.stdout, "encoding", None) or "utf-8"))
