"""Errors that a model's channels have beyond its ports: slow, and of a size that the drives themselves tell.

A hill that no map has, play in a joint, a link that bends: what a rover's model leaves out shows in its channels as a
course over seconds. Taken for white noise it would be a thousand independent witnesses, and some effect or other would
follow it. As an Ornstein-Uhlenbeck process beside the noise it is as many as it lasts seconds. How long that is the
drives tell as well.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping

import numpy as np

from lunar_mjx.diagnosis.drives.observations import with_discrepancy
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.inference.evidence import Levels
from lunar_mjx.inference.observations import Observations
from lunar_mjx.logs.schema import parse_name


class ChannelErrors:
    """Observations with each size that the slow errors of their channels may have.

    Attributes:
      log_prior: (levels,) of the sizes and times: half-Cauchy in the size, for nobody knows the order of what a model
        leaves out (Gelman 2006).
    """

    def __init__(
        self, observations: Observations, group: np.ndarray, kinds: int, settings: DriveSettings, floor: float = 0.0
    ):
        """Makes them.

        Args:
          observations: with noise alone. group: (n,) noise group of each. kinds: number of groups.
          settings: sizes that are tried, and their prior. floor: least size that is taken.
        """
        self._observations, self._group, self._kinds = observations, group, kinds
        # size and time of each level; how long nothing lasts is no question
        self._levels = [(size, t) for t in settings.error_times_s for size in settings.errors if size > 0.0]
        self._levels.insert(0, (0.0, settings.error_times_s[0]))
        self._spread = spread(observations)
        self._fit = observations.in_split("fit")
        # whitening of drives that are held out would double what takes most of the time
        self._fitted = observations.of_rows(self._fit)
        self._made: dict[tuple[int, ...], Observations] = {}
        self._whitens: dict[tuple[int, ...], Observations] = {}
        sizes = np.array([size for size, _ in self._levels])
        # every time is as probable as another
        self.log_prior = -np.log1p((sizes / settings.usual_error) ** 2)
        self.log_prior -= np.log(len(settings.error_times_s)) * (sizes > 0.0)
        self.log_prior[sizes < floor] = -np.inf
        self.usual = np.full(kinds, int(np.argmin(np.abs(sizes - max(settings.usual_error, floor)))))

    @functools.cached_property
    def log_scale(self) -> np.ndarray:
        """(levels, groups) sum of the logarithms of what whitening divides the fitted ones by."""
        kinds, group = self._kinds, self._group[self._fit]
        scales = [self._fitted_at(np.full(kinds, level)).log_widths() for level in range(len(self._levels))]
        return np.array([np.bincount(group, s, minlength=kinds) for s in scales])

    def shares(self, levels: np.ndarray) -> dict[str, float]:
        """The size of a channel's errors, as a share of what it does, at a level (groups,) of each group."""
        return {s.channel: self._levels[levels[self._group[s.start]]][0] for s in self._observations.series}

    def times_s(self, levels: np.ndarray) -> dict[str, float]:
        """How long a channel's errors last, s, at a level (groups,) of each group."""
        return {s.channel: self._levels[levels[self._group[s.start]]][1] for s in self._observations.series}

    def at_shares(self, shares: Mapping[str, float], times_s: Mapping[str, float]) -> np.ndarray | None:
        """(groups,) levels at which channels have such errors, as `shares` and `times_s` tell them; None for none."""
        found = np.full(self._kinds, -1)
        for s in self._observations.series:
            level = shares.get(s.channel, math.nan), times_s.get(s.channel, math.nan)
            if level not in self._levels:
                return None
            found[self._group[s.start]] = self._levels.index(level)
        return found

    def at(self, levels: np.ndarray) -> Observations:
        """The observations with errors of a level (groups,) of each group."""
        key = tuple(map(int, levels))
        if key not in self._made:
            self._made[key] = self._with_errors(self._observations, levels)
        return self._made[key]

    def _fitted_at(self, levels: np.ndarray) -> Observations:
        """The fitted ones, as `at`."""
        key = tuple(map(int, levels))
        if key not in self._whitens:
            self._whitens[key] = self._with_errors(self._fitted, levels)
        return self._whitens[key]

    def _with_errors(self, observations: Observations, levels: np.ndarray) -> Observations:
        times, shares = self.times_s(levels), self.shares(levels)
        measured = {s.channel for s in observations.series}
        chosen = {c: share * self._spread[c] for c, share in shares.items() if share > 0.0 and c in measured}
        for time_s in sorted({times[c] for c in chosen}):
            mine = {c: v for c, v in chosen.items() if times[c] == time_s}
            observations = with_discrepancy(observations, mine, time_s)
        return observations

    def levels(self, columns: np.ndarray, residual: np.ndarray, start: np.ndarray | None = None) -> Levels:
        """The fitted observations with each size of errors.

        Args:
          columns: (n, k) derivatives of the predictions, SI units. residual: (n,) measured less predicted.
          start: (groups,) levels to begin at; the usual size and none if None.
        """

        def whiten(levels: np.ndarray, fitted: np.ndarray) -> np.ndarray:
            return self._fitted_at(levels).whiten(fitted)

        none = np.full_like(self.usual, int(np.argmax(self.log_prior > -np.inf)))
        starts = np.stack([self.usual, none] if start is None else [start])
        fit = self._fit
        return Levels(columns[fit], residual[fit], self._group[fit], whiten, self.log_scale, self.log_prior, starts)


def spread(observations: Observations) -> dict[str, float]:
    """Root mean square of what a channel does, about its first value, by channel, over all logs, its axes together."""
    by_kind: dict[str, list[float]] = {}
    for s in observations.series:
        v = observations.value[s.start : s.stop]
        # Axes together, since one of them may stand still in these drives and would be left without any error.
        by_kind.setdefault(error_kind(s.channel), []).append(float(np.mean((v - v[0]) ** 2)))
    return {s.channel: float(np.sqrt(np.mean(by_kind[error_kind(s.channel)]))) for s in observations.series}


def error_kind(channel: str) -> str:
    """A channel's name without its axis and corner: channels of one kind share the sizes of their noise and errors."""
    parts = parse_name(channel)
    return channel if parts is None else dataclasses.replace(parts, axis="").kind
