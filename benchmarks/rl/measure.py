"""What training costs and what it comes to: one part of it in one command, which saves as it goes.

    python benchmarks/rl/measure.py large --rover viper --out runs/large              # one GPU
    python benchmarks/rl/measure.py large short --unseen-terrain flat --steps 30000 --episodes 64 --every 10 --last 5 \
        --out runs/short                                                             # the same code on two CPU cores
    python benchmarks/rl/measure.py rung ladder-3 --seeds 1 2 --steps 60e6 --every inf --out runs/rung

Parts, each with its own JSON file; `experiments.toml` holds their settings:
`large`: TD3 from thousands of rovers, scored on unseen ground, goals and soil beside agents that learn nothing.
`rung`: a training on a rung of the ladder, scored beside agents that learn nothing.
`depth`: rate of an environment with depth pictures, and a student distilled in it, beside its teacher.
`realism`: TD3 trained with and without the thermal and soil effects, each scored with and without them.
`fit`, `posterior`: training on what a log left open, beside wide ranges and the nominal soil.
`brax`: brax's PPO and SAC in the same environment, with the same scores.
`paper`: TD3 and DDPG on the paper's own task with one rover each, on CPU cores.
`rates`: environment steps per second, with observation, reward, reset and randomisation, against the bare physics.
`tune`: settings of the reactive rule on the ladder's training worlds; rungs are scored beside the best of them.
`export`: how far exported policies are from their own, and how long an action takes.
`sensors`, `escape`: scores that `lunar-mjx evaluate` gives, gathered in one record.
"""

from __future__ import annotations

import argparse
import importlib
import math
from pathlib import Path

from harness import EXPERIMENTS, Clock, say


def words() -> argparse.Namespace:
    """The command line, with the settings of its part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("part", choices=EXPERIMENTS)
    add("training", nargs="?", help="another than the part's: a shipped one by name, or a file like it")
    add("--out", type=Path, required=True)
    add("--name", help="of the files; the training's unless told")
    add("--seconds", type=float, help="for everything, compiling among it")
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
