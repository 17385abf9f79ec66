"""The figures of the demonstration."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from PIL import Image
from plotly.subplots import make_subplots

from lunar_mjx.cameras.relief import relief, ring, rocks_within
from lunar_mjx.criticism import SteadyStateTable, replicate_scatter
from lunar_mjx.demo.drive import Drive
from lunar_mjx.demo.husky import HuskyCase
from lunar_mjx.demo.wheel import Case, dense_curves
from lunar_mjx.report.style import BLUE, INK, MEASURED, ROCK, SERIES, VERMILION, Series, faded, finish
from lunar_mjx.terrain import Terrain
from lunar_mjx.wheel_bed.soil_fit import SOIL_FIT

ROVERS = {"viper": ("VIPER", BLUE), "luvmi_x": ("LUVMI-X", VERMILION)}
_MARGIN = 5.0
"""Ground that is drawn beyond the given ranges, on every side, m."""

CASE_STYLE: dict[str, Series] = {
    "paper": SERIES[0],
    "consistent": SERIES[1],
    "paper, refitted": SERIES[4],
    "consistent, refitted": SERIES[2],
}
WHEEL_ROWS = (
    ("drawbar_pull", "drawbar pull, N", 1.0),
    ("side_force", "side force, N", 1.0),
    ("sinkage", "sinkage, mm", 1e3),
)


def paths_figure(drives: Sequence[Drive], terrain: Terrain) -> go.Figure:
    """The rovers' paths on the shaded relief of the ground that they cover."""
    figure = go.Figure()
    xs, ys = (np.concatenate([getattr(d, k).ravel() for d in drives]) for k in ("x", "y"))
    image, box = _relief(terrain, (xs.min(), xs.max()), (ys.min(), ys.max()))
    west, east, south, north = box
    figure.add_layout_image(
        source=image,
        xref="x",
        yref="y",
        x=west,
        y=north,
        sizex=east - west,
        sizey=north - south,
        sizing="stretch",
        layer="below",
    )
    _add_rocks(figure, terrain, box)
    for d in drives:
        name, colour = ROVERS.get(d.rover, (d.rover, INK))
        for i in range(d.x.shape[1]):
            figure.add_scatter(
                # Twice a second and to a millimetre: more is not seen, and every number makes the page larger.
                x=d.x[::5, i].round(3),
                y=d.y[::5, i].round(3),
                mode="lines",
                name=name,
                legendgroup=name,
                showlegend=i == 0,
                line={"color": colour, "width": 3},
                hovertemplate=f"{name} {i + 1}<extra></extra>",
            )
        figure.add_scatter(
            x=d.x[0].round(3),
            y=d.y[0].round(3),
            mode="markers",
            name=f"start of {name}",
            hoverinfo="skip",
            marker={
                "symbol": "circle" if d.rover == "viper" else "square",
                "size": 8,
                "color": "white",
                "line": {"color": colour, "width": 2},
            },
        )
    finish(figure, 640, margin={"l": 52, "r": 36, "t": 64, "b": 46})
    # One scale for both axes, or paths and rocks would be distorted.
    figure.update_xaxes(title_text="east, m", range=[west, east], constrain="domain", showgrid=False)
    figure.update_yaxes(
        title_text="north, m", range=[south, north], scaleanchor="x", constrain="domain", showgrid=False
    )
    return figure


def _relief(
    terrain: Terrain, x: tuple[float, float], y: tuple[float, float]
) -> tuple[str, tuple[float, float, float, float]]:
    """Shaded relief as a PNG data URI, and its west, east, south and north, m."""
    low, high = (np.array([x[i], y[i]]) + margin for i, margin in ((0, -_MARGIN), (1, _MARGIN)))
    ground = relief(terrain, low, high)
    file = io.BytesIO()
    # A picture begins with its top row, the ground with its south.
    Image.fromarray((255 * ground.grey[::-1]).astype(np.uint8)).save(file, "PNG", optimize=True)
    # Within the page, which must open without a network and travel as one file.
    uri = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")
    return uri, (ground.west, ground.east, ground.south, ground.north)


def _drawn(stone: np.ndarray) -> dict[str, Any]:
    """An outline of `rocks_within` as a shape of Plotly, which turns no ellipses."""
    x, y, a, b, _ = stone
    if a == b:
        return {"type": "circle", "x0": x - a, "x1": x + a, "y0": y - a, "y1": y + a}
    return {"type": "path", "path": "M" + "L".join(f"{u:.3f},{v:.3f}" for u, v in ring(stone)) + "Z"}


def _add_rocks(figure: go.Figure, terrain: Terrain, box: tuple[float, float, float, float]) -> None:
    if terrain.rocks is None:
        return
    # Shapes, since a marker keeps its size on the screen when one zooms in.
    shapes = [
        {**_drawn(stone), "line": {"width": 0.5}, "fillcolor": ROCK}
        for stone in rocks_within(terrain, np.array([box[0], box[2]]), np.array([box[1], box[3]]))
    ]
    figure.update_layout(shapes=shapes)
    if shapes:
        figure.add_scatter(x=[None], y=[None], mode="markers", name="rock", marker={"color": ROCK, "size": 9})


CASE_LABELS = {
    "paper": "seed paper's equations, nominal soil",
    "paper, refitted": "seed paper's equations, soil refitted",
    "consistent": "corrected equations, nominal soil",
    "consistent, refitted": "corrected equations, soil refitted",
}
"""What the page calls each wheel model."""


def headline_figure(cases: Sequence[Case]) -> go.Figure:
    """How far each wheel model is from the measurements that no fit saw, in scatter of single runs; 1 is perfect."""
    names = [CASE_LABELS.get(c.name, c.name).replace(", ", ",<br>") for c in cases]  # so that a phone shows it whole
    figure = go.Figure()
    # numbers stand on two sides, for the marks may lie close to each other
    for key, label, look, side in (
        ("held out, inside", "angles between the fitted", SERIES[1], "top center"),
        ("held out, beyond", "angles beyond the fitted", SERIES[2], "bottom center"),
    ):
        values = [c.scores()[key] for c in cases]
        figure.add_scatter(
            x=values,
            y=names,
            mode="markers+text",
            name=label,
            text=[f"{v:.1f}" for v in values],
            textposition=side,
            cliponaxis=False,
            hovertemplate="%{y}: %{x:.1f}<extra></extra>",
            marker={"color": look.colour, "symbol": look.symbol, "size": 13, "line": {"color": INK, "width": 1}},
        )
    finish(figure, 110 + 52 * len(names), margin={"l": 24, "r": 36, "t": 48, "b": 52})
    figure.add_scatter(
        x=[1.0, 1.0],
        y=[names[0], names[-1]],
        mode="lines",
        name="a repeated run",
        hoverinfo="skip",
        line={"color": MEASURED.colour, "width": 3},
    )
    figure.update_xaxes(
        type="log", title_text="error, in scatter of single runs", range=[-0.12, 1.9], tickvals=[1, 2, 5, 10, 20, 50]
    )
    # Half a row of room at both ends, for the numbers above the first and below the last.
    figure.update_yaxes(type="category", range=[len(names) - 0.4, -0.6], automargin=True, showgrid=False)
    return figure


def husky_figure(case: HuskyCase) -> go.Figure:
    """The current of a real Husky's left motor on sandy loam, measured and by the model before and after."""
    figure = go.Figure()
    for name, values, look in (
        ("as fitted on the floor", case.before, SERIES[1]),
        ("with soft ground", case.after, SERIES[2]),
    ):
        figure.add_scatter(
            x=case.time.round(2),
            y=values.round(2),
            mode="lines",
            name=name,
            line={"color": look.colour, "dash": look.dash, "width": 2},
            hovertemplate=f"{name}: %{{y:.1f}} A<extra></extra>",
        )
    figure.add_scatter(
        x=case.time.round(2),
        y=case.measured.round(2),
        mode="markers",
        name="measured",
        marker={"color": MEASURED.colour, "size": 5, "symbol": MEASURED.symbol},
        hovertemplate="measured: %{y:.1f} A<extra></extra>",
    )
    finish(figure, 360, margin={"l": 60, "r": 36, "t": 48, "b": 52})
    figure.update_xaxes(title_text="time, s")
    figure.update_yaxes(title_text="current of the left motor, A", rangemode="tozero")
    return figure


def history_figure(drives: Sequence[Drive], individuals: int = 3) -> go.Figure:
    """Slip, sinkage and winding temperature over time: median and range over the batch, and a few individuals."""
    rows = ("mean slip", "deepest sinkage, mm", "hottest winding, °C")
    figure = make_subplots(
        rows=3,
        cols=len(drives),
        shared_xaxes=True,
        vertical_spacing=0.05,
        horizontal_spacing=0.12,
        column_titles=[ROVERS.get(d.rover, (d.rover, INK))[0] for d in drives],
    )
    for column, d in enumerate(drives, 1):
        colour = ROVERS.get(d.rover, (d.rover, INK))[1]
        for row, values in enumerate((d.mean_slip, 1e3 * d.sinkage.max(axis=-1), d.winding_degC), 1):
            _band(figure, d.time, values, colour, row, column, individuals, legend=row == 1 and column == 1)
    finish(figure, 640, margin={"l": 62, "r": 36, "t": 84, "b": 46})
    figure.update_layout(legend={"y": 1.06})
    for row, title in enumerate(rows, 1):
        figure.update_yaxes(title_text=title, row=row, col=1)
    figure.update_xaxes(title_text="time, s", row=3)
    return figure


def _band(figure, time, values, colour, row, column, individuals, legend) -> None:
    """One panel. Slip is not a number until the wheels roll; the band then starts later."""
    known = np.isfinite(values).any(axis=1)
    # Few digits: every number stands in the page as text.
    time, values = time[known].round(3), values[known]
    low, middle, high = (f(values, axis=1).round(4) for f in (np.nanmin, np.nanmedian, np.nanmax))
    place = {"row": row, "col": column}
    figure.add_scatter(x=time, y=high, mode="lines", line={"width": 0}, showlegend=False, hoverinfo="skip", **place)
    figure.add_scatter(
        x=time,
        y=low,
        mode="lines",
        line={"width": 0},
        fill="tonexty",
        fillcolor=faded(colour, 0.2),
        name="range over the batch",
        showlegend=legend,
        hoverinfo="skip",
        **place,
    )
    for i in range(min(individuals, values.shape[1])):
        figure.add_scatter(
            x=time,
            y=values[:, i].round(4),
            mode="lines",
            name="single rovers",
            showlegend=legend and i == 0,
            legendgroup="single",
            line={"color": faded(colour, 0.65), "width": 1, "dash": ("solid", "dot", "dash")[i % 3]},
            hovertemplate=f"rover {i + 1}: %{{y}}<extra></extra>",
            **place,
        )
    figure.add_scatter(
        x=time,
        y=middle,
        mode="lines",
        name="median",
        line={"color": INK, "width": 2.5},
        showlegend=legend,
        hovertemplate="median: %{y}<extra></extra>",
        **place,
    )


def _split_of(angle_deg: float) -> str:
    """Whether the points at a slip angle were fitted."""
    for angles, name in ((SOIL_FIT.fit_angles, "fitted"), (SOIL_FIT.apart_angles, "set apart")):
        if any(abs(angle_deg - a) < 0.01 for a in angles):
            return name
    return "held out"


def wheel_figure(cases: Sequence[Case], table: SteadyStateTable, angles: Sequence[float], beds: Sequence) -> go.Figure:
    """Drawbar pull, side force and sinkage over slip, a column per slip angle; error bars: replicates."""
    rows = [row for row in WHEEL_ROWS if row[0] in table.measured]
    scatter = replicate_scatter()
    # All curves first: their range sets the axes, which all columns share.
    curves = [dense_curves(bed, table, angles) for bed in beds]
    figure = make_subplots(
        rows=len(rows),
        cols=len(angles),
        shared_xaxes=True,
        shared_yaxes=True,
        vertical_spacing=0.035,
        horizontal_spacing=0.012,
        column_titles=[f"{a:g}°<br>{_split_of(a)}" for a in angles],
    )
    for column, angle in enumerate(angles, 1):
        at_angle = np.abs(table.test["slip_angle_deg"] - angle) < 0.01
        for row, (quantity, _, scale) in enumerate(rows, 1):
            place, legend = {"row": row, "col": column}, row == 1 and column == 1
            for case, curve in zip(cases, curves, strict=True):
                # A case is drawn alike in all panels, and stands once in the legend.
                style = CASE_STYLE.get(case.name, SERIES[3])
                figure.add_scatter(
                    x=curve["slip_ratio"].round(3),
                    y=(scale * curve[quantity][column - 1]).round(3),
                    mode="lines",
                    name=CASE_LABELS.get(case.name, case.name),
                    line={"color": style.colour, "dash": style.dash, "width": 2},
                    showlegend=legend,
                    legendgroup=case.name,
                    hovertemplate=f"{case.name}: %{{y}}<extra></extra>",
                    **place,
                )
            figure.add_scatter(
                x=table.test["slip_ratio"][at_angle].round(3),
                y=(scale * table.measured[quantity][at_angle]).round(3),
                error_y={
                    "type": "data",
                    "array": (scale * scatter[quantity][at_angle]).round(3),
                    "thickness": 1.2,
                    "width": 3,
                },
                mode="markers",
                name="measured (mean and scatter of 3 runs)",
                showlegend=legend,
                legendgroup="measured",
                marker={"color": MEASURED.colour, "size": 6, "symbol": MEASURED.symbol},
                hovertemplate="measured: %{y}<extra></extra>",
                **place,
            )
    finish(figure, 820, margin={"l": 66, "r": 36, "t": 130, "b": 52})
    figure.update_layout(legend={"y": 1.08})
    # what no fit saw stands on a tinted ground
    for column, angle in enumerate(angles, 1):
        for row in range(1, len(rows) + 1) if _split_of(angle) != "fitted" else ():
            at = (row - 1) * len(angles) + column
            axes = "" if at == 1 else str(at)
            figure.add_shape(
                type="rect",
                xref=f"x{axes} domain",
                yref=f"y{axes} domain",
                x0=0,
                x1=1,
                y0=0,
                y1=1,
                line={"width": 0},
                fillcolor=faded(BLUE, 0.08),
                layer="below",
            )
    for row, (_, title, _) in enumerate(rows, 1):
        figure.update_yaxes(title_text=title, row=row, col=1)
    for row, (quantity, _, scale) in enumerate(rows, 1):
        drawn = np.concatenate([c[quantity].ravel() for c in curves] + [table.measured[quantity]]) * scale
        low, high = float(drawn.min()), float(drawn.max())
        # A little room, so that no mark is cut by the frame.
        edge = 0.06 * (high - low)
        figure.update_yaxes(range=[low - edge, high + edge], row=row)
    figure.update_xaxes(dtick=0.5, range=[-1.08, 1.0])
    figure.update_xaxes(title_text="slip ratio", row=len(rows))
    return figure
