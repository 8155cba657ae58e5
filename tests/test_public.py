"""The public surface: what can be imported, and that all of it is documented and typed."""

import ast
import importlib
import json
import pkgutil
import subprocess
import sys
from importlib.metadata import distribution, packages_distributions, version
from importlib.util import find_spec
from pathlib import Path

import pytest

import apu_casadi
import estimators
import scenarios

PUBLIC = {
    "Ambient",
    "Apu",
    "ApuError",
    "ConstantPowerLoad",
    "FaultChange",
    "GasGenerator",
    "Generator",
    "Growth",
    "HealthChange",
    "LoadChange",
    "Noise",
    "OnOff",
    "OpenLoad",
    "OperatingPoint",
    "Points",
    "Ramp",
    "SeriesLoad",
    "Signal",
    "Signals",
    "SpeedChange",
    "StateSpace",
    "Steps",
    "Ttsc",
    "__version__",
    "simulate_ensemble",
    "simulate_joint",
    "trim",
    "trim_batch",
    "varying",
}


def modules():
    """Return the names of all modules of the three packages."""
    names = []
    for package in (apu_casadi, estimators, scenarios):
        names.append(package.__name__)
        found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        names += [m.name for m in found if not m.name.endswith("__main__")]
    return names


MODULES = modules()


def test_the_list_is_pinned():
    """House design: adding or removing a public name is a decision, made here."""
    assert set(apu_casadi.__all__) == PUBLIC
    assert len(apu_casadi.__all__) == len(PUBLIC)
    assert set(dir(apu_casadi)) >= PUBLIC


@pytest.mark.parametrize("name", sorted(PUBLIC - {"__version__"}))
def test_every_name_loads_and_comes_from_where_it_is_defined(name):
    """The lazy table must point to the module that defines the name, not to one that imports it."""
    thing = getattr(apu_casadi, name)
    assert thing.__name__ == name
    assert apu_casadi._HOME[name] == thing.__module__


def test_no_public_name_hides_a_module():
    """``from apu_casadi import x`` must mean one thing only."""
    inside = {m.rpartition(".")[2] for m in MODULES if m.startswith("apu_casadi.")}
    assert not PUBLIC & inside


def test_an_unknown_name_is_refused():
    """PEP 562: ``__getattr__`` raises AttributeError, and ``from`` turns it into ImportError."""
    with pytest.raises(AttributeError, match="'apu_casadi' has no attribute 'Turbofan'"):
        _ = apu_casadi.Turbofan
    with pytest.raises(ImportError):
        exec("from apu_casadi import Turbofan")


def test_the_version_is_that_of_the_distribution():
    """One source of the version: the metadata."""
    assert apu_casadi.__version__ == version("apu-casadi")


@pytest.mark.parametrize("package", ["apu_casadi", "estimators", "scenarios"])
def test_each_package_belongs_to_this_distribution_alone(package):
    """``estimators`` and ``scenarios`` are other people's names too; an overwrite would be silent.

    An editable install records no files of the packages, so that nothing can be overwritten.
    """
    owners = packages_distributions().get(package)
    if owners is None:
        origin = json.loads(distribution("apu-casadi").read_text("direct_url.json"))
        assert origin["dir_info"]["editable"]
    else:
        assert owners == ["apu-casadi"]


def test_import_is_light():
    """Bare import loads no numerical library: it costs milliseconds, and `apu list` with it."""
    code = (
        "import sys, apu_casadi\n"
        "heavy = ('numpy', 'casadi', 'scipy', 'xarray', 'matplotlib', 'tqdm')\n"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def tree(name):
    """Return the syntax tree of a module: read, not imported, since some need optional packages."""
    return ast.parse(Path(find_spec(name).origin).read_text(encoding="utf-8"))


def public(node, prefix):
    """Yield (dotted name, node) of the public classes, functions and methods below a node."""
    for child in node.body:
        if isinstance(child, ast.ClassDef | ast.FunctionDef) and not child.name.startswith("_"):
            yield f"{prefix}.{child.name}", child
            if isinstance(child, ast.ClassDef):
                yield from public(child, f"{prefix}.{child.name}")


@pytest.mark.parametrize("name", MODULES)
def test_everything_public_has_a_docstring(name):
    """House design: what a user can reach says what it does, with units and shapes."""
    module = tree(name)
    bare = [name] if module.body and not ast.get_docstring(module) else []
    bare += [label for label, node in public(module, name) if not ast.get_docstring(node)]
    assert not bare, f"without docstring: {', '.join(bare)}"


@pytest.mark.parametrize("name", MODULES)
def test_everything_public_is_typed(name):
    """``py.typed`` is a promise: every public function states its arguments and its result."""
    untyped = []
    for node in ast.walk(tree(name)):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        a = node.args
        named = [*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg]
        loose = [x.arg for x in named if x and not x.annotation and x.arg not in ("self", "cls")]
        if loose or node.returns is None:
            untyped.append(f"{name}:{node.lineno} {node.name}({', '.join(loose)})")
    assert not untyped, f"without types: {'; '.join(untyped)}"


@pytest.mark.parametrize("package", [apu_casadi, estimators, scenarios], ids=lambda p: p.__name__)
def test_type_information_is_shipped(package):
    """PEP 561: the marker file lies beside the package's ``__init__``."""
    assert (Path(package.__file__).parent / "py.typed").exists()


@pytest.mark.parametrize(
    ("package", "path"),
    [
        ("apu_casadi", "gaspath/data/axi5.csv"),
        ("apu_casadi", "gaspath/data/nasa9.csv"),
        ("scenarios", "library/joint.toml"),
        ("scenarios", "reference/table4.csv"),
    ],
)
def test_data_files_are_shipped(package, path):
    """A wheel without its data imports well and fails at the first use."""
    assert (Path(importlib.import_module(package).__file__).parent / path).is_file()
