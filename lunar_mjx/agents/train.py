"""The loop around the epochs: progress, records, checkpoints, guard, time limit, and the policy at the end."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import jax
import numpy as np

from lunar_mjx.agents import guard
from lunar_mjx.agents.from_brax.begin import begin_with
from lunar_mjx.agents.learner import EPISODE, Learner, TrainState
from lunar_mjx.agents.policy import Policy, policy_of, save_policy
from lunar_mjx.agents.record import Progress, Record
from lunar_mjx.envs.navigation.env import NavigationEnv
from lunar_mjx.errors import bad_input
from lunar_mjx.files import only_writer
from lunar_mjx.together import agreed, everywhere, leads, of_the_first

if TYPE_CHECKING:
    from lunar_mjx.agents.checkpoint import Checkpoints

LOCK = ".training"
"""File in a training's folder that is locked while it is written to."""


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """How long a training runs and what it leaves behind.

    Attributes:
      steps: environment steps, over all environments.
      seed: of everything random.
      time_limit: s of wall time of this process after which it saves and stops, to be resumed; none if None.
      checkpoint_every: s between checkpoints; also one at the end; none at all if infinite.
      resume: go on from the folder's newest checkpoint, if it has one.
      quiet: print no progress.
      begin_with: path of a policy, or name of one that ships, that the training begins with; see
        `lunar_mjx.agents.from_brax.begin`.
    """

    steps: int
    seed: int = 0
    time_limit: float | None = None
    checkpoint_every: float = 300.0
    resume: bool = True
    quiet: bool = False
    begin_with: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Result:
    """What a training came to.

    Attributes:
      learner, state: from which more can be read.
      policy: the trained policy.
      rows: numbers of every epoch; `elapsed_s` in them counts compilation but not the callback.
      episodes: return, length, success and step of every episode, where recorded.
      finished: False if the time limit came first.
    """

    learner: Learner
    state: TrainState
    policy: Policy
    rows: list[dict[str, Any]]
    episodes: dict[str, list[float]]
    finished: bool


Callback = Callable[[Learner, TrainState, dict[str, Any]], dict[str, Any] | None]
"""Called after every epoch with the row of numbers; may return more numbers for it, among them `stop` to end there."""


def train(
    learner: Learner,
    run: RunConfig,
    folder: Path | None = None,
    environment: dict[str, Any] | None = None,
    callback: Callback | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Result:
    """Trains until the steps are done or the time is up.

    Args:
      learner: environment, algorithm and devices.
      run: how long.
      folder: for checkpoints, `progress.csv`, TensorBoard events and `policy.npz`; nothing is written if None.
      environment: name and options of the environment, kept in the policy.
      callback: called after every epoch; with several processes in each of them, with the first one's `elapsed_s`.
      clock: s, monotonic; with several processes the first one's counts.

    Raises:
      DivergenceError: a value was not finite; the sentence names the environment and the file for replay.
      UserError: the folder's checkpoint belongs to other settings, another training writes there, or a checkpoint
        cannot be written.
    """
    loop = _Loop(learner, run, folder, environment or {}, clock)
    try:
        return loop.run(callback)
    finally:
        loop.close()


class _Loop:
    def __init__(
        self,
        learner: Learner,
        run: RunConfig,
        folder: Path | None,
        environment: dict[str, Any],
        clock: Callable[[], float],
    ):
        self.learner, self.config, self.folder, self.environment = learner, run, folder, environment
        self.per_epoch = learner.config.envs * learner.config.epoch_steps
        self.lead = leads()
        self.clock = clock
        self.lock: IO[str] | None = None
        self.checkpoints: Checkpoints | None = None
        self.record: Record | None = None
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def _begin(self) -> None:
        learner, run, folder = self.learner, self.config, self.folder
        with agreed("opening its folder"):
            self.lock = only_writer(folder, LOCK, "training") if folder and self.lead else None
        made = {"train": dataclasses.asdict(learner.config), "seed": run.seed, "environment": self.environment}
        settings = plain(made | ({"begin_with": run.begin_with} if run.begin_with else {}))
        self.checkpoints = _checkpoints(folder / "checkpoints", settings) if folder else None
        self.episodes: dict[str, list[float]] = {name: [] for name in (*EPISODE, "step")}
        self.epochs, self.elapsed, rows = 0, 0.0, []
        restored = None
        if self.checkpoints and run.resume:
            restored = self.checkpoints.newest(learner.abstract())
        elif self.checkpoints:
            # Else the newest of the old training would be resumed by the next command.
            self.checkpoints.clear()
        self._renewing(None if restored is None else restored[1].get("renewal"))
        if restored is not None:
            self.state, notes = restored
            self.epochs, self.elapsed, rows = notes["epochs"], notes["elapsed"], notes["rows"]
            self.episodes = notes["episodes"]
        else:
            self.state = learner.init(run.seed)
            if run.begin_with:
                self.state = begin_with(learner, self.state, run.begin_with)
        with agreed("beginning its records"):
            self.record = Record(folder, rows) if folder and self.lead else None
        self.rows: list[dict[str, Any]] = self.record.rows if self.record else list(rows)
        self.progress = Progress(run.steps, run.time_limit, run.quiet or not self.lead)

    def _renewing(self, notes: dict[str, Any] | None) -> None:
        """Begins to renew the ladder's worlds where the task says so; goes on from a checkpoint's notes."""
        env: Any = self.learner.env
        self.renewal = env.renewal() if isinstance(env, NavigationEnv) else None
        if self.renewal is None:
            return
        if jax.process_count() > 1:
            raise bad_input("train", "renew", True, "is not for several processes", "leave it out")
        pool = None
        if notes is not None:
            pool = self.renewal.restore(env.pool(env.config.place_seed), notes)
        elif int(env.params.begins[-1]) < len(env.params.begins):
            # an earlier training has left others
            pool = env.pool(env.config.place_seed)
        env.params = env.on_renewed(self.renewal, env.params, pool)

    def run(self, callback: Callback | None) -> Result:
        c, total = self.config, max(1, math.ceil(self.config.steps / self.per_epoch))
        begin = saved = self.clock()
        # Time of callbacks is taken off: evaluations shall not shorten a training by time.
        before, stop, outside = self.elapsed, False, 0.0
        while self.epochs < total and not stop:
            tick = self.clock()
            row = self._epoch()
            tock = self.clock()
            # a process that is a moment behind must neither stop nor save alone: the others would wait for it for ever
            self.elapsed, rate = (
                float(v) for v in of_the_first(before + tock - begin - outside, self.per_epoch / max(tock - tick, 1e-9))
            )
            row |= {"elapsed_s": self.elapsed, "steps_per_s": rate}
            with agreed(f"looking at epoch {self.epochs}"):
                extra = dict(callback(self.learner, self.state, row) or {}) if callback else {}
                outside += self.clock() - tock
                asked = bool(extra.pop("stop", False))
                row |= extra
                self._keep(row)
                self.progress.show(row, final=self.epochs >= total)
            now = self.clock()
            late = c.time_limit is not None and now - begin >= c.time_limit
            due = now - saved >= c.checkpoint_every
            stop, late, due = (bool(v) for v in of_the_first(asked, late, due))
            last = self.epochs >= total or late or stop
            if self.checkpoints and math.isfinite(c.checkpoint_every) and (last or due):
                self._save()
                saved = self.clock()
            if late:
                break
        return self._result(self.epochs >= total or stop)

    def _epoch(self) -> dict[str, Any]:
        self.state, (numbers, episodes) = self.learner.epoch(self.learner.env.params, self.state)
        # Waits for the epoch: from here its time is known.
        row = {k: float(v) for k, v in jax.device_get(numbers).items()}
        if self.renewal is not None:
            env: Any = self.learner.env
            env.params = env.renewed(self.renewal, env.params, self.state.env)
        first = self.epochs * self.per_epoch
        self.epochs += 1
        if row.pop("tripped") or row.pop("broken", 0.0):
            self._diverged()
        self._episodes(episodes, first)
        return {"steps": self.epochs * self.per_epoch, **row}

    def _episodes(self, episodes: Any, first: int) -> None:
        if not episodes or jax.process_count() > 1:
            return
        on_host = jax.device_get(episodes)
        env, step = np.nonzero(on_host["done"])
        # By the step in which they ended, as one learner meets them.
        order = np.lexsort((env, step))
        env, step = env[order], step[order]
        for name in EPISODE:
            self.episodes[name] += on_host[name][env, step].astype(float).tolist()
        self.episodes["step"] += (first + (step + 1) * self.learner.config.envs).tolist()

    def _keep(self, row: dict[str, Any]) -> None:
        if self.record:
            self.record.add(row)
        else:
            self.rows.append(row)

    def _save(self) -> None:
        assert self.checkpoints is not None
        notes = {"epochs": self.epochs, "elapsed": self.elapsed, "rows": self.rows, "episodes": self.episodes}
        notes |= {} if self.renewal is None else {"renewal": self.renewal.notes()}
        self.checkpoints.save(self.epochs, self.state, plain(notes))

    def _diverged(self) -> None:
        envs = self.learner.config.envs // self.learner.devices
        seen = everywhere(self.state.guard)
        # The environments are sound, so the learning diverged.
        if not np.any(seen.tripped):
            raise guard.DivergenceError(
                "train: the agent's parameters are not finite although all environments are; "
                "lower the learning rates or the reward scale."
            )
        if not self.folder:
            number = int(np.argmax(seen.tripped)) * envs + int(seen.env[np.argmax(seen.tripped)])
            raise guard.DivergenceError(
                f"train: environment {number} gave a value that is not finite; train into a folder to keep its state."
            )
        path = self.folder / "not_finite.npz"
        number, step = guard.dump(seen, path if self.lead else None, envs)
        raise guard.DivergenceError(
            f"train: environment {number} gave a value that is not finite in step {step}; its state before that step "
            f"is in {path}: take the step again with lunar_mjx.agents.guard.replay, and mend the model or time step."
        )

    def _result(self, finished: bool) -> Result:
        notes = {
            "algorithm": type(self.learner.agent).__name__,
            "train": plain(dataclasses.asdict(self.learner.config)),
            "seed": self.config.seed,
            **({"begin_with": self.config.begin_with} if self.config.begin_with else {}),
            "steps": self.epochs * self.per_epoch,
            "elapsed_s": self.elapsed,
        }
        policy = policy_of(self.learner, self.state, self.environment, notes)
        if self.folder and self.lead:
            save_policy(policy, self.folder / "policy.npz")
        return Result(self.learner, self.state, policy, self.rows, self.episodes, finished)

    def close(self) -> None:
        if self.record:
            self.record.close()
        if self.checkpoints:
            self.checkpoints.close()
        if self.lock:
            self.lock.close()


def _checkpoints(folder: Path, settings: dict[str, Any]) -> Checkpoints:
    # orbax takes a second to import, and trainings without a folder do without it
    from lunar_mjx.agents.checkpoint import Checkpoints

    return Checkpoints(folder, settings)


def plain(value: Any) -> Any:
    """A value as JSON can hold it: tuples become lists, numbers that are not finite None."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
