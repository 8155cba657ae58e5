"""Sphinx extension of this site: pages made from the code, and formulas as MathML.

MathML is drawn by the browser itself, so that the site needs no network.
"""

from argparse import _SubParsersAction
from pathlib import Path

import site_api
from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

from apu_casadi.core import files
from scenarios import cli
from scenarios.fileschema import file_schema

HERE = Path(__file__).parent


def bounds(node: dict) -> str:
    """Return type and bounds of a value of a JSON schema, in words."""
    if "const" in node:
        return f"`{node['const']}`"
    if "enum" in node:
        return ", ".join(f"`{v}`" for v in node["enum"])
    if "$ref" in node:
        name = node["$ref"].rsplit("/", 1)[-1]
        return f"[{name}](#{name.lower().replace('_', '-')})"
    for word in ("anyOf", "oneOf"):
        if word in node:
            return " or ".join(dict.fromkeys(bounds(n) for n in node[word]))
    if node.get("type") == "array":
        return f"list of {bounds(node.get('items', {}))}"
    low = node.get("minimum", node.get("exclusiveMinimum"))
    high = node.get("maximum", node.get("exclusiveMaximum"))
    ends = [
        f"{'>' if 'exclusiveMinimum' in node else '>='} {low:g}" if low is not None else "",
        f"{'<' if 'exclusiveMaximum' in node else '<='} {high:g}" if high is not None else "",
    ]
    kind = node.get("type", "table" if "properties" in node else "")
    kind = " or ".join(kind) if isinstance(kind, list) else kind.replace("object", "table")
    return " ".join([kind, ", ".join(e for e in ends if e)]).strip()


def rows(node: dict) -> list[str]:
    """Return the keys of an object of a JSON schema as lines of a table."""
    needed, lines = node.get("required", ()), []
    for key, value in node.get("properties", {}).items():
        text = " ".join(value.get("description", "").replace("|", "\\|").split())
        mark = " (needed)" if key in needed else ""
        lines.append(f"| `{key}`{mark} | {bounds(value)} | {text} |")
    return ["| key | value | meaning |", "| --- | --- | --- |", *lines, ""] if lines else []


def objects(node: dict) -> list[dict]:
    """Return the objects that a value may be: itself, those of a choice, or of a list's items."""
    if "properties" in node:
        return [node]
    inner = [*node.get("anyOf", ()), *node.get("oneOf", ())]
    inner += [node["items"]] if "items" in node else []
    return [o for n in inner for o in objects(n)]


def scenario_page(schema: dict) -> str:
    """Return the reference of the scenario file, from its schema."""
    text = ["# The scenario file", "", "Made from the schema that `apu list --schema` prints.", ""]
    text += rows(schema)
    for key, value in schema["properties"].items():
        for o in objects(value):
            text += [f"## `{key}`", "", value.get("description", ""), "", *rows(o)]
    for name, value in schema["definitions"].items():
        text += [f"## {name}", "", value.get("description", ""), ""]
        found = objects(value)
        if not found:
            text += [bounds(value), ""]
        for o in found:
            about = o.get("title") or o.get("description") or ""
            text += [about if about != value.get("description") else "", "", *rows(o)]
    return "\n".join(text)


def commands_page() -> str:
    """Return the help of every command, as the command prints it."""
    parser = cli.parser()
    subs = next(a for a in parser._actions if isinstance(a, _SubParsersAction))
    text = ["# Commands", "", "```text", parser.format_help(), "```", ""]
    for name, sub in subs.choices.items():
        text += [f"## apu {name}", "", "```text", sub.format_help(), "```", ""]
    return "\n".join(text)


def write_pages(app: Sphinx) -> None:
    """Make the pages that the code knows best; they are no part of the repository."""
    pages = {"scenario.md": scenario_page(file_schema()), "commands.md": commands_page()}
    for path in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        pages[f"notebooks/{path.name}"] = path.read_text(encoding="utf-8")
    write_folder(HERE / "made", pages)
    if "reference/api.md" not in app.config.exclude_patterns:
        write_folder(HERE / "reference/made", site_api.pages(HERE.parent))


def write_folder(folder: Path, pages: dict[str, str]) -> None:
    """Write the pages that have changed, and remove those that are none any more."""
    for path in folder.rglob("*.*"):
        if path.relative_to(folder).as_posix() not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            files.write_text(path, text)


def lead(app: Sphinx, name: str, source: list[str]) -> None:
    """Let links to pages beside ``docs`` lead to where the site has them."""
    for page in ("VALIDATION", "ESTIMATION", "BENCHMARKS", "CHANGELOG"):
        source[0] = source[0].replace(f"](../{page}.md", f"](reference/{page.lower()}.md")


def inline(self, node) -> None:
    """Write a formula within a line."""
    self.body.append(convert(node.astext()))
    raise nodes.SkipNode


def block(self, node) -> None:
    """Write a formula on a line of its own, with its number."""
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    label = f' id="{node["ids"][0]}"' if node.get("ids") else ""
    body = convert(node.astext(), display="block")
    self.body.append(f'<div class="math"{label}>{number}{body}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict:
    """Register both."""
    app.add_html_math_renderer(
        "mathml", inline_renderers=(inline, None), block_renderers=(block, None)
    )
    app.connect("builder-inited", write_pages)
    app.connect("source-read", lead)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
