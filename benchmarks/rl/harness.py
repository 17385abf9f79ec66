"""What the parts of measure.py share: clock, files, the training that is measured, and how policies are scored."""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

FINAL, DURING = 54321, 12345
"""Seeds of the episodes of final scores, and of scores during training."""
SMALL_TASK = {"terrain": "flat", "goal_distance": (2.0, 4.0), "episode_time": 10.0, "places": 256}
SMALL_TRAINING = {
    "envs": 64,
    "batch": 256,
    "updates": 2,
    "actor_layers": (64, 64),
    "critic_layers": (64, 64),
    "atoms": 21,
    "epoch_steps": 25,
    "buffer_steps": 64,
}
"""What --tiny measures, for two CPU cores."""


class Clock:
    """Time of a part of the benchmark, s."""

    def __init__(self, seconds: float):
        self.seconds, self._begin = seconds, time.monotonic()

    @property
    def spent(self) -> float:
        return time.monotonic() - self._begin

    @property
    def left(self) -> float:
        return self.seconds - self.spent


def write(path: Path, record: Any) -> None:
    """Writes a record so that a kill never leaves half of one."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(record) + "\n", encoding="utf-8")
    part.replace(path)


def save(out: Path, name: str, record: Mapping[str, Any]) -> None:
    """Writes a part's record, with the device and versions that it was measured on."""
    import jax
    import mujoco

    from lunar_mjx.agents.train import plain

    device = {"device": jax.devices()[0].device_kind, "devices": jax.device_count()}
    about = {**device, "jax": jax.__version__, "mujoco": mujoco.__version__}
    write(out / f"{name}.json", plain({"about": about, **record}))


def digits(value: Any) -> Any:
    """A record's numbers with five digits, which is more than one seed tells."""
    if isinstance(value, dict):
        return {k: digits(v) for k, v in value.items()}
    if isinstance(value, list):
        return [digits(v) for v in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def say(text: str) -> None:
    print(text, flush=True)


def percent(score: Mapping[str, Any]) -> str:
    """A success rate with its 95 % interval."""
    return f"{100 * score['success']:.1f} % ({100 * score['low']:.1f} to {100 * score['high']:.1f})"


def in_threads(*calls: Callable[[], Any]) -> list[float]:
    """Calls side by side, since XLA lets go of the interpreter while it compiles; s after which each was done."""
    begin = time.monotonic()

    def timed(call: Callable[[], Any]) -> float:
        call()
        return time.monotonic() - begin

    with ThreadPoolExecutor() as pool:
        return [w.result() for w in [pool.submit(timed, call) for call in calls]]


def training_of(args: argparse.Namespace) -> Any:
    """The training `large-td3` with the settings of the command line."""
    from lunar_mjx.agents.configs import get_training, override
    from lunar_mjx.commands.train import env_options, pairs

    training = get_training("large-td3")
    options = {**training.options, "rover": args.rover, **(SMALL_TASK if args.tiny else {}), **env_options(args.env)}
    unseen = {**training.unseen, **({"terrain": "flat"} if args.tiny else {})}
    if args.unseen_terrain:
        unseen["terrain"] = args.unseen_terrain
    training = override(training, **{**(SMALL_TRAINING if args.tiny else {}), **pairs("--set", args.set)})
    return dataclasses.replace(training, options=options, unseen=unseen)


def about_training(training: Any) -> dict[str, Any]:
    """What a record says of a training."""
    from lunar_mjx.agents.train import plain

    environment = {"name": training.environment, "options": plain(dict(training.options)), "unseen": training.unseen}
    return {"environment": environment, "train": dataclasses.asdict(training.train)}


def episodes_of(args: argparse.Namespace) -> int:
    """Episodes of a score."""
    return 32 if args.tiny else 1024


def compile_judge(judge: Any, learner: Any, params: Any, wrap: Callable[[Any], Any] = lambda policy: policy) -> None:
    """Compiles an `Evaluator` for the policies of a learner; `wrap` makes its argument of a policy."""
    import jax

    policy = learner.policy(learner.abstract())
    shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), policy)
    with jax.default_matmul_precision(learner.config.precision):
        judge.compile(params, wrap(shapes))
