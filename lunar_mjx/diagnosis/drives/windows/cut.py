"""Cuts logs with imposed wheel speeds into windows: what the wheels did, how the ground leans, what was measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from lunar_mjx.dynamics.imposed import Windows
from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log

WINDOW_S = 2.0
"""Length of a window: short beside a drive, long beside the 0.1 s in which loads and yaw rate settle."""
SHORTEST_BIN_S = 0.1
"""Faster samples are averaged: currents at 100 Hz show the ripple of gears, which nobody models."""
LEVELLING_S = 1.0
"""Span over which an accelerometer is averaged to tell the slope: longer than a wheel takes over a stone, shorter than
the rover takes into another slope."""
STRATA = (0.05, 0.3)
"""Bounds between standing, slow and fast, m/s, of the mean and of half the difference of the sides' rim speeds."""
CHANNELS = ("motor_left_drive_current_A", "motor_right_drive_current_A", "gyro_z_rad_s")
SIDES = ("left", "right")


@dataclasses.dataclass(frozen=True, eq=False)
class Cut:
    """Windows of a campaign, all of one length and one sampling interval.

    Attributes:
      log: (window,) number of the log. start_s: (window,) time of its first sample on the log's clock.
      interval_s: between samples. imposed: speeds and slopes at the edges of half intervals.
      measured: by channel (window, sample), NaN where nothing was measured.
      magnitude: channels that hold sizes without sign.
      available: number of windows from which these were drawn.
    """

    log: np.ndarray
    start_s: np.ndarray
    interval_s: float
    imposed: Windows
    measured: dict[str, np.ndarray]
    magnitude: frozenset[str]
    available: int

    def __len__(self) -> int:
        return len(self.log)

    @property
    def samples(self) -> int:
        """Samples of a window."""
        return next(iter(self.measured.values())).shape[1]


def cut(logs: Sequence[Log], joints: Sequence[str], radius: float, most: int, seed: int = 0) -> Cut:
    """Windows of some logs, at most `most`, spread evenly over speeds and turns.

    Args:
      logs: with imposed wheel speeds.
      joints: corner and kind of every drive joint in the order of the controls, such as `lf_drive`.
      radius: of the wheels, m.
      most: windows at most.
      seed: of the draw.

    Raises:
      UserError: no log is long enough, or they are sampled too differently.
    """
    intervals = [float(np.median(np.diff(_speeds(log, "left")[0]))) for log in logs]
    interval = max(SHORTEST_BIN_S, float(np.median(intervals)))
    parts = [_windows(n, log, joints, radius, interval) for n, log in enumerate(logs)]
    whole = [np.concatenate(column) for column in zip(*parts, strict=True)]
    log, start, speed, up, yaw, values = whole
    if not len(log):
        raise UserError(
            f"{logs[0].folder}: no window of {WINDOW_S:g} s has wheel speeds without a gap; give longer logs."
        )
    chosen = _stratified(speed, radius, log, most, np.random.default_rng(seed))
    measured = {c: values[chosen, k] for k, c in enumerate(CHANNELS)}
    magnitude = frozenset(
        c for c in CHANNELS if any(c in log.magnitudes or _matches(c, log.magnitudes) for log in logs)
    )
    imposed = Windows(speed[chosen], up[chosen, :, 0], up[chosen, :, 1], up[chosen, :, 2], yaw[chosen])
    return Cut(log[chosen], start[chosen], interval, imposed, measured, magnitude, len(log))


def _matches(channel: str, patterns: frozenset[str]) -> bool:
    from fnmatch import fnmatchcase

    return any(fnmatchcase(channel, p) for p in patterns)


def _speeds(log: Log, side: str) -> tuple[np.ndarray, np.ndarray]:
    """Times s and speeds rad/s of a side, or of the first wheel of it."""
    for corner in (side, side[0] + "f", side[0] + "m", side[0] + "r"):
        found = log.channel(f"joint_{corner}_drive_speed_rad_s")
        if found is not None and len(found[0]) > 2:
            return found
    raise UserError(f"{log.folder}: has no wheel speeds of the {side} side, which imposed motion needs.")


def _windows(number: int, log: Log, joints: Sequence[str], radius: float, interval: float) -> tuple[np.ndarray, ...]:
    """All windows of a log: number, start, speeds at edges, up at edges, yaw rate, and measurements."""
    left, right = _speeds(log, "left"), _speeds(log, "right")
    count = max(3, round(WINDOW_S / interval))
    starts: list[float] = []
    for first, last in _stretches(left[0], interval):
        for at in np.arange(first, last - (count - 1.01) * interval, count * interval):
            if _covered(right[0], at + interval * np.arange(count), interval):
                starts.append(float(at))
    start = np.array(starts)
    half = 0.5 * interval
    edges = start[:, None] - half + half * np.arange(2 * count + 1)
    sides = {side: np.interp(edges, *s) for side, s in zip(SIDES, (left, right), strict=True)}
    speed = np.stack([sides["left" if j.startswith("l") else "right"] for j in joints], axis=-1)
    up = _up(log, edges, (left, right), radius)
    times = start[:, None] + interval * np.arange(count)
    own = {"motor_left_drive_current_A": ("l",), "motor_right_drive_current_A": ("r",)}
    values = []
    for channel in CHANNELS:
        found = log.channel(channel)
        if found is None and channel in own:
            found = _sum_of_wheels(log, own[channel][0])
        if found is None and channel == "gyro_z_rad_s":
            found = _turning(log)
        values.append(np.full(times.shape, np.nan) if found is None else _means(*found, times, interval))
    values = np.stack(values, axis=1) if len(start) else np.zeros((0, len(CHANNELS), count))
    begun = values[:, 2, 0] if len(start) else np.zeros(0)
    base = np.where(np.isfinite(begun), begun, 0.0)
    return np.full(len(start), number), start, speed, up, base, values


def _sum_of_wheels(log: Log, side: str) -> tuple[np.ndarray, np.ndarray] | None:
    found = [log.channel(f"motor_{side}{row}_drive_current_A") for row in "fmr"]
    found = [f for f in found if f is not None]
    return (found[0][0], sum(np.interp(found[0][0], *f) for f in found)) if found else None  # type: ignore[return-value]


def _turning(log: Log) -> tuple[np.ndarray, np.ndarray] | None:
    """The yaw rate as the slope of a measured heading."""
    found = log.channel("yaw_deg")
    if found is None:
        return None
    time, yaw = found
    return time, np.gradient(np.unwrap(np.radians(yaw)), time)


def _stretches(time: np.ndarray, interval: float) -> list[tuple[float, float]]:
    """First and last time of every stretch of samples without a gap."""
    breaks = np.flatnonzero(np.diff(time) > 1.6 * max(interval, float(np.median(np.diff(time)))))
    first, last = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(time) - 1]])
    return [(float(time[a]), float(time[b])) for a, b in zip(first, last, strict=True)]


def _covered(time: np.ndarray, wanted: np.ndarray, interval: float) -> bool:
    """Whether samples lie about all wanted times without a gap."""
    inside = time[(time >= wanted[0] - 1.5 * interval) & (time <= wanted[-1] + 1.5 * interval)]
    return len(inside) > 2 and float(np.diff(inside).max()) < 1.6 * max(interval, float(np.median(np.diff(time))))


def _means(time: np.ndarray, value: np.ndarray, wanted: np.ndarray, width: float) -> np.ndarray:
    """Means of the samples within half a width of every wanted time; NaN where there are none."""
    total = np.concatenate([[0.0], np.cumsum(value)])
    low = np.searchsorted(time, wanted - 0.5 * width - 1e-6)
    high = np.searchsorted(time, wanted + 0.5 * width - 1e-6)
    many = high - low
    return np.where(many > 0, (total[high] - total[low]) / np.maximum(many, 1), np.nan)


def _up(log: Log, edges: np.ndarray, sides: Sequence[tuple[np.ndarray, np.ndarray]], radius: float) -> np.ndarray:
    """(window, edge, 3) specific force of gravity in the chassis frame.

    From the accelerometer over a second, less what the wheels' speed-up explains of it; else from measured attitude;
    else level ground.
    """
    g = log.gravity_m_s2
    force = [log.channel(f"accelerometer_{a}_m_s2") for a in "xyz"]
    if all(f is not None for f in force):
        up = np.stack([_means(*f, edges, LEVELLING_S) for f in force], axis=-1)  # type: ignore[misc]
        ahead = [np.interp(edges + 0.5 * s * LEVELLING_S, *side) for side in sides for s in (1, -1)]
        up[..., 0] -= radius * 0.5 * (ahead[0] - ahead[1] + ahead[2] - ahead[3]) / LEVELLING_S
        level = np.array([0.0, 0.0, g])
        up = np.where(np.isfinite(up), up, level)
        size = np.linalg.norm(up, axis=-1, keepdims=True)
        return up * g / size
    roll, pitch = (log.channel(c) for c in ("roll_deg", "pitch_deg"))
    if roll is not None and pitch is not None:
        r, p = (np.radians(np.interp(edges, *f)) for f in (roll, pitch))
        return g * np.stack([-np.sin(p), np.sin(r) * np.cos(p), np.cos(r) * np.cos(p)], axis=-1)
    return np.broadcast_to(np.array([0.0, 0.0, g]), (*edges.shape, 3)).copy()


def _stratified(speed: np.ndarray, radius: float, log: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    """Numbers of the windows to use, in order: as many of every stratum of speed and turn and of every log."""
    left, right = radius * speed[..., 0].mean(axis=1), radius * speed[..., 1].mean(axis=1)
    ahead, turn = 0.5 * (left + right), 0.5 * (right - left)
    stratum = np.sign(ahead) * np.digitize(np.abs(ahead), STRATA) + 10 * np.sign(turn) * np.digitize(
        np.abs(turn), (0.02, 0.1)
    )
    moving = np.abs(radius * speed).mean(axis=(1, 2)) > 0.02
    order: list[int] = []
    queues = [
        list(rng.permutation(np.flatnonzero(moving & (log == n) & (stratum == s))))
        for n in np.unique(log)
        for s in np.unique(stratum)
    ]
    while any(queues) and len(order) < most:
        for queue in queues:
            if queue and len(order) < most:
                order.append(int(queue.pop()))
    return np.sort(np.array(order, int))
