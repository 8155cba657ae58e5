"""An FMU: description, sources, and a library compiled for this platform, in one archive."""

from __future__ import annotations

import platform
import subprocess
import sys
import tempfile
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
from scenarios.export.ccode import array, generated, number, work
from scenarios.export.description import described, source_names
from scenarios.export.fmumodel import CONSTANTS, FmuModel

VERSIONS = (3, 2)
_COMMON = ("unit.c", "unit.h")
_FLAGS = ["-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-fno-math-errno"]
_TIMEOUT = 900.0  # s
_ABSENT = "N_Z N_MEANS M_TH M_U M_X".split()  # sizes of arrays that C wants not to be empty


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
    return {**texts, "model.h": head, "model.c": f'{code}\n#include "model.h"\n\n{arrays}'}


def _model_h(model: FmuModel, token: str) -> tuple[str, str]:
    """Sizes, constants and prototypes, and the arrays that they tell of."""
    roles = {"U": "input", "P": "parameter", "X": "state", "Y": "output"}
    sizes = dict.fromkeys(_ABSENT, 1) | model.sizes
    sizes |= {f"N_{k}": len(model.of(role)) for k, role in roles.items()}
    for i, n in enumerate(("W_ARG", "W_RES", "W_IW", "W_W")):
        sizes[n] = max(work(f)[i] for f in model.functions)
    numbers: dict[str, Any] = {}
    for k in "UPX":
        numbers[f"{k}_START"] = [v.start for v in model.of(roles[k])]
    for k in "UP":
        numbers[f"{k}_LEAST"] = [v.least for v in model.of(roles[k])]
        numbers[f"{k}_MOST"] = [v.most for v in model.of(roles[k])]
    numbers["X_NOMINAL"] = [float(v.signal.nominal) for v in model.of("state")]
    numbers |= model.arrays
    lines = ["/* Sizes and numbers of this model. */", "#ifndef MODEL_H", "#define MODEL_H", ""]
    lines += ["enum {", ",\n".join(f"  {n} = {v}" for n, v in sizes.items()), "};", ""]
    lines += [f"#define {n} {number(v)}" for n, v in CONSTANTS.items()]
    lines += [f'#define NAME "{model.name}"', f'#define TOKEN "{token}"', ""]
    definitions = []
    for name, values in numbers.items():
        declared, defined = _array(name, values)
        lines.append(declared)
        definitions.append(defined)
    work_space = "(const double **arg, double **res, long long int *iw, double *w, int mem);"
    lines += ["", *(f"int {f.name()}{work_space}" for f in model.functions), "", "#endif", ""]
    return "\n".join(lines), "\n".join(definitions)


def _array(name: str, values: Any) -> tuple[str, str]:
    a = np.asarray(values)
    whole = a.dtype.kind == "i" or name in ("RESET", "M_AT", "MEAN_OF", "Y_OF")
    kind = "int" if whole else "double"
    entries = [str(int(v)) if whole else _finite(float(v)) for v in a.ravel()]
    if a.ndim == 2:
        rows = ", ".join("{" + ", ".join(entries[i : i + a.shape[1]]) + "}"
                         for i in range(0, a.size, a.shape[1]))  # fmt: skip
        head = f"const {kind} {name}[{a.shape[0]}][{a.shape[1]}]"
        return f"extern {head};", f"{head} = {{{rows}}};\n"
    size = max(1, a.size)
    return f"extern const {kind} {name}[{size}];", array(f"const {kind} ", name, entries)


def _finite(value: float) -> str:
    return number(max(-1e300, min(1e300, value)))


def build(model: FmuModel, path: Path, *, fmi: int = 3, compile_it: bool = True) -> Path:
    """Write an FMU with sources and, by default, a library for this platform; return its path.

    Raises:
        ParameterError: a version of FMI that is not made.
        BackendError: there is no C compiler, or it had something to say.
        DataError: the file cannot be written.
    """
    if fmi not in VERSIONS:
        raise ParameterError(f"FMI version {fmi!r}: one of {', '.join(map(str, VERSIONS))}")
    text, token = described(model, fmi, model.name)
    texts = sources(model, fmi, token)
    contents: dict[str, bytes] = {"modelDescription.xml": text.encode()}
    contents |= {f"sources/{n}": t.encode() for n, t in texts.items()}
    if fmi == 3:
        contents["sources/buildDescription.xml"] = _build_description(model).encode()
    if compile_it:
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
    with tempfile.TemporaryDirectory() as folder:
        for n, t in texts.items():
            (Path(folder) / n).write_text(t, encoding="utf-8")
        line = [*command, *_FLAGS, *compiled, "-o", "library", "-lm"]
        done = subprocess.run(
            line, cwd=folder, capture_output=True, text=True, timeout=_TIMEOUT, check=False
        )
        if done.returncode:
            raise BackendError(f"{name}: {command[0]}: {' '.join(done.stderr.split())[:300]}")
        return (Path(folder) / "library").read_bytes()


def _build_description(model: FmuModel) -> str:
    root = Xml.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    one = Xml.SubElement(root, "BuildConfiguration", {"modelIdentifier": model.name})
    group = Xml.SubElement(one, "SourceFileSet", {"language": "C99"})
    for name in source_names(model, 3):
        Xml.SubElement(group, "SourceFile", {"name": name})
    Xml.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(root, "unicode") + "\n"


