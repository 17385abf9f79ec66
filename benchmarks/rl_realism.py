"""Part `realism` of rl_proof.py: what training with the thermal and soil effects is worth.

TD3 is trained for the same number of steps in two models: the whole one, and one without heat (no temperatures, no
cut-off, motor constants that do not drift) and without soil (hard ground with Coulomb friction everywhere). Every last
policy is then scored in both, on unseen ground and goals; in the whole one with the held-out soil and motors.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rl_common import Clock, save, say
from rl_large import FINAL, percent, training_of

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
    import jax

    from lunar_mjx.agents.evaluate import Evaluator
    from lunar_mjx.agents.learner import Learner
    from lunar_mjx.agents.run import learner_agent, unseen_params
    from lunar_mjx.agents.train import RunConfig, plain, train
    from lunar_mjx.envs import NavigationEnv, make

    training = training_of(args)
    whole: Any = make(training.environment, **training.options)
    envs: dict[str, Any] = {"without": NavigationEnv(plainer(whole.model), whole.config), "with": whole}
    learners = {name: Learner(env, training.train) for name, env in envs.items()}
    episodes = 32 if args.tiny else 1024
    judges = {name: Evaluator(env, learner_agent(learners[name]), episodes) for name, env in envs.items()}
    params = {name: unseen_params(env, dict(training.unseen)) for name, env in envs.items()}
    begin = time.monotonic()

    def compile_judge(name: str) -> None:
        policy = learners[name].policy(learners[name].abstract())
        shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), policy)
        with jax.default_matmul_precision(training.train.precision):
            judges[name].compile(params[name], shapes)

    with ThreadPoolExecutor() as pool:
        waits = [pool.submit(learner.compile) for learner in learners.values()]
        waits += [pool.submit(compile_judge, name) for name in envs]
        for wait in waits:
            wait.result()
    say(f"realism: compiled in {time.monotonic() - begin:.0f} s")
    record: dict[str, Any] = {
        "rover": args.rover,
        "environment": {"options": plain(dict(training.options)), "unseen": training.unseen},
        "train": dataclasses.asdict(training.train),
        "effects": {n: e.model.effect_names for n, e in envs.items()},
        "steps": 3200 if args.tiny else STEPS,
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
            result = train(learner, RunConfig(record["steps"], seed, None, float("inf"), quiet=True))
            policy = jax.device_get(learner.policy(result.state))
            scores = {where: judge(params[where], policy, FINAL).record() for where, judge in judges.items()}
            last = result.rows[-1]
            record["seeds"].append(
                {
                    "seed": seed,
                    "trained": name,
                    "scores": scores,
                    "train_s": last["elapsed_s"],
                    "steps": last["steps"],
                    "episode_return": last["episode_return"],
                }
            )
            longest = max(longest, time.monotonic() - began)
            say(
                f"realism: seed {seed}, trained {name} the effects for {last['elapsed_s']:.0f} s: "
                + ", ".join(f"tested {where} them {percent(s)}" for where, s in scores.items())
            )
            save(args.out, "realism", record)
            del result
