"""Trains on a rung of the ladder and scores the policy beside those that learn nothing, on the same unseen episodes.

    python benchmarks/rl/rung.py ladder-3 --seconds 500 --out runs/rung                # one GPU
    python benchmarks/rl/rung.py ladder-3 --tiny --seconds 400 --out runs/tiny         # the same code on two CPU cores

Rows: the policy, the policy with all that comes from its scans blanked, straight ahead, the reactive rule as it was
tuned (`benchmarks/rl/ladder.json`), and `mapper`, which follows the way on the rover's own map if the policy is told
it. All rows are of one program, compiled beside the training's. Each score writes `NAME.json`, `NAME.npz` (best on
the unseen worlds so far) and `NAME_last.npz`, so that a run that is cut off leaves what it had. The last score is of
other episodes than those by which the best was chosen.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from benchmarks.rl.harness import DURING, FINAL, Clock, in_threads, percent, save, say
from benchmarks.timing import commit
from lunar_mjx.agents.configs import get_training, override
from lunar_mjx.agents.evaluate import score
from lunar_mjx.agents.learner import Learner, normalised
from lunar_mjx.agents.policy import policy_of, save_policy
from lunar_mjx.agents.run import unseen_params
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import make, make_agent, split_keys
from lunar_mjx.envs.scripted import Reactive, reactive_rule

SEES = ("height_scan", "far_scan", "plan")
"""Blocks that come from what the rover sees ahead."""
PIECE = 25
"""Control steps between looks at whether all episodes are over."""
TINY = {"envs": 16, "epoch_steps": 24, "minibatches": 2, "passes": 1}
"""What --tiny changes of the training."""


def tuned_rule(rung: int) -> Reactive:
    """The reactive rule's best settings on this rung, as measured; its own where there are none."""
    path = Path(__file__).parent / "ladder.json"
    tuned = json.loads(path.read_text(encoding="utf-8"))["tuned"] if path.is_file() else {}
    return Reactive(**tuned[str(rung)]["rows"][0]["settings"]) if str(rung) in tuned else Reactive()


class Rows:
    """Scores of several agents on the same episodes, one program for all policies of a learner.

    Args:
      env: the environment. learner: whose policy to score. params: of the environment, unseen. episodes: of each row.
    """

    def __init__(self, env: Any, learner: Learner, params: Any, episodes: int):
        self.env, self.params, self.episodes = env, params, episodes
        blank = np.zeros(env.observation_size, bool)
        for name in SEES:
            if name in env.blocks:
                blank[env.blocks[name]] = True
        rules = {
            "scripted": make_agent("scripted", env),
            "reactive, tuned": reactive_rule(env, tuned_rule(env.config.rung)),
        }
        if "plan" in env.blocks:
            rules["mapper"] = make_agent("mapper", env)
        self.names = ("policy", "policy, scans blanked", *rules)
        row = jnp.repeat(jnp.arange(len(self.names)), episodes)

        def act(policy: Any, state: Any, key: Any) -> Any:
            weights, statistics = policy
            mean = statistics[0] if statistics is not None else jnp.zeros(env.observation_size)
            obs = jnp.where((row == 1)[:, None] & blank, mean, state.obs)
            if statistics is not None:
                obs = normalised(obs, *statistics)
            chosen = learner.agent.act(weights, obs)
            for i, rule in enumerate(rules.values()):
                chosen = jnp.where((row == 2 + i)[:, None], rule(state, key), chosen)
            return chosen

        def piece(params: Any, policy: Any, carry: Any, key: Any) -> Any:
            def step(carry: Any, key: Any) -> Any:
                state, over, kept = carry
                state = env.step(params, state, act(policy, state, key))
                first = state.done & ~over
                kept = {k: jnp.where(first, state.metrics[k], v) for k, v in kept.items()}
                return (state, over | state.done, kept), None

            return jax.lax.scan(step, carry, jax.random.split(key, PIECE))[0]

        self._reset: Any = jax.jit(env.reset)
        self._piece: Any = jax.jit(piece)

    def _carry(self, state: Any) -> Any:
        zero = jnp.zeros(len(self.names) * self.episodes)
        blank = {k: zero for k in state.metrics if not k.startswith("reward_")}
        return state, zero.astype(bool), blank

    def compile(self, policy: Any) -> None:
        """Compiles ahead; `policy` as of `Learner.policy`, shapes suffice."""
        policy = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), policy)
        keys = jax.ShapeDtypeStruct((len(self.names) * self.episodes, 2), jnp.uint32)
        carry = jax.eval_shape(self._carry, jax.eval_shape(self.env.reset, self.params, keys))
        self._reset = self._reset.lower(self.params, keys).compile()
        self._piece = self._piece.lower(self.params, policy, carry, jax.random.PRNGKey(0)).compile()

    def __call__(self, policy: Any, seed: int) -> dict[str, dict[str, Any]]:
        """Rows by agent."""
        policy = jax.device_put(jax.device_get(policy))
        key_reset, key = jax.random.split(jax.random.PRNGKey(seed))
        carry = self._carry(
            self._reset(self.params, jnp.tile(split_keys(key_reset, self.episodes), (len(self.names), 1)))
        )
        for i in range(-(-self.env.episode_steps // PIECE)):
            carry = self._piece(self.params, policy, carry, jax.random.fold_in(key, i))
            if bool(carry[1].all()):
                break
        told = {k: np.asarray(v).reshape(len(self.names), self.episodes) for k, v in carry[2].items()}
        interval = self.env.control_interval
        return {
            name: dataclasses.asdict(score({k: v[i] for k, v in told.items()}, interval))
            for i, name in enumerate(self.names)
        }


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("training", help="a shipped training of the ladder, or a file like it")
    add("--out", type=Path, required=True)
    add("--name", help="of the files; the training's unless told")
    add("--learner", help="another algorithm than the file's")
    add("--seconds", type=float, default=500.0, help="for everything, compiling and the last score among it")
    add("--last", type=float, default=70.0, help="of them kept for the last two scores")
    add("--target", type=float, help="success of the policy at which the training stops")
    add("--every", type=float, default=90.0, help="s of training between scores")
    add("--episodes", type=int, default=256, help="of each row")
    add("--seed", type=int, default=0)
    add("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of the training")
    add("--env", nargs="*", default=[], metavar="NAME=VALUE", help="options of the environment, as JSON")
    add("--tiny", action="store_true", help="small enough for two CPU cores")
    return parser.parse_args()


def told(value: str) -> Any:
    """An option's value: JSON, or the text itself."""
    try:
        found = json.loads(value)
    except json.JSONDecodeError:
        return value
    return tuple(found) if isinstance(found, list) else found


def main() -> None:
    """Trains, scores and writes."""
    args = options()
    clock = Clock(args.seconds)
    training = get_training(args.training, args.learner)
    training = override(training, **dict(pair.split("=", 1) for pair in args.set))
    more: Mapping[str, Any] = {k: told(v) for k, v in (pair.split("=", 1) for pair in args.env)}
    if args.tiny:
        names = {f.name for c in (training.train, training.train.algorithm) for f in dataclasses.fields(c)}
        training = override(training, **{k: v for k, v in TINY.items() if k in names})
        more, args.episodes = {"worlds": 2, "episode_time": 20.0, **more}, min(args.episodes, 2)
    settings = {**training.options, **more}
    name = args.name or Path(args.training).stem
    args.out.mkdir(parents=True, exist_ok=True)
    env = make(training.environment, **settings)
    unseen = unseen_params(env, training.unseen)
    worlds_s = clock.spent
    learner = Learner(env, training.train)
    rows = Rows(env, learner, unseen, args.episodes)
    shapes = jax.eval_shape(learner.policy, learner.abstract())
    compile_s = in_threads(learner.compile, lambda: rows.compile(shapes))
    say(f"worlds {worlds_s:.0f} s, compiled after {compile_s}, {clock.left:.0f} s left")
    environment = {"name": training.environment, "options": settings, "unseen": dict(training.unseen)}
    # whoever drives the policy makes as many worlds as the rung has, not all that it was trained in
    driven = {**environment, "options": {k: v for k, v in settings.items() if k != "worlds"}}
    record: dict[str, Any] = {
        "commit": commit(),
        "training": name,
        "environment": environment,
        "train": dataclasses.asdict(training.train),
        "learner": type(training.train.algorithm).__name__,
        "seed": args.seed,
        "worlds_s": worlds_s,
        "compile_s": compile_s,
        "scores": [],
        "epochs": [],
    }
    best = {"success": -1.0}
    chosen: list[Any] = []

    def look(state: Any, row: Mapping[str, Any], seed: int) -> None:
        begin = time.monotonic()
        policy = jax.device_get(learner.policy(state))
        found = rows(policy, seed)
        record["scores"].append({"steps": row["steps"], "elapsed_s": row["elapsed_s"], "seed": seed, "rows": found})
        notes = {"score": found["policy"], "steps": row["steps"], "elapsed_s": row["elapsed_s"], "commit": commit()}
        told_policy = policy_of(learner, state, driven, notes)
        save_policy(told_policy, args.out / f"{name}_last.npz")
        if found["policy"]["success"] > best["success"]:
            best["success"] = found["policy"]["success"]
            chosen[:] = [policy, row]
            save_policy(told_policy, args.out / f"{name}.npz")
        save(args.out, name, record)
        say(f"{row['steps']:.3g} steps, {row['elapsed_s']:.0f} s: scored in {time.monotonic() - begin:.0f} s")
        for agent, one in found.items():
            ends = {k: round(v, 3) for k, v in one["ends"].items() if v}
            say(f"    {agent}: {percent(one)}, SPL {one['spl']:.2f}, {one['collisions_per_km']:.0f}/km, {ends}")

    due = [args.every]

    def after_epoch(_: Learner, state: Any, row: dict[str, Any]) -> dict[str, Any]:
        record["epochs"].append({k: row[k] for k in row if not k.startswith("reward_")})
        if row["elapsed_s"] >= due[0]:
            look(state, row, DURING)
            due[0] = row["elapsed_s"] + args.every
        there = args.target is not None and best["success"] >= args.target
        return {"stop": there or clock.left < args.last}

    result = train(learner, RunConfig(training.steps, args.seed, quiet=True), None, environment, after_epoch)
    last = result.rows[-1]
    if not record["scores"] or record["scores"][-1]["steps"] < last["steps"]:
        look(result.state, last, DURING)
    policy, row = chosen
    record["final"] = {"steps": row["steps"], "elapsed_s": row["elapsed_s"], "seed": FINAL, "rows": rows(policy, FINAL)}
    save(args.out, name, record)
    for agent, one in record["final"]["rows"].items():
        say(f"final {agent}: {percent(one)}, SPL {one['spl']:.2f}, {one['collisions_per_km']:.0f}/km, {one['ends']}")
    say(f"done in {clock.spent:.0f} s, {last['steps']:.3g} steps, {last['steps_per_s']:.3g} steps/s")


if __name__ == "__main__":
    main()
