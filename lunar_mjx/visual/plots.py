"""Plots of drives and terrains: one look, told apart in grey, units on every axis."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon

from lunar_mjx.cameras.relief import relief, rocks_within
from lunar_mjx.dynamics.signals import joint_channels
from lunar_mjx.files import replacing
from lunar_mjx.report.style import (
    BLUE,
    GREEN,
    HEIGHTS,
    INK,
    LIT,
    MUTED,
    ORANGE,
    RELIEF,
    ROCK,
    RULE,
    SHADOW,
    VERMILION,
    save_light_and_dark,
    styled,
)
from lunar_mjx.rover.description import CORNER_WORDS
from lunar_mjx.terrain import Terrain, surface
from lunar_mjx.visual.recorded import RecordedDrive

WHEEL_STYLES = {
    "lf": (BLUE, "-"),
    "rf": (ORANGE, "-"),
    "lr": (BLUE, (0, (4, 2))),
    "rr": (ORANGE, (0, (4, 2))),
    "lm": (BLUE, ":"),
    "rm": (ORANGE, ":"),
}
"""Sides by colour, front, middle and rear by the line: legible without colour."""


@dataclasses.dataclass(frozen=True)
class PlotLayout:
    """Layout of plots of drives."""

    margin: float = 0.12
    least: float = 2.0
    """Least width of a map, m."""
    slim: float = 0.75
    """Height over width below which a map leaves room for a profile."""
    slimmest: float = 0.45
    """Least height of a map over its width: a straight drive shows some ground beside it."""
    least_contrast: float = 0.08
    """Least range of shades that a relief is stretched from: even ground stays even."""
    least_rise: float = 0.1
    """Least range of heights, m: a wheel feels no millimetre, and a plane shows none."""
    least_slope: float = 2.0
    """Least range of slopes, deg, for the same reason."""


LAYOUT = PlotLayout()


def style(axes: Axes, y: str, x: str = "") -> None:
    """Axis titles with units."""
    axes.set_ylabel(y)
    axes.set_xlabel(x)


def save(figure: Figure, path: Path, dark: bool = False) -> list[Path]:
    """Writes a figure as PNG, SVG or PDF, with `dark` also as `NAME_dark`; returns the files written."""
    FigureCanvasAgg(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    if dark:
        return save_light_and_dark(figure, path, dpi=120)
    with replacing(path) as part:
        figure.savefig(part, dpi=120)
    return [path]


def draw_relief(axes: Axes, terrain: Terrain, low: np.ndarray, high: np.ndarray, contours: bool = True) -> None:
    """Draws shaded ground with rocks, and contours of height, whose spacing stands in the corner."""
    ground = relief(terrain, low, high)
    extent = (ground.west, ground.east, ground.south, ground.north)
    # A few shadows and edges of rocks would take up the whole range of shades.
    dark, bright = (float(v) for v in np.percentile(ground.grey, (1.0, 99.0)))
    spare = max(0.0, 0.5 * (LAYOUT.least_contrast - (bright - dark)))
    # gentle ground is stretched to most of the shades, so that its shape shows
    span: dict[str, Any] = {
        "vmin": dark - spare - 0.35 * (bright - dark + 2 * spare),
        "vmax": bright + spare + 0.15 * (bright - dark),
    }
    axes.imshow(ground.grey, cmap=RELIEF, extent=extent, origin="lower", interpolation="bicubic", **span)
    if contours and np.ptp(ground.heights) > 1e-6:
        rows, cols = ground.heights.shape
        x = np.linspace(ground.west, ground.east, cols)
        y = np.linspace(ground.south, ground.north, rows)
        step = _round_step(float(np.ptp(ground.heights)) / 8.0)
        levels = np.arange(np.floor(ground.heights.min() / step), np.ceil(ground.heights.max() / step) + 1) * step
        axes.contour(x, y, ground.heights, levels=levels, colors=LIT, linewidths=0.7, alpha=0.6)
        text = f"contours every {1e3 * step:g} mm" if step < 0.1 else f"contours every {step:g} m"
    else:
        text = "level ground" if contours else ""
    if text:
        axes.text(
            0.01,
            0.015,
            text,
            transform=axes.transAxes,
            fontsize=8,
            color=LIT,
            bbox={"facecolor": SHADOW, "alpha": 0.65, "edgecolor": "none", "pad": 2.5},
        )
    stones = [
        Ellipse((x, y), 2.0 * a, 2.0 * b, angle=np.degrees(angle))
        for x, y, a, b, angle in rocks_within(terrain, low, high)
    ]
    axes.add_collection(PatchCollection(stones, facecolor=ROCK, edgecolor=SHADOW, linewidth=0.4))
    axes.grid(False)
    axes.set_aspect("equal")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")


def _round_step(step: float) -> float:
    """The next larger of 1, 2 and 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(step))
    return float(power * next(k for k in (1.0, 2.0, 5.0, 10.0) if k * power >= step * (1.0 - 1e-9)))


def bounds(
    places: np.ndarray, margin: float = LAYOUT.margin, slimmest: float = 1.0, pad: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a rectangle around places (n, 2), with a margin.

    Args:
      places: (n, 2) m.
      margin: on every side, as a share of the longer side.
      slimmest: shorter side over the longer one at least; 1 gives a square.
      pad: more ground on every side, m.
    """
    low, high = places.min(axis=0), places.max(axis=0)
    extent = high - low + 2.0 * pad
    longest = max(float(extent.max()), LAYOUT.least)
    half = 0.5 * (np.maximum(extent, slimmest * longest) + 2.0 * margin * longest)
    middle = 0.5 * (low + high)
    return middle - half, middle + half


@styled()
def drive_summary(drive: RecordedDrive) -> Figure:
    """The path on shaded relief, and over time slope, slip, sinkage, temperature and power."""
    figure = Figure(figsize=(13.0, 7.4), layout="constrained")
    grid = figure.add_gridspec(5, 2, width_ratios=(1.15, 1.0))
    # The rover is drawn where it ends, and must not stick out of the map.
    reach = float(np.abs(np.asarray(drive.model.rover.chassis_points)[:, :2]).max())
    low, high = bounds(drive.position[:, :2], 0.08, LAYOUT.slimmest, reach)
    slim = float((high - low)[1] / (high - low)[0]) < LAYOUT.slim
    ground = figure.add_subplot(grid[:4, 0] if slim else grid[:, 0])
    draw_relief(ground, drive.terrain, low, high)
    ground.set_xlim(low[0], high[0])
    ground.set_ylim(low[1], high[1])
    _draw_path(figure, ground, drive)
    if slim:  # what a long, slim map leaves free below shows the ground along the path
        _profile(figure.add_subplot(grid[4, 0]), drive)
    first = None
    for row, draw in enumerate((_slope, _slip, _sinkage, _temperature, _power)):
        axes = figure.add_subplot(grid[row, 1], sharex=first)
        first = first or axes
        draw(axes, drive)
        axes.set_xlim(drive.time[0], drive.time[-1])
        if row < 4:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("time, s")
    name, model = drive.model.rover.name, drive.model
    length = float(np.hypot(*np.diff(drive.position[:, :2], axis=0).T).sum())
    figure.suptitle(
        f"{name} on {model.terrain.name}, preset {model.preset}: {length:.2f} m in "
        f"{drive.time[-1] - drive.time[0]:.1f} s",
        x=0.01,
        ha="left",
        fontsize=12,
    )
    return figure


def _profile(axes: Axes, drive: RecordedDrive) -> None:
    """Height of the ground along the path."""
    x, y = drive.position[:, 0], drive.position[:, 1]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    height = np.asarray(surface(drive.model.terrain, x, y), float)
    axes.plot(way, height, color=INK, linewidth=1.2)
    _at_least(axes, LAYOUT.least_rise)
    bottom = axes.get_ylim()[0]
    axes.fill_between(way, height, bottom, color=MUTED, alpha=0.35, linewidth=0)
    axes.set_ylim(bottom=bottom)
    style(axes, "ground, m", "along the path, m")


def _at_least(axes: Axes, span: float) -> None:
    """Widens an axis of heights to a span: of what is level, rounding errors would fill it."""
    low, high = axes.get_ylim()
    missing = max(span - (high - low), 0.0)
    axes.set_ylim(low - 0.5 * missing, high + 0.5 * missing)


def _outline(drive: RecordedDrive, row: int) -> np.ndarray:
    """Corners of the rover seen from above at a row of the drive, (4, 2) m: around chassis and wheels."""
    points = np.asarray(drive.model.rover.chassis_points, float)[:, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    yaw = np.radians(drive.columns(["yaw_deg"])[row, 0])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return drive.position[row, :2] + corners @ turn.T


def _draw_path(figure: Figure, axes: Axes, drive: RecordedDrive) -> None:
    """The path, coloured by mean slip and outlined so that it shows in grey; start and end."""
    place = drive.position[:, :2]
    # Absolute, or a braked wheel would cancel a driving one.
    slip = np.nanmean(np.abs(drive.per_wheel("wheel_{}_slip_ratio")), axis=1)
    for n, track in enumerate(drive.tracks()):
        axes.plot(
            *track.places.T, "-", color=INK, linewidth=1.0, alpha=0.55, zorder=2, label="wheels" if n == 0 else None
        )
    axes.add_patch(
        Polygon(
            _outline(drive, -1),
            closed=True,
            fill=False,
            edgecolor=INK,
            linewidth=1.4,
            zorder=3,
            label="rover at the end",
        )
    )
    axes.plot(*place.T, "-", color=SHADOW, linewidth=4.5, solid_capstyle="round")
    dots = axes.scatter(*place.T, c=np.clip(slip, 0.0, 1.0), cmap=HEIGHTS, vmin=0.0, vmax=1.0, s=7, zorder=3)
    figure.colorbar(dots, ax=axes, label="mean |slip ratio| of the wheels", shrink=0.6, pad=0.01)
    axes.plot(*place[0], "o", color=LIT, markeredgecolor=SHADOW, markersize=8, label="start", zorder=4)
    axes.plot(*place[-1], "s", color=LIT, markeredgecolor=SHADOW, markersize=8, label="end", zorder=4)
    _legend_above(axes, fontsize=8, ncols=4)


def _legend_above(axes: Axes, **more: Any) -> None:
    """Names what is drawn above the axes: upon them, words would hide lines and lines cross words."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.3, frameon=False, **more)


def _slope(axes: Axes, drive: RecordedDrive) -> None:
    along, across = drive.slope.T
    axes.plot(drive.time, along, color=INK, label="along the heading")
    axes.plot(drive.time, across, color=GREEN, linestyle="--", label="across (up to the left)")
    _at_least(axes, LAYOUT.least_slope)
    style(axes, "slope, °")
    _legend_above(axes, fontsize=7, ncols=2)


def _wheels(axes: Axes, drive: RecordedDrive, values: np.ndarray) -> None:
    for i, corner in enumerate(drive.corners):
        colour, line = WHEEL_STYLES.get(corner, (INK, "-"))
        # left wheels lie as broad lines under right ones, so that both show where they agree
        width = 3.2 if corner.startswith("l") else 1.3
        axes.plot(
            drive.time,
            values[:, i],
            color=colour,
            linestyle=line,
            linewidth=width,
            zorder=2 if width > 2 else 3,
            label=CORNER_WORDS.get(corner, corner),
        )


def _slip(axes: Axes, drive: RecordedDrive) -> None:
    _wheels(axes, drive, drive.per_wheel("wheel_{}_slip_ratio"))
    style(axes, "slip ratio")
    _legend_above(axes, fontsize=7, ncols=4, handlelength=3.4)


def _sinkage(axes: Axes, drive: RecordedDrive) -> None:
    _wheels(axes, drive, 1e3 * drive.per_wheel("wheel_{}_sinkage_m"))
    style(axes, "sinkage, mm")


def _temperature(axes: Axes, drive: RecordedDrive) -> None:
    names = joint_channels(drive.model.rover)
    winding = drive.per_motor("winding_{}_temperature_degC")
    housing = drive.per_motor("housing_{}_temperature_degC")
    hottest = int(np.argmax(winding.max(axis=0)))
    coldest, warmest = winding.min(axis=1), winding.max(axis=1)
    axes.fill_between(drive.time, coldest, warmest, color=VERMILION, alpha=0.15, linewidth=0, label="all windings")
    corner, _, joint = names[hottest].partition("_")
    where = f"{CORNER_WORDS.get(corner, corner)} {joint}".strip()
    axes.plot(drive.time, winding[:, hottest], color=VERMILION, label=f"hottest: {where}")
    axes.plot(drive.time, housing[:, hottest], color=BLUE, linestyle="--", label="its housing")
    style(axes, "temperature, °C")
    _legend_above(axes, fontsize=7, ncols=3)


def _power(axes: Axes, drive: RecordedDrive) -> None:
    # The sum over all motors: which of them takes how much is in the drive's table.
    power = drive.power
    axes.plot(drive.time, power, color=INK, linewidth=1.1)
    axes.axhline(0.0, color=RULE, linewidth=0.8)
    # a start from rest is a spike of milliseconds that would flatten all else
    low, high = (float(v) for v in np.percentile(power, (2.0, 98.0)))
    edge = 0.15 * max(high - min(low, 0.0), 1.0)
    axes.set_ylim(min(low, 0.0) - edge, high + edge)
    axes.text(0.99, 0.95, f"peak {power.max():,.0f} W", transform=axes.transAxes, ha="right", va="top", fontsize=7)
    style(axes, "motors' power, W")


@styled()
def terrain_preview(terrain: Terrain) -> Figure:
    """A terrain's heights on shaded relief, and its slopes: map and shares."""
    field = terrain.field
    heights, cell = np.asarray(field.heights, float), float(field.cell)
    low = np.array([float(field.x0), float(field.y0)])
    high = low + cell * (np.array(heights.shape[::-1]) - 1)
    figure = Figure(figsize=(13.0, 4.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1, 0.8))
    draw_relief(left, terrain, low, high, contours=False)
    left.set_title("shaded relief with rocks, light from the north-west", loc="left", fontsize=9)
    # No more cells than the map has pixels; its title says over which length slopes are then taken.
    step = max(1, round(max(heights.shape) / 600))
    north, east = np.gradient(heights[::step, ::step], cell * step)
    slope = np.degrees(np.arctan(np.hypot(north, east)))
    image = middle.imshow(slope, cmap=HEIGHTS, extent=(low[0], high[0], low[1], high[1]), origin="lower")
    middle.grid(False)
    middle.set_xlabel("east, m")
    middle.set_title(f"slope over {cell * step:.3g} m", loc="left", fontsize=9)
    figure.colorbar(image, ax=middle, label="slope, °", shrink=0.8)
    # A cumulative curve needs no bins, whose width would change what it shows.
    ordered = np.sort(slope.ravel())
    right.plot(ordered, 100.0 * (1.0 - np.arange(ordered.size) / ordered.size), color=INK)
    style(right, "ground at least as steep, %", "slope, °")
    right.set_title(f"median {np.median(slope):.2g}°, steepest {slope.max():.3g}°", loc="left", fontsize=9)
    figure.suptitle(
        f"{terrain.name}: {high[0] - low[0]:.4g} m x {high[1] - low[1]:.4g} m, heights "
        f"{heights.min():.3g} to {heights.max():.3g} m",
        x=0.01,
        ha="left",
        fontsize=12,
    )
    return figure
