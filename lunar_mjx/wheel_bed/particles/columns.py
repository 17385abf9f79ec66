"""Which sand moves and which is held: columns of voxels about the wheels, and what was left of those behind them.

The bed's surface is the plane z = 0 of its own frame; columns are numbered by i = floor(x/voxel), j = floor(y/voxel).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from lunar_mjx.wheel_bed.particles.sand_box import particle_places
from lunar_mjx.wheel_bed.particles.settings import Layout

_ROW = 1 << 20
"""Columns of a row of their numbers: 10 km and more to each side at voxels of 2 cm."""
_DIGIT = _ROW // 2


@dataclasses.dataclass(frozen=True)
class Grains:
    """Particles that are computed: places (n, 3) m, velocities (n, 3) m/s, their gradients (n, 3, 3) 1/s, and which are
    held where they are, (n,)."""

    place: np.ndarray
    velocity: np.ndarray
    gradient: np.ndarray
    held: np.ndarray

    @staticmethod
    def none() -> Grains:
        """No particles."""
        nothing = np.zeros((0, 3), np.float32)
        return Grains(nothing, nothing, np.zeros((0, 3, 3), np.float32), np.zeros(0, bool))


class Columns:
    """Sand of a plane without end, strewn where wheels come near and kept as it was left behind them.

    Within `reach` of a wheel's centre sand moves; the columns around it, `rim` wide, are held still and bear it, as a
    box's walls would; all others are kept outside the computation.

    Args:
      voxel: m. per_edge: particles along its edge. depth: voxels of sand. reach, rim: m. seed: of particles' places.
    """

    def __init__(self, voxel: float, per_edge: int, depth: int, reach: float, rim: float, seed: int = 0) -> None:
        self.voxel, self.depth, self.reach, self.rim, self.seed = voxel, depth, reach, rim, seed
        self._one = Layout((1, 1, depth), voxel, per_edge, 0.0)
        self.kept: dict[int, np.ndarray] = {}
        """Places of the particles of columns that are not computed, by the column's number."""
        self._strewn: set[int] = set()
        self._moving = self._still = np.zeros(0, np.int64)
        self._about: np.ndarray | None = None

    @property
    def most_particles(self) -> int:
        """Particles that one wheel's sand may have, with room for what other columns push into it."""
        return int(1.2 * len(self._within(np.zeros((1, 2)), self.reach + self.rim)) * self._one.particles)

    def number(self, place: np.ndarray) -> np.ndarray:
        """Numbers of the columns of places (n, 2 or more), m."""
        cell = np.floor(np.asarray(place, float)[:, :2] / self.voxel).astype(np.int64)
        return (cell[:, 0] + _DIGIT) * _ROW + cell[:, 1] + _DIGIT

    def middle(self, number: np.ndarray) -> np.ndarray:
        """Middles (n, 2), m, of numbered columns."""
        return self.voxel * (np.stack([number // _ROW - _DIGIT, number % _ROW - _DIGIT], axis=-1) + 0.5)

    def near(self, wheels: np.ndarray) -> bool:
        """Whether wheels at (w, 2), m, need other columns than those computed; remembers which.

        They do once one of them has moved by a voxel: an exchange for all together, since it costs as much as a step.
        """
        if self._about is not None and np.hypot(*(wheels - self._about).T).max() <= self.voxel:
            return False
        self._about = np.array(wheels, float)
        moving, every = (self._within(wheels, r) for r in (self.reach, self.reach + self.rim))
        self._moving, self._still = moving, np.setdiff1d(every, moving, assume_unique=True)
        return True

    def _within(self, wheels: np.ndarray, radius: float) -> np.ndarray:
        """Sorted numbers of the columns whose middles lie within a radius, m, of a wheel's column."""
        steps = np.arange(-np.ceil(radius / self.voxel), np.ceil(radius / self.voxel) + 1.0)
        disc = self.voxel * np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        disc = disc[np.hypot(disc[:, 0], disc[:, 1]) <= radius]
        # About the middles of columns, so that every wheel has as many.
        middles = self.middle(self.number(wheels))
        return np.unique(self.number((middles[:, None] + disc[None]).reshape(-1, 2)))

    def exchange(self, grains: Grains) -> Grains:
        """What is to be computed after `near` has told of a change, of what was computed and what was kept.

        Sand that is held or kept loses its velocity, which is next to none so far from the wheels.
        """
        wanted = np.union1d(self._moving, self._still)
        column = self.number(grains.place)
        stays = np.isin(column, wanted)
        self._keep(grains.place[~stays], column[~stays])
        fresh = [self._take(n) for n in wanted.tolist() if n in self.kept or n not in self._strewn]
        place = np.concatenate([grains.place[stays], *fresh]).astype(np.float32)
        new = len(place) - int(stays.sum())
        velocity = np.concatenate([grains.velocity[stays], np.zeros((new, 3), np.float32)])
        gradient = np.concatenate([grains.gradient[stays], np.zeros((new, 3, 3), np.float32)])
        held = np.isin(self.number(place), self._still)
        velocity[held], gradient[held] = 0.0, 0.0
        return Grains(place, velocity, gradient, held)

    def _keep(self, place: np.ndarray, column: np.ndarray) -> None:
        if not len(column):
            return
        order = np.argsort(column, kind="stable")
        numbers, first = np.unique(column[order], return_index=True)
        for n, part in zip(numbers.tolist(), np.split(place[order], first[1:]), strict=True):
            before = self.kept.get(n)
            self.kept[n] = part if before is None else np.concatenate([before, part])

    def _take(self, number: int) -> np.ndarray:
        """Particles of a column: those kept, else strewn anew, the same whichever way a wheel comes."""
        kept = self.kept.pop(number, None)
        if number in self._strewn:
            return np.zeros((0, 3), np.float32) if kept is None else kept
        self._strewn.add(number)
        corner = np.array([*(self.middle(np.array([number]))[0] - 0.5 * self.voxel), -self.depth * self.voxel])
        strewn = particle_places(self._one, np.random.SeedSequence([self.seed, number]).generate_state(1)[0]) + corner
        return strewn if kept is None else np.concatenate([strewn, kept])

    def state(self) -> dict[str, np.ndarray]:
        """What lies outside the computation, as arrays by name."""
        kept = [np.zeros((0, 3), np.float32), *self.kept.values()]
        return {
            "kept": np.concatenate(kept),
            "kept_column": np.repeat(np.array(list(self.kept), np.int64), [len(p) for p in self.kept.values()]),
            "strewn": np.array(sorted(self._strewn), np.int64),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes back to where `state` was taken; the next `near` tells of a change."""
        self.kept, self._strewn = {}, set(state["strewn"].tolist())
        self._about = None
        self._keep(state["kept"], state["kept_column"])

    def surface(self, grains: Grains) -> np.ndarray:
        """Middle x, y of every column that was ever strewn and the height of its highest particle, (n, 3) m."""
        parts = [grains.place, *self.kept.values()]
        place = np.concatenate(parts) if parts else np.zeros((0, 3))
        numbers, which = np.unique(self.number(place), return_inverse=True)
        top = np.full(len(numbers), -np.inf)
        np.maximum.at(top, which, place[:, 2])
        return np.column_stack([self.middle(numbers), top])
