"""Amounts tried at once: only far from the data, and for the delay whose derivative at zero says nothing."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.scan import foresee_overlooked, overlooked, scan
from lunar_mjx.inference.score import Score
from tests.inference.toy_problem import Linear, manoeuvres

TIME = np.arange(400) * 0.01


class Late(Linear):
    """A ramped square wave, late by the effect's amount in tens of samples; whole samples only."""

    cheap_jacobian = False

    def predict(self, u):
        u = np.atleast_2d(u)
        shift = np.round(10.0 * u[:, 1:]).astype(int)
        wave = 100.0 * np.clip(5.0 * np.sin(2.0 * TIME), -1.0, 1.0)
        return u[:, :1] + wave[np.clip(np.arange(400)[None] - shift, 0, 399)]


def problem(delay: float, noise: float = 1.0) -> Late:
    rng = np.random.default_rng(0)
    empty = manoeuvres(4, 100)
    late = Late(np.ones((400, 1)), {"delay": np.zeros(400)}, empty)
    value = late.predict(np.array([0.0, delay]))[0] + noise * rng.standard_normal(400)
    late.observations = dataclasses.replace(empty, value=value)
    return late


def faint(sign: float) -> Score:
    return Score("delay", np.zeros((400, 1)), 10.0, 1.0, np.array([sign * 1e-3]), 5.0, 3.0)


def test_the_best_amount_is_found_where_the_derivative_is_silent():
    late = problem(2.0)
    base = fit(late, late.free(), starts=1, certify=False)
    chi2, place = scan(late, base, (), [faint(1.0)])["delay"]
    assert place[1] == 2.0 and chi2 < 0.01 * base.chi2


def test_near_the_data_derivatives_are_trusted():
    late = problem(0.0)
    base = fit(late, late.free(), starts=1, certify=False)
    assert scan(late, base, (), [faint(1.0)]) == {}


def test_what_scores_rank_low_is_refitted_where_a_usual_amount_takes_off_most():
    late = problem(1.0)
    base = fit(late, late.free(), starts=1, certify=False)
    asked = faint(1.0)
    assert overlooked(late, base, (), [asked]) == [asked]
    assert overlooked(late, base, (), []) == []
    wrong = faint(-1.0)  # an amount on the wrong side
    assert overlooked(late, base, (), [wrong]) == []


def test_what_may_be_asked_for_is_foreseen_with_either_sign():
    late, foreseen = problem(1.0), []
    late.foresee = lambda rows, which=None: foreseen.extend(rows[:, 1])
    base = fit(late, late.free(), starts=1, certify=False)
    foresee_overlooked(late, base, (), ["delay"])
    assert foreseen == [1.0, 2.0, -1.0, -2.0]
    several, late.coordinates = late.coordinates, (*late.coordinates, late.coordinates[1])
    late.candidates["delay"] = np.array([1, 2])
    base = dataclasses.replace(base, u=np.zeros(3))
    foreseen.clear()
    foresee_overlooked(late, base, (), ["delay"])
    late.coordinates = several
    assert foreseen == []  # no amount is usual where there are several amplitudes


def test_near_the_data_and_in_tables_scores_are_trusted():
    late = problem(0.0)
    assert overlooked(late, fit(late, late.free(), starts=1, certify=False), (), [faint(1.0)]) == []
    far = problem(1.0)
    base = fit(far, far.free(), starts=1, certify=False)
    far.cheap_jacobian = True
    assert overlooked(far, base, (), [faint(1.0)]) == []
