"""How the rover's sensors err (port `sensor`): clocks, scales, biases, lags and quantisation of the log channels."""

from __future__ import annotations

import re
from typing import Any

import jax
import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, effect
from lunar_mjx.effects.sensor.channels import FAMILIES, QUATERNION, Signals, lag, shifted

_GRAVITY_MEMS = "choice: MEMS accelerometer, 2 mg"


def _matching(signals: Signals, pattern: str) -> list[str]:
    return [name for name in signals.channels if re.fullmatch(pattern, name)]


def _entry(value: Any, index: int) -> Any:
    """One joint's value of a parameter that is one number for all joints, or one for each."""
    value = jnp.asarray(value)
    return value[index] if value.ndim else value


def _offset(name: str) -> Parameter:
    return Parameter(
        0.05,
        0.0,
        (-5.0, 5.0),
        "s",
        f"how late the {name} channels are stamped",
        "choice: one telemetry interval at 20 Hz",
    )


_OFFSETS: dict[str, Any] = {name: _offset(name) for name in FAMILIES}


@effect("sensor", order=90, **_OFFSETS)
def clock_offset(ctx, p, x, signals):
    """Each family of channels is logged late by a constant: y_m(t) = y(t - delta), by cubic Hermite interpolation.

    Families: odometry (position, attitude, velocity), imu, joint (angles, speeds), electrical (motor currents,
    voltages, torques, bus), temperature, wheel (sinkage, slip, forces). Before the first sample the channel goes on
    straight. Source: mujoco.sysid treats a delay as a parameter of the measurement.
    """
    # Behind the instruments' own errors: a late stamp shifts what was read, bias and scale included.
    return shifted(signals, {name: getattr(p, name) for name in FAMILIES})


def _rate(name: str) -> Parameter:
    return Parameter(
        1e-3,
        0.0,
        (-0.1, 0.1),
        "1",
        f"drift of the {name} clock, s per s",
        "choice: exaggerated; crystals drift by 1e-5 to 1e-4",
    )


_RATES: dict[str, Any] = {name: _rate(name) for name in FAMILIES}


@effect("sensor", order=91, **_RATES)
def clock_drift(ctx, p, x, signals):
    """Each family's clock drifts: y_m(t) = y(t - eps (t - t_0)) with t_0 the first sample; families as clock_offset."""
    # From the first sample, since nobody knows when a clock was set; the offset there is clock_offset's.
    since = ctx.time - ctx.time[..., :1]
    return shifted(signals, {name: getattr(p, name) * since for name in FAMILIES})


_SCALED = {
    "position": r"position_[xyz]_m",
    "velocity": r"(world|body)_velocity_[xyz]_m_s",
    "gyro": r"gyro_[xyz]_rad_s",
    "accelerometer": r"accelerometer_[xyz]_m_s2",
    "angle": r"joint_.*_angle_rad",
    "speed": r"joint_.*_speed_rad_s",
    "current": r"motor_.*_current_A",
    "voltage": r"motor_.*_voltage_V|bus_voltage_V",
    "torque": r"motor_.*_torque_Nm",
    "sinkage": r"wheel_.*_sinkage_m",
    "force": r"wheel_.*_(force|moment)_[xyz]_Nm?",
}
"""Quantities that share a scale error, by parameter."""


def _scale(name: str) -> Parameter:
    return Parameter(0.02, 0.0, (-0.5, 0.5), "1", f"relative scale error of {name}", "choice: 2 %")


_SCALES: dict[str, Any] = {name: _scale(name) for name in _SCALED}


@effect("sensor", order=40, **_SCALES)
def channel_scale(ctx, p, x, signals):
    """Each quantity reads y (1 + eps); a position by its distance from the first sample (visual odometry)."""
    changed = {}
    for quantity, pattern in _SCALED.items():
        error = getattr(p, quantity)
        for name in _matching(signals, pattern):
            value = jnp.asarray(signals.channels[name])
            # Visual odometry measures motion: its scale error grows with the distance from the start and leaves the
            # start.
            base = value - value[..., :1] if quantity == "position" else value
            changed[name] = value + error * base
    return signals.with_channels(changed)


_STEPPED = {
    "angle": r"joint_.*_angle_rad",
    "speed": r"joint_.*_speed_rad_s",
    "current": r"motor_.*_current_A",
    "voltage": r"motor_.*_voltage_V|bus_voltage_V",
    "temperature": r"(winding|housing)_.*_temperature_degC",
}


def _step(nominal: float, unit: str, name: str, source: str) -> Parameter:
    return Parameter(nominal, 0.0, (0.0, 10.0), unit, f"least step of the {name} reading", source)


@effect(
    "sensor",
    order=95,
    angle=_step(2.0 * 3.141592653589793 / 4096, "rad", "joint angle", "12 bit encoder at the joint"),
    speed=_step(0.01, "rad/s", "joint speed", "choice: 12 bit encoder, differences over 0.15 s"),
    current=_step(0.01, "A", "current", "12 bit over 40 A"),
    voltage=_step(0.02, "V", "voltage", "12 bit over 80 V"),
    temperature=_step(0.1, "K", "temperature", "choice: 12 bit over 400 K"),
)
def encoder_quantisation(ctx, p, x, signals):
    """y_m = step round(y/step), without dither.

    The derivative by a step is zero by construction (what it truly is almost everywhere is of no use), so no score test
    sees this effect; to derivatives by anything else the reading follows the truth.
    """
    changed = {}
    for quantity, pattern in _STEPPED.items():
        step = jax.lax.stop_gradient(jnp.asarray(getattr(p, quantity)))
        has_step = step > 0.0
        safe = jnp.where(has_step, step, 1.0)
        for name in _matching(signals, pattern):
            value = jnp.asarray(signals.channels[name])
            error = jnp.where(has_step, safe * jnp.round(value / safe) - value, 0.0)
            changed[name] = value + jax.lax.stop_gradient(error)
    return signals.with_channels(changed)


@effect(
    "sensor",
    order=30,
    heading=Parameter(
        0.002,
        0.0,
        (-0.5, 0.5),
        "rad/m",
        "turn of the odometry's heading per distance travelled",
        "choice: visual odometry, 0.1 deg/m",
    ),
    vertical=Parameter(
        0.01, 0.0, (-0.5, 0.5), "1", "rise of the odometry per distance travelled", "choice: visual odometry, 1 %"
    ),
)
def odometry_drift(ctx, p, x, signals):
    """Dead reckoning drifts: each increment of position is turned by psi = k s, and z rises by k_z s.

    s is the distance travelled in the plane since the first sample. Yaw drifts by psi as well.
    """
    # All three or none: a drift of the heading mixes x and y, so one alone could not be turned.
    names = [f"position_{a}_m" for a in "xyz"]
    if not set(names) <= signals.channels.keys():
        return signals
    px, py, pz = (jnp.asarray(signals.channels[n]) for n in names)
    dx, dy = jnp.diff(px, axis=-1), jnp.diff(py, axis=-1)
    length = _length(dx, dy)
    travelled = _running_sum(length)
    # The turn in the middle of an increment: taken at its end the error would be of first order in the sampling.
    half_way = travelled[..., 1:] - 0.5 * length
    turn = p.heading * half_way
    less = -2.0 * jnp.sin(0.5 * turn) ** 2  # cos - 1 without loss of digits
    changed = {
        names[0]: px + _running_sum(less * dx - jnp.sin(turn) * dy),
        names[1]: py + _running_sum(jnp.sin(turn) * dx + less * dy),
        names[2]: pz + p.vertical * travelled,
    }
    if "yaw_deg" in signals.channels:
        changed["yaw_deg"] = signals.channels["yaw_deg"] + jnp.rad2deg(p.heading * travelled)
    return signals.with_channels(changed)


def _length(dx: Any, dy: Any) -> Any:
    """Euclidean length with a finite derivative where it is zero."""
    square = dx * dx + dy * dy
    # The inner `where` keeps the root's infinite derivative at zero out of the gradient, which NaN times 0 would
    # poison.
    nonzero = square > 0.0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1.0)), 0.0)


def _running_sum(increments: Any) -> Any:
    """Cumulative sum that begins with zero; one entry more than the increments."""
    return jnp.concatenate([jnp.zeros_like(increments[..., :1]), jnp.cumsum(increments, axis=-1)], axis=-1)


def _bias(axis: str, sensor: str, nominal: float, unit: str, source: str) -> Parameter:
    bound = 5.0 if sensor == "accelerometer" else 1.0
    return Parameter(nominal, 0.0, (-bound, bound), unit, f"bias of the {sensor} along {axis}", source)


def _angle(meaning: str) -> Parameter:
    return Parameter(0.0087, 0.0, (-0.5, 0.5), "rad", meaning, "choice: 0.5 deg of mounting tolerance")


_BIASES: dict[str, Any] = {
    **{f"accelerometer_{a}": _bias(a, "accelerometer", 0.02, "m/s2", _GRAVITY_MEMS) for a in "xyz"},
    **{f"gyro_{a}": _bias(a, "gyro", 0.001, "rad/s", "choice: MEMS gyro, 200 deg/h") for a in "xyz"},
}


@effect(
    "sensor",
    order=20,
    **_BIASES,
    roll=_angle("roll of the mounted IMU about body x"),
    pitch=_angle("pitch of the mounted IMU about body y"),
    roll_bias=_angle("bias of the attitude's roll"),
    pitch_bias=_angle("bias of the attitude's pitch"),
)
def imu_bias(ctx, p, x, signals):
    """The IMU is mounted askew and biased: f_m = R^T f + b, omega_m = R^T omega + b, R = R_y(pitch) R_x(roll).

    The attitude reads roll + b_r and pitch + b_p (alpha_m = alpha + b), and the quaternion q R_y(b_p) R_x(b_r).
    """
    changed = {}
    for sensor, unit in (("accelerometer", "m_s2"), ("gyro", "rad_s")):
        names = [f"{sensor}_{a}_{unit}" for a in "xyz"]
        if set(names) <= signals.channels.keys():
            turned = _turn_back(p.roll, p.pitch, [signals.channels[n] for n in names])
            biases = [getattr(p, f"{sensor}_{a}") for a in "xyz"]
            changed.update({n: v + b for n, v, b in zip(names, turned, biases, strict=True)})
    for name, bias in (("roll_deg", p.roll_bias), ("pitch_deg", p.pitch_bias)):
        # Angles add only for small biases; the quaternion below is turned exactly.
        if name in signals.channels:
            changed[name] = signals.channels[name] + jnp.rad2deg(bias)
    if set(QUATERNION) <= signals.channels.keys():
        q = _turned_quaternion([signals.channels[c] for c in QUATERNION], p.roll_bias, p.pitch_bias)
        changed.update(zip(QUATERNION, q, strict=True))
    return signals.with_channels(changed)


def _turn_back(roll: Any, pitch: Any, v: list[Any]) -> list[Any]:
    """R_x(roll)^T R_y(pitch)^T v."""
    cp, sp, cr, sr = jnp.cos(pitch), jnp.sin(pitch), jnp.cos(roll), jnp.sin(roll)
    across, up = cp * v[0] - sp * v[2], sp * v[0] + cp * v[2]
    return [across, cr * v[1] + sr * up, cr * up - sr * v[1]]


def _turned_quaternion(q: list[Any], roll: Any, pitch: Any) -> list[Any]:
    """q times a pitch about body y and a roll about the body x that this gives."""
    c, s = jnp.cos(0.5 * pitch), jnp.sin(0.5 * pitch)
    # Products written out: four channels of a log come as four arrays, with leading axes of a batch.
    w, x, y, z = q[0] * c - q[2] * s, q[1] * c - q[3] * s, q[2] * c + q[0] * s, q[3] * c + q[1] * s
    c, s = jnp.cos(0.5 * roll), jnp.sin(0.5 * roll)
    return [w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s]


@effect(
    "sensor",
    order=10,
    winding=Parameter(
        5.0,
        0.0,
        (0.0, 1e3),
        "s",
        "time constant of the winding's thermistor",
        "choice: thermistor potted into the winding",
    ),
    housing=Parameter(
        20.0,
        0.0,
        (0.0, 1e3),
        "s",
        "time constant of the housing's thermistor",
        "choice: thermistor glued to the housing",
    ),
    self_heating=Parameter(
        0.2,
        0.0,
        (0.0, 20.0),
        "K",
        "rise of a thermistor by its own measuring current",
        "choice: 0.2 mW at 1 mW/K, in vacuum",
    ),
)
def thermistor_lag(ctx, p, x, signals):
    """tau dT_m/dt = T + dT - T_m, from equilibrium at the first sample; exact for T straight between the samples."""
    changed = {}
    for node in ("winding", "housing"):
        names = _matching(signals, rf"{node}_.*_temperature_degC")
        if names:
            values = jnp.stack([jnp.asarray(signals.channels[name]) for name in names], axis=-2)
            # Self-heating is added after the lag: the measuring current has flowed since long before the log.
            late = lag(jnp.asarray(signals.time)[..., None, :], values, getattr(p, node)) + p.self_heating
            changed.update({name: late[..., i, :] for i, name in enumerate(names)})
    return signals.with_channels(changed)


@effect(
    "sensor",
    order=0,
    resistance=Parameter(
        0.2,
        0.0,
        (0.0, 20.0),
        "ohm",
        "resistance of the harness to a motor",
        "5 m of AWG 24 copper out and back at 25 degC: 0.84 ohm; thicker wire chosen",
        axis="joint",
    ),
)
def harness_resistance(ctx, p, x, signals):
    """The voltage read at the amplifier is V_m = V + R_w I; a motor with controlled current does not feel it.

    With voltage_saturation in the list the amplifier has to give this voltage too.
    """
    changed = {}
    for i, joint in enumerate(ctx.joints):
        voltage, current = f"motor_{joint}_voltage_V", f"motor_{joint}_current_A"
        if {voltage, current} <= signals.channels.keys():
            changed[voltage] = signals.channels[voltage] + _entry(p.resistance, i) * signals.channels[current]
    return signals.with_channels(changed)


@effect(
    "sensor",
    order=25,
    axis=Parameter(
        0.01, 0.0, (-0.2, 0.2), "1", "cross-axis sensitivity of the IMU", "choice: MEMS datasheets, 1 to 2 %"
    ),
    current=Parameter(
        0.05,
        0.0,
        (-10.0, 10.0),
        "K/A",
        "temperature read per ampere of motor current",
        "choice: 0.5 mV/A of common ground over 10 mV/K",
    ),
)
def cross_talk(ctx, p, x, signals):
    """A channel hears its neighbour: x + k y, y + k z, z + k x of the IMU's axes; T + k_I |I| of the winding."""
    changed = {}
    for sensor, unit in (("accelerometer", "m_s2"), ("gyro", "rad_s")):
        names = [f"{sensor}_{a}_{unit}" for a in "xyz"]
        if set(names) <= signals.channels.keys():
            for name, other in zip(names, names[1:] + names[:1], strict=True):
                changed[name] = signals.channels[name] + p.axis * signals.channels[other]
    for joint in ctx.joints:
        name, current = f"winding_{joint}_temperature_degC", f"motor_{joint}_current_A"
        if {name, current} <= signals.channels.keys():
            changed[name] = signals.channels[name] + p.current * jnp.abs(signals.channels[current])
    return signals.with_channels(changed)
