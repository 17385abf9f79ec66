"""The upper surface of ground and rocks, as sensors that look from above meet it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from lunar_mjx.terrain.heightfield import sample
from lunar_mjx.terrain.rocks import form_at, nearest_rock
from lunar_mjx.terrain.terrain import Terrain


def surface(terrain: Terrain, x: Any, y: Any, reach: float = 0.0) -> Any:
    """Height of the ground or of the rock upon it, m, at points of any shape.

    Args:
      terrain: ground and rocks. x, y: m.
      reach: radius about each point within which the highest place of the rock counts, m; of an ellipsoid the place
        nearest to its top.
    """
    ground, _, _ = sample(terrain.field, x, y)
    if terrain.rocks is None:
        return ground
    cx, cy, cz, radius = nearest_rock(terrain.rocks, x, y)
    if terrain.rocks.forms is not None:
        form, dx, dy = form_at(terrain.rocks, x, y), x - cx, y - cy
        if reach > 0.0:
            apex = form.apex()
            dx, dy = dx - apex.x, dy - apex.y
            far = jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-12))
            nearer = jnp.maximum(far - reach, 0.0) / far
            dx, dy = apex.x + nearer * dx, apex.y + nearer * dy
        stone = (radius > 0.0) & (form.outline(dx, dy) < 1.0)
        return jnp.where(stone, jnp.maximum(ground, cz + form.height(dx, dy)), ground)
    away = (x - cx) ** 2 + (y - cy) ** 2
    if reach > 0.0:
        away = jnp.maximum(jnp.sqrt(away) - reach, 0.0) ** 2
    inside = radius * radius - away
    top = cz + jnp.sqrt(jnp.maximum(inside, 0.0))
    return jnp.where(inside > 0.0, jnp.maximum(ground, top), ground)
