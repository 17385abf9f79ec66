"""Difficulty follows success: rovers that arrive begin farther off, those that fail nearer; tests are always whole."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.configs import get_training, override
from lunar_mjx.agents.learner import Learner
from lunar_mjx.agents.policy import policy_of
from lunar_mjx.agents.run import unseen_params
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import make_navigation, split_keys
from lunar_mjx.envs.ladder.pool import make_pool, way_left
from lunar_mjx.envs.ladder.rungs import RUNGS, get_rung
from lunar_mjx.errors import UserError

SMALL = dataclasses.replace(get_rung(3), size=40.0, goal_distance=(8.0, 20.0), detour=1.1)
LEVELS = 4


@pytest.mark.slow
def test_levels_begin_on_the_shortest_way_and_the_last_one_where_the_rung_does():
    pool, plain = (make_pool(SMALL, 0, 2, 0.4, levels=n) for n in (LEVELS, 0))
    at = pool.places
    assert plain.places.nearer is None
    np.testing.assert_array_equal(at.starts, plain.places.starts)
    np.testing.assert_allclose(at.nearer[:, -1], at.starts, atol=1e-5)
    np.testing.assert_allclose(at.nearer_shortest[:, -1], at.shortest, rtol=1e-6)
    # each start lies in free ground with as much of the way left as is told, about its share of the whole
    place = jnp.arange(len(at.way))
    for level in range(LEVELS):
        left, known = way_left(pool, place, at.nearer[:, level])
        assert np.asarray(known).all()
        np.testing.assert_allclose(left, at.nearer_shortest[:, level], rtol=1e-4, atol=1e-3)
        share = np.asarray(at.nearer_shortest[:, level] / at.shortest)
        assert np.median(np.abs(share - (level + 1) / LEVELS)) < 0.05


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"task": "large", "terrain": "flat", "curriculum_levels": 3}, "ladder only"),
        ({"task": "ladder/1", "curriculum_levels": -1}, "whole number"),
        ({"task": "ladder/1", "curriculum_levels": 2.5}, "whole number"),
        ({"task": "ladder/1", "curriculum_levels": 20}, r"within goal_radius = 0.5 m of the goal; give less than 20"),
    ],
)
def test_mistakes_are_told(settings, said):
    with pytest.raises(UserError, match=said):
        make_navigation(**settings)


@pytest.fixture
def env(monkeypatch):
    monkeypatch.setitem(RUNGS, 3, SMALL)
    # every episode ends with its first step: at the goal, or because time is up
    told = {"worlds": 1, "decimation": 5, "episode_time": 0.01, "observations": ("goal_body", "plan")}
    return make_navigation("ladder/3", curriculum_levels=LEVELS, weights={"way": 1.0}, **told)


def at_goal(state, arrived):
    """The state with some rovers where they are going."""
    inner = state.inner
    qpos = inner.physics.qpos.at[:, :2].set(jnp.where(arrived[:, None], inner.goal, inner.physics.qpos[:, :2]))
    inner = dataclasses.replace(inner, physics=dataclasses.replace(inner.physics, qpos=qpos))
    return dataclasses.replace(state, inner=inner)


@pytest.mark.slow
def test_levels_rise_with_success_and_fall_with_failure_within_bounds(env):
    count = 16
    state = jax.jit(env.reset)(env.params, split_keys(jax.random.PRNGKey(0), count))
    step = jax.jit(env.step)
    stand = jnp.zeros((count, env.action_size))
    level = np.asarray(state.inner.level)
    assert set(level) == set(range(LEVELS))
    at = env.params.pool.places
    np.testing.assert_allclose(state.inner.origin[:, :2], at.nearer[state.inner.place, level], atol=0.1)
    np.testing.assert_allclose(state.inner.left, at.nearer_shortest[state.inner.place, level], rtol=1e-6)
    arrived = jnp.arange(count) % 2 == 0
    shape = jax.tree.map(jnp.shape, state)
    for _ in range(3 * LEVELS):
        level = np.asarray(state.inner.level)
        shortest = np.asarray(at.nearer_shortest[state.inner.place, level])
        state = step(env.params, at_goal(state, arrived), stand)
        assert bool(state.done.all())
        np.testing.assert_array_equal(state.metrics["success"], arrived)
        # what was driven is told, and decides about the episodes that are prepared next
        np.testing.assert_array_equal(state.metrics["curriculum_level"], level + 1)
        np.testing.assert_allclose(state.metrics["shortest"], shortest, rtol=1e-6)
        np.testing.assert_array_equal(state.inner.next_level, np.clip(level + np.where(arrived, 1, -1), 0, LEVELS - 1))
    np.testing.assert_array_equal(state.inner.level, np.where(arrived, LEVELS - 1, 0))
    assert jax.tree.map(jnp.shape, state) == shape


@pytest.mark.slow
def test_unseen_episodes_are_always_on_the_last_level_in_the_same_program(env):
    step, stand = jax.jit(env.step), jnp.zeros((8, env.action_size))
    keys = split_keys(jax.random.PRNGKey(1), 8)
    trained = step(env.params, jax.jit(env.reset)(env.params, keys), stand)
    params = unseen_params(env, {"ranges": "unseen", "hardness": 1.1})
    state = jax.jit(env.reset)(params, keys)
    for _ in range(3):
        np.testing.assert_array_equal(state.inner.level, LEVELS - 1)
        start = params.starts[state.inner.place]
        np.testing.assert_allclose(state.inner.origin[:, :2], start, atol=0.1)
        # all of them fail
        state = step(params, state, stand)
    np.testing.assert_array_equal(state.inner.next_level, LEVELS - 1)
    assert jax.tree.map(jnp.shape, state) == jax.tree.map(jnp.shape, trained)
    assert step._cache_size() == 1


@pytest.mark.slow
def test_a_training_tells_its_mean_level_and_resumes_with_it(env, tmp_path):
    small = {"envs": 8, "epoch_steps": 4, "actor_layers": "8", "critic_layers": "8", "unroll": 4, "minibatches": 1}
    training = override(get_training("ladder-4"), **small, passes=1)
    learner = Learner(env, training.train)
    whole = train(learner, RunConfig(96, quiet=True))
    train(learner, RunConfig(64, quiet=True), tmp_path)
    resumed = train(learner, RunConfig(96, quiet=True), tmp_path)
    told = [row["curriculum_level"] for row in whole.rows]
    assert told == [row["curriculum_level"] for row in resumed.rows] and len(told) == 3
    # nobody arrives: all come down
    assert told[0] > told[-1] and told[-1] == pytest.approx(1.0, abs=0.3)
    environment = {"name": "navigation", "options": {"task": "ladder/3", "curriculum_levels": LEVELS}}
    policy = policy_of(learner, whole.state, environment, {})
    assert policy.environment["options"] == {"task": "ladder/3"}
