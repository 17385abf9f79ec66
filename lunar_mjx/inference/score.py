"""What a refit leaves of a signature (orthogonal discrepancy, Plumlee 2017), and blocks of dependent measurements."""

from __future__ import annotations

import numpy as np

from lunar_mjx.inference.fitting import Fit
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.problem import Problem

MOST_BLOCKS = 400
"""Blocks of all logs together at most, but for the four that each log may have."""


def blocks(observations: Observations, residual: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Numbers the blocks over which scores are summed: stretches of at least five correlation times of one log.

    Points of a table form blocks of neighbours of all quantities in one group. Channels of a log share their blocks, so
    that dependence between channels stays inside.

    Returns:
      (n,) block of each observation, counted from 0 among those kept; -1 elsewhere.
    """
    number = np.full(len(observations), -1)
    count = 0
    for log in range(len(observations.logs)):
        mine = [s for s in observations.series if s.log == log]
        if all(s.time is None for s in mine):
            count = _table_blocks(observations, mine, keep, number, count)
            continue
        timed = [s for s in mine if s.time is not None and len(s.time)]
        first = min(float(np.asarray(s.time)[0]) for s in timed)
        last = max(float(np.asarray(s.time)[-1]) for s in timed)
        tau = max([_correlation_time(residual[s.start : s.stop], np.asarray(s.time)) for s in timed], default=0.0)
        length = max(5.0 * tau, (last - first) / max(4, MOST_BLOCKS // max(1, len(observations.logs))), 1e-9)
        # Whole blocks only: a short one at the end would be noisier than the others.
        pieces = max(1, int((last - first) / length))
        edges = np.linspace(first, last, pieces + 1)[1:-1]
        for s in timed:
            part = np.arange(s.start, s.stop)
            number[part] = count + np.searchsorted(edges, np.asarray(s.time), side="right")
        count += pieces
    number[~keep] = -1
    used = np.unique(number[number >= 0])
    relabel = np.full(count + 1, -1)
    relabel[used] = np.arange(len(used))
    return np.where(number >= 0, relabel[number], -1)


def _table_blocks(observations: Observations, mine: list, keep: np.ndarray, number: np.ndarray, count: int) -> int:
    """Blocks of three neighbouring points along the first covariate, within one group."""
    most = count
    for s in mine:
        part = np.arange(s.start, s.stop)
        if not keep[part].any():
            continue
        first = observations.place[part, 0] if observations.place is not None else np.arange(len(part))
        at = count
        for unit in np.unique(observations.unit[part]):
            unit_rows = part[observations.unit[part] == unit]
            order = unit_rows[np.argsort(first[observations.unit[part] == unit], kind="stable")]
            number[order] = at + np.arange(len(order)) // 3
            at += (len(order) + 2) // 3
        most = max(most, at)
    return most


def _correlation_time(residual: np.ndarray, time: np.ndarray) -> float:
    """Time over which the residual's autocorrelation falls to 1/e; 0 for white noise, at most an eighth of the log."""
    # An eighth of fewer samples is the lag of zero alone, where every autocorrelation is one.
    if len(residual) < 16:
        return 0.0
    r = residual - residual.mean()
    power = float(r @ r)
    if power <= 0.0:
        return 0.0
    step = float(np.median(np.diff(time)))
    # Padded to twice the length, so that the end does not wrap around to the beginning.
    size = 1 << (2 * len(r) - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(r, size)) ** 2
    auto = np.fft.irfft(spectrum, size)[: len(r) // 8] / power
    below = np.flatnonzero(auto < np.exp(-1.0))
    lag = int(below[0]) if len(below) else len(auto)
    # Gone within one sample: at this rate the noise is white.
    return 0.0 if lag <= 1 else lag * step


def span(jacobian: np.ndarray, prior_scale: np.ndarray) -> np.ndarray:
    """(n + p, rank) orthonormal basis of what a refit of the baseline moves, the priors counted as observations.

    Args:
      jacobian: (n, p) whitened. prior_scale: (p,) reciprocal prior standard deviations.
    """
    stacked = np.vstack([jacobian, np.diag(prior_scale)])
    # Columns of one length, or the rank would be judged by units.
    size = np.linalg.norm(stacked, axis=0)
    stacked = stacked / np.where(size > 0.0, size, 1.0)
    q, s, _ = np.linalg.svd(stacked, full_matrices=False)
    return q[:, s > 1e-10 * s.max()] if len(s) else q


def outside(columns: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """(n + p, m): what a refit leaves of columns (n, m), given its basis (`span`), the rows of the priors below."""
    extended = np.vstack([columns, np.zeros((len(basis) - len(columns), columns.shape[1]))])
    for _ in range(2):  # once more, against cancellation
        extended = extended - basis @ (basis.T @ extended)
    return extended


def project(columns: np.ndarray, jacobian: np.ndarray, prior_scale: np.ndarray) -> np.ndarray:
    """Columns less what a refit of the baseline takes of them, the priors counted as observations.

    Args:
      columns: (n, m) whitened. jacobian: (n, p) whitened. prior_scale: (p,) reciprocal prior standard deviations.

    Returns:
      (n + p, m): what is left, with the rows of the priors below.
    """
    return outside(columns, span(jacobian, prior_scale))


def leash(problem: Problem, fit: Fit) -> np.ndarray:
    """(free,) reciprocal standard deviations within which a refit may move the coordinates of a fit, by a linear guess.

    Beside the priors, a move over all of a coordinate's range counts as much as all of the misfit: in a model far from
    its data, a prior alone would let a nuisance take in any effect by moving far past its bounds.
    """
    _, prior = problem.prior_rows(fit.u, fit.free)
    low, high = problem.bounds(fit.free)
    residual = fit.residual[fit.fitted]
    excess = max(float(residual @ residual) - len(residual), 0.0)
    return np.sqrt(prior**2 + excess / (high - low) ** 2)
