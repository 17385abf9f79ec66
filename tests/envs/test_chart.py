"""The map that a rover draws while it drives: what it has not seen is open ground, and no dead end holds it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.envs.ladder import chart as charts
from lunar_mjx.envs.ladder.chart import CHART, Chart, Errand, coarse_prices

begin, look, straight, way = (jax.jit(f) for f in (charts.begin, charts.look, charts.straight, charts.way))
COUNT, CELL = 40, 0.8
GOAL, START = jnp.asarray([[28.4, 16.4]]), jnp.asarray([[6.0, 16.4]])
WORLD = jnp.zeros(1, jnp.int32)
NONE = jnp.zeros(1)


def errand(price, here=START, **more):
    """From a place to the goal."""
    return Errand(price, WORLD, here, GOAL, CELL, **more)


def level(free: np.ndarray) -> np.ndarray:
    """Prices of level ground."""
    return coarse_prices(free, np.zeros(free.shape), CELL / CHART.coarse)


def yard() -> np.ndarray:
    """A yard that is open to the west between start and goal, on the planning grid: 8 m deep and 16 m wide."""
    free = np.ones((COUNT * CHART.coarse, COUNT * CHART.coarse), bool)
    free[20:60, 44:49] = False
    free[20:25, 26:49] = free[56:61, 26:49] = False
    return free


@pytest.fixture(scope="module")
def price():
    return jnp.asarray(level(yard())[None], jnp.float32)


def test_prices_are_dear_beside_what_is_blocked_and_in_gaps_but_a_quarter_of_a_node_blocks_nothing(price):
    grid = np.asarray(price[0])
    assert np.isinf(grid[20, 23]) and grid[2, 2] == 1.0 and 1.0 < grid[20, 21] <= 3.0
    free = np.ones((4, 4), bool)
    free[0, 0] = free[2, 2:] = False
    assert np.isinf(level(free)).sum() == 0
    # a quarter of it counts as dear as the steepest slope
    assert level(free)[0, 0] == pytest.approx(0.25 * (CHART.dearest + 9.0), abs=1.0)
    free[3, 2] = False
    assert np.isinf(level(free))[1, 1]


def test_who_has_seen_nothing_goes_straight(price):
    blank = begin(errand(price))
    assert float(blank.cost[0, 20, 35]) == 0.0 and not bool(blank.seen.any())
    aim, nodes, left = way(blank, errand(price))
    told, steps, far = straight(errand(price))
    np.testing.assert_allclose(aim, told, atol=CELL)
    np.testing.assert_allclose(nodes, steps, atol=CELL)
    np.testing.assert_allclose(left, far, atol=CELL)


def test_it_sees_ahead_and_not_behind(price):
    seen = np.asarray(look(begin(errand(price)), errand(price), NONE, NONE).seen[0])
    assert seen[20, 7 + CHART.reach - 2] and not seen[20, 7 + CHART.reach + 1]
    assert seen[20, 6] and not seen[20, 2] and not seen[35, 7]


def drive(price, here, steps, **more):
    """Who follows its way at once and exactly; its chart, its path and the costs of its way."""

    def step(carry, _):
        chart, here, yaw = carry
        at = errand(price, here, **more)
        chart = look(chart, at, yaw, NONE)
        aim, _, left = way(chart, at)
        yaw = jnp.arctan2(aim[:, 1], aim[:, 0])
        pace = jnp.minimum(0.2, jnp.sqrt(jnp.sum(aim * aim, axis=-1)))
        here = here + pace[:, None] * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
        return (chart, here, yaw), (here[0], left[0])

    first = begin(errand(price, here, **more)), here, NONE
    (chart, _, _), (path, left) = jax.jit(lambda c: jax.lax.scan(step, c, length=steps))(first)
    return chart, np.asarray(path), np.asarray(left)


def test_it_drives_out_of_a_dead_end_and_around_it(price):
    # in the yard already, and blind for what lies behind: the way out must be found
    chart, path, left = drive(price, jnp.asarray([[16.0, 16.4]]), 400)
    assert np.hypot(*(path[-1] - np.asarray(GOAL[0]))) < 0.3
    node = (path / CELL).astype(int)
    assert np.isfinite(np.asarray(price)[0, node[:, 1], node[:, 0]]).all()
    # the cost rises when the walls are seen, and then falls to nothing
    assert left[20:].max() > 1.5 * left[0] and left[-1] < CELL
    assert not bool(chart.seen.all())


def test_slopes_are_dear_but_do_not_block():
    clear, slope = np.ones((32, 32), bool), np.zeros((32, 32))
    # far away from the rest
    clear[:2] = False
    slope[16:20], slope[20:24], slope[24:] = np.tan(np.radians([6.0, 11.0, 40.0]))[:, None, None]
    found = coarse_prices(clear, slope, 0.4)[:, 0]
    # mean of the times up and down where the speed falls evenly to nothing at 12 deg
    assert found[7] == 1.0 and found[8] == pytest.approx(0.5 * (1 / 0.5 + 1 / 1.5))
    assert found[8] < found[10] < found[12] == CHART.dearest


def test_a_steep_way_is_gone_around(price):
    steep = np.ones((COUNT, COUNT))
    steep[12:30, 18:24] = CHART.dearest
    _, path, _ = drive(jnp.asarray(steep[None], jnp.float32), START, 200)
    node = (path / CELL).astype(int)
    assert np.hypot(*(path[-1] - np.asarray(GOAL[0]))) < 0.3
    driven = steep[node[:, 1], node[:, 0]]
    # a corner may be clipped
    assert (driven > 1.0).mean() < 0.03


def test_what_was_tried_in_vain_becomes_dearer_with_every_try():
    flat = jnp.ones((1, COUNT, COUNT))
    at, chart, left = errand(flat), begin(errand(flat)), []
    for vain in (0.0, 1.0, 1.0, 1.0, 1.0):
        chart = look(chart, at, NONE, jnp.asarray([vain]))
        # so many sweeps that the cost settles
        for _ in range(20):
            chart = look(chart, at, NONE, NONE)
        aim, _, cost = way(chart, at)
        left.append(float(cost[0]))
    assert (np.diff(left) > 0.0).all() and int(chart.tries.max()) == 4
    # ahead, not behind, and after some tries the way leads around the place
    assert int(chart.tries[0, 20, 8]) == 4 and int(chart.tries[0, 20, 6]) == 0
    assert abs(float(aim[0, 1])) > 0.5 * CELL
    back = look(chart, at, NONE, -jnp.ones(1)).tries
    assert int(back[0, 20, 6]) == 1 and int(back[0, 20, 8]) == 4
    for _ in range(2 * CHART.most_tries):
        chart = look(chart, at, NONE, jnp.ones(1))
    assert int(chart.tries.max()) == CHART.most_tries


@pytest.mark.parametrize("arrival", np.radians([0.0, 90.0, 180.0, -90.0]))
def test_it_arrives_in_the_heading_asked_for(arrival):
    flat, within = jnp.ones((1, COUNT, COUNT)), np.pi / 4
    _, path, _ = drive(flat, START, 250, arrival=jnp.asarray([arrival]), within=within)
    far = np.hypot(*(path - np.asarray(GOAL[0])).T)
    # the first time that it is there it heads as asked: no luck is needed
    first = int(np.argmax(far < 0.5))
    step = path[first] - path[first - 1]
    assert far.min() < 0.5
    assert np.cos(np.arctan2(step[1], step[0]) - arrival) > np.cos(within)


def test_it_never_uses_what_it_has_not_seen(price):
    here, yaw = jnp.asarray([[2.0, 2.0]]), jnp.asarray([np.pi])
    open_ground = jnp.where(jnp.isinf(price), 1.0, 1.0)
    found = [look(begin(at), at, yaw, NONE) for at in (errand(price, here), errand(open_ground, here))]
    np.testing.assert_array_equal(found[0].cost, found[1].cost)
    assert isinstance(found[0], Chart)
