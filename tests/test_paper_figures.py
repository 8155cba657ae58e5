"""Section 6 module by module: Figures 15 to 19, Tables 6 and 9, the generated pages."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest

from apu_casadi.core.errors import ScenarioError
from apu_casadi.core.units import RPM
from scenarios.figures.moduleplots import MODULE_FIGURES
from scenarios.pages import errata_page, validation_page
from scenarios.validation import comparison, paper_figures
from scenarios.validation.comparison import Row

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def runs():
    """Both signs of the turbine flow, by the difference equation."""
    return {sign: paper_figures._gas(sign, "discrete") for sign in paper_figures.HEALTH}


@pytest.mark.long
def test_the_run_of_section_6_1_2(runs):
    """Steady at 230 kW and 36050 r/min for 3 s, then faster and hotter with 10 % more fuel."""
    for sign, ds in runs.items():
        before = (ds.time <= 3.0 + 1e-9).to_numpy()
        assert float(np.ptp(ds.N.to_numpy()[before])) < 1e-6 * 3775, f"{sign}: not steady"
        assert float(ds.N[0]) * RPM == pytest.approx(36050.0, rel=1e-9)
        assert float(ds.PW[0]) == pytest.approx(230e3, rel=1e-9)
        assert float(ds.Wf[-1] / ds.Wf[0]) == pytest.approx(1.10, rel=1e-9)
        cube = ds.PW.to_numpy() / 230e3 / (ds.N.to_numpy() * RPM / 36050.0) ** 3
        assert np.abs(cube - 1).max() < 1e-9, "the load is proportional to speed cubed"
        for name in ("N", "T3", "P3", "T4", "T5", "SM"):
            assert ds[name][-1] > ds[name][0], f"{sign}: {name} at 10 s against the start"
        assert float(ds.SM.min()) < float(ds.SM[0]), "richer fuel first takes surge margin"


def test_the_sign_of_the_turbine_flow_shows(runs):
    """A larger turbine capacity lowers the pressure ratio and gains surge margin."""
    gain, loss = runs["gain"], runs["loss"]
    assert float(gain.P3[0]) < float(loss.P3[0])
    assert float(gain.SM[0]) > float(loss.SM[0])
    assert gain.attrs["f_W_t"] == 1.04 and loss.attrs["f_W_t"] == 0.96


@pytest.mark.parametrize("name", ["table6", "table9"])
def test_every_row_is_within_its_tolerance(name):
    """``apu validate`` prints the rows; two routes of our own are checks, never the paper's."""
    rows = comparison.run(name)
    short = [f"{r.quantity}: {r.error:+.2e} > {r.tolerance:.0e}" for r in rows if not r.passed]
    assert not short, short
    for r in rows:
        assert (r.kind == "check") == np.isnan(r.reference), r.quantity


def test_unknown_choices_are_refused_with_the_nearest():
    """Three choices, three refusals."""
    with pytest.raises(ScenarioError, match="gain"):
        paper_figures.gas_generator_transient("gian")
    with pytest.raises(ScenarioError, match="cvodes"):
        paper_figures.gas_generator_transient(route="cvode")
    with pytest.raises(ScenarioError, match="healthy"):
        paper_figures.machine_transient("helthy")


@pytest.mark.long
def test_figures_15_to_19_are_written(tmp_path):
    """PNG, 1600 px wide, in the paper's order."""
    made = paper_figures.write_figures(tmp_path, joint=False)
    assert [p.stem for p in made] == list(MODULE_FIGURES)
    for path in made:
        head = path.read_bytes()[:24]
        assert head[1:4] == b"PNG" and struct.unpack(">I", head[16:20])[0] == 1600


# --------------------------------------------------------------------------- generated pages


def section_of_page(name):
    """Return the table rows of a section of VALIDATION.md as they stand."""
    text = (ROOT / "VALIDATION.md").read_text(encoding="utf-8")
    found = re.search(rf"^## {name}\n\n.*?\n\n((?:\|.*\n)+)", text, re.M)
    assert found, f"VALIDATION.md has no section {name}: run apu validate --write VALIDATION.md"
    return found.group(1).splitlines()[2:]


@pytest.mark.parametrize("name", ["table4", "table5", "table7", "table8"])
def test_validation_md_is_what_the_code_yields_now(name):
    """The committed page ages otherwise; errors are compared to a tenth of the tolerance."""
    rows = [r for r in comparison.run(name) if np.isfinite(r.tolerance)]
    lines = section_of_page(name)
    assert len(lines) == len(rows), f"{name}: write VALIDATION.md again"
    for line, r in zip(lines, rows, strict=True):
        cells = [c.strip() for c in line.strip("|").split("|")]
        assert cells[0] == r.quantity and cells[6] == r.kind
        # seven digits on the page; other processors round otherwise
        close = pytest.approx(r.ours, rel=2e-6, abs=0.1 * r.tolerance)
        assert float(cells[3]) == close, f"{name} {r.quantity}: write VALIDATION.md again"


def test_the_page_leaves_timings_out_and_names_what_was_skipped():
    """Rows that ask for nothing (wall times) would make every page another one."""
    rows = [
        Row("T3", "K", 568.1, 568.2, 1.8e-4, 1e-3, "why", "predicted"),
        Row("wall time", "s", float("nan"), 3.2, 0.0, float("inf"), "a timing", "check"),
        Row("P3", "kPa", 802.0, 900.0, 0.12, 1e-3, "why", "predicted"),
    ]
    page = validation_page.page({"table4": rows}, {"pycycle": "not installed"})
    assert "wall time" not in page and "pycycle (not installed)" in page
    assert "2 rows, 1 short" in page and "**SHORT**" in page


#: fast ones; the others take seconds each
FAST = ("corrected_flow", "gas_data", "table_5_P1", "turbine_flow_sign", "line_voltage",
        "damper_inductance", "field_loss", "droop", "efficiency_split")  # fmt: skip


def numbers(text):
    return [float(x) for x in re.findall(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?", text)]


@pytest.mark.parametrize("name", FAST)
def test_errata_md_is_what_the_code_yields_now(name):
    """Every number of the page is computed: within 1 % of what stands there, words equal."""
    page = (ROOT / "docs" / "ERRATA.md").read_text(encoding="utf-8")
    effect = getattr(errata_page, name)()
    words = effect.split(":")[0][:25]
    line = next((x for x in page.splitlines() if words in x and len(x.split(" | ")) == 4), None)
    assert line, f"not on the page: {words!r}; run apu errata --write docs/ERRATA.md"
    there = line.split(" | ")[3].removesuffix(" |")
    assert numbers(there) == pytest.approx(numbers(effect), rel=1e-2, abs=2e-6), "write it again"


def test_errata_md_has_every_item():
    """An item added to the list without writing the page again."""
    page = (ROOT / "docs" / "ERRATA.md").read_text(encoding="utf-8")
    missing = [i.what for items in errata_page.ITEMS.values() for i in items if i.what not in page]
    assert not missing, f"run apu errata --write docs/ERRATA.md: {missing}"


@pytest.mark.slow
def test_errata_md_word_for_word():
    """The whole page, the slow effects included; on the processor that wrote it."""
    effects = errata_page.page()
    page = (ROOT / "docs" / "ERRATA.md").read_text(encoding="utf-8")
    assert numbers(effects) == pytest.approx(numbers(page), rel=1e-2, abs=2e-6)
