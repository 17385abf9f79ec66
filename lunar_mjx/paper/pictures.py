"""Counterparts of the seed paper's Figs. 1, 2 and 4: the display, the workflow, the rovers and the terrain."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.ticker import MaxNLocator

from lunar_mjx.cameras import LABELS, Pinhole, RoverCamera, Sun, orbit
from lunar_mjx.dynamics import build
from lunar_mjx.model import make_model
from lunar_mjx.report.style import BLUE, GREEN, INK, MUTED, ORANGE, VERMILION
from lunar_mjx.terrain import load_terrain

RIM = "de_gerlache_rim"
_BOXES: dict[str, tuple[float, float, str, str, str]] = {
    "urdf": (0.0, 2.0, "URDF + description", "loops, motors, gains", BLUE),
    "dem": (0.0, 1.0, "DEM or procedure", "GeoTIFF, PDS, craters, rocks", BLUE),
    "effects": (0.0, 0.0, "effects at ports", "motor, heat, wheel and soil, sensors", BLUE),
    "model": (1.0, 1.0, "model", "rover + terrain + effects", INK),
    "step": (2.0, 1.0, "step on MJX", "dynamics, then ports, batched", VERMILION),
    "state": (3.0, 2.0, "state and cameras", "telemetry, RGB, depth, labels", GREEN),
    "learn": (3.0, 1.0, "learning", "DDPG, TD3, Gymnasium", GREEN),
    "judge": (3.0, 0.0, "criticism", "compare, find the missing effect", ORANGE),
}
_ARROWS = (
    ("urdf", "model"),
    ("dem", "model"),
    ("effects", "model"),
    ("model", "step"),
    ("step", "state"),
    ("step", "learn"),
    ("step", "judge"),
)


def figure_1() -> tuple[Figure, dict[str, Any]]:
    """The display: a rover on its terrain, and the three pictures of its front camera with the matrices' camera."""
    model = make_model("viper", "lunar_plain")
    system = build(model)
    qpos = np.asarray(system.reset(system.params, 5.0, 0.0, -0.2).qpos, float)
    with RoverCamera(model.rover, model.terrain, qpos[None, :2], sun=Sun(200.0, 14.0)) as camera:
        camera.place(qpos)
        wide = camera.picture(orbit(qpos[:3] + np.array([0.6, 0.0, 0.2]), 6.0, 215.0, 16.0), Pinhole(1200, 760, 42.0))
        images = camera.front()
        optics, pose = camera.camera, camera.front_pose
    figure = Figure(figsize=(13.0, 6.6))
    grid = figure.add_gridspec(3, 2, width_ratios=(3.0, 1.0))
    _picture(figure.add_subplot(grid[:, 0]), wide, "VIPER on lunar_plain, Sun in the south-south-west, 14° high")
    near = np.where(np.isfinite(images.depth), images.depth, np.nan)
    _picture(figure.add_subplot(grid[0, 1]), images.rgba, "front camera, RGBA")
    axes = figure.add_subplot(grid[1, 1])
    shown = axes.imshow(near, cmap="cividis_r", vmin=0.0, vmax=float(np.nanpercentile(near, 97)))
    _bare(axes, "depth, m")
    figure.colorbar(shown, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)))
    labels = figure.add_subplot(grid[2, 1])
    shown = labels.imshow(images.segmentation, cmap="gray", vmin=0, vmax=len(LABELS) - 1)
    _bare(labels, "segmentation")
    bar = figure.colorbar(shown, cax=labels.inset_axes((1.03, 0.0, 0.05, 1.0)), ticks=range(len(LABELS)))
    bar.ax.set_yticklabels(LABELS)
    shares = {name: float((images.segmentation == i).mean()) for i, name in enumerate(LABELS)}
    return figure, {
        "size": [optics.width, optics.height],
        "fovy_deg": optics.fovy_deg,
        "camera_position_m": pose.position.tolist(),
        "view_matrix": images.view.tolist(),
        "projection_matrix": images.projection.tolist(),
        "share_of_pixels": shares,
        "nearest_m": float(np.nanmin(near)),
        "median_m": float(np.nanmedian(near)),
    }


def figure_2() -> tuple[Figure, dict[str, Any]]:
    """The workflow as it is built here."""
    figure = Figure(figsize=(11.0, 4.2))
    axes = figure.subplots()
    wide, high = 0.74, 0.56
    for x, y, title, text, colour in _BOXES.values():
        axes.add_patch(
            FancyBboxPatch(
                (1.1 * x, y), wide, high, boxstyle="round,pad=0.04", facecolor="white", edgecolor=colour, linewidth=1.8
            )
        )
        axes.text(1.1 * x + wide / 2, y + 0.36, title, ha="center", va="center", fontsize=10, weight="bold")
        axes.text(1.1 * x + wide / 2, y + 0.15, text, ha="center", va="center", fontsize=7, color=MUTED)
    for start, end in _ARROWS:
        a, b = _BOXES[start], _BOXES[end]
        tail, head = (1.1 * a[0] + wide + 0.05, a[1] + high / 2), (1.1 * b[0] - 0.05, b[1] + high / 2)
        axes.add_patch(FancyArrowPatch(tail, head, arrowstyle="-|>", mutation_scale=12, color=INK))
    axes.add_patch(
        FancyArrowPatch(
            (3.3 + wide / 2, -0.06),
            (wide / 2, -0.06),
            connectionstyle="arc3,rad=-0.16",
            arrowstyle="-|>",
            mutation_scale=12,
            color=ORANGE,
            linestyle="--",
        )
    )
    axes.text(1.1 * 1.85, -0.5, "the effect that was missing", ha="center", fontsize=8, color=INK)
    axes.set_xlim(-0.1, 4.2)
    axes.set_ylim(-0.85, 2.75)
    axes.axis("off")
    return figure, {"stages": [box[2] for box in _BOXES.values()], "arrows": [list(a) for a in _ARROWS]}


def figure_4() -> tuple[Figure, dict[str, Any]]:
    """Both rovers, and the rim of de Gerlache as an elevation map and as a surface."""
    figure = Figure(figsize=(12.0, 9.0))
    numbers: dict[str, Any] = {"rovers": {}}
    for i, (name, distance) in enumerate((("luvmi_x", 2.6), ("viper", 5.6))):
        picture, about = _portrait(name, distance)
        _picture(figure.add_subplot(2, 2, 1 + i), picture, f"({'ab'[i]}) {about['title']}")
        numbers["rovers"][name] = about
    terrain = jax.device_get(load_terrain(RIM))
    heights, cell = np.asarray(terrain.field.heights, float), float(terrain.field.cell)
    x0, y0 = float(terrain.field.x0), float(terrain.field.y0)
    rows, cols = heights.shape
    extent = (x0, x0 + (cols - 1) * cell, y0, y0 + (rows - 1) * cell)
    axes = figure.add_subplot(2, 2, 3)
    image = axes.imshow(heights, cmap="cividis", extent=extent, origin="lower")
    axes.set(xlabel="east, m", ylabel="north, m")
    axes.set_title(f"(c) elevation map, {terrain.name}", loc="left", fontsize=10)
    figure.colorbar(image, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)), label="height, m")
    step = max(1, max(heights.shape) // 160)
    part = heights[::step, ::step]
    x, y = np.meshgrid(x0 + cell * step * np.arange(part.shape[1]), y0 + cell * step * np.arange(part.shape[0]))
    surface: Any = figure.add_subplot(2, 2, 4, projection="3d")
    lit = LightSource(315, 20).hillshade(part, dx=cell * step, dy=cell * step)
    grey = np.repeat(lit[..., None], 3, axis=-1)
    surface.plot_surface(
        x, y, part, facecolors=grey, rcount=160, ccount=160, linewidth=0, antialiased=False, shade=False
    )
    surface.zaxis.set_major_locator(MaxNLocator(2))  # flat at its true scale
    surface.set_box_aspect((1, 1, max(0.01, float(np.ptp(part)) / (extent[1] - extent[0]))))
    surface.set(xlabel="east, m", ylabel="north, m", zlabel="height, m")
    surface.set_title("(d) its surface, true to scale", loc="left", fontsize=10)
    numbers["terrain"] = {
        "name": terrain.name,
        "extent_m": [extent[1] - extent[0], extent[3] - extent[2]],
        "cell_m": cell,
        "lowest_m": float(heights.min()),
        "highest_m": float(heights.max()),
    }
    return figure, numbers


def _portrait(name: str, distance: float) -> tuple[np.ndarray, dict[str, Any]]:
    model = make_model(name, "flat")
    rover = model.rover
    with RoverCamera(rover, model.terrain, sun=Sun(200.0, 25.0), largest=(900, 640), margin=8.0) as camera:
        qpos = camera.model.qpos0.copy()
        camera.place(qpos)
        top = float(rover.chassis_points[:, 2].max())
        picture = camera.picture(orbit([0.0, 0.0, 0.3 * top], distance, 150.0, 18.0), Pinhole(900, 640, 42.0))
    title = (
        f"{name}: {rover.mass:g} kg, {len(rover.wheels)} wheels, {len(rover.joints)} motors, {len(rover.loops)} loops"
    )
    return picture, {"title": title, "mass_kg": rover.mass, "motors": len(rover.joints), "loops": len(rover.loops)}


def _picture(axes: Any, picture: np.ndarray, title: str) -> None:
    axes.imshow(picture)
    _bare(axes, title)


def _bare(axes: Any, title: str) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(title, loc="left", fontsize=9)
