"""The gate on files: good logs pass, and every kind of spoilt log is told with its column, row and reason."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.logs import Noise, check
from lunar_mjx.logs.checks.frames import check_frames
from lunar_mjx.logs.findings import is_bad
from tests.logs.log_files import GRAVITY, make_log, noise

Tables = dict[str, pd.DataFrame]


@pytest.mark.parametrize("seed", range(8))
def test_good_logs_pass(seed: int, tmp_path: Path) -> None:
    assert check(make_log(tmp_path / "a", seed=seed, seconds=20.0 + 5.0 * seed)) == []


def test_a_good_log_with_gaps_lost_rows_jitter_and_quanta_passes(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)

    def change(tables: Tables) -> None:
        drive = tables["drive"]
        drive["time_s"] += 0.004 * rng.uniform(-1, 1, len(drive))
        for name in drive.columns[1:]:
            if name.startswith("command_"):
                continue
            lost = rng.random(len(drive)) < 0.05
            drive.loc[lost, name] = np.nan
        for name in [c for c in drive if c.endswith(("current_A", "angle_rad", "speed_rad_s")) and c[0] != "c"]:
            drive[name] = np.round(drive[name] / 0.01) * 0.01
        tables["drive"] = drive[rng.random(len(drive)) > 0.1].reset_index(drop=True)

    assert check(make_log(tmp_path / "a", change, seconds=60.0)) == []


def test_coloured_noise_stated_as_such_passes(tmp_path: Path) -> None:
    def change(tables: Tables) -> None:
        rng = np.random.default_rng(5)
        thermal = tables["thermal"]
        for name in thermal.columns[1:]:
            state, out = 0.0, []
            for shock in rng.standard_normal(len(thermal)):
                state = 0.9 * state + np.sqrt(1 - 0.81) * shock
                out.append(0.3 * state)
            thermal[name] = -20.0 + np.array(out)

    given = {**noise(), "*_temperature_degC": Noise(0.3, "datasheet", 10.0)}
    assert check(make_log(tmp_path / "a", change, seconds=120.0, noise=given)) == []


def test_white_noise_beside_a_slow_error_that_rest_does_not_show_passes(tmp_path: Path) -> None:
    std = noise()["position_*"].std
    both = 20.0 * std
    joined, apart = Noise(both, "datasheet", 30.0), Noise(both, "datasheet", 30.0, 1.0 - (std / both) ** 2)
    assert check(make_log(tmp_path / "apart", noise={**noise(), "position_*": apart})) == []
    assert check(make_log(tmp_path / "joined", noise={**noise(), "position_*": joined}))


def test_a_log_without_noise_or_attitude_passes(tmp_path: Path) -> None:
    def change(tables: Tables) -> None:
        drop = [c for c in tables["drive"] if c.startswith(("quaternion", "roll", "pitch", "yaw", "gyro"))]
        tables["drive"] = tables["drive"].drop(columns=drop)

    assert check(make_log(tmp_path / "a", change, noise={})) == []


def test_a_gyroscope_with_a_zero_of_its_own_passes_and_a_frozen_angle_does_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)

    def straight(tables: Tables) -> None:
        table = next(t for t in tables.values() if "gyro_z_rad_s" in t)
        # a rover that does not turn, and a gyroscope that says 17 deg/s of it all the time
        table["gyro_z_rad_s"] = 0.3 + 0.002 * rng.standard_normal(len(table))
        table["yaw_deg"] = 0.1 * rng.standard_normal(len(table))

    def frozen(tables: Tables) -> None:
        table = next(t for t in tables.values() if "yaw_deg" in t)
        table["yaw_deg"] = 0.1 * rng.standard_normal(len(table))

    def without_quaternion(tables: Tables) -> None:
        for name, table in tables.items():
            tables[name] = table.drop(columns=[c for c in table if c.startswith("quaternion")])

    passed = check_frames(make_log(tmp_path / "a", both(without_quaternion, straight)))
    assert not [f for f in passed if f.kind == "stuck"]
    found = check_frames(make_log(tmp_path / "b", both(without_quaternion, frozen)))
    assert [f for f in found if f.kind == "stuck" and f.column == "yaw_deg"], found


def swap(*pairs: tuple[str, str]) -> Callable[[Tables], None]:
    def change(tables: Tables) -> None:
        for a, b in pairs:
            table = next(t for t in tables.values() if a in t)
            table[a], table[b] = table[b].copy(), table[a].copy()

    return change


def scale(column: str, factor: float, offset: float = 0.0) -> Callable[[Tables], None]:
    def change(tables: Tables) -> None:
        table = next(t for t in tables.values() if column in t)
        table[column] = factor * table[column] + offset

    return change


def sides_of(pattern: str) -> Callable[[Tables], None]:
    return swap(*((pattern.format(f"l{x}"), pattern.format(f"r{x}")) for x in "fr"))


def both(*changes: Callable[[Tables], object]) -> Callable[[Tables], None]:
    def change(tables: Tables) -> None:
        for one in changes:
            one(tables)

    return change


def set_rows(column: str, rows: slice, value: float | None) -> Callable[[Tables], None]:
    """Sets some rows of a column to a value, or to their first one."""

    def change(tables: Tables) -> None:
        table = next(t for t in tables.values() if column in t)
        values = table[column].to_numpy(float, copy=True)
        values[rows] = values[rows][0] if value is None else value
        table[column] = values

    return change


def time_of(edit: Callable[[np.ndarray], np.ndarray], table: str = "drive") -> Callable[[Tables], None]:
    def change(tables: Tables) -> None:
        tables[table]["time_s"] = edit(tables[table]["time_s"].to_numpy(float, copy=True))

    return change


def clip(column: str, share: float) -> Callable[[Tables], None]:
    def change(tables: Tables) -> None:
        tables["drive"][column] = tables["drive"][column].clip(upper=share * tables["drive"][column].max())

    return change


def later(t: np.ndarray, row: int, by: float) -> np.ndarray:
    t[row:] += by
    return t


def reorder(t: np.ndarray) -> np.ndarray:
    t[[100, 101]] = t[[101, 100]]
    return t


def repeat(t: np.ndarray) -> np.ndarray:
    t[57] = t[56]
    return t


def thin(tables: Tables) -> None:
    tables["drive"] = tables["drive"].iloc[[i for i in range(400) if i % 5 in (0, 2)]].reset_index(drop=True)
    tables["drive"]["time_s"] = np.round(tables["drive"]["time_s"], 6)


CASES: dict[str, tuple[Callable[[Tables], object], str, str, int | None]] = {
    # name: change, kind, column, line of the file
    "time unsorted": (time_of(reorder), "clock", "time_s", 103),
    "time repeats": (time_of(repeat), "clock", "time_s", 59),
    "time jumps back": (time_of(lambda t: later(t, 200, -3.0)), "clock", "time_s", 202),
    "time jumps ahead while driving": (time_of(lambda t: later(t, 150, 2.0)), "clock", "time_s", 152),
    "clock changes its rate": (time_of(lambda t: np.where(t > 8, 8 + 1.5 * (t - 8), t)), "clock", "time_s", None),
    "time in ms": (time_of(lambda t: 1000.0 * t), "clock", "time_s", None),
    "tables from two origins": (time_of(lambda t: t + 5000.0, "thermal"), "clock", "time_s", None),
    "time missing": (set_rows("time_s", slice(5, 6), np.nan), "clock", "time_s", 7),
    "empty column": (set_rows("yaw_deg", slice(None), np.nan), "dropout", "yaw_deg", None),
    "half a column lost": (
        set_rows("motor_lf_drive_current_A", slice(40, 240), np.nan),
        "dropout",
        "motor_lf_drive_current_A",
        42,
    ),
    "temperature in kelvin": (
        scale("winding_lf_drive_temperature_degC", 1.0, 273.15),
        "unit",
        "winding_lf_drive_temperature_degC",
        2,
    ),
    "angle in degrees": (scale("joint_rf_drive_angle_rad", 57.29578), "unit", "joint_rf_drive_angle_rad", None),
    "speed in rpm": (scale("joint_lr_drive_speed_rad_s", 9.5493), "unit", "joint_lr_drive_speed_rad_s", None),
    "gyro in deg/s": (scale("gyro_z_rad_s", 57.29578), "unit", "gyro_z_rad_s", None),
    "current in mA": (scale("motor_rr_drive_current_A", 1000.0), "any", "motor_rr_drive_current_A", None),
    "position in mm": (scale("position_x_m", 1000.0), "any", "world_velocity_x_m_s", None),
    "acceleration in g": (
        both(*(scale(f"accelerometer_{a}_m_s2", 1 / 9.80665) for a in "xyz")),
        "gravity",
        "accelerometer_z_m_s2",
        None,
    ),
    "earth's gravity": (scale("accelerometer_z_m_s2", 9.80665 / GRAVITY), "gravity", "accelerometer_z_m_s2", None),
    "gravity's sign": (scale("accelerometer_z_m_s2", -1.0), "gravity", "accelerometer_z_m_s2", None),
    "accelerometer's axes": (
        swap(("accelerometer_x_m_s2", "accelerometer_z_m_s2")),
        "frame",
        "accelerometer_z_m_s2",
        None,
    ),
    "quaternion not normalised": (set_rows("quaternion_w", slice(30, 35), 1.3), "any", "quaternion_w", 32),
    "quaternion scaled": (both(*(scale(f"quaternion_{c}", 0.9) for c in "wxyz")), "quaternion", "quaternion_w", 2),
    "quaternion's order": (swap(("quaternion_w", "quaternion_z")), "frame", "roll_deg", None),
    "left and right of the speeds": (
        sides_of("joint_{}_drive_speed_rad_s"),
        "swap",
        "joint_lf_drive_speed_rad_s",
        None,
    ),
    "left and right of all": (
        both(
            sides_of("joint_{}_drive_speed_rad_s"),
            sides_of("joint_{}_drive_angle_rad"),
            sides_of("command_{}_drive_speed_rad_s"),
        ),
        "swap",
        "joint_lf_drive_speed_rad_s",
        None,
    ),
    "left and right of the angles": (sides_of("joint_{}_drive_angle_rad"), "swap", "joint_lf_drive_angle_rad", None),
    "currents swapped": (
        swap(("motor_lf_drive_current_A", "motor_rr_drive_current_A")),
        "swap",
        "motor_lf_drive_current_A",
        None,
    ),
    "current and voltage swapped": (
        swap(("motor_lf_drive_current_A", "motor_lf_drive_voltage_V")),
        "swap",
        "motor_lf_drive_voltage_V",
        None,
    ),
    "velocity's axes": (swap(("world_velocity_x_m_s", "world_velocity_y_m_s")), "any", "world_velocity_x_m_s", None),
    "world's axes": (
        both(swap(("world_velocity_x_m_s", "world_velocity_y_m_s")), swap(("position_x_m", "position_y_m"))),
        "frame",
        "position_x_m",
        None,
    ),
    "velocity's sign": (scale("world_velocity_x_m_s", -1.0), "frame", "world_velocity_x_m_s", None),
    "stuck while moving": (
        set_rows("joint_lr_drive_speed_rad_s", slice(120, 200), None),
        "stuck",
        "joint_lr_drive_speed_rad_s",
        122,
    ),
    "stuck all the time": (
        set_rows("motor_lr_drive_current_A", slice(None), None),
        "stuck",
        "motor_lr_drive_current_A",
        2,
    ),
    "saturated": (clip("joint_rr_drive_speed_rad_s", 0.99), "saturated", "joint_rr_drive_speed_rad_s", None),
    "beyond the range": (
        set_rows("winding_rf_drive_temperature_degC", slice(7, 8), 4000.0),
        "range",
        "winding_rf_drive_temperature_degC",
        9,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_spoilt_log_is_told(case: str, tmp_path: Path) -> None:
    change, kind, column, line = CASES[case]
    found = check(make_log(tmp_path / "a", change, rates_hz={"drive": 20.0, "thermal": 1.0}))
    bad = [f for f in found if f.severity == "bad_data"]
    matching = [f for f in bad if f.column == column and kind in (f.kind, "any")]
    assert matching, [(f.where, f.kind, f.message) for f in found]
    if line is not None:
        assert matching[0].line == line, matching[0]
    assert ";" in matching[0].message or "," in matching[0].message
    assert matching[0].to_dict()["line"] == matching[0].line


def with_bus(electronics: float, factor: float, *more: Callable[[Tables], object]) -> Callable[[Tables], None]:
    """Adds what the bus gives, times a factor: the motors' power over 48 V, without jerks, and the electronics."""

    def change(tables: Tables) -> None:
        drive = tables["drive"]
        motors = [c for c in drive if c.startswith("motor_") and c.endswith("current_A")]
        power = sum(drive[c] * drive[c.replace("current_A", "voltage_V")] for c in motors)
        drive["bus_current_A"] = factor * (np.clip(power / 48.0, -1.5, 1.5) + electronics)
        for other in more:
            other(tables)

    return change


def downhill(tables: Tables) -> None:
    drive = tables["drive"]
    drive["pitch_deg"] += 6.0
    tilt = np.radians(6.0)
    drive["accelerometer_x_m_s2"] -= GRAVITY * np.sin(tilt)
    drive["accelerometer_z_m_s2"] -= GRAVITY * (1.0 - np.cos(tilt))


@pytest.mark.parametrize(
    ("electronics", "factor", "kind", "words"),
    [
        (1.5, 1.0, "", ""),
        (0.0, 1.0, "", ""),
        (1.5, -1.0, "frame", "negative on the whole (mean -1."),
        (0.0, -1.0, "frame", "change its sign"),
        (0.0, 200.0, "unit", "looks like mA"),
        (1.5, 1000.0, "range", "outside [-400, 400]"),
    ],
)
def test_the_current_of_the_bus(electronics: float, factor: float, kind: str, words: str, tmp_path: Path) -> None:
    found = [f for f in check(make_log(tmp_path / "a", with_bus(electronics, factor))) if f.column == "bus_current_A"]
    assert [f.kind for f in found] == ([kind] if kind else []), found
    assert all(words in f.message and f.severity == "bad_data" for f in found)


def test_a_bus_that_is_charged_is_no_mistake(tmp_path: Path) -> None:
    def panels(tables: Tables) -> None:
        tables["drive"]["bus_solar_W"] = 100.0 + np.random.default_rng(0).standard_normal(len(tables["drive"]))

    for name, change in (
        ("slope", with_bus(1.0, -1.0, downhill)),
        ("panels", with_bus(1.0, -1.0, panels)),
        ("on a dock", with_bus(-5.0, 1.0)),
    ):
        found = check(make_log(tmp_path / name, change))
        assert not [f for f in found if f.column == "bus_current_A"], name


def test_a_bus_without_a_rest_is_warned_of(tmp_path: Path) -> None:
    def driving(tables: Tables) -> None:
        tables["drive"] = tables["drive"].iloc[100:300].reset_index(drop=True)
        tables["thermal"] = tables["thermal"].iloc[5:15].reset_index(drop=True)

    (found,) = (f for f in check(make_log(tmp_path / "a", with_bus(1.0, -1.0, driving))) if f.column == "bus_current_A")
    assert found.severity == "warning" and "if none charged" in found.message


@pytest.mark.parametrize(("share", "bad"), [(0.35, False), (0.7, True)])
def test_a_short_table_may_lose_a_few_more_cells_by_chance(share: float, bad: bool, tmp_path: Path) -> None:
    def change(tables: Tables) -> None:
        table = next(t for t in tables.values() if "winding_lf_drive_temperature_degC" in t)
        lost = np.random.default_rng(0).permutation(len(table))[: round(share * len(table))]
        table.loc[lost, "winding_lf_drive_temperature_degC"] = np.nan

    found = check(make_log(tmp_path / "a", change, rates_hz={"drive": 20.0, "thermal": 1.0}))
    assert is_bad(found) == bad, [f.message for f in found]


def test_more_than_a_third_of_the_rows_lost(tmp_path: Path) -> None:
    def change(tables: Tables) -> None:
        rng = np.random.default_rng(0)
        tables["drive"] = tables["drive"][rng.random(len(tables["drive"])) > 0.45].reset_index(drop=True)

    found = check(make_log(tmp_path / "a", change, rates_hz={"drive": 20.0, "thermal": 1.0}))
    assert is_bad(found) and {f.kind for f in found} <= {"dropout", "clock"}


@pytest.mark.parametrize("factor", [0.2, 5.0])
@pytest.mark.parametrize("pattern", ["motor_*_current_A", "gyro_*", "position_*", "accelerometer_*"])
def test_noise_contradicted_by_rest(factor: float, pattern: str, tmp_path: Path) -> None:
    given = noise()
    given[pattern] = Noise(given[pattern].std * factor, "datasheet")
    found = check(make_log(tmp_path / "a", noise=given))
    assert found and all(f.kind == "noise" and f.column.startswith(pattern.split("*")[0]) for f in found)
    assert ("noisier" if factor < 1.0 else "quieter") in found[0].message


def test_a_unit_that_does_not_convert_is_bad_data(tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    path = tmp_path / "a" / "drive.csv"
    pd.read_csv(path).rename(columns={"position_x_m": "position_x_degC"}).to_csv(path, index=False)
    from lunar_mjx.logs import read_log

    found = check(read_log(tmp_path / "a"))
    assert [(f.kind, f.column) for f in found] == [("unit", "position_x_degC")] and is_bad(found)


def test_a_campaign_shorter_than_the_slowest_effect(tmp_path: Path) -> None:
    logs = [make_log(tmp_path / "a", seconds=20.0), make_log(tmp_path / "b", seconds=30.0)]
    assert check(logs, {"rotor_stator_path": 25.0}) == []
    found = check(logs, {"rotor_stator_path": 25.0, "housing_radiation": 600.0})
    assert [(f.kind, f.log) for f in found] == [("short", "b")] and "housing_radiation" in found[0].message


def test_the_imu_may_be_mounted_in_any_way(tmp_path: Path) -> None:
    change = both(scale("accelerometer_z_m_s2", -1.0), scale("accelerometer_y_m_s2", -1.0))
    upside_down = {"quaternion": [0.0, 1.0, 0.0, 0.0]}
    assert not [f for f in check(make_log(tmp_path / "a", change, imu=upside_down)) if f.kind == "gravity"]
    assert [f for f in check(make_log(tmp_path / "b", change)) if f.kind == "gravity"]


@pytest.mark.parametrize(("way", "rise", "told"), [(-0.2, -0.028, False), (-0.2, 0.028, True), (0.2, 0.028, False)])
def test_a_rover_that_slides_back_down_a_slope_is_no_reversed_axis(
    way: float, rise: float, told: bool, tmp_path: Path
) -> None:
    """Wheels drive forward up 8 deg; along x, and in height, the rover moves `way` and `rise` m/s."""

    def change(tables: Tables) -> None:
        drive = tables["drive"]
        t = drive["time_s"].to_numpy()
        keep = [
            c
            for c in drive
            if c.startswith(("time", "position", "roll", "pitch", "yaw", "joint", "command")) and "angle" not in c
        ]
        drive = drive[keep].copy()
        rng = np.random.default_rng(1)
        for axis, speed in zip("xyz", (way, 0.0, rise), strict=True):
            drive[f"position_{axis}_m"] = speed * t + 2e-3 * rng.standard_normal(len(t))
        for angle, value in (("roll", 0.0), ("pitch", -8.0), ("yaw", 0.0)):
            drive[f"{angle}_deg"] = value + 0.1 * rng.standard_normal(len(t))
        for corner in ("lf", "rf", "lr", "rr"):
            drive[f"command_{corner}_drive_speed_rad_s"] = 1.5
            drive[f"joint_{corner}_drive_speed_rad_s"] = 1.5 + 5e-3 * rng.standard_normal(len(t))
        tables["drive"] = drive

    found = check_frames(make_log(tmp_path / "a", change, terrain="slope:8deg"))
    assert bool([f for f in found if "heading" in f.message]) is told, [(f.column, f.message) for f in found]


def test_a_long_gap_says_how_to_cut_there(tmp_path: Path) -> None:
    def change(tables: Tables) -> None:
        drive = tables["drive"]
        tables["drive"] = drive[(drive["time_s"] < 10.0) | (drive["time_s"] > 23.0)].reset_index(drop=True)

    (found,) = [f for f in check(make_log(tmp_path / "a", change, seconds=43.0)) if f.table == "drive"]
    assert "lacks 30.3 % of its samples (at most 30 % may be lost)" in found.message
    assert "--split-at-gaps" in found.message
