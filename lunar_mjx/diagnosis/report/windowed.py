"""Windows of imposed wheel speeds as one drive for the viewer: each goes on where the one before was measured to end.

Such a run keeps no places: the ways of rover and models are sums of the speed ahead and the yaw rate that it keeps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_mjx.diagnosis.drives.windows.cut import AHEAD, GYRO
from lunar_mjx.diagnosis.report.read import Traces
from lunar_mjx.viewer.replay import Course


@dataclasses.dataclass(frozen=True, eq=False)
class Window:
    """A window of a run, and when it is shown.

    Attributes:
      log: number of its log. name: of the log. start: of its first sample on the log's clock, s.
      held_out: whether no fit saw it. shown: when it begins as shown, s. time: (n,) of its samples, s after its begin.
    """

    log: int
    name: str
    start: float
    held_out: bool
    shown: float
    time: NDArray[np.float64]

    @property
    def label(self) -> str:
        """Its log and where in it, for people."""
        return f"{self.name}, from {self.start:.1f} s" + (", held out" if self.held_out else "")


def windows_of(stored: Mapping[str, Any] | None, traces: Traces, log: str = "") -> list[Window]:
    """The windows of a run that tell a way, one after another; none where nothing was cut into such windows.

    Args:
      stored: contents of `windows.json`. traces: of the run. log: name of the log whose windows are wanted; all if "".
    """
    found: list[Window] = []
    if stored is None:
        return found
    for used in stored["used"]:
        if used["log"] not in traces.observations.logs or log not in ("", used["log"]):
            continue
        step, length = stored["interval_s"], stored["window_s"]
        one = Window(
            traces.observations.logs.index(used["log"]),
            used["log"],
            used["start_s"],
            used["split"] != "fit",
            # Its samples stand for intervals about them: the next window's first one lies an interval after the last.
            len(found) * length,
            step * np.arange(max(round(length / step), 2)),
        )
        if all(len(_rows(traces, one, channel)) for channel in (AHEAD, GYRO)):
            found.append(one)
    return found


def rows_of(traces: Traces, windows: Iterable[Window], channel: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Times as shown, (n,) s, and numbers, (n,), of a channel's observations; -1 ends every window's."""
    time, rows = [np.zeros(0)], [np.zeros(0, int)]
    for one in windows:
        mine = _rows(traces, one, channel)
        if len(mine):
            at = one.shown + traces.time[mine] - one.start
            time.append(np.append(at, at[-1]))
            rows.append(np.append(mine, -1))
    return np.concatenate(time), np.concatenate(rows)


def way_of(label: str, traces: Traces, windows: Iterable[Window], row: int | None) -> Course:
    """The way of the measured rover, or of a model that sets out in every window where the rover then was.

    Args:
      label: who says so. traces: of the run. windows: one after another. row: number of the model; None: as measured.
    """
    begin, parts = np.zeros(3), []
    for one in windows:
        measured = _way(traces, one, None, begin)
        parts.append((one.shown + one.time, measured if row is None else _way(traces, one, row, begin)))
        begin = measured[-1]
    way = np.concatenate([w for _, w in parts])
    return Course(label, np.concatenate([t for t, _ in parts]), way[:, 0], way[:, 1], way[:, 2])


def _rows(traces: Traces, one: Window, channel: str) -> NDArray[np.int64]:
    """Numbers of a channel's finite measurements within a window."""
    half = 0.5 * (one.time[1] - one.time[0])
    for s in traces.observations.series:
        if s.log == one.log and s.channel == channel:
            at = traces.time[s.start : s.stop] - one.start
            known = np.isfinite(traces.observations.value[s.start : s.stop])
            return s.start + np.flatnonzero(known & (at > -half) & (at < one.time[-1] + half))
    return np.zeros(0, int)


def _way(traces: Traces, one: Window, row: int | None, begin: np.ndarray) -> np.ndarray:
    """Place and heading (n, 3), m and rad, at the samples of a window that begins at a place and heading (3,)."""

    def values(channel: str) -> np.ndarray:
        mine = _rows(traces, one, channel)
        known = traces.observations.value if row is None else traces.predicted[row]
        return np.interp(one.time, traces.time[mine] - one.start, known[mine])

    def total(rate: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(one.time))])

    yaw = begin[2] + total(values(GYRO))
    ahead = values(AHEAD)
    return np.column_stack([begin[0] + total(ahead * np.cos(yaw)), begin[1] + total(ahead * np.sin(yaw)), yaw])
