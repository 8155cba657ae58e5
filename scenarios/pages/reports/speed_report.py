"""What the timings show: a step of the electrical filters, and the whole joint estimation."""

from __future__ import annotations

from scenarios.pages.reports.claims import Claim, Report, no_figures
from scenarios.pages.reports.words import table
from scenarios.studies.catalogue import Results

__all__ = ["REPORT"]


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
    out = []
    if "steps" in r:
        c = r["steps"]
        name, row = next(iter(c["rows"].items()))
        peer = c.get("filterpy_ukf_us")
        for kind in ("ekf", "ukf"):
            v, goal = row[f"{kind}_us"], c["goal_us"][kind]
            beside = "" if kind == "ekf" or not peer else (
                f"filterpy's UKF {peer:.0f} us, {peer / v:.0f} times"
            )  # fmt: skip
            out.append(Claim(8, f"step of the electrical {kind.upper()}, {name}",
                             f"<= {goal:g} us", f"{v:.1f} us", beside, "fastest of 7", v <= goal,
                             "on a slower or a busy processor"))  # fmt: skip
    if "joint" in r:
        c = r["joint"]
        out.append(Claim(8, f"joint estimation of {c['simulated']:g} s on one core", "<= 5 s",
                         f"{c['seconds']:.1f} s", "noise and measuring included", "fastest of 3",
                         c["seconds"] <= 5, "see the section"))  # fmt: skip
    return out


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
    if "steps" not in r:
        return []
    c = r["steps"]
    out = [table(
        ["electrical filter", "EKF step, us", "UKF step, us"],
        [[n, f"{x['ekf_us']:.2f}", f"{x['ukf_us']:.2f}"] for n, x in c["rows"].items()],
    )]  # fmt: skip
    if "machine" in c:
        m = c["machine"]
        out.append(
            f"{m['processor']}, {m['cores']} cores, {m['system']}; other load before the timing: "
            f"{m['load_before']:g}."
        )
    if c.get("filterpy_ukf_us"):
        out.append(f"filterpy's UKF on the same model (our functions in generated C behind its "
                   f"interface): {c['filterpy_ukf_us']:.0f} us a step.")  # fmt: skip
    return out


REPORT = Report(
    "One step of prediction and update of the electrical filter in generated C, a hundred "
    "steps to a call; and the whole joint estimation, noise and measuring included, after "
    "compilation.",
    claims, section, no_figures,
)  # fmt: skip
