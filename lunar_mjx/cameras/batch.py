"""Colour, depth and labels of many cameras in pure JAX: rays onto ground, rocks and rovers' shapes.

One ray a pixel finds what is seen, a second one whether the Sun reaches it: shadows are hard, from ground, rocks and
rovers, at any height of the Sun. Light that sunlit ground throws onto what faces it stands in for what a path tracer
would gather; Earth shines without shadows. Dust that wheels throw up veils what lies behind it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lunar_mjx.cameras.dust.grains import SPRAY, Grains
from lunar_mjx.cameras.dust.steady import steady_dust
from lunar_mjx.cameras.dust.veil import veil
from lunar_mjx.cameras.mount import front_mount
from lunar_mjx.cameras.photometry import ROCK_BRIGHTNESS, Film, Regolith
from lunar_mjx.cameras.pinhole import Pinhole, Pose
from lunar_mjx.cameras.raymarch import in_parts, mounted
from lunar_mjx.cameras.rays.trace import GROUND, ROCK, ROVER, SKY, sunlit, trace
from lunar_mjx.cameras.scene import Sun
from lunar_mjx.cameras.shapes import Placed, bodies, placed, rover_shapes, together
from lunar_mjx.cameras.texture import ALBEDO, SOIL_TEXTURE, TINT, Track, TrackPainter, regolith
from lunar_mjx.rover import Rover
from lunar_mjx.terrain import HeightField, Terrain, sample


@dataclasses.dataclass(frozen=True)
class BatchView:
    """How pictures of a batch are lit."""

    lit_ground: float = 0.12
    """Share of sunlight that ground throws back to all sides."""
    edge: float = 0.1
    """Share of painted ground, at each side, over which its mottling fades out."""
    horizon: float = 0.02
    """Share of the sky that lit slopes fill, as level ground sees it."""
    rut: float = 0.002
    """Depth of pressed soil at which a rut is as dark as `RoverCamera` draws tracks, m; a shallower one is less."""


BATCH_VIEW = BatchView()


@dataclasses.dataclass(frozen=True)
class Light:
    """Where light comes from.

    Attributes:
      sun: where the Sun stands.
      earth: towards Earth, (3,), of any length. earthshine: its light over the Sun's. A full Earth gives 1e-4.
      soil: how the ground reflects. film: how the camera exposes.
    """

    sun: Sun = dataclasses.field(default_factory=Sun)
    earth: tuple[float, float, float] = (0.0, -1.0, 0.15)
    earthshine: float = 1e-4
    soil: Regolith = dataclasses.field(default_factory=Regolith)
    film: Film = dataclasses.field(default_factory=Film)


class Ruts(Protocol):
    """What wheels did to the ground, such as `Relief` of the effect `ruts`; a pytree."""

    def at(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Height of soil moved and depth pressed, m, at points of any shape."""
        ...


class Pictures(NamedTuple):
    """Colour, depth and labels of one or many cameras.

    Attributes:
      rgb: 0 to 1, as shown on a screen; None if nothing is lit. depth: m along the optical axis, infinite in the sky.
      label: into `LABELS`.
    """

    rgb: Float[Array, "*camera height width 3"] | None
    depth: Float[Array, "*camera height width"]
    label: Int[Array, "*camera height width"]


def picture(
    terrain: Terrain,
    position: Float[Array, "3"],
    turn: Float[Array, "3 3"],
    camera: Pinhole,
    light: Light | None = None,
    rovers: Placed | None = None,
    sun: Any = None,
    paint: HeightField | Callable[[Any, Any], Any] | None = None,
    key: Any = None,
    far: float = 60.0,
    lit: bool = True,
    dust: Grains | None = None,
    smear: int = SPRAY.smear,
) -> Pictures:
    """Colour, depth and labels of one camera.

    Args:
      terrain: ground and rocks.
      position, turn: of the camera, as in `Pose`; see `mounted`.
      camera: optics. light: what shines, and how the camera exposes.
      rovers: shapes in the world, see `placed` and `together`; none if None.
      sun: (3,) unit vector towards the Sun in place of `light.sun`, so that it may differ between cameras of a batch.
      paint: brightness of the ground over that of plain soil, such as mottling and wheel tracks: a grid, see
        `painted` and `trodden`, or a function of x and y, m, see `rutted`.
      key: random key of the noise; no noise if None.
      far: largest depth that is looked for, m.
      lit: whether colour is sought; without it no ray asks for shadows.
      dust: grains in flight, which colour shows, and neither depth nor labels; see `steady_dust` and `Dust.at`.
      smear: places along the streak that a grain draws while the picture is exposed.
    """
    light = light or Light()
    dtype = position.dtype
    to_sun = jnp.asarray(light.sun.direction if sun is None else sun, dtype) if lit else None
    solid = None if rovers is None else bodies(rovers)
    found = trace(terrain, position, turn, camera, far, to_sun, solid)
    if to_sun is None:
        return Pictures(None, found.depth, found.label)
    depth, label, face = found.depth, found.label, found.face
    direction = jnp.sum(turn * jnp.asarray(camera.rays(), dtype)[..., None, :], axis=-1)
    point = position + jnp.where(label == SKY, 0.0, depth)[..., None] * direction
    to_eye = -direction / jnp.sqrt(jnp.sum(direction**2, axis=-1, keepdims=True))
    bright = _brightness(light, label, face, to_eye, to_sun, found.lit, point, paint)
    if rovers is not None:
        colour = rovers.colour[found.which]
        bright = jnp.where((label == ROVER)[..., None], bright * colour, bright * jnp.asarray(TINT, dtype))
    else:
        bright = bright * jnp.asarray(TINT, dtype)
    bright = jnp.where((label == SKY)[..., None], 0.0, bright)
    if dust is not None:
        shone = sunlit(terrain, jnp.asarray(dust.position, dtype), to_sun, solid)
        bright = veil(bright, depth, position, turn, camera, dust, shone, to_sun, light.soil, smear)
    return Pictures(_exposed(bright, light, camera, to_sun, key), depth, label)


def pictures(
    terrain: Terrain,
    rover: Rover,
    qpos: Float[Array, "rover nq"],
    camera: Pinhole | None = None,
    mount: Pose | None = None,
    light: Light | None = None,
    others: Float[Array, "rover other nq"] | None = None,
    at_once: int | None = None,
    detail: bool = False,
    qvel: Float[Array, "rover nv"] | None = None,
    others_qvel: Float[Array, "rover other nv"] | None = None,
    gravity: Any = SPRAY.gravity,
    grains: int = 24,
    ruts: Ruts | None = None,
    **more: Any,
) -> Pictures:
    """What the front cameras of many rovers see of ground, rocks, themselves and each other.

    Args:
      terrain: one for all.
      rover: what they are. qpos: their coordinates.
      camera: optics. mount: the camera's pose in the chassis frame; `front_mount` if None. light: see `Light`.
      others: coordinates of other rovers of the kind that each camera may see.
      at_once: how many pictures are in memory at once; all if None, at most 65,535.
      detail: whether parts too small for small pictures are drawn, such as grousers.
      qvel: velocities of the MJCF, if the soil that wheels throw up is to be seen; see `steady_dust`.
      others_qvel: those of the others. gravity: under which it flies, m/s2.
      grains: drawn of each wheel; more look finer in large pictures, and take time.
      ruts: that each rover knows of, leading axis `rover`: its pressed soil is darker. Their depth is not drawn.
      more: `far`, `paint` and `lit` of `picture`.
    """
    # Small by default: pictures for learning, not for looking.
    shapes, optics = rover_shapes(rover, detail), camera or Pinhole(64, 48)
    camera_mount = mount or front_mount(rover)

    def one(given: tuple) -> Pictures:
        own, own_velocity, other, other_velocity, pressed = given
        position, turn = mounted(camera_mount, own)
        seen = [placed(shapes, rover, own)]
        flying = [] if own_velocity is None else [steady_dust(terrain, rover, own, own_velocity, gravity, grains)]
        if other is not None:
            seen += [placed(shapes, rover, q) for q in other]
        if other is not None and other_velocity is not None:
            pairs = zip(other, other_velocity, strict=True)
            flying += [steady_dust(terrain, rover, q, v, gravity, grains) for q, v in pairs]
        scene = together(*seen) if len(seen) > 1 else seen[0]
        dust = Grains(*(jnp.concatenate(part) for part in zip(*flying, strict=True))) if flying else None
        # A grain stands for so much soil that it is wider than its streak is long.
        seen_ground: dict[str, Any] = more if pressed is None else more | {"paint": rutted(pressed, more.get("paint"))}
        return picture(terrain, position, turn, optics, light, scene, dust=dust, smear=1, **seen_ground)

    return in_parts(one, (qpos, qvel, others, others_qvel, ruts), at_once)


def stereo(mount: Pose, baseline: float) -> tuple[Pose, Pose]:
    """Left and right camera `baseline` m apart, about a mount, looking the same way."""
    aside = 0.5 * baseline * mount.rotation[:, 0]
    return Pose(mount.position - aside, mount.rotation), Pose(mount.position + aside, mount.rotation)


def painted(shade: np.ndarray, low: Any, metres: Any) -> HeightField:
    """Brightness of the ground for `picture`, from a square picture with north up.

    Args:
      shade: (rows, cols) brightness, 1 for plain soil. low: west and south edge, m. metres: extent of a side, m.
    """
    cols = shade.shape[1]
    cell = float(np.ravel(metres)[0]) / cols
    # Pictures have the north at the top, fields in the last row.
    values = jnp.asarray(np.asarray(shade, np.float32)[::-1])
    return HeightField(
        values,
        jnp.asarray(low[0] + 0.5 * cell, jnp.float32),
        jnp.asarray(low[1] + 0.5 * cell, jnp.float32),
        jnp.asarray(cell, jnp.float32),
    )


def trodden(tracks: Sequence[Track], low: Any, side: float, rows: int | None = None, texels: int = 2048) -> HeightField:
    """Mottled ground with wheel tracks as `paint` of `picture`: the ruts and prints that `RoverCamera` shows of them.

    Args:
      tracks: of the wheels; see `chase.wheel_tracks`. low: west and south edge of a square, (2,) m. side: of it, m.
      rows: of the tracks' places that are shown; all if None. texels: of a side.

    Returns:
      Brightness over that of plain soil, (texels, texels); 1 at the edge, so that all beyond is plain.
    """
    painter = TrackPainter(regolith(texels, side), list(low), [side, side], tracks)
    ground = painter.paint(max((len(t.places) for t in tracks), default=0) if rows is None else rows)
    # Over the mean albedo, since paint is a factor on the ground's own.
    shown = np.asarray(ground, np.float32).mean(axis=-1) / (255.0 * float(ALBEDO.mean()))
    at = np.linspace(0.0, 1.0, texels, dtype=np.float32)
    inner = np.clip(np.minimum(at, 1.0 - at) / BATCH_VIEW.edge, 0.0, 1.0)
    fade = np.minimum(inner[:, None], inner[None, :])  # beyond the paint its border's shade would go on as stripes
    # The painter shades what a screen shows, which is the root of the light.
    return painted(1.0 + fade * (shown ** Film().gamma - 1.0), low, side)


def rutted(ruts: Ruts, under: HeightField | None = None) -> Callable[[Any, Any], Any]:
    """Brightness of ground that wheels have pressed, as `paint` of `picture`: tracks without a list of places.

    Args:
      ruts: what wheels did to the ground. under: paint of the ground that they lie on.

    Returns:
      A function of x and y, m, of any shape: brightness over that of plain soil, of that shape.
    """

    def shade(x: Any, y: Any) -> Any:
        _, pressed = ruts.at(x, y)
        # The root of the light is what a screen shows.
        dark = (1.0 - (SOIL_TEXTURE.rut / 255.0) ** Film().gamma) * jnp.clip(pressed / BATCH_VIEW.rut, 0.0, 1.0)
        return (1.0 - dark) * (1.0 if under is None else sample(under, x, y)[0])

    return shade


def _brightness(light: Light, label: Any, face: Any, to_eye: Any, to_sun: Any, lit: Any, point: Any, paint: Any) -> Any:
    """I/F of what is seen, (..., 1), before its colour."""
    soil = light.soil
    earth = np.asarray(light.earth, float) / np.linalg.norm(light.earth)
    mu = jnp.sum(face * to_eye, axis=-1)

    def under(to_light: Any) -> Any:
        mu0 = jnp.sum(face * to_light, axis=-1)
        ground = soil.radiance_factor(mu0, mu, jnp.sum(to_eye * to_light, axis=-1))
        ground = ground * jnp.where(label == ROCK, ROCK_BRIGHTNESS, 1.0)
        # Paint diffuses; regolith throws light back to where it comes from.
        return jnp.where(label == ROVER, jnp.maximum(mu0, 0.0), ground)

    direct = under(to_sun) * lit + light.earthshine * under(jnp.asarray(earth, face.dtype))
    # sunlit ground fills the half of the sky below a wall, and a little of it above level ground
    seen = 0.5 * (1.0 - face[..., 2]) + BATCH_VIEW.horizon
    # By the sine of the Sun's height: low light brings little onto level ground.
    thrown = seen * BATCH_VIEW.lit_ground * jnp.maximum(to_sun[2], 0.0)
    diffuse = jnp.where(label == ROVER, 1.0, soil.radiance_factor(0.5, 1.0, 0.5) / 0.5)
    bright = direct + thrown * diffuse
    if paint is not None:
        x, y = point[..., 0], point[..., 1]
        value: Any = paint(x, y) if callable(paint) else sample(paint, x, y)[0]
        bright = bright * jnp.where(label == GROUND, value, 1.0)
    return bright[..., None]


def _exposed(bright: Any, light: Light, camera: Pinhole, to_sun: Any, key: Any) -> Any:
    """From I/F to what a screen shows: optics, exposure, noise, gamma."""
    film = light.film
    value = bright * film.gain(light.soil, to_sun[2])
    chance = None if key is None else jax.random.normal(key, value.shape, value.dtype)
    return film.developed(value, camera.rays(), chance)
