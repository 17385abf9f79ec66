"""What instruments get wrong: clocks of tables and the IMU's mounting where a log states an error, and what is usual.

A stated error is a nuisance of its log whose prior is the stated standard deviation. To first order it adds a known
vector to the predictions: the derivative by time of a table's channels, or the turn of a vector by a small angle. Usual
errors (zeros, scales, clocks) are the same in all logs; every refit finds them, so that its predictions are of what the
instruments read.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_mjx.effects.sensor.channels import family
from lunar_mjx.inference.coordinates import NUISANCE, Coordinate
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.logs import Log
from lunar_mjx.logs.attitude import EULER
from lunar_mjx.logs.schema import channel_name, sensor_of, suffix_of

CLOCK, MOUNTING, USUAL = "clock ", "mounting ", "usual "
"""Names of these nuisances begin so, and go on with the table, the axis, or the kind of instrument and its error."""


@dataclasses.dataclass(frozen=True)
class UsualErrors:
    """What instruments usually get wrong, and by how much at most."""

    farthest: float = 6.0
    """Standard deviations at which stated errors are bounded."""
    usual_farthest: float = 30.0
    """Standard deviations at which usual errors are bounded: far enough that their prior holds them and no bound
    does (a gyro's zero had ended at six, where a foreign LUVMI-X asked for seven and a half)."""
    unknown_deg: float = 60.0
    """A mounting less well known than this is no small angle: its axis tells nothing, and has no nuisance."""
    usual_clock_s: float = 0.005
    """Usual error between the clocks of kinds of channels, s: a quarter of a sampling interval of 50 Hz."""


USUAL_ERRORS = UsualErrors()

USUAL_ZERO = {"gyro": 0.002, "accelerometer": 0.02}
"""Usual bias of an inertial sensor by the first word of its channels, rad/s and m/s2: a MEMS unit's over a day."""
USUAL_SCALE = {
    "gyro": 0.01,
    "accelerometer": 0.01,
    "motor": 0.01,
    "position": 0.01,
    "world": 0.01,
    "body": 0.01,
    "wheel": 0.05,
    "bus A": 0.05,
}
"""Usual error of an instrument's scale by the first word of its channels, or with their unit: 1 %; 5 % of what a camera
sees of a rim in the soil, whose surface is rough, and of the current of a bus, of which amplifiers lose 2 to 10 %.
Angles of joints are counted, and have none."""
_VECTORS = {"gyro": "gyro_{}_rad_s", "accelerometer": "accelerometer_{}_m_s2"}


def instrument_nuisances(number: int, log: Log, observations: Observations) -> list[Coordinate]:
    """Coordinates of one log for each clock and mounting angle that it states within an error.

    Args:
      number: of the log. log: itself. observations: of the campaign.
    """
    mine = [s for s in observations.series if s.log == number]
    coordinates = []
    for name, table in log.tables.items():
        if table.clock_offset_std_s > 0.0 and any(s.channel in table.channels for s in mine):
            coordinates.append(_coordinate(CLOCK + name, table.clock_offset_std_s, "s", number))
    turned = [s for s in mine if sensor_of(s.channel) in _VECTORS or (log.imu.attitude and s.channel in EULER)]
    for axis, std in zip("xyz", log.imu.mounting_std_deg, strict=True):
        if turned and 0.0 < std < USUAL_ERRORS.unknown_deg:
            coordinates.append(_coordinate(MOUNTING + axis, float(np.radians(std)), "rad", number))
    return coordinates


def _coordinate(name: str, std: float, unit: str, number: int) -> Coordinate:
    far = USUAL_ERRORS.farthest * std
    return Coordinate(NUISANCE, name, 0.0, std, -far, far, prior=1.0, unit=unit, log_index=number)


def is_instrument(c: Coordinate) -> bool:
    """Whether a coordinate is one of these nuisances."""
    return c.nuisance and c.name.startswith((CLOCK, MOUNTING, USUAL))


def instrument_direction(
    c: Coordinate, log: Log, observations: Observations, predicted: np.ndarray, rate: np.ndarray
) -> np.ndarray:
    """(n,) what one unit (s, rad) of such a nuisance adds to the predictions.

    Args:
      c: the nuisance. log: that it belongs to. observations: of the campaign.
      predicted: (n,) by the model as given. rate: (n,) its change by time, per second.
    """
    out = np.zeros(len(observations))
    series = [s for s in observations.series if s.log == c.log_index]
    if c.name.startswith(CLOCK):
        table = log.tables[c.name.removeprefix(CLOCK)]
        for s in series:
            if s.channel in table.channels:
                out[s.start : s.stop] = rate[s.start : s.stop]
        return out
    axis = "xyz".index(c.name.removeprefix(MOUNTING))
    for s in series:
        kind, place = sensor_of(s.channel), slice(s.start, s.stop)
        if log.imu.attitude and s.channel == EULER[axis]:
            out[place] = np.degrees(1.0)  # near level; the attitude's axes are the chassis's
        elif kind in _VECTORS:
            out[place] = _turned(kind, s, series, log, axis, predicted)
    return out


def _turned(kind: str, one: Series, series: list[Series], log: Log, axis: int, predicted: np.ndarray) -> np.ndarray:
    """(samples,) change of one component of a vector, in the IMU's axes, by a turn of the IMU about a body axis.

    With the reading v = R(q)^T b of a body vector b, a further turn by a small angle a changes it by R(q)^T (b x a).
    """
    assert one.time is not None
    mounting = Rotation.from_quat(log.imu.quaternion, scalar_first=True)
    up = mounting.inv().apply([0.0, 0.0, log.gravity_m_s2]) if kind == "accelerometer" else np.zeros(3)
    # Axes that no channel gives are taken to be at rest, where gravity alone is read.
    vector = np.tile(up, (len(one.time), 1))
    for k, letter in enumerate("xyz"):
        other = next((s for s in series if s.channel == _VECTORS[kind].format(letter)), None)
        if other is not None and other.time is not None:
            vector[:, k] = np.interp(one.time, other.time, predicted[other.start : other.stop])
    change = mounting.inv().apply(np.cross(mounting.apply(vector), np.eye(3)[axis]))
    return change[:, "xyz".index(channel_name(one.channel).axis)]


def usual_nuisances(observations: Observations) -> list[Coordinate]:
    """Coordinates of what instruments get wrong as much as is usual, in units of that, shared by all logs."""
    names = usual_errors(observations, observations.value, np.zeros(len(observations)))
    far = USUAL_ERRORS.usual_farthest
    return [Coordinate(NUISANCE, USUAL + name, 0.0, 1.0, -far, far, prior=1.0) for name in names]


def usual_kind(c: Coordinate) -> str:
    """The kind of instrument that such a nuisance belongs to; empty for other coordinates."""
    return c.name.removeprefix(USUAL).partition(": ")[0] if c.nuisance and c.name.startswith(USUAL) else ""


def usual_errors(observations: Observations, predicted: np.ndarray, rate: np.ndarray) -> dict[str, np.ndarray]:
    """What instruments add that err as much as is usual, the same in all logs.

    Args:
      observations: of the campaign. predicted: (n,) by the model.
      rate: (n,) its change by time, per second. From one sample of 20 Hz to the next a wheel has reached its command:
        differences of `predicted` would not tell it.

    Returns:
      (n,) by "kind of instrument: error", in the channels' units.
    """
    columns: dict[str, np.ndarray] = {}

    def add(name: str, part: slice, error: np.ndarray | float) -> None:
        columns.setdefault(name, np.zeros(len(observations)))[part] = error

    for s in observations.series:
        word, part = sensor_of(s.channel), slice(s.start, s.stop)
        if word in USUAL_ZERO:
            add(f"{word}: zero {s.channel}", part, USUAL_ZERO[word])
        # motors, wheels and the bus have channels of several quantities, which their unit tells
        kind = f"{word} {suffix_of(s.channel)}" if word in ("motor", "wheel", "bus") else word
        usual_scale = USUAL_SCALE.get(kind, USUAL_SCALE.get(word, 0.0))
        if usual_scale:
            # Of the prediction: measured values would bring their noise into the column, and it would fit that. Of a
            # position it is the way from the start, which odometry measures.
            since = predicted[part] - predicted[s.start] if word == "position" else predicted[part]
            add(f"{kind}: scale", part, usual_scale * since)
        if s.time is not None and s.stop - s.start > 2:
            # A late reading shows what was there before, hence the sign.
            add(f"clock {family(s.channel) or word}: late", part, -USUAL_ERRORS.usual_clock_s * rate[part])
    return columns
