"""Means of readings over short spans of time, against which a model of drives is held.

A model's errors last for about a second, and each reading within one says the same of them. A mean over a tenth of a
second holds what single readings tell of a rover, whose wheels take longer to follow a command, and a fifth or half as
many numbers are to be whitened and weighed. Predictions are averaged like readings, so that nothing is approximated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from lunar_mjx.effects.sensor.channels import EULER
from lunar_mjx.inference.observations import Observations, Series

ON_TIME = 1e-6
"""1; share of a span by which a reading may come too early for it: rounding alone."""


class Means:
    """Which readings are averaged with each other.

    Attributes:
      starts: (n,) place of the first reading of each mean. counts: (n,) readings of each.
    """

    def __init__(self, readings: Observations, seconds: float, begins: Sequence[float]):
        """Makes them.

        Args:
          readings: of drives, each series in the order of its times. seconds: length of a span; 0 for every reading by
            itself. begins: time at which the first span of each log begins, s.
        """
        starts = [np.zeros(0, int)]
        for s in readings.series:
            assert s.time is not None
            if seconds > 0.0:
                span = np.floor((np.asarray(s.time) - begins[s.log]) / seconds + ON_TIME)
                starts.append(s.start + np.flatnonzero(np.diff(span, prepend=-np.inf)))
            else:
                starts.append(np.arange(s.start, s.stop))
        self.starts = np.concatenate(starts)
        self.counts = np.diff(self.starts, append=len(readings))

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """(..., n) means of values (..., readings)."""
        if len(self.starts) == values.shape[-1]:
            return values
        return np.add.reduceat(values, self.starts, axis=-1) / self.counts

    def each(self, means: np.ndarray) -> np.ndarray:
        """(..., readings) the mean (..., n) to which each reading belongs."""
        return np.repeat(means, self.counts, axis=-1)

    def observations(self, readings: Observations) -> Observations:
        """The means as observations, with the noise that the readings' noise leaves in them.

        Args:
          readings: those of which these are the means, with any noise.
        """
        if len(self.starts) == len(readings):
            return readings
        value = readings.value.copy()
        for s in readings.series:
            if s.channel in EULER:  # the mean of 179 and -179 degrees is 180
                value[s.start : s.stop] = np.unwrap(value[s.start : s.stop], period=360.0)
        edges = np.searchsorted(self.starts, [s.start for s in readings.series] + [len(readings)])
        series = [self._series(s, *edges[k : k + 2]) for k, s in enumerate(readings.series)]
        return dataclasses.replace(
            readings, value=self(value), series=tuple(series), unit=readings.unit[self.starts], place=None
        )

    def _series(self, s: Series, start: int, stop: int) -> Series:
        """Means [start, stop) of a series."""
        first, counts = self.starts[start:stop] - s.start, self.counts[start:stop]
        if len(counts) == s.stop - s.start:
            return dataclasses.replace(s, start=int(start), stop=int(stop))
        time = np.asarray(s.time)
        variance = np.broadcast_to(np.square(s.white), time.shape)
        coloured = s.coloured
        if coloured > 0.0 and s.correlation_time > 0.0:
            # Of an Ornstein-Uhlenbeck process as much is left as its values within a span have in common.
            apart = np.arange(round(float(np.mean(counts)))) * float(np.median(np.diff(time)))
            coloured *= float(np.sqrt(np.mean(np.exp(-np.abs(apart[:, None] - apart) / s.correlation_time))))
        else:
            variance, coloured = variance + coloured**2, 0.0
        white = np.sqrt(np.add.reduceat(variance, first)) / counts
        mean_time = np.add.reduceat(time, first) / counts
        return dataclasses.replace(s, start=int(start), stop=int(stop), time=mean_time, white=white, coloured=coloured)
