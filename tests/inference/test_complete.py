"""What a model of drives at the noise still owes: a second effect below the noise, and a simpler one in its place."""

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis import search as searching
from lunar_mjx.diagnosis.attribute import diagnose
from lunar_mjx.diagnosis.refit import Candidate, Settings
from lunar_mjx.diagnosis.search import search
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.inference.complete import best_start, simpler, stands, tried_in_place
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.held_out import noise_test
from lunar_mjx.inference.score import score, signatures
from tests.inference.toy_problem import Linear, coordinate, manoeuvres

LOGS, SAMPLES, WIDE = 6, 150, 7


class Dear(Linear):
    """A linear problem whose rows count as dear; `wide` has several parameters, `narrow` does what their sum does."""

    cheap_jacobian = False

    def __init__(self, rng: np.random.Generator):
        count = LOGS * SAMPLES
        wide = rng.normal(size=(count, WIDE))
        matrix = {"small": rng.normal(size=count), "narrow": wide.sum(axis=1) / WIDE}
        super().__init__(rng.normal(size=(count, 2)), matrix, manoeuvres(LOGS, SAMPLES))
        first = self.matrix.shape[1]
        self.matrix = np.column_stack([self.matrix, wide])
        self.coordinates = (*self.coordinates, *(coordinate("wide", f"w{i}", True) for i in range(WIDE)))
        self.candidates = {**self.candidates, "wide": np.arange(first, first + WIDE)}


def measured(problem: Dear, rng: np.random.Generator, **amounts: float) -> Dear:
    """The problem with measurements of these effects and unit noise."""
    u = np.zeros(len(problem.coordinates))
    for name, amount in amounts.items():
        u[problem.candidates[name]] = amount
    problem.observations.value[:] = problem.predict(u)[0] + rng.normal(size=len(problem.observations))
    return problem


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.mark.parametrize(("amount", "named"), [(0.35, {"narrow", "small"}), (0.0, {"narrow"})])
def test_a_second_effect_below_the_noise_is_found(rng, amount, named) -> None:
    problem = measured(Dear(rng), rng, narrow=8.0, small=amount)
    del problem.candidates["wide"]
    found = search(problem, Settings(draws=500))
    first = next(c for c in found.tried if c.effects == ("narrow",))
    assert first.noise.passes
    assert set(found.chosen.effects) == named


def test_an_effect_with_many_parameters_gives_way_to_one_that_does_the_same(rng) -> None:
    problem = measured(Dear(rng), rng, narrow=8.0)
    wide = fit(problem, problem.free(["wide"]), starts=1, certify=False)
    scores = score(problem, wide, signatures(problem, wide, ["narrow", "small"]), 100)
    (stand,) = stands(problem, wide, ("wide",), scores)
    assert stand.effects == ("narrow",)
    start = best_start(problem, stand)
    assert start[problem.candidates["narrow"]] == pytest.approx(8.0, rel=0.2)
    assert not start[problem.candidates["wide"]].any()
    narrow = fit(problem, problem.free(["narrow"]), start, starts=1, certify=False)
    assert simpler(narrow, wide)
    assert not simpler(wide, narrow)


def test_an_effect_that_needs_its_parameters_keeps_its_name(rng) -> None:
    problem = Dear(rng)
    problem.observations.value[:] = 3.0 * problem.matrix[:, -1] - 2.0 * problem.matrix[:, -2]
    problem.observations.value[:] += rng.normal(size=len(problem.observations))
    found = search(problem, Settings(draws=500), memory=Memory())
    assert found.chosen.effects == ("wide",)


class Held(Dear):
    """`narrow` acts in jumps of a half: its derivative is zero, as that of a delay of held commands."""

    def predict(self, u):
        u = np.array(np.atleast_2d(u), float)
        place = self.candidates["narrow"]
        u[:, place] = 8.0 * np.round(2.0 * u[:, place]) / 2.0
        return super().predict(u)

    def jacobian(self, u, which):
        return np.where(np.isin(which, self.candidates["narrow"]), 0.0, super().jacobian(u, which))


def test_an_effect_without_a_derivative_is_tried_in_place_of_one_with_many_parameters(rng) -> None:
    problem = measured(Held(rng), rng, narrow=1.0)
    wide = fit(problem, problem.free(["wide"]), starts=1, certify=False)
    scores = score(problem, wide, signatures(problem, wide, ["narrow", "small"]), 100)
    found = tried_in_place(problem, wide, ("wide",), scores)
    assert [stand.effects for stand in found] == [("narrow",)]
    assert found[0].start[problem.candidates["narrow"]] == pytest.approx(1.0)


def test_nothing_is_tried_in_place_of_an_effect_of_one_parameter(rng) -> None:
    problem = measured(Dear(rng), rng, small=3.0)
    small = fit(problem, problem.free(["small"]), starts=1, certify=False)
    scores = score(problem, small, signatures(problem, small, ["narrow"]), 100)
    assert tried_in_place(problem, small, ("small",), scores) == []


def test_a_name_that_only_a_dropped_effect_kept_free_of_patterns_is_not_given(monkeypatch):
    """Two effects together leave nothing, one of them is not worth its place, and without it a pattern shows."""
    rng = np.random.default_rng(2)
    base, one, two = rng.standard_normal((360, 3)), np.sin(np.arange(360) * 0.3), np.cos(np.arange(360) * 0.7)
    value = 2.0 * one + 0.05 * two + rng.standard_normal(360)
    problem = Linear(base, {"one": one, "two": two}, dataclasses.replace(manoeuvres(6, 60), value=value))

    def with_both(problem, base, grown, settings, tried):
        both = fit(problem, problem.free(["one", "two"]))
        return Candidate(("one", "two"), both, noise_test(problem, both), 0.0, 0.0)

    def verdict(left: float) -> tuple[Verdict, tuple[str, ...]]:
        second = int(problem.candidates["two"][0])
        monkeypatch.setattr(searching, "_reaching", with_both)
        monkeypatch.setattr(searching, "pattern", lambda problem, f: left if second not in f.free else 0.0)
        found, _ = diagnose(problem)
        return found.verdict, found.effects

    assert verdict(0.0) == (Verdict.KNOWN, ("one",))
    assert verdict(60.0) == (Verdict.UNKNOWN, ("one",))
