"""The error of the time step, taken anew where an effect has moved it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis.refit import Candidate, Settings, refit_with, with_own_step_error
from lunar_mjx.diagnosis.search import _in_own_steps
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.held_out import noise_test
from tests.inference.toy_problem import Linear, manoeuvres

TIME = np.arange(400) * 0.01


def stepped(amount: np.ndarray, halvings: float) -> np.ndarray:
    """A front that comes late by the amount and one that does not, both later still by the error of a step."""
    late = 0.02 * (1.0 - 0.5 * halvings)
    return 100.0 * (np.tanh((TIME - 0.5 - amount - late) / 0.1) + np.tanh((TIME - 3.0 - late) / 0.1))


class Stepped(Linear):
    """Its nuisance adds the error of the step, taken where the model was given: for a front that is not late."""

    cheap_jacobian = False
    renewed = 0

    def __init__(self, truth: float):
        empty = manoeuvres(4, 100)
        super().__init__(np.ones((400, 1)), {"delay": np.zeros(400)}, empty, prior=1.0)
        noise = 0.1 * np.random.default_rng(0).standard_normal(400)
        self.observations = dataclasses.replace(empty, value=stepped(np.array(truth), 1.0) + noise)
        self.error = self._error(0.0)

    def _error(self, amount: float) -> np.ndarray:
        return 2.0 * (stepped(np.array(amount), 1.0) - stepped(np.array(amount), 0.0))

    def predict(self, u):
        u = np.atleast_2d(u)
        return u[:, :1] * self.error + stepped(u[:, 1:], 0.0)

    def jacobian(self, u, which):
        e = 1e-6
        rows = u + e * np.eye(2)
        return ((self.predict(rows) - self.predict(u)) / e).T[:, which]

    def kept_step_error(self):
        return self.error

    def use_step_error(self, kept):
        self.error = kept

    def renew_step_error(self, u, least=1.0):
        error = self._error(float(u[1]))
        if np.linalg.norm(error - self.error) < 1.0:
            return False
        self.error, self.renewed = error, self.renewed + 1
        return True


def candidate(problem: Stepped) -> Candidate:
    found = fit(problem, problem.free(("delay",)), np.array([0.0, 1.0]), starts=1, certify=False)
    return Candidate(("delay",), found, noise_test(problem, found), 0.0, 0.0)


def test_a_delay_is_not_biased_by_a_step_error_taken_without_it():
    problem = Stepped(1.0)
    before = candidate(problem)
    after = with_own_step_error(problem, before)
    assert abs(before.fit.u[1] - 1.0) > 0.005
    assert after.fit.u[1] == pytest.approx(1.0, abs=1e-3)
    assert after.fit.u[0] == pytest.approx(0.5, abs=0.05)
    assert after.fit.chi2 < before.fit.chi2
    assert 1 <= problem.renewed <= 2


def test_what_the_nuisance_absorbs_already_is_not_fitted_again():
    problem = Stepped(0.0)
    before = candidate(problem)
    assert with_own_step_error(problem, before) is before
    assert problem.renewed == 0


def test_every_one_at_the_noise_is_judged_with_the_step_error_at_its_own_fit():
    problem = Stepped(1.0)
    given, delayed = problem.error, candidate(problem)
    worse = dataclasses.replace(delayed.fit, chi2=delayed.fit.chi2 + 1e4)
    far = dataclasses.replace(delayed, effects=("far",), fit=worse)
    # reached the noise first, with a step error that is that of the model as given
    first = candidate(Stepped(0.0))
    first = dataclasses.replace(
        first,
        effects=("other",),
        fit=dataclasses.replace(first.fit, chi2=delayed.fit.chi2 - 1.0, u=np.array([0.5, 0.0]), step_error=given),
    )
    tried = {frozenset(c.effects): c for c in (first, delayed, far)}
    base = fit(problem, problem.free(), starts=1, certify=False)
    nothing = Candidate((), base, noise_test(problem, base), 0.0, 0.0)
    best = _in_own_steps(problem, nothing, first, Settings(), tried)
    assert best.effects == ("delay",)
    assert best.fit.u[1] == pytest.approx(1.0, abs=1e-3)
    assert problem.error is best.fit.step_error is not given
    assert tried[frozenset(("delay",))] is best
    assert tried[frozenset(("other",))] is first
    assert tried[frozenset(("far",))] is far


def test_a_refit_on_demand_leaves_the_step_error_as_it_was():
    problem = Stepped(1.0)
    base = fit(problem, problem.free(), starts=1, certify=False)
    first = refit_with(problem, base, "delay", Settings(), Memory())
    again = refit_with(problem, base, "delay", Settings(), Memory())
    assert problem.error is base.step_error
    assert again.chi2 == pytest.approx(first.chi2, rel=1e-9)
    assert first.step_error is not base.step_error
