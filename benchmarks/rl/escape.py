"""Scores agents in getting out of holes that their wheels have dug, in two models of the soil, and across them.

    python benchmarks/rl/escape.py --out runs/escape --seconds 500                     # one GPU
    python benchmarks/rl/escape.py --out runs/escape --steps 0 --episodes 32           # two CPU cores: rules alone
    python benchmarks/rl/escape.py --out runs/escape --steps 20000 --episodes 32       # and a short training

A policy is trained in each model by `train/escape.toml`; each is scored in both, on holes that no training saw, beside
agents that learn nothing. What a policy loses in the other model is the transfer gap. All share the episodes' draws of
soil; whether a soil lets a rover dig in depends on the model, so that the holes of the two models differ.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

from harness import FINAL, Clock, Judge, Setup, ends, options, percent, save, say, trained, training_of, when

from lunar_mjx.agents.run import unseen_params
from lunar_mjx.agents.train import RunConfig
from lunar_mjx.envs import make, make_agent

SOILS = {"closed form": "consistent", "stress integral": "field"}
"""Presets by their model of the soil; `ruts` in both."""
RULES = ("zero", "random", "scripted", "rocking")


def main() -> None:
    """Trains, scores and writes."""
    parser = options(__doc__, Path("runs/escape"))
    parser.add_argument("--steps", type=int, default=1_000_000, help="of the environment, of each training; 0: none")
    parser.add_argument("--episodes", type=int, default=256, help="of each row")
    parser.add_argument("--seed", type=int, default=0, help="of the trainings")
    parser.set_defaults(seconds=500.0)
    args = parser.parse_args()
    clock, base = Clock(args.seconds), training_of(args, "escape")
    trainings = {s: dataclasses.replace(base, options={**base.options, "preset": p}) for s, p in SOILS.items()}
    about = {"seed": args.seed, "episodes_seed": FINAL, "episodes": args.episodes}
    record: dict[str, Any] = {**about, "trainings": {}, "soils": {}}
    learnt: dict[str, Any] = {}
    envs: dict[str, Any] = {}
    agent: Any = None
    for i, (soil, training) in enumerate(trainings.items()):
        envs[soil] = make(training.environment, **training.options)
        if not args.steps:
            continue
        setup = Setup(training, envs[soil])
        setup.compile()
        # a third of what is left is kept for the scores
        seconds = 0.67 * clock.left / (len(trainings) - i)
        run = RunConfig(args.steps, args.seed, seconds, math.inf, quiet=True)
        _, learnt[soil], row = trained(setup, run, math.inf, lambda *_: 0.0)
        agent = setup.policies()["policy"]
        record["trainings"][soil] = {**setup.about, **when(row)}
        say(f"{soil}: {row['steps']:.3g} steps in {row['elapsed_s']:.0f} s, {clock.left:.0f} s left")
    for soil, env in envs.items():
        policies = {f"TD3, {home}": _one(agent, home) for home in learnt}
        judge = Judge(env, args.episodes, policies, {name: make_agent(name, env) for name in RULES})
        rows = judge(unseen_params(env, {}), learnt, FINAL)
        record["soils"][soil] = rows
        save(args.out, "escape", record)
        for name, score in rows.items():
            say(f"{soil}, {name}: {percent(score)}, {score['episode_time']:.1f} s, {ends(score)}")


def _one(agent: Any, home: str) -> Any:
    return lambda policies, state, key: agent(policies[home], state, key)


if __name__ == "__main__":
    main()
