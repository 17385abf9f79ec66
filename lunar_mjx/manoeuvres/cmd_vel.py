"""From a wanted motion of the chassis (ROS's `cmd_vel`) to steering angles and wheel speeds, within the rover's limits.

One kinematic rule serves Ackermann steering, crabbing and turning on the spot: a chassis that moves at (v_x, v_y) and
turns at omega carries the wheel at (x, y) with (v_x - omega y, v_y + omega x). A steered wheel turns into that
direction (backward driving counts, so that no angle passes 90 degrees) and rolls at its part along the wheel. Wheels
that do not steer roll at their part along x and scrub the rest: with no steering at all that is skid steering.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.kinematics import wheel_feet
from lunar_mjx.effects.joint.motor import WINDINGS
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.model import Model
from lunar_mjx.simulate import Commands, constant_commands


@dataclasses.dataclass(frozen=True)
class TwistLimits:
    """Between which speeds a command of a rover's motion is taken up."""

    still: float = 1e-9
    """m/s; a wheel that is to move slower keeps its steering at zero."""
    fastest: float = 10.0
    """m/s and rad/s: no rover moves or turns faster."""


TWIST_LIMITS = TwistLimits()


class CmdVel:
    """A command layer of one rover: call it with the wanted motion, get the controls of all joints.

    Attributes:
      position: of the wheels from the point whose motion is commanded, (wheel, 2), m. That point is the chassis frame,
        or on the line of the wheels that do not steer where others do (the rear axle of a car).
      steer_limit: largest steering angle of each wheel to either side, (wheel,), rad; 0 where it does not steer.
      wheel_limit: largest rim speed, m/s.
      can_crab: whether all wheels steer, so that v_y can be followed; else it is left out.

    Args:
      model: with its drives in velocity control and its steering in position control.
      wheel_limit: largest rim speed, m/s; by default where the back-EMF reaches the nominal voltage of the winding.

    Raises:
      UserError: another control mode, or a limit that is not positive.
    """

    def __init__(self, model: Model, wheel_limit: float | None = None) -> None:
        rover = model.rover
        for group, mode in (("drive", "velocity"), ("steer", "position")):
            if rover.group(group) is not None and model.modes[group] != mode:
                raise bad_input("CmdVel", f"control.{group}.mode", model.modes[group], "is another mode", f"use {mode}")
        self.radius = np.array([w.radius for w in rover.wheels])
        self.wheel_limit = _no_load_speed(model) if wheel_limit is None else float(wheel_limit)
        if not self.wheel_limit > 0.0:
            raise bad_input("CmdVel", "wheel_limit", wheel_limit, "is not positive", "give m/s")
        compiled = rover.compile()
        bodies = np.array([compiled.body(w.body).id for w in rover.wheels])
        feet = wheel_feet(compiled, bodies, compiled.body(rover.chassis).id)[:, :2]
        self._steered = np.array([w.steer is not None for w in rover.wheels])
        self.can_crab = bool(self._steered.all())
        if self._steered.any() and not self.can_crab:
            # Wheels that do not steer can only roll straight, so a turn's centre lies on their line.
            feet = feet - np.array([feet[~self._steered, 0].mean(), 0.0])
        self.position = feet
        limits = [rover.joint_limits[w.steer] if w.steer else (0.0, 0.0) for w in rover.wheels]
        # The smaller of both sides: a rover is to turn left as it turns right.
        self.steer_limit = np.array([min(-low, high, np.pi / 2) for low, high in limits])
        self._drive = np.array([rover.joints.index(w.drive) for w in rover.wheels])
        self._steer = np.array([rover.joints.index(w.steer) if w.steer else -1 for w in rover.wheels])
        self._joints = len(rover.joints)

    def __call__(self, v_x: Any, v_y: Any = 0.0, yaw_rate: Any = 0.0) -> Any:
        """Controls for a wanted motion; pure, so that it composes with `jit`, `vmap` and `scan`.

        What the rover cannot do is bounded: a curve tighter than the steering allows becomes the tightest one, a
        direction of crabbing the nearest one, on the spot the wheels scrub; and all wheels slow down alike where one
        would pass `wheel_limit`.

        Args:
          v_x, v_y: forward and to the left, m/s. yaw_rate: to the left, rad/s. Numbers or scalars of JAX.

        Returns:
          (joint,) wheel speeds, rad/s, and steering angles, rad, in the order of the controls; suspension zero.
        """
        v_x, yaw_rate = jnp.asarray(v_x, float), jnp.asarray(yaw_rate, float)
        v_y = jnp.asarray(v_y, float) if self.can_crab else jnp.zeros_like(v_x)
        x, y = jnp.asarray(self.position[:, 0], float), jnp.asarray(self.position[:, 1], float)
        limit = jnp.asarray(self.steer_limit, float)
        yaw_rate = self._tightest(v_x, v_y, yaw_rate, x, y, limit)
        along, across = v_x - yaw_rate * y, v_y + yaw_rate * x
        angle = jnp.clip(_angle(along, across), -limit, limit)
        # With the angle that it got, not the one that it would need: what is across the wheel scrubs.
        speed = along * jnp.cos(angle) + across * jnp.sin(angle)
        # All alike: the path stays, only the time that it takes changes.
        speed = speed / jnp.maximum(jnp.max(jnp.abs(speed)) / self.wheel_limit, 1.0)
        control = jnp.zeros(self._joints).at[self._drive].set(speed / jnp.asarray(self.radius, float))
        if not self._steered.any():
            return control
        return control.at[self._steer[self._steered]].set(angle[self._steered])

    def _tightest(self, v_x: Any, v_y: Any, yaw_rate: Any, x: Any, y: Any, limit: Any) -> Any:
        """The yaw rate, bounded where a wheel of a car-like turn would need more than its steering limit.

        |omega x| <= tan(delta) (|v_x| - |omega| y') for every steered wheel, y' its place towards the turn's centre.
        """
        needed = jnp.abs(_angle(v_x - yaw_rate * y, v_y + yaw_rate * x))
        exceeds = jnp.any(jnp.where(self._steered, needed > limit, False))
        inward = jnp.sign(yaw_rate) * jnp.where(v_x < 0.0, -1.0, 1.0) * y
        per_rate = jnp.abs(x) / jnp.maximum(jnp.tan(limit), TWIST_LIMITS.still) + inward
        bound = jnp.abs(v_x) / jnp.maximum(
            jnp.max(jnp.where(self._steered, per_rate, TWIST_LIMITS.still)), TWIST_LIMITS.still
        )
        # Not for crabbing or a turn on the spot: there the limit is no bound on the yaw rate.
        car = (jnp.abs(v_x) > TWIST_LIMITS.still) & (jnp.abs(v_y) <= TWIST_LIMITS.still)
        return jnp.where(car & exceeds, jnp.clip(yaw_rate, -bound, bound), yaw_rate)


def _angle(along: Any, across: Any) -> Any:
    """Steering angle of a wheel that moves so, within 90 degrees, rad; 0 for one that stands."""
    way = jnp.where(along < 0.0, -1.0, 1.0)
    moving = jnp.abs(along) + jnp.abs(across) > TWIST_LIMITS.still
    # The inner choice keeps the derivative finite at rest, where arctan2(0, 0) has none.
    return jnp.where(moving, jnp.arctan2(way * across, jnp.where(moving, jnp.abs(along), 1.0)), 0.0)


def _no_load_speed(model: Model) -> float:
    """Rim speed at which the slowest drive's back-EMF reaches the nominal voltage of its winding, m/s."""
    group = model.rover.group("drive")
    assert group is not None  # every rover has driven wheels
    motor = model.parameters.get("motor", {})
    ratio = np.atleast_1d(np.asarray(motor.get("gear_ratio", group.gear_ratio), float))
    constant = np.atleast_1d(
        np.asarray(motor.get("torque_constant", WINDINGS[group.winding]["torque_constant"]), float)
    )
    drives = [model.rover.joints.index(j) for j in group.joints]
    per_speed = np.broadcast_to(ratio * constant, max(len(model.rover.joints), ratio.size))[drives]
    # The smallest wheel and the largest product of gear and constant: a speed that every wheel reaches.
    radius = min(w.radius for w in model.rover.wheels)
    return float(group.winding / per_speed.max() * radius)


def cmd_vel_commands(model: Model, wanted: str, duration: float) -> Commands:
    """Commands that hold one motion, given as "v_x,v_y,yaw_rate" in m/s and rad/s.

    Raises:
      UserError: the text is not three finite numbers, or the model's control modes do not suit.
    """
    parts = wanted.split(",")
    if len(parts) != 3:
        raise bad_input(
            "simulate", "--cmd-vel", wanted, "is not three numbers", "write v_x,v_y,yaw_rate as in 0.1,0,0.2"
        )
    motion = [
        require_within("simulate", "--cmd-vel", part, -TWIST_LIMITS.fastest, TWIST_LIMITS.fastest) for part in parts
    ]
    held = constant_commands(model, duration)
    return Commands(np.tile(np.asarray(CmdVel(model)(*motion)), (len(held.values), 1)), held.interval)
