"""The search over sets of terms on a toy: what is hidden, twins, nothing, something unlisted, a failing refit."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.conclusion import conclude, probabilities
from lunar_mjx.inference.deadline import TimeUp
from lunar_mjx.inference.evidence import EvidenceError, Gram, NoiseSize
from lunar_mjx.inference.weighing.hypotheses import EFFECT, UNLISTED, Linear, Term, shifted
from lunar_mjx.inference.weighing.search import Hypothesis, _carried_over, _Search, search
from tests.inference.toy_form import EFFECTS, NOISE, ToyForm, TwoValleys, X, curve, measured


def look(value, **more):
    return search([ToyForm(value, **more)], most_refits=12, most_terms=4, window=4.0)


def test_nothing_is_found_where_nothing_is_hidden():
    said = [conclude(look(measured(seed)), 0.95).verdict for seed in range(10)]
    assert said.count(Verdict.NOISE_ONLY) >= 9
    assert not {Verdict.KNOWN, Verdict.MULTIPLE} & set(said)


def test_a_hidden_effect_is_named_with_its_amount():
    found = look(measured(0, wave=0.8))
    said = conclude(found, 0.95)
    assert (said.verdict, said.effects) == (Verdict.KNOWN, ("wave",))
    best = found.best
    assert best.refitted and best.effects == {"wave"}
    assert best.refit.u[3] == pytest.approx(0.8, abs=0.1)


def test_twins_are_a_class():
    said = conclude(look(measured(1, square=0.6)), 0.95)
    assert said.verdict is Verdict.KNOWN_CLASS
    assert set(said.effects) == {"square", "twin"}


def test_two_effects_are_both_named():
    said = conclude(look(measured(2, wave=0.8, square=0.6)), 0.95)
    assert "wave" in said.effects
    assert said.verdict in (Verdict.KNOWN, Verdict.MULTIPLE)  # the square has a twin


def test_every_accepted_effect_is_challenged_by_a_refit_without_it():
    found = look(measured(2, wave=0.8, square=0.6))
    listed = [h for h in found.hypotheses if h.refitted and h.effects == h.names]
    best = listed[0]
    assert len(best.effects) == 2
    refitted = {h.effects for h in listed}
    assert {best.effects - {e} for e in best.effects} <= refitted


def test_a_better_valley_is_no_effect():
    found = search([TwoValleys(measured(0))], most_refits=12, most_terms=4, window=4.0)
    assert conclude(found, 0.95).verdict is Verdict.NOISE_ONLY
    assert found.best.refitted and not found.best.terms and found.best.refit.u[0] < 0.0
    # The effect that was tried first fell into that valley, and counts for what it is worth there.
    tried = [h for h in found.hypotheses if h.refitted and len(h.effects) == 1]
    assert tried and all(h.log_posterior < found.best.log_posterior for h in tried)


def test_an_effect_is_found_in_a_better_valley():
    found = search([TwoValleys(measured(1, wave=0.8))], most_refits=20, most_terms=4, window=4.0)
    assert conclude(found, 0.95).effects == ("wave",)


def test_a_refit_without_evidence_is_made_once_and_named():
    class Spoilt(Linear):
        """Statistics that rounding spoils."""

        def evidence(self, *args, **kwargs):
            raise EvidenceError("rounding spoils it")

    class Mute(ToyForm):
        """No evidence around refits with `wave`."""

        def refit(self, effects, near, start):
            made = super().refit(effects, near, start)
            fields = {f.name: getattr(made.linear, f.name) for f in dataclasses.fields(made.linear)}
            linear = Spoilt(**fields) if "wave" in effects else made.linear
            return dataclasses.replace(made, linear=linear)

    tried = []
    found = search([Mute(measured(0, wave=0.8))], 12, 4, 4.0, progress=lambda text, share: tried.append(text))
    assert tried.count("refitting toy + wave") == 1
    assert "toy + wave: no evidence around its refit" in found.failed
    assert not any("wave" in h.effects for h in found.hypotheses)


def test_what_ended_in_a_worse_valley_is_refitted_from_a_better_one():
    class Late(TwoValleys):
        """Only `twin` leads into the better valley."""

        def refit(self, effects, near, start):
            if start is not None and effects and "twin" not in effects and near.u[0] > 0.0:
                return ToyForm.refit(self, effects, near, start)
            return super().refit(effects, near, start)

    value = measured(2, wave=0.8)
    found = search([Late(value)], most_refits=30, most_terms=4, window=4.0)
    assert conclude(found, 0.95).effects == ("wave",)
    assert found.best.refit.u[0] < 0.0


class Lured(ToyForm):
    """A toy whose `twin` has a slope at its null and goes nowhere: what a linear estimate promises of it is not there.

    Nothing else that is listed can do what it promises.
    """

    terms = tuple(t for t in ToyForm.terms if t.name != "square")

    @staticmethod
    def curve(u):
        """The toy's curve (n,), with `twin` saturated beyond a hundredth."""
        reached = 0.01 * np.tanh(u[4:5] / 0.01)
        return curve(np.concatenate([u[:4], reached]))


def test_a_promise_that_a_refit_has_broken_is_not_believed_beside_other_effects():
    for amount in (0.6, 1.0):
        found = search([Lured(measured(2, wave=0.8, square=amount))], 20, 4, 3.0)
        assert any(h.refitted and "twin" in h.effects for h in found.hypotheses), "no promise was put to the test"
        estimates = [h for h in found.hypotheses if "twin" in h.effects and not h.refitted]
        assert estimates and all(h.log_posterior < found.best.log_posterior - 5.0 for h in estimates)


class Gated(ToyForm):
    """A toy whose `twin` acts where `wave` does and hardly alone, where its slope promises much."""

    # with the odds of one effect among three hundred a promise must be large to be tried at all
    terms = tuple(
        dataclasses.replace(t, log_prior=math.log(0.0033)) for t in ToyForm.terms if t.name not in ("square", "level")
    )

    @staticmethod
    def curve(u):
        """The toy's curve (n,)."""
        open_ = np.clip(u[3] / 0.5, 0.0, 1.0)
        alone = 0.01 * np.tanh(u[4] / 0.01) - 5.0 * u[4] ** 2
        return curve(np.array([*u[:4], open_ * u[4] + (1.0 - open_) * alone]))


def test_an_effect_that_acts_beside_another_alone_is_found_there():
    """Broken promises beside sets without the other say little of what it does there."""
    plain = np.array([0.5, -0.4, 0.0, 0.0, 0.0])
    noise = measured(5) - curve(plain)
    for amount in (0.3, 2.0):
        value = Gated.curve(plain + np.array([0.0, 0.0, 0.0, 0.8, amount])) + noise
        found = search([Gated(value)], most_refits=20, most_terms=4, window=4.0)
        assert set(conclude(found, 0.95).effects) == {"twin", "wave"}


class Rival(ToyForm):
    """Another law: the toy's with x^2 added, which nothing but a name would have to explain beside the first."""

    name, late = "rival", True

    @staticmethod
    def curve(u):
        """The toy's curve (n,), and half of x^2."""
        return curve(u) + 0.5 * X**2


def test_a_late_form_is_asked_before_anything_is_named_and_not_otherwise():
    for value, asked in ((measured(0), False), (measured(1) + 0.5 * X**2, True)):
        tried = []
        found = search([ToyForm(value), Rival(value)], 12, 4, 4.0, progress=lambda text, share, t=tried: t.append(text))
        assert ("refitting rival" in tried) is asked
        assert conclude(found, 0.95).verdict is Verdict.NOISE_ONLY
    assert tried[1] == "refitting rival"
    assert found.forms()["rival"] > 0.95


def test_something_unlisted_is_unknown_at_its_port():
    value = measured(3) + 0.5 * np.where(X > 0.2, X - 0.2, 0.0) * np.cos(6.0 * X)
    found = look(value)
    said = conclude(found, 0.95)
    assert said.verdict is Verdict.UNKNOWN
    assert found.complete
    tried = set().union(*(h.effects for h in found.hypotheses if h.refitted))
    assert tried == set(EFFECTS), "something unlisted was believed before every effect was refitted"
    assert said.port == "level"


@pytest.mark.parametrize("effect", ["square", "wave"])
def test_what_is_unlisted_is_like_the_effect_that_makes_it(effect):
    """An effect of another shape could do little of it, and one that would have to be negative could do nothing."""
    form = ToyForm(measured(0, **{effect: 0.6}))
    linear = form.refit(frozenset(), None, None).linear
    level = frozenset(t for t in form.terms if t.name == "level")
    _, found, places = linear.evidence(level)
    share = linear.alike(found, places, "level")
    assert set(share) == set(EFFECTS) and all(0.0 <= v <= 1.0 + 1e-9 for v in share.values())
    other = "wave" if effect == "square" else "square"
    # a half of either is level and slope, which are not unlisted
    assert share[effect] > 0.3 and share[effect] > 3.0 * share[other]
    against = dataclasses.replace(linear, high=np.where(np.arange(14) == EFFECTS[effect], 0.0, linear.high))
    assert against.alike(found, places, "level")[effect] < 1e-9
    assert set(linear.alike(found, places, "nothing").values()) == {0.0}


def test_what_is_most_like_what_is_unlisted_is_asked_before_what_estimates_promise(monkeypatch):
    asked = []

    class Asked(ToyForm):
        def refit(self, effects, near, start):
            asked.append(set(effects))
            return super().refit(effects, near, start)

    def first(alike):
        asked.clear()
        monkeypatch.setattr(Linear, "alike", lambda *_: alike)
        kink = 0.5 * np.where(X > 0.2, X - 0.2, 0.0) * np.cos(6.0 * X)
        found = search([Asked(measured(3) + kink)], most_refits=12, most_terms=4, window=4.0)
        assert conclude(found, 0.95).port == "level"
        assert set().union(*asked) == set(EFFECTS)
        return asked[1]

    nothing = dict.fromkeys(EFFECTS, 0.0)
    usual = first(nothing)
    (other,) = set(EFFECTS) - usual - {sorted(set(EFFECTS) - usual)[0]}
    assert first(nothing | {other: 0.9}) == {other}


class Seen(ToyForm):
    """A toy whose effects have been seen to gain, whatever their linear estimates promise; what was asked is noted."""

    late_race = False

    def __init__(self, value):
        super().__init__(value)
        self.made, self.asked, self.gains = [], [], {}

    def refit(self, effects, near, start):
        self.made.append(effects)
        return super().refit(effects, near, start)

    def promising(self, refit):
        self.asked.append(refit.effects)
        if self.late_race:
            raise TimeUp
        return {e: gain for e, gain in self.gains.items() if e not in refit.effects}


def test_what_has_been_seen_to_gain_is_refitted_first():
    form = Seen(measured(0, wave=0.8))
    form.gains = {"twin": 30.0, "square": 1.0}
    found = search([form], most_refits=12, most_terms=4, window=4.0)
    assert form.made[:2] == [frozenset(), frozenset({"twin"})]
    assert form.asked[0] == frozenset() and len(form.asked) == len(set(form.asked)), "each set is asked about once"
    # one nat is less than its odds: its estimate speaks for itself
    assert frozenset({"square"}) not in form.made[:3]
    assert conclude(found, 0.95).effects == ("wave",)


def test_a_search_ends_where_the_time_is_up_before_gains_were_seen():
    form = Seen(measured(0, wave=0.8))
    form.late_race = True
    found = search([form], most_refits=12, most_terms=4, window=4.0)
    assert form.made == [frozenset()] and not found.complete
    assert found.unseen and not found.waiting


def test_what_was_seen_to_gain_waits_for_its_refit():
    form = Seen(measured(0, wave=0.8))
    form.gains = {"twin": 30.0, "square": 20.0, "wave": 1.0}
    found = search([form], most_refits=2, most_terms=4, window=4.0)
    assert form.made == [frozenset(), frozenset({"twin"})] and not found.complete
    # one nat is less than its odds
    assert found.waiting == {"square"}


def test_a_refit_that_fails_is_no_hypothesis_and_is_told():
    found = look(measured(0, wave=0.8), broken=("wave",))
    assert not any("wave" in h.effects for h in found.hypotheses)
    assert found.failed == ("toy + wave: broken on purpose",)
    with pytest.raises(EvidenceError, match="not finite"):
        look(np.full(60, np.nan))


def test_probabilities_sum_to_one():
    found = look(measured(1, square=0.6))
    assert found.probability.sum() == pytest.approx(1.0)
    assert sum(probabilities(found).values()) == pytest.approx(1.0)


def test_leaving_an_effect_out_agrees_with_its_null():
    form = ToyForm(measured(0, square=0.4))
    u = np.array([0.5, -0.4, 0.4, 0.0, 0.0])
    back = np.zeros(14)
    back[2] = -0.4
    moved = shifted(form.linear(u).gram, back)
    null = form.linear(np.array([0.5, -0.4, 0.0, 0.0, 0.0])).gram
    keep = [0, 1, 2, 3, 4, 14]  # the gauge's column is the curve itself, which has moved
    at = np.ix_(keep, keep)
    np.testing.assert_allclose(moved.matrix[0][at], null.matrix[0][at], rtol=1e-5, atol=0.1)


def test_judged_measurements_weigh_as_if_they_had_been_fitted():
    """With sizes known, the evidence of one half and the prediction of the other are the evidence of both."""
    whole = ToyForm(measured(4, wave=0.8)).refit(frozenset({"wave"}), None, None).linear
    known = dataclasses.replace(whole, fields=(), noises=(NoiseSize("y", 1e-4),), always=np.r_[0, 1, 5])
    u = np.array([0.5, -0.4, 0.0, 0.8, 0.0])
    step = 1e-6 * np.eye(5)
    own = np.stack([(curve(u + h) - curve(u - h)) / 2e-6 for h in step], axis=1)
    columns = np.column_stack([own, curve(u), np.zeros((len(X), 8))]) / NOISE
    rows = (measured(4, wave=0.8) - curve(u)) / NOISE
    half = np.arange(len(X)) % 3 > 0
    parts = [Gram.of(columns[k], rows[k]) for k in (half, ~half)]
    for terms in (frozenset[Term](), frozenset({Term("wave", EFFECT, 0.0)})):
        both = dataclasses.replace(known, gram=parts[0] + parts[1]).evidence(terms)[0]
        split = dataclasses.replace(known, gram=parts[0], judged=parts[1]).evidence(terms)[0]
        assert split == pytest.approx(both, rel=1e-5)


def test_a_set_promises_beside_another_form_what_its_last_effects_gained():
    """Counted from the largest set that was refitted beside both forms; no promise where there is none."""
    terms = {n: Term(n, EFFECT, 0.0) for n in "abc"}

    def hypothesis(form, names, value):
        chosen = frozenset(terms[n] for n in names)
        return Hypothesis(form, chosen, value, None, True, None, None)  # pyright: ignore[reportArgumentType]

    known = [hypothesis("one", "", -50.0), hypothesis("one", "a", -40.0), hypothesis("one", "abc", -10.0)]
    known += [hypothesis("two", "", -60.0), hypothesis("two", "a", -35.0), hypothesis("two", "b", 0.0)]
    assert _carried_over(known, known[2], "two") == -35.0 + (-10.0 + 40.0)
    assert _carried_over(known, known[2], "three") == -np.inf


def test_a_name_is_challenged_from_its_own_end_before_anything_else_is_tried():
    tried = []

    class Watched(ToyForm):
        def refit(self, effects, near, start):
            tried.append((set(effects), None if near is None else set(near.effects)))
            return super().refit(effects, near, start)

    search([Watched(measured(0, wave=0.8))], 12, 4, 4.0)
    assert tried[:3] == [(set(), None), ({"wave"}, set()), (set(), {"wave"})]


def test_few_sets_are_scored_with_sizes_of_their_own_and_the_best_is_among_them():
    value = measured(0, wave=0.8)
    few = search([ToyForm(value)], 12, 4, 4.0, most_scored=1)
    assert few.best.effects == {"wave"}
    assert few.best.log_posterior == pytest.approx(look(value).best.log_posterior, abs=1e-6)
    assert len(few.hypotheses) < len(look(value).hypotheses)


def test_an_effect_ten_times_its_nominal_size_is_rare_and_no_miracle():
    form = ToyForm(measured(0, square=1.0))
    linear = form.linear(np.zeros(5))
    # An amplitude of prior size 0.1, of which the truth holds ten.
    std = linear.amplitudes.std.copy()
    std[EFFECTS["square"]] = 0.1
    gaussian = dataclasses.replace(linear, amplitudes=dataclasses.replace(linear.amplitudes, std=std))
    amount = np.zeros(gaussian.gram.width, bool)
    amount[list(EFFECTS.values())] = True
    cauchy = dataclasses.replace(gaussian, amount=amount, freedom=1.0)
    terms = frozenset(t for t in form.terms if t.name == "square")
    base, sizes, _ = gaussian.evidence(frozenset())
    assert cauchy.evidence(frozenset())[0] == base
    gains, found = {}, {}
    for name, one in (("gaussian", gaussian), ("cauchy", cauchy)):
        value, found[name], places = one.evidence(terms, (sizes.tau, sizes.noise))
        gains[name] = value - base
        # Sizes of effects stay within: discrepancies are told as before, and the prior of whoever reads on is Gaussian.
        assert len(found[name].tau) == len(one.fields)
        assert np.array_equal(found[name].amplitudes.field >= 0, one.amplitudes.field[places] >= 0)
    # Ten deviations cost 50 nats, and under Cauchy's prior log(1 + 100), which is 5.
    assert gains["cauchy"] - gains["gaussian"] > 20.0
    own = int(np.flatnonzero(places == EFFECTS["square"])[0])
    assert found["cauchy"].mean[own] == pytest.approx(1.0, abs=0.1)
    assert found["cauchy"].mean[own] > found["gaussian"].mean[own]
    # A look at a few sizes picks about as well.
    looked = [one.at_sizes(terms, (sizes.tau, sizes.noise)) for one in (gaussian, cauchy)]
    assert looked[1] - looked[0] > 20.0


def test_no_estimate_leads_for_good_because_of_something_unlisted_beside_it():
    """What is unlisted needs no refit, the effects beside it do; and their refit replaces every estimate of them."""
    form = ToyForm(measured(4, wave=0.8))
    going = _Search([form], 30, 4, 4.0, 1.0, 0.5, 100, lambda text, share: None)
    going.begin()
    base = going.known["toy", frozenset()]
    going.refit(form, frozenset({"wave", "twin"}), base)
    level = next(t for t in form.terms if t.kind == UNLISTED)
    key = "toy", form.listed(frozenset({"twin"})) | {level}
    assert not going.known[key].refitted
    top = max(h.log_posterior for h in going.known.values())
    going.known[key] = dataclasses.replace(going.known[key], log_posterior=top + 50.0)
    while going.may_refit and going.go_on(lambda found: None):
        pass
    assert going.known[key].refitted and going.known[key].log_posterior < top
