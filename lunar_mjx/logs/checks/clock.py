"""Checks of time: what repeats, jumps, changes its rate, or lacks samples."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.logs.findings import Finding
from lunar_mjx.logs.log import Log, LogTable
from lunar_mjx.logs.schema import channel_name, is_quantity


@dataclasses.dataclass(frozen=True)
class ClockLimits:
    """What the checks of clocks tolerate."""

    rate_tolerance: float = 0.1
    """Relative; loggers keep their rate to a per cent, and a fitted drift stays below it."""
    window: int = 25
    """Intervals per window whose median is its rate: jitter of 20 % leaves 5 % in it."""
    # Steps count as one and the same, or as multiples of it, if this share of them lie within `steady` of it.
    steady: float = 0.2
    mostly: float = 0.9
    usual: float = 6.0
    """Standard deviations by which a step may differ from what its speed says: next to none does by chance."""
    lost_share: float = 0.3
    """A log that lost more than this share of its samples is no record any more; links lose a few per cent."""


CLOCK_LIMITS = ClockLimits()


_RATES = {"joint_angle": "joint_speed", "position": "world_velocity"}
"""Quantities, and those that are their rates."""


def check_clock(log: Log) -> list[Finding]:
    """Findings on the times of every table, and on whether the tables share an origin."""
    findings: list[Finding] = []
    for table in log.tables.values():
        findings += _check_table(log, table)
    # Spans of clocks that jump say nothing.
    return findings or _check_overlap(log)


def _finding(log: Log, table: LogTable, row: int | None, kind: str, message: str) -> Finding:
    return Finding(log.name, table.name, row, "time_s", kind, message)


def _check_table(log: Log, table: LogTable) -> list[Finding]:
    time = table.time_s
    if len(time) < 3:
        return [_finding(log, table, None, "short", f"has {len(time)} rows; a table needs three at least")]
    missing = np.flatnonzero(~np.isfinite(time))
    if missing.size:
        row = int(missing[0])
        return [_finding(log, table, row, "clock", f"is empty in {missing.size} rows; every row needs its time")]
    # Order first: every later check divides by steps or sorts by time.
    steps = np.diff(time)
    backward = np.flatnonzero(steps <= 0.0)
    if backward.size:
        row = int(backward[0]) + 1
        event = "repeats" if steps[row - 1] == 0.0 else "goes back"
        return [
            _finding(
                log,
                table,
                row,
                "clock",
                f"{event}: {time[row]:.6g} s after {time[row - 1]:.6g} s, and so in "
                f"{backward.size} rows; sort the rows and drop copies",
            )
        ]
    findings = [] if table.on_change else _check_rate(log, table, steps)
    return findings or _check_jumps(log, table, steps)


def _check_rate(log: Log, table: LogTable, steps: np.ndarray) -> list[Finding]:
    base = float(np.median(steps))
    if abs(base * table.rate_hz - 1.0) > CLOCK_LIMITS.rate_tolerance:
        return [
            _finding(
                log,
                table,
                None,
                "clock",
                f"rises by {base:.6g} s from row to row, but log.toml states "
                f"rate_hz = {table.rate_hz:g}; correct one of them (is the time in seconds?)",
            )
        ]
    windows = (
        np.lib.stride_tricks.sliding_window_view(steps, CLOCK_LIMITS.window)
        if len(steps) >= 2 * CLOCK_LIMITS.window
        else None
    )
    if windows is None:
        return []
    rate = np.median(windows, axis=1) / base
    # Times rounded to hundredths jitter by half a step at 50 Hz.
    changed = np.abs(rate - 1.0) > CLOCK_LIMITS.rate_tolerance + _resolution(table.time_s) / base
    # Lost samples make some steps multiples of the base, and a sensor that reports when it has news makes all sorts of
    # steps: only a run of one and the same step is another rate.
    changed &= (np.abs(windows / base - rate[:, None]) < CLOCK_LIMITS.steady * rate[:, None]).mean(
        axis=1
    ) > CLOCK_LIMITS.mostly
    if not changed.any():
        return []
    # The middle of the first window that differs.
    row = int(np.argmax(changed)) + CLOCK_LIMITS.window // 2
    return [
        _finding(
            log,
            table,
            row,
            "clock",
            f"changes its rate from {1.0 / base:.4g} Hz to "
            f"{1.0 / (base * rate[np.argmax(changed)]):.4g} Hz; split the table there, or correct the clock",
        )
    ]


def _check_jumps(log: Log, table: LogTable, steps: np.ndarray) -> list[Finding]:
    """Findings of lost samples beyond the tolerable, and of gaps in which a moving rover did not move: clock jumps."""
    base = float(np.median(steps))
    lost = float(np.sum(np.maximum(np.round(steps / base) - 1.0, 0.0)))
    # Three steps: one or two lost samples are common, and too short to tell a jump from noise.
    for row in np.flatnonzero(steps > 3.0 * base):
        for integral, rate in _pairs(table):
            moved, expected, still = _over_gap(table, int(row), integral, rate, base)
            # Movements below 20 sigma decide nothing.
            sigma = log.noise[integral].std if integral in log.noise else 0.0
            # The clock jumped if what the sensor moved fits one ordinary step and not the gap, each clearly. Of a long
            # gap a quarter is more than a step: a rover that turned or stopped meanwhile moves so.
            step = abs(still) + CLOCK_LIMITS.usual * _usual(table, integral, rate, steps, base)
            if (
                abs(expected) > max(20.0 * sigma, 1e-6)
                and abs(moved - expected) > 0.5 * abs(expected)
                and abs(moved - still) < min(0.25 * abs(expected), step)
            ):
                return [
                    _finding(
                        log,
                        table,
                        int(row) + 1,
                        "clock",
                        f"jumps by {steps[row]:.4g} s, over which "
                        f"{integral} moved by {moved:.4g} instead of {expected:.4g}; correct the clock",
                    )
                ]
    share = lost / (lost + len(table))
    if share > CLOCK_LIMITS.lost_share and not table.on_change and _is_regular(steps, base):
        row = int(np.argmax(steps)) + 1
        return [
            _finding(
                log,
                table,
                row,
                "dropout",
                f"lacks {100 * share:.3g} % of its samples (at most "
                f"{100 * CLOCK_LIMITS.lost_share:.0f} % may be lost); the longest gap lasts {steps.max():.4g} s; "
                "record it anew, or make several drives of it (lunar-mjx log import --split-at-gaps)",
            )
        ]
    return []


def _resolution(time: np.ndarray) -> float:
    """The unit that times are rounded to, s: 0.01 of a clock that tells hundredths."""
    for digits in range(10):
        if np.all(np.abs(time - np.round(time, digits)) < 1e-9 * max(1.0, float(np.abs(time).max()))):
            return 10.0**-digits
    return 0.0


def _is_regular(steps: np.ndarray, base: float) -> bool:
    """Whether samples come at a rate, some of them lost, and not whenever a sensor has news."""
    multiples = np.maximum(np.round(steps / base), 1.0)
    return float((np.abs(steps / base - multiples) < CLOCK_LIMITS.steady).mean()) > CLOCK_LIMITS.mostly


def _pairs(table: LogTable) -> list[tuple[str, str]]:
    names = []
    for integral, rate in _RATES.items():
        for name in (n for n in table.channels if is_quantity(n, integral)):
            parts = channel_name(name)
            partner = str(dataclasses.replace(parts, quantity=rate, unit=f"{parts.unit}_s"))
            if partner in table.channels:
                names.append((name, partner))
    return names


def _over_gap(table: LogTable, row: int, integral: str, rate: str, base: float) -> tuple[float, float, float]:
    """Movement over a gap, what its rate lets expect, and what one ordinary step would have given."""
    values, speed = table.channels[integral], table.channels[rate]
    # A rover's speed hardly changes within a gap of some steps.
    mean = 0.5 * float(speed[row] + speed[row + 1])
    gap = float(table.time_s[row + 1] - table.time_s[row])
    moved = float(values[row + 1] - values[row])
    if not np.isfinite(mean + moved):
        return 0.0, 0.0, 0.0
    return moved, mean * gap, mean * base


def _usual(table: LogTable, integral: str, rate: str, steps: np.ndarray, base: float) -> float:
    """Standard deviation of what ordinary steps move beside what their speed says, by the median."""
    values, speed = table.channels[integral], table.channels[rate]
    off = np.diff(values) - 0.5 * (speed[:-1] + speed[1:]) * steps
    off = off[(steps < 1.5 * base) & np.isfinite(off)]
    return 1.4826 * float(np.median(np.abs(off))) if off.size else 0.0


def _check_overlap(log: Log) -> list[Finding]:
    """Findings of tables that share less than half of their span, or of the longest one's, with that: other origins."""
    tables = list(log.tables.values())
    longest = max(tables, key=lambda t: float(np.ptp(t.common_time_s)))
    low, high = longest.common_time_s[0], longest.common_time_s[-1]
    for table in tables:
        first, last = table.common_time_s[0], table.common_time_s[-1]
        shared = min(high, last) - max(low, first)
        # Half: instruments are switched on and off one after the other, but within one drive.
        if shared < 0.5 * (last - first):
            return [
                _finding(
                    log,
                    table,
                    None,
                    "clock",
                    f"runs from {first:g} to {last:g} s, apart from {longest.name} "
                    f"({low:g} to {high:g} s); give one origin or clock_offset_s",
                )
            ]
    return []
