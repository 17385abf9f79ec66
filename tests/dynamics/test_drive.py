"""Rovers on the ground: signs, standstill, steep slopes, edges, falling and rolling over."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import State
from tests.dynamics.conftest import bench, plane

EVERY = 50  # 0.1 s


def assert_finite(tree: object) -> None:
    for leaf in jax.tree.leaves(tree):
        assert np.isfinite(np.asarray(leaf, float)).all()


def test_commands_move_the_rover_as_their_signs_say(rover: str) -> None:
    """Positive drive goes forward, negative backward in the mirror image; positive steering turns left."""
    b = bench(rover)
    grounds = [plane(0.0)] * 4
    commands = np.stack(
        [
            np.tile(b.control(drive, steer), (60, 1))
            for drive, steer in ((0.6, 0.0), (-0.6, 0.0), (0.6, 0.15), (0.6, -0.15))
        ]
    )
    _, seen = b.drive(grounds, b.stand(grounds), commands, EVERY)
    assert_finite(seen)
    x, y, yaw = seen.position.x[:, -1], seen.position.y[:, -1], seen.euler.z[:, -1]
    assert x[0] > 0.1 and x[1] < -0.1
    assert abs(y[0]) < 1e-3 and abs(yaw[0]) < 1e-3
    assert yaw[2] > 0.01 and y[2] > 0 and yaw[3] < -0.01 and y[3] < 0
    assert yaw[2] == pytest.approx(-yaw[3], rel=1e-2)
    # slip is positive while driving, in either direction
    assert (seen.slip[0, -1] > 0).all() and (seen.slip[1, -1] > 0).all()
    # the rover is nearly symmetric fore and aft, so that backing up nearly mirrors driving
    assert x[1] == pytest.approx(-x[0], rel=0.1)


def test_suspension_raises_the_chassis(rover: str) -> None:
    """Positive suspension raises the chassis, on every corner."""
    b = bench(rover)
    grounds = [plane(0.0)] * 2
    commands = np.stack([np.tile(b.control(suspension=s), (60, 1)) for s in (0.0, 0.1)])
    _, seen = b.drive(grounds, b.stand(grounds), commands, EVERY)
    rise = seen.position.z[1, -1] - seen.position.z[0, -1]
    assert rise > 0.01
    assert abs(seen.euler.x[1, -1]) < 0.01 and abs(seen.euler.y[1, -1]) < 0.02


def test_rover_stands_in_equilibrium(rover: str) -> None:
    """At rest the ground carries exactly the weight, on four wheels, and nothing moves."""
    b = bench(rover)
    grounds = [plane(0.0)]
    _, seen = b.drive(grounds, b.stand(grounds), np.tile(b.control(), (100, 1)), EVERY)
    weight = b.model.rover.mass * b.model.gravity
    assert seen.wheel_force.z[0, -1].sum() == pytest.approx(weight, rel=1e-3)
    assert (seen.sinkage[0, -1] > 0.005).all()
    assert np.hypot(seen.velocity.x[0, -1], seen.velocity.z[0, -1]) < 1e-4


@pytest.mark.slow
def test_braked_rover_stays_on_a_slope(rover: str) -> None:
    """Braked on 10 degrees of soft soil, after 10 s of settling, it moves < 1 mm in 60 s, whichever way it faces."""
    b = bench(rover)
    grounds = [plane(10.0, direction) for direction in (0.0, 90.0, 45.0, 180.0)]
    _, seen = b.drive(grounds, b.stand(grounds), np.tile(b.control(), (700, 1)), EVERY, brake=True)
    settled, last = 100, -1
    moved = np.sqrt(sum((p[:, last] - p[:, settled]) ** 2 for p in seen.position))
    assert seen.time[0, settled] == pytest.approx(10.0, abs=0.01)
    assert seen.time[0, last] - seen.time[0, settled] >= 59.0
    assert_finite(seen)
    assert (moved < 1e-3).all(), moved


def test_paper_rover_creeps_on_a_slope() -> None:
    """Flaw 4: as printed there is no static friction, and a braked rover creeps down a 10 degree slope."""
    b = bench("luvmi_x", "paper")
    grounds = [plane(10.0)]
    _, seen = b.drive(grounds, b.stand(grounds), np.tile(b.control(), (100, 1)), EVERY, brake=True)
    assert seen.position.x[0, 20] - seen.position.x[0, -1] > 0.01


def test_steep_slope_reversal_and_edge_stay_finite_with_right_signs(rover: str) -> None:
    """30 degree slopes either way and across, reversing wheels, and wheels beyond the terrain's edge."""
    b = bench(rover)
    grounds = [plane(30.0), plane(-30.0), plane(30.0, 90.0), plane(5.0), plane(0.0), plane(0.0)]
    forward, backward = np.tile(b.control(1.0), (30, 1)), np.tile(b.control(-1.0), (30, 1))
    there_and_back = np.concatenate([forward[:15], backward[:15]])
    commands = np.stack([forward, forward, forward, there_and_back, forward, backward])
    edge = 99.9
    start = b.stand(grounds, x=np.array([0, 0, 0, 0, edge, -edge]), yaw=np.array([0, 0, 0, 0, 0.3, 0]))
    final, seen = b.drive(grounds, start, commands, EVERY)
    assert_finite((final, seen))
    # too steep to climb in this soil: the rover does not gain height; downhill it goes forward and down
    assert seen.position.z[0, -1] <= seen.position.z[0, 3] + 1e-3
    assert seen.position.x[1, -1] > 0.1 and seen.position.z[1, -1] < seen.position.z[1, 0]
    # across the slope it slides down, never up
    assert seen.position.y[2, -1] < 0.0
    # reversing: wheels turn forward, then backward
    assert (seen.joint_speed[3, 14, :4] > 0).all() and (seen.joint_speed[3, -1, :4] < 0).all()
    # half the wheels begin beyond the edge, where the ground continues flat and carries them
    assert (~seen.on_terrain[4, 0]).any() and seen.on_terrain[4, 0].any()
    weight = b.model.rover.mass * b.model.gravity
    assert seen.wheel_force.z[4, -1].sum() == pytest.approx(weight, rel=0.05)


def test_airborne_rover_falls_with_gravity_and_wheels_carry_nothing(rover: str) -> None:
    """In free flight the centre of mass falls at g, forces are exactly zero, and gravity is settable."""
    b = bench(rover)
    grounds = [plane(0.0)]
    state = b.stand(grounds)
    state = dataclasses.replace(state, qpos=state.qpos.at[:, 2].add(5.0))
    _, seen = b.drive(grounds, state, np.tile(b.control(), (10, 1)), EVERY)
    for force in (*seen.wheel_force, *seen.wheel_moment):
        assert (force == 0.0).all()
    drop = seen.position.z[0, 0] - seen.position.z[0, -1]
    t = seen.time[0, -1]
    dt = b.model.timestep
    assert drop == pytest.approx(0.5 * 1.625 * t * (t + dt), rel=1e-3)
    assert np.abs(seen.euler.y[0]).max() < 1e-4


def test_rover_on_its_back_rests_on_its_chassis(rover: str) -> None:
    """Dropped upside down or on its side, a rover ends on its chassis or wheels above the ground, at rest, finite."""
    b = bench(rover)
    grounds = [plane(0.0)] * 2
    state = b.stand(grounds)
    upside_down = jnp.array([0.0, 1.0, 0.0, 0.0])
    on_side = jnp.array([np.cos(0.9), np.sin(0.9), 0.0, 0.0])
    qpos = state.qpos.at[:, 3:7].set(jnp.stack([upside_down, on_side])).at[:, 2].set(2.2)
    final, seen = b.drive(grounds, dataclasses.replace(state, qpos=qpos), np.tile(b.control(), (150, 1)), EVERY)
    assert_finite((final, seen))
    assert (seen.position.z[:, -1] > 0.0).all() and (seen.position.z[:, -1] < 2.2).all()
    speed = np.sqrt(sum(v[:, -1] ** 2 for v in seen.velocity))
    assert (speed < 0.05).all()
    _, x, y, _ = seen.quaternion[0, -1]
    assert 1.0 - 2.0 * (x * x + y * y) < 0.5  # the first is not back on its wheels


def test_reset_leans_with_the_slope(rover: str) -> None:
    """At reset no wheel is below the surface, all are near it, and the chassis follows the slope under it."""
    b = bench(rover)
    grounds = [plane(12.0, 30.0)]
    start = b.stand(grounds, yaw=0.7)
    _, seen = b.drive(grounds, start, np.tile(b.control(), (10, 1)), EVERY)
    assert (seen.sinkage[0, 0] < 1e-4).all()
    up = 2.0 * (
        seen.quaternion[0, 0, 1] * seen.quaternion[0, 0, 3] + seen.quaternion[0, 0, 0] * seen.quaternion[0, 0, 2]
    )
    assert up == pytest.approx(-np.sin(np.deg2rad(12.0)) * np.cos(np.deg2rad(30.0)), abs=2e-3)
    assert np.abs(seen.position.z[0, -1] - seen.position.z[0, 0]) < 0.05


@pytest.mark.slow
def test_halving_the_step_hardly_moves_the_end_of_a_drive(rover: str) -> None:
    """20 s of driving with steering on a slope: halving dt changes the end position by < 1 % of the way."""
    ends = []
    for dt, every in ((0.002, 50), (0.001, 100)):
        b = bench(rover, dt=dt)
        grounds = [plane(4.0, 30.0)]
        _, seen = b.drive(grounds, b.stand(grounds), np.tile(b.control(0.8, 0.1), (200, 1)), every)
        ends.append((seen, np.array([p[0, -1] for p in seen.position])))
    way = np.hypot(np.diff(ends[0][0].position.x[0]), np.diff(ends[0][0].position.y[0])).sum()
    assert way > 0.5
    assert np.linalg.norm(ends[0][1] - ends[1][1]) < 0.01 * way


@pytest.mark.slow
def test_payload_weighs_on_the_wheels_near_it() -> None:
    """A payload adds its weight, and more of it to the side where it lies."""
    from lunar_mjx.dynamics import build

    b = bench("luvmi_x")
    model = b.model.add("payload", mass=10.0, y=0.1, z=0.2)
    system = build(model, "mjx")
    state = jax.jit(system.reset)(system.params)
    control = jnp.zeros((100, len(system.joint_names)))
    _, seen = jax.jit(lambda p, s: system.rollout(p, s, control, EVERY))(system.params, state)
    load = np.asarray(seen.wheel_force.z[-1])
    g, mass = model.gravity, model.rover.mass
    assert load.sum() == pytest.approx((mass + 10.0) * g, rel=2e-3)
    left, right = load[0] + load[2], load[1] + load[3]
    track = abs(float(seen.wheel_position.y[-1][0] - seen.wheel_position.y[-1][1]))
    assert (left - right) * track / 2 == pytest.approx(10.0 * g * 0.1, rel=0.1)


def test_state_is_a_pytree_of_arrays() -> None:
    b = bench("luvmi_x")
    state = jax.jit(b.system.reset)(b.system.params)
    assert isinstance(state, State)
    assert all(hasattr(leaf, "dtype") for leaf in jax.tree.leaves(state))
