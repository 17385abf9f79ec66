"""What the rover's sensors say about a simulated drive: telemetry as log channels, and the effects at port `sensor`.

All of it is pure JAX, so that derivatives reach the measured channels. The time axis is the last one; a batch leads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Float

from lunar_mjx.dynamics.bus import BUS_CURRENT, BUS_VOLTAGE, bus_current
from lunar_mjx.dynamics.quaternions import rotation
from lunar_mjx.dynamics.state import Params, Telemetry
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.sensor.channels import (
    EULER,
    QUATERNION,
    SensorContext,
    Signals,
    interpolate,
    quaternion_signs,
    slope,
    unwrapped,
    wrapped_degrees,
)
from lunar_mjx.errors import bad_input
from lunar_mjx.model import ZERO_CELSIUS
from lunar_mjx.pytree import AnyArray
from lunar_mjx.rover import Rover
from lunar_mjx.spatial import Frame, Vec3

if TYPE_CHECKING:
    from lunar_mjx.dynamics.system import System

__all__ = [
    "SensorContext",
    "Signals",
    "apply_sensors",
    "joint_channels",
    "measure",
    "observe",
    "sample_signals",
    "sensor_context",
]

_RAD_TO_DEG = 57.29577951308232
"""deg; one radian, 180/pi."""


def joint_channels(rover: Rover) -> list[str]:
    """Corner and kind of every actuated joint in the order of the controls: `lf_drive`, `lf_steer`, `lf_sus`, ...

    A joint that belongs to no single wheel goes by its own name.
    """
    names = {}
    for wheel in rover.wheels:
        for joint, kind in ((wheel.drive, "drive"), (wheel.steer, "steer"), (wheel.suspension, "sus")):
            if joint is not None:
                names[joint] = joint if joint in names else f"{wheel.corner}_{kind}"
    return [names.get(joint, joint) for joint in rover.joints]


def side_channels(rover: Rover) -> dict[str, tuple[str, ...]]:
    """Channels of sides that one motor drives, by name, and those of their wheels whose sum (currents) or mean
    (speeds, angles) they are; none of a rover whose motors drive a wheel each."""
    names, found = dict(zip(rover.joints, joint_channels(rover), strict=True)), {}
    for group in rover.drive_groups:
        wheels = [names[j] for j in group.joints]
        side, *others = {w.side for w in rover.wheels if w.drive in group.joints}
        if others or not side:
            continue
        for pattern in ("motor_{}_drive_current_A", "joint_{}_drive_speed_rad_s", "joint_{}_drive_angle_rad"):
            found[pattern.format(side)] = tuple(pattern.replace("_drive", "").format(w) for w in wheels)
    return found


def with_sides(rover: Rover, channels: Mapping[str, Any]) -> dict[str, Any]:
    """Channels of all wheels, and of sides that one motor drives."""
    out = dict(channels)
    for name, wheels in side_channels(rover).items():
        total = sum(channels[w] for w in wheels)
        out[name] = total if name.startswith("motor") else total / len(wheels)  # one motor's currents add up
    return out


def observe(
    system: System,
    telemetry: Telemetry,
    params: Params | None = None,
    imu_position: Sequence[float] | None = None,
    imu_quaternion: Sequence[float] | None = None,
    bus_voltage: Any = None,
) -> Signals:
    """The true channels of a drive: what perfect sensors with one clock would write.

    The accelerometer gives the specific force R^T (dv/dt + g z) in the body frame, at rest +g along body z; dv/dt is
    the central difference quotient of the velocities of neighbouring samples, the mean over the two intervals around
    one. Channels of the telemetry are passed on without loss of derivatives.

    Args:
      system: whose rover it is.
      telemetry: of `rollout` (time, ...) or `rollout_batch` (batch, time, ...).
      params: the parameters of the drive, for gravity (a number, or one per rover) and the current of the bus (see
        `bus.bus_current`); those of the model if None.
      imu_position: of the accelerometer in the chassis frame, m; the frame's origin if None.
      imu_quaternion: w, x, y, z from the IMU's axes to the chassis's, for the channels of gyroscope and accelerometer;
        the same axes if None.
      bus_voltage: by which the current of the bus is told, V, a number, (time,) or (batch, time); the model's own if
        None. Where neither is known there is no channel bus_current_A.

    Returns:
      Channels of shape (time,) or (batch, time), named as in a log.
    """
    params = system.params if params is None else params
    gravity = _felt_gravity(system.model.effects, params)
    gravity = gravity[..., None] if gravity.ndim else gravity
    corners = [w.corner for w in system.model.rover.wheels]
    seen = telemetry
    body = _body_frame(seen.quaternion)
    out: dict[str, Any] = {}
    _vector(out, "position_{}_m", seen.position)
    _vector(out, "world_velocity_{}_m_s", seen.velocity)
    _vector(out, "body_velocity_{}_m_s", body.from_world(seen.velocity))
    # Attitude is given in both forms: logs hold either, and a fit compares what its log holds.
    for i, name in enumerate(QUATERNION):
        out[name] = seen.quaternion[..., i]
    for name, part in zip(EULER, seen.euler, strict=True):
        out[name] = part * _RAD_TO_DEG
    spin, force = body.from_world(seen.angular_velocity), _specific_force(seen, body, gravity, imu_position)
    if imu_quaternion is not None:
        axes = _body_frame(jnp.asarray(imu_quaternion))
        spin, force = axes.from_world(spin), axes.from_world(force)
    _vector(out, "gyro_{}_rad_s", spin)
    _vector(out, "accelerometer_{}_m_s2", force)
    per_joint = {
        "joint_{}_angle_rad": seen.joint_angle,
        "joint_{}_speed_rad_s": seen.joint_speed,
        "motor_{}_torque_Nm": seen.joint_torque,
        "motor_{}_current_A": seen.current,
        "motor_{}_voltage_V": seen.voltage,
        "winding_{}_temperature_degC": seen.winding_temperature - ZERO_CELSIUS,
        "housing_{}_temperature_degC": seen.housing_temperature - ZERO_CELSIUS,
    }
    _entries(out, per_joint, joint_channels(system.model.rover))
    per_wheel = {
        "wheel_{}_sinkage_m": seen.sinkage,
        "wheel_{}_slip_ratio": seen.slip,
        "wheel_{}_slip_angle_deg": seen.slip_angle * _RAD_TO_DEG,
        **{f"wheel_{{}}_force_{a}_N": getattr(seen.wheel_force, a) for a in "xyz"},
        **{f"wheel_{{}}_moment_{a}_Nm": getattr(seen.wheel_moment, a) for a in "xyz"},
    }
    _entries(out, per_wheel, corners)
    if seen.supply is not None:
        supply = seen.supply
        kelvin = supply.chassis_temperature
        other_channels = {
            "bus_load_W": supply.load,
            "bus_solar_W": supply.solar,
            "battery_charge_ratio": supply.charge,
            BUS_VOLTAGE: supply.voltage,
            "chassis_temperature_degC": None if kelvin is None else kelvin - ZERO_CELSIUS,
        }
        out |= {name: value for name, value in other_channels.items() if value is not None}
    drawn = bus_current(seen, params, bus_voltage)
    if drawn is not None:
        out[BUS_CURRENT] = drawn
    return Signals(jnp.asarray(seen.time), {k: jnp.asarray(v) for k, v in out.items()})


def _vector(out: dict[str, Any], pattern: str, value: Vec3) -> None:
    for axis, part in zip("xyz", value, strict=True):
        out[pattern.format(axis)] = part


def _entries(out: dict[str, Any], values: dict[str, Any], names: Sequence[str]) -> None:
    """One channel for every entry of the last axis."""
    for pattern, value in values.items():
        for i, name in enumerate(names):
            out[pattern.format(name)] = value[..., i]


def _body_frame(quaternion: Float[AnyArray, "*batch time 4"]) -> Frame:
    """Axes of the chassis in world coordinates."""
    return rotation([quaternion[..., i] for i in range(4)])


def _felt_gravity(effects: Sequence[Effect], params: Params) -> Any:
    """Gravity after the effects at the port `geometry` that change it, m/s2."""
    gravity = jnp.asarray(params.gravity)
    # An accelerometer at rest shows the gravity that the rover feels, not the one that the model was told.
    if any(e.name == "gravity_error" for e in effects):
        gravity = gravity * (1.0 + params.effects["gravity_error"]["relative"])
    return gravity


def _specific_force(seen: Telemetry, body: Frame, gravity: Any, lever: Sequence[float] | None) -> Vec3:
    """R^T (a + g z) at the accelerometer, m/s2."""
    # as an IMU that averages over its interval: accelerations of single steps hold the jolts of contacts
    acceleration = Vec3(*(slope(v, seen.time) for v in seen.velocity))
    force = body.from_world(Vec3(acceleration.x, acceleration.y, acceleration.z + gravity))
    if lever is None:
        return force
    # the rate of the angular velocity is the same vector in the turning frame as in the world
    spin = body.from_world(seen.angular_velocity)
    rate = body.from_world(Vec3(*(slope(v, seen.time) for v in seen.angular_velocity)))
    arm = Vec3(*lever)
    return force + rate.cross(arm) + spin.cross(spin.cross(arm))


def sensor_context(system: System, signals: Signals, params: Params | None = None) -> SensorContext:
    """What effects at the port `sensor` see of a drive of this system."""
    used = system.params if params is None else params
    return SensorContext(
        time=signals.time,
        gravity=used.gravity,
        ambient_temperature=used.ambient_temperature(signals.time),
        rover=system.info,
        parameters={name: SimpleNamespace(**values) for name, values in used.effects.items()},
        joints=tuple(joint_channels(system.model.rover)),
        wheels=tuple(w.corner for w in system.model.rover.wheels),
    )


def apply_sensors(effects: Sequence[Effect], params: Params, signals: Signals, ctx: SensorContext) -> Signals:
    """Passes channels through the effects at the port `sensor`, by rising order; without any it returns them as given.

    Args:
      effects: of the model.
      params: parameters; a number each, or one per wheel or joint. For other parameters per trajectory use `vmap`.
      signals: true channels.
      ctx: from `sensor_context`.

    Returns:
      Measured channels at the same times.
    """
    # By rising order, as at every port: a delay comes before the quantisation of what it delays.
    for effect in sorted(effects, key=lambda e: e.order):
        port = effect.ports.get("sensor")
        if port is None:
            continue
        own = SimpleNamespace(**params.effects[effect.name])
        # Sensors see a whole drive at once, so that no state is carried from step to step: what they remember begins
        # anew with every log.
        memory = SimpleNamespace(**{k: v.initial for k, v in effect.state.items()})
        result = port(ctx, own, memory, signals)
        signals = result[0] if isinstance(result, tuple) else result
    return signals


def measure(
    system: System,
    telemetry: Telemetry,
    params: Params | None = None,
    imu_position: Sequence[float] | None = None,
    imu_quaternion: Sequence[float] | None = None,
    bus_voltage: Any = None,
) -> Signals:
    """What the rover's sensors write: `observe` with its arguments, and then the effects at the port `sensor`."""
    signals = observe(system, telemetry, params, imu_position, imu_quaternion, bus_voltage)
    used = system.params if params is None else params
    return apply_sensors(system.model.effects, used, signals, sensor_context(system, signals, params))


def sample_signals(signals: Signals, channel: str, times: Float[AnyArray, "*batch sample"]) -> Any:
    """A channel at other times, by straight lines between the samples (continued outside them).

    Euler angles take the short way over 180 deg and stay in (-180, 180]; quaternions are kept of one sign and of unit
    length.

    Args:
      signals: of one trajectory or a batch.
      channel: name of the channel.
      times: s.

    Returns:
      (..., sample).

    Raises:
      UserError: there is no such channel.
    """
    if channel not in signals.channels:
        raise bad_input(
            "sample_signals",
            "channel",
            channel,
            "is not among the signals",
            f"use one of {', '.join(list(signals.channels)[:6])}, ...",
        )
    if channel not in QUATERNION:
        value = interpolate(signals.time, unwrapped(channel, signals), times)
        return wrapped_degrees(value) if channel in EULER else value
    # q and -q are one attitude; a straight line between samples of opposite sign would pass through zero.
    sign = quaternion_signs(signals)
    parts = {c: interpolate(signals.time, sign * signals.channels[c], times) for c in QUATERNION}
    return parts[channel] / jnp.sqrt(sum(p * p for p in parts.values()))
