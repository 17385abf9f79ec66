"""Where refits of drives begin, and what they are credited with."""

from __future__ import annotations

import numpy as np
import pytest

import lunar_mjx.diagnosis.drives.form as module
from lunar_mjx.diagnosis.drives.form import DriveForm
from lunar_mjx.diagnosis.drives.refitting import prior
from lunar_mjx.diagnosis.drives.refitting.own import OwnRefit
from lunar_mjx.diagnosis.drives.refitting.steps import bounded_step, promise_left, promised
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from tests.diagnosis.drives.test_drive_form import USUAL, Toy


@pytest.fixture(autouse=True)
def _no_rover(monkeypatch):
    monkeypatch.setattr(module, "usual_of", lambda drives: USUAL)


def test_a_refit_without_an_effect_begins_without_it():
    """Near a refit that has the effect, and fits better: a set is told by what it has, and by nothing beside."""
    form = DriveForm(Toy({"a": 0.8, "drag": 2.0}), DriveSettings())  # type: ignore[arg-type]
    base = form.refit(frozenset(), None, None)
    both = form.refit(frozenset({"drag", "lag"}), base, None)
    assert abs(both.u[2]) > 0.5
    less = form.refit(frozenset({"lag"}), both, both.u)
    assert less.u[2] == 0.0
    assert form.refit(frozenset(), both, both.u).u[2:5].tolist() == [0.0] * 3


def test_a_step_within_bounds_that_leads_uphill_is_no_promise():
    """A refit would else be credited with what a needless step would cost."""
    normal = np.array([[29.0, 23.0, -4.0], [23.0, 22.0, 3.0], [-4.0, 3.0, 27.0]])
    downhill, low, high = np.array([-4.0, 5.0, -8.0]), np.array([0.0, -2.0, 0.0]), np.array([3.0, 4.0, 4.0])
    within = normal, downhill, np.zeros(3), low, high
    assert promised(bounded_step(*within), normal, downhill) < -100.0
    assert promise_left(*within) == 0.0
    far = np.full(3, 1e9)
    best = downhill @ np.linalg.solve(normal, downhill)
    assert promise_left(normal, downhill, np.zeros(3), -far, far) == pytest.approx(best)


def test_a_refit_begins_where_its_effects_act(monkeypatch):
    """At its null an effect may have no slope, and the amount of an estimate may be absurd."""
    form = DriveForm(Toy({"a": 0.8}), DriveSettings())  # type: ignore[arg-type]
    base, begun, lead = form.refit(frozenset(), None, None), [], OwnRefit.lead
    monkeypatch.setattr(OwnRefit, "lead", lambda self, u, *a, **k: (begun.append(u[2:4]), lead(self, u, *a, **k))[1])
    far = base.u.copy()
    far[2] = 40.0
    form.refit(frozenset({"drag", "lag"}), base, far)
    assert begun[0].tolist() == [0.5 * form.effect_size(form.coordinates[i]) for i in (2, 3)]


def test_what_is_nothing_in_a_model_begins_where_it_acts(monkeypatch):
    """At zero it has no slope, and a descent would leave it there."""
    monkeypatch.setattr(prior, "FROM_NOTHING", {"base": {"b": (0.01, 5.0, 0.3)}})
    toy = Toy({"a": 0.8})
    assert toy.coordinates[1].start == 0.0
    form = DriveForm(toy, DriveSettings())  # type: ignore[arg-type]
    assert form.start.tolist() == [0.0, 0.5 * toy.coordinates[1].prior] + [0.0] * (len(toy.coordinates) - 2)
