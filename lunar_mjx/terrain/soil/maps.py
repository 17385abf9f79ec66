"""Where the ground is hard rock, and the parameters of its soil by place."""

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


@pytree
class SoilGrids:
    """Parameters of the soil over a square grid; those that are None are the same everywhere, as the effects say.

    Attributes:
      x0: x of the south-western node, m.
      y0: y of the same, m.
      cell: spacing of the grid, m.
      k_c: cohesive modulus of sinkage, N/m^(n+1).
      k_phi: frictional modulus of sinkage, N/m^(n+2).
      n: sinkage exponent.
      cohesion: Pa.
      tan_phi: tangent of the angle of internal friction.
      shear_modulus_x: Janosi shear deformation modulus K_s, m.
      shear_modulus_y: the same across the wheel, K_y, m.
    """

    x0: Scalar
    y0: Scalar
    cell: Scalar
    k_c: Float[Array, "*batch rows cols"] | None = None
    k_phi: Float[Array, "*batch rows cols"] | None = None
    n: Float[Array, "*batch rows cols"] | None = None
    cohesion: Float[Array, "*batch rows cols"] | None = None
    tan_phi: Float[Array, "*batch rows cols"] | None = None
    shear_modulus_x: Float[Array, "*batch rows cols"] | None = None
    shear_modulus_y: Float[Array, "*batch rows cols"] | None = None

    @property
    def layers(self) -> dict[str, Float[Array, "*batch rows cols"]]:
        """The parameters that are given, by name."""
        return {name: values for name in LAYERS if (values := getattr(self, name)) is not None}


LAYERS = ("k_c", "k_phi", "n", "cohesion", "tan_phi", "shear_modulus_x", "shear_modulus_y")
"""Parameters that `SoilGrids` may hold."""


def soil_parameters(grids: SoilGrids, x: Points, y: Points) -> dict[str, Float[Array, "*points"]]:
    """The soil's parameters at points, each interpolated bilinearly; outside the grid those of the nearest edge point.

    Args:
      grids: one set of grids (use `vmap` over a batch of them).
      x: m, east.
      y: m, north.

    Returns:
      Those parameters that the grids hold, in SI units. Between nodes whose sinkage exponents differ, the numbers of
      the moduli are blended as they stand, that is, the pressures at a sinkage of 1 m.
    """
    dtype = jnp.asarray(grids.cell).dtype
    u = (jnp.asarray(x, dtype) - grids.x0) / grids.cell
    v = (jnp.asarray(y, dtype) - grids.y0) / grids.cell
    return {name: bilinear(values, u, v)[0] for name, values in grids.layers.items()}
