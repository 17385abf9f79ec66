"""Part `brax` of measure.py: brax's PPO and SAC on the task `large`, scored as TD3 is.

    python benchmarks/rl/measure.py brax --out runs/brax      # one GPU

Both see what the policy of TD3 sees; brax's critics get nothing privileged. Time is brax's own count of training,
without scores and, for the first epoch, without compilation.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import json
import math
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import DURING, FINAL, KEPT, Clock, Judge, percent, reached, save, say, training_of

from lunar_mjx.agents.run import unseen_params
from lunar_mjx.commands.train import pairs
from lunar_mjx.envs import make

SETTINGS = tomllib.loads((KEPT / "brax_settings.toml").read_text(encoding="utf-8"))
MOST_EPOCHS = 5000


class OutOfTime(Exception):
    """Ends a training of brax, which has no end of its own but its steps."""


def train(name: str, settings: dict[str, Any], seed: int, per_epoch: int, env: Any, look: Callable[..., None]) -> None:
    """Trains with one of brax's learners until `look` raises `OutOfTime`.

    Args:
      name: `ppo` or `sac`. per_epoch: training steps between two looks.
      look: called before the training and after every epoch with steps, s of training since brax last told, what makes
        a policy of parameters, and the parameters; takes the place of brax's evaluator.
    """
    from brax.training import acting

    from lunar_mjx.envs.brax_env import BraxEnv, wrap

    agent = f"brax.training.agents.{name}"
    learner, networks = (importlib.import_module(f"{agent}.{part}") for part in ("train", "networks"))
    make_networks = getattr(networks, f"make_{name}_networks")
    step = math.prod(settings[k] for k in SETTINGS["step"][name])

    def evaluator(_: Any, make_policy: Any, **__: Any) -> Any:
        def run_evaluation(params: Any, training_metrics: Any, **_: Any) -> dict[str, Any]:
            return {"seen": (float(training_metrics.get("training/walltime", 0.0)), make_policy, params)}

        return SimpleNamespace(run_evaluation=run_evaluation)

    theirs, acting.Evaluator = acting.Evaluator, evaluator
    try:
        learner.train(
            BraxEnv(env),
            num_timesteps=MOST_EPOCHS * per_epoch * step,
            num_evals=MOST_EPOCHS + 1,
            episode_length=env.episode_steps,
            wrap_env_fn=wrap,
            network_factory=functools.partial(make_networks, **SETTINGS["networks"][name]),
            seed=seed,
            deterministic_eval=True,
            max_devices_per_host=1,
            progress_fn=lambda steps, metrics: look(steps, *metrics["seen"]),
            num_eval_envs=1,
            **settings,
        )
    except OutOfTime:
        pass
    finally:
        acting.Evaluator = theirs


class Run:
    """Scores of one training, whose policy is scored by the judge of this benchmark.

    Args:
      env, params, episodes: where policies are scored. target: success rate whose time is kept.
      clock: ends the training. keep: called with the record after every epoch.
    """

    def __init__(self, env: Any, params: Any, episodes: int, target: float, clock: Clock, keep: Callable[[dict], None]):
        self.params, self.target, self.clock, self.keep = params, target, clock, keep
        self.judge = Judge(env, episodes, {"policy": lambda p, state, key: self.make_policy(p)(state.obs, key)[0]})
        self.rows: list[dict[str, Any]] = []
        self.walltimes: list[float] = []

    def look(self, steps: int, walltime: float, make_policy: Any, policy: Any) -> None:
        """Scores the policy; the first call, before any training, compiles the judge beside brax's own compiling."""
        self.make_policy, self.policy = make_policy, policy
        self.walltimes.append(walltime)
        if len(self.walltimes) == 1:
            self.ready = ThreadPoolExecutor(1).submit(self.judge.compile, self.params, policy)
            return
        self.ready.result()
        self.rows.append({"steps": int(steps), **self.score(DURING)})
        self.keep(self.record())
        if self.clock.left < 0.0:
            raise OutOfTime

    def score(self, seed: int) -> dict[str, Any]:
        """Score of the last parameters."""
        return self.judge(self.params, self.policy, seed)["policy"]

    def record(self) -> dict[str, Any]:
        """The scores; the first epoch, which compiles, counts like the quickest of the others."""
        first, *rest = [float(s) for s in np.diff(self.walltimes)] or [math.nan]
        times = [min(rest, default=math.nan) + sum(rest[:i]) for i in range(len(self.rows))]
        rows = [{**row, "elapsed_s": t} for row, t in zip(self.rows, times, strict=True)]
        about = {"first_epoch_s": first, "process_s": self.clock.spent}
        return {"unseen": rows, **about, **reached(rows, self.target)}


def brax(args: argparse.Namespace, clock: Clock) -> None:
    """PPO, then SAC, each for half of the time that is left."""
    if not hasattr(jax, "device_put_replicated"):  # brax's trainers were written for an older JAX
        jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda a: jnp.stack([a] * len(devices)), tree)
    asked, args.set = pairs("--set", args.set), []  # settings of brax, not of the training
    training = training_of(args, args.training)
    env = make(training.environment, **training.options)
    unseen, runs = unseen_params(env, training.unseen), {}
    told = {"rover": args.rover, "target": args.target, "runs": runs}
    for i, name in enumerate(("ppo", "sac")):
        settings = {**SETTINGS[name], **{k: json.loads(v) for k, v in asked.items() if k in SETTINGS[name]}}
        about = {"settings": settings, "networks": SETTINGS["networks"][name], "seed": args.seeds[0]}

        def keep(record: dict[str, Any], name: str = name, about: dict[str, Any] = about) -> None:
            runs[name] = {**runs.get(name, {}), **about, **record}
            save(args.out, "brax", told)

        run = Run(env, unseen, args.episodes, args.target, Clock(clock.left / (2 - i) - 8.0), keep)
        try:
            train(name, settings, args.seeds[0], SETTINGS["per_epoch"][name], env, run.look)
            keep({**run.record(), "final": run.score(FINAL)})
            say(f"{name}: {percent(runs[name]['final'])} after {run.rows[-1]['steps']:,} steps")
        except Exception as error:  # the other one still runs
            keep({**run.record(), "error": f"{type(error).__name__}: {error}"})
            say(f"{name}: {runs[name]['error']}")
