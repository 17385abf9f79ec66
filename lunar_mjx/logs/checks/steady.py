"""Checks of steady-state tables: copied rows, replicates against the stated noise, the sign of what a wheel does."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import stats

from lunar_mjx.logs.checks.noise import NOISE_LIMITS
from lunar_mjx.logs.checks.values import VALUE_LIMITS
from lunar_mjx.logs.findings import WARNING, Finding
from lunar_mjx.logs.log import SteadyLog
from lunar_mjx.logs.schema import STEADY_CHANNELS
from lunar_mjx.wheel_bed.scatter import grows
from lunar_mjx.wheel_bed.table import QUANTITIES, average, replicate_groups


@dataclasses.dataclass(frozen=True)
class SteadyLimits:
    """From where a table of a single wheel is refused: far beyond what soil, scatter and instruments do."""

    bearable: float = 3.0
    """Median pull or side force over the median load: no soil's coefficient of friction comes near it."""
    fewest: int = 8
    """Rows below which nothing is said of how a quantity goes with slip, nor of a value that many of them share."""
    span: float = 0.3
    """Range of slip ratios that shows how a quantity goes with slip."""
    rank: float = 0.7
    """Rank correlation with slip that counts as sure: eight rows of chance pass it in fewer than three of a hundred
    tables."""
    over_noise: float = 10.0
    """Range of a quantity over its noise: what varies less has a sign by chance."""
    upward: float = 5.0
    """Median sinkage below zero over its noise that shows another sign."""
    side_over_pull: float = 5.0
    """Scatter of the side force over that of the pull at zero slip angle from which the two are swapped."""
    at_limit: float = 0.05
    """Share of the rows at one extreme value from which a channel is saturated."""
    told_scatter: float = 1.3
    """Scatter of replicates over the stated noise from which a sure excess is told, but not refused."""
    over_others: float = 4.0
    """Rows at the extreme value over those at the most frequent other one: instruments of few digits repeat all."""


STEADY_LIMITS = SteadyLimits()


def check_steady(log: SteadyLog) -> list[Finding]:
    """Findings on a steady-state table beside those of its reader."""
    if len(log.table) == 0:
        return [Finding(log.name, "", None, "", "dropout", "holds no usable row; see the other findings, or fill it")]
    findings = _copies(log) + _ranges(log) + _signs(log) + _swapped(log) + _clipped(log) + _noiseless(log)
    # Scatter of a table with wrong rows or signs would be blamed on its noise.
    return findings + (_replicates(log) if not findings else [])


def _finding(
    log: SteadyLog, row: int | None, column: str, kind: str, message: str, severity: str = "bad_data"
) -> Finding:
    number = int(log.rows[row]) if row is not None and len(log.rows) else row
    return Finding(log.name, "", number, column, kind, message, severity)


def _columns(log: SteadyLog) -> dict[str, np.ndarray]:
    return {**log.table.test, **{QUANTITIES[q][0]: v for q, v in log.table.measured.items()}}


def _copies(log: SteadyLog) -> list[Finding]:
    """Findings of rows whose measured values occur again, more often than the instruments' digits explain."""
    measured = np.column_stack(list(log.table.measured.values()))
    if measured.shape[1] < 2:  # one quantity with few digits repeats by chance
        measured = np.column_stack([measured, *log.table.test.values()])
    _, first, count = np.unique(measured, axis=0, return_index=True, return_counts=True)
    # Rows of zeros are a wheel that was not driven, not a copy.
    trivial = np.all(measured[first] == 0.0, axis=1)
    # Judged by the number that chance would bring: one coincidence among thousands proves nothing.
    copies = int((count - 1)[~trivial].sum())
    if not copies or stats.poisson.sf(copies - 1, _coincidences(log)) >= VALUE_LIMITS.chance:
        return []
    original = int(first[np.argmax((count > 1) & ~trivial)])
    copy = int(np.flatnonzero((measured == measured[original]).all(axis=1))[1])
    line = int(log.rows[original]) + 2 if len(log.rows) else original + 2
    return [_finding(log, copy, "", "copy", f"holds the same measurements as line {line}; remove the copy")]


def _coincidences(log: SteadyLog) -> float:
    """Replicates that agree in everything measured by chance alone: instruments of few digits repeat themselves."""
    group = replicate_groups(log.table)

    def pairs(keys: list[np.ndarray]) -> float:
        count = np.unique(np.column_stack(keys), axis=0, return_counts=True)[1]
        return float((count * (count - 1) // 2).sum())

    number, whole = pairs([group]), pairs([group, *log.table.measured.values()])
    # a copied row must not count as proof that instruments repeat themselves
    shares = [
        max((pairs([group, values]) - whole) / max(number, 1.0), _agree(values, group))
        for values in log.table.measured.values()
    ]
    # As if the quantities agreed independently, given the point.
    return number * float(np.prod(shares))


def _agree(values: np.ndarray, group: np.ndarray) -> float:
    """Chance that two replicates of one quantity agree, by the steps of its instrument and their scatter."""
    steps = np.diff(np.unique(values))
    _, group = np.unique(group, return_inverse=True)
    count = np.bincount(group)
    deviation = values - (np.bincount(group, values) / count)[group]
    freedom = len(values) - len(count)
    scatter = np.sqrt(float(deviation @ deviation) / freedom) if freedom else 0.0
    if not len(steps) or not scatter > 0.0:
        return 0.0
    # Two Gaussians within one step: step over 2 sqrt(pi) sigma.
    return float(min(1.0, steps.min() / (2.0 * np.sqrt(np.pi) * scatter)))


def _ranges(log: SteadyLog) -> list[Finding]:
    findings = []
    for column, values in _columns(log).items():
        _, low, high = STEADY_CHANNELS[column]
        beyond = (values < low) | (values > high)
        if beyond.any():
            row = int(np.argmax(beyond))
            findings.append(
                _finding(
                    log, row, column, "range", f"is {values[row]:.5g}, outside [{low:g}, {high:g}]; check its unit"
                )
            )
    load = log.table.test["normal_load_N"]
    for quantity in ("drawbar_pull", "side_force"):
        values = log.table.measured.get(quantity)
        if values is not None and np.median(np.abs(values)) > STEADY_LIMITS.bearable * np.median(load):
            findings.append(
                _finding(
                    log,
                    None,
                    QUANTITIES[quantity][0],
                    "unit",
                    f"is {np.median(np.abs(values)):.3g} N "
                    "at the "
                    f"median under a load of {np.median(load):.3g} N: no soil bears that; check both "
                    "units",
                )
            )
    sinkage = log.table.measured.get("sinkage")
    if sinkage is not None and np.median(sinkage) > 2.0 * log.table.radius:
        findings.append(
            _finding(
                log,
                None,
                "sinkage_m",
                "unit",
                f"is {np.median(sinkage):.3g} m at the median, more than the wheel's diameter; check its unit",
            )
        )
    return findings


def _signs(log: SteadyLog) -> list[Finding]:
    """Findings where pull or torque fall with slip, or the wheel sinks upwards, by rank over the whole table."""
    findings = []
    slip = log.table.test["slip_ratio"]
    for quantity in ("drawbar_pull", "driving_torque"):
        values = log.table.measured.get(quantity)
        if values is None or len(values) < STEADY_LIMITS.fewest or np.ptp(slip) < STEADY_LIMITS.span:
            continue
        # By rank, since pull saturates with slip.
        rank = float(np.asarray(stats.spearmanr(slip, values))[0])
        noise = log.table.sigma.get(quantity, 0.0)
        if rank < -STEADY_LIMITS.rank and np.ptp(values) > STEADY_LIMITS.over_noise * noise:
            findings.append(
                _finding(
                    log,
                    None,
                    QUANTITIES[quantity][0],
                    "frame",
                    "falls with slip (rank correlation "
                    f"{rank:.2f})"
                    ": its sign, or that of the slip ratio, is reversed; a driving wheel pulls forward",
                )
            )
    sinkage = log.table.measured.get("sinkage")
    if sinkage is not None and np.median(sinkage) < -STEADY_LIMITS.upward * log.table.sigma.get("sinkage", 1e-4):
        findings.append(
            _finding(
                log,
                None,
                "sinkage_m",
                "frame",
                f"is {np.median(sinkage):.3g} m at the median; sinkage counts downwards",
            )
        )
    return findings


def _swapped(log: SteadyLog) -> list[Finding]:
    """Findings where side force and drawbar pull are swapped: without a slip angle only the pull follows slip."""
    side, pull = log.table.measured.get("side_force"), log.table.measured.get("drawbar_pull")
    straight = np.abs(log.table.test["slip_angle_deg"]) < 1.0
    slip = log.table.test["slip_ratio"][straight]
    if side is None or pull is None or straight.sum() < STEADY_LIMITS.fewest or np.ptp(slip) < STEADY_LIMITS.span:
        return []
    side, pull = side[straight], pull[straight]
    rank = float(np.asarray(stats.spearmanr(slip, side))[0])
    if rank < STEADY_LIMITS.rank or np.std(side) < STEADY_LIMITS.side_over_pull * np.std(pull):
        return []
    message = f"follows the slip at zero slip angle (rank correlation {rank:.2f}), and the drawbar pull does not"
    return [_finding(log, None, "side_force_N", "frame", f"{message}: the two columns are swapped")]


def _clipped(log: SteadyLog) -> list[Finding]:
    """Findings of an extreme value that many rows share although others hardly repeat: the instrument's limit."""
    findings = []
    for quantity, values in log.table.measured.items():
        count = np.unique(values, return_counts=True)[1]
        for at, extreme in ((-1, values.max()), (0, values.min())):
            other_counts = np.delete(count, at)
            often = max(
                STEADY_LIMITS.fewest,
                STEADY_LIMITS.at_limit * len(values),
                STEADY_LIMITS.over_others * float(other_counts.max(initial=1)),
            )
            # Zero is what many quantities honestly are.
            if len(count) > 2 and extreme != 0.0 and count[at] >= often:
                row = int(np.argmax(values == extreme))
                message = f"stays at {extreme:.5g} in {count[at]} of {len(values)} rows; leave out what was cut off"
                findings.append(_finding(log, row, QUANTITIES[quantity][0], "saturation", message))
    return findings


def _noiseless(log: SteadyLog) -> list[Finding]:
    """Findings of quantities whose noise neither the log nor replicates tell, so that nothing counts in sigma."""
    stated_sigma = average(log.table).sigma
    findings = []
    for quantity in log.table.measured:
        column = QUANTITIES[quantity][0]
        if not stated_sigma.get(quantity, 0.0) > 0.0 and column not in log.noise:
            message = (
                f"nothing tells its noise; state [noise.{column}] std in log.toml, give replicates, or leave it out"
            )
            findings.append(_finding(log, None, column, "noise", message))
    return findings


def _replicates(log: SteadyLog) -> list[Finding]:
    """Findings where the scatter of replicates contradicts the stated noise, by a chi-square over all points."""
    group = replicate_groups(log.table)
    count = np.bincount(group)
    freedom = int((count - 1).sum())
    findings: list[Finding] = []
    # Fewer degrees of freedom tell a factor of two by chance.
    if freedom < 3:
        return findings
    for quantity, values in log.table.measured.items():
        column = QUANTITIES[quantity][0]
        row_std = log.row_std.get(column)
        stated = row_std if row_std is not None else np.full(len(values), log.table.sigma.get(quantity, np.nan))
        if not np.isfinite(stated).all() or not (stated > 0.0).all():
            continue
        mean = np.bincount(group, weights=values) / count
        residual = (values - mean[group]) / stated
        # a correction for unequal stated noise within a group would change this by less than the factor allows
        statistic = float(residual @ residual)
        ratio = float(np.sqrt(statistic / freedom))
        high, low = (
            stats.chi2.sf(statistic, freedom) < VALUE_LIMITS.chance,
            stats.chi2.cdf(statistic, freedom) < VALUE_LIMITS.chance,
        )
        # A wrong statement is wrong at most points: where noise differs between points the median point tells.
        usual = _scatter_of_median_point(residual, group, count)
        repeated = count > 1
        squares = np.bincount(group, weights=(values - mean[group]) ** 2)[repeated]
        level = np.sqrt(np.bincount(group, weights=stated**2) / count)[repeated]
        honest = grows(squares, count[repeated] - 1, mean[repeated], level)
        if (min(ratio, usual) > NOISE_LIMITS.factor and high and not honest) or (
            max(ratio, usual) < 1.0 / NOISE_LIMITS.factor and low
        ):
            worst = int(np.argmax(np.abs(residual))) if ratio > 1.0 else None
            findings.append(
                _finding(
                    log,
                    worst,
                    column,
                    "noise",
                    f"its replicates scatter {ratio:.3g} times as much as "
                    "the "
                    f"stated noise ({freedom} degrees of freedom); state what the replicates show",
                )
            )
        elif high and ratio > STEADY_LIMITS.told_scatter:
            findings.append(
                _finding(
                    log,
                    None,
                    column,
                    "noise",
                    f"its replicates scatter {ratio:.3g} times as much as the stated noise",
                    WARNING,
                )
            )
    return findings


def _scatter_of_median_point(residual: np.ndarray, group: np.ndarray, count: np.ndarray) -> float:
    """Scatter of replicates over the stated noise at the median point; 1 is expected of a true statement.

    Args:
      residual: (row,) from the mean of its point, in stated sigma. group: (row,) number of its point. count: (point,)
        rows of each.
    """
    repeated = count > 1
    squares = np.bincount(group, weights=residual**2)[repeated]
    return float(np.sqrt(np.median(squares / stats.chi2.median(count[repeated] - 1))))
