"""Three-vectors held as separate components, so that XLA sees elementwise code only.

A component may have any shape (one entry per wheel, per chassis point, ...); components of one vector broadcast.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp


class Vec3(NamedTuple):
    """A vector (x, y, z), or many of them side by side."""

    x: Any
    y: Any
    z: Any

    def __add__(self, other: Vec3) -> Vec3:  # type: ignore[override]
        return Vec3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vec3) -> Vec3:
        return Vec3(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, scale: Any) -> Vec3:  # type: ignore[override]
        return Vec3(self.x * scale, self.y * scale, self.z * scale)

    def __neg__(self) -> Vec3:
        return Vec3(-self.x, -self.y, -self.z)

    def dot(self, other: Vec3) -> Any:
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: Vec3) -> Vec3:
        return Vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def norm(self, floor: float = 1e-12) -> Any:
        """Length, never below `floor`, so that its derivative stays finite at zero."""
        return jnp.sqrt(jnp.maximum(self.dot(self), floor * floor))

    def unit(self, floor: float = 1e-12) -> Vec3:
        return self * (1.0 / self.norm(floor))

    def sum(self) -> Vec3:
        """Sum over the entries of each component."""
        return Vec3(jnp.sum(self.x), jnp.sum(self.y), jnp.sum(self.z))

    def where(self, condition: Any, other: Vec3) -> Vec3:
        """This vector where `condition` holds, `other` elsewhere."""
        return Vec3(*(jnp.where(condition, a, b) for a, b in zip(self, other, strict=True)))

    def stack(self, axis: int = -1) -> Any:
        """One array with the components along `axis`."""
        return jnp.stack(jnp.broadcast_arrays(*self), axis=axis)

    @classmethod
    def of(cls, array: Any, axis: int = -1) -> Vec3:
        """The components of an array of shape (..., 3)."""
        return cls(*(jnp.take(array, i, axis=axis) for i in range(3)))

    @classmethod
    def zero(cls, like: Any) -> Vec3:
        z = jnp.zeros_like(like)
        return cls(z, z, z)


class Frame(NamedTuple):
    """A rotation as its three columns: the forward, left and up axes of the frame, in world coordinates."""

    forward: Vec3
    left: Vec3
    up: Vec3

    def to_world(self, v: Vec3) -> Vec3:
        return self.forward * v.x + self.left * v.y + self.up * v.z

    def from_world(self, v: Vec3) -> Vec3:
        return Vec3(self.forward.dot(v), self.left.dot(v), self.up.dot(v))

    @classmethod
    def of_matrix(cls, matrix: Any) -> Frame:
        """From rotation matrices of shape (..., 3, 3), body to world."""
        return cls(*(Vec3(*(matrix[..., i, j] for i in range(3))) for j in range(3)))

    def euler(self) -> Vec3:
        """Roll, pitch and yaw in rad (intrinsic z-y'-x'')."""
        roll = jnp.arctan2(self.left.z, self.up.z)
        pitch = jnp.arcsin(jnp.clip(-self.forward.z, -1.0, 1.0))
        yaw = jnp.arctan2(self.forward.y, self.forward.x)
        return Vec3(roll, pitch, yaw)
