"""Ground and optics that the camera tests share."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from lunar_mjx.cameras import Pinhole
from lunar_mjx.terrain import HeightField, Terrain, build_rocks

EYE = Pinhole(80, 60)


def bumpy(rocks: bool = True) -> Terrain:
    """Waves of some decimetres, 16 m wide, with three boulders."""
    at = np.arange(-8.0, 8.05, 0.1)
    x, y = np.meshgrid(at, at)
    heights = 0.25 * np.sin(0.9 * x) * np.cos(0.7 * y) + 0.05 * x
    field = HeightField(*(jnp.asarray(v, jnp.float32) for v in (heights, -8.0, -8.0, 0.1)))
    places = np.array([[3.0, 0.6, 0.2], [4.5, -1.5, 0.25], [2.5, -0.9, 0.1]])
    stones = build_rocks(places, np.array([0.35, 0.5, 0.2]), (-8.0, -8.0, 8.0, 8.0)) if rocks else None
    return Terrain(field, stones, None, jnp.zeros(3), "bumpy")
