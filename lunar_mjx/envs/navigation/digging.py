"""Rovers that have dug themselves in: their wheels spin ahead on soft soil until that moves them no more."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics import Params, System
from lunar_mjx.dynamics import State as Physics
from lunar_mjx.envs.navigation.actions import ActionMap
from lunar_mjx.errors import bad_input
from lunar_mjx.pytree import pytree

EFFECTS = ("rim_contact", "slip_sinkage", "ruts")
"""Without them a wheel that spins digs no trench; added to a model that has none."""


@dataclasses.dataclass(frozen=True)
class Digging:
    """How rovers get stuck; choices."""

    spin: int = 10
    """s of full speed ahead from rest: slip is 1 after 5 s where a rover gets stuck at all."""
    rest: int = 3
    """s without command thereafter; on soft soil the chassis may still bob by a centimetre."""
    watched: int = 2
    """s at the end of spinning in which a rover must hardly move to count as stuck."""
    still: float = 0.01
    """m that a stuck rover moves in that time at most; at the task's top speed it would be 0.5 m."""


DIGGING = Digging()


@pytree
class Dug:
    """Rovers that have dug themselves in, with standing motors; leading axis `place`.

    Attributes:
      physics: with what their wheels did to the ground. drawn: soil and other parameters that they did it in.
    """

    physics: Physics
    drawn: dict[str, Any]


def spin(system: System, params: Params, axes: Any, physics: Physics, actions: ActionMap) -> tuple[Physics, Any]:
    """The rovers after full speed ahead and a rest, and whether each was stuck by then, (env,).

    Args:
      system: the rover. params, axes: as of `System.rollout_batch`. physics: states at rest, leading axis `env`.
      actions: of the task.
    """
    count, d = physics.qpos.shape[0], DIGGING
    full = jnp.zeros((count, actions.size), physics.qpos.dtype).at[:, actions.source[actions.drives]].set(1.0)
    controls = actions.controls(full)

    def hold(physics: Physics, share: Any) -> tuple[Physics, Any]:
        each_second = round(1.0 / system.dt)
        physics, _ = system.rollout_batch(
            params, physics, (share * controls)[:, None], each_second, axes, lambda seen: (), one_body=True, last=True
        )
        return physics, physics.qpos[:, :2]

    shares = jnp.asarray([1.0] * d.spin + [0.0] * d.rest, physics.qpos.dtype)
    physics, places = jax.lax.scan(hold, physics, shares)
    moved = jnp.linalg.norm(places[d.spin - 1] - places[d.spin - 1 - d.watched], axis=-1)
    # what is not finite compares false
    return physics, moved < d.still


def stuck_ones(physics: Physics, drawn: dict[str, Any], stuck: Any) -> Dug:
    """Rovers that got stuck, repeated in turn until there are as many as were tried.

    Raises:
      UserError: none got stuck.
    """
    good = np.flatnonzero(np.asarray(stuck))
    if not len(good):
        remedy = "give a softer soil in randomise, or more places"
        raise bad_input("navigation", "escape_distance", len(stuck), "rovers were tried, and none dug in", remedy)
    which = np.resize(good, len(stuck))
    return jax.tree.map(lambda a: a[which], Dug(physics, drawn))
