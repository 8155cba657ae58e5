"""Named vectors: made and read by name, with every wrong name and shape refused.

CasADi itself sets absent named inputs to zero and spreads scalars (casadi/casadi issue 1468); these
tests are what keeps that out of the package.
"""

import casadi as ca
import numpy as np
import pytest

from apu_casadi.core.errors import SignalError
from apu_casadi.core.signals import Signal, Signals

WF = Signal("Wf", "kg/s", "fuel flow", nominal=0.05)
PW = Signal("PW", "W", "shaft power", nominal=5e5)
MACH = Signal("Mach", "1", "flight Mach number", default=0.0)
U = Signals((WF, PW, MACH))


def test_casadi_really_takes_absent_inputs_as_zero():
    """casadi/casadi issue 1468: the reason why Signals exist."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    f = ca.Function("f", [x, u], [x + u], ["x", "u"], ["y"])
    assert float(f(x=1.0)["y"]) == 1.0


def test_pack_and_unpack_are_inverse():
    """Order is declared once; values are exact copies."""
    v = U.pack({"PW": 5e5, "Wf": 0.05}, Mach=0.7)
    assert v.tolist() == [0.05, 5e5, 0.7]
    assert U.unpack(v) == {"Wf": 0.05, "PW": 5e5, "Mach": 0.7}


def test_defaults_fill_what_is_absent():
    """Only a declared default may be left out."""
    assert U.pack(Wf=0.05, PW=0.0)[2] == 0.0


def test_arrays_make_a_matrix():
    """Shape (n, m); scalars are repeated along the series, which is what a constant input means."""
    v = U.pack(Wf=[0.04, 0.05, 0.06], PW=1e5)
    assert v.shape == (3, 3)
    assert v[1].tolist() == [1e5] * 3
    assert U.unpack(v)["Wf"].tolist() == [0.04, 0.05, 0.06]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"PW": 5e5, "WF": 0.05}, r"missing Wf; unknown WF \(did you mean 'Wf'\?\)"),
        ({"PW": 5e5}, "missing Wf"),
        ({"Wf": 0.05, "PW": float("nan")}, r"PW \[W\]: 1 of 1 values not finite"),
        ({"Wf": [0.05, float("inf")], "PW": 0.0}, r"Wf \[kg/s\]: 1 of 2 values not finite"),
        ({"Wf": [1, 2, 3], "PW": [1, 2]}, r"unequal length: \[2, 3\]"),
        ({"Wf": np.ones((2, 2)), "PW": 0.0}, r"scalar or 1-D array expected, got shape \(2, 2\)"),
        ({"Wf": "much", "PW": 0.0}, r"Wf \[kg/s\] must be a number or a 1-D array, got 'much'"),
        ({"Wf": None, "PW": 0.0}, "not finite|must be a number"),
    ],
)
def test_pack_refuses(values, words):
    """Nothing is guessed: the message names the signal, its unit and what came."""
    with pytest.raises(SignalError, match=words):
        U.pack(values)


def test_pack_refuses_a_name_given_twice():
    """By mapping and by keyword: which one should win?"""
    with pytest.raises(SignalError, match="'Wf' given twice"):
        U.pack({"Wf": 0.05, "PW": 0.0}, Wf=0.06)


@pytest.mark.parametrize(
    "vector", [[1.0, 2.0], np.ones((2, 3)), 1.0, np.ones((3, 2, 2)), ca.DM(2, 1)]
)
def test_unpack_refuses_a_wrong_shape(vector):
    """The first dimension is the number of signals, always."""
    with pytest.raises(SignalError, match="expected"):
        U.unpack(vector)


def test_symbols_are_packed_in_the_same_order():
    """One order for numbers and for expressions: a Function fed by pack() returns the values."""
    v, parts = U.sx()
    f = ca.Function(
        "f", [v], [U.stack({"PW": parts["PW"], "Mach": parts["Mach"], "Wf": parts["Wf"]})]
    )
    x = U.pack(Wf=1.0, PW=2.0, Mach=3.0)
    assert f(x).full().ravel().tolist() == x.tolist()
    assert {n: float(s) for n, s in U.unpack(ca.DM(x)).items()} == U.unpack(x)


def test_stack_refuses_names_that_do_not_match():
    """A residual forgotten is an equation lost."""
    _, parts = U.sx()
    parts["WF"] = parts.pop("Wf")
    with pytest.raises(SignalError, match=r"missing Wf; unknown WF \(did you mean 'Wf'\?\)"):
        U.stack(parts)


def test_an_empty_set_is_a_vector_of_length_zero():
    """A healthy machine has no fault parameters: theta has shape (0,)."""
    none = Signals()
    assert none.pack().shape == (0,)
    assert none.unpack(np.zeros(0)) == {}
    v, parts = none.sx()
    assert v.shape == (0, 1)
    assert parts == {}
    assert none.stack({}).shape == (0, 1)


def test_it_is_a_sequence_with_names():
    """Positions and names lead to the same signal."""
    assert len(U) == 3
    assert list(U) == [WF, PW, MACH]
    assert U[0] is U["Wf"] is WF
    assert U.names == ("Wf", "PW", "Mach")
    assert U.indices(["PW", "Wf"]) == [1, 0]
    assert "PW" in U
    assert "pw" not in U
    assert U.nominals.tolist() == [0.05, 5e5, 1.0]
    assert repr(U) == "Signals(Wf [kg/s], PW [W], Mach [1])"


def test_sets_join_and_compare():
    """Equal means equal signals in equal order; hashable, so that models can be cached."""
    joined = Signals((WF,)) + Signals((PW, MACH))
    assert joined == U
    assert hash(joined) == hash(U)
    assert Signals((PW, WF, MACH)) != U
    with pytest.raises(SignalError, match="declared twice: Wf"):
        _ = U + Signals((WF,))


def test_an_unknown_name_is_told_the_nearest():
    """The hint of :func:`apu_casadi.core.errors.nearest`."""
    with pytest.raises(SignalError, match=r"unknown signal 'mach' \(did you mean 'Mach'\?\)"):
        U.index("mach")


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"name": "T 3"}, "'T 3' is not an identifier"),
        ({"name": "T3", "nominal": 0.0}, "T3: nominal must be > 0"),
        ({"name": "T3", "nominal": float("nan")}, "T3: nominal must be > 0"),
    ],
)
def test_a_signal_checks_itself(kwargs, words):
    """Names become attributes, nominal values divide."""
    with pytest.raises(SignalError, match=words):
        Signal(unit="K", doc="", **kwargs)
