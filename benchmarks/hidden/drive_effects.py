"""Hidden effects of drives: hooks of the NumPy reference, and what instruments do to the channels; from the equations.

Effects act on the drive motors or on all wheels alike. Parameters bear the names and units that the catalogue uses, so
that fitted values compare.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.backends import Hook

Rng = np.random.Generator
Numbers = dict[str, float]
Frame = pd.DataFrame


@dataclasses.dataclass(frozen=True)
class DriveKind:
    """A kind of hidden effect.

    Attributes:
      draw: parameters. hook: the hook at given parameters and mask (joint,) of the drive motors; None for sensors.
      sensor: changes the clean channels of one log instead. ports: where it acts; any of them is right.
    """

    draw: Callable[[Rng], Numbers]
    ports: tuple[str, ...]
    hook: Callable[[Numbers, np.ndarray], Hook] | None = None
    sensor: Callable[[Frame, Numbers], Frame] | None = None


def _torque(name: str, loss: Callable[[Any, Numbers], np.ndarray]) -> Callable[[Numbers, np.ndarray], Hook]:
    """A torque against the motion of the drive joints."""

    def make(p: Numbers, drive: np.ndarray) -> Hook:
        return Hook(name, {"torque": lambda ctx, state, torque: torque - drive * loss(ctx, p)})

    return make


def _slip_sinkage(p: Numbers, drive: np.ndarray) -> Hook:
    def soil(ctx: Any, state: dict[str, Any], value: dict[str, np.ndarray]) -> None:
        s, r = ctx.contact["soil_slip"], ctx.geometry["radius"]
        more = p["driving"] * np.maximum(s, 0.0) + p["skid"] * np.maximum(-s, 0.0)
        for key in ("k_c", "k_phi"):
            value[key] = value[key] * r**-more
        value["n"] = value["n"] + more

    return Hook("slip_sinkage", {"soil": soil})


def _rolling_resistance(p: Numbers, drive: np.ndarray) -> Hook:
    def shear(ctx: Any, state: dict[str, Any], value: dict[str, np.ndarray]) -> None:
        way = np.tanh(ctx.contact["rim_speed"] / 0.01)
        up = np.maximum(value["force"][..., 2], 0.0)
        value["moment"][..., 1] -= p["coefficient"] * ctx.geometry["radius"] * up * way

    return Hook("rolling_resistance", {"shear": shear})


def _geometry(name: str, key: str, change: Callable[[np.ndarray, Numbers], np.ndarray]) -> Callable[..., Hook]:
    def make(p: Numbers, drive: np.ndarray) -> Hook:
        def geometry(ctx: Any, state: dict[str, Any], value: dict[str, np.ndarray]) -> None:
            value[key] = change(value[key], p)

        return Hook(name, {"geometry": geometry})

    return make


def _delay(p: Numbers, drive: np.ndarray) -> Hook:
    def command(ctx: Any, state: dict[str, Any], target: np.ndarray) -> np.ndarray:
        line = state.setdefault("line", [])
        line.append(target.copy())
        steps = round(p["delay"] / ctx.dt)
        del line[: -steps - 1]
        return line[0]

    return Hook("actuator_delay", {"command": command})


def _heat(name: str, node: str, power: Callable[[Any, Numbers], np.ndarray]) -> Callable[[Numbers, np.ndarray], Hook]:
    def make(p: Numbers, drive: np.ndarray) -> Hook:
        def heat(ctx: Any, state: dict[str, Any], value: dict[str, np.ndarray]) -> None:
            value[node] = value[node] + drive * power(ctx, p)

        return Hook(name, {"heat": heat})

    return make


def _iron_loss(p: Numbers, drive: np.ndarray) -> Hook:
    def heat(ctx: Any, state: dict[str, Any], value: dict[str, np.ndarray]) -> None:
        gear = ctx.numbers.effects["motor"].gear_ratio
        value["winding"] = value["winding"] + drive * p["coefficient"] * (gear * ctx.joint_speed) ** 2

    def torque(ctx: Any, state: dict[str, Any], value: np.ndarray) -> np.ndarray:
        gear = ctx.numbers.effects["motor"].gear_ratio
        return value - drive * p["coefficient"] * gear**2 * ctx.joint_speed

    return Hook("iron_loss", {"heat": heat, "torque": torque})


def _harness(frame: Frame, p: Numbers) -> Frame:
    changed = {
        c: frame[c] + p["resistance"] * frame[c.replace("voltage_V", "current_A")]
        for c in frame
        if c.startswith("motor_") and c.endswith("voltage_V")
    }
    return frame.assign(**changed)


def _thermistor(frame: Frame, p: Numbers) -> Frame:
    changed = {}
    for c in (c for c in frame if c.endswith("temperature_degC")):
        lag = p["winding"] if c.startswith("winding") else p["housing"]
        values, time = frame[c].to_numpy(), frame["time_s"].to_numpy()
        seen = values.copy()
        for i in range(1, len(values)):
            share = -np.expm1(-(time[i] - time[i - 1]) / lag)
            seen[i] = seen[i - 1] + share * (0.5 * (values[i] + values[i - 1]) - seen[i - 1])
        changed[c] = seen
    return frame.assign(**changed)


def _late(frame: Frame, p: Numbers) -> Frame:
    time = frame["time_s"].to_numpy()
    attitude = ("roll_deg", "pitch_deg", "yaw_deg")
    moved = [c for c in frame if c.startswith(("position", "world_velocity")) or c in attitude]
    return frame.assign(**{c: np.interp(time - p["odometry"], time, frame[c]) for c in moved})


def _one(name: str, low: float, high: float) -> Callable[[Rng], Numbers]:
    return lambda g: {name: float(g.uniform(low, high))}


def _signed(name: str, low: float, high: float) -> Callable[[Rng], Numbers]:
    return lambda g: {name: float(g.choice([-1.0, 1.0]) * g.uniform(low, high))}


KNOWN: Mapping[str, DriveKind] = {
    "coulomb_friction": DriveKind(
        _one("torque", 0.2, 0.8),
        ("motor_torque",),
        _torque("coulomb_friction", lambda ctx, p: p["torque"] * np.tanh(ctx.joint_speed / 0.02)),
    ),
    "slip_sinkage": DriveKind(
        lambda g: {"driving": float(g.uniform(0.5, 1.5)), "skid": float(g.uniform(0.3, 0.8))}, ("soil",), _slip_sinkage
    ),
    "iron_loss": DriveKind(_one("coefficient", 5e-7, 2e-6), ("heat", "motor_torque"), _iron_loss),
    # in whole steps of the generator, which delays by whole steps
    "actuator_delay": DriveKind(lambda g: {"delay": round(float(g.uniform(0.03, 0.12)), 3)}, ("command",), _delay),
    "rolling_resistance": DriveKind(_one("coefficient", 0.03, 0.08), ("wheel_shear",), _rolling_resistance),
    "wheel_radius_error": DriveKind(
        _signed("offset", 0.002, 0.006),
        ("geometry",),
        _geometry("wheel_radius_error", "radius", lambda r, p: r + p["offset"]),
    ),
    "steering_toe": DriveKind(
        _signed("angle", 0.01, 0.04), ("geometry",), _geometry("steering_toe", "toe", lambda t, p: t + p["angle"])
    ),
    "com_offset": DriveKind(
        lambda g: {"x": float(g.choice([-1.0, 1.0]) * g.uniform(0.03, 0.08))},
        ("geometry",),
        _geometry("com_offset", "com_offset", lambda v, p: v + np.array([p["x"], 0.0, 0.0])),
    ),
    "harness_resistance": DriveKind(_one("resistance", 0.2, 0.6), ("sensor",), sensor=_harness),
    "thermistor_lag": DriveKind(
        lambda g: {"winding": float(g.uniform(3.0, 8.0)), "housing": float(g.uniform(10.0, 30.0))},
        ("sensor",),
        sensor=_thermistor,
    ),
    "clock_offset": DriveKind(_one("odometry", 0.06, 0.2), ("sensor",), sensor=_late),
}
"""Effects of the catalogue that short drives can show."""

OUTSIDE: Mapping[str, DriveKind] = {
    "churning": DriveKind(
        _one("amount", 0.05, 0.15),
        ("motor_torque",),
        _torque("churning", lambda ctx, p: p["amount"] * ctx.joint_speed * np.abs(ctx.joint_speed)),
    ),
    "commutator_heat": DriveKind(
        _one("amount", 0.5, 1.5),
        ("heat",),
        _heat("commutator_heat", "winding", lambda ctx, p: p["amount"] * np.abs(ctx.current)),
    ),
    "electronics_heat": DriveKind(
        _one("amount", 0.3, 1.0),
        ("heat",),
        _heat("electronics_heat", "housing", lambda ctx, p: p["amount"] + 0.0 * ctx.joint_speed),
    ),
    "tail_push": DriveKind(
        _one("amount", 4.0, 10.0),
        ("body_wrench",),
        lambda p, drive: Hook(
            "tail_push",
            {"body": lambda ctx, state, value: {**value, "force": value["force"] - p["amount"] * ctx.rotation[..., 0]}},
        ),
    ),
    "weak_amplifier": DriveKind(
        _one("amount", 0.04, 0.12),
        ("command", "motor_torque"),
        lambda p, drive: Hook(
            "weak_amplifier", {"current": lambda ctx, state, value: value * (1.0 - p["amount"] * drive)}
        ),
    ),
}
"""Effects that the catalogue lacks."""
