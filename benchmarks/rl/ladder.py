"""Scores agents that learn nothing on the ladder, and a policy of the task `large` with and without its height scan.

    python benchmarks/rl/ladder.py --rungs 1 2 3 --episodes 32 --out benchmarks/rl/ladder.json
    python benchmarks/rl/ladder.py --tune 24 --rungs 3 --episodes 8 --out benchmarks/rl/ladder.json
    python benchmarks/rl/ladder.py --rungs 3 --policies "TD3=runs/ladder-3/policy.npz"

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
from benchmarks.provenance import commit
from benchmarks.rl.harness import percent, save, say
from benchmarks.timing import LOCK, alone
from lunar_mjx.agents.evaluate import score
from lunar_mjx.agents.play import UNSEEN_LADDER, shipped_policy
from lunar_mjx.agents.policy import Policy, load_policy
from lunar_mjx.agents.run import unseen_params
from lunar_mjx.envs import TASKS, make_agent, make_navigation, split_keys
from lunar_mjx.envs.scripted import Reactive, reactive_rule

SCANS = ("height_scan", "far_scan")
SCRIPTED = ("zero", "random", "scripted", "reactive", "planner")
PIECE = 25
"""Control steps between looks at whether all episodes are over."""


def agents(
    env: Any, params: Any, rover: str, tuned: dict[str, Any] | None, policies: dict[str, Path]
) -> dict[str, Any]:
    """All agents by name, functions of state and key; the reactive rule with its own and with `tuned` settings, and
    every policy with and without what it sees ahead."""
    found = {name: make_agent(name, env, params) for name in SCRIPTED}
    if tuned is not None:
        found["reactive, tuned"] = reactive_rule(env, Reactive(**tuned))
    path = shipped_policy(rover)
    for name, place in (({} if path is None else {"policy of large": path}) | policies).items():
        policy = load_policy(place)
        found[name] = _driver(env, policy, ())
        found[f"{name}, scan blanked"] = _driver(env, policy, SCANS)
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


def drive(
    env: Any, params: Any, choices: list[Any], episodes: int, seed: int
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Metrics of the first episode of every rover, (agent, episode), and s for compiling and for driving."""
    begin = time.monotonic()
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
    ready = piece.lower(params, carry, key).compile()
    compiled = time.monotonic()
    with alone():
        driving = time.monotonic()
        for i in range(math.ceil(env.episode_steps / PIECE)):
            carry = ready(params, carry, jax.random.fold_in(key, i))
            if bool(carry[1].all()):
                break
        told = {k: np.asarray(v).reshape(len(choices), episodes) for k, v in carry[2].items()}
        return told, {"compile_s": compiled - begin, "drive_s": time.monotonic() - driving}


def measure(
    number: int,
    episodes: int,
    seed: int,
    rover: str,
    names: list[str],
    tuned: Any,
    policies: dict[str, Path],
    **settings: Any,
) -> dict[str, Any]:
    """Rows of one rung by agent, all agents if `names` is empty; each tells how it was measured."""
    begin = time.monotonic()
    # all that any of the policies sees
    blocks = dict.fromkeys(TASKS[f"ladder/{number}"].observations)
    for path in policies.values():
        blocks |= dict.fromkeys(seen_by(load_policy(path)))
    env = make_navigation(f"ladder/{number}", rover, observations=tuple(blocks), **settings)
    params = unseen_params(env, UNSEEN_LADDER)
    told = agents(env, params, rover, tuned, policies)
    told = {name: agent for name, agent in told.items() if not names or name in names}
    result, seconds = drive(env, params, list(told.values()), episodes, seed)
    rows = {}
    for i, name in enumerate(told):
        row = score({k: v[i] for k, v in result.items()}, env.control_interval)
        rows[name] = dataclasses.asdict(row) | {"commit": commit(), "seed": seed, "settings": settings}
        rows[name]["device"] = jax.devices()[0].device_kind
        cost = f"SPL {row.spl}, {row.collisions_per_km} collisions/km, {row.wh_per_km} Wh/km"
        say(f"rung {number} {name}: {percent(rows[name])}, {cost}, slip {row.slip}")
    say(f"rung {number}: {time.monotonic() - begin:.0f} s, of it {seconds}")
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
    result, _ = drive(env, env.params, [reactive_rule(env, s) for s in tried], episodes, seed)
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
    parser.add_argument("--policies", nargs="*", default=[], metavar="NAME=FILE", help="policies to measure, too")
    parser.add_argument("--lock", type=Path, help="file that is locked while rovers drive, for runs side by side")
    args = parser.parse_args()
    LOCK.extend([args.lock] if args.lock else [])
    policies = {name: Path(path) for name, _, path in (text.partition("=") for text in args.policies)}
    old = json.loads(args.out.read_text(encoding="utf-8")) if args.out.exists() else {}
    old = {"rungs": {}, "tuned": {}, **old, "rover": args.rover}
    for number in args.rungs:
        if args.tune:
            tuned = tune(number, args.tune, args.episodes, args.seed, args.rover, args.worlds)
            old["tuned"][str(number)] = tuned
        else:
            rows = old["tuned"].get(str(number), {}).get("rows")
            tuned = rows[0]["settings"] if rows else None
            one = (number, args.episodes, args.seed, args.rover, args.agents, tuned, policies)
            rung = old["rungs"].setdefault(str(number), {"rows": {}})
            rung["rows"] |= measure(*one, worlds=args.worlds)
        save(args.out.parent, args.out.stem, old)


if __name__ == "__main__":
    main()
