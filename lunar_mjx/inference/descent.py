"""Levenberg-Marquardt on whitened residuals with priors and bounds.

Source: Levenberg-Marquardt with geodesic acceleration (Transtrum & Sethna 2012).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.inference.objective import Objective


@dataclasses.dataclass(frozen=True)
class Damping:
    """How a descent is damped, and when it has arrived."""

    small_promise: float = 0.1
    """Drop of chi-square promised by a Gauss-Newton step below which a descent has arrived."""
    damping_growth: float = 1e2
    """Factor on the damping of Levenberg-Marquardt after a step of no damping helped."""
    iterations: int = 60
    """Most steps: a descent that still moves then creeps along a curved valley, and another start does more."""


DESCENT = Damping()

_DAMPINGS = np.array([1e-4, 1e-2, 1e-1, 1.0, 1e2])
"""Factors on the damping that are tried at once: a batch of rollouts costs little more than one, and a wide spread
finds in one iteration what a single damping would have to walk to."""


@dataclasses.dataclass
class Descent:
    """Where a descent has ended.

    Attributes:
      u: (coordinates,) place. residual: (n,) whitened. jacobian: (n, free) whitened. chi2: with the priors.
    """

    u: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    chi2: float


def descend(goal: Objective, start: np.ndarray, iterations: int = DESCENT.iterations) -> Descent:
    """Levenberg-Marquardt from one start, all dampings of an iteration in one batch.

    Args:
      goal: what is minimised. start: (coordinates,) where from. iterations: most steps.
    """
    u = start.copy()
    # A start may come from another problem with wider bounds.
    u[goal.free] = np.clip(u[goal.free], goal.low, goal.high)
    residuals, chi2s = goal.residuals(u[None])
    if not np.isfinite(chi2s[0]):
        # a simulation that diverged has no slope to follow: the caller's other starts go on
        return Descent(u, residuals[0], np.zeros((residuals.shape[1], len(goal.free))), float(chi2s[0]))
    present = Descent(u, residuals[0], goal.jacobian(u), float(chi2s[0]))
    damping, curved = 1e-2, False
    for _ in range(iterations):
        downhill, hessian = goal.quadratic(present.u, present.residual, present.jacobian)
        promise = goal.promise(present.u, downhill, hessian)
        # Judged by what chi-square can still fall: lengths of gradients and steps depend on units.
        if promise < DESCENT.small_promise:
            break
        dampings = damping * _DAMPINGS
        trials = goal.steps(present.u, downhill, hessian, dampings)
        rows = trials
        if curved:
            bent, probes, _ = goal.bent(present.u, present.residual, present.jacobian, hessian, trials, dampings)
            rows = np.concatenate([trials, bent, probes])
        residuals, chi2s = goal.residuals(rows)
        # All trials are simulated anyhow, so the best one is taken and not the first that helps.
        k = int(np.argmin(chi2s))
        if chi2s[k] < present.chi2:
            # a step that keeps less than half of its promise went round a bend: the next one is bent, too, at the
            # price of one more batch
            curved = not present.chi2 - chi2s[k] > 0.5 * promise
            present = Descent(rows[k], residuals[k], goal.jacobian(rows[k]), float(chi2s[k]))
            # trials, bent ones and probes lie in blocks of the same dampings
            damping = float(np.clip(dampings[k % len(dampings)], 1e-4, 1e6))
        elif damping > 1e8:
            break  # steps this short change nothing but rounding
        else:
            damping, curved = damping * DESCENT.damping_growth, True
    return present
