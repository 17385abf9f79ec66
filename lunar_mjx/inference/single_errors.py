"""Errors of single readings under Student's noise: normal noise whose size is each reading's own.

Source: EM for Student's t distribution as a scale mixture of normal ones (Lange, Little & Taylor 1989).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy import special

from lunar_mjx.inference.observations import Observations

_STEPS = 20
"""Steps by which the size of Student's noise settles: each leaves a third or so of what was wrong."""


@dataclasses.dataclass(frozen=True)
class SingleErrors:
    """What single readings have beyond the noise of all.

    Attributes:
      std: (n,) standard deviation of each reading's own error, in its channel's unit; 0 where noise suffices.
      log_ratio: (n,) log density of a reading under Student's noise over that under normal noise with this error.
      freedom: (groups,) most probable degrees of freedom; infinite where noise is normal.
    """

    std: np.ndarray
    log_ratio: np.ndarray
    freedom: np.ndarray


def single_errors(
    plain: Observations,
    present: Observations,
    square: np.ndarray,
    group: np.ndarray,
    counted: np.ndarray,
    freedoms: Sequence[float],
) -> SingleErrors:
    """One step of EM: the most probable errors of single readings, given what a model leaves of them.

    Args:
      plain: observations without such errors. present: with those of the step before.
      square: (n,) squares of the innovations that the model leaves, by `present.whiten`, in sigma: expected ones.
      group: (n,) group of each whose noise has the same degrees of freedom. counted: (n,) which of them tell these.
      freedoms: degrees of freedom that are tried; infinite for normal noise.
    """
    # Of an innovation's variance one part is the slow noise that earlier readings have not told; the rest is this
    # reading's own.
    slow = present.slow_variance()
    usual = slow + _white(plain)
    square = square * (slow + _white(present)) / usual
    # A simulation that diverged says nothing of its readings: they have all the error in the world.
    square = np.where(np.isfinite(square), np.minimum(square, 1e12), 1e12)
    std, log_ratio = np.empty(len(square)), np.empty(len(square))
    found = np.empty(int(group.max()) + 1)
    for g in range(len(found)):
        mine = group == g
        freedom, size = _tails(square[mine & counted], freedoms)
        # Normal noise of most probable size has other tails than that of the size at hand: both are chosen at once, and
        # the size settles with all that it scales.
        wide = np.maximum((freedom + square[mine] / size) / (freedom + 1.0), 1.0) if np.isfinite(freedom) else 1.0
        normal = -0.5 * np.log(wide) - 0.5 * square[mine] / wide
        found[g], std[mine] = freedom, np.sqrt((wide - 1.0) * usual[mine])
        log_ratio[mine] = _log_density(square[mine], freedom) - normal
    return SingleErrors(std, log_ratio, found)


def _tails(square: np.ndarray, freedoms: Sequence[float]) -> tuple[float, float]:
    """Most probable degrees of freedom of Student's noise and size of its variance, by readings' squares in sigma."""
    best, at = -math.inf, (math.inf, 1.0)
    for freedom in freedoms if len(square) else ():
        size = float(np.mean(square)) if math.isinf(freedom) else 1.0
        for _ in range(0 if math.isinf(freedom) else _STEPS):
            size = float(np.mean(square * (freedom + 1.0) / (freedom + square / size)))
        size = max(size, 1e-12)
        value = float(np.sum(_log_density(square / size, freedom))) - 0.5 * len(square) * math.log(size)
        if value > best:
            best, at = value, (freedom, size)
    return at


def _log_density(square: np.ndarray, freedom: float) -> np.ndarray:
    """Log density of Student's noise by the square of a reading in sigma, beside the normal one's constant."""
    if not np.isfinite(freedom):
        return -0.5 * square
    half = 0.5 * (freedom + 1.0)
    scale = special.gammaln(half) - special.gammaln(0.5 * freedom) - 0.5 * np.log(0.5 * freedom)
    return scale - half * np.log1p(square / freedom)


def _white(observations: Observations) -> np.ndarray:
    """(n,) variance of the white noise of every observation."""
    out = np.empty(len(observations))
    for s in observations.series:
        out[s.start : s.stop] = np.square(s.white)
    return out
