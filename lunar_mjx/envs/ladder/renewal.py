"""Worlds of a pool that are made anew while rovers drive: never one in which an episode is under way or prepared."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.envs.ladder.chart import coarse_prices
from lunar_mjx.envs.ladder.ground import World
from lunar_mjx.envs.ladder.pool import Places, Pool, maker, pairs
from lunar_mjx.envs.ladder.rungs import Rung
from lunar_mjx.errors import bad_input
from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.rocks import Rocks

_TRIES = 20
"""Worlds that are made for a slot until one has a way as the rung asks; of 64 worlds of rung 3 each had one."""


def begins(worlds: Any, is_open: Any) -> Any:
    """(place,) how many of the places up to each lie in open worlds; `worlds` (place,), `is_open` (world,)."""
    return jnp.cumsum(jnp.asarray(is_open)[worlds].astype(jnp.int32))


def pick(begins: Any, share: Any) -> Any:
    """Numbers of places in open worlds, each as likely; `begins` from `begins`, `share` in [0, 1)."""
    count = begins[-1]
    return jnp.searchsorted(begins, jnp.minimum((share * count).astype(jnp.int32), count - 1), side="right")


def worlds_in_use(worlds: Any, count: int, place: Any, prepared: Any, taken: Any) -> np.ndarray:
    """(world,) whether episodes are under way or prepared there.

    Args:
      worlds: (place,) number of each place's world. count: of worlds. place, prepared: (env,) places of episodes under
        way and of the next ones. taken: (env,) whether the next one has begun already.
    """
    # on the host: rovers may lie on several devices, and these are three numbers of each
    worlds, place, prepared, taken = (np.asarray(a) for a in jax.device_get((worlds, place, prepared, taken)))
    used = np.zeros(count, bool)
    used[worlds[place]] = True
    used[worlds[prepared[~taken]]] = True
    return used


@functools.partial(jax.jit, static_argnames=("across",))
def with_world(terrain: Terrain, world: World, slot: Any, middle: Any, across: int) -> Terrain:
    """The map of a pool with another world in a slot; shapes stay.

    Args:
      terrain: of the pool. world: without a leading axis. slot: its number. middle: (2,) of it on the map, m.
      across: worlds side by side in a row of the map.
    """
    row, column = slot // across, slot % across
    rocks = terrain.rocks
    assert rocks is not None
    each, none = world.radii.shape[0], rocks.radii.shape[0] - 1

    def tile(grid: Any, part: Any) -> Any:
        high, wide = part.shape
        return jax.lax.dynamic_update_slice(grid, part.astype(grid.dtype), (row * high, column * wide))

    centers = world.centers + jnp.pad(middle, (0, 1))
    index = jnp.where(world.index == each, none, world.index + slot * each)
    return dataclasses.replace(
        terrain,
        field=dataclasses.replace(terrain.field, heights=tile(terrain.field.heights, world.heights)),
        rocks=Rocks(
            jax.lax.dynamic_update_slice(rocks.centers, centers.astype(rocks.centers.dtype), (slot * each, 0)),
            jax.lax.dynamic_update_slice(rocks.radii, world.radii.astype(rocks.radii.dtype), (slot * each,)),
            tile(rocks.index, index),
            rocks.x0,
            rocks.y0,
            rocks.cell,
        ),
    )


class Renewal:
    """Which worlds of a training's pool are open, and how often each was made anew.

    Half of the worlds are open: episodes begin there. The other half is left by its rovers; a world without any is made
    anew and opened, and the oldest open one is closed. Worlds depend on seed, slot and generation alone.

    Args:
      rung: for this rover (`Rung.scaled`). seed: of the pool. worlds: how many. half_width, hardness, levels: as of
        `make_pool`.

    Raises:
      UserError: fewer than two worlds.
    """

    def __init__(self, rung: Rung, seed: int, worlds: int, half_width: float, hardness: float, levels: int):
        if worlds < 2:
            raise bad_input("navigation", "worlds", worlds, "cannot be renewed while rovers drive", "give at least 2")
        self.rung, self.seed, self.hardness = rung, seed, hardness
        self.generation = np.zeros(worlds, int)
        # By age: the order in which open worlds will be closed.
        self.order = list(range(worlds // 2, worlds))
        self._make = maker(rung, 1, half_width, levels)

    @property
    def is_open(self) -> np.ndarray:
        """(world,) where episodes begin."""
        return np.isin(np.arange(len(self.generation)), self.order)

    def notes(self) -> dict[str, Any]:
        """What `restore` needs, for a checkpoint."""
        return {"generation": self.generation.tolist(), "order": [int(i) for i in self.order]}

    def restore(self, pool: Pool, notes: dict[str, Any]) -> Pool:
        """The pool, as first made, with the worlds that stood at a checkpoint."""
        self.generation, self.order = np.array(notes["generation"]), list(notes["order"])
        for slot in np.flatnonzero(self.generation):
            made = self._world(int(slot), int(self.generation[slot]))
            assert made is not None
            pool = self._put(pool, int(slot), *made)
        return pool

    def __call__(self, pool: Pool, in_use: np.ndarray) -> Pool | None:
        """The pool with every closed world that is not in use made anew; None where there is none."""
        empty = [int(slot) for slot in np.flatnonzero(~self.is_open & ~in_use)]
        for slot in empty:
            made = None
            for _ in range(_TRIES):
                self.generation[slot] += 1
                made = self._world(slot, int(self.generation[slot]))
                if made is not None:
                    break
            if made is None:
                raise bad_input("ladder", "hardness", self.hardness, "leaves worlds without ways", "lower it")
            pool = self._put(pool, slot, *made)
            self.order = [*self.order[1:], slot]
        return pool if empty else None

    def _world(self, slot: int, generation: int) -> Any:
        """A world with its goals and ground; None if no goal can be driven to."""
        key = jax.random.fold_in(jax.random.fold_in(jax.random.PRNGKey(self.seed), slot), generation)
        made = self._make(key, jnp.float32(self.hardness))
        return made if np.asarray(made[1]["valid"]).any() else None

    def _put(self, pool: Pool, slot: int, world: World, goals: dict[str, Any], clear: Any, slope: Any) -> Pool:
        across = int(np.ceil(np.sqrt(len(self.generation))))
        each = goals["valid"].shape[1]
        price = coarse_prices(np.asarray(clear)[0], np.asarray(slope)[0], self.rung.plan_cell)
        return dataclasses.replace(
            pool,
            terrain=with_world(pool.terrain, jax.tree.map(lambda a: a[0], world), slot, pool.middles[slot], across),
            places=self._places(pool, slot, goals),
            ways=pool.ways.at[slot * each : (slot + 1) * each].set(goals["way"][0]),
            prices=pool.prices.at[slot].set(jnp.asarray(price, pool.prices.dtype)),
        )

    def _places(self, pool: Pool, slot: int, goals: dict[str, Any]) -> Places:
        """The table of places with those of a slot's world anew; as many as it had."""
        rows = np.flatnonzero(np.asarray(pool.places.world) == slot)
        starts, each = goals["starts"].shape[2], goals["valid"].shape[1]
        way = np.resize(np.repeat(np.flatnonzero(np.asarray(goals["valid"])[0]), starts), len(rows))
        number = np.resize(np.arange(starts), len(rows))
        middle = np.repeat(np.asarray(pool.middles)[slot][None], len(rows), axis=0)
        draw = np.random.default_rng([self.seed, 17, slot, int(self.generation[slot])])
        new = pairs(goals, way, number, np.full(len(rows), slot), middle, draw)
        new = dataclasses.replace(new, way=new.way + slot * each)
        return jax.tree.map(lambda old, now: old.at[rows].set(now.astype(old.dtype)), pool.places, new)
