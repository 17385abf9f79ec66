"""A drive on its way from a recording into a log: copies taken out, positions in metres, cut where it is asked for."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from lunar_mjx.errors import bad_input
from lunar_mjx.logs.noise import NOISE_ESTIMATE
from lunar_mjx.logs.readers.geodesy import tangent_plane, utm, utm_zone
from lunar_mjx.logs.readers.held import held_samples
from lunar_mjx.logs.readers.import_map import Geodetic
from lunar_mjx.logs.schema import channel_name, is_command, is_quantity, parse_column

TIME = "time_s"
LATITUDE, LONGITUDE = "latitude_deg", "longitude_deg"
"""Columns of a frame that `positions` replaces."""
_PLACES = {LATITUDE: "position_x_m", LONGITUDE: "position_y_m"}


@dataclasses.dataclass(frozen=True)
class Copies:
    """Channels of a slower sensor whose copies were left out: its period in s, its readings among so many rows."""

    channels: tuple[str, ...]
    period_s: float
    readings: int
    rows: int


@dataclasses.dataclass(frozen=True)
class RecordedDrive:
    """One drive of a recording.

    Attributes:
      name: of the drive. tables: frames by name, `time_s` first, channels after it; NaN at gaps.
      source: what goes into `[source]`. settings: keys of `log.toml` that reading has found.
      on_change: tables that hold the readings of slower sensors, which come when they are new.
      notes: what the user is told, one sentence each. copies: what was left out as copies of readings.
    """

    name: str
    tables: Mapping[str, pd.DataFrame]
    source: Mapping[str, str] = dataclasses.field(default_factory=dict)
    settings: Mapping[str, object] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()
    copies: tuple[Copies, ...] = ()
    on_change: frozenset[str] = frozenset()

    @property
    def seconds(self) -> float:
        """From the first to the last sample of all tables."""
        times = [f[TIME] for f in self.tables.values() if len(f)]
        return max(float(np.max(t)) for t in times) - min(float(np.min(t)) for t in times) if times else 0.0


def positions(frame: pd.DataFrame, geodetic: Geodetic, source: Path) -> tuple[pd.DataFrame, dict[str, float | str]]:
    """Latitude and longitude columns as `position_x_m` east and `position_y_m` north, and the origin they count from.

    The origin is empty where there is no fix at all.

    Args:
      source: file or folder of the recording, for a sentence that refuses it.

    Raises:
      UserError: an angle is none.
    """
    latitude, longitude = (frame[c].to_numpy(float) for c in (LATITUDE, LONGITUDE))
    # a receiver without a fix writes zeros
    there = np.isfinite(latitude) & np.isfinite(longitude) & ((latitude != 0.0) | (longitude != 0.0))
    out = frame.drop(columns=[LATITUDE, LONGITUDE])
    if not there.any():
        return out, {}
    for name, values, most in ((LATITUDE, latitude, 90.0), (LONGITUDE, longitude, 360.0)):
        beyond = there & (np.abs(values) > most)
        if beyond.any():
            row = int(np.argmax(beyond))
            # Receivers write degrees and minutes as one number (NMEA 0183: ddmm.mmmm), which no angle shows.
            raise bad_input(
                source,
                f"{name}, row {row}",
                float(values[row]),
                f"is outside [-{most:g}, {most:g}]",
                "record degrees, not degrees and minutes (ddmm.mmmm)",
            )
    first = int(np.argmax(there))
    # The first fix: local metres near zero keep their digits in float32.
    origin = geodetic.origin_deg or (float(latitude[first]), float(longitude[first]))
    if geodetic.projection == "utm":
        zone = utm_zone(origin[1])
        east, north = utm(latitude, longitude, zone)
        x0, y0 = geodetic.origin_m or tuple(float(v) for v in utm(np.array(origin[0]), np.array(origin[1]), zone))
        east, north = east - x0, north - y0
    else:
        east, north = tangent_plane(latitude, longitude, origin)
    out["position_x_m"], out["position_y_m"] = np.where(there, east, np.nan), np.where(there, north, np.nan)
    return out, {LATITUDE: origin[0], LONGITUDE: origin[1], "projection": geodetic.projection}


def without_copies(frame: pd.DataFrame, time: np.ndarray) -> tuple[dict[str, pd.DataFrame], list[Copies]]:
    """Readings of slower sensors as frames of their own, by what they measure; the rest of the frame has the key "".

    Channels of one quantity are taken together. Commands stay as they are: they hold until the next one.

    Args:
      frame: columns of channels among others, which every part keeps.
      time: (n,) rising time by which copies are told, s.
    """
    groups: dict[str, list[str]] = {}
    others = []
    for column in frame.columns:
        if column in (LATITUDE, LONGITUDE):
            groups.setdefault("position", []).append(column)
            continue
        found = parse_column(column, "import")
        if found is None or found.channel is None:
            others.append(column)
            continue
        quantity = channel_name(found.name).quantity
        if not is_command(found.name):
            # angles of one attitude come in one message
            # Grouped, since a repeat of one component alone may be chance.
            family = "attitude" if found.channel.family == "attitude" else quantity
            groups.setdefault(family, []).append(column)
    out, copies, rest = {}, [], frame
    for quantity, columns in groups.items():
        held = held_samples(time, frame[columns].to_numpy(float), recurs=quantity not in ("position", "attitude"))
        if held is not None:
            rest = rest.drop(columns=columns)
            out[quantity] = frame.loc[held.readings, [*others, *columns]].reset_index(drop=True)
            named = tuple(_PLACES.get(c, c) for c in columns)
            copies.append(Copies(named, held.period_s, int(held.readings.sum()), len(frame)))
    # Time alone is no table.
    if len(rest.columns) > len(others) or not out:
        out[""] = rest
    return out, copies


def without_empty(drive: RecordedDrive) -> RecordedDrive:
    """The drive without columns that hold no number at all, which its notes name."""
    tables, notes = {}, list(drive.notes)
    for name, frame in drive.tables.items():
        empty = [c for c in frame.columns if bool(np.all(frame[c].isna()))]
        if empty:
            notes.append(f"{', '.join(empty)}: holds no number in this drive and is left out")
        kept = frame.drop(columns=empty)
        if len(kept.columns) > 1:
            tables[name] = kept
    return dataclasses.replace(drive, tables=tables, notes=tuple(notes))


def cut(drive: RecordedDrive, gap_s: float | None, rest_s: float | None) -> Iterator[RecordedDrive]:
    """The drive in pieces: cut where all tables lack samples for `gap_s`, and in the middle of rests of `rest_s`.

    Every sample is in one piece; what is too short to be a table (fewer than three rows) is told in the notes.
    """
    edges = [*(_gaps(drive, gap_s) if gap_s else ()), *(_rests(drive, rest_s) if rest_s else ())]
    # Every sample falls into one piece.
    bounds = [-np.inf, *sorted(edges), np.inf]
    pieces: list[RecordedDrive] = []
    for low, high in itertools.pairwise(bounds):
        tables = {}
        lost = 0
        for name, frame in drive.tables.items():
            inside = frame[(frame[TIME] >= low) & (frame[TIME] < high)].reset_index(drop=True)
            if len(inside) >= 3:
                tables[name] = inside
            else:
                lost += len(inside)
        notes = (f"{lost} rows lie in a piece too short for a table and are left out",) if lost else ()
        if tables:
            pieces.append(dataclasses.replace(drive, tables=tables, notes=notes))
        elif pieces and notes:
            pieces[-1] = dataclasses.replace(pieces[-1], notes=(*pieces[-1].notes, *notes))
    if len(pieces) < 2:
        yield drive
        return
    for k, piece in enumerate(pieces, 1):
        start = min(float(f[TIME].iloc[0]) for f in piece.tables.values())
        where = f"{start:.2f} s to {start + piece.seconds:.2f} s"
        # All tables of a piece by one start: their offsets to each other are what clocks are checked by.
        shifted = {n: f.assign(**{TIME: f[TIME] - start}) for n, f in piece.tables.items()}
        notes, copies = ((*drive.notes, *piece.notes), drive.copies) if k == 1 else (piece.notes, ())
        source = {**drive.source, "segment": where}
        yield dataclasses.replace(
            piece, name=f"{drive.name}_{k:02d}", tables=shifted, source=source, notes=notes, copies=copies
        )


def _gaps(drive: RecordedDrive, gap_s: float) -> list[float]:
    time = np.sort(np.concatenate([f[TIME].to_numpy(float) for f in drive.tables.values()]))
    at = np.flatnonzero(np.diff(time) > gap_s)
    # Cut in the middle, where no sample lies.
    return [0.5 * float(time[k] + time[k + 1]) for k in at]


def _rests(drive: RecordedDrive, rest_s: float) -> list[float]:
    """Middles of spans in which every wheel speed that is measured, else commanded, is zero."""
    for quantity in ("joint_speed", "command_speed"):
        series = [
            (f[TIME].to_numpy(float)[keep], column.scale * f[c].to_numpy(float)[keep])
            for f in drive.tables.values()
            for c in f.columns
            if (column := parse_column(c, drive.name)) is not None
            and is_quantity(column.name, quantity, "drive")
            and (keep := f[c].notna().to_numpy()).any()
        ]
        if series:
            break
    else:
        return []
    time = np.unique(np.concatenate([t for t, _ in series]))
    still = np.ones(len(time), bool)
    for t, v in series:
        still &= (
            np.abs(v[np.maximum(np.searchsorted(t, time + 1e-9, side="right") - 1, 0)]) < NOISE_ESTIMATE.still_rad_s
        )
    edges = np.diff(np.concatenate([[0], still.astype(int), [0]]))
    spans = zip(time[np.flatnonzero(edges == 1)], time[np.flatnonzero(edges == -1) - 1], strict=True)
    # at the recording's own ends there is nothing to cut off
    return [float(0.5 * (a + b)) for a, b in spans if b - a >= rest_s and a > time[0] and b < time[-1]]
