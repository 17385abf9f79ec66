"""Fits: known optima, bounds, curved valleys."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.objective import Objective
from tests.inference.toy_problem import Decay, Linear, TwoMinima, coordinate, manoeuvres

RNG = np.random.default_rng(0)
BASE = RNG.standard_normal((120, 3))
TIME = np.linspace(0.0, 4.0, 80)


def linear(value: np.ndarray, **limits) -> Linear:
    observations = dataclasses.replace(manoeuvres(3, 40), value=value)
    return Linear(BASE, {"extra": np.cos(np.arange(120))}, observations, **limits)


def decay(noise: float = 0.01, **limits) -> Decay:
    value = 2.0 * np.exp(-0.7 * TIME) + noise * np.random.default_rng(1).standard_normal(len(TIME))
    return Decay(TIME, value, **limits)


def test_a_linear_fit_is_least_squares_with_its_prior():
    value = BASE @ [1.0, -2.0, 3.0] + RNG.standard_normal(120)
    problem = linear(value, prior=2.0)
    found = fit(problem, problem.free())
    exact = np.linalg.solve(BASE.T @ BASE + np.eye(3) / 4.0, BASE.T @ value)
    np.testing.assert_allclose(found.u[:3], exact, rtol=1e-3)
    assert found.u[3] == 0.0
    np.testing.assert_allclose(found.covariance(problem), np.linalg.inv(BASE.T @ BASE + np.eye(3) / 4.0), rtol=1e-6)


def test_every_start_finds_the_optimum_of_a_decay():
    problem = decay()
    found = fit(problem, problem.free(), np.array([1.0, 0.2]), starts=4)
    assert found.u == pytest.approx([2.0, 0.7], rel=0.03)
    assert found.rms(found.fitted) == pytest.approx(1.0, abs=0.25)


def test_the_lowest_of_several_starts_is_taken():
    """A quartic with a second, worse minimum, and starts in both basins."""
    problem = TwoMinima()
    assert fit(problem, problem.free(), np.array([-1.2]), starts=1).u[0] < 0.0
    found = fit(problem, problem.free(), np.array([-1.2]), starts=4, spread=2.5)
    assert found.u == pytest.approx([1.0], abs=0.01)
    assert found.chi2 == pytest.approx(0.0, abs=0.1)


def test_a_start_that_diverges_is_no_fit():
    problem = linear(np.zeros(120))
    problem.matrix = problem.matrix * np.inf
    with np.errstate(invalid="ignore"):
        assert fit(problem, problem.free()).chi2 == np.inf


def test_a_fit_rests_on_a_bound():
    bounded = decay(high=1.999)
    assert fit(bounded, bounded.free(), np.array([0.5, 0.5])).u[0] == pytest.approx(1.999)


def test_held_out_observations_do_not_move_a_fit():
    observations = manoeuvres(6, 20)
    value = BASE @ [1.0, -2.0, 3.0]
    value[80:] += 100.0
    problem = Linear(BASE, {}, dataclasses.replace(observations, value=value))
    found = fit(problem, problem.free())
    np.testing.assert_allclose(found.u, [1.0, -2.0, 3.0], rtol=1e-3)
    assert found.rms(~found.fitted) > 50.0


def test_a_step_that_meets_a_bound_is_the_best_within_it():
    rng = np.random.default_rng(5)
    columns = rng.standard_normal((300, 3)) @ np.array([[1.0, 0.9, 0.0], [0.0, 0.3, 0.5], [0.0, 0.0, 1.0]])
    observations = dataclasses.replace(manoeuvres(3, 100), value=columns @ [3.0, -4.0, 0.5])
    problem = Linear(columns, {}, observations, low=-2.0, high=2.0)
    goal = Objective(problem, problem.free(), np.ones(300, bool))
    residual, _ = goal.residuals(problem.origin()[None])
    downhill, hessian = goal.quadratic(problem.origin(), residual[0], columns)
    step = goal.steps(problem.origin(), downhill, hessian, np.zeros(1))[0]
    best = lsq_linear(columns, observations.value, (-2.0, 2.0), tol=1e-14).x
    np.testing.assert_allclose(step, best, atol=1e-4)
    dropped = goal.residuals(problem.origin()[None])[1][0] - goal.residuals(step[None])[1][0]
    assert goal.promise(problem.origin(), downhill, hessian) == pytest.approx(dropped, rel=1e-6)


class Valley(TwoMinima):
    """Rosenbrock's curved valley."""

    def __init__(self):
        super().__init__()
        self.coordinates, self.baseline = (coordinate("base", "u"), coordinate("base", "v")), np.arange(2)

    def predict(self, u):
        u = np.atleast_2d(u)
        return np.column_stack([1.0 - u[:, 0], 10.0 * (u[:, 1] - u[:, 0] ** 2)])

    def jacobian(self, u, which):
        return np.array([[-1.0, 0.0], [-20.0 * u[0], 10.0]])[:, which]


def test_a_curved_valley_is_followed_to_its_end():
    problem = Valley()
    found = fit(problem, problem.free(), np.array([-1.2, 1.0]), starts=1)
    assert found.chi2 < 0.1
