"""A pool of worlds side by side on one map: made once by a program of its own, so that an episode's reset only picks.

The environment's step sees one terrain and a table of places, as it does for any other task: its program does not
depend on how worlds are made.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.envs.ladder.chart import coarse_prices
from lunar_mjx.envs.ladder.ground import World, make_world
from lunar_mjx.envs.ladder.rungs import Rung
from lunar_mjx.envs.ladder.ways import draw_goal, survey
from lunar_mjx.errors import bad_input
from lunar_mjx.pytree import pytree
from lunar_mjx.terrain import HeightField, Rocks, Terrain
from lunar_mjx.terrain.rocks import CELL


@dataclasses.dataclass(frozen=True)
class PoolSizes:
    """How many places a world of the pool has, and how worlds are made."""

    goals: int = 4
    """Goals of a world."""
    starts: int = 16
    """Starts of a goal."""
    batch: int = 4
    """Worlds that are made at once."""


POOL_SIZES = PoolSizes()


@pytree
class Places:
    """Pairs of start and goal on a pool; all lead with `place`.

    Attributes:
      starts, goals: (place, 2) m on the map.
      arrivals: heading to arrive in, rad. shortest: length of the shortest way, m.
      way: number of the goal's distances in `Pool.ways`. world: number of the world.
      nearer: (place, level, 2) starts of a curriculum, nearer to the goal on the shortest way, the last one `starts`;
        nearer_shortest: (place, level) what is left of it. None without one.
    """

    starts: Any
    goals: Any
    arrivals: Any
    shortest: Any
    way: Any
    world: Any
    nearer: Any = None
    nearer_shortest: Any = None


@pytree
class Pool:
    """Worlds side by side on one map, with their places and ways.

    Attributes:
      terrain: the map of all; None where it is kept elsewhere.
      places: where to start and go.
      ways: (goal, row, column) distance to each goal over the planning grid of its world, m.
      middles: (world, 2) of the worlds on the map, m.
      size: side of a world, m.
      prices: (world, row, column) price of a metre on the grid of the rovers' charts, infinite where blocked.
      usual_price: median of those where nothing blocks.
    """

    terrain: Any
    places: Places
    ways: Any
    middles: Any
    size: Any
    prices: Any
    usual_price: Any


def way_left(pool: Pool, place: Any, position: Any) -> tuple[Any, Any]:
    """Length of the shortest way to the goal from where rovers are.

    Args:
      pool: the worlds. place: (env,) number of the pair of start and goal. position: (env, 2) m on the map.

    Returns:
      The length between the free nodes around each rover, m, and whether there are any, each (env,).
    """
    way, world, count = pool.places.way[place], pool.places.world[place], pool.ways.shape[-1]
    node = (position - pool.middles[world] + 0.5 * pool.size) / (pool.size / count) - 0.5
    first = jnp.clip(jnp.floor(node), 0, count - 2)
    share = jnp.clip(node - first, 0.0, 1.0)
    column, row = first.astype(jnp.int32).T
    total = weight = jnp.zeros(place.shape, position.dtype)
    for j in (0, 1):
        for i in (0, 1):
            length = pool.ways[way, row + j, column + i]
            part = (share[:, 0] if i else 1.0 - share[:, 0]) * (share[:, 1] if j else 1.0 - share[:, 1])
            # Nodes within a boulder's margin have no way; the others share their weight.
            part = jnp.where(jnp.isfinite(length), part, 0.0)
            total, weight = total + part * jnp.where(part > 0.0, length, 0.0), weight + part
    return total / jnp.maximum(weight, 1e-3), weight > 1e-3


def make_pool(rung: Rung, seed: int, worlds: int, half_width: float, hardness: float = 1.0, levels: int = 0) -> Pool:
    """Makes the worlds of a rung with their places.

    Args:
      rung: which, for this rover (`Rung.scaled`).
      seed: of everything in them.
      worlds: how many. half_width: of the rover with a margin, m. hardness: see `make_world`.
      levels: of a curriculum, see `Places.nearer`.

    Raises:
      UserError: no world has a pair of places as the rung asks.
    """
    made = maker(rung, worlds, half_width, levels)(jax.random.PRNGKey(seed), jnp.float32(hardness))
    world, goals, clear, slope = made
    valid = np.asarray(goals["valid"])
    if not valid.any():
        raise bad_input("ladder", "worlds", worlds, "have no such places", "raise it, or lower the hardness")
    # About square: float32 places are finest near the map's middle.
    across = math.ceil(math.sqrt(worlds))
    middles = _middles(worlds, across, rung.size)
    grounds = zip(np.asarray(clear), np.asarray(slope), strict=True)
    price = np.stack([coarse_prices(c, s, rung.plan_cell) for c, s in grounds])
    return Pool(
        _atlas(rung, world, middles, across),
        _places(goals, valid, np.asarray(middles), seed),
        goals["way"].reshape(-1, *goals["way"].shape[2:]),
        jnp.asarray(middles, jnp.float32),
        jnp.float32(rung.size),
        jnp.asarray(price, jnp.float32),
        jnp.float32(np.median(price[np.isfinite(price)])),
    )


@functools.cache
def maker(rung: Rung, worlds: int, half_width: float, levels: int) -> Any:
    """The compiled maker: key and hardness to worlds, their goals, and which nodes are clear and how steep, some worlds
    at a time."""

    def one(key: Any, hardness: Any) -> Any:
        k_world, k_goals = jax.random.split(key)
        world = make_world(rung, k_world, hardness)
        ground = survey(rung, world, half_width)
        keys = jax.random.split(k_goals, POOL_SIZES.goals)
        # Distances are found once per goal and kept: a step then only reads them.
        goals = jax.vmap(lambda k: draw_goal(rung, ground, k, POOL_SIZES.starts, levels))(keys)
        return world, goals, ground.clear, ground.slope

    def all_of(key: Any, hardness: Any) -> Any:
        # A few at a time: all at once would need their distances' memory at once.
        return jax.lax.map(lambda k: one(k, hardness), jax.random.split(key, worlds), batch_size=POOL_SIZES.batch)

    return jax.jit(all_of)


def _middles(worlds: int, across: int, size: float) -> np.ndarray:
    rows = math.ceil(worlds / across)
    number = np.arange(worlds)
    return size * np.column_stack([number % across - 0.5 * (across - 1), number // across - 0.5 * (rows - 1)])


def _atlas(rung: Rung, world: World, middles: np.ndarray, across: int) -> Terrain:
    """The worlds' grids side by side, and their boulders in one list; what is left over of the map is level."""
    count, rocks_each = world.radii.shape
    rows = math.ceil(count / across)

    def tiled(grids: Any, fill: Any) -> Any:
        spare = rows * across - count
        full = jnp.concatenate([grids, jnp.full((spare, *grids.shape[1:]), fill, grids.dtype)])
        high, wide = grids.shape[1:]
        return full.reshape(rows, across, high, wide).swapaxes(1, 2).reshape(rows * high, across * wide)

    # Boulders of all worlds are one list; indices move by the worlds before.
    number = world.index + rocks_each * jnp.arange(count)[:, None, None]
    index = jnp.where(world.index == rocks_each, count * rocks_each, number)
    shift = jnp.pad(jnp.asarray(middles, jnp.float32), ((0, 0), (0, 1)))
    centers = (world.centers + shift[:, None]).reshape(-1, 3)
    west, south = (-0.5 * n * rung.size for n in (across, rows))
    cell = rung.cell
    field = HeightField(
        tiled(world.heights, 0.0), *(jnp.float32(v) for v in (west + 0.5 * cell, south + 0.5 * cell, cell))
    )
    rocks = Rocks(
        jnp.pad(centers, ((0, 1), (0, 0))),
        jnp.pad(world.radii.reshape(-1), (0, 1)),
        tiled(index, count * rocks_each),
        *(jnp.float32(v) for v in (west, south, CELL)),
    )
    return Terrain(field, rocks, None, jnp.zeros(3), "ladder")


def _places(goals: dict[str, Any], valid: np.ndarray, middles: np.ndarray, seed: int) -> Places:
    """The pairs of the goals that have starts, repeated until there are as many as with all goals."""
    starts = goals["starts"].shape[2]
    good = np.flatnonzero(valid.reshape(-1))
    # Repeated to a fixed number, so that another seed's pool has the same shapes.
    way = np.repeat(np.resize(good, valid.size), starts)
    number = np.tile(np.arange(starts), valid.size)
    world = way // valid.shape[1]
    return pairs(goals, way, number, world, middles[world], np.random.default_rng([seed, 17]))


def pairs(
    goals: dict[str, Any],
    way: np.ndarray,
    number: np.ndarray,
    world: np.ndarray,
    middle: np.ndarray,
    draw: np.random.Generator,
) -> Places:
    """Pairs of start and goal, all arguments leading with `place`.

    Args:
      goals: of some worlds, as `draw_goal` tells them. way: which of their goals, counted through. number: which of its
        starts. world: number of the world. middle: (place, 2) of it, m. draw: of the headings to arrive in.
    """

    def of_goals(name: str) -> np.ndarray:
        array = np.asarray(goals[name])
        return array.reshape(-1, *array.shape[2:])

    start = of_goals("starts")[way, number] + middle
    goal = of_goals("goal")[way] + middle
    bearing = np.arctan2(*(goal - start).T[::-1])
    # from any side but the far one: a rover need not drive around its goal
    arrival = bearing + draw.uniform(-0.5 * np.pi, 0.5 * np.pi, len(way))
    shortest = of_goals("shortest")[way, number]
    start, goal, arrival, shortest = (jnp.asarray(a, jnp.float32) for a in (start, goal, arrival, shortest))
    places = Places(start, goal, arrival, shortest, jnp.asarray(way), jnp.asarray(world))
    if "nearer" not in goals:
        return places
    nearer, left = of_goals("nearer")[way, number] + middle[:, None], of_goals("nearer_shortest")[way, number]
    return dataclasses.replace(
        places, nearer=jnp.asarray(nearer, jnp.float32), nearer_shortest=jnp.asarray(left, jnp.float32)
    )
