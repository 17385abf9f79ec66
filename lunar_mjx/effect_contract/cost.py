"""What an effect costs: the time of a step's effects with and without it, compiled for a batch of rovers."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.batching.batch_last import batch_last
from lunar_mjx.effect_contract import random_rovers as probe
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.ports import Pipeline


@dataclasses.dataclass(frozen=True)
class CostMeasurement:
    """How the cost of an effect is timed."""

    batch: int = 2048
    """Rovers side by side; their state stays in the cache of a CPU."""
    repeats: int = 12
    """Turns of both lists, of which the quickest counts."""
    calls: int = 5
    """Steps per turn, so that reading the clock costs nothing."""


COST = CostMeasurement()


def measure_overhead(without: Sequence[Effect], full: Sequence[Effect]) -> tuple[float, float]:
    """Cost of the effects that only `full` has.

    Both lists are compiled with the batch axis last, in the default precision, and run by turns; the least time counts,
    since whatever else the machine does can only add to it.

    Returns:
      Relative increase of the time, and by how much the least times of the two halves of the repeats differ.
    """
    runs = [_compiled(without), _compiled(full)]
    # On a CPU the time that the process itself has spent, in which others on the machine count little.
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    times: list[list[float]] = [[], []]
    for _ in range(COST.repeats):
        for run, spent in zip(runs, times, strict=True):
            start, done = clock(), None
            for _ in range(COST.calls):
                done = run()
            jax.block_until_ready(done)
            spent.append((clock() - start) / COST.calls)
    # Halves of one measurement differ by what else the machine did: the error of a verdict on this machine.
    half = COST.repeats // 2
    drift = [abs(min(t[:half]) - min(t[half:])) / min(t) for t in times]
    return min(times[1]) / min(times[0]) - 1.0, max(drift)


def _compiled(effects: Sequence[Effect]) -> Callable[[], Any]:
    # Arrays of the default precision: checks run in float64, users' programs do not.
    pipeline, world = Pipeline(tuple(effects)), jax.tree.map(_real, probe.terrain())
    wheels = 4
    # A few random rovers over and over: what a rover does changes no instruction, so that more would cost time alone.
    s = probe.states(64, wheels)
    s = {k: np.moveaxis(np.tile(v, (COST.batch // 64, *(1,) * (v.ndim - 1))), 0, -1) for k, v in s.items()}
    memory = jax.tree.map(
        lambda a: np.repeat(np.asarray(a)[..., None], COST.batch, -1), probe.reset_memory(effects, wheels)
    )

    def one(s: Any, memory: Any) -> Any:
        return probe.step(pipeline, world, {}, s, probe.RANDOM_ROVERS.warm_up, memory)

    run = jax.jit(batch_last(one, (-1, -1)))
    arguments = jax.tree.map(_real, (s, memory))
    jax.block_until_ready(run(*arguments))
    return lambda: run(*arguments)


def _real(a: Any) -> Any:
    return jnp.asarray(a, float) if np.issubdtype(np.asarray(a).dtype, np.floating) else jnp.asarray(a)
