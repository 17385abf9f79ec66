"""Parts of measure.py that choose among the policies of a training: `large`, `rung` and `depth`; and `tune`.

    python benchmarks/rl/measure.py large --out runs/large
    python benchmarks/rl/measure.py rung ladder-3 --out runs/rung
    python benchmarks/rl/measure.py depth large-depth --seconds 420 --out runs/depth        # one GPU
    python benchmarks/rl/measure.py tune ladder/3 --repeats 24 --out benchmarks/rl

Rows of a score are of one program and the same unseen episodes: the policy, the policy with all that comes from its
scans blanked, and rules that learn nothing, the reactive one as it was tuned (`ladder.json`, on rung 3 alone). The
final score is of other episodes than those by which the best policy was chosen; with `--every inf` nothing is chosen.
`large` chooses by the score on the ground and soils of the training, so that unseen ground chooses nothing; `depth`
keeps the last policy, a student, and scores it beside itself with its picture at the mean, its teacher, and straight
ahead.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import harness
import jax
import numpy as np
from harness import COMMIT, EXPERIMENTS, KEPT, TREE, Clock, Judge, Setup, read, say, show, when
from rates import Driven

from lunar_mjx.agents import CHOOSING_SEED, FINAL_SEED
from lunar_mjx.agents.configs import Training
from lunar_mjx.agents.evaluate import success_text
from lunar_mjx.agents.policy import policy_of, save_policy
from lunar_mjx.agents.train import RunConfig
from lunar_mjx.commands.train import env_options
from lunar_mjx.envs import make_agent, make_navigation
from lunar_mjx.envs.navigation.observations import CAMERA
from lunar_mjx.envs.scripted import Reactive, reactive_rule

NEEDED = {"mapper": "plan", "reactive": "height_scan"}
"""Blocks of observations that rules steer by: the way on the rover's own map, and the ground ahead."""
RATED = 50
"""Steps of each rover in one repetition of the rate with depth pictures."""


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
        self.judge = Judge(env, args.episodes, policies, rules(env))
        self.during = Judge(env, args.episodes, {self.own: policies[self.own]}) if choose_by == "seen" else self.judge
        worlds_s, judges = clock.spent, dict.fromkeys((self.judge, self.during))
        compile_s = harness.in_threads(lambda: self.setup.compile(*judges), lambda: beside(self.setup))
        say(f"worlds {worlds_s:.0f} s, compiled after {compile_s}, {clock.left:.0f} s left")
        about = {"training": self.name, **self.setup.about, "learner": type(training.train.algorithm).__name__}
        about |= {"begin_with": args.begin_with} if args.begin_with else {}
        self.record: dict[str, Any] = {**about, "worlds_s": worlds_s, "compile_s": compile_s, "seeds": []}

    def save(self) -> None:
        """Writes the record."""
        harness.save(self.args.out, self.name, self.record)

    def store(self, seed: int, state: Any, row: Mapping[str, Any], score: Any, word: str = "") -> None:
        """Writes the policy of a state; `word` ends the file's name."""
        # whoever drives the policy makes as many worlds as the rung has, not all that it was trained in
        made = {k: v for k, v in self.setup.environment["options"].items() if k != "worlds"}
        notes = {"score": score, "seed": seed, "commit": COMMIT, "tree": TREE, **when(row)}
        policy = policy_of(self.setup.learner, state, {**self.setup.environment, "options": made}, notes)
        save_policy(policy, self.args.out / f"{self.name}_seed{seed}{word}.npz")

    def __call__(self, seed: int) -> None:
        """Trains a seed, for as long as the command line and the clock allow, and scores the best of the policies that
        it looks at: every so often and at the end, with `--every inf` not at all, for the last one counts then."""
        args, setup, unseen = self.args, self.setup, self.setup.unseen
        run: dict[str, Any] = {"seed": seed, "scores": [], "epochs": []}
        self.record["seeds"].append(run)
        best, due = (-math.inf, None, {}), args.every

        def look(state: Any, row: dict[str, Any]) -> float:
            nonlocal best
            policy = setup.policy(state)
            found = self.during(unseen, policy, CHOOSING_SEED)
            score, chosen = {**when(row), "seed": CHOOSING_SEED, "rows": found}, found[self.own]
            if self.choose_by == "seen":
                score["train"] = chosen = self.during(setup.env.params, policy, CHOOSING_SEED)[self.own]
            good = row["steps"] if self.choose_by == "last" else chosen["success"]
            run["scores"].append(score)
            self.store(seed, state, row, found[self.own], "_last")
            if good > best[0]:
                best = (good, policy, row)
                self.store(seed, state, row, found[self.own])
            self.save()
            say(f"{row['steps']:.3g} steps, {row['elapsed_s']:.0f} s, {self.choose_by} {success_text(chosen)}")
            show(found)
            return good

        def after_epoch(_: Any, state: Any, row: dict[str, Any]) -> dict[str, Any]:
            nonlocal due
            run["epochs"].append(row)
            if row["elapsed_s"] < due:
                return {}
            due = row["elapsed_s"] + args.every
            return {"stop": look(state, row) >= args.stop_at}

        seconds = min(args.seed_seconds, max(1.0, self.clock.left - args.last))
        config = RunConfig(int(args.steps), seed, seconds, math.inf, quiet=True, begin_with=args.begin_with)
        result = setup.train(config, after_epoch)
        last = run["epochs"][-1]
        if math.isinf(args.every):
            best = (0.0, setup.policy(result.state), last)
        elif not run["scores"] or run["scores"][-1]["steps"] < last["steps"]:
            look(result.state, last)
        _, policy, row = best
        found = self.judge(unseen, policy, FINAL_SEED)
        run["final"] = {**when(row), "seed": FINAL_SEED, "rows": found}
        if math.isinf(args.every):
            self.store(seed, result.state, row, found[self.own])
        self.save()
        say(f"seed {seed} after {self.clock.spent:.0f} s, {last['steps']:.3g} steps, {last['steps_per_s']:.3g} steps/s")
        show(found)


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
    training, plan = harness.training_of(args, args.training, args.learner), EXPERIMENTS[args.part]
    args.steps = args.steps or training.steps
    trials = Trials(args, training, clock, lambda env: rules(env, plan["rules"]), plan["choose_by"])
    if plan["choose_by"] == "seen":
        setup, policy = trials.setup, trials.setup.policy(trials.setup.learner.init(10_000))
        untrained = trials.judge(setup.unseen, policy, FINAL_SEED)["policy"]
        trials.record |= {"rover": args.rover, "target": args.target, "untrained": untrained}
    for seed in harness.in_time(clock, args.seeds):
        trials(seed)


def depth(args: argparse.Namespace, clock: Clock) -> None:
    """Compiles all programs side by side, measures the rate of the environment alone under random actions with as many
    rovers as the training has (each repetition goes on from where the one before ended), trains in time and scores."""
    training, driven = harness.training_of(args, args.training), []

    def agents(setup: Setup) -> dict[str, Any]:
        pictures = tuple(name for name in setup.env.blocks if name.startswith(CAMERA))
        student, blanked = setup.policies(pictures).values()
        teacher = setup.learner.agent.teacher
        return {"student": student, "blanked": blanked, "teacher": lambda _, state, key: teacher.act(state.privileged)}

    def rules(env: Any) -> dict[str, Any]:
        return {"straight": make_agent("scripted", env)}

    def beside(setup: Setup) -> None:
        driven.append(Driven(setup.env, training.train.envs, RATED))

    args.steps = args.steps or training.steps
    trials = Trials(args, training, clock, rules, "last", agents, beside)
    # One device of several: the rate is of one, and a state over a mesh is none that the program was compiled for.
    state = jax.device_put(jax.device_get(trials.setup.learner.init(args.seeds[0]).env))
    trials.record["rate"] = rate = driven[0].rate(state, args.repeats)
    del state
    say(f"{rate['env_steps_per_s']:,.0f} environment steps/s ({rate['least']:,.0f} to {rate['most']:,.0f})")
    trials(args.seeds[0])
    epochs = trials.record["seeds"][0]["epochs"]
    trials.record["train_steps_per_s"] = statistics.median(row["steps_per_s"] for row in epochs)
    trials.save()


def tune(args: argparse.Namespace, clock: Clock) -> None:
    """Scores random settings of the reactive rule on a rung's training worlds, as many as there are repeats, those that
    the rule has now among them. The tried settings of other rungs, and all else in `ladder.json`, are kept."""
    rover, seed, options = args.rover, args.seeds[0], env_options(args.env)
    env, rng = make_navigation(args.training, rover, **options), np.random.default_rng(seed)
    ranges = {k: np.log(bounds) for k, bounds in EXPERIMENTS["tune"]["searched"].items()}
    drawn = [{k: math.exp(rng.uniform(*bounds)) for k, bounds in ranges.items()} for _ in range(args.repeats - 1)]
    tried = [Reactive(), *(Reactive(**settings) for settings in drawn)]
    judge = Judge(env, args.episodes, {}, {str(s): reactive_rule(env, s) for s in tried})
    judge.compile(env.params)
    rows = [
        {"settings": dataclasses.asdict(s), "success": row["success"], "return": row["episode_return"]}
        for s, row in zip(tried, judge(env.params, (), seed).values(), strict=True)
    ]
    # where nobody arrives, the way towards the goal tells settings apart
    rows.sort(key=lambda r: (r["success"], r["return"]), reverse=True)
    about = {"commit": COMMIT, "seed": seed, "episodes": args.episodes, "rover": rover, "options": options}
    about |= {"device": jax.devices()[0].device_kind, "wall_s": clock.spent}
    record = {"tuned": {}, **(read(args.out / "ladder.json") or {}), "rover": rover}
    record["tuned"][args.training.partition("/")[2]] = {**about, "rows": rows}
    harness.write(args.out / "ladder.json", record)
    say("\n".join(str(row) for row in rows))
