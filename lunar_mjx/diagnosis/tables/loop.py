"""Tables through the verbs: forms of the wheel from a run, their comparison, and the diagnosis."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from lunar_mjx.diagnosis import build_problem
from lunar_mjx.diagnosis.candidates import usable
from lunar_mjx.diagnosis.runs import COMPARISON_FILE, HYPOTHESES_FILE, RUN_FILE, SERIES_FILE, SIGNATURES_FILE, Run
from lunar_mjx.diagnosis.tables import problem as tables
from lunar_mjx.diagnosis.tables.conclusion import conclude, label, probabilities, title
from lunar_mjx.diagnosis.tables.port_gains import FIELDS
from lunar_mjx.diagnosis.tables.settings import TableSettings
from lunar_mjx.diagnosis.tables.wheel_form import WheelForm, table_data
from lunar_mjx.diagnosis.verdict import Diagnosis, EffectEvidence, Verdict
from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect
from lunar_mjx.errors import UserError
from lunar_mjx.files import replacing
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.problem import NotTested
from lunar_mjx.inference.weighing.hypotheses import EFFECT, UNLISTED, Refit, Term
from lunar_mjx.inference.weighing.search import LEAST_SIGNAL, Hypothesis, ModelSearch, search
from lunar_mjx.logs import SteadyLog
from lunar_mjx.model import Model
from lunar_mjx.wheel_bed.bed import EARTH_GRAVITY, WheelBed

Progress = Callable[[str, float], None]

OWN_FORM = "the model's own contact law"
LAWS: Mapping[str, tuple[str, ...]] = {
    "closed form": ("pressure_sinkage", "closed_form_shear"),
    "stress_integral": ("stress_integral",),
}
"""Contact laws that are rivals of each other, and the effects that make them up. (The forms that the seed paper printed
are none: they are kept to reproduce it.)"""
_CONTACT = frozenset(
    {"pressure_sinkage", "closed_form_shear", "stress_integral", "penalty_contact", "printed_shear", "engine_friction"}
)
_SPLITS = {
    "fit": ("fit",),
    "select": ("select",),
    "test": ("test",),
    "held_out": ("select", "test"),
    "apart": ("apart",),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Tables:
    """The tables of a run as a problem: rival forms, the model's own first.

    Attributes:
      forms: of the wheel. beds: of each form without candidates, by name. effects: candidates by name.
      not_tested: candidates that a steady-state bed cannot show.
      settings: sizes, priors, effort.
    """

    forms: tuple[WheelForm, ...]
    beds: Mapping[str, WheelBed]
    effects: Mapping[str, Effect]
    not_tested: tuple[NotTested, ...]
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
      UserError: tables of different gravity, or a candidate that does not exist.
    """
    settings = settings or TableSettings()
    gravities = {float(log.gravity_m_s2 or EARTH_GRAVITY) for log in logs}
    if len(gravities) > 1:
        raise UserError(f"{logs[0].folder}: tables of different gravity do not go into one run; compare them apart.")
    known = build_problem.candidate_effects(run)
    for name in only or ():
        if name not in known:
            raise UserError(f"effect {name!r} is no candidate here; use one of {', '.join(known)}.")
    candidates = {n: e for n, e in known.items() if only is None or n in only}
    observations, tests = tables._observations(logs, run.splits, run.discrepancy)
    data = table_data(logs, observations, [t for t, _ in tests], settings)
    gravity = gravities.pop()
    forms, beds, all_effects, refused = [], {}, {}, ()
    laws = contact_laws(run.model, rivals)
    for number, (name, model) in enumerate(laws.items()):
        bed = WheelBed(model.effects, {n: _single(v) for n, v in model.parameters.items()}, gravity)
        mine = {
            n: e
            for n, e in candidates.items()
            if only is not None or n not in build_problem.FINER_FORMS or _integrates(bed)
        }
        mine = {n: e for n, e in mine.items() if not e.replaces}
        effects, left = usable(bed.effects, mine, tables._unfit)
        refused = left if number == 0 else refused
        union = bed
        for effect in effects.values():
            union = union.with_effect(effect, **effect.null())
        coordinates, baseline, places = tables._coordinates(bed, effects, tables.BASELINE, {})
        share = 1.0 if len(laws) == 1 else 0.5 if number == 0 else 0.5 / (len(laws) - 1)
        forms.append(WheelForm(name, data, union, coordinates, baseline, places, settings, math.log(share)))
        beds[name] = bed
        all_effects |= effects
    return Tables(tuple(forms), beds, all_effects, refused, settings)


def contact_laws(model: Model, rivals: bool) -> dict[str, Model]:
    """The model, and where wanted the same with each rival contact law in place of its own."""
    present = set(model.effect_names)
    own = next((name for name, parts in LAWS.items() if set(parts) <= present), OWN_FORM)
    found = {own: model}
    for name in LAWS if rivals else ():
        if name != own:
            found[name] = with_law(model, name)
    return found


def with_law(model: Model, law: str) -> Model:
    """The model with another contact law in place of its own."""
    for name in [n for n in model.effect_names if n in _CONTACT]:
        model = model.remove(name)
    for part in LAWS[law]:
        model = model.add(part, "contact law")
    return model


def better_law(forms: Mapping[str, float], model: Model, sure: float = TableSettings().sure) -> str | None:
    """An effect that stands for the contact law which surely explains tables better than the model's own, if any."""
    if not forms:
        return None
    best = max(forms, key=lambda name: forms[name])
    own = next(iter(contact_laws(model, rivals=False)))
    return LAWS[best][0] if best != own and best in LAWS and forms[best] >= sure else None


def _integrates(bed: WheelBed) -> bool:
    return "stress_integral" in bed.parameters


def _single(values: Mapping[str, Any]) -> dict[str, float]:
    """One value per parameter: the first where a model has one per wheel or joint."""
    return {k: float(v[0]) if isinstance(v, tuple | list) else v for k, v in values.items()}


# --- compare ---


def compare_tables(run: Run, logs: Sequence[SteadyLog], progress: Progress) -> tuple[Tables, Refit]:
    """The model as given and refitted against tables; writes `comparison.json` and the series."""
    problem = build_tables(run, logs, rivals=False)
    run.save(RUN_FILE, {**run.load(RUN_FILE), "settings": dataclasses.asdict(problem.settings)})
    progress("refitting the model", 0.0)
    with threadpool_limits(1, "blas"):
        refit = problem.own.refit(frozenset(), None, None)
    start = problem.own.residual(np.zeros(len(problem.own.coordinates)))
    run.save(COMPARISON_FILE, comparison(problem.own, start, refit))
    save_series(run, problem.own, start, {"refitted": (problem.own, refit.u)})
    return problem, refit


def comparison(form: WheelForm, start: np.ndarray, refit: Refit) -> dict[str, Any]:
    """Errors in sigma of the model as given and refitted, by group and channel, and the refitted parameters."""
    observations = form.data.observations
    residual = form.residual(refit.u)
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
    value, found, places = refit.linear.evidence(_terms(form, refit.effects))
    del value
    return {
        "unit": "sigma of the measurement noise",
        "as_given": errors(form, start),
        "refitted": errors(form, residual),
        "by_channel": rows,
        "parameters": parameter_table(form, refit, found.mean, found.covariance, places),
        "discrepancy": _discrepancy(found.tau, found.tau_log_std, refit.linear.felt()),
        "noise": {n.name: float(s) for n, s in zip(refit.linear.noises, found.noise, strict=True)},
        "solver": refit.failed or "ended",
        "observations": len(observations),
        "logs": list(observations.logs),
    }


def errors(form: WheelForm, residual: np.ndarray) -> dict[str, float]:
    """Root mean square of whitened residuals by split."""
    observations = form.data.observations
    return {k: _rms(residual[keep]) for k, v in _SPLITS.items() if (keep := observations.in_split(*v)).any()}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _terms(form: WheelForm, effects: frozenset[str]) -> frozenset[Term]:
    return frozenset(t for t in form.terms if t.kind == EFFECT and t.name in effects)


def parameter_table(
    form: WheelForm, refit: Refit, mean: np.ndarray, covariance: np.ndarray, places: np.ndarray
) -> dict[str, Any]:
    """Fitted values and standard deviations by effect and name, with units and the values that the model came with."""
    table: dict[str, Any] = {}
    for k, i in enumerate(places):
        if i >= len(form.coordinates):
            continue
        c = form.coordinates[i]
        entry = table.setdefault(c.effect, {"value": {}, "std": {}, "given": {}, "unit": {}})
        entry["value"][c.name] = float(c.value(refit.u[i]))
        entry["std"][c.name] = c.std(refit.u[i], math.sqrt(max(float(covariance[k, k]), 0.0)))
        entry["given"][c.name], entry["unit"][c.name] = c.start, c.unit
    return table


def _discrepancy(tau: np.ndarray, log_std: np.ndarray, felt: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Size of every field of which the data can tell something."""
    found = {}
    for (field, words), size, spread in zip(FIELDS.items(), tau, log_std, strict=True):
        if felt[field] < LEAST_SIGNAL:
            continue
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


def _corrected(form: WheelForm, best: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    """Predictions (n,) with what fitted points taught of discrepancy and calibration, and whitened residuals (n,)."""
    _, columns, residual = form.linearise(best.refit.u)
    learnt = columns[:, best.places] @ best.evidence.mean
    observations = form.data.observations
    return form.predict(best.refit.u)[0] + observations.sigma() * learnt, residual - learnt


def save_series(
    run: Run,
    own: WheelForm,
    start: np.ndarray,
    fits: Mapping[str, tuple[WheelForm, np.ndarray]],
    corrected: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """Measured and predicted series for the report, as `series.npz` (arrays only, no pickle).

    Args:
      run: to write to. own: the model as given. start: its whitened residuals.
      fits: form and coordinates by label.
      corrected: predictions and whitened residuals of the last fit with what the fitted points taught of discrepancy.
    """
    observations = own.data.observations
    predicted = [own.predict(np.zeros(len(own.coordinates)))[0], *(f.predict(u)[0] for f, u in fits.values())]
    residual = [start, *(f.residual(u) for f, u in fits.values())]
    place = observations.place if observations.place is not None else np.zeros((0, 3))
    with replacing(run.folder / SERIES_FILE) as part:
        np.savez_compressed(
            part,
            measured=observations.value,
            sigma=observations.sigma(),
            time=np.full(len(observations), np.nan),
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
            residual=np.vstack(residual),
            **({} if corrected is None else dict(zip(("corrected", "corrected_residual"), corrected, strict=True))),
        )


# --- why ---


def diagnose_tables(
    run: Run,
    logs: Sequence[SteadyLog],
    only: Sequence[str] | None,
    progress: Progress,
    settings: TableSettings | None = None,
) -> Diagnosis:
    """Weighs all hypotheses about a run's tables; writes comparison, series and signatures."""
    problem = build_tables(run, logs, only, settings=settings)
    settings = problem.settings
    try:
        # Matrices of some hundred rows are factored faster by one thread than by several that wait for each other.
        with threadpool_limits(1, "blas"):
            found = search(problem.forms, settings.most_refits, settings.most_terms, settings.window, progress)
    except EvidenceError as error:
        return Diagnosis(Verdict.BAD_FIT, (), f"The solver failed ({error}), so nothing is said about physics.")
    own = problem.own
    by_name = {f.name: f for f in problem.forms}
    if not any(h.form == own.name for h in found.hypotheses):
        return Diagnosis(Verdict.BAD_FIT, (), f"The solver failed ({'; '.join(found.failed)}).")
    base = found.base(own.name).refit
    best = next(h for h in found.hypotheses if h.refitted)
    diagnosis = _diagnosis(problem, found, best)
    start = own.residual(np.zeros(len(own.coordinates)))
    after = by_name[best.form]
    run.save(COMPARISON_FILE, comparison(own, start, base))
    fits = {"refitted": (own, base.u)}
    if best.effects or best.form != own.name:
        words = [*([best.form] if best.form != own.name else []), *sorted(best.effects)]
        fits["with " + ", ".join(words)] = (after, best.refit.u)
    save_series(run, own, start, fits, _corrected(after, best))
    _save_signatures(run, found.base(best.form).refit, own)
    run.save(HYPOTHESES_FILE, _fits(problem, found))
    return dataclasses.replace(
        diagnosis,
        error_before=errors(own, own.residual(base.u)),
        error_after=errors(after, after.residual(best.refit.u)),
    )


def _diagnosis(problem: Tables, found: ModelSearch, best: Hypothesis) -> Diagnosis:
    settings = problem.settings
    said = conclude(found, settings.sure)
    forms = found.forms()
    own = problem.own.name
    remains = _averaged(found)
    sentence = said.sentence
    better = max(forms, key=lambda n: forms[n])
    if forms[better] >= settings.sure and better != own:
        sentence += f" The contact law {better} explains these data better than {own}: add it."
    if remains:
        worst = max(remains, key=lambda k: remains[k]["size"])
        usual = remains[worst]["size"] <= 2.0 * settings.usual_discrepancy
        tail = f"usual: {remains[worst]['text']}, the rest better" if usual else f"large: {remains[worst]['text']}"
        sentence += f" What remains is {tail}."
    gain, se, units = _held_out(found, best, own)
    inclusion = found.inclusion()
    evidence, undecidable = _evidence(problem, found, said.effects)
    return Diagnosis(
        verdict=said.verdict,
        effects=said.effects,
        sentence=sentence,
        evidence=evidence,
        port=said.port,
        ports={t.name: p for t, p in inclusion.items() if t.kind == UNLISTED and p >= 1e-4},
        isolability=_cosines(found.base(best.form).refit),
        undecidable=undecidable,
        probability=said.probability,
        probabilities=probabilities(found),
        inclusion={label(t): p for t, p in inclusion.items()},
        forms=forms,
        unlisted=said.unlisted,
        discrepancy=remains,
        details={
            "best": {"form": best.form, "hypothesis": title(best), "log_posterior": best.log_posterior},
            "place": said.place,
            "held_out": {"gain": gain, "se": se, "manoeuvres": units},
            "noise": {n.name: float(s) for n, s in zip(best.refit.linear.noises, best.evidence.noise, strict=True)},
            "search": {
                "refits": found.refits,
                "complete": found.complete,
                "failed": list(found.failed),
                "hypotheses": len(found.hypotheses),
            },
            "parameters": parameter_table(
                next(f for f in problem.forms if f.name == best.form),
                best.refit,
                best.evidence.mean,
                best.evidence.covariance,
                best.places,
            ),
            "not_tested": [dataclasses.asdict(n) for n in problem.not_tested],
        },
    )


def _averaged(found: ModelSearch) -> dict[str, dict[str, Any]]:
    """Size of each field, averaged over hypotheses by their probability."""
    tau = np.sqrt(sum(p * h.evidence.tau**2 for h, p in zip(found.hypotheses, found.probability, strict=True)))
    spread = sum(p * h.evidence.tau_log_std for h, p in zip(found.hypotheses, found.probability, strict=True))
    return _discrepancy(np.asarray(tau), np.asarray(spread), found.best.refit.linear.felt())


def _held_out(found: ModelSearch, best: Hypothesis, own: str) -> tuple[float, float, int]:
    """Gain of log predictive density on manoeuvres that chose nothing: the best hypothesis over the model as it is."""
    base = found.base(own)
    names = list(best.refit.linear.held_out)
    if not names:
        return float("nan"), float("nan"), 0

    def score(h: Hypothesis, name: str) -> float:
        return h.evidence.log_score(h.refit.linear.held_out[name].select(h.places))

    gains = np.array([score(best, n) - score(base, n) for n in names])
    se = float(np.sqrt(len(gains) * np.var(gains, ddof=1))) if len(gains) > 1 else float("nan")
    return float(gains.sum()), se, len(names)


def _evidence(
    problem: Tables, found: ModelSearch, named: Sequence[str]
) -> tuple[tuple[EffectEvidence, ...], tuple[str, ...]]:
    inclusion = {t.name: p for t, p in found.inclusion().items() if t.kind == EFFECT}
    by_name = {f.name: f for f in problem.forms}
    best_form = found.best.form
    shows = found.base(best_form).refit.linear.shows()
    cosines = _cosines(found.base(best_form).refit)
    rows = []
    for name, length in shows.items():
        p = inclusion.get(name, 0.0)
        holding = next((h for h in found.hypotheses if name in h.effects), None)
        without = next(h for h in found.hypotheses if name not in h.effects)
        values, std, log_ratio = {}, {}, float("-inf")
        if holding is not None:
            log_ratio = holding.log_posterior - without.log_posterior
            form = by_name[holding.form]
            moved = holding.evidence.mean
            for k, i in enumerate(holding.places):
                if i < len(form.coordinates) and form.coordinates[i].effect == name:
                    c = form.coordinates[i]
                    values[c.name] = float(c.value(holding.refit.u[i] + (0.0 if holding.refitted else moved[k])))
                    std[c.name] = c.std(
                        holding.refit.u[i], math.sqrt(max(float(holding.evidence.covariance[k, k]), 0.0))
                    )
        others = {e: v for e, v in cosines.get(name, {}).items() if e != name}
        nearest = max(others.items(), key=lambda item: item[1]) if others else ("", 0.0)
        if length < LEAST_SIGNAL:
            status, reason = "not tested", f"would show with {length:.2g} sigma after a refit"
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
                separable_share=float("nan"),
                chi2=float("nan"),
                z=math.copysign(math.sqrt(2.0 * abs(log_ratio)), log_ratio) if math.isfinite(log_ratio) else -99.0,
                p=1.0 - p,
                values=values,
                std=std,
                nearest=nearest,
                probability=p,
                status=status,
                reason=reason,
            )
        )
    order = {name: i for i, name in enumerate(named)}
    rows.sort(key=lambda e: (order.get(e.effect, len(order)), -e.probability, -e.z))
    return tuple(rows), tuple(e.effect for e in rows if e.status == "not tested")


def _cosines(refit: Refit) -> dict[str, dict[str, float]]:
    """|cos| between the signatures of effects at their prior sizes that the form's own parameters cannot absorb."""
    linear = refit.linear
    whole = linear.gram.matrix.sum(axis=0)[:-1, :-1]
    calibrated = np.concatenate([*linear.calibration.values(), np.zeros(0)]).astype(int)
    own = np.setdiff1d(linear.always[linear.amplitudes.field[linear.always] < 0], calibrated)
    scale = linear.amplitudes.std
    inner = np.eye(len(own)) + scale[own, None] * whole[np.ix_(own, own)] * scale[own]
    every = np.concatenate([*linear.effects.values(), np.zeros(0)]).astype(int)
    across = scale[own, None] * whole[np.ix_(own, every)] * scale[every]
    left = scale[every, None] * whole[np.ix_(every, every)] * scale[every] - across.T @ np.linalg.solve(inner, across)
    index = {i: k for k, i in enumerate(every)}
    shows = linear.shows()
    names = [n for n in linear.effects if shows[n] >= LEAST_SIGNAL]
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
    keep = values > 1e-6 * max(values.max(initial=0.0), 1e-300)
    return (vectors[:, keep] / np.sqrt(values[keep])) @ vectors[:, keep].T


def _save_signatures(run: Run, refit: Refit, form: WheelForm) -> None:
    """Each effect's signature over the fitted observations at its prior size, in sigma."""
    _, columns, _ = form.linearise(refit.u) if refit.form == form.name else (None, np.zeros((0, 0)), None)
    names, signatures = [], []
    fit = form.data.observations.in_split("fit")
    for name, places in form.candidates.items() if len(columns) else ():
        names.append(name)
        signatures.append(columns[fit][:, places] @ refit.linear.amplitudes.std[places])
    with replacing(run.folder / SIGNATURES_FILE) as part:
        np.savez_compressed(part, names=np.array(names, str), signatures=np.array(signatures, np.float32))


def _fits(problem: Tables, found: ModelSearch) -> dict[str, Any]:
    """Coordinates of every refit, by form and effects, for `add` and for whoever reads along."""
    by_name = {f.name: f for f in problem.forms}
    out: dict[str, Any] = {}
    for h in found.hypotheses:
        if h.refitted:
            key = " + ".join([h.form, *sorted(h.effects)])
            keys = [c.key for c in by_name[h.form].coordinates]
            out.setdefault(
                key, {"u": dict(zip(keys, map(float, h.refit.u), strict=True)), "log_posterior": h.log_posterior}
            )
    return out


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
    kept = (run.load(HYPOTHESES_FILE) or {}).get(" + ".join([form.name, *sorted(new)]), {}).get("u")
    start = None if kept is None else np.array([kept.get(c.key, 0.0) for c in form.coordinates])
    with threadpool_limits(1, "blas"):
        near = form.refit(frozenset(), None, None) if new and start is None else None
        refit = form.refit(new, near, start)
    for i, c in enumerate(form.coordinates):
        mine = i in form.baseline or c.effect in new
        if mine and c.effect in model.effect_names and c.name not in values:
            value = float(c.value(refit.u[i]))
            old = model.parameters[c.effect][c.name]
            model = model.set(
                c.effect, "fit", **{c.name: tuple(value for _ in old) if isinstance(old, tuple) else value}
            )
    return model
