"""Parts of measure.py that hold trainings under several conditions, arms, against each other: `realism`, `posterior`
with its `fit`, and `paper`.

    python benchmarks/rl/measure.py realism --out runs/realism               # one GPU
    python benchmarks/rl/measure.py fit --out runs/fit                       # 4 minutes of CPU: posterior.toml
    python benchmarks/rl/measure.py posterior --seconds 400 --out runs/posterior     # one GPU: the trainings
    python benchmarks/rl/measure.py posterior short --steps 48000 --episodes 256 --out runs/short      # two CPU cores
    python benchmarks/rl/measure.py paper --only steady --seconds 900 --out runs/paper      # a core a run

`realism` trains in the whole model, and in one without heat (no temperatures, no cut-off, motor constants that do not
drift) and without soil (hard ground with Coulomb friction everywhere). Every last policy is scored in both, on unseen
ground and goals; in the whole one with the held-out soil and motors.

`fit` hides a soil and motors, `TRUTH`, behind a simulated drive with a data sheet's noise, on level ground, one axle
faster than the other. `lunar-mjx compare` fits the nominal model to it. `posterior` trains for as many steps each: on
that fit's posterior; on uniform ranges about the nominal model, in which the hidden soil lies; on the nominal model
alone; and, with `--only truth`, on the hidden soil itself. All last policies are scored on the same episodes in the
hidden soil, on unseen ground. Seeds go round, so that a run that is cut off has all arms.

`paper` trains on the paper's own task with one rover per run, each in a process on a core of its own.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import multiprocessing
import os
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import harness
import pandas
from harness import EXPERIMENTS, KEPT, Clock, Setup, in_time, save, say, show, training_of

from lunar_mjx.agents import FINAL_SEED, UNSEEN_PLACES
from lunar_mjx.agents.configs import override
from lunar_mjx.agents.evaluate import Judge
from lunar_mjx.agents.train import RunConfig
from lunar_mjx.envs import NavigationEnv, make
from lunar_mjx.envs.navigation.config import SOIL_RANGES
from lunar_mjx.envs.navigation.worlds import PREFIX, world
from lunar_mjx.model import Model, make_model
from lunar_mjx.model.file import load_model, save_model

THERMAL: Sequence[str] = EXPERIMENTS["realism"]["thermal"]
"""Effects that the plainer model lacks."""
TRUTH: Mapping[str, float] = EXPERIMENTS["fit"]["truth"]
"""Factors on the nominal model's values: weak ground, within every range of `SOIL_RANGES`."""
STILL = tuple(dataclasses.replace(r, low=1.0, high=1.0) if r.relative else r for r in SOIL_RANGES)
"""The ranges with all factors at one; motors begin cold or warm all the same: no log tells that of another day."""
FITTED = KEPT / "posterior.toml"
"""What `fit` writes and the trainings read."""
VARIANTS: dict[str, dict[str, Any]] = tomllib.loads((KEPT / "paper_variants.toml").read_text(encoding="utf-8"))
MAIN = "signed"
"""Of the variants of the paper's task, the one that its record begins with."""
JUDGED_EVERY, JUDGED, JUDGED_SEED = 2500, 24, 99
"""Steps between scores of the policy without noise, their episodes, and the seed of these."""


def last_policies(
    arms: Mapping[str, tuple[Setup, Any]],
    tests: Mapping[str, tuple[Judge, Any]],
    clock: Clock,
    args: argparse.Namespace,
) -> Iterator[dict[str, Any]]:
    """Trains every arm from every seed, one after another while there is time, and scores last policies in every test.

    Args:
      arms: a compiled setup, and the parameters of the environment to train on, of the shapes of the setup's own;
        those of `args.only` where that is told.
      tests: a judge, and the parameters that it scores on.

    Yields:
      A row with the arm, seed, steps, s, return in training, and scores by test.
    """
    names = [name for name in arms if args.only is None or name in args.only]
    for seed, name in in_time(clock, [(seed, name) for seed in args.seeds for name in names]):
        setup, params = arms[name]
        setup.env.params = params
        result = setup.train(RunConfig(int(args.steps), seed, None, math.inf, quiet=True))
        policy, last = setup.policy(result.state), result.rows[-1]
        scores = {test: judge(where, policy, FINAL_SEED)["policy"] for test, (judge, where) in tests.items()}
        say(f"seed {seed}, trained {name}, {last['elapsed_s']:.0f} s; tested")
        show(scores)
        about = {"seed": seed, "arm": name, "steps": last["steps"], "train_s": last["elapsed_s"]}
        yield {**about, "episode_return": last.get("episode_return"), "scores": scores}


def plainer(model: Any) -> Any:
    """The model without its thermal effects, and with hard ground wherever there was soil."""
    for name in set(THERMAL) & set(model.effect_names):
        model = model.remove(name)
    return model.set("motor", alpha=0.0, beta=0.0).add("hard_surface")


def realism(args: argparse.Namespace, clock: Clock) -> None:
    """Trains with and without the effects, seed after seed while time is left."""
    training = training_of(args, args.training)
    whole = Setup(training)
    setups = {"without": Setup(training, NavigationEnv(plainer(whole.env.model), whole.env.config)), "with": whole}
    judges = {n: s.judge(args.episodes) for n, s in setups.items()}
    harness.in_threads(*(lambda n=n, s=s: s.compile(judges[n]) for n, s in setups.items()))
    say(f"realism: compiled after {clock.spent:.0f} s")
    effects = {n: s.env.model.effect_names for n, s in setups.items()}
    record = {"rover": args.rover, **whole.about, "effects": effects, "steps": int(args.steps), "seeds": []}
    arms = {n: (s, s.env.params) for n, s in setups.items()}
    for row in last_policies(arms, {n: (judge, setups[n].unseen) for n, judge in judges.items()}, clock, args):
        record["seeds"].append({"trained": row.pop("arm"), **row})
        save(args.out, "realism", record)


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
    for line in EXPERIMENTS["fit"]["first"]:
        harness.command(*line.format(truth=truth, out=args.out).split())
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
    unseen, judge = hidden(nominal), uniform.judge(args.episodes)
    if ground := training.unseen.get("terrain"):
        unseen = unseen.replace(terrain=world(ground.removeprefix(PREFIX)) if ground.startswith(PREFIX) else ground)
    test = place(unseen, STILL, seed=uniform.env.config.place_seed + UNSEEN_PLACES)
    compile_s = max(harness.in_threads(lambda: uniform.compile(judge), own.compile))
    say(f"compiled in {compile_s:.0f} s, {clock.spent:.0f} s since the beginning")
    arms = {
        "posterior": (own, own.env.params),
        "uniform": (uniform, uniform.env.params),
        "nominal": (uniform, place(nominal, STILL)),
        "truth": (uniform, place(hidden(nominal), STILL)),
    }
    about = {"training": args.training, **uniform.about, "hidden": dict(TRUTH), "fit": told(fitted)}
    about |= {"episodes": args.episodes, "compile_s": compile_s}
    rows: list[dict[str, Any]] = []
    for row in last_policies(arms, {"hidden": (judge, test)}, clock, args):
        rows.append({**row, "score": row.pop("scores")["hidden"]})
        save(args.out, "posterior", {**about, "runs": rows, "summary": summary(rows)})


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over seeds with their standard errors, by arm; and of the posterior's lead over each other arm, by pairs of
    the same seed."""
    scores = pandas.DataFrame([{"arm": r["arm"], "seed": r["seed"], **r["score"]} for r in rows])
    by = {arm: of_arm.set_index("seed") for arm, of_arm in scores.groupby("arm", sort=False)}
    found: dict[str, Any] = {}
    for arm, own in by.items():
        found[arm] = {k: mean(own[k]) for k in ("success", "episode_return", "episode_time")}
        if arm != "posterior" and "posterior" in by:
            found[arm]["posterior_leads_by"] = mean((by["posterior"]["success"] - own["success"]).dropna())
    return found


def mean(values: pandas.Series) -> dict[str, Any]:
    """Mean, its standard error (None of one value), and how many values."""
    error = float(values.sem()) if len(values) > 1 else None
    return {"mean": float(values.mean()), "error": error, "seeds": len(values)}


def run(args: argparse.Namespace, core: int, variant: str, name: str, seed: int, seconds: float) -> dict[str, Any]:
    """One training on the paper's task, on a core: its settings, every episode, and the successes of its policy without
    noise."""
    harness.alone_on(core)
    clock = Clock(seconds)
    training = override(training_of(args, name), epoch_steps=250, **VARIANTS[variant].get("settings", {}))
    setup = Setup(dataclasses.replace(training, options={**training.options, **VARIANTS[variant]["options"]}))
    judge = setup.judge(JUDGED)
    quiet: dict[str, list[float]] = {"step": [], "success": []}

    def after_epoch(_: Any, state: Any, row: dict[str, Any]) -> dict[str, Any]:
        if row["steps"] % JUDGED_EVERY == 0:
            quiet["step"].append(row["steps"])
            quiet["success"].append(judge(setup.env.params, setup.policy(state), JUDGED_SEED)["policy"]["success"])
        return {"stop": clock.left < 0.0}

    result = setup.train(RunConfig(int(args.steps or training.steps), seed, quiet=True), after_epoch)
    episodes = {k: result.episodes[k] for k in ("episode_return", "success")}
    taken = {"steps": result.rows[-1]["steps"], "elapsed_s": clock.spent}
    return {"train": setup.about["train"], "run": {"seed": seed, **taken, "episodes": episodes, "without_noise": quiet}}


def paper(args: argparse.Namespace, clock: Clock) -> None:
    """Trains every variant, algorithm and seed in a process of its own; leaves those that take too long."""
    jobs = [
        (variant, name, seed)
        for variant in args.only
        for seed in range(VARIANTS[variant]["seeds"])
        for name in VARIANTS[variant].get("algorithms", ("paper-td3", "paper-ddpg"))
    ]
    cores = sorted(os.sched_getaffinity(0))
    jobs = jobs[: max(2, len(cores))]
    say(f"paper: {len(jobs)} runs of {clock.left:.0f} s on CPU cores")
    settings: dict[str, Any] = {}
    told = {v: {k: VARIANTS[v].get(k, {}) for k in ("options", "settings")} | {"runs": {}} for v in (MAIN, *args.only)}
    # compiling, before which a run looks at no clock, has a minute more
    deadline = time.monotonic() + clock.left + 60.0
    with multiprocessing.get_context("spawn").Pool(len(jobs), maxtasksperchild=1) as pool:
        words = [(args, cores[i % len(cores)], *job, clock.left) for i, job in enumerate(jobs)]
        for (variant, name, seed), promise in zip(jobs, [pool.apply_async(run, w) for w in words], strict=True):
            try:
                one = promise.get(max(0.1, deadline - time.monotonic()))
            except Exception as error:  # whatever ended it, the others count
                say(f"paper: {variant}, {name}, seed {seed} left nothing: {type(error).__name__} {error}")
                continue
            if variant == MAIN:
                settings[name] = one["train"]
            told[variant]["runs"].setdefault(name, []).append(one["run"])
    main, others = told.pop(MAIN), {variant: found for variant, found in told.items() if found["runs"]}
    save(args.out, "paper", {"variant": MAIN, **main, "train": settings, "others": others})
