"""An FMU: description, sources, and a library compiled for this platform, in one archive."""

from __future__ import annotations

import platform
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from importlib.resources import files as resources
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.backend import find_compiler
from apu_casadi.core.errors import BackendError, ParameterError
from apu_casadi.unit.stepmeans import MEANS
from scenarios.export.ccode import generated, number, work
from scenarios.export.description import described, source_names, text_of
from scenarios.export.fmumodel import CONSTANTS, PARTS, FmuModel, Machine

VERSIONS = (3, 2)
_COMMON = ("unit.c", "unit.h")
_FLAGS = ["-std=c99", "-O1", "-fPIC", "-shared", "-fvisibility=hidden", "-fno-math-errno"]
_TIMEOUT = 900.0  # s
# sizes of arrays that C wants not to be empty
_ABSENT = ["N_Z", "N_MEANS", "N_GENERATORS", "M_TH", "M_U"]


def platform_folder(fmi: int) -> tuple[str, str]:
    """Return the folder of this platform's library, and the ending of its name."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(m := platform.machine().lower(), m)
    system, end = {"darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}.get(
        sys.platform, ("linux", ".so")
    )
    if fmi == 3:
        return f"{machine}-{system}", end
    bits = "64" if sys.maxsize > 1 << 32 else "32"
    return {"windows": "win"}.get(system, system) + bits, end


def sources(model: FmuModel, fmi: int, token: str) -> dict[str, str]:
    """Return the C files by name."""
    folder = resources("scenarios.export") / "sources"
    names = (f"fmi{fmi}.c", *_COMMON, *model.sources)
    texts = {n: (folder / n).read_text(encoding="utf-8") for n in names}
    head, arrays = _model_h(model, token)
    code = generated("model", model.functions)
    return {**texts, "model.h": head, "model.c": f'{code}\n#include "unit.h"\n\n{arrays}'}


def _model_h(model: FmuModel, token: str) -> tuple[str, str]:
    """Sizes, constants and prototypes, and the arrays that they tell of."""
    roles = {"U": "input", "P": "parameter", "X": "state", "Y": "output"}
    of = {k: model.of(role) for k, role in roles.items()}
    sizes = dict.fromkeys(_ABSENT, 1) | model.sizes | {f"N_{k}": len(v) for k, v in of.items()}
    for i, n in enumerate(("W_ARG", "W_RES", "W_IW", "W_W")):
        sizes[n] = max(work(f)[i] for f in model.functions)
    numbers: dict[str, Any] = {f"{k}_START": [v.start for v in of[k]] for k in "UPX"}
    numbers |= {f"{k}_LEAST": [v.least for v in of[k]] for k in "UP"}
    numbers |= {f"{k}_MOST": [v.most for v in of[k]] for k in "UP"}
    numbers["X_NOMINAL"] = [v.signal.nominal for v in of["X"]]
    made = [_array(n, np.asarray(v)) for n, v in (numbers | model.arrays).items()]
    constants = {n: number(v) for n, v in CONSTANTS.items()}
    constants |= {"NAME": f'"{model.name}"', "TOKEN": f'"{token}"'}
    takes = "(const double **arg, double **res, long long int *iw, double *w, int mem);"
    lines = ["/* Sizes and numbers of this model. */", "#ifndef MODEL_H", "#define MODEL_H", ""]
    lines += ["enum {", ",\n".join(f"  {n} = {v}" for n, v in sizes.items()), "};", ""]
    lines += [f"#define {n} {v}" for n, v in constants.items()]
    lines += [f"extern {head};" for head, _ in made]
    lines += [f"int {f.name()}{takes}" for f in model.functions]
    defined = [*(f"{h} =\n{v};" for h, v in made), *_machines(model.machines)]
    return "\n".join([*lines, "#endif", ""]), "\n".join([*defined, ""])


def _machines(machines: Sequence[Machine]) -> list[str]:
    """The table of generators, and its arrays."""
    lines, rows = [], []
    for k, m in enumerate(machines):
        ss, own = m.faulty, m.healthy.x.names
        parts: dict[str, Any] = {"healthy": ss.x.indices(own), "reset": m.new_states}
        parts |= {"means": ss.y.indices(MEANS)}
        arrays = {n: np.array(v, dtype=int) for n, v in parts.items()}
        arrays |= {"nominal": ss.x.nominals, "numbers": np.array(ss.numbers)}
        made = (_array(f"{n}_{k}", a) for n, a in arrays.items())
        lines += [f"static {head} =\n{values};" for head, values in made]
        both = {n: f"{{healthy{m.structure}_{n}, faulty{m.structure}_{n}}}" for n in PARTS}
        row = both | {"size": f"{{{len(own)}, {len(ss.x)}}}"} | {n: f"{n}_{k}" for n in arrays}
        counts = {"n_reset": len(m.new_states), "n_numbers": len(ss.numbers)}
        counts |= {"n_inputs": len(m.inputs), "n_fault": len(m.faults), "n_outputs": len(ss.y)}
        counts |= {"axis": m.axis, "angle": ss.x.index("theta_e"), "like": m.like, **m.at}
        rows.append("{" + ",\n".join(f".{n} = {v}" for n, v in (row | counts).items()) + "}")
    return [*lines, "const Equations MACHINES[] = {", ",\n".join(rows), "};"] if rows else []


def _array(name: str, a: np.ndarray) -> tuple[str, str]:
    """Head and values of a constant array, which C wants not to be empty."""
    whole = a.dtype.kind == "i"
    kind, shape = "int" if whole else "double", "".join(f"[{n or 1}]" for n in a.shape)

    def braced(part: Any) -> str:
        if part.ndim > 1:
            return "{" + ",\n".join(braced(row) for row in part) + "}"
        values = [str(v) if whole else number(max(-1e300, min(1e300, v))) for v in part.tolist()]
        rows = (", ".join(values[i : i + 4]) for i in range(0, len(values), 4))
        return "{" + ",\n".join(rows) + "}"

    return f"const {kind} {name}{shape}", braced(a if a.size else np.zeros(1, a.dtype))


def build(model: FmuModel, path: Path, *, fmi: int = 3, library: bool = True) -> Path:
    """Write an FMU with sources and, by default, a library for this platform; return its path.

    Raises:
        ParameterError: a version of FMI that is not made.
        BackendError: there is no C compiler, or it had something to say.
        DataError: the file cannot be written.
    """
    if fmi not in VERSIONS:
        raise ParameterError(f"FMI version {fmi!r}: one of {', '.join(map(str, VERSIONS))}")
    text, token = described(model, fmi)
    texts = sources(model, fmi, token)
    contents: dict[str, bytes] = {"modelDescription.xml": text.encode()}
    contents |= {f"sources/{n}": t.encode() for n, t in texts.items()}
    if fmi == 3:
        contents["sources/buildDescription.xml"] = _build_description(model).encode()
    if library:
        folder, end = platform_folder(fmi)
        contents[f"binaries/{folder}/{model.name}{end}"] = _library(
            model.name, texts, source_names(model, fmi)
        )
    with files.whole(path) as new, zipfile.ZipFile(new, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            # no date: the same model makes the same file
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return path


def _library(name: str, texts: dict[str, str], compiled: Sequence[str]) -> bytes:
    command = find_compiler()
    if command is None:
        raise BackendError(
            f"{name}: no C compiler found for the FMU's library; install one, set CC, or make an "
            "FMU of sources alone"
        )
    with files.work_folder() as folder:
        for n, t in texts.items():
            (folder / n).write_text(t, encoding="utf-8")
        line = [*command, *_FLAGS, *compiled, "-o", "library", "-lm"]
        done = subprocess.run(
            line, cwd=folder, capture_output=True, text=True, timeout=_TIMEOUT, check=False
        )
        if done.returncode:
            raise BackendError(f"{name}: {command[0]}: {' '.join(done.stderr.split())[:300]}")
        return (folder / "library").read_bytes()


def _build_description(model: FmuModel) -> str:
    root = Xml.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    one = Xml.SubElement(root, "BuildConfiguration", {"modelIdentifier": model.name})
    group = Xml.SubElement(one, "SourceFileSet", {"language": "C99"})
    for name in source_names(model, 3):
        Xml.SubElement(group, "SourceFile", {"name": name})
    return text_of(root)
