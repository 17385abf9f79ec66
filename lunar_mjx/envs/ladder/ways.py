"""Ways through a world: where a rover fits, how far every place is from a goal, and pairs of start and goal."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp

from lunar_mjx.envs.ladder.ground import RIM, World, near_boulders, nodes, steepness
from lunar_mjx.envs.ladder.rungs import Rung
from lunar_mjx.pytree import pytree


@dataclasses.dataclass(frozen=True)
class WayLimits:
    """Where ways, starts and goals may lie."""

    steepest: float = math.radians(12.0)
    """Slope up to which ways are planned, rad: LUVMI-X in the preset `consistent` still climbs 12 deg (slip 0.83) and
    slides back on 15 deg."""
    level: float = 0.7
    """Share of `steepest` up to which the ground of a start or goal may slope."""
    room: float = 0.9
    """m around a start or goal that are free of boulders, for a rover as wide as LUVMI-X: enough to turn."""
    half_width: float = 0.4
    """m; half of LUVMI-X's width with a margin, for which `room` was chosen."""


WAY_LIMITS = WayLimits()

_STEPS = tuple((j, i, math.hypot(i, j)) for j in (-1, 0, 1) for i in (-1, 0, 1) if i or j)


def slope_grid(rung: Rung, heights: Any) -> Any:
    """Greatest slope of the ground, averaged over 3 cells, within each node of the planning grid; tangent."""
    wide = jnp.pad(heights, 1, mode="edge")
    count = heights.shape[0]
    smooth = sum(wide[j : j + count, i : i + count] for j in range(3) for i in range(3)) / 9.0
    per = round(rung.plan_cell / rung.cell)
    blocks = steepness(smooth, rung.cell).reshape(count // per, per, count // per, per)
    # The greatest within a node: a ledge across it must not be averaged away.
    return blocks.max(axis=(1, 3))


@pytree
class Ground:
    """What the planning grid says of a world; (row, column) each.

    Attributes:
      clear: no boulder within a rover's half width, and inside the world's rim.
      slope: greatest within the node, tangent.
      free: clear, and level enough that ways are planned there. roomy: free, with room to turn.
    """

    clear: Any
    slope: Any
    free: Any
    roomy: Any


def survey(rung: Rung, world: World, half_width: float) -> Ground:
    """The planning grid of a world for a rover of this half width, m."""
    at = nodes(rung.size, rung.plan_cell)
    x, y = jnp.meshgrid(at, at)
    gap, _ = near_boulders(rung, world.centers, world.radii, x, y)
    slope = slope_grid(rung, world.heights)
    inside = jnp.abs(at) < 0.5 * rung.size - RIM
    clear = inside[:, None] & inside[None, :] & (gap > half_width)
    # Wider rovers need more of it, in proportion.
    room = WAY_LIMITS.room * half_width / WAY_LIMITS.half_width
    free = clear & (slope < math.tan(WAY_LIMITS.steepest))
    roomy = free & (gap > room) & (slope < math.tan(WAY_LIMITS.level * WAY_LIMITS.steepest))
    return Ground(clear, slope, free, roomy)


def distances(free: Any, row: Any, column: Any, cell: float, price: Any = 1.0) -> Any:
    """Length of the shortest way to a node over free nodes and their eight neighbours, m; infinite where there is none.

    With a `price` of a metre at every node, (row, column), it is the cost of the cheapest way.

    The relaxation of Bellman and Ford for all nodes at once, until nothing changes. Ways bend by 45 deg at a time, so
    that they are up to 8 % longer than free ones.
    """
    blocked = jnp.where(free, 0.0, jnp.inf)
    start = jnp.full(free.shape, jnp.inf).at[row, column].set(0.0) + blocked

    def relax(carry: Any) -> Any:
        old, _ = carry
        wide = jnp.pad(old, 1, constant_values=jnp.inf)
        best = old
        for j, i, length in _STEPS:
            near = jax.lax.dynamic_slice(wide, (1 + j, 1 + i), free.shape)
            best = jnp.minimum(best, near + length * cell * price)
        # Infinity added keeps blocked nodes blocked, whatever their neighbours offer.
        best = best + blocked
        return best, jnp.any(best < old)

    return jax.lax.while_loop(lambda carry: carry[1], relax, (start, jnp.array(True)))[0]


def on_the_way(way: Any, roomy: Any, begin: Any, shares: Any, cell: float) -> Any:
    """Nodes on the shortest ways at which a share of them is left, and which have room to turn.

    Args:
      way: (row, column) distances to the goal. roomy: (row, column).
      begin: (start,) numbers of the nodes where ways begin. shares: (level,) of their lengths. cell: m.

    Returns:
      (level, start) numbers of nodes; the beginning where no node on the way has room.
    """
    count = way.shape[0]
    flat, room = way.reshape(-1), roomy.reshape(-1)
    wanted = shares[:, None] * flat[begin]

    def forward(carry: Any) -> Any:
        node, best, chosen = carry
        gap = jnp.where(room[node], jnp.abs(flat[node] - wanted), jnp.inf)
        best, chosen = jnp.minimum(best, gap), jnp.where(gap < best, node, chosen)
        row, column = node // count, node % count
        near = jnp.stack(
            [jnp.clip(row + j, 0, count - 1) * count + jnp.clip(column + i, 0, count - 1) for j, i, _ in _STEPS]
        )
        length = flat[near] + cell * jnp.asarray([s for _, _, s in _STEPS])[:, None]
        following = jnp.take_along_axis(near, jnp.argmin(length, axis=0)[None], axis=0)[0]
        # who has arrived waits for the others
        return jnp.where(flat[node] > 0.0, following, node), best, chosen

    def on(carry: Any) -> Any:
        return (flat[carry[0]] > 0.0).any() & jnp.isfinite(flat[carry[0]]).all()

    far = jnp.full(wanted.shape, jnp.inf)
    chosen = jnp.broadcast_to(begin, wanted.shape)
    return jax.lax.while_loop(on, forward, (begin, far, chosen))[2]


def draw_goal(rung: Rung, ground: Ground, key: Any, starts: int, levels: int = 0) -> dict[str, Any]:
    """A goal with its distances, and starts for it.

    Args:
      rung: which. ground: of the world. key: random. starts: how many.
      levels: of a curriculum.

    Returns:
      `goal` (2,), `starts` (start, 2), m from the world's middle; `shortest` (start,) length of the shortest way;
      `way` (row, column) the distances; `valid`: whether the world has such starts. With levels also `nearer`
      (start, level, 2), starts on the shortest ways, and `nearer_shortest` (start, level), m.
    """
    free, roomy = ground.free, ground.roomy
    at = nodes(rung.size, rung.plan_cell)
    count = at.shape[0]
    k_goal, k_start = jax.random.split(key)
    # Evenly over free nodes: log weights of zero or never.
    chance = jnp.where(roomy.reshape(-1), 0.0, -jnp.inf)
    end = jax.random.categorical(k_goal, chance)
    way = distances(free, end // count, end % count, rung.plan_cell)
    goal = jnp.stack([at[end % count], at[end // count]])
    straight = jnp.hypot(at[None, :] - goal[0], at[:, None] - goal[1])
    low, high = rung.goal_distance
    # A detour is asked for, so that driving straight is not enough.
    fits = roomy & jnp.isfinite(way) & (straight >= low) & (straight <= high) & (way >= rung.detour * straight)
    begin = jax.random.categorical(k_start, jnp.where(fits.reshape(-1), 0.0, -jnp.inf), shape=(starts,))
    found = {
        "goal": goal,
        "starts": jnp.stack([at[begin % count], at[begin // count]], axis=-1),
        "shortest": way.reshape(-1)[begin],
        "way": way,
        "valid": fits.any(),
    }
    if levels:
        near = on_the_way(way, roomy, begin, (jnp.arange(levels) + 1.0) / levels, rung.plan_cell).T
        found["nearer"] = jnp.stack([at[near % count], at[near // count]], axis=-1)
        found["nearer_shortest"] = way.reshape(-1)[near]
    return found
