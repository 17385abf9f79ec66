"""The ring against a list kept beside it: what is drawn, from where, and what never is."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.replay import ReplayBuffer, Transition
from lunar_mjx.errors import UserError

ENVS = 3


def step_at(t: int, ends: dict[tuple[int, int], str] | None = None) -> Transition:
    """Step t of every environment; every number says which environment and step it belongs to."""
    env = np.arange(ENVS)
    mark = (100.0 * env + t).astype(np.float32)
    kinds = [(ends or {}).get((int(e), t), "") for e in env]
    return Transition(
        obs=jnp.asarray(mark[:, None]),
        privileged=jnp.zeros((ENVS, 0)),
        action=jnp.asarray(mark[:, None] * 2),
        reward=jnp.asarray(mark),
        terminated=jnp.asarray([k == "terminated" for k in kinds]),
        truncated=jnp.asarray([k == "truncated" for k in kinds]),
        next_obs=jnp.asarray(mark[:, None] + 0.5),
        next_privileged=jnp.zeros((ENVS, 0)),
    )


def filled(buffer: ReplayBuffer, steps: int, ends=None):
    state = buffer.init(step_at(0))
    insert = jax.jit(buffer.insert)
    for t in range(steps):
        state = insert(state, step_at(t, ends))
    return state


@pytest.mark.parametrize("steps", [2, 5, 6, 13])
def test_draws_every_kept_step_and_no_other(steps):
    buffer = ReplayBuffer(5)
    batch = buffer.sample(filled(buffer, steps), jax.random.PRNGKey(0), 3000)
    kept = range(max(0, steps - 5), steps)
    marks, counts = np.unique(np.asarray(batch.obs), return_counts=True)
    assert set(marks.astype(int)) == {100 * e + t for e in range(ENVS) for t in kept}
    assert counts.min() > 0.6 * counts.mean(), "uniform"
    np.testing.assert_array_equal(batch.action[:, 0], 2 * batch.obs[:, 0])
    np.testing.assert_array_equal(batch.next_obs[:, 0], batch.obs[:, 0] + 0.5)
    np.testing.assert_allclose(batch.discount, 0.99)


@pytest.mark.parametrize("steps", [4, 7, 11])
def test_n_steps_never_cross_the_head_or_the_end_of_an_episode(steps):
    gamma, ends = 0.5, {(0, 2): "terminated", (1, 5): "truncated", (1, 9): "terminated", (2, 10): "truncated"}
    buffer = ReplayBuffer(7, n_step=3, gamma=gamma)
    batch = jax.device_get(buffer.sample(filled(buffer, steps, ends), jax.random.PRNGKey(1), 2000))
    seen = set()
    for obs, reward, discount, following in zip(
        batch.obs[:, 0], batch.reward, batch.discount, batch.next_obs[:, 0], strict=True
    ):
        env, t = divmod(int(obs), 100)
        seen.add((env, t))
        assert max(0, steps - 7) <= t <= steps - 3
        total, k, kind = 0.0, 0, ""
        while k < 3 and not kind:
            total += gamma**k * (100 * env + t + k)
            kind = ends.get((env, t + k), "")
            k += 1
        assert reward == pytest.approx(total)
        assert discount == pytest.approx(0.0 if kind == "terminated" else gamma**k)
        assert following == 100 * env + t + k - 1 + 0.5
    assert len(seen) == ENVS * (min(steps, 7) - 2)


def test_rewards_after_the_end_do_not_leak_even_if_not_a_number():
    buffer = ReplayBuffer(4, n_step=2)
    state = filled(buffer, 4, {(e, 1): "terminated" for e in range(ENVS)})
    storage = state.storage
    poisoned = storage.reward.at[:, 2].set(jnp.nan)
    state = type(state)(type(storage)(**{**vars(storage), "reward": poisoned}), state.head, state.filled)
    batch = buffer.sample(state, jax.random.PRNGKey(0), 500)
    at_end = np.asarray(batch.obs[:, 0]).astype(int) % 100 == 1
    assert np.isfinite(np.asarray(batch.reward)[at_end]).all()


def test_inserting_does_not_copy_a_donated_ring():
    buffer = ReplayBuffer(64)
    # head and filled are one array in an empty ring, which cannot be given up twice
    state = jax.tree.map(jnp.copy, buffer.init(step_at(0)))
    insert = jax.jit(buffer.insert, donate_argnums=0)
    where = state.storage.obs.unsafe_buffer_pointer()
    state = insert(state, step_at(0))
    assert state.storage.obs.unsafe_buffer_pointer() == where


def test_refuses_windows_longer_than_the_ring():
    with pytest.raises(UserError, match="n_step"):
        ReplayBuffer(2, n_step=3)
    with pytest.raises(UserError, match="gamma"):
        ReplayBuffer(2, gamma=1.5)
