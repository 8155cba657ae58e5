"""Draw the compressor and the turbine map with operating lines and surge line.

With --trajectory, the file that ``apu run`` wrote, a run is drawn on both.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from scenarios.commands import given

NAME = "maps"
HELP = "draw the component maps with operating lines and a run"
OPTIONS = f"""
--trajectory FILE.nc    | a run, as 'apu run' writes it, on the maps of its own unit
{given.UNIT}
--out DIR =results/maps | folder (default %(default)s)
--no-lines              | draw no operating lines
{given.DRAWN}
"""


def run(args: argparse.Namespace) -> int:
    """Draw both maps and print the paths."""
    from apu_casadi.core import results
    from apu_casadi.core.errors import DataError
    from scenarios import registry
    from scenarios.figures.mapplots import default_lines, plot_compressor_map, plot_turbine_map
    from scenarios.figures.runwords import scenario_of
    from scenarios.shell import progress

    ds = None if args.trajectory is None else results.load(args.trajectory)
    how = given.formatted(args)
    folder = registry.prepare(args.out)
    progress.tell("drawing both maps")
    if ds is not None and args.engine is None:
        args.engine = scenario_of(ds).get("engine")  # a run is drawn on the maps of its own unit
    gg = given.engine(args, given.LIMITED)
    note = f"Unit {Path(args.engine).stem}." if args.engine else ""
    lines = {} if args.no_lines else default_lines(gg)
    for name, draw in (("compressor_map", plot_compressor_map), ("turbine_map", plot_turbine_map)):
        try:
            figure = draw(gg, lines=lines, trajectory=ds, note=note)
        except DataError as e:
            said = str(e)
            if str(args.trajectory) not in said:
                said = f"{args.trajectory}: {said}"
            raise DataError(said) from None
        print(*how.save(figure, folder / name), sep="\n")
    return 0
