"""How recordings are read: the options of all commands that read some."""

from __future__ import annotations

import argparse
import dataclasses
import math
from typing import TYPE_CHECKING, Any

from scenarios.commands import given

if TYPE_CHECKING:
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.recordings.layout import Reading
    from estimators.apu.recordings.measured import Measurements

OPTIONS = """
--column NAME=COLUMN[:UNIT] ... | column of another name, or its unit
--columns FILE         | how the files are laid out (TOML): columns, names, units, rate, ...
--names A,B            | names of the columns in order, where the file has none; an empty one
                       | leaves a column out
--units A,B            | their units, an empty one for SI
--time COLUMN[:UNIT]   | time column (default: time, t, Timestamp and the like)
--rate float HZ        | of the rows, where no column is the time
--sort                 | put the rows in the order of time, and join those of one stamp
--barometer PRESSURE   | of the air around, for gauge pressures: 101.3kPa
--encoding NAME        | of text files, such as utf-16
--decimal {point,comma} | decimal point or comma
--missing A,B =        | numbers and words that stand for a gap: --missing=-999,off
--exclude-implausible  | leave out readings that cannot be, instead of refusing the file
--range NAME=LOW:HIGH ... | another plausible range, in SI: T5=250:1300
--time-format FORMAT   | of dates, such as %%d.%%m.%%Y %%H:%%M:%%S
--time-zone ZONE       | of dates without one: UTC, Europe/Berlin
"""


def reading(
    args: argparse.Namespace, gg: GasGenerator
) -> tuple[Reading, dict[str, tuple[str, str | None]]]:
    """Return how files are read that leave a question, and the columns that the options name."""
    from estimators.apu.recordings.layout import (
        Reading,
        merged,
        parse_mapping,
        pressure,
        read_layout,
    )
    from estimators.apu.recordings.plausible import parse_limits

    base, mapping = read_layout(args.columns) if args.columns else (Reading(), {})
    own: dict[str, Any] = {n: tuple(_blanks(getattr(args, n))) for n in ("names", "units")}
    own |= {"encoding": args.encoding, "decimal": args.decimal, "time": args.time}
    own |= {"time_format": args.time_format, "time_zone": args.time_zone, "rate": args.rate}
    own |= {"sort": args.sort, "exclude": args.exclude_implausible}
    own |= {"missing": tuple(map(_number_or_word, given.names(args.missing)))}
    own |= {"barometer": pressure(args.barometer) if args.barometer else None}
    limits = {**base.ranges, **parse_limits(args.range)}
    how = merged(base, Reading(**own))
    mapping |= parse_mapping(args.column)
    return dataclasses.replace(how, ranges=limits, engine=gg), mapping


def recording(args: argparse.Namespace, gg: GasGenerator) -> Measurements:
    """Read the files of a command as its options say; errors as of the reader."""
    from estimators.apu.recordings.measured import read_recording

    how, mapping = reading(args, gg)
    columns = {n: c if u is None else f"{c}:{u}" for n, (c, u) in mapping.items()}
    return read_recording(*args.files, columns=columns, reading=how)


def day(args: argparse.Namespace, m: Measurements) -> dict[str, float]:
    """Return ambient conditions of the options, and of run files where no column has them."""
    from estimators.apu.recordings.runfiles import recorded_ambient

    said = {n: v for f in args.files for n, v in recorded_ambient(f).items() if n not in m}
    return said | {n: v for n, v in given.ambient_given(args).items() if v is not None}


def _blanks(text: str | None) -> list[str]:
    """Return the names of ``A,,B``, empty ones among them."""
    return [n.strip() for n in text.split(",")] if text else []


def _number_or_word(text: str) -> float | str:
    try:
        number = float(text)
    except ValueError:
        return text
    return number if math.isfinite(number) else text
