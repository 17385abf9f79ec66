"""Names of channels in their parts: every name of the schema reads back as it is, and sensors agree with families."""

from __future__ import annotations

import itertools

import pytest

from lunar_mjx.effects.sensor.channels import family
from lunar_mjx.logs.schema import (
    CHANNELS,
    CORNERS,
    KINDS,
    SIDES,
    Channel,
    ChannelName,
    is_quantity,
    parse_name,
    sensor_of,
    suffix_of,
)

CLOCKS = {
    "position": "odometry",
    "attitude": "odometry",
    "velocity": "odometry",
    "imu": "imu",
    "joint": "joint",
    "electrical": "electrical",
    "torque": "electrical",
    "temperature": "temperature",
    "wheel": "wheel",
    "force": "wheel",
    "command": None,
}
"""Family of channels that share a clock, by the schema's family."""


def names_of(channel: Channel) -> set[str]:
    """All names that a line of the schema stands for."""
    found = set()
    for corner, joint, axis in itertools.product((*CORNERS, *SIDES), KINDS, "wxyz"):
        name = channel.stem.replace("{c}", corner).replace("{j}", joint).replace("{x}", axis).replace("{q}", axis)
        found.add(name + (f"_{channel.suffix}" if channel.suffix else ""))
    return {name for name in found if parse_name(name) is not None}


@pytest.mark.parametrize("channel", CHANNELS, ids=lambda c: c.stem)
def test_every_name_reads_back(channel: Channel) -> None:
    names = names_of(channel)
    assert names
    for name in names:
        assert str(parse_name(name)) == name
        assert family(name) == CLOCKS[channel.family], "the room of effects has no parser, and must agree"
        assert suffix_of(name) == channel.suffix


def test_a_name_tells_its_parts() -> None:
    assert parse_name("wheel_left_slip_ratio") is None, "sides stand for driven joints alone"
    name = parse_name("motor_left_drive_current_A")
    assert name == ChannelName("motor_current", "left", "drive", "", "A") and name.sensor == "motor"
    assert sensor_of("world_velocity_x_m_s") == "world" and sensor_of("tether_force") == "tether"
    assert suffix_of("tether_force_N") == ""
    assert is_quantity("position_x_m", "position", axis="x") and not is_quantity("position_y_m", "position", axis="x")
    assert is_quantity("wheel_lf_slip_ratio", "wheel_slip") and not is_quantity("wheel_lf_slip_angle_deg", "wheel_slip")
