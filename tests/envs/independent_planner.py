"""A planner that knows the whole map: the cheapest way by Dijkstra's algorithm over slopes and around boulders.

It shares no code with the making of worlds: boulders are looked up as spheres, slopes taken from the map's heights, and
the search is SciPy's. It checks that worlds can be solved.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from lunar_mjx.terrain import Terrain

_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
"""Neighbours in one half of the plane, as far as a knight's move: headings 18 to 27 deg apart."""


class Planner:
    """Ways over a square of a terrain.

    Args:
      terrain: ground and boulders. middle: of the square, m. size: its side, m.
      half_width: of the rover with a margin: boulders keep this far from its path, m.
      steepest: slope that is not driven on, rad. cell: of the grid, m.
      slope_cost: what a way on the steepest slope costs more than on level ground, as a share.
    """

    def __init__(
        self,
        terrain: Terrain,
        middle: Any,
        size: float,
        half_width: float,
        steepest: float,
        cell: float = 0.4,
        slope_cost: float = 1.0,
    ):
        self.cell, self.count = cell, round(size / cell)
        self.corner = np.asarray(middle, float) - 0.5 * size
        at = (np.arange(self.count) + 0.5) * cell
        x, y = np.meshgrid(self.corner[0] + at, self.corner[1] + at)
        slope = self._slopes(terrain, x, y)
        # Blocked and not just dear: a cheap detour over a cliff would be none.
        self.free = (slope < math.tan(steepest)) & (self._clearance(terrain, x, y, size) > half_width)
        self._graph = self._edges(1.0 + slope_cost * slope / math.tan(steepest))

    @staticmethod
    def _slopes(terrain: Terrain, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        field = terrain.field
        cell = float(field.cell)
        column, row = (np.rint((c - float(c0)) / cell).astype(int) for c, c0 in ((x[0], field.x0), (y[:, 0], field.y0)))
        part = np.asarray(field.heights)[row[0] : row[-1] + 1, column[0] : column[-1] + 1].astype(float)
        # Averaged over what a wheel covers; single nodes are rougher than a rover feels.
        north, east = np.gradient(uniform_filter(part, 3), cell)
        steep = np.hypot(north, east)
        return steep[np.ix_(row - row[0], column - column[0])]

    @staticmethod
    def _clearance(terrain: Terrain, x: np.ndarray, y: np.ndarray, size: float) -> np.ndarray:
        """Distance to the nearest boulder's surface in plan, m, as far as the sixteen nearest centres tell."""
        if terrain.rocks is None:
            return np.full(x.shape, np.inf)
        radii = np.asarray(terrain.rocks.radii, float)
        centers = np.asarray(terrain.rocks.centers, float)[:, :2]
        near = (radii > 0.0) & (np.abs(centers - [x.mean(), y.mean()]) < 0.5 * size + 2.0).all(axis=1)
        if not near.any():
            return np.full(x.shape, np.inf)
        centers, radii = centers[near], radii[near]
        apart, nearest = KDTree(centers).query(np.column_stack([x.ravel(), y.ravel()]), k=min(16, len(radii)))
        gaps = apart.reshape(x.size, -1) - radii[nearest.reshape(x.size, -1)]
        return gaps.min(axis=1).reshape(x.shape)

    def _edges(self, cost: np.ndarray) -> Any:
        n, number = self.count, np.arange(self.count**2).reshape(self.count, self.count)
        begins, ends, lengths = [], [], []
        for j, i in _STEPS:
            one = np.s_[: n - j, max(0, -i) : n - max(0, i)]
            other = np.s_[j:, max(0, i) : n - max(0, -i)]
            both_free = self.free[one] & self.free[other]
            begins.append(number[one][both_free])
            ends.append(number[other][both_free])
            # The mean of both ends, so that ways cost the same in both directions.
            lengths.append((0.5 * (cost[one] + cost[other]) * math.hypot(i, j) * self.cell)[both_free])
        begin, end, length = (np.concatenate(a) for a in (begins, ends, lengths))
        return coo_array((length, (begin, end)), shape=(n * n, n * n)).tocsr()

    def _node(self, place: Any) -> int:
        column, row = np.clip(((np.asarray(place) - self.corner) / self.cell).astype(int), 0, self.count - 1)
        return int(row * self.count + column)

    def ways(self, goal: Any, starts: np.ndarray) -> list[np.ndarray | None]:
        """The cheapest way from every start to a goal as points (point, 2), m; None where there is none."""
        # From the goal, once for all starts.
        cost, before = dijkstra(self._graph, directed=False, indices=self._node(goal), return_predecessors=True)
        cells_of_ways: list[np.ndarray | None] = []
        for start in starts:
            node = self._node(start)
            if not np.isfinite(cost[node]):
                cells_of_ways.append(None)
                continue
            nodes = [node]
            while before[nodes[-1]] >= 0:
                nodes.append(int(before[nodes[-1]]))
            row, column = np.divmod(nodes, self.count)
            cells_of_ways.append(self.corner + (np.column_stack([column, row]) + 0.5) * self.cell)
        return cells_of_ways


def length(way: np.ndarray) -> float:
    """Length of a way, m."""
    return float(np.hypot(*np.diff(way, axis=0).T).sum())
