"""Trains in the physics-free environment, as a process of its own: to be killed, resumed, and spread over devices.

    python -m tests.agents.point_run FOLDER [--steps N] [--kill epoch:N | --kill file:N] [--rover]
                        [--coordinator HOST:PORT --processes N --process I] [--skew] [--fail HOW]

Prints the parameters' fingerprint and the curve as JSON. `--kill` sends itself SIGKILL: after the N-th epoch
and before its checkpoint, or at the N-th opening, making, renaming or removing of a file under the checkpoints.
`--fail` ends process 1 alone in its third epoch, by an error or by SIGKILL.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import time
from pathlib import Path

import jax
import numpy as np

from tests.killed_run import die, die_at_file

ROVER = {"rover": "luvmi_x", "terrain": "flat", "goal_distance": (2.0, 4.0), "episode_time": 4.0, "places": 16}
"""A small task with physics."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("--steps", type=int, default=16_000)
    parser.add_argument("--kill", default=":0")
    parser.add_argument("--coordinator")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--process", type=int, default=0)
    parser.add_argument("--fail", choices=("callback", "kill"), help="how process 1 ends in its third epoch")
    parser.add_argument("--poison", type=int, default=0, help="step in which an environment gives a nan; 0: never")
    parser.add_argument("--rover", action="store_true", help="rovers on flat ground instead of points")
    parser.add_argument("--skew", action="store_true", help="the clock of process I runs 10^I s per look")
    args = parser.parse_args()
    print("started", flush=True)
    if args.coordinator:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(args.coordinator, args.processes, args.process, heartbeat_timeout_seconds=30)
    from lunar_mjx.agents.configs import get_training, override
    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.agents.train import RunConfig, train
    from lunar_mjx.envs import make

    config = override(get_training("point"), epoch_steps=25).train
    env = make("point", poison=args.poison)
    if args.rover:
        config = override(get_training("point"), epoch_steps=10, envs=8, batch=16).train
        env = make("navigation", **ROVER)
    learner = Learner(env, config)
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
        if args.process == 1 and args.fail and left == -3:
            if args.fail == "kill":
                die()
            raise RuntimeError("planted")

    looks = itertools.count()
    clock = (lambda: 10.0**args.process * next(looks)) if args.skew else time.monotonic
    limit = 50.0 if args.skew else None
    every = 15.0 if args.skew else 0.0
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
