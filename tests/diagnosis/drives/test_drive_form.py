"""The form of drives on a toy rover without a simulator: refits, signatures, verdicts."""

from __future__ import annotations

import dataclasses
import itertools
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lunar_mjx.diagnosis import audit
from lunar_mjx.diagnosis.build_problem import FINER_FORMS
from lunar_mjx.diagnosis.candidates import usable
from lunar_mjx.diagnosis.drives import form as module
from lunar_mjx.diagnosis.drives import loop
from lunar_mjx.diagnosis.drives.baseline import unfit
from lunar_mjx.diagnosis.drives.form import LEARNT, DriveForm
from lunar_mjx.diagnosis.drives.observations import observations_of
from lunar_mjx.diagnosis.drives.refitting import signatures
from lunar_mjx.diagnosis.drives.refitting.fields import USUAL_EFFECTS, Share
from lunar_mjx.diagnosis.drives.refitting.own import OwnRefit
from lunar_mjx.diagnosis.drives.refitting.race import Race
from lunar_mjx.diagnosis.drives.refitting.steps import bounded_step
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.drives.usual import acting_current
from lunar_mjx.diagnosis.unknown_inputs.inputs import FOLLOWS
from lunar_mjx.diagnosis.unknown_inputs.port_fields import DRIVEN, Usual, rotation
from lunar_mjx.diagnosis.verbs import explain
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.answer import _diagnosis, _held_to_account, _unlooked, _unrefitted, _without
from lunar_mjx.diagnosis.weighed.conclusion import Conclusion, conclude, helps
from lunar_mjx.diagnosis.weighed.form import Problem, SearchSettings
from lunar_mjx.diagnosis.weighed.held_to_account import account, gains_on_held_out
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.errors import UserError
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.deadline import Deadline, TimeUp
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.inference.weighing.search import search
from lunar_mjx.model import make_model
from tests.inference.toy_problem import coordinate, manoeuvres

LOGS, SAMPLES, LABEL = 6, 80, "motor_torque"
USUAL = Usual(40.0, 0.1, 2.0, 0.4, 0.3, 0.5, 4.0, 240.0, 0.3)
RNG = np.random.default_rng(0)
SHAPES = RNG.standard_normal((5 + len(FOLLOWS[LABEL]), LOGS * SAMPLES))
SHAPES[5:] /= [[USUAL.size(LABEL, q)] for q in FOLLOWS[LABEL]]


class Toy:
    """What `DriveForm` asks of drives: two parameters that bend, two effects of which one saturates, one input."""

    noise_unlearnt, together = False, 4

    def __init__(self, truth: dict[str, float], unlisted: float = 0.0):
        own = [coordinate("base", "a", prior=2.0), coordinate("base", "b", prior=2.0)]
        shown = [coordinate(e, "amount", True, low=-1.0, high=30.0) for e in ("drag", "lag", "idle")]
        self.coordinates = (*own, *shown, *(coordinate("inputs", q, True) for q in FOLLOWS[LABEL]))
        self.baseline, self.ground = np.arange(2), np.zeros(0, int)
        self.candidates = {c.effect: np.array([2 + k]) for k, c in enumerate(shown)}
        self.inputs = {LABEL: np.arange(5, len(self.coordinates))}
        self.rows = 0
        self.rate = np.zeros(LOGS * SAMPLES)
        u = np.zeros(len(self.coordinates))
        for c, value in truth.items():
            u[[x.effect if x.amplitude else x.name for x in self.coordinates].index(c)] = value
        u[6] = unlisted * USUAL.size(LABEL, FOLLOWS[LABEL][1])
        noise = np.random.default_rng(1).standard_normal(LOGS * SAMPLES)
        self.observations = dataclasses.replace(manoeuvres(LOGS, SAMPLES), value=self.predict(u[None])[0] + noise)

    def about(self, u):
        del u

    def devote(self, effects):
        del effects

    def take_noise(self, other):
        self.observations = other.observations

    def predict(self, u):
        u = np.atleast_2d(u).copy()
        self.rows += len(u)
        u[:, 0] = 5.0 * np.expm1(0.3 * u[:, 0])
        u[:, 1] += 0.2 * u[:, 1] ** 2
        u[:, 2] = 4.0 * (1.0 - np.exp(-0.7 * u[:, 2]))
        u[:, 4] *= 1e-3
        u[:, 5:] *= 20.0
        return u @ SHAPES

    def jacobian(self, u, which, side=1, steps=None):
        step = side * np.maximum(1e-6, 0.0 if steps is None else steps) * np.ones(len(u))
        rows = np.concatenate([u[None], u + np.diag(step)[which]])
        values = self.predict(rows)
        return values[0], ((values[1:] - values[0]) / step[which, None]).T

    def free(self, effects=()):
        return np.concatenate([self.baseline, *(self.candidates[e] for e in effects)]).astype(int)

    def bounds(self, which):
        pairs = np.array([self.coordinates[i].bounds() for i in which], float).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]


class Rough(Toy):
    """A toy whose predictions jump by a tenth of a sigma, three thousand times in a scale, as wheels that stick do."""

    def predict(self, u):
        jumps = np.sign(np.sin(3e3 * np.atleast_2d(u)[:, :2] + [0.0, 1.0])).sum(axis=1)
        return super().predict(u) + 0.1 * np.outer(jumps, SHAPES[2])


@pytest.fixture(autouse=True)
def _no_rover(monkeypatch):
    monkeypatch.setattr(module, "usual_of", lambda drives: USUAL)


def asked(toy: Toy):
    settings = DriveSettings()
    form = DriveForm(toy, settings)  # type: ignore[arg-type]
    found = search([form], settings.most_refits, settings.most_terms, settings.window)
    return form, found, conclude(found, settings.sure)


def test_what_is_missing_is_as_rare_however_many_effects_are_listed():
    """Candidates of a drive share the odds of the some fifteen of a table."""
    model = make_model("luvmi_x", terrain="flat")
    listed = {name: effect for name, effect in CATALOGUE.items() if name not in FINER_FORMS}
    tested, _ = usable(model.effects, listed, unfit)
    assert len(tested) * DriveSettings().effect_odds == pytest.approx(15 * SearchSettings().effect_odds, rel=0.15)


def test_a_descent_ends_where_jumps_hide_what_its_slopes_promise():
    """Steps that get ever shorter promise less than a nat: 452 and 408 rows were simulated before that ended them."""
    toy = Rough({"a": 1.5, "b": -0.8}, unlisted=2.0)
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    toy.rows = 0
    base = form.refit(frozenset(), None, None)
    assert toy.rows < 200
    assert base.u[:2] == pytest.approx([1.5, -0.8], abs=0.3)
    toy.rows = 0
    form.refit(frozenset({"drag"}), base, None)
    assert toy.rows < 100


def test_what_was_raced_is_refitted_from_where_the_race_has_brought_it_with_errors_of_its_own(monkeypatch):
    """Led by errors that lessen; afterwards all is again as for the model as it is."""
    form = DriveForm(Toy({"a": 1.5, "b": -0.8, "drag": 3.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    led, begun, lead, approach = [], [], OwnRefit.lead, OwnRefit.approach
    monkeypatch.setattr(OwnRefit, "lead", lambda self, *a, **k: (led.append(a), lead(self, *a, **k))[1])
    monkeypatch.setattr(OwnRefit, "approach", lambda self, u, *a: (begun.append(u), approach(self, u, *a))[1])
    about: list[np.ndarray] = []
    monkeypatch.setattr(form.drives, "about", about.append)
    errors, seen, steps = form.errors, form._refits.design.seen.copy(), form._derivatives.steps.copy()
    form.promising(base)
    drag, both = frozenset({"drag"}), frozenset({"drag", "lag"})
    found = form.refit(drag, base, form.trial(base.u, "drag"))
    # by errors that lessen as for the model as it is, then by its own
    assert len(led) == 1 and len(begun) == len(DriveSettings().annealing) + 1
    assert led[0][0] is form._refits.raced[frozenset(), drag]
    assert found.u[:3] == pytest.approx([1.5, -0.8, 3.0], abs=0.3)
    assert found.linear.log_scale != base.linear.log_scale
    assert form.errors is errors and np.array_equal(form._derivatives.steps, steps)
    assert about[-1] is form._refits.base.u
    assert np.array_equal(form._refits.design.seen, seen)
    # beside drag nothing was raced, and without it nothing: both begin there, one with a lag that acts
    form.refit(both, found, None)
    form.refit(frozenset(), found, None)
    assert len(led) == 3 and len(begun) == 3 * (len(DriveSettings().annealing) + 1)
    assert led[1][0][:3] == pytest.approx(found.u[:3])
    assert led[2][0][:2] == pytest.approx(found.u[:2]) and led[2][0][2] == 0.0


@pytest.mark.parametrize(("hidden", "amount"), [("drag", 3.0), ("lag", 2.0)])
def test_a_race_tells_what_would_gain_by_a_refit(hidden, amount):
    """By a few steps with the Jacobian of the model as it is; afterwards all is again as before."""
    form = DriveForm(Toy({"a": 1.5, "b": -0.8, hidden: amount}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    errors, seen, steps = form.errors, form._refits.design.seen.copy(), form._derivatives.steps.copy()
    gains = form.promising(base)
    assert set(gains) == {"drag", "lag"}, "what cannot show does not run"
    other = ({"drag", "lag"} - {hidden}).pop()
    assert gains[hidden] > 100.0 and gains[hidden] > 2.0 * gains[other]
    assert form.errors is errors and form._errors.floor == 0.0
    assert np.array_equal(form._refits.design.seen, seen) and np.array_equal(form._derivatives.steps, steps)
    assert set(form.promising(form.refit(frozenset({hidden}), base, None))) == {other}


def test_one_of_which_nothing_can_be_told_ends_no_race(monkeypatch):
    form = DriveForm(Toy({"a": 1.5, "drag": 3.0}), DriveSettings())  # type: ignore[arg-type]
    base, settle = form.refit(frozenset(), None, None), OwnRefit.settle

    def steep(self, u, *rest):
        if u[3] != 0.0:
            raise EvidenceError("derivatives are too steep to compute with")
        return settle(self, u, *rest)

    held = OwnRefit.held
    monkeypatch.setattr(OwnRefit, "settle", steep)
    monkeypatch.setattr(OwnRefit, "held", lambda self, u, *a: (steep(self, u, *a), held(self, u, *a))[1])
    gains = form.promising(base)
    assert gains["lag"] == -np.inf and gains["drag"] > 100.0


def test_a_little_of_every_effect_has_no_part_in_a_race(monkeypatch):
    """By slopes of where the model stands it would stand in for what an effect does elsewhere."""
    form = DriveForm(Toy({"a": 1.5, "drag": 3.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    seen, design = [], form._refits.design
    run = Race.run
    monkeypatch.setattr(Race, "run", lambda self, *a: (seen.append(design.seen.copy()), run(self, *a))[1])
    form.promising(base)
    small = form._own.prior.places.amplitudes(form.candidates)
    assert not seen[0][:, small].any() and design.seen[:, small].any()


def test_a_race_promises_nothing_where_nothing_is_missing():
    form = DriveForm(Toy({"a": 1.5, "b": -0.8}), DriveSettings())  # type: ignore[arg-type]
    gains = form.promising(form.refit(frozenset(), None, None))
    assert max(gains.values()) < -form.settings.effect_log_odds


def test_a_rover_that_diverges_in_a_race_gains_nothing(monkeypatch):
    form = DriveForm(Toy({"a": 1.5, "drag": 3.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    predict = form.drives.predict
    monkeypatch.setattr(form.drives, "predict", lambda u: np.where(np.atleast_2d(u)[:, [3]] != 0.0, np.nan, predict(u)))
    gains = form.promising(base)
    assert gains["lag"] == -np.inf and gains["drag"] > 100.0


@pytest.mark.parametrize("failure", [TimeUp, np.linalg.LinAlgError, EvidenceError])
def test_a_refit_that_is_late_or_fails_leaves_all_as_it_was(monkeypatch, failure):
    form = DriveForm(Toy({"a": 1.5, "b": -0.8, "drag": 3.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    errors, steps = form.errors, form._derivatives.steps.copy()

    def late(*a, **k):
        raise failure

    monkeypatch.setattr(OwnRefit, "approach", late)
    with pytest.raises(failure):
        form.refit(frozenset({"drag"}), base, form.trial(base.u, "drag"))
    assert form.errors is errors and form._errors.channels_held is False and form._errors.floor == 0.0
    assert np.array_equal(form._derivatives.steps, steps)


def test_hypotheses_with_errors_of_their_own_are_weighed_in_the_same_units():
    """The truth is less probable with the errors that the model as it is needs than with its own."""
    form = DriveForm(Toy({"a": 1.5, "b": -0.8, "drag": 3.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    drag, refits = frozenset({"drag"}), form._refits
    found = form.refit(drag, base, None)
    by_its_own = found.linear.evidence(form.listed(drag))[0]
    slopes = refits.ended[drag, found.u.tobytes()].slopes
    by_those_of_the_base = refits.linearised.around(found.u, drag, slopes).evidence(form.listed(drag))[0]
    plain = base.linear.evidence(frozenset())[0]
    assert plain < by_those_of_the_base <= by_its_own + 1.0


class Faint(Toy):
    """A toy one of whose parameters does next to nothing, and has a hundred thousand scales to go."""

    def __init__(self, truth: dict[str, float]):
        super().__init__(truth)
        own = list(self.coordinates)
        own[1] = dataclasses.replace(own[1], prior=1e6)
        self.coordinates = tuple(own)

    def predict(self, u):
        u = np.atleast_2d(u).copy()
        u[:, 1] *= 1e-5
        return super().predict(u)


def test_a_parameter_that_does_next_to_nothing_holds_back_no_other():
    """With steps shortened until the longest coordinate fits, `a` had not left its start."""
    form = DriveForm(Faint({"a": 1.5, "b": 1.5e5}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    assert base.u[0] == pytest.approx(1.5, abs=0.3)


def test_a_model_that_only_needs_a_refit_lacks_nothing():
    form, found, said = asked(Toy({"a": 1.5, "b": -0.8}))
    assert said.verdict is Verdict.NOISE_ONLY, said.sentence
    assert found.best.refit.u[:2] == pytest.approx([1.5, -0.8], abs=0.3)
    fitted = form.observations.in_split("fit")
    assert np.sqrt(np.mean(form.told(found.best.refit.u)[fitted] ** 2)) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("effect", "amount"), [("drag", 0.9), ("lag", 0.7)])
def test_an_effect_is_named_and_sized(effect, amount):
    form, found, said = asked(Toy({"a": 0.5, effect: amount}))
    assert (said.verdict, said.effects) == (Verdict.KNOWN, (effect,)), said.sentence
    assert found.best.refit.u[form.candidates[effect][0]] == pytest.approx(amount, abs=0.2)
    assert set(found.best.refit.linear.held_out) == {f"{log} from {k} s" for log in ("log4", "log5") for k in range(8)}
    assert "idle" not in {t.name for t in found.inclusion()}, "what cannot show is not weighed"


class Bent(Toy):
    """A toy whose unknown input, where it is large, looks like an effect besides."""

    bend = 0.0

    def predict(self, u):
        amount = np.atleast_2d(u)[:, 6] / USUAL.size(LABEL, FOLLOWS[LABEL][1])
        return super().predict(u) + self.bend * np.outer(amount**2, SHAPES[2])


@pytest.mark.parametrize(("amount", "bend"), [(0.05, 1000.0), (0.1, 300.0), (0.2, 100.0)])
def test_discrepancy_is_simulated_so_that_its_bend_is_no_effect(monkeypatch, amount, bend):
    """To first order an input has no bend: `drag` was told for it with certainty."""
    monkeypatch.setattr(Bent, "bend", bend)
    form, found, said = asked(Bent({"a": 0.5}, unlisted=amount))
    assert (said.verdict, said.effects) == (Verdict.NOISE_ONLY, ()), said.sentence
    assert abs(found.best.refit.u[form.discrepancy[1]]) > 0.5 * amount * USUAL.size(LABEL, FOLLOWS[LABEL][1])
    assert form.alone(found.best.refit)[form.discrepancy] == pytest.approx(0.0), "no part of the model"


@pytest.mark.parametrize("fitted", [1, 2, 4])
def test_an_input_that_bends_is_no_effect_however_few_drives_there_are(monkeypatch, fitted):
    """What equal amounts of every log's own explained of a mean was linear: `drag` got a probability of 0.75."""
    monkeypatch.setattr(Bent, "bend", 300.0)
    toy = Bent({"a": 0.5}, unlisted=0.3)
    split = tuple("fit" if i < fitted else "select" if i >= LOGS - 2 else "no" for i in range(LOGS))
    toy.observations = dataclasses.replace(toy.observations, unit_split=split, split=split)
    _, found, _ = asked(toy)
    assert sum(p for term, p in found.inclusion().items() if term.name == "drag") < 0.05


@pytest.mark.parametrize(("amount", "bend"), [(0.2, 300.0), (0.4, 100.0), (0.6, 30.0)])
def test_an_effect_is_named_beside_an_input_that_bends(monkeypatch, amount, bend):
    """With derivatives by inputs of another place a second refit of the model as it is stood for the effect."""
    monkeypatch.setattr(Bent, "bend", bend)
    _, _, said = asked(Bent({"a": 0.5, "drag": 0.9}, unlisted=amount))
    assert (said.verdict, said.effects) == (Verdict.KNOWN, ("drag",)), said.sentence


@pytest.mark.parametrize("own", [0.0, 0.5, 1.0])
def test_logs_share_what_the_settings_say(own):
    fitted = [True, True, False, True, False]
    share = Share.of(own, fitted)
    mean = np.where(fitted, 1.0, share.known)
    covariance = share.mean * np.outer(mean, mean) + share.apart @ share.apart.T
    np.testing.assert_allclose(covariance, (1.0 - own) + own * np.eye(len(fitted)), atol=1e-12)


def test_drives_of_which_none_is_to_be_fitted_are_refused():
    logs = [SimpleNamespace(name=name, split=None) for name in ("a", "b")]
    with pytest.raises(UserError, match="split = 'a=test, b=select' leaves no drive to fit; give one of them"):
        observations_of(None, logs, {"a": "test", "b": "select"}, None, None)  # type: ignore[arg-type]


def test_a_model_whose_drives_have_all_inputs_to_themselves_is_refitted():
    form = DriveForm(Toy({"a": 1.5}), DriveSettings.of({"own_share": 1.0}))  # type: ignore[arg-type]
    assert form.refit(frozenset(), None, None).u[0] == pytest.approx(1.5, abs=0.2)


def test_an_audit_draws_worlds_without_the_discrepancy_that_was_fitted():
    form = DriveForm(Toy({"b": 0.4}, unlisted=1.2), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    assert audit._case(form, base, audit._sizes(form, base), 0, 7)["outcome"] == "silent, rightly"


class Breakaway(Toy):
    """A toy whose readings jump by two hundredths of a sigma where an input begins."""

    def predict(self, u):
        return super().predict(u) + 0.01 * np.outer(np.sign(np.atleast_2d(u)[:, 6] - 1e-9), SHAPES[2])


def test_derivatives_by_inputs_step_over_jumps():
    """Columns as steep as a jump over a short step made two of 21 foreign campaigns end with an error."""
    toy = Breakaway({"a": 0.5})
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    place, size = form.discrepancy[1:2], form._own.prior.whole_size[1]

    def off(jacobian) -> float:
        return float(np.abs(jacobian(form.origin(), place)[1][:, 0] - 20.0 * SHAPES[6]).max() * size)

    assert off(form.jacobian) < 100.0 < off(toy.jacobian)


class Finer(Toy):
    """A toy with another law, in which something acts that looks like `drag` beside the first one's."""

    def predict(self, u):
        return super().predict(u) + 2.0 * SHAPES[2]


def test_a_rival_law_is_asked_before_anything_is_named_with_the_same_errors():
    settings = DriveSettings()
    for truth, better in ((Finer({"a": 0.5}), True), (Toy({"a": 0.5, "lag": 0.7}), False)):
        toy, other = Toy({}), Finer({})
        toy.observations = truth.observations
        own = DriveForm(toy, settings)  # type: ignore[arg-type]
        rival = DriveForm(other, settings, name="finer", beside=own)  # type: ignore[arg-type]
        found = search([own, rival], settings.most_refits, settings.most_terms, settings.window)
        said = conclude(found, settings.sure)
        assert (found.forms()["finer"] > 0.99) is better
        assert said.effects == (() if better else ("lag",)), said.sentence
        assert rival.observations.log_widths() == pytest.approx(own.observations.log_widths())
        assert rival.errors is own.errors
    # what explains itself asks for no rival
    toy, other = Toy({"a": 0.5}), Finer({})
    own = DriveForm(toy, settings)  # type: ignore[arg-type]
    search([own, DriveForm(other, settings, name="finer", beside=own)], 8, 7, 4.0)  # type: ignore[arg-type]
    assert other.rows == 1, "nothing but its own making"


def test_a_law_that_predicts_the_same_is_as_probable_where_readings_are_off():
    """Errors of single readings are found by the model's own form: both laws are weighed with the same."""
    settings = DriveSettings()
    toy, other = Toy({"a": 0.5, "lag": 0.7}), Toy({})
    value = toy.observations.value.copy()
    value[::10] += 3.0 * np.random.default_rng(4).standard_normal(len(value[::10]))
    toy.observations = other.observations = dataclasses.replace(toy.observations, value=value)
    own = DriveForm(toy, settings)  # type: ignore[arg-type]
    rival = DriveForm(other, settings, name="finer", beside=own)  # type: ignore[arg-type]
    found = search([own, rival], settings.most_refits, settings.most_terms, settings.window)
    best = {n: max(h.log_posterior for h in found.hypotheses if h.form == n) for n in (own.name, "finer")}
    assert best["finer"] == pytest.approx(best[own.name], abs=0.1)


def test_a_law_whose_own_refit_failed_is_asked_no_further(monkeypatch):
    settings = DriveSettings()
    toy, other = Toy({"a": 0.5, "lag": 0.7}), Toy({})
    other.observations = toy.observations
    own = DriveForm(toy, settings)  # type: ignore[arg-type]
    rival = DriveForm(other, settings, name="finer", beside=own)  # type: ignore[arg-type]

    def diverges(*_args, **_kwargs):
        raise EvidenceError("a rover's simulation diverged")

    monkeypatch.setattr(rival._own, "approach", diverges)
    found = search([own, rival], settings.most_refits, settings.most_terms, settings.window)
    assert conclude(found, settings.sure).effects == ("lag",)
    assert found.failed == ("finer: a rover's simulation diverged",)


@pytest.mark.parametrize(
    ("preset", "laws", "refused"),
    [
        ("paper", "stress_integral", "has no use"),
        ("consistent", "foo", "is not known"),
        ("consistent", "stress_integral", ""),
        ("field", "stress_integral", ""),
    ],
)
def test_rival_laws_go_with_the_closed_form(monkeypatch, preset: str, laws: str, refused: str):
    """Refused where there is nothing to compete with; an integral that is in the model already has no rival."""
    toy: Any = Toy({})
    toy.effects, toy.not_tested, toy.unused = {}, (), ""
    monkeypatch.setattr(loop, "DriveProblem", lambda *args, **more: toy)
    run: Any = SimpleNamespace(
        model=make_model("luvmi_x", terrain="flat", preset=preset),
        settings={"laws": laws},
        splits={},
        discrepancy={},
        load=lambda name: None,
    )
    if refused:
        with pytest.raises(UserError, match=refused):
            loop.build_drives(run, [], candidates={}, rivals=True)
        return
    forms = loop.build_drives(run, [], candidates={}, rivals=True).forms
    assert [f.late for f in forms] == ([False, True] if preset == "consistent" else [False])
    assert len(loop.build_drives(run, [], candidates={}).forms) == 1, "whoever only compares pays for no rival"


@pytest.mark.parametrize(("everywhere", "verdict"), [(True, Verdict.KNOWN), (False, Verdict.UNDECIDABLE)])
def test_a_name_has_to_help_drives_that_chose_nothing(everywhere: bool, verdict: Verdict):
    """An effect of all drives is named; one that only the fitted ones show is taken back."""
    toy = Toy({"drag": 0.9})
    if not everywhere:
        held = toy.observations.in_split("select")
        without = Toy({}).observations.value
        toy.observations = dataclasses.replace(toy.observations, value=np.where(held, without, toy.observations.value))
    form, found, said = asked(toy)
    assert (said.verdict, said.effects) == (Verdict.KNOWN, ("drag",)), said.sentence
    problem = Problem((form,), {}, (), form.settings)
    held = account(gains_on_held_out(problem, found))
    assert held.units == 16
    after, sentence = _held_to_account(said, said.sentence, held, 0.95)
    assert after.verdict is verdict
    assert (after.effects, "not named" in sentence) == ((("drag",), False) if everywhere else ((), True))
    assert _held_to_account(said, said.sentence, held, 0.0) == (said, said.sentence)


def test_what_is_held_out_is_predicted_with_the_same_errors_with_and_without_a_name():
    """How large errors are taken to be is nothing that an effect predicts: those of the better model are for both.

    Here the refit with the effect takes held-out readings to be ten times as good as they are. By errors of its own it
    would lose what it gains.
    """
    form, found, _ = asked(Toy({"drag": 0.9}))
    problem = Problem((form,), {}, (), form.settings)
    before, present = gains_on_held_out(problem, found), form.errors
    best, base = found.best.refit, found.base(form.name).refit
    ended = form._refits.ended
    end = ended[best.effects, best.u.tobytes()]
    seen = end.errors.plain
    held = seen.in_split("select")
    series = [dataclasses.replace(x, white=0.1 * x.white, chain=None) if held[x.start] else x for x in seen.series]
    fine = dataclasses.replace(seen, series=tuple(series))
    sure = dataclasses.replace(end.errors, plain=fine, single=0.0, log_ratio=0.0)
    ended[best.effects, best.u.tobytes()] = dataclasses.replace(end, errors=sure)
    linear = form.under_errors_of(best, best)
    term = dataclasses.replace(found.best, refit=dataclasses.replace(best, linear=linear))
    own = sum(linear.log_score(n, *linear.evidence(found.best.terms)[1:]) for n in linear.held_out)
    plain = sum(base.linear.log_score(n, *base.linear.evidence(frozenset())[1:]) for n in base.linear.held_out)
    assert own < plain, "each by its own errors"
    too_sure = dataclasses.replace(found, hypotheses=(term, *found.hypotheses[1:]))
    assert np.all(gains_on_held_out(problem, too_sure) > 0.0)
    assert np.all(before > 0.0)
    assert form.errors is present


@pytest.mark.parametrize(
    ("gains", "by_chance", "helps"),
    [
        # skewed, and all of them gains: by Student's t no more than 0.92
        ([200.0, 50.0, 30.0, 10.0, 4.0, 1.0, 1.0, 1.0], 2 / 2**9, True),
        # a large one carries the sum, and half of the flips carry it, too
        ([200.0, -50.0, 30.0, -40.0, 4.0, -1.0, 1.0, -1.0], 103 / 2**8, False),
        ([3.0, -2.0, 1.0], 3 / 2**3, False),
        ([1.0, 2.0], 1 / 2**2, True),
        ([-1.0, 2.0], 2 / 2**2, False),
    ],
)
def test_gains_on_held_out_pieces_are_held_against_flips_of_their_signs(gains, by_chance, helps):
    """A name helps where no more than one flip of signs in twenty leads as far, or where all of few pieces gain."""
    found = account(np.array(gains))
    flips = np.array(list(itertools.product([1.0, -1.0], repeat=len(gains)))) @ gains
    assert found.by_chance == pytest.approx(np.mean(flips >= sum(gains) - 1e-9)) == pytest.approx(by_chance)
    assert found.helps(0.95) is helps


def test_a_descent_draws_far_amplitudes_as_students_t_does():
    form = DriveForm(Toy({"drag": 0.9}), DriveSettings())  # type: ignore[arg-type]
    std, u = np.ones(len(form.coordinates)), form.origin()
    (drag,) = form.candidates["drag"]
    assert np.array_equal(form.effect_std(u, std, 1.0), std), "an effect at its null keeps its nominal width"
    u[drag] = 9.0
    # The slope of log(1 + a^2) is that of a Gaussian of variance (1 + a^2) / 2.
    assert form.effect_std(u, std, 1.0)[drag] == pytest.approx(np.sqrt(41.0))
    assert np.array_equal(form.effect_std(u, std, 0.0), std)
    assert np.array_equal(np.delete(form.effect_std(u, std, 1.0), drag), np.delete(std, drag))


def test_what_no_effect_does_is_unlisted_at_its_port():
    _, found, said = asked(Toy({"b": 0.4}, unlisted=1.2))
    assert (said.verdict, said.port) == (Verdict.UNKNOWN, LABEL), said.sentence
    assert 0.2 < found.best.evidence.tau[0] < 2.0


def test_a_refit_that_has_arrived_simulates_little():
    toy = Toy({"a": 0.3, "drag": 0.5})
    form, found, _ = asked(toy)
    before = toy.rows
    form.refit(found.best.effects, found.best.refit, None)
    # few at each size of errors that leads it, and at its end
    assert toy.rows - before < 13 * (len(DriveSettings().annealing) + 1)


def test_a_step_ends_at_a_bound_and_the_others_do_their_best():
    normal = np.array([[2.0, 0.9], [0.9, 1.0]])
    downhill = normal @ [3.0, -1.0]
    low, high = np.array([-1.0, -5.0]), np.array([1.0, 5.0])
    step = bounded_step(normal, downhill, np.zeros(2), low, high)
    assert step == pytest.approx([1.0, (downhill[1] - 0.9) / 1.0])
    assert bounded_step(normal, downhill, np.zeros(2), -10.0 * high, 10.0 * high) == pytest.approx([3.0, -1.0])


def test_columns_are_turned_so_that_few_are_left():
    columns = RNG.standard_normal((50, 2)) @ RNG.standard_normal((2, 6))
    turned = columns @ rotation(columns, 1e-6)
    assert turned.shape == (50, 2)
    np.testing.assert_allclose(turned @ turned.T, columns @ columns.T, atol=1e-8)


def test_fields_are_relative_to_what_is_usual():
    assert USUAL.size("command: motor current", "current") == pytest.approx(DRIVEN)  # a fifth of a gain
    assert USUAL.size("motor_torque", "direction") == pytest.approx(DRIVEN * 0.4)
    assert USUAL.size("motor_torque", "squared joint speed") == pytest.approx(DRIVEN * 0.4 * 4.0 / 2.0**2)
    assert USUAL.size("soil: stiffness", "slip") == pytest.approx(1.0)


def test_a_usual_current_is_what_acts_at_one_wheel():
    """A motor of a side drives two wheels; jerks are not usual, and readings that are noise alone tell no current."""
    time, rng = np.arange(400) * 0.05, np.random.default_rng(3)
    names = ("motor_left_drive_current_A", "motor_rf_drive_current_A", "joint_rf_drive_speed_rad_s")
    values = (6.0 * np.sign(np.sin(time)), 3.0 + 0.5 * rng.standard_normal(400), np.full(400, 9.0))
    values[1][::20] = 200.0

    def acting(scale: float) -> float:
        series = tuple(Series(0, c, 400 * i, 400 * (i + 1), time, 0.3, 0.4, 1.0) for i, c in enumerate(names))
        unit, split = np.zeros(1200, int), ("fit",)
        observations = Observations(scale * np.concatenate(values), series, ("a",), split, unit, split, ("a",))
        return acting_current(observations, {"left": 2})

    assert acting(1.0) == pytest.approx(3.0, rel=0.05)
    assert acting(0.1) == 0.0


def test_an_effect_is_as_large_as_the_rover_asks_for():
    """A friction that is usual for a small rover's drives is nothing to those of a large one."""
    form = DriveForm(Toy({}), DriveSettings())  # type: ignore[arg-type]
    torque = Coordinate("drag", "torque", 0.0, 0.1, 0.0, 50.0, unit="N m", amplitude=True)
    assert form.effect_size(torque) == pytest.approx(USUAL.drawbar_torque / 0.1)
    assert form.effect_size(dataclasses.replace(torque, scale=10.0)) == 1.0  # never less than is nominal
    damping = dataclasses.replace(torque, scale=0.01, unit="N m s/rad")
    assert form.effect_size(damping) == pytest.approx(USUAL.drawbar_torque / USUAL.speed / 0.01)
    assert form.effect_size(dataclasses.replace(torque, unit="rad")) == 1.0


class Hurried(Toy):
    """A toy whose time is over when some effect is first moved, or in the refit after so many calls."""

    late: str = ""
    refits_too = False

    def predict(self, u):
        (place,) = self.candidates[self.late] if self.late else (0,)
        if self.late and np.any(np.atleast_2d(u)[:, place]):
            raise TimeUp
        return super().predict(u)

    def jacobian(self, u, which, side=1, steps=None):
        if self.refits_too and len(which) > len(self.baseline) + len(self.inputs[LABEL]):
            raise TimeUp
        return super().jacobian(u, which, side, steps)


def test_candidates_without_time_are_skipped_and_told(monkeypatch):
    monkeypatch.setattr(signatures, "DRIVE_REFIT", dataclasses.replace(signatures.DRIVE_REFIT, together=1))
    toy = Hurried({"a": 0.5, "drag": 0.9})
    toy.late = "lag"
    form, _, said = asked(toy)
    assert form.skipped == ("lag",)
    assert said.effects == ("drag",)
    told, sentence = _without(said, said.sentence, form.skipped)
    assert (told.verdict, told.effects) == (Verdict.UNDECIDABLE, ())
    assert sentence.startswith("Of what was looked at: drag is missing")
    assert "lag; give more --seconds" in sentence
    quiet, _ = _without(asked(Toy({"a": 0.5}))[2], "Nothing.", form.skipped)
    assert quiet.verdict is Verdict.NOISE_ONLY


def test_a_refit_without_time_leaves_the_linear_estimate():
    toy = Hurried({"a": 0.5, "drag": 0.9})
    toy.refits_too = True
    _, found, said = asked(toy)
    assert not found.complete
    assert found.refits == 1
    assert said.effects == ("drag",), "the linear estimate tells it, too"
    refitted = [h.effects for h in found.hypotheses if h.refitted]
    told, sentence = _unrefitted(said, said.sentence, refitted, frozenset())
    assert (told.verdict, told.effects) == (Verdict.UNDECIDABLE, ())
    assert sentence.startswith("A first-order estimate points to drag. No refit with it was made")
    assert "%" not in sentence and "is missing" not in sentence
    refitted.append(frozenset({"drag", "lag"}))
    assert _unrefitted(said, said.sentence, refitted, frozenset({"lag"})) == (said, said.sentence)
    # beside something unlisted it is no name either, and the port stands
    both = ("drag", "lag")
    beside = Conclusion(Verdict.UNKNOWN, both, True, "soil", 0.99, "It acts at soil." + helps(both), helping=both)
    assert beside.sentence.endswith(" Beside it drag and lag help.")
    told, sentence = _unrefitted(beside, beside.sentence + " More.", [frozenset({"lag"})], frozenset())
    assert (told.verdict, told.effects, told.port) == (Verdict.UNKNOWN, ("lag",), "soil")
    # what a refit has held is still said to help
    assert sentence.startswith("It acts at soil. Beside it lag helps. A first-order estimate points to drag beside it,")
    assert sentence.endswith(" More.")


@pytest.mark.parametrize(
    ("waiting", "unseen", "why"),
    [
        (frozenset({"lag", "drag"}), False, "drag, lag gained beside the model within a few steps, and had no refit"),
        (frozenset(), True, "What effects gain beside the best refit was not looked at"),
    ],
)
def test_nothing_unlisted_is_believed_before_what_was_seen_to_gain_had_its_refit(waiting, unseen, why):
    said = Conclusion(Verdict.UNKNOWN, ("a",), True, "soil", 0.99, "It acts at soil." + helps(("a",)), helping=("a",))
    found = SimpleNamespace(waiting=waiting, unseen=unseen)
    told, sentence = _unlooked(said, said.sentence, found)  # type: ignore[arg-type]
    assert (told.verdict, told.effects, told.unlisted, told.probability) == (Verdict.UNDECIDABLE, (), False, 0.0)
    assert sentence.startswith("By what was refitted: It acts at soil.") and why in sentence
    assert _unlooked(said, said.sentence, SimpleNamespace(waiting=frozenset(), unseen=False)) == (said, said.sentence)
    quiet = Conclusion(Verdict.NOISE_ONLY, (), False, None, 0.99, "Nothing is missing.")
    assert _unlooked(quiet, quiet.sentence, found) == (quiet, quiet.sentence)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [("annealing", "", ()), ("noise_freedoms", "0", (0.0,)), ("error_times_s", "1,3,10", (1.0, 3.0, 10.0))],
)
def test_levels_that_are_tried_are_as_many_as_one_likes(name, text, value):
    assert getattr(DriveSettings.of({name: text}), name) == value


class Stopped(Toy):
    """A toy whose time can be over."""

    over = False

    def predict(self, u):
        if self.over:
            raise TimeUp
        return super().predict(u)


def test_a_name_without_its_challenge_is_none():
    """A refit goes on where that without the effect had stopped: until both have, the effect has earned nothing."""
    toy = Stopped({"a": 0.5, "drag": 0.9})
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    refit = form.refit

    def hurried(effects, near, start):
        toy.over = not effects and near is not None
        try:
            return refit(effects, near, start)
        finally:
            toy.over = False

    form.refit = hurried  # type: ignore[method-assign]
    settings = form.settings
    found = search([form], settings.most_refits, settings.most_terms, settings.window)
    assert not found.complete and found.refits == 2
    assert found.unchallenged == {"drag"}, "a challenge that was cut is none"
    problem = Problem((form,), dict.fromkeys(form.candidates, CATALOGUE["slip_sinkage"]), (), settings)
    said = _diagnosis(problem, found, found.best)
    assert (said.verdict, said.effects) == (Verdict.UNDECIDABLE, ())
    assert said.sentence.startswith(
        "A refit points to drag. From where it ended none was made without drag, so nothing"
    )


def test_an_estimate_is_no_name_where_candidates_were_skipped_as_well(monkeypatch):
    monkeypatch.setattr(signatures, "DRIVE_REFIT", dataclasses.replace(signatures.DRIVE_REFIT, together=1))
    toy = Hurried({"a": 0.5, "drag": 0.9})
    toy.late, toy.refits_too = "lag", True
    form, found, _ = asked(toy)
    problem = Problem((form,), dict.fromkeys(form.candidates, CATALOGUE["slip_sinkage"]), (), form.settings)
    said = _diagnosis(problem, found, found.best)
    assert (said.verdict, said.effects) == (Verdict.UNDECIDABLE, ())
    assert "A first-order estimate points to drag" in said.sentence and "lag; give more --seconds" in said.sentence
    assert "is missing" not in said.sentence
    assert said.probability == 0.0 and "drag" not in said.inclusion
    drag = next(e for e in said.evidence if e.effect == "drag")
    assert drag.status == "not refitted" and np.isnan(drag.probability)
    about = explain(said, "drag")
    assert about.verdict is Verdict.UNDECIDABLE and about.sentence.startswith("No refit with drag was made")


def test_without_time_for_the_model_as_it_is_nothing_is_said():
    toy = Hurried({"a": 0.5})
    toy.jacobian = _over
    with pytest.raises(TimeUp):
        asked(toy)


def _over(u, which, side=1, steps=None):
    raise TimeUp


def test_a_deadline_ends_what_needs_longer():
    Deadline().check(1e9)
    Deadline(60.0).check(1.0)
    with pytest.raises(TimeUp):
        Deadline(60.0).check(61.0)
    with pytest.raises(TimeUp):
        Deadline(-1e-3).check()


def test_a_little_of_everything_is_no_name():
    """Every rover has some of each effect; sixty sigma of it are explained and not named, however few the logs."""
    toy = Toy({"a": 0.4, "drag": 0.06, "lag": 0.05})
    _, found, said = asked(toy)
    assert said.verdict is Verdict.NOISE_ONLY, said.sentence
    base = found.base("the model")
    (field,) = [i for i, f in enumerate(base.refit.linear.fields) if f.name == USUAL_EFFECTS]
    assert 0.01 < base.evidence.tau[field] < 0.3


def test_a_refit_begins_at_a_similar_one_wherever_an_estimate_leads():
    """A linear estimate may be absurd from afar: on the plateau where `drag` is 20 nothing leads back."""
    form = DriveForm(Toy({"a": 0.8, "b": -0.4, "drag": 3.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    absurd = base.u.copy()
    absurd[:3] = 4.0, 0.0, 20.0
    drag = frozenset({"drag"})
    for near, start in ((base, absurd), (base, None), (None, form.refit(drag, base, None).u)):
        refit = form.refit(drag, near, start)
        assert refit.u[:3] == pytest.approx([0.8, -0.4, 3.0], abs=0.3)


def test_what_is_learnt_beside_the_parameters_can_be_compared_between_settings():
    """Tails of the noise are found where there are some; saying that it has none costs evidence."""
    toy = Toy({"a": 0.4})
    jolts = 6.0 * np.random.default_rng(9).standard_normal(LOGS * SAMPLES) * (np.arange(LOGS * SAMPLES) % 10 == 0)
    toy.observations = dataclasses.replace(toy.observations, value=toy.observations.value + jolts)
    found = []
    for freedoms in (DriveSettings().noise_freedoms, (0.0,)):
        form = DriveForm(toy, dataclasses.replace(DriveSettings(), noise_freedoms=freedoms))  # type: ignore[arg-type]
        found.append(form.learnt(form.refit(frozenset(), None, None)))
    assert set(found[0]["channel_errors"]) == {"y"}
    assert found[0]["log_evidence"] > found[1]["log_evidence"] + 10.0


class Jumping(Toy):
    """A toy of which one reading jumps by a tenth of a sigma just above a place, as where a wheel at rest slips."""

    edge = np.inf

    def predict(self, u):
        out = super().predict(u)
        out[:, 7] += 0.1 * (np.atleast_2d(u)[:, 0] > self.edge)
        return out


def test_a_jump_within_the_step_of_a_derivative_is_no_slope():
    toy = Jumping({"a": 0.3})
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    place, free = form.origin(), form.baseline
    smooth = form.jacobian(place, free)[1]
    toy.edge = place[0] + 1e-9
    assert abs(toy.jacobian(place, free)[1][7, 0] - smooth[7, 0]) > 1e4
    np.testing.assert_allclose(form.jacobian(place, free)[1], smooth, atol=1e-3)


class Stumbling(Toy):
    """A toy of which every tenth reading jumps by ten sigma, to and fro over a hundredth of a scale."""

    later = 0.0

    def predict(self, u):
        out, at = super().predict(u), np.arange(len(SHAPES[0]) // 10)
        out[:, ::10] += 10.0 * np.sign(np.sin(3e2 * np.atleast_2d(u)[:, :1] + at + self.later))
        return out


def test_readings_that_are_far_off_have_errors_of_their_own():
    toy = Stumbling({"a": 1.5, "b": -0.8})
    # no place has these
    signs = np.random.default_rng(3).choice([-1.0, 1.0], LOGS * SAMPLES)
    jolts = 15.0 * signs * (np.arange(LOGS * SAMPLES) % 29 == 7)
    toy.observations = dataclasses.replace(toy.observations, value=toy.observations.value + jolts)
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    off = np.abs(form.told(base.u)) > 5.0
    assert 0 < np.sum(off) < 0.1 * len(off)
    wider = form.observations.sigma() / toy.observations.sigma()
    assert np.min(wider[off]) > 2.0 > 1.2 > np.median(wider[~off])
    plain = DriveForm(toy, DriveSettings(noise_freedoms=(0.0,)))  # type: ignore[arg-type]
    without = plain.refit(frozenset(), None, None)
    # By itself its end explains as much as the end where readings do not jump. It need not be that: from place to place
    # a tenth of the readings have other jumps of ten sigma, so that there are many such ends.
    calm = DriveForm(Toy({"a": 1.5, "b": -0.8}), DriveSettings()).refit(frozenset(), None, None)  # type: ignore[arg-type]
    assert np.max(np.abs(base.u[:2] - calm.u[:2])) < 0.5

    def explains(u):
        own, free = form._own, form._own.prior.places.free()
        own.errors.forget(toy.observations)
        slopes = own.signatures.look(u, free)
        return own.held(u, free, slopes, own.settle(u, free, slopes, None, True)[1], True)[0]

    assert explains(base.u) > explains(calm.u) - 10.0

    def usual_width(form, refit):
        noise = refit.linear.evidence(frozenset())[1].noise[form._errors.group]
        return np.median((noise * form.observations.sigma() / toy.observations.sigma())[~off])

    # normal noise has to be wide for all readings, where a few are far off
    assert usual_width(plain, without) > 2.0 * usual_width(form, base)


def test_a_descent_is_led_by_sizes_that_are_usual_at_most():
    """With sizes that it finds on its way it would be held by nothing that it has wandered to."""
    form = DriveForm(Toy({"a": 1.5}, unlisted=1.0), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    found = base.linear.evidence(frozenset())[1]
    usual = form._own.prior.fields.usual
    assert np.max(found.tau / usual) > 3.0
    assert form._refits.base is not None
    assert np.all(form._refits.base.sizes[0] <= usual)
    np.testing.assert_allclose(form._own.prior.fields.led_by((found.tau, found.noise))[0], np.minimum(found.tau, usual))


class Turning(Toy):
    """A toy whose drag comes back to nothing at the amount over which secants are taken."""

    def predict(self, u):
        far = DriveSettings().secant * DriveSettings().effect_size
        u = np.atleast_2d(u).copy()
        u[:, 2] = np.where(np.abs(u[:, 2]) <= far, far / np.pi * np.sin(np.pi * u[:, 2] / far), u[:, 2])
        return super().predict(u)


class Deaf(Toy):
    """A toy whose drag does nothing below a thousandth of its nominal size."""

    def predict(self, u):
        u = np.atleast_2d(u).copy()
        u[:, 2] = np.sign(u[:, 2]) * np.maximum(np.abs(u[:, 2]) - 1e-3, 0.0)
        return super().predict(u)


@pytest.mark.parametrize("kind", [Turning, Deaf])
def test_an_effect_shows_by_its_derivative_or_by_a_usual_amount_of_it(kind):
    """Each of the two alone tells nothing of one of these toys."""
    form = DriveForm(kind({"drag": 1.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    drag = next(t for t in form.terms if t.name == "drag")
    shown, nothing = (base.linear.evidence(form.listed(e))[0] for e in (frozenset({drag.name}), frozenset()))
    assert shown > nothing + 5.0


class Coupled(Toy):
    """A toy whose drag is another one where a parameter is another one."""

    def predict(self, u):
        u = np.atleast_2d(u).copy()
        u[:, 2] *= 1.0 + u[:, 0]
        return super().predict(u)


def test_signatures_are_those_of_where_the_refit_has_ended():
    toy = Coupled({"a": 1.5, "b": -0.8})
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    there = form.jacobian(base.u, np.array([2]))[1][:, 0]
    seen = form._own.design.seen[:, 2]
    # a secant is up to a fifth shorter, as the toy's drag saturates; where the refit began both have two fifths of that
    assert seen @ there / (there @ there) == pytest.approx(0.9, abs=0.13)


def test_a_jump_at_nothing_of_an_effect_is_no_slope():
    form = DriveForm(Toy({}), DriveSettings())  # type: ignore[arg-type]
    slopes, secants = np.ones((len(form.observations), 1)), np.ones((len(form.observations), 1))
    slopes[7] = 1e6
    found = form._signatures._tamed(np.array([2]), slopes, secants)[0]
    assert found[7] == 1.0
    assert np.all(found == 1.0)


def test_a_refit_that_was_kept_is_not_made_again():
    toy = Toy({"a": 1.5, "b": -0.8, "drag": 1.0}, unlisted=2.0)
    first = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    base = first.refit(frozenset(), None, None)
    learnt, rows = first.learnt(base), toy.rows
    again = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    again.start, again.kept = base.u, learnt
    toy.rows = 0
    other = again.refit(frozenset(), None, None)
    assert toy.rows < 0.6 * rows
    np.testing.assert_allclose(other.u, base.u, atol=0.1)
    told = again.learnt(other)
    assert told["log_evidence"] == pytest.approx(learnt["log_evidence"], abs=1.0)
    assert {k: told[k] for k in LEARNT} == {k: learnt[k] for k in LEARNT}


def test_a_refit_with_errors_that_are_tried_no_more_is_made_again():
    form = DriveForm(Toy({"a": 1.5}), DriveSettings())  # type: ignore[arg-type]
    channel = form.observations.series[0].channel
    form.kept = {"channel_errors": {channel: 0.07}, "error_times_s": {channel: 1.0}}
    assert form.refit(frozenset(), None, None).u[0] == pytest.approx(1.5, abs=0.3)
    assert not form.kept


@pytest.mark.parametrize("truth", [{"a": 1.5, "b": -0.8}, {"drag": 2.0}])
def test_the_model_alone_predicts_no_worse_than_as_given_or_refitted(truth):
    """Something unlisted as large as this a refit leaves to its port."""
    form = DriveForm(Toy(truth, unlisted=1.0), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    fitted = form.observations.in_split("fit")

    def error(u):
        return np.sqrt(np.mean(form.told(u)[fitted] ** 2))

    refitted, alone = error(form.bare(base.u)), error(form.alone(base))
    assert alone <= refitted + 1e-3
    assert alone <= error(form.origin()) + 1e-3
    assert alone < refitted - 1e-3 or alone < error(form.origin()) - 1e-3


def test_a_secant_speaks_of_amounts_as_large_as_its_own_alone():
    """Where little of an effect is asked for, its slope stands: a secant beside it would be one more freedom."""
    form = DriveForm(Toy({"drag": 0.02}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    slope, secant = (form.jacobian(base.u, np.array([2]))[1][:, 0], form._signatures.secants[:, 2])
    assert np.linalg.norm(secant) < 0.95 * np.linalg.norm(slope)
    np.testing.assert_allclose(form._own.design.seen[:, 2], slope, rtol=1e-3)


def test_no_estimate_goes_beyond_what_a_parameter_can_be():
    """A base that is held by a bound is as bad as its bound makes it, and what a slope beyond promises is nothing."""
    toy = Toy({"a": 1.5})
    toy.coordinates = (dataclasses.replace(toy.coordinates[0], low=-1.0, high=1.0), *toy.coordinates[1:])
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    assert base.u[0] == pytest.approx(1.0, abs=1e-6)
    free = DriveForm(Toy({"a": 1.5}), DriveSettings())  # type: ignore[arg-type]
    bound, unbound = (f.learnt(f.refit(frozenset(), None, None))["log_evidence"] for f in (form, free))
    assert bound < unbound - 5.0


def test_an_effect_is_credited_with_what_its_refit_has_reached():
    """What slopes promise beyond a place that no step could leave is nobody's."""
    form = DriveForm(Toy({"a": 1.5, "drag": 1.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    drag = frozenset({"drag"})
    refit = form.refit(drag, base, None)
    assert 0.0 <= refit.linear.unkept < form.settings.settled
    away = refit.u + np.eye(len(refit.u))[0]
    slopes = form.jacobian(away, form._own.prior.places.free(drag))[1]
    linear = form._refits.linearised
    around = linear.around(away, drag, slopes)
    lavish, plain = (dataclasses.replace(around, unkept=k).evidence(form.listed(drag))[0] for k in (7.0, 0.0))
    assert lavish == pytest.approx(plain - 7.0)


def test_what_is_usual_has_none_of_an_effect_that_was_refitted():
    form = DriveForm(Toy({"drag": 1.0}), DriveSettings())  # type: ignore[arg-type]
    form.refit(frozenset(), None, None)
    usual, design = form._own.prior.fields.number[USUAL_EFFECTS], form._own.design
    drag = design.seen[:, 2]

    def left(effects: frozenset[str]) -> float:
        """Share of the effect's signature that the columns of usual effects cannot give."""
        columns, number = design.fields(design.seen[:, form.discrepancy], effects)
        mine = columns[:, number == usual]
        return float(np.linalg.norm(drag - mine @ np.linalg.lstsq(mine, drag, rcond=None)[0]) / np.linalg.norm(drag))

    assert left(frozenset()) < 1e-6
    assert left(frozenset({"drag"})) > 0.9


def test_a_run_s_record_holds_every_setting():
    """A setting that JSON cannot tell would be read back as another one, or refused."""
    told = json.loads(json.dumps(dataclasses.asdict(DriveSettings()), allow_nan=False))
    assert DriveSettings.of(told) == DriveSettings()


def test_a_place_counts_by_what_it_explains_itself():
    """Slopes promise the truth from afar, and errors as small as there; what is held there asks for larger ones."""
    toy = Toy({"a": 1.5, "b": -0.8})
    toy.candidates = {}
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    base, own = form.refit(frozenset(), None, None), form._own
    free = own.prior.places.free()
    told = {}
    for name, u in (("truth", base.u), ("afar", base.u + np.where(np.arange(len(base.u)) < 2, 1.0, 0.0))):
        slopes = own.signatures.look(u, free)
        learnt, sizes = own.settle(u, free, slopes, None, True)
        present = form.errors
        value, asked, asked_sizes = own.held(u, free, slopes, sizes, True)
        assert form.errors is present
        widths = [e.observations.sigma() * s[1][0] for e, s in ((asked, asked_sizes), (present, sizes))]
        told[name] = value, learnt.log_evidence, np.median(widths[0] / widths[1])
    assert told["truth"][0] > told["afar"][0] + 100.0
    assert told["truth"][1] < told["afar"][1] + 20.0
    assert told["truth"][2] == pytest.approx(1.0, abs=0.2) and told["afar"][2] > 1.5


def test_a_place_of_which_nothing_can_be_told_is_not_gone_to(monkeypatch):
    """Where slopes are too steep to compute with, the way there is shortened."""
    toy = Toy({"a": 1.5, "b": -0.8})
    toy.candidates = {}
    form = DriveForm(toy, DriveSettings(annealing=()))  # type: ignore[arg-type]
    looked, settle = [], OwnRefit.settle

    def steep(self, u, *rest):
        looked.append(u)
        if len(looked) == 3:
            raise EvidenceError("derivatives are too steep to compute with")
        return settle(self, u, *rest)

    monkeypatch.setattr(OwnRefit, "settle", steep)
    base = form.refit(frozenset(), None, None)
    np.testing.assert_allclose(looked[3], looked[1] + 0.3 * (looked[2] - looked[1]))
    assert base.u[:2] == pytest.approx([1.5, -0.8], abs=0.3)
    assert not np.allclose(base.u, looked[2], atol=1e-6)
