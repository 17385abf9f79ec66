"""The rungs as data: what the ground is made of, where goals lie, and what a mistake costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from lunar_mjx.errors import bad_input

BURIAL = 0.4
"""Buried share of a boulder's height: it stands 0.6 diameters high (Demidov & Basilevsky 2014)."""
COLLISIONS = ("free", "cost", "end")


@dataclasses.dataclass(frozen=True)
class Rung:
    """One rung of the ladder; lengths in m, for a rover as wide as LUVMI-X.

    Boulders lie on a lattice, at most one in each of its squares, which keeps them apart and lets all be placed at
    once. Ridges are rows of boulders too close to pass between; they run along the edges of square blocks, and which
    edges carry one is drawn: dead ends, yards and detours come from that.

    Attributes:
      note: in a few words.
      size: side of a world. cell: spacing of its grid of heights. plan_cell: of the grid that ways are planned on.
      slope_deg: 99th percentile of the relief's slope over `plan_cell`, before craters and roughness.
      roughness: root mean square difference of height 1 m apart.
      craters: N(>1 m) per m2, in equilibrium 0.079 (Trask 1966). deepest: greatest ratio of depth to diameter.
      coverage: share of the ground under boulders, those of ridges among them. smallest, largest: diameters of the
        scattered ones. lattice: side of the boulders' squares.
      ridges: share of the blocks' edges that carry a ridge. block: side of a block, a multiple of `lattice`.
      goal_distance: least and greatest distance from start to goal, as the crow flies.
      detour: least ratio of the shortest way to the straight line; 1 for any.
      arrival_deg: the rover must point within this of a drawn heading at the goal; 180 for any.
      episode_time: s.
      collisions: "free", "cost" (a reward term) or "end" (of the episode, as failed).
      weights: of reward terms.
      battery: an almost empty battery, panels and a low Sun behind the relief; motors that it cuts off fail.
      worlds: made side by side unless told otherwise.
    """

    note: str
    size: float
    cell: float
    slope_deg: float
    roughness: float
    craters: float
    deepest: float
    coverage: float
    ridges: float
    goal_distance: tuple[float, float]
    detour: float
    episode_time: float
    collisions: str
    weights: Mapping[str, float] = dataclasses.field(hash=False)
    smallest: float = 0.3
    largest: float = 1.2
    lattice: float = 1.6
    block: float = 8.0
    arrival_deg: float = 180.0
    plan_cell: float = 0.4
    battery: bool = False
    worlds: int = 16

    def __post_init__(self) -> None:
        if self.collisions not in COLLISIONS:
            raise bad_input("Rung", "collisions", self.collisions, "does not exist", f"use {', '.join(COLLISIONS)}")
        if not 0.0 <= self.presence <= 1.0:
            raise bad_input("Rung", "coverage", self.coverage, "does not fit on the lattice", "lower it")

    @property
    def ridge_diameter(self) -> float:
        """Diameter of a ridge's boulders: what is left between two is far too narrow for the rover."""
        return 0.88 * self.lattice

    @property
    def on_edges(self) -> float:
        """Share of the lattice's squares that lie on edges of blocks and belong to a ridge."""
        along = 1.0 / round(self.block / self.lattice)
        # a square at a corner of blocks belongs to four edges, one between corners to one
        return 2.0 * along * (1.0 - along) * self.ridges + along**2 * (1.0 - (1.0 - self.ridges) ** 4)

    @property
    def presence(self) -> float:
        """Share of the lattice's squares beside ridges that hold a scattered boulder."""
        mean_area = float(np.mean(np.pi / 4.0 * self.diameters() ** 2))
        in_ridges = self.on_edges * np.pi / 4.0 * self.ridge_diameter**2 / self.lattice**2
        outside_ridges = (self.coverage - in_ridges) * self.lattice**2 / mean_area
        # What ridges cover counts towards the coverage; the rest is spread over the squares that carry none.
        return outside_ridges / (1.0 - self.on_edges)

    def diameters(self, count: int = 256) -> np.ndarray:
        """Quantiles of the diameters: dN ~ D^-2 exp(-q D) dD between the bounds, q = 1.79 (Golombek & Rapp 1997)."""
        d = np.geomspace(self.smallest, self.largest, 512)
        density = np.exp(-1.79 * d) / d**2
        # Quantiles by trapezoids: the density has no closed integral.
        above = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(d))])
        return np.interp((np.arange(count) + 0.5) / count, above / above[-1], d)

    def scaled(self, factor: float) -> Rung:
        """This rung scaled to a rover `factor` times as wide: boulders and their distances grow, the world does not."""
        if factor == 1.0:
            return self
        lattice, block = self.lattice * factor, self.block * factor
        # Whole blocks, so that ridges close at the world's border.
        size = math.ceil(self.size / block) * block
        return dataclasses.replace(
            self,
            size=size,
            lattice=lattice,
            block=block,
            smallest=self.smallest * factor,
            largest=self.largest * factor,
            plan_cell=self.plan_cell * factor,
        )


_SMOOTH = {"progress": 20.0, "tilt": 0.05, "excite": 0.02, "jerkiness": 0.02}
_COSTS = {**_SMOOTH, "energy": 0.002, "slip": 0.02}
_ALL = {**_COSTS, "heat": 0.05}

RUNGS: dict[int, Rung] = {
    1: Rung(
        note="open ground with few boulders",
        size=80.0,
        cell=0.2,
        slope_deg=6.0,
        roughness=0.01,
        craters=0.02,
        deepest=0.10,
        coverage=0.008,
        ridges=0.0,
        goal_distance=(10.0, 40.0),
        detour=1.0,
        episode_time=120.0,
        collisions="free",
        weights=_SMOOTH,
    ),
    2: Rung(
        note="boulder fields and short ridges",
        size=80.0,
        cell=0.2,
        slope_deg=8.0,
        roughness=0.012,
        craters=0.03,
        deepest=0.10,
        coverage=0.04,
        ridges=0.08,
        goal_distance=(15.0, 40.0),
        detour=1.1,
        episode_time=180.0,
        collisions="cost",
        weights={**_SMOOTH, "collision": 5.0},
    ),
    3: Rung(
        note="ridges with dead ends; every way is a detour",
        size=80.0,
        cell=0.2,
        slope_deg=12.0,
        roughness=0.012,
        craters=0.03,
        deepest=0.12,
        coverage=0.09,
        ridges=0.30,
        goal_distance=(20.0, 50.0),
        detour=1.25,
        episode_time=300.0,
        collisions="cost",
        weights={**_COSTS, "collision": 5.0},
    ),
    4: Rung(
        note="goals 100 to 150 m away over slopes to 20 deg, a heading to arrive in",
        size=200.0,
        cell=0.2,
        slope_deg=20.0,
        roughness=0.012,
        craters=0.03,
        deepest=0.15,
        coverage=0.10,
        ridges=0.30,
        goal_distance=(100.0, 150.0),
        detour=1.15,
        arrival_deg=45.0,
        episode_time=900.0,
        worlds=4,
        collisions="cost",
        weights={**_ALL, "collision": 10.0},
    ),
    # gentler ground than rung 4's: with slopes of 25 deg, boulders on 12 % and ridges on 0.30 of the edges a quarter of
    # the nodes can be driven on, in patches of less than a tenth of them, and no way is 200 m long
    5: Rung(
        note="goals 200 to 500 m away, battery and shadow; a collision ends the drive",
        size=520.0,
        cell=0.2,
        slope_deg=16.0,
        roughness=0.012,
        craters=0.03,
        deepest=0.13,
        coverage=0.08,
        ridges=0.20,
        goal_distance=(200.0, 500.0),
        detour=1.15,
        arrival_deg=30.0,
        episode_time=2400.0,
        collisions="end",
        battery=True,
        plan_cell=0.8,
        worlds=2,
        weights={**_ALL, "collision": 10.0},
    ),
}
"""The ladder. Rung 1 is as easy as the task `large`; steepness and boulders grow to rung 4,
distances to rung 5."""


def get_rung(number: int) -> Rung:
    """The rung of this number.

    Raises:
      UserError: there is no such rung.
    """
    if number not in RUNGS:
        known = ", ".join(f"ladder/{n}" for n in RUNGS)
        raise bad_input("navigation", "task", f"ladder/{number}", "does not exist", f"use one of {known}")
    return RUNGS[number]
