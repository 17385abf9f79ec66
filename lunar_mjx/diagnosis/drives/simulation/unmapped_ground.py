"""Ground that nobody mapped: waves about a plane, as smooth modes along the way that a log's rover drove.

A log that names a plane ("flat", a slope) tells the mean of its ground. Real ground is rough: on waves of a centimetre
a rover climbs some degrees, which costs it more torque than most effects do. Heights are a random function with the
deviogram of natural ground (see `lunar_mjx.terrain.roughness`). Attitude, height and currents tell what they are.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import spatial, special

from lunar_mjx.inference.coordinates import NUISANCE, Coordinate
from lunar_mjx.logs import Log
from lunar_mjx.logs.series import at
from lunar_mjx.manoeuvres.manoeuvre import wheel_places
from lunar_mjx.model import Model
from lunar_mjx.terrain.heightfield import HeightField
from lunar_mjx.terrain.terrain import Terrain


@dataclasses.dataclass(frozen=True)
class UnmappedGrid:
    """How unmapped ground is described."""

    nodes: int = 96
    """Nodes along a side of a log's grid: one number for all logs, so that campaigns share their programs."""
    margin: float = 1.0
    """Wheelbases by which a grid is wider than what was driven."""
    modes: int = 32
    """Modes of a log, those of most variance."""
    share: float = 0.995
    """1; share of the variance under the wheels at which modes end: of waves of a centimetre 0.7 mm are left, which
    tilt a rover by less than a tenth of a degree."""
    apart: float = 0.25
    """Correlation lengths between points of the way that modes are made from."""
    most_points: int = 400
    """Points of the way at most; a longer way has longer waves."""
    flat: float = 1e-6
    """m; heights that lie so near to a plane are one."""


UNMAPPED_GRID = UnmappedGrid()
POSE = ("position_z_m", "roll_deg", "pitch_deg")
"""Channels by which a rover tells the ground below it."""


@dataclasses.dataclass(frozen=True, eq=False)
class UnmappedGround:
    """The ground of one log as far as nobody knows it.

    Attributes:
      field: the stated ground, on a grid about the way that was driven.
      modes: (modes, rows, cols) heights, each of its share of a variance of one under the wheels.
    """

    field: HeightField
    modes: np.ndarray


def unmapped_ground(log: Log, model: Model) -> UnmappedGround | None:
    """The unknown ground of a log; None where it names a map, or does not tell where the rover drove and lay.

    Args:
      log: of a drive. model: under the log's conditions.
    """
    if not _is_plane(model.terrain) or not any(log.channel(c) is not None for c in POSE):
        return None
    way = _way(log, model)
    if way is None:
        return None
    places = np.array(list(wheel_places(model.rover).values()))
    base = float(np.ptp(places[:, 0]))
    # waves much shorter than the wheelbase lift single wheels only; those of a long way are as fine as modes suffice
    reach = float(np.max(np.ptp(way, axis=0)))
    length = max(base, reach / UNMAPPED_GRID.modes)
    points = _thinned(way, UNMAPPED_GRID.apart * length)
    low = way.min(axis=0) - UNMAPPED_GRID.margin * base
    cell = float(np.max(way.max(axis=0) + UNMAPPED_GRID.margin * base - low)) / (UNMAPPED_GRID.nodes - 1)
    steps = cell * np.arange(UNMAPPED_GRID.nodes)
    x, y = np.meshgrid(low[0] + steps, low[1] + steps)
    stated = _plane(model.terrain.field)
    heights = stated[0] + stated[1] * x + stated[2] * y
    modes = _modes(points, np.column_stack([x.ravel(), y.ravel()]), length)
    # in double precision, which the annotations of a field leave to its maker
    place: Any = tuple(np.asarray(v, float) for v in (*low, cell))
    return UnmappedGround(HeightField(heights, *place), modes.reshape(-1, *x.shape))


def ground_coordinates(number: int, ground: UnmappedGround, radius: float) -> list[Coordinate]:
    """Amounts of the modes of one log's ground, in wheel radii, with a prior of size one: what is usual scales it.

    Args:
      number: of the log. ground: its modes. radius: of the wheels, m.
    """
    return [
        Coordinate(NUISANCE, mode_name(k), 0.0, radius, -3.0 * radius, 3.0 * radius, prior=1.0, log_index=number)
        for k in range(len(ground.modes))
    ]


def mode_name(k: int) -> str:
    """Name of the amount of a mode."""
    return f"ground {k}"


def _is_plane(terrain: Terrain) -> bool:
    if terrain.rocks is not None or terrain.soil is not None or terrain.grids is not None:
        return False
    field = terrain.field
    heights = np.asarray(field.heights, float)
    height, along_x, along_y = _plane(field)
    x = float(field.x0) + float(field.cell) * np.arange(heights.shape[1])
    y = float(field.y0) + float(field.cell) * np.arange(heights.shape[0])
    off = heights - (height + along_x * x + along_y * y[:, None])
    # in single precision the far end of a long slope is off by its own digits
    return bool(np.max(np.abs(off)) < UNMAPPED_GRID.flat * max(1.0, float(np.abs(heights).max())))


def _plane(field: HeightField) -> tuple[float, float, float]:
    """Height at the origin, and slopes along x and y."""
    heights = np.asarray(field.heights, float)
    cell, rows, cols = float(field.cell), *heights.shape
    along_x = (heights[0, -1] - heights[0, 0]) / (cell * (cols - 1))
    along_y = (heights[-1, 0] - heights[0, 0]) / (cell * (rows - 1))
    return heights[0, 0] - along_x * float(field.x0) - along_y * float(field.y0), along_x, along_y


def _way(log: Log, model: Model) -> np.ndarray | None:
    """(points, 2) where the wheels have been; None where the log does not tell it."""
    position = log.channel("position_x_m")
    if position is None or len(position[0]) < 2:
        return None
    time, x = position
    y, yaw = at(log, "position_y_m", time), at(log, "yaw_deg", time)
    if y is None or yaw is None:
        return None
    yaw = np.deg2rad(yaw)
    cos, sin = np.cos(yaw), np.sin(yaw)
    places = wheel_places(model.rover).values()
    way = [np.column_stack([x + a * cos - b * sin, y + a * sin + b * cos]) for a, b in places]
    whole = np.concatenate(way)
    return whole[np.isfinite(whole).all(axis=1)]


def _thinned(way: np.ndarray, apart: float) -> np.ndarray:
    """One point of each square of a side `apart`, larger where there would be too many."""
    while True:
        _, first = np.unique(np.round(way / apart).astype(int), axis=0, return_index=True)
        if len(first) <= UNMAPPED_GRID.most_points:
            return way[np.sort(first)]
        apart *= 1.5


def _covariance(a: np.ndarray, b: np.ndarray, length: float) -> np.ndarray:
    """Matern covariance of smoothness one: its deviogram grows with the lag as that of natural ground, then levels."""
    r = np.maximum(spatial.distance.cdist(a, b) / length, 1e-9)
    return r * special.kv(1, r)


def _modes(points: np.ndarray, nodes: np.ndarray, length: float) -> np.ndarray:
    """(modes, nodes) principal components of a random ground under the points, carried on to all nodes."""
    values, vectors = np.linalg.eigh(_covariance(points, points, length))
    order = np.argsort(values)[::-1]
    share = np.cumsum(values[order]) / values.sum()
    keep = order[: min(int(np.searchsorted(share, UNMAPPED_GRID.share)) + 1, UNMAPPED_GRID.modes)]
    # Kriging of each eigenvector: what the points say of a place beside them
    return (_covariance(nodes, points, length) @ (vectors[:, keep] / np.sqrt(values[keep]))).T
