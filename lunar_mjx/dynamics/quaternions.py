"""Unit quaternions w, x, y, z (body to world) as four components."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from lunar_mjx.spatial import Frame, Vec3


def normalized(q: list[Any]) -> list[Any]:
    """A quaternion of length one in the direction of `q`."""
    scale = 1.0 / jnp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return [c * scale for c in q]


def rotation(q: list[Any]) -> Frame:
    """Rotation matrix of a unit quaternion, body to world."""
    w, x, y, z = q
    return Frame(
        Vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        Vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        Vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def integrate(q: list[Any], spin: Vec3, dt: float) -> list[Any]:
    """Turns `q` by the angular velocity `spin`, rad/s in body coordinates, over `dt`: q exp(spin dt/2).

    The exponential map, as MuJoCo's mju_quatIntegrate.
    """
    v = spin * dt
    square = v.dot(v)
    small = square < 1e-4
    # 1 where the series is taken: the root's derivative at 0 is infinite, and infinity times 0 is not a number
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    # sin(t/2)/t and cos(t/2); their series below 0.01 rad, exact to rounding
    series = 0.5 - square * (1.0 / 48.0 - square * (1.0 / 3840.0))
    factor = jnp.where(small, series, jnp.sin(0.5 * angle) / angle)
    whole = 1.0 - square * (1.0 / 8.0 - square * (1.0 / 384.0 - square * (1.0 / 46080.0)))
    c = jnp.where(small, whole, jnp.cos(0.5 * angle))
    x, y, z = v.x * factor, v.y * factor, v.z * factor
    w0, x0, y0, z0 = q
    # the product is of unit length but for rounding, which a million steps would add up
    return normalized(
        [
            w0 * c - x0 * x - y0 * y - z0 * z,
            w0 * x + x0 * c + y0 * z - z0 * y,
            w0 * y - x0 * z + y0 * c + z0 * x,
            w0 * z + x0 * y - y0 * x + z0 * c,
        ]
    )
