"""Levenberg-Marquardt within bounds: where it arrives, from where, and by how many evaluations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from lunar_mjx.inference.bounded_descent import minimise

FREE = np.full(2, np.inf)


class Counted:
    """A function of residuals and derivatives that counts its calls."""

    def __init__(self, function):
        self.function, self.calls = function, 0

    def __call__(self, x):
        self.calls += 1
        return self.function(x)


def _rosenbrock(x):
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]), np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])


def test_a_curved_valley_is_followed_to_its_end():
    at = Counted(_rosenbrock)
    assert minimise(at, np.array([-1.2, 1.0]), -FREE, FREE, 1e-12, 100) == pytest.approx([1.0, 1.0], abs=1e-5)
    assert at.calls < 40


@pytest.mark.parametrize("seed", range(5))
def test_a_linear_problem_takes_two_steps_within_its_bounds(seed):
    rng = np.random.default_rng(seed)
    matrix, rest = rng.standard_normal((30, 6)) * np.geomspace(1e-3, 1e3, 6), rng.standard_normal(30)
    low, high = -np.abs(rng.standard_normal(6)), np.abs(rng.standard_normal(6))
    at = Counted(lambda x: (matrix @ x - rest, matrix))
    found = minimise(at, np.zeros(6), low, high, 1e-9, 50)
    best = optimize.lsq_linear(matrix, rest, (low, high), "bvls")
    assert np.sum((matrix @ found - rest) ** 2) == pytest.approx(2.0 * best.cost, rel=1e-6)
    assert at.calls <= 5 and (found >= low).all() and (found <= high).all()


def test_a_first_guess_of_nothing_is_left_where_a_unit_step_gains_little():
    # stiff and slack directions that are correlated: a trust region as short as the guess would gain next to nothing
    matrix = np.column_stack([np.full(400, 300.0), 300.0 + np.linspace(-1.0, 1.0, 400)])
    wanted = np.array([12.0, -12.0])
    noise = 30.0 * np.random.default_rng(0).standard_normal(400)
    found = minimise(lambda x: (matrix @ (x - wanted) + noise, matrix), np.zeros(2), -FREE, FREE, 0.01, 20)
    best = np.linalg.lstsq(matrix, matrix @ wanted - noise, rcond=None)[0]
    assert found == pytest.approx(best, abs=0.2)


def test_a_place_where_the_model_diverges_is_not_entered():
    def at(x):
        return (np.log(x) - 1.0, np.diag(1.0 / x)) if (x > 0.0).all() else (np.full(1, np.nan), np.full((1, 1), np.nan))

    with np.errstate(invalid="ignore", divide="ignore"):
        found = minimise(at, np.array([20.0]), np.array([-np.inf]), np.array([np.inf]), 1e-9, 50)
    assert found == pytest.approx([np.e], rel=1e-3)
