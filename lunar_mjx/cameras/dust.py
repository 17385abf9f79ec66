"""Soil that slipping wheels throw up: grains on ballistic arcs, and how they veil a picture.

There is no air: a grain leaves the rim with at most the rim's own speed over the ground, flies a parabola and comes
down at once, so that sheets trail the wheels and no cloud stays behind (Hsu & Horanyi 2012, Ballistic motion of dust
particles in the Lunar Roving Vehicle dust trails, Am. J. Phys. 80, 452, from films of Apollo 16). It is for the eye
alone: nothing of it acts on the rover, and the same drive throws the same grains each time.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from lunar_mjx.cameras.photometry import Film, Regolith
from lunar_mjx.cameras.pinhole import Pinhole, Pose, project
from lunar_mjx.cameras.texture import ALBEDO
from lunar_mjx.rover import Rover
from lunar_mjx.rover.look import LOOK
from lunar_mjx.terrain import Terrain


@dataclasses.dataclass(frozen=True)
class Spray:
    """What wheels throw, and how it is drawn: a choice, but for the size of grains."""

    layer: float = 1e-4
    """Thickness of the soil that is thrown, over the way that the rim slips, m."""
    soil_density: float = 1500.0
    grain_density: float = 3100.0
    grain_radius: float = 35e-6
    """kg/m3, and half of the mean size of lunar soils, m: 60 to 80 um (McKay et al. 1991 in the Lunar Sourcebook)."""
    per_metre: float = 10000.0
    """Drawn grains for each metre of slip. Each stands for many, by their cross-section."""
    most: int = 3000
    """Drawn grains in flight of one wheel; where there would be more, each stands for twice as many, and so on."""
    quiet: float = 0.01
    """Slip up to which soil is sheared and not thrown, m/s."""
    sweep: float = math.radians(50.0)
    """Angle of the rim over which soil leaves it, behind the place where the rim leaves the ground."""
    slowest: float = 0.3
    """Share of the rim's velocity that the slowest grain has; the fastest has all of it."""
    aside: float = 0.15
    """Most of a grain's velocity that goes sideways, as a share."""
    size: float = 0.002
    growth: float = 0.03
    """Spread of what a drawn grain stands for: at first, m, and how much of its way is added to it."""
    shutter: float = 0.02
    """Time over which a picture is exposed, so that grains are drawn as short streaks, s."""
    smear: int = 4
    """Places along a streak."""
    at_once: int = 2000
    """Such places that are drawn together."""
    upright: float = 0.3
    """Least height of the unit vector across the axle and upwards of a wheel that throws."""
    touch: float = 0.01
    """Distance from the ground within which a wheel touches it, m: grids of pictures and of physics differ by less."""
    heaviest: float = 2.0
    """Gravity from which on there is taken to be air, and no dust is drawn, m/s2."""

    @property
    def cover(self) -> float:
        """Cross-section of the grains from a square metre of slipped ground."""
        return self.layer * self.soil_density * 3.0 / (4.0 * self.grain_density * self.grain_radius)


SPRAY = Spray()


class WheelMotion(NamedTuple):
    """Wheels at each time of a drive.

    Attributes:
      centre: m. axle: unit vector to the left of a wheel that rolls forward. angle: of the drive, rad; forward is
        positive.
    """

    centre: Float[np.ndarray, "time wheel 3"]
    axle: Float[np.ndarray, "time wheel 3"]
    angle: Float[np.ndarray, "time wheel"]


class Grains(NamedTuple):
    """Grains in flight at one time.

    Attributes:
      position: m. velocity: m/s. spread: deviation of the soil that a drawn grain stands for, m. area: its
        cross-section, m2. wheel: that threw it.
    """

    position: Float[np.ndarray, "grain 3"]
    velocity: Float[np.ndarray, "grain 3"]
    spread: Float[np.ndarray, "grain"]
    area: Float[np.ndarray, "grain"]
    wheel: Any


def wheel_motion(rover: Rover, qpos: np.ndarray) -> WheelMotion:
    """Where a rover's wheels are, and how far they have turned, for coordinates (time, nq) of its MJCF."""
    model = rover.compile()
    data = mujoco.MjData(model)
    bodies = [model.body(w.body).id for w in rover.wheels]
    joints = [model.joint(w.drive).id for w in rover.wheels]
    centre, axle = (np.empty((len(qpos), len(bodies), 3)) for _ in range(2))
    for row, row_qpos in enumerate(qpos):
        data.qpos[:] = row_qpos
        mujoco.mj_kinematics(model, data)
        centre[row], axle[row] = data.xpos[bodies], data.xaxis[joints]
    angle = np.asarray(qpos, float)[:, [int(model.jnt_qposadr[j]) for j in joints]]
    return WheelMotion(centre, axle, angle)


class Dust:
    """The soil that wheels throw on a drive; `at` tells what flies at a time.

    A function of the wheels' motion alone, each row of it judged by itself and the one before: a drive that is watched
    while it goes on shows what its replay shows.

    Args:
      rover, terrain: what drives where. Rock throws nothing, nor does a wheel off the ground, such as on a boulder.
      time: of the rows, (time,) s, rising. motion: of the wheels, at these rows. gravity: m/s2, downwards.
      hard: whether all ground is rock, whatever the terrain says. seed: of which grain leaves where and how fast.
    """

    def __init__(
        self,
        rover: Rover,
        terrain: Terrain,
        time: Any,
        motion: WheelMotion,
        gravity: float,
        hard: bool = False,
        seed: int = 0,
    ) -> None:
        self._time, self._gravity, self._seed = np.asarray(time, float), float(gravity), seed
        self._ground = jax.device_get(terrain.field)
        self._width = np.array([w.width for w in rover.wheels])
        self._radius = np.array([w.radius for w in rover.wheels])
        self._rows = None
        if len(self._time) > 1 and gravity < SPRAY.heaviest and not hard:
            self._rows = self._judged(motion, jax.device_get(terrain.soil))

    def _judged(self, motion: WheelMotion, soil: Any) -> dict[str, np.ndarray]:
        """For each row and wheel: axes of the throw, speeds, where the rim leaves the ground, how much is thrown."""
        centre, axle = motion.centre, motion.axle
        step = np.diff(self._time)[:, None]
        # Of a row and the one before it, since live pictures do not know the next.
        velocity = _held(np.diff(centre, axis=0) / step[..., None])
        turning = _held(np.diff(motion.angle, axis=0) / step)
        height, normal = _ground(self._ground, centre[..., 0], centre[..., 1])
        sign = np.where(turning < 0.0, -1.0, 1.0)[..., None]
        ahead = _unit(np.cross(sign * axle, normal))
        up = np.cross(ahead, sign * axle)
        rim = np.abs(turning) * self._radius
        along = velocity - np.sum(velocity * normal, axis=-1, keepdims=True) * normal
        slip = np.linalg.norm(along - rim[..., None] * ahead, axis=-1)
        # By the distance to the plane of the ground, which on a slope is less than the height.
        clear = (centre[..., 2] - height) * normal[..., 2]
        touching = clear < self._radius + SPRAY.touch
        if soil is not None:
            touching &= _bilinear(soil.rock, soil, centre[..., 0], centre[..., 1])[0] < 0.5
        # A rim that does not turn carries nothing up, however fast it skids; nor does a wheel that lies on its side.
        carried = np.minimum(slip, rim) - SPRAY.quiet
        thrown = np.where(touching & (up[..., 2] > SPRAY.upright) & (carried > 0.0), carried, 0.0)
        # Of the way between two rows, so that it grows from row to row by what each is judged to throw.
        way = np.concatenate([np.zeros((1, thrown.shape[1])), np.cumsum(thrown[1:] * step, axis=0)])
        leave = np.arccos(np.clip(clear / self._radius, 0.5, 1.0))
        return {
            "centre": centre,
            "ahead": ahead,
            "up": up,
            "axle": axle,
            "along": along,
            "rim": rim,
            "leave": leave,
            "thrown": thrown,
            "way": way,
        }

    def at(self, time: float) -> Grains:
        """The grains in flight at `time`, s; at most `SPRAY.most` of each wheel."""
        found = [self._of(wheel, time) for wheel in range(len(self._radius))] if self._rows else []
        if not found:
            return _none()
        return Grains(*(np.concatenate(part) for part in zip(*found, strict=True)))

    def _of(self, wheel: int, time: float) -> Grains:
        assert self._rows is not None
        rows = {name: values[:, wheel] for name, values in self._rows.items()}
        way, g, radius = rows["way"], max(self._gravity, 1e-3), self._radius[wheel]
        throws = rows["thrown"] > 0.0
        if not way[-1] > 0.0:
            return _none()
        # Nothing stays up for longer than what the fastest rim throws off the ground, from as high as the axle.
        steepest = min(float(rows["leave"][throws].max()) + SPRAY.sweep, 0.5 * math.pi)
        lift = float(rows["rim"][throws].max()) * math.sin(steepest)
        pull = g * float(rows["up"][throws, 2].min())
        aloft = (lift + math.sqrt(lift**2 + 2.0 * pull * radius)) / pull
        first, last = np.interp([time - aloft, time], self._time, way) * SPRAY.per_metre
        # Few of those thrown since then still fly; far more than could be drawn need not be followed.
        stride = 1
        while (last - first) / stride > 8 * SPRAY.most:
            stride *= 2
        number = np.arange(math.ceil(first / stride), math.floor(last / stride) + 1, dtype=np.int64) * stride
        target = (number + 0.5) / SPRAY.per_metre
        number, target = number[target < way[-1]], target[target < way[-1]]
        row = np.searchsorted(way, target, side="right") - 1
        share = (target - way[row]) / (way[row + 1] - way[row])

        def then(values: np.ndarray) -> np.ndarray:
            part = share if values.ndim == 1 else share[:, None]
            return (1.0 - part) * values[row] + part * values[row + 1]

        age = time - then(self._time)
        angle, slowness, place, side = (_chance(self._seed, wheel, number, k) for k in range(4))
        # Most soil leaves soon: by the square of what chance says.
        angle = then(rows["leave"]) + SPRAY.sweep * angle**2
        cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
        ahead, up, axle, rim = (then(rows[name]) for name in ("ahead", "up", "axle", "rim"))
        start = then(rows["centre"]) - radius * (sin * ahead + cos * up)
        start = start + ((place - 0.5) * self._width[wheel])[:, None] * axle
        # The rim's own velocity over the ground there, some of it turned aside.
        launch = then(rows["along"]) + rim[:, None] * (sin * up - cos * ahead)
        speed = np.linalg.norm(launch, axis=-1, keepdims=True)
        aside = (SPRAY.aside * (2.0 * side - 1.0))[:, None]
        launch = np.sqrt(1.0 - aside**2) * launch + aside * speed * axle
        launch = launch * speed / np.maximum(np.linalg.norm(launch, axis=-1, keepdims=True), 1e-9)
        launch = launch * (1.0 - (1.0 - SPRAY.slowest) * slowness)[:, None]
        fall = np.array([0.0, 0.0, -self._gravity])
        position = start + launch * age[:, None] + 0.5 * fall * (age**2)[:, None]
        flies = (age >= 0.0) & (position[:, 2] > _ground(self._ground, position[:, 0], position[:, 1])[0])
        while flies.sum() > SPRAY.most:
            stride *= 2
            flies &= number % stride == 0
        spread = SPRAY.size + SPRAY.growth * np.linalg.norm(launch, axis=-1) * age
        velocity, count = launch + fall * age[:, None], int(flies.sum())
        area = np.full(count, SPRAY.cover * self._width[wheel] * stride / SPRAY.per_metre)
        return Grains(position[flies], velocity[flies], spread[flies], area, np.full(count, wheel))


def _none() -> Grains:
    return Grains(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0, int))


def sunlit(model: Any, data: Any, places: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Which places, (n, 3) m, the Sun reaches, (n,) bool: False in the shadow of rover, rock or ground.

    Args:
      model, data: the scene, its bodies placed. sun: unit vector towards the Sun.
    """
    seen = np.array([group < LOOK.hidden for group in range(6)], np.uint8)
    met, towards = np.zeros(1, np.int32), np.asarray(sun, float)
    return np.array([mujoco.mj_ray(model, data, p, towards, seen, True, -1, met) < 0.0 for p in places], bool)


def veiled(
    picture: np.ndarray,
    depth: np.ndarray,
    pose: Pose,
    camera: Pinhole,
    grains: Grains,
    lit: np.ndarray,
    sun: np.ndarray,
    soil: Regolith | None = None,
) -> np.ndarray:
    """A picture with grains before what it shows, (height, width, 3) uint8; pixels without grains stay as they are.

    Light is scattered once: grains of optical depth t let exp(-t) of what is behind through and add 1 - exp(-t) of the
    brightness of a thick cloud.

    Args:
      picture: (height, width, 3) uint8 as `Film` shows it. depth: m along the axis, (height, width).
      pose, camera: that took it. grains: in flight. lit: whether the Sun reaches each, (grain,).
      sun: unit vector towards the Sun. soil: what the grains are of.
    """
    height, width = depth.shape
    late = SPRAY.shutter * np.linspace(-0.5, 0.5, SPRAY.smear)[:, None, None]
    places = (grains.position + late * grains.velocity).reshape(-1, 3)
    spread, lit = np.tile(grains.spread, SPRAY.smear), np.tile(lit, SPRAY.smear)
    area = np.tile(grains.area / SPRAY.smear, SPRAY.smear)
    column, row, away = project(pose, camera, places).T
    near = (away > camera.near) & (abs(column - 0.5 * width) < width) & (abs(row - 0.5 * height) < height)
    if not near.any():
        return picture
    sums = np.zeros((2, height * width))
    # In parts, alike in size, since the widest sets how many pixels are looked at for each.
    order = np.flatnonzero(near)[np.argsort(spread[near] / away[near])]
    for part in np.array_split(order, math.ceil(len(order) / SPRAY.at_once)):
        pixel, thick, who = _splats(column[part], row[part], away[part], spread[part], area[part], depth, camera)
        sums[0] += np.bincount(pixel, thick, height * width)
        sums[1] += np.bincount(pixel, thick * lit[part][who], height * width)
    touched = sums[0] > 1e-3
    total, bright = (s[touched][:, None] for s in sums)
    return _blended(picture, touched, total, bright, _glow(pose, grains, sun, soil or Regolith()))


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
    # No finer than half a pixel, or grains would flicker as they move; and no wider than a few, for speed.
    sigma = np.clip(spread * scale, 0.5, 4.0)
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


def _blended(picture: np.ndarray, touched: np.ndarray, total: Any, bright: Any, glow: float) -> np.ndarray:
    """The picture with light added and taken away where grains are, in light and not in what a screen is told."""
    gamma = Film().gamma
    flat = picture.reshape(-1, 3).copy()
    behind = (flat[touched] / 255.0) ** gamma
    passed = np.exp(-total)
    value = behind * passed + glow * ALBEDO / ALBEDO[0] * (bright / total) * (1.0 - passed)
    flat[touched] = np.round(255.0 * np.clip(value, 0.0, 1.0) ** (1.0 / gamma)).astype(np.uint8)
    return flat.reshape(picture.shape)


def _glow(pose: Pose, grains: Grains, sun: np.ndarray, soil: Regolith) -> float:
    """Brightness of a thick cloud of the grains, where level ground is as bright as `Film` exposes it."""
    to_eye = pose.position - grains.position.mean(axis=0)
    cos_phase = float(to_eye @ sun) / max(float(np.linalg.norm(to_eye)), 1e-9)
    return float(Film().gain(soil, float(sun[2])) * soil.cloud(cos_phase))


def _held(rates: np.ndarray) -> np.ndarray:
    """Rates between rows as rates at rows: of the way that led there."""
    return np.concatenate([rates[:1], rates])


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _bilinear(values: Any, grid: Any, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value and its slopes along x and y of a grid, on the host: shapes change from picture to picture."""
    table, cell = np.asarray(values, float), float(grid.cell)
    rows, cols = table.shape
    u, v = (np.asarray(x, float) - float(grid.x0)) / cell, (np.asarray(y, float) - float(grid.y0)) / cell
    u, v = np.clip(np.nan_to_num(u), 0.0, cols - 1.0), np.clip(np.nan_to_num(v), 0.0, rows - 1.0)
    i, j = np.minimum(u.astype(int), cols - 2), np.minimum(v.astype(int), rows - 2)
    u, v = u - i, v - j
    a, b, c, d = table[j, i], table[j, i + 1], table[j + 1, i], table[j + 1, i + 1]
    return (
        (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d),
        ((1 - v) * (b - a) + v * (d - c)) / cell,
        ((1 - u) * (c - a) + u * (d - b)) / cell,
    )


def _ground(field: Any, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the ground, m, and its unit normal."""
    height, east, north = _bilinear(field.heights, field, x, y)
    return height, _unit(np.stack([-east, -north, np.ones_like(east)], axis=-1))


def _chance(seed: int, wheel: int, number: np.ndarray, kind: int) -> np.ndarray:
    """Numbers from 0 to 1 for the grains of a wheel, whatever others fly: a hash (Steele et al. 2014, SplitMix)."""
    start = (seed * 0xA0761D6478BD642F + wheel * 0xD1B54A32D192ED03 + kind * 0x8CB92BA72F3D8DD7) % 2**64
    z = number.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(start)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (z ^ (z >> np.uint64(31))).astype(float) / 2.0**64
