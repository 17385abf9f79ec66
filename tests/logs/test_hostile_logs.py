"""Logs and maps that no instrument wrote: half rows, wheels of no test bed, noise and numbers beyond all ranges."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, SteadyLog, check, import_drives, read_log
from lunar_mjx.logs.findings import is_bad
from lunar_mjx.logs.readers.bags import stamp
from tests.cli_harness import Run
from tests.logs.log_files import make_log

STEADY = """format = "lunar-mjx-log/1"
kind = "steady_state"
file = "points.csv"
slip_definition = "wheel_frame"
[wheel]
radius_m = 0.1
width_m = 0.1
grouser_count = 4
grouser_height_m = 0.01
[noise.drawbar_pull_N]
std = 1.0
"""
POINTS = "slip_ratio,slip_angle_deg,normal_load_N,drawbar_pull_N\n" + "".join(
    f"{0.05 * i:.2f},0,60,{2.3 * i - 5 + 0.7 * (i % 3):.2f}\n" for i in range(12)
)
MAP = """[log]
rover = "luvmi_x"
gravity_m_s2 = 9.81
[tables.drive]
file = "a.csv"
time = "time"
[tables.drive.channels]
joint_lf_drive_speed_rad_s = "speed"
"""


def steady(folder: Path, toml: str = STEADY, points: str = POINTS) -> SteadyLog:
    folder.mkdir(exist_ok=True)
    (folder / "log.toml").write_text(toml)
    (folder / "points.csv").write_text(points)
    log = read_log(folder)
    assert isinstance(log, SteadyLog)
    return log


def recorded(folder: Path, rows: str, mapping: str = MAP, header: str = "time,speed\n") -> tuple[Log, list[str]]:
    (folder / "a.csv").write_text(header + rows)
    (folder / "map.toml").write_text(mapping)
    found = import_drives(folder / "a.csv", folder / "log", folder / "map.toml")
    log = read_log(found.folder)
    assert isinstance(log, Log)
    return log, [note for _, note in found.notes]


@pytest.mark.parametrize("cut", [1, 3, 7])
def test_a_last_row_that_is_half_written_is_left_out_and_named(cut: int, tmp_path: Path) -> None:
    log = steady(tmp_path / "bed", points=POINTS[:-cut])
    assert len(log.rows) == 11
    named = [f for f in check(log) if f.kind == "short"]
    assert [f.line for f in named] == [13] and not is_bad(named) and "half written" in named[0].message

    whole = make_log(tmp_path / "a")
    path = whole.tables["drive"].file
    path.write_text(path.read_text()[:-cut])
    found = read_log(tmp_path / "a")
    assert isinstance(found, Log)
    assert len(found.tables["drive"].time_s) == len(whole.tables["drive"].time_s) - 1
    assert [f.kind for f in check(found)] == ["short"]

    mine, notes = recorded(tmp_path, "".join(f"{0.1 * i:.1f},{i}.25\n" for i in range(20))[:-cut])
    assert len(mine.tables["drive"].time_s) == 19 and any("row 19: is not ended" in note for note in notes)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("radius_m = 0.1", "radius_m = 1e6", "wheel.radius_m = 1000000.0 is above 5"),
        ("width_m = 0.1", "width_m = 100", "wheel.width_m = 100.0 is above 5"),
        ("grouser_count = 4", "grouser_count = 1.5", "wheel.grouser_count = 1.5 is no whole number"),
        ("grouser_count = 4", "grouser_count = -3", "wheel.grouser_count = -3.0 is out of range"),
        ("grouser_count = 4", f"grouser_count = {10**20}", "wheel.grouser_count = 1e\\+20 is out of range"),
        ("grouser_height_m = 0.01", "grouser_height_m = 5.0", "grouser_height_m = 5.0 is out of range; give .* 0.1 at"),
        ("[wheel]", "gravity_m_s2 = 981\n[wheel]", "gravity_m_s2 = 981.0 is above 100"),
        ("noise.drawbar_pull_N", "noise.drawbar_pul_N", "noise.drawbar_pul_N = .* is the noise of no channel"),
        ("std = 1.0", "std = 1e300", r"drawbar_pull_N.std = 1e\+300 is more than the channel's whole range"),
        ('"points.csv"', '"a\\nb.csv"', "file = 'a.*b.csv' is no name of a file"),
        ('"points.csv"', f'"{"a" * 300}.csv"', "file = 'aaa.* is no name of a file"),
    ],
)
def test_wheels_and_gravity_of_no_test_bed_are_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    assert old in STEADY
    with pytest.raises(UserError, match=said):
        steady(tmp_path / "bed", STEADY.replace(old, new))


@pytest.mark.parametrize(("key", "std"), [("drawbar_pull_N", 2.0), ("drawbar_pull_kN", 0.002), ('"*_pull_N"', 2.0)])
def test_noise_of_a_wheel_table_is_read_by_column_unit_and_pattern(key: str, std: float, tmp_path: Path) -> None:
    log = steady(
        tmp_path / "bed", STEADY.replace("noise.drawbar_pull_N", f"noise.{key}").replace("std = 1.0", f"std = {std}")
    )
    assert log.table.sigma == {"drawbar_pull": pytest.approx(2.0)}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rate_hz = 20.0", f"rate_hz = {'9' * 400}", "rate_hz = 9+... is too large"),
        ("gravity_m_s2 = 1.625", "gravity_m_s2 = 1e9", "gravity_m_s2 = 1000000000.0 is above 100"),
        ("std = 0.1", "std = 0.0", "std = 0.0 is less than any instrument's noise"),
        ("std = 0.1", "std = 1e-300", "std = 1e-300 is less than any instrument's noise"),
        ("std = 0.1", "std = 1e9", r"noise.*std = 1000000000.0 is more than the channel's whole range"),
        ("[noise", "[initial]\nposition_m = [0.0, 0.0, 1e30]\n[noise", "initial.position_m = .* is outside"),
        ("[noise", "[initial]\nyaw_deg = 1e9\n[noise", "initial.yaw_deg = .* is outside"),
        ("[noise", "[initial]\nquaternion = [0, 0, 0, 0]\n[noise", "initial.quaternion = .* has the norm 0"),
        ("rate_hz = 20.0", "rate_hz = 20.0\nclock_offset_s = 1e300", r"clock_offset_s = 1e\+300 is out of range"),
        ("std = 0.1", "std = 0.1\ncorrelation_time_s = 1e300", r"correlation_time_s = 1e\+300 is out of range"),
        ("std = 0.1", "std = 0.1\ncorrelation_time_s = 1.0\ncorrelated_share = 1.5", "share = 1.5 is out of range"),
        ("std = 0.1", "std = 0.1\ncorrelation_time_s = 1.0\ncorrelated_share = 0.0", "share = 0.0 is out of range"),
        ("std = 0.1", "std = 0.1\ncorrelated_share = 0.5", "share = 0.5 is of a part .* add correlation_time_s"),
        ("gravity", "terrain_origin_m = [1e300, 0]\ngravity", r"terrain_origin_m = 1e\+300 is out of range"),
        ("[noise", "[noise.wind]\nstd = 1.0\n[noise", "noise.wind = .* is the noise of no channel"),
        (
            "gravity",
            f"magnitudes = {{ motor_lf_drive_current_A = {'9' * 400} }}\ngravity",
            "magnitudes.motor_lf_drive_current_A = 9+... is too large",
        ),
        (
            "gravity",
            'magnitudes = { "motor_*_current_A" = 1e300 }\ngravity',
            r"magnitudes.motor_\*_current_A = 1e\+300 is out of range; give 0 or more, 200 at most",
        ),
        (
            "gravity",
            "imu = { position_m = [1e300, 0, 0] }\ngravity",
            "imu.position_m = .* is above 100; check its unit",
        ),
        ("gravity", "imu = { mounting_std_deg = [0, 200, 0] }\ngravity", "imu.mounting_std_deg = .* is above 180"),
        ('"luvmi_x"', '"luvmi\\nx"', "rover = 'luvmi.*x' is no name of a file"),
        ('"luvmi_x"', f'"{"a" * 5000}"', "rover = 'aaa.* is no name of a file"),
        ("gravity", 'terrain = "a\\u0000b"\ngravity', "terrain = 'a.*b' is no name of a file"),
        ('"drive.csv"', '"a\\u0000b"', "tables.drive.file = 'a.*b' is no name of a file"),
    ],
)
def test_what_no_rover_meets_is_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    path = tmp_path / "a" / "log.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(UserError, match=said):
        read_log(tmp_path / "a")


def test_a_recorded_number_without_end_is_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"speed, row 1 = .* is neither a number nor a gap"):
        recorded(tmp_path, f"0,1\n0.1,{'9' * 400}\n0.2,2\n")
    for k, cell in enumerate(("1e400", "inf")):
        folder = tmp_path / str(k)
        folder.mkdir()
        log, notes = recorded(folder, f"0,1\n0.1,{cell}\n0.2,2\n")
        assert "a.csv: speed reads inf in 1 rows, which are gaps" in notes
        np.testing.assert_array_equal(log.tables["drive"].channels["joint_lf_drive_speed_rad_s"], [1.0, np.nan, 2.0])


def test_a_clock_of_thousands_of_years_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="time, row 0 = 1e\\+300 is thousands of years"):
        recorded(tmp_path, "1e300,1\n2e300,2\n3e300,3\n")


def test_a_scale_that_leaves_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"scale = 0.0 makes every value zero"):
        recorded(tmp_path, "0,1\n0.1,2\n", MAP.replace('"speed"', '{ column = "speed", scale = 0.0 }'))


def test_columns_of_one_name_are_refused_where_one_is_read(tmp_path: Path) -> None:
    rows = "".join(f"{0.1 * i:.1f},{i % 5}.5,{i % 3}.25\n" for i in range(20))
    for name in ("speed", "speed.1"):
        with pytest.raises(UserError, match=rf"a\.csv: column = '{name}' occurs twice"):
            recorded(tmp_path, rows, MAP.replace('"speed"', f'"{name}"'), "time,speed,speed\n")
    log, _ = recorded(tmp_path, rows, MAP.replace('"speed"', '"speed.1"'), "time,speed,speed.1\n")
    assert log.tables["drive"].channels["joint_lf_drive_speed_rad_s"][1] == 1.25


def test_a_long_name_does_not_flood_the_screen(run, tmp_path: Path) -> None:
    log = make_log(tmp_path / "a")
    path = log.tables["drive"].file
    path.write_text(path.read_text().replace("gyro_x_rad_s", "g" * 40_000, 1))
    found = run("log", "check", tmp_path / "a")
    assert found.status == 0 and len(found.out) < 3000 and "g" * 70 in found.out
    assert np.isfinite(log.tables["drive"].time_s).all()


ROWS = "".join(f"{0.1 * i:.1f},{(7 * i) % 5 + 0.25}\n" for i in range(20))
SPEED, TIME = '= "speed"', 'time = "time"'
HOSTILE_MAPS = {
    "rate of ages": (TIME, "time = { rate_hz = 1e-300 }", r"a\.csv: rate_hz = 1e-300 makes it thousands of years"),
    "rate of no clock": (TIME, "time = { rate_hz = 1e300 }", r"rate_hz = 1e\+300 is above 1e\+09"),
    "rows without end": (TIME, f"{TIME}\nskip_rows = 1000000000", r"skip_rows = 1000000000.0 is no number of rows"),
    "sum and column": (
        SPEED,
        '= { column = "time", sum = [{ column = "speed" }] }',
        r"column = 'time' is one too many",
    ),
    "sum and scale": (SPEED, '= { scale = 3.0, sum = [{ column = "speed" }] }', r"scale = 3.0 is one too many"),
    "field and column": (SPEED, '= { field = "time", column = "speed" }', r"column = 'speed' is one too many"),
    "offset known to less than nothing": (
        TIME,
        f"{TIME}\nclock_offset_std_s = -1.0",
        r"clock_offset_std_s = -1.0 is out",
    ),
    "source": ("[tables.drive]", "source = 5\n[tables.drive]", r"log.source = 5 is not a table"),
    "magnitudes": ("[tables.drive]", "magnitudes = [5]\n[tables.drive]", r"magnitudes = \[5\] is no list of channels"),
    "magnitude": ("[tables.drive]", "magnitudes = 5\n[tables.drive]", r"magnitudes = 5 is no list of channels"),
    "table beside the folder": ("tables.drive", 'tables."../up"', r"name of a table = '../up' is no name of a file"),
    "Sun behind itself": (
        "[tables.drive]",
        "environment = { sun_elevation_deg = 900 }\n[tables.drive]",
        r"sun_elevation_deg = 900.0 is out of range",
    ),
    "origin of no Earth": (
        "[tables.drive]",
        "geodetic_origin = { latitude_deg = 1000, longitude_deg = 0 }\n[tables.drive]",
        r"latitude_deg = 1000.0 is out of range",
    ),
}


@pytest.mark.parametrize("name", HOSTILE_MAPS)
def test_a_map_that_means_nothing_is_refused_and_leaves_nothing(name: str, tmp_path: Path) -> None:
    old, new, said = HOSTILE_MAPS[name]
    assert old in MAP
    with pytest.raises(UserError, match=said):
        recorded(tmp_path, ROWS, MAP.replace(old, new))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "map.toml"]


SETTINGS = {
    "tables=1": "tables = 1 is an unknown key",
    "commitment=abc": "commitment = 'abc' is an unknown key",
    "rover=5": "rover = 5 is not a text",
    "noise.joint_lf_drive_speed_rad_s=3": "noise.joint_lf_drive_speed_rad_s = 3 is not a table",
    "noise.joint_lf_drive_speed_rad_s.std=-1": "has a negative entry",
    "source=5": "source = 5 is not a table",
    "magnitudes=5": "magnitudes = 5 is no list of channels",
    "magnitudes=[5]": "magnitudes = [5] is no list of channels",
    f"gravity_m_s2={'9' * 5000}": "is no value of TOML",
    f"ground={'[' * 5000}": "is no value of TOML",
    "a..b=1": "is not key=value",
    "ground=snow ground=ice": "--set = 'ground=ice' is given a value twice",
    "imu=1 imu.attitude=true": "--set = 'imu.attitude=true' is given a value twice",
}


@pytest.mark.parametrize("pairs", SETTINGS)
def test_a_setting_that_means_nothing_is_refused_and_leaves_nothing(pairs: str, run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,speed\n" + ROWS)
    (tmp_path / "map.toml").write_text(MAP)
    given = [part for pair in pairs.split(" ") for part in ("--set", pair)]
    found = run("log", "import", tmp_path / "a.csv", "--map", tmp_path / "map.toml", "-o", tmp_path / "log", *given)
    assert found.status == 2 and SETTINGS[pairs] in found.err and found.err.count("\n") == 1, found.err
    assert not (tmp_path / "log").exists()


def test_a_noise_can_be_set_over_the_maps(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,speed\n" + ROWS)
    (tmp_path / "map.toml").write_text(MAP)
    noise = "noise.joint_lf_drive_speed_rad_s.std=0.25"
    line = ("log", "import", tmp_path / "a.csv", "--map", tmp_path / "map.toml", "-o", tmp_path / "log", "--set", noise)
    assert run(*line).status == 0
    log = read_log(tmp_path / "log")
    assert log.noise["joint_lf_drive_speed_rad_s"].std == 0.25


CLOCK = MAP.replace(TIME, 'time = { column = "time", clock = true }')


def test_a_time_of_day_that_no_clock_shows_is_refused(tmp_path: Path) -> None:
    for cell in ("99:99:01", "24:00:00", "12:60:00", "12:00:61"):
        with pytest.raises(UserError, match=f"time, row 1 = '{cell}' is neither a time of day nor a date"):
            recorded(tmp_path, f"12:00:00,1\n{cell},2\n12:00:02,3\n", CLOCK)


@pytest.mark.parametrize("empty", ["", "nan", "NaT"])
@pytest.mark.parametrize("day", ["", "2020-11-03T"])
def test_a_clock_without_a_reading_is_a_gap_in_time(day: str, empty: str, tmp_path: Path) -> None:
    rows = [f"{day}12:00:0{i},{i}.5\n" for i in range(8)]
    rows[3] = f"{empty},3.5\n"
    log, _ = recorded(tmp_path, "".join(rows), CLOCK)
    expected = np.arange(8.0)
    expected[3] = np.nan
    np.testing.assert_array_equal(log.tables["drive"].time_s, expected)


PLACES = (
    MAP.split("[tables.drive.channels]")[0]
    + """[tables.drive.geodetic]
latitude = "lat"
longitude = "speed"
"""
)


@pytest.mark.parametrize(
    ("latitude", "longitude", "said"), [(4807.038, 11.5, "latitude_deg"), (48.1, 1131.0, "longitude_deg")]
)
def test_degrees_and_minutes_in_one_number_are_refused(
    latitude: float, longitude: float, said: str, tmp_path: Path
) -> None:
    rows = "".join(f"{0.1 * i:.1f},{longitude},{latitude + 1e-5 * i:.5f}\n" for i in range(20))
    with pytest.raises(
        UserError, match=rf"a\.csv: {said}, row 0 = .* is outside .*; record degrees, not degrees and minutes"
    ):
        recorded(tmp_path, rows, PLACES, "time,speed,lat\n")


def _matlab(compress: bool) -> bytes:
    held = io.BytesIO()
    time = 0.1 * np.arange(40)
    savemat(held, {"time": time, "speed": np.sin(9 * time), "s": {"q": time}}, do_compression=compress)
    return held.getvalue()


def _messages(payload: bytes = b"") -> bytes:
    writer = pytest.importorskip("mcap.writer", reason="the extra lunar-mjx[ros] is not installed")
    held = io.BytesIO()
    out = writer.Writer(held)
    out.start()
    channel = out.register_channel("/drive", "json", out.register_schema("drive", "jsonschema", b"{}"))
    for i in range(40):
        data = payload or json.dumps({"speed": i % 7 + 0.5}).encode()
        out.add_message(channel, 10**8 * i, data, 10**8 * i)
    out.finish()
    return held.getvalue()


TOPIC = MAP.replace('file = "a.csv"\ntime = "time"', 'topic = "/drive"')
RECORDINGS: dict[str, tuple[Callable[[], bytes], str]] = {
    "a.mat": (lambda: _matlab(False), MAP.replace("a.csv", "a.mat")),
    "b.mat": (lambda: _matlab(True), MAP.replace("a.csv", "b.mat")),
    "a.mcap": (_messages, TOPIC),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_damaged_recordings_are_refused_or_become_a_log(name: str, tmp_path: Path) -> None:
    make, mapping = RECORDINGS[name]
    (tmp_path / "map.toml").write_text(mapping)
    whole, path, rng, refused = make(), tmp_path / name, random.Random(name), 0
    for number in range(24):
        at = rng.randrange(len(whole))
        path.write_bytes(whole[:at] if number % 4 == 0 else whole[:at] + rng.randbytes(4) + whole[at + 4 :])
        try:
            import_drives(path, tmp_path / f"log{number}", tmp_path / "map.toml")
        except UserError as error:
            refused += 1
            assert name in str(error) and len(str(error)) < 1500 and "\n" not in str(error), number
    assert refused > 5


@pytest.mark.parametrize(
    "data",
    [
        b"[" * 5000,
        b'{"speed": ' + b"9" * 5000 + b"}",
        b"\xff\xfe",
        b"[1]",
        b'{"speed": [1]}',
        b'{"speed": %s}' % (b"9" * 400),
        b'{"speed": "1_0"}',
    ],
)
def test_messages_that_are_none_are_refused(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(_messages(data))
    (tmp_path / "map.toml").write_text(TOPIC)
    with pytest.raises(UserError, match=r"a\.mcap|map\.toml"):
        import_drives(tmp_path / "a.mcap", tmp_path / "log", tmp_path / "map.toml")


@pytest.mark.parametrize("value", [10**400, 1e300, -1e12, {"sec": 10**400, "nanosec": 0}, {"sec": 0, "nsec": 10**400}])
def test_a_stamp_of_no_clock_is_none(value: object) -> None:
    with pytest.raises(KeyError, match="thousands of years"):
        stamp(value)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.bag", b"#ROSBAG V2.0\n" + bytes(200)),
        ("a.bag", b""),
        ("a.db3", b"SQLite format 3\0" + bytes(500)),
        ("a.db3", b""),
        ("bag/metadata.yaml", b"- ["),
        ("bag/metadata.yaml", b"rosbag2_bagfile_information: 5"),
    ],
)
def test_damaged_bags_are_refused(name: str, data: bytes, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="the extra lunar-mjx[ros] is not installed")
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    (tmp_path / "map.toml").write_text(TOPIC)
    given = path.parent if path.parent != tmp_path else path
    with pytest.raises(UserError, match="is not a readable bag"):
        import_drives(given, tmp_path / "log", tmp_path / "map.toml")
