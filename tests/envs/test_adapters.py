"""Adapters on the physics-free environment: Gymnasium's batch, brax, Stable-Baselines3."""

from __future__ import annotations

import warnings

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from lunar_mjx.envs import PointEnv
from lunar_mjx.envs.brax_env import BraxEnv, wrap
from lunar_mjx.envs.gymnasium_env import POINT, SingleEnv
from lunar_mjx.errors import UserError


def test_one_environment_passes_gymnasiums_check():
    env = gym.make(POINT, episode_steps=6)
    check_env(env.unwrapped)
    obs, _ = env.reset(seed=3)
    for i in range(6):
        before = obs
        obs, reward, terminated, truncated, info = env.step(np.array([0.3, -0.2], np.float32))
        np.testing.assert_allclose(obs[:2], np.clip(before[:2] + np.array([0.03, -0.02]), -1.5, 1.5), atol=1e-6)
        assert truncated == (i == 5) and not terminated and np.isfinite(reward)
    assert info["episode_length"] == 6 and info["success"] == 0.0
    with pytest.raises(UserError, match="no rover to draw"):
        gym.make(POINT, render_mode="rgb_array")
    with pytest.raises(UserError, match="before the first reset"):
        SingleEnv(PointEnv()).step(np.zeros(2))


def test_a_batch_resets_in_the_same_step_and_keeps_final_observations():
    envs = gym.make_vec(POINT, num_envs=3, episode_steps=4)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    obs, _ = envs.reset(seed=5)
    again, _ = gym.make_vec(POINT, num_envs=3, episode_steps=4).reset(seed=5)
    np.testing.assert_array_equal(obs, again)
    assert obs in envs.observation_space and len(np.unique(obs[:, 0])) == 3
    action = np.full((3, 2), 0.5, np.float32)
    assert action in envs.action_space
    for i in range(4):
        before = obs
        obs, reward, terminated, truncated, infos = envs.step(action)
        moved = np.clip(before[:, :2] + 0.05, -1.5, 1.5)
        if i < 3:
            np.testing.assert_allclose(obs[:, :2], moved, atol=1e-6)
            assert "final_obs" not in infos
    done = terminated | truncated
    assert done.all() and infos["_final_obs"].all() and infos["final_info"]["episode_length"].tolist() == [4] * 3
    np.testing.assert_allclose(np.stack(infos["final_obs"])[:, :2], moved, atol=1e-6)
    assert (np.abs(obs[:, :2] - moved).max(axis=1) > 1e-3).all(), "the next episode has begun"
    assert reward.shape == (3,)
    with pytest.raises(UserError, match="num_envs"):
        gym.make_vec(POINT, num_envs=0)


def test_gymnasiums_own_vectoriser_sees_the_same_episode():
    single = gym.vector.SyncVectorEnv([lambda: SingleEnv(PointEnv(4))] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    single.reset(seed=1)
    for _ in range(4):
        *_, infos = single.step(np.zeros((2, 2), np.float32))
    ours = gym.make_vec(POINT, num_envs=2, episode_steps=4)
    ours.reset(seed=1)
    for _ in range(4):
        *_, own = ours.step(np.zeros((2, 2), np.float32))
    assert set(infos) <= set(own) | {"final_info"}
    for name in ("final_obs", "_final_obs", "_final_info"):
        assert own[name].dtype == infos[name].dtype and own[name].shape == infos[name].shape
    assert set(infos["final_info"]) <= set(own["final_info"]) | {"goal_body", "_goal_body"}


def test_brax_sees_single_environments_that_its_wrappers_can_batch():
    from brax.envs.wrappers.training import wrap as brax_wrap

    env = brax_wrap(BraxEnv(PointEnv(5)), episode_length=5)
    keys = jax.random.split(jax.random.PRNGKey(0), 4)
    state, step = jax.jit(env.reset)(keys), jax.jit(env.step)
    first = state.obs
    for i in range(5):
        state = step(state, jnp.zeros((4, 2)))
        assert bool((state.done == (i == 4)).all()) and bool((state.info["truncation"] == (i == 4)).all())
    np.testing.assert_array_equal(state.obs, first)


def test_native_batches_for_brax():
    env = wrap(BraxEnv(PointEnv(5)), episode_length=5)
    state, step = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 4)), jax.jit(env.step)
    first, total = state.obs, 0.0
    for _ in range(5):
        state = step(state, jnp.full((4, 2), 0.1))
        total = total + state.reward
    assert bool(state.done.all()) and bool(state.info["truncation"].all())
    np.testing.assert_allclose(state.info["episode_metrics"]["sum_reward"], total, rtol=1e-5, atol=1e-5)
    assert state.info["steps"].tolist() == [5.0] * 4 and bool((state.obs != first).any(axis=1).all())
    state = step(state, jnp.zeros((4, 2)))
    assert state.info["steps"].tolist() == [1.0] * 4 and not bool(state.done.any())
    with pytest.raises(UserError, match="episode_length=5"):
        wrap(BraxEnv(PointEnv(5)), episode_length=7)


@pytest.mark.slow
def test_sb3_trains_on_both():
    pytest.importorskip("stable_baselines3")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from stable_baselines3 import DDPG, PPO, SAC, TD3

        from lunar_mjx.envs.sb3 import SB3VecEnv

        batch = SB3VecEnv(4, PointEnv(6))
        batch.seed(3)
        obs = batch.reset()
        assert obs.shape == (4, 4)
        for _ in range(6):
            before = obs
            obs, _, done, infos = batch.step(np.zeros((4, 2), np.float32))
        assert done.all() and all(i["TimeLimit.truncated"] and i["episode"]["l"] == 6 for i in infos)
        np.testing.assert_allclose([i["terminal_observation"] for i in infos], before, atol=1e-6)
        for algorithm in (TD3, DDPG, SAC):
            for env in (batch, SingleEnv(PointEnv(6))):
                agent = algorithm(
                    "MlpPolicy", env, learning_starts=8, batch_size=8, device="cpu", policy_kwargs={"net_arch": [8]}
                )
                agent.learn(24)
                assert agent.num_timesteps >= 24
        assert PPO("MlpPolicy", batch, n_steps=8, batch_size=16, n_epochs=1, device="cpu").learn(32)
