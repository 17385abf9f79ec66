"""Figures of the report: waterfall of the error, ports, isolability, shapes of missing effects."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from lunar_mjx.diagnosis.report.steps import Error, Step
from lunar_mjx.diagnosis.report.words import percent, plot_text, port_label, sigmas
from lunar_mjx.report.style import BLUE, INK, MUTED, ORANGE, SHADES, VERMILION, faded, finish


def waterfall(
    steps: Sequence[Step], judged: Sequence[Error], fitted: Sequence[Error | None], measure: str
) -> go.Figure:
    """The error of each model of the chain, a row each from the first to the last, with its interval."""
    names = [_row_name(f"{i}. {s.short.replace('<br>', ' ')}") for i, s in enumerate(steps, 1)]
    value = [e.value for e in judged]
    known = [(name, e) for name, e in zip(names, fitted, strict=True) if e is not None and measure != "fitted"]
    highest = max(e.high if np.isfinite(e.high) else e.value for e in (*judged, *(e for _, e in known)))
    # A linear axis would shrink the better models' bars to nothing beside a bad one's.
    logarithmic = bool(max(value) > 15.0 * max(min(value), 0.5))
    figure = go.Figure()
    figure.add_bar(
        x=value,
        y=names,
        orientation="h",
        width=0.5,
        name=f"{measure} manoeuvres, with 95 % interval",
        marker={
            "color": [faded(BLUE, 0.45)] * (len(value) - 1) + [faded(VERMILION, 0.6)],
            "line": {"color": INK, "width": 1},
        },
        error_x={**_interval(judged)},
        hovertemplate="%{x:.4g} sigma<extra></extra>",
    )
    if known:
        figure.add_scatter(
            x=[e.value for _, e in known],
            y=[name for name, _ in known],
            mode="markers",
            name="fitted manoeuvres",
            marker={"color": ORANGE, "size": 11, "symbol": "triangle-up", "line": {"color": INK, "width": 1}},
            hovertemplate="%{x:.4g} sigma<extra></extra>",
        )
    for name, e in zip(names, judged, strict=True):
        # numbers stand in a column of their own at the right, where no mark can be
        figure.add_annotation(
            xref="paper",
            x=1.01,
            y=name,
            text=f"<b>{sigmas(e.value)}</b> sigma",
            showarrow=False,
            xanchor="left",
            font={"size": 14},
        )
    floor = {"color": MUTED, "dash": "solid", "width": 2}
    name = "noise floor, 1 sigma"
    ends = [names[0], names[-1]]
    figure.add_scatter(x=[1.0, 1.0], y=ends, mode="lines", name=name, hoverinfo="skip", line=floor)
    figure.add_vline(x=1.0, line=floor)
    lines = max(name.count("<br>") + 1 for name in names)
    # at the right room for the numbers, and beside them for the buttons that come up on pointing
    finish(figure, 150 + max(42, 18 * lines) * len(names), margin={"t": 74, "b": 52, "l": 24, "r": 128})
    figure.update_yaxes(type="category", autorange="reversed", automargin=True, showgrid=False)
    figure.update_xaxes(
        title_text="error, sigma", type="log" if logarithmic else "linear", range=[0.0, 1.05 * max(highest, 1.2)]
    )
    if logarithmic:
        low = np.log10(0.5 * min(1.0, *value))
        figure.update_xaxes(range=[low, np.log10(1.2 * highest)], dtick="D2")
    return figure


_NAME_WIDTH = 26
"""Characters of a line of a row's name: on a phone, bars need more than half of the width."""


def _row_name(text: str) -> str:
    lines = textwrap.wrap(text, _NAME_WIDTH, break_long_words=False)
    lines = lines if len(lines) <= 4 else [*lines[:3], lines[3] + " …"]
    return "<br>".join(plot_text(line) for line in lines)


def _interval(errors: Sequence[Error]) -> dict:
    up = [e.high - e.value if np.isfinite(e.high) else 0.0 for e in errors]
    down = [e.value - e.low if np.isfinite(e.low) else 0.0 for e in errors]
    return {"type": "data", "array": up, "arrayminus": down, "color": INK, "thickness": 1.5, "width": 6}


def bars(values: Mapping[str, float | None], title: str, named: str = "") -> go.Figure:
    """Horizontal bars of probabilities in percent, largest first; the one of a name stands out."""
    ascending = sorted(((k, v or 0.0) for k, v in values.items()), key=lambda item: item[1])
    figure = go.Figure(
        go.Bar(
            x=[100.0 * v for _, v in ascending],
            y=[plot_text(port_label(k)) for k, _ in ascending],
            orientation="h",
            text=[percent(v) for _, v in ascending],
            textposition="outside",
            cliponaxis=False,
            marker={
                "color": [BLUE if k == named else faded(BLUE, 0.35) for k, _ in ascending],
                "line": {"color": INK, "width": 1},
            },
            hovertemplate="%{y}: %{x:.3g} %<extra></extra>",
        )
    )
    finish(figure, 90 + 26 * max(len(ascending), 2), margin={"l": 16, "r": 128, "t": 20, "b": 52}, showlegend=False)
    figure.update_yaxes(automargin=True)
    figure.update_xaxes(title_text=title)
    return figure


def isolability(table: Mapping[str, Mapping[str, float]]) -> go.Figure:
    """|cos| between projected signatures of every pair of effects."""
    names = list(table)
    z = [[table[a].get(b) for b in names] for a in names]
    labels = [plot_text(n) for n in names]
    text = [["" if v is None else f"{v:.2f}" for v in row] for row in z]
    figure = go.Figure(
        go.Heatmap(
            x=labels,
            y=labels,
            z=z,
            zmin=0.0,
            zmax=1.0,
            colorscale=SHADES,
            text=text,
            texttemplate="%{text}" if len(names) <= 24 else None,
            xgap=1,
            ygap=1,
            colorbar={"title": {"text": "|cos|"}},
            hovertemplate="%{y} and %{x}: %{z:.3f}<extra></extra>",
        )
    )
    finish(figure, 190 + 26 * len(names), margin={"l": 190, "r": 16, "t": 16, "b": 150})
    figure.update_yaxes(autorange="reversed", showgrid=False)
    figure.update_xaxes(tickangle=-45, showgrid=False)
    return figure
