"""One visual language for every figure: colours told apart without colour vision and in grey, units on every axis."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import plotly.graph_objects as go

from lunar_mjx.files import replacing

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


LINES: tuple[tuple[str, Any], ...] = (
    (BLUE, "-"),
    (VERMILION, "--"),
    (GREEN, "-."),
    (ORANGE, ":"),
    (PURPLE, (0, (8, 2))),
    (SKY, (0, (8, 2, 1, 2, 1, 2))),
)
"""Colour and line of the first, second, ... line of a plot that names no styles: in grey the line tells them apart."""
ROCK, SHADOW, LIT = "#3a3a3a", "#000000", "#fffffe"
"""What is drawn on pictures of the ground: rocks, outlines on bright ground, and marks on dark ground.

Pictures stay what they are on a dark page, and marks on them too: so white marks are not quite `PAPER`."""
HEIGHTS, HEIGHTS_DOWN, RELIEF, SHARES = "cividis", "cividis_r", "gray", "Greys"
"""Colour maps: of numbers, which rise in lightness alike for all eyes; of shaded ground; of counts."""
SHADES = ((0.0, "#f7fbff"), (0.25, "#c6dbef"), (0.5, "#6baed6"), (0.75, "#2171b5"), (1.0, "#08306b"))
"""From none to much, in one hue: how far the darkness goes is what counts."""
DARK_SHADES = ("#15202b", "#173a56", "#1b5f8f", "#3f94c9", "#a8d8f5")
"""Shades from none to much on a dark page, where more is lighter."""
DARK_SERIES = {BLUE: SKY, PURPLE: "#CC79A7", SKY: BLUE}
"""What takes the place of colours that sink into a dark page."""
DARK_FIGURES = {**DARK, **DARK_SERIES, **{light: dark for (_, light), dark in zip(SHADES, DARK_SHADES, strict=True)}}
"""What takes the place of every colour of a figure on a dark page."""
SANS = ("Helvetica", "Arial", "DejaVu Sans")
"""Fonts of figures that are files; the last one comes with Matplotlib."""


def figure_style(dark: bool = False) -> dict[str, Any]:
    """Matplotlib's settings of every figure.

    Args:
      dark: for a dark page.
    """
    from cycler import cycler

    ink, muted, rule, paper = (DARK[c] if dark else c for c in (INK, MUTED, RULE, PAPER))
    colours = [DARK_SERIES.get(c, c) if dark else c for c, _ in LINES]
    return {
        "font.family": "sans-serif",
        "font.sans-serif": list(SANS),
        "figure.facecolor": paper,
        "savefig.facecolor": paper,
        "axes.facecolor": paper,
        "axes.edgecolor": muted,
        "axes.labelcolor": ink,
        "axes.titlelocation": "left",
        "axes.titlesize": 10,
        "axes.labelsize": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.prop_cycle": cycler(color=colours) + cycler(linestyle=[line for _, line in LINES]),
        "grid.color": rule,
        "grid.linewidth": 0.6,
        "text.color": ink,
        "xtick.color": muted,
        "ytick.color": muted,
        "xtick.labelsize": 8,
        "ytick.labelsize": 8,
        "legend.frameon": False,
        "legend.fontsize": 8,
        "image.cmap": HEIGHTS,
        # Letters stay letters, which a reader can search and copy.
        "svg.fonttype": "none",
    }


@contextmanager
def styled(dark: bool = False) -> Iterator[None]:
    """Draws with Matplotlib in the common style, as `with styled():` or as a decorator `@styled()`."""
    import matplotlib

    settings: dict[Any, Any] = figure_style(dark)
    with matplotlib.rc_context(settings):
        yield


def darkened(figure: Any) -> Any:
    """A Matplotlib figure as it looks on a dark page; it is changed, and returned.

    Every colour of `DARK_FIGURES` gives way to what takes its place; pictures and colour maps stay.
    """
    from matplotlib.colors import to_hex, to_rgba, to_rgba_array

    swap = {to_hex(light): dark for light, dark in DARK_FIGURES.items()}
    for artist in figure.findobj():
        if getattr(artist, "get_array", lambda: None)() is not None:
            continue
        names = ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor")
        getters = {name: getattr(artist, f"get_{name}", None) for name in names}
        # All are read before one is set: a marker follows its line, and would be swapped twice.
        colours = {name: to_rgba_array(get()) for name, get in getters.items() if get is not None}
        for name, found in colours.items():
            put = getattr(artist, f"set_{name}", None)
            new = [to_rgba(swap[to_hex(c)], c[3]) if to_hex(c) in swap else tuple(c) for c in found]
            if put is not None and any(a != tuple(b) for a, b in zip(new, found, strict=True)):
                # Lines take one colour alone, collections a list of them.
                put(new if len(new) > 1 else new[0])
    return figure


def save_light_and_dark(figure: Any, path: str | Path, **options: Any) -> list[Path]:
    """Writes a Matplotlib figure as `NAME.png` and, in the colours of a dark page, as `NAME_dark.png`.

    Args:
      figure: which is dark thereafter. path: of the light picture; its ending tells the format.
      options: of `Figure.savefig`, such as `dpi`.

    Returns:
      Both paths, the light one first.
    """
    light = Path(path)
    dark = light.with_name(f"{light.stem}_dark{light.suffix}")
    with replacing(light) as part:
        figure.savefig(part, **options)
    # One figure in other colours, so that both pages show the same numbers.
    darkened(figure)
    with replacing(dark) as part:
        figure.savefig(part, facecolor=figure.get_facecolor(), **options)
    return [light, dark]


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
        margin={"l": 62, "r": 36, "t": 60, "b": 52},
        hovermode="closest",
        legend={"orientation": "h", "x": 0.0, "y": 1.02, "yanchor": "bottom", "itemsizing": "constant"},
        # in a row they would cover the legend's last words; in the right margin they cover nothing
        modebar={"orientation": "v"},
    )
    # After the common layout, whose settings a figure's own replace.
    figure.update_layout(**layout)
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
    figure.update_annotations(font={"size": 13, "color": INK})
    return figure
