"""Part `large` of measure.py: TD3 from thousands of rovers, scored on ground, goals and soil never trained on.

Seed after seed is trained while time is left. The policy that is kept is the one with the best score on the ground and
soils of the training; unseen ground chooses nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import time
from typing import Any

from harness import (
    DURING,
    FINAL,
    Clock,
    about_training,
    compile_judge,
    episodes_of,
    in_threads,
    percent,
    save,
    say,
    training_of,
)


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
        wrap = functools.partial(lambda which, policy: (which, policy), jnp.asarray(0))
        self.compile = functools.partial(compile_judge, self._evaluator, learner, self.params["unseen"], wrap)

    def score(self, policy: Any, seed: int, where: str = "unseen", agent: str | None = None) -> Any:
        """Score of a policy (`Learner.policy`, on the host), or of an agent."""
        import jax.numpy as jnp

        which = 0 if agent is None else 1 + self.names.index(agent)
        return self._evaluator(self.params[where], (jnp.asarray(which), policy), seed)


def large(args: argparse.Namespace, clock: Clock) -> None:
    """Trains run after run while time is left; the JSON file is written anew after every one."""
    import jax

    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.envs import make

    training = training_of(args)
    learner = Learner(make(training.environment, **training.options), training.train)
    judge = Judge(learner, dict(training.unseen), episodes_of(args))
    record: dict[str, Any] = {
        "rover": args.rover,
        **about_training(training),
        "target": args.target,
        "setup_s": clock.spent,
        "seeds": [],
    }
    epoch, score = in_threads(learner.compile, judge.compile)
    record |= {"compile_epoch_s": epoch, "compile_score_s": score, "compile_all_s": max(epoch, score)}
    say(f"large: made in {record['setup_s']:.0f} s, compiled in {max(epoch, score):.0f} s, side by side")
    untrained = jax.device_get(learner.policy(learner.init(10_000)))
    record["agents"] = {"untrained": judge.score(untrained, FINAL).record()}
    record["agents"] |= {agent: judge.score(untrained, FINAL, agent=agent).record() for agent in judge.names}
    for agent, found in record["agents"].items():
        say(f"large: {agent} agent {percent(found)} on unseen ground, ends {short(found['ends'])}")
    save(args.out, "large", record)
    kept, state = -1.0, None
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        if clock.left < (5.0 if args.tiny else 45.0):
            break
        del state  # two replay buffers at once would not be needed
        kept, state = one_run(args, clock, record, judge, learner, seed, kept)
    if state is not None and clock.left > (1.0 if args.tiny else 15.0):
        record |= update_rate(learner, state)
    save(args.out, "large", record)


def one_run(
    args: Any, clock: Clock, record: dict[str, Any], judge: Judge, learner: Any, seed: int, kept: float
) -> tuple[float, Any]:
    """Trains one seed; keeps its best policy if none before was better; returns the best score and the last state."""
    import jax

    from lunar_mjx.agents.policy import policy_of, save_policy
    from lunar_mjx.agents.train import RunConfig, train

    begin, scores, due = time.monotonic(), [], args.eval_every
    limit = max(1.0, min(args.seed_seconds, clock.left - (0.0 if args.tiny else 25.0)))
    best: tuple[float, Any, dict[str, Any]] = (-1.0, None, {})

    def check(learner: Any, state: Any, row: dict[str, Any]) -> None:
        nonlocal due, best
        if row["elapsed_s"] < due and time.monotonic() - begin < limit:
            return
        due = row["elapsed_s"] + args.eval_every
        policy, at = jax.device_get(learner.policy(state)), {k: row[k] for k in ("steps", "elapsed_s")}
        unseen, seen = judge.score(policy, DURING), judge.score(policy, DURING, "train")
        scores.append({**at, **unseen.record(), "train": seen.record()})
        say(
            f"large: seed {seed}: {at['elapsed_s']:.1f} s, {at['steps']:,} steps, {row['steps_per_s']:,.0f} steps/s, "
            f"unseen {100 * unseen.success:.1f} %, trained ground {100 * seen.success:.1f} %, ends "
            f"{short(unseen.ends)}, return {unseen.episode_return:.0f}; critic {row['target']:.2f}, losses "
            f"{row['critic_loss']:.3f} {row['actor_loss']:.3f}"
        )
        if seen.success >= best[0]:
            best = (seen.success, policy, {**at, "train_score": seen.record()})
            if seen.success > kept:
                notes = {"seed": seed, "train": record["train"], **best[2]}
                path = args.out / f"policy_{args.rover}.npz"
                save_policy(policy_of(learner, state, record["environment"], notes), path)

    result = train(learner, RunConfig(args.steps, seed, limit, float("inf"), quiet=True), None, None, check)
    last = jax.device_get(learner.policy(result.state))
    final = judge.score(last, FINAL)
    chosen = final if best[1] is None else judge.score(best[1], FINAL)
    reached = next((s for s in scores if s["success"] >= args.target), None)
    record["seeds"].append(
        {
            "seed": seed,
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
        f"large: seed {seed}: kept policy (trained ground {100 * best[0]:.1f} %) {percent(chosen.record())} of "
        f"{chosen.episodes} unseen, last policy {percent(final.record())}; {100 * args.target:.0f} % after "
        f"{reached and round(reached['elapsed_s'], 1)} s of training"
    )
    save(args.out, "large", record)
    return max(kept, best[0]), result.state


def short(ends: dict[str, float]) -> str:
    """Shares of the ways in which episodes end."""
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
