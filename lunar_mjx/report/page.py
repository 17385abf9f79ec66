"""Self-contained report pages: one HTML file that opens offline, with every text escaped."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import plotly.graph_objects as go
import plotly.offline


class Figure(NamedTuple):
    """A figure with its caption."""

    figure: go.Figure
    caption: str = ""


class Table(NamedTuple):
    """A table; numbers are given as text, in the digits to show. The first `texts` columns hold words."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    texts: int = 1


class Text(NamedTuple):
    """Paragraphs of plain text."""

    paragraphs: Sequence[str]


class Facts(NamedTuple):
    """Names and values, as a definition list."""

    pairs: Sequence[tuple[str, str]]


class Section(NamedTuple):
    """A part of a page."""

    title: str
    blocks: Sequence[Figure | Table | Text | Facts]


_CONFIG = {"displaylogo": False, "responsive": True, "showLink": False,
           "modeBarButtonsToRemove": ["select2d", "lasso2d", "autoScale2d"]}  # fmt: skip


def _script() -> str:
    """plotly.js, compressed: the page stays far below 5 MB, and the browser unpacks it without any request."""
    packed = gzip.compress(plotly.offline.get_plotlyjs().encode(), 9, mtime=0)
    return base64.b64encode(packed).decode("ascii")


def _json(value: str) -> str:
    """JSON that cannot leave its script element."""
    return value.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def write_page(path: Path, title: str, verdict: Sequence[str], sections: Sequence[Section]) -> Path:
    """Writes a report.

    Args:
      path: of the HTML file.
      title: of the page.
      verdict: its findings in a sentence each; they come first.
      sections: the rest, in order.

    Returns:
      The path.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lunar_mjx.report", "templates"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    figures: list[str] = []
    shown = [{"title": s.title, "blocks": [_block(b, figures) for b in s.blocks]} for s in sections]
    html = environment.get_template("page.html.j2").render(
        title=title,
        verdict=verdict,
        sections=shown,
        figures=figures,
        config=_json(json.dumps(_CONFIG)),
        plotly=_script(),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(html, encoding="utf-8")
    return path


def _block(block: Figure | Table | Text | Facts, figures: list[str]) -> dict[str, Any]:
    kind = type(block).__name__.lower()
    if not isinstance(block, Figure):
        return {"kind": kind, **block._asdict()}
    figures.append(_json(str(block.figure.to_json())))
    return {
        "kind": kind,
        "caption": block.caption,
        "height": block.figure.layout.height or 450,
        "index": len(figures) - 1,
    }
