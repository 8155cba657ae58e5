"""Profiles of time: their values, jumps and bends, files, and what is made of them."""

import math
import pickle
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ApuError, DataError, ScenarioError, SignalError
from apu_casadi.core.profiles.points import Points, Steps
from apu_casadi.core.profiles.profile import (
    PROFILES,
    Moved,
    Varying,
    at,
    later,
    profile_from_table,
    varying,
)
from apu_casadi.core.profiles.shapes import Growth, OnOff, Ramp
from apu_casadi.machine.faults.fieldshort import FieldShort
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.events import Ambient
from scenarios.reading import read_fault, read_load

GOING = {"from": 1, "to": 200, "over": 9}
GROWING = {"kind": "exponential", "from": 1e-5, "to": 0.05, "over": 9}
EACH = [
    Ramp(1.0, 0.97, over=60.0, after=2.0),
    Growth(1e-5, 0.05, over=10.0),
    OnOff(0.05, 0.0, 5.0, duty=0.3, after=0.05),
    Steps((0.0, 2.0, 6.0), (225.0, 100.0, 50.0)),
    Points((0.0, 1.0, 1.0, 3.0), (0.0, 2.0, 5.0, 4.0)),
]


def test_values_are_those_of_the_formula():
    """By hand; constant before the beginning and after the end."""
    assert [Ramp(1.0, 3.0, over=4.0, after=1.0)(t) for t in (0, 1, 2, 5, 9)] == [1, 1, 1.5, 3, 3]
    growth = Growth(1e-4, 1e-2, over=10.0)
    assert_allclose(growth(np.array([0.0, 5.0, 10.0, 20.0])), [1e-4, 1e-3, 1e-2, 1e-2], rtol=1e-14)
    wave = OnOff(2.0, 1.0, 5.0, duty=0.25)
    assert [wave(t) for t in (0.0, 0.049, 0.051, 0.199, 0.2, 0.251)] == [2, 2, 1, 1, 2, 1]
    assert OnOff(2.0, 1.0, 5.0, after=1.0)(0.5) == 1.0
    assert [Steps((0.0, 2.0), (7.0, 8.0))(t) for t in (-1.0, 1.999, 2.0, 99.0)] == [7, 7, 8, 8]
    jump = Points((0.0, 1.0, 1.0, 3.0), (0.0, 2.0, 5.0, 4.0))
    assert [jump(t) for t in (-1.0, 0.5, 1.0, 2.0, 9.0)] == [0.0, 1.0, 5.0, 4.5, 4.0]


@pytest.mark.parametrize("p", EACH, ids=lambda p: p.word)
def test_every_jump_and_bend_is_told(p):
    """Between neighbouring instants the values move little; bounds hold and are reached."""
    T = 12.0
    t = np.linspace(0.0, T, 40001)
    jumped = t[1:][np.abs(np.diff(p(t))) > 0.02 * np.ptp(p.bounds)]
    told = np.array(p.instants(T))
    assert told.size == np.unique(np.round(jumped, 3)).size
    assert all(np.abs(told - x).min() < 1e-3 for x in jumped)
    assert set(p.instants(T)) <= set(p.corners(T))
    assert all(0 < x < T for x in p.corners(T))
    low, high = p.bounds
    wide = np.linspace(0.0, 100.0, 20001)
    assert p(wide).min() == pytest.approx(low) and p(wide).max() == pytest.approx(high)
    assert p(t).shape == t.shape and isinstance(p(1.0), float)
    bends = [0.0, *p.corners(T), T]
    for a, b in pairwise(bends):  # smooth in between: no second difference
        inside = p(np.linspace(a + 1e-6, b - 1e-6, 201))
        assert np.abs(np.diff(inside, 3)).max() <= 1e-3 * max(np.ptp(inside), 1e-12) + 1e-12


@pytest.mark.parametrize("p", EACH, ids=lambda p: p.word)
def test_tables_of_files_and_copies(p):
    """What is written is read as the same, with and without its kind where the keys tell it."""
    table = p.to_table()
    assert profile_from_table(table, "x") == p
    if p.word not in ("steps", "exponential"):  # as other keys tell a table and a ramp
        assert profile_from_table({k: v for k, v in table.items() if k != "kind"}, "x") == p
    assert pickle.loads(pickle.dumps(p)) == p and hash(p) == hash(profile_from_table(table, "x"))
    assert p.word in p.label
    assert set(PROFILES) >= {p.word}


def test_time_begins_where_it_is_given():
    p = later(Ramp(1.0, 3.0, over=4.0), 10.0)
    assert p(12.0) == 2.0 and p.corners(20.0) == (10.0, 14.0)
    assert later(OnOff(1.0, 0.0, 1.0), 0.25).instants(1.6) == (0.25, 0.75, 1.25)[1:]
    assert later(3.0, 5.0) == 3.0 and at(3.0, 5.0) == 3.0
    rpm = Moved(Steps((0.0, 2.0), (300.0, 600.0)), factor=math.pi / 30.0)
    assert rpm(3.0) == pytest.approx(20.0 * math.pi) and rpm.instants(9.0) == (2.0,)


def test_a_file_gives_a_column(tmp_path):
    """Comments, empty lines and spaces count for nothing; two rows of one time are a jump."""
    path = tmp_path / "climb.csv"
    path.write_text("# a climb\ntime, altitude ,Mach\n\n0,0,0.2\n600,6000,0.45\n600,6100,0.45\n")
    p = profile_from_table({"file": "climb.csv"}, "altitude", tmp_path)
    assert p == Points((0.0, 600.0, 600.0), (0.0, 6000.0, 6100.0))
    assert p.instants(1e3) == (600.0,) and "climb.csv, altitude" in p.label
    steps = profile_from_table(
        {"kind": "steps", "file": str(path), "column": "Mach", "time": "time"}, "altitude"
    )
    assert steps(599.0) == 0.2
    assert profile_from_table(p.to_table(), "altitude") == p


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "climb.csv: empty"),
        ("time,altitude\n", "climb.csv: no rows: names time and altitude, then numbers"),
        ("time,height\n0,1\n", "no column 'altitude' (valid: time, height)"),
        ("time,Altitude\n0,1\n", "no column 'altitude' (did you mean 'Altitude'?)"),
        ("t,altitude\n0,1\n", "no column 'time'"),
        ("time,altitude [ft]\n0,1\n", "column altitude has a unit, ft; profiles are in the unit"),
        ("time,altitude\n0,1\n1,\n", "line 3, column altitude: no number stands there: comp"),
        ('time,altitude\n0,"1,500"\n', "'1,500' in column altitude may have a decimal comma or"),
        (
            "time,altitude\n2024-01-01T00:00:00Z,1\n",
            "line 2, column time: '2024-01-01T00:00:00Z' is no number: numbers are expected, not",
        ),
        ("time,altitude,altitude\n0,1,2\n", "column 'altitude' stands 2 times"),
        ("time,altitude\n0,1\n1,x\n", "line 3, column altitude: 'x' is no number: correct it"),
        ("time,altitude\n0,1\n1,nan\n", "line 3, column altitude: no number stands there"),
        ("time,altitude\n\n0,1\n1\n", "line 4: 1 cells, but 2 columns are named"),
        ('time,altitude\n0,"' + 200_000 * "1", "line 2: no CSV file: field larger"),
        ("time,altitude\n-5,1\n0,2\n", "line 2, column time: -5 s is before the profile begins"),
        ("time,altitude\n0,1\n1,2\n1,3\n1,4\n", "line 5, column time: 1 s stands there three"),
        ("time,altitude\n1,1\n0,2\n", "line 3, column time: 0 s is before 1 s in the row before"),
    ],
)
def test_wrong_files_are_refused_with_row_and_column(tmp_path, text, message):
    path = tmp_path / "climb.csv"
    path.write_text(text)
    with pytest.raises(DataError) as e:
        profile_from_table({"file": str(path)}, "altitude")
    assert message in str(e.value) and "climb.csv" in str(e.value)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_files_as_spreadsheets_save_them(tmp_path, encoding):
    path = tmp_path / "climb.csv"
    path.write_bytes("time,altitude,Höhe\r\n0,1,hoch\r\n2,3.5,über\r\n".encode(encoding))
    assert profile_from_table({"file": str(path)}, "altitude").points == (1.0, 3.5)
    path.write_bytes("time,altitude".encode("utf-16") + b"x")
    with pytest.raises(DataError, match="damaged UTF-16 text"):
        profile_from_table({"file": str(path)}, "altitude")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "kind: missing, and the keys tell no profile"),
        ({"from": 1, "too": 2, "over": 3}, "too: unknown key of a profile (did you mean 'to'?)"),
        ({"kind": "rampe"}, "kind: unknown profile 'rampe' (did you mean 'ramp'?)"),
        ({"kind": "ramp", "from": 1, "to": 2}, "over: missing: a 'ramp' profile needs it"),
        ({"from": 1, "to": 2, "over": 0}, "over: must be > 0 s, got 0"),
        ({"from": 1, "to": "2", "over": 1}, "to: a number is expected, got '2'"),
        ({"kind": "exponential", "from": 0, "to": 2, "over": 1}, "from: exponential growth from 0"),
        ({"on": 1, "off": 0, "frequency": 5, "duty": 1}, "duty: must lie in [0.001, 0.999], got 1"),
        ({"on": 1, "off": 0, "frequency": 0}, "frequency: must lie in (0, 1000] Hz, got 0"),
        ({"times": [0, 1], "values": [1]}, "values: 1 for 2 times; one for each is expected"),
        ({"times": [-1, 0], "values": [1, 2]}, "times[1]: -1 s is before the profile begins"),
        ({"times": [1, 1, 1], "values": [1, 2, 3]}, "times[3]: 1 s stands there three times"),
        ({"times": [1, 0], "values": [1, 2]}, "times[2]: 0 s is before 1 s; times go on"),
        ({"times": 1, "values": [1]}, "times: a list of numbers is expected, got 1"),
        ({"times": [0, "a"], "values": [1, 2]}, "times[2]: a number is expected, got 'a'"),
        ({"kind": "steps", "times": [0]}, "values: missing: a 'steps' profile needs it"),
        ({"file": "x.csv", "colum": "y"}, "colum: unknown key (did you mean 'column'?)"),
        ({"file": 3}, "file: a text is expected, got 3"),
    ],
)
def test_wrong_tables_are_refused(table, message):
    with pytest.raises(ScenarioError) as e:
        profile_from_table(table, "x")
    assert str(e.value).startswith(message)


def test_a_square_wave_of_too_many_jumps_is_refused():
    with pytest.raises(ScenarioError, match="frequency: 1000 Hz jumps 7200000 times in 3600 s"):
        OnOff(1.0, 0.0, 1000.0).instants(3600.0)


def test_objects_of_profiles():
    """Numbers of loads, faults and days; a severity of a healthy machine is no fault."""
    load = varying(SeriesLoad.from_power, Ramp(100e3, 200e3, over=60.0), power_factor=0.85)
    assert load.at(30.0) == SeriesLoad.from_power(150e3, 0.85)
    assert load.profiles == {"P": Ramp(100e3, 200e3, over=60.0)} and load.corners(99.0) == (60.0,)
    fault = varying(Ttsc, OnOff(0.05, 0.0, 5.0), 20.0)
    assert fault.at(0.05) == Ttsc(0.05, 20.0) and fault.at(0.15) is None
    assert fault.example() == Ttsc(0.05, 20.0)
    assert varying(FieldShort, Ramp(0.0, 0.1, over=1.0)).at(0.0) is None
    grown = varying(Ttsc.of_h, 0.05, Growth(1e-5, 0.01, over=5.0))
    assert grown.at(5.0).h == pytest.approx(0.01, rel=1e-14)
    assert varying(Ambient, altitude=Ramp(0.0, 11e3, over=1800.0)).at(900.0).altitude == 5500.0
    for x in (load, fault, grown):
        assert pickle.loads(pickle.dumps(x)) == x and hash(x) == hash(pickle.loads(pickle.dumps(x)))
        assert later(x, 1.0).at(3.0) == x.at(2.0)
    with pytest.raises(ScenarioError, match=r"altitude: must lie in \[-1000, 15000\] m, got 20000"):
        varying(Ambient, altitude=Ramp(0.0, 20e3, over=1800.0))
    with pytest.raises(TypeError, match="missing a required argument"):
        varying(Ttsc, mu=Ramp(0.01, 0.05, over=1.0))


def test_h_in_place_of_k_rf():
    """h = mu/(k_rf + 1 - mu), solved for k_rf, and its range."""
    fault = read_fault({"mu": 0.05, "h": 0.002, "phase": "b"})
    assert fault == Ttsc.of_h(0.05, 0.002, phase="b") and fault.h == pytest.approx(0.002, rel=1e-14)
    assert Ttsc.of_h(0.05, 0.05 / 0.95).k_rf == 0.0
    for table, message in (
        ({"mu": 0.05, "h": 0.06}, "fault.h: 0.06 is outside (0, 0.0526316]: with mu = 0.05"),
        ({"mu": 0.05, "h": 0.01, "k_rf": 1}, "fault.h: stands in place of k_rf; give one of them"),
        ({"mu": 0.05, "h": "x"}, "fault.h: a number is expected, got 'x'"),
        ({"h": 0.01}, "fault.mu: missing: mu and k_rf are both needed"),
    ):
        with pytest.raises(ScenarioError) as e:
            read_fault(table)
        assert str(e.value).startswith(message)


@pytest.mark.parametrize(
    ("read", "table"),
    [
        (read_load, {"kind": "RL", "power_kW": GOING, "unbalance": [1, 2, 1]}),
        (read_load, {"kind": "series", "R_ohm": GOING, "L_mH": 0.1}),
        (read_fault, {"mu": 0.05, "h": GROWING}),
        (read_fault, {"kind": "field", "mu_f": {"on": 0.1, "off": 0, "frequency": 5}}),
    ],
)  # fmt: skip
def test_parts_of_a_file_change_in_time(read, table):
    """What is read is written as the same."""
    made = read(table)
    assert isinstance(made, Varying) and read(made.to_table()) == made
    assert made.at(4.5) != made.at(4.6)


@pytest.mark.parametrize(
    ("read", "table", "message"),
    [
        (read_load, {"kind": "R", "power_kW": {"from": 100, "to": 900, "over": 60}},
         "load.power_kW: must lie in [0.1, 500] kW, got 900"),
        (read_load, {"kind": "R", "power_kW": {"from": 100, "to": "x", "over": 60}},
         "load.power_kW.to: a number is expected, got 'x'"),
        (read_load, {"kind": "R", "power_kW": {"file": "none.csv"}},
         "load.power_kW: none.csv: profile cannot be read: No such file"),
        (read_fault, {"mu": {"from": 0, "to": 1.2, "over": 3}, "k_rf": 2},
         "fault.mu: must lie in (0, 0.99], got 1.2"),
        (read_fault, {"mu": 0.05, "h": {"from": 1e-5, "to": 0.06, "over": 1}},
         "fault.h: 0.06 is outside (0, 0.0526316]"),
    ],
)  # fmt: skip
def test_values_out_of_range_are_refused_before_the_run(read, table, message):
    with pytest.raises(ApuError) as e:
        read(table)
    assert str(e.value).startswith(message)


def test_the_gas_generator_follows_profiles():
    """Named inputs and factors held at mid-step equal the columns; against scipy, second order.

    The model's own rate f, integrated by Radau, with altitude, fuel and health on their way.  The
    discrete step holds the inputs and is implicit: at half the step the error is a quarter.
    """
    from scipy.integrate import solve_ivp

    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.gaspath.steady.trimming import initialise

    gg = GasGenerator()
    start = initialise(gg, N=gg.parameters.N, PW=200e3)
    inputs = {
        "altitude": Ramp(0.0, 200.0, over=1.0),
        "Wf": Ramp(start.u[0], 1.02 * start.u[0], over=1.0),
    }
    theta = {"f_eta_c": Ramp(1.0, 0.99, over=1.0)}

    def rate(t, x):
        u, th = start.u.copy(), start.theta.copy()
        u[gg.U.index("altitude")], u[0] = inputs["altitude"](t), inputs["Wf"](t)
        th[gg.THETA.index("f_eta_c")] = theta["f_eta_c"](t)
        z = gg.solve(start.z, x, u, th)
        return [float(gg.equations(x, z, u, th)[0])]

    exact = solve_ivp(rate, (0.0, 1.0), start.x, method="Radau", rtol=1e-9, atol=1e-7).y[0, -1]
    error = []
    for K in (25, 50):
        X, Y = gg.run(start, inputs, theta, steps=K, dt=0.02 * 50 / K)
        assert X.shape == (1, K + 1) and Y.shape[1] == K + 1
        error.append(abs(X[0, -1] - exact))
    t = 0.02 * (np.arange(50) + 0.5)
    u = np.repeat(start.u[:, None], 50, axis=1)
    u[gg.U.index("altitude")], u[0] = inputs["altitude"](t), inputs["Wf"](t)
    th = np.repeat(start.theta[:, None], 50, axis=1)
    th[0] = theta["f_eta_c"](t)
    assert np.array_equal(gg.run(start, u, th, dt=0.02)[0], X)
    moved = abs(X[0, -1] - X[0, 0])
    assert error[1] < 1e-4 * moved and error[1] == pytest.approx(error[0] / 4, rel=0.02)
    with pytest.raises(SignalError, match="altitud"):
        gg.run(start, {"altitud": 1.0}, steps=3)
