"""Driving one rover: commands by group or by table, log channels, and what is refused."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.dynamics import System, Telemetry, build
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model, make_model
from lunar_mjx.rover import convert
from lunar_mjx.simulate import (
    Commands,
    channels,
    check_finite,
    command_channels,
    constant_commands,
    front_steering,
    joint_channels,
    read_commands,
    simulate,
)

KINDS = ("drive", "steer", "sus")
CORNERS = ("lf", "rf", "lr", "rr")
SCHEMA = [
    "time_s",
    r"(position|world_velocity|body_velocity)_[xyz]_m(_s)?",
    r"(gyro_[xyz]_rad_s|accelerometer_[xyz]_m_s2)",
    "quaternion_[wxyz]",
    "(roll|pitch|yaw)_deg",
    "joint_{j}_angle_rad",
    "joint_{j}_speed_rad_s",
    "motor_{j}_(current_A|voltage_V|torque_Nm)",
    "(winding|housing)_{j}_temperature_degC",
    "wheel_{c}_(sinkage_m|slip_ratio|slip_angle_deg)",
    "wheel_{c}_(force_[xyz]_N|moment_[xyz]_Nm)",
    "command_{j}_(current_A|torque_Nm|speed_rad_s|angle_rad)",
]
"""The channels of the measurement log, `{c}` a corner and `{j}` a corner with the kind of its joint."""

IN_TORQUE = """
from lunar_mjx.effects import effect

@effect("motor_torque")
def broken(ctx, p, x, torque):
    return {body}
"""


@pytest.fixture(scope="module")
def model() -> Model:
    return make_model("luvmi_x", "flat")


@pytest.fixture(scope="module")
def table(model: Model) -> pd.DataFrame:
    """A command table of 0.2 s: drive at 0.4 rad/s."""
    commands = constant_commands(model, 0.2, drive=0.4)
    times = {"time_s": np.arange(len(commands.values)) * commands.interval}
    return pd.DataFrame({**times, **dict(zip(command_channels(model), commands.values.T, strict=True))})


@pytest.fixture(scope="module")
def drive(model: Model) -> tuple[System, Telemetry, Commands]:
    """0.3 s from (3, -2) m to the north and left."""
    commands = front_steering(model, constant_commands(model, 0.3, model.timestep, drive=0.8), 0.1)
    return *simulate(model, commands, 3.0, -2.0, np.pi / 2), commands


def test_channels_of_a_drive(model: Model, drive: tuple[System, Telemetry, Commands]) -> None:
    system, seen, commands = drive
    found = channels(system, seen, commands)
    patterns = [p.format(c=f"({'|'.join(CORNERS)})", j=f"({'|'.join(CORNERS)})_({'|'.join(KINDS)})") for p in SCHEMA]
    for name in found.columns:
        assert any(re.fullmatch(p, name) for p in patterns), f"{name} is not in the schema of logs"
    for pattern in patterns:
        assert any(re.fullmatch(pattern, name) for name in found.columns), pattern
    assert found.columns[0] == "time_s"
    np.testing.assert_allclose(found["time_s"], np.arange(150) * 0.002, atol=1e-6)
    assert found["winding_lf_drive_temperature_degC"].iloc[0] == pytest.approx(25.0, abs=1e-3)
    np.testing.assert_array_equal(found["command_lf_drive_speed_rad_s"], 0.8)
    np.testing.assert_array_equal(found["command_rf_steer_angle_rad"], 0.1)
    np.testing.assert_array_equal(found["command_lr_steer_angle_rad"], 0.0)
    last = found.iloc[-1]
    assert last["yaw_deg"] == pytest.approx(90.0, abs=2.0)
    assert (last["position_x_m"], last["position_y_m"]) == pytest.approx((3.0, -2.0), abs=0.05)
    assert all(0.1 < last[f"joint_{c}_drive_speed_rad_s"] < 1.6 for c in CORNERS), "the wheels are driven forward"
    assert last["joint_lf_steer_angle_rad"] > 0.02, "and the front ones steered to the left"
    weight = model.rover.mass * model.gravity
    assert 0.3 * weight < sum(last[f"wheel_{c}_force_z_N"] for c in CORNERS) < 3.0 * weight


def test_channels_are_those_of_the_sensors(model: Model, drive: tuple[System, Telemetry, Commands]) -> None:
    """Effects at the port `sensor` change what is written and nothing else."""
    system, seen, commands = drive
    plain = channels(system, seen, commands)
    askew = build(model.add("imu_bias", pitch_bias=0.1, accelerometer_x=0.5).add("bus_droop"))
    found = channels(askew, seen, commands)
    assert found["pitch_deg"].to_numpy() == pytest.approx(plain["pitch_deg"].to_numpy() + np.degrees(0.1), abs=1e-6)
    power = sum(plain[f"motor_{j}_voltage_V"] * plain[f"motor_{j}_current_A"] for j in joint_channels(model.rover))
    assert found["bus_voltage_V"].to_numpy() == pytest.approx(48.0 - 0.1 * np.asarray(power) / 48.0, rel=1e-9)
    assert "bus_voltage_V" not in plain
    np.testing.assert_array_equal(found["joint_lf_drive_angle_rad"], plain["joint_lf_drive_angle_rad"])
    assert plain["accelerometer_z_m_s2"].iloc[-1] == pytest.approx(model.gravity, rel=0.5), (
        "specific force, not acceleration"
    )


def test_joint_channels_go_by_corner_and_kind(tmp_path: Path) -> None:
    data = Path(__file__).parent / "rover" / "data"
    rover = convert(data / "steered.urdf", tmp_path)
    found = joint_channels(rover)
    assert len(set(found)) == len(rover.joints) == len(found)
    for wheel in rover.wheels:
        for joint, kind in ((wheel.drive, "drive"), (wheel.steer, "steer"), (wheel.suspension, "sus")):
            if joint is not None:
                assert found[rover.joints.index(joint)] == f"{wheel.corner}_{kind}"


def test_constant_commands(model: Model) -> None:
    commands = constant_commands(model, 1.0, drive=0.4, steer=-0.1)
    assert commands.values.shape == (20, 12) and commands.interval == pytest.approx(0.05)
    np.testing.assert_array_equal(commands.values, np.tile([0.4] * 4 + [-0.1] * 4 + [0.0] * 4, (20, 1)))


def test_the_default_interval_is_a_whole_number_of_time_steps(model: Model) -> None:
    for timestep in (0.002, 0.003, 0.02, 0.0007):
        interval = constant_commands(model.replace(timestep=timestep), 1.0).interval
        assert interval / timestep == pytest.approx(round(interval / timestep)) and 0.04 <= interval <= 0.06


def test_command_channels_follow_the_modes(model: Model) -> None:
    modes = {"drive": "torque", "steer": "current", "suspension": "velocity"}
    names = command_channels(model.replace(modes=modes))
    assert names[0] == "command_lf_drive_torque_Nm" and names[4] == "command_lf_steer_current_A"
    assert names[8] == "command_lf_sus_speed_rad_s"
    assert command_channels(model)[4] == "command_lf_steer_angle_rad"


def test_read_commands(model: Model, table: pd.DataFrame, tmp_path: Path) -> None:
    path = tmp_path / "commands.csv"
    table[table.columns[::-1]].to_csv(path, index=False)
    commands = read_commands(path, model)
    assert commands.interval == pytest.approx(0.05)
    np.testing.assert_array_equal(commands.values, constant_commands(model, 0.2, drive=0.4).values)


def edit(table: pd.DataFrame, column: str, row: int, value: object) -> pd.DataFrame:
    table = table.astype(object)
    table.loc[row, column] = value
    return table


TABLES = {
    "missing column": (lambda t: t.drop(columns="command_rf_drive_speed_rad_s"), ["lack command_rf_drive_speed_rad_s"]),
    "no time": (lambda t: t.drop(columns="time_s"), ["lack time_s"]),
    "unknown column": (lambda t: t.assign(lights=1.0), ["column = 'lights'", "is unknown", "time_s"]),
    "nan": (
        lambda t: edit(t, "command_lf_drive_speed_rad_s", 1, "nan"),
        ["line 3", "command_lf_drive_speed_rad_s = nan", "not a finite number"],
    ),
    "empty cell": (lambda t: edit(t, "command_lf_drive_speed_rad_s", 2, ""), ["line 4", "not a finite number"]),
    "infinite": (lambda t: edit(t, "command_lf_steer_angle_rad", 0, "inf"), ["line 2", "steer_angle_rad = inf"]),
    "text": (lambda t: edit(t, "command_lf_steer_angle_rad", 0, "left"), ["line 2", "'left'", "not a finite number"]),
    "truth": (lambda t: t.assign(command_lf_steer_angle_rad=True), ["line 2", "True", "not a finite number"]),
    "time not a number": (lambda t: edit(t, "time_s", 1, "noon"), ["line 3", "time_s = 'noon'"]),
    "time goes back": (lambda t: t.iloc[::-1], ["time_s", "does not rise"]),
    "time repeats": (lambda t: edit(t, "time_s", 1, 0.0), ["time_s", "does not rise"]),
    "one row": (lambda t: t.iloc[:1], ["time_s = [0.0]", "give two at least"]),
    "no rows": (lambda t: t.iloc[:0], ["time_s = []", "give two at least"]),
    "uneven time": (lambda t: edit(t, "time_s", 3, 0.2), ["0.05 to 0.1 s apart", "uneven", "resample"]),
}


@pytest.mark.parametrize("case", TABLES)
def test_refused_table(case: str, model: Model, table: pd.DataFrame, tmp_path: Path) -> None:
    change, words = TABLES[case]
    path = tmp_path / "commands.csv"
    change(table).to_csv(path, index=False)
    assert_refused(lambda: read_commands(path, model), [str(path), *words])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", ["is not a CSV table"]),
        (b"\x89PNG\r\n\x1a\n\xff\xfe\x00", ["is not a CSV table"]),
        (b"time_s,b\n0,1,2\n1,2,3\n", ["is not a CSV table"]),
        (b"time_s,b\n0,1\n1,2,3\n", ["is not a CSV table"]),
    ],
)
def test_refused_file(text: bytes, words: list[str], model: Model, tmp_path: Path) -> None:
    path = tmp_path / "commands.csv"
    path.write_bytes(text)
    assert_refused(lambda: read_commands(path, model), [str(path), *words])


def assert_refused(call, words: list[str]) -> None:
    with pytest.raises(UserError) as caught:
        call()
    text = str(caught.value)
    assert text.endswith(".") and ";" in text, text
    for word in words:
        assert word in text, text


def test_missing_table(model: Model, tmp_path: Path) -> None:
    assert_refused(lambda: read_commands(tmp_path / "gone.csv", model), ["gone.csv", "not there"])


COMMANDS = {
    "unknown group": (lambda m: constant_commands(m, 1.0, arm=1.0), ["arm = 1.0", "drive, steer, suspension"]),
    "nan": (lambda m: constant_commands(m, 1.0, drive=np.nan), ["drive = nan", "not finite"]),
    "negative duration": (lambda m: constant_commands(m, -1.0), ["duration = -1.0", "below 0.05 s"]),
    "duration nan": (lambda m: constant_commands(m, np.nan), ["duration = nan", "not finite"]),
    "duration for ever": (lambda m: constant_commands(m, 1e15), ["duration", "above 50000 s", "several parts"]),
    "steer nan": (lambda m: front_steering(m, constant_commands(m, 1.0), np.nan), ["steer = nan", "not finite"]),
    "steer by torque": (
        lambda m: front_steering(m.replace(modes={**m.modes, "steer": "torque"}), constant_commands(m, 1.0), 0.1),
        ["steer = 0.1", "mode of steer is torque"],
    ),
    "shape": (lambda m: simulate(m, Commands(np.zeros((3, 5)), 0.05)), ["(3, 5)", "give (time, 12)"]),
    "not finite": (
        lambda m: simulate(m, Commands(np.full((3, 12), np.inf), 0.05)),
        ["command 0", "lf_drive = inf", "not finite"],
    ),
    "interval below the time step": (
        lambda m: simulate(m, Commands(np.zeros((3, 12)), 1e-4)),
        ["interval = '0.0001 s'", "0.002 s", "timestep_s"],
    ),
    "interval between time steps": (
        lambda m: simulate(m, Commands(np.zeros((3, 12)), 0.005)),
        ["interval = '0.005 s'", "no whole number", "timestep_s = 0.0025"],
    ),
    "off the terrain": (
        lambda m: simulate(m, constant_commands(m, 1.0), 0.0, 1e4),
        ["y = 10000.0", "off the terrain flat", "-100 .. 100 m"],
    ),
    "start nan": (lambda m: simulate(m, constant_commands(m, 1.0), np.nan), ["x = nan", "not finite"]),
    "heading nan": (lambda m: simulate(m, constant_commands(m, 1.0), yaw=np.nan), ["yaw = nan", "not finite"]),
    "no motor": (lambda m: simulate(m.remove("motor"), constant_commands(m, 1.0)), ["lacks motor"]),
    "unknown engine": (lambda m: simulate(m, constant_commands(m, 1.0), engine="warp"), ["engine = 'warp'", "mjx"]),
}


@pytest.mark.parametrize("case", COMMANDS)
def test_refused_commands(case: str, model: Model) -> None:
    call, words = COMMANDS[case]
    assert_refused(lambda: call(model), words)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("torque + no_such_name", ["line 6", "the effect does not run", "NameError", "no_such_name", "mend that line"]),
        ("torque if torque > 0 else -torque", ["line 6", "the effect does not run", "mend that line"]),
        ("None", ["the model does not run with the effect broken", "return the port's value"]),
    ],
)
def test_a_users_effect_that_does_not_run(body: str, words: list[str], model: Model, tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(IN_TORQUE.format(body=body))
    own = model.add(str(path))
    assert_refused(lambda: simulate(own, constant_commands(own, 0.1), engine="mjx"), [str(path), *words])


def test_a_simulation_that_diverges_is_told(drive: tuple[System, Telemetry, Commands]) -> None:
    telemetry = drive[1]
    check_finite(telemetry)
    for name, row, when in (("winding_temperature", 50, "0.1 s"), ("quaternion", 0, "0 s"), ("slip", 149, "0.298 s")):
        values = np.array(getattr(telemetry, name))
        values[row:, 3] = np.nan
        broken = dataclasses.replace(telemetry, **{name: values})
        assert_refused(lambda t=broken: check_finite(t), [f"time = '{when}'", "diverged", "smaller timestep_s"])
