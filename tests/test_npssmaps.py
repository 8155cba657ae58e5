"""Map files in the NPSS text layout: read like the tables they hold, refused by their line."""

from __future__ import annotations

import dataclasses
import random
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from apu_casadi.core.errors import ApuError, ApuWarning, DataError, MapError
from apu_casadi.gaspath.engines import read_engine
from apu_casadi.gaspath.gasgenerator import GasGenerator, MapChoice
from apu_casadi.gaspath.maps.mapfiles import read_map, shipped
from apu_casadi.gaspath.maps.maptable import MapTable

HEAD = """// a map, with a comma
/* and a remark
of two lines */
Subelement {kind} S_map {{
   description = "as {{ used }}";
   {design}
"""
DESIGN = {
    "compressor": "alphaMapDes = 0.0;  NcMapDes = 1.000;  RlineMapDes = 2.0;  RlineStall = 1.0;",
    "turbine": "NpMapDes = 100.0; PRmapDes = 6.0;",
}
TAIL = """   Subelement CompressorReynoldsEffects S_Re {
      Table s_WcRe(real RNI) { RNI = {0.1, 1.0} s_WcRe = {0.9, 1.0} }
   }
}
"""
TABLES = {
    "compressor": {"TB_Wc": "W", "TB_PR": "PR", "TB_eff": "eta"},
    "turbine": {"TB_Wp": "W", "TB_eff": "eta"},
}


def npss(table: MapTable, *, alphas: tuple[float, ...] = (0.0,)) -> str:
    """A map as its authors would write it, with what NPSS needs besides."""
    up = table.kind == "compressor"
    speed, along = ("NcMap", "RlineMap") if up else ("NpMap", "PRmap")
    axes = f"real alphaMap, real {speed}, real {along}" if up else f"real {speed}, real {along}"
    out = [HEAD.format(kind=f"{table.kind}Map", design=DESIGN[table.kind]).rstrip("\n")]
    for name, q in TABLES[table.kind].items():
        out.append(f"   Table {name}({axes}) {{")
        for alpha in alphas:
            out += [f"      alphaMap = {alpha} {{"] if up else []
            for i, N in enumerate(table.N):
                x = table.beta if up else table.PR[i]
                values = getattr(table, q)[i] * (0.9 if alpha and q == "W" else 1.0)
                cells = [f"{v:.6f}" for v in values]
                half = len(cells) // 2  # wrapped, as long rows are
                out.append(f"         {speed} = {N:.3f} {{")
                out.append(f"            {along} = {{ {', '.join(f'{v:.6f}' for v in x)} }}")
                out.append(f"            {name[3:]}Map = {{ {', '.join(cells[:half])},")
                out += [f"               {', '.join(cells[half:])} }}", "         }"]
            out += ["      }"] if up else []
        out += [f'      {speed}.interp = "lagrange3";  {along}.extrap = "linear";', "   }"]
    return "\n".join(out) + "\n" + (TAIL if up else "}\n")


@pytest.fixture
def write(tmp_path):
    def write(text: str):
        path = tmp_path / "my.map"
        path.write_text(text)
        return path

    return write


def test_a_compressor_is_what_its_tables_say(write):
    """AXI5, whose source is such a file: axes, values, surge line at RlineStall, design point."""
    table = shipped("axi5")
    found = read_map(write(npss(table)))
    assert (found.kind, found.N_ref, found.beta_ref) == ("compressor", 1.0, 2.0)
    for name in ("N", "beta", "W", "PR", "eta", "surge_W", "surge_PR"):
        assert_allclose(getattr(found, name), getattr(table, name), atol=1e-6, err_msg=name)


def test_a_turbine_is_tabulated_over_pressure_ratio(write):
    """Beta is how far the pressure ratio has gone along its line."""
    table = shipped("lpt2269")
    found = read_map(write(npss(table)))
    assert (found.kind, found.N_ref) == ("turbine", 100.0)
    assert found.beta_ref == pytest.approx((6.0 - table.PR[0, 0]) / np.ptp(table.PR[0]))
    assert_allclose(found.PR, table.PR, atol=1e-6)
    assert_allclose(found.beta, (table.PR[0] - table.PR[0, 0]) / np.ptp(table.PR[0]), atol=1e-6)
    assert_allclose(found.eta, table.eta, atol=1e-6)


def test_the_design_alpha_is_read(write):
    """Of several alphas that of alphaMapDes, else the first; the source tells which."""
    table = shipped("axi5")
    text = npss(table, alphas=(5.0, 0.0))
    assert_allclose(read_map(write(text)).W, table.W, atol=1e-6)
    first = read_map(write(text.replace("alphaMapDes = 0.0;", "")))
    assert_allclose(first.W, 0.9 * table.W, atol=1e-6)
    assert "alphaMap = 5 of 5, 0" in first.source
    two = re.sub(r"(?m)real alphaMap, |alphaMap = 0.0 \{|^ {6}\}$", "", npss(table))
    assert read_map(write(two)).W.shape == table.W.shape


@pytest.mark.parametrize("name", ["axi5", "lpt2269"])
def test_a_star_repeats_the_coordinates_of_the_line_before(write, name):
    """As in the maps of the JT9D in NASA's T-MATS, after the first line of each table or alpha."""
    text = npss(shipped(name), alphas=(0.0, 90.0) if name == "axi5" else (0.0,))
    along = "RlineMap" if name == "axi5" else "PRmap"
    table, block = re.compile(r"Table TB_.*?\n   }", re.DOTALL), rf"{along} = {{[^}}]*}}"

    def starred(match):
        head, *rest = re.split(rf"({block})", match.group(), maxsplit=1)
        return head + rest[0] + re.sub(block, f"{along} = *;", rest[1])

    short = table.sub(starred, text)
    assert short.count(f"{along} = *;") > 5 * text.count("Table TB_")
    found, whole = read_map(write(short)), read_map(write(text))
    for n in ("N", "beta", "W", "PR", "eta"):
        assert_array_equal(getattr(found, n), getattr(whole, n))
    none = re.sub(block, f"{along} = *;", text, count=1)
    with pytest.raises(
        DataError, match=rf"line \d+: values of {along}, none of it before, expected"
    ):
        read_map(write(none))


def test_an_engine_runs_on_it(write):
    """The default engine's own maps from such files give its own operating points (to 1e-5)."""
    gg = GasGenerator()
    path = write(npss(shipped("axi5")))
    own = MapChoice(read_map(path), 1.0, 2.0, gg.compressor_map.calibration)
    a, b = (m.scaled(W=3.1, PR=8.0, eta=0.85).lookup(0.97, 1.9) for m in (own, gg.compressor_map))
    assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    toml = path.with_name("e.toml")
    toml.write_text('[compressor_map]\nfile = "my.map"\n[turbine_map]\nshipped = "lpt2269"\n'
                    "N_map_des = 100.0\nbeta_des = 0.5\n")  # fmt: skip
    assert read_engine(toml).compressor_map.N_map_des == 1.0


def test_lines_at_or_below_unity_are_left_out_with_a_note(write):
    """As maps of turbines begin at 1, and those of compressors end below it near choke."""
    table = shipped("axi5")
    made = npss(table)
    for i in range(table.N.size):
        made = made.replace(f", {table.PR[i, -1]:.6f} }}", ", 0.970000 }")
    path = write(made)
    with pytest.raises(MapError, match=r"line \d+, PR = 0\.97; pressure ratio must be > 1"):
        read_map(path, trim=False)
    with pytest.warns(ApuWarning, match=r"my\.map: left out, since PR <= 1 there: beta = 2.6"):
        found = read_map(path)
    assert found == read_map(path, trim=True)
    assert_array_equal(found.beta, table.beta[:-1])
    assert "left out, since PR <= 1" in found.source


def test_one_wrong_cell_is_not_the_end_of_a_map(write):
    """It is refused with its line, and not cut away with half of the table."""
    table = shipped("axi5")
    text = npss(table).replace(f"{table.PR[5, 4]:.6f}", "0.361000", 1)
    with pytest.raises(MapError, match=r"line \d+, PR = 0\.361; pressure ratio must be"):
        read_map(write(text))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Table TB_PR(", "Table TB_P(", r"no Table TB_PR; needed are TB_Wc, TB_PR, TB_eff of a c"),
        ("Table TB_PR(", "Table TB_Wc(", r"line \d+: second Table TB_Wc, the first is at line 7"),
        ("NcMap = 0.500 {", "NcMap = 0.500", r"line 15: '\{' after NcMap = 0.500 expected, got"),
        ("NcMap = 0.500 {", "NcMap 0.500 {", r"line \d+: '=' after 'NcMap' expected, got '0.500'"),
        ("NcMap = 0.500 {", "NcMap = half {", r"line \d+, NcMap: a number expected, got 'half'"),
        ("NcMap = 0.500 {", "NpMap = 0.500 {", r"line \d+: NcMap = \.\.\. expected .* got 'NpMap'"),
        ("NcMap = 0.500 {", "NcMap = 0.400 {", r"line \d+, Table TB_PR: speed 0.5, but 0.4 in"),
        ("RlineMap = { 1.000000,", "RlineMap = { 1.100000,", r"line \d+.*(R-lines|coordinates)"),
        ("RlineMap = { 1.000000,", "RlineMap = {", r"line \d+, NcMap = 0.4: 8 values of RlineMap"),
        ("WcMap = {", "RlineMap = {", r"line \d+: one array 'RlineMap' expected, a second"),
        ("WcMap = {", "WcMap = { NaN,", r"line \d+.*(values of|'NaN' is not finite)"),
        ("real RlineMap) {", "real RlineMap {", r"line 7: '\)' of Table TB_Wc expected, got"),
        ("(real alphaMap, real NcMap, real RlineMap)", "()", r"line 7, Table TB_Wc: speed and"),
        ("alphaMap = 0.0 {", "betaMap = 0.0 {", r"line 7: alphaMap = .* expected .* got betaMap"),
    ],
)  # fmt: skip
def test_messages(write, old, new, message):
    """File, line, what was expected."""
    text = npss(shipped("axi5"))
    assert old in text
    with pytest.raises(ApuError, match=rf"my\.map.*({message})"):
        read_map(write(text.replace(old, new, 1)))


def test_what_is_not_read_is_told(write):
    """A speed that falls, pressure ratios of another spacing, Python arrays."""
    t = npss(shipped("lpt2269"))
    with pytest.raises(MapError, match=r"line \d+: speed 59 follows 60; speeds must rise"):
        read_map(write(t.replace("NpMap = 70.000", "NpMap = 59.000")))
    one, other = t.split("NpMap = 70.000")[:2], t.split("NpMap = 70.000")[2]
    moved = "NpMap = 70.000".join([x.replace("= { 3.000", "= { 2.900", 1) for x in (one[1], other)])
    with pytest.raises(DataError, match=r"line 13: pressure ratios must be spaced as on the first"):
        read_map(write(f"{one[0]}NpMap = 70.000{moved}"))
    python = "import numpy as np\nAXI5 = MapData()\nAXI5.NcMap = np.array([0.3, 0.4])\n"
    with pytest.raises(DataError, match=r"Python"):
        read_map(write(python))


@pytest.mark.long
def test_damaged_files_are_refused_or_read_never_lost(write):
    """Cut anywhere, tokens swapped, numbers replaced: an error of the package, or the same map."""
    t, rng = shipped("axi5"), random.Random(1)
    part = {n: getattr(t, n)[3:8, :5] for n in ("W", "PR", "eta")}
    table = dataclasses.replace(t, N=t.N[3:8], beta=t.beta[:5], beta_ref=None, **part)
    text = npss(table)
    tokens = re.split(r"(\s+)", text)
    for k in range(90):
        if k % 3 == 0:
            damaged = text[: rng.randrange(len(text))]
        elif k % 3 == 1:
            parts = list(tokens)
            i, j = rng.randrange(len(parts)), rng.randrange(len(parts))
            parts[i], parts[j] = parts[j], parts[i]
            damaged = "".join(parts)
        else:
            parts = list(tokens)
            parts[rng.randrange(len(parts))] = rng.choice(["NaN", "{", "}", "1e999", "", "=", "-1"])
            damaged = "".join(parts)
        try:
            found = read_map(write(damaged), trim=True)
        except ApuError as e:
            assert "my.map" in str(e)
        else:
            assert found.W.shape[1] >= 4
