"""Score predictions about a data set: detection, latency, classes, severities, coverage.

PREDICTIONS is a CSV file with one row a run: run and class, and what else was predicted of score,
alarm_time, phase, generator, h, f_eta_c, ..., h_sigma, ...  Missing and doubled runs are refused.

  apu score predictions.csv --dataset results/dataset --split test
"""

from __future__ import annotations

import argparse
from typing import Any

from scenarios.shell import jsontext

NAME = "score"
HELP = "score predictions about a data set"
OPTIONS = """
predictions PREDICTIONS                      | CSV, one row a run
--dataset DIR =results/dataset               | the data set (default %(default)s)
--split {all,train,validation,test,range} =test | what is printed (default %(default)s)
--json                                       | print all splits as JSON
"""


def run(args: argparse.Namespace) -> int:
    """Read, score, print; return 0."""
    from apu_casadi.core.errors import DataError
    from scenarios.datasets.scoring import read_labels, read_predictions, score

    labels = read_labels(args.dataset)
    found = score(read_predictions(args.predictions, labels), labels)
    if args.json:
        jsontext.show(found)
        return 0
    if args.split not in found:
        raise DataError(f"{args.dataset} has no unit in split {args.split!r}: --split all")
    print(*words(found[args.split], args.split), sep="\n")
    return 0


def words(s: dict[str, Any], split: str) -> list[str]:
    """Return a split's scores as lines of text."""
    lines = [f"split {split}: {s['runs']} runs"]
    lines.append(f"accuracy {_percent(s['accuracy'])}, Cohen's kappa {_number(s['kappa'])}")
    lines.append(
        f"detected {_percent(s['detected'])} of the faulty, false alarms in "
        f"{_percent(s['false_alarms'])} of the healthy"
    )
    if at := s.get("detected_at_false_alarms"):
        lines.append(
            f"at {_percent(at['false_alarms'])} false alarms {_percent(at['detected'])} detected"
        )
    if late := s.get("latency"):
        lines.append(
            f"alarm after {_number(late['median'])} s (median), {_number(late['p90'])} s (90 %), "
            f"in {_percent(late['found'])}; before the onset in {_percent(late['early'])}"
        )
    lines += [
        f"{n} right in {_percent(s[f'{n}_right'])}"
        for n in ("phase", "generator")
        if f"{n}_right" in s
    ]
    lines += ["", f"{'class':<10}  runs  detected  called right"]
    lines += [
        f"{c:<10}  {v['runs']:>4}  {_percent(v['detected']):>8}  {_percent(v['right']):>12}"
        for c, v in s["by_class"].items()
    ]
    for n, v in s["severities"].items():
        cover = v.get("coverage_95")
        band = "" if cover is None else f", in the 95 % band {_percent(cover)}"
        lines.append(f"{n}: RMSE {_number(v.get('rmse'))} over {v['runs']} runs{band}")
    return lines


def _percent(x: float | None) -> str:
    return "-" if x is None else f"{100 * x:.1f} %"


def _number(x: float | None) -> str:
    return "-" if x is None else f"{x:.3g}"
