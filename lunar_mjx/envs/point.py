"""A physics-free environment: a point in the plane drives to a goal. For wrappers and trainers, solved in seconds."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from lunar_mjx.envs.core import State, where
from lunar_mjx.errors import bad_input
from lunar_mjx.pytree import pytree


@pytree
class PointState:
    """Position and goal, m; raw random key; steps and return of the episode."""

    position: Any
    goal: Any
    key: Any
    steps: Any
    total: Any


class PointEnv:
    """Reach a goal drawn in the square [-1, 1]^2 m, starting anywhere in it.

    Observation (4): position and goal, m. Action (2): velocity, in shares of 1 m/s, applied for 0.1 s; the point stays
    in the square [-1.5, 1.5]^2. Reward: 10 times the decrease of the distance, and 5 at the goal, which ends the
    episode within 0.1 m. Cut off after `episode_steps`. Privileged: the goal relative to the point (2).

    Args:
      episode_steps: most steps of an episode; at most 20 of them are needed.
      poison: reward becomes not a number after this many steps of an episode, to try guards; never if 0.
    """

    observation_size = 4
    privileged_size = 2
    action_size = 2
    control_interval = 0.1

    def __init__(self, episode_steps: int = 40, poison: int = 0):
        if isinstance(episode_steps, bool) or not isinstance(episode_steps, int):
            raise bad_input("PointEnv", "episode_steps", episode_steps, "is no whole number", "give at least one step")
        if episode_steps < 1:
            raise bad_input("PointEnv", "episode_steps", episode_steps, "is below 1", "give at least one step")
        self.episode_steps = episode_steps
        self.params = {"radius": jnp.asarray(0.1)}
        self._poison = poison

    def reset(self, params: Any, keys: Any) -> State:
        inner = self._fresh(keys)
        obs, privileged = self._observe(inner)
        zero, no = jnp.zeros(keys.shape[0]), jnp.zeros(keys.shape[0], bool)
        metrics: dict[str, Any] = {name: zero for name in ("episode_return", "episode_length", "success")}  # noqa: C420
        return State(obs, privileged, zero, no, no, obs, privileged, metrics, {"goal_body": privileged}, inner)

    def step(self, params: Any, state: State, action: Any) -> State:
        inner: PointState = state.inner
        before = jnp.linalg.norm(inner.goal - inner.position, axis=-1)
        moved = inner.position + self.control_interval * jnp.clip(action, -1.0, 1.0)
        position = jnp.clip(moved, -1.5, 1.5)
        distance = jnp.linalg.norm(inner.goal - position, axis=-1)
        success = distance < params["radius"]
        reward = 10.0 * (before - distance) + 5.0 * success
        steps = inner.steps + 1
        if self._poison:
            # For tests of guards against numbers that are not finite.
            reward = jnp.where(steps > self._poison, jnp.nan, reward)
        # Not both: a learner bootstraps from truncated states alone.
        truncated = ~success & (steps >= self.episode_steps)
        total = inner.total + reward
        ended = PointState(position, inner.goal, inner.key, steps, total)
        final_obs, final_privileged = self._observe(ended)
        done = success | truncated
        # Made for all and taken by few: cheap here, while a rover's reset is prepared.
        inner = where(done, self._fresh(inner.key), ended)
        obs, privileged = self._observe(inner)
        metrics = {
            "episode_return": total,
            "episode_length": steps.astype(total.dtype),
            "success": success.astype(total.dtype),
        }
        return State(
            obs,
            privileged,
            reward,
            success,
            truncated,
            final_obs,
            final_privileged,
            metrics,
            {"goal_body": privileged},
            inner,
        )

    def _fresh(self, keys: Any) -> PointState:
        split = jax.vmap(lambda k: jax.random.split(k, 3))(keys)
        place = jax.vmap(lambda k: jax.random.uniform(k, (2,), minval=-1.0, maxval=1.0))
        zero = jnp.zeros(keys.shape[0])
        return PointState(place(split[:, 1]), place(split[:, 2]), split[:, 0], zero.astype(jnp.int32), zero)

    def _observe(self, inner: PointState) -> tuple[Any, Any]:
        return jnp.concatenate([inner.position, inner.goal], axis=-1), inner.goal - inner.position
