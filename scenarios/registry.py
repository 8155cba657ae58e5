"""The scenario library, and running a scenario: by name, from a file, or from Python.

>>> from scenarios import registry
>>> ds = registry.run("joint")  # doctest: +SKIP
>>> ds["T4"].sel(time=5.0)  # doctest: +SKIP
"""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import ApuWarning, ScenarioError, ValidityError, nearest
from apu_casadi.core.sharing import once
from scenarios.doubts import doubts
from scenarios.schema import Scenario
from scenarios.shell import jsontext
from scenarios.units import engine_digest, engine_file, of_scenario

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.core.lanes.together import Course
    from apu_casadi.unit.apu import Apu
    from scenarios.figures.drawnas import DrawnAs

__all__ = [
    "assumed",
    "conditions",
    "course",
    "engine_digest",
    "engine_file",
    "get",
    "implausible",
    "joint_arguments",
    "list_scenarios",
    "name_of",
    "prepare",
    "profiles",
    "run",
    "summary",
    "unit_for",
    "write",
]

Progress = Callable[[float, float], None]
"""Called with the simulated and the total time [s]."""


@once
def _library() -> dict[str, Scenario]:
    made = {}
    folder = files("scenarios") / "library"
    for entry in sorted(folder.iterdir(), key=lambda e: e.name):
        if entry.name.endswith(".toml"):
            text = entry.read_text(encoding="utf-8")
            s = Scenario.from_toml_text(text, f"library/{entry.name}")
            if f"{s.name}.toml" != entry.name:
                raise ScenarioError(f"library/{entry.name}: its name is {s.name!r}")
            made[s.name] = s
    return made


def list_scenarios() -> list[Scenario]:
    """Return the scenarios of the library in alphabetical order, ``joint`` first."""
    return sorted(_library().values(), key=lambda s: (s.name != "joint", s.name))


def get(name_or_path: str | os.PathLike[str], **instead: Any) -> Scenario:
    """Return a scenario of the library, or read a ``.toml`` or ``.py`` file.

    Something is taken as a file if it ends in ``.toml`` or ``.py`` or has a folder in it.  A Python
    file is executed: run only what you trust.  ``instead`` are attributes that go before those of
    the file, such as ``engine``: a fault of its third generator is none of the default unit.

    Raises:
        ScenarioError: unknown name (the nearest is named), missing file, wrong key or value.

    Warns:
        ApuWarning: a number of a file that is possible and most often a slip.
    """
    text = os.fspath(name_or_path)
    path = Path(text)
    if path.suffix in (".py", ".toml"):
        read = Scenario.from_python if path.suffix == ".py" else Scenario.from_toml
        s = read(path, instead)
        for words in implausible(s):
            warnings.warn(ApuWarning(f"{path}: {words}"), stacklevel=2)
        return s
    library = _library()
    if text in library:
        return library[text].change(**instead)
    if path.name != text or path.exists():
        raise ScenarioError(f"{text}: a scenario file ends in .toml or .py")
    raise ScenarioError(f"unknown scenario {text!r} {nearest(text, library)}")


def run(
    scenario: Scenario | str | os.PathLike[str],
    *,
    out: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
    solver: str = "auto",
    phasors: bool = False,
    strict: bool = False,
    **overrides: Any,
) -> xr.Dataset:
    """Run a scenario and return the joint dataset.

    Args:
        scenario: a description, a name of the library, or a file.
        out: folder for the netCDF file, the figures and the summary; None writes nothing.
        progress: called with the simulated and the total time [s].
        solver: ``"auto"``, ``"cvodes"``, ``"idas"`` or ``"propagator"``: see
            :func:`apu_casadi.unit.multirate.simulate_joint`.
        phasors: keep the fundamental phasors of voltages and currents of each exchange step.
        strict: stop with an error, at its instant and in its phase, where there would be a warning.
        overrides: attributes of the scenario to change (``waveform_dt=None``, ``seed=3``,
            ``parameters={"machine.r_s": 0.01}``).

    Raises:
        ScenarioError, ParameterError: a wrong description; OperatingPointError, SimulationError :
            the unit cannot run so; DataError : ``out`` cannot be written.
    """
    unit = {n: v for n, v in overrides.items() if n in ("engine", "governor")}
    s = scenario if isinstance(scenario, Scenario) else get(scenario, **unit)
    if overrides:
        s = s.change(**overrides)
    if out is not None:
        prepare(out)
    try:
        ds = _simulate(s, progress, solver, phasors, **({"strict": True} if strict else {}))
    except ValidityError as error:
        inside = [p["name"] for p in s.phase_table() if p["start"] < error.t + 1e-9]
        raise ValidityError(f"in phase {inside[-1]!r}: {error.words}", error.t) from None
    _tell(s, ds)
    if out is not None:
        write(ds, out)
    return ds


def course(s: Scenario, *, solver: str = "auto") -> Course[xr.Dataset]:
    """Do what :func:`run` does as a member of an ensemble: pause where others are waited for."""
    from apu_casadi.unit.ensemble import course_of

    ds = yield from course_of({**joint_arguments(s), "solver": solver})
    _tell(s, ds)
    return ds


def _tell(s: Scenario, ds: xr.Dataset) -> None:
    """Let a dataset tell the scenario that made it."""
    from apu_casadi.unit.departures import name_phases

    ds.attrs |= {"title": s.title or s.name, "scenario": s.to_json()}
    ds.attrs["phases"] = json.dumps(s.phase_table(), ensure_ascii=False)
    name_phases(ds)
    if strange := implausible(s):
        ds.attrs["implausible"] = json.dumps(strange, ensure_ascii=False)
    if s.engine:
        ds.attrs["assumed"] = json.dumps(assumed(s), ensure_ascii=False)


def unit_for(s: Scenario) -> Apu:
    """Return the unit that a scenario is about."""
    return of_scenario(s.engine, s.governor, s.parameters)


def implausible(s: Scenario) -> list[str]:
    """Return what is possible in a scenario and most often a slip, each with its place."""
    return doubts(s, unit_for(s), engine_file(s.engine).unit)


def assumed(s: Scenario) -> list[dict[str, Any]]:
    """Return what the engine's file of a scenario leaves to the default unit: rows for JSON."""
    rows = engine_file(s.engine).assumed if s.engine else ()
    return [a._asdict() for a in rows if a.name not in s.parameters]


def _simulate(
    s: Scenario, progress: Progress | None, solver: str, phasors: bool, *, strict: bool = False
) -> xr.Dataset:
    from apu_casadi.unit.multirate import simulate_joint

    more: dict[str, Any] = {"strict": strict, "progress": progress}
    return simulate_joint(**joint_arguments(s), solver=solver, phasors=phasors, **more)


def joint_arguments(s: Scenario) -> dict[str, Any]:
    """Return what a scenario asks of :func:`apu_casadi.unit.multirate.simulate_joint`."""
    same = ("duration", "ambient", "dt", "exchange", "waveform_dt", "noise", "seed")
    return {
        "apu": unit_for(s),
        **{n: getattr(s, n) for n in same},
        **s.start(),
        "events": s.events(),
        "limits": engine_file(s.engine).limits,
    }


def prepare(out: str | os.PathLike[str]) -> Path:
    """Make the folder for results, before a long run; :class:`DataError` if that is impossible."""
    from apu_casadi.core import files

    return files.folder(out)


def name_of(ds: xr.Dataset) -> str:
    """Return the name of the scenario that made a dataset, ``"result"`` if it is not recorded."""
    try:
        return str(json.loads(ds.attrs["scenario"])["name"])
    except (KeyError, TypeError, ValueError):
        return "result"


_TOLD = {"assumed": "assumed_engine", "implausible": "implausible"}
"""Attributes of some runs, JSON lists, and their names in the summary."""


def summary(ds: xr.Dataset) -> dict[str, Any]:
    """Return name, title and the phase-by-phase summary of a run, ready for JSON."""
    from apu_casadi.unit.departures import by_phase, rows_of
    from apu_casadi.unit.runsummary import phase_summary
    from apu_casadi.unit.validity import found_in

    scenario, rows = _table(ds, "scenario"), phase_summary(ds)
    return {
        "scenario": name_of(ds),
        "title": str(scenario.get("title", "")),
        "apu_casadi_version": str(ds.attrs.get("apu_casadi_version", "")),
        **{k: scenario[k] for k in ("engine", "governor", "extensions") if k in scenario},
        **{k: json.loads(ds.attrs[a]) for a, k in _TOLD.items() if a in ds.attrs},
        **conditions(ds),
        "profiles": profiles(ds),
        "phases": [r | {"beyond": b} for r, b in zip(rows, by_phase(ds), strict=True)],
        "validity": rows_of(ds),
        "warnings": found_in(ds),
    }


def conditions(ds: xr.Dataset) -> dict[str, Any]:
    """Return what a run was made with, ready for JSON: ambient, solver, exchange, seed.

    What the dataset does not tell is None.
    """
    solver = _table(ds, "solver")
    seed, error = ds.attrs.get("seed", "none"), ds.attrs.get("exchange_error", math.nan)
    return {
        "ambient": _table(ds, "ambient") or None,
        "solver": {k: solver[k] for k in ("solver", "rtol", "atol") if k in solver} or None,
        "exchange": solver.get("exchange"),
        "dt": solver.get("dt"),
        "exchange_error": float(error) if math.isfinite(error) else None,
        "seed": None if isinstance(seed, str) else int(seed),
    }


def profiles(ds: xr.Dataset) -> list[str]:
    """Return the profiles that a run followed, one in words each."""
    try:
        given = json.loads(ds.attrs["profiles"])
        return [_profile_words(**g) for g in given]
    except (KeyError, TypeError, ValueError):
        return []


def _profile_words(
    t: float, part: str, name: str, profile: str, generator: int | None = None
) -> str:
    of = f"{part} {name}" if part in ("load", "fault") else name
    of += "" if generator is None else f" of generator {generator}"
    return f"{of}{f', from {t:g} s' if t else ''}: {profile}"


def _table(ds: xr.Dataset, name: str) -> dict[str, Any]:
    """Return an attribute that is a JSON table; {} where it is absent or something else."""
    try:
        found = json.loads(ds.attrs[name])
    except (KeyError, TypeError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write(
    ds: xr.Dataset,
    out: str | os.PathLike[str],
    *,
    figures: bool | DrawnAs = True,
    name: str | None = None,
    formats: Sequence[str] = ("nc",),
) -> list[Path]:
    """Write data, ``summary.json`` and the figures into a folder; return the paths.

    Args:
        ds: what a run gave.
        out: the folder.
        figures: whether they are drawn, or how.
        name: of the data, without ending; that of the scenario by default.
        formats: of the data (:data:`apu_casadi.core.resultformats.FORMATS`).

    Raises:
        ParameterError: an unknown format.
        DataError: the folder or a file cannot be written.
    """
    from apu_casadi.core import files
    from apu_casadi.core.resultformats import save_as

    folder = prepare(out)
    made = [p for form in formats for p in save_as(ds, folder / (name or name_of(ds)), form)]
    text = jsontext.dumps(summary(ds))
    made.append(files.write_text(folder / "summary.json", text + "\n"))
    if figures:
        from scenarios.figures import plotting

        made += plotting.save_figures(ds, folder, None if figures is True else figures)
    return made
