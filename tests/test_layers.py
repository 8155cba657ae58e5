"""Who may import whom: the folders and modules form layers, and imports point downwards.

The rules are the tables below.  Every import counts, also one inside a function or under
TYPE_CHECKING: a dependency is a dependency.
"""

import ast
from importlib.util import find_spec
from pathlib import Path

import pytest

# the folder of the packages: a checkout, or site-packages when the wheel is tested
ROOT = Path(find_spec("apu_casadi").origin).parents[1]
PACKAGES = ("apu_casadi", "estimators", "scenarios")

# Bottom first.  A module may import the layers below its own, and its neighbours only if NEIGHBOURS
# says so.  "components" and "machine" stand for all modules in these folders.
LAYERS = (
    ("interrupts",),
    ("errors", "checked", "sharing", "conditions"),
    ("signals", "parameters", "mapcheck", "cachefolder", "calling", "files", "filearrays"),
    ("netcdf3", "runstorage"),
    ("statespace", "results", "backend", "runwords"),
    ("means",),
    # solvers: they know nothing of turbines or windings, since those come above
    ("rootfinding", "discretisation", "simulation"),
    ("gas", "maptable"),
    ("mapfiles",),
    ("atmosphere", "maps"),
    ("components", "machine"),
    ("cycle",),
    ("gasgenerator", "generator", "terminalmodel"),
    ("trimkernel",),
    ("steadypoint",),
    ("trimsolver",),
    ("trimbranch",),
    ("trimming", "trimbatch", "propagation"),
    ("calibration", "meanstep"),
    ("control", "events"),
    ("apu", "runrecord"),
    ("jointstep", "validity"),
    ("machinestep",),
    ("jointmodel", "multirate"),
    ("linearisation", "monolithic"),
)
NEIGHBOURS = {
    "checked": {"errors"},
    "components": {"components"},
    "machine": {"machine"},
}
# What draws, and all that it may see.  Nothing else in apu_casadi imports these, and nothing else
# uses matplotlib.
ONLY = {
    "figstyle": set(),
    "plotting": {"results", "errors", "figstyle", "files", "runwords"},
    # these two draw what they are given a model of: eigenvalues, operating lines on a map
    "eigenplot": {"errors", "figstyle", "linearisation"},
    "benchplot": {"errors", "figstyle"},
    "isolationplot": {"errors", "figstyle"},
    "fitplot": {"errors", "figstyle"},
    "jointestimateplot": {"errors", "figstyle"},
    "studyplot": {"errors", "figstyle"},
    "estimationplot": {"errors", "figstyle"},
    "mapplots": {
        "results",
        "errors",
        "figstyle",
        "maps",
        "steadypoint",
        "trimming",
        "gasgenerator",
    },
}
# Upward imports that are known, with the reason; an entry that is no longer needed fails.
EXCEPTIONS: dict[tuple[str, str], str] = {}
# apu_casadi/__init__.py is the front door: it names modules, and no module comes in through it.
# Estimators know f, g and names; of the solvers only how to make a step of f and to compile it.
ESTIMATORS = {
    "statespace", "signals", "results", "errors", "checked", "sharing", "backend", "discretisation",
    "interrupts",
}  # fmt: skip

RANK = {unit: k for k, layer in enumerate(LAYERS) for unit in layer}


def imports(path: Path) -> list[tuple[int, str]]:
    """Return (line, dotted module) of every import; ``from package import module`` is resolved."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, a.name) for a in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                found.append((node.lineno, "." * node.level + (node.module or "")))
                continue
            module = node.module or ""
            for a in node.names:
                inner = ROOT.joinpath(*module.split("."), a.name)
                is_module = inner.with_suffix(".py").exists() or (inner / "__init__.py").exists()
                found.append((node.lineno, f"{module}.{a.name}" if is_module else module))
    return sorted(set(found))


def unit_of(dotted: str) -> str:
    """``apu_casadi.machine.load`` -> ``machine``; ``apu_casadi`` -> ``""``, the front door."""
    return dotted.split(".")[1] if "." in dotted else ""


def own_unit(path: Path) -> str:
    """Return the unit that a file of apu_casadi belongs to."""
    name = path.relative_to(ROOT / "apu_casadi").parts[0].removesuffix(".py")
    return "" if name == "__init__" else name


def verdict(path: Path, module: str) -> str | None:
    """Return what is wrong with the import of ``module`` by ``path``; None if it is allowed."""
    package = path.relative_to(ROOT).parts[0]
    top = module.split(".")[0]
    if module.startswith("."):
        return "relative import; write the absolute one"
    if top in ("tests", "notebooks"):
        return f"nothing imports {top}"
    if top == "matplotlib" and not (package == "apu_casadi" and own_unit(path) in ONLY):
        return f"only {', '.join(ONLY)} of apu_casadi use matplotlib; draw there"
    if top not in PACKAGES or package == "scenarios":
        return None
    if top == "scenarios":
        return "nothing imports scenarios; move what is shared down into apu_casadi"
    target = unit_of(module)
    if package == "estimators":
        if top == "estimators" or target in ESTIMATORS:
            return None
        return f"estimators import only {', '.join(sorted(ESTIMATORS))} of apu_casadi"
    if top == "estimators":
        return "apu_casadi does not know estimators"
    mine = own_unit(path)
    if mine in ("", "data"):
        return None if mine == "" else "data holds no code"
    if target == "":
        return "name the module (from apu_casadi.signals import Signals), not the package"
    if mine in ONLY:
        if target in ONLY[mine]:
            return None
        return f"{mine} sees only {', '.join(sorted(ONLY[mine]))}"
    if target in ONLY:
        return f"no model or solver imports {target}"
    if mine not in RANK or target not in RANK:
        return None  # test_every_module_has_a_place tells, once
    if RANK[target] < RANK[mine] or target in NEIGHBOURS.get(mine, ()):
        return None
    if (mine, target) in EXCEPTIONS:
        return None
    how = "upward" if RANK[target] > RANK[mine] else "sideways"
    return f"{how} import: {mine} is in layer {RANK[mine]}, {target} in layer {RANK[target]}"


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_point_downwards(package):
    """The tables above; every offence is listed with its line."""
    wrong = []
    for path in sorted((ROOT / package).rglob("*.py")):
        for line, module in imports(path):
            why = verdict(path, module)
            if why:
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {module}: {why}")
    assert not wrong, "\n" + "\n".join(wrong)


def test_every_module_has_a_place():
    """A new module must be put into a layer, or the rules would silently pass it over."""
    units = {own_unit(p) for p in (ROOT / "apu_casadi").rglob("*.py")} - {"", "data"}
    missing = units - set(RANK) - set(ONLY)
    assert not missing, f"no layer for {', '.join(sorted(missing))}: extend LAYERS in {__file__}"


def test_no_exception_is_stale():
    """An exception outlives its reason unless something asks."""
    used = {
        (own_unit(path), unit_of(module))
        for path in (ROOT / "apu_casadi").rglob("*.py")
        for _, module in imports(path)
    }
    stale = set(EXCEPTIONS) - used
    assert not stale, f"remove from EXCEPTIONS of {Path(__file__).name}: {stale}"


def test_inner_packages_hold_no_code():
    """Names have one home: only the front door re-exports; a docstring is welcome."""
    inner = [p for top in ("apu_casadi", "estimators") for p in (ROOT / top).glob("*/__init__.py")]
    assert ROOT / "estimators" / "detection" / "__init__.py" in inner
    for path in inner:
        body = ast.parse(path.read_text(encoding="utf-8")).body
        code = [node for node in body if not isinstance(node, ast.Expr)]
        assert not code, f"{path} must hold no code, line {code[0].lineno} does"


@pytest.mark.parametrize(
    ("path", "module", "words"),
    [
        ("apu_casadi/signals.py", "apu_casadi.gas", "upward import: signals is in layer 2"),
        ("apu_casadi/simulation.py", "apu_casadi.generator", "upward"),
        ("apu_casadi/machine/wrsg.py", "apu_casadi.components.shaft", "sideways"),
        ("apu_casadi/components/shaft.py", "apu_casadi.machine.park", "sideways"),
        ("apu_casadi/generator.py", "apu_casadi.gasgenerator", "sideways"),
        (
            "apu_casadi/plotting.py",
            "apu_casadi.apu",
            "plotting sees only errors, figstyle, files, results",
        ),
        ("apu_casadi/apu.py", "apu_casadi.plotting", "no model or solver imports plotting"),
        ("apu_casadi/apu.py", "apu_casadi", "name the module"),
        ("apu_casadi/apu.py", "scenarios.schema", "nothing imports scenarios"),
        ("apu_casadi/apu.py", "estimators.ekf", "does not know estimators"),
        ("estimators/ekf.py", "apu_casadi.generator", "estimators import only"),
        ("estimators/detection/glr.py", "apu_casadi.gasgenerator", "estimators import only"),
        (
            "estimators/detection/glr.py",
            "scenarios.estimation.gaspath",
            "nothing imports scenarios",
        ),
        ("scenarios/cli.py", "tests.test_cli", "nothing imports tests"),
        ("scenarios/cli.py", "matplotlib.pyplot", "only figstyle, plotting"),
        ("scenarios/cli.py", ".commands", "relative"),
    ],
)
def test_the_rules_bite(path, module, words):
    """Forbidden imports, one of each kind: a rule that never fires guards nothing."""
    assert words in (verdict(ROOT / path, module) or "")


@pytest.mark.parametrize(
    ("path", "module"),
    [
        ("apu_casadi/machine/wrsg.py", "apu_casadi.machine.park"),
        ("apu_casadi/multirate.py", "apu_casadi.trimming"),
        ("estimators/ekf.py", "apu_casadi.statespace"),
        ("estimators/ekf.py", "estimators.belief"),
        ("estimators/detection/glr.py", "estimators.detection.signatures"),
        ("scenarios/cli.py", "apu_casadi.apu"),
        ("apu_casadi/apu.py", "numpy"),
    ],
)
def test_the_rules_let_through(path, module):
    """Imports that the house design allows."""
    assert verdict(ROOT / path, module) is None
