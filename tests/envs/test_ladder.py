"""The ladder: worlds are as their rungs say and can be solved, and the task keeps its tally."""

from __future__ import annotations

import dataclasses

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.evaluate import score
from lunar_mjx.envs import TASKS, make_navigation, split_keys
from lunar_mjx.envs.contract import check_environment
from lunar_mjx.envs.gymnasium_env import NAVIGATION
from lunar_mjx.envs.ladder import chart
from lunar_mjx.envs.ladder.ground import make_world
from lunar_mjx.envs.ladder.pool import make_pool, way_left
from lunar_mjx.envs.ladder.rungs import RUNGS, get_rung
from lunar_mjx.envs.ladder.ways import WAY_LIMITS, distances
from lunar_mjx.envs.navigation import rewards
from lunar_mjx.envs.navigation.tally import METRICS, start, update
from lunar_mjx.errors import UserError
from lunar_mjx.terrain import nearest_rock
from tests.envs.independent_planner import Planner, length

pytestmark = pytest.mark.slow

HALF = 0.4
SMALL = dataclasses.replace(get_rung(3), size=40.0, goal_distance=(8.0, 20.0), detour=1.1)


@pytest.fixture(scope="module")
def pool():
    return make_pool(SMALL, 0, 5, HALF)


def test_rungs_grow_harder():
    rungs = list(RUNGS.values())
    # the top rung is harder by its length, battery and collisions: on harder ground no way is 200 m long
    for name, count in {"slope_deg": 4, "coverage": 4, "ridges": 4, "deepest": 4, "episode_time": 5}.items():
        values = [getattr(r, name) for r in rungs[:count]]
        assert values == sorted(values), name
    assert rungs[-1].goal_distance == (200.0, 500.0) and [r.battery for r in rungs] == [False] * 4 + [True]
    assert [r.collisions for r in rungs] == ["free", "cost", "cost", "cost", "end"]
    with pytest.raises(UserError, match="ladder/5"):
        get_rung(6)


@pytest.mark.parametrize("number", RUNGS)
@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_grids_of_a_rung_divide_its_world(number, factor):
    rung = get_rung(number).scaled(factor)
    for side in (rung.cell, rung.plan_cell, rung.lattice, rung.block, 0.25):
        assert rung.size / side == pytest.approx(round(rung.size / side)), side
    assert rung.plan_cell / rung.cell == pytest.approx(round(rung.plan_cell / rung.cell))
    assert 0.0 <= rung.presence <= 1.0 and rung.smallest < rung.largest < rung.lattice


def test_boulders_cover_what_the_rung_says_and_stay_apart(pool):
    rocks = pool.terrain.rocks
    radii, centers = np.asarray(rocks.radii), np.asarray(rocks.centers)
    real = radii > 0
    inner = 5 * (SMALL.size - 6.0) ** 2
    assert np.pi * (radii[real] ** 2).sum() / inner == pytest.approx(SMALL.coverage, rel=0.3)
    apart = np.hypot(*(centers[real, None, :2] - centers[None, real, :2]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    assert (apart - radii[real][:, None] - radii[real][None]).min() > 0.0
    # the look-up grid finds each boulder at its own centre
    x, y, _, radius = nearest_rock(rocks, centers[real, 0], centers[real, 1])
    np.testing.assert_allclose(np.stack([x, y], 1), centers[real, :2], atol=1e-5)
    np.testing.assert_allclose(radius, radii[real], atol=1e-6)


def test_worlds_join_and_the_ground_lies_under_its_boulders(pool):
    field, rocks = pool.terrain.field, pool.terrain.rocks
    heights, per = np.asarray(field.heights), round(SMALL.size / SMALL.cell)
    for k in range(per, heights.shape[0], per):
        assert np.abs(heights[k] - heights[k - 1]).max() < 0.05
    real = np.asarray(rocks.radii) > 0
    x, y, z = np.asarray(rocks.centers)[real].T
    column, row = (((c - float(c0)) / SMALL.cell + 0.5).astype(int) for c, c0 in ((x, field.x0), (y, field.y0)))
    np.testing.assert_allclose(z - heights[row, column], 0.2 * np.asarray(rocks.radii)[real], atol=0.05)


def test_places_are_as_far_apart_as_asked_and_an_independent_planner_solves_them(pool):
    at, middles = pool.places, np.asarray(pool.middles)
    starts, goals, world = (np.asarray(a) for a in (at.starts, at.goals, at.world))
    straight = np.hypot(*(goals - starts).T)
    assert straight.min() >= 8.0 - 1e-3 and straight.max() <= 20.0 + 1e-3
    assert (np.asarray(at.shortest) >= SMALL.detour * straight - 1e-3).all()
    for points in (starts, goals):
        assert (np.abs(points - middles[world]) < 0.5 * SMALL.size - 3.0).all()
    solved = total = 0
    for number in range(len(middles)):
        planner = Planner(pool.terrain, middles[number], SMALL.size, 0.9 * HALF, 1.1 * WAY_LIMITS.steepest, 0.25, 0.0)
        for way in np.unique(np.asarray(at.way)[world == number]):
            mine = np.asarray(at.way) == way
            found = planner.ways(goals[mine][0], starts[mine])
            total += len(found)
            solved += sum(f is not None for f in found)
            # on a finer grid with a little less room the shortest way is no longer than the told one
            for path, told, least in zip(found, np.asarray(at.shortest)[mine], straight[mine], strict=True):
                if path is not None:
                    assert least - 0.5 < length(path) < 1.05 * told + 0.5
    assert solved >= 0.98 * total


def test_distances_go_around_a_wall():
    free = np.ones((9, 9), bool)
    free[4, :8] = False
    way = np.asarray(distances(jnp.asarray(free), 0, 0, 1.0))
    assert way[0, 8] == pytest.approx(8.0) and np.isinf(way[4, 0])
    # along the upper row to the gap, diagonally through it, and back
    assert way[8, 0] == pytest.approx(4 * np.sqrt(2) + 4 + 4 * np.sqrt(2) + 4, rel=1e-5)


def test_the_way_left_is_that_of_the_nodes_and_straight_between_them(pool):
    place = jnp.arange(0, len(pool.places.way), 7)
    start, told = pool.places.starts[place], pool.places.shortest[place]
    left, known = way_left(pool, place, start)
    np.testing.assert_allclose(left, told, rtol=1e-5)
    assert np.asarray(known).all()
    # in the open around a goal it is the distance of a map whose ways bend by 45 deg, at most 8 % longer
    aside = jnp.asarray([0.23, -0.41])
    left, _ = way_left(pool, place, pool.places.goals[place] + aside)
    straight = float(jnp.hypot(*aside))
    assert np.mean((np.asarray(left) > 0.9 * straight) & (np.asarray(left) < 1.3 * straight)) > 0.9
    # boulders of ridges have no node that is free about them
    radii, rocks = np.asarray(pool.terrain.rocks.radii), np.asarray(pool.terrain.rocks.centers)
    middle = rocks[np.argmax(radii), :2]
    world = np.abs(np.asarray(pool.middles) - middle).max(1).argmin()
    place = np.flatnonzero(np.asarray(pool.places.world) == world)[:1]
    if len(place):
        assert not bool(way_left(pool, jnp.asarray(place), jnp.asarray(middle[None], jnp.float32))[1][0])


def test_hardness_makes_slopes_and_boulders_of_the_same_world():
    make = jax.jit(make_world, static_argnums=0)
    easy, hard = (make(SMALL, jax.random.PRNGKey(4), h) for h in (0.3, 1.0))
    assert np.asarray(easy.heights).std() < 0.5 * np.asarray(hard.heights).std()
    assert (np.asarray(easy.radii) > 0).sum() < 0.6 * (np.asarray(hard.radii) > 0).sum()


def test_a_collision_counts_when_it_begins_and_energy_never_flows_back():
    seen = start(2, jnp.float32)
    power, slip = jnp.array([[5.0, -3.0]] * 2), jnp.array([[0.2, -0.4]] * 2)
    for touching in ([True, False], [True, False], [False, False], [True, False]):
        seen = update(seen, jnp.ones(2), power, slip, jnp.array(touching), 0.1)
    np.testing.assert_allclose(seen.collisions, [2.0, 0.0])
    np.testing.assert_allclose(seen.energy, 4 * 5.0 * 0.1)
    np.testing.assert_allclose(seen.slip, 4 * 0.3)
    np.testing.assert_allclose(seen.travelled, 4.0)


def test_a_score_weighs_success_by_the_way():
    told = {
        "success": [1.0, 1.0, 0.0],
        "episode_return": [1.0, 1.0, 0.0],
        "episode_length": [10.0, 10.0, 10.0],
        "stuck": [0.0, 0.0, 1.0],
        "travelled": [20.0, 5.0, 15.0],
        "shortest": [10.0, 10.0, 10.0],
        "energy": [3600.0, 0.0, 0.0],
        "slip": [0.3, 0.3, 0.6],
        "collisions": [0.0, 0.0, 2.0],
    }
    found = score({k: np.array(v) for k, v in told.items()}, 0.1)
    assert found.spl == pytest.approx((0.5 + 1.0) / 3) and found.slip == pytest.approx(0.4)
    assert found.collisions_per_km == pytest.approx(50.0) and found.wh_per_km == pytest.approx(25.0)
    assert found.ends == pytest.approx({"success": 2 / 3, "stuck": 1 / 3, "time": 0.0})


def test_every_rung_is_a_task_and_a_gymnasium_id():
    assert NAVIGATION in gym.registry
    for number, rung in RUNGS.items():
        c = TASKS[f"ladder/{number}"]
        assert c.rung == number and c.tally and c.goal_distance == rung.goal_distance
        assert ("arrival" in c.observations) == (rung.arrival_deg < 180.0) == (c.arrive_within < np.pi)
        assert gym.spec(f"LunarMJX/Ladder{number}-v0").kwargs == {"task": f"ladder/{number}"}
        assert c.failure < 0.0 and set(c.weights) <= set(rewards.TERMS)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"task": "ladder/9"}, "ladder/5"),
        ({"task": "ladder/1", "terrain": "flat"}, "leave it out"),
        ({"task": "large", "terrain": "flat", "collisions": "end"}, "tally"),
        ({"task": "large", "terrain": "flat", "weights": {"energy": 1.0}}, "tally"),
        ({"task": "large", "terrain": "flat", "observations": ("arrival",)}, "ladder"),
        ({"task": "large", "terrain": "flat", "rung": 7}, "does not exist"),
        ({"task": "large", "terrain": "flat", "weights": {"way": 1.0}}, "ladder"),
    ],
)
def test_mistakes_are_told(settings, said):
    with pytest.raises(UserError, match=said):
        make_navigation(**settings)


@pytest.mark.slow
def test_a_rung_keeps_the_contract_and_collisions_end_episodes():
    told = {"observations": ("goal_body", "arrival"), "arrive_within": 0.5, "collisions": "end"}
    env = make_navigation("ladder/1", worlds=1, decimation=25, **told)
    state = check_environment(env, envs=4, steps=4)
    assert set(METRICS) <= set(state.metrics) and "collided" in state.metrics
    assert np.isfinite([np.asarray(state.metrics[m]) for m in METRICS]).all()
    # put rovers onto a boulder, onto free ground, and out of their world
    inner = env.reset(env.params, split_keys(jax.random.PRNGKey(1), 4)).inner
    rocks = env.params.system.terrain.rocks
    big = np.asarray(rocks.centers)[np.argmax(np.asarray(rocks.radii))]
    qpos = inner.physics.qpos.at[0, :3].set(jnp.asarray([big[0] + 0.3, big[1], big[2] + 1.0]))
    qpos = qpos.at[1, 0].set(39.5)
    moved = dataclasses.replace(inner, physics=dataclasses.replace(inner.physics, qpos=qpos))
    view = env._view(env.params, moved)
    touching = env._outline.touches(env.params.system.terrain, view)
    assert bool(touching[0]) and not bool(touching[2])
    ends = env._ends(env.params, moved, view, moved.goal - qpos[:, :2])
    assert bool(ends["off_terrain"][1]) and not bool(ends["off_terrain"][2])


@pytest.mark.slow
def test_what_was_tried_in_vain_lies_where_the_wheels_drove_and_not_the_first_joint(monkeypatch):
    env = make_navigation("ladder/1", worlds=1, decimation=25, action="joint_velocity", observations=("plan",))
    inner = env._fresh(env.params, split_keys(jax.random.PRNGKey(0), 2))
    almost = jnp.full(2, chart.CHART.patience - 0.5 * env.control_interval)
    inner = dataclasses.replace(inner, chart=env._blank(env.params, inner), waited=almost)
    wheels, joints = jnp.zeros((2, 4)), jnp.zeros((2, env.action_size))
    monkeypatch.setattr(env, "_drive", lambda params, inner, action: (inner.physics, (wheels, wheels, joints)))
    told, looking = [], chart.look
    monkeypatch.setattr(chart, "look", lambda *given: told.append(given[-1]) or looking(*given))
    asked = np.zeros((2, env.action_size), np.float32)
    # three wheels drive against the first
    asked[:, :4] = np.array([[0.8], [-0.8]]) * np.array([-0.5, 1.0, 1.0, 1.0])
    env._advance(env.params, inner, jnp.asarray(asked))
    assert np.asarray(told[0]).tolist() == [1.0, -1.0]


@pytest.mark.slow
def test_the_reward_of_the_way_adds_up_and_the_trail_follows():
    observations = ("goal_body", "height_scan", "far_scan", "trail", "border", "visited", "plan")
    env = make_navigation("ladder/3", worlds=1, decimation=25, observations=observations, weights={"way": 1.0})
    state = env.reset(env.params, split_keys(jax.random.PRNGKey(2), 3))
    first, begin, paid = state.inner.left, state.inner.origin[:, :2], 0.0
    np.testing.assert_allclose(state.obs[:, env.blocks["trail"]], 0.0, atol=1e-3)
    step = jax.jit(env.step)
    for _ in range(30):
        state = step(env.params, state, jnp.tile(jnp.asarray([1.0] + [0.0] * (env.action_size - 1)), (3, 1)))
        assert not bool(state.done.any())
        paid = paid + state.reward
    np.testing.assert_allclose(paid, first - state.inner.left, atol=1e-3)
    here = state.inner.physics.qpos[:, :2]
    gone = np.hypot(*(here - begin).T)
    back = np.asarray(state.obs[:, env.blocks["trail"]]).reshape(3, 2, 3)
    # the shortest memory lies nearest, all of them behind a rover that drives ahead, none beyond the beginning
    assert (back[:, 0] < 0.0).all() and (np.diff(back[:, 0], axis=1) < 0.0).all()
    assert (np.hypot(back[:, 0], back[:, 1]) <= gone[:, None] + 1e-3).all() and (gone > 0.05).all()
    assert env.blocks["far_scan"].stop - env.blocks["far_scan"].start == 143
    corners = env._view(env.params, state.inner).corners
    gap = np.concatenate([corners[:, 1] - here, here - corners[:, 0]], axis=1).min(1)
    seen = np.asarray(state.obs[:, env.blocks["border"]])
    # the shortest of four rays that cross at right angles is at most sqrt(2) times the distance
    assert ((10.0 * seen.min(1) >= np.minimum(gap, 10.0) - 1e-3) & (10.0 * seen.min(1) <= 1.42 * gap)).all()
    # one place so far, where the first step ended
    been = np.asarray(state.obs[:, env.blocks["visited"]]).reshape(3, 5, 5)
    np.testing.assert_allclose(been[:, 2, 2], np.exp(-0.125 * gone**2), atol=0.05)
    assert (been.reshape(3, -1).argmax(1) == 12).all()
    # the map is drawn from the first step on; its way costs no less than the straight line over open ground
    seen, plan = np.asarray(state.inner.chart.seen), np.asarray(state.obs[:, env.blocks["plan"]])
    assert (seen.sum((1, 2)) > 100).all() and not seen.all()
    straight = np.hypot(*(state.inner.goal - here).T)
    usual = float(env.params.pool.usual_price)
    assert usual > 1.0 and (50.0 * usual * plan[:, -1] > straight - 1.0).all()
    assert (np.hypot(plan[:, 0], plan[:, 1]) < 8.0).all()
    # an episode that ends leaves no map to the next one
    blank = env._restart(env.params, state.inner, dataclasses.replace(state, terminated=jnp.ones(3, bool))).inner.chart
    assert not np.asarray(blank.seen).any() and np.isfinite(np.asarray(blank.cost)).all()


@pytest.mark.slow
def test_the_top_rung_drives_on_a_battery_in_sun_and_shadow(monkeypatch):
    small = dataclasses.replace(get_rung(5), size=80.0, cell=0.4, goal_distance=(10.0, 40.0), worlds=1)
    monkeypatch.setitem(RUNGS, 5, small)
    env = make_navigation("ladder/5", decimation=25, observations=("goal_body", "power"))
    state = env.reset(env.params, split_keys(jax.random.PRNGKey(1), 4))
    charge, lit, *sun = np.asarray(state.obs[:, env.blocks["power"]]).T
    assert (charge > 0.4).all() and (charge < 2.6).all() and (lit >= 0.0).all() and (lit <= 1.0).all()
    np.testing.assert_allclose(np.hypot(*sun), 1.0, atol=1e-5)
    # where the relief rises above the Sun there is less light than in the open
    places = np.random.default_rng(0).uniform(-35.0, 35.0, (2000, 2))
    light = np.asarray(env.params.system.sun.light(0.0, *places.T).irradiance)
    assert 0.02 < (light < 100.0).mean() < 0.5 and light.max() > 1300.0
    # a battery that cuts the motors off ends the episode of its rover alone
    effects = state.inner.physics.effects
    flat = {**effects, "battery": {**effects["battery"], "flat": jnp.asarray([1.0, 0.0, 0.0, 0.0])}}
    empty = dataclasses.replace(state.inner, physics=dataclasses.replace(state.inner.physics, effects=flat))
    ends = env._ends(env.params, empty, env._view(env.params, empty), jnp.full((4, 2), 9.0))
    assert np.asarray(ends["drained"]).tolist() == [True, False, False, False]
    with pytest.raises(UserError, match="battery"):
        make_navigation("ladder/1", worlds=1, observations=("goal_body", "power"))
