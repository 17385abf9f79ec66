"""Parts `sensors` and `escape` of measure.py: what `lunar-mjx evaluate` says, row by row, gathered in one record.

    python benchmarks/rl/measure.py sensors --out runs/sensors                          # 3 minutes on two CPU cores
    python benchmarks/rl/measure.py escape --steps 0 --episodes 32 --out runs/escape    # rules alone

The commands stand in `experiments.toml`; `{out}` is the folder. All rows have the same draws of unseen ground, soils
and goals: those of the seed that `evaluate` has by itself.
"""

from __future__ import annotations

import argparse
from typing import Any

from harness import EXPERIMENTS, Clock, command, in_time, percent, read, save, say


def gather(args: argparse.Namespace, clock: Clock) -> None:
    """Runs the commands of a part one after another; saves after every score."""
    plan = EXPERIMENTS[args.part]
    told = {"out": args.out, "seed": args.seeds[0], "steps": int(args.steps or 0), "fifth": args.seconds / 5}
    for line in plan.get("first", ()) if args.steps else ():
        command(*line.format(**told).split(), "--quiet")
    # without a training, rules alone
    names = [name for name, line in plan["rows"].items() if args.steps or "{out}" not in line]
    rows: dict[str, Any] = {}
    for name in in_time(clock, [name for name in names if args.only is None or name in args.only]):
        words = plan["rows"][name].format(**told)
        command(*words.split(), "--episodes", args.episodes, "--out", args.out / "row.json")
        rows[name] = {"command": words, "score": read(args.out / "row.json")}
        save(args.out, args.part, {"rows": rows})
        say(f"{name}: {percent(rows[name]['score'])}")
