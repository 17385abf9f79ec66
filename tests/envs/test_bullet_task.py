"""The task around another engine's physics, as the benchmark trains Stable-Baselines3 on PyBullet."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.envs import make
from lunar_mjx.envs.host_env import HostedEnv


@pytest.mark.slow
def test_pybullet_gives_the_same_observations_and_rewards():
    pytest.importorskip("pybullet")
    from lunar_mjx.backends.pybullet import PyBulletBackend

    options = {
        "task": "large",
        "randomise": (),
        "terrain": "flat",
        "goal_distance": (2.0, 4.0),
        "places": 64,
        "episode_time": 1.0,
    }
    bullet, own = HostedEnv(PyBulletBackend, **options), make("navigation", **options)
    obs, _ = bullet.reset(seed=3)
    state, step = bullet._state, jax.jit(own.step)
    np.testing.assert_array_equal(obs, state.obs[0])
    for k in range(10):
        action = np.array([1.0, 0.5, 0.0, 0.1 * k, 0.0, 0.0], np.float32)
        obs, reward, terminated, truncated, metrics = bullet.step(action)
        state = step(own.params, state, jnp.asarray(action)[None])
        np.testing.assert_allclose(obs, state.final_obs[0], atol=2e-3)
        assert reward == pytest.approx(float(state.reward[0]), abs=2e-3)
        assert truncated == (k == 9) and not terminated
    assert metrics["episode_length"] == 10.0 and np.hypot(*obs[:2]) > 0.0
