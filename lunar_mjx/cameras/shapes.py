"""Rovers as boxes, cylinders, capsules and ellipsoids, placed by their joints, in pure JAX."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.cameras.rays.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, table
from lunar_mjx.cameras.rays.trace import Bodies
from lunar_mjx.rover import Rover
from lunar_mjx.rover.look import LOOK, seen_spec

_KINDS = {
    mujoco.mjtGeom.mjGEOM_BOX: BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER: CYLINDER,
    mujoco.mjtGeom.mjGEOM_CAPSULE: CAPSULE,
    mujoco.mjtGeom.mjGEOM_SPHERE: ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_MESH: BOX,
}


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


def bodies(placed: Placed) -> Bodies:
    """Placed shapes as rays meet them; see `rays.trace`."""
    counts = tuple(int(np.sum(placed.kind == kind)) for kind in range(4))
    return Bodies(counts, table(placed.kind, placed.place, placed.turn, placed.size))
