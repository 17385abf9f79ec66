"""compare, why and add for logs with imposed wheel speeds."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.drives.windows.coordinates import (
    CALIBRATION,
    DRIFT,
    Suspect,
    Unknown,
    baseline,
    catalogue_of,
    data_sheet,
    start_of,
    suspects_of,
)
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, Cut, cut
from lunar_mjx.diagnosis.drives.windows.judge import (
    MOST_NAMED,
    NAMED,
    Fitted,
    Settled,
    Split,
    fit,
    probabilities,
    search,
    settle,
    unknowns_of,
)
from lunar_mjx.diagnosis.drives.windows.problem import Noise, WindowProblem, corners, learn_noise, student_weights
from lunar_mjx.diagnosis.runs import COMPARISON_FILE, SERIES_FILE, VERDICT_FILE, Run
from lunar_mjx.diagnosis.verdict import Diagnosis, EffectEvidence, Verdict
from lunar_mjx.errors import UserError
from lunar_mjx.files import replacing
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.logs import Log
from lunar_mjx.logs.schema import find_channel
from lunar_mjx.model import Model
from lunar_mjx.model.file import save_model

WINDOWS_FILE, FITTED_FILE = "windows.json", "fitted.toml"
MOST_WINDOWS = 60
"""Windows of a campaign that are simulated: two minutes of driving, drawn evenly over speeds and turns."""
SECONDS = 240.0
"""Time that a search may take unless told otherwise, s."""
SAME = 0.005
"""Share of its error by which a model has to change it to count as having moved."""
NOT_TOLD = 0.7
"""Posterior over prior standard deviation from which logs count as not telling a parameter."""


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


class Bench:
    """A run's logs cut into windows, with the problems of every form of the ground made once."""

    def __init__(self, run: Run, logs: Sequence[Log], progress: Progress):
        self.run, self.logs, self.model = run, list(logs), run.model
        radius = float(np.mean([w.radius for w in run.model.rover.wheels]))
        self.cut: Cut = cut(self.logs, corners(run.model), radius, MOST_WINDOWS, run.seed)
        self.progress = progress
        self.names = [log.name if len({g.name for g in logs}) == len(logs) else _long_name(log) for log in logs]
        self.splits = _splits(run, self.logs, self.names, self.cut)
        self.split = Split(self.splits == "fit", np.isin(self.splits, ("select", "test")))
        self.base = baseline(self.model, self.cut.channels, self.logs)
        self.weight = np.ones((len(CHANNELS), len(self.cut)))
        self._made: dict[str | None, WindowProblem] = {}

    def problem(self, form: str | None) -> WindowProblem:
        """The problem with a form of the ground, made once."""
        if form not in self._made:
            self._made[form] = WindowProblem(self.cut, self.model, form, silent)
            self._made[form].weight = self.weight
        return self._made[form]

    def residual(self, predicted: np.ndarray) -> np.ndarray:
        """(channel, window, sample) measured less predicted; zero where nothing was measured."""
        return self.problem(None).residual(predicted)

    def noise(self) -> list[Noise]:
        """The noise that a run has kept, or what the windows show beyond the model refitted."""
        kept = self.run.load(WINDOWS_FILE)
        if kept is not None and "noise" in kept:
            self.use_weight(np.array(kept["weight"]))
            return [Noise(**n) for n in kept["noise"]]
        problem = self.problem(None)
        refitted = settle(problem, self.base, (), self.ripple(), self.split)
        return self.learn([refitted])

    def ripple(self) -> list[Noise]:
        """Noise by what fluctuates within windows, whatever the model: a first guess."""
        problem = self.problem(None)
        residual = self.residual(problem.predict(self.base, np.zeros((1, len(self.base))))[0])
        there = problem.there
        count = np.maximum(there.sum(axis=-1, keepdims=True), 1)
        inside = np.where(there, residual - residual.sum(axis=-1, keepdims=True) / count, 0.0)
        many = there.sum(axis=-1) > 1
        out = []
        for r, t, m in zip(inside, there, many, strict=True):
            # a channel with one sample a window shows no ripple: what differs from window to window takes its place
            values = r[m][t[m]] if m.any() else residual[len(out)][t]
            out.append(Noise(max(float(np.sqrt(np.mean(values**2))), 1e-6) if values.size else 1.0, 0.5, 0.5))
        return out

    def learn(self, settled: Sequence[Settled]) -> list[Noise]:
        """The noise that the best of some hypotheses leaves of the fitted windows, and the weights of all windows."""
        best = min(settled, key=lambda s: s.cost)
        problem = self.problem("soft_ground" if any(s.name == "soft_ground" for s in best.suspects) else None)
        left = self.residual(problem.predict(best.unknowns, best.u[None])[0])
        mine = self.split.fit
        found = learn_noise(left[:, mine], problem.there[:, mine], self.cut.interval_s)
        self.use_weight(student_weights(left, problem.there, found, self.cut.interval_s))
        return found

    def use_weight(self, weight: np.ndarray) -> None:
        """Takes the weights of the windows for all problems."""
        self.weight = weight
        for made in self._made.values():
            made.weight = weight


def _long_name(log: Log) -> str:
    return f"{log.folder.parent.name}/{log.name}"


def _splits(run: Run, logs: Sequence[Log], names: Sequence[str], found: Cut) -> np.ndarray:
    """(window,) split: as the user says, as the logs say, else every third log held out; of fewer logs their ends."""
    told = {n: run.splits.get(n, run.splits.get(log.name, log.split)) for n, log in zip(names, logs, strict=True)}
    own = [told[n] for n in names]
    if any(own):
        return np.array([own[k] or "fit" for k in found.log])
    if len(logs) >= 3:
        return np.array(["test" if k % 3 == 2 else "fit" for k in found.log])
    out = np.array(["fit"] * len(found), dtype="<U6")
    for k in np.unique(found.log):
        mine = np.flatnonzero(found.log == k)
        late = mine[np.argsort(found.start_s[mine])][math.ceil(0.7 * len(mine)) :]
        out[late] = "test"
    return out


def compare(run: Run, logs: Sequence[Log], progress: Progress = silent, like: Bench | None = None) -> Run:
    """Holds a model against windows of logs, as given and refitted; writes the run folder."""
    begin = time.monotonic()
    run.write()
    (run.folder / VERDICT_FILE).unlink(missing_ok=True)  # an earlier verdict is not about this comparison
    if like is None:
        (run.folder / WINDOWS_FILE).unlink(missing_ok=True)
    bench = Bench(run, logs, progress)
    used = list(bench.noise() if like is None else like.noise())
    if like is not None:
        bench.use_weight(like.weight)
    progress("fitting", 0.5)
    found = fit(bench.problem(None), bench.base, (), used, bench.split)
    given = bench.problem(None).predict(bench.base, np.zeros((1, len(bench.base))))[0]
    _save(bench, used, given, {"refitted": found}, found, time.monotonic() - begin)
    return run


def _save(
    bench: Bench, noise: Sequence[Noise], given: np.ndarray, fits: Mapping[str, Fitted], base: Fitted, seconds: float
) -> None:
    run, found = bench.run, bench.cut
    run.save(
        WINDOWS_FILE,
        {
            "window_s": found.seconds,
            "interval_s": found.interval_s,
            "available": found.available,
            "used": [
                {"log": bench.names[k], "start_s": float(t), "split": s}
                for k, t, s in zip(found.log, found.start_s, bench.splits, strict=True)
            ],
            "noise": [dataclasses.asdict(n) for n in noise],
            "noise_of": list(CHANNELS),
            "weight": bench.weight.tolist(),
        },
    )
    run.save(COMPARISON_FILE, _comparison(bench, noise, given, base, seconds))
    _save_series(bench, noise, given, fits)
    save_model(fitted_model(bench.model, base), run.folder / FITTED_FILE)


def errors(bench: Bench, noise: Sequence[Noise], predicted: np.ndarray) -> dict[str, float]:
    """Root mean square residual in sigma by split."""
    problem = bench.problem(None)
    white = bench.residual(predicted) / np.array([n.std for n in noise])[:, None, None]
    out = {}
    for name, windows in (("fit", bench.split.fit), ("held_out", bench.split.held_out)):
        keep = problem.there & windows[:, None]
        if keep.any():
            out[name] = float(np.sqrt(np.mean(white[keep] ** 2)))
    return out


def _comparison(
    bench: Bench, noise: Sequence[Noise], given: np.ndarray, base: Fitted, seconds: float
) -> dict[str, Any]:
    problem = bench.problem(None)
    residual = {"as_given": bench.residual(given), "refitted": bench.residual(base.predicted)}
    table = []
    for k, split in sorted({(int(k), str(s)) for k, s in zip(bench.cut.log, bench.splits, strict=True)}):
        for c, channel in enumerate(CHANNELS):
            keep = problem.there[c] & ((bench.cut.log == k) & (bench.splits == split))[:, None]
            if keep.any():
                row = {
                    "manoeuvre": bench.names[k],
                    "split": split,
                    "channel": channel,
                    "samples": int(keep.sum()),
                    "unit": _unit(channel),
                }
                for label, r in residual.items():
                    rms = float(np.sqrt(np.mean(r[c][keep] ** 2)))
                    row[label], row[f"{label}_si"] = rms / noise[c].std, rms
                table.append(row)
    untold = [q.key for q, s in zip(base.unknowns, base.std, strict=True) if s > NOT_TOLD]
    problems = [] if base.settled else ["the fit still moves"]
    problems += [f"{k} ends at the edge of what is plausible" for k in at_edge(bench, base)]
    return {
        "unit": "sigma of the measurement noise",
        "as_given": errors(bench, noise, given),
        "refitted": errors(bench, noise, base.predicted),
        "by_channel": table,
        "parameters": parameter_table(bench.model, base),
        "not_told": untold,
        "between_logs": base.differ,
        "certificate": {
            "chi2": None,
            "gradient": None,
            "starts": [],
            "at_bound": at_edge(bench, base),
            "problems": problems,
        },
        "observations": int(problem.there.sum()),
        "windows": {"used": len(bench.cut), "of": bench.cut.available, "seconds": bench.cut.seconds},
        "seconds": seconds,
        "logs": bench.names,
    }


def _unit(channel: str) -> str:
    found = find_channel(channel)
    return found[0].unit if found is not None else ""


def at_edge(bench: Bench, found: Fitted) -> list[str]:
    """Unknowns that ended at a bound of plausibility."""
    out = []
    for q, u in zip(found.unknowns, found.u, strict=True):
        value = float(q.value(_start(bench.model, q), u))
        span = 1e-3 * (abs(q.low) + abs(q.high)) if math.isfinite(q.low + q.high) else 1e-9
        if not q.low + span < value < q.high - span and q.low != 0.0:
            out.append(q.key)
    return out


def _start(model: Model, q: Unknown) -> float:
    """The model's value; of a suspect that the model has not, what it begins from."""
    if q.effect == CALIBRATION or q.effect in model.effect_names:
        return start_of(model, q)
    from lunar_mjx.effects import catalogue

    nominal = catalogue.CATALOGUE[q.effect]
    return nominal.nominal()[q.name] if q.factor else float(nominal.null()[q.name])


def parameter_table(model: Model, found: Fitted) -> dict[str, Any]:
    """Values and standard deviations of the unknowns, in physical units."""
    table: dict[str, Any] = {}
    for q, u, s in zip(found.unknowns, found.u, found.std, strict=True):
        start = _start(model, q)
        value = float(q.value(start, u))
        row = table.setdefault(q.effect, {"value": {}, "std": {}, "given": {}, "unit": {}, "posterior_over_prior": {}})
        row["value"][q.name], row["given"][q.name], row["unit"][q.name] = value, start, q.unit
        row["std"][q.name] = float(s * q.std * (value if q.factor else 1.0))
        row["posterior_over_prior"][q.name] = float(s)
    return table


def fitted_model(model: Model, found: Fitted) -> Model:
    """The model with fitted values, and with what these logs taught as priors for others.

    A rover's parameters drift from day to day, so no prior gets narrower than a tenth of the data sheet's range.
    """
    for s in found.suspects:
        if s.kind == "effect" and s.name not in model.effect_names:
            model = model.add(s.name)
    priors = dict(model.priors)
    full = {q.key: q for q in (*(q for s in catalogue_of(model) for q in s.unknowns), *data_sheet(model))}
    for q, u, s in zip(found.unknowns, found.u, found.std, strict=True):
        start = _start(model, q)
        value = float(q.value(start, u))
        if q.effect != CALIBRATION:
            old = model.parameters[q.effect][q.name]
            new = tuple(v * value / start for v in old) if isinstance(old, tuple) and q.factor else value
            model = model.set(q.effect, "fit", **{q.name: new})
        wide = full[q.key].std
        std = math.hypot(s * q.std, DRIFT * wide)
        priors[q.key] = (value, std * value if q.factor else std)
    return dataclasses.replace(model, priors=priors)


def why(run: Run, logs: Sequence[Log], only: Sequence[str] | None, seconds: float, progress: Progress) -> Diagnosis:
    """Weighs every explanation of what a model leaves of some logs; writes `verdict.json`, provisionally as it goes."""
    begin = time.monotonic()
    bench = Bench(run, logs, progress)
    noise = bench.noise()
    suspects = suspects_of(bench.model, bench.cut.channels)
    if only is not None:
        names = [s.name for s in suspects]
        for name in only:
            if name not in names:
                raise UserError(f"effect {name!r} is no candidate here; use one of {', '.join(names)}.")
        suspects = tuple(s for s in suspects if s.name in only)

    def provisional(found: Sequence[Fitted], noise: Sequence[Noise]) -> None:
        run.save(VERDICT_FILE, {**_diagnosis(bench, noise, found, []).to_dict(), "provisional": True})

    try:
        found, left, noise = search(
            bench.problem, bench.base, suspects, bench.learn, noise, bench.split, seconds, progress, provisional
        )
    except (EvidenceError, np.linalg.LinAlgError) as error:
        diagnosis = Diagnosis(Verdict.BAD_FIT, (), f"The model as it is could not be fitted: {error}.")
        run.save(VERDICT_FILE, diagnosis.to_dict())
        return diagnosis
    diagnosis = _diagnosis(bench, noise, found, left)
    fits = {"refitted": found[0]}
    if diagnosis.effects:
        best = max((f for f in found if f.suspects), key=lambda f: f.log_evidence)
        fits["with " + best.name] = best
    given = bench.problem(None).predict(bench.base, np.zeros((1, len(bench.base))))[0]
    _save(bench, noise, given, fits, found[0], time.monotonic() - begin)
    run.save(VERDICT_FILE, diagnosis.to_dict())
    return diagnosis


def _diagnosis(bench: Bench, noise: Sequence[Noise], found: Sequence[Fitted], left: Sequence[str]) -> Diagnosis:
    base = found[0]
    chance = probabilities(found)
    by_name = {f.name: f for f in found}
    order = sorted(by_name, key=lambda n: -chance[n])
    verdict, named = _named(order, chance, by_name)
    top = by_name[order[0]]
    names = tuple(dict.fromkeys(s.name for n in named for s in by_name[n].suspects))
    families = sorted({by_name[n].suspects[0].family for n in named if by_name[n].suspects})
    held = {n: _held_out_gain(bench, noise, by_name[n], base) for n in order[:8]}
    if named and verdict is not Verdict.UNKNOWN:
        gain, error = held.get(named[0], (math.nan, math.nan))
        # A name that does not help what it never saw is none; where nothing was held out, nothing is refused.
        if gain <= error:
            verdict = Verdict.UNKNOWN
    if verdict is Verdict.UNKNOWN:
        names = ()
    evidence = [
        _evidence_of(bench, f, base, chance[f.name], held.get(f.name), f.name in named)
        for f in sorted(found[1:], key=lambda f: -chance[f.name])
    ]
    sentence = _sentence(verdict, named, chance, bench, top, base)
    before, after = (errors(bench, noise, f.predicted) for f in (base, top))
    untold = [q.key for q, s in zip(base.unknowns, base.std, strict=True) if s > NOT_TOLD]
    if untold:
        sentence += f" These logs hardly tell {', '.join(untold)}."
    ports: dict[str, float] = {}
    for f in found[1:]:
        family = f.suspects[0].family
        if len(f.suspects) == 1:
            ports[family] = max(ports.get(family, -math.inf), f.log_evidence - base.log_evidence)
    return Diagnosis(
        verdict,
        names,
        sentence,
        tuple(evidence),
        ports=ports,
        error_before=before,
        error_after=after,
        details={
            "probability": {n: chance[n] for n in order},
            "log_evidence": {n: by_name[n].log_evidence for n in order},
            "families": families,
            "not_told": untold,
            "not_tried": list(left),
            "between_logs": base.differ,
            "noise_factor": base.evidence.noise.tolist(),
            "windows": {"used": len(bench.cut), "of": bench.cut.available},
            "parameters": parameter_table(bench.model, top),
        },
    )


def _named(
    order: Sequence[str], chance: Mapping[str, float], by_name: Mapping[str, Fitted]
) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict, and the hypotheses that together are as good as certain."""
    null = by_name_null(by_name)
    if chance[null] >= 1.0 - NAMED and order[0] == null:
        return Verdict.NOISE_ONLY if chance[null] >= NAMED else Verdict.UNDECIDABLE, ()
    named: list[str] = []
    total = 0.0
    for name in order:
        if name == null:
            continue
        named.append(name)
        total += chance[name]
        if total >= NAMED:
            break
    if total < NAMED:
        return Verdict.UNDECIDABLE, ()
    first = {by_name[n].suspects[0].name for n in named}
    if len(named) == 1:
        return (Verdict.KNOWN if len(by_name[named[0]].suspects) == 1 else Verdict.MULTIPLE), tuple(named)
    if len(first) == 1 and all(len(by_name[n].suspects) > 1 for n in named):
        return Verdict.MULTIPLE, tuple(named[:1])
    if len(first) <= MOST_NAMED:
        return Verdict.KNOWN_CLASS, tuple(named)
    return Verdict.UNKNOWN, tuple(named)


def by_name_null(by_name: Mapping[str, Fitted]) -> str:
    """Name of the hypothesis that nothing is missing."""
    return next(n for n, f in by_name.items() if not f.suspects)


def _sentence(
    verdict: Verdict, named: Sequence[str], chance: Mapping[str, float], bench: Bench, top: Fitted, base: Fitted
) -> str:
    shown = ", ".join(f"{n} ({100.0 * chance[n]:.0f} %)" for n in named[:5])
    if verdict is Verdict.NOISE_ONLY:
        null = chance[base.name]
        return f"Nothing beyond usual differences between drives is missing ({100.0 * null:.0f} %)."
    if verdict is Verdict.KNOWN:
        return f"{shown}: {_values(bench.model, top)}."
    if verdict is Verdict.KNOWN_CLASS:
        return f"One of {shown}; these logs do not tell them apart further."
    if verdict is Verdict.MULTIPLE:
        return f"Several at once: {shown}; {_values(bench.model, top)}."
    if verdict is Verdict.UNKNOWN:
        return _unknown_sentence(named, shown, bench, top, base)
    quiet = f"Nothing need be missing ({100.0 * chance[base.name]:.0f} %)" if top is base else "No explanation has 95 %"
    rivals = ", ".join(
        f"{n} ({100.0 * p:.0f} %)" for n, p in sorted(chance.items(), key=lambda c: -c[1])[:4] if n != base.name
    )
    return f"{quiet}, and these logs do not exclude {rivals}; drive slopes, turns and speeds beside these."


def _unknown_sentence(named: Sequence[str], shown: str, bench: Bench, top: Fitted, base: Fitted) -> str:
    """Where something acts that cannot be named, how much it is, and what would tell more."""
    problem = bench.problem(None)
    sizes = []
    for c, channel in enumerate(CHANNELS):
        there = problem.there[c]
        if there.any():
            moved = float(np.sqrt(np.mean((top.predicted[c] - base.predicted[c])[there] ** 2)))
            left = float(np.sqrt(np.mean(problem.residual(base.predicted)[c][there] ** 2)))
            sizes.append(f"{moved:.2g} of {left:.2g} {_unit(channel)} of {channel}")
    families = ", ".join(dict.fromkeys(s.family for s in top.suspects)) or "model"
    why_not = (
        "fits these windows without helping those that were held out"
        if len(named) <= MOST_NAMED
        else f"are more than {MOST_NAMED} explanations"
    )
    return (
        f"Something acts on the {families} that the list does not explain: {shown} {why_not}. It would change "
        f"{'; '.join(sizes)}. Measure the same ground again, with straight drives, turns and slopes at two speeds."
    )


def _values(model: Model, found: Fitted) -> str:
    """The suspects' values in physical units."""
    keys = {q.key for s in found.suspects for q in s.unknowns}
    out = []
    for q, u, s in zip(found.unknowns, found.u, found.std, strict=True):
        if q.key in keys:
            value = float(q.value(_start(model, q), u))
            std = float(s * q.std * (value if q.factor else 1.0))
            unit = "" if q.unit == "1" else f" {q.unit}"
            out.append(f"{q.name} {value:.3g} +- {std:.1g}{unit}")
    return ", ".join(out)


def _held_out_gain(bench: Bench, noise: Sequence[Noise], found: Fitted, base: Fitted) -> tuple[float, float]:
    """Gain of the log density of held-out windows over the model alone, by windows, with its standard error."""
    if not bench.split.held_out.any():
        return math.nan, math.nan
    problem = bench.problem(None)
    gains = np.zeros(len(bench.cut))
    for sign, f in ((-1.0, found), (1.0, base)):
        white = problem.whitened(bench.residual(f.predicted)[..., None], noise)[..., 0]
        gains += sign * 0.5 * np.sum(white**2, axis=(0, 2))
    mine = gains[bench.split.held_out]
    return float(mine.sum()), float(np.std(mine) * math.sqrt(len(mine)))


def _evidence_of(
    bench: Bench, found: Fitted, base: Fitted, chance: float, held: tuple[float, float] | None, named: bool
) -> EffectEvidence:
    keys = {q.key for s in found.suspects for q in s.unknowns}
    values, std = {}, {}
    for q, u, s in zip(found.unknowns, found.u, found.std, strict=True):
        if q.key in keys:
            values[q.name] = float(q.value(_start(bench.model, q), u))
            std[q.name] = float(s * q.std * (values[q.name] if q.factor else 1.0))
    gain = found.log_evidence - base.log_evidence
    moved = math.sqrt(max(2.0 * gain, 0.0))
    status = "accepted" if named else "rejected" if gain < 3.0 else "not significant"
    reason = f"probability {chance:.2g}, log evidence {gain:+.1f} over the model alone"
    if edge := [k for k in at_edge(bench, found) if k in keys]:
        reason += f"; implausible: {', '.join(edge)} ends at its bound"
    return EffectEvidence(
        found.name,
        moved,
        1.0,
        2.0 * gain,
        moved,
        1.0 - chance,
        *(held or (math.nan, math.nan)),
        values,
        std,
        status=status,
        reason=reason,
    )


def add(run: Run, logs: Sequence[Log], name: str, out: Path, progress: Progress) -> Run:
    """Adds a suspect to a run's model, refits, and compares anew in another folder, on the same windows and noise.

    Raises:
      UserError: no such effect, parameter or calibration, or the model has it.
    """
    bench = Bench(run, logs, progress)
    by_name = {s.name: s for s in suspects_of(bench.model, bench.cut.channels)}
    if name not in by_name:
        raise UserError(f"add: {name} cannot be added to this model; use one of {', '.join(by_name)}.")
    suspect: Suspect = by_name[name]
    noise = bench.noise()
    base = fit(bench.problem(None), bench.base, (), noise, bench.split)
    form = "soft_ground" if name == "soft_ground" else None
    found = fit(bench.problem(form), bench.base, (suspect,), noise, bench.split)
    model = fitted_model(bench.model, found)
    # What was added is as free in the next fit as it was in this one.
    priors = {**run.model.priors}
    for q in unknowns_of(bench.problem(form), bench.base, (suspect,)):
        if q.key in {k.key for k in suspect.unknowns}:
            value = model.priors[q.key][0]
            priors[q.key] = (value, q.std * value if q.factor else q.std)
        elif q.effect == CALIBRATION:
            priors[q.key] = (model.priors[q.key][0], q.std)
    model = dataclasses.replace(model, priors=priors)
    child = dataclasses.replace(
        run, folder=Path(out), model=model, added=(*run.added, name), parent=str(run.folder.resolve())
    )
    compare(child, logs, progress, bench)
    _say_what_moved(child, errors(bench, noise, base.predicted))
    return child


def _say_what_moved(child: Run, before: Mapping[str, float]) -> None:
    """Puts into the comparison's certificate whether the addition helped what it never saw."""
    content = child.load(COMPARISON_FILE)
    after = content["refitted"]
    for split, label in (("fit", "fitted"), ("held_out", "held-out")):
        if split in before and split in after:
            was, now = before[split], after[split]
            if now > was * (1.0 + SAME):
                content["certificate"]["problems"].append(
                    f"the error on {label} windows rises from {was:.2f} to {now:.2f}"
                )
            elif now > was * (1.0 - SAME):
                content["certificate"]["problems"].append(f"nothing moved on {label} windows ({was:.2f} to {now:.2f})")
    child.save(COMPARISON_FILE, content)


def _save_series(bench: Bench, noise: Sequence[Noise], given: np.ndarray, fits: Mapping[str, Fitted]) -> None:
    """Measured and predicted windows for the report, as `series.npz`."""
    problem, found = bench.problem(None), bench.cut
    rows = np.stack([given, *(f.predicted for f in fits.values())])
    columns: dict[str, list[Any]] = {
        k: [] for k in ("measured", "sigma", "time", "unit", "series_start", "series_channel", "series_log")
    }
    predicted, residual = [], []
    at = 0
    logs = [int(k) for k in np.unique(found.log)]
    # a log whose windows are partly held out is two units of one name
    units = sorted({(k, s) for k, s in zip(found.log.tolist(), bench.splits.tolist(), strict=True)})
    for k in logs:
        for c, channel in enumerate(CHANNELS):
            keep = np.flatnonzero(problem.present[c] & (found.log == k))
            if not len(keep):
                continue
            keep = keep[np.argsort(found.start_s[keep])]
            there = problem.there[c][keep]
            times = (found.start_s[keep][:, None] + found.interval_s * np.arange(found.samples))[there]
            columns["series_start"].append(at)
            columns["series_channel"].append(channel)
            columns["series_log"].append(k)
            columns["measured"].append(problem.measured[c][keep][there])
            columns["sigma"].append(np.full(times.size, noise[c].std))
            columns["time"].append(times)
            number = np.array([units.index((k, bench.splits[w])) for w in keep])
            columns["unit"].append(np.broadcast_to(number[:, None], there.shape)[there])
            predicted.append(rows[:, c, keep][:, there])
            residual.append((columns["measured"][-1] - predicted[-1]) / noise[c].std)
            at += times.size
    with replacing(bench.run.folder / SERIES_FILE) as part:
        np.savez_compressed(
            part,
            measured=np.concatenate(columns["measured"]),
            sigma=np.concatenate(columns["sigma"]),
            time=np.concatenate(columns["time"]),
            unit=np.concatenate(columns["unit"]),
            place=np.zeros((0, 3)),
            unit_names=np.array(
                [bench.names[k] + (" (end)" if s == "test" and (k, "fit") in units else "") for k, s in units]
            ),
            split=np.array([s for _, s in units]),
            series_start=np.array(columns["series_start"]),
            series_channel=np.array(columns["series_channel"]),
            series_log=np.array(columns["series_log"]),
            logs=np.array(bench.names),
            labels=np.array(["as given", *fits]),
            predicted=np.concatenate(predicted, axis=1),
            residual=np.concatenate(residual, axis=1),
        )
