"""What the scatter of replicates tells about the noise of a table: its level, and whether neighbours are correlated."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from lunar_mjx.wheel_bed.table import SAME_LOAD, SteadyStateTable, replicate_groups

if TYPE_CHECKING:
    from lunar_mjx.logs import SteadyLog


@dataclasses.dataclass(frozen=True)
class NeighbourNoise:
    """When the noise of neighbouring points counts as correlated."""

    most: float = 0.95
    """Largest correlation that is believed: at 1 no point would add anything to its neighbour."""
    sure: float = 2.5
    """Standard errors from which a correlation counts."""
    fewest: int = 8
    """Pairs of neighbours from which a correlation is estimated."""
    gap: float = 1.5
    """Median steps of slip beyond which two points of a sweep are no neighbours."""


NEIGHBOURS = NeighbourNoise()


@dataclasses.dataclass(frozen=True)
class Scatter:
    """What replicates tell about one quantity's noise.

    Attributes:
      level: relative standard deviation of the noise level that they give; 0 without replicates, where it is stated.
      correlation: of the noise between neighbours of a sweep; 0 where none is sure.
      innovation: standard deviation of what a point's noise adds to `correlation` times its neighbour's, in sigma.
    """

    level: float = 0.0
    correlation: float = 0.0
    innovation: float = 1.0

    @property
    def dependence(self) -> float:
        """Number of neighbours whose squares count as one: squares of AR(1) noise correlate by correlation squared."""
        return (1.0 + self.correlation**2) / (1.0 - self.correlation**2)


def scatter(log: SteadyLog) -> dict[str, Scatter]:
    """What the replicates of a table tell about the noise, by quantity."""
    table = log.table
    group = replicate_groups(table)
    freedom = len(table) - len(np.unique(group))
    out = {}
    for quantity, values in table.measured.items():
        if freedom < 1:
            out[quantity] = Scatter()
            continue
        # around each group's own mean: replicates tell the noise whatever the law of the wheel is
        mean = np.bincount(group, weights=values) / np.bincount(group)
        estimate = Scatter(0.0, *_neighbours(log, values - mean[group]))
        # A standard deviation from n squares is uncertain by 1/sqrt(2 n) of itself; dependent neighbours count for
        # fewer.
        out[quantity] = dataclasses.replace(estimate, level=float(np.sqrt(0.5 * estimate.dependence / freedom)))
    return out


def _neighbours(log: SteadyLog, residual: np.ndarray) -> tuple[float, float]:
    """Correlation of the noise between neighbours in slip of one trial, and the size of its innovations."""
    if log.trial is None:
        return 0.0, 1.0
    order, follows = sweeps(log.table, np.asarray(log.trial))
    first, second = residual[order][:-1][follows[1:]], residual[order][1:][follows[1:]]
    power = float(first @ first)
    size = float(np.sqrt(power * (second @ second)))
    if len(first) < NEIGHBOURS.fewest or size <= 0.0:
        return 0.0, 1.0
    correlation = float(first @ second) / size
    # 1/sqrt(n) is the standard error of a correlation that is none; a negative one is no memory of the bed
    if correlation <= NEIGHBOURS.sure / np.sqrt(len(first)):
        return 0.0, 1.0
    correlation = min(correlation, NEIGHBOURS.most)
    left = second - correlation * first
    return correlation, float(np.sqrt(np.mean(left**2) / np.mean(residual**2)))


def sweeps(table: SteadyStateTable, key: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order of points along sweeps of the slip ratio, and which follow a neighbour.

    Args:
      table: n points.
      key: (n,) whatever else separates sweeps beside slip angle and load: the trial, or the group left out together.

    Returns:
      (n,) places in the order of sweeps; (n,) whether the point at each of these places follows its neighbour.
    """
    slip = table.test["slip_ratio"]
    keys = np.column_stack([key, np.round(table.test["slip_angle_deg"], 2), _levels(table)])
    sweep = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort([slip, sweep])
    same_sweep = np.diff(sweep[order]) == 0
    gap = np.diff(slip[order])
    # a gap in a sweep is a point that was left out or measured elsewhere: noise need not go on across it
    near = gap <= NEIGHBOURS.gap * np.median(gap[same_sweep]) if same_sweep.any() else same_sweep
    return order, np.concatenate([[False], same_sweep & near])


def _levels(table: SteadyStateTable) -> np.ndarray:
    """Number of the load level of every row."""
    load = table.test["normal_load_N"]
    order = np.argsort(load, kind="stable")
    level = np.zeros(len(load), int)
    # measured loads scatter around what was set: a new level begins where the sorted loads jump
    level[order[1:]] = np.cumsum(np.diff(load[order]) > SAME_LOAD * load[order[:-1]])
    return level
