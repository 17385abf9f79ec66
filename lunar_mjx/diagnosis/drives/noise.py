"""Noise of a log's channels: stated, from rest segments, or from the datasheet of a channel's family."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lunar_mjx.effects.sensor.channels import family
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.logs.noise import ChannelNoise, noise_of
from lunar_mjx.logs.schema import is_command, is_quantity, sensor_of, suffix_of

if TYPE_CHECKING:
    from lunar_mjx.logs import Log

K = TypeVar("K", bound=Hashable)

DATASHEET = {
    "position": 0.005,
    "world": 0.005,
    "body": 0.005,
    "roll": 0.1,
    "pitch": 0.1,
    "yaw": 0.2,
    "quaternion": 0.002,
    "gyro": 0.002,
    "accelerometer": 0.02,
    "joint": 0.005,
    "bus": 0.05,
    "winding": 0.3,
    "housing": 0.3,
    "wheel": 0.002,
    "drawbar": 1.0,
}
"""Standard deviation by the first word of a channel, in its unit, where a log states nothing: visual odometry of a few
millimetres, a tactical MEMS IMU, 12-bit encoders, thermistors of 0.3 K."""
_ELECTRICAL = {"A": 0.01, "V": 0.05, "Nm": 0.2}
_FORCE = {"N": 1.0, "Nm": 0.2}


@dataclasses.dataclass(frozen=True)
class NoiseColours:
    """How the colour of noise is told from what channels show at rest."""

    settling: float = 2.0
    """s that the rover needs to come to rest."""
    # Samples of a rest segment: shorter ones tell nothing beside their own trend, longer ones are cut.
    shortest: int = 8
    longest: int = 100
    # What is tried: shares of the variance that are correlated; correlation times in sampling intervals, and the
    # ratio of one to the next.
    shortest_time: float = 0.7
    longest_time: float = 40.0
    times_apart: float = 1.6
    evidence: float = 15.0
    """Twice the log-likelihood that a colour must gain over white noise: a chi-square of two degrees exceeds it once in
    1,800 times."""
    own: float = 10.0
    """Twice the log-likelihood that a kind of instrument must gain by a colour of its own over the one of all kinds."""
    # Error of a segment's times, as a share of its length, that does not matter; sets of times that are looked at.
    jitter: float = 0.05
    uneven: int = 40
    size: float = 1.2
    """Factor by which the variance at rest may differ from what is stated: within a second, slow noise of any size
    looks alike but for that."""
    # Length of a residual's windows in correlation times; share of the stated variance beyond which one holds a
    # misfit.
    window: float = 3.0
    loud: float = 2.0
    quiet: float = 0.25
    """Share of the stated variance below which a channel at rest does not show its noise (an encoder that stands)."""
    quietest: float = 0.1
    """Share of what its family's sensors have, below which no channel's noise is believed to lie: a simulated log
    without noise would weigh millions of sigma."""
    unknown_log_std: float = 0.7
    """Standard deviation of the logarithm of a noise that nothing tells: what a family's sensors have, within a factor
    of two."""


NOISE_COLOURS = NoiseColours()

_SHARES = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97])


def stated_or_typical(log: Log, channel: str) -> float:
    """Standard deviation of a channel's noise as the log states it, else what its family's sensors have."""
    noise = log.noise.get(channel)
    if noise is not None and noise.std > 0.0:
        return noise.std
    unit = suffix_of(channel)
    if family(channel) == "electrical":
        return _ELECTRICAL.get(unit, 0.05)
    if is_quantity(channel, "wheel_slip"):
        return 0.02
    return _FORCE.get(unit, DATASHEET.get(sensor_of(channel), 0.01))


@dataclasses.dataclass(frozen=True)
class Colour:
    """Share of a noise's variance that is correlated, and its correlation time in s."""

    share: float = 0.0
    correlation_time: float = 0.0


class Noises:
    """Noise of every channel of a campaign.

    A channel's size is the stated one. Its colour is the stated correlation time, else what the segments at rest of
    all logs show. A second of rest tells little about one channel: instruments of one kind (first word of the name,
    stated size) have one colour, and that which all kinds have in common unless their segments contradict it.
    """

    def __init__(self, logs: Sequence[Log]):
        self.logs = tuple(logs)
        self._estimates: dict[tuple[int, str], ChannelNoise | None] = {}
        segments: dict[tuple[str, float], list[tuple[np.ndarray, np.ndarray]]] = {}
        for log in logs:
            rests = _rests(log)
            for channel in log.channel_names:
                samples = log.channel(channel)
                # a slip ratio at rest is noise over zero
                if is_command(channel) or is_quantity(channel, "wheel_slip") or samples is None:
                    continue
                key = _kind(log, channel)
                for begin, end in rests:
                    segments.setdefault(key, []).extend(_cut(*samples, begin, end, key[1]))
        self.common, self.colours = colours({key: parts for key, parts in segments.items() if parts})

    @staticmethod
    def _stated(log: Log, channel: str) -> bool:
        """Whether a log states a correlation time."""
        return channel in log.noise and log.noise[channel].correlation_time_s > 0.0

    def _known(self, log: Log, channel: str) -> bool:
        """Whether a channel's colour is stated, or was estimated from the whole drive."""
        return self._stated(log, channel) or self.estimate(log, channel) is not None

    def __call__(self, log: Log, channel: str) -> tuple[float, float, float]:
        """White and coloured standard deviation in the channel's unit, and correlation time in s."""
        estimate = self.estimate(log, channel)
        if estimate is not None:
            size = max(1.0, NOISE_COLOURS.quietest * stated_or_typical(log, channel) / estimate.std)
            return size * estimate.white, size * estimate.coloured, estimate.correlation_time_s
        std = stated_or_typical(log, channel)
        if self._stated(log, channel):
            noise = log.noise[channel]
            # Where no white part is stated, a little of it: a covariance without any is next to singular.
            return noise.white or 0.1 * std, noise.coloured, noise.correlation_time_s
        colour = self.colours.get(_kind(log, channel), self.common)
        return std * np.sqrt(1.0 - colour.share), std * np.sqrt(colour.share), colour.correlation_time

    def estimate(self, log: Log, channel: str) -> ChannelNoise | None:
        """Noise that the log does not state, as the drive itself shows it; None where that is stated or too short."""
        if channel in log.noise and log.noise[channel].std > 0.0:
            return None
        key = id(log), channel
        if key not in self._estimates:
            self._estimates[key] = noise_of(log, channel)
        return self._estimates[key]

    def log_std(self, log: Log, channel: str) -> float:
        """Standard deviation of the logarithm of a channel's noise: how well its size is known."""
        channel_noise = noise_of(log, channel) if channel in log.noise else self.estimate(log, channel)
        return NOISE_COLOURS.unknown_log_std if channel_noise is None else channel_noise.log_std

    def refined(self, observations: Observations, residual: np.ndarray) -> Observations:
        """The colours that rest has shown, taken anew from a residual, which is longer than any rest.

        Only windows of a few correlation times count, each about its own line, and none that is louder than noise: a
        model's misfit is slow or large. Noise that is white at rest stays white; what a log states stays.

        Args:
          observations: of these logs. residual: (n,) measured less predicted, in the channels' units.
        """
        segments: dict[tuple[str, float], list[tuple[np.ndarray, np.ndarray]]] = {}
        mine = [s for s in observations.series if s.time is not None and s.correlation_time > 0.0]
        mine = [s for s in mine if not self._known(self.logs[s.log], s.channel)]
        for s in mine:
            key, time, values = _kind(self.logs[s.log], s.channel), np.asarray(s.time), residual[s.start : s.stop]
            step = float(np.median(np.diff(time)))
            size = int(
                np.clip(
                    NOISE_COLOURS.window * s.correlation_time / step, 2 * NOISE_COLOURS.shortest, NOISE_COLOURS.longest
                )
            )
            for i in range(0, len(time) - size + 1 if step < s.correlation_time else 0, size):
                t, v = time[i : i + size], values[i : i + size] / key[1]
                # A window with a gap, one that is flat and one that holds a misfit tell nothing of the noise's colour.
                if t[-1] - t[0] < 1.5 * step * size and NOISE_COLOURS.quiet < _about_line(t, v) < NOISE_COLOURS.loud:
                    segments.setdefault(key, []).append((t, v))
        if segments:
            self.common, self.colours = colours(segments, near=self.common)
        by_series = {(s.log, s.channel): self(self.logs[s.log], s.channel) for s in mine}

        def changed(s: Series) -> Series:
            if (s.log, s.channel) not in by_series:
                return s
            white, coloured, tau = by_series[s.log, s.channel]
            return dataclasses.replace(s, white=white, coloured=coloured, correlation_time=tau)

        return dataclasses.replace(observations, series=tuple(changed(s) for s in observations.series))


def _about_line(time: np.ndarray, values: np.ndarray) -> float:
    """Variance about a straight line."""
    t, v = time - time.mean(), values - values.mean()
    return float(v @ v - (t @ v) ** 2 / (t @ t)) / len(v)


def _kind(log: Log, channel: str) -> tuple[str, float]:
    return sensor_of(channel), stated_or_typical(log, channel)


def _rests(log: Log) -> list[tuple[float, float]]:
    """Spans in which all commands are zero, without what the rover needs to come to rest."""
    commands = [samples for c in log.channel_names if is_command(c) and (samples := log.channel(c)) is not None]
    if not commands:
        return []
    # A command stays until the next one.
    time = np.unique(np.concatenate([t for t, _ in commands]))
    idle = np.ones(len(time), bool)
    for t, v in commands:
        idle &= np.abs(v[np.maximum(np.searchsorted(t, time + 1e-9, side="right") - 1, 0)]) < 1e-9
    edges = np.diff(np.concatenate([[0], idle.astype(int), [0]]))
    spans = []
    for first, after in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        begin = time[first] + (NOISE_COLOURS.settling if first > 0 else 0.0)
        end = time[min(after, len(time) - 1)] if after < len(time) else time[-1] + 1e-9
        if begin < end:
            spans.append((float(begin), float(end)))
    return spans


def _cut(
    time: np.ndarray, values: np.ndarray, begin: float, end: float, std: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pieces of a channel within a span; none where it is too short, or too quiet to be noise."""
    inside = (time >= begin) & (time < end)
    t, v = time[inside], values[inside]
    pieces = [
        (t[i : i + NOISE_COLOURS.longest], v[i : i + NOISE_COLOURS.longest] / std)
        for i in range(0, len(t), NOISE_COLOURS.longest)
    ]
    return [(t, v) for t, v in pieces if len(t) >= NOISE_COLOURS.shortest and np.var(v) >= NOISE_COLOURS.quiet]


def colours(
    segments: Mapping[K, Sequence[tuple[np.ndarray, np.ndarray]]], near: Colour | None = None
) -> tuple[Colour, dict[K, Colour]]:
    """Colours of kinds of noise by what they show at rest: white noise and an Ornstein-Uhlenbeck process about a line.

    Restricted maximum likelihood, so that the lines do not hide the correlation (Patterson and Thompson 1971).

    Args:
      segments: by kind, pairs of times in s and values in sigma, each of shape (n,); n may differ.
      near: a colour that is to be refined; the size is then the stated one, whereas white noise of any size is tried
        against a first colour.

    Returns:
      The colour that the kinds have in common, and that of each.
    """
    if not segments:
        return Colour(), {}
    tried = _around(near) if near is not None and near.share > 0.0 else _everywhere(segments)
    size = 1.0 if near is not None else NOISE_COLOURS.size
    likelihood = {}
    for kind, parts in segments.items():
        groups = _by_times(parts)
        # White noise may have any size here: a size that is stated wrongly must not pass for a colour.
        likelihood[kind] = np.array([_likelihood(groups, c, size if c.share else np.inf) for c in tried])

    def most_likely(rows: Sequence[np.ndarray]) -> int:
        total = np.sum(rows, axis=0) if len(rows) else np.zeros(len(tried))
        k = int(np.argmax(total))
        # the first that was tried is white noise: a colour must earn its two parameters
        return k if 2.0 * (total[k] - total[0]) > NOISE_COLOURS.evidence else 0

    common, alike = 0, list(likelihood)
    for _ in range(len(likelihood)):
        common = most_likely([likelihood[kind] for kind in alike])
        kept = [kind for kind, row in likelihood.items() if 2.0 * (row.max() - row[common]) < NOISE_COLOURS.own]
        if kept == alike:
            break
        alike = kept
    own = {kind: tried[common if kind in alike else most_likely([row])] for kind, row in likelihood.items()}
    return tried[common], own


def _everywhere(segments: Mapping[K, Sequence[tuple[np.ndarray, np.ndarray]]]) -> list[Colour]:
    intervals = [float(np.median(np.diff(t))) for parts in segments.values() for t, _ in parts]
    first, last = NOISE_COLOURS.shortest_time * min(intervals), NOISE_COLOURS.longest_time * max(intervals)
    times = np.geomspace(first, last, 1 + int(np.ceil(np.log(last / first) / np.log(NOISE_COLOURS.times_apart))))
    return [Colour(), *(Colour(float(share), float(tau)) for share in _SHARES for tau in times)]


def _around(near: Colour) -> list[Colour]:
    shares = np.clip(near.share + np.linspace(-0.3, 0.3, 21), 0.05, 0.98)
    times = near.correlation_time * np.geomspace(0.3, 3.0, 21)
    return [Colour(), *(Colour(float(share), float(tau)) for share in np.unique(shares) for tau in times)]


def _by_times(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Times since the beginning (n,) and values (n, segments) of the segments that share them.

    Clocks jitter: what is nearly even counts as even, and of uneven segments only so many are taken.
    """
    groups: dict[bytes, tuple[np.ndarray, list[np.ndarray]]] = {}
    for t, v in parts:
        # Two digits: clocks that jitter agree in these, and equal times share one factorisation.
        step = float(f"{np.median(np.diff(t)):.2g}")
        even = step * np.arange(len(t))
        since = (
            even if np.max(np.abs(t - t[0] - even)) < NOISE_COLOURS.jitter * step * len(t) else np.round(t - t[0], 6)
        )
        groups.setdefault(since.tobytes(), (since, []))[1].append(v)
    largest = sorted(groups.values(), key=lambda g: -len(g[1]))[: NOISE_COLOURS.uneven]
    return [(since, np.stack(values, axis=1)) for since, values in largest]


def _likelihood(groups: Sequence[tuple[np.ndarray, np.ndarray]], c: Colour, most: float) -> float:
    """Restricted log-likelihood of a colour, its size at its best within a factor of the stated one."""
    square, freedom, logarithms = 0.0, 0, 0.0
    for since, v in groups:
        weight, determinant = _about_a_line(since.tobytes(), c)
        square += float(np.sum(v * (weight @ v)))
        # Two of a segment's freedoms have gone into its line.
        freedom += v.shape[1] * (len(since) - 2)
        logarithms += v.shape[1] * determinant
    size = float(np.clip(square / freedom, 1.0 / most, most))
    return -0.5 * (freedom * np.log(size) + square / size + logarithms)


@functools.lru_cache(maxsize=512)
def _about_a_line(times: bytes, c: Colour) -> tuple[np.ndarray, float]:
    """Inverse covariance (n, n) of what is left about a line, for values at some times, and the log determinant.

    Kinds of noise that are sampled alike share them.
    """
    since = np.frombuffer(times)
    line = np.stack([np.ones_like(since), since - since.mean()], axis=1)
    # white noise and an Ornstein-Uhlenbeck process, of variance one together
    correlation = (1.0 - c.share) * np.eye(len(since))
    if c.share > 0.0:
        correlation += c.share * np.exp(-np.abs(since[:, None] - since) / c.correlation_time)
    factor = cho_factor(correlation, lower=True)
    solved = cho_solve(factor, line)
    inner = line.T @ solved
    weight = cho_solve(factor, np.eye(len(since))) - solved @ np.linalg.solve(inner, solved.T)
    # The second determinant is what restricted likelihood adds for the line having been fitted.
    return weight, 2.0 * float(np.sum(np.log(np.diag(factor[0])))) + float(np.linalg.slogdet(inner)[1])
