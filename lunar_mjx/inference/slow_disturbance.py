"""Standard errors where residuals are slower than the noise that logs state.

A smooth disturbance far below the noise of a sample does not average out: over many samples it moves a mean as much as
all the noise does. One channel may not show it; all of them together do. So the power of the
residuals is taken by frequency over all channels at once, and where it exceeds white noise the covariance of a fit is
that of an estimate made without knowing so (White 1980, "sandwich").
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import stats
from scipy.fft import dct

from lunar_mjx.inference.observations import Observations

_FEWEST = 20.0
"""Degrees of freedom of a band; fewer are pooled with the next one."""
_CHANCE = 0.01
"""How often white noise may pass for more in a band."""


def inflated(
    observations: Observations, fitted: np.ndarray, residual: np.ndarray, jacobian: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Covariance of a fit whose noise has the spectrum that its residual shows, no less than white noise has.

    Args:
      observations: what was measured. fitted: (n,) which of them were fitted.
      residual, jacobian: (n,) and (n, free), whitened.
      covariance: (free, free) under white noise.

    Returns:
      (free, free); the same where no series has times.
    """
    modes = list(_modes(observations, fitted, residual, jacobian))
    if not modes:
        return covariance
    band, rate, power, slopes = (np.concatenate([m[k] for m in modes]) for k in range(4))
    # what the fit has left of white noise
    freedom = np.clip(1.0 - np.sum(slopes @ covariance * slopes, axis=1), 0.0, 1.0)
    excess = rate * density(band, rate, power**2, freedom)[band]
    return covariance + covariance @ (slopes.T @ (excess[:, None] * slopes)) @ covariance


def density(band: np.ndarray, rate: np.ndarray, power: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """(bands,) spectral density of what is not white noise, in a sample's variance times s; 0 where chance would do.

    Args:
      band: (m,) of every mode. rate: (m,) samples per s of its series: the more, the more a disturbance counts.
      power: (m,) squared residual in it. freedom: (m,) what of white noise a fit leaves there.
    """
    count = int(band.max()) + 1
    over, weight, number = (np.bincount(band, v, count) for v in (power - freedom, freedom * rate, freedom))
    out = np.zeros(count)
    begin = 0
    for end in range(1, count + 1):
        part = slice(begin, end)
        if number[part].sum() >= _FEWEST:
            if over[part].sum() > stats.chi2.isf(_CHANCE, number[part].sum()) - number[part].sum():
                out[part] = over[part].sum() / weight[part].sum()
            begin = end
    return out


def _modes(
    observations: Observations, fitted: np.ndarray, residual: np.ndarray, jacobian: np.ndarray
) -> Iterator[tuple[np.ndarray, ...]]:
    """Octave of frequency (k,), samples per s (k,), residual (k,) and sensitivities (k, free) by cosine modes of every
    fitted series."""
    series = [s for s in observations.series if s.time is not None and s.stop - s.start > 1 and fitted[s.start]]
    if not series:
        return
    intervals = [float(np.median(np.diff(s.time))) for s in series]  # type: ignore[arg-type]
    longest = max(step * (s.stop - s.start) for s, step in zip(series, intervals, strict=True))
    for s, step in zip(series, intervals, strict=True):
        part, count = slice(s.start, s.stop), s.stop - s.start
        # a mean holds all that is slower than the first mode
        cycles = np.maximum(np.arange(count), 0.5) / (step * count)
        octave = np.floor(np.log2(2.0 * cycles * longest) + 1e-9).astype(int)
        yield (
            octave,
            np.full(count, 1.0 / step),
            np.asarray(dct(residual[part], norm="ortho")),
            np.asarray(dct(jacobian[part], axis=0, norm="ortho")),
        )
