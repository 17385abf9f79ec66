"""Trains in the physics-free environment, as a process of its own: to be killed, resumed, and spread over devices.

    python point_run.py FOLDER [--steps N] [--kill epoch:N | --kill file:N]
                        [--coordinator HOST:PORT --processes N --process I]

Prints the parameters' fingerprint and the curve as JSON. `--kill` sends itself SIGKILL: after the N-th epoch
and before its checkpoint, or at the N-th opening, making, renaming or removing of a file under the checkpoints.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

FILE_EVENTS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link"}


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def die_at_file(folder: Path, count: int) -> None:
    """Counts what Python does to files under a folder; dies just before the `count`-th."""
    seen = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if event in FILE_EVENTS and str(arguments[0]).startswith(str(folder)):
            seen += 1
            if seen == count:
                die()

    sys.addaudithook(hook)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("--steps", type=int, default=16_000)
    parser.add_argument("--kill", default=":0")
    parser.add_argument("--coordinator")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--process", type=int, default=0)
    parser.add_argument("--skew", action="store_true", help="the clock of process I runs 10^I s per look")
    args = parser.parse_args()
    if args.coordinator:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(args.coordinator, args.processes, args.process)
    from lunar_mjx.agents.configs import get_training, override
    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.agents.train import RunConfig, train
    from lunar_mjx.envs import make

    config = override(get_training("point"), epoch_steps=25).train
    learner = Learner(make("point"), config)
    folder = None if args.folder == "-" else Path(args.folder)
    where, _, number = args.kill.partition(":")
    if where == "file":
        assert folder is not None
        die_at_file(folder.resolve() / "checkpoints", int(number))
    left = int(number)

    def after(*_: object) -> None:
        nonlocal left
        left -= 1
        if where == "epoch" and left == 0:
            die()

    looks = itertools.count()
    clock = (lambda: 10.0**args.process * next(looks)) if args.skew else time.monotonic
    limit = 100.0 if args.skew else None
    every = 30.0 if args.skew else 0.0
    config = RunConfig(args.steps, time_limit=limit, checkpoint_every=every, quiet=True)
    result = train(learner, config, folder, callback=after, clock=clock)
    digest = hashlib.sha256()
    actor, statistics = jax.device_get(learner.policy(result.state))
    for leaf in jax.tree.leaves((actor, statistics)):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    curve = [[r["steps"], r["episode_return"], r["success"]] for r in result.rows]
    print(json.dumps({"devices": learner.devices, "digest": digest.hexdigest(), "curve": curve}))


if __name__ == "__main__":
    main()
