"""Effects that nobody listed: formulas at the failing port, scored through the simulator like catalogue effects."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.build_problem import known_logs, table_problem
from lunar_mjx.diagnosis.drives.loop import build_drives
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.formulas.search import FORMULA_SEARCH, Settings, Trial, search_formulas
from lunar_mjx.diagnosis.formulas.slots import WHEEL_PORTS, Slots
from lunar_mjx.diagnosis.formulas.targets import CONSTANTS
from lunar_mjx.diagnosis.formulas.terms import FORMULA_PORTS, SUGGESTED, Term, effect_of, terms, with_amount
from lunar_mjx.diagnosis.runs import UNKNOWN_FILE, VERDICT_FILE, Run, load_run
from lunar_mjx.diagnosis.weighed import answer
from lunar_mjx.effects.base import PORTS
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.files import write_text
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.fitting import Fit, Progress, fit, silent
from lunar_mjx.inference.held_out import errors
from lunar_mjx.logs import Log, SteadyLog
from lunar_mjx.logs.schema import channel_kind, is_command

REFITS = 5
"""Formulas that are suggested; where each is simulated by itself, the best-scored are refitted."""
LISTED = 100
"""Scores that are listed."""


@dataclasses.dataclass(frozen=True)
class Part:
    """One formula of a suggestion.

    Attributes:
      port, target: where it acts, on what. formula, latex: the law, its amount called a, as text and for a report.
      amount, std, unit: its fitted amount. constants: others in it that were fitted, with their units.
    """

    port: str
    target: str
    formula: str
    latex: str
    amount: float
    std: float
    unit: str
    constants: dict[str, tuple[float, str]] = dataclasses.field(default_factory=dict)

    def text(self) -> str:
        """Law and numbers in a line."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        more = "".join(f", {k} = {v:.3g}{'' if u == '1' else ' ' + u}" for k, (v, u) in self.constants.items())
        return f"{self.target} ({self.port}): {self.formula} with a = {self.amount:.4g} +- {self.std:.1g}{unit}{more}"


@dataclasses.dataclass(frozen=True)
class Suggestion:
    """A formula, or two together.

    Attributes:
      port, target, formula: where it acts, on what, and how, in words. parts: the formulas with their numbers.
      chi2: reduction of chi-square by the refit. held_out_gain, held_out_se: on manoeuvres left out.
      error: root mean square residual in sigma by split with it. at_noise: whether the residual is at the noise.
      length: operations and symbols in the formulas.
    """

    port: str
    target: str
    formula: str
    parts: tuple[Part, ...]
    chi2: float
    held_out_gain: float
    held_out_se: float
    error: dict[str, float]
    at_noise: bool
    length: int

    def pays(self, chi2: float) -> bool:
        """Whether its gain on manoeuvres left out exceeds its standard error, and half of the gain when fitted."""
        # Formulas are chosen out of hundreds: what noise gave one in the fit, held-out data do not repeat.
        return self.held_out_gain > self.held_out_se and self.held_out_gain > 0.5 * chi2


def _suggestion(
    parts: Sequence[Part],
    chi2: float,
    gained: tuple[float, float],
    error: dict[str, float],
    at_noise: bool,
    length: int,
) -> Suggestion:
    ports, targets = (list(dict.fromkeys(getattr(p, name) for p in parts)) for name in ("port", "target"))
    formula = "; ".join(p.formula for p in parts)
    return Suggestion(
        " and ".join(ports), " and ".join(targets), formula, tuple(parts), chi2, *gained, error, at_noise, length
    )


@dataclasses.dataclass(frozen=True)
class Discovery:
    """Suggested formulas, best first.

    Attributes:
      port: where the most evidence is, or that was asked for. suggestions: refitted ones.
      scored: formulas with their score's chi-square, highest first (tables: the first hundred).
      files: effect files of the best suggestion, one for each of its parts; none where nothing pays on manoeuvres left
        out. error_before: root mean square residual in sigma by split. number: formulas scored.
    """

    port: str
    suggestions: tuple[Suggestion, ...]
    scored: tuple[tuple[str, float], ...]
    files: tuple[str, ...]
    error_before: dict[str, float]
    number: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        return dataclasses.asdict(self)

    def text(self) -> str:
        """A few lines for a terminal."""
        lines = [f"Port {self.port}; {self.number} formulas scored:"]
        for i, s in enumerate(self.suggestions, 1):
            lines.append(f"  {i}. " + "; and ".join(p.text() for p in s.parts))
            lines.append(
                f"     chi2 {-s.chi2:+.0f}, held-out gain {s.held_out_gain:.0f} +- {s.held_out_se:.0f}"
                + (", at the noise" if s.at_noise else "")
            )
        if self.files:
            runs = ["RUN", *(f"run{k + 2}" for k in range(len(self.files)))]
            sequence = ", then ".join(
                f"lunar-mjx add {a} {shlex.quote(file)} -o {b}"
                for a, file, b in zip(runs, self.files, runs[1:], strict=False)
            )
            lines.append(f"Effect file: {', '.join(self.files)}; look at it, then: {sequence}")
        else:
            lines.append("No formula pays on manoeuvres left out; none is written.")
        return "\n".join(lines)


def discover(
    folder: str | Path | Run, port: str | None = None, out: str | Path | None = None, progress: Progress = silent
) -> Discovery:
    """Suggests formulas for what is missing at a port, and writes the best as an effect file.

    Args:
      folder: of the run. port: where to look; if None, where `why` found the most evidence, and for tables at every
        port of the wheel, because one signal may enter a bed at several.
      out: effect file to write; `suggested_<port>.py` in the run's folder if None.
      progress: told what is being done.

    Raises:
      UserError: no such port, or `why` has not been asked and no port is given.
    """
    run = folder if isinstance(folder, Run) else load_run(folder)
    verdict = run.load(VERDICT_FILE) or {}
    # What was asked for decides where tables are searched; the verdict's port is only where the evidence is.
    asked, port = port, port or verdict.get("port")
    if port is None:
        raise UserError(f"{run.folder}: no port shows anything unknown; run lunar-mjx why first, or give --port.")
    if port not in FORMULA_PORTS:
        problem = "has no formulas" if port in PORTS else "does not exist"
        raise bad_input("unknown", "port", port, problem, f"use one of {', '.join(FORMULA_PORTS)}")
    # A suggestion may be made anew, but a file that the user wrote is never written over.
    if out is not None and Path(out).exists() and not Path(out).read_text(encoding="utf-8").startswith(SUGGESTED):
        raise bad_input("unknown", "--out", str(out), "exists, and is none of these suggestions", "name another file")
    logs = known_logs(run)
    if isinstance(logs[0], SteadyLog):
        if asked is not None and asked not in WHEEL_PORTS:
            raise bad_input("unknown", "port", asked, "is none of a wheel bed", f"use one of {', '.join(WHEEL_PORTS)}")
        before, suggested, scored, number = _in_tables(run, logs, [asked] if asked else WHEEL_PORTS, progress)
    else:
        before, suggested, scored = _in_drives(run, logs, port, progress)
        number = len(scored)
    files: list[str] = []
    # The first that pays: the best-scored may have fitted noise.
    best = next((row for row in suggested if row[0].pays(Settings().chi2)), None)
    if best is not None:
        provenance = f"lunar-mjx unknown on {', '.join(p.name for p in run.logs)}"
        for k, (part, term) in enumerate(zip(best[0].parts, best[1], strict=True)):
            values = {c: v for c, (v, _) in part.constants.items()}
            text = functools.partial(with_amount, term, part.amount, provenance=provenance, constants=values)
            files.append(str(_write(run, Path(out) if out else None, part.port, k, text)))
    result = Discovery(port, tuple(s for s, _ in suggested), tuple(scored[:LISTED]), tuple(files), before, number)
    run.save(UNKNOWN_FILE, result.to_dict())
    return result


def _write(run: Run, out: Path | None, port: str, part: int, text: Callable[..., str]) -> Path:
    """Writes the effect file of a part under a name that the model lacks, beside what other models may refer to."""
    for k in itertools.count(part + 1):
        name = f"suggested_{port}" + (f"_{k}" if k > 1 else "")
        path = run.folder / f"{name}.py" if out is None else out.with_stem(f"{out.stem}_{part + 1}") if part else out
        made = text(name=name)
        # A model may refer to the file of an earlier suggestion: another text takes another name.
        kept = out is None and path.is_file() and path.read_text(encoding="utf-8") != made
        if name not in run.model.effect_names and not kept:
            write_text(path, made)
            return path
    raise AssertionError


Row = tuple[Suggestion, tuple[Term, ...]]
"""A suggestion with the terms of its parts."""


def _in_tables(
    run: Run, logs: Sequence[Any], ports: Sequence[str], progress: Progress
) -> tuple[dict[str, float], list[Row], list[tuple[str, float]], int]:
    """Errors of the model as it is, suggestions, the best scores, and how many formulas of a wheel were scored."""
    empty = Slots(table_problem(run, logs, {}))
    settings = Settings(seed=run.seed)
    # Without any slot filled: what formulas are scored against is the refitted model, and not the model as given.
    base = fit(empty.problem, empty.problem.free(), starts=settings.starts, seed=settings.seed, progress=progress)
    found = search_formulas(empty, base, ports, settings, progress)
    rows = [_of_trial(t, base) for t in found.trials[:REFITS]]
    scored = [(f"{c.term.target}: {c.term.formula}", chi2) for c, chi2 in found.scored[:LISTED]]
    return errors(empty.problem, base), rows, scored, len(found.scored)


def _in_drives(
    run: Run, logs: Sequence[Any], port: str, progress: Progress
) -> tuple[dict[str, float], list[Row], list[tuple[str, float]]]:
    """Errors of the model as it is, suggestions, and all formulas at a port with what they take off chi-square.

    Each formula is an effect with one amount: all are scored by their evidence in linear approximation where the model
    as it is has been refitted, beside usual discrepancy, and the best are refitted.
    """
    library = {t.name: t for t in terms(port, sensor_kinds(logs))}
    form = build_drives(run, logs, None, progress, {name: effect_of(t) for name, t in library.items()}).own
    base = form.refit(frozenset(), None, None)
    before, nothing, places = base.linear.evidence(frozenset())
    gains = {
        name: base.linear.evidence(form.listed(frozenset([name])), (nothing.tau, nothing.noise))[0] - before
        for name in form.candidates
    }
    # Twice a log evidence is on the scale of chi-square, in which the penalty is given.
    order = sorted(gains, key=lambda n: -(2.0 * gains[n] - FORMULA_SEARCH.penalty * library[n].length))
    scored = [(f"{library[n].target}: {library[n].formula}", max(2.0 * gains[n], 0.0)) for n in order]
    rows: list[Row] = []
    for i, name in enumerate(order[:REFITS]):
        progress("refitting formulas", i / REFITS)
        try:
            refit = form.refit(frozenset([name]), base, None)
        except EvidenceError:
            continue  # a formula with which the rover cannot drive
        after, posterior, own = refit.linear.evidence(form.listed(frozenset([name])))
        t = library[name]
        at = next(i for i in form.candidates[name] if form.coordinates[i].amplitude)
        c, k = form.coordinates[at], list(own).index(at)
        std = c.std(refit.u[at], math.sqrt(float(posterior.covariance[k, k])))
        part = Part(t.port, t.target, t.formula, t.latex, float(c.value(refit.u[at])), std, t.unit)
        held = [
            posterior.log_score(gram.select(own)) - nothing.log_score(base.linear.held_out[n].select(places))
            for n, gram in refit.linear.held_out.items()
        ]
        # Of the sum over manoeuvres: their spread is what another campaign would show.
        se = math.sqrt(len(held)) * float(np.std(held, ddof=1)) if len(held) > 1 else 0.0
        # without manoeuvres left out the evidence itself judges: it is what each measurement predicts of the next
        gained = (sum(held), se) if held else (after - before, 0.0)
        residual = form.residual(form.bare(refit.u))
        # At the noise where the fit asks for no more of it than the stated size is uncertain.
        quiet = bool(np.max(posterior.noise) < 1.0 + DriveSettings().stated_spread)
        suggestion = _suggestion([part], 2.0 * (after - before), gained, answer.errors(form, residual), quiet, t.length)
        rows.append((suggestion, (t,)))
    rows.sort(key=lambda row: -(row[0].chi2 - FORMULA_SEARCH.penalty * row[0].length))
    return answer.errors(form, form.residual(form.bare(base.u))), rows, scored


def _of_trial(trial: Trial, base: Fit) -> Row:
    problem, parts = trial.slots.problem, []
    root = np.sqrt(np.diag(trial.fit.covariance(problem)))
    free = [int(i) for i in trial.fit.free]
    for k, (choice, scale) in sorted(trial.slots.held.items()):
        amount, *shape = trial.slots.own(k)
        constants = {}
        if choice.shape:
            nominal, _, unit, *_ = CONSTANTS[choice.shape]
            constants[choice.shape] = float(nominal * problem.coordinates[shape[0]].value(trial.fit.u[shape[0]])), unit
        t = choice.term
        parts.append(
            Part(
                t.port,
                t.target,
                t.formula,
                t.latex,
                float(scale * trial.fit.u[amount]),
                float(scale * root[free.index(amount)]),
                t.unit,
                constants,
            )
        )
    suggestion = _suggestion(
        parts,
        base.chi2 - trial.fit.chi2,
        (trial.gain, trial.gain_se),
        errors(problem, trial.fit),
        trial.at_noise,
        trial.length,
    )
    return suggestion, tuple(c.term for _, (c, _) in sorted(trial.slots.held.items()))


def sensor_kinds(logs: Sequence[Log]) -> list[str]:
    """Kinds of measured channels: their names without corners."""
    return list(dict.fromkeys(channel_kind(c) for log in logs for c in log.channel_names if not is_command(c)))
