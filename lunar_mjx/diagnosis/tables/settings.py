"""Every number that decides about a table, in one tree: name, unit, and what it rests on."""

from __future__ import annotations

import dataclasses
import math

from lunar_mjx.diagnosis.tables.port_gains import MOMENT
from lunar_mjx.diagnosis.weighed.form import SearchSettings


@dataclasses.dataclass(frozen=True)
class TableSettings(SearchSettings):
    """Sizes, priors and effort of a diagnosis of tables; written to `run.json`."""

    # --- what is usual -----------------------------------------------------------------------------------------------
    effect_discrepancy: float = 0.2
    """1; scale of the half-normal prior of what the law of an effect gets wrong, over what the effect does."""
    following_discrepancy: float = 0.2
    """1; standard deviation of something unlisted that follows one quantity alone."""
    added_force: float = 0.25
    """1; size of a force that is missing, over the load, per size of the gain on the forces that are there."""
    added_usually: float = 0.0
    """1; share of that which belongs to a usual discrepancy: a law is inexact in what it has, what it lacks is
    something unlisted."""
    moment_discrepancy: float = 0.2
    """1; usual error of the driving moment beyond those of the shear stress, over theirs: shear acts at one lever, the
    radius, so that the moment errs with the stress (42 foreign tables of the tuning set: log evidence +22 nat)."""
    drawn_radius: float = 0.1
    """1; size of the wheel's deformation over its radius, per size of the gain on a force: where a stress is good to
    5 per cent, the radius of a wheel under its load is to 0.5 per cent."""
    sensor_scale: float = 0.02
    """1; usual error of a sensor's scale."""
    sensor_zero: float = 0.01
    """1; usual error of a sensor's zero, over its largest reading."""
    cross_talk: float = 0.01
    """1; usual cross-talk between the axes of a force sensor."""
    slip_zero: float = 0.015
    """1; usual error of the imposed slip ratio."""
    angle_zero: float = math.radians(0.5)
    """rad; usual error of the imposed slip angle."""
    abscissa_scale: float = 0.01
    """1; usual error of the scale of slip and slip angle, and of the load's zero over its mean."""
    wheel_radius: float = 0.005
    """1; usual error of the wheel's radius: a rigid wheel is measured by calliper, to half a millimetre in 100."""
    load_scale: float = 0.02
    """1; usual error of the imposed load, and of the wheel's width."""
    bad_calibration: float = 5.0
    """1; how much larger the errors of an instrument are that is out of order."""
    stated_spread: float = 0.3
    """1; standard deviation of the logarithm of the noise's size where it is only stated."""
    replicate_spread: float = 0.15
    """1; standard deviation of the logarithm of a noise's size that replicates tell, beside what their number allows:
    between points noise is not quite that between runs."""

    length_size: float = 0.06
    """1; prior standard deviation of an amplitude in metres (height of grousers, error of the radius) over the wheel's
    radius: VIPER's grousers have 4 to 10 per cent of it."""
    laws: tuple[str, ...] = ("closed form", "stress_integral", "granular_resistance")
    """contact laws that are rivals of the model's own."""

    # --- how rare things are -----------------------------------------------------------------------------------------
    following_odds: float = 0.002
    """1; prior odds of something unlisted that follows load or speed alone, for each field and quantity."""
    calibration_odds: float = 0.005
    """1; prior odds of each instrument to be out of order."""

    # --- smooth functions of a table's points ------------------------------------------------------------------------
    slip_length: float = 0.4
    """1; slip ratio over which a discrepancy changes."""
    angle_length: float = 30.0
    """deg; slip angle over which a discrepancy changes."""
    load_length: float = 0.7
    """1; logarithm of the load over which a discrepancy changes: a factor of two."""
    speed_length: float = 0.7
    """1; logarithm of the speed over which a discrepancy changes: a factor of two."""
    shape_shares: tuple[float, float, float] = (0.3, 0.3, 0.4)
    """1; shares of a discrepancy's variance: constant, linear, curved."""
    mode_share: float = 0.985
    """1; share of the variance that the modes kept have."""
    most_modes: int = 20
    """1; modes kept at most."""
    least_range: float = 0.25
    """1; range of a quantity, in its length, below which a table does not vary it."""
    least_length: float = 0.3
    """sigma; a direction in which even an unlisted discrepancy is shorter is left out."""
    steepest_lever: float = math.radians(80.0)
    """rad; slip angle beyond which the error of a wheel-frame slip grows no further."""

    # --- effort ------------------------------------------------------------------------------------------------------
    most_refits: int = 50
    """1; refits of a search: most tables need 3 to 10, a real wheel with seven effects some 45."""
    most_rounds: int = 10
    """1; rounds of refit and re-linearisation: most refits need 2 or 3."""
    settled: float = 0.3
    """nat; change of log evidence by a round below which a refit has settled."""
    fit_settled: float = 0.02
    """nat; what a step still promises below which a round's descent has arrived."""
    most_evaluations: int = 20
    """1; evaluations of one round of a refit."""

    @property
    def following_log_odds(self) -> float:
        """Log of `following_odds`."""
        return math.log(self.following_odds)

    @property
    def calibration_log_odds(self) -> float:
        """Log of `calibration_odds`."""
        return math.log(self.calibration_odds)

    def usual(self, field: str) -> float:
        """Usual size of a field of discrepancy."""
        return self.usual_discrepancy * (self.moment_discrepancy if field == MOMENT else 1.0)

    def abscissae(self) -> dict[str, float]:
        """Usual error of every abscissa."""
        return {
            "slip zero": self.slip_zero,
            "slip scale": self.abscissa_scale,
            "slip angle zero": self.angle_zero,
            "slip angle scale": self.abscissa_scale,
            "load zero": self.abscissa_scale,
            "load scale": self.load_scale,
            "wheel radius": self.wheel_radius,
            "wheel width": self.load_scale,
        }
