"""A small wheel's test, shared by the tests of the test bed."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lunar_mjx.criticism import WheelTest, wheel_test

RADIUS, WIDTH, LOAD = 0.0625, 0.05, 20.0


def small_test(slip, angle_deg, load=LOAD) -> WheelTest:
    """A test of the small wheel in float64; slip in the wheel's frame."""
    with jax.enable_x64(True):
        return wheel_test(slip, jnp.deg2rad(jnp.asarray(angle_deg, float)), load, RADIUS, WIDTH)
