"""Part `depth` of measure.py: rate of an environment with depth pictures, and a student distilled in it.

    python benchmarks/rl/measure.py depth large-depth --seconds 420 --out runs/depth        # one GPU

The rate is of the environment alone under random actions, with as many rovers as the training has: median, least and
most of several repetitions, each from where the one before ended. Rows of a score, all on the same unseen episodes in
one program: the student, the student with its picture at the mean (`blanked`), its teacher, and straight ahead. The
last policy is scored at the end, on other episodes than during the training; nothing is chosen by a score.
"""

from __future__ import annotations

import argparse
import statistics
from typing import Any

import jax
from harness import Clock, Setup, say, training_of
from rates import Driven
from trials import Trials

from lunar_mjx.envs import make_agent
from lunar_mjx.envs.navigation.observations import CAMERA

RATED = 50
"""Steps of each rover in one repetition of the rate."""


def agents(setup: Setup) -> dict[str, Any]:
    """The student, the student that sees no picture, and its teacher, as a judge takes them."""
    pictures = tuple(name for name in setup.env.blocks if name.startswith(CAMERA))
    student, blanked = setup.policies(pictures).values()
    teacher = setup.learner.agent.teacher
    return {"student": student, "blanked": blanked, "teacher": lambda _, state, key: teacher.act(state.privileged)}


def rate_of(driven: Driven, state: Any, repeats: int) -> dict[str, Any]:
    """Rates of repetitions; `state`, of all rovers, is used up."""
    seconds, _, ended = driven.timed(state, repeats)
    rates, c = [driven.size * driven.steps / s for s in seconds], driven.env.config
    about = {"rovers": driven.size, "steps": driven.steps, "picture": [c.camera_width, c.camera_height]}
    found = {"env_steps_per_s": statistics.median(rates), "least": min(rates), "most": max(rates)}
    return {**about, **found, "seconds": seconds, "resets_per_step": sum(ended) / (repeats * driven.steps)}


def depth(args: argparse.Namespace, clock: Clock) -> None:
    """Compiles all programs side by side, measures the rate, trains in time and scores."""
    training, (seed, *_) = training_of(args, args.training), args.seeds
    driven = []

    def beside(setup: Setup) -> None:
        driven.append(Driven(setup.env, training.train.envs, RATED))
        driven[0].compile()

    def rules(env: Any) -> dict[str, Any]:
        return {"straight": make_agent("scripted", env)}

    args.steps = args.steps or training.steps
    trials = Trials(args, training, clock, rules, "last", agents, beside)
    # One device of several: the rate is of one, and a state over a mesh is none that the program was compiled for.
    state = jax.device_put(jax.device_get(trials.setup.learner.init(seed).env))
    trials.record["rate"] = r = rate_of(driven[0], state, args.repeats)
    del state
    rates = f"{r['env_steps_per_s']:,.0f} environment steps/s ({r['least']:,.0f} to {r['most']:,.0f})"
    say(f"{rates}, {r['rovers']} rovers")
    trials(seed)
    (run,) = trials.record["seeds"]
    trials.record["train_steps_per_s"] = statistics.median(row["steps_per_s"] for row in run["epochs"])
    trials.save()
