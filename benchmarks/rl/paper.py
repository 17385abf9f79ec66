"""Part `paper` of measure.py: the paper's own task with one rover per run, on CPU cores."""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

from harness import say, write

VARIANTS: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("paper_variants.toml").read_text("utf-8"))
DEFAULT = ("signed", "printed", "drawn")
MAIN = "signed"
JUDGED_EVERY, JUDGED = 2500, 24
"""Steps between scores of the policy without noise, and their episodes."""


def options_of(variant: str) -> dict[str, Any]:
    """Options of a variant's environment, with those of the variant that it is like."""
    found = VARIANTS[variant]
    like = VARIANTS[found["like"]]["options"] if "like" in found else {}
    return {**like, **found.get("options", {})}


def paper_start(args: argparse.Namespace, seconds: float) -> list[dict[str, Any]]:
    """Starts one process per algorithm and seed, each on a core of its own; returns them."""
    folder, cores = Path(tempfile.mkdtemp(prefix="rl_paper_")), sorted(os.sched_getaffinity(0))
    jobs = [
        (variant, training, seed)
        for variant in args.variants
        for seed in range(VARIANTS[variant]["seeds"])
        for training in VARIANTS[variant].get("algorithms", ("paper-td3", "paper-ddpg"))
    ]
    # two cores are left to the process that drives the GPU
    free = cores[2:] if args.part == "all" and len(cores) > 2 else cores
    jobs = jobs[: 2 if args.tiny else max(2, len(free))]
    alone = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": "", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}
    children = []
    for i, (variant, training, seed) in enumerate(jobs):
        out = folder / f"{list(VARIANTS).index(variant)}_{training}_{seed}"
        own = f"--part paper-child --training {training} --first-seed {seed} --seconds {seconds}".split()
        line = [sys.executable, str(Path(__file__).with_name("measure.py")), *own, "--core", str(free[i % len(free)])]
        line += ["--out", str(out), "--variants", variant, *(["--tiny"] if args.tiny else [])]
        log = out.with_suffix(".log").open("w")
        process = subprocess.Popen(line, env={**os.environ, **alone}, stdout=log, stderr=log)
        children.append({"variant": variant, "training": training, "out": out, "process": process, "log": log})
    say(f"paper: {len(jobs)} runs of {seconds:.0f} s on CPU cores")
    return children


def paper_child(args: argparse.Namespace) -> None:
    """Runs of one or several seeds in a process of their own; the records are written anew every few seconds."""
    if args.core is not None:
        os.sched_setaffinity(0, {args.core})
    begin = time.monotonic()
    import jax
    import jax.numpy as jnp
    import numpy as np

    from lunar_mjx.agents.configs import get_training, override
    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.envs import make

    variant = args.variants[0]
    settings = {"epoch_steps": 50 if args.tiny else 250, **VARIANTS[variant].get("settings", {})}
    training = override(get_training(args.training), **settings)
    learner = Learner(make(training.environment, **{**training.options, **options_of(variant)}), training.train)
    seeds = range(args.first_seed, args.first_seed + args.together)
    records: list[dict[str, Any]] = [
        {"seed": seed, "episodes": {"episode_return": [], "success": []}, "without_noise": {"step": [], "success": []}}
        for seed in seeds
    ]
    # all seeds in one program, each with everything of its own
    epoch: Any = jax.jit(jax.vmap(learner._epoch, in_axes=(None, 0)), donate_argnums=1)
    state = jax.jit(jax.vmap(learner._init))(jnp.stack([jax.random.PRNGKey(seed) for seed in seeds]))
    judge, judged_every = judge_of(learner), 100 if args.tiny else JUDGED_EVERY
    steps, saved = 0, time.monotonic()
    while steps < (200 if args.tiny else training.steps) and time.monotonic() - begin < args.seconds:
        state, (_, found) = epoch(learner.env.params, state)
        found = jax.device_get(found)
        for i, record in enumerate(records):
            ended = np.flatnonzero(found["done"][i, 0])
            for name, kept in record["episodes"].items():
                kept += [float(f"{v:.4g}") for v in found[name][i, 0, ended]]
        steps += training.train.epoch_steps
        if steps % judged_every == 0:
            shares = jax.device_get(judge(learner.env.params, state.agent.actor, state.statistics))
            for record, share in zip(records, shares, strict=True):
                record["without_noise"]["step"].append(steps)
                record["without_noise"]["success"].append(float(share))
        if time.monotonic() - saved > 10.0 or steps == training.train.epoch_steps:
            saved = time.monotonic()
            keep(args.out, records, steps, saved - begin, training)
    keep(args.out, records, steps, time.monotonic() - begin, training)


def keep(out: Path, records: list[dict[str, Any]], steps: int, elapsed: float, training: Any) -> None:
    """Writes the runs; the time counts from the process' beginning, compilation included."""
    from lunar_mjx.agents.train import plain

    runs = [{**r, "steps": steps, "elapsed_s": elapsed} for r in records]
    write(out / "record.json", {"train": plain(dataclasses.asdict(training.train)), "runs": runs})


def judge_of(learner: Any) -> Any:
    """A function of the environment's parameters, actors and statistics (leading axis: seed) to shares of successes."""
    import jax
    import jax.numpy as jnp

    from lunar_mjx.agents.learner import normalised
    from lunar_mjx.envs import split_keys

    env = learner.env

    def one(params: Any, actor: Any, statistics: Any) -> Any:
        def step(carry: Any, _: Any) -> Any:
            state, over, won = carry
            obs = state.obs
            if learner.config.normalise:
                obs = normalised(obs, statistics.mean["obs"], statistics.std["obs"])
            state = env.step(params, state, learner.agent.act(actor, obs))
            won = won | (state.done & ~over & (state.metrics["success"] > 0.0))
            return (state, over | state.done, won), None

        no = jnp.zeros(JUDGED, bool)
        begin = env.reset(params, split_keys(jax.random.PRNGKey(99), JUDGED))
        return jnp.mean(jax.lax.scan(step, (begin, no, no), length=env.episode_steps)[0][2])

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))


def paper_merge(children: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Waits for the runs, ends what is left, and puts their records together."""
    import json

    deadline, train = time.monotonic() + max(seconds, 1.0), {}
    runs: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for child in children:
        try:
            child["process"].wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            child["process"].kill()
            child["process"].wait()
        child["log"].close()
        path = child["out"] / "record.json"
        if not path.is_file():
            told = Path(child["log"].name).read_text(encoding="utf-8")[-600:]
            say(f"paper: {child['variant']}, {child['training']} left nothing: {told}")
            continue
        found = json.loads(path.read_text(encoding="utf-8"))
        if child["variant"] == MAIN:
            train[child["training"]] = found["train"]
        runs.setdefault(child["variant"], {}).setdefault(child["training"], []).extend(found["runs"])
    about = {v: {"options": options_of(v), "settings": VARIANTS[v].get("settings", {})} for v in (MAIN, *runs)}
    others = {v: {**about[v], "runs": found} for v, found in runs.items() if v != MAIN}
    return {"variant": MAIN, **about[MAIN], "train": train, "runs": runs.get(MAIN, {}), "others": others}
