"""A rover as the rest of the library sees it: where its MJCF lies, and which joint does what."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np


@dataclass(frozen=True)
class Wheel:
    """One wheel of a rover, its joints and its size.

    Attributes:
      corner: lf, rf, lr, rr; lm, rm (lm1, lm2, ...) between; c in place of l or r in the middle.
      body: its body in the MJCF; at zero joint angles its origin is the rim's centre, x forward, y the axle, z up.
      radius: m, without grousers.
      width: m.
      drive: joint that turns it; positive is forward.
      steer: joint that steers it, positive to the left; None if it is not steered.
      suspension: actuated joint that lowers it, positive raises the chassis; None if there is none.
    """

    corner: str
    body: str
    radius: float
    width: float
    drive: str
    steer: str | None
    suspension: str | None

    @property
    def side(self) -> str:
        """`left` or `right`; "" between the sides."""
        return {"l": "left", "r": "right"}.get(self.corner[:1], "")

    @property
    def row(self) -> str:
        """`front`, `middle` or `rear`; "" where the corner's name tells none."""
        return {"f": "front", "m": "middle", "r": "rear"}.get(self.corner[1:2], "")


@dataclass(frozen=True)
class Loop:
    """A pin that closes a kinematic loop: anchors in m, each in its body's frame."""

    body1: str
    body2: str
    anchor1: tuple[float, float, float]
    anchor2: tuple[float, float, float]


@dataclass(frozen=True)
class DriveGroup:
    """Wheels that one motor drives at one speed, such as those of a side.

    Attributes:
      name: such as left.
      joints: drive joints of its wheels.
    """

    name: str
    joints: tuple[str, ...]


@dataclass(frozen=True)
class JointGroup:
    """The actuated joints of one kind, their nominal control and their motors.

    Attributes:
      name: drive, steer or suspension.
      joints: joint (and actuator) names, in wheel order.
      mode: position, velocity, torque or current.
      position_gain: N m/rad at the joint.
      velocity_gain: N m s/rad at the joint.
      gear_ratio: motor turns per joint turn.
      gear_efficiency: fraction.
      rotor_inertia: kg m2 at the motor; the MJCF's armature is this times the squared gear ratio.
      winding: nominal voltage of the motor's winding, V.
      torque_constant: N m/A, resistance: ohm, current_limit: A; of the winding where None.
    """

    name: str
    joints: tuple[str, ...]
    mode: str
    position_gain: float
    velocity_gain: float
    gear_ratio: float
    gear_efficiency: float
    rotor_inertia: float
    winding: int
    torque_constant: float | None = None
    resistance: float | None = None
    current_limit: float | None = None


@dataclass(frozen=True, eq=False)
class Rover:
    """A rover that was converted from a URDF.

    Attributes:
      name: name of the rover and of its MJCF model.
      folder: its folder.
      mjcf: its MJCF file.
      wheels: front to rear, left before right.
      groups: drive, steer, suspension; groups without joints are absent.
      joint_limits: lower and upper limit of every hinge in rad (m for a slide), infinite if there is none.
      chassis: the base body.
      chassis_points: (k, 3) points in m, in the chassis frame, that ground can touch; at most 16.
      loops: pins that close kinematic loops.
      mass: kg.
      standing_height: m, height of the chassis frame above flat ground that the wheels just touch at zero angles.
      drive_groups: wheels that share a motor; those that are in none have a motor each.
      gravity: m/s2 that it was made for; None where its folder does not say.
      timestep: s, of its MJCF.
      notes: what the conversion assumed, reversed or left out.
    """

    name: str
    folder: Path
    mjcf: Path
    wheels: tuple[Wheel, ...]
    groups: tuple[JointGroup, ...]
    joint_limits: dict[str, tuple[float, float]]
    chassis: str
    chassis_points: np.ndarray
    loops: tuple[Loop, ...]
    mass: float
    standing_height: float
    notes: tuple[str, ...] = ()
    drive_groups: tuple[DriveGroup, ...] = ()
    gravity: float | None = None
    timestep: float = 0.002

    @property
    def joints(self) -> tuple[str, ...]:
        """Actuated joints (and actuators) in the order of the controls: drive, steer, suspension."""
        # One order for controls, telemetry and parameters by joint: nothing in the package keeps another.
        return tuple(joint for group in self.groups for joint in group.joints)

    @property
    def assumed(self) -> tuple[str, ...]:
        """Notes of motors and gears that nobody stated and `convert` assumed; each begins with its joint group."""
        return tuple(note for note in self.notes if ": assumed " in note)

    def group(self, name: str) -> JointGroup | None:
        """The group called `name`, or None if the rover has no such joints."""
        return next((g for g in self.groups if g.name == name), None)

    def wheels_per_motor(self, joint: str) -> int:
        """How many wheels the motor of a joint drives."""
        return next((len(g.joints) for g in self.drive_groups if joint in g.joints), 1)

    def spec(self) -> mujoco.MjSpec:
        """A fresh `MjSpec` of the rover, free to be edited."""
        # Read anew each time: an edited spec must not reach the next caller.
        return mujoco.MjSpec.from_file(str(self.mjcf))

    def compile(self) -> mujoco.MjModel:
        """The compiled model."""
        return self.spec().compile()
