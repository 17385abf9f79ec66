"""TD3 (Fujimoto et al. 2018), with FastTD3's (Seo et al. 2025) distributional critic as an option.

One agent is three pure functions on a pytree: `init`, `act` and `update`. Observations come normalised, rewards as the
n-step sums of the replay buffer. SB3's defaults are `TD3Config()`; `train/large-td3.toml` is for large batches.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.agents.networks import check_rates, first_critic, make_actor, make_critics
from lunar_mjx.agents.replay import Batch
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.pytree import pytree

with without_warp_notices():
    from brax.training.gradients import gradient_update_fn


@dataclasses.dataclass(frozen=True)
class TD3Config:
    """Settings of TD3; the defaults are those of Stable-Baselines3.

    Attributes:
      actor_layers: widths of the policy's hidden layers.
      critic_layers: widths of the critics' hidden layers.
      activation: of the hidden layers.
      layer_norm: normalise the hidden layers (PQL and later work: steadier at large batches).
      actor_last_scale: of the policy's last layer at the start.
      actor_rate: learning rate of the policy.
      critic_rate: learning rate of the critics.
      weight_decay: of AdamW; plain Adam at 0.
      gamma: discount per step.
      tau: share of the new parameters in the targets, per update of the targets.
      critics: number of critics; targets take the least of them.
      policy_delay: critic updates per update of the policy and of the targets.
      target_noise: deviation of the noise on the target policy's actions.
      target_clip: bound of that noise.
      n_step: steps of a transition.
      atoms: of the distributional critic (C51); 1 for a plain one.
      value_range: least and greatest return that the distributional critic represents, after reward scaling.
      reward_scale: factor on rewards before learning.
    """

    actor_layers: tuple[int, ...] = (400, 300)
    critic_layers: tuple[int, ...] = (400, 300)
    activation: str = "relu"
    layer_norm: bool = False
    actor_last_scale: float = 1.0
    actor_rate: float = 1e-3
    critic_rate: float = 1e-3
    weight_decay: float = 0.0
    gamma: float = 0.99
    tau: float = 0.005
    critics: int = 2
    policy_delay: int = 2
    target_noise: float = 0.2
    target_clip: float = 0.5
    n_step: int = 1
    atoms: int = 1
    value_range: tuple[float, float] = (-10.0, 10.0)
    reward_scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("critics", "policy_delay", "n_step", "atoms"):
            if getattr(self, name) < 1:
                raise bad_input("TD3Config", name, getattr(self, name), "is below 1", "give at least 1")
        check_rates("TD3Config", self)
        for name in ("weight_decay", "target_noise", "target_clip"):
            require_within("TD3Config", name, getattr(self, name), 0.0)
        if self.atoms > 1 and not self.value_range[0] < self.value_range[1]:
            raise bad_input("TD3Config", "value_range", self.value_range, "is empty", "give the least return first")


@pytree
class TD3State:
    """Parameters, targets and optimisers; `updates` counts critic updates."""

    actor: Any
    actor_target: Any
    critic: Any
    critic_target: Any
    actor_optimiser: Any
    critic_optimiser: Any
    updates: Any


class TD3:
    """The algorithm for given widths of observation, privileged observation and action."""

    def __init__(self, config: TD3Config, obs: int, privileged: int, actions: int):
        c = self.config = config
        self.actor = make_actor(obs, actions, c.actor_layers, c.activation, c.layer_norm, c.actor_last_scale)
        self.critics = make_critics(
            obs + privileged, actions, c.critic_layers, c.critics, c.atoms, c.activation, c.layer_norm
        )
        self.actor_optimiser = optax.adamw(c.actor_rate, weight_decay=c.weight_decay)
        self.critic_optimiser = optax.adamw(c.critic_rate, weight_decay=c.weight_decay)
        # the returns on which the critics put their probabilities (C51, Bellemare et al. 2017); None for plain values
        self.support = jnp.linspace(*c.value_range, c.atoms) if c.atoms > 1 else None

    def init(self, key: Any) -> TD3State:
        """Networks and optimisers before the first update, drawn from a key of `jax.random`."""
        key_actor, key_critic = jax.random.split(key)
        actor, critic = self.actor.init(key_actor), self.critics.init(key_critic)
        return TD3State(
            actor=actor,
            actor_target=jax.tree.map(jnp.copy, actor),
            critic=critic,
            # Copies: a state is donated to the next epoch, and one buffer may be given away once only.
            critic_target=jax.tree.map(jnp.copy, critic),
            actor_optimiser=self.actor_optimiser.init(actor),
            critic_optimiser=self.critic_optimiser.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def act(self, actor: Any, obs: Any) -> Any:
        """Actions of the policy without noise, (env, action)."""
        return self.actor.apply(actor, obs)

    def policy(self, state: TD3State) -> Any:
        """Parameters of the deterministic policy."""
        return state.actor

    def explore(self, state: TD3State, obs: Any, deviation: Any, key: Any) -> Any:
        """Actions of the policy with noise of each environment's `deviation`, (env, action)."""
        action = self.act(state.actor, obs)
        noise = jax.random.normal(key, action.shape, obs.dtype)
        # Each environment keeps its deviation: some explore widely while others show what the policy is worth.
        return jnp.clip(action + deviation[:, None] * noise, -1.0, 1.0)

    def update(self, state: TD3State, batch: Batch, key: Any, axis: str | None = None) -> tuple[TD3State, dict]:
        """One update of the critics, and of policy and targets every `policy_delay` of them.

        Args:
          state: before. batch: normalised. key: of the target noise.
          axis: mesh axis over which gradients are averaged, if any.

        Returns:
          The state after, and losses by name.
        """
        c = self.config
        # the gradient of a target network's estimate would pull the target towards the critic (semi-gradient)
        target = jax.lax.stop_gradient(self.targets(state, batch, key))
        loss, critic, critic_optimiser = gradient_update_fn(
            self.critic_loss, _with_params(self.critic_optimiser, state.critic), axis
        )(state.critic, batch, target, optimizer_state=state.critic_optimiser)
        state = dataclasses.replace(state, critic=critic, critic_optimiser=critic_optimiser, updates=state.updates + 1)

        def improve(state: TD3State) -> tuple[TD3State, Any]:
            loss, actor, optimiser = gradient_update_fn(
                self.actor_loss, _with_params(self.actor_optimiser, state.actor), axis
            )(state.actor, state.critic, batch, optimizer_state=state.actor_optimiser)
            new = dataclasses.replace(
                state,
                actor=actor,
                actor_optimiser=optimiser,
                # targets move with the policy, at its slower pace (Fujimoto et al. 2018, algorithm 1)
                actor_target=polyak(state.actor_target, actor, c.tau),
                critic_target=polyak(state.critic_target, state.critic, c.tau),
            )
            return new, loss

        if c.policy_delay == 1:
            state, actor_loss = improve(state)
        else:
            due = state.updates % c.policy_delay == 0
            state, actor_loss = jax.lax.cond(due, improve, lambda s: (s, jnp.zeros((), loss.dtype)), state)
            actor_loss = actor_loss * c.policy_delay  # zero in between: the mean over updates is the loss
        value = self.mean_value(target)
        return state, {
            "critic_loss": loss,
            "actor_loss": actor_loss,
            "target": jnp.mean(value),
            "target_low": jnp.min(value),
            "target_high": jnp.max(value),
        }

    def targets(self, state: TD3State, batch: Batch, key: Any) -> Any:
        """What the critics should say: (batch,) returns, or (batch, atom) probabilities."""
        c = self.config
        noise = c.target_noise * jax.random.normal(key, batch.action.shape, batch.action.dtype)
        # Smooths the target over near actions, so that the policy cannot exploit a spike of the critics.
        noise = jnp.clip(noise, -c.target_clip, c.target_clip)
        action = jnp.clip(self.act(state.actor_target, batch.next_obs) + noise, -1.0, 1.0)
        seen = jnp.concatenate([batch.next_obs, batch.next_privileged], axis=-1)
        out = self.critics.apply(state.critic_target, seen, action)
        reward = c.reward_scale * batch.reward
        if self.support is None:
            # The least of the critics: the mean of maxima over noisy estimates is too high.
            return reward + batch.discount * jnp.min(out[..., 0], axis=0)
        probabilities = jax.nn.softmax(out, axis=-1)
        # By the mean, and then its whole distribution: a minimum atom by atom is no distribution.
        least = jnp.argmin(self.mean_value(probabilities), axis=0)
        chosen = jnp.take_along_axis(probabilities, least[None, :, None], axis=0)[0]
        return project(self.support, reward[:, None] + batch.discount[:, None] * self.support, chosen)

    def mean_value(self, values: Any) -> Any:
        """Expected return of probabilities over the atoms; returns themselves for a plain critic."""
        return values if self.support is None else jnp.sum(values * self.support, axis=-1)

    def critic_loss(self, critic: Any, batch: Batch, target: Any) -> Any:
        """Sum over the critics of the mean squared error, or of the mean cross entropy to the target distribution."""
        seen = jnp.concatenate([batch.obs, batch.privileged], axis=-1)
        out = self.critics.apply(critic, seen, batch.action)
        if self.support is None:
            return jnp.sum(jnp.mean((out[..., 0] - target) ** 2, axis=1))
        return -jnp.sum(jnp.mean(jnp.sum(target * jax.nn.log_softmax(out, axis=-1), axis=-1), axis=1))

    def actor_loss(self, actor: Any, critic: Any, batch: Batch) -> Any:
        """Minus the first critic's value of the policy's actions."""
        seen = jnp.concatenate([batch.obs, batch.privileged], axis=-1)
        # The first alone, as in the paper's algorithm: the minimum serves targets.
        out = self.critics.apply(first_critic(critic), seen, self.act(actor, batch.obs))[0]
        value = out[..., 0] if self.support is None else self.mean_value(jax.nn.softmax(out, axis=-1))
        return -jnp.mean(value)


def _with_params(optimiser: optax.GradientTransformation, held: Any) -> optax.GradientTransformation:
    """The optimiser with the parameters at hand, which decay needs and brax's update does not pass on."""

    def update(updates: Any, state: Any, params: Any = None) -> Any:
        return optimiser.update(updates, state, held)

    return optax.GradientTransformation(optimiser.init, update)


def polyak(target: Any, new: Any, tau: float) -> Any:
    """(1 - tau) target + tau new."""
    # One product in place of two.
    return jax.tree.map(lambda t, n: t + tau * (n - t), target, new)


def project(support: Any, places: Any, probabilities: Any) -> Any:
    """Spreads probabilities at shifted places onto the nearest two atoms (Bellemare et al. 2017).

    Args:
      support: (atom,) evenly spaced. places: (batch, atom) where the probabilities lie. probabilities: (batch, atom).

    Returns:
      (batch, atom) probabilities at the support.
    """
    step = support[1] - support[0]
    # Returns beyond the support count as its ends.
    at = jnp.clip((places - support[0]) / step, 0.0, len(support) - 1.0)
    # triangular weights in one fused sum: a scatter would be slow on a GPU, and a matrix product would need them stored
    weights = jnp.clip(1.0 - jnp.abs(at[:, :, None] - jnp.arange(len(support))), 0.0, 1.0)
    return jnp.sum(probabilities[:, :, None] * weights, axis=1)
