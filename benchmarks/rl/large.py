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
from harness import FINAL, Clock, percent, say, training_of
from trials import Trials

from lunar_mjx.envs import make_agent

RULES = ("zero", "random", "scripted", "reactive")
"""Agents that learn nothing."""
SCORING, TRAINING, RATING = 25.0, 20.0, 15.0
"""s kept for a seed's last scores, least s of its training, and s for the rate of updates; --tiny takes a tenth."""


def episodes_of(args: argparse.Namespace) -> int:
    """Episodes of a score."""
    return 32 if args.tiny else 1024


def large(args: argparse.Namespace, clock: Clock) -> None:
    """Trains seed after seed while time is left; the JSON file is written anew after every score."""
    training, share = training_of(args, "large-td3"), 0.1 if args.tiny else 1.0
    if args.unseen_terrain:
        training = dataclasses.replace(training, unseen={**training.unseen, "terrain": args.unseen_terrain})
    trials = Trials(training, "large", args.out, clock, episodes_of(args), rules, seen=True)
    setup, record, state = trials.setup, trials.record, None
    record |= {"rover": args.rover, "target": args.target}
    record["untrained"] = trials.judge(setup.unseen, setup.policy(setup.learner.init(10_000)), FINAL)["policy"]
    say(f"untrained agent {percent(record['untrained'])} on unseen ground")
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        if clock.left < share * (SCORING + TRAINING):
            break
        del state  # two replay buffers at once would not be needed
        state = trials(seed, args.steps, min(args.seed_seconds, clock.left - share * SCORING), args.eval_every)
    if state is not None and clock.left > share * RATING:
        record |= update_rate(setup.learner, state)
    trials.save()


def rules(env: Any) -> dict[str, Any]:
    """Agents that learn nothing, by name."""
    return {name: make_agent(name, env) for name in RULES}


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
