"""Self-contained report pages: one HTML file that opens offline, with every text escaped."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import plotly.graph_objects as go
import plotly.offline

from lunar_mjx.files import write_text
from lunar_mjx.report.style import DARK_FIGURES


class Figure(NamedTuple):
    """A figure with its caption.

    Attributes:
      figure: what is drawn. caption: stands below it.
      least: width in pixels below which its labels would collide; on a narrower screen it scrolls sideways.
    """

    figure: go.Figure
    caption: str = ""
    least: int = 0


class Pair(NamedTuple):
    """Two figures side by side where the page is wide enough, one above the other where it is not."""

    left: Figure
    right: Figure


class Lead(NamedTuple):
    """What a reader should know before anything else.

    Attributes:
      badge: one or two words, such as "effect named"; none if empty.
      tone: of the badge: "good", "open" or "bad".
      sentence: the finding in plain words.
      next: what to do now, a command or a sentence each.
    """

    badge: str
    tone: str
    sentence: str
    next: Sequence[str] = ()


class Explorer(NamedTuple):
    """Two figures: what is clicked in the first, or chosen from a list, is drawn in the second.

    Points of `figure` carry the key of a panel as their customdata. A panel holds "label" (in the list), "x" and "y",
    one list per trace of `detail` (x may be one list for all), "x_title" and "y_title" (text as plotly takes it). The
    first panel is shown at first. `least` is the width in pixels below which `figure` scrolls sideways.
    """

    figure: go.Figure
    detail: go.Figure
    panels: Mapping[str, Mapping[str, Any]]
    caption: str = ""
    least: int = 0


class Table(NamedTuple):
    """A table; numbers are given as text, in the digits to show. The first `texts` columns hold words.

    A `folded` table shows its caption alone until it is opened.
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    texts: int = 1
    folded: bool = False


class Text(NamedTuple):
    """Paragraphs of plain text."""

    paragraphs: Sequence[str]


class Facts(NamedTuple):
    """Names and values, as a definition list."""

    pairs: Sequence[tuple[str, str]]


Block = Figure | Pair | Explorer | Table | Text | Facts


class Section(NamedTuple):
    """One section of a report's page."""

    title: str
    blocks: Sequence[Block]


PLOT_CONFIG = {
    "displaylogo": False,
    "responsive": True,
    "showLink": False,
    # what is looked at stays on this machine: no button sends a chart to Plotly's servers, and none of them is known
    "plotlyServerURL": "",
    "modeBarButtonsToRemove": ["select2d", "lasso2d", "autoScale2d", "sendChartToCloud"],
}
"""How figures of pages are worked with."""


def _script() -> str:
    """plotly.js, compressed: the page stays far below 5 MB, and the browser unpacks it without any request."""
    return packed(plotly.offline.get_plotlyjs())


def packed(text: str) -> str:
    """Text as gzip in base64, which a page unpacks without any request."""
    # Without a time inside, so that the same report is the same bytes.
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode("ascii")


def _json(value: str) -> str:
    """JSON that cannot leave its script element."""
    # An HTML parser ends a script at </script> wherever it stands, also within a text of JSON.
    return value.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def write_page(
    path: Path, title: str, verdict: Sequence[str], sections: Sequence[Section], lead: Lead | None = None
) -> Path:
    """Writes a report.

    Args:
      path: of the HTML file.
      title: of the page.
      verdict: its findings in a sentence each; they come first.
      sections: the rest, in order.
      lead: stands above the findings: badge, plain sentence, what to do next.

    Returns:
      The path.
    """
    # Names come from users' files and are escaped; a name that a template lacks is an error and no silent gap.
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lunar_mjx.report", "templates"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    figures: list[str] = []
    shown = [{"title": s.title, "blocks": [_block(b, figures) for b in s.blocks]} for s in sections]
    html = environment.get_template("page.html.j2").render(
        title=title,
        lead=lead,
        verdict=verdict,
        sections=shown,
        figures=figures,
        config=_json(json.dumps(PLOT_CONFIG)),
        dark=_json(json.dumps(DARK_FIGURES)),
        plotly=_script(),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_text(path, html)


def _block(block: Block, figures: list[str]) -> dict[str, Any]:
    kind = type(block).__name__.lower()
    if isinstance(block, Figure):
        return {"kind": kind, "caption": block.caption, **_placed(block.figure, figures, block.least)}
    if isinstance(block, Pair):
        return {"kind": kind, "parts": [_block(part, figures) for part in block]}
    if isinstance(block, Explorer):
        return {
            "kind": kind,
            "caption": block.caption,
            "map": _placed(block.figure, figures, block.least),
            "detail": _placed(block.detail, figures),
            # NaN is no JSON: a browser would refuse all panels for one of them.
            "panels": packed(json.dumps(block.panels, allow_nan=False)),
            "choices": [(key, panel["label"]) for key, panel in block.panels.items()],
        }
    return {"kind": kind, **block._asdict()}


def _placed(figure: go.Figure, figures: list[str], least: int = 0) -> dict[str, int]:
    # Figures stand in the page's script, in one list: their place in it is what a block of HTML refers to.
    figures.append(_json(str(figure.to_json())))
    # Plotly's own height where a figure states none.
    return {"height": figure.layout.height or 450, "least": least, "index": len(figures) - 1}
