"""Scores agents that learn nothing on the ladder, and a policy of the task `large` with and without its height scan.

    python benchmarks/rl/ladder.py --rungs 1 2 3 --episodes 32 --out benchmarks/rl/ladder.json
    python benchmarks/rl/ladder.py --tune 24 --rungs 3 --episodes 8 --out benchmarks/rl/ladder.json
    python benchmarks/rl/ladder.py --rungs 3 --policies "TD3=runs/ladder-3/policy.npz"
    python benchmarks/rl/ladder.py --rungs 4 --agents mapper --episodes 16        # the rule on its own map alone

All agents drive the same episodes side by side in one program, in unseen worlds and soil as `lunar-mjx evaluate` takes
them. Rungs that the file holds already are kept unless they are measured again.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import AHEAD, COMMIT, KEPT, Judge, percent, read, say, write

from benchmarks.timing import LOCK, alone
from lunar_mjx.agents.play import UNSEEN_LADDER
from lunar_mjx.agents.policy import Policy, load_policy, shipped_policy
from lunar_mjx.agents.run import unseen_params
from lunar_mjx.commands.train import pairs
from lunar_mjx.envs import TASKS, make_agent, make_navigation
from lunar_mjx.envs.scripted import Reactive, reactive_rule

SCRIPTED = ("zero", "random", "scripted", "reactive", "planner")


def agents(env: Any, params: Any, rover: str, tuned: Mapping[str, Any] | None, policies: Mapping[str, Path]) -> dict:
    """All agents by name, functions of state and key; the reactive rule with its own and with `tuned` settings, and
    every policy with and without what it sees ahead."""
    found = {name: make_agent(name, env, params) for name in SCRIPTED}
    if "plan" in env.blocks:
        found["mapper"] = make_agent("mapper", env, params)
    if tuned is not None:
        found["reactive, tuned"] = reactive_rule(env, Reactive(**tuned))
    path = shipped_policy(rover)
    for name, place in (({} if path is None else {"policy of large": path}) | dict(policies)).items():
        policy = load_policy(place)
        found[name] = _driver(env, policy, ())
        found[f"{name}, scan blanked"] = _driver(env, policy, AHEAD)
    return found


def seen_by(policy: Policy) -> tuple[str, ...]:
    """The blocks that a policy sees, in its order."""
    options = policy.environment["options"]
    return tuple(options.get("observations", TASKS[options["task"]].observations))


def _driver(env: Any, policy: Policy, blanked: tuple[str, ...]) -> Any:
    """A policy as an agent in an environment that shows all that it sees; `blanked` blocks stay at their mean over the
    training, so that they say nothing."""
    blocks = seen_by(policy)
    where = np.concatenate([np.arange(env.blocks[b].start, env.blocks[b].stop) for b in blocks])
    blank = np.concatenate([np.full(env.blocks[b].stop - env.blocks[b].start, b in blanked) for b in blocks])
    mean = jnp.zeros(len(where)) if policy.mean is None else jnp.asarray(policy.mean)
    return lambda state, key: policy.act(jnp.where(blank, mean, state.obs[:, where]))


def drive(env: Any, params: Any, rules: Mapping[str, Any], episodes: int, seed: int) -> dict[str, dict[str, Any]]:
    """Scores of rules on the same episodes, driven while no other run is timed."""
    judge = Judge(env, episodes, {}, rules)
    judge.compile(params)
    with alone():
        return judge(params, (), seed)


def measure(args: argparse.Namespace, number: int, tuned: Any, policies: Mapping[str, Path]) -> dict[str, Any]:
    """Rows of one rung by agent, of all agents if none is asked for; each tells how it was measured."""
    begin, settings = time.monotonic(), {"worlds": args.worlds}
    # all that any of the policies sees
    blocks = dict.fromkeys(TASKS[f"ladder/{number}"].observations)
    for path in policies.values():
        blocks |= dict.fromkeys(seen_by(load_policy(path)))
    if "mapper" in args.agents:
        blocks |= {"plan": None}
    env = make_navigation(f"ladder/{number}", args.rover, observations=tuple(blocks), **settings)
    params = unseen_params(env, UNSEEN_LADDER)
    chosen = {n: a for n, a in agents(env, params, args.rover, tuned, policies).items() if n in (args.agents or [n])}
    how = {"commit": COMMIT, "seed": args.seed, "settings": settings, "device": jax.devices()[0].device_kind}
    rows = {name: row | how for name, row in drive(env, params, chosen, args.episodes, args.seed).items()}
    for name, row in rows.items():
        cost = f"SPL {row['spl']:.3f}, {row['collisions_per_km']:.1f} collisions/km, {row['wh_per_km']:.1f} Wh/km"
        say(f"rung {number} {name}: {percent(row)}, {cost}, slip {row['slip']:.2f}")
    say(f"rung {number}: {time.monotonic() - begin:.0f} s")
    return rows


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
    found = drive(env, env.params, {str(s): reactive_rule(env, s) for s in tried}, args.episodes, args.seed)
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
    """Measures and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--rungs", type=int, nargs="+", default=[1, 2, 3])
    add("--episodes", type=int, default=64)
    add("--seed", type=int, default=54321)
    add("--rover", default="luvmi_x")
    add("--out", type=Path, default=KEPT / "ladder.json")
    add("--worlds", type=int, default=0, help="side by side; as many as the rung says if 0")
    add("--agents", nargs="*", default=[], help="which rows to measure; all if left out")
    add("--tune", type=int, default=0, help="how many settings of the reactive rule to try")
    add("--policies", nargs="*", default=[], metavar="NAME=FILE", help="policies to measure, too")
    add("--lock", type=Path, help="file that is locked while rovers drive, for runs side by side")
    args = parser.parse_args()
    LOCK.extend([args.lock] if args.lock else [])
    policies = {name: Path(path) for name, path in pairs("--policies", args.policies).items()}
    record = {"rungs": {}, "tuned": {}, **(read(args.out) or {}), "rover": args.rover}
    for number in args.rungs:
        name = str(number)
        if args.tune:
            record["tuned"][name] = tune(args, number)
        else:
            tuned = record["tuned"].get(name)
            rows = measure(args, number, tuned and tuned["rows"][0]["settings"], policies)
            record["rungs"].setdefault(name, {"rows": {}})["rows"] |= rows
        write(args.out, record)


if __name__ == "__main__":
    main()
