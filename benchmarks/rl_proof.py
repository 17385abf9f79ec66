"""What training costs and what it comes to, measured in one command; every part saves as it goes.

    python benchmarks/rl_proof.py --out runs/proof                       # all parts in 9 minutes on one GPU
    python benchmarks/rl_proof.py --out runs/proof --part large --seconds 300 --rover viper
    python benchmarks/rl_proof.py --out runs/tiny --tiny                 # the same code on two CPU cores

Parts, each with its own JSON file:
`large`: TD3 from thousands of rovers until 95 % success on unseen ground, goals and soil, seed after seed while time is
left; zero, random and straight-line agents on the same episodes; learner updates per second; the best policy as .npz.
`rates`: environment steps per second, with observation, reward, reset and randomisation, against the bare physics.
`paper`: TD3 and DDPG on the paper's own task with one rover each, five seeds each, on CPU cores beside the GPU.
`scaling`: steps of whole training per second on 1, 2, 4, ... devices of the host, the same share for each device.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

from rl_paper import paper_child, paper_merge, paper_start

PERIOD = {"all": 535.0, "large": 300.0, "rates": 200.0, "paper": 400.0, "scaling": 150.0}
"""s that each part may take."""
FINAL = 54321
"""Seed of the episodes that final scores are taken from; scores during training have others."""


class Clock:
    """Time of a part of the benchmark."""

    def __init__(self, seconds: float):
        self.seconds, self._begin = seconds, time.monotonic()

    @property
    def spent(self) -> float:
        return time.monotonic() - self._begin

    @property
    def left(self) -> float:
        return self.seconds - self.spent


def save(out: Path, name: str, record: dict[str, Any]) -> None:
    import jax
    import mujoco

    from lunar_mjx.agents.train import plain

    about = {"device": jax.devices()[0].device_kind, "devices": jax.device_count(), "jax": jax.__version__,
             "mujoco": mujoco.__version__}  # fmt: skip
    text = json.dumps(plain({"about": about, **record}), indent=None) + "\n"
    (out / f"rl_{name}.json").write_text(text, encoding="utf-8")


def say(text: str) -> None:
    print(text, flush=True)


# Large batches


def training_of(args: argparse.Namespace) -> Any:
    from lunar_mjx.agents.configs import get_training, override
    from lunar_mjx.commands.train import env_options, pairs

    training = get_training("large-td3")
    options = {**training.options, "rover": args.rover}
    unseen = dict(training.unseen)
    small = {}
    if args.tiny:
        options |= {"terrain": "flat", "goal_distance": (2.0, 4.0), "episode_time": 10.0, "places": 256}
        unseen["terrain"] = "flat"
        small = {"envs": 64, "batch": 256, "updates": 2, "actor_layers": (64, 64), "critic_layers": (64, 64),
                 "atoms": 21, "epoch_steps": 25, "buffer_steps": 64}  # fmt: skip
    training = override(training, **{**small, **pairs("--set", args.set)})
    return dataclasses.replace(training, options={**options, **env_options(args.env)}, unseen=unseen)


class Judge:
    """Scores the learner's policy and the agents that learn nothing on unseen ground, compiled once for all of them."""

    def __init__(self, learner: Any, unseen: dict[str, Any], episodes: int):
        import jax.numpy as jnp

        from lunar_mjx.agents.evaluate import Evaluator
        from lunar_mjx.agents.run import learner_agent, unseen_params
        from lunar_mjx.envs.scripted import AGENTS, make_agent

        env, self.learner, self.names = learner.env, learner, AGENTS
        self.params = unseen_params(env, unseen)
        trained, others = learner_agent(learner), [make_agent(n, env) for n in AGENTS]

        def act(params: Any, state: Any, key: Any) -> Any:
            which, policy = params
            return jnp.stack([trained(policy, state, key), *(agent(state, key) for agent in others)])[which]

        self._evaluator = Evaluator(env, act, episodes)

    def score(self, state: Any, seed: int, agent: str | None = None) -> Any:
        """Score of the policy of a training's state, or of an agent."""
        import jax.numpy as jnp

        which = 0 if agent is None else 1 + self.names.index(agent)
        return self._evaluator(self.params, (jnp.asarray(which), self.learner.policy(state)), seed)


def large(args: argparse.Namespace, clock: Clock, name: str = "large") -> None:
    """Trains seed after seed; the JSON file is written anew after every one."""
    import jax

    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.agents.train import plain
    from lunar_mjx.envs import make

    training = training_of(args)
    env = make(training.environment, **training.options)
    environment = {"name": training.environment, "options": plain(dict(training.options)), "unseen": training.unseen}
    learner = Learner(env, training.train)
    judge = Judge(learner, dict(training.unseen), 32 if args.tiny else 1024)
    record: dict[str, Any] = {
        "rover": args.rover, "environment": environment, "train": dataclasses.asdict(training.train),
        "target": args.target, "setup_s": clock.spent, "seeds": [],
    }  # fmt: skip
    say(f"{name}: made in {clock.spent:.0f} s, observation {env.observation_size} + {env.privileged_size} numbers")
    begin = time.monotonic()
    state, _ = jax.block_until_ready(learner.epoch(env.params, learner.init(10_000)))
    record["compile_epoch_s"] = time.monotonic() - begin
    begin = time.monotonic()
    record["agents"] = {"untrained": judge.score(state, FINAL).record()}
    record["compile_score_s"] = time.monotonic() - begin
    for agent in judge.names:
        record["agents"][agent] = judge.score(state, FINAL, agent).record()
    for agent, score in record["agents"].items():
        say(f"{name}: {agent} agent {100 * score['success']:.1f} % on unseen ground, ends {short(score['ends'])}")
    say(f"{name}: compiled in {record['compile_epoch_s']:.0f} + {record['compile_score_s']:.0f} s")
    save(args.out, name, record)
    best = -1.0
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        if seed > args.first_seed and clock.left < 0.8 * record["seeds"][-1]["process_s"]:
            say(f"{name}: no time for seed {seed}")
            break
        best = one_seed(args, clock, name, record, judge, seed, best)
        if state is not None:
            record |= update_rate(learner, state)
            save(args.out, name, record)
            state = None


def one_seed(args: Any, clock: Clock, name: str, record: dict[str, Any], judge: Judge, seed: int, best: float
             ) -> float:  # fmt: skip
    """Trains one seed, keeps its policy if it is the best; returns the best score."""
    from lunar_mjx.agents.policy import save_policy
    from lunar_mjx.agents.train import RunConfig, train

    begin, scores, due = time.monotonic(), [], args.eval_every
    limit = max(1.0, min(args.seed_seconds, clock.left - (0.0 if args.tiny else 8.0)))

    def check(learner: Any, state: Any, row: dict[str, Any]) -> dict[str, Any] | None:
        nonlocal due
        if row["elapsed_s"] < due:
            return None
        due = row["elapsed_s"] + args.eval_every
        score = judge.score(state, 12345)
        scores.append({"steps": row["steps"], "elapsed_s": row["elapsed_s"], **score.record()})
        say(f"{name}: seed {seed}: {row['elapsed_s']:.1f} s of training, {row['steps']:,} steps, "
            f"{row['steps_per_s']:,.0f} steps/s, {100 * score.success:.1f} % on unseen ground, "
            f"ends {short(score.ends)}")  # fmt: skip
        return {"unseen_success": score.success, "stop": score.success >= args.target}

    run = RunConfig(args.steps, seed, limit, float("inf"), quiet=True)
    result = train(judge.learner, run, None, record["environment"], check)
    final = judge.score(result.state, FINAL)
    reached = next((s for s in scores if s["success"] >= args.target), None)
    record["seeds"].append({
        "seed": seed, "rows": result.rows, "unseen": scores, "final": final.record(),
        "train_s": result.rows[-1]["elapsed_s"], "steps": result.rows[-1]["steps"],
        "seconds_to_target": reached and reached["elapsed_s"], "steps_to_target": reached and reached["steps"],
        "process_s": time.monotonic() - begin,
    })  # fmt: skip
    say(f"{name}: seed {seed}: final {100 * final.success:.1f} % ({100 * final.low:.1f} to {100 * final.high:.1f}) of "
        f"{final.episodes}, target after {reached and round(reached['elapsed_s'], 1)} s")  # fmt: skip
    if final.success > best:
        best = final.success
        notes = {**result.policy.notes, "score": final.record(), "seed": seed}
        save_policy(dataclasses.replace(result.policy, notes=notes), args.out / f"policy_{args.rover}.npz")
    save(args.out, name, record)
    return best


def short(ends: dict[str, float]) -> str:
    return json.dumps({k: round(v, 3) for k, v in ends.items() if v > 0.0})


def update_rate(learner: Any, state: Any) -> dict[str, Any]:
    """Updates per second by the difference between epochs that learn and epochs that only collect; compiles nothing."""
    import jax
    import jax.numpy as jnp

    seconds, c = {}, learner.config
    for name, count in (("learning", c.random_steps), ("collecting", -(10**9))):
        best = float("inf")
        for _ in range(3):
            begin_at = jax.device_put(jnp.full_like(state.iterations, count), state.iterations.sharding)
            state = jax.block_until_ready(dataclasses.replace(state, iterations=begin_at))
            begin = time.monotonic()
            state, _ = jax.block_until_ready(learner.epoch(learner.env.params, state))
            best = min(best, time.monotonic() - begin)
        seconds[name] = best
    collected = c.envs * c.epoch_steps / seconds["collecting"]
    rate = c.updates * c.epoch_steps / max(seconds["learning"] - seconds["collecting"], 1e-9)
    say(f"large: {rate:,.0f} updates/s of {c.batch:,} transitions; {collected:,.0f} environment steps/s without them")
    return {"updates_per_s": rate, "transitions_per_s": rate * c.batch, "collected_per_s": collected}


# Rates of the environment


def timed(function: Any, args: tuple[Any, ...], repeats: int = 3) -> tuple[float, float, Any]:
    """Best time in s of `function(*args) -> args[-1]`, its compile time, and its memory analysis."""
    import jax

    begin = time.monotonic()
    compiled = jax.jit(function, donate_argnums=len(args) - 1).lower(*args).compile()
    compile_s = time.monotonic() - begin
    *fixed, state = args
    best = float("inf")
    for i in range(repeats + 1):
        begin = time.monotonic()
        state = jax.block_until_ready(compiled(*fixed, state))
        if i:
            best = min(best, time.monotonic() - begin)
    return best, compile_s, compiled.memory_analysis()


def rates(args: argparse.Namespace, clock: Clock) -> None:
    from lunar_mjx.envs import make_navigation
    from lunar_mjx.envs.observations import PAPER_OBSERVATION

    ground = {"terrain": "flat", "goal_distance": (2.0, 4.0), "places": 256} if args.tiny else {}
    few = {"observations": PAPER_OBSERVATION, "privileged": ()}
    plan = [("17 numbers", 5, 65536), ("all observations", 50, 65536), ("17 numbers", 5, 4096),
            ("17 numbers", 5, 16384), ("17 numbers", 5, 1024), ("all observations", 50, 4096),
            ("all observations", 5, 65536), ("17 numbers", 50, 65536)]  # fmt: skip
    made: dict[tuple[str, int], Any] = {}
    rows: list[dict[str, Any]] = []
    for label, decimation, size in [("17 numbers", 5, 8)] if args.tiny else plan:
        if rows and clock.left < 1.3 * rows[-1]["process_s"]:
            say("rates: no time for more")
            return
        begin = time.monotonic()
        if (label, decimation) not in made:
            options = {"decimation": decimation, "places": 2048, **(few if label == "17 numbers" else {}), **ground}
            made[label, decimation] = make_navigation("large", args.rover, **options)
        steps = 4 if args.tiny else max(20, 1000 // decimation)
        row = rate_of(made[label, decimation], size, steps, args.tiny)
        rows.append({"observation": label, "decimation": decimation, "rovers": size, **row,
                     "process_s": time.monotonic() - begin})  # fmt: skip
        say(f"rates: {label}, decimation {decimation}, {size:,} rovers: "
            f"{row['env_steps_per_s']:,.0f} environment steps/s, bare physics {row['bare_steps_per_s']:,.0f}, "
            f"ratio {row['ratio']:.3f}")  # fmt: skip
        save(args.out, "rates", {"rover": args.rover, "rows": rows})


def rate_of(env: Any, size: int, steps: int, tiny: bool) -> dict[str, Any]:
    """Steps per second of the environment under random actions, and of its physics alone under the same changes."""
    import jax
    import jax.numpy as jnp

    from lunar_mjx.envs import split_keys

    decimation, key = env.config.decimation, jax.random.PRNGKey(0)

    def drive(params: Any, state: Any) -> Any:
        def step(state: Any, key: Any) -> Any:
            action = jax.random.uniform(key, (size, env.action_size), minval=-1.0)
            return env.step(params, state, action), None

        return jax.lax.scan(step, state, jax.random.split(key, steps))[0]

    shares = jax.random.uniform(key, (steps, env.action_size), minval=-1.0)
    controls = env.actions.controls(shares)

    def bare(params: Any, state: Any) -> Any:
        return env.system.rollout_batch(params.system, state, controls, decimation, report=lambda t: None)[0]

    repeats = 1 if tiny else 3
    state = jax.block_until_ready(jax.jit(env.reset)(env.params, split_keys(key, size)))
    physics = jax.tree.map(jnp.copy, state.inner.physics)
    held = sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / size
    ours, compile_s, memory = timed(drive, (env.params, state), repeats)
    naked, bare_compile_s, _ = timed(bare, (env.params, physics), repeats)
    return {
        "env_steps_per_s": size * steps / ours,
        "physics_steps_per_s": size * steps * decimation / ours,
        "bare_steps_per_s": size * steps / naked,
        "ratio": naked / ours,
        "compile_s": compile_s,
        "bare_compile_s": bare_compile_s,
        "state_bytes_per_rover": held,
        "temporary_bytes_per_rover": getattr(memory, "temp_size_in_bytes", 0) / size,
    }


# Several devices


def scaling(args: argparse.Namespace, clock: Clock) -> None:
    """Whole training epochs per second on more and more devices, the same rovers and transitions on each."""
    import jax
    import numpy as np
    from jax.sharding import Mesh

    from lunar_mjx.agents.learner import AXIS, Learner
    from lunar_mjx.envs import make

    training = training_of(args)
    env = make(training.environment, **training.options)
    rows: list[dict[str, Any]] = []
    count = 1
    while count <= jax.device_count() and (not rows or clock.left > 30.0):
        config = dataclasses.replace(training.train, envs=training.train.envs * count,
                                     batch=training.train.batch * count)  # fmt: skip
        learner = Learner(env, config, Mesh(np.array(jax.devices()[:count]), (AXIS,)))
        state = learner.init(0)
        best = float("inf")
        for i in range(2 if args.tiny else 5):
            begin = time.monotonic()
            state, _ = jax.block_until_ready(learner.epoch(env.params, state))
            if i:
                best = min(best, time.monotonic() - begin)
        rate = config.envs * config.epoch_steps / best
        rows.append({"devices": count, "steps_per_s": rate, "updates_per_s": config.updates * config.epoch_steps / best,
                     "efficiency": rate / count / (rows[0]["steps_per_s"] if rows else rate)})  # fmt: skip
        say(f"scaling: {count} devices, {rate:,.0f} steps/s, efficiency {rows[-1]['efficiency']:.3f}")
        save(args.out, "scaling", {"rover": args.rover, "rows": rows})
        count *= 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", choices=(*PERIOD, "paper-child"), default="all")
    parser.add_argument("--seconds", type=float, help="that the part may take")
    parser.add_argument("--tiny", action="store_true", help="small enough for two CPU cores")
    parser.add_argument("--rover", default="luvmi_x")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=2_000_000_000, help="most environment steps of a seed")
    parser.add_argument("--seed-seconds", type=float, default=150.0, help="most s of one seed of part large")
    parser.add_argument("--eval-every", type=float, default=8.0, help="s of training")
    parser.add_argument("--target", type=float, default=0.95)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of the training")
    parser.add_argument("--env", nargs="*", default=[], metavar="NAME=VALUE", help="options of the environment")
    parser.add_argument("--training", default="paper-td3", help="of part paper-child")
    parser.add_argument("--core", type=int, help="CPU core of part paper-child")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    clock = Clock(args.seconds or PERIOD.get(args.part, 60.0))
    if args.tiny:
        args.seeds, args.steps, args.eval_every = min(args.seeds, 2), min(args.steps, 4000), 1.0
    if args.part == "paper-child":
        paper_child(args)
        return
    children = []
    if args.part in ("all", "paper"):
        children = paper_start(args, clock.left - 25.0)
    try:
        if args.part in ("all", "large"):
            large(args, Clock(0.7 * clock.left if args.part == "all" else clock.left))
        if args.part in ("all", "rates"):
            rates(args, Clock(clock.left - 15.0))
        if args.part == "scaling":
            scaling(args, clock)
    finally:
        if children:
            save(args.out, "paper", paper_merge(children, clock.left))
    say(f"done in {clock.spent:.0f} s")


if __name__ == "__main__":
    main()
