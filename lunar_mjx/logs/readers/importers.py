"""Measurement logs from recordings of ROS and MCAP, by a map from fields of messages to channels."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.logs.log import Noise
from lunar_mjx.logs.readers.bags import field, messages, stamp
from lunar_mjx.logs.readers.folder import TOP
from lunar_mjx.logs.schema import NOISE_SOURCES, parse_column
from lunar_mjx.logs.write import refuse_used, write_log
from lunar_mjx.toml_fields import Fields

RECORDED = "recorded"
"""Value of a table's `time` for the recorder's clock."""
_HEADER = "header.stamp"


@dataclasses.dataclass(frozen=True)
class Source:
    """Where a channel comes from: field of the message; value = scale * field + offset."""

    field: str
    scale: float = 1.0
    offset: float = 0.0


@dataclasses.dataclass(frozen=True)
class TableMap:
    """One table: its topic; its time (a field, "recorded", or "" for the header's stamp where there is one, else the
    recorder's); its channels."""

    topic: str
    time: str
    channels: Mapping[str, Source]


@dataclasses.dataclass(frozen=True)
class ImportMap:
    """A map file.

    Attributes:
      path: of the file. tables: by name. settings: keys of `log.toml`. rover: name or path. noise: by channel.
    """

    path: Path
    tables: Mapping[str, TableMap]
    rover: str
    settings: Mapping[str, Any]
    noise: Mapping[str, Noise]


def read_map(path: str | Path) -> ImportMap:
    """Reads a map file: `[log]` with keys of `log.toml`, and `[tables.NAME]` with `topic`, `time` and `channels`.

    Raises:
      UserError: the file, a key or a value is missing, unknown or of the wrong kind.
    """
    path = Path(path)
    top = Fields.read(path, "the map")
    top.known(("log", "tables"))
    log, stated = top.table("log"), top.table("tables")
    log.known([k for k in TOP if k not in ("format", "kind", "tables", "commitment")])
    if not stated.values:
        raise UserError(f"{path}: the table [tables.NAME] is missing; name a topic and the channels to take from it.")
    tables = {name: _table(stated.table(name)) for name in stated.values}
    noise = {name: _noise(log.table("noise").table(name)) for name in log.table("noise").values}
    settings = {k: v for k, v in log.values.items() if k not in ("rover", "noise")}
    return ImportMap(path, tables, log.text("rover"), settings, noise)


def _table(entry: Fields) -> TableMap:
    entry.known(("topic", "time", "channels"))
    channels = entry.table("channels")
    if not channels.values:
        raise bad_input(entry.path, channels.prefix, {}, "names no channel", 'write it as position_x_m = "pose.x"')
    found = {}
    for name, value in channels.values.items():
        column = parse_column(name, str(entry.path))
        if column is None or column.problem:
            what = column.problem if column else "is no channel"
            raise bad_input(entry.path, channels.prefix, name, what, "see docs/measurement_logs.md for the names")
        if isinstance(value, str):
            found[name] = Source(value)
            continue
        source = channels.table(name)
        source.known(("field", "scale", "offset"))
        found[name] = Source(source.text("field"), source.number("scale", 1.0), source.number("offset", 0.0))
    return TableMap(entry.text("topic"), entry.text("time", ""), found)


def _noise(entry: Fields) -> Noise:
    entry.known(("std", "source", "correlation_time_s"))
    source = entry.choice("source", NOISE_SOURCES) or "datasheet"
    return Noise(entry.number("std"), source, entry.number("correlation_time_s", 0.0))


def import_log(recording: str | Path, folder: str | Path, mapping: str | Path | ImportMap) -> Path:
    """Writes a log folder from a recording.

    Messages keep their order, and values that are not finite become gaps: what is wrong with the recording is for
    `check` to say. Time counts from the earliest message that is used.

    Args:
      recording: MCAP file, bag of ROS 1, file or folder of ROS 2. folder: must not exist, or be empty.
      mapping: the map or its file.

    Raises:
      UserError: the recording or the map is wrong, or the package that reads the recording is missing.
    """
    mapping = mapping if isinstance(mapping, ImportMap) else read_map(mapping)
    recording, folder = Path(recording), Path(folder)
    refuse_used(folder)
    rows: dict[str, list[list[float]]] = {name: [] for name in mapping.tables}
    times: dict[str, list[int]] = {name: [] for name in mapping.tables}
    clocks: dict[str, str] = {}
    for topic, time, message in messages(recording, {t.topic for t in mapping.tables.values()}):
        for name, table in mapping.tables.items():
            if table.topic != topic:
                continue
            if name not in clocks:
                clocks[name] = table.time or _clock(message)
            at = time if clocks[name] == RECORDED else _time(message, clocks[name], mapping, name)
            times[name].append(at)
            rows[name].append([_number(message, c, s, mapping, name) for c, s in table.channels.items()])
    for name, found in rows.items():
        if len(found) < 2:
            topic = mapping.tables[name].topic
            raise bad_input(
                recording,
                f"messages of {topic}",
                len(found),
                "are too few for a table",
                f"record more, or leave [tables.{name}] out of the map",
            )
    origin = min(t for found in times.values() for t in found)
    tables = {}
    for name, found in rows.items():
        frame = pd.DataFrame(np.array(found), columns=list(mapping.tables[name].channels))
        frame.insert(0, "time_s", [1e-9 * (t - origin) for t in times[name]])
        tables[name] = frame
    return write_log(folder, tables, rover=mapping.rover, noise=mapping.noise, **mapping.settings)


def _clock(message: Any) -> str:
    """The header's stamp where there is one that was set."""
    try:
        return _HEADER if stamp(field(message, _HEADER)) > 0 else RECORDED
    except KeyError:
        return RECORDED


def _time(message: Any, path: str, mapping: ImportMap, table: str) -> int:
    try:
        return stamp(field(message, path))
    except KeyError as error:
        raise bad_input(
            mapping.path,
            f"tables.{table}.time",
            path,
            f"is not in the messages: {error.args[0]}",
            f'name another field, or write time = "{RECORDED}"',
        ) from None


def _number(message: Any, channel: str, source: Source, mapping: ImportMap, table: str) -> float:
    where = f"tables.{table}.channels.{channel}"
    try:
        value = field(message, source.field)
    except KeyError as error:
        raise bad_input(
            mapping.path, where, source.field, f"is not in the messages: {error.args[0]}", "mend the map"
        ) from None
    if value is None:
        return math.nan
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise bad_input(
            mapping.path,
            where,
            source.field,
            f"holds a {type(value).__name__}, not a number",
            "name a number within it",
        ) from None
    return source.scale * number + source.offset if math.isfinite(number) else math.nan
