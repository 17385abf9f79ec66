"""Where rovers start and where they are sent: pairs of places on a terrain, drawn and checked once on the host."""

from __future__ import annotations

import jax
import numpy as np
from scipy.spatial import KDTree

from lunar_mjx.errors import bad_input
from lunar_mjx.terrain import Terrain

_TRIES = 200
"""Rounds of drawing until the terrain is taken to have too few free places."""


def draw_places(
    terrain: Terrain,
    count: int,
    distance: tuple[float, float],
    seed: int,
    *,
    clearance: float,
    margin: float = 3.0,
    steepest: float = np.radians(20.0),
    within: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draws pairs of start and goal.

    Both lie on the terrain, `margin` from its edge, clear of rocks, on ground below `steepest`; what lies between them
    is not looked at.

    Args:
      terrain: the ground.
      count: pairs.
      distance: least and greatest distance between start and goal, m, drawn uniformly.
      seed: of the draw.
      clearance: from rocks' surfaces in plan, m.
      margin: from the edge of the grid, m.
      steepest: slope, rad.
      within: starts lie in the square of this half side about the origin, m; anywhere if None.

    Returns:
      Starts and goals, each (count, 2) float32, m.

    Raises:
      UserError: the terrain has no room for such pairs.
    """
    # On the host: a search with trees, once per environment.
    terrain = jax.device_get(terrain)
    heights = np.asarray(terrain.field.heights, float)
    x0, y0, cell = (float(v) for v in (terrain.field.x0, terrain.field.y0, terrain.field.cell))
    rows, cols = heights.shape
    low = np.array([x0, y0]) + margin
    high = np.array([x0 + (cols - 1) * cell, y0 + (rows - 1) * cell]) - margin
    gradient = np.hypot(*np.gradient(heights, cell)) if min(rows, cols) > 1 else np.zeros_like(heights)
    gentle = gradient < np.tan(steepest)
    rocks, tree = _rocks(terrain)

    def free(points: np.ndarray) -> np.ndarray:
        inside = ((points >= low) & (points <= high)).all(axis=1)
        index = np.clip(np.rint((points - [x0, y0]) / cell).astype(int), 0, [cols - 1, rows - 1])
        ok = inside & gentle[index[:, 1], index[:, 0]]
        if tree is not None:
            reach = rocks[:, 2].max() + clearance
            near = tree.query_ball_point(points, reach)
            for i, found in enumerate(near):
                if found and ok[i]:
                    gap = np.hypot(*(rocks[found, :2] - points[i]).T) - rocks[found, 2]
                    ok[i] = gap.min() > clearance
        return ok

    rng = np.random.default_rng([seed, 11])
    first, last = (low, high) if within is None else (np.maximum(low, -within), np.minimum(high, within))
    starts, goals, have = [], [], 0
    if (last > first).all():
        for _ in range(_TRIES):
            # Many at a time, since on rough ground few of a hundred are free.
            n = max(256, min(count, 20_000))
            begin = first + rng.random((n, 2)) * (last - first)
            angle, far = 2 * np.pi * rng.random(n), rng.uniform(*distance, n)
            end = begin + far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            inside = ((end >= low) & (end <= high)).all(axis=1)
            # The cheap test first; rocks are searched for what is left.
            begin, end = begin[inside], end[inside]
            good = free(begin) & free(end)
            starts.append(begin[good])
            goals.append(end[good])
            have += int(good.sum())
            if have >= count:
                break
    if have < count:
        raise bad_input(
            "navigation",
            "goal_distance",
            distance,
            f"leaves too few places on {terrain.name} ({have} of {count} found)",
            "shorten it, or take a larger terrain",
        )
    taken = [np.concatenate(a)[:count].astype(np.float32) for a in (starts, goals)]
    return taken[0], taken[1]


def _rocks(terrain: Terrain) -> tuple[np.ndarray, KDTree | None]:
    """x, y and radius of the rocks, and a tree over them."""
    if terrain.rocks is None:
        return np.zeros((0, 3)), None
    radii = np.asarray(terrain.rocks.radii, float)
    real = radii > 0
    if not real.any():
        return np.zeros((0, 3)), None
    rocks = np.column_stack([np.asarray(terrain.rocks.centers, float)[real, :2], radii[real]])
    return rocks, KDTree(rocks[:, :2])
