"""Resistive force theory under a wheel, against quadrature of other code and by its signs."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.foreign import wheel
from lunar_mjx.effects.wheel.granular import FLAT
from lunar_mjx.wheel_bed.bed import WheelBed, WheelTest

RADIUS, WIDTH, LOAD, TRAVEL, STIFFNESS, FRICTION = 0.1, 0.08, 60.0, 0.05, 1.2e6, 0.5


@pytest.fixture(scope="module")
def bed():
    made = WheelBed.of_preset("consistent").with_effect("granular_resistance")
    soil = {"k_c": 0.0, "k_phi": STIFFNESS * FLAT, "n": 1.0, "friction_angle": float(np.arctan(FRICTION))}
    return made.with_values({"soil": soil})


def run(bed, slip, angle):
    forward = TRAVEL * np.cos(angle)
    rim = np.where(slip >= 0.0, forward / (1.0 - slip), forward * (1.0 + slip))
    same = np.ones_like(slip)
    test = WheelTest(
        rim_speed=rim,
        travel_speed=TRAVEL * same,
        slip_angle=angle,
        normal_load=LOAD * same,
        radius=RADIUS * same,
        width=WIDTH * same,
    )
    return bed.run(test)


def test_forces_agree_with_a_bed_of_other_code(bed):
    slip, angle = np.array([-0.4, 0.0, 0.1, 0.3, 0.6, 0.1, 0.5]), np.radians([0.0, 0.0, 0.0, 0.0, 0.0, 20.0, 40.0])
    soil = {"grain_stiffness": STIFFNESS, "rim_friction": FRICTION}
    world = wheel.World("granular", RADIUS, WIDTH, soil, {}, None, LOAD, {})
    same = np.ones_like(slip)
    other = wheel.run(world, wheel.Rows(slip, angle, LOAD * same, TRAVEL * same, 9.80665 * same))
    found = run(bed, slip, angle)
    for name, size in (("drawbar_pull", LOAD), ("side_force", LOAD), ("driving_torque", LOAD * RADIUS)):
        np.testing.assert_allclose(getattr(found, name), getattr(other, name), atol=1e-3 * size)
    np.testing.assert_allclose(found.sinkage, other.sinkage, atol=1e-3 * RADIUS)


@pytest.mark.slow
def test_slip_gives_thrust_and_sinkage_and_soil_opposes_the_slip_angle(bed):
    slip = np.array([-0.3, 0.0, 0.3])
    ahead = run(bed, slip, np.zeros(3))
    assert np.all(np.diff(ahead.drawbar_pull) > 0.0) and np.all(np.diff(ahead.driving_torque) > 0.0)
    assert ahead.sinkage[2] > ahead.sinkage[1]
    aside = run(bed, np.full(2, 0.2), np.radians([-20.0, 20.0]))
    assert aside.side_force[1] > 0.0
    np.testing.assert_allclose(aside.side_force[0], -aside.side_force[1], rtol=1e-6)
