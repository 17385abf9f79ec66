"""Trains on a rung of the ladder and scores the policy beside those that learn nothing, on the same unseen episodes.

    python benchmarks/rl/rung.py ladder-3 --seconds 500 --out runs/rung                # one GPU
    python benchmarks/rl/rung.py ladder-3 --seeds 1 2 3 4 --steps 60e6 --every inf --out runs/rung
    python benchmarks/rl/rung.py ladder-3 --tiny --seconds 400 --out runs/tiny         # the same code on two CPU cores
    python benchmarks/rl/rung.py --keep runs/rung/ladder-3.json                        # its seeds join the kept record
    python benchmarks/rl/rung.py --ship runs/rung/ladder-3_seed0.npz                   # to models/, with a card

Rows: the policy, the policy with all that comes from its scans blanked, straight ahead, the reactive rule as it was
tuned (`benchmarks/rl/ladder.json`), and `mapper`, which follows the way on the rover's own map if the policy is told
it. All rows are of one program, compiled beside the training's; all seeds use the same two. Each score writes
`NAME.json`, `NAME_seedN.npz` (best on the unseen worlds so far) and `NAME_seedN_last.npz`, so that a run that is cut
off leaves what it had. The final score is of other episodes than those by which the best was chosen; with
`--every inf` nothing is chosen. The documentation's tables of rungs are made from the kept records,
`benchmarks/rl/ladder-N.json`.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness import (
    COMMIT,
    DURING,
    FINAL,
    KEPT,
    Clock,
    Judge,
    Setup,
    ends,
    in_time,
    options,
    percent,
    read,
    save,
    say,
    trained,
    training_of,
    when,
)
from kept import keep_rung, ship_rung

from benchmarks.provenance import tree
from lunar_mjx.agents.policy import policy_of, save_policy
from lunar_mjx.agents.train import RunConfig
from lunar_mjx.envs import make_agent
from lunar_mjx.envs.scripted import Reactive, reactive_rule


def words() -> argparse.Namespace:
    """The command line."""
    parser = options(__doc__, Path("runs/rung"))
    parser.set_defaults(seconds=500.0)
    add = parser.add_argument
    add("training", nargs="?", default="ladder-3", help="a shipped training of the ladder, or a file like it")
    add("--name", help="of the files; the training's unless told")
    add("--learner", help="another algorithm than the file's")
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
    found = {"scripted": make_agent("scripted", env), "reactive, tuned": reactive_rule(env, reactive)}
    return found | ({"mapper": make_agent("mapper", env)} if "plan" in env.blocks else {})


class Trials:
    """Trainings from several seeds with the same two programs; called with a seed.

    Args:
      args: the command line.
    """

    def __init__(self, args: argparse.Namespace):
        self.args, self.clock, files = args, Clock(args.seconds), tree()
        training = training_of(args, args.training, args.learner)
        self.name, self.steps = args.name or Path(args.training).stem, int(args.steps or training.steps)
        args.out.mkdir(parents=True, exist_ok=True)
        self.setup = Setup(training)
        episodes = min(args.episodes, 2) if args.tiny else args.episodes
        self.judge = Judge(self.setup.env, episodes, self.setup.policies(), rules(self.setup.env))
        worlds_s = self.clock.spent
        compile_s = self.setup.compile(self.judge)
        say(f"worlds {worlds_s:.0f} s, compiled after {compile_s}, {self.clock.left:.0f} s left")
        learner = type(training.train.algorithm).__name__
        about = {"tree": files, "training": self.name, **self.setup.about, "learner": learner}
        self.record: dict[str, Any] = {**about, "worlds_s": worlds_s, "compile_s": compile_s, "seeds": []}

    def store(self, seed: int, state: Any, row: Mapping[str, Any], score: Any, word: str = "") -> None:
        """Writes the policy of a state; `word` ends the file's name."""
        # whoever drives the policy makes as many worlds as the rung has, not all that it was trained in
        made = {k: v for k, v in self.setup.environment["options"].items() if k != "worlds"}
        notes = {"score": score, "seed": seed, "commit": COMMIT, "tree": self.record["tree"], **when(row)}
        policy = policy_of(self.setup.learner, state, {**self.setup.environment, "options": made}, notes)
        save_policy(policy, self.args.out / f"{self.name}_seed{seed}{word}.npz")

    def __call__(self, seed: int) -> None:
        """Trains and scores one seed."""
        args, best = self.args, -1.0
        run: dict[str, Any] = {"seed": seed, "scores": [], "epochs": []}
        self.record["seeds"].append(run)

        def look(policy: Any, state: Any, epochs: list[dict[str, Any]]) -> float:
            nonlocal best
            begin, row, run["epochs"] = time.monotonic(), epochs[-1], plainly(epochs)
            found = self.judge(self.setup.unseen, policy, DURING)
            run["scores"].append({**when(row), "seed": DURING, "rows": found})
            self.store(seed, state, row, found["policy"], "_last")
            good = found["policy"]["success"]
            if good > best:
                best = good
                self.store(seed, state, row, found["policy"])
            save(args.out, self.name, self.record)
            say(f"{row['steps']:.3g} steps, {row['elapsed_s']:.0f} s: scored in {time.monotonic() - begin:.0f} s")
            shown(found, "    ")
            return good

        config = RunConfig(self.steps, seed, max(1.0, self.clock.left - args.last), math.inf, quiet=True)
        result, policy, row = trained(self.setup, config, args.every, look, args.target)
        found, last = self.judge(self.setup.unseen, policy, FINAL), result.rows[-1]
        run["final"] = {**when(row), "seed": FINAL, "rows": found}
        run["epochs"] = plainly(result.rows)
        if math.isinf(args.every):
            self.store(seed, result.state, row, found["policy"])
        save(args.out, self.name, self.record)
        shown(found, f"seed {seed} final ")
        say(f"done after {self.clock.spent:.0f} s, {last['steps']:.3g} steps, {last['steps_per_s']:.3g} steps/s")


def plainly(epochs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Epochs without the terms of their reward."""
    return [{k: v for k, v in row.items() if not k.startswith("reward_")} for row in epochs]


def shown(rows: Mapping[str, Any], before: str) -> None:
    """Prints the rows of a score."""
    for agent, one in rows.items():
        say(f"{before}{agent}: {percent(one)}, SPL {one['spl']:.2f}, {one['collisions_per_km']:.0f}/km, {ends(one)}")


def main() -> None:
    """Trains, scores and writes; or keeps and ships what earlier runs wrote."""
    args = words()
    if args.keep:
        say(str(keep_rung(args.keep)))
    if args.ship:
        say(str(ship_rung(args.ship)))
    if args.keep or args.ship:
        return
    trials = Trials(args)
    for seed in in_time(trials.clock, args.seeds):
        trials(seed)


if __name__ == "__main__":
    main()
