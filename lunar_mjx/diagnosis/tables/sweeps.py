"""Which sweep of a test bed tells hypotheses about tables apart best.

Two hypotheses differ in a sweep by the difference of their predictions, measured by the covariance that either of them
expects there: noise, what the tables so far leave open of its parameters, calibration, and discrepancy of usual size.
Half its square is the expected log odds between them (Atkinson and Fedorov 1975, with a covariance).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg
from threadpoolctl import threadpool_limits

from lunar_mjx.diagnosis.planned import planned_sweeps
from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.diagnosis.tables.loop import build_tables
from lunar_mjx.inference.weighing.hypotheses import EFFECT
from lunar_mjx.logs import SteadyLog


class Sweep(NamedTuple):
    """A planned sweep: its name, what it is, the expected separation in sigma, and the pair that it separates least."""

    name: str
    description: str
    separation: float
    pair: tuple[str, str]


class _Expected(NamedTuple):
    """What a hypothesis expects of all observations: mean, whitened; columns that are uncertain; their covariance."""

    mean: np.ndarray
    columns: np.ndarray
    covariance: np.ndarray


def rank_sweeps(
    run: Run,
    logs: Sequence[SteadyLog],
    verdict: dict[str, Any],
    names: Sequence[str],
    nothing: str,
    progress: Callable[[str, float], None],
) -> list[Sweep]:
    """Planned sweeps, the one first that separates the least separated pair best.

    Args:
      run: whose tables. logs: its tables. verdict: contents of `verdict.json`.
      names: of effects to tell apart; `nothing` stands for no effect beyond those that are sure.
      progress: told of every refit.
    """
    plans = planned_sweeps(logs)
    # Planned sweeps ride along as held-out groups: they choose nothing, and share the tables' fields of discrepancy.
    planned = [dataclasses.replace(log, split="select", name=f"planned {k}") for k, (_, _, log) in enumerate(plans)]
    problem = build_tables(run, [*logs, *planned])
    forms = verdict.get("forms") or {}
    form = max(problem.forms, key=lambda f: forms.get(f.name, 0.0))
    inclusion = verdict.get("inclusion") or {}
    sure = {n for n in form.candidates if inclusion.get(n, 0.0) >= problem.settings.sure and n not in names}
    expected = {}
    with threadpool_limits(1, "blas"):
        base = form.refit(frozenset(sure), None, None)
        for k, name in enumerate(names):
            progress(f"refitting with {name}", k / len(names))
            effects = frozenset(sure if name == nothing else sure | {name})
            refit = base if effects == base.effects else form.refit(effects, base, form.trial(base.u, name))
            linear, columns, residual = form.linearise(refit.u)
            terms = frozenset(t for t in form.terms if t.kind == EFFECT and t.name in effects)
            _, inferred, places = linear.evidence(terms)
            white = form.data.observations.whiten(form.data.observations.value) - residual
            expected[name] = _Expected(white, columns[:, places], inferred.covariance)
    observations = form.data.observations
    ranked = []
    for k, (name, text, _) in enumerate(plans):
        rows = np.zeros(len(observations), bool)
        for s in observations.series:
            if s.log == len(logs) + k:
                rows[s.start : s.stop] = True
        pairs = {}
        for a, b in itertools.combinations(names, 2):
            # Either may be the truth: a plan has to convince the one that expects the larger covariance.
            pairs[a, b] = min(_separation(expected[a], expected[b], rows), _separation(expected[b], expected[a], rows))
        worst = min(pairs, key=lambda p: pairs[p])
        ranked.append(Sweep(name, text, pairs[worst], worst))
    return sorted(ranked, key=lambda s: -s.separation)


def _separation(true: _Expected, judge: _Expected, rows: np.ndarray) -> float:
    """Distance of two means, in sigma, under the covariance that `judge`, one of both hypotheses, expects."""
    away = (true.mean - judge.mean)[rows]
    columns = judge.columns[rows]
    covariance = columns @ judge.covariance @ columns.T
    covariance[np.diag_indices(len(away))] += 1.0
    solved = linalg.cho_solve(linalg.cho_factor(covariance, lower=True), away)
    return float(np.sqrt(max(away @ solved, 0.0)))
