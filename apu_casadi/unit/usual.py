"""What a unit's numbers usually are: the ranges that the model was built for and tried in.

A number beyond them is possible, and most often a slip of the unit: r/min for rad/s, mH for H,
kg/h for kg/s.  It is taken, with a warning.  Beyond the range of its parameter set it is refused.

The ranges are *assumed*: about small gas turbines of 30 kW to 3 MW and synchronous machines of 5 kW
to 2 MW on aircraft supplies.  What has no row has a narrow range of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apu_casadi.gaspath.steady.steadypoint import Limits
    from apu_casadi.unit.apu import Apu

_TABLE = """
gas_generator.N          300    20000   | gas_generator.W2        0.1    50
gas_generator.PR_c       2      30      | gas_generator.eta_c     0.6    0.95
gas_generator.T4         900    2000    | gas_generator.eta_t     0.6    0.95
gas_generator.LHV        3e7    1.3e8   | gas_generator.P_acc     0      5e5
gas_generator.J          1e-3   20      | machine.r_s             1e-4   1
machine.L_ls             1e-6   1e-2    | machine.L_md            1e-5   0.1
machine.L_mq             1e-5   0.1     | machine.r_fd            1e-3   100
machine.L_lfd            1e-6   0.1     | machine.r_kd            1e-4   10
machine.L_lkd            1e-6   1e-2    | machine.r_kq            1e-4   10
machine.L_lkq            1e-6   1e-2    | machine.n_pp            1      12
machine.V_rated_rms      50     700     | machine.P_rated         5e3    2e6
machine.f_rated          50     2000    | machine.eta_sg          0.6    1
exciter.T_R              1e-4   0.1     | exciter.T_A             1e-4   1
exciter.K_A              5      2000    | exciter.K_E             0      2
exciter.T_E              1e-3   10      | exciter.K_F             0      1
exciter.T_F1             1e-3   10      | exciter.T_F2            0      10
exciter.T_F3             0      10      | exciter.V_R_max         1      100
exciter.V_R_min          -100   0       | exciter.E_1             0      100
exciter.S_E1             0      10      | exciter.E_2             0      100
exciter.S_E2             0      10      | exciter.T_lim           1e-5   0.1
governor.Kp              1e-3   10      | governor.Ki             0      100
governor.Wf_min          1e-5   0.5     | governor.Wf_max         1e-3   2
governor.T_aw            1e-3   10      | coupling.gear           0.1    30
coupling.eta_gtSg        0.8    1       | compressor_map.a_W      -2     2
compressor_map.c_PR      0      20      | compressor_map.c_N      0      100
compressor_map.k_SM      0.5    2       | turbine_map.a_W         -2     2
turbine_map.c_PR         0      20      | turbine_map.c_N         0      100
turbine_map.k_SM         0.5    2      | limits.off_map          0      2
limits.SM_min            0      0.5    | limits.T4_max           900    2300
limits.T5_max            500    1800   | limits.Mach8_max        0.3    1
limits.Wf_min            1e-5   0.5    | limits.eta_max          0.8    1
"""
USUAL: Mapping[str, tuple[float, float]] = {
    name: (float(lo), float(hi))
    for name, lo, hi in (part.split() for part in _TABLE.replace("|", "\n").strip().splitlines())
}
"""Lowest and highest usual value of a unit's parameters by dotted name, SI."""
LOAD_SHARE = (0.002, 1.6)
"""Lowest and highest usual load of a generator, over its rated power."""
_OFF = 0.3  # of the rated frequency, by which that at governed speed may differ


def beyond(name: str, value: Any, lo: float, hi: float, unit: str, what: str = "") -> str | None:
    """Return the words for a number outside its usual range; None inside.

    Args:
        what: why it is the usual one.
    """
    if lo <= value <= hi:
        return None
    u = f" {unit}" if unit not in ("", "1") else ""
    return f"{name} = {value:g}{u} is outside {lo:g} to {hi:g}{u}{what or _BUILT}"


_BUILT = ", for which the model was built; is the unit of the number right?"


def unusual(
    unit: Apu, names: Iterable[str], limits: Limits | None = None
) -> Iterator[tuple[str, str]]:
    """Yield name and words of those parameters that are beyond their usual ranges.

    And of what does not go together: speed, gear and pole pairs give the frequency.

    Args:
        unit: that has them.
        names: dotted ones, of what somebody has given.
        limits: of steady points, which may be among them.
    """
    names = [*names]
    if limits is not None:  # else what lists scenarios would wait for the trim's imports
        from apu_casadi.gaspath.steady.steadypoint import LIMIT_UNITS
    units = {f"{s}.{n}": u for s, p in unit.parameter_sets().items() for n, _, u, *_ in p.table()}
    values = unit.parameters()
    for n, unit_of_it in LIMIT_UNITS.items() if limits is not None else ():
        values[f"limits.{n}"], units[f"limits.{n}"] = getattr(limits, n), unit_of_it
    for name in names:
        own = name.partition(".")[2] if name.startswith("generator") and name[9] != "." else name
        value = values.get(name)
        if own in USUAL and isinstance(value, int | float) and math.isfinite(value):
            words = beyond(own.rpartition(".")[2], value, *USUAL[own], units[own])
            if words is not None:
                yield name, words
            if own == "machine.n_pp" and value % 1:
                yield name, f"n_pp = {value:g}: pole pairs are a whole number"
    for k, (gen, gear) in enumerate(unit.machines, 1):
        m, of = gen.machine, "" if unit.alike else f" of generator {k}"
        whole = ("gas_generator.N", "coupling.gear", "machine.n_pp", "machine.f_rated")
        given = next((n for n in names if n.endswith(whole)), None)
        f = unit.link_of((k,)).w_r(unit.N_ref) / (2 * math.pi)
        if given and abs(f - m.f_rated) > _OFF * m.f_rated:
            yield (
                given,
                f"the governed speed of {unit.N_ref:g} rad/s, gear {gear.gear:g} and {m.n_pp:g} "
                f"pole pairs give {f:.4g} Hz, the rated frequency{of} is {m.f_rated:g} Hz",
            )
            return
