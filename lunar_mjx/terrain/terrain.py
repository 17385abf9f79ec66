"""The terrain of a simulation: ground, rocks and soil in one frame, and batches of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.errors import UserError, bad_input, require_finite, require_within
from lunar_mjx.pytree import pytree, static
from lunar_mjx.terrain.dem import DEM_LIMITS, require_cell, require_size
from lunar_mjx.terrain.heightfield import HeightField
from lunar_mjx.terrain.rocks import Rocks, padded, with_forms
from lunar_mjx.terrain.soil.maps import LAYERS, SoilGrids, SoilMap

TURN = float(np.radians(360.0)) * (1.0 + 1e-9)
"""rad."""


@pytree
class Terrain:
    """Ground, rocks and soil about a local origin: x east, y north, z up, m.

    Attributes:
      field: the ground.
      rocks: obstacles, or None.
      soil: where hard rock is, or None for soft soil everywhere.
      origin: easting, northing and altitude of the local (0, 0, 0), m; whole numbers, so that float32 holds them
        exactly. Arrays, not static: a terrain from another seed must not compile the step again.
      name: for messages and reports.
      grids: the soil's parameters by place, or None where they are the same everywhere.
    """

    field: HeightField
    rocks: Rocks | None
    soil: SoilMap | None
    origin: Float[Array, "*batch 3"]
    name: str = static(default="terrain")
    grids: SoilGrids | None = None


def stack(terrains: Sequence[Terrain]) -> Terrain:
    """Joins terrains into a batch with a leading axis on every array; use it with `vmap`.

    Rocks and patches of rock that only some of the terrains have become empty ones in the others; grids of the soil's
    parameters have all of them or none.

    Args:
      terrains: at least one; their grids must agree in shape.

    Raises:
      UserError: no terrain, or grids that differ in shape or in what they hold.
    """
    if not terrains:
        raise UserError("stack: terrains = [] is empty; give at least one terrain.")
    first = terrains[0].field.heights.shape
    for terrain in terrains:
        if terrain.field.heights.shape != first:
            raise bad_input(
                terrain.name,
                "grid",
                f"{terrain.field.heights.shape} nodes",
                f"does not agree with the {first} of {terrains[0].name}",
                "crop or resample the terrains to one shape before stacking",
            )
    _require_same_grids(terrains)
    # The name is static: trees of different names would not stack.
    names = sorted({t.name for t in terrains})
    alike = [dataclasses.replace(t, name="+".join(names)) for t in _with_soil(_with_rocks(terrains))]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *alike)


def _require_same_grids(terrains: Sequence[Terrain]) -> None:
    held = {None if t.grids is None else tuple((k, v.shape) for k, v in t.grids.layers.items()) for t in terrains}
    if len(held) > 1:
        raise bad_input(
            "stack",
            "soil grids",
            ", ".join(sorted("none" if h is None else " ".join(f"{k} {s}" for k, s in h) for h in held)),
            "differ",
            f"give all terrains the same of {', '.join(LAYERS)} on grids of one shape",
        )


def _with_rocks(terrains: Sequence[Terrain]) -> Sequence[Terrain]:
    given = [t.rocks for t in terrains if t.rocks is not None]
    if not given:
        return terrains
    shapes = {r.index.shape for r in given}
    if len(shapes) > 1:
        raise bad_input(
            "stack",
            "rock grids",
            sorted(shapes),
            "differ in shape",
            "use one extent and one rock cell for all terrains",
        )
    # Spheres become ellipsoids of equal axes, since a batch has one shape of arrays.
    if any(r.forms is not None for r in given):
        given = [with_forms(r) for r in given]
        terrains = [t if t.rocks is None else dataclasses.replace(t, rocks=with_forms(t.rocks)) for t in terrains]
    most = max(r.radii.shape[0] for r in given)
    empty = dataclasses.replace(
        given[0],
        centers=jnp.zeros_like(given[0].centers[:1]),
        radii=jnp.zeros_like(given[0].radii[:1]),
        index=jnp.zeros_like(given[0].index),
        forms=None,
    )
    if given[0].forms is not None:
        empty = with_forms(empty)

    def filled(rocks: Rocks) -> Rocks:
        # A dummy's index is the number of rocks: what is appended there has radius 0 and stays a dummy.
        return padded(rocks, most - rocks.radii.shape[0])

    return [dataclasses.replace(t, rocks=filled(t.rocks or empty)) for t in terrains]


def _with_soil(terrains: Sequence[Terrain]) -> Sequence[Terrain]:
    given = [t.soil for t in terrains if t.soil is not None]
    if not given:
        return terrains
    shapes = {s.rock.shape for s in given}
    if len(shapes) > 1:
        raise bad_input("stack", "soil maps", sorted(shapes), "differ in shape", "use maps of one shape")
    soft = dataclasses.replace(given[0], rock=jnp.zeros_like(given[0].rock))
    return [dataclasses.replace(t, soil=t.soil or soft) for t in terrains]


def inclined(
    angle: float,
    extent: float = 200.0,
    direction: float = 0.0,
    *,
    cell: float = 1.0,
    dtype: np.dtype | type = np.float32,
    name: str | None = None,
) -> Terrain:
    """An exact plane through the origin.

    Beyond its edge the ground continues level, as on every height field: choose the extent for the whole drive.

    Args:
      angle: slope, rad, between -pi/2 and pi/2.
      extent: of the square grid, m.
      direction: in which the ground rises, rad, counterclockwise from x (east).
      cell: spacing of the grid, m.
      dtype: of the arrays.
      name: for messages.

    Raises:
      UserError: an angle of a right angle or more, an extent or spacing that is not positive.
    """
    if abs(require_finite("slope", "angle", angle)) >= np.pi / 2:
        raise bad_input(
            "slope", "angle", f"{np.degrees(angle):g} deg", "is a right angle or more", "give less than 90 deg"
        )
    # A turn to either side, and what rounding of degrees adds.
    require_within("slope", "direction", direction, -TURN, TURN)
    require_cell("slope", "cell", cell)
    if require_finite("slope", "extent", extent) < cell:
        raise bad_input("slope", "extent", extent, f"is less than one cell of {cell:g} m", "give it in m")
    # An even number of cells puts a node on the origin, and a third node keeps small grids legal.
    half = max(1, round(extent / cell / 2))
    require_size("slope", 2 * half + 1, 2 * half + 1)
    at = np.arange(-half, half + 1) * cell
    rise = np.tan(angle)
    if 2.0 * abs(rise) * at[-1] > DEM_LIMITS.most_relief:
        problem = f"makes heights of {abs(rise) * at[-1]:.3g} m on {extent:g} m"
        raise bad_input("slope", "angle", f"{np.degrees(angle):g} deg", problem, "give less, or a smaller extent")
    heights = rise * (np.cos(direction) * at[None, :] + np.sin(direction) * at[:, None])
    x0, y0, spacing = (jnp.asarray(v, dtype) for v in (at[0], at[0], cell))
    field = HeightField(jnp.asarray(heights, dtype), x0, y0, spacing)
    return Terrain(field, None, None, jnp.zeros(3, dtype), name or f"slope:{np.degrees(angle):g}deg")


def flat(extent: float = 200.0, *, cell: float = 1.0, dtype: np.dtype | type = np.float32) -> Terrain:
    """Level ground at z = 0; see `inclined`."""
    return inclined(0.0, extent, cell=cell, dtype=dtype, name="flat")
