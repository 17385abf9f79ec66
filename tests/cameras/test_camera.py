"""Pictures through MuJoCo's renderer."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from camera_scene import EYE

from lunar_mjx.cameras import LABELS, Pinhole, RoverCamera, Sun, Track, look_at, orbit, project
from lunar_mjx.cameras import gl as camera_gl
from lunar_mjx.cameras.texture import TrackPainter, regolith, thinned
from lunar_mjx.errors import UserError
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import flat

SKY, GROUND, ROCK, ROVER = range(4)


def test_front_images_are_as_the_paper_defines_them(scene):
    camera, _ = scene
    images = camera.front()
    assert images.rgba.shape == (60, 80, 4) and images.rgba.dtype == np.uint8 and (images.rgba[..., 3] == 255).all()
    assert images.depth.shape == images.segmentation.shape == (60, 80)
    assert Pinhole() == Pinhole(320, 240)
    assert LABELS == ("sky", "terrain", "rock", "rover")
    assert {GROUND, ROCK, SKY} <= set(np.unique(images.segmentation))
    assert (np.isinf(images.depth) == (images.segmentation == SKY)).all()
    assert (images.rgba[images.segmentation == SKY][:, :3] == 0).mean() > 0.95  # black, but for smoothed edges
    assert images.rgba[images.segmentation == GROUND][:, :3].mean() > 30


def test_matrices_take_a_boulder_to_its_pixels(scene):
    camera, _ = scene
    images = camera.front()
    centre = np.array([3.0, 0.6, 0.2, 1.0])
    clip = images.projection @ images.view @ centre
    column, row = 0.5 * (clip[0] / clip[3] + 1) * 80, 0.5 * (1 - clip[1] / clip[3]) * 60
    assert images.segmentation[int(row), int(column)] == ROCK
    u, v, depth = project(camera.front_pose, EYE, centre[None, :3])[0]
    assert (u, v) == pytest.approx((column, row))
    assert depth - 0.36 < images.depth[int(row), int(column)] < depth


def test_free_camera_sees_the_rover_and_its_shadow(scene):
    """The Sun stands in the east: the ground west of the rover is darker than that to the east."""
    camera, qpos = scene
    above = look_at((qpos[0], qpos[1], 6.0), qpos[:3], up=(0.0, 1.0, 0.0))
    images = camera.take(above, Pinhole(120, 120, 40.0))
    rover = images.segmentation == ROVER
    assert rover.any()
    grey = images.rgba[..., :3].mean(axis=-1)
    rows, columns = np.nonzero(rover)
    middle = slice(rows.min() + 4, rows.max() - 4)
    west = grey[middle, columns.min() - 30 : columns.min() - 18]
    east = grey[middle, columns.max() + 6 : columns.max() + 18]
    assert west.mean() < 0.5 * east.mean()


def test_view_follows_the_azimuth(scene):
    camera, qpos = scene
    assert (camera.take(orbit(qpos[:3], 3.0, 200.0, 25.0), Pinhole(60, 40)).segmentation == ROVER).mean() > 0.02


def test_tracks_darken_where_wheels_rolled():
    ground = regolith(400, 4.0)
    assert ground.shape == (400, 400, 3) and 0.02 < ground.std() / ground.mean() < 0.3
    line = np.stack([np.linspace(0.5, 3.5, 200), np.full(200, 1.0)], axis=-1)
    painter = TrackPainter(ground, (0.0, 0.0), (4.0, 4.0), [Track(line, 0.2)])
    assert (painter.paint(0) == ground).all()
    half = painter.paint(100).astype(float).mean(-1) / np.maximum(ground.mean(-1), 1.0)
    assert half[300, 150] < 0.85 and half[300, 250] > 0.98
    painted = painter.paint(200)
    change = painted.astype(float).mean(-1) / np.maximum(ground.mean(-1), 1.0)
    inside = change[295:305, 60:340]  # row 300 is y = 1 m, north up
    assert inside.max() < 0.85 and inside.min() < 0.6
    assert (change[:280] > 0.98).all() and (change[320:] > 0.98).all()
    assert len(thinned(line, 0.1)) == pytest.approx(31, abs=1)


def test_sun_is_refused_below_the_horizon():
    with pytest.raises(UserError, match="elevation_deg = -3 is outside"):
        Sun(0.0, -3)
    assert Sun(90.0, 0.001).direction == pytest.approx((1, 0, 0), abs=1e-4)


def test_no_opengl_is_one_sentence(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(UserError, match="MUJOCO_GL=disable turns OpenGL off; unset it"):
        camera_gl.context_class()
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert camera_gl.wanted_backends() == ("osmesa",)
    monkeypatch.delenv("MUJOCO_GL")
    assert camera_gl.wanted_backends() == ("egl", "osmesa")
    monkeypatch.setattr(camera_gl, "_chosen", {})
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", None)
    with pytest.raises(UserError, match=r"no OpenGL works here .tried egl, osmesa.; install EGL .*libegl1"):
        camera_gl.context_class()


UNCLOSED = """
import weakref

class Thing: pass

thing = Thing()
weakref.finalize(thing, int)  # as libraries do: from here on all that is left is freed last at the end
from lunar_mjx.cameras import Pinhole, RoverCamera
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import flat

camera = RoverCamera(load_rover("luvmi_x"), flat(20.0), camera=Pinhole(80, 60), largest=(80, 60))
print(camera.front().depth.shape)
"""


def test_a_camera_that_nobody_closes_ends_without_a_word(opengl):
    """EGL is ended by its own library when Python ends; contexts must be freed before."""
    environment = {**os.environ, "MUJOCO_GL": opengl[0]}
    ended = subprocess.run([sys.executable, "-c", UNCLOSED], capture_output=True, text=True, env=environment)
    assert ended.returncode == 0 and ended.stdout == "(60, 80)\n"
    assert "Error" not in ended.stderr and "Traceback" not in ended.stderr


def test_mistakes_are_one_sentence(scene):
    camera, qpos = scene
    with pytest.raises(UserError, match=r"qpos = .* has another shape; give "):
        camera.place(qpos[:5])


def test_tracks_show_in_the_picture(opengl):
    """Painted into the texture while the rover drives: seen from above, north up, where the wheel rolled."""
    at = np.linspace(-2.0, 2.0, 101)
    track = Track(np.stack([at, np.full(101, 1.0)], axis=-1), 0.4, 0.0)
    with RoverCamera(
        load_rover("luvmi_x"),
        flat(20.0),
        np.zeros((1, 2)),
        EYE,
        sun=Sun(180.0, 60.0),
        tracks=[track],
        margin=6.0,
        largest=(200, 200),
        backends=opengl,
        untrodden=True,
    ) as camera:
        above, optics = look_at((0.0, 1.0, 5.0), (0.0, 1.0, 0.0), up=(0.0, 1.0, 0.0)), Pinhole(200, 200, 50.0)
        before = np.maximum(camera.picture(above, optics).astype(float).mean(-1), 1.0)
        camera.roll(51)
        half = camera.picture(above, optics).astype(float).mean(-1) / before
        camera.roll(101)
        whole = camera.picture(above, optics).astype(float).mean(-1) / before
    # 5 m above, 50 deg: 4.66 m are 200 pixels; the track runs along the middle row
    assert half[95:105, 30:90].mean() < 0.85 and half[95:105, 115:180].mean() > 0.97
    assert whole[95:105, 30:170].mean() < 0.85
    assert whole[60:80, 30:170].mean() > 0.97 and whole[125:140, 130:170].mean() > 0.97
