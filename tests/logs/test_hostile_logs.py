"""Logs and maps that no instrument wrote: half rows, wheels of no test bed, noise and numbers beyond all ranges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, SteadyLog, check, import_drives, read_log
from lunar_mjx.logs.findings import is_bad
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


def recorded(folder: Path, rows: str, mapping: str = MAP) -> tuple[Log, list[str]]:
    (folder / "a.csv").write_text("time,speed\n" + rows)
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
    ],
)
def test_wheels_and_gravity_of_no_test_bed_are_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    assert old in STEADY
    with pytest.raises(UserError, match=said):
        steady(tmp_path / "bed", STEADY.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rate_hz = 20.0", f"rate_hz = {'9' * 400}", "rate_hz = 9+... is too large"),
        ("gravity_m_s2 = 1.625", "gravity_m_s2 = 1e9", "gravity_m_s2 = 1000000000.0 is above 100"),
        ("std = 0.1", "std = 1e9", r"noise.*std = 1000000000.0 is more than the channel's whole range"),
        ("[noise", "[initial]\nposition_m = [0.0, 0.0, 1e30]\n[noise", "initial.position_m = .* is outside"),
        ("[noise", "[initial]\nyaw_deg = 1e9\n[noise", "initial.yaw_deg = .* is outside"),
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


def test_a_long_name_does_not_flood_the_screen(run, tmp_path: Path) -> None:
    log = make_log(tmp_path / "a")
    path = log.tables["drive"].file
    path.write_text(path.read_text().replace("gyro_x_rad_s", "g" * 40_000, 1))
    found = run("log", "check", tmp_path / "a")
    assert found.status == 0 and len(found.out) < 3000 and "g" * 70 in found.out
    assert np.isfinite(log.tables["drive"].time_s).all()
