"""Trainings from several seeds with the same programs, scored beside agents that learn nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from harness import COMMIT, DURING, FINAL, Clock, Judge, Setup, ends, in_threads, percent, save, say, trained, when

from benchmarks.provenance import tree
from lunar_mjx.agents.configs import Training
from lunar_mjx.agents.policy import policy_of, save_policy
from lunar_mjx.agents.train import RunConfig


class Trials:
    """A training with its judges, compiled side by side; called with a seed, it trains and scores that.

    Every score writes `NAME.json`, `NAME_seedN.npz` (the best so far) and `NAME_seedN_last.npz`, so that a run that is
    cut off leaves what it had.

    Args:
      training: what to train. name: of the files. out: folder that they go to. clock: of everything.
      episodes: of each row of a score. rules: makes agents that learn nothing for an environment.
      begin_with: policy that all seeds begin with, if any.
      seen: choose the best policy by its score on the ground and soils of its training, and score it alone meanwhile;
        else by the unseen ones, beside the other agents.
      agents: makes the policy's agents for a `Setup`, the one that is trained first; `Setup.policies` if None.
      last: choose nothing; the last policy is the one that is scored and kept.
      beside: called with the `Setup` while the rest compiles, if given.
    """

    def __init__(
        self,
        training: Training,
        name: str,
        out: Path,
        clock: Clock,
        episodes: int,
        rules: Callable[[Any], Mapping[str, Any]],
        seen: bool = False,
        begin_with: str = "",
        agents: Callable[[Setup], Mapping[str, Any]] = Setup.policies,
        last: bool = False,
        beside: Callable[[Setup], Any] = lambda _: None,
    ):
        self.name, self.out, self.clock, self.seen, self.last, files = name, out, clock, seen, last, tree()
        self.begin_with = begin_with
        out.mkdir(parents=True, exist_ok=True)
        self.setup = Setup(training)
        env, policies = self.setup.env, agents(self.setup)
        self.own = next(iter(policies))
        self.judge = Judge(env, episodes, policies, rules(env))
        self.during = Judge(env, episodes, {self.own: policies[self.own]}) if seen else self.judge
        worlds_s = clock.spent
        judges = dict.fromkeys((self.judge, self.during))
        compile_s = in_threads(lambda: self.setup.compile(*judges), lambda: beside(self.setup))
        say(f"worlds {worlds_s:.0f} s, compiled after {compile_s}, {clock.left:.0f} s left")
        learner = type(training.train.algorithm).__name__
        about = {"tree": files, "training": name, **self.setup.about, "learner": learner}
        about |= {"begin_with": begin_with} if begin_with else {}
        self.record: dict[str, Any] = {**about, "worlds_s": worlds_s, "compile_s": compile_s, "seeds": []}

    def save(self) -> None:
        """Writes the record."""
        save(self.out, self.name, self.record)

    def store(self, seed: int, state: Any, row: Mapping[str, Any], score: Any, word: str = "") -> None:
        """Writes the policy of a state; `word` ends the file's name."""
        # whoever drives the policy makes as many worlds as the rung has, not all that it was trained in
        made = {k: v for k, v in self.setup.environment["options"].items() if k != "worlds"}
        notes = {"score": score, "seed": seed, "commit": COMMIT, "tree": self.record["tree"], **when(row)}
        policy = policy_of(self.setup.learner, state, {**self.setup.environment, "options": made}, notes)
        save_policy(policy, self.out / f"{self.name}_seed{seed}{word}.npz")

    def __call__(self, seed: int, steps: int, seconds: float, every: float, target: float = math.inf) -> Any:
        """The last state of a seed's training, which ends after environment steps, s, or with a policy of a success.

        Args:
          every: s of training between scores; with none but the last (inf) nothing is chosen.
        """
        best, unseen, run = -1.0, self.setup.unseen, {"seed": seed, "scores": [], "epochs": []}
        self.record["seeds"].append(run)

        def look(policy: Any, state: Any, epochs: list[dict[str, Any]]) -> float:
            nonlocal best
            row, run["epochs"] = epochs[-1], plainly(epochs)
            found = self.during(unseen, policy, DURING)
            score = {**when(row), "seed": DURING, "rows": found}
            chosen = found[self.own]
            if self.seen:
                score["train"] = chosen = self.during(self.setup.env.params, policy, DURING)[self.own]
            good = row["steps"] if self.last else chosen["success"]
            run["scores"].append(score)
            self.store(seed, state, row, found[self.own], "_last")
            if good > best:
                best = good
                self.store(seed, state, row, found[self.own])
            self.save()
            how = "nothing is chosen" if self.last else f"the best is chosen by {percent(chosen)}"
            say(f"{row['steps']:.3g} steps, {row['elapsed_s']:.0f} s: {how}")
            shown(found, "    ")
            return good

        config = RunConfig(steps, seed, seconds, math.inf, quiet=True, begin_with=self.begin_with)
        result, policy, row = trained(self.setup, config, every, look, target)
        found, last = self.judge(unseen, policy, FINAL), result.rows[-1]
        run["final"], run["epochs"] = {**when(row), "seed": FINAL, "rows": found}, plainly(result.rows)
        if math.isinf(every):
            self.store(seed, result.state, row, found[self.own])
        self.save()
        shown(found, f"seed {seed} final ")
        say(f"done after {self.clock.spent:.0f} s, {last['steps']:.3g} steps, {last['steps_per_s']:.3g} steps/s")
        return result.state


def plainly(epochs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Epochs without the terms of their reward."""
    return [{k: v for k, v in row.items() if not k.startswith("reward_")} for row in epochs]


def shown(rows: Mapping[str, Any], before: str) -> None:
    """Prints the rows of a score."""
    for agent, one in rows.items():
        costs = "" if one["spl"] is None else f"SPL {one['spl']:.2f}, {one['collisions_per_km']:.0f}/km, "
        say(f"{before}{agent}: {percent(one)}, {costs}{ends(one)}")
