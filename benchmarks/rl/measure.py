"""What training costs and what it comes to, measured in one command; every part saves as it goes.

    python benchmarks/rl/measure.py --out runs/proof                       # all parts in 9 minutes on one GPU
    python benchmarks/rl/measure.py --out runs/proof --part large --seconds 300 --rover viper
    python benchmarks/rl/measure.py --out runs/tiny --tiny                 # the same code on two CPU cores

Parts, each with its own JSON file:
`large`: TD3 from thousands of rovers, scored on unseen ground, goals and soil, seed after seed while time is left;
zero, random and straight-line agents on the same episodes; learner updates per second; the best policy as .npz.
`rates`: environment steps per second, with observation, reward, reset and randomisation, against the bare physics.
`paper`: TD3 and DDPG on the paper's own task with one rover each, five seeds each, on CPU cores beside the GPU.
`scaling`: steps of whole training per second on 1, 2, 4, ... devices of the host, the same share for each device.
`brax`: brax's PPO and SAC in the same environment, with the same scores.
`realism`: TD3 trained with and without the thermal and soil effects, each scored with and without them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from brax_learners import brax
from harness import Clock, save, say
from large import large
from paper import DEFAULT, VARIANTS, paper_child, paper_merge, paper_start
from rates import rates, scaling
from realism import realism

PERIOD = {
    "all": 535.0,
    "large": 300.0,
    "rates": 200.0,
    "paper": 400.0,
    "scaling": 150.0,
    "brax": 340.0,
    "realism": 300.0,
}
"""s that each part may take."""


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--out", type=Path, required=True)
    add("--part", choices=(*PERIOD, "paper-child"), default="all")
    add("--seconds", type=float, help="that the part may take")
    add("--tiny", action="store_true", help="small enough for two CPU cores")
    add("--rover", default="luvmi_x")
    add("--seeds", type=int, default=5)
    add("--first-seed", type=int, default=0)
    add("--steps", type=int, default=2_000_000_000, help="most environment steps of a seed")
    add("--seed-seconds", type=float, default=150.0, help="most s of one seed of part large")
    add("--eval-every", type=float, default=15.0, help="s of training")
    add("--target", type=float, default=0.95)
    add("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of the training")
    add("--env", nargs="*", default=[], metavar="NAME=VALUE", help="options of the environment")
    add("--unseen-terrain", help="on which policies are scored, such as world:heldout_boulders")
    add("--only", nargs="*", help="of part realism, such as 3/with 4/without (seed/effects)")
    add("--training", default="paper-td3", help="of part paper-child")
    add("--rows", nargs="*", help="of part rates, such as 17/5/65536 (numbers/decimation/rovers)")
    add("--variants", nargs="*", default=list(DEFAULT), choices=list(VARIANTS), help="of part paper")
    add("--together", type=int, default=1, help="seeds in one program of part paper-child")
    add("--core", type=int, help="CPU core of part paper-child")
    args = parser.parse_args()
    if args.tiny:
        args.seeds, args.steps, args.eval_every = min(args.seeds, 2), min(args.steps, 4000), 1.0
    return args


def main() -> None:
    args = options()
    args.out.mkdir(parents=True, exist_ok=True)
    clock = Clock(args.seconds or PERIOD.get(args.part, 60.0))
    if args.part == "paper-child":
        paper_child(args)
        return
    children = paper_start(args, clock.left - 25.0) if args.part in ("all", "paper") else []
    try:
        if args.part in ("all", "large"):
            large(args, Clock(0.7 * clock.left if args.part == "all" else clock.left))
        if args.part in ("all", "rates"):
            rates(args, Clock(clock.left - 15.0))
        for name, function in (("scaling", scaling), ("brax", brax), ("realism", realism)):
            if args.part == name:
                function(args, clock)
    finally:
        if children:
            save(args.out, "paper", paper_merge(children, clock.left))
    say(f"done in {clock.spent:.0f} s")


if __name__ == "__main__":
    main()
