"""A single-wheel test bed in NumPy float64, written from the equations; hidden effects are functions at its stages.

Sources: Wong & Reece 1967 (stress under a rolling wheel), Janosi & Hanamoto 1961 (shear), Ding et al. 2011 (closed
form: stress linear between the entrance, the angle of maximum stress and the exit). Nothing of the tool is imported.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

STAGES = ("geometry", "soil", "normal", "shear", "wrench")
"""Where a hidden effect may act, in the order of the computation."""

Values = dict[str, Any]
Act = Callable[[Values], None]
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)


@dataclasses.dataclass(frozen=True)
class Soil:
    """Bekker-Wong and Mohr-Coulomb parameters: k_c N/m^(n+1), k_phi N/m^(n+2), n, cohesion Pa, friction angle rad,
    shear moduli m."""

    k_c: float = 1.4e3
    k_phi: float = 8.2e5
    n: float = 1.0
    cohesion: float = 170.0
    friction_angle: float = 0.6109
    modulus_x: float = 0.0178
    modulus_y: float = 0.0178


@dataclasses.dataclass(frozen=True, eq=False)
class Points:
    """What is imposed: slip ratio (wheel frame), slip angle rad, load N, all (n,); wheel radius and width m, gravity
    m/s2, travel speed m/s of the carriage."""

    slip: np.ndarray
    angle: np.ndarray
    load: np.ndarray
    radius: float
    width: float
    gravity: float = 9.80665
    speed: float = 0.05


@dataclasses.dataclass(frozen=True)
class Hidden:
    """A hidden effect: functions by stage, each changing the values of the stage in place."""

    name: str
    acts: Mapping[str, Act]


def measure(points: Points, soil: Soil, hidden: Sequence[Hidden] = (), law: str = "closed") -> dict[str, np.ndarray]:
    """Drawbar pull N, side force N (against a positive slip angle), driving torque N m and sinkage m at every point.

    The wheel sinks until the soil carries the load: bisection on the sinkage, all points together.

    Args:
      points: what is imposed. soil: true parameters. hidden: effects. law: "closed" or "integral".

    Returns:
      By quantity; `carried` tells where a sinkage below 1.2 radii carries the load.
    """
    low = np.full(len(points.slip), 1e-7)
    high = np.full(len(points.slip), 1.2 * points.radius)
    carried = _forces(points, soil, hidden, law, high)["vertical"] >= points.load
    # the smallest root: a scan first, then bisection within the first cell that carries the load
    grid = np.geomspace(1e-5, 1.2, 24)[:, None] * np.full_like(high, points.radius)
    enough = np.array([_forces(points, soil, hidden, law, z)["vertical"] >= points.load for z in grid])
    first = np.argmax(enough, axis=0)
    found = enough.any(axis=0)
    here = np.arange(len(high))
    high = np.where(found, grid[first, here], high)
    low = np.where(found & (first > 0), grid[np.maximum(first - 1, 0), here], low)
    for _ in range(42):
        middle = 0.5 * (low + high)
        over = _forces(points, soil, hidden, law, middle)["vertical"] >= points.load
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    z = 0.5 * (low + high)
    out = _forces(points, soil, hidden, law, z)
    return {
        "drawbar_pull_N": out["force_x"],
        "side_force_N": -out["force_y"],
        "driving_torque_Nm": out["torque"],
        "sinkage_m": z,
        "carried": found | carried,
    }


def _forces(points: Points, soil: Soil, hidden: Sequence[Hidden], law: str, z: np.ndarray) -> Values:
    one = np.ones_like(z)
    v: Values = {
        "z": z,
        "r": points.radius * one,
        "b": points.width * one,
        "beta": points.angle * one,
        "s": points.slip * one,
        "load": points.load * one,
        "gravity": points.gravity,
        "speed": points.speed * one,
    }

    def act(stage: str) -> None:
        for effect in hidden:
            if stage in effect.acts:
                effect.acts[stage](v)

    v["toe"] = 0.0 * one
    act("geometry")
    _kinematics(v)
    v |= {f: getattr(soil, f) * one for f in ("k_c", "k_phi", "n", "cohesion", "modulus_x", "modulus_y")}
    v["tan_phi"] = np.tan(soil.friction_angle) * one
    act("soil")
    v["theta_1"] = np.arccos(np.clip(1.0 - z / v["r"], -0.5, 1.0 - 1e-12))
    v["share_m"], v["share_2"] = 0.5 * one, 0.0 * one
    v |= {"grip": one, "lug": 0.0 * one, "circle": 0.0 * one, "pressure": one}
    act("normal")
    v["theta_m"], v["theta_2"] = v["share_m"] * v["theta_1"], -v["share_2"] * v["theta_1"]
    act("shear")
    (_closed if law == "closed" else _integral)(v)
    act("wrench")
    # The force sensor sits at the hub and turns with the wheel.
    v["force_x"], v["force_y"] = v["fx"], v["fy"]
    return v


def _kinematics(v: Values) -> None:
    """Slip of eq. 8 and lateral displacement (1 - s) tan(beta) per rolling, for the wheel's true heading and radius."""
    slip, angle = v["s"], v["beta"]
    rim = np.where(slip >= 0.0, 1.0, 1.0 + slip)
    along = np.where(slip >= 0.0, 1.0 - slip, 1.0)
    across = along * np.tan(angle)
    c, s = np.cos(v["toe"]), np.sin(v["toe"])
    v_x, v_y = along * c + across * s, across * c - along * s
    rim = rim * v.get("rim_factor", 1.0)
    fastest = np.maximum(rim, np.abs(v_x))
    v["slip"] = (rim - v_x) / fastest
    braking = rim <= v_x
    factor = np.where(braking, 2.0 - rim / np.where(np.abs(v_x) > 1e-9, v_x, 1.0), 1.0)
    v["lateral"] = v_y * factor / fastest
    v["slide_y"] = v_y / np.maximum(rim, np.hypot(v_x, v_y))
    v["v_x"], v["v_y"], v["rim"] = v_x, v_y, rim


def _mobilised(j: np.ndarray, modulus: np.ndarray) -> np.ndarray:
    return np.sign(j) * -np.expm1(-np.abs(j) / modulus)


def _shear(v: Values, strength: np.ndarray, j_x: np.ndarray, j_y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stress along and across after the displacements; `circle` shares one strength between the two."""
    k_x, k_y = v["modulus_x"], v["modulus_y"]
    if strength.ndim > k_x.ndim:
        k_x, k_y = k_x[..., None], k_y[..., None]
    circle = v["circle"] if strength.ndim == v["circle"].ndim else v["circle"][..., None]
    own_x, own_y = strength * _mobilised(j_x, k_x), strength * _mobilised(j_y, k_y)
    q_x, q_y = j_x / k_x, j_y / k_y
    q = np.hypot(q_x, q_y) + 1e-12
    common = strength * -np.expm1(-q) / q
    return own_x + circle * (common * q_x - own_x), own_y + circle * (common * q_y - own_y)


def _closed(v: Values) -> None:
    """Linear stress from theta_2 over theta_m to theta_1, shear stress at theta_m over the same shape."""
    r, b, t1, tm, t2 = v["r"], v["b"], v["theta_1"], v["theta_m"], v["theta_2"]
    depth = np.maximum(r * (np.cos(tm) - np.cos(t1)), 1e-12)
    sigma = (v["k_c"] / b + v["k_phi"]) * depth ** v["n"] * v["pressure"]
    rise, fall = tm - t2, t1 - tm
    # integrals of the triangular shape times cos, sin and one
    cos = (np.cos(tm) - np.cos(t2)) / rise + (np.cos(tm) - np.cos(t1)) / fall
    sin = (np.sin(tm) - np.sin(t2)) / rise - (np.sin(t1) - np.sin(tm)) / fall
    area = 0.5 * (t1 - t2)
    r_s = r + v["lug"]
    chord = np.sin(t1) - np.sin(tm)
    # Slip is that of the rim, and tips of grousers turn faster than it.
    j_x = r_s * (t1 - tm) - r * (1.0 - v["slip"]) * chord
    j_y = r * (t1 - tm) * v["lateral"]
    strength = (v["cohesion"] + sigma * v["tan_phi"]) * v["grip"]
    tau_x, tau_y = _shear(v, strength, j_x, j_y)
    v["sigma"], v["tau_x"], v["tau_y"] = sigma, tau_x, tau_y
    v["resistance"] = r * b * sigma * sin
    v["fx"] = r_s * b * tau_x * cos - v["resistance"]
    v["fy"] = -r * b * tau_y * area
    v["vertical"] = r * b * sigma * cos + r_s * b * tau_x * sin
    v["torque"] = r_s * r_s * b * tau_x * area


def _integral(v: Values) -> None:
    """The same by quadrature of the stress itself: 24 nodes before and behind the angle of maximum stress."""
    r, b = v["r"], v["b"]
    t1, tm, t2 = (v[k][..., None] for k in ("theta_1", "theta_m", "theta_2"))
    share = 0.5 * (1.0 + NODES)
    rear, front = t2 + (tm - t2) * share, tm + (t1 - tm) * share
    mirror = t1 - (rear - t2) / (tm - t2) * (t1 - tm)
    angle = np.concatenate([rear, front], axis=-1)
    seen = np.concatenate([mirror, front], axis=-1)
    weight = 0.5 * np.concatenate([WEIGHTS * (tm - t2), WEIGHTS * (t1 - tm)], axis=-1)
    depth = np.maximum(r[..., None] * (np.cos(seen) - np.cos(t1)), 1e-12)
    sigma = (v["k_c"] / b + v["k_phi"])[..., None] * depth ** v["n"][..., None] * v["pressure"][..., None]
    r_s = r + v["lug"]
    chord = np.sin(t1) - np.sin(angle)
    j_x = r_s[..., None] * (t1 - angle) - r[..., None] * (1.0 - v["slip"][..., None]) * chord
    j_y = r[..., None] * (t1 - angle) * v["lateral"][..., None]
    strength = (v["cohesion"][..., None] + sigma * v["tan_phi"][..., None]) * v["grip"][..., None]
    tau_x, tau_y = _shear(v, strength, j_x, j_y)

    def arc(stress: np.ndarray) -> np.ndarray:
        return np.sum(weight * stress, axis=-1)

    v["resistance"] = r * b * arc(sigma * np.sin(angle))
    v["fx"] = r_s * b * arc(tau_x * np.cos(angle)) - v["resistance"]
    v["fy"] = -r * b * arc(tau_y)
    v["vertical"] = r * b * arc(sigma * np.cos(angle)) + r_s * b * arc(tau_x * np.sin(angle))
    v["torque"] = r_s * r_s * b * arc(tau_x)
    v["tau_x"], v["tau_y"] = tau_x, tau_y
