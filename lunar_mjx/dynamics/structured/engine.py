"""The structured engine: exact rigid-body dynamics of a floating base with legs, as elementwise code.

A rover's mass matrix is block-arrow: legs touch the base and not each other. Kinematics and recursive Newton-Euler run
along every leg at once (arrays over the legs), the composite-rigid-body algorithm gives each leg's block, an unrolled
factorisation eliminates it, and one 6 x 6 solve gives the base (Featherstone 2008, ch. 5, 6 and 9). Planar four-bars
are closed exactly, so there is no constraint solver. Everything is in the coordinates of the chassis frame, where most
axes and offsets are constant. The derivation is in docs/structured_engine.md.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.dynamics.indexing import assemble, select
from lunar_mjx.dynamics.kinematics import Finish, Kinematics, wheel_feet
from lunar_mjx.dynamics.quaternions import integrate, normalized, rotation
from lunar_mjx.dynamics.spatial_algebra import Body, Force, Inertia, Motion, Symmetric
from lunar_mjx.dynamics.structured.legs import (
    LegState,
    cast_group,
    forward_kinematics,
    impose,
    joint_speeds,
    joint_turns,
    leg_block,
    solve,
)
from lunar_mjx.dynamics.structured.suitability import UnsuitableError, check_model
from lunar_mjx.dynamics.structured.topology import LegGroup, Structure, read_structure
from lunar_mjx.effects.ports import Forces
from lunar_mjx.pytree import pytree
from lunar_mjx.rover import Rover
from lunar_mjx.spatial import IDENTITY, ZERO, Frame, Vec3, mul


@pytree
class Pieces:
    """Positions or velocities as separate components, so that a loop over time carries no array to cut up.

    Attributes:
      base: of the free joint, numbers.
      joints: by group: for positions the turn of every link, for velocities the speeds of the independent joints, in
        the links' own sense, each of shape (leg,).
    """

    base: tuple[Any, ...]
    joints: tuple[tuple[Any, ...], ...]

    @property
    def dtype(self) -> Any:
        """Float type of the whole step."""
        return self.base[0].dtype


class Base(NamedTuple):
    """The chassis: pose and velocity in the world, and its spatial velocity in its own frame."""

    position: Vec3
    quaternion: list[Any]
    frame: Frame
    velocity: Vec3
    motion: Motion


class StructuredEngine:
    """Rigid-body dynamics of one rover with legs: `forward` gives the kinematics and a function that ends the step.

    Raises:
      UnsuitableError: the rover has something that this engine cannot honour exactly.
    """

    name = "structured"

    def __init__(self, rover: Rover):
        model = rover.compile()
        check_model(model, str(rover.mjcf))
        self.mj_model = model
        self.nq, self.nv = model.nq, model.nv
        self.qpos0 = np.array(model.qpos0)
        wheels = np.array([model.body(wheel.body).id for wheel in rover.wheels])
        axles = np.array([model.jnt_axis[model.joint(wheel.drive).id] for wheel in rover.wheels])
        chassis = model.body(rover.chassis).id
        joints = [model.joint(name).id for name in rover.joints]
        self.structure: Structure = read_structure(model, chassis, wheels.tolist(), axles, joints, str(rover.mjcf))
        self.wheel_feet = wheel_feet(model, wheels, chassis)
        self._joints = len(joints)

    def forward(self, params: Any, qpos: Any, qvel: Any, dt: Any) -> tuple[Kinematics, Finish]:
        """Kinematics at (qpos, qvel), and a function from forces to the next (qpos, qvel).

        The dependent joints of loops are computed from the independent ones; their entries in `qpos` and `qvel` are
        not read.

        Args:
          params: gravity, and the motors' rotor inertia where there are motors.
          qpos, qvel: MuJoCo's coordinates of shapes (nq,) and (nv,), or both as `split` gives them.
          dt: time step, s.
        """
        # Loops over steps carry the pieces: joining and splitting them at each step would cost trigonometry.
        whole = not isinstance(qpos, Pieces)
        if whole:
            qpos, qvel = self.split(qpos, qvel)
        numbers, legs, base = self._kinematic_state(qpos, qvel)

        def finish(forces: Forces) -> tuple[Any, Any]:
            new = self._finish(params, numbers, legs, base, forces, dt)
            return self.join(*new) if whole else new

        return self._kinematics(numbers, legs, base), finish

    def _kinematic_state(self, qpos: Pieces, qvel: Pieces) -> tuple[list[LegGroup], list[LegState], Base]:
        """The legs' numbers in the state's type, what their forward pass leaves, and the chassis."""
        numbers = [cast_group(group, qpos.dtype) for group in self.structure.groups]
        position, velocity = Vec3(*qpos.base[:3]), Vec3(*qvel.base[:3])
        # A state that was set by hand, or stepped in float32, is of unit length only about.
        quaternion = normalized(list(qpos.base[3:]))
        frame = rotation(quaternion)
        base = Base(position, quaternion, frame, velocity, Motion(Vec3(*qvel.base[3:]), frame.from_world(velocity)))
        legs = [
            forward_kinematics(n, base.motion, angle, speed)
            for n, angle, speed in zip(numbers, qpos.joints, qvel.joints, strict=True)
        ]
        return numbers, legs, base

    def split(self, qpos: Float[Array, "nq"], qvel: Float[Array, "nv"]) -> tuple[Pieces, Pieces]:
        """The coordinates as the pieces that the engine computes with; dependent joints are left out."""
        p, v = self.structure.free_qpos, self.structure.free_dof
        groups = self.structure.groups
        numbers = [cast_group(g, qpos.dtype) for g in groups]
        turns = tuple(
            joint_turns(n, [mul(n.links[k].numbers.sign, select(qpos, n.links[k].qpos)) for k in n.free])
            for n in numbers
        )
        speeds = tuple(
            tuple(mul(n.links[k].numbers.sign, select(qvel, n.links[k].dof)) for k in n.free) for n in numbers
        )
        return (
            Pieces(tuple(qpos[p + i] for i in range(7)), turns),
            Pieces(tuple(qvel[v + i] for i in range(6)), speeds),
        )

    def join(self, qpos: Pieces, qvel: Pieces) -> tuple[Float[Array, "nq"], Float[Array, "nv"]]:
        """MuJoCo's coordinates from the pieces, with the dependent joints of loops."""
        positions, speeds = [jnp.stack(qpos.base)], [jnp.stack(qvel.base)]
        at_q, at_v = [self.structure.free_qpos + np.arange(7)], [self.structure.free_dof + np.arange(6)]
        for group, q, w in zip(self.structure.groups, qpos.joints, qvel.joints, strict=True):
            n = cast_group(group, qpos.dtype)
            speed, _, _ = joint_speeds(n, q, w)
            for k, link in enumerate(n.links):
                positions.append(_over_legs(mul(link.numbers.sign, q[k].angle), n.count))
                speeds.append(_over_legs(mul(link.numbers.sign, speed[k]), n.count))
                at_q.append(link.qpos)
                at_v.append(link.dof)
        return assemble(positions, at_q), assemble(speeds, at_v)

    def _kinematics(self, numbers: list[LegGroup], legs: list[LegState], base: Base) -> Kinematics:
        angles, speeds, drives = [], [], []
        for group, leg in zip(numbers, legs, strict=True):
            for k, link in enumerate(group.links):
                if link.actuated is not None:
                    angles.append(_over_legs(mul(link.numbers.sign, leg.angle[k]), group.count))
                    speeds.append(_over_legs(mul(link.numbers.sign, leg.speed[k]), group.count))
                    drives.append(link.actuated)
        places, axles, travels, spins, order = [], [], [], [], []
        for group, leg in zip(numbers, legs, strict=True):
            for slot in group.wheels:
                link = leg.links[slot.link]
                at = link.origin + link.frame.to_world(slot.numbers.center)
                moving = link.velocity.linear + link.velocity.angular.cross(at)
                vectors = at, link.frame.to_world(slot.numbers.axle), moving, link.velocity.angular
                for into, vector in zip((places, axles, travels, spins), vectors, strict=True):
                    into.append([_over_legs(c, group.count) for c in base.frame.to_world(vector)])
                order.append(slot.index)

        def of_wheels(pieces: list[list[Any]]) -> Vec3:
            return Vec3(*(assemble([piece[i] for piece in pieces], order) for i in range(3)))

        return Kinematics(
            position=base.position,
            quaternion=jnp.stack(base.quaternion),
            frame=base.frame,
            velocity=base.velocity,
            angular_velocity=base.frame.to_world(base.motion.angular),
            joint_angle=assemble(angles, drives),
            joint_speed=assemble(speeds, drives),
            wheel_position=of_wheels(places) + base.position,
            wheel_axle=of_wheels(axles),
            wheel_velocity=of_wheels(travels),
            wheel_angular_velocity=of_wheels(spins),
        )

    def forward_imposed(self, params: Any, qpos: Pieces, qvel: Pieces, dt: Any) -> tuple[Kinematics, Any]:
        """Kinematics, and a function from forces and imposed joint accelerations to the next state and the torques.

        The joints' motion is given, the base is free: torques come out instead of going in.

        Args:
          params, qpos, qvel, dt: as for `forward`, the coordinates as `split` gives them.

        Returns:
          The kinematics, and `finish(forces, joint_acceleration, up)` with accelerations of the actuated joints,
          (joint,), rad/s2, and the specific force of gravity in the chassis frame, m/s2 (at rest on level ground
          (0, 0, g)); it returns positions, velocities, the actuators' torques (joint,), N m, and the acceleration of
          the chassis frame's origin in its own frame, m/s2.

        Raises:
          UnsuitableError: a leg has more joints than its wheel's.
        """
        # a suspension would move freely, and `impose` takes the motion of every joint as given
        if any(len(g.links) != 1 or g.links[0].actuated is None for g in self.structure.groups):
            raise UnsuitableError("imposed motion needs a rover whose wheels' drives are its only joints.")
        numbers, legs, base = self._kinematic_state(qpos, qvel)

        def finish(forces: Forces, joint_acceleration: Any, up: Vec3) -> tuple[Pieces, Pieces, Any, Vec3]:
            return self._finish_imposed(params, numbers, legs, base, forces, joint_acceleration, up, dt)

        return self._kinematics(numbers, legs, base), finish

    def _finish_imposed(
        self,
        params: Any,
        numbers: list[LegGroup],
        legs: list[LegState],
        base: Base,
        forces: Forces,
        joint_acceleration: Any,
        up: Vec3,
        dt: Any,
    ) -> tuple[Pieces, Pieces, Any, Vec3]:
        dtype = forces.joint_torque.dtype
        armature = _reflected_inertia(params, self._joints, dtype)
        # The motors' torques are what is sought: those that the effects ask for must not act beside them.
        unpowered = dataclasses.replace(forces, joint_torque=jnp.zeros_like(forces.joint_torque))
        blocks = [
            leg_block(n, leg, up, unpowered, base.frame, armature, dt) for n, leg in zip(numbers, legs, strict=True)
        ]
        drives = [n.links[0].actuated for n in numbers]
        places: list[np.ndarray] = [at for at in drives if at is not None]
        rates = [
            mul(n.links[0].numbers.sign, select(joint_acceleration, at)) for n, at in zip(numbers, places, strict=True)
        ]
        acceleration, torques = impose(*self._chassis(base, forces, up), blocks, rates)
        stepped = self._integrate(numbers, legs, base, acceleration, [[rate] for rate in rates], dt)
        signed = [_over_legs(mul(n.links[0].numbers.sign, t), n.count) for n, t in zip(numbers, torques, strict=True)]
        linear = acceleration.linear + base.motion.angular.cross(base.motion.linear)
        return *stepped, assemble(signed, places), linear

    def _finish(
        self, params: Any, numbers: list[LegGroup], legs: list[LegState], base: Base, forces: Forces, dt: Any
    ) -> tuple[Pieces, Pieces]:
        """Accelerations from the forces, and a step of semi-implicit Euler."""
        dtype, frame = forces.joint_torque.dtype, base.frame
        gravity = params.gravity if forces.geometry.gravity is None else forces.geometry.gravity
        up = frame.from_world(Vec3(0.0, 0.0, jnp.asarray(gravity, dtype)))
        armature = _reflected_inertia(params, self._joints, dtype)
        blocks = [
            leg_block(group, leg, up, forces, frame, armature, dt) for group, leg in zip(numbers, legs, strict=True)
        ]
        acceleration, rates = solve(*self._chassis(base, forces, up), blocks, self.structure.couplings)
        return self._integrate(numbers, legs, base, acceleration, rates, dt)

    def _chassis(self, base: Base, forces: Forces, up: Vec3) -> tuple[Inertia, Force]:
        """The chassis' inertia, and the force that it needs to move as it does."""
        chassis, motion = _chassis_inertia(self.structure.base, forces), base.motion
        moment, push = forces.chassis_moment, forces.chassis_force
        applied = Force(base.frame.from_world(moment), base.frame.from_world(push))
        return chassis, chassis.apply(Motion(ZERO, up)) + motion.cross_force(chassis.apply(motion)) - applied

    def _integrate(
        self,
        numbers: list[LegGroup],
        legs: list[LegState],
        base: Base,
        acceleration: Motion,
        rates: list[list[Any]],
        dt: Any,
    ) -> tuple[Pieces, Pieces]:
        """A step of semi-implicit Euler."""
        frame, motion = base.frame, base.motion
        # the classical acceleration of the chassis frame's origin
        linear = acceleration.linear + motion.angular.cross(motion.linear)
        velocity = base.velocity + frame.to_world(linear) * dt
        spin = motion.angular + acceleration.angular * dt
        # with the new velocity (semi-implicit): with the old one contacts would gain energy
        position = base.position + velocity * dt
        quaternion = integrate(base.quaternion, spin, dt)
        speeds = [
            [leg.speed[k] + dt * r for k, r in zip(n.free, rate, strict=True)]
            for n, leg, rate in zip(numbers, legs, rates, strict=True)
        ]
        # before the angles are stepped, which are stepped with these
        speeds = self._coupled(speeds)
        free = [
            [leg.angle[k] + dt * w for k, w in zip(n.free, speed, strict=True)]
            for n, leg, speed in zip(numbers, legs, speeds, strict=True)
        ]
        angles = [joint_turns(n, angle) for n, angle in zip(numbers, self._coupled(free), strict=True)]
        speeds = [tuple(speed) for speed in speeds]
        # Angles travel as turns, with cosine and sine: the next step needs them, and a loop keeps what it carries.
        return Pieces((*position, *quaternion), tuple(angles)), Pieces((*velocity, *spin), tuple(speeds))

    def _coupled(self, values: list[list[Any]]) -> list[list[Any]]:
        """Angles or speeds by group and independent joint, with those of followers taken from their leaders.

        The accelerations agree already; what this takes away is the rounding that would add up over a drive.
        """
        for coupling in self.structure.couplings:
            follower, leader = coupling.follower, coupling.leader
            led = jnp.sum(jnp.where(leader.leg, values[leader.group][leader.free], 0.0))
            factor = coupling.multiplier * leader.sign * follower.sign
            own = values[follower.group][follower.free]
            values[follower.group][follower.free] = jnp.where(follower.leg, factor * led, own)
        return values


def _reflected_inertia(params: Any, joints: int, dtype: Any) -> Any:
    """Rotor inertia times the square of the gear ratio at the actuated joints; None without motors."""
    motor = params.effects.get("motor")
    # A model without motors moves its joints by what effects ask; their rotors then weigh nothing.
    if motor is None:
        return None
    return motor["rotor_inertia"] * motor["gear_ratio"] ** 2 * jnp.ones(joints, dtype)


def _chassis_inertia(base: Body, forces: Forces) -> Inertia:
    """The chassis with its centre of mass shifted and a point mass on it."""
    geometry = forces.geometry
    moved = base._replace(com=base.com + Vec3(*geometry.com_offset)).at(ZERO, IDENTITY)
    place = Vec3(*geometry.payload_position)
    mass = geometry.payload_mass
    return moved + Inertia(mass, place * mass, Symmetric.of_point(mass, place))


def _over_legs(value: Any, count: int) -> Any:
    """`value` as an array with one entry per leg."""
    return jnp.broadcast_to(value, (count,)) if np.ndim(value) == 0 else value
