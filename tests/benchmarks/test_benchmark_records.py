"""The records of the reinforcement learning benchmark: the page quotes them, and their parts do what they say."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

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
    from tables import percent, realism_cells

    cells = realism_cells(record("realism"))
    assert len(cells) == 4
    for trained in ("with", "without"):
        row = f"| {trained} | {percent(cells[trained, 'with'])} | {percent(cells[trained, 'without'])} |"
        assert row in PAGE
    assert cells["with", "with"]["low"] > cells["without", "with"]["success"], "what the effects are worth is no chance"


def test_the_page_quotes_what_boulders_are_to_viper():
    from tables import percent

    found = record("large_viper_boulders")
    policy, straight = found["seeds"][0]["final"], found["agents"]["scripted"]
    assert f"| {percent(policy)} |" in PAGE and f"| {percent(straight)} |" in PAGE
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
    from tables import first_good, variants

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
    from realism import THERMAL, plainer

    model = plainer(make_model("luvmi_x", "flat"))
    assert not set(THERMAL) & set(model.effect_names)
    assert model.parameters["hard_surface"]["fraction"] == 1.0
    assert model.parameters["motor"]["alpha"] == model.parameters["motor"]["beta"] == 0.0
