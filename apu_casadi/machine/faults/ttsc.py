"""Turn-to-turn short circuit of a stator phase: (4), (7), (9).

A fraction mu of phase k's turns is bridged by r_fault = k_rf mu r_s (4), which carries i_fault.
With the effective current ibar = i - T(:,k) mu i_fault the machine stays as it was, (7); what is
new is one scalar loop.

The paper leaves lambda_sa-f in (9) undefined.  Every partition of the phase leakage that leaves
the healthy machine unchanged and agrees with (7) is

    lambda_sa-f = mu lambda_k + mu (kappa - mu) L_ls i_fault,      mu <= kappa <= 1,

and then (5) and (9) give

    (kappa - mu) L_ls d(i_fault)/dt = -(v_k - w1_k) - (1 - mu + k_rf) r_s i_fault,

with v_k the winding voltage (terminal to machine neutral) and w1_k the noise of (5) in phase k.

* kappa = mu (default, the paper's own model): full coupling; i_fault is algebraic and only
  h = mu / (k_rf + 1 - mu) enters voltages, currents and loss.
* kappa = 1: leakage in proportion to the turns; i_fault is a state.

A severity is defined only by all three numbers.  Seen from outside, the faulty machine is the
healthy one with R_shunt and L_shunt in series from terminal k to the machine neutral.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Self

from apu_casadi.core.checked import bounded, number
from apu_casadi.core.errors import ParameterError, ScenarioError
from apu_casadi.core.register import Key, read_table
from apu_casadi.core.signals import Signal
from apu_casadi.machine.faults.fault import FAULTS, AtFault, Branch, Fault, Own
from apu_casadi.machine.loads.load import Load
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.machine.park import PHASE_ANGLE, Abc, phase_selector

_I_FAULT = Signal("i_fault", "A", "current of the fault branch", nominal=1e3)
_DI_FAULT = Signal("di_fault", "A/s", "rate of i_fault", nominal=1e8)
_MU = Signal("mu", "1", "fraction of the phase's turns that is shorted", nominal=0.05)
_K_RF = Signal("k_rf", "1", "fault over shorted-turn resistance (4)")
_KAPPA = Signal("kappa", "1", "leakage partition, mu <= kappa <= 1")
_PHASE = Signal("phase_angle", "rad", "axis of the faulty phase; 0 for phase a")


@FAULTS.add("ttsc")
@dataclass(frozen=True)
class Ttsc(Fault):
    """A turn-to-turn short circuit.

    Args:
        mu: fraction of the phase's turns that is shorted, 0 < mu < 1.
        k_rf: fault resistance over the resistance of the shorted turns (4), >= 0.
        kappa: leakage partition, mu <= kappa <= 1; None means mu, the paper's model.
        phase: "a" (the paper's), "b" or "c".

    Raises:
        ParameterError: a value outside its range.  A healthy machine is ``None``, not ``mu = 0``.
    """

    mu: float
    k_rf: float
    kappa: float | None = None
    phase: str = "a"

    word = "ttsc"
    keys: ClassVar[tuple[Key, ...]] = (
        Key("mu", "1", "shorted fraction of the turns of the phase", 0.0, 0.99, open_lo=True),
        Key("k_rf", "1", "fault resistance over that of the shorted turns", 0.0),
        Key("kappa", "1", "leakage partition, mu (full coupling) to 1", 0.0, 1.0, default=None),
        Key("phase", "1", "faulty phase", default="a", choices=tuple(PHASE_ANGLE)),
    )
    instead: ClassVar[Mapping[str, Key]] = MappingProxyType(
        {"k_rf": Key("h", "1", "mu/(k_rf + 1 - mu), in place of k_rf", 0.0, 99.0, open_lo=True)}
    )
    reversing: ClassVar[tuple[str, ...]] = ("i_fault",)
    severities: ClassVar[tuple[Signal, ...]] = (
        Signal("mu", "1", "shorted fraction of the turns of a phase (0: healthy)", default=0.0),
        Signal(
            "k_rf",
            "1",
            "fault resistance over that of the shorted turns (nan: healthy)",
            default=math.nan,
        ),
        Signal(
            "kappa",
            "1",
            "leakage partition of the shorted turns (nan: healthy)",
            default=math.nan,
        ),
    )

    def __post_init__(self) -> None:
        """Check the ranges; put mu for an absent kappa."""
        if self.kappa is None:
            object.__setattr__(self, "kappa", self.mu)
        for name in ("mu", "k_rf", "kappa"):
            value = number(f"Ttsc.{name}", getattr(self, name), error=ParameterError)
            object.__setattr__(self, name, value)
            if not math.isfinite(value):
                raise ParameterError(f"Ttsc.{name} must be a finite number, got {value!r}")
        if not 0 < self.mu < 1:
            raise ParameterError(
                f"Ttsc.mu = {self.mu:g} is outside (0, 1); a healthy machine has no fault (None)"
            )
        if self.k_rf < 0:
            raise ParameterError(f"Ttsc.k_rf = {self.k_rf:g} must be >= 0")
        if not self.mu <= self._kappa <= 1:
            raise ParameterError(
                f"Ttsc.kappa = {self.kappa:g} is outside [mu, 1] = [{self.mu:g}, 1]"
            )
        if self.phase not in PHASE_ANGLE:
            raise ParameterError(f"Ttsc.phase must be 'a', 'b' or 'c', got {self.phase!r}")

    @property
    def _kappa(self) -> float:
        assert self.kappa is not None
        return self.kappa

    @property
    def h(self) -> float:
        """mu / (k_rf + 1 - mu): the one severity that shows at the terminals if kappa = mu."""
        return self.mu / (self.k_rf + 1.0 - self.mu)

    @classmethod
    def of_h(cls, mu: float, h: float, kappa: float | None = None, phase: str = "a") -> Self:
        """Make the fault of a severity h = mu / (k_rf + 1 - mu) at the terminals.

        Args:
            mu, kappa, phase: as of the class.
            h: 0 < h <= mu / (1 - mu), which is a metallic short.

        Raises:
            ParameterError: a value outside its range.
        """
        mu, h = (number(f"Ttsc.{n}", v, error=ParameterError) for n, v in (("mu", mu), ("h", h)))
        if not (0 < mu < 1 and 0 < h * (1 - mu) <= mu * (1 + 1e-12)):
            most = f"{mu / (1 - mu):g}" if 0 < mu < 1 else "mu/(1 - mu)"
            raise ParameterError(
                f"Ttsc.h = {h:g} is outside (0, {most}]: with mu = {mu:g} a metallic short has "
                "mu/(1 - mu)"
            )
        return cls(mu, max(0.0, mu / h - 1.0 + mu), kappa, phase)

    @property
    def phase_angle(self) -> float:
        """Electrical angle of the faulty phase's axis, rad."""
        return PHASE_ANGLE[self.phase]

    # -- structure ------------------------------------------------------------------------------

    def kind(self, load: Load, neutral: str) -> str:
        """Return ``"coupled"`` where i_fault is algebraic, else ``"leaky"``.

        It is algebraic if kappa = mu, with a grounded neutral and no load inductance in the phase.
        """
        tied = self.kappa == self.mu and neutral == "grounded"
        return "coupled" if tied and not load.inductive(self.phase) else "leaky"

    def own(self, kind: str, neutral: str) -> Own:
        """Return mu, k_rf, (kappa,) phase_angle; i_fault is a state or an unknown."""
        if kind == "leaky":
            return Own((_MU, _K_RF, _KAPPA, _PHASE), (_I_FAULT,), (_DI_FAULT,))
        if neutral == "isolated":
            raise ParameterError(
                "with an isolated neutral i_fault is a state for every kappa: use 'leaky'"
            )
        return Own((_MU, _K_RF, _PHASE), (), (_I_FAULT,))

    @classmethod
    def examples(cls) -> dict[str, Fault]:
        """Return 5 % of the turns, with kappa = mu and kappa = 1."""
        return {"coupled": cls(0.05, 1.0), "leaky": cls(0.05, 1.0, 1.0)}

    def branch(self, at: AtFault) -> Branch:
        """Return mu i_fault in the faulty phase."""
        mu, i_fault, di_fault = at.theta["mu"], *_current(at)
        select = phase_selector(at.theta["phase_angle"])
        current, rate = (Abc(*(s * mu * i for s in select)) for i in (i_fault, di_fault))
        return Branch(current, rate, mu * i_fault / 3.0, mu * di_fault / 3.0)

    def residuals(self, at: AtFault) -> list[Any]:
        """Return that of the loop (:func:`loop_residual`)."""
        th = at.theta
        select = phase_selector(th["phase_angle"])
        v_k = sum(s * (v - w) for s, v, w in zip(select, at.v, at.w1, strict=True))
        i_fault, di_fault = _current(at)
        severity = {"mu": th["mu"], "k_rf": th["k_rf"], "kappa": th.get("kappa", th["mu"])}
        return [loop_residual(at.p, **severity, v_k=v_k, i_fault=i_fault, di_fault=di_fault)]

    def rates(self, at: AtFault) -> dict[str, Any]:
        """Return that of i_fault where it is a state."""
        return {"i_fault": at.z["di_fault"]} if at.kind == "leaky" else {}

    def loss(self, at: AtFault) -> Any:
        """Return the extra loss (:func:`fault_loss`)."""
        assert at.i is not None
        select = phase_selector(at.theta["phase_angle"])
        i_k = sum(s * i for s, i in zip(select, at.i, strict=True))
        mu, k_rf, i_fault = at.theta["mu"], at.theta["k_rf"], _current(at)[0]
        return fault_loss(at.p, mu=mu, k_rf=k_rf, i_k=i_k, i_fault=i_fault)

    def outputs(self, at: AtFault, y: dict[str, Any]) -> dict[str, Any]:
        """Return i_fault."""
        return {"i_fault": _current(at)[0]}

    # -- numbers --------------------------------------------------------------------------------

    def parameters(self, kind: str) -> dict[str, float]:
        """Return mu, k_rf and the phase's angle, and kappa where it counts."""
        values = {"mu": self.mu, "k_rf": self.k_rf, "phase_angle": self.phase_angle}
        return values if kind == "coupled" else {**values, "kappa": self._kappa}

    def start(
        self,
        before: Mapping[str, float],
        theta_before: Mapping[str, float],
        theta: Mapping[str, float],
        states: tuple[str, ...],
    ) -> dict[str, float]:
        """Return the i_fault that was there if it is in the same phase, else zero."""
        was, now = theta_before.get("phase_angle"), theta.get("phase_angle")
        moved = was is not None and now is not None and was != now
        return {n: 0.0 if moved else before.get(n, 0.0) for n in states}

    @classmethod
    def absent(cls, values: Mapping[str, Any]) -> bool:
        """Whether mu or h is zero."""
        return super().absent(values) or values.get("h") == 0

    @classmethod
    def resolved(cls, table: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the table with k_rf in place of h."""
        if "h" not in table:
            return table
        if "k_rf" in table:
            raise ScenarioError("h: stands in place of k_rf; give one of them")
        rest = {k: v for k, v in table.items() if k != "h"}
        h = cls.instead["k_rf"].read(table["h"])
        mu = read_table("a 'ttsc' fault", cls.keys[:1], {"mu": rest.get("mu")})["mu"]
        try:
            return {**rest, "k_rf": cls.of_h(mu, h).k_rf}
        except ParameterError as error:
            raise ScenarioError(f"h: {str(error).partition('h = ')[2]}") from None

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Fault:
        """Make the fault from mu, k_rf or h, kappa and phase."""
        values = read_table("a 'ttsc' fault", cls.keys, cls.resolved(table))
        if values["kappa"] is not None:
            bounded(values["kappa"], "kappa", lo=values["mu"], hi=1.0)
        return cls(**values)

    def to_table(self) -> dict[str, Any]:
        """Return the table, without the kind, which is the default."""
        table = super().to_table()
        del table["kind"]
        if self.kappa == self.mu:
            del table["kappa"]
        return table

    # -- seen from outside -----------------------------------------------------------------------

    def r_fault(self, p: MachineParameters) -> float:
        """Resistance of the fault branch (4), ohm."""
        return self.k_rf * self.mu * p.r_s

    def R_shunt(self, p: MachineParameters) -> float:
        """Resistance of the equivalent shunt from terminal k to the machine neutral, ohm."""
        return p.r_s / self.h

    def L_shunt(self, p: MachineParameters) -> float:
        """Inductance of the equivalent shunt, H; zero for kappa = mu."""
        return (self._kappa - self.mu) * p.L_ls / self.mu


def _current(at: AtFault) -> tuple[Any, Any]:
    """i_fault and its rate, which is zero where i_fault is algebraic."""
    if at.kind == "leaky":
        return at.x["i_fault"], at.z["di_fault"]
    return at.z["i_fault"], 0.0


def loop_residual(
    p: MachineParameters,
    *,
    mu: Any,
    k_rf: Any,
    kappa: Any,
    v_k: Any,
    i_fault: Any,
    di_fault: Any,
) -> Any:
    """Return the left minus the right side of the fault loop, V, with v_k - w1_k as ``v_k``.

    0 = (kappa - mu) L_ls d(i_fault)/dt + v_k + (1 - mu + k_rf) r_s i_fault, from (5) and (9).
    """
    return (kappa - mu) * p.L_ls * di_fault + v_k + (1.0 - mu + k_rf) * p.r_s * i_fault


def fault_loss(p: MachineParameters, *, mu: Any, k_rf: Any, i_k: Any, i_fault: Any) -> Any:
    """Return the extra loss of the fault in (8), W, from the phase's terminal current ``i_k``.

    i_fault^2 r_fault + ((i_k - i_fault)^2 - i_k^2) r_sa-f, with r_sa-f = mu r_s.
    """
    r_short = mu * p.r_s
    return i_fault**2 * k_rf * r_short + ((i_k - i_fault) ** 2 - i_k**2) * r_short
