"""Parts `large` and `rung` of measure.py: trainings from several seeds, scored beside agents that learn nothing.

    python benchmarks/rl/measure.py large --out runs/large
    python benchmarks/rl/measure.py rung ladder-3 --out runs/rung

Rows of a score are of one program and the same unseen episodes: the policy, the policy with all that comes from its
scans blanked, and rules that learn nothing, the reactive one as it was tuned (`ladder.json`, on rung 3 alone). The
final score is of other episodes than those by which the best policy was chosen; with `--every inf` nothing is chosen.
`large` chooses by the score on the ground and soils of the training, so that unseen ground chooses nothing.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from harness import (
    COMMIT,
    DURING,
    EXPERIMENTS,
    FINAL,
    KEPT,
    TREE,
    Clock,
    Judge,
    Setup,
    ends,
    in_threads,
    in_time,
    percent,
    read,
    save,
    say,
    trained,
    training_of,
    when,
)

from lunar_mjx.agents.configs import Training
from lunar_mjx.agents.policy import policy_of, save_policy
from lunar_mjx.agents.train import RunConfig
from lunar_mjx.envs import make_agent
from lunar_mjx.envs.scripted import Reactive, reactive_rule

NEEDED = {"mapper": "plan", "reactive": "height_scan"}
"""Blocks of observations that rules steer by: the way on the rover's own map, and the ground ahead."""


class Trials:
    """A training with its judges, compiled side by side; called with a seed, it trains and scores that.

    Every score writes `NAME.json`, `NAME_seedN.npz` (the best so far) and `NAME_seedN_last.npz`, so that a run that is
    cut off leaves what it had.

    Args:
      args: the command line. training: what to train. clock: of everything.
      rules: makes agents that learn nothing for an environment.
      choose_by: the best policy is that with the best score on `unseen` ground, beside the other agents; with the best
        score on the ground and soils of its training, `seen`, where it is scored alone; or it is the `last` one.
      agents: makes the policy's agents for a `Setup`, the one that is trained first.
      beside: called with the `Setup` while the rest compiles.
    """

    def __init__(
        self,
        args: argparse.Namespace,
        training: Training,
        clock: Clock,
        rules: Callable[[Any], Mapping[str, Any]],
        choose_by: str = "unseen",
        agents: Callable[[Setup], Mapping[str, Any]] = Setup.policies,
        beside: Callable[[Setup], Any] = lambda _: None,
    ):
        self.args, self.clock, self.choose_by = args, clock, choose_by
        self.name = args.name or Path(args.training).stem
        self.setup = Setup(training)
        env, policies = self.setup.env, agents(self.setup)
        self.own = next(iter(policies))
        alone = {self.own: policies[self.own]}
        self.judge = Judge(env, args.episodes, policies, rules(env))
        self.during = Judge(env, args.episodes, alone) if choose_by == "seen" else self.judge
        worlds_s, judges = clock.spent, dict.fromkeys((self.judge, self.during))
        compile_s = in_threads(lambda: self.setup.compile(*judges), lambda: beside(self.setup))
        say(f"worlds {worlds_s:.0f} s, compiled after {compile_s}, {clock.left:.0f} s left")
        learner = type(training.train.algorithm).__name__
        about = {"training": self.name, **self.setup.about, "learner": learner}
        about |= {"begin_with": args.begin_with} if args.begin_with else {}
        self.record: dict[str, Any] = {**about, "worlds_s": worlds_s, "compile_s": compile_s, "seeds": []}

    def save(self) -> None:
        """Writes the record."""
        save(self.args.out, self.name, self.record)

    def store(self, seed: int, state: Any, row: Mapping[str, Any], score: Any, word: str = "") -> None:
        """Writes the policy of a state; `word` ends the file's name."""
        # whoever drives the policy makes as many worlds as the rung has, not all that it was trained in
        made = {k: v for k, v in self.setup.environment["options"].items() if k != "worlds"}
        notes = {"score": score, "seed": seed, "commit": COMMIT, "tree": TREE, **when(row)}
        policy = policy_of(self.setup.learner, state, {**self.setup.environment, "options": made}, notes)
        save_policy(policy, self.args.out / f"{self.name}_seed{seed}{word}.npz")

    def __call__(self, seed: int) -> None:
        """Trains a seed, for as long as the command line and the clock allow, and scores it."""
        best, unseen, run = -1.0, self.setup.unseen, {"seed": seed, "scores": [], "epochs": []}
        self.record["seeds"].append(run)

        def look(policy: Any, state: Any, epochs: list[dict[str, Any]]) -> float:
            nonlocal best
            row, run["epochs"] = epochs[-1], epochs
            found = self.during(unseen, policy, DURING)
            score = {**when(row), "seed": DURING, "rows": found}
            chosen = found[self.own]
            if self.choose_by == "seen":
                score["train"] = chosen = self.during(self.setup.env.params, policy, DURING)[self.own]
            good = row["steps"] if self.choose_by == "last" else chosen["success"]
            run["scores"].append(score)
            self.store(seed, state, row, found[self.own], "_last")
            if good > best:
                best = good
                self.store(seed, state, row, found[self.own])
            self.save()
            say(f"{row['steps']:.3g} steps, {row['elapsed_s']:.0f} s, {self.choose_by} {percent(chosen)}")
            shown(found)
            return good

        args = self.args
        seconds = min(args.seed_seconds, max(1.0, self.clock.left - args.last))
        config = RunConfig(int(args.steps), seed, seconds, math.inf, quiet=True, begin_with=args.begin_with)
        result, policy, row = trained(self.setup, config, args.every, look, args.stop_at)
        found, last = self.judge(unseen, policy, FINAL), result.rows[-1]
        run["final"], run["epochs"] = {**when(row), "seed": FINAL, "rows": found}, result.rows
        if math.isinf(args.every):
            self.store(seed, result.state, row, found[self.own])
        self.save()
        say(f"seed {seed} after {self.clock.spent:.0f} s, {last['steps']:.3g} steps, {last['steps_per_s']:.3g} steps/s")
        shown(found)


def shown(rows: Mapping[str, Any]) -> None:
    """Prints the rows of a score."""
    for agent, one in rows.items():
        costs = "" if one["spl"] is None else f"SPL {one['spl']:.2f}, {one['collisions_per_km']:.0f}/km, "
        say(f"    {agent}: {percent(one)}, {costs}{ends(one)}")


def rules(env: Any, names: Sequence[str]) -> dict[str, Any]:
    """Agents that learn nothing, as far as the environment shows what they steer by; the reactive one with its best
    settings on this rung where it has been tuned."""
    found = {name: make_agent(name, env) for name in names if name not in NEEDED or NEEDED[name] in env.blocks}
    if tuned := read(KEPT / "ladder.json")["tuned"].get(str(env.config.rung)):
        found.pop("reactive", None)
        found["reactive, tuned"] = reactive_rule(env, Reactive(**tuned["rows"][0]["settings"]))
    return found


def measure(args: argparse.Namespace, clock: Clock) -> None:
    """Trains seed after seed while there is time for a whole one; where the ground of the training chooses the best,
    the policy before its training is scored, too."""
    training, plan = training_of(args, args.training, args.learner), EXPERIMENTS[args.part]
    args.steps = args.steps or training.steps
    trials = Trials(args, training, clock, lambda env: rules(env, plan["rules"]), plan["choose_by"])
    if plan["choose_by"] == "seen":
        setup, policy = trials.setup, trials.setup.policy(trials.setup.learner.init(10_000))
        untrained = trials.judge(setup.unseen, policy, FINAL)["policy"]
        trials.record |= {"rover": args.rover, "target": args.target, "untrained": untrained}
    for seed in in_time(clock, args.seeds):
        trials(seed)
