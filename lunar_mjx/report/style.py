"""One visual language for every figure: colours told apart without colour vision and in grey, units on every axis."""

from __future__ import annotations

from typing import Any, NamedTuple

import plotly.graph_objects as go

INK, MUTED, RULE, PAPER = "#1b1f24", "#57606a", "#d0d7de", "#ffffff"
DARK = {INK: "#e6edf3", MUTED: "#9aa4ae", RULE: "#39414a", PAPER: "#0d1117"}
"""What takes the place of each of these colours on a dark page."""
FONT = "system-ui, -apple-system, 'Segoe UI', Helvetica, Arial, sans-serif"


class Series(NamedTuple):
    """How one model or rover is drawn everywhere: colour, line dash and marker differ together, so grey suffices."""

    colour: str
    dash: str
    symbol: str


# Okabe & Ito's palette, ordered by lightness: dark, middle, light.
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#7A3E68", "#56B4E9"

MEASURED = Series(INK, "solid", "circle")
SERIES: tuple[Series, ...] = (
    Series(ORANGE, "dot", "triangle-up"),
    Series(BLUE, "dash", "square"),
    Series(VERMILION, "solid", "diamond"),
    Series(GREEN, "dashdot", "cross"),
    Series(PURPLE, "longdash", "x"),
    Series(SKY, "longdashdot", "star"),
)


def faded(colour: str, alpha: float) -> str:
    """The colour with an opacity, for bands."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha:g})"


def finish(figure: go.Figure, height: int, **layout: Any) -> go.Figure:
    """Applies the common look to a figure."""
    axis = {
        "gridcolor": RULE,
        "linecolor": MUTED,
        "zeroline": False,
        "ticks": "outside",
        "tickcolor": RULE,
        "title": {"standoff": 6},
    }
    figure.update_layout(
        template="none",
        height=height,
        font={"family": FONT, "size": 13, "color": INK},
        paper_bgcolor=PAPER,
        plot_bgcolor=PAPER,
        margin={"l": 62, "r": 16, "t": 60, "b": 52},
        hovermode="closest",
        legend={"orientation": "h", "x": 0.0, "y": 1.02, "yanchor": "bottom", "itemsizing": "constant"},
    )
    figure.update_layout(**layout)
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
    figure.update_annotations(font={"size": 13, "color": INK})
    return figure
