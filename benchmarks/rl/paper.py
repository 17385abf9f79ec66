"""Part `paper` of measure.py: the paper's own task with one rover per run, on CPU cores.

python benchmarks/rl/measure.py paper --only steady --seconds 900 --out runs/paper      # a core a run
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import time
import tomllib
from typing import Any

import jax
from harness import KEPT, Clock, Judge, Setup, save, say, training_of

from lunar_mjx.agents.configs import override
from lunar_mjx.agents.train import RunConfig, train

VARIANTS: dict[str, dict[str, Any]] = tomllib.loads((KEPT / "paper_variants.toml").read_text(encoding="utf-8"))
MAIN = "signed"
JUDGED_EVERY, JUDGED, JUDGED_SEED = 2500, 24, 99
"""Steps between scores of the policy without noise, their episodes, and the seed of these."""


def about(variant: str) -> dict[str, Any]:
    """Options of a variant's environment, with those of the variant that it is like, and settings of its trainings."""
    found = VARIANTS[variant]
    like = VARIANTS[found["like"]]["options"] if "like" in found else {}
    return {"options": {**like, **found.get("options", {})}, "settings": found.get("settings", {})}


def run(args: argparse.Namespace, core: int, variant: str, name: str, seed: int, seconds: float) -> dict[str, Any]:
    """One training: its settings, every episode, and the successes of its policy without noise.

    Puts the process onto a core of its own, without the GPU.
    """
    os.sched_setaffinity(0, {core})
    os.environ |= {"CUDA_VISIBLE_DEVICES": "", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
    jax.config.update("jax_platforms", "cpu")
    clock = Clock(seconds)
    told = about(variant)
    training = override(training_of(args, name), epoch_steps=250, **told["settings"])
    training = dataclasses.replace(training, options={**training.options, **told["options"]})
    setup = Setup(training)
    judge = Judge(setup.env, JUDGED, {"policy": setup.policies()["policy"]})
    quiet: dict[str, list[float]] = {"step": [], "success": []}

    def after_epoch(_: Any, state: Any, row: dict[str, Any]) -> dict[str, Any]:
        if row["steps"] % JUDGED_EVERY == 0:
            quiet["step"].append(row["steps"])
            quiet["success"].append(judge(setup.env.params, setup.policy(state), JUDGED_SEED)["policy"]["success"])
        return {"stop": clock.left < 0.0}

    config = RunConfig(int(args.steps or training.steps), seed, quiet=True)
    result = train(setup.learner, config, None, None, after_epoch)
    episodes = {k: result.episodes[k] for k in ("episode_return", "success")}
    taken = {"steps": result.rows[-1]["steps"], "elapsed_s": clock.spent}
    return {"train": setup.about["train"], "run": {"seed": seed, **taken, "episodes": episodes, "without_noise": quiet}}


def paper(args: argparse.Namespace, clock: Clock) -> None:
    """Trains every variant, algorithm and seed in a process of its own; leaves those that take too long."""
    jobs = [
        (variant, name, seed)
        for variant in args.only
        for seed in range(VARIANTS[variant]["seeds"])
        for name in VARIANTS[variant].get("algorithms", ("paper-td3", "paper-ddpg"))
    ]
    cores = sorted(os.sched_getaffinity(0))
    jobs = jobs[: max(2, len(cores))]
    say(f"paper: {len(jobs)} runs of {clock.left:.0f} s on CPU cores")
    train: dict[str, Any] = {}
    found: dict[str, Any] = {MAIN: {**about(MAIN), "runs": {}}}
    # compiling, before which a run looks at no clock, has a minute more
    deadline = time.monotonic() + clock.left + 60.0
    with multiprocessing.get_context("spawn").Pool(len(jobs), maxtasksperchild=1) as pool:
        words = [(args, cores[i % len(cores)], *job, clock.left) for i, job in enumerate(jobs)]
        for (variant, name, seed), promise in zip(jobs, [pool.apply_async(run, w) for w in words], strict=True):
            try:
                told = promise.get(max(0.1, deadline - time.monotonic()))
            except Exception as error:  # whatever ended it, the others count
                say(f"paper: {variant}, {name}, seed {seed} left nothing: {type(error).__name__} {error}")
                continue
            if variant == MAIN:
                train[name] = told["train"]
            runs = found.setdefault(variant, {**about(variant), "runs": {}})["runs"]
            runs.setdefault(name, []).append(told["run"])
    save(args.out, "paper", {"variant": MAIN, **found.pop(MAIN), "train": train, "others": found})
