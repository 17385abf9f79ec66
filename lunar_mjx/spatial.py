"""Three-vectors and rotations held as separate components, so that XLA sees elementwise code only.

A component is an array of any shape (one entry per wheel, per chassis point, ...), or a Python float; components of one
vector broadcast. Sums and products with a Python 0 or 1 vanish while a step is traced: the zeros of a rover's geometry
(an axle along y, a diagonal inertia) cost nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp


def add(a: Any, b: Any) -> Any:
    """a + b, where a Python 0 vanishes."""
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    return a + b


def neg(a: Any) -> Any:
    """The opposite of a number or array, -a."""
    return -a


def sub(a: Any, b: Any) -> Any:
    """a - b, where a Python 0 vanishes."""
    if isinstance(b, float) and b == 0.0:
        return a
    if isinstance(a, float) and a == 0.0:
        return neg(b)
    return a - b


def mul(a: Any, b: Any) -> Any:
    """a b, where a Python 0, 1 or -1 leaves no product."""
    for p, q in ((a, b), (b, a)):
        if isinstance(p, float):
            if p == 0.0:
                return 0.0
            if p == 1.0:
                return q
            if p == -1.0:
                return neg(q)
    return a * b


def total(*terms: Any) -> Any:
    """Sum of the terms, where Python zeros vanish."""
    result: Any = 0.0
    for term in terms:
        result = add(result, term)
    return result


class Vec3(NamedTuple):
    """A vector (x, y, z), or many of them side by side."""

    x: Any
    y: Any
    z: Any

    def __add__(self, other: Vec3) -> Vec3:  # type: ignore[override]
        return Vec3(add(self.x, other.x), add(self.y, other.y), add(self.z, other.z))

    def __sub__(self, other: Vec3) -> Vec3:
        return Vec3(sub(self.x, other.x), sub(self.y, other.y), sub(self.z, other.z))

    def __mul__(self, scale: Any) -> Vec3:  # type: ignore[override]
        return Vec3(mul(self.x, scale), mul(self.y, scale), mul(self.z, scale))

    def __neg__(self) -> Vec3:
        return Vec3(neg(self.x), neg(self.y), neg(self.z))

    def dot(self, other: Vec3) -> Any:
        """Scalar product."""
        return total(mul(self.x, other.x), mul(self.y, other.y), mul(self.z, other.z))

    def cross(self, other: Vec3) -> Vec3:
        """Vector product."""
        return Vec3(
            sub(mul(self.y, other.z), mul(self.z, other.y)),
            sub(mul(self.z, other.x), mul(self.x, other.z)),
            sub(mul(self.x, other.y), mul(self.y, other.x)),
        )

    def norm(self, floor: float = 1e-12) -> Any:
        """Length, never below `floor`, so that its derivative stays finite at zero."""
        # The floor keeps the root's derivative finite at the zero vector.
        return jnp.sqrt(jnp.maximum(self.dot(self), floor * floor))

    def unit(self, floor: float = 1e-12) -> Vec3:
        """The vector divided by its length; no longer than 1 where it is shorter than `floor`."""
        # One division for three components.
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
        """The zero vector, with components of the shape and type of an array."""
        # An array and no Python 0, where a state needs its shape.
        z = jnp.zeros_like(like)
        return cls(z, z, z)


class Frame(NamedTuple):
    """A rotation as its columns: the forward (x), left (y) and up (z) axes of the rotated frame, in the outer one."""

    forward: Vec3
    left: Vec3
    up: Vec3

    def to_world(self, v: Vec3) -> Vec3:
        """A vector given in the rotated frame, in the outer one."""
        return self.forward * v.x + self.left * v.y + self.up * v.z

    def from_world(self, v: Vec3) -> Vec3:
        """A vector given in the outer frame, in the rotated one."""
        return Vec3(self.forward.dot(v), self.left.dot(v), self.up.dot(v))

    def then(self, inner: Frame) -> Frame:
        """The product of this rotation and `inner`."""
        return Frame(self.to_world(inner.forward), self.to_world(inner.left), self.to_world(inner.up))

    def turn(self, axis: int, cos: Any, sin: Any) -> Frame:
        """The product of this rotation and a turn about its own axis number `axis` (0 forward, 1 left, 2 up)."""
        columns = list(self)
        first, second = columns[(axis + 1) % 3], columns[(axis + 2) % 3]
        # About one of the frame's own axes the third stays as it is: no matrix product.
        columns[(axis + 1) % 3] = first * cos + second * sin
        columns[(axis + 2) % 3] = second * cos - first * sin
        return Frame(*columns)

    @classmethod
    def of_matrix(cls, matrix: Any) -> Frame:
        """From rotation matrices of shape (..., 3, 3), body to world."""
        return cls(*(Vec3(*(matrix[..., i, j] for i in range(3))) for j in range(3)))

    def euler(self) -> Vec3:
        """Roll, pitch and yaw in rad (intrinsic z-y'-x'')."""
        roll = jnp.arctan2(self.left.z, self.up.z)
        # Rounding may pass 1 by a digit. Roll, pitch and yaw are intrinsic z-y'-x''.
        pitch = jnp.arcsin(jnp.clip(-self.forward.z, -1.0, 1.0))
        yaw = jnp.arctan2(self.forward.y, self.forward.x)
        return Vec3(roll, pitch, yaw)


ZERO = Vec3(0.0, 0.0, 0.0)
IDENTITY = Frame(Vec3(1.0, 0.0, 0.0), Vec3(0.0, 1.0, 0.0), Vec3(0.0, 0.0, 1.0))
