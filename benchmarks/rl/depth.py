"""Rate of an environment with depth pictures, and a student distilled in it, scored beside its teacher.

    python benchmarks/rl/depth.py large-depth --seconds 420 --out runs/depth        # one GPU
    python benchmarks/rl/depth.py large-depth --tiny --seconds 200 --out runs/tiny  # the same code on two CPU cores
    python benchmarks/rl/depth.py --keep runs/depth/large-depth.json              # to the records that pages quote

Writes `NAME.json` and, after every score, `NAME_seedN.npz`, so that a run that is cut off leaves what it had. The rate
is of the environment alone under random actions, with as many rovers as the training has: median, least and most of
several repetitions, each from where the one before ended. Rows of a score, all on the same unseen episodes in one
program: the student, the student with its picture at the mean (`blanked`), its teacher, and straight ahead. The last
policy is scored at the end, on other episodes than during the training; nothing is chosen by a score.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import time
from pathlib import Path
from typing import Any

import jax
from harness import (
    COMMIT,
    DURING,
    FINAL,
    Clock,
    Judge,
    Setup,
    ends,
    in_threads,
    options,
    percent,
    read,
    save,
    say,
    training_of,
    when,
)
from kept import few, keep
from rates import Driven

from benchmarks.provenance import tree
from lunar_mjx.agents.policy import policy_of, save_policy
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import make_agent
from lunar_mjx.envs.navigation.observations import CAMERA

TINY = {"camera_width": 16, "camera_height": 12}
"""Beside the small task of `harness`."""


def words() -> argparse.Namespace:
    """The command line."""
    parser = options(__doc__, Path("runs/depth"))
    parser.set_defaults(seconds=420.0)
    add = parser.add_argument
    add("training", nargs="?", default="large-depth", help="a shipped distillation, or a file like it")
    add("--seed", type=int, default=0)
    add("--steps", type=float, help="of the environment; the training's own unless told")
    add("--every", type=float, default=60.0, help="s of training between scores")
    add("--episodes", type=int, default=256, help="of each row")
    add("--last", type=float, default=30.0, help="s of all that are kept for the last score")
    add("--repeats", type=int, default=9, help="of the rate")
    add("--keep", type=Path, metavar="JSON", help="train nothing; this record is kept")
    return parser.parse_args()


def agents(setup: Setup) -> dict[str, Any]:
    """The student, the student that sees no picture, and its teacher, as a judge takes them."""
    pictures = tuple(name for name in setup.env.blocks if name.startswith(CAMERA))
    student, blanked = setup.policies(pictures).values()
    teacher = setup.learner.agent.teacher
    return {"student": student, "blanked": blanked, "teacher": lambda _, state, key: teacher.act(state.privileged)}


def rate_of(driven: Driven, state: Any, repeats: int) -> dict[str, Any]:
    """Rates of repetitions after a first one; `state`, of all rovers, is used up."""
    state, taken, ended = driven.staggered(state), [], []
    for i in range(repeats + 1):
        begin = time.monotonic()
        state, count = jax.block_until_ready(driven(driven.env.params, state, jax.random.PRNGKey(i)))
        taken.append(time.monotonic() - begin)
        ended.append(int(count))
    rates, c = [driven.size * driven.steps / s for s in taken[1:]], driven.env.config
    about = {"rovers": driven.size, "steps": driven.steps, "picture": [c.camera_width, c.camera_height]}
    found = {"env_steps_per_s": statistics.median(rates), "least": min(rates), "most": max(rates)}
    return {**about, **found, "seconds": taken[1:], "resets_per_step": sum(ended[1:]) / (repeats * driven.steps)}


def main() -> None:
    """Compiles all programs side by side, measures the rate, trains in time and scores; or keeps a record."""
    args = words()
    if args.keep:
        record = read(args.keep)
        say(str(keep(record["training"], {**record, "epochs": few(record["epochs"])})))
        return
    clock, files = Clock(args.seconds), tree()
    training = training_of(args, args.training)
    if args.tiny:
        training = dataclasses.replace(training, options={**training.options, **TINY})
    name, steps = Path(args.training).stem, int(args.steps or training.steps)
    args.out.mkdir(parents=True, exist_ok=True)
    setup = Setup(training)
    rules = {"straight": make_agent("scripted", setup.env)}
    judge = Judge(setup.env, min(args.episodes, 2) if args.tiny else args.episodes, agents(setup), rules)
    driven = Driven(setup.env, training.train.envs, 4 if args.tiny else 50)
    made_s = clock.spent
    in_threads(lambda: setup.compile(judge), driven.compile)
    record: dict[str, Any] = {"tree": files, "training": name, **setup.about, "seed": args.seed}
    record |= {"made_s": made_s, "compile_s": clock.spent - made_s, "scores": []}
    say(f"made in {made_s:.0f} s, compiled in {record['compile_s']:.0f} s, {clock.left:.0f} s left")
    # One device of several: the rate is of one, and a state over a mesh is none that the program was compiled for.
    state = jax.device_put(jax.device_get(setup.learner.init(args.seed).env))
    record["rate"] = rate_of(driven, state, 2 if args.tiny else args.repeats)
    del state
    r = record["rate"]
    say(
        f"{r['env_steps_per_s']:,.0f} environment steps/s ({r['least']:,.0f} to {r['most']:,.0f}), {r['rovers']} rovers"
    )
    save(args.out, name, record)
    due = args.every

    def score(state: Any, row: dict[str, Any], seed: int) -> dict[str, Any]:
        rows = judge(setup.unseen, setup.policy(state), seed)
        notes = {"score": rows["student"], "seed": args.seed, "commit": COMMIT, "tree": files, **when(row)}
        save_policy(policy_of(setup.learner, state, setup.environment, notes), args.out / f"{name}_seed{args.seed}.npz")
        told = {**when(row), "seed": seed, "imitation_loss": row["imitation_loss"], "rows": rows}
        say(f"{row['steps']:.3g} steps, {row['elapsed_s']:.0f} s, loss {row['imitation_loss']:.4f}")
        for agent, one in rows.items():
            say(f"    {agent}: {percent(one)}, {ends(one)}")
        return told

    epochs: list[dict[str, Any]] = []

    def after_epoch(_: Any, state: Any, row: dict[str, Any]) -> dict[str, Any]:
        nonlocal due
        epochs.append({k: v for k, v in row.items() if not k.startswith("reward_")})
        if row["elapsed_s"] >= due:
            due = row["elapsed_s"] + args.every
            record["scores"].append(score(state, row, DURING))
            save(args.out, name, {**record, "epochs": epochs})
        return {}

    run = RunConfig(steps, args.seed, max(1.0, clock.left - args.last), math.inf, quiet=True)
    result = train(setup.learner, run, None, setup.environment, after_epoch)
    say("at the end:")
    record["final"] = score(result.state, result.rows[-1], FINAL)
    record["train_steps_per_s"] = statistics.median(row["steps_per_s"] for row in epochs)
    save(args.out, name, {**record, "epochs": epochs})
    say(f"done after {clock.spent:.0f} s; while training {record['train_steps_per_s']:,.0f} environment steps/s")


if __name__ == "__main__":
    main()
