"""Draw the picture of docs/ARCHITECTURE.md again: ``python docs/draw_house.py`` (two seconds).

Boxes are folders with their files and lines, counted now; an arrow says that a folder imports
another one.  What is reached by way of others is left out.  ``--lines`` prints instead what lines
are: the table below "Size".
"""

import ast
import sys
from collections import Counter
from pathlib import Path

from scenarios.figures.figstyle import INK, LINE_INK, MUTED, STYLE, drawing, new_figure

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("apu_casadi", "estimators", "scenarios")
BOXES = """
apu_casadi.core         0.00 0 0.98 signals, state spaces, solvers, compiled code, results, files
apu_casadi.gaspath      0.00 1 0.30 gas, components, maps, cycle, steady/, engines
apu_casadi.machine      0.34 1 0.30 machine, exciter, loads/, faults/, exact propagation
estimators.models       0.70 1 0.28 what a filter must know; recordings
apu_casadi.unit         0.00 2 0.64 governor, events, exchange (1)-(3), one run loop, linear models
estimators.filters      0.70 2 0.28 EKF, UKF, IMM, square roots; belief
estimators.batch        0.64 3 0.11 smoothers, MHE, fit
estimators.information  0.76 3 0.11 bounds, NEES, NIS
estimators.detection    0.88 3 0.11 GLR, CUSUM
estimators.apu          0.00 4 0.98 sensors, recordings, electrical, gas-path and joint filters
scenarios.shell         0.00 5 0.30 signals, streams, locks, text
scenarios.figures       0.34 5 0.30 all that draws
scenarios.validation    0.70 6 0.28 against others
scenarios.studies       0.34 6 0.30 one file a study
scenarios.registry      0.00 6 0.30 schema, library, campaigns
scenarios.export        0.00 7 0.30 C functions, FMUs
scenarios.pages         0.34 7 0.30 pages and templates
scenarios.bench         0.70 7 0.28 times and targets
scenarios.commands      0.00 8 0.98 the command line: parse, call, print
"""
_TOP = ("schema", "campaigns", "campaign_records", "extensions", "reading", "fileschema")
_IMPORTS = ("import ", "from ", "__all__")
TOP = {f"scenarios.{n}" for n in _TOP}


def folder_of(dotted: str) -> str:
    """Return the box that a module belongs to."""
    folder = ".".join(dotted.split(".")[:2])
    folder = "scenarios.registry" if folder in TOP else folder
    return "scenarios.commands" if folder == "scenarios.cli" else folder


def measured() -> tuple[dict[str, tuple[int, int]], set[tuple[str, str]]]:
    """Return files and lines of each box, and which imports which."""
    sizes: dict[str, tuple[int, int]] = {}
    arrows = set()
    for path in (p for top in PACKAGES for p in (ROOT / top).rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        if name.count(".") < 1 or name.endswith("__init__"):
            continue
        text, mine = path.read_text(encoding="utf-8"), folder_of(name)
        files, lines = sizes.get(mine, (0, 0))
        sizes[mine] = files + 1, lines + text.count("\n")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
                names = [f"{node.module}.{a.name}" for a in node.names]
                arrows |= {(mine, folder_of(n)) for n in names}
    return sizes, {(a, b) for a, b in arrows if a != b}


def reduced(arrows: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Leave out the arrows that a way over other boxes says, too."""
    reach = set(arrows)
    while True:
        more = {(a, d) for a, b in reach for c, d in reach if b == c} - reach
        if not more:
            break
        reach |= more
    return {
        (a, c)
        for a, c in arrows
        if not any((a, b) in arrows and (b, c) in reach for b in {x for _, x in arrows} - {a, c})
    }


def lines(path: Path) -> Counter[str]:
    """Return how many lines of a file are of which kind."""
    text = path.read_text(encoding="utf-8")
    bare = [x.strip() for x in text.splitlines()]
    kinds = ["blank" if not x else "comment" if x.startswith("#") else "code" for x in bare]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            kind, end = "signature", node.body[0].lineno - 1
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            kind, end = "docstring", node.end_lineno
        elif isinstance(node, ast.stmt) and bare[node.lineno - 1].startswith(_IMPORTS):
            kind, end = "import", node.end_lineno
        else:
            continue
        for k in range(node.lineno - 1, end):
            if kind == "docstring" or kinds[k] == "code":
                kinds[k] = kind
    return Counter(kinds)


def main() -> None:
    """Write ``docs/images/house.png``."""
    sizes, arrows = measured()
    rows = [line.split(None, 4) for line in BOXES.strip().splitlines()]
    at = {n: (float(x), int(y), float(w)) for n, x, y, w, _ in rows}
    with drawing({**STYLE, "axes.grid": False}):
        figure = new_figure(7.5)
        ax = figure.add_axes((0.01, 0.01, 0.98, 0.98))
        ax.set(xlim=(-0.01, 1.0), ylim=(-0.1, 9.0))
        ax.axis("off")
        colours = dict(zip(PACKAGES, LINE_INK, strict=False))
        for name, *_, text in rows:
            x, y, w = at[name]
            files, lines = sizes.get(name, (0, 0))
            colour = colours[name.split(".")[0]]
            box = {"facecolor": "white", "edgecolor": colour, "linewidth": 1.4, "zorder": 2}
            ax.add_patch(_rectangle(x, y, w, box))
            title = name if w > 0.2 else name.split(".")[1]
            ax.text(x + w / 2, y + 0.44, title, ha="center", weight="bold", color=colour, zorder=3)
            ax.text(x + w / 2, y + 0.25, text, ha="center", fontsize=7.5, color=INK, zorder=3)
            ax.text(
                x + w / 2,
                y + 0.08,
                f"{files} files, {lines} lines",
                ha="center",
                fontsize=7,
                color=MUTED,
                zorder=3,
            )
        for a, b in sorted(reduced({(a, b) for a, b in arrows if a in at and b in at})):
            (xa, ya, wa), (xb, yb, wb) = at[a], at[b]
            left, right = max(xa, xb), min(xa + wa, xb + wb)
            x = (left + right) / 2 if right > left else None
            start = (x or xa + wa / 2, ya)
            end = (x or xb + wb / 2, yb + 0.62)
            style = {"arrowstyle": "-|>", "color": MUTED, "linewidth": 0.9}
            ax.annotate("", end, start, arrowprops=style, zorder=1)
        figure.savefig(ROOT / "docs" / "images" / "house.png", dpi=120, facecolor="white")


def _rectangle(x: float, y: float, w: float, look: dict[str, object]) -> object:
    from matplotlib.patches import FancyBboxPatch

    return FancyBboxPatch((x, y), w, 0.62, boxstyle="round,pad=0,rounding_size=0.01", **look)


if __name__ == "__main__":
    if "--lines" in sys.argv:
        for top in (*PACKAGES, "tests"):
            files = sorted((ROOT / top).rglob("*.py"))
            found = sum((lines(path) for path in files), Counter())
            print(f"{top}: {len(files)} files, {found.total()} lines:", dict(found.most_common()))
    else:
        main()
