"""Judging fits on manoeuvres that they never saw, and whether a residual is at the noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from lunar_mjx.inference.fitting import Fit
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.score import blocks


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """When a residual counts as noise, and how manoeuvres are left out."""

    at_noise: float = 1.03
    """Root mean square residual in sigma up to which a model counts as being at the noise, beyond sampling error."""
    channel_at_noise: float = 1.05
    """Root mean square residual in sigma up to which the worst single channel counts as being at the noise."""
    sampling: float = 3.5
    """Standard errors of the mean square that sampling may add: one in four thousand exceeds them."""
    known: float = 1e-2
    """Share of what is known about a direction from which the other manoeuvres count as knowing it."""
    enough: int = 4
    """Fitted manoeuvres from which leaving one out in turn is a fair judge."""
    pieces: int = 4
    """Pieces of a log that are left out in turn where there are too few manoeuvres."""


HELD_OUT = HeldOut()


def predictive_residual(problem: Problem, fit: Fit) -> np.ndarray:
    """(n,) whitened residual of every observation with its own manoeuvre left out of the fit, NaN where set apart.

    For fitted manoeuvres by one Gauss-Newton step from the fit without them; those not fitted as they are.
    """
    out = np.where(problem.observations.in_split("select", "test") | fit.fitted, fit.residual, np.nan)
    _, scale = problem.prior_rows(fit.u, fit.free)
    j = fit.jacobian[fit.fitted]
    hessian = j.T @ j + np.diag(scale**2)
    # Coordinates have units of their own; scaled, the eigenvalues can be compared.
    size = np.sqrt(np.diag(hessian))
    size = np.where(size > 0.0, size, 1.0)
    known, axes = np.linalg.eigh(hessian / np.outer(size, size))
    # Below this is rounding: neither data nor priors know the direction, and nothing can be taken from it.
    kept = known > 1e-13
    unit = axes[:, kept] / np.sqrt(known[kept]) / size[:, None]  # in which all that is known weighs one
    for part in _left_out(problem, fit):
        jb, rb = fit.jacobian[part], fit.residual[part]
        # What this manoeuvre alone says, in units of what all of them say together.
        mine = jb @ unit
        # Leaving the manoeuvre out takes its own part from the Hessian, which is the identity in these units.
        values, vectors = np.linalg.eigh(np.eye(mine.shape[1]) - mine.T @ mine)
        # A direction of which the other manoeuvres know next to nothing stays where the fit put it.
        live = values > HELD_OUT.known
        step = unit @ ((vectors[:, live] / values[live]) @ (vectors[:, live].T @ (mine.T @ rb)))
        out[part] = rb + jb @ step
    return out


def _left_out(problem: Problem, fit: Fit) -> list[np.ndarray]:
    observations = problem.observations
    parts = [np.flatnonzero(fit.fitted & (observations.unit == u)) for u in np.unique(observations.unit[fit.fitted])]
    # Of one or two manoeuvres, leaving one out would leave nothing, or half of what is known; pieces stand in for them.
    if len(parts) >= 3:
        return parts
    number = blocks(observations, fit.residual, fit.fitted)
    pieces = min(HELD_OUT.pieces * len(parts), number.max() + 1)
    group = np.where(number >= 0, number * pieces // (number.max() + 1), -1)
    return [np.flatnonzero(group == g) for g in range(pieces)]


def predictive_gain(
    problem: Problem,
    before: Fit,
    after: Fit,
    old: np.ndarray,
    new: np.ndarray,
    splits: tuple[str, ...] = ("fit", "select"),
) -> tuple[float, float]:
    """Gain of the expected log density on manoeuvres left out, and its standard error, from predictive residuals.

    The models are of one set of measurements, and need not be of one problem.

    Args:
      problem: whose measurements. before, after: the fits. old, new: (n,) their predictive residuals.
      splits: that judge.

    Returns:
      Sum over observations of half the drop of the squared predictive residual; its standard error.
    """
    keep = problem.observations.in_split(*splits)
    few = len(np.unique(problem.observations.unit[before.fitted])) < HELD_OUT.enough
    # Two manoeuvres hardly determine a model that has to predict a third.
    if few and problem.observations.in_split("select").any():
        # Leaving one of two or three groups out of a fit extrapolates too far; those never fitted judge alone.
        keep = problem.observations.in_split("select")
    difference = np.where(keep, 0.5 * (old**2 - new**2), 0.0)
    difference = np.where(np.isfinite(difference), difference, 0.0)
    block = blocks(problem.observations, after.residual, keep)
    inside = (block >= 0) & np.isfinite(old) & np.isfinite(new)
    # One block has no spread: its error is unknown, and not zero.
    if block.max(initial=-1) < 1:
        return float(difference.sum()), float("inf")
    # With the change d of the residual given, the gain is d^2 / 2 + d e; only the residual e is random.
    change = np.where(inside, old - new, 0.0)
    per = np.bincount(block[inside], weights=(change * new)[inside])
    # Unit white noise alone gives the second sum; few blocks may fall below it by chance.
    noise = max(float(np.sum(per**2)), float(np.sum(change**2)))
    return float(difference.sum()), float(np.sqrt(noise))


@dataclasses.dataclass(frozen=True)
class NoiseTest:
    """Whether a residual is at the noise.

    Attributes:
      rms: over all kept observations, in sigma, corrected for the fitted parameters. limit: the most that passes.
      channels: root mean square by channel. worst: the channel that passes least.
      passes: whether all limits hold.
    """

    rms: float
    limit: float
    channels: Mapping[str, float]
    worst: str
    passes: bool


def noise_test(problem: Problem, fit: Fit, splits: tuple[str, ...] = ("fit", "select")) -> NoiseTest:
    """Compares the residual of some splits with the noise, overall and channel by channel."""
    observations = problem.observations
    keep = observations.in_split(*splits)
    n = int(keep.sum())
    fitted_share = float((keep & fit.fitted).sum()) / max(n, 1)
    # Fitted parameters take up residual; at most three quarters of it, where a table is very short.
    freedom = max(n - fitted_share * len(fit.free), 0.25 * n, 1.0)
    squares = np.where(keep, fit.residual**2, 0.0)
    rms = float(np.sqrt(squares.sum() / freedom))
    channels: dict[str, np.ndarray] = {}
    for s in observations.series:
        part = slice(s.start, s.stop)
        count = float(keep[part].sum())
        # squares, observations, and the variance of half their sum: of the noise itself, and of what is known of it
        row = np.array([squares[part].sum(), count, 0.5 * s.dependence * count + (count * s.level) ** 2])
        channels[s.channel] = channels.get(s.channel, np.zeros(3)) + row
    spread = float(sum(row[2] for row in channels.values()))
    # Of half the sum, since the root of a mean square near 1 moves by half as much as the mean square.
    limit = HELD_OUT.at_noise + HELD_OUT.sampling * np.sqrt(spread) / max(n, 1)
    by_channel, worst, ratio = {}, "", 0.0
    for channel, (total, count, variance) in channels.items():
        if count < 1:
            continue
        # Which channel paid for the fitted parameters cannot be told: all pay by their number of observations.
        value = float(np.sqrt(total / count * n / freedom))
        by_channel[channel] = value
        share = value / (HELD_OUT.channel_at_noise + HELD_OUT.sampling * np.sqrt(variance) / count)
        if share > ratio:
            worst, ratio = channel, float(share)
    return NoiseTest(rms, float(limit), by_channel, worst, bool(rms <= limit and ratio <= 1.0))


def errors(problem: Problem, fit: Fit) -> dict[str, float]:
    """Root mean square residual in sigma by split, where the split holds observations."""
    by_split = {}
    for split in ("fit", "select", "test", "apart"):
        keep = problem.observations.in_split(split)
        if keep.any():
            by_split[split] = fit.rms(keep)
    held = problem.observations.in_split("select", "test")
    if held.any():
        by_split["held_out"] = fit.rms(held)
    return by_split
