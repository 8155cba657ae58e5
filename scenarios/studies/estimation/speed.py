"""Speed: a step of the electrical filters, and the whole joint estimation."""

from __future__ import annotations

from typing import Any

import casadi as ca

from scenarios.shell.computer import machine
from scenarios.studies.electrical import protocol as electrical
from scenarios.studies.electrical.steptime import filterpy_step_us, speed
from scenarios.studies.gaspath import course as gaspath
from scenarios.studies.jointrun import joint_seconds
from scenarios.studies.registration import Claim, Results, Study, Tell

__all__ = ["STUDY", "both"]


def both() -> list[ca.Function]:
    """Return the functions of the electrical and of the gas-path filter."""
    return [*electrical.filters(), *gaspath.filters()]


STUDY = Study(
    "speed",
    order=90,
    title="Speed",
    goal="A step of the electrical UKF takes at most 20 us and of the EKF at most 5 us, generated "
    "to C; the joint estimation of 14 s at most 5 s on one core.",
    filters=both,
    text="""
@intro
One step of prediction and update of the electrical filter in generated C, a hundred steps to a
call; and the whole joint estimation, noise and measuring included, after compilation.

@step
8 | step of the electrical {kind}, {name} | <= {goal:g} us | {us:.1f} us | {beside} | fastest of 7
| on a slower or a busy processor

@beside
filterpy's UKF {peer:.0f} us, {ratio:.0f} times

@joint
8 | joint estimation of {simulated:g} s on one core | <= 5 s | {seconds:.1f} s
| noise and measuring included | fastest of 3 | see the section

@table
electrical filter | EKF step, us | UKF step, us
---
{name} | {ekf_us:.2f} | {ukf_us:.2f}

@machine
{processor}, {cores} cores, {system}; other load before the timing: {load_before:g}.

@filterpy
filterpy's UKF on the same model (our functions in generated C behind its interface):
{filterpy_ukf_us:.0f} us a step.
""",
)


@STUDY.part("steps", start=60, share=None)
def steps(n: int, seed0: int, tell: Tell) -> Any:
    """Time a step of each electrical filter, and of filterpy's."""
    where = machine()
    out = speed()
    out["filterpy_ukf_us"] = filterpy_step_us()
    out["machine"] = {k: where[k] for k in ("processor", "cores", "system", "load_before")}
    return out


@STUDY.part("joint", start=60, share=None)
def joint(n: int, seed0: int, tell: Tell) -> Any:
    """Time the joint estimation."""
    return joint_seconds()


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim the times."""
    out = []
    if "steps" in r:
        c = r["steps"]
        name, row = next(iter(c["rows"].items()))
        peer = c.get("filterpy_ukf_us")
        for kind in ("ekf", "ukf"):
            us, goal, beside = row[f"{kind}_us"], c["goal_us"][kind], ""
            if kind == "ukf" and peer:
                beside = STUDY.template.text("beside", peer=peer, ratio=peer / us)
            values = {"kind": kind.upper(), "name": name, "goal": goal, "us": us}
            out.append(STUDY.claim("step", us <= goal, beside=beside, **values))
    if "joint" in r:
        out.append(STUDY.claim("joint", r["joint"]["seconds"] <= 5, **r["joint"]))
    return out


@STUDY.section
def section(r: Results) -> list[str]:
    """Show the steps of all filters, and the machine."""
    if "steps" not in r:
        return []
    c, t = r["steps"], STUDY.template
    out = [t.table("table", [{"name": n, **x} for n, x in c["rows"].items()])]
    if "machine" in c:
        out.append(t.text("machine", **c["machine"]))
    if c.get("filterpy_ukf_us"):
        out.append(t.text("filterpy", **c))
    return out
