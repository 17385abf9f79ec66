"""Spatial forces, motions and inertias as named components.

After Featherstone 2008 (Rigid Body Dynamics Algorithms).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lunar_mjx.spatial import Frame, Vec3, add, mul, neg, sub, total


def uniform(values: Any, unit: float = 1.0) -> Any:
    """One float where all legs agree, else an array; numbers that are 0 or 1 but for rounding become so."""
    v = np.array(values, float)
    # Exact zeros and ones vanish while a step is traced; those that a rotation left at 1e-17 would be computed.
    v[np.abs(v) < 1e-14 * unit] = 0.0
    v[np.abs(np.abs(v) - 1.0) < 1e-14] = np.sign(v[np.abs(np.abs(v) - 1.0) < 1e-14])
    # One number for all legs is a constant of the program; an array would be read and multiplied at every step.
    return float(v[0]) if np.all(np.abs(v - v[0]) <= 4e-16 * np.abs(v[0])) else v


class Symmetric(NamedTuple):
    """A symmetric 3 x 3 matrix."""

    xx: Any
    yy: Any
    zz: Any
    xy: Any
    xz: Any
    yz: Any

    def __add__(self, other: Symmetric) -> Symmetric:  # type: ignore[override]
        return Symmetric(*(add(a, b) for a, b in zip(self, other, strict=True)))

    def __mul__(self, scale: Any) -> Symmetric:  # type: ignore[override]
        return Symmetric(*(mul(a, scale) for a in self))

    def apply(self, v: Vec3) -> Vec3:
        """Product of the matrix and a vector."""
        return Vec3(
            total(mul(self.xx, v.x), mul(self.xy, v.y), mul(self.xz, v.z)),
            total(mul(self.xy, v.x), mul(self.yy, v.y), mul(self.yz, v.z)),
            total(mul(self.xz, v.x), mul(self.yz, v.y), mul(self.zz, v.z)),
        )

    def rotated(self, r: Frame) -> Symmetric:
        """R A R^T."""
        columns = (Vec3(self.xx, self.xy, self.xz), Vec3(self.xy, self.yy, self.yz), Vec3(self.xz, self.yz, self.zz))
        ra = Frame(*(r.to_world(c) for c in columns))

        def entry(i: int, j: int) -> Any:
            return total(*(mul(ra[k][i], r[k][j]) for k in range(3)))

        return Symmetric(entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2))

    @classmethod
    def isotropic(cls, value: Any) -> Symmetric:
        """`value` times the identity matrix."""
        return cls(value, value, value, 0.0, 0.0, 0.0)

    @classmethod
    def of_point(cls, mass: Any, c: Vec3) -> Symmetric:
        """Moments of inertia about the origin of a point mass at `c`: m (|c|^2 1 - c c^T)."""
        # By components, so that a centre on an axis leaves most of the products out.
        mx, my, mz = c * mass
        xx, yy, zz = mul(mx, c.x), mul(my, c.y), mul(mz, c.z)
        return cls(add(yy, zz), add(xx, zz), add(xx, yy), neg(mul(mx, c.y)), neg(mul(mx, c.z)), neg(mul(my, c.z)))


class Force(NamedTuple):
    """A spatial force: moment about the chassis frame's origin, and force."""

    moment: Vec3
    force: Vec3

    def __add__(self, other: Force) -> Force:  # type: ignore[override]
        return Force(self.moment + other.moment, self.force + other.force)

    def __sub__(self, other: Force) -> Force:
        return Force(self.moment - other.moment, self.force - other.force)


class Motion(NamedTuple):
    """A spatial motion: angular part, and linear part of the body-fixed point at the chassis frame's origin."""

    angular: Vec3
    linear: Vec3

    def __add__(self, other: Motion) -> Motion:  # type: ignore[override]
        return Motion(self.angular + other.angular, self.linear + other.linear)

    def __mul__(self, scale: Any) -> Motion:  # type: ignore[override]
        return Motion(self.angular * scale, self.linear * scale)

    def dot(self, f: Force) -> Any:
        """Power of a spatial force."""
        return add(self.angular.dot(f.moment), self.linear.dot(f.force))

    def cross(self, other: Motion) -> Motion:
        """v x m: rate of a motion vector that moves with velocity v (Featherstone 2008, eq. 2.33)."""
        return Motion(
            self.angular.cross(other.angular), self.linear.cross(other.angular) + self.angular.cross(other.linear)
        )

    def cross_force(self, f: Force) -> Force:
        """v x* f: rate of a force vector that moves with velocity v (Featherstone 2008, eq. 2.34)."""
        return Force(self.angular.cross(f.moment) + self.linear.cross(f.force), self.angular.cross(f.force))


class Inertia(NamedTuple):
    """A spatial inertia about the chassis frame's origin: mass, mass times centre of mass, moments of inertia."""

    mass: Any
    h: Vec3
    moments: Symmetric

    def __add__(self, other: Inertia) -> Inertia:  # type: ignore[override]
        return Inertia(add(self.mass, other.mass), self.h + other.h, self.moments + other.moments)

    def apply(self, v: Motion) -> Force:
        """Momentum of a velocity, or force of an acceleration (Featherstone 2008, eq. 2.62)."""
        return Force(
            self.moments.apply(v.angular) + self.h.cross(v.linear), v.linear * self.mass - self.h.cross(v.angular)
        )


class Body(NamedTuple):
    """Mass, centre of mass and moments of inertia about it, in a link's own frame.

    The moments are `spherical` times the identity plus `rest`, which leaves few numbers to rotate: one for a wheel.
    """

    mass: Any
    com: Vec3
    spherical: Any
    rest: Symmetric

    def at(self, origin: Vec3, frame: Frame) -> Inertia:
        """The body's spatial inertia when the link's frame stands at `origin` turned by `frame`."""
        c = origin + frame.to_world(self.com)
        moments = self.rest.rotated(frame) + Symmetric.isotropic(self.spherical)
        return Inertia(self.mass, c * self.mass, moments + Symmetric.of_point(self.mass, c))


def solve_positive(a: list[list[Any]], columns: list[list[Any]]) -> list[list[Any]]:
    """Solves A x = b for several b by an unrolled L D L^T, A symmetric and positive definite (lower half is read)."""
    n = len(a)
    # Unrolled: a leg has a few joints, and scalars fuse with their neighbours where a batched solver is a call of its
    # own.
    low: list[list[Any]] = [[0.0] * n for _ in range(n)]
    inverse: list[Any] = [0.0] * n
    scaled: list[list[Any]] = [[0.0] * n for _ in range(n)]
    for j in range(n):
        pivot = a[j][j]
        for k in range(j):
            pivot = sub(pivot, mul(low[j][k], scaled[j][k]))
        inverse[j] = 1.0 / pivot
        for i in range(j + 1, n):
            entry = a[i][j]
            for k in range(j):
                entry = sub(entry, mul(low[i][k], scaled[j][k]))
            scaled[i][j] = entry
            low[i][j] = mul(entry, inverse[j])
    return [_substitute(low, inverse, list(b)) for b in columns]


def _substitute(low: list[list[Any]], inverse: list[Any], x: list[Any]) -> list[Any]:
    n = len(x)
    for i in range(n):
        for k in range(i):
            x[i] = sub(x[i], mul(low[i][k], x[k]))
    for i in reversed(range(n)):
        x[i] = mul(x[i], inverse[i])
        for k in range(i + 1, n):
            x[i] = sub(x[i], mul(low[k][i], x[k]))
    return x
