"""Drives along the best way of one who knows the map: a row to hold learnt agents against, and a proof that rovers get
through."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.envs.ladder.chart import prices
from lunar_mjx.envs.ladder.pool import Pool
from lunar_mjx.envs.ladder.ways import distances


@dataclasses.dataclass(frozen=True)
class Following:
    """How the follower keeps to its way."""

    ahead: int = 4
    """Nodes along the way that it aims at, at most; fewer where the straight line there is blocked."""
    patience: float = 3.0
    """s without progress after which it backs off, and after as long again drives on."""


FOLLOWING = Following()


def costs(pool: Pool) -> Any:
    """(goal, row, column) cost of the cheapest way to each goal of a pool, like `Pool.ways` in m of open ground."""
    ways = np.asarray(pool.ways)
    cell = float(pool.size) / ways.shape[-1]
    goals = [np.unravel_index(int(np.argmin(way)), way.shape) for way in ways]

    @jax.jit
    def one(args: Any) -> Any:
        way, price, row, column = args
        return distances(jnp.isfinite(way), row, column, cell, price)

    price = jnp.asarray(np.stack([prices(np.isfinite(way), cell) for way in ways]), jnp.float32)
    rows, columns = (jnp.asarray(a) for a in np.array(goals).T)
    return jax.lax.map(one, (jnp.asarray(ways), price, rows, columns))


def toward(turn: Any, waited: Any, leaving: Any = False) -> tuple[Any, Any]:
    """Speed as a share of the top speed, and steering angle in rad, each (env,).

    Args:
      turn: to the place aimed at from the heading, rad. waited: s without progress.
      leaving: whether to go on backwards.
    """
    phase = jnp.floor(waited / FOLLOWING.patience).astype(jnp.int32)
    backing = jnp.where(phase == 0, leaving | (jnp.abs(turn) > 1.9), phase % 2 == 1)
    forward = jnp.where(jnp.abs(turn) > 0.6, 0.6, 1.0)
    # backwards, the wheels turned away bring the nose round
    return jnp.where(backing, -0.7, forward), jnp.where(backing, -1.5, 1.5) * jnp.clip(turn, -1.0, 1.0)


class Follower:
    """Follows the steepest descent of the cost to the goal.

    Args:
      pool: the worlds.
    """

    def __init__(self, pool: Pool):
        self.pool, self.costs = pool, costs(pool)
        self.count = self.costs.shape[-1]
        self.cell = pool.size / self.count

    def _free(self, way: Any, points: Any) -> Any:
        """Whether points (..., env, 2), in nodes, lie on free ones."""
        node = jnp.clip(points.astype(jnp.int32), 0, self.count - 1)
        return jnp.isfinite(self.costs[way, node[..., 1], node[..., 0]])

    def aim(self, inner: Any) -> tuple[Any, Any]:
        """Where to drive next, (env, 2) in m from the rover, and whether it stands off the free nodes, (env,)."""
        pool, count = self.pool, self.count
        way, world = pool.places.way[inner.place], pool.places.world[inner.place]
        position = inner.physics.qpos[:, :2]
        corner = pool.middles[world] - 0.5 * pool.size
        cell_position = (position - corner) / self.cell
        node = jnp.clip(cell_position.astype(jnp.int32), 0, count - 1)
        steps = jnp.asarray([(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1)])
        aim = node + 0.5
        seen = jnp.ones(node.shape[0], bool)
        share = jnp.linspace(0.0, 1.0, 2 * FOLLOWING.ahead + 1)[1:, None, None]
        for k in range(FOLLOWING.ahead):
            # off the free nodes every node of the neighbourhood is tried, two cells wide
            near = jnp.clip(node + (2 if k == 0 else 1) * steps[:, None, :], 0, count - 1)
            best = jnp.argmin(self.costs[way, near[..., 1], near[..., 0]], axis=0)
            node = jnp.take_along_axis(near, best[None, :, None], axis=0)[0]
            # The straight line is sampled twice a node: it may cut a corner that the way goes around.
            clear = self._free(way, cell_position + share * (node + 0.5 - cell_position)).all(axis=0)
            # The first node always counts, or a rover off the way would have no aim.
            seen = seen & (clear | (k == 0))
            aim = jnp.where(seen[:, None], node + 0.5, aim)
        target = aim * self.cell + corner
        # Within two cells the grid is coarser than the goal.
        close = jnp.sum((inner.goal - position) ** 2, axis=-1) < (2.0 * self.cell) ** 2
        return jnp.where(close[:, None], inner.goal, target) - position, ~self._free(way, cell_position)

    def command(self, inner: Any) -> tuple[Any, Any]:
        """Speed as a share of the top speed, and steering angle in rad, each (env,)."""
        to, beside = self.aim(inner)
        w, x, y, z = (inner.physics.qpos[:, k] for k in (3, 4, 5, 6))
        yaw = jnp.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
        turn = jnp.arctan2(to[:, 1], to[:, 0]) - yaw
        # Wrapped: 350 deg to the left are 10 to the right.
        turn = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
        # what it hangs on it must leave by more than the step that ends the waiting
        return toward(turn, inner.waited, beside & (inner.last_action[:, 0] < 0.0))
