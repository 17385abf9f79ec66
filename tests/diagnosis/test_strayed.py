"""Refits that a misfitting baseline has sent far along a valley."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis.refit import Candidate, _strayed, refit
from lunar_mjx.inference.descent import SMALL_GRADIENT, Rival, descend
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import Fit, fit
from lunar_mjx.inference.held_out import noise_test
from lunar_mjx.inference.objective import Objective
from tests.inference.toy_problem import Linear, manoeuvres

UNSURE = ("the gradient still promises a drop of chi-square of 21",)


class Dear(Linear):
    """One whose rows cost simulations."""

    cheap_jacobian = False


def test_it_begins_again_from_the_model_as_given_with_the_amount_that_was_found(monkeypatch):
    problem = Dear(np.ones((400, 1)), {"toe": np.linspace(0.0, 1.0, 400)}, manoeuvres(4, 100))
    value = problem.predict(np.array([0.2, 30.0]))[0] + np.random.default_rng(0).standard_normal(400)
    problem.observations = dataclasses.replace(problem.observations, value=value)
    base = fit(problem, problem.free(), starts=1, certify=False)
    parent, begun = Candidate((), base, noise_test(problem, base), 0.0, 0.0), []

    def stuck_far_away(problem, free, start, **options):
        begun.append(start.copy())
        found = fit(problem, free, start, **options)
        if start[0] == 0.0:
            return found
        return dataclasses.replace(found, chi2=found.chi2 + 21.0, problems=UNSURE, gradient=21.0)

    monkeypatch.setattr("lunar_mjx.diagnosis.refit.fit", stuck_far_away)
    found = refit(problem, parent, ("toe",), None, Memory(), start=np.array([9.0, 5.0]))
    assert len(begun) == 2
    assert begun[1].tolist() == pytest.approx([0.0, found.fit.u[1]], rel=1e-3)
    assert found.fit.problems == ()


def made(chi2: float, problems: tuple[str, ...], gradient: float = 21.0) -> Fit:
    none = np.zeros(1000)
    return Fit(np.zeros(1), np.arange(0), chi2, none, none[:, None], np.ones(1000, bool), gradient, problems=problems)


@pytest.mark.parametrize(
    ("chi2", "problems", "rival", "strayed"),
    [
        (1100.0, UNSURE, np.inf, True),
        (1100.0, (), np.inf, False),
        (1900.0, UNSURE, np.inf, False),
        (1100.0, UNSURE, 1050.0, True),
        (1100.0, UNSURE, 1000.0, False),
        (1100.0, UNSURE, Rival(1000.0), False),
    ],
)
def test_only_what_explains_most_without_a_certificate_has_strayed(chi2, problems, rival, strayed):
    assert _strayed(made(2000.0, ()), made(chi2, problems), rival) is strayed


class AtAnEdge(Linear):
    """Dear rows that jump where a coordinate passes zero: just before that no short step tells a derivative."""

    cheap_jacobian = False
    jumps = 0.03 * np.random.default_rng(12).normal(size=(3, 600))

    def predict(self, u):
        return super().predict(u) + (np.atleast_2d(u) > 0.0) @ self.jumps

    def _quotients(self, u, which, step):
        rows = u + np.eye(len(u))[which] * step
        return ((self.predict(rows) - self.predict(u)) / step).T

    def jacobian(self, u, which):
        return self._quotients(u, which, 1e-7)

    def wide_jacobian(self, u, which, std):
        return self._quotients(u, which, 0.05)


def test_a_descent_leaves_the_edge_of_a_jump():
    rng = np.random.default_rng(11)
    base = rng.normal(size=(600, 3))
    true = np.array([0.3, -0.2, 0.1])
    value = base @ true + rng.standard_normal(600)
    problem = AtAnEdge(base, {}, dataclasses.replace(manoeuvres(6, 100), value=value))
    goal = Objective(problem, problem.free(), np.ones(600, bool))
    start = np.full(3, -1e-8)
    assert np.all(np.abs(problem.jacobian(start, problem.free())).max(axis=0) > 1e5)
    found = descend(goal, start)
    assert found.u == pytest.approx(true, abs=0.15)
    assert found.promise < SMALL_GRADIENT
