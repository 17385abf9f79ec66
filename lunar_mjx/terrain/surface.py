"""The upper surface of ground and rocks, as sensors that look from above meet it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from lunar_mjx.terrain.heightfield import sample
from lunar_mjx.terrain.rocks import nearest_rock
from lunar_mjx.terrain.terrain import Terrain


def surface(terrain: Terrain, x: Any, y: Any) -> Any:
    """Height of the ground or of the rock upon it, m, at points of any shape."""
    ground, _, _ = sample(terrain.field, x, y)
    if terrain.rocks is None:
        return ground
    cx, cy, cz, radius = nearest_rock(terrain.rocks, x, y)
    inside = radius * radius - (x - cx) ** 2 - (y - cy) ** 2
    top = cz + jnp.sqrt(jnp.maximum(inside, 0.0))
    return jnp.where(inside > 0.0, jnp.maximum(ground, top), ground)
