"""Errors of instruments that are usual: zeros, scales and clocks, the same in all logs."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.diagnosis.drives.instruments import (
    USUAL_ERRORS,
    USUAL_SCALE,
    USUAL_ZERO,
    usual_errors,
    usual_kind,
    usual_nuisances,
)
from lunar_mjx.diagnosis.drives.observations import with_errors
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
    found = usual_errors(observations, rise, np.repeat([1.0, 2.0, 3.0, 4.0], 50))
    kinds = [usual_kind(c) for c in usual_nuisances(observations)]
    assert len(kinds) == len(found)
    assert set(kinds) == {"gyro", "motor A", "position", "clock imu", "clock electrical", "clock odometry"}
    zero, scale = found["gyro: zero gyro_z_rad_s"], found["gyro: scale"]
    assert not zero[50:].any() and not scale[50:].any()
    np.testing.assert_allclose(zero[:50], USUAL_ZERO["gyro"])
    np.testing.assert_allclose(scale[:50], USUAL_SCALE["gyro"] * rise[:50])
    current = found["motor A: scale"]
    np.testing.assert_allclose(current[50:150], USUAL_SCALE["motor"] * rise[50:150])  # one scale of all motors
    way = found["position: scale"]
    np.testing.assert_allclose(way[150:], USUAL_SCALE["position"] * (rise[150:] - rise[150]))
    np.testing.assert_allclose(
        found["clock electrical: late"], -USUAL_ERRORS.usual_clock_s * np.repeat([0.0, 2.0, 3.0, 0.0], 50)
    )


def test_times_that_scatter_count_where_a_signal_changes():
    observations = manoeuvres(2, 100, white=0.01)
    rate = np.zeros(200)
    rate[40:45] = 8.0
    rng = np.random.default_rng(5)
    seen = with_errors(observations, 0.005 * rate)
    error = rate * 0.005 * rng.standard_normal(200) + 0.01 * rng.standard_normal(200)
    weighed, taken_for_noise = (np.sqrt(np.mean(o.whiten(error)[40:45] ** 2)) for o in (seen, observations))
    assert weighed < 2.0 < taken_for_noise
    np.testing.assert_array_equal(seen.whiten(error)[50:], observations.whiten(error)[50:])
