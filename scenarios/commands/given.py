"""What several commands are given in the same words: the day, the unit, names, numbers, pairs.

What a command assumed, it prints; the defaults of the day are those of
:mod:`apu_casadi.gaspath.conditions`.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from apu_casadi.core.errors import ApuWarning, ParameterError, nearest
from apu_casadi.core.version import installed
from apu_casadi.gaspath.conditions import CONDITIONS, DEFAULT_DAY, assumed_words, day_words
from apu_casadi.unit.usual import LOAD_SHARE

if TYPE_CHECKING:
    from argparse import Namespace

    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.gaspath.steady.steadypoint import Limits
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load
    from apu_casadi.machine.machinedata import MachineParameters
    from apu_casadi.unit.apu import Apu
    from apu_casadi.unit.enginefile import Engine
    from scenarios.figures.drawnas import DrawnAs
    from scenarios.schema import Scenario

TABLES = ("gas_generator", "compressor_map", "turbine_map")
"""Parts of a unit that a gas generator is made of; ``LIMITED`` with the limits of its points."""
LIMITED = (*TABLES, "limits")
MACHINE = ("machine", "exciter", "generator")
"""Those of a generator."""

_FLAGS = {"altitude": "--altitude M", "Mach": "--mach MA", "dT_isa": "--disa K"}
_FLAGS |= {"war": "--humidity --war RATIO"}

PARTS = """
--with FILE ... >extensions | a Python file of your own that registers loads, faults, sensors, ...
"""
UNIT = f"""{PARTS.rstrip()}
--engine FILE | another unit: its file, or the name of one that comes with the package (apu list);
              | what it does not give is the default unit's and is printed as assumed
"""


WHOLE = f"""{UNIT.rstrip()}
--governor NAME | another law of the speed governor, of --with (default: the scenario's, or PI)
"""


class Pair(NamedTuple):
    """What stands on both sides of ``NAME=VALUE``, and the whole as it was given."""

    name: str
    value: str
    item: str


def ambient_options(otherwise: str = "") -> str:
    """Return the options of ambient conditions, numbers, for :func:`scenarios.shell.usage.declare`.

    Args:
        otherwise: what stands in for an option before the default day does, for the help.
    """
    lines = []
    for name, c in CONDITIONS.items():
        unit = "" if c.unit == "1" else f", {c.unit}"
        help_ = f"{c.doc}{unit} (default: {otherwise}{c.default:g})"
        lines.append(f"{_FLAGS[name]} float >{name} | {help_}\n")
    return "".join(lines)


def ambient_given(args: Namespace) -> dict[str, float | None]:
    """Return the conditions as given, None where an option was left out."""
    return {name: getattr(args, name) for name in CONDITIONS}


def ambient_of(args: Namespace) -> dict[str, float]:
    """Return all conditions: as given, else of the default day."""
    return {n: DEFAULT_DAY[n] if v is None else float(v) for n, v in ambient_given(args).items()}


def ambient_assumed(args: Namespace) -> list[str]:
    """Return the names of the conditions that nobody gave."""
    return [n for n, v in ambient_given(args).items() if v is None]


def ambient_line(given: Mapping[str, Any]) -> str:
    """Return the conditions in words, and which of them nobody gave."""
    known = {n: v for n, v in given.items() if v is not None}
    left = assumed_words(given)
    return f"ambient: {day_words(known)}" + (f" (assumed: {left})" if left else "")


def parts(args: Namespace) -> None:
    """Load the files of ``--with``, whose parts can be named from then on."""
    if args.extensions:
        from scenarios.reading import load_parts

        load_parts(args.extensions)


def engine_file(args: Namespace, parts_of_it: Sequence[str] | None = None) -> Engine:
    """Return the unit of ``--engine``, else the paper's, and tell what is assumed of some parts.

    Args:
        args: the command's.
        parts_of_it: those that the command uses, as in :mod:`apu_casadi.unit.enginefile`; None is
            all of them.
    """
    from scenarios import registry

    parts(args)
    found = registry.engine_file(args.engine)
    rows = [a._asdict() for a in found.assumed_for(parts_of_it)] if args.engine else []
    tell(args, args.engine, rows)
    return found


def tell(args: Namespace, engine: str | None, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print once what an engine's file leaves to the default unit; keep it for :func:`assumed`."""
    if not rows or getattr(args, "assumed", None):
        return
    args.assumed = list(rows)
    if getattr(args, "json", False):
        return
    width = max(len(str(r["name"])) for r in rows)
    print(f"assumed, since {engine} does not give it:", file=sys.stderr)
    for r in rows:
        value = f"{r['value']:.6g}" if isinstance(r["value"], float) else r["value"]
        unit = "" if r["unit"] == "1" else f" {r['unit']}"
        print(f"  {r['name']:<{width}} {value}{unit} ({r['source']})", file=sys.stderr)


def engine(args: Namespace, parts_of_it: Sequence[str] = TABLES) -> GasGenerator:
    """Return the gas generator that a command is about: of ``--engine``, else the paper's."""
    if args.engine is not None:
        return engine_file(args, parts_of_it).unit.gas_generator
    from apu_casadi.gaspath.gasgenerator import GasGenerator

    parts(args)
    return GasGenerator()  # without what only a whole unit needs: imports take longer than a trim


def limits(args: Namespace, parts_of_it: Sequence[str] | None = LIMITED) -> Limits:
    """Return the limits of steady points: of ``--engine``, else the default ones."""
    from apu_casadi.gaspath.steady.steadypoint import Limits

    return Limits() if args.engine is None else engine_file(args, parts_of_it).limits


def unit(args: Namespace, parts_of_it: Sequence[str] | None = None) -> Apu:
    """Return the whole unit with the engine and the governor of the options, else the paper's."""
    law = {} if args.governor is None else {"governor.kind": args.governor}
    return engine_file(args, parts_of_it).unit.change(law)


def loads(args: Namespace, unit: Apu, use: str = "a steady state") -> Load | list[Load]:
    """Return the load of each generator that ``--load`` gives, W or by the keys of a scenario.

    Given more than once they are those of generators 1, 2, ..., in a list.

    Args:
        use: what takes them, for the message about one that changes in time.
    """
    from apu_casadi.core.profiles.profile import fixed
    from scenarios.reading import read_load

    parts(args)
    factor, found = getattr(args, "power_factor", 1.0), []
    machines = [g.machine for g in unit.generators]
    for x, machine in zip(args.load, (machines * len(args.load)), strict=False):
        power = isinstance(x, float)
        load = power_load(machine, x, factor) if power else read_load(x, "--load")
        found.append(fixed(load, "--load", use))
    return found[0] if len(found) == 1 else list(unit.each("--load", found))


def faults(args: Namespace, unit: Apu, use: str = "a steady state") -> list[Fault | None]:
    """Return the fault of each generator that ``--fault`` describes by the keys of a scenario.

    With ``generator`` among them it is that of one, by its number, else that of all.
    """
    from apu_casadi.core.errors import ScenarioError
    from apu_casadi.core.profiles.profile import fixed
    from scenarios.reading import number_of, read_fault

    parts(args)
    n = len(unit.machines)
    found: list[Fault | None] = [None] * n
    for table in args.fault:
        own = dict(table) if isinstance(table, dict) else table
        which = own.pop("generator", None) if isinstance(own, dict) else None
        which = None if which is None else number_of(which, "--fault.generator")
        if which not in (None, *range(1, n + 1)):
            raise ScenarioError(f"--fault: generator = {which!r}: the unit has 1 to {n}")
        fault: Fault | None = fixed(read_fault(own, "--fault"), "--fault", use)
        for k in range(n) if which is None else [which - 1]:
            if found[k] is not None:
                raise ScenarioError(f"--fault: two faults of generator {k + 1}")
            found[k] = fault
    return found


def of_each(
    parts_of_it: Sequence[Any], words: Callable[[Any], str], each: str = "each generator"
) -> str:
    """Return in words what generators have: ``each: ...`` where all have the same."""
    if all(p == parts_of_it[0] for p in parts_of_it):
        return f"{each}: {words(parts_of_it[0])}"
    own = enumerate(parts_of_it, 1)
    return "; ".join(f"generator {k}: {words(p)}" for k, p in own if p is not None)


def power_load(machine: MachineParameters, P: float, power_factor: float = 1.0) -> Load:
    """Return the load that draws P, W, from the rated voltage of a machine."""
    from apu_casadi.machine.loads.series import SeriesLoad

    V_rms, f, rated = machine.V_rated_rms, machine.f_rated, machine.P_rated
    lo, hi = (s * rated for s in LOAD_SHARE)
    usual(f"load = {P:g} W", P, lo, hi, f"a generator is rated {rated:g} W")
    return SeriesLoad.from_power(P, power_factor, V_rms=V_rms, f=f)


def usual(what: str, value: float, lo: float, hi: float, why: str) -> None:
    """Warn of a number that is possible and most often one of another unit."""
    if not lo <= value <= hi:
        words = f"{what} is outside {lo:.4g} to {hi:.4g}, {why}; is the unit of the number right?"
        warnings.warn(ApuWarning(words), stacklevel=3)


def load_words(load: Load) -> str:
    """Return a load in words."""
    from apu_casadi.unit.runrecord import load_words as words

    return words(load)


def scenario(args: Namespace, name: str) -> Scenario:
    """Return a scenario with the parts, the engine and the governor of the options."""
    from scenarios import registry

    parts(args)
    s = registry.get(name, **own(args))
    if args.extensions:
        s = s.change(extensions=(*s.extensions, *args.extensions))
    tell(args, s.engine, registry.assumed(s))
    return s


def assumed(args: Namespace) -> dict[str, Any]:
    """Return for JSON what was assumed beside the engine's file: name, value, unit, source."""
    rows = getattr(args, "assumed", None)
    return {"assumed_engine": rows} if rows else {}


def own(args: Namespace) -> dict[str, str]:
    """Return engine and governor where the options name them, for results."""
    named = {n: getattr(args, n, None) for n in ("engine", "governor")}
    return {n: v for n, v in named.items() if v is not None}


def program(args: Namespace | None = None) -> str:
    """Return name and version of the program, for results, after engine and governor if named."""
    words = [f"{n} {v}" for n, v in own(args).items()] if args is not None else []
    return "; ".join([*words, f"apu-casadi {installed()}"])


def names(text: str) -> list[str]:
    """Return the names of ``A,B``."""
    return [n.strip() for n in text.split(",") if n.strip()]


def written(paths: Iterable[object]) -> None:
    """Print the files that were made."""
    print("\nwritten:", *(f"  {path}" for path in paths), sep="\n")


def report(
    args: Namespace,
    name: str,
    made_of: Mapping[str, Any],
    text: Callable[[], str],
    figure: Callable[[str], Any] | None = None,
    data: Mapping[str, Any] | None = None,
) -> int:
    """End a command on files: keep JSON, figure and data in ``--out``, print; return 0.

    Args:
        args: of the command: ``files``, ``out``, those of ``FIGURES``, ``json``, ``quiet``.
        name: of what is kept.
        made_of: the report, ready for JSON.
        text: the same in words.
        figure: makes the figure of a note for its caption.
        data: datasets by name.
    """
    from apu_casadi.core import results
    from apu_casadi.core.cf import described
    from apu_casadi.core.files import write_text
    from scenarios import registry
    from scenarios.shell import jsontext

    whole = {**made_of, "files": args.files, **own(args), **assumed(args)}
    made: list[Any] = []
    if args.out is not None:
        folder = registry.prepare(args.out)
        for n, d in (data or {}).items():
            title = f"{n} of {', '.join(args.files)}"
            made.append(results.save(described(d, title), folder / f"{n}.nc"))
        made.append(write_text(folder / f"{name}.json", jsontext.dumps(whole) + "\n"))
        how = drawn(args)
        if how and figure is not None:
            note = f"{', '.join(args.files)}; {program(args)}."
            made += how.save(figure(note), folder / name)
    if args.json:
        jsontext.show(whole)
        return 0
    print(text())
    if made and not args.quiet:
        written(made)
    return 0


def number(text: str, option: str, item: str) -> float:
    """Return a finite number of an option's text.

    Raises:
        ParameterError: it is none; names option and item.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ParameterError(f"{option} {item!r}: {text!r} is no number")
    return value


def pairs(items: Iterable[str], option: str, form: str = "NAME=VALUE") -> Iterator[Pair]:
    """Yield name, value and text of each ``NAME=VALUE``, also of several with commas between.

    Raises:
        ParameterError: another form than ``form``, or a name given twice.
    """
    seen = set()
    for item in (part for text in items for part in text.split(",")):
        name, sep, value = (part.strip() for part in item.partition("="))
        if not (sep and name and value):
            raise ParameterError(f"{option} {item!r}: {form} is expected")
        if name in seen:
            raise ParameterError(f"{option}: {name} given twice")
        seen.add(name)
        yield Pair(name, value, item)


def numbers(items: Iterable[str], option: str) -> dict[str, float]:
    """Return the numbers of ``NAME=VALUE`` by name; errors as :func:`pairs` and :func:`number`."""
    return {p.name: number(p.value, option, p.item) for p in pairs(items, option)}


def formats(text: str) -> tuple[str, ...]:
    """Return the formats that results are asked for in, before they are computed.

    Raises:
        ParameterError: an unknown one.
    """
    from apu_casadi.core.resultformats import FORMATS

    names = tuple(dict.fromkeys(n.strip() for n in text.split(",")))
    for name in names:
        if name not in FORMATS:
            raise ParameterError(f"--format: unknown format {name!r} {nearest(name, FORMATS)}")
    return names


LOOK = """
--dpi float =160 | dots per inch of PNG; figures are 10 in wide
--style {colour,grey} =colour | of figures; grey, for print, tells curves apart by line styles
""".strip()
"""Options of every command that draws; where FILE is given, its ending tells the format."""
DRAWN = f"""
--figures NAMES ?png,svg,pdf =png | formats of the figures, one or several with commas between:
| png, svg, pdf
{LOOK}
""".strip()
FIGURES = f"{DRAWN}\n--no-figures | draw no figures"


def look(args: Namespace) -> DrawnAs:
    """Return how a figure of a given file name is to be drawn; errors as :func:`formatted`."""
    from scenarios.figures.drawnas import DrawnAs

    return DrawnAs(dpi=args.dpi, style=args.style)


def drawn(args: Namespace) -> DrawnAs | None:
    """Return how figures are to be written, None for no figures; errors as :func:`formatted`."""
    made = formatted(args)
    return None if args.no_figures else made


def formatted(args: Namespace) -> DrawnAs:
    """Return how figures are to be written, before anything is computed.

    Raises:
        ParameterError: an unknown format, or a resolution out of range.
    """
    from scenarios.figures.drawnas import DrawnAs

    formats = tuple(dict.fromkeys(names(args.figures)))
    return DrawnAs(formats, args.dpi, args.style)
