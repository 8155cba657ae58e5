"""Every list of names is declared once: no table of the model is written again in another file.

A literal tuple, list or set of names that all stand in one table of the model is such a list, and
so is a dictionary of texts by such names; numbers by name are a point, not a list.  Three names
make a list, four where the table has more than five.  What is a choice of its own has its reason in
``CHOSEN``.
"""

import ast
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.gaspath.stations import UNKNOWNS
from apu_casadi.machine.faults.fault import FAULTS
from apu_casadi.machine.loads.load import LOADS
from apu_casadi.machine.park import PHASES
from apu_casadi.machine.wrsg import Windings
from apu_casadi.unit.exchange import EXCHANGES
from estimators.apu.sensors import ELECTRICAL, GAS_PATH
from scenarios.studies.estimation import names as studies

ROOT = Path(find_spec("apu_casadi").origin).parents[1]
PACKAGES = ("apu_casadi", "estimators", "scenarios")
TABLES = {
    "health factors": (HEALTH, "apu_casadi/gaspath/health.py"),
    "ambient conditions": (CONDITIONS, "apu_casadi/gaspath/conditions.py"),
    "unknowns of the cycle": (UNKNOWNS, "apu_casadi/gaspath/stations.py"),
    "windings": ([f"lam_{n}" for n in Windings._fields], "apu_casadi/machine/wrsg.py"),
    "loads": (LOADS, "apu_casadi/machine/loads/"),
    "faults": (FAULTS, "apu_casadi/machine/faults/"),
    "severity of a short circuit": (("mu", "k_rf", "kappa"), "apu_casadi/machine/faults/ttsc.py"),
    "exchanges": (EXCHANGES, "apu_casadi/unit/exchange.py"),
    "gas-path sensors": (GAS_PATH.names, "estimators/apu/sensors.py"),
    "electrical sensors": (ELECTRICAL.names, "estimators/apu/sensors.py"),
    "studies": (studies(), "scenarios/studies/estimation/"),
}
# file and table: why a choice of these names stands there
CHOSEN: dict[tuple[str, str], str] = {
    ("scenarios/commands/given.py", "ambient conditions"): "the flags of the options",
    ("scenarios/figures/runplots.py", "loads"): "short words for the lane of a figure",
    ("apu_casadi/machine/terminals.py", "electrical sensors"): "inputs of the model at terminals",
}


@cache
def groups(path):
    """Return (line, names, list) of the literal tuples, lists, sets and dictionaries of a file.

    A dictionary is a list if all its values are texts.
    """
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        parts, texts = getattr(node, "elts", []), ()
        if isinstance(node, ast.Dict):
            parts = node.keys
            texts = (isinstance(getattr(v, "value", v), str | ast.JoinedStr) for v in node.values)
        names = {p.value for p in parts if isinstance(p, ast.Constant) and isinstance(p.value, str)}
        if len(names) >= 3:
            found.append((node.lineno, names, all(texts)))
    return found


def written_again(group, names):
    """Whether names are those of a table, or too many of them to be chance."""
    return group <= names and len(group) >= (4 if len(names) > 5 else 3)


@pytest.mark.parametrize("table", TABLES)
def test_no_list_is_written_again(table):
    """Each offence with file and line."""
    names, home = set(TABLES[table][0]), TABLES[table][1]
    assert len(names) >= 2
    wrong = []
    for path in (p for top in PACKAGES for p in sorted((ROOT / top).rglob("*.py"))):
        where = path.relative_to(ROOT).as_posix()
        if where.startswith(home) or (where, table) in CHOSEN:
            continue
        wrong += [
            f"{where}:{line}: {', '.join(sorted(g))}"
            for line, g, listed in groups(path)
            if listed and written_again(g, names)
        ]
    assert not wrong, f"{table} are declared in {home}:\n" + "\n".join(wrong)


def test_no_exception_is_stale():
    """An exception outlives its reason unless something asks."""
    stale = [
        (where, table)
        for where, table in CHOSEN
        for names in [set(TABLES[table][0])]
        if not any(listed and written_again(g, names) for _, g, listed in groups(ROOT / where))
    ]
    assert not stale


@pytest.mark.parametrize("names", [GAS_PATH.names, ELECTRICAL.names, HEALTH, PHASES])
def test_estimators_take_their_lists_from_the_tables(names):
    """Nowhere in them stand three of the names together, be it with others or as keys."""
    wrong = [
        f"{path.name}:{line}: {sorted(g & set(names))}"
        for path in (ROOT / "estimators").rglob("*.py")
        for line, g, _ in groups(path)
        if len(g & set(names)) >= 3
    ]
    assert not wrong, "\n".join(wrong)
