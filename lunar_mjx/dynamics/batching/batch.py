"""Many rovers at once: the batch axis last inside, in chunks whose state stays in the cache of the device.

Outside, every array has the usual leading batch axis. Inside, neighbouring rovers lie side by side in memory, so that
one wide instruction (or one group of GPU threads) serves many of them. A rollout transposes once, not every step.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from lunar_mjx.dynamics.batching.batch_last import batch_last
from lunar_mjx.dynamics.batching.computed_once import computed_once
from lunar_mjx.dynamics.batching.cuda import Launch, compiler, on_gpu
from lunar_mjx.dynamics.batching.one_kernel import as_kernels
from lunar_mjx.dynamics.state import Params, State, Telemetry
from lunar_mjx.errors import UserError

CHUNK = {"cpu": 1024, "gpu": 65536}
"""Rovers per chunk by platform (benchmarks/speed.py): the state of a chunk stays in the L2 cache."""

PARTS: list[Launch] = []
"""How marked parts of a step run as kernels; where it is empty, on a GPU by its compiler, and elsewhere not at all."""

Axes = Any
"""None, 0, or a prefix of `Params` whose leaves are None (shared by all rovers) or 0 (leading axis: per rover)."""


@runtime_checkable
class Steps(Protocol):
    """What a batch needs of a system: its step for one rover, and its engine.

    Attributes:
      engine: has `name`, and `split` and `join`, which change the layout of the state for a rollout.
    """

    engine: Any

    def step(self, params: Params, state: State, control: Any) -> tuple[State, Telemetry]:
        """One physics step of one rover."""
        ...


def step_batch(
    system: Steps, params: Params, state: State, control: Any, params_axes: Axes = None, chunk: int | None = None
) -> tuple[State, Telemetry]:
    """One step of many rovers; see `System.step_batch`."""

    def step(params: Params, axes: list[int | None], state: State, control: Any) -> Any:
        return _once(system, batch_last(system.step, (axes, -1, -1), _parts()))(params, state, control)

    return _in_chunks(step, params, params_axes, (state, control), chunk)


def rollout_batch(
    system: Steps,
    params: Params,
    state: State,
    controls: Any,
    every: int = 1,
    params_axes: Axes = None,
    report: Callable[[Telemetry], Any] | None = None,
    chunk: int | None = None,
    one_body: bool = False,
    last: bool = False,
) -> tuple[State, Any]:
    """Drives many rovers through a sequence of controls; see `System.rollout_batch`."""
    keep = report or (lambda telemetry: telemetry)
    controls = jnp.asarray(controls)

    def drive(params: Params, axes: list[int | None], state: State, *own: Any) -> Any:
        each, engine = (axes, -1, -1 if own else None), system.engine

        def reporting(params: Params, now: State, control: Any) -> tuple[State, Any]:
            new, telemetry = system.step(params, now, control)
            return new, keep(telemetry)

        # What is kept of the telemetry is chosen within, so that a part's kernel writes nothing else of it.
        run = _once(system, batch_last(reporting, each, _parts()))
        silent = _once(system, batch_last(lambda p, now, control: system.step(p, now, control)[0], each, _parts()))

        def recast(change: Callable[..., Any], state: State) -> State:
            qpos, qvel = batch_last(change, (-1, -1))(state.qpos, state.qvel)
            return dataclasses.replace(state, qpos=qpos, qvel=qvel)

        def hold_one(now: State, control: Any) -> tuple[State, Any]:
            def again(i: Any, carry: Any) -> Any:
                new, kept = run(params, carry[0], control)
                return new, kept if last else jax.tree.map(lambda a, b: jnp.where(i == 0, a, b), kept, carry[1])

            # a loop must carry something of this shape; it is overwritten in the first round
            blank = jax.tree.map(
                lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(lambda: run(params, now, control)[1])
            )
            return jax.lax.fori_loop(0, every, again, (now, blank))

        def hold(now: State, control: Any) -> tuple[State, Any]:
            if one_body:
                return hold_one(now, control)
            # unless the last step is asked for, this one alone makes telemetry, and XLA drops it from the silent ones
            new, kept = run(params, now, control)
            if last:
                return jax.lax.fori_loop(1, every, lambda _, carry: run(params, carry[0], control), (new, kept))
            if every > 1:
                new = jax.lax.fori_loop(1, every, lambda _, s: silent(params, s, control), new)
            return new, kept

        end, kept = jax.lax.scan(hold, recast(engine.split, state), own[0] if own else controls)
        return recast(engine.join, end), kept

    return _in_chunks(drive, params, params_axes, (state, controls) if controls.ndim == 3 else (state,), chunk)


def _parts() -> Callable[..., Any] | None:
    """How marked parts of a step are computed, for `batch_last`."""
    if PARTS:
        return as_kernels(PARTS[0])
    return as_kernels(on_gpu) if jax.default_backend() == "gpu" and compiler() is not None else None


def _once(system: Steps, function: Callable[..., Any]) -> Callable[..., Any]:
    # MJX's step is made of matrix products, which are kernels of their own already.
    return computed_once(function) if system.engine.name == "structured" else function


def _in_chunks(function: Callable[..., Any], params: Params, axes: Axes, varying: Any, chunk: int | None) -> Any:
    """Calls `function(params, axes, *varying)` with the batch last, chunk by chunk, and returns it leading again."""
    batch = varying[0].step.shape[0]
    # Shared parameters are closed over and not mapped: they lie in memory once for all chunks.
    leaves, treedef = jax.tree.flatten(params)
    flags = jax.tree.map(lambda a: a is not None, axes, is_leaf=lambda a: a is None)
    per_rover = jax.tree.leaves(jax.tree.broadcast(flags, params))
    _check(leaves, per_rover, varying, batch)
    inner = [_inner_axis(leaf) if own else None for leaf, own in zip(leaves, per_rover, strict=True)]

    def block(args: tuple[list[Any], Any]) -> Any:
        own, varying = args
        moved = iter(own)
        filled = [leaf if a is None else jnp.moveaxis(next(moved), 0, a) for leaf, a in zip(leaves, inner, strict=True)]
        out = function(jax.tree.unflatten(treedef, filled), inner, *_last(varying))
        return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), out)

    args = ([leaf for leaf, own in zip(leaves, per_rover, strict=True) if own], varying)
    size = chunk or CHUNK.get(jax.default_backend(), 65536)
    # One chunk needs no loop around it, which would keep XLA from fusing across it.
    if batch <= size:
        return block(args)
    count = math.ceil(batch / size)
    # chunks of even size: one program, and the last one is not nearly empty
    size = math.ceil(batch / count)

    def split(a: Any) -> Any:
        # the last chunk is filled up with copies of the first rovers
        filled = a if count * size == batch else jnp.concatenate([a, a[: count * size - batch]])
        return filled.reshape(count, size, *a.shape[1:])

    out = jax.lax.map(block, jax.tree.map(split, args))
    return jax.tree.map(lambda a: a.reshape(count * size, *a.shape[2:])[:batch], out)


def _last(tree: Any) -> Any:
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), tree)


def _inner_axis(leaf: Any) -> int:
    """Numbers and short lists go batch last; maps stay batch first, so that a rover's own map lies together."""
    return 0 if leaf.ndim > 2 else -1


def _check(leaves: list[Any], per_rover: list[bool], varying: Any, batch: int) -> None:
    batch_sizes = {leaf.shape[0] if leaf.ndim else None for leaf, own in zip(leaves, per_rover, strict=True) if own}
    batch_sizes |= {leaf.shape[0] for leaf in jax.tree.leaves(varying)}
    if batch_sizes - {batch}:
        raise UserError(
            f"step_batch: the leading axes {sorted(map(str, batch_sizes))} do not agree with the {batch} rovers; "
            "give one entry per rover, or leave shared parameters out of params_axes."
        )
