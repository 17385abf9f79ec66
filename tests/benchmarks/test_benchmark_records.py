"""The records of the reinforcement learning benchmark: the page quotes them, and their parts do what they say."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.agents.configs import get_training
from lunar_mjx.agents.evaluate import success_text
from lunar_mjx.agents.policy import load_policy
from lunar_mjx.model import make_model

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reinforcement_learning_measured.md").read_text(encoding="utf-8")


def record(name):
    return json.loads((ROOT / "benchmarks" / "rl" / f"{name}.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module", autouse=True)
def benchmarks():
    sys.path.insert(0, str(ROOT / "benchmarks" / "rl"))
    yield
    sys.path.remove(str(ROOT / "benchmarks" / "rl"))


def test_the_page_quotes_what_realism_is_worth():
    from figures import realism_cells

    cells = realism_cells(record("realism"))
    assert len(cells) == 4
    for trained in ("with", "without"):
        row = f"| {trained} | {success_text(cells[trained, 'with'])} | {success_text(cells[trained, 'without'])} |"
        assert row in PAGE
    assert cells["with", "with"]["low"] > cells["without", "with"]["success"], "what the effects are worth is no chance"


def test_the_page_quotes_what_boulders_are_to_viper():
    found = record("large_viper_boulders")
    policy, straight = found["seeds"][0]["final"], found["agents"]["scripted"]
    assert f"| {success_text(policy)} |" in PAGE and f"| {success_text(straight)} |" in PAGE
    assert policy["success"] >= 0.95 and all(a["success"] < 0.5 for a in found["agents"].values())
    assert found["environment"]["unseen"]["terrain"] == "world:heldout_boulders"


def test_the_page_quotes_the_rates():
    rows = {(r["observation"], r["decimation"], r["rovers"]): r for r in record("rates")["rows"]}
    for (_, decimation, rovers), row in rows.items():
        if rovers != 4096 or decimation == 5:
            digits = 1 if decimation == 5 else 2
            said = [f"{row[k] / 1e6:.{digits}f}" for k in ("env_steps_per_s", "bare_steps_per_s")]
            assert f"| {decimation} | {rovers:,} | {said[0]} | {said[1]} | {row['ratio']:.2f} |" in PAGE
    assert max(r["env_steps_per_s"] for r in rows.values()) > 30e6
    assert all(r["ratio"] >= 0.7 for r in rows.values())
    two = record("scaling")["rows"][1]
    assert f"{100 * two['efficiency']:.0f} % of twice as much" in PAGE and two["efficiency"] > 0.85


def test_the_page_quotes_the_papers_own_task():
    from figures import first_good, variants

    for algorithms in variants(record("paper")).values():
        for runs in algorithms.values():
            last = [f"{np.mean(r['episodes']['success'][-50:]):.2f}" for r in runs]
            if len(runs) > 1:
                assert ", ".join(last) in PAGE
    good = [first_good(r) for r in variants(record("paper"))["signed"]["TD3"]]
    assert ", ".join("never" if g is None else str(g) for g in good) in PAGE

    steady = variants(record("paper"))["steady"]
    assert all(len(runs) == 5 for runs in steady.values()) and set(steady) == {"TD3", "DDPG"}
    assert all(np.mean(r["episodes"]["success"][-50:]) > 0.9 for runs in steady.values() for r in runs), "converged"


def test_the_plainer_model_has_neither_heat_nor_soil():
    from arms import THERMAL, plainer

    model = plainer(make_model("luvmi_x", "flat"))
    assert not set(THERMAL) & set(model.effect_names)
    assert model.parameters["hard_surface"]["fraction"] == 1.0
    assert model.parameters["motor"]["alpha"] == model.parameters["motor"]["beta"] == 0.0


def test_the_hidden_soil_is_a_likely_draw_of_the_kept_posterior_and_lies_in_all_ranges():
    import arms
    from scipy import stats

    from lunar_mjx.envs.navigation.config import SOIL_RANGES
    from lunar_mjx.model.file import load_model

    fitted = load_model(arms.FITTED)
    rows = arms.told(fitted)
    assert set(arms.TRUTH) <= {row["parameter"] for row in rows}
    off = np.array([np.log(row["hidden"] / row["fitted"]) for row in rows])
    assert all(fitted.posterior.log)
    assert off @ np.linalg.solve(fitted.posterior.covariance, off) < stats.chi2(len(off)).ppf(0.99)
    for r in SOIL_RANGES:
        assert r.parameter not in arms.TRUTH or r.low <= arms.TRUTH[r.parameter] <= r.high
    hidden = arms.hidden(make_model("luvmi_x", "flat", "consistent"))
    assert hidden.parameters["soil"]["k_phi"] == pytest.approx(0.6 * 8.2e5)


@pytest.mark.parametrize("name", ["posterior_short", "posterior_large"])
def test_the_page_quotes_what_a_log_is_worth_to_a_training(name):
    from arms import summary

    found = record(name)
    again = summary(found["runs"])
    assert list(found["summary"]) == list(again)
    for trained, arm in found["summary"].items():
        assert arm["success"] == pytest.approx(again[trained]["success"], abs=1e-4), "the means are those of the runs"
        mean, seeds = arm["success"], arm["success"]["seeds"]
        assert f"| {100 * mean['mean']:.1f} +- {100 * mean['error']:.1f} % | {seeds} |" in PAGE
        if "posterior_leads_by" in arm:
            lead = arm["posterior_leads_by"]
            assert f"| {100 * lead['mean']:+.1f} +- {100 * lead['error']:.1f} |" in PAGE


def test_the_page_quotes_what_late_and_drifting_sensors_cost():
    rows = {name: row["score"] for name, row in record("sensors")["rows"].items()}
    assert set(rows) > {"exact", "delay 0.3 s, drift 2 %"}
    for name, score in rows.items():
        assert f"| {name}{' (as trained)' * (name == 'exact')} | {success_text(score)} |" in PAGE


def test_arms_are_compared_by_pairs_of_one_seed():
    from arms import summary

    def run(arm, seed, success):
        return {"arm": arm, "seed": seed, "score": {"success": success, "episode_return": 0.0, "episode_time": 1.0}}

    rows = [run("posterior", 0, 0.9), run("uniform", 0, 0.8), run("posterior", 1, 0.7), run("uniform", 1, 0.6)]
    found = summary([*rows, run("uniform", 2, 0.1), run("nominal", 0, 0.5)])
    assert found["uniform"]["success"]["mean"] == pytest.approx(0.5) and "truth" not in found
    lead = found["uniform"]["posterior_leads_by"]
    assert lead["mean"] == pytest.approx(0.1) and lead["error"] == pytest.approx(0.0, abs=1e-9) and lead["seeds"] == 2
    assert found["nominal"]["posterior_leads_by"]["error"] is None


def test_rung_3_tells_those_apart_that_the_page_says_it_does():
    finals = [run["final"]["rows"] for run in record("ladder-3")["seeds"]]
    assert np.mean([rows["policy"]["success"] for rows in finals]) >= 0.9
    for rows in finals:
        policy, mapper = rows["policy"], rows["mapper"]
        assert rows["scripted"]["success"] <= 0.05 and rows["reactive, tuned"]["success"] <= 0.4
        assert rows["policy, scans blanked"]["success"] <= 0.1
        # the rule on the same map arrives about as often, and drives worse
        assert abs(policy["success"] - mapper["success"]) < 0.1
        assert all(policy[k] < mapper[k] for k in ("collisions_per_km", "wh_per_km", "slip"))


def test_seeds_train_one_after_another_with_the_same_programs(tmp_path, monkeypatch):
    import measure
    import trials

    from lunar_mjx.agents.policy import load_policy

    scored, compiled = [], []

    class Judge:
        """Scores every policy as arriving, in no time."""

        def __init__(self, *_):
            pass

        def compile(self, *_):
            compiled.append(1)

        def __call__(self, params, policy, seed):
            scored.append(seed)
            one = {
                "success": 1.0,
                "low": 0.9,
                "high": 1.0,
                "spl": 1.0,
                "collisions_per_km": 0.0,
                "ends": {"success": 1.0},
            }
            return {"policy": one}

    monkeypatch.setattr(trials, "Judge", Judge)
    monkeypatch.setattr(trials, "rules", lambda env, names: {})
    words = ["measure.py", "rung", "point", "--seeds", "3", "4", "--steps", "300", "--every", "inf"]
    settings = ["--set", "envs=4", "epoch_steps=8", "batch=8", "buffer_steps=64", "random_steps=4", "updates=1"]
    monkeypatch.setattr(sys, "argv", [*words, *settings, "--out", str(tmp_path)])
    measure.main()
    told = json.loads((tmp_path / "point.json").read_text())
    assert [run["seed"] for run in told["seeds"]] == [3, 4] and len(compiled) == 1
    assert scored == [trials.FINAL_SEED, trials.FINAL_SEED], "with no scores before the last nothing is chosen"
    for run in told["seeds"]:
        assert run["final"]["steps"] == run["epochs"][-1]["steps"] == 320 and run["scores"] == []
    first, second = (load_policy(tmp_path / f"point_seed{n}.npz") for n in (3, 4))
    assert (first.notes["seed"], second.notes["seed"]) == (3, 4)
    assert any((np.asarray(a) != np.asarray(b)).any() for a, b in zip(*map(_leaves, (first, second)), strict=True))


def _leaves(policy):
    import jax

    return jax.tree.leaves(policy.params)


def test_seeds_of_further_runs_join_the_kept_record_unless_settings_differ(tmp_path):
    from kept import keep

    def run(folder, seeds, steps, rate=1.0, **more):
        found = [{"seed": n, "epochs": [{"steps": 1, "kl": 2.0}], "final": {"steps": steps}} for n in seeds]
        about = {"about": {"device": "GPU"}, "commit": folder, "worlds_s": 1.0, "compile_s": [2.0]}
        told = {**about, "training": "mine", "environment": {}, "learner": "PPOConfig", "train": {"rate": rate}}
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "mine.json"
        path.write_text(json.dumps({**told, "seeds": [*found, *more.get("cut", [])]}))
        return path

    keep([run("a", [0, 1], 10)], home=tmp_path)
    kept = json.loads(keep([run("b", [3, 1], 20, cut=[{"seed": 4, "epochs": []}])], home=tmp_path).read_text())
    assert [(s["seed"], s["commit"], s["final"]["steps"]) for s in kept["seeds"]] == [
        (0, "a", 10),
        (1, "b", 20),
        (3, "b", 20),
    ]
    assert kept["seeds"][0]["epochs"] == [{"steps": 1}] and kept["seeds"][0]["device"] == "GPU"
    with pytest.raises(ValueError, match="train is not the same"):
        keep([run("c", [5], 20, rate=2.0)], home=tmp_path)
    for more in ({"learner": "SACConfig"}, {"begin_with": "luvmi_x/ladder-3"}):
        other = run(f"d{next(iter(more))}", [0], 20)
        other.write_text(json.dumps(json.loads(other.read_text()) | more))
        with pytest.raises(ValueError, match=f"{next(iter(more))} is not the same"):
            keep([other], home=tmp_path)
        own = json.loads(keep([other], "mine-other" + next(iter(more)), tmp_path).read_text())
        assert own.items() >= more.items() and own["training"] == "mine"


def test_the_page_quotes_that_rung_4_is_missed_and_what_beginning_with_rung_3_is_worth():
    begun, anew = record("ladder-4"), record("ladder-4-scratch")
    assert begun["begin_with"] == "luvmi_x/ladder-3" and "begin_with" not in anew
    assert all(begun[k] == anew[k] for k in ("environment", "train", "learner"))
    worse = anew["seeds"][0]["final"]["rows"]["policy"]["success"]
    finals = [run["final"]["rows"] for run in begun["seeds"]]
    assert len(finals) == 2
    for rows in finals:
        policy, mapper = rows["policy"]["success"], rows["mapper"]["success"]
        assert worse < policy < mapper < 0.9
        assert rows["scripted"]["success"] == rows["reactive"]["success"] == 0.0
        assert f"{100 * mapper:.1f} %" in PAGE
    policies = [100 * rows["policy"]["success"] for rows in finals]
    assert f"{policies[0]:.1f} and {policies[1]:.1f} %" in PAGE and f"{100 * worse:.1f} %" in PAGE
    # the best of a run's scores on the way, and the last of them: more steps did not help
    for run in begun["seeds"]:
        shares = [100 * score["rows"]["policy"]["success"] for score in run["scores"]]
        assert f"{max(shares):.1f} %, and {shares[-1]:.1f} % at the" in PAGE and max(shares) > shares[-1]


def test_the_page_quotes_how_fast_pictures_are_and_what_they_are_worth():
    large, rung = record("large-depth"), record("ladder-3-depth")
    assert all(r["rate"]["rovers"] == 4096 and r["rate"]["picture"] == [64, 48] for r in (large, rung))
    rates = [{k: f"{r['rate'][k]:,.0f}" for k in ("env_steps_per_s", "least", "most")} for r in (large, rung)]
    assert " | ".join("{env_steps_per_s} ({least} to {most})".format(**r) for r in rates) in PAGE
    assert " | ".join(f"{r['train_steps_per_s']:,.0f}" for r in (large, rung)) in PAGE
    points = {}
    for name, found in (("large", large), ("rung 3", rung)):
        rows = {k: 100 * v["success"] for k, v in found["final"]["rows"].items()}
        assert rows["student"] > 0.95 * rows["teacher"]
        points[name] = round(rows["student"] - rows["blanked"])
    assert f"The picture is worth {points['rung 3']} points there and {points['large']} on `large`" in PAGE


def test_the_page_and_the_card_of_the_shipped_policy_quote_who_gets_out_of_holes(tmp_path):
    from harness import EXPERIMENTS
    from kept import SOILS, ship

    found, page = record("escape"), (ROOT / "docs" / "how_to" / "escape.md").read_text(encoding="utf-8")
    rows = {name: row["score"] for name, row in found["rows"].items()}
    assert list(rows) == list(EXPERIMENTS["escape"]["rows"]) and {s["episodes"] for s in rows.values()} == {256}
    assert found["commit"] in page
    for agent in ("zero", "random", "scripted", "rocking", "TD3 of the closed form", "TD3 of the stress integral"):
        assert f"| {' | '.join(success_text(rows[f'{soil}, {agent}']) for soil in SOILS)} |" in page
    assert rows["stress integral, TD3 of the closed form"]["success"] == 0.0, "what does not transfer"

    shipped = ROOT / "models" / "luvmi_x" / "escape.npz"
    notes = load_policy(shipped).notes
    assert f"TD3 with the stress integral, {notes['steps']:,} steps, {notes['elapsed_s']:.0f} s" in page
    # what the training's own steps suffice for
    for steps in re.findall(r"100 % from ([\d,]+) steps on in closed form and from ([\d,]+) on", page)[0]:
        assert get_training("escape").steps > int(steps.replace(",", ""))
    run = tmp_path / "field"
    run.mkdir()
    shutil.copyfile(shipped, run / "policy.npz")
    told = {"training": "escape", "wall_s": 272.9, "rows": [{"steps": notes["steps"]}]}
    (run / "curve.json").write_text(json.dumps(told))
    (tmp_path / "escape.json").write_text(json.dumps(found))
    (tmp_path / "luvmi_x").mkdir()
    again = ship(run / "policy.npz", tmp_path)
    assert again.read_bytes() == shipped.read_bytes()
    assert again.with_suffix(".md").read_text("utf-8") == shipped.with_suffix(".md").read_text("utf-8")


def test_rung_1_is_kept_by_learner():
    ppo, sac = record("ladder-1-ppo"), record("ladder-1-sac")
    assert (ppo["learner"], sac["learner"]) == ("PPOConfig", "SACConfig") and len(ppo["seeds"]) == 5
    assert min(s["final"]["rows"]["policy"]["success"] for s in ppo["seeds"] + sac["seeds"]) >= 0.99
