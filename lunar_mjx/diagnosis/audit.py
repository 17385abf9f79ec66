"""How often the tool is wrong on logs like these: simulated nulls and single effects through the whole diagnosis.

The simulated logs have the inputs, rates and noise of the real ones. They come from the model itself, so the error
rates are those of the method where the rest of the model is true: a lower bound.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from lunar_mjx._version import __version__
from lunar_mjx.diagnosis.build_problem import known_logs
from lunar_mjx.diagnosis.drives.form import DriveForm
from lunar_mjx.diagnosis.drives.loop import build_drives
from lunar_mjx.diagnosis.runs import AUDIT_FILE, MODEL_FILE, Run, folder_hash, load_run
from lunar_mjx.diagnosis.tables.simulated import VISIBLE, SimulatedTables
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.conclusion import conclude
from lunar_mjx.errors import bad_input
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.weighing.hypotheses import Refit
from lunar_mjx.inference.weighing.search import LEAST_SIGNAL, search
from lunar_mjx.logs import Log, SteadyLog

NULL = "nothing"


@dataclasses.dataclass(frozen=True)
class Audit:
    """Result of diagnosing simulated logs whose truth is known.

    Attributes:
      cases: one row each: truth, amount (in nominal sizes), verdict, effects named, outcome.
      rates: by outcome: count, of how many, and its Wilson 95 % interval.
      sentence: all of that.
    """

    cases: tuple[dict[str, Any], ...]
    rates: dict[str, dict[str, float]]
    sentence: str

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        return dataclasses.asdict(self)


def audit(folder: str | Path | Run, seconds: float, progress: Progress = silent) -> Audit:
    """Diagnoses simulated logs like those of a run until the time is spent; writes `audit.json`.

    Nulls and single effects take turns. Earlier cases of the same model and logs are kept and added to.

    Args:
      folder: of the run. seconds: to spend; the case in progress is finished, and two are diagnosed at least.
      progress: told what is being done.

    Raises:
      UserError: a time that is not positive.
    """
    if not seconds > 0.0:
        raise bad_input("why", "--audit", seconds, "is not a time", "give minutes above 0")
    run = folder if isinstance(folder, Run) else load_run(folder)
    key = _key(run)
    stored = run.load(AUDIT_FILE) or {}
    cases: list[dict[str, Any]] = list(stored.get("cases", [])) if stored.get("key") == key else []
    end = time.monotonic() + seconds
    logs = known_logs(run)
    tables = [log for log in logs if isinstance(log, SteadyLog)]
    if tables:
        simulated = SimulatedTables(run, tables)

        def one(number: int) -> dict[str, Any]:
            truth, amount, said = simulated.case(number)
            return {
                "truth": truth or NULL,
                "amount": amount,
                "verdict": said.verdict.label,
                "effects": list(said.effects),
                "outcome": _outcome(truth or NULL, said.verdict, said.effects),
            }
    else:
        drives = [log for log in logs if isinstance(log, Log)]
        form = build_drives(run, drives, None, progress).own
        assert isinstance(form, DriveForm)
        base = form.refit(frozenset(), None, None)
        sizes = _sizes(form, base)

        def one(number: int) -> dict[str, Any]:
            return _case(form, base, sizes, number, run.seed)

    begun = time.monotonic()
    done = 0
    # two at least: a null and an effect
    while done < 2 or time.monotonic() < end:
        done += 1
        progress(f"auditing, case {len(cases) + 1}", min(1.0, (time.monotonic() - begun) / max(end - begun, 1e-9)))
        # numbered on from the stored ones, so that no case is drawn twice
        cases.append(one(len(cases)))
        summary = _summary(cases)
        # After each case, so that an audit that is broken off keeps what it has found.
        run.save(AUDIT_FILE, {"key": key, "version": __version__, **summary.to_dict()})
    return _summary(cases)


def _key(run: Run) -> str:
    """Hash of the model, the campaign and the tool that an audit belongs to."""
    digest = hashlib.sha256((run.folder / MODEL_FILE).read_bytes())
    for log in run.logs:
        digest.update(folder_hash(log).encode())
    digest.update(repr((run.candidates, sorted(run.splits.items()), sorted(run.discrepancy.items()))).encode())
    # Another version is another method: its cases must not be counted into the same rates.
    digest.update(repr((__version__, run.seed, sorted(run.settings.items()))).encode())
    return digest.hexdigest()


def _sizes(form: DriveForm, base: Refit) -> dict[str, float]:
    """Amount, in nominal sizes, of every effect that these logs can show: the nominal one, or what is well visible."""
    sizes = {}
    for name, length in base.linear.shows().items():
        if length >= LEAST_SIGNAL:
            low, high = form.drives.bounds(form.candidates[name])
            # effects that would drown at their nominal size are made visible: an audit of what cannot be seen says
            # nothing
            sizes[name] = float(np.clip(max(1.0, VISIBLE / length), 0.0, np.min(np.maximum(high, -low))))
    return sizes


def _case(form: DriveForm, base: Refit, sizes: dict[str, float], number: int, seed: int) -> dict[str, Any]:
    # Seeded by its number, a case is the same whichever call of the audit comes to it.
    rng = np.random.default_rng([seed, number])
    truth, u, amount = NULL, form.bare(base.u), 0.0
    if number % 2 and sizes:
        names = sorted(sizes)
        truth = names[int(rng.integers(len(names)))]
        amount = sizes[truth]
        places = [i for i in form.candidates[truth] if form.coordinates[i].amplitude]
        low, high = form.drives.bounds(np.array(places))
        sign = rng.choice([-1.0, 1.0], size=len(places))
        # An amplitude that its bounds keep to one side takes that side, whatever the coin says.
        u[places] = np.clip(np.where((sign > 0.0) & (high > 0.0) | (low >= 0.0), amount, -amount), low, high)
    clean = form.predicted(u)
    case: dict[str, Any] = {"truth": truth, "amount": amount}
    if not np.isfinite(clean).all():
        return {**case, "verdict": "", "effects": [], "outcome": "diverged"}
    drawn = form.measuring(clean + draw_noise(form.drives.observations, rng), form.bare(base.u))
    settings = form.settings
    try:
        model_search = search([drawn], settings.most_refits, settings.most_terms, settings.window)
    except EvidenceError:
        # A failed solver is an answer that users get, too: it is counted and not drawn again.
        return {
            **case,
            "verdict": Verdict.BAD_FIT.label,
            "effects": [],
            "outcome": _outcome(truth, Verdict.BAD_FIT, ()),
        }
    conclusion = conclude(model_search, settings.sure)
    return {
        **case,
        "verdict": conclusion.verdict.label,
        "effects": list(conclusion.effects),
        "outcome": _outcome(truth, conclusion.verdict, conclusion.effects),
    }


def draw_noise(observations: Observations, rng: np.random.Generator) -> np.ndarray:
    """(n,) noise of the stated kind: white, and Ornstein-Uhlenbeck where a series has a coloured part."""
    out = np.empty(len(observations))
    for s in observations.series:
        part = slice(s.start, s.stop)
        out[part] = s.white * rng.standard_normal(s.stop - s.start)
        if s.time is None or s.coloured <= 0.0:
            continue
        # exact at any spacing of samples (Gillespie 1996)
        slow = np.empty(s.stop - s.start)
        slow[0] = rng.standard_normal()
        keep = np.exp(-np.diff(s.time) / max(s.correlation_time, 1e-9))
        for i, k in enumerate(keep):
            slow[i + 1] = k * slow[i] + np.sqrt(1.0 - k**2) * rng.standard_normal()
        out[part] += s.coloured * slow
    return out


def _outcome(truth: str, verdict: Verdict, effects: tuple[str, ...]) -> str:
    if verdict is Verdict.BAD_FIT:
        return "no fit"
    if verdict is Verdict.UNDECIDABLE:
        return "missed" if truth != NULL else "undecided"
    if truth == NULL:
        return "silent, rightly" if verdict is Verdict.NOISE_ONLY else "false alarm"
    if verdict is Verdict.KNOWN and effects == (truth,):
        return "named"
    if verdict is Verdict.KNOWN_CLASS and truth in effects:
        return "in its class"
    if verdict is Verdict.NOISE_ONLY:
        return "missed"
    # Several effects named where one acts are wrong, even if that one is among them.
    return "unknown" if verdict is Verdict.UNKNOWN else "wrongly named"


def wilson(count: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a rate (Wilson 1927); all of it where nothing was tried."""
    if of == 0:
        return 0.0, 1.0
    # The normal interval has no width at 0 of n, which is the very count that is hoped for.
    interval = stats.binomtest(count, of).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


def _summary(cases: list[dict[str, Any]]) -> Audit:
    # A log that could not be simulated was never diagnosed: it says nothing for or against the method.
    used = [c for c in cases if c["outcome"] != "diverged"]
    nulls = [c for c in used if c["truth"] == NULL]
    singles = [c for c in used if c["truth"] != NULL]
    rates = {}
    for label, group, outcomes in (
        ("false alarms", nulls, ("false alarm",)),
        ("right", singles, ("named", "in its class")),
        ("wrongly named", singles, ("wrongly named",)),
        ("missed", singles, ("missed",)),
        ("unknown", singles, ("unknown",)),
        ("no fit", used, ("no fit",)),
    ):
        count = sum(c["outcome"] in outcomes for c in group)
        low, high = wilson(count, len(group))
        rates[label] = {"count": count, "of": len(group), "low": low, "high": high}

    def said(label: str) -> str:
        r = rates[label]
        return f"{r['count']} of {r['of']} (95 % interval {100 * r['low']:.0f} to {100 * r['high']:.0f} %)"

    sentence = (
        f"On simulated logs like these, false alarms: {said('false alarms')}; single effects named, or put into their "
        f"class: {said('right')}; wrongly named: {said('wrongly named')}."
    )
    return Audit(tuple(cases), rates, sentence)
