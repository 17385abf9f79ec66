"""Fits of a model's coordinates to measurements, from several starts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import qmc

from lunar_mjx.inference.descent import descend
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.problem import Problem

Progress = Callable[[str, float], None]
"""Called with what is being done and the share that is done, 0 to 1."""


def silent(what: str, share: float) -> None:
    """A `Progress` that shows nothing."""
    del what, share


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Attributes:
      u: (coordinates,) where every coordinate stands. free: places of those that moved.
      chi2: over the fitted observations and the priors.
      residual: (n,) whitened residual of all observations (measured less predicted), in sigma.
      jacobian: (n, free) whitened sensitivities. fitted: (n,) which observations were fitted.
    """

    u: np.ndarray
    free: np.ndarray
    chi2: float
    residual: np.ndarray
    jacobian: np.ndarray
    fitted: np.ndarray

    def covariance(self, problem: Problem) -> np.ndarray:
        """(free, free) covariance of the free coordinates, by the Gauss-Newton Hessian with the priors."""
        return Objective(problem, self.free, self.fitted).covariance(self.u, self.jacobian)

    def rms(self, keep: np.ndarray) -> float:
        """Root mean square residual of some observations, in sigma."""
        return float(np.sqrt(np.mean(self.residual[keep] ** 2))) if keep.any() else float("nan")


def fit(
    problem: Problem,
    free: np.ndarray,
    start: np.ndarray | None = None,
    starts: int = 4,
    seed: int = 0,
    spread: float = 1.5,
    splits: Sequence[str] = ("fit",),
    progress: Progress = silent,
) -> Fit:
    """Fits coordinates to the observations of some splits: the lowest of several descents.

    Args:
      problem: model and measurements.
      free: places of the coordinates that move.
      start: (coordinates,) first start; the model as given if None.
      starts: number of starts in all.
      seed: of the Sobol sequence of the other starts.
      spread: half width of the starts' box, in scales (or in the prior's standard deviations, where smaller).
      splits: which observations are fitted.
      progress: told of every start.
    """
    fitted = problem.observations.in_split(*splits)
    goal = Objective(problem, free, fitted)
    origin = problem.origin() if start is None else np.asarray(start, float)
    fits = []
    for i, place in enumerate([origin, *_other_starts(problem, free, origin, starts - 1, seed, spread, goal)]):
        progress("fitting", i / starts)
        fits.append(descend(goal, place))
    # Descents that ended elsewhere are local minima: only the lowest counts.
    best = min(fits, key=lambda d: d.chi2)
    return Fit(best.u, np.asarray(free), best.chi2, best.residual, best.jacobian, fitted)


def _other_starts(
    problem: Problem, free: np.ndarray, origin: np.ndarray, number: int, seed: int, spread: float, goal: Objective
) -> np.ndarray:
    if number <= 0:
        return np.zeros((0, len(origin)))
    # Sobol points are balanced in blocks of a power of two only
    size = 1 << max(0, (number - 1).bit_length())
    cube = qmc.Sobol(len(free), rng=np.random.default_rng(seed)).random(size)[:number]
    # a box wider than the prior would begin where nobody believes the parameter to be
    width = np.array([spread * min(1.0, problem.coordinates[i].prior) for i in free])
    out = np.repeat(origin[None], number, axis=0)
    out[:, free] = np.clip(origin[free] + (2.0 * cube - 1.0) * width, goal.low, goal.high)
    return out
