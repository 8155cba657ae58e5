"""Processes that end with their parent, locks that end with their process, signals."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from apu_casadi.core.errors import DataError
from scenarios.shell import locking, workers
from scenarios.shell.locking import locked

PARENT = """
import os, sys, time
from scenarios.shell.workers import pool
with pool(2) as p:
    pids = {p.submit(os.getpid).result() for _ in range(2)}
    jobs = [p.submit(time.sleep, 300) for _ in range(2)]
    time.sleep(0.2)
    print(*(q.pid for q in p._processes.values()), flush=True)
    if sys.argv[1] == "error":
        raise KeyboardInterrupt
    if sys.argv[1] == "exit":
        os._exit(3)
    time.sleep(300)
"""

HOLDER = """
import sys, time
from pathlib import Path
from scenarios.shell.locking import locked
with locked(Path(sys.argv[1]), "the.lock"):
    print("held", flush=True)
    time.sleep(300)
"""


def python(code, *args):
    return subprocess.Popen(
        [sys.executable, "-c", code, *args], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip


def gone(pid):
    """Whether a process has ended; one that nobody has waited for counts as ended."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    try:
        with open(f"/proc/{pid}/stat") as f:
            return f.read().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return not os.path.exists("/proc") or not os.path.exists(f"/proc/{pid}")


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL there")
@pytest.mark.parametrize("how", ["kill", "exit", "error"])
def test_workers_end_with_their_parent(how):
    """Killed, ended without a word, or interrupted: in the middle of jobs of five minutes."""
    p = python(PARENT, how)
    pids = [int(n) for n in p.stdout.readline().split()]
    assert len(pids) == 2
    if how == "kill":
        p.kill()
    p.wait(timeout=20)
    end = time.monotonic() + 10  # s; a thread has to wake up, on a machine that may be busy
    while not all(gone(n) for n in pids) and time.monotonic() < end:
        time.sleep(0.05)
    assert [gone(n) for n in pids] == [True, True]
    p.communicate()


def test_a_worker_ends_when_its_pipe_does(monkeypatch):
    """The way that needs no help of the kernel."""
    from multiprocessing import Pipe

    ended = threading.Event()
    monkeypatch.setattr(workers.os, "_exit", lambda status: ended.set())
    ours, theirs = Pipe(duplex=False)
    thread = threading.Thread(target=workers._end_with, args=(ours,))
    thread.start()
    assert not ended.wait(0.05)
    theirs.close()
    thread.join(timeout=10)
    assert ended.is_set()
    ours.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_both_signals_end_a_block(number):
    """Also where a solver swallows the exception; the handlers of before come back."""
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), workers.stoppable() as check:
        check()
        with contextlib.suppress(KeyboardInterrupt):  # as an integrator does
            signal.raise_signal(number)
        check()
        pytest.fail("not reached")
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_ignored_signals_and_own_handlers_are_respected():
    """nohup ignores; a program with a way of its own to end keeps it."""
    seen = []
    before = signal.signal(signal.SIGINT, lambda *a: seen.append("own"))
    term = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with pytest.raises(KeyboardInterrupt), workers.stoppable():
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
        assert seen == ["own"]
        signal.signal(signal.SIGTERM, lambda *a: seen.append("own too"))
        with pytest.raises(KeyboardInterrupt), workers.stoppable():
            signal.raise_signal(signal.SIGTERM)
        assert seen == ["own", "own too"]
    finally:
        signal.signal(signal.SIGINT, before)
        signal.signal(signal.SIGTERM, term)


def test_one_process_at_a_time(tmp_path, caplog):
    """The second is told whom it waits for, or refused; nothing stays in the folder."""
    said = []
    with locked(tmp_path, "the.lock"):
        who = json.loads((tmp_path / "the.lock").read_text())
        assert who["pid"] == os.getpid()
        with (
            pytest.raises(DataError, match=f"in use by process {os.getpid()} on .* since"),
            locked(tmp_path, "the.lock", wait=False),
        ):
            pass
        waiting = threading.Thread(
            target=lambda: locked(tmp_path, "the.lock", say=said.append).__enter__()
        )
        waiting.daemon = True
        waiting.start()
        waiting.join(0.3)
        assert waiting.is_alive() and len(said) == 1
    waiting.join(timeout=10)
    assert not waiting.is_alive()
    with pytest.raises(DataError, match="cannot be written"), locked(tmp_path / "no", "the.lock"):
        pass


def test_order_of_many(tmp_path):
    """Eight threads count in a file without losing one; the lock file goes and comes between."""
    (tmp_path / "n").write_text("0")

    def work():
        for _ in range(5):
            with locked(tmp_path, "the.lock"):
                n = int((tmp_path / "n").read_text())
                time.sleep(0.001)
                (tmp_path / "n").write_text(str(n + 1))

    threads = [threading.Thread(target=work) for _ in range(8)]
    poll, locking.POLL = locking.POLL, 0.002
    try:
        for t in threads:
            t.start()
        for t in threads:
            t.join()
    finally:
        locking.POLL = poll
    assert (tmp_path / "n").read_text() == "40"
    assert [p.name for p in tmp_path.iterdir()] == ["n"]


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL there")
def test_a_killed_process_leaves_no_lock(tmp_path):
    p = python(HOLDER, str(tmp_path))
    assert p.stdout.readline() == "held\n"
    with pytest.raises(DataError, match=f"process {p.pid} "), locked(
        tmp_path, "the.lock", wait=False
    ):  # fmt: skip
        pass
    p.kill()
    p.communicate()
    assert (tmp_path / "the.lock").exists()  # it says who held it, and means nothing
    with locked(tmp_path, "the.lock", wait=False):
        pass


def test_a_file_system_without_locks_is_told(tmp_path, monkeypatch, caplog):
    fcntl = pytest.importorskip("fcntl")

    def flock(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", flock)
    with locked(tmp_path, "the.lock"):
        assert "no locks on this file system" in caplog.text
