"""How a rover stands on the ground before it moves: the start of every run."""

from __future__ import annotations

import numpy as np

from lunar_mjx.backends.physics.ground import Ground
from lunar_mjx.backends.physics.parameters import Numbers


def stand(numbers: Numbers, ground: Ground, x: np.ndarray, y: np.ndarray, yaw: np.ndarray):
    """Pose on the plane fitted to the terrain under the wheels, none of which lies below the surface.

    Args:
      numbers: the model. ground: the terrain. x, y: m. yaw: rad; each (rover,).

    Returns:
      Position (rover, 3), m, and quaternion (rover, 4), w, x, y, z.
    """
    feet = numbers.feet
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    foot_x = x[:, None] + cos * feet[:, 0] - sin * feet[:, 1]
    foot_y = y[:, None] + sin * feet[:, 0] + cos * feet[:, 1]
    height = ground.field.value(foot_x, foot_y)[0]
    design = np.column_stack([np.ones(len(feet)), feet[:, :2]])
    # Four wheels or more rarely lie in one plane: the suspension has to take up the rest.
    fit = np.linalg.lstsq(design, height.T, rcond=None)[0]
    above = np.max(height.T - design @ fit, axis=0)
    pitch = -np.arctan(fit[1])
    # From the third column of R_y(pitch) R_x(roll), which is to be the plane's normal.
    roll = np.arctan(fit[2] * np.cos(pitch))
    quaternion = _product(_about(2, yaw), _product(_about(1, pitch), _about(0, roll)))
    w, i, j, k = quaternion.T
    up = np.stack([2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)], axis=-1)
    # The height is measured along the normal: on a slope the chassis stands off to a side.
    return np.stack([x, y, fit[0] + above], axis=-1) + numbers.standing_height * up, quaternion


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    quaternion = np.zeros((len(angle), 4))
    quaternion[:, 0], quaternion[:, 1 + axis] = np.cos(0.5 * angle), np.sin(0.5 * angle)
    return quaternion


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    w, v = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], -1, keepdims=True), np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + v], axis=-1)
