"""Refits that begin together: the best one leads, and ends those that cannot rival it."""

from __future__ import annotations

import contextlib
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from lunar_mjx.diagnosis import refit as refits
from lunar_mjx.diagnosis.refit import Settings, refit_all
from lunar_mjx.inference.descent import Descent, Outdone
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.score import Score
from tests.inference.toy_problem import Linear, manoeuvres

DROPS = {"far": 500.0, "best": 900.0, "near": 800.0}


@contextlib.contextmanager
def _together(threads):
    left = []
    yield lambda: left.append(1)
    assert len(left) == threads


def test_what_falls_far_short_of_one_that_is_at_the_noise_is_left_meanwhile(monkeypatch):
    leading, ended, known = {}, {}, []
    leads, looked = threading.Event(), threading.Event()

    def one(problem, parent, effects, scored, memory, rival, start, eager, outdone):
        name = effects[-1]
        leading[name] = eager
        chi2 = 1000.0 - DROPS[name]
        at = Descent(np.zeros(0), np.zeros(0), np.zeros((0, 0)), chi2, 0.0)
        if name != "best":
            leads.wait()
        ended[name] = outdone(at)
        if name == "best":
            known.append(rival.chi2)
            leads.set()
            looked.wait()  # the others look before the best is done
        elif len(ended) == len(DROPS):
            looked.set()
        if ended[name]:
            raise Outdone
        return SimpleNamespace(
            effects=effects, fit=SimpleNamespace(chi2=chi2), noise=SimpleNamespace(passes=name == "best")
        )

    monkeypatch.setattr(refits, "refit", one)
    monkeypatch.setattr(refits, "scan", lambda *_: {})
    monkeypatch.setattr(refits, "Objective", lambda *_: None)
    monkeypatch.setattr(refits, "foreseen_fit", lambda *_: None)
    monkeypatch.setattr(refits, "noise_test", lambda *_: SimpleNamespace(passes=True))
    problem = SimpleNamespace(eager=True, cheap_jacobian=False, together=_together, free=lambda _: np.zeros(0, int))
    parent = SimpleNamespace(effects=(), fit=SimpleNamespace(chi2=1000.0, fitted=np.zeros(0, bool)))
    new = [Score(e, np.zeros((0, 1)), 10.0, 1.0, np.ones(1), drop, 9.0) for e, drop in DROPS.items()]
    found = refit_all(problem, parent, new, Settings(), Memory())  # type: ignore[arg-type]
    assert [c.effects for c in found] == [("best",), ("near",)]
    assert np.isfinite(known).all() and ended == {"best": False, "near": False, "far": True}
    assert leading == {"best": True, "near": False, "far": False}


def test_a_fit_that_is_outdone_is_left_before_its_next_step():
    observations = manoeuvres(3, 20)
    problem = Linear(np.linspace(0.0, 1.0, 60)[:, None], {}, observations)
    asked = []

    def outdone(_):
        asked.append(1)
        return len(asked) > 1

    start = np.array([5.0])
    with pytest.raises(Outdone):
        fit(problem, problem.free(), start, starts=1, outdone=outdone)
    assert len(asked) == 2
