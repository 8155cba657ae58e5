"""Steady points: every way of fixing one gives the same, none is wrong, every refusal says why."""

import itertools
import pickle
import threading

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core import backend
from apu_casadi.core.errors import OperatingPointError, SignalError
from apu_casadi.gaspath.designdata import RPM
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import (
    MEANING,
    Limits,
    LoadLaw,
    Refusal,
    Status,
    limit_status,
    specify,
)
from apu_casadi.gaspath.steady.trimbatch import performance_deck, trim_batch
from apu_casadi.gaspath.steady.trimkernel import LAW, TrimKernel
from apu_casadi.gaspath.steady.trimming import maximum_power, trim_gas_generator
from apu_casadi.gaspath.steady.trimsolver import norms, solver_of
from scenarios.studies import trim_study

N_DESIGN = 36050 * RPM
CRUISE = {"altitude": 8000.0, "Mach": 0.7, "dT_isa": 5.0}
WORN = {"f_eta_c": 0.97, "f_W_c": 0.98, "f_eta_t": 0.98, "f_W_t": 1.03}

needs_compiler = pytest.mark.skipif(
    backend.find_compiler() is None, reason="no C compiler ($CC, cc, gcc, clang) found"
)


@pytest.fixture(scope="module")
def gg():
    return GasGenerator()


@pytest.fixture(scope="module")
def reference(gg):
    """Cruise of Table 5, a little off speed and worn, so that nothing is special."""
    fixed = {"N": 0.985 * N_DESIGN, "PW": 222e3}
    return trim_gas_generator(gg, fixed, theta=WORN, **CRUISE)


FIXABLE = ("N", "PW", "Wf", "T3", "P3", "T4", "T41", "T5", "SM", "W2", "SFC", "PR_t")


@pytest.mark.long
@pytest.mark.parametrize(
    "pair", [p for p in itertools.combinations(FIXABLE, 2) if p[0] in ("N", "PW", "Wf", "T5")]
)
def test_every_pair_gives_the_same_point(gg, reference, pair):
    """The equations do not know what was fixed: any two values of a point give it back.

    1e-8: errors below the residual's tolerance are magnified by the pair's conditioning.  Pairs
    with two solutions may give the other one, which must then have both values.
    """
    fixed = {n: reference[n] for n in pair}
    point = trim_gas_generator(gg, fixed, theta=WORN, **CRUISE)
    assert point.residual < 1e-9
    for n in pair:
        assert point[n] == pytest.approx(reference[n], rel=1e-9)
    if abs(point["N"] / reference["N"] - 1) < 1e-3:
        for n in FIXABLE:
            assert point[n] == pytest.approx(reference[n], rel=1e-7), n
    else:
        assert "N" not in pair


@pytest.mark.long
def test_speed_and_another_quantity_give_the_point_itself(gg, reference):
    """Guards the test above: with the speed fixed there is no second solution to hide behind."""
    for n in FIXABLE[1:]:
        point = trim_gas_generator(gg, {"N": reference["N"], n: reference[n]}, theta=WORN, **CRUISE)
        assert point["Wf"] == pytest.approx(reference["Wf"], rel=1e-8)


def test_design_point_comes_back(gg):
    """Table 4's design speed and T4 give the design calculation's own values, without maps."""
    p, d = gg.parameters, gg.design.values
    point = trim_gas_generator(gg, {"N": p.N, "T4": p.T4}, dT_isa=p.dT_isa)
    for n in ("W2", "T3", "P3", "T5", "Wf"):
        assert point[n] == pytest.approx(d[n], rel=1e-9)


def test_load_law_meets_the_law_and_the_other_value(gg, reference):
    """Power ~ speed cubed through a point: that point is found from its fuel flow and its speed."""
    law = LoadLaw(reference["PW"], reference["N"])
    for other in ("Wf", "T4", "N"):
        point = trim_gas_generator(
            gg, {"PW": law, other: reference[other]}, theta=WORN, **CRUISE
        )  # fmt: skip
        assert point["PW"] == pytest.approx(law.PW_ref * (point["N"] / law.N_ref) ** 3, rel=1e-9)
        assert point["N"] == pytest.approx(reference["N"], rel=1e-7)
    part = trim_gas_generator(gg, {"PW": LoadLaw(5e5, N_DESIGN), "Wf": 0.045})
    assert part["PW"] == pytest.approx(5e5 * (part["N"] / N_DESIGN) ** 3, rel=1e-9)
    assert part["N"] < N_DESIGN
    with pytest.raises(SignalError, match="load law needs finite"):
        LoadLaw(5e5, 0.0)
    with pytest.raises(SignalError, match="a load law fixes PW, not Wf"):
        trim_gas_generator(gg, {"Wf": LoadLaw(5e5, N_DESIGN), "N": N_DESIGN})


def test_maximum_power_is_at_the_limit_and_higher_is_refused(gg):
    """The lower of two limits counts; one kilowatt more breaks it."""
    top = maximum_power(gg, T5_max=760.0, dT_isa=15.0)
    assert top["T5"] == pytest.approx(760.0, rel=1e-10)
    both = maximum_power(gg, T4_max=1250.0, T5_max=760.0, dT_isa=15.0)
    assert both["PW"] <= top["PW"] * (1 + 1e-12) and both["T4"] <= 1250.0 + 1e-6
    with pytest.raises(Refusal, match=r"temperature limit: T5 = 76\d\.\d K, limit 760 K"):
        trim_gas_generator(
            gg, {"N": N_DESIGN, "PW": top["PW"] + 1e3}, dT_isa=15.0, limits=Limits(T5_max=760.0)
        )
    with pytest.raises(SignalError, match="T4_max or T5_max"):
        maximum_power(gg)


REFUSED = {
    "temperature": (
        {"N": N_DESIGN, "PW": 700e3}, {}, Status.TEMPERATURE, r"T4 = 1\d{3}\.\d K, limit 1320",
    ),
    "surge": ({"N": 0.8 * N_DESIGN, "PW": 4e5}, {}, Status.SURGE, r"beyond surge: SM = -0\.\d+"),
    "speed off the table": (
        {"N": 1.5 * N_DESIGN, "PW": 3e5}, {}, Status.OFF_MAP,
        r"off the compressor map by 0\.\d+ table spans, limit 0.25 \(relative corrected speed 1\.5",
    ),
    "cold and high": (
        {"N": N_DESIGN, "PW": 2e3}, {"altitude": 14e3, "dT_isa": -45.0}, Status.OFF_MAP,
        r"off the compressor map by .* table 0\.400 to 1\.100",
    ),
    "power that the fuel cannot give": (
        {"PW": 3e5, "Wf": 0.02}, {}, Status.NO_BALANCE,
        r"no power balance.*stopped at \d+\.\d % of the way .* best point N = ",
    ),
    "driven": ({"N": N_DESIGN, "PW": -4e5}, {}, Status.OFF_MAP, r"needs no fuel: Wf = "),
    "altitude": (
        {"N": N_DESIGN, "PW": 3e5}, {"altitude": 2e4}, Status.INPUT,
        r"altitude = 20000 m is outside \[-1000, 15000\]",
    ),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("case", list(REFUSED))
def test_refusals_name_reason_number_and_limit(gg, case):
    """Each is an OperatingPointError with status and best point; a batch has the same status."""
    fixed, ambient, status, words = REFUSED[case]
    with pytest.raises(OperatingPointError, match=words) as caught:
        trim_gas_generator(gg, fixed, **ambient)
    assert caught.value.status == status
    point = caught.value.point
    if point is not None:
        assert point.residual < 1e-9 and (caught.value.reached == 1.0) == (
            abs(point["N"] / fixed.get("N", point["N"]) - 1) < 1e-9
            and abs(point["PW"] / fixed["PW"] - 1) < 1e-9
        )
    batch = trim_batch(gg, fixed, **ambient)
    assert len(batch) == 1 and batch.status[0] == status
    assert batch.reason(0) and np.isnan(batch["T4"]).all()
    copy = pickle.loads(pickle.dumps(caught.value))
    assert str(copy) == str(caught.value) and copy.status == status


@pytest.mark.parametrize(
    ("fixed", "words"),
    [
        ({"N": 3775.0}, "needs two fixed quantities, got 1"),
        ({"N": 3775.0, "PW": 1e5, "T4": 1e3}, "got 3"),
        ({"N": 3775.0, "t4": 1e3}, r"unknown signal 't4' \(did you mean 'T4'\?\)"),
        ({"N": 3775.0, "T1": 300.0}, "T1 cannot be fixed: the ambient"),
        ({"N": 3775.0, "n_c": 1.01}, "N and n_c do not determine a point together"),
        ({"T5": 700.0, "T8": 710.0}, "T5 and T8 do not determine"),
        ({"N": 3775.0, "PW": float("nan")}, "must be finite"),
        ({"N": 3775.0, "PW": np.ones(3)}, "must be numbers"),
    ],
)
def test_wrong_questions_are_refused_as_such(gg, fixed, words):
    """A SignalError, not an operating point that cannot be found."""
    with pytest.raises(SignalError, match=words):
        trim_gas_generator(gg, fixed)


def test_limits_can_be_moved_and_removed(gg):
    """A limit refuses; without it the same point is returned, solved as well as any."""
    fixed = {"N": N_DESIGN, "PW": 700e3}
    with pytest.raises(Refusal) as caught:
        trim_gas_generator(gg, fixed)
    free = trim_gas_generator(gg, fixed, limits=Limits.none())
    assert free["T4"] == caught.value.point["T4"] > 1320.0
    with pytest.raises(Refusal, match=r"beyond surge: SM = 0\.2"):
        trim_gas_generator(gg, {"N": N_DESIGN, "PW": 5e5}, limits=Limits(SM_min=0.3))


@pytest.fixture(scope="module")
def envelope(gg):
    """A few hundred random points of the envelope, solved cold; more in ``apu study trim``."""
    asked = trim_study.sample(gg, 400, seed=7)
    return asked, trim_batch(gg, **asked)


def test_random_points_are_solved_or_refused_with_a_reason(gg, envelope):
    """None wrong by the plain model in the virtual machine, none unexplained; most solved."""
    _, batch = envelope
    solved = batch.ok
    assert solved.mean() > 0.85
    assert trim_study.recheck(gg, batch)[solved].max() < 1e-9
    assert (batch.status != Status.UNEXPLAINED).all()
    assert all(batch.reason(i) for i in np.flatnonzero(~solved))
    assert all(batch.reason(i) == "" for i in np.flatnonzero(solved))
    assert sum(batch.counts().values()) == len(batch) == 400
    assert set(batch.counts()) == set(MEANING.values())


def test_cold_starts_take_few_steps(envelope):
    """The first guess is good: measured 4.7 steps on average, and no solved point needs another."""
    _, batch = envelope
    steps = batch.iterations[batch.ok]
    assert steps.mean() < 6 and (steps > 0).mean() > 0.99


def test_batch_equals_single(gg, envelope):
    """Same status and the same numbers, point by point; a chunk knows nothing of its neighbours."""
    asked, batch = envelope
    for i in range(0, 400, 10):
        ambient = {k: asked[k][i] for k in ("altitude", "Mach", "dT_isa")}
        theta = {k: v[i] for k, v in asked["theta"].items()}
        fixed = {"N": asked["fixed"]["N"], "PW": asked["fixed"]["PW"][i]}
        try:
            point = trim_gas_generator(gg, fixed, theta=theta, **ambient)
        except Refusal as e:
            assert e.status == batch.status[i]
            continue
        assert batch.ok[i]
        for n in ("T4", "Wf", "SM"):
            assert batch[n][i] == pytest.approx(point[n], rel=1e-9)


def test_batch_in_chunks_equals_batch_at_once(gg, monkeypatch, envelope):
    """Chunks bound the memory and change nothing."""
    asked, batch = envelope
    monkeypatch.setattr("apu_casadi.gaspath.steady.trimbatch.CHUNK", 77)
    again = trim_batch(gg, outputs=("T4", "SM"), **asked)
    assert again.names == ("T4", "SM")
    np.testing.assert_array_equal(again.status, batch.status)
    np.testing.assert_allclose(again["T4"], batch["T4"], rtol=1e-12)
    with pytest.raises(SignalError, match=r"'T5' was not kept"):
        _ = again["T5"]


@pytest.mark.long
@needs_compiler
def test_c_equals_vm(gg, envelope):
    """The generated C and CasADi's virtual machine: the same points to rounding."""
    asked, _ = envelope
    with backend.use_backend("vm"):
        slow = trim_batch(gg, **asked)
        point = trim_gas_generator(gg, {"N": N_DESIGN, "PW": 222e3}, **CRUISE)
    with backend.use_backend("c"):
        batch = trim_batch(gg, **asked)
        fast = trim_batch(gg, {"N": N_DESIGN, "PW": np.full(500, 222e3)}, **CRUISE)
    np.testing.assert_array_equal(slow.status, batch.status)
    np.testing.assert_allclose(slow["T4"], batch["T4"], rtol=1e-9)
    np.testing.assert_allclose(fast["T4"], point["T4"], rtol=1e-12)


def test_bad_points_do_not_disturb_a_batch(gg):
    """Not a number, or out of range: flagged with the reason, and the neighbours are solved."""
    batch = trim_batch(
        gg, {"N": N_DESIGN, "PW": [3e5, np.nan, 3e5, 3e5]}, altitude=[0.0, 0.0, 3e4, 0.0]
    )
    assert batch.status.tolist() == [Status.SOLVED, Status.INPUT, Status.INPUT, Status.SOLVED]
    assert batch.reason(1) == "a fixed value is not finite"
    assert batch.reason(2) == "altitude = 30000 m is outside [-1000, 15000]"
    assert batch["T4"][0] == batch["T4"][3]
    with pytest.raises(SignalError, match=r"unknown Altitude \(did you mean 'altitude'\?\)"):
        trim_batch(gg, {"N": N_DESIGN, "PW": 3e5}, Altitude=0.0)
    with pytest.raises(SignalError, match="batch of N, PW"):
        trim_batch(gg, {"N": N_DESIGN, "PW": np.ones(3)}, altitude=np.zeros(4))


def test_batch_broadcasts_and_becomes_a_dataset(gg):
    """Arrays of several dimensions keep their shape; the dataset carries units and meanings."""
    batch = trim_batch(
        gg, {"N": N_DESIGN, "PW": np.array([[2e5], [3e5]])}, dT_isa=np.array([-10.0, 0.0, 10.0])
    )
    assert batch["T4"].shape == (2, 3) and np.all(np.diff(batch["T4"], axis=0) > 0)
    ds = batch.to_dataset()
    assert ds["T4"].dims == ("d0", "d1") and ds["T4"].attrs["units"] == "K"
    assert "beyond_surge" in ds["status"].attrs["flag_meanings"]
    assert float(ds["trim_residual"].max()) < 1e-9


def test_deck_is_a_grid_of_single_points(gg):
    """Axes by name; what cannot be had is NaN with its status."""
    deck = performance_deck(
        gg, altitude=[0.0, 6000.0], Mach=[0.0, 0.5], dT_isa=[0.0], PW=[1e5, 3e5, 9e5]
    )
    assert dict(deck.sizes) == {"altitude": 2, "Mach": 2, "dT_isa": 1, "PW": 3}
    there = deck.sel(altitude=6000.0, Mach=0.5, dT_isa=0.0, PW=1e5)
    point = trim_gas_generator(
        gg, {"N": N_DESIGN, "PW": 1e5}, altitude=6000.0, Mach=0.5, dT_isa=0.0
    )
    assert float(there["Wf"]) == pytest.approx(point["Wf"], rel=1e-9)
    lost = deck.sel(PW=9e5)
    assert np.isnan(lost["Wf"]).all() and (lost["status"] == Status.TEMPERATURE).any()


def test_threads_may_share_the_solver(gg):
    """The buffers belong to the solver; a lock guards them."""
    want = {p: trim_gas_generator(gg, {"N": N_DESIGN, "PW": p})["T4"] for p in (1e5, 2e5, 3e5)}
    wrong = []

    def work(power):
        for _ in range(50):
            got = trim_gas_generator(gg, {"N": N_DESIGN, "PW": power})["T4"]
            if got != want[power]:
                wrong.append((power, got))

    threads = [threading.Thread(target=work, args=(p,)) for p in want]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert not wrong


@pytest.mark.parametrize("spec", [("N", "PW"), ("T4", "Wf"), ("N", "SM"), (LAW, "Wf")])
def test_kernel_jacobian_is_the_derivative_of_its_residual(gg, spec):
    """Differences of the residual along random directions, at a point that is no solution."""
    k, c = TrimKernel(gg.family.cycle, spec), gg.numbers
    values = {"N": [N_DESIGN], "PW": [4e5], "T4": [1150.0], "Wf": [0.045], "SM": [0.3]}
    values[LAW] = [4e5, 3500.0, 2.5]
    at = np.array(
        [2000.0, 0.3, 5.0, 0.0, 0.98, 1.0, 1.01, 1.0, *(v for n in spec for v in values[n])]
    )
    s0 = k.design_start(c) + 0.01
    J = k.equations(s0, at, c)[1].full()
    rng = np.random.default_rng(3)
    for _ in range(4):
        d, h = rng.normal(size=s0.size), 1e-5
        ahead, behind = (k.equations(s0 + sign * h * d, at, c)[0] for sign in (1, -1))
        slope = (ahead - behind).full().ravel() / (2 * h)
        np.testing.assert_allclose(J @ d, slope, rtol=1e-6, atol=1e-7)


def test_the_map_tables_are_part_of_the_recipe(gg):
    """Another engine must not be given this one's library: the digest tells maps apart."""
    import dataclasses

    from apu_casadi.gaspath.steady.trimsolver import table_digest

    table = gg.compressor_map.table
    other = dataclasses.replace(table, eta=table.eta * 0.99)
    assert table_digest(other) != table_digest(table)
    assert table_digest(GasGenerator().compressor_map.table) == table_digest(table)


TWO = [{"PW": 480e3, "Wf": 0.0483}, {"PW": 490e3, "T4": 1200.0}]


@pytest.mark.parametrize("fixed", TWO)
def test_two_steady_points_are_told_and_the_designs_side_counts(gg, fixed):
    """Shaft power over speed has a maximum, scanned here with the speed fixed: the two speeds of
    equal power are the two answers, and the first is on the design speed's side of the maximum.
    """
    held = next(n for n in fixed if n != "PW")
    N = gg.parameters.N * np.linspace(0.8, 1.26, 93)
    scan = trim_batch(gg, {"N": N, held: fixed[held]}, dT_isa=5.0)
    gap = np.where(scan.ok, scan["PW"], np.nan) - fixed["PW"]
    crossings = N[:-1][gap[:-1] * gap[1:] < 0]
    point = trim_gas_generator(gg, fixed, dT_isa=5.0)
    assert crossings.size == 2 and point.second is not None
    speeds = sorted((point["N"], point.second["N"]))
    assert_allclose(speeds, crossings + 0.5 * (N[1] - N[0]), atol=0.6 * (N[1] - N[0]))
    top = N[np.nanargmax(gap)]
    d = trim_batch(
        gg, {"N": gg.parameters.N * np.array([0.999, 1.001]), held: gg.design.values.get(held)},
        dT_isa=5.0,
    )  # fmt: skip
    design_rises = d["PW"][1] > d["PW"][0]
    assert (point["N"] < top) == design_rises
    for q in (point, point.second):
        assert q.residual < 1e-9
        for name, value in fixed.items():
            assert q[name] == pytest.approx(value, rel=1e-9)
    batch = trim_batch(gg, {k: np.full(3, v) for k, v in fixed.items()}, dT_isa=5.0)
    assert_allclose(batch["N"], point["N"], rtol=1e-9)
    assert_allclose(batch.N_second, point.second["N"], rtol=1e-9)
    assert_allclose(batch.to_dataset()["N_second"], point.second["N"], rtol=1e-9)


def test_the_second_point_counts_where_the_first_is_beyond_a_limit(gg):
    """A least margin that only one of two points keeps, then one that none of two keeps."""
    fixed = {"PW": 480e3, "Wf": 0.0483}
    both = trim_gas_generator(gg, fixed, dT_isa=5.0)
    assert both.second is not None and both["SM"] > both.second["SM"]
    limits = Limits(SM_min=both["SM"] + 1e-3)
    with pytest.raises(Refusal, match="beyond surge"):
        trim_gas_generator(gg, fixed, dT_isa=5.0, limits=limits)
    hot = trim_gas_generator(gg, {"PW": 490e3, "T4": 1200.0}, dT_isa=5.0)
    assert hot.second is not None and hot.second["SM"] > hot["SM"]
    wide = Limits(SM_min=hot["SM"] + 1e-3)
    only = trim_gas_generator(gg, {"PW": 490e3, "T4": 1200.0}, dT_isa=5.0, limits=wide)
    assert only["N"] == pytest.approx(hot.second["N"], rel=1e-9) and only.second is None


@pytest.mark.long
def test_multiple_starts_give_one_point_or_the_answer_tells_of_two(gg):
    """100 points for each pair from six starts around the root, over health, ambient and speed.

    With N fixed there is one root: before the outermost speed line kept its shape, 1 to 2 % of
    these had two.
    """
    n, rng = 100, np.random.default_rng(7)
    ambient = {"altitude": rng.uniform(0, 9e3, n), "dT_isa": rng.uniform(-60, -20, n)}
    theta = {k: rng.uniform(0.85, 1.1, n) for k in gg.THETA.names}
    PW, N = rng.uniform(0, 3e5, n), N_DESIGN * rng.uniform(0.93, 1.04, n)
    for fixed in (
        {"N": N, "PW": PW}, {"N": N, "Wf": rng.uniform(0.01, 0.04, n)},
        {"N": N, "T5": rng.uniform(450, 900, n)}, {"PW": PW, "Wf": rng.uniform(0.015, 0.04, n)},
    ):  # fmt: skip
        batch = trim_batch(gg, fixed, theta=theta, **ambient)
        spec, _, _ = specify(gg, fixed)
        solver = solver_of(gg, spec)
        at = np.flatnonzero(batch.ok)
        assert at.size > 10
        p, s = batch.p[:, at], solver.sought(batch.w[:, at])
        speed = len(gg.z)
        for trial in range(6):
            start = s + rng.normal(0, 0.05 * (1 + trial), s.shape)
            w, y, r, _, _ = solver.many("warm", start, p, n_threads=1, compile=False)
            good = (norms(r) < 1e-9) & (limit_status(gg, Limits(), y) == Status.SOLVED)
            same = np.abs(y[gg.Y.index("T4")] / batch.y[gg.Y.index("T4"), at] - 1) < 1e-6
            told = np.abs(w[speed] / batch.N_second[at] - 1) < 1e-6
            assert np.all(~good | same | told), fixed


@pytest.mark.parametrize(
    ("N", "P3", "ambient", "health"),
    [
        (3350.677558, 736038.0158, (2830.130175, 0.6842347951, -31.97273157, 0.0),
         (0.8901993396, 1.0818551427, 1.0471951976, 0.9366392366)),
        (3482.645343, 634070.5808, (3242.741280, 0.8498429929, 15.54089503, 0.0),
         (1.0165626904, 1.0068769105, 0.8998637637, 0.8806726125)),
        (3775.147172, 737225.2348, (1100.928124, 0.0274476564, 34.27994341, 0.0312759814),
         (0.9884228667, 1.0979316490, 0.8899573487, 0.9158323335)),
    ],
)  # fmt: skip
def test_a_pressure_beyond_the_top_of_a_speed_line_is_no_balance(gg, N, P3, ambient, health):
    """Three of 100 000 random points ended as "not converged": at the highest P3 of the speed line.

    The scan over T4 at the place where the way ended shows the maximum; no other equation is asked.
    """
    names = ("altitude", "Mach", "dT_isa", "war")
    given, theta = (
        dict(zip(names, ambient, strict=True)),
        dict(zip(gg.THETA.names, health, strict=True)),
    )
    with pytest.raises(Refusal, match="an extreme value near the best point") as e:
        trim_gas_generator(gg, {"N": N, "P3": P3}, theta=theta, **given)
    assert e.value.status == Status.NO_BALANCE
    assert trim_batch(gg, {"N": N, "P3": P3}, theta=theta, **given).status[0] == Status.NO_BALANCE
    end = e.value.point
    factors = np.linspace(0.95, 1.05, 41)
    scan = trim_batch(
        gg, {"N": end["N"], "T4": factors * end["T4"]},
        theta=dict(zip(gg.THETA.names, end.theta, strict=True)), limits=Limits.none(),
        **dict(zip(names, end.u[2:], strict=True)),
    )  # fmt: skip
    assert abs(np.nanargmax(scan["P3"]) - 20) <= 1
