"""Environments of this package for brax's trainers: one at a time as a `brax.envs.Env`, or whole batches natively.

from brax.training.agents.ppo import train as ppo
env = BraxEnv(lunar_mjx.envs.make("navigation", task="large"))
ppo.train(env, wrap_env_fn=wrap, episode_length=env.env.episode_steps, num_envs=4096, ...)
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.envs.core import Environment
from lunar_mjx.errors import bad_input

with without_warp_notices(), warnings.catch_warnings():
    # brax's own physics imports a library that announces its end
    warnings.simplefilter("ignore", DeprecationWarning)
    from brax.envs.base import Env
    from brax.envs.base import State as BraxState


class BraxEnv(Env):
    """One environment; brax's own wrappers batch it, cut its episodes and reset it.

    `done` is the task's end; cutting episodes off is left to brax's `episode_length`, which must not be above
    `episode_steps`. Give `wrap` as `wrap_env_fn` for native batches: faster, and every episode begins anew, while
    brax's automatic reset returns to the first start and goal.

    Args:
      env: an `Environment`.
    """

    def __init__(self, env: Environment):
        self.env = env

    def reset(self, rng: jax.Array) -> BraxState:
        # A batch of one: brax's wrappers vmap over single environments.
        return _single(self.env.reset(self.env.params, jnp.asarray(rng)[None]))

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        own = jax.tree.map(lambda leaf: leaf[None], state.pipeline_state)
        new = _single(self.env.step(self.env.params, own, action[None]))
        # Brax's wrappers keep their own counters in info.
        return dataclasses.replace(new, info={**state.info, **new.info})

    @property
    def observation_size(self) -> int:
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return "lunar_mjx"


def _metrics(state: Any) -> dict[str, Any]:
    """Success where an episode ended, and the parts of the reward: sums over an episode make sense of both."""
    parts = {k: v for k, v in state.metrics.items() if k.startswith("reward_")}
    return {"success": jnp.where(state.done, state.metrics["success"], 0.0), **parts}


def _single(state: Any) -> BraxState:
    one = jax.tree.map(lambda leaf: leaf[0], state)
    # The true successor: brax resets by itself, and would otherwise see the next episode's beginning.
    return BraxState(one, one.final_obs, one.reward, one.terminated.astype(one.reward.dtype), _metrics(one), {})


class _Batch(BraxEnv):
    """A batch that resets itself, with what brax's wrappers would have added."""

    def reset(self, rng: jax.Array) -> BraxState:
        state: Any = self.env.reset(self.env.params, rng)
        zero = jnp.zeros_like(state.reward)
        metrics = _metrics(state)
        info = {
            "steps": zero,
            "truncation": zero,
            "episode_done": zero,
            "episode_metrics": {"sum_reward": zero, "length": zero, **dict.fromkeys(metrics, zero)},
        }
        return BraxState(state, state.obs, zero, zero, metrics, info)

    def step(self, state: BraxState, action: jax.Array) -> BraxState:
        before: Any = state.pipeline_state
        own: Any = self.env.step(self.env.params, before, action)
        metrics, info, reward = _metrics(own), state.info, own.reward
        done = own.done.astype(reward.dtype)
        # Sums begin anew in the step after an episode's end, as brax's own wrapper has it.
        going = 1.0 - info["episode_done"]
        adds = {"sum_reward": reward, "length": jnp.ones_like(reward), **metrics}
        totals = {k: info["episode_metrics"][k] * going + v for k, v in adds.items()}
        steps = info["steps"] * going + 1.0
        new = {
            **info,
            "steps": steps,
            "truncation": own.truncated.astype(reward.dtype),
            "episode_done": done,
            "episode_metrics": totals,
        }
        # Here the next episode's observation: a native batch has reset itself.
        return BraxState(own, own.obs, reward, done, metrics, new)


def wrap(env: BraxEnv, episode_length: int = 1000, action_repeat: int = 1, randomization_fn: Any = None) -> Env:
    """A native batch for brax's trainers, as their argument `wrap_env_fn`.

    Raises:
      UserError: an episode length other than the environment's, or what the environment does by itself.
    """
    if episode_length != env.env.episode_steps:
        raise bad_input(
            "brax",
            "episode_length",
            episode_length,
            "is not the environment's",
            f"give episode_length={env.env.episode_steps}",
        )
    if action_repeat != 1:
        raise bad_input("brax", "action_repeat", action_repeat, "is not 1", "set the environment's decimation")
    if randomization_fn is not None:
        raise bad_input("brax", "randomization_fn", "a function", "does not fit", "set the environment's randomise")
    return _Batch(env.env)
