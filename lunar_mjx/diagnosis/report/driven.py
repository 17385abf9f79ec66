"""A run's drive as the viewer plays it back: where the rover was, and where each model says that it was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lunar_mjx.diagnosis.folder.stored import read_stored
from lunar_mjx.diagnosis.report.read import Result, Traces, read_result
from lunar_mjx.diagnosis.report.windowed import rows_of, way_of, windows_of
from lunar_mjx.diagnosis.report.words import channel_label
from lunar_mjx.diagnosis.runs import WINDOWS_FILE
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.inference.observations import Series
from lunar_mjx.rover import Rover
from lunar_mjx.viewer.replay import Course, Replay, Trace

_MOST_TRACES = 4
"""Channels beside the picture: those that fit on a screen of 768 rows."""
_LEAST_STEP = 0.02
"""m between places whose direction tells a heading where none was measured."""


def replayed(folder: str | Path, log: str = "") -> Replay:
    """The drive of a run folder.

    Args:
      folder: of the run. log: name of one of its logs; if empty the first that measured positions, or all windows of
        a run that was cut into such.

    Returns:
      The measured course, that of each model, and the channels in which the last model is worst.

    Raises:
      UserError: no run, no such log, a log that tells no way, or a model that cannot be loaded any more.
    """
    folder = Path(folder)
    result = read_result(folder)
    traces = result.traces
    if traces is None:
        raise UserError(f"{folder}: holds no series.npz yet; make it with lunar-mjx compare.")
    stored = read_stored(folder / WINDOWS_FILE)
    windows = windows_of(stored, traces, log)
    number = 0 if windows else _log(folder, traces, log, sorted({one.name for one in windows_of(stored, traces)}))
    model = result.model
    if model is None:
        raise UserError(f"{folder}: its model cannot be loaded here, and brings the rover; run lunar-mjx compare anew.")
    labels = [_label(result, label) for label in traces.labels]
    if windows:
        measured, *courses = (
            way_of(label, traces, windows, row) for row, label in ((None, "measured"), *enumerate(labels))
        )
        channels = traces.channels
        told = {channel: rows_of(traces, windows, channel) for channel in channels}
        parts = [(one.shown, one.label) for one in windows]
        return Replay(model, folder.resolve().name, measured, courses, _worst(traces, told), parts)
    name = traces.observations.logs[number]
    courses = [_course(label, traces, number, row, model.rover) for row, label in enumerate(labels)]
    mine = [s for s in traces.observations.series if s.log == number]
    told = {s.channel: (traces.time[s.start : s.stop], np.arange(s.start, s.stop)) for s in mine}
    return Replay(model, name, _course("measured", traces, number, None, model.rover), courses, _worst(traces, told))


def _label(result: Result, label: str) -> str:
    added = ", ".join(result.run.get("added", []))
    return f"with {added}, refitted" if label == "refitted" and added else label


def _log(folder: Path, traces: Traces, wanted: str, in_windows: Sequence[str]) -> int:
    """Number of the log to show, which is none of those that can be shown in windows."""
    o = traces.observations
    placed = [
        i for i in range(len(o.logs)) if _series(traces, i, "position_x_m") and _series(traces, i, "position_y_m")
    ]
    if wanted and wanted not in o.logs:
        raise bad_input(folder, "--log", wanted, "is none of its logs", f"use one of {', '.join(o.logs)}")
    chosen = [i for i in placed if not wanted or o.logs[i] == wanted]
    if not chosen:
        usable = [o.logs[i] for i in placed] or in_windows
        remedy = f"use one of {', '.join(usable)}" if usable else "look at it with lunar-mjx studio"
        raise bad_input(
            folder,
            "--replay",
            wanted or folder.name,
            "measured no positions to put a rover at, nor in windows a speed ahead and a yaw rate",
            remedy,
        )
    return chosen[0]


def _series(traces: Traces, log: int, channel: str) -> Series | None:
    return next((s for s in traces.observations.series if s.log == log and s.channel == channel), None)


def _values(traces: Traces, series: Series, row: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of a series, measured (row None) or predicted, without what is missing."""
    part = slice(series.start, series.stop)
    value = traces.observations.value[part] if row is None else traces.predicted[row, part]
    keep = np.isfinite(value) & np.isfinite(traces.time[part])
    return traces.time[part][keep], value[keep]


def _course(label: str, traces: Traces, log: int, row: int | None, rover: Rover) -> Course:
    along, across = (_series(traces, log, f"position_{a}_m") for a in "xy")
    assert along is not None and across is not None
    time, x = _values(traces, along, row)
    y = np.interp(time, *_values(traces, across, row))
    heading = _series(traces, log, "yaw_deg")
    if heading is not None:
        heading_time, degrees = _values(traces, heading, row)
        # Without jumps: halfway between 179 and -179 degrees lies 180, and not 0.
        yaw = np.interp(time, heading_time, np.unwrap(np.radians(degrees)))
    else:
        yaw = _direction(x, y)
    noise = 0.0 if row is not None else float(np.max(along.white))
    return Course(label, time, x, y, yaw, _joints(traces, log, row, rover), noise)


def _joints(traces: Traces, log: int, row: int | None, rover: Rover) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Times, s, and angles, rad, of drives and steered joints that the log tells, by the wheel or by its side."""
    found = {}
    for wheel in rover.wheels:
        for joint, kind in ((wheel.drive, "drive"), (wheel.steer, "steer")):
            # Where one motor drives a side, its channel stands for all wheels there; a wheel's own comes first.
            for place in filter(None, (wheel.corner, wheel.side)) if joint is not None else ():
                angle = _series(traces, log, f"joint_{place}_{kind}_angle_rad")
                speed = _series(traces, log, f"joint_{place}_{kind}_speed_rad_s")
                if angle is not None:
                    found.setdefault(joint, _values(traces, angle, row))
                elif speed is not None and kind == "drive":
                    time, rate = _values(traces, speed, row)
                    # From no known start: on a wheel, which is round, the constant does not show.
                    way = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])
                    found.setdefault(joint, (time, way[: len(time)]))
    return {joint: known for joint, known in found.items() if len(known[0])}


def _direction(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heading of the way, rad: that of the last place that was far enough away, as if it drove forward."""
    yaw, last, has_direction = np.zeros(len(x)), 0, False
    for i in range(1, len(x)):
        yaw[i] = yaw[i - 1]
        if np.hypot(x[i] - x[last], y[i] - y[last]) >= _LEAST_STEP:
            yaw[i], last = np.arctan2(y[i] - y[last], x[i] - x[last]), i
            # Before it moved it stood as it set off.
            if not has_direction:
                yaw[:i], has_direction = yaw[i], True
    return np.unwrap(yaw)


def _worst(traces: Traces, told: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> list[Trace]:
    """Channels in which the last model leaves most, worst first.

    Args:
      traces: of the run. told: times, s, and numbers of a channel's observations, -1 where its curve is interrupted.
    """
    left = {c: float(np.nanmean(traces.residual[-1, at[at >= 0]] ** 2)) for c, (_, at) in told.items() if len(at)}
    out = []
    for channel in sorted(left, key=lambda c: -left[c])[:_MOST_TRACES]:
        time, at = told[channel]
        values = (traces.observations.value, traces.predicted, traces.residual)
        out.append(Trace(channel_label(channel), time, *(np.where(at < 0, np.nan, v[..., at]) for v in values)))
    return out
