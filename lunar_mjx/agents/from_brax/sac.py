"""Soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905): brax's losses on this package's batches.

Critics see what is privileged, too, and learn from n-step sums; the temperature follows brax's target entropy of half a
nat per action below zero.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.agents.from_brax.policies import make_policy, most_likely
from lunar_mjx.agents.networks import check_rates, make_actor, make_critics
from lunar_mjx.agents.replay import Batch
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.pytree import pytree

with without_warp_notices():
    from brax.training import gradients as brax_gradients
    from brax.training import networks as brax_networks
    from brax.training import types as brax_types
    from brax.training.agents.sac import losses as brax_losses
    from brax.training.agents.sac import networks as sac_networks

# brax declares less than it takes and gives
gradient_update_fn: Any = brax_gradients.gradient_update_fn
SACNetworks: Any = sac_networks.SACNetworks
Transition: Any = brax_types.Transition


@dataclasses.dataclass(frozen=True)
class SACConfig:
    """Settings of SAC; the defaults are those of Stable-Baselines3.

    Attributes:
      actor_layers: widths of the policy's hidden layers. critic_layers: of the critics'.
      activation, layer_norm: of the hidden layers.
      actor_last_scale: of the policy's last layer at the start.
      actor_rate, critic_rate, temperature_rate: learning rates.
      temperature: of the entropy at the start.
      gamma: discount per step. tau: share of the new critics in the targets, per update.
      critics: how many; targets take the least. n_step: steps of a transition.
      reward_scale: factor on rewards before learning; against it the temperature is measured.
    """

    UNUSED: ClassVar[tuple[str, ...]] = ("noise",)
    """Fields of `TrainConfig` that say nothing here: the policy is random by itself."""

    actor_layers: tuple[int, ...] = (256, 256)
    critic_layers: tuple[int, ...] = (256, 256)
    activation: str = "relu"
    layer_norm: bool = False
    actor_last_scale: float = 1.0
    actor_rate: float = 3e-4
    critic_rate: float = 3e-4
    temperature_rate: float = 3e-4
    temperature: float = 1.0
    gamma: float = 0.99
    tau: float = 0.005
    critics: int = 2
    n_step: int = 1
    reward_scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("critics", "n_step"):
            if getattr(self, name) < 1:
                raise bad_input("SACConfig", name, getattr(self, name), "is below 1", "give at least 1")
        check_rates("SACConfig", self)
        for name in ("temperature", "temperature_rate"):
            require_within("SACConfig", name, getattr(self, name), 0.0, above=True)


@pytree
class SACState:
    """Parameters, targets and optimisers; `temperature` is its logarithm."""

    actor: Any
    critic: Any
    critic_target: Any
    temperature: Any
    actor_optimiser: Any
    critic_optimiser: Any
    temperature_optimiser: Any


class SAC:
    """The algorithm for given widths of observation, privileged observation and action."""

    def __init__(self, config: SACConfig, obs: int, privileged: int, actions: int):
        c = self.config = config
        self.actions = actions
        network, self.distribution = make_policy(
            obs, actions, c.actor_layers, c.activation, c.layer_norm, c.actor_last_scale
        )
        self.network, self.mode = network, make_actor(obs, actions, c.actor_layers, c.activation, c.layer_norm)
        self.critics = make_critics(
            obs + privileged, actions, c.critic_layers, c.critics, 1, c.activation, c.layer_norm
        )
        values = brax_networks.FeedForwardNetwork(
            init=self.critics.init,
            # Brax wants critics last.
            apply=lambda _, params, seen, action: jnp.moveaxis(self.critics.apply(params, seen, action)[..., 0], 0, -1),
        )
        self.losses = brax_losses.make_losses(
            SACNetworks(network, values, self.distribution), c.reward_scale, c.gamma, actions
        )
        rates = c.temperature_rate, c.critic_rate, c.actor_rate
        self.optimisers = tuple(optax.adam(rate) for rate in rates)

    def init(self, key: Any) -> SACState:
        """Networks and optimisers before the first update, drawn from a key of `jax.random`."""
        key_actor, key_critic = jax.random.split(key)
        actor, critic = self.network.init(key_actor), self.critics.init(key_critic)
        temperature = jnp.log(jnp.float32(self.config.temperature))
        of_temperature, of_critic, of_actor = self.optimisers
        return SACState(
            actor=actor,
            critic=critic,
            critic_target=jax.tree.map(jnp.copy, critic),
            temperature=temperature,
            actor_optimiser=of_actor.init(actor),
            critic_optimiser=of_critic.init(critic),
            temperature_optimiser=of_temperature.init(temperature),
        )

    def policy(self, state: SACState) -> Any:
        """Parameters of the deterministic policy."""
        return most_likely(state.actor, self.config.actor_layers, self.actions)

    def act(self, policy: Any, obs: Any) -> Any:
        """Actions of the policy without noise, (env, action)."""
        return self.mode.apply(policy, obs)

    def explore(self, state: SACState, obs: Any, deviation: Any, key: Any) -> Any:
        """Actions drawn from the policy, (env, action); `deviation` is not used."""
        return self.distribution.sample(self.network.apply(None, state.actor, obs), key)

    def update(self, state: SACState, batch: Batch, key: Any, axis: str | None = None) -> tuple[SACState, dict]:
        """One update of temperature, critics, policy and targets; see `TD3.update`."""
        c = self.config
        data = Transition(
            observation=jnp.concatenate([batch.obs, batch.privileged], axis=-1),
            action=batch.action,
            reward=batch.reward,
            # brax multiplies by gamma once; the batch's discount holds all the steps
            discount=batch.discount / c.gamma,
            next_observation=jnp.concatenate([batch.next_obs, batch.next_privileged], axis=-1),
            # successors are the true ones: an episode that was cut off is no reason to leave its value out
            extras={"state_extras": {"truncation": jnp.zeros_like(batch.reward)}, "policy_extras": {}},
        )
        keys = jax.random.split(key, 3)
        of_temperature, of_critic, of_actor = (
            gradient_update_fn(loss, optimiser, axis)
            for loss, optimiser in zip(self.losses, self.optimisers, strict=True)
        )
        # The logarithm is learnt, so that the temperature stays positive.
        alpha = jnp.exp(state.temperature)
        temperature_loss, temperature, temperature_optimiser = of_temperature(
            state.temperature, state.actor, None, data, keys[0], optimizer_state=state.temperature_optimiser
        )
        critic_loss, critic, critic_optimiser = of_critic(
            state.critic,
            state.actor,
            None,
            state.critic_target,
            alpha,
            data,
            keys[1],
            optimizer_state=state.critic_optimiser,
        )
        actor_loss, actor, actor_optimiser = of_actor(
            state.actor, None, state.critic, alpha, data, keys[2], optimizer_state=state.actor_optimiser
        )
        # The policy has no target: its entropy keeps it from jumping.
        target = jax.tree.map(lambda t, n: t + c.tau * (n - t), state.critic_target, critic)
        new = SACState(actor, critic, target, temperature, actor_optimiser, critic_optimiser, temperature_optimiser)
        return new, {
            "critic_loss": critic_loss,
            "actor_loss": actor_loss,
            "temperature_loss": temperature_loss,
            "temperature": alpha,
        }
