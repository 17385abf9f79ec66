"""Replay buffer: a ring over time for every environment, `[env, time, feature]`, kept on the device.

The buffer is a frozen dataclass of pure functions and its contents a separate pytree, as in flashbax; the layout is
FastTD3's. Writing a step touches one slice of time and nothing else, so that a donated buffer is never copied.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from lunar_mjx.errors import bad_input
from lunar_mjx.pytree import pytree


@pytree
class Transition:
    """One step of every environment; when stored, with the axis `time` behind `env`.

    Attributes:
      obs, privileged: acted on. action: taken. reward: received.
      terminated: nothing follows. truncated: the episode was cut off here.
      next_obs, next_privileged: true successors, before any reset.
    """

    obs: Any
    privileged: Any
    action: Any
    reward: Any
    terminated: Any
    truncated: Any
    next_obs: Any
    next_privileged: Any


@pytree
class Batch:
    """Sampled n-step transitions, leading axis `batch`.

    Attributes:
      obs, privileged, action: at the beginning of the n steps.
      reward: discounted sum over the n steps, or fewer where the episode ended.
      discount: factor of the value of `next_obs`: gamma^steps, 0 where the episode terminated.
      next_obs, next_privileged: at the end of those steps.
    """

    obs: Any
    privileged: Any
    action: Any
    reward: Any
    discount: Any
    next_obs: Any
    next_privileged: Any


@pytree
class ReplayState:
    """What a replay buffer holds: a ring of steps for every environment.

    Attributes:
      storage: leaves `[env, time, ...]`.
      head: slot that the next step is written to. filled: slots that hold a step.
    """

    storage: Transition
    head: Any
    filled: Any


@dataclasses.dataclass(frozen=True)
class ReplayBuffer:
    """A ring of `length` steps for every environment, sampled uniformly over environments and steps.

    Attributes:
      length: steps kept per environment.
      n_step: steps of each sampled transition.
      gamma: discount per step.
    """

    length: int
    n_step: int = 1
    gamma: float = 0.99

    def __post_init__(self) -> None:
        if not 1 <= self.n_step <= self.length:
            raise bad_input(
                "ReplayBuffer",
                "n_step",
                self.n_step,
                f"is not within 1 .. length = {self.length}",
                "lower it or lengthen the buffer",
            )
        if not 0.0 <= self.gamma <= 1.0:
            raise bad_input("ReplayBuffer", "gamma", self.gamma, "is outside [0, 1]", "give about 0.99")

    def init(self, example: Transition) -> ReplayState:
        """An empty buffer for transitions like `example`, whose leaves have the leading axis `env`."""

        def empty(leaf: Any) -> Any:
            # Environments first: a device holds whole rings, and sampling never crosses devices.
            return jnp.zeros((leaf.shape[0], self.length, *leaf.shape[1:]), leaf.dtype)

        zero = jnp.zeros((), jnp.int32)
        return ReplayState(jax.tree.map(empty, example), zero, zero)

    def insert(self, state: ReplayState, step: Transition) -> ReplayState:
        """Writes one step of every environment over the oldest one."""

        def write(ring: Any, leaf: Any) -> Any:
            return jax.lax.dynamic_update_index_in_dim(ring, leaf.astype(ring.dtype), state.head, axis=1)

        return ReplayState(
            jax.tree.map(write, state.storage, step),
            (state.head + 1) % self.length,
            jnp.minimum(state.filled + 1, self.length),
        )

    def sample(self, state: ReplayState, key: Any, batch: int) -> Batch:
        """Draws `batch` transitions with replacement; `filled` must be at least `n_step`.

        Windows of n steps run from older to newer steps and never across the head. Where an episode ends within the
        window, the sum stops there, and the value is taken at its own successor.
        """
        store = state.storage
        envs = store.reward.shape[0]
        key_env, key_time = jax.random.split(key)
        env = jax.random.randint(key_env, (batch,), 0, envs)
        # Once full, the slot to be written next holds the oldest step.
        oldest = jnp.where(state.filled < self.length, 0, state.head)
        age = jax.random.randint(key_time, (batch,), 0, jnp.maximum(state.filled - self.n_step + 1, 1))
        window = (oldest + age[:, None] + jnp.arange(self.n_step)) % self.length
        reward, ended, cut = (a[env[:, None], window] for a in (store.reward, store.terminated, store.truncated))
        # Ends and cuts alike stop the sum; only an end also takes the value away.
        going = jnp.cumprod(1.0 - (ended | cut)[:, :-1].astype(reward.dtype), axis=1)
        alive = jnp.concatenate([jnp.ones((batch, 1), reward.dtype), going], axis=1)
        powers = self.gamma ** jnp.arange(self.n_step, dtype=reward.dtype)
        steps = jnp.sum(alive, axis=1)
        # The last step that was taken: its successor's value closes the sum.
        last = window[jnp.arange(batch), steps.astype(jnp.int32) - 1]
        stays = 1.0 - store.terminated[env, last].astype(reward.dtype)
        first = window[:, 0]
        return Batch(
            obs=store.obs[env, first],
            privileged=store.privileged[env, first],
            action=store.action[env, first],
            # a reward after the end may be anything, not a number included
            reward=jnp.sum(jnp.where(alive > 0.0, powers * reward, 0.0), axis=1),
            discount=stays * self.gamma**steps,
            next_obs=store.next_obs[env, last],
            next_privileged=store.next_privileged[env, last],
        )
