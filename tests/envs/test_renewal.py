"""Worlds made anew while rovers drive: never under a rover, with ways and levels of their own, the same if resumed."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.configs import get_training, override
from lunar_mjx.agents.learner import Learner
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import make_navigation
from lunar_mjx.envs.ladder.pool import make_pool, maker, way_left
from lunar_mjx.envs.ladder.renewal import Renewal, begins, pick, with_world, worlds_in_use
from lunar_mjx.envs.ladder.rungs import RUNGS, get_rung
from lunar_mjx.errors import UserError

pytestmark = pytest.mark.slow

SMALL = dataclasses.replace(get_rung(3), size=40.0, goal_distance=(8.0, 20.0), detour=1.1)
WORLDS, LEVELS, HALF = 4, 4, 0.4


@pytest.fixture(scope="module")
def pool():
    return make_pool(SMALL, 0, WORLDS, HALF, levels=LEVELS)


def _renewal():
    return Renewal(SMALL, 0, WORLDS, HALF, 1.0, LEVELS)


def _tiles(pool):
    """Heights of each world."""
    heights = np.asarray(pool.terrain.field.heights)
    half = heights.shape[0] // 2
    return [heights[r * half : (r + 1) * half, c * half : (c + 1) * half] for r in range(2) for c in range(2)]


def test_a_world_put_into_its_slot_is_as_a_pool_of_such_worlds_has_it(pool):
    other = make_pool(SMALL, 1, WORLDS, HALF, levels=LEVELS)
    worlds = maker(SMALL, WORLDS, HALF, LEVELS)(jax.random.PRNGKey(1), jnp.float32(1.0))[0]
    terrain = pool.terrain
    for slot in range(WORLDS):
        one = jax.tree.map(lambda a, i=slot: a[i], worlds)
        terrain = with_world(terrain, one, slot, pool.middles[slot], 2)
    jax.tree.map(np.testing.assert_array_equal, terrain, other.terrain)


def test_worlds_without_rovers_are_renewed_and_the_others_stay(pool):
    renewal = _renewal()
    before, was_open = _tiles(pool), renewal.is_open
    assert was_open.sum() == WORLDS // 2
    closed = np.flatnonzero(~was_open)
    # a rover is under way in one of the closed worlds
    busy = np.arange(WORLDS) == closed[0]
    new = renewal(pool, busy)
    assert new is not None
    for slot, (old, now) in enumerate(zip(before, _tiles(new), strict=True)):
        assert (np.abs(old - now).max() > 0.0) == (slot == closed[1]), slot
    # one is opened, the oldest closed
    assert renewal.is_open[closed[1]] and renewal.is_open.sum() == WORLDS // 2
    assert jax.tree.map(jnp.shape, new) == jax.tree.map(jnp.shape, pool)
    assert jax.tree.map(lambda a: a.dtype, new) == jax.tree.map(lambda a: a.dtype, pool)
    # nothing to do while all closed worlds are in use
    assert renewal(new, ~renewal.is_open) is None


def test_a_new_world_has_ways_of_its_own_on_every_level_of_the_curriculum(pool):
    new = _renewal()(pool, np.zeros(WORLDS, bool))
    at, place = new.places, np.arange(len(new.places.way))
    fresh = np.abs(np.asarray(at.starts) - np.asarray(pool.places.starts)).max(1) > 0.0
    assert set(np.asarray(at.world)[fresh]) == {0, 1}
    for level in range(LEVELS):
        left, known = way_left(new, jnp.asarray(place), at.nearer[:, level])
        assert np.asarray(known).all()
        np.testing.assert_allclose(left, at.nearer_shortest[:, level], rtol=1e-4, atol=1e-3)
    inside = np.abs(np.asarray(at.starts - new.middles[at.world])) < 0.5 * SMALL.size
    assert inside.all()


def test_worlds_depend_on_seed_slot_and_generation_alone(pool):
    one, none = _renewal(), np.zeros(WORLDS, bool)
    first = one(pool, none)
    second = one(first, none)
    assert one.generation.tolist() == [1, 1, 1, 1]
    other = _renewal()
    restored = other.restore(pool, one.notes())
    jax.tree.map(np.testing.assert_array_equal, restored.terrain, second.terrain)
    jax.tree.map(np.testing.assert_array_equal, restored.places, second.places)
    assert other.order == one.order


def test_episodes_begin_in_open_worlds_alone_each_place_as_often():
    worlds, is_open = jnp.array([0, 1, 1, 2, 0, 3]), jnp.array([True, False, True, False])
    total = begins(worlds, is_open)
    picked = np.asarray(pick(total, jnp.linspace(0.0, 0.9999999, 3000)))
    assert dict(zip(*np.unique(picked, return_counts=True), strict=True)) == {0: 1000, 3: 1000, 4: 1000}


def test_worlds_in_use_are_those_of_episodes_and_of_prepared_ones():
    used = worlds_in_use(jnp.arange(4), 4, jnp.array([1, 1]), jnp.array([2, 3]), jnp.array([False, True]))
    assert used.tolist() == [False, True, True, False]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"task": "large", "terrain": "flat", "renew": True}, "ladder only"),
        ({"task": "ladder/1", "renew": 1}, "neither true nor false"),
    ],
)
def test_mistakes_are_told(settings, said):
    with pytest.raises(UserError, match=said):
        make_navigation(**settings)


def test_a_single_world_cannot_be_renewed():
    with pytest.raises(UserError, match="give at least 2"):
        Renewal(SMALL, 0, 1, HALF, 1.0, 0)


@pytest.mark.slow
def test_a_training_renews_its_worlds_with_a_curriculum_and_resumes_on_the_same(monkeypatch, tmp_path):
    monkeypatch.setitem(RUNGS, 3, SMALL)
    told = {"worlds": WORLDS, "decimation": 5, "episode_time": 0.02, "observations": ("goal_body", "plan")}
    env = make_navigation("ladder/3", curriculum_levels=LEVELS, renew=True, weights={"way": 1.0}, **told)
    small = {"envs": 8, "epoch_steps": 4, "actor_layers": "8", "critic_layers": "8", "unroll": 4, "minibatches": 1}
    learner = Learner(env, override(get_training("ladder-4"), **small, passes=1).train)
    first, seen = env.params, []

    def look(_, state, row):
        inner, worlds = state.env.inner, np.asarray(env.params.pool.places.world)
        seen.append((worlds[np.asarray(inner.place)], np.asarray(env.params.system.terrain.field.heights)))
        # every rover stands on the ground that is now
        xy, height = np.asarray(inner.origin[:, :2]), np.asarray(inner.origin[:, 2])
        np.testing.assert_allclose(height - env.model.rover.standing_height, _ground(env.params, xy), atol=0.3)
        return {}

    whole = train(learner, RunConfig(160, quiet=True), callback=look)
    assert len(whole.rows) == 5
    changes = [np.abs(a[1] - b[1]).max() > 0.0 for a, b in itertools.pairwise(seen)]
    assert any(changes)
    assert np.abs(seen[-1][1] - np.asarray(first.system.terrain.field.heights)).max() > 0.0
    train(learner, RunConfig(96, quiet=True), tmp_path)
    resumed = train(learner, RunConfig(160, quiet=True), tmp_path)
    names = ("curriculum_level", "reward_way")
    assert [[r[n] for n in names] for r in whole.rows] == [[r[n] for n in names] for r in resumed.rows]
    np.testing.assert_array_equal(seen[-1][1], np.asarray(env.params.system.terrain.field.heights))


def _ground(params, xy):
    from lunar_mjx.terrain import sample

    return np.asarray(sample(params.system.terrain.field, jnp.asarray(xy[:, 0]), jnp.asarray(xy[:, 1]))[0])
