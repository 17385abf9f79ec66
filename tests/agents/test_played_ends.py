"""What a played episode says of its end, where the ladder has more ends than other tasks."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import pytest

from lunar_mjx.agents.play import play_episode
from lunar_mjx.envs import NavigationEnv
from lunar_mjx.envs.core import State


class _Physics(NamedTuple):
    qpos: Any


class _Inner(NamedTuple):
    goal: Any
    physics: _Physics


class _Short(NavigationEnv):
    """Episodes of one step that end in one way, without physics."""

    def __init__(self, end: str):
        self.end, self.episode_steps = end, 3

    def reset(self, params, keys):
        zero, no = jnp.zeros(1), jnp.zeros(1, bool)
        inner = _Inner(jnp.zeros((1, 2)), _Physics(jnp.zeros((1, 7))))
        return State(zero[:, None], zero[:, None], zero, no, no, zero, zero, {self.end: zero}, {}, inner)

    def step(self, params, state, action):
        one, yes = jnp.ones(1), jnp.ones(1, bool)
        return State(
            state.obs, state.privileged, one, yes, ~yes, one, one, {self.end: one, "reward_way": one}, {}, state.inner
        )


@pytest.mark.parametrize(
    ("end", "says"), [("collided", "struck a boulder"), ("drained", "battery empty"), ("stuck", "stuck")]
)
def test_the_end_is_told_by_its_name(end, says):
    episode = play_episode(_Short(end), None, lambda state, key: jnp.zeros((1, 1)))
    assert episode.end == says and len(episode.reward) == 1
