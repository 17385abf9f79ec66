"""Judges an answer: right, missed, or confidently wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from .separable import TELLS

NAMES = ("KNOWN", "KNOWN_CLASS", "MULTIPLE")
"""Verdicts that name an effect."""

Tells = Callable[[str], float]


def outcome(row: Mapping[str, Any], tells: Tells) -> dict[str, Any]:
    """What an answer is worth.

    Args:
      row: group, truth, verdict and named effects of a case.
      tells: sigma by which the data tell the truth from another effect.

    Returns:
      `right`; `outcome` in a word; `wrong_name`: whether something was named that is not there.
    """
    group, verdict, named = row["group"], row["verdict"], set(row["named"])
    hidden = set(row["truth"]["effects"])
    says = verdict in NAMES
    if group == "sabotaged":
        caught = verdict == "BAD_DATA"
        return _is(caught, "caught" if caught else verdict.lower(), says)
    if group == "nulls" or (group == "dirt" and not hidden):
        quiet = verdict == "NOISE_ONLY" or (group == "dirt" and verdict == "UNKNOWN")
        return _is(quiet, "quiet" if quiet else "false alarm" if says or verdict == "UNKNOWN" else "refused", says)
    if group == "undecidable":
        return _undecidable(row, hidden, named, says)
    if group == "outside":
        return _outside(verdict)
    if group in ("pairs", "triples"):
        return _several(verdict, hidden, named)
    return _single(group, verdict, hidden, named, tells)


def _is(right: bool, word: str, wrong_name: bool = False) -> dict[str, Any]:
    return {"right": right, "outcome": word, "wrong_name": wrong_name}


def _single(group: str, verdict: str, hidden: set[str], named: set[str], tells: Tells) -> dict[str, Any]:
    if verdict == "KNOWN" and named == hidden:
        return _is(True, "named")
    if verdict == "KNOWN_CLASS" and hidden <= named:
        smallest = all(tells(n) < TELLS for n in named - hidden)
        return _is(smallest, "class" if smallest else "class too wide")
    if verdict in NAMES:
        return _is(False, "named with others" if hidden <= named else "wrong name", True)
    faded = group == "dirt" and verdict in ("NOISE_ONLY", "UNKNOWN")
    return _is(faded, verdict.lower())


def _several(verdict: str, hidden: set[str], named: set[str]) -> dict[str, Any]:
    if verdict in NAMES and named == hidden:
        return _is(True, "all named")
    wrong = verdict in NAMES and bool(named - hidden) and verdict != "KNOWN_CLASS"
    if verdict in NAMES:
        return _is(False, "others named" if named - hidden else "some named", wrong)
    return _is(False, verdict.lower())


def _outside(verdict: str) -> dict[str, Any]:
    if verdict in ("UNKNOWN", "KNOWN_CLASS"):
        return _is(True, verdict.lower())
    return _is(False, "wrong name" if verdict in NAMES else verdict.lower(), verdict in NAMES)


def _undecidable(row: Mapping[str, Any], hidden: set[str], named: set[str], says: bool) -> dict[str, Any]:
    """A refit absorbs the effect: nothing is missing, and the effect counts among those that cannot be decided."""
    verdict = row["verdict"]
    if verdict == "NOISE_ONLY" and row.get("explained") == "UNDECIDABLE":
        return _is(True, "undecidable")
    if verdict == "KNOWN_CLASS" and hidden <= named:
        return _is(True, "class")
    return _is(False, "called absent" if verdict == "NOISE_ONLY" else verdict.lower(), says and not hidden <= named)
