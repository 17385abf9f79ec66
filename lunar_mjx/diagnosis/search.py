"""The search for missing effects: scores of all candidates, refits of the best, effects added while they earn it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from lunar_mjx.diagnosis.refit import Candidate, Settings, fit_in_own_step, refit, refit_all, with_own_step_error
from lunar_mjx.diagnosis.unknown_inputs.inputs import SMOOTH
from lunar_mjx.diagnosis.unknown_inputs.localise import pattern
from lunar_mjx.diagnosis.unknown_inputs.patterns import Unlisted, find_pattern
from lunar_mjx.inference.complete import best_start, simpler, stands, tried_in_place
from lunar_mjx.inference.descent import slack_of
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import Fit, Progress, fit, silent
from lunar_mjx.inference.held_out import gain, gain_in_turn, noise_test
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.scan import foresee_overlooked, overlooked
from lunar_mjx.inference.score import SEPARABLE, Score, cosines, score, signatures
from lunar_mjx.inference.shooting import shoot

STAND_IN_GIVE_UP_CHI2 = 200.0
"""A stand-in is refitted no further this far above the chi-square of the effect that it would replace."""
RIVAL_GIVE_UP_CHI2 = 200.0
"""An effect this far above another's chi-square is no rival of it, whatever the error of the time step."""
NOISE_FIT_KEY = "noise"
"""Key, in the store of fits, of the fit by which the noise's colour was estimated."""
_MISFIT = 1.3
"""Root mean square residual of a channel, over what noise allows it, from which a model is far beyond the noise."""


@dataclasses.dataclass(frozen=True, eq=False)
class Search:
    """Everything that a diagnosis looked at.

    Attributes:
      base: the baseline fit. scores: of every candidate at the base. cosines: between them.
      tried: every refitted set. chosen: the set that is named (the base's if empty). rivals: sets that explain the
        data alike.
      unlisted: an unknown input at none of the ports of the one effect that is named, which explains the data alike.
    """

    base: Candidate
    scores: tuple[Score, ...]
    cosines: Mapping[str, Mapping[str, float]]
    tried: tuple[Candidate, ...]
    chosen: Candidate
    rivals: tuple[Candidate, ...]
    unlisted: Unlisted | None = None


def fit_baseline(problem: Problem, settings: Settings, memory: Memory, progress: Progress = silent) -> Fit:
    """The model as it is, refitted, with its certificate; recalled where it has been done.

    Windows are fitted first where the model is far off, whole rollouts last.
    """
    start, free = None, problem.free()
    if problem.noise_unlearnt:
        start = memory.place(problem, NOISE_FIT_KEY)
        if start is None:
            start = shoot(problem, free, problem.origin(), progress)
            start = fit(problem, free, start, starts=1, certify=False, progress=progress).u
            memory.keep_place(problem, NOISE_FIT_KEY, start)
        problem.learn_noise(start)
    found = memory.recall(problem, ())
    if found is None:
        start = shoot(problem, free, problem.origin(), progress) if start is None else start
        found = fit_in_own_step(problem, free, start, starts=settings.starts, seed=settings.seed, progress=progress)
        memory.keep(problem, (), found)
    return found


def search(
    problem: Problem, settings: Settings | None = None, progress: Progress = silent, memory: Memory | None = None
) -> Search:
    """Fits the baseline, scores every candidate, refits the best and adds effects while they earn it.

    A baseline that passes for noise, or nearly, needs its certificate first: else noise looks like physics. One far
    beyond the noise, on fitted manoeuvres or on others, may be where no descent converges, or press against bounds;
    whether an effect brings it to the noise, with a certificate of its own, can be seen all the same.
    """
    settings, memory = settings or Settings(), memory or Memory()
    base_fit = fit_baseline(problem, settings, memory, progress)
    base = Candidate((), base_fit, noise_test(problem, base_fit), 0.0, 0.0)
    far = slack_of(base_fit.chi2, int(base_fit.fitted.sum())) > 0.0 or base.noise.worst_ratio > _MISFIT
    if base_fit.problems and not far:
        return Search(base, (), {}, (), base, ())
    progress("scoring", 0.0)
    scores, base = _scores(problem, base, settings)
    angles = cosines([s for s in scores if s.length >= SEPARABLE])
    tried: dict[frozenset[str], Candidate] = {frozenset(): base}
    beam, best, patience = [base], base, 1
    for level in range(settings.most):
        grown = []
        for number, parent in enumerate(beam):
            progress(f"refitting with {level + 1} effect{'s' if level else ''}", number / len(beam))
            found = scores if not parent.effects else _scores(problem, parent, settings)[0]
            near = angles if not parent.effects else cosines([s for s in found if s.length >= SEPARABLE])
            grown += _grow(problem, parent, found, near, settings, tried, memory)
        grown = sorted((c for c in grown if np.isfinite(c.fit.chi2)), key=lambda c: c.fit.chi2)
        reached = _reaching(problem, base, grown, settings, tried)
        if reached is not None:
            best = reached
            if not problem.cheap_jacobian:
                best = _in_own_steps(problem, base, reached, settings, tried)
                best = _completed(problem, best, settings, tried, memory, progress)
                best = tried[frozenset(best.effects)] = _with_pattern_test(problem, best, settings)
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
    pruned = _pruned(problem, best, settings, tried)
    if pruned is not best and pruned.effects:
        # what was dropped may have stood for a pattern that shows now
        if problem.inputs and pruned.noise.passes and pruned.pattern is None:
            _, pruned = _scores(problem, pruned, settings)
        pruned = tried[frozenset(pruned.effects)] = _with_pattern_test(problem, pruned, settings)
    best = pruned
    if not best.effects:
        base = best = tried[frozenset()] = _with_pattern_test(problem, base, settings)
    rivals = [c for c in tried.values() if c is not best and _alike(c, best, settings)]
    if not problem.cheap_jacobian:
        rivals = [c for c in rivals if not simpler(best.fit, c.fit)]
    unlisted = _unlisted(problem, base, best, settings)
    return Search(base, tuple(scores), angles, tuple(tried.values()), best, tuple(rivals), unlisted)


def _unlisted(problem: Problem, base: Candidate, best: Candidate, settings: Settings) -> Unlisted | None:
    """An unknown input elsewhere that would explain as much as the one effect named, where linear scores hold."""
    if base.pattern is None or len(best.effects) != 1:
        return None
    label, quantity, chi2 = base.pattern.elsewhere(frozenset(problem.effects[best.effects[0]].ports))
    ahead = chi2 - (base.fit.chi2 - best.fit.chi2)
    return Unlisted(label, quantity, chi2, ahead) if label and ahead > -settings.same else None


def _reaching(
    problem: Problem,
    base: Candidate,
    grown: Sequence[Candidate],
    settings: Settings,
    tried: dict[frozenset[str], Candidate],
) -> Candidate | None:
    """The first that leaves nothing but noise; those looked at replace what was tried."""
    for c in grown:
        if c.noise.passes and _earned(problem, base, c, settings):
            looked = tried[frozenset(c.effects)] = _with_pattern_test(problem, c, settings)
            if looked.at_noise:
                return looked
    return None


def _in_own_steps(
    problem: Problem, base: Candidate, reached: Candidate, settings: Settings, tried: dict[frozenset[str], Candidate]
) -> Candidate:
    """The best of those at the noise, each with the error of the time step at its own fit, which then stays.

    Else what is left of that error looks like a second effect (beside Coulomb friction, like Stribeck's), or another
    effect like a better one.
    """
    near = [c for c in tried.values() if c.effects and c.fit.chi2 < reached.fit.chi2 + RIVAL_GIVE_UP_CHI2]
    owns = [with_own_step_error(problem, c) for c in dict.fromkeys([reached, *near])]
    tried.update({frozenset(c.effects): c for c in owns})
    # who takes its place must have earned it on manoeuvres left out, as it had
    fit_to_lead = [owns[0], *(c for c in owns[1:] if c.at_noise and _earned(problem, base, c, settings))]
    best = min(fit_to_lead, key=lambda c: c.fit.chi2)
    problem.use_step_error(best.fit.step_error)
    return best


def _completed(
    problem: Problem,
    best: Candidate,
    settings: Settings,
    tried: dict[frozenset[str], Candidate],
    memory: Memory,
    progress: Progress,
) -> Candidate:
    """A model at the noise with a simpler effect where one does the same, and with what is significant beside it."""
    while True:
        progress("looking for more", 0.0)
        scores, best = _scores(problem, best, settings)
        tried[frozenset(best.effects)] = best
        instead = stands(problem, best.fit, best.effects, scores)[: settings.refits]
        instead += tried_in_place(problem, best.fit, best.effects, scores)[: settings.refits]
        for stand in instead:
            if frozenset(stand.effects) in tried:
                continue
            with problem.focused(stand.effects):
                start = best_start(problem, stand)
                c = refit(
                    problem, best, stand.effects, stand.scored, memory, best.fit.chi2 + STAND_IN_GIVE_UP_CHI2, start
                )
            tried[frozenset(c.effects)] = c
        plain = [c for c in tried.values() if 0 < len(c.effects) <= len(best.effects) and c.noise.passes]
        plain = [c for c in plain if simpler(c.fit, best.fit)]
        if plain:
            least = min(plain, key=lambda c: c.fit.chi2)
            return _completed(problem, least, settings, tried, memory, progress)
        new = [s for s in scores if s.effect not in best.effects and significant(s, settings)][: settings.refits]
        if not new or len(best.effects) >= settings.most:
            return best
        with problem.focused([*best.effects, *(s.effect for s in new)]):
            grown = refit_all(problem, best, new, settings, memory)
        tried.update({frozenset(c.effects): c for c in grown})
        better = [c for c in grown if _better(c, best, settings) and _earned(problem, best, c, settings)]
        if not better:
            return best
        best = max(better, key=lambda c: gain(problem, best.fit, c.fit)[0])


def _with_pattern_test(problem: Problem, c: Candidate, settings: Settings) -> Candidate:
    """The candidate with its residual-pattern test filled in; for drives only where scores were taken at the fit."""
    small = c.noise.passes and np.isfinite(c.fit.chi2)
    if not small or not problem.inputs:
        gain_ = pattern(problem, c.fit) if small else 0.0
        return dataclasses.replace(c, patterned=gain_ > settings.pattern, evidence=gain_)
    p = c.pattern
    return dataclasses.replace(c, patterned=p is not None and p.p <= settings.pattern_p and p.chi2 >= settings.chi2)


def _scores(problem: Problem, at: Candidate, settings: Settings) -> tuple[list[Score], Candidate]:
    """Scores of all other effects; and the candidate with its pattern, if its residual is small.

    Derivatives with respect to candidates and to unknown inputs are one batch of one program.
    """
    names = [e for e in problem.candidates if e not in at.effects]
    inputs = list(problem.inputs) if at.noise.passes and np.isfinite(at.fit.chi2) else []
    foresee_overlooked(problem, at.fit, at.effects, names)
    with problem.focused([*problem.candidates, SMOOTH]):
        columns = signatures(problem, at.fit, names, inputs)
    if inputs and columns:
        own = {label: columns.pop(label) for label in inputs}
        found = find_pattern(problem, at.fit, own, settings.draws, settings.seed)
        at = dataclasses.replace(at, pattern=found)
    return score(problem, at.fit, columns, settings.draws, settings.seed), at


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
    with problem.focused([*problem.candidates, SMOOTH]):
        chosen += overlooked(problem, parent.fit, parent.effects, [s for s in scores if s not in chosen])
    new = [s for s in chosen if frozenset((*parent.effects, s.effect)) not in tried]
    with problem.focused([*parent.effects, *(s.effect for s in new)]):
        grown = refit_all(problem, parent, new, settings, memory)
    tried.update({frozenset(c.effects): c for c in grown})
    return grown


def _earned(problem: Problem, before: Candidate, c: Candidate, settings: Settings) -> bool:
    """Whether the effects beyond an earlier set pay on manoeuvres left out."""
    value, se = gain(problem, before.fit, c.fit)
    # Reaching the noise on all manoeuvres is evidence of its own.
    needed = 1.0 if c.at_noise and not before.at_noise else settings.gain_se
    if value > 0.5 * settings.chi2 and value > needed * se:
        return True
    if not problem.cheap_jacobian or value <= 0.0:
        return False
    value, se = gain_in_turn(problem, before.fit, c.fit)
    return bool(value > 0.5 * settings.chi2 and value > settings.gain_se * se)


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
    if search_.chosen.patterned:
        # At the noise chance hides what is left; the pattern is what shows of it.
        found = search_.chosen.pattern
        left = max(after, found.chi2 if found is not None else 2.0 * search_.chosen.evidence)
        before, after = max(before, before - after + left), left
    return 1.0 if before <= 0.0 else 1.0 - max(after, 0.0) / before
