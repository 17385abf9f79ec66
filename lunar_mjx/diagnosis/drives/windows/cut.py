"""Cuts logs with imposed wheel speeds into windows: what the wheels did, how the ground leans, what was measured."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_mjx.dynamics.imposed import Windows
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.logs import Log


@dataclasses.dataclass(frozen=True)
class Cutting:
    """How drives are cut into windows, and which windows are left out."""

    window_s: float = 2.0
    """Length of a window: short beside a drive, long beside the 0.1 s in which loads and yaw rate settle."""
    shortest_bin_s: float = 0.1
    """Faster samples are averaged: currents at 100 Hz show the ripple of gears, which nobody models."""
    # Interval of wheel speeds from which they are known only about each reading: windows then lie about the readings,
    # and have so many samples of what is measured faster.
    slow_s: float = 0.4
    slow_bins: int = 10
    levelling_s: float = 1.0
    """Span over which an accelerometer is averaged to tell the slope: longer than a wheel takes over a stone, shorter
    than the rover takes into another slope."""
    strata: tuple[float, float] = (0.05, 0.3)
    """Bounds between standing, slow and fast, m/s, of the mean and of half the difference of the sides' rim speeds."""
    # Time between two positions that tell a speed, and the most over it: poses by lidar come up to 0.1 s early or
    # late, so that neighbours would tell 6 m/s of a rover that drives 1 m/s (DRIVE).
    speed_span_s: float = 0.5
    most_span: float = 5.0
    unknown_heading_deg: float = 20.0
    """Standard deviation of an IMU's mounting about the vertical from which its heading has no known zero."""
    # Share of the wheels' turning below which a rover that turns on the spot is held, and the least turning of the
    # wheels that is asked. A free one on even ground turns by a third of it and more: friction across the wheels acts
    # on shorter levers than friction along them.
    held: float = 0.1
    turning_rad_s: float = 0.1
    # Steps in which clocks are laid against each other; time after which what a gyroscope shows beyond the wheels'
    # turning is another matter, so that so many seconds count as one measurement.
    lag_step_s: float = 0.02
    independent_s: float = 0.5


CUTTING = Cutting()

CURRENTS = ("motor_left_drive_current_A", "motor_right_drive_current_A")
GYRO, AHEAD = "gyro_z_rad_s", "body_velocity_x_m_s"
CHANNELS = (*CURRENTS, GYRO, AHEAD)
"""What windows are judged by, as far as a log tells it: currents of the sides (or of their wheels), yaw rate (or
heading), and speed over ground along the chassis (or positions with a heading)."""
SIDES = ("left", "right")


@dataclasses.dataclass(frozen=True, eq=False)
class Cut:
    """Windows of a campaign, all of one length and one sampling interval.

    Attributes:
      log: (window,) number of the log. start_s: (window,) time of its first sample on the log's clock.
      interval_s: between samples. imposed: speeds and slopes at the edges of half intervals.
      measured: by channel (window, sample), NaN where nothing was measured.
      magnitude: channels that hold sizes without sign, with what they read where there is nothing.
      available: number of windows from which these were drawn.
      recording: (window,) number of the recording that the log was cut from; None: every log is one.
      clocks: offset of the IMU's clock and its standard deviation by number of the log, s, where the log's own were
        not known well; the windows are cut with it.
      unlevelled: numbers of logs that measure neither acceleration nor attitude: their ground is taken as level.
      held: number of windows that were left out because the rover was held.
    """

    log: np.ndarray
    start_s: np.ndarray
    interval_s: float
    imposed: Windows
    measured: dict[str, np.ndarray]
    magnitude: Mapping[str, float]
    available: int
    recording: np.ndarray | None = None
    clocks: Mapping[int, tuple[float, float]] = dataclasses.field(default_factory=dict)
    unlevelled: frozenset[int] = frozenset()
    held: int = 0

    def __len__(self) -> int:
        return len(self.log)

    def part(self, windows: np.ndarray) -> Cut:
        """Some of the windows, by number."""
        return dataclasses.replace(
            self,
            log=self.log[windows],
            start_s=self.start_s[windows],
            imposed=Windows(*(np.asarray(getattr(self.imposed, f.name))[windows] for f in dataclasses.fields(Windows))),
            measured={c: v[windows] for c, v in self.measured.items()},
            recording=None if self.recording is None else self.recording[windows],
        )

    @property
    def samples(self) -> int:
        """Samples of a window."""
        return next(iter(self.measured.values())).shape[1]

    @property
    def seconds(self) -> float:
        """Length of a window, s."""
        return self.samples * self.interval_s

    @property
    def recordings(self) -> np.ndarray:
        """(window,) number of the recording that a window belongs to: one ground, one day, one warmth of the drives."""
        return self.log if self.recording is None else self.recording

    @property
    def channels(self) -> frozenset[str]:
        """Channels that are measured in some window."""
        return frozenset(c for c, v in self.measured.items() if np.isfinite(v).any())


def cut(
    logs: Sequence[Log],
    joints: Sequence[str],
    radius: float,
    most: int,
    seed: int = 0,
    track: float = math.inf,
    interval_s: float | None = None,
) -> Cut:
    """Windows of some logs, at most `most`, spread evenly over speeds and turns.

    Windows in which the wheels turn against each other and the rover does not are left out: something beside the
    ground holds it, such as a kerb, with a force that nobody knows.

    Args:
      logs: with imposed wheel speeds.
      joints: corner and kind of every drive joint in the order of the controls, such as `lf_drive`.
      radius: of the wheels, m.
      most: windows at most.
      seed: of the draw.
      track: distance of the sides, m; infinite where windows of a rover that was held are to be kept.
      interval_s: between samples, as other windows of the same rover have it; that of the wheel speeds if None.

    Raises:
      UserError: no log is long enough, or tells anything that the windows could be judged by.
    """
    speeds = [[_speed(log, j) for j in joints] for log in logs]
    intervals = [float(np.median(np.diff(s[0][0]))) for s in speeds]
    interval = max(CUTTING.shortest_bin_s, float(np.median(intervals)))
    slow = interval > CUTTING.slow_s
    interval = CUTTING.window_s / CUTTING.slow_bins if slow else interval
    if interval_s is not None:
        interval = interval_s
    clocks = {}
    for n, log in enumerate(logs):
        found = imu_clock(log, *_sides(speeds[n], joints))
        if found is not None:
            clocks[n] = found
    parts = [
        _windows(n, log, joints, speeds[n], radius, interval, slow, clocks.get(n, (0.0, 0.0))[0])
        for n, log in enumerate(logs)
    ]
    whole = [np.concatenate(column) for column in zip(*parts, strict=True)]
    log, start, speed, up, yaw, values = whole
    if not len(log):
        raise UserError(
            f"{logs[0].folder}: no window of {CUTTING.window_s:g} s has wheel speeds without a gap; give longer logs."
        )
    if not np.isfinite(values).any():
        raise UserError(
            f"{logs[0].folder}: measures nothing that imposed wheel speeds could be judged by; give motor currents, "
            f"gyro_z_rad_s or yaw_deg, or {AHEAD}."
        )
    moving = np.abs(radius * speed).mean(axis=(1, 2)) > STANDING_M_S
    if not moving.any():
        raise UserError(
            f"{logs[0].folder}: the wheels turn in no window of {CUTTING.window_s:g} s; give logs of driving."
        )
    left = np.array([j.startswith("l") for j in joints])
    rim_left, rim_right = (radius * speed[..., mine].mean(axis=(1, 2)) for mine in (left, ~left))
    held = moving & _held(rim_left, rim_right, values[:, CHANNELS.index(GYRO)], track)
    moving &= ~held
    if not moving.any():
        raise UserError(f"{logs[0].folder}: the rover is held in every window; give logs of free driving.")
    chosen = _stratified(rim_left, rim_right, moving, log, most, np.random.default_rng(seed))
    measured = {c: values[chosen, k] for k, c in enumerate(CHANNELS)}
    imposed = Windows(speed[chosen], up[chosen, :, 0], up[chosen, :, 1], up[chosen, :, 2], yaw[chosen])
    return Cut(
        log[chosen],
        start[chosen],
        interval,
        imposed,
        measured,
        _magnitudes(logs),
        len(log),
        _recordings(logs)[log[chosen]],
        clocks,
        frozenset(n for n, g in enumerate(logs) if not _leans(g)),
        int(held.sum()),
    )


def _held(left: np.ndarray, right: np.ndarray, yaw_rate: np.ndarray, track: float) -> np.ndarray:
    """(window,) whether the sides turn against each other and the rover does not.

    Args:
      left, right: (window,) rim speeds, m/s. yaw_rate: (window, sample), rad/s. track: m.
    """
    turn = (right - left) / track
    seen = np.asarray(np.isfinite(yaw_rate).any(axis=1))
    mean = np.nanmean(np.where(seen[:, None], yaw_rate, 0.0), axis=1)
    return (
        seen
        & (left * right < 0.0)
        & (np.abs(turn) > CUTTING.turning_rad_s)
        & (np.abs(mean) < CUTTING.held * np.abs(turn))
    )


STANDING_M_S = 0.02
"""Mean size of the rims' speeds below which a rover stands."""


def _recordings(logs: Sequence[Log]) -> np.ndarray:
    """(log,) number of the recording of every log: logs that were cut from the same files share one."""
    keys = [(log.folder.resolve().parent, log.source.get("files", log.name)) for log in logs]
    return np.array([keys.index(k) for k in keys])


def _magnitudes(logs: Sequence[Log]) -> dict[str, float]:
    """Channels without sign, with what they read where there is nothing; a side's from those of its wheels."""
    found: dict[str, float] = {}
    for log in logs:
        for channel in CHANNELS:
            mine = [channel] if channel in log.magnitudes else _of_wheels(log, channel)
            floors = [log.magnitudes[c] for c in mine if c in log.magnitudes]
            if floors:
                found[channel] = float(sum(floors))
    return found


def _speed(log: Log, joint: str) -> tuple[np.ndarray, np.ndarray]:
    """Times s and speeds rad/s of a wheel: its own, its side's, or those of another wheel of its side."""
    side = "left" if joint.startswith("l") else "right"
    for name in (joint, f"{side}_drive", *(f"{side[0]}{row}_drive" for row in "fmr")):
        found = log.channel(f"joint_{name}_speed_rad_s")
        if found is not None and len(found[0]) > 2:
            return found
    raise UserError(f"{log.folder}: has no wheel speeds of the {side} side, which imposed motion needs.")


def _sides(
    speeds: Sequence[tuple[np.ndarray, np.ndarray]], joints: Sequence[str]
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Times and speeds of the first wheel of either side."""
    left, right = (next(s for s, j in zip(speeds, joints, strict=True) if j.startswith(c)) for c in "lr")
    return left, right


def imu_clock(
    log: Log, left: tuple[np.ndarray, np.ndarray], right: tuple[np.ndarray, np.ndarray]
) -> tuple[float, float] | None:
    """What has to be added to the times of the IMU's table, s, and its standard deviation.

    The yaw rate follows the difference of the sides, so that both clocks can be laid over each other wherever the rover
    turns. The log's own uncertainty is the prior, three standard deviations the furthest.

    Args:
      log: a drive. left, right: times s and speeds rad/s of the sides.

    Returns:
      None where the yaw rate is in the table of the wheel speeds, or the log states its clock as exact.
    """
    table = log.table_of(GYRO)
    stated = table.clock_offset_std_s if table is not None else 0.0
    yaw = log.channel(GYRO)
    if yaw is None or stated <= 0.0 or len(yaw[0]) < 10:
        return None
    width = max(CUTTING.shortest_bin_s, float(np.median(np.diff(left[0]))))
    reach = 3.0 * stated
    grid = np.arange(max(left[0][0], right[0][0]) + reach, min(left[0][-1], right[0][-1]) - reach, CUTTING.lag_step_s)
    if len(grid) * CUTTING.lag_step_s < 10.0 * CUTTING.independent_s:
        return 0.0, stated
    turn = np.interp(grid, *right) - np.interp(grid, *left)
    lags = np.arange(-reach, reach + 0.5 * CUTTING.lag_step_s, CUTTING.lag_step_s)
    left_over = np.zeros(len(lags))
    for k, lag in enumerate(lags):
        seen = _means(yaw[0] + lag, yaw[1], grid, width)
        ok = np.isfinite(seen)
        if ok.mean() < 0.5:
            left_over[k] = np.inf
            continue
        # Scale and zero are free, since only the times are asked for.
        columns = np.column_stack([turn[ok], np.ones(ok.sum())])
        fitted = columns @ np.linalg.lstsq(columns, seen[ok], rcond=None)[0]
        left_over[k] = np.mean((seen[ok] - fitted) ** 2)
    count = len(grid) * CUTTING.lag_step_s / CUTTING.independent_s
    # For each lag the likelihood at its best scale, zero and noise.
    score = -0.5 * count * np.log(np.maximum(left_over, 1e-12)) - 0.5 * (lags / stated) ** 2
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    mean = float(weight @ lags)
    # No lag is known better than to half a step of the grid.
    return mean, float(max(np.sqrt(weight @ (lags - mean) ** 2), 0.5 * CUTTING.lag_step_s))


def _windows(
    number: int,
    log: Log,
    joints: Sequence[str],
    speeds: Sequence[tuple[np.ndarray, np.ndarray]],
    radius: float,
    interval: float,
    slow: bool,
    clock_s: float,
) -> tuple[np.ndarray, ...]:
    """All windows of a log: number, start, speeds at edges, up at edges, yaw rate, and measurements."""
    left, right = _sides(speeds, joints)
    count = max(3, round(CUTTING.window_s / interval))
    start = np.array(_about_readings(left[0], right[0]) if slow else _in_stretches(left[0], right[0], interval, count))
    if slow:
        start = start + 0.5 * interval
    half = 0.5 * interval
    # A sample stands for the mean over an interval about it: the first edge lies half of one ahead.
    edges = start[:, None] - half + half * np.arange(2 * count + 1)
    speed = np.stack([np.interp(edges, *s) for s in speeds], axis=-1)
    up = _up(log, edges, (left, right), radius, clock_s)
    times = start[:, None] + interval * np.arange(count)
    imu = log.table_of(GYRO)
    values = []
    for channel in CHANNELS:
        found = log.channel(channel)
        if found is not None and imu is not None and channel in imu.channels:
            found = found[0] + clock_s, found[1]
        if channel == GYRO and found is not None:
            found = _upright(log, found)
        if found is None and channel in CURRENTS:
            found = _sum_of_wheels(log, channel, joints)
        if found is None and channel == GYRO:
            found = _turning(log)
        if found is None and channel == AHEAD:
            found = _over_ground(log)
        values.append(np.full(times.shape, np.nan) if found is None else _means(*found, times, interval))
    values = np.stack(values, axis=1) if len(start) else np.zeros((0, len(CHANNELS), count))
    begun = values[:, CHANNELS.index(GYRO), 0] if len(start) else np.zeros(0)
    base = np.where(np.isfinite(begun), begun, 0.0)
    return np.full(len(start), number), start, speed, up, base, values


def _in_stretches(left: np.ndarray, right: np.ndarray, interval: float, count: int) -> list[float]:
    """Starts of windows that lie one after another wherever both sides' speeds have no gap."""
    starts: list[float] = []
    for first, last in _stretches(left, interval):
        for at in np.arange(first, last - (count - 1.01) * interval, count * interval):
            if _covered(right, at + interval * np.arange(count), interval):
                starts.append(float(at))
    return starts


def _about_readings(left: np.ndarray, right: np.ndarray) -> list[float]:
    """Starts of windows about readings of speeds that come slowly: each between its neighbours, none over another."""
    usual = float(np.median(np.diff(left)))
    starts: list[float] = []
    for before, at, after in zip(left[:-2], left[1:-1], left[2:], strict=True):
        near = after - before < 2.0 * 1.6 * usual and np.abs(right - at).min() < 0.5 * usual
        if near and (not starts or at - 0.5 * CUTTING.window_s >= starts[-1] + CUTTING.window_s):
            starts.append(float(at - 0.5 * CUTTING.window_s))
    return starts


def _of_wheels(log: Log, channel: str) -> list[str]:
    """The channels of a side's wheels in the place of the side's own."""
    if channel not in CURRENTS:
        return []
    side = "l" if channel == CURRENTS[0] else "r"
    known = log.channel_names
    return [c for c in (f"motor_{side}{row}_drive_current_A" for row in "fmr") if c in known]


def _sum_of_wheels(log: Log, channel: str, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray] | None:
    """A side's current as the sum of its wheels'; None where none of them was measured.

    Raises:
      UserError: some of the side's wheels have a current and others have none.
    """
    wheels = _of_wheels(log, channel)
    side = channel.split("_")[1]
    lacking = [n for j in joints if j.startswith(side[0]) and (n := f"motor_{j}_current_A") not in wheels]
    if wheels and lacking:
        # The sum of a part would be held against the current of all.
        raise bad_input(
            log.folder,
            lacking[0],
            None,
            f"is missing beside {wheels[0]}",
            f"map the current of every wheel of the {side} side, or of its one motor as {channel}",
        )
    parts = [log.channel(c) for c in wheels]
    found = [f for f in parts if f is not None and len(f[0]) > 1]
    if not found:
        return None
    return found[0][0], np.sum([np.interp(found[0][0], *f) for f in found], axis=0)


def _upright(log: Log, found: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The yaw rate about the chassis's z axis, where the IMU is mounted askew and all of its axes were recorded."""
    turn = _mounting(log)
    others = [log.channel(f"gyro_{a}_rad_s") for a in "xy"]
    if turn is None or any(o is None or len(o[0]) != len(found[0]) for o in others):
        return found
    axes = [o[1] for o in others if o is not None]
    return found[0], turn.apply(np.column_stack([*axes, found[1]]))[:, 2]


def _mounting(log: Log) -> Rotation | None:
    """The rotation from the IMU's frame to the chassis's; None where they are one."""
    turn = Rotation.from_quat(log.imu.quaternion, scalar_first=True)
    return None if turn.magnitude() < 1e-6 else turn


def _turning(log: Log) -> tuple[np.ndarray, np.ndarray] | None:
    """The yaw rate as the slope of a measured heading."""
    found = log.channel("yaw_deg")
    if found is None or len(found[0]) < 3:
        return None
    time, yaw = found
    return time, np.gradient(np.unwrap(np.radians(yaw)), time)


def _over_ground(log: Log) -> tuple[np.ndarray, np.ndarray] | None:
    """The speed along the chassis from positions and heading, at the middle of two positions half a second apart."""
    x, y, yaw = (log.channel(c) for c in ("position_x_m", "position_y_m", "yaw_deg"))
    lost = log.imu.attitude and log.imu.mounting_std_deg[2] > CUTTING.unknown_heading_deg
    if x is None or y is None or yaw is None or lost or len(x[0]) < 3 or len(x[0]) != len(y[0]):
        return None
    later = np.searchsorted(x[0], x[0] + CUTTING.speed_span_s - 1e-6)
    first = np.flatnonzero(later < len(x[0]))
    last = later[first]
    first, last = (k[x[0][last] - x[0][first] < CUTTING.most_span * CUTTING.speed_span_s] for k in (first, last))
    if len(first) < 2:
        return None
    step = x[0][last] - x[0][first]
    # There a difference quotient is right to second order.
    middle = x[0][first] + 0.5 * step
    heading = np.interp(middle, yaw[0], np.unwrap(np.radians(yaw[1])))
    ahead, aside = x[1][last] - x[1][first], y[1][last] - y[1][first]
    return middle, (np.cos(heading) * ahead + np.sin(heading) * aside) / step


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
    # By differences of a running total: what is asked for overlaps, and logs are long.
    total = np.concatenate([[0.0], np.cumsum(value)])
    # Both ends are moved alike, so that a sample on a border counts for one of two neighbours.
    low = np.searchsorted(time, wanted - 0.5 * width - 1e-6)
    high = np.searchsorted(time, wanted + 0.5 * width - 1e-6)
    many = high - low
    return np.where(many > 0, (total[high] - total[low]) / np.maximum(many, 1), np.nan)


LEANS_BY = (tuple(f"accelerometer_{a}_m_s2" for a in "xyz"), ("roll_deg", "pitch_deg"))
"""Channels that tell the slope, the first that a log has."""


def _leans(log: Log) -> bool:
    """Whether a log tells how the ground leans."""
    return any(all(log.channel(c) is not None for c in channels) for channels in LEANS_BY)


def channels_read(log: Log) -> set[str]:
    """The channels of a log that windows are made of."""
    read = {c for c in CHANNELS if log.channel(c) is not None}
    for channel in CURRENTS:
        if channel not in read:
            read |= set(_of_wheels(log, channel))
    if GYRO not in read and _turning(log) is not None:
        read.add("yaw_deg")
    elif _mounting(log) is not None:
        read |= {"gyro_x_rad_s", "gyro_y_rad_s"}
    if AHEAD not in read and _over_ground(log) is not None:
        read |= {"position_x_m", "position_y_m", "yaw_deg"}
    return read | set(next((c for c in LEANS_BY if all(log.channel(n) is not None for n in c)), ()))


def _up(
    log: Log, edges: np.ndarray, sides: Sequence[tuple[np.ndarray, np.ndarray]], radius: float, clock_s: float
) -> np.ndarray:
    """(window, edge, 3) specific force of gravity in the chassis frame.

    From the accelerometer over a second, less what the wheels' speed-up explains of it; else from measured attitude;
    else level ground.
    """
    g = log.gravity_m_s2
    force = [log.channel(c) for c in LEANS_BY[0]]
    if all(f is not None for f in force):
        up = np.stack(
            [_means(f[0] + clock_s, f[1], edges, CUTTING.levelling_s) for f in force if f is not None], axis=-1
        )
        turn = _mounting(log)
        if turn is not None:
            up = turn.apply(up.reshape(-1, 3)).reshape(up.shape)
        ahead = [np.interp(edges + 0.5 * s * CUTTING.levelling_s, *side) for side in sides for s in (1, -1)]
        up[..., 0] -= radius * 0.5 * (ahead[0] - ahead[1] + ahead[2] - ahead[3]) / CUTTING.levelling_s
        level = np.array([0.0, 0.0, g])
        up = np.where(np.isfinite(up).all(axis=-1, keepdims=True), up, level)
        size = np.linalg.norm(up, axis=-1, keepdims=True)
        # Its direction alone: the size is the sensor's scale, and bumps.
        return up * g / size
    roll, pitch = (log.channel(c) for c in LEANS_BY[1])
    if roll is not None and pitch is not None:
        r, p = (np.radians(np.interp(edges, *f)) for f in (roll, pitch))
        # The world's up in the chassis's axes: last row of the rotation by yaw, pitch and roll, in which the yaw drops
        # out.
        return g * np.stack([-np.sin(p), np.sin(r) * np.cos(p), np.cos(r) * np.cos(p)], axis=-1)
    return np.broadcast_to(np.array([0.0, 0.0, g]), (*edges.shape, 3)).copy()


def _stratified(
    left: np.ndarray, right: np.ndarray, moving: np.ndarray, log: np.ndarray, most: int, rng: np.random.Generator
) -> np.ndarray:
    """Numbers of the windows to use, in order: as many of every stratum of speed and turn and of every log."""
    ahead, turn = 0.5 * (left + right), 0.5 * (right - left)
    stratum = np.sign(ahead) * np.digitize(np.abs(ahead), CUTTING.strata) + 10 * np.sign(turn) * np.digitize(
        np.abs(turn), (0.02, 0.1)
    )
    order: list[int] = []
    queues = [
        list(rng.permutation(np.flatnonzero(moving & (log == n) & (stratum == s))))
        for n in np.unique(log)
        for s in np.unique(stratum)
    ]
    # by lot, so that of more queues than windows not the first logs alone are used
    queues = [queues[k] for k in rng.permutation(len(queues))]
    while any(queues) and len(order) < most:
        for queue in queues:
            if queue and len(order) < most:
                order.append(int(queue.pop()))
    return np.sort(np.array(order, int))
