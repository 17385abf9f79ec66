"""Ruts that stay: a patch of ground around the rover that wheels press together, dig and heap up."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.base import Effect, Parameter, StateVariable
from lunar_mjx.effects.soil.multipass import compacted
from lunar_mjx.effects.wheel.closed_form import entrance_angle
from lunar_mjx.pytree import pytree


@dataclasses.dataclass(frozen=True)
class RutPatch:
    """The patch of ground that ruts are kept in, and where wheels act on it."""

    side: int = 64
    """Cells along each side of the patch; the patch repeats, so that a cell is forgotten where the rover comes to the
    next one of the same address, 64 cells on."""
    tiles: float = 1024.0
    """Tiles per row of their numbers: patches within 512 of the origin keep numbers of their own, exact in float32."""
    nowhere: float = -1e7
    """Tile of a cell that no wheel has touched."""
    dug: tuple[float, ...] = (-0.5, 0.0, 0.5, 1.0)
    """Where along the rim soil is taken, in lengths of the contact ahead of the axle."""
    behind: tuple[float, float] = (0.8, 1.0)
    """Distances at which it comes to lie behind the axle, in radii: just beyond the rim of a sunken wheel."""
    faint: float = 1e-3
    """Depth of a rut, in radii, at which its soil is half as firm as pressed soil is."""


PATCH = RutPatch()

_ACROSS = tuple(np.linspace(-0.4, 0.4, 5).tolist())
"""Where a wheel presses and digs, in its widths beside its middle."""


@pytree
class Relief:
    """What wheels did to the ground of a patch, for every cell.

    Attributes:
      moved: height of soil that was brought (positive) or taken away, m.
      pressed: depth by which soil was pressed together, m.
      tile: number of the patch to which a cell's values belong.
      cell: side of a cell, m.
    """

    moved: Any
    pressed: Any
    tile: Any
    cell: Any

    def at(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Soil moved and depth pressed, m, at points of any shape, bilinear between the centres of cells."""
        # Half a cell off: values belong to the middle of cells, and the bilinear weights run from middle to middle.
        u, v = x / self.cell - 0.5, y / self.cell - 0.5
        i, j = jnp.floor(u), jnp.floor(v)
        s, t = u - i, v - j
        moved = pressed = 0.0 * u
        for di, ws in ((0.0, 1.0 - s), (1.0, s)):
            for dj, wt in ((0.0, 1.0 - t), (1.0, t)):
                slot, tile = _address(i + di, j + dj)
                # A neighbour of another tile is untouched soil here, however its slot looks.
                own = jnp.where(self.tile[slot] == tile, ws * wt, 0.0)
                moved, pressed = moved + own * self.moved[slot], pressed + own * self.pressed[slot]
        return moved, pressed


def _address(i: Any, j: Any) -> tuple[Any, Any]:
    """Place of the cells i, j in the patch, and the number of their tile."""
    tile_i, tile_j = jnp.floor(i / PATCH.side), jnp.floor(j / PATCH.side)
    slot = (i - PATCH.side * tile_i) + PATCH.side * (j - PATCH.side * tile_j)
    # a position of NaN may become any whole number
    return jnp.clip(slot.astype(jnp.int32), 0, PATCH.side * PATCH.side - 1), tile_i + PATCH.tiles * tile_j


def cell_numbers(tile: Any) -> tuple[Any, Any]:
    """Numbers, east and north, of the cells that the slots of a patch (last axis) hold, from their tiles; whole."""
    slot = jnp.arange(PATCH.side * PATCH.side)
    tile_j = jnp.round(tile / PATCH.tiles)
    return slot % PATCH.side + PATCH.side * (tile - PATCH.tiles * tile_j), slot // PATCH.side + PATCH.side * tile_j


def tile_of(u: Any, v: Any) -> Any:
    """Tiles of all slots (last axis) in the patch whose middle lies nearest to a place, in cells."""
    # A slot stands for cells one patch apart; the copy nearest to the rover is the one that its wheels can reach.
    slot = jnp.arange(PATCH.side * PATCH.side)
    tile_i, tile_j = (
        jnp.round((middle[..., None] - 0.5 - number) / PATCH.side)
        for middle, number in ((u, slot % PATCH.side), (v, slot // PATCH.side))
    )
    return tile_i + PATCH.tiles * tile_j


def _relief(ctx: Any, p: Any, x: Any, geometry: Any) -> Relief:
    return Relief(x.moved, x.pressed, x.tile, p.cell * jnp.mean(geometry.width))


def _shape(ctx, p, x, geometry):
    return dataclasses.replace(geometry, relief=_relief(ctx, p, x, geometry)), {}


def _touched(relief: Relief, x: Any, y: Any) -> tuple[Relief, Any]:
    """The relief with the cells below points made current, and the places of these cells."""
    slot, tile = _address(jnp.floor(x / relief.cell), jnp.floor(y / relief.cell))
    slot, tile = slot.reshape(-1), tile.reshape(-1)
    fresh = relief.tile[slot] != tile
    # cells of another tile lie a patch's length behind: what is known of them is given up
    moved = relief.moved.at[slot].multiply(jnp.where(fresh, 0.0, 1.0))
    pressed = relief.pressed.at[slot].multiply(jnp.where(fresh, 0.0, 1.0))
    return Relief(moved, pressed, relief.tile.at[slot].set(tile), relief.cell), slot


def _soil(ctx, p, x, ground):
    geometry, contact = ctx.geometry, ctx.contact
    relief = _relief(ctx, p, x, geometry)
    radius, width = geometry.radius, geometry.width
    wheel_at, ahead, beside = ctx.wheel_position, contact.forward, contact.left
    # Which way the wheel rolls, without a jump at rest.
    way = jnp.clip(contact.rim_speed / p.turning, -1.0, 1.0)
    reach = radius * jnp.sin(entrance_angle(contact.sinkage, radius))
    # Half of the contact's length ahead of the axle: there the rim meets the ground that an earlier pass left.
    lead_x, lead_y = wheel_at.x + 0.5 * way * reach * ahead.x, wheel_at.y + 0.5 * way * reach * ahead.y
    _, rut = relief.at(lead_x, lead_y)
    rut = jnp.where(ground.rock > 0.5, 0.0, rut)
    # From untouched to pressed within some thousandths of a radius: a jump would shake the wheel at a rut's end.
    firm = 1.0 + rut / (rut + PATCH.faint * radius) * (jnp.power(1.0 - p.plastic, -ground.n) - 1.0)
    soil = dataclasses.replace(
        ground,
        k_c=ground.k_c * firm,
        k_phi=ground.k_phi * firm,
        rut=rut if ground.rut is None else jnp.maximum(rut, ground.rut),
    )
    soil = compacted(soil, rut, p.compacted_depth * width)

    # A wheel at rest works no soil; without the bound its creep would dig for ever.
    working = (contact.sinkage > 0.0) & (ground.rock < 0.5) & (jnp.abs(way) > 0.5)
    share = jnp.reshape(jnp.asarray(_ACROSS, wheel_at.x.dtype), (-1, 1))
    side_x, side_y = wheel_at.x + share * width * beside.x, wheel_at.y + share * width * beside.y
    slide = contact.rim_speed - contact.v_x
    # A spinning wheel throws soil back, a braked one shoves it ahead.
    toward = jnp.sign(slide)

    def along(*off):
        """Points across the wheel at distances ahead of its axle."""
        return (jnp.concatenate([s + d * a for d in off]) for s, a in ((side_x, ahead.x), (side_y, ahead.y)))

    dug_x, dug_y = along(*(toward * f * reach for f in PATCH.dug))
    back_x, back_y = along(*(-toward * f * radius for f in PATCH.behind))
    trail_x, trail_y = along(-way * relief.cell)

    heap = jnp.mean(relief.at(back_x, back_y)[0], axis=0)
    hole = jnp.mean(relief.at(dug_x, dug_y)[0], axis=0)
    # soil heaped steeper than it stands runs back to where it came from
    # 1 on level ground, 0 where the heap stands at the angle of friction over the hole, tan(phi) times their distance.
    room = 1.0 - (heap - hole) / (PATCH.behind[0] * radius * ground.tan_phi)
    # Only what lies below the rut's bottom is new soil to carry.
    deep = jnp.minimum(jnp.maximum(contact.sinkage - rut, 0.0), radius)
    volume = ctx.dt * p.carried * deep * jnp.abs(slide) * jnp.clip(room, 0.0, 1.0) * width
    # A volume spread over cells: what is taken from some is brought to others, so that soil is conserved.
    height = jnp.where(working, volume, 0.0) / relief.cell**2
    # The plastic part alone stays; the rest springs back when the wheel has passed.
    press = jnp.where(working, p.plastic * contact.sinkage, 0.0)

    points_x, points_y = (jnp.concatenate(v) for v in ((dug_x, back_x, trail_x), (dug_y, back_y, trail_y)))
    relief, slot = _touched(relief, points_x, points_y)
    taken, brought, none = (0.0 * v for v in (dug_x, back_x, trail_x))
    change = jnp.concatenate([taken - height / len(dug_x), brought + height / len(back_x), none])
    # Added, since several points may fall into one cell: setting would keep only one of them, and lose soil.
    moved = relief.moved.at[slot].add(change.reshape(-1))
    # The deepest pass counts: pressing twice to one depth presses once.
    pressed = relief.pressed.at[slot].max(jnp.concatenate([taken, brought, none + press]).reshape(-1))
    return soil, {"moved": moved, "pressed": pressed, "tile": relief.tile}


def _cells(initial: float, unit: str, meaning: str) -> StateVariable:
    return StateVariable(initial, unit, meaning, axis="rover", slots=PATCH.side * PATCH.side)


ruts = Effect(
    name="ruts",
    ports={"geometry": _shape, "soil": _soil},
    parameters={
        "plastic": Parameter(
            0.8,
            0.0,
            (0.0, 0.95),
            "1",
            "share of the sinkage that remains when the wheel has passed",
            "choice: as in multipass",
        ),
        "carried": Parameter(
            0.1,
            0.0,
            (0.0, 1.0),
            "1",
            "share of the sliding of the rim with which the soil in its way is carried behind the wheel",
            "choice: a wheel that spins at 5 cm/s sinks 2 cm deeper within two minutes",
        ),
        "compacted_depth": Parameter(
            1.5,
            None,
            (1.0, 10.0),
            "1",
            "thickness of the soil that a pass presses together, in widths of the wheel",
            "as in multipass",
        ),
        "turning": Parameter(
            2e-3,
            None,
            (1e-4, 0.1),
            "m/s",
            "rim speed from which a wheel knows ahead from behind; below half of it, it leaves no rut",
            "choice: the speed below which slip fades",
        ),
        "cell": Parameter(
            0.3,
            None,
            (0.05, 2.0),
            "1",
            "side of a cell in widths of the wheel",
            "choice: three cells across a wheel; the patch then reaches 19 widths",
        ),
    },
    state={
        "moved": _cells(0.0, "m", "soil brought to a cell or taken from it"),
        "pressed": _cells(0.0, "m", "depth by which the soil of a cell was pressed together"),
        "tile": _cells(PATCH.nowhere, "1", "which patch a cell belongs to"),
    },
    replaces=("multipass",),
    order=20,
    transient=True,
    requires=("rim_contact",),
    doc="""The ground of a patch of 64 by 64 cells about the rover remembers what its wheels did.

    A wheel that turns presses the cells behind its axle by e z, and finds what it, another wheel or another pass
    pressed before it where its rim enters: ruts, firmness and compaction as in `multipass`, by place. A rim that slides
    carries soil behind the wheel, a volume per width and time of alpha z |r omega - v_x|, until the heap stands at the
    angle of friction over the hole: a spinning wheel digs a trench whose walls its rim then meets (`rim_contact`). What
    is carried is taken from cells and given to others in the same step, so that mass is kept; pressed soil stays in its
    cell and is denser. A cell is forgotten when the rover comes to the same address one patch on.""",
)
