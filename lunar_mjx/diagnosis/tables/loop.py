"""Tables through the verbs: forms of the wheel from a run, their comparison, and the diagnosis."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from lunar_mjx.diagnosis import build_problem
from lunar_mjx.diagnosis.candidates import usable
from lunar_mjx.diagnosis.contact_laws import LAWS, contact_laws, log_shares, no_addition, with_law
from lunar_mjx.diagnosis.runs import HYPOTHESES_FILE, Run
from lunar_mjx.diagnosis.tables import problem as tables
from lunar_mjx.diagnosis.tables.settings import TableSettings
from lunar_mjx.diagnosis.tables.wheel_form import WheelForm, table_data
from lunar_mjx.diagnosis.weighed.form import Problem
from lunar_mjx.effects import catalogue
from lunar_mjx.errors import UserError
from lunar_mjx.logs import SteadyLog
from lunar_mjx.model import Model
from lunar_mjx.wheel_bed.bed import WheelBed

Progress = Callable[[str, float], None]


@dataclasses.dataclass(frozen=True, eq=False)
class Tables(Problem):
    """The tables of a run as a problem.

    Attributes:
      forms: contact laws.
    """

    forms: Sequence[WheelForm]
    settings: TableSettings

    @property
    def own(self) -> WheelForm:
        """The form of the model as given."""
        return self.forms[0]


def build_tables(
    run: Run,
    logs: Sequence[SteadyLog],
    only: Sequence[str] | None = None,
    rivals: bool = True,
    settings: TableSettings | None = None,
) -> Tables:
    """The problem of a run's tables.

    Args:
      run: model, candidates, splits. logs: its tables.
      only: candidates to include; all if None. rivals: whether other contact laws take part.
      settings: sizes, priors, effort; the usual ones if None.

    Raises:
      UserError: a candidate that does not exist.
    """
    settings = settings or TableSettings.of(run.settings)
    known = build_problem.candidate_effects(run)
    for name in only or ():
        if name not in known:
            raise UserError(f"effect {name!r} is no candidate here; use one of {', '.join(known)}.")
    candidates = {n: e for n, e in known.items() if only is None or n in only}
    observations, tests = tables._observations(logs, run.splits, run.discrepancy)
    data = table_data(logs, observations, [t for t, _ in tests], settings)
    gravity = float(data.imposed.gravity[0])  # of `next` and of formulas; the forms take every point's own
    forms, all_effects, refused = [], {}, ()
    laws = contact_laws(run.model, settings.laws if rivals else ())
    for number, (name, model) in enumerate(laws.items()):
        bed = WheelBed.of_first_wheel(model, gravity)
        present = [e.name for e in bed.effects]
        mine = {n: e for n, e in candidates.items() if not e.replaces and not no_addition(present, n)}
        effects, left = usable(bed.effects, mine, tables._unfit)
        refused = left if number == 0 else refused
        union = bed
        for effect in effects.values():
            union = union.with_effect(effect, **effect.null())
        coordinates, baseline, places = tables._coordinates(bed, effects, tables.BASELINE, {})
        prior = log_shares(len(laws))[number]
        forms.append(WheelForm(name, data, union, coordinates, baseline, places, settings, prior))
        all_effects |= effects
    return Tables(tuple(forms), all_effects, refused, settings, _not_used(run.model))


def _not_used(model: Model) -> str:
    """Effects of a model that read channels of drives and no table's columns, as one sentence; empty if it has none."""
    names = [e.name for e in model.effects if "sensor" in e.ports]
    if not names:
        return ""
    return f"Not used: {', '.join(names)} of the model ({tables.SENSORS})."


def grown_model(
    run: Run, logs: Sequence[SteadyLog], names: Sequence[str], values: Mapping[str, float], progress: Progress
) -> Model:
    """The run's model with effects, and another contact law where one is among them, at the values of their refit.

    Args:
      run: with its model. logs: its tables. names: of effects, or file.py:name; a part of a contact law stands for it.
      values: parameters to hold at other than their fitted values. progress: told of the refit.
    """
    base = run.model
    for law, parts in LAWS.items():
        if set(parts) & set(names):
            base = with_law(base, law)
    effects = [n for n in names if not any(n in parts for parts in LAWS.values())]
    specs = tuple(n for n in effects if ".py" in n and n not in run.candidates)
    grown = dataclasses.replace(run, model=base, candidates=(*run.candidates, *specs))
    problem = build_tables(grown, logs, rivals=False)
    model = base
    for name in effects:
        model = model.add(name if ".py" in name else catalogue.get(name), "add", **values)
    new = frozenset(catalogue.get(n).name for n in effects) & set(problem.own.candidates)
    progress("refitting with " + ", ".join(sorted(new) or [problem.own.name]), 0.0)
    form = problem.own
    # where the search of `why` ended: the refit is then a few steps, and ends in the minimum that was judged
    kept = (run.load(HYPOTHESES_FILE) or {}).get(" + ".join([form.name, *sorted(new)]), {}).get("u")
    start = None if kept is None else np.array([kept.get(c.key, 0.0) for c in form.coordinates])
    with threadpool_limits(1, "blas"):
        near = form.refit(frozenset(), None, None) if new and start is None else None
        alone = form.alone(form.refit(new, near, start))
    for i, c in enumerate(form.coordinates):
        mine = i in form.baseline or c.effect in new
        if mine and c.effect in model.effect_names and c.name not in values:
            value = c.value_within(alone[i])
            old = model.parameters[c.effect][c.name]
            model = model.set(
                c.effect, "fit", **{c.name: tuple(value for _ in old) if isinstance(old, tuple) else value}
            )
    return model
