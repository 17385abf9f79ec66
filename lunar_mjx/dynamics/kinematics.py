"""What every engine tells the effects, and how it is asked to end a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from lunar_mjx.effects.ports import Forces
from lunar_mjx.spatial import Frame, Vec3


class Kinematics(NamedTuple):
    """Poses and velocities in world coordinates, as the effects see them."""

    position: Vec3
    quaternion: Any
    frame: Frame
    velocity: Vec3
    angular_velocity: Vec3
    joint_angle: Any
    joint_speed: Any
    wheel_position: Vec3
    wheel_axle: Vec3
    wheel_velocity: Vec3
    wheel_angular_velocity: Vec3


Finish = Callable[[Forces], tuple[Any, Any]]


def wheel_feet(model: mujoco.MjModel, wheels: np.ndarray, chassis: int) -> np.ndarray:
    """Wheel centres relative to the chassis frame at zero joint angles, (wheel, 3) m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return (data.xpos[wheels] - data.xpos[chassis]) @ data.xmat[chassis].reshape(3, 3)


def chassis_boxes(model: mujoco.MjModel, chassis: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounding boxes of the chassis' shapes along the axes of its frame.

    Args:
      model: compiled model.
      chassis: id of the base body.

    Returns:
      Centres and half sides, each (box, 3), m; no boxes where the chassis has no shape.
    """
    centers, halves = [], []
    for geom in np.flatnonzero(model.geom_bodyid == chassis):
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        rotation = rotation.reshape(3, 3)
        centers.append(model.geom_pos[geom] + rotation @ model.geom_aabb[geom, :3])
        # The box that holds a turned box: each half side is the sum of the projections.
        halves.append(np.abs(rotation) @ model.geom_aabb[geom, 3:])
    return np.reshape(centers, (-1, 3)), np.reshape(halves, (-1, 3))
