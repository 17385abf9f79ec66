"""The pinhole camera, with a lens or without: its pose, its matrices, and the rays through its pixels.

Conventions are OpenGL's, as in the seed paper's engine: the camera looks along its -z axis, x points right and y up in
the picture; row 0 is the top. Depth is the distance along the optical axis, m.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
from jaxtyping import Float

from lunar_mjx.cameras.lens import NAMES, Lens
from lunar_mjx.errors import bad_input


@dataclasses.dataclass(frozen=True)
class ClippingPlanes:
    """Between which distances a camera sees unless told otherwise: a choice, from the rover's own mast to the end
    of the finely drawn ground."""

    near: float = 0.02
    """Nearest distance, m."""
    far: float = 400.0
    """Farthest distance, m."""


CLIPPING = ClippingPlanes()


@dataclasses.dataclass(frozen=True)
class Pinhole:
    """What a camera's optics and sensor are.

    Attributes:
      width, height: pixels. fovy_deg: vertical angle of view, of the pinhole: a lens moves what lies at the edges.
      near, far: clipping planes, m.
      lens: how the picture is distorted; not at all if None. Cameras in JAX and `project` know it; OpenGL and
        `projection_matrix` do not.

    Raises:
      UserError: a value out of range, or a lens that shows two things at one place of the picture.
    """

    width: int = 320
    height: int = 240
    fovy_deg: float = 60.0
    near: float = CLIPPING.near
    far: float = CLIPPING.far
    lens: Lens | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            if not 1 <= getattr(self, name) <= 4096:
                raise bad_input("camera", name, getattr(self, name), "is outside [1, 4096] pixels", "give about 320")
        if not 1.0 <= self.fovy_deg <= 170.0:
            raise bad_input("camera", "fovy_deg", self.fovy_deg, "is outside [1, 170]", "give about 60")
        if not 0.0 < self.near < self.far:
            raise bad_input(
                "camera", "near", self.near, f"is not between 0 and far = {self.far:g} m", "give about 0.02"
            )
        if self.lens is not None:
            _check_lens(self)

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * self.height / math.tan(0.5 * math.radians(self.fovy_deg))

    def rays(self) -> Float[np.ndarray, "height width 3"]:
        """Directions through the pixels' centres in the camera's axes, of length 1 along the optical axis."""
        if self.lens is not None:
            return _bent(self)
        u = (np.arange(self.width) + 0.5 - 0.5 * self.width) / self.focal
        v = (0.5 * self.height - np.arange(self.height) - 0.5) / self.focal
        x, y = np.meshgrid(u, v)
        return np.stack([x, y, -np.ones_like(x)], axis=-1)

    def projection_matrix(self) -> Float[np.ndarray, "4 4"]:
        """Camera to clip coordinates, as gluPerspective: multiply column vectors from the left."""
        f = 1.0 / math.tan(0.5 * math.radians(self.fovy_deg))
        near, far = self.near, self.far
        return np.array(
            [
                [f * self.height / self.width, 0, 0, 0],
                [0, f, 0, 0],
                [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
                [0, 0, -1, 0],
            ]
        )


def _check_lens(camera: Pinhole) -> None:
    lens = camera.lens
    if not isinstance(lens, Lens):
        raise bad_input("camera", "lens", lens, "is no Lens", "give Lens(k1, k2, p1, p2, k3), or leave it out")
    if not lens.one_to_one(0.5 * camera.width / camera.focal, 0.5 * camera.height / camera.focal):
        raise bad_input(
            "camera",
            "lens",
            ", ".join(f"{name} = {getattr(lens, name):g}" for name in NAMES if getattr(lens, name)),
            f"folds the picture over itself ({camera.width} x {camera.height} pixels, fovy_deg = {camera.fovy_deg:g})",
            "take the coefficients and the angle of view of one calibration, or a narrower view",
        )


@functools.lru_cache(maxsize=8)
def _bent(camera: Pinhole) -> np.ndarray:
    """Rays of a camera with a lens: sought once, since they are the same in every picture."""
    assert camera.lens is not None
    straight = dataclasses.replace(camera, lens=None).rays()
    # Calibrations have y downwards.
    x, y = camera.lens.undistorted(straight[..., 0], -straight[..., 1])
    out = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    out.setflags(write=False)
    return out


@dataclasses.dataclass(frozen=True)
class Pose:
    """Where a camera stands and looks: position (3,) m, and rotation (3, 3) with the camera's axes as columns."""

    position: np.ndarray
    rotation: np.ndarray

    def view_matrix(self) -> Float[np.ndarray, "4 4"]:
        """World to camera coordinates: multiply column vectors from the left."""
        out = np.eye(4)
        out[:3, :3] = self.rotation.T
        out[:3, 3] = -self.rotation.T @ self.position
        return out


def look_at(position: object, target: object, up: object = (0.0, 0.0, 1.0)) -> Pose:
    """A camera at `position` that looks at `target`, both (3,) m, with `up` upwards in the picture.

    Raises:
      UserError: the two places agree, or the camera would look along `up`.
    """
    eye, to, above = (np.asarray(v, float) for v in (position, target, up))
    ahead = to - eye
    right = np.cross(ahead, above)
    # Relative to the distance: two places may be near each other and still give a direction.
    if np.linalg.norm(right) < 1e-9 * max(1.0, float(np.linalg.norm(ahead))):
        raise bad_input(
            "camera",
            "target",
            to.tolist(),
            f"gives no picture from {eye.tolist()}",
            "look elsewhere, or give another up",
        )
    # Columns right, up and back: cameras of OpenGL and MuJoCo look along their own -z.
    ahead, right = ahead / np.linalg.norm(ahead), right / np.linalg.norm(right)
    return Pose(eye, np.stack([right, np.cross(right, ahead), -ahead], axis=1))


def orbit(target: object, distance: float, azimuth_deg: float, elevation_deg: float) -> Pose:
    """A free camera around `target` (3,) m: seen from compass azimuth (clockwise from north) and elevation."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    away = np.array(
        [math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    centre = np.asarray(target, float)
    return look_at(centre + distance * away, centre)


def project(pose: Pose, camera: Pinhole, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Pixel column and row (0, 0 is the corner of the first pixel) and depth in m of points in the world."""
    seen = (np.asarray(points, float) - pose.position) @ pose.rotation
    depth = -seen[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        right, down = seen[:, 0] / depth, -seen[:, 1] / depth
        if camera.lens is not None:
            right, down = camera.lens.distorted(right, down)
        u = 0.5 * camera.width + camera.focal * right
        v = 0.5 * camera.height + camera.focal * down
    return np.stack([u, v, depth], axis=-1)
