"""The paper's own task with one rover per run, on CPU cores: part `paper` of rl_proof.py."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TRAININGS = ("paper-td3", "paper-ddpg")
SEEDS = 5


def paper_start(args: argparse.Namespace, seconds: float) -> list[dict[str, Any]]:
    """Starts one process per algorithm and seed, each on a core of its own; returns them."""
    folder = Path(tempfile.mkdtemp(prefix="rl_paper_"))
    cores = sorted(os.sched_getaffinity(0))
    seeds = 1 if args.tiny else SEEDS
    jobs = [(training, seed) for seed in range(seeds) for training in TRAININGS]
    # two cores are left to the process that drives the GPU
    free = cores[2:] if len(cores) > 2 else cores
    jobs = jobs[: max(2, len(free))]
    env = {**os.environ, "JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": "",
           "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false"}  # fmt: skip
    children = []
    for i, (training, seed) in enumerate(jobs):
        out = folder / f"{training}_{seed}"
        line = [sys.executable, str(Path(__file__).with_name("rl_proof.py")), "--part", "paper-child", "--training",
                training, "--first-seed", seed, "--seconds", seconds, "--out", out, "--core", free[i % len(free)],
                *(["--tiny"] if args.tiny else [])]  # fmt: skip
        log = (folder / f"{training}_{seed}.log").open("w")
        process = subprocess.Popen([str(a) for a in line], env=env, stdout=log, stderr=log)
        children.append({"training": training, "seed": seed, "out": out, "process": process, "log": log})
    print(f"paper: {len(jobs)} runs of {seconds:.0f} s on CPU cores", flush=True)
    return children


def paper_child(args: argparse.Namespace) -> None:
    """One run in a process of its own; its record is written anew every few seconds."""
    if args.core is not None:
        os.sched_setaffinity(0, {args.core})
    begin = time.monotonic()
    from lunar_mjx.agents.configs import get_training, override
    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.agents.train import RunConfig, plain, train
    from lunar_mjx.envs import make

    training = override(get_training(args.training), epoch_steps=50 if args.tiny else 250)
    learner = Learner(make(training.environment, **training.options), training.train)
    steps = 200 if args.tiny else training.steps
    record: dict[str, Any] = {"seed": args.first_seed, "train": plain(dataclasses.asdict(training.train)),
                              "environment": plain(dict(training.options))}  # fmt: skip
    limit = max(1.0, args.seconds - (time.monotonic() - begin))
    result = train(learner, RunConfig(steps, args.first_seed, limit, float("inf"), quiet=True))
    record |= {
        "episodes": result.episodes,
        "steps": result.rows[-1]["steps"],
        "elapsed_s": result.rows[-1]["elapsed_s"],
    }
    (args.out / "record.json").write_text(json.dumps(plain(record)), encoding="utf-8")


def paper_merge(children: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Waits for the runs, ends what is left, and puts their records together."""
    deadline = time.monotonic() + max(seconds, 1.0)
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in TRAININGS}
    for child in children:
        try:
            child["process"].wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            child["process"].kill()
            child["process"].wait()
        child["log"].close()
        path = child["out"] / "record.json"
        if path.is_file():
            runs[child["training"]].append(json.loads(path.read_text(encoding="utf-8")))
        else:
            print(f"paper: {child['training']} seed {child['seed']} left nothing: "
                  f"{Path(child['log'].name).read_text(encoding='utf-8')[-600:]}", flush=True)  # fmt: skip
    for name, found in runs.items():
        steps = [r["steps"] for r in found]
        counts = [len(r["episodes"]["episode_return"]) for r in found]
        lasts = [r["episodes"]["success"][-50:] for r in found]
        shares = [round(sum(last) / max(1, len(last)), 2) for last in lasts]
        print(f"{name}: steps {steps}, episodes {counts}, success of the last 50 {shares}", flush=True)
    return {"runs": runs}
