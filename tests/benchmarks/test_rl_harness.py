"""What the learning benchmarks share: agents side by side, the best policy of a training, and what is kept."""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from pathlib import Path

import pytest

from lunar_mjx.agents.evaluate import Judge, evaluate
from lunar_mjx.envs import make, make_agent

SMALL = ["envs=4", "epoch_steps=8", "batch=8", "buffer_steps=64", "random_steps=4", "updates=1"]


@pytest.fixture(scope="module", autouse=True)
def harness():
    folder = str(Path(__file__).parents[2] / "benchmarks" / "rl")
    sys.path.insert(0, folder)
    import harness

    yield harness
    sys.path.remove(folder)


@pytest.fixture
def trials(harness, tmp_path):
    """Trials of the task without physics, scored on its own ground after every epoch."""
    from trials import Trials

    told = {"training": "point", "out": tmp_path, "name": "", "begin_with": "", "stop_at": math.inf, "episodes": 4}
    times = {"steps": 96, "seed_seconds": 60.0, "last": 0.0, "every": 0.0}
    args = argparse.Namespace(rover=None, unseen_terrain=None, set=SMALL, env=[], **told, **times)
    rules = {"scripted": make_agent("scripted", make("point"))}
    return Trials(args, harness.training_of(args, "point"), harness.Clock(60.0), lambda _: rules, "seen")


def test_agents_side_by_side_score_as_each_alone():
    env = make("point")
    rules = {name: make_agent(name, env) for name in ("zero", "scripted")}
    found = Judge(env, 8, {}, rules)(env.params, (), 3)
    assert found == {name: evaluate(env, rule, 8, 3).record() for name, rule in rules.items()}
    assert found["zero"]["success"] < found["scripted"]["success"]


def test_the_best_policy_of_a_training_is_chosen_and_a_good_one_ends_it(trials, monkeypatch):
    shares = []

    def scored(params, policy, seed):
        share = shares.pop(0) if params is trials.setup.env.params else 0.0
        return {"policy": {"success": share, "low": 0.0, "high": 1.0, "spl": None, "ends": {}}}

    trials.setup.unseen = object()
    monkeypatch.setattr(trials, "during", scored)
    monkeypatch.setattr(trials, "judge", scored)
    shares[:] = 0.2, 0.9, 0.5
    trials(0)
    (run,) = trials.record["seeds"]
    assert [s["steps"] for s in run["scores"]] == [32, 64, 96] and run["final"]["steps"] == 64
    trials.args.stop_at, shares[:] = 0.9, (0.2, 0.9, 0.5)
    trials(1)
    assert trials.record["seeds"][1]["epochs"][-1]["steps"] == 64
    trials.args.every, shares[:] = math.inf, ()
    trials(2)
    run = trials.record["seeds"][2]
    assert run["scores"] == [] and run["final"]["steps"] == run["epochs"][-1]["steps"] == 96


def test_a_job_that_would_be_cut_short_is_not_begun(harness, capsys):
    class Clock:
        spent, left = 0.0, 10.0

    done = []
    for job in harness.in_time(Clock, ("a", "b", "c")):
        done.append(job)
        Clock.spent += 4.0
        Clock.left -= 4.0
    assert done == ["a", "b"] and "no time for c: 2 s left" in capsys.readouterr().out


def test_what_is_kept_of_a_record_has_few_digits_and_few_columns():
    from kept import rounded

    epoch = {"steps": 1, "elapsed_s": 1.23456789, "loss": 3.0}
    final, unseen = {"seed": 1, "rows": {"policy": {"success": 1.0 / 3.0}}}, [{"success": 1.0, "ends": {}}]
    record = {"rows": [{"loss": 1.0}], "seeds": [{"seed": 0, "epochs": [epoch], "unseen": unseen, "final": final}]}
    assert rounded(record) == {
        "rows": [{"loss": 1.0}],
        "seeds": [
            {
                "seed": 0,
                "epochs": [{"steps": 1, "elapsed_s": 1.2346}],
                "unseen": [{"success": 1.0}],
                "final": {"seed": 1, "rows": {"policy": {"success": 0.33333}}},
            }
        ],
    }


def test_a_training_scored_on_its_own_ground_is_kept_as_figures_read_it(harness, trials, tmp_path):
    from kept import keep

    from lunar_mjx.agents.policy import load_policy

    trials.record |= {"rover": "none", "target": 0.0, "untrained": {"success": 0.0}}
    trials(3)
    record = harness.read(keep([tmp_path / "point.json"], home=tmp_path))
    (run,) = record["seeds"]
    assert run["steps"] == 96 and [s["steps"] for s in run["unseen"]] == [r["steps"] for r in run["rows"]] == [
        32,
        64,
        96,
    ]
    seen = harness.read(tmp_path / "point.json")["seeds"][0]["scores"]
    best = max(s["train"]["success"] for s in seen)
    assert run["kept"]["train_score"]["success"] == best and run["steps_to_target"] == 32
    assert load_policy(tmp_path / "point_seed3.npz").notes["steps"] == run["kept"]["steps"]
    assert list(record["agents"]) == ["untrained", "scripted"] and record["agents"]["scripted"]["episodes"] == 4


@pytest.mark.parametrize(("count", "left"), [(0, 0), (1, 1), (40, 40), (41, 21), (153, 39)])
def test_a_long_training_keeps_few_epochs_and_its_last(count, left):
    from kept import MOST_EPOCHS, few

    kept = few([{"steps": i} for i in range(count)])
    assert len(kept) == left <= MOST_EPOCHS and [e["steps"] for e in kept[-1:]] == [count - 1] * bool(count)
    assert len({b["steps"] - a["steps"] for a, b in itertools.pairwise(kept)}) <= 1
