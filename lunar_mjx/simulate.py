"""Drives one rover through a sequence of commands and writes what it did as a table of log channels."""

from __future__ import annotations

import dataclasses
import traceback
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from lunar_mjx.dynamics import System, Telemetry, build
from lunar_mjx.dynamics.signals import joint_channels, measure
from lunar_mjx.effects.joint.motor import MODES
from lunar_mjx.errors import UserError, bad_input, one_line, require_file, require_finite
from lunar_mjx.model import Model, check_effects

COMMAND_UNITS: dict[str, str] = dict(zip(MODES, ("angle_rad", "speed_rad_s", "torque_Nm", "current_A"), strict=True))
"""Ending of a command channel's name by control mode."""


@dataclasses.dataclass(frozen=True)
class SimulateSettings:
    """Pace of a simulated drive, and how long its commands may be."""

    interval: float = 0.05
    """About the time between commands, and between rows of telemetry, s."""
    most_commands: int = 1_000_000
    """14 hours of commands at 20 Hz."""
    piece: int = 100
    """Commands driven in one call of the compiled program, which so fits drives of every length."""


SIMULATE = SimulateSettings()


@dataclasses.dataclass(frozen=True)
class Commands:
    """Commands over time: `values` (time, joint), each held for `interval` s, in the unit of each joint's mode."""

    values: np.ndarray
    interval: float


def command_channels(model: Model) -> list[str]:
    """Names of the command channels in the order of the controls, such as `command_lf_drive_speed_rad_s`."""
    modes = [model.modes[group.name] for group in model.rover.groups for _ in group.joints]
    channels = zip(joint_channels(model.rover), modes, strict=True)
    return [f"command_{channel}_{COMMAND_UNITS[mode]}" for channel, mode in channels]


def constant_commands(model: Model, duration: float, interval: float | None = None, **groups: float) -> Commands:
    """One command for every joint of a group (`drive`, `steer`, `suspension`), zero for groups left out.

    Args:
      model: whose joints are commanded.
      duration: s.
      interval: time from one command to the next, s; by default the whole number of time steps nearest to 0.05 s.
      **groups: command by joint group, in the unit of its mode.

    Raises:
      UserError: a group that the rover lacks, a value that is not finite, or a duration of less than one command or of
        too many.
    """
    if interval is None:
        # Whole time steps: a command that changed within one would have to be split.
        interval = max(1, round(SIMULATE.interval / model.timestep)) * model.timestep
    value = []
    for name, number in groups.items():
        if model.rover.group(name) is None:
            known = ", ".join(g.name for g in model.rover.groups)
            raise bad_input("command", name, number, "names no joint group of the rover", f"use one of {known}")
        if not np.isfinite(number):
            raise bad_input("command", name, number, "is not finite", "give a finite number")
    for group in model.rover.groups:
        value += [groups.get(group.name, 0.0)] * len(group.joints)
    if not np.isfinite(duration):
        raise bad_input("command", "duration", duration, "is not finite", "give a time in s")
    if duration < interval:
        raise bad_input("command", "duration", duration, f"is below {interval:g} s", "give a longer time in s")
    if duration > SIMULATE.most_commands * interval:
        raise bad_input(
            "command",
            "duration",
            duration,
            f"is above {SIMULATE.most_commands * interval:g} s",
            "drive in several parts",
        )
    return Commands(np.tile(np.array(value, float), (round(duration / interval), 1)), interval)


def read_commands(path: str | Path, model: Model) -> Commands:
    """Reads commands from a CSV: `time_s` at a constant rate, and one column per actuated joint.

    Raises:
      UserError: the file, a column or a value is missing, unknown or not finite; time that does not rise evenly.
    """
    path = require_file(path, "the command file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # rows longer than the header
            table = pd.read_csv(path, index_col=False)
    except (pd.errors.ParserError, pd.errors.ParserWarning, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise UserError(
            f"{path}: is not a CSV table ({one_line(error)}); write time_s and one column per joint."
        ) from None
    names = ["time_s", *command_channels(model)]
    for name in names:
        if name not in table.columns:
            raise bad_input(path, "columns", ", ".join(map(str, table.columns)), f"lack {name}", "add that column")
    for name in table.columns:
        if name not in names:
            raise bad_input(path, "column", name, "is unknown", f"use {', '.join(names[:3])}, ...")
        # By text, so that whole numbers of hundreds of digits become infinite and are refused.
        numbers = np.asarray(pd.to_numeric(table[name].astype(str), errors="coerce"), float)
        wrong = np.flatnonzero(~np.isfinite(numbers))
        if wrong.size:
            row = int(wrong[0])
            raise bad_input(
                f"{path}, line {row + 2}",
                name,
                table[name].iloc[row],
                "is not a finite number",
                "give a number in the unit of the column's name",
            )
    time = table["time_s"].to_numpy(float)
    steps = np.diff(time)
    if time.size < 2 or (steps <= 0).any():
        raise bad_input(path, "time_s", time[:3].tolist(), "does not rise", "sort the rows by time; give two at least")
    # A per mille: times in files are rounded; more is another rate.
    if np.ptp(steps) > 1e-3 * steps.mean():
        raise bad_input(
            path,
            "time_s",
            f"{steps.min():g} to {steps.max():g} s apart",
            "is uneven",
            "resample the commands to a constant rate",
        )
    return Commands(table[names[1:]].to_numpy(float), float(steps.mean()))


def simulate(
    model: Model, commands: Commands, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, engine: str = "auto"
) -> tuple[System, Telemetry]:
    """Drives one rover; the telemetry has one entry per command (at its beginning), as NumPy arrays.

    Raises:
      UserError: commands of another number of joints or not finite, an interval that is no whole number of time steps,
        a start off the terrain, an effect that does not run, or a simulation that diverged.
    """
    # Before the build, whose errors speak of traced arrays.
    check_effects(model, "simulate")
    check_start(model, x, y, yaw)
    system = build(model, engine)
    joints = len(system.joint_names)
    if commands.values.ndim != 2 or commands.values.shape[1] != joints:
        raise bad_input("simulate", "commands", commands.values.shape, "have another shape", f"give (time, {joints})")
    if not np.isfinite(commands.values).all():
        row, column = np.argwhere(~np.isfinite(commands.values))[0]
        raise bad_input(
            f"simulate, command {row}",
            system.joint_names[column],
            commands.values[row, column],
            "is not finite",
            "give a finite number",
        )
    steps_per_command = round(commands.interval / model.timestep)
    if steps_per_command < 1 or abs(steps_per_command * model.timestep - commands.interval) > 1e-3 * commands.interval:
        raise bad_input(
            "simulate",
            "interval",
            f"{commands.interval:g} s",
            f"is no whole number of time steps of {model.timestep:g} s",
            f"set timestep_s = {commands.interval / max(steps_per_command, 1):.6g}, or resample the commands",
        )
    state = system.reset(system.params, x, y, yaw)
    run = jax.jit(lambda p, s, c: system.rollout(p, s, c, every=steps_per_command))
    count = len(commands.values)
    # Filled up to whole pieces, so that one program runs them all; the surplus is cut off below.
    values = jnp.asarray(np.pad(commands.values, ((0, -count % SIMULATE.piece), (0, 0)), mode="edge"))
    try:
        # Apart from running, so that errors of an effect's code are told from those of a drive.
        compiled = run.lower(system.params, state, values[: SIMULATE.piece]).compile()
    except Exception as error:
        _blame_user_effect(model, error)
        raise
    parts = []
    for first in range(0, count, SIMULATE.piece):
        state, seen = compiled(system.params, state, values[first : first + SIMULATE.piece])
        # To the host piece by piece: telemetry of long drives does not fit a GPU's memory.
        parts.append(jax.device_get(seen))
    telemetry = jax.tree.map(lambda *pieces: np.concatenate(pieces)[:count], *parts)
    check_finite(telemetry)
    return system, telemetry


def check_finite(telemetry: Telemetry) -> None:
    """Raises `UserError` if a simulation diverged, and says when."""
    finite = np.ones(len(telemetry.time), bool)
    for leaf in jax.tree.leaves(telemetry):
        finite &= np.isfinite(leaf.reshape(len(finite), -1)).all(axis=1)
    if not finite.all():
        time_s = float(telemetry.time[np.argmin(finite)])
        raise bad_input(
            "simulate",
            "time",
            f"{time_s:g} s",
            "is where the simulation diverged",
            "use a smaller timestep_s, softer gains or smaller commands",
        )


def check_start(model: Model, x: float, y: float, yaw: float) -> None:
    """Raises `UserError` if a start is not finite or off the terrain."""
    for name, value in (("x", x), ("y", y), ("yaw", yaw)):
        require_finite("simulate", name, value)
    field = model.terrain.field
    rows, cols = field.heights.shape[-2:]
    for name, value, low, count in (("x", x, field.x0, cols), ("y", y, field.y0, rows)):
        low, high = float(low), float(low + (count - 1) * field.cell)
        if not low <= value <= high:
            raise bad_input(
                "simulate",
                name,
                value,
                f"is off the terrain {model.terrain.name}",
                f"start within {low:g} .. {high:g} m",
            )


def _blame_user_effect(model: Model, error: Exception) -> None:
    """Raises a `UserError` if the step cannot be traced because of an effect from the user's own file."""
    files = {spec.partition(":")[0]: name for name, spec in model.effect_files.items() if ".py" in spec}
    message = f"{type(error).__name__}: {error}"
    # The innermost frame within the user's own file is the line to mend.
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if frame.filename in files:
            raise UserError(
                f"{frame.filename}, line {frame.lineno}: the effect does not run ({message}); mend that line."
            ) from error
    if files:
        raise UserError(
            f"{next(iter(files))}: the model does not run with the effect {next(iter(files.values()))} ({message}); "
            "return the port's value, with a dict of new state where the effect owns state."
        ) from error


def channels(system: System, seen: Telemetry, commands: Commands) -> pd.DataFrame:
    """Telemetry as a table of log channels, as the model's sensors measure them.

    Args:
      system: what drove, with the effects at the port `sensor`.
      seen: telemetry of one rover, one entry per command.
      commands: what was commanded.

    Returns:
      `time_s` first, then measured channels and commands; units in the names, temperatures in degrees Celsius.
    """
    # Differences and wrapped angles of float32 telemetry lose digits otherwise.
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda a: a.astype(float) if np.issubdtype(a.dtype, np.floating) else a, seen)
        signals = measure(system, exact)
        data: dict[str, Any] = {"time_s": np.asarray(signals.time)}
        data |= {name: np.asarray(values) for name, values in signals.channels.items()}
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
    fronts = [w.steer for w in model.rover.wheels if w.row == "front" and w.steer]
    if angle and not fronts:
        raise bad_input("command", "steer", angle, "needs steered front wheels, which the rover lacks", "leave it at 0")
    # The caller keeps its commands.
    values = commands.values.copy()
    if angle and model.modes["steer"] != "position":
        raise bad_input(
            "command",
            "steer",
            angle,
            f"is an angle, but the mode of steer is {model.modes['steer']}",
            "set control.steer.mode to position, or give the commands as a table",
        )
    for name in fronts:
        values[:, model.rover.joints.index(name)] = angle
    return Commands(values, commands.interval)
