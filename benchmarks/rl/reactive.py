"""Part `tune` of measure.py: random settings of the reactive rule, scored on a rung's training worlds.

    python benchmarks/rl/measure.py tune ladder/3 --repeats 24 --out benchmarks/rl

`rung` scores beside the best of them. Agents on unseen worlds are scored by `lunar-mjx evaluate --agent reactive --task
ladder/3`. The tried settings of other rungs, and all else that the file `ladder.json` holds, are kept.
"""

from __future__ import annotations

import argparse
import dataclasses
import math

import jax
import numpy as np
from harness import COMMIT, EXPERIMENTS, Clock, Judge, read, say, write

from lunar_mjx.commands.train import env_options
from lunar_mjx.envs import make_navigation
from lunar_mjx.envs.scripted import Reactive, reactive_rule


def tune(args: argparse.Namespace, clock: Clock) -> None:
    """Scores as many settings as there are repeats, those that the rule has now among them, and writes them."""
    rover, seed = args.rover, args.seeds[0]
    options = env_options(args.env)
    env, rng = make_navigation(args.training, rover, **options), np.random.default_rng(seed)
    tried = [Reactive()]
    for _ in range(args.repeats - 1):
        ranges = EXPERIMENTS["tune"]["searched"].items()
        tried.append(Reactive(**{k: math.exp(rng.uniform(math.log(low), math.log(high))) for k, (low, high) in ranges}))
    judge = Judge(env, args.episodes, {}, {str(s): reactive_rule(env, s) for s in tried})
    judge.compile(env.params)
    found = judge(env.params, (), seed)
    rows = [
        {"settings": dataclasses.asdict(s), "success": row["success"], "return": row["episode_return"]}
        for s, row in zip(tried, found.values(), strict=True)
    ]
    # where nobody arrives, the way towards the goal tells settings apart
    rows.sort(key=lambda r: (r["success"], r["return"]), reverse=True)
    about = {"commit": COMMIT, "seed": seed, "episodes": args.episodes, "rover": rover, "options": options}
    about |= {"device": jax.devices()[0].device_kind, "wall_s": clock.spent}
    record = {"tuned": {}, **(read(args.out / "ladder.json") or {}), "rover": rover}
    record["tuned"][args.training.partition("/")[2]] = {**about, "rows": rows}
    write(args.out / "ladder.json", record)
    say("\n".join(str(row) for row in rows))
