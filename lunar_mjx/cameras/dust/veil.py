"""How grains in flight veil a picture: on the host, grain by grain, and in JAX, where numbers of grains stay the same.

Light is scattered once: grains of optical depth t let exp(-t) of what is behind through and add 1 - exp(-t) of the
brightness of a thick cloud.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.cameras.dust.grains import SPRAY, Grains
from lunar_mjx.cameras.photometry import Regolith
from lunar_mjx.cameras.pinhole import Pinhole, Pose, project
from lunar_mjx.cameras.texture import TINT
from lunar_mjx.rover.look import LOOK


@dataclasses.dataclass(frozen=True)
class Splat:
    """How grains are drawn."""

    finest: float = 0.5
    """Least spread of a grain, pixels, or grains would flicker as they move."""
    widest: float = 4.0
    """Largest spread, pixels, for speed."""
    beyond: float = 1.2
    """How far beyond the picture's border, over its distance from the middle, grains are looked for: a lens is known
    inside the picture alone, and would bring what is far outside back into it."""
    at_once: int = 32
    """Places of grains that pictures of a batch look through together."""
    thinnest: float = 1e-3
    """Optical depth below which a pixel shows no dust, on the host."""


SPLAT = Splat()


def sunlit(model: Any, data: Any, places: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Which places, (n, 3) m, the Sun reaches, (n,) bool: False in the shadow of rover, rock or ground.

    Args:
      model, data: the scene, its bodies placed. sun: unit vector towards the Sun.
    """
    seen = np.array([group < LOOK.hidden for group in range(6)], np.uint8)
    met, towards = np.zeros(1, np.int32), np.asarray(sun, float)
    return np.array([mujoco.mj_ray(model, data, p, towards, seen, True, -1, met) < 0.0 for p in places], bool)


def veiled(
    light: Float[np.ndarray, "height width 3"],
    depth: Float[np.ndarray, "height width"],
    pose: Pose,
    camera: Pinhole,
    grains: Grains,
    lit: np.ndarray,
    sun: np.ndarray,
    gain: float,
    soil: Regolith | None = None,
) -> Float[np.ndarray, "height width 3"]:
    """Light with grains before what it shows; pixels without grains stay as they are.

    Args:
      light: on the sensor. depth: m along the axis. pose, camera: that took it.
      grains: in flight. lit: whether the Sun reaches each, (grain,). sun: unit vector towards the Sun.
      gain: light on the sensor of I/F = 1. soil: what the grains are of.
    """
    height, width = depth.shape
    places, spread, area, who = _streaks(np, grains, SPRAY.smear)
    column, row, away = project(pose, camera, places).T
    near = (away > camera.near) & (abs(column - 0.5 * width) < width) & (abs(row - 0.5 * height) < height)
    x, y, z = ((places - pose.position) @ pose.rotation).T
    near &= x * x + y * y < _widest(camera) * z * z
    if not near.any():
        return light
    sums = np.zeros((2, height * width))
    # In parts, alike in size, since the widest sets how many pixels are looked at for each.
    order = np.flatnonzero(near)[np.argsort(spread[near] / away[near])]
    for part in np.array_split(order, math.ceil(len(order) / SPRAY.at_once)):
        pixel, thick, which = _splats(column[part], row[part], away[part], spread[part], area[part], depth, camera)
        sums[0] += np.bincount(pixel, thick, height * width)
        sums[1] += np.bincount(pixel, thick * lit[who[part]][which], height * width)
    touched = (sums[0] > SPLAT.thinnest).reshape(height, width)
    total, shine = (s.reshape(height, width)[touched] for s in sums)
    rays = camera.rays()[touched] @ pose.rotation.T
    cos_phase = -(rays @ sun) / np.linalg.norm(rays, axis=-1)
    out = light.copy()
    cloud = gain * np.asarray((soil or Regolith()).cloud(cos_phase))
    out[touched] = _through(np, light[touched], total, shine, cloud)
    return out


def veil(
    bright: Float[Array, "height width 3"],
    depth: Float[Array, "height width"],
    position: Float[Array, "3"],
    turn: Float[Array, "3 3"],
    camera: Pinhole,
    grains: Grains,
    lit: Float[Array, "grain"],
    to_sun: Float[Array, "3"],
    soil: Regolith,
    smear: int = SPRAY.smear,
) -> Float[Array, "height width 3"]:
    """I/F with grains before what it shows, of one camera: what `veiled` does, in JAX.

    Time goes with pixels times grains times places along their streaks.

    Args:
      bright: I/F without grains. depth: m along the axis. position, turn: of the camera, as in `Pose`.
      camera: optics. grains: in flight; those without area are none. lit: 1 where the Sun reaches a grain.
      to_sun: unit vector towards the Sun. soil: what the grains are of. smear: places along a grain's streak.
    """
    dtype = bright.dtype
    places, spread, area, who = _streaks(jnp, Grains(*(jnp.asarray(g) for g in grains)), smear)
    x, y, z = (jnp.sum((places - position) * turn[:, i], axis=-1) for i in range(3))
    away = jnp.where(-z > camera.near, -z, 1.0)
    right, down = x / away, -y / away
    inside = (-z > camera.near) & (right * right + down * down < _widest(camera))
    if camera.lens is not None:
        right, down = camera.lens.bent(right, down)
    column, row = 0.5 * camera.width + camera.focal * right, 0.5 * camera.height + camera.focal * down
    scale = camera.focal / away
    sigma = jnp.clip(spread * scale, SPLAT.finest, SPLAT.widest)
    peak = jnp.where(inside, area * scale**2 / (2.0 * math.pi * sigma**2), 0.0)
    table = jnp.stack([column, row, away, 1.0 / sigma, peak, peak * lit[who]]).astype(dtype)
    parts = math.ceil(table.shape[1] / SPLAT.at_once)
    table = jnp.pad(table, ((0, 0), (0, parts * SPLAT.at_once - table.shape[1])))
    columns, rows = (jnp.arange(n, dtype=dtype) + 0.5 for n in (camera.width, camera.height))

    def some(part: Any, sums: tuple) -> tuple:
        at, up, far, fine, thick, shine = jax.lax.dynamic_slice_in_dim(table, part * SPLAT.at_once, SPLAT.at_once, 1)
        across = jnp.exp(-0.5 * ((columns - at[:, None]) * fine[:, None]) ** 2)
        along = jnp.exp(-0.5 * ((rows - up[:, None]) * fine[:, None]) ** 2)
        # Behind what the pixel shows nothing is seen.
        seen = jnp.where(far[:, None, None] < depth, along[:, :, None] * across[:, None, :], 0.0)
        return tuple(s + jnp.sum(w[:, None, None] * seen, axis=0) for s, w in zip(sums, (thick, shine), strict=True))

    total, shine = jax.lax.fori_loop(0, parts, some, (jnp.zeros_like(depth),) * 2)
    rays = jnp.sum(turn * jnp.asarray(camera.rays(), dtype)[..., None, :], axis=-1)
    cos_phase = -jnp.sum(rays * to_sun, axis=-1) / jnp.sqrt(jnp.sum(rays**2, axis=-1))
    return _through(jnp, bright, total, shine, soil.cloud(cos_phase))


def _streaks(xp: Any, grains: Grains, smear: int) -> tuple[Any, Any, Any, Any]:
    """Places along the way of each grain while a picture is exposed: where, how wide, cross-section, which grain."""
    shares = np.linspace(-0.5, 0.5, smear) if smear > 1 else np.zeros(1)
    late = SPRAY.shutter * shares[:, None, None]
    places = (grains.position + late * grains.velocity).reshape(-1, 3)
    who = np.tile(np.arange(len(grains.area)), smear)
    return places, xp.tile(grains.spread, smear), xp.tile(grains.area / smear, smear), who


def _widest(camera: Pinhole) -> float:
    """Square of the tangent between the axis and the farthest grain that is looked for."""
    return float(SPLAT.beyond**2 * np.sum(camera.rays()[..., :2] ** 2, axis=-1).max())


def _through(xp: Any, behind: Any, total: Any, shine: Any, cloud: Any) -> Any:
    """Light (..., 3) with dust of an optical depth before it, of which `shine` is lit; `cloud` as bright as a thick one
    is in red."""
    total, lit = total[..., None], (shine / xp.maximum(total, 1e-9))[..., None]
    return behind * xp.exp(-total) + (cloud[..., None] * lit * -xp.expm1(-total)) * TINT


def _splats(
    column: np.ndarray,
    row: np.ndarray,
    away: np.ndarray,
    spread: np.ndarray,
    area: np.ndarray,
    depth: np.ndarray,
    camera: Pinhole,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels before which grains are seen, the optical depth of each grain there, and which grain it is."""
    height, width = depth.shape
    scale = camera.focal / away
    sigma = np.clip(spread * scale, SPLAT.finest, SPLAT.widest)
    most = math.ceil(2.5 * float(sigma.max()))
    reach = np.arange(-most, most + 1)
    columns, rows = (np.floor(v).astype(int)[:, None] + reach for v in (column, row))
    across, down = (
        np.exp(-0.5 * ((at + 0.5 - middle[:, None]) / sigma[:, None]) ** 2)
        for at, middle in ((columns, column), (rows, row))
    )
    thick = (area * scale**2 / (2.0 * math.pi * sigma**2))[:, None, None] * down[:, :, None] * across[:, None, :]
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None, :]
    pixel = np.where(inside, rows[:, :, None] * width + columns[:, None, :], 0)
    shown = inside & (away[:, None, None] < depth.ravel()[pixel])
    return pixel[shown], thick[shown], np.nonzero(shown)[0]
