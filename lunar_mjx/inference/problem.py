"""What the method needs of a model and its measurements: predictions and their derivatives, at any coordinates.

A problem holds the union of the model's effects and of every candidate, the candidates at their null. A smaller model
is then a row of coordinates, not another program: candidates, parameters, starts and logs are one batch.
"""

from __future__ import annotations

import abc
import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
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
      cheap_jacobian: whether every start of a fit can afford Jacobians of its own.
      eager: whether a hundred more rows cost no time, so that Jacobians are best taken before they are known to be
        needed.
      inputs: places of the amplitudes of unknown inputs that follow quantities of their ports, by label; in none of
        the above.
      has_windows: whether predictions may begin anew at measured states.
      noise_unlearnt: whether the noise's colour is known from little, so that `learn_noise` is to be called.
    """

    cheap_jacobian: bool = True
    has_windows: bool = False
    noise_unlearnt: bool = False

    observations: Observations
    coordinates: tuple[Coordinate, ...]
    baseline: np.ndarray
    candidates: Mapping[str, np.ndarray]
    effects: Mapping[str, Any]
    inputs: Mapping[str, np.ndarray] = MappingProxyType({})
    not_tested: tuple[NotTested, ...]

    @property
    def eager(self) -> bool:
        """Whether rows cost no time (one batch of a GPU), so that Jacobians are taken before they are needed."""
        return False

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

    def wide_jacobian(self, u: np.ndarray, which: np.ndarray, std: np.ndarray) -> np.ndarray:
        """The same for intervals, over steps of about the standard errors (m,), scales, in which jumps hardly show."""
        del std
        return self.jacobian(u, which)

    def foresee_wide(self, u: np.ndarray, which: np.ndarray, std: np.ndarray) -> None:
        """`wide_jacobian` may be asked for."""
        del u, which, std

    def linearise(self, u: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, Callable[[int], np.ndarray]]:
        """Predictions (k, n) at (k, coordinates), and the Jacobians (n, m) there by number, simulated at once."""
        return self.predict(u), lambda k: self.jacobian(u[k], which)

    def jacobian_and(self, u: np.ndarray, which: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (n, m) at (coordinates,), and predictions (k, n) at (k, coordinates), simulated at once."""
        return self.jacobian(u, which), self.predict(rows)

    def foresee(self, rows: np.ndarray, which: np.ndarray | None = None) -> None:
        """Rows (k, coordinates), with Jacobians if `which` is given, that will be asked for soon.

        A problem whose rows cost nothing beside others takes them along with its next simulation.
        """
        del rows, which

    @contextlib.contextmanager
    def focused(self, effects: Sequence[str]) -> Iterator[None]:
        """Within it only these candidates leave their null, which a problem may use to simulate fewer effects."""
        del effects
        yield

    @contextlib.contextmanager
    def in_windows(self) -> Iterator[None]:
        """Within it predictions begin anew at the measured state from time to time, where `has_windows`."""
        yield

    @contextlib.contextmanager
    def together(self, threads: int) -> Iterator[Callable[[], None]]:
        """Within it calls of so many threads may be joined; each calls what it yields when it makes no more."""
        del threads
        yield lambda: None

    def learn_noise(self, u: np.ndarray) -> None:
        """Takes the noise's colour anew from the residual at a fit.

        Args:
          u: (coordinates,) of the fit.
        """
        del u

    def origin(self) -> np.ndarray:
        """The model as given: every coordinate at zero."""
        return np.zeros(len(self.coordinates))

    def prior_rows(self, u: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residual and diagonal Jacobian of the priors of some coordinates, in sigma."""
        scale = np.array([1.0 / self.coordinates[i].prior for i in which])
        return (u[which] - np.array([self.coordinates[i].centre for i in which])) * scale, scale

    def bounds(self, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of some coordinates."""
        pairs = np.array([self.coordinates[i].bounds() for i in which], float).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def free(self, effects: Sequence[str] = ()) -> np.ndarray:
        """Places of the baseline's coordinates and of those of some candidates."""
        return np.concatenate([self.baseline, *(self.candidates[e] for e in effects)]).astype(int)

    def kept_step_error(self) -> np.ndarray | None:
        """What predictions take for the error of the time step."""
        return None

    def use_step_error(self, kept: np.ndarray | None) -> None:
        """Takes the error of the time step that a fit was made with."""
        del kept

    def renew_step_error(self, u: np.ndarray, least: float = 1.0) -> bool:
        """Takes the time step's error at a fit rather than at the model as given, if they differ by so much chi-square.

        Returns:
          Whether it did.
        """
        del u, least
        return False

    def certificate(self, u: np.ndarray, free: np.ndarray) -> Mapping[str, float]:
        """What else a fit's certificate must hold, such as the effect of halving the time step on chi-square."""
        del u, free
        return {}
