"""What nobody knows exactly of a log: its start, the zero of its encoders, what its electronics draw, and how its time
compares with finite steps."""

from __future__ import annotations

import dataclasses
import re
from typing import TYPE_CHECKING

import numpy as np

from lunar_mjx.diagnosis.drives.instruments import is_instrument
from lunar_mjx.diagnosis.drives.simulation.log_run import LOG_START, READS_BEFORE, STOOD
from lunar_mjx.inference.coordinates import NUISANCE, Coordinate
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.logs.schema import is_quantity

if TYPE_CHECKING:
    from lunar_mjx.diagnosis.drives.simulation.rollouts import LogRun

STEP_ERROR = "step_error"
"""Name of the nuisance by which logs differ from what steps of finite length predict."""
_COUNTED = re.compile(r"position|angle|yaw")
"""What another pose at the start moves as a whole."""
_START = {"x": (0.01, 1.0), "y": (0.01, 1.0), "yaw": (0.01, 0.6), "temperature": (1.0, 100.0)}
"""Scale and reach of what is measured with noise at the start, m, rad, K."""


@dataclasses.dataclass(frozen=True)
class StoodTime:
    """The time for which a rover had stood when its log begins."""

    # Of the time for which a rover had stood, s.
    stood_scale: float = 0.5
    stood_most: float = 6.0
    shows: float = 500.0
    """Squared difference between them, in sigma, from which the time is fitted. Where it matters less, its jumps
    (wheels at rest that change the sign of their slip) cost descents more than it gives: four drives of VIPER on a
    slope show thousands, six of LUVMI-X some fifty."""


STOOD_TIME = StoodTime()

ELECTRONICS_QUANTILE = 0.1
"""1; quantile of a bus's current from which the draw of its electronics is sought: near what it gives at rest, with
motors that brake for a moment left out."""
_FARTHEST_DRAW = 6.0
"""Standard deviations at which that draw is bounded."""

STANDING = (LOG_START.settle, 3.0 * LOG_START.settle)
"""Times of standing that are compared, s."""


def is_encoder(series: Series) -> bool:
    """Whether a channel counts a wheel's turns from a zero of its own."""
    return is_quantity(series.channel, "joint_angle", "drive")


def is_bus_current(channel: str) -> bool:
    """Whether a channel (or the nuisance of its name) holds what motors and electronics draw together."""
    return is_quantity(channel, "bus_current")


def standing_shows(change: np.ndarray, number: int, observations: Observations) -> bool:
    """Whether a change (n,) of the predictions by another time of standing is more than another pose at the start."""
    total, sigma = 0.0, observations.sigma()
    for s in observations.series:
        if s.log == number:
            # The mean of a counted channel is what another pose at the start takes up.
            own = change[s.start : s.stop] / sigma[s.start : s.stop]
            total += float(np.sum((own - own.mean() if _COUNTED.search(s.channel) else own) ** 2))
    return total > STOOD_TIME.shows


def step_error_share() -> Coordinate:
    """How much of the step's error all logs contain: all where a rover was measured, nothing where steps of the same
    length recorded it."""
    return Coordinate(NUISANCE, STEP_ERROR, 0.0, 1.0, 0.0, 1.0, prior=0.5, centre=0.5)


def reads_before_share() -> Coordinate:
    """How far currents and voltages of a row are those from before the row's command: 1 where a controller reads
    before it acts and a motor's current takes milliseconds to rise, 0 where a simulator records after it.

    The model's motors have no inductance: at the instant of a command's jump their current jumps, too.
    """
    return Coordinate(NUISANCE, READS_BEFORE, 0.0, 1.0, 0.0, 1.0, prior=0.5, centre=0.5)


def nuisances(number: int, run: LogRun, observations: Observations, stood: bool) -> list[Coordinate]:
    """Coordinates of one log's nuisances; those of `is_linear` need no simulation.

    `stood` tells whether the time for which the rover had stood is one.
    """
    coordinates = [
        Coordinate(
            NUISANCE,
            name,
            run.start[name],
            _START[name][0],
            run.start[name] - _START[name][1],
            run.start[name] + _START[name][1],
            prior=10.0,
            log_index=number,
        )
        for name in run.unknown
        if name in _START
    ]
    if stood:
        coordinates.append(
            Coordinate(
                NUISANCE,
                STOOD,
                run.start[STOOD],
                STOOD_TIME.stood_scale,
                LOG_START.settle,
                STOOD_TIME.stood_most,
                prior=10.0,
                log_index=number,
            )
        )
    for s in observations.series:
        if s.log == number and is_encoder(s):
            first = float(np.mean(observations.value[s.start : s.stop][:5]))
            scale = 3.0 * float(observations.sigma()[s.start])
            coordinates.append(
                Coordinate(
                    NUISANCE,
                    s.channel,
                    first,
                    scale,
                    first - 30.0 * scale,
                    first + 30.0 * scale,
                    prior=10.0,
                    log_index=number,
                )
            )
        elif s.log == number and is_bus_current(s.channel):
            coordinates.append(_electronics(number, s, observations))
    return coordinates


def _electronics(number: int, series: Series, observations: Observations) -> Coordinate:
    """The constant current, A, that computers, radios and sensors draw beside the motors, and that nobody logs.

    Its standard deviation is the reading's root mean square: it may be all of the current or nothing of it.
    """
    own = slice(series.start, series.stop)
    measured = observations.value[own]
    draw = float(np.quantile(measured, ELECTRONICS_QUANTILE))
    std = float(np.hypot(np.sqrt(np.mean(measured**2)), observations.sigma()[series.start]))
    far = _FARTHEST_DRAW * std
    return Coordinate(
        NUISANCE, series.channel, draw, std, draw - far, draw + far, prior=1.0, unit="A", log_index=number
    )


def is_linear(c: Coordinate) -> bool:
    """Whether a coordinate adds a known vector to the predictions, whatever the others are."""
    if not c.nuisance:
        return False
    constant = is_quantity(c.name, "joint_angle", "drive") or is_bus_current(c.name)
    return constant or c.name == STEP_ERROR or is_instrument(c)


def direction(c: Coordinate, observations: Observations, step_error: np.ndarray) -> np.ndarray:
    """(n,) what one unit of a linear nuisance's value adds to the predictions."""
    out = np.zeros(len(observations))
    for s in observations.series:
        if c.log_index in (s.log, -1):
            part = slice(s.start, s.stop)
            if c.name == STEP_ERROR:
                out[part] = step_error[part]
            elif c.name == s.channel:
                out[part] = 1.0
    return out


def from_first(predicted: np.ndarray, observations: Observations) -> np.ndarray:
    """Predictions (..., n) with the angles of encoders counted from their first sample."""
    for s in observations.series:
        if is_encoder(s):
            predicted[..., s.start : s.stop] -= predicted[..., s.start : s.start + 1]
    return predicted
