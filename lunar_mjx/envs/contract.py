"""What every environment must keep, as a check for those of this package and for a user's own."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.envs.core import Environment, State, split_keys


def check_environment(env: Environment, envs: int = 8, steps: int = 10, seed: int = 0) -> State:
    """Drives an environment at random and checks the contract of `Environment` and `State`.

    Checked: shapes and types stay the same from reset to step; everything is finite; `obs` and `final_obs` differ only
    where an episode ended; nothing both terminates and is truncated; episodes are no longer than promised; the same
    keys give the same numbers; environments do not share their randomness.

    Args:
      env: to check. envs: how many at once. steps: to drive. seed: of keys and actions.

    Returns:
      The last state.

    Raises:
      AssertionError: says what is broken.
    """
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    key = jax.random.PRNGKey(seed)
    state = first = reset(env.params, split_keys(key, envs))
    _same(first, reset(env.params, split_keys(key, envs)), "reset gives other numbers for the same keys")
    assert envs == 1 or not bool((first.obs == first.obs[:1]).all()), "environments with other keys begin alike"
    age = np.zeros(envs, int)
    for i in range(steps):
        action = jax.random.uniform(jax.random.fold_in(key, i), (envs, env.action_size), minval=-1.0)
        before, state = state, step(env.params, state, action)
        if i == 0:
            _same(state, step(env.params, before, action), "step gives other numbers for the same state and action")
        _check_shapes(env, first, state, envs)
        _check_ends(state)
        age += 1
        assert (age <= env.episode_steps).all(), f"an episode is longer than episode_steps = {env.episode_steps}"
        length = np.asarray(state.metrics["episode_length"])[np.asarray(state.done)]
        assert (length == age[np.asarray(state.done)]).all(), "episode_length is not the number of steps"
        age[np.asarray(state.done)] = 0
    return state


def _check_shapes(env: Environment, first: State, state: State, envs: int) -> None:
    def shape(leaf: Any) -> tuple[Any, Any]:
        return jnp.shape(leaf), jnp.result_type(leaf)

    assert jax.tree.structure(first) == jax.tree.structure(state), "the state's structure changes from reset to step"
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(first), jax.tree.leaves(state), strict=True):
        assert shape(a) == shape(b), f"{jax.tree_util.keystr(path)} changes from {shape(a)} to {shape(b)}"
        assert shape(b)[0][:1] == (envs,), f"{jax.tree_util.keystr(path)} lacks the leading axis env"
    assert state.obs.shape == (envs, env.observation_size), "obs is not (env, observation_size)"
    assert state.privileged.shape == (envs, env.privileged_size), "privileged is not (env, privileged_size)"
    for name in ("obs", "final_obs", "privileged", "reward"):
        assert bool(jnp.isfinite(getattr(state, name)).all()), f"{name} is not finite"


def _check_ends(state: State) -> None:
    assert not bool((state.terminated & state.truncated).any()), "an episode both terminated and was truncated"
    going = ~np.asarray(state.done)
    for a, b in (("obs", "final_obs"), ("privileged", "final_privileged")):
        alone, batched = np.asarray(getattr(state, a)), np.asarray(getattr(state, b))
        assert (alone[going] == batched[going]).all(), f"{a} and {b} differ although the episode goes on"


def _same(a: Any, b: Any, complaint: str) -> None:
    equal = jax.tree.map(lambda x, y: bool((np.asarray(x) == np.asarray(y)).all()), a, b)
    assert all(jax.tree.leaves(equal)), complaint
