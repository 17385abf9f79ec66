"""compare, why and add for logs with imposed wheel speeds."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from lunar_mjx.diagnosis.drives.windows.bench import Bench
from lunar_mjx.diagnosis.drives.windows.coordinates import CALIBRATION, DRIFT, Unknown, catalogue_of, data_sheet
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS
from lunar_mjx.diagnosis.drives.windows.form import DRIVE, INSTEAD, OF_THE_GROUND, WindowForm, between
from lunar_mjx.diagnosis.drives.windows.problem import Noise, corners
from lunar_mjx.diagnosis.fitted_model import posterior_of
from lunar_mjx.diagnosis.folder.refits import write_refits
from lunar_mjx.diagnosis.runs import COMPARISON_FILE, FITTED_FILE, VERDICT_FILE, WINDOWS_FILE, Run
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.diagnosis.weighed import answer
from lunar_mjx.diagnosis.weighed.form import Problem
from lunar_mjx.diagnosis.weighed.held_to_account import FEWEST, NAMING, Account, account, gains_on_held_out
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.inference.weighing.hypotheses import Refit
from lunar_mjx.logs import Log
from lunar_mjx.logs.schema import find_channel
from lunar_mjx.model import Model
from lunar_mjx.model.file import save_model


@dataclasses.dataclass(frozen=True)
class Telling:
    """When the verbs on windows end, and what they tell."""

    seconds: float = 240.0
    """Time that a search may take unless told otherwise, s."""
    same: float = 0.005
    """Share of its error by which a model has to change it to count as having moved."""
    not_told: float = 0.7
    """Posterior over prior standard deviation from which logs count as not telling a parameter."""
    sure: float = 0.95
    """Probability that a name helps what it never saw."""
    # Difference of the sides' rim speeds over their mean below which a window is straight; rim speed between slow and
    # fast; windows of a kind from which it counts as driven.
    straight: float = 0.1
    fast_m_s: float = 0.3
    least: int = 3


TELLING = Telling()


def imposed(logs: Sequence[Any]) -> bool:
    """Whether all logs have their wheel speeds imposed.

    Raises:
      UserError: some have and some have not.
    """
    found = [isinstance(log, Log) and log.imposed is not None for log in logs]
    if any(found) and not all(found):
        odd = logs[found.index(not found[0])]
        raise UserError(
            f"{odd.folder}: logs with imposed wheel speeds and others do not go into one run; compare them in two."
        )
    return bool(found) and all(found)


def compare(run: Run, logs: Sequence[Log], progress: Progress = silent, like: Bench | None = None) -> Run:
    """Holds a model against windows of logs, as given and refitted; writes the run folder.

    Args:
      run: with its model. logs: of it. progress: told what is being done.
      like: of another run on the same windows, whose noise is taken over; None learns it.
    """
    begin = time.monotonic()
    bench = Bench(run, logs)  # before the folder is made: a mistake leaves nothing behind
    run.write()
    # how long a first simulation compiles on this machine, and how many steps a fit takes, is not known beforehand
    progress("compiling, and learning the noise", math.nan)
    with threadpool_limits(1, "blas"):
        noise = bench.noise() if like is None else like.noise()
        if like is not None:
            bench.use_weight(like.weight)
        question = bench.question(noise, ())
        progress("fitting", math.nan)
        refit = _form(question).refit(frozenset(), None, None)
        alone = _form(question).alone(refit)
        own = question.own
        start = own.told(own.origin())
        _save_windows(bench, noise)
        run.save(COMPARISON_FILE, comparison(bench, question, start, refit, alone, time.monotonic() - begin))
        answer.save_series(run, own, start, {"refitted": (own, alone)})
        fitted = dataclasses.replace(fitted_model(_form(question), refit), grounds=bench.grounds)
        save_model(fitted, run.folder / FITTED_FILE)
    return run


def _form(question: Problem) -> WindowForm:
    form = question.own
    assert isinstance(form, WindowForm)
    return form


def _save_windows(bench: Bench, noise: Sequence[Noise]) -> None:
    found = bench.cut
    bench.run.save(
        WINDOWS_FILE,
        {
            "window_s": found.seconds,
            "interval_s": found.interval_s,
            "available": found.available,
            "held": found.held,
            "used": [
                {"log": bench.names[k], "start_s": float(t), "split": s}
                for k, t, s in zip(found.log, found.start_s, bench.splits, strict=True)
            ],
            "noise": [dataclasses.asdict(n) for n in noise],
            "noise_of": list(CHANNELS),
            "weight": bench.weight.tolist(),
        },
    )


def comparison(
    bench: Bench, question: Problem, start: np.ndarray, refit: Refit, alone: np.ndarray, seconds: float
) -> dict[str, Any]:
    """What `comparison.json` holds: errors in sigma and in the channels' units, parameters, what is not told.

    Args:
      bench, question: the windows and what they are asked. start: (n,) residuals of the model as given, as told.
      refit: of the model. alone: (coordinates,) where it predicts best by itself. seconds: that it took.
    """
    form = _form(question)
    found = answer.comparison(question, start, refit, alone)
    rows = found["by_channel"]
    place = {(r["manoeuvre"], r["split"], r["channel"]): r for r in rows}
    observations = form.observations
    off = {"as_given": form.predicted(form.origin()), "refitted": form.predicted(alone)}
    sigma: dict[str, Noise] = dict(zip(CHANNELS, observations.noise, strict=True))
    for s in observations.series:
        part = np.arange(s.start, s.stop)
        for unit in np.unique(observations.unit[part]):
            keep = part[observations.unit[part] == unit]
            row = place[observations.unit_names[unit], observations.unit_split[unit], s.channel]
            row["unit"] = unit_of(s.channel)
            for label, predicted in off.items():
                size = float(np.sqrt(np.mean((observations.value[keep] - predicted[keep]) ** 2)))
                row[label], row[f"{label}_si"] = size / sigma[s.channel].std, size
    errors_of = {label: errors(form, predicted) for label, predicted in off.items()}
    edge = at_edge(form, refit)
    problems = [refit.failed] if refit.failed else []
    problems += [f"{k} ends at the edge of what is plausible" for k in edge]
    return {
        **found,
        **errors_of,
        "not_told": not_told(form, refit),
        "between_logs": {k: v["size"] for k, v in found["discrepancy"].items()},
        "certificate": {"chi2": None, "gradient": None, "starts": [], "at_bound": edge, "problems": problems},
        "windows": {"used": len(bench.cut), "of": bench.cut.available, "seconds": bench.cut.seconds},
        "seconds": seconds,
    }


def errors(form: WindowForm, predicted: np.ndarray) -> dict[str, float]:
    """Root mean square residual in sigma by split; every sample alone, as its noise is coloured."""
    observations = form.observations
    off = (observations.value - predicted) / observations.sigma()
    splits = {"fit": ("fit",), "held_out": ("select", "test")}
    keep = {name: observations.in_split(*of) for name, of in splits.items()}
    return {name: float(np.sqrt(np.mean(off[k] ** 2))) for name, k in keep.items() if k.any()}


def unit_of(channel: str) -> str:
    """The unit of a channel."""
    found = find_channel(channel)
    return found[0].unit if found is not None else ""


def _posterior(form: WindowForm, refit: Refit) -> dict[int, float]:
    """Posterior standard deviations, in units of priors, of what a refit moves; the drive's own amounts left out."""
    places, covariance = _covariance(form, refit)
    return {int(i): math.sqrt(max(float(v), 0.0)) for i, v in zip(places, np.diag(covariance), strict=True)}


def _covariance(form: WindowForm, refit: Refit) -> tuple[np.ndarray, np.ndarray]:
    """Places (k,) of what a refit moves, but for the drive's own amounts, and their posterior covariance (k, k)."""
    _, found, places = refit.linear.evidence(form.listed(refit.effects))
    mine = [k for k, i in enumerate(places) if i < len(form.coordinates) and form.coordinates[i].effect != DRIVE]
    return places[mine], found.covariance[np.ix_(mine, mine)]


def not_told(form: WindowForm, refit: Refit, named: Sequence[str] = ()) -> list[str]:
    """The model's own unknowns that these logs hardly tell, but for those of effects that are named.

    Within its usual size an unknown may be hardly told, and still be sure to be far beyond it.
    """
    std = _posterior(form, refit)
    said = {form.unknowns[i].key for name in named for i in form.candidates.get(name, ())}
    untold = [form.unknowns[i].key for i in form.baseline if std.get(int(i), 0.0) > TELLING.not_told]
    return [key for key in untold if key not in said]


def at_edge(form: WindowForm, refit: Refit) -> list[str]:
    """Unknowns that ended at a bound of plausibility."""
    out = []
    for i in _posterior(form, refit):
        q, c = form.unknowns[i], form.coordinates[i]
        value = float(c.value(refit.u[i]))
        span = 1e-3 * (abs(q.low) + abs(q.high)) if math.isfinite(q.low + q.high) else 1e-9
        # A range that begins at zero is left out: to end there is physics, such as ground without resistance.
        if not q.low + span < value < q.high - span and q.low != 0.0 and q.name != INSTEAD:
            out.append(q.key)
    return out


def fitted_model(form: WindowForm, refit: Refit) -> Model:
    """The model with fitted values, and with what these logs taught as priors for others.

    A rover's parameters drift from day to day, so no prior gets narrower than a tenth of the data sheet's range. What
    differs between recordings is taught where there were several.
    """
    model = form.model
    for name in sorted(refit.effects):
        if name not in model.effect_names and form.unknowns[form.candidates[name][0]].effect == name:
            model = model.add(name)
    priors = dict(model.priors)
    full = {q.key: q for q in (*(q for s in catalogue_of(model) for q in s.unknowns), *data_sheet(model))}
    moved: dict[str, tuple[Unknown, float, float, float]] = {}
    for i, std in _posterior(form, refit).items():
        q = form.unknowns[i]
        if q.name == INSTEAD:
            continue
        start = form.coordinates[i].start
        first, u, before, spread = moved.get(q.key, (q, 0.0, start, 0.0))
        share = q.std / first.std  # coordinates of one key move the same value
        moved[q.key] = (first, u + share * float(refit.u[i]), before, math.hypot(spread, share * std))
    for key, (q, u, start, std) in moved.items():
        value = float(q.value(start, u))
        if q.effect != CALIBRATION:
            old = model.parameters[q.effect][q.name]
            factor = isinstance(old, tuple) and q.factor
            new = tuple(v * value / start for v in old) if isinstance(old, tuple) and factor else value
            model = model.set(q.effect, "fit", **{q.name: new})
        wide = math.hypot(std * q.std, DRIFT * full[key].std)
        priors[key] = (value, wide * value if q.factor else wide)
    cut = form.problem(None).cut
    # Two recordings have one difference, which hardly tells the size of differences.
    if len(np.unique(cut.recordings[np.unique(form.observations.window[form.fit])])) > 2:
        _, found, _ = refit.linear.evidence(form.listed(refit.effects))
        priors |= between(found.tau, found.tau_log_std, form.shares)
    places, covariance = _covariance(form, refit)
    keys = {int(i): form.unknowns[i].key for i in places}
    posterior = posterior_of(form.coordinates, covariance, refit.linear.amplitudes.std[places], places, model, keys)
    return dataclasses.replace(model, priors=priors, posterior=posterior)


def why(
    run: Run,
    logs: Sequence[Log],
    only: Sequence[str] | None,
    seconds: float,
    progress: Progress,
    about: str | None = None,
) -> Diagnosis:
    """Weighs every explanation of what a model leaves of some logs; writes `verdict.json`, provisionally as it goes.

    Raises:
      UserError: a name in `only`, or `about`, is no suspect here.
    """
    begin = time.monotonic()
    bench = Bench(run, logs)
    suspects = bench.suspects
    if only is not None:
        names = [s.name for s in suspects]
        for name in only:
            if name not in names:
                raise UserError(f"effect {name!r} is no candidate here; use one of {', '.join(names)}.")
        suspects = tuple(s for s in suspects if s.name in only)
    if about is not None and about not in (names := [s.name for s in suspects]):
        raise bad_input("why", "--explain", about, "is no candidate here", f"use one of {', '.join(names)}")
    try:
        with threadpool_limits(1, "blas"):
            noise = bench.noise()
    except (EvidenceError, np.linalg.LinAlgError) as error:
        diagnosis = Diagnosis(Verdict.BAD_FIT, (), f"The model as it is could not be fitted: {error}.")
        run.save(VERDICT_FILE, diagnosis.to_dict())
        return diagnosis
    question = bench.question(noise, suspects)
    _save_windows(bench, noise)
    # cutting windows and learning their noise counts, too: the user's clock began with the command
    left = max(seconds - (time.monotonic() - begin), 0.0)
    diagnosis, found = answer.diagnose(run, question, progress, left)
    if found is not None:
        form = _form(question)
        base = found.base(form.name).refit
        start = form.told(form.origin())
        alone = form.alone(base)
        run.save(COMPARISON_FILE, comparison(bench, question, start, base, alone, time.monotonic() - begin))
        tried = {tuple(sorted(h.effects)): h.refit.u for h in found.hypotheses if h.refitted and h.effects}
        write_refits(run.folder, {e: (form.told(u), form.predicted(u)) for e, u in tried.items()})
        held = account(gains_on_held_out(question, found))
        diagnosis = _held_to_account(diagnosis, held, {s.name: s.family for s in bench.suspects})
        untold = not_told(form, base, diagnosis.effects)
        sentence = diagnosis.sentence
        if diagnosis.verdict in (Verdict.UNKNOWN, Verdict.UNDECIDABLE, Verdict.KNOWN_CLASS):
            sentence += _what_next(bench)
        if bench.cut.held:
            sentence += (
                f" In {bench.cut.held} further windows the wheels turned and the rover was held: they are left out."
            )
        if untold:
            sentence += f" These logs hardly tell {', '.join(untold)}."
        details = {
            **diagnosis.details,
            "not_told": untold,
            "not_tried": [] if found.complete else ["the search was ended by its time or its number of refits"],
            "windows": {"used": len(bench.cut), "of": bench.cut.available},
        }
        evidence = [dataclasses.replace(e, values=_shown(e.values), std=_shown(e.std)) for e in diagnosis.evidence]
        diagnosis = dataclasses.replace(diagnosis, sentence=sentence, details=details, evidence=evidence)
    run.save(VERDICT_FILE, diagnosis.to_dict())
    return diagnosis


def _shown(values: Mapping[str, float]) -> dict[str, float]:
    """Values without the switch from one ground to another, which is no quantity of the ground."""
    return {name: value for name, value in values.items() if name != INSTEAD}


PORTS = {
    "ground": "wheel_normal",
    "friction": "wheel_shear",
    "drive": "motor_torque",
    "rover": "geometry",
    "sensor": "sensor",
}
"""The port at which a family of suspects acts."""


def _held_to_account(diagnosis: Diagnosis, held: Account, families: Mapping[str, str]) -> Diagnosis:
    """The diagnosis, or UNKNOWN where what it names does not help held-out windows with 95 %.

    Where fewer than two windows were held out, nothing is refused.
    """
    if diagnosis.verdict not in NAMING or held.units < FEWEST or held.helps(TELLING.sure):
        return diagnosis
    names = ", ".join([*diagnosis.effects, *(["something unlisted"] if diagnosis.unlisted else [])])
    sentence = (
        f"Something acts that is not explained: {names} would explain the fitted windows, and does not help those that "
        f"were held out (gain of log density {held.gain:.1f} +- {held.se:.1f} over {held.units} windows)."
    )
    acts = [PORTS[families[n]] for n in diagnosis.effects if n in families]
    if acts:
        fields = {k: d for k, d in diagnosis.discrepancy.items() if k.startswith(acts[0])}
        sentence += f" It acts at {acts[0]}" + "".join(f"; {d['text']} beside it" for d in fields.values()) + "."
        diagnosis = dataclasses.replace(diagnosis, port=acts[0])
    return dataclasses.replace(diagnosis, verdict=Verdict.UNKNOWN, effects=(), further=(), sentence=sentence)


def _what_next(bench: Bench) -> str:
    """What the windows lack that would tell resistance, friction and instruments apart, as a sentence."""
    speed = np.asarray(bench.cut.imposed.speed)
    radius = float(np.mean([w.radius for w in bench.model.rover.wheels]))
    left = np.array([j.startswith("l") for j in corners(bench.model)])
    sides = [radius * speed[..., mine].mean(axis=(1, 2)) for mine in (left, ~left)]
    ahead, turn = 0.5 * (sides[0] + sides[1]), 0.5 * (sides[1] - sides[0])
    straight = np.abs(turn) < TELLING.straight * np.abs(ahead)
    lacks = []
    if straight.sum() < TELLING.least:
        lacks.append("straight drives (resistance without scrub)")
    elif (straight & (ahead > 0.0)).sum() < TELLING.least or (straight & (ahead < 0.0)).sum() < TELLING.least:
        lacks.append("straight drives there and back (resistance apart from slope)")
    if (~straight).sum() < TELLING.least:
        lacks.append("turns on the spot (friction across the wheels)")
    if min((np.abs(ahead) > TELLING.fast_m_s).sum(), (np.abs(ahead) <= TELLING.fast_m_s).sum()) < TELLING.least:
        lacks.append("a second speed (friction that grows with it)")
    return f" Drive next, on the same ground: {', '.join(lacks)}." if lacks else ""


def add(run: Run, logs: Sequence[Log], name: str, out: Path, progress: Progress) -> Run:
    """Adds a suspect to a run's model, refits, and compares anew in another folder, on the same windows and noise.

    Raises:
      UserError: no such effect, parameter or calibration, or the model has it.
    """
    bench = Bench(run, logs)
    by_name = {s.name: s for s in bench.suspects}
    if name not in by_name:
        raise UserError(f"add: {name} cannot be added to this model; use one of {', '.join(by_name)}.")
    suspect = by_name[name]
    with threadpool_limits(1, "blas"):
        form = bench.form(bench.noise(), (suspect,))
        base = form.refit(frozenset(), None, None)
        found = form.refit(frozenset({name}), base, None)
    model = fitted_model(form, found)
    # What was added is as free in the next fit as it was in this one.
    priors = {**run.model.priors}
    wide = {q.key: q for q in (*bench.base, *suspect.unknowns)}
    for key in {q.key for q in suspect.unknowns} | {q.key for q in bench.base if q.effect == CALIBRATION}:
        q, value = wide[key], model.priors[key][0]
        priors[key] = (value, q.std * value if q.factor else q.std)
    grounds = bench.grounds if suspect.family in OF_THE_GROUND else run.model.grounds
    model = dataclasses.replace(model, priors=priors, grounds=grounds)
    child = dataclasses.replace(
        run, folder=Path(out), model=model, added=(*run.added, name), parent=str(run.folder.resolve())
    )
    compare(child, logs, progress, bench)
    _say_what_moved(child, errors(form, form.predicted(form.alone(base))))
    return child


def _say_what_moved(child: Run, before: Mapping[str, float]) -> None:
    """Puts into the comparison's certificate whether the addition helped what it never saw."""
    content = child.load(COMPARISON_FILE)
    after = content["refitted"]
    for split, label in (("fit", "fitted"), ("held_out", "held-out")):
        if split in before and split in after:
            was, now = before[split], after[split]
            if now > was * (1.0 + TELLING.same):
                content["certificate"]["problems"].append(
                    f"the error on {label} windows rises from {was:.2f} to {now:.2f}"
                )
            elif now > was * (1.0 - TELLING.same):
                content["certificate"]["problems"].append(f"nothing moved on {label} windows ({was:.2f} to {now:.2f})")
    child.save(COMPARISON_FILE, content)
