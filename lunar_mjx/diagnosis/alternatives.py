"""Other forms of what a model has already: effects that would replace some of its own, refitted in their place."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.build_problem import build_problem, candidate_effects
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.refit import Candidate
from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.inference.fitting import Fit, Progress, fit
from lunar_mjx.inference.held_out import errors, predictive_gain, predictive_residual
from lunar_mjx.inference.problem import Problem


@dataclasses.dataclass(frozen=True)
class Alternative:
    """Another form of part of the model.

    Attributes:
      effect: that is put in. replaces: what goes out. chi2: of the refit, and chi2_before: of the model as it is, both
        with the effects that `why` named.
      error: root mean square residual in sigma by split.
      held_out_gain, held_out_se: of expected log density on manoeuvres left out.
    """

    effect: str
    replaces: tuple[str, ...]
    chi2: float
    chi2_before: float
    error: dict[str, float]
    held_out_gain: float
    held_out_se: float

    @property
    def helps(self) -> bool:
        """Whether it earns its place on manoeuvres left out."""
        return self.chi2 < self.chi2_before and self.held_out_gain > 2.0 * self.held_out_se


def alternatives(
    run: Run, logs: Sequence[Any], problem: Problem, chosen: Candidate, progress: Progress
) -> tuple[Alternative, ...]:
    """Refits the model with every effect that would replace some of its own, the most helpful first.

    Each form is a program of its own. Where rows are dear, one descent starts where the model as it is has ended, all
    rovers of a step in one batch, and is left once it is sure not to reach what that model does.

    Args:
      run: model and candidates. logs: of the run. problem, chosen: what the model as it is explains, and with what.
      progress: told of every refit.
    """
    present = set(run.model.effect_names)
    found = []
    kinds = {n: e for n, e in candidate_effects(run).items() if present & set(e.replaces) and n not in present}
    old = predictive_residual(problem, chosen.fit)
    for number, (name, effect) in enumerate(kinds.items()):
        progress(f"refitting with {name} instead", number / len(kinds))
        other = dataclasses.replace(run, model=run.model.add(effect, "alternative"))
        named = [e for e in chosen.effects if e in candidate_effects(other)]
        if isinstance(problem, DriveProblem):
            mine, refitted = _driven(problem, other, named, chosen.fit, progress)
        else:
            mine = build_problem(other, logs, named)
            free = mine.free([e for e in named if e in mine.candidates])
            refitted = fit(mine, free, starts=2, certify=False)
        judged = problem.observations.in_split("fit", "select")
        if not np.isfinite(refitted.chi2) or not np.isfinite(refitted.residual[judged]).all():
            continue
        gain, se = predictive_gain(problem, chosen.fit, refitted, old, predictive_residual(mine, refitted))
        found.append(
            Alternative(
                name,
                tuple(e for e in effect.replaces if e in present),
                refitted.chi2,
                chosen.fit.chi2,
                errors(mine, refitted),
                gain,
                se,
            )
        )
    return tuple(sorted(found, key=lambda a: -a.held_out_gain))


def _driven(
    problem: DriveProblem, other: Run, named: Sequence[str], before: Fit, progress: Progress
) -> tuple[DriveProblem, Fit]:
    """Drives against the other model, refitted from where the model as it is ended; left where it cannot catch up."""
    effects = candidate_effects(other)
    mine = problem.instead(other.model, {e: effects[e] for e in named}, progress)
    named = [e for e in named if e in mine.candidates]
    at = {c.key: u for c, u in zip(problem.coordinates, before.u, strict=True)}
    start = np.array([at.get(c.key, 0.0) for c in mine.coordinates])
    with mine.focused(named):
        return mine, fit(mine, mine.free(named), start, starts=1, certify=False, rival=before.chi2)
