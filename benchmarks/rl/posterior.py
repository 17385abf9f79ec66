"""Parts `fit` and `posterior` of measure.py: training on what a log left open, scored on a soil that none was told.

    python benchmarks/rl/measure.py fit --out runs/fit                       # 4 minutes of CPU: posterior.toml
    python benchmarks/rl/measure.py posterior --seconds 400 --out runs/posterior     # one GPU: the trainings
    python benchmarks/rl/measure.py posterior short --steps 48000 --episodes 256 --out runs/short      # two CPU cores

`fit` hides a soil and motors, `TRUTH`, behind a simulated drive with a data sheet's noise, on level ground, one axle
faster than the other. `lunar-mjx compare` fits the nominal model to it. Policies are then trained for as many steps
each: on that fit's posterior; on uniform ranges about the nominal model, in which the hidden soil lies; on the nominal
model alone; and, with `--only truth`, on the hidden soil itself. All last policies are scored on the same episodes in
the hidden soil, on unseen ground. Seeds go round, so that a run that is cut off has all arms.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import pandas
from harness import KEPT, Clock, Judge, Setup, command, ends, in_threads, last_policies, percent, save, say, training_of

from lunar_mjx.envs import make
from lunar_mjx.envs.navigation.config import SOIL_RANGES
from lunar_mjx.envs.navigation.worlds import PREFIX, world
from lunar_mjx.model import Model, make_model
from lunar_mjx.model.file import load_model, save_model

TRUTH: Mapping[str, float] = {
    "soil.k_phi": 0.6,
    "soil.cohesion": 0.5,
    "soil.friction_angle": 0.92,
    "soil.shear_modulus_x": 1.3,
    "motor.torque_constant": 0.98,
    "motor.resistance": 1.03,
}
"""Factors on the nominal model's values: weak ground, within every range of `SOIL_RANGES`."""
STILL = tuple(dataclasses.replace(r, low=1.0, high=1.0) if r.relative else r for r in SOIL_RANGES)
"""The ranges with all factors at one; motors begin cold or warm all the same: no log tells that of another day."""
FITTED = KEPT / "posterior.toml"
"""What `fit` writes and the trainings read."""
DRIVE = ("--manoeuvre", "slip_sweep", "--seconds", 20, "--noise", "datasheet", "--seed", 1)
"""The log: one axle runs faster than the other."""
ARMS = ("posterior", "uniform", "nominal", "truth")


def hidden(model: Model) -> Model:
    """A model with the hidden soil and motors."""
    for name, factor in TRUTH.items():
        effect, _, parameter = name.partition(".")
        value = model.parameters[effect][parameter]
        new = tuple(v * factor for v in value) if isinstance(value, tuple) else value * factor
        model = model.set(effect, **{parameter: new})
    return model


def fit(args: argparse.Namespace, _: Clock) -> None:
    """Simulates the drive and fits it, by the commands that a user types; keeps the fitted model."""
    truth = save_model(hidden(make_model("luvmi_x", "flat", "consistent")), args.out / "truth.toml")
    command("log", "simulate", args.out / "drive", "--model", truth, *DRIVE)
    command("compare", args.out / "drive", "-o", args.out / "run1")
    save_model(load_model(args.out / "run1" / "fitted.toml"), FITTED)
    for row in told(load_model(FITTED)):
        say(f"{row['parameter']}: {row['fitted']:.4g} of nominal, +- {row['std']:.2g}, hidden {row['hidden']:.4g}")


def told(fitted: Model) -> list[dict[str, Any]]:
    """What the fit made of each parameter and what was hidden, as factors on the nominal value; std of logarithms."""
    assert fitted.posterior is not None
    rows, nominal = [], make_model("luvmi_x", "flat", "consistent")
    for name, std in zip(fitted.posterior.parameters, fitted.posterior.std, strict=True):
        effect, _, parameter = name.partition(".")
        values = (m.parameters[effect][parameter] for m in (nominal, fitted))
        own, new = (float(v[0] if isinstance(v, tuple) else v) for v in values)
        rows.append({"parameter": name, "fitted": new / own, "std": float(std), "hidden": TRUTH.get(name, 1.0)})
    return rows


def posterior(args: argparse.Namespace, clock: Clock) -> None:
    """Trains every arm from every seed with one of two programs, and scores last policies in the hidden soil."""
    training, fitted = training_of(args, args.training), load_model(FITTED)
    ranged = {**training.options, "randomise": SOIL_RANGES}
    uniform = Setup(training, make(training.environment, **ranged))
    nominal, place = uniform.env.model, uniform.env.place
    # the preset is the fitted model's own
    drawn = {k: v for k, v in ranged.items() if k != "preset"}
    drawn |= {"model": fitted.replace(terrain=nominal.terrain), "posterior": True}
    own = Setup(training, make(training.environment, **drawn))
    unseen = hidden(nominal)
    if ground := training.unseen.get("terrain"):
        unseen = unseen.replace(terrain=world(ground.removeprefix(PREFIX)) if ground.startswith(PREFIX) else ground)
    judge = Judge(uniform.env, args.episodes, {"policy": uniform.policies()["policy"]})
    test = place(unseen, STILL, seed=uniform.env.config.place_seed + 7919)
    compile_s = max(in_threads(lambda: uniform.compile(judge), own.compile))
    say(f"compiled in {compile_s:.0f} s, {clock.spent:.0f} s since the beginning")
    arms = {
        "posterior": (own, own.env.params),
        "uniform": (uniform, uniform.env.params),
        "nominal": (uniform, place(nominal, STILL)),
        "truth": (uniform, place(hidden(nominal), STILL)),
    }
    arms = {name: arms[name] for name in args.only or ARMS}
    about = {"training": args.training, **uniform.about, "hidden": dict(TRUTH), "fit": told(fitted)}
    about |= {"episodes": args.episodes, "compile_s": compile_s}
    rows: list[dict[str, Any]] = []
    for row in last_policies(arms, {"hidden": (judge, test)}, clock, args):
        score = row.pop("scores")["hidden"]
        rows.append({**row, "score": score})
        save(args.out, "posterior", {**about, "runs": rows, "summary": summary(rows)})
        say(f"seed {row['seed']}, {row['arm']}: {row['train_s']:.0f} s, {percent(score)}, {ends(score)}")


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over seeds with their standard errors, by arm; and of the posterior's lead over each other arm, by pairs of
    the same seed."""
    scores = pandas.DataFrame([{"arm": r["arm"], "seed": r["seed"], **r["score"]} for r in rows])
    by = {arm: of_arm.set_index("seed") for arm, of_arm in scores.groupby("arm")}
    found: dict[str, Any] = {}
    for arm in [arm for arm in ARMS if arm in by]:
        found[arm] = {k: mean(by[arm][k]) for k in ("success", "episode_return", "episode_time")}
        if arm != "posterior" and "posterior" in by:
            found[arm]["posterior_leads_by"] = mean((by["posterior"]["success"] - by[arm]["success"]).dropna())
    return found


def mean(values: pandas.Series) -> dict[str, Any]:
    """Mean, its standard error (None of one value), and how many values."""
    error = float(values.sem()) if len(values) > 1 else None
    return {"mean": float(values.mean()), "error": error, "seeds": len(values)}
