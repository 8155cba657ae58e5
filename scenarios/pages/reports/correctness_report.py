"""What the study of correctness shows: linear models, where every estimator is exact."""

from __future__ import annotations

from scenarios.pages.reports.claims import Claim, Report, no_figures
from scenarios.pages.reports.words import seeds_of, table
from scenarios.studies.catalogue import Results
from scenarios.studies.correctness import GOAL as EXACT

__all__ = ["REPORT"]


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
    if "linear" not in r:
        return []
    c = r["linear"]
    ours = [x for x in c["rows"] if "filterpy" not in x["name"]]
    peers = [x for x in c["rows"] if "filterpy" in x["name"]]
    out = []
    for what, rows in (
        ("EKF, iterated EKF, UKF, moving horizon and smoother against Kalman filter and batch "
         "least squares", ours),
        ("EKF and UKF against filterpy's", peers),
    ):  # fmt: skip
        if rows:
            worst = max(x["largest"] for x in rows)
            out.append(Claim(1, what, f"<= {EXACT:.0e}", f"{worst:.0e}", "largest difference",
                             seeds_of(c["seeds"]), worst <= EXACT))  # fmt: skip
    return out


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
    if "linear" not in r:
        return []
    rows = [[x["name"], str(x["seeds"]), f"{x['largest']:.1e}"] for x in r["linear"]["rows"]]
    return [
        "Largest difference of any mean or covariance over 1 + its size:",
        table(["compared", "systems", "largest difference"], rows),
        "The tests say more: `tests/test_ekf.py`, `test_ukf.py`, `test_mhe.py`, "
        "`test_smoother.py`, `test_filterpy_adapter.py` compare predictions, likelihoods and "
        "innovations as well, with silent sensors, irregular instants, singular priors and "
        "considered states.",
    ]


REPORT = Report(
    "On linear models everything is exact. Random stable systems of three states with noise "
    "that output and transition share, irregular instants and 30 % of the samples missing go "
    "through every estimator, and through a Kalman filter and a least-squares problem of all "
    "states and noises that are written out beside them.",
    claims, section, no_figures,
)  # fmt: skip
