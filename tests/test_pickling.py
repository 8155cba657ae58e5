"""Used models go to other processes: small, and the same bits there.

A used unit holds functions, buffers and loaded libraries; none of it may go along.
"""

import concurrent.futures as cf
import copy
import hashlib
import multiprocessing as mp
import os
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from apu_casadi import (
    Apu,
    FaultChange,
    GasGenerator,
    Generator,
    SeriesLoad,
    Ttsc,
    simulate_joint,
    trim,
    trim_batch,
)
from apu_casadi.core import backend, sharing
from apu_casadi.core.errors import BackendError
from apu_casadi.core.simulation import stepper
from apu_casadi.gaspath.gasgenerator import MapChoice
from apu_casadi.gaspath.maps.mapfiles import shipped
from apu_casadi.gaspath.maps.maptable import MapTable
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator
from estimators.batch.fit import FitProblem
from estimators.batch.mhe import HorizonEstimator
from estimators.filters.ekf import ekf_step, extended_kalman_filter
from estimators.filters.ukf import ukf_step

pytestmark = pytest.mark.compiled
SMALL = 100_000  # bytes; what a message between processes does not notice
SOURCE = SeriesLoad.from_power(1e5)


def digest(ds):
    """Hash all variables of a dataset."""
    h = hashlib.sha256()
    for name in sorted(map(str, ds.data_vars)):
        h.update(ds[name].values.tobytes())
    return h.hexdigest()


def run(apu, k=0):
    """Simulate 0.2 s with a short circuit of its own."""
    events = [FaultChange(t=0.1, fault=Ttsc(mu=0.05, k_rf=20.0 + k))]
    return digest(
        simulate_joint(
            apu, duration=0.2, load=SOURCE, events=events, solver="propagator", waveform_dt=1e-3
        )
    )


def point(gg, k=0):
    """Trim one point."""
    return trim(gg, {"N": 3775.15, "PW": 2e5 + 1e4 * k}).y.tobytes()


@pytest.fixture(scope="module")
def used():
    """A unit that has been run, trimmed and linearised from."""
    from apu_casadi.unit.linearisation import linearise_joint

    apu = Apu()
    run(apu)
    trim_batch(apu.gas_generator, {"N": 3775.15, "PW": np.linspace(1e5, 4e5, 20)})
    linearise_joint(apu, apu.steady_state(SOURCE))
    return apu


@pytest.fixture
def elsewhere(monkeypatch):
    """Forget all that is known of any model, as in another process."""
    import weakref

    def forget():
        monkeypatch.setattr(sharing, "_stores", weakref.WeakValueDictionary())
        monkeypatch.setattr(sharing, "_recent", {})

    return forget


@pytest.mark.long
def test_a_used_unit_is_pickled_as_its_parameters(used, elsewhere):
    """Some kilobytes; elsewhere everything is made again and gives the same bits."""
    text = pickle.dumps(used)
    assert len(text) < 10_000
    want = run(used), point(used.gas_generator)
    elsewhere()
    again = pickle.loads(text)
    assert again == used and again.gas_generator.cycle is not used.gas_generator.cycle
    assert (run(again), point(again.gas_generator)) == want


@pytest.mark.long
@pytest.mark.parametrize("protocol", [2, pickle.HIGHEST_PROTOCOL])
def test_copies_of_a_used_unit_are_equal_and_share_what_was_made(used, protocol):
    """Deep and flat copies, and pickles in the same process."""
    for again in (copy.deepcopy(used), copy.copy(used), pickle.loads(pickle.dumps(used, protocol))):
        assert again is not used and again == used
        assert again.gas_generator.cycle is used.gas_generator.cycle
        assert run(again) == run(used)


def test_equal_fresh_units_share_what_was_made(used):
    """Nothing is built for a new ``Apu()`` that an equal one has, nor for one with other numbers
    in another part."""
    assert Apu().gas_generator.cycle is used.gas_generator.cycle
    other = Apu().change({"machine.r_s": 0.0051})
    assert other.gas_generator.cycle is used.gas_generator.cycle
    assert other.generator.state_space() is not used.generator.state_space()


def test_own_maps_go_along():
    """A table that no other process knows is pickled with its numbers, read-only again."""
    t = shipped("axi5")
    own = MapTable(
        kind=t.kind, N=t.N, beta=t.beta, W=t.W * 1.0001, PR=t.PR, eta=t.eta,
        surge_W=t.surge_W, surge_PR=t.surge_PR, name="own",
    )  # fmt: skip
    default = GasGenerator()
    choice = MapChoice(own, 1.0, 2.0, default.compressor_map.calibration)
    gg = GasGenerator(compressor_map=choice)
    want = point(gg)
    text = pickle.dumps(gg)
    assert len(text) < SMALL
    again = pickle.loads(text)
    assert again == gg != default and hash(again) == hash(gg)
    assert not again.compressor_map.table.W.flags.writeable
    assert not copy.deepcopy(own).W.flags.writeable
    assert point(again) == want


@pytest.fixture(scope="module")
def models(used):
    """Public objects that hold functions or buffers, by name."""
    from estimators.apu.electrical.electricalfilter import electrical_filter
    from estimators.apu.fitting import engine_model
    from estimators.apu.gaspath import gas_path_filter

    gen, gg = used.generator, used.gas_generator
    at = gen.steady_state(SOURCE)
    fast = {"n_out": 160, "dt": 0.02, "quad": ("P_total",)}
    gas, electrical = gas_path_filter(gg), electrical_filter(gen.machine)
    lifted = engine_model(gg, ("P3", "T3", "T5"), steady=True)
    return {
        "generator": gen,
        "steady point": used.steady_state(SOURCE),
        "state space": gen.state_space("inductive", "leaky"),
        "gas state space": gg.state_space,
        "cycle": gg.cycle,
        "stepper": stepper(at.ss, 4, quad=("P_total",)),
        "propagator": Propagator(gen, at.ss, at.u, np.zeros(0), **fast),
        "mean step": MeanStep(gen, at.ss, at.u, np.zeros(0), dt=0.02, quad=("P_total",)),
        "gas-path filter": gas,
        "gas-path model": gas.model.with_walk({"N": 2.0}),
        "electrical filter": electrical,
        "electrical model": electrical.model.expanded(),
        "filter step": ekf_step(gas.model),
        "unscented step": ukf_step(electrical.model),
        "lifted model": lifted,
        "fit": FitProblem(lifted, [3], ["f_eta_c"]),
        "batch": trim_batch(gg, {"N": 3775.15, "PW": np.linspace(1e5, 4e5, 20)}),
    }


@pytest.mark.long
def test_everything_that_holds_functions_is_small(models):
    """Pickles and deep copies of each kind of model, used."""
    for name, model in models.items():
        text = pickle.dumps(model)
        assert len(text) < SMALL, f"{name}: {len(text)} bytes"
        assert type(pickle.loads(text)) is type(model) is type(copy.deepcopy(model)), name


def test_copied_steppers_and_propagators_give_the_same_bits(used, models):
    """Their functions are built again, or found; in the virtual machine, which compiles nothing."""
    at = used.generator.steady_state(SOURCE)
    calls = {
        "stepper": lambda s: s(at.x, at.u).x.tobytes(),
        "propagator": lambda s: s(at.x, at.u)[0].tobytes(),
        "mean step": lambda s: s(at.x, at.u)[0].tobytes(),
    }
    with backend.use_backend("vm"):
        for name, call in calls.items():
            assert call(pickle.loads(pickle.dumps(models[name]))) == call(models[name]), name


@pytest.mark.long
def test_a_filters_model_of_own_functions_goes_along():
    """Models that no function of the package made are pickled with their functions."""
    from estimation_models import pendulum, pendulum_data, random_belief

    model = pendulum()
    prior, data = random_belief(2, model), pendulum_data(model)
    want = extended_kalman_filter(model, prior, data)
    got = extended_kalman_filter(*pickle.loads(pickle.dumps((model, prior, data))))
    assert got.mean.tobytes() == want.mean.tobytes() and got.loglik == want.loglik
    horizon = HorizonEstimator(model, 3)
    assert pickle.loads(pickle.dumps(horizon)).run(prior, data).mean.tobytes() == (
        horizon.run(prior, data).mean.tobytes()
    )


def test_callers_of_compiled_code_are_refused_with_the_reason():
    """A library is a file of this machine; functions of the virtual machine go along."""
    x = ca.SX.sym("x", 2)
    f = ca.Function("f", [x], [2 * x])
    for made in (backend.Caller(f), backend.mapped(f, 1)):
        np.testing.assert_array_equal(
            np.ravel(pickle.loads(pickle.dumps(made))(np.ones(2))[0]), [2.0, 2.0]
        )
    if backend.find_compiler():
        with pytest.raises(BackendError, match="compiled code cannot be pickled"):
            pickle.dumps(backend.Caller(backend.compiled(f)))


def test_a_result_that_is_what_it_was_made_from_is_no_circle(models):
    """A function that returns its argument does not make it its own origin."""

    @sharing.remade
    def same(model):
        return model

    gen = Generator()
    assert pickle.loads(pickle.dumps(same(gen))) == gen
    step = ekf_step(models["gas-path model"])
    assert step.plain is step and type(pickle.loads(pickle.dumps(step.plain))) is type(step)


# ------------------------------------------------------------------------------ processes


@pytest.mark.long
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(
            "fork",
            marks=[
                pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here"),
                # Python warns of any thread; those of other tests are done, or wait for work
                pytest.mark.filterwarnings("ignore:This process.*is multi-threaded"),
            ],
        ),
        "spawn",
    ],
)
def test_processes_that_get_a_used_unit_give_the_same_bits(used, method):
    """Forked they inherit it, spawned they unpickle it."""
    want = [run(used, k) for k in range(2)]
    with cf.ProcessPoolExecutor(1, mp_context=mp.get_context(method)) as pool:
        assert list(pool.map(run, [used, used], range(2))) == want


@pytest.mark.long
@pytest.mark.parametrize("backend_name", ["loky", "threading"])
def test_joblib(used, backend_name):
    """Two workers of either kind."""
    joblib = pytest.importorskip("joblib")
    work = joblib.delayed(run)
    jobs = joblib.Parallel(n_jobs=2, backend=backend_name)(work(used, k) for k in range(3))
    assert jobs == [run(used, k) for k in range(3)]


DASK = """
import sys
sys.path.insert(0, sys.argv[1])
from dask.distributed import Client, LocalCluster
from test_pickling import point, run
from apu_casadi import Apu

if __name__ == "__main__":
    apu = Apu()
    want = [(run(apu, k), point(apu.gas_generator, k)) for k in range(3)]
    for processes in (False, True):
        with LocalCluster(
            n_workers=1, threads_per_worker=2, processes=processes,
            dashboard_address=":0", protocol="tcp" if processes else None,
        ) as cluster, Client(cluster) as client:
            got = client.gather([
                (client.submit(run, apu, k, pure=False),
                 client.submit(point, apu.gas_generator, k, pure=False)) for k in range(3)
            ])
        assert [tuple(g) for g in got] == want, (processes, got, want)
    print("SAME")
"""


@pytest.mark.ci  # starts a cluster; joblib and spawn, above, send the same models
def test_dask(tmp_path):
    """A local cluster of threads and one of processes, in a process of its own."""
    pytest.importorskip("distributed")
    script = tmp_path / "cluster.py"
    script.write_text(DASK)
    done = subprocess.run(
        [sys.executable, str(script), os.path.dirname(__file__)],
        capture_output=True, text=True, timeout=300, cwd=tmp_path,
    )  # fmt: skip
    assert done.stdout.strip() == "SAME", done.stderr[-3000:]
