"""Drives of an agent as a dataset of episodes that Minari loads: one HDF5 file and its metadata."""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lunar_mjx._version import __version__
from lunar_mjx.agents.train import plain
from lunar_mjx.envs.core import State, split_keys
from lunar_mjx.envs.navigation.env import NavigationEnv
from lunar_mjx.envs.navigation.labels import labels
from lunar_mjx.envs.scripted import Agent
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.files import replacing

DATA, METADATA = "main_data.hdf5", "metadata.json"
"""Files of a dataset's folder `data`, as Minari names them."""
MINARI = "0.5.4"
"""Version of Minari whose layout is written."""
_BOUND = 1e6
"""Bound of observations that a dataset states: they have none, and Gymnasium warns of infinite ones."""
_NAME = re.compile(r"(\w[\w-]*/)*\w[\w-]*-v\d+")
_PIECE = 50
"""Steps that run on the device between transfers."""

Episode = dict[str, Any]
"""`observations` (step + 1, n), `actions`, `rewards`, `terminations`, `truncations` (step, ...), and `infos` by name,
(step + 1, ...)."""


def check_dataset(name: str, frames: int, rovers: int) -> None:
    """Refuses what cannot be written, before any rover drives.

    Raises:
      UserError: a name that Minari does not take, fewer frames than rovers, or no h5py.
    """
    if frames < rovers:
        raise bad_input("export", "--frames", frames, f"are fewer than --rovers = {rovers}", "raise it")
    if not _NAME.fullmatch(name):
        raise bad_input("export", "--name", name, "is no dataset's name", "write it as lunar-mjx/my-drives-v0")
    try:
        importlib.import_module("h5py")
    except ImportError as error:
        remedy = "give pip install 'lunar-mjx[datasets]'"
        raise UserError(f"export: the package h5py is not installed; {remedy}.") from error


def _seen(env: NavigationEnv, state: State) -> dict[str, Any]:
    """The labels of a step: what the rover's sensors do not tell."""
    inner = state.inner
    return {
        "slip": inner.slip,
        "sinkage": inner.sinkage,
        "position": inner.physics.qpos[:, :3],
        "quaternion": inner.physics.qpos[:, 3:7],
        "goal": inner.goal,
        **{f"drawn.{name}": value for name, value in inner.drawn.items()},
    }


def drives(env: NavigationEnv, params: Any, agent: Agent, rovers: int, frames: int, seed: int) -> Iterator[Episode]:
    """The episodes of rovers side by side, as they end; the last ones are cut off, as truncated.

    Args:
      env, params: where. agent: who. rovers: side by side. frames: steps of all together, whole steps of all rovers.
      seed: of starts, goals, soils and random agents.

    Raises:
      UserError: an observation is not finite.
    """

    def step(state: State, key: Any) -> tuple[State, dict[str, Any]]:
        action = agent(state, key)
        after = env.act(params, state, action)
        new = env.restarted(params, after)
        told = {
            "actions": action,
            "rewards": after.reward,
            "terminations": after.terminated,
            "truncations": after.truncated,
        }
        # An episode's last observation is the true one, not the first of the next: a learner takes its value from it.
        ends = {"observations": after.final_obs, **_seen(env, after)}
        return new, {**told, "after": ends, "begun": {"observations": new.obs, **_seen(env, new)}}

    piece = jax.jit(lambda state, keys: jax.lax.scan(step, state, keys))
    key_reset, key = jax.random.split(jax.random.PRNGKey(seed))
    state = jax.jit(env.reset)(params, split_keys(key_reset, rovers))
    first = jax.device_get({"observations": state.obs, **_seen(env, state)})
    open_ones = [_Open({name: value[i] for name, value in first.items()}) for i in range(rovers)]
    # Whole steps of all rovers, so that none of them has fewer frames than the others.
    left = -(-frames // rovers)
    for number in range(-(-left // _PIECE)):
        keys = jax.random.split(jax.random.fold_in(key, number), _PIECE)
        state, told = piece(state, keys)
        told = jax.device_get(told)
        steps = min(_PIECE, left - number * _PIECE)
        if not np.isfinite(told["after"]["observations"][:steps]).all():
            # a learner reads such numbers without a word; where episodes end by divergence, observations are bounded
            problem = "lets a rover's state through that is not finite"
            raise bad_input("export", "divergence", env.config.divergence, problem, "give --env divergence=reset")
        for i, rover in enumerate(open_ones):
            yield from rover.add(told, i, steps)
    for rover in open_ones:
        yield from rover.cut()


class _Open:
    """The episode that a rover drives, in pieces."""

    def __init__(self, first: dict[str, Any]):
        self._begin(first)

    def _begin(self, first: dict[str, Any]) -> None:
        self._rows: list[dict[str, Any]] = []
        self._states: list[dict[str, Any]] = [{name: np.asarray(value)[None] for name, value in first.items()}]

    def add(self, told: dict[str, Any], rover: int, steps: int) -> Iterator[Episode]:
        """Appends a piece, (step, rover, ...); gives the episodes that ended in it."""
        after, begun = told["after"], told["begun"]
        alone = {name: told[name][:steps, rover] for name in ("actions", "rewards", "terminations", "truncations")}
        start = 0
        for end in np.flatnonzero(alone["terminations"] | alone["truncations"]):
            self._take(alone, after, rover, slice(start, end + 1))
            yield self._whole()
            self._begin({name: value[end, rover] for name, value in begun.items()})
            start = end + 1
        if start < steps:
            self._take(alone, after, rover, slice(start, steps))

    def cut(self) -> Iterator[Episode]:
        """The episode that is not over, cut off; nothing where none has begun."""
        # A rover whose episode ended with the last step has begun another one, in which nothing was done.
        if self._rows:
            episode = self._whole()
            episode["truncations"][-1] = True
            yield episode

    def _take(self, alone: dict[str, Any], after: dict[str, Any], rover: int, part: slice) -> None:
        self._rows.append({name: value[part] for name, value in alone.items()})
        self._states.append({name: value[part, rover] for name, value in after.items()})

    def _whole(self) -> Episode:
        rows = {name: np.concatenate([piece[name] for piece in self._rows]) for name in self._rows[0]}
        infos = {name: np.concatenate([piece[name] for piece in self._states]) for name in self._states[0]}
        return {"observations": infos.pop("observations"), **rows, "infos": infos}


def _space(low: float, high: float, size: int) -> str:
    """A box as Minari tells it."""
    box = {"type": "Box", "dtype": "float32", "shape": [size], "low": [low] * size, "high": [high] * size}
    return json.dumps(box)


class _Sink(io.FileIO):
    """A file that keeps what the operating system refuses until it is asked.

    HDF5 cannot close a file that it could not write: where a disk is full it ends the process with a fault of memory.
    """

    def __init__(self, path: Path):
        super().__init__(path, "w+")
        self.refused: OSError | None = None

    def write(self, data: Any, /) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while len(rest) and self.refused is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.refused = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size) if self.refused is None else size or 0
        except OSError as error:
            self.refused = error
            return size or 0

    def flush(self) -> None:
        """Nothing is held back here; `replacing` has it written to the disk."""

    def check(self) -> None:
        """Raises what was refused.

        Raises:
          OSError: a write was.
        """
        if self.refused is not None:
            raise self.refused


def write_dataset(
    episodes: Iterator[Episode], env: NavigationEnv, folder: Path, name: str, about: dict[str, Any]
) -> tuple[int, int]:
    """Writes episodes into `folder/name/data`; returns how many they were, and their steps.

    Args:
      episodes: from `drives`. env: whose observations they are. folder: that exists. name: of the dataset, as
        `check_dataset` takes it. about: what the metadata says beside sizes and names of numbers.

    Raises:
      UserError: it cannot be written: no permission, disk full.
    """
    h5py: Any = importlib.import_module("h5py")
    data = folder / name / "data"
    data.mkdir(parents=True, exist_ok=True)
    count = steps = 0
    # Renamed together, at the end: who kills it keeps the dataset that was there.
    with replacing(data / METADATA) as metadata_part, replacing(data / DATA) as part:
        with _Sink(part) as sink:
            with h5py.File(sink, "w", track_order=True) as file:
                for episode in episodes:
                    length = len(episode["rewards"])
                    group = file.create_group(f"episode_{count}")
                    group.attrs.update({"id": count, "total_steps": length})
                    infos = group.create_group("infos")
                    for parent, values in ((group, episode), (infos, episode["infos"])):
                        for key, value in values.items():
                            if key != "infos":
                                parent.create_dataset(key, data=value)
                    count, steps = count + 1, steps + length
                    # A full disk is noticed at the first write that fails, not after hours of driving.
                    if sink.refused:
                        break
            sink.check()
        told = {
            "dataset_id": name,
            "minari_version": MINARI,
            "data_format": "hdf5",
            "jpeg_encoding": False,
            "total_episodes": count,
            "total_steps": steps,
            "dataset_size": round(part.stat().st_size / 1e6, 1),
            "observation_space": _space(-_BOUND, _BOUND, env.observation_size),
            "action_space": _space(-1.0, 1.0, env.action_size),
            "observations": [f"{block}: {i.name} [{i.unit}]" for block, own in labels(env).items() for i in own],
            "actions": list(env.actions.names),
            "wheels": [wheel.corner for wheel in env.model.rover.wheels],
            "infos": UNITS,
            "rover": env.model.rover.name,
            "effects": env.model.effect_names,
            "settings": dataclasses.asdict(env.config),
            "control_interval_s": env.control_interval,
            "lunar_mjx_version": __version__,
            **about,
        }
        metadata_part.write_text(json.dumps(plain(told), indent=1) + "\n", encoding="utf-8")
    return count, steps


UNITS = {
    "slip": "1, of each wheel, of the last physics step before",
    "sinkage": "m, of each wheel, likewise",
    "position": "m, of the chassis frame, world axes",
    "quaternion": "1, of the chassis frame to the world, w first",
    "goal": "m, world axes, in the plane",
    "drawn": "parameters of the episode: `drawn.effect.parameter`, SI units",
}
"""What the infos hold."""


def export_dataset(
    env: Any,
    params: Any,
    agent: Agent,
    folder: Path,
    name: str,
    rovers: int,
    frames: int,
    seed: int,
    say: Callable[[str], Any],
    about: dict[str, Any],
) -> Path:
    """Drives and writes a dataset; returns its folder. Arguments as of `drives` and `write_dataset`.

    Raises:
      UserError: what `check_dataset` refuses, or an environment without rovers.
    """
    check_dataset(name, frames, rovers)
    if not isinstance(env, NavigationEnv):
        raise bad_input("export", "environment", type(env).__name__, "has no rovers", "export drives of navigation")
    begin = time.monotonic()
    device = jax.devices()[0].device_kind
    # What it takes to drive the same episodes again.
    whole = {**about, "seed": seed, "rovers": rovers, "device": device}
    count, steps = write_dataset(drives(env, params, agent, rovers, frames, seed), env, folder, name, whole)
    spent = time.monotonic() - begin
    say(f"{steps} frames of {count} episodes in {spent:.0f} s: {steps / spent:.0f} frames/s, compiling included")
    return folder / name
