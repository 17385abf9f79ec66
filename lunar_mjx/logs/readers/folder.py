"""Reads measurement logs: a folder of `log.toml` and tables; a folder of such folders is a campaign."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.errors import UserError, bad_input, require_name, require_within
from lunar_mjx.logs.attitude import body_attitude, with_angles
from lunar_mjx.logs.findings import Finding
from lunar_mjx.logs.log import Imu, Log, LogTable, Noise, SteadyLog
from lunar_mjx.logs.readers.steady import read_steady
from lunar_mjx.logs.readers.table import read_log_table
from lunar_mjx.logs.schema import (
    FORMAT,
    GREATEST_GRAVITY,
    IMPOSED,
    LATEST,
    NOISE_KEYS,
    NOISE_SOURCES,
    SPLITS,
    STEADY_CHANNELS,
    find_channel,
    is_quantity,
    limits,
    parse_column,
)
from lunar_mjx.model.ambient import ENVIRONMENT, require_environment
from lunar_mjx.toml_fields import Fields

LOG_FILE = "log.toml"
LEAST_NOISE = 1e-12
"""SI units: what is less is no instrument's noise but a zero, or rounding of double precision."""
ANSWER = ".answer.toml"
"""How the answer to a sealed log is called, after the log."""
FARTHEST_MOUNT_M = 100.0
"""From the chassis to its IMU: no rover is as long."""
FARTHEST_M = 2e7
"""Half of the Earth's circumference: no place on a grid lies beyond."""
CHANGED = {
    "payload_kg": ("payload", "mass"),
    "payload_position_m": ("payload", "x"),
    "com_offset_m": ("com_offset", "x"),
    "wheel_radius_offset_m": ("wheel_radius_error", "offset"),
}
"""Effect and parameter whose bounds hold for a change of the rover, in all its axes."""
INITIAL = {
    "position_m": 3,
    "quaternion": 4,
    "roll_deg": 1,
    "pitch_deg": 1,
    "yaw_deg": 1,
    "world_velocity_m_s": 3,
    "angular_velocity_rad_s": 3,
    "winding_temperature_degC": 1,
    "housing_temperature_degC": 1,
}
"""Initial values by name and number of entries; a channel of one joint may be named as well."""
INITIAL_CHANNEL = {
    "position_m": "position_x_m",
    "world_velocity_m_s": "world_velocity_x_m_s",
    "angular_velocity_rad_s": "gyro_x_rad_s",
    "winding_temperature_degC": "winding_lf_drive_temperature_degC",
    "housing_temperature_degC": "housing_lf_drive_temperature_degC",
}
"""A channel whose physical range holds for a key of `initial`, in all its axes."""
TOP = (
    "format",
    "kind",
    "rover",
    "manoeuvre",
    "gravity_m_s2",
    "terrain",
    "terrain_origin_m",
    "split",
    "environment",
    "rover_changes",
    "initial",
    "imu",
    "tables",
    "noise",
    "source",
    "commitment",
    "imposed",
    "magnitudes",
    "ground",
    "geodetic_origin",
)


def read_log(folder: str | Path) -> Log | SteadyLog:
    """Reads one log.

    What makes its data unusable without making them unreadable (a unit that does not convert, text in a column of
    numbers) is kept in `problems` for `check`, which alone judges data.

    Args:
      folder: a folder with `log.toml`, or that file.

    Raises:
      UserError: the folder, a file, a key or a value is missing, unknown or of the wrong kind.
    """
    folder = Path(folder)
    # Shells complete to the file; its folder is what is meant.
    if folder.name == LOG_FILE and folder.is_file():
        folder = folder.parent
    path = folder / LOG_FILE
    if not path.is_file():
        raise UserError(f"{folder}: holds no {LOG_FILE}; give the folder of a log, or make one with lunar-mjx log new.")
    top = Fields.read(path)
    if top.values.get("format") != FORMAT:
        raise bad_input(path, "format", top.values.get("format"), "is not known", f'write format = "{FORMAT}"')
    kind = top.text("kind", "drive")
    if kind == "steady_state":
        return read_steady(folder, top, lambda f: _noise(f, tuple(STEADY_CHANNELS)))
    if kind != "drive":
        raise bad_input(path, "kind", kind, "does not exist", "use drive (or leave it out) or steady_state")
    return _read_drive(folder, top)


def read_campaign(paths: str | Path | Sequence[str | Path]) -> list[Log | SteadyLog]:
    """Reads several logs: each path is a log, or a folder of logs (a campaign), in alphabetical order.

    Answers to sealed logs are left out.

    Raises:
      UserError: a path holds no log, or a log cannot be read.
    """
    # `logs/*` names answers, too; a reader of logs must not open one.
    given = without_answers([paths] if isinstance(paths, str | Path) else paths)
    if not given:
        raise UserError("read_campaign: no log is given; name at least one folder with a log.toml.")
    logs: list[Log | SteadyLog] = []
    seen: set[Path] = set()
    for path in map(Path, given):
        for folder in _log_folders(path):
            if folder.resolve() in seen:
                raise bad_input("read_campaign", "log", str(folder), "is named twice", "name every log once")
            # By the real path: a log read twice would count as two measurements.
            seen.add(folder.resolve())
            logs.append(read_log(folder))
    return logs


def without_answers(paths: Sequence[str | Path]) -> list[str | Path]:
    """The paths without answers to sealed logs, which lie beside these: `logs/*` is meant to name the logs."""
    return [p for p in paths if not str(p).endswith(ANSWER)]


def _log_folders(path: Path) -> list[Path]:
    if path.is_file() or (path / LOG_FILE).is_file():
        return [path.parent if path.is_file() and path.name == LOG_FILE else path]
    found = sorted(p.parent for p in path.glob(f"*/{LOG_FILE}")) if path.is_dir() else []
    if not found:
        raise UserError(f"{path}: neither it nor a folder in it holds {LOG_FILE}; name a log or a campaign.")
    return found


def _read_drive(folder: Path, top: Fields) -> Log:
    top.known(TOP)
    problems: list[Finding] = []
    environment, columns = _environment(top.table("environment"))
    tables = _tables(folder, top, columns, problems)
    imu = _imu(top.table("imu"))
    # Before anything reads angles; noise is told for what the log then holds.
    tables = body_attitude(tables, imu)
    names = tuple(c for t in tables.values() for c in t.channels)
    origin = top.vector("terrain_origin_m", 2, (0.0, 0.0))
    for value in origin:
        require_within(top.path, "terrain_origin_m", value, -FARTHEST_M, FARTHEST_M)
    return Log(
        folder=folder,
        name=folder.resolve().name,
        rover=_near(folder, require_name(top.path, "rover", top.text("rover")), "rover.toml"),
        manoeuvre=top.text("manoeuvre", ""),
        gravity_m_s2=top.positive("gravity_m_s2", 1.625, GREATEST_GRAVITY),
        terrain=_near(folder, require_name(top.path, "terrain", top.text("terrain", "flat")), "terrain.toml"),
        terrain_origin_m=(origin[0], origin[1]),
        split=top.choice("split", SPLITS),
        environment=environment,
        rover_changes=_rover_changes(top.table("rover_changes")),
        initial=_initial(top.table("initial")),
        imu=imu,
        tables=tables,
        noise=with_angles(_noise(top.table("noise"), names), names),
        source={k: str(v) for k, v in top.table("source").values.items()},
        problems=tuple(problems),
        imposed=_imposed(top, names),
        magnitudes=_magnitudes(top, names),
        ground=top.text("ground", ""),
        geodetic_origin=_geodetic_origin(top.table("geodetic_origin")),
    )


def _imposed(top: Fields, channels: Sequence[str]) -> str | None:
    imposed = top.choice("imposed", IMPOSED)
    if imposed is not None and not any(is_quantity(c, "joint_speed", "drive") for c in channels):
        raise bad_input(
            top.path,
            "imposed",
            imposed,
            "needs measured wheel speeds, and no table holds any",
            "add joint_left_drive_speed_rad_s and joint_right_drive_speed_rad_s, or leave imposed out",
        )
    return imposed


def _magnitudes(top: Fields, channels: Sequence[str]) -> dict[str, float]:
    """Channels without sign, with what each reads where there is nothing; a pattern with `*` means all it matches."""
    stated = top.values.get("magnitudes", [])
    floors = (
        dict.fromkeys(stated, 0.0) if isinstance(stated, list) and all(isinstance(v, str) for v in stated) else stated
    )
    if not isinstance(floors, dict) or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and 0.0 <= v < math.inf for v in floors.values()
    ):
        raise bad_input(
            top.path,
            "magnitudes",
            stated,
            "is neither a list of channels nor a table of what they read at zero",
            'write magnitudes = ["motor_left_drive_current_A"], or { "motor_left_drive_current_A" = 0.6 }',
        )
    found = {}
    for name, floor in floors.items():
        matches = [c for c in channels if fnmatchcase(c, name)]
        if not matches and find_channel(name) is None:
            raise bad_input(top.path, "magnitudes", name, "is no channel", "correct its name or leave it out")
        for channel in matches:
            found[channel] = require_within(top.path, f"magnitudes.{name}", floor, 0.0, limits(channel)[1])
    return found


def _geodetic_origin(fields: Fields) -> dict[str, float | str]:
    fields.known(("latitude_deg", "longitude_deg", "projection"))
    if not fields.values:
        return {}
    latitude, longitude = (
        require_within(fields.path, fields.field(key), fields.number(key), -most, most)
        for key, most in (("latitude_deg", 90.0), ("longitude_deg", 360.0))
    )
    return {
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "projection": fields.choice("projection", ("tangent", "utm")) or "tangent",
    }


def _tables(folder: Path, top: Fields, extra: dict[str, str], problems: list[Finding]) -> dict[str, LogTable]:
    stated = top.table("tables")
    if not stated.values:
        raise UserError(f"{top.path}: the table [tables.NAME] is missing; name at least one file of measurements.")
    name = folder.resolve().name
    tables = {}
    for key in stated.values:
        entry = stated.table(key)
        entry.known(("file", "rate_hz", "on_change", "clock_offset_s", "clock_offset_std_s"))
        tables[key] = read_log_table(folder, name, key, entry, extra, problems)
    # One table per channel: two readings of one sensor would count as independent.
    owner: dict[str, str] = {}
    for key, table in tables.items():
        for channel in table.channels:
            if channel in owner:
                raise bad_input(
                    top.path, "tables", f"{owner[channel]}, {key}", f"both hold {channel}", "keep it in one table"
                )
            owner[channel] = key
    for key, column in extra.items():
        if key not in owner:
            raise bad_input(
                top.path,
                f"environment.{key}",
                column,
                "is no column of any table",
                "give a number or the name of a column",
            )
    return tables


def _environment(fields: Fields) -> tuple[dict[str, float | str], dict[str, str]]:
    """Constants, and the columns that hold what is no constant, by key."""
    fields.known(tuple(ENVIRONMENT))
    values: dict[str, float | str] = {}
    columns: dict[str, str] = {}
    for key, value in fields.values.items():
        if isinstance(value, str):
            values[key], columns[key] = key, value
        else:
            values[key] = require_environment(fields.path, fields.field(key), key, fields.number(key))
    return values, columns


def _rover_changes(fields: Fields) -> dict[str, Any]:
    fields.known(tuple(CHANGED))
    changes: dict[str, Any] = {}
    for key in fields.values:
        changes[key] = fields.vector(key, 3) if key in ("payload_position_m", "com_offset_m") else fields.number(key)
    if changes.get("payload_kg", 0.0) < 0.0:
        raise bad_input(
            fields.path, fields.field("payload_kg"), changes["payload_kg"], "is negative", "give the mass in kg"
        )
    for key, change in changes.items():
        effect, parameter = CHANGED[key]
        low, high = CATALOGUE[effect].parameters[parameter].bounds
        for number in np.atleast_1d(change):
            require_within(fields.path, fields.field(key), float(number), low, high)
    return changes


def _initial(fields: Fields) -> dict[str, Any]:
    initial: dict[str, Any] = {}
    for key, value in fields.values.items():
        count = INITIAL.get(key)
        column = parse_column(key, str(fields.path)) if count is None else None
        if count is None and (column is None or column.problem or column.name != key):
            raise bad_input(
                fields.path,
                fields.field(key),
                value,
                "is an unknown key",
                f"use one of {', '.join(INITIAL)}, or a channel's name",
            )
        initial[key] = fields.number(key) if count in (None, 1) else fields.vector(key, count)
        low, high, why = limits(INITIAL_CHANNEL.get(key, key))
        numbers = np.atleast_1d(initial[key])
        if (numbers < low).any() or (numbers > high).any():
            problem = f"is outside [{low:g}, {high:g}] ({why})"
            raise bad_input(fields.path, fields.field(key), value, problem, "check its unit")
        if key == "quaternion":
            _norm(fields, key, initial[key])
    return initial


def _norm(fields: Fields, key: str, quaternion: Sequence[float]) -> float:
    """Norm of a quaternion, which is one."""
    norm = sum(v * v for v in quaternion) ** 0.5
    # Quaternions are written with four digits or more; more than that is no rounding.
    if abs(norm - 1.0) > 1e-3:
        raise bad_input(fields.path, fields.field(key), list(quaternion), f"has the norm {norm:.4g}", "normalise it")
    return norm


def _imu(fields: Fields) -> Imu:
    fields.known(("position_m", "quaternion", "mounting_std_deg", "attitude"))
    p, q = fields.vector("position_m", 3, (0.0,) * 3), fields.vector("quaternion", 4, (1.0, 0.0, 0.0, 0.0))
    norm = _norm(fields, "quaternion", q)
    std = fields.vector("mounting_std_deg", 3, (0.0,) * 3)
    if min(std) < 0.0:
        raise bad_input(
            fields.path,
            fields.field("mounting_std_deg"),
            list(std),
            "has a negative entry",
            "give zero or more degrees about x, y and z",
        )
    for key, values, most in (("position_m", p, FARTHEST_MOUNT_M), ("mounting_std_deg", std, 180.0)):
        if max(map(abs, values)) > most:
            raise bad_input(fields.path, fields.field(key), list(values), f"is above {most:g}", "check its unit")
    attitude = fields.values.get("attitude", False)
    if not isinstance(attitude, bool):
        raise bad_input(
            fields.path,
            fields.field("attitude"),
            attitude,
            "is neither true nor false",
            "write attitude = true where roll, pitch and yaw are the IMU's own",
        )
    turn = (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)
    return Imu((p[0], p[1], p[2]), turn, (std[0], std[1], std[2]), attitude)


def _noise(fields: Fields, channels: Sequence[str]) -> dict[str, Noise]:
    """Noise by channel; a key with `*` means every channel that it matches and that has no noise of its own."""
    exact: dict[str, Noise] = {}
    patterns: list[tuple[str, Noise]] = []
    for key in fields.values:
        entry = fields.table(key)
        entry.known(NOISE_KEYS)
        source = entry.choice("source", NOISE_SOURCES) or "datasheet"
        std, correlation = entry.number("std"), entry.number("correlation_time_s", 0.0)
        require_within(fields.path, f"{fields.field(key)}.correlation_time_s", abs(correlation), 0.0, LATEST)
        if std < 0.0 or correlation < 0.0:
            raise bad_input(fields.path, fields.field(key), entry.values, "has a negative entry", "give zero or more")
        share = entry.number("correlated_share", 1.0)
        require_within(fields.path, f"{fields.field(key)}.correlated_share", share, 0.0, 1.0, above=True)
        if share < 1.0 and correlation == 0.0:
            problem = "is of a part that has no correlation time"
            remedy = "add correlation_time_s, or leave it out"
            raise bad_input(fields.path, f"{fields.field(key)}.correlated_share", share, problem, remedy)
        if std < LEAST_NOISE:
            remedy = "state what is measured, or a digit's last place over sqrt(12)"
            raise bad_input(fields.path, f"{fields.field(key)}.std", std, "is less than any instrument's noise", remedy)
        # Kept for later: exact names win over patterns, in whatever order they stand.
        if "*" in key:
            patterns.append((key, Noise(std, source, correlation, share)))
            continue
        column = None if key in channels else parse_column(key, str(fields.path))
        if column is None and key not in channels:
            remedy = "list the names with lunar-mjx log channels"
            raise bad_input(fields.path, fields.field(key), entry.values, "is the noise of no channel", remedy)
        if column is not None and column.problem:
            raise bad_input(fields.path, fields.field(key), key, column.problem, "state the noise in that unit")
        name, scale = (column.name, column.scale) if column is not None else (key, 1.0)
        low, high = STEADY_CHANNELS[name][1:] if name in STEADY_CHANNELS else limits(name)[:2]
        if std * abs(scale) > high - low:
            raise bad_input(
                fields.path, f"{fields.field(key)}.std", std, "is more than the channel's whole range", "check its unit"
            )
        # Noise takes the unit's scale, never its offset.
        exact[name] = Noise(std * abs(scale), source, correlation, share)
    for pattern, noise in patterns:
        for name in channels:
            if fnmatchcase(name, pattern):
                exact.setdefault(name, noise)
    return exact


def _near(folder: Path, spec: str, marker: str) -> str:
    """A path counted from the log's folder as an absolute one; a name as it is."""
    near = (folder / spec).resolve()
    # What lies beside the log wins over a shipped name: a log travels with its rover.
    return str(near) if near.is_file() or (near / marker).is_file() else spec
