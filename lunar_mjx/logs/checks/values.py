"""Checks of single channels: empty, out of the physical range, stuck, saturated."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from lunar_mjx.logs.apply import environment_value
from lunar_mjx.logs.checks.clock import CLOCK_LIMITS
from lunar_mjx.logs.findings import Finding
from lunar_mjx.logs.log import Log, LogTable
from lunar_mjx.logs.noise import NOISE_ESTIMATE
from lunar_mjx.logs.schema import MIRROR, find_channel, is_command, is_quantity, limits, suffix_of
from lunar_mjx.logs.series import sigma
from lunar_mjx.model import ZERO_CELSIUS


@dataclasses.dataclass(frozen=True)
class ValueLimits:
    """What the checks of single values tolerate."""

    chance: float = 1e-6
    """Largest probability of a finding on a good channel."""
    shortest_run: int = 20
    """Equal samples in a row that may be chance, whatever the rest of the channel looks like."""
    clipped_share: float = 0.02
    """Share of samples exactly at the extreme value; with noise of two quanta or more a good channel has a few."""
    far_from_ambient: float = 200.0
    """K between a motor at the log's start and its surroundings: 273 is kelvin for Celsius, no motor is that hot."""
    hottest_around: float = 150.0
    """degC of surroundings, above which they look like kelvin themselves: lunar ground at noon has some 120."""
    by_chance: float = 2.5
    """Standard deviations by which a share of few cells may exceed `CLOCK_LIMITS.lost_share` by chance."""
    evenly: float = 0.8
    """Share of the distances between filled cells that must be one and the same for a column of a slower sensor."""
    still: float = NOISE_ESTIMATE.still_rad_s
    """rad/s of a wheel that counts as standing: a wheel of 0.25 m then moves by less than 5 mm/s."""


VALUE_LIMITS = ValueLimits()


def check_values(log: Log) -> list[Finding]:
    """Findings on the values of every channel by itself, and beside its stated noise."""
    findings: list[Finding] = []
    for table in log.tables.values():
        for name in table.channels:
            findings += _check_channel(log, table, name)
    return findings


def _check_channel(log: Log, table: LogTable, name: str) -> list[Finding]:
    column = table.columns.get(name, name)

    def finding(row: int | None, kind: str, message: str) -> list[Finding]:
        return [Finding(log.name, table.name, row, column, kind, message)]

    values = table.channels[name]
    finite = np.isfinite(values)
    if not finite.any():
        return finding(None, "dropout", "is empty; leave the column out")
    # a short table whose sensor loses fewer cells than that may still have lost more by chance
    chance = VALUE_LIMITS.by_chance * np.sqrt(CLOCK_LIMITS.lost_share * (1.0 - CLOCK_LIMITS.lost_share) / len(finite))
    if (share := _lost(finite)) > CLOCK_LIMITS.lost_share + chance:
        return finding(
            int(np.argmin(finite)),
            "dropout",
            f"is empty in {100 * share:.0f} % of its rows (at most "
            f"{100 * (CLOCK_LIMITS.lost_share + chance):.0f} % may be); record it anew, leave the column out or, if "
            "its sensor only reports now and then, give it a table of its own with on_change = true",
        )
    low, high, why = limits(name)
    beyond = finite & ((values < low) | (values > high))
    if beyond.any():
        row = int(np.argmax(beyond))
        return finding(
            row,
            "range",
            f"is {values[row]:.6g}, outside [{low:g}, {high:g}] ({why}), and so in "
            f"{int(beyond.sum())} rows; check its unit, or leave these cells empty",
        )
    if suffix_of(name) == "degC" and (text := _kelvin(log, values[finite])):
        return finding(int(np.argmax(finite)), "unit", text)
    if is_command(name):
        return []
    # a receiver that holds its fix at rest, and an encoder that stands, are not broken
    judged = _judged(log, table, name, finite)
    stuck = _stuck(log, table, name, values[finite], judged[finite])
    if stuck is not None:
        first, length, value = stuck
        row = int(np.flatnonzero(finite)[first])
        extreme = value in (values[finite].min(), values[finite].max()) and np.ptp(values[finite]) > 0.0
        what, kind = ("lies at its extreme", "saturated") if extreme else ("is stuck at", "stuck")
        return finding(
            row,
            kind,
            f"{what} {value:.6g} for {length} samples in a row, which its noise rules out; "
            "leave these cells empty or the column out",
        )
    clipped = _clipped(log, name, values[finite & judged])
    if clipped is not None:
        row = int(np.flatnonzero(finite & (values == clipped))[0])
        count = int((values[judged] == clipped).sum())
        return finding(
            row,
            "saturated",
            f"is exactly {clipped:.6g}, its extreme, in {count} of {int(finite.sum())} "
            "samples: the sensor is clipped; leave these cells empty",
        )
    return []


def _kelvin(log: Log, values: np.ndarray) -> str:
    ambient = environment_value(log, "ambient_temperature_degC")
    # At the start motors have their surroundings' temperature; later they may be hot.
    start = float(np.median(values[:5]))
    sound = ambient is not None and ambient < VALUE_LIMITS.hottest_around
    if ambient is not None and sound and abs(start - ambient) > VALUE_LIMITS.far_from_ambient:
        hint = " (looks like kelvin)" if abs(start - ZERO_CELSIUS - ambient) < 100.0 else ""
        return (
            f"starts at {start:.4g} degC where the surroundings have {ambient:g} degC{hint}; give degrees Celsius, "
            "or call the column by its unit"
        )
    if ambient is None and float(values.min()) > VALUE_LIMITS.far_from_ambient:
        return f"never falls below {values.min():.4g} degC (looks like kelvin); give degrees Celsius"
    return ""


def quantum(values: np.ndarray) -> float:
    """Smallest step between the values of a channel; 0 for a constant one."""
    # Between values that occur and not between neighbours in time, which may all jump.
    steps = np.diff(np.unique(values))
    # what remains of a decimal number written with nine digits is no step
    steps = steps[steps > 1e-8 * max(1e-12, float(np.abs(values).max()))]
    return float(steps.min()) if steps.size else 0.0


def _lost(there: np.ndarray) -> float:
    """Share of a column's samples that are lost: of all rows, or of every k-th where a slower sensor fills these."""
    rows = np.flatnonzero(there)
    distances = np.diff(rows)
    spacing = int(np.median(distances)) if distances.size else 1
    # A slower sensor in a fast table leaves regular gaps, which are no losses.
    if spacing < 2 or float((distances == spacing).mean()) < VALUE_LIMITS.evenly:
        return float(1.0 - there.mean())
    return max(0.0, 1.0 - len(rows) * spacing / len(there))


MOVED = ("position", "attitude", "velocity", "joint")
"""Families of channels that tell motion, and may stand still exactly where there is none."""


def _judged(log: Log, table: LogTable, name: str, there: np.ndarray) -> np.ndarray:
    """(n,) rows in which a channel would show its noise: all, but those at rest for a channel that tells motion.

    A wheel's own speed is no witness of its rest, but the other wheels' are.
    """
    channel_entry = find_channel(name)
    if channel_entry is None or channel_entry[0].family not in MOVED:
        return np.ones(len(there), bool)
    speeds = [c for c in log.channel_names if is_quantity(c, "joint_speed", "drive") and c != name]
    speeds = speeds or [c for c in log.channel_names if is_quantity(c, "command_speed", "drive")]
    series = [s for c in speeds if (s := log.channel(c)) is not None and s[0].size]
    if not series:
        return np.ones(len(there), bool)
    moving = np.zeros(len(there), bool)
    for time, speed in series:
        # between two readings a wheel is known to turn only if it does at both
        after = np.searchsorted(time, table.common_time_s, side="left")
        last = len(time) - 1
        before, after = np.clip(after - 1, 0, last), np.clip(after, 0, last)
        moving |= np.minimum(np.abs(speed[before]), np.abs(speed[after])) > VALUE_LIMITS.still
    return moving


def longest_run(values: np.ndarray, judged: np.ndarray) -> tuple[int, int]:
    """Start and length of the longest run of equal samples, as many of them as are judged."""
    changes = np.concatenate([[0], np.flatnonzero(np.diff(values) != 0.0) + 1, [len(values)]])
    lengths = np.diff(np.concatenate([[0], np.cumsum(judged)])[changes])
    longest = int(np.argmax(lengths))
    return int(changes[longest]), int(lengths[longest])


def _stuck(
    log: Log, table: LogTable, name: str, values: np.ndarray, judged: np.ndarray
) -> tuple[int, int, float] | None:
    """Start, length and value of a run that noise rules out, or that its siblings contradict."""
    first, length = longest_run(values, judged)
    if length < VALUE_LIMITS.shortest_run:
        return None
    noise = sigma(log, name)
    # A channel that never changes shows no step of its own; its siblings have the same instrument.
    step = quantum(values) or _siblings_quantum(table, name)
    if noise > 0.0 and step is not None and length >= _possible_run(noise, step, len(values)):
        return first, length, float(values[first])
    if length >= int(judged.sum()) and np.ptp(values) == 0.0 and _siblings_move(table, name):
        return first, length, float(values[0])
    return None


def _possible_run(noise: float, step: float, count: int) -> float:
    """Length of a run of equal samples that noise of this size still allows in a channel of `count` samples.

    At least a tenth of the variance is taken to be white, the rest to stand still in the middle of a quantum.
    """
    # Chance that white noise stays within the quantum in whose middle the rest stands.
    inside = math.erf(0.5 * step / (np.sqrt(0.1) * noise * np.sqrt(2.0)))
    # Two samples agree if both stay inside, or both leave to the same side.
    repeat_chance = min(inside**2 + 0.5 * (1.0 - inside) ** 2, 1.0 - 1e-12)
    return max(VALUE_LIMITS.shortest_run, math.log(VALUE_LIMITS.chance / count) / math.log(max(repeat_chance, 1e-3)))


def _siblings(table: LogTable, name: str) -> list[np.ndarray]:
    """Values of a channel at the other corners of the rover, such as the other wheels' currents."""
    channel_entry = find_channel(name)
    corner = channel_entry[1].groupdict().get("corner") if channel_entry else None
    if corner is None:
        return []
    sibling_names = (name.replace(f"_{corner}_", f"_{c}_") for c in MIRROR if c != corner)
    return [
        v[np.isfinite(v)] for o in sibling_names if (v := table.channels.get(o)) is not None and np.isfinite(v).any()
    ]


def _siblings_quantum(table: LogTable, name: str) -> float | None:
    steps = [q for v in _siblings(table, name) if (q := quantum(v)) > 0.0]
    return float(np.median(steps)) if len(steps) >= 2 else None


def _siblings_move(table: LogTable, name: str) -> bool:
    """Whether a measured channel of a wheel's drive never changes while at least two other wheels' do, and much."""
    if "_drive_" not in name:
        return False  # an idle steering joint beside others that steer is no broken sensor
    moving = [np.ptp(v) > 20.0 * quantum(v) > 0.0 for v in _siblings(table, name)]
    return sum(moving) >= 2


def _clipped(log: Log, name: str, values: np.ndarray) -> float | None:
    """The extreme value, if far more samples have exactly that than noise allows."""
    noise = sigma(log, name)
    # With noise of less than two quanta every value is frequent.
    if noise <= 0.0 or len(values) < 100 or noise < 2.0 * (step := quantum(values)):
        return None
    for extreme in (float(values.max()), float(values.min())):
        count = int((values == extreme).sum())
        # slow noise stays at its extreme for a while too, but then its neighbours are as frequent
        beside = int((np.abs(values - extreme) < 1.5 * step).sum()) - count
        if count >= max(10, VALUE_LIMITS.clipped_share * len(values), 5 * beside):
            return extreme
    return None
