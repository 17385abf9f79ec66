"""Rock, boulders and soil by place, and the ambient temperature."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import Ambient, build
from lunar_mjx.dynamics.state import compensated_add
from lunar_mjx.model import make_model
from lunar_mjx.model.ambient import SYNODIC_DAY
from lunar_mjx.terrain import SoilMap, build_rocks, flat

EVERY = 50
BOULDER_X, BOULDER_RADIUS = 1.0, 0.4
LOW_RADIUS, LOW_LINE = 0.15, -12.0  # passes between the wheels, but not under the belly


@pytest.fixture(scope="module")
def drives():
    """A LUVMI-X on ground with two boulders ahead whose northern part is rock, run along four lines."""
    ground = flat(40.0)
    centers = np.array([[BOULDER_X, 0.0, 0.1], [BOULDER_X, LOW_LINE, 0.0]])
    rocks = build_rocks(centers, np.array([BOULDER_RADIUS, LOW_RADIUS]), (-20.0, -20.0, 20.0, 20.0))
    rock = np.zeros((41, 41), np.float32)
    rock[24:] = 1.0  # y from 4 m on
    soil = SoilMap(jnp.asarray(rock), jnp.asarray(-20.0), jnp.asarray(-20.0), jnp.asarray(1.0))
    system = build(make_model("luvmi_x", dataclasses.replace(ground, rocks=rocks, soil=soil)))
    control = jnp.zeros((100, len(system.joint_names))).at[:, :4].set(1.5)

    def run(y):
        start = jax.vmap(lambda y: system.reset(system.params, 0.0, y))(y)
        return system.rollout_batch(system.params, start, control, EVERY, one_body=True)[1]

    # head-on, on soft soil far from the boulders, on rock, and at the low boulder
    return jax.device_get(jax.jit(run)(jnp.array([0.0, -6.0, 8.0, LOW_LINE])))


@pytest.mark.slow
def test_a_boulder_stops_or_lifts_the_rover(drives) -> None:
    """No wheel centre ever enters the boulder, and the rover that meets it lags behind the one that does not."""
    x, y, z = (np.asarray(c)[0] for c in drives.wheel_position)
    distance = np.sqrt((x - BOULDER_X) ** 2 + y**2 + (z - 0.1) ** 2)
    assert np.isfinite(distance).all()
    # the wheels stand beside the centre line; their rims may touch, their centres stay outside
    assert distance.min() > BOULDER_RADIUS + 0.03
    free, stopped = drives.position.x[1, -1], drives.position.x[0, -1]
    assert free > 0.7
    assert stopped < free - 0.1 or drives.position.z[0].max() > drives.position.z[1].max() + 0.05


def test_a_boulder_between_the_wheels_does_not_pass_through_the_chassis(drives) -> None:
    """A boulder higher than the belly stops the chassis at its front face, though no wheel touches it."""
    x, belly = np.asarray(drives.position.x[3]), 0.115
    # the hull reaches 0.35 m ahead of the frame and meets the sphere at the height of the belly
    meets = BOULDER_X - np.sqrt(LOW_RADIUS**2 - belly**2) - 0.35
    assert x.max() == pytest.approx(meets, abs=0.05)
    assert abs(x[-1] - x[-20]) < 0.01


def test_rock_carries_without_sinkage_and_slip(drives) -> None:
    """On rock, wheels stand on the surface and hardly slip; on soil they sink and slip."""
    soft, rock = drives.sinkage[1, -1], drives.sinkage[2, -1]
    assert (rock < 1e-3).all() and (soft > 5e-3).all()
    assert np.abs(drives.slip[2, -20:].mean()) < 0.02 < drives.slip[1, -20:].mean()
    assert drives.position.x[2, -1] > drives.position.x[1, -1]


def test_ambient_temperature_is_constant_or_follows_the_sun() -> None:
    """Noon and night temperatures are reached; half a day after noon it is night; equal ones are constant."""
    day = Ambient(400.0, 100.0, 0.0, SYNODIC_DAY)
    times = jnp.array([0.0, 0.2 * SYNODIC_DAY, 0.25 * SYNODIC_DAY, 0.5 * SYNODIC_DAY, SYNODIC_DAY])
    noon, afternoon, _, midnight, again = np.asarray(day.at(times))
    assert noon == pytest.approx(400.0, rel=1e-6) and midnight == pytest.approx(100.0) and again == pytest.approx(400.0)
    assert afternoon == pytest.approx(100.0 + 300.0 * np.cos(0.4 * np.pi) ** 0.25, rel=1e-4)
    constant = Ambient(250.0, 250.0, 0.0, SYNODIC_DAY)
    assert (np.asarray(constant.at(times)) == 250.0).all()
    slope = jax.vmap(jax.grad(lambda t: day.at(t)))(times)
    assert np.isfinite(np.asarray(slope)).all()


def test_compensated_sum_keeps_small_increments() -> None:
    """1e5 increments of 1e-6 K on 100 K: float32 alone loses them all, the compensated sum none."""

    def add(carry, _):
        total, lost, plain = carry
        return (*compensated_add(total, lost, jnp.float32(1e-6)), plain + jnp.float32(1e-6)), None

    start = (jnp.float32(100.0), jnp.float32(0.0), jnp.float32(100.0))
    (total, _, plain), _ = jax.jit(lambda c: jax.lax.scan(add, c, length=100_000))(start)
    assert float(total) == pytest.approx(100.1, abs=1e-5)
    assert float(plain) == 100.0
