"""What is still to be asked of a model of drives that reached the noise: is it all, and is it the simplest?

Noise as large as a log's hides a second effect, and an effect with many parameters can do what one with few does. Both
show at the fit, where derivatives are right, and not at the baseline from which the effects were scored.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lunar_mjx.inference.fitting import Fit
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.scan import AMOUNTS
from lunar_mjx.inference.score import SEPARABLE, Score, leash, outside, span

if TYPE_CHECKING:
    from lunar_mjx.inference.problem import Problem

_TAKEN = 0.45
"""Share of a candidate's signature that an effect in the model may leave of it: below, one can stand for the other."""
_SHARES = np.array([0.5, 1.0, 1.5])
"""Of the amount that does what the effect in the model does: where a refit may start."""
_MANY = 4
"""Parameters of an effect from which amounts of simpler ones are tried in its place, where derivatives may mislead."""
_MOST = 0.5
"""Share of what the effect takes off that such an amount must, without any refit."""
_SIMPLER = 25.0
"""Chi-square, beyond ln n for each parameter, by which a simpler effect must be ahead to be named in its place."""


@dataclasses.dataclass(frozen=True, eq=False)
class Stand:
    """A candidate that may stand for an effect in the model.

    Attributes:
      effects: of the model with the one in place of the other, which comes last. start: (coordinates,) of its refit.
      scored: its score.
    """

    effects: tuple[str, ...]
    start: np.ndarray
    scored: Score


def stands(problem: Problem, fit: Fit, effects: Sequence[str], scores: Sequence[Score]) -> list[Stand]:
    """Candidates whose signature one effect of a fitted model takes up, closest first.

    Args:
      problem: model and measurements. fit: with the effects. scores: of the other candidates at this fit.
    """
    keep = fit.fitted
    found: list[tuple[float, Stand]] = []
    for effect in effects:
        mine = np.isin(fit.free, problem.candidates[effect])
        others, prior = fit.jacobian[keep][:, ~mine], leash(problem, fit)[~mine]
        basis = span(others, prior)
        does = outside((fit.jacobian[keep][:, mine] @ fit.u[fit.free[mine]])[:, None], basis)
        for s in scores:
            if s.columns is None or not s.columns.size:
                continue
            signature, target = outside(s.columns[keep], basis), does[:, 0]
            length = float(np.linalg.norm(signature))
            if length < SEPARABLE or s.length > _TAKEN * length:
                continue
            amount = np.linalg.lstsq(signature, target, rcond=1e-6)[0]
            alike = float(np.linalg.norm(signature @ amount)) / max(float(np.linalg.norm(target)), 1e-30)
            rest = tuple(e for e in effects if e != effect)
            start = fit.u.copy()
            start[problem.candidates[effect]] = 0.0
            places = [i for i in problem.candidates[s.effect] if problem.coordinates[i].amplitude]
            start[places] = _within(problem, places, amount)
            found.append((alike, Stand((*rest, s.effect), start, s)))
    return [stand for alike, stand in sorted(found, key=lambda f: -f[0]) if alike**2 > 1.0 - _TAKEN**2]


def tried_in_place(problem: Problem, fit: Fit, effects: Sequence[str], scores: Sequence[Score]) -> list[Stand]:
    """Candidates of one amount that do most of what an effect of many parameters does, by simulation.

    A delay of held commands has no derivative, and a clock that is late by a step of the course has a wrong one.

    Args:
      problem, fit, effects, scores: as for `stands`.
    """
    goal = Objective(problem, problem.free(effects), fit.fitted)
    found: list[tuple[float, Stand]] = []
    for effect in effects:
        own = problem.candidates[effect]
        if np.isin(fit.free[_felt(fit)], own).sum() < _MANY:
            continue
        without = fit.u.copy()
        without[own] = 0.0
        rows, owner = [without], [-1]
        for n, s in enumerate(scores):
            places = [i for i in problem.candidates[s.effect] if problem.coordinates[i].amplitude]
            if len(places) != 1 or s.effect in effects:
                continue
            low, high = problem.bounds(np.array(places))
            for amount in np.concatenate([-AMOUNTS, AMOUNTS]):
                if low[0] < amount < high[0]:
                    rows.append(without.copy())
                    rows[-1][places] = amount
                    owner.append(n)
        _, chi2 = goal.residuals(np.array(rows))
        rest = tuple(e for e in effects if e != effect)
        for n in set(owner[1:]):
            mine = np.flatnonzero(np.array(owner) == n)
            k = mine[np.argmin(chi2[mine])]
            if chi2[0] - chi2[k] > _MOST * (chi2[0] - fit.chi2):
                found.append((float(chi2[k]), Stand((*rest, scores[n].effect), rows[k], scores[n])))
    return [stand for _, stand in sorted(found, key=lambda f: f[0])]


def _within(problem: Problem, places: Sequence[int], amount: np.ndarray) -> np.ndarray:
    low, high = problem.bounds(np.array(places, int))
    return np.clip(amount, low, high)


def best_start(problem: Problem, stand: Stand) -> np.ndarray:
    """(coordinates,) the start, with the amount that fits best without a refit."""
    places = [i for i in problem.candidates[stand.scored.effect] if problem.coordinates[i].amplitude]
    rows = np.repeat(stand.start[None], len(_SHARES), axis=0)
    rows[:, places] = [_within(problem, places, share * stand.start[places]) for share in _SHARES]
    fitted = problem.observations.in_split("fit")
    _, chi2 = Objective(problem, problem.free(stand.effects), fitted).residuals(rows)
    return rows[int(np.argmin(chi2))]


def simpler(one: Fit, other: Fit) -> bool:
    """Whether one fit explains as much as another with so many fewer parameters that it is to be preferred."""
    penalty = float(np.log(one.fitted.sum()))
    return one.chi2 + penalty * _parameters(one) + _SIMPLER < other.chi2 + penalty * _parameters(other)


def _parameters(fit: Fit) -> int:
    """Parameters that the measurements feel."""
    return len(_felt(fit))


def _felt(fit: Fit) -> np.ndarray:
    return np.flatnonzero(np.linalg.norm(fit.jacobian[fit.fitted], axis=0) > 1e-6)
