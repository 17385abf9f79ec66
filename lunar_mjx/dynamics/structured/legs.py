"""The legs of a rover: kinematics outward, forces and inertias inward, and the block-arrow equation of motion.

Every quantity of a leg is an array over the legs of its group, in the coordinates of the chassis frame about its
origin. Names and steps are those of Featherstone 2008 (ch. 5, 6 and 9): Newton-Euler, composite rigid bodies.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.indexing import select
from lunar_mjx.dynamics.spatial_algebra import Force, Inertia, Motion, Symmetric, solve_positive
from lunar_mjx.dynamics.structured.topology import CHASSIS, Coupling, LegGroup
from lunar_mjx.effects.ports import Forces
from lunar_mjx.spatial import IDENTITY, ZERO, Frame, Vec3, add, mul, neg, sub, total

STILL = Motion(ZERO, ZERO)


class Turn(NamedTuple):
    """A joint's angle, rad, with its cosine and sine: carried along, so that no kernel computes them again."""

    angle: Any
    cos: Any
    sin: Any


class LinkState(NamedTuple):
    """A link in the chassis frame's coordinates, for every leg of a group."""

    origin: Vec3
    frame: Frame
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
    ties: tuple[np.ndarray, ...] = ()


def cast_group(group: LegGroup, dtype: Any) -> LegGroup:
    """A group with its arrays in the state's type; floats stay, and fold into the code."""

    def cast(tree: Any) -> Any:
        # Python floats stay: zeros and ones among them drop out of every product while the step is traced.
        return jax.tree.map(lambda a: jnp.asarray(a, dtype) if isinstance(a, np.ndarray) else a, tree)

    loop = group.loop
    return dataclasses.replace(
        group,
        links=tuple(dataclasses.replace(link, numbers=cast(link.numbers)) for link in group.links),
        wheels=tuple(dataclasses.replace(slot, numbers=cast(slot.numbers)) for slot in group.wheels),
        loop=None if loop is None else dataclasses.replace(loop, numbers=cast(loop.numbers)),
    )


def joint_turns(n: LegGroup, free: list[Any]) -> tuple[Turn, ...]:
    """All joints' angles with their cosines and sines, from the independent angles."""
    angle: list[Any] = [0.0] * len(n.links)
    for k, q in zip(n.free, free, strict=True):
        angle[k] = q
    loop = n.loop
    if loop is not None:
        for k, q in zip(loop.dependent, loop.angles(loop.numbers, angle[loop.independent]), strict=True):
            angle[k] = q
    return tuple(Turn(q, *once(jnp.cos(q), jnp.sin(q))) for q in angle)


def once(*values: Any) -> tuple[Any, ...]:
    """The given values, which XLA computes once and stores instead of again in every kernel that reads them."""
    return jax.lax.optimization_barrier(values)


def joint_speeds(n: LegGroup, turns: tuple[Turn, ...], free: tuple[Any, ...]) -> tuple[list[Any], list[Any], list[Any]]:
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


def forward_kinematics(n: LegGroup, base: Motion, turns: tuple[Turn, ...], free: tuple[Any, ...]) -> LegState:
    """Poses, velocities and bias accelerations from the chassis outward (Featherstone 2008, table 5.1)."""
    speed, gain, drift = joint_speeds(n, turns, free)
    ground = LinkState(ZERO, IDENTITY, STILL, base, STILL)
    links: list[LinkState] = []
    for k, link in enumerate(n.links):
        up = ground if link.parent == CHASSIS else links[link.parent]
        origin = up.origin + up.frame.to_world(link.numbers.origin)
        # a turn leaves its own axis alone, so that it is read before the turn, where it has more zeros
        mount = up.frame.then(link.numbers.turn)
        axis = mount[link.axis]
        # A revolute joint's motion about the chassis frame's origin: all spatial vectors share that reference, so that
        # no transform stands between links.
        subspace = Motion(axis, origin.cross(axis))
        velocity = up.velocity + subspace * speed[k]
        bias = up.bias + velocity.cross(subspace) * speed[k] + subspace * drift[k]
        frame = mount.turn(link.axis, turns[k].cos, turns[k].sin)
        links.append(LinkState(origin, frame, subspace, velocity, bias))
    return LegState([turn.angle for turn in turns], speed, gain, drift, links)


def leg_block(n: LegGroup, leg: LegState, up: Vec3, forces: Forces, frame: Frame, armature: Any, dt: float) -> LegBlock:
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
        # Newton-Euler at zero joint accelerations: what remains is the force that the motion itself needs.
        own = inertia.apply(state.bias + lift) + state.velocity.cross_force(inertia.apply(state.velocity))
        force.append(own - wheel[k] if k in wheel else own)
    hung = Inertia(0.0, ZERO, Symmetric.isotropic(0.0)), Force(ZERO, ZERO)
    torque: list[Any] = [0.0] * count
    mass: list[list[Any]] = [[0.0] * count for _ in range(count)]
    coupling: list[list[Any]] = [[0.0] * 6 for _ in range(count)]
    for k in reversed(range(count)):
        link, subspace = n.links[k], leg.links[k].subspace
        # the model's motor, where there is one, in place of what the MJCF draws
        reflected = link.numbers.armature
        if armature is not None and link.actuated is not None:
            reflected = select(armature, link.actuated)
        # damping acts at the new speed: at the old one it would turn a light joint around within a step
        added = add(reflected, mul(dt, link.numbers.damping))
        bias = add(subspace.dot(force[k]), mul(added, leg.drift[k]))
        # Actuator minus bias is what is left to accelerate the joint.
        torque[k] = sub(_joint_torque(n, leg, k, forces), bias)
        momentum = composite[k].apply(subspace)
        # The force that a unit acceleration of this joint asks of the base: a column of F.
        coupling[k] = [*momentum.moment, *momentum.force]
        mass[k][k] = add(subspace.dot(momentum), added)
        # A joint's composite inertia couples with its ancestors in the leg, and with nothing else: that is the block-
        # arrow shape.
        j = link.parent
        while j != CHASSIS:
            mass[k][j] = mass[j][k] = leg.links[j].subspace.dot(momentum)
            j = n.links[j].parent
        if link.parent == CHASSIS:
            hung = hung[0] + composite[k], hung[1] + force[k]
        else:
            # no shift to the parent: all inertias are about the chassis frame already
            composite[link.parent] = composite[link.parent] + composite[k]
            force[link.parent] = force[link.parent] + force[k]
    return _project(n, leg, LegBlock(mass, coupling, torque, *hung, n.ties))


def _wheel_forces(n: LegGroup, leg: LegState, forces: Forces, frame: Frame) -> dict[int, Force]:
    """Forces of the ground about the chassis frame's origin, by link."""
    wheel_forces: dict[int, Force] = {}
    for slot in n.wheels:
        link = leg.links[slot.link]
        push = frame.from_world(Vec3(*(select(c, slot.index) for c in forces.wheel_force)))
        moment = frame.from_world(Vec3(*(select(c, slot.index) for c in forces.wheel_moment)))
        at = link.origin + link.frame.to_world(slot.numbers.center)
        force = Force(moment + at.cross(push), push)
        # Several wheels may hang on one link, as on a bogie whose axle is rigid.
        wheel_forces[slot.link] = wheel_forces[slot.link] + force if slot.link in wheel_forces else force
    return wheel_forces


def _joint_torque(n: LegGroup, leg: LegState, k: int, forces: Forces) -> Any:
    """Actuator, spring and damper at a joint, in the link's own sense."""
    link = n.links[k]
    sign, spring = link.numbers.sign, link.numbers.stiffness
    # Most joints have no spring; leaving the stretch out keeps a subtraction for every leg out of the program.
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
    # Which joints move, and how fast, when one independent joint moves at unit speed: a row of G^T.
    moved = {k: [(k, 1.0)] for k in free}
    moved[loop.independent] += [(k, leg.gain[k]) for k in loop.dependent]

    def project(row: list[Any], a: int) -> Any:
        return total(*(mul(g, row[k]) for k, g in moved[a]))

    half = [[project(row, b) for b in free] for row in block.mass_matrix]
    mass = [[project([row[j] for row in half], a) for j in range(len(free))] for a in free]
    coupling = [[project([row[i] for row in block.coupling], a) for i in range(6)] for a in free]
    return block._replace(mass_matrix=mass, coupling=coupling, torque=[project(block.torque, a) for a in free])


def solve(
    chassis: Inertia, force: Force, blocks: list[LegBlock], couplings: tuple[Coupling, ...] = ()
) -> tuple[Motion, list[list[Any]]]:
    """Eliminates the legs, solves for the base, and substitutes back: the block-arrow equation of motion.

    [I_c  F][a_0]   [-p_c]
    [F^T  H][u' ] = [tau ]

    Couplings J u' = 0 add J^T lambda to tau. The response to each row of J is one more right side of the same
    factorisation, and J u' = 0 gives the lambda of all of them.
    """
    # Couplings tie joints of different legs (a differential), which the block-arrow shape does not allow: they are
    # solved for as constraint forces, a few at most.
    pulls = [_pull(coupling, blocks) for coupling in couplings]
    total_inertia, total_force = chassis, [*force.moment, *force.force]
    # the lower triangle only: the complement is symmetric, and solve_positive reads no more
    corrections: list[list[Any]] = [[0.0] * 6 for _ in range(6)]
    pulled: list[list[Any]] = [[0.0] * 6 for _ in pulls]
    eliminated: list[list[list[Any]]] = []
    for block in blocks:
        count = _legs_of(block)
        total_inertia = total_inertia + Inertia(
            _sum_over_legs(block.inertia.mass, count),
            Vec3(*(_sum_over_legs(c, count) for c in block.inertia.h)),
            Symmetric(*(_sum_over_legs(c, count) for c in block.inertia.moments)),
        )
        rows_of_j = [pull[len(eliminated)] for pull in pulls]
        # One factorisation of the leg's mass matrix serves its torque, the six columns of F and every row of J.
        columns = [block.torque, *([row[i] for row in block.coupling] for i in range(6)), *rows_of_j]
        mass = block.mass_matrix
        if block.ties:
            # Tied legs are one joint with their masses, couplings and torques together.
            mass = [[_over_ties(m, block) for m in row] for row in mass]
            columns = [[_over_ties(c, block) for c in column] for column in columns]
        solved = solve_positive(mass, columns)
        rows = range(len(block.coupling))
        hung = [*block.force.moment, *block.force.force]
        for i in range(6):
            through = total(*(mul(block.coupling[k][i], solved[0][k]) for k in rows))
            total_force[i] = add(total_force[i], _sum_over_legs(add(hung[i], through), count))
            for j in range(i + 1):
                through = total(*(mul(block.coupling[k][i], solved[1 + j][k]) for k in rows))
                corrections[i][j] = add(corrections[i][j], _sum_over_legs(through, count))
            for c in range(len(pulls)):
                through = total(*(mul(block.coupling[k][i], solved[7 + c][k]) for k in rows))
                pulled[c][i] = add(pulled[c][i], _sum_over_legs(through, count))
        eliminated.append(solved)
    # What is left after the legs are eliminated is the Schur complement: the inertia that the base feels, legs
    # included.
    matrix = _matrix(total_inertia)
    schur = [[sub(matrix[i][j], corrections[i][j]) if j <= i else 0.0 for j in range(6)] for i in range(6)]
    a, *responses = solve_positive(schur, [[neg(f) for f in hung] for hung in (total_force, *pulled)])
    rates = _substituted(eliminated, 0, a)
    if not pulls:
        return Motion(Vec3(*a[:3]), Vec3(*a[3:])), rates
    answers = [_substituted(eliminated, 7 + c, response) for c, response in enumerate(responses)]
    gaps = [_gap(pull, rates) for pull in pulls]
    # How far each constraint force closes each gap: the small matrix J H^-1 J^T.
    compliance = [[_gap(pull, answer) for answer in answers] for pull in pulls]
    # J H^-1 J^T is positive as long as no two couplings say the same
    (forces,) = solve_positive(compliance, [[neg(gap) for gap in gaps]])
    for force_of, response, answer in zip(forces, responses, answers, strict=True):
        a = [add(old, mul(force_of, more)) for old, more in zip(a, response, strict=True)]
        rates = [
            [add(old, mul(force_of, more)) for old, more in zip(own, extra, strict=True)]
            for own, extra in zip(rates, answer, strict=True)
        ]
    return Motion(Vec3(*a[:3]), Vec3(*a[3:])), rates


def _substituted(eliminated: list[list[list[Any]]], column: int, a: list[Any]) -> list[list[Any]]:
    """Joint accelerations by block, for one right side and the base's acceleration with it."""
    return [
        [sub(s[column][k], total(*(mul(s[1 + i][k], a[i]) for i in range(6)))) for k in range(len(s[0]))]
        for s in eliminated
    ]


def _pull(coupling: Coupling, blocks: list[LegBlock]) -> list[list[Any]]:
    """A row of J: by block and independent joint 0.0 or an array (leg,)."""
    row: list[list[Any]] = [[0.0] * len(block.torque) for block in blocks]
    for end, share in ((coupling.follower, 1.0), (coupling.leader, -coupling.multiplier)):
        dtype = next(jnp.result_type(t) for block in blocks for t in block.torque if not isinstance(t, float))
        row[end.group][end.free] = add(row[end.group][end.free], jnp.asarray(share * end.sign * end.leg, dtype))
    return row


def _gap(pull: list[list[Any]], rates: list[list[Any]]) -> Any:
    """A row of J times joint accelerations."""
    return total(
        *(
            jnp.sum(mul(p, r))
            for own, rate in zip(pull, rates, strict=True)
            for p, r in zip(own, rate, strict=True)
            if not isinstance(p, float)
        )
    )


def impose(chassis: Inertia, force: Force, blocks: list[LegBlock], rates: list[Any]) -> tuple[Motion, list[Any]]:
    """The base's acceleration, and the torques that legs of one joint need, for given joint accelerations.

    The first row of the equation of motion gives a_0, the second the torques (hybrid dynamics, Featherstone 2008,
    sec. 9.2).

    Args:
      chassis, force, blocks: as for `solve`; the blocks' torques are without the actuators.
      rates: accelerations of the legs' joints in the links' own sense, (leg,) by group, rad/s2.

    Returns:
      The base's spatial acceleration, and the actuators' torques in the links' own sense, (leg,) by group, N m.
    """
    whole, applied = chassis, [*force.moment, *force.force]
    for block, rate in zip(blocks, rates, strict=True):
        count = _legs_of(block)
        whole = whole + Inertia(
            _sum_over_legs(block.inertia.mass, count),
            Vec3(*(_sum_over_legs(c, count) for c in block.inertia.h)),
            Symmetric(*(_sum_over_legs(c, count) for c in block.inertia.moments)),
        )
        hung = [*block.force.moment, *block.force.force]
        for i in range(6):
            pushed = mul(block.coupling[0][i], rate)
            applied[i] = add(applied[i], _sum_over_legs(add(hung[i], pushed), count))
    matrix = _matrix(whole)
    # With the joints' motion given, the base sees all masses as one rigid body.
    lower = [[matrix[i][j] if j <= i else 0.0 for j in range(6)] for i in range(6)]
    (a,) = solve_positive(lower, [[neg(f) for f in applied]])
    torques = [
        sub(
            total(mul(block.mass_matrix[0][0], rate), *(mul(block.coupling[0][i], a[i]) for i in range(6))),
            block.torque[0],
        )
        for block, rate in zip(blocks, rates, strict=True)
    ]
    return Motion(Vec3(*a[:3]), Vec3(*a[3:])), torques


def _over_ties(value: Any, block: LegBlock) -> Any:
    """The sum over the legs that are tied together, by leg."""
    if np.ndim(value) == 0:
        return len(block.ties) * value
    return total(*(select(value, index) for index in block.ties))


def _legs_of(block: LegBlock) -> int:
    return next((t.shape[0] for t in block.torque if np.ndim(t)), 1)


def _sum_over_legs(value: Any, count: int) -> Any:
    if isinstance(value, float):
        return count * value
    # A number that all legs share stands for each of them.
    return count * value if jnp.ndim(value) == 0 else jnp.sum(value)


def _matrix(inertia: Inertia) -> list[list[Any]]:
    """The 6 x 6 matrix of a spatial inertia, angular part first."""
    i, h, m = inertia.moments, inertia.h, inertia.mass
    # The matrix of h x, the coupling of spin and push through the centre of mass.
    cross = [[0.0, neg(h.z), h.y], [h.z, 0.0, neg(h.x)], [neg(h.y), h.x, 0.0]]
    moments = [[i.xx, i.xy, i.xz], [i.xy, i.yy, i.yz], [i.xz, i.yz, i.zz]]
    top = [moments[r] + cross[r] for r in range(3)]
    bottom = [[cross[c][r] for c in range(3)] + [m if c == r else 0.0 for c in range(3)] for r in range(3)]
    return top + bottom
