"""Whether the phases of a recording stand as the model takes them: order, signs, what was measured.

The model's generator turns a, b, c, its currents leave the machine, its voltages are those of the
phases.  A filter that is given anything else is lost and names a cause that is none; the phasors of
the first periods tell it before, and which column is to be changed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from apu_casadi.core.means import fortescue
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.machine.park import PHASES
from estimators.apu.electrical.sequences import fitted
from estimators.apu.electrical.terminalsignals import PHASES_I, PHASES_V

__all__ = ["miswired"]

PERIODS = 10  # of which the phasors are
CLEARLY = 0.3  # of apparent power, that flows into the machine; a passive load has none
BACKWARD = 4.0  # negative over positive sequence; one inverted phase makes it 2
SMALL = 0.2  # of the largest phasor of a kind, below which one tells nothing
LINE = 0.04  # relative deviation of a voltage between lines from sqrt(3) times the rated one


def miswired(a: Mapping[str, np.ndarray], machine: MachineParameters) -> str | None:
    """Say what is wrong with the phases, and the remedy; None if nothing is seen.

    Args:
        a: ``t``, speed ``w_r``, voltages and currents, NaN where there is no sample, (K,).
        machine: of which the rated voltage is.
    """
    w = float(np.nanmedian(a["w_r"]))
    t = a["t"] - a["t"][0]
    part = slice(0, max(int(np.searchsorted(t, PERIODS * 2 * math.pi / max(abs(w), 1e-9))), 16))
    x = np.array([a[n][part] for n in (*PHASES_V, *PHASES_I)])
    if np.isfinite(x).sum(axis=1).min() < 8:
        return None
    basis = np.column_stack([f(w * t[part]) for f in (np.cos, np.sin)] + [np.ones(x.shape[1])])
    c = fitted(basis, x.T)
    v, i = np.split(c[0] - 1j * c[1], 2)
    back = [abs(s[1]) > BACKWARD * abs(s[0]) for s in (fortescue(v), fortescue(i))]
    if all(back):
        return (
            "voltages and currents follow one another as a, c, b: two phases have each other's "
            "names; exchange those of b and c in both"
        )
    if any(back):
        kind = "currents" if back[1] else "voltages"
        return f"the {kind} alone follow one another as a, c, b: two of them are exchanged"
    there = (np.abs(v) > SMALL * np.abs(v).max()) & (np.abs(i) > SMALL * np.abs(i).max())
    against = there & ((v * i.conj()).real < -CLEARLY * np.abs(v) * np.abs(i))
    if against.any():
        names = (
            "all currents"
            if against.all()
            else ", ".join(f"i_{PHASES[k]}" for k in np.flatnonzero(against))
        )
        return (
            f"{names}: power flows into the machine; a current counts as it leaves it: change its "
            "sign"
        )
    ratio = abs(fortescue(v)[0]) / (math.sqrt(2) * machine.V_rated_rms * math.sqrt(3))
    if abs(ratio - 1) < LINE:
        return (
            "the voltages are sqrt(3) times the rated: those between lines? the phases' are taken"
        )
    return None
