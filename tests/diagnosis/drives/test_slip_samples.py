"""Samples of the slip ratio that are compared: none near a wheel's rest or reversal."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.slip_samples import SLIP_TIME, least

TIME = np.arange(0.0, 4.0, 0.05)


@pytest.mark.parametrize("course", [np.where(TIME < 2.0, 1.0, -1.0), TIME - 2.01, np.where(TIME < 2.0, 1.0, 0.0)])
def test_nothing_counts_around_a_reversal_or_a_rest(course):
    smallest = least(TIME, course)
    zero = np.flatnonzero((np.abs(course) < 1e-9) | (np.abs(TIME - 2.0) < 0.051))
    near = np.min(np.abs(TIME[:, None] - TIME[zero]), axis=1) < SLIP_TIME - 0.06
    assert np.all(smallest[near] <= 0.05)
    assert np.all(smallest[TIME < 1.6] > 0.1)


def test_a_steady_speed_stays_as_it_is():
    np.testing.assert_array_equal(least(TIME, np.full(len(TIME), -0.7)), 0.7)
