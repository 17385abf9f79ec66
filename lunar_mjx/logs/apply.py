"""Puts a log's settings into a model, and its commands onto the model's time steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.effects.joint.motor import MODES
from lunar_mjx.errors import bad_input
from lunar_mjx.logs.log import Log
from lunar_mjx.model import ZERO_CELSIUS, Model
from lunar_mjx.simulate import COMMAND_UNITS, Commands, joint_channels
from lunar_mjx.terrain import HeightField, Terrain

_KIND = {"drive": "drive", "steer": "steer", "suspension": "sus"}


def log_modes(log: Log, model: Model) -> dict[str, str]:
    """Control mode of each joint group that the log commands, from the unit of its command channels.

    Raises:
      UserError: the joints of one group are commanded in different units.
    """
    modes: dict[str, str] = {}
    names = set(log.channel_names)
    channels = _channels_by_joint(model)
    for group in model.rover.groups:
        # The unit of a command tells the controller's mode: who commands rad/s runs a speed controller.
        stated_modes = [m for m in MODES if any(_command(c, m) in names for j in group.joints for c in channels[j])]
        if len(stated_modes) > 1:
            shown = ", ".join(f"command_*_{_KIND[group.name]}_{COMMAND_UNITS[m]}" for m in stated_modes)
            raise bad_input(
                log.folder,
                "commands",
                shown,
                f"command the {group.name} joints in several modes",
                "command all joints of a group in one unit",
            )
        if stated_modes:
            modes[group.name] = stated_modes[0]
    return modes


def _channels_by_joint(model: Model) -> dict[str, tuple[str, ...]]:
    """Names under which a log may command each joint, its own first, such as (`lf_drive`, `left_drive`).

    Wheels that share a motor (`DriveGroup`) share its command, which rovers log once, for the motor.
    """
    rover = model.rover
    return {
        joint: (own, *(f"{g.name}_{_KIND['drive']}" for g in rover.drive_groups if joint in g.joints))
        for joint, own in zip(rover.joints, joint_channels(rover), strict=True)
    }


def _command(channel: str, mode: str) -> str:
    return f"command_{channel}_{COMMAND_UNITS[mode]}"


def commands(log: Log, model: Model) -> tuple[Commands, float]:
    """The log's commands as the simulator takes them: zero-order hold on whole time steps.

    Wheels of one motor may be commanded by its channel, such as `command_left_drive_speed_rad_s`. A joint without a
    command channel is commanded 0 in its group's mode. A gap holds the command before it; before the first command,
    the first one holds.

    Args:
      log: a drive log.
      model: with the log's control modes (`log_model`).

    Returns:
      The commands from the log's first sample to its last, and the common time of the first, s.

    Raises:
      UserError: the log commands nothing, or in another mode than the model's.
    """
    modes = log_modes(log, model)
    if not modes:
        raise bad_input(
            log.folder,
            "commands",
            None,
            "are missing: no channel command_* is in any table",
            'log what was commanded, such as command_lf_drive_speed_rad_s, or state imposed = "wheel_speed" in '
            "log.toml where the wheels' speeds were measured",
        )
    for group, mode in modes.items():
        if model.modes[group] != mode:
            raise bad_input(
                log.folder,
                f"commands of {group}",
                mode,
                f"differ from the model's mode {model.modes[group]}",
                "make the model with log_model(log, model)",
            )
    # The whole log and not the commands' table: telemetry before the first command wants a simulation, too.
    start, end = log.span_s
    names = _command_names(log, model)
    # Whole time steps: a command that changed within a step would have to be split between two.
    interval = _interval([log.table_of(n) for n in names if log.table_of(n) is not None], model.timestep)
    grid = start + interval * np.arange(max(1, int(np.floor((end - start) / interval + 1e-6)) + 1))
    values = np.zeros((len(grid), len(names)))
    for column, name in enumerate(names):
        samples = log.channel(name)
        if samples is not None and samples[0].size:
            # Held and never interpolated: a controller acts on the last command that it has.
            values[:, column] = hold(samples[0], samples[1], grid)
    return Commands(values, interval), start


def _command_names(log: Log, model: Model) -> list[str]:
    """Command channel of each joint in the order of the controls: the first of its names that the log has."""
    channels = _channels_by_joint(model)
    logged = set(log.channel_names)
    names = []
    for group in model.rover.groups:
        for joint in group.joints:
            own = [_command(c, model.modes[group.name]) for c in channels[joint]]
            # The wheel's own channel wins: it says more than that of its side.
            names.append(next((n for n in own if n in logged), own[0]))
    return names


def hold(time: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Zero-order hold of samples (sorted `time`, `values`) at the times `grid`; the first value before the first."""
    # A microsecond later, since times of steps and of rows differ by rounding.
    return values[np.maximum(np.searchsorted(time, grid + 1e-6, side="right") - 1, 0)]


def _interval(tables: list[Any], timestep: float) -> float:
    """The commands' own interval where it is a whole number of steps; else a quarter of it at most, in whole steps."""
    # The fastest table decides: a slower command is held over several of its intervals.
    step = min(float(np.median(np.diff(t.time_s[np.isfinite(t.time_s)]))) if len(t) > 1 else 0.05 for t in tables)
    whole = round(step / timestep)
    if whole >= 1 and abs(whole * timestep - step) <= 1e-3 * step:
        return whole * timestep
    # A quarter: then a command acts late by an eighth of its interval on average.
    return max(1, int(step / (4.0 * timestep))) * timestep


def log_model(log: Log, base: Model) -> Model:
    """The base model under the log's conditions: gravity, terrain, changes of the rover, ambient, control modes.

    A canned manoeuvre brings the arrangement of its test. The Sun's angles go to every effect of the model that has the
    parameters `sun_azimuth` and `sun_elevation`. An ambient temperature that is a channel gives its mean.

    Raises:
      UserError: the log is of another rover, or states what the model cannot take.
    """
    if Path(log.rover).name != base.rover.name and log.rover != str(base.rover.folder):
        raise bad_input(
            log.folder,
            "rover",
            log.rover,
            f"is not the model's rover {base.rover.name}",
            "give the model of the log's rover",
        )
    changes: dict[str, Any] = {"gravity": log.gravity_m_s2, "modes": log_modes(log, base)}
    if log.terrain != base.terrain_spec:
        changes["terrain"] = log.terrain
    ambient = environment_value(log, "ambient_temperature_degC")
    if ambient is not None:
        kelvin = ambient + ZERO_CELSIUS
        # Noon and night alike: one measured temperature tells no lunar day.
        changes["ambient"] = (kelvin, kelvin, 0.0, base.ambient[3])
    model = base.replace(**changes)
    if any(log.terrain_origin_m):
        x, y = log.terrain_origin_m
        # The terrain moves to the log's coordinates, so that all channels stay as they were written.
        model = model.replace(terrain=moved(model.terrain, -x, -y), terrain_spec="")
    # The arrangement last: a stand holds the rover as it was changed.
    return _arranged(log, _sun(log, _changed_rover(log, model)))


def _arranged(log: Log, model: Model) -> Model:
    """The arrangement of a canned manoeuvre (a stand, a brake), which its log names."""
    from lunar_mjx.manoeuvres import MANOEUVRES, load_manoeuvre, with_arrangement  # which reads files as this package

    return with_arrangement(load_manoeuvre(log.manoeuvre), model) if log.manoeuvre in MANOEUVRES else model


def environment_value(log: Log, key: str) -> float | None:
    """A constant of the environment, or the mean of the channel that holds it; None if the log does not say."""
    value = log.environment.get(key)
    if isinstance(value, str):
        samples = log.channel(value)
        return float(samples[1].mean()) if samples is not None and samples[1].size else None
    return value


def moved(terrain: Terrain, x: float, y: float) -> Terrain:
    """A plain height field with its coordinates shifted by (x, y) m.

    Raises:
      UserError: the terrain carries rocks or a soil map, which do not move with it.
    """
    import dataclasses

    if not (terrain.rocks is None and terrain.soil is None and terrain.grids is None):
        raise bad_input(
            "log_model",
            "terrain_origin_m",
            [-x, -y],
            f"does not go with {terrain.name}, which has rocks or a soil map",
            "write the log in the terrain's coordinates",
        )
    field: HeightField = dataclasses.replace(terrain.field, x0=terrain.field.x0 + x, y0=terrain.field.y0 + y)
    return dataclasses.replace(terrain, field=field)


def _changed_rover(log: Log, model: Model) -> Model:
    source = str(log.folder)
    given = log.rover_changes
    mass = given.get("payload_kg", 0.0)
    if mass:
        model = _with_payload(model, mass, given.get("payload_position_m", (0.0, 0.0, 0.0)), source)
    if "com_offset_m" in given:
        model = _set(model, "com_offset", source, **dict(zip("xyz", given["com_offset_m"], strict=True)))
    if "wheel_radius_offset_m" in given:
        model = _set(model, "wheel_radius_error", source, offset=given["wheel_radius_offset_m"])
    return model


def _with_payload(model: Model, mass: float, position: Any, source: str) -> Model:
    """The payload added to one that the model carries already, as one point mass at their common centre."""
    if "payload" in model.effect_names:
        # A payload is one for the rover: none of its parameters has several values.
        old = {k: float(np.asarray(v)) for k, v in model.parameters["payload"].items()}
        total_mass = old["mass"] + mass
        # The effect knows one point mass: the inertia of the two about their common centre is left out.
        position = [(old[k] * old["mass"] + p * mass) / total_mass for k, p in zip("xyz", position, strict=True)]
        mass = total_mass
    return _set(model, "payload", source, mass=mass, **dict(zip("xyz", position, strict=True)))


def _set(model: Model, effect: str, source: str, /, **values: Any) -> Model:
    # A model that has the effect already keeps its place in the list.
    return model.set(effect, source, **values) if effect in model.effect_names else model.add(effect, source, **values)


def _sun(log: Log, model: Model) -> Model:
    for key, name in (("sun_azimuth_deg", "sun_azimuth"), ("sun_elevation_deg", "sun_elevation")):
        value = environment_value(log, key)
        if value is None:
            continue
        # Every effect with such a parameter: panels, housings and radiators see one Sun.
        for effect in model.effects:
            if name in effect.parameters:
                unit = np.radians(value) if effect.parameters[name].unit == "rad" else value
                model = model.set(effect.name, str(log.folder), **{name: float(unit)})
    return model
