"""Part `brax` of measure.py: brax's PPO and SAC on the task `large`, scored as TD3 is.

Both see what the policy of TD3 sees; brax's critics get nothing privileged. Time is brax's own count of training,
without scores and, for the first epoch, without compilation.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import math
import tomllib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import DURING, FINAL, Clock, Judge, reached, save, say, training_of
from large import episodes_of
from tables import table_brax

from lunar_mjx.agents.run import unseen_params
from lunar_mjx.envs import make

SETTINGS = tomllib.loads(Path(__file__).with_name("brax_settings.toml").read_text(encoding="utf-8"))
MOST_EPOCHS = 5000


class OutOfTime(Exception):
    """Ends a training of brax, which has no end of its own but its steps."""


class Run:
    """One training; takes the place of brax's evaluator, so that the judge of this benchmark scores the policy.

    Args:
      name: `ppo` or `sac`. env, params, episodes: where policies are scored. target: success rate whose time is kept.
      clock: ends the training. keep: called with the record after every epoch.
    """

    def __init__(
        self, name: str, scored: tuple[Any, Any, int], target: float, clock: Clock, keep: Callable[[dict], None]
    ):
        self.name, self.scored, self.target, self.clock, self.keep = name, scored, target, clock, keep
        self.rows: list[dict[str, Any]] = []
        self.walltimes = [0.0]
        self.judge: Judge | None = None
        self.ready: Future[None]

    def evaluator(self, _: Any, make_policy: Any, **__: Any) -> Run:
        """What brax takes for an evaluator of this training."""
        self.make_policy = make_policy
        return self

    def run_evaluation(self, policy_params: Any, training_metrics: Any, **_: Any) -> dict[str, Any]:
        """What brax calls before the training and after every epoch."""
        self.params = policy_params
        return dict(training_metrics)

    def progress(self, steps: int, metrics: dict[str, Any]) -> None:
        """Scores the policy; the first call, before any training, compiles the judge beside brax's own compiling."""
        env, unseen, episodes = self.scored
        if self.judge is None:
            self.judge = Judge(env, episodes, {"policy": self.act})
            self.ready = ThreadPoolExecutor(1).submit(self.judge.compile, unseen, self.params)
            return
        self.walltimes.append(float(metrics["training/walltime"]))
        self.ready.result()
        self.rows.append({"steps": int(steps), **self.score(DURING)})
        self.keep(self.record())
        if self.clock.left < 0.0:
            raise OutOfTime

    def act(self, params: Any, state: Any, key: Any) -> Any:
        """Actions of brax's policy, for the judge."""
        return self.make_policy(params)(state.obs, key)[0]

    def score(self, seed: int) -> dict[str, Any]:
        """Score of the last parameters."""
        assert self.judge is not None
        return self.judge(self.scored[1], self.params, seed)["policy"]

    def record(self) -> dict[str, Any]:
        """The scores; the first epoch, which compiles, counts like the quickest of the others."""
        first, *rest = [float(s) for s in np.diff(self.walltimes)] or [math.nan]
        times = [min(rest, default=math.nan) + sum(rest[:i]) for i in range(len(self.rows))]
        rows = [{**row, "elapsed_s": t} for row, t in zip(self.rows, times, strict=True)]
        about = {"first_epoch_s": first, "process_s": self.clock.spent}
        return {"unseen": rows, **about, **reached(rows, self.target)}

    def train(self, settings: dict[str, Any], seed: int, per_epoch: int) -> None:
        """Trains with one of brax's learners until time is up."""
        from brax.training import acting

        from lunar_mjx.envs.brax_env import BraxEnv, wrap

        agent = f"brax.training.agents.{self.name}"
        learner, networks = (importlib.import_module(f"{agent}.{part}") for part in ("train", "networks"))
        make_networks = getattr(networks, f"make_{self.name}_networks")
        step = math.prod(settings[k] for k in SETTINGS["step"][self.name])
        theirs, env = acting.Evaluator, self.scored[0]
        acting.Evaluator = self.evaluator
        try:
            learner.train(
                BraxEnv(env),
                num_timesteps=MOST_EPOCHS * per_epoch * step,
                num_evals=MOST_EPOCHS + 1,
                episode_length=env.episode_steps,
                wrap_env_fn=wrap,
                network_factory=functools.partial(make_networks, **SETTINGS["networks"][self.name]),
                seed=seed,
                deterministic_eval=True,
                max_devices_per_host=1,
                progress_fn=self.progress,
                num_eval_envs=1,
                **settings,
            )
        except OutOfTime:
            pass
        finally:
            acting.Evaluator = theirs


def brax(args: argparse.Namespace, clock: Clock) -> None:
    """PPO, then SAC, each for half of the time that is left."""
    if not hasattr(jax, "device_put_replicated"):  # brax's trainers were written for an older JAX
        jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda a: jnp.stack([a] * len(devices)), tree)
    training = training_of(args, "large-td3")
    env = make(training.environment, **training.options)
    scored, runs = (env, unseen_params(env, training.unseen), episodes_of(args)), {}
    for i, name in enumerate(("ppo", "sac")):
        settings = {**SETTINGS[name], **(SETTINGS["tiny"][name] if args.tiny else {})}

        def keep(record: dict[str, Any], name: str = name, settings: dict[str, Any] = settings) -> None:
            about = {"settings": settings, "networks": SETTINGS["networks"][name], "seed": args.first_seed}
            runs[name] = {**runs.get(name, {}), **about, **record}
            told = {"rover": args.rover, "target": args.target, "runs": runs}
            say(table_brax(save(args.out, "brax", told))[-1])

        run = Run(name, scored, args.target, Clock(clock.left / (2 - i) - 8.0), keep)
        try:
            run.train(settings, args.first_seed, 3 if args.tiny else SETTINGS["per_epoch"][name])
            keep({**run.record(), "final": run.score(FINAL)})
        except Exception as error:  # the other one still runs
            keep({**run.record(), "error": f"{type(error).__name__}: {error}"})
