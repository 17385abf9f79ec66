"""Matrices, rays and mounts of cameras."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.cameras import Pinhole, facing, front_mount, look_at, orbit, project
from lunar_mjx.cameras.mount import carried
from lunar_mjx.errors import UserError
from lunar_mjx.rover import load_rover


def test_matrices_and_rays_tell_the_same_pixel():
    """A point along the ray of a pixel lands on that pixel through view and projection matrix."""
    camera, pose = Pinhole(32, 24, 50.0), look_at((1.0, 2.0, 3.0), (4.0, 1.0, 0.5))
    column, row, depth = 7, 20, 3.7
    point = pose.position + pose.rotation @ (depth * camera.rays()[row, column])
    clip = camera.projection_matrix() @ pose.view_matrix() @ np.append(point, 1.0)
    assert clip[3] == pytest.approx(depth)
    x, y = clip[:2] / clip[3]
    assert (0.5 * (x + 1) * 32, 0.5 * (1 - y) * 24) == pytest.approx((column + 0.5, row + 0.5))
    assert project(pose, camera, point[None])[0] == pytest.approx((column + 0.5, row + 0.5, depth))


def test_clipping_planes_map_to_the_ends_of_the_clip_space():
    camera = Pinhole(near=0.1, far=50.0)
    for depth, end in ((0.1, -1.0), (50.0, 1.0)):
        clip = camera.projection_matrix() @ np.array([0.0, 0.0, -depth, 1.0])
        assert clip[2] / clip[3] == pytest.approx(end)


def test_poses_are_rotations_and_look_where_they_say():
    for pose in (look_at((0, 0, 2), (1, 1, 0)), orbit((1, 2, 3), 5.0, 30.0, 20.0)):
        assert pose.rotation @ pose.rotation.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
    from_north = orbit((0, 0, 0), 4.0, 0.0, 0.0)
    assert from_north.position == pytest.approx((0, 4, 0)) and -from_north.rotation[:, 2] == pytest.approx((0, -1, 0))
    assert facing(0.0) @ [0, 0, -1] == pytest.approx((1, 0, 0)) and facing(0.0) @ [1, 0, 0] == pytest.approx((0, -1, 0))
    assert (facing(90.0) @ [0, 0, -1])[2] == pytest.approx(-1.0)


@pytest.mark.parametrize("name", ["luvmi_x", "viper"])
def test_front_camera_sits_on_the_mast(name):
    rover = load_rover(name)
    mount = front_mount(rover)
    assert mount.position[2] > 0.9 * rover.chassis_points[:, 2].max() and abs(mount.position[1]) < 1e-9
    turned = carried(mount, np.array([1.0, 2.0, 3.0]), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    assert turned.position == pytest.approx((1.0, 2.0 + mount.position[0], 3.0 + mount.position[2]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Pinhole(0, 10), "width = 0 is outside"),
        (lambda: Pinhole(fovy_deg=190.0), "fovy_deg = 190.0 is outside"),
        (lambda: Pinhole(near=0.0), "near = 0.0 is not between"),
        (lambda: look_at((0, 0, 1), (0, 0, 0)), "gives no picture"),
    ],
)
def test_mistakes_are_one_sentence(make, message):
    with pytest.raises(UserError, match=message):
        make()
