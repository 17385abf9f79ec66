"""Tables and plots of the parts of measure.py other than `large`; called by figures.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from harness import percent

from lunar_mjx.agents.curves import mean_interval, moving_mean, new_figure
from lunar_mjx.report.style import LINES, MUTED, styled

LAST = 50
"""Episodes that a training is judged by at its end."""
DRAWN = ("signed", "printed", "scaled", "scaled, layer norm, 3 steps", "steady")
"""Variants of the paper's task that the figure shows; the table has all."""


# The paper's own task


def variants(record: dict[str, Any]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Runs by variant and algorithm, the main variant first."""
    found = {record["variant"]: record["runs"], **{v: other["runs"] for v, other in record["others"].items()}}
    return {
        v: {n.removeprefix("paper-").upper(): runs for n, runs in groups.items() if runs} for v, groups in found.items()
    }


def first_good(run: dict[str, Any], share: float = 0.9) -> int | None:
    """Episode at which the mean success of 20 episodes first reaches a share; None if it never does."""
    at = np.flatnonzero(moving_mean(run["episodes"]["success"])[19:] >= share)
    return int(at[0]) + 20 if at.size else None


def plot_paper(record: dict[str, Any], path: Path) -> None:
    """Return by episode on the axes of the paper's Fig. 6 (above) and success (below), a column per variant."""
    groups = {v: found for v, found in variants(record).items() if v in DRAWN or v == record["variant"]}
    figure, above = new_figure(len(groups), 2.7, 5.0)
    for axes in above:
        axes.remove()
    with styled():
        rows = figure.subplots(2, len(groups), sharex="col", squeeze=False)
    for column, (variant, algorithms) in enumerate(groups.items()):
        for name, runs in algorithms.items():
            i = int(name == "DDPG")
            for axes, quantity, factor in ((rows[0][column], "episode_return", 1.0), (rows[1][column], "success", 100)):
                curves = [factor * moving_mean(r["episodes"][quantity]) for r in runs]
                count = min(len(c) for c in curves)
                mean, low, high = mean_interval(np.stack([c[:count] for c in curves]))
                x = np.arange(1, count + 1)
                label = f"{name}, {len(runs)} seed{'s' if len(runs) > 1 else ''}"
                axes.plot(x, mean, color=LINES[i][0], linestyle=LINES[i][1], label=label)
                axes.fill_between(x, low, high, color=LINES[i][0], alpha=0.2, lw=0)
        rows[0][column].set_title(variant, fontsize=9)
        rows[1][column].set(xlabel="episode", ylim=(-3, 103))
        rows[0][column].legend(frameon=False, fontsize=7)
    rows[0][0].set(ylabel="average return per episode")
    rows[1][0].set(ylabel="success, %")
    figure.savefig(path, dpi=110)


def table_paper(record: dict[str, Any]) -> list[str]:
    lines = ["The paper's own task:"]
    for variant, algorithms in variants(record).items():
        for name, runs in algorithms.items():
            last = [round(float(np.mean(r["episodes"]["success"][-LAST:])), 2) for r in runs]
            returns = [round(float(np.mean(r["episodes"]["episode_return"][-LAST:]))) for r in runs]
            lines.append(
                f"  {variant}, {name}: steps {[r['steps'] for r in runs]}, episodes "
                f"{[len(r['episodes']['success']) for r in runs]}, last {LAST}: success {last}, return "
                f"{returns}; 90 % of 20 first at episode {[first_good(r) for r in runs]}"
            )
    return lines


# Rates and scaling


def plot_rates(record: dict[str, Any], path: Path) -> None:
    """Environment steps per second against the bare physics, over the number of rovers, at decimation 5."""
    rows = sorted(
        (r for r in record["rows"] if r["decimation"] == 5 and r["observation"] == "17 numbers"),
        key=lambda r: r["rovers"],
    )
    figure, (left, right) = new_figure(2)
    at = [r["rovers"] for r in rows]
    left.loglog(at, [r["bare_steps_per_s"] / 1e6 for r in rows], "s--", ms=4, color=MUTED, label="bare physics")
    left.loglog(at, [r["env_steps_per_s"] / 1e6 for r in rows], "o-", ms=4, label="environment")
    left.axhline(30.0, color=MUTED, lw=0.8)
    left.set(xlabel="rovers", ylabel="million steps/s at decimation 5", title=record["rover"])
    left.legend(frameon=False)
    ratios = [[min(r["bare_seconds"]) / s for s in r["seconds"]] for r in rows]
    right.plot(at, [r["ratio"] for r in rows], "o-", ms=4)
    right.vlines(at, [min(q) for q in ratios], [max(q) for q in ratios], lw=1.5)
    right.axhline(0.7, color=MUTED, lw=0.8)
    right.set(xlabel="rovers", xscale="log", ylabel="environment / bare physics", ylim=(0, 1))
    figure.savefig(path, dpi=120)


def table_rates(record: dict[str, Any]) -> list[str]:
    lines = [f"Environment steps per second, {record['rover']}, {record['about']['device']}:"]
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
    lines = [f"Whole training on several devices, {record['rover']}, {record['about']['device']}:"]
    return lines + [
        f"  {r['devices']} devices {r['steps_per_s']:,.0f} steps/s, {r['updates_per_s']:.0f} updates/s, "
        f"efficiency {r['efficiency']:.3f}"
        for r in record["rows"]
    ]


# What realism is worth


def pooled(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Success over the episodes of several seeds, with its interval."""
    from lunar_mjx.agents.evaluate import wilson

    count = sum(r["episodes"] for r in records)
    won = sum(r["success"] * r["episodes"] for r in records)
    low, high = wilson(won, count)
    ends = {k: float(np.mean([r["ends"][k] for r in records])) for k in records[0]["ends"]}
    return {"success": won / count, "low": low, "high": high, "episodes": count, "ends": ends}


def realism_cells(record: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    """Pooled scores by (trained, tested)."""
    kinds = ("with", "without")
    return {
        (trained, tested): pooled([s["scores"][tested] for s in record["seeds"] if s["trained"] == trained])
        for trained in kinds
        for tested in kinds
        if any(s["trained"] == trained for s in record["seeds"])
    }


def plot_realism(record: dict[str, Any], path: Path) -> None:
    """Failures of policies trained with and without the thermal and soil effects, in both models."""
    figure, (axes,) = new_figure(1, 5.6, 3.2)
    reasons = ("stuck", "rolled_over", "time", "off_terrain", "diverged")
    labels, bottom = [], None
    cells = realism_cells(record)
    at = np.arange(len(cells))
    bottom = np.zeros(len(cells))
    for reason in reasons:
        share = np.array([100.0 * c["ends"][reason] for c in cells.values()])
        if share.any():
            axes.barh(at, share, left=bottom, height=0.55, label=reason.replace("_", " "))
            bottom += share
    fails = np.array([[100 * (1 - c["success"]), 100 * (1 - c["high"]), 100 * (1 - c["low"])] for c in cells.values()])
    axes.errorbar(
        fails[:, 0],
        at,
        xerr=[fails[:, 0] - fails[:, 1], fails[:, 2] - fails[:, 0]],
        fmt="none",
        ecolor="k",
        capsize=3,
        lw=1,
    )
    labels = [f"trained {trained},\ntested {tested} the effects" for trained, tested in cells]
    axes.set_yticks(at, labels, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel="episodes that fail, % (95 % interval)")
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=120)


def table_realism(record: dict[str, Any]) -> list[str]:
    seeds = {t: sum(s["trained"] == t for s in record["seeds"]) for t in ("with", "without")}
    lines = [f"Thermal and soil effects, {record['rover']}, {record['about']['device']}, seeds {seeds}:"]
    for (trained, tested), score in realism_cells(record).items():
        ends = ", ".join(f"{k} {100 * v:.1f} %" for k, v in score["ends"].items() if k != "success" and v > 0)
        lines.append(f"  trained {trained:7s} tested {tested:7s} {percent(score)} of {score['episodes']:,}: {ends}")
    return lines


# Other learners


def table_brax(record: dict[str, Any]) -> list[str]:
    lines = [f"brax on the same environment, {record['rover']}, {record['about']['device']}:"]
    for name, run in record["runs"].items():
        if not run.get("unseen"):
            lines.append(f"  {name}: {run.get('error', 'no score')}")
            continue
        best = max(run["unseen"], key=lambda s: s["success"])
        after = run["seconds_to_target"]
        said = f"{after:.0f} s, {run['steps_to_target'] / 1e6:.1f} M steps" if after else "not reached"
        last = run["unseen"][-1]
        lines.append(
            f"  {name}: {100 * record['target']:.0f} % after {said}; best {percent(best)} after "
            f"{best['elapsed_s']:.0f} s, {best['steps'] / 1e6:.1f} M steps; last "
            f"{percent(run.get('final', last))} after {last['elapsed_s']:.0f} s, {last['steps'] / 1e6:.1f} M "
            "steps"
        )
    return lines


def table_sb3(record: dict[str, Any]) -> list[str]:
    episodes = record["episodes"]
    ends: dict[str, int] = {}
    for e in episodes:
        ends[e["end"]] = ends.get(e["end"], 0) + 1
    lines = [
        f"SB3 TD3 on PyBullet, one rover: {record['steps']:,} steps, {len(episodes)} episodes in "
        f"{record['cpu_s'] / 60:.0f} min of CPU time, ends {ends}"
    ]
    if "final" in record:
        final = record["final"]
        ended = {k: round(v, 3) for k, v in final["ends"].items() if v}
        lines.append(f"  its policy on unseen ground: {percent(final)} of {final['episodes']}, ends {ended}")
    return lines


def plot_learners(large: dict[str, Any] | None, brax: dict[str, Any] | None, path: Path) -> None:
    """Success on unseen ground over time of training: TD3's seeds and brax's learners."""
    figure, (left, right) = new_figure(2)
    lines = [(f"TD3, {large['about']['device']}", s["unseen"], LINES[0][0]) for s in large["seeds"]] if large else []
    for i, (name, run) in enumerate((brax or {"runs": {}})["runs"].items()):
        lines.append(
            (f"brax {name.upper()}, {(brax or {})['about']['device']}", run.get("unseen", []), LINES[i + 1][0])
        )
    named = set()
    for label, found, colour in lines:
        for axes, x, unit in ((left, "elapsed_s", 1.0), (right, "steps", 1e6)):
            places = [s[x] / unit if s[x] is not None else np.nan for s in found]
            axes.plot(
                places,
                [100 * s["success"] for s in found],
                "o-",
                ms=2.5,
                lw=1,
                color=colour,
                label=None if label in named else label,
            )
            axes.fill_between(
                places,
                [100 * s["low"] for s in found],
                [100 * s["high"] for s in found],
                color=colour,
                alpha=0.15,
                lw=0,
            )
        named.add(label)
    left.set(xlabel="s of training", xscale="log", ylabel="success on unseen ground, %", ylim=(-3, 103))
    right.set(xlabel="million environment steps", xscale="log", ylim=(-3, 103))
    left.legend(frameon=False, fontsize=7)
    figure.savefig(path, dpi=120)
