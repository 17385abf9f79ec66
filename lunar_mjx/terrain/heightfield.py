"""The height field: a square grid of heights, sampled bilinearly at any point inside `jit`, `vmap` and `grad`.

The rule at the edge: outside the grid the ground continues flat. The height there is the height of the nearest point of
the edge, the derivative across that edge is zero, and `inside` is false. A position of NaN gives a height of NaN and
never an index out of bounds.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from lunar_mjx.pytree import pytree

Scalar = Float[Array, "*batch"]
Points = Float[ArrayLike, "*points"]


@pytree
class HeightField:
    """Heights on a square grid; x points east (columns), y north (rows), z up.

    All fields are array leaves, so that fields of one shape stack into a batch.

    Attributes:
      heights: m above the terrain's origin. Altitudes in kilometres would eat the digits of float32: they are taken off
        on the host (`Dem.to_heightfield`).
      x0: x of `heights[0, 0]`, m.
      y0: y of `heights[0, 0]`, m.
      cell: spacing of the grid, m.
    """

    heights: Float[Array, "*batch rows cols"]
    x0: Scalar
    y0: Scalar
    cell: Scalar


def take(flat: Array, index: Int[Array, "*points"]) -> Array:
    """`flat[index]` for indices known to be in bounds, without the selects that guard against others."""
    # JAX would guard every gather by selects; a step has dozens, and grid_index has clamped already.
    return flat.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def grid_index(u: Float[Array, "*points"], last: int) -> Int[Array, "*points"]:
    """The integer part of `u`, within 0 and `last` whatever `u` is: NaN, infinite or far outside."""
    # The outer clip is for NaN, which passes through the inner one and may become any integer.
    return jnp.clip(jnp.floor(jnp.clip(u, 0, last)).astype(jnp.int32), 0, last)


def bilinear(
    values: Float[Array, "rows cols"], u: Float[Array, "*points"], v: Float[Array, "*points"]
) -> tuple[Float[Array, "*points"], Float[Array, "*points"], Float[Array, "*points"]]:
    """Bilinear interpolation with one set of four gathers.

    Args:
      values: values at the nodes, at least 2 x 2.
      u: column coordinate, in cells.
      v: row coordinate, in cells.

    Returns:
      The value, and its exact derivatives by u and v (those of the patch to the right and above where u or v is whole).
    """
    rows, cols = values.shape
    # floor of the clipped coordinate is at most `cols - 1`; the last column closes the last patch.
    i, j = grid_index(u, cols - 2), grid_index(v, rows - 2)
    s = jnp.clip(u, 0, cols - 1) - i
    t = jnp.clip(v, 0, rows - 1) - j
    flat, k = values.reshape(-1), j * cols + i
    z00, z10 = take(flat, k), take(flat, k + 1)
    z01, z11 = take(flat, k + cols), take(flat, k + cols + 1)
    south, north = z10 - z00, z11 - z01
    low, high = z00 + s * south, z01 + s * north
    zero = jnp.zeros_like(s)
    # Beyond the edge the ground goes on flat, and so do its slopes (see the module).
    du = jnp.where((u < 0) | (u > cols - 1), zero, south + t * (north - south))
    dv = jnp.where((v < 0) | (v > rows - 1), zero, high - low)
    return low + t * (high - low), du, dv


def _cells(field: HeightField, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    dtype = field.heights.dtype
    x, y = jnp.asarray(x, dtype), jnp.asarray(y, dtype)
    # In the heights' own dtype: a float64 position would turn a float32 step into float64.
    return (x - field.x0) / field.cell, (y - field.y0) / field.cell


def sample(
    field: HeightField, x: Points, y: Points
) -> tuple[Float[Array, "*points"], Float[Array, "*points"], Float[Array, "*points"]]:
    """Height and slope of the ground below points.

    Elementwise code and four gathers: no dot, no scatter. Differentiable by x, y and the heights.

    Args:
      field: one height field (use `vmap` over a batch of them).
      x: m, east.
      y: m, north; of the same shape as `x`.

    Returns:
      z in m, dz/dx and dz/dy; in the dtype of the heights. See the module's docstring for points outside.
    """
    u, v = _cells(field, x, y)
    z, du, dv = bilinear(field.heights, u, v)
    return z, du / field.cell, dv / field.cell


def height(field: HeightField, x: Points, y: Points) -> Float[Array, "*points"]:
    """Height of the ground in m; arguments as for `sample`."""
    return sample(field, x, y)[0]


def gradient(field: HeightField, x: Points, y: Points) -> tuple[Float[Array, "*points"], Float[Array, "*points"]]:
    """dz/dx and dz/dy of the ground; arguments as for `sample`."""
    return sample(field, x, y)[1:]


def normal(
    field: HeightField, x: Points, y: Points
) -> tuple[Float[Array, "*points"], Float[Array, "*points"], Float[Array, "*points"]]:
    """Upward unit normal of the ground, as (nx, ny, nz); arguments as for `sample`."""
    _, dzdx, dzdy = sample(field, x, y)
    nz = jax.lax.rsqrt(1 + dzdx * dzdx + dzdy * dzdy)
    return -dzdx * nz, -dzdy * nz, nz


def slope(field: HeightField, x: Points, y: Points) -> Float[Array, "*points"]:
    """Steepest slope of the ground, rad, from 0 to pi/2; arguments as for `sample`."""
    _, dzdx, dzdy = sample(field, x, y)
    squared = dzdx * dzdx + dzdy * dzdy
    # The root has no derivative at level ground; taking it of 1 there keeps the gradient finite (zero).
    level = squared == 0
    return jnp.where(level, 0.0, jnp.arctan(jnp.sqrt(jnp.where(level, 1.0, squared))))


def inside(field: HeightField, x: Points, y: Points) -> Bool[Array, "*points"]:
    """Whether points lie on the grid, its edge included; false for NaN. Arguments as for `sample`."""
    rows, cols = field.heights.shape
    u, v = _cells(field, x, y)
    return (u >= 0) & (u <= cols - 1) & (v >= 0) & (v <= rows - 1)
