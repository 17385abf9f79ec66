"""Logs on disk that the tests of this folder read: a plausible drive of a four-wheeled rover, written from formulas."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from lunar_mjx.logs import Log, Noise, read_log
from lunar_mjx.logs.write import write_log

CORNERS = ("lf", "rf", "lr", "rr")
GRAVITY = 1.625
RADIUS = 0.1
TRACK = 0.6
STD = {
    "position": 2e-3,
    "yaw": 0.1,
    "velocity": 5e-3,
    "gyro": 2e-3,
    "accelerometer": 0.01,
    "angle": 1e-3,
    "speed": 5e-3,
    "current": 0.01,
    "voltage": 0.05,
    "temperature": 0.3,
}


def drive_tables(seed: int = 0, seconds: float = 20.0) -> dict[str, pd.DataFrame]:
    """A drive with 4 s of rest, a straight, a turn to the left and another rest, noise as `noise()` states it."""
    rng = np.random.default_rng(seed)

    def noisy(kind: str, values: np.ndarray) -> np.ndarray:
        return values + STD[kind] * rng.standard_normal(len(values))

    t = np.arange(0.0, seconds, 0.05)
    command = np.where((t >= 4.0) & (t < seconds - 4.0), 1.5, 0.0)
    turn = np.where((t >= 0.5 * seconds) & (t < seconds - 4.0), 0.3, 0.0)
    left, right = _lag(command - turn, 0.05), _lag(command + turn, 0.05)
    speed = RADIUS * 0.5 * (left + right)
    yaw_rate = RADIUS * (right - left) / TRACK
    yaw = np.cumsum(yaw_rate) * 0.05
    x, y = np.cumsum(speed * np.cos(yaw)) * 0.05, np.cumsum(speed * np.sin(yaw)) * 0.05
    zero = np.zeros_like(t)
    drive = {"time_s": t}
    for axis, value in zip("xyz", (x, y, zero + 0.16), strict=True):
        drive[f"position_{axis}_m"] = noisy("position", value)
    for axis, value in zip("xyz", (speed * np.cos(yaw), speed * np.sin(yaw), zero), strict=True):
        drive[f"world_velocity_{axis}_m_s"] = noisy("velocity", value)
    for name, value in (("roll", zero), ("pitch", zero), ("yaw", np.rad2deg(yaw))):
        drive[f"{name}_deg"] = noisy("yaw", value)
    drive["quaternion_w"], drive["quaternion_x"] = np.cos(0.5 * yaw), zero
    drive["quaternion_y"], drive["quaternion_z"] = zero, np.sin(0.5 * yaw)
    for axis, value in zip("xyz", (zero, zero, yaw_rate), strict=True):
        drive[f"gyro_{axis}_rad_s"] = noisy("gyro", value)
    for axis, value in zip("xyz", (np.gradient(speed, t), speed * yaw_rate, zero + GRAVITY), strict=True):
        drive[f"accelerometer_{axis}_m_s2"] = noisy("accelerometer", value)
    thermal = {"time_s": np.arange(0.0, seconds, 1.0)}
    for i, corner in enumerate(CORNERS):
        wheel, wanted = (left, command - turn) if corner[0] == "l" else (right, command + turn)
        drive[f"command_{corner}_drive_speed_rad_s"] = wanted
        drive[f"joint_{corner}_drive_angle_rad"] = noisy("angle", np.cumsum(wheel) * 0.05)
        drive[f"joint_{corner}_drive_speed_rad_s"] = noisy("speed", wheel)
        current = (0.15 + 0.02 * i) * np.sign(wheel) * (np.abs(wheel) > 0.01) + 0.3 * np.gradient(wheel, t)
        drive[f"motor_{corner}_drive_current_A"] = noisy("current", current)
        drive[f"motor_{corner}_drive_voltage_V"] = noisy("voltage", 4.13 * current + 0.0716 * 243.0 * wheel)
        heat = np.interp(thermal["time_s"], t, np.cumsum(current**2) * 0.05)
        for place, share in (("winding", 1.0), ("housing", 0.1)):
            channel = f"{place}_{corner}_drive_temperature_degC"
            thermal[channel] = noisy("temperature", -20.0 + share * heat)
    return {"drive": pd.DataFrame(drive), "thermal": pd.DataFrame(thermal)}


def _lag(values: np.ndarray, share: float) -> np.ndarray:
    """What follows a command within a few samples."""
    out, state = np.zeros_like(values), 0.0
    for i, value in enumerate(values):
        state += (1.0 - share * 8.0) * (value - state)
        out[i] = state
    return out


def noise(scale: float = 1.0) -> dict[str, Noise]:
    kinds = {
        "position_*": "position",
        "world_velocity_*": "velocity",
        "roll_deg": "yaw",
        "pitch_deg": "yaw",
        "yaw_deg": "yaw",
        "gyro_*": "gyro",
        "accelerometer_*": "accelerometer",
        "joint_*_angle_rad": "angle",
        "joint_*_speed_rad_s": "speed",
        "motor_*_current_A": "current",
        "motor_*_voltage_V": "voltage",
        "*_temperature_degC": "temperature",
    }
    return {pattern: Noise(scale * STD[kind], "datasheet") for pattern, kind in kinds.items()}


def make_log(
    folder: Path,
    change: Callable[[dict[str, pd.DataFrame]], object] | None = None,
    seed: int = 0,
    seconds: float = 20.0,
    **settings: object,
) -> Log:
    """Writes the drive with its tables changed, and reads it."""
    tables = drive_tables(seed, seconds)
    if change is not None:
        change(tables)
    given = {
        "noise": noise(),
        "manoeuvre": "test",
        "gravity_m_s2": GRAVITY,
        "environment": {"ambient_temperature_degC": -20.0},
        **settings,
    }
    write_log(folder, tables, rover="luvmi_x", **given)
    log = read_log(folder)
    assert isinstance(log, Log)
    return log
