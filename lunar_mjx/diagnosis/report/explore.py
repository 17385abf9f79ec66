"""Where a model fails, to look at: channels by manoeuvre, what residuals follow, shapes of missing effects."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike
from plotly.subplots import make_subplots

from lunar_mjx.diagnosis.report.figures import SHADES
from lunar_mjx.diagnosis.report.read import Result, Traces
from lunar_mjx.diagnosis.report.steps import Step
from lunar_mjx.diagnosis.report.words import SPLIT_NAMES, channel_label, plot_text, sigmas
from lunar_mjx.inference.observations import Observations
from lunar_mjx.logs.schema import is_quantity
from lunar_mjx.report.page import Block, Explorer, Figure
from lunar_mjx.report.style import BLUE, INK, MEASURED, MUTED, ORANGE, SERIES, faded, finish


@dataclasses.dataclass(frozen=True)
class ExploreSizes:
    """How much a page to explore holds."""

    most_values: int = 250_000
    """Numbers in the panels of one page; longer series are thinned."""
    # Bins of a covariate; observations that make a bin.
    bins: int = 16
    least: int = 8
    few: int = 4
    """Observations that make a shape."""
    lines: int = 5
    """Channels drawn over a covariate."""
    maps: int = 6
    """Models of a chain whose heat maps are shown; of longer chains the first five and the last."""
    channels: int = 24
    """Rows of a heat map: of more channels the worst."""
    name: int = 30
    """Letters of a manoeuvre's name that stand at a map."""
    shapes: int = 6
    """Effects in the gallery."""


EXPLORE = ExploreSizes()


def panels(steps: Sequence[Step]) -> list[Block]:
    """Heat maps of the residual, channel by manoeuvre, one for each model of a chain; a click shows the traces.

    All models must have been held against the same measurements.
    """
    o = steps[0].observations
    places = {(c, u): at for c, u, at in cells(o) if any(np.isfinite(s.residual[at]).any() for s in steps)}
    if not places:
        return []
    channels, units = list(dict.fromkeys(c for c, _ in places)), sorted({u for _, u in places})
    shown_steps = [*steps[: EXPLORE.maps - 1], steps[-1]] if len(steps) > EXPLORE.maps else list(steps)
    rms = [{key: _rms(s.residual[at]) for key, at in places.items()} for s in shown_steps]
    measured = len(channels)
    if measured > EXPLORE.channels:
        worst_of = {c: max(row[key] or 0.0 for row in rms for key in places if key[0] == c) for c in channels}
        kept = sorted(channels, key=lambda c: -worst_of[c])[: EXPLORE.channels]
        channels = [c for c in channels if c in kept]
    # One scale of shades for all maps: a field that fades from one to the next is an error that fell.
    most = max(v for row in rms for v in row.values() if v is not None)
    level = len(units) <= 8
    # seven pixels a letter: manoeuvres below, channels at the left
    wide = 20 + 7 * min(max(len(o.unit_names[u]) for u in units), EXPLORE.name)
    across = (wide if level else 44) * len(units)
    # A title may be as long as its map is wide; the line break is for the rows of the first figure.
    most_letters = max(80, across // 7)
    titles = [f"{_number(steps, s)}. {plot_text(s.short.replace('<br>', ' '), most_letters)}" for s in shown_steps]
    height = 24 * len(channels)
    gap = 34 / (height * len(rms) + 34 * (len(rms) - 1))
    figure = make_subplots(len(rms), 1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=gap)
    for n, channel_rms in enumerate(rms, 1):
        figure.add_heatmap(
            x=[_unit_label(o, u) for u in units],
            y=[plot_text(channel_label(c)) for c in channels],
            z=[[_depth(channel_rms.get((c, u))) for u in units] for c in channels],
            text=[
                [sigmas(channel_rms[c, u]) if channel_rms.get((c, u)) is not None else "" for u in units]
                for c in channels
            ],
            texttemplate="%{text}",
            customdata=[[_key(c, u) for u in units] for c in channels],
            colorscale=SHADES,
            zmin=np.log10(0.7),
            zmax=max(np.log10(3.0), np.log10(most)),
            showscale=False,
            xgap=1,
            ygap=1,
            hovertemplate="%{y}, %{x}: %{text} sigma<extra></extra>",
            row=n,
            col=1,
        )
    beside = 50 + 7 * max(len(plot_text(channel_label(c))) for c in channels)
    finish(figure, 100 + (height + 34) * len(rms), margin={"l": 16, "r": 36, "t": 36, "b": 64})
    figure.update_yaxes(autorange="reversed", showgrid=False, type="category", automargin=True)
    figure.update_xaxes(tickangle=0 if level else -45, showgrid=False, type="category", automargin=True)
    figure.update_annotations(x=0.0, xanchor="left")
    # Five numbers an observation: measured, and of two models what each says and leaves.
    thin = max(1, int(np.ceil(len(o) * 5 / EXPLORE.most_values)))
    # The worst first: the list opens with what there is to be explained.
    worst = sorted(places, key=lambda key: -(rms[0][key] or 0.0))
    models = _compared(steps)
    channel_rms = {_key(*key): _panel(models, *key, places[key][::thin]) for key in worst}
    left = f" {len(steps) - EXPLORE.maps} models in between are left out." if len(steps) > EXPLORE.maps else ""
    fewer = f" Of {measured} channels the {len(channels)} worst are shown." if measured > len(channels) else ""
    caption = (
        "Root mean square residual in sigma, 1 is the noise: one map for each model of the chain, in one scale of "
        f"shades.{left}{fewer} What is held out was never fitted. Click a field, or choose from the list, to see what "
        "was measured, what the models say, and what they leave."
    )
    return [Explorer(figure, _detail(models), channel_rms, caption, least=beside + across)]


def _number(steps: Sequence[Step], step: Step) -> int:
    return next(i for i, s in enumerate(steps, 1) if s is step)


def _rms(residual: np.ndarray) -> float | None:
    known = residual[np.isfinite(residual)]
    return float(np.sqrt(np.mean(known**2))) if known.size else None


def _depth(rms: float | None) -> float | None:
    """Shade of a field: the logarithm of its error, even below a third of the noise."""
    return None if rms is None else float(np.log10(max(rms, 0.3)))


def _unit_label(o: Observations, unit: int) -> str:
    """A manoeuvre's name, and below it whether it was held out."""
    split, name = o.unit_split[unit], plot_text(o.unit_names[unit], EXPLORE.name)
    return name if split == "fit" else f"{name}<br><i>{SPLIT_NAMES.get(split, split)}</i>"


def _compared(steps: Sequence[Step]) -> list[Step]:
    """The two models whose traces are drawn: the first refit of the chain, and its last model."""
    # Not the model as given: what an effect adds shows beside the best that the model can do without it.
    refits = [s for s in steps if s.short == "refitted"]
    first = refits[0] if refits else steps[0]
    return [first] if first is steps[-1] else [first, steps[-1]]


def dependence(result: Result) -> list[Block]:
    """Mean residual over what it might follow: slip, angle and load, or time, place, speed, slope and temperature."""
    traces = result.traces
    if traces is None:
        return []
    residual = traces.residual[-1]
    known = {name: v for name, v in _covariates(traces).items() if _spread(v)}
    if not known:
        return []
    o = traces.observations
    size: dict[str, float] = {}
    for s in o.series:
        size[s.channel] = size.get(s.channel, 0.0) + float(np.nansum(residual[s.start : s.stop] ** 2))
    worst = sorted(size, key=lambda c: -size[c])[: EXPLORE.lines]
    columns = min(3, len(known))
    rows = -(-len(known) // columns)
    figure = make_subplots(rows, columns, shared_yaxes=True, horizontal_spacing=0.03, vertical_spacing=0.3 / rows)
    for n, (name, covariate) in enumerate(known.items()):
        at: dict[str, Any] = {"row": n // columns + 1, "col": n % columns + 1}
        for look, channel in zip(SERIES, worst, strict=False):
            mine = np.concatenate([np.arange(s.start, s.stop) for s in o.series if s.channel == channel])
            x, (mean, error) = broken(*_binned(covariate[mine], residual[mine]))
            figure.add_scatter(
                x=x,
                y=mean,
                error_y={"type": "data", "array": error, "thickness": 1, "width": 2},
                mode="lines+markers",
                name=plot_text(channel_label(channel)),
                legendgroup=channel,
                showlegend=n == 0,
                line={"color": look.colour, "dash": look.dash},
                marker={"color": look.colour, "symbol": look.symbol},
                hovertemplate="%{x:.3g}: %{y:.3g} sigma<extra></extra>",
                **at,
            )
        figure.update_xaxes(title_text=name, **at)
    finish(figure, 120 + 260 * rows, margin={"l": 62, "r": 36, "t": 70, "b": 52})
    figure.update_yaxes(title_text="mean residual, sigma", col=1)
    figure.add_hline(y=0.0, line={"color": MUTED, "width": 1})
    caption = (
        f"What {result.name}'s model {traces.labels[-1]} leaves in its {len(worst)} worst channels, averaged in bins "
        "with 95 % intervals: noise would scatter about zero whatever it is drawn over."
    )
    return [Figure(figure, caption, least=80 + 220 * columns)]


def gallery(result: Result) -> list[Block]:
    """The residual beside the shape that each of the best-scored effects would give it, where that shape is largest."""
    traces = result.traces
    if traces is None or not result.signatures:
        return []
    o, residual = traces.observations, traces.whitened[_baseline(traces)]
    fitted = np.flatnonzero(o.in_split("fit"))
    shapes = {}
    for e in (result.verdict or {}).get("evidence") or []:
        signature = result.signatures.get(e["effect"])
        if e.get("status") != "not tested" and signature is not None and len(signature) == len(fitted):
            shapes[e["effect"]] = np.zeros(len(o))
            shapes[e["effect"]][fitted] = signature
    # Long signatures are those that these logs show best, whether or not anything is missing.
    chosen = sorted(shapes, key=lambda e: -float(np.linalg.norm(shapes[e])))[: EXPLORE.shapes]
    drawn = {e: largest for e in chosen if (largest := _largest(o, shapes[e])) is not None}
    if not drawn:
        return []
    columns = min(2, len(drawn))
    rows = -(-len(drawn) // columns)
    titles = [
        f"{plot_text(e)}<br>{plot_text(channel_label(c))}, {plot_text(o.unit_names[u], 30)}"
        for e, (c, u, _) in drawn.items()
    ]
    figure = make_subplots(rows, columns, subplot_titles=titles, vertical_spacing=0.42 / rows, horizontal_spacing=0.08)
    for n, (effect, (_, _, at)) in enumerate(drawn.items()):
        x, name = _abscissa(traces, at)
        place: dict[str, Any] = {"row": n // columns + 1, "col": n % columns + 1}
        figure.add_scatter(
            x=x,
            y=residual[at],
            mode="markers",
            name="residual of the refitted model",
            marker={"color": INK, "size": 7},
            showlegend=n == 0,
            legendgroup="r",
            **place,
        )
        figure.add_scatter(
            x=x,
            y=shapes[effect][at],
            mode="lines" if o.place is None else "markers",
            name="the effect alone",
            line={"color": ORANGE, "width": 2.5},
            marker={"color": ORANGE, "size": 8, "symbol": "triangle-up-open"},
            showlegend=n == 0,
            legendgroup="s",
            **place,
        )
        figure.update_xaxes(title_text=name, **place)
    finish(
        figure,
        110 + 300 * rows,
        margin={"l": 62, "r": 36, "t": 110, "b": 52},
        legend={"orientation": "h", "x": 0.0, "y": 1.0 + 0.22 / rows, "yanchor": "bottom"},
    )
    figure.update_yaxes(title_text="sigma", col=1)
    caption = (
        "Shapes of missing effects: what the simulator says each would add at the amount that fits best, less what a "
        "refit of the model absorbs, in the channel and manoeuvre where it shows most."
    )
    return [Figure(figure, caption, least=80 + 260 * columns)]


def _baseline(traces: Traces) -> int:
    """The row of the refitted model."""
    return traces.labels.index("refitted") if "refitted" in traces.labels else len(traces.labels) - 1


def cells(o: Observations) -> Iterator[tuple[str, int, np.ndarray]]:
    """Channel, manoeuvre, and places of its observations."""
    rows_of: dict[tuple[str, int], list[np.ndarray]] = {}
    for s in o.series:
        part = np.arange(s.start, s.stop)
        for unit in np.unique(o.unit[part]):
            rows_of.setdefault((s.channel, int(unit)), []).append(part[o.unit[part] == unit])
    for (channel, unit), parts in rows_of.items():
        yield channel, unit, np.concatenate(parts)


def _key(channel: str, unit: int) -> str:
    return f"{unit} {channel}"


def _abscissa(traces: Traces, at: np.ndarray) -> tuple[np.ndarray, str]:
    place = traces.observations.place
    return (place[at, 0], "slip ratio") if place is not None else (traces.time[at], "time, s")


def _panel(models: Sequence[Step], channel: str, unit: int, at: np.ndarray) -> dict[str, Any]:
    traces = models[0].result.traces
    assert traces is not None
    x, x_title = _abscissa(traces, at)
    order = np.argsort(x, kind="stable")
    at, x = at[order], x[order]
    o = traces.observations
    x, drawn = broken(x, o.value[at], *(m.predicted[at] for m in models), *(m.residual[at] for m in models))
    measured, said, left = drawn[0], drawn[1 : 1 + len(models)], drawn[1 + len(models) :]
    # The page's figure has places for two models; a run of one leaves the second empty.
    none = [np.zeros(0)] * (2 - len(models))
    y = [measured, *said, *none, *left, *none]
    name = f"{channel_label(channel)}: {o.unit_names[unit]}"
    return {
        "label": name,
        "x": _plain(x),
        "y": [_plain(v) for v in y],
        "x_title": x_title,
        "y_title": plot_text(channel_label(channel)),
    }


def broken(x: ArrayLike, *values: ArrayLike) -> tuple[np.ndarray, list[np.ndarray]]:
    """An ascending abscissa and values over it, with NaN values in every gap, so that no line is drawn across it.

    A gap is wider than five usual steps, as between the windows of a drive.
    """
    x = np.asarray(x, float)
    step = np.diff(x)
    gaps = np.flatnonzero(step > 5.0 * np.median(step)) + 1 if step.size and np.median(step) > 0.0 else []
    middle = x[gaps] - 0.5 * step[np.asarray(gaps, int) - 1]
    return np.insert(x, gaps, middle), [np.insert(np.asarray(v, float), gaps, np.nan) for v in values]


def _plain(values: np.ndarray | list) -> list[float | None]:
    # More digits than a picture shows would only make the page larger.
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in values]


def _detail(models: Sequence[Step]) -> go.Figure:
    """Measured and predicted above, residuals below; the panels fill it."""
    figure = make_subplots(2, 1, shared_xaxes=True, row_heights=[0.64, 0.36], vertical_spacing=0.06)
    table = models[0].observations.place is not None
    names = [plot_text(m.label) for m in models] + ["-"] * (2 - len(models))
    looks = [
        ("measured", MEASURED.colour, "circle", "solid"),
        (names[0], ORANGE, "triangle-up", "dot"),
        (names[1], BLUE, "square", "solid"),
    ]
    for n, (name, colour, symbol, dash) in enumerate(looks):
        figure.add_scatter(
            x=[],
            y=[],
            name=name,
            mode="markers" if n == 0 or table else "lines",
            showlegend=name != "-",
            marker={"color": colour, "symbol": symbol, "size": 10 if table else 5},
            line={"color": colour, "dash": dash, "width": 2},
            row=1,
            col=1,
        )
    for name, colour, symbol, _ in looks[1:]:
        look = {"color": colour, "symbol": symbol, "size": 9 if table else 4}
        figure.add_scatter(
            x=[], y=[], name=f"residual, {name}", mode="markers", showlegend=False, marker=look, row=2, col=1
        )
    figure.add_shape(
        type="rect",
        xref="x2 domain",
        yref="y2",
        x0=0,
        x1=1,
        y0=-2.0,
        y1=2.0,
        line={"width": 0},
        fillcolor=faded(BLUE, 0.12),
        layer="below",
    )
    finish(figure, 450, margin={"l": 70, "r": 36, "t": 60, "b": 52})
    figure.update_yaxes(title_text="residual, sigma", row=2, col=1)
    return figure


def _covariates(traces: Traces) -> Mapping[str, np.ndarray]:
    """Name with unit, and value at every observation; NaN where it is not known."""
    o = traces.observations
    if o.place is not None:
        return dict(zip(("slip ratio", "slip angle, deg", "load, N"), o.place.T, strict=False))
    wanted = {
        "speed of the wheels, rad/s": ("joint_speed", "drive"),
        "pitch, deg": ("pitch",),
        "winding temperature, °C": ("winding_temperature",),
        "position x, m": ("position", "", "x"),
    }
    return {"time, s": traces.time} | {name: covariate_along(o, *what) for name, what in wanted.items()}


def covariate_along(o: Observations, quantity: str, joint: str = "", axis: str = "") -> np.ndarray:
    """(n,) mean of the measured channels of a quantity (as for `is_quantity`) in the log of each observation, then."""
    out = np.full(len(o), np.nan)
    for log in range(len(o.logs)):
        mine = [s for s in o.series if s.log == log and s.time is not None and len(s.time)]
        kind = [s for s in mine if is_quantity(s.channel, quantity, joint, axis)]
        for s in mine if kind else ():
            # Channels have clocks of their own.
            values = [np.interp(np.asarray(s.time), np.asarray(k.time), o.value[k.start : k.stop]) for k in kind]
            out[s.start : s.stop] = np.mean(values, axis=0)
    return out


def _spread(values: np.ndarray) -> bool:
    known = values[np.isfinite(values)]
    return len(known) >= 2 * EXPLORE.least and bool(np.ptp(known) > 1e-6 * max(float(np.abs(known).max()), 1e-12))


def _binned(x: np.ndarray, y: np.ndarray) -> tuple[list[float], list[float], list[float]]:
    """Centres of bins of equal counts, means, and the half widths of their 95 % intervals."""
    keep = np.isfinite(x) & np.isfinite(y)
    x, y = x[keep], y[keep]
    rows = []
    # Bins of equal width would hold hardly any observations at the ends.
    for part in np.array_split(np.argsort(x, kind="stable"), min(EXPLORE.bins, max(1, len(x) // EXPLORE.least))):
        if len(part) >= 2:
            rows.append((x[part].mean(), y[part].mean(), 1.96 * y[part].std(ddof=1) / np.sqrt(len(part))))
    centres, means, errors = zip(*rows, strict=True) if rows else ((), (), ())
    return [*map(float, centres)], [*map(float, means)], [*map(float, errors)]


def _largest(o: Observations, shape: np.ndarray) -> tuple[str, int, np.ndarray] | None:
    """Channel, manoeuvre and observations where a shape has most of its length."""
    seen = [(c, u, at) for c, u, at in cells(o) if len(at) >= EXPLORE.few]
    best = max(seen, key=lambda cell: float(np.sum(shape[cell[2]] ** 2)), default=None)
    return best if best is not None and np.any(shape[best[2]]) else None
