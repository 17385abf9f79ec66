"""What differs from rover to rover: any parameter of any effect, gravity, ambient and starting temperature."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.dynamics import Params
from lunar_mjx.errors import bad_input, require_finite
from lunar_mjx.model import Model
from lunar_mjx.pytree import pytree, static, tree_of

SCALES = ("uniform", "log")
_TRIES = 16
"""Draws from a posterior, of which the first within all bounds counts: even where every fourth alone is, one rover of a
hundred gets none, and is put at the bounds."""
_LEAST = 1e-30
"""Least value of what is drawn by its logarithm, in SI units: positive in single precision."""


@dataclasses.dataclass(frozen=True)
class Range:
    """One parameter drawn anew for every episode.

    Attributes:
      parameter: `effect.parameter`, `gravity` (m/s2), `ambient` (K, constant over the episode) or
        `winding_temperature` (K, of all motors at the start), in SI units.
      low, high: bounds of the draw.
      scale: "uniform" or "log".
      relative: bounds are factors of the model's own value.
    """

    parameter: str
    low: float
    high: float
    scale: str = "uniform"
    relative: bool = False

    def __post_init__(self) -> None:
        where = f"randomise.{self.parameter}"
        for field in ("low", "high"):
            require_finite(where, field, getattr(self, field))
        if self.low > self.high:
            raise bad_input(where, "low", self.low, f"is above high = {self.high}", "swap the two")
        if self.scale not in SCALES:
            raise bad_input(where, "scale", self.scale, "does not exist", f"use one of {', '.join(SCALES)}")
        if self.scale == "log" and self.low <= 0.0:
            raise bad_input(where, "low", self.low, "is not positive on a log scale", "give bounds above zero")


@pytree
class Spread:
    """A model's posterior as arrays; others of the same parameters need no new compilation.

    Attributes:
      parameters: `effect.parameter` of each. log: of each, whether its logarithm is drawn.
      factor: (parameter, parameter) that makes deviations of standard normal numbers.
      low, high: (parameter,) bounds of the deviations, so that values stay within those of their effects.
    """

    parameters: tuple[str, ...] = static()
    log: tuple[bool, ...] = static()
    factor: Any
    low: Any
    high: Any


def spread_of(model: Model, source: str = "navigation") -> Spread:
    """The posterior that a model holds, made ready to be drawn from.

    Raises:
      UserError: the model holds none.
    """
    posterior = model.posterior
    if posterior is None:
        remedy = "give --env model=RUN/fitted.toml, which `lunar-mjx compare` writes"
        raise bad_input(source, "posterior", True, "does not go with a model without [posterior]", remedy)
    low, high = [], []
    for name, log in zip(posterior.parameters, posterior.log, strict=True):
        effect, _, parameter = name.partition(".")
        value = np.asarray(model.parameters[effect][parameter], float)
        bounds = next(e for e in model.effects if e.name == effect).parameters[parameter].bounds
        # The first wheel or joint that reaches its bound ends the deviation, which is one for all of them.
        # However wide the posterior, an exponential must not become zero.
        least = max(bounds[0], _LEAST) if log else bounds[0]
        ends = [np.log(b) - np.log(value) if log else b - value for b in (least, bounds[1])]
        low.append(np.max(ends[0]))
        high.append(np.min(ends[1]))
    arrays = (jnp.asarray(a, jnp.result_type(float)) for a in (posterior.factor(), low, high))
    return Spread(posterior.parameters, posterior.log, *arrays)


def check_ranges(model: Model, ranges: Sequence[Range], source: str = "navigation") -> None:
    """Refuses ranges that the model has no parameter for, or that leave a parameter's bounds.

    Raises:
      UserError: names the range.
    """
    seen = set()
    for r in ranges:
        if r.parameter in seen:
            raise bad_input(source, "randomise", r.parameter, "stands there twice", "give each parameter one range")
        seen.add(r.parameter)
        if r.parameter in ("gravity", "ambient", "winding_temperature"):
            if r.low <= 0.0:
                raise bad_input(source, f"randomise.{r.parameter}", r.low, "is not positive", "give a positive value")
            continue
        effect, _, name = r.parameter.partition(".")
        owner = next((e for e in model.effects if e.name == effect), None)
        if owner is None or name not in owner.parameters:
            known = ", ".join(f"{e.name}.{k}" for e in model.effects for k in e.parameters)
            raise bad_input(source, "randomise", r.parameter, "is no parameter of the model", f"use one of {known}")
        value = np.asarray(model.parameters[effect][name], float)
        for bound in (r.low, r.high):
            for number in np.ravel(value * bound if r.relative else bound):
                # Both ends are checked as any value of the model is: a draw then cannot leave the bounds.
                owner.check(name, float(number), f"{source}, randomise")


def draw(
    ranges: Sequence[Range], params: Params, bounds: Float[Array, "range 2"], keys: Float[Array, "env 2"]
) -> dict[str, Any]:
    """Draws every range for every environment.

    Args:
      ranges: what to draw. bounds: low and high of each, as arrays, so that other bounds need no new compilation.
      params: the model's own values.
      keys: raw random keys, one per environment.

    Returns:
      Values by parameter with the leading axis `env`; relative draws are multiplied out.
    """
    if not ranges:
        return {}
    share = jax.vmap(lambda k: jax.random.uniform(k, (len(ranges),)))(keys)
    drawn = {}
    for i, r in enumerate(ranges):
        low, high = bounds[i, 0], bounds[i, 1]
        if r.scale == "log":
            value = jnp.exp(jnp.log(low) + share[:, i] * (jnp.log(high) - jnp.log(low)))
        else:
            value = low + share[:, i] * (high - low)
        if r.relative:
            own = _own(params, r.parameter)
            # One factor for all wheels or joints: they differ as a set, from rover to rover.
            value = value.reshape(-1, *([1] * own.ndim)) * own
        drawn[r.parameter] = value
    return drawn


def draw_spread(spread: Spread, params: Params, keys: Float[Array, "env 2"]) -> dict[str, Any]:
    """Draws from a posterior for every environment: a normal distribution cut off at the parameters' bounds.

    Args:
      spread: of the posterior, about the model's own values. params: those. keys: raw random keys, one per environment.

    Returns:
      Values by parameter with the leading axis `env`.
    """
    count = len(spread.parameters)
    normal = jax.vmap(lambda k: jax.random.normal(k, (_TRIES, count)))(keys)
    # Exact products: with a GPU's short factors strongly correlated parameters would come apart.
    tried = jnp.einsum("etj,ij->eti", normal, spread.factor, precision=jax.lax.Precision.HIGHEST)
    inside = ((tried >= spread.low) & (tried <= spread.high)).all(-1)
    first = jnp.argmax(inside, axis=1)
    deviation = jnp.clip(jnp.take_along_axis(tried, first[:, None, None], axis=1)[:, 0], spread.low, spread.high)
    drawn = {}
    for i, (name, log) in enumerate(zip(spread.parameters, spread.log, strict=True)):
        own = _own(params, name)
        # One deviation for all wheels or joints, as the fit had it.
        by = deviation[:, i].reshape(-1, *([1] * own.ndim))
        drawn[name] = own * jnp.exp(by) if log else own + by
    return drawn


def _own(params: Params, parameter: str) -> Any:
    if parameter == "gravity":
        return jnp.asarray(params.gravity)
    if parameter in ("ambient", "winding_temperature"):
        return jnp.asarray(params.ambient.noon)
    effect, _, name = parameter.partition(".")
    return params.effects[effect][name]


def apply(params: Params, drawn: dict[str, Any]) -> tuple[Params, Any]:
    """Puts the drawn values into the parameters.

    Returns:
      The parameters, and their axes as `System.step_batch` wants them: None if nothing differs between rovers.
    """
    if not drawn:
        return params, None
    effects = {e: dict(values) for e, values in params.effects.items()}
    axes: dict[str, dict[str, Any]] = {e: dict.fromkeys(values) for e, values in params.effects.items()}
    gravity, gravity_axis, ambient, ambient_axis = params.gravity, None, params.ambient, None
    for parameter, value in drawn.items():
        if parameter == "gravity":
            gravity, gravity_axis = value, 0
        elif parameter == "ambient":
            ambient = dataclasses.replace(
                params.ambient,
                # Noon and night alike: within an episode of minutes the lunar day stands still.
                noon=value,
                night=value,
                noon_time=jnp.broadcast_to(params.ambient.noon_time, value.shape),
                period=jnp.broadcast_to(params.ambient.period, value.shape),
            )
            ambient_axis = 0
        # That one is a state and no parameter; reset takes it.
        elif parameter != "winding_temperature":
            effect, _, name = parameter.partition(".")
            effects[effect][name] = value
            axes[effect][name] = 0
    new = dataclasses.replace(params, gravity=gravity, ambient=ambient, effects=effects)
    return new, tree_of(Params, gravity=gravity_axis, ambient=ambient_axis, effects=axes, terrain=None)
