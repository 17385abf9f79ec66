"""Depth and height images of many rovers in pure JAX, without OpenGL. Rovers and colours are added in `batch`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lunar_mjx.cameras.pinhole import Pinhole, Pose
from lunar_mjx.cameras.rays.trace import TRACE, trace
from lunar_mjx.cameras.shapes import rotation
from lunar_mjx.terrain import Terrain, surface


def depth_image(
    terrain: Terrain, position: Float[Array, "3"], rotation: Float[Array, "3 3"], camera: Pinhole, far: float = 60.0
) -> Float[Array, "height width"]:
    """Depth along the optical axis of what a camera sees of the terrain and its rocks, m; infinite beyond `far`.

    Args:
      terrain: one terrain.
      position, rotation: of the camera, as in `Pose`; see `mounted`.
      camera: optics.
      far: largest depth that is looked for, m.

    Returns:
      Depth, m. Ground beyond the edge of the grid counts as sky.
    """
    return trace(terrain, position, rotation, camera, far).depth


def depth_images(
    terrain: Terrain,
    position: Float[Array, "rover 3"],
    rotation: Float[Array, "rover 3 3"],
    camera: Pinhole,
    far: float = 60.0,
    at_once: int | None = None,
) -> Float[Array, "rover height width"]:
    """`depth_image` of many cameras on one terrain; `at_once` bounds how many are in memory (all if None)."""
    return in_parts(lambda at: depth_image(terrain, at[0], at[1], camera, far), (position, rotation), at_once)


def in_parts(one: Callable[[tuple], Any], given: tuple, at_once: int | None) -> Any:
    """`one` of every entry of `given` along its first axis; at most `at_once` of them, and 65,535, side by side."""
    # all at once is fastest; in parts, where pictures do not fit into memory together
    at_once = min(at_once or TRACE.most_pictures, TRACE.most_pictures)
    if given[0].shape[0] <= at_once:
        return jax.vmap(one)(given)
    return jax.lax.map(one, given, batch_size=at_once)


@jax.default_matmul_precision("highest")  # not TF32, the default of GPUs
def mounted(
    mount: Pose, qpos: Float[Array, "*rover nq"]
) -> tuple[Float[Array, "*rover 3"], Float[Array, "*rover 3 3"]]:
    """Position and rotation in the world of a camera that rovers carry.

    Args:
      mount: its pose in the chassis frame, such as `front_mount(rover)`.
      qpos: the rovers' coordinates; place and orientation of the chassis come first.
    """
    qpos = jnp.asarray(qpos)  # MuJoCo gives float64, of which JAX would warn at every use
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
    position = jnp.asarray(position)  # as above
    dtype = position.dtype
    forward = jnp.linspace(ahead[1], ahead[0], shape[0], dtype=dtype)[:, None]
    left = jnp.linspace(aside, -aside, shape[1], dtype=dtype)[None, :]
    cos, sin = jnp.cos(yaw)[..., None, None], jnp.sin(yaw)[..., None, None]
    place = position[..., None, None, :]
    x, y = place[..., 0] + cos * forward - sin * left, place[..., 1] + sin * forward + cos * left
    return surface(terrain, x, y) - place[..., 2]


def _turned(rotation: Float[Array, "*rover 3 3"], vector: Float[Array, "3"]) -> Float[Array, "*rover 3"]:
    return jnp.sum(rotation * vector, axis=-1)
