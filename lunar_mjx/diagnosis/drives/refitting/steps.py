"""Gauss-Newton steps within bounds, and what they promise."""

from __future__ import annotations

import numpy as np

from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT


def bounded_step(
    normal: np.ndarray, downhill: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The Gauss-Newton step (k,) within bounds: coordinates that it would carry beyond one stay on it.

    Args:
      normal: (k, k) matrix of the normal equations. downhill: (k,) half the negative gradient of chi-square.
      x: (k,) where from. low, high: (k,) bounds.
    """
    step, held = np.zeros(len(x)), np.zeros(len(x), bool)
    for _ in range(len(x)):
        move = ~held
        known = downhill[move] - normal[np.ix_(move, held)] @ step[held]
        step[move] = np.linalg.solve(normal[np.ix_(move, move)], known)
        outside = move & ((x + step < low - DRIVE_REFIT.rounding) | (x + step > high + DRIVE_REFIT.rounding))
        if not outside.any():
            break
        step[outside] = np.clip(step[outside], (low - x)[outside], (high - x)[outside])
        # Never let go again: at most one solve for each coordinate, at the price of a step that may not be the very
        # best.
        held |= outside
    return step


def promised(step: np.ndarray, normal: np.ndarray, downhill: np.ndarray) -> float:
    """Decrease of chi-square that the linear model promises of a step (k,); the rest as for `bounded_step`."""
    return float(2.0 * step @ downhill - step @ normal @ step)


def promise_left(normal: np.ndarray, downhill: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Decrease of chi-square that a step within bounds still promises; 0 where it leads uphill, since none need be.

    Args:
      normal, downhill, x, low, high: as for `bounded_step`.
    """
    return max(promised(bounded_step(normal, downhill, x, low, high), normal, downhill), 0.0)
