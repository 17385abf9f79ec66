"""Where rocks lie and how large they are.

Size-frequency: the fraction of the ground that rocks larger than D cover is F(>D) = k exp(-q D), q = 1.79 + 0.152/k
(Golombek & Rapp 1997, of landing sites on Mars; Di et al. 2016 found the exponential form at Chang'E-3 too, similar to
Surveyor III). k, the rock abundance, is 0.0021 at Chang'E-4 (Wu et al. 2021) and some hundredths on fresh ejecta.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from lunar_mjx.errors import bad_input
from lunar_mjx.terrain.checks import require_at_least, require_between, require_positive
from lunar_mjx.terrain.rocks import CELL, REACH, Rocks, build_ellipsoids, build_rocks


@dataclasses.dataclass(frozen=True)
class RockLimits:
    """How many rocks are placed, and how long a place is looked for."""

    most: int = 20_000
    """Rocks above which a terrain is refused: each is placed beside those before it."""
    tries: int = 30
    """Places tried for a rock before it is left out."""


ROCK_LIMITS = RockLimits()


@dataclasses.dataclass(frozen=True)
class RockField:
    """Statistics of a population of rocks.

    Attributes:
      abundance: fraction of the ground covered by rocks of all sizes (k).
      smallest: least diameter that becomes an obstacle, m; smaller ones are roughness.
      largest: greatest diameter, m.
      burial: share of a rock's height below ground. 0.4 leaves a height of 0.6 diameters, the mean of rocks on
        panoramas of Lunokhod and Apollo (Demidov & Basilevsky 2014).
      gap: least distance between two rocks' surfaces, m; it makes the look-up unambiguous, see `rocks.clearance`.
      clear: radius around the middle of the terrain that stays free of rocks, m.
      cell: spacing of the look-up grid, m.
      width: intermediate over longest axis, the two that lie level; they cover as much ground as a disc of the
        diameter. Fragments of impacts have 0.7 (2 : sqrt 2 : 1, Fujiwara et al. 1978).
      height: upright axis over longest. Fragments of impacts that lie on their flat side have 0.5. With `width` and
        `height` of 1 rocks are spheres.
    """

    abundance: float = 0.01
    smallest: float = 0.2
    largest: float = 1.0
    burial: float = 0.4
    gap: float = 0.9
    clear: float = 2.0
    cell: float = CELL
    width: float = 1.0
    height: float = 1.0

    def __post_init__(self) -> None:
        require_at_least(self, "abundance", 0.0, "give the fraction of ground covered by rocks, such as 0.01")
        require_between(self, "abundance", -1.0, 0.5, "give the fraction of ground covered by rocks, such as 0.01")
        require_positive(self, "smallest", "give the least diameter in m")
        require_positive(self, "largest", "give the greatest diameter in m")
        require_between(self, "burial", 0.0, 0.95, "give the buried share of a rock's height, such as 0.4")
        require_at_least(self, "gap", 0.0, "give the least gap in m")
        require_at_least(self, "clear", 0.0, "give the radius of the clear circle in m")
        require_positive(self, "cell", "give the spacing of the look-up grid in m")
        for name in ("width", "height"):
            require_at_least(self, name, 0.2, "give the axis over the longest one, such as 0.7")
            if getattr(self, name) > 1.0:
                raise bad_input("RockField", name, getattr(self, name), "is above 1", "give it over the longest axis")
        if self.smallest >= self.largest:
            raise bad_input("RockField", "smallest", self.smallest, "is not below largest", "swap the two")

    def number(self, diameter: np.ndarray | float) -> np.ndarray:
        """Expected number per m^2 of rocks above a diameter (m), up to the largest.

        A rock of diameter D covers pi D^2 / 4, so dN = (4 / (pi D^2)) q k exp(-q D) dD, integrated numerically.
        """
        if self.abundance == 0:
            return np.zeros_like(np.asarray(diameter, float))
        grid, above = self._cumulative()
        return np.asarray(np.interp(diameter, grid, above))

    def _cumulative(self) -> tuple[np.ndarray, np.ndarray]:
        q = 1.79 + 0.152 / self.abundance
        # Geometric: the density falls over decades, and most rocks are small.
        d = np.geomspace(self.smallest, self.largest, 400)
        density = 4 / (np.pi * d * d) * q * self.abundance * np.exp(-q * d)
        steps = 0.5 * (density[1:] + density[:-1]) * np.diff(d)
        return d, np.append(np.cumsum(steps[::-1])[::-1], 0.0)

    def draw_diameters(self, area: float, rng: np.random.Generator) -> np.ndarray:
        """Draws the diameters (m) of the rocks on an area (m^2), largest first."""
        expected = float(self.number(self.smallest)) * area
        if expected > ROCK_LIMITS.most:
            raise bad_input(
                "RockField", "abundance", self.abundance, f"gives {expected:.0f} rocks", "lower it or raise smallest"
            )
        if expected == 0:
            return np.zeros(0)
        grid, above = self._cumulative()
        u = rng.random(int(rng.poisson(expected))) * above[0]
        # Largest first: a large rock finds no place among many small ones.
        return np.sort(np.interp(u, above[::-1], grid[::-1]))[::-1]


def place_rocks(
    population: RockField,
    bounds: tuple[float, float, float, float],
    ground: Callable[[np.ndarray, np.ndarray], np.ndarray],
    rng: np.random.Generator,
    dtype: np.dtype | type = np.float32,
) -> Rocks:
    """Scatters rocks at random over a rectangle, largest first, none nearer to another than the gap.

    Ellipsoids lie on their flat side and turn at random about the vertical.

    Args:
      population: statistics; a rock for which no free place is found in 30 tries is left out.
      bounds: west, south, east and north, m.
      ground: function of x and y (m) that returns the height of the ground, m.
      rng: source of randomness.
      dtype: of the result's floating-point arrays.

    Returns:
      The rocks with their look-up grid.
    """
    west, south, east, north = bounds
    diameters = population.draw_diameters((east - west) * (north - south), rng)
    middle = np.array([(west + east) / 2, (south + north) / 2])
    # A sphere buried beyond its middle shows a smaller circle than its own: its radius makes up for it.
    share = 2 * population.burial - 1
    radii = diameters / 2 / (np.sqrt(1 - share**2) if share > 0 else 1.0) / np.sqrt(population.width)
    places, kept = np.zeros((len(radii), 2)), np.zeros(len(radii))
    # Rocks nearer than the gap lie in this square or the eight around it.
    side = population.gap + 2 * radii[0] if len(radii) else 1.0
    rocks_in_bin: dict[tuple[int, int], list[int]] = {}
    n = 0
    for radius in radii:
        for _ in range(ROCK_LIMITS.tries):
            place = np.array([west, south]) + rng.random(2) * [east - west, north - south]
            if np.hypot(*(place - middle)) < population.clear + radius:
                continue
            i, j = int((place[0] - west) // side), int((place[1] - south) // side)
            near = [k for a in (i - 1, i, i + 1) for b in (j - 1, j, j + 1) for k in rocks_in_bin.get((a, b), ())]
            distance = np.hypot(*(places[near] - place).T) - kept[near] - radius
            if not near or distance.min() >= population.gap:
                places[n], kept[n] = place, radius
                rocks_in_bin.setdefault((i, j), []).append(n)
                n += 1
                break
    places, kept = places[:n], kept[:n]
    height = np.asarray(ground(places[:, 0], places[:, 1])) if n else np.zeros(0)
    # Sunk by the buried share: at burial 0.5 the centre lies at the ground.
    centers = np.column_stack([places, height - share * population.height * kept])
    options: Any = {"cell": population.cell, "reach": REACH, "dtype": dtype}
    if population.width == population.height == 1.0:
        return build_rocks(centers, kept, bounds, **options)
    yaw = rng.uniform(0.0, np.pi, n)
    zero, one = np.zeros(n), np.ones(n)
    turns = np.stack([np.cos(yaw), -np.sin(yaw), zero, np.sin(yaw), np.cos(yaw), zero, zero, zero, one], axis=-1)
    axes = kept[:, None] * np.array([1.0, population.width, population.height])
    return build_ellipsoids(centers, axes, turns, bounds, **options)
