"""Rovers' shapes in JAX against MuJoCo: where bodies are, and where rays meet them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from lunar_mjx.cameras import placed, rover_shapes, together
from lunar_mjx.cameras.rays import solids
from lunar_mjx.cameras.rays.ground import FAR, take
from lunar_mjx.cameras.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, Placed, bodies, body_poses
from lunar_mjx.rover import load_rover
from lunar_mjx.rover.look import seen_spec
from lunar_mjx.spatial import Vec3

SHOWN = np.array([1, 1, 1, 0, 0, 0], np.uint8)
"""Groups of geoms that the eye sees."""


def hit(shapes: Placed, origin, direction):
    """Multiple of the direction at which rays enter a shape, infinite for none, and which shape."""
    counts, table = bodies(shapes)
    start = Vec3(*(jnp.full(direction.shape[0], v) for v in origin))
    end = jnp.full(direction.shape[0], FAR)
    found, which = solids.meet(counts, table, take, start, Vec3(*direction.T), end)
    return jnp.where(found < FAR, found, jnp.inf), which


def normal(shapes: Placed, which, point):
    """Unit normals of shapes at points (n, 3)."""
    return solids.normal(*bodies(shapes), take, which, Vec3(*point.T)).stack()


def some_pose(rover, seed: int):
    """Any coordinates, joints within 0.5 rad, and MuJoCo's data there."""
    model = seen_spec(rover).compile()
    rng = np.random.default_rng(seed)
    qpos = model.qpos0 + rng.uniform(-0.5, 0.5, model.nq)
    qpos[3:7] = rng.standard_normal(4)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return model, data, qpos


@pytest.mark.parametrize("name", ["viper", "luvmi_x"])
def test_bodies_are_where_mujoco_puts_them(name: str) -> None:
    rover = load_rover(name)
    _, data, qpos = some_pose(rover, 3)
    place, turn = jax.jit(lambda q: body_poses(rover, q))(jnp.asarray(qpos, jnp.float32))
    np.testing.assert_allclose(place, data.xpos, atol=2e-6)
    np.testing.assert_allclose(turn, data.xmat.reshape(-1, 3, 3), atol=2e-6)


@pytest.mark.parametrize("name", ["viper", "luvmi_x"])
def test_rays_meet_a_rover_where_mujocos_do(name: str) -> None:
    rover = load_rover(name)
    model, data, qpos = some_pose(rover, 5)
    rng = np.random.default_rng(0)
    origin = data.xpos[1] + np.array([2.5, -1.5, 1.0])
    aim = data.xpos[1] + rng.uniform(-0.6, 0.6, (600, 3))
    direction = aim - origin
    shapes = rover_shapes(rover, detail=True)
    found, which = jax.jit(lambda q, d: hit(placed(shapes, rover, q), jnp.asarray(origin, jnp.float32), d))(
        jnp.asarray(qpos, jnp.float32), jnp.asarray(direction, jnp.float32)
    )
    geom = np.zeros(1, np.int32)
    true = np.array([mujoco.mj_ray(model, data, origin, d, SHOWN, 1, -1, geom, None) for d in direction])
    met = true >= 0
    assert 100 < met.sum() < 600
    assert (np.isfinite(found) == met).mean() > 0.995  # but for rays that graze an edge
    both = met & np.isfinite(found)
    error = np.abs(np.asarray(found)[both] - true[both])
    assert np.median(error) < 1e-6 and np.mean(error > 1e-3) < 0.01
    assert np.asarray(which).max() < len(shapes.kind)


def one(kind: int, size: tuple[float, float, float]) -> Placed:
    return Placed(np.array([kind]), jnp.array([size]), jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.ones((1, 3)))


@pytest.mark.parametrize(
    ("kind", "size", "origin", "direction", "depth", "face"),
    [
        (BOX, (1.0, 2.0, 3.0), (5.0, 0.5, 0.0), (-1.0, 0.0, 0.0), 4.0, (1, 0, 0)),
        (CYLINDER, (0.5, 1.0, 0.0), (0.1, 0.0, 3.0), (0.0, 0.0, -1.0), 2.0, (0, 0, 1)),
        (CYLINDER, (0.5, 1.0, 0.0), (0.0, -3.0, 0.5), (0.0, 2.0, 0.0), 1.25, (0, -1, 0)),
        (CAPSULE, (0.5, 1.0, 0.0), (0.0, 0.0, 3.0), (0.0, 0.0, -1.0), 1.5, (0, 0, 1)),
        (ELLIPSOID, (0.5, 1.0, 2.0), (0.0, 0.0, 3.0), (0.0, 0.0, -1.0), 1.0, (0, 0, 1)),
    ],
)
def test_each_kind_of_shape(kind, size, origin, direction, depth, face) -> None:
    shape = one(kind, size)
    found, which = hit(shape, jnp.array(origin), jnp.array([direction]))
    assert float(found[0]) == pytest.approx(depth, rel=1e-5)
    point = jnp.array(origin) + found[:, None] * jnp.array([direction])
    np.testing.assert_allclose(normal(shape, which, point)[0], face, atol=1e-5)
    away = tuple(-d for d in direction)
    assert np.isinf(hit(shape, jnp.array(origin), jnp.array([away]))[0][0])


def test_two_rovers_together() -> None:
    rover = load_rover("luvmi_x")
    shapes = rover_shapes(rover)
    qpos = jnp.asarray(rover.compile().qpos0, jnp.float32)
    other = qpos.at[0].add(2.0)
    both = together(placed(shapes, rover, qpos), placed(shapes, rover, other))
    assert len(both.kind) == 2 * len(shapes.kind) and (np.diff(both.kind) >= 0).all()
    down = jnp.array([[0.0, 0.0, -1.0]])
    for x in (0.0, 2.0):
        assert np.isfinite(hit(both, jnp.array([x, 0.0, 3.0]), down)[0][0])
    assert np.isinf(hit(both, jnp.array([1.0, 0.0, 3.0]), down)[0][0])
