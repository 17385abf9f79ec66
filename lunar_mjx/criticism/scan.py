"""Amounts of missing effects tried at once, where a model is so far from its data that derivatives may mislead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lunar_mjx.criticism.fitting import Fit
from lunar_mjx.criticism.objective import Objective
from lunar_mjx.criticism.problem import Problem
from lunar_mjx.criticism.score import Score

AMOUNTS = np.array([0.1, 0.3, 1.0, 2.0, 3.0])
"""Amounts of a candidate, in terms of its nominal one, that are tried where derivatives may mislead."""
_FAR = 4.0
"""Chi-square per observation from which a model is so far from the data that derivatives may mislead."""


def scan(
    problem: Problem, fit: Fit, effects: Sequence[str], new: Sequence[Score]
) -> dict[str, tuple[float, np.ndarray]]:
    """For each candidate the least chi-square (and where) that an amount of it reaches without any refit, all at once.

    Derivatives at the null say little about effects that act in jumps: a delay moves a held command past the next
    sample, or does nothing. And a model that misfits may have gone to where no effect can help, so that the model as it
    was given is a start, too. For drives far from their data; tables are fitted from several starts.

    Args:
      problem: model and measurements. fit: of the model with some effects. effects: their names.
      new: scores of the candidates.

    Returns:
      By candidate, chi-square and (coordinates,) place; empty where derivatives are trusted.
    """
    if problem.cheap_jacobian or fit.chi2 < _FAR * fit.fitted.sum():
        return {}
    given = problem.origin()
    for e in effects:
        given[problem.candidates[e]] = fit.u[problem.candidates[e]]
    rows, owner = [], []
    for s in new:
        places = [i for i in problem.candidates[s.effect] if problem.coordinates[i].amplitude]
        for start in (fit.u, given):
            for amount in _amounts(problem, places, s):
                rows.append(start.copy())
                rows[-1][places] = amount
                owner.append(s.effect)
    if not rows:
        return {}
    _, chi2 = Objective(problem, problem.free(effects), fit.fitted).residuals(np.array(rows))
    best: dict[str, tuple[float, np.ndarray]] = {}
    for effect, row, value in zip(owner, rows, chi2, strict=True):
        if effect not in best or value < best[effect][0]:
            best[effect] = float(value), row
    return best


def _amounts(problem: Problem, places: Sequence[int], s: Score) -> np.ndarray:
    """(k, amplitudes) amounts to try: shares of the linear one; for one amplitude, multiples of its nominal size."""
    if len(places) != 1:
        return np.array([1.0, 0.3])[:, None] * np.clip(s.amount, -3.0, 3.0)
    low, high = problem.coordinates[places[0]].bounds()
    tried = np.sign(s.amount[0]) * AMOUNTS
    return tried[(tried > low) & (tried < high), None]
