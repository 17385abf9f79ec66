"""How the scatter of replicates depends on what is read: a constant part, and a share of the reading."""

from __future__ import annotations

import dataclasses

import numpy as np

_RATIOS = np.concatenate([[0.0], np.geomspace(0.1, 30.0, 15)])
"""Share of the reading over the constant part, at the r.m.s. reading; 0 stands for constant noise."""


@dataclasses.dataclass(frozen=True)
class ScatterPrior:
    """What is expected of noise before replicates are seen."""

    constant: float = 0.5
    """Prior probability that noise does not grow with its reading."""
    most_share: float = 0.1
    """Share of the reading beyond which scatter is no noise of an instrument that works."""


SCATTER_PRIOR = ScatterPrior()


def point_scatter(squares: np.ndarray, freedom: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Standard deviation of one run at every point, averaged over how strongly noise may grow with its reading.

    The variance at a point is a^2 (1 + r^2 x^2), with x the reading over its r.m.s.; a has a scale-free prior and is
    integrated, r is summed over a grid.

    Args:
      squares: (points,) sum of squares of replicates about their point. freedom: (points,) runs less one.
      reading: (points,) mean of the replicates.
    """
    x2 = (reading / max(float(np.sqrt(np.mean(reading**2))), 1e-300)) ** 2
    shape = 1.0 + _RATIOS[:, None] ** 2 * x2
    # The scale a integrated under 1/a: what is left of the likelihood is a power of this sum.
    whole = np.sum(squares / shape, axis=1)
    total = float(freedom.sum())
    log_p = -0.5 * np.log(shape) @ freedom - 0.5 * total * np.log(np.maximum(whole, 1e-300))
    # Half of the prior for constant noise, the other half spread over all ratios: growth has to be seen to be believed.
    log_p[0] += np.log(SCATTER_PRIOR.constant)
    log_p[1:] += np.log((1.0 - SCATTER_PRIOR.constant) / (len(_RATIOS) - 1))
    # Less the largest: likelihoods of hundreds of runs underflow otherwise.
    p = np.exp(log_p - log_p.max())
    # The mean of variances and not of deviations: noise adds by its square.
    return np.sqrt((p / p.sum()) @ (whole[:, None] / total * shape))


def grows(squares: np.ndarray, freedom: np.ndarray, reading: np.ndarray, stated: np.ndarray) -> bool:
    """Whether replicates that scatter more than stated do so since noise grows with its reading.

    Compares two explanations of one unknown each by their likelihood: the stated noise and a share of the reading
    beside it, or the stated noise times a constant.

    Args:
      squares, freedom, reading: as for `point_scatter`. stated: (points,) standard deviation.
    """

    def log_likelihood(variance: np.ndarray) -> np.ndarray:
        return -0.5 * (np.log(variance) @ freedom + (1.0 / variance) @ squares)

    shares = np.linspace(0.0, SCATTER_PRIOR.most_share, 41)[:, None]
    factor = np.geomspace(1.0, 100.0, 81)[:, None]
    growing = log_likelihood(stated**2 + (shares * reading) ** 2).max()
    # One unknown each, so that the likelihoods compare without a penalty.
    return bool(growing >= log_likelihood((factor * stated) ** 2).max())
