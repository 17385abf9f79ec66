"""What training costs and what it comes to, measured in one command; every part saves as it goes.

    python benchmarks/rl/measure.py --out runs/proof                       # all parts in 9 minutes on one GPU
    python benchmarks/rl/measure.py --out runs/proof --part large --seconds 300 --rover viper
    python benchmarks/rl/measure.py --out runs/tiny --tiny                 # the same code on two CPU cores

Parts, each with its own JSON file:
`large`: TD3 from thousands of rovers, scored on unseen ground, goals and soil, seed after seed while time is left;
agents that learn nothing on the same episodes; learner updates per second; the best policy as .npz.
`rates`: environment steps per second, with observation, reward, reset and randomisation, against the bare physics.
`paper`: TD3 and DDPG on the paper's own task with one rover each, five seeds each, on CPU cores beside the GPU.
`scaling`: steps of whole training per second on 1, 2, 4, ... devices of the host, the same share for each device.
`brax`: brax's PPO and SAC in the same environment, with the same scores.
`realism`: TD3 trained with and without the thermal and soil effects, each scored with and without them.
`all` is paper, large and rates.
"""

from __future__ import annotations

import argparse

import paper
from brax_learners import brax
from harness import Clock, options, save, say
from large import large
from rates import rates, scaling
from realism import realism

PARTS = {
    "all": (None, 535.0),
    "large": (large, 300.0),
    "rates": (rates, 200.0),
    "paper": (None, 400.0),
    "scaling": (scaling, 150.0),
    "brax": (brax, 340.0),
    "realism": (realism, 300.0),
}
"""What measures a part, and s that it may take."""
LARGE = 0.7
"""Share of what is left that `large` takes of `all`; `rates` takes the rest."""
SPARE = 20.0
"""s before the end at which the last part of `all` and the runs on CPU cores stop."""


def words() -> argparse.Namespace:
    """The command line."""
    parser = options(__doc__)
    parser.set_defaults(rover="luvmi_x")
    add = parser.add_argument
    add("--part", choices=PARTS, default="all")
    add("--seeds", type=int, default=5)
    add("--first-seed", type=int, default=0)
    add("--steps", type=int, default=2_000_000_000, help="most environment steps of a seed")
    add("--seed-seconds", type=float, default=150.0, help="most s of one seed of part large")
    add("--eval-every", type=float, default=15.0, help="s of training")
    add("--target", type=float, default=0.95)
    add("--unseen-terrain", help="on which policies are scored, such as world:heldout_boulders")
    add("--only", nargs="*", help="of part realism, such as 3/with 4/without (seed/effects)")
    add("--rows", nargs="*", help="of part rates, such as 17/5/65536 (numbers/decimation/rovers)")
    add("--variants", nargs="*", default=list(paper.DEFAULT), choices=list(paper.VARIANTS), help="of part paper")
    args = parser.parse_args()
    if args.tiny:
        args.seeds, args.steps, args.eval_every = min(args.seeds, 2), min(args.steps, 4000), 1.0
    return args


def main() -> None:
    """Measures the parts that are asked for."""
    args = words()
    args.out.mkdir(parents=True, exist_ok=True)
    measure, period = PARTS[args.part]
    clock = Clock(args.seconds or period)
    pool, pending = paper.start(args, clock.left - SPARE) if args.part in ("all", "paper") else (None, [])
    try:
        if measure is not None:
            measure(args, clock)
        if args.part == "all":
            large(args, Clock(LARGE * clock.left))
            rates(args, Clock(clock.left - SPARE))
    finally:
        if pool is not None:
            save(args.out, "paper", paper.merged(pending, clock.left))
            pool.terminate()
    say(f"done in {clock.spent:.0f} s")


if __name__ == "__main__":
    main()
