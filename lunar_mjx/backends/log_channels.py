"""Telemetry of a reference backend as log channels: what perfect sensors with one clock would write."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lunar_mjx.dynamics.signals import joint_channels
from lunar_mjx.dynamics.state import Telemetry
from lunar_mjx.model import ZERO_CELSIUS, Model
from lunar_mjx.simulate import Commands, command_channels


def log_channels(model: Model, seen: Telemetry, commands: Commands, rover: int = 0) -> pd.DataFrame:
    """One rover's telemetry as a table of log channels (units in the names, temperatures in degrees Celsius).

    The accelerometer sits at the origin of the chassis frame; its acceleration is the central difference quotient of
    the velocities of neighbouring rows.

    Args:
      model: what drove. seen: telemetry with leading axes (rover, time). commands: what was commanded.
      rover: which one.
    """

    def own(name: str) -> np.ndarray:
        value = getattr(seen, name)
        parts = np.stack(value, -1) if isinstance(value, tuple) else value
        return np.asarray(parts[rover], float)

    time, velocity = own("time"), own("velocity")
    turn = _rotation(own("quaternion"))
    felt = np.gradient(velocity, time, axis=0) if len(time) > 1 else np.zeros_like(velocity)
    # An accelerometer feels what bears it: at rest it reads gravity, upward.
    felt[:, 2] += model.gravity
    data = {"time_s": time}
    _split(data, "position_{}_m", own("position"), "xyz")
    _split(data, "world_velocity_{}_m_s", velocity, "xyz")
    _split(data, "body_velocity_{}_m_s", _into(turn, velocity), "xyz")
    _split(data, "quaternion_{}", own("quaternion"), "wxyz")
    _split(data, "{}_deg", np.rad2deg(own("euler")), ("roll", "pitch", "yaw"))
    _split(data, "gyro_{}_rad_s", _into(turn, own("angular_velocity")), "xyz")
    _split(data, "accelerometer_{}_m_s2", _into(turn, felt), "xyz")
    joints = joint_channels(model.rover)
    _split(data, "joint_{}_angle_rad", own("joint_angle"), joints)
    _split(data, "joint_{}_speed_rad_s", own("joint_speed"), joints)
    _split(data, "motor_{}_torque_Nm", own("joint_torque"), joints)
    _split(data, "motor_{}_current_A", own("current"), joints)
    _split(data, "motor_{}_voltage_V", own("voltage"), joints)
    for node in ("winding", "housing"):
        _split(data, f"{node}_{{}}_temperature_degC", own(f"{node}_temperature") - ZERO_CELSIUS, joints)
    corners = [w.corner for w in model.rover.wheels]
    _split(data, "wheel_{}_sinkage_m", own("sinkage"), corners)
    _split(data, "wheel_{}_slip_ratio", own("slip"), corners)
    _split(data, "wheel_{}_slip_angle_deg", np.rad2deg(own("slip_angle")), corners)
    for name, unit in (("force", "N"), ("moment", "Nm")):
        for i, axis in enumerate("xyz"):
            _split(data, f"wheel_{{}}_{name}_{axis}_{unit}", own(f"wheel_{name}")[..., i], corners)
    values = commands.values if commands.values.ndim == 2 else commands.values[rover]
    data |= dict(zip(command_channels(model), values.T, strict=True))
    return pd.DataFrame(data)


def _split(data: dict[str, np.ndarray], pattern: str, values: np.ndarray, names) -> None:
    for i, name in enumerate(names):
        data[pattern.format(name)] = values[:, i]


def _into(turn: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """World vectors (time, 3) in the body frame."""
    return np.einsum("tij,ti->tj", turn, vectors)


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Body to world, (time, 3, 3), of w, x, y, z."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
