"""An engine is one file: written, read, refused with its place, and used like the default one."""

import dataclasses

import numpy as np
import pytest

from apu_casadi.core.errors import ApuError, DataError, MapError, OperatingPointError
from apu_casadi.gaspath.engines import read_engine, write_engine
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.maps.mapfiles import shipped, write_map_csv
from apu_casadi.gaspath.steady.trimbatch import trim_batch
from apu_casadi.gaspath.steady.trimming import initialise, trim_gas_generator

MAPS = """
[compressor_map]
shipped = "axi5"
N_map_des = 1.0
beta_des = 2.0

[turbine_map]
shipped = "lpt2269"
N_map_des = 100.0
beta_des = 0.5
"""
SMALL = """
[gas_generator]   # a third of the flow, lower pressure ratio and temperature
N = 5200.0
W2 = 1.1
PR_c = 6
T4 = 1150.0
eta_c = 0.8
P_acc = 8e3
J = 0.006
gas_data = "nasa9"

[compressor_map]
file = "maps/mine.csv"
beta_des = 1.9
a_W = 0.1

[turbine_map]
shipped = "lpt2269"
N_map_des = 100.0
beta_des = 0.5
c_PR = 0.2
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A file with an engine of another size and another compressor map."""
    folder = tmp_path_factory.mktemp("engine")
    (folder / "maps").mkdir()
    t = shipped("axi5")
    PR, surge_PR = (1 + 0.9 * (v - 1) for v in (t.PR[:-1], t.surge_PR))
    W, surge_W = (0.4 * v**1.05 for v in (t.W[:-1], t.surge_W))
    grid = {"N": t.N[:-1], "W": W, "PR": PR, "eta": t.eta[:-1] - 0.01}
    line = {"surge_W": surge_W, "surge_PR": surge_PR}
    mine = dataclasses.replace(t, **grid, **line, N_ref=1.0, name="mine")
    write_map_csv(mine, folder / "maps" / "mine.csv")
    path = folder / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.mark.long
def test_another_engine_is_trimmed_run_and_batched(small):
    """Balances of mass and energy hold at its points, and its run settles on its trim."""
    gg = read_engine(small)
    assert gg.parameters.W2 == 1.1 and gg.parameters.NPR == GasGenerator().parameters.NPR
    assert gg.compressor_map.N_map_des == 1.0, "where the map says"
    p, N = gg.parameters, gg.parameters.N
    powers = np.linspace(0.4, 1.0, 320) * gg.design.values["PW"]
    batch = trim_batch(gg, {"N": N, "PW": powers}, altitude=1000.0)
    assert batch.ok.all()
    for k in (0, 160, 319):
        point = trim_gas_generator(gg, {"N": N, "PW": powers[k]}, altitude=1000.0)
        assert batch["Wf"][k] == pytest.approx(point["Wf"], rel=1e-10)
        assert point["W8"] == pytest.approx(point["W2"] * 0.99 + point["Wf"], rel=1e-12)
        h3, h2 = (float(gg.gas.h(point[n])) for n in ("T3", "T2"))
        far = point["Wf"] / (0.99 * point["W2"])
        out = point["W8"] * float(gg.gas.h(point["T8"], far)) + 0.01 * point["W2"] * h3
        left = point["Wf"] * p.LHV + point["W2"] * h2 - out - point["PW"] - p.P_acc
        assert abs(left) < 1e-8 * point["Wf"] * p.LHV
    start = initialise(gg, N=N, PW=powers[0])
    end = trim_gas_generator(gg, {"N": 0.985 * N, "PW": powers[40]})
    inputs = np.tile(end.u[:, None], (1, 1500))
    _, Y = gg.run(start, inputs, dt=0.02)
    assert Y[gg.Y.index("N"), -1] < N
    design = trim_gas_generator(gg, {"N": N, "PW": gg.design.values["PW"]})
    assert design["T4"] == pytest.approx(1150.0, rel=1e-9)


def test_engines_of_two_sizes_are_similar():
    """Half of all flows, areas and powers: the same temperatures, half the fuel (to 1e-9)."""
    gg = GasGenerator()
    p = gg.parameters
    half = dataclasses.replace(gg, parameters=p.change(W2=p.W2 / 2, P_acc=p.P_acc / 2, J=p.J / 2))
    a = trim_gas_generator(gg, {"N": p.N, "PW": 3e5}, altitude=2000.0)
    b = trim_gas_generator(half, {"N": p.N, "PW": 1.5e5}, altitude=2000.0)
    for name in ("T3", "T4", "T5", "P3", "SM", "Mach8"):
        assert b[name] == pytest.approx(a[name], rel=1e-9), name
    for name in ("Wf", "W2", "P_turb"):
        assert b[name] == pytest.approx(a[name] / 2, rel=1e-9), name


def test_an_engine_comes_back_from_its_file(small, tmp_path):
    """Bit for bit, the default one and one with a map of its own; the map goes along."""
    for gg in (GasGenerator(), read_engine(small)):
        path = tmp_path / "written.toml"
        write_engine(gg, path)
        assert read_engine(path) == gg
    assert [f.name for f in tmp_path.glob("*.csv")] == ["written-compressor.csv"]
    assert 'shipped = "lpt2269"' in path.read_text()
    assert "# compressor efficiency [1]" in path.read_text()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[gas_generator]\neta = 0.8" + MAPS, r"gas_generator.*unknown 'eta'.*eta_"),
        ("[gas_generator]\neta_c = 1.2" + MAPS, r"gas_generator.*eta_c \[1\] = 1.2.*\[0.3, 1\]"),
        ("[gas_generator]\nW2 = '3 kg/s'" + MAPS, r"W2 \[kg/s\].*number"),
        ("[gas_generator]\ngas_data = 'nasa8'" + MAPS, r"gas_data = 'nasa8'.*nasa"),
        ("gas_generator = 3" + MAPS, r"gas_generator must be a table"),
        ("[compresor_map]\na = 1" + MAPS, r"unknown 'compresor_map'.*compressor_map"),
        ("", r"engine.toml: empty: an engine has at least one of the tables gas_generator"),
        (MAPS.replace("axi5", "axi6"), r"compressor_map.*shipped = 'axi6'.*axi5"),
        (MAPS.replace('shipped = "axi5"', ""), r"compressor_map.*give the map"),
        (MAPS.replace('shipped = "axi5"', 'file = "no.csv"'), r"no\.csv.*cannot read"),
        (MAPS.replace('"axi5"', '"axi5"\ntrim = true'), r"trim goes with file"),
        (MAPS.replace('shipped = "axi5"', 'file = "x.csv"\ncheck = 1'), r"check must be true"),
        (MAPS.replace("axi5", "lpt2269"), r"compressor_map.*map of a turbine"),
        (MAPS.replace("N_map_des = 1.0", "N_map_des = 7"), r"N_map_des = 7 .*table, 0\."),
        (MAPS.replace("beta_des = 2.0", "beta_des = 2.0\na_W = 9"), r"a_W.*\[-5, 5\]"),
        ("[gas_generator\n", r"no TOML file.*line 1"),
    ],
)
def test_mistakes_are_told_with_their_place(tmp_path, text, words):
    """File, table, name, unit, range and the nearest name."""
    path = tmp_path / "engine.toml"
    path.write_text(text)
    with pytest.raises(ApuError, match=words) as e:
        read_engine(path)
    assert str(tmp_path) in str(e.value)


def test_what_cannot_be_an_engine_is_told_when_it_is_read(tmp_path):
    """A design point without solution, a map that cannot be scaled to it, a file that is not."""
    path = tmp_path / "engine.toml"
    path.write_text("[gas_generator]\nT4 = 620.0\nPR_c = 40" + MAPS)
    with pytest.raises(OperatingPointError, match=r"engine\.toml: design point not solved"):
        read_engine(path)
    path.write_text("[gas_generator]\neta_c = 0.99" + MAPS)
    with pytest.raises(MapError, match=r"engine\.toml: map .*efficiency would be"):
        read_engine(path)
    with pytest.raises(DataError, match=r"absent\.toml"):
        read_engine(tmp_path / "absent.toml")
