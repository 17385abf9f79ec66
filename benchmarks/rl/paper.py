"""Part `paper` of measure.py: the paper's own task with one rover per run, on CPU cores."""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import time
import tomllib
from pathlib import Path
from typing import Any

import jax
from harness import Clock, Judge, Setup, say

from lunar_mjx.agents.configs import get_training, override
from lunar_mjx.agents.train import RunConfig, train

VARIANTS: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("paper_variants.toml").read_text("utf-8"))
DEFAULT = ("signed", "printed", "drawn")
MAIN = "signed"
JUDGED_EVERY, JUDGED, JUDGED_SEED = 2500, 24, 99
"""Steps between scores of the policy without noise, their episodes, and the seed of these."""


def about(variant: str) -> dict[str, Any]:
    """Options of a variant's environment, with those of the variant that it is like, and settings of its trainings."""
    found = VARIANTS[variant]
    like = VARIANTS[found["like"]]["options"] if "like" in found else {}
    return {"options": {**like, **found.get("options", {})}, "settings": found.get("settings", {})}


def alone(cores: Any) -> None:
    """Puts a process onto a core of its own, without the GPU."""
    os.sched_setaffinity(0, {cores.get()})
    os.environ |= {"CUDA_VISIBLE_DEVICES": "", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
    jax.config.update("jax_platforms", "cpu")


def start(args: argparse.Namespace, seconds: float) -> tuple[Any, list[Any]]:
    """Starts one process per variant, algorithm and seed; returns them and what they will give."""
    jobs = [
        (args, variant, name, seed, seconds)
        for variant in args.variants
        for seed in range(VARIANTS[variant]["seeds"])
        for name in VARIANTS[variant].get("algorithms", ("paper-td3", "paper-ddpg"))
    ]
    cores = sorted(os.sched_getaffinity(0))
    # two cores are left to the process that drives the GPU
    free = cores[2:] if args.part == "all" and len(cores) > 2 else cores
    jobs = jobs[: 2 if args.tiny else max(2, len(free))]
    context = multiprocessing.get_context("spawn")
    queue = context.SimpleQueue()
    for i in range(len(jobs)):
        queue.put(free[i % len(free)])
    pool = context.Pool(len(jobs), alone, (queue,))
    say(f"paper: {len(jobs)} runs of {seconds:.0f} s on CPU cores")
    return pool, [(job[1:4], pool.apply_async(run, job)) for job in jobs]


def run(args: argparse.Namespace, variant: str, name: str, seed: int, seconds: float) -> dict[str, Any]:
    """One training: its settings, every episode, and the successes of its policy without noise."""
    clock = Clock(seconds)
    training, told, every = get_training(name), about(variant), 96 if args.tiny else JUDGED_EVERY
    training = override(training, epoch_steps=48 if args.tiny else 250, **told["settings"])
    training = dataclasses.replace(training, options={**training.options, **told["options"]})
    setup = Setup(training)
    judge = Judge(setup.env, JUDGED, {"policy": setup.policies()["policy"]})
    quiet: dict[str, list[float]] = {"step": [], "success": []}

    def after_epoch(_: Any, state: Any, row: dict[str, Any]) -> dict[str, Any]:
        if row["steps"] % every == 0:
            found = judge(setup.env.params, setup.policy(state), JUDGED_SEED)["policy"]
            quiet["step"].append(row["steps"])
            quiet["success"].append(found["success"])
        return {"stop": clock.left < 0.0}

    steps = 192 if args.tiny else training.steps
    result = train(setup.learner, RunConfig(steps, seed, quiet=True), None, None, after_epoch)
    episodes = {k: result.episodes[k] for k in ("episode_return", "success")}
    taken = {"steps": result.rows[-1]["steps"], "elapsed_s": clock.spent}
    return {"train": setup.about["train"], "run": {"seed": seed, **taken, "episodes": episodes, "without_noise": quiet}}


def merged(pending: list[Any], seconds: float) -> dict[str, Any]:
    """Waits for the runs, leaves those that take longer, and puts the others together."""
    deadline, train = time.monotonic() + seconds, {}
    found: dict[str, Any] = {MAIN: {**about(MAIN), "runs": {}}}
    for (variant, name, seed), promise in pending:
        try:
            told = promise.get(max(0.1, deadline - time.monotonic()))
        except Exception as error:  # whatever ended it, the others count
            say(f"paper: {variant}, {name}, seed {seed} left nothing: {type(error).__name__} {error}")
            continue
        if variant == MAIN:
            train[name] = told["train"]
        runs = found.setdefault(variant, {**about(variant), "runs": {}})["runs"]
        runs.setdefault(name, []).append(told["run"])
    return {"variant": MAIN, **found.pop(MAIN), "train": train, "others": found}
