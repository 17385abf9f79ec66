"""Is the stated noise what the channels show at rest? White and first-order coloured noise, quantised or not."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy import stats

from lunar_mjx.logs.checks.values import VALUE_LIMITS, quantum
from lunar_mjx.logs.findings import Finding
from lunar_mjx.logs.log import Log, Noise
from lunar_mjx.logs.noise import NOISE_ESTIMATE
from lunar_mjx.logs.schema import is_command, is_quantity


@dataclasses.dataclass(frozen=True)
class NoiseLimits:
    """How rest is found in a log, and by how much its noise may differ from what is stated."""

    factor: float = 2.0
    """A stated noise that is wrong by less than this does not mislead; the data sheets themselves are no better."""
    quieter: float = 3.5
    """A stated noise that is too large by less than this is borne, where the rest shows white noise: of noise that is
    nine tenths slow, spans of a few seconds show a third."""
    settle: float = 2.0
    """Seconds after a command has changed in which a rover still rocks."""
    still: float = NOISE_ESTIMATE.still_rad_s
    """rad/s: a wheel of 0.25 m that turns slower moves by less than 5 mm/s."""
    longest: float = 8.0
    """Seconds of rest taken together, over which a parabola follows whatever creeps or cools."""
    white: float = 0.15
    """Largest correlation of neighbouring samples that passes for white noise."""
    shortest: float = 1.2
    """s; shortest rest that is used: twice `margin`, and as much again for the noise itself."""
    margin: float = 0.3
    """Seconds at both ends of a rest in which filters and difference quotients still see the motion beside it."""
    fewest: int = 20
    """Samples of rest below which no noise is estimated: its standard deviation would be off by a sixth or more."""


NOISE_LIMITS = NoiseLimits()


def rest_segments(log: Log) -> list[tuple[float, float]]:
    """Spans of common time, s, at which all commands are constant, drives are commanded to rest and no joint moves."""
    commands = [c for c in log.channel_names if is_command(c)]
    if not commands:
        return []
    start, end = log.span_s
    # Finer than any rest that is used.
    grid = np.arange(start, end, 0.05)
    at_rest = np.ones(len(grid), bool)
    for name in commands:
        at_rest &= _quiet_command(log, name, grid)
    for name in log.channel_names:
        if is_quantity(name, "joint_speed"):
            samples = log.channel(name)
            if samples is None or len(samples[0]) < NOISE_LIMITS.fewest:
                continue
            noise = log.noise[name].std if name in log.noise else 0.0
            speed = np.interp(grid, samples[0], np.abs(_medians(samples[1])))
            at_rest &= speed < max(NOISE_LIMITS.still, noise)
    return _spans(grid, at_rest)


def _medians(values: np.ndarray) -> np.ndarray:
    """Running median of nine samples, so that noise does not look like motion."""
    padded = np.pad(values, 4, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 9), axis=1)


def _quiet_command(log: Log, name: str, grid: np.ndarray) -> np.ndarray:
    samples = log.channel(name)
    if samples is None or not samples[0].size:
        return np.ones(len(grid), bool)
    time, values = samples
    held = values[np.maximum(np.searchsorted(time, grid + 1e-6, side="right") - 1, 0)]
    # A steering angle that is held is at rest, whatever its value.
    quiet = np.ones(len(grid), bool) if is_quantity(name, "command_angle") else held == 0.0
    for change_time in time[1:][np.diff(values) != 0.0]:
        quiet &= (grid < change_time) | (grid > change_time + NOISE_LIMITS.settle)
    return quiet


def _spans(grid: np.ndarray, rest: np.ndarray) -> list[tuple[float, float]]:
    padded = np.concatenate([[False], rest, [False]]).astype(int)
    starts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
    spans = []
    for first, last in zip(starts, ends, strict=True):
        low, high = float(grid[first]), float(grid[last - 1])
        low, high = (
            low + (NOISE_LIMITS.settle if first == 0 else NOISE_LIMITS.margin),
            high - NOISE_LIMITS.margin,
        )  # a log may begin in motion
        pieces = max(1, int(np.ceil((high - low) / NOISE_LIMITS.longest)))
        cuts = np.linspace(low, high, pieces + 1)
        spans += [(float(a), float(b)) for a, b in itertools.pairwise(cuts) if b - a >= NOISE_LIMITS.shortest]
    return spans


def rest_noise(log: Log, name: str, spans: list[tuple[float, float]]) -> tuple[float, float, float] | None:
    """Noise of a channel at rest after a parabola is taken off each span.

    Returns:
      Standard deviation, correlation of neighbouring samples, and the number of independent samples behind it; None if
      there are too few.
    """
    samples = log.channel(name)
    if samples is None:
        return None
    time, values = samples
    squares = products = count = freedom = pairs = 0.0
    for low, high in spans:
        keep = (time >= low) & (time <= high)
        if keep.sum() < NOISE_LIMITS.fewest:
            continue
        # Times within [-1, 1]: powers of seconds would make the parabola ill-conditioned.
        t = 2.0 * (time[keep] - low) / (high - low) - 1.0
        residual = values[keep] - np.polynomial.polynomial.polyval(
            t, np.polynomial.polynomial.polyfit(t, values[keep], 2)
        )
        squares += float(residual @ residual)
        products += float(residual[1:] @ residual[:-1])
        # Three coefficients are fitted to each span.
        count, freedom, pairs = count + len(t), freedom + len(t) - 3, pairs + len(t) - 1
    if freedom < NOISE_LIMITS.fewest - 3 or squares == 0.0:
        return None
    # Negative ones count as none: noise of instruments is white or slow.
    correlation = float(np.clip(products / pairs / (squares / count), 0.0, 0.98))
    # variance of a variance under AR(1): as from n (1 - rho^2)/(1 + rho^2) independent samples
    independent = freedom * (1.0 - correlation**2) / (1.0 + correlation**2)
    return float(np.sqrt(squares / freedom)), correlation, independent


def check_noise(log: Log) -> list[Finding]:
    """Channels whose noise at rest contradicts the stated one by more than `NOISE_LIMITS.factor`, beyond chance."""
    spans = rest_segments(log)
    if not spans:
        return []
    findings: list[Finding] = []
    for name, noise in log.noise.items():
        estimate = rest_noise(log, name, spans) if noise.std > 0.0 and not is_command(name) else None
        if estimate is None:
            continue
        text = _contradiction(log, name, noise, *estimate)
        table = log.table_of(name)
        if text and table is not None:
            findings.append(
                Finding(log.name, table.name, _row(log, name, spans), table.columns.get(name, name), "noise", text)
            )
    return findings


def _contradiction(log: Log, name: str, noise: Noise, std: float, correlation: float, independent: float) -> str:
    samples = log.channel(name)
    assert samples is not None, name
    values = samples[1]
    step = quantum(values)
    # Spans of seconds may show nothing of a slow part.
    least = noise.white or noise.std
    # Rounding adds the variance of a uniform error.
    ratio, quiet = (std / float(np.hypot(s, step / np.sqrt(12.0))) for s in (noise.std, least))
    if noise.correlation_time_s > 0.0 or correlation > 0.5:
        independent = min(independent, 10.0)  # spans of a few seconds hold few correlation times
    # Both large and sure: with many samples 10 % is sure, with few a factor of two is chance.
    if ratio > NOISE_LIMITS.factor and stats.chi2.sf(independent * ratio**2, independent) < VALUE_LIMITS.chance:
        side = "is noisier than stated"
    elif (
        quiet < 1.0 / NOISE_LIMITS.quieter
        and correlation < NOISE_LIMITS.white
        and step < least
        and stats.chi2.cdf(independent * quiet**2, independent) < VALUE_LIMITS.chance
    ):
        side = "is quieter than stated"
    else:
        return ""
    return (
        f"{side}: standard deviation {std:.3g} at rest ({independent:.0f} independent samples, neighbours "
        "correlated "
        f"by {correlation:.2f}) where log.toml states {noise.std:g} from {noise.source}; state what is measured "
        "at rest"
    )


def _row(log: Log, name: str, spans: list[tuple[float, float]]) -> int | None:
    table = log.table_of(name)
    if table is None:
        return None
    return int(np.searchsorted(table.common_time_s, spans[0][0]))
