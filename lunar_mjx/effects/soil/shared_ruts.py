"""Ruts that several rovers of one world share: what each did to its patch is brought together between steps.

Every rover of a batch carries a patch of its own (`ruts`), so that a step needs no exchange. `exchange` adds what the
rovers did since the last one to a grid of their world, and lays the grid into the patch around each of them. Cells of
all patches lie on one lattice, so that soil is moved from number to number and none is lost.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lunar_mjx.effects.soil.ruts import cell_numbers, tile_of
from lunar_mjx.errors import UserError, require_finite
from lunar_mjx.pytree import pytree, static


@pytree
class SharedGround:
    """What rovers did to the ground of their worlds, and what of it each of them was told.

    Attributes:
      moved: height of soil brought (positive) or taken away, m.
      pressed: depth by which soil was pressed together, m.
      told: height of soil, m, and tile of every rover's patch after the last exchange.
      world: in which of the worlds each rover drives.
      first: numbers, east and north, of the cell [0, 0]; whole.
      cell: side of a cell, m.
    """

    moved: Float[Array, "world rows cols"]
    pressed: Float[Array, "world rows cols"]
    told: tuple[Float[Array, "rover slot"], Float[Array, "rover slot"]]
    world: Int[Array, " rover"]
    cell: Any
    first: tuple[int, int] = static(default=(0, 0))


def shared_ground(
    ruts: Mapping[str, Float[Array, "rover slot"]],
    world: Int[Array, " rover"],
    low: tuple[float, float],
    high: tuple[float, float],
    cell: float,
) -> SharedGround:
    """Untouched ground for rovers whose patches are untouched.

    Args:
      ruts: the state of the effect `ruts` of all rovers, `state.effects["ruts"]`, as reset.
      world: number of the world in which each rover drives, from 0.
      low, high: south-western and north-eastern corner of the ground that is shared, m. What is done beyond it stays
        with the rover that did it, as without sharing.
      cell: side of a cell, m: the effect's `cell` times the mean width of the wheels.

    Raises:
      UserError: a side that is not positive, or corners in the wrong order.
    """
    if require_finite("shared ruts", "cell", cell) <= 0.0:
        raise UserError(f"shared ruts: cell = {cell:g} is not positive; give the side of a cell in m.")
    # Floor division, as cells are numbered: truncation would give two cells the number 0.
    first, last = (tuple(int(v // cell) for v in corner) for corner in (low, high))
    if not (first[0] < last[0] and first[1] < last[1]):
        raise UserError(f"shared ruts: high = {high} is not beyond low = {low}; give the north-eastern corner in m.")
    shape = int(jnp.max(world)) + 1, last[1] - first[1] + 1, last[0] - first[0] + 1
    moved = jnp.zeros(shape, ruts["moved"].dtype)
    told = ruts["moved"], ruts["tile"]
    return SharedGround(moved, moved, told, jnp.asarray(world), jnp.asarray(cell, moved.dtype), (first[0], first[1]))


def exchange(
    ground: SharedGround, ruts: Mapping[str, Float[Array, "rover slot"]], x: Any, y: Any
) -> tuple[SharedGround, dict[str, Any]]:
    """Brings together what the rovers did, and tells each what lies around it. Pure; once a control interval is enough.

    Args:
      ground: from `shared_ground` or the last exchange. ruts: the rovers' patches, `state.effects["ruts"]`.
      x, y: of the rovers, (rover,) m. A rover's wheels shall stay within 32 cells of there until the next exchange.

    Returns:
      The ground, and the patches for `state.effects`. Soil that two rovers moved adds up; of depths pressed the larger
      one counts.
    """
    moved, pressed, tile = ruts["moved"], ruts["pressed"], ruts["tile"]
    moved_soil, told_tile = ground.told
    _, rows, cols = ground.moved.shape
    world = jnp.broadcast_to(ground.world[:, None], moved.shape)

    def places(tile: Any) -> tuple[Any, Any, Any]:
        """Columns and rows of every slot's cell, outside the grid where it is not shared, and whether it is."""
        i, j = cell_numbers(tile)
        col, row = i - ground.first[0], j - ground.first[1]
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        return jnp.where(inside, col, cols).astype(jnp.int32), jnp.where(inside, row, rows).astype(jnp.int32), inside

    # a cell that was given up for the next tile on keeps in the grid what it had been told
    # Only the difference to what was told is new: adding the patch whole would count soil at each exchange again.
    done = moved - jnp.where(tile == told_tile, moved_soil, 0.0)
    col, row, _ = places(tile)
    # Scatters of all rovers at once: soil adds up, whoever moved it, and what lies beyond the grid is dropped.
    total = ground.moved.at[world, row, col].add(done, mode="drop")
    # The deepest pass counts, whoever made it; sums would press soil deeper the more often rovers exchange.
    deepest = ground.pressed.at[world, row, col].max(pressed, mode="drop")

    # Every patch is laid anew about where its rover is now, whatever it held before.
    own_tile = tile_of(x / ground.cell, y / ground.cell)
    col, row, inside = places(own_tile)
    at = world, row, col
    own = tile == own_tile
    new = {
        "moved": jnp.where(inside, total.at[at].get(mode="fill", fill_value=0.0), jnp.where(own, moved, 0.0)),
        "pressed": jnp.where(inside, deepest.at[at].get(mode="fill", fill_value=0.0), jnp.where(own, pressed, 0.0)),
        "tile": own_tile,
    }
    return dataclasses.replace(ground, moved=total, pressed=deepest, told=(new["moved"], new["tile"])), new
