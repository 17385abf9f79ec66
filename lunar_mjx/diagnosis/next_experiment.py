"""Which measurement tells the surviving hypotheses apart best: T-optimal design (Atkinson and Fedorov 1975).

Two hypotheses differ in a new measurement by what is left of the difference of their predictions after either has been
refitted, held by everything that the logs so far say about its parameters.
"""

from __future__ import annotations

import dataclasses
import itertools
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.build_problem import candidate_effects, known_logs
from lunar_mjx.diagnosis.drives.form import DriveForm
from lunar_mjx.diagnosis.drives.loop import build_drives
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.planned import planned_drives
from lunar_mjx.diagnosis.runs import HYPOTHESES_FILE, NEXT_FILE, VERDICT_FILE, Run, load_run
from lunar_mjx.diagnosis.tables.sweeps import rank_sweeps
from lunar_mjx.diagnosis.weighed.answer import kept_start
from lunar_mjx.errors import UserError
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.logs import Log, SteadyLog

NOTHING = "no further effect"


@dataclasses.dataclass(frozen=True)
class ExperimentChoice:
    """How experiments are chosen."""

    seconds: float = 30.0
    """Longest planned drive by default, s."""
    most: int = 4
    """Hypotheses at most."""
    separable: float = 5.0
    """sigma; difference of two hypotheses from which a measurement tells them apart."""


CHOICE = ExperimentChoice()


@dataclasses.dataclass(frozen=True)
class Plan:
    """A measurement to make.

    Attributes:
      name: of the manoeuvre or sweep. description: what it is.
      separation: expected difference of the two hypotheses that it tells apart least, sigma. pair: these two.
    """

    name: str
    description: str
    separation: float
    pair: tuple[str, str]


@dataclasses.dataclass(frozen=True)
class NextExperiment:
    """The measurements to make next, ranked.

    Attributes:
      hypotheses: that survive. plans: best first. sentence: the answer.
    """

    hypotheses: tuple[str, ...]
    plans: tuple[Plan, ...]
    sentence: str

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        return dataclasses.asdict(self)


def next_experiment(
    folder: str | Path | Run, between: Sequence[str] = (), seconds: float = CHOICE.seconds, progress: Progress = silent
) -> NextExperiment:
    """The manoeuvre (or sweep of a test bed) that best separates what the logs leave open; writes `next.json`.

    Args:
      folder: of a run on which `why` has been called.
      between: effects to tell apart; those that the verdict leaves open if none.
      seconds: longest drive to plan, s; canned manoeuvres beyond it are scaled down.
      progress: told of simulations.

    Raises:
      UserError: `why` has not been called, or an effect is none of its candidates.
    """
    run = folder if isinstance(folder, Run) else load_run(folder)
    verdict = run.load(VERDICT_FILE)
    if verdict is None:
        raise UserError(f"{run.folder}: has no verdict yet; run lunar-mjx why {shlex.quote(str(run.folder))} first.")
    if verdict["verdict"] in ("BAD_DATA", "BAD_FIT"):
        raise UserError(f"{run.folder}: the verdict is {verdict['verdict']}; mend that before planning a measurement.")
    names = _hypotheses(verdict, between, set(candidate_effects(run)))
    effects = [n for n in names if n != NOTHING]
    logs = known_logs(run)
    tables = [log for log in logs if isinstance(log, SteadyLog)]
    if tables:
        held = set(run.model.effect_names)
        usable = [n for n in names if n not in held]
        if len(usable) < 2:
            raise UserError(f"{run.folder}: no two hypotheses are left to tell apart; name effects with --between.")
        sweeps = rank_sweeps(run, tables, verdict, usable, NOTHING, progress)
        ranked = [Plan(*sweep) for sweep in sweeps]
        experiment = NextExperiment(tuple(usable), tuple(ranked), _sentence(usable, ranked))
        run.save(NEXT_FILE, experiment.to_dict())
        return experiment
    drives = [log for log in logs if isinstance(log, Log)]
    form = build_drives(run, drives, effects, progress).own
    assert isinstance(form, DriveForm)
    usable = [n for n in names if n == NOTHING or n in form.candidates]
    if len(usable) < 2:
        raise UserError(f"{run.folder}: no two hypotheses are left to tell apart; name effects with --between.")
    form.drives.progress = silent
    progress("what the logs say so far", 0.0)
    known = _Knowledge(form, run, usable)
    model = form.drives.model
    plans = planned_drives(drives, model, seconds)
    effects_by_name = {n: form.drives.effects[n] for n in usable if n != NOTHING}
    new = DriveProblem([p[2] for p in plans], model, effects_by_name, progress=progress)
    ranked = _rank(new, known, usable, [(name, text) for name, text, _ in plans])
    experiment = NextExperiment(tuple(usable), tuple(ranked), _sentence(usable, ranked))
    run.save(NEXT_FILE, experiment.to_dict())
    return experiment


def _hypotheses(verdict: dict[str, Any], between: Sequence[str], candidates: set[str]) -> list[str]:
    """What is to be told apart: the class, an effect and its nearest confounder, or something against nothing."""
    evidence = verdict.get("evidence") or []
    if between:
        for name in between:
            if name not in candidates:
                raise UserError(f"next --between: {name!r} is no candidate here; use one of {', '.join(candidates)}.")
        return list(between) if len(between) > 1 else [*between, NOTHING]
    named = [e for e in verdict["effects"] if e in candidates]
    if verdict["verdict"] == "KNOWN_CLASS" and len(named) > 1:
        return named[: CHOICE.most]
    if verdict["verdict"] == "NOISE_ONLY":
        # What these logs could not have shown, the most nearly visible first.
        hidden = sorted((e for e in evidence if e["status"] == "not tested"), key=lambda e: -e["separable_sigma"])
        return [*(e["effect"] for e in hidden[: CHOICE.most - 1]), NOTHING]
    open_ = [e["effect"] for e in evidence if e["status"] in ("accepted", "confounded")]
    near = [e["nearest"][0] for e in evidence if e["effect"] in named and e["nearest"][0] in candidates]
    by_z = [e["effect"] for e in sorted(evidence, key=lambda e: -(e["z"] or 0.0)) if e["effect"] in candidates]
    return list(dict.fromkeys([*named[:2], *open_, *near, *by_z]))[: max(2, min(CHOICE.most, len(named) + 2))]


class _Knowledge:
    """Places and precisions of all hypotheses after the logs so far.

    Attributes:
      place: coordinate by key, for each hypothesis. precision: inverse covariance of the shared coordinates `keys`.
    """

    def __init__(self, form: DriveForm, run: Run, names: Sequence[str]):
        base = kept_start(run, form, frozenset())
        # Discrepancy is no part of a hypothesis: a plan that told amounts of it apart would tell no effects apart.
        base = form.bare(form.refit(frozenset(), None, None).u if base is None else base)
        kept = run.load(HYPOTHESES_FILE) or {}
        self.place: dict[str, dict[str, float]] = {}
        for name in names:
            entry = kept.get(form.name if name == NOTHING else f"{form.name} + {name}")
            u = base.copy()
            if entry is not None:
                for i, c in enumerate(form.coordinates):
                    u[i] = entry["u"].get(c.key, u[i])
                u = form.bare(u)
            elif name != NOTHING:
                places = form.candidates[name]
                low, high = form.drives.bounds(places)
                amplitude = np.array([form.coordinates[i].amplitude for i in places])
                u[places] = np.where(amplitude, np.where(high >= 1.0, 1.0, np.maximum(low, -1.0)), u[places])
            self.place[name] = {c.key: float(v) for c, v in zip(form.coordinates, u, strict=True)}
        free = form.drives.free([n for n in names if n != NOTHING])
        jacobian = form.observations.whiten(form.jacobian(base, free)[1])[form.observations.in_split("fit", "select")]
        scale = np.array([1.0 / form.coordinates[i].prior for i in free])
        hessian = jacobian.T @ jacobian + np.diag(scale**2)
        own = np.array([form.coordinates[i].nuisance for i in free])
        self.keys = [form.coordinates[i].key for i, mine in zip(free, own, strict=True) if not mine]
        across = hessian[np.ix_(~own, own)]
        # Offsets and starts of the earlier logs are integrated out (Schur's complement): a new log has its own.
        inner = np.linalg.pinv(hessian[np.ix_(own, own)], hermitian=True)
        self.precision = hessian[np.ix_(~own, ~own)] - across @ inner @ across.T


def _rank(
    problem: DriveProblem, known: _Knowledge, names: Sequence[str], plans: Sequence[tuple[str, str]]
) -> list[Plan]:
    keys = {c.key: i for i, c in enumerate(problem.coordinates)}
    rows = np.repeat(problem.origin()[None], len(names), axis=0)
    for row, name in zip(rows, names, strict=True):
        for key, value in known.place[name].items():
            if key in keys and not problem.coordinates[keys[key]].nuisance:
                row[keys[key]] = value
    white = problem.observations.whiten(problem.predict(rows).T).T
    effects = [n for n in names if n != NOTHING]
    free = problem.free(effects)
    base = problem.origin()
    base[problem.baseline] = np.mean(rows[:, problem.baseline], axis=0)
    jacobian = problem.observations.whiten(problem.jacobian(base, free)[1])
    ranked = []
    for number, (name, text) in enumerate(plans):
        keep = problem.observations.unit == -1
        for s in problem.observations.series:
            if s.log == number:
                keep[s.start : s.stop] = True
        j = jacobian[keep]
        if not keep.any() or not np.isfinite(white[:, keep]).all() or not np.isfinite(j).all():
            continue  # a rover that cannot drive this here
        pairs = {
            # Told apart only where neither can be refitted so that it looks like the other.
            (a, b): min(_left(problem, known, white[i, keep] - white[k, keep], j, free, effects, n) for n in (a, b))
            for (i, a), (k, b) in itertools.combinations(enumerate(names), 2)
        }
        # A plan is worth what it does for the pair that it tells apart least.
        worst = min(pairs, key=lambda p: pairs[p])
        ranked.append(Plan(name, text, float(np.sqrt(max(pairs[worst], 0.0))), worst))
    return sorted(ranked, key=lambda p: -p.separation)


def _left(
    problem: DriveProblem,
    known: _Knowledge,
    difference: np.ndarray,
    jacobian: np.ndarray,
    free: np.ndarray,
    effects: Sequence[str],
    hypothesis: str,
) -> float:
    """Squared length of a difference after the hypothesis has been refitted to it, the earlier logs counted in."""
    other_columns = np.concatenate([[-1], *(problem.candidates[e] for e in effects if e != hypothesis)])
    mine = ~np.isin(free, other_columns)
    columns, places = jacobian[:, mine], free[mine]
    precision = np.diag([1.0 / problem.coordinates[i].prior ** 2 for i in places])
    index = {key: k for k, key in enumerate(known.keys)}
    shared = [k for k, i in enumerate(places) if problem.coordinates[i].key in index]
    at = [index[problem.coordinates[places[k]].key] for k in shared]
    # In place of the prior and not beside it: what earlier logs know holds the prior already.
    precision[np.ix_(shared, shared)] = known.precision[np.ix_(at, at)]
    # The least of |d - J x|^2 + x P x over x, in closed form.
    downhill = columns.T @ difference
    return float(
        difference @ difference - downhill @ np.linalg.pinv(columns.T @ columns + precision, hermitian=True) @ downhill
    )


def _sentence(names: Sequence[str], plans: Sequence[Plan]) -> str:
    listed = " and ".join(names) if len(names) == 2 else ", ".join(names)
    if not plans:
        return f"No planned measurement could be simulated to tell {listed} apart."
    best = plans[0]
    pair = f" (least for {best.pair[0]} against {best.pair[1]})" if len(names) > 2 else ""
    if best.separation < CHOICE.separable:
        return (
            f"No planned measurement tells {listed} apart with these instruments: the best, {best.name}, would show a "
            f"difference of {best.separation:.2g} sigma{pair}; measure longer, or with less noise."
        )
    runners_up = "; ".join(f"{p.name} {p.separation:.3g}" for p in plans[1:4])
    return f"Measure next: {best.name}. It would show {listed} apart by {best.separation:.3g} sigma{pair}." + (
        f" Next best: {runners_up} sigma." if runners_up else ""
    )
