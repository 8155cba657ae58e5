"""Ctrl-C and its kin: one line and status 130 from the command, KeyboardInterrupt from the library.

A signal comes from outside, as from a terminal: raised inside Python it would not meet the solvers
where they are.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from apu_casadi.core import files, interrupts
from apu_casadi.core.errors import SimulationError
from apu_casadi.core.interrupts import watched
from scenarios.shell import guard

ANSWER = 15.0
"""Seconds until an answer that takes 0.6 s on a quiet machine; work left alone goes on longer."""


@pytest.fixture
def soon():
    """Send this process SIGINT from another one, some time later."""
    children = []

    def send(after):
        code = f"import os, time; time.sleep({after}); os.kill({os.getpid()}, 2)"
        children.append(subprocess.Popen([sys.executable, "-S", "-c", code]))

    yield send
    for child in children:
        child.wait()
    interrupts.clear()


def test_an_interrupt_inside_cvodes_is_no_failure_of_the_model(soon):
    """CVODES makes a set-up that failed of the exception; `watched` makes the interrupt of that."""
    x = ca.SX.sym("x", 2)
    ode = ca.vertcat(1e4 * x[1], -1e4 * x[0])
    F = ca.integrator("F", "cvodes", {"x": x, "ode": ode}, 0, 1e4, {"max_num_steps": 10**8})
    before = signal.getsignal(signal.SIGINT)
    soon(0.3)
    with pytest.raises(KeyboardInterrupt), watched():
        F(x0=[1.0, 0.0])
    assert signal.getsignal(signal.SIGINT) is before
    assert interrupts.recorded() == 0


def test_an_interrupt_inside_ipopt_is_no_missing_solution(soon):
    """IPOPT ends as if the user had asked it to stop, without any exception."""
    x = ca.MX.sym("x", 30)
    f = ca.sum1((x[1:] - x[:-1] ** 2) ** 2 * 100 + (1 - x[:-1]) ** 2)
    slow = f
    for _ in range(400):  # a Rosenbrock valley with much to compute at each step
        slow = slow + 1e-12 * ca.sin(slow)
    options = {
        "print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-300,
        "ipopt.max_iter": 10**6, "ipopt.hessian_approximation": "limited-memory",
        "ipopt.acceptable_iter": 0, "ipopt.dual_inf_tol": 1e-300,
    }  # fmt: skip
    S = ca.nlpsol("S", "ipopt", {"x": x, "f": slow}, options)
    soon(0.3)
    with pytest.raises(KeyboardInterrupt), watched():
        while not interrupts.recorded():  # should IPOPT end by itself before the signal comes
            S(x0=-np.ones(30))


def test_nothing_is_concluded_while_an_interrupt_is_recorded():
    """Whatever turns a solver's failure into an error of the package raises the interrupt."""
    interrupts.record(signal.SIGINT)
    try:
        with pytest.raises(KeyboardInterrupt):
            raise SimulationError("a state has left the model's domain")
    finally:
        interrupts.clear()
    assert str(SimulationError("later")) == "later"


def test_a_handler_that_raises_nothing_is_left_alone():
    """A program with a handler of its own decides for itself; threads get no signals at all."""
    came = []
    before = signal.signal(signal.SIGINT, lambda *_: came.append(1))
    try:
        with watched():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert came == [1] and interrupts.recorded() == 0

    entered = []

    def go():
        with watched():
            entered.append(1)

    thread = threading.Thread(target=go)
    thread.start()
    thread.join()
    assert entered == [1]


def test_the_line_says_what_is_kept(monkeypatch, tmp_path):
    """Finished files by name; else that there are none; and how to go on."""
    monkeypatch.setattr(guard, "_note", "")
    files.account(True)
    try:
        assert guard.line(2) == (
            "apu: interrupted; nothing was written; run the same command again"
        )
        files.write_text(tmp_path / "a.txt", "a")
        assert guard.line(15) == (
            f"apu: terminated; written: {tmp_path / 'a.txt'}; run the same command again"
        )
        guard.note("runs are kept in X; the same command goes on")
        assert guard.line(2).endswith("a.txt; runs are kept in X; the same command goes on")
    finally:
        files.account(False)


def test_processes_started_in_the_block_do_not_hear_ctrl_c():
    """Also not while they start, when no handler of theirs can stand yet."""
    code = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
    with interrupts.kept_from_children():
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "True\n"
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


# ------------------------------------------------------------------ the command, from outside

RECORD = "time,N,P3,T3,T5,Wf,PW\n" + "".join(
    f"{0.02 * k:.2f},{3775 + k % 3},{1e6 + 100 * (k % 7)},{605 + k % 5},{800 + k % 4},0.045,5e5\n"
    for k in range(400)
)
COMMANDS = {
    "run": ["run", "joint", "--solver", "cvodes"],
    "trim": ["trim", "--power", "2e5"],
    "list": ["list"],
    "deck": ["deck", "--power", "0:5e5:60000"],
    "study": ["study", "trim", "--points", "60000"],
    "validate": ["validate"],
    "fit": ["fit", "rec.csv"],
    "calibrate": ["calibrate"],
    "maps": ["maps"],
    "linearise": ["linearise"],
    "identify": ["identify", "--trials", "500"],
    "errata": ["errata"],
    "multirate": ["multirate"],
    "compile": ["compile"],
    "bench": ["bench", "--only", "trim"],
    "campaign": ["campaign", "--runs", "300"],
    "estimate joint": ["estimate", "joint"],
    "estimate study": ["estimate", "study", "fitting", "--out", "kept"],
}


def interrupted(argv, after, folder, signum=signal.SIGINT, times=1):
    """Start a command, send a signal; return status, stderr, and seconds until the answer.

    None if the command was over before.
    """
    (folder / "rec.csv").write_text(RECORD)
    env = {**os.environ, "APU_CACHE_DIR": str(folder / "cache")} if "compile" in argv else None
    p = subprocess.Popen(
        [sys.executable, "-m", "scenarios.cli", *argv], cwd=folder, env=env, text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip
    time.sleep(after)
    if p.poll() is not None:
        p.communicate()
        return None
    for _ in range(times):
        p.send_signal(signum)
        time.sleep(0.02 if times > 1 else 0.0)
    t = time.perf_counter()
    err = p.communicate(timeout=60)[1]
    return p.returncode, err, time.perf_counter() - t


def check(answer, folder, signum=signal.SIGINT):
    """One line, the status, in time, and nothing half written."""
    if answer is None:
        return
    status, err, seconds = answer
    assert status == 128 + signum, err
    assert err.startswith("apu: ") and err.count("\n") == 1, err
    assert seconds < ANSWER
    assert not [p for p in Path(folder).rglob("*") if p.name.endswith(".part")]


@pytest.mark.long
@pytest.mark.parametrize(("name", "after"), [("run", 0.5), ("deck", 3.0), ("fit", 2.0)])
def test_ctrl_c_ends_a_command_with_one_line(tmp_path, name, after):
    """During imports, in compiled code on threads, and while a fit builds or solves its problem."""
    check(interrupted(COMMANDS[name], after, tmp_path), tmp_path)


@pytest.mark.long
def test_sigterm_and_a_second_ctrl_c(tmp_path):
    """kill is answered as Ctrl-C is, with 143; impatience changes nothing."""
    check(
        interrupted(COMMANDS["validate"], 1.5, tmp_path, signal.SIGTERM), tmp_path, signal.SIGTERM
    )
    check(interrupted(COMMANDS["run"], 2.0, tmp_path, times=3), tmp_path)


# Python's own start, before the first line of the package, belongs to nobody: it takes some 20 ms,
# and up to ten times as long where the machine is shared
@pytest.mark.slow  # about three minutes: every command at six moments
@pytest.mark.parametrize("after", (0.3, 0.7, 1.5, 2.5, 4.0, 7.0))
@pytest.mark.parametrize("name", list(COMMANDS))
def test_ctrl_c_at_every_moment_of_every_command(tmp_path, name, after):
    """Imports, building of functions, solvers, drawing, processes."""
    answer = interrupted(COMMANDS[name], after, tmp_path)
    if answer is not None and answer[0] == 0:  # all was done; only the interpreter was ending
        assert answer[1] == "" and answer[2] < 1.0
        return
    check(answer, tmp_path)
