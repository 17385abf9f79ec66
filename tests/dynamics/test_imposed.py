"""Imposed wheel speeds: statics and energy that need no data."""

import dataclasses

import jax
import numpy as np
import pytest

from lunar_mjx.dynamics.imposed import KinematicDrive, Windows
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model

RADIUS, WEIGHT = 0.165, 59.9 * 9.81
PER_AMPERE = 78.71 * 0.7 * 0.044


@pytest.fixture(scope="module")
def drive():
    model = make_model("husky", "flat").add("hard_surface").add("coulomb_friction", "test", torque=2.0)
    model = model.add("rolling_resistance", "test", coefficient=0.0)
    model = model.set("hard_ground", "test", stiffness=5e4, mu=0.6, slip_scale=0.03)
    with jax.enable_x64(True):
        return KinematicDrive(model, 0.08, 0.008)


ROVERS = 2
"""Windows at once in every test, so that one program is compiled for all."""


def run(drive, sides, slope=0.0, edges=21, **values):
    """Windows of (left, right) rim speeds, m/s, each constant or of shape (edge,), up a slope of some radians."""
    wanted = len(sides)
    sides, count = [*sides, *sides[-1:] * (ROVERS - wanted)], ROVERS
    speed = np.zeros((count, edges, 4))
    for i, (left, right) in enumerate(sides):
        speed[i, :, [0, 2]], speed[i, :, [1, 3]] = np.asarray(left) / RADIUS, np.asarray(right) / RADIUS
    flat = np.zeros((count, edges))
    windows = Windows(speed, flat + 9.81 * np.sin(slope), flat, flat + 9.81 * np.cos(slope), np.zeros(count))
    with jax.enable_x64(True):
        params = jax.tree.map(np.asarray, dataclasses.replace(drive.system.params, terrain=None))
        for key, value in values.items():
            effect, _, name = key.partition("__")
            params.effects[effect][name] = np.asarray(value)
        params = jax.tree.map(lambda a: np.broadcast_to(a, (count, *a.shape)), params)
        return jax.tree.map(lambda a: a[:wanted], drive.run(params, windows))


def side(seen, joints):
    return seen.current[:, -1, joints].sum(axis=-1)


def test_straight_drive_costs_friction_alone(drive):
    seen = run(drive, [(0.3, 0.3), (-0.3, -0.3)])
    np.testing.assert_allclose(side(seen, [0, 2]), [4.0 / PER_AMPERE, -4.0 / PER_AMPERE], rtol=1e-3)
    np.testing.assert_allclose(seen.speed_x[:, -1], [0.3, -0.3], rtol=1e-3)


@pytest.mark.slow
def test_rolling_resistance_and_slope_add_up(drive):
    """Within 1 %: gravity stands in the chassis frame, which the drives' reaction tilts by 0.02 deg on its tyres."""
    level = run(drive, [(0.3, 0.3)], rolling_resistance__coefficient=0.05)
    extra = side(level, [0, 2])[0] + side(level, [1, 3])[0] - 8.0 / PER_AMPERE
    assert extra == pytest.approx(0.05 * RADIUS * WEIGHT / PER_AMPERE, rel=0.01)
    slope = np.radians(8.0)
    uphill = run(drive, [(0.3, 0.3)], slope)
    climb = side(uphill, [0, 2])[0] + side(uphill, [1, 3])[0] - 8.0 / PER_AMPERE
    assert climb == pytest.approx(WEIGHT * np.sin(slope) * RADIUS / PER_AMPERE, rel=0.015)


def test_accelerating_costs_inertia(drive):
    """F = m a at the rim, and the wheels' and the rotors' own inertia."""
    ramp = 0.2 + 0.25 * 0.08 * np.arange(21)
    seen = run(drive, [(ramp, ramp)])
    wheels = 4 * 2.6 * RADIUS**2 / 2 + 2 * 5e-5 * 78.71**2
    torque = (59.9 * RADIUS + wheels / RADIUS) * 0.25
    extra = seen.torque[0, 5:].sum(axis=-1).mean() - 0.0
    assert extra == pytest.approx(torque, rel=0.02)


def test_scrub_comes_from_side_slip(drive):
    """A pivot: longitudinal and lateral friction share mu N along the slip, and their moments balance.

    With slip (v_x, v_y) = (u - w c/2, w b/2) at every wheel the balance of yaw moments of Coulomb friction is
    v_x c/2 = v_y b/2: u = w (c/2 + b^2/(2 c)), whatever mu is.
    """
    seen = run(drive, [(-0.15, 0.15)])
    wheelbase, track = 0.512, 0.5708
    ideal = 0.15 / (track / 2 + wheelbase**2 / (2 * track))
    assert seen.yaw_rate[0, -1] == pytest.approx(ideal, rel=0.03)
    force = 0.6 * WEIGHT / 4 * wheelbase / np.hypot(wheelbase, track)
    pull = (side(seen, [1, 3])[0] - 4.0 / PER_AMPERE) * PER_AMPERE / RADIUS / 2
    assert pull == pytest.approx(force, rel=0.03)


def test_power_of_the_drives_is_what_the_ground_takes(drive):
    """Steady on level ground the drives' power less friction in the gear is lost to slip; nothing is created."""
    seen = run(drive, [(0.1, 0.3), (0.3, -0.1)])
    speed = np.array([[0.1, 0.3] * 2, [0.3, -0.1] * 2]) / RADIUS
    power = (seen.torque[:, -1] * speed).sum(axis=-1)
    assert np.all(power > 0.0)
    assert seen.yaw_rate[0, -1] > 0.0 > seen.yaw_rate[1, -1]


def test_other_joints_are_refused():
    with pytest.raises(UserError, match="imposed wheel speeds need a rover whose drives are its only joints"):
        KinematicDrive(make_model("luvmi_x", "flat"), 0.1)
