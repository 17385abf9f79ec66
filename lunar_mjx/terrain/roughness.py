"""Self-affine roughness by spectral synthesis, and the deviogram that measures it.

The root mean square difference of height between points a lag L apart (the deviogram) is nu(L) = nu_0 (L / L_0)^H with
the Hurst exponent H (Shepard et al. 2001). The Moon has H = 0.95 (median, highlands) and less in the maria at 17 m to
2.7 km (Rosenburg et al. 2011), and 0.6 to 0.85 from millimetres to decimetres (Guo et al. 2021, at Chang'E-4).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from scipy import fft

from lunar_mjx.terrain.checks import require_at_least, require_between, require_positive


@dataclasses.dataclass(frozen=True)
class Synthesis:
    """How a surface is synthesised."""

    model_nodes: int = 512
    """Nodes along a side of the torus on which the spectral exponent is found."""
    large: int = 2_000_000
    """Nodes beyond which the synthesis saves memory and time."""


SYNTHESIS = Synthesis()


@dataclasses.dataclass(frozen=True)
class Roughness:
    """Statistics of a self-affine surface.

    Attributes:
      hurst: Hurst exponent, between 0 and 1.
      deviation: root mean square difference of height at the baseline, m. The default is the undulation between
        craters; craters add their own.
      baseline: lag at which the deviation is stated, m.
    """

    hurst: float = 0.75
    deviation: float = 0.02
    baseline: float = 1.0

    def __post_init__(self) -> None:
        require_between(self, "hurst", 0.0, 1.0, "give a Hurst exponent such as 0.75")
        require_at_least(self, "deviation", 0.0, "give the rms height difference in m")
        require_positive(self, "baseline", "give the lag of the deviation in m")


def fractal(
    rows: int, cols: int, cell: float, roughness: Roughness, rng: np.random.Generator, longest: float = np.inf
) -> np.ndarray:
    """Heights of a random self-affine surface.

    Gaussian noise is shaped to a power spectrum ~ k^-(2H+2) on a torus larger than the result, so that opposite edges
    are not alike, and scaled by the spectrum's own expected deviogram.

    Args:
      rows: nodes to the north.
      cols: nodes to the east.
      cell: spacing, m.
      roughness: statistics.
      rng: source of randomness.
      longest: waves longer than this are left out, m.

    Returns:
      Heights in m of mean zero.
    """
    factor = 2.0 if rows * cols <= SYNTHESIS.large else 1.25
    dtype = np.float64 if rows * cols <= SYNTHESIS.large else np.float32
    high, wide = (int(fft.next_fast_len(int(factor * n) + 1, real=True) or n) for n in (rows, cols))
    fy, fx = np.fft.fftfreq(high)[:, None], np.fft.rfftfreq(wide)[None, :]
    k = np.hypot(fy, fx)
    k[0, 0] = np.inf
    gain = k ** -(_spectral_hurst(roughness.hurst) + 1)
    # Within the torus a lag beyond a quarter is no longer self-affine, below a cell there is none.
    lag = float(np.clip(roughness.baseline / cell, 1.0, min(rows, cols) / 4 if min(rows, cols) >= 4 else 1.0))
    wanted = roughness.deviation * (lag * cell / roughness.baseline) ** roughness.hurst
    # Every column of the half plane stands for two but the first and, where the width is even, the last.
    twice = np.full(gain.shape[1], 2.0)
    twice[0] = 1.0
    if wide % 2 == 0:
        twice[-1] = 1.0
    squared = (gain**2 * twice * 2 * (1 - np.cos(2 * np.pi * fx * lag))).sum() / (high * wide)
    gain *= wanted / np.sqrt(squared)
    # Waves that the DEM holds already: adding them again would double the relief.
    gain[k * longest < cell] = 0.0
    noise = rng.standard_normal((high, wide), dtype=dtype)
    shaped: Any = fft.irfft2(fft.rfft2(noise, workers=2) * gain.astype(dtype), s=(high, wide), workers=2)
    heights = shaped[:rows, :cols].astype(np.float64)
    return heights - heights.mean()


@functools.cache
def _spectral_hurst(hurst: float) -> float:
    """The exponent to synthesise with, so that the deviogram of the result has the slope that is asked for.

    A torus lacks the waves longer than itself and a grid those shorter than its cells; both bend the deviogram, by up
    to 0.1 near H = 1. The expected deviogram follows from the spectrum, so the bend is undone by bisection on a grid of
    moderate size.
    """
    f = np.fft.fftfreq(SYNTHESIS.model_nodes)
    k = np.hypot(f[:, None], f[None, :])
    k[0, 0] = np.inf
    lags = np.unique(np.geomspace(2, SYNTHESIS.model_nodes / 32, 12).astype(int))
    waves = 1 - np.cos(2 * np.pi * f[:, None] * lags)
    low, high = -0.5, 2.0
    for _ in range(12):
        middle = 0.5 * (low + high)
        square = (k ** (-2 * middle - 2)).sum(axis=0) @ waves
        slope = 0.5 * np.polyfit(np.log(lags), np.log(square), 1)[0]
        low, high = (middle, high) if slope < hurst else (low, middle)
    return 0.5 * (low + high)


def deviogram(heights: np.ndarray, cell: float, lags: np.ndarray) -> np.ndarray:
    """Root mean square difference of height along rows and columns.

    Args:
      heights: m.
      cell: spacing, m.
      lags: lags in m, rounded to whole cells.

    Returns:
      One deviation per lag, m.
    """
    result = []
    for lag in np.round(np.asarray(lags) / cell).astype(int):
        east, north = heights[:, lag:] - heights[:, :-lag], heights[lag:] - heights[:-lag]
        result.append(np.sqrt(0.5 * ((east**2).mean() + (north**2).mean())))
    return np.array(result)


def hurst_exponent(heights: np.ndarray, cell: float) -> float:
    """Slope of the log-log deviogram between 2 cells and a sixteenth of the grid."""
    lags = cell * np.unique(np.geomspace(2, max(4, min(heights.shape) / 16), 12).astype(int))
    return float(np.polyfit(np.log(lags), np.log(deviogram(heights, cell, lags)), 1)[0])
