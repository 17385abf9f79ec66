"""Impact craters by size-frequency distribution, from fresh to degraded.

Small lunar craters are in equilibrium: N(>D) = 0.079 D^-2 per m^2 (Trask 1966: 10^10.9 D^-2 per 10^6 km^2, D in m),
the exponent confirmed by Moore et al. (1980). A fresh crater is 0.196 of its diameter deep and its rim 0.036 high (Pike
1977); metre-sized craters at Chang'E-4 are degraded to 0.061 on average (Wu et al. 2021). Depths are drawn
log-uniformly between `shallowest` and `deepest`, whose defaults have that mean; the rim keeps Pike's share.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from lunar_mjx.errors import bad_input
from lunar_mjx.terrain.checks import require_at_least, require_between, require_positive


@dataclasses.dataclass(frozen=True)
class CraterShape:
    """Shape of craters, and how many are dug."""

    rim: float = 0.036 / 0.196
    """Height of the rim as a share of the crater's depth from rim to floor (Pike 1977)."""
    reach: float = 3.0
    """Radii at which the ejecta blanket ends; it falls with the cube of the distance (McGetchin et al. 1973)."""
    round: float = 0.05
    """Width of the rounding of the rim's crest, as a share of the depth"""
    most: int = 200_000
    """Craters above which a terrain is refused: they are dug one by one."""


CRATER_SHAPE = CraterShape()


@dataclasses.dataclass(frozen=True)
class Craters:
    """Statistics of a population of craters.

    Attributes:
      smallest: least diameter, m.
      largest: greatest diameter, m.
      density: N(>1 m) per m^2 of the power law.
      exponent: N(>D) ~ D^-exponent.
      shallowest: least ratio of depth (rim to floor) to diameter.
      deepest: greatest ratio of depth to diameter.
    """

    smallest: float = 0.5
    largest: float = 20.0
    density: float = 0.079
    exponent: float = 2.0
    shallowest: float = 0.02
    deepest: float = 0.15

    def __post_init__(self) -> None:
        require_positive(self, "smallest", "give the least diameter in m")
        require_positive(self, "largest", "give the greatest diameter in m")
        require_at_least(self, "density", 0.0, "give craters per m^2 larger than 1 m, 0.079 in equilibrium")
        require_between(self, "exponent", 0.0, 6.0, "give the slope of the power law, 2 in equilibrium")
        require_between(self, "shallowest", 0.0, 0.5, "give a ratio of depth to diameter such as 0.02")
        require_between(self, "deepest", 0.0, 0.5, "give a ratio of depth to diameter, 0.2 for fresh craters")
        for low, high in (("smallest", "largest"), ("shallowest", "deepest")):
            if getattr(self, low) > getattr(self, high):
                raise bad_input("Craters", low, getattr(self, low), f"is above {high}", "swap the two")

    def number(self, diameter: float) -> float:
        """Expected number per m^2 of craters above a diameter (m), up to the largest."""
        diameter = float(np.clip(diameter, self.smallest, self.largest))
        return self.density * (diameter**-self.exponent - self.largest**-self.exponent)


def profile(r: Any, depth: Any, xp: Any = np) -> Any:
    """Height of a crater over the ground around it.

    Args:
      r: distance from the centre, in radii.
      depth: from rim to floor, m.
      xp: `numpy`, or `jax.numpy` for arrays on the device.

    Returns:
      Height in m: a parabolic bowl and an r^-3 rim, joined by a smooth minimum, zero beyond `CRATER_SHAPE.reach`.
    """
    # Bowl and blanket meet at r = 1, where both have the height of the rim.
    rim = CRATER_SHAPE.rim * depth
    bowl = rim + depth * (r * r - 1)
    # Inside half a radius the bowl is far below the blanket, whose value there only has to be finite.
    blanket = rim * xp.maximum(r, 0.5) ** -3.0
    width = CRATER_SHAPE.round * depth
    # Beyond this many widths the smooth minimum is the minimum, and exp() would overflow.
    lower, gap = xp.minimum(bowl, blanket), xp.minimum(xp.abs(bowl - blanket) / width, 40.0)
    joined = lower - width * xp.log1p(xp.exp(-gap))
    # Less the blanket's height where it is cut off, so that no step rings the crater.
    return xp.where(r < CRATER_SHAPE.reach, joined - rim * CRATER_SHAPE.reach**-3.0, 0.0)


def draw(
    craters: Craters, bounds: tuple[float, float, float, float], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draws a population of craters that may touch a rectangle.

    Args:
      craters: statistics.
      bounds: west, south, east and north, m.
      rng: source of randomness.

    Returns:
      x, y (m), diameter (m) and depth (m) of each crater.

    Raises:
      UserError: there would be too many to draw.
    """
    west, south, east, north = bounds
    # Craters beyond the edge throw ejecta onto the terrain.
    margin = 0.5 * CRATER_SHAPE.reach * craters.largest
    wide, high = east - west + 2 * margin, north - south + 2 * margin
    expected = wide * high * craters.number(craters.smallest)
    if expected > CRATER_SHAPE.most:
        raise bad_input(
            "Craters", "smallest", craters.smallest, f"gives {expected:.0f} craters", "raise it or shrink the terrain"
        )
    n = int(rng.poisson(expected))
    b = craters.exponent
    most, least = craters.smallest**-b, craters.largest**-b
    # Inverse of the power law's cumulative distribution, cut off at both ends.
    diameter = (most - rng.random(n) * (most - least)) ** (-1 / b)
    x, y = west - margin + wide * rng.random(n), south - margin + high * rng.random(n)
    ratio = craters.shallowest * (craters.deepest / craters.shallowest) ** rng.random(n)
    far = 0.5 * CRATER_SHAPE.reach * diameter
    # Drawn over the margin of the largest; small ones that cannot reach the terrain are left out.
    near = (x > west - far) & (x < east + far) & (y > south - far) & (y < north + far)
    return x[near], y[near], diameter[near], (ratio * diameter)[near]


def stamp(
    heights: np.ndarray,
    cell: float,
    x0: float,
    y0: float,
    population: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Adds craters to `heights` in place; `x0`, `y0` are the coordinates of `heights[0, 0]`, m."""
    rows, cols = heights.shape
    # One by one: each touches few nodes, and summing all over all nodes would take gigabytes.
    for x, y, diameter, depth in zip(*population, strict=True):
        radius = diameter / 2
        far = CRATER_SHAPE.reach * radius
        i0, i1 = max(0, int((x - far - x0) / cell)), min(cols, int((x + far - x0) / cell) + 2)
        j0, j1 = max(0, int((y - far - y0) / cell)), min(rows, int((y + far - y0) / cell) + 2)
        if i0 >= i1 or j0 >= j1:
            continue
        dx = (x0 + np.arange(i0, i1) * cell - x) / radius
        dy = (y0 + np.arange(j0, j1) * cell - y) / radius
        heights[j0:j1, i0:i1] += profile(np.sqrt(dx[None, :] ** 2 + dy[:, None] ** 2), depth)
