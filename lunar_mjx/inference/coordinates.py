"""What a fit may move: every parameter as a scaled coordinate with a prior, at zero where the model stands."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

NUISANCE = "initial"
"""Effect of the coordinates that belong to logs."""
WIDE = 10.0
"""Prior standard deviation, in scales, of a coordinate that the data alone should settle."""
FACTOR_UNIT = "factor"
"""Unit, in tables, of a value that multiplies the model's own, which may differ between wheels or joints."""


@dataclasses.dataclass(frozen=True)
class Coordinate:
    """One parameter on a scale of its own: value = start exp(scale u) where `log`, else start + scale u.

    Attributes:
      effect, name: whose parameter it is; nuisances such as a log's initial pose have the effect `NUISANCE`.
      start: value at u = 0, SI units. scale: change per unit of u (relative where `log`).
      low, high: bounds of the value.
      log: whether the logarithm moves.
      prior: standard deviation of u; infinite for none. centre: the value of u that it is centred on.
      unit: of the value.
      log_index: the log that a nuisance belongs to, or -1 where all share it.
      amplitude: whether the value has a null at which its effect vanishes.
      factor: whether the value is a factor on the model's own, which may differ between wheels or joints.
    """

    effect: str
    name: str
    start: float
    scale: float
    low: float
    high: float
    log: bool = False
    prior: float = WIDE
    unit: str = "1"
    log_index: int = -1
    amplitude: bool = False
    factor: bool = False
    centre: float = 0.0

    @property
    def nuisance(self) -> bool:
        """Whether the coordinate belongs to the measurements (an offset, a start) and not to the model."""
        return self.effect == NUISANCE

    @property
    def key(self) -> str:
        """Effect and name in one word, with the log for a nuisance."""
        return f"{self.effect}.{self.name}" + (f"[{self.log_index}]" if self.log_index >= 0 else "")

    def value(self, u: Any) -> Any:
        """The value at a coordinate."""
        return self.start * np.exp(self.scale * np.asarray(u)) if self.log else self.start + self.scale * np.asarray(u)

    def value_within(self, u: float) -> float:
        """The value at a coordinate, within its bounds: a coordinate that lies at its bound may round beyond it."""
        return min(max(float(self.value(u)), self.low), self.high)

    def std(self, u: float, std_u: float) -> float:
        """Standard deviation of the value, from that of the coordinate, to first order."""
        return abs(float(self.value(u)) * self.scale * std_u) if self.log else abs(self.scale * std_u)

    def bounds(self) -> tuple[float, float]:
        """Bounds of the coordinate."""
        if self.log:
            # A logarithm never reaches zero: a lower bound of zero binds nothing.
            low = -np.inf if self.low <= 0.0 else math.log(self.low / self.start) / self.scale
            return low, math.log(self.high / self.start) / self.scale
        # Sorted, because a negative scale turns the bounds around.
        return tuple(sorted(((self.low - self.start) / self.scale, (self.high - self.start) / self.scale)))  # type: ignore[return-value]


def indices(coordinates: Sequence[Coordinate], effects: Sequence[str]) -> np.ndarray:
    """Places of the coordinates of some effects."""
    return np.array([i for i, c in enumerate(coordinates) if c.effect in effects], int)
