"""Rover-steps per second of every engine, gated by parity in the same run; JSON, table and roofline numbers.

    python benchmarks/speed.py --rovers luvmi_x,viper --batches 4096,32768,65536,131072 --out benchmarks/speed_gpu.json
    python benchmarks/speed.py --batches 1,256 --only-full --skip-mjx --pool 1 --processes 2 --threads 2 \
        --out benchmarks/speed_2cores.json

Rows: the structured engine with all effects of the preset `consistent`, with the stress integral, with one map per
rover, and without effects; MJX with all effects; bare `mjx.step`; native MuJoCo's batched stepper on the CPU.
A row counts only where `parity` is true: one step of both engines from the same states, in the same process.
With --processes, as many processes as stated also run each row at the same time, each pinned to a core of its own.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from timing import LOCK, alone, cpu_name, sharded

from lunar_mjx._quiet import mjx
from lunar_mjx.dynamics import Params, System, build
from lunar_mjx.model import Model, make_model

TOLERANCE = 2e-3
"""Largest difference of the velocities after one float32 step, relative to the largest velocity change."""


def control(model: Model) -> np.ndarray:
    """Drive at 1 rad/s with the wheels straight."""
    return np.array([1.0 if g.name == "drive" else 0.0 for g in model.rover.groups for _ in g.joints], np.float32)


def starts(system: System, batch: int) -> Any:
    spread = jnp.linspace(-5.0, 5.0, batch)
    return jax.jit(jax.vmap(lambda x, y: system.reset(system.params, x, y)))(spread, 0.6 * spread)


def parity(model: Model, batch: int = 64) -> float:
    """Difference of one step, structured against MJX, from states that have driven for 0.5 s."""
    if model.rover.loops:
        return loop_parity(model)
    ours, theirs = build(model, "structured"), build(model, "mjx")
    state = starts(ours, batch)
    controls = jnp.broadcast_to(control(model), (250, len(control(model))))
    state, _ = jax.jit(lambda s: ours.rollout_batch(ours.params, s, controls, report=lambda t: None))(state)
    held = jnp.broadcast_to(controls[0], (batch, controls.shape[1]))
    new = [jax.jit(lambda s, e=e: e.step_batch(e.params, s, held)[0])(state).qvel for e in (ours, theirs)]
    change = jnp.maximum(jnp.abs(new[1] - state.qvel).max(), 1e-3)
    return float(jnp.abs(new[0] - new[1]).max() / change)


def loop_parity(model: Model, states: int = 20) -> float:
    """Difference of the accelerations from the rigid loop of native MuJoCo's matrices, from random states and forces.

    MJX's loops are soft: its velocities differ from a rigid loop's by several per cent of a step's change.
    """
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "dynamics"))
    from structured_reference import Reference

    reference = Reference(model.rover)
    reference.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    qpos, qvel, forces = reference.random(states)
    with jax.enable_x64(True):
        qpos, qvel = reference.closed(qpos, qvel)
    single = [jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), x) for x in (qpos, qvel, forces)]
    new = np.asarray(reference.step(*single)[1][1], float)
    free = [*range(6)]
    for group in reference.engine.structure.groups:
        free += [int(dof) for k in group.free for dof in group.links[k].dof]
    gap = 0.0
    for i in range(states):
        exact = reference.hard_loop(qpos[i], qvel[i], {k: f[i] for k, f in forces.items()})
        found = (new[i] - np.float32(qvel[i])) / reference.timestep
        gap = max(gap, float(np.abs(found - exact)[free].max() / np.abs(exact).max()))
    return gap


READY = "ready"
"""What a process of `side_by_side` prints when its row is compiled; it times the row once it gets a line of input."""
MEETING: list[bool] = []
"""Not empty where this process waits for such a line."""


def meet() -> None:
    """Waits until all processes of `side_by_side` have compiled, or ends with the one that started them."""
    if MEETING:
        print(READY, flush=True)
        if not sys.stdin.readline():
            raise SystemExit("speed.py: another process ended before it was ready.")


def timed(
    function: Any,
    state: Any,
    steps: int,
    batch: int,
    repeats: int = 3,
    inspect: Callable[[Any], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Compiles, warms up, and times `function(state) -> state` of `steps` steps; `inspect` sees the first result."""
    begin = time.perf_counter()
    lowered = jax.jit(function).lower(state)
    traced = time.perf_counter() - begin
    compiled = lowered.compile()
    compile_s = time.perf_counter() - begin - traced
    text, cost = compiled.as_text() or "", compiled.cost_analysis() or {}
    best = cpu = float("inf")
    with alone():
        new = jax.block_until_ready(compiled(state))
    found = inspect(new) if inspect is not None else {}
    with alone():
        meet()
        for _ in range(repeats):
            wall, process = time.perf_counter(), time.process_time()
            new = jax.block_until_ready(compiled(new))
            best, cpu = min(best, time.perf_counter() - wall), min(cpu, time.process_time() - process)
    return found | {
        "steps_per_s": batch * steps / best,
        "us_per_batch_step": best / steps * 1e6,
        "process_cpu_ns_per_step": cpu / steps / batch * 1e9,
        "trace_s": traced,
        "compile_s": compile_s,
        "kernels_in_loop": kernels_in_loop(text),
        # XLA's analysis counts the body of the loop over time once
        "bytes_per_step": cost.get("bytes accessed", 0.0) / batch,
        "flop_per_step": cost.get("flops", 0.0) / batch,
        "finite": all(bool(np.isfinite(a).all()) for a in jax.tree.leaves(jax.device_get(new))),
    }


def kernels_in_loop(text: str) -> int:
    """Fusions, copies and library calls of the largest computation that is no fusion: the loop's body."""
    counts, name = {}, ""
    for line in text.splitlines():
        if line and not line.startswith(" ") and line.endswith("{"):
            name = line.split(" ", 1)[0]
        elif "fused" not in name:
            counts[name] = counts.get(name, 0) + any(f" {op}(" in line for op in ("fusion", "copy", "custom-call"))
    return max(counts.values(), default=0)


def rollout(system: System, steps: int, chunk: int | None, params: Params | None = None, axes: Any = None) -> Any:
    held = jnp.broadcast_to(control(system.model), (steps, len(control(system.model))))

    def run(state: Any) -> Any:
        used = system.params if params is None else params
        return system.rollout_batch(used, state, held, report=lambda t: None, params_axes=axes, chunk=chunk)[0]

    return run


def per_rover_maps(system: System, batch: int, nodes: int = 128) -> Params:
    """A small map for every rover, each a shifted cut of the model's own."""
    field = system.params.terrain.field
    rows = np.asarray(field.heights)
    cut = np.stack([np.roll(rows[:nodes, :nodes], i % nodes, axis=0) for i in range(min(batch, 64))])
    heights = jnp.asarray(cut)[jnp.arange(batch) % len(cut)]
    ground = dataclasses.replace(
        system.params.terrain, field=dataclasses.replace(field, heights=heights), rocks=None, soil=None
    )
    return dataclasses.replace(system.params, terrain=ground)


def bare_mjx(model: Model, steps: int, batch: int) -> dict[str, Any]:
    native = model.rover.compile()
    m = mjx.put_model(native)
    data = jax.vmap(lambda _: mjx.make_data(m))(jnp.arange(batch))

    def run(data: Any) -> Any:
        step = jax.vmap(lambda d: mjx.step(m, d))
        return jax.lax.scan(lambda d, _: (step(d), None), data, None, length=steps)[0]

    return timed(run, data, steps, batch)


def side_by_side(rover: str, batch: int, options: argparse.Namespace) -> dict[str, Any]:
    """The sum of several processes that run the same batch at the same time, one on each core."""
    cores = sorted(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as folder:
        outs = [Path(folder) / f"{i}.json" for i in range(options.processes)]
        command = [sys.executable, __file__, "--rovers", rover, "--batches", str(batch), "--meet", "--only-full"]
        # long enough to overlap
        command += ["--skip-mjx", "--pool", "1", "--steps", str(20 * options.steps)]
        children = [
            subprocess.Popen(
                [*command, "--out", str(out), "--core", str(cores[i % len(cores)])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for i, out in enumerate(outs)
        ]
        if all(any(line.strip() == READY for line in child.stdout or ()) for child in children):
            for child in children:
                assert child.stdin is not None
                print("go", file=child.stdin, flush=True)
        # closes the input of all: where one has ended, the others do so, too
        for child in children:
            child.communicate()
        if any(child.returncode for child in children):
            raise SystemExit("speed.py: one of the processes ended with an error; run it with --processes 0.")
        rows = [json.loads(out.read_text())["rows"][0] for out in outs]
    own = [row["process_cpu_ns_per_step"] for row in rows]
    return {
        "steps_per_s": sum(row["steps_per_s"] for row in rows),
        "processes": options.processes,
        "process_cpu_ns_per_step": float(np.mean(own)),
        "parity": all(row["parity"] for row in rows),
        "parity_gap": max(row["parity_gap"] for row in rows),
    }


def native_batch(model: Model, threads: int, batch: int, steps: int = 200) -> dict[str, Any]:
    """Native MuJoCo without effects on `threads` threads (float64)."""
    from mujoco import rollout as native_rollout

    native = model.rover.compile()
    data = [mujoco.MjData(native) for _ in range(threads)]
    size = mujoco.mj_stateSize(native, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros((batch, size))
    mujoco.mj_getState(native, data[0], state[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state[:] = state[0]
    best = cpu = float("inf")
    with native_rollout.Rollout(nthread=threads) as runner:
        for _ in range(3):
            begin, process = time.perf_counter(), time.process_time()
            runner.rollout([native] * batch, data, state, nstep=steps)
            best, cpu = min(best, time.perf_counter() - begin), min(cpu, time.process_time() - process)
    return {
        "steps_per_s": batch * steps / best,
        "process_cpu_ns_per_step": cpu / steps / batch * 1e9,
        "threads": threads,
    }


def rows_of(rover: str, options: argparse.Namespace, rows: list[dict[str, Any]], save: Callable[[], None]) -> None:
    """Appends the rows of one rover, and saves them one by one."""
    model = make_model(rover)
    gap = parity(model)

    def add(engine: str, batch: int, result: dict[str, Any]) -> None:
        counted = {"parity": gap < TOLERANCE, "parity_gap": gap} if engine.startswith("structured") else {}
        rows.append({"rover": rover, "engine": engine, "batch": batch, **counted, **result})
        print(
            f"{rover:8s} {engine:28s} {batch:8d} {result['steps_per_s']:14,.0f} steps/s  "
            + ", ".join(
                f"{k} {v:.3g}"
                for k, v in result.items()
                if k
                in (
                    "compile_s",
                    "kernels_in_loop",
                    "bytes_per_step",
                    "flop_per_step",
                    "process_cpu_ns_per_step",
                    "efficiency",
                )
            ),
            flush=True,
        )
        save()

    full, bare = build(model, "structured"), model
    integral = build(model.add("stress_integral"), "structured")
    for effect in model.effect_names:
        bare = bare.remove(effect)
    for batch in options.batches:
        chunk = options.chunk or None
        state = starts(full, batch)
        steps = options.steps * max(1, 256 // batch)  # a few steps of few rovers are over before the clock ticks
        add("structured", batch, timed(rollout(full, steps, chunk), state, steps, batch))
        single = rows[-1]["steps_per_s"]
        for count in options.devices[1:]:
            # weak scaling (a batch for each) and strong scaling (one batch for all)
            for whole in (count * batch, batch):
                run, split = sharded(rollout(full, steps, chunk), starts(full, whole), jax.devices()[:count])
                own = timed(run, split, steps, whole)
                share = own["steps_per_s"] / (count * single)
                add(f"structured, {count} devices", whole, own | {"efficiency": share})
        if not options.only_full and batch in (options.batches[-1], options.main):
            own = starts(integral, batch)
            add(
                "structured, stress integral",
                batch,
                timed(rollout(integral, options.steps, chunk), own, options.steps, batch),
            )
            naked = build(bare, "structured")
            add(
                "structured, no effects",
                batch,
                timed(rollout(naked, options.steps, chunk), starts(naked, batch), options.steps, batch),
            )
        if batch == options.main:
            maps = per_rover_maps(full, batch)
            # an argument: as a constant of the program 4 GB of maps would be compiled in

            def own_maps(both: Any, chunk: int | None = chunk) -> Any:
                return both[0], rollout(full, options.steps, chunk, both[0], _terrain_axes(both[0]))(both[1])

            add("structured, map per rover", batch, timed(own_maps, (maps, state), options.steps, batch))
            if not options.skip_mjx:
                slow = build(model, "mjx")
                add("mjx", batch, timed(rollout(slow, options.mjx_steps, None), state, options.mjx_steps, batch))
                add("bare mjx.step", batch, bare_mjx(model, options.mjx_steps, batch))
        if options.processes:
            add(f"structured, {options.processes} processes", batch, side_by_side(rover, batch, options))
    if options.threads:
        add("native rollout, no effects", 512, native_batch(model, options.threads, 512))


def _terrain_axes(params: Params) -> Params:
    """Per-rover heights; everything else shared."""
    none = jax.tree.map(lambda _: None, params)
    field = dataclasses.replace(none.terrain.field, heights=0)
    return dataclasses.replace(none, terrain=dataclasses.replace(none.terrain, field=field))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    numbers = lambda text: [int(n) for n in text.split(",")]  # noqa: E731
    parser.add_argument("--rovers", default="luvmi_x,viper")
    parser.add_argument("--batches", type=numbers, default=[1024, 4096])
    parser.add_argument("--main", type=int, default=0, help="batch at which every engine is compared")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--mjx-steps", type=int, default=10)
    parser.add_argument("--chunk", type=int, default=0, help="rovers per chunk; 0: the library's choice")
    parser.add_argument(
        "--devices", type=numbers, default=[1], help="such as 1,2,4; several take a batch each, then share one"
    )
    parser.add_argument("--lock", type=Path, help="file that is locked while a row is timed; see backends.py")
    parser.add_argument("--threads", type=int, default=0, help="threads of native MuJoCo; 0: leave it out")
    parser.add_argument("--processes", type=int, default=0, help="processes side by side, besides the one; 0: none")
    parser.add_argument("--pool", type=int, default=0, help="threads of XLA on a CPU (NPROC); 0: one per core")
    parser.add_argument("--core", type=int, default=-1, help="core to run on; -1: any")
    parser.add_argument("--meet", action="store_true", help="wait for a line of input before a row is timed")
    parser.add_argument("--skip-mjx", action="store_true")
    parser.add_argument("--only-full", action="store_true", help="leave out stress integral and no effects")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.pool:
        os.environ["NPROC"] = str(options.pool)  # read when JAX makes its CPU client, at the first use of a device
    if options.core >= 0:
        os.sched_setaffinity(0, {options.core})
    MEETING[:] = [True] if options.meet else []
    rows: list[dict[str, Any]] = []
    LOCK[:] = [options.lock] if options.lock else []
    about = {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "cpu": cpu_name(),
        "cores": len(os.sched_getaffinity(0)),
        "steps": options.steps,
        "chunk": options.chunk,
        "pool": options.pool,
    }

    def save() -> None:
        if options.out:
            options.out.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n")

    for rover in options.rovers.split(","):
        rows_of(rover, options, rows, save)


if __name__ == "__main__":
    main()
