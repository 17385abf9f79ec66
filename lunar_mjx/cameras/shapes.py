"""Rovers as boxes, cylinders, capsules and ellipsoids, placed by their joints and hit by rays, in pure JAX."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo is a compiled module without type stubs)

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.rover import Rover
from lunar_mjx.rover.look import LOOK, seen_spec

BOX, CYLINDER, CAPSULE, ELLIPSOID = range(4)
_KINDS = {
    mujoco.mjtGeom.mjGEOM_BOX: BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER: CYLINDER,
    mujoco.mjtGeom.mjGEOM_CAPSULE: CAPSULE,
    mujoco.mjtGeom.mjGEOM_SPHERE: ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_MESH: BOX,
}
_FAR = 1e9
"""m; the depth of a ray that meets nothing: a large number, since infinities less infinities are not numbers."""


class Shapes(NamedTuple):
    """What a rover looks like, on the host; leading axis `shape`. A mesh is drawn as the box around it.

    Attributes:
      kind: one of BOX, CYLINDER, CAPSULE, ELLIPSOID. size: (n, 3) half sizes, m; radius first for round shapes.
      body: of the kinematic tree. place: (n, 3) m, and turn: (n, 3, 3), in the body's frame. colour: (n, 3) linear.
    """

    kind: np.ndarray
    size: np.ndarray
    body: np.ndarray
    place: np.ndarray
    turn: np.ndarray
    colour: np.ndarray


class Placed(NamedTuple):
    """Shapes in the world; leading axis `shape`. `kind` stays on the host."""

    kind: np.ndarray
    size: Float[Array, "shape 3"]
    place: Float[Array, "shape 3"]
    turn: Float[Array, "shape 3 3"]
    colour: Float[Array, "shape 3"]


@functools.lru_cache(maxsize=16)
def _compiled(rover: Rover) -> Any:
    return seen_spec(rover).compile()


def rover_shapes(rover: Rover, detail: bool = False) -> Shapes:
    """The shapes of a rover that the eye sees; with `detail` grousers, seams and lenses, too, which take time."""
    m = _compiled(rover)
    seen = [
        i
        for i in range(m.ngeom)
        if m.geom_group[i] < (LOOK.hidden if detail else LOOK.detail)
        and m.geom_rgba[i, 3] > 0
        and int(m.geom_type[i]) in _KINDS
    ]
    size = m.geom_size[seen].copy()
    place, turn = m.geom_pos[seen].copy(), np.stack([_matrix(q) for q in m.geom_quat[seen]])
    for row, i in enumerate(seen):
        kind = int(m.geom_type[i])
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            size[row] = size[row, 0]
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            first = m.mesh_vertadr[m.geom_dataid[i]]
            corners = m.mesh_vert[first : first + m.mesh_vertnum[m.geom_dataid[i]]]
            low, high = corners.min(axis=0), corners.max(axis=0)
            size[row] = np.maximum(0.5 * (high - low), 1e-4)
            place[row] = place[row] + turn[row] @ (0.5 * (low + high))
    colour = m.geom_rgba[seen, :3] ** 2.2  # colours are given for the screen
    kinds = np.array([_KINDS[int(m.geom_type[i])] for i in seen], int)
    # one kind after the other, so that each is one batch
    order = np.argsort(kinds, kind="stable")
    return Shapes(*(a[order] for a in (kinds, size, m.geom_bodyid[seen], place, turn, colour)))


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, float))
    return out.reshape(3, 3)


@jax.default_matmul_precision("highest")  # not TF32, the default of GPUs
def body_poses(rover: Rover, qpos: Float[Array, "nq"]) -> tuple[Any, Any]:
    """Positions (body, 3) m and rotations (body, 3, 3) of a rover's bodies; the same as `mj_kinematics` gives.

    Args:
      rover: with a free joint at its chassis, and hinges and slides elsewhere.
      qpos: coordinates of its MJCF.
    """
    m = _compiled(rover)
    places = [jnp.zeros(3, qpos.dtype)]
    turns = [jnp.eye(3, dtype=qpos.dtype)]
    for b in range(1, m.nbody):
        up = int(m.body_parentid[b])
        place = places[up] + turns[up] @ jnp.asarray(m.body_pos[b], qpos.dtype)
        turn = turns[up] @ jnp.asarray(_matrix(m.body_quat[b]), qpos.dtype)
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
            at, kind = int(m.jnt_qposadr[j]), int(m.jnt_type[j])
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                place, turn = qpos[at : at + 3], rotation(qpos[at + 3 : at + 7])
                continue
            axis = jnp.asarray(m.jnt_axis[j], qpos.dtype)
            value = qpos[at] - float(m.qpos0[at])
            if kind == mujoco.mjtJoint.mjJNT_SLIDE:
                place = place + turn @ axis * value
                continue
            # a hinge turns the body about its anchor
            anchor = jnp.asarray(m.jnt_pos[j], qpos.dtype)
            still = place + turn @ anchor
            turn = turn @ _about(axis, value)
            place = still - turn @ anchor
        places.append(place)
        turns.append(turn)
    return jnp.stack(places), jnp.stack(turns)


def rotation(q: Float[Array, "*rover 4"]) -> Float[Array, "*rover 3 3"]:
    """Rotation matrices of quaternions w, x, y, z of any length."""
    unit = q / jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True))
    w, x, y, z = (unit[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _about(axis: Any, angle: Any) -> Any:
    """Rotation about a unit axis."""
    half = 0.5 * angle
    return rotation(jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis]))


def placed(shapes: Shapes, rover: Rover, qpos: Float[Array, "nq"]) -> Placed:
    """A rover's shapes in the world."""
    at, turn = body_poses(rover, qpos)
    at, turn = at[shapes.body], turn[shapes.body]
    local, own = jnp.asarray(shapes.place, qpos.dtype), jnp.asarray(shapes.turn, qpos.dtype)
    return Placed(
        shapes.kind,
        jnp.asarray(shapes.size, qpos.dtype),
        at + jnp.sum(turn * local[:, None, :], axis=-1),
        jnp.sum(turn[:, :, :, None] * own[:, None, :, :], axis=2),
        jnp.asarray(shapes.colour, qpos.dtype),
    )


def together(*parts: Placed) -> Placed:
    """Several rovers' shapes as one set."""
    kind = np.concatenate([p.kind for p in parts])
    order = np.argsort(kind, kind="stable")
    return Placed(kind[order], *(jnp.concatenate(a)[order] for a in zip(*(p[1:] for p in parts), strict=True)))


def hit(placed: Placed, origin: Any, direction: Any) -> tuple[Any, Any]:
    """Where rays first enter a shape.

    Args:
      placed: the shapes, sorted by kind.
      origin: (3,) or (..., 3) m. direction: (..., 3), of any length.

    Returns:
      Multiple of `direction` at the entry, infinite where nothing is hit; and which shape it is.
    """
    distances, first = [], 0
    for kind in range(4):
        count = int(np.sum(placed.kind == kind))
        if count:
            part = slice(first, first + count)
            distances.append(_ENTRY[kind](placed.size[part], *_local(placed, part, origin, direction)))
        first += count
    t = jnp.concatenate(distances)
    which = jnp.argmin(t, axis=0)
    near = jnp.min(t, axis=0)
    return jnp.where(near < _FAR, near, jnp.inf), which


def _local(placed: Placed, part: slice, origin: Any, direction: Any) -> tuple[tuple, tuple]:
    """Origin and direction of rays in each shape's frame, components with the shapes' axis first."""
    extra = (1,) * (direction.ndim - 1)

    def of(a: Any) -> Any:
        return a.reshape(a.shape[0], *extra)

    turn, place = placed.turn[part], placed.place[part]
    from_ = [origin[..., i][None] - of(place[:, i]) for i in range(3)]
    o = tuple(sum(of(turn[:, i, k]) * from_[i] for i in range(3)) for k in range(3))
    d = tuple(sum(of(turn[:, i, k]) * direction[..., i][None] for i in range(3)) for k in range(3))
    return o, d


def _column(size: Any, i: int, like: Any) -> Any:
    return size[:, i].reshape(-1, *(1,) * (like.ndim - 1))


def _over(value: Any) -> Any:
    """1 / value without a division by zero."""
    return 1.0 / jnp.where(jnp.abs(value) < 1e-9, jnp.where(value < 0, -1e-9, 1e-9), value)


def _first(enter: Any, leave: Any) -> Any:
    """The entry if it lies ahead and before the exit."""
    return jnp.where((enter < leave) & (enter > 0.0), enter, _FAR)


def _box(size: Any, o: tuple, d: tuple) -> Any:
    enter, leave = -jnp.inf, jnp.inf
    for i in range(3):
        half, inverse = _column(size, i, d[0]), _over(d[i])
        a, b = (-half - o[i]) * inverse, (half - o[i]) * inverse
        enter, leave = jnp.maximum(enter, jnp.minimum(a, b)), jnp.minimum(leave, jnp.maximum(a, b))
    return _first(enter, leave)


def _round(a: Any, b: Any, c: Any) -> tuple[Any, Any]:
    """Where a t^2 + 2 b t + c is negative: from, to; an empty span where it never is."""
    root = b * b - a * c
    some = root > 0.0
    root, inverse = jnp.sqrt(jnp.where(some, root, 0.0)), _over(a)
    # along the axis nothing changes: all of the ray is within, or nothing
    along = a < 1e-12
    never, always = jnp.where(along & (c < 0.0), -_FAR, _FAR), jnp.where(along & (c < 0.0), _FAR, -_FAR)
    some = some & ~along
    return jnp.where(some, (-b - root) * inverse, never), jnp.where(some, (-b + root) * inverse, always)


def _cylinder(size: Any, o: tuple, d: tuple) -> Any:
    r, half = _column(size, 0, d[0]), _column(size, 1, d[0])
    enter, leave = _round(d[0] ** 2 + d[1] ** 2, o[0] * d[0] + o[1] * d[1], o[0] ** 2 + o[1] ** 2 - r * r)
    inverse = _over(d[2])
    a, b = (-half - o[2]) * inverse, (half - o[2]) * inverse
    return _first(jnp.maximum(enter, jnp.minimum(a, b)), jnp.minimum(leave, jnp.maximum(a, b)))


def _sphere(o: tuple, d: tuple, r: Any, lift: Any) -> Any:
    z = o[2] - lift
    return _first(
        *_round(
            d[0] ** 2 + d[1] ** 2 + d[2] ** 2,
            o[0] * d[0] + o[1] * d[1] + z * d[2],
            o[0] ** 2 + o[1] ** 2 + z * z - r * r,
        )
    )


def _capsule(size: Any, o: tuple, d: tuple) -> Any:
    r, half = _column(size, 0, d[0]), _column(size, 1, d[0])
    caps = jnp.minimum(_sphere(o, d, r, half), _sphere(o, d, r, -half))
    return jnp.minimum(_cylinder(size, o, d), caps)


def _ellipsoid(size: Any, o: tuple, d: tuple) -> Any:
    inverse = [1.0 / _column(size, i, d[0]) for i in range(3)]
    o, d = (tuple(v * k for v, k in zip(w, inverse, strict=True)) for w in (o, d))
    return _sphere(o, d, 1.0, 0.0)


_ENTRY = {BOX: _box, CYLINDER: _cylinder, CAPSULE: _capsule, ELLIPSOID: _ellipsoid}


def normal(placed: Placed, which: Any, point: Any) -> Any:
    """Outward unit normals (..., 3) of the shapes `which` at points (..., 3) on their surfaces."""
    turn, size = placed.turn[which], placed.size[which]
    kind = jnp.asarray(placed.kind)[which]
    away = point - placed.place[which]
    x, y, z = (jnp.sum(turn[..., :, k] * away, axis=-1) for k in range(3))
    sx, sy, sz = (size[..., i] for i in range(3))
    # a box's face is the one that the point is nearest to, as a share of the half size
    ax, ay, az = jnp.abs(x) / sx, jnp.abs(y) / sy, jnp.abs(z) / sz
    zero = jnp.zeros_like(x)
    on_x, on_y = (ax >= ay) & (ax >= az), (ay > ax) & (ay >= az)
    box = (
        jnp.where(on_x, jnp.sign(x), zero),
        jnp.where(on_y, jnp.sign(y), zero),
        jnp.where(on_x | on_y, zero, jnp.sign(z)),
    )
    on_cap = jnp.abs(z) / sy > jnp.sqrt(x * x + y * y) / sx
    cylinder = (jnp.where(on_cap, zero, x), jnp.where(on_cap, zero, y), jnp.where(on_cap, jnp.sign(z), zero))
    capsule = (x, y, z - jnp.clip(z, -sy, sy))
    ellipsoid = (x / sx**2, y / sy**2, z / sz**2)
    own = []
    for i in range(3):
        value = box[i]
        for code, other in ((CYLINDER, cylinder), (CAPSULE, capsule), (ELLIPSOID, ellipsoid)):
            value = jnp.where(kind == code, other[i], value)
        own.append(value)
    length = jnp.sqrt(sum(v * v for v in own))
    unit = [v / jnp.maximum(length, 1e-12) for v in own]
    return jnp.stack([sum(turn[..., i, k] * unit[k] for k in range(3)) for i in range(3)], axis=-1)
