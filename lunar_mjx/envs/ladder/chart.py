"""The map that a rover draws of its world while it drives, and the way to the goal over what it has seen so far.

What has not been seen counts as open ground. The way is that of value iteration: every control step relaxes the cost of
all nodes once, from the costs before, so that what is learnt of a dead end spreads over the map while the rover drives
on (real-time dynamic programming, Barto et al. 1995). No other map of the world enters.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from lunar_mjx.pytree import pytree


@dataclasses.dataclass(frozen=True)
class ChartReach:
    """What a rover sees of its world, and how it plans on what it has seen."""

    wide: float = 1.6
    """m from what is blocked at which a way costs no more than its length."""
    close: float = 3.0
    """Price of a metre right beside what is blocked, over that of an open one. Shortest ways brush past boulders, and a
    rover that drifts a hand's breadth hangs on them."""
    coarse: int = 2
    """Nodes of the planning grid to a side of a node of the chart."""
    reach: int = 20
    """Nodes ahead that a rover sees: 16 m for one as wide as LUVMI-X."""
    around: float = 2.5
    """Nodes that it knows on all sides, from its wheels and what it has just passed."""
    sweeps: int = 2
    """Relaxations a control step: the news of a dead end spreads by so many nodes, 16 m/s at 10 Hz."""
    steps: int = 6
    """Nodes along the way that are told."""


CHART = ChartReach()

HALF_VIEW = math.radians(60.0)
"""Half the horizontal angle of view."""


@pytree
class Chart:
    """What rovers know of their worlds; leading axis `env`.

    Attributes:
      seen: (row, column) whether a node has been seen.
      cost: (row, column) of the way to the goal, m of open ground.
    """

    seen: Any
    cost: Any


def prices(free: np.ndarray, cell: float) -> np.ndarray:
    """Price of a metre at every node of a planning grid, from where a rover fits, (row, column) booleans."""
    clear = cell * np.asarray(ndimage.distance_transform_edt(free))
    # Falls gradually: a step would let ways run along its edge.
    return 1.0 + (CHART.close - 1.0) * np.clip(1.0 - (clear - cell) / CHART.wide, 0.0, 1.0)


def coarse_prices(free: np.ndarray, cell: float) -> np.ndarray:
    """Prices on the chart's grid, mean of the planning grid's; infinite where more than half of its nodes are blocked.

    Were half of them enough, a quarter of rung 3's pairs of start and goal would have no way on the coarser grid. So
    all have one, and ridges, four and a half nodes thick, stay closed.
    """
    count = free.shape[0] // CHART.coarse

    def mean(grid: np.ndarray) -> np.ndarray:
        return grid.reshape(count, CHART.coarse, count, CHART.coarse).mean(axis=(1, 3))

    return np.where(mean(free.astype(float)) >= 0.5, mean(prices(free, cell)), np.inf)


def _nodes(count: int) -> tuple[Any, Any]:
    """Rows and columns of all nodes, of shapes that broadcast to (env, row, column)."""
    return jnp.arange(count)[None, :, None], jnp.arange(count)[None, None, :]


def begin(count: int, goal: Any, cell: Any) -> Chart:
    """The chart of who has seen nothing: every way is straight, in eight directions.

    Args:
      count: nodes to a side. goal: (env, 2) m from the world's corner. cell: spacing of the nodes, m.
    """
    row, column = _nodes(count)
    end = jnp.clip((goal / cell).astype(jnp.int32), 0, count - 1)[:, :, None, None]
    up, along = jnp.abs(row - end[:, 1]), jnp.abs(column - end[:, 0])
    short, long = jnp.minimum(up, along), jnp.maximum(up, along)
    # The cost that value iteration on an empty map ends with, so that nothing has to settle first.
    cost = cell * (long + (math.sqrt(2.0) - 1.0) * short).astype(goal.dtype)
    return Chart(jnp.zeros(cost.shape, bool), cost)


def look(chart: Chart, price: Any, world: Any, position: Any, yaw: Any, goal: Any, cell: Any) -> Chart:
    """The chart after a look around and `CHART.sweeps` relaxations.

    A camera on a mast higher than the boulders sees, behind each, the tops of all that are no lower. That hills hide
    what lies behind them is left out.

    Args:
      chart: before. price: (world, row, column) of a metre, infinite where blocked. world: (env,) its number.
      position, goal: (env, 2) m from the corner of the world. yaw: (env,) rad. cell: spacing of the nodes, m.
    """
    count = price.shape[-1]
    row, column = _nodes(count)
    cell_position = position / cell
    dx, dy = column + 0.5 - cell_position[:, 0, None, None], row + 0.5 - cell_position[:, 1, None, None]
    far = jnp.sqrt(dx * dx + dy * dy)
    cos, sin = jnp.cos(yaw)[:, None, None], jnp.sin(yaw)[:, None, None]
    # By cosine: no angle to wrap.
    ahead = dx * cos + dy * sin > far * math.cos(HALF_VIEW)
    seen = chart.seen | ((far < CHART.reach) & (ahead | (far < CHART.around)))
    # the fence of the world is known from the beginning
    edge = jnp.zeros((count, count), bool).at[0].set(True).at[-1].set(True).at[:, 0].set(True).at[:, -1].set(True)
    # Optimism: what is unseen is taken for open, so that the way leads there and finds out.
    known = jnp.where(seen | edge, price[world], 1.0)
    end = jnp.clip((goal / cell).astype(jnp.int32), 0, count - 1)[:, :, None, None]
    at_goal = (row == end[:, 1]) & (column == end[:, 0])

    def relax(cost: Any, _: Any) -> tuple[Any, None]:
        # Beyond the border there is no way.
        wide = jnp.pad(cost, ((0, 0), (1, 1), (1, 1)), constant_values=jnp.inf)

        def near(j: int, i: int) -> Any:
            return wide[:, 1 + j : 1 + j + count, 1 + i : 1 + i + count]

        straight = jnp.minimum(jnp.minimum(near(0, 1), near(0, -1)), jnp.minimum(near(1, 0), near(-1, 0)))
        aslant = jnp.minimum(jnp.minimum(near(1, 1), near(1, -1)), jnp.minimum(near(-1, 1), near(-1, -1)))
        # The old cost is left out of the minimum: costs must be able to rise where a dead end shows itself.
        best = jnp.minimum(straight + cell * known, aslant + math.sqrt(2.0) * cell * known)
        return jnp.where(at_goal, 0.0, best), None

    return Chart(seen, jax.lax.scan(relax, chart.cost, length=CHART.sweeps)[0])


def way(chart: Chart, price: Any, world: Any, position: Any, goal: Any, cell: Any) -> tuple[Any, Any, Any]:
    """The next nodes of the way, down the steepest descent of the cost.

    Args:
      As of `look`.

    Returns:
      (env, 2) where to aim, the last node that is straight ahead over known or unseen free ground; (env, node, 2) the
      nodes of the way, both m from the rover; and (env,) the cost of the way, m of open ground.
    """
    count = price.shape[-1]
    env, cell_position = jnp.arange(position.shape[0]), position / cell
    steps = jnp.asarray([(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1)])
    stride = cell * jnp.sqrt(jnp.sum(steps * steps, axis=-1).astype(position.dtype))
    share = jnp.linspace(0.0, 1.0, 2 * CHART.steps + 1)[1:, None, None]

    def blocked(points: Any) -> Any:
        at = jnp.clip(points.astype(jnp.int32), 0, count - 1)
        return chart.seen[env, at[..., 1], at[..., 0]] & jnp.isinf(price[world, at[..., 1], at[..., 0]])

    node = jnp.clip(cell_position.astype(jnp.int32), 0, count - 1)
    aim, straight, nodes = node + 0.5, jnp.ones(node.shape[0], bool), []
    left: Any = None
    for k in range(CHART.steps):
        near = jnp.clip(node + steps[:, None, :], 0, count - 1)
        cost = chart.cost[env, near[..., 1], near[..., 0]]
        # staying is best at the goal alone: a cost that is out of date must not hold the rover
        still = (steps == 0).all(-1)[:, None] & (cost > 0.0)
        total = jnp.where(still, jnp.inf, cost + stride[:, None])
        best = jnp.argmin(total, axis=0)
        if left is None:
            left = jnp.min(total, axis=0)
        node = jnp.take_along_axis(near, best[None, :, None], axis=0)[0]
        straight = straight & (~blocked(cell_position + share * (node + 0.5 - cell_position)).any(axis=0) | (k == 0))
        aim = jnp.where(straight[:, None], node + 0.5, aim)
        nodes.append((node + 0.5) * cell)
    close = jnp.sum((goal - position) ** 2, axis=-1) < (2.0 * cell) ** 2
    aim = jnp.where(close[:, None], goal, aim * cell) - position
    return aim, jnp.stack(nodes, axis=1) - position[:, None], jnp.minimum(left, 1e3)


def straight(position: Any, goal: Any, cell: Any) -> tuple[Any, Any, Any]:
    """Where to aim, nodes and distance as `way` returns them, for a rover without a chart: straight to the goal."""
    away = goal - position
    far = jnp.sqrt(jnp.sum(away * away, axis=-1, keepdims=True))
    reach = jnp.minimum(cell * jnp.arange(1, CHART.steps + 1), far)
    nodes = away[:, None] / jnp.maximum(far, 1e-3)[..., None] * reach[..., None]
    return nodes[:, -1], nodes, far[:, 0]
