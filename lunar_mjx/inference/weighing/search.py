"""One search over one list of hypotheses: sets of terms beside every form of a model, by posterior probability.

Best first: around each refit all neighbours (one term more, one less) are scored in linear approximation; the most
probable set that has not been refitted is refitted next, until no other comes near the best. So every accepted effect
is challenged by a refit without it, and a greedy step that led into a trap is undone. Before something unlisted is
believed, every effect that could be seen is refitted from a place where it acts: where a signature saturates, the
linear estimate at its null is much too low.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from lunar_mjx.inference.deadline import TimeUp
from lunar_mjx.inference.evidence import Evidence, EvidenceError
from lunar_mjx.inference.weighing.hypotheses import EFFECT, UNLISTED, Form, Refit, Term

Terms = frozenset[Term]

LEAST_SIGNAL = 1.0
"""Length in sigma of a signature at its prior size below which no data can speak for or against an effect or an
unlisted input: it is undecidable, and keeps its prior probability without being listed."""
UNLISTED_SHARE = 0.5
"""Probability of something unlisted from which every effect that could be seen is refitted from where it acts: more
probable than not."""


@dataclasses.dataclass(frozen=True, eq=False)
class Hypothesis:
    """A set of terms beside a form, and how probable it is.

    Attributes:
      form: name. terms: beside it.
      log_posterior: log evidence and log prior, up to a constant that all hypotheses share.
      refit: around which the evidence was computed. refitted: whether that refit has the very effects of the set.
      evidence: sizes and posterior. places: columns of the posterior.
    """

    form: str
    terms: Terms
    log_posterior: float
    refit: Refit
    refitted: bool
    evidence: Evidence
    places: np.ndarray

    @property
    def names(self) -> frozenset[str]:
        """Names of the terms."""
        return frozenset(t.name for t in self.terms)

    @property
    def effects(self) -> frozenset[str]:
        """Names of the terms that are effects."""
        return frozenset(t.name for t in self.terms if t.kind == EFFECT)


@dataclasses.dataclass(frozen=True, eq=False)
class ModelSearch:
    """What a search found.

    Attributes:
      hypotheses: all that were evaluated, most probable first. probability: of each, together 1.
      refits: made. failed: "form with effects: reason" of each refit whose solver failed.
      complete: whether no hypothesis near the best was left without a refit.
    """

    hypotheses: tuple[Hypothesis, ...]
    probability: np.ndarray
    refits: int
    failed: tuple[str, ...]
    complete: bool

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.hypotheses[0]

    def inclusion(self) -> dict[Term, float]:
        """Probability that a term belongs to the truth, by term."""
        found: dict[Term, float] = {}
        for h, p in zip(self.hypotheses, self.probability, strict=True):
            for t in h.terms:
                found[t] = found.get(t, 0.0) + float(p)
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def probability_of(self, holds: Callable[[Hypothesis], bool]) -> float:
        """Probability of a statement about the hypotheses."""
        return float(sum(p for h, p in zip(self.hypotheses, self.probability, strict=True) if holds(h)))

    def forms(self) -> dict[str, float]:
        """Probability of each form."""
        names = dict.fromkeys(h.form for h in self.hypotheses)
        return {n: self.probability_of(lambda h, n=n: h.form == n) for n in names}

    def base(self, form: str) -> Hypothesis:
        """The hypothesis that nothing is missing beside a form."""
        return next(h for h in self.hypotheses if h.form == form and not h.terms)


def search(
    forms: Sequence[Form],
    most_refits: int,
    most_terms: int,
    window: float,
    progress: Callable[[str, float], None] = lambda text, share: None,
    stop: Callable[[], bool] = lambda: False,
    provisional: Callable[[ModelSearch], None] = lambda found: None,
    least_signal: float = LEAST_SIGNAL,
    unlisted_share: float = UNLISTED_SHARE,
) -> ModelSearch:
    """Looks for the most probable sets of terms.

    Args:
      forms: rival forms of the model, the given one first.
      most_refits: in all. most_terms: of one hypothesis.
      window: log probability below the best from which a hypothesis is not refitted.
      progress: told of every refit. stop: whether to begin no further refit.
      provisional: given what is known after every refit but the first.
      least_signal: see `LEAST_SIGNAL`. unlisted_share: see `UNLISTED_SHARE`.

    Raises:
      EvidenceError: no form could be fitted. TimeUp: before the first one was.
    """
    known: dict[tuple[str, Terms], Hypothesis] = {}
    done: dict[tuple[str, frozenset[str]], Refit | None] = {}
    failed: list[str] = []
    reasons: list[str] = []
    by_name = {form.name: form for form in forms}
    over = False

    def refit(form: Form, effects: frozenset[str], near: Hypothesis | None, trial: str = "") -> None:
        label = form.name + "".join(f" + {e}" for e in sorted(effects))
        progress(f"refitting {label}", len(done) / most_refits)
        start = None if near is None else _start(near, form)
        if trial and start is not None:
            start = form.trial(start, trial)
        try:
            made = form.refit(effects, near.refit if near else None, start)
        except TimeUp:
            if not known:
                raise
            nonlocal over
            over = True
            return
        # A solver that fails says nothing against a hypothesis: it is recorded and the search goes on.
        except (EvidenceError, ValueError, np.linalg.LinAlgError) as error:
            done[form.name, effects] = None
            failed.append(label)
            reasons.append(f"{label}: {error}")
            return
        done[form.name, effects] = made
        if made.failed:
            failed.append(label)
            reasons.append(f"{label}: {made.failed}")
        _score_around(form, made, near, known, done, most_terms, window, least_signal)

    complete = False
    for form in forms:
        refit(form, frozenset(), None)
    if not known:
        raise EvidenceError("; ".join(reasons))
    for form in forms:
        for effect in form.exchanged:
            refit(form, frozenset({effect}), known.get((form.name, frozenset())))

    def ranked(complete: bool) -> ModelSearch:
        # A set whose refit failed is no hypothesis.
        alive = [h for h in known.values() if done.get((h.form, h.effects), h.refit) is not None]
        order = sorted(alive, key=lambda h: -h.log_posterior)
        # relative to the best, for evidences differ by thousands
        weight = np.exp([h.log_posterior - order[0].log_posterior for h in order])
        return ModelSearch(tuple(order), weight / weight.sum(), len(done), tuple(reasons), complete)

    while len(done) < most_refits and not over and not stop():
        # Unlisted inputs are linear and need no refit; effects are not, and gain by theirs. What is unlisted closes the
        # door on no effect before that has been refitted.
        listed = [h for h in known.values() if not any(t.kind == UNLISTED for t in h.terms)]
        best = max(listed, key=lambda h: h.log_posterior)
        near = [h for h in listed if h.log_posterior > best.log_posterior - window]
        open_ = [h for h in near if (h.form, h.effects) not in done]
        # Linear estimates from another form's refit do not exist: what is best beside one is tried beside all, in the
        # order of what it promises there. Else one form's many neighbours would take the refits that tell which it is.
        others = [f for f in forms if best.refitted and (f.name, best.effects) not in done]
        others = [f for f in others if best.effects <= {t.name for t in f.terms}]
        promise = {f.name: _carried_over(listed, best, f.name) for f in others}
        others.sort(key=lambda f: -promise[f.name])
        chosen = max(open_, key=lambda h: h.log_posterior, default=None)
        if chosen is not None and not (others and promise[others[0].name] > chosen.log_posterior):
            refit(by_name[chosen.form], chosen.effects, chosen)
            provisional(ranked(False))
            continue
        if others:
            refit(others[0], best.effects, None)
            continue
        # What leaving an effect out costs is told by a refit: where several do the work of one another, the linear
        # estimate about the full set is much too high, and a set that grew around a wrong first step would stand.
        unchallenged = [e for e in sorted(best.effects) if (best.form, best.effects - {e}) not in done]
        if unchallenged:
            refit(by_name[best.form], best.effects - {unchallenged[0]}, best)
            continue
        untried = _untried(known.values(), best, by_name[best.form], done, least_signal, unlisted_share)
        if not untried:
            complete = True
            break
        refit(by_name[best.form], best.effects | {untried[0]}, best, untried[0])
    return ranked(complete)


def _carried_over(listed: Sequence[Hypothesis], best: Hypothesis, form: str) -> float:
    """Log posterior of the best hypothesis' set beside another form, were its last effects to gain as much there.

    The gain is counted from the largest set of its effects that was refitted beside both forms.
    """
    found: dict[tuple[str, frozenset[str]], float] = {}
    for h in listed:
        if h.refitted and h.effects <= best.effects:
            found[h.form, h.effects] = max(h.log_posterior, found.get((h.form, h.effects), -math.inf))
    common = [e for name, e in found if name == form and (best.form, e) in found]
    if not common:
        return -math.inf
    shared = max(common, key=len)
    return found[form, shared] + best.log_posterior - found[best.form, shared]


def _untried(
    known: Iterable[Hypothesis],
    best: Hypothesis,
    form: Form,
    done: Mapping[tuple[str, frozenset[str]], Refit | None],
    least_signal: float,
    unlisted_share: float,
) -> list[str]:
    """Effects that no refit has tried beside the best listed set, the one with the best linear estimate first.

    Empty where something unlisted is less probable than its share: then what is listed explains the measurements.
    """
    scored = list(known)
    top = max(h.log_posterior for h in scored)
    weights = [(math.exp(h.log_posterior - top), any(t.kind == UNLISTED for t in h.terms)) for h in scored]
    # refits of everything are dear: they are made only where something unlisted would else be believed
    if sum(w for w, other in weights if other) < unlisted_share * sum(w for w, _ in weights):
        return []
    linear = {next(iter(h.effects - best.effects)): h.log_posterior for h in scored if _one_more(h, best)}
    shows = best.refit.linear.shows()
    names = [n for n in shows if n not in best.effects and shows[n] >= least_signal]
    names = [n for n in names if (form.name, best.effects | {n}) not in done]
    return sorted(names, key=lambda n: -linear.get(n, -math.inf))


def _one_more(h: Hypothesis, best: Hypothesis) -> bool:
    """Whether a hypothesis is another with one effect more, and nothing else."""
    more = h.terms - best.terms
    return h.form == best.form and best.terms <= h.terms and len(more) == 1 and len(h.effects) > len(best.effects)


def _start(near: Hypothesis, form: Form) -> np.ndarray:
    """Where a hypothesis scored in linear approximation stands by its own posterior."""
    u = near.refit.u.copy()
    # beyond the coordinates lie the amplitudes of unlisted inputs, which are integrated out and have no place in u
    own = near.places < len(u)
    u[near.places[own]] += near.evidence.mean[own]
    return u


def _score_around(
    form: Form,
    made: Refit,
    near: Hypothesis | None,
    known: dict[tuple[str, Terms], Hypothesis],
    done: dict[tuple[str, frozenset[str]], Refit | None],
    most_terms: int,
    window: float,
    least_signal: float,
) -> None:
    """Scores the refitted set with every choice of terms that need no refit, and their neighbours by one effect."""
    own = frozenset(t for t in form.terms if t.kind == EFFECT and t.name in made.effects)
    felt = made.linear.felt()
    others = [t for t in form.terms if t.kind != EFFECT and (t.kind != UNLISTED or felt[t.name] >= least_signal)]
    shows = made.linear.shows()
    effects = [t for t in form.terms if t.kind == EFFECT and shows[t.name] >= least_signal]
    start = None if near is None else (near.evidence.tau, near.evidence.noise)

    def score(terms: Terms, begin: tuple[np.ndarray, np.ndarray] | None) -> Hypothesis | None:
        refitted = terms.issuperset(own) and not any(t.kind == EFFECT for t in terms - own)
        old = known.get((form.name, terms))
        if len(terms) > most_terms or (old is not None and old.refitted):
            return old
        named = frozenset(t.name for t in terms if t.kind == EFFECT)
        if not refitted and (form.name, named) in done:
            return old
        try:
            value, found, places = made.linear.evidence(terms, begin)
        except (EvidenceError, np.linalg.LinAlgError):
            return old
        # terms are independent beforehand: each has its own odds, and a set the product of theirs
        prior = form.log_prior + sum(t.log_prior for t in terms)
        new = Hypothesis(form.name, terms, value + prior, made, refitted, found, places)
        # Of two linear estimates of one set the one from nearer by counts: that of the more probable refit.
        if old is None or refitted or new.log_posterior > old.log_posterior:
            known[form.name, terms] = new
        return known[form.name, terms]

    base = score(own, start)
    if base is None:
        return
    sizes = (base.evidence.tau, base.evidence.noise)
    roots = [base]
    # Terms without a refit: all single ones, then more beside the best of them.
    level = [h for t in others if (h := score(own | {t}, sizes))]
    best = max([base, *level], key=lambda h: h.log_posterior)
    while level and best is not roots[-1] and len(best.terms) < most_terms:
        roots.append(best)
        level = [h for t in others if t not in best.terms and (h := score(best.terms | {t}, _sizes(best)))]
        best = max([best, *level], key=lambda h: h.log_posterior)
        # What a later term makes needless goes again.
        fewer = [h for t in best.terms - own if (h := score(best.terms - {t}, _sizes(best)))]
        best = max([best, *fewer], key=lambda h: h.log_posterior)
    top = max(h.log_posterior for h in known.values())
    for root in roots:
        # A neighbour of what is hopeless may still be the truth where nothing has been found yet.
        if root is not base and root.log_posterior < top - window:
            continue
        for t in effects:
            if t not in own:
                score(root.terms | {t}, _sizes(root))
        for t in own:
            score(root.terms - {t}, _sizes(root))


def _sizes(h: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    return h.evidence.tau, h.evidence.noise


def log_sum(values: Sequence[float]) -> float:
    """Log of the sum of exponentials."""
    top = max(values)
    return top + math.log(sum(math.exp(v - top) for v in values))
