"""Training on what a log left open, beside wide ranges and the nominal soil, scored on a soil that none was told.

    python benchmarks/rl/posterior.py --fit                                  # 4 minutes of CPU: posterior.toml
    python benchmarks/rl/posterior.py --out runs/posterior --seconds 400     # one GPU: the trainings
    python benchmarks/rl/posterior.py short --steps 48000 --episodes 256 --out runs/short      # two CPU cores
    python benchmarks/rl/posterior.py --tiny --seconds 300 --out runs/tiny   # the same code, to see that it runs

`--fit` hides a soil and motors, `TRUTH`, behind a simulated drive with a data sheet's noise, on level ground, one axle
faster than the other. `lunar-mjx compare` fits the nominal model to it. Policies are then trained for as many steps
each: on that fit's posterior; on uniform ranges about the nominal model, in which the hidden soil lies; on the nominal
model alone; and, for the room that is left, on the hidden soil itself. All last policies are scored on the same
episodes in the hidden soil, on unseen ground. Seeds go round, so that a run that is cut off has all arms.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import harness
from harness import (
    FINAL,
    KEPT,
    Clock,
    Judge,
    Setup,
    ends,
    in_threads,
    in_time,
    options,
    percent,
    save,
    say,
    training_of,
)

from benchmarks.provenance import tree
from lunar_mjx.agents.train import RunConfig
from lunar_mjx.envs import make
from lunar_mjx.envs.navigation.config import SOIL_RANGES
from lunar_mjx.envs.navigation.randomise import Range
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
FITTED = KEPT / "posterior.toml"
"""What `--fit` writes and the trainings read."""
DRIVE = ("--manoeuvre", "slip_sweep", "--seconds", "20", "--noise", "datasheet", "--seed", "1")
"""The log: one axle runs faster than the other."""
ARMS = ("posterior", "uniform", "nominal", "truth")


def words() -> argparse.Namespace:
    """The command line."""
    parser = options(__doc__, Path("runs/posterior"))
    parser.set_defaults(seconds=math.inf)
    add = parser.add_argument
    add("training", nargs="?", default="large-td3", help="a shipped training, or a file like it")
    add("--fit", action="store_true", help="make the log and fit it; train nothing")
    add("--fitted", type=Path, default=FITTED, help="model.toml with [posterior]")
    add("--steps", type=float, default=6e6, help="of the environment, of each training")
    add("--episodes", type=int, default=1024, help="of each score")
    add("--seeds", type=int, nargs="+", default=[0, 1, 2, 3], help="one after another, as many as there is time for")
    add("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    args = parser.parse_args()
    if args.tiny:
        args.steps, args.episodes, args.seeds = min(args.steps, 3200), min(args.episodes, 8), args.seeds[:1]
    return args


def hidden(model: Model) -> Model:
    """A model with the hidden soil and motors."""
    for name, factor in TRUTH.items():
        effect, _, parameter = name.partition(".")
        value = model.parameters[effect][parameter]
        new = tuple(v * factor for v in value) if isinstance(value, tuple) else value * factor
        model = model.set(effect, **{parameter: new})
    return model


def fit(out: Path) -> None:
    """Simulates the drive and fits it, by the commands that a user types; keeps the fitted model."""
    out.mkdir(parents=True, exist_ok=True)
    truth = save_model(hidden(make_model("luvmi_x", "flat", "consistent")), out / "truth.toml")
    command = [sys.executable, "-m", "lunar_mjx.cli"]
    subprocess.run([*command, "log", "simulate", out / "drive", "--model", truth, *DRIVE], check=True)
    subprocess.run([*command, "compare", out / "drive", "-o", out / "run1"], check=True)
    save_model(load_model(out / "run1" / "fitted.toml"), FITTED)
    for row in told(load_model(FITTED)):
        say(f"{row['parameter']}: {row['fitted']:.4g} of nominal, +- {row['std']:.2g}, hidden {row['hidden']:.4g}")


def told(fitted: Model) -> list[dict[str, Any]]:
    """What the fit made of each parameter and what was hidden, as factors on the nominal value; std of logarithms."""
    assert fitted.posterior is not None
    rows, nominal = [], make_model("luvmi_x", "flat", "consistent")
    for name, std in zip(fitted.posterior.parameters, fitted.posterior.std, strict=True):
        effect, _, parameter = name.partition(".")
        own, new = (_first(m.parameters[effect][parameter]) for m in (nominal, fitted))
        rows.append({"parameter": name, "fitted": new / own, "std": float(std), "hidden": TRUTH.get(name, 1.0)})
    return rows


def _first(value: Any) -> float:
    return float(value[0] if isinstance(value, tuple) else value)


def still(ranges: Sequence[Range]) -> tuple[Range, ...]:
    """The ranges with all factors at one."""
    return tuple(dataclasses.replace(r, low=1.0, high=1.0) if r.relative else r for r in ranges)


class Arms:
    """Two programs, one that draws from ranges and one from a posterior, and what each arm is trained on.

    Args:
      args: the command line.
    """

    def __init__(self, args: argparse.Namespace):
        training = training_of(args, args.training)
        # Motors begin cold or warm in every arm: no log tells that of another day.
        ranged = {**training.options, "randomise": SOIL_RANGES}
        ranges_env: Any = make(training.environment, **ranged)
        nominal = ranges_env.model
        fitted = load_model(args.fitted).replace(terrain=nominal.terrain)
        drawn = {**ranged, "model": fitted, "posterior": True}
        del drawn["preset"]  # the fitted model's own
        self.ranges, self.posterior = Setup(training, ranges_env), Setup(training, make(training.environment, **drawn))
        place = ranges_env.place
        self.of = {
            "posterior": (self.posterior, self.posterior.env.params),
            "uniform": (self.ranges, ranges_env.params),
            "nominal": (self.ranges, place(nominal, still(SOIL_RANGES))),
            "truth": (self.ranges, place(hidden(nominal), still(SOIL_RANGES))),
        }
        ground = training.unseen.get("terrain")
        unseen = hidden(nominal)
        if ground is not None:
            unseen = unseen.replace(terrain=world(ground.removeprefix(PREFIX)) if ground.startswith(PREFIX) else ground)
        self.scored_in = place(unseen, still(SOIL_RANGES), seed=ranges_env.config.place_seed + 7919)
        self.judge = Judge(ranges_env, args.episodes, {"policy": self.ranges.policies()["policy"]})
        self.fitted = fitted

    def compile(self) -> float:
        """Compiles both programs side by side; s until both were done."""
        return max(in_threads(lambda: self.ranges.compile(self.judge), self.posterior.compile))

    def __call__(self, arm: str, seed: int, steps: int) -> dict[str, Any]:
        """Trains an arm from a seed, and scores its last policy in the hidden soil."""
        setup, params = self.of[arm]
        setup.env.params = params  # what the trainer takes; of the same shapes, so that nothing is compiled anew
        run = RunConfig(steps, seed, None, math.inf, quiet=True)
        _, policy, last = harness.trained(setup, run, math.inf, lambda *_: 0.0)
        score = self.judge(self.scored_in, policy, FINAL)["policy"]
        return {"arm": arm, "seed": seed, "steps": last["steps"], "train_s": last["elapsed_s"], "score": score}


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over seeds with their standard errors, by arm; and of the posterior's lead over each other arm, by pairs of
    the same seed."""
    by = {arm: {r["seed"]: r["score"] for r in rows if r["arm"] == arm} for arm in ARMS}
    found: dict[str, Any] = {}
    for arm, scores in by.items():
        if not scores:
            continue
        found[arm] = {k: mean([s[k] for s in scores.values()]) for k in ("success", "episode_return", "episode_time")}
        pairs = [seed for seed in scores if seed in by["posterior"]]
        if arm != "posterior" and pairs:
            lead = [by["posterior"][seed]["success"] - scores[seed]["success"] for seed in pairs]
            found[arm]["posterior_leads_by"] = mean(lead)
    return found


def mean(values: Sequence[float]) -> dict[str, Any]:
    """Mean, its standard error (None of one value), and how many values."""
    error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None
    return {"mean": statistics.fmean(values), "error": error, "seeds": len(values)}


def main() -> None:
    """Fits, or trains, scores and writes."""
    args = words()
    if args.fit:
        fit(args.out)
        return
    clock, files = Clock(args.seconds), tree()
    args.out.mkdir(parents=True, exist_ok=True)
    arms = Arms(args)
    compile_s = arms.compile()
    say(f"compiled in {compile_s:.0f} s, {clock.spent:.0f} s since the beginning")
    about = {"tree": files, "training": args.training, **arms.ranges.about, "hidden": dict(TRUTH)}
    about |= {"fit": told(arms.fitted), "episodes": args.episodes, "compile_s": compile_s}
    rows: list[dict[str, Any]] = []
    # What is compared comes first, the room that is left last.
    last = [arm for arm in args.arms if arm == "truth"]
    asked = [arm for arm in args.arms if arm != "truth"]
    jobs = [f"{seed}/{arm}" for part in (asked, last) for seed in args.seeds for arm in part]
    for job in in_time(clock, jobs):
        seed, _, arm = job.partition("/")
        rows.append(arms(arm, int(seed), int(args.steps)))
        save(args.out, "posterior", {**about, "runs": rows, "summary": summary(rows)})
        row = rows[-1]
        say(
            f"seed {seed}, {arm}: {row['train_s']:.0f} s, {row['steps']:,} steps: {percent(row['score'])}, "
            f"return {row['score']['episode_return']:.0f}, {ends(row['score'])}"
        )


if __name__ == "__main__":
    main()
