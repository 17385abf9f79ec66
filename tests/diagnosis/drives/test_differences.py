"""Difference quotients between rovers of one batch."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.differences import STEP, Differences
from tests.inference.toy_problem import coordinate, manoeuvres

COORDINATES = (coordinate("base", "edge"), coordinate("base", "capped", high=0.0))
JUMP = 1e-5


def predictions(rows):
    """(k, n) smooth in both, with a small jump of the first a tenth of a short step beyond zero."""
    jump = JUMP * (rows[:, 0] > 0.1 * STEP)
    return np.stack([3.0 * rows[:, 0] + jump + 0.5 * rows[:, 1]] * 4, axis=1)


def test_a_jump_counts_by_the_step():
    observations = manoeuvres(1, 4)
    u, which = np.zeros(2), np.arange(2)
    differences = Differences(COORDINATES, which)
    rows = differences.rows(u)
    found = differences.jacobian(u, predictions(rows), observations, lambda c: np.zeros(4))
    np.testing.assert_allclose(found[:, 0], 3.0 + JUMP / STEP, rtol=1e-6)
    np.testing.assert_allclose(found[:, 1], 0.5, rtol=1e-6)  # one that stands at its bound is moved the other way
    assert rows[2, 1] == pytest.approx(-STEP)
