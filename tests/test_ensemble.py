"""Ensembles of joint runs: each member is the single run, whoever else is there."""

import numpy as np
import pytest

from apu_casadi import Apu, FaultChange, HealthChange, LoadChange, SeriesLoad, Ttsc, simulate_joint
from apu_casadi.core.backend import find_compiler
from apu_casadi.core.errors import BackendError, OperatingPointError, ScenarioError, SimulationError
from apu_casadi.core.lanes import together
from apu_casadi.core.lanes.together import Member, Question, Together, answer, ensemble
from apu_casadi.unit.ensemble import simulate_ensemble
from apu_casadi.unit.noise import Noise

COMMON = {"duration": 0.5, "waveform_dt": None, "warn_exchange": False}
LOAD = SeriesLoad.from_power(100e3)


def members():
    """Events at different instants, other loads, another unit, noise, and one that ends early."""
    sick = HealthChange(t=0.1, factors={"f_eta_c": 0.99})
    drop = LoadChange(t=0.213, load=SeriesLoad.from_power(150e3))
    return [
        {"load": LOAD},
        {"load": LOAD, "events": [sick]},
        {"load": SeriesLoad.from_power(99e3), "health": {"f_W_c": 0.98}, "events": [drop]},
        {"load": LOAD, "apu": Apu().change({"machine.r_s": 0.0079})},
        {"load": LOAD, "noise": Noise(N=0.01), "seed": 3, "duration": 0.1},
        {"load": LOAD, "waveform_dt": 1e-4, "duration": 0.21},
    ]


def assert_same(a, b):
    assert set(a.variables) == set(b.variables)
    for name, values in a.variables.items():
        assert np.array_equal(values.values, b[name].values, equal_nan=True), name
    assert a.attrs == b.attrs


@pytest.fixture(scope="module")
def alone():
    return [simulate_joint(**{"apu": Apu(), **COMMON, **m}) for m in members()]


def test_members_are_the_single_runs(alone):
    """In chunks that part them; each by its number."""
    for a, b in zip(simulate_ensemble(members(), chunk=3, **COMMON), alone, strict=True):
        assert_same(a, b)


@pytest.mark.compiled
@pytest.mark.ci
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler found")
def test_members_are_the_single_runs_in_lanes(monkeypatch):
    """The blocks of all members in compiled lanes, also on threads: the bits of compiled runs."""
    monkeypatch.setattr(together, "OFTEN", 0)
    fault = FaultChange(t=0.05, fault=Ttsc(mu=0.05, k_rf=20.0))
    some = [*members()[:3], {"load": LOAD, "events": [fault]}]
    single = [simulate_joint(**{"apu": Apu(), **COMMON, **m}) for m in some]
    for threads in (1, 2):
        many = simulate_ensemble([*some, *some], n_threads=threads, **COMMON)
        for k, a in enumerate(many):
            assert_same(a, single[k % 4])


def test_results_do_not_depend_on_who_else_is_there(alone):
    some = members()
    (one,) = simulate_ensemble(some[2:3], **COMMON)
    two = simulate_ensemble([some[2], some[0]], **COMMON)
    assert_same(one, alone[2])
    assert_same(two[0], alone[2])
    assert_same(two[1], alone[0])


def test_what_is_kept_and_told(alone):
    seen = []
    kept = simulate_ensemble(
        members()[:3],
        keep=lambda k, ds: (k, float(ds["N"][-1])),
        progress=lambda done, total: seen.append((done, total)),
        **COMMON,
    )
    assert kept == [(k, float(ds["N"][-1])) for k, ds in enumerate(alone[:3])]
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_a_member_that_cannot_run_does_not_stop_the_others(alone):
    asked = [members()[0], {"load": SeriesLoad.from_power(2e6)}]
    good, bad = simulate_ensemble(asked, refused="keep", **COMMON)
    assert_same(good, alone[0])
    assert isinstance(bad, OperatingPointError | SimulationError)
    with pytest.raises(type(bad)) as told:
        simulate_ensemble(asked, **COMMON)
    assert told.value.__notes__ == ["member 1 of the ensemble"]


@pytest.mark.parametrize(
    ("asked", "how", "words"),
    [
        ([], {}, "at least one member"),
        ([{"laod": LOAD}], {}, "member 0: argument 'laod' .*load"),
        ([{}], {}, "member 0: load must be given"),
        ([{"load": LOAD}], {"chunk": 0}, "chunk = 0"),
        ([{"load": LOAD}], {"refused": "skip"}, "'raise' or 'keep'"),
    ],
)
def test_wrong_input_is_named(asked, how, words):
    with pytest.raises(ScenarioError, match=words):
        simulate_ensemble(asked, **COMMON, **how)


def doubled(name="doubled"):
    import casadi as ca

    x = ca.SX.sym("x", 2, 2)
    f = ca.Function(name, [x], [2 * x])
    return Together(f, f)


def test_a_member_asks_and_finds_the_answer():
    f, g, x = doubled(), doubled("other"), np.array([[1.0, 2.0], [3.0, 4.0]])
    assert np.array_equal(f(x)[0], 2 * x)
    both = [Member(), Member()]
    for k, m in enumerate(both):
        with m, pytest.raises(Question):
            f(k * x)
    answer(both)
    for k, m in enumerate(both):
        with m:
            assert np.array_equal(f(k * x)[0], 2 * k * x)
            with pytest.raises(Question):
                f(x)
    answer(both)
    with both[0], pytest.raises(BackendError, match="asked for doubled, then for other"):
        g(x)


def test_rows_of_calls_are_answered_together_and_whole_packs_first():
    """Rows of two lengths: each member has its own; what one function is asked more often goes."""
    f, g, x = doubled(), doubled("other"), np.array([[1.0, 2.0], [3.0, 4.0]])
    row = np.hstack([2 * x, 4 * x, 8 * x])
    assert np.array_equal(f.in_a_row(3, x)[0], row)
    asked = [Member() for _ in range(3)]
    for m, (h, n) in zip(asked, ((f, 3), (g, 1), (f, 2)), strict=True):
        with m, pytest.raises(Question):
            h.in_a_row(n, x)
    answer(asked, patient=True)
    answer(asked, patient=True)
    answer(asked, patient=True)
    for m, (h, n) in zip(asked, ((f, 3), (g, 1), (f, 2)), strict=True):
        with m:
            assert m.asks is None and np.array_equal(h.in_a_row(n, x)[0], row[:, : 2 * n])


def test_a_hook_that_simulates_does_so_by_itself(alone):
    """What a member runs inside asks nobody."""

    def hook(k, x):
        if k == 3:
            assert_same(simulate_joint(Apu(), load=LOAD, **COMMON), alone[0])
        return x

    (ds,) = simulate_ensemble([{"load": LOAD, "hook": hook, **COMMON, "duration": 0.1}])
    assert float(ds["time"][-1]) == 0.1


def test_no_more_members_are_under_way_than_a_chunk():
    """Memory is that of a chunk: courses begin when others have ended."""
    f, x, alive, most = doubled(), np.eye(2), [0], [0]

    def course(k):
        alive[0] += 1
        most[0] = max(most[0], alive[0])
        for _ in range(k % 3):
            while True:
                try:
                    made = f(k * x)[0]
                    break
                except Question as question:
                    asked = question
                yield asked
            assert np.array_equal(made, 2 * k * x)
        alive[0] -= 1
        return k

    done = dict(ensemble(map(course, range(20)), chunk=4))
    assert done == {k: k for k in range(20)}
    assert 1 < most[0] <= 4
