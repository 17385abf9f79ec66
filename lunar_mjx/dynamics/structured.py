"""The structured engine: exact rigid-body dynamics of a floating base with legs, as elementwise code.

A rover's mass matrix is block-arrow: legs touch the base and not each other. Kinematics and recursive Newton-Euler run
along every leg at once (arrays over the legs), the composite-rigid-body algorithm gives each leg's block, an unrolled
factorisation eliminates it, and one 6 x 6 solve gives the base (Featherstone 2008, ch. 5, 6 and 9). Planar four-bars
are closed exactly, so there is no constraint solver. Everything is in the coordinates of the chassis frame, where most
axes and offsets are constant. The derivation is in docs/structured_engine.md.
"""

# MuJoCo ships no type stubs for its compiled module.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.dynamics.indexing import assemble, select
from lunar_mjx.dynamics.kinematics import Finish, Kinematics, wheel_feet
from lunar_mjx.dynamics.ports import Forces
from lunar_mjx.dynamics.quaternions import integrate, normalized, rotation
from lunar_mjx.dynamics.spatial_algebra import (
    IDENTITY,
    ZERO,
    Body,
    Force,
    Inertia,
    Motion,
    Rotation,
    Symmetric,
    Vector,
    add,
    mul,
    neg,
    solve_positive,
    sub,
    total,
)
from lunar_mjx.dynamics.suitability import check_model
from lunar_mjx.dynamics.topology import CHASSIS, LegGroup, Structure, read_structure
from lunar_mjx.pytree import pytree
from lunar_mjx.rover import Rover
from lunar_mjx.spatial import Frame, Vec3

STILL = Motion(ZERO, ZERO)


class Turn(NamedTuple):
    """A joint's angle, rad, with its cosine and sine: carried along, so that no kernel computes them again."""

    angle: Any
    cos: Any
    sin: Any


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
        return self.base[0].dtype


class Base(NamedTuple):
    """The chassis: pose and velocity in the world, and its spatial velocity in its own frame."""

    position: Vector
    quaternion: list[Any]
    frame: Rotation
    velocity: Vector
    motion: Motion


class LinkState(NamedTuple):
    """A link in the chassis frame's coordinates, for every leg of a group."""

    origin: Vector
    frame: Rotation
    subspace: Motion
    velocity: Motion
    bias: Motion


class LegState(NamedTuple):
    """What the forward pass leaves for the backward pass.

    Attributes:
      angle, speed: of every joint in the link's own sense, rad, rad/s.
      gain: speeds of all joints per speed of the joint that moves them; 1 for independent joints.
      drift: accelerations at zero independent accelerations, rad/s2.
      links: of every joint.
    """

    angle: list[Any]
    speed: list[Any]
    gain: list[Any]
    drift: list[Any]
    links: list[LinkState]


class LegBlock(NamedTuple):
    """A leg's part of the equation of motion: H u' + F^T a_0 = tau, and what it hangs on the base."""

    mass_matrix: list[list[Any]]
    coupling: list[list[Any]]
    torque: list[Any]
    inertia: Inertia
    force: Force


class StructuredEngine:
    """Rigid-body dynamics of one rover with legs: `forward` gives the kinematics and a function that ends the step.

    Raises:
      UnsuitableError: the rover has something that this engine cannot honour exactly.
    """

    name = "structured"

    def __init__(self, rover: Rover, timestep: float):
        model = rover.compile()
        model.opt.timestep = timestep
        check_model(model, str(rover.mjcf))
        self.mj_model = model
        self.nq, self.nv = model.nq, model.nv
        self.qpos0 = np.array(model.qpos0)
        self.timestep = timestep
        wheels = np.array([model.body(wheel.body).id for wheel in rover.wheels])
        axles = np.array([model.jnt_axis[model.joint(wheel.drive).id] for wheel in rover.wheels])
        chassis = model.body(rover.chassis).id
        joints = [model.joint(name).id for name in rover.joints]
        self.structure: Structure = read_structure(model, chassis, wheels.tolist(), axles, joints, str(rover.mjcf))
        self.wheel_feet = wheel_feet(model, wheels, chassis)
        self._joints = len(joints)

    def forward(self, params: Any, qpos: Any, qvel: Any) -> tuple[Kinematics, Finish]:
        """Kinematics at (qpos, qvel), and a function from forces to the next (qpos, qvel).

        The dependent joints of loops are computed from the independent ones; their entries in `qpos` and `qvel` are
        not read.

        Args:
          params: gravity, and the motors' rotor inertia where there are motors.
          qpos, qvel: MuJoCo's coordinates of shapes (nq,) and (nv,), or both as `split` gives them.
        """
        whole = not isinstance(qpos, Pieces)
        if whole:
            qpos, qvel = self.split(qpos, qvel)
        numbers = [_cast_group(group, qpos.dtype) for group in self.structure.groups]
        position, velocity = Vector(*qpos.base[:3]), Vector(*qvel.base[:3])
        quaternion = normalized(list(qpos.base[3:]))
        frame = rotation(quaternion)
        base = Base(position, quaternion, frame, velocity, Motion(Vector(*qvel.base[3:]), frame.undo(velocity)))
        legs = [
            _forward(n, base.motion, angle, speed)
            for n, angle, speed in zip(numbers, qpos.joints, qvel.joints, strict=True)
        ]

        def finish(forces: Forces) -> tuple[Any, Any]:
            new = self._finish(params, numbers, legs, base, forces)
            return self.join(*new) if whole else new

        return self._kinematics(numbers, legs, base), finish

    def split(self, qpos: Float[Array, "nq"], qvel: Float[Array, "nv"]) -> tuple[Pieces, Pieces]:
        """The coordinates as the pieces that the engine computes with; dependent joints are left out."""
        p, v = self.structure.free_qpos, self.structure.free_dof
        groups = self.structure.groups
        numbers = [_cast_group(g, qpos.dtype) for g in groups]
        turns = tuple(
            _turns(n, [mul(n.links[k].numbers.sign, select(qpos, n.links[k].qpos)) for k in n.free]) for n in numbers
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
            n = _cast_group(group, qpos.dtype)
            speed, _, _ = _speeds(n, q, w)
            for k, link in enumerate(n.links):
                positions.append(_over_legs(mul(link.numbers.sign, q[k].angle), n.count))
                speeds.append(_over_legs(mul(link.numbers.sign, speed[k]), n.count))
                at_q.append(link.qpos)
                at_v.append(link.dof)
        return assemble(positions, at_q), assemble(speeds, at_v)

    def _kinematics(
        self,
        numbers: list[LegGroup],
        legs: list[LegState],
        base: Base,
    ) -> Kinematics:
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
                at = link.origin + link.frame.apply(slot.numbers.center)
                moving = link.velocity.linear + link.velocity.angular.cross(at)
                vectors = at, link.frame.apply(slot.numbers.axle), moving, link.velocity.angular
                for into, vector in zip((places, axles, travels, spins), vectors, strict=True):
                    into.append([_over_legs(c, group.count) for c in base.frame.apply(vector)])
                order.append(slot.index)

        def of_wheels(pieces: list[list[Any]]) -> Vec3:
            return Vec3(*(assemble([piece[i] for piece in pieces], order) for i in range(3)))

        place = Vec3(*base.position)
        return Kinematics(
            position=place,
            quaternion=jnp.stack(base.quaternion),
            frame=Frame(*(Vec3(*column) for column in base.frame)),
            velocity=Vec3(*base.velocity),
            angular_velocity=Vec3(*base.frame.apply(base.motion.angular)),
            joint_angle=assemble(angles, drives),
            joint_speed=assemble(speeds, drives),
            wheel_position=of_wheels(places) + place,
            wheel_axle=of_wheels(axles),
            wheel_velocity=of_wheels(travels),
            wheel_angular_velocity=of_wheels(spins),
        )

    def _finish(
        self, params: Any, numbers: list[LegGroup], legs: list[LegState], base: Base, forces: Forces
    ) -> tuple[Pieces, Pieces]:
        """Accelerations from the forces, and a step of semi-implicit Euler."""
        dtype, dt = forces.joint_torque.dtype, self.timestep
        frame, motion = base.frame, base.motion
        up = frame.undo(Vector(0.0, 0.0, jnp.asarray(params.gravity, dtype)))
        armature = _reflected_inertia(params, self._joints, dtype)
        blocks = [
            _leg_block(group, leg, up, forces, frame, armature, dt) for group, leg in zip(numbers, legs, strict=True)
        ]
        chassis = _chassis_inertia(self.structure.base, forces)
        applied = Force(frame.undo(Vector(*forces.chassis_moment)), frame.undo(Vector(*forces.chassis_force)))
        force = chassis.apply(Motion(ZERO, up)) + motion.cross_force(chassis.apply(motion)) - applied
        acceleration, rates = _solve(chassis, force, blocks)
        # the classical acceleration of the chassis frame's origin
        linear = acceleration.linear + motion.angular.cross(motion.linear)
        velocity = base.velocity + frame.apply(linear) * dt
        spin = motion.angular + acceleration.angular * dt
        position = base.position + velocity * dt
        quaternion = integrate(base.quaternion, spin, dt)
        angles, speeds = [], []
        for n, leg, rate in zip(numbers, legs, rates, strict=True):
            speed = [leg.speed[k] + dt * r for k, r in zip(n.free, rate, strict=True)]
            angle = [leg.angle[k] + dt * w for k, w in zip(n.free, speed, strict=True)]
            speeds.append(tuple(speed))
            angles.append(_turns(n, angle))
        return Pieces((*position, *quaternion), tuple(angles)), Pieces((*velocity, *spin), tuple(speeds))


def _cast_group(group: LegGroup, dtype: Any) -> LegGroup:
    """The same group with its arrays in the state's type; floats stay, and fold into the code."""

    def cast(tree: Any) -> Any:
        return jax.tree.map(lambda a: jnp.asarray(a, dtype) if isinstance(a, np.ndarray) else a, tree)

    loop = group.loop
    return dataclasses.replace(
        group,
        links=tuple(dataclasses.replace(link, numbers=cast(link.numbers)) for link in group.links),
        wheels=tuple(dataclasses.replace(slot, numbers=cast(slot.numbers)) for slot in group.wheels),
        loop=None if loop is None else dataclasses.replace(loop, numbers=cast(loop.numbers)),
    )


def _over_legs(value: Any, count: int) -> Any:
    """`value` as an array with one entry per leg."""
    return jnp.broadcast_to(value, (count,)) if np.ndim(value) == 0 else value


def _sum_over_legs(value: Any, count: int) -> Any:
    if isinstance(value, float):
        return count * value
    return count * value if jnp.ndim(value) == 0 else jnp.sum(value)


def _turns(n: LegGroup, free: list[Any]) -> tuple[Turn, ...]:
    """All joints' angles with their cosines and sines, from the independent angles."""
    angle: list[Any] = [0.0] * len(n.links)
    for k, q in zip(n.free, free, strict=True):
        angle[k] = q
    loop = n.loop
    if loop is not None:
        for k, q in zip(loop.dependent, loop.angles(loop.numbers, angle[loop.independent]), strict=True):
            angle[k] = q
    return tuple(Turn(q, *once(jnp.cos(q), jnp.sin(q))) for q in angle)


def _speeds(n: LegGroup, turns: tuple[Turn, ...], free: tuple[Any, ...]) -> tuple[list[Any], list[Any], list[Any]]:
    """Speeds of all joints, with their gains and drifts (see `LegState`)."""
    count, loop = len(n.links), n.loop
    speed, gain, drift = [0.0] * count, [1.0] * count, [0.0] * count
    for k, w in zip(n.free, free, strict=True):
        speed[k] = w
    if loop is not None:
        driver = loop.independent
        gains, drifts = loop.rates(loop.numbers, turns[driver].angle, speed[driver])
        for k, g, b in zip(loop.dependent, gains, drifts, strict=True):
            speed[k], gain[k], drift[k] = mul(g, speed[driver]), g, b
    return speed, gain, drift


def _forward(n: LegGroup, base: Motion, turns: tuple[Turn, ...], free: tuple[Any, ...]) -> LegState:
    """Poses, velocities and bias accelerations from the chassis outward (Featherstone 2008, table 5.1)."""
    speed, gain, drift = _speeds(n, turns, free)
    ground = LinkState(ZERO, IDENTITY, STILL, base, STILL)
    links: list[LinkState] = []
    for k, link in enumerate(n.links):
        up = ground if link.parent == CHASSIS else links[link.parent]
        origin = up.origin + up.frame.apply(link.numbers.origin)
        mount = up.frame.then(link.numbers.turn)
        axis = mount[link.axis]
        subspace = Motion(axis, origin.cross(axis))
        velocity = up.velocity + subspace * speed[k]
        bias = up.bias + velocity.cross(subspace) * speed[k] + subspace * drift[k]
        frame = mount.turn(link.axis, turns[k].cos, turns[k].sin)
        links.append(LinkState(origin, frame, subspace, velocity, bias))
    return LegState([turn.angle for turn in turns], speed, gain, drift, links)


def once(*values: Any) -> tuple[Any, ...]:
    """The same values, which XLA computes once and stores instead of again in every kernel that reads them."""
    return jax.lax.optimization_barrier(values)


def _reflected_inertia(params: Any, joints: int, dtype: Any) -> Any:
    """Rotor inertia times the square of the gear ratio at the actuated joints; None without motors."""
    motor = params.effects.get("motor")
    if motor is None:
        return None
    return motor["rotor_inertia"] * motor["gear_ratio"] ** 2 * jnp.ones(joints, dtype)


def _chassis_inertia(base: Body, forces: Forces) -> Inertia:
    """The chassis with its centre of mass shifted and a point mass on it."""
    geometry = forces.geometry
    moved = base._replace(com=base.com + Vector(*geometry.com_offset)).at(ZERO, IDENTITY)
    place = Vector(*geometry.payload_position)
    mass = geometry.payload_mass
    return moved + Inertia(mass, place * mass, Symmetric.of_point(mass, place))


def _wheel_forces(n: LegGroup, leg: LegState, forces: Forces, frame: Rotation) -> dict[int, Force]:
    """Forces of the ground about the chassis frame's origin, by link."""
    found: dict[int, Force] = {}
    for slot in n.wheels:
        link = leg.links[slot.link]
        push = frame.undo(Vector(*(select(c, slot.index) for c in forces.wheel_force)))
        moment = frame.undo(Vector(*(select(c, slot.index) for c in forces.wheel_moment)))
        at = link.origin + link.frame.apply(slot.numbers.center)
        force = Force(moment + at.cross(push), push)
        found[slot.link] = found[slot.link] + force if slot.link in found else force
    return found


def _leg_block(
    n: LegGroup, leg: LegState, up: Vector, forces: Forces, frame: Rotation, armature: Any, dt: float
) -> LegBlock:
    """Newton-Euler inward for the bias forces, composite rigid bodies for the mass matrix, then the loop's projection.

    Gravity enters as an upward acceleration `up` of the base (Featherstone 2008, sec. 5.3). Damping is implicit as in
    MuJoCo's Euler integrator: dt D joins the mass matrix.
    """
    count = len(n.links)
    wheel = _wheel_forces(n, leg, forces, frame)
    composite = [
        link.numbers.body.at(state.origin, state.frame) for link, state in zip(n.links, leg.links, strict=True)
    ]
    lift = Motion(ZERO, up)
    force = []
    for k, (inertia, state) in enumerate(zip(composite, leg.links, strict=True)):
        own = inertia.apply(state.bias + lift) + state.velocity.cross_force(inertia.apply(state.velocity))
        force.append(own - wheel[k] if k in wheel else own)
    hung = Inertia(0.0, ZERO, Symmetric.isotropic(0.0)), Force(ZERO, ZERO)
    torque: list[Any] = [0.0] * count
    mass: list[list[Any]] = [[0.0] * count for _ in range(count)]
    coupling: list[list[Any]] = [[0.0] * 6 for _ in range(count)]
    for k in reversed(range(count)):
        link, subspace = n.links[k], leg.links[k].subspace
        reflected = link.numbers.armature
        if armature is not None and link.actuated is not None:
            reflected = select(armature, link.actuated)
        added = add(reflected, mul(dt, link.numbers.damping))
        bias = add(subspace.dot(force[k]), mul(added, leg.drift[k]))
        torque[k] = sub(_joint_torque(n, leg, k, forces), bias)
        momentum = composite[k].apply(subspace)
        coupling[k] = [*momentum.moment, *momentum.force]
        mass[k][k] = add(subspace.dot(momentum), added)
        j = link.parent
        while j != CHASSIS:
            mass[k][j] = mass[j][k] = leg.links[j].subspace.dot(momentum)
            j = n.links[j].parent
        if link.parent == CHASSIS:
            hung = hung[0] + composite[k], hung[1] + force[k]
        else:
            composite[link.parent] = composite[link.parent] + composite[k]
            force[link.parent] = force[link.parent] + force[k]
    return _project(n, leg, LegBlock(mass, coupling, torque, *hung))


def _joint_torque(n: LegGroup, leg: LegState, k: int, forces: Forces) -> Any:
    """Actuator, spring and damper at a joint, in the link's own sense."""
    link = n.links[k]
    sign, spring = link.numbers.sign, link.numbers.stiffness
    stretch = sub(leg.angle[k], mul(sign, link.numbers.springref)) if _present(spring) else 0.0
    passive = add(mul(spring, stretch), mul(link.numbers.damping, leg.speed[k]))
    if link.actuated is None:
        return neg(passive)
    return sub(mul(sign, select(forces.joint_torque, link.actuated)), passive)


def _present(number: Any) -> bool:
    return not (isinstance(number, float) and number == 0.0)


def _project(n: LegGroup, leg: LegState, block: LegBlock) -> LegBlock:
    """The block in the independent joints: G^T H G, G^T F and G^T tau with G the loop's gains."""
    loop = n.loop
    if loop is None:
        return block
    free = n.free
    moved = {k: [(k, 1.0)] for k in free}
    moved[loop.independent] += [(k, leg.gain[k]) for k in loop.dependent]

    def project(row: list[Any], a: int) -> Any:
        return total(*(mul(g, row[k]) for k, g in moved[a]))

    half = [[project(row, b) for b in free] for row in block.mass_matrix]
    mass = [[project([row[j] for row in half], a) for j in range(len(free))] for a in free]
    coupling = [[project([row[i] for row in block.coupling], a) for i in range(6)] for a in free]
    return block._replace(mass_matrix=mass, coupling=coupling, torque=[project(block.torque, a) for a in free])


def _solve(chassis: Inertia, force: Force, blocks: list[LegBlock]) -> tuple[Motion, list[list[Any]]]:
    """Eliminates the legs, solves for the base, and substitutes back: the block-arrow equation of motion.

    [I_c  F][a_0]   [-p_c]
    [F^T  H][u' ] = [tau ]
    """
    total_inertia, total_force = chassis, [*force.moment, *force.force]
    corrections: list[list[Any]] = [[0.0] * 6 for _ in range(6)]
    eliminated = []
    for block in blocks:
        count = _legs_of(block)
        total_inertia = total_inertia + Inertia(
            _sum_over_legs(block.inertia.mass, count),
            Vector(*(_sum_over_legs(c, count) for c in block.inertia.h)),
            Symmetric(*(_sum_over_legs(c, count) for c in block.inertia.moments)),
        )
        columns = [block.torque, *([row[i] for row in block.coupling] for i in range(6))]
        solved = solve_positive(block.mass_matrix, columns)
        rows = range(len(block.coupling))
        hung = [*block.force.moment, *block.force.force]
        for i in range(6):
            through = total(*(mul(block.coupling[k][i], solved[0][k]) for k in rows))
            total_force[i] = add(total_force[i], _sum_over_legs(add(hung[i], through), count))
            for j in range(i + 1):
                through = total(*(mul(block.coupling[k][i], solved[1 + j][k]) for k in rows))
                corrections[i][j] = add(corrections[i][j], _sum_over_legs(through, count))
        eliminated.append(solved)
    matrix = _matrix(total_inertia)
    schur = [[sub(matrix[i][j], corrections[i][j]) if j <= i else 0.0 for j in range(6)] for i in range(6)]
    (a,) = solve_positive(schur, [[neg(f) for f in total_force]])
    rates = [
        [sub(s[0][k], total(*(mul(s[1 + i][k], a[i]) for i in range(6)))) for k in range(len(s[0]))] for s in eliminated
    ]
    return Motion(Vector(*a[:3]), Vector(*a[3:])), rates


def _legs_of(block: LegBlock) -> int:
    return next((t.shape[0] for t in block.torque if np.ndim(t)), 1)


def _matrix(inertia: Inertia) -> list[list[Any]]:
    """The 6 x 6 matrix of a spatial inertia, angular part first."""
    i, h, m = inertia.moments, inertia.h, inertia.mass
    cross = [[0.0, neg(h.z), h.y], [h.z, 0.0, neg(h.x)], [neg(h.y), h.x, 0.0]]
    moments = [[i.xx, i.xy, i.xz], [i.xy, i.yy, i.yz], [i.xz, i.yz, i.zz]]
    top = [moments[r] + cross[r] for r in range(3)]
    bottom = [[cross[c][r] for c in range(3)] + [m if c == r else 0.0 for c in range(3)] for r in range(3)]
    return top + bottom
