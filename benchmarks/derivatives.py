"""What the derivatives of whole drives by many parameters cost, against the drives alone.

    python benchmarks/derivatives.py --batch 1024 --out benchmarks/derivatives_h200.json      # one GPU
    taskset -c 0,1 python benchmarks/derivatives.py --batch 8 --platform cpu --out benchmarks/derivatives_cpu.json

Forward mode (`jax.jacfwd`) of the rovers' last positions and temperatures by factors on the model's parameters, and for
comparison one batch of drives with each factor changed in turn. Structured engine, all effects of `consistent`, flat
ground, float32. Times are the best of three calls; compilation stands beside them. On a CPU the ratios are
of the process' CPU time.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from speed import control, starts
from timing import LOCK, alone

from lunar_mjx.dynamics import System, build
from lunar_mjx.model import make_model

EVERY = 25
"""Steps for which a control is held."""


def scaled(system: System, factors: Any) -> Any:
    """The model's parameters with the first numbers of its effects (alike for all joints) multiplied by factors."""
    leaves, tree = jax.tree.flatten(system.params.effects)
    floats = [i for i, leaf in enumerate(leaves) if jnp.asarray(leaf).dtype.kind == "f"]
    if len(floats) < len(factors):
        raise SystemExit(f"--parameters: the model has only {len(floats)}")
    for i, factor in zip(floats, factors, strict=False):
        leaves[i] = leaves[i] * factor
    return jax.tree.unflatten(tree, leaves)


def drive(system: System, state: Any, steps: int) -> Callable[[Any], Any]:
    """Factors (parameter,) to the last position and winding temperatures (rover, output)."""
    held = jnp.broadcast_to(control(system.model), (steps // EVERY, len(control(system.model))))

    def end(factors: Any) -> Any:
        params = dataclasses.replace(system.params, effects=scaled(system, factors))
        last = system.rollout_batch(params, state, held, EVERY, report=lambda t: None, one_body=True)[0]
        return jnp.concatenate([last.qpos[:, :3], last.temperature.winding], axis=1)

    return end


def jacobian(function: Callable[[Any], Any], chunk: int | None) -> Callable[[Any], Any]:
    """`jax.jacfwd`, or the same by so many parameters at a time, one such pass after another."""
    if chunk is None:
        return jax.jacfwd(function)

    def found(at: Any) -> Any:
        if len(at) % chunk:
            raise SystemExit(f"--chunk: {chunk} does not divide {len(at)} parameters")
        directions = jnp.eye(len(at)).reshape(-1, chunk, len(at))
        rows = jax.lax.map(jax.vmap(lambda v: jax.jvp(function, (at,), (v,))[1]), directions)
        return jnp.moveaxis(rows.reshape(len(at), *rows.shape[2:]), 0, -1)

    return found


def timed(function: Callable[[Any], Any], argument: Any) -> dict[str, Any]:
    begin, begin_cpu = time.perf_counter(), time.process_time()
    compiled = jax.jit(function).lower(argument).compile()
    compile_s, compile_cpu_s = time.perf_counter() - begin, time.process_time() - begin_cpu
    with alone():
        value = jax.block_until_ready(compiled(argument))
        walls, cpus = [], []
        for _ in range(3):
            begin, begin_cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(compiled(argument))
            walls.append(time.perf_counter() - begin)
            cpus.append(time.process_time() - begin_cpu)
        wall, cpu = min(walls), min(cpus)
    return {
        "seconds": wall,
        "cpu_s": cpu,
        "compile_s": compile_s,
        "compile_cpu_s": compile_cpu_s,
        "finite": bool(jnp.isfinite(value).all()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rover", default="luvmi_x")
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--parameters", type=int, default=40)
    parser.add_argument("--chunk", type=int, help="parameters per pass of forward mode; all at once if left out")
    parser.add_argument("--seconds", type=float, default=20.0, help="of the drive")
    parser.add_argument("--lock", type=Path, help="file that is locked while a row is timed; see backends.py")
    parser.add_argument("--platform", default="", help="cpu or cuda; JAX's choice if left out")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    LOCK[:] = [options.lock] if options.lock else []
    device = jax.devices(options.platform or None)[0]
    with jax.default_device(device):
        system = build(make_model(options.rover, "flat"), "structured")
        steps = round(options.seconds / system.dt)
        one = jnp.ones(options.parameters)
        rows: dict[str, Any] = {
            "about": {
                "device": device.device_kind,
                "jax": jax.__version__,
                "rover": options.rover,
                "batch": options.batch,
                "parameters": options.parameters,
                "steps": steps,
                "chunk": options.chunk,
                "nproc": os.environ.get("NPROC"),
            }
        }
        end = drive(system, starts(system, options.batch), steps)
        changed = jnp.concatenate([one[None], one + 1e-3 * jnp.eye(options.parameters)])
        for name, function, argument in (
            ("plain", end, one),
            ("jacfwd", jacobian(end, options.chunk), one),
            ("changed in turn", jax.vmap(end), changed),
        ):
            rows[name] = timed(function, argument)
            # processes beside this one cost a CPU wall time
            clock = "cpu_s" if device.platform == "cpu" else "seconds"
            rows[name]["plain_runs"] = rows[name][clock] / rows["plain"][clock]
            print(name, {k: round(float(v), 3) for k, v in rows[name].items()}, flush=True)
            if options.out:
                options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
