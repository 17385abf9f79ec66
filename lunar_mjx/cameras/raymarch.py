"""Depth and height images of many rovers in pure JAX: rays marched over the height field, without OpenGL.

A ray advances by as much as ground of a slope of `STEEPEST` would let it, and by no less than a fixed share of its
length, until it is below the surface; bisection then finds where it went in. What is thinner than such a step seen from
its side, such as the very edge of a rock, can be missed. Rovers and colours are added in `batch`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lunar_mjx.cameras.pinhole import Pinhole, Pose
from lunar_mjx.cameras.shapes import rotation
from lunar_mjx.terrain import Terrain, inside, surface

STEEPEST = 1.5
"""Slope (rise over run) up to which no step passes through the ground."""

STEPS, HALVINGS = 96, 12
"""Steps of a ray, and halvings of the last one: 12 leave 1/4096 of it."""
START = 0.2
"""Depth at which marching begins, m."""


@jax.default_matmul_precision("highest")  # not TF32, in which rays of a GPU miss by a thousandth
def depth_image(
    terrain: Terrain,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    camera: Pinhole,
    far: float = 60.0,
    steps: int = STEPS,
) -> Float[Array, "height width"]:
    """Depth along the optical axis of what a camera sees of the terrain and its rocks, m; infinite beyond `far`.

    Args:
      terrain: one terrain.
      position, rotation: of the camera, as in `Pose`; see `mounted`.
      camera: optics.
      far: largest depth that is looked for, m. steps: of the march; more find thinner things.

    Returns:
      Depth, m. Ground beyond the edge of the grid counts as sky.
    """
    direction = jnp.asarray(camera.rays(), position.dtype) @ rotation.T
    return march(terrain, position, direction, far, steps)


def march(
    terrain: Terrain,
    origin: Float[Array, "*ray 3"],
    direction: Float[Array, "*ray 3"],
    far: Any,
    steps: int = STEPS,
    start: float = START,
    refine: int = HALVINGS,
) -> Float[Array, "*ray"]:
    """Where rays meet the ground or a rock, as a multiple of their direction; infinite if not within `far`.

    Args:
      terrain: one terrain.
      origin: (3,) for all, or of each ray, m. direction: of any length.
      far: largest multiple that is looked for, one for all or of each ray.
      steps: of the march; more find thinner things. start: where it begins.
      refine: halvings that find the place; with 0 only whether something is met counts.

    Returns:
      The multiple. Ground beyond the edge of the grid is not met.
    """
    dx, dy, dz = (direction[..., i] for i in range(3))
    ox, oy, oz = (origin[..., i] for i in range(3))
    closing = STEEPEST * jnp.sqrt(dx * dx + dy * dy) - dz
    grow = (jnp.maximum(far, 2.0 * start) / start) ** (1.0 / steps) - 1.0

    def gap(t: Any) -> Any:
        return oz + t * dz - surface(terrain, ox + t * dx, oy + t * dy)

    def advance(_: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        before, t = carry
        above = gap(t)
        step = jnp.maximum(above / jnp.maximum(closing, 1e-3), grow * t)
        free = (above > 0.0) & (t < far)
        return jnp.where(free, t, before), jnp.where(free, jnp.minimum(t + step, 1.01 * far), t)

    def halve(_: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        low, high = carry
        middle = 0.5 * (low + high)
        above = gap(middle) > 0.0
        return jnp.where(above, middle, low), jnp.where(above, high, middle)

    zero = jnp.zeros_like(dx)
    low, high = jax.lax.fori_loop(0, steps, advance, (zero, zero + start))
    met = gap(high) <= 0.0
    low, high = jax.lax.fori_loop(0, refine, halve, (low, high))
    there = inside(terrain.field, ox + high * dx, oy + high * dy)
    return jnp.where(met & there & (high <= far), high, jnp.inf)


def depth_images(
    terrain: Terrain,
    position: Float[Array, "rover 3"],
    rotation: Float[Array, "rover 3 3"],
    camera: Pinhole,
    far: float = 60.0,
    steps: int = STEPS,
    at_once: int | None = None,
) -> Float[Array, "rover height width"]:
    """`depth_image` of many cameras on one terrain; `at_once` bounds how many are in memory (all if None)."""

    def one(pose: tuple[Any, Any]) -> Any:
        return depth_image(terrain, pose[0], pose[1], camera, far, steps)

    if at_once is None:
        return jax.vmap(lambda p, r: one((p, r)))(position, rotation)
    return jax.lax.map(one, (position, rotation), batch_size=at_once)


@jax.default_matmul_precision("highest")  # not TF32, the default of GPUs
def mounted(
    mount: Pose, qpos: Float[Array, "*rover nq"]
) -> tuple[Float[Array, "*rover 3"], Float[Array, "*rover 3 3"]]:
    """Position and rotation in the world of a camera that rovers carry.

    Args:
      mount: its pose in the chassis frame, such as `front_mount(rover)`.
      qpos: the rovers' coordinates; place and orientation of the chassis come first.
    """
    body = rotation(qpos[..., 3:7])
    arm = jnp.asarray(mount.position, qpos.dtype)
    return qpos[..., :3] + _turned(body, arm), body @ jnp.asarray(mount.rotation, qpos.dtype)


def height_scan(
    terrain: Terrain,
    position: Float[Array, "*rover 3"],
    yaw: Float[Array, "*rover"],
    shape: tuple[int, int] = (32, 32),
    ahead: tuple[float, float] = (-1.0, 5.0),
    aside: float = 3.0,
) -> Float[Array, "*rover rows cols"]:
    """A picture of heights around rovers, seen from above: rows from far to near, columns from left to right.

    Args:
      terrain: one terrain.
      position: of the chassis, m. yaw: its heading, rad.
      shape: rows and columns.
      ahead: from where to where along the heading, m. aside: how far to either side, m.

    Returns:
      Height of the ground or rock over the chassis' position, m.
    """
    dtype = position.dtype
    forward = jnp.linspace(ahead[1], ahead[0], shape[0], dtype=dtype)[:, None]
    left = jnp.linspace(aside, -aside, shape[1], dtype=dtype)[None, :]
    cos, sin = jnp.cos(yaw)[..., None, None], jnp.sin(yaw)[..., None, None]
    place = position[..., None, None, :]
    x, y = place[..., 0] + cos * forward - sin * left, place[..., 1] + sin * forward + cos * left
    return surface(terrain, x, y) - place[..., 2]


def _turned(rotation: Float[Array, "*rover 3 3"], vector: Float[Array, "3"]) -> Float[Array, "*rover 3"]:
    return jnp.sum(rotation * vector, axis=-1)
