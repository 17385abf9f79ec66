"""What a campaign of drives measured, as one vector: channels that the model gives, within the time it simulates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lunar_mjx.diagnosis.drives.noise import Noises
from lunar_mjx.diagnosis.drives.rollouts import Bench
from lunar_mjx.diagnosis.drives.slip_samples import defined
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
    """Measurements of the channels that a bench models (all of them if `channels` is None), with their noise."""
    value, series, unit, at = [], [], [], 0
    default = default_splits(logs)
    for number, (log, run) in enumerate(zip(logs, bench.runs, strict=True)):
        for channel in bench.channels(number):
            if channels is not None and channel not in channels:
                continue
            found = log.channel(channel)
            if found is None:
                continue
            time, measured = found
            inside = (time >= run.begin - 1e-9) & (time <= run.end + 1e-9) & defined(log, run, channel, time)
            time, measured = time[inside], measured[inside]
            if len(time) < 2:
                continue
            white, coloured, tau = noise(log, channel)
            series.append(Series(number, channel, at, at + len(time), time, white, coloured, tau))
            value.append(measured)
            unit.append(np.full(len(time), number))
            at += len(time)
    names = tuple(log.name for log in logs)
    split = tuple(splits.get(n, d) for n, d in zip(names, default, strict=True))
    return Observations(
        value=np.concatenate(value),
        series=tuple(series),
        logs=names,
        split=split,
        unit=np.concatenate(unit),
        unit_split=split,
        unit_names=names,
    )
