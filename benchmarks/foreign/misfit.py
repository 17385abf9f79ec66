"""Smooth random misfits: what a contact law gets wrong by some per cent, and no parameter mends."""

from __future__ import annotations

import dataclasses

import numpy as np

RIM = 0.5
"""Share of the contact over which a misfit changes."""
FEATURES = 10
"""Waves of a field; with their cosines and sines it is nearly a Gaussian process of squared-exponential kernel."""


@dataclasses.dataclass(frozen=True)
class Field:
    """A smooth random function of scaled coordinates: sum of a_i cos(w_i x) + b_i sin(w_i x).

    Attributes:
      waves: wave vectors per unit of the coordinates, shape (wave, coordinate).
      weights: amplitudes of the cosines, then of the sines, shape (2 wave,).
    """

    waves: np.ndarray
    weights: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator, rms: float, coordinates: int) -> Field:
        """A field of a root mean square `rms` over many draws and a length scale of one unit (Rahimi & Recht 2007)."""
        waves = rng.normal(size=(FEATURES, coordinates))
        return cls(waves, rng.normal(size=2 * FEATURES) * rms / np.sqrt(FEATURES))

    def basis(self, x: np.ndarray) -> np.ndarray:
        """Values of the cosines and sines, shape (2 wave, ...), at coordinates of shape (..., coordinate)."""
        phase = np.moveaxis(x @ self.waves.T, -1, 0)
        return np.concatenate([np.cos(phase), np.sin(phase)])

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values at coordinates of shape (..., coordinate)."""
        phase = x @ self.waves.T
        half = len(self.waves)
        return np.cos(phase) @ self.weights[:half] + np.sin(phase) @ self.weights[half:]

    def by_rows_and_places(self, row: np.ndarray, place: np.ndarray, more: np.ndarray | float = 0.0) -> np.ndarray:
        """Values (row, place) where all rows have the same places: cos(a + b) taken apart, as a product of matrices.

        Args:
          row: all coordinates but the last, shape (row, coordinate - 1). place: the last one, shape (place,).
          more: what each row's field has beside `weights`, shape (row, 2 wave).
        """
        half, weights = len(self.waves), self.weights + more
        even, odd = weights[..., :half], weights[..., half:]
        a, b = row @ self.waves[:, :-1].T, self.waves[:, -1:] * place
        cosine, sine = np.cos(a), np.sin(a)
        return (cosine * even + sine * odd) @ np.cos(b) + (cosine * odd - sine * even) @ np.sin(b)


def coordinates(slip: np.ndarray, angle: np.ndarray, load: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Scaled coordinates of a place under a wheel.

    Args:
      slip: ratio. angle: slip angle, rad. load: over the table's middle load. rim: angle along the contact, over the
        entry angle.

    Returns:
      Shape (..., 4): a misfit changes over half a unit of slip, 45 degrees, a factor of two in load, and half the arc.
    """
    parts = np.broadcast_arrays(slip / 0.5, angle / np.radians(45.0), np.log(load) / 0.7, rim / RIM)
    return np.stack(parts, axis=-1)
