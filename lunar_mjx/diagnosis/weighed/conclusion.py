"""From probabilities of hypotheses to a verdict: a statement that is true with at least 95 per cent."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.inference.weighing.hypotheses import CALIBRATION, EFFECT, UNLISTED, Term
from lunar_mjx.inference.weighing.search import Hypothesis, ModelSearch

LARGEST_CLASS = 5
"""Effects of a class at most: "one of six" is no help to its reader."""
_TOLD = 12
"""Hypotheses whose probabilities are listed."""


@dataclasses.dataclass(frozen=True)
class Conclusion:
    """What a search allows to say.

    Attributes:
      verdict: the statement's kind. effects: that it names, most probable first; instruments as "calibration: NAME".
      unlisted: whether "or something unlisted" belongs to it. port: where, most probably. place: the same with what is
        wrong there, for a reader.
      probability: of the statement. sentence: it in words.
      further: beside `effects`, one of these is missing as well; together with something unlisted where `unlisted`.
      helping: effects that are as sure beside something unlisted; the sentence ends with them (see `helps`).
    """

    verdict: Verdict
    effects: tuple[str, ...]
    unlisted: bool
    port: str | None
    probability: float
    sentence: str
    place: str | None = None
    further: tuple[str, ...] = ()
    helping: tuple[str, ...] = ()


def helps(names: Sequence[str]) -> str:
    """A sentence that effects help beside something unlisted, with a space before it; empty without effects.

    How much of each effect is real, no hypothesis tells.
    """
    return f" Beside it {_list(names)} {'help' if len(names) > 1 else 'helps'}." if names else ""


def conclude(found: ModelSearch, sure: float, largest_class: int = LARGEST_CLASS) -> Conclusion:
    """The strongest statement that has the probability `sure`.

    In this order: something unlisted (UNKNOWN), and beside it the effects that are as sure or help; effects that are
    each sure (KNOWN, MULTIPLE), and beside them the smallest class that holds what is missing as well; nothing beyond
    usual discrepancy (NOISE_ONLY); the smallest class that holds what is missing (KNOWN_CLASS); none of these
    (UNDECIDABLE). Something unlisted comes first: beside what no hypothesis describes, the shares of the described ones
    are not known.
    """
    inclusion = found.inclusion()
    named = [t for t, p in inclusion.items() if p >= sure and t.kind in (EFFECT, CALIBRATION)]
    unlisted = found.probability_of(lambda h: any(t.kind == UNLISTED for t in h.terms))
    port, place = _where(found)
    if unlisted >= sure:
        names = tuple(map(label, named))
        said = _with(f"Something that no listed effect explains acts at {place}", unlisted)
        effects = tuple(dict.fromkeys([*names, *_helpful(found)]))
        said += helps(names)
        return Conclusion(Verdict.UNKNOWN, effects, True, port, unlisted, said, place, helping=names)
    if named:
        # each is sure by itself, and all of them together less so: this is the probability that is told
        p = found.probability_of(lambda h: set(named) <= h.terms)
        names = tuple(map(label, named))
        unnamed = [t for t in inclusion if t not in named]
        further, _ = _smallest(found, unnamed, sure, named, largest_class)
        plural = len(names) > 1
        said = f"{_list(names)} {'are' if plural else 'is'} missing"
        # an instrument is there and wrong, not missing
        if all(t.kind == CALIBRATION for t in named):
            said = f"{_list(names)}: out of order beyond what is usual"
        verdict = Verdict.MULTIPLE if plural else Verdict.KNOWN
        other = _UNLISTED in further
        where = (port, place) if other else (None, None)
        more = tuple(m for m in further if m != _UNLISTED)
        sentence = _with(said, p)
        if further:
            sentence += f" Beside {'them' if plural else 'it'}, {_one_of(further, place)} acts, too."
        return Conclusion(verdict, names, other, where[0], p, sentence, where[1], more)
    no_term = found.probability_of(lambda h: not any(t.kind in (EFFECT, UNLISTED) for t in h.terms))
    if no_term >= sure:
        said = "Nothing is missing beyond usual errors of model, sensors and noise"
        return Conclusion(Verdict.NOISE_ONLY, (), False, None, no_term, _with(said, no_term))
    members, p = _smallest(found, list(inclusion), sure, (), largest_class)
    effects = tuple(m for m in members if m != _UNLISTED)
    if members:
        other = _UNLISTED in members
        said = f"{_one_of(members, place)} acts".capitalize() if other else f"One of {_list(effects)} is missing"
        where = (port, place) if other else (None, None)
        return Conclusion(Verdict.KNOWN_CLASS, effects, other, where[0], p, _with(said, p), where[1])
    said = f"These data do not settle whether anything is missing (nothing: {_percent(no_term)})"
    return Conclusion(Verdict.UNDECIDABLE, (), False, None, 0.0, said + ".")


def label(term: Term) -> str:
    """A term's name for a reader."""
    if term.kind == UNLISTED:
        return f"unlisted at {term.name}"
    return f"calibration: {term.name}" if term.kind == CALIBRATION else term.name


def title(hypothesis: Hypothesis) -> str:
    """A hypothesis in words, whatever its form."""
    order = {EFFECT: 0, UNLISTED: 1, CALIBRATION: 2}
    terms = sorted(hypothesis.terms, key=lambda t: (order[t.kind], t.name))
    return " + ".join(map(label, terms)) or "nothing is missing"


def probabilities(found: ModelSearch) -> dict[str, float]:
    """Probability by hypothesis, forms summed, most probable first; the rest of the list as "others"."""
    total: dict[str, float] = {}
    for h, p in zip(found.hypotheses, found.probability, strict=True):
        total[title(h)] = total.get(title(h), 0.0) + float(p)
    ranked = sorted(total.items(), key=lambda item: -item[1])
    most_probable = dict(ranked[:_TOLD])
    remainder = sum(p for _, p in ranked[_TOLD:])
    return {**most_probable, "others": remainder} if remainder > 0.0 else most_probable


def _where(found: ModelSearch) -> tuple[str | None, str | None]:
    """Port, and name of the term, at which something unlisted most probably acts; the larger of two as sure."""
    names = [t.name for t in found.inclusion() if t.kind == UNLISTED]
    if not names:
        return None, None
    best = found.best
    sizes = {f.name: float(tau) for f, tau in zip(best.refit.linear.fields, best.evidence.tau, strict=True)}

    def sure(holds: Callable[[str], bool]) -> float:
        p = found.probability_of(lambda h: any(t.kind == UNLISTED and holds(t.name) for t in h.terms))
        # probabilities that differ by less than a per cent are taken for equal; then the larger one is told
        return round(p, 2)

    def size(name: str) -> float:
        return sizes.get(name.partition(" with ")[0], 0.0)

    ports = {port_of(n): max(size(m) for m in names if port_of(m) == port_of(n)) for n in names}
    port = max(ports, key=lambda p: (sure(lambda name: port_of(name) == p), ports[p]))
    mine = [n for n in names if port_of(n) == port]
    return port, max(mine, key=lambda n: (sure(lambda name: name == n), size(n)))


def port_of(field: str) -> str:
    """The port of a field such as "soil: stiffness"."""
    return field.partition(":")[0]


def _helpful(found: ModelSearch) -> tuple[str, ...]:
    return tuple(t.name for t, p in found.inclusion().items() if t.kind == EFFECT and p > 0.5)


_UNLISTED = ""
"""Member of a class that stands for something unlisted, wherever it acts."""


def _smallest(
    found: ModelSearch, terms: Sequence[Term], sure: float, named: Sequence[Term], largest_class: int
) -> tuple[list[str], float]:
    """Fewest terms, one by one the most useful, of which the truth holds at least one with probability `sure`.

    Something unlisted counts as one of them, wherever it acts. Hypotheses that lack what is `named` hold no statement
    about what acts beside it. Empty where the class would hold more than `largest_class` names.
    """
    by_label = {_UNLISTED if t.kind == UNLISTED else label(t): t for t in terms}
    members: list[str] = []

    def holds(more: Sequence[str]) -> Callable[[Hypothesis], bool]:
        wanted = {by_label[m] for m in more if m != _UNLISTED}
        return lambda h: (
            set(named) <= h.terms
            and (bool(wanted & h.terms) or (_UNLISTED in more and any(t.kind == UNLISTED for t in h.terms)))
        )

    p = 0.0
    # greedy: the smallest cover is hard to find, and a name too many costs the reader little
    while p < sure and len([m for m in members if m != _UNLISTED]) < largest_class:
        # jointly, not from the terms' own probabilities: hypotheses that hold both must not count twice
        gains = {t: found.probability_of(holds([*members, t])) for t in by_label if t not in members}
        best = max(gains, key=lambda t: gains[t], default=None)
        # nothing more helps: the rest of the probability lies with hypotheses without any of these
        if best is None or gains[best] <= p:
            break
        members.append(best)
        p = gains[best]
    return (members, p) if p >= sure else ([], p)


def _one_of(members: Sequence[str], place: str | None) -> str:
    names = [m for m in members if m != _UNLISTED] + (
        [f"something unlisted at {place}"] if _UNLISTED in members else []
    )
    return names[0] if len(names) == 1 else f"one of {_list(names)}"


def _list(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _percent(p: float) -> str:
    return f"{100.0 * p:.0f} %" if p < 0.99 else "more than 99 %"


def _with(said: str, p: float) -> str:
    return f"{said} (probability {_percent(p)})."
