"""Map files: CSV and GasTurb/GSP layouts, round trip, failure messages, shipped maps."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from apu_casadi.core.errors import ApuWarning, DataError, MapError
from apu_casadi.gaspath.maps.gasturbmaps import read_map_gasturb
from apu_casadi.gaspath.maps.mapfiles import SHIPPED, read_map, read_map_csv, shipped, write_map_csv
from apu_casadi.gaspath.maps.maptable import MapTable

N = np.array([0.5, 0.7, 0.9, 1.0, 1.1])
BETA = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.2])
W = 10 * N[:, None] ** 2 * (1 - 0.1 * BETA)
PR = 1 + 3 * N[:, None] ** 2 * (1 + 0.2 * BETA)
ETA = 0.8 - 0.1 * (N[:, None] - 0.9) ** 2 - 0.05 * (BETA - 0.5) ** 2
SURGE_W, SURGE_PR = np.array([1.0, 3.0, 6.0, 8.0, 10.0]), np.array([1.2, 2.0, 3.0, 4.0, 5.0])
GRID = ("N", "beta", "W", "PR", "eta")


def made(**changes) -> MapTable:
    fields = dict(kind="compressor", N=N, beta=BETA, W=W, PR=PR, eta=ETA)
    fields |= dict(surge_W=SURGE_W, surge_PR=SURGE_PR, N_ref=1.0, beta_ref=0.5)
    return MapTable(**(fields | dict(name="made", source="made up, here") | changes))


def same(a: MapTable, b: MapTable, rtol: float = 0) -> None:
    assert a.kind == b.kind
    for name in (*GRID, "surge_W", "surge_PR"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            assert_allclose(x, y, rtol=rtol, err_msg=name)


def csv_lines() -> list[str]:
    out = ["# made up", "# kind: compressor", "N,beta,W,PR,eta"]  # lines 1 to 3, rows from 4
    for i, j in np.ndindex(W.shape):
        out.append(f"{N[i]},{BETA[j]},{W[i, j]:.6f},{PR[i, j]:.6f},{ETA[i, j]:.6f}")
    out.append("W_surge,PR_surge")  # line 34
    return out + [f"{w},{p}" for w, p in zip(SURGE_W, SURGE_PR, strict=True)]


def section(title: str, array: np.ndarray, per_line: int = 5) -> list[str]:
    """Write one GasTurb section: code, then row by row, wrapped."""
    a = np.array(array, dtype=float)
    a[0, 0] = a.shape[0] + a.shape[1] / 1000
    out = [title]
    for row in a:
        cells = [f"{v:12.8f}" for v in row]
        out += ["".join(cells[k : k + per_line]) for k in range(0, len(cells), per_line)]
    return [*out, ""]


def grid(values: np.ndarray) -> np.ndarray:
    return np.block([[np.zeros((1, 1)), BETA[None, :]], [N[:, None], values]])


def pair(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.array([[0.0, *x], [1.0, *y]])


def gasturb_compressor() -> list[str]:
    return [
        "99 Made-up compressor",
        "Reynolds: RNI=0.100 f=0.950 RNI=1.000 f=1.000",
        *section("Mass Flow", grid(W)),
        *section("Efficiency", grid(ETA)),
        *section("Pressure Ratio", grid(PR)),
        *section("Surge Line", pair(SURGE_W, SURGE_PR)),
    ]


def gasturb_turbine() -> list[str]:
    return [
        "99 ",
        "Reynolds: RNI=0.1 f=1 RNI=1 f=1",
        *section("Min Pressure Ratio", pair(N, 1.1 + 0.1 * N), per_line=10),
        *section("Max Pressure Ratio", pair(N, 4.0 + N), per_line=10),
        *section("Mass Flow", grid(W), per_line=10),
        *section("Efficiency", grid(ETA), per_line=10),
    ]


@pytest.fixture
def write(tmp_path):
    def write(lines: list[str], name: str = "my.map", encoding: str = "utf-8") -> Path:
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n", encoding=encoding)
        return path

    return write


@pytest.mark.parametrize("name", SHIPPED)
def test_round_trip_of_shipped_maps(name, tmp_path):
    """Write, read: numbers written by repr come back bit by bit."""
    table = shipped(name)
    write_map_csv(table, tmp_path / "again.csv")
    again = read_map(tmp_path / "again.csv")
    same(table, again)
    assert (again.name, again.source, again.N_ref, again.beta_ref) == (
        table.name, table.source, table.N_ref, table.beta_ref,
    )  # fmt: skip


def test_shipped_figures_are_those_of_pycycle():
    """om-pycycle 4.4.0, modules pycycle.maps.axi5 (alpha 0) and lpt2269, read off the print."""
    c, t = shipped("AXI5"), shipped("lpt2269")
    assert c.W.shape == (10, 9) and t.W.shape == (7, 20)
    at = (int(np.argmax(c.N == 1.0)), int(np.argmax(c.beta == 2.0)))
    assert (c.W[at], c.PR[at], c.eta[at]) == (30.0, 5.2, 0.851)
    assert (c.W[0, 0], c.PR[-1, -1], c.eta[5, 4]) == (4.843, 5.3284, 0.8617)
    assert_array_equal(c.surge_W, c.W[:, 0])  # RlineStall = 1.0, the first R-line
    assert_array_equal(c.surge_PR, c.PR[:, 0])
    at = (int(np.argmax(t.N == 100)), int(np.argmax(t.beta == 0.6)))
    assert (t.W[at], t.PR[at], t.eta[at]) == (149.898, 6.0, 0.9276)
    assert (t.W[-1, 0], t.eta[-1, -1], t.eta[0, 0]) == (140.863, 0.936, 0.8388)
    assert_allclose(t.PR, np.broadcast_to(3 + 5 * t.beta, t.PR.shape), rtol=1e-15)
    assert (c.N_ref, c.beta_ref, t.N_ref, t.beta_ref) == (1.0, 2.0, 100.0, 0.6)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_files_name_origin_and_licence(name):
    """Apache-2.0, section 4: attribution and a statement of changes stay with the figures."""
    text = (resources.files("apu_casadi.gaspath.data") / f"{name}.csv").read_text()
    for words in ("om-pycycle 4.4.0", f"pycycle/maps/{name}.py", "Apache-2.0", "# changed:"):
        assert words in text


def test_csv_as_spreadsheets_write_it(write):
    """Byte order mark, padding commas, quoted comments, swapped columns: same table, 6 digits."""
    lines = ['"# source: A, B",,,,', "# kind: Compressor,,,,", ",,,,", "eta,W,PR,beta,N"]
    for row in csv_lines()[3:33]:
        n, beta, w, pr, eta = row.split(",")
        lines.append(f"{eta}, {w} ,{pr},{beta},{n}")
    lines += ["PR_surge,W_surge,,,"]
    lines += [f"{p},{w},,," for w, p in zip(SURGE_W, SURGE_PR, strict=True)]
    table = read_map(write(lines, "sheet.csv", "utf-8-sig"))
    same(table, made(), rtol=1e-5)
    assert (table.name, table.source, table.N_ref) == ("sheet", "A, B", None)


def test_gasturb_compressor(write):
    """The layout as GasTurb and GSP exchange it, made-up figures, eight digits, wrapped rows."""
    table = read_map(write(gasturb_compressor(), encoding="latin-1"))
    same(table, made(), rtol=1e-7)
    assert table.name == "Made-up compressor"
    assert "RNI=0.100 f=0.950" in table.source


def test_gasturb_turbine(write):
    """PR = min + beta (max - min), as the layout defines it; beta 0 to 1.2 here."""
    table = read_map(write(gasturb_turbine()))
    lo, hi = (1.1 + 0.1 * N)[:, None], (4.0 + N)[:, None]
    same(table, made(kind="turbine", PR=lo + BETA * (hi - lo), surge_W=None, surge_PR=None), 1e-7)
    assert table.name == "my"


def test_gasturb_wrapping_does_not_matter(write):
    """Numbers count, not lines; titles in any case, with a colon or a remark at the end."""
    lines = [
        "99 x",
        *section("MASS FLOW:", grid(W), 3),
        *section("efficiency", grid(ETA), 99),
        *section("  Pressure   Ratio", grid(PR), 1),
        *section("Surge Line", pair(SURGE_W, SURGE_PR), 4),
        "end of the map",
    ]
    same(read_map_gasturb(write(lines)), made(), rtol=1e-7)


def test_gasturb_surge_line_from_the_origin(write):
    """Some files start the surge line at W = 0, PR = 1: left out, as a power law has it anyway."""
    lines = gasturb_compressor()[:-4]
    lines = lines[: lines.index("Surge Line")]
    lines += section("Surge Line", pair([0, *SURGE_W], [1, *SURGE_PR]))
    same(read_map(write(lines)), made(), rtol=1e-7)


def test_trim_leaves_out_lines_at_or_below_unity(write):
    """As GSP's compressor maps have it: one point below 1 at low speed, and a bad choke line."""
    ratio = PR.copy()
    ratio[:, 0] = 0.98
    ratio[0, 1] = 1.0
    lines = gasturb_compressor()
    start, end = lines.index("Pressure Ratio"), lines.index("Surge Line")
    lines[start:end] = section("Pressure Ratio", grid(ratio))
    path = write(lines)
    with pytest.raises(MapError, match=r"row 2, column 2: 0\.98; .*trim=True"):
        read_map(path, trim=False)
    with pytest.warns(ApuWarning, match=r"my\.map: left out, since PR <= 1 there: N = 0\.5, beta"):
        told = read_map(path)
    table = read_map(path, trim=True)
    assert told == table
    # the choke line first (all points at fault); then speed and beta line have one point of five
    # at fault each, and the speed line is asked first
    part = dict(N=N[1:], beta=BETA[1:], W=W[1:, 1:], PR=PR[1:, 1:], eta=ETA[1:, 1:])
    same(table, made(**part), rtol=1e-7)
    assert table.source.endswith("left out, since PR <= 1 there: N = 0.5, beta = 0")
    good = write(gasturb_compressor())
    same(read_map(good, trim=True), read_map(good))


def test_gasturb_to_csv(write, tmp_path):
    """Two routes: a GasTurb map read, written as CSV and read again is the same map."""
    table = read_map(write(gasturb_compressor()))
    write_map_csv(table, tmp_path / "out.csv")
    same(read_map(tmp_path / "out.csv"), table)


def replaced(line: int, old: str, new: str):
    def change(lines: list[str]) -> list[str]:
        assert old in lines[line - 1]
        return [*lines[: line - 1], lines[line - 1].replace(old, new, 1), *lines[line:]]

    return change


def without(*which: int):
    return lambda lines: [t for k, t in enumerate(lines, 1) if k not in which]


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (replaced(2, "kind", "knd"), DataError, "no line '# kind: compressor' or '# k"),
        (replaced(2, "compressor", "fan"), MapError, "kind must be one of .*'fan'"),
        (replaced(3, "beta", "Beta"), DataError, r"line 3: column beta missing.*'Beta'.*'beta'"),
        (replaced(3, "PR,", ""), DataError, "line 3: column PR missing"),
        (replaced(3, ",eta", ",eta,x"), DataError, "line 3: the header must hold"),
        (replaced(6, "0.5,", "half,"), DataError, "line 6, column N: 'half' is no number"),
        (replaced(6, "0.5,", ",0.5,"), DataError, "line 6: 6 cells, but 5 columns .* too many"),
        (replaced(6, "0.5,", "nan,"), DataError, "line 6, column N: no number .*fill the cell"),
        (replaced(9, "0.5,1.2,", "0.5,1.2,-"), MapError, "line 9, column W: -.*must be > 0"),
        (replaced(9, ",0.7", ",1.7"), MapError, r"line 9, column eta: 1.7.*in \(0, 1\]"),
        (replaced(9, ",1.93", ",0.93"), MapError, "line 9, column PR: 0.93.*must be > 1"),
        (without(6), DataError, "speed line N = 0.7 has 6 points, the first line has 5"),
        (without(12), DataError, "line 14: speed line N = 0.7 has 5 points, the first line has 6"),
        (replaced(12, "0.7,0.5", "0.7,0.6"), DataError, "line 12, column beta: 0.6, but 0.5"),
        (replaced(12, "0.7,0.5", "0.7,0.2"), MapError, "line 12, column beta: 0.2 follows 0.25"),
        (replaced(12, "0.7,", "0.4,"), MapError, "line 12, column N: 0.4 follows 0.7"),
        (without(*range(16, 28)), MapError, "N: at least 4 speed lines needed, got 3"),
        (without(*range(34, 40)), MapError, "a compressor needs a surge line"),
        (replaced(36, "3.0", "0.9"), MapError, "line 36, column W_surge: 0.9 does not rise"),
        (replaced(34, "PR_surge", "PR"), DataError, "line 34: column PR_surge missing"),
        (lambda lines: lines[:3], DataError, "no map rows"),
        (lambda lines: ["# kind: turbine", "hello"], DataError, "neither a CSV map"),
        (lambda lines: [""], DataError, "file is empty"),
        (lambda t: [*t[:1], "# N_ref: one", *t[1:]], DataError, "line 2, N_ref: a number"),
    ],
)  # fmt: skip
def test_messages_of_csv(write, change, error, message):
    """Failure messages: file, line, column, what is wrong, what to do."""
    path = write(change(csv_lines()))
    with pytest.raises(error, match=rf"my\.map.*{message}"):
        read_map(path)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda t: t[:10], DataError, "section Efficiency, Pressure Ratio, Surge Line missing"),
        (lambda t: t[:-2], DataError, "'Surge Line' at line 45: 12 numbers announced.*11 found"),
        (without(8), DataError, "'Mass Flow' at line 3: 42 numbers .*6.007.*37 found up"),
        (replaced(8, "4.90", "4.9 0"), DataError, "line 15, .*'Mass Flow': more than the 42 n"),
        (replaced(4, "6.007", "6.000"), DataError, "line 4, section 'Mass Flow': the first number"),
        (replaced(8, "4.9", "x.9"), DataError, "line 8, section 'Mass Flow': a number e"),
        (replaced(8, "0.70000000", "NaN"), DataError, "line 8, .*'NaN' is not finite"),
        (replaced(17, "Efficiency", "Mass Flow"), DataError, "line 17: second section"),
        (replaced(18, "0.25", "0.26"), DataError, "'Efficiency' at line 17: beta values differ"),
        (replaced(20, "0.5", "0.6"), DataError, "'Efficiency' at line 17: speeds differ"),
        (replaced(20, "0.7", "1.7"), MapError, "line 20, .*'Efficiency', row 2, column 2: 1.7"),
        (without(1, 2, *range(17, 60)), DataError, "section Efficiency, .* missing"),
        (lambda t: ["99 x"], DataError, "no section Mass Flow"),
    ],
)  # fmt: skip
def test_messages_of_gasturb(write, change, error, message):
    """Failure messages: file, section, line, announced and found counts."""
    lines = gasturb_compressor()
    path = write(change(lines))
    with pytest.raises(error, match=rf"my\.map.*({message})"):
        read_map(path)


def test_messages_of_gasturb_turbines(write):
    """A turbine file lacks its limits, or has them at other speeds, or a limit at PR = 1."""
    lines = gasturb_turbine()
    with pytest.raises(DataError, match="section Max Pressure Ratio missing; a turbine needs"):
        read_map(write([*lines[:6], *lines[10:]]))
    with pytest.raises(DataError, match=r"'Min Pressure Ratio' at line 3: speeds differ .*0\.6"):
        read_map(write(replaced(4, "0.50000000", "0.60000000")(lines)))
    with pytest.raises(MapError, match=r"line 5, section 'Min.*row 2, column 2: 1; pressure ratio"):
        read_map(write(replaced(5, "1.15", "1.00")(lines)), trim=False)


def test_messages_of_files(tmp_path):
    """Missing files and unknown names are said by name."""
    for read in (read_map, read_map_csv, read_map_gasturb):
        with pytest.raises(DataError, match=r"none\.csv: cannot read the map file: No such file"):
            read(tmp_path / "none.csv")
    with pytest.raises(DataError, match=r"cannot write the map file"):
        write_map_csv(made(), tmp_path / "no" / "folder.csv")
    with pytest.raises(DataError, match=r"no map 'axi6'.*did you mean 'axi5'"):
        shipped("axi6")


@pytest.mark.parametrize("cell", ["1_0", "\u0661", "0x10"])
def test_numbers_are_written_plainly(write, cell):
    """float() would take an underscore and digits of other scripts."""
    lines = csv_lines()
    lines[3] = lines[3].replace(f"{W[0, 0]:.6f}", cell)
    with pytest.raises(DataError, match=r"line 4, column W: .* is no number: correct it"):
        read_map(write(lines))


def test_an_overlong_cell_is_no_traceback(write):
    """The csv module refuses cells beyond 128 KiB with an error of its own."""
    lines = csv_lines()
    lines[5] = "1" * 200_000
    with pytest.raises(DataError, match="line 6: no CSV file: field larger"):
        read_map(write(lines))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_maps_as_spreadsheets_save_them(tmp_path, encoding):
    path = tmp_path / "my.csv"
    path.write_bytes("\r\n".join(["# Höhe", *csv_lines()]).encode(encoding))
    (tmp_path / "plain.csv").write_text("\n".join(csv_lines()))
    assert_array_equal(read_map(path).W, read_map(tmp_path / "plain.csv").W)
