"""A log made ready to simulate: its model, its commands on whole time steps, and where the rover stands at first."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from lunar_mjx.diagnosis.drives.simulation.unmapped_ground import UnmappedGround, unmapped_ground
from lunar_mjx.dynamics.bus import BUS_VOLTAGE, tells_bus_voltage
from lunar_mjx.dynamics.signals import joint_channels
from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, log_model
from lunar_mjx.logs import commands as log_commands
from lunar_mjx.logs.schema import parse_name, suffix_of
from lunar_mjx.logs.series import sigma
from lunar_mjx.model import ZERO_CELSIUS, Model
from lunar_mjx.terrain.heightfield import slope


@dataclasses.dataclass(frozen=True)
class LogStart:
    """How a simulation begins where its log does."""

    settle: float = 1.0
    """Least time for which a rover stands before a log begins, s: it sinks to rest, as the real one had before."""
    finest: float = 0.01
    """Shortest interval of telemetry, s."""
    # s within which a first sample tells the start; noise that it must exceed to tell motion.
    near_start: float = 0.5
    sigmas: float = 5.0
    starts_moving: float = 0.02
    """m/s of a rover, or of its wheels' rims, from which a log begins in motion: below, noise of a rover at rest."""


LOG_START = LogStart()

READS_BEFORE = "reads_before"
"""Name of how far motors are read before a row's command takes effect: a share, which all logs have in common."""
STOOD = "stood"
"""Name of the time for which a rover had stood before a log, s."""
_LEVEL = math.radians(1.0)
"""On a steeper slope a rover creeps for seconds, ever slower: how long it has stood may show in its currents."""


class ImuMounting(NamedTuple):
    """Position m in the chassis frame; quaternion w, x, y, z from the IMU's axes to the chassis's."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class LogRun:
    """A log made ready to simulate.

    Attributes:
      model: the union model under the log's conditions.
      commands: (time, joint). every: time steps per command.
      begin, end: common time of the first command and of the last telemetry, s.
      start: x, y m, yaw rad, temperature K, time it had stood s. unknown: which of these a fit must find.
      motion: `moves`, whether the log begins in motion; then `velocity` (2,) world m/s, `yaw_rate` rad/s and
        `joint_speed` (joint,) rad/s, NaN where unknown.
      imu: how the IMU is mounted.
      ground: what nobody knows of the ground, where the log names no map.
      bus_voltage: (time,) of the bus as the log reads it, V; None where the model predicts it or the log has none.
    """

    model: Model
    commands: np.ndarray
    every: int
    begin: float
    end: float
    start: Mapping[str, float]
    unknown: tuple[str, ...]
    motion: Mapping[str, np.ndarray]
    imu: ImuMounting
    ground: UnmappedGround | None = None
    bus_voltage: np.ndarray | None = None


def log_run(log: Log, model: Model) -> LogRun:
    """A log made ready: its model, its commands on whole time steps, and where the rover stands at first.

    Raises:
      UserError: the log is shorter than two samples, or is of another rover.
    """
    own = log_model(log, model)
    given, begin = log_commands(log, own)
    steps_per_command = round(given.interval / own.timestep)
    values = given.values
    finest = max(LOG_START.finest, min(float(np.median(np.diff(t.time_s))) for t in log.tables.values() if len(t) > 2))
    # Commands are repeated until telemetry, which comes once a command, is as fine as the finest table.
    split = next(
        (
            k
            for k in range(1, steps_per_command + 1)
            if steps_per_command % k == 0 and given.interval / k <= 1.01 * finest
        ),
        1,
    )
    values, steps_per_command = np.repeat(values, split, axis=0), steps_per_command // split
    if len(values) < 3:
        raise UserError(f"{log.folder}: is too short to simulate ({len(values)} commands); record a longer drive.")
    end = begin + (len(values) - 1) * steps_per_command * own.timestep
    start, unknown = _start(log, own)
    motion = start_motion(log, own, begin, start["yaw"])
    imu = ImuMounting(log.imu.position_m, log.imu.quaternion)
    ground = unmapped_ground(log, own)
    times = begin + steps_per_command * own.timestep * np.arange(len(values))
    bus = None if tells_bus_voltage(model.effect_names) else _bus_voltage(log, times)
    return LogRun(own, values, steps_per_command, begin, end, start, unknown, motion, imu, ground, bus)


def _bus_voltage(log: Log, times: np.ndarray) -> np.ndarray | None:
    """(n,) voltage of the bus at some times as the log reads it, V; None where it reads none."""
    samples = log.channel(BUS_VOLTAGE)
    # A supply that drives a rover has a voltage: what reads none was not connected yet.
    there = np.zeros(0, bool) if samples is None else samples[1] > 0.0
    return np.interp(times, samples[0][there], samples[1][there]) if samples is not None and there.any() else None


def _start(log: Log, model: Model) -> tuple[dict[str, float], tuple[str, ...]]:
    """Pose, temperature and time of standing at the first samples, and which of them a fit must find."""
    start = {"x": 0.0, "y": 0.0, "yaw": 0.0, "temperature": float(model.ambient[0]), STOOD: LOG_START.settle}
    unknown = []

    def first(channel: str) -> float | None:
        samples = log.channel(channel)
        return None if samples is None or not len(samples[1]) else float(np.mean(samples[1][:5]))

    stated = log.initial.get("position_m")
    for i, axis in enumerate("xy"):
        value = first(f"position_{axis}_m")
        if stated is not None:
            start[axis] = float(stated[i])
        if value is not None:
            start[axis] = value
            unknown.append(axis)
    yaw, stated_yaw = first("yaw_deg"), _stated_yaw(log)
    if stated_yaw is not None:
        start["yaw"] = stated_yaw
    if yaw is not None:
        start["yaw"] = float(np.deg2rad(yaw))
        unknown.append("yaw")
    degrees = [log.initial[k] for k in ("winding_temperature_degC", "housing_temperature_degC") if k in log.initial]
    if degrees:
        start["temperature"] = float(np.mean(degrees)) + ZERO_CELSIUS
    temperatures = [first(c) for c in log.channel_names if suffix_of(c) == "degC"]
    known = [t for t in temperatures if t is not None]
    if known:
        start["temperature"] = float(np.mean(known)) + ZERO_CELSIUS
        unknown.append("temperature")
    if float(slope(model.terrain.field, start["x"], start["y"])) > _LEVEL:
        start[STOOD] = 2.0 * LOG_START.settle
        unknown.append(STOOD)
    return start, tuple(unknown)


def _stated_yaw(log: Log) -> float | None:
    """Yaw at the start as `[initial]` states it, as an angle or by a quaternion, rad; None where it does not."""
    if "yaw_deg" in log.initial:
        return math.radians(log.initial["yaw_deg"])
    if "quaternion" not in log.initial:
        return None
    w, x, y, z = log.initial["quaternion"]
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _speeds_of(joint: str) -> tuple[str, ...]:
    """Channels that tell a joint's speed: its own, then its side's, which is that of each driven wheel."""
    name = f"joint_{joint}_speed_rad_s"
    parts = parse_name(name)
    return (name, str(parts.at(parts.side))) if parts is not None and parts.joint == "drive" else (name,)


def start_motion(log: Log, model: Model, begin: float, yaw: float) -> dict[str, np.ndarray]:
    """Velocities of a rover whose log begins in motion: what `[initial]` states, else what is measured about then.

    Where no velocity is known, the wheels are taken to roll.

    Args:
      log: of a drive. model: with its rover. begin: common time of the start, s. yaw: then, rad.

    Returns:
      `moves`, `velocity`, `yaw_rate` and `joint_speed` as in `LogRun`.
    """

    def measured(*names: str) -> float:
        """The first sample: a line through several would see a rover that starts at once as one that was moving."""
        for name in names:
            samples = log.channel(name)
            if samples is not None and len(samples[0]) and samples[0][0] - begin < LOG_START.near_start:
                value = float(samples[1][0])
                return value if abs(value) > LOG_START.sigmas * sigma(log, name) else 0.0
        return math.nan

    channels = joint_channels(model.rover)
    spin = np.array([measured(*_speeds_of(c)) for c in channels])
    rims = [spin[channels.index(f"{w.corner}_drive")] * w.radius for w in model.rover.wheels]
    rolling = float(np.mean(rims)) if np.all(np.isfinite(rims)) else math.nan
    velocity = _start_velocity(log, measured, yaw)
    stated = log.initial.get("angular_velocity_rad_s")
    rate = measured("gyro_z_rad_s") if stated is None else float(stated[2])
    rate = 0.0 if math.isnan(rate) else rate
    if velocity is None:
        ahead = 0.0 if math.isnan(rolling) else rolling
        velocity = np.array([ahead * math.cos(yaw), ahead * math.sin(yaw)])
    # one of the two may be noise of a sensor that drifts; a rover in motion shows both where both are measured
    sizes = [float(np.hypot(*velocity)), *(abs(v) for v in rims if np.isfinite(v))]
    moves = max(sizes) > LOG_START.starts_moving and (
        math.isnan(rolling) or max(np.abs(rims)) > LOG_START.starts_moving
    )
    return {"moves": np.array(moves), "velocity": velocity, "yaw_rate": np.array(rate), "joint_speed": spin}


def _start_velocity(log: Log, measured: Callable[..., float], yaw: float) -> np.ndarray | None:
    """(2,) velocity in the world at the start, m/s; None where neither `[initial]` nor a channel tells it."""
    if "world_velocity_m_s" in log.initial:
        return np.array(log.initial["world_velocity_m_s"][:2], float)
    world = np.array([measured(f"world_velocity_{a}_m_s") for a in "xy"])
    if np.isfinite(world).all():
        return world
    ahead, left = (measured(f"body_velocity_{a}_m_s") for a in "xy")
    if math.isnan(ahead) or "body_velocity_x_m_s" in log.magnitudes:
        return None
    left = 0.0 if math.isnan(left) else left
    return np.array([ahead * math.cos(yaw) - left * math.sin(yaw), ahead * math.sin(yaw) + left * math.cos(yaw)])
