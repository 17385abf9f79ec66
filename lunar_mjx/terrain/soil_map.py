"""Where the ground is soft soil and where it is hard rock."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from lunar_mjx.pytree import pytree
from lunar_mjx.terrain.heightfield import Points, Scalar, bilinear


@pytree
class SoilMap:
    """Fraction of hard rock over a square grid.

    Attributes:
      rock: 0 for soft soil, 1 for hard rock.
      x0: x of `rock[0, 0]`, m.
      y0: y of `rock[0, 0]`, m.
      cell: spacing of the grid, m.
    """

    rock: Float[Array, "*batch rows cols"]
    x0: Scalar
    y0: Scalar
    cell: Scalar


def rock_fraction(soil: SoilMap | None, x: Points, y: Points) -> Float[Array, "*points"]:
    """Fraction of hard rock at points, interpolated bilinearly; outside the grid that of the nearest edge point.

    Args:
      soil: the map, or None for soft soil everywhere.
      x: m, east.
      y: m, north.

    Returns:
      Fraction from 0 (soft soil) to 1 (hard rock).
    """
    if soil is None:
        return jnp.zeros_like(x)
    dtype = soil.rock.dtype
    u = (jnp.asarray(x, dtype) - soil.x0) / soil.cell
    v = (jnp.asarray(y, dtype) - soil.y0) / soil.cell
    return bilinear(soil.rock, u, v)[0]
