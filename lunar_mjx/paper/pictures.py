"""Counterparts of the seed paper's Figs. 1, 2 and 4: the display, the workflow, the rovers and the terrain."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import LightSource, ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.ticker import MaxNLocator

from lunar_mjx.cameras import (
    LABELS,
    Film,
    Light,
    Pictures,
    Pinhole,
    Pose,
    Sun,
    front_mount,
    mounted,
    orbit,
    picture,
    placed,
    rover_shapes,
    together,
    trodden,
    wheel_tracks,
)
from lunar_mjx.dynamics import build
from lunar_mjx.model import Model, make_model
from lunar_mjx.report.style import BLUE, GREEN, HEIGHTS, HEIGHTS_DOWN, INK, MUTED, ORANGE, PAPER, SHADOW, SKY, VERMILION
from lunar_mjx.resources import find
from lunar_mjx.rover import Rover
from lunar_mjx.terrain import HeightField, Terrain, load_terrain
from lunar_mjx.terrain.config import read_config
from lunar_mjx.terrain.load import CONFIG, build_terrain

RIM = "de_gerlache_rim"
_ABUNDANCE = 0.04
"""Share of the ground that rocks cover in the first figure: as on fresh ejecta, four times that of `lunar_plain`."""
_PLACE = (-10.0, -10.0, math.radians(290.0))
"""Where the rover of the first figure stands: x, y in m and yaw in rad. Its front camera sees rocks and a rover."""
_MATE = (4.1, -28.0, 75.0)
"""Where the other rover stands: distance in m and direction from the heading, and yaw from the heading, deg."""
_ONLOOKER = (7.0, 280.0, 9.0)
"""Where the first figure is seen from: distance in m, compass azimuth and elevation in deg."""
_LOW_SUN = (308.0, 7.0)
"""Azimuth and elevation of the Sun in the first figure, deg."""
_FILM = Film(mid=0.12)
"""A little darker than the cameras' own exposure, so that white parts are not burnt out."""
_ROWS = 300
"""Places of a rover on its way here, from which its tracks are painted."""
_LABEL_COLOURS = (SHADOW, MUTED, SKY, ORANGE)
"""Sky, ground, rock, rover: told apart without colour vision, and by their brightness."""
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
    """The display: a rover under a low Sun, and colour, depth and labels of its front camera, by the cameras in JAX."""
    terrain = _rocky_plain()
    model = make_model("viper", terrain)
    qpos, mate_qpos = _standing(model, _PLACE), _beside(_PLACE, _MATE)
    mate = make_model("luvmi_x", terrain)
    rovers = ((model.rover, qpos), (mate.rover, _standing(mate, mate_qpos)))
    light = Light(Sun(*_LOW_SUN), film=_FILM)
    paint = _trodden(rovers)
    ahead = np.array([math.cos(_PLACE[2]), math.sin(_PLACE[2]), 0.0])
    pose = orbit(qpos[:3] + 1.9 * ahead + np.array([0.0, 0.0, 0.2]), *_ONLOOKER)
    wide = _taken(terrain, rovers, pose, Pinhole(1440, 960, 42.0), light, paint, detail=True)
    optics = Pinhole(320, 240)
    place, turn = mounted(front_mount(model.rover), jnp.asarray(qpos, jnp.float32))
    front = Pose(np.asarray(place, float), np.asarray(turn, float))
    seen = _taken(terrain, rovers, front, optics, light, paint, detail=False)
    figure = Figure(figsize=(13.0, 6.6))
    grid = figure.add_gridspec(3, 2, width_ratios=(3.0, 1.0), left=0.01, right=0.94, top=0.95, bottom=0.01, wspace=0.02)
    title = f"VIPER and LUVMI-X on a rocky lunar plain, Sun {_LOW_SUN[1]:g}° high"
    _picture(figure.add_subplot(grid[:, 0]), np.asarray(wide.rgb), title)
    depth = np.asarray(seen.depth)
    # The sky has no distance, and a logarithm takes no infinity.
    near = np.where(np.isfinite(depth), depth, np.nan)
    _picture(figure.add_subplot(grid[0, 1]), np.asarray(seen.rgb), "its front camera: colour")
    axes = figure.add_subplot(grid[1, 1])
    shown = axes.imshow(near, cmap=HEIGHTS_DOWN, norm=LogNorm(float(np.nanmin(near)), float(np.nanmax(near))))
    _bare(axes, "distance, m (logarithmic)")
    bar = figure.colorbar(shown, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)), ticks=(2, 5, 10, 20, 50))
    bar.ax.set_yticklabels(("2", "5", "10", "20", "50"))
    bar.ax.minorticks_off()
    labels, axes = np.asarray(seen.label), figure.add_subplot(grid[2, 1])
    shown = axes.imshow(labels, cmap=ListedColormap(_LABEL_COLOURS), vmin=-0.5, vmax=len(LABELS) - 0.5)
    _bare(axes, "what each pixel shows")
    bar = figure.colorbar(shown, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)), ticks=range(len(LABELS)))
    bar.ax.set_yticklabels(LABELS)
    return figure, {
        "size": [optics.width, optics.height],
        "fovy_deg": optics.fovy_deg,
        "camera_position_m": front.position.tolist(),
        "view_matrix": front.view_matrix().tolist(),
        "projection_matrix": optics.projection_matrix().tolist(),
        "share_of_pixels": {name: float((labels == i).mean()) for i, name in enumerate(LABELS)},
        "nearest_m": float(np.nanmin(near)),
        "median_m": float(np.nanmedian(near)),
    }


def _rocky_plain() -> Terrain:
    """`lunar_plain` with more rocks."""
    file = find("terrain", "lunar_plain", CONFIG) / CONFIG
    config = read_config(file)
    assert config.rocks is not None
    rocks = dataclasses.replace(config.rocks, abundance=_ABUNDANCE)
    return build_terrain(dataclasses.replace(config, rocks=rocks), "lunar_plain", file.parent)


def _standing(model: Model, place: tuple[float, float, float]) -> np.ndarray:
    """Coordinates (nq,) of a rover that stands at x, y in m and yaw in rad."""
    system = build(model)
    return np.asarray(system.reset(system.params, *place).qpos, float)


def _beside(place: tuple[float, float, float], way: tuple[float, float, float]) -> tuple[float, float, float]:
    """The place at a distance (m) and direction (deg) from a rover's heading, turned by deg."""
    x, y, yaw = place
    towards = yaw + math.radians(way[1])
    return x + way[0] * math.cos(towards), y + way[0] * math.sin(towards), yaw + math.radians(way[2])


def _taken(
    terrain: Terrain,
    rovers: Sequence[tuple[Rover, np.ndarray]],
    pose: Pose,
    camera: Pinhole,
    light: Light,
    paint: HeightField,
    detail: bool,
) -> Pictures:
    """A picture of rovers at their coordinates, their tracks and their shadows."""
    shapes = [rover_shapes(rover, detail) for rover, _ in rovers]

    def look(terrain: Any, coordinates: Any, place: Any, turn: Any) -> Pictures:
        stand = [placed(s, r, q) for s, (r, _), q in zip(shapes, rovers, coordinates, strict=True)]
        return picture(terrain, place, turn, camera, light, together(*stand), paint=paint, far=90.0)

    coordinates = [jnp.asarray(qpos, jnp.float32) for _, qpos in rovers]
    given = (jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation))
    return jax.device_get(jax.jit(look)(terrain, coordinates, *given))


def _trodden(rovers: Sequence[tuple[Rover, np.ndarray]]) -> HeightField:
    """Mottled ground with the tracks of rovers that came straight to where they stand; the first is in the middle."""
    side, tracks = 40.0, []
    for rover, qpos in rovers:
        w, x, y, z = qpos[3:7]
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        way = np.tile(qpos, (_ROWS, 1))
        way[:, :2] -= np.linspace(12.0, 0.0, _ROWS)[:, None] * np.array([np.cos(yaw), np.sin(yaw)])
        tracks += wheel_tracks(rover, way)
    return trodden(tracks, rovers[0][1][:2] - 0.5 * side, side, texels=4096)


def figure_2() -> tuple[Figure, dict[str, Any]]:
    """The workflow as it is built here."""
    figure = Figure(figsize=(11.0, 4.2))
    axes = figure.subplots()
    wide, high = 0.74, 0.56
    for x, y, title, text, colour in _BOXES.values():
        axes.add_patch(
            FancyBboxPatch(
                (1.1 * x, y), wide, high, boxstyle="round,pad=0.04", facecolor=PAPER, edgecolor=colour, linewidth=1.8
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
    image = axes.imshow(heights, cmap=HEIGHTS, extent=extent, origin="lower")
    axes.set(xlabel="east, m", ylabel="north, m")
    axes.grid(False)
    axes.set_title(f"(c) elevation map, {terrain.name}", loc="left", fontsize=10)
    figure.colorbar(image, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)), label="height, m")
    # As many nodes as the surface draws: more cost seconds and are not seen.
    step = max(1, max(heights.shape) // 160)
    part = heights[::step, ::step]
    x, y = np.meshgrid(x0 + cell * step * np.arange(part.shape[1]), y0 + cell * step * np.arange(part.shape[0]))
    surface: Any = figure.add_subplot(2, 2, 4, projection="3d")
    # From the north-west, as on maps: lit from below, hills look like pits.
    lit = LightSource(315, 20).hillshade(part, dx=cell * step, dy=cell * step)
    grey = np.repeat(lit[..., None], 3, axis=-1)
    surface.plot_surface(
        x, y, part, facecolors=grey, rcount=160, ccount=160, linewidth=0, antialiased=False, shade=False
    )
    surface.zaxis.set_major_locator(MaxNLocator(2))  # flat at its true scale
    surface.set_box_aspect((1, 1, max(0.01, float(np.ptp(part)) / (extent[1] - extent[0]))))
    surface.grid(False)
    for axis in (surface.xaxis, surface.yaxis, surface.zaxis):
        axis.pane.set_visible(False)  # grey panes and their grid would hide the ground on a dark page
    surface.set(xlabel="east, m", ylabel="north, m", zlabel="height, m", xlim=extent[:2], ylim=extent[2:])
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
    """A rover by itself on level ground, by the cameras in JAX, and what is said of it."""
    model = make_model(name, "flat")
    rover = model.rover
    stands = ((rover, _standing(model, (0.0, 0.0, 0.0))),)
    top = float(rover.chassis_points[:, 2].max())
    # At a height within the rover, so that it stands in the middle of its picture.
    pose = orbit(np.array([0.0, 0.0, 0.3 * top]), distance, 150.0, 18.0)
    light, optics = Light(Sun(200.0, 25.0), film=_FILM), Pinhole(900, 640, 42.0)
    seen = _taken(model.terrain, stands, pose, optics, light, _trodden(stands), detail=True)
    called = name.upper().replace("_", "-")
    title = (
        f"{called}: {rover.mass:g} kg, {len(rover.wheels)} wheels, {len(rover.joints)} motors, {len(rover.loops)} loops"
    )
    about = {"title": title, "mass_kg": rover.mass, "motors": len(rover.joints), "loops": len(rover.loops)}
    return np.asarray(seen.rgb), about


def _picture(axes: Any, picture: np.ndarray, title: str) -> None:
    axes.imshow(picture)
    _bare(axes, title)


def _bare(axes: Any, title: str) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(title, loc="left", fontsize=9)
