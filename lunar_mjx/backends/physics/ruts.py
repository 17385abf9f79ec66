"""Ruts that stay, in NumPy: a patch of ground about each rover that its wheels press together, dig and heap up."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np

from lunar_mjx.backends.physics.context import Context, Values
from lunar_mjx.backends.physics.outdoors import DENSITY_POWERS, MULTIPASS
from lunar_mjx.backends.physics.soil import entrance
from lunar_mjx.backends.physics.vectors import clamp


@dataclasses.dataclass(frozen=True)
class RutPatch:
    """Numbers of ruts, written again for the independent check."""

    side: int = 64
    """Cells along each side of a patch, which repeats."""
    tiles: float = 1024.0
    """Tiles per row of their numbers."""
    nowhere: float = -1e7
    """Number of the tile of a cell that no wheel has touched."""
    dug: tuple[float, ...] = (-0.5, 0.0, 0.5, 1.0)
    behind: tuple[float, float] = (0.8, 1.0)
    faint: float = 1e-3


RUT_PATCH = RutPatch()

_ACROSS = np.linspace(-0.4, 0.4, 5)[:, None]


def untouched(rovers: int) -> Values:
    """The patches at reset, (rover, cell)."""
    # Every rover's ground is its own, as in a batch of the JAX engines.
    cells = np.zeros((rovers, RUT_PATCH.side * RUT_PATCH.side))
    return {"moved": cells, "pressed": cells.copy(), "tile": cells + RUT_PATCH.nowhere}


@dataclasses.dataclass
class Relief:
    """Height of soil moved, m, depth pressed, m, and number of the tile, of every cell (rover, cell) of side `cell`."""

    moved: np.ndarray
    pressed: np.ndarray
    tile: np.ndarray
    cell: float

    def at(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Soil moved and depth pressed, m, at points (rover, ...), bilinear between the centres of cells."""
        # Each rover reads its own patch.
        rover = np.arange(len(x)).reshape(-1, *(1,) * (x.ndim - 1))
        u, v = x / self.cell - 0.5, y / self.cell - 0.5
        i, j = np.floor(u), np.floor(v)
        moved = pressed = np.zeros_like(u)
        for di, along in ((0.0, 1.0 - (u - i)), (1.0, u - i)):
            for dj, across in ((0.0, 1.0 - (v - j)), (1.0, v - j)):
                slot, tile = _address(i + di, j + dj)
                weight = np.where(self.tile[rover, slot] == tile, along * across, 0.0)
                moved = moved + weight * self.moved[rover, slot]
                pressed = pressed + weight * self.pressed[rover, slot]
        return moved, pressed

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Soil moved, m, at points (rover, ...)."""
        return self.at(x, y)[0]


def _address(i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place of the cells i, j in the patch, and the number of their tile."""
    tile_i, tile_j = np.floor(i / RUT_PATCH.side), np.floor(j / RUT_PATCH.side)
    slot = (i - RUT_PATCH.side * tile_i) + RUT_PATCH.side * (j - RUT_PATCH.side * tile_j)
    # not-a-number becomes the smallest integer
    return clamp(slot.astype(np.int64), 0, RUT_PATCH.side * RUT_PATCH.side - 1), tile_i + RUT_PATCH.tiles * tile_j


def relief_of(c: Context, p: SimpleNamespace, state: Values) -> Relief:
    """The patches of the state; all rovers have wheels of one mean width."""
    return Relief(state["moved"], state["pressed"], state["tile"], p.cell * float(c.geometry["width"][0].mean()))


def ruts(c: Context, p: SimpleNamespace, soil: Values, state: Values) -> Values:
    """Changes the soil under each wheel to what earlier passes left of it; returns the patches after this step."""
    relief, contact = relief_of(c, p, state), c.contact
    radius, width, sinkage = c.geometry["radius"], c.geometry["width"], contact["sinkage"]
    x, y = c.wheel_position[..., 0], c.wheel_position[..., 1]
    ahead_x, ahead_y = contact["forward"][..., 0], contact["forward"][..., 1]
    way = clamp(contact["rim_speed"] / p.turning, -1.0, 1.0)
    reach = radius * np.sin(entrance(sinkage, radius))
    rut = relief.at(x + 0.5 * way * reach * ahead_x, y + 0.5 * way * reach * ahead_y)[1]
    rut = np.where(soil["rock"] > 0.5, 0.0, rut)
    firmer = 1.0 + rut / (rut + RUT_PATCH.faint * radius) * ((1.0 - p.plastic) ** -soil["n"] - 1.0)
    soil["k_c"], soil["k_phi"], soil["rut"] = soil["k_c"] * firmer, soil["k_phi"] * firmer, rut
    tan_phi = soil["tan_phi"]  # loose soil stands in the heap, whatever lies pressed below
    layer = p.compacted_depth * width
    density = layer / (layer - np.minimum(rut, MULTIPASS.most_pressed * layer))
    for name, power in DENSITY_POWERS.items():
        soil[name] = soil[name] * density**power

    working = (sinkage > 0.0) & (soil["rock"] < 0.5) & (np.abs(way) > 0.5)
    slide = contact["rim_speed"] - contact["v_x"]
    toward = np.sign(slide)
    # (rover, place across, wheel)
    side_x = x[:, None] + _ACROSS * width[:, None] * contact["left"][:, None, :, 0]
    side_y = y[:, None] + _ACROSS * width[:, None] * contact["left"][:, None, :, 1]

    def along(*distances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points across the wheel at distances ahead of its axle, (rover, place, wheel)."""
        return (
            np.concatenate([side_x + (d * ahead_x)[:, None] for d in distances], axis=1),
            np.concatenate([side_y + (d * ahead_y)[:, None] for d in distances], axis=1),
        )

    dug, back = (
        along(*(toward * f * reach for f in RUT_PATCH.dug)),
        along(*(-toward * f * radius for f in RUT_PATCH.behind)),
    )
    trail = along(-way * relief.cell)
    heap, hole = relief.at(*back)[0].mean(axis=1), relief.at(*dug)[0].mean(axis=1)
    room = 1.0 - (heap - hole) / (RUT_PATCH.behind[0] * radius * tan_phi)
    deep = np.minimum(np.maximum(sinkage - rut, 0.0), radius)
    volume = c.dt * p.carried * deep * np.abs(slide) * clamp(room, 0.0, 1.0) * width
    height = (np.where(working, volume, 0.0) / relief.cell**2)[:, None]
    press = np.where(working, p.plastic * sinkage, 0.0)[:, None]
    taken, brought, rolled = (np.zeros_like(points[0]) for points in (dug, back, trail))
    change = np.concatenate([taken - height / taken.shape[1], brought + height / brought.shape[1], rolled], axis=1)
    pressed = np.concatenate([taken, brought, rolled + press], axis=1)
    points = [np.concatenate(axis, axis=1) for axis in zip(dug, back, trail, strict=True)]
    return _worked(relief, points[0], points[1], change, pressed)


def _worked(relief: Relief, x: np.ndarray, y: np.ndarray, change: np.ndarray, pressed: np.ndarray) -> Values:
    """The patches with soil brought to points and pressed there, m; cells of another tile are given up first."""
    slot, tile = _address(np.floor(x / relief.cell), np.floor(y / relief.cell))
    rover = np.broadcast_to(np.arange(len(x)).reshape(-1, 1, 1), slot.shape)
    new = {"moved": relief.moved.copy(), "pressed": relief.pressed.copy(), "tile": relief.tile.copy()}
    fresh = new["tile"][rover, slot] != tile
    for name in ("moved", "pressed"):
        new[name][rover[fresh], slot[fresh]] = 0.0
    new["tile"][rover, slot] = tile
    np.add.at(new["moved"], (rover, slot), change)
    np.maximum.at(new["pressed"], (rover, slot), pressed)
    return new
