"""Part `rates` of measure.py: environment steps per second, with all that belongs to them, against the bare physics.

    python benchmarks/rl/measure.py rates --out runs/rates                                      # one GPU
    python benchmarks/rl/measure.py rates --only 17/5/64 --env terrain=flat --out runs/rates    # two CPU cores

A row is numbers that are observed / physics steps per action / rovers.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
from harness import Clock, in_time, save, say

from lunar_mjx.commands.train import env_options
from lunar_mjx.envs import make_navigation, split_keys
from lunar_mjx.envs.navigation.observations import PAPER_OBSERVATION

FEW = {"observations": PAPER_OBSERVATION, "privileged": ()}
"""Options of an environment with 17 observations."""


def rates(args: argparse.Namespace, clock: Clock) -> None:
    """Compiles every row in threads, and measures."""
    plan = [(numbers, int(every), int(size)) for numbers, every, size in (row.split("/") for row in args.only)]
    made = {}
    for numbers, every in {row[:2] for row in plan}:
        options = {"places": 2048, **(FEW if numbers == "17" else {}), **env_options(args.env)}
        made[numbers, every] = make_navigation("large", args.rover, decimation=every, **options)
    steps = {every: max(20, 1000 // every) for _, every, _ in plan}
    with ThreadPoolExecutor(8) as pool:
        ready = list(pool.map(lambda row: Rate(made[row[:2]], row[2], steps[row[1]]), plan))
    say(f"rates: {len(ready)} rows compiled after {clock.spent:.0f} s")
    rows: list[dict[str, Any]] = []
    waiting = dict(zip(plan, ready, strict=True))
    for numbers, every, size in in_time(clock, plan):
        row = waiting.pop((numbers, every, size)).measure(args.repeats)
        seen = "17 numbers" if numbers == "17" else "all observations"
        rows.append({"observation": seen, "decimation": every, "rovers": size, **row})
        save(args.out, "rates", {"rover": args.rover, "rows": rows})
        million, bare = row["env_steps_per_s"] / 1e6, row["bare_steps_per_s"] / 1e6
        say(f"{seen}, {every}, {size:,} rovers: {million:.2f} M/s, bare {bare:.2f} M/s, ratio {row['ratio']:.3f}")


class Driven:
    """Steps of an environment under random actions in one program; called with parameters, state and key.

    Args:
      env: the environment. size: rovers. steps: of each, in one call.

    Returns:
      The state, whose memory is that of the state given, and how many episodes ended.
    """

    def __init__(self, env: Any, size: int, steps: int):
        self.env, self.size, self.steps = env, size, steps

        def drive(params: Any, state: Any, key: Any) -> Any:
            def step(carry: Any, key: Any) -> Any:
                state, ended = carry
                state = env.step(params, state, jax.random.uniform(key, (size, env.action_size), minval=-1.0))
                # each rover counts: a sum over all, XLA fuses with the environment's last kernel, run by one block then
                return (state, ended + state.done), None

            start = (state, jnp.zeros(size, jnp.int32))
            (state, ended), _ = jax.lax.scan(step, start, jax.random.split(key, steps))
            return state, jnp.sum(ended)

        self.program: Any = jax.jit(drive, donate_argnums=1)

    def compile(self) -> Any:
        """Compiles ahead; returns the shapes of the state."""
        keys = jax.ShapeDtypeStruct((self.size, 2), jnp.uint32)
        state = jax.eval_shape(self.env.reset, self.env.params, keys)
        self.program = self.program.lower(self.env.params, state, jax.random.PRNGKey(0)).compile()
        return state

    def staggered(self, state: Any) -> Any:
        """The state with episodes at every stage, so that as many end in one step as in the next."""
        share = jax.random.uniform(jax.random.PRNGKey(1), (self.size,))
        inner = dataclasses.replace(state.inner, waited=share * self.env.config.stuck_time)
        return dataclasses.replace(state, inner=inner)

    def timed(self, state: Any, repeats: int, beside: Callable[[], Any] = lambda: None) -> Any:
        """s of repetitions after a first one, s of `beside` after each, and how many episodes ended in each.

        Args:
          state: of all rovers; used up. beside: what is timed in turns with this.
        """
        state, taken = self.staggered(state), []
        for i in range(repeats + 1):
            begin = time.monotonic()
            state, ended = jax.block_until_ready(self.program(self.env.params, state, jax.random.PRNGKey(i)))
            middle = time.monotonic()
            beside()
            taken.append((middle - begin, time.monotonic() - middle, int(ended)))
        return map(list, zip(*taken[1:], strict=True))


class Rate:
    """The environment under random actions, and its physics alone under the same changes; compiled when made."""

    def __init__(self, env: Any, size: int, steps: int):
        self._driven, key = Driven(env, size, steps), jax.random.PRNGKey(0)
        decimation = env.config.decimation
        controls = env.actions.controls(jax.random.uniform(key, (steps, env.action_size), minval=-1.0))

        def bare(params: Any, state: Any) -> Any:
            return env.system.rollout_batch(params.system, state, controls, decimation, report=lambda t: None)[0]

        self._reset = jax.jit(env.reset).lower(env.params, jax.ShapeDtypeStruct((size, 2), jnp.uint32)).compile()
        state = self._driven.compile()
        self._bare = jax.jit(bare, donate_argnums=1).lower(env.params, state.inner.physics).compile()

    def measure(self, repeats: int) -> dict[str, Any]:
        """Best of several repetitions, in turns."""
        driven = self._driven
        params, size, steps = driven.env.params, driven.size, driven.size * driven.steps
        state = jax.block_until_ready(self._reset(params, split_keys(jax.random.PRNGKey(0), size)))
        physics = jax.tree.map(jnp.copy, state.inner.physics)
        held = sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / size

        def beside() -> None:
            nonlocal physics
            physics = jax.block_until_ready(self._bare(params, physics))

        seconds, naked, ended = driven.timed(state, repeats, beside)
        best, bare, memory = min(seconds), min(naked), driven.program.memory_analysis()
        return {
            "env_steps_per_s": steps / best,
            "physics_steps_per_s": steps * driven.env.config.decimation / best,
            "bare_steps_per_s": steps / bare,
            "ratio": bare / best,
            "resets_per_step": ended[-1] / driven.steps,
            "seconds": seconds,
            "bare_seconds": naked,
            "state_bytes_per_rover": held,
            "temporary_bytes_per_rover": getattr(memory, "temp_size_in_bytes", 0) / size,
        }
