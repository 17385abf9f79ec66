"""How the wheels meet the ground: wheel frames, sinkage, slip (eqs. 8 and 9)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from lunar_mjx.backends.physics.context import Context, Values
from lunar_mjx.backends.physics.ground import Grid
from lunar_mjx.backends.physics.vectors import clamp, cross, dot

Moved = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From x and y, m, to the height of soil that wheels have moved there, m."""


@dataclasses.dataclass(frozen=True)
class Contact:
    """Numbers of contact that the effects have, written again for the independent check."""

    slow: float = 2e-3
    """m/s; smallest denominator of the slip ratio."""
    standing: float = 1e-3
    """m/s; below it a braking wheel counts as standing."""
    margin: float = 0.02
    """Clearance, in radii, within which ground counts as near the rim."""
    airborne: float = 1e-6
    """Weight of the three middle samples whatever the rim's clearance."""


CONTACT = Contact()


def wheel_contact(
    c: Context, height: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, inside: np.ndarray
) -> Values:
    """Contact with the plane that touches the ground below each wheel's centre.

    Args:
      c: poses and velocities, and the geometry.
      height, slope_x, slope_y, inside: of the ground below the wheels, (rover, wheel).
    """
    radius, toe = c.geometry["radius"], c.geometry["toe"]
    up = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    normal = np.empty(c.wheel_position.shape)
    normal[..., 0], normal[..., 1], normal[..., 2] = -slope_x * up, -slope_y * up, up
    lean = dot(c.wheel_axle, normal)
    # The floors are the JAX effects' own, as numbers of the model: engines are compared to rounding.
    level = np.sqrt(np.maximum(1.0 - lean * lean, 1e-6))  # cosine of the wheel's camber against the ground
    sinkage = np.maximum(radius * level - (c.wheel_position[..., 2] - height) * up, 0.0)
    forward = cross(c.wheel_axle, normal)
    forward /= np.sqrt(np.maximum(dot(forward, forward), 1e-12))[..., None]
    left = cross(normal, forward)
    # Most models have no toe; the branch saves the products.
    if toe.any():
        cos, sin = np.cos(toe)[..., None], np.sin(toe)[..., None]
        forward, left = forward * cos + left * sin, left * cos - forward * sin
    v_x, v_y = dot(c.wheel_velocity, forward), dot(c.wheel_velocity, left)
    rim = radius * dot(c.wheel_angular_velocity, c.wheel_axle)
    fastest = faster(rim, v_x)
    speed = np.maximum(np.abs(fastest), CONTACT.slow)
    heading = 1.0 - 2.0 * (fastest < 0.0)
    slip = heading * (rim - v_x) / speed
    return {
        "sinkage": sinkage,
        "sinkage_rate": -dot(c.wheel_velocity, normal),
        "slip": slip,
        "soil_slip": clamp(slip, -1.0, 1.0),
        "soil_slid": np.minimum(np.abs(slip), 1.0),
        "slip_angle": np.arctan2(v_y, np.maximum(np.abs(v_x), CONTACT.slow)),
        "v_x": v_x,
        "v_y": v_y,
        "rim_speed": rim,
        "forward": forward,
        "left": left,
        "normal": normal,
        "inside": inside,
    }


ALONG = np.linspace(-0.9, 0.9, 11)
"""Places of the samples along the wheel, in radii."""


def rim_plane(c: Context, field: Grid, moved: Moved | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height below each wheel's centre and slopes by x and y of the plane fitted along and beside its rim.

    The ground is the field and what `moved` says of soil that wheels have moved there, m, at points (rover, ...).

    Weighted least squares along the heading with weights (p/r + m)^2 of the depth p within the rim, and the difference
    of the two sides across.
    """
    r, axle, center = c.geometry["radius"], c.wheel_axle, c.wheel_position
    level = np.sqrt(axle[..., 0] ** 2 + axle[..., 1] ** 2 + 1e-12)
    heading = np.stack([axle[..., 1], -axle[..., 0]], axis=-1) / level[..., None]
    beside = np.stack([-heading[..., 1], heading[..., 0]], axis=-1)

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ground = field.value(x, y)[0]
        return ground if moved is None else ground + moved(x, y)

    u = r[..., None] * ALONG
    points = center[..., None, :2] + u[..., None] * heading[..., None, :]
    along = height(points[..., 0], points[..., 1])
    offset = 0.5 * c.geometry["width"][..., None] * beside
    left, right = (height(*np.moveaxis(center[..., :2] + s * offset, -1, 0)) for s in (1.0, -1.0))
    foot = along[..., len(ALONG) // 2].copy()
    along -= foot[..., None]
    clear = center[..., 2, None] - foot[..., None] - along
    depth = 1.0 + CONTACT.margin - np.sqrt(u * u + clear * clear) / r[..., None]
    weight = np.maximum(depth, 0.0) ** 2 + CONTACT.airborne * (np.abs(ALONG) < 0.3)
    # Normalised once; the JAX effect divides by the sum instead, which is the same line.
    weight /= weight.sum(-1, keepdims=True)
    mean_u, mean_h = (weight * u).sum(-1), (weight * along).sum(-1)
    off = u - mean_u[..., None]
    slope = (weight * off * along).sum(-1) / (weight * off * off).sum(-1)
    steep = slope[..., None] * heading + ((left - right) / c.geometry["width"])[..., None] * beside
    return foot + mean_h - slope * mean_u, steep[..., 0], steep[..., 1]


def faster(rim: np.ndarray, travel: np.ndarray) -> np.ndarray:
    """The one of rim and travel speed with the larger magnitude, m/s: the denominator of eq. 8."""
    return np.where(np.abs(rim) > np.abs(travel), rim, travel)


def side_speed(contact: Values) -> np.ndarray:
    """Numerator of (1 - s) tan(beta): v_y when driving, v_y (2 - |r omega/v_x|) when braking, m/s (eqs. 8, 9, 11)."""
    rim, v_x, v_y = contact["rim_speed"], contact["v_x"], contact["v_y"]
    # share by which travel outruns the rim: none for a driven wheel, all for a locked one, less for one turning back
    outrun = np.maximum(np.abs(v_x) - np.abs(rim), 0.0) / np.maximum(np.abs(v_x), CONTACT.standing)
    return v_y * (1.0 + outrun)


def momentary_slip(contact: Values) -> Values:
    """Slip without memory of the soil: rim less travel speed over the larger, eq. 11's factor, and the direction."""
    fastest = faster(contact["rim_speed"], contact["v_x"])
    speed = np.maximum(np.abs(fastest), CONTACT.slow)
    return {
        "slip_x": (contact["rim_speed"] - contact["v_x"]) / speed,
        "slip_y": side_speed(contact) / speed,
        "direction": clamp(contact["rim_speed"] + contact["v_x"], -np.abs(fastest), np.abs(fastest)) / speed,
    }
