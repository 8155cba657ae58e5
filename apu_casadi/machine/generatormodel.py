"""The equations of the generator, assembled from machine, exciter, load and fault.

Written in the effective current ibar = i - branch, in which the machine is healthy; the branch is
what a fault lets flow in the phases beside it.  Flux linkages are the states and terminal voltages
the algebraic unknowns; the latter enter linearly, so that the explicit right-hand side follows
from the DAE by elimination.  The healthy model has no fault state at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.sharing import Parametric, keep, once
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine import exciter as ac5a
from apu_casadi.machine import wrsg
from apu_casadi.machine.faults.fault import AtFault, Branch, FaultStructure
from apu_casadi.machine.faults.fault import Own as OwnOfFault
from apu_casadi.machine.loads.load import AtLoad, LoadStructure, by_phase
from apu_casadi.machine.machinedata import (
    ExciterParameters,
    MachineParameters,
    SaturatedMachine,
)
from apu_casadi.machine.park import Abc, Qd0, abc_to_qd0, qd0_to_abc, speed_voltage
from apu_casadi.machine.wrsg import Windings

FLUXES = (
    Signal("lam_sq", "Wb", "stator flux linkage, q axis", nominal=0.1),
    Signal("lam_sd", "Wb", "stator flux linkage, d axis", nominal=0.1),
    Signal("lam_s0", "Wb", "stator flux linkage, zero sequence", nominal=0.1),
    Signal("lam_fd", "Wb", "field flux linkage", nominal=0.1),
    Signal("lam_kd", "Wb", "d damper flux linkage", nominal=0.1),
    Signal("lam_kq", "Wb", "q damper flux linkage", nominal=0.1),
)
ANGLE = Signal("theta_e", "rad", "rotor angle, phase-a axis to q axis, unwrapped")
DRIVES = (
    Signal("w_r", "rad/s", "electrical rotor speed", nominal=2500.0),
    Signal("V_ref", "1", "voltage reference, per unit"),
)
NOISE = (
    *(Signal(f"w1_{a}", "V", f"process noise w1 of (5), {a} axis", default=0.0) for a in "qd0"),
    *(
        Signal(f"w2_{a}", "V", f"process noise w2 of (6), {a} winding", default=0.0)
        for a in ("fd", "kd", "kq")
    ),
)
#: A difference of phase voltages: megavolts when a switch opens, so the nominal is large.
V_N = Signal("v_n", "V", "load star point to machine neutral", nominal=1e4)
FIXED_LOSS = Signal("shaft.P_fixed", "W", "iron and friction loss at rated speed", nominal=2e4)


class Shaft(NamedTuple):
    """What takes power of the shaft beside the torque: :data:`FIXED_LOSS`."""

    P_fixed: float = 0.0


OUTPUTS = Signals(
    [
        *by_phase("v", "V", "terminal voltage of phase {} to the machine's neutral", nominal=300.0),
        *by_phase("i", "A", "terminal current of phase {}", nominal=300.0),
        Signal("V_fd", "V", "field voltage, referred to the stator", nominal=50.0),
        Signal("i_fd", "A", "field current, referred to the stator", nominal=1e3),
        Signal("i_kd", "A", "d damper current", nominal=100.0),
        Signal("i_kq", "A", "q damper current", nominal=100.0),
        Signal("i_fault", "A", "current of the fault branch", nominal=1e3),
        Signal("E_fd", "1", "exciter output, per unit"),
        Signal("V_t", "V", "terminal voltage: rms of the space vector", nominal=200.0),
        Signal("v_n", "V", "load star point to machine neutral", nominal=100.0),
        Signal("T_e", "N m", "electromagnetic torque of one machine", nominal=200.0),
        Signal("P_e", "W", "electrical output of one machine", nominal=2e5),
        Signal("P_loss_fault", "W", "extra loss of the fault in (8), one machine", nominal=1e4),
        Signal("P_total", "W", "mechanical power of both machines (8)", nominal=4e5),
    ]
)


@dataclass(frozen=True)
class GeneratorModel(StateSpace):
    """A variant of the generator: a :class:`StateSpace` that knows its load and fault.

    Args:
        load, fault: structures that it is built of.
        linear: names of the states that are linear at constant speed with the exciter held; empty
            where the load or the machine is not.
        nonlinear: which of them is not, in words; "" where both are.
        reversing: those of them that change their sign when the rotor has turned by half a turn.
        exciter: Function (x, V_t, V_ref, theta) -> rates of the exciter's states, in the order of
            ``x``, from a terminal voltage in V rms.
        reduced: of a family, the same model with what follows from theta alone as its theta, and
            Function theta -> that.
    """

    load: LoadStructure | None = None
    fault: FaultStructure | None = None
    linear: tuple[str, ...] = ()
    nonlinear: str = ""
    reversing: tuple[str, ...] = ()
    exciter: ca.Function = field(default=None, repr=False)
    reduced: tuple[GeneratorModel, ca.Function] | None = field(default=None, repr=False)

    @property
    def shared(self) -> GeneratorModel:
        """The family with all that follows from theta alone as its theta, computed beforehand."""
        family = self.family
        if isinstance(family, GeneratorModel) and family.reduced is not None:
            return family.reduced[0]
        return self

    def full(self, theta: Any) -> np.ndarray:
        """Return theta of :attr:`shared` from this model's, shape (ntheta,)."""
        given = np.asarray(theta, dtype=float)
        family = self.family
        if not isinstance(family, GeneratorModel) or family.reduced is None:
            return given
        follow = family.reduced[1]
        return keep(
            self,
            GeneratorModel,
            given.tobytes(),
            lambda: follow(np.append(given, self.numbers)).full().ravel(),
        )


@dataclass(frozen=True)
class Structure(Parametric):
    """What the equations of a generator depend on, beside numbers.

    Args:
        load, fault, neutral, excitation, power: as of the generator.
        absent: parameters of the exciter that do not count (:attr:`ExciterParameters.absent`).
        machine: what the machine's parameters are of, linear or saturating.
    """

    load: LoadStructure
    fault: FaultStructure | None
    neutral: str
    absent: tuple[str, ...] = ()
    excitation: str = "regulated"
    machine: type[MachineParameters] = MachineParameters
    power: str = "paper"

    @property
    def name(self) -> str:
        """Name of the model."""
        parts = ["generator", self.load.kind, self.fault.kind if self.fault else "healthy"]
        parts += [] if self.grounded else ["isolated"]
        parts += [] if self.excitation == "regulated" else ["constant_field"]
        parts += ["saturated"] if self.saturated else []
        return "_".join(parts + ([] if self.power == "paper" else [self.power]))

    @property
    def saturated(self) -> bool:
        """Whether the machine is not linear."""
        return issubclass(self.machine, SaturatedMachine)

    @property
    def grounded(self) -> bool:
        """Whether the star points of machine and load are joined."""
        return self.neutral == "grounded"

    @property
    def exciter(self) -> ExciterParameters:
        """An exciter of this structure, unchecked: what does not count is zero, all else one."""
        names = (f.name for f in fields(ExciterParameters))
        return ExciterParameters().symbolic(**{n: float(n not in self.absent) for n in names})

    @property
    def own_of_fault(self) -> OwnOfFault:
        """What the fault brings in."""
        if self.fault is None:
            return OwnOfFault()
        return self.fault.fault.own(self.fault.kind, self.neutral)

    def signals(self) -> tuple[Signals, Signals, Signals, Signals]:
        """Return x, z, u and theta; theta without the machine's and the exciter's parameters."""
        load, fault = self.load.load.own, self.own_of_fault
        fluxes = [s for s in FLUXES if self.grounded or s.name != "lam_s0"]
        exciter = ac5a.exciter_signals(self.exciter)
        X = [*fluxes, *fault.states, ANGLE, *exciter, *load.states]
        v = by_phase("v", "V", "terminal voltage of phase {}", nominal=300.0)
        Z = [*v, *([] if self.grounded else [V_N]), *fault.unknowns, *load.unknowns]
        return Signals(X), Signals(Z), self.inputs, Signals(fault.theta)

    def parameters(self) -> tuple[Signals, Signals, Signals]:
        """Return the parameters of machine, exciter and shaft that count."""
        names = [f.name for f in fields(ExciterParameters) if f.name not in self.absent]
        return (
            self.machine().signals("machine"),
            ExciterParameters().signals("exciter", names),
            Signals([FIXED_LOSS] if self.power == "torque" else []),
        )

    def numbers(self, p: MachineParameters, e: ExciterParameters, shaft: Shaft) -> list[float]:
        """Return their values."""
        parts = zip((p, e, shaft), self.parameters(), strict=True)
        return [getattr(x, n.split(".")[1]) for x, part in parts for n in part.names]

    @property
    def inputs(self) -> Signals:
        """The inputs u."""
        return Signals([*DRIVES, *self.load.load.own.inputs, *NOISE])

    @property
    def linear(self) -> tuple[str, ...]:
        """States of the windings, the fault and the load, where all of them are linear."""
        if not self.load.load.linear or self.saturated:
            return ()
        fluxes = [s.name for s in FLUXES if self.grounded or s.name != "lam_s0"]
        fault = [s.name for s in self.own_of_fault.states]
        return (*fluxes, *fault, *(s.name for s in self.load.load.own.states))

    @property
    def nonlinear(self) -> str:
        """What is not linear, in words."""
        parts = [] if self.load.load.linear else ["its load is not linear"]
        return "; ".join(parts + (["its machine saturates"] if self.saturated else []))

    @property
    def reversing(self) -> tuple[str, ...]:
        """Those of them that belong to phases, not to the rotor's axes."""
        fault = self.fault.fault.reversing if self.fault else ()
        names = ("lam_s0", *fault, *self.load.load.reversing)
        return tuple(n for n in self.linear if n in names)


@once
def family(structure: Structure) -> GeneratorModel:
    """Write the semi-explicit DAE, and eliminate its algebraic unknowns.

    theta has the parameters of the fault, the machine and the exciter.
    """
    X, Z, U, TH = structure.signals()
    of_machine, of_exciter, of_shaft = structure.parameters()
    (xv, x), (zv, z), (uv, u), (tv, th) = X.sx(), Z.sx(), U.sx(), TH.sx()
    pv, ev = ca.SX.sym("machine", len(of_machine)), ca.SX.sym("exciter", len(of_exciter))
    lv = ca.SX.sym("shaft", len(of_shaft))
    p = structure.machine().symbolic(**_by_field(of_machine, pv))
    e = structure.exciter.symbolic(**_by_field(of_exciter, ev))
    V_t, V_ref = ca.SX.sym("V_t"), ca.SX.sym("V_ref")
    ode, alg, y = equations(structure, p, e, x, z, u, th)
    if structure.power == "torque":
        w_m, part = u["w_r"] / p.n_pp, u["w_r"] / p.w_rated
        y["P_total"] = 2.0 * (y["T_e"] * w_m + lv[0] * part)
    dex = exciter_rates(structure, p, e, x, V_t, V_ref)
    ode_v, alg_v, y_v = X.stack(ode), ca.vertcat(*alg), OUTPUTS.stack(y)
    z_expr = solve_linear(ca.jacobian(alg_v, zv), -ca.substitute(alg_v, zv, ca.SX.zeros(len(Z))))
    f_v, g_v = ca.substitute([ode_v, y_v], [zv], [z_expr])
    exciter = ca.vertcat(*(dex[n] for n in X.names if n in dex))
    theta = ca.vertcat(tv, pv, ev, lv)
    signals = Signals([*TH, *of_machine, *of_exciter, *of_shaft])
    symbols = (xv, zv, uv, V_t, V_ref)
    expressions = [ode_v, alg_v, f_v, g_v, z_expr, exciter]
    reduced, follow, by = ca.extract_parametric(
        ca.cse(expressions), theta, {"extract_trivial": True}
    )
    compact = Signals([Signal(f"p{k}", "1", "follows from parameters") for k in range(len(follow))])
    inner = _model(structure, (X, Z, U, compact), symbols, ca.vertcat(*follow), reduced)
    outer = _model(structure, (X, Z, U, signals), symbols, theta, expressions)
    values = ca.Function("follow", [theta], [ca.vertcat(*by)], {"cse": True})
    return replace(outer, reduced=(inner, values))


def _by_field(signals: Signals, symbols: ca.SX) -> dict[str, Any]:
    return {n.split(".")[1]: symbols[k] for k, n in enumerate(signals.names)}


def _model(
    structure: Structure,
    signals: tuple[Signals, Signals, Signals, Signals],
    symbols: tuple[Any, Any, Any, Any, Any],
    theta: Any,
    expressions: Sequence[Any],
) -> GeneratorModel:
    (xv, zv, uv, V_t, V_ref), (ode, alg, f, g, z, exciter) = symbols, expressions
    made = GeneratorModel.of(
        structure.name,
        (*signals, OUTPUTS),
        (xv, zv, uv, theta),
        dae=(ode, alg),
        f=f,
        g=g,
        z=z,
        cse=True,
    )
    rates = ca.Function("exciter", [xv, V_t, V_ref, theta], [exciter], {"cse": True})
    return _told(made, structure, rates)


def _told(made: GeneratorModel, structure: Structure, exciter: ca.Function) -> GeneratorModel:
    linear, reversing = structure.linear, structure.reversing
    return replace(
        made,
        load=structure.load,
        fault=structure.fault,
        linear=linear,
        nonlinear=structure.nonlinear,
        reversing=reversing,
        exciter=exciter,
    )


def variant(
    structure: Structure, p: MachineParameters, e: ExciterParameters, shaft: Shaft
) -> GeneratorModel:
    """Return the model of one unit, a member of the family."""
    whole = family(structure)
    theta = structure.signals()[3]
    made = GeneratorModel.member(structure.name, whole, theta, structure.numbers(p, e, shaft))
    return _told(made, structure, None)


def exciter_rates(
    structure: Structure,
    p: MachineParameters,
    e: ExciterParameters,
    x: dict[str, Any],
    V_t: Any,
    V_ref: Any,
) -> dict[str, Any]:
    """Return the rates of the exciter's states by name, from V_t in V rms."""
    if structure.excitation == "constant":
        return {n: ca.SX(0) for n in ac5a.ExciterState._fields if n in x}
    ex = ac5a.ExciterState(*(x.get(n) for n in ac5a.ExciterState._fields))
    dex = ac5a.exciter_rates(e, ex, V_t=V_t / p.V_rated_rms, V_ref=V_ref)
    return {n: d for n, d in dex._asdict().items() if d is not None}


def equations(
    structure: Structure,
    healthy: MachineParameters,
    e: ExciterParameters,
    x: dict[str, Any],
    z: dict[str, Any],
    u: dict[str, Any],
    th: dict[str, Any],
) -> tuple[dict[str, Any], list[Any], dict[str, Any]]:
    """Return rates of the states by name, residuals in the order of z, and outputs by name."""
    load, fault = structure.load.load, structure.fault and structure.fault.fault
    grounded, zero = structure.grounded, ca.SX(0)
    p = fault.machine(healthy, th) if fault else healthy
    theta_e, w_r = x["theta_e"], u["w_r"]
    v, v_n = Abc(z["v_a"], z["v_b"], z["v_c"]), z.get("v_n", zero)
    v_qd0 = abc_to_qd0(theta_e, v)
    w1 = Qd0(u["w1_q"], u["w1_d"], u["w1_0"])

    none = Abc(zero, zero, zero)
    branch = Branch(none, none, zero, zero)
    at = AtFault("", healthy, x, z, th, v, qd0_to_abc(theta_e, w1))
    if structure.fault and fault:
        at = at._replace(kind=structure.fault.kind)
        branch = fault.branch(at) or branch

    # machine; with an isolated neutral i_0 = 0, so that ibar_0 is what the branch has less
    lam_s0 = x["lam_s0"] if grounded else p.L_ls * branch.zero
    lam = Windings(x["lam_sq"], x["lam_sd"], lam_s0, x["lam_fd"], x["lam_kd"], x["lam_kq"])
    ibar = wrsg.currents(p, lam)
    V_fd = p.V_fd_base * x["E_fd"]
    w2 = (u["w2_fd"], u["w2_kd"], u["w2_kq"])
    dlam = wrsg.flux_rates(p, lam=lam, i=ibar, v=v_qd0, V_fd=V_fd, w_r=w_r, w1=w1, w2=w2)
    i = Abc(*map(sum, zip(qd0_to_abc(theta_e, ibar.stator), branch.current, strict=True)))

    # load
    rates = dlam if grounded else dlam._replace(s0=p.L_ls * branch.zero_rate)
    dibar, turn = wrsg.current_rates(p, lam, rates).stator, speed_voltage(w_r, ibar.stator)
    dbar = qd0_to_abc(theta_e, Qd0(*map(sum, zip(dibar, turn, strict=True))))
    di = Abc(*map(sum, zip(dbar, branch.rate, strict=True)))
    v_load = Abc(*(vk - v_n for vk in v))
    at_load = AtLoad(x, z, u, v_load, i, di, theta_e, w_r, p.V_rated_rms)
    alg = [vk - d for vk, d in zip(v_load, load.drop(at_load), strict=True)]
    if not grounded:  # (5), zero sequence: what v_0 must be for i_0 to stay zero
        v_0 = p.L_ls * branch.zero_rate - p.r_s * ibar.s0 + w1.zero
        alg.append(v_qd0.zero - v_0)
    at = at._replace(i=i)
    alg += (fault.residuals(at) if fault else []) + load.residuals(at_load)

    # exciter
    V_space = ca.sqrt(v_qd0.q**2 + v_qd0.d**2 + (1e-6 * p.V_rated_rms) ** 2)
    V_t = V_space / math.sqrt(2.0)
    dex = exciter_rates(structure, p, e, x, V_t, u["V_ref"])

    ode = {f"lam_{n}": d for n, d in dlam._asdict().items() if f"lam_{n}" in x}
    ode |= {**dex, "theta_e": w_r, **load.rates(at_load), **(fault.rates(at) if fault else {})}

    P_e = sum((vk * ik for vk, ik in zip(v, i, strict=True)), zero)
    P_loss = fault.loss(at) if fault else zero
    y = {f"v_{k}": vk for k, vk in zip("abc", v, strict=True)}
    y |= {f"i_{k}": ik for k, ik in zip("abc", i, strict=True)}
    y |= {"V_fd": V_fd, "i_fd": ibar.fd, "i_kd": ibar.kd, "i_kq": ibar.kq, "i_fault": zero}
    y |= {"E_fd": x["E_fd"], "V_t": V_t, "v_n": v_n, "T_e": wrsg.torque(p, lam=lam, i=ibar)}
    y |= {"P_e": P_e, "P_loss_fault": P_loss, "P_total": 2.0 * (P_e + P_loss) / p.eta_sg}
    return ode, alg, y | (fault.outputs(at, y) if fault else {})


def solve_linear(M: ca.SX, b: ca.SX) -> ca.SX:
    """Return M^-1 b by elimination in the given order, spending nothing on structural zeros.

    No pivoting: the caller orders the unknowns so that the pivots cannot vanish.
    """
    n = M.shape[0]
    A = [[M[i, j] for j in range(n)] for i in range(n)]
    r = [b[i] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            if A[i][k].is_zero():
                continue
            factor = A[i][k] / A[k][k]
            A[i][k] = ca.SX(0)
            for j in range(k + 1, n):
                if not A[k][j].is_zero():
                    A[i][j] = A[i][j] - factor * A[k][j]
            r[i] = r[i] - factor * r[k]
    x: list[Any] = [None] * n
    for i in reversed(range(n)):
        total = r[i]
        for j in range(i + 1, n):
            if not A[i][j].is_zero():
                total = total - A[i][j] * x[j]
        x[i] = total / A[i][i]
    return ca.vertcat(*x)
