"""How rare things are in drives with imposed wheel speeds, and what usually differs from one drive to the next."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.drives.windows.cut import STANDING_M_S
from lunar_mjx.diagnosis.weighed.form import SearchSettings, SettingsKind
from lunar_mjx.errors import bad_input


@dataclasses.dataclass(frozen=True)
class WindowSettings(SearchSettings):
    """Priors and effort of a diagnosis of windows."""

    most_terms: int = 4
    """1; terms of one hypothesis at most: a drive tells less than a table."""
    other_ground_odds: float = 1.0
    """1; prior odds that something of the ground differs where the logs name another ground than the model's logs did:
    as likely as not. Else each suspect of the ground has `effect_odds`, as any other."""

    @classmethod
    def of(cls: type[SettingsKind], changed: Mapping[str, Any]) -> SettingsKind:
        """See `SearchSettings`; what nothing reads here is refused: `DIFFERENCES` has other sizes, and their prior is a
        Gaussian."""
        for name in ("usual_discrepancy", "effect_size", "effect_freedom"):
            if name in changed:
                problem = "is not read where wheel speeds are imposed"
                raise bad_input("settings", name, changed[name], problem, "leave it out")
        return super().of(changed)


@dataclasses.dataclass(frozen=True)
class Difference:
    """What differs from one recording to another on one kind of ground with one rover, at a port of the model.

    Attributes:
      key: by which a model's file holds its size, `between_drives.KEY`. words: for a reader.
      size: usual standard deviation between recordings, as a share of what `words` says.
      unlisted: the same where something unlisted acts; 0 where no such term stands.
    """

    key: str
    words: str
    size: float
    unlisted: float = 0.0

    def share(self, wide: float) -> float:
        """What an amount of 1 changes, so that a size of `wide` is that of something unlisted."""
        return (self.unlisted or 6.0 * self.size) / wide


DIFFERENCES: Mapping[str, Difference] = MappingProxyType(
    {
        "wheel_normal: resistance": Difference("resistance", "resistance of the ground over the load", 0.01, 0.12),
        "wheel_shear: friction": Difference("grip", "friction on the ground", 0.3, 0.6),
        "wheel_shear: side friction": Difference("side_grip", "friction across over along the wheels", 0.1, 0.4),
        "wheel_shear: slip": Difference("slip", "slip at which the friction is reached", 0.3, 0.8),
        "motor_torque: current for a torque": Difference("current", "current for a torque", 0.1, 0.25),
        "motor_torque: left against right": Difference(
            "sides", "left side's current against the right one's", 0.03, 0.15
        ),
        "wheel_normal: resistance by motion": Difference(
            "resistance_by_motion", "resistance of the ground over the load from one motion to another", 0.01
        ),
        "wheel_shear: friction by motion": Difference(
            "grip_by_motion", "friction on the ground from one motion to another", 0.1
        ),
        "wheel_shear: side friction by motion": Difference(
            "side_grip_by_motion", "friction across over along the wheels from one motion to another", 0.1
        ),
        "motor_torque: current by motion": Difference(
            "current_by_motion", "current for a torque from one motion to another", 0.05
        ),
    }
)
"""What usually differs. From drive to drive: rolling resistance over load (hard floors and asphalt have 0.01 to 0.02:
Wong 2008, table 1.1); friction (paint, dust and rubber: 30 %), across over along it, and how stiffly it comes with
slip; current for the same torque (oil and magnets by temperature: 10 %); the left side's against the right one's.
Several recordings teach their own sizes. Unlisted: ground that gives way resists with a tenth of the load and more
(Wong 2008), friction spans from ice to rubber, and gears, magnets and ammeters that are out of order change a current
by a quarter.

The last four depend on how the rover moves (see `by_motion`): no contact law and no gear follows its law exactly, to 5
to 10 % (Wong 2008), and what a law is off by on a pivot it is off by on every pivot, however many windows hold one.
"""


@dataclasses.dataclass(frozen=True)
class WindowPriors:
    """How large usual errors of windows are, and what counts as alike."""

    law_share: float = 0.5
    """Share of the variance of differences by motion that all recordings have in common, which is the law's own error;
    the rest belongs to each recording's ground."""
    # How unlike two motions are of which one says little of a law's error at the other: difference of the angle whose
    # tangent is the sides' half difference over their mean (0: straight, pi/2: a pivot), and log of the ratio of
    # speeds.
    turned_rad: float = 0.5
    faster: float = 0.7
    least_share: float = 0.02
    """Share of the variance of differences by motion that is left out, to have few columns."""
    # Tilt that an accelerometer shows over a second on rough ground; slope along the drive of ground that a log says
    # nothing of, where 5 % is the steepest of most paths and yards.
    uneven_deg: float = 1.0
    unknown_slope_deg: float = 3.0
    late_s: float = 0.05
    """By how much currents come later in one recording than in another: a third of a sample."""
    noise_log_std: float = 0.3
    """How well the noise's size is known from the residuals that it was learnt from."""
    drifted: float = 3.0
    """Standard deviations by which what other logs taught may have drifted: beyond, it is a change, and has to be named
    as one. Without this bound the refit of a hard-floor model on ice takes a friction of 0.15 without a word."""


WINDOW_PRIORS = WindowPriors()


def by_motion(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Columns (window, k) whose random amounts of size 1 differ from motion to motion and are alike for like motions.

    The covariance is Gaussian in the log of the speed and, on the circle, in the angle between straight and pivot.

    Args:
      left, right: (window,) rim speeds of the sides, m/s.
    """
    angle = np.arctan2(0.5 * (right - left), 0.5 * (left + right))
    pace = np.log(np.maximum(np.hypot(left, right), STANDING_M_S))
    turned = (1.0 - np.cos(angle[:, None] - angle)) / WINDOW_PRIORS.turned_rad**2
    faster = 0.5 * ((pace[:, None] - pace) / WINDOW_PRIORS.faster) ** 2
    values, vectors = np.linalg.eigh(np.exp(-turned - faster))
    # the largest first, until what is left out is little
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    many = int(np.searchsorted(np.cumsum(values), (1.0 - WINDOW_PRIORS.least_share) * values.sum())) + 1
    return vectors[:, :many] * np.sqrt(values[:many])


BY_MOTION = " by motion"
"""End of the names of `DIFFERENCES` that depend on how the rover moves."""
BETWEEN = "between_drives"
"""First part of the keys by which a model's file holds what was learnt of the sizes of `DIFFERENCES`."""
