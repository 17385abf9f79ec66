"""How well the scatter of replicates tells the noise of a table, and whether the noise of neighbours is correlated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lunar_mjx.criticism.table import SAME_LOAD, SteadyStateTable, replicate_groups

if TYPE_CHECKING:
    from lunar_mjx.criticism.log import SteadyLog

_MOST = 0.95
_SURE = 2.5
"""Standard errors from which a correlation counts."""


def level_and_dependence(log: SteadyLog) -> dict[str, tuple[float, float]]:
    """What the replicates of a table tell about the noise itself.

    Returns:
      By quantity: relative standard deviation of the noise level that the replicates give (0 without replicates, where
      it is stated), and the number of neighbours in a sweep that count as one independent observation.
    """
    table = log.table
    group = replicate_groups(table)
    freedom = len(table) - len(np.unique(group))
    out = {}
    for quantity, values in table.measured.items():
        if freedom < 1:
            out[quantity] = (0.0, 1.0)
            continue
        mean = np.bincount(group, weights=values) / np.bincount(group)
        correlation = _neighbours(log, values - mean[group])
        # squares of an AR(1) noise correlate by the square of its correlation
        dependence = (1.0 + correlation**2) / (1.0 - correlation**2)
        out[quantity] = (float(np.sqrt(0.5 * dependence / freedom)), float(dependence))
    return out


def _neighbours(log: SteadyLog, residual: np.ndarray) -> float:
    """Correlation of the noise between neighbours in slip of one trial; 0 where none is sure."""
    if log.trial is None:
        return 0.0
    table = log.table
    keys = np.column_stack([log.trial, np.round(table.test["slip_angle_deg"], 2), _levels(table)])
    sweep = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort([table.test["slip_ratio"], sweep])
    pair = np.diff(sweep[order]) == 0
    first, second = residual[order][:-1][pair], residual[order][1:][pair]
    size = float(np.sqrt((first @ first) * (second @ second)))
    if len(first) < 8 or size <= 0.0:
        return 0.0
    correlation = float(first @ second) / size
    return min(correlation, _MOST) if correlation > _SURE / np.sqrt(len(first)) else 0.0


def _levels(table: SteadyStateTable) -> np.ndarray:
    """Number of the load level of every row."""
    load = table.test["normal_load_N"]
    order = np.argsort(load, kind="stable")
    level = np.zeros(len(load), int)
    level[order[1:]] = np.cumsum(np.diff(load[order]) > SAME_LOAD * load[order[:-1]])
    return level
