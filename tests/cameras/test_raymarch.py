"""Depth and height images in JAX, against planes, spheres and MuJoCo's renderer."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_scene import EYE, bumpy

from lunar_mjx.cameras import Pinhole, depth_image, depth_images, front_mount, height_scan, look_at, mounted
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import flat, inclined, sample


@pytest.fixture(scope="module")
def march():
    """One compiled function for all pictures of one size."""
    return jax.jit(lambda terrain, position, rotation: depth_image(terrain, position, rotation, EYE))


def test_plane_is_exact(march):
    pose = look_at((0.0, 0.0, 1.2), (4.0, 1.0, 0.0))
    for terrain in (flat(100.0), inclined(np.radians(10.0), 100.0)):
        seen = np.asarray(march(terrain, jnp.asarray(pose.position), jnp.asarray(pose.rotation)))
        rays = EYE.rays() @ pose.rotation.T
        _, dzdx, dzdy = (float(v) for v in sample(terrain.field, 0.0, 0.0))
        true = 1.2 / (dzdx * rays[..., 0] + dzdy * rays[..., 1] - rays[..., 2])
        place = pose.position + true[..., None] * rays
        sure = (true > 0.3) & (true < 40.0) & (np.abs(place[..., :2]) < 49.0).all(-1)
        assert sure.mean() > 0.5
        assert np.abs(seen[sure] / true[sure] - 1.0).max() < 2e-4
        assert np.isinf(seen[(true < 0.0) | (true > 61.0)]).all()


def test_sphere_is_exact(march):
    """The upper half of a boulder; its foot is in the ground."""
    terrain = bumpy()
    pose = look_at((1.0, 0.6, 1.0), (3.0, 0.6, 0.45))
    seen = np.asarray(march(terrain, jnp.asarray(pose.position), jnp.asarray(pose.rotation)))
    ray = EYE.rays()[30, 40] @ pose.rotation.T
    to = np.array([3.0, 0.6, 0.2]) - pose.position
    b, c = ray @ to / (ray @ ray), (to @ to - 0.35**2) / (ray @ ray)
    assert seen[30, 40] == pytest.approx(b - np.sqrt(b * b - c), rel=2e-4)


@pytest.mark.slow
def test_batch_and_chunks_agree_with_one(march):
    terrain, small = bumpy(), Pinhole(16, 12)
    poses = [look_at((0.0, 0.3 * i, 1.0 + 0.1 * i), (3.0, 0.0, 0.0)) for i in range(5)]
    position, rotation = (jnp.asarray(np.stack([getattr(p, k) for p in poses])) for k in ("position", "rotation"))
    whole = depth_images(terrain, position, rotation, small)
    parts = depth_images(terrain, position, rotation, small, at_once=2)
    assert whole.shape == (5, 12, 16)
    # Programs of other batch sizes round differently; grazing rays make 6e-5 m of it, within what a depth is good to.
    np.testing.assert_allclose(whole, parts, rtol=1e-4)
    one = depth_image(terrain, position[3], rotation[3], small)
    np.testing.assert_allclose(whole[3], one, rtol=1e-4)


def test_height_scan_looks_ahead_and_to_the_left():
    terrain = bumpy(rocks=False)
    position, yaw = jnp.array([[1.0, 0.5, 0.4], [0.0, 0.0, 0.0]]), jnp.array([0.5 * jnp.pi, 0.0])
    seen = height_scan(terrain, position, yaw, (5, 3), ahead=(0.0, 2.0), aside=1.0)
    assert seen.shape == (2, 5, 3)
    # heading north: two metres ahead is y + 2, a metre to the left is x - 1
    for row, column, x, y in ((0, 1, 1.0, 2.5), (4, 0, 0.0, 0.5), (4, 2, 2.0, 0.5)):
        assert float(seen[0, row, column]) == pytest.approx(float(sample(terrain.field, x, y)[0]) - 0.4, abs=1e-6)


def test_agrees_with_the_renderer(scene, march):
    """Half of the pixels within 1 % is asked for; MuJoCo draws triangles, and JAX bilinear patches."""
    camera, qpos = scene
    images = camera.front()
    mount = front_mount(load_rover("luvmi_x"))
    position, rotation = mounted(mount, jnp.asarray(qpos))
    assert np.asarray(position) == pytest.approx(camera.front_pose.position, abs=1e-6)
    assert np.asarray(rotation) == pytest.approx(camera.front_pose.rotation, abs=1e-6)
    seen = np.asarray(march(bumpy(), position, rotation))
    both = np.isfinite(seen) & np.isfinite(images.depth) & (images.segmentation != 3)
    assert both.mean() > 0.4
    assert (np.isfinite(seen) == np.isfinite(images.depth)).mean() > 0.99
    error = np.abs(seen[both] / images.depth[both] - 1.0)
    assert np.median(error) < 0.002 and np.mean(error > 0.01) < 0.05
    rocks = both & (images.segmentation == 2)
    assert rocks.sum() > 50 and np.median(error[rocks[both]]) < 0.01


def test_coordinates_as_mujoco_gives_them(recwarn):
    """Arrays of float64 in NumPy are taken without a warning, and give what the same in JAX gives."""
    rover = load_rover("luvmi_x")
    qpos = np.array([[1.0, 2.0, 0.5, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.3, 0.6, 0.0, 0.0, 0.8]])
    yaw = np.array([0.0, 1.8])
    seen = [
        (*mounted(front_mount(rover), q), height_scan(flat(10.0), q[:, :3], y, (4, 4)))
        for q, y in ((qpos, yaw), (jnp.asarray(qpos), jnp.asarray(yaw)))
    ]
    for got, want in zip(*seen, strict=True):
        np.testing.assert_array_equal(got, want)
    assert not [w for w in recwarn if "dtype" in str(w.message)]
