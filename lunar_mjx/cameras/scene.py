"""A rover on its terrain as MuJoCo draws it: ground near and far, boulders, regolith, black sky, one hard Sun."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Sequence
from typing import Any

import jax
import mujoco
import numpy as np
from PIL import Image

from lunar_mjx.cameras.mount import front_mount
from lunar_mjx.cameras.photometry import LOWEST_SUN, ROCK_BRIGHTNESS, Film
from lunar_mjx.cameras.pinhole import Pose
from lunar_mjx.cameras.texture import ALBEDO, Track, TrackPainter, regolith
from lunar_mjx.errors import bad_input
from lunar_mjx.rover import Rover
from lunar_mjx.rover.look import seen_spec
from lunar_mjx.rover.mjcf import quaternion
from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.rocks import semi_axes

GROUND, FAR_GROUND, ROCK, FRONT = "ground", "far_ground", "rock", "front"
LEVEL_LIGHT = 0.55
"""Brightness of the Sun's light on level ground, to which `texture.ALBEDO` is fitted."""


@dataclasses.dataclass(frozen=True)
class SceneDetail:
    """How finely a scene is drawn."""

    # Most nodes per side of the near and the far height field, and pixels of the pictures of their ground.
    nodes: int = 420
    far_nodes: int = 160
    texels: int = 2048
    far_texels: int = 1024
    far_rocks: float = 60.0
    """How far beyond the near ground rocks are drawn, m: as far as the cameras in JAX look."""
    # How far the far ground is lowered under the near one, and everywhere, so that the two never meet, m.
    drop: float = 3.0
    seam: float = 0.05
    shadow_reach: float = 40.0
    """How far around the rover things throw shadows, m. MuJoCo has one shadow map: one of 60 m draws stripes on slopes
    that the Sun grazes."""
    shadow_texels: int = 8192
    """Of a side of the shadow map: a centimetre each."""


SCENE_DETAIL = SceneDetail()


@dataclasses.dataclass(frozen=True)
class Sun:
    """Where the Sun stands: azimuth clockwise from north (y), elevation above the horizon, deg."""

    azimuth_deg: float = 135.0
    elevation_deg: float = 15.0

    def __post_init__(self) -> None:
        if not 0.0 < self.elevation_deg <= 90.0:
            raise bad_input("sun", "elevation_deg", self.elevation_deg, "is outside (0, 90]", "give about 15")
        if not math.isfinite(self.azimuth_deg):
            raise bad_input("sun", "azimuth_deg", self.azimuth_deg, "is not finite", "give a compass direction in deg")

    @property
    def direction(self) -> np.ndarray:
        """Unit vector towards the Sun."""
        a, e = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        return np.array([math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)])

    @property
    def exposure(self) -> float:
        """Brightness of the light, by which level ground looks alike down to the lowest Sun that `Film` exposes for."""
        return LEVEL_LIGHT / max(math.sin(math.radians(self.elevation_deg)), LOWEST_SUN)


@dataclasses.dataclass(frozen=True)
class Patch:
    """A part of a terrain's grid: heights (rows, cols) m, and the places of its first and last node, m."""

    heights: np.ndarray
    low: tuple[float, float]
    high: tuple[float, float]


def shadow_light(at: np.ndarray, sun: Sun) -> np.ndarray:
    """Where the light of the shadow map stands, (3,) m, so that shadows are drawn around a place (3,) m."""
    return at + SCENE_DETAIL.shadow_reach * sun.direction


def cut(terrain: Terrain, low: np.ndarray, high: np.ndarray, most: int) -> Patch:
    """The grid between two corners, thinned to at most `most` nodes per side."""
    field = terrain.field
    heights, cell = np.asarray(field.heights, float), float(field.cell)
    at, last = [], []
    for axis, origin in ((1, float(field.x0)), (0, float(field.y0))):
        count = heights.shape[axis]
        first = int(np.clip(math.floor((low[1 - axis] - origin) / cell), 0, count - 2))
        end = int(np.clip(math.ceil((high[1 - axis] - origin) / cell), first + 1, count - 1))
        # Every so many nodes and no means: nodes that are drawn lie on the ground that the wheels touch.
        step = max(1, math.ceil((end - first) / (most - 1)))
        nodes = np.arange(first, end + 1, step)
        at.append(nodes)
        last.append((origin + nodes[0] * cell, origin + nodes[-1] * cell))
    columns, rows = at
    return Patch(heights[np.ix_(rows, columns)], (last[0][0], last[1][0]), (last[0][1], last[1][1]))


def build_scene(
    rover: Rover,
    terrain: Terrain,
    places: np.ndarray,
    sun: Sun,
    tracks: Sequence[Track] = (),
    margin: float = 15.0,
    mount: Pose | None = None,
    fovy_deg: float = 60.0,
) -> tuple[Any, TrackPainter]:
    """The compiled scene of rover and ground, and the painter of its ground.

    Args:
      rover, terrain: what stands where.
      places: (n, 2) m that the near ground covers with `margin` m around.
      sun: the light. tracks: wheel tracks on the near ground.
      mount: of the camera "front" in the chassis frame; `front_mount` if None. fovy_deg: its angle of view.

    Returns:
      The compiled `MjModel`, with untrodden ground, and what paints the tracks into its texture.
    """
    # MuJoCo reads arrays of the host; a terrain of a batch lies on the device.
    terrain = jax.device_get(terrain)
    spec = seen_spec(rover)
    spec.stat.extent = 1.0
    spec.stat.center = [0.0, 0.0, 0.0]
    visual = spec.visual
    visual.map.znear, visual.map.zfar = 0.02, 400.0
    visual.map.shadowclip, visual.map.shadowscale = SCENE_DETAIL.shadow_reach, 0.9
    visual.quality.shadowsize, visual.quality.offsamples = SCENE_DETAIL.shadow_texels, 4
    visual.headlight.ambient, visual.headlight.diffuse = [0.04] * 3, [0.05] * 3
    visual.headlight.specular = [0.0] * 3
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[0, 0, 0],
        rgb2=[0, 0, 0],
        width=32,
        height=192,
    )
    spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0, 0, 20],
        dir=(-sun.direction).tolist(),
        castshadow=True,
        diffuse=[sun.exposure] * 3,
        ambient=[0.0] * 3,
        specular=[0.15] * 3,
    )
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    near = cut(terrain, low, high, SCENE_DETAIL.nodes)
    _add_far(spec, terrain, near)
    painter = _painter(near, tracks)
    _add_ground(spec, GROUND, near, painter.paint(0))
    _add_rocks(spec, terrain, low - SCENE_DETAIL.far_rocks, high + SCENE_DETAIL.far_rocks)
    pose = mount or front_mount(rover)
    spec.body(rover.chassis).add_camera(name=FRONT, pos=pose.position, quat=quaternion(pose.rotation), fovy=fovy_deg)
    return spec.compile(), painter


def _painter(patch: Patch, tracks: Sequence[Track]) -> TrackPainter:
    extent = np.subtract(patch.high, patch.low)
    picture = regolith(SCENE_DETAIL.texels, float(extent.max()))
    return TrackPainter(picture, patch.low, extent.tolist(), tracks)


def _add_ground(spec: Any, name: str, patch: Patch, picture: np.ndarray, lower: Any = 0.0) -> None:
    """The patch as a mesh: MuJoCo lights meshes smoothly, and height fields triangle by triangle."""
    vertices, normals, faces, texture = _surface(patch, lower)
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.usernormal = vertices.ravel(), normals.ravel()
    mesh.userface = mesh.userfacenormal = faces.ravel()
    material = spec.add_material(name=name, rgba=[1, 1, 1, 1], specular=0.0, shininess=0.0)
    mesh.usertexcoord, mesh.userfacetexcoord = texture.ravel(), faces.ravel()
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=1)
    spec.assets = {**spec.assets, f"{name}.png": file.getvalue()}
    spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=f"{name}.png")
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, mass=0.0, contype=0, conaffinity=0
    )


def _surface(patch: Patch, lower: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, normals, triangles and texture coordinates (0, 0 at the picture's top left) of a patch."""
    z = patch.heights
    rows, cols = z.shape
    x, y = (np.linspace(a, b, n) for a, b, n in zip(patch.low, patch.high, (cols, rows), strict=True))
    north, east = np.gradient(z, y, x)
    normal = np.stack([-east, -north, np.ones_like(z)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    place = np.stack([*np.meshgrid(x, y), z - lower], axis=-1)
    u, v = np.meshgrid(np.linspace(0, 1, cols), np.linspace(1, 0, rows))
    index = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2)
    flat = (place.reshape(-1, 3), normal.reshape(-1, 3), faces.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2))
    return flat[0].astype(np.float32), flat[1].astype(np.float32), flat[2].astype(np.int32), flat[3].astype(np.float32)


def _add_far(spec: Any, terrain: Terrain, near: Patch) -> None:
    """Adds the whole terrain as a coarse mesh, lowered where the near ground covers it."""
    field = terrain.field
    rows, cols = np.asarray(field.heights).shape
    origin, cell = np.array([float(field.x0), float(field.y0)]), float(field.cell)
    whole = cut(terrain, origin, origin + cell * np.array([cols - 1, rows - 1]), SCENE_DETAIL.far_nodes)
    x, y = (np.linspace(a, b, n) for a, b, n in zip(whole.low, whole.high, whole.heights.shape[::-1], strict=True))
    step = max(x[1] - x[0], y[1] - y[0])
    inside = [(v > a + step) & (v < b - step) for v, a, b in zip((x, y), near.low, near.high, strict=True)]
    if all(i.all() for i in inside) or (near.low == whole.low and near.high == whole.high):
        return
    hidden = inside[1][:, None] & inside[0][None, :]
    extent = float(np.subtract(whole.high, whole.low).max())
    _add_ground(
        spec,
        FAR_GROUND,
        whole,
        regolith(SCENE_DETAIL.far_texels, extent),
        np.where(hidden, SCENE_DETAIL.drop, SCENE_DETAIL.seam),
    )


def _add_rocks(spec: Any, terrain: Terrain, low: np.ndarray, high: np.ndarray) -> None:
    """All rocks between two corners (2,) m."""
    if terrain.rocks is None:
        return
    centers = np.asarray(terrain.rocks.centers, float)
    # A screen shows the root of the light, by the cameras' gamma.
    rock = ALBEDO * ROCK_BRIGHTNESS ** (1.0 / Film().gamma)
    spec.add_material(name=ROCK, rgba=[*rock, 1], specular=0.0, shininess=0.0)
    for i, (center, axes, turn) in enumerate(zip(centers, *semi_axes(terrain.rocks), strict=True)):
        if axes[0] > 0 and (center[:2] > low).all() and (center[:2] < high).all():
            ball = terrain.rocks.forms is None
            spec.worldbody.add_geom(
                name=f"{ROCK}_{i}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE if ball else mujoco.mjtGeom.mjGEOM_ELLIPSOID,
                size=[axes[0], 0, 0] if ball else axes,
                pos=center,
                quat=quaternion(turn),
                material=ROCK,
                contype=0,
                conaffinity=0,
            )
