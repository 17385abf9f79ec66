"""Stresses under a wheel by three laws from the literature: linearised, integrated, and granular resistive force.

Every law answers at nodes along the rim with a pressure and the shear stress that the soil exerts on the wheel, forward
along the rim and to the left. Angles are measured from straight down, positive toward the front.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

Values = Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Rim:
    """Nodes along the contact and how the wheel moves there; arrays are (row, node) or (row, 1).

    Attributes:
      radius: m. entry, lowest, leave: angles at which contact begins, is pressed most, and ends, rad.
      theta: of the nodes. weight: of the quadrature over theta.
      turn: v_x/(r omega), travel per rolling. aside: v_y/(r omega).
      slip: ratio, driving positive. speed: rim speed, m/s. angle: slip angle, rad. roll: 1, less where a rover's wheel
        hardly turns and `turn` and `aside` are held finite. press: speed of sinking over the rim speed.
    """

    radius: np.ndarray
    entry: np.ndarray
    lowest: np.ndarray
    leave: np.ndarray
    theta: np.ndarray
    weight: np.ndarray
    turn: np.ndarray
    aside: np.ndarray
    slip: np.ndarray
    speed: np.ndarray
    angle: np.ndarray
    roll: np.ndarray | float = 1.0
    press: float = 0.0

    @property
    def mirrored(self) -> np.ndarray:
        """The angle in front that is pressed as much as each node (Wong & Reece 1967)."""
        behind = self.entry - (self.theta - self.leave) / (self.lowest - self.leave) * (self.entry - self.lowest)
        return np.where(self.theta >= self.lowest, self.theta, behind)

    @property
    def depth(self) -> np.ndarray:
        """Depth whose pressure each node has, m."""
        return np.maximum(self.radius * (np.cos(self.mirrored) - np.cos(self.entry)), 0.0)

    def ways(self, shear_radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Shear displacement of the soil, m, backward along the rim and across (Janosi & Hanamoto 1961)."""
        travelled = self.turn / shear_radius * (np.sin(self.entry) - np.sin(self.theta))
        along = self.roll * (self.entry - self.theta) - travelled
        return self.radius * shear_radius * along, self.radius * self.aside * (self.entry - self.theta)


def strength(pressure: np.ndarray, soil: Values, cohesion: np.ndarray | float) -> np.ndarray:
    """Shear strength: Mohr-Coulomb, or an envelope that bends down beyond its reference pressure, Pa."""
    bend = soil.get("envelope", 1.0)
    reference = soil.get("envelope_pressure", 1.0)
    friction = np.tan(soil["friction_angle"]) * pressure
    if bend != 1.0:
        friction = np.tan(soil["friction_angle"]) * reference * (np.maximum(pressure, 1e-9) / reference) ** bend
    return cohesion + friction


def mobilised(way: np.ndarray, modulus: float, peak: float = 0.0) -> np.ndarray:
    """Share of the strength that a shear displacement calls up, signed.

    Janosi & Hanamoto's exponential; with `peak` a hump of that height over it at one modulus, as dense sand has
    (after Oida's and Wong's humps).
    """
    x = np.abs(way) / modulus
    return np.sign(way) * (1.0 - np.exp(-x) + peak * x * np.exp(1.0 - x))


def shear(
    rim: Rim, pressure: np.ndarray, soil: Values, circle: float, shear_radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Shear stresses on the wheel, forward and to the left, Pa.

    Args:
      rim: the contact. pressure: Pa. soil: constants. circle: share of a common strength for both directions.
      shear_radius: radius at which the soil shears, over the wheel's.
    """
    back, left = rim.ways(shear_radius)
    kx, ky, peak = soil["shear_x"], soil["shear_y"], soil.get("peak", 0.0)
    cohesion: np.ndarray | float = soil["cohesion"]
    if "cohesion_way" in soil:
        cohesion = cohesion * np.exp(-np.hypot(back, left) / soil["cohesion_way"])
    limit = strength(pressure, soil, cohesion)
    apart = limit * mobilised(back, kx, peak), -limit * mobilised(left, ky, peak)
    if circle == 0.0:
        return apart
    qx, qy = back / kx, left / ky
    q = np.maximum(np.hypot(qx, qy), 1e-12)
    both = limit * mobilised(q, 1.0, peak)
    return (1.0 - circle) * apart[0] + circle * both * qx / q, (1.0 - circle) * apart[1] - circle * both * qy / q


def plate_pressure(depth: np.ndarray, radius: np.ndarray, width: float, soil: Values, growth: np.ndarray) -> np.ndarray:
    """Pressure under a plate, Pa: Reece's (c k_c + gamma b k_phi)(z/b)^n; `growth` of n keeps p at z = r."""
    n = soil["exponent"]
    base = (soil["reece_c"] * soil["cohesion"] + soil["unit_weight"] * width * soil["reece_phi"]) * (depth / width) ** n
    hard = soil.get("hard_modulus", 0.0) * np.maximum(depth - soil.get("hard_depth", 0.0), 0.0)
    return base * np.maximum(depth / radius, 1e-9) ** growth + hard


def integral(
    rim: Rim,
    width: float,
    soil: Values,
    growth: np.ndarray,
    softer: np.ndarray,
    circle: float,
    shear_radius: float,
    loss: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wong & Reece 1967 along the arc: pressure, shear forward, shear to the left, Pa.

    `softer` divides the pressure; `loss` is the share of it that fully sheared soil no longer bears.
    """
    pressure = plate_pressure(rim.depth, rim.radius, width, soil, growth) / softer
    if loss:
        back, left = rim.ways(shear_radius)
        pressure = pressure * (1.0 - loss * (1.0 - np.exp(-np.hypot(back / soil["shear_x"], left / soil["shear_y"]))))
    return (pressure, *shear(rim, pressure, soil, circle, shear_radius))


def linear(
    rim: Rim,
    width: float,
    soil: Values,
    growth: np.ndarray,
    softer: np.ndarray,
    circle: float,
    shear_radius: float,
    loss: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shibly, Iagnemma & Dubowsky 2005: the integral's stresses at theta_m, straight lines to both ends."""
    top = dataclasses.replace(rim, theta=rim.lowest, weight=np.ones_like(rim.lowest))
    values = integral(top, width, soil, growth, softer, circle, shear_radius, loss)
    front = (rim.entry - rim.theta) / (rim.entry - rim.lowest)
    behind = (rim.theta - rim.leave) / (rim.lowest - rim.leave)
    share = np.where(rim.theta >= rim.lowest, front, behind)
    return values[0] * share, values[1] * share, values[2] * share


_C1 = (
    0.00212,
    -0.02320,
    -0.20890,
    -0.43083,
    -0.00259,
    0.48872,
    -0.00415,
    0.07204,
    -0.02750,
    -0.08772,
    0.01992,
    -0.45961,
    0.40799,
    -0.10107,
    -0.06576,
    0.05664,
    -0.09269,
    0.01892,
    0.01033,
    0.15120,
)
_C2 = (
    -0.06796,
    -0.10941,
    0.04725,
    -0.06914,
    -0.05835,
    -0.65880,
    -0.11985,
    -0.25739,
    -0.26834,
    0.02692,
    -0.00736,
    0.63758,
    0.08997,
    0.21069,
    0.04748,
    0.20406,
    0.18589,
    0.04934,
    0.13527,
    -0.33207,
)
_C3 = (
    -0.02634,
    -0.03436,
    0.45256,
    0.00835,
    0.02553,
    -1.31290,
    -0.05532,
    0.06790,
    -0.16404,
    0.02287,
    0.02927,
    0.95406,
    -0.00131,
    -0.11028,
    0.01487,
    -0.02730,
    0.10911,
    -0.04097,
    0.07881,
    -0.27519,
)
GRANULAR = np.array([_C1, _C2, _C3])
"""Coefficients of f1, f2, f3 (Agarwal, Goldman & Kamrin 2023, PNAS 120:e2214017120)."""


def granular_stress(normal: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Stress of grains on a face per depth and stiffness, by three-dimensional resistive force theory.

    Args:
      normal: of the face, out of the body, unit vectors of shape (..., 3), z up. motion: its direction, likewise.

    Returns:
      Stress vector on the body, shape (..., 3); zero on faces that recede.
    """
    x1, x2 = -motion[..., 2], -normal[..., 2]
    x3 = np.sum(normal * motion, axis=-1)
    one = np.ones_like(x1)
    terms = np.stack(
        [
            one,
            x1,
            x2,
            x3,
            x1**2,
            x2**2,
            x3**2,
            x1 * x2,
            x2 * x3,
            x3 * x1,
            x1**3,
            x2**3,
            x3**3,
            x1 * x2**2,
            x2 * x1**2,
            x2 * x3**2,
            x3 * x2**2,
            x3 * x1**2,
            x1 * x3**2,
            x1 * x2 * x3,
        ],
        axis=-1,
    )
    f = terms @ GRANULAR.T
    up = np.array([0.0, 0.0, 1.0])
    stress = f[..., :1] * normal + f[..., 1:2] * motion - f[..., 2:] * up
    return np.where(x3[..., None] > 0.0, stress, 0.0)


def granular(
    rim: Rim,
    width: float,
    soil: Values,
    growth: np.ndarray,
    softer: np.ndarray,
    circle: float,
    shear_radius: float,
    loss: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Resistive force theory on the rim's faces, along which friction bounds it (Agarwal et al. 2021)."""
    del width, circle, loss
    sine, cosine = np.sin(rim.theta), np.cos(rim.theta)
    zero = np.zeros_like(sine)
    normal = np.stack([sine, zero, -cosine], axis=-1)
    along, sinking = rim.turn - rim.roll * shear_radius * cosine, -rim.roll * shear_radius * sine - rim.press
    motion = np.stack([along, rim.aside + zero, sinking], axis=-1)
    motion = motion / np.maximum(np.linalg.norm(motion, axis=-1, keepdims=True), 1e-12)
    stress = granular_stress(normal, motion)
    pressure = np.maximum(-np.sum(stress * normal, axis=-1), 0.0)
    along = stress[..., 0] * cosine + stress[..., 2] * sine
    across = stress[..., 1]
    share = np.minimum(1.0, soil["rim_friction"] * pressure / np.maximum(np.hypot(along, across), 1e-12))
    depth = np.maximum(rim.radius * (cosine - np.cos(rim.entry)), 0.0)
    scale = soil["grain_stiffness"] * depth * np.maximum(depth / rim.radius, 1e-9) ** growth / softer
    return scale * pressure, scale * share * along, scale * share * across


GRANULAR_HOLDS = (
    "stress_integral",
    "slide_softening",
    "slip_sinkage",
    "angle_sinkage",
    "shear_softening",
    "friction_circle",
    "skid_shear",
    "exit_angle",
)
"""What the granular law holds by itself, in the catalogue's names: stress falls as motion turns along the face, in one
strength for all directions, and soil behind the axle bears nothing, so that sinkage grows with slip and slip angle."""
LAWS = {"linear": linear, "integral": integral, "granular": granular}
