"""Pictures of a rover on its terrain: a shaded map, drawn anywhere, and MuJoCo's camera where there is OpenGL."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo is a compiled module without type stubs)

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import jax
import mujoco
import numpy as np
from PIL import Image, ImageDraw

from lunar_mjx.errors import UserError
from lunar_mjx.rover import Rover
from lunar_mjx.terrain import Terrain

_MARGIN = 4.0
_SUN = np.array([-0.6, 0.5, 0.62])


class TopView:
    """A map with north up, lit from the north-west, with rocks, rover, path and goal.

    Args:
      terrain: the ground.
      places: (n, 2) m, all within the picture.
      size: of the longer side, pixels.
    """

    def __init__(self, terrain: Terrain, places: Any, size: int = 480):
        terrain = jax.device_get(terrain)
        places = np.asarray(places, float)
        self._low = places.min(axis=0) - _MARGIN
        extent = places.max(axis=0) + _MARGIN - self._low
        self._scale = size / extent.max()
        width, height = (max(16, 2 * round(0.5 * e * self._scale)) for e in extent)
        self.shape = (height, width)
        x = self._low[0] + (np.arange(width) + 0.5) / self._scale
        y = self._low[1] + (height - np.arange(height) - 0.5) / self._scale
        self._base = Image.fromarray(_shade(terrain, x, y))
        draw = ImageDraw.Draw(self._base)
        for rx, ry, radius in _rocks(terrain, self._low, self._low + extent):
            u, v = self._pixel((rx, ry))
            r = max(1.0, radius * self._scale)
            draw.ellipse([u - r, v - r, u + r, v + r], fill=(92, 84, 78), outline=(50, 45, 42))

    def _pixel(self, place: Any) -> tuple[float, float]:
        u, v = (np.asarray(place, float)[:2] - self._low) * self._scale
        return float(u), float(self.shape[0] - v)

    def frame(
        self, position: Any, yaw: float, goal: Any, radius: float, path: Sequence[Any] = (), length: float = 1.0
    ) -> np.ndarray:
        """One picture, (height, width, 3) uint8; `length` of the rover and `radius` of the goal in m."""
        image = self._base.copy()
        draw = ImageDraw.Draw(image)
        if len(path) > 1:
            draw.line([self._pixel(p) for p in path], fill=(70, 160, 255), width=2)
        u, v = self._pixel(goal)
        r = max(3.0, radius * self._scale)
        draw.ellipse([u - r, v - r, u + r, v + r], outline=(90, 255, 120), width=2)
        forward, left = (np.array([np.cos(yaw + t), np.sin(yaw + t)]) for t in (0.0, np.pi / 2))
        half = max(0.5 * length, 4.0 / self._scale)
        at = np.asarray(position, float)[:2]
        corners = [
            at + half * (a * forward + 0.6 * b * left) for a, b in ((1, 1), (1.4, 0), (1, -1), (-1, -1), (-1, 1))
        ]
        draw.polygon([self._pixel(c) for c in corners], fill=(255, 196, 60), outline=(60, 40, 0))
        return np.asarray(image)


def _shade(terrain: Terrain, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Lambert's shading of the ground at a grid of places, (y, x, 3) uint8."""
    field = terrain.field
    heights = np.asarray(field.heights, float)
    x0, y0, cell = (float(v) for v in (field.x0, field.y0, field.cell))
    columns = np.clip(np.rint((x - x0) / cell).astype(int), 0, heights.shape[1] - 1)
    rows = np.clip(np.rint((y - y0) / cell).astype(int), 0, heights.shape[0] - 1)
    r0, c0 = rows.min(), columns.min()
    part = heights[r0 : rows.max() + 1, c0 : columns.max() + 1]
    north, east = (np.gradient(part, cell, axis=a) if part.shape[a] > 1 else np.zeros_like(part) for a in (0, 1))
    light = (_SUN[2] - 3.0 * east * _SUN[0] - 3.0 * north * _SUN[1]) / np.sqrt(1 + 9 * (east**2 + north**2))
    value = np.clip(60 + 190 * light[np.ix_(rows - r0, columns - c0)], 0, 255)
    return np.repeat(value[..., None], 3, axis=-1).astype(np.uint8)


def _rocks(terrain: Terrain, low: Any, high: Any) -> list[tuple[float, float, float]]:
    if terrain.rocks is None:
        return []
    centers, radii = np.asarray(terrain.rocks.centers, float), np.asarray(terrain.rocks.radii, float)
    near = (radii > 0) & (centers[:, :2] > low).all(axis=1) & (centers[:, :2] < high).all(axis=1)
    return [(float(c[0]), float(c[1]), float(r)) for c, r in zip(centers[near], radii[near], strict=True)]


class Camera:
    """MuJoCo's renderer, following the rover over its terrain.

    Args:
      rover: the rover. terrain: the ground.
      places: (n, 2) m: the ground is drawn around all of them.
      width, height: pixels.

    Raises:
      UserError: MuJoCo finds no OpenGL.
    """

    def __init__(self, rover: Rover, terrain: Terrain, places: Any, width: int = 480, height: int = 320):
        model = _scene(rover, jax.device_get(terrain), np.asarray(places, float))
        self._model, self._data = model, mujoco.MjData(model)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of windowing libraries that find no display
                self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:
            raise UserError(
                f"render: MuJoCo finds no OpenGL ({type(error).__name__}); set MUJOCO_GL=egl or osmesa on a machine "
                "that has it, or take the view from the top."
            ) from error
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.elevation = 8.0 * rover.standing_height + 2.5, -22.0
        self._goal = model.body("goal").mocapid[0]

    def frame(self, qpos: Any, yaw: float, goal: Any, ground: float) -> np.ndarray:
        """One picture, (height, width, 3) uint8, from behind the rover; `ground` is the goal's height, m."""
        self._data.qpos[:] = np.asarray(qpos, float)
        self._data.mocap_pos[self._goal] = [*np.asarray(goal, float)[:2], ground]
        mujoco.mj_forward(self._model, self._data)
        self._camera.lookat[:] = np.asarray(qpos, float)[:3]
        self._camera.azimuth = np.degrees(yaw)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()

    def close(self) -> None:
        self._renderer.close()


def _scene(rover: Rover, terrain: Terrain, places: np.ndarray) -> Any:
    """The rover with its ground as a height field, rocks as spheres and a post at the goal."""
    spec = rover.spec()
    field = terrain.field
    heights = np.asarray(field.heights, float)
    x0, y0, cell = (float(v) for v in (field.x0, field.y0, field.cell))
    low, high = places.min(axis=0) - 3 * _MARGIN, places.max(axis=0) + 3 * _MARGIN
    c0, r0 = (max(0, int((v - o) / cell)) for v, o in zip(low, (x0, y0), strict=True))
    c1, r1 = (int(np.ceil((v - o) / cell)) + 2 for v, o in zip(high, (x0, y0), strict=True))
    part = heights[r0:r1, c0:c1]
    rows, cols = part.shape
    base, span = part.min(), max(float(np.ptp(part)), 1e-3)
    half_x, half_y = 0.5 * (cols - 1) * cell, 0.5 * (rows - 1) * cell
    spec.add_hfield(
        name="ground",
        nrow=rows,
        ncol=cols,
        size=[half_x, half_y, span, 0.5],
        userdata=((part - base) / span).astype(np.float32).ravel().tolist(),
    )
    world = spec.worldbody
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="ground",
        rgba=[0.55, 0.53, 0.51, 1],
        pos=[x0 + c0 * cell + half_x, y0 + r0 * cell + half_y, base],
        contype=0,
        conaffinity=0,
    )
    if terrain.rocks is not None:
        centers, radii = np.asarray(terrain.rocks.centers, float), np.asarray(terrain.rocks.radii, float)
        for center, radius in zip(centers, radii, strict=True):
            if radius > 0 and (center[:2] > low).all() and (center[:2] < high).all():
                world.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_SPHERE,
                    size=[radius, 0, 0],
                    pos=center,
                    rgba=[0.4, 0.37, 0.34, 1],
                    contype=0,
                    conaffinity=0,
                )
    goal = world.add_body(name="goal", mocap=True)
    goal.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.05, 1.0, 0],
        pos=[0, 0, 1],
        rgba=[0.2, 1, 0.4, 0.8],
        contype=0,
        conaffinity=0,
    )
    world.add_light(pos=[0, 0, 50], dir=[0.6, -0.5, -0.62], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    return spec.compile()
