"""What instruments do to a true signal: white and coloured noise, quantisation, lost samples; and unmodelled dirt."""

from __future__ import annotations

import dataclasses

import numpy as np

Rng = np.random.Generator
NOISES = ("white", "coloured", "quantised")


@dataclasses.dataclass(frozen=True)
class Recipe:
    """How a log is spoilt.

    Attributes:
      kind: "white"; "coloured" (AR(1) along a sweep or over time); "quantised" (white, rounded to the resolution, and
        with lost samples).
      scale: factor on the datasheet's noise. dirt: root mean square of the smooth unmodelled disturbance, in sigma of
        one sample at datasheet noise.
    """

    kind: str = "white"
    scale: float = 1.0
    dirt: float = 0.1


def ar1(rng: Rng, count: int, decay: float) -> np.ndarray:
    """(count,) unit-variance noise whose neighbours correlate by `decay`."""
    shocks = rng.normal(size=count) * np.sqrt(1.0 - decay**2)
    out = np.empty(count)
    last = rng.normal()
    for i, shock in enumerate(shocks):
        last = decay * last + shock
        out[i] = last
    return out


def smooth(rng: Rng, places: np.ndarray, terms: int = 12) -> np.ndarray:
    """(n,) random smooth function of the places (n, k), of unit mean square: a sum of long waves (random features)."""
    frequency = rng.normal(size=(terms, places.shape[1]))
    phase = rng.uniform(0.0, 2.0 * np.pi, terms)
    wave = np.cos(places @ frequency.T + phase) @ rng.normal(size=terms)
    size = np.sqrt(np.mean(wave**2))
    return wave / size if size > 0.0 else wave


def rounded(values: np.ndarray, step: float) -> np.ndarray:
    """Values as a converter of this resolution gives them."""
    return step * np.round(values / step)
