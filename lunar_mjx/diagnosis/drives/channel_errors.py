"""Errors that a model's channels have beyond its ports, of a size that the drives themselves tell.

A hill that no map has, play in a joint, a link that bends: what a rover's model leaves out shows in its channels as a
course over seconds. Taken for white noise it would be a thousand independent witnesses, and some effect or other would
follow it. As an Ornstein-Uhlenbeck process beside the noise it is as many as it lasts seconds. How long that is the
drives tell as well.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.instruments import USUAL_ERRORS
from lunar_mjx.diagnosis.drives.observations import with_discrepancy, with_errors
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.inference.evidence import Gram, Levels
from lunar_mjx.inference.observations import Observations
from lunar_mjx.logs.schema import parse_name

LEARNT = ("channel_errors", "error_times_s", "jitter_s")
"""What is kept of a channel's errors: size of the slow ones, over what it does; how long they last, s; scatter, s."""


class ChannelErrors:
    """Observations with each size that the errors of their channels may have: slow ones, and the scatter of times.

    A level is a size of the slow errors, how long they last, and a scatter; every group of channels has one of its own.

    Attributes:
      log_prior: (levels,) half-Cauchy in size and scatter, for nobody knows the order of what a model leaves out
        (Gelman 2006).
      usual: (groups,) level of the usual size and scatter. none: (groups,) level of none and the usual scatter.
    """

    def __init__(
        self,
        observations: Observations,
        group: np.ndarray,
        kinds: int,
        settings: DriveSettings,
        rate: np.ndarray | None = None,
        jitters_s: Sequence[float] = (0.0,),
    ):
        """Makes them.

        Args:
          observations: with noise alone. group: (n,) noise group of each. kinds: number of groups.
          settings: sizes that are tried, and their prior.
          rate: (n,) change of each by time, 1/s, where scatters are tried. jitters_s: those, s.
        """
        self._observations, self._group, self._kinds = observations, group, kinds
        self._rate = np.zeros(len(observations)) if rate is None else rate
        # how long nothing lasts is no question
        sizes = [(size, t) for t in settings.error_times_s for size in settings.errors if size > 0.0]
        sizes.insert(0, (0.0, settings.error_times_s[0]))
        self._each, self._scatters = len(sizes), len(jitters_s)
        self._levels = [(size, t, jitter_s) for jitter_s in jitters_s for size, t in sizes]
        self._spread = spread(observations)
        self._fit = observations.in_split("fit")
        self._made: dict[tuple[int, ...], Observations] = {}
        size = np.array([size for size, _, _ in self._levels])
        scatter = np.array([jitter_s for _, _, jitter_s in self._levels])
        # every time is as probable as another
        self.log_prior = -np.log1p((size / settings.usual_error) ** 2) - np.log1p(
            (scatter / USUAL_ERRORS.jitter_s) ** 2
        )
        self.log_prior -= np.log(len(settings.error_times_s)) * (size > 0.0)
        jitter = self._each * int(np.argmin(np.abs(np.array(jitters_s) - USUAL_ERRORS.jitter_s)))
        usual = int(np.argmin(np.abs(size[: self._each] - settings.usual_error)))
        self.usual, self.none = np.full(kinds, jitter + usual), np.full(kinds, jitter)

    def sizes(self, at: np.ndarray) -> np.ndarray:
        """(m, groups) levels of every size and time, with the scatter of a level (groups,) of each group."""
        return at // self._each * self._each + np.arange(self._each)[:, None]

    def scatters(self, at: np.ndarray) -> np.ndarray:
        """(m, groups) levels of every scatter, with the size and time of a level (groups,) of each group."""
        return at % self._each + self._each * np.arange(self._scatters)[:, None]

    def told(self, levels: np.ndarray) -> dict[str, dict[str, float]]:
        """What is kept of a level (groups,) of each group, by channel: `LEARNT`."""
        by_channel = {s.channel: self._levels[levels[self._group[s.start]]] for s in self._observations.series}
        return {name: {c: level[k] for c, level in by_channel.items()} for k, name in enumerate(LEARNT)}

    def at_told(self, told: Mapping[str, Mapping[str, float]]) -> np.ndarray | None:
        """(groups,) levels of which `told` tells; None where it tells of others than are tried."""
        found = np.full(self._kinds, -1)
        for s in self._observations.series:
            size, time_s, jitter_s = (told[name].get(s.channel, math.nan) for name in LEARNT)
            level = size, time_s, jitter_s
            if level not in self._levels:
                return None
            found[self._group[s.start]] = self._levels.index(level)
        return found

    def at(self, levels: np.ndarray) -> Observations:
        """The observations with errors of a level (groups,) of each group."""
        key = tuple(int(level) for level in levels)
        if key not in self._made:
            shares, times, _ = self.told(levels).values()
            jitter_s = np.array([self._levels[level][2] for level in levels])
            # To first order an error of time is one of the signal, times its rate.
            made = with_errors(self._observations, jitter_s[self._group] * self._rate)
            chosen = {c: share * self._spread[c] for c, share in shares.items() if share > 0.0}
            for time_s in sorted({times[c] for c in chosen}):
                made = with_discrepancy(made, {c: v for c, v in chosen.items() if times[c] == time_s}, time_s)
            self._made[key] = made
        return self._made[key]

    def levels(
        self, columns: np.ndarray, residual: np.ndarray, tried: np.ndarray, starts: Sequence[np.ndarray]
    ) -> Levels:
        """Statistics of the fitted observations at some levels.

        Args:
          columns: (n, k) derivatives of the predictions, SI units. residual: (n,) measured less predicted.
          tried: (m, groups) levels. starts: levels (groups,) among these to begin at, of which the best end counts.
        """
        whole, number, grams, scales = np.column_stack([columns, residual]), self._group[self._fit], [], []
        for row in tried:
            seen = self.at(row)
            white = seen.whiten(whole)[self._fit]
            grams.append(Gram.of(white[:, :-1], white[:, -1], number, self._kinds))
            scales.append(np.bincount(number, seen.log_widths()[self._fit], minlength=self._kinds))
        matrix = np.stack([g.matrix for g in grams])
        begin = np.stack([np.argmax(tried == at, axis=0) for at in starts])
        return Levels(grams[0].count, matrix, np.stack(scales), self.log_prior[tried], begin)


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
