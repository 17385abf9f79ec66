"""What a refit leaves of a signature, and blocks of dependent measurements."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.score import blocks, leash, project
from tests.inference.toy_problem import Linear, manoeuvres

RNG = np.random.default_rng(0)
LOGS, SAMPLES = 4, 100
BASE = RNG.standard_normal((LOGS * SAMPLES, 3))
EFFECTS = {"slow": np.sin(np.arange(LOGS * SAMPLES) * 0.02), "fast": np.sin(np.arange(LOGS * SAMPLES) * 0.7)}


def test_projection_leaves_nothing_that_a_refit_takes():
    mixed = BASE @ np.array([[1.0], [-2.0], [0.5]])
    assert np.linalg.norm(project(mixed, BASE, np.full(3, 1e-6))) < 1e-4
    left = project(EFFECTS["slow"][:, None], BASE, np.full(3, 1e-6))[: len(BASE)]
    np.testing.assert_allclose(BASE.T @ left, 0.0, atol=1e-8)


def test_a_tight_prior_keeps_what_a_loose_one_gives_away():
    column = BASE[:, :1]
    assert np.linalg.norm(project(column, BASE, np.full(3, 1e4))) > 0.99 * np.linalg.norm(column)


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
        base = fit(problem, problem.free(), np.zeros(2), starts=1)
        base = dataclasses.replace(base, u=np.zeros(2), residual=observations.value)
        left = project(slow[:, None], nuisance[:, None], leash(problem, base))[: len(slow)]
        share[reach] = np.linalg.norm(left) / np.linalg.norm(slow)
    assert share[1e6] < 0.1 and share[2.0] > 0.9
