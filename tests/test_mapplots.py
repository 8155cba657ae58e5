"""Map and eigenvalue figures: what is drawn lies where the model says, with axes and captions."""

import numpy as np
import pytest

from apu_casadi.core.errors import DataError, MapError, SignalError
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.linearisation import linearise_gas_generator, linearise_joint
from apu_casadi.unit.multirate import simulate_joint
from scenarios.cli import main
from scenarios.figures.eigenplot import plot_eigenvalues
from scenarios.figures.mapplots import (
    P_STD,
    T_STD,
    default_lines,
    operating_line,
    plot_compressor_map,
    plot_turbine_map,
    published_surge_line,
    surge_line,
)


@pytest.fixture(scope="module")
def gg():
    return Apu().gas_generator


@pytest.fixture(scope="module")
def lines(gg):
    return default_lines(gg)


@pytest.fixture(scope="module")
def run():
    return simulate_joint(Apu(), duration=0.2, load=SeriesLoad.from_power(200e3), waveform_dt=None)


def curve(ax, label):
    return next(line for line in ax.lines if line.get_label().startswith(label)).get_xydata()


@pytest.mark.long
def test_operating_line_lies_on_its_own_points(gg, lines):
    """At design ambient the line ends at the design point, at standard-day flow 3.2034 kg/s.

    Table 4's W2 = 3.1442 kg/s is 3.2034 kg/s on a standard day; 1e-4 by its five digits.
    """
    fig = plot_compressor_map(gg, lines=lines)
    xy = curve(fig.axes[0], "operating line, 0 m")
    assert xy[-1, 0] == pytest.approx(3.2034, rel=1e-4)
    assert xy[-1, 1] == pytest.approx(8.0, rel=1e-9)
    points = next(iter(lines.values()))
    W = [p["W2"] * np.sqrt(p["T2"] / T_STD) / (p["P2"] / P_STD) for p in points]
    np.testing.assert_allclose(xy[:, 0], W, rtol=1e-12)
    assert points[0]["PW"] == pytest.approx(0, abs=1e-3)


def test_surge_line_is_where_the_margin_vanishes(gg):
    """SM = PR_surge(W)/PR - 1 is 0 there; 2e-3 by interpolation between samples of beta."""
    cmap = gg.maps[0]
    W, PR = surge_line(cmap)
    assert W.size > 40
    n = 1.0
    beta = np.linspace(cmap.table.beta[0] - 0.7, cmap.table.beta[-1] + 0.7, 4000)
    m = cmap.lookup(np.full(beta.shape, n), beta, 1.0)
    k = int(np.argmin(np.abs(m.SM)))
    assert np.interp(m.W[k], W, PR) == pytest.approx(m.PR[k], rel=2e-3)


def test_published_surge_line_passes_over_the_design_flow(gg):
    """Scaled only: the margin at design flow over k_SM times is that of the model, at n = 1."""
    cmap = gg.maps[0]
    W, PR = published_surge_line(cmap)
    at = np.interp(cmap.W_des, W, PR) - 1
    m = cmap.lookup(1.0, cmap.beta_des, 1.0)
    assert 1 + cmap.cal.k_SM * at == pytest.approx(
        (1 + m.SM) * m.PR, rel=0.02
    )  # chords, not spline
    with pytest.raises(MapError, match="no surge line"):
        published_surge_line(gg.maps[1])


@pytest.mark.long
@pytest.mark.parametrize("draw", [plot_compressor_map, plot_turbine_map])
def test_maps_carry_axes_units_labels_and_captions(gg, lines, run, draw):
    fig = draw(gg, lines=lines, trajectory=run)
    fig.canvas.draw()
    whole, near = fig.axes
    assert "[" in whole.get_xlabel() and "Pressure ratio" in whole.get_ylabel()
    assert any("map at Reynolds number index 1" in t.get_text() for t in fig.texts)
    legend = [t.get_text() for t in fig.legends[0].get_texts()]
    assert "design point" in legend and "run: run" in legend
    assert sum(t.startswith("operating line, ") for t in legend) == 2
    speeds = [t.get_text() for t in whole.texts]
    assert "1" in speeds
    # nothing drawn runs out of the enlarged part
    (x0, x1), (y0, y1) = near.get_xlim(), near.get_ylim()
    for label in ("operating line", "run: "):
        for x, y in curve(near, label):
            assert x0 < x < x1 and y0 < y < y1
    # the legend does not cover the axes
    box = fig.legends[0].get_window_extent()
    assert box.y1 < whole.get_window_extent().y0


def test_trajectory_starts_where_the_run_starts(gg, run):
    fig = plot_turbine_map(gg, lines={}, trajectory=run)
    xy = curve(fig.axes[0], "run: ")
    v = {n: float(run[n].values[0]) for n in ("W41", "T41", "P4", "n_t", "PR_t")}
    x = v["W41"] * np.sqrt(v["T41"]) / v["P4"] / gg.design.W_t * v["n_t"]
    assert xy[0] == pytest.approx([x, v["PR_t"]], rel=1e-9)
    with pytest.raises(DataError, match="lacks PR_t"):
        plot_turbine_map(gg, lines={}, trajectory=run.drop_vars("PR_t"))


def test_operating_line_with_worse_health_needs_another_point(gg):
    """A worn compressor runs nearer to surge at the same power."""
    (new,), (worn,) = (
        operating_line(gg, [4e5], health=h) for h in (None, {"f_eta_c": 0.97, "f_W_t": 0.98})
    )
    assert worn["SM"] < new["SM"]


def test_eigenvalue_plot_shows_every_mode():
    apu = Apu()
    point = apu.steady_state(SeriesLoad.from_power(225e3))
    m = linearise_joint(apu, point)
    fig = plot_eigenvalues({"225 kW": m, "again": m})
    fig.canvas.draw()
    (ax,) = fig.axes
    xy = curve(ax, "225 kW")
    assert len(xy) == len(m.x)
    found = np.sort_complex(xy[:, 0] + 1j * xy[:, 1])
    np.testing.assert_allclose(found, np.sort_complex(np.linalg.eigvals(m.A)), rtol=1e-6, atol=1e-6)
    assert "[1/s]" in ax.get_xlabel() and "[rad/s]" in ax.get_ylabel()
    named = {t.get_text() for t in ax.texts}
    assert {"E_fd", "lam_s0", "Wf_I"} <= named
    one = linearise_gas_generator(apu.gas_generator, point.gas)
    plot_eigenvalues({"gas": one}).canvas.draw()
    with pytest.raises(SignalError, match="got 0"):
        plot_eigenvalues({})


@pytest.mark.long
def test_commands_write_their_figures(tmp_path, capsys):
    """`apu maps` and `apu linearise` print what they wrote, and the table of eigenvalues."""
    assert main(["maps", "--no-lines", "--out", str(tmp_path)]) == 0
    assert main(["linearise", "--power", "100", "--out", str(tmp_path)]) == 0
    for name in ("compressor_map", "turbine_map", "eigenvalues"):
        assert (tmp_path / f"{name}.png").stat().st_size > 20_000
    out = capsys.readouterr().out
    assert "joint_averaged_resistive: 12 states" in out and "lam_fd" in out
    assert main(["linearise", "--model", "gas", "--json", "--no-figures"]) == 0
    assert '"eigenvalues"' in capsys.readouterr().out
    assert main(["linearise", "--model", "generator", "--constant-power", "--no-figures"]) == 0
    assert "G_load" in capsys.readouterr().out
