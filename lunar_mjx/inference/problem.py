"""What the method needs of a model and its measurements: predictions and their derivatives, at any coordinates.

A problem holds the union of the model's effects and of every candidate, the candidates at their null. A smaller model
is then a row of coordinates, not another program: candidates, parameters, starts and logs are one batch.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.observations import Observations


@dataclasses.dataclass(frozen=True)
class NotTested:
    """A catalogue effect that cannot enter a problem, and why."""

    effect: str
    reason: str


class Problem(abc.ABC):
    """A model, candidates and measurements.

    Attributes:
      observations: what was measured.
      coordinates: everything that may move: baseline, nuisances, candidates.
      baseline: places of the coordinates that a fit of the model as it is moves.
      candidates: places of every candidate's coordinates, by effect.
      effects: the candidates themselves.
      not_tested: catalogue effects that cannot enter.
    """

    observations: Observations
    coordinates: tuple[Coordinate, ...]
    baseline: np.ndarray
    candidates: Mapping[str, np.ndarray]
    effects: Mapping[str, Any]
    not_tested: tuple[NotTested, ...]

    @abc.abstractmethod
    def predict(self, u: np.ndarray) -> np.ndarray:
        """Predicted observations.

        Args:
          u: (k, coordinates).

        Returns:
          (k, n), in the channels' units; not finite where a simulation diverged.
        """

    @abc.abstractmethod
    def jacobian(self, u: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Derivatives of the predictions with respect to some coordinates.

        Args:
          u: (coordinates,).
          which: (m,) places of the coordinates.

        Returns:
          (n, m), in the channels' units per unit of the coordinate.
        """

    def origin(self) -> np.ndarray:
        """The model as given: every coordinate at zero."""
        return np.zeros(len(self.coordinates))

    def prior_rows(self, u: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residual and diagonal Jacobian of the priors of some coordinates, in sigma."""
        # An infinite prior becomes a row of zeros, which holds nothing: no case of its own is needed.
        scale = np.array([1.0 / self.coordinates[i].prior for i in which])
        return (u[which] - np.array([self.coordinates[i].centre for i in which])) * scale, scale

    def bounds(self, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of some coordinates."""
        pairs = np.array([self.coordinates[i].bounds() for i in which], float).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def free(self, effects: Sequence[str] = ()) -> np.ndarray:
        """Places of the baseline's coordinates and of those of some candidates."""
        return np.concatenate([self.baseline, *(self.candidates[e] for e in effects)]).astype(int)
