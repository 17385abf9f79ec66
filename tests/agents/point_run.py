"""Trains in the physics-free environment, as a process of its own: to be killed, resumed, and spread over devices.

    python point_run.py FOLDER [--steps N] [--coordinator HOST:PORT --processes N --process I]

Prints the parameters' fingerprint and the last success rate as JSON.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import jax
import numpy as np


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("--steps", type=int, default=16_000)
    parser.add_argument("--coordinator")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--process", type=int, default=0)
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
    print("begin", flush=True)
    result = train(learner, RunConfig(args.steps, checkpoint_every=0.0, quiet=True), folder)
    digest = hashlib.sha256()
    actor, statistics = jax.device_get(learner.policy(result.state))
    for leaf in jax.tree.leaves((actor, statistics)):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    curve = [[r["steps"], r["episode_return"], r["success"]] for r in result.rows]
    print(json.dumps({"devices": learner.devices, "digest": digest.hexdigest(), "curve": curve}))


if __name__ == "__main__":
    main()
