"""What the learning benchmarks share: time, files, the command line, trainings made ready, and how they are scored."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from benchmarks.provenance import commit
from lunar_mjx.agents.configs import Training, get_training, override
from lunar_mjx.agents.evaluate import Evaluator
from lunar_mjx.agents.learner import Learner
from lunar_mjx.agents.run import environment_of, learner_agent, unseen_params
from lunar_mjx.agents.train import Result, RunConfig, plain, train
from lunar_mjx.commands.train import env_options, pairs
from lunar_mjx.envs import make

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "benchmarks" / "rl"
"""Where the records lie that the documentation quotes."""
COMMIT = commit()
"""As the process began: files may change while it runs."""
FINAL, DURING = 54321, 12345
"""Seeds of the episodes of final scores, and of scores during training."""
AHEAD = ("height_scan", "far_scan", "plan")
"""Blocks of observations that come from what the rover sees ahead."""
SMALL_TASK = {
    "large": {"terrain": "flat", "goal_distance": (2.0, 4.0), "episode_time": 10.0, "places": 256},
    "ladder": {"worlds": 2, "episode_time": 20.0},
}
SMALL_TRAINING = {
    "envs": 64,
    "batch": 256,
    "updates": 2,
    "actor_layers": (64, 64),
    "critic_layers": (64, 64),
    "atoms": 21,
    "epoch_steps": 24,
    "buffer_steps": 64,
    "minibatches": 2,
    "passes": 1,
}
"""What --tiny measures, for two CPU cores; of the training, what it has."""


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
    part = path.with_suffix(".part")
    part.write_text(json.dumps(plain(record), separators=(",", ":")) + "\n", encoding="utf-8")
    part.replace(path)


def save(out: Path, name: str, record: Mapping[str, Any]) -> dict[str, Any]:
    """Writes a record with the commit, device and versions that it was measured on; returns it with these."""
    device = {"device": jax.devices()[0].device_kind, "devices": jax.device_count()}
    about = {**device, "jax": jax.__version__, "mujoco": mujoco.__version__}
    whole = {"about": about, "commit": COMMIT, **record}
    write(out / f"{name}.json", whole)
    return whole


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


# The command line


def options(doc: str | None, out: Path | None = None) -> argparse.ArgumentParser:
    """A command line with what every benchmark that trains takes; `out` must be given where it is None."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--out", type=Path, default=out, required=out is None)
    add("--seconds", type=float, help="for everything, compiling among it")
    add("--tiny", action="store_true", help="small enough for two CPU cores")
    add("--rover", help="another than the training's")
    add("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of the training")
    add("--env", nargs="*", default=[], metavar="NAME=VALUE", help="options of the environment, as JSON")
    return parser


def training_of(args: argparse.Namespace, name: str, learner: str | None = None) -> Training:
    """A training by its name or file, with the settings of the command line."""
    training = get_training(name, learner)
    options = {**training.options, **({"rover": args.rover} if args.rover else {})}
    small, unseen = {}, dict(training.unseen)
    if args.tiny:
        config = (training.train, training.train.algorithm)
        known = {f.name for c in config for f in dataclasses.fields(c)} - set(getattr(config[1], "UNUSED", ()))
        small = {k: v for k, v in SMALL_TRAINING.items() if k in known}
        less = SMALL_TASK.get(str(options.get("task")).partition("/")[0], {})
        options |= less
        unseen |= {k: v for k, v in less.items() if k == "terrain"}
    training = override(training, **{**small, **pairs("--set", args.set)})
    return dataclasses.replace(training, options={**options, **env_options(args.env)}, unseen=unseen)


# Trainings and their scores


def in_threads(*calls: Callable[[], Any]) -> list[float]:
    """Calls side by side, since XLA lets go of the interpreter while it compiles; s after which each was done."""
    begin = time.monotonic()

    def timed(call: Callable[[], Any]) -> float:
        call()
        return time.monotonic() - begin

    with ThreadPoolExecutor() as pool:
        return [w.result() for w in [pool.submit(timed, call) for call in calls]]


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
