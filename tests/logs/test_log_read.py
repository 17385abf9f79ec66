"""Reading logs: units, gaps, rates, patterns of noise, what is refused and what is only noted."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, SteadyLog, read_campaign, read_log
from lunar_mjx.logs.schema import CHANNELS, find_channel, parse_column
from tests.logs.log_files import CORNERS, drive_tables, make_log


def test_a_log_comes_back_as_it_was_written(tmp_path: Path) -> None:
    log = make_log(
        tmp_path / "a",
        split="fit",
        initial={"position_m": [0, 0, 0.16], "yaw_deg": 0.0},
        rover_changes={"payload_kg": 6.0},
        imu={"position_m": [0.1, 0.0, 0.0]},
    )
    tables = drive_tables()
    assert set(log.tables) == {"drive", "thermal"} and log.split == "fit" and log.problems == ()
    assert log.tables["thermal"].rate_hz == 1.0 and log.tables["drive"].rate_hz == pytest.approx(20.0)
    for name, frame in tables.items():
        table = log.tables[name]
        np.testing.assert_allclose(table.time_s, frame["time_s"])
        assert list(table.channels) == list(frame.columns[1:])
        for column in frame.columns[1:]:
            np.testing.assert_allclose(table.channels[column], frame[column], rtol=1e-8, atol=1e-12)
    assert log.noise["winding_rr_drive_temperature_degC"].std == 0.3, "the pattern reaches every channel"
    assert log.initial["position_m"] == (0.0, 0.0, 0.16) and log.imu.position_m == (0.1, 0.0, 0.0)


@pytest.mark.parametrize(
    ("column", "name", "given", "wanted"),
    [
        ("position_x_mm", "position_x_m", 1500.0, 1.5),
        ("joint_lf_drive_speed_deg_s", "joint_lf_drive_speed_rad_s", 180.0, np.pi),
        ("joint_lf_drive_speed_rpm", "joint_lf_drive_speed_rad_s", 60.0, 2.0 * np.pi),
        ("joint_rr_steer_angle_deg", "joint_rr_steer_angle_rad", 90.0, np.pi / 2),
        ("winding_lf_drive_temperature_degF", "winding_lf_drive_temperature_degC", 212.0, 100.0),
        ("housing_lf_sus_temperature_K", "housing_lf_sus_temperature_degC", 273.15, 0.0),
        ("motor_lr_drive_current_mA", "motor_lr_drive_current_A", 250.0, 0.25),
        ("motor_lr_drive_torque_mNm", "motor_lr_drive_torque_Nm", 1500.0, 1.5),
        ("body_velocity_x_km_h", "body_velocity_x_m_s", 3.6, 1.0),
        ("wheel_lf_slip_percent", "wheel_lf_slip_ratio", 30.0, 0.3),
        ("yaw_rad", "yaw_deg", np.pi, 180.0),
        ("accelerometer_z_cm_s2", "accelerometer_z_m_s2", 162.5, 1.625),
    ],
)
def test_units_convert(column: str, name: str, given: float, wanted: float) -> None:
    found = parse_column(column, "file")
    assert found is not None and found.name == name and not found.problem
    assert found.scale * given + found.offset == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(
    "column",
    [
        "position_x_degC",
        "position_x",
        "accelerometer_z_g",
        "quaternion_w_deg",
        "motor_lf_drive_current_rad",
        "wheel_lf_slip_angle_m",
    ],
)
def test_units_that_do_not_convert_are_a_problem_and_no_channel(column: str, tmp_path: Path) -> None:
    log = make_log(tmp_path / "a")
    path = tmp_path / "a" / "drive.csv"
    frame = pd.read_csv(path).rename(columns={"position_x_m": column})
    frame.to_csv(path, index=False)
    log = read_log(tmp_path / "a")
    assert [(p.kind, p.column, p.severity) for p in log.problems] == [("unit", column, "bad_data")]
    assert "position_x_m" not in log.channel_names


def test_every_channel_of_the_schema_is_its_own() -> None:
    for channel in CHANNELS:
        name = channel.stem.replace("{c}", "lf").replace("{j}", "drive").replace("{x}", "x").replace("{q}", "w")
        name += f"_{channel.suffix}" if channel.suffix else ""
        found = find_channel(name)
        assert found is not None and found[0] is channel


def test_gaps_texts_and_foreign_columns(tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    path = tmp_path / "a" / "thermal.csv"
    lines = path.read_text().splitlines()
    cells = [line.split(",") for line in lines]
    cells[3][1], cells[4][1], cells[5][1], cells[6][2] = "", "n/a", "NaN", "hot"
    path.write_text("\n".join(",".join(row) for row in cells) + "\n")
    frame = pd.read_csv(path).assign(lights=1.0)
    frame.to_csv(path, index=False)
    log = read_log(tmp_path / "a")
    values = log.tables["thermal"].channels["winding_lf_drive_temperature_degC"]
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(values)), [2, 3, 4])
    found = {p.kind: p for p in log.problems}
    assert found["number"].line == 7 and found["number"].row == 5 and "'hot'" in found["number"].message
    assert found["unknown"].column == "lights" and found["unknown"].severity == "warning"
    time, kept = log.channel("winding_lf_drive_temperature_degC")
    assert len(time) == len(kept) == len(values) - 3


def test_an_environment_by_column(tmp_path: Path) -> None:
    def change(tables: dict[str, pd.DataFrame]) -> None:
        tables["thermal"]["shade_thermometer"] = -30.0

    log = make_log(tmp_path / "a", change, environment={"ambient_temperature_degC": "shade_thermometer"})
    np.testing.assert_array_equal(log.channel("ambient_temperature_degC")[1], -30.0)
    assert log.problems == ()


REFUSED = {
    "no format": (lambda t: t.replace("lunar-mjx-log/1", "log/7"), ["format", "log/7"]),
    "not toml": (lambda t: t + "\n= 3\n", ["is not valid TOML"]),
    "unknown key": (lambda t: 'colour = "red"\n' + t, ["colour", "unknown key"]),
    "split": (lambda t: 'split = "train"\n' + t, ["split = 'train'", "fit, select, test"]),
    "gravity": (lambda t: t.replace("gravity_m_s2 = 1.625", "gravity_m_s2 = -1.6"), ["gravity_m_s2 = -1.6"]),
    "kind": (lambda t: 'kind = "flight"\n' + t, ["kind = 'flight'", "steady_state"]),
    "file gone": (lambda t: t.replace("thermal.csv", "warm.csv"), ["warm.csv", "not there"]),
    "noise": (lambda t: t.replace("std = 0.3", "std = -0.3"), ["negative entry"]),
    "noise source": (lambda t: t.replace('"datasheet"', '"guess"'), ["source = 'guess'", "datasheet, rest, replicate"]),
    "ambient column": (lambda t: t.replace("-20.0", '"no_such"'), ["environment.ambient_temperature_degC", "no_such"]),
    "initial": (lambda t: t + "\n[initial]\nmood = 3.0\n", ["initial.mood", "unknown key"]),
    "imu": (lambda t: t + "\n[imu]\nquaternion = [1, 1, 0, 0]\n", ["imu.quaternion", "normalise"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_log_toml(case: str, tmp_path: Path) -> None:
    change, words = REFUSED[case]
    make_log(tmp_path / "a")
    path = tmp_path / "a" / "log.toml"
    path.write_text(change(path.read_text()))
    with pytest.raises(UserError) as caught:
        read_log(tmp_path / "a")
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_refused_tables(tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    path = tmp_path / "a" / "thermal.csv"
    frame = pd.read_csv(path)
    for changed, words in (
        (frame.drop(columns="time_s"), ["lack time_s"]),
        (frame.assign(winding_lf_drive_temperature_K=300.0), ["winding_lf_drive_temperature_K", "the same channel"]),
        (frame.assign(position_x_m=0.0), ["both hold position_x_m"]),
    ):
        changed.to_csv(path, index=False)
        with pytest.raises(UserError) as caught:
            read_log(tmp_path / "a")
        for word in words:
            assert word in str(caught.value), str(caught.value)
    path.write_text("time_s,position_x_m\n1,2,3,4\n")
    with pytest.raises(UserError, match="not a CSV table"):
        read_log(tmp_path / "a")


def test_campaigns(tmp_path: Path) -> None:
    for name in ("b", "a"):
        make_log(tmp_path / "campaign" / name)
    logs = read_campaign(tmp_path / "campaign")
    assert [log.name for log in logs] == ["a", "b"]
    assert [log.name for log in read_campaign([tmp_path / "campaign" / "b", tmp_path / "campaign" / "a"])] == ["b", "a"]
    answer = tmp_path / "campaign" / "a.answer.toml"
    answer.write_text("")
    assert [log.name for log in read_campaign([tmp_path / "campaign" / "a", answer])] == ["a"]
    with pytest.raises(UserError, match="no log is given"):
        read_campaign([answer])
    with pytest.raises(UserError, match="named twice"):
        read_campaign([tmp_path / "campaign", tmp_path / "campaign" / "a"])
    with pytest.raises(UserError, match=r"log\.toml"):
        read_campaign(tmp_path / "nowhere")


STEADY = """
format = "lunar-mjx-log/1"
kind = "steady_state"
slip_definition = "travel_speed"
gravity_m_s2 = 9.81
split = "select"
[tables.points]
file = "points.csv"
[wheel]
radius_m = 0.0625
width_m = 0.05
[noise.drawbar_pull_N]
std = 0.8
source = "replicate"
"""


def steady(folder: Path, text: str, toml: str = STEADY) -> SteadyLog:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "log.toml").write_text(toml)
    (folder / "points.csv").write_text(text)
    log = read_log(folder)
    assert isinstance(log, SteadyLog)
    return log


def test_a_steady_state_log(tmp_path: Path) -> None:
    log = steady(
        tmp_path,
        "slip_percent,slip_angle_rad,normal_load_kN,drawbar_pull_N,drawbar_pull_std_N,sinkage_mm,"
        "trial\n"
        "10,0,0.02,3,0.5,12,1\n30,0.5235987755982988,0.02,6,0.6,17,2\n",
    )
    np.testing.assert_allclose(log.table.test["slip_ratio"], [0.1, 0.3])
    np.testing.assert_allclose(log.table.test["slip_angle_deg"], [0.0, 30.0])
    np.testing.assert_allclose(log.table.test["normal_load_N"], 20.0)
    np.testing.assert_allclose(log.table.measured["sinkage"], [0.012, 0.017])
    np.testing.assert_allclose(log.row_std["drawbar_pull_N"], [0.5, 0.6])
    assert log.table.sigma == {"drawbar_pull": 0.8} and log.split == "select" and log.problems == ()
    assert log.wheel["radius_m"] == log.table.radius == 0.0625 and log.wheel["grouser_count"] == 0.0


def test_rows_that_no_wheel_can_repeat_are_left_out_and_told(tmp_path: Path) -> None:
    log = steady(
        tmp_path, "slip_ratio,slip_angle_deg,normal_load_N,drawbar_pull_N\n0.1,0,20,3\n0.2,0,-20,4\n12,0,20,5\n"
    )
    assert [(p.column, p.line) for p in log.problems] == [("normal_load_N", 3), ("slip_ratio", 4)]
    np.testing.assert_array_equal(log.rows, [0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("slip_ratio,normal_load_N,drawbar_pull_N\n0.1,20,3\n", ["slip_angle_deg is missing"]),
        ("slip_ratio,slip_angle_deg,normal_load_N\n0.1,0,20\n", ["nothing measured"]),
        ("slip_ratio,slip_angle_deg,normal_load_N,drawbar_pull_N\n", ["no rows"]),
    ],
)
def test_refused_steady_tables(text: str, words: list[str], tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        steady(tmp_path, text)
    for word in words:
        assert word in str(caught.value)


def test_parquet_without_pyarrow_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lunar_mjx.logs.readers.table.importlib.util.find_spec", lambda _: None)
    make_log(tmp_path / "a")
    (tmp_path / "a" / "thermal.parquet").write_bytes(b"PAR1")
    path = tmp_path / "a" / "log.toml"
    path.write_text(path.read_text().replace("thermal.csv", "thermal.parquet"))
    with pytest.raises(UserError, match=r"pyarrow; install lunar-mjx\[parquet\]"):
        read_log(tmp_path / "a")
    with pytest.raises(UserError, match=r"pyarrow; install lunar-mjx\[parquet\]"):
        make_log(tmp_path / "b", parquet=True)
    assert not (tmp_path / "b").exists()


@pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="needs pyarrow")
def test_parquet(tmp_path: Path) -> None:
    log = make_log(tmp_path / "a", parquet=True)
    assert log.tables["drive"].file.suffix == ".parquet"
    for corner in CORNERS:
        name = f"joint_{corner}_drive_speed_rad_s"
        np.testing.assert_array_equal(log.tables["drive"].channels[name], drive_tables()["drive"][name])


def test_the_name_is_that_of_the_folder(tmp_path: Path) -> None:
    log = make_log(tmp_path / "morning")
    again = read_log(tmp_path / "morning" / "log.toml")
    assert isinstance(again, Log) and log.name == again.name == "morning"
