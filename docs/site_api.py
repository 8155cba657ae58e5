"""Pages of the API: one for each module, with a table of what is in a package.

The text comes from docstrings by ``sphinx.ext.autodoc``.  Names and first lines are read from the
files, so that nothing has to be imported twice.
"""

import ast
from pathlib import Path

PACKAGES = ("apu_casadi", "estimators", "scenarios")
FRONT = "apu_casadi"
"""The package whose own names stand in the modules that they come from."""
_TABLE = """\
.. list-table::
   :widths: auto

{rows}

.. toctree::
   :hidden:

{names}
"""


def modules(root: Path) -> dict[str, Path]:
    """Return the file of each module below the packages of a folder, by dotted name."""
    found = {}
    for path in (p for package in PACKAGES for p in sorted((root / package).rglob("*.py"))):
        parts = path.relative_to(root).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        if not any(p.startswith("_") for p in parts) and (path.parent / "__init__.py").is_file():
            found[".".join(parts)] = path
    return found


def first_line(path: Path) -> str:
    """Return the first sentence of a module's docstring."""
    said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(said.split("\n\n", 1)[0].split())


def page(name: str, known: dict[str, Path]) -> str:
    """Return the page of a module as reStructuredText."""
    text = [name, "=" * len(name), "", f".. automodule:: {name}"]
    text += ["   :members:", "   :show-inheritance:"] if name != FRONT else []
    inner = [n for n in known if n.rpartition(".")[0] == name]
    if inner:
        rows = [f"   * - :doc:`{n}`\n     - {first_line(known[n])}" for n in inner]
        names = [f"   {n}" for n in inner]
        text += ["", _TABLE.format(rows="\n".join(rows), names="\n".join(names))]
    return "\n".join([*text, ""])


def pages(root: Path) -> dict[str, str]:
    """Return name and text of every page."""
    known = modules(root)
    return {f"{name}.rst": page(name, known) for name in known}
