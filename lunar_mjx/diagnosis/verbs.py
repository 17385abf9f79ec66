"""The verbs of criticism: compare, why, add, improve. Each works on a run folder and returns plain data."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import math
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.build_problem import (
    candidate_effects,
    candidates_of,
    known_logs,
    require_discrepancy,
    require_splits,
)
from lunar_mjx.diagnosis.contact_laws import LAWS, better_law, no_addition
from lunar_mjx.diagnosis.drives.baseline import with_nominal_controller
from lunar_mjx.diagnosis.drives.loop import build_drives, grown_drives
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.drives.windows import verbs as windows
from lunar_mjx.diagnosis.folder.refits import write_refits
from lunar_mjx.diagnosis.runs import COMPARISON_FILE, VERDICT_FILE, Run, load_run, log_folders
from lunar_mjx.diagnosis.tables.loop import build_tables, grown_model
from lunar_mjx.diagnosis.tables.settings import TableSettings
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.diagnosis.weighed import answer
from lunar_mjx.diagnosis.weighed.form import Problem, SearchSettings
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.inference.observations import Observations
from lunar_mjx.logs import Log, SteadyLog
from lunar_mjx.logs.findings import is_bad
from lunar_mjx.model import Model


class BadData(Exception):
    """The logs did not pass the gate; carries the diagnosis `BAD_DATA`."""

    def __init__(self, diagnosis: Diagnosis):
        super().__init__(diagnosis.sentence)
        self.diagnosis = diagnosis


def compare(
    logs: Sequence[str | Path],
    model: Model,
    out: str | Path,
    effects: Sequence[str] = (),
    splits: Mapping[str, str] | None = None,
    seed: int = 0,
    discrepancy: Mapping[str, float] | None = None,
    progress: Progress = silent,
    settings: Mapping[str, Any] | None = None,
) -> Run:
    """Holds a model against logs: as it stands, and refitted; writes the run folder with `comparison.json`.

    Args:
      logs: folders of logs or campaigns, all drives or all steady-state tables.
      model: what is compared.
      out: the run folder.
      effects: the user's own effects (file.py:name) that `why` may propose.
      splits: split of logs (or of groups of points) by name, in place of the default.
      seed: of all random starts.
      discrepancy: known unexplained error by quantity of a table, SI units, added to the noise.
      progress: told what is being done.
      settings: of a diagnosis of tables, by name, where they are not the usual ones (`diagnosis.tables.settings`).

    Returns:
      The run.

    Raises:
      UserError: a mistake of the user's. BadData: the logs do not pass the gate.
    """
    folders = log_folders(logs)
    for log in folders:
        # The run's files would change the log, which is known by its bytes.
        if Path(out).resolve().is_relative_to(log):
            raise bad_input("compare", "--out", str(out), f"lies in the log {log}", "name a folder beside it")
    run = Run(
        Path(out),
        folders,
        model,
        tuple(effects),
        dict(splits or {}),
        seed=seed,
        discrepancy=dict(discrepancy or {}),
        settings=dict(settings or {}),
    )
    return _compare(run, progress)


def _compare(run: Run, progress: Progress) -> Run:
    campaign = gate(run, new=True)
    require_splits(run.splits, campaign)
    require_discrepancy(run.discrepancy, campaign)
    # Logs whose wheels moved as measured are compared in windows, each from its measured start.
    if windows.imposed(campaign):
        return windows.compare(run, campaign, progress)
    # Before the folder is made: a mistake leaves nothing behind.
    (TableSettings if isinstance(campaign[0], SteadyLog) else DriveSettings).of(run.settings)
    if not isinstance(campaign[0], SteadyLog):
        run = dataclasses.replace(run, model=with_nominal_controller(run.model))
    run.write()
    # Without candidates: what may be missing is the business of `why`, and would cost compiling here.
    problem = _problem(run, campaign, (), progress)
    own, refit = problem.own, answer.compare(run, problem, progress)
    # Kept beside the errors, since a report must tell who chose what was held out.
    stated = {log.name: log.split for log in campaign if isinstance(log, Log) and log.split}
    run.save(COMPARISON_FILE, {**run.load(COMPARISON_FILE), "log_splits": stated})
    rows = {"as given": own.origin(), "refitted": refit.u}
    _record_opening(run, "compare", own.observations, own.coordinates, own.baseline, rows)
    return run


def _problem(run: Run, logs: Sequence[Any], only: Sequence[str] | None, progress: Progress) -> Problem:
    """The problem of a run's tables or drives; without candidates where `only` is empty."""
    if isinstance(logs[0], SteadyLog):
        return build_tables(run, logs, rivals=False) if only == () else build_tables(run, logs, only)
    return build_drives(run, logs, only, progress, rivals=only != ())


def gate(run: Run, new: bool = False) -> list[Any]:
    """Reads and checks the logs of a run.

    Args:
      run: whose logs. new: whether it takes the place of what an earlier run has left in the folder.

    Raises:
      BadData: they are not fit to be used.
    """
    logs, findings = run.checked
    if is_bad(findings):
        bad = [f for f in findings if f.severity == "bad_data"]
        sentence = f"{bad[0].where}: {bad[0].message}" + (f" ({len(bad) - 1} more)" if len(bad) > 1 else "")
        diagnosis = Diagnosis(Verdict.BAD_DATA, (), sentence, details={"findings": [f.to_dict() for f in findings]})
        # A refused log leaves a verdict, too: `report` can show the findings without reading the logs again.
        if new:
            run.write()
        run.save(VERDICT_FILE, diagnosis.to_dict())
        raise BadData(diagnosis)
    return list(logs)


def _record_opening(
    run: Run,
    verb: str,
    observations: Observations,
    coordinates: Sequence[Coordinate],
    baseline: np.ndarray,
    rows: Mapping[str, np.ndarray],
) -> None:
    """Puts on record which places' errors on the test split have been computed, by label."""
    # Without a test split nothing was opened, and a record of it would only alarm.
    if not observations.in_split("test").any():
        return
    prints = {}
    for label, u in rows.items():
        moved = [
            # Nine digits: the same fit made again differs by rounding alone, and is no new opening.
            f"{c.key} {c.value(v):.9g}"
            for i, (c, v) in enumerate(zip(coordinates, u, strict=True))
            # Candidates at rest at zero are no part of the model: the print is that of the model that was judged.
            if v != 0.0 or i in baseline
        ]
        prints[label] = hashlib.sha256("\n".join(moved).encode()).hexdigest()[:16]
    run.opened_test(verb, prints)


def why(
    folder: str | Path | Run,
    only: Sequence[str] | None = None,
    progress: Progress = silent,
    seconds: float | None = None,
    about: str | None = None,
) -> Diagnosis:
    """Localises and attributes the misfit of a run; writes `verdict.json`.

    Args:
      folder: of the run. only: candidates to consider; all if None. progress: told what is being done.
      seconds: after which the answer is to be there, as far as it is known by then; without, logs with imposed wheel
        speeds have `windows.TELLING.seconds` and others as long as it takes.
      about: a candidate that the answer will be asked about, see `explain`.

    Raises:
      UserError: the folder is no run, or a name is no candidate: before anything is fitted.
    """
    began = time.monotonic()
    run = folder if isinstance(folder, Run) else load_run(folder)
    try:
        campaign = gate(run)
    except BadData as bad:
        return bad.diagnosis
    known_logs(run)
    if windows.imposed(campaign):
        limit = windows.TELLING.seconds if seconds is None else seconds
        left = max(limit - (time.monotonic() - began), 0.0)
        return windows.why(run, campaign, only, left, progress, about)
    if about is not None:
        _require_candidate(about, run, campaign, only)
    problem = _problem(run, campaign, only, progress)
    # Reading and checking count, too: the user's clock began with the command.
    left = math.inf if seconds is None else max(seconds - (time.monotonic() - began), 0.0)
    diagnosis, model_search = answer.diagnose(run, problem, progress, left)
    if model_search is not None:
        own = problem.own
        rows = {"refitted": model_search.base(own.name).refit.u}
        # Hypotheses come by falling probability: the first that was refitted is the best that was seen.
        best = next(h for h in model_search.hypotheses if h.refitted)
        # Another contact law has other coordinates, whose values would mean nothing to this problem.
        if best.form == own.name:
            rows[", ".join(sorted(best.effects)) or "refitted"] = best.refit.u
        if not isinstance(campaign[0], SteadyLog):  # those of tables are made by `studio`, a second each
            write_refits(
                run.folder,
                {
                    tuple(sorted(h.effects)): (own.residual(own.bare(h.refit.u)), own.predicted(own.bare(h.refit.u)))
                    for h in model_search.hypotheses
                    if h.refitted and h.effects and h.form == own.name
                },
            )
        _record_opening(run, "why", own.observations, own.coordinates, own.baseline, rows)
    run.save(VERDICT_FILE, diagnosis.to_dict())
    return diagnosis


def _require_candidate(name: str, run: Run, logs: Sequence[Any], only: Sequence[str] | None) -> None:
    """Raises `UserError` for an effect that a verdict on these logs will not speak of."""
    held = set(run.model.effect_names)
    if name in held:
        raise bad_input("why", "--explain", name, "is in the model already", "name an effect that may be missing")
    if isinstance(logs[0], SteadyLog):
        known = [n for n in candidate_effects(run) if only is None or n in only]
    else:
        known = list(candidates_of(run, only))
    if name not in known:
        remedy = f"use one of {', '.join(n for n in known if n not in held)}"
        raise bad_input("why", "--explain", name, "is no candidate here", remedy)


def explain(diagnosis: Diagnosis, effect: str) -> Diagnosis:
    """The diagnosis of a run narrowed to one effect: the answer to "is it this effect?".

    Without a fit there is none, and the diagnosis itself says why.

    Raises:
      UserError: the diagnosis says nothing about it.
    """
    if diagnosis.verdict in (Verdict.BAD_DATA, Verdict.BAD_FIT):
        return diagnosis
    evidence = next((e for e in diagnosis.evidence if e.effect == effect), None)
    if evidence is None:
        refused = {n["effect"]: n["reason"] for n in diagnosis.details.get("not_tested", [])}
        # No typing error: the effect exists, and the logs cannot tell it.
        if effect in refused:
            sentence = f"{effect} cannot be tested here: it {refused[effect]}."
            return dataclasses.replace(diagnosis, verdict=Verdict.UNDECIDABLE, effects=(effect,), sentence=sentence)
        raise UserError(
            f"why --explain: nothing is known about {effect!r}; use one of "
            f"{', '.join(e.effect for e in diagnosis.evidence)}."
        )
    nearest = (
        f"; its nearest confounder is {evidence.nearest[0]} (|cos| {evidence.nearest[1]:.2f})"
        if evidence.nearest[0]
        else ""
    )
    if evidence.status == "not tested":
        return dataclasses.replace(
            diagnosis,
            verdict=Verdict.UNDECIDABLE,
            effects=(effect,),
            sentence=f"{effect} leaves no separable signal in these logs: {evidence.reason}{nearest}.",
        )
    if evidence.status == "not refitted":
        said = f"No refit with {effect} was made, so nothing is said of it; give more --seconds, or --only {effect}."
        return dataclasses.replace(diagnosis, verdict=Verdict.UNDECIDABLE, effects=(effect,), sentence=said)
    values = ", ".join(f"{k} {v:.3g} +- {evidence.std.get(k, 0.0):.1g}" for k, v in evidence.values.items())
    sentence = (
        f"{effect} is missing with probability {evidence.probability:.3f}; it would show with "
        f"{evidence.separable_sigma:.1f} sigma at its usual size, its best fit is {values or 'none'}{nearest}."
    )
    return dataclasses.replace(diagnosis, sentence=sentence)


def add(folder: str | Path | Run, effect: str, out: str | Path, progress: Progress = silent, **values: float) -> Run:
    """Adds an effect to a run's model, refits on the fitted manoeuvres, and compares anew in another folder.

    Args:
      folder: of the run. effect: catalogue name or file.py:name. out: the new run's folder.
      progress: told what is being done.
      **values: parameters of the effect to hold at other than their fitted values.

    Raises:
      UserError: no such effect, or it is in the model already.
    """
    run = folder if isinstance(folder, Run) else load_run(folder)
    # Before the gate reads hours of logs.
    if Path(out).resolve() == run.folder.resolve():
        raise bad_input("add", "--out", out, "is the run itself, which would be lost", "name another folder")
    campaign = gate(run)
    known_logs(run)
    if windows.imposed(campaign):
        return windows.add(run, campaign, effect, Path(out), progress)
    from lunar_mjx.effects import catalogue

    new = catalogue.get(effect)
    if new.name in run.model.effect_names:
        raise UserError(
            f"add: the model has {new.name} already; remove it from {run.folder / 'model.toml'} to add it anew."
        )
    return _add(run, campaign, [effect], out, progress, values)


def improve(
    logs: Sequence[str | Path],
    model: Model,
    out: str | Path,
    effects: Sequence[str] = (),
    splits: Mapping[str, str] | None = None,
    seed: int = 0,
    most: int = 8,
    discrepancy: Mapping[str, float] | None = None,
    progress: Progress = silent,
    settings: Mapping[str, Any] | None = None,
) -> tuple[Diagnosis, list[Run]]:
    """The whole loop unattended: compare, why, add, while the verdict names something or is UNKNOWN.

    What a round adds is every effect that is more probable than not. Where there is none the loop ends, too. A contact
    law with which the model itself predicts the fitted measurements worse than before is taken back: what had been
    added for the old law went with it. It is not tried again, and the details of every later verdict tell of it, as
    `taken_back`.

    Args:
      logs, model, effects, splits, seed, discrepancy, progress, settings: as for `compare`.
      out: folder of the runs run1, run2, ...
      most: rounds that add something at most.

    Returns:
      The last verdict, and the runs.
    """
    out = Path(out)
    try:
        run = compare(logs, model, out / "run1", effects, splits, seed, discrepancy, progress, settings)
    except BadData as bad:
        return bad.diagnosis, []
    runs = [run]
    refused: list[dict[str, Any]] = []
    while True:
        diagnosis = _telling_of(refused, why(run, progress=progress), run)
        present = run.model.effect_names
        names = _next_to_add(diagnosis, run)
        if not {r["law"] for r in refused}.isdisjoint(names):
            names = _without_law(names, present)
        if not names or len(runs) > most:
            return diagnosis, runs
        # A verdict calls the user's own effects by their bare names; to be added again they need their file.
        specs = {s.rpartition(":")[2]: s for s in effects}
        names, place = [specs.get(n, n) for n in names], out / f"run{len(runs) + 1}"
        campaign = gate(run)
        if windows.imposed(campaign):
            run = add(run, names[0], place, progress)
        else:
            grown = _add(run, campaign, names, place, progress, {})
            if _LAWS & set(names) and not _fitted_error(grown) <= _fitted_error(run):
                progress("taking the contact law back: with it the model itself fits worse", math.nan)
                refused.append(_refusal(names, run, grown))
                diagnosis = _telling_of(refused, diagnosis, run)
                names = _without_law(names, present)
                if not names:
                    # kept beside the runs: it has opened what was held out, and may hold files of its user
                    place.rename(next(p for k in itertools.count(1) if not (p := out / f"taken_back{k}").exists()))
                    return diagnosis, runs
                grown = _add(run, campaign, names, place, progress, {})
            run = grown
        runs.append(run)


_LAWS = frozenset(parts[0] for parts in LAWS.values())
"""Effects by which contact laws are added."""


def _without_law(names: Sequence[str], present: Collection[str]) -> list[str]:
    """Effects to add to those of a model, without contact laws and without what is no addition to the model's own."""
    return [n for n in names if n not in _LAWS and not no_addition(present, n)]


def _refusal(names: Sequence[str], run: Run, grown: Run) -> dict[str, Any]:
    """What is told of a contact law that is taken back.

    Args:
      names: what was added, a law and the effects beside it. run, grown: before and after.

    Returns:
      The `law`, the effects added `beside` it, the `run` before, the errors `before` and `after` of the model alone in
      the fitted measurements, sigma, and the `sentence` that says so.
    """
    law = next(n for n in names if n in _LAWS)
    beside = [n for n in names if n != law]
    before, after = _fitted_error(run), _fitted_error(grown)
    also = f" and with {', '.join(beside)}" if beside else ""
    name = run.folder.name
    sentence = (
        f"{law} was taken back: in place of the contact law of {name}{also} the model itself fits worse, "
        f"{after:.3g} sigma in the fitted measurements where it had {before:.3g}."
    )
    return {"law": law, "beside": beside, "run": name, "before": before, "after": after, "sentence": sentence}


def _telling_of(refused: Sequence[Mapping[str, Any]], diagnosis: Diagnosis, run: Run) -> Diagnosis:
    """A run's verdict with the contact laws that were taken back so far; the run's file of it tells of them, too."""
    if not refused:
        return diagnosis
    diagnosis = dataclasses.replace(diagnosis, details={**diagnosis.details, "taken_back": list(refused)})
    run.save(VERDICT_FILE, diagnosis.to_dict())
    return diagnosis


def _fitted_error(run: Run) -> float:
    """Error, in sigma, of the model alone in the fitted measurements of a comparison."""
    return float(run.load(COMPARISON_FILE)["refitted"]["fit"])


def _add(
    run: Run,
    logs: Sequence[Any],
    names: Sequence[str],
    out: str | Path,
    progress: Progress,
    values: Mapping[str, float],
) -> Run:
    """Adds effects to the model of a run, all at once, and compares anew in another folder."""
    from lunar_mjx.effects import catalogue

    # The user's files stay with the run, so that later verbs find the effect without being told of it.
    specs = tuple(n for n in names if ".py" in n and n not in run.candidates)
    grown = dataclasses.replace(run, candidates=(*run.candidates, *specs))
    grow = grown_model if isinstance(logs[0], SteadyLog) else grown_drives
    model = grow(grown, logs, names, values, progress)
    added = (*run.added, *(catalogue.get(n).name for n in names))
    child = dataclasses.replace(grown, folder=Path(out), model=model, added=added, parent=str(run.folder.resolve()))
    return _compare(child, progress)


def _next_to_add(diagnosis: Diagnosis, run: Run) -> list[str]:
    """What `improve` adds next: the effects that are more probable than not, and the most probable contact law.

    Names are said where they are sure; a model is grown to foresee. Of all single models the one of the terms that are
    more probable than not foresees best in the mean square (the median probability model, Barbieri & Berger 2004). It
    is made of the most probable contact law: there is no model without a law, so that keeping the old one is a choice
    like any other. A law alone is exchanged where it is surely better. Something unlisted changes none of this: beside
    it shares of the effects are not known, and their absence is no better guess.
    """
    # Calibration belongs to the instruments of these logs, and not into a model for other drives.
    no_effects = ("unlisted at ", "calibration")
    named = [n for n in diagnosis.effects if not n.startswith(no_effects)]
    probable = [n for n, p in diagnosis.inclusion.items() if p > 0.5 and not n.startswith(no_effects)]
    sure = float(run.settings.get("sure", SearchSettings().sure))
    names: list[str] = []
    if diagnosis.verdict in (Verdict.KNOWN, Verdict.MULTIPLE):
        names = [*dict.fromkeys([*named, *probable])]
    elif diagnosis.verdict is Verdict.UNKNOWN:
        # what held-out drives have taken back is probable by the fitted ones, and none of the verdict's effects
        names = [n for n in named if n in probable]
    names = [n for n in names if n not in run.model.effect_names]
    # Beside an effect any likelier law is taken; alone it must be sure, or rounds would swap laws to and fro.
    law = better_law(diagnosis.forms, run.model, 0.0 if names else sure)
    return [*([law] if law else []), *names]
