"""Derivatives of a rover's predictions, as difference quotients that step over their jumps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.baseline import FROM_NOTHING
from lunar_mjx.diagnosis.drives.differences import STEP, flatter
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel
from lunar_mjx.diagnosis.drives.refitting.prior import Prior
from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT


class Derivatives:
    """Derivatives of drives' predictions by their coordinates, per scale.

    Attributes:
      steps: (coordinates,) over which they are taken, in scales.
    """

    def __init__(self, drives: DriveProblem, prior: Prior, errors: ErrorModel):
        """Makes them.

        Args:
          drives: simulation. prior: how far coordinates may be from where they are. errors: of the readings.
        """
        self._drives, self._prior, self._errors = drives, prior, errors
        places = prior.places
        # Inputs act on every reading, at all times: to first order in a
        # fiftieth of what is usual a jump of a reading is little, where over a short step it is a slope of thousands.
        own = [FROM_NOTHING.get(c.effect, {}).get(c.name, (0.0, 0.0, STEP))[2] for c in places.coordinates]
        self.steps = np.array(own)
        self.steps[places.discrepancy] = DRIVE_REFIT.input_step * prior.whole_size

    def step_over(self, which: np.ndarray, steps: np.ndarray) -> None:
        """Takes derivatives by some coordinates over steps (which,), in scales, from now on."""
        self.steps[which] = steps

    def jacobian(self, u: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (n,) at (coordinates,) and their derivatives (n, free).

        A jump of a hundredth of a sigma within a difference quotient's step would be a slope of a hundred thousand, and
        stand in it as knowledge. Where a slope says so much, the one to the other side is taken as well, and of each
        reading's two the flatter: the other has the jump.
        """
        value, slopes = self._drives.jacobian(u, free, steps=self.steps)
        slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        steep = self._steep(slopes, free)
        if len(steep):
            other = self._drives.jacobian(u, free[steep], side=-1, steps=self.steps)[1]
            slopes[:, steep] = flatter(slopes[:, steep], other)
        return value, slopes

    def _steep(self, slopes: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Which of some coordinates' slopes (n, m) say more of a reading than any can be true."""
        reach = np.abs(slopes) * self._prior.std[which] / self._errors.observations.sigma()[:, None]
        return np.flatnonzero(reach.max(axis=0, initial=0.0) > DRIVE_REFIT.steep)

    def changes(self, u: np.ndarray, which: Sequence[int] | np.ndarray, steps: np.ndarray) -> np.ndarray:
        """(n, m) changes of the predictions by a step of each of some coordinates alone; 0 where a rover diverged."""
        rows = np.repeat(u[None], 1 + len(which), axis=0)
        rows[1 + np.arange(len(which)), which] += steps
        values = self._drives.predict(rows)
        change = values[1:] - values[:1]
        change[~np.isfinite(change).all(axis=1)] = 0.0
        return change.T
