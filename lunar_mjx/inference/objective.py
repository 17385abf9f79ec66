"""What a fit minimises: chi-square of whitened residuals with priors, and its quadratic model within bounds.

Source of the bent steps: geodesic acceleration (Transtrum & Sethna 2012).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from lunar_mjx.inference.problem import Problem

_PROBE = 0.1
"""Share of a step at which the second derivative along it is measured (Transtrum & Sethna 2012 take 0.1)."""
_ROOM = 1e-12
"""Width that the solver needs between bounds."""


class Objective:
    """Chi-square of the fitted observations with the priors, and its quadratic model, over the free coordinates."""

    def __init__(self, problem: Problem, free: np.ndarray, fitted: np.ndarray):
        self.problem, self.free, self.fitted = problem, free, fitted
        self.low, self.high = problem.bounds(free)

    def residuals(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residuals (k, n), and chi-square (k,), infinite where a prediction is not finite."""
        observations = self.problem.observations
        r = observations.whiten((observations.value[None] - self.problem.predict(u)).T).T
        return r, self.chi2(u, r)

    def chi2(self, u: np.ndarray, r: np.ndarray) -> np.ndarray:
        """(k,) chi-square of (k, n) residuals at (k, coordinates); infinite where a prediction is not finite."""
        prior = np.array([np.sum(self.problem.prior_rows(row, self.free)[0] ** 2) for row in u])
        with np.errstate(over="ignore", invalid="ignore"):
            # A simulation that diverges overflows here, and counts as infinitely bad instead of stopping the descent.
            chi2 = np.sum(r[:, self.fitted] ** 2, axis=1) + prior
        return np.where(np.isfinite(chi2), chi2, np.inf)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """(n, free) whitened derivatives of the predictions; zero where they are not finite."""
        j = self.problem.observations.whiten(self.problem.jacobian(u, self.free))
        # A zero leaves one coordinate out of a step; a NaN would spoil the step of all of them.
        return np.where(np.isfinite(j), j, 0.0)

    def covariance(self, u: np.ndarray, j: np.ndarray) -> np.ndarray:
        """(free, free) covariance of the free coordinates, by the Gauss-Newton Hessian with the priors."""
        j = j[self.fitted]
        _, scale = self.problem.prior_rows(u, self.free)
        # A direction that neither data nor prior hold has no finite variance: the pseudo-inverse leaves it out.
        return np.linalg.pinv(j.T @ j + np.diag(scale**2), hermitian=True)

    def quadratic(self, u: np.ndarray, r: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Half the downhill gradient and the Gauss-Newton Hessian."""
        prior, scale = self.problem.prior_rows(u, self.free)
        j = j[self.fitted]
        return j.T @ r[self.fitted] - scale * prior, j.T @ j + np.diag(scale**2)

    def steps(self, u: np.ndarray, downhill: np.ndarray, hessian: np.ndarray, dampings: np.ndarray) -> np.ndarray:
        """(dampings, coordinates) damped Gauss-Newton steps, each the best within the bounds.

        Cut at the bounds only, a step would lead where the others fit a coordinate that is somewhere else.
        """
        at = u[self.free]
        out = np.repeat(u[None], len(dampings), axis=0)
        for i, damping in enumerate(dampings):
            # Marquardt's scaling: damping is a share of each coordinate's own stiffness, whatever its unit
            damped = hessian + damping * np.diag(np.diag(hessian) + 1e-12)
            step = _within(damped, downhill, self.low - at, self.high - at)
            out[i, self.free] = np.clip(at + step, self.low, self.high)
        return out

    def bent(
        self, u: np.ndarray, r: np.ndarray, j: np.ndarray, hessian: np.ndarray, trials: np.ndarray, dampings: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Steps bent along a curved valley by the second derivative in their direction (Transtrum and Sethna 2012).

        Returns:
          Their ends; and the probes by which the derivative was taken, with their residuals: steps as well, if short.
        """
        steps = (trials - u)[:, self.free]
        probes = self.probes(u, trials)
        ahead, _ = self.residuals(probes)
        out = trials.copy()
        for i, (step, damping) in enumerate(zip(steps, dampings, strict=True)):
            if not np.isfinite(ahead[i]).all() or not np.any(step):
                continue
            # Second derivative along the step from one more residual, since the first derivative is known.
            second = -2.0 / _PROBE * ((ahead[i] - r) / _PROBE + j @ step)
            inner = hessian + damping * np.diag(np.diag(hessian) + 1e-12)
            bend = -0.5 * np.linalg.lstsq(inner, j[self.fitted].T @ second[self.fitted], rcond=None)[0]
            # beyond this the quadratic path is not to be trusted either
            bend *= min(1.0, 0.75 * np.linalg.norm(step) / max(2.0 * float(np.linalg.norm(bend)), 1e-30))
            out[i, self.free] = np.clip(u[self.free] + step + bend, self.low, self.high)
        return out, probes, ahead

    def probes(self, u: np.ndarray, trials: np.ndarray) -> np.ndarray:
        """(k, coordinates) a short way towards each trial."""
        out = np.repeat(u[None], len(trials), axis=0)
        out[:, self.free] += _PROBE * (trials - u)[:, self.free]
        return out

    def promise(self, u: np.ndarray, downhill: np.ndarray, hessian: np.ndarray) -> float:
        """Drop of chi-square that a full Gauss-Newton step within the bounds promises."""
        step = (self.steps(u, downhill, hessian, np.zeros(1))[0] - u)[self.free]
        return float(2.0 * downhill @ step - step @ hessian @ step)


def _within(hessian: np.ndarray, downhill: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(n,) step that minimises a quadratic model between bounds about zero."""
    # least squares in place of a solve: coordinates that the data do not tell apart leave the matrix singular
    step = np.linalg.lstsq(hessian, downhill, rcond=None)[0]
    if np.all((step >= low) & (step <= high)):
        return step
    # one unit for all coordinates, or the bounded solver's tolerance would hold for the stiffest alone
    size = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-30))
    values, axes = np.linalg.eigh(hessian * np.outer(size, size))
    # Rounding makes eigenvalues of unknown directions negative, and a zero one would be divided by.
    root = np.sqrt(np.maximum(values, 1e-14 * max(float(values[-1]), 1e-30)))
    # a square root of the matrix as rows: the quadratic model becomes a least-squares problem, which takes bounds
    rows = root[:, None] * axes.T
    solution = lsq_linear(rows, (axes.T @ (size * downhill)) / root, (low / size - _ROOM, high / size + _ROOM), "bvls")
    return solution.x * size
