"""Noise of a drive's channels, estimated from the drive itself: its size, its colour, and how well these are known.

What a sensor shows while a rover drives is more than its data sheet's noise: a gyroscope shakes with the chassis, a
current ripples with the gear. All of it is noise to a model that moves a rigid rover over smooth ground, and is called
by what it is: `vibration` (IMU), `ripple` (currents, voltages, torques) or `estimate` (everything else), beside `rest`,
which is what remains while the rover stands.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import polygamma
from scipy.stats import chi2

from lunar_mjx.logs.log import Log
from lunar_mjx.logs.schema import find_channel, is_command, is_quantity


@dataclasses.dataclass(frozen=True)
class NoiseEstimate:
    """How noise is estimated from a drive."""

    window_s: float = 2.0
    """Windows about whose own parabola a channel is noise: what changes within two seconds in any other way than that
    is faster than a rover on its wheels, and what is slower is motion."""
    # Samples of a window: with fewer three are too many for the parabola; of more, as many as these tell the colour.
    fewest: int = 12
    most: int = 100
    parabola: int = 3
    """Coefficients of a parabola."""
    windows: int = 200
    """Windows that are looked at, spread over the drive."""
    fewest_windows: int = 3
    """Windows of a drive below which its noise is not told."""
    shares: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.97)
    times_s: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
    """What is tried: shares of the variance that are correlated, and correlation times."""
    coloured: float = 9.2
    """Twice the log-likelihood that a colour must gain over white noise: a chi-square of two degrees exceeds it once in
    a hundred times."""
    still_rad_s: float = 0.02
    """A wheel that turns slower stands: one of 0.25 m moves by less than 5 mm/s."""
    quietest: float = 1e-12
    """Least variance that has a logarithm, in squared units of the channel: below it a channel is constant."""


NOISE_ESTIMATE = NoiseEstimate()

STATED_LOG_STD = {"datasheet": 0.3, "rest": 0.1, "replicate": 0.1}
"""Standard deviation of the logarithm of a stated noise by its source: data sheets are right within a third."""
_NAMES = {"imu": "vibration", "electrical": "ripple", "torque": "ripple"}


@dataclasses.dataclass(frozen=True)
class ChannelNoise:
    """Noise of one channel of one log.

    Attributes:
      std: standard deviation of one sample, in the channel's unit.
      share: of the variance that is correlated in time. correlation_time_s: of an Ornstein-Uhlenbeck process.
      source: vibration, ripple, estimate or rest where the log itself tells; else as stated (datasheet, rest,
        replicate).
      freedom: independent deviations behind `std`; 0 where it is stated.
      spread: standard deviation of log std from window to window, beyond chance: noise grows with speed and roughness.
    """

    std: float
    share: float
    correlation_time_s: float
    source: str
    freedom: float = 0.0
    spread: float = 0.0

    @property
    def white(self) -> float:
        """Standard deviation of the part without memory."""
        return self.std * float(np.sqrt(1.0 - self.share))

    @property
    def coloured(self) -> float:
        """Standard deviation of the correlated part."""
        return self.std * float(np.sqrt(self.share))

    @property
    def log_std(self) -> float:
        """Standard deviation of log `std`: by its degrees of freedom and its spread, or by where it is stated."""
        if self.freedom <= 0.0:
            return STATED_LOG_STD.get(self.source, 0.3)
        return float(np.hypot(np.sqrt(0.5 / self.freedom), self.spread))


def noise_of(log: Log, channel: str) -> ChannelNoise | None:
    """Noise of a channel: as the log states it, else as its drive shows it, else as its rests do; None if nothing does.

    Args:
      log: of a drive. channel: that it holds.
    """
    stated = log.noise.get(channel)
    if stated is not None and stated.std > 0.0:
        share = stated.correlated_share if stated.correlation_time_s > 0.0 else 0.0
        # Not 1: a covariance without any white part is next to singular.
        share = 0.99 if share == 1.0 else share
        return ChannelNoise(stated.std, share, stated.correlation_time_s, stated.source)
    # What is asked about is the drive; its noise is larger than that at rest.
    return estimated_noise(log, channel, moving=True) or estimated_noise(log, channel, moving=False)


def estimated_noise(log: Log, channel: str, moving: bool) -> ChannelNoise | None:
    """Noise of a channel while the rover drives, or while it stands; None where too little of that was recorded.

    A channel is taken about a parabola of its own in every window. The colour is found by restricted likelihood with a
    size of its own for every window (Patterson and Thompson 1971), the size is the median of the windows'.

    Args:
      log: of a drive. channel: that it holds; commands have no noise. moving: which part of the drive.
    """
    samples = log.channel(channel)
    if samples is None or is_command(channel):
        return None
    time, values = samples
    step, windows = _windows(time, values, moving_at(log, time), moving)
    if windows.shape[1] < NOISE_ESTIMATE.fewest_windows:
        return None
    share, correlation_time = _colour(step, windows)
    weight, _ = _about_parabola(len(windows), step, share, correlation_time)
    free = len(windows) - NOISE_ESTIMATE.parabola
    size = np.sum(windows * (weight @ windows), axis=0) / free
    # half of the windows are quieter than this; a chi-square's median lies below its mean
    variance = float(np.median(size)) * free / float(chi2.median(free))
    if variance <= NOISE_ESTIMATE.quietest:
        return None
    logs = 0.5 * np.log(np.maximum(size, NOISE_ESTIMATE.quietest))
    # the middle half tells the spread: a few windows hold a kerb
    scatter = (float(np.quantile(logs, 0.75)) - float(np.quantile(logs, 0.25))) / 1.349
    spread = float(np.sqrt(max(scatter**2 - 0.25 * float(polygamma(1, 0.5 * free)), 0.0)))
    family = find_channel(channel)
    # Families that shake with the drive are named so; the rest is an estimate.
    name = _NAMES.get(family[0].family if family else "", "estimate") if moving else "rest"
    # the median of windows is as good as two thirds of them
    freedom = 2.0 / 3.0 * free * windows.shape[1]
    return ChannelNoise(float(np.sqrt(variance)), share, correlation_time, name, freedom, spread)


def noise_table(logs: Sequence[Log]) -> dict[str, dict[str, ChannelNoise]]:
    """Noise by channel of a campaign: `stated`, `drive` and `rest`, the median log's where several tell it."""
    out: dict[str, dict[str, ChannelNoise]] = {}
    names = dict.fromkeys(c for log in logs for c in log.channel_names if not is_command(c))
    for name in names:
        mine = [log for log in logs if name in log.channel_names]
        noises: dict[str, list[ChannelNoise]] = {}
        for log in mine:
            stated = log.noise.get(name)
            by_channel: Mapping[str, ChannelNoise | None] = {
                "stated": noise_of(log, name) if stated is not None and stated.std > 0.0 else None,
                "drive": estimated_noise(log, name, moving=True),
                "rest": estimated_noise(log, name, moving=False),
            }
            for kind, one in by_channel.items():
                if one is not None:
                    noises.setdefault(kind, []).append(one)
        if noises:
            # The median log: one that hit a kerb shall not speak for all.
            out[name] = {k: sorted(v, key=lambda n: n.std)[len(v) // 2] for k, v in noises.items()}
    return out


def moving_at(log: Log, time: np.ndarray) -> np.ndarray:
    """(n,) whether any wheel turns at some times; everywhere where no channel tells."""
    for quantity in ("joint_speed", "command_speed"):
        names = [c for c in log.channel_names if is_quantity(c, quantity, "drive")]
        series = [s for c in names if (s := log.channel(c)) is not None and s[0].size]
        if series:
            moves = np.zeros(len(time), bool)
            for t, v in series:
                after = np.clip(np.searchsorted(t, time), 0, len(t) - 1)
                before = np.clip(after - 1, 0, len(t) - 1)
                # The samples on both sides: a slow channel may miss when a wheel started.
                moves |= np.maximum(np.abs(v[before]), np.abs(v[after])) > NOISE_ESTIMATE.still_rad_s
            return moves
    # Without any wheel's speed all counts as motion.
    return np.ones(len(time), bool)


def _windows(time: np.ndarray, values: np.ndarray, moves: np.ndarray, moving: bool) -> tuple[float, np.ndarray]:
    """Time step in s, and pieces (samples, windows) of a channel that lie wholly in motion or wholly at rest."""
    step = float(np.median(np.diff(time))) if len(time) >= NOISE_ESTIMATE.fewest else 0.0
    if step <= 0.0:
        return step, np.zeros((NOISE_ESTIMATE.fewest, 0))
    count = int(np.clip(round(NOISE_ESTIMATE.window_s / step), NOISE_ESTIMATE.fewest, NOISE_ESTIMATE.most))
    starts = list(range(0, len(time) - count + 1, count))
    out = []
    for k in starts[:: max(1, len(starts) // NOISE_ESTIMATE.windows)]:
        piece = slice(k, k + count)
        # One lost sample passes; more would bend the correlation's time scale.
        even = np.diff(time[piece]).max() < 2.5 * step
        # a sensor that stands still in its resolution shows no noise
        if even and np.all(moves[piece] == moving) and np.ptp(values[piece]) > 0.0:
            # Less its first value: positions of kilometres would eat the digits of a millimetre's noise.
            out.append(values[piece] - values[k])
    # Rounded, so that steps that differ in the last digit share a cached factor.
    return round(step, 6), np.array(out).T if out else np.zeros((count, 0))


def _colour(step: float, windows: np.ndarray) -> tuple[float, float]:
    """Share of the variance that is correlated, and its correlation time in s, by restricted likelihood."""
    best, most = (0.0, 0.0), -np.inf
    white = _likelihood(step, windows, 0.0, 1.0)
    for tau in NOISE_ESTIMATE.times_s:
        # A memory of less than half a step cannot be told from white noise.
        for share in NOISE_ESTIMATE.shares[1:] if tau >= 0.5 * step else ():
            likelihood = _likelihood(step, windows, share, tau)
            if likelihood > most:
                best, most = (share, tau), likelihood
    return best if 2.0 * (most - white) > NOISE_ESTIMATE.coloured else (0.0, 0.0)


def _likelihood(step: float, windows: np.ndarray, share: float, tau: float) -> float:
    """Restricted log-likelihood of windows (samples, windows), the size of each at its best."""
    weight, determinant = _about_parabola(len(windows), step, share, tau)
    squares = np.sum(windows * (weight @ windows), axis=0)
    free = len(windows) - NOISE_ESTIMATE.parabola
    # Each window's size at its best and so out of the question: windows differ by speed and ground.
    return -0.5 * float(np.sum(free * np.log(np.maximum(squares, NOISE_ESTIMATE.quietest)) + determinant))


@functools.lru_cache(maxsize=512)
def _about_parabola(count: int, step: float, share: float, tau: float) -> tuple[np.ndarray, float]:
    """Inverse covariance (count, count) of what is left about a parabola, and that covariance's log determinant."""
    t = step * np.arange(count)
    parabola = np.stack([np.ones(count), t - t.mean(), (t - t.mean()) ** 2], axis=1)
    # What is orthogonal to every parabola: its likelihood does not depend on the motion (REML).
    contrasts = np.linalg.qr(parabola, mode="complete")[0][:, NOISE_ESTIMATE.parabola :]
    covariance = (1.0 - share) * np.eye(count)
    if share > 0.0:
        covariance += share * np.exp(-np.abs(t[:, None] - t) / tau)
    factor = cho_factor(contrasts.T @ covariance @ contrasts, lower=True)
    determinant = 2.0 * float(np.sum(np.log(np.diag(factor[0]))))
    return contrasts @ cho_solve(factor, contrasts.T), determinant
