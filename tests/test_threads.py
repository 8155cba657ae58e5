"""The same objects used by several threads: the serial bits, and no lock in compiled code.

What serial calls give is the reference: each result is compared bit for bit.
"""

import concurrent.futures as cf
import dataclasses
import hashlib
import re
import threading
import time
import weakref
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import apu_casadi
from apu_casadi import (
    Apu,
    FaultChange,
    GasGenerator,
    HealthChange,
    SeriesLoad,
    Ttsc,
    simulate_joint,
    trim,
    trim_batch,
)
from apu_casadi.core import backend, sharing
from apu_casadi.core.errors import BackendError
from apu_casadi.core.results import load, save
from apu_casadi.core.simulation import stepper

pytestmark = pytest.mark.compiled
THREADS = 4


def at_once(work, n=THREADS):
    """Call ``work(k)`` for k < n in as many threads, which begin together."""
    barrier = threading.Barrier(n)

    def begin(k):
        barrier.wait()
        return work(k)

    with cf.ThreadPoolExecutor(n) as pool:
        return list(pool.map(begin, range(n)))


def digest(ds):
    """Hash all variables of a dataset."""
    h = hashlib.sha256()
    for name in sorted(map(str, ds.data_vars)):
        h.update(ds[name].values.tobytes())
    return h.hexdigest()


def run(apu, k, **options):
    """Simulate 0.24 s with a load of its own, both kinds of faults in it."""
    events = [
        HealthChange(t=0.06, factors={"f_eta_c": 0.99}),
        FaultChange(t=0.12, fault=Ttsc(mu=0.05, k_rf=20.0 + k)),
    ]
    source = SeriesLoad.from_power(1e5 + 2e4 * k)
    return simulate_joint(apu, duration=0.24, load=source, events=events, **options)


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    [
        {"solver": "propagator", "waveform_dt": 1e-3},
        {"solver": "propagator", "waveform_dt": None, "phasors": True},
        {"solver": "cvodes", "waveform_dt": 1e-3},
    ],
    ids=["propagator", "means", "cvodes"],
)
@pytest.mark.parametrize("cold", [True, False], ids=["cold", "warm"])
def test_one_unit_in_four_threads_gives_the_serial_bits(options, cold, monkeypatch):
    """Cold, the threads race to build what a new process lacks; warm, they race in its code."""
    apu = Apu()
    if cold:  # nothing is known of any unit; libraries are on disk, or not
        monkeypatch.setattr(sharing, "_stores", weakref.WeakValueDictionary())
        monkeypatch.setattr(sharing, "_recent", {})
    else:
        run(apu, 0, **options)
    got = at_once(lambda k: digest(run(apu, k, **options)))
    assert got == [digest(run(Apu(), k, **options)) for k in range(THREADS)]


@pytest.mark.long
def test_the_virtual_machine_in_four_threads_gives_the_serial_bits():
    """Chosen for the process; the choice of a block stays with its thread."""
    apu = Apu()
    options = {"solver": "propagator", "waveform_dt": 1e-3}
    backend.use_backend("vm")
    try:
        got = at_once(lambda k: digest(run(apu, k, **options)))
        assert got == [digest(run(apu, k, **options)) for k in range(THREADS)]
    finally:
        backend.use_backend(None)


@pytest.mark.long
@pytest.mark.skipif(backend.find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(("duration", "waveform_dt"), [(0.5, 1e-3), (0.24, None)])
def test_a_compiled_run_is_that_of_the_virtual_machine(duration, waveform_dt):
    """Single steps, and in the longer run blocks of steps; 1e-9 of each value's largest."""
    how = {"duration": duration, "waveform_dt": waveform_dt, "solver": "propagator"}
    at, load = (0.6 * duration, 0.8 * duration), SeriesLoad.from_power(1e5)
    events = [HealthChange(at[0], {"f_eta_c": 0.99}), FaultChange(at[1], Ttsc(0.05, 20.0))]
    found = []
    for name in ("c", "vm"):
        with backend.use_backend(name):
            found.append(simulate_joint(Apu(), load=load, events=events, **how))
    for name, one in found[0].data_vars.items():
        other = found[1][name]
        assert float(abs(one - other).max()) <= 1e-9 * float(abs(other).max()), name


def test_trims_of_one_engine_in_four_threads_give_the_serial_bits():
    """Single points and batches; a refused point goes through the continuation."""
    gg = GasGenerator()

    def work(k):
        point = trim(gg, {"N": 3775.15, "PW": 2e5 + 1e4 * k})
        batch = trim_batch(gg, {"N": 3775.15, "PW": np.linspace(1e5, 9e5, 40) + 1e3 * k})
        return point.y.tobytes(), batch["T4"].tobytes(), batch.status.tobytes()

    assert at_once(work) == [work(k) for k in range(THREADS)]


def test_each_thread_reads_the_statistics_of_its_own_integration():
    """A stiff and an easy step in two threads: the counts of steps are not exchanged."""
    gen = Apu().generator
    source = SeriesLoad.from_power(1e5)
    point = gen.steady_state(source)
    step = stepper(point.ss, 1, quad=("P_total",))

    def work(k):
        u = point.u.copy()
        u[point.ss.u.index("w_r")] *= 1.0 + 0.01 * (k % 2)
        found = [step(point.x, u, dt=0.002 * (1 + k)) for _ in range(20)]
        return [(r.stats["nsteps"], r.x_end.tobytes(), r.mean["P_total"]) for r in found]

    got = at_once(work)
    assert got == [work(k) for k in range(THREADS)]
    assert len({rows[0][0] for rows in got}) > 1  # they do differ


def test_filters_of_one_model_in_four_threads_give_the_serial_bits():
    """A filter's step is built once and run by each thread on data of its own."""
    from estimation_models import pendulum, pendulum_data, random_belief

    from estimators.filters.ekf import extended_kalman_filter
    from estimators.filters.ukf import unscented_kalman_filter

    model = pendulum()
    prior, data = random_belief(2, model), pendulum_data(model)

    def work(k):
        f = (extended_kalman_filter, unscented_kalman_filter)[k % 2]
        found = f(model, prior, data)
        return found.mean.tobytes(), found.variance.tobytes(), found.loglik

    assert at_once(work) == [work(k) for k in range(THREADS)]


def test_a_hook_may_simulate_the_same_unit():
    """A run inside a run uses the same thread's buffers; the outer one has kept its own values."""
    apu, options = Apu(), {"solver": "propagator", "waveform_dt": 1e-3}

    def inner(k, x):
        if k == 8:
            run(apu, 3, **options)
        return x

    plain = run(apu, 0, hook=lambda k, x: x, **options)
    assert digest(run(apu, 0, hook=inner, **options)) == digest(plain)


def test_caller_and_mapped_have_buffers_for_each_thread():
    """Views belong to the thread that called."""
    x = ca.MX.sym("x", 200)
    f = ca.Function("f", [x], [ca.sin(x) + x**2])
    call, batch = backend.Caller(f, copy=False), backend.mapped(f, 2, chunk=64)
    rng = np.random.default_rng(5)
    inputs = rng.normal(size=(THREADS, 200, 70))

    def work(k):
        for _ in range(100):
            (y,) = call(inputs[k][:, 0])
            if not np.array_equal(y, backend.Caller(f)(inputs[k][:, 0])[0]):
                return None
        return batch(inputs[k])[0].tobytes()

    got = at_once(work)
    assert got == [backend.mapped(f, 1)(a)[0].tobytes() for a in inputs]
    mine, others = call.inputs[0], at_once(lambda k: call.inputs[0], 2)
    assert not any(np.shares_memory(mine, a) for a in others)


def test_a_threads_buffers_end_with_it():
    """A pool that comes and goes leaves nothing behind."""
    x = ca.MX.sym("x", 3)
    call = backend.Caller(ca.Function("f", [x], [2 * x]))
    made = []

    class Noted:
        def __init__(self):
            made.append(1)

        def __del__(self):
            made.append(-1)

    own = sharing.PerThread(Noted)
    at_once(lambda k: (own.own, call(np.ones(3))))
    assert own.own is own.own
    deadline = time.time() + 5.0
    while sum(made) > 1 and time.time() < deadline:
        time.sleep(0.01)
    assert sum(made) == 1  # this thread's own


def test_everything_is_built_once_however_many_threads_ask():
    """A property, a kept function and a lookup: one call of what makes them."""
    made = []

    @dataclasses.dataclass(frozen=True)
    class Model(sharing.Parametric):
        @sharing.derived
        def slow(self):
            made.append("slow")
            time.sleep(0.05)
            return object()

    @sharing.kept
    def of(model, n):
        made.append(n)
        time.sleep(0.05)
        return object()

    m = Model()
    got = at_once(lambda k: (m.slow, of(m, 1)))
    assert made == ["slow", 1] and len(set(got)) == 1


def test_a_block_chooses_the_backend_of_its_own_thread():
    """While one thread is in a block, another one sees the choice of the process."""
    inside, leave, seen = threading.Event(), threading.Event(), []

    def other():
        with backend.use_backend("vm"):
            seen.append(backend.backend_in_use())
            inside.set()
            leave.wait(10)

    before = backend.backend_in_use()
    t = threading.Thread(target=other)
    t.start()
    assert inside.wait(10)
    assert backend.backend_in_use() == before
    with backend.use_backend("vm"):
        leave.set()
        t.join()
        assert backend.backend_in_use() == "vm"
    assert seen == ["vm"] and backend.backend_in_use() == before


def test_blocks_of_many_threads_leave_the_choice_of_the_process():
    """Choices that overlap in any order: what was before holds afterwards."""
    before = backend.backend_in_use()

    def work(k):
        for _ in range(200):
            with backend.use_backend(("vm", "auto")[k % 2]):
                pass

    at_once(work)
    assert backend.backend_in_use() == before
    with pytest.raises(BackendError, match="unknown backend"):
        backend.use_backend("clang")


def test_one_path_saved_by_four_threads_holds_one_whole_result(tmp_path):
    """Each writes a file of its own and puts it in place; nothing else stays."""
    runs = [run(Apu(), k, solver="propagator", waveform_dt=1e-3) for k in range(2)]
    path = tmp_path / "same.nc"
    at_once(lambda k: [save(runs[k % 2], path) for _ in range(5)])
    assert digest(load(path)) in [digest(r) for r in runs]
    assert [p.name for p in tmp_path.iterdir()] == ["same.nc"]


def test_a_long_call_of_one_thread_keeps_no_other_waiting():
    """Compiled code runs without any lock: short calls of the same object go on beside it."""
    source = SeriesLoad.from_power(1e5)
    point = Apu().generator.steady_state(source)
    step, u = stepper(point.ss, 1), point.u.copy()
    u[point.ss.u.index("w_r")] *= 1.02

    def meanwhile(dt):
        """Count the short calls that end while one of length dt goes on."""
        ended, count = threading.Event(), 0

        def long():
            step(point.x, u, dt=dt)
            ended.set()

        t = threading.Thread(target=long)
        t.start()
        while not ended.is_set():
            step(point.x, u, dt=1e-4)
            count += 1
        t.join()
        return count

    # one may begin before, and one end after it; on a busy machine the long one may be over before
    # this thread has its turn, and is tried longer: with a lock no length would do
    assert any(meanwhile(dt) > 2 for dt in (5.0, 20.0, 80.0, 320.0))


def test_figures_of_four_threads_are_those_of_one(tmp_path):
    """Matplotlib's settings belong to the process: threads take turns, and nothing stays."""
    import matplotlib as mpl

    from scenarios.figures.figstyle import drawing, new_figure

    def work(k):
        with drawing():
            fig = new_figure(2.0, 3.0)
            ax = fig.add_subplot()
            ax.plot([0, 1, k])
        path = tmp_path / f"{k}-{threading.get_ident()}.png"
        fig.savefig(path, metadata={"Software": None})
        return path.read_bytes()

    before = dict(mpl.rcParams)
    got = at_once(work)
    assert dict(mpl.rcParams) == before
    assert got == [work(k) for k in range(THREADS)]


#: Modules whose cached values are small, safe to make twice, and belong to no model.
PLAIN_CACHES = {
    "apu_casadi/core/backend.py",
    "apu_casadi/core/cachefolder.py",
    "apu_casadi/core/signals.py",
    "estimators/batch/fitresult.py",
    # of an object that lives during one call
    "estimators/apu/electrical/causes.py",
    # texts, in modules that must not load casadi
    "apu_casadi/core/version.py",
    "scenarios/commands/identify.py",
}


def test_what_is_kept_is_kept_by_the_one_mechanism():
    """functools' caches build twice, never let go of a model, and go along with a pickle."""
    root = Path(apu_casadi.__file__).parents[1]
    found = {
        path.relative_to(root).as_posix()
        for package in ("apu_casadi", "estimators", "scenarios")
        for path in (root / package).rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if re.match(r"\s*@(functools\.)?(lru_cache|cache|cached_property)\b", line)
    }
    assert found == PLAIN_CACHES, "use derived, kept, last or once of apu_casadi.core.sharing"
