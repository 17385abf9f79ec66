"""Tries settings of the reactive rule on the ladder's training worlds; `rung.py` scores beside the best of them.

    python benchmarks/rl/ladder.py --tune 24 --rungs 3 --episodes 8

Agents on unseen worlds are scored by `lunar-mjx evaluate --agent reactive --task ladder/3`. The tried settings of other
rungs, and all else that the file holds, are kept.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from harness import COMMIT, KEPT, Judge, read, say, write

from benchmarks.timing import LOCK, alone
from lunar_mjx.envs import make_navigation
from lunar_mjx.envs.scripted import Reactive, reactive_rule

SEARCHED = {
    "tall": (0.06, 0.3),
    "half_width": (0.3, 0.7),
    "horizon": (1.0, 4.5),
    "turn_price": (0.05, 2.0),
    "gain": (0.8, 3.0),
    "near": (0.2, 1.2),
    "patience": (1.5, 8.0),
}
"""Ranges of the reactive rule's settings, drawn from evenly in the logarithm."""


def tune(args: argparse.Namespace, number: int) -> dict[str, Any]:
    """Scores random settings of the reactive rule on a rung's training worlds, those it has now among them."""
    begin = time.monotonic()
    env = make_navigation(f"ladder/{number}", args.rover, worlds=args.worlds)
    rng = np.random.default_rng(args.seed)
    tried = [Reactive()]
    for _ in range(args.tune - 1):
        drawn = {k: math.exp(rng.uniform(math.log(low), math.log(high))) for k, (low, high) in SEARCHED.items()}
        tried.append(Reactive(**drawn))
    judge = Judge(env, args.episodes, {}, {str(s): reactive_rule(env, s) for s in tried})
    judge.compile(env.params)
    with alone():
        found = judge(env.params, (), args.seed)
    rows = [
        {"settings": dataclasses.asdict(s), "success": row["success"], "return": row["episode_return"]}
        for s, row in zip(tried, found.values(), strict=True)
    ]
    # where nobody arrives, the way towards the goal tells settings apart
    rows.sort(key=lambda r: (r["success"], r["return"]), reverse=True)
    for row in rows:
        say(f"rung {number} reactive: {row}")
    about = {"commit": COMMIT, **{k: getattr(args, k) for k in ("seed", "episodes", "rover", "worlds")}}
    return {**about, "device": jax.devices()[0].device_kind, "wall_s": time.monotonic() - begin, "rows": rows}


def main() -> None:
    """Tries and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--rungs", type=int, nargs="+", default=[3])
    add("--episodes", type=int, default=8, help="of each setting")
    add("--seed", type=int, default=54321)
    add("--rover", default="luvmi_x")
    add("--out", type=Path, default=KEPT / "ladder.json")
    add("--worlds", type=int, default=0, help="side by side; as many as the rung says if 0")
    add("--tune", type=int, default=24, help="how many settings of the reactive rule to try")
    add("--lock", type=Path, help="file that is locked while rovers drive, for runs side by side")
    args = parser.parse_args()
    LOCK.extend([args.lock] if args.lock else [])
    record = {"tuned": {}, **(read(args.out) or {}), "rover": args.rover}
    for number in args.rungs:
        record["tuned"][str(number)] = tune(args, number)
        write(args.out, record)


if __name__ == "__main__":
    main()
