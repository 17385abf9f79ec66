"""Trains on a rung of the ladder and scores the policy beside those that learn nothing, on the same unseen episodes.

    python benchmarks/rl/rung.py ladder-3 --seconds 500 --out runs/rung                # one GPU
    python benchmarks/rl/rung.py ladder-3 --seeds 1 2 3 4 --steps 60e6 --every inf --out runs/rung
    python benchmarks/rl/rung.py ladder-3 --tiny --seconds 400 --out runs/tiny         # the same code on two CPU cores
    python benchmarks/rl/rung.py --keep runs/rung/ladder-3.json                        # its seeds join the kept record
    python benchmarks/rl/rung.py --keep runs/sac/ladder-1.json --name ladder-1-sac     # apart from other learners
    python benchmarks/rl/rung.py --ship runs/rung/ladder-3_seed0.npz                   # to models/, with a card

Rows: the policy, the policy with all that comes from its scans blanked, straight ahead, the reactive rule (as it was
tuned in `benchmarks/rl/ladder.json`, on rung 3 alone; else with its defaults), and `mapper`, which follows the way on
the rover's own map if the policy is told it. All rows are of one program, compiled beside the training's; all seeds use
the same two. Each score writes `NAME.json`, `NAME_seedN.npz` (best on the unseen worlds so far) and
`NAME_seedN_last.npz`, so that a run that is cut off leaves what it had. The final score is of other episodes than those
by which the best was chosen; with `--every inf` nothing is chosen. The documentation's tables of rungs are made from
the kept records, `benchmarks/rl/ladder-N*.json`.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from harness import KEPT, Clock, in_time, options, read, say, training_of
from kept import keep_rung, ship_rung
from trials import Trials

from lunar_mjx.envs import make_agent
from lunar_mjx.envs.scripted import Reactive, reactive_rule


def words() -> argparse.Namespace:
    """The command line."""
    parser = options(__doc__, Path("runs/rung"))
    parser.set_defaults(seconds=500.0)
    add = parser.add_argument
    add("training", nargs="?", default="ladder-3", help="a shipped training of the ladder, or a file like it")
    add("--name", help="of the files, or of the kept record; the training's unless told")
    add("--learner", help="another algorithm than the file's")
    add("--begin-with", default="", help="policy that the training begins with, as of `lunar-mjx train`")
    add("--last", type=float, default=70.0, help="s of all that are kept for the last two scores")
    add("--steps", type=float, help="of the environment, of each seed; the training's own unless told")
    add("--target", type=float, default=math.inf, help="success of the policy at which the training stops")
    add("--every", type=float, default=90.0, help="s of training between scores; inf: the final one alone")
    add("--episodes", type=int, default=256, help="of each row")
    add("--seeds", type=int, nargs="+", default=[0], help="one after another, as many as there is time for")
    add("--keep", type=Path, nargs="+", metavar="JSON", help="train nothing; add the seeds of these to the kept record")
    add("--ship", type=Path, metavar="NPZ", help="train nothing; a policy of the kept record goes to models/")
    return parser.parse_args()


def rules(env: Any) -> dict[str, Any]:
    """Agents that learn nothing, the reactive one with its best settings on this rung where it has been tuned."""
    tuned = read(KEPT / "ladder.json")["tuned"].get(str(env.config.rung))
    reactive = Reactive(**tuned["rows"][0]["settings"]) if tuned else Reactive()
    name = "reactive, tuned" if tuned else "reactive"
    found = {"scripted": make_agent("scripted", env), name: reactive_rule(env, reactive)}
    return found | ({"mapper": make_agent("mapper", env)} if "plan" in env.blocks else {})


def main() -> None:
    """Trains, scores and writes; or keeps and ships what earlier runs wrote."""
    args = words()
    if args.keep:
        say(str(keep_rung(args.keep, name=args.name or "")))
    if args.ship:
        say(str(ship_rung(args.ship)))
    if args.keep or args.ship:
        return
    clock, training = Clock(args.seconds), training_of(args, args.training, args.learner)
    episodes = min(args.episodes, 2) if args.tiny else args.episodes
    trials = Trials(
        training, args.name or Path(args.training).stem, args.out, clock, episodes, rules, begin_with=args.begin_with
    )
    for seed in in_time(clock, args.seeds):
        trials(seed, int(args.steps or training.steps), max(1.0, clock.left - args.last), args.every, args.target)


if __name__ == "__main__":
    main()
