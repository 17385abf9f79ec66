"""Plots of drives and terrains: one look, told apart in grey, units on every axis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from lunar_mjx.dynamics.signals import joint_channels
from lunar_mjx.report.style import BLUE, GREEN, INK, ORANGE, RULE, VERMILION
from lunar_mjx.terrain import Terrain
from lunar_mjx.visual.recorded import RecordedDrive
from lunar_mjx.visual.relief import relief, rocks_within

WHEEL_STYLES = {
    "lf": (BLUE, "-"),
    "rf": (ORANGE, "-"),
    "lr": (BLUE, (0, (4, 2))),
    "rr": (ORANGE, (0, (4, 2))),
    "lm": (BLUE, ":"),
    "rm": (ORANGE, ":"),
}
"""Sides by colour, front, middle and rear by the line: legible without colour."""

_MARGIN = 0.12
_LEAST = 2.0


def style(axes: Axes, y: str, x: str = "") -> None:
    """Axis titles with units, a light grid, no box."""
    axes.set_ylabel(y)
    axes.set_xlabel(x)
    axes.grid(True, color=RULE, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def save(figure: Figure, path: Path) -> Path:
    """Writes a figure as PNG, SVG or PDF."""
    FigureCanvasAgg(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    return path


def draw_relief(axes: Axes, terrain: Terrain, low: np.ndarray, high: np.ndarray, contours: bool = True) -> None:
    """Draws shaded ground with rocks, and contours of height."""
    ground = relief(terrain, low, high)
    extent = (ground.west, ground.east, ground.south, ground.north)
    axes.imshow(ground.grey, cmap="gray", vmin=0, vmax=1, extent=extent, origin="lower", interpolation="bilinear")
    if contours and np.ptp(ground.heights) > 1e-6:
        rows, cols = ground.heights.shape
        x = np.linspace(ground.west, ground.east, cols)
        y = np.linspace(ground.south, ground.north, rows)
        lines = axes.contour(x, y, ground.heights, levels=8, colors="white", linewidths=0.5, alpha=0.55)
        axes.clabel(lines, fontsize=6, fmt="%.3g m")
    stones = [Circle((x, y), r) for x, y, r in rocks_within(terrain, low, high)]
    axes.add_collection(PatchCollection(stones, facecolor="#3a3a3a", edgecolor="#222222", linewidth=0.4))
    axes.set_aspect("equal")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")


def bounds(places: np.ndarray, margin: float = _MARGIN) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a square around places (n, 2), with a margin."""
    low, high = places.min(axis=0), places.max(axis=0)
    half = 0.5 * max(float((high - low).max()), _LEAST) * (1.0 + 2.0 * margin)
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def drive_summary(drive: RecordedDrive) -> Figure:
    """The path on shaded relief, and over time slope, slip, sinkage, temperature and power."""
    figure = Figure(figsize=(13.0, 7.4), layout="constrained")
    grid = figure.add_gridspec(5, 2, width_ratios=(1.15, 1.0))
    ground = figure.add_subplot(grid[:, 0])
    low, high = bounds(drive.position[:, :2])
    draw_relief(ground, drive.terrain, low, high)
    ground.set_xlim(low[0], high[0])
    ground.set_ylim(low[1], high[1])
    _draw_path(figure, ground, drive)
    first = None
    for row, draw in enumerate((_slope, _slip, _sinkage, _temperature, _power)):
        axes = figure.add_subplot(grid[row, 1], sharex=first)
        first = first or axes
        draw(axes, drive)
        axes.set_xlim(drive.time[0], drive.time[-1])
        if row < 4:
            axes.tick_params(labelbottom=False)
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


def _draw_path(figure: Figure, axes: Axes, drive: RecordedDrive) -> None:
    """The path, coloured by mean slip and outlined so that it shows in grey; start and end."""
    place = drive.position[:, :2]
    slip = np.nanmean(np.abs(drive.per_wheel("wheel_{}_slip_ratio")), axis=1)
    axes.plot(*place.T, color="black", linewidth=4.5, solid_capstyle="round")
    dots = axes.scatter(*place.T, c=np.clip(slip, 0.0, 1.0), cmap="cividis", vmin=0.0, vmax=1.0, s=7, zorder=3)
    figure.colorbar(dots, ax=axes, label="mean |slip ratio| of the wheels", shrink=0.6, pad=0.01)
    axes.plot(*place[0], "o", color="white", markeredgecolor="black", markersize=8, label="start", zorder=4)
    axes.plot(*place[-1], "s", color="white", markeredgecolor="black", markersize=8, label="end", zorder=4)
    axes.legend(loc="upper right", fontsize=8, framealpha=0.9)


def _slope(axes: Axes, drive: RecordedDrive) -> None:
    along, across = drive.slope.T
    axes.plot(drive.time, along, color=INK, label="along the heading")
    axes.plot(drive.time, across, color=GREEN, linestyle="--", label="across (up to the left)")
    style(axes, "slope, °")
    axes.legend(fontsize=7, frameon=False, ncols=2)


def _wheels(axes: Axes, drive: RecordedDrive, values: np.ndarray) -> None:
    for i, corner in enumerate(drive.corners):
        colour, line = WHEEL_STYLES.get(corner, (INK, "-"))
        axes.plot(drive.time, values[:, i], color=colour, linestyle=line, linewidth=1.1, label=corner)


def _slip(axes: Axes, drive: RecordedDrive) -> None:
    _wheels(axes, drive, drive.per_wheel("wheel_{}_slip_ratio"))
    style(axes, "slip ratio")
    axes.legend(fontsize=7, frameon=False, ncols=4)


def _sinkage(axes: Axes, drive: RecordedDrive) -> None:
    _wheels(axes, drive, 1e3 * drive.per_wheel("wheel_{}_sinkage_m"))
    style(axes, "sinkage, mm")


def _temperature(axes: Axes, drive: RecordedDrive) -> None:
    names = joint_channels(drive.model.rover)
    winding = drive.per_motor("winding_{}_temperature_degC")
    housing = drive.per_motor("housing_{}_temperature_degC")
    hottest = int(np.argmax(winding.max(axis=0)))
    axes.fill_between(drive.time, winding.min(axis=1), winding.max(axis=1), color=VERMILION, alpha=0.15, linewidth=0)
    axes.plot(drive.time, winding[:, hottest], color=VERMILION, label=f"winding of {names[hottest]}, the hottest")
    axes.plot(drive.time, housing[:, hottest], color=BLUE, linestyle="--", label="its housing")
    style(axes, "temperature, °C")
    axes.legend(fontsize=7, frameon=False, ncols=2)


def _power(axes: Axes, drive: RecordedDrive) -> None:
    power = drive.power
    axes.plot(drive.time, power, color=INK, linewidth=1.1)
    axes.axhline(0.0, color=RULE, linewidth=0.8)
    # a start from rest is a spike of milliseconds that would flatten all else
    low, high = (float(v) for v in np.percentile(power, (2.0, 98.0)))
    edge = 0.15 * max(high - min(low, 0.0), 1.0)
    axes.set_ylim(min(low, 0.0) - edge, high + edge)
    axes.text(0.99, 0.95, f"peak {power.max():,.0f} W", transform=axes.transAxes, ha="right", va="top", fontsize=7)
    style(axes, "motors' power, W")


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
    step = max(1, round(max(heights.shape) / 600))
    north, east = np.gradient(heights[::step, ::step], cell * step)
    slope = np.degrees(np.arctan(np.hypot(north, east)))
    image = middle.imshow(slope, cmap="cividis", extent=(low[0], high[0], low[1], high[1]), origin="lower")
    middle.set_xlabel("east, m")
    middle.set_title(f"slope over {cell * step:.3g} m", loc="left", fontsize=9)
    figure.colorbar(image, ax=middle, label="slope, °", shrink=0.8)
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
