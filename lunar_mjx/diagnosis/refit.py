"""Refits of a model with missing effects: which are worth it, and from where they start."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.unknown_inputs.patterns import Pattern
from lunar_mjx.inference.descent import Descent, Outdone, Rival
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import Fit, fit, foreseen_fit, step_too_long
from lunar_mjx.inference.held_out import NoiseTest, gain, noise_test
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.scan import scan
from lunar_mjx.inference.score import Score, score, signatures

_RIVAL = 0.8
"""Share of what an effect takes off that score or scan must promise another to be refitted as its rival. (Of ten
rivals of Coulomb friction in two campaigns eight took off what was promised within 3 % of that effect's share; gravity
took off 14 % more, grousers nothing.)"""

MAX_LEFT_FRACTION = 0.5
"""A refit explains most of a misfit if at most this share of the chi-square beyond the noise remains."""
_RENEWALS = 2
"""Times that the error of the time step is taken anew at most: at a fit with an error of its own it is nearly right."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a diagnosis is made.

    Attributes:
      alpha: family-wise error rate of the score tests.
      share: of the excess over the noise; a candidate that explains more of it is refitted whatever its score, because
        the other missing effects of a model that fails badly drown every score. Held-out manoeuvres judge it.
      chi2: least drop of chi-square by an effect that is named.
      gain_se: held-out gain in standard errors that an effect must earn.
      refits: effects refitted at each level. beam: models carried from level to level. most: effects named at most.
      confounded: |cos| from which two effects count as near relatives.
      same: differences of chi-square below which two effects explain the data alike.
      pattern: log evidence of a smooth unknown input in the residual from which a model counts as failing, however
        small the residual. Of 35 tables with the true model none left more than 4.8, at thrice the usual disturbance
        14; three wrong models whose residual passed for noise left 30 to 78. (For tables.)
      pattern_p: family-wise p value of smooth unknown inputs below which the same holds of drives, if they explain
        `chi2`, too.
      explained: share of the excess over the noise that the effects named must explain where they do not reach it.
      starts: of the baseline fit. draws: of the bootstrap. seed: of both.
    """

    alpha: float = 0.01
    share: float = 0.05
    chi2: float = 25.0
    gain_se: float = 2.0
    refits: int = 4
    beam: int = 2
    most: int = 4
    confounded: float = 0.9
    same: float = 12.0
    pattern: float = 20.0
    pattern_p: float = 0.001
    explained: float = 0.995
    starts: int = 4
    draws: int = 2000
    seed: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class Candidate:
    """A refitted set of effects.

    Attributes:
      effects: names, in the order of adding. fit: the refit. noise: whether its residual is as small as the noise.
      gain, gain_se: held-out gain over the parent set and its standard error.
      patterned: whether what is left is small, but no noise: some smooth unknown input has it. evidence: log evidence
        of that input, for tables.
      pattern: what smooth unknown inputs explain of the residual of drives, where that was asked.
    """

    effects: tuple[str, ...]
    fit: Fit
    noise: NoiseTest
    gain: float
    gain_se: float
    patterned: bool = False
    evidence: float = 0.0
    pattern: Pattern | None = None

    @property
    def at_noise(self) -> bool:
        """Whether nothing is left but noise, as far as can be told."""
        return self.noise.passes and not self.patterned


def refit_all(
    problem: Problem, parent: Candidate, new: Sequence[Score], settings: Settings, memory: Memory
) -> list[Candidate]:
    """Refits the parent with each of the new effects, the best first; others only as far as they may still rival it.

    Where rows are free, all refits begin together and share their batches. Only the best takes Jacobians with its
    residuals: it is the one that may end the others.
    """
    scans = scan(problem, parent.fit, parent.effects, new)
    new = sorted(new, key=lambda s: scans[s.effect][0] if s.effect in scans else parent.fit.chi2 - s.chi2)

    def one(s: Score, rival: Rival | float = np.inf, **how: Any) -> Candidate:
        chi2, start = scans.get(s.effect, (np.inf, None))
        better = chi2 < parent.fit.chi2 - s.chi2
        return refit(problem, parent, (*parent.effects, s.effect), s, memory, rival, start if better else None, **how)

    def beaten(s: Score, reached: float) -> bool:
        """Whether an effect falls far short of one that reaches the noise."""
        promised = max(s.chi2, parent.fit.chi2 - scans.get(s.effect, (np.inf, None))[0])
        return promised < _RIVAL * (parent.fit.chi2 - reached)

    if not problem.eager or len(new) < 2:
        grown: list[Candidate] = []
        for s in new:
            reached = min((c.fit.chi2 for c in grown if c.noise.passes), default=np.inf)
            if problem.cheap_jacobian or not beaten(s, reached):
                grown.append(one(s, reached + settings.same))
        return grown
    with problem.together(len(new)) as leave:
        rival = Rival()

        def lead(at: Descent) -> bool:
            goal = Objective(problem, problem.free((*parent.effects, new[0].effect)), parent.fit.fitted)
            if noise_test(problem, foreseen_fit(goal, at)).passes:
                rival.lower(at.chi2 + settings.same)
            return False

        def tracked(s: Score) -> Candidate | None:
            first = s is new[0]
            try:
                outdone = lead if first else lambda _: beaten(s, rival.chi2 - settings.same)
                found = one(s, rival, eager=first, outdone=outdone)
                if found.noise.passes:
                    rival.lower(found.fit.chi2 + settings.same)
                return found
            except Outdone:
                return None
            finally:
                leave()

        with concurrent.futures.ThreadPoolExecutor(len(new)) as pool:
            return [c for c in pool.map(tracked, new) if c is not None]


def refit(
    problem: Problem,
    parent: Candidate,
    effects: tuple[str, ...],
    scored: Score | None,
    memory: Memory,
    rival: Rival | float = np.inf,
    start: np.ndarray | None = None,
    **how: Any,
) -> Candidate:
    """Refits from a start; without one from the parent with the new effect at its linear estimate, and from a third of
    it where that fails; `how` are further arguments of `fit`."""
    free = problem.free(effects)
    found = memory.recall(problem, effects)
    if found is not None:
        value, se = gain(problem, parent.fit, found)
        return Candidate(effects, found, noise_test(problem, found), value, se)
    places = [i for i in problem.candidates[effects[-1]] if problem.coordinates[i].amplitude]
    if start is not None:
        found = fit(problem, free, start, starts=1, certify=False, rival=rival, **how)
    elif scored is not None and scored.columns is not None and not problem.cheap_jacobian:
        # The score has taken all derivatives at the parent's fit: the first step costs nothing.
        known = parent.fit.residual, _joined(problem, parent.fit, free, places, scored.columns)
        found = fit(problem, free, parent.fit.u, starts=1, certify=False, rival=rival, known=known, **how)
    else:
        for share in (1.0, 0.3) if scored is not None else (0.0,):
            near = parent.fit.u.copy()
            if scored is not None:
                near[places] += share * np.clip(scored.amount, -3.0, 3.0)
            trial = fit(problem, free, near, starts=1, certify=False, rival=rival)
            if found is None or trial.chi2 < found.chi2:
                found = trial
            if found.chi2 < parent.fit.chi2 and share != 1.0:
                break
    if scored is not None and problem.cheap_jacobian:
        # A baseline that misfits may have gone far along a valley, from where the way back is long.
        given = problem.origin()
        given[places] += np.clip(scored.amount, -1.0, 1.0)
        trial = fit(problem, free, given, starts=1, certify=False)
        if found is None or trial.chi2 < found.chi2:
            found = trial
    assert found is not None
    if not problem.cheap_jacobian and _strayed(parent.fit, found, rival):
        given = problem.origin()
        for e in effects:
            given[problem.candidates[e]] = found.u[problem.candidates[e]]
        # if another model has reached the noise meanwhile, what was found stays
        with contextlib.suppress(Outdone):
            trial = fit(problem, free, given, starts=1, certify=False, rival=rival, **how)
            found = trial if trial.chi2 < found.chi2 else found
    memory.keep(problem, effects, found)
    value, se = gain(problem, parent.fit, found)
    return Candidate(effects, found, noise_test(problem, found), value, se)


def _strayed(parent: Fit, found: Fit, rival: Rival | float) -> bool:
    """Whether a refit that explains most ended where it has no certificate, and may do better.

    A baseline that misfits may have gone far along a valley, from where the way back is long.
    """
    count = float(found.fitted.sum())
    explains = found.chi2 - count < MAX_LEFT_FRACTION * max(parent.chi2 - count, 0.0)
    reached = rival.chi2 if isinstance(rival, Rival) else rival
    return bool(found.problems) and explains and found.chi2 - 4.0 * found.gradient < reached


def with_own_step_error(problem: Problem, candidate: Candidate) -> Candidate:
    """The set fitted with the error of the time step as it is with its effects, if that is another, which then stays.

    A delay moves commands to between the samples of a log, where a step's error is another: 88 ms were found as
    90.84 +- 0.13 with the error of the model as given, and as 87.2 +- 0.6 with its own.
    """
    found = candidate.fit
    problem.use_step_error(found.step_error)
    problem.foresee(found.u[None], found.free)
    for _ in range(_RENEWALS):
        with problem.focused(candidate.effects):
            if not problem.renew_step_error(found.u):
                break
            found = fit(problem, found.free, found.u, starts=1, certify=False)
    if found is candidate.fit:
        return candidate
    return dataclasses.replace(candidate, fit=found, noise=noise_test(problem, found))


def fit_in_own_step(problem: Problem, free: np.ndarray, start: np.ndarray | None, **how: Any) -> Fit:
    """`fit`, again with the error of the time step as it is there while halving the step would change chi-square."""
    found = fit(problem, free, start, **how)
    again = {k: v for k, v in how.items() if k != "known"}
    for _ in range(_RENEWALS):
        # beside what a missing effect leaves, even a change far below the noise counts
        if not (step_too_long(found) and problem.renew_step_error(found.u, 0.0)):
            break
        found = dataclasses.replace(fit(problem, free, found.u, **again), own_step_error=True)
    return found


def _joined(problem: Problem, parent: Fit, free: np.ndarray, places: Sequence[int], columns: np.ndarray) -> np.ndarray:
    """(n, free) Jacobian at the parent's fit, with the columns of a candidate; its shapes do nothing at its null."""
    out = np.zeros((len(problem.observations), len(free)))
    at = {int(i): k for k, i in enumerate(free)}
    for k, i in enumerate(parent.free):
        out[:, at[int(i)]] = parent.jacobian[:, k]
    for k, i in enumerate(places):
        out[:, at[int(i)]] = columns[:, k]
    return out


def refit_with(problem: Problem, base: Fit, effect: str, settings: Settings, memory: Memory) -> Fit:
    """The model refitted with one candidate, as it would be among others, with the error of the time step at its fit.

    The problem keeps the error that the base was fitted with.
    """
    parent = Candidate((), base, noise_test(problem, base), 0.0, 0.0)
    scored = score(problem, base, signatures(problem, base, [effect]), settings.draws, settings.seed)
    if scored:
        found = refit_all(problem, parent, scored[:1], settings, memory)[0]
    else:
        found = refit(problem, parent, (effect,), None, memory)
    own = with_own_step_error(problem, found)
    problem.use_step_error(base.step_error)
    return own.fit
