"""The family of errors, and the hint that names the nearest valid word."""

import pytest

from apu_casadi.core import errors
from apu_casadi.core.errors import ApuError, nearest

FAMILY = [
    e for e in vars(errors).values()
    if isinstance(e, type) and issubclass(e, Exception) and not issubclass(e, Warning)
]  # fmt: skip


@pytest.mark.parametrize("error", FAMILY, ids=lambda e: e.__name__)
def test_a_campaign_can_catch_the_family(error):
    """House design: every deliberate error is an ApuError, so that one clause catches them all."""
    with pytest.raises(ApuError, match="42 % off"):
        raise error("42 % off")


@pytest.mark.parametrize(
    "error", [e for e in FAMILY if e is not ApuError], ids=lambda e: e.__name__
)
def test_each_is_also_of_the_builtin_kind(error):
    """Python convention: wrong input is a ValueError, a calculation that failed a RuntimeError."""
    failed = {"EstimationError", "OperatingPointError", "SimulationError", "BackendError"}
    failed |= {"NotApplicable", "ValidityError"}  # a SimulationError each
    assert issubclass(error, RuntimeError if error.__name__ in failed else ValueError)


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        ("WF", "(did you mean 'Wf'?)"),
        ("f_eta_C", "(did you mean 'f_eta_c'?)"),
        ("altitud", "(did you mean 'altitude'?)"),
        ("lam_qs", "(did you mean 'lam_sq'?)"),
    ],
)
def test_a_slip_gets_the_nearest_name(wrong, hint):
    """Wrong case, a letter missing, two letters swapped: the slips people make."""
    assert nearest(wrong, ["Wf", "PW", "altitude", "f_eta_c", "lam_sq"]) == hint


def test_a_name_like_nothing_gets_the_list():
    """Where no name is near, all are told, in the order given."""
    assert nearest("xyzzy", iter(["Wf", "PW"])) == "(valid: Wf, PW)"
    assert nearest("x", []) == "(valid: )"
