"""Measurement logs from recordings as they come: `lunar-mjx log import`."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from lunar_mjx.errors import UserError
from lunar_mjx.logs.readers.drives_from_bags import drive_of_bag
from lunar_mjx.logs.readers.drives_from_files import drives_of_files
from lunar_mjx.logs.readers.import_map import ImportMap, changed, merged, read_map
from lunar_mjx.logs.readers.recorded_drive import Copies, RecordedDrive, cut
from lunar_mjx.logs.schema import find_channel, is_quantity, parse_column
from lunar_mjx.logs.write import refuse_used, write_log


@dataclasses.dataclass(frozen=True)
class Imported:
    """What an import has written.

    Attributes:
      folder: the log, or the campaign whose folders are the logs. logs: folders of the logs.
      notes: what the user should know, by log: columns not read, rows that no table takes, files that lack.
      copies: what was left out as copies of a slower sensor's readings, one sentence each.
      seconds: length of each log.
    """

    folder: Path
    logs: tuple[Path, ...]
    notes: tuple[tuple[str, str], ...]
    copies: tuple[str, ...]
    seconds: tuple[float, ...]


def import_log(
    recording: str | Path | Sequence[str | Path],
    folder: str | Path,
    mapping: str | Path | ImportMap,
    *,
    changes: Mapping[str, Any] | None = None,
    split_at_gaps_s: float | None = None,
    split_at_rest_s: float | None = None,
) -> Path:
    """Writes a log, or a campaign of logs where the recordings hold several drives, and returns its folder.

    `import_drives` says more of what it found.

    Args:
      recording: MCAP file, bag of ROS 1, file or folder of ROS 2; or plain files and folders of files (CSV, TXT,
        Parquet, MATLAB), several for one drive.
      folder: must not exist, or be empty.
      mapping: the map, its file, or the name of a shipped one.
      changes: keys of `log.toml` over those of the map.
      split_at_gaps_s, split_at_rest_s: cut drives where nothing is recorded, or the rover stands, for so long.

    Raises:
      UserError: a recording or the map is wrong, or the package that reads the recording is missing.
    """
    return import_drives(
        recording, folder, mapping, changes=changes, split_at_gaps_s=split_at_gaps_s, split_at_rest_s=split_at_rest_s
    ).folder


def import_drives(
    recording: str | Path | Sequence[str | Path],
    folder: str | Path,
    mapping: str | Path | ImportMap,
    *,
    changes: Mapping[str, Any] | None = None,
    split_at_gaps_s: float | None = None,
    split_at_rest_s: float | None = None,
) -> Imported:
    """Writes what `import_log` writes, and returns the folders with what should be known of them.

    A single drive is written to `folder` itself; several become folders in it. Nothing is cut off: every row of a
    mapped column is in some log, but for copies and rows that the notes count.

    Raises:
      UserError: as `import_log`.
    """
    mapping = mapping if isinstance(mapping, ImportMap) else read_map(mapping)
    mapping = changed(mapping, changes or {})
    paths = [Path(p) for p in ([recording] if isinstance(recording, str | Path) else recording)]
    folder = Path(folder)
    if not paths:
        raise UserError("log import: no recording is given; name a file or a folder.")
    # Before hours of reading.
    refuse_used(folder)
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: the recording is not there; check the path or its spelling.")
    drives = [drive_of_bag(p, mapping) for p in paths] if mapping.reads_topics else drives_of_files(paths, mapping)
    pieces = [piece for drive in drives for piece in cut(drive, split_at_gaps_s, split_at_rest_s)]
    usable = [d for d in pieces if d.tables]
    notes = [(d.name, note) for d in pieces for note in d.notes]
    notes += [(d.name, "holds nothing that the map reads") for d in pieces if not d.tables]
    if not usable:
        raise UserError(f"{paths[0]}: holds no drive that the map {mapping.path.name} reads; correct the map.")
    alone = len(usable) == 1
    logs = []
    for drive in usable:
        place = folder if alone else folder / drive.name
        logs.append(
            write_log(
                place,
                drive.tables,
                rover=_rover_from(place, mapping),
                noise=mapping.noise,
                clock_offsets_s=_offsets(drive, mapping),
                on_change=drive.on_change,
                **_settings(drive, mapping, changes),
            )
        )
    copies = _told([c for d in pieces for c in d.copies], len(usable))
    return Imported(folder, tuple(logs), tuple(notes), copies, tuple(d.seconds for d in usable))


def _rover_from(place: Path, mapping: ImportMap) -> str:
    """The map's rover as a log in a folder names it: a path counted from that folder, or a shipped name.

    A path in a map counts from where the command runs, else from the map. The log is read from anywhere.
    """
    for base in (Path(), mapping.path.parent):
        folder = base / mapping.rover
        if (folder / "rover.toml").is_file():
            return Path(os.path.relpath(folder.resolve(), place.resolve())).as_posix()
    return mapping.rover


def _told(copies: Sequence[Copies], drives: int) -> tuple[str, ...]:
    """One sentence per set of channels, however many drives there are."""
    by_channels: dict[tuple[str, ...], list[Copies]] = {}
    for c in copies:
        by_channels.setdefault(c.channels, []).append(c)
    told = []
    for channels, found in by_channels.items():
        low, high = min(c.period_s for c in found), max(c.period_s for c in found)
        period = f"{low:.3g}" if high < 1.05 * low else f"{low:.3g} to {high:.3g}"
        readings, rows = sum(c.readings for c in found), sum(c.rows for c in found)
        where = f" in {len(found)} recording{'s' if len(found) > 1 else ''}" if drives > 1 else ""
        told.append(
            f"{', '.join(channels)}: renewed every {period} s only{where}; {readings} of {rows} rows are "
            "readings, the others are copies of these and left out"
        )
    return tuple(told)


def _settings(drive: RecordedDrive, mapping: ImportMap, changes: Mapping[str, Any] | None) -> dict[str, Any]:
    """Keys of `log.toml`: the map's, what reading found, and the user's own over both."""
    # The nearer to the user the later: map, then what the recording says, then the call.
    settings = merged(mapping.settings, drive.settings)
    settings = merged(settings, {k: v for k, v in (changes or {}).items() if k not in ("rover", "noise")})
    # Columns may be in units of their own: what they hold is asked by the name that reading will give them.
    columns = {c for frame in drive.tables.values() for c in frame.columns}
    channels = {c if (found := parse_column(c, drive.name)) is None else found.name for c in columns}
    if "magnitudes" in settings:
        stated = settings["magnitudes"]
        kept = [m for m in stated if _names(m, channels)]
        settings["magnitudes"] = {m: stated[m] for m in kept} if isinstance(stated, Mapping) else kept
    if not any(is_quantity(c, "joint_speed", "drive") for c in channels):
        # A map serves many drives; one without wheel speeds cannot have them imposed.
        settings.pop("imposed", None)
    return {**settings, "source": {**settings.get("source", {}), **drive.source}}


def _names(magnitude: str, channels: Collection[str]) -> bool:
    """Whether an entry of `magnitudes` names a channel of this drive, or none at all, which reading will refuse."""
    if "*" in magnitude:
        return any(fnmatchcase(c, magnitude) for c in channels)
    return magnitude in channels or find_channel(magnitude) is None


def _offsets(drive: RecordedDrive, mapping: ImportMap) -> dict[str, tuple[float, float]]:
    """Clock offsets by table; tables of renewed readings share that of the table they were taken from."""
    out = {}
    for name in drive.tables:
        origin = next((t for t in _by_length(mapping.tables) if name == t or name.startswith(f"{t}_")), None)
        table = mapping.tables.get(origin or "")
        if table is not None and (table.clock_offset_s or table.clock_offset_std_s):
            out[name] = (table.clock_offset_s, table.clock_offset_std_s)
    return out


def _by_length(names: Iterable[str]) -> list[str]:
    # The longest first: `imu_left` shall not be taken for a part of `imu`.
    return sorted(names, key=len, reverse=True)
