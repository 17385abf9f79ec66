"""Part `realism` of measure.py: what training with the thermal and soil effects is worth.

TD3 is trained for the same number of steps in two models: the whole one, and one without heat (no temperatures, no
cut-off, motor constants that do not drift) and without soil (hard ground with Coulomb friction everywhere). Every last
policy is then scored in both, on unseen ground and goals; in the whole one with the held-out soil and motors.
"""

from __future__ import annotations

import argparse
import functools
import time
from typing import Any

from harness import (
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

THERMAL = (
    "thermal_cutoff",
    "winding_conduction",
    "rotor_stator_path",
    "housing_convection",
    "housing_conduction",
    "housing_radiation",
)
STEPS = 10_000_000
"""Environment steps of each training: twice what the first score of 95 % takes."""


def plainer(model: Any) -> Any:
    """The model without its thermal effects, and with hard ground wherever there was soil."""
    for name in THERMAL:
        if name in model.effect_names:
            model = model.remove(name)
    return model.set("motor", alpha=0.0, beta=0.0).add("hard_surface")


def realism(args: argparse.Namespace, clock: Clock) -> None:
    """Trains with and without the effects, seed after seed while time is left."""
    import jax

    from lunar_mjx.agents.evaluate import Evaluator
    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.agents.run import learner_agent, unseen_params
    from lunar_mjx.agents.train import RunConfig, train
    from lunar_mjx.envs import NavigationEnv, make

    training = training_of(args)
    whole: Any = make(training.environment, **training.options)
    envs: dict[str, Any] = {"without": NavigationEnv(plainer(whole.model), whole.config), "with": whole}
    learners = {name: Learner(env, training.train) for name, env in envs.items()}
    judges = {name: Evaluator(env, learner_agent(learners[name]), episodes_of(args)) for name, env in envs.items()}
    params = {name: unseen_params(env, dict(training.unseen)) for name, env in envs.items()}
    calls = [functools.partial(compile_judge, judges[name], learners[name], params[name]) for name in envs]
    say(f"realism: compiled in {max(in_threads(*(x.compile for x in learners.values()), *calls)):.0f} s")
    steps = 3200 if args.tiny else STEPS
    record: dict[str, Any] = {
        "rover": args.rover,
        **about_training(training),
        "effects": {n: e.model.effect_names for n, e in envs.items()},
        "steps": steps,
        "seeds": [],
    }
    longest = 0.0
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for name, learner in learners.items():
            if args.only is not None and f"{seed}/{name}" not in args.only:
                continue
            if clock.left < 1.1 * longest:
                say("realism: no time for more")
                return
            began = time.monotonic()
            result = train(learner, RunConfig(steps, seed, None, float("inf"), quiet=True))
            policy, last = jax.device_get(learner.policy(result.state)), result.rows[-1]
            scores = {where: judge(params[where], policy, FINAL).record() for where, judge in judges.items()}
            row = {"seed": seed, "trained": name, "scores": scores, "train_s": last["elapsed_s"]}
            record["seeds"].append({**row, "steps": last["steps"], "episode_return": last["episode_return"]})
            longest = max(longest, time.monotonic() - began)
            told = ", ".join(f"tested {where} them {percent(s)}" for where, s in scores.items())
            say(f"realism: seed {seed}, trained {name} the effects for {last['elapsed_s']:.0f} s: {told}")
            save(args.out, "realism", record)
            del result
