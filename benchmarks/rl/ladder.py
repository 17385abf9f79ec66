"""Scores agents that learn nothing on the ladder, and a policy of the task `large` with and without its height scan.

    python benchmarks/rl/ladder.py --rungs 1 2 3 --episodes 32 --out benchmarks/rl/ladder.json
    python benchmarks/rl/ladder.py --tune 24 --rungs 3 --episodes 8 --out benchmarks/rl/ladder.json

All agents drive the same episodes side by side in one program, in unseen worlds and soil as `lunar-mjx evaluate` takes
them. Rungs that the file holds already are kept unless they are measured again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from benchmarks.rl.harness import percent, save, say
from benchmarks.timing import commit
from lunar_mjx.agents.evaluate import score
from lunar_mjx.agents.play import UNSEEN_LADDER, shipped_policy
from lunar_mjx.agents.policy import load_policy
from lunar_mjx.agents.run import unseen_params
from lunar_mjx.envs import make_agent, make_navigation, split_keys
from lunar_mjx.envs.scripted import Reactive, reactive_rule

SCRIPTED = ("zero", "random", "scripted", "reactive", "planner")
PIECE = 25
"""Control steps between looks at whether all episodes are over."""


def agents(env: Any, params: Any, rover: str, tuned: dict[str, Any] | None) -> dict[str, Any]:
    """All agents by name, functions of state and key; the reactive rule with its own and with `tuned` settings."""
    found = {name: make_agent(name, env, params) for name in SCRIPTED}
    if tuned is not None:
        found["reactive, tuned"] = reactive_rule(env, Reactive(**tuned))
    path = shipped_policy(rover)
    if path is None:
        return found
    policy = load_policy(path)
    seen = policy.network["obs"]
    blank = jnp.zeros(seen, bool).at[env.blocks["height_scan"]].set(True)
    mean = jnp.zeros(seen) if policy.mean is None else jnp.asarray(policy.mean)
    found["policy of large"] = lambda state, key: policy.act(state.obs[:, :seen])
    # the scan at its mean over training, so that it says nothing
    found["policy of large, scan blanked"] = lambda state, key: policy.act(jnp.where(blank, mean, state.obs[:, :seen]))
    return found


def drive(env: Any, params: Any, choices: list[Any], episodes: int, seed: int) -> dict[str, np.ndarray]:
    """Metrics of the first episode of every rover, (agent, episode)."""
    key_reset, key = jax.random.split(jax.random.PRNGKey(seed))
    keys = jnp.tile(split_keys(key_reset, episodes), (len(choices), 1))
    row = jnp.repeat(jnp.arange(len(choices)), episodes)

    @jax.jit
    def piece(params: Any, carry: Any, key: Any) -> Any:
        def step(carry: Any, key: Any) -> Any:
            state, over, kept = carry
            actions = jnp.stack([agent(state, key) for agent in choices])
            action = jnp.take_along_axis(actions, row[None, :, None], axis=0)[0]
            state = env.step(params, state, action)
            first = state.done & ~over
            kept = {k: jnp.where(first, state.metrics[k], v) for k, v in kept.items()}
            return (state, over | state.done, kept), None

        return jax.lax.scan(step, carry, jax.random.split(key, PIECE))[0]

    state = jax.jit(env.reset)(params, keys)
    blank = {k: jnp.zeros(len(row)) for k in state.metrics if not k.startswith("reward_")}
    carry = state, jnp.zeros(len(row), bool), blank
    for i in range(math.ceil(env.episode_steps / PIECE)):
        carry = piece(params, carry, jax.random.fold_in(key, i))
        if bool(carry[1].all()):
            break
    return {k: np.asarray(v).reshape(len(choices), episodes) for k, v in carry[2].items()}


def measure(
    number: int, episodes: int, seed: int, rover: str, names: list[str], tuned: Any, **settings: Any
) -> dict[str, Any]:
    """Rows of one rung by agent, all agents if `names` is empty; each tells how it was measured."""
    begin = time.monotonic()
    env = make_navigation(f"ladder/{number}", rover, **settings)
    params = unseen_params(env, UNSEEN_LADDER)
    told = agents(env, params, rover, tuned)
    told = {name: agent for name, agent in told.items() if not names or name in names}
    result = drive(env, params, list(told.values()), episodes, seed)
    rows = {}
    for i, name in enumerate(told):
        row = score({k: v[i] for k, v in result.items()}, env.control_interval)
        rows[name] = dataclasses.asdict(row) | {"commit": commit(), "seed": seed, "settings": settings}
        rows[name]["device"] = jax.devices()[0].device_kind
        cost = f"SPL {row.spl}, {row.collisions_per_km} collisions/km, {row.wh_per_km} Wh/km"
        say(f"rung {number} {name}: {percent(rows[name])}, {cost}, slip {row.slip}")
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


def tune(number: int, settings: int, episodes: int, seed: int, rover: str, worlds: int) -> dict[str, Any]:
    """Scores random settings of the reactive rule on a rung's training worlds, those it has now among them."""
    begin = time.monotonic()
    env = make_navigation(f"ladder/{number}", rover, worlds=worlds)
    rng = np.random.default_rng(seed)
    tried = [Reactive()]
    for _ in range(settings - 1):
        drawn = {k: math.exp(rng.uniform(math.log(low), math.log(high))) for k, (low, high) in SEARCHED.items()}
        tried.append(Reactive(**drawn))
    result = drive(env, env.params, [reactive_rule(env, s) for s in tried], episodes, seed)
    rows = []
    for i, one in enumerate(tried):
        row = score({k: v[i] for k, v in result.items()}, env.control_interval)
        # where nobody arrives, the way towards the goal tells settings apart
        rows.append({"settings": dataclasses.asdict(one), "success": row.success, "return": row.episode_return})
    rows.sort(key=lambda r: (r["success"], r["return"]), reverse=True)
    for row in rows:
        say(f"rung {number} reactive: {row}")
    about = {"commit": commit(), "seed": seed, "episodes": episodes, "rover": rover, "worlds": worlds}
    return {**about, "device": jax.devices()[0].device_kind, "wall_s": time.monotonic() - begin, "rows": rows}


def main() -> None:
    """Measures and writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rungs", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--seed", type=int, default=54321)
    parser.add_argument("--rover", default="luvmi_x")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/rl/ladder.json"))
    parser.add_argument("--worlds", type=int, default=0, help="side by side; as many as the rung says if 0")
    parser.add_argument("--agents", nargs="*", default=[], help="which rows to measure; all if left out")
    parser.add_argument("--tune", type=int, default=0, help="how many settings of the reactive rule to try")
    args = parser.parse_args()
    old = json.loads(args.out.read_text(encoding="utf-8")) if args.out.exists() else {}
    old = {"rungs": {}, "tuned": {}, **old, "rover": args.rover}
    for number in args.rungs:
        if args.tune:
            tuned = tune(number, args.tune, args.episodes, args.seed, args.rover, args.worlds)
            old["tuned"][str(number)] = tuned
        else:
            rows = old["tuned"].get(str(number), {}).get("rows")
            tuned = rows[0]["settings"] if rows else None
            one = (number, args.episodes, args.seed, args.rover, args.agents, tuned)
            rung = old["rungs"].setdefault(str(number), {"rows": {}})
            rung["rows"] |= measure(*one, worlds=args.worlds)
        save(args.out.parent, args.out.stem, old)


if __name__ == "__main__":
    main()
