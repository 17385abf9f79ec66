"""What the learning benchmarks share: time, files, trainings made ready, and how they are scored."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from benchmarks.provenance import commit, tree
from lunar_mjx.agents.configs import Training, get_training, override
from lunar_mjx.agents.evaluate import Evaluator
from lunar_mjx.agents.learner import Learner
from lunar_mjx.agents.run import environment_of, learner_agent, unseen_params
from lunar_mjx.agents.train import Result, RunConfig, plain, train
from lunar_mjx.commands.train import env_options, pairs
from lunar_mjx.envs import make
from lunar_mjx.files import write_text

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "benchmarks" / "rl"
"""Where the records lie that the documentation quotes."""
COMMIT, TREE = commit(), tree()
"""As the process began: files may change while it runs."""
FINAL, DURING = 54321, 12345
"""Seeds of the episodes of final scores, and of scores during training."""
AHEAD = ("height_scan", "far_scan", "plan")
"""Blocks of observations that come from what the rover sees ahead."""
EXPERIMENTS: dict[str, dict[str, Any]] = tomllib.loads((KEPT / "experiments.toml").read_text(encoding="utf-8"))
"""Settings of each part of `measure.py`."""


class Clock:
    """Time of a part of the benchmark, s."""

    def __init__(self, seconds: float):
        self.seconds, self._begin = seconds, time.monotonic()

    @property
    def spent(self) -> float:
        return time.monotonic() - self._begin

    @property
    def left(self) -> float:
        return self.seconds - self.spent


def in_time(clock: Clock, jobs: Iterable[Any]) -> Iterator[Any]:
    """Jobs, as long as there is time for one that takes as long as the longest: none is cut short."""
    longest = 0.0
    for job in jobs:
        if clock.left < longest:
            say(f"no time for {job}: {clock.left:.0f} s left")
            return
        begin = clock.spent
        yield job
        longest = max(longest, clock.spent - begin)


# Files and words


def read(path: Path) -> Any:
    """What a JSON file holds, None where there is none."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def write(path: Path, record: Any) -> None:
    """Writes a record so that a kill never leaves half of one."""
    write_text(path, json.dumps(plain(record), separators=(",", ":")) + "\n")


def save(out: Path, name: str, record: Mapping[str, Any]) -> None:
    """Writes a record with the commit, device and versions that it was measured on."""
    device = {"device": jax.devices()[0].device_kind, "devices": jax.device_count()}
    about = {**device, "jax": jax.__version__, "mujoco": mujoco.__version__}
    write(out / f"{name}.json", {"about": about, "commit": COMMIT, "tree": TREE, **record})


def say(text: str) -> None:
    """Prints a line at once."""
    print(text, flush=True)


def percent(score: Mapping[str, Any]) -> str:
    """A success rate with its 95 % interval."""
    return f"{100 * score['success']:.1f} % ({100 * score['low']:.1f} to {100 * score['high']:.1f})"


def ends(score: Mapping[str, Any]) -> dict[str, float]:
    """Shares of the ways in which episodes ended, without those in which none did."""
    return {k: round(v, 3) for k, v in score["ends"].items() if v}


def when(row: Mapping[str, Any]) -> dict[str, Any]:
    """Environment steps and s of training of an epoch's row."""
    return {k: row[k] for k in ("steps", "elapsed_s")}


def reached(scores: Iterable[Mapping[str, Any]], target: float) -> dict[str, Any]:
    """When scores first showed a success rate, as records tell it; None if none did."""
    first = next((s for s in scores if s["success"] >= target), {})
    return {"seconds_to_target": first.get("elapsed_s"), "steps_to_target": first.get("steps")}


def command(*words: Any) -> None:
    """Runs a `lunar-mjx` command, as a user types it.

    Raises:
      subprocess.CalledProcessError: it fails.
    """
    subprocess.run([sys.executable, "-m", "lunar_mjx.cli", *map(str, words)], check=True)


# Trainings and their scores


def in_threads(*calls: Callable[[], Any]) -> list[float]:
    """Calls side by side, since XLA lets go of the interpreter while it compiles; s after which each was done."""
    begin = time.monotonic()

    def timed(call: Callable[[], Any]) -> float:
        call()
        return time.monotonic() - begin

    with ThreadPoolExecutor() as pool:
        return [w.result() for w in [pool.submit(timed, call) for call in calls]]


def training_of(args: argparse.Namespace, name: str, learner: str | None = None) -> Training:
    """A training by its name or file, with the settings of the command line."""
    training = override(get_training(name, learner), **pairs("--set", args.set))
    options = {**training.options, **({"rover": args.rover} if args.rover else {}), **env_options(args.env)}
    unseen = {**training.unseen, **({"terrain": args.unseen_terrain} if args.unseen_terrain else {})}
    return dataclasses.replace(training, options=options, unseen=unseen)


class Judge:
    """Scores agents on the same episodes, side by side in one program.

    Args:
      env: the environment. episodes: of each agent.
      policies: by name, functions of (policy, state, key) to actions; `policy` is whatever they share.
      rules: by name, functions of (state, key) to actions.
    """

    def __init__(self, env: Any, episodes: int, policies: Mapping[str, Any], rules: Mapping[str, Any] | None = None):
        rules = rules or {}
        self.names = (*policies, *rules)
        row = jnp.repeat(jnp.arange(len(self.names)), episodes)

        def act(policy: Any, state: Any, key: Any) -> Any:
            actions = [agent(policy, state, key) for agent in policies.values()]
            actions += [rule(state, key) for rule in rules.values()]
            return jnp.take_along_axis(jnp.stack(actions), row[None, :, None], axis=0)[0]

        self._evaluator = Evaluator(env, act, episodes, len(self.names))

    def compile(self, params: Any, policy: Any = ()) -> None:
        """Compiles ahead for the environment's parameters; shapes suffice for the policy."""
        # without where the learner's devices hold it
        shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), policy)
        self._evaluator.compile(params, shapes)

    def __call__(self, params: Any, policy: Any, seed: int) -> dict[str, dict[str, Any]]:
        """The score of every agent by name."""
        scores = self._evaluator.scores(params, jax.device_put(policy), seed)
        return {name: score.record() for name, score in zip(self.names, scores, strict=True)}


class Setup:
    """A training made: its environment and learner and, once compiled, the parameters of unseen ground.

    Args:
      training: what to train. env: its environment, if that is not made by the training's options.
    """

    unseen: Any = None

    def __init__(self, training: Training, env: Any = None):
        self.training = training
        self.env: Any = make(training.environment, **training.options) if env is None else env
        self.learner = Learner(self.env, training.train)
        self.environment = environment_of(training)
        self.about = {"environment": self.environment, "train": plain(dataclasses.asdict(training.train))}

    def policies(self, ahead: Sequence[str] = AHEAD) -> dict[str, Any]:
        """Agents of a judge: the learner's policy, and the same with all that it sees ahead at its mean."""
        trained, blank = learner_agent(self.learner), np.zeros(self.env.observation_size, bool)
        for name in ahead:
            if name in getattr(self.env, "blocks", ()):
                blank[self.env.blocks[name]] = True

        def blanked(policy: Any, state: Any, key: Any) -> Any:
            mean = 0.0 if policy[1] is None else policy[1][0]
            return trained(policy, dataclasses.replace(state, obs=jnp.where(blank, mean, state.obs)), key)

        return {"policy": trained, "policy, scans blanked": blanked}

    def compile(self, *judges: Judge) -> list[float]:
        """Compiles the learner and, beside it, the judges of its policies; s after which both were done."""

        def prepare() -> None:
            self.unseen = unseen_params(self.env, self.training.unseen)
            policy = jax.eval_shape(self.learner.policy, self.learner.abstract())
            with jax.default_matmul_precision(self.learner.config.precision):
                for judge in judges:
                    judge.compile(self.unseen, policy)

        return in_threads(self.learner.compile, prepare)

    def policy(self, state: Any) -> Any:
        """The policy of a training's state, on the host."""
        return jax.device_get(self.learner.policy(state))


Look = Callable[[Any, Any, list[dict[str, Any]]], float]
"""Scores (policy, state, rows of the epochs so far) and says how good it is."""


def trained(
    setup: Setup, run: RunConfig, every: float, look: Look, target: float = math.inf
) -> tuple[Result, Any, dict[str, Any]]:
    """Trains one seed and looks at the policy every so often, and at the last one.

    Args:
      setup: compiled. run: how long. every: s of training between looks; none at all if infinite.
      target: how good a policy ends the training.

    Returns:
      The training's result, the policy that was the best (the last one if none was looked at), and its epoch's row.
    """
    best, due, seen, rows = (-math.inf, None, {}), every, 0, []

    def judged(state: Any) -> float:
        nonlocal best, seen
        policy, row = setup.policy(state), rows[-1]
        good, seen = look(policy, state, rows), row["steps"]
        if good > best[0]:
            best = (good, policy, row)
        return good

    def after_epoch(_: Learner, state: Any, row: dict[str, Any]) -> dict[str, Any]:
        nonlocal due
        rows.append(row)
        if row["elapsed_s"] < due:
            return {}
        due = row["elapsed_s"] + every
        return {"stop": judged(state) >= target}

    result = train(setup.learner, run, None, setup.environment, after_epoch)
    if math.isinf(every):
        return result, setup.policy(result.state), rows[-1]
    if seen < rows[-1]["steps"]:
        judged(result.state)
    return result, *best[1:]


def last_policies(
    arms: Mapping[str, tuple[Setup, Any]],
    tests: Mapping[str, tuple[Judge, Any]],
    clock: Clock,
    args: argparse.Namespace,
) -> Iterator[dict[str, Any]]:
    """Trains every arm from every seed, one after another while there is time, and scores last policies in every test.

    Args:
      arms: a compiled setup, and the parameters of the environment to train on, of the shapes of the setup's own.
      tests: a judge, and the parameters that it scores on.

    Yields:
      A row with the arm, seed, steps, s, return in training, and scores by test.
    """
    for seed, name in in_time(clock, [(seed, name) for seed in args.seeds for name in arms]):
        setup, params = arms[name]
        setup.env.params = params
        result = train(setup.learner, RunConfig(int(args.steps), seed, None, math.inf, quiet=True))
        policy, last = setup.policy(result.state), result.rows[-1]
        scores = {test: judge(where, policy, FINAL)["policy"] for test, (judge, where) in tests.items()}
        about = {"seed": seed, "arm": name, "steps": last["steps"], "train_s": last["elapsed_s"]}
        yield {**about, "episode_return": last.get("episode_return"), "scores": scores}
