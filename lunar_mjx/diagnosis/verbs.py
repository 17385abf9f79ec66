"""The verbs of criticism: compare, why, add, improve. Each works on a run folder and returns plain data."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.attribute import diagnose, parameters
from lunar_mjx.diagnosis.build_problem import build_problem, require_splits
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.windows import verbs as windows
from lunar_mjx.diagnosis.fitted_model import fitted_model
from lunar_mjx.diagnosis.folder.refits import write_refits
from lunar_mjx.diagnosis.refit import Settings
from lunar_mjx.diagnosis.runs import (
    COMPARISON_FILE,
    FITS_FILE,
    SERIES_FILE,
    SIGNATURES_FILE,
    VERDICT_FILE,
    Run,
    load_run,
    log_folders,
)
from lunar_mjx.diagnosis.search import Search, fit_baseline
from lunar_mjx.diagnosis.tables.loop import better_law, build_tables, grown_model
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.diagnosis.weighed import answer
from lunar_mjx.diagnosis.weighed.form import SearchSettings
from lunar_mjx.errors import UserError
from lunar_mjx.files import replacing
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import Fit, Progress, silent
from lunar_mjx.inference.held_out import errors, noise_test
from lunar_mjx.inference.objective import whitened_residuals
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.problem import Problem
from lunar_mjx.logs import SteadyLog
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
    run = Run(
        Path(out),
        log_folders(logs),
        model,
        tuple(effects),
        dict(splits or {}),
        seed=seed,
        discrepancy=dict(discrepancy or {}),
        settings=dict(settings or {}),
    )
    return _compare(run, progress)


def _compare(run: Run, progress: Progress) -> Run:
    campaign = gate(run)
    require_splits(run.splits, campaign)
    if windows.imposed(campaign):
        return windows.compare(run, campaign, progress)
    run.write()
    if isinstance(campaign[0], SteadyLog):
        tables = build_tables(run, campaign, rivals=False)
        own, refit = tables.own, answer.compare(run, tables, progress)
        rows = {"as given": own.origin(), "refitted": refit.u}
        _record_opening(run, "compare", own.observations, own.coordinates, own.baseline, rows)
        return run
    # All candidates are in the problem from the start: `why` then shares the program that is compiled here.
    problem = build_problem(run, campaign, progress=progress)
    memory = _memory(run)
    problem.foresee(problem.origin()[None], problem.free())
    start = whitened_residuals(problem, problem.origin()[None])[0]
    fitted = fit_baseline(problem, Settings(seed=run.seed), memory, progress)
    stated = {log.name: log.split for log in campaign if log.split}
    unused = problem.unused if isinstance(problem, DriveProblem) else ""
    run.save(COMPARISON_FILE, {**comparison(problem, start, fitted), "log_splits": stated, "unused": unused})
    _save_series(run, problem, start, {"refitted": fitted})
    _record_test(run, "compare", problem, {"refitted": fitted})
    return run


def gate(run: Run) -> list[Any]:
    """Reads and checks the logs of a run.

    Raises:
      BadData: they are not fit to be used.
    """
    logs, findings = run.checked
    if is_bad(findings):
        bad = [f for f in findings if f.severity == "bad_data"]
        sentence = f"{bad[0].where}: {bad[0].message}" + (f" ({len(bad) - 1} more)" if len(bad) > 1 else "")
        diagnosis = Diagnosis(Verdict.BAD_DATA, (), sentence, details={"findings": [f.to_dict() for f in findings]})
        run.folder.mkdir(parents=True, exist_ok=True)
        run.save(VERDICT_FILE, diagnosis.to_dict())
        raise BadData(diagnosis)
    return list(logs)


def _memory(run: Run) -> Memory:
    return Memory(run.load(FITS_FILE), lambda entries: run.save(FITS_FILE, entries))


def comparison(problem: Problem, start: np.ndarray, fitted: Fit) -> dict[str, Any]:
    """Errors in sigma of the model as given and refitted, by log and channel, and the refitted parameters."""
    observations = problem.observations
    table = []
    for s in observations.series:
        part = slice(s.start, s.stop)
        for unit in np.unique(observations.unit[part]):
            keep = np.arange(s.start, s.stop)[observations.unit[part] == unit]
            table.append(
                {
                    "manoeuvre": observations.unit_names[unit],
                    "split": observations.unit_split[unit],
                    "channel": s.channel,
                    "samples": len(keep),
                    "as_given": _rms(start[keep]),
                    "refitted": _rms(fitted.residual[keep]),
                }
            )
    given = {k: _rms(start[observations.in_split(*v)]) for k, v in _SPLITS.items() if observations.in_split(*v).any()}
    return {
        "unit": "sigma of the measurement noise",
        "as_given": given,
        "refitted": errors(problem, fitted),
        "noise_test": dataclasses.asdict(noise_test(problem, fitted)),
        "by_channel": table,
        "parameters": _parameter_table(problem, fitted),
        "certificate": {
            "chi2": fitted.chi2,
            "gradient": fitted.gradient,
            "starts": list(fitted.starts),
            "at_bound": list(fitted.at_bound),
            "problems": list(fitted.problems),
            **fitted.extra,
        },
        "observations": len(observations),
        "logs": list(observations.logs),
    }


_SPLITS = {
    "fit": ("fit",),
    "select": ("select",),
    "test": ("test",),
    "held_out": ("select", "test"),
    "apart": ("apart",),
}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _parameter_table(problem: Problem, fitted: Fit) -> dict[str, Any]:
    """Fitted values and standard deviations by effect and name, with units and the values that the model came with."""
    moved = [c for c in (problem.coordinates[i] for i in fitted.free) if not c.nuisance]
    table: dict[str, Any] = {}
    covariance = fitted.covariance(problem)
    for effect in dict.fromkeys(c.effect for c in moved):
        value, std = parameters(problem, fitted, effect, covariance)
        mine = [c for c in moved if c.effect == effect]
        table[effect] = {
            "value": value,
            "std": std,
            "given": {c.name: c.start for c in mine},
            "unit": {c.name: "factor" if c.factor else c.unit for c in mine},
        }
    return table


def _record_test(run: Run, verb: str, problem: Problem, fits: Mapping[str, Fit]) -> None:
    """Puts on record which models' errors on the test split have been computed."""
    rows = {"as given": problem.origin(), **{label: f.u for label, f in fits.items()}}
    _record_opening(run, verb, problem.observations, problem.coordinates, problem.baseline, rows)


def _record_opening(
    run: Run,
    verb: str,
    observations: Observations,
    coordinates: Sequence[Coordinate],
    baseline: np.ndarray,
    rows: Mapping[str, np.ndarray],
) -> None:
    """Puts on record which places' errors on the test split have been computed, by label."""
    if not observations.in_split("test").any():
        return
    prints = {}
    for label, u in rows.items():
        moved = [
            f"{c.key} {c.value(v):.9g}"
            for i, (c, v) in enumerate(zip(coordinates, u, strict=True))
            if v != 0.0 or i in baseline
        ]
        prints[label] = hashlib.sha256("\n".join(moved).encode()).hexdigest()[:16]
    run.opened_test(verb, prints)


def _save_signatures(run: Run, found: Search) -> None:
    """Projected signatures over the fitted observations, each at its best linear amount, in sigma."""
    scored = [s for s in found.scores if s.signature.size]
    with replacing(run.folder / SIGNATURES_FILE) as part:
        np.savez_compressed(
            part,
            names=np.array([s.effect for s in scored], str),
            signatures=np.array([s.signature @ s.amount for s in scored], np.float32),
        )


def _save_series(run: Run, problem: Problem, start: np.ndarray, fits: Mapping[str, Fit]) -> None:
    """Measured and predicted series for the report, as `series.npz` (arrays only, no pickle)."""
    rows = np.array([problem.origin(), *(f.u for f in fits.values())])
    if problem.cheap_jacobian:
        predicted = problem.predict(rows)
    else:
        # those of drives have been simulated, each with the effects that it has
        parts = []
        for row, step_error in zip(rows, [None, *(f.step_error for f in fits.values())], strict=True):
            problem.use_step_error(step_error)
            parts.append(problem.predict(row))
        predicted = np.concatenate(parts)
    observations = problem.observations
    place = observations.place if observations.place is not None else np.zeros((0, 3))
    time = np.concatenate(
        [np.full(s.stop - s.start, np.nan) if s.time is None else s.time for s in observations.series]
    )
    with replacing(run.folder / SERIES_FILE) as part:
        np.savez_compressed(
            part,
            measured=observations.value,
            sigma=observations.sigma(),
            time=time,
            place=place,
            unit=observations.unit,
            unit_names=np.array(observations.unit_names),
            split=np.array(observations.unit_split),
            series_start=np.array([s.start for s in observations.series]),
            series_channel=np.array([s.channel for s in observations.series]),
            series_log=np.array([s.log for s in observations.series]),
            logs=np.array(observations.logs),
            labels=np.array(["as given", *fits]),
            predicted=predicted,
            residual=np.vstack([start, *(f.residual for f in fits.values())]),
        )


def why(
    folder: str | Path | Run,
    only: Sequence[str] | None = None,
    settings: Settings | None = None,
    progress: Progress = silent,
    seconds: float | None = None,
) -> Diagnosis:
    """Localises and attributes the misfit of a run; writes `verdict.json`.

    Args:
      folder: of the run. only: candidates to consider; all if None. settings: thresholds and effort.
      progress: told what is being done. seconds: time that the search may take, for logs with imposed wheel speeds.

    Raises:
      UserError: the folder is no run, or a time limit that cannot be kept.
    """
    run = folder if isinstance(folder, Run) else load_run(folder)
    settings = settings or Settings(seed=run.seed)
    try:
        campaign = gate(run)
    except BadData as bad:
        return bad.diagnosis
    if windows.imposed(campaign):
        return windows.why(run, campaign, only, windows.SECONDS if seconds is None else seconds, progress)
    if seconds is not None:
        raise UserError("why: --seconds is for logs with imposed wheel speeds; drop it.")
    if isinstance(campaign[0], SteadyLog):
        diagnosis, _ = answer.diagnose(run, build_tables(run, campaign, only), progress)
        run.save(VERDICT_FILE, diagnosis.to_dict())
        return diagnosis
    problem = build_problem(run, campaign, only, progress)
    problem.foresee(problem.origin()[None])
    diagnosis, found = diagnose(problem, settings, progress, _memory(run))
    if diagnosis.verdict is not Verdict.BAD_FIT:
        from lunar_mjx.diagnosis.unknown_inputs.localise import localise

        place = localise(problem, found.base, found.chosen, progress)
        port = place.port if diagnosis.verdict is Verdict.UNKNOWN else None
        sentence = diagnosis.sentence + (f" It acts at the port {' or '.join(place.alike)}." if port else "")
        others: list[dict[str, Any]] = []
        if diagnosis.verdict is Verdict.UNKNOWN and only is None:
            from lunar_mjx.diagnosis.alternatives import alternatives

            tried = alternatives(run, campaign, problem, found.chosen, progress)
            others = [dataclasses.asdict(a) for a in tried]
            if tried and tried[0].helps:
                sentence += (
                    f" {tried[0].effect} in place of {', '.join(tried[0].replaces)} does better on what was left out "
                    f"(gain {tried[0].held_out_gain:.0f} +- {tried[0].held_out_se:.0f}): add it and ask again."
                )
        diagnosis = dataclasses.replace(
            diagnosis,
            port=port,
            ports=place.ports,
            sentence=sentence,
            details={
                **diagnosis.details,
                "localise": place.to_dict(),
                "alternatives": others,
                "parameters": _parameter_table(problem, found.chosen.fit),
            },
        )
        fits = {"refitted": found.base.fit}
        if found.chosen.effects:
            fits["with " + ", ".join(found.chosen.effects)] = found.chosen.fit
        start = whitened_residuals(problem, problem.origin()[None])[0]
        _save_series(run, problem, start, fits)
        write_refits(run.folder, {c.effects: (c.fit.residual, None) for c in found.tried if c.effects})
        run.save(COMPARISON_FILE, comparison(problem, start, found.base.fit))
        _save_signatures(run, found)
        _record_test(run, "why", problem, fits)
    run.save(VERDICT_FILE, diagnosis.to_dict())
    return diagnosis


def explain(diagnosis: Diagnosis, effect: str) -> Diagnosis:
    """The answer to "is it this effect?": the diagnosis narrowed to one effect.

    Raises:
      UserError: the diagnosis says nothing about it.
    """
    found = next((e for e in diagnosis.evidence if e.effect == effect), None)
    if found is None:
        refused = {n["effect"]: n["reason"] for n in diagnosis.details.get("not_tested", [])}
        if effect in refused:
            sentence = f"{effect} cannot be tested here: it {refused[effect]}."
            return dataclasses.replace(diagnosis, verdict=Verdict.UNDECIDABLE, effects=(effect,), sentence=sentence)
        raise UserError(
            f"why --explain: nothing is known about {effect!r}; use one of "
            f"{', '.join(e.effect for e in diagnosis.evidence)}."
        )
    nearest = (
        f"; its nearest confounder is {found.nearest[0]} (|cos| {found.nearest[1]:.2f})" if found.nearest[0] else ""
    )
    if found.status == "not tested":
        return dataclasses.replace(
            diagnosis,
            verdict=Verdict.UNDECIDABLE,
            effects=(effect,),
            sentence=f"{effect} leaves no separable signal in these logs: {found.reason}{nearest}.",
        )
    if found.probability == found.probability:
        values = ", ".join(f"{k} {v:.3g} +- {found.std.get(k, 0.0):.1g}" for k, v in found.values.items())
        sentence = (
            f"{effect} is missing with probability {found.probability:.3f}; it would show with "
            f"{found.separable_sigma:.1f} sigma at its usual size, its best fit is {values or 'none'}{nearest}."
        )
        return dataclasses.replace(diagnosis, sentence=sentence)
    sentence = (
        f"{effect} is {found.status} ({found.reason}): separable {found.separable_sigma:.1f} sigma "
        f"({100.0 * found.separable_share:.1f} % of its signal), z {found.z:.1f}, family-wise p {found.p:.2g}, "
        f"held-out gain {found.held_out_gain:.1f} +- {found.held_out_se:.1f}{nearest}."
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
    campaign = gate(run)
    if windows.imposed(campaign):
        return windows.add(run, campaign, effect, Path(out), progress)
    from lunar_mjx.effects import catalogue

    new = catalogue.get(effect)
    grown = dataclasses.replace(run, candidates=(*run.candidates, effect)) if ".py" in effect else run
    if new.name in run.model.effect_names:
        raise UserError(
            f"add: the model has {new.name} already; remove it from {run.folder / 'model.toml'} to add it anew."
        )
    if isinstance(campaign[0], SteadyLog):
        return _add_to_tables(grown, campaign, [effect], out, progress, values)
    model = run.model.add(new if ".py" not in effect else effect, "add", **values)
    replaced = [e for e in run.model.effect_names if e not in model.effect_names]
    if not replaced:
        problem = build_problem(grown, campaign, [new.name], progress)
        memory = _memory(run)
        base = fit_baseline(problem, Settings(seed=run.seed), memory, progress)
        from lunar_mjx.diagnosis.refit import refit_with

        fitted = refit_with(problem, base, new.name, Settings(seed=run.seed), memory)
        model = fitted_model(problem, fitted, model, held=values)
    child = dataclasses.replace(
        run, folder=Path(out), model=model, added=(*run.added, new.name), parent=str(run.folder.resolve())
    )
    return _compare(child, progress)


def improve(
    logs: Sequence[str | Path],
    model: Model,
    out: str | Path,
    effects: Sequence[str] = (),
    splits: Mapping[str, str] | None = None,
    seed: int = 0,
    most: int = 8,
    keep_going: bool = False,
    discrepancy: Mapping[str, float] | None = None,
    progress: Progress = silent,
    settings: Mapping[str, Any] | None = None,
) -> tuple[Diagnosis, list[Run]]:
    """The whole loop unattended: compare, why, add, until the verdict is neither KNOWN nor MULTIPLE.

    Args:
      logs, model, effects, splits, seed, discrepancy, progress, settings: as for `compare`.
      out: folder of the runs run1, run2, ...
      most: effects added at most.
      keep_going: go on also through UNKNOWN while some catalogue effect earns its place on held-out manoeuvres.

    Returns:
      The last verdict, and the runs.
    """
    out = Path(out)
    try:
        run = compare(logs, model, out / "run1", effects, splits, seed, discrepancy, progress, settings)
    except BadData as bad:
        return bad.diagnosis, []
    runs = [run]
    while True:
        diagnosis = why(run, progress=progress)
        names = _next_to_add(diagnosis, run, keep_going)
        if not names or len(runs) > most:
            return diagnosis, runs
        specs = {s.rpartition(":")[2]: s for s in effects}
        names, place = [specs.get(n, n) for n in names], out / f"run{len(runs) + 1}"
        campaign = gate(run)
        if isinstance(campaign[0], SteadyLog):
            run = _add_to_tables(run, campaign, names, place, progress, {})
        else:
            run = add(run, names[0], place, progress)
        runs.append(run)


def _add_to_tables(
    run: Run,
    logs: Sequence[SteadyLog],
    names: Sequence[str],
    out: str | Path,
    progress: Progress,
    values: Mapping[str, float],
) -> Run:
    """Adds effects to the model of a run on tables, all at once, and compares anew in another folder."""
    from lunar_mjx.effects import catalogue

    model = grown_model(run, logs, names, values, progress)
    added = (*run.added, *(catalogue.get(n).name for n in names))
    child = dataclasses.replace(run, folder=Path(out), model=model, added=added, parent=str(run.folder.resolve()))
    return _compare(child, progress)


def _next_to_add(diagnosis: Diagnosis, run: Run, keep_going: bool) -> list[str]:
    """What `improve` adds next: another form of the model first, where it is surely better, then all that is named.

    Beside something unlisted that is what is sure in itself, or with `keep_going` all that helps.
    """
    law = better_law(diagnosis.forms, run.model)
    names = [n for n in diagnosis.effects if not n.startswith("calibration: ")]
    sure = float(run.settings.get("sure", SearchSettings().sure))
    if diagnosis.verdict is Verdict.UNKNOWN and not keep_going:
        names = [n for n in names if diagnosis.inclusion.get(n, 0.0) >= sure]
    go_on = diagnosis.verdict in (Verdict.KNOWN, Verdict.MULTIPLE, Verdict.UNKNOWN)
    return [*([law] if law else []), *(names if go_on else [])]
