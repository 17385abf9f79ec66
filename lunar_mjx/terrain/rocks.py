"""Rocks as obstacles: spheres partly buried, found through a coarse grid with one gather.

Rocks are not rasterised into the height field: a rock is analytic, so that a wheel that climbs it meets a smooth
surface however coarse the terrain's grid is.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.pytree import pytree
from lunar_mjx.terrain.heightfield import Points, Scalar, grid_index, take

CELL = 0.25
"""Default spacing of the look-up grid, m."""
REACH = 0.6
"""Default distance from a rock's surface within which the look-up still finds it, m."""


@pytree
class Rocks:
    """Spheres and the grid that finds them.

    Attributes:
      centers: m; the last entries are dummies of radius 0.
      radii: m; 0 for a dummy.
      index: for each cell, which rock has its surface nearest to the cell's centre (in plan), or a dummy.
      x0: x of the south-west corner of cell [0, 0], m.
      y0: y of the south-west corner of cell [0, 0], m.
      cell: spacing of the grid, m.
    """

    centers: Float[Array, "*batch n 3"]
    radii: Float[Array, "*batch n"]
    index: Int[Array, "*batch rows cols"]
    x0: Scalar
    y0: Scalar
    cell: Scalar


def nearest_rock(
    rocks: Rocks | None, x: Points, y: Points
) -> tuple[Float[Array, "*points"], Float[Array, "*points"], Float[Array, "*points"], Float[Array, "*points"]]:
    """The rock whose surface is nearest to each point in plan, as far as the look-up grid tells.

    Within `clearance(gap, cell)` of a rock's surface the answer is that rock, for rocks at least `gap` apart.
    Elementwise code and gathers only.

    Args:
      rocks: the rocks, or None.
      x: m, east.
      y: m, north.

    Returns:
      x, y and z of the sphere's centre and its radius, m. Where no rock is near, the radius is 0.
    """
    if rocks is None:
        zero = jnp.zeros_like(x)
        return zero, zero, zero, zero
    rows, cols = rocks.index.shape
    dtype = rocks.radii.dtype
    i = grid_index((jnp.asarray(x, dtype) - rocks.x0) / rocks.cell, cols - 1)
    j = grid_index((jnp.asarray(y, dtype) - rocks.y0) / rocks.cell, rows - 1)
    k = take(rocks.index.reshape(-1), j * cols + i)
    flat = rocks.centers.reshape(-1)
    return take(flat, 3 * k), take(flat, 3 * k + 1), take(flat, 3 * k + 2), take(rocks.radii, k)


def clearance(gap: float, cell: float = CELL) -> float:
    """Distance from a rock's surface within which `nearest_rock` surely returns that rock, m.

    A point lies at most cell/sqrt(2) from its cell's centre, which judges for it.
    """
    return 0.5 * gap - cell / np.sqrt(2)


def build_rocks(
    centers: np.ndarray,
    radii: np.ndarray,
    bounds: tuple[float, float, float, float],
    *,
    cell: float = CELL,
    reach: float = REACH,
    dtype: np.dtype | type = np.float32,
) -> Rocks:
    """Builds the look-up grid for given spheres.

    Args:
      centers: m, shape (n, 3); n may be 0.
      radii: m, shape (n,), positive.
      bounds: west, south, east and north edge of the terrain, m.
      cell: spacing of the look-up grid, m.
      reach: points within this distance of a rock's surface find it, m.
      dtype: of the result's floating-point arrays.

    Raises:
      UserError: centres or radii of the wrong shape, not finite, or a radius that is not positive.
    """
    centers, radii = np.asarray(centers, np.float64).reshape(-1, 3), np.asarray(radii, np.float64).reshape(-1)
    if len(centers) != len(radii):
        raise bad_input(
            "rocks", "radii", f"{len(radii)} values", f"do not match {len(centers)} centres", "give as many"
        )
    if not (np.isfinite(centers).all() and np.isfinite(radii).all()):
        raise UserError("rocks: centers or radii hold a value that is not finite; give finite numbers in m.")
    if (radii <= 0).any():
        raise bad_input("rocks", "radii", radii.min(), "is not positive", "give radii in m above zero")
    west, south, east, north = bounds
    cols, rows = (max(1, int(np.ceil((b - a) / cell))) for a, b in ((west, east), (south, north)))
    index = _nearest_index(centers, radii, west, south, rows, cols, cell, reach + cell / np.sqrt(2))
    return Rocks(
        centers=jnp.asarray(np.vstack([centers, np.zeros((1, 3))]), dtype),
        radii=jnp.asarray(np.append(radii, 0.0), dtype),
        index=jnp.asarray(index, jnp.int32),
        x0=jnp.asarray(west, dtype),
        y0=jnp.asarray(south, dtype),
        cell=jnp.asarray(cell, dtype),
    )


def _nearest_index(
    centers: np.ndarray, radii: np.ndarray, west: float, south: float, rows: int, cols: int, cell: float, reach: float
) -> np.ndarray:
    """Rasterises "whose surface is nearest" rock by rock; cells farther than `reach` from any keep the dummy."""
    index = np.full((rows, cols), len(radii), np.int32)
    best = np.full((rows, cols), reach)
    for k, ((x, y, _), radius) in enumerate(zip(centers, radii, strict=True)):
        far = radius + reach
        i0, i1 = (int(np.clip(np.floor((x + s * far - west) / cell), 0, cols - 1)) for s in (-1, 1))
        j0, j1 = (int(np.clip(np.floor((y + s * far - south) / cell), 0, rows - 1)) for s in (-1, 1))
        dx = west + (np.arange(i0, i1 + 1) + 0.5) * cell - x
        dy = south + (np.arange(j0, j1 + 1) + 0.5) * cell - y
        distance = np.hypot(dx[None, :], dy[:, None]) - radius
        window = np.s_[j0 : j1 + 1, i0 : i1 + 1]
        nearer = distance < best[window]
        best[window] = np.where(nearer, distance, best[window])
        index[window] = np.where(nearer, k, index[window])
    return index


def smallest_gap(centers: np.ndarray, radii: np.ndarray) -> float:
    """Smallest distance in plan between the surfaces of two spheres, m; infinite for fewer than two."""
    centers, radii = np.asarray(centers), np.asarray(radii)
    if len(radii) < 2:
        return float("inf")
    tree = KDTree(centers[:, :2])
    gap = np.inf
    for k, near in enumerate(tree.query_ball_point(centers[:, :2], radii + radii.max() + 10.0)):
        others = np.array([n for n in near if n != k], int)
        if len(others):
            distance = np.hypot(*(centers[others, :2] - centers[k, :2]).T) - radii[others] - radii[k]
            gap = min(gap, float(distance.min()))
    return gap
