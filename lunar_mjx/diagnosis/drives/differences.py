"""Derivatives of drives as difference quotients between rovers of one batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.nuisances import is_linear
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.observations import Observations

STEP = 1e-7
"""Difference quotient's step in scales. Predictions jump by hundredths of a sigma where a wheel at rest changes the
sign of its slip; a step this short rarely meets a jump, and rounding spoils only the faintest derivatives."""


class Differences:
    """Which rows a Jacobian takes: nuisances of different logs are perturbed together, since a log feels only its own.

    Args:
      coordinates: of the problem. which: (m,) places of those that the Jacobian is of.
      side: 1 for steps upwards where bounds allow, -1 for steps downwards.
      steps: (coordinates,) size of each one's step in scales; `STEP` for all if None.
    """

    def __init__(
        self, coordinates: Sequence[Coordinate], which: np.ndarray, side: int = 1, steps: np.ndarray | None = None
    ):
        self._coordinates, self._which = coordinates, which
        self._steps = side * (np.full(len(coordinates), STEP) if steps is None else steps)
        self._own = [int(i) for i in which if coordinates[i].log_index >= 0 and not is_linear(coordinates[i])]
        self._shared = [int(i) for i in which if coordinates[i].log_index < 0 and not is_linear(coordinates[i])]
        self._kinds = sorted({coordinates[i].name for i in self._own})

    def rows(self, u: np.ndarray) -> np.ndarray:
        """(k, coordinates) what is to be predicted for the Jacobian at `u`, which comes first."""
        rows = np.repeat(u[None], 1 + len(self._shared) + len(self._kinds), axis=0)
        for k, i in enumerate(self._shared):
            rows[1 + k, i] += self._step(u, i)
        for k, kind in enumerate(self._kinds):
            same_kind = [i for i in self._own if self._coordinates[i].name == kind]
            rows[1 + len(self._shared) + k, same_kind] += [self._step(u, i) for i in same_kind]
        return rows

    def _step(self, u: np.ndarray, i: int) -> float:
        # Inwards at a bound, beyond which the model need not make sense.
        low, high = self._coordinates[i].bounds()
        step = self._steps[i]
        return step if low <= u[i] + step <= high else -step

    def jacobian(
        self,
        u: np.ndarray,
        values: np.ndarray,
        observations: Observations,
        direction: Callable[[Coordinate], np.ndarray],
    ) -> np.ndarray:
        """(n, m) from the predictions (k, n) of `rows(u)`; `direction` gives what a linear nuisance's unit adds."""
        difference = values[1:] - values[:1]
        out = np.zeros((len(observations), len(self._which)))
        for column, i in enumerate(self._which):
            c = self._coordinates[i]
            if is_linear(c):
                out[:, column] = c.scale * direction(c)
            elif c.log_index < 0:
                out[:, column] = difference[self._shared.index(int(i))] / self._step(u, int(i))
            else:
                part = observations.of_log.get(c.log_index, slice(0, 0))
                out[part, column] = difference[len(self._shared) + self._kinds.index(c.name), part] / self._step(
                    u, int(i)
                )
        return out


def flatter(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Of slopes to two sides the flatter ones, reading by reading."""
    return np.where(np.isfinite(other) & (np.abs(other) < np.abs(one)), other, one)
