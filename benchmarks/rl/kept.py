"""What the repository keeps of measurements: their records here, and policies with their cards in `models`.

    python benchmarks/rl/kept.py runs/rung/ladder-3.json                         # its seeds join the kept record
    python benchmarks/rl/kept.py runs/sac/ladder-1.json --name ladder-1-sac      # apart from other learners
    python benchmarks/rl/kept.py runs/a/large-td3.json runs/b/large-td3.json     # seeds of both runs
    python benchmarks/rl/kept.py --ship runs/rung/ladder-3_seed0.npz             # to models/, with a card
    python benchmarks/rl/kept.py --ship runs/escape/field/policy.npz             # to models/, too

A policy is shipped from the folder of its run, whose record lies beside it, or a folder above it (part `escape`).
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness import KEPT, ends, reached, read, say, when, write

from lunar_mjx.agents.evaluate import success_text
from lunar_mjx.agents.policy import Policy, load_policy
from lunar_mjx.envs.ladder.rungs import get_rung
from lunar_mjx.resources import shipped

SCORED = ("steps", "elapsed_s", "success", "low", "high")
COLUMNS = {"rows": (*SCORED, "episode_return"), "epochs": SCORED, "unseen": SCORED}
"""What a seed's epochs and its scores during training are called, and which of their numbers figures read."""
MOST_EPOCHS = 40
"""Of a training whose curve no figure draws."""
ALIKE = ("rover", "training", "environment", "train", "learner", "begin_with")
"""What runs have alike whose seeds stand side by side."""
MOST_BYTES = 2_000_000
"""Of a shipped policy."""
SOILS = {"closed form": "consistent", "stress integral": "field"}
"""Models of the soil, as rows of part `escape` begin with them, and the preset of each."""
COSTS = ("spl", "collisions_per_km", "wh_per_km", "slip")
"""Numbers of a score that a card tells beside the success."""


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


def keep(paths: Sequence[Path], name: str = "", home: Path = KEPT) -> Path:
    """Writes what is kept of a run's records; returns the file.

    Args:
      paths: of records; of several, finished seeds stand side by side. name: of the kept record. home: its folder.

    Raises:
      ValueError: runs of different trainings, environments or settings.
    """
    records = [read(path) for path in paths]
    record, name = records[0], name or paths[0].stem
    if "untrained" in record:
        record = large(records)
        name = f"large_{record['rover']}" if name == record["training"] else name
    elif "rate" in record:
        (run,), took = record.pop("seeds"), {"made_s": record.pop("worlds_s"), "compile_s": max(record["compile_s"])}
        record = {**record, **took, **run, "epochs": few(run["epochs"])}
    elif "learner" in record:
        record = rung([*filter(None, [read(home / f"{name}.json")]), *records])
    write(home / f"{name}.json", rounded(record))
    return home / f"{name}.json"


def finished(records: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """The finished seeds of records that are alike, each with its record."""
    for same in ALIKE:
        for other in records[1:]:
            if (there := other.get(same)) != (here := records[0].get(same)):
                raise ValueError(f"{same} is not the same in all runs: {here}; {there}")
    return [(record, run) for record in records for run in record["seeds"] if "final" in run]


def rung(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One record of trainings, with finished seeds of all; a seed told twice is the later's."""
    seeds = {}
    for record, run in finished(records):
        about = {k: record[k] for k in ("commit", "tree", "worlds_s", "compile_s") if k in record}
        about["device"] = record["about"]["device"]
        seeds[run["seed"]] = {**about, **run, "epochs": few(run["epochs"])}
    shared = {k: records[0][k] for k in ("about", *ALIKE) if k in records[0]}
    return {**shared, "seeds": [seeds[n] for n in sorted(seeds)]}


def large(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One record of runs of part `large`, with finished seeds of all, by what its figures and pages tell."""
    first, agents, seeds = records[0], {"untrained": records[0]["untrained"]}, []
    for _, run in finished(records):
        unseen = [{**score["rows"]["policy"], **when(score), "train": score["train"]} for score in run["scores"]]
        at, rows = next(s for s in unseen if s["steps"] == run["final"]["steps"]), run["final"]["rows"]
        about = {"seed": run["seed"], "rows": run["epochs"], "unseen": unseen, "final": rows["policy"]}
        about |= {"blanked": rows["policy, scans blanked"], "kept": {**when(at), "train_score": at["train"]}}
        about |= {"train_s": run["epochs"][-1]["elapsed_s"], "steps": run["epochs"][-1]["steps"]}
        # agents that learn nothing have the same episodes beside every seed
        agents |= {k: v for k, v in rows.items() if not k.startswith("policy") and k not in agents}
        seeds.append({**about, **reached(unseen, first["target"])})
    return {**first, "compile_epoch_s": first["compile_s"][0], "agents": agents, "seeds": seeds}


def ship(path: Path, home: Path | None = None) -> Path:
    """Copies a policy of a run into its rover's folder and writes its card; returns the copy.

    Args:
      path: of the policy. home: folder of the rovers' folders; that of the models that ship if left out.
    """
    assert path.stat().st_size < MOST_BYTES, "the policy is too large to ship"
    policy = load_policy(path)
    options = policy.environment["options"]
    task = options["task"].partition("/")[0]
    words, rows = (escape_words if task == "escape" else trial_words)(path, policy)
    words |= {"rover": options.get("rover", "luvmi_x"), "options": json.dumps(options)}
    words |= {"notes": policy.notes, "size": path.stat().st_size / 1e6}
    words["rows"] = "\n".join(f"| {' | '.join([name, *cells])} |" for name, cells in rows.items())
    card = {"ladder": "rung", "escape": "escape"}.get(task, "large")
    name = "policy" if card == "large" else words["training"]
    folder = (home or shipped("models")) / words["rover"]
    text = Path(__file__).with_name(f"card_{card}.txt").read_text(encoding="utf-8").format(**words)
    (folder / ("POLICY.md" if name == "policy" else f"{name}.md")).write_text(text, "utf-8")
    return Path(shutil.copyfile(path, folder / f"{name}.npz"))


def trial_words(path: Path, policy: Policy) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """Words of the card of a policy of part `large` or `rung`, and the cells of its table's rows by agent."""
    record = read(path.with_name(f"{path.stem.partition('_seed')[0]}.json"))
    run = next(r for r in record["seeds"] if r["seed"] == policy.notes["seed"])
    final, number = run["final"], policy.environment["options"]["task"].partition("/")[2]
    assert final["steps"] == policy.notes["steps"], f"{path}: not the policy that the record's last score is of"
    scores = dict(final["rows"])
    own = scores.pop("policy")
    words = {
        "record": record,
        "run": run,
        "training": record["training"],
        "unseen": json.dumps(record["environment"]["unseen"]),
        "learner": record["learner"].removesuffix("Config"),
        "compile_s": max(record["compile_s"]),
        "steps": final["steps"] / 1e6,
        "ends": json.dumps({k: round(v, 4) for k, v in own["ends"].items()}),
    }
    if number:
        words |= {"number": number, "rung": get_rung(int(number))}
    else:
        words["trained"] = success_text(next(s for s in run["scores"] if s["steps"] == final["steps"])["train"])
    cells = {
        name: [success_text(row), *(f"{row[k]:.2f}" for k in COSTS if row[k] is not None)]
        for name, row in {"this policy": own, **scores}.items()
    }
    return words, cells


def escape_words(path: Path, policy: Policy) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """Words of the card of a policy of part `escape`, and the cells of its table's rows by agent.

    `lunar-mjx train` wrote the policy into a folder beside the record.
    """
    record, run = read(path.parents[1] / "escape.json"), read(path.with_name("curve.json"))
    preset, rows = policy.environment["options"]["preset"], record["rows"]
    assert run["rows"][-1]["steps"] == policy.notes["steps"], f"{path}: not the policy that the training ended with"
    soil = next(name for name, own in SOILS.items() if own == preset)
    agents = dict.fromkeys(name.partition(", ")[2] for name in rows)
    scores = {agent: [rows[f"{name}, {agent}"]["score"] for name in SOILS] for agent in agents}
    own = scores.pop(f"TD3 of the {soil}")
    words = {"record": record, "run": run, "training": run["training"], "preset": preset, "soil": soil}
    words |= {"episodes": own[0]["episodes"], "columns": " | ".join(SOILS)}
    words["ends"] = "; ".join(f"{name} {json.dumps(ends(s))}" for name, s in zip(SOILS, own, strict=True))
    return words, {name: [success_text(s) for s in row] for name, row in {"this policy": own, **scores}.items()}


def main() -> None:
    """Keeps records, or ships a policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", type=Path, nargs="*", help="that measure.py wrote")
    parser.add_argument("--name", default="", help="of the kept record; the file's unless told")
    parser.add_argument("--ship", type=Path, metavar="NPZ", help="a policy that goes to models/")
    args = parser.parse_args()
    if args.records:
        say(str(keep(args.records, args.name)))
    if args.ship:
        say(str(ship(args.ship)))


if __name__ == "__main__":
    main()
