"""Instruments of a simulated log: rates, noise at datasheet level, quanta, lost samples, biases."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import NamedTuple

import numpy as np
import pandas as pd

from lunar_mjx.errors import bad_input, plain_digits, require_finite, require_within
from lunar_mjx.logs.log import Noise
from lunar_mjx.logs.schema import is_command, limits


class Instrument(NamedTuple):
    """Channels that match `pattern` are written to `table`, with noise `std`, in steps of `quantum` (0: none)."""

    pattern: str
    table: str
    std: float
    quantum: float
    source: str


INSTRUMENTS: tuple[Instrument, ...] = (
    Instrument("command_*", "drive", 0.0, 0.0, "recorded as sent"),
    Instrument("position_*_m", "drive", 5e-3, 1e-3, "stereo visual odometry over some metres, about 1 % of a step"),
    Instrument("world_velocity_*", "drive", 5e-3, 1e-3, "the same, differentiated and filtered at 20 Hz"),
    Instrument("roll_deg", "drive", 0.1, 0.01, "inclinometer, 0.1 deg"),
    Instrument("pitch_deg", "drive", 0.1, 0.01, "inclinometer, 0.1 deg"),
    Instrument("yaw_deg", "drive", 0.2, 0.01, "sun sensor with gyroscope, 0.2 deg"),
    Instrument("joint_*_angle_rad", "drive", 1e-3, 2.0 * np.pi / 4096.0, "encoder of 12 bits at the output"),
    Instrument("joint_*_speed_rad_s", "drive", 5e-3, 2e-3, "its difference quotient, filtered"),
    Instrument("motor_*_current_A", "drive", 0.01, 5e-3, "shunt amplifier of 12 bits over 20 A"),
    Instrument("motor_*_voltage_V", "drive", 0.05, 0.0125, "12 bits over 48 V"),
    Instrument("bus_voltage_V", "drive", 0.05, 0.0125, "12 bits over 48 V"),
    Instrument("gyro_*", "imu", 2e-3, 1e-4, "tactical MEMS IMU beside running motors"),
    Instrument("accelerometer_*", "imu", 0.02, 1e-3, "tactical MEMS IMU beside running motors"),
    Instrument("winding_*", "thermal", 0.3, 0.1, "thermistor, class 0.3 K"),
    Instrument("housing_*", "thermal", 0.3, 0.1, "thermistor, class 0.3 K"),
    Instrument("wheel_*_sinkage_m", "camera", 2e-3, 5e-4, "hazard camera, a pixel at the wheel"),
    Instrument("wheel_*_slip_ratio", "camera", 0.02, 1e-3, "hazard camera over a second, one fiftieth"),
)
"""What a simulated rover carries. Torques at the joints and forces at the wheels are not measured on rovers."""

RATES: Mapping[str, float] = {"drive": 20.0, "imu": 50.0, "thermal": 1.0, "camera": 5.0}
"""Sampling rates by table, Hz."""

FORCE_SENSORS: tuple[Instrument, ...] = (
    Instrument("wheel_*_force_*_N", "drive", 1.0, 0.1, "force-torque sensor of 1 kN, 0.1 %"),
    Instrument("wheel_*_moment_*_Nm", "drive", 0.2, 0.02, "force-torque sensor of 200 N m, 0.1 %"),
    Instrument("motor_*_torque_Nm", "drive", 0.2, 0.02, "torque sensor of 200 N m, 0.1 %"),
)
"""On test vehicles; written with `forces=True`."""


BUS_SENSOR = Instrument("bus_current_A", "drive", 0.05, 0.025, "shunt amplifier of 12 bits over 100 A")
"""Reads all motors together; written with `bus_current=True`, since most rovers read a current per motor instead."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """How a simulated log is recorded.

    Attributes:
      scale: factor on the datasheet's noise; 0 for none.
      coloured: nine tenths of the variance are first-order autoregressive.
      correlation_time_s: of that part; 1.9 s is a correlation of 0.9 at 5 Hz.
      quantise: round to the instruments' quanta.
      dropouts: share of samples lost, half as rows and half as cells.
      bias: constant added to a channel, by name.
      forces: with force and torque sensors.
      bus_current: with the current that the bus gives to all motors.
    """

    scale: float = 1.0
    coloured: bool = False
    correlation_time_s: float = 1.9
    quantise: bool = False
    dropouts: float = 0.0
    bias: Mapping[str, float] = dataclasses.field(default_factory=dict)
    forces: bool = False
    bus_current: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= require_finite("log simulate", "noise scale", self.scale) <= 1e3:
            raise bad_input("log simulate", "noise scale", self.scale, "is not in [0, 1000]", "give a factor")
        if not 0.0 <= require_finite("log simulate", "dropouts", self.dropouts) <= 0.25:
            raise bad_input("log simulate", "dropouts", self.dropouts, "is not in [0, 0.25]", "give a share of samples")
        for channel, value in self.bias.items():
            low, high, _ = limits(channel)
            require_within("log simulate", f"bias {channel}", value, low - high, high - low)

    @property
    def instruments(self) -> tuple[Instrument, ...]:
        """The sensors aboard; those of wheel forces and of the whole current where they are asked for."""
        return INSTRUMENTS + (FORCE_SENSORS if self.forces else ()) + ((BUS_SENSOR,) if self.bus_current else ())

    def noise(self, channels: list[str]) -> dict[str, Noise]:
        """What `log.toml` states: total noise by channel, from the datasheet; it does not tell its colour."""
        found = {c: self.instrument(c) for c in channels}
        return {c: Noise(self.scale * i.std, "datasheet") for c, i in found.items() if i and self.scale * i.std > 0.0}

    def instrument(self, channel: str) -> Instrument | None:
        """The instrument of a channel; None if the rover carries none."""
        # The first pattern counts, case and all: channel names are exact.
        return next((i for i in self.instruments if fnmatchcase(channel, i.pattern)), None)


def parse_noise(text: str) -> float:
    """The factor of `--noise`: datasheet (1), none (0) or scale:5."""
    known = {"datasheet": 1.0, "none": 0.0}
    if text in known:
        return known[text]
    head, _, tail = text.partition(":")
    try:
        if head == "scale":
            return float(plain_digits(tail))
    except ValueError:
        pass
    raise bad_input("log simulate", "--noise", text, "is unknown", "use datasheet, none or scale:5")


def record(
    time: np.ndarray, signals: Mapping[str, np.ndarray], recording: Recording, rng: np.random.Generator
) -> dict[str, pd.DataFrame]:
    """Samples signals into tables at the instruments' rates, with noise, quanta, biases and losses.

    Args:
      time: (n,) of the signals, s, from 0.
      signals: (n,) by channel; Euler angles may wrap.
      recording: how.
      rng: random numbers, used in a fixed order.

    Raises:
      UserError: a bias names a channel that is not recorded.
    """
    tables: dict[str, pd.DataFrame] = {}
    written: set[str] = set()
    for name, rate in RATES.items():
        mine = [c for c in signals if (i := recording.instrument(c)) is not None and i.table == name]
        count = int(np.floor((time[-1] - time[0]) * rate + 1e-6)) + 1
        # Fewer samples than any check can use.
        if not mine or count < 8:
            continue
        when = time[0] + np.arange(count) / rate
        data = {"time_s": when}
        for channel in mine:
            data[channel] = _measured(channel, when, time, signals[channel], recording, rng)
        tables[name] = _lossy(pd.DataFrame(data), recording.dropouts, rng)
        written |= set(mine)
    for channel in recording.bias:
        if channel not in written:
            raise bad_input(
                "log simulate",
                "--bias",
                channel,
                "is not a channel that is recorded",
                f"use one of {', '.join(sorted(written)[:8])}, ...",
            )
    return tables


def _measured(
    channel: str, when: np.ndarray, time: np.ndarray, values: np.ndarray, recording: Recording, rng: np.random.Generator
) -> np.ndarray:
    values = np.asarray(values, float)
    if is_command(channel):
        # Commands are what was sent: held, and without noise.
        return values[np.maximum(np.searchsorted(time, when + 1e-6, side="right") - 1, 0)]
    turn = channel in ("roll_deg", "pitch_deg", "yaw_deg")
    # Unwrapped first: between 179 and -179 deg the straight line would pass through zero.
    sampled = np.interp(when, time, np.unwrap(values, period=360.0) if turn else values)
    instrument = recording.instrument(channel)
    assert instrument is not None
    noise = _noise(when, recording, rng)
    sampled = sampled + recording.bias.get(channel, 0.0) + recording.scale * instrument.std * noise
    if recording.quantise and instrument.quantum > 0.0:
        sampled = instrument.quantum * np.round(sampled / instrument.quantum)
    return (sampled + 180.0) % 360.0 - 180.0 if turn else sampled


def _noise(when: np.ndarray, recording: Recording, rng: np.random.Generator) -> np.ndarray:
    """Unit variance: white, or a tenth white and nine tenths autoregressive."""
    white = rng.standard_normal(len(when))
    if not recording.coloured:
        return white
    keep = np.exp(-(when[1] - when[0]) / recording.correlation_time_s)
    # So sized that the variance is one at every time.
    shocks = rng.standard_normal(len(when)) * np.sqrt(1.0 - keep * keep)
    # Begun in its stationary state and not at zero.
    state = float(rng.standard_normal())
    slow = np.empty(len(when))
    for i, shock in enumerate(shocks):
        state = keep * state + shock
        slow[i] = state
    return np.sqrt(0.1) * white + np.sqrt(0.9) * slow


def _lossy(frame: pd.DataFrame, share: float, rng: np.random.Generator) -> pd.DataFrame:
    if share <= 0.0:
        return frame
    for channel in [c for c in frame.columns if c != "time_s" and not is_command(c)]:
        frame.loc[rng.random(len(frame)) < 0.5 * share, channel] = np.nan
    keep = rng.random(len(frame)) >= 0.5 * share
    # A log's length shall not hang on which samples are lost.
    keep[0] = keep[-1] = True
    return frame.loc[keep].reset_index(drop=True)
