"""Runs and results of a particle bed that no particle was moved for."""

from __future__ import annotations

import numpy as np

from lunar_mjx.wheel_bed.particles.sand_box import Series
from lunar_mjx.wheel_bed.particles.settings import BedRun, Numerics, ParticleWheel, Point, Sand

WHEEL, SAND, NUMERICS = ParticleWheel(0.1, 0.1), Sand(), Numerics(0.0125)
POINT = Point(0.2, 0.0, 50.0, 1.0, 0.8)
RUN = BedRun(WHEEL, SAND, 9.81, POINT, NUMERICS)


def fake_result(run: BedRun, **changes: object) -> dict:
    """A result as the campaign keeps it, with values that a test can foresee."""
    values = {"drawbar_pull": 5.0, "side_force": 1.0, "driving_torque": 2.0, "sinkage": 0.01}
    values |= {k: v for k, v in changes.items() if k in values}
    rest = {
        "error": dict.fromkeys(values, 0.0),
        "drift": dict.fromkeys(values, 0.0),
        "usable": changes.get("usable", True),
        "momentum_error": 1e-7,
    }
    timing = {"seconds": 10.0, "wheel_seconds": 2.0, "device": "cpu"}
    return {"key": run.key, "variant": run.variant, **run.inputs(), "values": values, **rest, **timing}


def series(run: BedRun, **values: float) -> Series:
    """A wheel that does the same in every step."""
    time = run.time_step * np.arange(1, run.steps + 1)
    constant = {"drawbar_pull": 3.0, "side_force": 0.0, "vertical_force": run.point.load, "driving_torque": 1.0}
    constant |= {"sinkage": 0.02, "travel": 0.0, "contacts": 50.0} | values
    full = {k: np.full(run.steps, v) for k, v in constant.items()}
    return Series(time=time, momentum_error=np.array([0.0, 0.0, 1e-6]), particles=1000, **full)
