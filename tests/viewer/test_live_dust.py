"""Dust of a drive that goes on: the same grains as a record of it has, and what the page is told of them."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from lunar_mjx.cameras import Dust, Sun, wheel_motion
from lunar_mjx.model import make_model
from lunar_mjx.viewer.drive import LiveDrive
from lunar_mjx.viewer.scene import dust_scene, rover_scene
from lunar_mjx.viewer.thrown import LIVE_DUST, LiveDust


@functools.cache
def model():
    return make_model("viper", "flat")


@functools.cache
def drive() -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and coordinates of a level VIPER that drives at 0.2 m/s while its rims turn at 0.2 to 0.8."""
    rover = model().rover
    compiled, time = rover.compile(), np.arange(0.0, 9.0, 0.02)
    qpos = np.tile(compiled.qpos0, (len(time), 1))
    qpos[:, 0], qpos[:, 2] = 0.2 * time, rover.standing_height - 0.02
    way = 0.5 * time - 0.3 * np.sin(time)
    for wheel in rover.wheels:
        qpos[:, int(compiled.joint(wheel.drive).qposadr[0])] = way / wheel.radius
    return time, qpos


def test_grains_are_those_of_the_whole_drive_although_its_beginning_is_forgotten() -> None:
    time, qpos = drive()
    rover = model().rover
    whole = Dust(rover, model().terrain, time, wheel_motion(rover, qpos), model().gravity)
    live, compared = LiveDust(model()), 0
    for row, (t, q) in enumerate(zip(time, qpos, strict=True)):
        live.add(t, q)
        found = live.at(t)
        if row % 50 == 49:
            record = whole.at(t, LIVE_DUST.most)
            np.testing.assert_allclose(found.position, record.position, atol=1e-6)
            compared += len(found.position) > 50
    assert compared >= 5 and np.bincount(found.wheel).max() <= LIVE_DUST.most
    live.begin()
    assert len(live.at(10.0).position) == 0


def test_a_drive_with_slip_tells_the_page_of_its_grains() -> None:
    """A start with spinning wheels throws soil; a rover at rest and one in air throw none."""
    live = LiveDrive(make_model("viper", "slope:14deg"), "native", top_speed=0.9)
    assert dust_scene(live.dust()) == []
    live.pilot.hold(["forward"])
    for _ in range(60):
        live.advance(0.04)
    rows = np.reshape(dust_scene(live.dust()), (-1, 5))
    wheels = live.bodies()[[w["body"] for w in rover_scene(live.model, Sun())["wheels"]], :3]
    assert len(rows) > 50 and (rows[:, 3:] > 0.0).all()
    assert np.linalg.norm(rows[:, None, :3] - wheels, axis=-1).min(axis=1).max() < 1.5
    live.reset()
    assert dust_scene(live.dust()) == []


def test_the_page_draws_grains_as_bright_beside_the_ground_as_other_cameras_do() -> None:
    """At grazing view across the light of a Sun 30 deg high, by the page's own formula and by `Regolith.cloud`."""
    from lunar_mjx.cameras import Film, Regolith

    over, albedo, lobe, back = rover_scene(model(), Sun(90.0, 30.0))["cloud"]
    for towards in (-0.5, 0.0, 0.9):
        one, other = ((1 - lobe**2) / (1 + lobe**2 - 2 * lobe * c) ** 1.5 for c in (towards, -towards))
        told = over * 0.125 * albedo * ((1 + back) * one + (1 - back) * other)
        film = Film()
        expected = film.gain(Regolith(), 0.5) * Regolith().cloud(towards) / film.mid
        assert told == pytest.approx(float(expected), rel=1e-5)
