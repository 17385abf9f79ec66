"""Rocks as spheres or ellipsoids partly buried, found through a coarse grid with one gather.

Rocks are not rasterised into the height field: a rock is analytic, so that a wheel that climbs it meets a smooth
surface however coarse the terrain's grid is.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.pytree import pytree
from lunar_mjx.terrain.dem import require_cell, require_size
from lunar_mjx.terrain.heightfield import Points, Scalar, grid_index, take
from lunar_mjx.terrain.rocks.form import Form, forms_of, principal_axes

CELL = 0.25
"""Default spacing of the look-up grid, m."""
REACH = 0.6
"""Default distance from a rock's surface within which the look-up still finds it, m."""


@pytree
class Rocks:
    """Spheres or ellipsoids and the grid that finds them.

    Attributes:
      centers: m; the last entries are dummies of radius 0.
      radii: m; 0 for a dummy. Of an ellipsoid its longest semi-axis: the sphere around it serves the look-up.
      index: for each cell, which rock has its surface nearest to the cell's centre (in plan), or a dummy.
      x0: x of the south-west corner of cell [0, 0], m.
      y0: y of the south-west corner of cell [0, 0], m.
      cell: spacing of the grid, m.
      forms: the ellipsoids' shapes, see `Form`; None where all rocks are spheres.
    """

    centers: Float[Array, "*batch n 3"]
    radii: Float[Array, "*batch n"]
    index: Int[Array, "*batch rows cols"]
    x0: Scalar
    y0: Scalar
    cell: Scalar
    forms: Float[Array, "*batch n 6"] | None = None


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
      x, y and z of the rock's centre and its radius, m; see `form_at` for ellipsoids. Where no rock is near, the
      radius is 0.
    """
    if rocks is None:
        zero = jnp.zeros_like(x)
        return zero, zero, zero, zero
    # One gather finds the number, the others read that rock: no loop over rocks, however many there are.
    # The grid only decides which rock; where its surface lies is computed, not read.
    k = _number(rocks, x, y)
    flat = rocks.centers.reshape(-1)
    return take(flat, 3 * k), take(flat, 3 * k + 1), take(flat, 3 * k + 2), take(rocks.radii, k)


def form_at(rocks: Rocks, x: Points, y: Points) -> Form:
    """The shapes of the rocks that `nearest_rock` finds; the rocks must have forms. A dummy's is a unit sphere's."""
    assert rocks.forms is not None
    flat, k = rocks.forms.reshape(-1), _number(rocks, x, y)
    return Form(*(take(flat, 6 * k + i) for i in range(6)))


def _number(rocks: Rocks, x: Points, y: Points) -> Int[Array, "*points"]:
    rows, cols = rocks.index.shape
    dtype = rocks.radii.dtype
    i = grid_index((jnp.asarray(x, dtype) - rocks.x0) / rocks.cell, cols - 1)
    j = grid_index((jnp.asarray(y, dtype) - rocks.y0) / rocks.cell, rows - 1)
    return take(rocks.index.reshape(-1), j * cols + i)


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
      UserError: centres or radii of the wrong shape, not finite, or a radius that is not positive; a spacing that
        leaves too many cells.
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
    require_cell("rocks", "cell", cell)
    cols, rows = (max(1, int(np.ceil((b - a) / cell))) for a, b in ((west, east), (south, north)))
    require_size("rocks", rows, cols)
    # A cell's centre judges for its corners, which lie up to cell/sqrt(2) farther.
    index = _nearest_index(centers, radii, west, south, rows, cols, cell, reach + cell / np.sqrt(2))
    return Rocks(
        # A dummy of radius 0 at the end: terrains without rocks keep the same code and shapes.
        centers=jnp.asarray(np.vstack([centers, np.zeros((1, 3))]), dtype),
        radii=jnp.asarray(np.append(radii, 0.0), dtype),
        index=jnp.asarray(index, jnp.int32),
        x0=jnp.asarray(west, dtype),
        y0=jnp.asarray(south, dtype),
        cell=jnp.asarray(cell, dtype),
    )


MOST_ELONGATED = 5.0
"""Largest ratio of two semi-axes, up to which a wheel's contact is found within a fixed number of steps."""


def build_ellipsoids(
    centers: np.ndarray,
    axes: np.ndarray,
    turns: np.ndarray,
    bounds: tuple[float, float, float, float],
    *,
    cell: float = CELL,
    reach: float = REACH,
    dtype: np.dtype | type = np.float32,
) -> Rocks:
    """Builds the look-up grid for given ellipsoids; gaps between rocks count from the spheres around them.

    Args:
      centers: m, shape (n, 3); n may be 0.
      axes: semi-axes, m, shape (n, 3), positive.
      turns: rotations, shape (n, 3, 3); the columns are the directions of the semi-axes.
      bounds, cell, reach, dtype: as for `build_rocks`.

    Raises:
      UserError: arrays of the wrong shape, not finite, a semi-axis that is not positive, semi-axes of too different
        length, or turns that are no rotations.
    """
    axes, turns = np.asarray(axes, np.float64).reshape(-1, 3), np.asarray(turns, np.float64).reshape(-1, 3, 3)
    if len(turns) != len(axes):
        raise bad_input("rocks", "turns", f"{len(turns)} values", f"do not match {len(axes)} axes", "give as many")
    if not (axes > 0).all():
        raise bad_input("rocks", "axes", axes.min(), "is not positive", "give semi-axes in m above zero")
    most = (axes.max(axis=1) / axes.min(axis=1)).max(initial=1.0)
    if most > MOST_ELONGATED * (1.0 + 1e-9):
        raise bad_input(
            "rocks", "axes", f"{most:g} to 1", "are too unequal", f"give semi-axes within {MOST_ELONGATED:g} to 1"
        )
    if not np.allclose(turns @ turns.swapaxes(1, 2), np.eye(3), atol=1e-6):
        raise UserError("rocks: turns hold a matrix that is no rotation; give orthonormal columns.")
    # By the sphere around each, which reaches at least as far as the ellipsoid.
    rocks = build_rocks(centers, axes.max(axis=1), bounds, cell=cell, reach=reach, dtype=dtype)
    return dataclasses.replace(rocks, forms=jnp.asarray(np.vstack([forms_of(axes, turns), _UNIT]), dtype))


_UNIT = np.array([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]])
"""Form of a dummy, by which one may divide."""


def with_forms(rocks: Rocks) -> Rocks:
    """Rocks with forms: spheres become ellipsoids of three equal semi-axes."""
    if rocks.forms is not None:
        return rocks
    squares = jnp.where(rocks.radii > 0.0, rocks.radii, 1.0) ** -2.0
    return dataclasses.replace(rocks, forms=squares[..., None] * jnp.asarray(_UNIT[0], rocks.radii.dtype))


def padded(rocks: Rocks, more: int) -> Rocks:
    """Rocks with `more` dummies of radius zero behind them, so that fields of different number stack."""
    forms = rocks.forms
    if forms is not None:
        forms = jnp.concatenate([forms, jnp.broadcast_to(jnp.asarray(_UNIT, forms.dtype), (more, 6))])
    return dataclasses.replace(
        rocks, centers=jnp.pad(rocks.centers, ((0, more), (0, 0))), radii=jnp.pad(rocks.radii, (0, more)), forms=forms
    )


def semi_axes(rocks: Rocks) -> tuple[np.ndarray, np.ndarray]:
    """Semi-axes (n, 3), m, and the rotations (n, 3, 3) whose columns they lie along; those of spheres are equal."""
    radii = np.asarray(rocks.radii, float)
    if rocks.forms is None:
        return np.repeat(radii[:, None], 3, axis=1), np.broadcast_to(np.eye(3), (len(radii), 3, 3))
    axes, turns = principal_axes(np.asarray(rocks.forms))
    return np.where(radii[:, None] > 0, axes, 0.0), turns


def _nearest_index(
    centers: np.ndarray, radii: np.ndarray, west: float, south: float, rows: int, cols: int, cell: float, reach: float
) -> np.ndarray:
    """Rasterises "whose surface is nearest" rock by rock; cells farther than `reach` from any keep the dummy."""
    # The number behind the last rock is the dummy: "none" needs no branch.
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
    # In plan, since the look-up is.
    tree = KDTree(centers[:, :2])
    gap = np.inf
    # Ten metres more than the radii: gaps wider than that matter to nobody.
    for k, near in enumerate(tree.query_ball_point(centers[:, :2], radii + radii.max() + 10.0)):
        neighbours = np.array([n for n in near if n != k], int)
        if len(neighbours):
            distance = np.hypot(*(centers[neighbours, :2] - centers[k, :2]).T) - radii[neighbours] - radii[k]
            gap = min(gap, float(distance.min()))
    return gap
