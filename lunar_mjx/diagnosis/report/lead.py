"""What a report says first: a badge, one plain sentence, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from lunar_mjx.diagnosis.report.read import Result
from lunar_mjx.diagnosis.report.words import SURE, and_list
from lunar_mjx.diagnosis.runs import COMPARISON_FILE, FITTED_FILE, MODEL_FILE
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.report.page import Lead

INSTRUMENT = "calibration: "
"""Begins what a verdict calls an instrument that errs: no effect, so that `add` does not take it."""
_TONES = {
    "NOISE_ONLY": ("nothing missing", "good"),
    "KNOWN": ("effect named", "good"),
    "MULTIPLE": ("effects named", "good"),
    "KNOWN_CLASS": ("still ambiguous", "open"),
    "UNKNOWN": ("unknown effect", "open"),
    "UNDECIDABLE": ("cannot be decided", "open"),
    "BAD_FIT": ("fit not trusted", "bad"),
    "BAD_DATA": ("logs not usable", "bad"),
}
"""Words and tone of the badge of each verdict."""


def lead(results: Sequence[Result], judge: Result) -> Lead:
    """Badge, sentence and next steps for a chain of runs, of which `judge` is the last one diagnosed."""
    last, added = results[-1], list(results[-1].run.get("added") or [])
    if not judge.verdict:
        return Lead(
            "not diagnosed",
            "open",
            "The model has been compared with the logs. Nobody has asked yet why it fails.",
            [f"lunar-mjx why {_typed(last.path)}"],
        )
    name = str(judge.verdict.get("verdict"))
    named = [str(e) for e in judge.verdict.get("effects") or []]
    badge, tone = _TONES.get(name, (name, "open"))
    sentence = _sentence(name, named, str(judge.verdict.get("port") or ""), added)
    steps = _next(name, named, judge)
    # The verdict is on an earlier model: its badge must not stand over one that nobody has judged.
    if judge is not last:
        new = [e for e in added if e not in (judge.run.get("added") or [])]
        now = f"The model now has {_and(new)}." if new else "The model was compared again."
        sentence = f"{now} Nobody has asked yet what it still lacks; the findings below are those on {judge.name}."
        badge, tone, steps = "not diagnosed", "open", [f"lunar-mjx why {_typed(last.path)}"]
    return Lead(badge, tone, sentence, steps)


def _sentence(name: str, named: Sequence[str], port: str, added: Sequence[str]) -> str:
    acts = f" It acts at {port}, a step of the model (a port)." if port else ""
    since = f" now that it has {_and(added)}" if added else ""
    return {
        "NOISE_ONLY": f"The model explains these measurements down to their noise{since}.",
        "KNOWN": f"The model lacks one effect, and it can be named: {_and(named)}.",
        "MULTIPLE": f"The model lacks several effects: {_and(named)}.",
        "KNOWN_CLASS": f"The model lacks one of {_or(named)}; these measurements cannot tell them apart."
        if len(named) > 1
        else f"The model lacks {_and(named)}, or something that is on no list.",
        "UNKNOWN": f"The model lacks something that no effect of the catalogue explains.{acts}",
        "UNDECIDABLE": "Nothing can be named from these measurements so far.",
        "BAD_FIT": "The fit of the model did not converge, so nothing is said about physics.",
        "BAD_DATA": "The logs contradict themselves, so nothing is said about physics.",
    }.get(name, "")


def _next(name: str, named: Sequence[str], judge: Result) -> list[str]:
    run = _typed(judge.path)
    log = _typed(next(iter(judge.run.get("logs") or ["LOG"])))
    return {
        "NOISE_ONLY": [
            _using(judge.path),
            "Test it on a manoeuvre that no fit has seen; that is where the next missing effect shows.",
        ],
        "KNOWN": _adding(judge, [*_law(judge), *named]),
        "MULTIPLE": _adding(judge, [*_law(judge), *named]),
        "KNOWN_CLASS": [
            f"lunar-mjx next {run}  (names the manoeuvre that tells them apart)",
            "Drive that manoeuvre, and compare with its log too.",
        ],
        "UNKNOWN": _unlisted(judge),
        "UNDECIDABLE": [
            f"lunar-mjx next {run}  (names the manoeuvre that would show it)"
            if _searched(judge)
            else f"lunar-mjx why {run}  (without --seconds: its search ended before it was done)"
        ],
        "BAD_FIT": ["The sentence above says what failed: look at the log and the model there, and compare again."],
        "BAD_DATA": ["Mend what the findings below name.", f"lunar-mjx log check {log}"],
    }.get(name, [])


def _unlisted(judge: Result) -> list[str]:
    """What is unlisted is sought under the contact law that explains the measurements, where that is another one."""
    adding = _adding(judge, _law(judge))
    where = adding[-1].rpartition(" ")[2] if adding else _typed(judge.path)
    when = "if that is unknown, too: " if adding else ""
    return [*adding, f"lunar-mjx unknown {where}  ({when}suggests a formula, as a ready effect file)"]


def _using(run: Path) -> str:
    """How to drive the model that explains everything; `model.toml` is what was compared, before any refit."""
    if (run / FITTED_FILE).is_file():
        return f"Use the fitted model: lunar-mjx simulate --model {_typed(run / FITTED_FILE)}"
    command = f"lunar-mjx simulate --model {_typed(run / MODEL_FILE)}"
    return f"Use the model as it was compared: {command}  (its parameters as refitted are in {COMPARISON_FILE})"


def _searched(judge: Result) -> bool:
    """Whether the search for effects ended by itself, not by its time."""
    search = ((judge.verdict or {}).get("details") or {}).get("search") or {}
    return bool(search.get("complete", True))


def _law(judge: Result) -> list[str]:
    """The contact law that explains the measurements better than the model's own, if one surely does."""
    forms = (judge.verdict or {}).get("forms") or {}
    best = max(forms, key=lambda n: float(forms[n]), default="")
    model = judge.model
    present = {*(judge.run.get("added") or []), *((e.name for e in model.effects) if model is not None else ())}
    refused = {r["law"] for r in judge.taken_back}
    return [best] if best in CATALOGUE and best not in present | refused and float(forms[best]) >= SURE else []


def _adding(judge: Result, names: Sequence[str]) -> list[str]:
    """Commands that add effects one after the other, as `add` takes one, and ask again; runs lie beside the first."""
    # A verdict calls the user's own effects by their bare names; to be added they need their file.
    specs = {str(s).rpartition(":")[2]: str(s) for s in judge.run.get("candidates") or []}
    steps, last = [], judge.path
    for name in names:
        if name.startswith(INSTRUMENT):
            steps.append(f"Recalibrate {name.removeprefix(INSTRUMENT)}: it errs by more than is usual.")
            continue
        after = judge.path.parent / f"with_{name}"
        steps.append(f"lunar-mjx add {_typed(last)} {_typed(specs.get(name, name))} -o {_typed(after)}")
        last = after
    return steps if last == judge.path else [*steps, f"lunar-mjx why {_typed(last)}"]


def _typed(word: object) -> str:
    """A word as a shell takes it, blanks and all."""
    return shlex.quote(str(word))


def _and(names: Sequence[str]) -> str:
    return and_list([n.replace("_", " ") for n in names])


def _or(names: Sequence[str]) -> str:
    words = [n.replace("_", " ") for n in names]
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else "".join(words)
