"""Formats, resolution and the style for grey print of figures."""

import struct

import pytest

from apu_casadi.core.errors import ParameterError
from scenarios import cli, commands
from scenarios.commands import given
from scenarios.figures import figstyle as fs
from scenarios.figures.drawnas import DrawnAs, grey


def small():
    """Three curves beside each other, one alone, a band, a legend and a boundary."""
    with fs.drawing():
        fig = fs.new_figure(2.0, 3.0)
        left, right = fig.subplots(1, 2)
        for k, ink in enumerate(fs.ABC.values()):
            left.plot([0, 1], [k, k + 1], color=ink, label=f"{k}")
        left.axvline(0.5, color=fs.PHASE_INK[3], ls=fs.DASHED)
        fs.legend(left, "upper left")
        right.axvspan(0, 1, color=fs.BANDS[2], lw=0)
        right.plot([0, 1], [0, 1], color=fs.LINE_INK[1])
    return fig


def test_grey_has_no_colour_and_tells_curves_apart():
    import numpy as np

    fig = grey(small())
    fig.canvas.draw()
    r, g, b = (np.asarray(fig.canvas.buffer_rgba())[..., k].astype(int) for k in range(3))
    assert abs(r - g).max() <= 1 and abs(g - b).max() <= 1
    left, right = fig.axes
    assert len({str(line.get_linestyle()) + str(line._dash_pattern) for line in left.lines}) == 4
    shown = [line._dash_pattern[1] for line in left.get_legend().get_lines()]
    assert [p is None for p in shown] == [True, False, False] and shown[1] != shown[2]
    assert right.lines[0].get_linestyle() == "-"
    assert left.get_legend().get_frame().get_edgecolor()[3] == 0.0  # it had no edge


def test_formats_and_resolution(tmp_path):
    made = DrawnAs(("png", "svg", "pdf"), 50).save(small(), tmp_path / "a.b")
    assert [p.name for p in made] == ["a.b.png", "a.b.svg", "a.b.pdf"]
    heads = [p.read_bytes() for p in made]
    assert struct.unpack(">I", heads[0][16:20])[0] == 150  # 3 in
    assert b"<svg" in heads[1] and heads[2].startswith(b"%PDF")
    again = DrawnAs(("svg", "pdf")).save(small(), tmp_path / "again")
    assert [p.read_bytes() for p in again] == heads[1:]  # no date, no random names


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"formats": ("jpg",)}, "unknown format of figures 'jpg'"),
        ({"formats": ()}, "no format of figures"),
        ({"style": "gray"}, "did you mean 'grey'"),
        ({"dpi": 5}, "dpi must be 20 to 1200, got 5"),
    ],
)
def test_what_cannot_be_drawn_is_told_before(given, words):
    with pytest.raises(ParameterError, match=words):
        DrawnAs(**given)


@pytest.mark.parametrize(
    "command",
    [
        "run",
        "linearise",
        "maps",
        "tune",
        "identify",
        "fit",
        "multirate",
        "validate",
        "estimate:joint",
        "estimate:data",
    ],
)
def test_every_command_that_draws_has_the_options(command):
    """Declared once: ``--dpi`` and ``--style``, and formats where no FILE tells one."""
    name, _, action = command.partition(":")
    needed = {"run": ["joint"], "fit": ["a.csv"], "tune": ["a.csv"], "estimate:data": ["a.csv"]}
    words = [name, *([action] if action else []), *needed.get(command, [])]
    args = commands.parser().parse_args([*words, "--style", "grey", "--dpi", "90"])
    assert given.look(args) == DrawnAs(dpi=90, style="grey")
    if name not in ("identify", "fit", "validate"):
        args = commands.parser().parse_args([*words, "--style", "grey", "--figures=svg,pdf"])
        assert given.formatted(args) == DrawnAs(("svg", "pdf"), style="grey")


def test_the_switch_of_figures_still_works():
    parse = commands.parser().parse_args
    assert given.drawn(parse(["estimate", "joint", "--figures"])) == DrawnAs()
    assert given.drawn(parse(["estimate", "joint"])) == DrawnAs()
    assert given.drawn(parse(["estimate", "joint", "--no-figures"])) is None


def test_linearise_writes_what_was_asked_for(tmp_path, capsys):
    how = ["--figures", "svg", "--style", "grey", "--out", str(tmp_path)]
    assert cli.main(["linearise", "--model", "gas", *how]) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["eigenvalues.svg"]
    assert "eigenvalues.svg" in capsys.readouterr().out
