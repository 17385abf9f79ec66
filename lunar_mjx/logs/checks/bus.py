"""Checks of the current of the bus: its sign, and its unit beside those of the motors' currents."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.dynamics.bus import BUS_CURRENT
from lunar_mjx.logs.checks.frames import _finding
from lunar_mjx.logs.findings import WARNING, Finding
from lunar_mjx.logs.log import Log
from lunar_mjx.logs.noise import moving_at
from lunar_mjx.logs.schema import is_quantity, parse_name
from lunar_mjx.logs.series import at, continuous, known, known_at, sigma, span


@dataclasses.dataclass(frozen=True)
class BusLimits:
    """What the checks of the bus tolerate."""

    gives: float = -0.8
    """Mean of a current over that of its size, from which a rover seems to charge its battery all the way."""
    least: float = 0.05
    """A; a mean size below which a current tells no sign. A single-board computer at 12 V draws several times that."""
    level: float = 2.0
    """deg of pitch beyond which motors may brake, and charge the battery, all the way."""
    samples: int = 40
    """Samples on level ground that tell a sign; a quarter of them tells rest, or motion."""
    many: float = 30.0
    """Factor by which a bus's current may vary beyond all motors' currents together: motors alone give no more than
    1, as no amplifier gives more than the bus's voltage, and heaters that are switched a few."""


BUS_LIMITS = BusLimits()


def check_bus(log: Log) -> list[Finding]:
    """Findings on the current of the bus; none where the log has no such channel."""
    return [] if continuous(log, BUS_CURRENT) is None else _sign(log) or _size(log)


def _sign(log: Log) -> list[Finding]:
    """A finding of a current that is negative on the whole, as battery monitors write what is discharged.

    Where it falls as the wheels turn, its sign is wrong; where it rises, something charges the battery. A log without
    rest, or without motion, tells neither and gets a warning.
    """
    # Panels may well give more than the rover takes.
    if "bus_solar_W" in log.channel_names:
        return []
    time, current = known(log, BUS_CURRENT)
    pitch = at(log, "pitch_deg", time)
    # Beyond the span of the pitch nobody knows the slope: level, as where no pitch was logged.
    level = np.ones(len(time), bool) if pitch is None else ~(np.abs(pitch) >= BUS_LIMITS.level)
    moves, current = moving_at(log, time)[level], current[level]
    size = float(np.abs(current).mean()) if len(current) >= BUS_LIMITS.samples else 0.0
    if size <= max(BUS_LIMITS.least, 3.0 * sigma(log, BUS_CURRENT)) or current.mean() > BUS_LIMITS.gives * size:
        return []
    text = f"is negative on the whole (mean {current.mean():.3g} A), as if the battery were charged"
    told = min(moves.sum(), (~moves).sum()) >= BUS_LIMITS.samples / 4
    if not told:
        found = _finding(
            log, BUS_CURRENT, "frame", f"{text}; what is drawn is positive: change its sign if none charged"
        )
        return [dataclasses.replace(found, severity=WARNING)]
    if current[moves].mean() > current[~moves].mean():
        return []
    text = f"{text}, and all the more as the wheels turn; what is drawn is positive: change its sign"
    return [_finding(log, BUS_CURRENT, "frame", text)]


def _size(log: Log) -> list[Finding]:
    """A finding of a current that varies far more than the currents of all drives together."""
    motors = [c for c in log.channel_names if is_quantity(c, "motor_current", "drive")]
    sides = {parts.side for c in motors if (parts := parse_name(c)) is not None}
    limits = span(log, (BUS_CURRENT, *motors))
    # One side, or a few of six wheels, would not be all that the bus feeds; a factor of thirty bears that of two.
    if limits is None or sides != {"left", "right"}:
        return []
    time = np.linspace(*limits, 500)
    drives = np.sum([np.abs(known_at(log, c, time)) for c in motors], axis=0)
    low, high = np.quantile(known_at(log, BUS_CURRENT, time), [0.02, 0.98])
    most = float(np.quantile(drives, 0.98))
    if high - low <= BUS_LIMITS.many * max(most, BUS_LIMITS.least):
        return []
    text = f"varies by {high - low:.3g} A where all drives together draw {most:.3g} A (looks like mA)"
    return [_finding(log, BUS_CURRENT, "unit", f"{text}; correct its unit, as in bus_current_mA")]
