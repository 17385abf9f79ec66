"""The map that a rover draws while it drives: what it has not seen is open ground, and no dead end holds it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.envs.ladder.chart import CHART, Chart, begin, coarse_prices, look, straight, way

COUNT, CELL = 40, 0.8
GOAL, START = jnp.asarray([[28.4, 16.4]]), jnp.asarray([[6.0, 16.4]])
WORLD = jnp.zeros(1, jnp.int32)


def yard() -> np.ndarray:
    """A yard that is open to the west between start and goal, on the planning grid: 8 m deep and 16 m wide."""
    free = np.ones((COUNT * CHART.coarse, COUNT * CHART.coarse), bool)
    free[20:60, 44:49] = False
    free[20:25, 26:49] = free[56:61, 26:49] = False
    return free


@pytest.fixture(scope="module")
def price():
    return jnp.asarray(coarse_prices(yard(), CELL / CHART.coarse)[None], jnp.float32)


def test_prices_are_dear_beside_what_is_blocked_and_a_quarter_of_a_node_blocks_nothing(price):
    grid = np.asarray(price[0])
    assert np.isinf(grid[20, 23]) and grid[2, 2] == 1.0 and 1.0 < grid[20, 21] <= 3.0
    free = np.ones((4, 4), bool)
    free[0, 0] = free[2, 2:] = False
    assert np.isinf(coarse_prices(free, 0.4)).sum() == 0
    free[3, 2] = False
    assert np.isinf(coarse_prices(free, 0.4))[1, 1]


def test_who_has_seen_nothing_goes_straight(price):
    blank = begin(COUNT, GOAL, CELL)
    assert float(blank.cost[0, 20, 35]) == 0.0 and not bool(blank.seen.any())
    aim, nodes, left = way(blank, price, WORLD, START, GOAL, CELL)
    told, steps, far = straight(START, GOAL, CELL)
    np.testing.assert_allclose(aim, told, atol=CELL)
    np.testing.assert_allclose(nodes, steps, atol=CELL)
    np.testing.assert_allclose(left, far, atol=CELL)


def test_it_sees_ahead_and_not_behind(price):
    seen = np.asarray(look(begin(COUNT, GOAL, CELL), price, WORLD, START, jnp.zeros(1), GOAL, CELL).seen[0])
    assert seen[20, 7 + CHART.reach - 2] and not seen[20, 7 + CHART.reach + 1]
    assert seen[20, 6] and not seen[20, 2] and not seen[35, 7]


def test_it_drives_out_of_a_dead_end_and_around_it(price):
    def step(carry, _):
        chart, here, yaw = carry
        chart = look(chart, price, WORLD, here, yaw, GOAL, CELL)
        aim, _, left = way(chart, price, WORLD, here, GOAL, CELL)
        yaw = jnp.arctan2(aim[:, 1], aim[:, 0])
        pace = jnp.minimum(0.2, jnp.sqrt(jnp.sum(aim * aim, axis=-1)))
        here = here + pace[:, None] * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
        return (chart, here, yaw), (here[0], left[0])

    # in the yard already, and blind for what lies behind: the way out must be found
    start = jnp.asarray([[16.0, 16.4]])
    first = begin(COUNT, GOAL, CELL), start, jnp.zeros(1)
    (chart, last, _), (path, left) = jax.jit(lambda c: jax.lax.scan(step, c, length=400))(first)
    assert float(jnp.hypot(*(last - GOAL)[0])) < 0.3
    node = (np.asarray(path) / CELL).astype(int)
    assert np.isfinite(np.asarray(price)[0, node[:, 1], node[:, 0]]).all()
    # the cost rises when the walls are seen, and then falls to nothing
    assert float(left[20:].max()) > 1.5 * float(left[0]) and float(left[-1]) < CELL
    assert not bool(chart.seen.all())


def test_it_never_uses_what_it_has_not_seen(price):
    here, yaw = jnp.asarray([[2.0, 2.0]]), jnp.asarray([np.pi])
    open_ground = jnp.where(jnp.isinf(price), 1.0, 1.0)
    found = [look(begin(COUNT, GOAL, CELL), p, WORLD, here, yaw, GOAL, CELL) for p in (price, open_ground)]
    np.testing.assert_array_equal(found[0].cost, found[1].cost)
    assert isinstance(found[0], Chart)
