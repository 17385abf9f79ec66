"""The channels of a measurement log: unit, family and physical range of each, by the pattern of its name."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Mapping

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.units import to_unit

FORMAT = "lunar-mjx-log/1"
CORNERS = ("lf", "rf", "lm", "rm", "lr", "rr")
"""Left and right, front, middle (six wheels) and rear."""
KINDS = ("drive", "steer", "sus")
SIDES = ("left", "right")
"""In the place of a corner: one reading for all wheels of a side, which one motor or one command drives together.

A side's current is what its one motor draws, whatever number of wheels it turns; a side's speed is that of each of its
wheels. A reading that stands for a side is written once, under the side's name: a copy for each wheel would count as
independent readings.
"""
SPLITS = ("fit", "select", "test")
NOISE_SOURCES = ("datasheet", "rest", "replicate", "vibration", "ripple", "estimate")
"""Where a stated noise comes from; the last three are what a drive shows of an IMU, of currents and of all else."""
NOISE_KEYS = ("std", "source", "correlation_time_s", "correlated_share")
"""What a log states of a channel's noise."""
MIRROR = {"lf": "rf", "rf": "lf", "lm": "rm", "rm": "lm", "lr": "rr", "rr": "lr", "left": "right", "right": "left"}
"""The corner on the other side, or the other side."""
IMPOSED = ("wheel_speed",)
"""What a log may declare as imposed: measured, and taken as what the rover did, so that it is no observation."""


@dataclasses.dataclass(frozen=True)
class Channel:
    """A channel, or a family of channels that differ in axis, corner or joint.

    Attributes:
      stem: pattern of the name without its unit; `{c}` a corner (before `_drive` a side as well), `{j}` drive, steer or
        sus, `{x}` an axis, `{q}` a component of a quaternion.
      suffix: unit as the name ends; empty for pure numbers that the stem already names.
      unit: the same in the grammar of `lunar_mjx.units`.
      family: position, attitude, velocity, imu, joint, electrical, torque, temperature, wheel, force or command.
      low, high: what is physically possible on a rover, in `unit`; values beyond are another unit or a broken sensor.
      why: reason of the range.
    """

    stem: str
    suffix: str
    unit: str
    family: str
    low: float
    high: float
    why: str

    @functools.cached_property
    def pattern(self) -> re.Pattern[str]:
        """Matches a name without its unit, with the groups `corner`, `joint` and `axis` where the stem has them."""
        joint = f"(?P<joint>{'|'.join(KINDS)})"
        # Sides only where joints are driven: no rover steers a side as one.
        side = f"(?:{'|'.join(SIDES)})(?=_drive)" if "{c}_{j}" in self.stem else ""
        corner = f"(?P<corner>{'|'.join(CORNERS)}{'|' if side else ''}{side})"
        text = self.stem.replace("{c}", corner).replace("{j}", joint).replace("{x}", "(?P<axis>[xyz])")
        return re.compile(text.replace("{q}", "(?P<axis>[wxyz])"))


def _channel(
    stem: str, suffix: str, family: str, low: float, high: float, why: str, unit: str | None = None
) -> Channel:
    return Channel(stem, suffix, unit or unit_of(suffix), family, low, high, why)


def unit_of(suffix: str) -> str:
    """A unit as names carry it (`m_s2`, `Nm`, `deg_s`) in the grammar of `lunar_mjx.units` ("m/s2")."""
    # Ratios carry a word and no unit.
    if suffix in ("", "ratio"):
        return "1"
    text = suffix.replace("_per_", "_")
    text = re.sub(r"^(k|m|M|c|u)?N(k|m|c)?m(?=_|$)", lambda m: f"{m[1] or ''}N {m[2] or ''}m", text)
    head, *rest = text.split("_")
    return "/".join([head, *rest])


_SPEED = "rovers on the Moon and Mars drive below 5 m/s"
_ELECTRIC = "rovers' buses stay below 200 V and their motors below 200 A"
_HEAT = "no motor or lubricant outlives 300 degC, and the coldest crater is -250 degC"

CHANNELS: tuple[Channel, ...] = (
    _channel("position_{x}", "m", "position", -1e5, 1e5, "a drive log stays within 100 km of its origin"),
    _channel("quaternion_{q}", "", "attitude", -1.1, 1.1, "a component of a unit quaternion"),
    _channel("roll", "deg", "attitude", -180.0, 180.0, "a full turn"),
    _channel("pitch", "deg", "attitude", -90.0, 90.0, "by definition of the angle"),
    _channel("yaw", "deg", "attitude", -36000.0, 36000.0, "a hundred turns, where it is not wrapped"),
    _channel("world_velocity_{x}", "m_s", "velocity", -10.0, 10.0, _SPEED),
    _channel("body_velocity_{x}", "m_s", "velocity", -10.0, 10.0, _SPEED),
    _channel("gyro_{x}", "rad_s", "imu", -20.0, 20.0, "the range of gyroscopes of a rover's IMU, 1000 deg/s"),
    _channel("accelerometer_{x}", "m_s2", "imu", -200.0, 200.0, "the range of accelerometers of a rover's IMU, 20 g"),
    _channel("joint_{c}_{j}_angle", "rad", "joint", -1e6, 1e6, "a wheel of 0.1 m would have rolled 100 km"),
    _channel("joint_{c}_{j}_speed", "rad_s", "joint", -100.0, 100.0, "a wheel of 0.1 m would drive 10 m/s"),
    _channel("motor_{c}_{j}_current", "A", "electrical", -200.0, 200.0, _ELECTRIC),
    _channel("motor_{c}_{j}_voltage", "V", "electrical", -2e3, 2e3, "beyond any rover's bus, simulated or not"),
    _channel("bus_voltage", "V", "electrical", 0.0, 400.0, _ELECTRIC),
    _channel("bus_current", "A", "electrical", -400.0, 400.0, "ten motors of 40 A; more looks like mA"),
    _channel("bus_load", "W", "electrical", -1e5, 1e5, "200 V at 200 A, braking motors included, and some more"),
    _channel("bus_solar", "W", "electrical", -1.0, 1e5, "70 m2 of panels in full sunlight at 1 au"),
    _channel("battery_charge", "ratio", "electrical", -0.1, 1.1, "a share of the full charge"),
    _channel("chassis_temperature", "degC", "temperature", -250.0, 300.0, _HEAT),
    _channel("motor_{c}_{j}_torque", "Nm", "torque", -5e3, 5e3, "more than any rover's joint bears"),
    _channel("winding_{c}_{j}_temperature", "degC", "temperature", -250.0, 300.0, _HEAT),
    _channel("housing_{c}_{j}_temperature", "degC", "temperature", -250.0, 300.0, _HEAT),
    _channel("wheel_{c}_sinkage", "m", "wheel", -0.2, 1.0, "a wheel that sinks by a metre is buried"),
    _channel("wheel_{c}_slip_angle", "deg", "wheel", -180.0, 180.0, "an angle of the wheel's velocity"),
    _channel("wheel_{c}_slip", "ratio", "wheel", -5.0, 5.0, "eq. 8 stays within [-2, 2]; the rest is noise"),
    _channel("wheel_{c}_force_{x}", "N", "force", -1e5, 1e5, "more than any rover weighs"),
    _channel("wheel_{c}_moment_{x}", "Nm", "force", -1e4, 1e4, "more than any rover's wheel bears"),
    _channel("drawbar_pull", "N", "force", -1e5, 1e5, "more than any rover weighs"),
    _channel("command_{c}_{j}_current", "A", "command", -200.0, 200.0, _ELECTRIC),
    _channel("command_{c}_{j}_torque", "Nm", "command", -5e3, 5e3, "more than any rover's joint bears"),
    _channel("command_{c}_{j}_speed", "rad_s", "command", -100.0, 100.0, "a wheel of 0.1 m would drive 10 m/s"),
    _channel("command_{c}_{j}_angle", "rad", "command", -1e6, 1e6, "a wheel of 0.1 m would have rolled 100 km"),
)
"""Every channel of the schema."""

GREATEST_GRAVITY = 100.0
"""m/s2: of a centrifuge with a test bed in it; no rover meets more."""
LATEST = 1e11
"""s: no clock counts 3000 years."""
ANGLE_LIMIT = math.tau
"""Steering and suspension joints do not turn further, rad; wheels do."""

STEADY_CHANNELS: Mapping[str, tuple[str, float, float]] = {
    "slip_ratio": ("1", -1.5, 1.5),
    "slip_angle_deg": ("deg", -95.0, 95.0),
    "normal_load_N": ("N", 0.0, 1e5),
    "travel_speed_m_s": ("m/s", 0.0, 10.0),
    "rim_speed_m_s": ("m/s", 0.0, 10.0),
    "drawbar_pull_N": ("N", -1e5, 1e5),
    "side_force_N": ("N", -1e5, 1e5),
    "driving_torque_Nm": ("N m", -1e4, 1e4),
    "sinkage_m": ("m", -0.1, 1.0),
    "trial": ("1", 0.0, 1e9),
}
"""Columns of a steady-state table: unit and physical range."""


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of a file as a channel: value = `scale` * cell + `offset`; `problem` if its unit does not convert."""

    name: str
    channel: Channel | None
    scale: float = 1.0
    offset: float = 0.0
    problem: str = ""


@dataclasses.dataclass(frozen=True)
class ChannelName:
    """A channel's name in its parts.

    Attributes:
      quantity: what is measured, such as `motor_current`, `joint_speed`, `position` or `wheel_force`.
      corner: `lf` .. `rr`, a side (`left`, `right`), or "" for what belongs to the whole rover.
      joint: drive, steer, sus or "".
      axis: x, y, z, a component w, x, y, z of a quaternion, or "".
      unit: as the name ends (`rad_s`); "" for pure numbers that carry none.
    """

    quantity: str
    corner: str = ""
    joint: str = ""
    axis: str = ""
    unit: str = ""

    @property
    def side(self) -> str:
        """`left`, `right`, or "" where the channel belongs to neither."""
        if self.corner in SIDES:
            return self.corner
        # Corners begin with their side's letter; the middle rows of six wheels do, too.
        return {"l": "left", "r": "right"}.get(self.corner[:1], "")

    @property
    def sensor(self) -> str:
        """What reads the channel, by the first word of its quantity: `gyro`, `motor`, `wheel`, `world` (odometry)."""
        return self.quantity.partition("_")[0]

    @property
    def kind(self) -> str:
        """The name without its corner: one kind of sensor, wherever on the rover it sits."""
        return str(dataclasses.replace(self, corner=""))

    def at(self, corner: str) -> ChannelName:
        """The channel of the same quantity at another corner or side."""
        return dataclasses.replace(self, corner=corner)

    def __str__(self) -> str:
        head, _, tail = self.quantity.partition("_")
        parts = (head, self.corner, self.joint, tail, self.axis, self.unit)
        return "_".join(p for p in parts if p)


def channel_name(name: str) -> ChannelName:
    """The parts of a channel's name.

    Raises:
      UserError: the name is no channel of the schema.
    """
    parts = parse_name(name)
    if parts is None:
        raise bad_input("channel", "name", name, "is no channel", "list them with lunar-mjx log channels")
    return parts


@functools.cache
def parse_name(name: str) -> ChannelName | None:
    """The parts of a channel's name; None for a name that is not of the schema."""
    found = find_channel(name)
    if found is None:
        return None
    channel, match = found
    parts = match.groupdict()
    # The stem without its places: `joint_{c}_{j}_speed` is the quantity `joint_speed`.
    quantity = re.sub(r"_?\{.\}", "", channel.stem)
    return ChannelName(
        quantity, parts.get("corner") or "", parts.get("joint") or "", parts.get("axis") or "", channel.suffix
    )


def is_command(name: str) -> bool:
    """Whether a channel is what the rover was told, not what was measured: such names alone begin with `command_`."""
    return name.startswith("command_")


def is_quantity(name: str, quantity: str, joint: str = "", axis: str = "") -> bool:
    """Whether a channel is of a quantity such as `joint_speed`, wherever on the rover.

    Args:
      name: of the channel. quantity: as in `ChannelName`. joint, axis: which one; any if empty.
    """
    parts = parse_name(name)
    return parts is not None and parts.quantity == quantity and joint in ("", parts.joint) and axis in ("", parts.axis)


def sensor_of(name: str) -> str:
    """What reads a channel (`ChannelName.sensor`); the first word of a name that is not of the schema."""
    parts = parse_name(name)
    return name.partition("_")[0] if parts is None else parts.sensor


def suffix_of(name: str) -> str:
    """The unit that ends a channel's name (`degC`); empty without one, and for a name that is not of the schema."""
    parts = parse_name(name)
    return "" if parts is None else parts.unit


def channel_kind(name: str) -> str:
    """A channel's name without its corner; names that are not of the schema as they are."""
    parts = parse_name(name)
    return name if parts is None else parts.kind


def find_channel(name: str) -> tuple[Channel, re.Match[str]] | None:
    """The channel that a name of the schema belongs to, with the match that holds its corner, joint and axis."""
    for channel in CHANNELS:
        # The unit belongs to the name: `position_x` alone is no channel, for nobody could say in what it counts.
        stem = name.removesuffix("_" + channel.suffix) if channel.suffix else name
        match = channel.pattern.fullmatch(stem)
        if match and (not channel.suffix or stem != name):
            return channel, match
    return None


def limits(name: str) -> tuple[float, float, str]:
    """Physical range of a channel and its reason; infinite for a name that is not of the schema."""
    found = find_channel(name)
    if found is None:
        return -float("inf"), float("inf"), ""
    channel, match = found
    # The one range that depends on the joint.
    if channel.suffix == "rad" and match["joint"] != "drive":
        return -ANGLE_LIMIT, ANGLE_LIMIT, "steering and suspension turn less than once"
    return channel.low, channel.high, channel.why


def parse_column(column: str, source: str) -> Column | None:
    """What a column of a file holds: a channel in the schema's unit or in another one that its name ends with.

    Args:
      column: such as `position_x_m`, `position_x_mm` or `winding_lf_drive_temperature_degF`.
      source: file to name in a problem.

    Returns:
      The channel with its conversion; None where the name does not belong to the schema at all.
    """
    found = find_channel(column)
    if found is not None:
        return Column(column, found[0])
    for channel in CHANNELS:
        match = channel.pattern.match(column)
        rest = column[match.end() :] if match else ""
        # `pitching_m` is no pitch: the stem must end where a word ends.
        if match is None or (rest and not rest.startswith("_")):
            continue
        name = column[: match.end()] + (f"_{channel.suffix}" if channel.suffix else "")
        # Refused with the full name, and not taken to be SI: a guess at a unit would be a thousandfold error.
        if not rest:
            return Column(name, channel, problem=f"does not say its unit; call it {name} if it is in {channel.unit}")
        scale, offset, problem = conversion(rest[1:], channel.unit, source, column)
        return Column(name, channel, scale, offset, problem and f"{problem}; give {name}")
    return None


def conversion(suffix: str, unit: str, source: str, field: str) -> tuple[float, float, str]:
    """Scale and offset that bring a value with the unit `suffix` to `unit`, and what is wrong if there are none."""
    given = "percent" if suffix in ("percent", "pct") else unit_of(suffix)
    try:
        offset = to_unit(0.0, given, unit, source, field)
        # Units convert by straight lines, so two values tell scale and offset (degF to degC).
        scale = to_unit(1.0, given, unit, source, field) - offset
    except UserError:
        shown = "a pure number" if unit == "1" else unit
        return 1.0, 0.0, f"ends with {suffix!r}, which does not convert to {shown}"
    return scale, offset, ""
