"""Measurement logs to and from the `TimeSeries` of `mujoco.sysid`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.logs.log import Log, Noise
from lunar_mjx.logs.schema import find_channel, is_command, parse_column
from lunar_mjx.logs.write import write_log


def _sysid() -> Any:
    from mujoco import sysid

    if not hasattr(sysid, "TimeSeries"):
        raise UserError("log: mujoco.sysid is not complete here; install the extra lunar-mjx[sysid].")
    return sysid


def to_time_series(
    log: Log, channels: Sequence[str] | None = None, names: Mapping[str, str | tuple[str, Any]] | None = None
) -> dict[str, Any]:
    """The tables of a log as time series of mujoco.sysid, on the log's common clock.

    Rows with a gap in any of the channels are left out, because a time series has none.

    Args:
      log: a drive log. channels: to take; all if None.
      names: name of the signal by channel, or its name and `SignalType`, such as
        {"joint_lf_drive_speed_rad_s": ("lf_drive_speed", SignalType.MjSensor)}. Otherwise a channel keeps its name;
        commands are `MjCtrl` and everything else `CustomObs`.

    Returns:
      By table; data (n, channels) in the schema's units.

    Raises:
      UserError: a channel does not exist, no row is complete, or time does not rise.
    """
    sysid = _sysid()
    for channel in (*(channels or ()), *(names or ())):
        if channel not in log.channel_names:
            raise bad_input(log.folder, "channels", channel, "is not in the log", "use one of its channels")
    found = {}
    for table in log.tables.values():
        mine = [c for c in table.channels if channels is None or c in channels]
        if not mine:
            continue
        data = np.column_stack([table.channels[c] for c in mine])
        # Whole rows: a time series of sysid has one time for all its signals, and no gaps.
        keep = np.isfinite(data).all(axis=1) & np.isfinite(table.time_s)
        if not keep.any():
            raise UserError(f"{table.file}: no row holds all of {', '.join(mine)}; name fewer channels.")
        time = table.common_time_s[keep]
        if np.any(np.diff(time) <= 0.0):
            raise UserError(f"{table.file}: time_s does not rise; run lunar-mjx log check on the log first.")
        signals = []
        for c in mine:
            # Sysid replays controls and compares the rest.
            kind = sysid.SignalType.MjCtrl if is_command(c) else sysid.SignalType.CustomObs
            name = (names or {}).get(c, c)
            name, kind = (name, kind) if isinstance(name, str) else name
            signals.append((name, 1, kind))
        found[table.name] = sysid.TimeSeries.from_custom_map(time, data[keep], signals)
    return found


def from_time_series(
    series: Mapping[str, Any],
    folder: str | Path,
    *,
    rover: str,
    names: Mapping[str, str | Sequence[str]] | None = None,
    noise: Mapping[str, Noise] | None = None,
    **settings: Any,
) -> Path:
    """Writes a log folder from time series of mujoco.sysid.

    Args:
      series: by name of the table that each becomes.
      folder: must not exist, or be empty.
      rover, noise, settings: as for `write_log`.
      names: channel by signal, or one channel per column of a signal of several, such as
        {"imu_gyro": ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"]}. A signal that is not named here must carry a
        channel's name itself.

    Raises:
      UserError: a signal has no channel, or the number of channels is not that of its columns.
    """
    tables = {}
    used = set()
    for table, one in series.items():
        if one.signal_mapping is None:
            raise bad_input(
                "from_time_series",
                "series",
                table,
                "has no signal mapping",
                "make it with TimeSeries.from_custom_map or from_names",
            )
        columns: dict[str, np.ndarray] = {"time_s": np.asarray(one.times, float)}
        for signal, (_, places) in one.signal_mapping.items():
            used.add(signal)
            wanted: str | Sequence[str] = (names or {}).get(signal) or signal
            channels = [wanted] if isinstance(wanted, str) else list(wanted)
            if len(channels) != len(places):
                raise bad_input(
                    "from_time_series",
                    f"names[{signal!r}]",
                    channels,
                    f"has not one channel for each of {len(places)} columns",
                    "name one for each",
                )
            for channel, place in zip(channels, places, strict=True):
                if find_channel(channel) is None and parse_column(channel, table) is None:
                    raise bad_input(
                        "from_time_series",
                        "signal",
                        signal,
                        "is no channel",
                        f"name its channel: names={{{signal!r}: ...}}",
                    )
                columns[channel] = np.asarray(one.data, float)[:, place]
        tables[table] = pd.DataFrame(columns)
    # A name that nothing bears is a typing error, by which a channel would be lost without a word.
    for signal in names or ():
        if signal not in used:
            raise bad_input("from_time_series", "names", signal, "is in no series", "leave it out")
    return write_log(folder, tables, rover=rover, noise=noise, **settings)
