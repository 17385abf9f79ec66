"""The verbs on any problem of weighed hypotheses: compare a model with measurements, and say what is missing."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from lunar_mjx.diagnosis.fitted_model import fitted_model, posterior_of
from lunar_mjx.diagnosis.runs import (
    COMPARISON_FILE,
    FITTED_FILE,
    HYPOTHESES_FILE,
    RUN_FILE,
    SERIES_FILE,
    SIGNATURES_FILE,
    VERDICT_FILE,
    Run,
)
from lunar_mjx.diagnosis.verdict import Diagnosis, EffectEvidence, Verdict
from lunar_mjx.diagnosis.weighed.conclusion import Conclusion, conclude, helps, label, probabilities, title
from lunar_mjx.diagnosis.weighed.form import MeasuredForm, Problem
from lunar_mjx.diagnosis.weighed.held_to_account import FEWEST, NAMING, Account, account, gains_on_held_out
from lunar_mjx.files import replacing
from lunar_mjx.inference.coordinates import FACTOR_UNIT
from lunar_mjx.inference.deadline import TimeUp
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.fitting import Progress
from lunar_mjx.inference.weighing.hypotheses import EFFECT, UNLISTED, Refit
from lunar_mjx.inference.weighing.search import Hypothesis, ModelSearch, search
from lunar_mjx.model.file import save_model

_WRITING = 0.1
"""1; share of the time given that is kept for writing the answer."""
_SPLITS = {
    "fit": ("fit",),
    "select": ("select",),
    "test": ("test",),
    "held_out": ("select", "test"),
    "apart": ("apart",),
}


def compare(run: Run, problem: Problem, progress: Progress) -> Refit:
    """The model as given and refitted; writes `comparison.json`, `fitted.toml` and the series."""
    # Later verbs on this run weigh by what it was compared with, and not by what is usual in their version.
    run.save(RUN_FILE, {**run.load(RUN_FILE), "settings": dataclasses.asdict(problem.settings)})
    own = problem.own
    progress("refitting the model", 0.0)
    with threadpool_limits(1, "blas"):
        refit = own.refit(frozenset(), None, None)
    # the model as given, by its own numbers: what a refit gains is told beside it
    start = own.told(own.origin())
    alone = own.alone(refit)
    run.save(COMPARISON_FILE, comparison(problem, start, refit, alone))
    run.save(HYPOTHESES_FILE, {own.name: {"u": _by_key(own, refit.u)}})
    save_series(run, own, start, {"refitted": (own, alone)})
    _, found, places = refit.linear.evidence(own.listed(refit.effects))
    posterior = posterior_of(own.coordinates, found.covariance, refit.linear.amplitudes.std[places], places, run.model)
    # The values and deviations that `comparison.json` tells.
    fitted = fitted_model(own.coordinates, alone, own.baseline, run.model)
    save_model(dataclasses.replace(fitted, posterior=posterior), run.folder / FITTED_FILE)
    return refit


def kept_start(run: Run, form: MeasuredForm, effects: frozenset[str]) -> np.ndarray | None:
    """(coordinates,) where a run's refit of a form with some effects has ended; None where it keeps none."""
    kept = (run.load(HYPOTHESES_FILE) or {}).get(" + ".join([form.name, *sorted(effects)]), {}).get("u")
    return None if kept is None else np.array([float(kept.get(c.key, 0.0)) for c in form.coordinates])


def _by_key(form: MeasuredForm, u: np.ndarray) -> dict[str, float]:
    return dict(zip([c.key for c in form.coordinates], map(float, u), strict=True))


def diagnose(
    run: Run, problem: Problem, progress: Progress, seconds: float = math.inf
) -> tuple[Diagnosis, ModelSearch | None]:
    """Weighs all hypotheses; writes comparison, series, signatures, refits. A search that failed is not returned.

    Args:
      run: to write to. problem: to be explained. progress: told of every refit.
      seconds: after which the answer is to be there, as far as it is known then; a verdict is then written after every
        refit, too, as provisional.
    """
    settings, begun = problem.settings, time.monotonic()
    end = begun + (1.0 - _WRITING) * seconds
    turns = itertools.count(sum(1 + len(form.exchanged) for form in problem.forms if not form.late))

    def over() -> bool:
        """Asked before each further refit: whether it and what comes after it would last longer than the time given."""
        now, writing = time.monotonic(), problem.own.writing
        # The mean of those that were made: how long the next one takes is known when it has ended.
        a_refit = (now - begun) / next(turns)
        return now > end or (writing > 0.0 and now + (1.0 + writing) * a_refit > begun + seconds)

    def provisional(found: ModelSearch) -> None:
        # with a limit the next refit may never come, and what is known by then is the answer
        if math.isfinite(seconds):
            best = next(h for h in found.hypotheses if h.refitted)
            run.save(VERDICT_FILE, {**_diagnosis(problem, found, best).to_dict(), "provisional": True})

    for form in problem.forms:
        form.limit(end)
    try:
        # Matrices of some hundred rows are factored faster by one thread than by several that wait for each other.
        with threadpool_limits(1, "blas"):
            found = search(
                problem.forms,
                settings.most_refits,
                settings.most_terms,
                settings.window,
                progress,
                over,
                provisional,
                settings.least_signal,
                settings.unlisted_share,
                settings.most_scored,
            )
    except TimeUp:
        said = f"{seconds:.0f} s did not suffice to refit the model as it is, so nothing is said; give more --seconds."
        return Diagnosis(Verdict.UNDECIDABLE, (), said), None
    except EvidenceError as error:
        return Diagnosis(Verdict.BAD_FIT, (), f"The solver failed ({error}), so nothing is said about physics."), None
    finally:
        for form in problem.forms:
            form.limit(math.inf)
    own = problem.own
    if not any(h.form == own.name for h in found.hypotheses):
        return Diagnosis(Verdict.BAD_FIT, (), f"The solver failed ({'; '.join(found.failed)})."), None
    # the model's own form, whichever form won: "refitted" is told of what the user gave
    base = found.base(own.name).refit
    best = next(h for h in found.hypotheses if h.refitted)
    diagnosis = _diagnosis(problem, found, best)
    start = own.told(own.origin())
    after = problem.form(best.form)
    with threadpool_limits(1, "blas"):
        own_alone, best_alone = own.alone(base), after.alone(best.refit)
    run.save(COMPARISON_FILE, {**(run.load(COMPARISON_FILE) or {}), **comparison(problem, start, base, own_alone)})
    fits = {"refitted": (own, own_alone)}
    if best.effects or best.form != own.name:
        words = [*([best.form] if best.form != own.name else []), *sorted(best.effects)]
        fits["with " + ", ".join(words)] = (after, best_alone)
    save_series(run, own, start, fits, after.corrected(best))
    _save_signatures(run, found.base(best.form).refit, own)
    run.save(HYPOTHESES_FILE, _fits(problem, found))
    diagnosis = dataclasses.replace(
        diagnosis, error_before=errors(own, own.told(own_alone)), error_after=errors(after, after.told(best_alone))
    )
    return diagnosis, found


def comparison(problem: Problem, start: np.ndarray, refit: Refit, alone: np.ndarray | None = None) -> dict[str, Any]:
    """Errors in sigma of the model as given and refitted, by group and channel, and the refitted parameters.

    Args:
      problem: whose own form is told of. start: (n,) residuals of the model as given, as told. refit: of the form.
      alone: (coordinates,) where the model alone predicts best; where the refit stands, without discrepancy, if None.
    """
    form = problem.own
    observations = form.observations
    alone = form.bare(refit.u) if alone is None else alone
    residual = form.told(alone)
    rows = []
    for s in observations.series:
        part = slice(s.start, s.stop)
        for unit in np.unique(observations.unit[part]):
            keep = np.arange(s.start, s.stop)[observations.unit[part] == unit]
            rows.append(
                {
                    "manoeuvre": observations.unit_names[unit],
                    "split": observations.unit_split[unit],
                    "channel": s.channel,
                    "samples": len(keep),
                    "as_given": _rms(start[keep]),
                    "refitted": _rms(residual[keep]),
                }
            )
    _, found, places = refit.linear.evidence(form.listed(refit.effects))
    return {
        "unit": "sigma of the measurement noise",
        "as_given": errors(form, start),
        "refitted": errors(form, residual),
        "by_channel": rows,
        "parameters": parameter_table(form, alone, found.covariance, places),
        "discrepancy": _discrepancy(
            form, found.tau, found.tau_log_std, refit.linear.felt(), problem.settings.least_signal
        ),
        "noise": {n.name: float(s) for n, s in zip(refit.linear.noises, found.noise, strict=True)},
        **form.learnt(refit),
        "solver": refit.failed or "ended",
        "observations": len(observations),
        "logs": list(observations.logs),
        "unused": problem.unused,
    }


def errors(form: MeasuredForm, residual: np.ndarray) -> dict[str, float]:
    """Root mean square of residuals by split."""
    observations = form.observations
    return {k: _rms(residual[keep]) for k, v in _SPLITS.items() if (keep := observations.in_split(*v)).any()}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def parameter_table(form: MeasuredForm, u: np.ndarray, covariance: np.ndarray, places: np.ndarray) -> dict[str, Any]:
    """Fitted values and standard deviations by effect and name, with units and the values that the model came with.

    Amounts of fields, of which only the size is told, are no parameters.
    """
    table: dict[str, Any] = {}
    for k, i in enumerate(places):
        if i >= len(form.coordinates) or i in form.discrepancy or i in form.ground:
            continue
        c = form.coordinates[i]
        entry = table.setdefault(c.effect, {"value": {}, "std": {}, "given": {}, "unit": {}})
        entry["value"][c.name] = float(c.value(u[i]))
        # Rounding leaves the variance of what is hardly told a little below zero.
        entry["std"][c.name] = c.std(u[i], math.sqrt(max(float(covariance[k, k]), 0.0)))
        entry["given"][c.name], entry["unit"][c.name] = c.start, FACTOR_UNIT if c.factor else c.unit
    return table


def _discrepancy(
    form: MeasuredForm, tau: np.ndarray, log_std: np.ndarray, felt: Mapping[str, float], least_signal: float
) -> dict[str, dict[str, Any]]:
    """Size of every field of which the data can tell something."""
    found = {}
    # sizes of fields without words, such as that of effects of usual size, come last
    for (field, words), size, spread in zip(form.words.items(), tau, log_std, strict=False):
        if felt[field] < least_signal:
            continue  # its size would be the prior's, told as if it had been measured
        size = size * form.shares.get(field, 1.0)
        # Alike in the logarithm, in which the size was inferred.
        low, high = size * math.exp(-spread), size * math.exp(spread)
        found[field] = {
            "size": float(size),
            "low": float(low),
            "high": float(high),
            "text": f"{words} good to {_percent(size)}",
        }
    return found


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"


def save_series(
    run: Run,
    own: MeasuredForm,
    start: np.ndarray,
    fits: Mapping[str, tuple[MeasuredForm, np.ndarray]],
    corrected: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """Measured and predicted series for the report, as `series.npz` (arrays only, no pickle).

    Args:
      run: to write to. own: the model as given. start: its residuals as told.
      fits: form and coordinates by label.
      corrected: predictions and whitened residuals of the last fit with what the fitted points taught of discrepancy.
    """
    observations = own.observations
    predicted = [own.predicted(own.origin()), *(f.predicted(u) for f, u in fits.values())]
    residual = np.vstack([start, *(f.told(u) for f, u in fits.values())])
    # Signatures are whitened, and only what is whitened can be held beside them: kept where it is not what is told.
    whitened = np.vstack([own.residual(own.origin()), *(f.residual(u) for f, u in fits.values())])
    more = {} if np.array_equal(whitened, residual, equal_nan=True) else {"whitened": whitened}
    # Points of tables have no time; NaN keeps one entry for each observation.
    time = np.concatenate(
        [np.full(s.stop - s.start, np.nan) if s.time is None else s.time for s in observations.series]
    )
    place = observations.place if observations.place is not None else np.zeros((0, 3))
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
            predicted=np.vstack(predicted),
            residual=residual,
            **more,
            **({} if corrected is None else dict(zip(("corrected", "corrected_residual"), corrected, strict=True))),
        )


def _diagnosis(problem: Problem, found: ModelSearch, best: Hypothesis) -> Diagnosis:
    settings = problem.settings
    conclusion = conclude(found, settings.sure, settings.largest_class)
    forms = found.forms()
    own = problem.own.name
    remains = _averaged(problem.own, found, settings.least_signal)
    sentence = conclusion.sentence
    better = max(forms, key=lambda n: forms[n])
    if forms[better] >= settings.sure and better != own:
        sentence += f" The contact law {better} explains these data better than {own}: add it."
    if remains:
        sizes = {k: d["size"] / problem.own.shares.get(k, 1.0) for k, d in remains.items()}
        worst = max(sizes, key=lambda k: sizes[k])
        usual = sizes[worst] <= 2.0 * settings.usual_discrepancy
        tail = f"usual: {remains[worst]['text']}, the rest better" if usual else f"large: {remains[worst]['text']}"
        sentence += f" What remains is {tail}."
    if not found.complete:
        sentence += " The search ended by its time or its number of refits: what it did not refit is an estimate."
    skipped = problem.own.skipped
    if not found.complete:
        refitted = [h.effects for h in found.hypotheses if h.refitted]
        conclusion, sentence = _unlooked(conclusion, sentence, found)
        conclusion, sentence = _unrefitted(conclusion, sentence, refitted, found.unchallenged)
    if skipped:
        conclusion, sentence = _without(conclusion, sentence, skipped)
    held = account(gains_on_held_out(problem, found))
    conclusion, sentence = _held_to_account(conclusion, sentence, held, settings.held_out_sure)
    inclusion = {t: p for t, p in found.inclusion().items() if t.name not in _estimates(found)}
    evidence, undecidable = _evidence(problem, found, conclusion.effects)
    return Diagnosis(
        verdict=conclusion.verdict,
        effects=conclusion.effects,
        sentence=sentence,
        evidence=evidence,
        port=conclusion.port,
        ports={t.name: p for t, p in inclusion.items() if t.kind == UNLISTED and p >= 1e-4},
        isolability=_cosines(found.base(best.form).refit, settings.least_signal),
        undecidable=undecidable,
        probability=conclusion.probability,
        probabilities=probabilities(found),
        inclusion={label(t): p for t, p in inclusion.items()},
        forms=forms,
        unlisted=conclusion.unlisted,
        further=conclusion.further,
        discrepancy=remains,
        details={
            "best": {"form": best.form, "hypothesis": title(best), "log_posterior": best.log_posterior},
            "place": conclusion.place,
            "held_out": held.to_dict("manoeuvres"),
            "noise": {n.name: float(s) for n, s in zip(best.refit.linear.noises, best.evidence.noise, strict=True)},
            "search": {
                "refits": found.refits,
                "complete": found.complete,
                "skipped": list(skipped),
                "failed": list(found.failed),
                "hypotheses": len(found.hypotheses),
            },
            "parameters": parameter_table(problem.form(best.form), best.refit.u, best.evidence.covariance, best.places),
            "not_tested": [dataclasses.asdict(n) for n in problem.not_tested],
        },
    )


def _without(said: Conclusion, sentence: str, skipped: Sequence[str]) -> tuple[Conclusion, str]:
    """A conclusion and its sentence where the time did not suffice to look at some candidates.

    That nothing is missing stands, for it has been held against unknown inputs at all ports. That something is missing
    stands, too, but not what: a candidate that was not looked at may be that.
    """
    skipped_sentence = f" Not looked at in the time given: {', '.join(skipped)}; give more --seconds."
    if said.verdict is Verdict.NOISE_ONLY:
        return said, sentence + skipped_sentence
    said = dataclasses.replace(said, verdict=Verdict.UNDECIDABLE, effects=(), further=(), probability=0.0)
    return said, "Of what was looked at: " + sentence + skipped_sentence


def _unlooked(said: Conclusion, sentence: str, found: ModelSearch) -> tuple[Conclusion, str]:
    """A conclusion and its sentence where time or refits did not suffice for what something unlisted needs.

    That is a refit with each effect that has been seen to gain. Until then what is unlisted, which is linear and always
    at hand, stands in for it: of twelve foreign campaigns that the time had cut short, two were told of it wrongly,
    with 99 % and more, and three of an effect that would help beside it.
    """
    if said.verdict is not Verdict.UNKNOWN or not (found.waiting or found.unseen):
        return said, sentence
    if found.waiting:
        which = f"{', '.join(sorted(found.waiting))} gained beside the model within a few steps, and had no refit"
    else:
        which = "What effects gain beside the best refit was not looked at"
    sentence = f"By what was refitted: {sentence} {which}, so nothing is said yet; give more --seconds."
    return dataclasses.replace(
        said, verdict=Verdict.UNDECIDABLE, effects=(), further=(), helping=(), unlisted=False, probability=0.0
    ), sentence


def _unrefitted(
    said: Conclusion, sentence: str, refitted: Sequence[frozenset[str]], unchallenged: frozenset[str]
) -> tuple[Conclusion, str]:
    """A conclusion and its sentence where time or refits did not suffice for what a name needs.

    That is a refit with all that it names, and one without each effect from where that had ended.
    A first-order estimate about a model that misfits by many sigma is no name: on seven foreign campaigns of drives
    whose searches ended so, six such names were wrong, each with more than 99 %. Nor is a refit by itself one: it may
    have gone on where the descent without the effect had stopped.

    Args:
      said, sentence: what was concluded. refitted: sets of effects. unchallenged: see `ModelSearch`.
    """
    named = {e for e in said.effects if not e.startswith("calibration: ")}
    if said.verdict is Verdict.UNKNOWN and (estimates := named.difference(*refitted)):
        # What is unlisted is linear and needs no refit; what would help beside it does.
        told = said.sentence.removesuffix(helps(said.helping)) + helps([e for e in said.helping if e not in estimates])
        told += (
            f" A first-order estimate points to {' and '.join(sorted(estimates))} beside it, which is not named, as no "
            "refit with it was made."
        )
        rest = tuple(e for e in said.effects if e not in estimates)
        return dataclasses.replace(said, effects=rest, sentence=told), told + sentence.removeprefix(said.sentence)
    if said.verdict not in (Verdict.KNOWN, Verdict.MULTIPLE):
        return said, sentence
    if not any(named <= effects for effects in refitted):
        told = f"A first-order estimate points to {' and '.join(sorted(named))}. No refit with it was made"
    elif doubtful := sorted(named & unchallenged):
        told = f"A refit points to {' and '.join(sorted(named))}. From where it ended none was made without "
        told += " and none without ".join(doubtful)
    else:
        return said, sentence
    told += ", so nothing is named; give more --seconds, or name the candidates with --only."
    taken_back = {"verdict": Verdict.UNDECIDABLE, "effects": (), "further": (), "probability": 0.0, "sentence": told}
    return dataclasses.replace(said, **taken_back), told + sentence.removeprefix(said.sentence)


def _estimates(found: ModelSearch) -> frozenset[str]:
    """Effects that no refit has held where a search ended early: what is said of them is an estimate, no probability.

    A search that came to its end has refitted whatever comes near the best; what it left is improbable by far.
    """
    if found.complete:
        return frozenset()
    refitted = frozenset[str]().union(*(h.effects for h in found.hypotheses if h.refitted))
    return frozenset[str]().union(*(h.effects for h in found.hypotheses)) - refitted


def _averaged(form: MeasuredForm, found: ModelSearch, least_signal: float) -> dict[str, dict[str, Any]]:
    """Size of each field, averaged over hypotheses by their probability."""
    # squares, for sizes are standard deviations
    tau = np.sqrt(sum(p * h.evidence.tau**2 for h, p in zip(found.hypotheses, found.probability, strict=True)))
    spread = sum(p * h.evidence.tau_log_std for h, p in zip(found.hypotheses, found.probability, strict=True))
    return _discrepancy(form, np.asarray(tau), np.asarray(spread), found.best.refit.linear.felt(), least_signal)


def _held_to_account(said: Conclusion, sentence: str, held: Account, sure: float) -> tuple[Conclusion, str]:
    """A conclusion and its sentence where what it names does not help what was held out.

    Drives that chose a name have bent it to whatever else is wrong there. One that says nothing of other drives is not
    known to be missing, nor is it known that it is not.

    Args:
      said, sentence: the conclusion. held: what it gains on what was held out.
      sure: probability of a gain below which it is taken back; 0: never.
    """
    if not sure or said.verdict not in NAMING:
        return said, sentence
    if held.units < FEWEST:
        return said, sentence + " No drive was held out that could bear it out."
    if held.helps(sure):
        return said, sentence
    names = ", ".join([*said.effects, *(["something unlisted"] if said.unlisted else [])])
    sentence = (
        f"By the fitted drives alone: {sentence} Those that were held out do not bear it out (log density "
        f"{held.gain:+.1f} +- {held.se:.1f} over {held.units} pieces), so {names} is not named; drive more, and "
        "otherwise."
    )
    taken_back = {"verdict": Verdict.UNDECIDABLE, "effects": (), "further": (), "unlisted": False, "port": None}
    return dataclasses.replace(said, **taken_back, probability=0.0), sentence


def _evidence(
    problem: Problem, found: ModelSearch, named: Sequence[str]
) -> tuple[tuple[EffectEvidence, ...], tuple[str, ...]]:
    inclusion = {t.name: p for t, p in found.inclusion().items() if t.kind == EFFECT}
    best_form = found.best.form
    shows = found.base(best_form).refit.linear.shows()
    cosines = _cosines(found.base(best_form).refit, problem.settings.least_signal)
    estimates, rows = _estimates(found), []
    for name, length in shows.items():
        p = inclusion.get(name, 0.0)
        holding = next((h for h in found.hypotheses if name in h.effects), None)
        best_without = next(h for h in found.hypotheses if name not in h.effects)
        values, std, log_ratio = {}, {}, float("-inf")
        if holding is not None:
            log_ratio = holding.log_posterior - best_without.log_posterior
            form = problem.form(holding.form)
            moved = holding.evidence.mean
            for k, i in enumerate(holding.places):
                if i < len(form.coordinates) and form.coordinates[i].effect == name:
                    c = form.coordinates[i]
                    # A refit stands where its effects fit; a linear estimate has yet to be moved there.
                    values[c.name] = float(c.value(holding.refit.u[i] + (0.0 if holding.refitted else moved[k])))
                    std[c.name] = c.std(
                        holding.refit.u[i], math.sqrt(max(float(holding.evidence.covariance[k, k]), 0.0))
                    )
        similar_effects = {e: v for e, v in cosines.get(name, {}).items() if e != name}
        nearest = max(similar_effects.items(), key=lambda item: item[1]) if similar_effects else ("", 0.0)
        if name in problem.own.skipped:
            status, reason = "not tested", "the time did not suffice to look at it"
        elif length < problem.settings.least_signal:
            status, reason = "not tested", f"would show with {length:.2g} sigma after a refit"
        elif name in estimates:
            p, status, reason = float("nan"), "not refitted", "a first-order estimate, with which no refit was made"
        elif name in named:
            status, reason = "accepted", f"probability {p:.3f}"
        elif p > 0.5 * (1.0 - problem.settings.sure):
            status, reason = "confounded", f"probability {p:.3f}"
        else:
            status, reason = "rejected", f"probability {p:.2g}"
        rows.append(
            EffectEvidence(
                effect=name,
                separable_sigma=length,
                # Twice a log ratio is about a chi-square of one degree, whose root is a z (Wilks 1938).
                z=math.copysign(math.sqrt(2.0 * abs(log_ratio)), log_ratio) if math.isfinite(log_ratio) else -99.0,
                values=values,
                std=std,
                nearest=nearest,
                probability=p,
                status=status,
                reason=reason,
            )
        )
    # As the verdict names them, then by probability: what was not refitted has none, and comes behind.
    order = {name: i for i, name in enumerate(named)}
    rows.sort(key=lambda e: (order.get(e.effect, len(order)), -np.nan_to_num(e.probability), -e.z))
    return tuple(rows), tuple(e.effect for e in rows if e.status == "not tested")


def _cosines(refit: Refit, least_signal: float) -> dict[str, dict[str, float]]:
    """|cos| between the signatures of effects at their prior sizes that the form's own parameters cannot absorb."""
    linear = refit.linear
    whole = linear.gram.matrix.sum(axis=0)[:-1, :-1]
    calibrated = np.concatenate([*linear.calibration.values(), np.zeros(0)]).astype(int)
    # What is left of a signature once the model's own parameters, within their priors, have taken up what they can.
    own = np.setdiff1d(linear.always[linear.amplitudes.field[linear.always] < 0], calibrated)
    scale = linear.amplitudes.std
    inner = np.eye(len(own)) + scale[own, None] * whole[np.ix_(own, own)] * scale[own]
    effect_columns = np.concatenate([*linear.effects.values(), np.zeros(0)]).astype(int)
    across = scale[own, None] * whole[np.ix_(own, effect_columns)] * scale[effect_columns]
    left = scale[effect_columns, None] * whole[np.ix_(effect_columns, effect_columns)] * scale[
        effect_columns
    ] - across.T @ np.linalg.solve(inner, across)
    index = {i: k for k, i in enumerate(effect_columns)}
    shows = linear.shows()
    names = [n for n in linear.effects if shows[n] >= least_signal]
    found: dict[str, dict[str, float]] = {}
    for a in names:
        pa = [index[i] for i in linear.effects[a]]
        for b in names:
            pb = [index[i] for i in linear.effects[b]]
            # the largest canonical cosine of the two signatures' spans
            wa, wb = (_root(left[np.ix_(p, p)]) for p in (pa, pb))
            value = np.linalg.svd(wa @ left[np.ix_(pa, pb)] @ wb, compute_uv=False)
            found.setdefault(a, {})[b] = float(min(value.max(initial=0.0), 1.0))
    return found


def _root(matrix: np.ndarray) -> np.ndarray:
    """Inverse square root of what is felt of a symmetric matrix."""
    values, vectors = np.linalg.eigh(matrix)
    # A direction of which nothing is felt has no cosine with any other.
    keep = values > 1e-6 * max(values.max(initial=0.0), 1e-300)
    return (vectors[:, keep] / np.sqrt(values[keep])) @ vectors[:, keep].T


def _save_signatures(run: Run, refit: Refit, form: MeasuredForm) -> None:
    """Each effect's signature over the fitted observations at its prior size, in sigma."""
    found = form.signatures(refit) if refit.form == form.name else {}
    with replacing(run.folder / SIGNATURES_FILE) as part:
        np.savez_compressed(
            part, names=np.array(list(found), str), signatures=np.array(list(found.values()), np.float32)
        )


def _fits(problem: Problem, found: ModelSearch) -> dict[str, Any]:
    """Coordinates of every refit, by form and effects, for `add` and for whoever reads along."""
    out: dict[str, Any] = {}
    for h in found.hypotheses:
        if h.refitted:
            key = " + ".join([h.form, *sorted(h.effects)])
            out.setdefault(key, {"u": _by_key(problem.form(h.form), h.refit.u), "log_posterior": h.log_posterior})
    return out
