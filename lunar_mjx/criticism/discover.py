"""Effects that nobody listed: formulas at the failing port, scored through the simulator like catalogue effects."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lunar_mjx.criticism.build_problem import build_problem
from lunar_mjx.criticism.drive_problem import DriveProblem
from lunar_mjx.criticism.fitting import Fit, Memory, Progress, silent
from lunar_mjx.criticism.held_out import errors, gain, noise_test
from lunar_mjx.criticism.problem import Problem
from lunar_mjx.criticism.refit import Candidate, Settings, refit_with
from lunar_mjx.criticism.runs import VERDICT_FILE, Run, load_run
from lunar_mjx.criticism.score import score, signatures
from lunar_mjx.criticism.search import fit_baseline
from lunar_mjx.criticism.table_problem import TableProblem
from lunar_mjx.criticism.terms import Term, effect_of, terms, with_amount
from lunar_mjx.effects.base import PORTS
from lunar_mjx.errors import UserError, bad_input

UNKNOWN_FILE = "unknown.json"
REFITS = 5
"""Best-scored formulas that are refitted."""


@dataclasses.dataclass(frozen=True)
class Suggestion:
    """A formula.

    Attributes:
      port, target, formula: where it acts, on what, and how. amount, std, unit: its fitted amount.
      chi2: reduction of chi-square by the refit. held_out_gain, held_out_se: on manoeuvres left out.
      error: root mean square residual in sigma by split with it. at_noise: whether the residual is at the noise.
    """

    port: str
    target: str
    formula: str
    amount: float
    std: float
    unit: str
    chi2: float
    held_out_gain: float
    held_out_se: float
    error: dict[str, float]
    at_noise: bool


@dataclasses.dataclass(frozen=True)
class Discovery:
    """Suggested formulas, best first.

    Attributes:
      port: that was searched. suggestions: refitted ones. scored: all formulas with their score's chi-square.
      ceiling: chi-square that any smooth input at the port explains; None where `why` has not been asked.
      file: effect file of the best suggestion, or None where none pays on manoeuvres left out.
      error_before: root mean square residual in sigma by split.
    """

    port: str
    suggestions: tuple[Suggestion, ...]
    scored: tuple[tuple[str, float], ...]
    ceiling: float | None
    file: str | None
    error_before: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        return dataclasses.asdict(self)

    def text(self) -> str:
        """A few lines for a terminal."""
        lines = [f"Port {self.port}:"]
        for i, s in enumerate(self.suggestions, 1):
            amount = f"({s.amount:.3g} +- {s.std:.1g} {s.unit})"
            lines.append(f"  {i}. {s.target} += {amount} {s.formula}   chi2 -{s.chi2:.0f}, "
                         f"held-out gain {s.held_out_gain:.0f} +- {s.held_out_se:.0f}"
                         + (", at the noise" if s.at_noise else ""))  # fmt: skip
        if self.ceiling is not None:
            lines.append(f"  any smooth input at this port explains chi2 of at most about {self.ceiling:.0f}")
        if self.file:
            lines.append(f"Effect file: {self.file}; look at it, then: lunar-mjx add RUN {self.file} -o run2")
        else:
            lines.append("No formula pays on manoeuvres left out; none is written.")
        return "\n".join(lines)


def discover(
    folder: str | Path | Run,
    port: str | None = None,
    out: str | Path | None = None,
    settings: Settings | None = None,
    progress: Progress = silent,
) -> Discovery:
    """Suggests formulas for what is missing at a port, and writes the best as an effect file.

    Args:
      folder: of the run. port: where to look; where `why` found the most evidence if None.
      out: effect file to write; `suggested_<port>.py` in the run's folder if None.
      settings: thresholds. progress: told what is being done.

    Raises:
      UserError: no such port, or `why` has not been asked and no port is given.
    """
    run = folder if isinstance(folder, Run) else load_run(folder)
    settings = settings or Settings(seed=run.seed)
    verdict = run.load(VERDICT_FILE) or {}
    place = (verdict.get("details") or {}).get("localise") or {}
    port = port or place.get("port")
    if port is None:
        raise UserError(f"{run.folder}: no port shows anything unknown; run lunar-mjx why first, or give --port.")
    if port not in PORTS:
        raise bad_input("unknown", "port", port, "does not exist", f"use one of {', '.join(PORTS)}")
    logs = run.campaign()
    plain = build_problem(run, logs, [], progress)
    problem, library = with_terms(plain, terms(port, sensor_kinds(plain)), progress)
    base = fit_baseline(problem, settings, Memory(), progress)
    found, scored = suggest(problem, base, library, settings, progress)
    file = None
    best = next((s for s, _, _ in found if s.held_out_gain > s.held_out_se and
                 s.held_out_gain > 0.5 * settings.chi2), None)  # fmt: skip
    if best is not None:
        term = next(t for s, t, _ in found if s is best)
        target = Path(out) if out else run.folder / f"suggested_{port}.py"
        provenance = f"lunar-mjx unknown on {', '.join(p.name for p in run.logs)}"
        target.write_text(with_amount(term, best.amount, f"suggested_{port}", provenance), encoding="utf-8")
        file = str(target)
    ceiling = max((v for k, v in place.get("ceiling", {}).items() if k.partition(":")[0] == port), default=None)
    result = Discovery(port, tuple(s for s, _, _ in found), tuple(scored), ceiling, file, errors(problem, base))
    run.save(UNKNOWN_FILE, result.to_dict())
    return result


def suggest(
    problem: Problem, base: Fit, library: dict[str, Term], settings: Settings, progress: Progress = silent
) -> tuple[list[tuple[Suggestion, Term, Candidate]], list[tuple[str, float]]]:
    """Scores a library of formulas and refits the best.

    Returns:
      Suggestions with their terms and fits, best first; and all formulas with the chi-square of their score.
    """
    scores = score(problem, base, signatures(problem, base, list(library)), settings.draws, settings.seed)
    scored = [(f"{library[s.effect].target}: {library[s.effect].formula}", s.chi2) for s in scores]
    found = []
    for i, s in enumerate(scores[:REFITS]):
        progress("refitting formulas", i / REFITS)
        fitted = refit_with(problem, base, s.effect, settings, Memory())
        value, se = gain(problem, base, fitted)
        noise = noise_test(problem, fitted)
        place = next(i for i in problem.candidates[s.effect] if problem.coordinates[i].amplitude)
        c, k = problem.coordinates[place], list(fitted.free).index(place)
        std = c.std(fitted.u[place], float(fitted.covariance(problem)[k, k]) ** 0.5)
        t = library[s.effect]
        suggestion = Suggestion(t.port, t.target, t.formula, float(c.value(fitted.u[place])), std, t.unit,
                                base.chi2 - fitted.chi2, value, se, errors(problem, fitted), noise.passes)  # fmt: skip
        found.append((suggestion, t, Candidate((s.effect,), fitted, noise, value, se)))
    found.sort(key=lambda row: -row[0].chi2)
    return found, scored


def with_terms(plain: Problem, library: Sequence[Term], progress: Progress) -> tuple[Problem, dict[str, Term]]:
    """The problem with formulas as candidates, and the formulas by the names of their effects."""
    effects = {t.name: effect_of(t) for t in library}
    if isinstance(plain, TableProblem):
        problem: Problem = TableProblem(plain.logs, plain.bed, effects, plain.splits, extra_sigma=plain.extra_sigma)
    else:
        assert isinstance(plain, DriveProblem)
        problem = plain.with_effects(effects, progress)
    return problem, {t.name: t for t in library if t.name in problem.candidates}


def sensor_kinds(problem: Problem) -> list[str]:
    """Kinds of measured channels: their names without corners."""
    corners = ("lf", "rf", "lm", "rm", "lr", "rr")
    kinds = ["_".join(w for w in s.channel.split("_") if w not in corners) for s in problem.observations.series]
    return list(dict.fromkeys(kinds))
