"""Part `large` of measure.py: TD3 from thousands of rovers, scored on ground, goals and soil never trained on.

Seed after seed is trained while time is left. The policy that is kept is the one with the best score on the ground and
soils of the training; unseen ground chooses nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp
from harness import DURING, FINAL, Clock, Judge, Setup, ends, percent, reached, save, say, trained, training_of, when

from lunar_mjx.agents.policy import policy_of, save_policy
from lunar_mjx.agents.train import RunConfig
from lunar_mjx.envs import make_agent

RULES = ("zero", "random", "scripted", "reactive")
"""Agents that learn nothing."""
SCORING, TRAINING, RATING = 25.0, 20.0, 15.0
"""s kept for a seed's last scores, least s of its training, and s for the rate of updates; --tiny takes a tenth."""


def episodes_of(args: argparse.Namespace) -> int:
    """Episodes of a score."""
    return 32 if args.tiny else 1024


def large(args: argparse.Namespace, clock: Clock) -> None:
    """Trains run after run while time is left; the JSON file is written anew after every one."""
    training = training_of(args, "large-td3")
    if args.unseen_terrain:
        training = dataclasses.replace(training, unseen={**training.unseen, "terrain": args.unseen_terrain})
    setup = Setup(training)
    rules = {name: make_agent(name, setup.env) for name in RULES}
    alone = Judge(setup.env, episodes_of(args), {"policy": setup.policies()["policy"]})
    beside = Judge(setup.env, episodes_of(args), setup.policies(), rules)
    record = {"rover": args.rover, **setup.about, "target": args.target, "setup_s": clock.spent, "seeds": []}
    epoch, score = setup.compile(alone, beside)
    record |= {"compile_epoch_s": epoch, "compile_score_s": score, "compile_all_s": max(epoch, score)}
    say(f"large: made in {record['setup_s']:.0f} s, compiled in {max(epoch, score):.0f} s, side by side")
    rows = beside(setup.unseen, setup.policy(setup.learner.init(10_000)), FINAL)
    record["agents"] = {"untrained": rows["policy"], **{n: rows[n] for n in RULES}}
    for agent, found in record["agents"].items():
        say(f"large: {agent} agent {percent(found)} on unseen ground, ends {ends(found)}")
    save(args.out, "large", record)
    kept, state, share = -1.0, None, 0.1 if args.tiny else 1.0
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        if clock.left < share * (SCORING + TRAINING):
            break
        del state  # two replay buffers at once would not be needed
        kept, state = one_run(args, clock, record, setup, (alone, beside), seed, kept)
        save(args.out, "large", record)
    if state is not None and clock.left > share * RATING:
        record |= update_rate(setup.learner, state)
    save(args.out, "large", record)


def one_run(
    args: Any, clock: Clock, record: dict[str, Any], setup: Setup, judges: Any, seed: int, kept: float
) -> tuple[float, Any]:
    """Trains one seed; keeps its best policy if none before was better; returns the best score and the last state."""
    (alone, beside), begin, scores = judges, time.monotonic(), []
    limit = min(args.seed_seconds, clock.left - (0.1 if args.tiny else 1.0) * SCORING)

    def look(policy: Any, state: Any, epochs: list[dict[str, Any]]) -> float:
        nonlocal kept
        row, at = epochs[-1], when(epochs[-1])
        unseen, seen = (alone(params, policy, DURING)["policy"] for params in (setup.unseen, setup.env.params))
        scores.append({**at, **unseen, "train": seen})
        say(
            f"large: seed {seed}: {at['elapsed_s']:.1f} s, {at['steps']:,} steps, {row['steps_per_s']:,.0f} steps/s, "
            f"unseen {percent(unseen)}, trained ground {percent(seen)}, ends {ends(unseen)}, return "
            f"{unseen['episode_return']:.0f}; critic {row['target']:.2f}, losses {row['critic_loss']:.3f} "
            f"{row['actor_loss']:.3f}"
        )
        if seen["success"] > kept:
            kept = seen["success"]
            notes = {"seed": seed, "train": record["train"], **at, "train_score": seen}
            save_policy(
                policy_of(setup.learner, state, setup.environment, notes), args.out / f"policy_{args.rover}.npz"
            )
        return seen["success"]

    run = RunConfig(args.steps, seed, limit, float("inf"), quiet=True)
    result, chosen, at = trained(setup, run, args.eval_every, look)
    last = alone(setup.unseen, setup.policy(result.state), FINAL)["policy"]
    rows = beside(setup.unseen, chosen, FINAL)
    score = next(s["train"] for s in scores if s["steps"] == at["steps"])
    told = {
        "seed": seed,
        "rows": result.rows,
        "unseen": scores,
        "last": last,
        "final": rows["policy"],
        "blanked": rows["policy, scans blanked"],
        "kept": {**when(at), "train_score": score},
        "train_s": result.rows[-1]["elapsed_s"],
        "steps": result.rows[-1]["steps"],
        **reached(scores, args.target),
        "process_s": time.monotonic() - begin,
    }
    record["seeds"].append(told)
    say(
        f"large: seed {seed}: kept policy (trained ground {percent(score)}) {percent(rows['policy'])} of "
        f"{last['episodes']} unseen, last policy {percent(last)}; {100 * args.target:.0f} % after "
        f"{told['seconds_to_target']} s of training"
    )
    return kept, result.state


def update_rate(learner: Any, state: Any) -> dict[str, Any]:
    """Updates per second by the difference between epochs that learn and epochs that only collect; compiles nothing."""
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
