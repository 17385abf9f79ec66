"""An answer is there when its time is over, with what comes after the search."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from lunar_mjx.diagnosis.weighed import answer
from lunar_mjx.diagnosis.weighed.form import SearchSettings
from lunar_mjx.inference.deadline import TimeUp


@pytest.mark.parametrize(("writing", "end"), [(0.0, 110.0), (4.0, 80.0)])
def test_a_search_leaves_time_for_what_comes_after_it(writing, end, monkeypatch):
    """Of 120 s, with refits of 10 s: a tenth, or the last refit and four times as long as one."""
    clock = [7.0]

    def search(forms, most_refits, most_terms, window, progress, stop, *_):
        clock[0] += 20.0  # the model as it is, and with what is exchanged
        while not stop():
            clock[0] += 10.0
        raise TimeUp

    monkeypatch.setattr(answer, "search", search)
    monkeypatch.setattr(answer.time, "monotonic", lambda: clock[0])
    form = SimpleNamespace(limit=lambda until: None, exchanged=("soft_ground",), late=False, writing=writing)
    question = SimpleNamespace(forms=(form,), own=form, settings=SearchSettings())
    answer.diagnose(None, question, lambda text, share: None, 120.0)
    assert clock[0] - 7.0 == end
