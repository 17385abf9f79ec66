"""Attitude of a log: quaternions alone tell the angles, and the mounting of a tilted IMU is taken off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from lunar_mjx.logs import Log, Noise, read_log, write_log

N = 50
TIME = 0.1 * np.arange(N)
BODY = Rotation.from_euler(
    "ZYX", np.stack([40.0 + 3.0 * TIME, 5.0 * np.sin(TIME), 4.0 * np.cos(TIME)], axis=1), degrees=True
)
MOUNTING = Rotation.from_euler("ZYX", [20.0, -13.9, 4.9], degrees=True)
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")


def frame(rotation: Rotation, quaternion: bool, angles: bool) -> pd.DataFrame:
    out = {"time_s": TIME}
    if quaternion:
        out |= {f"quaternion_{c}": v for c, v in zip("wxyz", rotation.as_quat(scalar_first=True).T, strict=True)}
    if angles:
        out |= dict(zip(ANGLES, rotation.as_euler("ZYX", degrees=True).T[::-1], strict=True))
    return pd.DataFrame(out)


def read(folder: Path, table: pd.DataFrame, **settings: object) -> Log:
    write_log(folder, {"pose": table}, rover="luvmi_x", **settings)
    log = read_log(folder)
    assert isinstance(log, Log)
    return log


def test_a_log_with_quaternions_only_has_angles(tmp_path: Path) -> None:
    table = frame(BODY, True, False)
    table.loc[7, "quaternion_x"] = np.nan
    log = read(tmp_path / "a", table, noise={"quaternion_*": Noise(0.001, "datasheet")})
    expected = BODY.as_euler("ZYX", degrees=True).T[::-1]
    for name, values in zip(ANGLES, expected, strict=True):
        found = log.tables["pose"].channels[name]
        assert np.isnan(found[7])
        np.testing.assert_allclose(np.delete(found, 7), np.delete(values, 7), atol=1e-5)
        # half an angle of 0.002 rad changes a component by 0.001
        assert log.noise[name].std == pytest.approx(np.degrees(0.002))


@pytest.mark.parametrize(("quaternion", "angles"), [(True, False), (False, True), (True, True)])
def test_the_imus_mounting_is_taken_off(quaternion: bool, angles: bool, tmp_path: Path) -> None:
    imu = {"quaternion": MOUNTING.as_quat(scalar_first=True).tolist(), "attitude": True}
    log = read(tmp_path / "a", frame(BODY * MOUNTING, quaternion, angles), imu=imu)
    for name, values in zip(ANGLES, BODY.as_euler("ZYX", degrees=True).T[::-1], strict=True):
        np.testing.assert_allclose(log.tables["pose"].channels[name], values, atol=1e-5)
    if quaternion:
        w = log.tables["pose"].channels["quaternion_w"]
        np.testing.assert_allclose(w, BODY.as_quat(scalar_first=True).T[0], atol=1e-6)


def test_without_attitude_the_angles_are_the_chassis_own(tmp_path: Path) -> None:
    imu = {"quaternion": MOUNTING.as_quat(scalar_first=True).tolist()}
    log = read(tmp_path / "a", frame(BODY, True, True), imu=imu)
    np.testing.assert_allclose(
        log.tables["pose"].channels["roll_deg"], BODY.as_euler("ZYX", degrees=True).T[2], atol=1e-5
    )
