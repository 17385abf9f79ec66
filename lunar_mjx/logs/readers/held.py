"""Held samples: rows that repeat a reading of a slower sensor, which are no readings of their own."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class HeldReadings:
    """How readings that a recorder repeats are told from readings of their own."""

    fewest_changes: int = 6
    """Renewals below which nothing is said: a channel that hardly ever changes may just be steady."""
    slower: float = 1.5
    """A channel is held only if its typical change comes later than this many rows."""
    # Renewals are regular if `on_time` of the time lies in intervals within `regular` of whole multiples of one
    # period, of at least `regular_rows` rows: of intervals at random a third would.
    regular: float = 0.15
    on_time: float = 0.75
    regular_rows: float = 3.0
    # Changes keep a distance if one is followed by another in the next row less than `spaced` times as often as in
    # one of the rows up to `spaced_most` after it, by `spaced_sigma` standard deviations: a slower sensor's readings
    # do.
    spaced: float = 0.5
    spaced_most: int = 5
    spaced_sigma: float = 5.0
    ramp: float = 0.8
    """A channel in few digits that rises or falls steadily changes at steady times, too: by one step, in one direction,
    in more than this share of its changes."""
    coarse: float = 8.0
    """Typical change in steps of the channel's resolution from which an exact repeat is no chance: below, a channel
    written in few digits repeats itself honestly."""


HELD_READINGS = HeldReadings()


@dataclasses.dataclass(frozen=True)
class Held:
    """What a group of channels shows.

    Attributes:
      period_s: typical time between renewals. readings: (n,) whether a row is a reading of its own.
    """

    period_s: float
    readings: np.ndarray


def held_samples(time: np.ndarray, values: np.ndarray, recurs: bool = True) -> Held | None:
    """Finds out whether the rows of some channels repeat a slower sensor's readings.

    Channels of a group are renewed together (both wheels of one message, latitude and longitude). A repeat counts as a
    copy where renewals come at a steady period of several rows, or where the readings' resolution is so fine that a
    repeat by chance is out of the question. Zeros of a rover at rest are not judged.

    Args:
      time: (n,) s. values: (n, channels), NaN at gaps.
      recurs: whether a reading may come again exactly, as a steady speed in few digits does and a receiver's fix not.

    Returns:
      Period and readings; None where every row may be a reading. A copy that stands for longer than the period is kept
      once per period where the sensor may have read the same again.
    """
    there = np.isfinite(values).all(axis=1) & np.isfinite(time)
    rows = np.flatnonzero(there)
    if len(rows) < 3 * HELD_READINGS.fewest_changes:
        return None
    t, v = time[rows], values[rows]
    step = float(np.median(np.diff(t)))
    # Any channel of the message: one component may stay while another moves.
    changed = np.concatenate([[True], (np.diff(v, axis=0) != 0.0).any(axis=1)])
    at = np.flatnonzero(changed)
    if len(at) < HELD_READINGS.fewest_changes + 1 or step <= 0.0:
        return None
    intervals = np.diff(t[at])
    # while a rover stands its speeds are 0 and its fixes the same: those intervals tell nothing of the sensor
    moving = (v[at[:-1]] != 0.0).any(axis=1)
    intervals = intervals[moving & (intervals > 0.0)]
    if len(intervals) < HELD_READINGS.fewest_changes or all(_is_ramp(column) for column in v.T):
        return None
    # Weighted by time, since a few short intervals must not hide long ones.
    middle = _weighted_median(intervals)
    if middle < HELD_READINGS.slower * step:
        return None
    # readings that happen to be equal make an interval twice as long: the shortest period that fits is the sensor's
    candidates = sorted([*np.quantile(intervals, (0.1, 0.25, 0.5)), middle])
    period = next((float(c) for c in candidates if _regular(intervals, float(c), step)), None)
    if period is None:
        period = float(np.median(intervals))
        if period < HELD_READINGS.slower * step or not (_fine(v) or _spaced(changed)):
            return None
    else:
        period = float(np.median(intervals[np.round(intervals / period) == 1.0]))
    keep, last = np.zeros(len(t), bool), -np.inf
    # a fine reading that comes again is the old one; a coarse one, and the zero of a rover at rest, may be new
    may_recur = (np.full(len(t), not _fine(v)) | (v == 0.0).all(axis=1)) & recurs
    for k in range(len(t)):
        if changed[k] or (may_recur[k] and t[k] - last > 1.5 * period):
            keep[k], last = True, t[k]
    readings = np.zeros(len(time), bool)
    readings[rows] = keep
    return Held(period, readings)


def _weighted_median(intervals: np.ndarray) -> float:
    """The interval in which the middle of the time lies."""
    order = np.sort(intervals)
    total = np.cumsum(order)
    # The plain median would count a burst of new readings as typical.
    return float(order[np.searchsorted(total, 0.5 * total[-1])])


def _regular(intervals: np.ndarray, period: float, step: float) -> bool:
    if period < HELD_READINGS.regular_rows * step:
        return False
    multiple = intervals / period
    near = np.abs(multiple - np.round(multiple)) < HELD_READINGS.regular * np.maximum(np.round(multiple), 1.0)
    near &= np.round(multiple) >= 1.0
    return int(near.sum()) >= HELD_READINGS.fewest_changes and float(
        intervals[near].sum()
    ) > HELD_READINGS.on_time * float(intervals.sum())


def _spaced(changed: np.ndarray) -> bool:
    """Whether changes keep a distance of two rows or more from each other."""
    at = np.flatnonzero(changed[: -HELD_READINGS.spaced_most])
    # Fewer changes leave shares too rough to compare.
    if len(at) < 30:
        return False
    after = np.array([changed[at + lag].mean() for lag in range(1, HELD_READINGS.spaced_most + 1)])
    most = float(after.max())
    # Of a share among so many changes (binomial).
    error = np.sqrt(most * (1.0 - most) / len(at)) + 1e-12
    return after[0] < HELD_READINGS.spaced * most and most - after[0] > HELD_READINGS.spaced_sigma * error


def _is_ramp(column: np.ndarray) -> bool:
    """Whether a channel in few digits just rises or falls steadily."""
    jumps = np.diff(column)
    jumps = jumps[jumps != 0.0]
    if len(jumps) < 2:
        return True
    size = float(np.abs(jumps).min())
    single = np.abs(jumps) < 1.5 * size
    onwards = np.sign(jumps[1:]) == np.sign(jumps[:-1])
    return float((single[1:] & single[:-1] & onwards).mean()) > HELD_READINGS.ramp


def _fine(values: np.ndarray) -> bool:
    """Whether every channel that changes does so by many steps of its resolution."""
    found = []
    for column in values.T:
        jumps = np.abs(np.diff(column))
        jumps = jumps[jumps > 0.0]
        steps: np.ndarray = np.diff(np.unique(column))
        steps = steps[steps > 1e-9 * max(1e-12, float(np.abs(column).max()))]
        if jumps.size and steps.size:
            # the smallest of many differences of real numbers is far below any resolution: a low quantile is not
            found.append(float(np.median(jumps)) > HELD_READINGS.coarse * float(np.quantile(steps, 0.05)))
    return bool(found) and all(found)
