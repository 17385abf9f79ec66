"""Drives from bags of ROS and MCAP files: fields of messages as channels."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.errors import bad_input, plain_digits
from lunar_mjx.logs.readers.bags import field, messages, stamp
from lunar_mjx.logs.readers.import_map import ImportMap, Source, Term
from lunar_mjx.logs.readers.recorded_drive import LATITUDE, LONGITUDE, TIME, RecordedDrive, positions, without_empty

RECORDED = "recorded"
"""Value of a table's `time` for the recorder's clock."""
_HEADER = "header.stamp"


def drive_of_bag(recording: Path, mapping: ImportMap) -> RecordedDrive:
    """The drive that one bag holds.

    Messages keep their order, and values that are not finite become gaps: what is wrong with the recording is for
    `check` to say. Time counts from the earliest message that is used.

    Args:
      recording: MCAP file, bag of ROS 1, file or folder of ROS 2.

    Raises:
      UserError: the recording or the map is wrong, or the package that reads the recording is missing.
    """
    wanted = {name: _sources(mapping, name) for name in mapping.tables}
    rows: dict[str, list[list[float]]] = {name: [] for name in mapping.tables}
    times: dict[str, list[int]] = {name: [] for name in mapping.tables}
    clocks: dict[str, str] = {}
    for topic, time, message in messages(recording, {t.topic for t in mapping.tables.values()}):
        for name, table in mapping.tables.items():
            if table.topic != topic:
                continue
            if name not in clocks:
                # By the first message and for all: a table that changed its clock half-way would jump.
                clocks[name] = table.time or _clock(message)
            at = time if clocks[name] == RECORDED else _time(message, clocks[name], mapping, name)
            times[name].append(at)
            rows[name].append([_number(message, c, s, mapping, name) for c, s in wanted[name].items()])
    for name, found in rows.items():
        # A rate needs two times.
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
    tables, settings = {}, {}
    for name, found in rows.items():
        frame = pd.DataFrame(np.array(found), columns=list(wanted[name]))
        # In whole nanoseconds until here: seconds since 1970 leave a float 0.2 microseconds.
        frame.insert(0, TIME, [1e-9 * (t - origin) for t in times[name]])
        geodetic = mapping.tables[name].geodetic
        if geodetic is not None:
            frame, place = positions(frame, geodetic, recording)
            if place:
                settings["geodetic_origin"] = place
        tables[name] = frame
    drive = RecordedDrive(recording.stem, tables, {"files": recording.name}, settings)
    return without_empty(drive)


def _sources(mapping: ImportMap, name: str) -> dict[str, Source]:
    table = mapping.tables[name]
    wanted = dict(table.channels)
    if table.geodetic is not None:
        wanted[LATITUDE] = Source((Term(table.geodetic.latitude),), missing=table.geodetic.missing)
        wanted[LONGITUDE] = Source((Term(table.geodetic.longitude),), missing=table.geodetic.missing)
    return wanted


def _clock(message: Any) -> str:
    """The header's stamp where there is one that was set."""
    try:
        # Drivers that set no stamp leave zero there, which would be 1970.
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
    total = source.offset
    for term in source.terms:
        try:
            value = field(message, term.field)
        except KeyError as error:
            raise bad_input(
                mapping.path, where, term.field, f"is not in the messages: {error.args[0]}", "mend the map"
            ) from None
        # JSON's null is a gap.
        if value is None:
            return math.nan
        try:
            number = float(plain_digits(value) if isinstance(value, str) else value)
        except (TypeError, ValueError, OverflowError):
            raise bad_input(
                mapping.path,
                where,
                term.field,
                f"holds a {type(value).__name__}, not a number",
                "name a number within it",
            ) from None
        if not math.isfinite(number) or number in source.missing:
            return math.nan
        total += term.scale * number
    return total
