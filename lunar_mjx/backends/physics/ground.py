"""The terrain in NumPy: bilinear heights, boulders, rock fraction, soil parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from lunar_mjx.backends.physics.vectors import clamp
from lunar_mjx.terrain import Terrain


class Grid:
    """Values at the nodes of a square grid, continued flat beyond its edge."""

    def __init__(self, values: Any, x0: Any, y0: Any, cell: Any) -> None:
        grid = np.asarray(values, float)
        self.rows, self.cols = grid.shape
        # One index per corner: `take` of a flat array is NumPy's fastest gather.
        self.flat = np.ascontiguousarray(grid).ravel()
        self.x0, self.y0, self.cell = float(x0), float(y0), float(cell)

    def value(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Bilinear value at points, its derivatives by x and y, and whether the points lie on the grid."""
        u, v = (x - self.x0) / self.cell, (y - self.y0) / self.cell
        uc, vc = clamp(u, 0.0, self.cols - 1.0), clamp(v, 0.0, self.rows - 1.0)
        # not-a-number becomes the smallest integer: the outer clamp keeps it a valid index
        i = clamp(uc.astype(np.int64), 0, self.cols - 2)
        j = clamp(vc.astype(np.int64), 0, self.rows - 2)
        s, t = uc - i, vc - j
        k = j * self.cols + i
        z00, z10 = self.flat.take(k), self.flat.take(k + 1)
        k += self.cols
        z01, z11 = self.flat.take(k), self.flat.take(k + 1)
        twist = z11 - z01 - z10 + z00
        du, dv = (z10 - z00) + t * twist, (z01 - z00) + s * twist
        value = z00 + s * (z10 - z00) + t * dv
        # Clamping changed nothing: the point lies on the grid.
        in_x, in_y = u == uc, v == vc
        return value, du * in_x / self.cell, dv * in_y / self.cell, in_x & in_y


class Ground:
    """Heights, boulders and hard rock of a terrain.

    Attributes:
      field: heights, m. hard: fraction of hard rock, or None. layers: the soil's parameters by place, in SI units.
      has_rocks: whether there is any boulder. has_forms: whether boulders are ellipsoids.
    """

    def __init__(self, terrain: Terrain) -> None:
        field = terrain.field
        self.field = Grid(field.heights, field.x0, field.y0, field.cell)
        soil = terrain.soil
        self.hard = None if soil is None else Grid(soil.rock, soil.x0, soil.y0, soil.cell)
        grids = terrain.grids
        self.layers: dict[str, Grid] = {}
        if grids is not None:
            self.layers = {k: Grid(v, grids.x0, grids.y0, grids.cell) for k, v in grids.layers.items()}
        rocks = terrain.rocks
        self.has_rocks = rocks is not None and bool((np.asarray(rocks.radii) > 0).any())
        self.has_forms = rocks is not None and rocks.forms is not None
        if rocks is not None and rocks.forms is not None:
            # rows of the matrix, of the entries xx, yy, zz, yz, xz, xy
            self._forms = np.asarray(rocks.forms, float)[:, [[0, 5, 4], [5, 1, 3], [4, 3, 2]]]
        if rocks is not None:
            self._centers, self._radii = np.asarray(rocks.centers, float), np.asarray(rocks.radii, float)
            self._index = np.asarray(rocks.index, np.int64)
            self._x0, self._y0, self._cell = float(rocks.x0), float(rocks.y0), float(rocks.cell)

    def rock(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centre (..., 3) and radius (...) of the boulder near each point, m; the radius is 0 where there is none."""
        k = self._number(x, y)
        return self._centers.take(k, 0), self._radii.take(k)

    def form(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Matrices (..., 3, 3) of the ellipsoids that `rock` finds, 1/m^2; only where `has_forms`."""
        return self._forms.take(self._number(x, y), 0)

    def _number(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        rows, cols = self._index.shape
        i = clamp(clamp((x - self._x0) / self._cell, 0.0, cols - 1.0).astype(np.int64), 0, cols - 1)
        j = clamp(clamp((y - self._y0) / self._cell, 0.0, rows - 1.0).astype(np.int64), 0, rows - 1)
        return self._index[j, i]
