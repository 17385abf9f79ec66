"""The shape of an ellipsoid as a quadratic form: (p - c)' A (p - c) = 1 on its surface, with c its centre."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from lunar_mjx.spatial import Vec3


class Form(NamedTuple):
    """The symmetric matrix A, 1/m^2, entry by entry, of one ellipsoid or of many side by side."""

    xx: Any
    yy: Any
    zz: Any
    yz: Any
    xz: Any
    xy: Any

    def times(self, v: Vec3) -> Vec3:
        """A v: on the surface, with v from the centre, it points outward along the normal."""
        return Vec3(
            self.xx * v.x + self.xy * v.y + self.xz * v.z,
            self.xy * v.x + self.yy * v.y + self.yz * v.z,
            self.xz * v.x + self.yz * v.y + self.zz * v.z,
        )

    def between(self, u: Vec3, v: Vec3) -> Any:
        """The bilinear form u' A v."""
        return u.dot(self.times(v))

    def outline(self, x: Any, y: Any) -> Any:
        """1 on the outline seen from above, less within it; (x, y) from the centre, m."""
        inverse = 1.0 / self.zz
        xx, yy = self.xx - self.xz * self.xz * inverse, self.yy - self.yz * self.yz * inverse
        return xx * x * x + 2.0 * (self.xy - self.xz * self.yz * inverse) * x * y + yy * y * y

    def height(self, x: Any, y: Any) -> Any:
        """Height of the upper surface over the centre, m, at (x, y) from it; beyond the outline that of its middle."""
        rise = jnp.sqrt(jnp.maximum(self.zz * (1.0 - self.outline(x, y)), 0.0))
        return (rise - self.xz * x - self.yz * y) / self.zz

    def apex(self) -> Vec3:
        """The highest point, from the centre, m."""
        x = self.xy * self.yz - self.yy * self.xz
        y = self.xy * self.xz - self.xx * self.yz
        z = self.xx * self.yy - self.xy * self.xy
        # A^-1 e_z over its own height's root: cofactors over the root of determinant times cofactor
        scale = 1.0 / jnp.sqrt((self.xz * x + self.yz * y + self.zz * z) * z)
        return Vec3(x * scale, y * scale, z * scale)


def forms_of(axes: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """The six entries of A, in the order of `Form`, (n, 6), 1/m^2.

    Args:
      axes: semi-axes, (n, 3), m. turns: rotations (n, 3, 3) whose columns are the axes' directions.
    """
    matrix = np.einsum("nij,nj,nkj->nik", turns, axes**-2.0, turns)
    return np.stack([matrix[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))], axis=-1)


def principal_axes(forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Semi-axes (n, 3), m, longest first, and the rotations (n, 3, 3) whose columns they lie along; see `forms_of`."""
    xx, yy, zz, yz, xz, xy = np.asarray(forms, float).T
    matrix = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)
    # Eigenvalues of the form are inverse squares of the semi-axes, so that the smallest belongs to the longest.
    values, turns = np.linalg.eigh(matrix)
    turns[:, :, 2] *= np.linalg.det(turns)[:, None]  # right-handed
    return values**-0.5, turns
