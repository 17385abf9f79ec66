"""The search for missing effects: scores of all candidates, refits of the best, effects added while they earn it."""

from __future__ import annotations

import concurrent.futures
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from lunar_mjx.criticism.descent import slack_of
from lunar_mjx.criticism.fitting import Fit, Memory, Progress, fit, silent
from lunar_mjx.criticism.held_out import NoiseTest, gain, noise_test
from lunar_mjx.criticism.localise import pattern
from lunar_mjx.criticism.problem import Problem
from lunar_mjx.criticism.scan import scan
from lunar_mjx.criticism.score import SEPARABLE, Score, cosines, score, signatures

_RIVAL = 0.8
"""Share of what an effect takes off that score or scan must promise another to be refitted as its rival. (Of ten
rivals of Coulomb friction in two campaigns eight took off what was promised within 3 % of that effect's share; gravity
took off 14 % more, grousers nothing.)"""
_NOISE = "noise"
"""What the place is called at which the noise's colour was learnt."""
_MISFIT = 1.3
"""Root mean square residual of a channel, over what noise allows it, from which a model is far beyond the noise."""


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
        14; three wrong models whose residual passed for noise left 30 to 78.
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
      patterned: whether what is left is small, but no noise: some smooth unknown input has it.
    """

    effects: tuple[str, ...]
    fit: Fit
    noise: NoiseTest
    gain: float
    gain_se: float
    patterned: bool = False

    @property
    def at_noise(self) -> bool:
        """Whether nothing is left but noise, as far as can be told."""
        return self.noise.passes and not self.patterned


@dataclasses.dataclass(frozen=True, eq=False)
class Search:
    """Everything that a diagnosis looked at.

    Attributes:
      base: the baseline fit. scores: of every candidate at the base. cosines: between them.
      tried: every refitted set. chosen: the set that is named (the base's if empty). rivals: sets that explain the
        data alike.
    """

    base: Candidate
    scores: tuple[Score, ...]
    cosines: Mapping[str, Mapping[str, float]]
    tried: tuple[Candidate, ...]
    chosen: Candidate
    rivals: tuple[Candidate, ...]


def fit_baseline(problem: Problem, settings: Settings, memory: Memory, progress: Progress = silent) -> Fit:
    """The model as it is, refitted, with its certificate; recalled where it has been done."""
    start = None
    if problem.noise_unlearnt:
        start = memory.place(problem, _NOISE)
        if start is None:
            start = fit(problem, problem.free(), starts=1, certify=False, progress=progress).u
            memory.keep_place(problem, _NOISE, start)
        problem.learn_noise(start)
    found = memory.recall(problem, ())
    if found is None:
        found = fit(problem, problem.free(), start, settings.starts, settings.seed, progress=progress)
        memory.keep(problem, (), found)
    return found


def search(
    problem: Problem, settings: Settings = Settings(), progress: Progress = silent, memory: Memory | None = None
) -> Search:
    """Fits the baseline, scores every candidate, refits the best and adds effects while they earn it.

    A baseline that passes for noise, or nearly, needs its certificate first: else noise looks like physics. One far
    beyond the noise, on fitted manoeuvres or on others, may be where no descent converges, or press against bounds;
    whether an effect brings it to the noise, with a certificate of its own, can be seen all the same.
    """
    memory = memory or Memory()
    base_fit = fit_baseline(problem, settings, memory, progress)
    base = Candidate((), base_fit, noise_test(problem, base_fit), 0.0, 0.0)
    far = slack_of(base_fit.chi2, int(base_fit.fitted.sum())) > 0.0 or base.noise.worst_ratio > _MISFIT
    if base_fit.problems and not far:
        return Search(base, (), {}, (), base, ())
    progress("scoring", 0.0)
    scores = _scores(problem, base, settings)
    angles = cosines([s for s in scores if s.length >= SEPARABLE])
    tried: dict[frozenset[str], Candidate] = {frozenset(): base}
    beam, best, patience = [base], base, 1
    for level in range(settings.most):
        grown = []
        for number, parent in enumerate(beam):
            progress(f"refitting with {level + 1} effect{'s' if level else ''}", number / len(beam))
            found = scores if not parent.effects else _scores(problem, parent, settings)
            near = angles if not parent.effects else cosines([s for s in found if s.length >= SEPARABLE])
            grown += _grow(problem, parent, found, near, settings, tried, memory)
        grown = sorted((c for c in grown if np.isfinite(c.fit.chi2)), key=lambda c: c.fit.chi2)
        reached = _reaching(problem, base, grown, settings, tried)
        if reached is not None:
            best = reached
            break
        grown = [tried[frozenset(c.effects)] for c in grown]
        better = [c for c in grown if _better(c, best, settings) and _earned(problem, best, c, settings)]
        if better:
            best = max(better, key=lambda c: gain(problem, best.fit, c.fit)[0])
        elif not grown or not patience:
            break
        else:
            patience -= 1  # two effects may help only together
        # The most promising by their fit and, where these differ, by manoeuvres left out.
        held = sorted(grown, key=lambda c: -gain(problem, base.fit, c.fit)[0])
        beam = list(dict.fromkeys([*better[:1], *grown[:1], *held[:1], *grown]))[: settings.beam]
    best = _pruned(problem, best, settings, tried)
    if not best.effects:
        base = best = tried[frozenset()] = _looked_at(problem, base, settings)
    rivals = [c for c in tried.values() if c is not best and _alike(c, best, settings)]
    return Search(base, tuple(scores), angles, tuple(tried.values()), best, tuple(rivals))


def _reaching(
    problem: Problem, base: Candidate, grown: Sequence[Candidate], settings: Settings,
    tried: dict[frozenset[str], Candidate],
) -> Candidate | None:  # fmt: skip
    """The first that leaves nothing but noise; those looked at replace what was tried."""
    for c in grown:
        if c.noise.passes and _earned(problem, base, c, settings):
            looked = tried[frozenset(c.effects)] = _looked_at(problem, c, settings)
            if looked.at_noise:
                return looked
    return None


def _looked_at(problem: Problem, c: Candidate, settings: Settings) -> Candidate:
    """Whether a residual that is small has a pattern, too."""
    small = c.noise.passes and np.isfinite(c.fit.chi2)
    return dataclasses.replace(c, patterned=small and pattern(problem, c.fit) > settings.pattern)


def _scores(problem: Problem, at: Candidate, settings: Settings) -> list[Score]:
    names = [e for e in problem.candidates if e not in at.effects]
    return score(problem, at.fit, signatures(problem, at.fit, names), settings.draws, settings.seed)


def significant(s: Score, settings: Settings) -> bool:
    """Whether a score alone would name the effect."""
    return s.length >= SEPARABLE and s.p <= settings.alpha and s.chi2 >= settings.chi2


def worth_refitting(s: Score, parent: Candidate, settings: Settings) -> bool:
    """Whether a score, or the share of the excess that it explains, earns a refit."""
    fitted = parent.fit.residual[parent.fit.fitted]
    excess = float(fitted @ fitted) - len(fitted)
    large = not parent.at_noise and s.chi2 > settings.share * excess
    return significant(s, settings) or (large and s.length >= SEPARABLE and s.chi2 >= settings.chi2)


def _grow(
    problem: Problem,
    parent: Candidate,
    scores: Sequence[Score],
    near: Mapping[str, Mapping[str, float]],
    settings: Settings,
    tried: dict[frozenset[str], Candidate],
    memory: Memory,
) -> list[Candidate]:
    """Refits the parent with each of the best-scored effects, and with their near relatives."""
    good = [s for s in scores if worth_refitting(s, parent, settings)]
    if not good:
        return []
    # Far from the noise linear scores order effects badly, and tables have one more start against that.
    refits = settings.refits if problem.cheap_jacobian else 2 * settings.refits
    chosen = list(good[:refits])
    for s in good[refits:]:
        if near.get(good[0].effect, {}).get(s.effect, 0.0) >= settings.confounded and len(chosen) < 2 * settings.refits:
            chosen.append(s)
    new = [s for s in chosen if frozenset((*parent.effects, s.effect)) not in tried]
    with problem.focused([*parent.effects, *(s.effect for s in new)]):
        grown = _refit_all(problem, parent, new, settings, memory)
    tried.update({frozenset(c.effects): c for c in grown})
    return grown


def _refit_all(
    problem: Problem, parent: Candidate, new: Sequence[Score], settings: Settings, memory: Memory
) -> list[Candidate]:
    """Refits the parent with each of the new effects.

    Where rows are free, all refits share their batches. Where they are dear, the best is refitted first, and others
    only as far as they may still rival it.
    """

    scans = scan(problem, parent.fit, parent.effects, new)
    new = sorted(new, key=lambda s: scans[s.effect][0] if s.effect in scans else parent.fit.chi2 - s.chi2)

    def one(s: Score, rival: float = np.inf) -> Candidate:
        chi2, start = scans.get(s.effect, (np.inf, None))
        better = chi2 < parent.fit.chi2 - s.chi2
        return _refit(problem, parent, (*parent.effects, s.effect), s, memory, rival, start if better else None)

    if not problem.eager or len(new) < 2:
        grown: list[Candidate] = []
        for s in new:
            # What falls far short of one that reaches the noise is not refitted, or left soon.
            reached = min((c.fit.chi2 for c in grown if c.noise.passes), default=np.inf)
            promised = max(s.chi2, parent.fit.chi2 - scans.get(s.effect, (np.inf, None))[0])
            if problem.cheap_jacobian or not promised < _RIVAL * (parent.fit.chi2 - reached):
                grown.append(one(s, reached + settings.same))
        return grown
    with problem.together(len(new)) as leave:

        def tracked(s: Score) -> Candidate:
            try:
                return one(s)
            finally:
                leave()

        with concurrent.futures.ThreadPoolExecutor(len(new)) as pool:
            return list(pool.map(tracked, new))


def _refit(
    problem: Problem, parent: Candidate, effects: tuple[str, ...], scored: Score | None, memory: Memory,
    rival: float = np.inf, start: np.ndarray | None = None,
) -> Candidate:  # fmt: skip
    """Refits from a start; without one from the parent with the new effect at its linear estimate, and from a third of
    it where that fails."""
    free = problem.free(effects)
    found = memory.recall(problem, effects)
    if found is not None:
        value, se = gain(problem, parent.fit, found)
        return Candidate(effects, found, noise_test(problem, found), value, se)
    places = [i for i in problem.candidates[effects[-1]] if problem.coordinates[i].amplitude]
    if start is not None:
        found = fit(problem, free, start, starts=1, certify=False, rival=rival)
    elif scored is not None and scored.columns is not None and not problem.cheap_jacobian:
        # The score has taken all derivatives at the parent's fit: the first step costs nothing.
        known = parent.fit.residual, _joined(problem, parent.fit, free, places, scored.columns)
        found = fit(problem, free, parent.fit.u, starts=1, certify=False, rival=rival, known=known)
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
    memory.keep(problem, effects, found)
    value, se = gain(problem, parent.fit, found)
    return Candidate(effects, found, noise_test(problem, found), value, se)


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
    """The model refitted with one candidate, from the candidate's linear estimate."""
    parent = Candidate((), base, noise_test(problem, base), 0.0, 0.0)
    scored = score(problem, base, signatures(problem, base, [effect]), settings.draws, settings.seed)
    return _refit(problem, parent, (effect,), scored[0] if scored else None, memory).fit


def _earned(problem: Problem, before: Candidate, c: Candidate, settings: Settings) -> bool:
    """Whether the effects beyond an earlier set pay on manoeuvres left out."""
    value, se = gain(problem, before.fit, c.fit)
    # Reaching the noise on all manoeuvres is evidence of its own.
    needed = 1.0 if c.at_noise and not before.at_noise else settings.gain_se
    return bool(value > 0.5 * settings.chi2 and value > needed * se)


def _better(c: Candidate, best: Candidate, settings: Settings) -> bool:
    return c.fit.chi2 < best.fit.chi2 - settings.chi2 * max(1, len(c.effects) - len(best.effects))


def _alike(c: Candidate, best: Candidate, settings: Settings) -> bool:
    """Whether another set of as many effects, or fewer, explains the data as well as the best."""
    if not best.effects or not c.effects or len(c.effects) > len(best.effects) or not np.isfinite(c.fit.chi2):
        return False
    return c.fit.chi2 - best.fit.chi2 < settings.same


def _pruned(problem: Problem, best: Candidate, settings: Settings, tried: dict[frozenset[str], Candidate]) -> Candidate:
    """Drops effects that are not significant given the others."""
    while len(best.effects) > 1:
        for effect in best.effects:
            rest = tuple(e for e in best.effects if e != effect)
            if frozenset(rest) not in tried:
                start = best.fit.u.copy()
                start[problem.candidates[effect]] = 0.0
                refitted = fit(problem, problem.free(rest), start, starts=1, certify=False)
                tried[frozenset(rest)] = Candidate(rest, refitted, noise_test(problem, refitted), np.nan, np.nan)
            without = tried[frozenset(rest)]
            value, se = gain(problem, without.fit, best.fit)
            small = without.fit.chi2 - best.fit.chi2 < settings.chi2 or value < settings.gain_se * se
            if small or (without.noise.passes and not best.noise.passes):
                best = without
                break
        else:
            break
    return best


def excess_explained(search_: Search, problem: Problem) -> float:
    """Share of the squared error beyond the noise that the chosen effects explain, over fitted and select splits."""
    keep = problem.observations.in_split("fit", "select")
    before = float(np.sum(search_.base.fit.residual[keep] ** 2)) - keep.sum()
    after = float(np.sum(search_.chosen.fit.residual[keep] ** 2)) - keep.sum()
    return 1.0 if before <= 0.0 else 1.0 - max(after, 0.0) / before
