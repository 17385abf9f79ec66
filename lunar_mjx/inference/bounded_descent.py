"""Levenberg-Marquardt within bounds, ended by what a step still promises.

Source: Marquardt 1963; damping after Nielsen 1999; each step by bounded least squares (Stark & Parker 1995, by SciPy).

scipy.optimize.least_squares is not used here: its trust region begins with the length of the first guess, whatever a
step is worth, and where that is short it ends at once, since a short step gains little.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import optimize

DAMPING = 1e-3
"""First damping, as a share of each coordinate's own stiffness: nearly a Gauss-Newton step."""
MOST_DAMPING = 1e8
"""Damping beyond which steps change nothing but rounding."""


def minimise(
    at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    settled: float,
    most: int,
) -> np.ndarray:
    """The place of the smallest sum of squares between bounds.

    Args:
      at: residuals (n,) and their derivatives (n, k) at a place (k,); not finite where a model diverges.
      start: (k,) where from, between the bounds. low, high: (k,) bounds.
      settled: fall of the sum of squares promised by a Gauss-Newton step below which the descent has arrived.
      most: evaluations at most.

    Returns:
      The place (k,).
    """
    x = np.clip(start, low, high)
    residual, slope = at(x)
    present_cost, damping, growth = float(residual @ residual), DAMPING, 2.0
    evaluations = 1
    while True:
        # The undamped step decides: a damped one is short by construction and always promises little.
        if _promise(residual, slope, _step(residual, slope, low - x, high - x, 0.0)) < settled:
            return x
        while True:
            if evaluations >= most or damping > MOST_DAMPING:
                return x
            step = _step(residual, slope, low - x, high - x, damping)
            there = np.clip(x + step, low, high)
            trial, trial_slope = at(there)
            evaluations += 1
            reached = float(trial @ trial) if np.isfinite(trial).all() and np.isfinite(trial_slope).all() else np.inf
            if reached < present_cost:
                break
            # Nielsen's rule: failures double the growth of the damping, so that a hopeless region is left in a few
            # trials.
            damping, growth = damping * growth, 2.0 * growth
        # Share of the promised fall that the step kept: near 1 the model is linear here and the damping may fall to a
        # third.
        kept = (present_cost - reached) / max(_promise(residual, slope, step), 1e-300)
        damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * kept - 1.0) ** 3), 2.0
        x, residual, slope, present_cost = there, trial, trial_slope, reached


def _step(residual: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray, damping: float) -> np.ndarray:
    """The step between bounds about zero that minimises the damped linear model."""
    # one unit for all coordinates, or the bounded solver's tolerance would hold for the stiffest alone
    size = 1.0 / np.maximum(np.linalg.norm(slope, axis=0), 1e-12)
    # a triangle in place of all rows: the same sum of squares but for a constant
    triangle = np.asarray(np.linalg.qr(np.column_stack([slope * size, residual]), mode="r"))
    matrix, right_side = triangle[:, :-1], -triangle[:, -1]
    if damping:
        matrix = np.vstack([matrix, np.sqrt(damping) * np.eye(len(size))])
        right_side = np.concatenate([right_side, np.zeros(len(size))])
    # The free solution is the bounded one wherever it lies inside, and costs one solve.
    step = np.linalg.lstsq(matrix, right_side, rcond=None)[0]
    # SciPy refuses bounds that coincide.
    room = 1e-12
    if np.any(step * size < low) or np.any(step * size > high):
        step = optimize.lsq_linear(matrix, right_side, ((low - room) / size, (high + room) / size), "bvls").x
    # The room above, and rounding, may have led past a bound.
    return np.clip(step * size, low, high)


def _promise(residual: np.ndarray, slope: np.ndarray, step: np.ndarray) -> float:
    """Fall of the sum of squares by a step, in linear approximation."""
    change = slope @ step
    return float(-2.0 * residual @ change - change @ change)
