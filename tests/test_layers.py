"""Who may import whom: the folders form layers, and imports point downwards.

``BELOW`` is the whole rule: a folder, and the folders that it may import besides itself.  Inside a
folder any import is allowed that makes no circle.  Every import counts, also one inside a function
or under TYPE_CHECKING: a dependency is a dependency.
"""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.util import find_spec
from pathlib import Path

import pytest

# the folder of the packages: a checkout, or site-packages when the wheel is tested
ROOT = Path(find_spec("apu_casadi").origin).parents[1]
PACKAGES = ("apu_casadi", "estimators", "scenarios")

CORE = ("apu_casadi.core",)
PARTS = (*CORE, "apu_casadi.gaspath", "apu_casadi.machine")
UNIT = (*PARTS, "apu_casadi.unit")
MODELS = (*CORE, "estimators.models")
FILTERS = (*MODELS, "estimators.filters")
INFORMATION = (*FILTERS, "estimators.information")
GENERIC = (*INFORMATION, "estimators.batch", "estimators.detection")
ESTIMATORS = (*UNIT, *GENERIC, "estimators.apu")
SHELL = (*CORE, "scenarios", "scenarios.shell")
READING = (*ESTIMATORS, "scenarios.extensions", "scenarios.reading", "scenarios.units")
SCENARIO = (*READING, *SHELL, "scenarios.figures", "scenarios.phases", "scenarios.schema",
            "scenarios.fileschema", "scenarios.doubts", "scenarios.registry",
            "scenarios.campaign_records", "scenarios.campaigns")  # fmt: skip
STUDIES = (*SCENARIO, "scenarios.validation", "scenarios.studies")
PAGES = (*STUDIES, "scenarios.bench", "scenarios.pages")

# Bottom first: a folder, or a module that stands in a package itself, and what it may import.
BELOW: dict[str, tuple[str, ...]] = {
    "apu_casadi": UNIT,  # the front door names modules; no module of the package comes in by it
    "apu_casadi.core": (),
    "apu_casadi.gaspath": CORE,
    "apu_casadi.machine": CORE,
    "apu_casadi.unit": PARTS,
    # generic estimators see f, g and names
    "estimators": (),
    "estimators.models": CORE,
    "estimators.filters": MODELS,
    "estimators.information": FILTERS,
    "estimators.batch": INFORMATION,
    "estimators.detection": INFORMATION,
    "estimators.apu": (*UNIT, *GENERIC),
    "scenarios": (),
    "scenarios.shell": SHELL,
    "scenarios.figures": UNIT,
    "scenarios.extensions": CORE,
    "scenarios.reading": (*ESTIMATORS, "scenarios.extensions"),
    "scenarios.units": (*ESTIMATORS, "scenarios.extensions", "scenarios.reading"),
    "scenarios.phases": READING,
    "scenarios.schema": (*READING, "scenarios.phases"),
    "scenarios.fileschema": (*READING, "scenarios.phases", "scenarios.schema"),
    "scenarios.doubts": (*READING, "scenarios.phases", "scenarios.schema"),
    "scenarios.registry": SCENARIO,
    "scenarios.campaign_records": SCENARIO,
    "scenarios.campaigns": SCENARIO,
    "scenarios.validation": SCENARIO,
    "scenarios.studies": STUDIES,
    "scenarios.bench": STUDIES,
    "scenarios.pages": STUDIES,
    "scenarios.datasets": SCENARIO,
    "scenarios.export": (*ESTIMATORS, *SHELL),
    "scenarios.commands": (*PAGES, "apu_casadi", "scenarios.export", "scenarios.datasets"),
    "scenarios.cli": (*SHELL, "scenarios.commands"),
}
# who may import a package of others' code; all others may not
ONLY = {"matplotlib": "scenarios.figures"}


def name_of(path: Path) -> str:
    """``ROOT/apu_casadi/machine/park.py`` -> ``apu_casadi.machine.park``."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def folder_of(dotted: str) -> str:
    """``apu_casadi.machine.faults.ttsc`` -> ``apu_casadi.machine``."""
    return ".".join(dotted.split(".")[:2])


@cache
def modules() -> dict[str, Path]:
    """Return all modules of the three packages by dotted name."""
    return {name_of(p): p for top in PACKAGES for p in sorted((ROOT / top).rglob("*.py"))}


@cache
def tree_of(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path: Path) -> list[tuple[int, str]]:
    """Return (line, dotted module) of every import; ``from package import module`` is resolved."""
    found = []
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, a.name) for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            for a in node.names:
                inner = f"{module}.{a.name}"
                found.append((node.lineno, inner if inner in modules() else module))
    return sorted(set(found))


def verdict(path: Path, module: str) -> str | None:
    """Return what is wrong with the import of ``module`` by ``path``; None if it is allowed."""
    mine, target = folder_of(name_of(path)), folder_of(module)
    top = module.split(".")[0]
    if module.startswith("."):
        return "relative import; write the absolute one"
    if top in ("tests", "notebooks"):
        return f"nothing imports {top}"
    if top in ONLY and mine != ONLY[top]:
        return f"only {ONLY[top]} uses {top}; draw there"
    if top not in PACKAGES or target == mine or target in BELOW[mine]:
        return None
    if target == "apu_casadi":
        return "name the module (from apu_casadi.core.signals import Signals), not the package"
    below = ", ".join(BELOW[mine]) or "nothing else"
    return f"upward or sideways import: {mine} may import {below}"


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_point_downwards(package):
    """Every offence is listed with its line; a new folder must be put into ``BELOW``."""
    found = {n: p for n, p in modules().items() if n.split(".")[0] == package}
    missing = sorted({folder_of(n) for n in found} - set(BELOW))
    assert not missing, f"no place for {', '.join(missing)}: extend BELOW in {__file__}"
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {module}: {why}"
        for path in found.values()
        for line, module in imports(path)
        if (why := verdict(path, module))
    ]
    assert not wrong, "\n" + "\n".join(wrong)


def test_no_circles():
    """No module imports itself by a detour, whether at once or inside a function."""
    known = modules()
    graph = {
        name: [m for _, m in imports(path) if m in known and m != name]
        for name, path in known.items()
        if name not in PACKAGES
    }
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as e:
        pytest.fail(" -> ".join(e.args[1]))


def test_no_private_name_leaves_its_module():
    """Who needs a name of another module needs a public one."""
    known, wrong = modules(), []
    for name, path in known.items():
        tree = tree_of(path)
        inner = {m.split(".")[-1] for _, m in imports(path) if m in known}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
                private = [a.name for a in node.names if a.name.startswith("_")]
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                there = node.value.id in inner and node.attr.startswith("_")
                private = [node.attr] if there and not node.attr.endswith("__") else []
            else:
                continue
            wrong += [f"{name}:{node.lineno}: {p}" for p in private if p != "__version__"]
    assert not wrong, "\n" + "\n".join(wrong)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_file_name_twice(package):
    """A name tells which file is meant; ``__init__.py`` aside."""
    names = [p.name for n, p in modules().items() if n.split(".")[0] == package]
    assert not {n for n in names if names.count(n) > 1} - {"__init__.py"}


def test_inner_packages_hold_no_code():
    """Names have one home: only the front door re-exports; a docstring is welcome."""
    tops = [ROOT / top for top in ("apu_casadi", "estimators")]
    inner = [p for top in tops for p in top.glob("*/**/__init__.py")]
    assert ROOT / "estimators" / "detection" / "__init__.py" in inner
    assert ROOT / "apu_casadi" / "machine" / "faults" / "__init__.py" in inner
    for path in inner:
        body = tree_of(path).body
        code = [node for node in body if not isinstance(node, ast.Expr)]
        assert not code, f"{path} must hold no code, line {code[0].lineno} does"


@pytest.mark.parametrize(
    ("path", "module", "words"),
    [
        ("apu_casadi/core/signals.py", "apu_casadi.gaspath.gas", "upward"),
        ("apu_casadi/core/simulation.py", "apu_casadi.machine.generator", "upward"),
        ("apu_casadi/machine/wrsg.py", "apu_casadi.gaspath.components.shaft", "sideways"),
        ("apu_casadi/gaspath/components/shaft.py", "apu_casadi.machine.park", "sideways"),
        ("apu_casadi/machine/generator.py", "apu_casadi.unit.apu", "upward"),
        ("apu_casadi/unit/apu.py", "scenarios.figures.runplots", "upward"),
        ("apu_casadi/unit/apu.py", "apu_casadi", "name the module"),
        ("apu_casadi/unit/apu.py", "scenarios.schema", "upward"),
        ("apu_casadi/unit/apu.py", "estimators.filters.ekf", "upward"),
        (
            "estimators/filters/ekf.py",
            "apu_casadi.machine.generator",
            "may import apu_casadi.core,",
        ),
        ("estimators/models/recording.py", "estimators.filters.belief", "upward"),
        ("estimators/detection/glr.py", "apu_casadi.gaspath.gasgenerator", "sideways"),
        ("estimators/detection/glr.py", "estimators.apu.gaspath", "upward"),
        ("estimators/apu/gaspath.py", "scenarios.registry", "upward"),
        ("scenarios/cli.py", "tests.test_cli", "nothing imports tests"),
        ("scenarios/cli.py", "matplotlib.pyplot", "only scenarios.figures"),
        ("scenarios/cli.py", ".commands", "relative"),
        ("scenarios/shell/guard.py", "scenarios.registry", "upward"),
        ("scenarios/studies/jointrun.py", "scenarios.bench.benchmarks", "sideways"),
    ],
)
def test_the_rules_bite(path, module, words):
    """Forbidden imports, one of each kind: a rule that never fires guards nothing."""
    assert words in (verdict(ROOT / path, module) or "")


@pytest.mark.parametrize(
    ("path", "module"),
    [
        ("apu_casadi/machine/wrsg.py", "apu_casadi.machine.park"),
        ("apu_casadi/unit/multirate.py", "apu_casadi.gaspath.steady.trimming"),
        ("estimators/filters/ekf.py", "apu_casadi.core.statespace"),
        ("estimators/filters/ekf.py", "estimators.filters.belief"),
        ("estimators/detection/glr.py", "estimators.detection.signatures"),
        ("estimators/apu/joint.py", "apu_casadi.unit.apu"),
        ("scenarios/commands/run.py", "apu_casadi.unit.apu"),
        ("scenarios/figures/figstyle.py", "matplotlib.figure"),
        ("apu_casadi/unit/apu.py", "numpy"),
    ],
)
def test_the_rules_let_through(path, module):
    """Imports that the house design allows."""
    assert verdict(ROOT / path, module) is None
