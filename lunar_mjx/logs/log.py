"""A measurement log in memory: tables of channels, what was stated about them, and what reading them found wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.logs.findings import Finding
from lunar_mjx.wheel_bed.table import SteadyStateTable


@dataclasses.dataclass(frozen=True)
class Noise:
    """Stated noise of a channel.

    Attributes:
      std: standard deviation of one sample, in the channel's unit.
      source: datasheet, rest or replicate.
      correlation_time_s: of a first-order autoregressive part; 0 for white noise.
      correlated_share: of the variance, which that part has; the rest is white. 1: no white part is stated.
    """

    std: float
    source: str
    correlation_time_s: float = 0.0
    correlated_share: float = 1.0

    @property
    def white(self) -> float:
        """Standard deviation of the part without memory, in the channel's unit; 0 where none is stated."""
        return self.std * float(np.sqrt(1.0 - self.correlated_share)) if self.correlation_time_s > 0.0 else self.std

    @property
    def coloured(self) -> float:
        """Standard deviation of the autoregressive part, in the channel's unit."""
        return self.std * float(np.sqrt(self.correlated_share)) if self.correlation_time_s > 0.0 else 0.0


@dataclasses.dataclass(frozen=True)
class Imu:
    """How the IMU is mounted.

    Attributes:
      position_m: in the chassis frame.
      quaternion: w, x, y, z from the IMU's frame to the body's. Gyroscope and accelerometer channels are in the IMU's
        frame; so are roll, pitch, yaw and the quaternion where `attitude` says so.
      mounting_std_deg: standard deviation of the mounting about the body's x, y and z: how well `quaternion` is known.
        180 says that nothing is known.
      attitude: whether the attitude channels are the IMU's own and not the chassis's.
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    mounting_std_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    attitude: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class LogTable:
    """One table of a log: channels that share a clock.

    Attributes:
      name: as `[tables.NAME]`. file: its path.
      time_s: (n,) as written. channels: (n,) float64 by name of the schema, NaN at gaps, in the schema's units.
      rate_hz: stated; the median one of `time_s` if nothing is stated.
      clock_offset_s: add it to `time_s` to get the log's common time. clock_offset_std_s: its standard deviation.
      on_change: rows were written when a reading was new, and not at a rate; then none can be missed.
      columns: name in the file by channel.
    """

    name: str
    file: Path
    time_s: np.ndarray
    channels: Mapping[str, np.ndarray]
    rate_hz: float
    clock_offset_s: float = 0.0
    clock_offset_std_s: float = 0.0
    columns: Mapping[str, str] = dataclasses.field(default_factory=dict)
    on_change: bool = False

    @property
    def common_time_s(self) -> np.ndarray:
        """(n,) times on the log's common clock, s."""
        # Added when read: the times as written stay, for messages that name rows.
        return self.time_s + self.clock_offset_s

    def __len__(self) -> int:
        return len(self.time_s)


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """A drive log: one folder.

    Attributes:
      folder: where it lies. name: the folder's name.
      rover: name, or absolute path of a rover's folder. manoeuvre: canned name or free text.
      gravity_m_s2: positive. terrain: name, slope:10deg or absolute path. terrain_origin_m: where the log's origin
        lies in the terrain's coordinates, x and y.
      split: fit, select, test or None.
      environment: ambient temperature degC and Sun's angles deg: numbers, or the key itself where it is a channel.
      rover_changes, initial: as written; what is omitted is unknown.
      imu: where it is mounted.
      tables: by name. noise: by channel.
      source: who, licence, citation.
      problems: what reading found wrong; `check` passes them on.
      imposed: "wheel_speed" where the measured wheel speeds are taken as what the wheels did; None where the commands
        are what drove the rover.
      magnitudes: channels that hold a size without its sign, with what each reads where there is nothing, in its unit.
      ground: what was driven on, in the user's words. Where a model was fitted on other ground, `why` expects that
        something of the ground differs.
      geodetic_origin: latitude_deg, longitude_deg and projection of the point from which positions count, if stated.
    """

    folder: Path
    name: str
    rover: str
    manoeuvre: str
    gravity_m_s2: float
    terrain: str
    split: str | None
    environment: Mapping[str, float | str]
    rover_changes: Mapping[str, Any]
    initial: Mapping[str, Any]
    imu: Imu
    tables: Mapping[str, LogTable]
    noise: Mapping[str, Noise]
    source: Mapping[str, str]
    terrain_origin_m: tuple[float, float] = (0.0, 0.0)
    problems: tuple[Finding, ...] = ()
    imposed: str | None = None
    magnitudes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    ground: str = ""
    geodetic_origin: Mapping[str, float | str] = dataclasses.field(default_factory=dict)

    def channel(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Common time s and values of a channel without its gaps; None if no table has it."""
        for table in self.tables.values():
            if name in table.channels:
                values = table.channels[name]
                # Gaps are left out here, once, so that no reader has to think of them.
                keep = np.isfinite(values) & np.isfinite(table.time_s)
                return table.common_time_s[keep], values[keep]
        return None

    def table_of(self, channel: str) -> LogTable | None:
        """The table that holds a channel."""
        return next((t for t in self.tables.values() if channel in t.channels), None)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """All channels, in the order of the tables."""
        return tuple(c for t in self.tables.values() for c in t.channels)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last common time of all tables, s."""
        times = [t.common_time_s[np.isfinite(t.time_s)] for t in self.tables.values()]
        times = [t for t in times if t.size]
        return min(float(t.min()) for t in times), max(float(t.max()) for t in times)


@dataclasses.dataclass(frozen=True, eq=False)
class SteadyLog:
    """A steady-state log: the table of a single-wheel test bed.

    Attributes:
      folder: where it lies. name: the folder's name.
      table: one row per run; rows that `problems` refuses are left out.
      wheel: radius_m, width_m, grouser_count, grouser_height_m.
      noise: stated, by column. row_std: (n,) standard deviation of each row, by column, where the table gives it.
      split: fit, select, test or None. gravity_m_s2: positive. source: who, licence, citation.
      rows: (n,) row of the file of each row of the table. trial: (n,) number of the trial, or None.
      problems: what reading found wrong; `check` passes them on.
    """

    folder: Path
    name: str
    table: SteadyStateTable
    wheel: Mapping[str, float]
    noise: Mapping[str, Noise]
    split: str | None
    gravity_m_s2: float
    source: Mapping[str, str]
    row_std: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    trial: np.ndarray | None = None
    problems: tuple[Finding, ...] = ()
