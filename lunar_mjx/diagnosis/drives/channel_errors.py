"""Errors that a model's channels have beyond its ports: slow, and of a size that the drives themselves tell.

A hill that no map has, play in a joint, a link that bends: what a rover's model leaves out shows in its channels as a
course over seconds. Taken for white noise it would be a thousand independent witnesses, and some effect or other would
follow it. As an Ornstein-Uhlenbeck process beside the noise it is as many as it lasts seconds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from lunar_mjx.diagnosis.drives.observations import with_discrepancy
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.inference.evidence import Amplitudes, Gram, NoiseSize, infer
from lunar_mjx.inference.observations import Observations
from lunar_mjx.logs.schema import parse_name


def chosen_errors(
    observations: Observations,
    whole: np.ndarray,
    std: np.ndarray,
    group: np.ndarray,
    kinds: int,
    settings: DriveSettings,
) -> tuple[Observations, Mapping[str, float]]:
    """Observations with the most probable errors of the channels, and these by channel, as shares of what it does.

    The size is that of greatest evidence where all candidates and all unknown inputs are free together, so that nothing
    which one of them explains is put down to it.

    Args:
      observations: with noise alone.
      whole: (n, k + 1) derivatives by everything that may be the matter, SI units, and the residual beside them.
      std: (k,) prior standard deviations. group: (n,) noise group. kinds: number of groups.
      settings: sizes that are tried, and their prior.
    """
    fit = observations.in_split("fit")
    sizes = spread(observations)
    grams, log_det = [], []
    tried = [with_errors(observations, sizes, size) for size in settings.errors]
    for one in tried:
        white = one.whiten(whole)[fit]
        grams.append(Gram.of(white[:, :-1], white[:, -1], group[fit], kinds))
        log_det.append(np.bincount(group[fit], one.log_widths()[fit], minlength=kinds))
    # heavy tails, for nobody knows the order of what a model leaves out (half-Cauchy: Gelman 2006)
    prior = -np.log1p((np.array(settings.errors) / settings.usual_error) ** 2)
    amplitudes = Amplitudes.of(std)
    noises = [NoiseSize(str(g), settings.stated_spread) for g in range(kinds)]

    def value(levels: np.ndarray) -> float:
        gram = Gram(grams[0].count, np.stack([grams[level].matrix[g] for g, level in enumerate(levels)]))
        inferred = infer(gram, amplitudes, (), noises)
        return (
            inferred.log_evidence
            - sum(log_det[level][g] for g, level in enumerate(levels))
            + float(prior[levels].sum())
        )

    levels = np.zeros(kinds, int)
    best = value(levels)
    for _ in range(3):
        before = levels.copy()
        for g in range(kinds):
            for level in range(len(settings.errors)):
                other = levels.copy()
                other[g] = level
                if level != levels[g] and (reached := value(other)) > best:
                    levels, best = other, reached
        if np.array_equal(before, levels):
            break
    shares = {s.channel: settings.errors[levels[group[s.start]]] for s in observations.series}
    chosen = {c: share * sizes[c] for c, share in shares.items() if share > 0.0}
    return with_discrepancy(observations, chosen), shares


def with_errors(observations: Observations, sizes: Mapping[str, float], share: float) -> Observations:
    """Observations whose channels all err by a share of what they do."""
    if share == 0.0:
        return observations
    return with_discrepancy(observations, {c: share * size for c, size in sizes.items()})


def spread(observations: Observations) -> dict[str, float]:
    """Root mean square of what a channel does, about its first value, by channel, over all logs, its axes together."""
    by_kind: dict[str, list[float]] = {}
    for s in observations.series:
        v = observations.value[s.start : s.stop]
        by_kind.setdefault(_kind(s.channel), []).append(float(np.mean((v - v[0]) ** 2)))
    return {s.channel: float(np.sqrt(np.mean(by_kind[_kind(s.channel)]))) for s in observations.series}


def _kind(channel: str) -> str:
    """A channel's name without its axis and corner."""
    parts = parse_name(channel)
    return channel if parts is None else dataclasses.replace(parts, axis="").kind
