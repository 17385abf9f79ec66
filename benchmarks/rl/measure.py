"""What training costs and what it comes to: one part of it in one command, which saves as it goes.

    python benchmarks/rl/measure.py large --rover viper --out runs/large              # one GPU
    python benchmarks/rl/measure.py large short --unseen-terrain flat --steps 30000 --episodes 64 --every 10 --last 5 \
        --out runs/short                                                             # the same code on two CPU cores
    python benchmarks/rl/measure.py rung ladder-3 --seeds 1 2 --steps 60e6 --every inf --out runs/rung
    python benchmarks/rl/measure.py sensors --out runs/sensors                       # 3 minutes on two CPU cores
    python benchmarks/rl/measure.py escape --steps 0 --episodes 32 --out runs/escape    # rules alone

Parts, each with its own JSON file; `experiments.toml` holds their settings:
"""

from __future__ import annotations

import argparse
import importlib
import math
from pathlib import Path
from typing import Any

from harness import EXPERIMENTS, Clock, command, in_time, read, save, say

from lunar_mjx.agents.evaluate import success_text


def words() -> argparse.Namespace:
    """The command line, with the settings of its part."""
    about = str(__doc__) + "".join(f"`{part}`: {found['about']}\n" for part, found in EXPERIMENTS.items())
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("part", choices=EXPERIMENTS)
    add("training", nargs="?", help="another than the part's: a shipped one by name, or a file like it")
    add("--out", type=Path, required=True)
    add("--name", help="of the files; the training's unless told")
    add("--seconds", type=float, help="for everything, compiling among it; of `sb3` its CPU time")
    add("--rover", help="another than the training's")
    add("--learner", help="another algorithm than the training's")
    add("--begin-with", default="", help="policy that trainings begin with, as of `lunar-mjx train`")
    add("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of the training")
    add("--env", nargs="*", default=[], metavar="NAME=VALUE", help="options of the environment, as JSON")
    add("--unseen-terrain", help="on which policies are scored, such as world:heldout_boulders")
    add("--seeds", type=int, nargs="+", help="one after another, as many as there is time for")
    add("--steps", type=float, help="of the environment, of each training; the training's own unless told")
    add("--seed-seconds", type=float, help="most s of training of one seed")
    add("--last", type=float, help="s of all that are kept for the last scores")
    add("--every", type=float, help="s of training between scores; inf: the final one alone")
    add("--episodes", type=int, help="of each row of a score")
    add("--repeats", type=int, help="of rates")
    add("--target", type=float, default=0.95, help="success whose time is told")
    add("--stop-at", type=float, default=math.inf, help="success of the policy at which a training stops")
    add("--only", nargs="+", help="variants of `paper`, rows of `rates` and others by name, arms")
    common = {"seconds": math.inf, "seed_seconds": math.inf, "episodes": 256, "repeats": 9, "seeds": [0]}
    told = parser.parse_args()
    parser.set_defaults(**common | {k: v for k, v in EXPERIMENTS[told.part].items() if k in told})
    return parser.parse_args()


def gather(args: argparse.Namespace, clock: Clock) -> None:
    """What `lunar-mjx evaluate` says, row by row, gathered in one record that is saved after every score.

    The commands stand in `experiments.toml`; `{out}` is the folder. All rows have the same draws of unseen ground,
    soils and goals: those of the seed that `evaluate` has by itself.
    """
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
        say(f"{name}: {success_text(rows[name]['score'])}")


def main() -> None:
    """Measures the part that is asked for."""
    args = words()
    args.out.mkdir(parents=True, exist_ok=True)
    module, _, function = EXPERIMENTS[args.part]["measure"].partition(":")
    clock = Clock(args.seconds)
    getattr(importlib.import_module(module), function)(args, clock)
    say(f"done in {clock.spent:.0f} s")


if __name__ == "__main__":
    main()
