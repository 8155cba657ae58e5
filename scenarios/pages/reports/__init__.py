"""What the results of the estimation studies show: claims with numbers, text, figures.

Each study has a module of its name: its claims, its section of the page, its figures.  Everything
there is made from the kept numbers alone, seeds included, so that a page can be written again
without running anything.  A part that has not been run is left out, and said to be missing.
"""

from __future__ import annotations

from scenarios.pages.reports import (
    correctness_report,
    detection_report,
    electrical_report,
    fitting_report,
    gaspath_report,
    isolation_report,
    joint_report,
    shaft_power_report,
    speed_report,
)
from scenarios.pages.reports.claims import JOINT, Claim, Pictures, Report

__all__ = ["JOINT", "REPORTS", "Claim", "Pictures", "Report"]

REPORTS: dict[str, Report] = {
    "correctness": correctness_report.REPORT,
    "electrical": electrical_report.REPORT,
    "detection": detection_report.REPORT,
    "gaspath": gaspath_report.REPORT,
    "shaft-power": shaft_power_report.REPORT,
    "isolation": isolation_report.REPORT,
    "fitting": fitting_report.REPORT,
    "joint": joint_report.REPORT,
    "speed": speed_report.REPORT,
}
"""How each study is shown, by its name."""
