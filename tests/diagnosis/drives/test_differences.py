"""Difference quotients between rovers of one batch: by short steps, and by wide ones, in which jumps hardly count."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.differences import STEP, WIDE, Differences
from tests.inference.toy_problem import coordinate, manoeuvres

COORDINATES = (coordinate("base", "edge"), coordinate("base", "capped", high=0.0))
JUMP = 1e-5


def predictions(rows):
    """(k, n) smooth in both, with a small jump of the first a tenth of a short step beyond zero."""
    jump = JUMP * (rows[:, 0] > 0.1 * STEP)
    return np.stack([3.0 * rows[:, 0] + jump + 0.5 * rows[:, 1]] * 4, axis=1)


@pytest.mark.parametrize(("step", "slope"), [(STEP, 3.0 + JUMP / STEP), (WIDE[0], 3.0 + JUMP / WIDE[0])])
def test_a_jump_counts_by_the_step(step, slope):
    observations = manoeuvres(1, 4)
    u, which = np.zeros(2), np.arange(2)
    differences = Differences(COORDINATES, which, step)
    rows = differences.rows(u)
    found = differences.jacobian(u, predictions(rows), observations, lambda c: np.zeros(4))
    np.testing.assert_allclose(found[:, 0], slope, rtol=1e-6)
    np.testing.assert_allclose(found[:, 1], 0.5, rtol=1e-6)  # one that stands at its bound is moved the other way
    assert rows[2, 1] == pytest.approx(-step)


def test_every_coordinate_has_its_own_step():
    u, which = np.zeros(2), np.arange(2)
    differences = Differences(COORDINATES, which, np.array([0.25, 0.5]))
    rows = differences.rows(u)
    np.testing.assert_array_equal(rows, [[0.0, 0.0], [0.25, 0.0], [0.0, -0.5]])
    found = differences.jacobian(u, predictions(rows), manoeuvres(1, 4), lambda c: np.zeros(4))
    np.testing.assert_allclose(found, [[3.0 + JUMP / 0.25, 0.5]] * 4, rtol=1e-9)
