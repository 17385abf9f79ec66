"""Rate of an environment with depth pictures, and a student distilled in it, scored beside its teacher.

    python benchmarks/rl/depth.py large-depth --seconds 420 --out runs/depth        # one GPU
    python benchmarks/rl/depth.py large-depth --tiny --seconds 200 --out runs/tiny  # the same code on two CPU cores
    python benchmarks/rl/depth.py --keep runs/depth/large-depth.json              # to the records that pages quote

Writes `NAME.json` and, after every score, `NAME_seedN.npz` (the last policy), so that a run that is cut off leaves what
it had. The rate is of the environment alone under random actions, with as many rovers as the training has: median,
least and most of several repetitions, each from where the one before ended. Rows of a score, all on the same unseen
episodes in one program: the student, the student with its picture at the mean (`blanked`), its teacher, and straight
ahead. The last policy is scored at the end, on other episodes than during the training; nothing is chosen by a score.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import time
from pathlib import Path
from typing import Any

import jax
from harness import Clock, Setup, options, read, say, training_of
from kept import few, keep
from rates import Driven
from trials import Trials

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
        (run,) = record.pop("seeds")
        took = {"made_s": record.pop("worlds_s"), "compile_s": max(record["compile_s"])}
        say(str(keep(record["training"], {**record, **took, **run, "epochs": few(run["epochs"])})))
        return
    clock, training = Clock(args.seconds), training_of(args, args.training)
    if args.tiny:
        training = dataclasses.replace(training, options={**training.options, **TINY})
    episodes, driven = min(args.episodes, 2) if args.tiny else args.episodes, []

    def beside(setup: Setup) -> None:
        driven.append(Driven(setup.env, training.train.envs, 4 if args.tiny else 50))
        driven[0].compile()

    def rules(env: Any) -> dict[str, Any]:
        return {"straight": make_agent("scripted", env)}

    name = Path(args.training).stem
    trials = Trials(training, name, args.out, clock, episodes, rules, agents=agents, last=True, beside=beside)
    # One device of several: the rate is of one, and a state over a mesh is none that the program was compiled for.
    state = jax.device_put(jax.device_get(trials.setup.learner.init(args.seed).env))
    trials.record["rate"] = r = rate_of(driven[0], state, 2 if args.tiny else args.repeats)
    del state
    say(
        f"{r['env_steps_per_s']:,.0f} environment steps/s ({r['least']:,.0f} to {r['most']:,.0f}), {r['rovers']} rovers"
    )
    trials(args.seed, int(args.steps or training.steps), max(1.0, clock.left - args.last), args.every)
    (run,) = trials.record["seeds"]
    trials.record["train_steps_per_s"] = statistics.median(row["steps_per_s"] for row in run["epochs"])
    trials.save()


if __name__ == "__main__":
    main()
