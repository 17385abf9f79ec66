"""Noise of channels from drives: size, colour and certainty come back from series whose noise is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.logs import Log, Noise, read_log, write_log
from lunar_mjx.logs.noise import estimated_noise, noise_of, noise_table
from tests.cli_harness import Run

STEP, SECONDS = 0.05, 120.0
TIME = np.arange(0.0, SECONDS, STEP)
MOVES = (TIME > 30.0) & (TIME < 100.0)


def coloured(rng: np.random.Generator, tau: float) -> np.ndarray:
    keep = np.exp(-STEP / tau)
    state, out = rng.normal(), np.zeros(len(TIME))
    for k in range(len(TIME)):
        out[k] = state
        state = keep * state + np.sqrt(1.0 - keep**2) * rng.normal()
    return out


def make(folder: Path, columns: dict[str, np.ndarray], **settings: object) -> Log:
    frame = {"time_s": TIME, "joint_left_drive_speed_rad_s": 1.0 * MOVES, **columns}
    write_log(folder, {"drive": pd.DataFrame(frame)}, rover="luvmi_x", **settings)
    log = read_log(folder)
    assert isinstance(log, Log)
    return log


def test_driving_and_rest_are_told_apart_and_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    motion = 3.0 * np.sin(0.3 * TIME) + 0.1 * TIME
    level = np.where(MOVES, 0.5, 0.05)
    columns = {
        "gyro_z_rad_s": motion + level * rng.normal(size=len(TIME)),
        "motor_left_drive_current_A": motion + level * rng.normal(size=len(TIME)),
        "yaw_deg": motion + level * rng.normal(size=len(TIME)),
    }
    log = make(tmp_path / "a", columns)
    for name, source in zip(columns, ("vibration", "ripple", "estimate"), strict=True):
        drive, rest = (estimated_noise(log, name, moving) for moving in (True, False))
        assert drive is not None and rest is not None
        assert drive.source == source and rest.source == "rest"
        assert drive.share == rest.share == 0.0
        assert abs(np.log(drive.std / 0.5)) < 4.0 * drive.log_std and drive.log_std < 0.1
        assert abs(np.log(rest.std / 0.05)) < 4.0 * rest.log_std and rest.log_std < 0.1
        assert noise_of(log, name) == drive


@pytest.mark.parametrize("tau", [0.2, 0.8])
def test_colour_is_found(tau: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    values = 0.3 * coloured(rng, tau) + 0.1 * rng.normal(size=len(TIME))
    found = estimated_noise(make(tmp_path / "a", {"gyro_x_rad_s": values}), "gyro_x_rad_s", moving=True)
    assert found is not None and found.share >= 0.6
    assert 0.4 < found.correlation_time_s / tau < 2.5
    assert 0.7 < found.std / np.hypot(0.3, 0.1) < 1.4


def test_the_certainty_covers_the_errors(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    off = []
    for k in range(40):
        columns = {f"gyro_{a}_rad_s": rng.normal(size=len(TIME)) for a in "xyz"}
        log = make(tmp_path / str(k), columns)
        for name in columns:
            found = estimated_noise(log, name, moving=False)
            assert found is not None
            off.append(np.log(found.std) / found.log_std)
    assert 0.6 < np.std(off) < 1.3 and abs(np.mean(off)) < 0.4


def test_noise_that_grows_from_window_to_window_has_a_spread(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    level = np.repeat(np.exp(0.6 * rng.normal(size=60)), 40)[: len(TIME)]
    found = estimated_noise(
        make(tmp_path / "a", {"gyro_x_rad_s": level * rng.normal(size=len(TIME))}), "gyro_x_rad_s", moving=True
    )
    assert found is not None and 0.3 < found.spread < 1.0 and found.log_std > 0.3


def test_what_is_stated_counts_and_says_how_well(tmp_path: Path, run: Run) -> None:
    rng = np.random.default_rng(4)
    stated = {"gyro_x_rad_s": Noise(0.2, "datasheet"), "gyro_y_rad_s": Noise(0.3, "vibration", 0.4)}
    columns = {name: rng.normal(size=len(TIME)) for name in stated}
    log = make(tmp_path / "a", columns, noise=stated)
    one, two = noise_of(log, "gyro_x_rad_s"), noise_of(log, "gyro_y_rad_s")
    assert one is not None and (one.std, one.source, one.log_std) == (0.2, "datasheet", 0.3)
    assert two is not None and two.correlation_time_s == 0.4 and two.source == "vibration" and two.share == 0.99
    log.noise["gyro_y_rad_s"] = Noise(0.3, "vibration", 0.4, 0.2)  # type: ignore[index]
    two = noise_of(log, "gyro_y_rad_s")
    assert two is not None and two.share == 0.2
    table = noise_table([log])
    assert set(table["gyro_x_rad_s"]) == {"stated", "drive", "rest"}
    assert noise_of(log, "joint_left_drive_speed_rad_s") is None, "a wheel that turns evenly shows none"
    result = run("log", "noise", tmp_path / "a")
    assert result.status == 0 and "gyro_x_rad_s" in result.out and "vibration" in result.out
    lines = [line.split() for line in result.out.splitlines()]
    below = lines[lines.index(["gyro_y_rad_s"]) + 1 :]
    assert [line[0] for line in below[:3]] == ["stated:", "vibration", "rest"]


def test_a_row_of_the_noise_fits_into_80_columns(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    columns = {name: rng.normal(size=len(TIME)) for name in ("gyro_x_rad_s", "accelerometer_x_m_s2")}
    make(tmp_path / "a", columns, noise={"gyro_x_rad_s": Noise(0.2, "datasheet")})
    monkeypatch.setenv("COLUMNS", "80")  # after the fixture's own
    lines = run("log", "noise", tmp_path / "a").out.rstrip().splitlines()
    assert max(map(len, lines)) <= 80 and len(lines) == 1 + 2 + 5
    assert sum("stated: datasheet" in line for line in lines) == 1
    rows = [line.split() for line in lines[1:] if line.startswith("   ")]
    assert len(rows) == 5 and all(len([float(v) for v in row[-4:]]) == 4 for row in rows)
