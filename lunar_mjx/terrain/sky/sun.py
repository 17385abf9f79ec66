"""The Sun's direction and irradiance over time, and how much of its disc stands above the horizon."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.pytree import pytree
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain.heightfield import Points, Scalar, grid_index, take
from lunar_mjx.terrain.sky.horizon import Horizon, horizon_elevation

SUN_RADIUS = 4.650e-3
"""Angle of the Sun's radius from 1 au, rad: 695 700 km over 149 597 871 km."""
SOLAR_CONSTANT = 1361.0
"""W/m2 at 1 au (Kopp & Lean 2011)."""
_EDGE = 1e-6
"""Distance from the disc's upper and lower edge, in radii, up to which its slope is taken: at the edge it is 0/0."""


@pytree
class Sun:
    """The Sun's track over a terrain, at equal intervals of time.

    Attributes:
      direction: unit vectors towards it, x east, y north, z up.
      irradiance: W/m2 on a plane that faces it, without horizon.
      interval: time between two directions, s; they stay as they are before the first and after the last.
      highest: sine of the highest elevation of the site's Sun.
      horizon: of the terrain, or None for a level plain.
    """

    direction: Float[Array, "*batch times 3"]
    irradiance: Float[Array, "*batch times"]
    interval: Scalar
    highest: Scalar
    horizon: Horizon | None = None

    def towards(self, time: Any) -> Vec3:
        """Unit vector towards the Sun at `time`, s."""
        # Interpolated and made a unit again: between samples the chord is shorter.
        return Vec3(*(self._at(self.direction[:, k], time) for k in range(3))).unit()

    def _at(self, values: Float[Array, "times"], time: Any) -> Any:
        last = values.shape[0] - 1
        if last == 0:
            return values[0]
        u = jnp.clip(time / self.interval, 0, last)
        i = grid_index(u, last - 1)
        low, high = take(values, i), take(values, i + 1)
        return low + (u - i) * (high - low)

    def light(self, time: Any, x: Points, y: Points) -> Sunlight:
        """Direction, and irradiance behind the horizon, at `time`, s, and a place, m."""
        to = self.towards(time)
        edge = 0.0 if self.horizon is None else horizon_elevation(self.horizon, x, y, to.x, to.y)
        # The whole disc, not its middle: near the poles sunset lasts for many hours.
        return Sunlight(to, self._at(self.irradiance, time) * share_above(jnp.arcsin(to.z) - edge))


@pytree
class Sunlight:
    """Sunlight at one place and time.

    Attributes:
      direction: unit vector towards the Sun, world frame.
      irradiance: on a plane that faces it, W/m2; what the horizon leaves of it.
    """

    direction: Vec3
    irradiance: Any


def share_above(height: Any) -> Any:
    """Share of the Sun's disc above the horizon.

    Args:
      height: elevation of its middle above the horizon, rad.

    Returns:
      1/2 + (u sqrt(1 - u^2) + asin u)/pi with u = height over the radius, a segment of a circle: from 0 to 1.
    """
    # Kept off the edges, where the root's derivative is infinite.
    u = jnp.clip(height / SUN_RADIUS, -1.0 + _EDGE, 1.0 - _EDGE)
    segment = 0.5 + (u * jnp.sqrt(1.0 - u * u) + jnp.arcsin(u)) / jnp.pi
    return jnp.where(height >= SUN_RADIUS, 1.0, jnp.where(height <= -SUN_RADIUS, 0.0, segment))


def unit_vector(azimuth: Any, elevation: Any) -> np.ndarray:
    """Direction of an azimuth, clockwise from north (y), and an elevation, rad; (..., 3)."""
    level = np.cos(elevation)
    return np.stack([level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation)], axis=-1)


def fixed_sun(
    azimuth_deg: float = 135.0,
    elevation_deg: float = 15.0,
    irradiance: float = SOLAR_CONSTANT,
    horizon: Horizon | None = None,
    dtype: np.dtype | type = np.float32,
) -> Sun:
    """A Sun that does not move.

    Args:
      azimuth_deg: clockwise from north (y). elevation_deg: above a level horizon.
      irradiance: W/m2. horizon: of the terrain, or None. dtype: of the arrays.
    """
    towards = unit_vector(math.radians(azimuth_deg), math.radians(elevation_deg))
    # Divided by elsewhere, so never zero; a Sun below the horizon keeps the ground cold.
    highest = max(math.sin(math.radians(elevation_deg)), 1e-6)
    return Sun(
        jnp.asarray(towards[None], dtype),
        jnp.asarray([irradiance], dtype),
        jnp.asarray(1.0, dtype),
        jnp.asarray(highest, dtype),
        horizon,
    )
