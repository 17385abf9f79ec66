"""Logs from plain files: what loggers write is imported by a map and read back, and nothing is taken twice."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, check, import_drives, read_log
from lunar_mjx.logs.readers.clocks import TimeColumn, seconds
from lunar_mjx.logs.readers.geodesy import tangent_plane, utm, utm_zone
from lunar_mjx.logs.readers.held import held_samples
from lunar_mjx.logs.readers.import_map import read_map, shipped_maps
from lunar_mjx.resources import shipped
from tests.cli_harness import Run

MAP = """
[log]
rover = "luvmi_x"
gravity_m_s2 = 9.81
[tables.drive]
file = "{drive}.txt"
header = false
separator = "blank"
missing = [-1000]
time = { column = 3, clock = true }
[tables.drive.channels]
joint_left_drive_speed_rad_s = { column = 0, scale = 0.5, offset = 0.1 }
joint_right_drive_speed_rad_s = { sum = [{ column = 0, scale = 0.5 }, { column = 1, scale = -1.0 }] }
motor_left_drive_current_mA = 2
"""


def write_map(folder: Path, text: str = MAP, name: str = "map.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def drive(folder: Path) -> Log:
    log = read_log(folder)
    assert isinstance(log, Log)
    return log


def test_blanks_sentinels_clocks_and_sums(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(
        "2.0  1.0   500 23:59:59.50\n4.0 -1000 600 23:59:59.75\n 6.0 2.0 -1000 00:00:00.00\n", encoding="utf-8"
    )
    found = import_drives(tmp_path / "a.txt", tmp_path / "log", write_map(tmp_path))
    log = drive(found.folder)
    table = log.tables["drive"]
    np.testing.assert_allclose(table.time_s, [0.0, 0.25, 0.5])
    np.testing.assert_allclose(table.channels["joint_left_drive_speed_rad_s"], [1.1, 2.1, 3.1])
    np.testing.assert_allclose(table.channels["joint_right_drive_speed_rad_s"], [0.0, np.nan, 1.0])
    np.testing.assert_allclose(table.channels["motor_left_drive_current_A"], [0.5, 0.6, np.nan])
    assert log.source["files"] == "a.txt"


def test_the_ground_may_be_the_name_of_the_folder(tmp_path: Path) -> None:
    ice = tmp_path / "ICE"
    ice.mkdir()
    (ice / "a.txt").write_text("2 1 500 10:00:00.0\n4 1 600 10:00:00.5\n", encoding="utf-8")
    text = MAP.replace("[log]", '[log]\nground = "{folder}"')
    found = import_drives(ice, tmp_path / "log", write_map(tmp_path, text))
    assert drive(found.folder).ground == "ice"
    told = import_drives(ice, tmp_path / "other", write_map(tmp_path, text), changes={"ground": "frozen lake"})
    assert drive(told.folder).ground == "frozen lake"
    bag = text[: text.index("[tables.drive]")] + '[tables.drive]\ntopic = "/odom"\n[tables.drive.channels]\n'
    bag += 'body_velocity_x_m_s = "twist.twist.linear.x"\n'
    with pytest.raises(UserError, match=r"log\.ground"):
        read_map(write_map(tmp_path, bag, "bag.toml"))


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", "."), (";", ","), ("\t", "."), (" ", ".")])
def test_the_separator_is_guessed(tmp_path: Path, separator: str, decimal: str) -> None:
    rows = [("time", "speed", "note"), *((f"{0.1 * k:.2f}", f"{k + 0.5:.3f}", f"{k}") for k in range(30))]
    text = "".join(separator.join(v.replace(".", decimal) for v in row) + "\n" for row in rows)
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    mapping = write_map(
        tmp_path,
        f"""
[log]
rover = "luvmi_x"
[tables.drive]
file = "a.csv"
decimal = "{decimal}"
time = "time"
[tables.drive.channels]
joint_lf_drive_speed_rad_s = "speed"
""",
    )
    found = import_drives(tmp_path / "a.csv", tmp_path / "log", mapping)
    time, values = drive(found.folder).channel("joint_lf_drive_speed_rad_s") or (None, None)
    np.testing.assert_allclose(values, np.arange(30) + 0.5)
    np.testing.assert_allclose(time, 0.1 * np.arange(30))
    assert any("note" in note for _, note in found.notes), "a column that nobody reads is named"


COMMAS = """t;links;I
s;m/s;A
0,00;1,5;2,0
0,05;1,6;-2,5
0,10;;3,0
"""


def test_a_row_of_units_is_left_out_and_decimal_commas_are_told(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text(COMMAS, encoding="utf-8")
    text = """
[log]
rover = "husky"
[tables.drive]
file = "a.csv"
time = "t"
[tables.drive.channels]
joint_left_drive_speed_rad_s = { column = "links", scale = 2.0 }
motor_left_drive_current_A = "I"
"""
    with pytest.raises(UserError, match=r't, row 0 = \'0,00\' is no number; write decimal = ","'):
        import_drives(file, tmp_path / "log", write_map(tmp_path, text))
    with pytest.raises(UserError, match=r'links, row 0 = \'1,5\' .*; write decimal = ","'):
        import_drives(file, tmp_path / "log", write_map(tmp_path, text.replace('"t"', "{ rate_hz = 20 }")))
    told = text.replace('time = "t"', 'time = "t"\ndecimal = ","')
    found = import_drives(file, tmp_path / "log", write_map(tmp_path, told))
    table = drive(found.folder).tables["drive"]
    np.testing.assert_allclose(table.time_s, [0.0, 0.05, 0.1])
    np.testing.assert_allclose(table.channels["joint_left_drive_speed_rad_s"], [3.0, 3.2, np.nan])
    np.testing.assert_allclose(table.channels["motor_left_drive_current_A"], [2.0, -2.5, 3.0])
    assert any("under the header holds no number (s, m/s, A) and is left out" in note for _, note in found.notes)


TWO = """
[log]
rover = "luvmi_x"
[tables.drive]
file = "pro_{drive}.csv"
time = { column = "t", unit = "ms" }
[tables.drive.channels]
motor_left_drive_current_A = "c"
[tables.imu]
file = "imu_{drive}.csv"
time = "t"
start = "own"
clock_offset_std_s = 0.05
[tables.imu.channels]
gyro_z_rad_s = "w"
"""


def test_files_of_several_drives_with_clocks_of_their_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in ("01", "02"):
        pd.DataFrame({"t": 1000.0 + 200.0 * np.arange(20), "c": rng.normal(size=20)}).to_csv(
            tmp_path / f"pro_{name}.csv", index=False
        )
    pd.DataFrame({"t": 77.0 + 0.01 * np.arange(300), "w": rng.normal(size=300)}).to_csv(
        tmp_path / "imu_01.csv", index=False
    )
    found = import_drives(tmp_path, tmp_path / "out", write_map(tmp_path, TWO), changes={"ground": "sand"})
    assert [p.name for p in found.logs] == ["01", "02"]
    first, second = map(drive, found.logs)
    assert set(first.tables) == {"drive", "imu"} and set(second.tables) == {"drive"}
    assert first.tables["imu"].time_s[0] == 0.0 and first.tables["imu"].rate_hz == pytest.approx(100.0)
    assert first.tables["drive"].rate_hz == pytest.approx(5.0)
    assert first.tables["imu"].clock_offset_std_s == 0.05 and first.ground == "sand"
    assert any(name == "02" and "imu" in note for name, note in found.notes)


def test_matlab_structs_of_different_length(tmp_path: Path) -> None:
    t = 0.1 * np.arange(40)
    savemat(tmp_path / "run.mat", {"imu": {"t": t, "w": np.stack([t, 2 * t, 3 * t])}, "other": np.arange(99.0)})
    mapping = write_map(
        tmp_path,
        """
[log]
rover = "luvmi_x"
[tables.imu]
file = "*.mat"
time = "imu.t"
[tables.imu.channels]
gyro_z_rad_s = "imu.w[2]"
""",
    )
    found = import_drives(tmp_path / "run.mat", tmp_path / "log", mapping)
    np.testing.assert_allclose(drive(found.folder).tables["imu"].channels["gyro_z_rad_s"], 3 * t)


def test_parquet(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    frame = pd.DataFrame({"t": 0.1 * np.arange(40), "w": np.arange(40.0)})
    frame.to_parquet(tmp_path / "run.parquet")
    text = '[log]\nrover = "luvmi_x"\n[tables.imu]\nfile = "*.parquet"\ntime = "t"\n'
    mapping = write_map(tmp_path, text + '[tables.imu.channels]\ngyro_z_rad_s = "w"\n')
    found = import_drives(tmp_path / "run.parquet", tmp_path / "log", mapping)
    np.testing.assert_allclose(drive(found.folder).tables["imu"].channels["gyro_z_rad_s"], np.arange(40.0))


def test_copies_of_a_slow_sensor_are_no_readings(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    t = 0.1 * np.arange(900)
    slow = np.repeat(np.round(20.0 + rng.normal(size=18), 1), 50)
    frame = pd.DataFrame({"t": t, "w": slow, "c": rng.normal(size=900)})
    frame.to_csv(tmp_path / "a.csv", index=False)
    text = '[log]\nrover = "luvmi_x"\n[tables.drive]\nfile = "a.csv"\ntime = "t"\n[tables.drive.channels]\n'
    text += 'joint_left_drive_speed_rad_s = "w"\nmotor_left_drive_current_A = "c"\n'
    found = import_drives(tmp_path / "a.csv", tmp_path / "log", write_map(tmp_path, text))
    log = drive(found.folder)
    held = log.table_of("joint_left_drive_speed_rad_s")
    assert held is not None and len(held) == 18 and held.rate_hz == pytest.approx(0.2)
    assert len(log.tables["drive"]) == 900
    assert len(found.copies) == 1 and "renewed every 5 s" in found.copies[0] and "18 of 900" in found.copies[0]
    text = text.replace('time = "t"', 'time = "t"\nheld = "never"')
    kept = import_drives(tmp_path / "a.csv", tmp_path / "whole", write_map(tmp_path, text))
    assert len(drive(kept.folder).tables["drive"].channels["joint_left_drive_speed_rad_s"]) == 900


def _steps(rng: np.random.Generator) -> np.ndarray:
    """A command followed closely: constant but for ramps, in few digits."""
    return np.round(np.repeat(rng.choice([0.0, 0.2, 0.5], 12), 30) + 0.008 * rng.integers(-1, 2, 360), 3)


@pytest.mark.parametrize(
    ("make", "held"),
    [
        (lambda rng: rng.normal(size=360), False),
        (lambda rng: np.round(rng.normal(size=360), 1), False),
        (_steps, False),
        (lambda rng: np.full(360, 0.24), False),
        (lambda rng: np.repeat(rng.normal(size=180), 2), True),
        (lambda rng: np.repeat(rng.normal(size=180), rng.integers(1, 4, 180))[:360], True),
        (lambda rng: np.repeat(np.round(5.0 + 0.1 * rng.normal(size=36), 1), 10), True),
    ],
)
def test_what_counts_as_held(make: Callable[[np.random.Generator], np.ndarray], held: bool) -> None:
    for seed in range(5):
        values = make(np.random.default_rng(seed))
        found = held_samples(0.1 * np.arange(len(values)), values[:, None])
        assert (found is not None) == held, seed
        if found is not None:
            changes = np.flatnonzero(np.diff(values) != 0.0) + 1
            assert found.readings[changes].all()


def test_places_in_metres(tmp_path: Path) -> None:
    easting, northing = utm(np.array(43.642567), np.array(-79.387139), utm_zone(-79.387139))
    assert utm_zone(-79.387139) == 17
    # the CN Tower on the grid of zone 17, as published (630,084 m east, 4,833,438 m north)
    assert abs(float(easting) - 630084.0) < 1.0 and abs(float(northing) - 4833439.0) < 1.0
    assert float(utm(np.array(-33.0), np.array(-70.0), 19)[1]) > 5e6
    # a degree of latitude is 111,133 m at 45 degrees and one of longitude 78,847 m (WGS84)
    east, north = tangent_plane(np.array([45.0005, 45.0]), np.array([8.0, 8.0005]), (45.0, 8.0))
    assert abs(north[0] - 0.0005 * 111132.1) < 1e-3 and abs(east[1] - 0.0005 * 78846.8) < 1e-3
    rows = "".join(f"{0.2 * k:.1f} {45.0 + 1e-6 * k:.7f} {8.0 + 2e-6 * k:.7f} {k % 7}\n" for k in range(40))
    (tmp_path / "a.txt").write_text("0.0 0 0 1\n" + rows.replace("0.0 45", "0.1 45", 1), encoding="utf-8")
    mapping = write_map(
        tmp_path,
        """
[log]
rover = "luvmi_x"
[tables.gps]
file = "a.txt"
header = false
time = 0
[tables.gps.channels]
yaw_deg = 3
[tables.gps.geodetic]
latitude = 1
longitude = 2
""",
    )
    log = drive(import_drives(tmp_path / "a.txt", tmp_path / "log", mapping).folder)
    assert log.geodetic_origin == {"latitude_deg": 45.0, "longitude_deg": 8.0, "projection": "tangent"}
    _, x = log.channel("position_x_m") or (None, np.zeros(0))
    _, y = log.channel("position_y_m") or (None, np.zeros(0))
    assert len(x) == 40, "a receiver's zeros are no fix"
    np.testing.assert_allclose(y[-1], 39e-6 * 111132.1, atol=1e-3)
    np.testing.assert_allclose(x[-1], 78e-6 * 78846.8, atol=1e-3)


def test_cut_at_gaps_and_rests_and_nothing_is_lost(tmp_path: Path) -> None:
    t = 0.1 * np.arange(600)
    t[300:] += 60.0
    speed = np.where((np.arange(600) % 300 > 100) & (np.arange(600) % 300 < 200), 0.0, 1.0)
    rng = np.random.default_rng(2)
    pd.DataFrame({"t": t, "w": speed, "c": rng.normal(size=600)}).to_csv(tmp_path / "a.csv", index=False)
    text = '[log]\nrover = "luvmi_x"\n[tables.drive]\nfile = "a.csv"\ntime = "t"\n[tables.drive.channels]\n'
    text += 'joint_left_drive_speed_rad_s = "w"\nmotor_left_drive_current_A = "c"\n'
    mapping = write_map(tmp_path, text)
    for name, options, count in (
        ("whole", {}, 1),
        ("gaps", {"split_at_gaps_s": 10.0}, 2),
        ("rests", {"split_at_rest_s": 5.0}, 3),
        ("both", {"split_at_gaps_s": 10.0, "split_at_rest_s": 5.0}, 4),
    ):
        found = import_drives(tmp_path / "a.csv", tmp_path / name, mapping, **options)
        assert len(found.logs) == count, name
        logs = [drive(f) for f in found.logs]
        assert sum(len(log.tables["drive"]) for log in logs) == 600
        assert all(log.tables["drive"].time_s[0] == 0.0 for log in logs)


def test_the_current_of_the_bus_comes_in_the_logger_s_units(tmp_path: Path) -> None:
    t = 0.1 * np.arange(20)
    pd.DataFrame({"t": t, "i": 1500.0 + t, "v": 28.5 - t}).to_csv(tmp_path / "a.csv", index=False)
    text = '[log]\nrover = "husky"\n[tables.drive]\nfile = "a.csv"\ntime = "t"\n[tables.drive.channels]\n'
    text += 'bus_current_mA = "i"\nbus_voltage_mV = { column = "v", scale = 1000.0 }\n'
    found = import_drives(tmp_path / "a.csv", tmp_path / "log", write_map(tmp_path, text))
    log = drive(found.folder)
    np.testing.assert_allclose(log.channel("bus_current_A")[1], 1.5 + 1e-3 * t)
    np.testing.assert_allclose(log.channel("bus_voltage_V")[1], 28.5 - t)
    for name, words in (("bus_current", "does not say its unit"), ("bus_current_V", "does not convert to A")):
        with pytest.raises(UserError, match=words):
            read_map(write_map(tmp_path, text.replace("bus_current_mA", name)))


@pytest.mark.parametrize("imposed", [True, False])
def test_other_units_lose_nothing_that_the_map_states(imposed: bool, tmp_path: Path) -> None:
    """Speeds in rpm are imposed and tell rests, and currents in mA are magnitudes, as those in SI units are."""
    t = 0.1 * np.arange(300)
    # 0.05 rpm is rest, and would be none in rad/s
    speed = np.where((t > 10.0) & (t < 20.0), 0.05, 20.0 + np.sin(t))
    pd.DataFrame({"t": t, "w": speed, "c": 900.0 + 50.0 * np.cos(3.0 * t)}).to_csv(tmp_path / "a.csv", index=False)
    text = '[log]\nrover = "husky"\nmagnitudes = { "motor_*_drive_current_A" = 0.6 }\n'
    text += 'imposed = "wheel_speed"\n' if imposed else ""
    text += '[tables.drive]\nfile = "a.csv"\ntime = "t"\n[tables.drive.channels]\n'
    for side in ("left", "right"):
        text += f'joint_{side}_drive_speed_rpm = "w"\nmotor_{side}_drive_current_mA = "c"\n'
    found = import_drives(tmp_path / "a.csv", tmp_path / "log", write_map(tmp_path, text), split_at_rest_s=5.0)
    logs = [drive(f) for f in found.logs]
    assert len(logs) == 2
    for log in logs:
        assert log.imposed == ("wheel_speed" if imposed else None)
        assert log.magnitudes == {"motor_left_drive_current_A": 0.6, "motor_right_drive_current_A": 0.6}


def test_groups_are_drives_that_begin_in_motion(tmp_path: Path) -> None:
    frame = pd.DataFrame({"w": np.repeat([0, 1, 2], 20), "t": np.tile(0.05 * np.arange(20), 3), "y": np.arange(60.0)})
    frame.to_csv(tmp_path / "a.csv", index=False)
    text = '[log]\nrover = "luvmi_x"\n[tables.drive]\nfile = "a.csv"\ntime = "t"\ngroup = "w"\n'
    mapping = write_map(tmp_path, text + '[tables.drive.channels]\nyaw_deg = "y"\n')
    found = import_drives(tmp_path / "a.csv", tmp_path / "log", mapping)
    assert [len(drive(f).tables["drive"]) for f in found.logs] == [20, 20, 20]
    np.testing.assert_allclose(drive(found.logs[1]).tables["drive"].channels["yaw_deg"], np.arange(20.0, 40.0))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('file = "{drive}.txt"', 'topic = "/a"\nfile = "b"', ("tables.drive", "either a topic or a file")),
        ('file = "{drive}.txt"', "", ("either a topic or a file",)),
        ('file = "{drive}.txt"', 'file = "b.txt"', ("a.txt", "matches no table")),
        ("header = false", "header = 3", ("tables.drive.header", "true nor false")),
        ('"blank"', '"comma"', ("a.txt", "is no column")),
        ("column = 0, scale = 0.5, offset = 0.1", "column = 9", ("a.txt", "= '9' is no column", "0, 1")),
        ("missing = [-1000]", "missing = -1000", ("missing", "is not a list")),
        ("clock = true", 'unit = "s"', ("no number", "clock = true")),
        ("time = { column = 3, clock = true }", "", ("tables.drive.time", "is missing")),
        ("time = { column = 3, clock = true }", "time = { rate_hz = 5, column = 3 }", ("states a rate and more",)),
        ("motor_left_drive_current_mA = 2", "motor_left_steer_current_A = 2", ("is no channel", "log channels")),
        ("sum = [{ column = 0, scale = 0.5 }, { column = 1, scale = -1.0 }]", "sum = []", ("sum", "list of columns")),
        ("motor_left_drive_current_mA = 2", "motor_left_drive_current_mA = { column = 3 }", ("neither a number",)),
        ('rover = "luvmi_x"', 'rover = "luvmi_x"\nimposed = "all"', ("imposed", "wheel_speed")),
        ('rover = "luvmi_x"', 'rover = "luvmi_x"\nmagnitudes = ["motor"]', ("magnitudes", "is no channel")),
    ],
)
def test_bad_maps_are_answered_in_one_sentence(
    run: Run, tmp_path: Path, old: str, new: str, words: tuple[str, ...]
) -> None:
    rows = "".join(f"{0.5 * k:.1f} 1.0 {k % 9} 12:00:{k:02d}.5\n" for k in range(40))
    (tmp_path / "a.txt").write_text(rows, encoding="utf-8")
    assert old in MAP
    mapping = write_map(tmp_path, MAP.replace(old, new, 1))
    result = run("log", "import", tmp_path / "a.txt", "-o", tmp_path / "log", "--map", mapping)
    told = " ".join(result.err.split())
    assert result.status == 2 and all(w in told for w in words), told


def test_shipped_maps_are_read_by_name(tmp_path: Path) -> None:
    assert {"husky_borealtc", "husky_drive", "cuadriga_camis", "warthog_drive"} <= set(shipped_maps())
    for name in shipped_maps():
        assert read_map(name).tables
    with pytest.raises(UserError, match=r"neither a map file nor a shipped map; shipped are .*husky_borealtc"):
        read_map("no_such_map")


def test_a_rover_beside_its_map_is_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(shipped("models") / "husky", tmp_path / "mine" / "my_rover")
    (tmp_path / "mine" / "a.txt").write_text("2 1 500 10:00:00.0\n4 1 600 10:00:00.5\n", encoding="utf-8")
    mapping = write_map(tmp_path / "mine", MAP.replace('"luvmi_x"', '"my_rover"'))
    # from the map's folder, and from another one
    for k, place in enumerate((tmp_path / "mine", tmp_path)):
        monkeypatch.chdir(place)
        found = import_drives(tmp_path / "mine" / "a.txt", f"logs/{k}", mapping)
        folder = found.folder.resolve()
        monkeypatch.chdir("/")
        assert Path(drive(folder).rover) == tmp_path / "mine" / "my_rover"


@pytest.mark.parametrize(
    ("channel", "words"),
    [
        (
            "joint_left_drive_speed_m_s",
            "state one over the wheel's radius in m, as in joint_left_drive_speed_rad_s = {",
        ),
        ("accelerometer_x_g", "state the factor between the units, as in accelerometer_x_m_s2 = {"),
        ("battery_current_A", "is no channel; list the names with lunar-mjx log channels"),
    ],
)
def test_a_unit_that_does_not_convert_is_told_with_the_remedy(channel: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=re.escape(words)):
        read_map(write_map(tmp_path, MAP.replace("motor_left_drive_current_mA", channel)))


def test_a_warthog_is_read_in_the_columns_of_drive(tmp_path: Path) -> None:
    t = np.tile(0.05 * np.arange(40), 2)
    names = "cmd_left_rad_s,cmd_right_rad_s,wheel_left_rad_s,wheel_right_rad_s,x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad"
    columns = {name: np.zeros(80) for name in (*names.split(","), "imu_yaw", "ax", "ay")}
    columns |= {"window": np.repeat([0, 1], 40), "t_s": t, "az": np.full(80, 9.8), "wheel_left_rad_s": np.sin(t)}
    pd.DataFrame(columns).to_csv(tmp_path / "asphalt.csv", index=False)
    changes = {"ground": "asphalt", "imu": {"quaternion": [0, 1, 0, 0]}}
    found = import_drives(tmp_path / "asphalt.csv", tmp_path / "logs", "warthog_drive", changes=changes)
    log = drive(found.logs[1])
    assert len(found.logs) == 2 and log.rover == "warthog" and log.ground == "asphalt"
    assert tuple(log.imu.quaternion) == (0.0, 1.0, 0.0, 0.0)
    assert log.channel("joint_left_drive_speed_rad_s") is not None


def test_dates_count_from_the_first(tmp_path: Path) -> None:
    frame = pd.DataFrame({"t": ["2020-11-03T11:41:07.5", "2020-11-03T11:41:09"]})
    np.testing.assert_allclose(np.diff(seconds(frame, TimeColumn("t", clock=True), tmp_path)), 1.5, atol=1e-6)
    with pytest.raises(UserError, match="neither a time of day nor a date"):
        seconds(pd.DataFrame({"t": ["noon", "11:00"]}), TimeColumn("t", clock=True), tmp_path)


def test_channels_are_listed(run: Run) -> None:
    result = run("log", "channels")
    assert result.status == 0 and "motor_{c}_{j}_current_A" in result.out and "left, right" in result.out


def test_the_example_is_imported_and_passes_the_gate(run: Run, tmp_path: Path) -> None:
    assert run("log", "example", tmp_path / "raw").status == 0
    assert sum(f.stat().st_size for f in (tmp_path / "raw").iterdir()) < 300_000
    assert "CC0 1.0" in (tmp_path / "raw" / "LICENSE").read_text(encoding="utf-8")
    assert run("log", "example", tmp_path / "raw").status == 2, "nobody's files are overwritten"
    result = run(
        "log", "import", tmp_path / "raw", "--map", "husky_borealtc", "-o", tmp_path / "log", "--set", "ground=x"
    )
    assert result.status == 0 and "2 drives, 40 s" in result.out
    assert run("log", "check", tmp_path / "log").status == 0
    floor, sand = drive(tmp_path / "log" / "floor"), drive(tmp_path / "log" / "sand")
    assert floor.imposed == "wheel_speed" and floor.ground == "x"
    assert floor.magnitudes == {"motor_left_drive_current_A": 0.6, "motor_right_drive_current_A": 0.6}
    assert set(floor.tables) == {"drive", "imu"} and sand.tables["imu"].rate_hz == pytest.approx(100.0)

    def vertical(log: Log) -> float:
        return float(np.mean(log.tables["imu"].channels["accelerometer_z_m_s2"]))

    assert abs(vertical(floor) - 9.81) < 0.1 and abs(vertical(sand) - 9.81) < 0.3


def test_the_documented_map_is_read(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "measurement_logs.md").read_text(encoding="utf-8")
    text = next(b for b in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if "{drive}_motors.txt" in b)
    rows = "".join(f"14:31:{k:02d}.5 500 {10 + k} -1000 3.0 {k} 36.7157{k:02d} -4.4885\n" for k in range(40))
    (tmp_path / "run07_motors.txt").write_text(rows, encoding="utf-8")
    imu = pd.DataFrame({"t": 5.0 + 0.01 * np.arange(200), "wz": np.sin(np.arange(200.0))})
    imu.to_csv(tmp_path / "run07_imu.csv", index=False)
    found = import_drives(
        tmp_path, tmp_path / "log", write_map(tmp_path, text.replace('rover = "husky"', 'rover = "viper"'))
    )
    log = drive(found.folder)
    assert found.folder == tmp_path / "log" and log.imposed == "wheel_speed"
    motors = log.tables["motors"].channels
    np.testing.assert_allclose(motors["motor_left_drive_current_A"], 0.5)
    np.testing.assert_allclose(motors["joint_left_drive_speed_rad_s"], 0.10472 * (10 + np.arange(40)))
    np.testing.assert_allclose(motors["command_left_drive_speed_rad_s"], 3.0 - 0.3 * np.arange(40))
    assert "joint_right_drive_speed_rad_s" not in motors and any("no number" in note for _, note in found.notes)
    assert np.ptp((log.channel("position_y_m") or (None, np.zeros(1)))[1]) == pytest.approx(39e-6 * 110973.0, rel=0.01)
    assert log.tables["imu"].clock_offset_std_s == 0.05 and log.tables["imu"].time_s[0] == 0.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "is empty"),
        (b"t,c\n", "holds no drive"),
        (b"\x00\xff\xfe\x81", "is not a text table"),
        (b"t,c\n0,1\n1,2\n2,3,4\n3,4\n", "is not a table of even rows"),
        (b"# logger 2.3\nt,c\n0,1\n1,2\n", "comment = "),
        (b"t,c\n0,1\n", "short: has 1 rows"),
        (b"t,c\n0,1\n0,2\n0,3\n", "clock: repeats"),
        (b"t,c\n3,1\n2,2\n1,3\n", "clock: goes back"),
        (b"t,c\n,1\n0.1,2\n0.2,\n0.3,4\n", "clock: is empty"),
        (b"\xef\xbb\xbft,c\r\n0,1\r\n0.1,inf\r\n0.2,3\r\n", ""),
    ],
)
def test_spoilt_files_are_told_by_a_sentence_or_by_the_gate(text: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(text)
    head = '[log]\nrover = "luvmi_x"\n[tables.d]\nfile = "a.csv"\ntime = "t"\n'
    mapping = write_map(tmp_path, head + '[tables.d.channels]\nmotor_left_drive_current_A = "c"\n')
    try:
        found = check(drive(import_drives(tmp_path / "a.csv", tmp_path / "log", mapping).folder))
        told = "; ".join(f"{f.kind}: {f.message}" for f in found)
    except UserError as error:
        told = str(error)
    assert words in told if words else told == "", told
