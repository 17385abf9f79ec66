"""Coordinates of parameters: values at their bounds."""

from __future__ import annotations

import numpy as np

from lunar_mjx.inference.coordinates import Coordinate


def test_a_coordinate_at_its_bound_has_a_value_within_it():
    """No rounding carries a refit that ended at a bound beyond it, where a model would refuse the value."""
    rounded = 0
    for scale in np.random.default_rng(0).uniform(0.1, 10.0, 200):
        for c in (
            Coordinate("soil", "n", 1.7, float(scale), 0.3, 20.1),
            Coordinate("soil", "k_phi", 1.7, float(scale), 0.3, 20.1, log=True),
        ):
            for u in c.bounds():
                rounded += not c.low <= float(c.value(u)) <= c.high
                assert c.low <= c.value_within(u) <= c.high
    assert rounded, "no value rounded beyond a bound: the test shows nothing"
