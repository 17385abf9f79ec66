"""The map that a rover draws of its world while it drives, and the way to the goal over what it has seen so far.

What has not been seen counts as open ground. The way is that of value iteration: every control step relaxes the cost of
all nodes, from the costs before, so that what is learnt of a dead end spreads over the map while the rover drives
on (real-time dynamic programming, Barto et al. 1995). No other map of the world enters.

Only boulders block. A slope is dear, as it takes time; where the rover has tried in vain, a place becomes dearer with
every try; and around a goal with a heading to arrive in, all ground but the approach is dear.
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
    climb: float = math.radians(12.0)
    """Slope on which LUVMI-X comes to a stand in the mean soil of the training, in the preset `consistent`, rad."""
    dearest: float = 60.0
    """Price of a metre that is as steep or steeper, or that boulders block in part, over that of a level one. Not
    infinite: rovers that have slid into a crater must try to get out, and down a slope or across it they come."""
    patience: float = 2.5
    """s without progress after which the place ahead counts as tried in vain, and again after as long."""
    tried_ahead: float = 1.25
    """Nodes from the rover's middle to the place that stops its wheels."""
    tried_around: float = 1.3
    """Nodes about that place that become dearer: the rover's width."""
    most_tries: int = 8
    """Tries in vain that are counted; the price doubles with each."""
    approach: float = 3.0
    """Nodes around a goal with a heading to arrive in where other ground than the approach is dear."""
    detached: float = 8.0
    """Price of a metre there."""
    bend: float = 1.05
    """Price of a straight line, over that of the way that it cuts short, up to which it is driven."""
    approach_share: float = 0.75
    """Half the approach's angle, of the one within which the heading is met: from its edge the turn is not easy."""
    arrived: float = 0.75
    """Nodes from the goal that are never dear: the goal's radius for a rover as wide as LUVMI-X."""


CHART = ChartReach()

HALF_VIEW = math.radians(60.0)
"""Half the horizontal angle of view."""


@pytree
class Chart:
    """What rovers know of their worlds; leading axis `env`.

    Attributes:
      seen: (row, column) whether a node has been seen.
      tries: (row, column) how often the rover has come no farther at a node.
      cost: (row, column) of the way to the goal, m of open ground.
    """

    seen: Any
    tries: Any
    cost: Any


@pytree
class Errand:
    """Where rovers are and go; leading axis `env` but for the first and the last two.

    Attributes:
      price: (world, row, column) of a metre, infinite where blocked. world: its number.
      position, goal: (env, 2) m from the corner of the world.
      cell: spacing of the nodes, m.
      unseen: price of a metre that has not been seen: open ground as it is on average. Were it free ground at its best,
        rovers would rather look for better ways than drive those that they know.
      arrival: heading to arrive in, rad; None for any. within: what it must be met by, rad.
    """

    price: Any
    world: Any
    position: Any
    goal: Any
    cell: Any
    unseen: Any = 1.0
    arrival: Any = None
    within: Any = math.pi

    @property
    def count(self) -> int:
        """Nodes to a side."""
        return self.price.shape[-1]

    def detached(self, dx: Any, dy: Any, arrival: Any) -> Any:
        """Factor on the price of a metre at places around the goal, from which its heading cannot be met.

        Args:
          dx, dy: from the goal, nodes. arrival: as the attribute, of a shape that goes with them.
        """
        if arrival is None:
            return 1.0
        far = jnp.sqrt(dx * dx + dy * dy)
        # who arrives in a heading comes from the opposite side
        approach = -(dx * jnp.cos(arrival) + dy * jnp.sin(arrival)) > far * jnp.cos(CHART.approach_share * self.within)
        return jnp.where((far < CHART.approach) & (far > CHART.arrived) & ~approach, CHART.detached, 1.0)


def prices(free: np.ndarray, cell: float) -> np.ndarray:
    """Price of a metre at every node of a planning grid, from where a rover fits, (row, column) booleans."""
    clear = cell * np.asarray(ndimage.distance_transform_edt(free))
    # Falls gradually: a step would let ways run along its edge.
    return 1.0 + (CHART.close - 1.0) * np.clip(1.0 - (clear - cell) / CHART.wide, 0.0, 1.0)


def coarse_prices(clear: np.ndarray, slope: np.ndarray, cell: float) -> np.ndarray:
    """Prices on the chart's grid; infinite where boulders block more than half of the planning grid's nodes.

    Were half of them enough, a quarter of rung 3's pairs of start and goal would have no way on the coarser grid. So
    all have one, and ridges, four and a half nodes thick, stay closed.

    Args:
      clear: (row, column) whether boulders leave room. slope: (row, column) tangent. cell: their spacing, m.
    """
    count = clear.shape[0] // CHART.coarse

    def mean(grid: np.ndarray) -> np.ndarray:
        return grid.reshape(count, CHART.coarse, count, CHART.coarse).mean(axis=(1, 3))

    # At full drive the speed falls about evenly with the slope, to nothing at `climb`, and rises as much downhill. The
    # map does not say which way it will be driven: the mean of both times, (1 / (1 - s) + 1 / (1 + s)) / 2.
    share = np.arctan(mean(slope)) / CHART.climb
    steep = 1.0 / np.maximum(1.0 - share**2, 1.0 / CHART.dearest)
    # A gap of which a part is blocked takes exact driving: rovers hang on its boulders and roll over.
    narrow = mean(np.where(clear, prices(clear, cell), CHART.dearest))
    # Time on the slope and room beside boulders are prices of their own.
    return np.where(mean(clear.astype(float)) >= 0.5, narrow + steep - 1.0, np.inf)


def _nodes(count: int) -> tuple[Any, Any]:
    """Rows and columns of all nodes, of shapes that broadcast to (env, row, column)."""
    return jnp.arange(count)[None, :, None], jnp.arange(count)[None, None, :]


def begin(at: Errand) -> Chart:
    """The chart of who has seen nothing: every way is straight, in eight directions."""
    count, cell, goal = at.count, at.cell, at.goal
    row, column = _nodes(count)
    end = jnp.clip((goal / cell).astype(jnp.int32), 0, count - 1)[:, :, None, None]
    up, along = jnp.abs(row - end[:, 1]), jnp.abs(column - end[:, 0])
    short, long = jnp.minimum(up, along), jnp.maximum(up, along)
    # The cost that value iteration on an empty map ends with, so that nothing has to settle first.
    cost = at.unseen * cell * (long + (math.sqrt(2.0) - 1.0) * short).astype(goal.dtype)
    return Chart(jnp.zeros(cost.shape, bool), jnp.zeros(cost.shape, jnp.uint8), cost)


def look(chart: Chart, at: Errand, yaw: Any, vain: Any) -> Chart:
    """The chart after a look around and `CHART.sweeps` relaxations.

    A camera on a mast higher than the boulders sees, behind each, the tops of all that are no lower. That hills hide
    what lies behind them is left out.

    Args:
      chart: before. at: where rovers are. yaw: (env,) rad.
      vain: (env,) 1 where a rover comes no farther ahead, -1 backwards, else 0.
    """
    count, cell, goal = at.count, at.cell, at.goal
    row, column = _nodes(count)
    cell_position = at.position / cell
    dx, dy = column + 0.5 - cell_position[:, 0, None, None], row + 0.5 - cell_position[:, 1, None, None]
    far = jnp.sqrt(dx * dx + dy * dy)
    cos, sin = jnp.cos(yaw)[:, None, None], jnp.sin(yaw)[:, None, None]
    # By cosine: no angle to wrap.
    ahead = dx * cos + dy * sin > far * math.cos(HALF_VIEW)
    seen = chart.seen | ((far < CHART.reach) & (ahead | (far < CHART.around)))
    side = CHART.tried_ahead * vain[:, None, None]
    met = ((dx - side * cos) ** 2 + (dy - side * sin) ** 2 < CHART.tried_around**2) & (side != 0.0)
    tries = jnp.minimum(chart.tries + met.astype(jnp.uint8), CHART.most_tries).astype(jnp.uint8)
    # the fence of the world is known from the beginning
    edge = jnp.zeros((count, count), bool).at[0].set(True).at[-1].set(True).at[:, 0].set(True).at[:, -1].set(True)
    # Optimism: what is unseen is taken for open, so that the way leads there and finds out.
    known = jnp.where(seen | edge, at.price[at.world], at.unseen)
    gx, gy = (column + 0.5 - (goal[:, 0] / cell)[:, None, None], row + 0.5 - (goal[:, 1] / cell)[:, None, None])
    arrival = None if at.arrival is None else at.arrival[:, None, None]
    known = known * jnp.exp2(tries.astype(known.dtype)) * at.detached(gx, gy, arrival)
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

    return Chart(seen, tries, jax.lax.scan(relax, chart.cost, length=CHART.sweeps)[0])


def way(chart: Chart, at: Errand) -> tuple[Any, Any, Any]:
    """The next nodes of the way, down the steepest descent of the cost.

    Returns:
      (env, 2) where to aim, the last node to which the straight line is no dearer than the way; (env, node, 2) the
      nodes of the way, both m from the rover; and (env,) the cost of the way, m of ground as it is on average.
    """
    count, cell, position, goal = at.count, at.cell, at.position, at.goal
    env, cell_position = jnp.arange(position.shape[0]), position / cell
    steps = jnp.asarray([(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1)])
    stride = cell * jnp.sqrt(jnp.sum(steps * steps, axis=-1).astype(position.dtype))
    share = jnp.linspace(0.0, 1.0, 2 * CHART.steps + 1)[1:, None, None]

    def price(points: Any) -> Any:
        node = jnp.clip(points.astype(jnp.int32), 0, count - 1)
        where = (env, node[..., 1], node[..., 0])
        known = jnp.where(chart.seen[where], at.price[at.world, where[1], where[2]], at.unseen)
        away = points - goal / cell
        off = at.detached(away[..., 0], away[..., 1], at.arrival)
        return known * jnp.exp2(chart.tries[where].astype(known.dtype)) * off

    node = jnp.clip(cell_position.astype(jnp.int32), 0, count - 1)
    here, here_price = cell_position, jnp.minimum(price(cell_position), CHART.dearest)
    aim, straight, nodes, paid = node + 0.5, jnp.ones(node.shape[0], bool), [], jnp.zeros(node.shape[0])
    left: Any = None
    for k in range(CHART.steps):
        near = jnp.clip(node + steps[:, None, :], 0, count - 1)
        cost = chart.cost[env, near[..., 1], near[..., 0]]
        # staying is best at the goal alone: a cost that is out of date must not hold the rover
        still = (steps == 0).all(-1)[:, None] & (cost > 0.0)
        total = jnp.where(still, jnp.inf, cost + stride[:, None] * here_price)
        best = jnp.argmin(total, axis=0)
        if left is None:
            left = jnp.min(total, axis=0)
        node = jnp.take_along_axis(near, best[None, :, None], axis=0)[0]
        before, here = (here, here_price), node + 0.5
        # capped: a rover that stands on blocked ground has a way, too
        here_price = jnp.minimum(price(here), CHART.dearest)
        paid = paid + 0.5 * (before[1] + here_price) * _length(here - before[0])
        line = price(cell_position + share * (here - cell_position)).mean(axis=0) * _length(here - cell_position)
        # The first node always counts, or a rover off the way would have no aim.
        straight = straight & ((line <= CHART.bend * paid) | (k == 0))
        aim = jnp.where(straight[:, None], here, aim)
        nodes.append(here * cell)
    close = _length(goal - position) < 2.0 * cell
    # but not from the side on which its heading cannot be met
    away = cell_position - goal / cell
    close = close & (at.detached(away[:, 0], away[:, 1], at.arrival) == 1.0)
    aim = jnp.where(close[:, None], goal, aim * cell) - position
    return aim, jnp.stack(nodes, axis=1) - position[:, None], jnp.minimum(left / at.unseen, 1e3)


def _length(vector: Any) -> Any:
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1))


def straight(at: Errand) -> tuple[Any, Any, Any]:
    """Where to aim, nodes and distance as `way` returns them, for a rover without a chart: straight to the goal."""
    away = at.goal - at.position
    far = _length(away)[:, None]
    reach = jnp.minimum(at.cell * jnp.arange(1, CHART.steps + 1), far)
    nodes = away[:, None] / jnp.maximum(far, 1e-3)[..., None] * reach[..., None]
    return nodes[:, -1], nodes, far[:, 0]
