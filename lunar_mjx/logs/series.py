"""Channels of a log on common windows, and how two of them that should agree do."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from lunar_mjx.logs.log import Log
from lunar_mjx.logs.schema import is_quantity

PERIODS = {"yaw_deg": 360.0, "roll_deg": 360.0}


def continuous(log: Log, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """A channel without gaps and without the jumps of an angle that wraps; None if fewer than 8 samples are left."""
    samples = log.channel(name)
    if samples is None or len(samples[0]) < 8:
        return None
    time, values = samples
    period = PERIODS.get(name)
    # An angle within little more than a turn wraps; one that counts on does not.
    if period is None and is_quantity(name, "joint_angle") and np.ptp(values) <= 6.5:
        period = 2.0 * np.pi
    return time, values if period is None else np.unwrap(values, period=period)


def known(log: Log, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and values of a channel that `span` has found, without gaps and without jumps of a wrapped angle."""
    samples = continuous(log, name)
    assert samples is not None, name
    return samples


def sigma(log: Log, name: str) -> float:
    """Stated noise of a channel; 0 if none is stated."""
    return log.noise[name].std if name in log.noise else 0.0


def at(log: Log, name: str, time: np.ndarray) -> np.ndarray | None:
    """A channel at other times, by straight lines; NaN outside its span."""
    samples = continuous(log, name)
    return None if samples is None else _straight(samples, time)


def known_at(log: Log, name: str, time: np.ndarray) -> np.ndarray:
    """(n,) values of a channel that `span` has found, at other times; NaN outside its span."""
    return _straight(known(log, name), time)


def _straight(samples: tuple[np.ndarray, np.ndarray], time: np.ndarray) -> np.ndarray:
    return np.interp(time, samples[0], samples[1], left=np.nan, right=np.nan)


def span(log: Log, names: Sequence[str]) -> tuple[float, float] | None:
    """Times that all channels cover; None if one is missing or they share none."""
    series = [s for n in names if (s := continuous(log, n)) is not None]
    if len(series) < len(names):
        return None
    low, high = max(s[0][0] for s in series), min(s[0][-1] for s in series)
    return (float(low), float(high)) if high > low else None


def edges(low: float, high: float, count: int = 40, shortest: float = 0.5) -> np.ndarray:
    """Edges of windows over a span: `count` of them, but none shorter than `shortest` s."""
    # Forty windows tell a correlation; half a second is longer than controllers and filters lag.
    return np.linspace(low, high, max(2, min(count, int((high - low) / shortest)) + 1))


def increments(log: Log, name: str, windows: np.ndarray) -> np.ndarray:
    """Change of a channel over each window, from the mean of five samples about each edge: less noise than two."""
    time, values = known(log, name)
    return np.diff(np.interp(windows, time, smooth(values)))


def integrals(log: Log, name: str, windows: np.ndarray, like: str | None = None) -> np.ndarray:
    """Integral of a channel over each window, its edges smoothed as `increments` smooths those of `like`."""
    time, values = known(log, name)
    # Trapezoids over the samples' own times: rates need not be regular.
    total = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(time))])
    if like is not None:
        length = SMOOTHED * np.median(np.diff(known(log, like)[0]))
        # The same smoothing on both sides, or a difference of filters would look like one of channels.
        total = smooth(total, max(1, round(float(length / np.median(np.diff(time))))))
    return np.diff(np.interp(windows, time, total))


def means(log: Log, name: str, windows: np.ndarray) -> np.ndarray:
    """Mean of a channel over each window."""
    return integrals(log, name, windows) / np.diff(windows)


SMOOTHED = 5
"""Samples over which the edges of windows are averaged."""


def smooth(values: np.ndarray, width: int = SMOOTHED) -> np.ndarray:
    """Moving mean, with the ends left as means of fewer samples."""
    kernel = np.ones(min(width, len(values)))
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How a series follows another that it should equal.

    Attributes:
      factor: least-squares factor from reference to series. cosine: between the two, 1 if proportional.
      series, reference: root mean squares.
    """

    factor: float
    cosine: float
    series: float
    reference: float


def agreement(series: np.ndarray, reference: np.ndarray, noise: float, least: float = 0.0) -> Agreement | None:
    """Compares two series; None where the reference does not rise above ten times the noise, and above `least`."""
    keep = np.isfinite(series) & np.isfinite(reference)
    a, b = series[keep], reference[keep]
    if len(a) < 4:
        return None
    rms_a, rms_b = float(np.sqrt(np.mean(a * a))), float(np.sqrt(np.mean(b * b)))
    if rms_b <= max(10.0 * noise, least, 1e-9):
        return None
    cosine = float(a @ b / (len(a) * rms_a * rms_b)) if rms_a > 0.0 else 0.0
    return Agreement(float(a @ b / (b @ b)), cosine, rms_a, rms_b)


FACTORS = {
    57.29577951308232: "degrees for radians",
    1.0 / 57.29577951308232: "radians for degrees",
    1000.0: "thousandths (mm, mA)",
    1e-3: "thousands (km, kN)",
    100.0: "hundredths (cm, percent)",
    0.01: "hundreds",
    9.549296585513721: "rpm for rad/s",
    1.0 / 9.549296585513721: "rad/s for rpm",
    6.283185307179586: "rad for turns",
    1.0 / 6.283185307179586: "turns for rad",
    60.0: "minutes for seconds",
    1.0 / 60.0: "seconds for minutes",
    -1.0: "the sign",
    3.6: "km/h for m/s",
    1.943844: "knots for m/s",
    1.0 / 3.6: "m/s for km/h",
    6.0: "deg/s for rpm",
    1.0 / 6.0: "rpm for deg/s",
}


def guess(factor: float) -> str:
    """What a factor between two channels that should agree looks like; empty if like nothing known."""
    for value, text in FACTORS.items():
        if abs(factor / value - 1.0) < 0.15:
            return f" (looks like {text})"
    return ""
