"""Amounts of missing effects tried at once, where a model is so far from its data that derivatives may mislead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lunar_mjx.inference.fitting import Fit
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.score import Score

AMOUNTS = np.array([0.1, 0.3, 1.0, 2.0, 3.0])
"""Amounts of a candidate, in terms of its nominal one, that are tried where derivatives may mislead."""
_USUAL = np.array([1.0, 2.0])
"""Amounts, in terms of the nominal one, that are tried of candidates which scores have ranked low."""
MAX_LEFT_FRACTION = 0.5
"""A refit of a candidate is tried if an amount of it, without any refit, leaves at most this share of chi-square."""
_FEW = 2
"""Candidates that are refitted for that."""
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
    if not _misleading(problem, fit):
        return {}
    given = _given(problem, fit, effects)
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


def overlooked(problem: Problem, fit: Fit, effects: Sequence[str], others: Sequence[Score]) -> list[Score]:
    """Candidates that scores far from the data have ranked too low: a usual amount of one takes off most of chi-square.

    Those with several amplitudes have no usual amount, and are left to their scores. (A delay of 119 ms was not among
    the eight best scores of a baseline at 38 sigma, which had moved far to make up for it; 100 ms of it in the model as
    given leave 7 % of chi-square.)

    Args:
      problem: model and measurements. fit: of the model with some effects. effects: their names.
      others: scores of the candidates that are not to be refitted otherwise.
    """
    if not _misleading(problem, fit):
        return []
    blocks = [_usual(problem, fit, effects, s.effect, (float(np.sign(s.amount[0])),)) for s in others]
    owner = [s for s, block in zip(others, blocks, strict=True) for _ in block]
    if not owner:
        return []
    _, chi2 = Objective(problem, problem.free(effects), fit.fitted).residuals(np.concatenate(blocks))
    ahead = [(float(c), k) for k, c in enumerate(chi2) if c < MAX_LEFT_FRACTION * fit.chi2]
    return list(dict.fromkeys(owner[k] for _, k in sorted(ahead)))[:_FEW]


def foresee_overlooked(problem: Problem, fit: Fit, effects: Sequence[str], names: Sequence[str]) -> None:
    """`overlooked` may be asked for these candidates."""
    if _misleading(problem, fit):
        for name in names:
            problem.foresee(_usual(problem, fit, effects, name, (1.0, -1.0)))


def _usual(problem: Problem, fit: Fit, effects: Sequence[str], name: str, signs: Sequence[float]) -> np.ndarray:
    """(k, coordinates) usual amounts of a candidate, if it has one amplitude, in the model as it was given."""
    places = [i for i in problem.candidates[name] if problem.coordinates[i].amplitude]
    if len(places) != 1:
        return np.zeros((0, len(fit.u)))
    low, high = problem.coordinates[places[0]].bounds()
    tried = np.concatenate([sign * _USUAL for sign in signs])
    tried = tried[(tried > low) & (tried < high)]
    rows = np.repeat(_given(problem, fit, effects)[None], len(tried), axis=0)
    rows[:, places[0]] = tried
    return rows


def _misleading(problem: Problem, fit: Fit) -> bool:
    return not problem.cheap_jacobian and fit.chi2 >= _FAR * fit.fitted.sum()


def _given(problem: Problem, fit: Fit, effects: Sequence[str]) -> np.ndarray:
    """(coordinates,) the model as it was given, with the effects that it has got since."""
    given = problem.origin()
    for e in effects:
        given[problem.candidates[e]] = fit.u[problem.candidates[e]]
    return given


def _amounts(problem: Problem, places: Sequence[int], s: Score) -> np.ndarray:
    """(k, amplitudes) amounts to try: shares of the linear one; for one amplitude, multiples of its nominal size."""
    if len(places) != 1:
        return np.array([1.0, 0.3])[:, None] * np.clip(s.amount, -3.0, 3.0)
    low, high = problem.coordinates[places[0]].bounds()
    tried = np.sign(s.amount[0]) * AMOUNTS
    return tried[(tried > low) & (tried < high), None]
