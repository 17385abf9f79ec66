"""Dust that wheels throw up: arcs, what throws none, and what a picture shows of it."""

from __future__ import annotations

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.cameras import Dust, Pinhole, Regolith, RoverCamera, Sun, look_at, project, wheel_motion
from lunar_mjx.cameras.dust.grains import SPRAY, Grains, WheelMotion
from lunar_mjx.cameras.dust.veil import sunlit, veiled
from lunar_mjx.rover import Rover, load_rover
from lunar_mjx.terrain import flat, inclined
from lunar_mjx.terrain.soil.maps import SoilMap

GRAVITY, END = 1.62, 2.0
TIME = np.arange(0.0, END + 1e-9, 0.05)
GROUND = flat(40.0)


@functools.cache
def viper() -> Rover:
    return load_rover("viper")


def coordinates(rim: float, speed: float, lift: float = -0.02) -> np.ndarray:
    """A level VIPER whose wheels' rims turn at a speed while it goes at another, m/s, (time, nq)."""
    rover = viper()
    model = rover.compile()
    qpos = np.tile(model.qpos0, (len(TIME), 1))
    qpos[:, 0], qpos[:, 2] = speed * TIME, rover.standing_height + lift
    for wheel in rover.wheels:
        qpos[:, int(model.joint(wheel.drive).qposadr[0])] = rim / wheel.radius * TIME
    return qpos


def thrown(rim: float, speed: float, lift: float = -0.02, ground=GROUND, **more) -> Dust:
    rover = viper()
    return Dust(rover, ground, TIME, wheel_motion(rover, coordinates(rim, speed, lift)), **{"gravity": GRAVITY} | more)


@pytest.mark.parametrize(("rim", "speed"), [(0.6, 0.0), (0.6, 0.2), (1.0, 0.5)])
def test_no_grain_has_more_energy_than_the_rim_gave_it(rim: float, speed: float) -> None:
    """Speed v at the start and height: z + v_z^2 / 2 g is at most where the rim let go, and v^2 / 2 g above it."""
    found = thrown(rim, speed).at(END)
    radius, width = viper().wheels[0].radius, viper().wheels[0].width
    leave = np.arccos(1.0 - 0.02 / radius) + SPRAY.sweep
    most = np.sqrt(rim**2 + speed**2 - 2.0 * rim * speed * np.cos(leave))
    released = radius * (1.0 - np.cos(leave)) - 0.02
    apex = found.position[:, 2] + found.velocity[:, 2] ** 2 / (2.0 * GRAVITY)
    energy = np.sum(found.velocity**2, axis=-1) / (2.0 * GRAVITY) + found.position[:, 2]
    assert len(apex) > 500 and (found.position[:, 2] > 0.0).all()
    assert energy.max() <= released + most**2 / (2.0 * GRAVITY) + 1e-9
    assert apex.max() <= released + (rim * np.sin(leave)) ** 2 / (2.0 * GRAVITY) + 1e-9
    assert apex.max() > 0.6 * (released + (rim * np.sin(leave)) ** 2 / (2.0 * GRAVITY))
    # backwards, and within the wheels' width but for a little that goes aside
    places = wheel_motion(viper(), coordinates(rim, speed)[-1:]).centre[0]
    assert np.median(found.position[:, 0] - places[found.wheel, 0]) < 0.0
    assert np.quantile(np.abs(found.position[:, 1] - places[found.wheel, 1]), 0.95) < 0.5 * width + 0.1


def test_grains_fly_parabolas_and_come_down_at_once() -> None:
    """Wheels stop at half of the time: what then flies falls freely, and is gone as soon as it can be."""
    rim = 0.5
    qpos = coordinates(rim, 0.0)
    qpos[len(TIME) // 2 :] = qpos[len(TIME) // 2]
    dust = Dust(viper(), GROUND, TIME, wheel_motion(viper(), qpos), GRAVITY)
    for wait in (0.05, 0.15):
        before, after = dust.at(1.05), dust.at(1.05 + wait)
        later = before.position + wait * before.velocity + [0.0, 0.0, -0.5 * GRAVITY * wait**2]
        flies = later[:, 2] > 0.0
        assert 0 < flies.sum() < len(flies)
        np.testing.assert_allclose(after.position, later[flies], atol=1e-9)
    assert len(dust.at(1.0 + 2.0 * rim / GRAVITY + 0.3).position) == 0


@pytest.mark.parametrize(
    ("why", "options"),
    [
        ("rolls without slip", {"rim": 0.3, "speed": 0.3}),
        ("stands", {"rim": 0.0, "speed": 0.0}),
        ("skids without turning", {"rim": 0.0, "speed": 0.5}),
        ("hangs above the ground", {"rim": 0.6, "speed": 0.0, "lift": 0.05}),
        ("is on hard ground", {"rim": 0.6, "speed": 0.0, "hard": True}),
        ("is in air", {"rim": 0.6, "speed": 0.0, "gravity": 9.81}),
        (
            "is on rock",
            {
                "rim": 0.6,
                "speed": 0.0,
                "ground": dataclasses.replace(
                    GROUND, soil=SoilMap(jnp.ones((4, 4)), *(jnp.asarray(v) for v in (-20.0, -20.0, 10.0)))
                ),
            },
        ),
    ],
)
def test_nothing_is_thrown_by_a_wheel_that(why: str, options: dict) -> None:
    del why
    assert len(thrown(**options).at(END).position) == 0


def test_count_is_bounded_and_what_is_left_out_is_carried_by_the_others() -> None:
    slow, fast = thrown(0.3, 0.0).at(END), thrown(3.0, 0.0).at(END)
    assert np.bincount(slow.wheel).max() < np.bincount(fast.wheel).max() <= SPRAY.most
    wheel = viper().wheels[0]
    single = SPRAY.cover * wheel.width / SPRAY.per_metre
    assert slow.area == pytest.approx(single)
    # In flight is what was thrown over the time of flight: sinkage and chance are the same, flights and slip scale.
    ratio = np.unique(np.round(fast.area / single, 6))
    assert len(ratio) == 1 and ratio[0] >= 2.0 and np.log2(ratio[0]) % 1.0 == 0.0


def test_the_same_drive_throws_the_same_and_its_beginning_does_not_know_the_end() -> None:
    motion = wheel_motion(viper(), coordinates(0.6, 0.1))
    whole = Dust(viper(), GROUND, TIME, motion, GRAVITY)
    half = Dust(viper(), GROUND, TIME[:21], WheelMotion(*(m[:21] for m in motion)), GRAVITY)
    a, b = whole.at(float(TIME[20])), half.at(float(TIME[20]))
    assert len(a.position) > 500
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one, other)
    other_seed = Dust(viper(), GROUND, TIME, motion, GRAVITY, seed=1).at(float(TIME[20]))
    assert np.abs(other_seed.position[:100] - a.position[:100]).max() > 0.01


def test_a_rover_that_rolls_over_or_diverges_still_has_pictures() -> None:
    """Wheels on their side throw nothing; what is not finite is no throw, and spoils none before it."""
    qpos = coordinates(0.6, 0.0)
    qpos[20:, 3:7] = np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0
    over = Dust(viper(), GROUND, TIME, wheel_motion(viper(), qpos), GRAVITY)
    assert len(over.at(float(TIME[19])).position) > 500 and len(over.at(END).position) == 0
    motion = wheel_motion(viper(), coordinates(0.6, 0.0))
    motion.centre[30:], motion.angle[30:] = np.nan, np.nan
    lost = Dust(viper(), GROUND, TIME, motion, GRAVITY)
    assert np.isfinite(lost.at(float(TIME[32])).position).all() and len(lost.at(float(TIME[29])).position) > 500


def test_backwards_they_are_thrown_ahead() -> None:
    places = wheel_motion(viper(), coordinates(-0.6, 0.0)[-1:]).centre[0]
    found = thrown(-0.6, 0.0).at(END)
    assert np.median(found.position[:, 0] - places[found.wheel, 0]) > 0.05


def test_grains_stay_above_a_slope() -> None:
    rover, slope = viper(), inclined(np.radians(15.0), 40.0)
    field = slope.field
    tilt = np.arctan2(
        float(field.heights[0, -1] - field.heights[0, 0]), float(field.cell) * (field.heights.shape[1] - 1)
    )
    qpos = coordinates(0.6, 0.0)
    lift = rover.standing_height - 0.02
    qpos[:, 3:7] = np.cos(0.5 * tilt), 0.0, -np.sin(0.5 * tilt), 0.0
    qpos[:, 0], qpos[:, 2] = -lift * np.sin(tilt), lift * np.cos(tilt)
    found = Dust(rover, slope, TIME, wheel_motion(rover, qpos), GRAVITY).at(END)
    above = found.position[:, 2] - np.tan(tilt) * found.position[:, 0]
    assert abs(tilt) == pytest.approx(np.radians(15.0), abs=1e-3)
    assert len(above) > 500 and above.min() > 0.0 and above.max() < 0.35


def one_grain(area: float = 4e-4, away: float = 3.0) -> Grains:
    return Grains(np.array([[away, 0.0, 0.0]]), np.zeros((1, 3)), np.array([0.01]), np.array([area]), np.zeros(1, int))


def test_a_grain_takes_as_much_light_as_its_cross_section_and_only_from_what_is_behind() -> None:
    eye, pose, sun = Pinhole(60, 40, 20.0), look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), np.array([-0.8, 0.0, 0.6])
    white, far, gain = np.ones((40, 60, 3)), np.full((40, 60), 9.0), 5.0
    grain = one_grain()
    dark = veiled(white, far, pose, eye, grain, np.array([False]), sun, gain)
    taken = -np.log(dark[..., 0])
    assert taken.sum() == pytest.approx(grain.area[0] * (eye.focal / 3.0) ** 2, rel=0.08)
    assert taken.max() == taken[20, 30] and (taken[:10] == 0.0).all()
    assert (veiled(white, np.full((40, 60), 2.0), pose, eye, grain, np.array([True]), sun, gain) == white).all()
    black = np.zeros_like(white)
    assert (veiled(black, far, pose, eye, grain, np.array([False]), sun, gain) == black).all()
    bright = veiled(black, far, pose, eye, one_grain(1.0), np.array([True]), sun, gain)
    # thick: as bright as a cloud of the grains, by the phase angle of the ray there
    assert bright[20, 30, 0] == pytest.approx(gain * float(Regolith().cloud(0.8)), rel=0.02)
    assert bright[20, 30, 0] >= bright[20, 30, 2]


def test_pictures_differ_near_the_wheels_alone(opengl: tuple[str, ...]) -> None:
    rover, optics = viper(), Pinhole(240, 160, 45.0)
    qpos = coordinates(0.8, 0.1)
    found = thrown(0.8, 0.1).at(END)
    wheels = wheel_motion(rover, qpos[-1:]).centre[0]
    with RoverCamera(
        rover, GROUND, qpos[:, :2], optics, sun=Sun(150.0, 20.0), largest=(240, 160), backends=opengl
    ) as camera:
        camera.place(qpos[-1])
        pose = look_at(qpos[-1, :3] + [-3.0, -2.0, 1.2], qpos[-1, :3])
        plain = camera.picture(pose, optics).astype(int)
        dusty = camera.picture(pose, optics, dust=found).astype(int)
        again = camera.picture(pose, optics, dust=found).astype(int)
        lit = sunlit(camera.model, camera.data, found.position, camera.sun.direction)
    assert (dusty == again).all()
    changed = np.abs(dusty - plain).max(axis=-1) > 2
    rows, columns = np.nonzero(changed)
    assert 60 < len(rows) < 0.1 * changed.size
    middle = project(pose, optics, wheels)
    # no farther than a grain can fly: 0.7 m at 0.8 m/s and the wheel's own radius
    reach = 0.9 * optics.focal / middle[:, 2].min()
    apart = np.hypot(columns[:, None] + 0.5 - middle[:, 0], rows[:, None] + 0.5 - middle[:, 1]).min(axis=1)
    assert apart.max() < reach and np.median(apart) < 0.4 * reach
    assert 0.2 < lit.mean() < 1.0  # some fly in the rover's shadow
