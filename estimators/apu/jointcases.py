"""Errors drawn for studies of the joint estimate, and what it mistakes for what."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.terminalsignals import GAIN_SENSORS
from estimators.apu.joint import estimate_joint
from estimators.apu.sensors import ELECTRICAL, GAS_PATH
from estimators.apu.unknowns import ETA_SIGMA, UNKNOWNS

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["JointCase", "cross_talk", "joint_case"]


@dataclass(frozen=True)
class JointCase:
    """Errors of sensors, efficiency and winding drawn for one seed.

    Args:
        gas_gains, electrical_gains: of sensors; ``PW`` is the error of the efficiency.
        delay: of the phase currents, s.
        r_s: by what share the stator's resistance is larger than the filters know it: what they
            consider of it is a share of what they know.
    """

    gas_gains: dict[str, float]
    electrical_gains: dict[str, float]
    delay: float = 0.0
    r_s: float = 0.0

    def unit(self, apu: Apu) -> Apu:
        """Return the unit as the filters know it, of a true one."""
        return apu.change({"machine.r_s": apu.generator.machine.r_s / (1 + self.r_s)})

    def errors(self) -> dict[str, Any]:
        """Return what :func:`~estimators.apu.joint.estimate_joint` takes of it."""
        named = ("gas_gains", "electrical_gains", "delay")
        return {n: getattr(self, n) for n in named}


def joint_case(seed: int, *, electrical: bool = True, machines: int = 1) -> JointCase:
    """Draw the gain errors of a seed from the sensor sets, and what else is considered.

    With more than one of ``machines`` that differ, their names have endings, ``v_a_2``.
    """
    rng = np.random.default_rng([seed, 0])
    gas = GAS_PATH.draw_gains(rng, GAS_PATH.uncertain)
    gas["PW"] = ETA_SIGMA * float(rng.standard_normal())
    gains = ELECTRICAL.draw_gains(rng, GAIN_SENSORS)
    if machines > 1:
        more = [gains, *(ELECTRICAL.draw_gains(rng, GAIN_SENSORS) for _ in range(1, machines))]
        gains = {f"{n}_{k}": v for k, own in enumerate(more, 1) for n, v in own.items()}
    rest = [UNKNOWNS[n].sigma * float(rng.standard_normal()) for n in ("delay_i", "machine.r_s")]
    return JointCase(gas, gains if electrical else {}, *rest)


def cross_talk(
    ds: xr.Dataset, seeds: Sequence[int], *, fault: float = 10.0, gas_fault: float = 6.0
) -> dict[str, Any]:
    """How much of a short circuit is taken for a gas-path fault, and the other way round.

    Args:
        ds: a joint run with a gas-path fault and, later, a short circuit.
        seeds: of gain errors and noise.
        fault, gas_fault: instants of the two, s.

    Returns:
        By estimator (``coupled``; ``healthy machine``: no short circuit in the electrical filter;
        ``no power``): mean and RMS over the seeds of the change of each factor from 1 s before the
        short circuit to 3 s after it, and alarms within the 3 s; the same of h over the gas-path
        fault; RMSE of the factors, and RMS of error over claimed sigma, at the end of each phase.
    """
    variants: dict[str, dict[str, Any]] = {
        "coupled": {},
        "healthy machine": {"ttsc": False},
        "no power": {"power": False},
    }
    out: dict[str, Any] = {"seeds": len(seeds)}
    for name, options in variants.items():
        change, h_change, error, z, alarms, h_alarms = [], [], [], [], 0, 0
        for seed in seeds:
            case = joint_case(seed)
            e = estimate_joint(
                ds,
                seed,
                gas_gains=case.gas_gains,
                electrical_gains=case.electrical_gains,
                **options,
            )
            t = e["time"].values
            k0, k1 = (int(np.searchsorted(t, v - 1e-9)) for v in (fault, fault + 3.0))
            k = np.array([int(np.searchsorted(t, v - 1e-9)) for v in (2.0, gas_fault, fault)])
            k = np.append(k, t.size - 1)
            factors = np.array([e[n].values for n in HEALTH])
            true = np.array([e[f"{n}_true"].values for n in HEALTH])
            change.append(factors[:, k1] - factors[:, k0])
            error.append((factors - true)[:, k])
            sigma = np.array([e[f"{n}_sigma"].values for n in HEALTH])
            z.append(((factors - true) / sigma)[:, k])
            raised = np.array(json.loads(e.attrs["alarms"]))
            alarms += int(((raised > fault) & (raised <= fault + 3)).sum())
            before = e["faulty_phase"].values[: k0 + 1]
            h_alarms += int((before > 0).any())
            g0, g1 = (int(np.searchsorted(t, v - 1e-9)) for v in (gas_fault, gas_fault + 1.0))
            h = np.array([e[f"h_{p}"].values for p in PHASES])
            h_change.append(np.abs(h[:, g0 : g1 + 1] - h[:, [g0]]).max())
        c, E = np.array(change), np.array(error)
        out[name] = {
            "change_mean": dict(zip(HEALTH, c.mean(0).tolist(), strict=True)),
            "change_rms": dict(zip(HEALTH, np.sqrt((c**2).mean(0)).tolist(), strict=True)),
            "health_alarms_after_short_circuit": alarms,
            "short_circuits_reported_before": h_alarms,
            "h_change_at_gas_fault": float(np.max(h_change)),
            "rmse_at_ends": np.sqrt((E**2).mean(0)).tolist(),
            "z_rms_at_ends": np.sqrt((np.array(z) ** 2).mean(0)).tolist(),
        }
    return out
