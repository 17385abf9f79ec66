"""Curves, tables and model cards from what measure.py measured; no number is typed in by hand.

python benchmarks/rl/figures.py runs/proof                        # figures to docs/figures, tables to the screen
python benchmarks/rl/figures.py runs/proof runs/more --ship luvmi_x   # seeds of both runs; also the policy and its card
                                                                  # to models/luvmi_x, the record to benchmarks
python benchmarks/rl/figures.py runs/proof --keep                 # the other parts' records to benchmarks
python benchmarks/rl/figures.py benchmarks/rl                      # figures and tables of the records kept there
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tables
from harness import KEPT, ROOT, read
from kept import keep, read_large, ship_large

from lunar_mjx.agents.curves import draw_mean, new_figure
from lunar_mjx.report.style import LINES, LIT, MUTED, styled

DRAWN = ("signed", "printed", "scaled", "scaled, layer norm, 3 steps", "steady")
"""Variants of the paper's task that the figure shows; the table has all."""
REASONS = {"stuck": "", "rolled_over": "///", "time": "xxx", "off_terrain": "...", "diverged": "---"}
"""For which drives fail, in the order of the figure's bars, with what tells a bar apart without colour."""
UNSEEN = {"ylabel": "success on unseen ground, %", "ylim": (-3, 103)}
"""The axis of success."""


def shares(scores: Sequence[Mapping[str, Any]], name: str = "success") -> list[float]:
    """Shares of scores in percent."""
    return [100 * s[name] for s in scores]


def plot_large(record: dict[str, Any]) -> Any:
    """Success on unseen ground and return in training over wall time; the agents that learn nothing as lines."""
    figure, (left, right) = new_figure(2)
    for seed in record["seeds"]:
        found, rows = seed["unseen"], [r for r in seed["rows"] if r.get("episode_return") is not None]
        left.plot(
            [s["elapsed_s"] for s in found], shares(found), marker="o", ms=3, lw=1.2, label=f"seed {seed['seed']}"
        )
        right.plot([r["elapsed_s"] for r in rows], [r["episode_return"] for r in rows], lw=1.2)
    for style, (name, score) in zip(("--", "-.", ":", (0, (1, 4))), record["agents"].items(), strict=False):
        left.axhline(100 * score["success"], color=MUTED, lw=0.8, ls=style, label=name)
    left.axhline(100 * record["target"], color=MUTED, lw=0.8)
    left.set(xlabel="wall time of training, s", **UNSEEN)
    right.set(xlabel="wall time of training, s", ylabel="return of ended episodes in training")
    left.legend(frameon=False, fontsize=7)
    return figure


def plot_paper(record: dict[str, Any]) -> Any:
    """Return by episode on the axes of the paper's Fig. 6 (above) and success (below), a column per variant."""
    groups = {v: found for v, found in tables.variants(record).items() if v in DRAWN or v == record["variant"]}
    figure, above = new_figure(len(groups), 2.7, 5.0)
    for axes in above:
        axes.remove()
    with styled():
        rows = figure.subplots(2, len(groups), sharex="col", squeeze=False)
    for column, (variant, algorithms) in enumerate(groups.items()):
        for name, runs in algorithms.items():
            colour, line = LINES[int(name == "DDPG")][:2]
            label = f"{name}, {len(runs)} seed{'s' if len(runs) > 1 else ''}"
            for row, (quantity, factor) in enumerate((("episode_return", 1.0), ("success", 100))):
                curves = [r["episodes"][quantity] for r in runs]
                draw_mean(rows[row][column], curves, factor, color=colour, linestyle=line, label=label)
        rows[0][column].set_title(variant, fontsize=9)
        rows[1][column].set(xlabel="episode", ylim=(-3, 103))
        rows[0][column].legend(frameon=False, fontsize=7)
    rows[0][0].set(ylabel="average return per episode")
    rows[1][0].set(ylabel="success, %")
    return figure


def plot_rates(record: dict[str, Any]) -> Any:
    """Environment steps per second against the bare physics, over the number of rovers, at decimation 5."""
    rows = [r for r in record["rows"] if r["decimation"] == 5 and r["observation"] == "17 numbers"]
    rows.sort(key=lambda r: r["rovers"])
    figure, (left, right) = new_figure(2)
    at = [r["rovers"] for r in rows]
    left.loglog(at, [r["bare_steps_per_s"] / 1e6 for r in rows], "s--", ms=4, color=MUTED, label="bare physics")
    left.loglog(at, [r["env_steps_per_s"] / 1e6 for r in rows], "o-", ms=4, label="environment")
    left.axhline(30.0, color=MUTED, lw=0.8)
    left.set(xlabel="rovers", ylabel="million steps/s at decimation 5")
    left.set_title(record["rover"], loc="left")
    left.legend(frameon=False)
    ratios = [[min(r["bare_seconds"]) / s for s in r["seconds"]] for r in rows]
    right.plot(at, [r["ratio"] for r in rows], "o-", ms=4)
    right.vlines(at, [min(q) for q in ratios], [max(q) for q in ratios], lw=1.5)
    right.axhline(0.7, color=MUTED, lw=0.8)
    right.set(xlabel="rovers", xscale="log", ylabel="environment / bare physics", ylim=(0, 1))
    return figure


def plot_realism(record: dict[str, Any]) -> Any:
    """Failures of policies trained with and without the thermal and soil effects, in both models."""
    figure, (axes,) = new_figure(1, 5.6, 3.2)
    cells = tables.realism_cells(record)
    at, bottom = np.arange(len(cells)), np.zeros(len(cells))
    for reason, hatch in REASONS.items():
        share = np.array([100.0 * c["ends"][reason] for c in cells.values()])
        if share.any():
            axes.barh(at, share, left=bottom, height=0.55, hatch=hatch, edgecolor=LIT, label=reason.replace("_", " "))
            bottom += share
    middle, low, high = (100 - np.array(shares(list(cells.values()), k)) for k in ("success", "high", "low"))
    axes.errorbar(middle, at, xerr=[middle - low, high - middle], fmt="none", ecolor="k", capsize=3, lw=1)
    labels = [f"trained {trained},\ntested {tested} the effects" for trained, tested in cells]
    axes.set_yticks(at, labels, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel="episodes that fail, % (95 % interval)")
    axes.legend(frameon=False, fontsize=8)
    return figure


def plot_learners(large: dict[str, Any] | None, brax: dict[str, Any]) -> Any:
    """Success on unseen ground over time of training: TD3's seeds and brax's learners."""
    figure, both = new_figure(2)
    lines = [(f"TD3, {large['about']['device']}", s["unseen"], LINES[0]) for s in large["seeds"]] if large else []
    for look, (name, run) in zip(LINES[1:], brax["runs"].items(), strict=False):
        lines.append((f"brax {name.upper()}, {brax['about']['device']}", run.get("unseen", []), look))
    for i, (label, found, (colour, line)) in enumerate(lines):
        # a label stands once, whatever the number of its seeds
        label = None if label in [other[0] for other in lines[:i]] else label
        for axes, x, unit in zip(both, ("elapsed_s", "steps"), (1.0, 1e6), strict=True):
            places = [s[x] / unit if s[x] is not None else np.nan for s in found]
            axes.plot(places, shares(found), marker="o", ms=2.5, lw=1.2, color=colour, linestyle=line, label=label)
            axes.fill_between(places, shares(found, "low"), shares(found, "high"), color=colour, alpha=0.15, lw=0)
    both[0].set(xlabel="s of training", xscale="log", **UNSEEN)
    both[1].set(xlabel="million environment steps", xscale="log", ylim=(-3, 103))
    both[0].legend(frameon=False, fontsize=7)
    return figure


PLOTS = {"paper": plot_paper, "rates": plot_rates, "realism": plot_realism}
TABLES = {
    "paper": tables.table_paper,
    "rates": tables.table_rates,
    "scaling": tables.table_scaling,
    "realism": tables.table_realism,
    "brax": tables.table_brax,
    "sb3": tables.table_sb3,
}


def main() -> None:
    """Draws, prints and keeps what the folders hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "figures")
    parser.add_argument("--keep", action="store_true", help="records of the other parts go to benchmarks")
    parser.add_argument("--ship", help="rover whose policy goes to models/")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    lines, figures, large = [], {}, read_large(args.folders)
    # trainings just measured, or the one that the guide shows of those kept
    kept = read(KEPT / "large_luvmi_x.json") if KEPT in [f.resolve() for f in args.folders] else None
    for record in [r for r in (large, kept) if r and r["seeds"]]:
        figures[f"large_{record['rover']}"] = plot_large(record)
        lines += tables.table_large(record)
    parts = {name: found for name in TABLES for folder in args.folders if (found := read(folder / f"{name}.json"))}
    for name, record in parts.items():
        lines += TABLES[name](record)
        if name in PLOTS:
            figures[name] = PLOTS[name](record)
        if args.keep:
            keep(name, record)
    if brax := parts.get("brax"):
        figures["learners"] = plot_learners(read(KEPT / f"large_{brax['rover']}.json") or large, brax)
    for name, figure in figures.items():
        figure.savefig(args.out / f"rl_{name}.png", dpi=110 if name == "paper" else 120)
    if args.ship:
        assert large is not None and large["rover"] == args.ship, "the folder holds another rover's training"
        lines.append(f"shipped {ship_large(large, args.folders)}")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
