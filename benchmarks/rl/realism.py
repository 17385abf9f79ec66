"""Part `realism` of measure.py: what training with the thermal and soil effects is worth.

TD3 is trained for the same number of steps in two models: the whole one, and one without heat (no temperatures, no
cut-off, motor constants that do not drift) and without soil (hard ground with Coulomb friction everywhere). Every last
policy is then scored in both, on unseen ground and goals; in the whole one with the held-out soil and motors.
"""

from __future__ import annotations

import argparse
from typing import Any

from harness import Clock, Judge, Setup, in_threads, last_policies, percent, save, say, training_of

from lunar_mjx.envs import NavigationEnv

THERMAL = (
    "thermal_cutoff",
    "winding_conduction",
    "rotor_stator_path",
    "housing_convection",
    "housing_conduction",
    "housing_radiation",
)


def plainer(model: Any) -> Any:
    """The model without its thermal effects, and with hard ground wherever there was soil."""
    for name in THERMAL:
        if name in model.effect_names:
            model = model.remove(name)
    return model.set("motor", alpha=0.0, beta=0.0).add("hard_surface")


def realism(args: argparse.Namespace, clock: Clock) -> None:
    """Trains with and without the effects, seed after seed while time is left."""
    training = training_of(args, args.training)
    whole = Setup(training)
    setups = {"without": Setup(training, NavigationEnv(plainer(whole.env.model), whole.env.config)), "with": whole}
    judges = {n: Judge(s.env, args.episodes, {"policy": s.policies()["policy"]}) for n, s in setups.items()}
    in_threads(*(lambda n=n, s=s: s.compile(judges[n]) for n, s in setups.items()))
    say(f"realism: compiled after {clock.spent:.0f} s")
    effects = {n: s.env.model.effect_names for n, s in setups.items()}
    record = {"rover": args.rover, **whole.about, "effects": effects, "steps": int(args.steps), "seeds": []}
    arms = {n: (s, s.env.params) for n, s in setups.items() if args.only is None or n in args.only}
    for row in last_policies(arms, {n: (judge, setups[n].unseen) for n, judge in judges.items()}, clock, args):
        record["seeds"].append({"trained": row.pop("arm"), **row})
        save(args.out, "realism", record)
        for tested, score in row["scores"].items():
            say(f"seed {row['seed']} trained {record['seeds'][-1]['trained']}, tested {tested}: {percent(score)}")
