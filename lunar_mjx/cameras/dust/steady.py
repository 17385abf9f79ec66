"""Dust of rovers in JAX, from how they move now: as if their wheels had turned so for as long as grains fly.

A grain is in the air for a second at most, and in it a wheel's slip changes little. So no history is kept, and a
picture is a function of coordinates and velocities alone.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.cameras.dust.grains import SPRAY, Grains, Throw, judged, released
from lunar_mjx.cameras.shapes import body_poses
from lunar_mjx.rover import Rover
from lunar_mjx.terrain import HeightField, Terrain, sample
from lunar_mjx.terrain.soil.maps import rock_fraction


def steady_dust(
    terrain: Terrain,
    rover: Rover,
    qpos: Float[Array, "nq"],
    qvel: Float[Array, "nv"],
    gravity: Any,
    count: int,
    seed: int = 0,
) -> Grains:
    """The grains in flight about a rover: always as many, those of wheels that throw nothing without area.

    Each wheel's grains stand for all the soil that it has in the air. They leave one after the other as the rim turns:
    of a wheel that turns steadily, pictures show one grain fly on.

    Args:
      terrain: ground, below a wheel taken to be a plane for how long grains fly; rock throws nothing.
      rover: what it is. qpos, qvel: coordinates and velocities of its MJCF.
      gravity: m/s2, downwards; from `SPRAY.heaviest` on there is air, and no dust. count: grains of each wheel.
      seed: of where grains leave and how fast.
    """
    dtype = qpos.dtype
    centre, axle, velocity, turning, angle = _wheels(rover, qpos, qvel)
    radius, width = (jnp.asarray([getattr(w, k) for w in rover.wheels], dtype) for k in ("radius", "width"))
    height, normal = _ground(terrain.field, centre)
    throw = judged(jnp, centre, axle, velocity, turning, height, normal, radius)
    throws = (throw.thrown > 0.0) & (jnp.asarray(gravity) < SPRAY.heaviest)
    throws = throws & (rock_fraction(terrain.soil, centre[:, 0], centre[:, 1]) < 0.5)

    def each(values: Any) -> Any:
        return jnp.repeat(values, count, axis=0)

    random = np.random.default_rng(seed)
    chances = random.random((4, len(rover.wheels) * count))
    # One after the other: chance would leave gaps between so few.
    phase = (np.arange(count) + random.random((len(rover.wheels), count))).ravel() / count
    start, launch = released(
        jnp, Throw(*map(each, throw)), each(radius), each(width), tuple(jnp.asarray(c, dtype) for c in chances)
    )
    above = jnp.sum((start - each(centre)) * each(normal), axis=-1) + each((centre[:, 2] - height) * normal[:, 2])
    rise = jnp.sum(launch * each(normal), axis=-1)
    pull = jnp.maximum(gravity, 1e-3) * each(normal[:, 2])
    flight = (rise + jnp.sqrt(rise**2 + 2.0 * pull * jnp.maximum(above, 0.0))) / pull
    # The rim's way over that within a flight: when the rim turns steadily, it grows by one within a flight.
    turns = each(jnp.abs(angle) * radius) / jnp.maximum(each(throw.rim) * flight, 1e-6)
    age = flight * ((turns + jnp.asarray(phase, dtype)) % 1.0)
    fall = jnp.asarray([0.0, 0.0, -1.0], dtype) * gravity
    # The wheel was as far back as it has come since.
    position = start + (launch - each(throw.along)) * age[:, None] + 0.5 * fall * age[:, None] ** 2
    slipped = each(throw.thrown) * flight
    flies = each(throws) & (position[:, 2] > sample(terrain.field, position[:, 0], position[:, 1])[0])
    stands_for = jnp.maximum(slipped * SPRAY.per_metre / count, 1.0)
    spread = (SPRAY.size + SPRAY.growth * jnp.linalg.norm(launch, axis=-1) * age) * jnp.sqrt(stands_for)
    area = jnp.where(flies, SPRAY.cover * each(width) * slipped / count, 0.0)
    # What is not finite, of a rover that diverged, spoils no picture.
    sound = jnp.isfinite(jnp.sum(position, axis=-1) + area)
    return Grains(
        jnp.where(sound[:, None], position, 0.0),
        jnp.where(sound[:, None], launch + fall * age[:, None], 0.0),
        jnp.where(sound, spread, 1.0),
        jnp.where(sound, area, 0.0),
        np.repeat(np.arange(len(rover.wheels)), count),
    )


def _wheels(rover: Rover, qpos: Any, qvel: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Centres, axles, velocities of the centres, m/s, speeds and angles of the drives of a rover's wheels."""
    m = rover.compile()
    bodies = np.array([m.body(w.body).id for w in rover.wheels])
    drives = [m.joint(w.drive) for w in rover.wheels]
    axes = jnp.asarray(np.stack([j.axis for j in drives]), qpos.dtype)

    def placed(q: Any) -> tuple[Any, Any]:
        at, turn = body_poses(rover, q)
        return at[bodies], jnp.sum(turn[bodies] * axes[:, None, :], axis=-1)

    (centre, axle), (velocity, _) = jax.jvp(placed, (qpos,), (_rate(m, qpos, qvel),))
    angle, turning = (
        jnp.stack([v[int(k)] for k in at])
        for v, at in ((qpos, [j.qposadr[0] for j in drives]), (qvel, [j.dofadr[0] for j in drives]))
    )
    return centre, axle, velocity, turning, angle


def _rate(m: mujoco.MjModel, qpos: Any, qvel: Any) -> Any:
    """Coordinates' rates of change, (nq,), for velocities (nv,): a free joint's turn by quaternion and body rates."""
    rates = []
    for j in range(m.njnt):
        q, v = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
        if m.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE:
            rates.append(qvel[v : v + 1])
            continue
        w, a = qpos[q + 3], qpos[q + 4 : q + 7]
        body = qvel[v + 3 : v + 6]
        rates += [qvel[v : v + 3], -0.5 * jnp.sum(a * body)[None], 0.5 * (w * body + jnp.cross(a, body))]
    return jnp.concatenate(rates)


def _ground(field: HeightField, place: Any) -> tuple[Any, Any]:
    """Height of the ground below places (wheel, 3), m, and its unit normal there."""
    height, east, north = sample(field, place[:, 0], place[:, 1])
    normal = jnp.stack([-east, -north, jnp.ones_like(east)], axis=-1)
    return height, normal / jnp.linalg.norm(normal, axis=-1, keepdims=True)
