"""Judging on manoeuvres left out, and the test for noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.held_out import errors, noise_test, predictive_gain, predictive_residual
from tests.inference.toy_problem import Linear, manoeuvres

RNG = np.random.default_rng(0)
LOGS, SAMPLES = 6, 60
BASE = RNG.standard_normal((LOGS * SAMPLES, 4))
EXTRA = np.sin(np.arange(LOGS * SAMPLES) * 0.3)


def problem_of(value: np.ndarray) -> Linear:
    return Linear(BASE, {"extra": EXTRA}, dataclasses.replace(manoeuvres(LOGS, SAMPLES), value=value))


def noise(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(LOGS * SAMPLES)


def test_the_predictive_residual_is_that_of_a_fit_without_the_manoeuvre():
    value = BASE @ [1.0, 2.0, 3.0, 4.0] + noise()
    problem = problem_of(value)
    predicted = predictive_residual(problem, fit(problem, problem.free()))
    for log in range(4):
        mine = slice(log * SAMPLES, (log + 1) * SAMPLES)
        rest = np.ones(len(value), bool)
        rest[mine] = False
        rest[4 * SAMPLES :] = False
        u = np.linalg.lstsq(BASE[rest], value[rest], rcond=None)[0]
        np.testing.assert_allclose(predicted[mine], value[mine] - BASE[mine] @ u, atol=0.02)


def gain(problem: Linear) -> tuple[float, float]:
    """What the extra column gains on manoeuvres left out, and its standard error."""
    before, after = (fit(problem, problem.free(more)) for more in ((), ("extra",)))
    residuals = [predictive_residual(problem, one) for one in (before, after)]
    return predictive_gain(problem, before, after, *residuals)


def test_a_real_effect_gains_and_an_idle_one_does_not():
    real = problem_of(EXTRA + noise())
    value, se = gain(real)
    assert value > 3.0 * se
    # half the sum of the squares that the effect explains
    assert value == pytest.approx(0.5 * np.sum(EXTRA**2), rel=0.3)
    idle = problem_of(noise())
    value, se = gain(idle)
    assert value < 2.0 * se + 1.0


@pytest.mark.parametrize("seed", range(5))
def test_noise_passes_for_noise(seed):
    problem = problem_of(noise(seed))
    assert noise_test(problem, fit(problem, problem.free())).passes


def test_understated_noise_does_not_pass():
    problem = problem_of(1.3 * noise())
    found = noise_test(problem, fit(problem, problem.free()))
    assert not found.passes
    assert found.worst == "y"
    assert found.rms == pytest.approx(1.3 * noise().std(), rel=0.02)


def test_errors_are_given_by_split():
    problem = problem_of(noise())
    found = errors(problem, fit(problem, problem.free()))
    assert set(found) == {"fit", "select", "held_out"}
    assert found["held_out"] == found["select"]
    assert found["fit"] == pytest.approx(1.0, abs=0.15)
