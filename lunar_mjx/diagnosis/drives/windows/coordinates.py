"""What may be unknown in a drive with imposed wheel speeds: parameters, calibration, and the prior of each.

Every coordinate u is in units of its prior: value = start exp(std u) for positive parameters, start + std u for others.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from lunar_mjx.model import Model

CALIBRATION = "calibration"


@dataclasses.dataclass(frozen=True)
class Unknown:
    """One coordinate.

    Attributes:
      effect, name: parameter of an effect, or `calibration` and what is calibrated.
      std: of its prior: of the logarithm where `factor`, else in `unit`.
      factor: whether the value stays positive and moves by a factor.
      unit: of the value. low, high: what is plausible, in `unit`.
      mean: of the prior, in units of `std` about the model's value.
    """

    effect: str
    name: str
    std: float
    factor: bool = False
    unit: str = "1"
    low: float = -math.inf
    high: float = math.inf
    mean: float = 0.0

    @property
    def key(self) -> str:
        return f"{self.effect}.{self.name}"

    def value(self, start: float | np.ndarray, u: float | np.ndarray) -> np.ndarray:
        """The value at `u` for the model's `start`."""
        return start * np.exp(self.std * u) if self.factor else start + self.std * np.asarray(u)


def _factor(effect: str, name: str, std: float, low: float, high: float, unit: str = "1") -> Unknown:
    return Unknown(effect, name, std, True, unit, low, high)


def _shift(effect: str, name: str, std: float, unit: str, low: float = -math.inf, high: float = math.inf) -> Unknown:
    return Unknown(effect, name, std, False, unit, low, high)


ROVER = (
    _factor("motor", "gear_efficiency", 0.10, 0.4, 0.95),
    _factor("coulomb_friction", "torque", 0.7, 0.05, 30.0, "N m"),
    _factor("viscous_friction", "damping", 1.0, 1e-3, 30.0, "N m s/rad"),
    _shift("com_offset", "x", 0.04, "m", -0.15, 0.15),
    _shift("com_offset", "z", 0.05, "m", -0.1, 0.2),
    _factor("hard_ground", "mu", 0.35, 0.05, 1.3),
    _factor("hard_ground", "slip_scale", 0.8, 0.003, 0.4),
    _factor("hard_ground", "side", 0.3, 0.2, 1.3),
)
"""What a data sheet leaves open of a rover and of its tyres on hard ground. Torque constant, gear and efficiency act as
their product, of which the efficiency stands for all."""

SENSORS = (
    _shift(CALIBRATION, "pitch", 2.0, "deg", -10.0, 10.0),
    _shift(CALIBRATION, "roll", 2.0, "deg", -10.0, 10.0),
    _shift(CALIBRATION, "gyro_bias", 0.01, "rad/s", -0.1, 0.1),
    _shift(CALIBRATION, "gyro_scale", 0.01, "1", -0.1, 0.1),
    _shift(CALIBRATION, "current_difference", 0.03, "1", -0.3, 0.3),
    _shift(CALIBRATION, "current_floor", 0.2, "A", -0.6, 0.6),
    _shift(CALIBRATION, "imu_clock", 0.05, "s", -0.5, 0.5),
)
"""What every instrument may be off by. `current_difference` is the left side's scale over the right one's, less 1;
`current_floor` what an ammeter of magnitudes shows at rest beyond 0.6 A."""


@dataclasses.dataclass(frozen=True)
class Suspect:
    """Something that may be missing or wrong, with what it adds to the unknowns.

    Attributes:
      name: effect of the catalogue, parameter of the model (`effect.parameter`), or calibration.
      kind: "effect", "parameter" or "sensor".
      unknowns: its coordinates, whose priors take the place of those of the same key.
      family: ground, drive, rover or sensor.
    """

    name: str
    kind: str
    unknowns: tuple[Unknown, ...]
    family: str


SUSPECTS = (
    Suspect(
        "rolling_resistance", "effect", (_shift("rolling_resistance", "coefficient", 0.08, "1", 0.0, 0.5),), "ground"
    ),
    Suspect(
        "soft_ground",
        "effect",
        (
            _factor("soft_ground", "stiffness", 1.2, 2e4, 2e7, "N/m^(n+2)"),
            _factor("soft_ground", "cohesion", 0.7, 100.0, 2e4, "Pa"),
            _factor("soft_ground", "friction_angle", 0.25, 0.2, 0.85, "rad"),
            _factor("soft_ground", "shear_modulus", 0.6, 4e-3, 0.12, "m"),
        ),
        "ground",
    ),
    Suspect("hard_ground.mu", "parameter", (_factor("hard_ground", "mu", 0.7, 0.02, 1.3),), "friction"),
    Suspect(
        "coulomb_friction.torque",
        "parameter",
        (_factor("coulomb_friction", "torque", 0.7, 0.05, 30.0, "N m"),),
        "drive",
    ),
    Suspect("motor.gear_efficiency", "parameter", (_factor("motor", "gear_efficiency", 0.25, 0.3, 1.0),), "drive"),
    Suspect(
        "viscous_friction", "effect", (_shift("viscous_friction", "damping", 1.5, "N m s/rad", 0.0, 30.0),), "drive"
    ),
    Suspect("payload", "effect", (_shift("payload", "mass", 10.0, "kg", 0.0, 75.0),), "rover"),
    Suspect("com_offset.x", "parameter", (_shift("com_offset", "x", 0.08, "m", -0.2, 0.2),), "rover"),
    Suspect(
        "wheel_radius_error", "effect", (_shift("wheel_radius_error", "offset", 0.006, "m", -0.03, 0.03),), "rover"
    ),
    Suspect("calibration.pitch", "sensor", (_shift(CALIBRATION, "pitch", 3.0, "deg", -15.0, 15.0),), "sensor"),
    Suspect(
        "calibration.current_scale", "sensor", (_shift(CALIBRATION, "current_scale", 0.15, "1", -0.6, 0.6),), "sensor"
    ),
    Suspect(
        "calibration.current_left", "sensor", (_shift(CALIBRATION, "current_left", 0.15, "1", -0.6, 0.6),), "sensor"
    ),
    Suspect(
        "calibration.current_right", "sensor", (_shift(CALIBRATION, "current_right", 0.15, "1", -0.6, 0.6),), "sensor"
    ),
    Suspect("calibration.gyro_scale", "sensor", (_shift(CALIBRATION, "gyro_scale", 0.05, "1", -0.3, 0.3),), "sensor"),
    Suspect("calibration.gyro_bias", "sensor", (_shift(CALIBRATION, "gyro_bias", 0.05, "rad/s", -0.3, 0.3),), "sensor"),
    Suspect("calibration.imu_clock", "sensor", (_shift(CALIBRATION, "imu_clock", 0.2, "s", -1.0, 1.0),), "sensor"),
    Suspect(
        "calibration.current_clock", "sensor", (_shift(CALIBRATION, "current_clock", 0.2, "s", -1.0, 1.0),), "sensor"
    ),
)
"""Everything that may be named, with the usual size of each."""

DRIFT = 0.1
"""Share of a data sheet's range by which a rover's own parameters drift from one day to the next: a prior that was
learnt on other logs never gets narrower than this."""


def baseline(model: Model) -> tuple[Unknown, ...]:
    """The unknowns of a model that every hypothesis fits, with priors from the model's file where it states them."""
    given = model.priors
    out = {}
    for unknown in (*ROVER, *SENSORS):
        if unknown.effect == CALIBRATION or unknown.effect in model.effect_names:
            out[unknown.key] = with_prior(unknown, given)
    for suspect in SUSPECTS:
        for unknown in suspect.unknowns:
            added = suspect.kind == "effect" and unknown.effect in model.effect_names
            if unknown.key not in out and (added or unknown.key in given):
                out[unknown.key] = with_prior(unknown, given)
    return tuple(out.values())


def suspects_of(model: Model) -> tuple[Suspect, ...]:
    """What may be missing of a model or wrong in it: effects it has not, parameters of those it has, and sensors."""
    out = []
    for s in SUSPECTS:
        has = s.unknowns[0].effect in model.effect_names
        replaced = s.name == "soft_ground" and "hard_surface" not in model.effect_names
        if (s.kind == "effect" and not has and not replaced) or (s.kind == "parameter" and has) or s.kind == "sensor":
            out.append(s)
    return tuple(out)


def with_prior(unknown: Unknown, given: Mapping[str, tuple[float, float]]) -> Unknown:
    """An unknown with the prior that the model's file states for it: its standard deviation, relative for factors."""
    found = given.get(unknown.key)
    if found is None:
        return unknown
    value, std = found
    if unknown.factor:
        return dataclasses.replace(unknown, std=max(std / value, 1e-6))
    return dataclasses.replace(unknown, std=max(std, 1e-9))


def start_of(model: Model, unknown: Unknown) -> float:
    """The model's own value of an unknown; zero for calibration that nobody stated."""
    if unknown.effect == CALIBRATION:
        return model.priors.get(unknown.key, (0.0, 0.0))[0]
    value = model.parameters.get(unknown.effect, {}).get(unknown.name, 0.0)
    return float(np.mean(value))
