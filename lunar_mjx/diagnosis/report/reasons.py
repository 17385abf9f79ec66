"""Why it is this effect, and why it is not that one, in plain sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lunar_mjx.diagnosis.report.words import SURE, and_list, percent, shown

ALIKE = 0.9
"""|cos| between two traces from which a reader is told that they look alike; the report's isolability says the same."""


def reason(
    evidence: Mapping[str, Any], named: list[str], errors: Mapping[str, float], before: float | None, measure: str
) -> str:
    """What the measurements say for or against one effect.

    Args:
      evidence: its entry of `verdict.json`.
      named: effects that the verdict names.
      errors: error in sigma that is left with an effect or with all the named ones ("" for these), where known.
      before: error of the model as it is. measure: on which manoeuvres these errors are, such as "held-out".
    """
    name, status = str(evidence.get("effect")), str(evidence.get("status"))
    shows = _number(evidence.get("separable_sigma"))
    if status == "not tested":
        but = f" but {shown(shows, 2)} sigma" if shows else ""
        return f"These measurements cannot tell: at its usual size, a refit of the model makes up for all{but} of it."
    sentences = []
    probability = _number(evidence.get("probability"))
    if name in named:
        sentences.append("This is what the measurements ask for.")
        # Of several named effects the verdict claims that they act together: one alone may leave the error as it is.
        own = errors.get("" if len(named) > 1 else name, errors.get(name))
        if own is not None and before is not None:
            with_others = (
                f" together with {and_list([_plain(n) for n in named if n != name])}" if len(named) > 1 else ""
            )
            sentences.append(
                f"With it{with_others} the {measure} error falls from {shown(before)} to {shown(own)} sigma."
            )
        return " ".join([*sentences, *_probable(probability)])
    if shows:
        sentences.append(
            f"At its usual size it would change all these measurements together by {shown(shows, 2)} sigma."
        )
    if name in errors and before is not None:
        left = errors[name]
        # One parameter more lessens any fitted error a little, by noise alone: two per cent are no fall.
        falls = left < 0.98 * before
        tail = f"leaves {shown(left)} of {shown(before)} sigma" if falls else "does not make the error smaller"
        best = errors.get("") if "" in errors else errors.get(named[0]) if named else None
        if best is not None and best < left:
            tail += f", where {and_list([_plain(n) for n in named])} leaves {shown(best)}"
        sentences.append(f"Adding it alone {tail} ({measure} error).")
    near, cosine = _nearest(evidence)
    if near and cosine >= ALIKE:
        more = (
            "which the measurements ask for"
            if near in named
            else "which they do not ask for either"
            if named
            else "so these measurements cannot tell the two apart"
        )
        sentences.append(
            f"What it changes looks like what {_plain(near)} changes (alike to {cosine:.2f} of 1), {more}."
        )
    note = str(evidence.get("reason") or "")
    if probability is None and note:
        # A run folder that was received may hold a note of any length.
        sentences.append(f"The diagnosis notes: {note[:200]}.")
    return " ".join([*sentences, *_probable(probability)])


def _probable(probability: float | None) -> list[str]:
    if probability is None:
        return []
    if probability >= SURE:
        return [f"Its probability is {percent(probability)}."]
    limit = f"{100.0 * (1.0 - SURE):.0f} %"
    words = f"too much to rule it out (below {limit})" if probability > 1.0 - SURE else "so it is ruled out"
    return [f"Its probability is {percent(probability)}, {words}."]


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _number(value: Any) -> float | None:
    """A finite number, or None for whatever else a file may hold."""
    known = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < float("inf")
    return float(value) if known else None


def _nearest(evidence: Mapping[str, Any]) -> tuple[str, float]:
    pair = evidence.get("nearest")
    if isinstance(pair, list | tuple) and len(pair) == 2 and (cosine := _number(pair[1])) is not None:
        return str(pair[0]), cosine
    return "", 0.0
