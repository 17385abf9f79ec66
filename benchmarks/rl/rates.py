"""Parts `rates` and `scaling` of measure.py: steps per second of the environment, and of training on more devices."""

from __future__ import annotations

import argparse
import dataclasses
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import SMALL_TASK, Clock, in_threads, in_time, save, say, training_of
from jax.sharding import Mesh
from tables import table_rates, table_scaling

from lunar_mjx.agents.learner import AXIS, Learner
from lunar_mjx.envs import make, make_navigation, split_keys
from lunar_mjx.envs.navigation.observations import PAPER_OBSERVATION

PLAN = (
    ("17 numbers", 5, (65536, 1024, 2048, 4096, 8192, 16384, 32768, 262144)),
    ("17 numbers", 50, (65536,)),
    ("all observations", 50, (65536, 4096)),
    ("all observations", 5, (65536,)),
)
"""Observation, physics steps per action, and numbers of rovers."""


def rates(args: argparse.Namespace, clock: Clock) -> None:
    """Compiles every row in threads, and measures."""
    few = {"observations": PAPER_OBSERVATION, "privileged": ()}
    plan = [(seen, every, size) for seen, every, sizes in PLAN for size in sizes]
    plan = [row for row in plan if args.rows is None or f"{row[0][:2]}/{row[1]}/{row[2]}" in args.rows]
    plan = [("17 numbers", 5, 8)] if args.tiny else plan
    made = {}
    for seen, every in {row[:2] for row in plan}:
        less = {**(few if seen == "17 numbers" else {}), **(SMALL_TASK["large"] if args.tiny else {})}
        made[seen, every] = make_navigation("large", args.rover, decimation=every, **{"places": 2048, **less})
    with ThreadPoolExecutor(8) as pool:
        steps = {every: 4 if args.tiny else max(20, 1000 // every) for _, every, _ in plan}
        ready = list(pool.map(lambda row: Rate(made[row[:2]], row[2], steps[row[1]]), plan))
    say(f"rates: {len(ready)} rows compiled after {clock.spent:.0f} s")
    rows: list[dict[str, Any]] = []
    waiting = dict(zip(plan, ready, strict=True))
    for seen, every, size in in_time(clock, plan):
        row = waiting.pop((seen, every, size)).measure(1 if args.tiny else 5)
        rows.append({"observation": seen, "decimation": every, "rovers": size, **row})
        say(table_rates(save(args.out, "rates", {"rover": args.rover, "rows": rows}))[-1])


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

    def __call__(self, params: Any, state: Any, key: Any) -> Any:
        return self.program(params, state, key)

    def staggered(self, state: Any) -> Any:
        """The state with episodes at every stage, so that as many end in one step as in the next."""
        share = jax.random.uniform(jax.random.PRNGKey(1), (self.size,))
        inner = dataclasses.replace(state.inner, waited=share * self.env.config.stuck_time)
        return dataclasses.replace(state, inner=inner)


class Rate:
    """The environment under random actions, and its physics alone under the same changes; compiled when made."""

    def __init__(self, env: Any, size: int, steps: int):
        self.env, self.size, self.steps, self._key = env, size, steps, jax.random.PRNGKey(0)
        decimation = env.config.decimation
        shares = jax.random.uniform(self._key, (steps, env.action_size), minval=-1.0)
        controls = env.actions.controls(shares)

        def bare(params: Any, state: Any) -> Any:
            return env.system.rollout_batch(params.system, state, controls, decimation, report=lambda t: None)[0]

        self._reset = jax.jit(env.reset).lower(env.params, jax.ShapeDtypeStruct((size, 2), jnp.uint32)).compile()
        self._drive = Driven(env, size, steps)
        state = self._drive.compile()
        self._bare = jax.jit(bare, donate_argnums=1).lower(env.params, state.inner.physics).compile()

    def measure(self, repeats: int) -> dict[str, Any]:
        """Best of several repetitions, in turns."""
        params = self.env.params
        state = jax.block_until_ready(self._reset(params, split_keys(self._key, self.size)))
        state = self._drive.staggered(state)
        physics = jax.tree.map(jnp.copy, state.inner.physics)
        held = sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / self.size
        ours, naked, ended = [], [], 0
        for _ in range(repeats + 1):
            begin = time.monotonic()
            state, ended = jax.block_until_ready(self._drive(params, state, self._key))
            middle = time.monotonic()
            physics = jax.block_until_ready(self._bare(params, physics))
            ours.append(middle - begin)
            naked.append(time.monotonic() - middle)
        steps, best, bare = self.size * self.steps, min(ours[1:]), min(naked[1:])
        memory = self._drive.program.memory_analysis()
        return {
            "env_steps_per_s": steps / best,
            "physics_steps_per_s": steps * self.env.config.decimation / best,
            "bare_steps_per_s": steps / bare,
            "ratio": bare / best,
            "resets_per_step": int(ended) / self.steps,
            "seconds": ours[1:],
            "bare_seconds": naked[1:],
            "state_bytes_per_rover": held,
            "temporary_bytes_per_rover": getattr(memory, "temp_size_in_bytes", 0) / self.size,
        }


def scaling(args: argparse.Namespace, clock: Clock) -> None:
    """Whole training epochs per second on more and more devices, the same rovers and transitions on each."""
    training = training_of(args, "large-td3")
    env, own = make(training.environment, **training.options), training.train
    learners = {}
    for count in [2**i for i in range(jax.device_count().bit_length())]:
        config = dataclasses.replace(own, envs=own.envs * count, batch=own.batch * count)
        learners[count] = Learner(env, config, Mesh(np.array(jax.devices()[:count]), (AXIS,)))
    in_threads(*(learner.compile for learner in learners.values()))
    say(f"scaling: compiled after {clock.spent:.0f} s")
    rows: list[dict[str, Any]] = []
    for count, learner in learners.items():
        config, state, best = learner.config, learner.init(0), float("inf")
        for i in range(2 if args.tiny else 9):
            begin = time.monotonic()
            state, _ = jax.block_until_ready(learner.epoch(env.params, state))
            if i:
                best = min(best, time.monotonic() - begin)
        rate = config.envs * config.epoch_steps / best
        row = {"devices": count, "steps_per_s": rate, "updates_per_s": config.updates * config.epoch_steps / best}
        rows.append({**row, "efficiency": rate / count / (rows[0]["steps_per_s"] if rows else rate)})
        say(table_scaling(save(args.out, "scaling", {"rover": args.rover, "rows": rows}))[-1])
        del state
