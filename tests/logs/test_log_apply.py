"""A log's conditions put into a model, and its commands onto whole time steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, commands, log_model, read_log
from lunar_mjx.logs.write import write_log
from lunar_mjx.model import Model, make_model
from tests.logs.log_files import make_log


@pytest.fixture(scope="module")
def base() -> Model:
    return make_model("luvmi_x", "flat")


def small(folder: Path, columns: dict[str, list[float]], step: float = 0.05, **settings: object) -> Log:
    count = len(next(iter(columns.values())))
    frame = pd.DataFrame({"time_s": step * np.arange(count), **columns})
    write_log(folder, {"drive": frame}, rover="luvmi_x", **settings)
    log = read_log(folder)
    assert isinstance(log, Log)
    return log


def test_conditions(base: Model, tmp_path: Path) -> None:
    log = make_log(
        tmp_path / "a",
        gravity_m_s2=9.81,
        terrain="slope:10deg",
        rover_changes={
            "payload_kg": 30.0,
            "payload_position_m": [0.1, 0.0, 0.4],
            "com_offset_m": [0.0, 0.02, 0.0],
            "wheel_radius_offset_m": 0.002,
        },
        environment={"ambient_temperature_degC": -50.0},
    )
    model = log_model(log, base)
    assert model.gravity == 9.81 and model.terrain_spec == "slope:10deg"
    assert model.ambient[0] == pytest.approx(223.15) == model.ambient[1]
    assert model.parameters["payload"] == {"mass": 30.0, "x": 0.1, "y": 0.0, "z": 0.4}
    assert model.parameters["com_offset"]["y"] == 0.02 and model.parameters["wheel_radius_error"]["offset"] == 0.002
    assert model.modes == base.modes, "speeds of drives, and nothing said of the others"


def test_a_payload_is_added_to_one_that_is_there(base: Model, tmp_path: Path) -> None:
    log = make_log(tmp_path / "a", rover_changes={"payload_kg": 10.0, "payload_position_m": [0.0, 0.0, 0.4]})
    model = log_model(log, base.add("payload", mass=30.0, x=0.2, z=0.4))
    assert model.parameters["payload"]["mass"] == 40.0
    assert model.parameters["payload"]["x"] == pytest.approx(0.15)


def test_an_origin_moves_the_terrain(base: Model, tmp_path: Path) -> None:
    log = make_log(tmp_path / "a", terrain_origin_m=[10.0, -4.0])
    field = log_model(log, base).terrain.field
    assert float(field.x0 - base.terrain.field.x0) == -10.0 and float(field.y0 - base.terrain.field.y0) == 4.0


def test_the_sun_reaches_the_effects_that_ask_for_it(base: Model, tmp_path: Path) -> None:
    log = make_log(tmp_path / "a", environment={"sun_azimuth_deg": 90.0, "sun_elevation_deg": -5.0})
    model = log_model(log, base.add("solar_flux"))
    assert model.parameters["solar_flux"]["sun_azimuth"] == pytest.approx(np.pi / 2)
    assert model.parameters["solar_flux"]["sun_elevation"] == pytest.approx(np.radians(-5.0))
    assert log_model(log, base).effect_names == base.effect_names


def test_a_canned_manoeuvre_brings_its_arrangement(base: Model, tmp_path: Path) -> None:
    assert "stand" in log_model(make_log(tmp_path / "a", manoeuvre="wheels_lifted"), base).effect_names
    assert "stand" not in log_model(make_log(tmp_path / "b", manoeuvre="my own"), base).effect_names


MODES = [("speed_rad_s", "velocity"), ("torque_Nm", "torque"), ("current_A", "current"), ("angle_rad", "position")]


@pytest.mark.parametrize(("ending", "mode"), MODES)
def test_modes_by_the_unit_of_the_commands(ending: str, mode: str, base: Model, tmp_path: Path) -> None:
    log = small(tmp_path / "a", {f"command_lf_drive_{ending}": [0.0, 1.0, 2.0]})
    model = log_model(log, base)
    assert model.modes == {**base.modes, "drive": mode}
    found, start = commands(log, model)
    assert start == 0.0 and found.interval == pytest.approx(0.05)
    np.testing.assert_array_equal(found.values[:, 0], [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(found.values[:, 1:], 0.0)


def test_commands_hold_over_gaps_and_start_with_the_log(base: Model, tmp_path: Path) -> None:
    nan = float("nan")
    log = small(tmp_path / "a", {"command_lf_drive_speed_rad_s": [nan, 1.0, nan, 3.0, 4.0]})
    found, start = commands(log, log_model(log, base))
    np.testing.assert_array_equal(found.values[:, 0], [1.0, 1.0, 1.0, 3.0, 4.0])
    assert start == 0.0


def test_commands_of_an_odd_rate_come_on_whole_steps(base: Model, tmp_path: Path) -> None:
    log = small(tmp_path / "a", {"command_lf_drive_speed_rad_s": [1.0, 2.0, 3.0, 4.0]}, step=1.0 / 30.0)
    model = log_model(log, base)
    found, _ = commands(log, model)
    assert found.interval / model.timestep == pytest.approx(round(found.interval / model.timestep))
    assert found.interval <= 1.0 / 120.0
    time = found.interval * np.arange(len(found.values))
    np.testing.assert_array_equal(found.values[:, 0], 1.0 + np.floor(time * 30.0 + 1e-4))


def test_a_clock_offset_moves_a_table(base: Model, tmp_path: Path) -> None:
    drive = pd.DataFrame({"time_s": [0.0, 0.05, 0.1, 0.15], "command_lf_drive_speed_rad_s": [1.0, 2.0, 3.0, 4.0]})
    imu = pd.DataFrame({"time_s": [0.0, 0.1, 0.2], "gyro_z_rad_s": [0.0, 0.0, 0.0]})
    write_log(tmp_path / "a", {"drive": drive, "imu": imu}, rover="luvmi_x", clock_offsets_s={"imu": (-0.1, 0.01)})
    log = read_log(tmp_path / "a")
    assert isinstance(log, Log) and log.span_s == pytest.approx((-0.1, 0.15))
    found, start = commands(log, log_model(log, base))
    assert start == pytest.approx(-0.1)
    np.testing.assert_array_equal(found.values[:, 0], [1.0, 1.0, 1.0, 2.0, 3.0, 4.0])


def test_refused(base: Model, tmp_path: Path) -> None:
    several = {"command_lf_drive_speed_rad_s": [0.0, 1.0, 1.0], "command_rf_drive_torque_Nm": [0.0, 1.0, 1.0]}
    with pytest.raises(UserError, match="several modes"):
        log_model(small(tmp_path / "a", several), base)
    silent = small(tmp_path / "b", {"position_x_m": [0.0, 1.0, 2.0]})
    with pytest.raises(UserError, match="no channel command_"):
        commands(silent, log_model(silent, base))
    torque = small(tmp_path / "c", {"command_lf_drive_torque_Nm": [0.0, 1.0, 1.0]})
    with pytest.raises(UserError, match="log_model"):
        commands(torque, base)
    with pytest.raises(UserError, match="is not the model's rover"):
        log_model(make_log(tmp_path / "d"), make_model("viper", "flat"))


def test_wheels_of_one_motor_follow_its_command(tmp_path: Path) -> None:
    husky = make_model("husky", "flat")
    sides = {"command_left_drive_speed_rad_s": [1.0, 1.0], "command_right_drive_speed_rad_s": [-2.0, -2.0]}
    frame = pd.DataFrame({"time_s": [0.0, 0.05], **sides})
    write_log(tmp_path / "a", {"drive": frame}, rover="husky")
    log = read_log(tmp_path / "a")
    assert isinstance(log, Log)
    driven, _ = commands(log, log_model(log, husky))
    corners = [w.corner for w in husky.rover.wheels]
    assert driven.values[0].tolist() == [1.0 if c.startswith("l") else -2.0 for c in corners]
