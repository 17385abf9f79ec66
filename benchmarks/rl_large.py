"""Part `large` of rl_proof.py: TD3 from thousands of rovers, scored on ground, goals and soil never trained on.

One configuration is trained from a first seed. If it reaches the target, other seeds of it follow; if not, and
`--compare` names other settings, those are trained next. Everything is compiled side by side beforehand. The policy
that is kept is the one with the best score on the ground and soils of the training; unseen ground chooses nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rl_common import Clock, save, say

FINAL = 54321
"""Seed of the episodes that final scores are taken from; scores during training have others."""
DURING = 12345


def training_of(args: argparse.Namespace, more: list[str] | None = None) -> Any:
    """The training, with the settings of the command line and `more` of them."""
    from lunar_mjx.agents.configs import get_training, override
    from lunar_mjx.commands.train import env_options, pairs

    training = get_training("large-td3")
    options = {**training.options, "rover": args.rover}
    unseen = dict(training.unseen)
    if args.unseen_terrain:
        unseen["terrain"] = args.unseen_terrain
    small = {}
    if args.tiny:
        options |= {"terrain": "flat", "goal_distance": (2.0, 4.0), "episode_time": 10.0, "places": 256}
        unseen["terrain"] = "flat"
        small = {
            "envs": 64,
            "batch": 256,
            "updates": 2,
            "actor_layers": (64, 64),
            "critic_layers": (64, 64),
            "atoms": 21,
            "epoch_steps": 25,
            "buffer_steps": 64,
        }
    training = override(training, **{**small, **pairs("--set", args.set), **pairs("--compare", more)})
    return dataclasses.replace(training, options={**options, **env_options(args.env)}, unseen=unseen)


class Judge:
    """Scores policies and the agents that learn nothing, on unseen ground and on the training's, by one program."""

    def __init__(self, learner: Any, unseen: dict[str, Any], episodes: int):
        import jax.numpy as jnp

        from lunar_mjx.agents.evaluate import Evaluator
        from lunar_mjx.agents.run import learner_agent, unseen_params
        from lunar_mjx.envs.scripted import AGENTS, make_agent

        env, self.names = learner.env, AGENTS
        self.params = {"train": env.params, "unseen": unseen_params(env, unseen)}
        trained, others = learner_agent(learner), [make_agent(n, env) for n in AGENTS]

        def act(params: Any, state: Any, key: Any) -> Any:
            which, policy = params
            return jnp.stack([trained(policy, state, key), *(agent(state, key) for agent in others)])[which]

        self._evaluator = Evaluator(env, act, episodes)

    def compile(self, learner: Any) -> None:
        import jax
        import jax.numpy as jnp

        policy = learner.policy(learner.abstract())
        shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), policy)
        with jax.default_matmul_precision(learner.config.precision):
            self._evaluator.compile(self.params["unseen"], (jnp.asarray(0), shapes))

    def score(self, policy: Any, seed: int, where: str = "unseen", agent: str | None = None) -> Any:
        """Score of a policy (`Learner.policy`, on the host), or of an agent."""
        import jax.numpy as jnp

        which = 0 if agent is None else 1 + self.names.index(agent)
        return self._evaluator(self.params[where], (jnp.asarray(which), policy), seed)


def large(args: argparse.Namespace, clock: Clock) -> None:
    """Trains run after run while time is left; the JSON file is written anew after every one."""
    import jax

    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.agents.train import plain
    from lunar_mjx.envs import make

    training = training_of(args)
    env = make(training.environment, **training.options)
    environment = {"name": training.environment, "options": plain(dict(training.options)), "unseen": training.unseen}
    learners = [Learner(env, training.train)]
    if args.compare:
        learners.append(Learner(env, training_of(args, args.compare).train))
    judge = Judge(learners[0], dict(training.unseen), 32 if args.tiny else 1024)
    record: dict[str, Any] = {
        "rover": args.rover,
        "environment": environment,
        "train": dataclasses.asdict(training.train),
        "compare": args.compare,
        "target": args.target,
        "setup_s": clock.spent,
        "seeds": [],
    }
    say(f"large: made in {clock.spent:.0f} s, observation {env.observation_size} + {env.privileged_size} numbers")
    record |= compile_all(learners, judge)
    policy = jax.device_get(learners[0].policy(learners[0].init(10_000)))
    record["agents"] = {"untrained": judge.score(policy, FINAL).record()}
    for agent in judge.names:
        record["agents"][agent] = judge.score(policy, FINAL, agent=agent).record()
    for agent, score in record["agents"].items():
        say(f"large: {agent} agent {percent(score)} on unseen ground, ends {short(score['ends'])}")
    save(args.out, "large", record)
    kept, which, seed, state = -1.0, 0, args.first_seed, None
    while seed < args.first_seed + args.seeds and clock.left > (5.0 if args.tiny else 45.0):
        del state  # two replay buffers at once would not be needed
        kept, state = one_run(args, clock, record, judge, learners[which], which, seed, kept)
        reached = record["seeds"][-1]["seconds_to_target"] is not None
        if which == 0 and not reached and len(learners) > 1:
            which = 1
        else:
            seed += 1
    if state is not None and clock.left > (1.0 if args.tiny else 15.0):
        record |= update_rate(learners[which], state)
    save(args.out, "large", record)


def compile_all(learners: list[Any], judge: Judge) -> dict[str, float]:
    """Compiles in threads: XLA lets go of the interpreter."""
    begin = time.monotonic()

    def timed(function: Any, *arguments: Any) -> float:
        function(*arguments)
        return time.monotonic() - begin

    with ThreadPoolExecutor() as pool:
        waits = [pool.submit(timed, x.compile) for x in learners]
        score = pool.submit(timed, judge.compile, learners[0])
        epochs = [w.result() for w in waits]
        seconds = {"compile_epoch_s": epochs[0], "compile_score_s": score.result(), "compile_all_s": 0.0}
    seconds["compile_all_s"] = time.monotonic() - begin
    say(
        f"large: compiled in {seconds['compile_all_s']:.0f} s, side by side: training {[round(e) for e in epochs]} s, "
        f"scores {seconds['compile_score_s']:.0f} s"
    )
    return seconds


def one_run(
    args: Any, clock: Clock, record: dict[str, Any], judge: Judge, learner: Any, which: int, seed: int, kept: float
) -> tuple[float, Any]:
    """Trains one seed; keeps its best policy if none before was better; returns the best score and the last state."""
    import jax

    from lunar_mjx.agents.policy import policy_of, save_policy
    from lunar_mjx.agents.train import RunConfig, train

    begin, scores, due = time.monotonic(), [], args.eval_every
    limit = max(1.0, min(args.seed_seconds, clock.left - (0.0 if args.tiny else 25.0)))
    label = f"large: {'compared ' if which else ''}seed {seed}"
    best: tuple[float, Any, dict[str, Any]] = (-1.0, None, {})

    def check(learner: Any, state: Any, row: dict[str, Any]) -> None:
        nonlocal due, best
        if row["elapsed_s"] < due and time.monotonic() - begin < limit:
            return
        due = row["elapsed_s"] + args.eval_every
        policy = jax.device_get(learner.policy(state))
        unseen, seen = judge.score(policy, DURING), judge.score(policy, DURING, "train")
        scores.append({"steps": row["steps"], "elapsed_s": row["elapsed_s"], **unseen.record(), "train": seen.record()})
        say(
            f"{label}: {row['elapsed_s']:.1f} s, {row['steps']:,} steps, {row['steps_per_s']:,.0f} steps/s, unseen "
            f"{100 * unseen.success:.1f} %, trained ground {100 * seen.success:.1f} %, ends {short(unseen.ends)}, "
            f"return {unseen.episode_return:.0f}; while training: success {row['success']:.3f}, return "
            f"{row['episode_return']:.0f}, reward {row['reward']:.3f}, critic {row['target']:.2f} "
            f"({row['target_low']:.2f} to {row['target_high']:.2f}), losses {row['critic_loss']:.3f} "
            f"{row['actor_loss']:.3f}"
        )
        if seen.success >= best[0]:
            best = (
                seen.success,
                policy,
                {"steps": row["steps"], "elapsed_s": row["elapsed_s"], "train_score": seen.record()},
            )
            if seen.success > kept:
                notes = {"seed": seed, "train": record["train"], "compare": args.compare if which else [], **best[2]}
                save_policy(policy_of(learner, state, record["environment"], notes), path)

    path = args.out / f"policy_{args.rover}.npz"
    result = train(learner, RunConfig(args.steps, seed, limit, float("inf"), quiet=True), None, None, check)
    last = jax.device_get(learner.policy(result.state))
    final = judge.score(last, FINAL)
    chosen = final if best[1] is None else judge.score(best[1], FINAL)
    reached = next((s for s in scores if s["success"] >= args.target), None)
    record["seeds"].append(
        {
            "seed": seed,
            "compared": bool(which),
            "rows": result.rows,
            "unseen": scores,
            "last": final.record(),
            "final": chosen.record(),
            "kept": best[2],
            "train_s": result.rows[-1]["elapsed_s"],
            "steps": result.rows[-1]["steps"],
            "seconds_to_target": reached and reached["elapsed_s"],
            "steps_to_target": reached and reached["steps"],
            "process_s": time.monotonic() - begin,
        }
    )
    say(
        f"{label}: kept policy (trained ground {100 * best[0]:.1f} %) {percent(chosen.record())} of {chosen.episodes} "
        f"unseen, last policy {percent(final.record())}; {100 * args.target:.0f} % after "
        f"{reached and round(reached['elapsed_s'], 1)} s of training"
    )
    save(args.out, "large", record)
    return max(kept, best[0]), result.state


def percent(score: dict[str, Any]) -> str:
    return f"{100 * score['success']:.1f} % ({100 * score['low']:.1f} to {100 * score['high']:.1f})"


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
