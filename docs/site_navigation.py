"""The column at the left: every page, but of the API the branch that is read.

Sphinx makes the whole tree anew for each page, which takes the square of their number: four fifths
of the time of this site.  Here titles and children are asked once.
"""

from html import escape
from typing import Any

from sphinx import addnodes
from sphinx.application import Sphinx


class Tree:
    """Pages below the first one, by captions; children and parents of each."""

    def __init__(self, app: Sphinx) -> None:
        env = app.env
        self.titles = {doc: title.astext() for doc, title in env.titles.items()}
        for doc in (d for d in self.titles if d.startswith("reference/made/")):
            self.titles[doc] = self.titles[doc].rpartition(".")[2]  # the branch says the rest
        self.children: dict[str, list[str]] = {}
        self.parents: dict[str, str] = {}
        self.parts: list[tuple[str, list[str]]] = []
        for doc, toc in env.tocs.items():
            for node in toc.findall(addnodes.toctree):
                below = [ref for _, ref in node["entries"] if ref in self.titles]
                self.children.setdefault(doc, []).extend(below)
                self.parents.update(dict.fromkeys(below, doc))
                if doc == app.config.root_doc:
                    self.parts.append((node.get("caption") or "", below))

    def way(self, doc: str) -> list[str]:
        """Return a page and those above it."""
        found = [doc]
        while (above := self.parents.get(found[-1])) is not None and above not in found:
            found.append(above)
        return found


def listed(app: Sphinx, tree: Tree, docs: list[str], here: str, level: int) -> str:
    """Return pages as a list, with what is below those that lead to the one that is read."""
    way, lines = tree.way(here), []
    for doc in docs:
        on = "current " if doc in way else ""
        href = "#" if doc == here else app.builder.get_relative_uri(here, doc)
        link = f'<a class="{on}reference internal" href="{href}">{escape(tree.titles[doc])}</a>'
        below = tree.children.get(doc) if on else None
        inner = listed(app, tree, below, here, level + 1) if below else ""
        lines.append(f'<li class="toctree-l{level} {on.strip()}">{link}{inner}</li>')
    return f'<ul class="current">{"".join(lines)}</ul>'


def put(app: Sphinx, here: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Give the theme this tree where it asks for the whole one."""
    if (tree := getattr(app, "_tree_of_pages", None)) is None:
        tree = Tree(app)
        app._tree_of_pages = tree
    caption = '<p class="caption" role="heading"><span class="caption-text">{}</span></p>'
    html = "".join(
        caption.format(escape(name)) + listed(app, tree, docs, here, 1) for name, docs in tree.parts
    )
    context["toctree"] = lambda **how: html


def setup(app: Sphinx) -> dict[str, Any]:
    """Register it, before the theme asks."""
    app.connect("html-page-context", put, priority=400)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
