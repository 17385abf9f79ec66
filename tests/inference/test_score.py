"""Score tests with known answers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.score import _to_z, blocks, cosines, project, score, signatures
from tests.inference.toy_problem import Linear, manoeuvres

RNG = np.random.default_rng(0)
LOGS, SAMPLES = 4, 100
BASE = RNG.standard_normal((LOGS * SAMPLES, 3))
EFFECTS = {"slow": np.sin(np.arange(LOGS * SAMPLES) * 0.02), "fast": np.sin(np.arange(LOGS * SAMPLES) * 0.7)}
EFFECTS["faint"] = 0.05 * RNG.standard_normal(LOGS * SAMPLES)


def scored(value: np.ndarray, draws: int = 200):
    observations = dataclasses.replace(manoeuvres(LOGS, SAMPLES), value=value)
    problem = Linear(BASE, EFFECTS, observations)
    base = fit(problem, problem.free(), starts=1)
    found = score(problem, base, signatures(problem, base, list(EFFECTS)), draws)
    return {s.effect: s for s in found}


def test_projection_leaves_nothing_that_a_refit_takes():
    mixed = BASE @ np.array([[1.0], [-2.0], [0.5]])
    assert np.linalg.norm(project(mixed, BASE, np.full(3, 1e-6))) < 1e-4
    left = project(EFFECTS["slow"][:, None], BASE, np.full(3, 1e-6))[: len(BASE)]
    np.testing.assert_allclose(BASE.T @ left, 0.0, atol=1e-8)


def test_a_tight_prior_keeps_what_a_loose_one_gives_away():
    column = BASE[:, :1]
    assert np.linalg.norm(project(column, BASE, np.full(3, 1e4))) > 0.99 * np.linalg.norm(column)


def test_the_amount_of_a_planted_effect_is_unbiased():
    rng = np.random.default_rng(3)
    amounts = []
    for _ in range(60):
        value = BASE @ [1.0, 2.0, 3.0] + 1.5 * EFFECTS["fast"] + rng.standard_normal(len(BASE))
        amounts.append(float(scored(value, 20)["fast"].amount[0]))
    error = 1.0 / np.linalg.norm(EFFECTS["fast"]) / np.sqrt(60)
    assert np.mean(amounts) == pytest.approx(1.5, abs=4.0 * error)


def test_the_planted_effect_leads_and_the_faint_one_is_not_tested():
    value = 1.0 * EFFECTS["slow"] + np.random.default_rng(4).standard_normal(len(BASE))
    found = scored(value)
    assert max(found.values(), key=lambda s: s.chi2).effect == "slow"
    assert found["slow"].p <= 0.01
    assert found["faint"].length < 5.0
    assert found["faint"].p == 1.0


def test_pure_noise_is_significant_as_often_as_stated():
    rng = np.random.default_rng(5)
    smallest = [min(s.p for s in scored(rng.standard_normal(len(BASE)), 200).values()) for _ in range(150)]
    assert np.mean(np.array(smallest) <= 0.05) < 0.11  # 3.4 standard deviations above 5 %
    assert np.mean(np.array(smallest) <= 0.5) > 0.3


def test_a_residual_larger_than_its_noise_is_not_evidence_by_itself():
    rng = np.random.default_rng(6)
    smallest = [min(s.p for s in scored(5.0 * rng.standard_normal(len(BASE)), 200).values()) for _ in range(60)]
    assert np.mean(np.array(smallest) <= 0.01) <= 0.1


def test_twins_are_alike_and_strangers_are_not():
    observations = manoeuvres(LOGS, SAMPLES)
    problem = Linear(BASE, {**EFFECTS, "twin": EFFECTS["slow"] + BASE[:, 0]}, observations)
    base = fit(problem, problem.free(), starts=1)
    near = cosines(score(problem, base, signatures(problem, base, list(problem.candidates)), 20))
    assert near["slow"]["twin"] == pytest.approx(1.0, abs=1e-4)
    assert near["slow"]["fast"] < 0.3


def test_blocks_follow_the_correlation_time():
    o = manoeuvres(1, 4000)
    rng = np.random.default_rng(7)
    white = rng.standard_normal(4000)
    slow = np.convolve(white, np.exp(-np.arange(2000) / 200.0))[:4000]
    every = np.ones(4000, bool)
    many, few = blocks(o, white, every).max() + 1, blocks(o, slow, every).max() + 1
    assert few < many
    assert 4000 * 0.1 / few >= 5.0 * 10.0  # seconds: five correlation times or more


def test_a_nuisance_takes_in_no_effect_by_moving_past_its_bounds():
    """The nuisance has nearly the effect's shape, and would have to move to fifty times its bound."""
    slow = EFFECTS["slow"]
    nuisance = 0.02 * slow + 0.001 * RNG.standard_normal(len(slow))
    observations = dataclasses.replace(manoeuvres(LOGS, SAMPLES), value=200.0 * slow)
    share = {}
    for reach in (1e6, 2.0):
        problem = Linear(nuisance[:, None], {"slow": slow}, observations, low=-reach, high=reach)
        base = fit(problem, problem.free(), np.zeros(2), starts=1, certify=False)
        base = dataclasses.replace(base, u=np.zeros(2), residual=observations.value)
        share[reach] = score(problem, base, signatures(problem, base, ["slow"]), 50)[0].share
    assert share[1e6] < 0.1 and share[2.0] > 0.9


def test_z_of_overwhelming_evidence_is_a_number():
    z = _to_z(np.array([4.0, 500.0, 1e3, 1e4, 1e8]), 2)
    assert np.all(np.isfinite(z)) and np.all(np.diff(z) > 0.0)
    assert z[-1] == pytest.approx(1e4, rel=1e-3)


class _Bent(Linear):
    """One candidate that acts by its square."""

    def predict(self, u):
        u = np.atleast_2d(u).copy()
        u[:, 1] = u[:, 1] ** 2
        return super().predict(u)

    def jacobian(self, u, which):
        return self.matrix[:, which] * np.where(np.array(which) == 1, 2.0 * u[1], 1.0)


class _Eager(_Bent):
    eager = True


def test_secants_are_the_same_whether_taken_beside_the_derivatives_or_after():
    x = np.linspace(0.0, 1.0, 60)
    found = []
    for kind in (_Bent, _Eager):
        problem = kind(np.ones((60, 1)), {"square": x, "plain": x**2}, manoeuvres(3, 20))
        base = fit(problem, problem.free(), starts=1)
        found.append(signatures(problem, base, ["square", "plain"]))
    assert np.array_equal(found[0]["square"][:, 0], x)
    for name, columns in found[0].items():
        assert np.array_equal(columns, found[1][name])
