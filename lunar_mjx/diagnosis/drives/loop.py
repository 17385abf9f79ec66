"""Drives through the verbs: the form of a rover's model from a run, and that model with effects added."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from lunar_mjx.diagnosis.build_problem import candidates_of
from lunar_mjx.diagnosis.contact_laws import CLOSED_FORM, LAWS, contact_laws, log_shares
from lunar_mjx.diagnosis.drives.baseline import with_nominal_controller
from lunar_mjx.diagnosis.drives.form import LEARNT, DriveForm
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.fitted_model import fitted_model
from lunar_mjx.diagnosis.runs import COMPARISON_FILE, Run
from lunar_mjx.diagnosis.weighed.answer import kept_start
from lunar_mjx.diagnosis.weighed.form import Problem
from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect
from lunar_mjx.errors import bad_input
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.logs import Log
from lunar_mjx.model import Model


def build_drives(
    run: Run,
    logs: Sequence[Log],
    only: Sequence[str] | None = None,
    progress: Progress = silent,
    candidates: Mapping[str, Effect] | None = None,
    rivals: bool = False,
) -> Problem:
    """The problem of a run's drives.

    Args:
      run: model, candidates, splits, settings. logs: its drives.
      only: candidates to include; all if None. progress: told of simulations and refits.
      candidates: effects by name, in place of those of the catalogue.
      rivals: whether other contact laws take part, where the model has the closed form.

    Raises:
      UserError: a candidate or a setting that does not exist; rival laws of a model without a law of soil.
    """
    settings = DriveSettings.of(run.settings)
    wanted = candidates_of(run, only) if candidates is None else candidates
    model = with_nominal_controller(run.model)

    def problem_of(model: Model) -> DriveProblem:
        return DriveProblem(
            logs, model, wanted, run.splits, progress=progress, discrepancy=run.discrepancy, span=settings.span
        )

    drives = problem_of(model)
    form = DriveForm(drives, settings, progress)
    # what was kept of a model whose controllers followed its motors is another model's
    kept = kept_start(run, form, frozenset()) if model is run.model else None
    if kept is not None:
        told = run.load(COMPARISON_FILE) or {}
        form.start, form.kept = kept, told if LEARNT.issubset(told) else {}
    forms, laws = [form], contact_laws(model, settings.laws)
    own = next(iter(laws))
    if settings.laws and own not in LAWS:
        problem = "has no use beside a model without a closed form"
        raise bad_input("settings", "laws", ", ".join(settings.laws), problem, "leave it away")
    # the closed form is an approximation of the others: beside one of these it is no rival
    for law in [name for name in laws if rivals and own == CLOSED_FORM and name != own]:
        beside = problem_of(laws[law])
        forms.append(DriveForm(beside, settings, progress, law, form))
    for one, prior in zip(forms, log_shares(len(forms)), strict=True):
        one.log_prior = prior
    return Problem(forms, drives.effects, drives.not_tested, settings, drives.unused)


def grown_drives(
    run: Run, logs: Sequence[Log], names: Sequence[str], values: Mapping[str, float], progress: Progress
) -> Model:
    """The run's model with effects at the values of their refit.

    Args:
      run: with its model. logs: its drives. names: of effects, or file.py:name.
      values: parameters to hold at other than their fitted values. progress: told of the refit.
    """
    effects = {n: catalogue.get(n) for n in names}
    run = dataclasses.replace(run, model=with_nominal_controller(run.model))
    model = run.model
    for name, effect in effects.items():
        model = model.add(name if ".py" in name else effect, "add", **values)
    if set(run.model.effect_names) - set(model.effect_names):
        return model  # another form of what it replaces: its own comparison refits it
    specs = tuple(n for n in names if ".py" in n and n not in run.candidates)
    grown = dataclasses.replace(run, candidates=(*run.candidates, *specs))
    form = build_drives(grown, logs, [e.name for e in effects.values()], progress).own
    new = frozenset(e.name for e in effects.values()) & set(form.candidates)
    progress("refitting with " + ", ".join(sorted(new)), 0.0)
    base = form.refit(frozenset(), None, None)
    start = kept_start(run, form, new)
    refit = form.refit(new, base if start is None else None, start) if new else base
    moved = [*form.baseline, *(i for e in new for i in form.candidates[e])]
    return fitted_model(form.coordinates, refit.u, moved, model, values)
