"""What the results of the estimation studies show: claims with numbers, text, figures.

Each study has a module of its name: its claims, its section of the page, its figures.  Everything
there is made from the kept numbers alone, seeds included, so that a page can be written again
without running anything.  A part that has not been run is left out, and said to be missing.
"""

from __future__ import annotations

from scenarios.estimation.reports import (
    correctness,
    detection,
    electrical,
    fitting,
    gaspath,
    isolation,
    joint,
    shaft_power,
    speed,
)
from scenarios.estimation.reports.claims import JOINT, Claim, Pictures, Report

__all__ = ["JOINT", "REPORTS", "Claim", "Pictures", "Report"]

REPORTS: dict[str, Report] = {
    "correctness": correctness.REPORT,
    "electrical": electrical.REPORT,
    "detection": detection.REPORT,
    "gaspath": gaspath.REPORT,
    "shaft-power": shaft_power.REPORT,
    "isolation": isolation.REPORT,
    "fitting": fitting.REPORT,
    "joint": joint.REPORT,
    "speed": speed.REPORT,
}
"""How each study is shown, by its name."""
