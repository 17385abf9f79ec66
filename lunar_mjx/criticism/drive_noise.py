"""Noise of a log's channels: stated, from rest segments, or from the datasheet of a channel's family."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lunar_mjx.effects.channels import family

if TYPE_CHECKING:
    from lunar_mjx.criticism.log import Log

DATASHEET = {
    "position": 0.005, "world": 0.005, "body": 0.005, "roll": 0.1, "pitch": 0.1, "yaw": 0.2, "quaternion": 0.002,
    "gyro": 0.002, "accelerometer": 0.02, "joint": 0.005, "bus": 0.05, "winding": 0.3, "housing": 0.3,
    "wheel": 0.002, "drawbar": 1.0,
}  # fmt: skip
"""Standard deviation by the first word of a channel, in its unit, where a log states nothing: visual odometry of a few
millimetres, a tactical MEMS IMU, 12-bit encoders, thermistors of 0.3 K."""
_ELECTRICAL = {"A": 0.01, "V": 0.05, "Nm": 0.2}
_REST = 40
"""Samples at rest that an estimate needs."""


def stated_or_typical(log: Log, channel: str) -> float:
    """Standard deviation of a channel's noise as the log states it, else what its family's sensors have."""
    noise = log.noise.get(channel)
    if noise is not None and noise.std > 0.0:
        return noise.std
    word = channel.partition("_")[0]
    if family(channel) == "electrical":
        return _ELECTRICAL.get(channel.rsplit("_", 1)[-1], 0.05)
    if channel.endswith("_N"):
        return 1.0
    if channel.endswith("_Nm"):
        return 0.2
    if channel.endswith("slip_ratio"):
        return 0.02
    return DATASHEET.get(word, 0.01)


def channel_noise(log: Log, channel: str) -> tuple[float, float, float]:
    """White and coloured standard deviation, and correlation time s, of a channel.

    The size is the stated one; its colour is the stated correlation time, else that of rest segments, which are long
    enough where the commands stay zero for forty samples.
    """
    std = stated_or_typical(log, channel)
    noise = log.noise.get(channel)
    if noise is not None and noise.correlation_time_s > 0.0:
        return 0.1 * std, std, noise.correlation_time_s
    rest = rest_samples(log, channel)
    if rest is None:
        return std, 0.0, 0.0
    time, values = rest
    share, tau = colour(time, values)
    return std * np.sqrt(max(1.0 - share, 0.01)), std * np.sqrt(share), tau


def rest_samples(log: Log, channel: str) -> tuple[np.ndarray, np.ndarray] | None:
    """The channel while all commands are zero, detrended; None where that is too short."""
    found = log.channel(channel)
    commands = [log.channel(c) for c in log.channel_names if c.startswith("command_")]
    if found is None or not commands:
        return None
    time, values = found
    idle = np.ones(len(time), bool)
    for command in commands:
        assert command is not None
        at = np.maximum(np.searchsorted(command[0], time + 1e-6, side="right") - 1, 0)
        idle &= np.abs(command[1][at]) < 1e-9
    # The rover needs a moment to come to rest.
    began = np.flatnonzero(idle & ~np.concatenate([[False], idle[:-1]]))
    for start in began[began > 0]:
        idle &= ~((time >= time[start]) & (time < time[start] + 2.0))
    runs = np.split(np.flatnonzero(idle), np.flatnonzero(np.diff(np.flatnonzero(idle)) > 1) + 1)
    longest = max(runs, key=len, default=np.array([], int))
    if len(longest) < _REST:
        return None
    t, v = time[longest], values[longest]
    return t, v - np.polyval(np.polyfit(t - t[0], v, 1), t - t[0])


def colour(time: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Share of the variance that is correlated, and its correlation time s, from autocovariances at lags 1 and 2."""
    n = len(values)
    power = float(np.mean(values**2))
    if power <= 0.0:
        return 0.0, 0.0
    c1, c2 = (float(np.mean(values[:-lag] * values[lag:])) for lag in (1, 2))
    significant = 2.5 * power / np.sqrt(n)
    if c1 < significant or c2 < 0.5 * significant:
        return 0.0, 0.0
    ratio = float(np.clip(c2 / c1, 0.05, 0.99))
    step = float(np.median(np.diff(time)))
    return float(np.clip(c1 / ratio / power, 0.0, 0.99)), -step / float(np.log(ratio))
