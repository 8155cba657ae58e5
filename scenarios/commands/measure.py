"""Measure a run: write what sensors with noise and gain errors would have recorded.

RUN is a netCDF file of apu run.  The recording goes to --out, .csv, .parquet or .nc: the gas path
every 20 ms, and, where the run has waveforms, the generators at their step, as two files.  A file
of sensors changes noise (1 sigma), gain error and rate by name:

    [T5]
    noise = 0.004
    rate = 10

    apu run joint --out results/joint
    apu measure results/joint/joint.nc --seed 3 --out test.csv
    apu estimate data test_gaspath.csv test_electrical.csv
"""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import ParameterError
from scenarios.commands import given
from scenarios.shell import jsontext

if TYPE_CHECKING:
    from apu_casadi.unit.apu import Apu

NAME = "measure"
HELP = "write a recording: what sensors would have read of a run"
OPTIONS = f"""
run_file RUN                 | the run, .nc
--out FILE                   | of the recording, .csv, .parquet or .nc (required)
--sensors FILE               | noise, gain and rate of sensors (TOML); default: apu estimate sensors
--seed int N =1              | of gain errors and noise (default 1)
--gains =on                  | draw a gain error for each sensor (default)
--only {{gaspath,electrical}} | one of the two
{given.UNIT}
--json                       | print JSON
"""


def run(args: argparse.Namespace) -> int:
    """Read, measure, write; return 0."""
    from apu_casadi.core import results
    from apu_casadi.core.errors import DataError
    from estimators.apu.measuring import measure_run, read_sensors, write_recording

    if args.out is None:
        raise ParameterError("--out FILE is needed: .csv, .parquet or .nc")
    if args.seed < 0:
        raise ParameterError(f"--seed must be >= 0, got {args.seed}")
    given.parts(args)
    sensors = read_sensors(args.sensors)
    ds = results.load(args.run_file)
    readings = measure_run(ds, _unit(args, ds), args.seed, sensors, gains=args.gains)
    if args.only is not None:
        if args.only not in readings:
            raise DataError(
                f"{args.run_file} has no waveforms: apu run writes them unless --no-waveforms"
            )
        readings = {args.only: readings[args.only]}
    made = write_recording(readings, args.out)
    what = {
        str(p): [str(n) for n in r.data_vars] for p, r in zip(made, readings.values(), strict=True)
    }
    remarks = _remarks(ds) if "electrical" in readings else []
    if args.json:
        told = {"seed": args.seed, "gains": args.gains, "written": what, "remarks": remarks}
        jsontext.show(told)
        return 0
    for path, names in what.items():
        print(f"written: {path}: {', '.join(names)}")
    print(*(f"note: {r}" for r in remarks), sep="\n", end="\n" * bool(remarks))
    return 0


def _remarks(ds: Any) -> list[str]:
    """Say where the run's exchange is coarser than what electrical filters resolve."""
    by = json.loads(ds.attrs.get("solver", "{}"))
    if by.get("exchange") == "corrected" and by.get("dt", 0.0) <= 0.005 + 1e-9:
        return []
    ms = 1e3 * by.get("dt", 0.0)
    return [
        f"with exchange {by.get('exchange')!r} every {ms:g} ms speed and voltage have kinks, "
        "which an electrical filter may take for changes of the machine; none were seen with "
        "exchange = 'corrected' and dt = 0.005 in the scenario"
    ]


def _unit(args: argparse.Namespace, ds: Any) -> Apu:
    """Return the unit of ``--engine``, else of the run's own scenario."""
    if args.engine is None and "scenario" in ds.attrs:
        from scenarios import registry
        from scenarios.schema import Scenario

        return registry.unit_for(Scenario.from_dict(json.loads(ds.attrs["scenario"])))
    return given.engine_file(args).unit
