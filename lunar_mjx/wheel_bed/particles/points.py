"""The points of a steady-state table, as a particle bed imposes them."""

from __future__ import annotations

import numpy as np

from lunar_mjx.wheel_bed.particles.settings import Point
from lunar_mjx.wheel_bed.table import SteadyStateTable


def points_of_table(table: SteadyStateTable) -> list[Point]:
    """The points of a steady-state table: slip, slip angle, load, and both speeds over the larger of them."""
    test = table.wheel_test()
    rim, travel = np.asarray(test.rim_speed, float), np.asarray(test.travel_speed, float)
    fast = np.maximum(rim, travel)
    imposed = (table.test[c] for c in ("slip_ratio", "slip_angle_deg", "normal_load_N"))
    rows = zip(*(np.asarray(c, float).tolist() for c in (*imposed, rim / fast, travel / fast)), strict=True)
    return [Point(*row) for row in rows]
