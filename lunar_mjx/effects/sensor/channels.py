"""Log channels over time: what the port `sensor` receives and returns, and the operations that sensors share.

The time axis is the last one; leading axes, if any, are a batch (a rover or a hypothesis each).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from lunar_mjx.effects.context import RoverInfo
from lunar_mjx.pytree import AnyArray, pytree, static

FAMILIES = ("odometry", "imu", "joint", "electrical", "temperature", "wheel")
"""Channels that share one clock; commands belong to none, since nothing measures them."""

_FAMILY_OF = {
    "position": "odometry",
    "world": "odometry",
    "body": "odometry",
    "quaternion": "odometry",
    "roll": "odometry",
    "pitch": "odometry",
    "yaw": "odometry",
    "gyro": "imu",
    "accelerometer": "imu",
    "joint": "joint",
    "motor": "electrical",
    "bus": "electrical",
    "battery": "electrical",
    "winding": "temperature",
    "housing": "temperature",
    "chassis": "temperature",
    "wheel": "wheel",
    "drawbar": "wheel",
}
EULER = ("roll_deg", "pitch_deg", "yaw_deg")
QUATERNION = tuple(f"quaternion_{c}" for c in "wxyz")


@pytree
class Signals:
    """Value of the port `sensor`: channels by their name in a log, in the unit that the name says.

    Attributes:
      time: of the samples, s, rising.
      channels: values at these times, by channel name.
    """

    time: Float[AnyArray, "*batch time"]
    channels: dict[str, Float[AnyArray, "*batch time"]]

    def with_channels(self, changed: dict[str, Any]) -> Signals:
        """These signals with some channels changed or added."""
        return dataclasses.replace(self, channels={**self.channels, **changed})


@pytree
class SensorContext:
    """What the port `sensor` sees beside its value.

    Attributes:
      time: of the samples, s.
      gravity: m/s2, positive.
      ambient_temperature: at the samples, K.
      rover: the rover as drawn.
      parameters: every effect's parameters, by effect and name.
      joints: how channels name the actuated joints, such as `lf_drive`, in the order of the controls.
      wheels: how channels name the wheels, such as `lf`.
    """

    time: Float[AnyArray, "*batch time"]
    gravity: Any
    ambient_temperature: Any
    rover: RoverInfo
    parameters: Any
    joints: tuple[str, ...] = static()
    wheels: tuple[str, ...] = static()


def family(channel: str) -> str | None:
    """The family of a channel, or None for commands and other channels that no sensor of the rover gives."""
    return _FAMILY_OF.get(channel.partition("_")[0])


def slope(values: Float[AnyArray, "*batch time"], time: Float[AnyArray, "*batch time"]) -> Any:
    """Central difference quotient by time, one-sided at the ends; zero where there is a single sample.

    It is the mean rate over the two intervals around a sample, of second order where these are equal.
    """
    values, time = jnp.asarray(values), jnp.asarray(time)
    count = values.shape[-1]
    if count < 2:
        return jnp.zeros_like(values)
    before = jnp.concatenate([values[..., :1], values[..., :-1]], axis=-1)
    after = jnp.concatenate([values[..., 1:], values[..., -1:]], axis=-1)
    t_before = jnp.concatenate([time[..., :1], time[..., :-1]], axis=-1)
    t_after = jnp.concatenate([time[..., 1:], time[..., -1:]], axis=-1)
    return (after - before) / (t_after - t_before)


def unwrapped(channel: str, signals: Signals) -> Any:
    """A channel without its jumps: Euler angles go on beyond 180 deg, a quaternion keeps its sign.

    Args:
      channel: its name.
      signals: with that channel, and with the whole quaternion where the channel is a part of one.

    Returns:
      (..., time), equal to the channel at the first sample.
    """
    sign = quaternion_signs(signals) if channel in QUATERNION else 1.0
    return _smooth(channel, jnp.asarray(signals.channels[channel]), sign)


def _smooth(channel: str, values: Any, sign: Any) -> Any:
    if channel in EULER:
        return jnp.unwrap(values, period=360.0)
    return values * sign if channel in QUATERNION else values


def quaternion_signs(signals: Signals) -> Any:
    """+1 or -1 at every sample: the factor that makes the quaternion continuous from its first sample on."""
    parts = [jnp.asarray(signals.channels[c]) for c in QUATERNION]
    # Neighbours of one attitude have a positive scalar product, unless one of them has the other sign.
    turn = sum(p[..., 1:] * p[..., :-1] for p in parts)
    flips = jnp.where(turn < 0.0, -1.0, 1.0).astype(parts[0].dtype)
    first = jnp.ones_like(parts[0][..., :1])
    return jnp.cumprod(jnp.concatenate([first, flips], axis=-1), axis=-1)


def wrapped_degrees(angle: Any) -> Any:
    """An angle in (-180, 180] deg; one that lies there already is returned bit for bit."""
    return jnp.where(jnp.abs(angle) > 180.0, angle - 360.0 * jnp.ceil(angle / 360.0 - 0.5), angle)


def _segment(time: Any, at: Any) -> Any:
    """Index of the interval in which each time lies, the outermost one for times outside."""
    count = time.shape[-1]
    if time.ndim == 1:
        index = jnp.searchsorted(time, at, side="right") - 1
    else:
        at = jnp.broadcast_to(at, (*jnp.broadcast_shapes(time.shape[:-1], at.shape[:-1]), at.shape[-1]))
        index = jnp.sum(time[..., None, :] <= at[..., :, None], axis=-1) - 1
    return jnp.clip(index, 0, max(count - 2, 0))


def _take(values: Any, index: Any) -> Any:
    if values.ndim == 1:
        return values[index]
    shape = jnp.broadcast_shapes(values.shape[:-1], index.shape[:-1])
    values = jnp.broadcast_to(values, (*shape, values.shape[-1]))
    return jnp.take_along_axis(values, jnp.broadcast_to(index, (*shape, index.shape[-1])), axis=-1)


def interpolate(time: Any, values: Any, at: Any) -> Any:
    """Straight lines between the samples, and their continuation outside; (..., len(at))."""
    time, values, at = jnp.asarray(time), jnp.asarray(values), jnp.asarray(at)
    if values.shape[-1] < 2:
        return jnp.broadcast_to(values, (*values.shape[:-1], at.shape[-1]))
    i = _segment(time, at)
    t0, t1, y0, y1 = _take(time, i), _take(time, i + 1), _take(values, i), _take(values, i + 1)
    return y0 + (at - t0) / (t1 - t0) * (y1 - y0)


def shift_smoothly(time: Any, values: Any, at: Any) -> Any:
    """Cubic Hermite interpolation with central slopes, continued by straight lines outside.

    Its derivative by time is the central difference quotient at every sample, where the one of straight lines jumps:
    the derivative by a small offset of the clock is then right to second order of the sampling interval.
    """
    time, values, at = jnp.asarray(time), jnp.asarray(values), jnp.asarray(at)
    if values.shape[-1] < 2:
        return jnp.broadcast_to(values, (*values.shape[:-1], at.shape[-1]))
    rate = slope(values, time)
    i = _segment(time, at)
    t0, t1, y0, y1 = _take(time, i), _take(time, i + 1), _take(values, i), _take(values, i + 1)
    m0, m1, h = _take(rate, i), _take(rate, i + 1), t1 - t0
    s = jnp.where(at < t0, 0.0, jnp.where(at > t1, 1.0, (at - t0) / h))
    inside = y0 + s * s * (3.0 - 2.0 * s) * (y1 - y0) + h * s * (1.0 - s) * ((1.0 - s) * m0 - s * m1)
    return jnp.where(at < t0, y0 + (at - t0) * m0, jnp.where(at > t1, y1 + (at - t1) * m1, inside))


def shifted(signals: Signals, offset_of: dict[str, Any]) -> Signals:
    """Signals whose channels of each family are those of earlier times; angles wrap and quaternions flip as before.

    Args:
      signals: of one trajectory or a batch.
      offset_of: how much earlier, s, by family: one number, or one per sample.

    Returns:
      Signals at the same times.
    """
    families = {name: f for name in signals.channels if (f := family(name)) is not None and f in offset_of}
    if not families:
        return signals
    whole = set(QUATERNION) <= signals.channels.keys()
    sign = quaternion_signs(signals) if whole else 1.0
    time = jnp.asarray(signals.time)
    old = {name: jnp.asarray(signals.channels[name]) for name in families}
    smooth = jnp.stack([_smooth(name, value, sign) for name, value in old.items()], axis=-2)
    late = [jnp.broadcast_to(jnp.asarray(offset_of[f]), time.shape) for f in families.values()]
    at = time[..., None, :] - jnp.stack(late, axis=-2)
    moved = shift_smoothly(time if time.ndim == 1 else time[..., None, :], smooth, at)
    change = moved - smooth
    out = {}
    for i, (name, value) in enumerate(old.items()):
        if name in EULER:
            out[name] = wrapped_degrees(value + change[..., i, :])
        else:
            out[name] = moved[..., i, :] * (sign if name in QUATERNION else 1.0)
    return signals.with_channels(out)


def lag(time: Any, values: Any, constant: Any) -> Any:
    """Output y of tau dy/dt = u - y with y = u at the first sample, exact for an input of straight lines.

    Its derivative by tau at tau = 0 is minus the slope of the input, hence seen by a score test.

    Args:
      time: (..., time), s.
      values: (..., time) input u.
      constant: tau, s, zero or more.

    Returns:
      (..., time).
    """
    time, values = jnp.asarray(time), jnp.asarray(values)
    if values.shape[-1] < 2:
        return values
    step = jnp.diff(time, axis=-1)
    has_lag = constant > 0.0
    safe = jnp.where(has_lag, constant, 1.0)
    # At tau = 0 the output is the input: no memory, and a finite derivative.
    decay = jnp.where(has_lag, jnp.exp(-step / safe), 0.0)
    behind = constant * jnp.diff(values, axis=-1) / step
    # e = u - y obeys e_k = decay e_(k-1) + behind (1 - decay)
    decay, source = jnp.broadcast_arrays(decay, behind * (1.0 - decay))

    def chain(first: Any, second: Any) -> Any:
        return first[0] * second[0], first[1] * second[0] + second[1]

    # A parallel scan: the recursion is linear, so that a log of n samples takes log n rounds on a GPU.
    error = jax.lax.associative_scan(chain, (decay, source), axis=-1)[1]
    return values - jnp.concatenate([jnp.zeros_like(values[..., :1]), error], axis=-1)
