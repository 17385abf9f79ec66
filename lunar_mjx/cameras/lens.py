"""Lens distortion by Brown and Conrady, with the coefficients that OpenCV and ROS calibrate."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from lunar_mjx.errors import bad_input, require_finite


@dataclasses.dataclass(frozen=True)
class _Search:
    """How the distortion is inverted."""

    stages: int = 8
    """Steps from the picture's middle outwards, each begun on the line through the place of the one before."""
    newton: int = 2
    """Newton iterations of a step."""
    polish: int = 12
    """Most Newton iterations at the end."""
    residual: float = 1e-11
    """Distance in the picture, over the focal length, that counts as found."""
    border: int = 64
    """Places on each side of the picture where the map is looked at, and between the middle and each of them."""


_SEARCH = _Search()
NAMES = ("k1", "k2", "p1", "p2", "k3")
"""In the order of OpenCV's `distCoeffs` and of `D` in ROS."""


@dataclasses.dataclass(frozen=True)
class Lens:
    """Distortion coefficients of a lens, without unit: OpenCV's five, `plumb_bob` of ROS (`sensor_msgs/CameraInfo`).

    With x to the right and y down over the depth, and r^2 = x^2 + y^2, a point is seen at

        x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
        y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

    times the focal length from the picture's middle (OpenCV, "Camera Calibration and 3D Reconstruction"; D. C. Brown,
    Close-range camera calibration, Photogrammetric Engineering 37, 1971). Negative k1 draws corners inwards (a barrel).

    Attributes:
      k1, k2, k3: radial. p1, p2: tangential, of a lens that does not lie parallel to the sensor.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        for name in NAMES:
            require_finite("lens", name, getattr(self, name))

    def distorted(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """Where points (x, y) are seen: all right and down of the axis, over the depth, of any one shape."""
        return self.bent(np.asarray(x, float), np.asarray(y, float))

    def bent(self, x: Any, y: Any) -> tuple[Any, Any]:
        """`distorted` of arrays as they are, of NumPy or of JAX."""
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )

    def undistorted(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """Points (x, y) that are seen at (x, y), the inverse of `distorted`; not a number where none was found.

        Places are followed from the middle outwards, so that of several points the one that hangs together with it
        is found.
        """
        seen = np.asarray(x, float), np.asarray(y, float)
        at = (np.zeros_like(seen[0]), np.zeros_like(seen[1]))
        with np.errstate(all="ignore"):
            for stage in range(1, _SEARCH.stages + 1):
                share = stage / _SEARCH.stages
                ahead = stage / max(stage - 1, 1)
                at = (ahead * at[0], ahead * at[1])
                for _ in range(_SEARCH.newton):
                    at, _ = self._nearer(at, (share * seen[0], share * seen[1]))
            for _ in range(_SEARCH.polish):
                at, away = self._nearer(at, seen)
                if not (away > _SEARCH.residual).any():
                    break
            away = np.hypot(*(a - b for a, b in zip(self.distorted(*at), seen, strict=True)))
            lost = ~(away <= 10.0 * _SEARCH.residual)
        return np.where(lost, np.nan, at[0]), np.where(lost, np.nan, at[1])

    def _nearer(self, at: tuple, seen: tuple) -> tuple[tuple, np.ndarray]:
        """One Newton step, and how far the step began from what is sought."""
        xx, xy, yy = self._slopes(*at)
        ex, ey = (a - b for a, b in zip(self.distorted(*at), seen, strict=True))
        det = xx * yy - xy * xy
        return (at[0] - (yy * ex - xy * ey) / det, at[1] - (xx * ey - xy * ex) / det), np.hypot(ex, ey)

    def _slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives of the map: xx, xy = yx, yy."""
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        grows = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3))
        return (
            radial + grows * x * x + 2.0 * self.p1 * y + 6.0 * self.p2 * x,
            grows * x * y + 2.0 * self.p1 * x + 2.0 * self.p2 * y,
            radial + grows * y * y + 6.0 * self.p1 * y + 2.0 * self.p2 * x,
        )

    def one_to_one(self, right: float, down: float) -> bool:
        """Whether every place of a picture shows one point; the picture reaches `right` and `down` of its middle.

        What is seen on the picture's border is sought, and the map's derivative is looked at between it and the
        middle. Where the derivative is positive definite throughout, no two points come to one place.
        """
        side = np.linspace(-1.0, 1.0, _SEARCH.border)
        one = np.ones_like(side)
        x, y = self.undistorted(
            right * np.concatenate([side, side, one, -one]), down * np.concatenate([one, -one, side, side])
        )
        if not np.isfinite(x).all():
            return False
        way = np.linspace(0.0, 1.0, _SEARCH.border)[:, None]
        xx, xy, yy = self._slopes(way * x, way * y)
        return bool((xx + yy > 0.0).all() and (xx * yy - xy * xy > 0.0).all())


def lens_of(
    coefficients: Sequence[float] | np.ndarray, source: str = "lens", field: str = "coefficients"
) -> Lens | None:
    """The lens of OpenCV's `distCoeffs`, or `D` of a ROS `CameraInfo`; None if all are 0 or there are none.

    Args:
      coefficients: k1, k2, p1, p2 and, if there is a fifth, k3. source, field: where they stand, for errors.

    Raises:
      UserError: they are not numbers, or neither none, four nor five; OpenCV's models with eight and more are others.
    """
    if isinstance(coefficients, np.ndarray):
        coefficients = np.ravel(coefficients).tolist()  # OpenCV gives a row or a column
    if isinstance(coefficients, str) or not isinstance(coefficients, Sequence) or len(coefficients) not in (0, 4, 5):
        raise bad_input(
            source,
            field,
            coefficients,
            "are not the coefficients of plumb_bob",
            "give k1, k2, p1, p2, k3, or none for no distortion",
        )
    numbers = [require_finite(source, field, v) for v in coefficients]
    return Lens(*numbers) if any(numbers) else None
