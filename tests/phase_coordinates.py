"""A second machine, in phase coordinates: coupled windings, no Park transform.

The textbook machine in phase variables (Krause, Analysis of Electric Machinery, ch. 5) with
rotor-dependent inductances.  It shares no code and no transformation with the package.  Two forms
of the turn-to-turn short circuit:

* :func:`independent_machine`: a shunt R-L from the terminal to the machine neutral, with exciter;
* :func:`coupled_windings`: the phase is cut in two windings with their own self and mutual
  inductances, and the fault resistance bridges one of them; at constant field voltage.
"""

import math
from types import SimpleNamespace

import casadi as ca
import numpy as np
import scipy.integrate

from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters

P = MachineParameters()
W = 2 * math.pi * 400.0


def krause_inductance(theta, P=P):
    """Phase-domain inductances, motor signs, rows a b c fd kd kq; Krause eqs. 5.2-8 to 5.3-18.

    One matrix for each angle; one matrix of objects for a symbol.
    """
    A, B = (P.L_md + P.L_mq) / 3, (P.L_md - P.L_mq) / 3
    s = 2 * np.pi / 3
    cos, sin, shape, kind = ca.cos, ca.sin, (), object
    if not isinstance(theta, ca.SX):
        theta = np.asarray(theta)
        cos, sin, shape, kind = np.cos, np.sin, theta.shape, np.result_type(theta, float)
    L = np.zeros((*shape, 6, 6), dtype=kind)
    for j, k in ((0, 0), (1, 1), (2, 2)):
        L[..., j, k] = P.L_ls + A - B * cos(2 * (theta - j * s))
    for j, k, shift in ((0, 1, np.pi / 3), (0, 2, -np.pi / 3), (1, 2, np.pi)):
        L[..., j, k] = L[..., k, j] = -A / 2 - B * cos(2 * (theta - shift))
    for j in range(3):
        L[..., j, 3] = L[..., j, 4] = P.L_md * sin(theta - j * s)
        L[..., j, 5] = P.L_mq * cos(theta - j * s)
    L[..., 3:, :3] = 2 / 3 * L[..., :3, 3:].swapaxes(-1, -2)
    L[..., 3:5, 3:5] = P.L_md
    L[..., 3, 3] += P.L_lfd
    L[..., 4, 4] += P.L_lkd
    L[..., 5, 5] = P.L_mq + P.L_lkq
    return L


def independent_machine(point, load, fault, t_end, n_out, *, isolated=False):
    """Healthy phase-domain machine with shunt R-L and AC5A, from the package's steady state.

    Returns phase voltages (3, n), terminal currents (3, n) and the shunt current (n,).
    """
    e = ExciterParameters()
    k = "abc".index(fault.phase)
    x0 = point.ss.x.unpack(point.x)
    theta0 = x0["theta_e"]
    R = np.array(load.R)
    R_sh, L_sh = fault.R_shunt(P), fault.L_shunt(P)
    if isolated and L_sh == 0:
        raise NotImplementedError
    B = math.log(e.S_E1 / e.S_E2) / (e.E_1 - e.E_2)
    A = e.S_E2 * math.exp(-B * e.E_2)
    shifts = np.array([0, 1, 2]) * 2 * np.pi / 3
    lam0 = np.cos(theta0 - shifts) * x0["lam_sq"] + np.sin(theta0 - shifts) * x0["lam_sd"]
    rotor0 = [x0["lam_fd"], x0["lam_kd"], x0["lam_kq"]]
    s0 = np.array([*lam0, *rotor0, 0.0, x0["V_c"], x0["V_R"], x0["E_fd"], x0["x_F1"]])
    r = np.array([P.r_s] * 3 + [P.r_fd, P.r_kd, P.r_kq])

    def signals(t, s):
        theta = theta0 + W * t
        L = krause_inductance(theta)
        i = np.linalg.solve(L, s[:6])  # motor signs; the stator's output is -i
        out = -i[:3]
        V_fd = P.V_fd_base * s[9]
        if L_sh == 0:  # grounded: the shunt is a resistance beside the load's
            R_eff = R.copy()
            R_eff[k] = R[k] * R_sh / (R[k] + R_sh)
            v = R_eff * out
            i_sh = v[k] / R_sh
        else:
            i_sh = s[6]
            i_load = out.copy()
            i_load[k] -= i_sh
            v = R * i_load
            if isolated:  # the star point moves so that the load's currents keep adding to zero
                dL = krause_inductance(theta + 1e-30j).imag / 1e-30 * W

                def drift(v_n):
                    u = np.concatenate([v + v_n, [V_fd, 0, 0]])
                    di = np.linalg.solve(L, u - r * i - dL @ i)
                    return -di[:3].sum() - (v[k] + v_n - R_sh * i_sh) / L_sh

                at_0, at_1 = drift(0.0), drift(1.0)
                v = v - at_0 / (at_1 - at_0)
        out_load = out.copy()
        out_load[k] -= i_sh
        return v, out_load, i_sh, i, V_fd

    def rates(t, s):
        v, _, i_sh, i, V_fd = signals(t, s)
        dlam = np.concatenate([v, [V_fd, 0, 0]]) - r * i
        di_sh = 0.0 if L_sh == 0 else (v[k] - R_sh * i_sh) / L_sh
        # space vector without the zero sequence
        V_t = math.sqrt(2 / 3 * (v @ v - v.sum() ** 2 / 3)) / math.sqrt(2) / P.V_rated_rms
        V_c, V_R, E, x_F = s[7:]
        V_F = e.K_F / e.T_F1 * (E - x_F)
        dV_R = (e.K_A * (point.V_ref - V_c - V_F) - V_R) / e.T_A
        dV_R = max(min(dV_R, (e.V_R_max - V_R) / e.T_lim), (e.V_R_min - V_R) / e.T_lim)
        S = A * math.exp(B * E)
        d_ex = [(V_t - V_c) / e.T_R, dV_R, (V_R - (e.K_E + S) * E) / e.T_E, (E - x_F) / e.T_F1]
        return np.concatenate([dlam, [di_sh], d_ex])

    t = np.linspace(0, t_end, n_out + 1)
    sol = scipy.integrate.solve_ivp(
        rates, (0, t_end), s0, "DOP853", t_eval=t, rtol=1e-10, atol=1e-12
    )
    assert sol.success
    rows = [signals(ti, si)[:3] for ti, si in zip(sol.t, sol.y.T, strict=True)]
    v, i, i_sh = (np.array(c).T for c in zip(*rows, strict=True))
    return SimpleNamespace(t=sol.t, v=v, i=i, i_sh=i_sh)


class PhaseMachine:
    """A machine with AC5A on a resistive load, grounded neutral, at a speed that is given in steps.

    CVODES integrates the equations written here, with tolerances of their own.

    Its short circuit (kappa = mu) is a resistance beside the load's.  Energies are states: work of
    the shaft, of the field, output, extra loss of (8), and copper loss.

    Parameters
    ----------
    gen, load : parameters are read from the first, resistances from the second.
    point : steady state to start from.
    """

    def __init__(self, gen, load, point):
        self.p, self.e, self.V_ref = gen.machine, gen.exciter, point.V_ref
        self.R, self.fault = np.array(load.R), None
        x = point.ss.x.unpack(point.x)
        self.theta = x["theta_e"]
        angles = self.theta - np.array([0, 1, 2]) * 2 * np.pi / 3
        lam = np.cos(angles) * x["lam_sq"] + np.sin(angles) * x["lam_sd"]
        rotor = [x[n] for n in ("lam_fd", "lam_kd", "lam_kq", "V_c", "V_R", "E_fd", "x_F1")]
        self.s = np.array([*lam, *rotor, *np.zeros(5)])
        p = self.p
        self.r = np.array([p.r_s] * 3 + [p.r_fd, p.r_kd, p.r_kq])

    def stored(self):
        """Magnetic energy, J; rotor rows are referred by 2/3."""
        i = np.linalg.solve(krause_inductance(self.theta, self.p), self.s[:6])
        return 0.5 * (self.s[:3] @ i[:3] + 1.5 * self.s[3:6] @ i[3:])

    def _functions(self):
        """Waveforms and rates as functions of (time, state, speed, angle); CasADi computes them."""
        p, e, R = self.p, self.e, self.R
        t, s, w, theta0 = (ca.SX.sym(n, k) for n, k in (("t", 1), ("s", 15), ("w", 1), ("th", 1)))
        theta = theta0 + w * t
        # harmonics 0, 1 and 2 of the angle are all that there is
        harmonics = np.fft.fft(krause_inductance(2 * np.pi * np.arange(8) / 8, p), axis=0) / 8
        L = sum(
            (2 if k else 1)
            * (ca.cos(k * theta) * ca.DM(c.real) - ca.sin(k * theta) * ca.DM(c.imag))
            for k, c in enumerate(harmonics[:3])
        )
        i, symmetric = ca.solve(L, s[:6]), ca.DM([1, 1, 1, 1.5, 1.5, 1.5])
        g_sh = np.zeros(3)
        if self.fault is not None:
            g_sh["abc".index(self.fault.phase)] = 1.0 / self.fault.R_shunt(p)
        v = -i[:3] / ca.DM(1.0 / R + g_sh)
        i_load, i_sh, V_fd = v / ca.DM(R), ca.dot(v, ca.DM(g_sh)), p.V_fd_base * s[8]
        dL = ca.reshape(ca.jacobian(ca.vec(L), theta0), 6, 6)
        torque = -0.5 * p.n_pp * ca.dot(i * symmetric, dL @ i)
        dlam = ca.vertcat(v, V_fd, 0, 0) - self.r * i
        V_t = ca.sqrt((ca.dot(v, v) - ca.sum1(v) ** 2 / 3) / 3) / p.V_rated_rms
        V_c, V_R, E, x_F = ca.vertsplit(s[6:10])
        V_F = e.K_F / e.T_F1 * (E - x_F)
        dV_R = (e.K_A * (self.V_ref - V_c - V_F) - V_R) / e.T_A
        dV_R = ca.fmax(ca.fmin(dV_R, (e.V_R_max - V_R) / e.T_lim), (e.V_R_min - V_R) / e.T_lim)
        B = math.log(e.S_E1 / e.S_E2) / (e.E_1 - e.E_2)
        S = e.S_E2 * ca.exp(B * (E - e.E_2))
        d_ex = [(V_t - V_c) / e.T_R, dV_R, (V_R - (e.K_E + S) * E) / e.T_E, (E - x_F) / e.T_F1]
        loss = shunt = 0.0
        if self.fault is not None:
            k, mu = "abc".index(self.fault.phase), self.fault.mu
            i_F, shunt = i_sh / mu, i_sh * v[k]  # equal ampere-turns: mu of the turns have i_F more
            loss = self.fault.r_fault(p) * i_F**2
            loss += mu * p.r_s * ((i_load[k] + i_F) ** 2 - i_load[k] ** 2)
        copper = ca.dot(self.r * i, i * symmetric)
        energy = [torque * w / p.n_pp, 1.5 * V_fd * i[3], ca.dot(v, i_load), loss, copper + shunt]
        waves = ca.vertcat(v, i_load, torque)
        model = {
            "x": s,
            "t": t,
            "p": ca.vertcat(w, theta0),
            "ode": ca.vertcat(dlam, *d_ex, *energy),
        }
        return model, ca.Function("waves", [t, s, model["p"]], [waves])

    def step(self, w, t):
        """Go on at the electrical speed w over instants t from 0; return waveforms at them."""
        model, waves = self._functions()
        how = {"reltol": 1e-11, "abstol": 1e-12}
        solve = ca.integrator("reference", "cvodes", model, 0.0, t, how)
        p = [w, self.theta]
        x = solve(x0=self.s, p=p)["xf"].full()
        rows = waves.map(t.size)(ca.DM(t).T, x, p).full()
        before, self.s, self.theta = self.s, x[:, -1], self.theta + w * t[-1]
        means = (self.s[10:] - before[10:]) / t[-1]
        return SimpleNamespace(v=rows[:3], i=rows[3:6], T_e=rows[6], means=means)


# Radau IIA with three stages (Hairer and Wanner, Solving Ordinary Differential Equations II,
# table IV.5.6): order 5, stiffly accurate, so that a singular inductance matrix does no harm
_S = math.sqrt(6.0)
RADAU_C = np.array([(4 - _S) / 10, (4 + _S) / 10, 1.0])
RADAU_A = np.array(
    [
        [(88 - 7 * _S) / 360, (296 - 169 * _S) / 1800, (-2 + 3 * _S) / 225],
        [(296 + 169 * _S) / 1800, (88 + 7 * _S) / 360, (-2 - 3 * _S) / 225],
        [(16 - _S) / 36, (16 + _S) / 36, 1 / 9],
    ]
)


def split_phase(theta, fault):
    """Inductances of a b c, the shorted turns, fd kd kq; motor signs, shape (..., 7, 7).

    The phase of ``fault`` is cut in two: 1 - mu of its turns stay in its row, mu are in row 3.
    Magnetising inductances go with the turns.  The leakage L_ls of the whole phase is that of two
    windings in series, L_1 + 2 M + L_2 with M + L_2 = mu L_ls, which leaves (7) of the paper as
    it is; the one number left free is L_2 = mu kappa L_ls.
    """
    k = "abc".index(fault.phase)
    mu, kappa = fault.mu, fault.kappa
    magnetising = krause_inductance(theta)
    for j in range(3):
        magnetising[..., j, j] -= P.L_ls
    turns = np.zeros((7, 6))
    turns[:3, :3], turns[4:, 3:] = np.eye(3), np.eye(3)
    turns[k, k], turns[3, k] = 1 - mu, mu
    L = turns @ magnetising @ turns.T
    for j in range(3):
        L[..., j, j] += P.L_ls * (1 - 2 * mu + mu * kappa if j == k else 1.0)
    L[..., 3, 3] += P.L_ls * mu * kappa
    L[..., 3, k] += P.L_ls * mu * (1 - kappa)
    L[..., k, 3] += P.L_ls * mu * (1 - kappa)
    return L


def coupled_windings(start, V_fd, theta0, load, fault, t_end, n_out, *, isolated=False, steps=20):
    """Simulate the faulty machine at constant field voltage and rated speed.

    Kirchhoff's voltage law of each loop, d/dt(C' L C j) = C' (u - R C j): j are the loops'
    currents, C says which elements a loop passes, motor signs.  A loop runs through each phase,
    both of its parts, and the load; one through the shorted turns and the fault resistance; one
    through each rotor winding.  With an isolated neutral the loop of c is that of a and b.

    Parameters
    ----------
    start : currents just before the switch, A: i_a, i_b, i_c (out of the machine), i_fd.
    V_fd : field voltage, V.
    theta0 : rotor angle at the switch, rad.
    load, fault : from the switch on; currents are continuous, i_fault starts from zero.
    t_end, n_out : end, s, and number of equally spaced outputs.
    isolated : whether the load's star point is free.
    steps : steps between two outputs.

    Returns
    -------
    Phase currents out of the machine (3, n), i_fault (n,), rotor currents (3, n), winding voltages
    terminal to neutral (3, n; None where the inductances are singular), torque of the shaft (n,).
    """
    k = "abc".index(fault.phase)
    # loops a b c, fault, fd kd kq; the shorted turns carry the phase's current and the fault's
    C = np.eye(7)
    C[3, k] = 1.0
    r = np.array([P.r_s] * 3 + [fault.mu * P.r_s, P.r_fd, P.r_kd, P.r_kq])
    r[k] *= 1 - fault.mu
    R_machine = C.T @ np.diag(r) @ C
    R_machine[3, 3] += fault.k_rf * fault.mu * P.r_s
    R = R_machine + np.diag([*load.R, 0, 0, 0, 0])
    L_load = np.diag([*load.L, 0, 0, 0, 0])
    free = np.eye(7)
    if isolated:
        free = np.delete(free, 2, axis=1)
        free[2, :2] = -1.0
    u = np.array([0, 0, 0, 0, V_fd, 0, 0.0])

    def loops(theta):
        return C.T @ split_phase(theta, fault) @ C + L_load

    def slope(theta):
        return loops(theta + 1e-30j).imag / 1e-30

    n = free.shape[1]
    R_free, u_free = free.T @ R @ free, free.T @ u
    h = t_end / (n_out * steps)
    j = np.array([-start["i_a"], -start["i_b"], -start["i_c"], 0.0, start["i_fd"], 0.0, 0.0])
    flux = free.T @ loops(theta0) @ j
    ones = np.repeat(h * RADAU_A.sum(axis=1), n) * np.tile(u_free, 3)
    stages = theta0 + W * h * (np.arange(n_out * steps)[:, None] + RADAU_C)
    L = free.T @ loops(stages) @ free
    M = np.tile(np.kron(h * RADAU_A, R_free), (len(L), 1, 1))
    for s in range(3):
        M[:, s * n : (s + 1) * n, s * n : (s + 1) * n] += L[:, s]
    out = []
    for step in range(n_out * steps):
        last = np.linalg.solve(M[step], np.tile(flux, 3) + ones)[2 * n :]
        flux = L[step, 2] @ last
        if (step + 1) % steps == 0:
            out.append(free @ last)
    J = np.array(out).T
    t = np.arange(1, n_out + 1) * t_end / n_out
    symmetric = np.diag([1, 1, 1, 1, 1.5, 1.5, 1.5])  # rotor rows are referred by 2/3
    torque, v = [], []
    regular = np.linalg.cond(free.T @ loops(theta0) @ free) < 1e9
    angles = theta0 + W * t
    for L, dL, ji in zip(loops(angles), slope(angles), J.T, strict=True):
        torque.append(-0.5 * P.n_pp * ji @ symmetric @ dL @ ji)
        if regular:
            drop = free.T @ (R + W * dL) @ ji
            dj = free @ np.linalg.solve(free.T @ L @ free, u_free - drop)
            own = (L - L_load) @ dj + W * dL @ ji + R_machine @ ji
            v.append(own[:3])
    return SimpleNamespace(
        t=t, i=-J[:3], i_fault=J[3], rotor=J[4:], T_e=np.array(torque),
        v=np.array(v).T if regular else None,
    )  # fmt: skip
