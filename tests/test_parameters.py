"""Parameter sets: every number has unit, source, meaning and range, and is checked when set."""

import dataclasses
from dataclasses import dataclass

import pytest

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.parameters import Parameters, par
from apu_casadi.gaspath.designdata import GasGeneratorParameters
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration
from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters
from apu_casadi.unit.apu import Apu, CouplingParameters
from apu_casadi.unit.control import GovernorParameters


@dataclass(frozen=True)
class Shaft(Parameters):
    """A set as small as can be."""

    J: float = par(0.05, unit="kg m^2", source="assumed", doc="inertia", lo=1e-3, hi=10.0)
    N: float = par(3775.0, unit="rad/s", source="paper, Table 3", doc="speed")
    label: str = "rotor"


SETS = [
    CouplingParameters,
    ExciterParameters,
    GasGeneratorParameters,
    GovernorParameters,
    MachineParameters,
    MapCalibration,
]


def test_change_returns_a_copy():
    """Frozen: the original stays what it was."""
    a = Shaft()
    b = a.change(J=0.06, label="light")
    assert (a.J, b.J, b.N, b.label) == (0.05, 0.06, 3775.0, "light")
    with pytest.raises(dataclasses.FrozenInstanceError):
        a.J = 1.0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"j": 0.1}, r"Shaft has no 'j' \(did you mean 'J'\?\)"),
        ({"J": 0.0}, r"Shaft.J \[kg m\^2\] = 0 is outside \[0.001, 10\]"),
        ({"J": 11.0}, "outside"),
        ({"J": float("nan")}, r"Shaft.J \[kg m\^2\] must be finite, got nan"),
        ({"N": float("inf")}, "must be finite"),
        ({"J": "0.05"}, "must be a number, got '0.05'"),
        ({"J": True}, "must be a number, got True"),
        ({"J": None}, "must be a number, got None"),
    ],
)
def test_wrong_values_are_refused(values, words):
    """The message names the parameter, its unit, the value and the range."""
    with pytest.raises(ParameterError, match=words):
        Shaft().change(**values)


def test_the_ends_of_the_range_belong_to_it():
    """:func:`par` declares a closed range."""
    assert Shaft(J=1e-3).J == 1e-3
    assert Shaft(J=10).J == 10


def test_replace_checks_too():
    """``dataclasses.replace`` runs the same checks as a new object."""
    with pytest.raises(ParameterError):
        dataclasses.replace(Shaft(), J=-1.0)


def test_the_table_has_all_that_is_to_be_printed():
    """Name, value, unit, meaning, source; a field that is no number is left out."""
    assert Shaft().table() == [
        ("J", 0.05, "kg m^2", "inertia", "assumed"),
        ("N", 3775.0, "rad/s", "speed", "paper, Table 3"),
    ]


@pytest.mark.parametrize("cls", SETS, ids=lambda c: c.__name__)
def test_every_number_of_the_package_has_unit_source_and_meaning(cls):
    """House rule: parameters carry unit and source; a bare float field is a number from nowhere."""
    for f in dataclasses.fields(cls):
        if f.type not in ("float", "int", float, int):
            continue
        assert {"unit", "source", "doc"} <= set(f.metadata), f"{cls.__name__}.{f.name}"
        for key in ("unit", "source", "doc"):
            assert f.metadata[key].strip(), f"{cls.__name__}.{f.name}: {key}"


@pytest.mark.parametrize("cls", SETS, ids=lambda c: c.__name__)
def test_assumed_numbers_give_their_reason(cls):
    """What the paper does not state is assumed, and says why."""
    for name, _, _, _, source in cls().table():
        if source.startswith("assumed"):
            assert len(source) > len("assumed: "), f"{cls.__name__}.{name} gives no reason"


def test_dotted_names_change_the_unit():
    """``Apu.parameters`` lists what ``Apu.change`` takes; every other value stays."""
    before = Apu()
    after = before.change({"machine.r_s": 0.005, "governor.Kp": 0.5}).parameters()
    differ = {k for k, v in before.parameters().items() if after[k] != v}
    assert differ == {"machine.r_s", "governor.Kp"}
    with pytest.raises(ParameterError, match=r"'machine.rs' \(did you mean 'machine.r_s'\?\)"):
        before.change({"machine.rs": 0.005})
