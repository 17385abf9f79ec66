"""Horizon angles of a terrain: how high the ground stands in every direction, computed once on the host."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage

from lunar_mjx.pytree import pytree
from lunar_mjx.terrain.dem import Dem
from lunar_mjx.terrain.heightfield import Points, Scalar, grid_index, take


@dataclasses.dataclass(frozen=True)
class HorizonGrid:
    """Where and how finely horizons are sampled."""

    moon_radius: float = 1737.4e3
    """m; distant ground sinks below a level plane by s^2/(2 R)."""
    bearings: int = 120
    """Directions of a horizon, 3 deg apart."""
    places: int = 32
    """Places along each side of a terrain for which a horizon is computed, at most."""
    eye: float = 0.5
    """Height above the ground from which it is seen, m: that of a small rover's panels."""
    growth: float = 1.02
    """Ratio of neighbouring distances at which the ground is looked at."""


HORIZON_GRID = HorizonGrid()


@pytree
class Horizon:
    """Elevation of the horizon by place and direction.

    Attributes:
      elevation: rad; direction 0 is north (y), then clockwise.
      x0, y0: place of the south-western node, m. cell: spacing of the places, m.
    """

    elevation: Float[Array, "*batch bearings rows cols"]
    x0: Scalar
    y0: Scalar
    cell: Scalar


def horizon_elevation(horizon: Horizon, x: Points, y: Points, towards_x: Points, towards_y: Points) -> Any:
    """Elevation of the horizon, rad, at a place and in a direction; linear between places and directions.

    Args:
      horizon: of one terrain.
      x, y: place, m; beyond the grid that of the nearest edge.
      towards_x, towards_y: direction, east and north; of any length.
    """
    bearings, rows, cols = horizon.elevation.shape
    # East over north: azimuths count clockwise from north.
    turn = jnp.arctan2(towards_x, towards_y) / (2.0 * jnp.pi)
    w = (turn - jnp.floor(turn)) * bearings
    u = jnp.clip((x - horizon.x0) / horizon.cell, 0, cols - 1)
    v = jnp.clip((y - horizon.y0) / horizon.cell, 0, rows - 1)
    k, i, j = grid_index(w, bearings - 1), grid_index(u, max(cols - 2, 0)), grid_index(v, max(rows - 2, 0))
    flat = horizon.elevation.reshape(-1)
    # A grid of one row or column has no neighbour to interpolate to.
    right, up = min(cols - 1, 1), cols * min(rows - 1, 1)

    def plane(bearing: Any) -> Any:
        at = bearing * rows * cols + j * cols + i
        low = take(flat, at) + (u - i) * (take(flat, at + right) - take(flat, at))
        high = take(flat, at + up) + (u - i) * (take(flat, at + up + right) - take(flat, at + up))
        return low + (v - j) * (high - low)

    first = plane(k)
    # The last direction's neighbour is the first one.
    return first + (w - k) * (plane(jnp.where(k + 1 == bearings, 0, k + 1)) - first)


def compute_horizon(
    ground: Dem,
    around: Sequence[Dem] = (),
    *,
    places: int = HORIZON_GRID.places,
    bearings: int = HORIZON_GRID.bearings,
    eye: float = HORIZON_GRID.eye,
    dtype: np.dtype | type = np.float32,
) -> Horizon:
    """Horizon angles of a terrain: at each place the steepest way up to ground in each direction.

    Args:
      ground: the terrain, in whose coordinates the result is.
      around: DEMs of the surroundings in the same coordinates, where the ground ends; a DEM counts within its edges.
      places: along the longer side of the terrain, at most. bearings: number of directions.
      eye: height above the ground, m. dtype: of the result.

    Returns:
      Elevations, 0 at least: ground that no DEM covers is taken for level. Ground is looked at in steps of 2 % of
      the distance, so that a ridge thinner than that may be missed, and sinks by s^2/(2 R) with the Moon's curvature.
    """
    west, south, east, north = ground.bounds
    cell = max(east - west, north - south) / max(places - 1, 1)
    cols, rows = (int(np.floor(extent / cell + 1e-9)) + 1 for extent in (east - west, north - south))
    x, y = (a.ravel() for a in np.meshgrid(west + np.arange(cols) * cell, south + np.arange(rows) * cell))
    # Without the eye's height, the ground's own roughness would hide a low Sun from every place.
    stand = _heights(ground, x, y) + eye
    elevation = np.zeros((bearings, len(x)))
    for dem in (ground, *around):
        w, s, e, n = dem.bounds
        far = np.hypot(max(e, east) - min(w, west), max(n, north) - min(s, south))
        # In proportion to the distance: what is far away has to be high to be seen, and then it is wide.
        steps = dem.cell * HORIZON_GRID.growth ** np.arange(
            int(np.ceil(np.log(max(far / dem.cell, 2.0)) / np.log(HORIZON_GRID.growth))) + 1
        )
        for k, bearing in enumerate(np.arange(bearings) * (2.0 * np.pi / bearings)):
            at_x = x[:, None] + np.sin(bearing) * steps
            at_y = y[:, None] + np.cos(bearing) * steps
            rise = _heights(dem, at_x, at_y) - stand[:, None] - steps**2 / (2.0 * HORIZON_GRID.moon_radius)
            inside = (at_x >= w) & (at_x <= e) & (at_y >= s) & (at_y <= n)
            # The largest tangent, before any arc tangent: it grows with the angle, and one is enough.
            steepest = np.where(inside, rise / steps, 0.0).max(axis=1)
            # The highest of all DEMs: where two overlap, the coarser one may miss a ridge but invents none.
            elevation[k] = np.maximum(elevation[k], np.arctan(steepest))
    return Horizon(
        jnp.asarray(elevation.reshape(bearings, rows, cols), dtype),
        *(jnp.asarray(v, dtype) for v in (west, south, cell)),
    )


def _heights(dem: Dem, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    at = np.stack([(y - dem.y0) / dem.cell, (x - dem.x0) / dem.cell])
    return ndimage.map_coordinates(dem.heights, at, order=1, mode="nearest")
