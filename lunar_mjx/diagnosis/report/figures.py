"""Figures of the report: waterfall of the error, ports, isolability, shapes of missing effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from lunar_mjx.diagnosis.report.steps import Ceiling, Error, Step
from lunar_mjx.diagnosis.report.words import plot_text, port_label, shown
from lunar_mjx.report.style import BLUE, INK, MUTED, ORANGE, SKY, VERMILION, faded, finish

SHADES = ((0.0, "#f7fbff"), (0.25, "#c6dbef"), (0.5, "#6baed6"), (0.75, "#2171b5"), (1.0, "#08306b"))
"""One hue from light to dark: in grey it reads the same."""


def waterfall(
    steps: Sequence[Step], judged: Sequence[Error], fitted: Sequence[Error | None], measure: str, top: Ceiling | None
) -> go.Figure:
    """The error of each model of the chain, and what every step takes off or puts on."""
    labels = [plot_text(s.short, 80).replace("&lt;br&gt;", "<br>") for s in steps]
    x = [f"{i + 1}. {label}" for i, label in enumerate(labels)]
    value = np.array([e.value for e in judged])
    logarithmic = bool(value.max() > 15.0 * max(value.min(), 0.5))
    bottom = 0.5 * min(1.0, float(value.min())) if logarithmic else 0.0
    before = np.concatenate([[value[0]], value[:-1]])
    whole = np.zeros(len(value), bool)
    whole[[0, -1]] = True
    low = np.where(whole, bottom, np.minimum(value, before))
    high = np.where(whole, value, np.maximum(value, before))
    figure = go.Figure()
    for name, mask, colour, pattern in (
        ("error", whole, BLUE, ""),
        ("taken off by the step", ~whole & (value <= before), SKY, "\\"),
        ("put on by the step", ~whole & (value > before), VERMILION, "x"),
    ):
        if mask.any():
            figure.add_bar(
                x=[x[i] for i in np.flatnonzero(mask)],
                base=low[mask].tolist(),
                y=(high - low)[mask].tolist(),
                name=name,
                marker={
                    "color": colour,
                    "line": {"color": INK, "width": 1},
                    "pattern": {"shape": pattern, "fgcolor": INK, "fillmode": "overlay", "size": 7},
                },
                hoverinfo="skip",
            )
    figure.add_scatter(
        x=x,
        y=value.tolist(),
        mode="markers+text",
        name=f"{measure} manoeuvres, with 95 % interval",
        text=[f" {shown(v)}" for v in value],
        textposition="middle right",
        textfont={"size": 14},
        marker={"color": INK, "size": 9, "symbol": "diamond"},
        error_y=_interval(judged),
        hovertemplate="%{y:.4g} sigma<extra></extra>",
    )
    known = [(a, e) for a, e in zip(x, fitted, strict=True) if e is not None]
    if measure != "fitted" and known:
        figure.add_scatter(
            x=[a for a, _ in known],
            y=[e.value for _, e in known],
            mode="markers",
            name="fitted manoeuvres",
            marker={"color": ORANGE, "size": 11, "symbol": "triangle-up", "line": {"color": INK, "width": 1}},
            error_y=_interval([e for _, e in known]),
            hovertemplate="%{y:.4g} sigma<extra></extra>",
        )
    _level(figure, x, 1.0, "noise floor, 1 sigma", "solid")
    if top is not None:
        _level(figure, x, top.value, plot_text(f"ceiling, {shown(top.value)} sigma: {top.label}"), "dash")
    finish(figure, 480, barmode="overlay", bargap=0.45, margin={"t": 90, "b": 80, "l": 62, "r": 16})
    figure.update_yaxes(
        title_text="root mean square residual, sigma", type="log" if logarithmic else "linear", rangemode="tozero"
    )
    if logarithmic:
        most = max([e.high if np.isfinite(e.high) else e.value for e in (*judged, *(e for _, e in known))])
        figure.update_yaxes(range=[np.log10(bottom), np.log10(1.3 * most)], dtick="D2", minor={"ticks": "outside"})
    figure.update_xaxes(type="category", categoryorder="array", categoryarray=x)
    return figure


def _interval(errors: Sequence[Error]) -> dict:
    up = [e.high - e.value if np.isfinite(e.high) else 0.0 for e in errors]
    down = [e.value - e.low if np.isfinite(e.low) else 0.0 for e in errors]
    return {"type": "data", "array": up, "arrayminus": down, "color": INK, "thickness": 1.5, "width": 6}


def _level(figure: go.Figure, x: Sequence[str], y: float, name: str, dash: str) -> None:
    figure.add_scatter(
        x=[x[0], x[-1]] if len(x) > 1 else x,
        y=[y] * min(len(x), 2),
        mode="lines",
        name=name,
        line={"color": MUTED, "dash": dash, "width": 2},
        hoverinfo="skip",
    )
    figure.add_hline(y=y, line={"color": MUTED, "dash": dash, "width": 2})


def bars(values: Mapping[str, float | None], title: str, named: str = "") -> go.Figure:
    """Horizontal bars, largest first; the one of a name stands out."""
    items = sorted(((k, v or 0.0) for k, v in values.items()), key=lambda item: item[1])
    figure = go.Figure(
        go.Bar(
            x=[v for _, v in items],
            y=[plot_text(port_label(k)) for k, _ in items],
            orientation="h",
            text=[shown(v) for _, v in items],
            textposition="outside",
            cliponaxis=False,
            marker={
                "color": [BLUE if k == named else faded(BLUE, 0.35) for k, _ in items],
                "line": {"color": INK, "width": 1},
            },
            hovertemplate="%{y}: %{x:.4g}<extra></extra>",
        )
    )
    finish(figure, 90 + 26 * max(len(items), 2), margin={"l": 270, "r": 70, "t": 20, "b": 52}, showlegend=False)
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
