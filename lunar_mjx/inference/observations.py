"""Measurements as one vector, with their noise: series by log and channel, whitened by models of correlated noise."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import get_lapack_funcs


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


@dataclasses.dataclass(frozen=True, eq=False)
class KalmanFilter:
    """The filter of a series with a white noise and a slow one; it depends on their sizes alone, not on what is read.

    Attributes:
      variance: (n,) of every innovation.
      decay: (n,) share of the slow noise's mean that is left from the time before. gain: (n,) of the filter.
    """

    variance: np.ndarray
    decay: np.ndarray
    gain: np.ndarray

    def innovations(self, columns: np.ndarray) -> np.ndarray:
        """What each reading (n, k) adds to those before it, over its standard deviation."""
        if not columns.shape[1]:  # LAPACK's wrapper writes beyond an array without columns
            return np.zeros(columns.shape)
        # The slow noise's mean before a reading is a share of the one before and of that reading. All of them solve one
        # system with two diagonals: a loop over time would go through all columns at every time.
        bands = np.ones((2, len(columns)))
        bands[1, :-1] = -self.decay[1:] * (1.0 - self.gain[:-1])
        told = np.zeros(columns.shape, order="F")
        told[1:] = (self.decay[1:] * self.gain[:-1])[:, None] * columns[:-1]
        (solve,) = get_lapack_funcs(("tbtrs",), (bands, told))
        mean, _ = solve(bands, told, uplo="L", diag="U", overwrite_b=True)
        return np.asarray((columns - mean) / np.sqrt(self.variance)[:, None])


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

    def of_rows(self, keep: np.ndarray) -> Observations:
        """Those of some rows (n,), which hold every series whole or not at all."""
        series, stop = [], 0
        for s in self.series:
            if keep[s.start]:
                series.append(dataclasses.replace(s, start=stop, stop=stop + s.stop - s.start))
                stop += s.stop - s.start
        assert stop == np.count_nonzero(keep), "a series is kept in part"
        place = None if self.place is None else self.place[keep]
        return dataclasses.replace(
            self, value=self.value[keep], series=tuple(series), unit=self.unit[keep], place=place
        )

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
        for s, kalman in self._filters:
            part = slice(s.start, s.stop)
            out[part] = kalman.innovations(flat[part])
        return out.reshape(columns.shape)

    @functools.cached_property
    def _filters(self) -> list[tuple[Series, KalmanFilter]]:
        """Series with slow noise, and the filters that whiten them."""
        # series of one clock share the loop over its times, which is what costs
        clocks: dict[tuple[int, bytes], list[Series]] = {}
        for s in self.series:
            if _is_slow(s):
                clocks.setdefault((s.stop - s.start, np.asarray(s.time).tobytes()), []).append(s)
        return [found for group in clocks.values() for found in zip(group, _kalman_filters(group), strict=True)]

    def log_widths(self) -> np.ndarray:
        """(n,) log of what `whiten` divides every innovation by, in the channels' units.

        Their sum is half the log determinant of the noise's covariance.
        """
        out = np.empty(len(self))
        for s in self.series:
            if not _is_slow(s):
                out[s.start : s.stop] = 0.5 * np.log(np.square(s.white) + s.coloured**2)
        for s, kalman in self._filters:
            out[s.start : s.stop] = 0.5 * np.log(kalman.variance)
        return out

    def slow_variance(self) -> np.ndarray:
        """(n,) variance of the correlated noise at every observation, as far as earlier ones have not told it.

        With the white noise's it is the variance of an innovation, whose root is what `whiten` divides by.
        """
        out = np.empty(len(self))
        for s in self.series:
            if not _is_slow(s):
                out[s.start : s.stop] = s.coloured**2
        for s, kalman in self._filters:
            out[s.start : s.stop] = kalman.gain * kalman.variance
        return out


def _is_slow(s: Series) -> bool:
    """Whether a series has noise that lasts, which a filter over its times whitens."""
    return s.time is not None and s.coloured > 0.0 and s.correlation_time > 0.0


def _kalman_filters(group: Sequence[Series]) -> list[KalmanFilter]:
    """Filters of a white noise plus an Ornstein-Uhlenbeck process, for series that share their times."""
    time = np.asarray(group[0].time)
    white = np.stack([np.broadcast_to(np.square(s.white), time.shape) for s in group], axis=1)
    power = np.array([s.coloured**2 for s in group])
    decay = np.exp(-np.diff(time, prepend=time[0])[:, None] / np.array([s.correlation_time for s in group]))
    total, gain = np.empty_like(white), np.empty_like(white)
    # The process begins in its stationary state: nothing is known of its past.
    variance = power
    for i in range(len(time)):
        variance = decay[i] ** 2 * variance + power * (1.0 - decay[i] ** 2)
        total[i] = variance + white[i]
        gain[i] = variance / total[i]
        variance = (1.0 - gain[i]) * variance
    return [KalmanFilter(total[:, k], decay[:, k], gain[:, k]) for k in range(len(group))]
