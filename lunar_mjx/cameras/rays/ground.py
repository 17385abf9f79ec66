"""Where rays meet the ground and its rocks: a walk through squares of which the highest place is known.

The tops of the surface are kept for squares of one cell, of 2 x 2, 4 x 4 and so on (Tevs, Ihrke & Seidel 2008, Maximum
mipmaps for fast, accurate, and scalable dynamic height field rendering). A ray that stays above a square's top leaves
it in one step; otherwise the square's quarter is asked. In the last cell the bilinear patch and the rocks are hit by
formula. Nothing is stepped over, however thin it is.

All rays walk together, and a round ends when each is done or stands before a cell: the code is elementwise, so that it
runs on arrays of XLA and inside a kernel alike. `load` is how it reads the tables.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.rocks import Form, with_forms

Load = Callable[[Any, Any], Any]
"""(table, indices) to values."""

FAR = 1e9
"""Multiple of a direction that stands for "nothing is met", and for what divides by zero."""


@dataclasses.dataclass(frozen=True)
class WalkSettings:
    """Bounds of the walk of rays through squares."""

    low: float = -1e9
    """Top of a square beyond the grid, m."""
    nudge: float = 1e-3
    """Cells by which a ray goes on over an edge, so that rounding never leaves it before: some units in the last
    place of a coordinate of 1,000 cells."""
    most_rounds: int = 4096
    """Most rounds of a walk. A ray through n cells needs fewer than 3 n; rays that are not finite end here."""


WALK = WalkSettings()


_NUMBERS = ("x0", "y0", "cell", "rock_x0", "rock_y0", "rock_cell", "top")


class Grid(NamedTuple):
    """What is known when the program is built.

    Attributes:
      rows, cols: nodes of the ground. levels: of the tops above single cells. rock_rows, rock_cols: of the rocks' grid,
        0 without rocks.
    """

    rows: int
    cols: int
    levels: int
    rock_rows: int
    rock_cols: int


class Tables(NamedTuple):
    """Ground and rocks as flat tables.

    Attributes:
      numbers: see `_NUMBERS`; m. heights: of the nodes, row by row, m.
      tops: highest place within each square, coarsest level first, m.
      rock: which rock each cell of the rocks' grid knows. stones: per rock centre, radius and the six entries of its
        form; ten numbers.
    """

    numbers: Any
    heights: Any
    tops: Any
    rock: Any
    stones: Any


def take(table: Any, index: Any) -> Any:
    """The `Load` of arrays; indices are in bounds."""
    return table.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def tables(terrain: Terrain) -> tuple[Grid, Tables]:
    """What rays need to know of a terrain, which may be traced."""
    field = terrain.field
    heights = field.heights
    rows, cols = heights.shape
    # A square pyramid of a power of two, whatever the grid: levels are then shifts of indices.
    levels = math.ceil(math.log2(max(rows, cols) - 1))
    cells = jnp.maximum(
        jnp.maximum(heights[:-1, :-1], heights[1:, :-1]), jnp.maximum(heights[:-1, 1:], heights[1:, 1:])
    )
    dtype = heights.dtype
    rocks = terrain.rocks
    if rocks is None:
        zero = jnp.zeros(1, dtype)
        rock_shape, rock, stones, places = (0, 0), jnp.zeros(1, jnp.int32), zero, (zero[0],) * 3
    else:
        # Spheres as ellipsoids: one formula, and no branch between them.
        rocks = with_forms(rocks)
        rock_shape, rock, places = rocks.index.shape, rocks.index.reshape(-1), (rocks.x0, rocks.y0, rocks.cell)
        parts = [rocks.centers, rocks.radii[:, None], jnp.asarray(rocks.forms)]
        stones = jnp.concatenate(parts, axis=1).astype(dtype).reshape(-1)
        cells = jnp.maximum(cells, _stones_over(terrain, rocks, (rows - 1, cols - 1)))
    side = 2**levels
    # Beyond the grid lies nothing that a ray could meet.
    level = jnp.pad(cells, ((0, side - rows + 1), (0, side - cols + 1)), constant_values=WALK.low)
    pyramid = [level]
    while level.shape[0] > 1:
        half = level.shape[0] // 2
        level = jnp.max(level.reshape(half, 2, half, 2), axis=(1, 3))
        pyramid.append(level)
    numbers = [field.x0, field.y0, field.cell, *places, level[0, 0]]
    return (
        Grid(rows, cols, levels, *rock_shape),
        Tables(
            jnp.stack([jnp.asarray(n, dtype) for n in numbers]),
            heights.reshape(-1),
            jnp.concatenate([p.reshape(-1) for p in reversed(pyramid)]),
            rock,
            stones,
        ),
    )


def _stones_over(terrain: Terrain, rocks: Any, shape: tuple[int, int]) -> Any:
    """Upper bound of the rocks' tops over each cell of the ground, m; `WALK.low` where there is none."""
    field, (rows, cols) = terrain.field, rocks.index.shape
    centre, radius = rocks.centers[rocks.index], rocks.radii[rocks.index]
    west, south = rocks.x0 + jnp.arange(cols) * rocks.cell, rocks.y0 + jnp.arange(rows) * rocks.cell
    # beyond its edges the grid of the rocks continues
    x_gap = jnp.maximum(jnp.maximum(west - centre[..., 0], centre[..., 0] - west - rocks.cell), 0.0)
    y_gap = jnp.maximum(jnp.maximum(south[:, None] - centre[..., 1], centre[..., 1] - south[:, None] - rocks.cell), 0.0)
    # A per cent more: a bound that is too high costs a step, one too low loses a rock's edge.
    over = (x_gap**2 + y_gap**2 < (radius * 1.01) ** 2) & (radius > 0.0)
    tops = jnp.where(over, centre[..., 2] + radius, WALK.low)

    def reach(count: int, start: Any, rock_start: Any, last: int) -> tuple[Any, Any]:
        edge = (start + jnp.arange(count + 1) * field.cell - rock_start) / rocks.cell
        first = jnp.clip(jnp.floor(edge[:-1] - 1e-3).astype(jnp.int32), 0, last)
        return first, jnp.clip(jnp.floor(edge[1:] + 1e-3).astype(jnp.int32), 0, last)

    i0, i1 = reach(shape[1], field.x0, rocks.x0, cols - 1)
    j0, j1 = reach(shape[0], field.y0, rocks.y0, rows - 1)

    def along(k: Any, best: Any) -> Any:
        return jnp.maximum(best, tops[:, jnp.minimum(i0 + k, i1)])

    def across(k: Any, best: Any) -> Any:
        return jnp.maximum(best, wide[jnp.minimum(j0 + k, j1), :])

    # as many cells of the rocks' grid as one cell of the ground spans, by columns and then by rows
    low = jnp.full((rows, shape[1]), WALK.low, tops.dtype)
    wide = jax.lax.fori_loop(0, jnp.max(i1 - i0) + 1, along, low)
    return jax.lax.fori_loop(0, jnp.max(j1 - j0) + 1, across, jnp.full(shape, WALK.low, tops.dtype))


def over(value: Any) -> Any:
    """1 / value without a division by zero."""
    # The sign is kept: it tells on which side a ray leaves.
    return 1.0 / jnp.where(jnp.abs(value) < 1e-9, jnp.where(value < 0, -1e-9, 1e-9), value)


class Met(NamedTuple):
    """Where rays meet the surface: multiple of their direction, `FAR` for nothing; and which rock, -1 for soil."""

    t: Any
    rock: Any


def meet(
    grid: Grid, table: Tables, load: Load, origin: Vec3, direction: Vec3, start: Any, end: Any, coarse: int
) -> Met:
    """Where rays first meet ground or a rock.

    Args:
      grid, table: of the terrain. load: reads a table.
      origin: m, and direction, of any length; entries of one shape.
      start, end: multiples of the direction between which is looked.
      coarse: level at which to begin: high far above the ground, 0 upon it.

    Returns:
      See `Met`. Ground beyond the edge of the grid is not met; what begins below the ground meets it at `start`.
    """
    x0, y0, cell, *_, top = (table.numbers[k] for k in range(len(_NUMBERS)))
    per_cell = 1.0 / cell
    u0, v0 = (origin.x - x0) * per_cell, (origin.y - y0) * per_cell
    du, dv, dz = direction.x * per_cell, direction.y * per_cell, direction.z
    iu, iv, iz = over(du), over(dv), over(dz)
    nudge = WALK.nudge * jnp.minimum(jnp.abs(iu), jnp.abs(iv))
    # within the grid, and below the highest place
    ends_u = (-u0 * iu, (grid.cols - 1 - u0) * iu)
    ends_v = (-v0 * iv, (grid.rows - 1 - v0) * iv)
    ceiling = (top - origin.z) * iz
    # Slabs: a ray is within the grid between its latest entry and its earliest exit.
    start = jnp.maximum(jnp.maximum(start, jnp.minimum(*ends_u)), jnp.minimum(*ends_v))
    end = jnp.minimum(jnp.minimum(end, jnp.maximum(*ends_u)), jnp.maximum(*ends_v))
    start = jnp.maximum(start, jnp.where(dz < 0.0, ceiling, start))
    end = jnp.minimum(end, jnp.where(dz < 0.0, end, ceiling))
    east, north = du > 0.0, dv > 0.0
    east_i, north_i = east.astype(jnp.int32), north.astype(jnp.int32)

    def at(t: Any) -> tuple[Any, Any]:
        """Column and row of the cell."""
        u, v = jnp.clip(u0 + du * t, 0.0, grid.cols - 2.0), jnp.clip(v0 + dv * t, 0.0, grid.rows - 2.0)
        return u.astype(jnp.int32), v.astype(jnp.int32)

    def leave(i: Any, j: Any, level: Any, t: Any) -> tuple[Any, Any]:
        """Where a ray leaves square (i, j), and whether it leaves the square above, too."""
        # The edge ahead: the eastern one for rays that go east, the square's own for others.
        tu = (((i + east_i) << level).astype(u0.dtype) - u0) * iu
        tv = (((j + north_i) << level).astype(u0.dtype) - v0) * iv
        # the odd half of the square above is the eastern, northern one
        outer = jnp.where(tu < tv, (i & 1) == east_i, (j & 1) == north_i)
        return jnp.maximum(jnp.minimum(tu, tv), t) + nudge, outer.astype(jnp.int32)

    def walking(carry: tuple) -> Any:
        count, _, _, state = carry
        return (count < WALK.most_rounds) & (jnp.max(state) > 0)

    def step(carry: tuple) -> tuple:
        count, t, level, state = carry
        i, j = at(t)
        i, j = i >> level, j >> level
        up = grid.levels - level
        # (4^up - 1) / 3 squares lie in the coarser levels
        highest = load(table.tops, (((1 << (2 * up)) - 1) & 0x55555555) + (j << up) + i)
        out, outer = leave(i, j, level, t)
        out = jnp.minimum(out, end)
        now, then = origin.z + dz * t, origin.z + dz * out
        # A ray is straight, so its lower end within the square decides.
        above = jnp.minimum(now, then) > highest
        # what comes down from above goes on to where it may touch
        down = jnp.where((now > highest) & ~above, jnp.maximum((highest - origin.z) * iz - nudge, t), t)
        going = state > 0
        before = going & ~above & (level == 0)
        t = jnp.where(going, jnp.where(above, out, down), t)
        # Coarser again only when the next larger square is left, too: else it would be asked twice.
        level = jnp.where(going, jnp.where(above, jnp.minimum(level + outer, grid.levels), level - 1), level)
        state = jnp.where(going & (t >= end), 0, jnp.where(before, -1, state))
        return count + 1, t, jnp.maximum(level, 0), state

    def seeking(carry: tuple) -> Any:
        count, state = carry[0], carry[3]
        return (count < WALK.most_rounds) & (jnp.max(jnp.abs(state)) > 0)

    def round_(carry: tuple) -> tuple:
        count, t, level, state, rock = carry
        count, t, level, state = jax.lax.while_loop(walking, step, (count, t, level, state))
        i, j = at(t)
        out, outer = leave(i, j, jnp.zeros_like(i), t)
        far = jnp.minimum(out, end) - t
        found, which = _in_cell(grid, table, load, origin, direction, (u0, v0, du, dv), (i, j), t, far, nudge)
        before = state < 0
        # Up to the nudge beyond the cell, so that no ray slips through between two.
        hit = before & (found <= jnp.minimum(far + nudge, end - t))
        t = jnp.where(hit, t + found, jnp.where(before, t + far, t))
        rock = jnp.where(hit, which, rock)
        level = jnp.where(before, outer, level)
        state = jnp.where(before, jnp.where(hit | (t >= end), 0, 1), state)
        return count + 1, t, level, state, rock

    state = (start < end).astype(jnp.int32)
    nothing = jnp.full(state.shape, -2, jnp.int32)
    level = jnp.full(state.shape, min(coarse, grid.levels), jnp.int32)
    _, t, _, _, rock = jax.lax.while_loop(seeking, round_, (0, start, level, state, nothing))
    return Met(jnp.where(rock > -2, t, FAR), rock)


def _in_cell(
    grid: Grid,
    table: Tables,
    load: Load,
    origin: Vec3,
    direction: Vec3,
    cells: tuple,
    place: tuple,
    t: Any,
    far: Any,
    nudge: Any,
) -> tuple[Any, Any]:
    """How much farther rays go that are at `t` until they meet the patch of a cell or a rock, and which rock."""
    (u0, v0, du, dv), (i, j) = cells, place
    k = j * grid.cols + i
    z00, z10 = load(table.heights, k), load(table.heights, k + 1)
    z01, z11 = load(table.heights, k + grid.cols), load(table.heights, k + grid.cols + 1)
    a, b, c = z10 - z00, z01 - z00, z11 - z10 - z01 + z00
    r, s = u0 + du * t - i.astype(u0.dtype), v0 + dv * t - j.astype(u0.dtype)
    # the height over the bilinear patch along the ray, g0 + g1 x + g2 x^2
    g0 = origin.z + direction.z * t - (z00 + r * a + s * b + r * s * c)
    g1 = direction.z - (a * du + b * dv + c * (r * dv + s * du))
    g2 = -c * du * dv
    root = g1 * g1 - 4.0 * g2 * g0
    # with g0 > 0, the first root ahead is the one whose inverse is largest
    # Multiplied out, since g2 is zero along the grid's axes, where the usual formula divides by it.
    inverse = jnp.sqrt(jnp.maximum(root, 0.0)) - g1
    soil = jnp.where((root >= 0.0) & (inverse > 0.0), 2.0 * g0 / jnp.where(inverse > 0.0, inverse, 1.0), FAR)
    best, which = jnp.where(g0 <= 0.0, 0.0, soil), jnp.full_like(i, -1)
    if not grid.rock_rows:
        return best, which
    here = origin + direction * t
    # a cell may span squares of the rocks' grid: ask both ends of the way
    inset = jnp.minimum(nudge, 0.25 * far)
    for share in (inset, far - inset):
        number = _rock_at(grid, table, load, here.x + share * direction.x, here.y + share * direction.y)
        entry = _enter(load, table.stones, number, here, direction)
        nearer = entry < best
        best, which = jnp.where(nearer, entry, best), jnp.where(nearer, number, which)
    return best, which


def _rock_at(grid: Grid, table: Tables, load: Load, x: Any, y: Any) -> Any:
    x0, y0, cell = (table.numbers[k] for k in (3, 4, 5))
    i = jnp.clip((x - x0) / cell, 0.0, grid.rock_cols - 1.0).astype(jnp.int32)
    j = jnp.clip((y - y0) / cell, 0.0, grid.rock_rows - 1.0).astype(jnp.int32)
    return load(table.rock, j * grid.rock_cols + i)


def stone(load: Load, stones: Any, number: Any) -> tuple[Vec3, Any, Form]:
    """Centre, radius and form of rocks."""
    values = [load(stones, 10 * number + k) for k in range(10)]
    return Vec3(*values[:3]), values[3], Form(*values[4:])


def _enter(load: Load, stones: Any, number: Any, here: Vec3, direction: Vec3) -> Any:
    """How much farther rays enter their rock, 0 inside it, `FAR` if they do not."""
    centre, radius, form = stone(load, stones, number)
    away = here - centre
    a, b, c = form.between(direction, direction), form.between(direction, away), form.between(away, away) - 1.0
    root = b * b - a * c
    # The nearer root is where the ray enters.
    entry = (-b - jnp.sqrt(jnp.maximum(root, 0.0))) * over(a)
    ahead = jnp.where((root > 0.0) & (entry > 0.0), entry, FAR)
    return jnp.where(radius > 0.0, jnp.where(c < 0.0, 0.0, ahead), FAR)


def slope_normal(grid: Grid, table: Tables, load: Load, x: Any, y: Any) -> Vec3:
    """Unit normals of smooth shading: a central difference over two cells, not the patch's own slope."""
    x0, y0, cell = (table.numbers[k] for k in range(3))
    u, v = (x - x0) / cell, (y - y0) / cell

    def height(u: Any, v: Any) -> Any:
        u, v = jnp.clip(u, 0.0, grid.cols - 1.0), jnp.clip(v, 0.0, grid.rows - 1.0)
        i = jnp.minimum(u.astype(jnp.int32), grid.cols - 2)
        j = jnp.minimum(v.astype(jnp.int32), grid.rows - 2)
        s, r, k = u - i.astype(u.dtype), v - j.astype(u.dtype), j * grid.cols + i
        low = load(table.heights, k) * (1.0 - s) + load(table.heights, k + 1) * s
        high = load(table.heights, k + grid.cols) * (1.0 - s) + load(table.heights, k + grid.cols + 1) * s
        return low * (1.0 - r) + high * r

    # Smooth shading: facets of bilinear patches would show as a checkerboard under a low Sun.
    twice = 0.5 / cell
    east, north = (height(u + 1.0, v) - height(u - 1.0, v)) * twice, (height(u, v + 1.0) - height(u, v - 1.0)) * twice
    return Vec3(-east, -north, jnp.ones_like(east)).unit()
