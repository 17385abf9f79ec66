"""What the derivatives of whole drives by many parameters cost, against the drives alone.

    python benchmarks/derivatives.py --batch 1024 --out benchmarks/derivatives_h200.json      # one GPU
    taskset -c 0,1 python benchmarks/derivatives.py --batch 8 --platform cpu --out benchmarks/derivatives_cpu.json

Forward mode (`jax.jacfwd`) of the rovers' last positions and temperatures by factors on the model's parameters, and for
comparison one batch of drives with each factor changed in turn. Structured engine, all effects of `consistent`, flat
ground, float32. Times are of the second call; the first one's compilation stands beside them.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
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


def timed(function: Callable[[Any], Any], argument: Any) -> dict[str, Any]:
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(argument).compile()
    compile_s = time.perf_counter() - begin
    with alone():
        value = jax.block_until_ready(compiled(argument))
        begin = time.perf_counter()
        jax.block_until_ready(compiled(argument))
        wall = time.perf_counter() - begin
    return {"seconds": wall, "compile_s": compile_s, "finite": bool(jnp.isfinite(value).all())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rover", default="luvmi_x")
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--parameters", type=int, default=40)
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
        rows: dict[str, Any] = {"about": {
            "device": device.device_kind, "jax": jax.__version__, "rover": options.rover, "batch": options.batch,
            "parameters": options.parameters, "steps": steps}}  # fmt: skip
        end = drive(system, starts(system, options.batch), steps)
        changed = jnp.concatenate([one[None], one + 1e-3 * jnp.eye(options.parameters)])
        for name, function, argument in (
            ("plain", end, one),
            ("jacfwd", jax.jacfwd(end), one),
            ("changed in turn", jax.vmap(end), changed),
        ):
            rows[name] = timed(function, argument)
            rows[name]["plain_runs"] = rows[name]["seconds"] / rows["plain"]["seconds"]
            print(name, {k: round(float(v), 3) for k, v in rows[name].items()}, flush=True)
            if options.out:
                options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
