"""What the web page draws: the rover's shapes, once, and the ground around a place, whenever it is asked for."""

from __future__ import annotations

import base64
import dataclasses
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.cameras.chase import print_pitch
from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.cameras.photometry import ROCK_BRIGHTNESS, Film, Regolith
from lunar_mjx.cameras.scene import LEVEL_LIGHT, SCENE_DETAIL, Patch, Sun, cut
from lunar_mjx.cameras.texture import SOIL_TEXTURE, TINT
from lunar_mjx.model import Model
from lunar_mjx.rover.look import LOOK, seen_spec
from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.rocks import semi_axes


@dataclasses.dataclass(frozen=True)
class DrawnGround:
    """How much ground is drawn finely."""

    near: float = 20.0
    """How far around the rover, m."""
    nodes: int = 420
    """Nodes per side there."""


DRAWN_GROUND = DrawnGround()


@dataclasses.dataclass(frozen=True)
class PageLight:
    """How the page's lambertian scene is lit: choices. `Film` decides how bright level soil is on the screen."""

    soil: float = 0.6
    """Reflectance of soil, by which level faces of rovers stand beside it as in MuJoCo's pictures, within a tenth."""
    thrown: float = 0.075
    """Share of level soil's light that is no sunlight: what the ground throws back, and shadows keep."""


PAGE_LIGHT = PageLight()


_SHAPES = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}


def rover_scene(model: Model, sun: Sun) -> dict[str, Any]:
    """The rover's shapes, wheels, and the light, as plain data for JSON."""
    rover, soil, film = model.rover, Regolith(), Film()
    level = film.mid / PAGE_LIGHT.soil
    mj = seen_spec(rover).compile()
    shapes = [
        _shape(mj, i) for i in range(mj.ngeom) if mj.geom_group[i] < LOOK.hidden and int(mj.geom_type[i]) in _SHAPES
    ]
    return {
        "rover": rover.name,
        "terrain": model.terrain.name,
        "shapes": shapes,
        "chassis": int(mj.body(rover.chassis).id),
        "wheels": [
            {
                "corner": w.corner,
                "body": int(mj.body(w.body).id),
                "radius": w.radius,
                "width": w.width,
                "pitch": print_pitch(w),
            }
            for w in rover.wheels
        ],
        # Brightness on the screen over that of soil beside the track, as the other cameras show it.
        "tracks": {"rut": SOIL_TEXTURE.rut / 255.0, "print": SOIL_TEXTURE.print / 255.0},
        "size": float(2.0 * np.abs(rover.chassis_points).max()),
        "sun": sun.direction.tolist(),
        # Level soil comes out at `mid` of the film down to the lowest Sun that it exposes for, as in the other cameras.
        "light": {
            "exposure": (1.0 - PAGE_LIGHT.thrown) * level * sun.exposure / LEVEL_LIGHT,
            "fill": PAGE_LIGHT.thrown * level,
            "gamma": film.gamma,
        },
        "soil": (PAGE_LIGHT.soil * TINT).tolist(),
        "rock": (ROCK_BRIGHTNESS * PAGE_LIGHT.soil * TINT).tolist(),
        # How bright flying grains are beside level ground, by the formulas of the other cameras.
        "cloud": [float(film.gain(soil, float(sun.direction[2]))) / film.mid, soil.albedo, soil.lobe, soil.back],
    }


def dust_scene(grains: Grains) -> list[float]:
    """Grains in flight, five numbers each: place x, y, z and spread, m, and cross-section, cm2."""
    rows = np.column_stack([grains.position, grains.spread, 1e4 * grains.area])
    return np.round(rows, 4).ravel().tolist()


def _shape(mj: mujoco.MjModel, i: int) -> dict[str, Any]:
    kind = _SHAPES[int(mj.geom_type[i])]
    size = mj.geom_size[i].tolist()
    if mj.geom_type[i] == mujoco.mjtGeom.mjGEOM_SPHERE:
        # MuJoCo gives a sphere one size; the page draws it as the ellipsoid that it is, with three.
        size = size[:1] * 3
    shape = {
        "kind": kind,
        "body": int(mj.geom_bodyid[i]),
        "size": size,
        "place": mj.geom_pos[i].tolist(),
        "turn": mj.geom_quat[i].tolist(),
        "colour": mj.geom_rgba[i].tolist(),
    }
    if kind == "mesh":
        k = int(mj.geom_dataid[i])
        first, count = int(mj.mesh_vertadr[k]), int(mj.mesh_vertnum[k])
        face, faces = int(mj.mesh_faceadr[k]), int(mj.mesh_facenum[k])
        shape["corners"] = _packed(mj.mesh_vert[first : first + count])
        shape["faces"] = _packed(mj.mesh_face[face : face + faces], "<u4")
    return shape


def ground_scene(terrain: Terrain, x: float, y: float) -> dict[str, Any]:
    """The fine ground around a place, the whole ground coarsely, and the rocks as far as MuJoCo's pictures have them.

    Args:
      terrain: with NumPy arrays. x, y: m.
    """
    field = terrain.field
    rows, cols = np.asarray(field.heights).shape
    origin, cell = np.array([float(field.x0), float(field.y0)]), float(field.cell)
    end = origin + cell * np.array([cols - 1, rows - 1])
    # A rover may have left the terrain: the nearest ground is drawn then.
    middle = np.clip([x, y], origin, end)
    near = cut(terrain, middle - DRAWN_GROUND.near, middle + DRAWN_GROUND.near, DRAWN_GROUND.nodes)
    return {
        "near": _grid(near),
        "far": _grid(cut(terrain, origin, end, SCENE_DETAIL.far_nodes)),
        "rocks": _rocks(terrain, near, SCENE_DETAIL.far_rocks),
    }


def _grid(patch: Patch) -> dict[str, Any]:
    rows, cols = patch.heights.shape
    return {"rows": rows, "cols": cols, "low": patch.low, "high": patch.high, "heights": _packed(patch.heights)}


def _rocks(terrain: Terrain, near: Patch, beyond: float) -> list[list[float]]:
    """Centre x, y, z and the three semi-axes as vectors, (12,) m, of each rock up to `beyond` m around fine ground."""
    if terrain.rocks is None:
        return []
    centers, (axes, turns) = np.asarray(terrain.rocks.centers, float), semi_axes(terrain.rocks)
    low, high = np.asarray(near.low) - beyond, np.asarray(near.high) + beyond
    seen = (axes[:, 0] > 0) & (centers[:, :2] > low).all(axis=1) & (centers[:, :2] < high).all(axis=1)
    vectors = (turns * axes[:, None, :]).swapaxes(1, 2).reshape(-1, 9)
    return np.column_stack([centers, vectors])[seen].round(4).tolist()


def _packed(values: np.ndarray, kind: str = "<f4") -> str:
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode("ascii")
