"""Which runs of a table repeat each other."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.wheel_bed.table import SteadyStateTable, replicate_groups


@pytest.mark.parametrize("column", ["travel_speed_m_s", "rim_speed_m_s"])
def test_runs_at_other_speeds_are_no_replicates(column: str) -> None:
    test = {
        "slip_ratio": np.full(6, 0.2),
        "slip_angle_deg": np.zeros(6),
        "normal_load_N": np.full(6, 50.0),
        column: np.array([0.01, 0.01, 0.02, 0.02, 0.05, 0.05]),
    }
    measured = {"drawbar_pull": np.arange(6.0)}
    table = SteadyStateTable("a", test, measured, np.ones(6, int), {}, 0.1, 0.1, "wheel_frame")
    np.testing.assert_array_equal(replicate_groups(table), [0, 0, 1, 1, 2, 2])


def test_planned_loads_a_fifth_apart_are_no_replicates_and_measured_ones_are() -> None:
    test = {"slip_ratio": np.full(6, 0.2), "slip_angle_deg": np.zeros(6)}
    planned = test | {"normal_load_N": np.array([50.0, 50.0, 50.0, 60.0, 60.0, 60.0])}
    read = test | {"normal_load_N": np.array([50.1, 52.3, 54.9, 57.2, 59.8, 60.4])}
    measured = {"drawbar_pull": np.arange(6.0)}
    for imposed, groups in ((planned, [0, 0, 0, 1, 1, 1]), (read, [0] * 6)):
        table = SteadyStateTable("a", imposed, measured, np.ones(6, int), {}, 0.1, 0.1, "wheel_frame")
        np.testing.assert_array_equal(replicate_groups(table), groups)
