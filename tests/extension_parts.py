"""A user's file: a load, a fault, a sensor and a governor of one's own, each in less than 50 lines.

It names only what the package makes public.  ``apu run my.toml --with extension_parts.py`` takes
it, and so does ``extensions = ["extension_parts.py"]`` in a scenario; from Python it is imported.
"""

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from apu_casadi import Signal, Signals
from apu_casadi.core.parameters import par
from apu_casadi.core.register import Key
from apu_casadi.machine.faults.fault import FAULTS, Fault
from apu_casadi.machine.faults.fault import Own as FaultOwn
from apu_casadi.machine.loads.load import LOADS, Load, Own
from apu_casadi.machine.park import Abc, Qd0, abc_to_qd0, qd0_to_abc, speed_voltage
from apu_casadi.unit.control import GOVERNORS, Governor
from estimators.apu.sensors import Sensor, register

# -- (a) a load: R and C in series in each phase; capacitors on the rotor axes ----


@LOADS.add("my_RC")
@dataclass(frozen=True)
class MyCapacitors(Load):
    """v = R i + v_C,  C dv_C/dt = i; balanced."""

    R: float
    C: float

    tables: ClassVar = {
        "my_RC": (Key("R", "ohm", "resistance", 0), Key("C", "F", "capacitance", 0))
    }
    kind = "my_capacitors"
    balanced = True
    own = Own(
        (Signal("R_my", "ohm", "resistance"), Signal("C_my", "F", "capacitance", nominal=1e-3)),
        (Signal("u_q", "V", "capacitors, q axis"), Signal("u_d", "V", "capacitors, d axis")),
    )

    @property
    def inputs(self):
        return {"R_my": self.R, "C_my": self.C}

    @property
    def label(self):
        return f"{self.R:g} ohm and {self.C:g} F"

    @classmethod
    def examples(cls):
        return {"my_capacitors": cls(1.0, 2e-3)}

    def drop(self, at):
        v_C = qd0_to_abc(at.theta_e, Qd0(at.x["u_q"], at.x["u_d"], 0.0))
        return Abc(*(at.u["R_my"] * i + v for i, v in zip(at.i, v_C, strict=True)))

    def rates(self, at):
        i = abc_to_qd0(at.theta_e, at.i)
        turn = speed_voltage(at.w_r, Qd0(at.x["u_q"], at.x["u_d"], 0.0))
        return {"u_q": i.q / at.u["C_my"] - turn.q, "u_d": i.d / at.u["C_my"] - turn.d}

    def impedance(self, w_r, V_t):
        return complex(self.R, -1 / (w_r * self.C))

    def steady(self, w_r, V_t, i):
        return {"u_q": -i.d / (w_r * self.C), "u_d": i.q / (w_r * self.C)}


# -- (b) a fault of another kind: shorted turns of the field winding ----


@FAULTS.add("my_field")
@dataclass(frozen=True)
class MyFieldShort(Fault):
    """A fraction of the field's turns out of the circuit: r_fd/(1 - m) by the turns left."""

    m: float

    word = "my_field"
    keys = (Key("m", "1", "shorted fraction of the field's turns", 0.0, 0.9),)
    severities = (Signal("m", "1", "shorted fraction of the field's turns", default=0.0),)

    def kind(self, load, neutral):
        return "my_field"

    def own(self, kind, neutral):
        return FaultOwn((Signal("m", "1", "shorted fraction", nominal=0.1),))

    def machine(self, p, theta):
        return p.symbolic(r_fd=p.r_fd / (1 - theta["m"]))

    def outputs(self, at, y):
        left = 1 - at.theta["m"]
        return {"V_fd": left * y["V_fd"], "i_fd": y["i_fd"] / left}

    def parameters(self, kind):
        return {"m": self.m}

    @classmethod
    def examples(cls):
        return {"my_field": cls(0.1)}


# -- (c) sensors: T41 by a thermocouple with a first-order lag; a difference of pressures ----

T41_MINE = register(
    Sensor("T41_mine", 0.005, True, 0.005, "K", "my thermocouple", (400.0, 1900.0),
           reads=("T41",), tau=0.8)
)  # fmt: skip


def difference(P3, P5):
    return P3 - P5


DP_MINE = register(
    Sensor("dP_mine", 0.005, True, 0.005, "Pa", "my transducer", (1e4, 2e6),
           reads=("P3", "P5"), value=difference)
)  # fmt: skip

# -- (e) a governor with derivative action ----


@GOVERNORS.add("my_PID")
@dataclass(frozen=True)
class MyGovernor(Governor):
    """A PI law with a filtered derivative."""

    X: ClassVar[Signals] = Signals([
        Signal("Wf_I", "kg/s", "integrator", nominal=0.05),
        Signal("e_slow", "1", "filtered speed error", nominal=1e-2),
    ])  # fmt: skip
    Kp: float = par(0.38, unit="kg/s", source="mine", doc="proportional gain")
    Ki: float = par(0.76, unit="kg/s^2", source="mine", doc="integral gain")
    Kd: float = par(0.01, unit="kg", source="mine", doc="derivative gain")
    T_d: float = par(0.05, unit="s", source="mine", doc="filter of the derivative", lo=1e-3)
    T_aw: float = par(0.1, unit="s", source="mine", doc="anti-windup", lo=1e-4)
    Wf_min: float = par(0.010, unit="kg/s", source="mine", doc="lower fuel limit", lo=1e-5)
    Wf_max: float = par(0.060, unit="kg/s", source="mine", doc="upper fuel limit", lo=1e-5)

    def demand(self, e, x):
        return self.Kp * e + x[0] + self.Kd * (e - x[1]) / self.T_d

    def rates(self, e, x, cut):
        return self.Ki * e + cut / self.T_aw, (e - x[1]) / self.T_d


# -- (f) a filter step: the gain of the steady filter, which does not change ----


def constant_gain(K, S):
    """Return the maker of a step m + K (y - g(m)), with the innovation's covariance S."""
    from estimators.filters.filtering import STEP_IN, STEP_OUT, FilterStep
    from estimators.filters.stepparts import step_symbols

    def step(model):
        m, P, u, p, y, R, dt = s = step_symbols(model, ca.MX)
        w = ca.MX.zeros(len(model.w))
        h, check = model.output(m, u, p, w)
        nu = ca.if_else(R >= 0, y - h, 0)
        m_f = m + ca.DM(K) @ nu
        m1, c = model.transition(m_f, u, p, w, dt)
        nis = nu.T @ ca.inv(ca.DM(S)) @ nu
        loglik = -0.5 * (nis + ca.log(ca.det(2 * ca.pi * ca.DM(S))))
        stats = ca.vertcat(check + c, nis, loglik, ca.sum1(R >= 0))
        out = [ca.densify(o) for o in (m1, P, m_f, P, P, nu, ca.DM(S), stats)]
        return FilterStep(model, ca.Function(f"constant_{model.name}", s, out, STEP_IN, STEP_OUT))

    return step
