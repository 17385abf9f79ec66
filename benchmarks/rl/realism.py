"""Part `realism` of measure.py: what training with the thermal and soil effects is worth.

TD3 is trained for the same number of steps in two models: the whole one, and one without heat (no temperatures, no
cut-off, motor constants that do not drift) and without soil (hard ground with Coulomb friction everywhere). Every last
policy is then scored in both, on unseen ground and goals; in the whole one with the held-out soil and motors.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

from harness import FINAL, Clock, Judge, Setup, in_threads, in_time, save, say, trained, training_of
from large import episodes_of
from tables import table_realism

from lunar_mjx.agents.train import RunConfig
from lunar_mjx.envs import NavigationEnv

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
    training = training_of(args, "large-td3")
    whole = Setup(training)
    setups = {"without": Setup(training, NavigationEnv(plainer(whole.env.model), whole.env.config)), "with": whole}
    judges = {n: Judge(s.env, episodes_of(args), {"policy": s.policies()["policy"]}) for n, s in setups.items()}
    in_threads(*(lambda n=n, s=s: s.compile(judges[n]) for n, s in setups.items()))
    say(f"realism: compiled after {clock.spent:.0f} s")
    steps = 3200 if args.tiny else STEPS
    effects = {n: s.env.model.effect_names for n, s in setups.items()}
    record: dict[str, Any] = {"rover": args.rover, **whole.about, "effects": effects, "steps": steps, "seeds": []}
    jobs = [f"{seed}/{name}" for seed in range(args.first_seed, args.first_seed + args.seeds) for name in setups]
    for job in in_time(clock, [job for job in jobs if args.only is None or job in args.only]):
        seed, _, name = job.partition("/")
        run = RunConfig(steps, int(seed), None, math.inf, quiet=True)
        _, policy, last = trained(setups[name], run, math.inf, lambda *_: 0.0)
        scores = {n: judge(setups[n].unseen, policy, FINAL)["policy"] for n, judge in judges.items()}
        row = {"seed": int(seed), "trained": name, "scores": scores, "train_s": last["elapsed_s"]}
        record["seeds"].append({**row, "steps": last["steps"], "episode_return": last["episode_return"]})
        say("\n".join(table_realism(save(args.out, "realism", record))))
