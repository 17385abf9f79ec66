"""Sensors as rovers have them: observations that come late, odometry that drifts, ground that a mast cannot see."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lunar_mjx.pytree import pytree
from lunar_mjx.terrain import Terrain, surface

LOOKS = 12
"""Places along a line of sight at which ground is looked for: every 0.3 m of the farthest, with rocks as wide as the
scan's cells."""
GRAZE = 0.05
"""m by which ground may stand above a line of sight and hide nothing: what a map's cell averages over."""


def queue_of(seen: Any, steps: int) -> Any:
    """Observations on their way at the beginning of an episode: the first one, as nothing older is known.

    Args:
      seen: arrays (env, ...). steps: for which they are on their way.

    Returns:
      Arrays (env, steps, ...).
    """
    return jax.tree.map(lambda a: jnp.repeat(a[:, None], steps, axis=1), seen)


def arrived(queue: Any, seen: Any) -> tuple[Any, Any]:
    """The observations that arrive now, and those then on their way, newest first.

    Args:
      queue: on their way so far, arrays (env, steps, ...). seen: made now, (env, ...).
    """
    on_their_way = jax.tree.map(lambda old, new: jnp.concatenate([new[:, None], old[:, :-1]], axis=1), queue, seen)
    return jax.tree.map(lambda a: a[:, -1], queue), on_their_way


@pytree
class Odometry:
    """Where a rover wrongly believes itself to be; leading axis `env`.

    Attributes:
      error: (2,) believed less true position, m. astray: (2,) unit vector along which it grows, drawn per episode.
    """

    error: Any
    astray: Any


def odometry_at_start(keys: Float[Array, "env 2"], dtype: Any) -> Odometry:
    """Odometry at the beginning of episodes, from raw random keys."""
    # Another direction in every episode: a policy could learn to correct one that is always the same.
    bearing = jax.vmap(lambda k: jax.random.uniform(k, (), dtype, -jnp.pi, jnp.pi))(keys)
    astray = jnp.stack([jnp.cos(bearing), jnp.sin(bearing)], axis=-1)
    return Odometry(jnp.zeros_like(astray), astray)


def drifted(odometry: Odometry, way: Float[Array, "env"], share: float) -> Odometry:
    """Odometry after another `way`, m, of which it errs by a share: always to one side, the worst that can add up."""
    return Odometry(odometry.error + share * way[:, None] * odometry.astray, odometry.astray)


def in_sight(
    terrain: Terrain,
    eye: Float[Array, "env 3"],
    place: tuple[Float[Array, "env point"], Float[Array, "env point"], Float[Array, "env point"]],
    reach: float,
) -> Bool[Array, "env point"]:
    """Whether no ground or rock stands between a sensor and places.

    Args:
      terrain: one for all. eye: the sensors, m. place: x, y and height of the places, m.
      reach: by which rocks are widened, m.
    """
    # Neither end counts: the sensor stands on its own mast, and a place does not hide itself.
    share = jnp.arange(1, LOOKS + 1) / (LOOKS + 1)
    x, y, line = (
        a[:, None, None] + share * (b[..., None] - a[:, None, None])
        for a, b in zip((eye[:, 0], eye[:, 1], eye[:, 2]), place, strict=True)
    )
    return (surface(terrain, x, y, reach) <= line + GRAZE).all(-1)
