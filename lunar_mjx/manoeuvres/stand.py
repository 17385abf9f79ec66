"""A stand that lifts the rover off its wheels, for runs without soil."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, StateVariable, effect
from lunar_mjx.spatial import Vec3

_CHOICE = "choice: stiff beside a rover's weight, stable at 2 ms for one of 50 kg"


def _memory(unit: str, meaning: str) -> StateVariable:
    return StateVariable(0.0, unit, meaning, axis="rover")


@effect(
    "body_wrench",
    state={
        "caught": _memory("1", "1 once the stand holds the rover"),
        "x": _memory("m", "where it holds the rover"),
        "y": _memory("m", "where it holds the rover"),
        "z": _memory("m", "where it holds the rover"),
        "ahead_x": _memory("1", "heading that it holds"),
        "ahead_y": _memory("1", "heading that it holds"),
        "height": _memory("m", "by how much it has lifted the rover"),
    },
    lift=Parameter(0.15, 0.0, (0.0, 2.0), "m", "height of the lift", "choice: more than a wheel sinks and hangs"),
    stiffness=Parameter(1e5, 0.0, (0.0, 1e8), "N/m", "of the stand", _CHOICE),
    damping=Parameter(4e3, 0.0, (0.0, 1e6), "N s/m", "of the stand", _CHOICE),
    turning_stiffness=Parameter(1e4, 0.0, (0.0, 1e8), "N m/rad", "of the stand", _CHOICE),
    turning_damping=Parameter(5e2, 0.0, (0.0, 1e6), "N m s/rad", "of the stand", _CHOICE),
)
def stand(ctx, p, x, wrench):
    """Holds the chassis as a damped spring, level and `lift` above where it stood, raised at 0.2 m/s."""
    # Held where it stands at the first step, which the model cannot know beforehand.
    caught = x.caught > 0.5
    at = Vec3(*(jnp.where(caught, old, present) for old, present in zip((x.x, x.y, x.z), ctx.position, strict=True)))
    ahead = ctx.frame.forward
    held_x, held_y = jnp.where(caught, x.ahead_x, ahead.x), jnp.where(caught, x.ahead_y, ahead.y)
    # Raised slowly: a lift at once would throw the rover off.
    height = jnp.minimum(x.height + 0.2 * ctx.dt, p.lift)
    gap = Vec3(at.x - ctx.position.x, at.y - ctx.position.y, at.z + height - ctx.position.z)
    force = gap * p.stiffness - ctx.velocity * p.damping
    up = ctx.frame.up
    # up x z levels the rover; ahead x held turns it back to its heading
    turn = Vec3(up.y, -up.x, ahead.x * held_y - ahead.y * held_x)
    moment = turn * p.turning_stiffness - ctx.angular_velocity * p.turning_damping
    new = {"caught": jnp.ones_like(height), "x": at.x, "y": at.y, "z": at.z, "ahead_x": held_x, "ahead_y": held_y}
    wrench = dataclasses.replace(wrench, force=wrench.force + force, moment=wrench.moment + moment)
    return wrench, {**new, "height": height}
