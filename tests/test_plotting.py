"""Figures 20 to 25: drawn without a display, with units, phases and every peak."""

import itertools
import json
import struct

import numpy as np
import pytest
import xarray as xr
from synthetic_joint import synthetic_joint

from apu_casadi.core.errors import DataError
from scenarios.figures import chosen, plotting
from scenarios.figures import figstyle as fs
from scenarios.figures.threephase import cycle_rms, envelope


@pytest.fixture(scope="module")
def ds():
    return synthetic_joint()


def texts(fig):
    fig.canvas.draw()
    found = [t for ax in fig.axes for t in ax.texts] + list(fig.texts)
    return [t.get_text().replace("\n", " ") for t in found]


@pytest.mark.long
def test_files_are_1600_pixels_wide(ds, tmp_path):
    made = plotting.save_figures(ds, tmp_path)
    assert [p.stem for p in made] == list(plotting.FIGURES)
    for path in made:
        head = path.read_bytes()[:24]
        assert head[1:4] == b"PNG"
        assert struct.unpack(">I", head[16:20])[0] == 1600


@pytest.mark.long
@pytest.mark.parametrize("key", plotting.FIGURES)
def test_phases_units_and_caption_are_on_every_figure(ds, key):
    fig = plotting.DRAW[key](ds)
    words = texts(fig)
    for name in ("design point", "load drop", "gas-path fault", "TTSC fault"):
        assert name in words
    assert any(w.startswith(f"Figure {key[3:5]}.") for w in words)
    assert any("rf" in w and "µ" in w and "κ" in w for w in words)
    assert any(ax.get_xlabel() == "Time [s]" for ax in fig.axes)
    if key != "fig20_phases":
        assert "[" in fig.axes[0].get_ylabel()


@pytest.mark.long
@pytest.mark.parametrize("key", plotting.FIGURES)
def test_phase_names_do_not_overlap_or_leave_the_figure(ds, key):
    ds = ds.copy()
    names = ["a rather long name", "b", "gas-path fault of all four kinds", "TTSC", "mended", "end"]
    starts = [0, 1, 2, 6, 10, 12, 14]
    ds.attrs["phases"] = json.dumps(
        [
            {"name": n, "start": a, "end": b}
            for n, a, b in zip(names, starts, starts[1:], strict=False)
        ]
    )
    fig = plotting.DRAW[key](ds)
    fig.canvas.draw()
    boxes = [t.get_window_extent() for t in fig.axes[0].texts if t.get_fontweight() == "bold"]
    assert len(boxes) == 6
    for one, other in itertools.pairwise(boxes):
        assert one.x1 <= other.x0 + 2
    assert all(b.y1 <= fig.bbox.y1 and b.x0 >= 0 for b in boxes)


def test_the_phases_that_matter_are_enlarged():
    """Of seven: those in which wear and a fault begin and end, not the first ones."""
    t = np.linspace(0.0, 7.0, 701)
    starts = range(7)
    rows = [{"name": f"phase {k}", "start": float(k), "end": k + 1.0} for k in starts]
    step = np.floor(np.clip(t - 1e-9, 0, 6))
    rms = {f"I_{p}_rms": 100.0 + 20.0 * np.minimum(step, 3) for p in "abc"}
    rms["I_a_rms"] = rms["I_a_rms"] - 2.0 * (step == 5)
    values = {
        **rms, "f_eta_c": np.where(step >= 4, 0.99, 1.0), "mu": np.where(step == 5, 0.05, 0.0),
        "k_rf": np.where(step == 5, 20.0, np.nan), "N": 3775.0 - step,
    }  # fmt: skip
    ds = xr.Dataset({n: ("time", v) for n, v in values.items()}, {"time": t})
    assert chosen.worn(ds, rows) == [4, 5, 6]
    assert chosen.largest(ds, rows, list(rms), 3) == [4, 5, 6]
    assert chosen.largest(ds, rows, list(rms), 4)[1:] == [4, 5, 6]
    assert chosen.quietest(ds, rows, ds["N"].values) in (4, 5, 6)
    quiet = ds.assign(f_eta_c=("time", np.ones(701)), mu=("time", np.zeros(701)))
    assert chosen.worn(quiet.drop_vars("k_rf"), rows) == []
    assert set(chosen.largest(quiet.drop_vars("k_rf"), rows, list(rms), 3)) == {1, 2, 3}


def test_only_the_papers_scenario_and_unit_have_the_papers_numbers(ds):
    scenarios = {"name": "mine"}, {"name": "joint", "engine": "tpe331"}
    others = [ds.assign_attrs(scenario=json.dumps(s)) for s in scenarios]
    captions = [[t.get_text() for t in plotting.figure_21(x).texts][-1] for x in (ds, *others)]
    assert captions[0].startswith("Figure 21. Shaft speed")
    assert [c.startswith("Shaft speed") for c in captions[1:]] == [True, True]


def test_tick_labels_of_a_long_run_do_not_touch():
    """An enlargement at the end of half an hour, three abreast."""
    fig = fs.new_figure(2.0)
    with fs.drawing():
        ax = fig.add_axes((0.1, 0.2, 0.25, 0.7))
        ax.set_xlim(1799.8, 1801.4)
        fs.few_ticks(ax, 1801.4)
        fig.canvas.draw()
    boxes = [b.get_window_extent() for b in ax.get_xticklabels() if b.get_text()]
    assert all(a.x1 + 4 < b.x0 for a, b in itertools.pairwise(boxes))


def test_envelope_loses_no_peak():
    t = np.arange(100_003) * 50e-6
    y = np.sin(2 * np.pi * 400 * t)
    y[77_777] = 9.0
    x, lo, hi = envelope(t, y, 1000)
    assert x.shape == lo.shape == hi.shape == (1000,)
    assert hi.max() == 9.0 and lo.min() == y.min()
    assert abs(x[hi.argmax()] - t[77_777]) < t[101]
    assert envelope(t[:3], y[:3], 1000)[0].shape == (3,)


@pytest.mark.parametrize("f", [400.0, 413.7])
def test_cycle_rms_does_not_ripple_off_rated_speed(f):
    t = np.arange(4000) * 50e-6
    x, rms = cycle_rms(t, 325.0 * np.sin(2 * np.pi * f * t + 0.3))
    assert rms == pytest.approx(325.0 / np.sqrt(2), rel=1e-4)
    assert np.diff(x) == pytest.approx(1 / f, rel=1e-3)
    assert cycle_rms(t, np.ones_like(t))[0].size == 0
    assert cycle_rms(t, np.sin(2 * np.pi * f * t + 0.3), 8)[0].size == x.size - 7


def test_envelope_is_drawn_and_not_every_sample(ds):
    fig = plotting.figure_25(ds)
    assert max(np.size(line.get_xdata()) for ax in fig.axes for line in ax.lines) < 2000
    top = max(line.get_ydata().max() for line in fig.axes[0].lines if np.size(line.get_xdata()) > 2)
    assert top == 480.0


def test_without_waveforms_the_rms_values_are_drawn():
    fig = plotting.figure_24(synthetic_joint(waveforms=False))
    assert fig.axes[0].get_ylabel() == "Current [A], rms"


@pytest.mark.long
def test_single_phase_and_constant_values_draw(tmp_path):
    quiet = synthetic_joint(end=0.5)
    quiet["N"][:] = 3775.1
    del quiet.attrs["scenario"], quiet.attrs["phases"]
    assert len(plotting.save_figures(quiet, tmp_path)) == 6


def test_a_missing_variable_is_named(ds):
    with pytest.raises(DataError, match="the dataset lacks SM"):
        plotting.figure_23(ds.drop_vars("SM"))
    with pytest.raises(DataError, match="the dataset lacks i_b"):
        plotting.figure_24(ds.drop_vars("i_b"))
