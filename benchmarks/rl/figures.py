"""Curves, tables and model cards from what measure.py measured; no number is typed in by hand.

python benchmarks/rl/figures.py runs/proof                        # figures to docs/figures, tables to the screen
python benchmarks/rl/figures.py runs/proof runs/more --ship luvmi_x   # seeds of both runs; also the policy and its card
                                                                  # to models/luvmi_x, the record to benchmarks
python benchmarks/rl/figures.py runs/proof --keep                 # the other parts' records to benchmarks
python benchmarks/rl/figures.py benchmarks/rl                      # figures and tables of the records kept there
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import tables as more
from harness import digits, percent

from lunar_mjx.agents.curves import mean_interval, new_figure
from lunar_mjx.agents.policy import load_policy
from lunar_mjx.report.style import MUTED

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "benchmarks" / "rl"
TABLES = {
    "paper": more.table_paper,
    "rates": more.table_rates,
    "scaling": more.table_scaling,
    "realism": more.table_realism,
    "brax": more.table_brax,
    "sb3": more.table_sb3,
}
PLOTS = {"paper": more.plot_paper, "rates": more.plot_rates, "realism": more.plot_realism}
PARTS = tuple(TABLES)
_LIMIT = 2_000_000
"""Bytes that a shipped policy may have."""


def read(folder: Path, name: str) -> dict[str, Any] | None:
    path = folder / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def read_large(folders: list[Path]) -> dict[str, Any] | None:
    """The record of part `large`; seeds of further runs of the same settings join those of the first."""
    records = [r for r in (read(f, "large") for f in folders) if r]
    if not records:
        return None
    first, *others = records
    for other in others:
        assert all(other[k] == first[k] for k in ("rover", "environment", "train", "agents", "about")), "not alike"
        first["seeds"] += other["seeds"]
    return first


ROWS = ("steps", "elapsed_s", "steps_per_s", "episode_return", "success")
"""Columns of a training's rows that figures read; the others are not kept."""


def rounded(value: Any) -> Any:
    """What is kept of a record: its numbers as of `digits`, of a training's rows `ROWS` alone."""
    if isinstance(value, dict):
        if "seed" in value and "rows" in value:
            value = {**value, "rows": [{k: r[k] for k in ROWS if k in r} for r in value["rows"]]}
        return {k: rounded(v) for k, v in value.items()}
    return [rounded(v) for v in value] if isinstance(value, list) else digits(value)


def plot_large(record: dict[str, Any], path: Path) -> None:
    """Success on unseen ground and return in training over wall time; the agents that learn nothing as lines."""
    figure, (left, right) = new_figure(2)
    for seed in record["seeds"]:
        found = seed["unseen"]
        left.plot(
            [s["elapsed_s"] for s in found],
            [100 * s["success"] for s in found],
            "o-",
            ms=3,
            lw=1,
            label=f"seed {seed['seed']}",
        )
        rows = [r for r in seed["rows"] if r.get("episode_return") is not None]
        right.plot([r["elapsed_s"] for r in rows], [r["episode_return"] for r in rows], lw=1)
    for style, (name, score) in zip(("--", "-.", ":", (0, (1, 4))), record["agents"].items(), strict=False):
        left.axhline(100 * score["success"], color=MUTED, lw=0.8, ls=style, label=name)
    left.axhline(100 * record["target"], color=MUTED, lw=0.8)
    left.set(xlabel="wall time of training, s", ylabel="success on unseen ground, %", ylim=(-3, 103))
    right.set(xlabel="wall time of training, s", ylabel="return of ended episodes in training")
    left.legend(frameon=False, fontsize=7)
    figure.savefig(path, dpi=120)


def table_large(record: dict[str, Any]) -> list[str]:
    lines = [f"Large batch, {record['rover']}, {record['about']['device']}:"]
    for name, score in record["agents"].items():
        lines.append(f"  {name:10s} {percent(score)}")
    for seed in record["seeds"]:
        after = seed["seconds_to_target"]
        said = f"{after:.0f} s, {seed['steps_to_target'] / 1e6:.1f} M steps" if after else "not reached"
        lines.append(
            f"  seed {seed['seed']}: final {percent(seed['final'])}; {100 * record['target']:.0f} % after "
            f"{said} (training {seed['train_s']:.0f} s)"
        )
    times = [s["seconds_to_target"] for s in record["seeds"] if s["seconds_to_target"]]
    if len(times) > 1:
        mean, low, high = (float(a[0]) for a in mean_interval(np.array(times)[:, None].astype(float)))
        lines.append(f"  time to target {mean:.0f} s ({low:.0f} to {high:.0f}, 95 %, n = {len(times)})")
    if "updates_per_s" in record:
        lines.append(f"  learner {record['updates_per_s']:,.0f} updates/s of {record['train']['batch']:,} transitions")
    return lines


def card(record: dict[str, Any], seed: dict[str, Any], size: int) -> str:
    """The model card of a shipped policy."""
    options = record["environment"]["options"]
    agents = "\n".join(f"| {name} | {percent(score)} |" for name, score in record["agents"].items())
    train, kept = record["train"], seed["kept"]
    others = [str(s["seed"]) for s in record["seeds"] if s is not seed]
    return f"""# Trained policy of {record["rover"]}

`policy.npz` ({size / 1e6:.2f} MB): weights, observation statistics and the environment's options, without pickles.

    lunar-mjx play {record["rover"]}
    lunar-mjx evaluate {record["rover"]}

**Task.** `{options.get("task")}`: drive 10 to 40 m to a goal over rough ground with rocks and craters; success is being
within the goal's radius before the time is up. Options: `{json.dumps(options)}`.

**Training.** TD3 with a distributional critic, {train["envs"]:,} rovers, batches of {train["batch"]:,}, seed
{seed["seed"]}: {kept["steps"] / 1e6:.1f} M environment steps in {kept["elapsed_s"]:.0f} s on one
{record["about"]["device"]} (without compilation, {record["compile_epoch_s"]:.0f} s). Script:
`benchmarks/rl/measure.py`.
Of the policies of this training and its other seeds ({", ".join(others) or "none"}), it scored best on the ground and
soils of the training: {percent(kept["train_score"])}.

**Score** on ground, goals and soil never trained on (`{json.dumps(record["environment"]["unseen"])}`),
{seed["final"]["episodes"]} episodes, 95 % Wilson interval:

| agent | success |
|---|---|
| this policy | {percent(seed["final"])} |
{agents}

Ends of this policy's episodes: {json.dumps({k: round(v, 4) for k, v in seed["final"]["ends"].items()})}.

**Limits.** Trained in simulation only, with the model's effects and the spread of soils and motors of
`lunar_mjx.envs.navigation.config.SOIL_RANGES`. It sees exact poses and a height map without noise. It has driven no
real rover.
"""


def ship(record: dict[str, Any], folders: list[Path], home: Path) -> Path:
    """Copies the policy that scored best on the ground of its training, writes its card, and keeps the record."""
    best = max(record["seeds"], key=lambda s: s["kept"]["train_score"]["success"])
    found = [f / f"policy_{record['rover']}.npz" for f in folders]
    policy = next(p for p in found if load_policy(p).notes["seed"] == best["seed"])
    assert policy.stat().st_size < _LIMIT, "the policy is too large to ship"
    shutil.copyfile(policy, home / "policy.npz")
    (home / "POLICY.md").write_text(card(record, best, policy.stat().st_size), encoding="utf-8")
    text = json.dumps(rounded(record), separators=(",", ":")) + "\n"
    (KEPT / f"large_{record['rover']}.json").write_text(text, encoding="utf-8")
    return home / "policy.npz"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "figures")
    parser.add_argument("--keep", action="store_true", help="records of the other parts go to benchmarks")
    parser.add_argument("--ship", help="rover whose policy goes to models/")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    lines: list[str] = []
    large = read_large(args.folders)
    if large and large["seeds"]:
        plot_large(large, args.out / f"rl_large_{large['rover']}.png")
        lines += table_large(large)
    parts = {name: found for name in PARTS for folder in args.folders if (found := read(folder, name))}
    for name, record in parts.items():
        lines += TABLES[name](record)
        if name in PLOTS:
            PLOTS[name](record, args.out / f"rl_{name}.png")
        if args.keep:
            text = json.dumps(rounded(record), separators=(",", ":")) + "\n"
            (KEPT / f"{name}.json").write_text(text, encoding="utf-8")
    if "brax" in parts:
        kept = KEPT / f"large_{parts['brax']['rover']}.json"
        compared = json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else large
        more.plot_learners(compared, parts["brax"], args.out / "rl_learners.png")
    if args.ship:
        assert large is not None and large["rover"] == args.ship, "the folder holds another rover's training"
        lines.append(f"shipped {ship(large, args.folders, ROOT / 'models' / args.ship)}")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
