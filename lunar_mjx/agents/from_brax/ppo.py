"""Proximal policy optimisation (Schulman et al. 2017): brax's loss and its learning rate that follows the divergence.

The value sees what is privileged, too. Defaults are those with which legged robots are trained by the thousand (Rudin
et al. 2022, arXiv 2109.11978).
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.agents.from_brax.policies import make_policy, most_likely
from lunar_mjx.agents.networks import make_actor, mlp
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.pytree import pytree

with without_warp_notices():
    from brax.training import gradients as brax_gradients
    from brax.training import networks as brax_networks
    from brax.training import types as brax_types
    from brax.training.agents.ppo import losses as brax_losses
    from brax.training.agents.ppo import networks as ppo_networks
    from brax.training.agents.ppo.optimizer import adaptive_kl_learning_rate

# brax declares less than it takes and gives
loss_and_pgrad: Any = brax_gradients.loss_and_pgrad
compute_ppo_loss: Any = brax_losses.compute_ppo_loss
PPONetworkParams: Any = brax_losses.PPONetworkParams
PPONetworks: Any = ppo_networks.PPONetworks
Transition: Any = brax_types.Transition


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings of proximal policy optimisation.

    Attributes:
      actor_layers: widths of the policy's hidden layers. critic_layers: of the value's.
      activation, layer_norm: of the hidden layers.
      actor_last_scale: of the policy's last layer at the start.
      rate: learning rate at the start. kl: divergence of the policy per update that the rate is steered to.
      max_gradient: norm to which gradients are cut.
      gamma: discount per step. gae_lambda: of the advantages' average.
      clip: of the ratio of probabilities. entropy: what a nat of it is worth.
      unroll: steps of every environment between updates.
      minibatches: of environments, per pass. passes: over the data of an unroll.
      reward_scale: factor on rewards before learning.
    """

    UNUSED: ClassVar[tuple[str, ...]] = ("batch", "updates", "buffer_steps", "random_steps", "noise")
    """Fields of `TrainConfig` that say nothing here: nothing is replayed, and the policy is random by itself."""

    actor_layers: tuple[int, ...] = (512, 256, 128)
    critic_layers: tuple[int, ...] = (512, 256, 128)
    activation: str = "elu"
    layer_norm: bool = False
    actor_last_scale: float = 0.01
    rate: float = 3e-4
    kl: float = 0.01
    max_gradient: float = 1.0
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.005
    unroll: int = 24
    minibatches: int = 4
    passes: int = 5
    reward_scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("unroll", "minibatches", "passes"):
            if getattr(self, name) < 1:
                raise bad_input("PPOConfig", name, getattr(self, name), "is below 1", "give at least 1")
        for name in ("rate", "kl", "max_gradient", "clip", "reward_scale", "actor_last_scale"):
            require_within("PPOConfig", name, getattr(self, name), 0.0, above=True)
        for name in ("gamma", "gae_lambda"):
            require_within("PPOConfig", name, getattr(self, name), 0.0, 1.0)
        require_within("PPOConfig", "entropy", self.entropy, 0.0)
        for name in ("actor_layers", "critic_layers"):
            for width in getattr(self, name):
                require_within("PPOConfig", name, width, 1.0, 1e5)


@pytree
class PPOState:
    """Parameters of policy and value, and their optimiser."""

    params: Any
    optimiser: Any


@pytree
class Rollout:
    """Steps of every environment with the policy as it was; leading axes `env`, `time`, or `env` for one step.

    Attributes:
      seen: observations and what is privileged, side by side; `next_seen`: their true successors.
      raw: actions before squashing. logits: of their distribution. log_prob: of the actions.
      reward: received. done: whether the episode ended, truncated: for it was cut off.
    """

    seen: Any
    raw: Any
    logits: Any
    log_prob: Any
    reward: Any
    done: Any
    truncated: Any
    next_seen: Any


class PPO:
    """The algorithm for given widths of observation, privileged observation and action."""

    def __init__(self, config: PPOConfig, obs: int, privileged: int, actions: int):
        c = self.config = config
        self.actions, self.obs = actions, obs
        self.network, self.distribution = make_policy(
            obs, actions, c.actor_layers, c.activation, c.layer_norm, c.actor_last_scale
        )
        self.mode = make_actor(obs, actions, c.actor_layers, c.activation, c.layer_norm)
        module = mlp((*c.critic_layers, 1), c.activation, c.layer_norm)
        self.value = brax_networks.FeedForwardNetwork(
            init=lambda key: module.init(key, jnp.zeros((1, obs + privileged))),
            # Brax hands on its own normaliser first; observations come normalised here.
            apply=lambda _, params, seen: module.apply(params, seen)[..., 0],
        )
        self.networks = PPONetworks(self.network, self.value, self.distribution)
        self.optimiser = optax.chain(
            optax.clip_by_global_norm(c.max_gradient),
            # As a hyperparameter in the state: the rate follows the divergence from update to update.
            optax.inject_hyperparams(optax.adam)(learning_rate=c.rate),
        )

    def init(self, key: Any) -> PPOState:
        """Networks and optimisers before the first update, drawn from a key of `jax.random`."""
        key_policy, key_value = jax.random.split(key)
        params = PPONetworkParams(policy=self.network.init(key_policy), value=self.value.init(key_value))
        return PPOState(params, self.optimiser.init(params))

    def policy(self, state: PPOState) -> Any:
        """Parameters of the deterministic policy."""
        return most_likely(state.params.policy, self.config.actor_layers, self.actions)

    def act(self, policy: Any, obs: Any) -> Any:
        """Actions of the policy without noise, (env, action)."""
        return self.mode.apply(policy, obs)

    def draw(self, state: PPOState, obs: Any, key: Any) -> tuple[Any, Any, Any, Any]:
        """Draws from the policy for observations (env, obs): actions, and of `Rollout` raw, logits and log_prob."""
        logits = self.network.apply(None, state.params.policy, obs)
        raw = self.distribution.sample_no_postprocessing(logits, key)
        # Raw actions are kept: the inverse of the squashing loses digits at the bounds.
        return self.distribution.postprocess(raw), raw, logits, self.distribution.log_prob(logits, raw)

    def loss(self, params: Any, data: Any, key: Any) -> tuple[Any, dict[str, Any]]:
        """brax's loss, and its parts by name."""
        c = self.config
        return compute_ppo_loss(
            params,
            None,
            data,
            key,
            self.networks,
            entropy_cost=c.entropy,
            discounting=c.gamma,
            reward_scaling=c.reward_scale,
            gae_lambda=c.gae_lambda,
            clipping_epsilon=c.clip,
        )

    def update(self, state: PPOState, rollout: Rollout, key: Any, axis: str | None = None) -> tuple[PPOState, dict]:
        """All passes over a rollout.

        Args:
          state: before. rollout: normalised, (env, time, ...). key: of minibatches.
          axis: mesh axis over which gradients and the divergence are averaged, if any.

        Returns:
          The state after, and means of the loss's parts by name.
        """
        c = self.config
        data = Transition(
            observation=rollout.seen,
            action=rollout.raw,
            reward=rollout.reward,
            # Ends and cuts alike; brax tells them apart by `truncation`.
            discount=1.0 - rollout.done,
            next_observation=rollout.next_seen,
            extras={
                "state_extras": {"truncation": rollout.truncated},
                "policy_extras": {
                    "raw_action": rollout.raw,
                    "log_prob": rollout.log_prob,
                    "distribution_params": rollout.logits,
                },
            },
        )
        gradients = loss_and_pgrad(self.loss, pmap_axis_name=axis, has_aux=True)

        def minibatch(state: PPOState, part: Any) -> tuple[PPOState, Any]:
            data, key = part
            (_, told), gradient = gradients(state.params, data, key)
            # The rate must follow one divergence on all devices, or their parameters would drift apart.
            kl = told["kl_mean"] if axis is None else jax.lax.pmean(told["kl_mean"], axis)
            optimiser, rate = adaptive_kl_learning_rate(state.optimiser, kl, c.kl)
            change, optimiser = self.optimiser.update(gradient, optimiser)
            names = {"policy_loss": "policy_loss", "value_loss": "v_loss", "deviation": "policy_dist_mean_std"}
            losses = {name: told[theirs] for name, theirs in names.items()}
            return PPOState(optax.apply_updates(state.params, change), optimiser), {**losses, "kl": kl, "rate": rate}

        def once(carry: tuple[PPOState, Any], _: Any) -> tuple[tuple[PPOState, Any], Any]:
            state, key = carry
            key, key_order, key_loss = jax.random.split(key, 3)
            order = jax.random.permutation(key_order, rollout.reward.shape[0])
            # Whole environments are shuffled, not steps: advantages are sums along an environment's time.
            parts = jax.tree.map(lambda a: a[order].reshape(c.minibatches, -1, *a.shape[1:]), data)
            state, losses = jax.lax.scan(minibatch, state, (parts, jax.random.split(key_loss, c.minibatches)))
            return (state, key), losses

        (state, _), losses = jax.lax.scan(once, (state, key), length=c.passes)
        return state, jax.tree.map(jnp.mean, losses)
