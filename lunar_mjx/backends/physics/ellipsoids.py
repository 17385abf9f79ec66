"""Wheels and boxes against ellipsoids in NumPy; see `effects.wheel.ellipsoid_contact`, which solves by other means."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.backends.physics.vectors import clamp, cross, dot


@dataclasses.dataclass(frozen=True)
class EllipsoidSearch:
    """How the nearest place of an ellipsoid is sought: plain and long, as the check of a fast method."""

    halvings: int = 60
    """Halvings of an interval: to the last digit of double precision."""
    sweeps: int = 400
    """Rounds of improving one coordinate after the other."""


ELLIPSOID_SEARCH = EllipsoidSearch()


def wheel_in_ellipsoid(
    form: np.ndarray, gap: np.ndarray, axle: np.ndarray, radius: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The wheel's point deepest in an ellipsoid, the unit vector from there into it, and the depth.

    Args:
      form: (..., 3, 3). gap: the ellipsoid's centre from the wheel's, and axle, (..., 3), m. radius, width: (...), m.
    """
    # The axis farthest from the axle, so that the cross product is never short.
    helper = np.eye(3)[np.abs(axle).argmin(axis=-1)]
    first = cross(axle, helper)
    first /= np.sqrt(dot(first, first))[..., None]
    axes = np.stack([first, cross(axle, first), axle], axis=-2)
    m = np.einsum("...ij,...jk,...lk->...il", axes, form, axes)
    b = np.einsum("...ij,...j->...i", m, np.einsum("...ij,...j->...i", axes, gap))
    # With the place along the axle eliminated (Schur's complement): a wheel without end.
    aside = m[..., :2, 2] / m[..., 2:, 2]
    endless = _least_on_disc(
        m[..., :2, :2] - aside[..., :, None] * m[..., None, :2, 2], b[..., :2] - aside * b[..., 2:], radius
    )
    # What the disc's best leaves is convex in t, so that the best within the width is the best of all, clamped.
    t = clamp((b[..., 2] - dot(m[..., :2, 2], endless)) / m[..., 2, 2], -0.5 * width, 0.5 * width)[..., None]
    local = np.concatenate([_least_on_disc(m[..., :2, :2], b[..., :2] - m[..., :2, 2] * t, radius), t], axis=-1)
    point = np.einsum("...ij,...i->...j", axes, local)
    return point, *_normal_and_depth(form, point - gap)


def box_in_ellipsoid(
    form: np.ndarray, gap: np.ndarray, rotation: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `wheel_in_ellipsoid` for boxes; gap, half sides and the point in the box frame, normals in the world's.

    The normal is the box's downward axis where the ellipsoid's centre is within the box.
    """
    m = np.einsum("...ji,...jk,...kl->...il", rotation, form, rotation)
    point = clamp(gap, -half, half)
    for _ in range(ELLIPSOID_SEARCH.sweeps):
        before = point.copy()
        # One coordinate after the other finds the least of a convex quadratic in a box.
        for i in range(3):
            pull = dot(m[..., i, :], point - gap) - m[..., i, i] * (point - gap)[..., i]
            point[..., i] = clamp(gap[..., i] - pull / m[..., i, i], -half[..., i], half[..., i])
        if np.abs(point - before).max() < 1e-15:
            break
    apart = point - gap
    inside = np.sqrt(dot(apart, apart)) < 1e-6
    toward, depth = _normal_and_depth(form, np.einsum("...ij,...j->...i", rotation, apart))
    # A centre within the box has no nearest face that means anything: the box is taken to lie on top.
    toward = np.where(inside[..., None], -rotation[..., 2], toward)
    return point, toward, np.where(inside, m[..., 2, 2] ** -0.5, depth)


def _normal_and_depth(form: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    outward = np.einsum("...ij,...j->...i", form, q)
    steep = np.maximum(np.sqrt(dot(outward, outward)), 1e-9)
    level = np.sqrt(np.maximum(dot(q, outward), 1e-18))
    # Depth to first order: (1 - f)/|grad f| with f = sqrt(q' A q), which is exact on the surface.
    return -outward / steep[..., None], (1.0 - level) * level / steep


def _least_on_disc(m: np.ndarray, b: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Where p' m p/2 - b' p is least within |p| <= radius, by halving Lagrange's multiplier among eigenvectors."""
    values, vectors = np.linalg.eigh(m)
    b = np.einsum("...ji,...j->...i", vectors, b)
    # At the upper end the point lies within the disc for certain, since every eigenvalue is positive.
    low, high = np.zeros(b.shape[:-1]), np.sqrt(dot(b, b)) / radius
    for _ in range(ELLIPSOID_SEARCH.halvings):
        middle = 0.5 * (low + high)
        p = b / (values + middle[..., None])
        long = dot(p, p) > radius * radius
        # |p| falls as the multiplier grows, so halving cannot miss.
        low, high = np.where(long, middle, low), np.where(long, high, middle)
    within = b / values
    free = dot(within, within) <= radius * radius
    p = np.where(free[..., None], within, b / (values + high[..., None]))
    return np.einsum("...ij,...j->...i", vectors, p)
