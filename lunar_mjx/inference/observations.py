"""Measurements as one vector, with their noise: series by log and channel, whitened by models of correlated noise."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False)
class Chain:
    """Points of a table whose neighbours have correlated noise.

    Attributes:
      order: (n,) places along sweeps. follows: (n,) whether the point at each of these places follows its neighbour.
      correlation: of neighbours. innovation: standard deviation of what a point adds to it, in sigma.
    """

    order: np.ndarray
    follows: np.ndarray
    correlation: float
    innovation: float

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Innovations of (n, k) columns in sigma, each at the place of its point."""
        along = columns[self.order]
        out = along.copy()
        at = np.flatnonzero(self.follows)
        out[at] = (along[at] - self.correlation * along[at - 1]) / self.innovation
        lagged = np.empty_like(out)
        lagged[self.order] = out
        return lagged


@dataclasses.dataclass(frozen=True)
class Series:
    """One channel of one log (or one quantity at one group of points of a table).

    Attributes:
      log: number of the log. channel: name.
      start, stop: place in the vector of observations.
      time: s, one per observation; None where the observations are independent points.
      white: standard deviation of the white noise, in the channel's unit, one number or one per observation.
      coloured: standard deviation of the correlated noise, same unit.
      correlation_time: of the correlated noise, s.
      level: relative standard deviation of the noise level itself, where it comes from few replicates.
      dependence: observations per independent one, where correlated noise of neighbours cannot be whitened.
      chain: how it can be.
    """

    log: int
    channel: str
    start: int
    stop: int
    time: np.ndarray | None
    white: np.ndarray | float
    coloured: float = 0.0
    correlation_time: float = 0.0
    level: float = 0.0
    dependence: float = 1.0
    chain: Chain | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Observations:
    """All measurements of a campaign.

    Attributes:
      value: (n,) measured values, each in its channel's unit; no gaps.
      series: what they are, in order and without holes.
      logs: names of the logs. split: "fit", "select" or "test" of every log.
      unit: (n,) number of the manoeuvre (or of the group of points) that is left out together.
      place: (n, k) covariates of table points (slip ratio, slip angle, load), or None.
    """

    value: np.ndarray
    series: tuple[Series, ...]
    logs: tuple[str, ...]
    split: tuple[str, ...]
    unit: np.ndarray
    unit_split: tuple[str, ...]
    unit_names: tuple[str, ...]
    place: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.value)

    @functools.cached_property
    def of_log(self) -> Mapping[int, slice]:
        """Where each log's observations lie."""
        rows_of_log: dict[int, slice] = {}
        for s in self.series:
            rows_of_log[s.log] = slice(rows_of_log[s.log].start if s.log in rows_of_log else s.start, s.stop)
        return rows_of_log

    def in_split(self, *splits: str) -> np.ndarray:
        """(n,) which observations belong to one of the splits."""
        wanted = np.array([s in splits for s in self.unit_split])
        return wanted[self.unit]

    def sigma(self) -> np.ndarray:
        """(n,) standard deviation of every observation's noise, white and coloured together."""
        out = np.empty(len(self))
        for s in self.series:
            out[s.start : s.stop] = np.sqrt(np.square(s.white) + s.coloured**2)
        return out

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Columns with the noise's covariance divided out: unit white noise stays.

        Args:
          columns: (n,) or (n, k), in the channels' units; 0 marks nothing.

        Returns:
          The same shape, in sigma: innovations of each series over their standard deviation.
        """
        flat = columns.reshape(len(self), -1)
        out = np.empty_like(flat, dtype=float)
        for s in self.series:
            part = slice(s.start, s.stop)
            if not _is_slow(s):
                out[part] = flat[part] / np.sqrt(np.square(s.white) + s.coloured**2).reshape(-1, 1)
                if s.chain is not None:
                    out[part] = s.chain.whiten(out[part])
        for group in self._clocks():
            _innovations(group, flat, out)
        return out.reshape(columns.shape)

    def _clocks(self) -> list[list[Series]]:
        """Series with slow noise by their clock: they share the filter's loop over time, which is what costs."""
        batches: dict[tuple[int, bytes], list[Series]] = {}
        for s in self.series:
            if _is_slow(s):
                batches.setdefault((s.stop - s.start, np.asarray(s.time).tobytes()), []).append(s)
        return list(batches.values())

    def log_widths(self) -> np.ndarray:
        """(n,) log of what `whiten` divides every innovation by, in the channels' units.

        Their sum is half the log determinant of the noise's covariance.
        """
        out = np.empty(len(self))
        for s in self.series:
            if not _is_slow(s):
                out[s.start : s.stop] = 0.5 * np.log(np.square(s.white) + s.coloured**2)
        for group in self._clocks():
            for i, (total, _, _) in enumerate(_filter(group)):
                out[[s.start + i for s in group]] = 0.5 * np.log(total)
        return out

    def slow_variance(self) -> np.ndarray:
        """(n,) variance of the correlated noise at every observation, as far as earlier ones have not told it.

        With the white noise's it is the variance of an innovation, whose root is what `whiten` divides by.
        """
        out = np.empty(len(self))
        for s in self.series:
            if not _is_slow(s):
                out[s.start : s.stop] = s.coloured**2
        for group in self._clocks():
            for i, (total, _, gain) in enumerate(_filter(group)):
                out[[s.start + i for s in group]] = gain * total
        return out


def _is_slow(s: Series) -> bool:
    """Whether a series has noise that lasts, which a filter over its times whitens."""
    return s.time is not None and s.coloured > 0.0 and s.correlation_time > 0.0


def _filter(group: Sequence[Series]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Variance (series,) of every innovation, share (series,) of the slow noise's mean that is left from the time
    before, and the filter's gain (series,), time by time: none of them depends on what was measured."""
    time = np.asarray(group[0].time)
    white = np.stack([np.broadcast_to(np.square(s.white), time.shape) for s in group], axis=1)
    power = np.array([s.coloured**2 for s in group])
    tau = np.array([s.correlation_time for s in group])
    # The process begins in its stationary state: nothing is known of its past.
    variance, decay = power.copy(), np.ones(len(group))
    for i in range(len(time)):
        if i:
            decay = np.exp(-(time[i] - time[i - 1]) / tau)
            variance = decay**2 * variance + power * (1.0 - decay**2)
        total = variance + white[i]
        gain = variance / total
        yield total, decay, gain
        variance = (1.0 - gain) * variance


def _innovations(group: Sequence[Series], flat: np.ndarray, out: np.ndarray) -> None:
    """Kalman filter of a white noise plus an Ornstein-Uhlenbeck process, for series that share their times."""
    data = np.stack([flat[s.start : s.stop] for s in group], axis=1)  # (time, series, column)
    result = np.empty_like(data, dtype=float)
    mean = np.zeros_like(data[0], dtype=float)
    for i, (total, decay, gain) in enumerate(_filter(group)):
        mean = decay[:, None] * mean
        innovation = data[i] - mean
        result[i] = innovation / np.sqrt(total)[:, None]
        mean = mean + gain[:, None] * innovation
    for j, s in enumerate(group):
        out[s.start : s.stop] = result[:, j]
