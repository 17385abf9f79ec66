"""Rover-steps per second of a step as one kernel (CUDA C from the traced step) beside XLA's; each row a process.

    python benchmarks/one_kernel.py --out benchmarks/one_kernel_gpu.json

Every row starts from the same rovers. `gap` is the largest difference of the base's position and velocity from XLA's
rollout of the same model in the same process, over the largest change that the drive made there. Needs CuPy.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from speed import control, rollout, starts
from timing import LOCK, alone, commit

from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.one_kernel import KernelRollout
from lunar_mjx.model import make_model

STEPS = 50
VARIANTS = [[128, 1, ["--use_fast_math"]], [128, 1, []]]


def best_of(function: Any, state: Any, repeats: int = 5) -> float:
    """Seconds of the fastest of some calls, each from the last one's result."""
    least = float("inf")
    for _ in range(repeats):
        begin = time.perf_counter()
        state = jax.block_until_ready(function(state))
        least = min(least, time.perf_counter() - begin)
    return least


def kernel_seconds(kernel: KernelRollout, state: Any, held: Any, steps: int, repeats: int = 5) -> float:
    """Seconds of the kernel alone, by the GPU's clock."""
    import cupy  # pyright: ignore[reportMissingImports]

    rows = cupy.from_dlpack(jax.block_until_ready(kernel.rows(state, held)))
    least = float("inf")
    for _ in range(repeats):
        begin, end = cupy.cuda.Event(), cupy.cuda.Event()
        begin.record()
        kernel.run_rows(rows, steps)
        end.record()
        end.synchronize()
        least = min(least, cupy.cuda.get_elapsed_time(begin, end) * 1e-3)
    return least


def row(rover: str, preset: str, batch: int, variants: list[Any], steps: int) -> dict[str, Any]:
    """One model as XLA compiles it and as one kernel, in the variants (threads, blocks, options)."""
    model = make_model(rover, preset=preset)
    system = build(model, "structured")
    state = starts(system, batch)
    xla = jax.jit(rollout(system, steps, None)).lower(state).compile()
    told: dict[str, Any] = {"rover": rover, "preset": preset, "batch": batch, "kernels": []}
    expected = jax.block_until_ready(xla(state))
    with alone():
        told["xla_steps_per_s"] = batch * steps / best_of(xla, state)
    print(json.dumps(told), flush=True)
    held = jnp.broadcast_to(jnp.asarray(control(model)), (batch, len(control(model))))
    for block, blocks, options in variants:
        begin = time.perf_counter()
        kernel = KernelRollout(system, system.params, block=block, blocks=blocks, options=tuple(options))
        own: dict[str, Any] = {"block": block, "blocks": blocks, "options": options}
        own["trace_s"], begin = time.perf_counter() - begin, time.perf_counter()
        kernel.compile()
        own["compile_s"] = time.perf_counter() - begin
        own |= {"registers": kernel.registers, "spilled_bytes": kernel.spilled}
        found = kernel(state, held, steps)
        gaps = []
        for name, size in (("qpos", 3), ("qvel", 6)):
            a, b, c = (np.asarray(getattr(s, name), float)[:, :size] for s in (expected, state, found))
            moved = np.abs(a - b).max(axis=1)
            gaps.append(np.abs(a - c).max(axis=1) / np.maximum(moved, 1e-6))
        own["gap"] = float(np.max(gaps))
        own["gap_99"] = float(np.quantile(np.max(gaps, axis=0), 0.99))
        own["finite"] = all(bool(np.isfinite(a).all()) for a in jax.tree.leaves(jax.device_get(found)))
        with alone():
            own["whole_steps_per_s"] = batch * steps / best_of(lambda s, k=kernel: k(s, held, steps), state)
            own["kernel_steps_per_s"] = batch * steps / kernel_seconds(kernel, state, held, steps)
        told["kernels"].append(own)
        print(json.dumps(told), flush=True)
    return told


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--row", help="rover,preset,batch: this one, here")
    parser.add_argument(
        "--rows", default="luvmi_x,consistent,65536;luvmi_x,field,65536;viper,consistent,65536;viper,field,65536"
    )
    parser.add_argument("--variants", type=json.loads, default=VARIANTS, help="[[threads, blocks, [options]], ...]")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for a row")
    parser.add_argument("--lock", type=Path, help="file that is locked while something is timed, for runs side by side")
    parser.add_argument("--commit")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    LOCK[:] = [options.lock] if options.lock else []
    if options.row:
        rover, preset, batch = options.row.split(",")
        print(json.dumps(row(rover, preset, int(batch), options.variants, options.steps)), flush=True)
        return
    about = {
        "commit": options.commit or commit(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "steps": options.steps,
    }
    rows: list[dict[str, Any]] = []
    for one in options.rows.split(";"):
        command = [sys.executable, __file__, "--row", one, "--steps", str(options.steps)]
        command += ["--variants", json.dumps(options.variants)]
        command += ["--lock", str(options.lock)] if options.lock else []
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=options.limit)
            lines, error = done.stdout, done.stderr[-1500:] if done.returncode else ""
        except subprocess.TimeoutExpired as late:
            lines, error = late.stdout or "", f"more than {options.limit:g} s"
        text = lines.decode() if isinstance(lines, bytes) else lines
        found = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
        rows.append((found[-1] if found else {"row": one}) | ({"error": error} if error else {}))
        print(json.dumps(rows[-1]), flush=True)
        if options.out:
            options.out.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
