"""Figures and lines of a table from records of measure.py; no number is typed in by hand.

python benchmarks/rl/figures.py benchmarks/rl/*.json                       # all that is kept
python benchmarks/rl/figures.py runs/rates/rates.json --out runs/rates     # what was just measured
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from harness import KEPT, ROOT, read, say

from lunar_mjx.agents.curves import draw_mean, moving_mean, new_figure, plot_progress
from lunar_mjx.agents.evaluate import pooled, success_text
from lunar_mjx.report.style import INK, LINES, LIT, MUTED, save_light_and_dark, styled

DRAWN = ("signed", "printed", "scaled", "scaled, layer norm, 3 steps", "steady")
"""Variants of the paper's task that the figure shows; the table has all."""
REASONS = {"stuck": "", "rolled_over": "///", "time": "xxx", "off_terrain": "...", "diverged": "---"}
"""For which drives fail, in the order of the figure's bars, with what tells a bar apart without colour."""
LAST = 50
"""Episodes that a training on the paper's task is judged by at its end."""
CURVES = ("rows", "epochs", "unseen", "scores", "episodes")
"""What a seed went through, of which no table tells."""


def variants(record: dict[str, Any]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Runs on the paper's own task by variant and algorithm, the main variant first if it was run."""
    found = {record["variant"]: record["runs"], **{v: other["runs"] for v, other in record["others"].items()}}
    return {
        v: {n.removeprefix("paper-").upper(): runs for n, runs in groups.items()}
        for v, groups in found.items()
        if groups
    }


def first_good(run: dict[str, Any], share: float = 0.9) -> int | None:
    """Episode at which the mean success of 20 episodes first reaches a share; None if it never does."""
    at = np.flatnonzero(moving_mean(run["episodes"]["success"])[19:] >= share)
    return int(at[0]) + 20 if at.size else None


def realism_cells(record: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    """Pooled scores by (trained, tested), each with and without the thermal and soil effects."""
    kinds = ("with", "without")
    return {
        (trained, tested): pooled([s["scores"][tested] for s in record["seeds"] if s["trained"] == trained])
        for trained in kinds
        for tested in kinds
        if any(s["trained"] == trained for s in record["seeds"])
    }


def scores(record: Any, name: str) -> Iterator[str]:
    """A line for every score in a record, by where it stands there."""
    if isinstance(record, list):
        names = [" ".join(f"{k} {v[k]}" for k in ("arm", "trained", "seed") if k in v) for v in record]
        record = {name or str(i): v for i, (name, v) in enumerate(zip(names, record, strict=True))}
    if {"success", "low", "high", "episodes"} <= record.keys():
        yield f"{name}: {success_text(record)} of {record['episodes']:,}"
        return
    for key, value in record.items():
        rows = isinstance(value, list) and value and isinstance(value[0], dict) and key not in CURVES
        if rows or isinstance(value, dict):
            yield from scores(value, f"{name}, {key}")


def shares(found: Sequence[Mapping[str, Any]], name: str = "success") -> list[float]:
    """Shares of scores in percent."""
    return [100 * s[name] for s in found]


def plot_paper(record: dict[str, Any]) -> Any:
    """Return by episode on the axes of the paper's Fig. 6 (above) and success (below), a column per variant."""
    for variant, algorithms in variants(record).items():
        for name, runs in algorithms.items():
            last = [round(float(np.mean(r["episodes"]["success"][-LAST:])), 2) for r in runs]
            say(f"{variant}, {name}: success of the last {LAST} {last}; 90 % of 20 at {[first_good(r) for r in runs]}")
    groups = {v: found for v, found in variants(record).items() if v in DRAWN or v == record["variant"]}
    figure, above = new_figure(len(groups), 2.7, 5.0)
    for axes in above:
        axes.remove()
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
    for r in record["rows"]:
        say(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in r.items() if "conds" not in k))
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
    cells = realism_cells(record)
    for (trained, tested), cell in cells.items():
        say(f"trained {trained}, tested {tested}: {success_text(cell)} of {cell['episodes']:,}")
    at, bottom = np.arange(len(cells)), np.zeros(len(cells))
    for reason, hatch in REASONS.items():
        share = np.array([100.0 * c["ends"][reason] for c in cells.values()])
        if share.any():
            axes.barh(at, share, left=bottom, height=0.55, hatch=hatch, edgecolor=LIT, label=reason.replace("_", " "))
            bottom += share
    middle, low, high = (100 - np.array(shares(list(cells.values()), k)) for k in ("success", "high", "low"))
    axes.errorbar(middle, at, xerr=[middle - low, high - middle], fmt="none", ecolor=INK, capsize=3, lw=1)
    labels = [f"trained {trained},\ntested {tested} the effects" for trained, tested in cells]
    axes.set_yticks(at, labels, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel="episodes that fail, % (95 % interval)")
    axes.legend(frameon=False, fontsize=8)
    return figure


def plot_learners(brax: dict[str, Any]) -> Any:
    """Success on unseen ground over time of training: the seeds of TD3 that are kept, and brax's learners."""
    figure, both = new_figure(2)
    large = read(KEPT / f"large_{brax['rover']}.json") or {"seeds": []}
    lines = [(f"TD3, {large['about']['device']}", s["unseen"], LINES[0]) for s in large["seeds"]]
    for look, (name, run) in zip(LINES[1:], brax["runs"].items(), strict=False):
        lines.append((f"brax {name.upper()}, {brax['about']['device']}", run.get("unseen", []), look))
    for i, (label, found, (colour, line)) in enumerate(lines):
        # a label stands once, whatever the number of its seeds
        label = None if label in [other[0] for other in lines[:i]] else label
        for axes, x, unit in zip(both, ("elapsed_s", "steps"), (1.0, 1e6), strict=True):
            places = [s[x] / unit if s[x] is not None else np.nan for s in found]
            axes.plot(places, shares(found), marker="o", ms=2.5, lw=1.2, color=colour, linestyle=line, label=label)
            axes.fill_between(places, shares(found, "low"), shares(found, "high"), color=colour, alpha=0.15, lw=0)
    both[0].set(xlabel="s of training", xscale="log", ylabel="success on unseen ground, %", ylim=(-3, 103))
    both[1].set(xlabel="million environment steps", xscale="log", ylim=(-3, 103))
    both[0].legend(frameon=False, fontsize=7)
    return figure


PLOTS = {"paper": plot_paper, "rates": plot_rates, "realism": plot_realism, "brax": plot_learners}
"""Figures by the names of records."""
FILES = {"brax": "rl_learners"}
"""Of figures that are not called by the record's name."""


@styled()  # legends and titles, too, which would else be black on dark pages
def main() -> None:
    """Prints what records hold, and draws those that have a figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "figures")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for path in args.records:
        record, name = read(path), path.stem
        say("\n".join(scores(record, name)))
        to = args.out / f"{FILES.get(name, f'rl_{name}')}.png"
        if name in PLOTS:
            save_light_and_dark(PLOTS[name](record), to, dpi=110 if name == "paper" else 120)
        elif name.startswith("large_") and record["rover"] in name:
            plot_progress(record["seeds"], to, dark=True)


if __name__ == "__main__":
    main()
