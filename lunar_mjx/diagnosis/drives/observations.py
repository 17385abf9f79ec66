"""What a campaign of drives measured, as one vector: channels that the model gives, within the time it simulates."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from lunar_mjx.diagnosis.drives.noise import Noises
from lunar_mjx.diagnosis.drives.simulation.rollouts import Bench
from lunar_mjx.diagnosis.drives.slip_samples import defined
from lunar_mjx.errors import bad_input
from lunar_mjx.inference.observations import Observations, Series

if TYPE_CHECKING:
    from lunar_mjx.logs import Log


def default_splits(logs: Sequence[Log]) -> list[str]:
    """Splits of logs that state none: with four or more every fourth is held out, the first of these for selection."""
    out = []
    for i, log in enumerate(logs):
        held = "select" if i % 8 == 3 else "test"
        out.append(log.split or (held if len(logs) >= 4 and i % 4 == 3 else "fit"))
    return out


def observations_of(
    bench: Bench, logs: Sequence[Log], splits: Mapping[str, str], channels: Sequence[str] | None, noise: Noises
) -> Observations:
    """Measurements of the channels that a bench models (all of them if `channels` is None), with their noise.

    Raises:
      UserError: no log is left to be fitted.
    """
    names = tuple(log.name for log in logs)
    default = default_splits(logs)
    split = tuple(splits.get(n, d) for n, d in zip(names, default, strict=True))
    if "fit" not in split:
        said = ", ".join(f"{n}={s}" for n, s in zip(names, split, strict=True))
        raise bad_input("compare", "split", said, "leaves no drive to fit", "give one of them the split fit")
    value, series, unit, at = [], [], [], 0
    for number, (log, run) in enumerate(zip(logs, bench.runs, strict=True)):
        for channel in bench.channels(number):
            if channels is not None and channel not in channels:
                continue
            samples = log.channel(channel)
            if samples is None:
                continue
            time, measured = samples
            inside = (time >= run.begin - 1e-9) & (time <= run.end + 1e-9) & defined(log, run, channel, time)
            time, measured = time[inside], measured[inside]
            if len(time) < 2:
                continue
            white, coloured, tau = noise(log, channel)
            series.append(Series(number, channel, at, at + len(time), time, white, coloured, tau))
            value.append(measured)
            unit.append(np.full(len(time), number))
            at += len(time)
    return Observations(
        value=np.concatenate(value),
        series=tuple(series),
        logs=names,
        split=split,
        unit=np.concatenate(unit),
        unit_split=split,
        unit_names=names,
    )


DISCREPANCY_TIME_S = 1.0
"""Correlation time of a known discrepancy where a channel's noise has none: a model errs alike within a manoeuvre's
phases, which last about a second, and not from sample to sample."""


def discrepancy_of(discrepancy: Mapping[str, float], channels: Collection[str]) -> dict[str, float]:
    """Known unexplained errors of the model by channel, in its unit; 0 where none is stated.

    Args:
      discrepancy: standard deviation by channel; a name may hold `*`. channels: that are compared.

    Raises:
      UserError: a name that matches no channel that is compared, or a negative size.
    """
    for pattern, size in discrepancy.items():
        if not any(fnmatchcase(n, pattern) for n in channels):
            shown = ", ".join(sorted(channels))
            raise bad_input("--discrepancy", "channel", pattern, "is not compared", f"use one of {shown}")
        if not 0.0 <= size < np.inf:
            raise bad_input("--discrepancy", pattern, size, "is no size of an error", "give a number from 0 on")
    return {
        n: float(np.sqrt(sum(size**2 for pattern, size in discrepancy.items() if fnmatchcase(n, pattern))))
        for n in channels
    }


def with_discrepancy(
    observations: Observations, discrepancy: Mapping[str, float], time_s: float = DISCREPANCY_TIME_S
) -> Observations:
    """Observations whose noise holds a known unexplained error of the model, as a coloured part.

    Args:
      observations: of drives. discrepancy: see `discrepancy_of`.
      time_s: correlation time of the error in a channel whose noise has no coloured part of its own.

    Raises:
      UserError: see `discrepancy_of`.
    """
    sizes = discrepancy_of(discrepancy, {s.channel for s in observations.series})

    def widened(s: Series) -> Series:
        added = sizes[s.channel]
        if added == 0.0:
            return s
        time = s.correlation_time if s.coloured > 0.0 and s.correlation_time > 0.0 else time_s
        return dataclasses.replace(s, coloured=float(np.hypot(s.coloured, added)), correlation_time=time)

    return dataclasses.replace(observations, series=tuple(map(widened, observations.series)))


def with_errors(observations: Observations, error: np.ndarray) -> Observations:
    """Observations whose white noise holds errors of single readings, such as those of times that scatter.

    Args:
      observations: of drives. error: (n,) standard deviation of each reading's own error, in its channel's unit.
    """

    def widened(s: Series) -> Series:
        return dataclasses.replace(s, white=np.hypot(s.white, error[s.start : s.stop]))

    return dataclasses.replace(observations, series=tuple(map(widened, observations.series)))
