"""Dust of a drive whose wheels' motion is known, row by row."""

from __future__ import annotations

import math
from typing import Any

import jax
import mujoco
import numpy as np

from lunar_mjx.cameras.dust.grains import SPRAY, Grains, Throw, WheelMotion, judged, released, unit
from lunar_mjx.rover import Rover
from lunar_mjx.terrain import Terrain


def wheel_motion(rover: Rover, qpos: np.ndarray, compiled: mujoco.MjModel | None = None) -> WheelMotion:
    """Where a rover's wheels are, and how far they have turned, for coordinates (time, nq) of its MJCF.

    `compiled` is that MJCF, if it is at hand: to compile it takes longer than a row of coordinates.
    """
    model = rover.compile() if compiled is None else compiled
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
    while it goes on shows what its replay shows, and the same drive throws the same grains each time.

    Args:
      rover, terrain: what drives where. Rock throws nothing, nor does a wheel off the ground, such as on a boulder.
      time: of the rows, (time,) s, rising. motion: of the wheels, at these rows. gravity: m/s2, downwards.
      hard: whether all ground is rock, whatever the terrain says. seed: of which grain leaves where and how fast.
      before: slip of each wheel whose soil was thrown before the first row, (wheel,) m: rows that were dropped.
      quiet: slip up to which nothing is thrown, m/s: more where motion was measured, and its noise would look like it.

    Attributes:
      way: slip whose soil was thrown until each row, (time, wheel) m; by it grains are numbered.
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
        before: Any = 0.0,
        quiet: float = SPRAY.quiet,
    ) -> None:
        self._time, self._gravity, self._seed = np.asarray(time, float), float(gravity), seed
        self._ground = jax.device_get(terrain.field)
        self._width = np.array([w.width for w in rover.wheels])
        self._radius = np.array([w.radius for w in rover.wheels])
        self.way = np.broadcast_to(before, (len(self._time), len(self._width)))
        self._throw: Throw | None = None
        self._quiet = quiet
        if len(self._time) > 1 and gravity < SPRAY.heaviest and not hard:
            self._throw = self._judged(motion, jax.device_get(terrain.soil))
            # Of the way between two rows, so that it grows from row to row by what each is judged to throw.
            steps = self._throw.thrown[1:] * np.diff(self._time)[:, None]
            self.way = self.way + np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])

    def _judged(self, motion: WheelMotion, soil: Any) -> Throw:
        """What each wheel throws at each row."""
        centre = motion.centre
        step = np.diff(self._time)[:, None]
        # Of a row and the one before it, since live pictures do not know the next.
        velocity = _held(np.diff(centre, axis=0) / step[..., None])
        turning = _held(np.diff(motion.angle, axis=0) / step)
        height, normal = ground_below(self._ground, centre[..., 0], centre[..., 1])
        throw = judged(np, centre, motion.axle, velocity, turning, height, normal, self._radius, self._quiet)
        if soil is None:
            return throw
        on_soil = _bilinear(soil.rock, soil, centre[..., 0], centre[..., 1])[0] < 0.5
        return throw._replace(thrown=np.where(on_soil, throw.thrown, 0.0))

    def at(self, time: float, most: int = SPRAY.most) -> Grains:
        """The grains in flight at `time`, s; at most `most` of each wheel, each of which stands for the more soil."""
        found = [self._of(wheel, time, most) for wheel in range(len(self._radius))] if self._throw else []
        if not found:
            return none()
        return Grains(*(np.concatenate(part) for part in zip(*found, strict=True)))

    def _of(self, wheel: int, time: float, most: int) -> Grains:
        assert self._throw is not None
        rows, way = Throw(*(values[:, wheel] for values in self._throw)), self.way[:, wheel]
        g, radius, width = max(self._gravity, 1e-3), self._radius[wheel], self._width[wheel]
        throws = rows.thrown > 0.0
        if not way[-1] > way[0]:
            return none()
        # Nothing stays up for longer than what the fastest rim throws off the ground, from as high as the axle.
        steepest = min(float(rows.leave[throws].max()) + SPRAY.sweep, 0.5 * math.pi)
        lift = float(rows.rim[throws].max()) * math.sin(steepest)
        pull = g * float(rows.up[throws, 2].min())
        aloft = (lift + math.sqrt(lift**2 + 2.0 * pull * radius)) / pull
        first, last = np.interp([time - aloft, time], self._time, way) * SPRAY.per_metre
        # Few of those thrown since then still fly; far more than could be drawn need not be followed.
        stride = 1
        while (last - first) / stride > 8 * most:
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
        start, launch = released(np, Throw(*map(then, rows)), radius, width, (angle, slowness, place, side))
        fall = np.array([0.0, 0.0, -self._gravity])
        position = start + launch * age[:, None] + 0.5 * fall * (age**2)[:, None]
        flies = (age >= 0.0) & (position[:, 2] > ground_below(self._ground, position[:, 0], position[:, 1])[0])
        while flies.sum() > most:
            stride *= 2
            flies &= number % stride == 0
        # What stands for more is wider, or few grains would look like gravel.
        spread = (SPRAY.size + SPRAY.growth * np.linalg.norm(launch, axis=-1) * age) * math.sqrt(stride)
        velocity, count = launch + fall * age[:, None], int(flies.sum())
        area = np.full(count, SPRAY.cover * width * stride / SPRAY.per_metre)
        return Grains(position[flies], velocity[flies], spread[flies], area, np.full(count, wheel))


def none() -> Grains:
    """No grains at all."""
    return Grains(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0, int))


def _held(rates: np.ndarray) -> np.ndarray:
    """Rates between rows as rates at rows: of the way that led there."""
    return np.concatenate([rates[:1], rates])


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


def ground_below(field: Any, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the ground, m, and its unit normal."""
    height, east, north = _bilinear(field.heights, field, x, y)
    return height, unit(np, np.stack([-east, -north, np.ones_like(east)], axis=-1))


def _chance(seed: int, wheel: int, number: np.ndarray, kind: int) -> np.ndarray:
    """Numbers from 0 to 1 for the grains of a wheel, whatever others fly: a hash (Steele et al. 2014, SplitMix)."""
    start = (seed * 0xA0761D6478BD642F + wheel * 0xD1B54A32D192ED03 + kind * 0x8CB92BA72F3D8DD7) % 2**64
    z = number.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(start)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (z ^ (z >> np.uint64(31))).astype(float) / 2.0**64
