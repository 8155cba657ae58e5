"""The JSON of the commands is strict, whatever the values are made of."""

import dataclasses
import enum
import io
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from scenarios.shell import jsontext


@dataclasses.dataclass
class _Point:
    T4: float
    ok: bool


class _Kind(enum.Enum):
    SOLVED = 0


def _no_constant(word):
    raise AssertionError(f"{word} is no JSON")


def test_every_type_becomes_plain():
    value = {
        "bool": np.bool_(True), "int": np.int64(3), "float": np.float64(0.5),
        "single": np.float32(0.5),
        "nan": math.nan, "inf": [math.inf, -math.inf, np.float64("nan")],
        "array": np.array([[1.0, math.nan], [2.0, 3.0]]), "point": _Point(np.float64("inf"), True),
        "kind": _Kind.SOLVED, "path": Path("a/b"), 5: None, np.int64(6): (1, 2), True: "±",
    }  # fmt: skip
    assert json.loads(jsontext.dumps(value), parse_constant=_no_constant) == {
        "bool": True, "int": 3, "float": 0.5, "single": 0.5, "nan": None, "inf": [None, None, None],
        "array": [[1.0, None], [2.0, 3.0]], "point": {"T4": None, "ok": True}, "kind": 0,
        "path": "a/b", "5": None, "6": [1, 2], "true": "±",
    }  # fmt: skip
    with pytest.raises(TypeError, match="object has no place in JSON"):
        jsontext.dumps(object())


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_what_the_terminal_lacks_is_escaped(monkeypatch, encoding):
    """A name from the file system that is no UTF-8, and letters that the encoding has not."""
    out = io.TextIOWrapper(io.BytesIO(), encoding)
    monkeypatch.setattr(sys, "stdout", out)
    jsontext.show({"name": "é\udcff", "unit": "Ω"})
    out.flush()
    printed = out.buffer.getvalue().decode(encoding)
    assert json.loads(printed) == {"name": "é\udcff", "unit": "Ω"}
