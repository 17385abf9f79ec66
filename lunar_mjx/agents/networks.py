"""Actor and critics: brax's multi-layer perceptrons, several critics as one batch of parameters.

An actor that sees a picture looks at it through convolutions first, whose features join its other numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from lunar_mjx._quiet import without_warp_notices
from lunar_mjx.errors import bad_input, require_within

with without_warp_notices():
    from brax.training import networks as brax_networks

ACTIVATIONS: dict[str, Callable[[Any], Any]] = {
    "relu": jax.nn.relu,
    "elu": jax.nn.elu,
    "swish": jax.nn.swish,
    "tanh": jnp.tanh,
}

MOST_DEVIATIONS = 10.0
"""To which normalised observations are cut."""

Network = brax_networks.FeedForwardNetwork
"""`init(key) -> params` and `apply(params, ...)`."""

_TORCH = jax.nn.initializers.variance_scaling(1.0 / 3.0, "fan_in", "uniform")
"""PyTorch's default for linear layers, U(-1/sqrt(fan_in), 1/sqrt(fan_in)), which SB3 keeps."""


def normalised(values: Any, mean: Any, deviation: Any) -> Any:
    """Observations in deviations from the mean, within `MOST_DEVIATIONS` of them."""
    return jnp.clip((values - mean) / deviation, -MOST_DEVIATIONS, MOST_DEVIATIONS)


def mlp(sizes: Sequence[int], activation: str, layer_norm: bool) -> Any:
    """brax's module of layers of these widths, the last one linear, begun as PyTorch would."""
    if activation not in ACTIVATIONS:
        raise bad_input("networks", "activation", activation, "does not exist", f"use one of {', '.join(ACTIVATIONS)}")
    return brax_networks.MLP(
        layer_sizes=tuple(sizes), activation=ACTIVATIONS[activation], kernel_init=_TORCH, layer_norm=layer_norm
    )


def check_rates(source: str, config: Any) -> None:
    """Raises `UserError` for learning rates, discount, target share or layers of a config that no learner can take."""
    for name in ("actor_rate", "critic_rate", "actor_last_scale", "reward_scale"):
        require_within(source, name, getattr(config, name), 0.0, above=True)
    require_within(source, "gamma", config.gamma, 0.0, 1.0)
    require_within(source, "tau", config.tau, 0.0, 1.0, above=True)
    for name in ("actor_layers", "critic_layers"):
        # More than 100,000 units a layer is a slip of the keyboard, and would only fail when memory runs out.
        for width in getattr(config, name):
            require_within(source, name, width, 1.0, 1e5)


def make_actor(
    obs: int,
    actions: int,
    layers: Sequence[int],
    activation: str = "relu",
    layer_norm: bool = False,
    last_scale: float = 1.0,
    picture: Sequence[int] | None = None,
    filters: Sequence[int] = (),
) -> Network:
    """A deterministic policy: `apply(params, obs) -> action` in [-1, 1].

    Args:
      obs, actions: widths.
      layers: widths of the hidden layers.
      activation: name in `ACTIVATIONS`.
      layer_norm: normalise each hidden layer.
      last_scale: of the last layer's weights at the start; a small one makes the first actions near zero.
      picture: first number, rows, columns and colours of a picture among the observations; None if there is none.
      filters: of the convolutions on it, each of which halves rows and columns.
    """
    module = mlp((*layers, actions), activation, layer_norm)
    eye = None if picture is None else make_eye(picture, filters, activation)

    def init(key: Any) -> Any:
        one = jnp.zeros((1, obs))
        looked = {} if eye is None else {"eye": eye.init(jax.random.fold_in(key, 1))}
        # Scaled after the initialiser, so that hidden layers keep their own.
        params = module.init(key, one if eye is None else eye.apply(looked["eye"], one))
        last = f"hidden_{len(layers)}"
        inner = params["params"]
        return {"params": {**inner, last: jax.tree.map(lambda a: last_scale * a, inner[last])}, **looked}

    def apply(params: Any, x: Any) -> Any:
        seen = x if eye is None else eye.apply(params["eye"], x)
        return jnp.tanh(module.apply({"params": params["params"]}, seen))

    return Network(init=init, apply=apply)


def make_eye(picture: Sequence[int], filters: Sequence[int], activation: str = "relu") -> Network:
    """Convolutions of 3 x 3 over a picture among observations: `apply(params, obs) -> (..., other numbers + features)`.

    Args:
      picture: first number, rows, columns and colours. filters: of each layer, which halves rows and columns.
      activation: name in `ACTIVATIONS`.
    """
    start, rows, columns, colours = picture
    stop, wide = start + rows * columns * colours, (colours, *filters)

    def init(key: Any) -> Any:
        keys = jax.random.split(key, len(filters))
        kernels = [_TORCH(k, (3, 3, *wide[i : i + 2])) for i, k in enumerate(keys)]
        return {f"conv_{i}": {"kernel": k, "bias": jnp.zeros(k.shape[-1])} for i, k in enumerate(kernels)}

    def apply(params: Any, x: Any) -> Any:
        # Observations are flat; leading axes become one, since a convolution takes a batch of pictures.
        seen = x[..., start:stop].reshape(-1, rows, columns, colours)
        for i in range(len(filters)):
            layer = params[f"conv_{i}"]
            kept = jax.lax.conv_general_dilated(
                seen, layer["kernel"], (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
            seen = ACTIVATIONS[activation](kept + layer["bias"])
        features = seen.reshape(*x.shape[:-1], -1)
        return jnp.concatenate([x[..., :start], x[..., stop:], features], axis=-1)

    return Network(init=init, apply=apply)


def make_critics(
    obs: int,
    actions: int,
    layers: Sequence[int],
    count: int = 2,
    outputs: int = 1,
    activation: str = "relu",
    layer_norm: bool = False,
) -> Network:
    """Several critics: `apply(params, obs, action) -> (critic, batch, outputs)`; params lead with the axis `critic`."""
    module = mlp((*layers, outputs), activation, layer_norm)

    def init(key: Any) -> Any:
        one = jnp.zeros((1, obs + actions))
        # One set of weights with a leading axis: all critics are one batched product.
        return jax.vmap(lambda k: module.init(k, one))(jax.random.split(key, count))

    def apply(params: Any, x: Any, action: Any) -> Any:
        return jax.vmap(module.apply, in_axes=(0, None))(params, jnp.concatenate([x, action], axis=-1))

    return Network(init=init, apply=apply)


def first_critic(params: Any) -> Any:
    """The parameters of the first critic alone, still with the leading axis."""
    # The axis stays, so that the same function applies them.
    return jax.tree.map(lambda a: a[:1], params)
