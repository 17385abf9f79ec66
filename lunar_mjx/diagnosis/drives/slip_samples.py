"""Where a channel of a drive means something: slip ratios need wheels that turn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import minimum_filter1d

from lunar_mjx.diagnosis.drives.simulation.rollouts import LogRun
from lunar_mjx.logs.schema import channel_name, is_quantity

if TYPE_CHECKING:
    from lunar_mjx.logs import Log

SLIP_SPEED = 0.03
"""Speed of a wheel's rim below which a measured slip ratio is not compared, m/s."""
SLIP_TIME = 0.25
"""Time around a rim speed below `SLIP_SPEED` in which no slip ratio is compared either, s: where a wheel reverses,
the ratio jumps by hundreds of its noise with a millisecond."""


def defined(log: Log, run: LogRun, channel: str, time: np.ndarray) -> np.ndarray:
    """Where a channel means something: a slip ratio needs a wheel that turns; at rest it is noise over zero."""
    out = np.ones(len(time), bool)
    if not is_quantity(channel, "wheel_slip"):
        return out
    for wheel in run.model.rover.wheels:
        if wheel.corner != channel_name(channel).corner:
            continue
        name = f"{wheel.corner}_drive"
        speed = log.channel(f"joint_{name}_speed_rad_s")
        if speed is None and run.model.modes["drive"] == "velocity":
            speed = log.channel(f"command_{name}_speed_rad_s")
        if speed is not None:
            out &= np.interp(time, speed[0], least(*speed)) * wheel.radius > SLIP_SPEED
    return out


def least(time: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """(n,) least |speed| within `SLIP_TIME` of every sample; zero where it changes its sign."""
    size = np.abs(speed)
    turns = np.flatnonzero(speed[:-1] * speed[1:] < 0.0)
    # Between two samples of opposite sign the speed was zero, which no sample need show.
    size[turns] = size[turns + 1] = 0.0
    reach = int(np.ceil(SLIP_TIME / max(float(np.median(np.diff(time))), 1e-6)))
    return minimum_filter1d(size, 2 * reach + 1, mode="nearest")
