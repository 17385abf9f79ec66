"""The stochastic policy of SAC and PPO: a normal distribution squashed by tanh, from one network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.agents.networks import Network, make_actor, mlp

with without_warp_notices():
    from brax.training.distribution import NormalTanhDistribution


def make_policy(
    obs: int, actions: int, layers: Sequence[int], activation: str, layer_norm: bool, last_scale: float
) -> tuple[Network, NormalTanhDistribution]:
    """Network and distribution of actions, as brax's losses take them.

    The network's `apply(_, params, seen)` reads the first `obs` numbers of what is seen: what follows is the critic's.
    It returns means and, before softplus, deviations before squashing, (..., 2 * action). The rest is `make_actor`'s.
    """
    module = mlp((*layers, 2 * actions), activation, layer_norm)
    init = make_actor(obs, 2 * actions, layers, activation, layer_norm, last_scale).init
    network = Network(init=init, apply=lambda _, params, seen: module.apply(params, seen[..., :obs]))
    return network, NormalTanhDistribution(event_size=actions)


def most_likely(params: Any, layers: Sequence[int], actions: int) -> Any:
    """Parameters of the deterministic actor (`make_actor`) that does what the distribution's mode is."""
    last = f"hidden_{len(layers)}"
    inner = params["params"]
    # The last layer gives means first and deviations after them; tanh of the mean is where the squashed density is
    # highest, to first order.
    means = {name: a[..., :actions] for name, a in inner[last].items()}
    return {"params": {**inner, last: means}}
