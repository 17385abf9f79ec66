"""Errors of instruments that are usual: zeros, scales and clocks, the same in all logs."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.diagnosis.drives.instruments import USUAL_CLOCK_S, USUAL_SCALE, USUAL_ZERO, usual_errors
from tests.inference.toy_problem import manoeuvres


def test_each_kind_of_instrument_errs_in_its_own_way():
    names = ("gyro_z_rad_s", "motor_lf_drive_current_A", "motor_rf_drive_current_A", "position_x_m")
    seen = manoeuvres(4, 50)
    series = tuple(
        dataclasses.replace(s, log=0, channel=c, time=np.arange(50) * 0.02)
        for s, c in zip(seen.series, names, strict=True)
    )
    observations = dataclasses.replace(seen, series=series)
    rise = np.tile(np.arange(50) * 0.02, 4) * np.repeat([1.0, 2.0, 3.0, 4.0], 50)
    columns, places = usual_errors(observations, rise)
    assert set(places) == {"gyro", "motor A", "clock imu", "clock electrical", "clock odometry"}
    assert np.array_equal(np.sort(np.concatenate(list(places.values()))), np.arange(columns.shape[1]))
    gyro = columns[:, places["gyro"]]
    assert gyro.shape[1] == 2 and not gyro[50:].any()
    np.testing.assert_allclose(gyro[:50, 0], USUAL_ZERO["gyro"])
    np.testing.assert_allclose(gyro[:50, 1], USUAL_SCALE * rise[:50])
    (current,) = columns[:, places["motor A"]].T
    np.testing.assert_allclose(current[50:150], USUAL_SCALE * rise[50:150])  # one scale of all motors
    (late,) = columns[:, places["clock electrical"]].T
    np.testing.assert_allclose(late, USUAL_CLOCK_S * np.repeat([0.0, 2.0, 3.0, 0.0], 50))
