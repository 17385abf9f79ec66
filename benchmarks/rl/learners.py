"""Parts `brax` and `sb3` of measure.py: other packages' learners on the task `large`, scored as TD3 is.

    python benchmarks/rl/measure.py brax --out runs/brax      # one GPU
    python benchmarks/rl/measure.py sb3 --out runs/sb3        # an hour of a core

brax's PPO and SAC see what the policy of TD3 sees; brax's critics get nothing privileged. Time is brax's own count of
training, without scores and, for the first epoch, without compilation.

`sb3` is Stable-Baselines3's TD3 with its defaults and the paper's action noise N(0, 0.3), on one rover in the seed
paper's engine, PyBullet. The task, its observations, rewards and ends are those of `lunar_mjx.envs`. Soil and motors
are the model's own in every episode, which is easier than the drawn ones of the large-batch training. The record is
written anew every minute; at the end the last policy is scored on unseen ground, goals and soil.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import json
import math
import time
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from harness import COMMIT, KEPT, Clock, Judge, alone_on, ends, reached, save, say, training_of, write

from lunar_mjx.agents import CHOOSING_SEED, FINAL_SEED
from lunar_mjx.agents.evaluate import evaluate, success_text
from lunar_mjx.agents.play import open_agent
from lunar_mjx.agents.policy import policy_of_sb3, save_policy
from lunar_mjx.agents.run import environment_of, unseen_params
from lunar_mjx.commands.train import pairs
from lunar_mjx.envs import make
from lunar_mjx.envs.navigation.env import ENDS

SETTINGS = tomllib.loads((KEPT / "brax_settings.toml").read_text(encoding="utf-8"))
MOST_EPOCHS = 5000


class OutOfTime(Exception):
    """Ends a training of brax, which has no end of its own but its steps."""


class Scorer:
    """Stands in for brax's evaluator: scores the policy of every epoch by this benchmark's judge, until time is up.

    Args:
      args: the command line. env, params: where policies are scored.
      clock: ends the training. keep: called with the record after every epoch.
    """

    def __init__(self, args: argparse.Namespace, env: Any, params: Any, clock: Clock, keep: Callable[[dict], None]):
        self.args, self.env, self.params, self.clock, self.keep = args, env, params, clock, keep
        self.rows: list[dict[str, Any]] = []
        self.walltimes: list[float] = []

    def __call__(self, _: Any, make_policy: Any, **__: Any) -> Scorer:
        """Itself, with a judge of the training's policies: brax calls this to make its evaluator."""
        act = {"policy": lambda params, state, key: make_policy(params)(state.obs, key)[0]}
        self.judge = Judge(self.env, self.args.episodes, act)
        return self

    def run_evaluation(self, policy: Any, training_metrics: Any, **_: Any) -> dict[str, Any]:
        """No metrics: notes the policy and brax's own count of s, and before any training begins to compile."""
        self.policy = policy
        self.walltimes.append(float(training_metrics.get("training/walltime", 0.0)))
        if len(self.walltimes) == 1:
            # beside brax's own compiling
            self.ready = ThreadPoolExecutor(1).submit(self.judge.compile, self.params, policy)
        return {}

    def look(self, steps: int, _: Any) -> None:
        """Scores the policy that was noted, after so many environment steps."""
        if not steps:  # nothing is learnt yet, and the judge is being compiled
            return
        self.ready.result()
        self.rows.append({"steps": int(steps), **self.score(CHOOSING_SEED)})
        self.keep(self.record())
        if self.clock.left < 0.0:
            raise OutOfTime

    def score(self, seed: int) -> dict[str, Any]:
        """Score of the policy that was noted last."""
        return self.judge(self.params, self.policy, seed)["policy"]

    def record(self) -> dict[str, Any]:
        """The scores; the first epoch, which compiles, counts like the quickest of the others."""
        first, *rest = [float(s) for s in np.diff(self.walltimes)] or [math.nan]
        times = [min(rest, default=math.nan) + sum(rest[:i]) for i in range(len(self.rows))]
        rows = [{**row, "elapsed_s": t} for row, t in zip(self.rows, times, strict=True)]
        about = {"first_epoch_s": first, "process_s": self.clock.spent}
        return {"unseen": rows, **about, **reached(rows, self.args.target)}


def learn(name: str, settings: dict[str, Any], scorer: Scorer) -> None:
    """Trains with brax's `ppo` or `sac` until the scorer ends it."""
    from brax.training import acting

    from lunar_mjx.envs.brax_env import BraxEnv, wrap

    agent = f"brax.training.agents.{name}"
    learner, networks = (importlib.import_module(f"{agent}.{part}") for part in ("train", "networks"))
    make_networks = getattr(networks, f"make_{name}_networks")
    per_epoch = SETTINGS["per_epoch"][name] * math.prod(settings[k] for k in SETTINGS["step"][name])
    with mock.patch.object(acting, "Evaluator", scorer), contextlib.suppress(OutOfTime):
        learner.train(
            BraxEnv(scorer.env),
            num_timesteps=MOST_EPOCHS * per_epoch,
            num_evals=MOST_EPOCHS + 1,
            episode_length=scorer.env.episode_steps,
            wrap_env_fn=wrap,
            network_factory=functools.partial(make_networks, **SETTINGS["networks"][name]),
            seed=scorer.args.seeds[0],
            deterministic_eval=True,
            max_devices_per_host=1,
            progress_fn=scorer.look,
            num_eval_envs=1,
            **settings,
        )


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
        runs[name] = {"settings": settings, "networks": SETTINGS["networks"][name], "seed": args.seeds[0]}

        def keep(record: dict[str, Any], name: str = name) -> None:
            runs[name] |= record
            save(args.out, "brax", told)

        scorer = Scorer(args, env, unseen, Clock(clock.left / (2 - i) - 8.0), keep)
        try:
            learn(name, settings, scorer)
            keep({**scorer.record(), "final": scorer.score(FINAL_SEED)})
            say(f"{name}: {success_text(runs[name]['final'])} after {scorer.rows[-1]['steps']:,} steps")
        except Exception as error:  # the other one still runs
            keep({**scorer.record(), "error": f"{type(error).__name__}: {error}"})
            say(f"{name}: {runs[name]['error']}")


def sb3(args: argparse.Namespace, clock: Clock) -> None:
    """Trains until so many seconds of this process's CPU time are over, and scores the policy."""
    alone_on()
    import pybullet
    import stable_baselines3
    import torch
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise

    from lunar_mjx.backends.pybullet import PyBulletBackend
    from lunar_mjx.envs.host_env import HostedEnv

    torch.set_num_threads(1)
    training, path = training_of(args, args.training), args.out / "policy_sb3.npz"
    env, made = HostedEnv(PyBulletBackend, **{**training.options, "randomise": ()}), environment_of(training)
    noise = NormalActionNoise(np.zeros(env.env.action_size), np.full(env.env.action_size, 0.3))
    others = {"seed": args.seeds[0], "device": "cpu", "buffer_size": 200_000}
    model = stable_baselines3.TD3("MlpPolicy", env, action_noise=noise, **others)
    what = "SB3 TD3 defaults, action noise N(0, 0.3), PyBullet reference backend, one rover, one CPU thread"
    versions = {"stable_baselines3": stable_baselines3.__version__, "torch": torch.__version__}
    about = {**versions, "pybullet_api": pybullet.getAPIVersion()}
    asked = {"rover": args.rover, "options": made["options"], "seed": args.seeds[0]}
    record = {"what": what, "about": about, "commit": COMMIT, **asked, "steps": 0, "cpu_s": 0.0, "episodes": []}

    def keep() -> None:
        record["steps"] = model.num_timesteps
        notes = {"algorithm": "stable-baselines3 TD3", "steps": record["steps"], "cpu_s": record["cpu_s"]}
        save_policy(policy_of_sb3(model, made, notes), path)
        write(args.out / "sb3.json", record)

    class Recorder(BaseCallback):
        """Keeps episodes, writes the record and the policy, and stops in time."""

        last = 0.0

        def _on_step(self) -> bool:
            info, now = self.locals["infos"][0], {"cpu_s": time.process_time(), "wall_s": clock.spent}
            if self.locals["dones"][0]:
                end = next((e for e in ENDS if info.get(e if e != "reached" else "success", 0.0) > 0.0), "time")
                told = {k: info[f"episode_{k}"] for k in ("return", "length")}
                episode = {"step": self.num_timesteps, **now, **told, "success": info["success"], "end": end}
                record["episodes"].append(episode)
            over = now["cpu_s"] >= args.seconds
            if over or now["wall_s"] - self.last >= 60.0:
                self.last = now["wall_s"]
                record.update(**now, finished=over)
                keep()
            return not over

    model.learn(int(args.steps), callback=Recorder())
    keep()
    own, agent, unseen = open_agent(str(path))
    record["final"] = evaluate(own, agent, args.episodes, FINAL_SEED, unseen_params(own, unseen)).record()
    keep()
    say(f"{record['steps']:,} steps, {len(record['episodes'])} episodes in {record['cpu_s'] / 60:.0f} min of CPU time")
    say(f"its policy on unseen ground: {success_text(record['final'])} of {args.episodes}, {ends(record['final'])}")
