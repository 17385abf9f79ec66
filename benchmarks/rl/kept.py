"""What the repository keeps of measurements: their records here, and policies with their cards in `models`."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from harness import KEPT, percent, reached, read, when, write

from lunar_mjx.agents.policy import load_policy
from lunar_mjx.envs.ladder.rungs import get_rung
from lunar_mjx.resources import shipped

SCORED = ("steps", "elapsed_s", "success", "low", "high")
COLUMNS = {"rows": (*SCORED, "episode_return"), "epochs": SCORED, "unseen": SCORED}
"""What a seed's epochs and its scores during training are called, and which of their numbers figures read."""
MOST_EPOCHS = 40
"""Of a training on a rung, whose curve no figure draws."""
SAME = {
    "large": ("rover", "environment", "train", "agents", "about"),
    "rung": ("training", "environment", "train", "learner", "begin_with"),
}
"""What runs have alike whose seeds stand side by side."""
MOST_BYTES = 2_000_000
"""Of a shipped policy."""


def rounded(value: Any) -> Any:
    """What is kept of a record: numbers with five digits, and of what seeds went through `COLUMNS`."""
    if isinstance(value, dict):
        few = [k for k in COLUMNS if "seed" in value and isinstance(value.get(k), list)]
        value = {**value, **{k: [{c: r[c] for c in COLUMNS[k] if c in r} for r in value[k]] for k in few}}
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def few(epochs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """At most `MOST_EPOCHS` epochs at even distances, the last one among them."""
    return epochs[:: -math.ceil(max(len(epochs), 1) / MOST_EPOCHS)][::-1]


def require_alike(kind: str, records: Iterable[dict[str, Any]]) -> None:
    """Raises ValueError for runs of different trainings, environments or settings."""
    first, *others = records
    for same in SAME[kind]:
        for other in others:
            if (there := other.get(same)) != (here := first.get(same)):
                raise ValueError(f"{kind}: {same} is not the same in all runs: {here}; {there}")


def keep(name: str, record: dict[str, Any], home: Path = KEPT) -> Path:
    """Writes what is kept of a record; returns the file."""
    write(home / f"{name}.json", rounded(record))
    return home / f"{name}.json"


def read_large(folders: Iterable[Path]) -> dict[str, Any] | None:
    """The record of part `large` as it is kept; finished seeds of further runs join those of the first."""
    records = [as_kept(r) for r in (read(folder / "large.json") for folder in folders) if r]
    if not records:
        return None
    require_alike("large", records)
    return {**records[0], "seeds": [seed for record in records for seed in record["seeds"]]}


def as_kept(record: dict[str, Any]) -> dict[str, Any]:
    """A record of part `large` by what its figure, table and card tell."""
    runs, seeds = [run for run in record["seeds"] if "final" in run], []
    for run in runs:
        unseen = [{**score["rows"]["policy"], **when(score), "train": score["train"]} for score in run["scores"]]
        at, rows = next(s for s in unseen if s["steps"] == run["final"]["steps"]), run["final"]["rows"]
        about = {"seed": run["seed"], "rows": run["epochs"], "unseen": unseen, "final": rows["policy"]}
        about |= {"blanked": rows["policy, scans blanked"], "kept": {**when(at), "train_score": at["train"]}}
        about |= {"train_s": run["epochs"][-1]["elapsed_s"], "steps": run["epochs"][-1]["steps"]}
        seeds.append({**about, **reached(unseen, record["target"])})
    agents = {k: v for k, v in runs[0]["final"]["rows"].items() if not k.startswith("policy")} if runs else {}
    agents = {"untrained": record["untrained"], **agents}
    return {**record, "compile_epoch_s": record["compile_s"][0], "agents": agents, "seeds": seeds}


def keep_rung(paths: Iterable[Path], home: Path = KEPT, name: str = "") -> Path:
    """The kept record of a training on a rung, with finished seeds of further runs; a seed told twice is the later's.

    Args:
      paths: of the runs' records. home: folder of kept records. name: of the kept record, the training's unless told.

    Raises:
      ValueError: runs of different trainings, environments, settings, learners or beginnings.
    """
    records = [read(path) for path in paths]
    name = name or records[0]["training"]
    if before := read(home / f"{name}.json"):
        records.insert(0, before)
    require_alike("rung", records)
    seeds = {}
    for record in records:
        about = {k: record[k] for k in ("commit", "tree", "worlds_s", "compile_s") if k in record}
        about["device"] = record["about"]["device"]
        seeds |= {
            run["seed"]: {**about, **run, "epochs": few(run["epochs"])} for run in record["seeds"] if "final" in run
        }
    shared = {k: records[0][k] for k in ("about", *SAME["rung"]) if k in records[0]}
    return keep(name, {**shared, "seeds": [seeds[n] for n in sorted(seeds)]}, home)


def ship(path: Path, to: Path, card: str, record: dict[str, Any], final: dict[str, Any], **words: Any) -> Path:
    """Copies a policy into its rover's folder and writes its card; returns the copy.

    Args:
      path: of the policy. to: the copy. card: name of the text `card_NAME.txt`. record: of the policy's training.
      final: the policy's last score. words: more that the text names.
    """
    assert path.stat().st_size < MOST_BYTES, "the policy is too large to ship"
    shutil.copyfile(path, to)
    words |= {"record": record, "policy": load_policy(path), "size": to.stat().st_size / 1e6}
    ended = {k: round(v, 4) for k, v in final["ends"].items()}
    words |= {"options": json.dumps(words["policy"].environment["options"])}
    words |= {"unseen": json.dumps(record["environment"]["unseen"]), "ends": json.dumps(ended)}
    text = Path(__file__).with_name(f"card_{card}.txt").read_text(encoding="utf-8")
    to.with_name("POLICY.md" if to.stem == "policy" else f"{to.stem}.md").write_text(text.format(**words), "utf-8")
    return to


def ship_large(record: dict[str, Any], folders: Iterable[Path]) -> Path:
    """Ships the policy of part `large` that scored best on the ground of its training, and keeps the record."""
    best = max(record["seeds"], key=lambda s: s["kept"]["train_score"]["success"])
    found = (folder / f"large_seed{best['seed']}.npz" for folder in folders)
    path = next(p for p in found if p.is_file() and load_policy(p).notes["steps"] == best["kept"]["steps"])
    keep(f"large_{record['rover']}", record)
    rows = {"this policy": best["final"], **record["agents"]}
    words = {
        "run": best,
        "steps": best["kept"]["steps"] / 1e6,
        "others": ", ".join(str(s["seed"]) for s in record["seeds"] if s is not best) or "none",
        "trained": percent(best["kept"]["train_score"]),
        "rows": "\n".join(f"| {name} | {percent(score)} |" for name, score in rows.items()),
    }
    return ship(path, shipped("models") / record["rover"] / "policy.npz", "large", record, best["final"], **words)


def ship_rung(path: Path) -> Path:
    """Ships a policy whose training's record is kept."""
    policy, training = load_policy(path), path.stem.partition("_")[0]
    options, record = policy.environment["options"], read(KEPT / f"{training}.json")
    run = next(r for r in record["seeds"] if r["seed"] == policy.notes["seed"])
    final, number, rover = run["final"], int(options["task"].rpartition("/")[2]), options.get("rover", "luvmi_x")
    assert final["steps"] == policy.notes["steps"], f"{path}: not the policy that the kept record scores"
    rows = {"this policy": final["rows"]["policy"], **{k: v for k, v in final["rows"].items() if k != "policy"}}
    words = {
        "run": run,
        "rover": rover,
        "training": training,
        "number": number,
        "rung": get_rung(number),
        "learner": record["learner"].removesuffix("Config"),
        "steps": final["steps"] / 1e6,
        "compile_s": max(run["compile_s"]),
        "rows": "\n".join(
            f"| {name} | {percent(r)} | {r['spl']:.2f} | {r['collisions_per_km']:.0f} | {r['wh_per_km']:.0f} "
            f"| {r['slip']:.2f} |"
            for name, r in rows.items()
        ),
    }
    to = shipped("models") / rover / f"{training}.npz"
    return ship(path, to, "rung", record, final["rows"]["policy"], **words)
