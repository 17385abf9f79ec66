"""Shaded relief of a terrain, as a grey picture with its extent, and its rocks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.rocks import Form

LIGHT = (315.0, 20.0)
"""Compass azimuth and elevation of the light, deg: from the north-west, as maps are lit."""


class Relief(NamedTuple):
    """A rectangle of ground as a shaded picture, with its heights.

    Attributes:
      grey: (rows, cols) 0 to 1, south first. heights: m, alike.
      west, east, south, north: edges, m.
    """

    grey: np.ndarray
    heights: np.ndarray
    west: float
    east: float
    south: float
    north: float


def relief(terrain: Terrain, low: np.ndarray, high: np.ndarray, most: int = 700, light: tuple = LIGHT) -> Relief:
    """Shades the ground between two corners (2,) m, with at most about `most` cells per side."""
    field = terrain.field
    heights, cell = np.asarray(field.heights, float), float(field.cell)
    rows, cols = heights.shape
    origin = (float(field.x0), float(field.y0))
    i0, i1 = (int(np.clip((v - origin[0]) / cell, 0, cols - 1)) for v in (low[0] - cell, high[0] + cell))
    j0, j1 = (int(np.clip((v - origin[1]) / cell, 0, rows - 1)) for v in (low[1] - cell, high[1] + cell))
    step = max(1, round(max(i1 - i0, j1 - j0) / most))
    part = heights[j0 : j1 + 1 : step, i0 : i1 + 1 : step]
    if min(part.shape) < 2:
        part = np.tile(part[:1, :1], (2, 2))
    north, east = np.gradient(part, cell * step)
    azimuth, elevation = (math.radians(v) for v in light)
    sun = np.array(
        [math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    lit = (-east * sun[0] - north * sun[1] + sun[2]) / np.sqrt(1.0 + east**2 + north**2)
    grey = np.clip(0.59 + 0.94 * (lit - sun[2]), 0.24, 0.92)
    half = 0.5 * cell * step
    west, south = origin[0] + i0 * cell - half, origin[1] + j0 * cell - half
    return Relief(grey, part, west, west + part.shape[1] * cell * step, south, south + part.shape[0] * cell * step)


def rocks_within(terrain: Terrain, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Outlines of the rocks between two corners, seen from above.

    Returns:
      x and y of the centre and the two half widths, m, and the angle from x (east) to the first, rad; (n, 5).
    """
    if terrain.rocks is None:
        return np.zeros((0, 5))
    centers, radii = np.asarray(terrain.rocks.centers, float), np.asarray(terrain.rocks.radii, float)
    near = (radii > 0) & (centers[:, :2] > low).all(axis=1) & (centers[:, :2] < high).all(axis=1)
    x, y, radius = *centers[near, :2].T, radii[near]
    if terrain.rocks.forms is None:
        return np.column_stack([x, y, radius, radius, np.zeros(len(x))])
    form = Form(*np.asarray(terrain.rocks.forms, float)[near].T)
    # twice the outline's matrix: differences of its values over the plane
    xx, yy = form.outline(1.0, 0.0), form.outline(0.0, 1.0)
    matrix = np.stack([xx, *(0.5 * (form.outline(1.0, 1.0) - xx - yy),) * 2, yy], axis=-1).reshape(-1, 2, 2)
    values, turns = np.linalg.eigh(matrix)
    return np.column_stack([x, y, values**-0.5, np.arctan2(turns[:, 1, 0], turns[:, 0, 0])])


def ring(outline: np.ndarray, corners: int = 32) -> np.ndarray:
    """Corners of a polygon for an outline of `rocks_within`, (corners, 2) m."""
    x, y, a, b, angle = outline
    t = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.column_stack(
        [x + a * cos * np.cos(t) - b * sin * np.sin(t), y + a * sin * np.cos(t) + b * cos * np.sin(t)]
    )
