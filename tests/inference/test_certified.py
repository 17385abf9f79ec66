"""What a diagnosis reports is the fit that has the certificate, with the derivatives that intervals are taken from."""

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis.attribute import diagnose
from lunar_mjx.diagnosis.refit import Settings
from lunar_mjx.diagnosis.search import fit_baseline
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import HALF_STEP
from tests.inference.toy_problem import Linear, manoeuvres

SHARE = 0.25
"""Of the short steps' derivatives that those over wide steps are: as where a fit ends at the edge of a jump."""


class Edged(Linear):
    """A problem of dear rows whose derivatives over short steps promise too much."""

    cheap_jacobian = False

    def wide_jacobian(self, u, which, std):
        return SHARE * self.jacobian(u, which)


class Coarse(Linear):
    """A problem in which halving the time step changes chi-square until the step's error is taken at the fit."""

    cheap_jacobian = False
    renewed_at = None

    def certificate(self, u, free):
        own = self.renewed_at is not None and abs(self.renewed_at[0] - u[0]) < 1.0
        return {"half_step_chi2": 0.0 if own else 2.0 * HALF_STEP}

    def renew_step_error(self, u, least=1.0):
        if least > 0.0:
            return False
        self.renewed_at = u.copy()
        return True


@pytest.fixture
def columns():
    rng = np.random.default_rng(5)
    return rng.normal(size=(600, 2)), rng.normal(size=600), rng.standard_normal(600)


def test_intervals_are_those_of_the_certified_fit(columns):
    base, one, noise = columns
    observed = dataclasses.replace(manoeuvres(6, 100), value=3.0 * one + noise)
    plain, edged = (diagnose(kind(base, {"one": one}, observed), Settings(draws=200))[0] for kind in (Linear, Edged))
    assert plain.verdict is edged.verdict is Verdict.KNOWN
    std = [d.evidence[0].std["amount"] for d in (plain, edged)]
    assert std[1] == pytest.approx(std[0] / SHARE, rel=1e-3)
    assert edged.evidence[0].values["amount"] == pytest.approx(3.0, abs=0.2)


def test_a_baseline_recalled_has_the_derivatives_that_it_was_certified_with(columns):
    base, one, noise = columns
    problem = Edged(base, {"one": one}, dataclasses.replace(manoeuvres(6, 100), value=noise))
    memory = Memory()
    found = fit_baseline(problem, Settings(), memory)
    recalled = fit_baseline(problem, Settings(), Memory(memory.entries))
    np.testing.assert_array_equal(recalled.wide, found.wide)
    np.testing.assert_allclose(recalled.jacobian, found.jacobian, rtol=1e-12)


def test_the_step_error_is_taken_at_the_fit_where_halving_the_step_changes_chi_square(columns):
    base, one, noise = columns
    problem = Coarse(base, {"one": one}, dataclasses.replace(manoeuvres(6, 100), value=base[:, 0] * 4.0 + noise))
    memory = Memory()
    found = fit_baseline(problem, Settings(), memory)
    assert not found.problems and found.own_step_error and problem.renewed_at[0] == pytest.approx(4.0, abs=0.2)
    again = Coarse(base, {"one": one}, problem.observations)
    recalled = fit_baseline(again, Settings(), Memory(memory.entries))
    assert recalled.own_step_error and again.renewed_at[0] == pytest.approx(found.u[0])


def test_without_that_there_is_no_certificate(columns, monkeypatch):
    base, one, noise = columns
    monkeypatch.setattr(Coarse, "renew_step_error", lambda self, u, least=1.0: False)
    problem = Coarse(base, {"one": one}, dataclasses.replace(manoeuvres(6, 100), value=base[:, 0] * 4.0 + noise))
    assert "halving the time step" in fit_baseline(problem, Settings(), Memory()).problems[0]


class Uncertain(Linear):
    """A problem in which no fit with a candidate earns its certificate."""

    def certificate(self, u, free):
        return {"half_step_chi2": 1e9 if np.any(np.isin(free, self.candidates["one"])) else 0.0}


def test_what_would_only_help_and_has_no_certificate_is_left_out(columns):
    """That something is missing stands on the baseline; only the helper is not to be told."""
    base, one, noise = columns
    hidden = np.random.default_rng(6).normal(size=600)
    problem = Uncertain(base, {"one": one}, dataclasses.replace(manoeuvres(6, 100), value=3.0 * (one + hidden) + noise))
    found, search = diagnose(problem, Settings(draws=200))
    assert found.verdict is Verdict.UNKNOWN and not found.effects and search.chosen is search.base
    assert "The fit with one has no certificate (halving the time step" in found.sentence
    assert found.error_after == found.error_before
    assert next(e for e in found.evidence if e.effect == "one").status != "accepted"


def test_what_explains_all_and_has_no_certificate_is_not_named(columns):
    base, one, noise = columns
    problem = Uncertain(base, {"one": one}, dataclasses.replace(manoeuvres(6, 100), value=3.0 * one + noise))
    found = diagnose(problem, Settings(draws=200))[0]
    assert found.verdict is Verdict.BAD_FIT and not found.effects
