"""Parts `rates` and `export` of measure.py: steps per second, and how exact and quick exported policies are.

    python benchmarks/rl/measure.py rates --out runs/rates                                      # one GPU
    python benchmarks/rl/measure.py rates --only 17/5/64 --env terrain=flat --out runs/rates    # two CPU cores
    python benchmarks/rl/measure.py export --out runs/export                                    # a core

Rates are of all that belongs to a step, against the bare physics. A row is numbers that are observed / physics steps
per action / rovers.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from harness import Clock, in_time, save, say

from lunar_mjx.agents.export.write import NODE, export_policy
from lunar_mjx.agents.policy import load_policy, shipped_policy
from lunar_mjx.commands.train import env_options
from lunar_mjx.envs import make_navigation, split_keys
from lunar_mjx.envs.navigation.observations import PAPER_OBSERVATION

FEW = {"observations": PAPER_OBSERVATION, "privileged": ()}
"""Options of an environment with 17 observations."""
COUNT, SEED = 2000, 0
"""Observations of exported policies, drawn around the training's mean with 1.5 of its deviations."""


class Driven:
    """Steps of an environment under random actions in one program, compiled when made.

    Args:
      env: the environment. size: rovers. steps: of each, in one repetition.
    """

    def __init__(self, env: Any, size: int, steps: int):
        self.env, self.size, self.steps, key = env, size, steps, jax.random.PRNGKey(0)

        def drive(params: Any, state: Any, key: Any) -> Any:
            def step(carry: Any, key: Any) -> Any:
                state, ended = carry
                state = env.step(params, state, jax.random.uniform(key, (size, env.action_size), minval=-1.0))
                # each rover counts: a sum over all, XLA fuses with the environment's last kernel, run by one block then
                return (state, ended + state.done), None

            start = (state, jnp.zeros(size, jnp.int32))
            (state, ended), _ = jax.lax.scan(step, start, jax.random.split(key, steps))
            return state, jnp.sum(ended)

        self.begins: Any = jax.eval_shape(env.reset, env.params, jax.ShapeDtypeStruct((size, 2), jnp.uint32))
        self.program: Any = jax.jit(drive, donate_argnums=1).lower(env.params, self.begins, key).compile()

    def timed(self, state: Any, repeats: int, beside: Callable[[], Any] = lambda: None) -> Any:
        """s of repetitions after a first one, s of `beside` after each, and how many episodes ended in each.

        Args:
          state: of all rovers; used up. beside: what is timed in turns with this.
        """
        # episodes at every stage, so that as many end in one step as in the next
        waited = jax.random.uniform(jax.random.PRNGKey(1), (self.size,)) * self.env.config.stuck_time
        state, taken = dataclasses.replace(state, inner=dataclasses.replace(state.inner, waited=waited)), []
        for i in range(repeats + 1):
            begin = time.monotonic()
            state, ended = jax.block_until_ready(self.program(self.env.params, state, jax.random.PRNGKey(i)))
            middle = time.monotonic()
            beside()
            taken.append((middle - begin, time.monotonic() - middle, int(ended)))
        return map(list, zip(*taken[1:], strict=True))

    def rate(self, state: Any, repeats: int) -> dict[str, Any]:
        """Median, least and most of the rates of repetitions, with pictures; `state`, of all rovers, is used up."""
        seconds, _, ended = self.timed(state, repeats)
        rates, c = [self.size * self.steps / s for s in seconds], self.env.config
        about = {"rovers": self.size, "steps": self.steps, "picture": [c.camera_width, c.camera_height]}
        found = {"env_steps_per_s": statistics.median(rates), "least": min(rates), "most": max(rates)}
        return {**about, **found, "seconds": seconds, "resets_per_step": sum(ended) / (repeats * self.steps)}


class Rate(Driven):
    """The environment under random actions, and its physics alone under the same changes; compiled when made."""

    def __init__(self, env: Any, size: int, steps: int):
        super().__init__(env, size, steps)
        actions = jax.random.uniform(jax.random.PRNGKey(0), (steps, env.action_size), minval=-1.0)
        controls = env.actions.controls(actions)

        def bare(params: Any, state: Any) -> Any:
            every = env.config.decimation
            return env.system.rollout_batch(params.system, state, controls, every, report=lambda t: None)[0]

        self._reset = jax.jit(env.reset).lower(env.params, jax.ShapeDtypeStruct((size, 2), jnp.uint32)).compile()
        self._bare = jax.jit(bare, donate_argnums=1).lower(env.params, self.begins.inner.physics).compile()

    def measure(self, repeats: int) -> dict[str, Any]:
        """Best of several repetitions, in turns."""
        params, steps = self.env.params, self.size * self.steps
        state = jax.block_until_ready(self._reset(params, split_keys(jax.random.PRNGKey(0), self.size)))
        physics = jax.tree.map(jnp.copy, state.inner.physics)
        held = sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / self.size

        def beside() -> None:
            nonlocal physics
            physics = jax.block_until_ready(self._bare(params, physics))

        seconds, naked, ended = self.timed(state, repeats, beside)
        best, bare, memory = min(seconds), min(naked), self.program.memory_analysis()
        return {
            "env_steps_per_s": steps / best,
            "physics_steps_per_s": steps * self.env.config.decimation / best,
            "bare_steps_per_s": steps / bare,
            "ratio": bare / best,
            "resets_per_step": ended[-1] / self.steps,
            "seconds": seconds,
            "bare_seconds": naked,
            "state_bytes_per_rover": held,
            "temporary_bytes_per_rover": getattr(memory, "temp_size_in_bytes", 0) / self.size,
        }


def rates(args: argparse.Namespace, clock: Clock) -> None:
    """Compiles every row in threads, and measures."""
    plan = [(numbers, int(every), int(size)) for numbers, every, size in (row.split("/") for row in args.only)]
    made = {}
    for numbers, every in {row[:2] for row in plan}:
        options = {"places": 2048, **(FEW if numbers == "17" else {}), **env_options(args.env)}
        made[numbers, every] = make_navigation("large", args.rover, decimation=every, **options)
    with ThreadPoolExecutor(8) as pool:
        ready = list(pool.map(lambda row: Rate(made[row[:2]], row[2], max(20, 1000 // row[1])), plan))
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


def exported(path: Path) -> dict[str, float]:
    """Greatest errors of both graphs of a policy, and times of the exported folder's own node, ms."""
    policy = load_policy(path)
    assert policy.mean is not None and policy.deviation is not None
    drawn = np.random.default_rng(SEED).normal(0.0, 1.5, (COUNT, policy.network["obs"]))
    obs = (drawn * policy.deviation + policy.mean).astype(np.float32)
    wanted, actions, times = np.asarray(policy.act(obs)), [], []
    with tempfile.TemporaryDirectory() as name:
        export_policy(path, Path(name))
        spec: Any = importlib.util.spec_from_file_location("node", Path(name) / NODE)
        node = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(node)
        taken = node.Policy(name)
        for row in obs:
            begin = time.perf_counter()
            actions.append(taken.act(row))
            times.append(1e3 * (time.perf_counter() - begin))
        graph = jax.export.deserialize(bytearray((Path(name) / "policy.stablehlo").read_bytes()))
        other = np.asarray(graph.call(obs))
    errors = {"onnx_error": np.stack(actions), "stablehlo_error": other}
    found = {name: float(np.abs(values - wanted).max()) for name, values in errors.items()}
    return found | {"median_ms": float(np.median(times)), "p99_ms": float(np.quantile(times, 0.99))}


def export(args: argparse.Namespace, _: Clock) -> None:
    """Measures the policies that ship with rovers."""
    paths = {rover: shipped_policy(rover) for rover in ("luvmi_x", "viper")}
    rows = {rover: exported(path) for rover, path in paths.items() if path is not None}
    say(str(rows))
    save(args.out, "export", {"seed": SEED, "observations": COUNT, "rovers": rows})
