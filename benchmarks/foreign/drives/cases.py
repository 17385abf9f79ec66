"""Campaigns of drives: what is hidden, how the rover was built, what was driven, and the logs that come of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..cases import generator
from ..laws import GRANULAR_HOLDS
from ..misfit import Field
from ..wheel import World
from .rollout import Ground, Motors, Setup
from .rovers import CORNERS, ROVERS, Build, Rover

SECONDS = 8.0
GROUPS: Mapping[str, float] = {"null": 0.25, "single": 0.55, "outside": 0.2}


@dataclasses.dataclass(frozen=True)
class DriveKind:
    """A kind of hidden effect on a rover.

    Attributes:
      draw: amounts. ports: where it acts. where: "world" (forces and motors), "build" or "sensor". rovers: that can
        have it.
    """

    draw: Callable[[np.random.Generator, Rover], dict[str, float]]
    ports: tuple[str, ...]
    where: str = "world"
    rovers: tuple[str, ...] = ("luvmi_x", "viper", "husky")


def _u(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _drive_torque(rover: Rover) -> float:
    """Torque of a drive motor at a drawbar of a tenth of the weight, N m."""
    return 0.1 * rover.mass * rover.gravity / 4.0 * rover.radius


def _patches(rng: np.random.Generator, rover: Rover) -> dict[str, float]:
    way = rover.speeds[2] * SECONDS
    found = {"width": _u(rng, 0.15, 0.3) * way}
    for i in range(3):
        found |= {f"a{i}": _sign(rng) * _u(rng, 0.4, 1.2), f"x{i}": _u(rng, 0.1, 0.9) * way}
    return found


_SUSPENDED = ("luvmi_x", "viper")

KNOWN: dict[str, DriveKind] = {
    "coulomb_friction": DriveKind(lambda r, v: {"torque": _u(r, 0.5, 1.5) * _drive_torque(v)}, ("motor_torque",)),
    "actuator_delay": DriveKind(lambda r, v: {"delay": _u(r, 0.04, 0.12)}, ("command",)),
    "slip_sinkage": DriveKind(lambda r, v: {"driving": _u(r, 0.6, 1.6), "skid": _u(r, 0.3, 0.8)}, ("soil",)),
    "com_offset": DriveKind(
        lambda r, v: {"x": _sign(r) * _u(r, 0.03, 0.08) * v.half_base, "y": _u(r, -0.08, 0.08) * v.half_track},
        ("geometry",),
        "build",
    ),
    "wheel_radius_error": DriveKind(lambda r, v: {"offset": _sign(r) * _u(r, 0.03, 0.08) * v.radius}, ("geometry",)),
    "imu_bias": DriveKind(
        lambda r, v: {
            "gyro": _sign(r) * _u(r, 0.005, 0.02),
            "accelerometer": _sign(r) * _u(r, 0.05, 0.2),
            "pitch": np.radians(_sign(r) * _u(r, 1.0, 3.0)),
        },
        ("sensor",),
        "sensor",
    ),
    "backlash": DriveKind(
        lambda r, v: {"half_gap": _u(r, 0.01, 0.04), "stiffness": 60.0 * v.drive_gain, "damping": 0.1 * v.drive_gain},
        ("command",),
    ),
    "stribeck_friction": DriveKind(
        lambda r, v: {"torque": _u(r, 0.8, 2.0) * _drive_torque(v), "speed": _u(r, 0.15, 0.5) * v.speeds[1] / v.radius},
        ("motor_torque",),
    ),
    "cold_grease": DriveKind(
        lambda r, v: {
            "viscosity": _u(r, 0.3, 0.8) * _drive_torque(v) / (v.speeds[2] / v.radius),
            "per_kelvin": _u(r, 0.015, 0.03),
            "ambient": _u(r, -60.0, -20.0),
        },
        ("motor_torque",),
    ),
    "cogging": DriveKind(
        lambda r, v: {
            "torque": _u(r, 0.3, 1.0) * _drive_torque(v),
            "poles": float(r.integers(4, 10)),
            "phase": _u(r, 0.0, 6.0),
        },
        ("motor_torque",),
    ),
    "voltage_saturation": DriveKind(
        lambda r, v: {"bus": _u(r, 0.65, 0.9) * v.gear * v.constant * v.speeds[2] / v.radius}, ("command",)
    ),
    "multipass": DriveKind(lambda r, v: {"plastic": _u(r, 0.5, 0.85), "harder": _u(r, 0.5, 1.5)}, ("soil",)),
    "soil_patches": DriveKind(_patches, ("soil",)),
    "channel_scale": DriveKind(
        lambda r, v: {"position": _sign(r) * _u(r, 0.03, 0.08), "current": _sign(r) * _u(r, 0.05, 0.12)},
        ("sensor",),
        "sensor",
    ),
    "clock_offset": DriveKind(lambda r, v: {"joint": _u(r, 0.04, 0.12)}, ("sensor",), "sensor"),
    "suspension_friction": DriveKind(
        lambda r, v: {"torque": _u(r, 0.05, 0.2) * v.mass * v.gravity / 4.0 * v.arm},
        ("body_wrench",),
        "world",
        _SUSPENDED,
    ),
    "steering_toe": DriveKind(
        lambda r, v: {c: np.radians(_sign(r) * _u(r, 1.0, 4.0)) for c in CORNERS}, ("geometry",), "world", _SUSPENDED
    ),
    "payload": DriveKind(
        lambda r, v: {
            "mass": _u(r, 0.08, 0.2) * v.mass,
            "x": _u(r, -0.3, 0.3) * v.half_base,
            "z": _u(r, 0.5, 1.0) * v.height,
        },
        ("geometry",),
        "build",
    ),
}
"""Effects by the catalogue's names."""

OUTSIDE: dict[str, DriveKind] = {
    "oil_churning": DriveKind(  # a gearbox that stirs its oil: torque with the square of the speed
        lambda r, v: {"torque": _u(r, 0.8, 2.0) * _drive_torque(v) / (v.speeds[2] / v.radius) ** 2}, ("motor_torque",)
    ),
    "spooling_cable": DriveKind(  # a cable behind the rover that is paid out against a growing pull
        lambda r, v: {"per_metre": _u(r, 0.03, 0.08) * v.mass * v.gravity}, ("body_wrench",)
    ),
    "eccentric_wheel": DriveKind(  # axles beside the centre of the rim
        lambda r, v: {"share": _u(r, 0.02, 0.06), "phase": _u(r, 0.0, 6.0)}, ("geometry",)
    ),
    "gyro_g_sensitivity": DriveKind(  # gyros that hear the specific force
        lambda r, v: {"per_m_s2": _sign(r) * _u(r, 0.01, 0.04)}, ("sensor",), "sensor"
    ),
}
"""Effects that no catalogue has."""

TUNE_KNOWN = ("coulomb_friction", "actuator_delay", "slip_sinkage", "com_offset", "wheel_radius_error", "imu_bias")
TUNE_OUTSIDE = ("oil_churning",)
REPORT_KNOWN = tuple(KNOWN)
REPORT_OUTSIDE = tuple(k for k in OUTSIDE if k not in TUNE_OUTSIDE)

STD = {
    "position": 0.005,
    "velocity": 0.005,
    "angle": 0.1,
    "gyro": 0.002,
    "accelerometer": 0.02,
    "drive_angle": 0.001,
    "drive_speed": 0.005,
    "steer_angle": 0.001,
    "sus_angle": 0.001,
    "current": 0.01,
    "voltage": 0.05,
    "winding": 0.3,
    "housing": 0.3,
    "sinkage": 0.002,
    "slip": 0.02,
}
"""Noise of one sample by quantity, SI units and degrees of attitude; currents of larger motors have more."""


@dataclasses.dataclass(frozen=True)
class Campaign:
    """A sealed campaign of drives: as `cases.Case`, of a rover."""

    name: str
    group: str
    rover: Rover
    world: World
    setups: tuple[Setup, ...]
    slopes_deg: tuple[float, ...]
    hidden: tuple[str, ...]
    amounts: Mapping[str, Mapping[str, float]]
    ports: tuple[str, ...]
    holds: tuple[str, ...]
    std: Mapping[str, float]
    stated: Mapping[str, float]
    noise: str
    memory: float
    imu: Mapping[str, Any]
    seed: int


def plan(which: str, count: int, rovers: Sequence[str] = tuple(ROVERS)) -> list[tuple[str, tuple[str, ...], str]]:
    """Group, hidden names and rover (of `rovers`) of every campaign of a set."""
    known, outside = (TUNE_KNOWN, TUNE_OUTSIDE) if which == "tune" else (REPORT_KNOWN, REPORT_OUTSIDE)
    pools = {"null": [()], "single": [(k,) for k in known], "outside": [(k,) for k in outside]}
    found = []
    for group, share in GROUPS.items():
        number = round(share * count)
        for n in range(number):
            hidden = pools[group][n % len(pools[group])]
            allowed = [r for r in rovers if all(r in (KNOWN.get(k) or OUTSIDE[k]).rovers for k in hidden)]
            # Every third turn through the kinds another rover.
            rover = allowed[(n + n // max(len(pools[group]), 1)) % len(allowed)]
            found.append(((n + 0.5) / number, group, hidden, rover))
    return [(g, h, r) for _, g, h, r in sorted(found, key=lambda f: (f[0], f[1]))]


def _ramp(values: list[tuple[float, np.ndarray, np.ndarray]]) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """Commands that go straight from one (time, speeds, angles) to the next and stay at the last."""
    times = np.array([v[0] for v in values])
    speeds, angles = np.array([v[1] for v in values]), np.array([v[2] for v in values])

    def command(t: float) -> tuple[np.ndarray, np.ndarray]:
        # As a log holds it: commands change twenty times a second.
        t = np.floor(t * 20.0 + 1e-6) / 20.0
        mix = [np.array([np.interp(t, times, table[:, i]) for i in range(4)]) for table in (speeds, angles)]
        return mix[0], mix[1]

    return command


def _commands(rover: Rover) -> dict[str, Callable[[float], tuple[np.ndarray, np.ndarray]]]:
    """What is driven, by name."""
    slow, middle, fast = (s / rover.radius for s in rover.speeds)
    one, zero = np.ones(4), np.zeros(4)
    stairs = [(0.0, zero, zero), (1.0, zero, zero)]
    for at, speed in ((1.5, slow), (3.0, middle), (4.5, fast), (6.0, -middle)):
        stairs += [(at, speed * one, zero), (at + 1.0, speed * one, zero)]
    edges = [(0.0, zero, zero), (1.0, zero, zero)]
    for k in range(6):
        speed = (middle if k < 4 else fast) * (-1.0) ** k
        edges += [(1.05 + k, speed * one, zero), (2.0 + k, speed * one, zero)]
    axles = np.array([1.3, 1.3, 0.7, 0.7]) if rover.steered else np.array([1.2, 0.8, 1.2, 0.8])
    sweep = [
        (0.0, zero, zero),
        (1.0, zero, zero),
        (1.5, middle * one, zero),
        (3.0, middle * one, zero),
        (3.5, middle * axles, zero),
        (5.0, middle * axles, zero),
        (5.5, middle * axles[::-1], zero),
    ]
    if rover.steered:
        left = 0.3 * np.array([1.0, 1.0, -1.0, -1.0])
        crab = 0.3 * one
        arc = [
            (0.0, zero, zero),
            (1.0, zero, zero),
            (2.0, middle * one, left),
            (4.5, middle * one, left),
            (5.5, middle * one, crab),
            (8.0, middle * one, crab),
        ]
    else:
        left, right = np.array([0.6, 1.4, 0.6, 1.4]), np.array([1.4, 0.6, 1.4, 0.6])
        arc = [
            (0.0, zero, zero),
            (1.0, zero, zero),
            (2.0, middle * left, zero),
            (4.5, middle * left, zero),
            (5.5, middle * right, zero),
            (8.0, middle * right, zero),
        ]
    climb = [
        (0.0, zero, zero),
        (1.0, zero, zero),
        (1.5, middle * one, zero),
        (4.5, middle * one, zero),
        (5.0, zero, zero),
        (5.5, -slow * one, zero),
    ]
    return {
        "staircase": _ramp(stairs),
        "edges": _ramp(edges),
        "sweep": _ramp(sweep),
        "arc": _ramp(arc),
        "climb": _ramp(climb),
    }


SLOPE_DEG = 6.0
SPLITS = {"staircase": "fit", "edges": "fit", "sweep": "fit", "arc": "fit", "climb": "select"}


def draw(which: str, seed: int, number: int, group: str, hidden: tuple[str, ...], rover_name: str) -> Campaign:
    """A campaign of five drives of eight seconds.

    Args:
      which: "tune" or "report". seed: of the set. number: of the campaign. group, hidden: what it is about.
      rover_name: of `ROVERS`.
    """
    rng = generator(seed, which, "drive", number)
    rover = ROVERS[rover_name]
    kinds = {k: KNOWN.get(k) or OUTSIDE[k] for k in hidden}
    amounts = {k: kind.draw(rng, rover) for k, kind in kinds.items()}
    laws = ("linear", "integral") if which == "tune" else ("linear", "integral", "granular")
    law = str(rng.choice(laws))
    if "slip_sinkage" in hidden and law == "granular":
        law = "integral"
    load = rover.mass * rover.gravity / 4.0
    pressure, depth = load / (0.5 * rover.width * rover.radius), _u(rng, 0.04, 0.08) * rover.radius
    if law == "granular":
        stiffness = pressure / (0.6 * depth) * 9.80665 / rover.gravity
        soil = {"grain_stiffness": stiffness, "rim_friction": _u(rng, 0.45, 0.7)}
        holds = list(GRANULAR_HOLDS)
        traits: dict[str, float] = {}
    else:
        exponent, cohesion, share = _u(rng, 0.7, 1.1), _u(rng, 100.0, 600.0), _u(rng, 0.0, 0.3)
        ratio = (depth / rover.width) ** exponent
        soil = {
            "exponent": exponent,
            "cohesion": cohesion,
            "unit_weight": 1600.0 * rover.gravity,
            "reece_c": share * pressure / cohesion / ratio,
            "reece_phi": (1.0 - share) * pressure / (1600.0 * rover.gravity * rover.width) / ratio,
            "friction_angle": float(np.radians(_u(rng, 29.0, 38.0))),
            "shear_x": _u(rng, 0.06, 0.2) * rover.radius,
            "shear_y": _u(rng, 0.08, 0.25) * rover.radius,
        }
        holds, traits = (["stress_integral"] if law == "integral" else []) + ["skid_shear"], {}
        if rng.random() < 0.35:
            traits = {"c1": _u(rng, 0.38, 0.5), "c3": _u(rng, 0.0, 0.3)}
            holds.append("exit_angle")
    # As built: a few per cent of mass and inertia, the centre of mass by millimetres; the IMU a little askew.
    holds += ["com_offset", "payload", "gravity_error", "imu_bias", "directional_gear_efficiency", "coulomb_friction"]
    fields = tuple(Field.draw(rng, _u(rng, 0.02, 0.08), 4) for _ in range(3))
    effects = {k: v for k, v in amounts.items() if kinds[k].where == "world"}
    world = World(law, rover.radius, rover.width, soil, traits, fields, load, effects)  # type: ignore[arg-type]
    shift = [_u(rng, -0.008, 0.008) * rover.half_base, _u(rng, -0.008, 0.008) * rover.half_track, 0.0]
    if "com_offset" in amounts:
        shift = [shift[0] + amounts["com_offset"]["x"], shift[1] + amounts["com_offset"]["y"], 0.0]
    load_at = amounts.get("payload")
    build = Build(
        mass=_u(rng, 0.985, 1.015),
        inertia=_other_inertia(rng, rover.chassis_inertia),
        com=tuple(shift),  # type: ignore[arg-type]
        payload=load_at["mass"] if load_at else 0.0,
        payload_at=(load_at["x"], 0.0, load_at["z"]) if load_at else (0, 0, 0),
        rotor_share=0.02 if "backlash" in hidden else 1.0,
    )
    middle_current = _drive_torque(rover) / (rover.gear * rover.constant * rover.efficiency)
    motors = Motors(
        _u(rng, 0.97, 1.03), _u(rng, 0.95, 1.05), _u(rng, 0.97, 1.03), _u(rng, 0.0, 0.06), 0.5 * middle_current
    )
    damping = _u(rng, 5e4, 1.2e5)
    setups, slopes = [], []
    for name, command in _commands(rover).items():
        slope = SLOPE_DEG if name == "climb" else 0.0
        setups.append(Setup(build, motors, _ground(rng, rover, np.radians(slope)), command, {}, damping))
        slopes.append(slope)
    noise = str(rng.choice(["gaussian", "ar1", "student"]))
    std = dict(STD)
    std["current"] = max(0.01, 0.02 * middle_current)
    imu = {
        "gyro": rng.normal(0.0, 5e-4, 3),
        "accelerometer": rng.normal(0.0, 0.008, 3),
        "tilt": rng.normal(0.0, np.radians(0.3), 2),
    }
    return Campaign(
        f"{which}-drive-{number:03d}",
        group,
        rover,
        world,
        tuple(setups),
        tuple(slopes),
        hidden,
        amounts,
        tuple(dict.fromkeys(p for k in kinds.values() for p in k.ports)),
        tuple(h for h in holds if h not in hidden),
        std,
        {q: s * _u(rng, 0.8, 1.2) for q, s in std.items()},
        noise,
        _u(rng, 0.3, 0.7) if noise == "ar1" else 0.0,
        imu,
        seed,
    )


def _other_inertia(rng: np.random.Generator, inertia: tuple[float, float, float]) -> tuple[float, float, float]:
    """Factors of the principal inertias of a chassis whose mass spreads by 15 % more or less along each axis.

    Inertias drawn by themselves may belong to no body: each is at most the sum of the other two.
    """
    whole = 0.5 * sum(inertia)
    spread = [(whole - i) * _u(rng, 0.85, 1.15) for i in inertia]
    a, b, c = ((sum(spread) - s) / i for s, i in zip(spread, inertia, strict=True))
    return a, b, c


def _ground(rng: np.random.Generator, rover: Rover, slope: float) -> Ground:
    """Waves of 0.8 to 6 wheel radii on no map, 2 cm between the highest and the lowest for wheels of 0.1 m and more."""
    count = 8
    length = rover.radius * np.exp(rng.uniform(np.log(4.0), np.log(25.0), count))
    heading = rng.uniform(0.0, 2.0 * np.pi, count)
    waves = 2.0 * np.pi / length[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    sizes = np.abs(rng.normal(size=count)) * length
    sizes *= 0.01 / np.sqrt(np.sum(sizes**2)) * min(1.0, rover.radius / 0.15)
    return Ground(slope, waves, sizes, rng.uniform(0.0, 2.0 * np.pi, count))


def _euler(q: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw in degrees of quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(np.stack([roll, pitch, np.unwrap(yaw, axis=-1)], axis=-1))


def channels(case: Campaign, found: Mapping[str, np.ndarray], sensors: bool = True) -> dict[str, dict[str, np.ndarray]]:
    """Readings without noise of all rollouts, by table and channel, (rollout, sample); `sensors`: with hidden ones."""
    hidden = case.amounts if sensors else {}
    scale = hidden.get("channel_scale", {})
    gyro, force = found["gyro"], found["accelerometer"]
    tilt = case.imu["tilt"] + np.array([0.0, hidden.get("imu_bias", {}).get("pitch", 0.0)])
    turn = _tilt(*tilt)
    gyro = gyro @ turn + case.imu["gyro"] + hidden.get("imu_bias", {}).get("gyro", 0.0)
    if e := hidden.get("gyro_g_sensitivity"):
        gyro = gyro + e["per_m_s2"] * force
    force = force @ turn + case.imu["accelerometer"] + hidden.get("imu_bias", {}).get("accelerometer", 0.0)
    start = found["position"][:, :1]
    position = start + (found["position"] - start) * (1.0 + scale.get("position", 0.0))
    angles = _euler(found["quaternion"])
    drive: dict[str, np.ndarray] = {}
    for i, axis in enumerate("xyz"):
        drive[f"position_{axis}_m"] = position[..., i]
        drive[f"world_velocity_{axis}_m_s"] = found["velocity"][..., i]
    for i, name in enumerate(("roll_deg", "pitch_deg", "yaw_deg")):
        drive[name] = angles[..., i]
    late = hidden.get("clock_offset", {}).get("joint", 0.0)
    joints = {
        k: _late(found["time"], found[k], late)
        for k in ("drive_angle", "drive_speed", "steer_angle", "sus_angle")
        if k in found
    }
    current = found["current"] * (1.0 + scale.get("current", 0.0))
    for i, c in enumerate(CORNERS):
        drive[f"joint_{c}_drive_angle_rad"] = joints["drive_angle"][..., i]
        drive[f"joint_{c}_drive_speed_rad_s"] = joints["drive_speed"][..., i]
        for kind in ("steer", "sus"):
            if f"{kind}_angle" in joints:
                drive[f"joint_{c}_{kind}_angle_rad"] = joints[f"{kind}_angle"][..., i]
        if not case.rover.sides:
            drive[f"motor_{c}_drive_current_A"] = current[..., i]
            drive[f"motor_{c}_drive_voltage_V"] = found["voltage"][..., i]
    if case.rover.sides:
        for side, (a, b) in {"left": (0, 2), "right": (1, 3)}.items():
            drive[f"motor_{side}_drive_current_A"] = current[..., a] + current[..., b]
    imu = {f"gyro_{a}_rad_s": gyro[..., i] for i, a in enumerate("xyz")}
    imu |= {f"accelerometer_{a}_m_s2": force[..., i] for i, a in enumerate("xyz")}
    camera = {f"wheel_{c}_sinkage_m": found["sinkage"][..., i] for i, c in enumerate(CORNERS)}
    thermal = {}
    if not case.rover.sides:
        thermal = {
            f"{part}_{c}_drive_temperature_degC": found[part][..., i]
            for part in ("winding", "housing")
            for i, c in enumerate(CORNERS)
        }
    tables = {"drive": drive, "imu": imu, "camera": camera} | ({"thermal": thermal} if thermal else {})
    return {t: {c: v[:, :: EVERY[t]] for c, v in table.items()} for t, table in tables.items()}


EVERY = {"drive": 5, "imu": 2, "camera": 20, "thermal": 100}
"""Kept samples (every 10 ms) from one row of a table to the next."""
RATES = {t: 100.0 / n for t, n in EVERY.items()}


def _tilt(roll: float, pitch: float) -> np.ndarray:
    """R of an IMU mounted askew; readings are R^T f, written for row vectors f @ R."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def _late(time: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Readings stamped late by `delay` (s)."""
    if not delay:
        return values
    found = np.empty_like(values)
    for k in range(values.shape[0]):
        for i in range(values.shape[2]):
            found[k, :, i] = np.interp(time[k] - delay, time[k], values[k, :, i])
    return found


_QUANTITY = {
    "position": "position",
    "world": "velocity",
    "roll": "angle",
    "pitch": "angle",
    "yaw": "angle",
    "gyro": "gyro",
    "accelerometer": "accelerometer",
    "winding": "winding",
    "housing": "housing",
}


def quantity(channel: str) -> str:
    """The key of `STD` of a channel."""
    head = channel.split("_")[0]
    if head in _QUANTITY:
        return _QUANTITY[head]
    for part in ("drive_angle", "drive_speed", "steer_angle", "sus_angle", "current", "voltage", "sinkage", "slip"):
        if part in channel:
            return part
    raise KeyError(channel)


def write(case: Campaign, found: Mapping[str, np.ndarray], folder: Path) -> None:
    """Writes the logs of a campaign, one folder for each drive."""
    names = list(SPLITS)
    tables = channels(case, found)
    for k, setup in enumerate(case.setups):
        log = folder / names[k]
        log.mkdir(parents=True, exist_ok=True)
        rng = generator(case.seed, case.name, "noise", k)
        for table, columns in tables.items():
            time = found["time"][k, :: EVERY[table]]
            head, data = ["time_s"], [time]
            if table == "drive":
                commands = [setup.command(max(float(t) + 1e-4, 0.0)) for t in time]
                head, data = _command_columns(case.rover, commands, head, data)
            for channel, values in columns.items():
                head.append(channel)
                data.append(values[k] + _noise(rng, case, len(time)) * case.std[quantity(channel)])
            rows = "\n".join(",".join(f"{v:.9g}" for v in row) for row in np.stack(data, axis=1))
            (log / f"{table}.csv").write_text(",".join(head) + "\n" + rows + "\n", encoding="utf-8")
        _write_toml(case, tables, log, names[k], case.slopes_deg[k], found["position"][k, 0])


def _command_columns(
    rover: Rover, commands: list[tuple[np.ndarray, np.ndarray]], head: list[str], data: list[np.ndarray]
) -> tuple[list[str], list[np.ndarray]]:
    speeds, angles = np.array([c[0] for c in commands]), np.array([c[1] for c in commands])
    if rover.sides:
        return [*head, "command_left_drive_speed_rad_s", "command_right_drive_speed_rad_s"], [
            *data,
            speeds[:, 0],
            speeds[:, 1],
        ]
    head = (
        head + [f"command_{c}_drive_speed_rad_s" for c in CORNERS] + [f"command_{c}_steer_angle_rad" for c in CORNERS]
    )
    head += [f"command_{c}_sus_angle_rad" for c in CORNERS]
    return head, [*data, *speeds.T, *angles.T, *(np.zeros(len(speeds)) for _ in CORNERS)]


def _noise(rng: np.random.Generator, case: Campaign, count: int) -> np.ndarray:
    if case.noise == "student":
        return rng.standard_t(4.0, count) / np.sqrt(2.0)
    white = rng.normal(size=count)
    for i in range(1, count if case.memory else 0):
        white[i] = case.memory * white[i - 1] + np.sqrt(1.0 - case.memory**2) * white[i]
    return white


def _write_toml(
    case: Campaign,
    tables: Mapping[str, Mapping[str, np.ndarray]],
    log: Path,
    name: str,
    slope: float,
    start: np.ndarray,
) -> None:
    lines = [
        'format = "lunar-mjx-log/1"',
        f'rover = "{case.rover.name}"',
        f'manoeuvre = "foreign_{name}"',
        f"gravity_m_s2 = {case.rover.gravity:.6g}",
        f'terrain = "{f"slope:{slope:g}deg" if slope else "flat"}"',
        f'split = "{SPLITS[name]}"',
    ]
    if e := case.world.has("cold_grease"):
        lines += ["", "[environment]", f"ambient_temperature_degC = {e['ambient']:.4g}"]
    # Where the rover stood was surveyed to the millimetre in the plane, its height by the wheels on the ground.
    lines += ["", "[initial]", f"position_m = [{start[0]:.4f}, {start[1]:.4f}, {start[2]:.4f}]"]
    for table in tables:
        lines += ["", f"[tables.{table}]", f'file = "{table}.csv"', f"rate_hz = {RATES[table]:g}"]
    for columns in tables.values():
        for channel in columns:
            lines += ["", f"[noise.{channel}]", f"std = {case.stated[quantity(channel)]:.6g}", 'source = "datasheet"']
    lines += ["", "[source]", 'who = "benchmarks.foreign"', 'licence = "CC0-1.0"', 'citation = ""']
    (log / "log.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def summary(case: Campaign) -> dict[str, Any]:
    """The sealed truth as numbers, names and lists."""
    first = case.setups[0]
    return {
        "case": case.name,
        "kind": "drive",
        "group": case.group,
        "hidden": list(case.hidden),
        "ports": list(case.ports),
        "holds": list(case.holds),
        "amounts": {k: dict(v) for k, v in case.amounts.items()},
        "rover": case.rover.name,
        "law": case.world.law,
        "soil": dict(case.world.soil),
        "traits": dict(case.world.traits),
        "misfit_rms": [float(np.sqrt(np.sum(f.weights**2) / 2.0)) for f in case.world.fields or ()],
        "build": dataclasses.asdict(first.build),
        "motors": dataclasses.asdict(first.motors),
        "damping": first.damping,
        "roughness_m": [float(np.sqrt(np.sum(s.ground.sizes**2) / 2.0)) for s in case.setups],
        "imu": {k: np.asarray(v).tolist() for k, v in case.imu.items()},
        "noise": {"kind": case.noise, "std": dict(case.std), "stated": dict(case.stated), "memory": case.memory},
    }
