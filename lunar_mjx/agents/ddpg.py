"""DDPG (Lillicrap et al. 2016): one critic, no target noise, policy and targets updated every time.

Stable-Baselines3 implements it as TD3 with those settings, and so does the paper. Written out here on its own, so that
it can be read, and checked against TD3, alone.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.agents.networks import check_rates, make_actor, make_critics
from lunar_mjx.agents.replay import Batch
from lunar_mjx.agents.td3 import polyak
from lunar_mjx.errors import bad_input
from lunar_mjx.pytree import pytree

with without_warp_notices():
    from brax.training.gradients import gradient_update_fn


@dataclasses.dataclass(frozen=True)
class DDPGConfig:
    """Settings of DDPG; the defaults are those of Stable-Baselines3.

    Attributes:
      actor_layers: widths of the policy's hidden layers.
      critic_layers: widths of the critic's hidden layers.
      activation: of the hidden layers.
      layer_norm: normalise the hidden layers.
      actor_last_scale: of the policy's last layer at the start.
      actor_rate: learning rate of the policy.
      critic_rate: learning rate of the critic.
      gamma: discount per step.
      tau: share of the new parameters in the targets, per update.
      n_step: steps of a transition.
      reward_scale: factor on rewards before learning.
      value_range: least and greatest return that the task can pay, after reward scaling; targets are clipped to it, as
        in DDPG with hindsight replay (Andrychowicz et al. 2017, appendix A). One critic whose policy looks for its
        errors overestimates without end otherwise.
    """

    actor_layers: tuple[int, ...] = (400, 300)
    critic_layers: tuple[int, ...] = (400, 300)
    activation: str = "relu"
    layer_norm: bool = False
    actor_last_scale: float = 1.0
    actor_rate: float = 1e-3
    critic_rate: float = 1e-3
    gamma: float = 0.99
    tau: float = 0.005
    n_step: int = 1
    reward_scale: float = 1.0
    value_range: tuple[float, float] = (-1e9, 1e9)

    def __post_init__(self) -> None:
        if self.n_step < 1:
            raise bad_input("DDPGConfig", "n_step", self.n_step, "is below 1", "give at least 1")
        check_rates("DDPGConfig", self)
        if not self.value_range[0] < self.value_range[1]:
            raise bad_input("DDPGConfig", "value_range", self.value_range, "is empty", "give the least return first")


@pytree
class DDPGState:
    """Parameters, targets and optimisers; `updates` counts updates."""

    actor: Any
    actor_target: Any
    critic: Any
    critic_target: Any
    actor_optimiser: Any
    critic_optimiser: Any
    updates: Any


class DDPG:
    """The algorithm for given widths of observation, privileged observation and action."""

    def __init__(self, config: DDPGConfig, obs: int, privileged: int, actions: int):
        c = self.config = config
        self.actor = make_actor(obs, actions, c.actor_layers, c.activation, c.layer_norm, c.actor_last_scale)
        self.critic = make_critics(obs + privileged, actions, c.critic_layers, 1, 1, c.activation, c.layer_norm)
        self.actor_optimiser, self.critic_optimiser = optax.adam(c.actor_rate), optax.adam(c.critic_rate)

    def init(self, key: Any) -> DDPGState:
        """Networks and optimisers before the first update, drawn from a key of `jax.random`."""
        key_actor, key_critic = jax.random.split(key)
        actor, critic = self.actor.init(key_actor), self.critic.init(key_critic)
        return DDPGState(
            actor=actor,
            actor_target=jax.tree.map(jnp.copy, actor),
            critic=critic,
            critic_target=jax.tree.map(jnp.copy, critic),
            actor_optimiser=self.actor_optimiser.init(actor),
            critic_optimiser=self.critic_optimiser.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def act(self, actor: Any, obs: Any) -> Any:
        """Actions of the policy without noise, (env, action)."""
        return self.actor.apply(actor, obs)

    def policy(self, state: DDPGState) -> Any:
        """Parameters of the deterministic policy."""
        return state.actor

    def explore(self, state: DDPGState, obs: Any, deviation: Any, key: Any) -> Any:
        """Actions of the policy with noise of each environment's `deviation`, (env, action)."""
        action = self.act(state.actor, obs)
        # White noise as in Stable-Baselines3; the Ornstein-Uhlenbeck process of Lillicrap et al. gains nothing by its
        # memory (Fujimoto et al. 2018).
        noise = jax.random.normal(key, action.shape, obs.dtype)
        return jnp.clip(action + deviation[:, None] * noise, -1.0, 1.0)

    def update(self, state: DDPGState, batch: Batch, key: Any, axis: str | None = None) -> tuple[DDPGState, dict]:
        """One update of critic, policy and targets; arguments as for `TD3.update` (`key` is not used)."""
        c = self.config
        target = jax.lax.stop_gradient(self.targets(state, batch))
        critic_loss, critic, critic_optimiser = gradient_update_fn(self.critic_loss, self.critic_optimiser, axis)(
            state.critic, batch, target, optimizer_state=state.critic_optimiser
        )
        # By the critic as it has just become, as Stable-Baselines3 does.
        actor_loss, actor, actor_optimiser = gradient_update_fn(self.actor_loss, self.actor_optimiser, axis)(
            state.actor, critic, batch, optimizer_state=state.actor_optimiser
        )
        new = DDPGState(
            actor=actor,
            actor_target=polyak(state.actor_target, actor, c.tau),
            critic=critic,
            critic_target=polyak(state.critic_target, critic, c.tau),
            actor_optimiser=actor_optimiser,
            critic_optimiser=critic_optimiser,
            updates=state.updates + 1,
        )
        return new, {"critic_loss": critic_loss, "actor_loss": actor_loss, "target": jnp.mean(target)}

    def targets(self, state: DDPGState, batch: Batch) -> Any:
        """r + discount Q'(s', pi'(s')) within `value_range`, (batch,)."""
        action = self.act(state.actor_target, batch.next_obs)
        value = self._value(state.critic_target, batch.next_obs, batch.next_privileged, action)
        # No more than the task can pay: see `value_range`.
        return jnp.clip(self.config.reward_scale * batch.reward + batch.discount * value, *self.config.value_range)

    def critic_loss(self, critic: Any, batch: Batch, target: Any) -> Any:
        """Mean squared error of the critic's values against `target` (batch,)."""
        return jnp.mean((self._value(critic, batch.obs, batch.privileged, batch.action) - target) ** 2)

    def actor_loss(self, actor: Any, critic: Any, batch: Batch) -> Any:
        """Minus the value of the policy's actions."""
        return -jnp.mean(self._value(critic, batch.obs, batch.privileged, self.act(actor, batch.obs)))

    def _value(self, critic: Any, obs: Any, privileged: Any, action: Any) -> Any:
        return self.critic.apply(critic, jnp.concatenate([obs, privileged], axis=-1), action)[0, :, 0]
