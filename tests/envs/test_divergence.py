"""States that no rover can be in end the episode, and enter no reward, observation or normaliser."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.envs import make_navigation, split_keys
from lunar_mjx.envs.navigation.env import PLAUSIBLE, bounded, plausible

ABSURD = {
    "at rest": (None, 0.0, True),
    "driving": (("qvel", 0), 1.0, True),
    "wheels spin": (("qvel", 8), 20.0, True),
    "high": (("qpos", 2), 1e20, False),
    "below": (("qpos", 2), -200.0, False),
    "fast": (("qvel", 0), 1000.0, False),
    "tumbling": (("qvel", 4), 1e5, False),
    "wheel mad": (("qvel", 8), -1e6, False),
    "joint away": (("qpos", 9), 1e9, False),
    "nan": (("qvel", 3), np.nan, False),
    "inf": (("qpos", 2), np.inf, False),
}


@pytest.mark.parametrize("name", ABSURD)
def test_what_no_rover_can_do_is_not_plausible(name):
    where, value, expected = ABSURD[name]
    state = {"qpos": np.zeros((3, 15)), "qvel": np.zeros((3, 14))}
    if where:
        state[where[0]][1, where[1]] = value
    found = plausible(jnp.asarray(state["qpos"]), jnp.asarray(state["qvel"]), jnp.array([-2.0, 3.0]))
    assert found.tolist() == [True, expected, True]


def test_values_are_bounded():
    assert PLAUSIBLE.most_value <= 1e4
    found = bounded(jnp.array([1.0, -1e30, 1e30, np.nan, np.inf, -np.inf]))
    np.testing.assert_array_equal(found, [1.0, -PLAUSIBLE.most_value, PLAUSIBLE.most_value, 0.0, 0.0, 0.0])


@pytest.mark.slow
def test_absurd_states_end_the_episode_within_bounds():
    env = make_navigation("large", terrain="flat", places=16, goal_distance=(4.0, 5.0), decimation=2)
    cases = [(w, v) for w, v, fine in ABSURD.values() if not fine]
    count = len(cases) + 1
    state = jax.jit(env.reset)(env.params, split_keys(jax.random.PRNGKey(0), count))
    physics = state.inner.physics
    qpos, qvel = np.array(physics.qpos), np.array(physics.qvel)
    for i, ((field, place), value) in enumerate(cases):
        (qpos if field == "qpos" else qvel)[i, place] = value
    physics = dataclasses.replace(physics, qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))
    inner = dataclasses.replace(state.inner, physics=physics)
    action = jnp.zeros((count, env.action_size))
    after = jax.jit(env.step)(env.params, dataclasses.replace(state, inner=inner), action)
    assert np.asarray(after.metrics["diverged"]).tolist() == [1.0] * len(cases) + [0.0]
    for values in (after.reward, after.obs, after.final_obs, after.privileged):
        assert np.isfinite(values).all() and np.abs(values).max() <= PLAUSIBLE.most_value
