"""What observations and rewards see of a batch of rovers: poses, rates and joints, read from the physics' state."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from lunar_mjx.dynamics import State, System
from lunar_mjx.envs.navigation.kalman import KalmanState
from lunar_mjx.pytree import pytree
from lunar_mjx.terrain import Terrain, surface


@dataclasses.dataclass(frozen=True)
class ViewSizes:
    """What a rover sees and remembers of its surroundings."""

    scan_ahead: tuple[float, ...] = (-1.0, -0.7, -0.35, 0.0, 0.35, 0.65, 0.95, 1.25, 1.6, 2.0, 2.5, 3.1, 3.8)
    scan_aside: tuple[float, ...] = (-1.6, -1.1, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.1, 1.6)
    """Places of the height scan relative to the rover, m, along and across its heading; times `SCAN_SCALE`."""
    far_scan: float = 2.5
    """What the far scan's pattern is larger by: places 9.5 m ahead and 4 m aside."""
    scan_reach: float = 0.2
    """Radius of the cell about each place, m, times `SCAN_SCALE`: the scan keeps the highest rock within it, as
    elevation maps do. Without it the smallest rocks, 0.25 m wide, slip between the places and end up under the
    chassis."""
    trail: tuple[float, float, float] = (4.0, 15.0, 60.0)
    """Time constants of the means of past positions, s: a few metres, a yard, and the way into it."""
    # m between the places that a rover remembers to have been at, and how many it remembers.
    visited_apart: float = 2.0
    visited_kept: int = 32
    visited_grid: tuple[float, ...] = (-8.0, -4.0, 0.0, 4.0, 8.0)
    """m along and across the heading at which the memory is looked up."""
    nowhere: float = 1e4
    """m; coordinates of places not yet visited."""


VIEW = ViewSizes()

SCAN_SCALE = {"viper": 1.6}
"""Larger rovers look farther."""


@pytree
class View:
    """A batch of rovers after a step; world frame unless said otherwise, SI units.

    Attributes:
      position, velocity, angular_velocity: of the chassis frame.
      roll, pitch, yaw: rad.
      up: body z axis in the world. world_up: the world's z axis in the body frame.
      body_velocity, body_rates: along the body's axes.
      joint_angle, joint_speed: actuated joints in the order of the controls.
      winding_temperature: K.
      slip, sinkage: of every wheel in the last physics step, eq. 8 and m.
      origin: start of the episode: where positions are counted from.
      goal: horizontal, m.
      filtered: the Kalman filter's estimates.
      last_action: in [-1, 1].
      waited: time since the rover left the place that it is said to be stuck at, s.
      qpos: coordinates of the rover's MJCF.
      arrival: heading to arrive in, rad; None where any will do.
      corners: south-western and north-eastern corner of the world that the rover must not leave, (env, 2, 2) m.
      visited: places where it has been, newest first, (env, place, 2) m, far away where there is none yet; None unless
        they are observed.
      charge: of the battery above that at which it cuts the motors off, 0 to 1; None without one.
      trail: where the rover was, averaged over the `VIEW.trail` times, m; None unless it is observed.
      drift: believed less true horizontal position, m; None where odometry is exact.
      plan: where to aim and the next nodes of the way on the rover's own map, x and y from the rover along the world's
        axes, m, and the cost of that way, m; (env, 2 + 2 * node + 1), None unless it is observed.
    """

    position: Float[Array, "env 3"]
    velocity: Float[Array, "env 3"]
    angular_velocity: Float[Array, "env 3"]
    roll: Float[Array, "env"]
    pitch: Float[Array, "env"]
    yaw: Float[Array, "env"]
    up: Float[Array, "env 3"]
    world_up: Float[Array, "env 3"]
    body_velocity: Float[Array, "env 3"]
    body_rates: Float[Array, "env 3"]
    joint_angle: Float[Array, "env joint"]
    joint_speed: Float[Array, "env joint"]
    winding_temperature: Float[Array, "env joint"]
    slip: Float[Array, "env wheel"]
    sinkage: Float[Array, "env wheel"]
    origin: Float[Array, "env 3"]
    goal: Float[Array, "env 2"]
    filtered: KalmanState
    last_action: Float[Array, "env action"]
    waited: Float[Array, "env"]
    qpos: Float[Array, "env nq"]
    arrival: Any = None
    corners: Any = None
    visited: Any = None
    charge: Any = None
    trail: Any = None
    plan: Any = None
    drift: Any = None

    @property
    def believed(self) -> Any:
        """(env, 2) horizontal position as odometry tells it, m."""
        return self.position[:, :2] if self.drift is None else self.position[:, :2] + self.drift


def rotation(quaternion: Float[Array, "env 4"]) -> Float[Array, "env 3 3"]:
    """Rotation matrices, body to world."""
    # Made a unit first: the engine's drifts by rounding between its own corrections.
    q = quaternion / jnp.sqrt(jnp.sum(quaternion * quaternion, axis=-1, keepdims=True))
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


class Reader:
    """Reads a `View` from the physics' state of a system."""

    def __init__(self, system: System):
        model = system.engine.mj_model
        joints = [model.joint(name) for name in system.joint_names]
        # Positions and velocities of a free body differ in number, so each has its own places.
        self._qpos = [int(j.qposadr[0]) for j in joints]
        self._qvel = [int(j.dofadr[0]) for j in joints]

    def pose(self, physics: State) -> dict[str, Any]:
        """The fields of `View` that the physics' state alone gives."""
        matrix = rotation(physics.qpos[:, 3:7])
        velocity, rates = physics.qvel[:, :3], physics.qvel[:, 3:6]
        return {
            "position": physics.qpos[:, :3],
            "velocity": velocity,
            # MuJoCo gives a free body's rates in its own axes, its velocity in the world's.
            "angular_velocity": _turn(matrix, rates),
            "roll": jnp.arctan2(matrix[:, 2, 1], matrix[:, 2, 2]),
            # Clipped, since rounding may pass 1 by a digit, where the arc sine is no number.
            "pitch": jnp.arcsin(jnp.clip(-matrix[:, 2, 0], -1.0, 1.0)),
            "yaw": jnp.arctan2(matrix[:, 1, 0], matrix[:, 0, 0]),
            "up": matrix[:, :, 2],
            "world_up": matrix[:, 2, :],
            "body_velocity": _turn(jnp.swapaxes(matrix, 1, 2), velocity),
            "body_rates": rates,
            "joint_angle": physics.qpos[:, self._qpos],
            "joint_speed": physics.qvel[:, self._qvel],
            "winding_temperature": physics.temperature.winding_kelvin,
            "qpos": physics.qpos,
        }


def _turn(matrix: Any, vector: Any) -> Any:
    # elementwise: a batched dot of 3 x 3 would be a library call on a GPU
    return jnp.sum(matrix * vector[:, None, :], axis=-1)


def scan_places(view: View, scale: float) -> tuple[Float[Array, "env point"], Float[Array, "env point"]]:
    """Places of the pattern `VIEW.scan_ahead` x `VIEW.scan_aside` around the rover, times `scale`, m."""
    ahead, aside = jnp.meshgrid(jnp.asarray(VIEW.scan_ahead), jnp.asarray(VIEW.scan_aside), indexing="ij")
    ahead, aside = scale * ahead.reshape(-1), scale * aside.reshape(-1)
    cos, sin = jnp.cos(view.yaw)[:, None], jnp.sin(view.yaw)[:, None]
    return (
        view.position[:, 0, None] + cos * ahead - sin * aside,
        view.position[:, 1, None] + sin * ahead + cos * aside,
    )


def height_scan(terrain: Terrain, view: View, scale: float, ride: float) -> Float[Array, "env point"]:
    """Height of the surface around the rover over the plane its wheels would stand on if it were level, m.

    Rocks count with their highest point within `VIEW.scan_reach` of each place.

    Args:
      terrain: one for all.
      view: the rovers.
      scale: of the pattern `VIEW.scan_ahead` x `VIEW.scan_aside`.
      ride: height of the chassis frame over the ground when standing, m.
    """
    x, y = scan_places(view, scale)
    return surface(terrain, x, y, scale * VIEW.scan_reach) - (view.position[:, 2, None] - ride)


def goal_in_body(view: View) -> Float[Array, "env 2"]:
    """Horizontal vector to the goal along and across the heading, as odometry tells it, m."""
    to_goal = view.goal - view.believed
    cos, sin = jnp.cos(view.yaw), jnp.sin(view.yaw)
    return jnp.stack([cos * to_goal[:, 0] + sin * to_goal[:, 1], cos * to_goal[:, 1] - sin * to_goal[:, 0]], axis=-1)


def read(reader: Reader, physics: State, **rest: Any) -> View:
    """A `View` of the physics' state and of what the task adds."""
    return View(**reader.pose(physics), **rest)
