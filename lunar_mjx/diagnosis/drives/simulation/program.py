"""The compiled simulation of a chunk of rovers that differ in parameters, starts, commands and ground."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.diagnosis.drives.simulation.log_run import LOG_START, STOOD, ImuMounting, LogRun
from lunar_mjx.diagnosis.drives.simulation.unmapped_ground import UNMAPPED_GRID, mode_name
from lunar_mjx.dynamics import System, build
from lunar_mjx.dynamics.bus import BUS_CURRENT, tells_bus_voltage
from lunar_mjx.dynamics.signals import measure, with_sides
from lunar_mjx.dynamics.state import Params
from lunar_mjx.inference.coordinates import NUISANCE
from lunar_mjx.inference.deadline import Deadline
from lunar_mjx.model import Model

Rows = Mapping[tuple[str, str, int, bool], np.ndarray]
"""(rows,) values by effect, parameter, log (-1 for all) and whether they are factors."""

PIECE = 0.5
"""Length of the pieces in which logs are simulated, s. A time of standing between two of them is interpolated."""
_FEWEST = 64
"""Rovers that come back from the device at least; else the next power of two, for few programs."""


_NUMBERS = itertools.count()


class _Compiling:
    """How long the last program of this process took until its first piece, s: what the next one will need."""

    seconds = 0.0


_compiling = _Compiling()


class Program:
    """One compiled simulation of a chunk of rovers, from rest to the measured channels."""

    def __init__(self, model: Model, every: int, channels: tuple[str, ...], imu: ImuMounting, engine: str):
        self.model, self.every, self.channels, self.imu = model, every, channels, imu
        self.number = next(_NUMBERS)
        with jax.enable_x64(True):
            self.system: System = build(model, engine)
        # Pieces of one length, the first of which settle the rover: one program serves logs of any length.
        self.segment = math.ceil(PIECE / (every * self.system.dt) - 1e-9)
        self.compiled = False
        self._reset = jax.jit(self._reset_all)
        self._drive = jax.jit(self._drive_all, static_argnames="shared")
        self._measure = jax.jit(self._measure_all, static_argnames="shared")
        self._set_moving = jax.jit(jax.vmap(self._in_motion))
        body = self.system.engine.mj_model
        self._joint_dofs = np.array([body.jnt_dofadr[body.joint(j).id] for j in model.rover.joints])

    def length(self, commands: int) -> int:
        """Number of commands rounded up to whole pieces."""
        return self.segment * math.ceil(commands / self.segment)

    def _axes(self, params: Params, shared: bool) -> Any:
        axes = jax.tree.map(lambda _: 0, params)
        # One ground for all rovers is not copied for each of them.
        return dataclasses.replace(axes, terrain=None) if shared else axes

    def _reset_all(
        self, params: Params, start: Mapping[str, Any], terrain: Any, modes: Any, log: Any
    ) -> tuple[Params, Any]:
        """Parameters with their ground, and states at the start."""
        shared = log is None
        if not shared:
            terrain = jax.tree.map(lambda a: a[log], terrain)
        if modes is not None:
            amounts = jnp.stack([start[mode_name(k)] for k in range(modes.shape[1])], axis=-1)
            heights = terrain.field.heights + jnp.einsum("rk,rkij->rij", amounts, modes[log])
            terrain = dataclasses.replace(terrain, field=dataclasses.replace(terrain.field, heights=heights))
        params = dataclasses.replace(params, terrain=terrain)
        one = lambda p, s: self.system.reset(p, s["x"], s["y"], s["yaw"], s["temperature"])  # noqa: E731
        return params, jax.vmap(one, (self._axes(params, shared), 0))(params, start)

    def _drive_all(self, params: Params, state: Any, commands: Any, shared: bool) -> tuple[Any, Any]:
        return self.system.rollout_batch(
            params, state, commands, self.every, self._axes(params, shared), chunk=commands.shape[0], one_body=True
        )

    def _measure_all(self, params: Params, bus_voltage: Any, pieces: Sequence[Any], shared: bool) -> Any:
        seen = jax.tree.map(lambda *a: jnp.concatenate(a, axis=1), *pieces)

        def channels(params: Params, bus_voltage: Any, seen: Any) -> Any:
            position = self.imu.position if any(self.imu.position) else None
            turn = self.imu.quaternion if any(self.imu.quaternion[1:]) else None
            signals = measure(self.system, seen, params, position, turn, bus_voltage)
            measured = with_sides(self.model.rover, signals.channels)
            return jnp.stack([measured[c] for c in self.channels])

        of_bus = None if bus_voltage is None else 0
        return jax.vmap(channels, (self._axes(params, shared), of_bus, 0))(params, bus_voltage, seen)

    def _in_motion(self, state: Any, motion: Mapping[str, Any]) -> Any:
        """A standing rover's state with the velocities of a log that begins in motion."""
        spin = motion["joint_speed"]
        # Of a free joint MuJoCo counts velocity in the world and turning about the body's own axes: the sixth is the
        # yaw rate.
        moving = state.qvel.at[:2].set(motion["velocity"]).at[5].set(motion["yaw_rate"])
        moving = moving.at[self._joint_dofs].set(jnp.where(jnp.isnan(spin), moving[self._joint_dofs], spin))
        return dataclasses.replace(state, qvel=jnp.where(motion["moves"], moving, state.qvel))

    def __call__(
        self, logs: Logs, log: np.ndarray, row: np.ndarray, values: Rows, count: int, deadline: Deadline
    ) -> np.ndarray:
        """(rovers, channels, time) of rovers by their log (place in `logs`) and their row of `values`.

        The first `count` are wanted, and few beyond them come back from the device.

        Raises:
          TimeUp: the deadline passed, or comes before the program could be compiled.
        """
        deadline.check(0.0 if self.compiled else _compiling.seconds)
        began, first = time.monotonic(), not self.compiled
        params, start = logs.rovers(log, row, values)
        commands = logs.commands[log]
        self.compiled = True
        with jax.enable_x64(True):
            own, shared = (None, True) if logs.shared else (log, False)
            full, state = self._reset(params, start, logs.terrain, logs.modes, own)
            stood = self._stand(full, state, np.zeros_like(commands[:, : self.segment]), start[STOOD], shared)
            # The clock and the heat begin with the log.
            state = dataclasses.replace(stood, step=state.step, temperature=state.temperature)
            if logs.motion["moves"].any():
                state = self._set_moving(state, {name: a[log] for name, a in logs.motion.items()})
            seen = []
            for at in range(0, commands.shape[1], self.segment):
                if math.isfinite(deadline.until):
                    jax.block_until_ready(state)  # else all pieces are under way before the first has ended
                    deadline.check()
                state, telemetry = self._drive(full, state, commands[:, at : at + self.segment], shared=shared)
                seen.append(telemetry)
                if first and not at:
                    _compiling.seconds = time.monotonic() - began
            bus = None if logs.bus_voltage is None else logs.bus_voltage[log]
            measured = self._measure(full, bus, seen, shared=shared)
            size = max(_FEWEST, 1 << (count - 1).bit_length())
            return np.asarray(measured if size >= len(log) else _first(measured, size))

    def _stand(self, params: Params, state: Any, still: np.ndarray, stood: np.ndarray, shared: bool) -> Any:
        """Rovers that have stood for their own times (rovers,), s, at least `LOG_START.settle`."""
        pieces = stood / (self.segment * self.every * self.system.dt)
        first = round(LOG_START.settle / PIECE)
        for _ in range(first):
            state, _ = self._drive(params, state, still, shared=shared)
        kept, now = state, state
        for k in range(first, math.ceil(float(np.max(pieces)) - 1e-12)):
            after, _ = self._drive(params, now, still, shared=shared)
            kept, now = _between(kept, now, after, np.clip(pieces - k, 0.0, 1.0)), after
        return kept


@functools.partial(jax.jit, static_argnums=1)
def _first(found: Any, size: int) -> Any:
    return found[:size]


@jax.jit
def _between(kept: Any, before: Any, after: Any, share: Any) -> Any:
    """`before` and `after` in a share (rovers,) of each; `kept` where the share is nothing."""

    def blend(kept: Any, before: Any, after: Any) -> Any:
        part = share.reshape(-1, *[1] * (jnp.ndim(after) - 1))
        if not jnp.issubdtype(jnp.result_type(after), jnp.floating):
            return jnp.where(part > 0.0, after, kept)
        return jnp.where(part == 1.0, after, jnp.where(part > 0.0, before + part * (after - before), kept))

    return jax.tree.map(blend, kept, before, after)


@dataclasses.dataclass(frozen=True, eq=False)
class Logs:
    """Logs that one program runs, stacked, so that a rover is a pair of indices.

    Attributes:
      program: which runs them. numbers: of the logs in the campaign.
      params: with a leading axis of logs, but for the ground. start: (logs,) by name.
      terrain: the ground, with a leading axis of logs unless `shared` by all of them.
      commands: (logs, time, joint), the last ones repeated up to whole pieces.
      motion: (logs, ...) velocities at the start, by name, as in `LogRun`.
      modes: (logs, modes, rows, cols) of unmapped ground, whose amounts are in `start`; None where all is mapped.
      bus_voltage: (logs, time) that logs read, V, NaN of those that read none; None where none does.
    """

    program: Program
    numbers: tuple[int, ...]
    params: Params
    start: Mapping[str, np.ndarray]
    terrain: Any
    shared: bool
    commands: np.ndarray
    motion: Mapping[str, np.ndarray]
    modes: Any
    bus_voltage: np.ndarray | None

    def rovers(self, log: np.ndarray, row: np.ndarray, values: Rows) -> tuple[Params, dict[str, np.ndarray]]:
        """Parameters (but for the ground) and starts of rovers: the logs' conditions with rows of values put in."""
        params = jax.tree.map(lambda a: a[log], self.params)
        start = {name: column[log].copy() for name, column in self.start.items()}
        number = np.asarray(self.numbers)[log]
        for (effect, name, own, factor), column in values.items():
            value = column[row]
            if effect == NUISANCE:
                if name in start:
                    start[name] = np.where(number == own, value, start[name])
            elif effect in params.effects:  # else a candidate at its null, which this program does without
                old = params.effects[effect][name]
                spread = value.reshape(-1, *[1] * (old.ndim - 1))
                params.effects[effect][name] = old * spread if factor else np.broadcast_to(spread, old.shape)
        return params, start


def stack_logs(program: Program, numbers: Sequence[int], runs: Sequence[LogRun], params: Sequence[Params]) -> Logs:
    """Makes logs of one program and one length ready."""
    length = program.length(max(len(r.commands) for r in runs))
    terrains = [p.terrain for p in params]
    leaves = [jax.tree.leaves(t) for t in terrains]
    shared = all(np.array_equal(a, b) for other in leaves[1:] for a, b in zip(leaves[0], other, strict=True))
    bare = [dataclasses.replace(p, terrain=None) for p in params]  # type: ignore[arg-type]
    start = {n: np.array([r.start[n] for r in runs], float) for n in ("x", "y", "yaw", "temperature", STOOD)}
    grounds = [r.ground.modes for r in runs if r.ground is not None]
    modes = None
    if grounds:
        # all of one number, so that logs of any length share a program: those that a log lacks are level
        modes = np.zeros((len(runs), UNMAPPED_GRID.modes, *grounds[0].shape[1:]))
        for place, own in zip(modes, grounds, strict=True):
            place[: len(own)] = own
        start |= {mode_name(k): np.zeros(len(runs)) for k in range(UNMAPPED_GRID.modes)}
        shared = False
    with jax.enable_x64(True):
        ground = terrains[0] if shared else jax.tree.map(lambda *a: np.stack(a), *terrains)
        ground, modes = jax.device_put((ground, modes))
    return Logs(
        program=program,
        numbers=tuple(numbers),
        params=jax.tree.map(lambda *a: np.stack(a), *bare),
        start=start,
        terrain=ground,
        shared=shared,
        commands=np.stack([_padded(r.commands, length) for r in runs]),
        motion={name: np.stack([r.motion[name] for r in runs]) for name in runs[0].motion},
        modes=modes,
        bus_voltage=_bus_voltages(program, runs, length),
    )


def _bus_voltages(program: Program, runs: Sequence[LogRun], length: int) -> np.ndarray | None:
    """(logs, time) voltages that logs read, as in `Logs`."""
    # a program that tells the current for logs of another length has to be told some voltage here, too
    told = BUS_CURRENT in program.channels and not tells_bus_voltage(program.model.effect_names)
    if not told and all(r.bus_voltage is None for r in runs):
        return None
    read = (np.full(len(r.commands), np.nan) if r.bus_voltage is None else r.bus_voltage for r in runs)
    return np.stack([_padded(v, length) for v in read])


def cores() -> int:
    """Cores that this process may use, which may be fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), axis=0)])
