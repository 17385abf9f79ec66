"""A sweep hands back one row per case, and none for twins whose noise replicates tell."""

from __future__ import annotations

import json

import pytest

from benchmarks.foreign import cases, sweep, work


@pytest.fixture
def answered(monkeypatch):
    def one(logs, out, extra):
        (out / "run").mkdir()
        verdict = {"verdict": "NOISE_ONLY", "effects": [], "inclusion": {"grousers": 0.01}, "probabilities": {"x": 1.0}}
        (out / "run" / "verdict.json").write_text(json.dumps(verdict), encoding="utf-8")
        assert (logs / "log.toml").is_file()
        return {"verdict": "NOISE_ONLY", "effects": [], "seconds": {"all": 1.0}, "extra": extra}

    monkeypatch.setattr(work, "one", one)


def test_twins_follow_their_case_and_have_names_of_their_own():
    jobs = sweep.jobs("tune", 5, 8, 4)
    names = [sweep._name(j) for j in jobs]
    whole = [n for n in names if n.count("-") == 1]
    assert names[:3] == ["tune-000", "tune-000-loud", "tune-000-quiet"] and len(set(names)) == len(names)
    assert whole == sorted(whole)
    assert len(names) - len(whole) == 2 * -(-len(whole) // 4)


def test_a_row_is_judged_against_its_truth(answered):
    jobs = [j for j in sweep.jobs("tune", 20261123, 12, 1) if j[3] == "null"]
    rows = [sweep.ask(j, {}) for j in jobs]
    case, twins = rows[0], [r for r in rows[1:] if r]
    assert case["verdict"] == "NOISE_ONLY" and not case["wrong_name"] and case["twin_of"] is None
    assert case["inclusion"] == {"grousers": 0.01}
    for twin in twins:
        if twin["twin_of"]:
            assert twin["truth"]["replicates"] == 1 and twin["case"].startswith(twin["twin_of"])


def test_two_effects_outside_the_catalogue_are_a_set_of_their_own():
    assert not any(group == cases.TWO_OUTSIDE for group, _ in cases.plan("report", 200))
    both = cases.plan("tune", 12, cases.TWO_OUTSIDE)
    assert len(both) == 12
    assert all(group == cases.TWO_OUTSIDE and len(set(hidden)) == 2 for group, hidden in both)
    case = cases.draw("tune", 5, 0, *both[0])
    assert set(case.world.effects) == set(case.hidden)
