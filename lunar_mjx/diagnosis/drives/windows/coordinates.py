"""What may be unknown in a drive with imposed wheel speeds: parameters, calibration, and the prior of each.

Every coordinate u is in units of its prior: value = start exp(std u) for positive parameters, start + std u for others.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo is a compiled module without type stubs)

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence

import mujoco
import numpy as np

from lunar_mjx.diagnosis.drives.windows.cut import AHEAD, CHANNELS, CURRENTS, GYRO
from lunar_mjx.errors import bad_input
from lunar_mjx.logs import Log
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
      size: of the rover in which `low`, `high` and, without `factor`, `std` count: a name of `sizes`; "" for none.
    """

    effect: str
    name: str
    std: float
    factor: bool = False
    unit: str = "1"
    low: float = -math.inf
    high: float = math.inf
    mean: float = 0.0
    size: str = ""

    @property
    def key(self) -> str:
        return f"{self.effect}.{self.name}"

    def value(self, start: float | np.ndarray, u: float | np.ndarray) -> np.ndarray:
        """The value at `u` for the model's `start`."""
        return start * np.exp(self.std * u) if self.factor else start + self.std * np.asarray(u)


def _factor(effect: str, name: str, std: float, low: float, high: float, unit: str = "1", size: str = "") -> Unknown:
    return Unknown(effect, name, std, True, unit, low, high, size=size)


def _shift(
    effect: str, name: str, std: float, unit: str, low: float = -math.inf, high: float = math.inf, size: str = ""
) -> Unknown:
    return Unknown(effect, name, std, False, unit, low, high, size=size)


ASSUMED_MOTOR = 0.5
"""Standard deviation of the logarithm of a torque constant that `convert` assumed: motors of one size
differ by half."""
ASSUMED_GEAR = 1.0
"""Standard deviation of the logarithm of a gear ratio that `convert` assumed: gears of wheels go from 20 to 250. The
torque constant stands for motor and gear, since currents tell their product alone."""

ROVER = (
    _factor("motor", "torque_constant", 0.05, 1e-3, 1.0, "N m/A"),
    _factor("motor", "gear_efficiency", 0.10, 0.4, 0.95),
    _factor("coulomb_friction", "torque", 0.7, 5e-4, 0.3, "N m", "torque"),
    _factor("viscous_friction", "damping", 1.0, 1e-4, 2.0, "N m s/rad", "damping"),
    _shift("com_offset", "x", 0.08, "m", -0.3, 0.3, "wheelbase"),
    _shift("com_offset", "y", 0.08, "m", -0.3, 0.3, "wheelbase"),
    _shift("com_offset", "z", 0.10, "m", -0.2, 0.4, "wheelbase"),
    _factor("hard_ground", "mu", 0.35, 0.05, 1.3),
    _factor("hard_ground", "slip_scale", 0.8, 0.003, 0.4),
    _factor("hard_ground", "side", 0.3, 0.2, 1.3),
)
"""What a data sheet leaves open of a rover and of its tyres on hard ground, in sizes of the rover. Magnets differ by
5 % within a series (makers' tolerances are 5 to 10 %)."""

SENSORS = (
    _shift(CALIBRATION, "pitch", 2.0, "deg", -10.0, 10.0),
    _shift(CALIBRATION, "roll", 2.0, "deg", -10.0, 10.0),
    _shift(CALIBRATION, "gyro_bias", 0.01, "rad/s", -0.1, 0.1),
    _shift(CALIBRATION, "gyro_scale", 0.01, "1", -0.1, 0.1),
    _shift(CALIBRATION, "current_difference", 0.03, "1", -0.3, 0.3),
    _shift(CALIBRATION, "current_floor", 0.33, "1", -1.0, 1.0),
    _shift(CALIBRATION, "current_clock", 0.05, "s", -0.5, 0.5),
    _shift(CALIBRATION, "friction_difference", 0.02, "A", -0.1, 0.1, "current"),
    _shift(CALIBRATION, "imu_clock", 0.05, "s", -0.5, 0.5),
    _shift(CALIBRATION, "position_aside", 0.1, "m", -1.0, 1.0),
)
"""What every instrument may be off by. `current_difference` is the left side's scale over the right one's, less 1;
`current_floor` what an ammeter of magnitudes shows at rest over what its log states, less 1; `current_clock` how late
currents come (a third of a sample, and the wind-up of the driveline); `friction_difference` the current that the left
drives' friction needs, less the right ones' (gears of one series differ by half); `position_aside` how far to the left
of the chassis frame's origin the speed over ground is measured."""

MEASURED_BY = {"gyro": (GYRO,), "imu_clock": (GYRO,), "current": CURRENTS, "friction": CURRENTS, "position": (AHEAD,)}
"""Channels by which a calibration can be told, by how its name begins."""


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
            _factor("soft_ground", "stiffness", 1.2, 2e4, 5e6, "N/m^(n+2)"),
            _factor("soft_ground", "cohesion", 0.7, 100.0, 2e4, "Pa"),
            _factor("soft_ground", "friction_angle", 0.25, 0.2, 0.85, "rad"),
            _factor("soft_ground", "shear_modulus", 0.6, 0.01, 0.1, "m"),
        ),
        "ground",
    ),
    Suspect("hard_ground.mu", "parameter", (_factor("hard_ground", "mu", 0.7, 0.02, 1.3),), "friction"),
    Suspect(
        "coulomb_friction.torque",
        "parameter",
        (_factor("coulomb_friction", "torque", 0.7, 5e-4, 0.3, "N m", "torque"),),
        "drive",
    ),
    Suspect("motor.gear_efficiency", "parameter", (_factor("motor", "gear_efficiency", 0.25, 0.3, 1.0),), "drive"),
    Suspect(
        "viscous_friction",
        "effect",
        (_shift("viscous_friction", "damping", 0.1, "N m s/rad", 0.0, 2.0, "damping"),),
        "drive",
    ),
    Suspect("payload", "effect", (_shift("payload", "mass", 0.17, "kg", 0.0, 1.25, "mass"),), "rover"),
    Suspect("com_offset.x", "parameter", (_shift("com_offset", "x", 0.16, "m", -0.4, 0.4, "wheelbase"),), "rover"),
    Suspect(
        "wheel_radius_error",
        "effect",
        (_shift("wheel_radius_error", "offset", 0.036, "m", -0.18, 0.18, "radius"),),
        "rover",
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
    Suspect("calibration.gyro_bias", "sensor", (_shift(CALIBRATION, "gyro_bias", 0.02, "rad/s", -0.1, 0.1),), "sensor"),
    Suspect("calibration.imu_clock", "sensor", (_shift(CALIBRATION, "imu_clock", 0.2, "s", -1.0, 1.0),), "sensor"),
    Suspect(
        "calibration.current_clock", "sensor", (_shift(CALIBRATION, "current_clock", 0.2, "s", -1.0, 1.0),), "sensor"
    ),
)
"""Everything that may be named, with the usual size of each, in sizes of the rover.

Soft ground is as soft as ground that was measured: moduli of sinkage to 5 MPa/m, and of shear deformation from 1 cm
(Wong 2008, ch. 2: snow, loams and sands). Stiffer than that it would stand for another law of friction on a hard floor.

A gyroscope's zero is off by 1 deg/s usually and 5 at most (makers' figures of small MEMS gyroscopes), so that a rover
that hardly turns while its wheels do is not ascribed to it."""

DRIFT = 0.1
"""Share of a data sheet's range by which a rover's own parameters drift from one day to the next: a prior that was
learnt on other logs never gets narrower than this."""


def sizes(model: Model) -> dict[str, float]:
    """Sizes of a rover: mass kg; wheel radius, wheelbase and track m; torque N m, damping N m s/rad and current A.

    The torque is weight times wheel radius, with which all of the weight would be lifted at the rim; the damping, one
    in every wheel, makes it at a rim speed of 1 m/s; the current makes it through the motors.
    """
    rover = model.rover
    compiled = rover.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_kinematics(compiled, data)
    ahead, aside = ([float(data.body(w.body).xpos[k]) for w in rover.wheels] for k in (0, 1))
    radius = float(np.mean([w.radius for w in rover.wheels]))
    torque = rover.mass * model.gravity * radius
    base = max(max(ahead) - min(ahead), radius)
    motor = model.parameters.get("motor", {})
    factors = ("torque_constant", "gear_ratio", "gear_efficiency")
    per_ampere = float(np.prod([np.mean(motor.get(k, 1.0)) for k in factors]))
    return {
        "mass": rover.mass,
        "radius": radius,
        "wheelbase": base,
        "track": max(aside) - min(aside),
        "torque": torque,
        "damping": torque * radius / len(rover.wheels),
        "current": torque / per_ampere,
    }


def _of_rover(unknown: Unknown, size: Mapping[str, float]) -> Unknown:
    """An unknown in its own unit."""
    if not unknown.size:
        return unknown
    by = size[unknown.size]
    std = unknown.std if unknown.factor else unknown.std * by
    return dataclasses.replace(unknown, std=std, low=unknown.low * by, high=unknown.high * by, size="")


def data_sheet(model: Model, logs: Sequence[Log] = ()) -> tuple[Unknown, ...]:
    """What is open of a rover and its instruments before any log: `ROVER` and `SENSORS` in physical units.

    Args:
      model: its rover gives the sizes; a motor or gear that `convert` assumed is known badly.
      logs: state how well their IMU's mounting is known.
    """
    size = sizes(model)
    found = {u.key: _of_rover(u, size) for u in (*ROVER, *SENSORS)}
    assumed = [note for note in model.rover.assumed if note.startswith("drive")]
    spread = math.hypot(
        *(std for what, std in (("motor", ASSUMED_MOTOR), ("gear", ASSUMED_GEAR)) if any(what in n for n in assumed))
    )
    if spread:
        found["motor.torque_constant"] = dataclasses.replace(found["motor.torque_constant"], std=spread)
    for axis, key in enumerate((f"{CALIBRATION}.roll", f"{CALIBRATION}.pitch")):
        stated = [log.imu.mounting_std_deg[axis] for log in logs if log.imu.mounting_std_deg[axis] > 0.0]
        if stated:
            found[key] = dataclasses.replace(found[key], std=min(max(stated), found[key].high))
    return tuple(found.values())


def catalogue_of(model: Model) -> tuple[Suspect, ...]:
    """Everything that may be named of a rover, `SUSPECTS` in physical units."""
    size = sizes(model)
    return tuple(dataclasses.replace(s, unknowns=tuple(_of_rover(u, size) for u in s.unknowns)) for s in SUSPECTS)


def _told(unknown: Unknown, channels: Collection[str]) -> bool:
    """Whether one of the channels could show a calibration; parameters of the model always count."""
    if unknown.effect != CALIBRATION:
        return True
    need = next((c for start, c in MEASURED_BY.items() if unknown.name.startswith(start)), None)
    return need is None or any(c in channels for c in need)


def baseline(model: Model, channels: Collection[str] = CHANNELS, logs: Sequence[Log] = ()) -> tuple[Unknown, ...]:
    """The unknowns of a model that every hypothesis fits, with priors from the model's file where it states them.

    Args:
      model: as compared. channels: that are measured. logs: state how well instruments are mounted.
    """
    given = model.priors
    out = {}
    for unknown in data_sheet(model, logs):
        if _told(unknown, channels) and (unknown.effect == CALIBRATION or unknown.effect in model.effect_names):
            out[unknown.key] = with_prior(unknown, given)
    for suspect in catalogue_of(model):
        for unknown in suspect.unknowns:
            added = suspect.kind == "effect" and unknown.effect in model.effect_names
            if unknown.key not in out and (added or unknown.key in given) and _told(unknown, channels):
                out[unknown.key] = with_prior(unknown, given)
    fixed = {key for key, (_, std) in given.items() if std == 0.0}
    return tuple(q for q in out.values() if q.key not in fixed)


def suspects_of(model: Model, channels: Collection[str] = CHANNELS) -> tuple[Suspect, ...]:
    """What may be missing of a model or wrong in it: effects it has not, parameters of those it has, and sensors."""
    out = []
    for s in catalogue_of(model):
        has = s.unknowns[0].effect in model.effect_names
        replaced = s.name == "soft_ground" and "hard_surface" not in model.effect_names
        fits = {"effect": not has and not replaced, "parameter": has, "sensor": True}[s.kind]
        if fits and all(_told(u, channels) for u in s.unknowns):
            out.append(s)
    return tuple(out)


def with_prior(unknown: Unknown, given: Mapping[str, tuple[float, float]]) -> Unknown:
    """An unknown with the prior that the model's file states for it: its standard deviation, relative for factors."""
    found = given.get(unknown.key)
    if found is None:
        return unknown
    value, std = found
    if unknown.factor:
        # The standard deviation of a logarithm is the relative one, to first order.
        return dataclasses.replace(unknown, std=max(std / value, 1e-6))
    return dataclasses.replace(unknown, std=max(std, 1e-9))


def with_knowledge(model: Model, known: Mapping[str, tuple[float, float]]) -> Model:
    """A model with values and priors of its parameters and instruments.

    Args:
      model: as it is.
      known: value and standard deviation by key (`effect.parameter`, `calibration.name`), in the key's unit; 0 fixes.

    Raises:
      UserError: a key is none of this model, or a value lies outside what is plausible.
    """
    if not known:
        return model
    unknowns = {q.key: q for s in catalogue_of(model) for q in s.unknowns} | {q.key: q for q in data_sheet(model)}
    there = [k for k, q in unknowns.items() if q.effect == CALIBRATION or q.effect in model.effect_names]
    for key, (value, std) in known.items():
        if key not in there:
            raise bad_input(
                "lunar-mjx", "--prior or --fix", key, "is not fitted here", f"use one of {', '.join(there)}"
            )
        q = unknowns[key]
        if not q.low <= value <= q.high or not 0.0 <= std < math.inf:
            limits = f"between {q.low:g} and {q.high:g} {q.unit}".rstrip(" 1")
            raise bad_input("lunar-mjx", "--prior or --fix", f"{key}={value:g}", "is not plausible", f"give {limits}")
        if q.effect != CALIBRATION:
            old = model.parameters[q.effect][q.name]
            mean = float(np.mean(old))
            # What is known is the mean: wheels and joints keep their ratios.
            new = tuple(v * value / mean for v in old) if isinstance(old, tuple) and mean != 0.0 else value
            model = model.set(q.effect, "--prior or --fix", **{q.name: new})
    return dataclasses.replace(model, priors={**model.priors, **known})


def start_of(model: Model, unknown: Unknown) -> float:
    """The model's own value of an unknown; zero for calibration that nobody stated."""
    if unknown.effect == CALIBRATION:
        return model.priors.get(unknown.key, (0.0, 0.0))[0]
    value = model.parameters.get(unknown.effect, {}).get(unknown.name, 0.0)
    return float(np.mean(value))
