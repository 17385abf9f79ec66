"""Drives one rover through a sequence of commands and writes what it did as a table of log channels."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from lunar_mjx.dynamics import System, Telemetry, build
from lunar_mjx.effects.motor import MODES
from lunar_mjx.errors import UserError, bad_input, require_file
from lunar_mjx.model import Model

COMMAND_UNITS = dict(zip(MODES, ("angle_rad", "speed_rad_s", "torque_Nm", "current_A"), strict=True))
"""Ending of a command channel's name by control mode."""


@dataclasses.dataclass(frozen=True)
class Commands:
    """Commands over time: `values` (time, joint), each held for `interval` s, in the unit of each joint's mode."""

    values: np.ndarray
    interval: float


def command_channels(model: Model) -> list[str]:
    """Names of the command channels in the order of the controls, such as `command_lf_drive_speed_rad_s`."""
    return [
        f"command_{joint}_{COMMAND_UNITS[model.modes[group.name]]}"
        for group in model.rover.groups
        for joint in group.joints
    ]


def constant_commands(model: Model, duration: float, interval: float = 0.05, **groups: float) -> Commands:
    """The same command for every joint of a group (`drive`, `steer`, `suspension`), zero for groups left out.

    Raises:
      UserError: a group that the rover lacks, a value that is not finite, or a duration below one interval.
    """
    value = []
    for name, number in groups.items():
        if model.rover.group(name) is None:
            known = ", ".join(g.name for g in model.rover.groups)
            raise bad_input("command", name, number, "names no joint group of the rover", f"use one of {known}")
        if not np.isfinite(number):
            raise bad_input("command", name, number, "is not finite", "give a finite number")
    for group in model.rover.groups:
        value += [groups.get(group.name, 0.0)] * len(group.joints)
    if not np.isfinite(duration) or duration < interval:
        raise bad_input("command", "duration", duration, f"is below {interval} s", "give a longer time in s")
    return Commands(np.tile(np.array(value, float), (round(duration / interval), 1)), interval)


def read_commands(path: str | Path, model: Model) -> Commands:
    """Reads commands from a CSV: `time_s` at a constant rate, and one column per actuated joint.

    Raises:
      UserError: the file, a column or a value is missing, unknown or not finite; time that does not rise evenly.
    """
    path = require_file(path, "the command file")
    try:
        table = pd.read_csv(path)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: is not a CSV table ({error}); write time_s and one column per joint.") from None
    names = ["time_s", *command_channels(model)]
    for name in names:
        if name not in table.columns:
            raise bad_input(path, "columns", ", ".join(map(str, table.columns)), f"lack {name}", "add that column")
    for name in table.columns:
        if name not in names:
            raise bad_input(path, "column", name, "is unknown", f"use {', '.join(names[:3])}, ...")
        numbers = pd.to_numeric(table[name], errors="coerce").to_numpy(float)
        wrong = np.flatnonzero(~np.isfinite(numbers))
        if wrong.size:
            row = int(wrong[0])
            raise bad_input(f"{path}, row {row + 2}", name, table[name].iloc[row], "is not a finite number",
                            "give a number in the unit of the column's name")  # fmt: skip
    time = table["time_s"].to_numpy(float)
    steps = np.diff(time)
    if time.size < 2 or (steps <= 0).any():
        raise bad_input(path, "time_s", list(time[:3]), "does not rise", "sort the rows by time; give two at least")
    if np.ptp(steps) > 1e-3 * steps.mean():
        raise bad_input(path, "time_s", f"{steps.min():g} to {steps.max():g} s apart", "is uneven",
                        "resample the commands to a constant rate")  # fmt: skip
    return Commands(table[names[1:]].to_numpy(float), float(steps.mean()))


def simulate(
    model: Model, commands: Commands, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, engine: str = "auto"
) -> tuple[System, Telemetry]:
    """Drives one rover; the telemetry has one entry per command (at its beginning), as NumPy arrays.

    Raises:
      UserError: commands of another number of joints or not finite, an interval below the time step, or a simulation
        that diverged.
    """
    system = build(model, engine)
    joints = len(system.joint_names)
    if commands.values.ndim != 2 or commands.values.shape[1] != joints:
        raise bad_input("simulate", "commands", commands.values.shape, "have another shape", f"give (time, {joints})")
    if not np.isfinite(commands.values).all():
        row, column = np.argwhere(~np.isfinite(commands.values))[0]
        raise bad_input(f"simulate, command {row}", system.joint_names[column], commands.values[row, column],
                        "is not finite", "give a finite number")  # fmt: skip
    every = round(commands.interval / model.timestep)
    if every < 1:
        raise bad_input("simulate", "interval", commands.interval, f"is below the time step of {model.timestep} s",
                        "give commands less often or a smaller timestep_s")  # fmt: skip
    run = jax.jit(lambda p, s, c: system.rollout(p, s, c, every=every))
    start = system.reset(system.params, x, y, yaw)
    telemetry = jax.device_get(run(system.params, start, jnp.asarray(commands.values))[1])
    broken = np.flatnonzero(~np.isfinite(telemetry.quaternion).all(axis=1))
    if broken.size:
        raise bad_input("simulate", "time", f"{telemetry.time[broken[0]]:g} s", "is where the simulation diverged",
                        "use a smaller timestep_s, softer gains or smaller commands")  # fmt: skip
    return system, telemetry


def channels(system: System, seen: Telemetry, commands: Commands) -> pd.DataFrame:
    """Telemetry as a table of log channels (time_s first; units in the names; temperatures in degrees Celsius)."""
    corners = [w.corner for w in system.model.rover.wheels]
    data: dict[str, np.ndarray] = {"time_s": np.asarray(seen.time, float)}
    for axis in "xyz":
        data[f"position_{axis}_m"] = getattr(seen.position, axis)
        data[f"world_velocity_{axis}_m_s"] = getattr(seen.velocity, axis)
    for i, part in enumerate("wxyz"):
        data[f"quaternion_{part}"] = seen.quaternion[:, i]
    for name, part in zip(("roll", "pitch", "yaw"), seen.euler, strict=True):
        data[f"{name}_deg"] = np.rad2deg(part)
    per_joint = {
        "joint_{}_angle_rad": seen.joint_angle,
        "joint_{}_speed_rad_s": seen.joint_speed,
        "motor_{}_torque_Nm": seen.joint_torque,
        "motor_{}_current_A": seen.current,
        "motor_{}_voltage_V": seen.voltage,
        "winding_{}_temperature_degC": seen.winding_temperature - 273.15,
        "housing_{}_temperature_degC": seen.housing_temperature - 273.15,
    }
    for pattern, values in per_joint.items():
        for i, joint in enumerate(system.joint_names):
            data[pattern.format(joint)] = values[:, i]
    per_wheel = {
        "wheel_{}_sinkage_m": seen.sinkage,
        "wheel_{}_slip_ratio": seen.slip,
        **{f"wheel_{{}}_force_{a}_N": getattr(seen.wheel_force, a) for a in "xyz"},
        **{f"wheel_{{}}_moment_{a}_Nm": getattr(seen.wheel_moment, a) for a in "xyz"},
    }
    for pattern, values in per_wheel.items():
        for i, corner in enumerate(corners):
            data[pattern.format(corner)] = values[:, i]
    for name, values in zip(command_channels(system.model), commands.values.T, strict=True):
        data[name] = values
    return pd.DataFrame(data)


def front_steering(model: Model, commands: Commands, angle: float) -> Commands:
    """The commands with the front wheels' steering joints at `angle`, rad (in position mode), positive to the left.

    Raises:
      UserError: the angle is not finite, or not zero on a rover that does not steer.
    """
    if not np.isfinite(angle):
        raise bad_input("command", "steer", angle, "is not finite", "give an angle in rad")
    fronts = [w.steer for w in model.rover.wheels if w.corner in ("lf", "rf") and w.steer]
    if angle and not fronts:
        raise bad_input("command", "steer", angle, "needs steered front wheels, which the rover lacks", "leave it at 0")
    values = commands.values.copy()
    for name in fronts:
        values[:, model.rover.joints.index(name)] = angle
    return Commands(values, commands.interval)
