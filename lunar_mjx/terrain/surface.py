"""The upper surface of ground and rocks, as sensors that look from above meet it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from lunar_mjx.terrain.heightfield import sample
from lunar_mjx.terrain.rocks import nearest_rock
from lunar_mjx.terrain.terrain import Terrain


def surface(terrain: Terrain, x: Any, y: Any, reach: float = 0.0) -> Any:
    """Height of the ground or of the rock upon it, m, at points of any shape.

    Args:
      terrain: ground and rocks. x, y: m.
      reach: radius about each point within which the highest place of the rock counts, m.
    """
    ground, _, _ = sample(terrain.field, x, y)
    if terrain.rocks is None:
        return ground
    cx, cy, cz, radius = nearest_rock(terrain.rocks, x, y)
    away = (x - cx) ** 2 + (y - cy) ** 2
    if reach > 0.0:
        away = jnp.maximum(jnp.sqrt(away) - reach, 0.0) ** 2
    inside = radius * radius - away
    top = cz + jnp.sqrt(jnp.maximum(inside, 0.0))
    return jnp.where(inside > 0.0, jnp.maximum(ground, top), ground)
