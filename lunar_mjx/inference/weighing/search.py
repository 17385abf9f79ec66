"""One search over one list of hypotheses: sets of terms beside every form of a model, by posterior probability.

Best first: around each refit all neighbours (one term more, one less) are scored in linear approximation; the most
probable set that has not been refitted is refitted next, until no other comes near the best. So every accepted effect
is challenged by a refit without it, from where the refit with it has ended, as soon as it leads, and a greedy step that
led into a trap is undone: a descent that found a better optimum on its way must not be taken for what the effect is
worth.

What an effect promises is believed in the share that its refits have kept. Else some larger set, of which there are
always more than refits, would stand in front of those that were refitted by a promise that has been broken already.

Where a form can see what effects gain, by a few steps of each, the first of these are refitted before all others.

Before something unlisted is believed, every effect that could be seen is refitted from a place where it acts: where a
signature saturates, the linear estimate at its null is much too low. First, and before any set that a linear estimate
promises, come those most like what is unlisted: about a refit without it, an effect that parameters and unlisted inputs
have stood in for promises nothing.
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

FIRST_SEEN = 3
"""Effects beside one set that are refitted since they have been seen to gain, before what linear estimates promise."""
LEAST_SIGNAL = 1.0
"""Length in sigma of a signature at its prior size below which no data can speak for or against an effect or an
unlisted input: it is undecidable, and keeps its prior probability without being listed."""
FIRST_ALIKE = 2
"""Effects most like what is unlisted that are refitted beside one set before what else is promised: several are alike
at one port."""
UNLISTED_SHARE = 0.5
"""Probability of something unlisted from which every effect that could be seen is refitted from where it acts: more
probable than not."""


@dataclasses.dataclass(frozen=True)
class Promise:
    """What an effect adds to a set of terms by the linear model around a refit without it.

    Attributes:
      effect: its name. beside: log posterior of the set without the gain, the effect's odds counted.
      gain: nats of evidence.
    """

    effect: str
    beside: float
    gain: float

    def believed(self, share: float) -> float:
        """Log posterior if no more than a share of the gain is kept; a loss counts in full."""
        return self.beside + (share * self.gain if self.gain > 0.0 else self.gain)


@dataclasses.dataclass(frozen=True, eq=False)
class Hypothesis:
    """A set of terms beside a form, and how probable it is.

    Attributes:
      form: name. terms: beside it.
      log_posterior: log evidence and log prior, up to a constant that all hypotheses share.
      refit: around which the evidence was computed. refitted: whether that refit has the very effects of the set.
      evidence: sizes and posterior. places: columns of the posterior.
      promise: what one effect adds by a linear estimate; None for sets without such a one.
    """

    form: str
    terms: Terms
    log_posterior: float
    refit: Refit
    refitted: bool
    evidence: Evidence
    places: np.ndarray
    promise: Promise | None = None

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
      unchallenged: effects of the best refit without which none was made from where that had ended.
      waiting: effects that were seen to gain beside some refit, and that none has tried there.
      unseen: whether it was not looked at what effects gain beside the best refit.
    """

    hypotheses: tuple[Hypothesis, ...]
    probability: np.ndarray
    refits: int
    failed: tuple[str, ...]
    complete: bool
    unchallenged: frozenset[str] = frozenset()
    waiting: frozenset[str] = frozenset()
    unseen: bool = False

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.hypotheses[0]

    def inclusion(self) -> dict[Term, float]:
        """Probability that a term belongs to the truth, by term."""
        by_term: dict[Term, float] = {}
        for h, p in zip(self.hypotheses, self.probability, strict=True):
            for t in h.terms:
                by_term[t] = by_term.get(t, 0.0) + float(p)
        return dict(sorted(by_term.items(), key=lambda item: -item[1]))

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
    most_scored: float = math.inf,
) -> ModelSearch:
    """Looks for the most probable sets of terms.

    Args:
      forms: rival forms of the model, the given one first.
      most_refits: in all. most_terms: of one hypothesis.
      window: log probability below the best from which a hypothesis is not refitted.
      progress: told of every refit. stop: whether to begin no further refit.
      provisional: given what is known after every refit but the first.
      least_signal: see `LEAST_SIGNAL`. unlisted_share: see `UNLISTED_SHARE`.
      most_scored: effects beside a set that are scored with sizes of their own; the others are less probable by far.

    Raises:
      EvidenceError: no form could be fitted. TimeUp: before the first one was.
    """
    under_way = _Search(forms, most_refits, most_terms, window, least_signal, unlisted_share, most_scored, progress)
    under_way.begin()
    complete = False
    while not complete and under_way.may_refit and not stop():
        complete = not under_way.go_on(provisional)
    return under_way.ranked(complete)


@dataclasses.dataclass(eq=False)
class _Search:
    """A search under way: what is asked of it, and what it knows.

    Attributes:
      forms, most_refits, most_terms, window, least_signal, unlisted_share, most_scored, progress: as for `search`.
      known: the best evidence of each set of terms beside each form.
      done: the best refit by form and effects; None where the solver failed.
      refits: number made. begun: form, effects, and effects of the refit at whose end it began, of each.
      reasons: "form with effects: reason" of each refit whose solver failed.
      record: nats that refits of each effect beside a form have been promised, and how many of these they kept.
      asked: form and effects of sets beside which a doubted effect was refitted.
      over: whether time was up within a refit.
      seen: what `Form.promising` told of effects beside a refitted set, by form and effects.
      looked_alike: number of effects asked for as most like what is unlisted beside a set, by form and effects.
    """

    forms: Sequence[Form]
    most_refits: int
    most_terms: int
    window: float
    least_signal: float
    unlisted_share: float
    most_scored: float
    progress: Callable[[str, float], None]
    known: dict[tuple[str, Terms], Hypothesis] = dataclasses.field(default_factory=dict)
    done: dict[tuple[str, frozenset[str]], Refit | None] = dataclasses.field(default_factory=dict)
    refits: int = 0
    begun: set[tuple[str, frozenset[str], frozenset[str]]] = dataclasses.field(default_factory=set)
    reasons: list[str] = dataclasses.field(default_factory=list)
    record: dict[tuple[str, str], tuple[float, float]] = dataclasses.field(default_factory=dict)
    asked: set[tuple[str, frozenset[str]]] = dataclasses.field(default_factory=set)
    over: bool = False
    seen: dict[tuple[str, frozenset[str]], Mapping[str, float]] = dataclasses.field(default_factory=dict)
    looked_alike: dict[tuple[str, frozenset[str]], int] = dataclasses.field(default_factory=dict)

    @property
    def may_refit(self) -> bool:
        """Whether refits and time are left."""
        return self.refits < self.most_refits and not self.over

    def begin(self) -> None:
        """Refits every form that is not late as it is, then with each effect that takes the place of a part of it.

        Raises:
          EvidenceError: no form could be fitted. TimeUp: before the first one was.
        """
        for form in self.forms:
            if not form.late:
                self.refit(form, frozenset(), None)
        if not self.known:
            raise EvidenceError("; ".join(self.reasons))
        for form in self.forms:
            for effect in form.exchanged:
                self.refit(form, frozenset({effect}), self.known.get((form.name, frozenset())))

    def go_on(self, provisional: Callable[[ModelSearch], None]) -> bool:
        """Makes the refit that promises most; false where none is left that could change the answer."""
        by_name = {form.name: form for form in self.forms}
        late = [f for f in self.forms if f.late and (f.name, frozenset()) not in self.done]
        # A form that has to explain what another one lacks is asked before the first name: beside a law that is a
        # little wrong everywhere, some set of effects always looks like what it lacks.
        if late and max(self.known.values(), key=lambda h: h.log_posterior).terms:
            self.refit(late[0], frozenset(), None)
            return True
        # Unlisted inputs are linear and need no refit; effects are not, and gain by theirs. What is unlisted closes the
        # door on no effect before that has been refitted.
        listed = [h for h in self.known.values() if not any(t.kind == UNLISTED for t in h.terms)]
        best = max(listed, key=lambda h: h.log_posterior)
        leads = max((h for h in listed if h.refitted), key=lambda h: h.log_posterior)
        # All that was seen to gain beside one set comes before what follows from the first of them.
        if self.refit_seen(by_name[leads.form], provisional):
            return True
        # Before anything else beside a new name, the set without it from there: it may have found a better optimum.
        doubtful = [leads.effects - {e} for e in sorted(leads.effects - self.challenged(leads.form))]
        if doubtful:
            self.refit(by_name[leads.form], doubtful[0], leads)
            provisional(self.ranked(False))
            return True
        if (leads.form, leads.effects) not in self.seen:
            try:
                self.look(by_name[leads.form], leads)
            except TimeUp:
                self.over = True
                return True
            if self.refit_seen(by_name[leads.form], provisional):
                return True
        # What was seen to gain nothing beside the best set needs no refit to be told so.
        alike = [] if self.seen[leads.form, leads.effects] else self.alike(leads)
        if alike:
            self.looked_alike[leads.form, leads.effects] = self.looked_alike.get((leads.form, leads.effects), 0) + 1
            form, wanted = by_name[leads.form], leads.effects | {alike[0]}
            estimate = self.known.get((form.name, form.listed(wanted)))
            # An estimate that promises something is a better start than a place where the effect just acts.
            if estimate is not None and estimate.promise is not None and estimate.promise.gain > 0.0:
                self.refit(form, wanted, estimate)
            else:
                self.refit(form, wanted, leads, alike[0])
            provisional(self.ranked(False))
            return True
        # What is unlisted needs no refit, the effects beside it do: else an estimate without one could lead for good.
        alive = [h for h in self.known.values() if self.done.get((h.form, h.effects), h.refit) is not None]
        top = max(h.log_posterior for h in alive)
        near = [h for h in listed if h.log_posterior > best.log_posterior - self.window]
        near += [h for h in alive if h.log_posterior > top - self.window]
        open_ = [h for h in near if (h.form, h.effects) not in self.done]
        # Linear estimates from another form's refit do not exist: what is best beside one is tried beside all, in the
        # order of what it promises there. Else one form's many neighbours would take the refits that tell which it is.
        other_forms = [f for f in self.forms if best.refitted and (f.name, best.effects) not in self.done]
        # nor beside one that has not been refitted as it is, or could not be
        other_forms = [f for f in other_forms if self.done.get((f.name, frozenset())) is not None]
        other_forms = [f for f in other_forms if best.effects <= {t.name for t in f.terms}]
        promise = {f.name: _carried_over(listed, best, f.name) for f in other_forms}
        other_forms.sort(key=lambda f: -promise[f.name])
        chosen = max(open_, key=lambda h: h.log_posterior, default=None)
        if chosen is not None and not (other_forms and promise[other_forms[0].name] > chosen.log_posterior):
            self.refit(by_name[chosen.form], chosen.effects, chosen)
            provisional(self.ranked(False))
            return True
        if other_forms:
            self.refit(other_forms[0], best.effects, None)
            return True
        # What leaving an effect out costs is told by a refit: where several do the work of one another, the linear
        # estimate about the full set is much too high, and a set that grew around a wrong first step would stand.
        rivals = [best.effects - {e} for e in sorted(best.effects)]
        rivals = [r for r in rivals if (best.form, r, best.effects) not in self.begun]
        if rivals:
            self.refit(by_name[best.form], rivals[0], best)
            return True
        doubted = self.doubted(best)
        if doubted is not None:
            self.asked.add((best.form, best.effects))
            self.refit(by_name[best.form], doubted.effects, doubted)
            return True
        untried = self.untried(best)
        if untried:
            self.refit(by_name[best.form], best.effects | {untried[0]}, best, untried[0])
        return bool(untried)

    def refit(self, form: Form, effects: frozenset[str], near: Hypothesis | None, trial: str = "") -> None:
        """Refits a form with a set of effects, and scores the hypotheses around it.

        Args:
          form, effects: what is refitted. near: hypothesis to begin at; the model as given if None.
          trial: effect that begins where it acts, for one whose slope at its null says little.
        """
        label = form.name + "".join(f" + {e}" for e in sorted(effects))
        self.progress(f"refitting {label}", self.refits / self.most_refits)
        start, key = None, (form.name, effects)
        if near is not None:
            start = _start(near)
            self.begun.add((*key, near.refit.effects))
        if trial and start is not None:
            start = form.trial(start, trial)
        try:
            made = form.refit(effects, near.refit if near else None, start)
        except TimeUp:
            if not self.known:
                raise
            self.over = True
            if near is not None:
                self.begun.discard((*key, near.refit.effects))  # what was begun and not ended challenges nothing
            return
        # A solver that fails says nothing against a hypothesis: it is recorded and the search goes on.
        except (EvidenceError, ValueError, np.linalg.LinAlgError) as error:
            self.refits += 1
            self.done.setdefault(key, None)
            self.reasons.append(f"{label}: {error}")
            return
        self.refits += 1
        if made.failed:
            self.reasons.append(f"{label}: {made.failed}")
        listed = form.listed(effects)
        estimated = self.known.get((form.name, listed))
        if self.score_around(form, made, near):
            self.done[key] = made
            # Estimates from elsewhere of what is unlisted beside these effects give way to what their own refit says.
            for h in [h for h in self.known.values() if (h.form, h.effects) == key and not h.refitted]:
                del self.known[h.form, h.terms]
                self.score(form, made, listed, h.terms, _sizes(h))
            if estimated is not None and estimated.promise is not None and not made.failed:
                self.hold(estimated.promise, self.known[form.name, listed])
        elif key not in self.done:
            # A refit around which nothing can be said is a failed one; the set would else be refitted for ever.
            self.done[key] = None
            self.reasons.append(f"{label}: no evidence around its refit")

    def challenged(self, form: str) -> frozenset[str]:
        """Effects beside a form without which some set was refitted from where the one with them had ended."""
        return frozenset(e for name, less, more in self.begun if name == form and less < more for e in more - less)

    def hold(self, promise: Promise, reached: Hypothesis) -> None:
        """Holds a promise against what its refit has reached, and all others of the same effect with it."""
        if promise.gain <= 0.0:
            return
        key = reached.form, promise.effect
        promised, kept = self.record.get(key, (0.0, 0.0))
        gain = min(max(reached.log_posterior - promise.beside, 0.0), promise.gain)
        self.record[key] = promised + promise.gain, kept + gain
        for place, h in self.known.items():
            if h.form == reached.form and h.promise is not None and h.promise.effect == promise.effect:
                self.known[place] = self.believed(h)

    def believed(self, h: Hypothesis) -> Hypothesis:
        """A linear estimate as far as refits of its effect have kept what others like it had promised."""
        if h.promise is None or (h.form, h.promise.effect) not in self.record:
            return h
        promised, kept = self.record[h.form, h.promise.effect]
        return dataclasses.replace(h, log_posterior=h.promise.believed(kept / promised))

    def doubted(self, best: Hypothesis) -> Hypothesis | None:
        """The set with one effect more that would come near the best one if its promise were kept in full.

        Refits of that effect beside other sets have broken their promises, which says little of this one: it may do
        nothing by itself, and much beside what the best set has. It is asked once about each set.
        """
        if (best.form, best.effects) in self.asked:
            return None
        found = [
            (h.promise.believed(1.0), h)
            for h in self.known.values()
            if h.promise is not None and _one_more(h, best) and (h.form, h.effects) not in self.done
        ]
        promised, h = max(found, key=lambda pair: pair[0], default=(-math.inf, None))
        return h if promised > best.log_posterior - self.window else None

    def ranked(self, complete: bool) -> ModelSearch:
        """What is known, most probable first."""
        # A set whose refit failed is no hypothesis.
        alive = [h for h in self.known.values() if self.done.get((h.form, h.effects), h.refit) is not None]
        order = sorted(alive, key=lambda h: -h.log_posterior)
        # relative to the best, for evidences differ by thousands
        weight = np.exp([h.log_posterior - order[0].log_posterior for h in order])
        leads = next((h for h in order if h.refitted), None)
        by_name = {form.name: form for form in self.forms}
        waiting = [self.gaining(by_name[name], beside, gains) for (name, beside), gains in self.seen.items()]
        return ModelSearch(
            tuple(order),
            weight / weight.sum(),
            self.refits,
            tuple(self.reasons),
            complete,
            unchallenged=leads.effects - self.challenged(leads.form) if leads else frozenset(),
            waiting=frozenset().union(*waiting),
            unseen=leads is not None and (leads.form, leads.effects) not in self.seen,
        )

    def untried(self, best: Hypothesis) -> list[str]:
        """Effects that no refit has tried beside the best listed set, the one with the best linear estimate first.

        Empty where something unlisted is less probable than its share: then what is listed explains the measurements.
        Empty, too, where one effect more would be too many.
        """
        if not self.may_be_unlisted(best):
            return []
        scored = self.known.values()
        linear = {next(iter(h.effects - best.effects)): h.log_posterior for h in scored if _one_more(h, best)}
        return sorted(self.not_refitted(best), key=lambda n: -linear.get(n, -math.inf))

    def look(self, form: Form, leads: Hypothesis) -> None:
        """Takes down what each effect is seen to gain beside a refitted set.

        Raises:
          TimeUp: before that was known.
        """
        try:
            gains = form.promising(leads.refit) if len(leads.terms) < self.most_terms else {}
        except EvidenceError:
            gains = {}
        self.seen[form.name, leads.effects] = gains

    def refit_seen(self, form: Form, provisional: Callable[[ModelSearch], None]) -> bool:
        """Refits the next effect that has been seen to gain, beside that set; whether there was one."""
        for (name, effects), gains in self.seen.items():
            wanted = self.gaining(form, effects, gains) if name == form.name else []
            beside = self.known.get((form.name, form.listed(effects)))
            if wanted and beside is not None:
                self.refit(form, effects | {wanted[0]}, beside, wanted[0])
                provisional(self.ranked(False))
                return True
        return False

    def gaining(self, form: Form, effects: frozenset[str], gains: Mapping[str, float]) -> list[str]:
        """Of the first effects that have been seen to gain beside a set those that no refit has tried, most first.

        Those count that have gained more than their odds ask for: they are already more probable than not.
        """
        odds = {t.name: t.log_prior for t in form.terms if t.kind == EFFECT}
        first = sorted((e for e in gains if gains[e] + odds[e] > 0.0), key=lambda e: -gains[e])[:FIRST_SEEN]
        return [e for e in first if (form.name, effects | {e}) not in self.done]

    def alike(self, leads: Hypothesis) -> list[str]:
        """Effects that no refit has tried beside a refitted set, the one most like what is unlisted there first.

        Empty as for `untried`, and where `FIRST_ALIKE` have been asked for.
        """
        unlisted = [
            h
            for h in self.known.values()
            if h.form == leads.form and h.effects == leads.effects and any(t.kind == UNLISTED for t in h.terms)
        ]
        enough = self.looked_alike.get((leads.form, leads.effects), 0) >= FIRST_ALIKE
        if enough or not unlisted or not self.may_be_unlisted(leads):
            return []
        most = max(unlisted, key=lambda h: h.log_posterior)
        names = [t.name for t in most.terms if t.kind == UNLISTED]
        linear = most.refit.linear
        shares = [linear.alike(most.evidence, most.places, name) for name in names]
        share = {n: max(s[n] for s in shares) for n in self.not_refitted(leads)}
        return sorted((n for n in share if share[n] > 0.0), key=lambda n: -share[n])

    def may_be_unlisted(self, best: Hypothesis) -> bool:
        """Whether something unlisted would be believed by what is known, and one effect more is not too many."""
        if len(best.effects) >= self.most_terms:
            return False
        top = max(h.log_posterior for h in self.known.values())
        weights = [
            (math.exp(h.log_posterior - top), any(t.kind == UNLISTED for t in h.terms)) for h in self.known.values()
        ]
        # refits of everything are dear: they are made only where something unlisted would else be believed
        return sum(w for w, other in weights if other) >= self.unlisted_share * sum(w for w, _ in weights)

    def not_refitted(self, best: Hypothesis) -> list[str]:
        """Effects that could be seen and that no refit has tried beside a set."""
        shows = best.refit.linear.shows()
        names = [n for n in shows if n not in best.effects and shows[n] >= self.least_signal]
        return [n for n in names if (best.form, best.effects | {n}) not in self.done]

    def score_around(self, form: Form, made: Refit, near: Hypothesis | None) -> bool:
        """Scores the refitted set with every choice of terms that need no refit, and their neighbours by one effect.

        Returns:
          Whether this is the best refit of its set so far and has evidence; around another one nothing is scored.
        """
        own = form.listed(made.effects)
        felt, shows = made.linear.felt(), made.linear.shows()
        unfitted = [t for t in form.terms if t.kind != EFFECT]
        unfitted = [t for t in unfitted if t.kind != UNLISTED or felt[t.name] >= self.least_signal]
        effects = [t for t in form.terms if t.kind == EFFECT and shows[t.name] >= self.least_signal]
        base = self.score(form, made, own, own, None if near is None else _sizes(near))
        if base is None or base.refit is not made:
            return False

        def scored(choices: Iterable[Terms], beside: Hypothesis) -> list[Hypothesis]:
            return [h for terms in choices if (h := self.score(form, made, own, terms, _sizes(beside), beside))]

        roots = [base]
        # Terms without a refit: all single ones, then more beside the best of them.
        level = scored((own | {t} for t in unfitted), base)
        best = max([base, *level], key=lambda h: h.log_posterior)
        while level and best is not roots[-1] and len(best.terms) < self.most_terms:
            roots.append(best)
            level = scored((best.terms | {t} for t in unfitted if t not in best.terms), best)
            best = max([best, *level], key=lambda h: h.log_posterior)
            # What a later term makes needless goes again.
            fewer = scored((best.terms - {t} for t in best.terms - own), best)
            best = max([best, *fewer], key=lambda h: h.log_posterior)
        top = max(h.log_posterior for h in self.known.values())
        for root in roots:
            # A neighbour of what is hopeless may still be the truth where nothing has been found yet.
            if root is not base and root.log_posterior < top - self.window:
                continue
            more = [root.terms | {t} for t in effects if t not in own]
            scored(self.likely(made, more, root), root)
            scored((root.terms - {t} for t in own), root)
        return True

    def likely(self, made: Refit, choices: Sequence[Terms], beside: Hypothesis) -> Sequence[Terms]:
        """Of sets of terms the most probable ones at the sizes of a set around the same refit, as many as are scored.

        Sizes settle anew for each set that is scored, which takes far longer than a look at given ones.
        """
        if len(choices) <= self.most_scored:
            return choices
        sizes = _sizes(beside)
        looks = [(made.linear.at_sizes(terms, sizes), k) for k, terms in enumerate(choices)]
        return [choices[k] for _, k in sorted(looks, reverse=True)[: int(self.most_scored)]]

    def score(
        self,
        form: Form,
        made: Refit,
        own: Terms,
        terms: Terms,
        sizes: tuple[np.ndarray, np.ndarray] | None,
        beside: Hypothesis | None = None,
    ) -> Hypothesis | None:
        """The best that is known of a set of terms after it was scored around a refit; None if nothing is.

        Args:
          form, made: around which refit. own: its effects as terms. terms: of the set.
          sizes: of discrepancy and noise to begin at. beside: set around the same refit of which it is a neighbour.
        """
        refitted = terms.issuperset(own) and not any(t.kind == EFFECT for t in terms - own)
        old = self.known.get((form.name, terms))
        # What a set's own refit says is not replaced by an estimate from another's.
        if len(terms) > self.most_terms or (old is not None and old.refitted and not refitted):
            return old
        named = frozenset(t.name for t in terms if t.kind == EFFECT)
        # These effects have had their refit: an estimate from elsewhere comes too late, even where that refit failed.
        if not refitted and (form.name, named) in self.done:
            return old
        new = self.estimate(form, made, terms, sizes, refitted)
        if new is None:
            return old
        more = [] if refitted or beside is None else list(terms - beside.terms)
        if more and beside is not None:
            without = beside.log_posterior + more[0].log_prior
            new = dataclasses.replace(new, promise=Promise(more[0].name, without, new.log_posterior - without))
            new = self.believed(new)
        # Of two linear estimates of one set the one from nearer by counts: that of the more probable refit. Of two
        # refits of one set the better optimum counts.
        if old is None or (refitted and not old.refitted) or new.log_posterior > old.log_posterior:
            self.known[form.name, terms] = new
        return self.known[form.name, terms]

    def estimate(
        self, form: Form, made: Refit, terms: Terms, sizes: tuple[np.ndarray, np.ndarray] | None, refitted: bool = False
    ) -> Hypothesis | None:
        """A set of terms by the linear model around a refit; None where it tells nothing.

        Args:
          form, made: around which refit. terms: of the set. sizes: of discrepancy and noise to begin at.
          refitted: whether the refit has the very effects of the set.
        """
        try:
            value, inferred, places = made.linear.evidence(terms, sizes)
        except (EvidenceError, np.linalg.LinAlgError):
            return None
        # terms are independent beforehand: each has its own odds, and a set the product of theirs
        prior = form.log_prior + sum(t.log_prior for t in terms)
        return Hypothesis(form.name, terms, value + prior, made, refitted, inferred, places)


def _carried_over(listed: Sequence[Hypothesis], best: Hypothesis, form: str) -> float:
    """Log posterior of the best hypothesis' set beside another form, were its last effects to gain as much there.

    The gain is counted from the largest set of its effects that was refitted beside both forms.
    """
    best_of: dict[tuple[str, frozenset[str]], float] = {}
    for h in listed:
        if h.refitted and h.effects <= best.effects:
            best_of[h.form, h.effects] = max(h.log_posterior, best_of.get((h.form, h.effects), -math.inf))
    common = [e for name, e in best_of if name == form and (best.form, e) in best_of]
    if not common:
        return -math.inf
    shared = max(common, key=len)
    return best_of[form, shared] + best.log_posterior - best_of[best.form, shared]


def _one_more(h: Hypothesis, best: Hypothesis) -> bool:
    """Whether a hypothesis is another with one effect more, and nothing else."""
    more = h.terms - best.terms
    return h.form == best.form and best.terms <= h.terms and len(more) == 1 and len(h.effects) > len(best.effects)


def _start(near: Hypothesis) -> np.ndarray:
    """(coordinates,) where a hypothesis scored in linear approximation stands by its own posterior."""
    u = near.refit.u.copy()
    # beyond the coordinates lie the amplitudes of unlisted inputs, which are integrated out and have no place in u
    own = near.places < len(u)
    linear = near.refit.linear
    u[near.places[own]] += near.evidence.within(linear.low[near.places], linear.high[near.places])[own]
    return u


def _sizes(h: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    return h.evidence.tau, h.evidence.noise
