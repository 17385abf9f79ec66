"""The particle bed with its extra: momentum, a wheel's signs, gravity as a mere scale, and the angle of repose."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest

from lunar_mjx.wheel_bed.particles import campaign
from lunar_mjx.wheel_bed.particles.settings import Numerics, ParticleWheel, Point, Sand
from lunar_mjx.wheel_bed.particles.slump import settlement, slump_angle, surface_angle

HERE = all(importlib.util.find_spec(name) for name in ("newton", "warp"))
needs_extra = pytest.mark.skipif(not HERE, reason="needs newton and warp-lang: pip install 'lunar-mjx[particles]'")
COARSE = Numerics(0.033, step_share=0.25, path=1.5, settle=2.0, least_travel=1.0, iterations=60)
WHEEL = ParticleWheel(0.1, 0.1)


def test_the_slope_of_a_wedge():
    rng = np.random.default_rng(0)
    x, share = rng.random(40_000), rng.random(40_000)
    wedge = np.stack([x, np.zeros_like(x), share * (1.0 - x) * math.tan(math.radians(25.0))], axis=1)
    assert surface_angle(wedge, 0.02) == pytest.approx(25.0, abs=1.0)


@needs_extra
@pytest.mark.slow
def test_a_wheel_in_sand(tmp_path):
    """Momentum closes; a sliding wheel is pushed back; a locked one is dragged; the Moon is the Earth to scale."""
    moon = 1.625 / 9.81
    points = [Point(0.2, 20.0, 50.0, 1.0, 0.8), Point(-0.8, 0.0, 50.0, 0.2, 1.0)]
    light = [Point(p.slip_ratio, p.slip_angle, moon * p.load, p.rim, p.travel) for p in points[:1]]
    runs = campaign.plan(WHEEL, Sand(), 9.81, points, COARSE, 0)
    runs += campaign.plan(WHEEL, Sand(), 1.625, light, COARSE, 0)
    done = campaign.compute(runs, tmp_path, "cpu", most_particles=10**6)
    slid, locked, on_moon = done.results
    assert max(r["momentum_error"] for r in done.results) < 1e-4
    assert slid["values"]["side_force"] > 2.0 and slid["values"]["driving_torque"] > 0.0
    assert locked["values"]["drawbar_pull"] < -2.0
    for quantity, size in (("drawbar_pull", 50.0), ("side_force", 50.0), ("driving_torque", 5.0)):
        assert on_moon["values"][quantity] / moon == pytest.approx(slid["values"][quantity], abs=0.02 * size)
    assert on_moon["values"]["sinkage"] == pytest.approx(slid["values"]["sinkage"], abs=0.02 * 0.1)


@needs_extra
@pytest.mark.slow
def test_angle_of_repose():
    """At rest no slope is steeper than that of simple shear, tan = sin(phi); a slump runs out somewhat flatter."""
    steepest = math.degrees(math.atan(math.sin(math.radians(35.0))))
    assert 0.6 * steepest < slump_angle(Sand(), 9.81, 0.02, height=6, device="cpu") < 1.1 * steepest


@needs_extra
@pytest.mark.slow
def test_sand_settles_by_a_small_part_of_a_voxel():
    """Places off a lattice by 40 % of a spacing leave gaps; they must not pass for a wheel's sinkage."""
    assert 0.0 < settlement(Sand(), 9.81, 0.01, 0.005, depth=8, device="cpu") < 0.12 * 0.01
