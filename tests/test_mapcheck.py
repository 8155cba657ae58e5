"""Plausibility of maps: wrong cells and lines are found and named, sound and noisy maps pass."""

import dataclasses

import numpy as np
import pytest

from apu_casadi.core.errors import MapError
from apu_casadi.gaspath.maps import mapcheck
from apu_casadi.gaspath.maps.mapfiles import read_map, shipped, write_map_csv
from apu_casadi.gaspath.maps.maptable import MapTable

MAPS = {n: shipped(n) for n in ("axi5", "lpt2269")}
COLUMNS = ("W", "PR", "eta")


def changed(t: MapTable, name: str, at, value, **more) -> MapTable:
    a = np.array(getattr(t, name))
    a[at] = value
    return dataclasses.replace(t, **{name: a}, **more)


def findings(t: MapTable, name: str, a: np.ndarray) -> list[mapcheck.Finding]:
    """What the check says with one array replaced, without the ranges of MapTable."""
    v = {n: getattr(t, n) for n in COLUMNS} | {name: a}
    surge = None if t.surge_W is None else (t.surge_W, t.surge_PR)
    return mapcheck.implausible(t.kind, t.N, t.beta, *v.values(), surge)


def sample(t: MapTable, count: int) -> list[tuple[int, int]]:
    """Some cells of a map, its corners included."""
    n, m = t.W.shape
    some = np.random.default_rng(3).permutation(n * m)[:count]
    return [divmod(int(c), m) for c in some] + [(0, 0), (0, m - 1), (n - 1, 0), (n - 1, m - 1)]


@pytest.mark.long
@pytest.mark.parametrize("name", list(MAPS))
@pytest.mark.parametrize("column", COLUMNS)
@pytest.mark.parametrize("factor", [1e300, 10.0, 2.0, 0.5])
def test_every_wrong_cell_is_found_and_named(name, column, factor):
    """What is expected is within 10 % of the true value, at corners too."""
    t = MAPS[name]
    for i, j in sample(t, 8):
        a = np.array(getattr(t, column))
        a[i, j] *= factor
        worst = findings(t, column, a)[0]
        assert (worst.name, worst.i, worst.j) == (column, i, j)
        if factor < 1e3:  # beyond, rounding leaves nothing of the difference
            assert worst.expected == pytest.approx(a[i, j] / factor, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("name", list(MAPS))
@pytest.mark.parametrize("factor", [1.2, 0.8])
def test_a_fifth_is_found_away_from_the_edges(name, factor):
    """20 % is five times what sound maps scatter at most; at edges a part of it may pass."""
    t = MAPS[name]
    n, m = t.W.shape
    for i, j in sample(t, 12):
        if 0 < i < n - 1 and 0 < j < m - 1:
            for column in COLUMNS:
                a = np.array(getattr(t, column))
                a[i, j] *= factor
                worst = findings(t, column, a)[0]
                assert (worst.name, worst.i, worst.j) == (column, i, j)


@pytest.mark.parametrize("name", list(MAPS))
def test_noisy_maps_pass(name):
    """A map is judged by its own noise: up to 10 % in every number, flow, PR - 1 and efficiency."""
    t, rng = MAPS[name], np.random.default_rng(4)
    for amplitude in (0.01, 0.03, 0.1):
        for _ in range(2):

            def noisy(v, amplitude=amplitude):
                return v * (1 + amplitude * rng.uniform(-1, 1, v.shape))

            surge = None if t.surge_W is None else (t.surge_W, 1 + noisy(t.surge_PR - 1))
            found = mapcheck.implausible(
                t.kind, t.N, t.beta, noisy(t.W), 1 + noisy(t.PR - 1),
                np.minimum(noisy(t.eta), 1), surge,
            )  # fmt: skip
            assert not found, (amplitude, found[0])


def test_swapped_lines_are_found():
    """Neighbouring speed lines of flow or pressure ratio, and the two first beta lines of one."""
    t = MAPS["axi5"]
    for column in ("W", "PR"):
        for i in range(0, t.N.size - 1, 2):
            a = np.array(getattr(t, column))
            a[[i, i + 1]] = a[[i + 1, i]]
            worst = findings(t, column, a)[0]
            assert worst.name == column and worst.i in (i - 1, i, i + 1, i + 2) and worst.j == -1
    eta = np.array(t.eta)
    eta[:, [6, 7]] = eta[:, [7, 6]]
    assert findings(t, "eta", eta)


@pytest.mark.long
@pytest.mark.parametrize("factor", [10.0, 1.5, 0.7])
def test_surge_points_are_found(factor):
    """Each point in turn; the ends have one neighbour only and are found from a factor of two."""
    t = MAPS["axi5"]
    for k in range(t.surge_W.size):
        PR = np.array(t.surge_PR)
        PR[k] = 1 + (PR[k] - 1) * factor
        if k in (0, t.surge_W.size - 1) and factor < 2:
            continue
        if abs(np.log(PR[k] / t.surge_PR[k])) < 0.15:  # PR near 1: little of PR itself
            continue
        with pytest.raises(MapError, match=r"surge point \d+ at W = .*PR_surge: .* is implausible"):
            dataclasses.replace(t, surge_PR=PR)


def test_a_file_names_line_column_and_expectation(tmp_path):
    """The message of a CSV file: line, column, place, value, what is expected, what to do."""
    t, path = MAPS["axi5"], tmp_path / "map.csv"
    bad = changed(t, "W", (4, 3), 10 * t.W[4, 3], check=False)
    write_map_csv(bad, path)
    line = next(
        k for k, s in enumerate(path.read_text().splitlines(), 1) if s.startswith("0.8,1.6,")
    )
    with pytest.raises(
        MapError,
        match=rf"map.csv, line {line}, column W, N = 0.8, beta = 1.6, W: 160.65 is implausible: "
        r"its neighbours say about 16\.\d+, off by .* correct the cell, or accept .* check=False",
    ):
        read_map(path)
    known = read_map(path, check=False)
    assert "accepted with check=False: " in known.source
    assert known.W[4, 3] == bad.W[4, 3]


def test_a_gasturb_file_names_section_and_line(tmp_path):
    """One efficiency of a text file halved."""
    t = MAPS["axi5"]

    def section(title, rows):
        code = len(rows) + len(rows[0]) / 1000
        body = [[code, *rows[0][1:]], *rows[1:]]
        return [title, *(" ".join(f"{v:.6f}" for v in row) for row in body)]

    def grid(title, a):
        return section(title, [[0, *t.beta], *([n, *r] for n, r in zip(t.N, a, strict=True))])

    eta = np.array(t.eta)
    eta[2, 5] /= 2
    lines = [
        "99 made", "Reynolds: RNI=1 f_RNI=1 RNI=2 f_RNI=1", *grid("Mass Flow", t.W),
        *grid("Efficiency", eta), *grid("Pressure Ratio", t.PR),
        *section("Surge Line", [[0, *t.surge_W], [0, *t.surge_PR]]),
    ]  # fmt: skip
    path = tmp_path / "map.txt"
    path.write_text("\n".join(lines))
    line = lines.index("Efficiency") + 1 + 1 + 3  # title, row of betas, third speed
    with pytest.raises(
        MapError, match=rf"line {line}, section 'Efficiency', N = 0.6, beta = 2, eta"
    ):
        read_map(path)
    assert read_map(path, check=False).eta[2, 5] == pytest.approx(eta[2, 5], abs=1e-6)


def test_a_strange_table_is_accepted_knowingly_only():
    """MapTable itself: refused by default, kept with check=False, also through replace."""
    t = MAPS["axi5"]
    with pytest.raises(MapError, match=r"N = 0.8, beta = 1.6, W: .* is implausible"):
        changed(t, "W", (4, 3), 2 * t.W[4, 3])
    strange = changed(t, "W", (4, 3), 2 * t.W[4, 3], check=False)
    assert dataclasses.replace(strange, name="again").W[4, 3] == 2 * t.W[4, 3]
    assert [(f.i, f.j) for f in strange.implausible()[:1]] == [(4, 3)]
