"""Reads a compiled MuJoCo model as a floating base with legs: what the structured engine computes with.

Bodies without joints fuse into the body that carries them. A leg is whatever hangs from the chassis by one joint, or by
two that a connect constraint ties together; legs of one pattern form a group whose numbers stand side by side in
arrays of shape (leg,), or as one float where all legs agree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from lunar_mjx.dynamics.spatial_algebra import Body, Symmetric, uniform
from lunar_mjx.dynamics.structured.fourbar import FourBar, read_fourbar
from lunar_mjx.dynamics.structured.links import Link, LinkNumbers
from lunar_mjx.dynamics.structured.suitability import UnsuitableError
from lunar_mjx.spatial import Frame, Vec3

CHASSIS, WORLD = -1, -2
"""Parents that are no links of a leg."""


class WheelNumbers(NamedTuple):
    """Centre of a wheel, m, and direction of its axle, in the frame of the link that carries it."""

    center: Vec3
    axle: Vec3


@dataclasses.dataclass(frozen=True, eq=False)
class WheelSlot:
    """The wheel on one link of every leg: the wheels' places in the rover's list, by leg."""

    link: int
    numbers: WheelNumbers
    index: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class LegGroup:
    """Legs of a rover that have one pattern of bodies and joints, computed together.

    Attributes:
      count: of legs. links, wheels, loop: what every leg has.
      ties: where the legs' only joints turn as one (a side's wheels behind one motor): for every leg the numbers of the
        legs tied to it, itself among them, as arrays of shape (leg,), one for each; empty where legs are free.
    """

    count: int
    links: tuple[Link, ...]
    wheels: tuple[WheelSlot, ...]
    loop: FourBar | None
    ties: tuple[np.ndarray, ...] = ()

    @property
    def free(self) -> list[int]:
        """The independent joints."""
        dependent = self.loop.dependent if self.loop else ()
        return [k for k in range(len(self.links)) if k not in dependent]


@dataclasses.dataclass(frozen=True, eq=False)
class End:
    """One joint of a coupling: its group, its place among the group's independent joints, its leg, and its sense."""

    group: int
    free: int
    leg: np.ndarray
    sign: float


@dataclasses.dataclass(frozen=True, eq=False)
class Coupling:
    """Two joints, of one leg or of two: angle of `follower` = `multiplier` times angle of `leader`."""

    follower: End
    leader: End
    multiplier: float


@dataclasses.dataclass(frozen=True, eq=False)
class Structure:
    """A floating base with legs; `base` in the chassis frame."""

    base: Body
    groups: tuple[LegGroup, ...]
    free_qpos: int
    free_dof: int
    couplings: tuple[Coupling, ...] = ()


@dataclasses.dataclass(eq=False)
class _RawLink:
    """One joint of one leg, in frames parallel to the bodies' own; `mount` is the parent frame's turn."""

    joint: int
    parent: int
    origin: np.ndarray
    mount: np.ndarray
    axis: np.ndarray
    masses: list[tuple[float, np.ndarray, np.ndarray]]
    align: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))


class _Place(NamedTuple):
    """Where a body's frame stands: in which link's frame, turned and shifted how."""

    owner: int
    turn: np.ndarray
    shift: np.ndarray


def read_structure(
    model: mujoco.MjModel,
    chassis: int,
    wheels: Sequence[int],
    axles: Float[np.ndarray, "wheel 3"],
    joints: Sequence[int],
    name: str,
) -> Structure:
    """Reads the model's tree.

    Args:
      model: a model that passed `check_model`.
      chassis: body that carries the free joint.
      wheels: the wheels' bodies.
      axles: direction of each wheel's axle in its body's frame.
      joints: the actuated joints, in the order of the controls.
      name: what to name in errors.

    Raises:
      UnsuitableError: the tree is no floating base with legs, or a loop is no planar four-bar.
    """
    links, places, base_masses = _walk(model, chassis, name)
    pins = _pins(model, places)
    legs = _legs(links, pins, name)
    order = {id_: i for i, id_ in enumerate(joints)}
    patterns: dict[Any, list[_Leg]] = {}
    for members in legs:
        leg = _leg(members, links, places, pins, wheels, axles, order)
        # Legs of one pattern become one group, computed side by side: a rover of six alike legs costs little more than
        # one leg.
        patterns.setdefault(leg.pattern, []).append(leg)
    groups, members = [], []
    for alike in patterns.values():
        # In the order of the rover's wheels, so that results are slices and not gathers.
        alike.sort(key=lambda leg: [w[0] for w in leg.wheels] or [leg.links[0].joint])
        groups.append(_group(model, alike, order, name))
        members.append(alike)
    free = int(model.body_jntadr[chassis])
    return Structure(
        base=_body([base_masses], [np.eye(3)]),
        groups=tuple(groups),
        free_qpos=int(model.jnt_qposadr[free]),
        free_dof=int(model.jnt_dofadr[free]),
        couplings=_couplings(model, groups, members, name),
    )


def _couplings(
    model: mujoco.MjModel, groups: list[LegGroup], members: list[list[_Leg]], name: str
) -> tuple[Coupling, ...]:
    """The joint equalities that `_ties` has not taken: differentials, and joints that mimic others."""
    place = {
        link.joint: (g, k, i)
        for g, legs in enumerate(members)
        for i, leg in enumerate(legs)
        for k, link in enumerate(leg.links)
    }

    def end(joint: int, equality: str) -> End:
        g, k, i = place[joint]
        group = groups[g]
        if k not in group.free:
            raise UnsuitableError(
                f"{name}: the joint equality {equality!r} holds the joint {model.joint(joint).name!r}, which a loop "
                "holds already; the structured engine couples joints that are free otherwise."
            )
        sign = np.broadcast_to(np.asarray(group.links[k].numbers.sign), group.count)[i]
        return End(g, group.free.index(k), np.arange(group.count) == i, float(sign))

    couplings = []
    for e in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        ends = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])]
        # Taken care of already: tied legs are one joint.
        if any(groups[place[j][0]].ties for j in ends):
            continue
        follower, leader = (end(j, model.eq(e).name) for j in ends)
        couplings.append(Coupling(follower, leader, float(model.eq_data[e, 1])))
    return tuple(couplings)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)


def _walk(model: mujoco.MjModel, chassis: int, name: str) -> tuple[list[_RawLink], list[_Place], list[Any]]:
    """Every joint as a link, every body's place, and the masses that ride on the chassis."""
    first = int(model.body_jntadr[chassis])
    if model.body_jntnum[chassis] != 1 or model.jnt_type[first] != mujoco.mjtJoint.mjJNT_FREE:
        raise UnsuitableError(f"{name}: the chassis {model.body(chassis).name!r} has no free joint of its own.")
    links: list[_RawLink] = []
    places = [_Place(WORLD, np.eye(3), np.zeros(3))]
    base: list[Any] = []
    for body in range(1, model.nbody):
        up = places[model.body_parentid[body]]
        turn = up.turn @ _matrix(model.body_quat[body])
        # A body without joints is carried rigidly: its mass goes to whatever carries it.
        place = _Place(up.owner, turn, up.shift + up.turn @ model.body_pos[body])
        if body == chassis:
            place = _Place(CHASSIS, np.eye(3), np.zeros(3))
        elif model.body_jntnum[body] and up.owner == WORLD:
            raise UnsuitableError(f"{name}: the body {model.body(body).name!r} moves but does not hang on the chassis.")
        else:
            for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
                pivot = model.jnt_pos[joint]
                origin = place.shift + place.turn @ pivot
                links.append(_RawLink(joint, place.owner, origin, place.turn, np.array(model.jnt_axis[joint]), []))
                # A link's frame has its origin on the joint's axis, where most offsets vanish.
                place = _Place(len(links) - 1, np.eye(3), -np.array(pivot))
        places.append(place)
        if place.owner == WORLD:
            continue
        frame = place.turn @ _matrix(model.body_iquat[body])
        moments = frame @ np.diag(model.body_inertia[body]) @ frame.T
        mass = (float(model.body_mass[body]), place.shift + place.turn @ model.body_ipos[body], moments)
        (base if place.owner == CHASSIS else links[place.owner].masses).append(mass)
    return links, places, base


class _Pin(NamedTuple):
    """A connect constraint: two links (or the chassis), and the anchor in the frame of each."""

    name: str
    links: tuple[int, int]
    anchors: tuple[np.ndarray, np.ndarray]


def _pins(model: mujoco.MjModel, places: list[_Place]) -> list[_Pin]:
    pins = []
    for i in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_CONNECT):
        on = places[model.eq_obj1id[i]], places[model.eq_obj2id[i]]
        given = model.eq_data[i, :3], model.eq_data[i, 3:6]
        first, second = (p.shift + p.turn @ a for p, a in zip(on, given, strict=True))
        pins.append(_Pin(model.eq(i).name, (on[0].owner, on[1].owner), (first, second)))
    return pins


def _legs(links: list[_RawLink], pins: list[_Pin], name: str) -> list[list[int]]:
    """Links by leg, in the order of the model."""
    root: list[int] = []
    for i, link in enumerate(links):
        root.append(i if link.parent == CHASSIS else root[link.parent])
    for pin in pins:
        # A pin to the chassis closes a loop through the base, which the elimination leg by leg cannot honour.
        if min(pin.links) < 0:
            raise UnsuitableError(f"{name}: the connect {pin.name!r} ties a leg to the chassis or the world.")
        a, b = sorted(root[i] for i in pin.links)
        # Two chains that a pin ties are one leg.
        root = [a if r == b else r for r in root]
    return [[i for i, r in enumerate(root) if r == leg] for leg in dict.fromkeys(root)]


class _Leg(NamedTuple):
    links: list[_RawLink]
    parents: tuple[int, ...]
    wheels: list[tuple[int, int, np.ndarray, np.ndarray]]
    pins: list[_Pin]
    pattern: Any


def _leg(
    members: list[int],
    links: list[_RawLink],
    places: list[_Place],
    pins: list[_Pin],
    wheels: Sequence[int],
    axles: np.ndarray,
    actuated: dict[int, int],
) -> _Leg:
    """One leg with its own numbering of links; its pattern is what legs of one group must share."""
    local = {g: i for i, g in enumerate(members)}
    own = [links[g] for g in members]
    parents = tuple(local.get(link.parent, CHASSIS) for link in own)
    leg_links = [
        (i, local[p.owner], p.shift, p.turn @ axles[i])
        for i, p in enumerate(places[w] for w in wheels)
        if p.owner in local
    ]
    tied = [_Pin(p.name, (local[p.links[0]], local[p.links[1]]), p.anchors) for p in pins if p.links[0] in local]
    pattern = (
        parents,
        tuple(link.joint in actuated for link in own),
        tuple(slot for _, slot, _, _ in leg_links),
        tuple(p.links for p in tied),
    )
    return _Leg(own, parents, leg_links, tied, pattern)


def _group(model: mujoco.MjModel, legs: list[_Leg], actuated: dict[int, int], name: str) -> LegGroup:
    """Puts the numbers of several legs of one pattern side by side."""
    count = len(legs)
    parents = legs[0].parents
    axes = [_coordinate_axis([leg.links[k] for leg in legs]) for k in range(len(parents))]
    made = []
    for k, parent in enumerate(parents):
        raw = [leg.links[k] for leg in legs]
        above = [np.eye(3) if parent == CHASSIS else leg.links[parent].align for leg in legs]
        ids = [r.joint for r in raw]
        # Damping and armature belong to degrees of freedom, springs to joints; for hinges these are one to one.
        dof = model.jnt_dofadr[ids]
        numbers = LinkNumbers(
            sign=uniform([float(np.sign(r.align[:, axes[k]] @ r.axis)) for r in raw]),
            origin=_vector([a.T @ r.origin for a, r in zip(above, raw, strict=True)]),
            turn=_rotation([a.T @ r.mount @ r.align for a, r in zip(above, raw, strict=True)]),
            body=_body([r.masses for r in raw], [r.align for r in raw]),
            damping=uniform(model.dof_damping[dof]),
            stiffness=uniform(model.jnt_stiffness[ids]),
            springref=uniform(model.qpos_spring[model.jnt_qposadr[ids]]),
            armature=uniform(model.dof_armature[dof]),
        )
        drives = np.array([actuated[i] for i in ids]) if ids[0] in actuated else None
        made.append(Link(parent, axes[k], numbers, np.array(model.jnt_qposadr[ids]), np.array(dof), drives))
    slots = []
    for w, (_, slot, _, _) in enumerate(legs[0].wheels):
        aligns = [leg.links[slot].align for leg in legs]
        numbers = WheelNumbers(
            _vector([a.T @ leg.wheels[w][2] for a, leg in zip(aligns, legs, strict=True)]),
            _vector([a.T @ leg.wheels[w][3] for a, leg in zip(aligns, legs, strict=True)]),
        )
        slots.append(WheelSlot(slot, numbers, np.array([leg.wheels[w][0] for leg in legs])))
    loop = None
    if len(legs[0].pins) > 1:
        raise UnsuitableError(f"{name}: a leg has {len(legs[0].pins)} loops; the structured engine closes one per leg.")
    if legs[0].pins:
        pins = [leg.pins[0] for leg in legs]
        moved = [
            tuple(leg.links[i].align.T @ a for i, a in zip(p.links, p.anchors, strict=True))
            for leg, p in zip(legs, pins, strict=True)
        ]
        loop = read_fourbar(made, count, pins[0].links, moved, f"{name}: the loop {pins[0].name!r}")
    return LegGroup(count, tuple(made), tuple(slots), loop, _ties(model, legs, made, loop, name))


def _ties(
    model: mujoco.MjModel, legs: list[_Leg], links: list[Link], loop: FourBar | None, name: str
) -> tuple[np.ndarray, ...]:
    """Legs whose joints are one, by leg (see `LegGroup`)."""
    own = {link.joint: (i, k) for i, leg in enumerate(legs) for k, link in enumerate(leg.links)}
    cluster = np.arange(len(legs))
    tied = False
    for i in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        ends = [own[j] for joint in (model.eq_obj1id[i], model.eq_obj2id[i]) if (j := int(joint)) in own]
        # what ties legs of several joints, or not one to one, is a coupling (see `_couplings`)
        if len(ends) < 2 or loop is not None or len(links) > 1 or model.eq_data[i, 1] != 1.0:
            continue
        # Union of the two clusters.
        (first, _), (second, _) = ends
        cluster[cluster == cluster[second]] = cluster[first]
        tied = True
    if not tied:
        return ()
    members = [np.flatnonzero(cluster == c) for c in cluster]
    sign = np.broadcast_to(np.asarray(links[0].numbers.sign), len(legs))
    if len({len(m) for m in members}) > 1 or any(np.ptp(sign[m]) for m in members):
        raise UnsuitableError(f"{name}: legs are tied in groups of different sizes or senses of rotation.")
    return tuple(np.array([m[k] for m in members]) for k in range(len(members[0])))


def _coordinate_axis(links: list[_RawLink]) -> int:
    """Coordinate axis about which these links turn; oblique axes become y by turning the links' frames."""
    # An axis along a coordinate needs one cosine and one sine instead of a full rotation matrix.
    for axis in range(3):
        if all(np.linalg.norm(np.delete(link.axis, axis)) < 1e-14 for link in links):
            return axis
    for link in links:
        y = link.axis / np.linalg.norm(link.axis)
        x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
        x /= np.linalg.norm(x)
        link.align = np.column_stack([x, y, np.cross(x, y)])
    return 1


def _vector(vectors: list[np.ndarray]) -> Vec3:
    return Vec3(*(uniform(c) for c in np.array(vectors).T))


def _rotation(matrices: list[np.ndarray]) -> Frame:
    m = np.array(matrices)
    return Frame(*(_vector(list(m[:, :, j])) for j in range(3)))


def _body(masses: list[list[tuple[float, np.ndarray, np.ndarray]]], aligns: list[np.ndarray]) -> Body:
    """One rigid body per leg from the masses that ride on it, in frames turned by `aligns`."""
    fused = [_fuse(m) for m in masses]
    coms = [a.T @ c for (_, c, _), a in zip(fused, aligns, strict=True)]
    moments = np.array([a.T @ i @ a for (_, _, i), a in zip(fused, aligns, strict=True)])
    size = max(float(np.abs(moments).max()), 1e-30)
    entries = np.stack([moments[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    # The moment that most diagonal entries share is taken out as a sphere, which needs no rotation; for a wheel one
    # number is left.
    best = min(
        (entries[k] for k in range(3)), key=lambda s: sum(np.abs(entries[k] - s).max() > 1e-13 * size for k in range(3))
    )
    anisotropic = entries - best * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])[:, None]
    anisotropic[np.abs(anisotropic) < 1e-13 * size] = 0.0
    return Body(
        uniform([m for m, _, _ in fused], 0.0),
        _vector(coms),
        uniform(best, 0.0),
        Symmetric(*(uniform(e, 0.0) for e in anisotropic)),
    )


def _fuse(masses: list[tuple[float, np.ndarray, np.ndarray]]) -> tuple[float, np.ndarray, np.ndarray]:
    mass = float(sum(m for m, _, _ in masses))
    if mass == 0.0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    com = np.sum([m * c for m, c, _ in masses], axis=0) / mass
    moments = np.zeros((3, 3))
    for m, c, i in masses:
        r = c - com
        moments += i + m * (r @ r * np.eye(3) - np.outer(r, r))
    return mass, com, moments
