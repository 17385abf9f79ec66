"""Tables of what measure.py and sb3_bullet.py measured: lines of text from a part's record; called by figures.py."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from harness import ends, percent

from lunar_mjx.agents.curves import mean_interval, moving_mean
from lunar_mjx.agents.evaluate import wilson

LAST = 50
"""Episodes that a training is judged by at its end."""


def measured(what: str, record: dict[str, Any], more: str = "") -> str:
    """The first line of a table."""
    return f"{what}, {record['rover']}, {record['about']['device']}{more}:"


def target(record: dict[str, Any], run: dict[str, Any]) -> str:
    """When a training first reached the success that was wanted."""
    after = run["seconds_to_target"]
    said = f"{after:.0f} s, {run['steps_to_target'] / 1e6:.1f} M steps" if after else "not reached"
    return f"{100 * record['target']:.0f} % after {said}"


def table_large(record: dict[str, Any]) -> list[str]:
    """Agents that learn nothing, each seed, and how long seeds take to the target."""
    lines = [measured("Large batch", record)]
    lines += [f"  {name:10s} {percent(score)}" for name, score in record["agents"].items()]
    for seed in record["seeds"]:
        took = f"(training {seed['train_s']:.0f} s)"
        lines.append(f"  seed {seed['seed']}: final {percent(seed['final'])}; {target(record, seed)} {took}")
    times = [s["seconds_to_target"] for s in record["seeds"] if s["seconds_to_target"]]
    if len(times) > 1:
        mean, low, high = (float(a[0]) for a in mean_interval(np.array(times)[:, None].astype(float)))
        lines.append(f"  time to target {mean:.0f} s ({low:.0f} to {high:.0f}, 95 %, n = {len(times)})")
    if "updates_per_s" in record:
        lines.append(f"  learner {record['updates_per_s']:,.0f} updates/s of {record['train']['batch']:,} transitions")
    return lines


def variants(record: dict[str, Any]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Runs on the paper's own task by variant and algorithm, the main variant first."""
    found = {record["variant"]: record["runs"], **{v: other["runs"] for v, other in record["others"].items()}}
    return {
        v: {n.removeprefix("paper-").upper(): runs for n, runs in groups.items() if runs} for v, groups in found.items()
    }


def first_good(run: dict[str, Any], share: float = 0.9) -> int | None:
    """Episode at which the mean success of 20 episodes first reaches a share; None if it never does."""
    at = np.flatnonzero(moving_mean(run["episodes"]["success"])[19:] >= share)
    return int(at[0]) + 20 if at.size else None


def table_paper(record: dict[str, Any]) -> list[str]:
    """What each variant and algorithm came to in each seed."""
    lines = ["The paper's own task:"]
    for variant, algorithms in variants(record).items():
        for name, runs in algorithms.items():
            ended = [r["episodes"] for r in runs]
            last = [round(float(np.mean(e["success"][-LAST:])), 2) for e in ended]
            returns = [round(float(np.mean(e["episode_return"][-LAST:]))) for e in ended]
            lines.append(
                f"  {variant}, {name}: steps {[r['steps'] for r in runs]}, episodes "
                f"{[len(e['success']) for e in ended]}, last {LAST}: success {last}, return "
                f"{returns}; 90 % of 20 first at episode {[first_good(r) for r in runs]}"
            )
    return lines


def table_rates(record: dict[str, Any]) -> list[str]:
    """Rate, its ratio to the bare physics, and memory of each row."""
    lines = [measured("Environment steps per second", record)]
    for r in record["rows"]:
        held = r["state_bytes_per_rover"] + r["temporary_bytes_per_rover"]
        lines.append(
            f"  {r['observation']:17s} decimation {r['decimation']:3d} rovers {r['rovers']:7,d} "
            f"{r['env_steps_per_s'] / 1e6:6.2f} M/s, bare {r['bare_steps_per_s'] / 1e6:6.2f} M/s, "
            f"ratio {r['ratio']:.3f}, {held / 1e3:.1f} kB a rover "
            f"({r['state_bytes_per_rover'] / 1e3:.1f} kept)"
        )
    return lines


def table_scaling(record: dict[str, Any]) -> list[str]:
    """Rates of whole training by number of devices."""
    return [measured("Whole training on several devices", record)] + [
        f"  {r['devices']} devices {r['steps_per_s']:,.0f} steps/s, {r['updates_per_s']:.0f} updates/s, "
        f"efficiency {r['efficiency']:.3f}"
        for r in record["rows"]
    ]


def pooled(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Success over the episodes of several seeds, with its interval."""
    count = sum(r["episodes"] for r in records)
    won = sum(r["success"] * r["episodes"] for r in records)
    low, high = wilson(won, count)
    ended = {k: float(np.mean([r["ends"][k] for r in records])) for k in records[0]["ends"]}
    return {"success": won / count, "low": low, "high": high, "episodes": count, "ends": ended}


def realism_cells(record: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    """Pooled scores by (trained, tested), each with and without the thermal and soil effects."""
    kinds = ("with", "without")
    return {
        (trained, tested): pooled([s["scores"][tested] for s in record["seeds"] if s["trained"] == trained])
        for trained in kinds
        for tested in kinds
        if any(s["trained"] == trained for s in record["seeds"])
    }


def table_realism(record: dict[str, Any]) -> list[str]:
    """Success and failures of each kind of training in each kind of model."""
    seeds = {t: sum(s["trained"] == t for s in record["seeds"]) for t in ("with", "without")}
    lines = [measured("Thermal and soil effects", record, f", seeds {seeds}")]
    for (trained, tested), score in realism_cells(record).items():
        ended = ", ".join(f"{k} {100 * v:.1f} %" for k, v in score["ends"].items() if k != "success" and v > 0)
        lines.append(f"  trained {trained:7s} tested {tested:7s} {percent(score)} of {score['episodes']:,}: {ended}")
    return lines


def table_brax(record: dict[str, Any]) -> list[str]:
    """Each of brax's learners: when it reached the target, its best and its last score."""
    lines = [measured("brax on the same environment", record)]
    for name, run in record["runs"].items():
        if not run.get("unseen"):
            lines.append(f"  {name}: {run.get('error', 'no score')}")
            continue
        best, last = max(run["unseen"], key=lambda s: s["success"]), run["unseen"][-1]
        scores = {"best": (best, best), "last": (run.get("final", last), last)}
        said = [
            f"{word} {percent(score)} after {at['elapsed_s']:.0f} s, {at['steps'] / 1e6:.1f} M steps"
            for word, (score, at) in scores.items()
        ]
        lines.append(f"  {name}: {'; '.join([target(record, run), *said])}")
    return lines


def table_sb3(record: dict[str, Any]) -> list[str]:
    """What Stable-Baselines3's training came to."""
    lines = [
        f"SB3 TD3 on PyBullet, one rover: {record['steps']:,} steps, {len(record['episodes'])} episodes in "
        f"{record['cpu_s'] / 60:.0f} min of CPU time, ends {dict(Counter(e['end'] for e in record['episodes']))}"
    ]
    if "final" in record:
        final = record["final"]
        lines.append(f"  its policy on unseen ground: {percent(final)} of {final['episodes']}, ends {ends(final)}")
    return lines
