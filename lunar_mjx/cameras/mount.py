"""Where a rover carries its front camera."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from lunar_mjx.cameras.pinhole import Pose
from lunar_mjx.rover import Rover


@dataclasses.dataclass(frozen=True)
class FrontMount:
    """Where the front camera sits unless a rover says so itself: a choice."""

    pitch_deg: float = 15.0
    """How far the front camera looks down."""
    before: float = 0.03
    """Distance before the highest part of the rover, m, so that it does not look into itself."""


FRONT_MOUNT = FrontMount()


def front_mount(rover: Rover, pitch_deg: float = FRONT_MOUNT.pitch_deg) -> Pose:
    """Pose of the front camera in the chassis frame: at the front of the rover's highest part, looking ahead and down.

    On both shipped rovers that is the head of the mast.
    """
    points = np.asarray(rover.chassis_points, float)
    top = points[points[:, 2] > points[:, 2].max() - 0.02]
    position = np.array([top[:, 0].max() + FRONT_MOUNT.before, top[:, 1].mean(), top[:, 2].max() - 0.02])
    return Pose(position, facing(pitch_deg))


def facing(pitch_deg: float, yaw_deg: float = 0.0) -> np.ndarray:
    """Rotation (3, 3) of a camera that looks along the body's x axis, turned left by yaw and down by pitch."""
    p, y = math.radians(pitch_deg), math.radians(yaw_deg)
    ahead = np.array([math.cos(p) * math.cos(y), math.cos(p) * math.sin(y), -math.sin(p)])
    right = np.array([math.sin(y), -math.cos(y), 0.0])
    return np.stack([right, np.cross(right, ahead), -ahead], axis=1)


def carried(mount: Pose, position: np.ndarray, rotation: np.ndarray) -> Pose:
    """The pose in the world of a mounted camera: `position` (3,) m and `rotation` (3, 3) of the chassis frame."""
    return Pose(position + rotation @ mount.position, rotation @ mount.rotation)
