"""The gate on what honest recordings of real rovers look like: none is refused, and what is wrong in them is found."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.logs import Log, Noise, check, read_log, write_log
from lunar_mjx.logs.findings import is_bad

TRACK, RADIUS = 1.3, 0.165


def skid_steer(seed: int = 0, seconds: float = 120.0) -> dict[str, pd.DataFrame]:
    """A skid steer on winding ways with stops: speeds of both sides, currents, yaw, GPS at 5 Hz that holds at rest."""
    rng = np.random.default_rng(seed)
    t = np.round(0.1 * np.arange(int(10 * seconds)) + 0.01 * rng.integers(-1, 2, int(10 * seconds)), 2)
    go = ((t > 10.0) & (t < 0.6 * seconds)) | ((t > 0.7 * seconds) & (t < seconds - 10.0))
    bend = np.repeat(rng.choice([-0.6, -0.3, 0.0, 0.0, 0.3, 0.6], len(t) // 50 + 1), 50)[: len(t)]
    left, right = go * (3.0 - bend), go * (3.0 + bend)
    rate = RADIUS * (right - left) / TRACK
    yaw = np.cumsum(rate) * 0.1
    speed = 0.5 * RADIUS * (left + right)
    x, y = np.cumsum(speed * np.cos(yaw)) * 0.1, np.cumsum(speed * np.sin(yaw)) * 0.1
    noisy = {"left": left + go * 0.05 * rng.normal(size=len(t)), "right": right + go * 0.05 * rng.normal(size=len(t))}
    drive = {"time_s": t}
    for side, w in noisy.items():
        drive[f"joint_{side}_drive_speed_rad_s"] = np.round(w, 2)
        drive[f"motor_{side}_drive_current_A"] = 4.0 * (w > 0.5) + rng.normal(size=len(t)) * (0.3 + 2.5 * (w > 0.5))
    drive["yaw_deg"] = np.round(np.degrees(yaw) + 0.1 * rng.normal(size=len(t)), 1)
    own = np.flatnonzero((np.arange(len(t)) % 2 == 0) & (rng.random(len(t)) > 0.1))
    still = np.concatenate([[False], speed[own][1:] == 0.0])
    fix = np.stack([x[own], y[own]]) + 0.02 * rng.normal(size=(2, len(own)))
    for k in np.flatnonzero(still):
        fix[:, k] = fix[:, k - 1]
    gps = {"time_s": t[own], "position_x_m": np.round(fix[0], 2), "position_y_m": np.round(fix[1], 2)}
    velocity = {"time_s": t[own], "body_velocity_x_m_s": np.abs(speed[own] + 0.02 * rng.normal(size=len(own)))}
    return {"drive": pd.DataFrame(drive), "gps": pd.DataFrame(gps), "gps_speed": pd.DataFrame(velocity)}


def make(folder: Path, change: Callable[[dict[str, pd.DataFrame]], object] | None = None, seed: int = 0) -> Log:
    tables = skid_steer(seed)
    if change is not None:
        change(tables)
    noise = {f"position_{a}_m": Noise(0.5, "datasheet", 10.0) for a in "xy"}
    write_log(
        folder, tables, rover="luvmi_x", gravity_m_s2=9.81, imposed="wheel_speed", noise=noise, on_change=("gps",)
    )
    log = read_log(folder)
    assert isinstance(log, Log)
    return log


@pytest.mark.parametrize("seed", range(6))
def test_honest_recordings_pass(seed: int, tmp_path: Path) -> None:
    assert check(make(tmp_path / "a", seed=seed)) == []


def _swap(table: str, one: str, other: str) -> Callable[[dict[str, pd.DataFrame]], None]:
    def change(tables: dict[str, pd.DataFrame]) -> None:
        t = tables[table]
        t[one], t[other] = t[other].copy(), t[one].copy()

    return change


def _scale(table: str, column: str, factor: float) -> Callable[[dict[str, pd.DataFrame]], None]:
    def change(tables: dict[str, pd.DataFrame]) -> None:
        tables[table][column] = factor * tables[table][column]

    return change


def _freeze(tables: dict[str, pd.DataFrame]) -> None:
    gps = tables["gps"]
    driving = slice(100, 250)
    for column in ("position_x_m", "position_y_m"):
        gps.iloc[driving, gps.columns.get_loc(column)] = gps[column].iloc[100]


@pytest.mark.parametrize(
    ("change", "kind", "column", "bad"),
    [
        (
            _swap("drive", "joint_left_drive_speed_rad_s", "joint_right_drive_speed_rad_s"),
            "swap",
            "joint_left_drive_speed_rad_s",
            True,
        ),
        (_scale("gps_speed", "body_velocity_x_m_s", 1.944), "unit", "body_velocity_x_m_s", True),
        (_scale("drive", "yaw_deg", -1.0), "swap", "joint_left_drive_speed_rad_s", True),
        (_scale("drive", "motor_right_drive_current_A", -1.0), "frame", "motor_right_drive_current_A", False),
        (_freeze, "stuck", "position_x_m", True),
    ],
)
def test_what_is_wrong_is_found(
    change: Callable[[dict[str, pd.DataFrame]], object], kind: str, column: str, bad: bool, tmp_path: Path
) -> None:
    for seed in range(3):
        found = check(make(tmp_path / str(seed), change, seed))
        matching = [f for f in found if f.kind == kind and f.column == column]
        assert matching and is_bad(matching) == bad, [(f.where, f.kind, f.message) for f in found]


def test_a_single_fault_of_a_receiver_becomes_a_gap(tmp_path: Path) -> None:
    def spike(tables: dict[str, pd.DataFrame]) -> None:
        many = pd.concat([tables["gps_speed"]] * 3, ignore_index=True)
        many["time_s"] = 0.2 * np.arange(len(many))
        tables["gps_speed"] = many
        many.loc[77, "body_velocity_x_m_s"] = 20.0

    log = make(tmp_path / "a", spike)
    assert np.isnan(log.tables["gps_speed"].channels["body_velocity_x_m_s"][77])
    told = [f for f in check(log) if f.kind == "range"]
    assert len(told) == 1 and not is_bad(told) and told[0].row == 77


def test_one_command_tells_no_sign(tmp_path: Path) -> None:
    """A controller that trades the sides' speeds for a turn may drive a wheel against its command."""
    t = 0.05 * np.arange(40)
    rng = np.random.default_rng(0)
    for name, command, bad in (("one", np.full(40, 2.0), False), ("many", 2.0 * np.sin(3.0 * t), True)):
        frame = pd.DataFrame({"time_s": t, "command_left_drive_speed_rad_s": command})
        frame["joint_left_drive_speed_rad_s"] = -0.8 * command + 0.01 * rng.normal(size=40)
        write_log(tmp_path / name, {"drive": frame}, rover="luvmi_x")
        assert is_bad(check(read_log(tmp_path / name))) == bad


@pytest.mark.parametrize(("every", "lost", "bad"), [(5, 0.0, False), (5, 0.1, False), (5, 0.6, True), (1, 0.6, True)])
def test_a_slower_sensor_in_a_faster_table(every: int, lost: float, bad: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def change(tables: dict[str, pd.DataFrame]) -> None:
        t = tables["drive"]
        filled = np.arange(len(t)) % every == 0
        filled[rng.permutation(np.flatnonzero(filled))[: int(lost * filled.sum())]] = False
        t["yaw_deg"] = t["yaw_deg"].where(filled)

    assert is_bad(check(make(tmp_path / "a", change))) == bad


def test_the_advice_on_a_sparse_channel_passes_next(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)

    def sparse(tables: dict[str, pd.DataFrame]) -> None:
        t = tables["drive"]
        t["yaw_deg"] = t["yaw_deg"].where(rng.random(len(t)) < 0.1)

    found = check(make(tmp_path / "a", sparse))
    assert [f.column for f in found] == ["yaw_deg"] and "table of its own with on_change = true" in found[0].message
    tables = skid_steer(0)
    yaw = tables["drive"][["time_s", "yaw_deg"]][rng.random(len(tables["drive"])) < 0.1]
    tables["drive"] = tables["drive"].drop(columns="yaw_deg")
    write_log(tmp_path / "b", {**tables, "compass": yaw}, rover="luvmi_x", gravity_m_s2=9.81, on_change=("compass",))
    assert check(read_log(tmp_path / "b")) == []


def turning(folder: Path, rates: tuple[float, float], wrong: float = 1.0, sideways: float = 0.0) -> Log:
    """6 s of wheels at constant rates, rad/s; yaw that changes `wrong` times as fast; a rover that slips sideways."""
    t = 0.05 * np.arange(120)
    rng = np.random.default_rng(1)
    rate = 0.4 * RADIUS * (rates[1] - rates[0]) / TRACK * np.ones(len(t))
    yaw = np.cumsum(rate) * 0.05
    ahead = 0.5 * RADIUS * (rates[0] + rates[1])
    x = np.cumsum(ahead * np.cos(yaw) - sideways * np.sin(yaw)) * 0.05
    y = np.cumsum(ahead * np.sin(yaw) + sideways * np.cos(yaw)) * 0.05
    columns = {
        "time_s": t,
        "joint_left_drive_speed_rad_s": rates[0] + 0.02 * rng.normal(size=len(t)),
        "joint_right_drive_speed_rad_s": rates[1] + 0.02 * rng.normal(size=len(t)),
        "position_x_m": x + 1e-3 * rng.normal(size=len(t)),
        "position_y_m": y + 1e-3 * rng.normal(size=len(t)),
        "yaw_deg": np.degrees(yaw) * wrong,
        "gyro_z_rad_s": rate + 1e-3 * rng.normal(size=len(t)),
    }
    source = {"files": "all.csv"}
    write_log(folder, {"drive": pd.DataFrame(columns)}, rover="husky", imposed="wheel_speed", source=source)
    log = read_log(folder)
    assert isinstance(log, Log)
    return log


def test_a_rover_that_turns_about_itself_may_slip_sideways(tmp_path: Path) -> None:
    assert not is_bad(check(turning(tmp_path / "pivot", (-3.0, 2.0), sideways=0.1)))
    # driving ahead, the same says that the axes are not the schema's
    assert is_bad(check(turning(tmp_path / "ahead", (2.0, 2.2), sideways=1.0)))


@pytest.mark.parametrize(("many", "bad"), [(2, False), (12, True)])
def test_what_few_pieces_of_a_recording_show_is_no_mistake_of_its_map(many: int, bad: bool, tmp_path: Path) -> None:
    pieces = [turning(tmp_path / f"p{k:02d}", (-2.0, 2.0), 1.6 if k < many else 1.0) for k in range(30)]
    found = check(pieces)
    assert len(found) == many and is_bad(found) == bad
    assert bad or all("2 of the 30 pieces of its recording that could show it do" in f.message for f in found)
    assert is_bad(check(pieces[:1])), "alone it is the recording"


def test_pieces_that_could_not_tell_are_no_witnesses(tmp_path: Path) -> None:
    """Three pieces turn, and their yaw is wrong; the others drive straight ahead, and say nothing of it."""
    pieces = [turning(tmp_path / "a" / f"p{k:02d}", (-2.0, 2.0), 1.6) for k in range(3)]
    pieces += [turning(tmp_path / "a" / f"p{k:02d}", (2.0, 2.0)) for k in range(3, 35)]
    assert is_bad(check(pieces))
    # and pieces of another campaign with the same names are another recording
    others = [turning(tmp_path / "b" / f"p{k:02d}", (-2.0, 2.0)) for k in range(35)]
    assert is_bad(check(pieces[:3] + others))


def test_gravity_is_asked_where_attitude_begins_later(tmp_path: Path) -> None:
    t = 0.05 * np.arange(60)
    force = {f"accelerometer_{a}_m_s2": np.full(60, v) for a, v in zip("xyz", (0.1, 0.2, -9.8), strict=True)}
    angles = {f"{a}_deg": 0.1 * np.sin(t[2:]) for a in ("roll", "pitch", "yaw")}
    force |= {f"joint_{side}_drive_speed_rad_s": np.full(60, 2.0) for side in ("left", "right")}
    tables = {"imu": pd.DataFrame({"time_s": t} | force), "pose": pd.DataFrame({"time_s": t[2:]} | angles)}
    write_log(tmp_path / "a", tables, rover="husky", gravity_m_s2=9.81, imposed="wheel_speed")
    log = read_log(tmp_path / "a")
    assert any(f.kind == "gravity" and "upside down" in f.message for f in check(log))


def test_one_current_under_two_names_is_found(tmp_path: Path) -> None:
    """A total that is written for both sides, or a side's for each of its wheels, would count twice."""

    def total(tables: dict[str, pd.DataFrame]) -> None:
        left, right = (f"motor_{side}_drive_current_A" for side in ("left", "right"))
        tables["drive"][left] = tables["drive"][right] = 0.5 * (tables["drive"][left] + tables["drive"][right])

    found = check(make(tmp_path / "a", total))
    assert [f.kind for f in found] == ["copy"] and is_bad(found)
    assert "equals motor_left_drive_current_A in all 1200 rows" in found[0].message
