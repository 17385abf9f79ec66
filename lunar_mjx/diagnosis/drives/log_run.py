"""A log made ready to simulate: its model, its commands on whole time steps, and where the rover stands at first."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, log_model
from lunar_mjx.logs import commands as log_commands
from lunar_mjx.model import ZERO_CELSIUS, Model
from lunar_mjx.terrain.heightfield import slope

SETTLE = 1.0
"""Least time for which a rover stands before a log begins, s: it sinks to rest, as the real one had before."""
STOOD = "stood"
"""Name of the time for which a rover had stood before a log, s."""
_FINEST = 0.01
"""Shortest interval of telemetry, s."""
_LEVEL = math.radians(1.0)
"""On a steeper slope a rover creeps for seconds, ever slower: how long it has stood may show in its currents."""


@dataclasses.dataclass(frozen=True, eq=False)
class LogRun:
    """A log made ready to simulate.

    Attributes:
      model: the union model under the log's conditions.
      commands: (time, joint). every: time steps per command.
      begin, end: common time of the first command and of the last telemetry, s.
      start: x, y m, yaw rad, temperature K, time it had stood s. unknown: which of these a fit must find.
      imu_position: m.
    """

    model: Model
    commands: np.ndarray
    every: int
    begin: float
    end: float
    start: Mapping[str, float]
    unknown: tuple[str, ...]
    imu_position: tuple[float, float, float]


def log_run(log: Log, model: Model) -> LogRun:
    """A log made ready: its model, its commands on whole time steps, and where the rover stands at first.

    Raises:
      UserError: the log is shorter than two samples, or is of another rover.
    """
    own = log_model(log, model)
    given, begin = log_commands(log, own)
    every = round(given.interval / own.timestep)
    values = given.values
    finest = max(_FINEST, min(float(np.median(np.diff(t.time_s))) for t in log.tables.values() if len(t) > 2))
    split = next((k for k in range(1, every + 1) if every % k == 0 and given.interval / k <= 1.01 * finest), 1)
    values, every = np.repeat(values, split, axis=0), every // split
    if len(values) < 3:
        raise UserError(f"{log.folder}: is too short to simulate ({len(values)} commands); record a longer drive.")
    end = begin + (len(values) - 1) * every * own.timestep
    start, unknown = _start(log, own)
    return LogRun(own, values, every, begin, end, start, unknown, tuple(log.imu.position_m))  # type: ignore[arg-type]


def _start(log: Log, model: Model) -> tuple[dict[str, float], tuple[str, ...]]:
    """Pose, temperature and time of standing at the first samples, and which of them a fit must find."""
    start = {"x": 0.0, "y": 0.0, "yaw": 0.0, "temperature": float(model.ambient[0]), STOOD: SETTLE}
    unknown = []

    def first(channel: str) -> float | None:
        found = log.channel(channel)
        return None if found is None or not len(found[1]) else float(np.mean(found[1][:5]))

    stated = log.initial.get("position_m")
    for i, axis in enumerate("xy"):
        value = first(f"position_{axis}_m")
        if stated is not None:
            start[axis] = float(stated[i])
        if value is not None:
            start[axis] = value
            unknown.append(axis)
    yaw = first("yaw_deg")
    if yaw is not None:
        start["yaw"] = float(np.deg2rad(yaw))
        unknown.append("yaw")
    temperatures = [first(c) for c in log.channel_names if c.endswith("_temperature_degC")]
    known = [t for t in temperatures if t is not None]
    if known:
        start["temperature"] = float(np.mean(known)) + ZERO_CELSIUS
        unknown.append("temperature")
    if float(slope(model.terrain.field, start["x"], start["y"])) > _LEVEL:
        start[STOOD] = 2.0 * SETTLE
        unknown.append(STOOD)
    return start, tuple(unknown)
