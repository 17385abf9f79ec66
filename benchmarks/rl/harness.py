"""What the learning benchmarks share: time, files, trainings made ready, and how they are scored."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import mujoco

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from benchmarks.provenance import commit, tree
from lunar_mjx.agents.configs import Training, get_training, override
from lunar_mjx.agents.evaluate import Judge, success_text
from lunar_mjx.agents.learner import Learner
from lunar_mjx.agents.run import environment_of, learner_agent, unseen_params
from lunar_mjx.agents.train import Callback, Result, RunConfig, plain, train
from lunar_mjx.commands.train import env_options, pairs
from lunar_mjx.envs import make
from lunar_mjx.files import write_text

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "benchmarks" / "rl"
"""Where the records lie that the documentation quotes."""
COMMIT, TREE = commit(), tree()
"""As the process began: files may change while it runs."""
AHEAD = ("height_scan", "far_scan", "plan")
"""Blocks of observations that come from what the rover sees ahead."""
EXPERIMENTS: dict[str, dict[str, Any]] = tomllib.loads((KEPT / "experiments.toml").read_text(encoding="utf-8"))
"""Settings of each part of `measure.py`."""

say = functools.partial(print, flush=True)
"""Prints a line at once."""


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


def in_threads(*calls: Callable[[], Any]) -> list[float]:
    """Calls side by side, since XLA lets go of the interpreter while it compiles; s after which each was done."""
    clock = Clock(0.0)
    with ThreadPoolExecutor() as pool:
        return [w.result() for w in [pool.submit(lambda call=call: (call(), clock.spent)[1]) for call in calls]]


def command(*words: Any) -> None:
    """Runs a `lunar-mjx` command, as a user types it.

    Raises:
      subprocess.CalledProcessError: it fails.
    """
    subprocess.run([sys.executable, "-m", "lunar_mjx.cli", *map(str, words)], check=True)


def alone_on(core: int | None = None) -> None:
    """Keeps this process, which has used no device yet, off the GPU and to one thread, and on a core if one is told."""
    os.environ |= {"CUDA_VISIBLE_DEVICES": "", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
    jax.config.update("jax_platforms", "cpu")
    if core is not None:
        os.sched_setaffinity(0, {core})


# Records


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


def ends(score: Mapping[str, Any]) -> dict[str, float]:
    """Shares of the ways in which episodes ended, without those in which none did."""
    return {k: round(v, 3) for k, v in score["ends"].items() if v}


def show(scores: Mapping[str, Mapping[str, Any]]) -> None:
    """Prints a line for every score, by its name."""
    for name, score in scores.items():
        costs = "" if score["spl"] is None else f"SPL {score['spl']:.2f}, {score['collisions_per_km']:.0f}/km, "
        say(f"    {name}: {success_text(score)}, {costs}{ends(score)}")


def when(row: Mapping[str, Any]) -> dict[str, Any]:
    """Environment steps and s of training of an epoch's row."""
    return {k: row[k] for k in ("steps", "elapsed_s")}


def reached(scores: Iterable[Mapping[str, Any]], target: float) -> dict[str, Any]:
    """When scores first showed a success rate, as records tell it; None if none did."""
    first = next((s for s in scores if s["success"] >= target), {})
    return {"seconds_to_target": first.get("elapsed_s"), "steps_to_target": first.get("steps")}


# Trainings


def training_of(args: argparse.Namespace, name: str, learner: str | None = None) -> Training:
    """A training by its name or file, with the settings of the command line."""
    training = override(get_training(name, learner), **pairs("--set", args.set))
    options = {**training.options, **({"rover": args.rover} if args.rover else {}), **env_options(args.env)}
    unseen = {**training.unseen, **({"terrain": args.unseen_terrain} if args.unseen_terrain else {})}
    return dataclasses.replace(training, options=options, unseen=unseen)


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
        return {"policy": learner_agent(self.learner), "policy, scans blanked": learner_agent(self.learner, ahead)}

    def judge(self, episodes: int) -> Judge:
        """A judge of the policy alone."""
        return Judge(self.env, episodes, {"policy": learner_agent(self.learner)})

    def compile(self, *judges: Judge) -> list[float]:
        """Compiles the learner and, beside it, the judges of its policies; s after which both were done."""

        def prepare() -> None:
            self.unseen = unseen_params(self.env, self.training.unseen)
            policy = jax.eval_shape(self.learner.policy, self.learner.abstract())
            with jax.default_matmul_precision(self.learner.config.precision):
                for judge in judges:
                    judge.compile(self.unseen, policy)

        return in_threads(self.learner.compile, prepare)

    def train(self, config: RunConfig, after_epoch: Callback | None = None) -> Result:
        """Trains without a folder; `after_epoch` is called as `lunar_mjx.agents.train.train` calls it."""
        return train(self.learner, config, None, self.environment, after_epoch)

    def policy(self, state: Any) -> Any:
        """The policy of a training's state, on the host."""
        return jax.device_get(self.learner.policy(state))
