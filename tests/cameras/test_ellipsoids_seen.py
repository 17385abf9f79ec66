"""Ellipsoids as cameras, maps and the web page see them: the shape that wheels meet."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from camera_scene import EYE
from scipy.spatial.transform import Rotation

from lunar_mjx.cameras import Light, Sun, look_at, picture
from lunar_mjx.cameras.rays.trace import TRACE
from lunar_mjx.cameras.relief import ring, rocks_within
from lunar_mjx.cameras.scene import build_scene
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import Terrain, build_ellipsoids, flat
from lunar_mjx.viewer.scene import ground_scene

CENTRE, AXES = np.array([4.0, 0.3, -0.1]), np.array([0.9, 0.6, 0.55])
"""Of a stone that stands half a metre high; none of it overhangs, as marching over heights would show as a wall."""
TURN = Rotation.from_euler("zyx", [0.9, 0.2, -0.15]).as_matrix()
SCALED = TURN.T / AXES[:, None]
"""Takes the ellipsoid about its centre to the unit sphere."""
SUN = Sun(110.0, 25.0)


def _stone() -> Terrain:
    rocks = build_ellipsoids(CENTRE[None], AXES[None], TURN[None], (-20.0, -20.0, 20.0, 20.0))
    return dataclasses.replace(flat(100.0), rocks=rocks)


def _entry(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Where rays enter the ellipsoid, as a multiple of their direction; infinite if they miss."""
    o, d = (origin - CENTRE) @ SCALED.T, direction @ SCALED.T
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1.0
    root = b * b - a * c
    entry = (-b - np.sqrt(np.maximum(root, 0.0))) / a
    return np.where((root > 0.0) & (entry > 0.0), entry, np.inf)


def test_depth_labels_and_shadow_are_those_of_rays_in_scaled_space() -> None:
    pose = look_at((2.8, -0.6, 2.2), (4.0, 0.3, 0.2))
    draw = jax.jit(lambda position, turn: picture(_stone(), position, turn, EYE, Light(sun=SUN)))
    found = draw(jnp.asarray(pose.position, jnp.float32), jnp.asarray(pose.rotation, jnp.float32))
    rays = EYE.rays() @ pose.rotation.T
    stone = _entry(pose.position, rays)
    ground = np.where(rays[..., 2] < 0.0, -pose.position[2] / np.minimum(rays[..., 2], -1e-9), np.inf)
    label, depth = np.asarray(found.label), np.asarray(found.depth)
    expected = np.where(stone < ground, 2, np.where(ground < 60.0, 1, 0))
    assert (expected == 2).sum() > 200
    assert np.mean(label == expected) > 0.995
    both = (label == 2) & (expected == 2)
    error = np.abs(depth - stone)[both]
    assert np.quantile(error, 0.95) < 2e-3 and np.median(error) < 3e-4
    # what faces the Sun is bright, and the ground behind the stone lies in its shadow
    point = pose.position + ground[..., None] * rays
    above = point + np.array([0.0, 0.0, TRACE.skin])  # where a shadow ray begins
    dark = (expected == 1) & np.isfinite(_entry(above, np.broadcast_to(SUN.direction, point.shape)))
    lit = (expected == 1) & ~dark & (np.linalg.norm(point[..., :2] - CENTRE[:2], axis=-1) < 5.0)
    grey = np.asarray(found.rgb)[..., 0]
    assert dark.sum() > 50 and np.mean(grey[dark] < 0.5 * np.median(grey[lit])) > 0.95


def test_the_drawn_shape_is_the_one_that_wheels_meet() -> None:
    """MuJoCo's scene, the map's outline and the web page's ball against the ellipsoid itself."""
    terrain = _stone()
    model, _ = build_scene(load_rover("luvmi_x"), terrain, np.array([[4.0, 0.0]]), SUN)
    geom = next(g for g in range(model.ngeom) if model.geom(g).name.startswith("rock_"))
    turn, mesh = np.zeros(9), model.geom_dataid[geom]
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    corners = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    drawn = model.geom_pos[geom] + corners @ turn.reshape(3, 3).T
    np.testing.assert_allclose(np.linalg.norm((drawn - CENTRE) @ SCALED.T, axis=1), 1.0, atol=1e-4)
    np.testing.assert_allclose(model.geom_pos[geom], CENTRE, atol=1e-4)
    outline = rocks_within(terrain, np.array([-10.0, -10.0]), np.array([10.0, 10.0]))
    assert outline.shape == (1, 5)
    for corner in ring(outline[0]):
        # upright lines through the outline touch: of their points none is inside, and one is on the surface
        way = np.array([0.0, 0.0, 1.0]) @ SCALED.T
        start = (np.array([*corner, CENTRE[2]]) - CENTRE) @ SCALED.T
        nearest = start - way * (start @ way) / (way @ way)
        np.testing.assert_allclose(np.linalg.norm(nearest), 1.0, atol=1e-5)
    (sent,) = ground_scene(jax.device_get(terrain), 4.0, 0.0)["rocks"]
    vectors = np.array(sent[3:]).reshape(3, 3).T
    np.testing.assert_allclose(vectors @ vectors.T, TURN * AXES**2 @ TURN.T, atol=2e-4)
    assert np.linalg.det(vectors) > 0.0
