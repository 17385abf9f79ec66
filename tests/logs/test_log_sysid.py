"""Logs to and from the time series of mujoco.sysid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.logs import from_time_series, read_log, to_time_series
from tests.logs.log_files import make_log


@pytest.fixture
def sysid() -> Any:
    from mujoco import sysid

    if not hasattr(sysid, "TimeSeries"):
        pytest.skip("mujoco.sysid is not complete")
    return sysid


def spoil(tables: dict[str, pd.DataFrame]) -> None:
    tables["drive"].loc[5, "position_x_m"] = np.nan


def test_there_and_back(sysid: Any, tmp_path: Path) -> None:
    make_log(tmp_path / "a", spoil)
    log = read_log(tmp_path / "a")
    series = to_time_series(log)
    assert set(series) == set(log.tables)
    drive = log.tables["drive"]
    assert len(series["drive"]) == len(drive) - 1, "a row with a gap is left out"
    kind, place = series["drive"].get_indices("command_lf_drive_speed_rad_s")
    assert kind is sysid.SignalType.MjCtrl and len(place) == 1
    folder = from_time_series(series, tmp_path / "b", rover=log.rover, gravity_m_s2=log.gravity_m_s2, noise=log.noise)
    back = read_log(folder)
    keep = np.arange(len(drive)) != 5
    for name, values in drive.channels.items():
        np.testing.assert_allclose(back.tables["drive"].channels[name], values[keep], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(back.tables["drive"].time_s, drive.common_time_s[keep], rtol=1e-8)
    assert back.noise == log.noise


def test_names_of_signals(sysid: Any, tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    log = read_log(tmp_path / "a")
    gyro = [f"gyro_{a}_rad_s" for a in "xyz"]
    sensor = sysid.SignalType.MjSensor
    series = to_time_series(log, ["gyro_z_rad_s"], {"gyro_z_rad_s": ("imu_gyro_z", sensor)})
    assert len(series) == 1
    one = next(iter(series.values()))
    assert one.signal_mapping["imu_gyro_z"][0] is sensor and one.data.shape[1] == 1
    whole = next(iter(to_time_series(log, gyro).values()))
    packed = sysid.TimeSeries.from_custom_map(whole.times, whole.data, [("imu_gyro", 3, sensor)])
    folder = from_time_series({"imu": packed}, tmp_path / "b", rover="luvmi_x", names={"imu_gyro": gyro})
    np.testing.assert_allclose(read_log(folder).tables["imu"].channels[gyro[2]], whole.data[:, 2], rtol=1e-8)
    for names, told in (
        ({}, "imu_gyro"),
        ({"imu_gyro": gyro[:2]}, "3 columns"),
        ({"imu_gyro": gyro, "mast": "roll_deg"}, "mast"),
    ):
        with pytest.raises(UserError, match=told):
            from_time_series({"imu": packed}, tmp_path / "c", rover="luvmi_x", names=names)
    with pytest.raises(UserError, match="no_such"):
        to_time_series(log, ["no_such"])


def test_a_missing_package_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mujoco import sysid

    make_log(tmp_path / "a")
    monkeypatch.delattr(sysid, "TimeSeries", raising=False)
    with pytest.raises(UserError, match=r"lunar-mjx\[sysid\]"):
        to_time_series(read_log(tmp_path / "a"))
